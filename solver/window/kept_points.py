"""Object points of strips that have left the window, as the block keeps them (`archive`)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..adjustment.normal_equations import PointNormals
from .backward import LeftPoints
from .batch import Batch, inverse_factors
from .drift_border import Cell
from .points import ControlPoint
from .results import AdjustedPoint, Look, RayResidual

Array = NDArray[np.floating]
IntArray = NDArray[np.int64]

#: Known coordinates tell how far along its ray a point is where a metre along it changes them by as much, m.
LEAST_ACROSS = 0.1


@dataclass
class KeptPoint:
    """A point that became final.

    Attributes
    ----------
    left, place : where its coordinates come from, given the unknowns
    strips : where it was seen
    time_s : about when, in the last of them
    control : (3,) weights of known coordinates that are in it
    single : the look, if it is one that found no partner in its strip
    """

    left: LeftPoints
    place: int
    strips: frozenset[str]
    time_s: float
    control: Array
    single: SingleLook | None = None

    @property
    def point(self) -> AdjustedPoint:
        """As it was published."""
        return self.left.points[list(self.left.order).index(self.place)]

    @property
    def with_control(self) -> bool:
        """Whether known coordinates are in it."""
        return bool(self.control.any())

    @property
    def root(self) -> tuple[Array, Array, Array]:
        """``L^T`` (3, 3), ``D`` (3, u), ``y`` (3,) of ``L^T (p - origin) + D theta = y + noise(1)``."""
        L_inv = inverse_factors(self.left.normals)[self.place]
        return np.linalg.inv(L_inv).T, self.left.coupling[self.place], self.left.normals.y[:, self.place]


@dataclass(frozen=True)
class SingleLook:
    """A look that found no partner in its strip. It says nothing until another strip sees its point.

    How far away the point is nobody knows until then, so the look is linearised again when it is seen: a look that is
    linearised far off would tell the position of the strip from its attitude, which it cannot.

    Attributes
    ----------
    batch, place : the look is that of a point in a batch of points with one look each
    look : as it came
    cell : what drifts of its strip have to do with the batch, None if nothing
    """

    batch: Batch
    place: int
    look: Look
    cell: Cell | None

    def place_at(self, control: ControlPoint) -> Array | None:
        """Where along its ray (3,) it meets known coordinates best; None if these do not tell it well."""
        known = control.weight > 0
        ray = self.batch.points_l[self.place] - self.batch.rays.position_l[self.place]
        ray = ray / np.linalg.norm(ray)
        if np.linalg.norm(ray[known]) < LEAST_ACROSS:
            return None
        off = control.xyz_l[known] - self.batch.points_l[self.place][known]
        return self.batch.points_l[self.place] + ray * (ray[known] @ off) / (ray[known] @ ray[known])

    def left(self, place_l: Array | None = None) -> LeftPoints:
        """What is kept of it, linearised anew where its point (3,) is if that is known.

        So that there are coordinates, they are held to their place along the ray by their distance from the camera;
        that says nothing beside another look.
        """
        batch, i = self.batch, self.place
        if place_l is not None:
            batch.points_l = batch.points_l.copy()
            batch.points_l[i] = place_l
            batch.linearise(batch.theta, reweigh=True)
        A, J, residual, origin = batch.equations(i)
        columns = batch.columns
        if self.cell is not None:
            A = np.column_stack([A, self.cell.on_rays(range(i, i + 1))])
            columns = np.concatenate([columns, self.cell.of_block])
        along = np.cross(J[0], J[1])
        distance_m = float(np.linalg.norm(origin - batch.rays.position_l[i]))
        J = np.vstack([J, along / np.linalg.norm(along) / distance_m])
        A, residual = np.vstack([A, np.zeros(len(columns))]), np.append(residual, 0.0)
        normal = J.T @ J
        seen = (RayResidual(self.look, 0.0, 0.0, 0.0, False),)
        point = AdjustedPoint(batch.names[i], "tie", origin, np.linalg.inv(normal), 1, True, seen, "across")
        return eliminated(A, J, residual, normal, columns, origin, point)[0]


def eliminated(
    A: Array, J: Array, residual: Array, normal: Array, columns: IntArray, origin: Array, point: AdjustedPoint
) -> tuple[LeftPoints, Array, Array]:
    """A point with rows ``A theta + J (p - origin) = residual``: what is left of it, and its information."""
    L_inv = np.linalg.inv(np.linalg.cholesky(normal))
    D, y = L_inv @ (J.T @ A), L_inv @ (J.T @ residual)
    lower = L_inv[np.tril_indices(3)]
    normals = PointNormals(lower[:, None], y[:, None], np.array([3]))
    left = LeftPoints(columns, origin[None], normals, D[None], np.zeros(1, dtype=np.int64), (point,))
    return left, A.T @ A - D.T @ D, A.T @ residual - D.T @ y
