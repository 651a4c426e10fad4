"""Satellite scenes as a recording: the on-line adjustment against the batch and against the truth, and bad input."""

from __future__ import annotations

import json
import re
import shutil
import warnings

import numpy as np
import pytest
import rasterio
from satellite_scenes import Truth, write_dimap2

from triline.nodes.adjuster.adjuster import Adjuster
from triline.nodes.batch.simulated_scenes import SceneSimulation, simulated_recording, write_with_sensors
from triline.nodes.cli import main
from triline.nodes.formats.block_recording import block_from_messages
from triline.nodes.formats.scene_block import read_scene_block
from triline.nodes.formats.scene_recording import local_block
from triline.nodes.recording.reader import RecordingReader
from triline.solver.adjustment.adjustment import adjust
from triline.solver.adjustment.block_data import network_from_block
from triline.solver.adjustment.snooping import snoop
from triline.solver.models.dgr import DgrOptions
from triline.solver.simulation.orbital_imagery import render, texture_of


def on_line(messages, **options):
    """Points of the adjuster: name -> (xyz, covariance), and the node."""
    node = Adjuster(**({"self_calibration": "none"} | options))  # as the batch beside it
    points = {}
    found = [out for message in messages if message.topic in node.inputs for out in node.step(message)]
    for out in [*found, *node.finish()]:
        if out.topic == "point/object":
            body = out.body
            points[body.point] = np.array([body.x, body.y, body.z]), np.reshape(body.covariance, (3, 3))
    return points, node


def batch_of(messages):
    """Points of the batch of the same messages, name -> xyz; its network and solution."""
    block = block_from_messages(messages, "recording")
    network = network_from_block(block)
    solution = adjust(network, DgrOptions.from_settings(block.apriori.trajectory))
    return dict(zip(network.point_ids, solution.state.points_l, strict=True)), network, solution


def truth_of(messages):
    return {m.body.point: np.array([m.body.x, m.body.y, m.body.z]) for m in messages if m.topic == "truth/point"}


def nees_of(messages, points):
    """Squared errors of the points without known coordinates by their covariance, a coordinate."""
    truth = truth_of(messages)
    known = {m.body.point for m in messages if m.topic == "observation/control"}
    free = [id for id in points if id not in known]
    return [(e := points[id][0] - truth[id]) @ np.linalg.solve(points[id][1], e) / 3 for id in free]


@pytest.mark.parametrize(
    ("satellite", "overpasses"),
    [
        ("alos-prism", 1),
        ("spot5-hrs", 1),
        pytest.param("aster-vnir", 1, marks=pytest.mark.study),  # two lenses as of SPOT
        pytest.param("moms-02", 1, marks=pytest.mark.study),  # three as of PRISM
        ("eros-a1", 2),
    ],
)
def test_on_line_is_as_the_batch(satellite, overpasses):
    """Lenses minutes apart, overpasses days apart, a strip each: all points, within hundredths of a sigma of the batch.

    EROS-A1 turns back while it images, more slowly than the ground goes by.
    """
    messages, _ = simulated_recording(SceneSimulation(satellite, points=60, check=10, overpasses=overpasses))
    points, node = on_line(messages, model="dgr")
    assert not node.counters["failed"] and len(points) == 60
    batch = batch_of(messages)[0]
    off = np.array([np.abs(xyz - batch[id]) / np.sqrt(np.diag(C)) for id, (xyz, C) in points.items()])
    assert off.mean() < 0.01 and off.max() < 0.05
    # the true orientation is far from the measured one: without corrections points are tens of metres off
    assert 0.5 < np.mean(nees_of(messages, points)) < 2.0


def test_one_lens_in_one_overpass():
    """EROS-A1: what nobody else sees has no place; control has, as in the batch, and orients the strip."""
    messages, _ = simulated_recording(SceneSimulation("eros-a1", points=40, check=10))
    points, node = on_line(messages, model="dgr")
    assert set(points) == {f"P{k}" for k in range(9)} and node.counters["too few looks"] == 31
    batch = batch_of(messages)[0]
    assert max(np.abs(xyz - batch[id]).max() / np.sqrt(np.diag(C)).min() for id, (xyz, C) in points.items()) < 0.01


@pytest.mark.study
def test_nine_lenses_leave_out_the_looks_that_the_batch_leaves_out():
    """MISR: two looks at the limit of the test. The batch with data snooping refuses both, and agrees in all points."""
    messages, _ = simulated_recording(SceneSimulation("misr"))
    points, _ = on_line(messages, model="dgr")
    _, network, solution = batch_of(messages)
    snooped = snoop(solution)
    assert len(snooped.rejected) == 2 and all(abs(rejected.w) < 3.6 for rejected in snooped.rejected)
    batch = dict(zip(network.point_ids, snooped.solution.state.points_l, strict=True))
    assert max((np.abs(xyz - batch[id]) / np.sqrt(np.diag(C))).max() for id, (xyz, C) in points.items()) < 0.02


@pytest.mark.parametrize("options", [{"model": "ppm"}, {"model": "lim"}, {"model": "dgr", "self_calibration": "lens"}],
                         ids=["ppm", "lim", "lens"])  # fmt: skip
def test_other_models_and_lens_sets(options):
    messages, _ = simulated_recording(SceneSimulation("spot5-hrs", points=60, check=10, seed=4))
    points, node = on_line(messages, **options)
    assert len(points) == 60 and not node.counters["failed"]
    assert 0.4 < np.mean(nees_of(messages, points)) < 2.5


@pytest.mark.study
@pytest.mark.parametrize("satellite", ["alos-prism", "spot5-hrs", "aster-vnir", "misr"])
def test_errors_are_as_large_as_their_sigmas(satellite):
    """NEES over seeds."""
    found = []
    for seed in range(10):
        messages, _ = simulated_recording(SceneSimulation(satellite, points=60, check=10, seed=seed))
        found += nees_of(messages, on_line(messages, model="dgr")[0])
    assert 0.6 < np.mean(found) < 1.6


def test_the_earth_is_curved_in_the_local_frame():
    """The origin lies on the ground in the middle; points at the edge of the swath of MISR lie far below its plane."""
    messages, _ = simulated_recording(SceneSimulation("misr", points=60, check=10))
    truth = np.array(list(truth_of(messages).values()))
    assert np.linalg.norm(truth[:, :2].mean(axis=0)) < 60_000
    far = np.linalg.norm(truth[:, :2], axis=1)
    drop = far**2 / (2 * 6.37e6)
    assert drop.max() > 1000
    # what is left is relief (0 to 1500 m), about the height of the origin
    assert np.abs(truth[:, 2] + drop).max() < 1200


def test_cameras_and_strips(tmp_path, capsys):
    folder = tmp_path / "triplet"
    assert main(["simulate", "-q", "-o", str(folder), "--satellite", "alos-prism", "--points", "40"]) == 0
    block = local_block(read_scene_block(folder))
    assert [strip.id for strip in block.strips] == ["scene/F", "scene/N", "scene/B"]
    assert [lens.id for lens in block.camera.lenses] == ["F", "N", "B"]
    assert block.camera.lines[0].chips == (0, 4960, 9920, 14880)
    assert block.camera.lenses[0].focal_length_mm == 1939.0
    recording = tmp_path / "x.mcap"
    assert main(["import", str(folder), "-o", str(recording)]) == 0
    capsys.readouterr()
    assert main(["info", str(recording), "--json"]) == 0
    assert "scene/N" in capsys.readouterr().out
    result = tmp_path / "result"
    assert main(["adjust", str(recording), "--model", "dgr", "-q", "-o", str(result)]) == 0
    assert json.loads((result / "result.json").read_text())["chi_square_test"]["passed"]


def test_bad_input(tmp_path, capsys):
    folder = tmp_path / "pair"
    assert main(["simulate", "-q", "-o", str(folder), "--satellite", "spot5-hrs", "--points", "40"]) == 0
    affine = shutil.copytree(folder, tmp_path / "affine")
    project = affine / "project.toml"
    project.write_text(project.read_text().replace('[scenes."scene"]', '[scenes."scene"]\nmodel = "affine"'))
    out = str(tmp_path / "x.mcap")
    for arguments, match in (
        ([str(affine)], "model affine, wanted the rigorous one: a recording holds orbit and attitude"),
        ([str(folder), "--date", "2020-01-01"], "--date does not go with block of satellite scenes"),
        ([str(folder), "--camera", "si-100"], "--camera does not go with block of satellite scenes"),
    ):
        capsys.readouterr()
        assert main(["import", *arguments, "-o", out]) != 0
        error = capsys.readouterr().err
        assert match in error and error.count("\n") == 1


@pytest.mark.parametrize(
    ("back", "match"),
    [
        ({"samples": 400}, "scene aft of camera 'pleiades' has 400 samples, scene fore 500"),
        ({"gsd": 8e-6}, "of camera 'pleiades' has detectors that look 83.2 px beside those of the others"),
        ({}, None),
    ],
)
def test_scenes_of_one_camera_share_its_pixels(back, match, tmp_path, capsys):
    """Those of two cameras of one name were averaged, and the focal length was that of the first, without a word."""
    lines = ["[project]"]
    for name, pitch, other in (("fore", 18.0, {}), ("aft", -18.0, back)):
        truth = {"lines": 2000, "samples": 500, "gsd": 4e-6} | other
        write_dimap2(
            tmp_path / f"{name}.xml",
            Truth(**truth, tilt_deg=(0.0, pitch, 0.0), phase_deg=40.0 - 0.1133 * pitch),
        )
        lines += [f"[scenes.{name}]", f'metadata = "{name}.xml"', 'camera = "pleiades"']
    (tmp_path / "project.toml").write_text("\n".join([*lines, ""]))
    rows = [f"{point},{name},,{line},100" for point, line in (("P", 900), ("Q", 990)) for name in ("fore", "aft")]
    (tmp_path / "image_points.csv").write_text("\n".join(["point,strip,ccd,line,sample", *rows, ""]))
    code = main(["import", str(tmp_path), "-o", str(tmp_path / "x.mcap")])
    said = capsys.readouterr()
    if match is None:
        assert code == 0 and "px beside" not in said.out
    else:
        assert code == 1 and match in said.err and "wanted another camera for it" in said.err
        assert said.err.count("\n") == 1


@pytest.fixture(scope="module")
def pictures(tmp_path_factory):
    """A folder of scenes of two lenses, and their images as TIFF beside it."""
    folder = tmp_path_factory.mktemp("pictures")
    _, sensors = write_with_sensors(folder / "pair", SceneSimulation("spot5-hrs-small", seed=2))
    frame = local_block(read_scene_block(folder / "pair")).frame
    texture = texture_of(sensors[0], 2)
    for name, sensor in zip("FB", sensors, strict=True):
        pixels = render(sensor, frame, texture, frame.height_m, np.random.default_rng(3))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            shape = {"width": pixels.shape[1], "height": pixels.shape[0], "count": 1, "dtype": "uint16"}
            with rasterio.open(folder / f"{name}.tif", "w", driver="GTiff", **shape) as image:
                image.write(pixels, 1)
    return folder


def matched_points(made, out):
    """Number of points that are matched and adjusted in a recording of scenes; the result goes beside it."""
    settings, points = out.with_name("dgr.toml"), out.with_name("points.csv")
    settings.write_text('[adjuster]\nmodel = "dgr"\n')
    nodes = ["--nodes", "matcher,adjuster", "--config", str(settings)]
    assert main(["process", "-q", str(made), *nodes, "-o", str(out)]) == 0
    assert main(["export", str(out), "--points", str(points)]) == 0
    return sum("-M" in row.split(",")[0] for row in points.read_text().splitlines())


def test_pictures_of_scenes(pictures, tmp_path, capsys):
    """A user's scenes with their images: imported, matched between the lenses, adjusted, rectified."""
    made, out = tmp_path / "pair.mcap", tmp_path / "out.mcap"
    lines = f"scene/F={pictures / 'F.tif'},scene/B={pictures / 'B.tif'}"
    assert main(["import", str(pictures / "pair"), "--lines", lines, "-o", str(made)]) == 0
    assert matched_points(made, out) > 40
    ortho = ["--ccd", "F", "--strip", "scene/F", "--gsd", "400", "-q", "-o", str(tmp_path / "f.tif")]
    assert main(["rectify", str(out), *ortho]) == 0
    with rasterio.open(tmp_path / "f.tif") as image:
        assert (image.read(1) > 0).sum() > 25_000


@pytest.mark.parametrize("kept", ["", "scene,F,"], ids=["none", "in one lens"])
def test_pictures_need_no_image_points(kept, pictures, tmp_path, capsys):
    """As `triline new scenes` leaves the table; it was refused, and a lens without points was not one of the block."""
    folder, made, out = tmp_path / "pair", tmp_path / "pair.mcap", tmp_path / "out.mcap"
    shutil.copytree(pictures / "pair", folder)
    header, *rows = (folder / "image_points.csv").read_text().splitlines()
    left = [row for row in rows if kept and kept in row]
    (folder / "image_points.csv").write_text("\n".join([header, *left, ""]))
    lines = f"scene/F={pictures / 'F.tif'},scene/B={pictures / 'B.tif'}"
    assert main(["import", str(folder), "--lines", lines, "-o", str(made), "-q"]) == 0
    assert matched_points(made, out) > 40


def named_images(pictures, folder, more=""):
    """A copy of the folder whose scene names its images, as `triline match` wants it; image lines in two bands."""
    shutil.copytree(pictures / "pair", folder)
    for name in "FB":
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with rasterio.open(pictures / f"{name}.tif") as image:
                pixels, profile = image.read(1), image.profile
            with rasterio.open(folder / f"{name}.tif", "w", **profile | {"count": 2}) as image:
                image.write(np.stack([np.zeros_like(pixels), pixels]))
    project = folder / "project.toml"
    named = f'image = {{ F = "F.tif", B = "B.tif" }}\nband = "2"\n{more}'
    text, n = re.subn(r"(\[scenes\.\W?scene\W?\]\n)", rf"\1{named}", project.read_text())
    assert n == 1
    project.write_text(text)
    return f"scene/F={folder / 'F.tif'},scene/B={folder / 'B.tif'}"


@pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
def test_images_that_the_project_names_are_told_and_taken_with_their_band(pictures, tmp_path, capsys):
    """Nothing said that their lines are missing, and `--lines` took another band than `match`."""
    folder, made = tmp_path / "pair", tmp_path / "pair.mcap"
    lines = named_images(pictures, folder)
    assert main(["import", str(folder), "-o", str(made)]) == 0
    note = f"images of the scenes are not in the recording: --lines {lines} makes image lines of them"
    assert note in capsys.readouterr().out
    assert main(["import", str(folder), "--lines", lines, "-o", str(made)]) == 0
    assert "makes image lines" not in capsys.readouterr().out
    sent = RecordingReader(made).sorted_messages(["sensor/lines/F"])
    with rasterio.open(pictures / "F.tif") as image:
        np.testing.assert_array_equal(np.concatenate([message.body.pixels for message in sent]), image.read(1))


@pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
def test_parts_of_scenes_make_no_image_lines(pictures, tmp_path, capsys):
    folder, made = tmp_path / "pair", tmp_path / "pair.mcap"
    lines = named_images(pictures, folder, "first_pixel = [0, 10]\n")
    assert main(["import", str(folder), "-o", str(made)]) == 0
    said = capsys.readouterr().out
    assert f"{folder / 'F.tif'}: a part of scene scene/F (first_pixel), of which no image lines can be made" in said
    assert "--lines" not in said
    assert main(["import", str(folder), "--lines", lines, "-o", str(made)]) == 1
    told = f"{folder / 'F.tif'}: a part of scene scene/F (first_pixel), wanted an image of all its lines\n"
    assert capsys.readouterr().err.endswith(told)


@pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
def test_grey_values_that_do_not_fit_are_told(pictures, tmp_path, capsys):
    """As of the images of a flight."""
    with rasterio.open(pictures / "F.tif") as image:
        pixels = image.read(1)
    low, high = np.percentile(pixels, (20, 70))
    arguments = ["--lines", f"scene/F={pictures / 'F.tif'}", "--grey-range", str(low), str(high)]
    assert main(["import", str(pictures / "pair"), *arguments, "-o", str(tmp_path / "x.mcap")]) == 0
    said = capsys.readouterr().out
    assert f"F.tif: {(pixels < low).sum()} values below the range, taken as 0\n" in said
    assert f"F.tif: {(pixels > high).sum()} values above the range, taken as 65535\n" in said


@pytest.mark.parametrize(
    ("lines", "more", "match"),
    [
        ("scene/N={F}", [], "scene 'scene/N' is not one of scene/F, scene/B, wanted SCENE=FILE for each"),
        ("scene={F}", [], "scene 'scene' is not one of scene/F, scene/B"),
        ("scene/F={small}", [], "3 lines of 4 samples, wanted 150 of 300 as scene scene/F has"),
        ("scene/F=nothing.tif", [], "nothing.tif: no such file"),
        ("scene/F={F}", ["--strip", "S"], "wanted no --line-times, --first-time, --strip"),
    ],
)
def test_pictures_that_do_not_fit(lines, more, match, pictures, tmp_path, capsys):
    small = tmp_path / "small.tif"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with rasterio.open(small, "w", driver="GTiff", width=4, height=3, count=1, dtype="uint16") as image:
            image.write(np.ones((3, 4), np.uint16), 1)
    given = lines.format(F=pictures / "F.tif", small=small)
    assert main(["import", str(pictures / "pair"), "--lines", given, *more, "-o", str(tmp_path / "x.mcap")]) != 0
    error = capsys.readouterr().err
    assert match in error and error.count("\n") == 1 and not (tmp_path / "x.mcap").exists()
