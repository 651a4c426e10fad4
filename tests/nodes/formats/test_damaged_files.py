"""Files with bytes changed, cut out, put in or cut off: read, or refused in one line; never anything else."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from places import DATA
from small_block import FILES, write_files
from test_gpx import HEAD, attitude, point
from test_imports import write_sbet_file
from test_ros2 import flight_of, write_bag
from tracks import straight_track, waypoint_text

from triline.nodes.errors import UserError
from triline.nodes.formats.block_folder import read_block
from triline.nodes.formats.detect import kind_of_path, read_any
from triline.nodes.formats.geocal_xml import read_glas_camera

_WORDS = (b"nan", b"inf", b"1e999", b"-", b'"', b",", b"\n", b"\0", b"\xff")
CASES = 40


def _damaged(data: bytes, rng: np.random.Generator) -> bytes:
    b = bytearray(data)
    i, j = (int(v) for v in rng.integers(0, len(b), 2))
    kind = rng.integers(0, 6)
    if kind == 0:
        return bytes(b[:i])
    if kind == 1:
        for k in rng.integers(0, len(b), 4):
            b[k] = rng.integers(0, 256)
    elif kind == 2:
        del b[i : i + 30]
    elif kind == 3:
        b[i:i] = bytes(rng.integers(32, 127, 12).astype(np.uint8))
    elif kind == 4:
        b[i : i + 20] = b[j : j + 40]
    else:
        word = _WORDS[rng.integers(0, len(_WORDS))]
        b[i : i + len(word)] = word
    return bytes(b)


def _lines(path: Path, n: int) -> bytes:
    return b"\n".join(path.read_bytes().split(b"\n")[:n])


def small_files(folder: Path) -> dict[str, bytes]:
    """Small whole files of every kind."""
    csv = "time_s,lat_deg,lon_deg,height_m,roll_deg,pitch_deg,heading_deg\n"
    found = {
        "sbet.out": write_sbet_file(folder).read_bytes(),
        "poses.csv": (csv + "".join(f"{i},48.{i},11,500,0,0,45\n" for i in range(20))).encode(),
    }
    columns = ("Week (weeks)", "GPSTime (sec)", "Latitude (+/-D M S)", "Longitude (+/-D M S)", "H-Ell (m)")
    found["explorer.txt"] = waypoint_text(
        straight_track(), *columns, "Roll (deg)", "Pitch (deg)", "Heading (deg)"
    ).encode()
    gpx = "".join(point(i, attitude(i)) for i in range(20))
    found["track.gpx"] = f"{HEAD}{gpx}</trkseg></trk></gpx>".encode()
    found["ros.mcap"] = (write_bag(folder / "bag", flight_of()) / "bag.mcap").read_bytes()
    if DATA.is_dir():
        avirisng = DATA / "avirisng"
        found["ang20170323t202244_eph_att"] = (avirisng / "ang20170323t202244_eph_att").read_bytes()[: 56 * 40]
        name = "f180522t01p00r07rdn_e_lonlat_eph"
        found[name] = (avirisng / name).read_bytes()[: 48 * 40]
        found["pos.txt"] = _lines(DATA / "pospac" / "s251_sbet_subset.txt", 50)
        found["camera.xml"] = (avirisng / "cam_cal_2022_04_11_glas.xml").read_bytes()
        ties = (avirisng / "tpcol_3_1.xml").read_bytes()
        place, ends = 0, []
        while (place := ties.find(b"\n\t\t\t</item>", place + 1)) >= 0:
            ends.append(place + len(b"\n\t\t\t</item>"))
        found["ties.xml"] = ties[: ends[4]].replace(b"<count>800<", b"<count>5<") + ties[ends[-1] :]
    return found


def _read(path: Path) -> None:
    kind = kind_of_path(path)
    if kind == "camera":
        read_glas_camera(path)
        return
    for _ in read_any(path, kind).messages:
        pass


@pytest.fixture(scope="module")
def samples(tmp_path_factory):
    return small_files(tmp_path_factory.mktemp("samples"))


_NAMES = [
    "sbet.out",
    "poses.csv",
    "explorer.txt",
    "track.gpx",
    "ros.mcap",
    "ang20170323t202244_eph_att",
    "f180522t01p00r07rdn_e_lonlat_eph",
]


@pytest.mark.parametrize("name", [*_NAMES, "pos.txt", "camera.xml", "ties.xml"])
def test_damaged_files_are_read_or_refused_in_one_line(samples, name, tmp_path):
    if name not in samples:
        pytest.skip("../shared/data is not there")
    path = tmp_path / name
    path.write_bytes(samples[name])
    _read(path)
    rng = np.random.default_rng(11)
    refused = 0
    for _ in range(CASES):
        path.write_bytes(_damaged(samples[name], rng))
        try:
            _read(path)
        except UserError as error:
            refused += 1
            assert "\n" not in str(error) and name in str(error)
    assert refused > 0


@pytest.mark.parametrize("name", FILES)
def test_damaged_block_folders(name, tmp_path):
    rng = np.random.default_rng(12)
    refused = 0
    for _ in range(CASES):
        folder = write_files(tmp_path)
        (folder / name).write_bytes(_damaged(FILES[name].encode(), rng))
        try:
            read_block(folder)
        except UserError as error:
            refused += 1
            assert "\n" not in str(error)
    assert refused > 0
