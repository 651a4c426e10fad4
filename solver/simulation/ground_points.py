"""Where tie points, control points and check points lie on the ground."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..adjustment.network import Strip
from ..geometry.rotation import matrix_from_angles
from .flight import Flight, view_tangents

Array = NDArray[np.floating]

#: Share of the swath that tie points fill, and where control points lie to the left and right of its middle.
TIE_SHARE, CONTROL_SHARE = 0.94, 0.35
GOLDEN = 0.6180339887498949
#: Kept from the limits of full coverage, for relief and attitude move them.
COVERAGE_MARGIN_S = 1.5
#: Share of the way and place across the swath (-0.5 .. 0.5), (n,) each, of n points of a strip.
Pattern = Callable[[int, np.random.Generator], tuple[Array, Array]]


@dataclass(frozen=True)
class GroundPoints:
    """Points on the ground; m points.

    Attributes
    ----------
    id : (m,) names
    role : (m,) tie, control or check
    xyz_l : (m, 3) true coordinates, local frame
    """

    id: NDArray[np.str_]
    role: NDArray[np.str_]
    xyz_l: Array

    def __len__(self) -> int:
        return len(self.id)

    def select(self, chosen: NDArray[np.bool_]) -> GroundPoints:
        """The points of a mask."""
        return GroundPoints(self.id[chosen], self.role[chosen], self.xyz_l[chosen])


def place_points(
    flight: Flight,
    tie_points_per_s: float,
    control: int,
    check: int,
    tie_rng: np.random.Generator,
    control_rng: np.random.Generator,
) -> GroundPoints:
    """Tie points spread evenly over all strips; control at both sides of strips, check points between.

    Control and check points lie where all CCD lines of a strip see them; they are shared out among the strips.
    """
    ties = [_tie_points(flight, strip, tie_points_per_s, tie_rng) for strip in flight.strips]
    groups = [
        ("tie", "T{:05d}", np.concatenate(ties)),
        ("control", "GCP{}", _shared(flight, control, control_rng, _sides)),
    ]
    groups.append(("check", "CHK{}", _shared(flight, check, control_rng, _scattered)))
    ids = [pattern.format(i + 1) for _, pattern, xyz in groups for i in range(len(xyz))]
    roles = [role for role, _, xyz in groups for _ in xyz]
    return GroundPoints(np.array(ids, dtype=str), np.array(roles, dtype=str), np.concatenate([g[2] for g in groups]))


def _tie_points(flight: Flight, strip: Strip, per_s: float, rng: np.random.Generator) -> Array:
    """Points (m, 3) as the line that looks down most steeply sees them: evenly in time, golden-section order across."""
    start, end = strip.first_line_time_s, float(strip.time_of(strip.lines - 1))
    count = round((end - start) * per_s)
    time_s = start + (end - start) * (np.arange(count) + rng.uniform(size=count)) / max(count, 1)
    across = (rng.uniform() + GOLDEN * np.arange(count)) % 1.0 - 0.5
    return _seen(flight, time_s, TIE_SHARE * across)


def _shared(flight: Flight, count: int, rng: np.random.Generator, pattern: Pattern) -> Array:
    """``count`` points (count, 3) shared out among the strips, each strip's laid out by ``pattern``."""
    strips = len(flight.strips)
    parts: list[Array] = [np.empty((0, 3))]
    for i, strip in enumerate(flight.strips):
        mine = count // strips + (i < count % strips)
        if mine:
            start, end = full_coverage(flight, strip)
            along, across = pattern(mine, rng)
            parts.append(_seen(flight, start + along * (end - start), across))
    return np.concatenate(parts)


def _sides(count: int, rng: np.random.Generator) -> tuple[Array, Array]:
    """Pairs left and right, from one end of the strip to the other; an odd last one in the middle of the swath."""
    stations = (count + 1) // 2
    along = np.linspace(0.04, 0.96, stations) if stations > 1 else np.array([0.5])
    side = np.where(np.arange(count) % 2 == 0, 1.0, -1.0) * CONTROL_SHARE
    if count % 2 == 1:
        side[-1] = 0.0
    return np.repeat(along, 2)[:count] + rng.uniform(-0.03, 0.03, count), side + rng.uniform(-0.03, 0.03, count)


def _scattered(count: int, rng: np.random.Generator) -> tuple[Array, Array]:
    """Evenly along the strip, golden-section order across."""
    along = (np.arange(count) + rng.uniform(size=count)) / count
    return along, 0.9 * ((rng.uniform() + GOLDEN * np.arange(count)) % 1.0 - 0.5)


def full_coverage(flight: Flight, strip: Strip) -> tuple[float, float]:
    """When the steepest line sees ground that all lines of the strip see; else the whole strip."""
    start, end = strip.first_line_time_s, float(strip.time_of(strip.lines - 1))
    ahead, behind = _apart_s(flight, strip)
    first, last = start + ahead + COVERAGE_MARGIN_S, end + behind - COVERAGE_MARGIN_S
    return (float(first), float(last)) if first < last else (start, end)


def shortest_coverage_s(flight: Flight, strip: Strip) -> float:
    """How long a strip has to last so that all its lines see some ground together, s."""
    ahead, behind = _apart_s(flight, strip)
    return ahead - behind + 2 * COVERAGE_MARGIN_S


def _apart_s(flight: Flight, strip: Strip) -> tuple[float, float]:
    """After how long the steepest line sees what the foremost one has seen, and the hindmost one, s (the latter
    negative: it sees it later)."""
    start, end = strip.first_line_time_s, float(strip.time_of(strip.lines - 1))
    middle = flight.truth.at(0.5 * (start + end))
    position = middle.position_l[0]
    height = float(position[2] - flight.terrain.height(position[0], position[1]))
    speed = float(np.hypot(*middle.velocity_l[0, :2]))
    tangents = view_tangents(flight.camera)
    tangents = tangents - tangents[np.argmin(np.abs(tangents))]
    return float(tangents.max() * height / speed), float(tangents.min() * height / speed)


def _seen(flight: Flight, time_s: Array, across: Array) -> Array:
    """Ground (n, 3) that the steepest line sees at times (n,), ``across`` the swath from -0.5 to 0.5."""
    if len(time_s) == 0:
        return np.empty((0, 3))
    camera = flight.camera
    k = int(np.argmin(np.abs(view_tangents(camera))))
    sample = (across + 0.5) * (camera.lines[k].pixels - 1)
    xy = camera.image_coordinates(np.full(len(sample), k), sample)[0]
    poses = flight.truth.at(time_s)
    ray_c = np.column_stack([xy, np.full(len(xy), -camera.focal_length_mm[k])])
    ray_l = np.einsum("nij,nj->ni", matrix_from_angles(*poses.angles.T), ray_c)
    return flight.terrain.intersect(poses.position_l, ray_l)
