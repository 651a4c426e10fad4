"""Times of image lines as Resonon and Headwall write them beside their images."""

from __future__ import annotations

from datetime import date, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
from envi_files import write_image
from tracks import ns

from triline.nodes.cli import main
from triline.nodes.errors import UserError
from triline.nodes.formats.detect import kind_of_path
from triline.nodes.formats.line_time_files import line_times
from triline.nodes.recording.reader import RecordingReader

START = ns("2020-06-01T12:00:00")
LINES = 50


def gps_s(time_ns: int) -> float:
    return time_ns / 1e9 + 18 - 315964800


def image(path: Path) -> Path:
    return write_image(path, np.ones((LINES, 7, 1), "u1"), "bil")


def recorded_times(recording: Path) -> np.ndarray:
    bodies = [message.body for message in RecordingReader(recording).messages(["sensor/lines/N"])]
    return np.concatenate([body.line_times_ns for body in bodies])


# ---- Resonon


def resonon(folder: Path, epoch_s: float = 0.0) -> Path:
    """Image, times and poses of a flight; lines are uneven, the first pose is not to be used."""
    image(folder / "a_Pika_L_1.bil")
    seconds = 4711.25 + np.arange(LINES) * 0.02 + 0.001 * (np.arange(LINES) % 3)
    times = folder / "a_Pika_L_1.bil.times"
    times.write_text("".join(f"{second:.6f}\n" for second in seconds))
    first = gps_s(START) + epoch_s
    rows = [f"{first + 0.1 * i:.3f} 0 0 1 11.0 {48 + 1e-6 * i:.6f} 2000 0 0 {5 * (i > 0)}\n" for i in range(20)]
    (folder / "a_Pika_L_1.lcf").write_text("".join(rows))
    return times


def test_times_of_resonon_lines_begin_with_the_first_pose(tmp_path):
    resonon(tmp_path)
    out = tmp_path / "o.mcap"
    poses = str(tmp_path / "a_Pika_L_1.lcf")
    assert main(["import", poses, "-o", str(out), "--lines", f"N={tmp_path / 'a_Pika_L_1.bil'}"]) == 0
    wanted = START + np.rint((np.arange(LINES) * 0.02 + 0.001 * (np.arange(LINES) % 3)) * 1e9).astype(np.int64)
    assert np.abs(recorded_times(out) - wanted).max() < 1_000_000  # times of the log have milliseconds


def test_resonon_times_with_poses_since_1970(tmp_path):
    times = resonon(tmp_path, 315964800 - 18)
    assert abs(int(line_times(times, date(2020, 6, 1), [])[0]) - START) < 1000


def test_resonon_times_that_cannot_be(tmp_path):
    times = resonon(tmp_path)
    with pytest.raises(UserError, match=r"L_1.bil.times: times of image lines, which `triline import` finds beside"):
        kind_of_path(times)
    rows = times.read_text().splitlines()
    for text, wanted in (
        ([*rows[:3], rows[2], *rows[4:]], r"L_1.bil.times:4: does not come after the line before it"),
        ([*rows[:-1], "9" * 40], r"L_1.bil.times: 1e\+40 s from the first to the last line, wanted less than a day"),
        ([*rows[:3], "now", *rows[4:]], r"L_1.bil.times:4: time: 'now' is not a number"),
    ):
        times.write_text("\n".join(text))
        with pytest.raises(UserError, match=wanted):
            line_times(times, None, [])
    (tmp_path / "a_Pika_L_1.lcf").unlink()
    with pytest.raises(UserError, match=r"since the system was started; wanted a_Pika_L_1.lcf beside it"):
        line_times(times, None, [])


# ---- Headwall

COLUMNS = "Roll\tPitch\tYaw\tLat\tLon\tAlt\tTimestamp\tGps_UTC_Date&Time\tStatus\tHeading\n"
#: Counts a second, and at the first line.
CLOCK_HZ = 1_000_050
FIRST = 987_654_321


def headwall(folder: Path) -> Path:
    """Image, frame index and log of a cube that begins 5 s after the log; its clock is 50 ppm fast."""
    image(folder / "raw_2000")
    counts = [FIRST + round(i * 0.01 * CLOCK_HZ) for i in range(LINES)]
    index = folder / "frameIndex_2000.txt"
    index.write_text("Frame#\tTimestamp\r\n" + "".join(f"{2000 + i}\t{c}\r\n" for i, c in enumerate(counts)))
    log = []
    for i in range(1100):  # 100 Hz, UTC with two decimals, readings of the clock that are late by up to 4 ms
        count = FIRST + round((i * 0.01 - 5.0 + 0.004 * (i * 7 % 11) / 10) * CLOCK_HZ)
        utc = f"{datetime(2020, 6, 1, 11, 59, 55) + timedelta(seconds=i * 0.01):%Y/%m/%d %H:%M:%S.%f}"[:-4]
        log.append(f"0\t0\t1\t{48 + 1e-6 * i:.6f}\t11\t2000\t{count}\t{utc}\t4\t44\n")
    (folder / "imu_gps.txt").write_text(COLUMNS + "".join(log))
    return index


def test_times_of_headwall_lines_by_the_clock_of_the_log(tmp_path):
    headwall(tmp_path)
    out = tmp_path / "o.mcap"
    assert main(["import", str(tmp_path / "imu_gps.txt"), "-o", str(out), "--lines", f"N={tmp_path / 'raw_2000'}"]) == 0
    late = recorded_times(out) - (START + np.arange(LINES) * 10_000_000)
    assert late.min() > -3_000_000 and late.max() < -1_000_000  # by the mean lateness of the readings, 2 ms
    assert np.ptp(late) < 100_000


def test_headwall_times_that_cannot_be(tmp_path):
    index, log = headwall(tmp_path), tmp_path / "imu_gps.txt"
    with pytest.raises(UserError, match=r"frameIndex_2000.txt: times of image lines, which `triline import` finds"):
        kind_of_path(index)
    good, poses = index.read_text(), log.read_text()
    back = poses.replace("12:00:00", "12:00:01")
    for text, other, wanted in (
        (good.replace("Timestamp", "Time"), poses, r"2000.txt:1: 'Frame# Time', wanted the columns Frame# and Timest"),
        (good.replace("\t987654321", "\tx"), poses, r"2000.txt:2: Timestamp: 'x' is not a number"),
        (good.replace("\t987654321", "\t997654321"), poses, r"2000.txt:3: does not come after the line before it"),
        (good.replace("\t98", "\t88"), poses, r"Timestamp: 88\d+ to 88\d+, wanted the range of imu_gps.txt, 98\d+"),
        (good, poses.replace("\tTimestamp", "\tSystemTime"), r"imu_gps.txt:1: Timestamp: column missing, wanted Ti"),
        (good, back, r"imu_gps.txt: Timestamp: \S+ s off a clock that runs evenly, wanted at most 0.1 s while the"),
    ):
        index.write_text(text)
        log.write_text(other)
        with pytest.raises(UserError, match=wanted):
            line_times(index, None, [])
    log.unlink()
    with pytest.raises(UserError, match=r"counts of a clock, wanted imu_gps.txt beside it, which has their UTC"):
        line_times(index, None, [])
