"""Pose at any time between samples: cubic Hermite position, cubic attitude on the rotation group."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .rotation import (
    angles_from_matrix,
    angles_jacobian,
    matrix_from_quaternion,
    quaternion_conjugate,
    quaternion_from_vector,
    quaternion_multiply,
    skew,
    vector_from_quaternion,
)

Array = NDArray[np.floating]


@dataclass(frozen=True)
class Poses:
    """Measured exterior orientation at n times.

    Attributes
    ----------
    time_s : (n,)
    position_l : (n, 3) perspective centre, local frame, metres
    angles : (n, 3) omega, phi, kappa, radians
    velocity_l : (n, 3) m/s
    angle_rate : (n, 3) time derivative of omega, phi, kappa, rad/s
    """

    time_s: Array
    position_l: Array
    angles: Array
    velocity_l: Array
    angle_rate: Array

    def part(self, which: slice | NDArray[np.int64]) -> Poses:
        """Some of them."""
        return Poses(*(value[which] for value in vars(self).values()))

    @property
    def R_lc(self) -> Array:
        from .rotation import matrix_from_angles

        return matrix_from_angles(*self.angles.T)


class Trajectory:
    """A sampled pose, interpolated.

    The four samples about a time decide its pose (slopes at the two inner ones from their neighbours), so the result
    does not depend on how much of the trajectory has been received, and is continuous with its first derivative.

    Parameters
    ----------
    time_s : (n,) strictly increasing, n >= 2
    position_l : (n, 3) metres, local frame
    quaternion : (n, 4) ``R_lc`` as xyzw

    Raises
    ------
    ValueError : fewer than two samples, shapes that do not match, times that do not increase
    """

    def __init__(self, time_s: ArrayLike, position_l: ArrayLike, quaternion: ArrayLike):
        self.time_s = np.ascontiguousarray(time_s, dtype=float)
        self.position_l = np.ascontiguousarray(position_l, dtype=float)
        q = np.array(quaternion, dtype=float)
        n = len(self.time_s)
        if n < 2:
            raise ValueError(f"a trajectory needs at least 2 samples, got {n}")
        if self.position_l.shape != (n, 3) or q.shape != (n, 4):
            raise ValueError(f"position {self.position_l.shape} and quaternion {q.shape} do not match {n} times")
        step = np.diff(self.time_s)
        if not (step > 0).all():
            raise ValueError(f"times must increase; sample {int(np.argmin(step > 0)) + 1} does not")
        self.quaternion = q / np.linalg.norm(q, axis=1, keepdims=True)
        relative = quaternion_multiply(quaternion_conjugate(self.quaternion[:-1]), self.quaternion[1:])
        self._turn = vector_from_quaternion(relative)  # rotation vector from one sample to the next, image frame
        self._velocity = slopes(step, np.diff(self.position_l, axis=0))
        self._rate = slopes(step, self._turn)

    def __len__(self) -> int:
        return len(self.time_s)

    @property
    def start_s(self) -> float:
        return float(self.time_s[0])

    @property
    def end_s(self) -> float:
        return float(self.time_s[-1])

    def covers(self, time_s: ArrayLike) -> NDArray[np.bool_]:
        """Which times lie inside the trajectory."""
        t = np.asarray(time_s, dtype=float)
        return (t >= self.time_s[0]) & (t <= self.time_s[-1])

    def angles_at(self, time_s: ArrayLike) -> Array:
        """Omega, phi, kappa (m, 3) at times (m,) inside."""
        i, h, s = self._places(np.atleast_1d(np.asarray(time_s, dtype=float)))
        theta, _ = _hermite(s, h, self._turn[i], self._rate[i], self._rate[i + 1])
        return angles_from_matrix(matrix_from_quaternion(self._turned(i, theta)))

    def at(self, time_s: ArrayLike) -> Poses:
        """Pose at times (m,).

        Raises
        ------
        ValueError : a time outside the trajectory
        """
        t = np.atleast_1d(np.asarray(time_s, dtype=float))
        i, h, s = self._places(t)
        p0 = self.position_l[i]
        change = np.concatenate([self.position_l[i + 1] - p0, self._turn[i]], axis=1)
        slope0, slope1 = (np.concatenate([self._velocity[k], self._rate[k]], axis=1) for k in (i, i + 1))
        value, rate = _hermite(s, h, change, slope0, slope1)
        position, velocity, theta, theta_rate = value[:, :3], rate[:, :3], value[:, 3:], rate[:, 3:]
        R = matrix_from_quaternion(self._turned(i, theta))
        angles = angles_from_matrix(R)
        # angles between two samples are small, so theta_rate is the body rate to first order; one more term is kept
        rate_c = theta_rate - 0.5 * np.einsum("nij,nj->ni", skew(theta), theta_rate)
        rate_l = np.einsum("nij,nj->ni", R, rate_c)
        angle_rate = np.einsum("nij,nj->ni", angles_jacobian(angles), rate_l)
        return Poses(t, p0 + position, angles, velocity, angle_rate)

    def _places(self, t: Array) -> tuple[NDArray[np.intp], Array, Array]:
        """Sample before each time (m,), the step from it to the next (m, 1) and the share of it (m, 1)."""
        covered = self.covers(t)
        if not covered.all():
            bad = t[~covered][0]
            raise ValueError(f"time {bad:.6f} s outside the trajectory [{self.start_s:.6f}, {self.end_s:.6f}] s")
        i = sample_before(self.time_s, t)
        h = (self.time_s[i + 1] - self.time_s[i])[:, None]
        return i, h, (t - self.time_s[i])[:, None] / h

    def _turned(self, i: NDArray[np.intp], theta: Array) -> Array:
        """Quaternions (m, 4), turned from those of samples by rotation vectors (m, 3)."""
        return quaternion_multiply(self.quaternion[i], quaternion_from_vector(theta))


def sample_before(time_s: Array, at_s: Array) -> NDArray[np.intp]:
    """Sample (m,) from which times (m,) are interpolated to the next, among samples at times (n,): never the last."""
    return np.minimum(np.maximum(time_s.searchsorted(at_s, side="right") - 1, 0), len(time_s) - 2)


def slopes(step: Array, change: Array) -> Array:
    """Derivatives (n, k) at the samples from changes (n-1, k) over steps (n-1,): parabola through three neighbours."""
    secant = change / step[:, None]
    slope = np.empty((len(step) + 1, change.shape[1]))
    if len(step) == 1:
        slope[:] = secant[0]
        return slope
    w = (step[1:] / (step[:-1] + step[1:]))[:, None]
    slope[1:-1] = w * secant[:-1] + (1.0 - w) * secant[1:]
    slope[0] = 2.0 * secant[0] - slope[1]
    slope[-1] = 2.0 * secant[-1] - slope[-2]
    return slope


def _hermite(s: Array, h: Array, change: Array, slope0: Array, slope1: Array) -> tuple[Array, Array]:
    """Cubic from 0 to ``change`` with the slopes given: value and time derivative at share ``s`` of step ``h``."""
    s2, s3 = s * s, s * s * s
    w = 3 * s2 - 2 * s3
    value = w * change + h * ((s3 - 2 * s2 + s) * slope0 + (s3 - s2) * slope1)
    rate = (6 * (s - s2) / h) * change + (3 * s2 - 4 * s + 1) * slope0 + (3 * s2 - 2 * s) * slope1
    return value, rate


def noise_between(time_s: Array, covariance: Array, at_s: Array) -> Array:
    """Covariance (m, 6, 6) of the noise of an interpolated pose, from that of the samples (n, 6, 6) at times (n,).

    The white noise of the attitude shrinks between samples, since the interpolation averages; that of the position does
    not, it is correlated over many samples.
    """
    i = sample_before(time_s, at_s)
    s = (at_s - time_s[i]) / (time_s[i + 1] - time_s[i])
    factor = np.ones((len(s), 6))
    factor[:, 3:] = np.sqrt(hermite_noise(s))[:, None]
    return covariance[i + (s >= 0.5)] * factor[:, :, None] * factor[:, None, :]


def hermite_noise(s: Array) -> Array:
    """Sum of squared weights of the four samples about share ``s`` of a step: what is left of white noise variance."""
    s2, s3 = s * s, s * s * s
    h0, h1 = s3 - 2 * s2 + s, s3 - s2  # of the slopes, each half the difference of its sample's neighbours
    w0, w1 = 1 - 3 * s2 + 2 * s3, 3 * s2 - 2 * s3
    return (0.5 * h0) ** 2 + (w0 - 0.5 * h1) ** 2 + (w1 + 0.5 * h0) ** 2 + (0.5 * h1) ** 2
