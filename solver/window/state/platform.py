"""The constant errors of the platform as unknowns of the window; they stay in it as long as it flies."""

from __future__ import annotations

import numpy as np

from ...arrays import Array
from ...geometry.measured_trajectory import MeasuredTrajectory
from ...geometry.trajectory import Poses
from ...models.base import Design
from ...models.platform import PlatformErrors
from .unknowns import WindowState

#: Least standard deviation of a value's departure from what was known beforehand, as a share of its sigma: where the
#: data say hardly anything of it, nothing speaks against the sigma either. Tuned.
LEAST_LEFT = 0.2


class LivePlatform:
    """Its unknowns are present from the start, with what is known of them beforehand.

    Attributes
    ----------
    errors : which they are
    numbers : (m,) in the window
    sigma : (m,) what is known of them beforehand, as stated or as restated
    """

    def __init__(self, errors: PlatformErrors, trajectory: MeasuredTrajectory, state: WindowState) -> None:
        self.errors, self._trajectory, self._state = errors, trajectory, state
        self.sigma = errors.sigma
        m = errors.n_unknowns
        self.numbers = state.new_numbers(m)
        self._equations = self.numbers[:, None].astype(np.int32), np.ones((m, 1)), np.zeros(m)
        if m:
            state.enter(self.numbers)
            state.observe(*self._equations, self.sigma)

    def question(self, critical: float) -> bool:
        """State sigmas larger that the solution contradicts; whether there are any.

        Parameters
        ----------
        critical : of the normalised residual of what was known beforehand
        """
        value, variance = self._state.values(self.numbers), np.diagonal(self._state.covariance(self.numbers))
        left = np.sqrt(np.maximum(self.sigma**2 - variance, 0.0))
        wrong = np.abs(value) > critical * np.maximum(left, LEAST_LEFT * self.sigma)
        wrong &= self.errors.questioned
        if not wrong.any():
            return False
        before, self.sigma = self.sigma, np.where(wrong, np.maximum(np.abs(value), 2.0 * self.sigma), self.sigma)
        self._state.reweigh(*self._equations, before, self.sigma)
        return True

    def joined(self, design: Design, time_s: Array, poses: Poses | None = None) -> Design:
        """The design of a strip at times (n,) with the errors of the platform; without them where nothing is measured.

        Parameters
        ----------
        poses : measured orientation at the times, if the caller has it
        """
        if not len(self.numbers):
            return design
        if poses is None:
            if not self._trajectory.covers(time_s).all():
                return design
            poses = self._trajectory.at(time_s).poses
        return design.joined(self.errors.design(poses, self._trajectory, heading=True), self.numbers)
