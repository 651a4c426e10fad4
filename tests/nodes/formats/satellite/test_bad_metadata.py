"""Broken metadata: one line that says what, where, and what was wanted."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest
from satellite_scenes import Truth, write_dimap1, write_dimap2, write_folder, write_isd

from triline.nodes.errors import UserError
from triline.nodes.formats.detect import kind_of_path
from triline.nodes.formats.satellite.read import read_scene
from triline.nodes.formats.satellite.xml_file import read_xml

TRUTH = Truth(lines=4000, samples=500)


def refused(path, match):
    with pytest.raises(UserError, match=match) as caught:
        read_scene(path)
    text = str(caught.value)
    assert "\n" not in text and path.name in text
    return text


def without(text, tag, keep=0):
    """The text without the elements of a name, but for the first ``keep``."""
    found = list(re.finditer(rf"<{tag}>.*?</{tag}>", text, re.DOTALL))
    for match in reversed(found[keep:]):
        text = text[: match.start()] + text[match.end() :]
    return text


@pytest.mark.parametrize("share", [0.05, 0.5, 0.99])
@pytest.mark.parametrize("write", [write_dimap1, write_dimap2])
def test_truncated_xml(write, share, tmp_path):
    path = write(tmp_path / "scene.xml", TRUTH)
    data = path.read_bytes()
    path.write_bytes(data[: int(share * len(data))])
    refused(path, r"scene.xml:\d+: not whole XML: .*, wanted a whole document")


def gap(text, tag, low, high):
    found = list(re.finditer(rf"<{tag}>.*?</{tag}>", text, re.DOTALL))
    return text[: found[low].start()] + text[found[high].start() :]


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (lambda s: without(s, "Point"), "Ephemeris/Point_List/Point: missing, wanted at least 2 positions"),
        (lambda s: without(s, "Point_List"), "Ephemeris/Point_List: missing, wanted positions of the satellite"),
        (lambda s: without(s, "Quaternion_List"), "Quaternion_List: missing, wanted polynomials or a list"),
        (lambda s: without(s, "Refined_Model"), "Refined_Model: missing, wanted the rigorous model of a SENSOR"),
        (lambda s: without(s, "Raster_Data"), "Raster_Dimensions: missing, wanted the size of the image"),
        # the list of the files of a product, VOL_*.XML
        (
            lambda s: without(without(s, "Raster_Data"), "Geometric_Data"),
            r"Refined_Model: missing, .*\(DIM_\*.XML; an OR",
        ),
        (lambda s: without(s, "XLOS_0"), "XLOS_0: missing, wanted a number"),
        (
            lambda s: gap(s, "Quaternion", 9, 16),
            r"Quaternion_List: gap from 2021-03-04T10:20:00\.\d+Z to .*every 0.125 s",
        ),
        (lambda s: s.replace("<NROWS>4000", "<NROWS>4e3.5"), "NROWS: '4e3.5', wanted a number"),
        (lambda s: s.replace("<NROWS>4000", "<NROWS>40000"), "lines are taken from .*attitude is given from"),
        (lambda s: s.replace("<START>2021-03", "<START>2021-13"), "START: '2021-13.* is not a day of the calendar"),
        (lambda s: re.sub("<LINE_PERIOD unit=.ms.>", "<LINE_PERIOD unit='ms'>-", s), "LINE_PERIOD: '-.*above 0"),
        (
            lambda s: re.sub("<LOCATION_XYZ>", "<LOCATION_XYZ>1 ", s, count=1),
            "Point.1./LOCATION_XYZ: .*wanted 3 numbers",
        ),
        (lambda s: s.replace("Dimap_Document", "Other"), "XML with the root Other, wanted one of: DIMAP 2"),
    ],
)
def test_dimap2(change, match, tmp_path):
    path = write_dimap2(tmp_path / "scene.xml", TRUTH)
    path.write_text(change(path.read_text()))
    refused(path, match)


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (lambda s: without(s, "Points"), "Data_Strip/Ephemeris/Points: missing, wanted positions"),
        (lambda s: without(s, "Corrected_Attitudes"), "Angles_List: missing, wanted corrected or raw attitudes"),
        (lambda s: without(s, "Angles", 2), "lines are taken from .* but the attitude is given from"),
        (lambda s: gap(s, "Angles", 9, 14), "Corrected_Attitude: gap from"),
        (lambda s: s.replace("<OUT_OF_RANGE>N", "<OUT_OF_RANGE>Y"), "at least 2 attitudes that are in range"),
        (lambda s: without(s, "Look_Angles", 1), "Look_Angles: '1 of them', wanted look angles of at least 2"),
        (lambda s: s.replace("<DETECTOR_ID>7<", "<DETECTOR_ID>3<"), r"Look_Angles\[7\]/DETECTOR_ID: '3', wanted"),
        (lambda s: s.replace("<PROCESSING_LEVEL>1A", "<PROCESSING_LEVEL>2A"), "PROCESSING_LEVEL: '2A', wanted 1A: im"),
        (lambda s: s.replace("<MISSION>SPOT", "<MISSION>THEOS"), "Scene_Source/MISSION: 'THEOS', wanted SPOT"),
        (lambda s: s.replace("<MISSION_INDEX>5", "<MISSION_INDEX>6"), "MISSION_INDEX: '6', wanted 1 to 5"),
    ],
)
def test_dimap1(change, match, tmp_path):
    path = write_dimap1(tmp_path / "scene.dim", TRUTH)
    path.write_text(change(path.read_text()))
    refused(path, match)


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (
            lambda d: d.update(name_model="USGS_ASTRO_FRAME_SENSOR_MODEL"),
            "name_model: .*wanted USGS_ASTRO_LINE_SCANNER",
        ),
        (lambda d: d.pop("instrument_position"), "instrument_position: missing, wanted the ephemeris"),
        (lambda d: d["radii"].update(unit="mile"), "radii.unit: 'mile', wanted m or km"),
        (lambda d: d["instrument_pointing"]["quaternions"].pop(), "ephemeris_times: .*numbers that increase"),
        (
            lambda d: d["optical_distortion"].update({"kaguyalism": d["optical_distortion"].pop("radial")}),
            "wanted radial",
        ),
        (lambda d: d.update(line_scan_rate=[[0.5, 1.0]]), "line_scan_rate: .*wanted at least 1 rows of 3 numbers"),
        (lambda d: d.update(focal2pixel_samples=[0, 1, 0]), "focal2pixel_samples: .*can be inverted"),
    ],
)
def test_isd(change, match, tmp_path):
    path = write_isd(tmp_path / "scene.json", TRUTH, inertial=True)
    isd = json.loads(path.read_text())
    change(isd)
    path.write_text(json.dumps(isd))
    refused(path, match)


def in_kilometres(rows):
    """An ephemeris with its positions in kilometres."""
    cells = [row.split(",") for row in rows]
    place = [k for k, name in enumerate(cells[0]) if name in ("X_m", "Y_m", "Z_m")]
    for row in cells[1:]:
        for k in place:
            row[k] = repr(float(row[k]) / 1000.0)
    return [",".join(row) for row in cells]


def lines(name, change):
    def apply(folder):
        rows = (folder / name).read_text().splitlines()
        (folder / name).write_text("\n".join(change(rows)) + "\n")

    return apply


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (lambda f: (f / "attitude.csv").unlink(), "attitude.csv: no such file"),
        (
            lines("ephemeris.csv", lambda r: [*r[:3], "2021-03-04T10:19:00Z,1,2", *r[4:]]),
            r"ephemeris.csv:4: Z_m: missing",
        ),
        (lines("ephemeris.csv", lambda r: [*r[:3], r[2], *r[4:]]), "ephemeris.csv:4: time: does not follow the time"),
        # of such a scene a block was adjusted, "sigma0 1.0000, passed, converged", by nothing
        (
            lines("ephemeris.csv", in_kilometres),
            r"ephemeris.csv:2: X_m, Y_m, Z_m: 7\d{3} m from the centre of the planet, which is inside it; wanted",
        ),
        (lines("attitude.csv", lambda r: [*r[:5], *r[9:]]), "attitude.csv: time: gap from .* every 0.5 s"),
        (
            lines("attitude.csv", lambda r: [r[0].replace("yaw", "jaw"), *r[1:]]),
            "qx: column missing, wanted qx,qy,qz,qw",
        ),
        (lines("line_times.csv", lambda r: r[:2]), "line_times.csv: line: 1 row of CCD line P"),
        (
            lines("line_times.csv", lambda r: [r[0], r[1].replace("T", "?"), r[2]]),
            "line_times.csv:2: time_utc: .*not a time",
        ),
        (
            lines("scene.toml", lambda r: [*r, "light = 3", "[time]", "scale = 'CET'"]),
            "time.scale: 'CET', wanted one of UTC",
        ),
        (
            lines("scene.toml", lambda r: ["[frames]", "attitude = 'sky'"]),
            "frames.attitude: 'sky', wanted one of earth",
        ),
        (lines("scene.toml", lambda r: ["[sigma]", "time_s = -1"]), "scene.toml: sigma: .*at least 0"),
        (
            lines("scene.toml", lambda r: ["[planet]", "semi_major_m = 1737400"]),
            "scene.toml: planet.rotation_rate_rad_s: missing, wanted that of this planet",
        ),
        (
            lines("scene.toml", lambda r: ["[frames]", "ephemeris = 'gcrs'", "[planet]", "semi_major_m = 1737400"]),
            "scene.toml: frames.ephemeris: 'gcrs', wanted earth or orbital: how this planet turns",
        ),
    ],
)
def test_folder(change, match, tmp_path):
    path = write_folder(tmp_path / "scene", TRUTH)
    change(path)
    refused(path, match)


def test_folder_before_the_earth_orientation_table(tmp_path):
    path = write_folder(tmp_path / "scene", TRUTH, settings="[frames]\nephemeris = 'gcrs'\nattitude = 'orbital'\n")
    for name in ("ephemeris.csv", "attitude.csv", "line_times.csv"):
        (path / name).write_text((path / name).read_text().replace("2021-03-04", "1955-03-04"))
    refused(path, "1955-03-04T.* lies before the Earth orientation table, which begins 1962")


def test_folder_after_the_earth_orientation_table_is_told_not_refused(tmp_path):
    path = write_folder(tmp_path / "scene", TRUTH, settings="[frames]\nephemeris = 'gcrs'\nattitude = 'orbital'\n")
    for name in ("ephemeris.csv", "attitude.csv", "line_times.csv"):
        (path / name).write_text((path / name).read_text().replace("2021-03-04", "2051-03-04"))
    scene = read_scene(path)
    assert any("lies after the Earth orientation table" in note and "m on the ground" in note for note in scene.notes)


@pytest.mark.parametrize("content", [b"", b"\0\1\2", b"hello"])
def test_what_is_nothing_known(content, tmp_path):
    path = tmp_path / "scene.bin"
    path.write_bytes(content)
    refused(path, "wanted one of: DIMAP 2")
    refused(tmp_path / "none.xml", "no such file")


def damaged(data, seed):
    """A file with one bit flipped, some bytes lost or added, or its end cut off."""
    rng = np.random.default_rng(seed)
    out, place = bytearray(data), int(rng.integers(len(data)))
    kind = seed % 4
    if kind == 0:
        out[place] ^= 1 << int(rng.integers(8))
    elif kind == 1:
        del out[place : place + int(rng.integers(1, 40))]
    elif kind == 2:
        out[place:place] = rng.bytes(5)
    else:
        del out[place:]
    return bytes(out)


@pytest.mark.parametrize(
    "name", ["scene.xml", "scene.dim", "scene.json", "ephemeris.csv", "attitude.csv", "line_times.csv", "scene.toml"]
)
def test_damaged_files_are_read_or_refused_in_one_line(name, tmp_path):
    whole = {"scene.xml": write_dimap2, "scene.dim": write_dimap1, "scene.json": write_isd}
    top = whole[name](tmp_path / name, TRUTH) if name in whole else write_folder(tmp_path / "folder", TRUTH)
    path = top if name in whole else top / name
    data = path.read_bytes()
    for seed in range(40):
        path.write_bytes(damaged(data, seed))
        try:
            sensor = read_scene(top).model("rigorous")
            located = sensor.direct([5.0], [5.0], [0.0])
            sensor.inverse(*located.T)
        except UserError as error:
            assert "\n" not in str(error)


def test_import_names_locate(tmp_path):
    world_view = tmp_path / "WV01.XML"
    world_view.write_text('<?xml version="1.0"?>\n<isd>\n<IMD></IMD></isd>\n')
    for path in (write_dimap2(tmp_path / "scene.xml", TRUTH), world_view, write_folder(tmp_path / "scene", TRUTH)):
        with pytest.raises(UserError, match=r"(metadata|folder) of a satellite scene, which `triline locate` and"):
            kind_of_path(path)


def test_years_that_no_satellite_saw(tmp_path):
    path = write_dimap2(tmp_path / "scene.xml", TRUTH)
    path.write_text(path.read_text().replace("<START>2021", "<START>9021"))
    refused(path, "START: '9021.*' lies outside the years 1900 to 2200")


def test_an_encoding_that_there_is_not(tmp_path):
    path = tmp_path / "DIM.XML"
    path.write_text('<?xml version="1.0" encoding="UTF-0x10"?>\n<Dimap_Document></Dimap_Document>\n')
    with pytest.raises(UserError, match=r"DIM\.XML:1: unknown encoding: UTF-0x10, wanted XML in UTF-8"):
        read_xml(path)
