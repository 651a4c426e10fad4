"""Gauss-Newton with the object points eliminated, damped after Levenberg and Marquardt where a step fails."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from .linearisation import (
    Linearisation,
    Weighed,
    linearise,
    linearise_and_weigh,
    pitch_covariance,
    refresh_weights,
    whiten,
)
from .normal_equations import back_substitute, reduce_normals
from .problem import AdjustmentOptions, Iteration, Problem, Solution, State, cost_of, start_state
from .robust import WeightFunction

Array = NDArray[np.floating]

#: The image motion is taken anew for the weights after every step that lowers the cost by more than this share of it.
WEIGHTS_CHANGE = 1e-5
#: A step that promised less than this share of the cost and did not lower it met the rounding of the cost.
ROUNDING = 1e-10
#: Damping after a first failed step, the least from then on (all but the weakest unknowns converge with it), the most.
FIRST_DAMPING, LEAST_DAMPING, MOST_DAMPING = 1e-4, 1e-7, 1e10
#: Squared sigmas: where undamped steps fail, steps that gain less follow a direction that is hardly determined; enough.
INSIGNIFICANT = 1e-2


class Descent:
    """An adjustment on its way: values, weights, equations and cost, and the damping of the next step."""

    def __init__(
        self, problem: Problem, start: Solution | State | Array | None, given: Array, options: AdjustmentOptions
    ):
        self.problem, self.given, self.options = problem, given, options
        self.keep_weights = options.weights == "pitch"
        if isinstance(start, Solution):
            self.state, self.whitening, self.lin = start.state, start.whitening, start.linearisation
            self.layout = start.layout
            self.fresh_weights = 0  # how often they may still be taken anew
        else:
            self.state = start if isinstance(start, State) else start_state(problem, start)
            self.layout, rays = problem.layout, problem.network.rays
            at = self.state.theta, self.state.points_l
            given_weights = whiten(pitch_covariance(rays)) if self.keep_weights else None
            self.whitening, self.lin, self.layout = linearise_and_weigh(rays, self.layout, *at, given_weights)
            self.fresh_weights = 8
        self.history: list[Iteration] = []
        self.taken = 0
        self.damping, self.least_damping, self.last_drop = 0.0, 0.0, np.inf
        self.converged = self.stuck = False
        self._reweigh()
        self.form_normals()

    @property
    def arrived(self) -> bool:
        return self.converged or self.stuck

    def form_normals(self) -> None:
        """Reduced normal equations here, and what their solution promises to gain, as a share of the cost."""
        p = self.problem
        self.normals = reduce_normals(
            self.active,
            self.layout,
            p.elimination,
            p.prior,
            p.control,
            self.state.theta,
            self.state.points_l,
            self.damping,
        )
        self.factor = self.normals.matrix.factorise()
        self.d_theta = self.factor.solve(self.normals.rhs)
        y = self.normals.points.y
        # a cost far below one observation's is rounding, and its share of nothing
        self.gain = float(self.normals.rhs @ self.d_theta + np.vdot(y, y)) / max(self.cost, 1.0)
        self.converged = self.gain <= self.options.tolerance and self.damping <= self.least_damping

    def step(self) -> None:
        """Try the step; take it if it lowers the cost, otherwise damp the next one."""
        p = self.problem
        d_points = back_substitute(self.active, self.layout, p.elimination, self.normals.points, self.d_theta)
        trial = State(self.state.theta + self.d_theta, self.state.points_l + d_points)
        with np.errstate(all="ignore"):
            (whitening, lin, layout), active, cost = self._linearise(trial)
        accepted = bool(cost <= self.cost * (1.0 + 1e-13))
        self.history.append(Iteration(len(self.history) + 1, self.cost, cost, self.damping, accepted))
        if not accepted:
            self.converged = self.gain < ROUNDING
            self.least_damping = 10.0 * self.damping or LEAST_DAMPING  # what failed once is not tried again
            self.damping = 10.0 * self.damping or FIRST_DAMPING
            self.stuck = self.damping > MOST_DAMPING
            return
        drop = self.cost - cost
        # slow steps of little gain, though hardly damped
        self.converged = 0.0 < self.damping <= self.least_damping and 0.05 * self.last_drop < drop < INSIGNIFICANT
        self.damping, self.last_drop = max(self.damping / 10.0, self.least_damping), drop
        self.taken += 1
        weighed = layout is not self.layout or whitening is not self.whitening
        self.state, self.whitening, self.lin, self.active, self.cost = trial, whitening, lin, active, cost
        self.layout = layout
        if weighed:
            self.fresh_weights -= 1
        elif self.fresh_weights and drop > WEIGHTS_CHANGE * cost:
            self._renew(trial)
            self.fresh_weights -= 1
            self._reweigh()
            return
        if self.options.robust is not None:
            self._reweigh()

    def _renew(self, at: State) -> None:
        """Weights anew, and with additional parameters the places of the rays."""
        rays = self.problem.network.rays
        if self.layout.camera is not None:
            kept = self.whitening if self.keep_weights else None
            fresh = linearise_and_weigh(rays, self.layout, at.theta, at.points_l, kept)
            self.whitening, self.lin, self.layout = fresh
        elif not self.keep_weights:
            self.whitening, self.lin = refresh_weights(rays, self.whitening, self.lin)

    def _linearise(self, trial: State) -> tuple[Weighed, Linearisation, float]:
        """Weights and equations, equations with ray weights, and cost at trial values.

        From far away the weights are taken anew at once: that changes the cost by far less than the step does.
        Otherwise, and where the step does not lower the cost clearly, the weights stay as they were.
        """
        p, at = self.problem, (trial.theta, trial.points_l)
        if self.fresh_weights and self.gain > 0.5:
            kept = self.whitening if self.keep_weights else None
            fresh = linearise_and_weigh(p.network.rays, self.layout, *at, kept)
            active = _weighted(fresh.linearisation, self.weight)
            cost = cost_of(p, trial, active)
            if cost < 0.75 * self.cost:
                return fresh, active, cost
        lin = linearise(p.network.rays, self.layout, self.whitening, *at, self.lin.camera)
        active = _weighted(lin, self.weight)
        return Weighed(self.whitening, lin, self.layout), active, cost_of(p, trial, active)

    def _reweigh(self) -> None:
        """Robust weights here, for the first half of the iterations; equations and cost with them."""
        if self.taken <= self.options.max_iterations // 2:
            self.weight = _robust_weight(self.given, self.lin, self.options.robust)
        self.active = _weighted(self.lin, self.weight)
        self.cost = cost_of(self.problem, self.state, self.active)

    def solution(self) -> Solution:
        p = self.problem
        if self.damping:  # cofactors are those of the undamped system at the solution
            self.damping = 0.0
            converged = self.converged
            self.form_normals()
            self.converged = converged
        points = self.normals.points
        n = 2 * int((self.weight > 0).sum()) + p.prior.n_observations + p.control.n_observations
        n += 0 if p.control.surface is None else p.control.surface.n_observations
        u = self.layout.n_unknowns - len(self.factor.undetermined) + int(points.rank.sum())
        return Solution(
            replace(p, layout=self.layout),
            self.state,
            self.whitening,
            self.weight,
            self.lin,
            points,
            self.factor,
            self.cost,
            n,
            u,
            self.taken,
            self.converged,
            tuple(self.history),
        )


def _weighted(lin: Linearisation, weight: Array) -> Linearisation:
    return lin if (weight == 1.0).all() else lin.reweighted(weight)


def _robust_weight(given: Array, lin: Linearisation, robust: WeightFunction | None) -> Array:
    """Given weights times the weight function of the larger whitened residual, scaled by its median."""
    if robust is None:
        return given
    w = np.abs(lin.residual).max(axis=0)
    used = given > 0
    scale = np.median(np.abs(lin.residual[:, used])) / 0.6745 if used.any() else 1.0
    return given * robust(w / max(float(scale), 1e-12))
