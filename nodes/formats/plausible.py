"""Whether poses of a file can be in the units that it states."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from ...solver.geometry.earth import ecef_from_geodetic
from ..errors import UserError
from .course import MOST_CRAB_DEG
from .track import NavigationTrack

#: Aircraft that carry a line camera fly faster than this and slower than that, m/s.
SPEEDS_M_S = (5.0, 350.0)
#: The course is compared with the heading where the flight is faster than this, m/s, and long enough, m.
_MOVING = (1.0, 30.0)


def check_units(track: NavigationTrack, path: Path, names: Mapping[str, str] | None = None) -> NavigationTrack:
    """The track, with a note about a speed that no survey flight has.

    Parameters
    ----------
    track : poses
    path : of the file, for messages
    names : quantity (lat, lon, roll, pitch, heading) -> column of the file

    Raises
    ------
    UserError : positions or headings that only make sense in radians, where the file states degrees
    """
    names = {} if names is None else names
    lat, lon, height = track.geodetic.T
    seconds = (track.time_ns - track.time_ns[0]) * 1e-9
    median = _speed(lat, lon, height, seconds)
    in_degrees = _speed(np.degrees(lat), np.degrees(lon), height, seconds)
    small = bool((np.abs(lat) <= np.pi / 2).all() and (np.abs(lon) <= 2 * np.pi).all())
    slow, fast = SPEEDS_M_S
    if small and median < slow < in_degrees < fast:
        what = f"positions within {np.abs(lat).max():.3g} and {np.abs(lon).max():.3g}, a flight of {median:.2g} m/s"
        column = f"{names.get('lat', 'latitude')}, {names.get('lon', 'longitude')}"
        raise UserError(f"{path}: {column}: radians in columns of degrees? {what} ({in_degrees:.0f} m/s in radians)")
    _check_heading(track, path, names.get("heading", "heading"), median * float(seconds[-1]), median)
    if median < slow or median > fast:
        what = f"a flight of {median:.2g} m/s (median), wanted {slow:g} to {fast:g}"
        note = f"{path.name}: {what}; are times in seconds, and positions in degrees?"
        return replace(track, notes=(*track.notes, note))
    return track


def _speed(lat: np.ndarray, lon: np.ndarray, height: np.ndarray, seconds: np.ndarray) -> float:
    """Median speed, m/s, over steps of a second or more where there are some."""
    step = max(round(1.0 / max(float(np.median(np.diff(seconds))), 1e-6)), 1)
    step = min(step, len(seconds) - 1)
    position = ecef_from_geodetic(np.radians(lat), np.radians(lon), height)
    way = np.linalg.norm(position[step:] - position[:-step], axis=1)
    return float(np.median(way / (seconds[step:] - seconds[:-step])))


def _check_heading(track: NavigationTrack, path: Path, name: str, length_m: float, speed: float) -> None:
    """Raise UserError where headings agree with the course only when they are taken as radians."""
    if speed < _MOVING[0] or length_m < _MOVING[1]:
        return
    lat, lon, _ = track.geodetic.T
    step = max(len(track) // 200, 1)
    north = np.diff(lat[::step])
    east = np.diff(lon[::step]) * np.cos(np.radians(lat[::step][:-1]))
    moved = np.hypot(north, east) > 0
    if not moved.any():
        return
    course = np.degrees(np.arctan2(east, north))[moved]
    said = np.degrees(track.rpy[::step, 2])[:-1][moved]
    if np.abs(said).max() > 2 * np.pi:
        return
    off, off_rad = (float(np.median(np.abs((h - course + 180) % 360 - 180))) for h in (said, np.degrees(said)))
    if off > MOST_CRAB_DEG and off_rad < min(MOST_CRAB_DEG, off / 3):
        what = (
            f"headings up to {np.abs(said).max():.3g}, and {off:.0f} deg off the course, {off_rad:.0f} deg in radians"
        )
        raise UserError(f"{path}: {name}: radians in a column of degrees? {what}")
