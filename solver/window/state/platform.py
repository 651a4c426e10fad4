"""The constant errors of the platform as unknowns of the window; they stay in it as long as it flies."""

from __future__ import annotations

import numpy as np

from ...arrays import Array
from ...geometry.measured_trajectory import MeasuredTrajectory
from ...geometry.trajectory import Poses
from ...models.base import Design
from ...models.platform import PlatformErrors
from .beforehand import KnownBeforehand
from .unknowns import WindowState

#: Least standard deviation of a value's departure from what was known beforehand, as a share of its sigma: where the
#: data say hardly anything of it, nothing speaks against the sigma either. Tuned.
LEAST_LEFT = 0.2


class LivePlatform(KnownBeforehand):
    """Its unknowns; see `KnownBeforehand`.

    Attributes
    ----------
    errors : which they are
    """

    def __init__(self, errors: PlatformErrors, trajectory: MeasuredTrajectory, state: WindowState) -> None:
        super().__init__(errors.sigma, state)
        self.errors, self._trajectory = errors, trajectory

    def question(self, critical: float) -> bool:
        """State sigmas larger that the solution contradicts; whether there are any.

        Parameters
        ----------
        critical : of the normalised residual of what was known beforehand
        """
        value, Q = self.values()
        left = np.sqrt(np.maximum(self.sigma**2 - np.diagonal(Q), 0.0))
        wrong = np.abs(value) > critical * np.maximum(left, LEAST_LEFT * self.sigma)
        wrong &= self.errors.questioned
        if not wrong.any():
            return False
        self.restate(np.where(wrong, np.maximum(np.abs(value), 2.0 * self.sigma), self.sigma))
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
