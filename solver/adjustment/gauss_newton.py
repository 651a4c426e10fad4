"""Gauss-Newton with the object points eliminated, damped after Levenberg and Marquardt where a step fails."""

from __future__ import annotations

import numpy as np

from .equations import Equations, Outcome
from .problem import AdjustmentOptions, Iteration

#: The image motion is taken anew for the weights after every step that lowers the cost by more than this share of it.
WEIGHTS_CHANGE = 1e-5
#: A step that promised less than this share of the cost and did not lower it met the rounding of the cost.
ROUNDING = 1e-10
#: Damping after a first failed step, the least from then on (all but the weakest unknowns converge with it), the most.
FIRST_DAMPING, LEAST_DAMPING, MOST_DAMPING = 1e-4, 1e-7, 1e10
#: Squared sigmas: where undamped steps fail, steps that gain less follow a direction that is hardly determined; enough.
INSIGNIFICANT = 1e-2
#: Times that weights are taken anew at most, from values that are no solution.
FRESH_WEIGHTS = 8


class Descent:
    """An adjustment on its way: the equations where it has arrived, and the damping of the next step."""

    def __init__(self, equations: Equations, options: AdjustmentOptions):
        self.equations, self.options = equations, options
        self.fresh_weights = 0 if equations.weights_given else FRESH_WEIGHTS  # how often they may still be taken anew
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
        normals = self.equations.form(self.damping)
        self.factor = normals.matrix.factorise()
        self.d_theta = self.factor.solve(normals.rhs)
        # a cost far below one observation's is rounding, and its share of nothing
        self.gain = float(normals.rhs @ self.d_theta + normals.squares) / max(self.equations.cost, 1.0)
        self.converged = self.gain <= self.options.tolerance and self.damping <= self.least_damping

    def step(self) -> None:
        """Try the step; take it if it lowers the cost, otherwise damp the next one."""
        before = self.equations.cost
        cost = self._attempt(before)
        accepted = bool(cost <= before * (1.0 + 1e-13))
        self.history.append(Iteration(len(self.history) + 1, before, cost, self.damping, accepted))
        if not accepted:
            self.converged = self.gain < ROUNDING
            self.least_damping = 10.0 * self.damping or LEAST_DAMPING  # what failed once is not tried again
            self.damping = 10.0 * self.damping or FIRST_DAMPING
            self.stuck = self.damping > MOST_DAMPING
            return
        drop = before - cost
        # slow steps of little gain, though hardly damped
        self.converged = 0.0 < self.damping <= self.least_damping and 0.05 * self.last_drop < drop < INSIGNIFICANT
        self.damping, self.last_drop = max(self.damping / 10.0, self.least_damping), drop
        self.taken += 1
        if self.equations.take():
            self.fresh_weights -= 1
        elif self.fresh_weights and drop > WEIGHTS_CHANGE * cost:
            self.equations.renew()
            self.fresh_weights -= 1
            self._reweigh()
            return
        if self.options.robust is not None:
            self._reweigh()

    def _attempt(self, before: float) -> float:
        """Cost at the values that the step leads to.

        From far away the weights are taken anew at once: that changes the cost by far less than the step does.
        Otherwise, and where the step does not lower the cost clearly, the weights stay as they were.
        """
        if self.fresh_weights and self.gain > 0.5:
            cost = self.equations.attempt(self.d_theta, True)
            if cost < 0.75 * before:
                return cost
        return self.equations.attempt(self.d_theta, False)

    def _reweigh(self) -> None:
        """Robust weights here, for the first half of the iterations; the last ones stay from then on."""
        if self.options.robust is not None and self.taken > self.options.max_iterations // 2:
            self.equations.refresh()
            return
        self.equations.reweigh(self.options.robust)

    def finished(self) -> Outcome:
        """The end: cofactors are those of the undamped system there."""
        if self.damping:
            self.damping = 0.0
            converged = self.converged
            self.form_normals()
            self.converged = converged
        return Outcome(self.factor, self.taken, self.converged)
