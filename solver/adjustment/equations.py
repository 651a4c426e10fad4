"""The observation equations of a block at the values an adjustment has reached, and at those it tries next.

`gauss_newton.Descent` decides which steps are taken; what the steps are made of comes from here for a block whose rays
are all in memory. A block in partitions (`triline.solver.partitioned`) answers the same questions, each of its
partitions by one of these.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple, Protocol

import numpy as np

from ..arrays import Array
from .layout import Layout
from .linearisation import (
    Linearisation,
    Whitening,
    linearise,
    linearise_and_weigh,
    pitch_covariance,
    refresh_weights,
    whiten,
)
from .normal_equations import PointNormals, back_substitute, reduce_normals
from .normal_matrix import NormalMatrix
from .problem import Iteration, Problem, Solution, State, assumed_of, cost_of, start_state
from .reduced_system import Factor
from .robust import WeightFunction


class Normals(NamedTuple):
    """Reduced normal equations, and what the points alone promise to gain (sum of their squared ``y``)."""

    matrix: NormalMatrix
    rhs: Array
    squares: float


class Outcome(NamedTuple):
    """What a descent knows of itself at its end, for the solution."""

    factor: Factor
    steps: int
    converged: bool


class Equations(Protocol):
    """What a descent works on.

    Attributes
    ----------
    weights_given : whether it starts from weights that stay
    cost : sum of squared whitened residuals at the values reached
    """

    weights_given: bool

    @property
    def cost(self) -> float: ...
    def form(self, damping: float) -> Normals:
        """Normal equations at the values reached; ``damping`` multiplies their diagonals by ``1 + damping``."""
        ...

    def attempt(self, d_theta: Array, renewed: bool) -> float:
        """Cost at values changed by a step (n_unknowns,), with weights taken anew there or as they are."""
        ...

    def take(self) -> bool:
        """Take the step that was tried last; whether weights or places of the rays have changed with it."""
        ...

    def renew(self) -> None:
        """Take weights anew at the values reached, and with additional parameters the places of the rays."""
        ...

    def reweigh(self, robust: WeightFunction | None) -> None:
        """Robust weights of the rays at the values reached; their given ones without a weight function."""
        ...

    def refresh(self) -> None:
        """Equations and cost with the rays' weights as they are."""
        ...


@dataclass(frozen=True)
class Reached:
    """Values with the equations there, without the rays' own weights; what is kept of a step and of a partition."""

    state: State
    whitening: Whitening
    linearisation: Linearisation
    layout: Layout


class BlockEquations:
    """Equations of all rays of a problem, in memory; see `Equations`.

    Parameters
    ----------
    problem : what is adjusted
    start : a solution (warm, keeps its weights), a state, or points (p, 3) alone; None for the approximate ones
    given : (n,) factors on the rays' weights
    weights : "motion" or "pitch", see `AdjustmentOptions`
    """

    def __init__(self, problem: Problem, start: Solution | State | Array | None, given: Array, weights: str = "motion"):
        self.problem, self.given = problem, given
        self.keep_weights = weights == "pitch"
        self.weights_given = isinstance(start, Solution)
        if isinstance(start, Solution):
            self.at = Reached(start.state, start.whitening, start.linearisation, start.layout)
        else:
            state = start if isinstance(start, State) else start_state(problem, start)
            rays = problem.network.rays
            kept = whiten(pitch_covariance(rays)) if self.keep_weights else None
            fresh = linearise_and_weigh(rays, problem.layout, state.theta, state.points_l, kept)
            self.at = Reached(state, fresh.whitening, fresh.linearisation, fresh.layout)
        self.trial: tuple[Reached, Linearisation, float] | None = None
        self.points: PointNormals | None = None
        self.reweigh(None)

    @property
    def cost(self) -> float:
        return self._cost

    def form(self, damping: float) -> Normals:
        p, state = self.problem, self.at.state
        normals = reduce_normals(
            self.active, self.at.layout, p.elimination, p.prior, p.control, state.theta, state.points_l, damping
        )
        self.points = normals.points
        return Normals(normals.matrix, normals.rhs, float(np.vdot(normals.points.y, normals.points.y)))

    def attempt(self, d_theta: Array, renewed: bool) -> float:
        p, at = self.problem, self.at
        assert self.points is not None
        d_points = back_substitute(self.active, at.layout, p.elimination, self.points, d_theta)
        trial = State(at.state.theta + d_theta, at.state.points_l + d_points)
        with np.errstate(all="ignore"):
            if renewed:
                kept = at.whitening if self.keep_weights else None
                fresh = linearise_and_weigh(p.network.rays, at.layout, trial.theta, trial.points_l, kept)
                reached = Reached(trial, fresh.whitening, fresh.linearisation, fresh.layout)
            else:
                values = trial.theta, trial.points_l
                lin = linearise(p.network.rays, at.layout, at.whitening, *values, at.linearisation.camera)
                reached = Reached(trial, at.whitening, lin, at.layout)
            return self.retry(reached)

    def retry(self, reached: Reached) -> float:
        """Put values on trial; the cost there."""
        active = _weighted(reached.linearisation, self.weight)
        cost = cost_of(self.problem, reached.state, active)
        self.trial = reached, active, cost
        return cost

    def take(self) -> bool:
        assert self.trial is not None
        before = self.at
        (self.at, self.active, self._cost), self.trial = self.trial, None
        return self.at.layout is not before.layout or self.at.whitening is not before.whitening

    def renew(self) -> None:
        rays, at = self.problem.network.rays, self.at
        if at.layout.camera is not None:
            kept = at.whitening if self.keep_weights else None
            fresh = linearise_and_weigh(rays, at.layout, at.state.theta, at.state.points_l, kept)
            self.at = Reached(at.state, fresh.whitening, fresh.linearisation, fresh.layout)
        elif not self.keep_weights:
            whitening, lin = refresh_weights(rays, at.whitening, at.linearisation)
            self.at = replace(at, whitening=whitening, linearisation=lin)

    def reweigh(self, robust: WeightFunction | None) -> None:
        self.weigh(robust, residual_scale(self.used_residuals()) if robust is not None else 1.0)

    def weigh(self, robust: WeightFunction | None, scale: float) -> None:
        """`reweigh` with the scale of the residuals given; also takes up weights that were changed from outside."""
        self.weight = self.given
        if robust is not None:
            w = np.abs(self.at.linearisation.residual).max(axis=0)
            self.weight = self.given * robust(w / max(scale, 1e-12))
        self.refresh()

    def refresh(self) -> None:
        """Equations and cost with the rays' weights as they are."""
        self.active = _weighted(self.at.linearisation, self.weight)
        self._cost = cost_of(self.problem, self.at.state, self.active)

    def used_residuals(self) -> Array:
        """Absolute whitened residuals of rays with given weight."""
        return np.abs(self.at.linearisation.residual[:, self.given > 0])

    def solution(self, outcome: Outcome, history: tuple[Iteration, ...]) -> Solution:
        """The solution at the values reached, with what `form` found last."""
        p, at = self.problem, self.at
        assert self.points is not None
        n = 2 * int((self.weight > 0).sum()) + p.prior.n_observations + p.control.n_observations
        n += 0 if p.control.surface is None else p.control.surface.n_observations
        u = at.layout.n_unknowns - len(outcome.factor.undetermined) + int(self.points.rank.sum())
        return Solution(
            replace(p, layout=at.layout),
            at.state,
            at.whitening,
            self.weight,
            at.linearisation,
            self.points,
            outcome.factor,
            outcome.steps,
            outcome.converged,
            history,
            cost=self.cost,
            n_observations=n,
            n_unknowns=u,
            assumed=assumed_of(at.layout, p.prior, at.state.theta, outcome.factor, p.wide),
        )


def residual_scale(absolute: Array) -> float:
    """Sigma of whitened residuals from the median of their absolute values, but not less than 1; 1 without any.

    Residuals are smaller than errors by what the unknowns have taken of these, much where points have few rays. A scale
    that followed them would leave out good rays, whose residuals grow by that, and become smaller still.
    """
    return max(float(np.median(absolute)) / 0.6745, 1.0) if absolute.size else 1.0


def _weighted(lin: Linearisation, weight: Array) -> Linearisation:
    return lin if (weight == 1.0).all() else lin.reweighted(weight)
