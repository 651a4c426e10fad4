"""The Earth's curve where a platform is so high that its looks at a point lie hundreds of kilometres apart.

The local frame is Cartesian: on a strip from orbit the ground falls away from its XY plane by kilometres, and the
platform moves about the centre of the Earth while the ground goes by more slowly than it does. A sphere is near enough
to predict with; what is off is found by matching.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .height_guess import HeightGuess

Array = NDArray[np.floating]

#: Mean radius of the Earth, m. Definition.
RADIUS_M = 6_371_000.0
#: Platforms above this are in orbit. Derived: no aircraft flies higher, and below it the way to a look 30 deg off is
#: longer on the sphere by half a per cent at most.
ORBIT_M = 50_000.0


def above_sphere(position_l: ArrayLike) -> float:
    """Height of a position (3,) over the sphere that touches the XY plane at the origin, m."""
    return float(np.linalg.norm(np.add(position_l, [0.0, 0.0, RADIUS_M])) - RADIUS_M)


def tilt(position_l: ArrayLike, ray_l: ArrayLike) -> float:
    """Angle between a ray (3,) of any length and the way down from a position (3,) to the middle of the sphere, rad."""
    down, ray = -np.add(position_l, [0.0, 0.0, RADIUS_M]), np.asarray(ray_l)
    return float(np.arccos(np.clip(ray @ down / (np.linalg.norm(ray) * np.linalg.norm(down)), -1.0, 1.0)))


def way_of_platform(forward: float, height_m: float) -> float:
    """How far a platform flies until it is above what it sees in a direction, m.

    Parameters
    ----------
    forward : tangent of the angle from the nadir; positive ahead
    height_m : above the sphere
    """
    nadir = np.arctan(forward)
    zenith = np.arcsin(np.clip((RADIUS_M + height_m) / RADIUS_M * np.sin(nadir), -1.0, 1.0))
    return float((zenith - nadir) * (RADIUS_M + height_m))


@dataclass
class RoundHeights(HeightGuess):
    """Heights that are guessed above the sphere where the platform is in orbit, above the XY plane where it is not.

    Attributes
    ----------
    in_orbit : what counts
    """

    in_orbit: bool = False

    def add(self, xyz_l: Array) -> None:
        super().add(np.column_stack([xyz_l[:, :2], xyz_l[:, 2] - self.level(xyz_l[:, :2], 0.0)]))

    def found(self, xyz_l: Array) -> None:
        self.say(float(np.median(xyz_l[:, 2] - self.level(xyz_l[:, :2], 0.0))))
        self.add(xyz_l)

    def level(self, xy: Array, height_m: float) -> Array:
        """Z (n,) of ground of one height at places (n, 2)."""
        level = np.full(len(xy), height_m)
        return level + _sphere(np.asarray(xy)) if self.in_orbit else level

    def at(self, xy: Array) -> tuple[Array, Array]:
        height, sigma = super().at(xy)
        return height + self.level(xy, 0.0), sigma


def _sphere(xy: Array) -> Array:
    """Z (n,) of the sphere at places (n, 2)."""
    return np.sqrt(np.maximum(RADIUS_M**2 - (xy**2).sum(axis=-1), 0.0)) - RADIUS_M
