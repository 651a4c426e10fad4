"""Times in CSV files: ISO 8601, seconds since the Unix epoch, GPS seconds with week or day."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from datetime import UTC, date, datetime
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..convert import LATEST_S, SECOND_NS
from ..errors import UserError
from .gps_time import DAY_S, WEEK_ROLLOVER, WEEK_S, gps_week, unwrap_weeks, utc_ns_from_gps
from .table import Column, Table
from .track import times_from_gps

if TYPE_CHECKING:
    import pandas as pd


Array = NDArray[np.floating]

#: Names of columns with a time in words; ``date`` beside one holds its day.
ISO = ("time", "time_utc", "utc", "timestamp", "datetime")
#: Names of columns with GPS seconds, of the week or since 1980-01-06.
GPS = ("gps_s", "gps_time_s", "gps_seconds", "sow_s", "tow_s")
WEEKS = ("week", "gps_week")
#: What a file may hold.
WANTED = "time_s (UTC, since 1970), time (ISO 8601), or gps_s (of the week, with week or --date)"


def time_columns(header: Iterable[str]) -> list[Column]:
    """The columns with the time among the names of a header; empty where there is none."""
    names = list(header)
    seconds = [name for name in names if name == "time_s"]
    gps = [name for name in names if name in GPS]
    words = [name for name in names if name in ISO]
    if seconds:
        return [Column(seconds[0])]
    if gps:
        return [Column(gps[0], low=0.0), *(Column(name, "integer", low=0) for name in names if name in WEEKS)]
    if words:
        return [Column(name, "text") for name in (*words[:1], *(n for n in names if n == "date"))]
    return []


def times_of(table: Table, columns: list[Column], day: date | None, notes: list[str]) -> NDArray[np.int64]:
    """UTC (n,) in ns since the Unix epoch, of the columns that `time_columns` found.

    Parameters
    ----------
    table : with these columns
    columns : from `time_columns`
    day : of the flight, from the user; needed for GPS seconds of the week without a week, compared with all others
    notes : gets a remark where the day is not known

    Raises
    ------
    UserError : a time that cannot be read, by line and column; a day that is not that of the file
    """
    name = columns[0].name
    if name == "time_s":
        seconds = table[name]
        bad = ~(np.abs(seconds) < LATEST_S)
        table.refuse(bad, name, lambda i: f"{seconds[i]:.6g}, wanted seconds since 1970-01-01 UTC")
        table.refuse(seconds < 0, name, lambda i: f"{seconds[i]:.6g} is before 1970, wanted UTC seconds since then")
        time_ns = _ns(seconds)
    elif name in GPS:
        time_ns, given = _from_gps(table, columns, day, notes)
        if not given:
            return time_ns
    else:
        time_ns = _from_words(table, columns)
    same_day(table.path, int(time_ns[0]), day)
    return time_ns


def same_day(path: Path, first_ns: int, day: date | None) -> None:
    """Raise UserError where a file that knows its day knows another than the user's (they may differ by a night)."""
    if day is not None and not is_same_day(first_ns, day):
        own = _day_of(first_ns)
        raise UserError(f"{path}: --date {day}, but its times begin on {own}; wanted the same day, or no --date")


def is_same_day(first_ns: int, day: date) -> bool:
    """Whether a UTC is of a day, or within a night of it."""
    return abs((_day_of(first_ns) - day).days) <= 1


def _day_of(time_ns: int) -> date:
    return datetime.fromtimestamp(time_ns // SECOND_NS, UTC).date()


def instant_ns(text: str, what: str) -> int:
    """UTC in ns since the Unix epoch of an ISO 8601 time; one without a zone is UTC.

    Raises
    ------
    UserError : naming ``what``
    """
    time_ns = instants_ns([text], lambda _: what)
    return int(time_ns[0])


def instants_ns(texts: Sequence[str], what: Callable[[int], str]) -> NDArray[np.int64]:
    """UTC (n,) in ns since the Unix epoch of ISO 8601 times; those without a zone are UTC. One takes a millisecond, and
    thousands take hardly longer.

    Parameters
    ----------
    what : names a time by its place among them

    Raises
    ------
    UserError : naming the first that cannot be read
    """
    read = _read_words(texts)
    for i in np.flatnonzero(read.isna().to_numpy())[:1].tolist():
        raise UserError(f"{what(i)}: {texts[i]!r}, wanted an ISO 8601 time as 2024-05-17T09:30:00.5Z")
    time_ns = _datetime_ns(read)
    for i in np.flatnonzero(time_ns < 0)[:1].tolist():
        raise UserError(f"{what(i)}: {texts[i]!r} is before 1970, wanted UTC since then")
    return time_ns


def _ns(seconds: Array) -> NDArray[np.int64]:
    whole = np.floor(seconds)
    return whole.astype(np.int64) * SECOND_NS + np.rint((seconds - whole) * 1e9).astype(np.int64)


def _datetime_ns(times: pd.Series) -> NDArray[np.int64]:
    return times.dt.tz_convert(None).to_numpy().astype("datetime64[ns]").astype(np.int64)


def _read_words(words: Iterable[str]) -> pd.Series:
    """ISO 8601 times as pandas reads them, NaT for what is none; ISO 8601 has decimal commas as well as points."""
    import pandas as pd

    points = [word.replace(",", ".") for word in words]
    return pd.to_datetime(pd.Series(points, dtype=object), format="ISO8601", utc=True, errors="coerce")


def _from_words(table: Table, columns: list[Column]) -> NDArray[np.int64]:
    name = columns[0].name
    words = table[name].astype(str)
    if len(columns) > 1:
        words = np.array([f"{d}T{t}" for d, t in zip(table["date"].astype(str), words, strict=True)], dtype=object)
    else:
        plain = np.array([word.replace(",", ".").replace(".", "", 1).isdigit() for word in words])
        table.refuse(plain, name, lambda i: f"{words[i]} has no scale, wanted an ISO 8601 time, or a column {WANTED}")
    read = _read_words(words)
    wanted = "wanted an ISO 8601 time as 2024-05-17T09:30:00.5Z"
    table.refuse(read.isna().to_numpy(), name, lambda i: f"{str(words[i])!r}, {wanted}")
    time_ns = _datetime_ns(read)
    table.refuse(time_ns < 0, name, lambda i: f"{str(words[i])!r} is before 1970, wanted UTC since then")
    return time_ns


def _from_gps(
    table: Table, columns: list[Column], day: date | None, notes: list[str]
) -> tuple[NDArray[np.int64], bool]:
    """Times, and whether the file knows its day by itself."""
    name = columns[0].name
    seconds = table[name]
    if len(columns) > 1:
        week = table[columns[1].name]
        bad = ~(seconds < WEEK_S)
        table.refuse(bad, name, lambda i: f"{seconds[i]:.6g}, wanted seconds of the week, 0 to {WEEK_S}")
        week = week + WEEK_ROLLOVER * np.concatenate([[0], np.cumsum(np.diff(week) < -WEEK_ROLLOVER / 2)])
        first = int(week[0])
        turns = 0 if day is None else max(round((gps_week(day)[0] - first) / WEEK_ROLLOVER), 0)
        if turns and first < WEEK_ROLLOVER:
            week, first = week + turns * WEEK_ROLLOVER, first + turns * WEEK_ROLLOVER
            what = f"counts modulo {WEEK_ROLLOVER}: week {first} by the day given"
            notes.append(f"{table.path.name}: {columns[1].name} {what}")
        time_ns = utc_ns_from_gps(first, seconds + (week - first) * WEEK_S)
        if day is None and first < WEEK_ROLLOVER:
            own = datetime.fromtimestamp(int(time_ns[0]) // SECOND_NS, UTC).date()
            what = f"if it counts modulo {WEEK_ROLLOVER}, wanted the day of the flight (--date)"
            notes.append(f"{table.path.name}: {columns[1].name} {first} is that of {own}; {what}")
        return time_ns, True
    if (seconds >= 2 * WEEK_S).any():
        low, high = 20 * 365 * DAY_S, (2100 - 1980) * 366 * DAY_S
        bad = ~((seconds >= low) & (seconds < high))
        wanted = f"wanted seconds of the week (0 to {WEEK_S}) or since 1980-01-06"
        table.refuse(bad, name, lambda i: f"{seconds[i]:.6g}, {wanted}")
        time_ns = utc_ns_from_gps(0, seconds)
        if day is None:
            begin = np.datetime64(int(time_ns[0]), "ns").astype("datetime64[s]")
            notes.append(f"{table.path.name}: {name} counts since 1980-01-06: the flight begins at {begin}Z")
        return time_ns, True
    return times_from_gps(table.path, unwrap_weeks(seconds), day, notes), False
