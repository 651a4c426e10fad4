"""Pose logs of hyperspectral line scanners: Headwall's ``imu_gps.txt`` and Resonon's ``.lcf``."""

from __future__ import annotations

import re
from datetime import date
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..convert import LATEST_S
from ..errors import UserError
from .byte_order_mark import without_mark
from .gps_time import GPS_EPOCH_S, utc_ns_from_gps
from .number_rows import numbered_lines, numbers_of
from .plausible import check_units
from .table import one_line
from .time_columns import is_same_day, same_day
from .track import NavigationTrack, checked

_HEADWALL = ("Roll", "Pitch", "Yaw", "Lat", "Lon", "Alt")
_HEADWALL_TIME = "Gps_UTC_Date&Time"
_HEADWALL_CLOCK = "Timestamp"
_LCF = ("time", "roll", "pitch", "yaw", "longitude", "latitude", "altitude")


def is_headwall(path: Path) -> bool:
    """Whether the first line is that of an ``imu_gps.txt``."""
    with open(path, "rb") as file:
        names = without_mark(file.readline(1024)).decode("latin-1").strip().split("\t")
    return names[:3] == ["Roll", "Pitch", "Yaw"]


def is_resonon(path: Path) -> bool:
    """Whether a file is named like a Resonon log."""
    return path.suffix.lower() == ".lcf"


def read_headwall(path: Path, day: date | None = None) -> NavigationTrack:
    """Poses of an ``imu_gps.txt``: tabs, ``Roll Pitch Yaw Lat Lon Alt`` in degrees and metres, and the UTC of the GPS.

    The time of a pose is ``Gps_UTC_Date&Time`` (``2018/08/28 19:34:25.05`` or ``2018/Aug/28 ...``). The first of
    poses with the same time counts: the log repeats a GPS time between fixes.

    Raises
    ------
    UserError : a column that is missing, a value that is malformed (with its line), another day
    """
    values, time_ns, keep = _headwall(path, _HEADWALL)
    same_day(path, int(time_ns[0]), day)
    notes = (f"{path.name}: Alt is taken as height above the ellipsoid (WGS 84)",)
    if not keep.all():
        notes += (f"{path.name}: {int((~keep).sum())} poses repeat the time of the one before them and were left out",)
    rpy = np.radians(values[keep, :3])
    track = NavigationTrack(path.stem, time_ns[keep], values[keep, 3:], rpy, notes=notes)
    return check_units(checked(track, path), path, {"lat": "Lat", "lon": "Lon", "heading": "Yaw"})


def headwall_clock(path: Path) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Readings (n,) of the clock ``Timestamp`` of an ``imu_gps.txt``, rising, and their UTC (n,), ns.

    Raises
    ------
    UserError : a column that is missing, a value that is malformed (with its line)
    """
    values, time_ns, keep = _headwall(path, (_HEADWALL_CLOCK,))
    clock, first = np.unique(values[keep, 0], return_index=True)
    return clock, time_ns[keep][first]


def _headwall(path: Path, columns: tuple[str, ...]) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.bool_]]:
    """Columns (n, columns) of an ``imu_gps.txt``, the UTC (n,) of its rows, ns, and which do not repeat that before."""
    lines = [(i, text.split("\t")) for i, text in numbered_lines(path)]
    names = [name.strip() for name in lines[0][1]] if lines else []
    for name in (*columns, _HEADWALL_TIME):
        if name not in names:
            wanted = ", ".join((*columns, _HEADWALL_TIME))
            raise UserError(f"{path}:1: {name}: column missing, wanted {wanted}, between tabs")
    values = numbers_of(path, lines[1:], {name: names.index(name) for name in columns})
    place = names.index(_HEADWALL_TIME)
    words = [fields[place].strip() if place < len(fields) else "" for _, fields in lines[1:]]
    time_ns, bad = _utc_ns(words)
    if len(bad):
        where = f"{path}:{lines[1 + bad[0]][0]}: {_HEADWALL_TIME}"
        problem = f"{where}: {words[bad[0]]!r}, wanted a UTC time as 2018/08/28 19:34:25.05"
        raise UserError(one_line([problem], len(bad) - 1))
    return values, time_ns, np.concatenate([[True], np.diff(time_ns) != 0])


def read_resonon(path: Path, day: date | None = None) -> NavigationTrack:
    """Poses of an ``.lcf``: time (GPS seconds since 1980), roll, pitch, yaw (rad), longitude, latitude (deg), altitude
    above the ellipsoid (m), two numbers that mean nothing, and 5 of a line to be used, 0 of another.

    As Resonon specifies it roll is positive with the right wing up, against the rule of all other files. Times are
    seconds since 1970 (UTC) where only these are of the day that is given.

    Raises
    ------
    UserError : a value that is missing or malformed (with its line), degrees where radians are wanted, another day
    """
    every = [(i, text.split()) for i, text in numbered_lines(path) if not text.startswith("#")]
    rows = np.array([k for k, (_, fields) in enumerate(every) if fields[9:10] != ["0"]], dtype=np.intp)
    rows = rows if len(rows) else np.arange(len(every))  # of a program that does not know this column
    lines = [every[k] for k in rows]
    values = numbers_of(path, lines, {name: i for i, name in enumerate(_LCF)})
    angles = np.abs(values[:, 1:4])
    bad = np.argwhere(angles > 2 * np.pi + 1e-3)
    if len(bad):
        row, column = bad[0]
        where = f"{path}:{lines[row][0]}: {_LCF[1 + column]}"
        raise UserError(
            one_line([f"{where}: {values[row, 1 + column]:g}, wanted radians; are they degrees?"], len(bad) - 1)
        )
    time_ns, scale = _resonon_utc_ns(path, lines, values[:, 0], day)
    begin = np.datetime64(int(time_ns[0]), "ns").astype("datetime64[s]")
    notes = (
        f"{path.name}: times are taken as {scale}: the flight begins at {begin}Z",
        f"{path.name}: roll is taken as positive with the right wing up, altitude as height above the ellipsoid",
    )
    if len(lines) < len(every):
        notes += (f"{path.name}: {len(every) - len(lines)} poses that the file says not to use were left out",)
    rpy = values[:, 1:4] * [-1.0, 1.0, 1.0]
    track = NavigationTrack(path.stem, time_ns, values[:, [5, 4, 6]], rpy, notes=notes)
    return check_units(checked(track, path, rows), path, {"lat": "latitude", "lon": "longitude", "heading": "yaw"})


def resonon_first_ns(path: Path, day: date | None = None) -> int:
    """UTC of the first pose of an ``.lcf``, whether it is to be used or not, in ns since the Unix epoch.

    Raises
    ------
    UserError : a time that is missing or malformed, another day
    """
    lines = [(i, text.split()) for i, text in numbered_lines(path) if not text.startswith("#")]
    seconds = numbers_of(path, lines, {_LCF[0]: 0})[:, 0]
    return int(_resonon_utc_ns(path, lines, seconds, day)[0][0])


def _resonon_utc_ns(
    path: Path, lines: list[tuple[int, list[str]]], seconds: NDArray[np.float64], day: date | None
) -> tuple[NDArray[np.int64], str]:
    """UTC (n,), ns, of the times of an ``.lcf``, and since when they count."""
    bad = np.flatnonzero(~((seconds >= 0.0) & (seconds < LATEST_S - GPS_EPOCH_S)))
    if len(bad):
        what = f"{path}:{lines[bad[0]][0]}: {_LCF[0]}: {seconds[bad[0]]:.6g}, wanted GPS seconds since 1980-01-06"
        raise UserError(one_line([what], len(bad) - 1))
    time_ns, scale = utc_ns_from_gps(0, seconds), "GPS seconds since 1980-01-06"
    since_1970_ns = np.rint(seconds * 1e6).astype(np.int64) * 1000
    if day is not None and not is_same_day(int(time_ns[0]), day) and is_same_day(int(since_1970_ns[0]), day):
        time_ns, scale = since_1970_ns, "seconds since 1970-01-01 (UTC)"
    same_day(path, int(time_ns[0]), day)
    return time_ns, scale


def _utc_ns(words: list[str]) -> tuple[NDArray[np.int64], NDArray[np.intp]]:
    """Times (n,) in ns since the Unix epoch of ``2018/08/28 19:34:25.05`` (or a month in words), and which are none."""
    import pandas as pd

    month = "%b" if re.match(r"\d+/[A-Za-z]", words[0]) else "%m"
    whole = pd.to_datetime([w.partition(".")[0] for w in words], format=f"%Y/{month}/%d %H:%M:%S", errors="coerce")
    instants = np.asarray(whole, dtype="datetime64[ns]")
    parts = [w.partition(".")[2] or "0" for w in words]
    digits = np.array([part.isdecimal() for part in parts])
    fraction_ns = np.array([round(float(f"0.{p}") * 1e9) if p.isdecimal() else 0 for p in parts], dtype=np.int64)
    return instants.astype(np.int64) + fraction_ns, np.flatnonzero(np.isnat(instants) | ~digits)
