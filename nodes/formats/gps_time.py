"""GPS time: weeks, seconds of the week, leap seconds."""

from __future__ import annotations

from datetime import UTC, date, datetime

import numpy as np
from numpy.typing import ArrayLike, NDArray

WEEK_S = 604_800
DAY_S = 86_400
#: Satellites send the week in 10 bits, and some receivers pass it on so.
WEEK_ROLLOVER = 1024
#: Start of GPS time, in seconds since the Unix epoch.
GPS_EPOCH_S = 315_964_800
#: First day (UTC) from which GPS time is ahead of UTC by 1, 2, 3, ... seconds (IERS Bulletin C).
_LEAPS = (
    "1981-07-01 1982-07-01 1983-07-01 1985-07-01 1988-01-01 1990-01-01 1991-01-01 1992-07-01 1993-07-01 "
    "1994-07-01 1996-01-01 1997-07-01 1999-01-01 2006-01-01 2009-01-01 2012-07-01 2015-07-01 2017-01-01"
)
_LEAP_S = np.array([int(datetime.fromisoformat(day).replace(tzinfo=UTC).timestamp()) for day in _LEAPS.split()])


def gps_week(day: date) -> tuple[int, int]:
    """GPS week of a day, and the day of the week (0 = Sunday)."""
    days = (day - date(1980, 1, 6)).days
    return divmod(days, 7)


def utc_ns_from_gps(week: int, seconds_of_week: ArrayLike) -> NDArray[np.int64]:
    """UTC as integer nanoseconds since the Unix epoch, (n,), of a GPS week and seconds in it (n,)."""
    ns = utc_ns_from_utc(week, seconds_of_week)
    # a leap second counts from the GPS second at which UTC has already fallen behind
    ahead = np.searchsorted(_LEAP_S + np.arange(1, len(_LEAP_S) + 1), ns // 1_000_000_000, side="right")
    return ns - ahead * 1_000_000_000


def utc_ns_from_utc(week: int, seconds_of_week: ArrayLike) -> NDArray[np.int64]:
    """UTC as integer nanoseconds since the Unix epoch, (n,), of a week and seconds in it (n,) that count in UTC."""
    seconds = np.asarray(seconds_of_week, dtype=float)
    whole = np.floor(seconds)
    start_s = GPS_EPOCH_S + week * WEEK_S
    return (start_s + whole.astype(np.int64)) * 1_000_000_000 + np.rint((seconds - whole) * 1e9).astype(np.int64)


def gps_from_utc_ns(utc_ns: ArrayLike) -> tuple[int, NDArray[np.float64]]:
    """GPS week of the first time, and seconds since the start of that week, of UTC nanoseconds (n,)."""
    ns = np.atleast_1d(np.asarray(utc_ns, dtype=np.int64))
    whole, rest = np.divmod(ns, 1_000_000_000)
    gps_s = whole + np.searchsorted(_LEAP_S, whole, side="right") - GPS_EPOCH_S
    week = int(gps_s[0] // WEEK_S)
    return week, (gps_s - week * WEEK_S) + rest * 1e-9


def unwrap_weeks(seconds_of_week: ArrayLike, period_s: int = WEEK_S) -> NDArray[np.float64]:
    """Seconds (n,) that go on over the end of a week (or of a day) instead of starting again from 0."""
    seconds = np.asarray(seconds_of_week, dtype=float)
    turns = np.concatenate([[0], np.cumsum(np.diff(seconds) < -period_s / 2)])
    return seconds + turns * period_s
