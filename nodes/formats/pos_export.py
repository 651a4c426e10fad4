"""Applanix POS Export text: a header in words, then one pose a line."""

from __future__ import annotations

import re
from datetime import date
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...solver.geometry.frames import CrsError
from ..errors import UserError
from .byte_order_mark import read_latin
from .projection import Projection
from .table import MOST_PROBLEMS, one_line
from .track import NavigationTrack, checked, times_from_gps

_NUMBER = r"([-+]?\d+(?:\.\d*)?)"
_WANTED = ("TIME", "ROLL", "PITCH", "HEADING")
#: Quantities of the remark about units that are used -> how their unit begins.
_UNITS = {
    "time": ("sec", "gps sec"),
    "position": ("met",),
    "long": ("deg",),
    "orientation angles and sd": ("deg",),
    "position sd": ("met",),
}
_SIGMAS = ("NORTH SD", "EAST SD", "HEIGHT SD", "ROLL SD", "PITCH SD", "HEADING SD")


def is_pos_export(path: Path) -> bool:
    """Whether a text file begins like one of POS Export."""
    with open(path, "rb") as file:
        return b"POS Export Utility" in file.read(2048)


def read_pos_export(path: Path, day: date | None = None) -> NavigationTrack:
    """Poses of a POS Export file; positions from latitude and longitude, or from the mapping frame where they lack.

    Raises
    ------
    UserError : a file without the header, a column that is missing, a unit other than seconds, metres and degrees, a
        value that is malformed (with line and column)
    """
    notes: list[str] = []
    text = read_latin(path).splitlines()
    place = next((i for i, line in enumerate(text) if re.match(r"\s*TIME\s*,", line)), None)
    if place is None:
        raise UserError(f"{path}: no line of column names, wanted 'TIME, ... ROLL, PITCH, HEADING, ...' of POS Export")
    names = [name.strip().upper() for name in text[place].split(",")]
    for name in _WANTED:
        if name not in names:
            raise UserError(f"{path}:{place + 1}: {name}: column missing, wanted {', '.join(_WANTED)}")
    if "ELLIPSOID HEIGHT" not in names:
        raise UserError(f"{path}:{place + 1}: ELLIPSOID HEIGHT: column missing")
    _check_units(path, text, place + 1)
    head = " ".join(line.strip() for line in text[:place])
    own = _day(head)
    if own is not None and day is not None and abs((own - day).days) > 1:  # they may differ by a night
        raise UserError(f"{path}: --date {day}, but its mission began on {own}; wanted the same day, or no --date")
    day = day or own
    values = _values(path, text, place + 1, names)
    column = {name: values[:, names.index(name)] for name in names}
    lat, lon = _lat_lon(path, head, column, notes)
    for what in ("Boresight", "Lever arm"):
        said = re.search(rf"{what} values:((?:\s*\w+\s*=\s*{_NUMBER}[^,.]*[,.]?){{3}})", head)
        if said and any(float(v) for v in re.findall(rf"=\s*{_NUMBER}", said.group(1))):
            notes.append(f"{path.name}: {what.lower()} applied by POS Export: {said.group(1).strip()}")
    has_position, has_attitude = (all(name in names for name in three) for three in (_SIGMAS[:3], _SIGMAS[3:]))
    track = NavigationTrack(
        path.stem,
        times_from_gps(path, column["TIME"], day, notes),
        np.column_stack([lat, lon, column["ELLIPSOID HEIGHT"]]),
        np.radians(np.column_stack([column["ROLL"], column["PITCH"], column["HEADING"]])),
        np.column_stack([column[name] for name in _SIGMAS[:3]]) if has_position else None,
        np.radians(np.column_stack([column[name] for name in _SIGMAS[3:]])) if has_attitude else None,
        notes=tuple(notes),
    )
    return checked(track, path)


def _day(head: str) -> date | None:
    """Day on which the mission began, where the header says it."""
    said = re.search(r"Date of Mission:\s*(\d{4}-\d{2}-\d{2})", head)
    try:
        return None if said is None else date.fromisoformat(said.group(1))
    except ValueError:
        return None


def _check_units(path: Path, text: list[str], start: int) -> None:
    """Raise UserError where the remark below the names, from line ``start`` (0-based) on, says another unit."""
    for number, line in enumerate(text[start:], start + 1):
        if re.match(r"\s*[-+.\d]", line):
            return
        for what, unit in re.findall(r"([\w ]+?)\s+in\s+([^,)]+)", line):
            wanted = _UNITS.get(what.strip().lower(), ("",))
            if not unit.strip().lower().startswith(wanted):
                known = "seconds, metres and degrees"
                raise UserError(f"{path}:{number}: {what.strip()} in {unit.strip()}, wanted an export in {known}")


def _values(path: Path, text: list[str], start: int, names: list[str]) -> NDArray[np.float64]:
    """Numbers (n, columns) of the lines from ``start`` (0-based) on."""
    rows, problems = [], []
    for number, line in enumerate(text[start:], start + 1):
        fields = line.split()
        if not fields or fields[0].startswith("("):  # the remark about units
            continue
        if fields[0].lower().startswith("(time") or (not rows and not re.match(r"[-+.\d]", fields[0])):
            continue
        if len(fields) != len(names):
            problems.append(f"{path}:{number}: {names[0]}: {len(fields)} values, wanted {len(names)}")
        else:
            numbers = [_number(field) for field in fields]
            bad = next((i for i, value in enumerate(numbers) if not np.isfinite(value)), None)
            if bad is None:
                rows.append(numbers)
            else:
                problems.append(f"{path}:{number}: {names[bad]}: {fields[bad]!r} is not a number")
        if len(problems) >= MOST_PROBLEMS:
            break
    if problems:
        raise UserError(one_line(problems))
    if len(rows) < 2:
        raise UserError(f"{path}: {len(rows)} poses below the header, wanted at least 2")
    return np.array(rows)


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return np.nan


def _lat_lon(
    path: Path, head: str, column: dict[str, NDArray[np.float64]], notes: list[str]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    datum = re.search(r"Mapping frame datum:\s*([^;]+);", head)
    if datum and datum.group(1).strip().upper() not in ("WGS84", "WGS 84"):
        notes.append(f"{path.name}: datum {datum.group(1).strip()}, taken as WGS 84")
    mapped = None
    if "EASTING" in column and "NORTHING" in column:
        crs = mapping_frame(head)
        if crs is not None:
            try:
                mapped = Projection(crs).to_lonlat(column["EASTING"], column["NORTHING"])
            except CrsError as error:
                raise UserError(f"{path}: mapping frame: {error}") from None
    if "LATITUDE" in column and "LONGITUDE" in column:
        lat, lon = column["LATITUDE"], column["LONGITUDE"]
        if mapped is not None:
            east = (mapped[0] - lon + 180.0) % 360.0 - 180.0
            apart = 111_000 * float(np.hypot(east * np.cos(np.radians(lat)), mapped[1] - lat).max())
            if apart > 0.01:
                notes.append(f"{path.name}: mapping frame and latitude/longitude differ by up to {apart:.2f} m")
        return lat, lon
    if mapped is None:
        raise UserError(f"{path}: neither LATITUDE and LONGITUDE nor a transverse Mercator mapping frame")
    return mapped[1], mapped[0]


def mapping_frame(head: str) -> str | None:
    """PROJ string of the transverse Mercator frame that the header describes, None without one."""
    if not re.search(r"Mapping frame projection\s*:\s*(TM|UTM)", head):
        return None
    said: dict[str, str] = {}
    for key, words in (
        ("lon_0", "central meridian"),
        ("lat_0", "latitude of the grid origin"),
        ("k", "grid scale factor"),
        ("x_0", "false easting"),
        ("y_0", "false northing"),
    ):
        found = re.search(rf"{words}\s*=\s*{_NUMBER}", head)
        if found is None:
            return None
        said[key] = found.group(1)
    return "+proj=tmerc " + " ".join(f"+{key}={value}" for key, value in said.items()) + " +datum=WGS84 +units=m"
