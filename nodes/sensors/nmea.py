"""NMEA 0183: GGA or GNS, RMC, ZDA and GST become ``sensor/gnss``, PASHR and HDT ``sensor/attitude``.

A fix goes out with its GGA, or its GNS where no GGA comes. Its date is that of the last RMC or ZDA, its accuracy that
of the last GST, which may come before it or after it; without GST, or with one of another quality, it follows from the
quality and the HDOP of the fix. An attitude goes out with its PASHR, which has its own time and accuracy; headings of
HDT, which have neither, only where they are wanted and no PASHR comes. Sentences are decoded by pynmeagps.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, date, datetime, timedelta
from datetime import time as time_of_day
from pathlib import Path
from threading import Event
from typing import TYPE_CHECKING, Any

import numpy as np
from pynmeagps import GET, VALCKSUM, NMEAReader

from ..convert import SECOND_NS, attitude_message, check_angles, check_place, gnss_message
from ..formats.course import MOST_CRAB_DEG, SLOW_M_S
from ..formats.gps_time import WEEK_ROLLOVER
from ..formats.keys import Keys
from ..node import Message
from ..ordering import REBASE_AFTER
from .bytes_in import check_address, read_bytes
from .program import Clock, Sensor, publish, refuse_unknown

if TYPE_CHECKING:
    from ..bus.program import ProgramOptions

KEYS = ("address", "baud", "date", "heading_sigma_deg", "level_sigma_deg", "velocity_sigma_m_s")
Triple = tuple[float, float, float]
#: Sentences that are read; others pass by.
READ = ("GGA", "GNS", "RMC", "ZDA", "GST", "HDT", "SHR")
#: Horizontal sigma, m, at HDOP 1, by the quality of a GGA (SPS, DGPS, PPS, RTK fixed, RTK float, simulator); usual
#: figures of such solutions. Heights are taken to be twice as poor.
QUALITY_SIGMA_M = {1: 2.5, 2: 1.0, 3: 2.5, 4: 0.02, 5: 0.3, 8: 2.5}
#: Sentences of Ashtech have a letter where the one with attitudes has a time.
OTHER_SHR = tuple(b"$PASHR," + bytes([letter]) for letter in b"ABCDEFGHIJKLMNOPQRSTUVWXYZ")
#: Quality of a GGA that says the same as a mode of a GNS; its other modes are no fix.
GNS_QUALITY = {"R": 4, "F": 5, "P": 3, "D": 2, "A": 1, "S": 8}
#: A GST holds for fixes of the same quality so long after it, s.
GST_HOLDS_S = 5.0
#: A vertical velocity that no sentence tells is taken as 0 with this sigma, m/s.
UNKNOWN_CLIMB_M_S = 20.0
#: No sentence is longer (82 by the standard; some receivers write more), bytes.
LONGEST = 512
#: So many headings are compared with the course.
HEADINGS = 20
KNOT_M_S = 1852.0 / 3600.0
#: A minute of latitude, m.
MINUTE_M = 1852.0


@dataclass(frozen=True)
class NmeaSettings:
    """What a table says; see docs/flight-folder.md."""

    id: str
    address: str
    baud: int
    clock: Clock
    day: date | None
    heading_sigma_deg: float
    level_sigma_deg: float
    velocity_sigma_m_s: float

    @classmethod
    def read(cls, keys: Keys, folder: Path) -> NmeaSettings:
        """From a table of a flight.toml or of a configuration.

        Raises
        ------
        UserError : a key that is not known, or a value that cannot be
        """
        refuse_unknown(keys, KEYS)
        try:
            address = check_address(keys.text("address"), folder)
        except ValueError as error:
            raise keys.refuse("address", str(error)) from None
        day = keys.raw("date")
        if day is not None and (not isinstance(day, date) or isinstance(day, datetime)):
            raise keys.refuse("date", "a day as 2024-05-17, without quotes")
        return cls(
            keys.text("id", "nmea"), address, keys.integer("baud", 115200, low=300), Clock.of(keys), day,
            *(keys.number(key, 0.0 if key != "level_sigma_deg" else 5.0, positive=keys.has(key)) for key in KEYS[3:]),
        )  # fmt: skip

    def in_full(self) -> dict[str, Any]:
        """What a table has to say in another folder."""
        return {"address": self.address}


class NmeaParser:
    """Bytes in, messages out.

    Parameters
    ----------
    settings : see `NmeaSettings`
    problem : counts what cannot be used: kind, text
    """

    def __init__(self, settings: NmeaSettings, problem: Any) -> None:
        self._settings, self._problem = settings, problem
        self._rest = b""
        self._newest: datetime | None = None
        self._fixes, self._attitudes = _Forward(), _Forward()
        self._last_heading_ns = -1
        self._epoch_ns = -1  # of the newest fix or RMC
        self._gga_comes = self._shr_comes = False  # so that GNS, and HDT, are not wanted
        self._gns_ns = -1  # of the newest fix of a GNS
        self._stated: tuple[int, tuple[float, float, float]] | None = None  # sigmas, of a GST
        self._quality = self._stated_quality = 0  # of the newest fix, and of the one a GST is about
        self._motion: tuple[int, tuple[float, float]] | None = None  # east and north velocity, of an RMC
        self._few_told = False  # that fixes are rounded
        self._era_told = False  # that weeks count modulo 1024
        self._off_deg: list[float] = []  # of the first headings from the course

    def feed(self, data: bytes) -> list[Message]:
        """The messages that follow from more bytes."""
        *lines, self._rest = (self._rest + data).split(b"\n")
        if len(self._rest) > LONGEST:
            self._problem("not NMEA", f"{len(self._rest)} bytes without an end of line: {_shown(self._rest)}")
            begun = self._rest[-LONGEST:].rpartition(b"$")[1:]  # a sentence that follows what was no NMEA
            self._rest = b"".join(begun) if begun[0] else b""
        return [message for line in lines for message in self._line(line.strip())]

    def _line(self, line: bytes) -> list[Message]:
        if not line:
            return []
        start = line.rfind(b"$")  # binary messages of the receiver may stand before it, with any bytes
        if start < 0 or len(line) - start > LONGEST:
            self._problem("not NMEA", _shown(line))
            return []
        line = line[start:]
        kind = line.split(b",", 1)[0][-3:].decode("ascii", "replace")
        if kind not in READ or line.startswith(OTHER_SHR):
            return []
        if b"*" not in line:
            self._problem("no checksum", _shown(line))
            return []
        if line.startswith(b"$PASHR,,"):  # before its alignment; no sentence to the library
            self._problem("no attitude", "PASHR without time")
            return []
        try:
            sentence: Any = NMEAReader.parse(line + b"\r\n", msgmode=GET, validate=VALCKSUM)
        except Exception as error:  # of several classes, some of them not the library's
            kind = "bad checksum" if "checksum" in str(error).lower() else "not readable"
            self._problem(kind, f"{_shown(line)}: {error}")
            return []
        try:
            return getattr(self, "_" + kind.lower())(sentence)
        # a field that is missing, empty, no number or too large
        except (TypeError, ValueError, LookupError, AttributeError, OverflowError):
            self._problem("field missing", _shown(line))
            return []

    # ---- sentences

    def _rmc(self, s: Any) -> list[Message]:
        if s.status != "A":  # nor is the date to be believed: that of a receiver without a fix begins in 1980
            return []
        if isinstance(s.date, date):
            self._newest = _at(self._in_this_era(s.date), s.time)
        utc_ns = self._utc(s.time)
        if utc_ns is not None:
            self._epoch_ns = utc_ns
            if s.spd != "" and s.cog != "":
                speed, course = _number(s.spd) * KNOT_M_S, np.radians(_number(s.cog))
                self._motion = utc_ns, (float(speed * np.sin(course)), float(speed * np.cos(course)))
                if self._settings.velocity_sigma_m_s and utc_ns == self._fixes.newest_ns:  # the fix has gone out
                    self._problem("RMC after its GGA", "velocities go with fixes whose RMC comes before the GGA")
        return []

    def _zda(self, s: Any) -> list[Message]:
        self._newest = _at(self._in_this_era(date(int(s.year), int(s.month), int(s.day))), s.time)
        return []

    def _gst(self, s: Any) -> list[Message]:
        utc_ns = self._utc(s.time)
        east, north, up = _number(s.stdLong), _number(s.stdLat), _number(s.stdAlt)
        if utc_ns is not None and min(east, north, up) > 0:
            self._stated, self._stated_quality = (utc_ns, (east, north, up)), self._quality
        return []

    def _gga(self, s: Any) -> list[Message]:
        self._gga_comes = True
        units = s.altUnit, getattr(s, "sepUnit", "")
        if set(units) - {"M", ""}:
            self._problem("not in metres", f"GGA with heights in {' and '.join(units)}, wanted M")
            return []
        return self._fix("GGA", s, int(s.quality), s.payload[10])

    def _gns(self, s: Any) -> list[Message]:
        if self._gga_comes:
            return []
        quality = next((quality for mode, quality in GNS_QUALITY.items() if mode in s.posMode), 0)
        messages = self._fix("GNS", s, quality, s.payload[9])
        if messages:
            self._gns_ns = self._fixes.newest_ns
        return messages

    def _fix(self, name: str, s: Any, quality: int, separation: str) -> list[Message]:
        """A fix from a sentence GGA or GNS, with its quality and its geoid separation as a text."""
        self._quality = quality
        if quality not in QUALITY_SIGMA_M:
            self._problem("no fix", f"{name} of quality {quality}")
            return []
        if s.sep == "" or s.alt == "":
            self._problem("no geoid separation", f"{name} without height above the ellipsoid")
            return []
        _, latitude, north, longitude, east = s.payload[:5]
        if north not in ("N", "S") or east not in ("E", "W") or "-" in latitude + longitude:
            what = f"{name} at {latitude} {north}, {longitude} {east}, wanted N or S, and E or W"
            self._problem("no hemisphere", what)
            return []
        utc_ns = self._utc(s.time)
        if utc_ns is None:
            self._problem("no date yet", f"{name} before the first RMC or ZDA; or give date")
            return []
        if not self._fixes.goes_on(utc_ns):
            if utc_ns != self._gns_ns:  # the first GGA may come after a GNS
                self._problem("time does not go on", f"{name} of {s.time} does not come after the one before")
            return []
        self._epoch_ns = utc_ns
        place = _number(s.lat), _number(s.lon), _number(s.alt) + _number(s.sep)
        check_place(*place)
        sigma = self._as_written(self._sigma(utc_ns, quality, s.HDOP), name, _rounding_m(s, separation))
        velocity: tuple[Any, ...] = ()
        if self._settings.velocity_sigma_m_s and self._motion is not None and self._motion[0] == utc_ns:
            level = self._settings.velocity_sigma_m_s
            velocity = (*self._motion[1], 0.0), (level, level, UNKNOWN_CLIMB_M_S)
        body = gnss_message(utc_ns, place, sigma, *velocity)
        return [Message("sensor/gnss", self._settings.clock.stamp(utc_ns), body)]

    def _shr(self, s: Any) -> list[Message]:
        """``PASHR,time,heading,T,roll,pitch,heave,sigmas of roll, pitch and heading,GNSS quality,IMU status``, in
        degrees. Right side down and nose up are taken as positive, as ArduPilot writes it; manuals do not say."""
        fields = s.payload
        if fields[2] != "T" or fields[10:11] == ["0"]:
            what = "of an IMU that is out or not aligned" if fields[2] == "T" else "without true heading"
            self._problem("no attitude", f"PASHR {what}")
            return []
        utc_ns = self._utc(s.utctime)
        if utc_ns is None:
            self._problem("no date yet", "PASHR before the first RMC or ZDA; or give date")
            return []
        if not self._attitudes.goes_on(utc_ns):
            self._problem("time does not go on", f"PASHR of {s.utctime} does not come after the one before")
            return []
        heading, roll, pitch = (_number(fields[k]) for k in (1, 3, 4))
        check_angles(*np.radians([roll, pitch, heading]))
        stated = [_number(field) for field in fields[6:9]]
        if min(stated) <= 0:
            self._problem("no accuracy", f"PASHR with sigmas {', '.join(fields[6:9])} deg of roll, pitch and heading")
            return []
        self._shr_comes = True
        self._compare_with_course("PASHR", heading, utc_ns)
        rounding = [_last_figure(fields[k]) / math.sqrt(12.0) for k in (3, 4, 1)]
        body = attitude_message(utc_ns, np.radians([roll, pitch, heading]), np.radians(np.hypot(stated, rounding)))
        return [Message("sensor/attitude", self._settings.clock.stamp(utc_ns), body)]

    def _hdt(self, s: Any) -> list[Message]:
        heading_deg = _number(s.headingT)
        settings = self._settings
        if not settings.heading_sigma_deg or self._shr_comes or self._epoch_ns == self._last_heading_ns:
            return []
        self._last_heading_ns = self._epoch_ns
        self._compare_with_course("HDT", heading_deg, self._epoch_ns)
        sigma = np.radians([settings.level_sigma_deg, settings.level_sigma_deg, settings.heading_sigma_deg])
        body = attitude_message(self._epoch_ns, np.radians([0.0, 0.0, heading_deg]), sigma)
        return [Message("sensor/attitude", settings.clock.stamp(self._epoch_ns), body)]

    def _compare_with_course(self, name: str, heading_deg: float, time_ns: int) -> None:
        """Tell where the first headings of a fast flight lie off the course, as of antennas across the aircraft."""
        if self._motion is None or abs(self._motion[0] - time_ns) > SECOND_NS or len(self._off_deg) == HEADINGS:
            return
        east, north = self._motion[1]
        if math.hypot(east, north) > SLOW_M_S:
            off_deg = heading_deg - math.degrees(math.atan2(east, north))
            self._off_deg.append(abs((off_deg + 180.0) % 360.0 - 180.0))
        if len(self._off_deg) == HEADINGS and np.quantile(self._off_deg, 0.2) > MOST_CRAB_DEG:
            what = f"{name} lies {np.median(self._off_deg):.0f} deg off the course of RMC (median of {HEADINGS})"
            self._problem("heading off the course", f"{what}: are the antennas across the aircraft?")

    # ---- time and accuracy

    def _in_this_era(self, said: date) -> date:
        """The day that a sentence says, of a receiver that counts weeks modulo 1024 that of the settings' era."""
        era = timedelta(weeks=WEEK_ROLLOVER)
        turns = 0 if self._settings.day is None else round((self._settings.day - said) / era)
        day = said + turns * era
        if not turns or self._settings.day is None or abs((self._settings.day - day).days) > 1:
            return said
        if not self._era_told:
            self._era_told = True
            self._problem("wrong weeks", f"the receiver says {said}, {turns * WEEK_ROLLOVER} weeks off: {day} taken")
        return day

    def _utc(self, time: time_of_day) -> int | None:
        """UTC in ns of a time of day, on the day that brings it next to the newest time; None before a day is known."""
        if self._newest is None:
            if self._settings.day is None:
                return None
            self._newest = _at(self._settings.day, time)
        newest = self._newest
        day = newest.date()
        near = min((_at(day + timedelta(days=d), time) for d in (-1, 0, 1)), key=lambda t: abs(t - newest))
        self._newest = max(near, newest)
        whole = near.replace(microsecond=0)
        utc_ns = round(whole.timestamp()) * SECOND_NS + near.microsecond * 1000
        return self._settings.clock.utc(utc_ns)

    def _sigma(self, utc_ns: int, quality: int, hdop: Any) -> Triple:
        """East, north, up, m."""
        if self._stated is not None:
            age_ns, sigma = utc_ns - self._stated[0], self._stated[1]
            if age_ns == 0 or not self._stated_quality:
                self._stated_quality = quality
            if 0 <= age_ns <= GST_HOLDS_S * SECOND_NS and quality == self._stated_quality:
                return sigma
        level = QUALITY_SIGMA_M[quality] * max(_number(hdop or 1.0), 0.5)
        return level, level, 2.0 * level

    def _as_written(self, sigma: Triple, name: str, rounding: Triple) -> Triple:
        """Accuracy of a fix (east, north, up, m) with its rounding; that this is the larger part is told once."""
        lost, own = max(zip(rounding, sigma, strict=True), key=lambda both: both[0] / both[1])
        if lost > own and not self._few_told:
            self._few_told = True
            what = f"{name} are rounded, which makes {lost:.3f} m (1 sigma) of a fix known to {own:.3f} m"
            self._problem("few figures", f"{what}: let the receiver write more of them")
        east, north, up = (math.hypot(*both) for both in zip(sigma, rounding, strict=True))
        return east, north, up


class _Forward:
    """Times of one kind of message, which go on."""

    def __init__(self) -> None:
        self.newest_ns = -1
        self._earlier_ns: list[int] = []  # those that came one after another, before the newest one

    def goes_on(self, utc_ns: int) -> bool:
        """Whether a time comes after the one before, or is one of so many in a row that go on from an earlier time that
        the newest one was wrong, or the clock was set back."""
        if utc_ns <= self.newest_ns:
            if self._earlier_ns and utc_ns <= self._earlier_ns[-1]:
                self._earlier_ns.clear()
            self._earlier_ns.append(utc_ns)
            if len(self._earlier_ns) < REBASE_AFTER:
                return False
        self._earlier_ns.clear()
        self.newest_ns = utc_ns
        return True


def _rounding_m(s: Any, separation: str) -> Triple:
    """East, north, up, m: sigma of what a fix lost where its figures end, a uniform error of half a unit at most."""
    _, latitude, _, longitude, *_ = s.payload
    north, east = (_last_figure(field) * MINUTE_M / math.sqrt(12.0) for field in (latitude, longitude))
    up = math.hypot(_last_figure(s.payload[8]), _last_figure(separation)) / math.sqrt(12.0)
    return east * math.cos(math.radians(_number(s.lat))), north, up


def _last_figure(field: str) -> float:
    """What one unit of the last figure of a number counts."""
    return 10.0 ** -len(field.partition(".")[2])


def _number(field: Any) -> float:
    """A field as a number; raises ValueError where it is none, or not finite."""
    value = float(field)
    if not math.isfinite(value):
        raise ValueError(f"{field!r} is not finite")
    return value


def _at(day: date, time: time_of_day) -> datetime:
    return datetime.combine(day, time, UTC)


def _shown(line: bytes) -> str:
    text = line[:80].decode("ascii", "replace")
    return "".join(c if c.isprintable() else "." for c in text)


class Nmea(Sensor):
    """A receiver that speaks NMEA 0183."""

    outputs = ("sensor/gnss", "sensor/attitude")

    def __init__(self, settings: NmeaSettings) -> None:
        super().__init__(settings.id)
        self.from_begin = settings.address.startswith("file:")
        self._settings = settings
        self.parser = NmeaParser(settings, self.problem)

    def messages(self, stop: Event) -> Iterator[Message | None]:
        for data in read_bytes(self._settings.address, stop, self.problem, self._settings.baud):
            yield None
            yield from self.parser.feed(data)


def run(options: ProgramOptions) -> int:
    """Publish what a receiver says until told to stop."""
    settings = NmeaSettings.read(Keys(Path("configuration"), options.table, options.name), Path.cwd())
    return publish(options, Nmea(settings))
