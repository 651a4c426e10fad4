"""Poses that tell how the platform moves, and those that do not: of a filter that has just begun."""

from __future__ import annotations

import numpy as np

from ..convert import PoseSample


class MovingPoses:
    """Leaves out filtered poses that do not know how the platform moves.

    A filter of positions begins with its first fix. Until the second one it does not know how fast it flies: its
    position stands where the fix was, and then jumps, which matching would take for the way of the platform. Fixes that
    have been missing for so long that nothing is left of what was known have the same effect. Such poses are not valid,
    and from one to the next they become uncertain by more than the way between them.

    Attributes
    ----------
    left_out : how many poses since the last one that was taken
    """

    def __init__(self) -> None:
        self.left_out = 0
        self._last: PoseSample | None = None

    def begin(self) -> None:
        """Poses that follow are not in the local frame of those before."""
        self.left_out, self._last = 0, None

    def takes(self, pose: PoseSample) -> bool:
        """Whether the motion is known at a pose that comes after the last one; both have a covariance."""
        last, self._last = self._last, pose
        if pose.valid:
            return True
        way_m = 0.0 if last is None else float(np.linalg.norm(pose.position_l - last.position_l))
        if _sigma_m(pose) - _sigma_m(last) <= way_m:
            return True
        self.left_out += 1
        return False


def _sigma_m(pose: PoseSample | None) -> float:
    """Of the position in space; 0 of no pose."""
    return 0.0 if pose is None or pose.covariance is None else float(np.sqrt(np.trace(pose.covariance[:3, :3])))
