"""Where the strips of a flight lie on the Earth, in few numbers, for maps of many flights."""

from __future__ import annotations

from typing import Any

import numpy as np

from .. import convert
from .flight import Flight

#: Points of a strip on such a map.
POINTS = 12


def tracks(flight: Flight) -> list[dict[str, Any]]:
    """The strips: ``strip, lat_deg, lon_deg`` (POINTS values at most each); none where the place is not known.

    The positions are the best that the recording has: after the strips, final, smoothed, filtered.
    """
    project = flight.project
    if project is None or not (project.origin_latitude or project.origin_longitude or project.origin_height):
        return []
    frame = convert.local_frame(project)
    found = []
    for strip in flight.strips:
        span = flight.strip_times(strip)
        for name in ("whole", "final", "smoothed", "filtered"):
            poses = flight.poses.get(name)
            if span is None or poses is None:
                continue
            inside = np.flatnonzero((poses.time_ns >= span[0]) & (poses.time_ns <= span[1]))
            if len(inside) > 1:
                chosen = inside[np.unique(np.linspace(0, len(inside) - 1, POINTS).astype(int))]
                lat, lon, _ = frame.to_geodetic(poses.position_l[chosen]).T
                rounded = {"lat_deg": np.round(lat, 6).tolist(), "lon_deg": np.round(lon, 6).tolist()}
                found.append({"strip": strip, **rounded})
                break
    return found
