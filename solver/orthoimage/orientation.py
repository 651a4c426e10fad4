"""Where each line was taken from: measured poses at their high rate, and what an adjustment adds to them."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..geometry.rotation import angles_from_matrix, matrix_from_angles, matrix_from_quaternion
from ..geometry.trajectory import Trajectory

Array = NDArray[np.floating]
Mask = NDArray[np.bool_]

#: Measured poses farther apart than this have a gap between them; refined ones reach so far beyond the last, s.
GAP_S, REACH_S = 0.3, 1.0
#: A line so close to a measured pose was taken from there, s: tables state times to a microsecond, and seconds since
#: 1970 are known to a tenth of it.
SAME_S = 1e-6


class LineOrientation:
    """Measured orientation, refined where there is refined orientation.

    Refined poses come less often than lines. They are not interpolated themselves, which would smooth the motion of the
    platform away: what they add to the measured pose of the same time is, since errors of a trajectory change slowly.

    Parameters
    ----------
    time_s, position_l, quaternion : (n,), (n, 3), (n, 4) measured poses, ascending
    gap_s : measured poses farther apart than this have a gap between them

    Attributes
    ----------
    not_valid : how many measured poses were not taken because they are not to be relied on; for people

    Raises
    ------
    ValueError : fewer than two poses, times that do not increase
    """

    def __init__(self, time_s: ArrayLike, position_l: ArrayLike, quaternion: ArrayLike, gap_s: float = GAP_S) -> None:
        self.measured = Trajectory(time_s, position_l, quaternion)
        self.not_valid = 0
        self._gap_s = gap_s
        self._knots: tuple[Array, Array] | None = None
        self._covariance: tuple[Array, Array] | None = None

    @property
    def has_covariance(self) -> bool:
        """Whether covariances are stated."""
        return self._covariance is not None

    def state_covariance(self, time_s: ArrayLike, covariance: ArrayLike) -> None:
        """Covariances (m, 6, 6) of X, Y, Z, omega, phi, kappa at times (m,), m and rad; unknown ones are left out.

        Raises
        ------
        ValueError : none is known
        """
        t, Q = np.asarray(time_s, dtype=float), np.asarray(covariance, dtype=float)
        known = np.flatnonzero(np.isfinite(Q).all(axis=(1, 2)))
        if not len(known):
            raise ValueError("no pose has a covariance")
        t, first = np.unique(t[known], return_index=True)
        self._covariance = t, Q[known[first]]

    def covariance_at(self, time_s: ArrayLike) -> Array:
        """Covariances (n, 6, 6) at times (n,): between those that are stated, element by element.

        Raises
        ------
        ValueError : none is stated
        """
        if self._covariance is None:
            raise ValueError("no covariance is stated")
        stamps, Q = self._covariance
        t = np.asarray(time_s, dtype=float)
        after = np.clip(np.searchsorted(stamps, t), 1, max(len(stamps) - 1, 1)) % len(stamps)
        before = np.maximum(after - 1, 0)
        span = np.where(after > before, stamps[after] - stamps[before], 1.0)
        share = np.clip((t - stamps[before]) / span, 0.0, 1.0)[:, None, None]
        return (1.0 - share) * Q[before] + share * Q[after]

    def refine(self, time_s: ArrayLike, position_l: ArrayLike, quaternion: ArrayLike) -> None:
        """Refined poses (n,); those at times without measured pose are left out.

        Raises
        ------
        ValueError : none is left
        """
        t, position, q = (np.asarray(a, dtype=float) for a in (time_s, position_l, quaternion))
        t, first = np.unique(t, return_index=True)
        inside = self._measured_at(t)
        if not inside.any():
            raise ValueError("no refined pose lies inside the measured trajectory")
        t, first = t[inside], first[inside]
        measured = self.measured.at(t)
        turn = angles_from_matrix(matrix_from_quaternion(q[first])) - measured.angles
        turn = (turn + np.pi) % (2 * np.pi) - np.pi
        self._knots = t, np.concatenate([position[first] - measured.position_l, turn], axis=1)

    def covers(self, time_s: ArrayLike) -> Mask:
        """Which times (n,) have an orientation; where there is refined orientation at all, a refined one."""
        t = self._on_poses(np.asarray(time_s, dtype=float))
        good = self._measured_at(t)
        if self._knots is not None:
            knots = self._knots[0]
            i = np.searchsorted(knots, t)
            before = t - knots[np.maximum(i - 1, 0)]
            after = knots[np.minimum(i, len(knots) - 1)] - t
            good &= np.minimum(np.abs(before), np.abs(after)) <= REACH_S
        return good

    def at(self, time_s: ArrayLike) -> tuple[Array, Array]:
        """Perspective centres (n, 3) and rotations ``R_lc`` (n, 3, 3).

        Raises
        ------
        ValueError : a time outside the measured poses
        """
        t = self._on_poses(np.asarray(time_s, dtype=float))
        poses = self.measured.at(t)
        position, angles = poses.position_l, poses.angles
        if self._knots is not None:
            knots, added = self._knots
            correction = np.stack([np.interp(t, knots, column) for column in added.T], axis=1)
            position, angles = position + correction[:, :3], angles + correction[:, 3:]
        return position, matrix_from_angles(*angles.T)

    def _measured_at(self, t: Array) -> Mask:
        """Whether times have a measured pose, or lie between two without a gap."""
        times = self.measured.time_s
        i = np.clip(np.searchsorted(times, t, side="right") - 1, 0, len(times) - 2)
        there = (t == times[i]) | (t == times[i + 1])
        return there | (self.measured.covers(t) & (times[i + 1] - times[i] <= self._gap_s))

    def _on_poses(self, t: Array) -> Array:
        """Times; those of measured poses where they are the same but for their rounding."""
        times = self.measured.time_s
        after = np.clip(np.searchsorted(times, t), 1, len(times) - 1)
        nearest = np.where(t - times[after - 1] < times[after] - t, times[after - 1], times[after])
        return np.where(np.abs(nearest - t) <= SAME_S, nearest, t)
