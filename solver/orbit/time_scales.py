"""Time scales: UTC, TAI, GPS and TT as integer nanoseconds, and the Julian dates that the IAU routines want.

An instant is an integer number of nanoseconds of TAI since 1970-01-01 00:00:00 TAI (``tai_ns``). Leap seconds come from
ERFA's table (`erfa.dat`). A time stamp of recordings, nanoseconds since the Unix epoch in UTC, has no place for a leap
second; all instants inside one get the stamp of the second after.
"""

from __future__ import annotations

import re
import warnings
from functools import lru_cache

import erfa
import numpy as np
from numpy.typing import ArrayLike, NDArray

#: TAI minus the scale, seconds, for scales at a constant distance.
_OFFSETS_S = {"TAI": 0.0, "GPS": 19.0, "TT": -32.184}
SCALES = ("UTC", *_OFFSETS_S)

_SECOND = 1_000_000_000
_DAY = 86_400 * _SECOND
_UNIX_EPOCH_MJD = 40587
_MJD0 = 2400000.5
_ISO = re.compile(
    r"\s*(?P<year>\d{4})-(?:(?P<month>\d\d?)-(?P<day>\d\d?)|(?P<ordinal>\d{3}))"
    r"[T ]\s*(?P<hour>\d\d?):(?P<minute>\d\d?):(?P<second>\d\d?)(?:[.,](?P<fraction>\d*))?"
    r"\s*(?:Z|UTC|(?P<sign>[-+])(?P<hours>\d\d):?(?P<minutes>\d\d))?\s*$"
)


def parse_time(text: str, scale: str = "UTC") -> int:
    """``tai_ns`` of an ISO 8601 text in a scale: ``2018-12-26T10:48:55.4490000Z``, ``2018-360T10:48:55``, with a zone
    ``+01:00``.

    Raises
    ------
    ValueError : not a time, a day that does not exist, or an unknown scale
    """
    found = _ISO.match(text)
    if found is None:
        raise ValueError(f"{text!r} is not a time, wanted YYYY-MM-DDThh:mm:ss.s")
    year, hour, minute, second = (int(found[name]) for name in ("year", "hour", "minute", "second"))
    fraction = (found["fraction"] or "")[:9].ljust(9, "0")
    if not 1900 <= year <= 2200:
        raise ValueError(f"{text!r} lies outside the years 1900 to 2200")
    try:
        if found["ordinal"]:
            first, day = np.datetime64(f"{year:04d}-01-01", "D"), int(found["ordinal"])
            date = first + (day - 1)
            if not day >= 1 or date >= np.datetime64(f"{year + 1:04d}-01-01", "D"):
                raise ValueError
        else:
            date = np.datetime64(f"{year:04d}-{int(found['month']):02d}-{int(found['day']):02d}", "D")
    except ValueError:
        raise ValueError(f"{text!r} is not a day of the calendar") from None
    if hour > 23 or minute > 59 or second > 60:
        raise ValueError(f"{text!r} is not a time of day")
    mjd = int(date.astype(np.int64)) + _UNIX_EPOCH_MJD
    ns = ((hour * 60 + minute) * 60 + second) * _SECOND + int(fraction)
    if not found["sign"]:
        return tai_from_day(mjd, ns, scale)
    if int(found["hours"]) > 14 or int(found["minutes"]) > 59:
        raise ValueError(f"{text!r} has no zone that there is")
    ahead = (int(found["hours"]) * 60 + int(found["minutes"])) * 60 * _SECOND * (-1 if found["sign"] == "-" else 1)
    days, ns = divmod(ns - ahead, _DAY)
    return tai_from_day(mjd + days, ns, scale)


def tai_from_day(mjd: int, ns_of_day: int, scale: str = "UTC") -> int:
    """``tai_ns`` of a modified Julian day and nanoseconds since its midnight, both in a scale.

    Raises
    ------
    ValueError : an unknown scale
    """
    ns = (mjd - _UNIX_EPOCH_MJD) * _DAY + ns_of_day
    if scale == "UTC":
        return ns + _leap_ns(mjd)
    if scale not in _OFFSETS_S:
        raise ValueError(f"time scale {scale!r}, wanted one of {', '.join(SCALES)}")
    return ns + round(_OFFSETS_S[scale] * _SECOND)


def tai_from_unix(utc_ns: ArrayLike) -> NDArray[np.int64]:
    """``tai_ns`` (...) of time stamps (...): nanoseconds since the Unix epoch, UTC without leap seconds."""
    ns = np.asarray(utc_ns, dtype=np.int64)
    leap = np.round(leap_seconds(ns // _DAY + _UNIX_EPOCH_MJD) * _SECOND).astype(np.int64)
    return ns + leap


def unix_from_tai(tai_ns: ArrayLike) -> NDArray[np.int64]:
    """Time stamps (nanoseconds since the Unix epoch, UTC) of instants."""
    tai = np.asarray(tai_ns, dtype=np.int64)
    guess = tai - np.round(leap_seconds(tai // _DAY + _UNIX_EPOCH_MJD) * _SECOND).astype(np.int64)
    # close to a leap second the day of TAI is one day ahead of the day of UTC
    return tai - np.round(leap_seconds(guess // _DAY + _UNIX_EPOCH_MJD) * _SECOND).astype(np.int64)


def iso_utc(tai_ns: int, digits: int = 3) -> str:
    """Text in UTC for messages, ``2018-12-26T10:48:55.449Z``."""
    stamp = np.datetime64(int(unix_from_tai(tai_ns)), "ns")
    text = str(stamp)[: 20 + digits] if digits else str(stamp)[:19]
    return f"{text}Z"


def julian_dates(reference_ns: int, time_s: ArrayLike, scale: str = "TT") -> tuple[float, NDArray[np.floating]]:
    """Two-part Julian date in TT or TAI: days at the midnight before the reference, and days since then.

    Parameters
    ----------
    reference_ns : ``tai_ns``
    time_s : (...) seconds of TAI from the reference
    """
    day, ns = divmod(int(reference_ns), _DAY)
    seconds = ns / _SECOND + np.asarray(time_s, dtype=float) - _OFFSETS_S[scale]
    return _MJD0 + _UNIX_EPOCH_MJD + day, seconds / 86400.0


@lru_cache(maxsize=1024)
def _leap_ns(mjd_utc: int) -> int:
    """TAI minus UTC, nanoseconds, at the midnight that begins a day of UTC: the same for all lines of a scene."""
    return round(float(leap_seconds(np.array([mjd_utc]))[0]) * _SECOND)


def leap_seconds(mjd_utc: NDArray[np.int64]) -> NDArray[np.floating]:
    """TAI minus UTC, seconds, at the midnights that begin these days of UTC."""
    days, back = np.unique(np.asarray(mjd_utc), return_inverse=True)
    with warnings.catch_warnings():  # a year that ERFA calls dubious has the last known number of leap seconds
        warnings.simplefilter("ignore", erfa.ErfaWarning)
        year, month, day, _ = erfa.jd2cal(_MJD0, days.astype(float))
        leap = erfa.dat(year, month, day, 0.0)
    return np.asarray(leap)[back].reshape(np.shape(mjd_utc))
