"""The kinematic filter's model: its states and settings, how they move on, and what lies between two of them."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ..geometry.rotation import R_BC_NOMINAL
from ..models.gauss_markov import second_order_gauss_markov

Array = NDArray[np.floating]

#: States: position, velocity, acceleration, slow GNSS error and its rate; three axes each, axis fastest (definition).
P, V, A, W, WD = (slice(3 * i, 3 * i + 3) for i in range(5))
N_STATES = 15
#: Lag in units of 1 / w_s at which the error of the smoothed position is correlated by 1/e; derived in `noise_time`.
NOISE_TIMES_BANDWIDTH = 1.963


@dataclass(frozen=True)
class KinematicOptions:
    """Settings of the filter.

    Attributes
    ----------
    lever_arm_b : (3,) perspective centre to antenna, body axes, m
    R_bc : (3, 3) image to body, with the boresight
    offset_sigma_m : (3,) constant error of the GNSS positions
    wander_sigma_m, wander_time_s : (3,) slow error of the GNSS positions, 1 sigma, and its correlation time
    attitude_sigma : (3,) slow error of omega, phi, kappa, rad; added to the white noise of the samples
    jerk_psd : spectral density of the jerk, m^2/s^5; too large costs little, too small lags behind motion
    lag_s : of the smoothed trajectory
    hold_s : in an outage the smoothed trajectory waits for the fixes after it, so long at most: a gap bridged from both
        sides is far better known than one extrapolated
    lateness_s : a fix that is late by no more than this is filtered in again
    coast_limit_s, sigma_limit_m : longer without a fix, or a filter sigma (slow errors apart) above: not valid
    gate, hard_gate : normalised innovation squared of a position above which a fix is weighted down, or refused
    patience : so many refused fixes in a row mean that the filter is wrong; it starts again
    attitude_gap_s : a longer step between attitude samples is a gap, if it is half as long again as the usual one
    filtered_s : least distance of filtered poses; 0 = one at each attitude sample
    """

    lever_arm_b: Array = field(default_factory=lambda: np.zeros(3))
    R_bc: Array = field(default_factory=lambda: R_BC_NOMINAL)
    offset_sigma_m: Array = field(default_factory=lambda: np.zeros(3))
    wander_sigma_m: Array = field(default_factory=lambda: np.zeros(3))
    wander_time_s: float = 60.0
    attitude_sigma: Array = field(default_factory=lambda: np.zeros(3))
    jerk_psd: float = 1.0
    lag_s: float = 1.0
    hold_s: float = 22.0
    lateness_s: float = 2.0
    coast_limit_s: float = 2.5
    sigma_limit_m: float = 2.0
    gate: float = 16.27  # chi-square, 3 degrees of freedom, 0.1 %
    hard_gate: float = 150.0
    patience: int = 5
    attitude_gap_s: float = 0.1
    filtered_s: float = 0.0


def transition(dt: float, options: KinematicOptions) -> tuple[Array, Array]:
    """Transition and noise (15, 15) of the filter's states over a step."""
    I3 = np.eye(3)
    F, Q = np.eye(N_STATES), np.zeros((N_STATES, N_STATES))
    F[P, V] = F[V, A] = dt * I3
    F[P, A] = 0.5 * dt * dt * I3
    grown = ((dt**5 / 20, dt**4 / 8, dt**3 / 6), (dt**4 / 8, dt**3 / 3, dt**2 / 2), (dt**3 / 6, dt**2 / 2, dt))
    for i, si in enumerate((P, V, A)):
        for j, sj in enumerate((P, V, A)):
            Q[si, sj] = options.jerk_psd * grown[i][j] * I3
    Fw, Qw, _ = second_order_gauss_markov(1.0, options.wander_time_s, dt)
    variance = np.diag(np.square(np.broadcast_to(options.wander_sigma_m, 3)) + 1e-12)
    for i, si in enumerate((W, WD)):
        for j, sj in enumerate((W, WD)):
            F[si, sj] = Fw[i, j] * I3
            Q[si, sj] = Qw[i, j] * variance
    return F, Q


def noise_time(jerk_psd: float, fix_density: float) -> float:
    """Lag at which the error of a smoothed position is correlated by 1/e, s.

    The error of the Wiener smoother of white noise jerk has the spectrum ``fix_density / (1 + (w / w_s)^6)`` with
    ``w_s^6 = jerk_psd / fix_density``, and is correlated by 1/e at ``NOISE_TIMES_BANDWIDTH / w_s``.

    Parameters
    ----------
    fix_density : variance of a fix times the time between two, m^2 s
    """
    return NOISE_TIMES_BANDWIDTH * (fix_density / jerk_psd) ** (1.0 / 6.0)


def quintic(t: Array, h: Array, x0: Array, x1: Array) -> tuple[Array, Array]:
    """Position and velocity (n, 3) at times ``t`` after the first of two states (n, 15) that lie ``h`` apart.

    The fifth-degree polynomial through both positions, velocities and accelerations; for white noise jerk it is the
    conditional mean between the two states.
    """
    t, h = t[:, None], h[:, None]
    s = t / h
    dp = x1[:, P] - x0[:, P] - h * x0[:, V] - 0.5 * h * h * x0[:, A]
    dv = (x1[:, V] - x0[:, V] - h * x0[:, A]) * h
    da = (x1[:, A] - x0[:, A]) * h * h
    c3, c4, c5 = 10 * dp - 4 * dv + 0.5 * da, -15 * dp + 7 * dv - da, 6 * dp - 3 * dv + 0.5 * da
    position = x0[:, P] + t * x0[:, V] + 0.5 * t * t * x0[:, A] + s**3 * (c3 + s * (c4 + s * c5))
    velocity = x0[:, V] + t * x0[:, A] + s**2 * (3 * c3 + s * (4 * c4 + 5 * s * c5)) / h
    return position, velocity
