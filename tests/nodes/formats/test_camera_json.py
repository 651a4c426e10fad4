"""camera.json: values, tables, errors that name file, key and what was wanted; the AVIRIS-NG camera."""

from __future__ import annotations

import copy
import json

import numpy as np
import pytest
from places import DATA
from small_block import CAMERA

from triline.nodes.cli import main
from triline.nodes.convert import camera_from, camera_message
from triline.nodes.errors import UserError
from triline.nodes.formats.camera_json import read_camera, read_camera_instead, write_camera
from triline.nodes.formats.geocal_xml import read_glas_camera
from triline.solver.camera.line_camera import CcdLine, Lens, LineCamera
from triline.solver.camera.sensors import PRESETS, brown_distortion, preset

GLAS = DATA / "avirisng" / "cam_cal_2022_04_11_glas.xml"


def _write(folder, change=None):
    camera = copy.deepcopy(CAMERA)
    if change is not None:
        change(camera)
    path = folder / "camera.json"
    path.write_text(json.dumps(camera))
    return path


def test_values(tmp_path):
    camera = read_camera(_write(tmp_path))
    assert camera.name == "test" and camera.lenses[0].principal_point_mm == (0.01, -0.02)
    nadir = camera.lines[camera.line_index["N"]]
    step = nadir.xy_mm[1] - nadir.xy_mm[0]
    np.testing.assert_allclose(step, 0.01 * np.array([np.sin(np.radians(1)), np.cos(np.radians(1))]))
    xy, _ = camera.image_coordinates(np.array([0]), np.array([499.5]))
    np.testing.assert_allclose(xy, [[25.0 - 0.01, 0.02]], atol=1e-12)


@pytest.mark.parametrize("as_list", [True, False])
def test_distortion_goes_into_the_table(tmp_path, as_list):
    values = {"k1": 1e-5, "k2": 0.0, "k3": 0.0, "p1": 2e-6, "p2": 0.0}
    given = list(values.values()) if as_list else {"k1": 1e-5, "p1": 2e-6}
    path = _write(tmp_path, lambda c: c["lenses"][0].update(distortion=given))
    straight = read_camera(_write(tmp_path))
    path.write_text(json.dumps({**CAMERA, "lenses": [{**CAMERA["lenses"][0], "distortion": given}]}))
    camera = read_camera(path)
    nominal = straight.lines[0].xy_mm
    wanted = nominal + brown_distortion(nominal - [0.01, -0.02], **values)
    np.testing.assert_allclose(camera.lines[0].xy_mm, wanted, atol=1e-12)


@pytest.mark.parametrize(
    "change",
    [
        lambda c: c["lenses"][0].update(focal_length_mm=c["lenses"][0]["focal_length_mm"] / 1000),
        lambda c: c["lines"][0].update(pixel_size_mm=10.0),
        lambda c: c["lines"][0].update(center_mm=[30580.0, 0.0]),
        lambda c: c["lenses"][0].update(distortion={"k1": 1e3}),
    ],
)
def test_lengths_in_other_units_are_named(tmp_path, change):
    """A focal length in metres gave a camera that looks along the horizon, and a flight without a tie point."""
    with pytest.raises(
        UserError, match=r"camera.json: lines\[0\]: pixels up to .* wanted 80 at most; is all of it in mm"
    ):
        read_camera(_write(tmp_path, change))


def test_table_and_chips(tmp_path):
    def change(camera):
        camera["lines"][0] = {"id": "F", "lens": "L1", "table": "f.csv", "chips": [0, 2]}

    path = _write(tmp_path, change)
    (tmp_path / "f.csv").write_text("sample,x_mm,y_mm\n0,1.0,-0.02\n1,1.001,-0.01\n2,1.0,0.0\n3,1.0,0.011\n")
    line = read_camera(path).lines[0]
    assert line.chips == (0, 2) and line.pixels == 4
    xy, pitch = line.image_coordinates(np.array([2.5]))
    np.testing.assert_allclose(xy, [[1.0, 0.0055]])
    np.testing.assert_allclose(pitch, [[0.0, 0.011]])


BAD = {
    "no lenses": (lambda c: c.pop("lenses"), "camera.json: lenses: missing, wanted a list with at least one entry"),
    "no focal length": (
        lambda c: c["lenses"][0].pop("focal_length_mm"),
        "camera.json: lenses[0].focal_length_mm: missing, wanted a number above 0",
    ),
    "text for a number": (
        lambda c: c["lenses"][0].update(focal_length_mm="60"),
        "camera.json: lenses[0].focal_length_mm: '60', wanted a number above 0",
    ),
    "principal point": (
        lambda c: c["lenses"][0].update(principal_point_mm=[1]),
        "camera.json: lenses[0].principal_point_mm: [1], wanted 2 numbers",
    ),
    "unknown lens": (
        lambda c: c["lines"][1].update(lens="X"),
        "camera.json: lines[1].lens: 'X', wanted one of the lenses L1",
    ),
    "same id": (
        lambda c: c["lines"][1].update(id="F"),
        "camera.json: lines[1].id: 'F', wanted an id that no other line has",
    ),
    "pixels": (
        lambda c: c["lines"][1].update(pixels=1.5),
        "camera.json: lines[1].pixels: 1.5, wanted an integer of at least 2",
    ),
    "no table": (
        lambda c: c["lines"][1].update(table="no.csv"),
        "camera.json: lines[1].table: no file 'no.csv' beside it",
    ),
    "distortion": (
        lambda c: c["lenses"][0].update(distortion=[1, 2]),
        "camera.json: lenses[0].distortion: [1, 2], wanted 5 numbers: k1, k2, k3, p1, p2",
    ),
    "distortion name": (
        lambda c: c["lenses"][0].update(distortion={"k9": 1}),
        "camera.json: lenses[0].distortion.k9: unknown, wanted some of k1, k2, k3, p1, p2",
    ),
    "chips": (
        lambda c: c["lines"][0].update(chips=[5, 3]),
        "camera.json: lines[0].chips: [5, 3], wanted the first sample",
    ),
    "two lenses of one name": (
        lambda c: c["lenses"].append(c["lenses"][0]),
        "camera.json: lenses[1].id: 'L1', wanted an id that no other lens has",
    ),
    "distortion that is a number": (
        lambda c: c["lenses"][0].update(distortion=1),
        "camera.json: lenses[0].distortion: 1, wanted 5 numbers",
    ),
    "more pixels than any line has": (
        lambda c: c["lines"][0].update(pixels=1_000_001),
        "camera.json: lines[0].pixels: 1000001, wanted an integer of at least 2 and at most 1000000",
    ),
    "pixels without size": (
        lambda c: c["lines"][0].update(pixel_size_mm=0.0),
        "camera.json: lines[0].pixel_size_mm: 0.0, wanted a number above 0",
    ),
    **{
        f"chips {chips!r}": (
            lambda c, chips=chips: c["lines"][0].update(chips=chips),
            f"camera.json: lines[0].chips: {chips!r}, wanted the first sample of each chip: 0, ..",
        )
        for chips in ([3, 5], [0, 5, 3], [0, 5, 5], [0, 1000], [0, 2.5], [False, 3], {"0": 3})
    },
    "list of lines": (lambda c: c.update(lines={"id": 1}), "camera.json: lines: {'id': 1}, wanted a list"),
}


@pytest.mark.parametrize("case", BAD)
def test_errors_name_file_key_and_what_was_wanted(tmp_path, case):
    change, wanted = BAD[case]
    with pytest.raises(UserError) as error:
        read_camera(_write(tmp_path, change))
    assert wanted in str(error.value)


def test_table_with_a_gap(tmp_path):
    path = _write(tmp_path, lambda c: c["lines"][0].update(table="f.csv"))
    (tmp_path / "f.csv").write_text("sample,x_mm,y_mm\n0,1,0\n2,1,0.01\n")
    with pytest.raises(UserError, match=r"f.csv:3: sample: 2, wanted 1"):
        read_camera(path)
    (tmp_path / "f.csv").write_text("sample,x_mm,y_mm\n0,1,0\n1,1,0.01\n")
    with pytest.raises(UserError, match=r"lines\[0\].pixels: 1000, wanted 2, the number of samples in f.csv"):
        read_camera(path)


def test_not_json(tmp_path):
    path = tmp_path / "camera.json"
    path.write_text('{"name": "x",\n "lenses": [}')
    with pytest.raises(UserError, match=r"camera.json:2: not valid JSON"):
        read_camera(path)
    path.write_bytes(b"\xff\xfe\0\0")
    with pytest.raises(UserError, match="not a text file"):
        read_camera(path)
    path.write_text("[1, 2]")
    with pytest.raises(UserError, match=r"top level: \[1, 2\], wanted a table of keys"):
        read_camera(path)


@pytest.mark.parametrize("name", PRESETS)
def test_presets_survive_the_round_trip(tmp_path, name):
    camera = preset(name)
    write_camera(tmp_path / "camera.json", camera)
    again = read_camera(tmp_path / "camera.json")
    assert again.lenses == camera.lenses
    for a, b in zip(again.lines, camera.lines, strict=True):
        assert (a.id, a.lens, a.chips) == (b.id, b.lens, b.chips)
        np.testing.assert_allclose(a.xy_mm, b.xy_mm, atol=1e-9)


def test_lines_with_names_that_files_cannot_tell_apart(tmp_path):
    """Each has a table of its own: the second one was written over the first, and both lines lay at one place."""
    xy = [np.column_stack([np.full(5, x), np.arange(5.0)]) for x in (20.0, 0.0, -20.0)]
    lines = tuple(CcdLine(id, "L", place) for id, place in zip(("N+", "N*", "n/"), xy, strict=True))
    write_camera(tmp_path / "camera.json", LineCamera("c", (Lens("L", 50.0),), lines))
    back = read_camera(tmp_path / "camera.json")
    assert [line.id for line in back.lines] == ["N+", "N*", "n/"]
    for line, place in zip(back.lines, xy, strict=True):
        np.testing.assert_array_equal(line.xy_mm, place)


def test_distorted_camera_is_not_distorted_twice(tmp_path):
    path = _write(tmp_path, lambda c: c["lenses"][0].update(distortion=[1e-5, 0, 0, 0, 0]))
    camera = read_camera(path)
    write_camera(tmp_path / "again.json", camera)
    np.testing.assert_allclose(read_camera(tmp_path / "again.json").lines[0].xy_mm, camera.lines[0].xy_mm, atol=1e-9)


@pytest.mark.skipif(not GLAS.is_file(), reason="../shared/data is not there")
def test_fitted_camera_of_aviris_ng(tmp_path, capsys):
    camera = read_glas_camera(GLAS)
    line = camera.lines[0]
    assert camera.lenses[0].focal_length_mm == 27.5 and line.pixels == 598
    pitch = np.hypot(*np.diff(line.xy_mm, axis=0).T)
    # nominal pitch 27 um; the fitted distortion widens it towards the ends of the field
    assert pitch.mean() == pytest.approx(0.027, rel=0.05)
    assert pitch[280:320].mean() == pytest.approx(0.027, rel=0.03)
    assert pitch[0] > pitch[299] and pitch[-1] > pitch[299]
    # +-18 deg across; sample 0 looks to the right: seen in the tie points, where samples grow to the left of flight
    angle = np.degrees(np.arctan2(line.xy_mm[[0, -1], 1], 27.5))
    assert -18.5 < angle[0] < -16 and 15 < angle[1] < 18.5
    assert np.abs(line.xy_mm[:, 0]).max() < 0.4
    assert main(["import", str(GLAS), "-o", str(tmp_path / "camera.json")]) == 0
    assert "598 pixels" in capsys.readouterr().out
    np.testing.assert_allclose(read_camera(tmp_path / "camera.json").lines[0].xy_mm, line.xy_mm, atol=1e-9)


@pytest.mark.skipif(not GLAS.is_file(), reason="../shared/data is not there")
def test_damaged_camera_archives(tmp_path):
    text = GLAS.read_text()
    path = tmp_path / "camera.xml"
    path.write_text(text[: len(text) // 2])
    with pytest.raises(UserError, match=r"camera.xml:\d+: not well-formed XML"):
        read_glas_camera(path)
    path.write_text(text.replace("<rows>598</rows>", "<rows>597</rows>"))
    with pytest.raises(UserError, match="field_alignment: 2392 values in 597 x 4"):
        read_glas_camera(path)
    path.write_text(text.replace("<field_angle_type>0", "<field_angle_type>1"))
    with pytest.raises(UserError, match="field_angle_type"):
        read_glas_camera(path)
    path.write_text(text.replace("3.52930124904383913e-01", "what"))
    with pytest.raises(UserError, match="'what', wanted a number"):
        read_glas_camera(path)


def test_a_table_of_one_sample_is_refused(tmp_path):
    path = _write(tmp_path, lambda c: c["lines"].__setitem__(0, {"id": "F", "table": "f.csv"}))
    (tmp_path / "f.csv").write_text("sample,x_mm,y_mm\n0,1.0,-0.02\n")
    with pytest.raises(UserError, match=r"f.csv: one sample, wanted at least 2"):
        read_camera(path)


def test_keys_that_are_not_known_are_named_and_those_that_a_table_replaces_are_not(tmp_path):
    def change(camera):
        camera["maker"] = "x"
        camera["lenses"][0]["stop"] = 4
        camera["lines"][0] |= {"table": "f.csv", "colour": "red"}
        del camera["lines"][0]["pixels"]

    (tmp_path / "f.csv").write_text("sample,x_mm,y_mm\n0,1.0,-0.02\n1,1.0,-0.01\n")
    notes: list[str] = []
    read_camera(_write(tmp_path, change), notes)
    named = ("lenses[0].stop", "lines[0].colour", "maker")
    assert notes == [f"camera.json: key {name} is not known and was ignored" for name in named]


def test_a_camera_in_place_of_another_has_its_lines_in_its_order(tmp_path):
    one = read_camera(_write(tmp_path))
    other = read_camera_instead(_write(tmp_path, lambda c: c["lines"].reverse()), one)
    assert [line.id for line in other.lines] == [line.id for line in one.lines] == ["F", "N"]
    # the name of the only lens says nothing
    renamed = _write(
        tmp_path, lambda c: (c["lenses"][0].update(id="X"), [line.update(lens="X") for line in c["lines"]])
    )
    assert read_camera_instead(renamed, one).lines[0].lens == "X"

    def second_lens(camera):
        camera["lenses"].append(camera["lenses"][0] | {"id": "L2"})
        camera["lines"][1]["lens"] = "L2"

    for change, wanted in (
        (lambda c: c["lines"].pop(), "F with 1000 pixels, N with 1000 pixels"),
        (lambda c: c["lines"][0].update(pixels=999), "F with 1000 pixels, N with 1000 pixels"),
        (second_lens, "F with 1000 pixels behind L1, N with 1000 pixels behind L1"),
    ):
        with pytest.raises(UserError, match=f"has other lines, wanted {wanted}"):
            read_camera_instead(_write(tmp_path, change), one)
    with pytest.raises(UserError, match=r"none.json: no such file, wanted a camera.json"):
        read_camera_instead(tmp_path / "none.json", one)


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda c: setattr(c.lenses[0], "focal_length_mm", 0.0), "lens 'L1' has focal length 0.0, wanted more than 0"),
        (lambda c: c.lines[0].x_mm.pop(), "CCD line 'F' has no usable table"),
        (
            lambda c: (c.lines[1].x_mm.__delitem__(slice(1, None)), c.lines[1].y_mm.__delitem__(slice(1, None))),
            "line 'N'",
        ),
        (lambda c: c.lines[0].y_mm.__setitem__(3, float("nan")), "CCD line 'F' has no usable table"),
        (lambda c: setattr(c.lines[0], "lens", "X"), "CCD line 'F' names lens 'X'; known lenses"),
        (lambda c: setattr(c.lines[0], "id", "N"), "two CCD lines of a camera have the same id"),
    ],
)
def test_a_camera_message_that_is_no_camera_is_refused(tmp_path, change, told):
    body = camera_message(read_camera(_write(tmp_path)))
    assert [line.id for line in camera_from(body).lines] == ["F", "N"]
    change(body)
    with pytest.raises(ValueError, match=told):
        camera_from(body)
