"""Check points that one image point measures: where they lie at their given heights.

A point of one ray has no place of its own, but its ray, with the adjusted orientation, meets the given height:
that is what an orthoimage is off there. The elimination of points holds the height of such a point where it is, so that
the cofactors of its X and Y are those of the ray at that height, and the ray itself goes in the direction that the
equations of the image point do not see.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..arrays import Array, IntArray
from .covariance import Cofactors
from .problem import Solution

#: A ray flatter than this, height over length, has no place at a height.
_FLAT = 1e-3


@dataclass(frozen=True)
class SingleLooks:
    """Check points that their rays do not determine, at their given heights.

    Attributes
    ----------
    point : (k,) index of the point
    difference_m : (k, 2) measured minus given X and Y
    sigma_m, expected_m : (k, 2) sigmas of these, without and with those of the given coordinates
    """

    point: IntArray
    difference_m: Array
    sigma_m: Array
    expected_m: Array


def single_looks(solution: Solution, cofactors: Cofactors, sigma0: float) -> SingleLooks:
    """The check points whose rays leave their heights open; none of an adjustment in parts, which has no equations.

    Parameters
    ----------
    cofactors : of the solution
    sigma0 : of unit weight, a posteriori
    """
    network, check = solution.network, solution.network.check
    none = np.empty((0, 2))
    if solution.problem.parts is not None or not len(check):
        return SingleLooks(np.empty(0, dtype=np.int64), none, none, none)
    used = np.flatnonzero(solution.ray_weight > 0)
    ray = np.full(network.n_points, -1)
    ray[network.rays.point[used]] = used  # one of them: where there are more they look alike
    a, _, c, _, _, f = solution.points.inverse_factor
    open_height = (solution.points.rank == 2) & (a > 0) & (c > 0) & (f == 0)
    k = np.flatnonzero(open_height[check.point] & (ray[check.point] >= 0))
    by_point = solution.linearisation.point[:, :, ray[check.point[k]]]
    direction = np.cross(by_point[0].T, by_point[1].T)
    direction /= np.linalg.norm(direction, axis=1)[:, None]
    steep = np.abs(direction[:, 2]) > _FLAT
    k, direction = k[steep], direction[steep]
    point, slope = check.point[k], direction[:, :2] / direction[:, 2:]
    off = solution.state.points_l[point] - check.xyz_l[k]
    survey = np.where(np.isfinite(check.sigma_m[k]), check.sigma_m[k], 0.0) ** 2
    variance = sigma0**2 * np.einsum("kii->ki", cofactors.points[point])[:, :2]
    return SingleLooks(
        point,
        off[:, :2] - slope * off[:, 2:],
        np.sqrt(np.maximum(variance, 0.0)),
        np.sqrt(np.maximum(variance, 0.0) + survey[:, :2] + slope**2 * survey[:, 2:]),
    )
