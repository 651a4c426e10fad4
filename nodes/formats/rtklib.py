"""RTKLIB positions (``.pos``), as RTKPOST, rnx2rtkp and programs beside them write after a flight."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from datetime import date
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...solver.geometry.earth import R_en, geodetic_from_ecef
from ...solver.navigation.inertial_data import GnssData
from ..convert import LATEST_S
from ..errors import UserError
from .byte_order_mark import read_latin, without_mark
from .gps_time import DAY_S, GPS_EPOCH_S, WEEK_S, utc_ns_from_gps
from .table import MOST_PROBLEMS, one_line

Array = NDArray[np.floating]

#: How a solution was found, by its number in the column Q.
QUALITIES = {1: "fixed", 2: "float", 3: "SBAS", 4: "differential", 5: "single", 6: "PPP"}
#: Columns behind time and position that count, of positions (north, east, up) and of velocities, where there are any.
_SIGMA = ("sdn(m)", "sde(m)", "sdu(m)")
_VELOCITY, _SIGMA_VELOCITY = ("vn(m/s)", "ve(m/s)", "vu(m/s)"), ("sdvn", "sdve", "sdvu")
_ECEF, _SIGMA_ECEF = ("x-ecef(m)", "y-ecef(m)", "z-ecef(m)"), ("sdx(m)", "sdy(m)", "sdz(m)")
_MIXED_ECEF = ("sdxy(m)", "sdyz(m)", "sdzx(m)")
_VELOCITY_ECEF, _SIGMA_VELOCITY_ECEF = ("vx(m/s)", "vy(m/s)", "vz(m/s)"), ("sdvx", "sdvy", "sdvz")
_MIXED_VELOCITY_ECEF = ("sdvxy", "sdvyz", "sdvzx")
_GEODETIC = ("latitude(deg)", "longitude(deg)", "height(m)")
_NAMES = r"%.*(latitude\(|x-ecef\(|e-baseline\()"
_HEAD_BYTES = 16_384


def is_rtklib(path: Path) -> bool:
    """Whether a text file begins like positions of RTKLIB."""
    with open(path, "rb") as file:
        head = without_mark(file.read(_HEAD_BYTES))
    return head.startswith(b"%") and re.search(f"^{_NAMES}".encode(), head, re.MULTILINE) is not None


def read_rtklib(path: Path, notes: list[str]) -> GnssData:
    """Positions of the antenna, with velocities where the file has any.

    Latitude, longitude and ellipsoidal height, or x, y, z; times as day and time in GPST or UTC, or as GPS week and
    seconds. Correlations between north, east and up are not used.

    Raises
    ------
    UserError : no line of column names, or several that differ; columns, times, heights or a datum of another kind; a
        value that is malformed (with its line)
    """
    text = read_latin(path).splitlines()
    places = [i for i, line in enumerate(text) if re.match(_NAMES, line)]
    if not places:
        raise UserError(f"{path}: no line of column names, wanted '% GPST latitude(deg) longitude(deg) ..' of RTKLIB")
    scale, *names = _words(text[places[0]].lstrip("% "))
    where = f"{path}:{places[0] + 1}"
    for other in places[1:]:  # of files that were put one behind the other
        if _words(text[other].lstrip("% ")) != [scale, *names]:
            raise UserError(
                f"{path}:{other + 1}: other columns than in line {places[0] + 1}, wanted one kind in a file"
            )
    if scale not in ("GPST", "UTC"):
        raise UserError(f"{where}: times in {scale}, wanted GPST or UTC")
    cartesian = _ECEF[0] in names
    for name in (*(_ECEF if cartesian else _GEODETIC), "Q", *((*_SIGMA_ECEF, *_MIXED_ECEF) if cartesian else _SIGMA)):
        if name not in names:
            wanted = f"{' '.join(_GEODETIC)} (or {' '.join(_ECEF)}), Q and sigmas"
            raise UserError(f"{where}: {name}: column missing, wanted {wanted}")
    if not cartesian:
        _check_datum(path, text, notes)
    lines = [(i, line) for i, line in enumerate(text, 1) if line.strip() and not line.startswith("%")]
    split = _words if re.search("[,;]", text[places[0]]) else str.split  # a decimal comma is none of RTKLIB's
    fields = [(i, split(line)) for i, line in lines]
    time_s, values = _values(path, fields, names, utc=scale == "UTC")
    column = dict(zip(names, values.T, strict=True))

    def three(columns: Sequence[str]) -> Array:
        return np.column_stack([column[name] for name in columns])

    _tell_quality(path, column["Q"], notes)
    if cartesian:
        lat, lon, height = geodetic_from_ecef(three(_ECEF)).T
        sigma = _along_ned(three(_SIGMA_ECEF), three(_MIXED_ECEF), lat, lon)
    else:
        position = three(_GEODETIC)
        lat, lon, height = np.radians(position[:, 0]), np.radians(position[:, 1]), position[:, 2]
        sigma = three(_SIGMA)
    velocity = sigma_velocity = None
    if all(name in column for name in (*_VELOCITY, *_SIGMA_VELOCITY)):
        velocity, sigma_velocity = three(_VELOCITY) * [1.0, 1.0, -1.0], three(_SIGMA_VELOCITY)
    elif all(name in column for name in (*_VELOCITY_ECEF, *_SIGMA_VELOCITY_ECEF, *_MIXED_VELOCITY_ECEF)):
        velocity = np.einsum("nij,ni->nj", R_en(lat, lon), three(_VELOCITY_ECEF))
        sigma_velocity = _along_ned(three(_SIGMA_VELOCITY_ECEF), three(_MIXED_VELOCITY_ECEF), lat, lon)
    return GnssData(time_s, lat, lon, height, sigma, velocity, sigma_velocity)


def _words(line: str) -> list[str]:
    return re.sub(r"[,;]", " ", line).split()


def _check_datum(path: Path, text: Sequence[str], notes: list[str]) -> None:
    """Raise UserError for a datum or heights of another kind; a note where the file does not say."""
    said = {(i, *kind) for i, line in enumerate(text, 1) for kind in re.findall(r"^%.*height=(\w+)/(\w+)", line)}
    for number, datum, height in sorted(said):
        if datum == "Tokyo":
            raise UserError(f"{path}:{number}: positions in the datum Tokyo, wanted WGS84")
        if height != "ellipsoidal":
            what = f"heights above the geoid ({datum}/{height}), wanted those above the ellipsoid"
            raise UserError(f"{path}:{number}: {what}")
    for datum in sorted({datum for _, datum, _ in said} - {"WGS84"}):  # CGCS2000 of other programs: decimetres
        notes.append(f"{path.name}: datum {datum}, taken as WGS 84")
    if not said:
        notes.append(f"{path.name}: heights are taken as those above the ellipsoid of WGS 84; the file does not say")


def _along_ned(sigma: Array, mixed: Array, lat: Array, lon: Array) -> Array:
    """Sigmas (n, 3) along north, east and down.

    Parameters
    ----------
    sigma : (n, 3) along x, y and z, m
    mixed : (n, 3) of x and y, y and z, z and x: roots of covariances, with their signs, m
    lat, lon : (n,) radians
    """
    C = np.square(sigma)[:, :, None] * np.eye(3)
    for (i, j), root in zip(((0, 1), (1, 2), (2, 0)), mixed.T, strict=True):
        C[:, i, j] = C[:, j, i] = root * np.abs(root)
    to_e = R_en(lat, lon)
    return np.sqrt(np.maximum(np.einsum("nij,nik,nkj->nj", to_e, C, to_e), 0.0))


def _values(
    path: Path, lines: Sequence[tuple[int, list[str]]], names: Sequence[str], *, utc: bool
) -> tuple[Array, NDArray[np.float64]]:
    """Times (n,), seconds since the Unix epoch, and values (n, columns) of the numbered lines."""
    times, rows, problems = [], [], []
    for number, fields in lines:
        try:
            times.append(_utc_s(fields[0], fields[1], utc=utc))
            rows.append([float(field) for field in fields[2 : 2 + len(names)]])
            if len(rows[-1]) != len(names):
                raise ValueError
        except (ValueError, IndexError, OverflowError):
            when = "day and time" if utc else "day and time (or week and seconds)"
            wanted = f"{when} and {len(names)} values as the names say"
            problems.append(f"{path}:{number}: {' '.join(fields)[:60]!r}, wanted {wanted}")
            if len(problems) >= MOST_PROBLEMS:
                break
    if problems:
        raise UserError(one_line(problems))
    if not rows:
        raise UserError(f"{path}: no position below the column names")
    return np.array(times), np.array(rows)


def _utc_s(day: str, time: str, *, utc: bool) -> float:
    """Seconds since the Unix epoch of ``2024/05/17 09:30:00.250``, or of week and seconds (GPST).

    Raises
    ------
    ValueError : no such time
    """
    if "/" in day:
        hours, minutes, seconds = time.split(":")
        if not (0 <= int(hours) < 24 and 0 <= int(minutes) < 60 and 0.0 <= float(seconds) < 61.0):
            raise ValueError
        days = (date.fromisoformat(day.replace("/", "-")) - date(1980, 1, 6)).days
        week, seconds_s = 0, days * DAY_S + int(hours) * 3600 + int(minutes) * 60 + float(seconds)
        if utc:
            return _bounded(seconds_s) + GPS_EPOCH_S
    elif utc:  # RTKLIB counts these weeks without leap seconds
        raise ValueError
    else:
        week, seconds_s = int(day), float(time)
    _bounded(week * WEEK_S + seconds_s)
    return float(utc_ns_from_gps(week, seconds_s)) * 1e-9


def _bounded(seconds_s: float) -> float:
    """Seconds since 1980-01-06, where these can be times of a flight.

    Raises
    ------
    ValueError : they cannot
    """
    if not 0.0 <= seconds_s < LATEST_S - GPS_EPOCH_S:
        raise ValueError
    return seconds_s


def _tell_quality(path: Path, quality: Array, notes: list[str]) -> None:
    """A note about how solutions were found: fixed ones are some centimetres good, others are not."""
    counts = Counter(
        QUALITIES.get(int(q), "of no known kind") if np.isfinite(q) else "of no known kind" for q in quality
    )
    shares = ", ".join(f"{n / len(quality):.1%} {name}" for name, n in counts.most_common())
    notes.append(f"{path.name}: {len(quality)} positions: {shares}")
