"""The backward pass: once a strip is over, what was learnt late reaches what became final early.

Each time unknowns left the window, `Marginal` kept what was known of them given those that stayed. From the last to
the first, ``x1 = R11^-1 (d1 - R12 x2)`` gives them the information of the whole strip; covariances follow the same way.
It is the smoother of the window's filter, and agrees with a batch adjustment of the strip.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular

from ..adjustment.normal_equations import PointNormals
from ..adjustment.reliability import CRITICAL_W
from ..models.base import Design
from ..rotation import corrected_angles
from .batch import Batch, inverse_factors
from .results import AdjustedPoint, RefinedOrientation, WholeStrips
from .state import Marginal, WindowState

Array = NDArray[np.floating]
IntArray = NDArray[np.int64]

#: A variance that is so many times larger is larger.
CLEARLY = 1.01


@dataclass(frozen=True)
class LeftPoints:
    """Points of a batch as they left: what leads from the unknowns to them (see `Batch`)."""

    columns: IntArray
    origin_l: Array
    normals: PointNormals
    coupling: Array
    order: IntArray
    points: tuple[AdjustedPoint, ...]

    @classmethod
    def of(cls, batch: Batch, points: Iterable[AdjustedPoint]) -> LeftPoints:
        """Of a batch and the points it published (those of full rank, in its order)."""
        published = tuple(points)
        place = {name: i for i, name in enumerate(batch.names)}
        order = np.array([place[p.name] for p in published], dtype=np.int64)
        return cls(batch.columns, batch.origin_l, batch.normals, batch.coupling, order, published)

    def refined(self, theta: Array, Q: Array) -> list[AdjustedPoint]:
        """The points for other values (u,) and cofactors (u, u) of their unknowns."""
        xyz = self.origin_l + self.normals.back((self.normals.y.T - self.coupling @ theta).T).T
        p, u = len(self.origin_l), len(self.columns)
        D = self.coupling
        inner = (D.reshape(3 * p, u) @ Q).reshape(p, 3, u) @ np.swapaxes(D, 1, 2) + np.eye(3)
        L = inverse_factors(self.normals)
        covariance = np.swapaxes(L, 1, 2) @ inner @ L
        return [
            replace(point, xyz_l=xyz[i], covariance=covariance[i], whole=True)
            for i, point in zip(self.order, self.points, strict=True)
        ]


@dataclass
class Step:
    """What left at one time.

    Attributes
    ----------
    marginal : the unknowns
    orientation, design : what became final with them, and how it depends on unknowns
    noise : (n, 6, 6) covariance that does not come from unknowns
    left : points that left since the step before
    """

    marginal: Marginal
    orientation: RefinedOrientation | None
    design: Design | None
    noise: Array | None
    left: list[LeftPoints] = field(default_factory=list)


def backward(steps: list[Step], state: WindowState) -> WholeStrips:
    """Go back through the steps from the present state of the window."""
    orientation: list[RefinedOrientation] = []
    points: list[AdjustedPoint] = []
    if not steps:
        return WholeStrips(orientation, points)
    numbers = steps[-1].marginal.stayed
    values = state.values(numbers)
    Q = state.covariance(numbers) if len(numbers) else np.empty((0, 0))
    for step in reversed(steps):
        m = step.marginal
        keep = _places(m.stayed, numbers)
        x2, Q22 = values[keep], Q[np.ix_(keep, keep)]
        gone = solve_triangular(m.R11, m.d1 - m.R12 @ x2, check_finite=False)
        T = solve_triangular(m.R11, m.R12, check_finite=False)
        own = solve_triangular(m.R11, np.eye(len(gone)), check_finite=False)
        Q12 = -T @ Q22
        Q = np.block([[own @ own.T - Q12 @ T.T, Q12], [Q12.T, Q22]])
        numbers, values = np.concatenate([m.gone, m.stayed]), np.concatenate([gone, x2])
        if step.orientation is not None and step.design is not None and step.noise is not None:
            orientation.append(again(step.orientation, step.design, step.noise, numbers, values, Q))
        for left in reversed(step.left):
            place = _places(left.columns, numbers)
            points += left.refined(values[place], Q[np.ix_(place, place)])
    return WholeStrips(orientation[::-1], points[::-1])


def _places(wanted: IntArray, numbers: IntArray) -> IntArray:
    order = np.argsort(numbers)
    return order[np.searchsorted(numbers, wanted, sorter=order)]


def again(
    old: RefinedOrientation, design: Design, noise: Array, numbers: IntArray, values: Array, Q: Array
) -> RefinedOrientation:
    """The orientation with other values and cofactors of its unknowns; ``noise`` (n, 6, 6) comes from none of them."""
    columns = np.unique(design.columns)
    columns = columns[columns >= 0].astype(np.int64)
    place = _places(columns, numbers)
    local = np.where(design.columns >= 0, np.searchsorted(columns, design.columns), len(columns))
    A = np.zeros((len(old.time_s), 6, len(columns) + 1))
    A[np.arange(len(A))[:, None, None], np.arange(6), local] += design.coefficients[:, :, None]
    A = A[:, :, :-1]
    change = A @ values[place] - old.correction
    angles = corrected_angles(old.angles, change[:, 3:])
    angles[:, 2] = (angles[:, 2] + np.pi) % (2 * np.pi) - np.pi
    covariance = A @ Q[np.ix_(place, place)] @ np.swapaxes(A, 1, 2) + noise
    protection = old.protection
    if protection is not None:  # where control was taken out since, less is known than then
        now, then = np.einsum("nii->ni", covariance), np.einsum("nii->ni", old.covariance)
        protection = np.where(now > CLEARLY * then, np.hypot(protection, CRITICAL_W * np.sqrt(now)), protection)
    return replace(
        old, position_l=old.position_l + change[:, :3], angles=angles, covariance=covariance,
        correction=old.correction + change, protection=protection,
    )  # fmt: skip
