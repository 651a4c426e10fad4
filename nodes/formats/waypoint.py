"""Text of NovAtel's Waypoint programs: a header in words, names of columns, their units, then a row a pose or position.

Inertial Explorer writes poses, GrafNav positions of the antenna.

Which columns there are, in what order and in what units, the user chooses when he exports. Angles are taken as those of
other navigation files: roll positive with the right side down, pitch with the nose up, heading clockwise from north.
Poses that contradict this by their course and turns are noted, as of any file.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import date, datetime, timedelta
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...solver.navigation.inertial_data import GnssData
from ..errors import UserError
from .gps_time import DAY_S, WEEK_S, gps_week
from .number_rows import numbered_lines, numbers_of
from .plausible import check_units
from .table import MOST_PROBLEMS, one_line
from .time_columns import same_day
from .track import NavigationTrack, checked, times_from_gps

Array = NDArray[np.float64]
#: Lines of a text with their numbers, split into words.
_Rows = list[tuple[int, list[str]]]

#: Quantity -> names of its column, in small letters and without hyphens.
_NAMES = {
    "week": ("week", "gpsweek"),
    "gps": ("gpstime", "corrtime"),
    "utc": ("utctime",),
    "date": ("date", "gpsdate", "utcdate"),
    "lat": ("latitude",),
    "lon": ("longitude",),
    "height": ("hell",),
    "roll": ("roll",),
    "pitch": ("pitch",),
    "heading": ("heading",),
    "sd_n": ("sdnorth", "sdn"),
    "sd_e": ("sdeast", "sde"),
    "sd_u": ("sdheight", "sdh", "sdup"),
    "sd_level": ("sdhoriz",),
    "sd_roll": ("rollsd",),
    "sd_pitch": ("pitchsd", "ptchsd"),
    "sd_heading": ("hdngsd", "headingsd"),
    "quality": ("q",),
}
#: Quantities that have to be there, as Waypoint calls them: of positions, of poses, and the accuracies of positions.
_PLACE = {"lat": "Latitude", "lon": "Longitude", "height": "H-Ell"}
_POSE = _PLACE | {"roll": "Roll", "pitch": "Pitch", "heading": "Heading"}
_ACCURACY = {"sd_n": "SDNorth", "sd_e": "SDEast", "sd_u": "SDHeight"}
_METRES = ("height", "sd_n", "sd_e", "sd_u", "sd_level")
_ANGLES = ("lat", "lon", "roll", "pitch", "heading", "sd_roll", "sd_pitch", "sd_heading")
#: Unit of an angle of one number -> degrees.
_DEGREES = {"deg": 1.0, "arcmin": 1.0 / 60.0, "arcsec": 1.0 / 3600.0, "rad": 180.0 / np.pi}
#: Unit of an angle of several numbers -> how many of these.
_SPLIT = {"dms": 3, "dm": 2}
_PARTS = ("", " (minutes)", " (seconds)")
#: Order of day, month and year, as the unit of a date says it.
_DATES = {"mdy": "%m/%d/%Y", "dmy": "%d/%m/%Y", "ymd": "%Y/%m/%d"}
#: A table begins within so many lines.
_MOST_HEADER = 100


@dataclass(frozen=True)
class _Column:
    """Name and unit (in small letters) of a column, and where its words stand in a row."""

    name: str
    unit: str
    first: int
    words: int


def is_waypoint(path: Path) -> bool:
    """Whether a text has a row of names with a row of units below it, as Waypoint writes them."""
    return bool(_names(path))


def is_grafnav(path: Path) -> bool:
    """Whether it is one without attitudes, as GrafNav writes it."""
    names = _names(path)
    return bool(names) and not names & {"roll", "pitch", "heading"}


def _names(path: Path) -> set[str]:
    """Names of the columns; empty where a file is no text of Waypoint."""
    with open(path, "rb") as file:
        head = file.read(1 << 14)
    if b"\0" in head:
        return set()
    lines = [line for line in head.decode("utf-8-sig", "replace").splitlines() if line.strip()]
    at = _table_at(lines)
    return set() if at is None else {_plain(word) for word in _words(lines[at])}


def read_waypoint(path: Path, day: date | None = None) -> NavigationTrack:
    """Poses of a text of Inertial Explorer.

    The day is that of ``Week``, else of a column with the date, else the one given. ``GPSTime`` and ``CorrTime`` are
    GPS seconds; where there is neither, ``UTCTime`` counts.

    Raises
    ------
    UserError : a column that is missing, a unit that is not known, a value that is malformed (with its line), another
        day
    """
    notes: list[str] = []
    value, time_ns = _read(path, day, _POSE, notes)
    track = NavigationTrack(
        path.stem,
        time_ns,
        np.column_stack([value[name] for name in ("lat", "lon", "height")]),
        np.radians(np.column_stack([value[name] for name in ("roll", "pitch", "heading")])),
        *_sigmas(path, value, notes),
        notes=tuple(notes),
    )
    return check_units(checked(track, path), path, {"lat": "Latitude", "lon": "Longitude", "heading": "Heading"})


def read_grafnav(path: Path, notes: list[str], day: date | None = None) -> GnssData:
    """Positions of the antenna of a text of GrafNav, with their accuracies; the day as of `read_waypoint`.

    Raises
    ------
    UserError : as `read_waypoint`
    """
    value, time_ns = _read(path, day, _PLACE | _ACCURACY, notes)
    if "quality" in value:
        numbers, counts = np.unique(value["quality"], return_counts=True)
        shares = ", ".join(f"{n / len(time_ns):.1%} of quality {q:g}" for q, n in zip(numbers, counts, strict=True))
        notes.append(f"{path.name}: {len(time_ns)} positions: {shares} (1 is the best)")
    lat, lon = np.radians(value["lat"]), np.radians(value["lon"])
    sigma = np.column_stack([value[name] for name in _ACCURACY])
    return GnssData(time_ns * 1e-9, lat, lon, value["height"], sigma)


def _read(
    path: Path, day: date | None, wanted: Mapping[str, str], notes: list[str]
) -> tuple[dict[str, Array], NDArray[np.int64]]:
    """Values by quantity, (n,) each, in degrees and metres, and UTC (n,) in ns since the Unix epoch."""
    lines = numbered_lines(path)
    at = _table_at([text for _, text in lines])
    if at is None:
        raise UserError(f"{path}: no row of names with Latitude and Longitude and a row of their units below it")
    names_at = lines[at][0]
    rows = [(number, _words(text)) for number, text in lines[at + 2 :]]
    while rows and not re.match(r"[-+.\d]", "".join(rows[-1][1])):  # remarks behind the table
        rows.pop()
    columns, total = _columns(lines[at][1], lines[at + 1][1], rows[0][1] if rows else [])
    found = {quantity: c for quantity, names in _NAMES.items() for c in columns if _plain(c.name) in names}
    if "roll" in wanted:
        found.pop("quality", None)  # of solutions of GNSS
    if "sd_level" in found:  # stands for both
        wanted = {quantity: name for quantity, name in wanted.items() if quantity not in ("sd_n", "sd_e")}
    for quantity, name in wanted.items():
        if quantity not in found:
            other = " (H-MSL counts from a geoid)" if quantity == "height" else ""
            raise UserError(f"{path}:{names_at}: {name}: column missing, wanted {', '.join(wanted.values())}{other}")
    wrong = [f"{path}:{number}: {len(words)} values, wanted {total}" for number, words in rows if len(words) != total]
    if wrong:
        raise UserError(one_line(wrong[:MOST_PROBLEMS], max(len(wrong) - MOST_PROBLEMS, 0)))
    value = _values(path, names_at, rows, found)
    if "sd_level" in value:
        value = dict.fromkeys(("sd_n", "sd_e"), value["sd_level"] / np.sqrt(2.0)) | value
    notes += _remarks(path, " ".join(text.strip() for _, text in lines[:at]))
    return value, _times(path, names_at, rows, found, day, notes)


def _table_at(lines: Sequence[str]) -> int | None:
    """Place of the row of names among lines that are not blank; None where there is none."""
    for i, (names, units) in enumerate(pairwise(lines[:_MOST_HEADER])):
        words = {_plain(word) for word in _words(names)}
        if {"latitude", "longitude"} <= words and units.count("(") > 2 and not re.match(r"[\s\"]*[-+.\d]", units):
            return i
    return None


def _words(text: str) -> list[str]:
    return text.replace(",", " ").replace('"', " ").split()


def _plain(name: str) -> str:
    return name.lower().replace("-", "").replace("_", "")


def _columns(names: str, units: str, first_row: Sequence[str]) -> tuple[list[_Column], int]:
    """The columns, and how many words a row has.

    Columns without a unit have nothing in the row of units: each unit is that of the name which ends next to it.
    """
    named, stated = list(re.finditer(r'[^\s,"]+', names)), list(re.finditer(r"\(([^)]*)\)", units))
    unit = [""] * len(named)
    for k, found in enumerate(stated):
        if len(stated) == len(named):
            place = k
        elif "," in units:
            place = units[: found.start()].count(",")
        else:
            place = min(range(len(named)), key=lambda i: abs(named[i].end() - found.end()))
        if place < len(unit):
            unit[place] = re.sub(r"[^a-z]", "", found.group(1).lower())
    out: list[_Column] = []
    first = 0
    for name, its in zip(named, unit, strict=True):
        words = _SPLIT.get(its, 1)
        if its == "hms" and ":" not in "".join(first_row[first : first + 1]):
            words = 3
        out.append(_Column(name.group(), its, first, words))
        first += words
    return out, first


def _values(path: Path, names_at: int, rows: _Rows, found: dict[str, _Column]) -> dict[str, Array]:
    """Places and angles in degrees, lengths in metres, (n,) each."""
    for quantity in (*_ANGLES, *_METRES):
        column = found.get(quantity)
        known = ("m",) if quantity in _METRES else (*_DEGREES, *(_SPLIT if quantity in ("lat", "lon") else ()))
        if column is not None and column.unit not in known:
            what = f"{column.name}: in {column.unit}" if column.unit else f"{column.name}: no unit below it"
            raise UserError(f"{path}:{names_at + 1}: {what}, wanted {' or '.join(known)}")
    place: dict[str, int] = {}
    for quantity, column in found.items():
        if quantity in (*_ANGLES, *_METRES, "quality"):
            place |= {column.name + _PARTS[k]: column.first + k for k in range(column.words)}
    numbers = dict(zip(place, numbers_of(path, rows, place).T, strict=True))
    out: dict[str, Array] = {}
    for quantity, column in found.items():
        if column.name not in numbers:
            continue
        parts = [numbers[column.name + part] for part in _PARTS[: column.words]]
        size = sum(np.abs(part) / 60.0**k for k, part in enumerate(parts))
        out[quantity] = np.copysign(size, parts[0]) * _DEGREES.get(column.unit, 1.0)
    return out


def _sigmas(path: Path, value: dict[str, Array], notes: list[str]) -> tuple[Array | None, Array | None]:
    """Of north, east and up, m, and of roll, pitch and heading, rad, (n, 3) each; None where the file lacks some."""
    position = [value[name] for name in ("sd_n", "sd_e", "sd_u") if name in value]
    attitude = [value[name] for name in ("sd_roll", "sd_pitch", "sd_heading") if name in value]
    for given, what, wanted in (
        (position, "positions", "SDNorth, SDEast and SDHeight"),
        (attitude, "attitudes", "RollSD, PitchSD and HdngSD"),
    ):
        if 0 < len(given) < 3:
            notes.append(f"{path.name}: accuracies of the {what} are not complete and not used, wanted {wanted}")
    return (
        np.column_stack(position) if len(position) == 3 else None,
        np.radians(np.column_stack(attitude)) if len(attitude) == 3 else None,
    )


def _times(
    path: Path, names_at: int, rows: _Rows, found: dict[str, _Column], day: date | None, notes: list[str]
) -> NDArray[np.int64]:
    """UTC (n,) in ns since the Unix epoch."""
    utc = "gps" not in found
    column = found.get("utc" if utc else "gps")
    if column is None:
        raise UserError(f"{path}:{names_at}: GPSTime: column missing, wanted it with Week, or UTCTime with UTCDate")
    clock = column.unit == "hms"
    if clock:
        seconds = _seconds_of_day(path, rows, column)
    elif column.unit == "sec":
        seconds = numbers_of(path, rows, {column.name: column.first})[:, 0]
    else:
        raise UserError(f"{path}:{names_at + 1}: {column.name}: in {column.unit or 'no unit'}, wanted sec or HMS")
    own = _own_day(path, rows, found, None if utc or clock else seconds)
    # beside a date seconds count from midnight or from Sunday, where these differ
    of_day = clock or (own is not None and "week" not in found and seconds.max() < DAY_S and gps_week(own)[1] > 0)
    time_ns = times_from_gps(path, seconds, own or day, notes, of_day=of_day, utc=utc)
    if own is not None:
        same_day(path, int(time_ns[0]), day)
    return time_ns


def _seconds_of_day(path: Path, rows: _Rows, column: _Column) -> Array:
    """Of times in hours, minutes and seconds."""
    out = np.empty(len(rows))
    for i, (number, words) in enumerate(rows):
        text = ":".join(words[column.first : column.first + column.words])
        found = re.fullmatch(r"(\d+):(\d+):(\d+(?:\.\d*)?)", text)
        if found is None:
            raise UserError(f"{path}:{number}: {column.name}: {text!r}, wanted a time as 06:29:06.00")
        out[i] = int(found[1]) * 3600 + int(found[2]) * 60 + float(found[3])
    return out


def _own_day(path: Path, rows: _Rows, found: dict[str, _Column], seconds_of_week: Array | None) -> date | None:
    """The day of the first row, by its week or its date; None where no column says it."""
    number, words = rows[0]
    if "week" in found and seconds_of_week is not None:
        text = words[found["week"].first]
        if not re.fullmatch(r"\d{1,5}(\.0*)?", text):
            raise UserError(f"{path}:{number}: {found['week'].name}: {text!r}, wanted a GPS week")
        days = int(min(max(seconds_of_week[0], 0.0), WEEK_S) // DAY_S) if np.isfinite(seconds_of_week[0]) else 0
        return date(1980, 1, 6) + timedelta(weeks=int(float(text)), days=days)
    if "date" not in found:
        return None
    column = found["date"]
    text = words[column.first].replace("-", "/").replace(".", "/")
    order = _DATES.get(column.unit, _DATES["ymd"])
    try:
        return datetime.strptime(text, order).date()
    except ValueError:
        wanted = f"wanted a date as {column.unit.upper() or 'YMD'}"
        raise UserError(f"{path}:{number}: {column.name}: {words[column.first]!r}, {wanted}") from None


def _remarks(path: Path, head: str) -> list[str]:
    """What the header says that matters for the poses."""
    notes = []
    datum = re.search(r"Datum:\s+([^,(]+?)\s*(?:[,(]|\s{2}|$)", head)
    if datum and not datum[1].upper().replace(" ", "").startswith(("WGS84", "ITRF")):
        notes.append(f"{path.name}: datum {datum[1]}, taken as WGS 84")
    turned = re.search(r"Rotations:\s*(xRot=\s*([-+.\d]+),\s*yRot=\s*([-+.\d]+),\s*zRot=\s*([-+.\d]+) degrees)", head)
    if turned and any(text.strip("-+0.") for text in turned.groups()[1:]):
        notes.append(f"{path.name}: body to sensor rotations applied by Inertial Explorer: {turned[1]}")
    return notes
