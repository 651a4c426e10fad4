"""`triline adjust` of a block of satellite scenes: what it writes, other models, bad input."""

from __future__ import annotations

import csv
import json
import re
import shutil
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from full_disk import files_of_at_most
from satellite_scenes import Truth, write_dimap1, write_dimap2, write_isd

from triline.nodes.batch.adjustment_summary import summary_lines
from triline.nodes.cli import main
from triline.nodes.errors import UserError
from triline.nodes.formats.satellite.read import read_scene
from triline.nodes.formats.satellite.rpc_files import write_rpb
from triline.nodes.formats.scene_block import read_scene_block, write_scene_block
from triline.solver.location.refraction import Refraction
from triline.solver.location.rpc_fit import fit_to_model
from triline.solver.scene_adjustment.block import ImagePoints, KnownGround, SceneBlock

#: Columns of places in tables of results: these scenes have longitude and latitude.
PLACE = ("X_deg", "Y_deg", "Z_m")


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Two lenses of SPOT-5 HRS, 40 points, some gross errors."""
    folder = tmp_path_factory.mktemp("scenes") / "pair"
    arguments = ["--satellite", "spot5-hrs", "--points", "40", "--control", "9", "--check", "15"]
    assert main(["simulate", "-q", "-o", str(folder), *arguments, "--outliers", "0.15", "--seed", "3"]) == 0
    return folder


@pytest.fixture
def block(made, tmp_path):
    return shutil.copytree(made, tmp_path / "pair")


def rows(path):
    with open(path, newline="") as file:
        return list(csv.DictReader(file))


def columns(path, *names):
    return np.array([[float(row[name]) for name in names] for row in rows(path)])


def test_result_and_tables(block, tmp_path, capsys):
    out = tmp_path / "result"
    assert main(["adjust", str(block), "--snoop", "-o", str(out), "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result == json.loads((out / "result.json").read_text())
    assert set(result["strips"]) == {"scene/F", "scene/B"}
    for strip in result["strips"].values():
        assert all(len(strip[key]) == 3 for key in ("offset_m", "shift_deg", "drift_deg", "drift_deg_sigma"))
    assert result["converged"] and result["chi_square_test"]["passed"] and result["rejected"]
    check, direct = result["check"], result["direct_georeferencing"]
    assert check["n"] == 15 and direct["n"] == 15
    assert np.linalg.norm(direct["rmse_m"]) > 10 * np.linalg.norm(check["rmse_m"])
    assert np.all(np.array(check["rmse_m"]) < 2.0 * np.array(check["sigma_m"]))
    # points against the truth, in their sigmas
    points = {row["point"]: row for row in rows(out / "points.csv")}
    truth = {row["point"]: row for row in rows(block / "truth.csv")}
    assert set(points) == set(truth)
    scale = np.array([111_000.0 * np.cos(np.radians(36.0)), 111_000.0, 1.0])
    off = [
        np.array([(float(p[k]) - float(truth[id][f"{k[0]}_m"])) for k in PLACE])
        * scale
        / np.array([float(p[f"sigma_{axis}_m"]) for axis in "XYZ"])
        for id, p in points.items()
        if p["role"] == "tie" and p["rays"] == "2"
    ]
    assert np.sqrt(np.mean(np.square(off))) < 1.6
    residuals = rows(out / "residuals.csv")
    assert sum(int(row["rejected"]) for row in residuals) == len(result["rejected"])
    assert {row["ccd"] for row in residuals} == {"F", "B"}


def test_expected_rmse_of_check_points_and_control_holds_the_survey(tmp_path, capsys):
    """Errors of a poor survey looked like those of the adjustment, whose sigmas alone stood beside them."""
    check, control = [], []
    for seed in range(4):
        block = tmp_path / f"pair{seed}"
        arguments = ["--satellite", "spot5-hrs", "--points", "60", "--control", "9", "--check", "30"]
        assert main(["simulate", "-q", "-o", str(block), *arguments, "--seed", str(seed)]) == 0
        points = pd.read_csv(block / "ground_points.csv")
        given = points["role"] == "check"
        rng = np.random.default_rng(100 + seed)
        east = 111_320.0 * np.cos(np.radians(36.0))
        for axis, metres in zip("XYZ", (east, 111_000.0, 1.0), strict=True):
            points.loc[given, f"{axis}_m"] += rng.normal(0.0, 6.0, np.count_nonzero(given)) / metres
            points[f"sigma_{axis}_m"] = points[f"sigma_{axis}_m"].astype(float)
            points.loc[given, f"sigma_{axis}_m"] = 6.0
        points.to_csv(block / "ground_points.csv", index=False)
        assert main(["adjust", str(block), "-o", str(tmp_path / "out")]) == 0
        assert "RMSE to be expected" in capsys.readouterr().out
        result = json.loads((tmp_path / "out" / "result.json").read_text())
        np.testing.assert_allclose(result["check"]["expected_m"], np.hypot(result["check"]["sigma_m"], 6.0), rtol=1e-6)
        check.append(np.divide(result["check"]["rmse_m"], result["check"]["expected_m"]))
        control.append(np.divide(result["control"]["rmse_m"], result["control"]["expected_m"]))
        assert np.mean(np.divide(result["check"]["rmse_m"], result["check"]["sigma_m"])) > 1.8
    assert 0.9 < np.sqrt(np.mean(np.square(check))) < 1.1
    assert 0.7 < np.sqrt(np.mean(np.square(control))) < 1.3


def test_check_points_of_a_scene_alone_are_compared_at_their_heights(tmp_path, capsys):
    """They were left out as not determined; beside the written polynomials, and one pixel that is off is named."""
    folder, out = tmp_path / "one", tmp_path / "result"
    arguments = ["--satellite", "spot5-hrs", "--points", "24", "--control", "9", "--check", "15", "--seed", "2"]
    assert main(["simulate", "-q", "-o", str(folder), *arguments]) == 0
    image = pd.read_csv(folder / "image_points.csv")
    image = image[image.ccd == "F"]
    image.loc[image.point == "P12", "sample"] += 6.0
    image.to_csv(folder / "image_points.csv", index=False)
    capsys.readouterr()
    assert main(["adjust", str(folder), "-o", str(out)]) == 0
    printed = capsys.readouterr().out
    result = json.loads((out / "result.json").read_text())
    single = result["check_single"]
    assert result["check"]["n"] == 0 and single["n"] == 15 and single["rmse_m"][2] is None
    assert re.search(r"check points of one ray +15 ", printed) and " px to be expected" in printed
    assert any(re.match(r"1 pixels of check points .*: P12 sample \(\+\d", note) for note in result["notes"])
    assert not any("P12" in note or "P13" in note for note in result["notes"] if "not determined" in note)
    assert result["direct_georeferencing"]["against"] == "check_single"
    assert result["direct_georeferencing"]["rmse_m"][0] > 3.0 * single["rmse_m"][0]
    ground = pd.read_csv(folder / "ground_points.csv").set_index("point")
    check = image[image.point.isin(ground.index[ground.role == "check"])]
    given = ground.loc[check.point]
    rpc = read_scene(out / "rpc" / "scene_F.RPB").rpc
    lat, lon, _ = rpc.direct(check.line.to_numpy(), check["sample"].to_numpy(), given.Z_m.to_numpy()).T
    metres = 6_378_137.0 * np.cos(np.radians(36.0)), 6_358_000.0
    off = [np.radians(given.X_m.to_numpy()), np.radians(given.Y_m.to_numpy())]
    for k, found in enumerate((lon, lat)):
        difference = (found - off[k]) * metres[k]
        np.testing.assert_allclose(np.sqrt(np.mean(difference**2)), single["rmse_m"][k], rtol=0.02)
    table = pd.read_csv(out / "residuals.csv").set_index("point").loc[check.point]
    pixel = rpc.inverse(*np.radians([given.Y_m.to_numpy(), given.X_m.to_numpy()]), given.Z_m.to_numpy())
    v = table[["v_line_px", "v_sample_px"]].to_numpy()
    np.testing.assert_allclose(check[["line", "sample"]].to_numpy() - pixel, v, atol=5e-3)
    np.testing.assert_allclose(single["rmse_px"], np.sqrt(np.mean(v**2, axis=0)), rtol=1e-4)
    assert abs(table.w_sample["P12"]) > 10.0 and np.abs(table.drop("P12")[["w_line", "w_sample"]]).max().max() < 4.0


def test_few_control_points_do_not_scale_the_sigmas(block, capsys):
    """A shift of polynomials by two control points: sigma0 of two observations too many was anything from 0.2 to 2,
    and good pixels of check points were named as wrong."""
    rpc = fit_to_model(read_scene(block / "spot5-hrs").sensors["F"], -500.0, 2500.0).rpc
    write_rpb(block / "F.RPB", rpc)
    head = (block / "project.toml").read_text().split("[scenes")[0]
    (block / "project.toml").write_text(head + '[rpc]\ncorrection = "shift"\n[scenes.forward]\nmetadata = "F.RPB"\n')
    ground = pd.read_csv(block / "ground_points.csv")
    ground["role"] = ["control"] * 2 + ["check"] * (len(ground) - 2)
    ground[["sigma_X_m", "sigma_Y_m", "sigma_Z_m"]] = [[0.1] * 3] * 2 + [[0.0] * 3] * (len(ground) - 2)
    ground.to_csv(block / "ground_points.csv", index=False)
    pixel = rpc.inverse(*np.radians([ground.Y_m, ground.X_m]), ground.Z_m.to_numpy())
    sigma0, squares, named = [], [], 0
    for seed in range(6):
        noise = np.random.default_rng(seed).normal(0.0, 0.3, pixel.shape)
        measured = pd.DataFrame(pixel + np.array([12.0, -7.0]) + noise, columns=["line", "sample"])
        table = pd.concat([ground[["point"]].assign(strip="forward", ccd=""), measured], axis=1)
        table.assign(sigma_px=0.3).to_csv(block / "image_points.csv", index=False)
        assert main(["adjust", str(block), "--json"]) == 0
        result = json.loads(capsys.readouterr().out)
        assert any("too little for sigma0" in note for note in result["notes"])
        named += sum(int(note.split()[0]) for note in result["notes"] if "pixels of check points" in note)
        coefficient = result["strips"]["forward"]["coefficients"]["sample shift"]
        np.testing.assert_allclose(coefficient["sigma"], 0.3 / np.sqrt(2.0), rtol=0.05)
        sigma0.append(result["sigma0"])
        squares.append(np.square(np.divide(result["check_single"]["rmse_px"], result["check_single"]["expected_px"])))
    assert min(sigma0) < 0.6 and named <= 3
    assert 0.5 < np.mean(squares) < 1.6


def test_what_is_known_of_the_orbit_counts_once_in_two_models(block, capsys):
    """A second model finds next to nothing beside its a-priori sigmas; those stated for it alone are knowledge."""
    found = []
    for options, then in (
        (("--model", "dgr"), ""),
        (("--model", "dgr", "--then", "dgr"), ""),
        (("--model", "dgr", "--then", "dgr"), "[trajectory.then]\noffset_sigma_m = [3, 3, 3]\n"),
    ):
        with open(block / "project.toml", "a") as file:
            file.write(then)
        assert main(["adjust", str(block), "--snoop", *options, "--json"]) == 0
        found.append(json.loads(capsys.readouterr().out))
    one, two, stated = found
    assert one["n_unknowns"] == two["n_unknowns"] == stated["n_unknowns"]
    assert two["redundancy"] < stated["redundancy"] - 5
    assert two["sigma0"] == pytest.approx(one["sigma0"], rel=0.06)
    assert stated["sigma0"] < 0.96 * one["sigma0"]


def test_control_that_no_image_measures_is_not_in_the_accuracy_of_control(block, capsys):
    found = []
    for more in (False, True):
        if more:
            given = rows(block / "ground_points.csv")
            control = [row for row in given if row["role"] == "control"]
            with open(block / "ground_points.csv", "a", newline="") as file:
                writer = csv.DictWriter(file, given[0])
                writer.writerows({**row, "point": f"U{i}"} for i, row in enumerate(control))
        assert main(["adjust", str(block), "--snoop", "--json"]) == 0
        found.append(json.loads(capsys.readouterr().out)["control"])
    one, two = found
    assert one["n"] == two["n"] == 9
    np.testing.assert_allclose(two["rmse_m"], one["rmse_m"], rtol=1e-6)


def test_times_that_metadata_state_to_be_uncertain_count_as_an_offset_along_the_track(block, tmp_path):
    """They counted nowhere: 5 ms are 34 m along the track, and points without control had sigmas of 1 to 3 m."""
    late, rng = 5e-3, np.random.default_rng(1)
    scene = block / "spot5-hrs"
    sensors, truth = read_scene(scene).sensors, pd.read_csv(block / "truth.csv", index_col="point")
    points = pd.read_csv(block / "image_points.csv")
    for ccd, of_line in points.groupby("ccd"):
        place = truth.loc[of_line["point"]]
        pixel = sensors[ccd].inverse(np.radians(place["Y_m"]), np.radians(place["X_m"]), place["Z_m"])
        points.loc[of_line.index, ["line", "sample"]] = pixel + rng.normal(0.0, 0.3, pixel.shape)
    points.to_csv(block / "image_points.csv", index=False)
    (block / "ground_points.csv").unlink()
    # the lenses are off by a sigma each, against each other
    times = pd.read_csv(scene / "line_times.csv")
    off = {"F": np.timedelta64(round(late * 1e9), "ns"), "B": np.timedelta64(-round(late * 1e9), "ns")}
    stamps = zip(times["ccd"], times["time_utc"], strict=True)
    times["time_utc"] = [f"{np.datetime64(stamp.rstrip('Z'), 'ns') + off[ccd]}Z" for ccd, stamp in stamps]
    times.to_csv(scene / "line_times.csv", index=False)
    with open(scene / "scene.toml", "a") as file:
        file.write(f"\n[sigma]\nposition_m = [1, 2, 0]\nattitude_deg = [1e-5, 1e-5, 0]\ntime_s = {late}\n")
    settings = read_scene_block(block).trajectory_settings()
    # the ground passes at 6.7 km/s below an orbit of 830 km; at 36 degrees of latitude it turns by 370 m/s across
    np.testing.assert_allclose(settings["offset_sigma_m"], [33.5, np.hypot(2.0, 370.0 * late), 5.0], rtol=0.05)
    np.testing.assert_allclose(settings["shift_sigma_deg"], [1e-5, 1e-5, 0.01])  # what is not stated is as usual
    assert main(["adjust", str(block), "-o", str(tmp_path / "out")]) == 0
    found = pd.read_csv(tmp_path / "out" / "points.csv", index_col="point")
    up = found["Z_m"] - truth.loc[found.index, "Z_m"]
    assert np.abs(up).median() > 60.0
    sigma0 = json.loads((tmp_path / "out" / "result.json").read_text())["sigma0"]  # which sigmas are times
    ratio = sigma0 * np.abs(up / found["sigma_Z_m"])[found["rays"] == 2].median()
    assert 1.2 < ratio < 1.5  # of two equal and opposite errors: the root of 2


def test_scenes_have_the_sigmas_of_their_own_metadata(made, tmp_path, capsys):
    """All had the largest of any scene; where one stated none, all had the usual ones, however large those stated."""
    block = tmp_path / "two"
    block.mkdir()
    points = pd.read_csv(made / "image_points.csv").assign(strip=lambda t: t["ccd"].map({"F": "fore", "B": "aft"}))
    points.drop(columns="ccd").to_csv(block / "image_points.csv", index=False)
    for scene, ccd in (("fore", "F"), ("aft", "B")):
        shutil.copytree(made / "spot5-hrs", block / scene)
        times = pd.read_csv(block / scene / "line_times.csv")
        times[times["ccd"] == ccd].to_csv(block / scene / "line_times.csv", index=False)
    with open(block / "aft" / "scene.toml", "a") as file:
        file.write("\n[sigma]\nposition_m = [30, 40, 50]\nattitude_deg = [0.05, 0.05, 0.05]\n")
    project = "".join(f"[scenes.{scene}]\nmetadata = {scene!r}\n" for scene in ("fore", "aft"))
    (block / "project.toml").write_text(project)
    assert main(["adjust", str(block), "--json", "--snoop"]) == 0
    strips = json.loads(capsys.readouterr().out)["strips"]
    sigma = {scene: strips[scene]["offset_m_sigma"] for scene in strips}
    assert max(sigma["fore"]) < 10.0 < 15.0 < min(sigma["aft"]), sigma
    data = read_scene_block(block)
    fore, aft = (data.trajectory_settings([image]) for image in data.images)
    assert fore["offset_sigma_m"] == [5.0, 5.0, 5.0] and fore["shift_sigma_deg"] == [0.01, 0.01, 0.01]
    assert aft["offset_sigma_m"] == [30.0, 40.0, 50.0]
    np.testing.assert_allclose(aft["shift_sigma_deg"], 0.05)
    np.testing.assert_allclose(data.trajectory_settings()["offset_sigma_m"], [30.0, 40.0, 50.0])


def test_known_points_whose_names_have_other_capitals_in_the_images_are_told(block):
    image = pd.read_csv(block / "image_points.csv")
    assert "names differ" not in "\n".join(read_scene_block(block).notes)
    image.assign(point=image["point"].str.lower()).to_csv(block / "image_points.csv", index=False)
    assert "names differ by capitals or zeros alone" in "\n".join(read_scene_block(block).notes)


def test_control_that_lost_its_image_points_is_named(block, capsys):
    """A latitude mistyped by a degree: of two rays nothing tells who is wrong, and the point stands as it was given.

    The adjustment ended with "time -5.024848 s lies outside the attitude [-5.024848, 106.975152] s".
    """
    known = pd.read_csv(block / "ground_points.csv")
    wrong = known.loc[known["role"] == "control", "point"].iloc[0]
    known.loc[known["point"] == wrong, "Y_m"] += 3.0
    known.to_csv(block / "ground_points.csv", index=False)
    assert main(["adjust", str(block), "--snoop", "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert 0.8 < result["sigma0"] < 1.2 and result["control"]["n"] == 8
    assert any(f"lost all its image points and stands as given: {wrong};" in note for note in result["notes"])


def test_a_test_of_nothing_has_not_passed(block, capsys):
    """Of a block whose rays had all gone: "chi-square 95 %: 0.000 to -, passed"."""
    assert main(["adjust", str(block), "--json"]) == 0
    content = json.loads(capsys.readouterr().out)
    content |= {"redundancy": 0, "sigma0": 1.0, "chi_square_test": {"low": 0.0, "high": None, "passed": None}}
    head = list(summary_lines(content))[2]
    assert "passed" not in head and "(taken, not found: nothing is redundant, and nothing tested)" in head


def swapped(path, which):
    """Longitude and latitude exchanged in rows of ground_points.csv."""
    known = pd.read_csv(path)
    known.loc[which, ["X_m", "Y_m"]] = known.loc[which, ["Y_m", "X_m"]].to_numpy()
    known.to_csv(path, index=False)


@pytest.mark.parametrize("command", ["adjust", "import", "study"])
def test_longitudes_and_latitudes_that_are_swapped_are_refused(command, tmp_path, capsys):
    """All of them, with --snoop: sigma0 1, passed and converged, no control left, check points 4 700 km off."""
    block, out = tmp_path / "pair", str(tmp_path / "out.mcap")
    place = ["--satellite", "spot5-hrs-small", "--place", "44", "5", "--points", "40", "--control", "9"]
    assert main(["simulate", "-q", "-o", str(block), *place]) == 0
    swapped(block / "ground_points.csv", slice(None))
    more = {"adjust": [str(block), "--snoop"], "import": [str(block), "-o", out], "study": ["control", str(block)]}
    assert main([command, *more[command]]) == 1
    error = capsys.readouterr().err
    assert re.search(r"ground_points.csv: \d\d known points lie 5[56]\d\d km \(median\) from where their pixels", error)
    assert "wanted longitude first (X), then latitude (Y), and the metadata of these" in error


def test_metadata_of_another_scene_are_refused_unless_they_are_said_to_be_that_bad(tmp_path, capsys):
    for name, lat in (("pair", "44"), ("other", "44.4")):
        place = ["--satellite", "spot5-hrs-small", "--place", lat, "5", "--points", "40", "--control", "9"]
        assert main(["simulate", "-q", "-o", str(tmp_path / name), *place]) == 0
    metadata = tmp_path / "pair" / "spot5-hrs-small"
    shutil.rmtree(metadata)
    shutil.copytree(tmp_path / "other" / "spot5-hrs-small", metadata)
    assert main(["adjust", str(tmp_path / "pair"), "--snoop"]) == 1
    assert re.search(r"34 known points lie 4\d km \(median\) from where", capsys.readouterr().err)
    with open(tmp_path / "pair" / "project.toml", "a") as file:
        file.write("[trajectory]\noffset_sigma_m = [20000, 20000, 20000]\n")
    assert main(["adjust", str(tmp_path / "pair"), "--snoop", "-q"]) == 0


def test_an_image_that_its_points_show_upside_down_is_told(made, tmp_path, capsys):
    """Lines counted from below: the affine correction of its polynomials mirrored the image, and no word said so."""
    block = tmp_path / "rpc"
    block.mkdir()
    sensor = read_scene(made / "spot5-hrs").sensors["F"]
    write_rpb(block / "F.RPB", fit_to_model(sensor, -500.0, 2500.0).rpc)
    scenes = f'[scenes.F]\nmetadata = "F.RPB"\n[scenes.B]\nmetadata = "{made}/spot5-hrs"\n'
    (block / "project.toml").write_text(f'[project]\ncrs = "EPSG:4979"\n{scenes}')
    shutil.copy(made / "ground_points.csv", block)
    image = pd.read_csv(made / "image_points.csv")
    image = image.assign(strip=image["ccd"], ccd=image["ccd"].where(image["ccd"] == "B", ""))
    told = "note: image F: its correction turns or stretches it by 200 % of its size"
    for turned in (False, True):
        if turned:
            image["line"] = image["line"].where(image["strip"] == "B", sensor.lines - 1 - image["line"])
        image.to_csv(block / "image_points.csv", index=False)
        assert main(["adjust", str(block), "-q"]) == 0
        assert (told in capsys.readouterr().out) == turned
        # of the two rays of each control point snooping leaves out one: heights are off by 40 km, and sigma0 is 1
        assert main(["adjust", str(block), "-q", "--snoop"]) == 0
        assert ("note: image F: all its 9 pixels of control are left out" in capsys.readouterr().out) == turned


def test_one_swapped_control_point_of_polynomials_is_refused(made, tmp_path, capsys):
    """One of nine: nothing was left of the block but one point, "sigma0 1.0000, passed, NOT CONVERGED"."""
    block = tmp_path / "rpc"
    block.mkdir()
    entries = []
    for ccd in "FB":
        write_rpb(block / f"{ccd}.RPB", fit_to_model(read_scene(made / "spot5-hrs").sensors[ccd], -500.0, 2500.0).rpc)
        entries.append(f'[scenes.{ccd}]\nmetadata = "{ccd}.RPB"\n')
    (block / "project.toml").write_text('[project]\ncrs = "EPSG:4979"\n' + "".join(entries))
    shutil.copy(made / "ground_points.csv", block)
    image = pd.read_csv(made / "image_points.csv")
    image.assign(strip=image["ccd"], ccd="").to_csv(block / "image_points.csv", index=False)
    assert main(["adjust", str(block), "--snoop", "-q"]) == 0
    printed = capsys.readouterr().out.splitlines()
    assert printed[0] == "rpc: RPC, corrections in the images"  # "DGR, no self-calibration"
    assert "image F, RPC; px, along lines and samples from the middle of the image to its edge" in printed
    assert re.fullmatch(r"  line shift +-?\d+\.\d{4} \+- \d+\.\d{4}", next(x for x in printed if "line shift" in x))
    assert any(re.fullmatch(r"  point P\d+, strip [FB]: w .*", line) for line in printed)  # "strip F, : w"
    known = pd.read_csv(block / "ground_points.csv")
    known.loc[2, ["X_m", "Y_m"]] = [36.14, 39.6]  # as 139.6, 36.14 may be mistyped
    known.to_csv(block / "ground_points.csv", index=False)
    capsys.readouterr()
    assert main(["adjust", str(block), "--snoop"]) == 1
    assert re.search(r"ground_points.csv: point P2 lies 79\d{2} km from where its pixels lie", capsys.readouterr().err)


def test_known_points_are_refused_by_what_is_known_of_each_image(made, tmp_path):
    """Polynomials of coarse pixels, or of a large shift, are off by more than 10 km; so are oblique views."""
    block = tmp_path / "rpc"
    block.mkdir()
    write_rpb(block / "F.RPB", fit_to_model(read_scene(made / "spot5-hrs").sensors["F"], -500.0, 2500.0).rpc)
    project = '[project]\ncrs = "EPSG:4979"\n[scenes.F]\nmetadata = "F.RPB"\n'
    (block / "project.toml").write_text(project)
    image = pd.read_csv(made / "image_points.csv")
    image[image["ccd"] == "F"].assign(strip="F", ccd="").to_csv(block / "image_points.csv", index=False)
    known = pd.read_csv(made / "ground_points.csv")
    known.assign(Y_m=known["Y_m"] + 0.2).to_csv(block / "ground_points.csv", index=False)
    with pytest.raises(UserError, match=r"known points lie 22 km \(median\) .* larger sigmas in project.toml"):
        read_scene_block(block)
    (block / "project.toml").write_text(project + "[rpc]\nshift_sigma_px = 1000\n")
    read_scene_block(block)
    (block / "project.toml").write_text(project)
    known["sigma_Y_m"] = 8000.0  # of a small map
    known.assign(Y_m=known["Y_m"] + 0.2).to_csv(block / "ground_points.csv", index=False)
    read_scene_block(block)


def test_an_attitude_counts_by_what_it_does_on_the_ground(tmp_path):
    """70 deg off the way down a degree is 10 times as much as from above; it was taken as from 800 km above."""
    block = tmp_path / "oblique"
    assert main(["simulate", "-q", "-o", str(block), "--satellite", "misr", "--control", "9"]) == 0
    known, image = pd.read_csv(block / "ground_points.csv"), pd.read_csv(block / "image_points.csv")
    oblique = image[image["ccd"].isin(["Df", "Da"])]
    oblique.to_csv(block / "image_points.csv", index=False)
    known.assign(Y_m=known["Y_m"] + 0.5).to_csv(block / "ground_points.csv", index=False)
    with open(block / "project.toml", "a") as file:
        file.write("[trajectory]\nshift_sigma_deg = [0.5, 0.5, 0.5]\n")
    read_scene_block(block)


@pytest.mark.parametrize(
    ("off_deg", "all_of_it", "told"),
    [
        (1.0, False, r"control point {} lies 11\d{{4}} m from where its rays meet"),
        (-5.0, True, r"control lies 5\d{{5}} m from where its rays meet \(median\): check its coordinate reference"),
    ],
)
def test_a_block_that_does_not_converge_names_control_that_lies_elsewhere(
    off_deg, all_of_it, told, block, tmp_path, capsys
):
    """It was a result: polynomials that look kilometres beside, and a note that it has not converged."""
    known = pd.read_csv(block / "ground_points.csv")
    control = known["role"] == "control"
    wrong = known.loc[control, "point"].iloc[1]
    known.loc[control if all_of_it else known["point"] == wrong, "Y_m"] += off_deg
    known.to_csv(block / "ground_points.csv", index=False)
    assert main(["adjust", str(block), "-o", str(tmp_path / "out")]) == 1
    error = capsys.readouterr().err
    assert re.search(r"does not converge \(sigma0 .*\); " + told.format(wrong), error), error
    assert not (tmp_path / "out" / "rpc").exists()


def test_control_by_names_that_no_image_point_has_is_told(block, capsys):
    """Of control that images name otherwise nothing was said, not even where the block stands on its orbits alone."""
    known = pd.read_csv(block / "ground_points.csv")
    control = np.flatnonzero(known["role"] == "control")
    for some, told in (
        (control[:2], "2 of 9 control points are measured in no image"),
        (
            control[2:],
            "no control point of 9 is measured in an image: where the block lies comes from the a-priori sigmas",
        ),
    ):
        known.loc[some, "point"] = "G" + known.loc[some, "point"]
        known.to_csv(block / "ground_points.csv", index=False)
        assert main(["adjust", str(block), "--snoop", "--json"]) == 0
        assert any(note.startswith(told) for note in json.loads(capsys.readouterr().out)["notes"])


def test_control_that_does_not_fit_is_named_without_snooping_too(block, capsys):
    """A block with control 100 m off had a sigma0 that fails, and nothing said where to look."""
    known = pd.read_csv(block / "ground_points.csv")
    wrong = np.flatnonzero(known["role"] == "control")[3]
    known.loc[wrong, "Y_m"] += 0.001
    known.to_csv(block / "ground_points.csv", index=False)
    notes = {}
    for snoop in ((), ("--snoop",)):
        assert main(["adjust", str(block), "--json", *snoop]) == 0
        notes[snoop] = [note for note in json.loads(capsys.readouterr().out)["notes"] if "control coord" in note]
    (said,) = notes[()]
    worst = re.match(r"\d+ control coordinates have \|w\| > 3.29: (\w+) Y \(-", said)
    assert worst and worst[1] == known["point"][wrong], said  # adjusted minus given, which is too far north
    assert not notes["--snoop",]  # it is left out


def test_iterations_are_of_every_adjustment_and_the_result_counts_them_all(block, capsys):
    """Data snooping took up to 20 steps in each round, whatever was asked for, and the result had those of the last."""

    def adjusted(*options):
        assert main(["adjust", str(block), "--json", *options]) == 0
        return json.loads(capsys.readouterr().out)

    alone, snooped = adjusted(), adjusted("--snoop")
    assert snooped["rejected"] and snooped["iterations"] > alone["iterations"] > 1
    one = adjusted("--snoop", "--iterations", "1")
    assert one["iterations"] < snooped["iterations"] and not one["converged"]
    assert f"not converged after {one['iterations']} iterations" in one["notes"]
    both = adjusted("--model", "dgr", "--then", "dgr", "--iterations", "1")
    assert both["iterations"] == 2
    assert "the first of two steps has not converged after 1 iterations" in both["notes"]


def test_images_whose_names_differ_by_a_slash_alone_have_polynomials_of_their_own(block, tmp_path, capsys):
    """The second of a_b/F and a/b/F was written over the first."""
    project, image_points = block / "project.toml", block / "image_points.csv"
    head = project.read_text().split("[scenes")[0]
    scenes = [f'[scenes."{name}"]\nmetadata = "spot5-hrs"\n' for name in ("a_b", "a/b")]
    project.write_text(head + "".join(scenes))
    text = image_points.read_text()
    first, second = text.replace(",scene,", ",a_b,"), text.replace(",scene,", ",a/b,").partition("\n")[2]
    image_points.write_text(first + second)
    out = tmp_path / "result"
    assert main(["adjust", str(block), "-o", str(out), "--json"]) == 0
    assert [path.name for path in sorted((out / "rpc").iterdir())] == [
        "a_b_B.RPB",
        "a_b_B_2.RPB",
        "a_b_F.RPB",
        "a_b_F_2.RPB",
    ]
    told = [note for note in json.loads(capsys.readouterr().out)["notes"] if "RPC is" in note]
    assert told == [f"image a/b/{ccd}: its RPC is a_b_{ccd}_2.RPB, beside that of image a_b/{ccd}" for ccd in "FB"]


def test_a_full_disk_leaves_the_result_of_the_earlier_run(block, tmp_path, capsys):
    out, table = tmp_path / "result", tmp_path / "result" / "residuals.csv"
    assert main(["adjust", str(block), "-q", "-o", str(out)]) == 0
    old = {path.relative_to(out): path.read_bytes() for path in out.rglob("*.*")}
    assert "scene_F.RPB" in {path.name for path in old}
    capsys.readouterr()
    with files_of_at_most(table.stat().st_size - 1):
        assert main(["adjust", str(block), "-q", "-o", str(out)]) == 1
    assert capsys.readouterr().err == f"triline adjust: {table}: cannot be written: file too large\n"
    assert {path.relative_to(out): path.read_bytes() for path in out.rglob("*.*")} == old


def test_refined_orientation_and_rpc_locate_the_adjusted_points(block, tmp_path):
    out = tmp_path / "result"
    assert main(["adjust", str(block), "--snoop", "-q", "-o", str(out)]) == 0
    poses = rows(out / "trajectory_refined.csv")
    assert poses[0]["ccd"] == "F" and poses[-1]["line"] == "11999" and poses[0]["time_utc"].startswith("2006-06-17T")
    radius = np.linalg.norm(columns(out / "trajectory_refined.csv", "X_m", "Y_m", "Z_m"), axis=1)
    np.testing.assert_allclose(radius, 6_378_137.0 + 832_000.0, atol=100.0)
    sigma = columns(out / "trajectory_refined.csv", "sigma_along_m", "sigma_roll_deg")
    assert (sigma > 0).all() and (sigma[:, 0] < 6.0).all()
    # to the nanosecond, as the metadata have the times: a millisecond is 7 m of the orbit
    time = {(row["ccd"], row["line"]): row["time_utc"] for row in rows(block / "spot5-hrs" / "line_times.csv")}
    refined = {(row["ccd"], row["line"]): row["time_utc"] for row in poses}
    assert {key: refined[key] for key in time} == time
    # the polynomials take the adjusted points to their pixels
    points = {row["point"]: row for row in rows(out / "points.csv")}
    for ccd in "FB":
        rpc = read_scene(out / "rpc" / f"scene_{ccd}.RPB").rpc
        mine = [r for r in rows(out / "residuals.csv") if r["ccd"] == ccd and points[r["point"]]["X_deg"]]
        lon, lat, h = np.array([[float(points[r["point"]][k]) for k in PLACE] for r in mine]).T
        pixel = rpc.inverse(np.radians(lat), np.radians(lon), h)
        measured, v = (
            np.array([[float(r[k]) for k in keys] for r in mine])
            for keys in (("line", "sample"), ("v_line_px", "v_sample_px"))
        )
        np.testing.assert_allclose(pixel, measured - v, atol=5e-3)


@pytest.mark.parametrize(
    "options",
    [
        ["--model", "ppm", "--segments", "2"],
        ["--model", "dgr", "--then", "lim", "--fixes", "4"],
        ["--selfcal", "lens"],
        ["--sets", "scene", "--selfcal", "prism30", "--free"],
    ],
)
def test_models_and_sets(options, block, capsys):
    assert main(["adjust", str(block), "--snoop", *options]) == 0
    printed = capsys.readouterr().out
    assert ", converged, " in printed and float(printed.split("sigma0 ")[1].split()[0]) < 1.5
    if "--selfcal" in options:
        assert "additional parameters: " in printed and ("sy_F" in printed or "s_F" in printed)
    assert ("2 correction sets" in printed) == ("scene" not in options)


def test_the_second_step_has_settings_of_its_own(block, capsys):
    """What `[trajectory.then]` states is of the second model alone, and direct georeferencing of neither."""
    project = block / "project.toml"
    words = ["adjust", str(block), "--snoop", "--json", "--then", "lim", "--fixes", "4"]
    assert main(words) == 0
    free = json.loads(capsys.readouterr().out)
    project.write_text(project.read_text() + "[trajectory.then]\noffset_sigma_m = 0.001\nshift_sigma_deg = 1e-9\n")
    assert main(words) == 0
    held = json.loads(capsys.readouterr().out)
    assert held["then"] == "lim" and held["before"] == free["before"] and held["before"][0]["model"] == "dgr"
    for strip in free["strips"]:
        fixes = [
            np.array([[fix["offset_m"], fix["offset_m_sigma"]] for fix in run["strips"][strip]["fixes"]])
            for run in (free, held)
        ]
        assert np.abs(fixes[0]).max() > 0.1 and np.abs(fixes[1]).max() < 0.002
    assert main(words[:-4]) == 0
    alone = json.loads(capsys.readouterr().out)
    assert any("[trajectory.then]" in note for note in alone["notes"]) and "before" not in alone
    for run in (free, held):
        assert not any("[trajectory.then]" in note for note in run["notes"])
        np.testing.assert_allclose(
            run["direct_georeferencing"]["rmse_m"], alone["direct_georeferencing"]["rmse_m"], rtol=1e-3
        )


def test_locate_says_which_line_of_detectors_it_takes(made, tmp_path, capsys):
    (tmp_path / "pixels.csv").write_text("column,row,height_m\n0,0,500\n")
    words = ["locate", str(made / "spot5-hrs"), "--pixels", str(tmp_path / "pixels.csv"), "-o"]
    texts = {}
    for ccd in ("", "F", "B"):
        out = tmp_path / f"{ccd}.csv"
        assert main([*words, str(out), *(["--ccd", ccd] if ccd else [])]) == 0
        said = "line of detectors F of F, B: --ccd takes another" in capsys.readouterr().out
        assert said == (not ccd)
        texts[ccd] = out.read_text()
    assert texts[""] == texts["F"] != texts["B"]


def test_rpc_and_dlt_beside_rigorous(block, capsys):
    scene = read_scene(block / "spot5-hrs")
    for ccd in "FB":
        write_rpb(block / f"{ccd}.RPB", fit_to_model(scene.sensors[ccd], -500.0, 2500.0).rpc)
    image_points = block / "image_points.csv"
    text = image_points.read_text()
    image_points.write_text(text.replace(",scene,F,", ",forward,,").replace(",scene,B,", ",backward,,"))
    project = block / "project.toml"
    head = project.read_text().split("[scenes")[0]
    project.write_text(
        head
        + '[rpc]\ncorrection = "affine"\nshift_sigma_px = 100\n'
        + '[scenes.forward]\nmetadata = "F.RPB"\nmodel = "dlt"\n[scenes.backward]\nmetadata = "B.RPB"\n'
    )
    out = block / "result"
    assert main(["adjust", str(block), "-o", str(out), "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["images"] == {"forward": "dlt", "backward": "rpc"}
    for name in result["images"]:  # an .RPB does not state it
        told = (
            f"image {name}: no RPC written: its metadata do not say how large it is; name the image itself as metadata"
        )
        for notes in (result["notes"], json.loads((out / "result.json").read_text())["notes"]):
            assert any(note.startswith(told) for note in notes)
    assert len(result["strips"]["forward"]["coefficients"]) == 11
    assert result["strips"]["backward"]["coefficients"]["line shift"]["sigma"] > 0
    assert not result["undetermined"] and result["converged"]
    assert main(["adjust", str(block)]) == 0
    printed = re.findall(r"denominator by .* \+- (\S+)", capsys.readouterr().out)
    sigmas = [c["sigma"] for name, c in result["strips"]["forward"]["coefficients"].items() if "denominator" in name]
    np.testing.assert_allclose([float(word) for word in printed], sigmas, rtol=0.01)  # all of them were 0.000


@pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
def test_an_image_with_its_polynomials_beside_it_has_adjusted_ones(block, tmp_path):
    rasterio = pytest.importorskip("rasterio")
    sensor = read_scene(block / "spot5-hrs").sensors["F"]
    write_rpb(block / "F.RPB", fit_to_model(sensor, -500.0, 2500.0).rpc)
    size = {"width": sensor.samples, "height": sensor.lines, "count": 1, "dtype": "uint8", "sparse_ok": True}
    rasterio.open(block / "F.tif", "w", driver="GTiff", **size).close()
    image_points = block / "image_points.csv"
    image_points.write_text(image_points.read_text().replace(",scene,F,", ",forward,,"))
    with open(block / "project.toml", "a") as file:
        file.write('[scenes.forward]\nmetadata = "F.tif"\n')
    assert main(["adjust", str(block), "--snoop", "-o", str(tmp_path / "out")]) == 0
    assert (tmp_path / "out" / "rpc" / "forward.RPB").exists()


def put(text, *changes):
    for old, new in changes:
        assert old in text
        text = text.replace(old, new, 1)
    return text


BAD = {
    "no scenes": ("project.toml", lambda t: t.split("[scenes")[0] + "[scenes]\n", r"scenes: none, wanted"),
    "metadata missing": ("project.toml", lambda t: put(t, ('metadata = "spot5-hrs"', "")), r"scenes.scene.metadata"),
    "no such metadata": ("project.toml", lambda t: put(t, ('"spot5-hrs"', '"HRS.XML"')), r"HRS.XML: no such file"),
    "unknown model": ("project.toml", lambda t: t + 'model = "magic"\n', r"model: .*wanted one of rigorous, rpc"),
    "no polynomials": ("project.toml", lambda t: t + 'model = "rpc"\n', r"has no rational polynomials"),
    "crs": ("project.toml", lambda t: put(t, ("EPSG:4979", "EPSG:99999999")), r"project.crs: PROJ does not know"),
    "sigma": ("project.toml", lambda t: t + "[trajectory]\noffset_sigma_m = [1, 2]\n", r"offset_sigma_m: .*wanted 3"),
    "third step": ("project.toml", lambda t: t + "[trajectory.then.then]\nfixes = 4\n", r"then: .*no third step"),
    "fixes of then": ("project.toml", lambda t: t + '[trajectory.then]\nfixes = "x"\n', r"then.fixes: 'x', wanted an"),
    "bad correction": ("project.toml", lambda t: t + '[rpc]\ncorrection = "cubic"\n', r"correction: .*affine or shift"),
    "role": ("ground_points.csv", lambda t: put(t, ("control", "anchor")), r"ground_points.csv:2: role: "),
    "sigma of control": ("ground_points.csv", lambda t: put(t, (",0.5,0.5,0.5,", ",0.5,,0.5,")), r"sigma_Y_m: missing"),
    "latitude": ("ground_points.csv", lambda t: put(t, (",35.", ",95.")), r"ground_points.csv:\d+: X_m: .* outside"),
    "number": ("image_points.csv", lambda t: put(t, ("P0,scene,F,", "P0,scene,F,x")), r"image_points.csv:2: line: "),
    "no usable row": ("image_points.csv", lambda t: t.replace(",scene,", ",other,"), r"no row that can be used"),
    "gap of the attitude": (
        "spot5-hrs/attitude.csv",
        lambda t: "\n".join(r for k, r in enumerate(t.splitlines()) if not 100 < k < 160) + "\n",
        r"attitude.csv: time: gap from",
    ),
    "no ephemeris": ("spot5-hrs/ephemeris.csv", None, r"ephemeris.csv: no such file"),
}  # fmt: skip


def test_images_taken_through_the_air(block, tmp_path, capsys):
    """Image points are moved by what the air does; with --refraction everything is as it was."""
    image, truth = rows(block / "image_points.csv"), {row["point"]: row for row in rows(block / "truth.csv")}
    sensors = read_scene(block / "spot5-hrs").sensors
    bent = block.with_name("bent")
    shutil.copytree(block, bent)
    for row in image:
        place = [float(truth[row["point"]][k]) for k in ("X_m", "Y_m", "Z_m")]
        at = np.radians(place[1]), np.radians(place[0]), place[2]
        sensor = sensors[row["ccd"]]
        moved = (sensor.with_refraction(Refraction()).inverse(*at) - sensor.inverse(*at))[0]
        assert 0.01 < np.linalg.norm(moved) < 1.0
        row["line"], row["sample"] = (
            repr(float(row[k]) + float(d)) for k, d in zip(("line", "sample"), moved, strict=True)
        )
    with open(bent / "image_points.csv", "w", newline="") as file:
        writer = csv.DictWriter(file, list(image[0]))
        writer.writeheader()
        writer.writerows(image)
    shifts, points = [], []
    for folder, words in ((block, ()), (bent, ("--refraction",)), (bent, ())):
        out = tmp_path / f"result{len(shifts)}"
        assert main(["adjust", str(folder), "-q", "--snoop", "-o", str(out), *words]) == 0
        result = json.loads((out / "result.json").read_text())
        assert ("refraction in the models of 2 images" in result["notes"]) == bool(words)
        shifts.append(np.array([result["strips"][f"scene/{ccd}"]["shift_deg"] for ccd in "FB"]))
        known = [[float(row[k] or "nan") for k in PLACE] for row in rows(out / "points.csv")]
        points.append(np.array(known) * [91e3, 111e3, 1.0])
    # a hundredth of the turn that the correction has to make for the air where nobody takes it off
    wrong = np.abs(shifts[2] - shifts[0]).max()
    assert wrong > 1e-5 and np.abs(shifts[1] - shifts[0]).max() < 0.01 * wrong
    np.testing.assert_allclose(points[1], points[0], atol=0.01)
    assert main(["adjust", str(block), "--refraction", "1", "2"]) == 1
    assert "--refraction: 2 values, wanted none, or temperature (K)" in capsys.readouterr().err


@pytest.mark.parametrize("name", BAD)
def test_bad_input_gets_one_line(name, block, capsys):
    file, change, match = BAD[name]
    path = block / file
    if change is None:
        path.unlink()
    else:
        path.write_text(change(path.read_text()))
    assert main(["adjust", str(block)]) == 1
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and error.startswith("triline adjust: ") and "fault in triline" not in error
    assert re.search(match, error), error


def test_rays_that_miss_the_earth(block, capsys):
    with open(block / "spot5-hrs" / "scene.toml", "a") as file:
        file.write("[mounting]\nboresight_deg = [0.0, 90.0, 0.0]\n")
    (block / "ground_points.csv").unlink()
    assert main(["adjust", str(block)]) == 1
    error = capsys.readouterr().err
    assert "no ray reaches the ground, and no point is known" in error and error.count("\n") == 1


def test_polynomials_with_a_zero_denominator(block, capsys):
    rpc = fit_to_model(read_scene(block / "spot5-hrs").sensors["F"], -500.0, 2500.0).rpc
    coefficients = rpc.to_image.coefficients.copy()
    coefficients[1, 1] = 5.0
    broken = replace(rpc, to_image=replace(rpc.to_image, coefficients=coefficients))
    write_rpb(block / "F.RPB", broken)
    project = block / "project.toml"
    project.write_text(project.read_text().replace('"spot5-hrs"', '"F.RPB"'))
    assert main(["adjust", str(block)]) == 1
    error = capsys.readouterr().err
    assert "F.RPB" in error and "denominator" in error and error.count("\n") == 1


def test_dimap_and_isd_scenes_in_one_block(tmp_path, capsys):
    """Pleiades-like forward (DIMAP 2), ISD back, SPOT-5-like down (DIMAP 1): located, measured with noise, adjusted."""
    looks = {"fore": (18.0, write_dimap2), "aft": (-18.0, write_isd), "down": (0.0, write_dimap1)}
    names = {"fore": "a.xml", "aft": "b.json", "down": "c.dim"}
    folder = tmp_path / "block"
    folder.mkdir()
    sensors = {}
    for name, (pitch, write) in looks.items():
        # the orbit goes on while the look comes round, so that all see the same ground
        truth = Truth(lines=8000, samples=3000, gsd=4e-6, tilt_deg=(0.0, pitch, 0.0), phase_deg=40.0 - 0.1133 * pitch)
        sensors[name] = read_scene(write(folder / names[name], truth)).sensor
    rng = np.random.default_rng(1)
    middle = sensors["down"]
    P = middle.ground(rng.uniform(0, 7999, 400), rng.uniform(0, 2999, 400), rng.uniform(0, 1500, 400))
    pixels = [sensor.ground_to_pixel(P) + rng.normal(0, 0.3, (400, 2)) for sensor in sensors.values()]
    seen = np.flatnonzero(np.all([np.isfinite(p[:, 0]) & (p > 0).all(axis=1) for p in pixels], axis=0))[:40]
    assert len(seen) == 40
    rays = ImagePoints(
        np.repeat(np.arange(3), 40), np.tile(np.arange(40), 3), *np.concatenate([p[seen] for p in pixels]).T,
        np.full(120, 0.3),
    )  # fmt: skip
    covariance = np.tile(0.04 * np.eye(3), (40, 1, 1))
    known = KnownGround(np.arange(40), P[seen], covariance, ("control",) * 6 + ("check",) * 34)
    named = tuple(SimpleNamespace(name=name) for name in looks)
    block = SceneBlock(named, tuple(f"P{k}" for k in range(40)), rays, known)
    write_scene_block(folder, "mixed makers", {name: {"metadata": names[name]} for name in looks}, block)
    assert main(["adjust", str(folder), "--selfcal", "lens", "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert set(result["strips"]) == set(looks) and result["converged"]
    assert 0.7 < result["sigma0"] < 1.15
    assert (np.array(result["check"]["rmse_m"]) < 2.0 * np.array(result["check"]["sigma_m"])).all()
    assert len(result["additional_parameters"]) == 27


def test_new_scenes(made, tmp_path, capsys):
    folder = tmp_path / "mine"
    assert main(["new", "scenes", str(folder), str(made / "spot5-hrs")]) == 0
    assert main(["adjust", str(folder)]) == 1
    assert "image_points.csv: no rows below the header" in capsys.readouterr().err
    for arguments, match in (
        (["scenes", str(folder), str(made / "spot5-hrs")], "project.toml: is there already"),
        (["scenes", str(tmp_path / "other")], "no metadata: wanted those of the scenes"),
        (["scenes", str(tmp_path / "other"), str(made / "truth.csv")], "truth.csv: of no known kind"),
        (["flight", str(tmp_path / "other"), str(made / "spot5-hrs")], "metadata go with `triline new scenes`"),
    ):
        assert main(["new", *arguments]) == 1
        assert match in capsys.readouterr().err


def test_control_that_is_left_out_counts_in_no_accuracy(block, capsys):
    path = block / "ground_points.csv"
    first = rows(path)[0]
    path.write_text(path.read_text().replace(first["Z_m"], str(float(first["Z_m"]) + 80.0), 1))
    assert main(["adjust", str(block), "--snoop", "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert [(r["point"], r["coordinate"], r["w"] < 0) for r in result["rejected_control"]] == [
        (first["point"], "Z", True)  # adjusted minus given
    ]
    assert result["control"]["n"] == 9 and result["control"]["max_m"][2] < 5.0


def test_rows_that_cannot_be_used_are_named_and_the_rest_adjusted(block, capsys):
    path = block / "image_points.csv"
    lines = path.read_text().splitlines()
    lines += [
        "Q1,scene,N,100,100,0.3",
        "Q2,elsewhere,F,100,100,0.3",
        "Q3,scene,F,-70,100,0.3",
        "Q4,scene,F,100,99999,0.3",
    ]
    lines += [lines[1], "Q5,scene,F,200,200,0.3"]
    path.write_text("\n".join([*lines, ""]))
    assert main(["adjust", str(block), "--snoop", "--json"]) == 0
    notes = "\n".join(json.loads(capsys.readouterr().out)["notes"])
    assert "ccd: 'N' is none of scene scene, which has F, B; the ray cannot be used" in notes
    assert "strip: 'elsewhere' is not in project.toml" in notes
    assert "line: -70, sample 100 lies outside image scene/F of 12000 lines and 12000 samples" in notes
    assert "sample 99999 lies outside" in notes
    assert "1 rows repeat a measurement" in notes
    assert "points are not determined by their rays and were left out" in notes


def test_image_points_before_the_first_row_of_polynomials_of_no_size_are_told(block, capsys):
    write_rpb(block / "F.RPB", fit_to_model(read_scene(block / "spot5-hrs").sensors["F"], -500.0, 2500.0).rpc)
    image_points = block / "image_points.csv"
    image_points.write_text(image_points.read_text().replace(",scene,F,", ",forward,,") + "P1,forward,,-70,100,0.3\n")
    with open(block / "project.toml", "a") as file:
        file.write('[scenes.forward]\nmetadata = "F.RPB"\n')
    assert main(["adjust", str(block), "--snoop", "--json"]) == 0
    notes = "\n".join(json.loads(capsys.readouterr().out)["notes"])
    assert "line: -70, sample 100 lies outside image forward; the ray cannot be used" in notes


def test_keys_of_sigmas_that_are_not_known_are_told(block, capsys):
    """``ofset_sigma_m`` was left out without a word, and the usual sigmas held."""
    with open(block / "project.toml", "a") as file:
        file.write("[rpc]\nshift_sigma = 3\n[trajectory]\nofset_sigma_m = [1, 1, 1]\nshift_sigma_deg = 0.01\n")
    assert main(["adjust", str(block), "--json"]) == 0
    told = [note for note in json.loads(capsys.readouterr().out)["notes"] if "is not known" in note]
    assert told == [
        "project.toml: key rpc.shift_sigma is not known and was ignored",
        "project.toml: trajectory: key ofset_sigma_m is not known and was ignored",
    ]


def test_image_points_of_a_line_that_its_scene_has_not(block, capsys):
    """Of a scene with the line F alone those of F and those without a name count; those of B were taken for F's."""
    times = block / "spot5-hrs" / "line_times.csv"
    times.write_text("".join(line for line in times.read_text().splitlines(keepends=True) if line[:2] != "B,"))
    path = block / "image_points.csv"
    head, *points = path.read_text().splitlines()
    first = [line.replace(",scene,F,", ",scene,,") for line in points[:3]]
    path.write_text("\n".join([head, *first, *points[3:], ""]))
    assert main(["adjust", str(block), "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    of_b = sum(",scene,B," in line for line in points)
    assert result["n_image_points"] == len(points) - of_b and result["converged"]
    notes = "\n".join(result["notes"])
    assert "ccd: 'B' is none of scene scene, which has F; the ray cannot be used" in notes
    assert f"image_points.csv: {of_b - 5} more rays cannot be used" in notes


@pytest.mark.parametrize(
    ("options", "match"),
    [
        (["--selfcal", "tls18"], "--selfcal tls18: does not go with satellite scenes, wanted none, lens, prism30"),
        (["--model", "wander"], "model wander: does not go with satellite scenes, wanted dgr, ppm, lim"),
        (["--segments", "3"], "--segments is for the model ppm; asked for is dgr"),
        (["--model", "ppm", "--segments", "500"], "--segments 500, wanted 1 to 60"),
        (["--selfcal", "lens", "--keep", "all"], "--keep does not go with satellite scenes: their parameters are not"),
        (["--reweight"], "--reweight does not go with a block of satellite scenes"),
        (["--free"], "--free goes with additional parameters, wanted --selfcal"),
        (["--per-line", "-o", "result"], "--per-line does not go with satellite scenes: trajectory_refined.csv has"),
        (["--dem", "d.tif", "--dem-sigma", "1"], "--dem does not go with a block of satellite scenes"),
    ],
)
def test_options_that_do_not_go(options, match, made, capsys):
    assert main(["adjust", str(made), *options]) == 1
    assert match in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "match"),
    [
        (["--satellite", "sputnik"], "satellite 'sputnik', wanted one of alos-prism"),
        (["--satellite", "moms-02", "--place", "60", "0"], "wanted one that an orbit of 28.5 deg reaches"),
        (["--satellite", "spot5-hrs", "--points", "5"], "wanted no more of these than there are points"),
        (["--satellite", "spot5-hrs", "--strips", "2"], "--strips does not go with --satellite"),
        (["--points", "5"], "--place, --points and --overpasses go with --satellite"),
    ],
)
def test_simulations_that_do_not_go(options, match, tmp_path, capsys):
    assert main(["simulate", "-o", str(tmp_path / "x"), *options]) == 1
    assert match in capsys.readouterr().err


def test_a_simulation_does_not_write_over_what_is_in_a_folder(block, tmp_path, capsys):
    before = {path: path.read_bytes() for path in block.rglob("*") if path.is_file()}
    assert main(["simulate", "-q", "-o", str(block), "--satellite", "spot5-hrs", "--seed", "4"]) == 1
    assert capsys.readouterr().err == (
        f"triline simulate: {block}: is there already and is not empty, wanted a new folder\n"
    )
    assert {path: path.read_bytes() for path in block.rglob("*") if path.is_file()} == before
    empty = tmp_path / "empty"
    empty.mkdir()
    assert main(["simulate", "-q", "-o", str(empty), "--satellite", "spot5-hrs", "--points", "40"]) == 0
    assert (empty / "project.toml").is_file()
