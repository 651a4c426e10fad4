"""Error-state filter of a strapdown navigator with GNSS.

The errors are, Earth-fixed, ``dr, dv, psi`` (metres, m/s, rad; ``R_eb = exp([psi]) R_eb_hat``), then gyro and
accelerometer errors (biases, on request also scale factors), then on request the lever arm of the antenna. They are
zero before every update: what an update finds is put into the state at once.

The covariance is updated in Joseph's form. Gating, down-weighting and the state on the rotation group stand around it.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ..geometry import earth
from ..models.gauss_markov import damping_rate, second_order_gauss_markov
from ..quantiles import chi2
from .inertial_data import TACTICAL, InertialGrade
from .strapdown import IncrementBlock, State, process_noise, propagate, rotation_matrix, transition

Array = NDArray[np.floating]

#: Places in the error state (definition).
POSITION, VELOCITY, ATTITUDE = slice(0, 3), slice(3, 6), slice(6, 9)


@dataclass(frozen=True)
class NavigationSettings:
    """What a navigator has to know about its sensors, and how it treats them.

    Attributes
    ----------
    grade : error model of the inertial sensor
    lever_arm_b : (3,) antenna from the inertial sensor, body axes, metres
    lever_arm_sigma_m : standard deviation of the lever arm; 0 takes it as known, else it is estimated
    wander_sigma_ned_m : slow errors of GNSS positions north, east, down (see `models.gauss_markov`); zero has none,
        else they are estimated beside the position
    wander_time_s : their correlation time
    scale_factors : estimate scale factors (their sigmas are in the grade)
    step_s : longest time between two covariances
    soft_gate, hard_gate : an innovation that is rarer than ``soft_gate`` (probability) is weighted down to it; one
        whose square is ``hard_gate`` times larger still is rejected
    restore_after : after so many rejections in a row the filter, not the observation, is taken to be wrong
    gap_rate_sigma, gap_force_sigma : how far rates (rad/s) and specific forces (m/s^2) in a gap may be from the
        straight line between its ends
    longest_gap_s : a longer gap in the inertial data ends the navigation, and it is aligned anew
    """

    grade: InertialGrade = TACTICAL
    lever_arm_b: tuple[float, float, float] = (0.0, 0.0, 0.0)
    lever_arm_sigma_m: float = 0.0
    wander_sigma_ned_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    wander_time_s: float = 60.0
    scale_factors: bool = False
    step_s: float = 0.5
    soft_gate: float = 1e-3
    hard_gate: float = 6.0
    restore_after: int = 3
    gap_rate_sigma: float = 0.05
    gap_force_sigma: float = 0.5
    longest_gap_s: float = 10.0

    @cached_property
    def layout(self) -> StateLayout:
        return StateLayout(
            6 if self.scale_factors else 3, self.lever_arm_sigma_m > 0.0, max(self.wander_sigma_ned_m) > 0.0
        )


@dataclass(frozen=True)
class StateLayout:
    """Where the errors stand in the vector."""

    k: int  # per sensor: 3 biases, or 3 biases and 3 scale factors
    with_lever_arm: bool
    with_wander: bool = False  # slow errors of GNSS and their rates, Earth-fixed

    @cached_property
    def n(self) -> int:
        return self.lever_arm.stop + (6 if self.with_wander else 0)

    @cached_property
    def gyro(self) -> slice:
        return slice(9, 9 + self.k)

    @cached_property
    def accel(self) -> slice:
        return slice(9 + self.k, 9 + 2 * self.k)

    @cached_property
    def lever_arm(self) -> slice:
        first = 9 + 2 * self.k
        return slice(first, first + (3 if self.with_lever_arm else 0))

    @cached_property
    def wander(self) -> slice:
        return slice(self.lever_arm.stop, self.n)


@dataclass(slots=True)
class Estimate:
    """State with sensor errors, at a time.

    Attributes
    ----------
    time_s : time
    state : position, velocity, attitude
    gyro, accel : (k,) biases (rad/s, m/s^2) and scale factors
    lever_arm_b : (3,) metres
    wander_e : (6,) slow error of GNSS positions and its rate, Earth-fixed, metres, m/s
    """

    time_s: float
    state: State
    gyro: Array
    accel: Array
    lever_arm_b: Array
    wander_e: Array = field(default_factory=lambda: np.zeros(6))

    def corrected(self, x: Array, layout: StateLayout) -> Estimate:
        """The estimate with errors (n,) put in."""
        s = self.state
        state = State(s.r_e + x[POSITION], s.v_e + x[VELOCITY], rotation_matrix(x[ATTITUDE]) @ s.R_eb)
        arm = self.lever_arm_b + x[layout.lever_arm] if layout.with_lever_arm else self.lever_arm_b
        wander = self.wander_e + x[layout.wander] if layout.with_wander else self.wander_e
        return Estimate(self.time_s, state, self.gyro + x[layout.gyro], self.accel + x[layout.accel], arm, wander)


class Observation(Protocol):
    """An observation at the time of an estimate.

    Attributes
    ----------
    kind : its name
    axes : (3, 3) from the axes of the innovation to those it is shown in, or None
    gated : whether an innovation that is too large is weighted down or rejected
    """

    @property
    def kind(self) -> str: ...
    @property
    def axes(self) -> Array | None: ...
    @property
    def gated(self) -> bool: ...

    def linearise(self, estimate: Estimate, layout: StateLayout) -> tuple[Array, Array, Array]:
        """Innovation (m,), its derivative (m, n) with respect to the errors, and the noise covariance (m, m)."""
        ...


@dataclass(frozen=True, slots=True)
class Innovation:
    """What an observation said.

    Attributes
    ----------
    time_s, kind : of the observation
    value, sigma : (m,) innovation and its standard deviation as predicted, in the axes of the observation
    nis : normalised innovation squared, chi-square of ``m`` degrees of freedom
    status : ``used``, ``weighted`` (down), ``rejected``, ``restored`` (used, after the covariance was enlarged),
        ``held out`` (compared only)
    """

    time_s: float
    kind: str
    value: Array
    sigma: Array
    nis: float
    status: str


@dataclass(slots=True)
class Start:
    """Where a navigation starts: an estimate, its covariance (n, n), and how it was found."""

    estimate: Estimate
    P: Array
    how: str = "given"
    notes: list[str] = field(default_factory=list)


def bias_variances(settings: NavigationSettings) -> Array:
    """A-priori variances of the sensor errors, and of the lever arm where it is estimated, (n - 9,)."""
    g, k = settings.grade, settings.layout.k
    out = [np.full(3, g.gyro_bias**2), np.full(3, g.accel_bias**2)]
    if k == 6:
        out = [out[0], np.full(3, g.gyro_scale**2), out[1], np.full(3, g.accel_scale**2)]
    if settings.layout.with_lever_arm:
        out.append(np.full(3, settings.lever_arm_sigma_m**2))
    return np.concatenate(out)


def sensor_covariance(settings: NavigationSettings, r_e: Array) -> Array:
    """A-priori covariance (n - 9, n - 9) of all but position, velocity and attitude, at a place (3,) Earth-fixed."""
    lay = settings.layout
    variances = bias_variances(settings)
    P = np.zeros((lay.n - 9, lay.n - 9))
    i = np.arange(len(variances))
    P[i, i] = variances
    if lay.with_wander:
        P[-6:, -6:] = np.kron(np.diag([1.0, damping_rate(settings.wander_time_s) ** 2]), _wander_e(settings, r_e))
    return P


def _kron(A: Array, B: Array) -> Array:
    """Kronecker product of two small matrices, in a fifth of the time that `numpy.kron` takes for any arrays."""
    (a, b), (c, d) = A.shape, B.shape
    return (A[:, None, :, None] * B[None, :, None, :]).reshape(a * c, b * d)


def _wander_e(settings: NavigationSettings, r_e: Array) -> Array:
    """Covariance (3, 3) of the slow errors of GNSS, Earth-fixed."""
    g = earth.geodetic_from_ecef(r_e)
    A = earth.R_en(g[0], g[1]) * np.asarray(settings.wander_sigma_ned_m)
    return A @ A.T


class ErrorStateFilter:
    """One navigator's filter: an estimate, its covariance, and the two steps.

    Parameters
    ----------
    settings : sensors and treatment
    start : first estimate with covariance
    """

    def __init__(self, settings: NavigationSettings, start: Start):
        self.settings = settings
        self.layout = settings.layout
        n = self.layout.n
        if start.P.shape != (n, n):
            raise ValueError(f"covariance {start.P.shape}: wanted {(n, n)}")
        self.P = start.P.copy()
        self.estimate = start.estimate
        self.rejections = 0
        self._doubts, self._doubted_s = 0, -np.inf
        self._gates: dict[int, float] = {}
        self._wander = _wander_e(settings, start.estimate.state.r_e) if self.layout.with_wander else np.zeros((3, 3))

    @property
    def memory(self) -> tuple[int, int, float]:
        """What the filter remembers besides estimate and covariance."""
        return self.rejections, self._doubts, self._doubted_s

    def set(self, estimate: Estimate, P: Array, memory: tuple[int, int, float]) -> None:
        """Go back to an earlier estimate."""
        self.estimate, self.P = estimate, P
        self.rejections, self._doubts, self._doubted_s = memory

    def predict(self, block: IncrementBlock, gyro_ref: Array, accel_ref: Array) -> Array:
        """Over a block that was integrated with given sensor errors taken off; returns the transition matrix (n, n)."""
        e = self.estimate
        gyro, accel = e.gyro, e.accel
        R, v, p = block.for_errors(gyro - gyro_ref, accel - accel_ref)
        F, Q, decay = self.transition(e.state, block)
        new = propagate(e.state, block.duration_s, R, v, p)
        gyro, accel = gyro.copy(), accel.copy()
        gyro[:3] *= decay
        accel[:3] *= decay
        self.P = F @ self.P @ F.T + Q
        w = self.layout.wander
        wander = F[w, w] @ e.wander_e if self.layout.with_wander else e.wander_e
        self.estimate = Estimate(e.time_s + block.duration_s, new, gyro, accel, e.lever_arm_b, wander)
        return F

    def transition(self, state: State, block: IncrementBlock) -> tuple[Array, Array, float]:
        """Transition matrix (n, n), process noise (n, n) and what is left of a bias after a block."""
        g, lay = self.settings.grade, self.layout
        T = block.duration_s
        F = np.eye(lay.n)
        m = 9 + 2 * lay.k
        F[:m, :m] = transition(state, block)
        decay = float(np.exp(-T / g.bias_time_s))
        Q = np.zeros((lay.n, lay.n))
        Q[:9, :9] = process_noise(state, block, g.gyro_noise**2, g.accel_noise**2)
        for first, sigma in ((lay.gyro.start, g.gyro_bias), (lay.accel.start, g.accel_bias)):
            i = np.arange(first, first + 3)
            F[i, i] = decay
            Q[i, i] = sigma**2 * -np.expm1(-2.0 * T / g.bias_time_s)
        if lay.with_wander:
            F2, Q2, _ = second_order_gauss_markov(1.0, self.settings.wander_time_s, T)
            F[lay.wander, lay.wander] = _kron(F2, np.eye(3))
            Q[lay.wander, lay.wander] = _kron(Q2, self._wander)
        return F, Q, decay

    def update(self, observation: Observation, *, use: bool = True) -> tuple[Innovation, Array]:
        """With an observation at the time of the estimate.

        Returns
        -------
        innovation : what it said, and what became of it
        x : (n,) errors that were put into the estimate
        """
        y, H, R = observation.linearise(self.estimate, self.layout)
        P = self.P
        PHt = P @ H.T
        S = H @ PHt + R
        nis = float(y @ np.linalg.solve(S, y))
        gate = self._gate(len(y))
        status, restored = "used", False
        if not use:
            status = "held out"
        elif nis > gate * self.settings.hard_gate and observation.gated:
            self.rejections += 1
            restored = self.rejections >= self.settings.restore_after
            status = "restored" if restored else "rejected"
        elif nis > gate and observation.gated:
            status = "weighted"
        sigma = np.sqrt(np.diag(S))
        if observation.axes is not None:  # shown in the observation's own axes
            sigma = np.sqrt(np.einsum("ij,jk,ik->i", observation.axes, S, observation.axes))
            shown = observation.axes @ y
        else:
            shown = y
        record = Innovation(self.estimate.time_s, observation.kind, shown, sigma, nis, status)
        if status in ("held out", "rejected"):
            return record, np.zeros(self.layout.n)
        if restored:
            P = P + self._doubt(y, H, nis)
            PHt = P @ H.T
        elif status == "weighted":
            R = R + (nis / gate - 1.0) * S  # brings the innovation to the gate
        self.rejections = 0
        # Joseph's form; filterpy does the same, and keeps copies of all that it meets, which takes twice as long
        K = PHt @ np.linalg.inv(H @ PHt + R)
        x = K @ y
        left = np.eye(self.layout.n) - K @ H
        P = left @ P @ left.T + K @ R @ K.T
        self.P = 0.5 * (P + P.T)
        self.estimate = self.estimate.corrected(x, self.layout)
        return record, x

    def _doubt(self, y: Array, H: Array, nis: float) -> Array:
        """What is added to the covariance when the filter disagrees with several observations in a row.

        First position and velocity are let go by as much as is missing, which covers a jump of GNSS. If that has not
        helped, the whole covariance grows.
        """
        self._doubts = self._doubts + 1 if self.estimate.time_s < self._doubted_s + 30.0 else 1
        self._doubted_s = self.estimate.time_s
        if self._doubts > 2:
            return self.P * (nis / len(y))
        out = np.zeros_like(self.P)
        for part in (POSITION, VELOCITY):
            if H[:, part].any():
                out[part, part] = np.eye(3) * float(y @ y)
        return out

    def _gate(self, m: int) -> float:
        if m not in self._gates:
            self._gates[m] = float(chi2.isf(self.settings.soft_gate, m))
        return self._gates[m]
