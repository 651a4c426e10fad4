"""Images that a camera's program has cut into cubes."""

from __future__ import annotations

from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
from envi_files import write_image
from tracks import ns

from triline.nodes.cli import main
from triline.nodes.recording.reader import RecordingReader

START = ns("2020-06-01T12:00:00")
#: Of the cubes, by the number of their first line: when each begins, s after the poses, and its lines.
CUBES = {0: (-60.0, 20), 20: (1.0, 30), 50: (1.3, 30), 100: (1.6, 25), 1000: (9.5, 40)}
FLIGHT = """[flight]
crs = "EPSG:32632"
vertical_datum = "ellipsoid"
ground_height_m = 500
[camera]
file = "camera.json"
[navigation]
file = "poses.csv"
[[strips]]
id = "N1_"
images = {N = "raw_*"}
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A Headwall camera's: a dark cube before the poses, a strip of three cubes, and one of a single cube."""
    clock = 5_000_000_000
    values = np.random.default_rng(1).integers(0, 250, (145, 6, 1)).astype("u1")
    begin = 0
    for number, (second, lines) in CUBES.items():
        write_image(tmp_path / f"raw_{number}", values[begin : begin + lines], "bil")
        counts = [f"{number + i}\t{clock + round((second + 0.01 * i) * 1e6)}\n" for i in range(lines)]
        (tmp_path / f"frameIndex_{number}.txt").write_text("Frame#\tTimestamp\n" + "".join(counts))
        begin += lines
    times = [datetime(2020, 6, 1, 11, 58, 50) + timedelta(seconds=0.1 * i) for i in range(820)]
    log = [
        f"0\t0\t1\t48\t11\t2000\t{clock - 70_000_000 + 100_000 * i}\t{time:%Y/%m/%d %H:%M:%S.%f}\t4\t44\n"
        for i, time in enumerate(times)
    ]
    names = "Roll\tPitch\tYaw\tLat\tLon\tAlt\tTimestamp\tGps_UTC_Date&Time\tStatus\tHeading\n"
    (tmp_path / "imu_gps.txt").write_text(names + "".join(log))
    poses = [f"{START // 10**9 + i / 10:.1f},{48 + 3e-6 * i:.6f},11,2000,0,0,1\n" for i in range(120)]
    names = "time_s,lat_deg,lon_deg,height_m,roll_deg,pitch_deg,heading_deg\n"
    (tmp_path / "poses.csv").write_text(names + "".join(poses))
    np.save(tmp_path / "values.npy", values[..., 0])
    return tmp_path


def strips_of(recording: Path) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Pixels and times of the lines of each strip."""
    found: dict[str, list] = {}
    for message in RecordingReader(recording).messages(["sensor/lines/N"]):
        body = message.body
        assert body.first_line == sum(len(b.pixels) for b in found.get(body.strip, []))
        found.setdefault(body.strip, []).append(body)
    join = np.concatenate
    return {id: (join([b.pixels for b in bs]), join([b.line_times_ns for b in bs])) for id, bs in found.items()}


@pytest.mark.parametrize("as_folder", [False, True])
def test_cubes_become_strips(folder, tmp_path, capsys, as_folder):
    out = str(tmp_path / "o.mcap")
    if as_folder:
        (folder / "flight.toml").write_text(FLIGHT)
        (folder / "camera.json").write_text(
            '{"lenses": [{"id": "L", "focal_length_mm": 60}], "lines": '
            '[{"id": "N", "lens": "L", "pixels": 6, "pixel_size_mm": 0.01, "center_mm": [0, 0]}]}'
        )
        assert main(["import", str(folder), "-o", out]) == 0
    else:
        lines = ["--lines", f"N={folder / 'raw_*'}", "--strip", "N1_"]
        assert main(["import", str(folder / "poses.csv"), "-o", out, *lines]) == 0
    assert "outside the time of the poses and left out: strips N1_115900" in capsys.readouterr().out
    strips, values = strips_of(tmp_path / "o.mcap"), np.load(folder / "values.npy")
    assert list(strips) == ["N1_120001", "N1_120009"]
    np.testing.assert_array_equal(strips["N1_120001"][0], values[20:105])
    np.testing.assert_array_equal(strips["N1_120009"][0], values[105:])
    wanted = np.concatenate([second + 0.01 * np.arange(lines) for second, lines in list(CUBES.values())[1:4]])
    assert np.abs(strips["N1_120001"][1] - START - np.rint(wanted * 1e9)).max() < 10_000


def test_cubes_with_a_first_time_follow_one_another(folder, tmp_path):
    out = str(tmp_path / "o.mcap")
    lines = ["--lines", f"N={folder / 'raw_*'}", "--first-time", "2020-06-01T12:00:01", "--line-rate", "100"]
    assert main(["import", str(folder / "poses.csv"), "-o", out, *lines]) == 0
    (strip,) = [m.body for m in RecordingReader(tmp_path / "o.mcap").messages(["configuration/strip"]) if m.body.ended]
    assert (strip.id, strip.lines) == ("raw_0", 145)


def test_cubes_that_do_not_fit(folder, tmp_path, capsys):
    (folder / "dark_0.txt").write_text("")
    (folder / "other_0").write_bytes((folder / "raw_0").read_bytes())
    (folder / "other_0.hdr").write_text((folder / "raw_0.hdr").read_text())
    write_image(folder / "other_1", np.ones((20, 7, 1), "u1"), "bil")
    write_image(folder / "two_0", np.ones((20, 6, 1), "u1"), "bil")
    for files, wanted in (
        (f"N={folder / 'none_*'}", "none_*: no such files"),
        (f"N={folder / 'dark_*'}", "dark_*: 1 files, none of them an image"),
        (
            f"N={folder / 'other_*'}",
            "other_1: 7 samples of 1 bands of uint8, wanted 6 samples of 1 bands of uint8",
        ),
        (f"N={folder / 'raw_*'},B={folder / 'two_*'}", "1 images from"),
        (f"N={folder / 'raw_0'},B={folder / 'raw_20'}", "raw_20: 30 lines, wanted 20 as in raw_0"),
    ):
        assert refused(folder, files, capsys, wanted)
    index = folder / "frameIndex_50.txt"
    index.unlink()
    assert refused(folder, f"N={folder}/raw_*", capsys, "raw_50: no times of its lines beside it, as raw_0 has them")
    index.write_text((folder / "frameIndex_20.txt").read_text())
    assert refused(folder, f"N={folder}/raw_*", capsys, "frameIndex_50.txt: begins before the cube before it ends")


def refused(folder: Path, files: str, capsys, wanted: str) -> bool:
    """Whether an import of images is refused in one line with these words."""
    code = main(["import", str(folder / "poses.csv"), "-o", str(folder / "no.mcap"), "--lines", files])
    said = capsys.readouterr().err
    assert wanted in said and said.count("\n") == 1, said
    return code == 1
