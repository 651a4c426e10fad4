"""The backward pass: what is learnt late in a strip reaches the orientation and points that became final early.

Each time unknowns left the window, `Marginal` kept their equations with those that stayed. From the last step to the
first, ``x1 = R11^-1 (d1 - R12 x2)`` gives them the information of the whole strip, and covariances follow the same way.
It is the smoother that belongs to the window's filter, and agrees with a batch adjustment of the strip.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.linalg import solve_triangular

from ...adjustment.eliminated_points import EliminatedPoints
from ...adjustment.pose_noise import of_vibration
from ...adjustment.reliability import CRITICAL_W
from ...arrays import Array
from ...geometry.rotation import corrected_angles
from ...models.base import Design
from ..results import AdjustedPoint, RefinedOrientation, WholeStrips
from ..state.batch import Batch, inverse_factors
from ..state.unknowns import Marginal, WindowState
from ..state.vibrations import Vibrations
from .solution import DenseSolution, Solution

#: Times of orientation that are refined at once: so few that observations have their unknowns in common. Tuned.
REFINED_AT_ONCE = 16
#: Factor by which a variance must exceed an earlier one to count as larger, above the rounding of either. Tuned.
LARGER = 1.01


@dataclass(frozen=True)
class LeftPoints:
    """Points that became final: as functions of the unknowns that their rays touch, and as they were published."""

    functions: EliminatedPoints
    points: tuple[AdjustedPoint, ...]

    @classmethod
    def of(cls, batch: Batch, published: Iterable[AdjustedPoint]) -> LeftPoints:
        """Those of a batch that were published, which are the ones of full rank, in its order."""
        full, normals = batch.normals.rank == 3, batch.normals
        factor, y = inverse_factors(normals)[full], normals.y.T[full]
        functions = EliminatedPoints(batch.columns, batch.origin_l[full], factor, y, batch.coupling[full])
        return cls(functions, tuple(published))

    def refined(self, solution: Solution) -> list[AdjustedPoint]:
        """The points as a solution of whole strips gives them."""
        xyz_l, covariance = self.functions.at(*solution.of(self.functions.columns))
        return [
            AdjustedPoint(p.name, p.role, xyz, C, p.rays, p.final, p.residuals, p.checked, whole=True)
            for p, xyz, C in zip(self.points, xyz_l, covariance, strict=True)
        ]


@dataclass
class LeftOrientation:
    """Orientation that became final.

    Attributes
    ----------
    published : at n times
    design : how its corrections depend on the unknowns
    noise : (n, 6, 6) covariance that comes from none of them, and is no vibration
    vibration : (n,) of the attitude from look to look, rad, as it was known then
    doubtful : whether looks were noisier than stated then, which was not known to be a vibration
    """

    published: RefinedOrientation
    design: Design
    noise: Array
    vibration: Array
    doubtful: bool

    def over(self, vibrations: Vibrations) -> None:
        """The strip is over: what was noise of its looks has turned out to be a vibration of the attitude, or not."""
        if self.doubtful:
            self.vibration = vibrations.since(self.published.time_s)

    def refined(self, solution: Solution) -> RefinedOrientation:
        """The orientation as a solution of whole strips gives it."""
        old, n = self.published, len(self.published.time_s)
        change, covariance = -old.correction, self.noise + of_vibration(self.vibration)
        for part in (slice(i, i + REFINED_AT_ONCE) for i in range(0, n, REFINED_AT_ONCE)):
            columns, A = self.design.part(part).functions()
            theta, Q = solution.of(columns)
            change[part] += A @ theta
            through = (A.reshape(-1, len(columns)) @ Q).reshape(A.shape)
            covariance[part] += through @ np.swapaxes(A, 1, 2)
        angles = corrected_angles(old.angles, change[:, 3:])
        angles[:, 2] = (angles[:, 2] + np.pi) % (2 * np.pi) - np.pi
        protection = old.protection
        if protection is not None:  # where control was taken out since, less is known than then
            now, then = np.einsum("nii->ni", covariance), np.einsum("nii->ni", old.covariance)
            protection = np.where(now > LARGER * then, np.hypot(protection, CRITICAL_W * np.sqrt(now)), protection)
        return replace(
            old, position_l=old.position_l + change[:, :3], angles=angles, covariance=covariance,
            correction=old.correction + change, protection=protection,
        )  # fmt: skip


@dataclass
class Step:
    """What left the window at one time.

    Attributes
    ----------
    marginal : the unknowns
    orientation : what became final with them, None if nothing did
    left : points that left since the step before
    """

    marginal: Marginal
    orientation: LeftOrientation | None
    left: list[LeftPoints] = field(default_factory=list)


def before(left: Marginal, later: DenseSolution) -> DenseSolution:
    """The solution for unknowns that left at one time and those that stayed then, from one for the latter.

    The cofactors of those that stayed are made symmetric: what rounding leaves of asymmetry would come back with
    the wrong sign in half of the cofactors between both, and grow from step to step without bounds.
    """
    x2, Q22 = later.of(left.stayed)
    Q22 = 0.5 * (Q22 + Q22.T)
    x1 = solve_triangular(left.R11, left.d1 - left.R12 @ x2, check_finite=False)
    T = solve_triangular(left.R11, left.R12, check_finite=False)
    own = solve_triangular(left.R11, np.eye(len(x1)), check_finite=False)
    Q12 = -T @ Q22
    Q = np.block([[own @ own.T - Q12 @ T.T, Q12], [Q12.T, Q22]])
    numbers, values = np.concatenate([left.gone, left.stayed]), np.concatenate([x1, x2])
    order = np.argsort(numbers)
    return DenseSolution(numbers[order], values[order], Q[np.ix_(order, order)])


def backward(steps: list[Step], state: WindowState) -> WholeStrips:
    """Go back through the steps, one or more, from the present state of the window."""
    found = WholeStrips([], [])
    stayed = np.sort(steps[-1].marginal.stayed)
    cofactors = state.covariance(stayed) if len(stayed) else np.empty((0, 0))
    solution = DenseSolution(stayed, state.values(stayed), cofactors)
    for step in reversed(steps):
        solution = before(step.marginal, solution)
        if step.orientation is not None:
            found.orientation.append(step.orientation.refined(solution))
        for left in reversed(step.left):
            found.points.extend(left.refined(solution))
    return WholeStrips(found.orientation[::-1], found.points[::-1])
