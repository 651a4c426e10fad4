"""AVIRIS-NG's line-by-line pose file (``angYYYYMMDDtHHMMSS_eph_att``)."""

from __future__ import annotations

import re
from datetime import date
from pathlib import Path

import numpy as np

from ..errors import UserError
from .envi import read_records
from .track import NavigationTrack, checked, times_from_gps

#: Order of the bands where no header says it.
BANDS = ("gpstime", "lat", "lon", "alt", "pitch", "roll", "heading")
_NAME = re.compile(r"^(ang(\d{4})(\d{2})(\d{2})t(\d{2})(\d{2})(\d{2}))")


def is_avirisng(path: Path) -> bool:
    """Whether a file name is that of an AVIRIS-NG pose file."""
    return bool(_NAME.match(path.name)) and "eph_att" in path.name and path.suffix != ".hdr"


def read_avirisng(path: Path, day: date | None = None) -> NavigationTrack:
    """Poses of all image lines; GPS seconds of the week become UTC with the day in the file name.

    The body is that of the inertial unit: without boresight the camera is taken to be aligned with it.

    Raises
    ------
    UserError : a file of another kind, or damaged
    """
    notes: list[str] = []
    bands, values = read_records(path, BANDS, notes)
    missing = [name for name in BANDS if name not in bands]
    if missing:
        raise UserError(f"{path}: band {missing[0]}: missing, wanted {', '.join(BANDS)}")
    column = {name: values[:, bands.index(name)] for name in BANDS}
    named = _NAME.match(path.name)
    if day is None and named:
        try:
            day = date(*(int(part) for part in named.groups()[1:4]))
        except ValueError:
            raise UserError(f"{path}: the file name has no valid day, wanted angYYYYMMDDtHHMMSS_...") from None
    time = times_from_gps(path, column["gpstime"], day, notes)
    rate, apart = line_rate(time)
    notes.append(
        f"{path.name}: {len(time)} lines at {rate:.4f} lines/s, off a constant rate by {apart:.2f} lines at most"
    )
    track = NavigationTrack(
        named.group(1) if named else path.name,
        time,
        np.column_stack([column["lat"], column["lon"], column["alt"]]),
        np.radians(np.column_stack([column["roll"], column["pitch"], column["heading"]])),
        line_rate_hz=rate,
        notes=tuple(notes),
    )
    return checked(track, path)


def line_rate(time_ns: np.ndarray) -> tuple[float, float]:
    """Mean line rate of line times (n,), Hz, and the largest distance from it in lines."""
    seconds = (time_ns - time_ns[0]) * 1e-9
    span = float(seconds[-1]) if len(seconds) > 1 else 0.0
    if span <= 0:
        return 0.0, 0.0
    rate = (len(seconds) - 1) / span
    return rate, float(np.abs(seconds * rate - np.arange(len(seconds))).max())
