"""Poses a navigation engine puts out, and the attitude samples they are made from."""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass
from math import asin, atan2, cos, inf, sin

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..geometry.frames import LocalFrame, opk_covariance_from_navigation
from ..geometry.rotation import (
    matrix_from_navigation,
    multiply_plain,
    quaternion_conjugate,
    quaternion_from_matrix,
    quaternion_multiply,
    vector_from_quaternion,
)

Array = NDArray[np.floating]
Quaternion = tuple[float, float, float, float]


@dataclass(frozen=True, slots=True)
class NavigationPose:
    """Pose of the camera.

    Attributes
    ----------
    time_s : time of validity
    position_l : (3,) perspective centre, local frame, m
    angles : (3,) omega, phi, kappa, rad
    quaternion : (4,) the same, ``R_lc`` xyzw
    velocity_l : (3,) m/s
    covariance : (6, 6) X, Y, Z, omega, phi, kappa; m, rad
    valid, reason : False with a reason where it should not be relied on
    smoothed : from the fixed-lag smoother
    noise_time_s : lag at which the noise of the position (slow errors apart) is correlated by 1/e; 0 = white
    """

    time_s: float
    position_l: Array
    angles: Array
    quaternion: Array
    velocity_l: Array
    covariance: Array
    valid: bool
    reason: str
    smoothed: bool
    noise_time_s: float = 0.0


@dataclass(frozen=True)
class NavigationEvent:
    """Something an operator should read."""

    time_s: float
    text: str


class AttitudeHistory:
    """Recent attitude samples, oldest first."""

    def __init__(self) -> None:
        self.time_s: list[float] = []
        self._rpy: list[Array] = []
        self._covariance: list[Array] = []

    @property
    def last_s(self) -> float:
        return self.time_s[-1] if self.time_s else -np.inf

    @property
    def covariance(self) -> Array:
        """(3, 3) of the newest sample."""
        return self._covariance[-1]

    def append(self, time_s: float, rpy: Array, covariance: Array) -> None:
        self.time_s.append(time_s)
        self._rpy.append(rpy)
        self._covariance.append(covariance)

    def covers(self, time_s: float) -> bool:
        return bool(self.time_s) and self.time_s[0] <= time_s <= self.time_s[-1]

    def at(self, time_s: float) -> Array:
        """Roll, pitch, heading (3,) at a time between samples, linear on the shorter arc."""
        i = min(max(bisect_right(self.time_s, time_s) - 1, 0), len(self.time_s) - 2)
        if i < 0:
            return self._rpy[0]
        share = (time_s - self.time_s[i]) / (self.time_s[i + 1] - self.time_s[i])
        turn = (self._rpy[i + 1] - self._rpy[i] + np.pi) % (2 * np.pi) - np.pi
        return self._rpy[i] + share * turn

    def between(self, after_s: float, to_s: float) -> tuple[int, int]:
        """Range of the samples with ``after_s < t <= to_s``."""
        return bisect_right(self.time_s, after_s), bisect_right(self.time_s, to_s)

    def part(self, low: int, high: int) -> tuple[Array, Array, Array]:
        """Times (n,), angles (n, 3) and covariances (n, 3, 3) of a range."""
        return np.array(self.time_s[low:high]), np.array(self._rpy[low:high]), np.array(self._covariance[low:high])

    def forget(self, before_s: float) -> None:
        """Drop what is older; the list is cut in larger pieces only."""
        n = bisect_right(self.time_s, before_s)
        if n > 256:
            del self.time_s[:n], self._rpy[:n], self._covariance[:n]


#: The Jacobian from navigation to photogrammetric angles is renewed when an angle has changed by this much, rad.
_TURN = 0.01


class PoseMaker:
    """Pose of the camera from position and measured attitude, for one sample at a time and with plain numbers.

    The north-east-down frame moves with the platform; between epochs it is turned on with the rate of the last one.
    """

    def __init__(self, frame: LocalFrame, R_bc: Array, attitude_sigma: ArrayLike):
        self.frame = frame
        self.R_bc = np.asarray(R_bc, dtype=float)
        self._q_bc = _plain(quaternion_from_matrix(self.R_bc))
        self._slow = np.diag(np.square(np.broadcast_to(attitude_sigma, 3)))
        self._time = 0.0
        self._q_ln: Quaternion = (0.0, 0.0, 0.0, 1.0)
        self._rate = (0.0, 0.0, 0.0)
        self._R_ln = np.eye(3)
        self._at_rpy = (inf, inf, inf)
        self._of_cov: Array | None = None
        self._cov_opk: Array = np.zeros((3, 3))

    def R_lb(self, position_l: Array, rpy: Array) -> Array:
        """Body to local (3, 3)."""
        return self.frame.R_ln(position_l) @ matrix_from_navigation(*rpy)

    def move(self, time_s: float, position_l: Array, velocity_l: Array) -> None:
        """The platform is here now and moves with this velocity."""
        speed = float(np.linalg.norm(velocity_l))
        ahead = velocity_l if speed < 1e3 else velocity_l * (1e3 / speed)
        R = self.frame.R_ln(np.stack([position_l, position_l + ahead]))
        self._R_ln = R[0]
        q = quaternion_from_matrix(R)
        turn = vector_from_quaternion(quaternion_multiply(quaternion_conjugate(q[0]), q[1]))
        self._time, self._q_ln = time_s, _plain(q[0])
        self._rate = (float(turn[0]), float(turn[1]), float(turn[2]))

    def pose(
        self, time_s: float, position_l: Array, velocity_l: Array, position_cov: Array, rpy: Array, cov_rpy: Array,
        valid: bool, reason: str,
    ) -> NavigationPose:  # fmt: skip
        """The filtered pose at a time."""
        half = 0.5 * (time_s - self._time)
        turn = (self._rate[0] * half, self._rate[1] * half, self._rate[2] * half, 1.0)
        roll, pitch, heading = rpy.tolist()
        q = multiply_plain(
            multiply_plain(self._q_ln, turn), multiply_plain(_navigation(roll, pitch, heading), self._q_bc)
        )
        x, y, z, w = q
        norm = (x * x + y * y + z * z + w * w) ** -0.5
        x, y, z, w = x * norm, y * norm, z * norm, w * norm
        omega = atan2(-2 * (y * z - x * w), 1 - 2 * (x * x + y * y))
        phi = asin(max(-1.0, min(1.0, 2 * (x * z + y * w))))
        kappa = atan2(-2 * (x * y - z * w), 1 - 2 * (y * y + z * z))
        angles = np.array([omega, phi, kappa])
        at_roll, at_pitch, at_heading = self._at_rpy
        turned = max(abs(roll - at_roll), abs(pitch - at_pitch), abs(heading - at_heading)) > _TURN
        if turned or cov_rpy is not self._of_cov:
            if turned or self._of_cov is None or (cov_rpy != self._of_cov).any():
                R_lc = self._R_ln @ matrix_from_navigation(*rpy) @ self.R_bc
                self._cov_opk = opk_covariance_from_navigation(rpy, R_lc, self._R_ln, cov_rpy) + self._slow
                self._at_rpy = (roll, pitch, heading)
            self._of_cov = cov_rpy
        covariance = np.zeros((6, 6))
        covariance[:3, :3] = position_cov
        covariance[3:, 3:] = self._cov_opk
        return NavigationPose(
            time_s, position_l, angles, np.array([x, y, z, w]), velocity_l, covariance, valid, reason, False
        )


def _plain(q: Array) -> Quaternion:
    return (float(q[0]), float(q[1]), float(q[2]), float(q[3]))


def _navigation(roll: float, pitch: float, heading: float) -> Quaternion:
    """Quaternion of ``R_nb = Rz(heading) Ry(pitch) Rx(roll)``."""
    sr, cr = sin(0.5 * roll), cos(0.5 * roll)
    sp, cp = sin(0.5 * pitch), cos(0.5 * pitch)
    sh, ch = sin(0.5 * heading), cos(0.5 * heading)
    return (
        ch * cp * sr - sh * sp * cr,
        ch * sp * cr + sh * cp * sr,
        sh * cp * cr - ch * sp * sr,
        ch * cp * cr + sh * sp * sr,
    )
