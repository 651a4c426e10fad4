"""Inertial and GNSS measurements of a true motion, with the errors of real sensors."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import BSpline, make_interp_spline

from ..geometry import earth
from ..geometry.rotation import (
    matrix_from_navigation,
    matrix_from_quaternion,
    navigation_from_matrix,
    quaternion_conjugate,
    quaternion_from_matrix,
    quaternion_multiply,
)
from ..navigation.inertial_data import GnssData, InertialData, InertialGrade

Array = NDArray[np.floating]

_GAUSS = np.polynomial.legendre.leggauss(3)


@dataclass(frozen=True)
class TrueState:
    """True motion at n times: geodetic position, velocity and attitude.

    Attributes
    ----------
    time_s : (n,)
    lat, lon : (n,) radians
    height_m : (n,)
    velocity_n : (n, 3) m/s north, east, down
    R_nb : (n, 3, 3)
    """

    time_s: Array
    lat: Array
    lon: Array
    height_m: Array
    velocity_n: Array
    R_nb: Array

    @property
    def position_e(self) -> Array:
        return earth.ecef_from_geodetic(self.lat, self.lon, self.height_m)

    @property
    def angles(self) -> Array:
        """Roll, pitch, heading (n, 3), radians."""
        return navigation_from_matrix(self.R_nb)


class TrueMotion:
    """A motion, four times differentiable, through given positions and attitudes: quintic splines of the Earth-fixed
    position and of the quaternion. What inertial sensors feel on it follows by differentiation, not by an inverted
    mechanisation, so that it can judge the mechanisation.

    Parameters
    ----------
    time_s : (n,) increasing, n >= 6
    lat, lon : (n,) radians
    height_m : (n,)
    R_nb : (n, 3, 3)
    """

    def __init__(self, time_s: ArrayLike, lat: ArrayLike, lon: ArrayLike, height_m: ArrayLike, R_nb: ArrayLike):
        self.time_s = np.asarray(time_s, dtype=float)
        if len(self.time_s) < 6:
            raise ValueError(f"a motion needs at least 6 samples, got {len(self.time_s)}")
        position = earth.ecef_from_geodetic(lat, lon, height_m)
        self._origin = position[0]
        q = quaternion_from_matrix(earth.R_en(lat, lon) @ np.asarray(R_nb))
        flip = np.sign(np.sum(q[1:] * q[:-1], axis=1))
        q[1:] *= np.cumprod(np.where(flip == 0, 1.0, flip))[:, None]
        t = self.time_s - self.time_s[0]
        self._r: BSpline = make_interp_spline(t, position - self._origin, k=5)
        self._q: BSpline = make_interp_spline(t, q, k=5)
        self._v, self._a, self._dq = self._r.derivative(1), self._r.derivative(2), self._q.derivative(1)

    @property
    def start_s(self) -> float:
        return float(self.time_s[0])

    @property
    def end_s(self) -> float:
        return float(self.time_s[-1])

    def at(self, time_s: ArrayLike) -> TrueState:
        """The motion at times (n,)."""
        time = np.atleast_1d(np.asarray(time_s, dtype=float))
        t = time - self.time_s[0]
        g = earth.geodetic_from_ecef(self._r(t) + self._origin)
        R_ne = np.swapaxes(earth.R_en(g[:, 0], g[:, 1]), -1, -2)
        q = self._q(t)
        R_eb = matrix_from_quaternion(q / np.linalg.norm(q, axis=-1, keepdims=True))
        v = np.einsum("nij,nj->ni", R_ne, self._v(t))
        return TrueState(time, g[:, 0], g[:, 1], g[:, 2], v, R_ne @ R_eb)

    def felt(self, time_s: ArrayLike) -> tuple[Array, Array]:
        """Angular rate against inertial space (n, 3), rad/s, and specific force (n, 3), m/s^2; body axes."""
        t = np.asarray(time_s, dtype=float) - self.time_s[0]
        q, dq = self._q(t), self._dq(t)
        norm = np.linalg.norm(q, axis=-1, keepdims=True)
        q, dq = q / norm, dq / norm  # what dq has along q drops out below
        R_be = np.swapaxes(matrix_from_quaternion(q), -1, -2)
        rate = 2.0 * quaternion_multiply(quaternion_conjugate(q), dq)[..., :3]
        omega = np.array([0.0, 0.0, earth.ROTATION_RATE])
        r = self._r(t) + self._origin
        g = earth.geodetic_from_ecef(r)
        gravity = np.einsum("...ij,...j->...i", earth.R_en(g[..., 0], g[..., 1]), earth.gravity_n(g[..., 0], g[..., 2]))
        force = self._a(t) + 2.0 * np.cross(omega, self._v(t)) - gravity
        return rate + R_be @ omega, (R_be @ force[..., None])[..., 0]

    def increments(self, time_s: ArrayLike) -> InertialData:
        """Error-free increments between consecutive times (n + 1,): n samples."""
        time = np.asarray(time_s, dtype=float)
        dt = np.diff(time)
        dtheta, dv = np.zeros((len(dt), 3)), np.zeros((len(dt), 3))
        for x, w in zip(*_GAUSS, strict=True):
            rate, force = self.felt(time[:-1] + 0.5 * (1.0 + x) * dt)
            dtheta += (0.5 * w) * dt[:, None] * rate
            dv += (0.5 * w) * dt[:, None] * force
        zero = np.zeros(len(dt))
        return InertialData(time[1:], dt, dtheta, dv, zero, zero)


def with_errors(
    data: InertialData, grade: InertialGrade, rng: np.random.Generator
) -> tuple[InertialData, tuple[Array, Array]]:
    """Increments as a sensor of a grade measures them, and its true biases.

    Returns
    -------
    measured : the data with scale factors, biases and noise
    biases : gyro (n, 3) rad/s and accelerometer (n, 3) m/s^2
    """
    n = len(data)
    dt = data.dt_s[:, None]
    biases = [gauss_markov(data.dt_s, s, grade.bias_time_s, rng) for s in (grade.gyro_bias, grade.accel_bias)]
    scales = [1.0 + s * rng.standard_normal(3) for s in (grade.gyro_scale, grade.accel_scale)]
    noise = [s * np.sqrt(dt) * rng.standard_normal((n, 3)) for s in (grade.gyro_noise, grade.accel_noise)]
    dtheta = data.dtheta * scales[0] + biases[0] * dt + noise[0]
    dv = data.dv * scales[1] + biases[1] * dt + noise[1]
    return InertialData(data.time_s, data.dt_s, dtheta, dv, data.gyro_psd, data.accel_psd), (biases[0], biases[1])


def gauss_markov(dt_s: Array, sigma: float, time_s: float, rng: np.random.Generator) -> Array:
    """First-order Gauss-Markov process (n, 3), stationary from the start."""
    from scipy.signal import lfilter

    n = len(dt_s)
    decay = float(np.exp(-np.median(dt_s) / time_s))
    w = rng.standard_normal((n, 3)) * (sigma * np.sqrt(1.0 - decay**2))
    w[0] = sigma * rng.standard_normal(3)
    return np.asarray(lfilter([1.0], [1.0, -decay], w, axis=0))


def gnss_fixes(
    motion: TrueMotion,
    time_s: ArrayLike,
    sigma_ned_m: ArrayLike,
    rng: np.random.Generator,
    lever_arm_b: ArrayLike = (0.0, 0.0, 0.0),
    sigma_velocity_n: ArrayLike | None = None,
) -> GnssData:
    """Positions (and velocities) of an antenna with white noise.

    Parameters
    ----------
    sigma_ned_m : (3,) metres
    lever_arm_b : (3,) antenna from the inertial sensor, body axes, metres
    sigma_velocity_n : (3,) m/s; None leaves velocities out
    """
    time = np.asarray(time_s, dtype=float)
    arm = np.asarray(lever_arm_b, dtype=float)
    true = motion.at(time)
    R_en = earth.R_en(true.lat, true.lon)
    sigma = np.broadcast_to(np.asarray(sigma_ned_m, dtype=float), (len(time), 3))
    error_n = true.R_nb @ arm + sigma * rng.standard_normal((len(time), 3))
    g = earth.geodetic_from_ecef(true.position_e + (R_en @ error_n[..., None])[..., 0])
    velocity = s_v = None
    if sigma_velocity_n is not None:
        s_v = np.broadcast_to(np.asarray(sigma_velocity_n, dtype=float), (len(time), 3)).copy()
        rate_ib = motion.felt(time)[0]
        R_be = np.swapaxes(R_en @ true.R_nb, -1, -2)
        rate_eb = rate_ib - R_be @ np.array([0.0, 0.0, earth.ROTATION_RATE])
        velocity = true.velocity_n + (true.R_nb @ np.cross(rate_eb, arm)[..., None])[..., 0]
        velocity = velocity + s_v * rng.standard_normal((len(time), 3))
    return GnssData(time, g[:, 0], g[:, 1], g[:, 2], sigma.copy(), velocity, s_v)


def survey_flight(
    duration_s: float,
    rng: np.random.Generator,
    *,
    speed_m_s: float = 70.0,
    line_s: float = 60.0,
    bank_deg: float = 28.0,
    turbulence: float = 1.0,
    start: tuple[float, float, float] = (0.83, 0.16, 1500.0),
    static_s: float = 0.0,
    start_s: float = 0.0,
) -> TrueMotion:
    """Survey lines flown to and fro, turns with bank, turbulence in attitude and velocity.

    Parameters
    ----------
    line_s : time on a line between two half turns
    turbulence : 1 is moderate (0.7 deg in attitude, 0.7 m/s in velocity, up to 1 Hz), 0 is calm
    start : latitude and longitude in radians, height in metres
    static_s : time at rest before the flight
    """
    rate_hz = 20.0
    t = np.arange(int(duration_s * rate_hz) + 1) / rate_hz
    turn_rate = earth.normal_gravity(start[0], start[2]) * np.tan(np.radians(bank_deg)) / speed_m_s
    turn_s = np.pi / turn_rate
    flying = t - static_s
    leg = np.floor(flying / (line_s + turn_s))
    turning = (flying > 0) & (flying - leg * (line_s + turn_s) > line_s)
    smooth = np.hanning(int(5.0 * rate_hz) + 2)[1:-1]
    smooth /= smooth.sum()
    ramp = np.convolve(np.pad(np.clip(flying / 20.0, 0.0, 1.0), len(smooth), mode="edge"), smooth, "same")
    ramp = ramp[len(smooth) : -len(smooth)]
    if static_s == 0.0:
        ramp = np.ones_like(t)
    course_rate = np.convolve(np.where(turning, turn_rate * np.where(leg % 2 == 0, 1.0, -1.0), 0.0), smooth, "same")
    heading0 = 2 * np.pi * rng.random()
    course = heading0 + np.cumsum(course_rate) / rate_hz
    gust = [_gusts(len(t), rate_hz, f, rng) * turbulence * ramp[:, None] for f in (0.25, 0.8)]
    speed = speed_m_s * ramp
    v = np.stack([speed * np.cos(course), speed * np.sin(course), np.zeros_like(t)], axis=-1) + 0.7 * gust[0]
    angles = np.radians(0.7) * gust[1]
    angles[:, 0] += np.arctan(speed * course_rate / 9.8)
    angles[:, 1] += np.radians(3.0) * ramp
    angles[:, 2] += course + np.radians(4.0) * np.sin(course - 1.0) * ramp
    moved = np.zeros_like(v)
    moved[1:] = np.cumsum(0.5 * (v[1:] + v[:-1]), axis=0) / rate_hz
    R_N, R_E = earth.curvature_radii(start[0])
    lat = start[0] + moved[:, 0] / (R_N + start[2])
    lon = start[1] + moved[:, 1] / ((R_E + start[2]) * np.cos(lat))
    return TrueMotion(start_s + t, lat, lon, start[2] - moved[:, 2], matrix_from_navigation(*angles.T))


def _gusts(n: int, rate_hz: float, cutoff_hz: float, rng: np.random.Generator) -> Array:
    """Noise (n, 3) of unit variance below a frequency."""
    from scipy.signal import butter, sosfilt

    settle = int(10 * rate_hz / cutoff_hz)
    x = np.asarray(
        sosfilt(butter(3, cutoff_hz, fs=rate_hz, output="sos"), rng.standard_normal((n + settle, 3)), axis=0)
    )
    return (x / x.std(axis=0))[settle:]
