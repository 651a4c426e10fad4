"""GPX tracks: positions with times, and attitudes where the program that wrote them put any beside them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from datetime import date
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...schemas import messages as m
from ..convert import gnss_message
from ..errors import UserError
from ..node import Message
from .plausible import check_units
from .satellite.xml_file import Element, read_xml
from .table import MOST_PROBLEMS, one_line
from .time_columns import same_day
from .track import Accuracy, NavigationTrack, checked, frame_of

#: Quantity -> names of elements below a track point, the best ones first; GPX itself has none for attitudes.
_ANGLES = {"roll": ("roll",), "pitch": ("pitch",), "heading": ("heading", "yaw", "course")}
#: Taken where nothing says how good positions are: east, north, up, m.
POSITION_SIGMA_M = (5.0, 5.0, 10.0)
_TIME = "an ISO 8601 time as 2024-05-17T09:30:00Z"


def is_gpx(head: bytes) -> bool:
    """Whether a file that begins so is GPX."""
    return b"<gpx" in head and head.lstrip(b"\xef\xbb\xbf \t\r\n").startswith(b"<")


def read_gpx(path: Path, day: date | None = None) -> NavigationTrack:
    """Poses of a GPX track whose points have roll, pitch and heading (or yaw, or course), degrees.

    Raises
    ------
    UserError : a track of positions alone, or as `read_positions`
    """
    track, oriented = _read(path, day)
    if not oriented:
        wanted = (
            "wanted roll, pitch and heading (degrees) in each trkpt, or its positions as gnss.csv of a sensor folder"
        )
        raise UserError(f"{path}: positions without attitudes, {wanted}")
    return check_units(track, path)


def has_attitudes(path: Path) -> bool:
    """Whether the points of a GPX track have attitudes.

    Raises
    ------
    UserError : as `read_positions`
    """
    return _read(path, None)[1]


def read_positions(path: Path, day: date | None = None) -> NavigationTrack:
    """Positions and times of a GPX track; attitudes are 0.

    Raises
    ------
    UserError : not GPX, fewer than two points with rising times, a value that is missing or malformed, by the number of
        its point, or another day
    """
    track, _ = _read(path, day)
    return replace(track, rpy=np.zeros_like(track.rpy))


def position_messages(track: NavigationTrack, accuracy: Accuracy, notes: list[str], source: str) -> Iterator[Message]:
    """``configuration/project`` and ``sensor/gnss`` of positions."""
    sigma = accuracy.position_m if accuracy.position_stated else POSITION_SIGMA_M
    if not accuracy.position_stated:
        taken = f"{sigma[0]:g} m and {sigma[2]:g} m in height taken (--position-sigma)"
        notes.append(f"{track.name}: no accuracies of the positions: {taken}")
    notes.append(f"{track.name}: positions without attitudes: they become sensor/gnss, not poses")
    frame = frame_of(track)
    project = m.Project(name=track.name, crs="local", origin_latitude=frame.lat_deg, origin_longitude=frame.lon_deg)
    yield Message("configuration/project", int(track.time_ns[0]), project, source)
    for time_ns, place in zip(track.time_ns.tolist(), track.geodetic.tolist(), strict=True):
        yield Message("sensor/gnss", time_ns, gnss_message(time_ns, place, sigma), source)


def _read(path: Path, day: date | None) -> tuple[NavigationTrack, bool]:
    import pandas as pd

    root = read_xml(path)
    if root.tag != "gpx":
        raise UserError(f"{path}: XML with the root {root.tag!r}, wanted gpx")
    every = root.all("trk/trkseg/trkpt", "a track with points that have time and ele", least=2)
    rows = np.flatnonzero([_text(point, "fix") != "none" for point in every])
    if len(rows) < 2:
        raise UserError(f"{path}: {len(rows)} points with a fix, wanted at least 2")
    points = [every[i] for i in rows]
    problems: list[str] = []
    place = np.array([_place(point, problems) for point in points])
    words = [_text(point, "time") or "" for point in points]
    read = pd.to_datetime(pd.Series(words, dtype=object), format="ISO8601", utc=True, errors="coerce")
    for i in np.flatnonzero(read.isna().to_numpy())[:MOST_PROBLEMS]:
        problems.append(str(points[i].refuse("time", _TIME, words[i] or None)))
    named = {
        quantity: next((name for name in names if any(_text(point, name) is not None for point in points)), "")
        for quantity, names in _ANGLES.items()
    }
    oriented = all(named.values())
    rpy = np.zeros((len(points), 3))
    if oriented:
        rpy = np.radians(np.column_stack([_degrees(points, name, problems) for name in named.values()]))
    if problems:
        raise UserError(one_line(problems))
    time_ns = read.dt.tz_convert(None).to_numpy().astype("datetime64[ns]").astype(np.int64)
    same_day(path, int(time_ns[0]), day)
    notes = []
    if len(points) < len(every):
        notes.append(f"{path.name}: {len(every) - len(points)} points without a fix were left out")
    if oriented and named["heading"] == "course":
        notes.append(f"{path.name}: heading taken from course, as programs write it that give roll and pitch")
    separation = [_number(point, "geoidheight") for point in points]
    if all(value is not None for value in separation):
        place[:, 2] += np.array(separation, dtype=float)
    else:
        notes.append(f"{path.name}: ele is taken as height above the ellipsoid (no geoidheight of all points)")
    return checked(NavigationTrack(path.stem, time_ns, place, rpy, notes=tuple(notes)), path, rows), oriented


def _text(point: Element, name: str) -> str | None:
    """Text of an element of a name below a point, whatever its namespace and case; None for none.

    The one that stands the least deep counts: deeper ones are of other things, as the angles of a gimbal.
    """
    level = list(point.node)
    while level:
        for node in level:
            if isinstance(node.tag, str) and node.tag.lower() == name:
                return (node.text or "").strip()
        level = [child for node in level for child in node]
    return None


def _number(point: Element, name: str) -> float | None:
    text = _text(point, name)
    try:
        value = float(text) if text else np.nan
    except ValueError:
        value = np.nan
    return value if np.isfinite(value) else None


def _place(point: Element, problems: list[str]) -> tuple[float, float, float]:
    """Latitude, longitude, ele."""
    found = []
    for name in ("lat", "lon"):
        text = point.node.get(name)
        try:
            found.append(float(text) if text else np.nan)
        except ValueError:
            found.append(np.nan)
        if not np.isfinite(found[-1]) and len(problems) < MOST_PROBLEMS:
            problems.append(str(point.refuse(name, "degrees", text)))
    ele = _number(point, "ele")
    if ele is None and len(problems) < MOST_PROBLEMS:
        problems.append(str(point.refuse("ele", "metres", _text(point, "ele"))))
    return found[0], found[1], np.nan if ele is None else ele


def _degrees(points: list[Element], name: str, problems: list[str]) -> NDArray[np.float64]:
    """Angles (n,) under a name."""
    values = [_number(point, name) for point in points]
    for point, value in zip(points, values, strict=True):
        if value is None and len(problems) < MOST_PROBLEMS:
            problems.append(str(point.refuse(name, "degrees", _text(point, name))))
    return np.array([np.nan if value is None else value for value in values])
