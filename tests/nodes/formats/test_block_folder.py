"""Block folders: values, errors with their place, round trips, coordinate systems."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
from block_writer import write_block
from places import BLOCKS, needs_blocks
from small_block import FILES, simulated_block, write_files

from triline.nodes.cli import main
from triline.nodes.cli.adjust import by_recording, models_of
from triline.nodes.errors import UserError
from triline.nodes.formats.block_folder import read_block
from triline.nodes.formats.block_messages import block_messages, not_carried
from triline.nodes.formats.block_recording import block_from_messages
from triline.nodes.formats.projection import refuse_missing_grids, unknown_heights
from triline.solver.adjustment.block_data import network_from_block
from triline.solver.adjustment.joined_block import join_blocks
from triline.solver.adjustment.options_by_strip import slow_errors_of_strip
from triline.solver.geometry.rotation import angles_from_matrix, matrix_from_quaternion
from triline.solver.models.lim import LimOptions
from triline.solver.models.wander import WanderOptions


def test_values_of_a_hand_written_folder(tmp_path):
    block = read_block(write_files(tmp_path))
    assert block.name == "hand" and block.apriori.image_sigma_px == 0.4
    assert block.apriori.trajectory == {"offset_sigma_m": (0.1, 0.2, 0.3)}
    strip = block.strips[0]
    assert (strip.id, strip.lines, strip.line_rate_hz) == ("S1", 2001, 200.0)
    np.testing.assert_allclose(strip.trajectory.position_l[3], [210.0, 1.5, 1000.0])
    angles = np.degrees(angles_from_matrix(matrix_from_quaternion(strip.trajectory.quaternion[3])))
    np.testing.assert_allclose(angles, [0.1, -0.2, 0.53], atol=1e-12)
    assert block.point_ids == ("G1", "G2", "G3", "G4", "T1")
    np.testing.assert_allclose(block.image.sigma_px, [0.5, 0.4, 0.4])
    np.testing.assert_allclose(block.image.time_s, [100 + 500.25 / 200, 104.5, 100 + 901 / 200])
    assert block.image_name(2) == ("T1", "S1", "N")
    sigma = block.ground.sigma_m
    np.testing.assert_allclose(sigma[0], [0.02, 0.03, 0.04])
    assert np.isinf(sigma[1, 2]) and np.isinf(sigma[2, :2]).all() and sigma[2, 2] == 0.05
    assert block.ground.role == ("control", "planimetric", "height", "check")
    assert any("without height" in note for note in block.notes)


def test_columns_in_any_order_and_unknown_ones(tmp_path):
    text = "colour ,sample , line,ccd ,strip,point \nred,499.5,500.25,F,S1,G1\nblue, 510 ,900, N ,S1, G1 \n"
    block = read_block(write_files(tmp_path, image_points=text))
    assert [block.image_name(i) for i in range(2)] == [("G1", "S1", "F"), ("G1", "S1", "N")]
    np.testing.assert_allclose(block.image.sample, [499.5, 510.0])
    np.testing.assert_allclose(block.image.sigma_px, 0.4)
    assert "image_points.csv: column 'colour' is not known and was ignored" in block.notes


def test_project_file_may_be_absent(tmp_path):
    block = read_block(write_files(tmp_path, project=None))
    assert block.name == tmp_path.name and block.apriori.image_sigma_px == 0.3 and not block.apriori.trajectory


def test_byte_order_mark_crlf_and_blank_lines(tmp_path):
    text = "\ufeff" + FILES["image_points.csv"].replace("\n", "\r\n\r\n")
    folder = write_files(tmp_path)
    (folder / "image_points.csv").write_bytes(text.encode("utf-8"))
    assert len(read_block(folder).image) == 3


@pytest.mark.parametrize("measured, told", [("g1", True), ("G01", True), ("G1.0", True), ("G10", False), ("G1", False)])
def test_names_that_differ_by_capitals_or_zeros_are_told(tmp_path, measured, told):
    """As where a spreadsheet has made numbers of the names in one of the files: control lost its image points."""
    image = FILES["image_points.csv"].replace("G1", measured)
    notes = "\n".join(read_block(write_files(tmp_path, image_points=image)).notes)
    said = f"names differ by capitals or zeros alone, and count as different points: G1 and {measured}"
    assert ((said in notes), ("names differ" in notes)) == (told, told)


@pytest.mark.parametrize("crs", ["EPSG:32632", "EPSG:4326"])
def test_known_points_of_another_place_are_refused(tmp_path, crs):
    """As of a wrong zone, and with X and Y exchanged: `check` said that the block is complete."""
    x, y, one_m = (691000.0, 5334000.0, 1.0) if crs == "EPSG:32632" else (11.5, 48.1, 1e-5)
    head, *rows = (line.split(",") for line in FILES["trajectory.csv"].splitlines())
    moved = ([s, t, str(x + one_m * float(a)), str(y + one_m * float(b)), *more] for s, t, a, b, *more in rows)
    files = {
        "project": FILES["project.toml"].replace("local", crs),
        "trajectory": "\n".join(",".join(row) for row in (head, *moved)),
        "image_points": "point,strip,ccd,line,sample\nG1,S1,F,500,500\n",
    }

    def points_at(x, y):
        ground = f"{GROUND.splitlines()[0]}\nG1,{x},{y},100,1,1,1,control\n"
        return len(read_block(write_files(tmp_path, ground_points=ground, **files)).ground)

    far = r"ground_points\.csv: no point lies within \d+ km of the trajectories, wanted coordinates in 'EPSG:\d+'"
    assert points_at(x + 40_000.0 * one_m, y) == 1
    with pytest.raises(UserError, match=far + "$"):
        points_at(x - 440_000.0 * one_m, y)
    with pytest.raises(UserError, match=far + "; X and Y are exchanged$"):
        points_at(y, x)


TRAJECTORY = FILES["trajectory.csv"]
GROUND = FILES["ground_points.csv"]
IMAGE = FILES["image_points.csv"]
BAD = {
    "missing column": (
        {"image_points": "point,strip,ccd,line\nG1,S1,F,1\n"},
        "image_points.csv:1: sample: column missing",
    ),
    "tabs": ({"image_points": "point\tstrip\tccd\tline\tsample\nG1\tS1\tF\t1\t2\n"}, "is the separator a comma?"),
    "column twice": (
        {"image_points": "point,strip,ccd,line,sample,line\nG1,S1,F,1,2,3\n"},
        "line: this column comes twice",
    ),
    "word": ({"image_points": IMAGE.replace("500.25", "5oo")}, "image_points.csv:2: line: '5oo' is not a number"),
    "nan": ({"image_points": IMAGE.replace("901", "NaN")}, "image_points.csv:4: line: NaN, wanted a number"),
    "infinite": ({"trajectory": TRAJECTORY.replace("70.0", "inf")}, "trajectory.csv:3: X_m: inf, wanted a number"),
    "blank": ({"trajectory": TRAJECTORY.replace(",70.0,", ",,")}, "trajectory.csv:3: X_m: missing, wanted a number"),
    "short row": ({"image_points": IMAGE + "T2,S1\n"}, "image_points.csv:5: ccd: missing, wanted a name"),
    "long row": ({"image_points": IMAGE + "T2,S1,N,1,2,0.3,9\n"}, "image_points.csv:5: sigma_px: 7 values, wanted 6"),
    "sigma zero": (
        {"image_points": IMAGE.replace("0.5", "0")},
        "image_points.csv:2: sigma_px: 0, wanted a number above 0",
    ),
    "no rows": ({"image_points": "point,strip,ccd,line,sample\n"}, "no rows below the header"),
    "empty file": ({"image_points": ""}, "image_points.csv: empty, wanted a header with point,strip,ccd,line,sample"),
    "binary": ({"image_points": "\0\1\2\3\n"}, "not a text table"),
    "role": (
        {"ground_points": GROUND.replace("check", "chek")},
        "ground_points.csv:5: role: 'chek', wanted one of control",
    ),
    "sigma of control": (
        {"ground_points": GROUND.replace("0.03", "0")},
        "ground_points.csv:2: sigma_Y_m: 0, wanted a number above 0",
    ),
    "height of height point": ({"ground_points": GROUND.replace(",110,", ",,")}, "ground_points.csv:4: Z_m: missing"),
    "duplicated ground point": (
        {"ground_points": GROUND.replace("G4", "G1")},
        "ground_points.csv:5: point: G1 comes twice",
    ),
    "duplicated strip": ({"strips": FILES["strips.csv"] + "S1,1,1,1\n"}, "strips.csv:3: strip: S1 comes twice"),
    "strip without trajectory": (
        {"strips": FILES["strips.csv"] + "S9,1,1,1\n"},
        "strips.csv:3: strip: no trajectory of S9",
    ),
    "line rate": (
        {"strips": FILES["strips.csv"].replace("200.0", "-5")},
        "strips.csv:2: line_rate_hz: -5, wanted a number above 0",
    ),
    "strip elsewhere": (
        {"strips": FILES["strips.csv"].replace("100.0", "900")},
        "strips.csv:2: first_line_time_s: lines from 900.000",
    ),
    "strip of no flight": (
        {"strips": FILES["strips.csv"].replace("2001", "201e18")},
        "strips.csv:2: lines: 2.01e+20, 200 a second: more than a day",
    ),
    "name that no file can have": (
        {"strips": f"strip,first_line_time_s,line_rate_hz,lines,line_times\nS1,,,,{'9' * 400}\n"},
        "strips.csv:2: line_times: no file '999",
    ),
    "time backwards": (
        {"trajectory": TRAJECTORY.replace("S1,101,", "S1,99.5,")},
        "trajectory.csv:4: time_s: 99.500000 of strip S1 does not come after 100.000000",
    ),
    "one pose": ({"trajectory": "\n".join(TRAJECTORY.splitlines()[:2])}, "S1 has one sample, wanted at least 2"),
    "unknown CRS": (
        {"project": '[project]\ncrs = "EPSG:999999"\n'},
        "project.toml: project.crs: PROJ does not know the CRS",
    ),
    "vertical CRS": (
        {"project": '[project]\ncrs = "EPSG:5773"\n'},
        "project.toml: project.crs: crs 'EPSG:5773': a vertical system, wanted a projected or geographic one (with",
    ),
    "geocentric CRS": (
        {"project": '[project]\ncrs = "EPSG:4978"\n'},
        "trajectory.csv:2: X_m: [0.0, 1.5, 1000.0] lies outside the area of 'EPSG:4978'",
    ),
    "TOML": ({"project": "[project\n"}, "project.toml: not valid TOML"),
    "TOML type": (
        {"project": "[apriori]\nimage_sigma_px = 'x'\n"},
        "project.toml: apriori.image_sigma_px: 'x', wanted a number above 0",
    ),
    "TOML triple": (
        {"project": "[trajectory]\nshift_sigma_deg = [1, 2]\n"},
        "project.toml: trajectory.shift_sigma_deg: [1, 2], wanted 3 positive numbers",
    ),
    "sigma of zero": (
        {"project": "[trajectory]\nfirst_sigma_m = 0\n"},
        "project.toml: trajectory.first_sigma_m: 0, wanted a number above 0",
    ),
    "wander below zero": (
        {"project": "[trajectory]\nwander_sigma_m = [0, 0, -1]\n"},
        "project.toml: trajectory.wander_sigma_m: [0, 0, -1], wanted 3 numbers of at least 0",
    ),
    "wander below zero, one number": (
        {"project": "[trajectory]\nwander_sigma_deg = -1\n"},
        "project.toml: trajectory.wander_sigma_deg: -1, wanted a number of at least 0",
    ),
    "correlation time of no length": (
        {"project": "[trajectory]\nwander_time_s = -1\n"},
        "project.toml: trajectory.wander_time_s: -1, wanted a number above 0",
    ),
    "correlation time in words": (
        {"project": "[trajectory]\nattitude_wander_time_s = 'x'\n"},
        "project.toml: trajectory.attitude_wander_time_s: 'x', wanted a number above 0",
    ),
    "file missing": ({"strips": None}, "no strips.csv; a block folder has"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input_is_named_with_its_place(tmp_path, case):
    changed, wanted = BAD[case]
    with pytest.raises(UserError) as error:
        read_block(write_files(tmp_path, **changed))
    assert wanted in str(error.value)
    assert "\n" not in str(error.value)


def test_zeros_say_that_nothing_wanders(tmp_path):
    """And a recording of the block says so, too: what it does not state the adjuster would take to be a little."""
    project = "[trajectory]\nwander_sigma_m = 0\nwander_sigma_deg = [0, 0, 0]\n"
    block = read_block(write_files(tmp_path, project=project))
    stated = block.apriori.trajectory
    slow = WanderOptions.from_settings(stated).slow
    assert not any((*slow.wander_m, *slow.wander)) and any(slow.offset_m)
    assert LimOptions.from_settings(stated).slow is None
    body = next(m.body for m in block_messages(block) if m.topic == "configuration/project")
    assert list(body.wander_sigma_m) == list(body.wander_sigma_deg) == [0.0, 0.0, 0.0]


def test_the_number_of_problems_is_told(tmp_path):
    with pytest.raises(UserError, match=r"image_points.csv:2: line: 'x' is not a number \(and 2 more like it\)"):
        read_block(write_files(tmp_path, image_points="point,strip,ccd,line,sample\n" + "G1,S1,F,x,1\n" * 3))
    with pytest.raises(UserError, match=r"\(and at least 9 more like it\)"):  # of 39
        read_block(write_files(tmp_path, image_points="point,strip,ccd,line,sample\n" + "G1,S1,F,x,1\n" * 40))


def test_rays_of_unknown_strip_or_ccd_are_kept_and_named(tmp_path):
    """They are for the adjustment to reject, which names them."""
    block = read_block(write_files(tmp_path, image_points=IMAGE + "T1,S7,N,1,1,\nT1,S1,Q,1,1,\n"))
    assert block.image_name(3) == ("T1", "S7", "N") and block.image_name(4) == ("T1", "S1", "Q")
    assert "image_points.csv:5: strip: 'S7' is not in strips.csv; the ray cannot be used" in block.notes
    assert "image_points.csv:6: ccd: 'Q' is not in camera.json; the ray cannot be used" in block.notes
    network = network_from_block(block)
    assert dict(network.refused) == {3: "unknown strip", 4: "unknown CCD line"}


def test_repeated_measurements_count_once(tmp_path):
    row = IMAGE.splitlines()[1] + "\n"
    block = read_block(write_files(tmp_path, image_points=IMAGE + row + "T2,S1,N,7,7,\n"))
    assert len(block.image) == 4 and block.image_name(3)[0] == "T2"
    assert "image_points.csv: 1 rows repeat a measurement and were left out" in block.notes


@pytest.mark.parametrize(
    "strips",
    ["strip,first_line_time_s,line_rate_hz,lines,line_times\nS1,,,,lines.csv\n", "line_times,strip\nlines.csv,S1\n"],
    ids=["with the columns that it replaces", "without"],
)
def test_line_times_from_a_file(strips, tmp_path):
    folder = write_files(tmp_path, strips=strips, image_points="point,strip,ccd,line,sample\nG1,S1,N,1.5,1\n")
    (folder / "lines.csv").write_text("line,time_s\n0,100\n1,100.1\n2,100.3\n")
    block = read_block(folder)
    np.testing.assert_allclose(block.image.time_s, 100.2)
    assert block.strips[0].lines == 3
    (folder / "lines.csv").write_text("line,time_s\n0,100\n1,100.1\n3,100.3\n")
    with pytest.raises(UserError, match=r"lines.csv:4: line: 3, wanted 2"):
        read_block(folder)
    (folder / "lines.csv").unlink()
    with pytest.raises(UserError, match=r"strips.csv:2: line_times: no file 'lines.csv'"):
        read_block(folder)


def test_columns_that_line_times_replace_are_wanted_without_these(tmp_path):
    folder = write_files(tmp_path, strips="line_times,strip\n,S1\n")
    with pytest.raises(UserError, match=r"strips.csv:2: first_line_time_s: missing, wanted a number \(or a file"):
        read_block(folder)
    (folder / "strips.csv").write_text("strip,lines\nS1,3\n")
    with pytest.raises(UserError, match=r"strips.csv:1: first_line_time_s: column missing, wanted strip,first_line"):
        read_block(folder)


def _lens_folder(tmp_path, own_orientation: bool):
    camera = json.loads(FILES["camera.json"])
    camera["lenses"].append({"id": "L2", "focal_length_mm": 60.0})
    camera["lines"][1]["lens"] = "L2"
    strips = "strip,lens,first_line_time_s,line_rate_hz,lines\nS1,L1,100,200,2001\nS1,L2,100.5,200,1900\n"
    trajectory = TRAJECTORY
    if own_orientation:
        rows = TRAJECTORY.splitlines()
        both = [row + ",L1" for row in rows[1:]] + [row.replace("1000.0", "1001.0") + ",L2" for row in rows[1:]]
        trajectory = "\n".join([rows[0] + ",lens", *both]) + "\n"
    return write_files(tmp_path, camera=json.dumps(camera), strips=strips, trajectory=trajectory)


@pytest.mark.parametrize("lines", ["0", ""])
def test_a_number_of_lines_that_is_not_known_is_that_under_the_trajectory(tmp_path, lines):
    """An on-line adjustment took such a strip for one of ten minutes, and did not tie others to it."""
    strips = FILES["strips.csv"].replace("2001", lines)
    block = read_block(write_files(tmp_path, strips=strips))
    assert block.strips[0].lines == 0
    bodies = [m.body for m in block_messages(block) if m.topic == "configuration/strip"]
    assert [body.lines for body in bodies] == [2201, 2201]  # 100 to 111 s, 200 a second
    assert "strip S1: number of lines not known, taken as the 2201 under its trajectory" in not_carried(block)


@pytest.mark.parametrize("own_orientation", [False, True])
def test_strips_lens_by_lens(tmp_path, own_orientation):
    block = read_block(_lens_folder(tmp_path / "a", own_orientation))
    assert [strip.id for strip in block.strips] == ["S1/L1", "S1/L2"]
    assert block.image.strip.tolist() == [0, 1, 1]
    np.testing.assert_allclose(block.image.time_s[1], 100.5 + 900 / 200)
    assert block.image_name(1) == ("G1", "S1", "N")
    assert block.strips[1].trajectory.position_l[0, 2] == (1001.0 if own_orientation else 1000.0)
    write_block(tmp_path / "b", block)
    again = read_block(tmp_path / "b")
    assert [strip.id for strip in again.strips] == ["S1/L1", "S1/L2"]
    np.testing.assert_allclose(again.image.time_s, block.image.time_s)
    assert again.strips[1].trajectory.position_l[0, 2] == block.strips[1].trajectory.position_l[0, 2]


@pytest.mark.parametrize("crs", ["local", "EPSG:32632", "EPSG:4979", "EPSG:4978"])
def test_round_trip_in_any_crs(tmp_path, crs):
    """Written in a CRS and read back the block lies in another local frame: compared through the Earth-fixed one."""
    block = simulated_block(crs)
    write_block(tmp_path, block)
    again = read_block(tmp_path)
    assert again.frame.crs == crs and again.point_ids == block.point_ids and again.ground.role == block.ground.role
    assert again.notes == ()
    old, new = block.frame, again.frame
    R = np.eye(3) if crs == "local" else new.R_el.T @ old.R_el  # old local to new local
    shift = np.zeros(3) if crs == "local" else (old.origin_e - new.origin_e) @ new.R_el
    np.testing.assert_allclose(again.ground.xyz_l, block.ground.xyz_l @ R.T + shift, atol=2e-6)
    np.testing.assert_allclose(again.ground.covariance[0], R @ block.ground.covariance[0] @ R.T, atol=1e-6)
    for a, b in zip(again.strips, block.strips, strict=True):
        np.testing.assert_allclose(a.trajectory.position_l, b.trajectory.position_l @ R.T + shift, atol=2e-6)
        turned = R @ matrix_from_quaternion(b.trajectory.quaternion)
        np.testing.assert_allclose(matrix_from_quaternion(a.trajectory.quaternion), turned, atol=5e-9)
    for name in ("point", "strip", "ccd", "line", "sample", "time_s"):
        np.testing.assert_allclose(getattr(again.image, name), getattr(block.image, name), atol=6e-7)
    np.testing.assert_allclose(again.camera.lines[0].xy_mm, block.camera.lines[0].xy_mm, atol=1e-9)


@pytest.mark.parametrize("crs", ["local", "EPSG:32632", "EPSG:4978"])
def test_rays_meet_at_the_control_points(tmp_path, crs):
    """Angles and coordinates of the CRS fit each other: exact image points intersect at the ground points."""
    write_block(tmp_path, simulated_block(crs))
    block = read_block(tmp_path)
    network = network_from_block(block)
    free = [i for i, id in enumerate(network.point_ids) if id in ("P5", "P6", "P7")]  # check points: intersected only
    wanted = {id: xyz for id, xyz in zip(block.ground.id, block.ground.xyz_l, strict=True)}
    for i in free:
        np.testing.assert_allclose(network.approximate_l[i], wanted[network.point_ids[i]], atol=0.02)


def test_omitting_convergence_would_be_seen(tmp_path):
    """The same files read as if the grid were the local frame put the points elsewhere."""
    block = simulated_block("EPSG:32632")
    write_block(tmp_path, block)
    lon = np.radians(10.6 - 9.0)
    convergence = np.degrees(lon * np.sin(np.radians(47.5)))
    kappa = np.loadtxt(tmp_path / "trajectory.csv", delimiter=",", skiprows=1, usecols=7, max_rows=1)
    true = np.degrees(angles_from_matrix(matrix_from_quaternion(block.strips[0].trajectory.quaternion[0])))[2]
    assert kappa - true == pytest.approx(convergence, abs=0.02)


def less_certain(messages, strip, sigma_kappa):
    """The messages of a block with poses of a strip whose kappa is as uncertain as that, rad."""
    for message in messages:
        if message.topic == "trajectory/smoothed" and message.body.strip == strip:
            message.body.covariance[35] = sigma_kappa**2
        yield message


def with_filtered(messages, factor):
    """The messages of a block with filtered poses, too, whose attitude has variances so many times as large."""
    for message in messages:
        yield message
        if message.topic == "trajectory/smoothed":
            body = type(message.body)()
            body.CopyFrom(message.body)
            for axis in (21, 28, 35):
                body.covariance[axis] *= factor
            yield replace(message, topic="trajectory/filtered", body=body)


def test_strips_that_begin_before_a_filter_has_found_its_attitude_are_stated_apart(tmp_path):
    """One sigma for all: sigma0 was 0.8 and points twice as far off in flights whose first strip alone began so."""
    write_block(tmp_path, simulated_block("local"))
    read = read_block(tmp_path)
    wander = {"wander_sigma_m": (0.3, 0.3, 0.5), "wander_sigma_deg": (0.005, 0.005, 0.01), "wander_time_s": 30.0}
    read = replace(read, apriori=replace(read.apriori, trajectory={**read.apriori.trajectory, **wander}))
    first, *others = (strip.id for strip in read.strips)
    assert others
    block = block_from_messages(less_certain(block_messages(read), first, 0.02), "flight")
    assert list(block.apriori.of_strip) == [first] and block.apriori.wide
    assert any(f"where strip {first} begins poses are less certain" in note for note in block.notes)
    model, _ = models_of(block, "wander", None, {})
    usual, _ = models_of(block_from_messages(block_messages(read), "flight"), "wander", None, {})
    assert all(slow_errors_of_strip(model, id) == usual.slow for id in others)
    own = slow_errors_of_strip(model, first)
    assert own.shift[2] == pytest.approx(0.02, rel=0.01) and own.shift[:2] == pytest.approx(usual.slow.shift[:2])
    assert {strip.id: strip.noise is None for strip in block.strips} == dict.fromkeys((first, *others), True)
    # of a filter that learns its attitude positions err faster than stated, in all strips
    learnt = models_of(block_from_messages(with_filtered(block_messages(read), 1.1), "flight"), "wander", None, {})[0]
    assert all(slow_errors_of_strip(learnt, id) == usual.slow.with_taken_back() for id in (first, *others))
    assert usual.slow.with_taken_back().wander_time_s < 0.8 * usual.slow.wander_time_s
    taken_over = block_from_messages(with_filtered(block_messages(read), 1.0), "flight")
    assert models_of(taken_over, "wander", None, {})[0] == usual
    # a second flight with strips of the same names, which get others: each has its own still
    flights = [block, replace(block, apriori=replace(block.apriori, of_strip={}, wide=False))]
    joined = join_blocks(flights[::-1], ["day1", "day2"])
    assert joined.renamed and joined.block.apriori.wide
    both = by_recording(joined, [models_of(flight, "wander", None, {})[0] for flight in flights[::-1]])
    assert slow_errors_of_strip(both, f"{first}@day2") == own
    assert slow_errors_of_strip(both, f"{first}@day1") == slow_errors_of_strip(both, f"{others[0]}@day2") == usual.slow


def test_missing_geoid_grid_is_told(tmp_path):
    block = simulated_block("EPSG:32632")
    write_block(tmp_path, block)
    text = (tmp_path / "project.toml").read_text().replace("EPSG:32632", "EPSG:32632+EPSG:5773")
    (tmp_path / "project.toml").write_text(text)
    from triline.nodes.formats.projection import missing_grids

    grids = missing_grids("EPSG:32632+EPSG:5773")
    read = read_block(tmp_path)
    assert bool(grids) == any("has no grid" in note for note in read.notes)
    # so are those of a recording, which may have been made where PROJ has the grid
    notes = block_from_messages(block_messages(read), "flight.mcap").notes
    assert bool(grids) == any(note.startswith("flight.mcap: PROJ has no grid us_nga") for note in notes)
    assert missing_grids("EPSG:32632") == []


def test_heights_of_which_proj_knows_no_geoid_are_told(tmp_path):
    """Such as DHHN92 of EPSG:5555: no grid is missing, and heights counted as ellipsoidal ones in silence."""
    block = simulated_block("EPSG:25832")
    write_block(tmp_path, block)
    text = (tmp_path / "project.toml").read_text().replace("EPSG:25832", "EPSG:5555")
    (tmp_path / "project.toml").write_text(text)
    said = "PROJ knows no geoid of 'DHHN92 height': heights count as ellipsoidal ones and may be off by it, all alike"
    read = read_block(tmp_path)
    assert f"project.toml: {said}" in read.notes
    assert f"flight.mcap: {said}" in block_from_messages(block_messages(read), "flight.mcap").notes
    with pytest.raises(UserError, match=r"x.csv: PROJ knows no geoid of 'DHHN92 height' in 'ETRS89 / UTM zone 32N"):
        refuse_missing_grids("EPSG:5555", "x.csv")
    for crs in ("EPSG:25832", "EPSG:4979", "EPSG:4978", "EPSG:32632+EPSG:5773"):
        assert unknown_heights(crs) == ""


def test_coordinates_outside_the_crs(tmp_path):
    write_block(tmp_path, simulated_block("EPSG:32632"))
    path = tmp_path / "ground_points.csv"
    rows = path.read_text().splitlines()
    rows[3] = "P2,9e12,5e6,100,0.1,0.1,0.1,control"
    path.write_text("\n".join(rows))
    with pytest.raises(UserError, match=r"(outside the area)"):
        read_block(tmp_path)


@needs_blocks
@pytest.mark.parametrize("name", ["dgr", "selfcal"])
def test_given_blocks(name, tmp_path):
    block = read_block(BLOCKS / name)
    assert not block.notes
    counts = {"dgr": (814, 104, 3, 14), "selfcal": (2299, 240, 4, 20)}[name]
    assert (len(block.image), len(block.point_ids), len(block.strips), len(block.ground)) == counts
    truth = json.loads((BLOCKS / name / "truth.json").read_text())["points"]
    true = np.array([truth[id] for id in block.ground.id])
    assert np.abs(block.ground.xyz_l - true).max() < 5 * 0.02
    network = network_from_block(block)
    assert not network.refused
    # direct georeferencing with the errors of trajectory and, in the second, camera: metres at 1800 m
    limit = {"dgr": 1.5, "selfcal": 12.0}[name]
    xyz = network.approximate_l
    true = np.array([truth[id] for id in network.point_ids])
    assert np.abs(xyz - true).max() < limit
    write_block(tmp_path, block)
    again = read_block(tmp_path)
    for column, values in vars(block.image).items():
        if isinstance(values, np.ndarray):
            np.testing.assert_allclose(getattr(again.image, column), values, atol=1e-9)


@needs_blocks
def test_a_large_file_is_read_whole(tmp_path):
    folder = tmp_path / "big"
    shutil.copytree(BLOCKS / "dgr", folder)
    (folder / "image_points.csv").chmod(0o644)
    rng = np.random.default_rng(1)
    n = 200_000
    u, v = rng.uniform(0, 29000, n), rng.uniform(0, 11000, n)
    rows = (f"T{i // 4},S{1 + i // 2 % 2},{'FN'[i % 2]},{u[i]:.6f},{v[i]:.6f}\n" for i in range(n))
    (folder / "image_points.csv").write_text("point,strip,ccd,line,sample\n" + "".join(rows))
    assert len(read_block(folder).image) == n


def test_a_folder_is_checked(tmp_path, capsys):
    write_files(tmp_path)
    assert main(["check", str(tmp_path)]) == 0
    said = capsys.readouterr().out
    assert "complete; 1 strip" in said and "image points" in said
    assert main(["check", str(tmp_path), "--json"]) == 0
    held = json.loads(capsys.readouterr().out)
    assert f"{held['strips']} strip, {held['image_points']} image points, {held['ground_points']} ground points" in said
    points = tmp_path / "image_points.csv"
    points.write_text(points.read_text() + "P9,S1,N,x,1\n")
    assert main(["check", str(tmp_path)]) == 1
    assert "image_points.csv:" in capsys.readouterr().err
    assert main(["check", str(tmp_path), "--json"]) == 1
    checked = json.loads(capsys.readouterr().out)
    assert checked["complete"] is False and "line: 'x'" in checked["problems"][0]
