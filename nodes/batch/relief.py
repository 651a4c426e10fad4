"""Relief of the ground: between the points that a recording knows, and the true one of a simulated flight."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...solver.orthoimage.ground_grid import utm_of
from ...solver.orthoimage.heights_of_points import heights_of_points
from ...solver.orthoimage.surface import HeightField
from ...solver.simulation.flight import Flight
from .. import convert
from ..errors import UserError
from ..formats.geotiff import Heights
from ..recording.access import Recording
from ..voices import VERDICT, RecordedVoices

Array = NDArray[np.floating]


def _ground_with_height(recording: Recording) -> dict[str, Any]:
    """Ground control with a height that counts, by name: not what nodes or an operator refused in flight, nor points of
    which the adjuster left a coordinate out, nor what was stated in a local frame that was given up."""
    points: dict[str, Any] = {}
    refused: set[str] = set()
    left_out: set[tuple[str, str]] = set()
    begin_ns = recording.reader.frame_begins_ns()
    messages = recording.messages("observation/control", VERDICT, "adjustment/report")
    for message in RecordedVoices().all_used(messages):
        body = message.body
        if message.topic == "observation/control":
            if message.stamp_ns >= begin_ns:
                points[body.point] = body
        elif message.topic == "adjustment/report":
            if message.stamp_ns < begin_ns:  # of coordinates in the frame before
                continue
            left_out |= {(r.point, r.coordinate) for r in body.rejected if r.coordinate}
            left_out -= {(r.point, r.coordinate) for r in body.returned}
        elif not body.topic:
            (refused.discard if body.accepted else refused.add)(body.point)
    refused |= {point for point, _ in left_out}
    return {
        name: body for name, body in points.items() if name not in refused and convert.role_of(body) != "planimetric"
    }


def known_points(recording: Recording) -> Array:
    """(n, 3) local coordinates of object points as adjusted last, and of ground control with a height that counts."""
    points = _ground_with_height(recording)
    for message in recording.reader.in_frame(recording.messages("point/object")):
        points[message.body.point] = message.body
    xyz = np.array([(p.x, p.y, p.z) for p in points.values()]).reshape(-1, 3)
    return xyz[np.isfinite(xyz).all(axis=1)]


def ground_of_points(recording: Recording) -> HeightField:
    """The relief between the object points and the ground control of a recording.

    Raises
    ------
    UserError : too few of them
    """
    points = known_points(recording)
    try:
        return heights_of_points(points)
    except ValueError as error:
        raise UserError(f"{recording.reader.path}: no relief from object points: {error}") from None


def true_relief(flight: Flight, step_m: float = 10.0) -> Heights:
    """The ground of a simulated flight, as far as its cameras look, on a grid of its UTM zone."""
    low, high = flight.truth.position_l.min(axis=0), flight.truth.position_l.max(axis=0)
    above = high[2] - flight.terrain.height_m
    c = float(flight.camera.focal_length_mm.min())
    reach = 1.3 * above * max(float(np.abs(line.xy_mm).max()) for line in flight.camera.lines) / c
    utm = replace(flight.frame, crs=utm_of(flight.frame))
    corners = [(x, y, 0.0) for x in (low[0] - reach, high[0] + reach) for y in (low[1] - reach, high[1] + reach)]
    border = utm.to_crs(np.array(corners))
    (x0, y0), (x1, y1) = border[:, :2].min(axis=0), border[:, :2].max(axis=0)
    x, y = np.meshgrid(np.arange(x0, x1, step_m), np.arange(y1, y0, -step_m))
    place = np.stack([x.ravel(), y.ravel(), np.full(x.size, flight.frame.height_m + flight.terrain.height_m)], axis=1)
    for _ in range(3):  # the plumb lines of the local frame and of the map differ a little
        local = utm.from_crs(place)
        local[:, 2] = flight.terrain.height(local[:, 0], local[:, 1])
        place[:, 2] = utm.to_crs(local)[:, 2]
    return Heights(
        utm.crs, place[:, 2].reshape(x.shape), float(x[0, 0]), float(y[0, 0]), step_m, -step_m, above_ellipsoid=True
    )
