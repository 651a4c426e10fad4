"""`triline rectify` and the rectifier node: a flight with image lines to orthoimages, held against the true ground."""

from __future__ import annotations

import csv
import json
import struct
from dataclasses import replace
from datetime import datetime
from decimal import Decimal

import numpy as np
import pandas as pd
import pytest
import rasterio
import rasterio.warp
from command_line import answer
from notebook import Notebook
from recording_file import without_topics
from rio_cogeo.cogeo import cog_validate
from scipy import ndimage
from synthetic_flight import flight_messages

from triline.nodes.batch import rectification as work
from triline.nodes.batch.relief import known_points
from triline.nodes.batch.strip_orientation import OfTable, camera_beside, orientation_of
from triline.nodes.batch.strip_orientation import estimated_camera as camera_estimated_in
from triline.nodes.cli import main, rectify_mosaic
from triline.nodes.convert import camera_from, camera_message, estimated_camera, ground_point_message, time_ns
from triline.nodes.errors import UserError
from triline.nodes.formats.dem import dem_in_frame, read_dem
from triline.nodes.formats.geotiff import Heights, read_heights, write_heights
from triline.nodes.formats.height_raster import HeightRaster
from triline.nodes.formats.projection import missing_grids
from triline.nodes.formats.trajectory_csv import read_poses_of_strips
from triline.nodes.node import Message
from triline.nodes.recording.access import Recording
from triline.nodes.recording.reader import RecordingReader
from triline.nodes.recording.writer import RecordingWriter
from triline.nodes.rectifier.rectifier import Rectifier
from triline.nodes.simulator.flight_settings import simulated_flight
from triline.nodes.viewer.scene import Scene
from triline.schemas import messages as m
from triline.solver.geometry.frames import LocalFrame
from triline.solver.orthoimage.ground_grid import GroundGrid
from triline.solver.orthoimage.surface import HeightField
from triline.solver.simulation.imagery import ground_sample
from triline.solver.simulation.road_check import find_roads

#: A rough flight: roads are off by several pixels with the measured orientation.
SETTINGS = {
    "sensor": "ads40-small", "pixels": 800, "images": True, "seconds": 11.0, "ties": 12.0, "turbulence": 3.0,
    "lead_in": 3.0,
    "wander_attitude": (0.3,) * 3, "wander": (3.0,) * 3, "attitude_rate": 50.0,
    "control": 6, "check": 4, "cars": 0.0, "seed": 4,
}  # fmt: skip


@pytest.fixture(scope="module")
def simulated():
    return simulated_flight(SETTINGS)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("rectify")


@pytest.fixture(scope="module")
def flown(folder):
    """The recording, with navigator, adjuster and rectifier."""
    options = []
    for name, value in SETTINGS.items():
        values = value if isinstance(value, tuple) else (value,)
        options += ["--" + name.replace("_", "-"), *(() if value is True else map(str, values))]
    assert main(["simulate", "-o", str(folder / "raw.mcap"), "--dem", str(folder / "dem.tif"), "-q", *options]) == 0
    out = folder / "flown.mcap"
    assert main(["process", str(folder / "raw.mcap"), "-o", str(out), "--nodes", "navigator,adjuster,rectifier"]) == 0
    return out


@pytest.fixture(scope="module")
def dem(flown, folder):
    """The true relief, as `triline simulate` wrote it beside the recording."""
    return folder / "dem.tif"


def _rectify(capsys, flown, target, *options):
    return answer(capsys, "rectify", flown, "-o", target, *options)


def test_orthoimage_shows_the_ground_where_it_is(flown, simulated, dem, folder, capsys):
    """Grey values of cells against the reflectance of their places: direct rectification undoes what was rendered."""
    flight, imager = simulated.simulation.flight, simulated.imager
    target = folder / "truth.tif"
    result = _rectify(capsys, flown, target, "--orientation", "truth", "--dem", dem, "--resampling", "cubic")
    assert result["orientation"] == "truth" and result["crs"] == "EPSG:32632" and not result["left_out"]
    assert result["strips"] == {"S1": flight.strips[0].lines}
    valid, errors, warnings = cog_validate(str(target), strict=True)
    assert valid and not errors and not warnings
    with rasterio.open(target) as image:
        assert image.crs.to_epsg() == 32632 and image.nodata == 0 and image.dtypes == ("uint16",)
        assert image.overviews(1) and image.shape == (result["rows"], result["columns"])
        assert image.transform.a == -image.transform.e == result["gsd"]
        grey = image.read(1).astype(float)
        rng = np.random.default_rng(1)
        row, column = (a[rng.choice((grey > 0).sum(), 6000, replace=False)] for a in np.nonzero(grey))
        x, y = rasterio.transform.xy(image.transform, row, column)
    utm = replace(flight.frame, crs="EPSG:32632")
    place = np.column_stack([x, y, np.full(len(x), flight.frame.height_m)])
    for _ in range(4):
        local = utm.from_crs(place)
        local[:, 2] = flight.terrain.height(local[:, 0], local[:, 1])
        place[:, 2] = utm.to_crs(local)[:, 2]
    seen = imager.texture.seen_by(1.05 * imager.texture.detail_m)
    found = np.empty((2, 3))
    for axis in range(2):
        for k, shift in enumerate((-1.0, 0.0, 1.0)):
            at = local[:, :2] + shift * result["gsd"] * np.eye(2)[axis]
            # look 1 is that of the nadir line: it decides about what stirs
            found[axis, k] = np.corrcoef(grey[row, column], seen.reflectance(at[:, 0], at[:, 1], 0.0, 1))[0, 1]
    assert found[:, 1].min() > 0.95  # illumination falls off to the ends of the line
    peak = 0.5 * (found[:, 2] - found[:, 0]) / (2 * found[:, 1] - found[:, 0] - found[:, 2])
    assert np.abs(peak).max() < 0.1, "best shift, cells"


def test_a_part_is_the_same_window_of_the_whole(flown, folder, capsys):
    whole, part = folder / "whole.tif", folder / "part.tif"
    sigmas = folder / "whole_sigma.tif", folder / "part_sigma.tif"
    options = "--gsd", "5", "--ccd", "N", "--sigma"
    _rectify(capsys, flown, whole, *options, sigmas[0])
    with rasterio.open(whole) as image:
        left, bottom, right, top = image.bounds
        middle = image.read(1)[40:80, 20:60]
        corner = [left + 100.0, top - 400.0, left + 300.0, top - 200.0]
    result = _rectify(capsys, flown, part, *options, sigmas[1], "--bounds", *corner)
    with rasterio.open(part) as image:
        assert image.bounds == tuple(corner) and image.shape == (40, 40)
        cells = image.read(1).astype(float)
        assert (cells > 0).all() and np.abs(cells - middle).mean() < 0.01 * middle.mean() and middle.std() > 20.0
    with rasterio.open(sigmas[0]) as of_whole, rasterio.open(sigmas[1]) as of_part:
        assert of_part.read() == pytest.approx(of_whole.read()[:, 40:80, 20:60], rel=0.01)
    lines = result["strips"]["S1"]
    of_strip = int(Recording(flown).last_strips()["S1"].lines)
    assert lines + result["left_out"]["beside the bounds"] == of_strip // 2 * 2  # two pixels to a cell
    assert lines < 0.7 * of_strip
    assert main(["rectify", str(flown), "-o", str(folder / "none.tif"), "--bounds", "8", "48", "9", "49"]) == 1
    told = capsys.readouterr().err
    assert "no line sees --bounds 8 48 9 49; all lines together see --bounds " in told and "in EPSG:32632" in told
    seen = [float(word) for word in told.partition("see --bounds")[2].split()[:4]]
    assert np.abs(np.array(seen) - [left, bottom, right, top]).max() < 100.0
    assert not (folder / "none.tif").exists()


def test_roads_become_straight(flown, simulated):
    """Off by more than 3 px with the measured orientation, by less than 0.3 px with the final one."""
    flight = simulated.simulation.flight
    recording = Recording(flown)
    camera = recording.camera()
    frame = work.frame_for(recording.frame(), "EPSG:32632")
    grid = GroundGrid(frame, round(ground_sample(flight), 2))
    low, high = flight.truth.position_l.min(axis=0) - 2000, flight.truth.position_l.max(axis=0) + 2000
    x, y = np.arange(low[0], high[0], 10.0), np.arange(low[1], high[1], 10.0)
    field = HeightField(x[0], y[0], 10.0, flight.terrain.height(*np.meshgrid(x, y)))
    off = {}
    for name in ("measured", "final", "truth"):
        _, orientation, reference_ns = orientation_of(recording, name)
        job = work.Rectification(camera, 1, field, grid, "bilinear", lambda _, it=orientation: it, reference_ns)
        for block in work.line_blocks(recording, "N", None):
            job.add(block)
        done = job.finish()
        assert done is not None and done.missed_rays == 0
        roads = find_roads(done.mosaic, grid, simulated.imager.texture, flight.terrain, reach=14.0)
        assert len(roads.road) > 60 and len(np.unique(roads.road)) >= 3
        off[name] = roads.rms()
    assert off["measured"] > 3.0
    assert off["final"] < 0.3
    assert off["truth"] < 0.2  # the noise of the measurement


def test_orientation_of_an_adjustment_goes_with_the_camera_that_it_calibrated(flown, folder, capsys):
    out = folder / "adjusted"
    command = ["adjust", flown, "--selfcal", "tls18", "--keep", "all", "-o", out, "--per-line", "-q"]
    assert main([*map(str, command)]) == 0
    camera = Recording(flown).camera()
    found, path = camera_beside(out / "trajectory_refined.csv", camera)
    assert path == out / "camera.json"
    moved = [np.abs(a.xy_mm - b.xy_mm).max() for a, b in zip(found.lines, camera.lines, strict=True)]
    assert max(moved) > 1e-5
    options = ["--gsd", 8, "--height", 300]
    whole = {}
    for name in ("trajectory_refined.csv", "orientation_lines.csv"):
        told = _rectify(capsys, flown, folder / "calibrated.tif", "--trajectory", out / name, *options)
        assert told["camera"] == str(path) and told["orientation"] == name
        with rasterio.open(folder / "calibrated.tif") as image:
            whole[name] = image.read(1), image.transform
    # the same camera named, for a table that lies elsewhere
    alone = folder / "alone"
    alone.mkdir()
    (alone / "lines.csv").write_text((out / "orientation_lines.csv").read_text())
    named = ["--trajectory", alone / "lines.csv", "--camera", out / "camera.json"]
    told = _rectify(capsys, flown, folder / "named.tif", *named, *options)
    assert told["camera"] == str(out / "camera.json")
    with rasterio.open(folder / "named.tif") as image:
        np.testing.assert_array_equal(image.read(1), whole["orientation_lines.csv"][0])
    misspelt = json.loads((out / "camera.json").read_text()) | {"distorsion": [0.0]}
    (out / "camera.json").write_text(json.dumps(misspelt))
    told = _rectify(capsys, flown, folder / "named.tif", "--camera", out / "camera.json", "--height", 0)
    assert told["camera"] == str(out / "camera.json") and not told["camera_parameters"]
    assert any("distorsion" in note for note in told["notes"])
    # a camera that is 40 pixels off across the track takes the orthoimage along
    table = out / "camera_N.csv"
    rows = np.loadtxt(table, delimiter=",", skiprows=1)
    rows[:, 2] += 40 * abs(rows[1, 2] - rows[0, 2])
    np.savetxt(table, rows, delimiter=",", header="sample,x_mm,y_mm", comments="", fmt=("%d", "%.9f", "%.9f"))
    _rectify(capsys, flown, folder / "off.tif", "--trajectory", out / "trajectory_refined.csv", *options)
    with rasterio.open(folder / "off.tif") as image:
        apart = np.hypot(image.transform.c - whole[name][1].c, image.transform.f - whole[name][1].f)
        assert apart > 30
    (out / "camera.json").write_text((out / "camera.json").read_text().replace('"id": "N"', '"id": "M"'))
    assert (
        main(["rectify", str(flown), "-o", str(folder / "x.tif"), "--trajectory", str(out / "orientation_lines.csv")])
        == 1
    )
    assert "stands beside orientation_lines.csv and has other lines, wanted F with" in capsys.readouterr().err


def test_a_table_of_lines_comes_back_with_the_camera_of_its_orientation(flown, folder, capsys):
    table = folder / "exported" / "lines.csv"
    table.parent.mkdir()
    assert main(["export", str(flown), "--per-line", str(table), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["camera"] == str(folder / "exported" / "lines_camera.json") and told["camera_parameters"] > 0
    options = ["--gsd", 8, "--height", 300]
    images = {}
    for name, words in {"plain": [], "table": ["--trajectory", table]}.items():
        found = _rectify(capsys, flown, folder / "back.tif", *words, *options)
        with rasterio.open(folder / "back.tif") as image:
            images[name] = image.read(1).astype(float)
    assert found["camera"] == told["camera"]
    assert images["table"].shape == images["plain"].shape
    assert (images["table"] != images["plain"]).mean() < 0.02
    # an orientation that nobody has refined belongs to the camera as it was
    assert main(["export", str(flown), "--per-line", str(table), "--orientation", "measured", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["camera"] is None
    assert not (folder / "exported" / "lines_camera.json").exists()


def test_no_line_of_a_table_is_left_out_for_the_rounding_of_its_time(flown, folder, capsys):
    table = folder / "rounded" / "lines.csv"
    table.parent.mkdir()
    assert main(["export", str(flown), "--per-line", str(table), "-q"]) == 0
    rows = [row.split(",") for row in table.read_text().splitlines()]
    for row, off in ((rows[1], "0.000000400"), (rows[-1], "-0.000000400")):
        row[2] = str(Decimal(row[2]) + Decimal(off))
    table.write_text("".join(",".join(row) + "\n" for row in rows))
    told = _rectify(capsys, flown, folder / "rounded.tif", "--trajectory", table, "--height", 0)
    assert told["strips"] == {"S1": len(rows) - 1} and not told["left_out"]


def test_lines_have_the_poses_of_their_own_strip_where_two_are_imaged_at_the_same_time(flown, folder, capsys):
    """Of a time one pose was taken, whichever strip it is of."""
    recording, beside = Recording(flown), folder / "beside.mcap"
    with RecordingWriter(beside) as writer:
        for message in recording.messages():
            writer.write(message)
            if message.topic == "configuration/strip":
                other = m.Strip.FromString(message.body.SerializeToString())
                other.id, other.line_rate_hz, other.lines = "S2", 0.5 * other.line_rate_hz, other.lines // 2
                writer.write(replace(message, body=other))
            elif message.topic in ("orientation/final", "orientation/whole"):
                pose = m.PoseInFrame.FromString(message.body.SerializeToString())
                pose.strip, pose.pose.position.x = "S2", pose.pose.position.x + 100.0
                writer.write(replace(message, body=pose))
    tables = {}
    for path in (flown, beside):
        table = folder / f"{path.stem}_lines.csv"
        assert main(["export", str(path), "--per-line", str(table), "-q"]) == 0
        tables[path] = {strip: rows for strip, rows in pd.read_csv(table).groupby("strip")}
    alone, own, other = tables[flown]["S1"], tables[beside]["S1"], tables[beside]["S2"]
    np.testing.assert_array_equal(own.to_numpy(), alone.to_numpy())
    n = min(len(other), len(alone) // 2)  # each second line at the same time
    off = other[["X_m", "Y_m", "Z_m"]].to_numpy()[:n] - alone[["X_m", "Y_m", "Z_m"]].to_numpy()[::2][:n]
    assert n > 150 and np.linalg.norm(off, axis=1) == pytest.approx(np.full(n, 100.0), abs=0.1)  # scale of the CRS
    images = []
    for path in (flown, beside):
        _rectify(capsys, path, folder / "strip.tif", "--strip", "S1", "--gsd", 8, "--height", 0)
        with rasterio.open(folder / "strip.tif") as image:
            images.append((image.read(1), image.transform))
    np.testing.assert_array_equal(images[1][0], images[0][0])
    assert images[1][1] == images[0][1]
    # so it is with tables of the lines: that of both strips was refused, as its times go back
    images = []
    for path in (flown, beside):
        words = ["--trajectory", folder / f"{path.stem}_lines.csv", "--strip", "S1", "--gsd", 8, "--height", 0]
        told = _rectify(capsys, path, folder / "strip.tif", *words)
        assert told["strips"]["S1"] > len(alone) - told["pixels_together"] and not told["notes"]
        with rasterio.open(folder / "strip.tif") as image:
            images.append((image.read(1), image.transform))
    np.testing.assert_array_equal(images[1][0], images[0][0])
    assert images[1][1] == images[0][1]
    words = ["rectify", str(beside), "-o", str(folder / "x.tif"), "--trajectory", str(folder / "flown_lines.csv")]
    assert main([*words, "--strip", "S2"]) == 1
    assert capsys.readouterr().err.endswith("flown_lines.csv: strip: no rows of 'S2', there are: S1\n")
    assert main([*words, "--gsd", "20", "--height", "0"]) == 0
    assert "note: flown_lines.csv has no rows of strip S2" in capsys.readouterr().out
    sbet = folder / "mission.sbet"
    sbet.write_bytes(np.linspace(0.0, 1.0, 17 * 4).tobytes())
    assert main([*words[:-1], str(sbet)]) == 1
    assert "mission.sbet: no column of times, wanted a table of `triline adjust` or" in capsys.readouterr().err


def test_parameters_of_other_things_than_the_camera_do_not_hide_those_of_the_camera(flown, folder):
    names = {"dX": 0.1, "phi drift": 1e-6, "shift of the surface": 0.4, "clock": 1e-4, "xp_F": 0.01, "dc": 0.02}
    parameters = [m.ParameterEstimate(name=name, value=value) for name, value in names.items()]
    path = folder / "parameters.mcap"
    with RecordingWriter(path) as writer:
        for message in RecordingReader(flown).messages(["configuration/camera"]):
            writer.write(message)
        report = m.AdjustmentReport(parameters=parameters)
        writer.write(Message("adjustment/report", message.stamp_ns + 1, report, "adjuster"))
    camera = Recording(path).camera()
    found, n = camera_estimated_in(Recording(path), camera)
    assert n == 2
    assert np.abs(found.lines[0].xy_mm - camera.lines[0].xy_mm).max() > 0.005


def test_choices_of_rectify(flown, folder, capsys):
    best = _rectify(capsys, flown, folder / "best.tif", "--gsd", 8, "--dem", "points")
    assert best["orientation"] == "whole" and best["pixels_together"] == 3 and best["gsd"] == 8
    forward = _rectify(
        capsys, flown, folder / "f.tif", "--ccd", "F", "--gsd", 10, "--crs", "EPSG:3035", "--height", 320
    )
    assert forward["ccd"] == "F" and forward["crs"] == "EPSG:3035" and "320.0 m" in forward["ground"]
    local = _rectify(
        capsys, flown, folder / "l.tif", "--crs", "local", "--gsd", 10, "--orientation", "live", "--strip", "S1"
    )
    with rasterio.open(folder / "l.tif") as image:
        assert image.crs is None and abs(image.bounds.left) < 4000 and image.shape == (local["rows"], local["columns"])
    assert main(["rectify", str(flown), "-o", str(folder / "q.tif"), "--gsd", "10"]) == 0
    assert "whole orientation, height" in capsys.readouterr().out


def test_heights_of_a_flight_folder(flown, dem, tmp_path, capsys):
    toml = tmp_path / "flight.toml"
    toml.write_text(f'[dem]\nfile = "{dem}"\ncrs = "ellipsoid"\n')
    by_folder, by_file = (
        _rectify(capsys, flown, tmp_path / "o.tif", "--gsd", 10, "--dem", *given)
        for given in ((tmp_path,), (dem, "--dem-crs", "ellipsoid"))
    )
    assert by_folder | {"seconds": 0} == by_file | {"seconds": 0} and "dem.tif" in by_folder["ground"]
    toml.write_text("[flight]\n")
    assert main(["rectify", str(flown), "-o", str(tmp_path / "o.tif"), "--dem", str(tmp_path)]) == 1
    assert "wanted a table [dem] with file" in capsys.readouterr().err


def test_sigmas_beside_the_orthoimage(flown, simulated, dem, folder, capsys):
    """Of the covariance of the orientation in use, the heights and matching; cells as the orthoimage."""
    sigma, values = folder / "sigma.tif", {}
    for name, options in {
        "measured": (), "final": (), "truth": ("--pixel-sigma", 0.5, "--height-sigma", 2.0),
    }.items():  # fmt: skip
        result = _rectify(
            capsys, flown, folder / "o.tif", "--orientation", name, "--dem", dem, "--gsd", 8, "--sigma", sigma, *options
        )
        assert any("heights of the ground are taken as without error" in n for n in result["notes"]) != bool(options)
        with rasterio.open(sigma) as image, rasterio.open(folder / "o.tif") as grey:
            assert image.shape == grey.shape == (result["rows"], result["columns"]) and image.crs == grey.crs
            assert image.transform == grey.transform and np.isnan(image.nodata) and image.count == 2
            band, seen = image.read(), grey.read(1) > 0
        assert (np.isfinite(band[0]) == seen).mean() > 0.999
        values[name] = np.nanmedian(band, axis=(1, 2))
    # the measured orientation is known to some metres and tenths of a degree; ties and control make much more of it
    assert 5.0 < values["measured"][0] < 50.0 and values["final"][0] < 0.2 * values["measured"][0]
    pixel = ground_sample(simulated.simulation.flight)
    assert values["truth"] == pytest.approx([np.hypot(np.sqrt(2) * 0.5 * pixel, 0.3), 2.0], rel=0.25)


def test_cells_behind_walls_are_left_out(flown, simulated, dem, folder, capsys):
    """A forward look at walls and blocks: hidden is what rays marched from the ground to the camera find hidden."""
    raster = read_heights(dem)
    recording = Recording(flown)
    _, orientation, reference_ns = orientation_of(recording, "truth")
    camera, strip = recording.camera(), next(iter(recording.last_strips().values()))
    ccd = camera.line_index["F"]
    first_s = (strip.first_line_time_ns - reference_ns) * 1e-9
    ray = np.array([*camera.image_coordinates(np.array([ccd]), np.array([399.5]))[0][0], -camera.focal_length_mm[ccd]])

    # walls along, across and oblique, in the middle of what the line sees
    C, R = (a[0] for a in orientation.at([first_s + 0.5 * strip.lines / strip.line_rate_hz]))
    d = R @ ray
    utm = replace(simulated.simulation.flight.frame, crs=raster.crs)
    x0, y0, _ = utm.to_crs((C + d * ((30.0 - C[2]) / d[2]))[None])[0]
    i, j = round((y0 - raster.y0) / raster.dy) - 35, round((x0 - raster.x0) / raster.dx) - 35
    fine = ndimage.zoom(raster.z_m[i : i + 70, j : j + 70], 2, order=1, grid_mode=True, mode="nearest")  # every 5 m
    x = raster.x0 + raster.dx * (j - 0.25 + 0.5 * np.arange(fine.shape[1])) - x0
    y = (raster.y0 + raster.dy * (i - 0.25 + 0.5 * np.arange(fine.shape[0])) - y0)[:, None]
    for left, bottom, right, top, height in (
        (-150, -200, -130, 0, 60), (-60, 80, 140, 100, 40), (20, -150, 90, -80, 90), (120, -20, 150, 10, 120),
    ):  # fmt: skip
        fine[(x > left) & (x < right) & (y > bottom) & (y < top)] += height
    oblique = (np.abs(x + y + 220.0) < 12.0) & (np.abs(x - y) < 150.0)
    fine[oblique] += 50.0
    walls = folder / "walls.tif"
    built = Heights(
        raster.crs, fine, float(x[0] + x0), float(y[0, 0] + y0), 0.5 * raster.dx, 0.5 * raster.dy, above_ellipsoid=True
    )
    write_heights(walls, built)

    options = ("--ccd", "F", "--orientation", "truth", "--dem", walls, "--crs", utm.crs, "--gsd", "1.5")
    _rectify(capsys, flown, folder / "whole.tif", *options)
    told = _rectify(capsys, flown, folder / "seen.tif", *options, "--occlusions")

    def cells(name):
        with rasterio.open(folder / name) as image:
            row, column = image.index(x0, y0)
            window = rasterio.windows.Window(column - 140, row - 140, 280, 280)
            return image.read(1, window=window), image.window_transform(window)

    (whole, corner), (seen, _) = cells("whole.tif"), cells("seen.tif")
    assert (whole > 0).all()
    left_out = seen == 0
    assert told["hidden_cells"] >= left_out.sum() > 3000
    assert (seen == whole)[~left_out].all()
    at = np.arange(280) + 0.5
    e, n = np.meshgrid(corner.c + corner.a * at, corner.f + corner.e * at)

    def ground(e, n):
        return ndimage.map_coordinates(fine, [(n - built.y0) / built.dy, (e - built.x0) / built.dx], order=1, cval=-1e3)

    # some cells of every kind, on their ground
    rng = np.random.default_rng(7)
    some = np.unravel_index(rng.choice(seen.size, 1500, replace=False), seen.shape)
    foot = utm.from_crs(np.column_stack([e[some], n[some], ground(e[some], n[some])]))
    # the line that looks their way: halving, as what lies ahead of it is passed later
    early, late = np.zeros(len(foot)), np.full(len(foot), float(strip.lines - 1))
    for _ in range(20):
        line = 0.5 * (early + late)
        C, R = orientation.at(first_s + line / strip.line_rate_hz)
        image = np.einsum("nij,ni->nj", R, foot - C)
        ahead = -camera.focal_length_mm[ccd] * image[:, 0] / image[:, 2] > ray[0]
        early, late = np.where(ahead, line, early), np.where(ahead, late, line)
    steps = (C - foot) / (C - foot)[:, 2:]
    hidden = np.zeros(len(foot), dtype=bool)
    for up in np.arange(0.5, 150.0, 1.0):  # metres of height
        place = utm.to_crs(foot + up * steps)
        hidden |= ground(place[:, 0], place[:, 1]) > place[:, 2] + 0.05
    assert 0.04 < hidden.mean() < 0.5
    wrong = left_out[some] != hidden
    edge = ndimage.binary_dilation(left_out, iterations=3) & ~ndimage.binary_erosion(left_out, iterations=3)
    assert not (wrong & ~edge[some]).any() and wrong.mean() < 0.02
    # cells that are seen have the grey of the pixel that sees them: rays stand closer than on smooth ground
    xy = image[:, :2] * (-camera.focal_length_mm[ccd] / image[:, 2:])
    sample = np.interp(xy[:, 1], *_ascending(camera.lines[ccd].xy_mm[:, 1]))
    lines = np.concatenate([block.pixels for block in work.line_blocks(recording, "F", [strip.id])]).astype(float)
    grey = ndimage.map_coordinates(lines, [0.5 * (early + late), sample], order=1)
    off = np.abs(whole[some] - grey)[~hidden & ~edge[some]]
    assert np.median(off) < 1.0 and (off > 0.1 * lines.std()).mean() < 0.05  # 2.7 and 0.15 with those of smooth ground
    # in a mosaic they stay empty, too, where no other strip sees them
    block = _rectify(capsys, flown, folder / "block.tif", *options, "--occlusions", "--mosaic", "--workers", "1")
    layer = block["layers"][0]
    assert layer["hidden_cells"] == told["hidden_cells"] and layer["missed_rays"] == told["missed_rays"]
    rectify_mosaic.tell({**block, "layers": [{**layer, "missed_rays": 12}]}, quiet=True)
    words = capsys.readouterr().out
    assert f"S1: {told['hidden_cells']} cells hidden by relief" in words and "S1: 12 rays did not meet the" in words
    assert ((cells("block.tif")[0] == 0) == left_out).all()


def _ascending(y_mm):
    """Places and numbers of pixels, by place."""
    order = np.argsort(y_mm)
    return y_mm[order], order.astype(float)


def test_refraction_moves_an_orthoimage_by_as_much_as_the_air_does(flown, folder, capsys):
    plain = _rectify(capsys, flown, folder / "r0.tif", "--gsd", 8, "--crs", "local")
    bent = _rectify(capsys, flown, folder / "r1.tif", "--gsd", 8, "--crs", "local", "--refraction")
    assert "refraction" in bent["ground"] and "refraction" not in plain["ground"]
    with rasterio.open(folder / "r0.tif") as a, rasterio.open(folder / "r1.tif") as b:
        assert np.abs(np.subtract(a.bounds, b.bounds)).max() <= 8.0  # centimetres at this height: the same cells


@pytest.mark.parametrize(
    ("options", "text"),
    [
        (["--refraction", "1", "2"], "--refraction: 2 values, wanted none, or temperature"),
        (["--pixel-sigma", "0.3"], "--pixel-sigma: goes with --sigma FILE"),
        (["--sigma", "s.tif", "--height-sigma", "-1"], "--height-sigma -1.0: wanted a number of at least 0"),
        (["--position-sigma", "1", "1", "1"], "--position-sigma: goes with an image and its --sensor"),
        (["--workers", "0"], "--workers: goes with an image and its --sensor, not with a recording"),
        (["--nodata", "0"], "--nodata: goes with an image and its --sensor, not with a recording"),
        (["--correction", "shift"], "--correction: goes with an image and its --sensor, not with a recording"),
        (["--occlusions"], "--occlusions: goes with --dem, without which no ground is higher than another"),
        (["--occlusions", "--mosaic", "--height", "300"], "--occlusions: goes with --dem, without which no ground is"),
        (["--tile", "0"], "--tile: goes with --mosaic"),
        (["--feather", "0"], "--feather: goes with --mosaic"),
        (["--ccd", "X"], "no image lines of CCD line 'X', there are: F, N, B"),
        (["--strip", "S9"], "no strip 'S9', there are: S1"),
        (["--gsd", "0"], "--gsd 0.0: wanted more than 0"),
        (["--gsd", "0.0001"], "choose a larger one"),
        (["--gsd", "1e9"], "--gsd 1e+09: leaves less than two cells for the"),
        (["--crs", "EPSG:4326"], "is geographic, wanted a projected CRS"),
        (["--crs", "EPSG:4978"], "--crs: crs 'EPSG:4978': a geocentric system, wanted a projected or geographic one"),
        (["--crs", "EPSG:0"], "PROJ does not know the CRS 'EPSG:0'"),
        (["--dem", "no.tif"], "no.tif: no such file"),
        (["--dem", __file__], "not a raster"),
        (["--height", "9000"], "below the ground"),
        (["--height", "1", "--dem", "points"], "wanted one of them"),
        (["--mosaic", "--height", "nan"], "--height nan: wanted a number"),
        (["--mosaic", "--gsd", "inf"], "--gsd inf: wanted a number"),
        (["--crs", "+proj=gnom +lat_0=-49 +lon_0=-170 +datum=WGS84 +type=crs"], "lies outside its area"),
    ],
)
def test_refusals(flown, folder, capsys, options, text):
    target = folder / "refused.tif"
    assert main(["rectify", str(flown), "-o", str(target), *options]) == 1
    err = capsys.readouterr().err
    assert text in err and err.count("\n") == 1 and not target.exists()


@pytest.mark.parametrize("mosaic", [[], ["--mosaic", "--workers", "1"]])
def test_a_map_whose_datum_shift_is_not_here(flown, folder, capsys, mosaic):
    if not missing_grids("EPSG:31467"):
        pytest.skip("PROJ has the grid here")
    for crs, said in (("EPSG:31467", 1), ("EPSG:32632", 0)):
        words = ["--crs", crs, "--gsd", 20, "--height", 0, *mosaic]
        notes = _rectify(capsys, flown, folder / "shifted.tif", *words)["notes"]
        assert len(notes) == said and all("no grid de_adv_BETA2007.tif here" in note for note in notes)


def test_recordings_that_cannot_be_rectified(flown, folder, capsys):
    def without(name, *gone):
        return without_topics(flown, folder / name, "orthoimage", *gone)

    def refused(path, *options):
        assert main(["rectify", str(path), "-o", str(folder / "no.tif"), *options]) == 1
        return capsys.readouterr().err

    assert "no image lines in it" in refused(without("blind.mcap", "sensor/lines"))
    raw = folder / "raw.mcap"
    assert "no final orientation" in refused(raw, "--orientation", "final")
    assert "it has truth" in refused(raw, "--orientation", "measured")
    lost = without("lost.mcap", "truth", "orientation", "trajectory", "sensor/lines/F", "sensor/lines/B")
    assert "no orientation in it" in refused(lost)
    assert "no such file" in refused(folder / "none.mcap")
    assert "is a folder" in refused(folder)
    assert "would overwrite" in (main(["rectify", str(raw), "-o", str(raw)]), capsys.readouterr().err)[1]
    assert (
        "no folder"
        in (main(["rectify", str(raw), "-o", str(folder / "x" / "y.tif"), "--gsd", "20"]), capsys.readouterr().err)[1]
    )


@pytest.mark.parametrize("mosaic", [[], ["--mosaic", "--workers", "1"]])
def test_the_truth_is_told_where_nobody_asked_for_it(flown, folder, capsys, mosaic):
    """Of a recording that went through no node: its mosaic, with sigmas of 0, did not say which orientation it has."""
    words = ["rectify", str(folder / "raw.mcap"), "-o", str(folder / "true.tif"), "--gsd", "20", "--height", "0"]
    for asked, told in (([], True), (["--orientation", "truth"], False)):
        capsys.readouterr()
        assert main([*words, *mosaic, *asked]) == 0
        out = capsys.readouterr().out
        assert ("note: the recording has no orientation but the truth" in out) == told
        assert ("orientation of the strips: truth (1)" if mosaic else "truth orientation") in out


def test_lost_blocks_leave_a_hole_and_are_told(flown, folder, capsys):
    gone = 0
    with RecordingWriter(folder / "holes.mcap") as writer:
        for message in RecordingReader(flown).sorted_messages():
            if message.topic == "sensor/lines/N" and 200 <= message.body.first_line < 240:
                gone += len(message.body.pixels)
            elif message.topic.startswith(
                ("configuration", "sensor/lines/N", "truth/trajectory", "observation/control")
            ):
                writer.write(message)
    assert gone > 20
    result = _rectify(capsys, folder / "holes.mcap", folder / "holes.tif", "--gsd", 3)
    assert result["left_out"] == {"missing": gone}
    whole = _rectify(capsys, flown, folder / "whole.tif", "--orientation", "truth", "--gsd", 3)
    with rasterio.open(folder / "holes.tif") as a, rasterio.open(folder / "whole.tif") as b:
        share = 1 - (a.read(1) > 0).sum() / (b.read(1) > 0).sum()
    assert 0.8 < share / (gone / sum(whole["strips"].values())) < 1.3


def test_cells_in_feet_are_as_large_as_those_in_metres(flown, folder, capsys):
    """Also which pixels are put together goes by the size of a cell on the ground."""
    foot = 1200.0 / 3937.0
    utm = "+proj=utm +zone=32 +datum=WGS84 +units={} +type=crs"
    made = {}
    for unit, size in (("m", 1.0), ("us-ft", foot)):
        for gsd in (None, 6.0):
            words = [] if gsd is None else ["--gsd", gsd / size]
            crs = utm.format(unit)
            made[unit, gsd] = _rectify(capsys, flown, folder / "unit.tif", "--height", 0, "--crs", crs, *words)
    for gsd in (None, 6.0):
        metres, feet = made["m", gsd], made["us-ft", gsd]
        assert feet["gsd"] * foot == pytest.approx(metres["gsd"], rel=0.05)
        assert feet["pixels_together"] == metres["pixels_together"]
        assert feet["rows"] == pytest.approx(metres["rows"], rel=0.06)
    assert made["m", 6.0]["pixels_together"] > 1 == made["m", None]["pixels_together"]
    # a map that is enlarged as much as Web Mercator is here: by 1 / cos 49 deg
    mercator = _rectify(capsys, flown, folder / "unit.tif", "--height", 0, "--crs", "EPSG:3857")
    assert mercator["gsd"] == pytest.approx(made["m", None]["gsd"] / np.cos(np.radians(48.9)), rel=0.05)
    words = ["rectify", flown, "-o", folder / "unit.tif", "--crs", utm.format("us-ft"), "--height", 0, "--gsd", 60]
    assert main([*map(str, words)]) == 0
    assert " ft_us in +proj=utm" in capsys.readouterr().out


def test_a_mosaic_says_what_of_a_recording_is_left_out(flown, folder, tmp_path, capsys):
    """A project with another origin in mid-flight, and the end of the file lost."""
    messages = list(RecordingReader(flown).sorted_messages())
    was = next(x for x in messages if x.topic == "configuration/project")
    body = type(was.body).FromString(was.body.SerializeToString())
    body.origin_height += 10.0
    poses = [x.stamp_ns for x in messages if x.topic == "trajectory/filtered"]
    middle = poses[len(poses) // 3]
    said = m.Verdict(topic="configuration/project", accepted=True, by="Ann")
    other = replace(was, body=body, stamp_ns=middle - 1000, sequence=was.sequence + 1)
    messages += [other, Message("observation/verdict", middle, said, "desk")]
    with RecordingWriter(tmp_path / "two.mcap") as writer:
        for x in sorted(messages, key=lambda x: x.stamp_ns):
            writer.write(x)
    words = ["--mosaic", "--height", 0, "--gsd", 20, "--workers", 1, "--orientation", "measured", "-q"]
    assert main(["rectify", str(tmp_path / "two.mcap"), "-o", str(tmp_path / "two.tif"), *map(str, words)]) == 0
    assert "poses and points are in another local frame and left out" in capsys.readouterr().err
    whole = flown.read_bytes()
    (tmp_path / "cut.mcap").write_bytes(whole[: len(whole) - 2000])
    assert main(["rectify", str(tmp_path / "cut.mcap"), "-o", str(tmp_path / "cut.tif"), *map(str, words)]) == 0
    assert "cut.mcap: " in capsys.readouterr().err


def test_a_mosaic_does_not_take_a_flight_beside_what_was_made_of_it(flown, tmp_path, capsys):
    """Seams would run between two orientations of the same pixels."""
    again = tmp_path / "again.mcap"
    assert main(["process", str(flown), "--nodes", "navigator", "-o", str(again), "-q"]) == 0
    capsys.readouterr()
    assert main(["rectify", str(flown), str(again), "--mosaic", "--workers", "1", "-o", str(tmp_path / "b.tif")]) == 1
    said = capsys.readouterr().err
    assert "again.mcap begins with the same image lines (sensor/lines/" in said
    assert f"as {flown}: is it the same flight" in said
    assert not list(tmp_path.glob("b*"))


def test_simulated_flights_that_begin_at_one_time_are_two(flown, tmp_path, capsys):
    """Their messages have the same stamps and numbers; only the pixels tell them apart."""
    other = tmp_path / "other.mcap"
    with RecordingWriter(other) as writer:
        for x in RecordingReader(flown).sorted_messages():
            if x.topic.startswith("sensor/lines/"):
                x = replace(x, body=replace(x.body, pixels=255 - x.body.pixels))
            writer.write(x)
    words = ["--mosaic", "--height", 0, "--gsd", 20, "--workers", 1, "--orientation", "measured", "-q"]
    assert main(["rectify", str(flown), str(other), "-o", str(tmp_path / "b.tif"), *map(str, words)]) == 0


def test_stac_item_tells_when_lines_were_taken_and_cells_in_metres(flown, folder, capsys):
    crs, target = "+proj=utm +zone=32 +datum=WGS84 +units=us-ft +type=crs", folder / "mosaic.tiff"
    words = ["--mosaic", "--height", 0, "--crs", crs, "--gsd", 20, "--workers", 1, "--stac", folder / "item.json"]
    _rectify(capsys, flown, target, *words)
    item = json.loads((folder / "item.json").read_text())
    about = item["properties"]
    assert about["datetime"] is None and about["gsd"] == pytest.approx(20 * 1200 / 3937, rel=1e-2)
    strip = next(iter(Recording(flown).last_strips().values()))
    first, last = (datetime.fromisoformat(about[f"{end}_datetime"]).timestamp() for end in ("start", "end"))
    assert first == pytest.approx(strip.first_line_time_ns * 1e-9, abs=1e-3)
    assert last - first == pytest.approx((strip.lines - 1) / strip.line_rate_hz, abs=2e-3)
    assert item["assets"]["mosaic"]["type"].endswith("profile=cloud-optimized")
    local = [
        "rectify",
        str(flown),
        "--mosaic",
        "--crs",
        "local",
        "-o",
        str(folder / "of_local.tif"),
        "--stac",
        str(folder / "of_local.json"),
    ]
    assert main(local) == 1 and "wanted a map projection" in capsys.readouterr().err
    assert not (folder / "of_local.tif").exists()


def test_poses_that_are_not_valid_give_no_orientation(flown, folder, capsys):
    """As of a navigator that still seeks its heading: the place of the antenna, and no attitude."""
    begin = next(iter(Recording(flown).last_strips().values())).first_line_time_ns + 8 * 10**9
    lost = 0
    with RecordingWriter(folder / "aligning.mcap") as writer:
        for message in RecordingReader(flown).sorted_messages():
            if message.topic == "trajectory/filtered" and time_ns(message.body.timestamp) < begin:
                message.body.valid, message.body.reason, lost = False, "aligning", lost + 1
                turned = message.body.pose.orientation
                turned.x, turned.y, turned.z, turned.w = 0.0, 0.0, 1.0, 0.0
            if not message.topic.startswith(("trajectory/smoothed", "orientation", "orthoimage")):
                writer.write(message)
    result = _rectify(capsys, folder / "aligning.mcap", folder / "aligning.tif", "--gsd", 3)
    assert result["orientation"] == "measured" and result["poses_not_valid"] == lost > 10
    total = next(iter(Recording(flown).last_strips().values())).lines
    left, there = result["left_out"]["without orientation"], sum(result["strips"].values())
    assert left + there == total and left == pytest.approx(8.0 * total / SETTINGS["seconds"], abs=0.02 * total)
    table = folder / "aligning.csv"
    assert main(["export", str(folder / "aligning.mcap"), "--per-line", str(table)]) == 0
    assert f"{lost} poses left out, not valid" in capsys.readouterr().out
    with open(table) as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == there and min(float(row["time_s"]) for row in rows) >= begin * 1e-9 - 0.01
    spread = np.ptp([float(row["kappa_deg"]) for row in rows])
    assert spread < 5.0


def test_heights_that_cannot_be_used(folder, flown, capsys):
    z = np.zeros((20, 20))
    write_heights(folder / "far.tif", Heights("EPSG:32756", z, 4e5, 6.2e6, 10.0, -10.0))
    assert main(["rectify", str(flown), "-o", str(folder / "no.tif"), "--dem", str(folder / "far.tif")]) == 1
    assert capsys.readouterr().err.count("\n") == 1
    write_heights(folder / "none.tif", Heights("EPSG:32632", np.full((20, 20), np.nan), 4e5, 5e6, 10.0, -10.0))
    assert main(["rectify", str(flown), "-o", str(folder / "no.tif"), "--dem", str(folder / "none.tif")]) == 1
    assert "holds no height" in capsys.readouterr().err
    back = read_heights(folder / "far.tif")
    assert (back.x0, back.y0, back.dx, back.dy) == (4e5, 6.2e6, 10.0, -10.0)


def test_heights_are_those_that_the_raster_states(tmp_path):
    """Whole decimetres with scale and offset; feet are refused where the CRS does not say so."""
    path = tmp_path / "dm.tif"
    place = rasterio.Affine(10.0, 0.0, 5e5, 0.0, -10.0, 5.3e6)
    shape = {"driver": "GTiff", "width": 4, "height": 4, "count": 1, "dtype": "int16"}
    with rasterio.open(path, "w", crs="EPSG:32632", transform=place, nodata=-1, **shape) as target:
        target.write(np.array([[[4000] * 4] * 3 + [[-1] * 4]], dtype=np.int16))
        target.scales, target.offsets = (0.1,), (50.0,)
    z = read_dem(path, "ellipsoid").z_m
    assert z[:3] == pytest.approx(450.0) and np.isnan(z[3]).all()
    assert HeightRaster([path], None, "ellipsoid").heights(0, 0, 3, 4) == pytest.approx(450.0)
    with rasterio.open(path, "r+") as target:
        target.units = ("ft",)
    for read in (lambda: read_dem(path, "ellipsoid"), lambda: HeightRaster([path], None, "ellipsoid")):
        with pytest.raises(UserError, match="heights in ft, wanted metres"):
            read()
    in_feet = "+proj=utm +zone=32 +datum=WGS84 +vunits=ft +type=crs"
    assert read_dem(path, in_feet).unit == "ft"
    raster = HeightRaster([path], in_feet)
    assert raster.heights(0, 0, 3, 4) == pytest.approx(450.0 * 0.3048)
    # the field of a raster in feet lies where that of the same heights in metres does
    local = LocalFrame(47.85, 9.0, 0.0)
    place = replace(local, crs="EPSG:32632").from_crs(np.array([[5e5 + 15.0, 5.3e6 - 15.0, 450.0 * 0.3048]]))
    lat, lon, _ = np.radians(local.to_geodetic(place)).T
    assert raster.range_over(lat, lon) == pytest.approx((450.0 * 0.3048,) * 2)
    assert raster.at(lat, lon) == pytest.approx(450.0 * 0.3048)
    height = dem_in_frame(path, local, in_feet).height(*place[:, :2].T)
    assert height == pytest.approx(place[:, 2], abs=1e-3)


@pytest.mark.parametrize("void", [-9999.0, -32767.0, -32768.0, -99999.0, float(np.finfo(np.float32).min)])
@pytest.mark.parametrize("stated", [True, False])
def test_voids_are_no_heights_also_where_the_raster_does_not_say_so(tmp_path, void, stated):
    path, z = tmp_path / "void.tif", np.full((1, 4, 5), 450.0, dtype=np.float32)
    z[0, 1, 2] = void
    place = rasterio.Affine(10.0, 0.0, 5e5, 0.0, -10.0, 5.3e6)
    shape = {"driver": "GTiff", "width": 5, "height": 4, "count": 1, "dtype": "float32"}
    with rasterio.open(
        path, "w", crs="EPSG:32632", transform=place, nodata=void if stated else None, **shape
    ) as target:
        target.write(z)
    whole = HeightRaster([path], None, "ellipsoid").heights(0, 0, 4, 5)
    for found in (read_dem(path, "ellipsoid").z_m, whole):
        assert np.isnan(found[1, 2]) and np.isnan(found).sum() == 1 and np.nanmin(found) == 450.0


@pytest.mark.parametrize("whole", [True, False])
def test_a_geoid_of_one_country(whole, tmp_path):
    """Its grid does not reach to the Gulf of Guinea, where it was tried: it was "not installed"."""
    grid, path = tmp_path / "geoid.gtx", tmp_path / "flat.tif"
    south, west, rows, columns = (-90.0, -180.0, 181, 361) if whole else (45.0, 5.0, 6, 11)
    head = struct.pack(">4d2i", south, west, 1.0, 1.0, rows, columns)
    grid.write_bytes(head + np.full(rows * columns, 47.0, dtype=">f4").tobytes())
    shape = {"driver": "GTiff", "width": 20, "height": 20, "count": 1, "dtype": "float32"}
    for north in (5.3e6, 0.3e6):
        place = rasterio.Affine(100.0, 0.0, 6e5, 0.0, -100.0, north)
        with rasterio.open(path, "w", crs="EPSG:32632", transform=place, **shape) as target:
            target.write(np.full((1, 20, 20), 500.0, dtype=np.float32))
        datum = f"+proj=longlat +datum=WGS84 +geoidgrids={grid} +type=crs"
        if north < 1e6 and not whole:
            with pytest.raises(UserError, match="or does not reach there"):
                HeightRaster([path], None, datum)
            continue
        x, y = rasterio.warp.transform("EPSG:32632", "EPSG:4326", [6.01e5], [north - 1000.0])
        assert HeightRaster([path], None, datum).at(np.radians(y), np.radians(x)) == pytest.approx(547.0)


@pytest.mark.parametrize("cells", [0, 1, 10])
def test_heights_as_far_as_the_grid_of_their_geoid(cells, tmp_path):
    """The field in the local frame reaches beyond its raster, and beyond the geoid: the raster was refused for that."""
    grid, path = tmp_path / "geoid.gtx", tmp_path / "flat.tif"
    head = struct.pack(">4d2i", 47.0, 10.0, 0.01, 0.01, 101, 101)
    grid.write_bytes(head + np.full(101 * 101, 47.0, dtype=">f4").tobytes())
    n = 101 - 2 * cells
    place = rasterio.Affine(0.01, 0.0, 9.995 + 0.01 * cells, 0.0, -0.01, 48.005 - 0.01 * cells)
    shape = {"driver": "GTiff", "width": n, "height": n, "count": 1, "dtype": "float32"}
    with rasterio.open(path, "w", crs="EPSG:4326", transform=place, **shape) as target:
        target.write(np.full((1, n, n), 500.0, dtype=np.float32))
    frame = LocalFrame(47.5, 10.5, 0.0)
    field = dem_in_frame(path, frame, f"+proj=longlat +datum=WGS84 +geoidgrids={grid} +type=crs")
    edge = 0.01 * cells + 0.02
    lat, lon = np.array([47.5, 47.0 + edge, 48.0 - edge]), np.array([10.5, 10.0 + edge, 11.0 - edge])
    wanted = frame.from_geodetic(lat, lon, 547.0)
    np.testing.assert_allclose(field.height(wanted[:, 0], wanted[:, 1]), wanted[:, 2], atol=0.05)


@pytest.mark.parametrize("first", [0, 1])
def test_tiles_of_heights_on_both_sides_of_the_date_line_are_neighbours(first, tmp_path):
    """A raster round the Earth was made of them, whose windows no memory holds, with a gap along the date line."""
    paths, shape = [], {"driver": "GTiff", "width": 100, "height": 100, "count": 1, "dtype": "float32"}
    for k, west in enumerate((179.0, -180.0)):
        paths.append(tmp_path / f"{k}.tif")
        place = rasterio.Affine(0.01, 0.0, west, 0.0, -0.01, 49.0)
        with rasterio.open(paths[-1], "w", crs="EPSG:4326", transform=place, **shape) as target:
            target.write(np.tile(np.arange(100, dtype=np.float32) + 100 * k, (1, 100, 1)))
    raster = HeightRaster([paths[first], paths[1 - first]], None, "ellipsoid")
    assert (raster.rows, raster.columns) == (100, 200)
    lon = np.array([179.5, 179.999, 180.0, -179.999, -179.5])
    wanted = (lon % 360.0 - 179.005) * 100.0
    np.testing.assert_allclose(raster.at(np.radians(np.full(5, 48.5)), np.radians(lon)), wanted, atol=1e-4)


@pytest.mark.parametrize(("west", "lon"), [(179.8, 180.0), (179.8, -179.9), (-180.2, 180.0), (259.8, -100.0)])
def test_heights_across_the_date_line_and_longitudes_to_360(west, lon, tmp_path):
    """Half of such a raster was a hole without a word, and one from 0 to 360 degrees had no height at all."""
    path, place = tmp_path / "dem.tif", rasterio.Affine(0.01, 0.0, west - 0.005, 0.0, -0.01, 48.205)
    shape = {"driver": "GTiff", "width": 41, "height": 41, "count": 1, "dtype": "float32", "crs": "EPSG:4326"}
    with rasterio.open(path, "w", transform=place, **shape) as target:
        target.write(np.tile(np.arange(41, dtype=np.float32), (1, 41, 1)))
    frame = LocalFrame(48.0, lon, 0.0)
    field = dem_in_frame(path, frame, "ellipsoid")
    east = np.array([0.05, 0.15, 0.25, 0.35])
    wanted = frame.from_geodetic(np.full(4, 48.0), west + east, 100.0 * east)
    np.testing.assert_allclose(field.height(wanted[:, 0], wanted[:, 1]), wanted[:, 2], atol=0.05)


def test_relief_is_of_points_with_a_height(tmp_path):
    with RecordingWriter(tmp_path / "control.mcap") as writer:
        for k, role in enumerate(("control", "planimetric", "height", "check")):
            body = ground_point_message(role, (10.0 * k, 0.0, 100.0 + k), np.eye(3), role)
            writer.write(Message("observation/control", k, body, "import"))
    assert known_points(Recording(tmp_path / "control.mcap"))[:, 2].tolist() == [100.0, 102.0, 103.0]


def test_control_that_does_not_count_is_no_ground(tmp_path):
    """Refused by an operator, of another source, left out by the adjuster; what came back counts."""
    path = tmp_path / "control.mcap"
    with RecordingWriter(path) as writer:
        for k, name in enumerate(("good", "refused", "confirmed", "left out", "returned")):
            body = ground_point_message(name, (10.0 * k, 0.0, 100.0 + k), np.eye(3), "control")
            writer.write(Message("observation/control", k, body, "survey"))
        other = ground_point_message("good", (0.0, 0.0, 900.0), np.eye(3), "control")
        writer.write(Message("observation/control", 10, other, "somebody"))
        for k, (name, accepted) in enumerate((("refused", False), ("confirmed", False), ("confirmed", True))):
            writer.write(Message("observation/verdict", 20 + k, m.Verdict(point=name, accepted=accepted), "desk"))
        out = [m.RejectedObservation(point=name, coordinate="Z") for name in ("left out", "returned")]
        writer.write(Message("adjustment/report", 30, m.AdjustmentReport(rejected=out), "adjuster"))
        writer.write(Message("adjustment/report", 31, m.AdjustmentReport(returned=out[1:]), "adjuster"))
    assert known_points(Recording(path))[:, 2].tolist() == [100.0, 102.0, 104.0]


def test_node_takes_no_height_of_control_that_an_operator_refused(flown):
    """Before there are object points the ground is a plane at the height of control."""
    reader, heights = RecordingReader(flown), []
    for verdict in (False, True):
        node, tiles = Rectifier(), []
        for message in reader.sorted_messages([*node.inputs]):
            if message.topic == "point/object":
                continue
            if message.topic == "observation/control":
                message.body.role = m.GroundPoint.CHECK
                wrong_point = ground_point_message("wrong", (0.0, 0.0, 400.0), np.eye(3), "control")
                tiles += node.step(replace(message, body=wrong_point))
                if verdict:
                    no = m.Verdict(point="wrong", accepted=False)
                    tiles += node.step(Message("observation/verdict", message.stamp_ns, no, "desk"))
            tiles += node.step(message)
            if sum(tile.topic == "orthoimage/live" for tile in tiles) > 3:
                break
        heights.append({tile.body.z for tile in tiles if tile.topic == "orthoimage/live"})
    assert heights == [{400.0}, {0.0}]


def test_node_keeps_control_and_what_an_operator_said_of_it_with_another_camera(flown):
    """Control that stands there before the first camera counts, too."""
    reader = RecordingReader(flown)
    begin_ns = reader.first("configuration/strip").first_line_time_ns
    node, heights, camera, said = Rectifier(), [], None, False
    for name, height in (("good", 250.0), ("wrong", 400.0)):
        body = ground_point_message(name, (0.0, 0.0, height), np.eye(3), "control")
        list(node.step(Message("observation/control", 0, body, "survey")))
    list(node.step(Message("observation/verdict", 0, m.Verdict(point="wrong", accepted=False), "desk")))
    for message in reader.sorted_messages([*node.inputs]):
        if message.topic in ("point/object", "observation/control"):
            continue
        camera = message if message.topic == "configuration/camera" else camera
        heights += [tile.body.z for tile in node.step(message) if tile.topic == "orthoimage/live"]
        if not said and camera is not None and message.stamp_ns > begin_ns + 7 * 10**9:
            assert heights and set(heights) == {250.0}
            body = type(camera.body).FromString(camera.body.SerializeToString())
            body.lenses[0].focal_length_mm += 0.1
            list(node.step(replace(camera, body=body, stamp_ns=message.stamp_ns)))
            said, heights = True, []
        elif said and len(heights) > 3:
            break
    assert len(heights) > 3 and set(heights) == {250.0}


# ---- the node


def _tiles(path, version):
    newest = {}
    for message in RecordingReader(path).sorted_messages([f"orthoimage/{version}"]):
        newest[message.body.row, message.body.column] = message.body
    return newest


def test_node_grows_two_orthoimages(flown, simulated):
    """Tiles of both versions, and the final one shows roads where they are."""
    flight = simulated.simulation.flight
    live, final = _tiles(flown, "live"), _tiles(flown, "final")
    assert len(final) >= 4 and len(set(live) ^ set(final)) <= 3
    known = {}
    for name, tiles in (("live", live), ("final", final)):
        tile = next(iter(tiles.values()))
        assert tile.size == 256 and tile.encoding == "mono8" and tile.ccd == "N" and tile.strip == "S1"
        known[name] = sum((np.frombuffer(t.data, np.uint8) > 0).sum() for t in tiles.values()) * tile.gsd_m**2
        for (row, column), t in tiles.items():
            assert (t.x, t.y) == (column * 256 * t.gsd_m, -row * 256 * t.gsd_m)
    swath = flight.strips[0].lines * ground_sample(flight) * 800 * ground_sample(flight)
    assert 0.9 < known["final"] / swath < 1.15 and 0.9 < known["live"] / swath < 1.15


def test_node_gives_the_same_bytes_again(flown, folder):
    again = folder / "again.mcap"
    assert main(["process", str(flown), "-o", str(again), "--nodes", "rectifier", "-q"]) == 0
    for version in ("live", "final"):
        one, other = (
            [
                (t.stamp_ns, t.body.SerializeToString())
                for t in RecordingReader(p).sorted_messages([f"orthoimage/{version}"])
            ]
            for p in (flown, again)
        )
        assert one == other and len(one) > 5


def test_node_draws_with_the_camera_that_goes_with_the_orientations(flown):
    """Parameters in the reports move the final orthoimage as much as a camera that has them in its pixels."""
    reader = RecordingReader(flown)
    told = [m.ParameterEstimate(name="dc", value=0.05), m.ParameterEstimate(name="yp_N", value=0.1)]
    camera, n = estimated_camera(camera_from(reader.first("configuration/camera")), told)
    assert n == 2
    end_ns = reader.first("configuration/strip").first_line_time_ns + 8 * 10**9
    tiles = {}
    for name in ("stated", "reported", "calibrated"):
        node, newest = Rectifier(), {}
        for message in reader.sorted_messages([*node.inputs]):
            if message.stamp_ns > end_ns:
                break
            if message.topic == "configuration/camera" and name == "calibrated":
                message = replace(message, body=camera_message(camera))
            elif message.topic == "adjustment/report":
                del message.body.parameters[:]
                message.body.parameters.extend(told if name == "reported" else ())
            newest |= {(t.body.row, t.body.column): t.body for t in node.step(message) if t.topic.endswith("final")}
        newest |= {(t.body.row, t.body.column): t.body for t in node.finish() if t.topic.endswith("final")}
        tiles[name] = {key: np.frombuffer(body.data, np.uint8) for key, body in newest.items()}
    assert tiles["reported"].keys() == tiles["calibrated"].keys()
    for key, tile in tiles["calibrated"].items():
        np.testing.assert_array_equal(tiles["reported"][key], tile)
    pairs = [
        (tiles["stated"][key], tiles["reported"][key]) for key in tiles["stated"].keys() & tiles["reported"].keys()
    ]
    assert max((a != b)[(a > 0) | (b > 0)].mean() for a, b in pairs) > 0.3  # of the cells that are drawn


def test_node_begins_again_in_another_local_frame(flown):
    """Lines, poses and heights of before would lie in its orthoimage 11 km from where they are."""
    reader, node, tiles = RecordingReader(flown), Rectifier(), []
    end_ns = reader.first("configuration/strip").first_line_time_ns + 12 * 10**9
    project = None
    for message in reader.sorted_messages([*node.inputs]):
        if message.stamp_ns > end_ns:
            break
        project = message if message.topic == "configuration/project" else project
        tiles += node.step(message)
    assert project is not None and tiles and node._control
    list(node.step(replace(project, stamp_ns=end_ns)))  # said again
    assert node._control and node.images["live"].grid is not None
    body = type(project.body).FromString(project.body.SerializeToString())
    body.origin_latitude += 0.1
    list(node.step(replace(project, body=body, stamp_ns=end_ns)))
    assert not node._control and not node._heights
    assert not list(node.finish())


def test_node_draws_cameras_of_16_bits_as_it_draws_those_of_12(flown):
    reader = RecordingReader(flown)
    end_ns = reader.first("configuration/strip").first_line_time_ns + 8 * 10**9
    greys = {}
    for factor in (1, 16):
        node, newest = Rectifier(), {}
        for message in reader.sorted_messages([*node.inputs]):
            if message.stamp_ns > end_ns:
                break
            if message.topic.startswith("sensor/lines/"):
                message = replace(message, body=replace(message.body, pixels=message.body.pixels * np.uint16(factor)))
            newest |= {(t.body.row, t.body.column): t.body.data for t in node.step(message)}
        greys[factor] = {key: np.frombuffer(data, np.uint8).astype(int) for key, data in newest.items()}
    assert greys[1].keys() == greys[16].keys() and len(greys[1]) > 1
    for key, grey in greys[1].items():
        np.testing.assert_allclose(greys[16][key], grey, atol=1)


def test_node_draws_no_lines_by_poses_that_are_not_valid(flown):
    reader, node = RecordingReader(flown), Rectifier()
    begin = reader.first("configuration/strip").first_line_time_ns + 8 * 10**9
    lost, tiles = 0, set()
    for message in reader.sorted_messages([*node.inputs]):
        if message.topic.startswith(("trajectory/smoothed", "orientation")):
            continue
        if message.topic == "trajectory/filtered" and time_ns(message.body.timestamp) < begin:
            message.body.valid, lost = False, lost + 1
            turned = message.body.pose.orientation
            turned.x, turned.y, turned.z, turned.w = 0.0, 0.0, 1.0, 0.0
        made = list(node.step(message))
        assert not made or message.stamp_ns >= begin
        tiles |= {(tile.body.row, tile.body.column) for tile in made if tile.topic == "orthoimage/live"}
    list(node.finish())
    assert node.counters["poses not valid"] == lost > 10 and tiles
    without = node.counters["live lines without orientation"]
    assert without == pytest.approx(8.0 * reader.last("configuration/strip").line_rate_hz, rel=0.05)
    assert not node.counters["malformed"] and not node.counters["failed"]


def test_node_counts_what_it_cannot_use(flown):
    node = Rectifier()
    assert node.state() == "waiting for configuration"
    reader = RecordingReader(flown)
    end_ns = reader.first("configuration/strip").first_line_time_ns + 5e9
    for message in reader.sorted_messages(list(node.inputs)):
        if message.stamp_ns > end_ns:
            break
        list(node.step(message))
        if message.topic == "sensor/lines/N":
            list(node.step(message))  # twice
            block = replace(message.body, pixels=message.body.pixels[:, :5])
            list(node.step(Message(message.topic, message.stamp_ns, block)))
            list(node.step(Message("sensor/lines/Q", message.stamp_ns, message.body)))
            list(node.step(Message(message.topic, message.stamp_ns, replace(message.body, strip="S7"))))
    assert node.state() == "running" and list(node.finish())
    assert node.counters["lines twice or late"] > 100 and node.counters["unknown strip"] > 10
    assert node.counters["malformed"] > 20 and not node.counters["failed"]
    for bad in ({"samples": 2}, {"publish_s": 0.0}, {"budget_mb": -1.0}):
        with pytest.raises(ValueError, match="wanted"):
            Rectifier(**bad)


@pytest.mark.study
def test_a_small_budget_does_not_wait_for_the_final_orientation(flown):
    node = Rectifier(budget_mb=0.05)
    out = [t for message in RecordingReader(flown).sorted_messages(list(node.inputs)) for t in node.step(message)]
    assert node.counters["final lines without refined orientation"] > 100
    assert any(t.topic == "orthoimage/final" for t in out)


def test_scene_lays_tiles_on_the_ground():
    canvas = Notebook()
    scene = Scene(canvas)
    messages = flight_messages(seconds=14.0, points=20)
    for message in messages:
        scene.take(message)
    data = np.zeros((8, 8), dtype=np.uint8)
    data[2:4, 1:6] = 100
    tile = m.GroundTile(size=8, gsd_m=2.0, x=100.0, y=50.0, encoding="mono8", data=data.tobytes(), row=3, column=-2)
    scene.take(Message("orthoimage/final", messages[-1].stamp_ns, tile))
    scene.draw()
    corners, grey = canvas.drawn["mosaic/final/3_-2"]
    assert grey.shape == (2, 5) and (grey > 100).all()
    wanted = np.array([(102, 46), (112, 46), (112, 42), (102, 42)]) - scene.state.origin[:2]
    assert np.allclose(corners[:, :2], wanted) and canvas.layouts[-1].mosaic
    tile.data = b"123"
    with pytest.raises(ValueError, match="3 bytes"):
        scene.take(Message("orthoimage/final", messages[-1].stamp_ns, tile))


def test_poses_of_two_lenses_at_one_time_are_refused(tmp_path):
    """Of a table in the local frame the first one was taken without a word; a row that comes twice is one pose."""
    rows = [f"{100 + 0.1 * k:.6f},{7.0 * k:.4f},0.0000,1000.0000,0.0,0.0,0.0" for k in range(10)]
    head = "time_s,X_m,Y_m,Z_m,omega_deg,phi_deg,kappa_deg"
    path = tmp_path / "poses.csv"
    path.write_text("\n".join([head, *rows, rows[3], ""]))
    frame = LocalFrame(48.0, 11.0, 0.0, "local")
    assert len(read_poses_of_strips(path, frame).of(None)[2]) == 10
    for other in (
        "100.300000,21.0000,0.5000,1000.0000,0.0,0.0,0.0",
        "100.300000,21.0000,0.0000,1000.0000,0.0,14.0,0.0",
    ):
        path.write_text("\n".join([head, *rows, other, ""]))
        with pytest.raises(UserError, match=r"poses\.csv:12: time_s: 100\.300000 comes twice with two poses"):
            read_poses_of_strips(path, frame).of(None)


def test_a_table_of_two_strips_gives_each_its_own_rows(tmp_path):
    """In the local frame, too, where all rows counted by their times alone."""
    start, path = 1_700_000_000_000_000_000, tmp_path / "two.mcap"
    with RecordingWriter(path) as writer:
        project = m.Project(name="two", crs="local", origin_latitude=48.0, origin_longitude=11.0)
        writer.write(Message("configuration/project", start, project, "x"))
        for strip in ("S1", "S2", "S3"):
            body = m.Strip(id=strip, first_line_time_ns=start, line_rate_hz=10.0, lines=10)
            writer.write(Message("configuration/strip", start, body, "x"))
    table, head = tmp_path / "poses.csv", "strip,time_s,X_m,Y_m,Z_m,omega_deg,phi_deg,kappa_deg"
    rows = {s: [f"{s},{start // 10**9 + k / 10:.3f},{7.0 * k:.1f},0,{z},0,0,0" for k in range(10)]
            for s, z in {"S1": 1000, "S2/L2": 1200, "": 900}.items()}  # fmt: skip
    table.write_text("\n".join([head, *rows["S1"], *rows["S2/L2"], *rows[""], ""]))
    recording = Recording(path)
    found = OfTable(recording, table, lens="L2")
    time_s = np.arange(10) / 10 + (start - found.reference_ns) * 1e-9
    for strip, height in {"S1": 1000.0, "S2": 1200.0}.items():
        of_strip = found(strip)
        assert of_strip is not None and of_strip.covers(time_s).all()
        np.testing.assert_allclose(of_strip.at(time_s)[0][:, 2], height, atol=1e-6)
    assert found("S3") is None and found.missing == ["S3"]
    with pytest.raises(UserError, match=r"poses\.csv: strip: no rows of 'S3', there are: S1, S2/L2$"):
        OfTable(recording, table, ["S3"], "L2")
    table.write_text("\n".join([head, *(row.replace("S1,", "A,") for row in rows["S1"]), ""]))
    with pytest.raises(UserError, match=r"poses\.csv: strip: A, wanted one of those of .*two\.mcap: S1, S2, S3$"):
        OfTable(recording, table)
    bad = rows["S2/L2"][3].replace(",0,1200,", ",nothing,1200,")
    table.write_text("\n".join([head, *rows["S1"], *rows["S2/L2"][:3], bad, ""]))
    with pytest.raises(UserError, match=r"poses\.csv:15: Y_m: 'nothing' is not a number"):
        OfTable(recording, table)
    table.write_text(
        "\n".join([head, *rows["S1"], *rows["S2/L2"], rows["S2/L2"][2].replace(",0,1200,", ",5,1200,"), ""])
    )
    with pytest.raises(UserError, match=r"poses\.csv:22: time_s: .* comes twice with two poses"):
        OfTable(recording, table, lens="L2")


def test_of_several_lenses_the_one_that_looks_down_is_rectified(tmp_path, capsys):
    """The first of them was, which looks forward: all lines lie in the middle of the image of their own lens."""
    flight, words = tmp_path / "triplet.mcap", ["--gsd", "1000", "-o", str(tmp_path / "ortho.tif")]
    simulated = ["simulate", "-o", str(flight), "--satellite", "alos-prism-small", "--images", "--points", "34", "-q"]
    assert main(simulated) == 0
    assert main(["rectify", str(flight), *words]) == 0
    assert " lines of N, measured orientation" in capsys.readouterr().out
