"""AVIRIS-C ephemeris: poses of one flight line in UTM (``*_eph``) or longitude and latitude (``*_lonlat_eph``)."""

from __future__ import annotations

import re
from datetime import UTC, date, datetime
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...solver.geometry.frames import CrsError
from ..errors import UserError
from .envi import read_records
from .projection import Projection
from .track import NavigationTrack, checked

BANDS = ("x", "y", "elevation", "roll", "pitch", "heading")
#: AVIRIS-C turns its mirror 12 times a second; the files carry no times.
LINE_RATE_HZ = 12.0
_NAME = re.compile(r"^(f(\d{2})(\d{2})(\d{2})t\d{2}p\d{2}r\d{2}).*_eph$")


def is_avirisc(path: Path) -> bool:
    """Whether a file name is that of an AVIRIS-C ephemeris file."""
    return bool(_NAME.match(path.name))


def avirisc_has_latitudes(path: Path) -> bool:
    """Whether an AVIRIS-C ephemeris file has longitude and latitude, and not UTM coordinates.

    Raises
    ------
    UserError : from `read_records`
    """
    values = read_records(path, BANDS, [])[1]
    return values.shape[1] == len(BANDS) and _are_degrees(values)


def read_avirisc(
    path: Path, crs: str | None = None, line_rate_hz: float = LINE_RATE_HZ, day: date | None = None
) -> NavigationTrack:
    """Poses of all lines. The file has no times: lines follow each other at ``line_rate_hz`` from midnight of the day.

    Headings of the UTM file count from grid north, those of the other from true north: the two differ by the meridian
    convergence. The UTM zone is not in the file; ``crs`` says it, or a ``*_lonlat_eph`` file of the line beside it.

    Raises
    ------
    UserError : a file of another kind or damaged, or a UTM file whose zone is not known
    """
    notes: list[str] = []
    _, values = read_records(path, BANDS, notes)
    if values.shape[1] != 6:
        raise UserError(f"{path}: {values.shape[1]} values a record, wanted 6: {', '.join(BANDS)}")
    x, y, height = values[:, 0], values[:, 1], values[:, 2]
    heading = np.radians(values[:, 5])
    if _are_degrees(values):
        lon, lat = x, y
    else:
        crs = crs or _zone_of_twin(path)
        try:
            projection = Projection(crs)
            lon, lat = projection.to_lonlat(x, y)
        except CrsError as error:
            raise UserError(f"{path}: {error}") from None
        heading = heading + projection.convergence(lon, lat)
    notes.append(f"{path.name}: heights as in the file; AVIRIS-C gives them above the geoid")
    named = _NAME.match(path.name)
    if day is None and named:
        year = int(named.group(2))
        try:
            day = date(1900 + year if year > 80 else 2000 + year, int(named.group(3)), int(named.group(4)))
        except ValueError:
            raise UserError(f"{path}: the file name has no valid day, wanted fYYMMDDtNNpNNrNN...") from None
    start = datetime.combine(day, datetime.min.time(), UTC) if day else datetime(1970, 1, 1, tzinfo=UTC)
    notes.append(f"{path.name}: no times in the file; lines set at {line_rate_hz:g} Hz from {start:%Y-%m-%d %H:%M} UTC")
    time = int(start.timestamp()) * 1_000_000_000 + np.rint(np.arange(len(x)) / line_rate_hz * 1e9).astype(np.int64)
    track = NavigationTrack(
        named.group(1) if named else path.name,
        time,
        np.column_stack([lat, lon, height]),
        np.column_stack([np.radians(values[:, 3:5]), heading]),
        line_rate_hz=line_rate_hz,
        notes=tuple(notes),
    )
    return checked(track, path)


def _are_degrees(values: NDArray[np.floating]) -> bool:
    """Whether the first two of the values (n, 6) are longitudes and latitudes."""
    return bool(np.abs(values[:, 0]).max() <= 360 and np.abs(values[:, 1]).max() <= 90)


def _zone_of_twin(path: Path) -> str:
    """CRS of the UTM zone, from the longitude-latitude file of the same flight line."""
    named = _NAME.match(path.name)
    stem = named.group(1) if named else path.name.split("_")[0]
    for twin in sorted(path.parent.glob(f"{stem}*lonlat_eph")):
        lon, lat = (float(v) for v in np.fromfile(twin, "<f8", count=2))
        if abs(lon) <= 360 and abs(lat) <= 90:
            return utm_zone(lon, lat)
    raise UserError(f"{path}: UTM coordinates of an unknown zone, wanted --crs (for example EPSG:32611)")


def utm_zone(lon_deg: float, lat_deg: float) -> str:
    """EPSG code of the WGS 84 / UTM zone of a place."""
    zone = int((lon_deg + 180) % 360 // 6) + 1
    return f"EPSG:{(32600 if lat_deg >= 0 else 32700) + zone}"
