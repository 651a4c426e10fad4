"""Object points of strips that have left the window, as the block keeps them (`archive`)."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from ...adjustment.eliminated_points import EliminatedPoints, Rows, eliminated
from ...arrays import Array
from ..datum.drifts import Cell
from ..results import AdjustedPoint, Look, RayResidual
from ..state.batch import Batch
from ..state.points import ControlPoint
from .backward import LeftPoints

#: A single look takes its distance from known coordinates only where these change by at least this much, m, for each
#: metre along the ray; otherwise, as with a height given for a ray that is level, they do not tell it. Tuned.
LEAST_ACROSS = 0.1
#: The line and the sample of a look tell the same where the sine between what they depend on is less; it is 1 but for
#: rays in the focal plane. Tuned: anything far above rounding and far below 1 is the same.
LEAST_APART = 1e-9


@dataclass
class KeptPoint:
    """A point that became final.

    Attributes
    ----------
    left, place : the points it left the window with, and its place among them
    strips : where it was seen
    time_s : mean time of its rays in the last of them
    control, known_l : (3,), (3,) weights of known coordinates that count in it, 1/m^2, and these coordinates, m
    single : the look, if it is one that found no partner in its strip
    unplaced : it is such a look, and nobody knows yet how far away the ground is
    """

    left: LeftPoints
    place: int
    strips: frozenset[str]
    time_s: float
    control: Array
    known_l: Array
    single: SingleLook | None = None
    unplaced: bool = False

    @property
    def functions(self) -> EliminatedPoints:
        """The points it left the window with, as functions of the unknowns."""
        return self.left.functions

    @property
    def point(self) -> AdjustedPoint:
        """As it was published."""
        return self.left.points[self.place]

    def doubted(self) -> KeptPoint:
        """The point with a strip that contradicts it."""
        f, own = self.functions, slice(self.place, self.place + 1)
        functions = EliminatedPoints(f.columns, f.origin_l[own], f.factor[own], f.y[own], f.coupling[own])
        return replace(self, left=LeftPoints(functions, (self.point._replace(checked="doubtful"),)), place=0)


@dataclass(frozen=True)
class SingleLook:
    """A look that found no partner in its strip. It says nothing until another strip sees its point.

    How far away the point is nobody knows until then, so the look is linearised again when it is seen: a look that is
    linearised far off would tell the position of the strip from its attitude, which it cannot.

    Attributes
    ----------
    batch, place : the look is that of a point in a batch of points with one look each
    look : as it came
    cell : equations of the drifts of its strip with the batch, None if there are none
    """

    batch: Batch
    place: int
    look: Look
    cell: Cell | None

    @property
    def ray_l(self) -> tuple[Array, Array]:
        """Where it was taken from (3,), and where it looks (3,), local frame."""
        position_l = self.batch.rays.position_l[self.place]
        return position_l, self.batch.points_l[self.place] - position_l

    def place_above(self, height_m: float) -> Array | None:
        """Where its ray comes to a height (3,); None if it does not."""
        position_l, ray = self.ray_l
        share = (height_m - position_l[2]) / ray[2] if ray[2] else -1.0
        return position_l + share * ray if share > 0.0 else None

    def place_at(self, control: ControlPoint) -> Array | None:
        """Where along its ray (3,) it meets known coordinates best; None if these do not tell it well."""
        known, point_l = control.weight > 0, self.batch.points_l[self.place]
        ray = point_l - self.batch.rays.position_l[self.place]
        ray = ray / np.linalg.norm(ray)
        if np.linalg.norm(ray[known]) < LEAST_ACROSS:
            return None
        off = control.xyz_l[known] - point_l[known]
        return point_l + ray * (ray[known] @ off) / (ray[known] @ ray[known])

    def left(self, place_l: Array | None = None) -> LeftPoints | None:
        """Its point as a function of the unknowns, linearised anew where the point (3,) is if that is known.

        None where line and sample tell the same, as of a ray along the ground.

        So that there are coordinates, they are held to their place along the ray by their distance from the camera;
        that says nothing beside another look.
        """
        batch, i = self.batch, self.place
        with suppress(np.linalg.LinAlgError):
            if place_l is not None:
                batch.points_l = batch.points_l.copy()
                batch.points_l[i] = place_l
                batch.linearise(batch.theta, reweigh=True)
            rows, origin = rows_of(batch, i, self.cell)
            J = rows[2]
            along = np.cross(J[0], J[1])
            across = float(np.linalg.norm(along))
            if across > LEAST_APART * np.linalg.norm(J[0]) * np.linalg.norm(J[1]):
                along /= across * np.linalg.norm(origin - batch.rays.position_l[i])
                seen = (RayResidual(self.look, 0.0, 0.0, 0.0, False),)
                held = np.outer(along, along)
                covariance = np.linalg.inv(J.T @ J + held)
                point = AdjustedPoint(batch.names[i], "tie", origin, covariance, 1, True, seen, "across")
                return LeftPoints(eliminated([rows], held, origin, origin)[0], (point,))
        return None


def rows_of(batch: Batch, point: int, cell: Cell | None) -> tuple[Rows, Array]:
    """Equations of a point's rays, and of the surface it lies on, with the drifts of their strip, without earlier
    strips; the origin (3,)."""
    A, J, residual, origin = batch.equations(point)
    rays = len(A)
    if (of_surface := batch.surface_equation(point)) is not None:
        A, J, residual = (np.concatenate(pair) for pair in zip((A, J, residual), of_surface, strict=True))
    columns = batch.columns[: len(batch.columns) - batch.n_tied]
    A = A[:, : len(columns)]
    if cell is not None:
        drifts = cell.on_rays(range(batch.first_ray[point], batch.first_ray[point + 1]))
        A = np.column_stack([A, np.pad(drifts, ((0, len(A) - rays), (0, 0)))])
        columns = np.concatenate([columns, cell.of_block])
    touched = A.any(axis=0)  # the batch has unknowns of its other points
    return (columns[touched], A[:, touched], J, residual), origin
