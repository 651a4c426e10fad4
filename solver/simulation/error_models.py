"""Errors of the trajectory sensors: white noise, and slow errors of known covariance.

A slow error is, for each strip, ``offset + wander(t)`` in X, Y, Z and ``shift + drift s + wander(t)`` in omega, phi,
kappa, ``s`` going from 0 at the first line to 1 at the last. Offset, shift, drift are drawn for each strip; between
two they pass smoothly from one to the next. The wander is one process over the whole flight (`models.gauss_markov`).

Measured = true + error, for positions in the local frame and for omega, phi, kappa; a correction that an adjustment
estimates is minus the error. An error of kappa is one of heading, about the vertical: omega and phi, right about level
axes, are told in axes that are turned with it (`rotation.measured_angles`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..geometry.frames import LocalFrame, navigation_from_R_lc
from ..geometry.rotation import matrix_from_angles, measured_angles
from ..geometry.trajectory import Trajectory
from ..models.gauss_markov import second_order_gauss_markov

if TYPE_CHECKING:
    from scipy.interpolate import CubicHermiteSpline


Array = NDArray[np.floating]
Three = tuple[float, float, float]

#: Step at which a wander is drawn; between, its own slopes interpolate it (error below 1e-4 sigma for 10 s and longer).
WANDER_STEP_S = 0.1


@dataclass(frozen=True)
class ErrorModel:
    """A-priori errors, 1 sigma; what the simulator draws from and what estimators are told.

    Attributes
    ----------
    offset_sigma_m : X, Y, Z, constant over a strip
    wander_sigma_m : X, Y, Z
    shift_sigma_deg : omega, phi, kappa, constant over a strip
    drift_sigma_deg : omega, phi, kappa, change over a strip
    wander_sigma_deg : omega, phi, kappa
    wander_time_s : correlation time of the wander (see `models.gauss_markov`)
    attitude_wander_time_s : of the attitude's, where it is another one; 0 = the same
    gnss_noise_m : X, Y, Z, white
    gnss_rate_hz :
    attitude_noise_deg : roll, pitch, heading, white
    attitude_rate_hz :

    Raises
    ------
    ValueError : a negative sigma, a rate or time that is not positive
    """

    offset_sigma_m: Three = (0.5, 0.5, 0.8)
    wander_sigma_m: Three = (1.0, 1.0, 1.5)
    shift_sigma_deg: Three = (0.02, 0.02, 0.04)
    drift_sigma_deg: Three = (0.01, 0.01, 0.01)
    wander_sigma_deg: Three = (0.005, 0.005, 0.01)
    wander_time_s: float = 30.0
    gnss_noise_m: Three = (0.03, 0.03, 0.03)
    gnss_rate_hz: float = 5.0
    attitude_noise_deg: Three = (0.0005, 0.0005, 0.001)
    attitude_rate_hz: float = 200.0
    attitude_wander_time_s: float = 0.0

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if isinstance(value, tuple):
                if len(value) != 3 or not all(np.isfinite(v) and v >= 0 for v in value):
                    raise ValueError(f"error model: {name} wants three numbers not below 0, got {value}")
            elif not (np.isfinite(value) and (value > 0 or (value == 0 and name == "attitude_wander_time_s"))):
                raise ValueError(f"error model: {name} must be positive, got {value}")


@dataclass(frozen=True)
class ErrorRealisation:
    """One drawing of the slow errors of a trajectory.

    Attributes
    ----------
    strip_s : (strips, 2) first and last line of each strip, ascending
    constant : (strips, 6) offset in m, shift in rad
    drift : (strips, 3) change of omega, phi, kappa over each strip, rad
    """

    strip_s: Array
    constant: Array
    drift: Array
    _systematic: CubicHermiteSpline
    _wander: CubicHermiteSpline

    def systematic(self, time_s: Array) -> Array:
        """Offset, shift and drift at times (n,): (n, 6), m and rad."""
        return self._systematic(np.asarray(time_s, dtype=float))

    def wander(self, time_s: Array) -> Array:
        """Wander at times (n,): (n, 6), m and rad."""
        return self._wander(np.asarray(time_s, dtype=float))

    def rate(self, time_s: Array) -> Array:
        """Time derivative of the whole slow error at times (n,): (n, 6), m/s and rad/s."""
        return self._systematic(np.asarray(time_s, dtype=float), 1) + self._wander(np.asarray(time_s, dtype=float), 1)

    def at(self, time_s: Array) -> Array:
        """The whole slow error at times (n,): (n, 6), m and rad."""
        return self.systematic(time_s) + self.wander(time_s)


def draw_wander(rng: np.random.Generator, n: int, step_s: float, sigma: Array, time_s: float) -> tuple[Array, Array]:
    """Value and time derivative (n, k) of k independent wanders of standard deviation ``sigma`` (k,); stationary."""
    F, Q, P0 = second_order_gauss_markov(1.0, time_s, step_s)
    draws = rng.standard_normal((n, 2, len(sigma)))
    draws[0] = np.sqrt(P0) @ draws[0]
    draws[1:] = np.linalg.cholesky(Q) @ draws[1:]
    for i in range(1, n):
        draws[i] += F @ draws[i - 1]
    return draws[:, 0] * sigma, draws[:, 1] * sigma


def draw_slow_errors(
    model: ErrorModel,
    strip_s: Array,
    start_s: float,
    end_s: float,
    position: np.random.Generator,
    attitude: np.random.Generator,
) -> ErrorRealisation:
    """Draw slow errors for a flight from ``start_s`` to ``end_s``, position and attitude each from its own stream.

    Parameters
    ----------
    strip_s : (k, 2) begin and end of each strip

    Raises
    ------
    ValueError : strips that overlap in time
    """
    from scipy.interpolate import CubicHermiteSpline

    strip_s = np.asarray(strip_s, dtype=float)
    if not (np.diff(strip_s.ravel()) > 0).all():
        raise ValueError("strips must follow each other in time")
    n = int(np.ceil((end_s - start_s) / WANDER_STEP_S)) + 1
    parts = [
        draw_wander(rng, n, WANDER_STEP_S, np.asarray(sigma), time_s)
        for rng, sigma, time_s in (
            (position, model.wander_sigma_m, model.wander_time_s),
            (attitude, np.radians(model.wander_sigma_deg), model.attitude_wander_time_s or model.wander_time_s),
        )
    ]
    value, rate = (np.hstack([p[i] for p in parts]) for i in range(2))
    count = len(strip_s)
    offset = position.standard_normal((count, 3)) * model.offset_sigma_m
    shift = attitude.standard_normal((count, 3)) * np.radians(model.shift_sigma_deg)
    drift = attitude.standard_normal((count, 3)) * np.radians(model.drift_sigma_deg)
    constant = np.hstack([offset, shift])
    wander = CubicHermiteSpline(start_s + WANDER_STEP_S * np.arange(n), value, rate)
    return ErrorRealisation(strip_s, constant, drift, _systematic(strip_s, constant, drift, start_s, end_s), wander)


def _systematic(strip_s: Array, constant: Array, drift: Array, start_s: float, end_s: float) -> CubicHermiteSpline:
    """Straight lines over the strips and on beyond the first and the last, smooth bridges between."""
    from scipy.interpolate import CubicHermiteSpline

    change = np.hstack([np.zeros_like(drift), drift])
    slope = change / np.diff(strip_s, axis=1)
    value = np.stack([constant, constant + change], axis=1).reshape(-1, 6)
    rate = np.repeat(slope, 2, axis=0)
    before, after = strip_s[0, 0] - start_s, end_s - strip_s[-1, 1]
    t = np.concatenate([[start_s - 1.0], strip_s.ravel(), [end_s + 1.0]])
    value = np.vstack([value[0] - slope[0] * (before + 1.0), value, value[-1] + slope[-1] * (after + 1.0)])
    return CubicHermiteSpline(t, value, np.vstack([rate[0], rate, rate[-1]]))


def measure_attitude(
    truth: Trajectory,
    frame: LocalFrame,
    R_bc: Array,
    time_s: Array,
    slow: ErrorRealisation,
    sigma_deg: Three,
    rng: np.random.Generator,
) -> Array:
    """Roll, pitch, heading (n, 3) in radians of the body, as an inertial system reports them at times (n,)."""
    poses = truth.at(time_s)
    angles = measured_angles(poses.angles, slow.at(time_s)[:, 3:])
    rpy = navigation_from_R_lc(frame, poses.position_l, matrix_from_angles(*angles.T), R_bc)
    rpy += rng.standard_normal(rpy.shape) * np.radians(sigma_deg)
    rpy[:, 2] %= 2 * np.pi
    return rpy


def antenna_position(truth: Trajectory, R_bc: Array, lever_arm_b: Array, time_s: Array) -> Array:
    """True place (n, 3) of the GNSS antenna, local frame; the lever arm leads to it from the perspective centre."""
    poses = truth.at(time_s)
    return poses.position_l + poses.R_lc @ R_bc.T @ lever_arm_b


def measure_gnss(
    truth: Trajectory,
    frame: LocalFrame,
    R_bc: Array,
    lever_arm_b: Array,
    time_s: Array,
    slow: ErrorRealisation,
    sigma_m: Three,
    rng: np.random.Generator,
) -> Array:
    """Latitude, longitude (degrees) and height (n, 3) of the antenna, as a receiver reports them at times (n,)."""
    position = antenna_position(truth, R_bc, lever_arm_b, time_s) + slow.at(time_s)[:, :3]
    return frame.to_geodetic(position + rng.standard_normal(position.shape) * sigma_m)
