"""A short flight as a navigation track."""

from __future__ import annotations

from datetime import UTC, datetime

import numpy as np

from triline.nodes.formats.gps_time import gps_from_utc_ns
from triline.nodes.formats.track import NavigationTrack


def ns(text: str) -> int:
    return round(datetime.fromisoformat(text).replace(tzinfo=UTC).timestamp()) * 10**9


def straight_track(n: int = 50, **more) -> NavigationTrack:
    """Level flight to the north-east, 100 m/s, from 48 deg north."""
    t = np.arange(n) * 0.1
    geodetic = np.column_stack([48.0 + t * 100 / 111_000 * 0.7, 11.0 + t * 100 / 74_000 * 0.7, np.full(n, 2000.0)])
    rpy = np.radians(np.column_stack([np.sin(t), np.cos(t), np.full(n, 45.0)]))
    return NavigationTrack("t", ns("2020-06-01T12:00:00") + np.rint(t * 1e9).astype(np.int64), geodetic, rpy, **more)


def _dms(degrees: float) -> str:
    """An angle as Waypoint writes it; the sign stands before the degrees, also where they are 0."""
    ten_thousandths = round(abs(degrees) * 36_000_000)
    minutes, rest = divmod(ten_thousandths, 600_000)
    return f"{'-' if degrees < 0 else ''}{minutes // 60} {minutes % 60:02d} {rest / 10_000:08.5f}"


def _clock(seconds: float) -> str:
    return f"{int(seconds // 3600) % 24:02d}:{int(seconds // 60) % 60:02d}:{seconds % 60:06.3f}"


def waypoint_text(track: NavigationTrack, *columns: str, header: str = "") -> str:
    """A text of Inertial Explorer: names of columns with their units right below, as far to the right.

    Parameters
    ----------
    columns : as ``GPSTime (sec)``, of those that are known here; others have the value 0
    """
    week, gps_s = gps_from_utc_ns(track.time_ns)
    _, utc_s = divmod(track.time_ns * 1e-9 - 315_964_800, 604_800)
    roll, pitch, heading = np.degrees(track.rpy).T
    day = [datetime.fromtimestamp(t // 10**9, UTC) for t in track.time_ns.tolist()]
    cells = {
        "Week (weeks)": [f"{week}.00000"] * len(track),
        "GPSTime (sec)": [f"{s:.3f}" for s in gps_s],
        "GPSTime (s of day)": [f"{s % 86_400:.3f}" for s in gps_s],
        "UTCTime (sec)": [f"{s:.3f}" for s in utc_s],
        "UTCTime (HMS)": [_clock(s) for s in utc_s],
        "UTCDate (MDY)": [f"{t:%m/%d/%Y}" for t in day],
        "Date (YMD)": [f"{t:%Y/%m/%d}" for t in day],
        "Latitude (deg)": [f"{v:.10f}" for v in track.geodetic[:, 0]],
        "Longitude (deg)": [f"{v:.10f}" for v in track.geodetic[:, 1]],
        "Latitude (+/-D M S)": [_dms(v) for v in track.geodetic[:, 0]],
        "Longitude (+/-D M S)": [_dms(v) for v in track.geodetic[:, 1]],
        "H-Ell (m)": [f"{v:.3f}" for v in track.geodetic[:, 2]],
        "Roll (deg)": [f"{v:.9f}" for v in roll],
        "Pitch (deg)": [f"{v:.9f}" for v in pitch],
        "Heading (deg)": [f"{v:.9f}" for v in heading],
    }
    names, units = zip(*(c.split(" ", 1) if "(" in c else (c, "") for c in columns), strict=True)
    units = ["(sec)" if unit == "(s of day)" else unit for unit in units]
    rows = [[cells.get(c, ["0"] * len(track))[i] for c in columns] for i in range(len(track))]
    table = [names, units, *rows]
    return header + "\n".join(" ".join(f"{cell:>20}" for cell in row) for row in table) + "\n"
