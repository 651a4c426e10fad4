"""Cofactors of a solution, block by block: object points, residuals, and both with the reduced unknowns.

All are for sigma0 = 1; multiply by ``sigma0 ** 2`` for a-posteriori covariances. No matrix over all points is formed.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..arrays import Array, IntArray
from .adjustment import Solution
from .elimination import Cluster
from .normal_equations import couplings

_UNIT = np.eye(2)

#: Rays for which dense rows are held at a time.
ROWS = 1024


@dataclass(frozen=True)
class Cofactors:
    """Cofactor blocks of one solution.

    Attributes
    ----------
    unknowns : (n_unknowns,) variances of the reduced unknowns (orientation, then additional parameters)
    points : (p, 3, 3) of the object points, m^2; zero in directions that are not determined
    observed : (n, 2, 2) of the adjusted image coordinates, whitened: ``A Q A^T``
    squares : (n,) squared whitened residuals, and
    statistics : `ray_statistics.RayStatistics` of the rays, where they were computed with the cofactors
    """

    unknowns: Array
    points: Array
    observed: Array
    squares: Array | None = None
    statistics: Any = None

    def residuals(self, ray_weight: Array) -> Array:
        """Cofactors (n, 2, 2) of whitened residuals: ``Qvv = I - A Q A^T``; for rays left out ``I + A Q A^T``.

        The residual of a ray with weight 0 is that of a prediction from the others.
        """
        sign = np.where(ray_weight > 0, -1.0, 1.0)
        return _UNIT + sign[:, None, None] * self.observed


def cofactors(solution: Solution) -> Cofactors:
    """All cofactor blocks of a solution."""
    if solution.problem.parts is not None:
        return solution.problem.parts.cofactors(solution)
    p, n = solution.network.n_points, len(solution.network.rays)
    points, observed = np.empty((p, 3, 3)), np.empty((n, 2, 2))
    for cluster, D in _clusters(solution):
        Q = solution.factor.cofactors(cluster.columns)
        points[cluster.points] = _of_points(solution, cluster, D, Q)
        _of_rays(solution, cluster, D, Q, observed)
    return Cofactors(solution.factor.variances(), points, observed)


def point_cofactors(solution: Solution) -> Array:
    """Cofactors (p, 3, 3) of the object points."""
    points = np.empty((solution.network.n_points, 3, 3))
    for cluster, D in _clusters(solution):
        points[cluster.points] = _of_points(solution, cluster, D, solution.factor.cofactors(cluster.columns))
    return points


def point_unknown_cofactors(solution: Solution, columns: IntArray) -> Array:
    """Cofactors (p, 3, m) between object points and some reduced unknowns (m,)."""
    result = np.empty((solution.network.n_points, 3, len(columns)))
    unit = np.zeros((solution.layout.n_unknowns, len(columns)))
    unit[columns, np.arange(len(columns))] = 1.0
    Q = solution.factor.solve(unit)
    for cluster, D in _clusters(solution):
        t = (D @ Q[cluster.columns]).reshape(3, cluster.n_points, -1)
        inverse = _inverse_factors(solution, cluster)
        result[cluster.points] = -np.einsum("pdi,dpm->pim", inverse, t)
    return result


def _clusters(solution: Solution) -> Iterator[tuple[Cluster, Array]]:
    """Clusters with their couplings D (3 points, U)."""
    lin = solution.linearisation
    if not (solution.ray_weight == 1.0).all():
        lin = lin.reweighted(solution.ray_weight)
    for cluster, D in couplings(lin, solution.layout, solution.problem.elimination, solution.points):
        yield cluster, D[:, :-1]


def _inverse_factors(solution: Solution, cluster: Cluster) -> Array:
    """``L^-1`` (points, 3, 3)."""
    a, b, c, d, e, f = solution.points.inverse_factor[:, cluster.points]
    zero = np.zeros_like(a)
    return np.stack([a, zero, zero, b, c, zero, d, e, f], axis=1).reshape(-1, 3, 3)


def _of_points(solution: Solution, cluster: Cluster, D: Array, Q: Array) -> Array:
    t = D.reshape(3, cluster.n_points, -1)
    through = (D @ Q).reshape(t.shape)
    inner = np.einsum("apu,bpu->pab", t, through) + np.eye(3)
    inverse = _inverse_factors(solution, cluster)
    return np.swapaxes(inverse, 1, 2) @ inner @ inverse


def _of_rays(solution: Solution, cluster: Cluster, D: Array, Q: Array, observed: Array) -> None:
    """``A Q A^T`` of the rays of a cluster: the row of a ray, freed of its point, through the reduced cofactors."""
    lin, layout = solution.linearisation, solution.layout
    width, T = len(cluster.columns) + 1, len(layout.node)
    t = D.reshape(3, cluster.n_points, -1)
    for low in range(cluster.rays.start, cluster.rays.stop, ROWS):
        rays = slice(low, min(low + ROWS, cluster.rays.stop))
        m = rays.stop - rays.start
        point = solution.problem.elimination.point[rays]
        a, b, c, d, e, f = solution.points.inverse_factor[:, point]
        j0, j1, j2 = lin.point[:, 0, rays], lin.point[:, 1, rays], lin.point[:, 2, rays]
        w = np.stack([a * j0, b * j0 + c * j1, d * j0 + e * j1 + f * j2], axis=1)  # Jp L^-T, (2, 3, m)
        local = point - cluster.points.start
        place = cluster.place[:, rays.start - cluster.rays.start : rays.stop - cluster.rays.start] % width
        R = np.zeros((2, m, width))
        for k in range(3):
            of_point = t[k, local]
            R[0, :, :-1] -= w[0, k][:, None] * of_point
            R[1, :, :-1] -= w[1, k][:, None] * of_point
        row = np.arange(m)
        for term in range(len(place)):
            if term < T:
                factor = layout.coefficients[layout.node[term], rays]
                values = lin.orientation[:, layout.component[term], rays] * factor
            else:
                values = lin.camera[:, term - T, rays]
            R[:, row, place[term]] += values
        R = R[:, :, :-1]
        through = (R.reshape(2 * m, -1) @ Q).reshape(R.shape)
        observed[rays] = np.einsum("anu,bnu->nab", R, through) + np.einsum("akn,bkn->nab", w, w)
