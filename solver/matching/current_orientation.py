"""The best orientation known now, at any line time: measured poses at their high rate, plus slow corrections."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..geometry.measured_trajectory import GrowingTrajectory
from ..geometry.rotation import corrected_angles, matrix_from_angles
from .pose_smoothing import PoseSmoother
from .steady_positions import SteadyPositions

Array = NDArray[np.floating]

#: Corrections are averaged over so long: a live orientation moves a little at each update, and patches must not bend.
KNOT_S = 1.0
#: Poses and corrections older than this are forgotten where nothing else is said, s.
KEPT_S = 120.0
#: Poses are taken when orientation is asked for, or when so many have come. Tuned: with many more there is nothing left
#: to gain (bench/poses.py); the poses that come out are the same with any number.
MOST_NEW = 64
#: A correction that changes by more than this share of its sigma within so long, s, has been found anew, as when the
#: first control is met: slow errors change far less. What was told of earlier times was wrong by as much.
JUMP_SHARE, JUMP_S = 0.2, 0.5


class CurrentOrientation:
    """Measured poses and the corrections that an adjustment has found so far.

    Parameters
    ----------
    kept_s : what is older is forgotten, s; infinity where the first line of a strip is asked for at its end

    Attributes
    ----------
    changes : grows when orientation that was asked for before may be another one now
    """

    def __init__(self, kept_s: float = KEPT_S) -> None:
        self._kept_s = kept_s
        self.changes = 0
        self._trajectory = GrowingTrajectory()
        self._smoother, self._steady = PoseSmoother(), SteadyPositions(kept_s)
        self._new: list[tuple[float, Array, Array, Array]] = []
        self._last_s = -np.inf
        self._closed = False
        self._knots: dict[int, list[Array | int]] = {}
        self._covariance: dict[int, Array] = {}
        self._newest: tuple[float, Array] | None = None

    @property
    def end_s(self) -> float:
        """Times before this one will not change with the next pose; minus infinity with fewer than four poses."""
        return float(self._poses.time_s[-1 if self._closed else -2]) if len(self._poses) >= 4 else -np.inf

    @property
    def noise_left(self) -> Array:
        """(6,) variance of what is left of the poses' white noise: X, Y, Z, m^2, about x, y, z of the camera, rad^2."""
        self._smooth()
        return self._smoother.noise_left

    @property
    def start_s(self) -> float:
        return self._poses.start_s if len(self._poses) >= 2 else np.inf

    def add_pose(self, time_s: float, position_l: Array, quaternion: Array, covariance: Array) -> bool:
        """Add a measured pose; False for one that does not come after the last."""
        if time_s <= self._last_s:
            return False
        self._last_s = time_s
        self._steady.add(time_s, position_l)
        self._new.append((time_s, position_l, quaternion, covariance))
        if len(self._new) >= MOST_NEW:
            self._smooth()
        return True

    @property
    def _poses(self) -> GrowingTrajectory:
        """With all that has come."""
        self._smooth()
        return self._trajectory

    def _smooth(self) -> None:
        """Take the poses that have come since orientation was asked for last; twenty take hardly longer than one."""
        if not self._new:
            return
        time_s, position_l, quaternion, covariance = (np.array(column) for column in zip(*self._new, strict=True))
        self._new.clear()
        self._trajectory.append(*self._smoother.push(time_s, position_l, quaternion, covariance))
        newest_s = float(time_s[-1])
        if len(self._trajectory) > 4096 and self._trajectory.start_s < newest_s - 2 * self._kept_s:
            self._trajectory.forget(newest_s - self._kept_s)

    def close(self) -> None:
        """No more poses come: those that wait for neighbours are taken as they are."""
        self._smooth()
        self._trajectory.append(*self._smoother.rest())
        self._closed = True
        self.changes += 1

    def add_correction(self, time_s: float, correction: Array, covariance: Array) -> None:
        """Add what an adjustment adds to the measured pose at a time (6,), and the covariance (6, 6) of the sum."""
        if self._newest is not None and 0 <= time_s - self._newest[0] <= JUMP_S:
            change = correction - self._newest[1]
            if (np.abs(change) > JUMP_SHARE * np.sqrt(np.diagonal(covariance))).any():
                self._knots = {k: [n * correction, n] for k, (_, n) in self._knots.items()}
                self._covariance = dict.fromkeys(self._covariance, covariance)
        self._newest = time_s, correction
        knot = int(time_s // KNOT_S)
        total, n = self._knots.get(knot, (np.zeros(6), 0))
        self._knots[knot] = [total + correction, n + 1]
        self._covariance[knot] = covariance
        for old in [k for k in self._knots if k < knot - self._kept_s / KNOT_S]:
            del self._knots[old], self._covariance[old]
        self.changes += 1

    def beyond_s(self, time_s: float) -> float:
        """So long after the newest correction a time is, s; 0 without corrections."""
        return 0.0 if self._newest is None else max(time_s - self._newest[0], 0.0)

    def forget_corrections(self) -> None:
        """A new strip begins: corrections of the last one say little about it."""
        self._knots.clear()
        self._covariance.clear()
        self._newest = None

    def at(self, time_s: ArrayLike) -> tuple[Array, Array]:
        """Perspective centres (n, 3) and rotations ``R_lc`` (n, 3, 3) at times (n,) inside the poses."""
        t = np.asarray(time_s, dtype=float)
        poses = self._poses.at(t)
        position, angles = self._steady.at(t, poses.position_l), poses.angles
        if self._knots:
            numbers = sorted(self._knots)
            middle = (np.array(numbers) + 0.5) * KNOT_S
            values = np.array([self._knots[k][0] / self._knots[k][1] for k in numbers])
            correction = np.stack([np.interp(t, middle, column) for column in values.T], axis=1)
            position, angles = position + correction[:, :3], corrected_angles(angles, correction[:, 3:])
        return position, matrix_from_angles(*angles.T)

    def covariance(self, time_s: float) -> Array:
        """(6, 6) of the pose at a time; that of the nearest pose or corrected pose."""
        if self._knots:
            nearest = min(self._covariance, key=lambda k: abs((k + 0.5) * KNOT_S - time_s))
            return self._covariance[nearest]
        i = int(np.clip(np.searchsorted(self._poses.time_s, time_s), 0, len(self._poses) - 1))
        return self._poses.covariance[i]
