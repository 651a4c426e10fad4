"""``triline locate``: pixels to the ground and back."""

from __future__ import annotations

import json

import numpy as np
import pandas as pd
import pytest
import rasterio
from relief import Waves
from satellite_scenes import Truth, write_dimap2, write_folder

from triline.nodes.cli import main
from triline.nodes.formats.height_raster import HeightRaster
from triline.nodes.formats.satellite.read import read_scene
from triline.nodes.formats.satellite.rpc_files import write_rpb
from triline.solver.location.rpc_fit import fit_to_model

TRUTH = Truth(lines=4000, samples=500)


@pytest.fixture
def scene(tmp_path):
    return write_dimap2(tmp_path / "scene.xml", TRUTH)


def pixels(tmp_path, rows="0,0,0\n499,3999,500\n250.25,1999.5,-400\n"):
    path = tmp_path / "pixels.csv"
    path.write_text("column,row,height_m\n" + rows)
    return path


def test_there_and_back(scene, tmp_path, capsys):
    ground, back = tmp_path / "ground.csv", tmp_path / "back.csv"
    assert main(["locate", str(scene), "--pixels", str(pixels(tmp_path)), "-o", str(ground)]) == 0
    assert "3 rows, 0 of them miss" in capsys.readouterr().out
    assert main(["locate", str(scene), "--ground", str(ground), "-o", str(back), "-q"]) == 0
    asked, got = pd.read_csv(tmp_path / "pixels.csv"), pd.read_csv(back)
    # seven decimals of a degree would be a centimetre; ten are written
    assert (asked[["column", "row"]] - got[["column", "row"]]).abs().max().max() < 1e-4


def test_heights_far_beyond_those_of_an_rpc_are_told(scene, tmp_path, capsys):
    """At 50 km the polynomials of a Pleiades image are hundreds of metres off, and nothing said so."""
    write_rpb(tmp_path / "scene.RPB", fit_to_model(read_scene(scene).model("rigorous"), 0.0, 500.0).rpc)
    words = ["locate", str(tmp_path / "scene.RPB"), "-o", str(tmp_path / "out.csv"), "--json", "--pixels"]
    assert main([*words, str(pixels(tmp_path, "0,0,0\n10,10,500\n20,20,900\n"))]) == 0
    assert json.loads(capsys.readouterr().out)["notes"] == []
    assert main([*words, str(pixels(tmp_path, "0,0,0\n10,10,1100\n20,20,50000\n"))]) == 0
    (note,) = json.loads(capsys.readouterr().out)["notes"]
    assert note.startswith("heights of 2 rows, up to 50000 m, lie beyond those that the RPC was made for (0 to 500 m)")


def test_rows_that_miss_are_empty_with_a_note(scene, tmp_path, capsys):
    ground, back = tmp_path / "ground.csv", tmp_path / "back.csv"
    where = pixels(tmp_path, "0,0,0\n900,10,0\n10,10,800000\n")
    assert main(["locate", str(scene), "--pixels", str(where), "-o", str(ground), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["missed"] == 2
    table = pd.read_csv(ground)
    assert table["lon_deg"].isna().tolist() == [False, True, True]
    assert table["note"].tolist()[1:] == ["outside the image of 500 columns and 4000 rows", "the ray misses the ground"]
    assert main(["locate", str(scene), "--ground", str(ground), "-o", str(back), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["missed"] == 2
    again = pd.read_csv(back)
    assert (
        again["column"].isna().tolist() == [False, True, True] and again["note"].tolist()[1:] == ["nothing given"] * 2
    )
    (tmp_path / "far.csv").write_text("lon_deg,lat_deg,height_m\n0,0,0\n")
    assert main(["locate", str(scene), "--ground", str(tmp_path / "far.csv"), "-o", str(back), "-q"]) == 0
    row = pd.read_csv(back).iloc[0]
    assert pd.isna(row["column"]) and row["note"] == "not in the image"
    assert main(["locate", str(scene), "--pixels", str(back), "-o", str(ground), "-q"]) == 0
    assert pd.read_csv(ground)["note"].tolist() == ["nothing given"]
    for row, what in (("1,,0", "lat_deg"), (",1,0", "lon_deg"), ("1,1,", "height_m")):
        (tmp_path / "part.csv").write_text(f"lon_deg,lat_deg,height_m\n0,0,0\n{row}\n")
        assert main(["locate", str(scene), "--ground", str(tmp_path / "part.csv"), "-o", str(back), "-q"]) == 1
        assert f"part.csv:3: {what}: missing, wanted a number" in capsys.readouterr().err


def test_sigmas_of_the_command_line_and_of_the_scene(scene, tmp_path):
    ground = tmp_path / "ground.csv"
    sigmas = ["--position-sigma", "1", "1", "1", "--attitude-sigma", "0", "0", "0", "--height-sigma", "0"]
    assert main(["locate", str(scene), "--pixels", str(pixels(tmp_path)), "-o", str(ground), "-q", *sigmas]) == 0
    table = pd.read_csv(ground)
    assert table["sigma_e_m"].between(0.9, 1.2).all() and (table["sigma_u_m"] < 1e-6).all()
    text = "[frames]\nattitude = 'orbital'\n[sigma]\nposition_m = [2.0, 2.0, 2.0]\nheight_m = 3.0\n"
    folder = write_folder(tmp_path / "folder", TRUTH, settings=text)
    assert main(["locate", str(folder), "--pixels", str(pixels(tmp_path)), "-o", str(ground), "-q"]) == 0
    table = pd.read_csv(ground)
    assert table["sigma_u_m"].between(2.999, 3.001).all() and (table["sigma_n_m"] > 1.9).all()


def test_rpc_beside_the_rigorous_model(scene, tmp_path, capsys):
    write_rpb(tmp_path / "scene.RPB", fit_to_model(read_scene(scene).model("rigorous"), -500.0, 1000.0).rpc)
    ground, back = tmp_path / "ground.csv", tmp_path / "back.csv"
    main(["locate", str(scene), "--pixels", str(pixels(tmp_path)), "-o", str(ground), "-q"])
    assert main(["locate", str(tmp_path / "scene.RPB"), "--ground", str(ground), "-o", str(back)]) == 0
    assert "rpc model" in capsys.readouterr().out
    asked, got = pd.read_csv(tmp_path / "pixels.csv"), pd.read_csv(back)
    assert (asked[["column", "row"]] - got[["column", "row"]]).abs().max().max() < 0.01
    assert main(["locate", str(scene), "--model", "rpc", "--ground", str(ground), "-o", str(back)]) == 1
    assert "no rpc model in a file of the kind dimap2" in capsys.readouterr().err


def test_where_an_image_of_unknown_size_begins(scene, tmp_path, capsys):
    """An .RPB file does not say how large the image is, but that its first pixel is that of row and column 0."""
    rpc = fit_to_model(read_scene(scene).model("rigorous"), 0.0, 500.0).rpc
    write_rpb(tmp_path / "scene.RPB", rpc)
    lat, lon, height = rpc.direct([100.0, -50.0, 100.0], [100.0, 100.0, -50.0], 200.0).T
    places = {"lon_deg": np.degrees(lon), "lat_deg": np.degrees(lat), "height_m": height}
    pd.DataFrame(places).to_csv(tmp_path / "ground.csv", index=False)
    pd.DataFrame({"column": [100, 100, -50], "row": [100, -50, 100], "height_m": 200}).to_csv(
        tmp_path / "pixels.csv", index=False
    )
    for what, wanted in (("ground", "not in the image"), ("pixels", "outside the image")):
        args = ["locate", tmp_path / "scene.RPB", f"--{what}", tmp_path / f"{what}.csv", "-o", tmp_path / "out.csv"]
        assert main([str(word) for word in args]) == 0
        assert pd.read_csv(tmp_path / "out.csv")["note"].fillna("").tolist() == ["", wanted, wanted]
        assert ("do not say how large the image is" in capsys.readouterr().out) == (what == "ground")


@pytest.mark.parametrize(
    ("arguments", "match"),
    [
        (["--ccd", "B"], "line of detectors 'B': not in the scene"),
        (["--height-sigma", "-1"], "wanted numbers of at least 0"),
    ],
)
def test_one_line_for_what_does_not_go(arguments, match, scene, tmp_path, capsys):
    assert (
        main(["locate", str(scene), "--pixels", str(pixels(tmp_path)), "-o", str(tmp_path / "o.csv"), *arguments]) == 1
    )
    error = capsys.readouterr().err
    assert match in error and error.count("\n") == 1
    assert not (tmp_path / "o.csv").exists()


def test_refraction_there_and_back(scene, tmp_path, capsys):
    straight, ground, back = (tmp_path / name for name in ("straight.csv", "ground.csv", "back.csv"))
    where = str(pixels(tmp_path))
    assert main(["locate", str(scene), "--pixels", where, "-o", str(straight), "-q"]) == 0
    assert main(["locate", str(scene), "--pixels", where, "-o", str(ground), "-q", "--refraction"]) == 0
    assert main(["locate", str(scene), "--ground", str(ground), "-o", str(back), "-q", "--refraction"]) == 0
    asked, got = pd.read_csv(where), pd.read_csv(back)
    assert (asked[["column", "row"]] - got[["column", "row"]]).abs().max().max() < 1e-4
    moved_m = (pd.read_csv(ground)["lat_deg"] - pd.read_csv(straight)["lat_deg"]).abs().max() * 111_000
    assert 0.05 < moved_m < 20.0
    stated = ["--refraction", "300", "1023", "16"]
    assert main(["locate", str(scene), "--pixels", where, "-o", str(ground), "-q", *stated]) == 0
    for bad, reason in (
        (["300"], "1 values, wanted none, or temperature"),
        (["20", "1", "1"], "temperature_k 20, "),
    ):
        assert main(["locate", str(scene), "--pixels", where, "-o", str(ground), "--refraction", *bad]) == 1
        assert f"--refraction: {reason}" in capsys.readouterr().err.replace("atmosphere: ", "")
    write_rpb(tmp_path / "scene.RPB", fit_to_model(read_scene(scene).model("rigorous"), 0.0, 500.0).rpc)
    assert main(["locate", str(tmp_path / "scene.RPB"), "--pixels", where, "-o", str(ground), "--refraction"]) == 1
    assert "--refraction goes with a rigorous model, this is an RPC" in capsys.readouterr().err


def test_refraction_on_another_planet_is_refused(tmp_path, capsys):
    planet = "[planet]\nsemi_major_m = 6300000.0\nsemi_minor_m = 6300000.0\nrotation_rate_rad_s = 0.0\n"
    folder = write_folder(tmp_path / "folder", TRUTH, settings="[frames]\nattitude = 'orbital'\n" + planet)
    where, ground = str(pixels(tmp_path)), str(tmp_path / "ground.csv")
    for command in (["locate", str(folder), "--pixels", where, "-o", ground], ["study", "sensitivity", str(folder)]):
        assert main([*command, "--refraction"]) == 1
        assert "--refraction knows the air of the Earth only, this is another planet" in capsys.readouterr().err


@pytest.fixture
def relief(scene, tmp_path):
    """Relief under the scene, and its raster; the values are heights above the ellipsoid."""
    waves = Waves.under(read_scene(scene).model(), 120, waves=2.0)
    return waves, ["--dem", str(waves.write(tmp_path / "dem.tif")), "--dem-datum", "ellipsoid"]


def located(scene, tmp_path, where, *more) -> pd.DataFrame:
    assert main(["locate", str(scene), *map(str, where), "-o", str(tmp_path / "out.csv"), "-q", *map(str, more)]) == 0
    return pd.read_csv(tmp_path / "out.csv")


def on_terrain(scene, tmp_path, rows, *more) -> pd.DataFrame:
    path = tmp_path / "bare.csv"
    path.write_text("column,row\n" + rows)
    return located(scene, tmp_path, ["--pixels", path], *more)


def test_pixels_on_a_terrain_lie_on_it_and_come_back(scene, relief, tmp_path):
    waves, dem = relief
    rows = "".join(f"{x},{y}\n" for x in (0, 12.5, 250, 499) for y in (0, 1234.5, 3999))
    table = on_terrain(scene, tmp_path, rows, *dem)
    assert len(table) == 12 and table["note"].isna().all() and table["height_m"].between(0, 1000).all()
    assert table["height_m"].max() - table["height_m"].min() > 100
    surface = waves.at(np.radians(table["lat_deg"]), np.radians(table["lon_deg"]))
    assert np.abs(table["height_m"] - surface).max() < 0.01
    table[["lon_deg", "lat_deg"]].to_csv(tmp_path / "places.csv", index=False)
    back = located(scene, tmp_path, ["--ground", tmp_path / "places.csv"], *dem)
    assert np.abs(back[["column", "row"]] - table[["column", "row"]]).to_numpy().max() < 0.01
    assert np.abs(back["height_m"] - table["height_m"]).max() < 0.01


def test_one_pixel_alone_is_met_where_the_ground_rises(scene, relief, tmp_path):
    # around the place at height 0 the terrain lies elsewhere than where the ray comes down
    _, dem = relief
    together = on_terrain(scene, tmp_path, "100,700\n0,0\n499,3999\n", *dem)
    alone = on_terrain(scene, tmp_path, "100,700\n", *dem)
    assert np.abs(alone.loc[0, ["lon_deg", "lat_deg"]] - together.loc[0, ["lon_deg", "lat_deg"]]).max() < 2e-8


def test_a_pixel_is_met_by_a_raster_of_its_place_alone(scene, tmp_path):
    """At height 0 the ray is beside it; that other pixels meet something, or nothing does, makes no difference."""
    waves = Waves.under(read_scene(scene).model(), 300, low_m=4000.0, high_m=4500.0)
    pixel, datum = "250,2000\n", ["--dem-datum", "ellipsoid"]
    whole = on_terrain(scene, tmp_path, pixel, "--dem", waves.write(tmp_path / "whole.tif"), *datum).iloc[0]
    row, column = (int(at) for at in waves.place(np.radians(whole["lat_deg"]), np.radians(whole["lon_deg"])))
    near = np.zeros(waves.z.shape, dtype=bool)
    near[row - 1 : row + 3, column - 1 : column + 3] = True
    waves.z = np.where(near, waves.z, np.float32(np.nan))
    alone = ["--dem", waves.write(tmp_path / "alone.tif"), *datum]
    for rows in (pixel, pixel + "100,0\n"):
        table = on_terrain(scene, tmp_path, rows, *alone)
        assert np.abs(table.loc[0, ["lon_deg", "lat_deg"]] - whole[["lon_deg", "lat_deg"]]).max() < 2e-8
        assert len(table) == 1 or table.loc[1, "note"] == "no height of alone.tif where the ray comes down"


def test_sigmas_on_a_slope_are_what_shifts_do(scene, relief, tmp_path):
    waves, dem = relief
    rows, moved = "60,900\n320,2500\n", "60,900.5\n320,2500.5\n"
    nothing = ["--position-sigma", "0", "0", "0", "--attitude-sigma", "0", "0", "0", "--pixel-sigma", "0"]
    first = on_terrain(scene, tmp_path, rows, *dem, *nothing, "--height-sigma", "1")
    waves.z = waves.z + np.float32(1.0)
    higher = on_terrain(scene, tmp_path, rows, "--dem", waves.write(tmp_path / "up.tif"), *dem[2:])
    east = np.radians(1) * 6.378e6 * np.cos(np.radians(first["lat_deg"]))
    for sigma, column, metres in (
        ("sigma_e_m", "lon_deg", east),
        ("sigma_n_m", "lat_deg", np.radians(1) * 6.37e6),
        ("sigma_u_m", "height_m", 1.0),
    ):
        np.testing.assert_allclose(first[sigma], np.abs(higher[column] - first[column]) * metres, rtol=0.02, atol=2e-4)
    assert np.abs(first["sigma_u_m"] - 1.0).max() > 0.005  # the ray slides along the slope
    sigmas = on_terrain(scene, tmp_path, rows, *dem, *nothing[:8], "--pixel-sigma", "1", "--height-sigma", "0")
    next_line = on_terrain(scene, tmp_path, moved, *dem)
    next_column = on_terrain(scene, tmp_path, "60.5,900\n320.5,2500\n", *dem)
    rise = 2 * np.hypot(next_line["height_m"] - first["height_m"], next_column["height_m"] - first["height_m"])
    np.testing.assert_allclose(sigmas["sigma_u_m"], rise, rtol=0.03, atol=2e-3)


def test_what_a_terrain_does_not_cover_is_told(scene, relief, tmp_path, capsys):
    waves, dem = relief
    half = Waves(waves.lat_deg, waves.lon_deg, waves.step_deg, waves.rows // 2, waves.columns)
    path = half.write(tmp_path / "half.tif")
    table = on_terrain(scene, tmp_path, "100,3999\n100,0\n700,2000\n", "--dem", path, *dem[2:])
    known = table["lon_deg"].notna()
    assert known.sum() == 1
    assert sorted(table["note"][~known]) == [
        "no height of half.tif where the ray comes down", "outside the image of 500 columns and 4000 rows",
    ]  # fmt: skip
    where = ["--pixels", str(pixels(tmp_path)), "-o", str(tmp_path / "o.csv")]
    assert main(["locate", str(scene), *where, *dem]) == 0
    assert f"{tmp_path / 'pixels.csv'}: height_m is not used: heights are those of dem.tif" in capsys.readouterr().out
    far = Waves(waves.lat_deg - 20, waves.lon_deg, waves.step_deg, 20, 20).write(tmp_path / "far.tif")
    for more, reason in (
        (dem[:2], "does not say what its heights are above"),
        (["--dem-datum", "ellipsoid"], "--dem-datum: goes with --dem"),
    ):
        assert main(["locate", str(scene), *where, *more]) == 1
        error = capsys.readouterr().err
        assert reason in error and error.count("\n") == 1, error
    assert main(["locate", str(scene), *where, "--dem", str(far), *dem[2:]]) == 0
    assert "3 of them miss; heights far.tif" in (told := capsys.readouterr().out)
    assert "note: far.tif: does not cover the pixels around " in told
    assert pd.read_csv(tmp_path / "o.csv")["note"].eq("no height of far.tif where the ray comes down").all()
    by_crs = on_terrain(scene, tmp_path, "100,700\n", *dem[:2], "--dem-crs", "ellipsoid")
    pd.testing.assert_frame_equal(by_crs, on_terrain(scene, tmp_path, "100,700\n", *dem))
    assert main(["locate", str(scene), "--pixels", str(tmp_path / "bare.csv"), "-o", str(tmp_path / "o.csv")]) == 1
    assert "height_m: column missing" in capsys.readouterr().err


# -- a frame camera ------------------------------------------------------------------------------------------------

FRAME = {
    "interior": {
        "focal_length_mm": 100.0, "pixel_size_mm": 0.01, "lines": 3000, "samples": 4000,
        "principal_point_mm": [0.12, -0.08], "distortion": {"k1": -1e-6},
    },
    "exterior": {"lat_deg": 47.0, "lon_deg": 11.0, "height_m": 2500.0, "omega_phi_kappa_deg": [4.0, -15.0, 33.0]},
    "sigma": {"position_m": [0.1, 0.2, 0.3], "attitude_deg": [0.01, 0.02, 0.03]},
}  # fmt: skip


def _turn(axis: int, angle: float) -> np.ndarray:
    i, j = (axis + 1) % 3, (axis + 2) % 3
    R = np.eye(3)
    R[[i, i, j, j], [i, j, i, j]] = np.cos(angle), -np.sin(angle), np.sin(angle), np.cos(angle)
    return R


def _in_image(lon_deg, lat_deg, height_m, moved_m=(0.0, 0.0, 0.0), turned_rad=(0.0, 0.0, 0.0)) -> np.ndarray:
    """Column and row of a ground point in `FRAME`, by the definitions of docs/rectification.md."""
    from pyproj import Transformer

    to_earth = Transformer.from_crs(4979, 4978, always_xy=True)
    inside, outside = FRAME["interior"], FRAME["exterior"]
    lon, lat = np.radians(outside["lon_deg"]), np.radians(outside["lat_deg"])
    east = np.array([-np.sin(lon), np.cos(lon), 0.0])
    up = np.array([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)])
    enu = np.column_stack([east, np.cross(up, east), up])
    R = np.eye(3)
    for axis, angle in enumerate(np.radians(outside["omega_phi_kappa_deg"])):
        R = R @ _turn(axis, angle)
    for axis, angle in enumerate(turned_rad):
        R = _turn(axis, angle) @ R
    C = np.array(to_earth.transform(outside["lon_deg"], outside["lat_deg"], outside["height_m"])) + enu @ moved_m
    d = (enu @ R).T @ (np.array(to_earth.transform(lon_deg, lat_deg, height_m)) - C)
    x, y = -inside["focal_length_mm"] * d[:2] / d[2]
    x, y = np.array([x, y]) * (1.0 + inside["distortion"]["k1"] * (x * x + y * y)) + inside["principal_point_mm"]
    return np.array([1999.5 + x / 0.01, 1499.5 - y / 0.01])


@pytest.fixture
def frame(tmp_path):
    path = tmp_path / "frame.json"
    path.write_text(json.dumps(FRAME))
    return path


def test_a_frame_camera_by_its_definition(frame, tmp_path, capsys):
    rows = "0,0,600\n3999,2999,500\n1999.5,1499.5,700\n-3,10,0\n"
    more = ["--pixel-sigma", "0.3", "--height-sigma", "0.5"]
    table = located(frame, tmp_path, ["--pixels", pixels(tmp_path, rows)], *more)
    assert table["note"].tolist()[3] == "outside the image of 4000 columns and 3000 rows"
    for _, row in table[:3].iterrows():
        at = row[["lon_deg", "lat_deg", "height_m"]].to_numpy(float)
        assert _in_image(*at) == pytest.approx(row[["column", "row"]].to_numpy(float), abs=1e-4)
        # sigmas by differences of the definition
        step = 1e-7
        metres = np.radians(1.0) * np.array([6388182.0 * np.cos(np.radians(at[1])), 6369510.0])
        by = [(_in_image(*(at + e)) - _in_image(*(at - e))) / (2 * step) for e in np.eye(3)[:2] * step]
        to_ground = metres[:, None] * np.linalg.inv(np.column_stack(by))
        half = np.array([0.0, 0.0, 0.5])  # of a metre, the sigma of the height
        errors = [np.diag([0.3, 0.3]), 0.5 * (_in_image(*(at + half)) - _in_image(*(at - half)))[:, None]]
        for name, steps, sigmas in (
            ("moved_m", 0.01, FRAME["sigma"]["position_m"]),
            ("turned_rad", 1e-5, np.radians(FRAME["sigma"]["attitude_deg"])),
        ):
            ways = [_in_image(*at, **{name: e}) - _in_image(*at, **{name: -e}) for e in np.eye(3) * steps]
            errors.append(np.column_stack(ways) * sigmas / (2 * steps))
        wanted = np.sqrt(np.square(to_ground @ np.hstack(errors)).sum(axis=1))
        assert row[["sigma_e_m", "sigma_n_m"]].to_numpy(float) == pytest.approx(wanted, rel=2e-3)
        assert row["sigma_u_m"] == pytest.approx(0.5, abs=1e-4)
    table[:3][["lon_deg", "lat_deg", "height_m"]].to_csv(tmp_path / "places.csv", index=False)
    back = located(frame, tmp_path, ["--ground", tmp_path / "places.csv"], *more)
    assert np.abs(back[["column", "row"]] - table[:3][["column", "row"]]).to_numpy().max() < 1e-4
    assert back["sigma_row"].between(1.0, 5.0).all() and back["sigma_column"].between(1.0, 5.0).all()
    where = ["--pixels", str(tmp_path / "pixels.csv"), "-o", str(tmp_path / "o.csv")]
    assert main(["locate", str(frame), *where, "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert (told["kind"], told["model"], told["missed"]) == ("frame", "rigorous", 1)
    assert main(["locate", str(frame), *where, "--ccd", "F"]) == 1
    assert "is of a frame camera, which has one model and no lines" in capsys.readouterr().err


@pytest.mark.parametrize("summit_m", [0.0, 1500.0])
def test_a_frame_camera_over_a_terrain_that_may_be_higher_than_it(frame, summit_m, tmp_path):
    valley = Waves(47.02, 10.98, 1e-4, 400, 500, low_m=550.0, high_m=650.0)
    valley.z[189, 300] += np.float32(summit_m + 500.0)  # beside what the pixels see, between their places
    table = on_terrain(
        frame,
        tmp_path,
        "0,0\n3999,2999\n1999.5,1499.5\n",
        "--dem",
        valley.write(tmp_path / "valley.tif"),
        "--dem-datum",
        "ellipsoid",
    )
    surface = valley.at(np.radians(table["lat_deg"]), np.radians(table["lon_deg"]))
    assert np.abs(table["height_m"] - surface).max() < 0.01
    for _, row in table.iterrows():
        found = _in_image(row["lon_deg"], row["lat_deg"], row["height_m"])
        assert found == pytest.approx(row[["column", "row"]].to_numpy(float), abs=0.02)


def test_ground_points_far_from_each_other_take_small_windows_of_the_heights(tmp_path, monkeypatch):
    """They took one that holds all of them: 2.3 GB of 11 000 x 11 000 values."""
    with rasterio.open(
        tmp_path / "fine.tif", "w", driver="GTiff", width=6000, height=6000, count=1, dtype="int16", crs="EPSG:32633",
        transform=rasterio.Affine(1.0, 0.0, 497_000.0, 0.0, -1.0, 4_983_000.0), tiled=True, sparse_ok=True,
    ) as target:  # fmt: skip
        target.write(np.full((1, 256, 256), 120, dtype=np.int16), window=rasterio.windows.Window(0, 0, 256, 256))
        target.write(np.full((1, 112, 112), 80, dtype=np.int16), window=rasterio.windows.Window(5888, 5888, 112, 112))
    raster, sizes = HeightRaster([tmp_path / "fine.tif"], None, "10"), []
    heights = raster.heights

    def watched(*window):
        sizes.append(window[2] * window[3])
        assert sizes[-1] < 6e6
        return heights(*window)

    monkeypatch.setattr(raster, "heights", watched)
    from pyproj import Transformer

    x, y = (
        np.array([497_010.0, 502_990.0, 500_000.0, 600_000.0]),
        np.array([4_982_990.0, 4_977_010.0, 4_980_000.0, 0.0]),
    )
    lon, lat = Transformer.from_crs("EPSG:32633", "EPSG:4326", always_xy=True).transform(x, y)
    got = raster.at(np.radians(lat), np.radians(lon))
    assert np.array_equal(got, [130.0, 90.0, 10.0, np.nan], equal_nan=True) and len(sizes) >= 3
