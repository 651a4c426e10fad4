"""Kinematic filter: pose of the camera from measured attitude and GNSS positions, at once and after a fixed lag.

Position: white noise jerk on position, velocity and acceleration of the perspective centre, beside it the slow error of
the GNSS positions as second-order Gauss-Markov states, which fixes cannot tell from motion and which therefore stand in
the covariance as they should. Attitude: the measured samples as they are; smoothing them would bend real motion.

Fixed-lag smoothing is Rauch-Tung-Striebel over the epochs of the lag. Source: Bar-Shalom et al.,
Estimation with Applications to Tracking and Navigation, 2001, sections 5.4, 6.2, 8.6.
"""

from __future__ import annotations

from bisect import bisect_left
from collections import Counter, deque
from dataclasses import dataclass
from functools import cached_property
from statistics import median
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..geometry.frames import LocalFrame, opk_covariance_from_navigation
from ..geometry.rotation import angles_from_matrix, matrix_from_navigation, quaternion_from_matrix
from ..models.gauss_markov import second_order_gauss_markov
from .kalman_filter import kalman_filter
from .kinematic_model import N_STATES, WD, A, KinematicOptions, P, V, W, noise_time, quintic, transition
from .pose import AttitudeHistory, NavigationEvent, NavigationPose, PoseMaker

Array = NDArray[np.floating]


@dataclass
class _Epoch:
    """A fix (or, while coasting, a time without one) and the filter's state after it."""

    time_s: float
    z: Array | None
    R: Array | None
    x: Array
    P: Array
    F: Array
    Q: Array
    accepted: bool


#: Steps between attitude samples whose median is the usual one. Tuned: a gap among them does not matter, a rate that
#: changes is soon the usual one.
USUAL_STEPS = 9
#: While coasting, an epoch without a fix is put in after this time, s, so that the smoother has states to lean on.
COAST_STEP_S = 0.5
#: Times after an epoch for which the position covariance is computed, s; linear between them. Tuned.
_AHEAD_S = np.array([0.0, 0.1, 0.2, 0.35, 0.55])


class KinematicFilter:
    """Attitude and GNSS in, poses of the camera out.

    An engine of the navigator: `add_attitude`, `add_gnss` and `finish` return the poses that follow, filtered ones at
    each attitude sample, smoothed ones after the lag. Times are seconds from any reference, the same for all.

    Attributes
    ----------
    counters : what was wrong with the data, by kind
    """

    def __init__(self, frame: LocalFrame, options: KinematicOptions):
        self.options = options
        self.frame = frame
        self.counters: Counter[str] = Counter()
        self._events: list[NavigationEvent] = []
        self._attitude = AttitudeHistory()
        self._steps_s: deque[float] = deque(maxlen=USUAL_STEPS)
        self._maker = PoseMaker(frame, options.R_bc, options.attitude_sigma)
        self._epochs: list[_Epoch] = []
        self._pending: list[tuple[float, Array, Array]] = []
        self._H = np.zeros((3, N_STATES))
        self._H[:, P] = self._H[:, W] = np.eye(3)
        self._last_fix_s = -np.inf
        self._gap_from_s = self._bridged_at_s = -np.inf
        self._refused = 0
        self._smoothed_to = self._next_filtered_s = -np.inf
        self._transitions: dict[int, tuple[Array, Array]] = {}
        self._ahead_cov = np.zeros((len(_AHEAD_S), 3, 3))
        self._ahead_white_m = np.zeros(len(_AHEAD_S))  # without the slow errors
        self._offset_cov = np.diag(np.square(np.broadcast_to(options.offset_sigma_m, 3)))
        self._attitude_cov = np.diag(np.square(np.broadcast_to(options.attitude_sigma, 3)))
        self._coasting = False

    @cached_property
    def _kf(self) -> Any:
        """The filter; made with the first fix, since a navigator with inertial data makes none."""
        kf = kalman_filter()(dim_x=N_STATES, dim_z=3)
        kf.x = np.zeros(N_STATES)
        return kf

    @cached_property
    def _ahead(self) -> tuple[Array, Array, Array, Array]:
        """What takes the covariance of an epoch to the times after it: of the position (n, 3, 15) and the noise that
        comes to it (n, 3, 3), and both without the slow errors."""
        steps = [self._transition(float(dt)) for dt in _AHEAD_S]
        F, Q = np.stack([F for F, _ in steps]), np.stack([Q for _, Q in steps])
        return F[:, P], Q[:, P, P], self._H @ F, self._H @ Q @ self._H.T

    # -- input ---------------------------------------------------------------------------------------------------------

    def add_attitude(self, time_s: float, rpy: ArrayLike, covariance: ArrayLike) -> list[NavigationPose]:
        """One attitude sample: roll, pitch, heading (3,) in radians with covariance (3, 3).

        Returns the filtered pose at its time (none before the first fix, or if one has just been) and smoothed poses
        that fell due.
        """
        rpy = np.asarray(rpy, dtype=float)
        last = self._attitude.last_s
        if time_s <= last:
            self.counters["attitude duplicate" if time_s == last else "attitude out of order"] += 1
            return []
        if last > -np.inf:
            if self._is_gap(time_s - last):
                self.counters["attitude gap"] += 1
                self._event(time_s, f"attitude gap of {time_s - last:.2f} s")
            self._steps_s.append(time_s - last)
        left: list[NavigationPose] = []
        if time_s - last > self.options.coast_limit_s and last > -np.inf:
            left = self._start_anew(time_s)
        self._attitude.append(time_s, rpy, np.asarray(covariance, dtype=float))
        poses = left
        while self._pending and self._pending[0][0] <= time_s:
            poses += self._take_fix(*self._pending.pop(0))
        if not self._epochs:
            self._attitude.forget(time_s - self.options.lateness_s)
            return poses
        while time_s - self._epochs[-1].time_s > COAST_STEP_S:
            poses += self._coast(self._epochs[-1].time_s + COAST_STEP_S)
        if time_s >= self._next_filtered_s:
            self._next_filtered_s = time_s + self.options.filtered_s - 1e-6
            poses.append(self._filtered(time_s, rpy))
        return poses

    def _is_gap(self, step_s: float) -> bool:
        """Whether a step between two attitude samples is longer than a usual one; of the first ones nobody knows."""
        if step_s <= self.options.attitude_gap_s or len(self._steps_s) < USUAL_STEPS:
            return False
        return step_s > 1.5 * median(self._steps_s)

    def add_gnss(self, time_s: float, antenna_l: ArrayLike, covariance: ArrayLike) -> list[NavigationPose]:
        """One GNSS position of the antenna (3,), local frame, with covariance (3, 3); returns smoothed poses due.

        A fix waits for the attitude sample that follows it, since the lever arm needs the attitude at its time.
        """
        fix = (float(time_s), np.asarray(antenna_l, dtype=float), np.asarray(covariance, dtype=float))
        if any(abs(e.time_s - time_s) < 1e-6 and e.z is not None for e in self._epochs) or any(
            abs(p[0] - time_s) < 1e-6 for p in self._pending
        ):
            self.counters["gnss duplicate"] += 1
            return []
        if time_s > self._attitude.last_s:
            self._pending.append(fix)
            self._pending.sort(key=lambda p: p[0])
            return []
        return self._take_fix(*fix)

    def finish(self) -> list[NavigationPose]:
        """Smoothed poses up to the end, with what lag there is."""
        if not self._epochs:
            return []
        if self._attitude.last_s > self._epochs[-1].time_s:
            self._advance(self._attitude.last_s, None, None, judge=False)
        return self._smooth(np.inf)

    @property
    def has_events(self) -> bool:
        """Whether `take_events` would return some."""
        return bool(self._events)

    def take_events(self) -> list[NavigationEvent]:
        """What happened since the last call, for the log."""
        events, self._events = self._events, []
        return events

    # -- filter --------------------------------------------------------------------------------------------------------

    def _take_fix(self, time_s: float, antenna_l: Array, R: Array) -> list[NavigationPose]:
        if not self._attitude.covers(time_s):
            self.counters["gnss without attitude"] += 1
            return []
        z = antenna_l - self._maker.R_lb(antenna_l, self._attitude.at(time_s)) @ self.options.lever_arm_b
        if not self._epochs:
            self._start(time_s, z, R)
            return []
        if time_s < self._epochs[0].time_s or time_s < self._epochs[-1].time_s - self.options.lateness_s:
            self.counters["gnss too late"] += 1
            return []
        times = [e.time_s for e in self._epochs]
        place = bisect_left(times, time_s - 1e-6)
        late = place < len(times)
        if late:
            self.counters["gnss late"] += 1
        after = self._epochs[place:]
        if after and abs(after[0].time_s - time_s) < 1e-6:  # an epoch without a fix stood here
            after = after[1:]
        del self._epochs[place:]
        if not self._epochs:
            self._start(time_s, z, R)
        else:
            self._advance(time_s, z, R, judge=True)
        for epoch in after:
            self._advance(epoch.time_s, epoch.z if epoch.accepted else None, epoch.R, judge=False)
        self._look_ahead()
        return self._smooth(self._due(self._epochs[-1].time_s))

    def _coast(self, time_s: float) -> list[NavigationPose]:
        self._advance(time_s, None, None, judge=False)
        self._look_ahead()
        return self._smooth(self._due(time_s))

    def _due(self, now_s: float) -> float:
        """Time up to which the smoothed trajectory is due."""
        o = self.options
        due = now_s - o.lag_s
        if now_s - self._last_fix_s > o.coast_limit_s:
            return min(due, max(self._last_fix_s, now_s - o.hold_s))
        if now_s < self._bridged_at_s:
            return min(due, max(self._gap_from_s, now_s - o.hold_s))
        return due

    def _start(self, time_s: float, z: Array, R: Array) -> None:
        o = self.options
        x, cov = np.zeros(N_STATES), np.zeros((N_STATES, N_STATES))
        x[P] = z
        slow = np.diag(np.square(np.broadcast_to(o.wander_sigma_m, 3)))
        cov[P, P], cov[P, W], cov[W, P], cov[W, W] = R + slow, -slow, -slow, slow
        cov[V, V], cov[A, A] = np.eye(3) * 300.0**2, np.eye(3) * 10.0**2
        rate = second_order_gauss_markov(1.0, o.wander_time_s, 0.0)[2][1, 1]
        cov[WD, WD] = slow * rate
        self._epochs = [_Epoch(time_s, z, R, x, cov, np.eye(N_STATES), np.zeros_like(cov), True)]
        self._last_fix_s = time_s
        self._refused = 0
        self._look_ahead()

    def _advance(self, time_s: float, z: Array | None, R: Array | None, judge: bool) -> None:
        """Predict from the last epoch to a time, update with the fix if it passes, and keep the state."""
        o, kf, last = self.options, self._kf, self._epochs[-1]
        F, Q = self._transition(time_s - last.time_s)
        kf.x, kf.P = last.x, last.P
        kf.predict(F=F, Q=Q)
        accepted = z is not None
        if z is not None and R is not None:
            if judge:
                innovation = z - self._H @ kf.x
                nis = float(innovation @ np.linalg.solve(self._H @ kf.P @ self._H.T + R, innovation))
                if nis > o.hard_gate:
                    accepted = False
                    self.counters["gnss refused"] += 1
                    self._refused += 1
                    size = float(np.linalg.norm(innovation))
                    self._event(time_s, f"GNSS position off by {size:.1f} m refused")
                    if self._refused >= o.patience:
                        self._restart(time_s, z, R, size)
                        return
                elif nis > o.gate:
                    R = R * (nis / o.gate)
                    self.counters["gnss weighted down"] += 1
            if accepted:
                kf.update(z, R=R, H=self._H)
                kf.P = 0.5 * (kf.P + kf.P.T)
                if time_s - self._last_fix_s > o.coast_limit_s:
                    self._gap_from_s, self._bridged_at_s = self._last_fix_s, time_s + o.lag_s
                self._last_fix_s = max(self._last_fix_s, time_s)
                self._refused = 0 if judge else self._refused
        self._epochs.append(_Epoch(time_s, z, R, kf.x.copy(), kf.P.copy(), F, Q, accepted))

    def _start_anew(self, time_s: float) -> list[NavigationPose]:
        """Nothing was measured for long: finish what was, and wait for the next fix."""
        left = self.finish()
        self._epochs = []
        self._attitude = AttitudeHistory()
        self._pending = [fix for fix in self._pending if fix[0] >= time_s]
        self._smoothed_to = -np.inf
        return left

    def _restart(self, time_s: float, z: Array, R: Array, size: float) -> None:
        self.counters["position jump"] += 1
        text = f"GNSS position jumped by {size:.1f} m: wrong is what was before or what follows; filter started again"
        self._event(time_s, text)
        old = self._epochs[-1]
        self._start(time_s, z, R)
        start = self._epochs[0]
        start.x[V], start.x[A] = old.x[V], old.x[A]
        start.P[V, V], start.P[A, A] = np.eye(3) * 25.0, np.eye(3) * 4.0
        self._smoothed_to = time_s
        self._look_ahead()

    def _transition(self, dt: float) -> tuple[Array, Array]:
        key = round(dt * 1e9)
        if key not in self._transitions:
            if len(self._transitions) > 256:
                self._transitions.clear()
            self._transitions[key] = transition(dt, self.options)
        return self._transitions[key]

    def _look_ahead(self) -> None:
        """Covariance of the position at a few times after the newest epoch, and the frame at the platform."""
        last = self._epochs[-1]
        F_P, Q_P, HF, HQH = self._ahead
        self._ahead_cov = F_P @ last.P @ F_P.transpose(0, 2, 1) + Q_P + self._offset_cov
        self._ahead_white_m = np.sqrt((HF @ last.P @ HF.transpose(0, 2, 1) + HQH).trace(axis1=1, axis2=2))
        self._maker.move(last.time_s, last.x[P], last.x[V])
        self._state_scalars = last.x[:9].tolist()

    # -- output --------------------------------------------------------------------------------------------------------

    def _validity(self, time_s: float, sigma_m: float) -> tuple[bool, str]:
        since = time_s - self._last_fix_s
        if since > self.options.coast_limit_s:
            if not self._coasting:
                self._coasting = True
                self.counters["gnss outage"] += 1
                self._event(time_s, f"no GNSS for {since:.1f} s: coasting")
            return False, f"no GNSS for {since:.1f} s"
        if self._coasting:
            self._coasting = False
            self._event(time_s, "GNSS is back")
        if sigma_m > self.options.sigma_limit_m:
            return False, f"filter sigma {sigma_m:.1f} m"
        return True, ""

    def _filtered(self, time_s: float, rpy: Array) -> NavigationPose:
        dt = time_s - self._epochs[-1].time_s
        half = 0.5 * dt * dt
        x, y, z, vx, vy, vz, ax, ay, az = self._state_scalars
        position = np.array([x + vx * dt + ax * half, y + vy * dt + ay * half, z + vz * dt + az * half])
        velocity = np.array([vx + ax * dt, vy + ay * dt, vz + az * dt])
        i = 0
        while i < len(_AHEAD_S) - 2 and dt > _AHEAD_S[i + 1]:
            i += 1
        share = (dt - _AHEAD_S[i]) / (_AHEAD_S[i + 1] - _AHEAD_S[i])
        cov = (1.0 - share) * self._ahead_cov[i] + share * self._ahead_cov[i + 1]
        white_m = (1.0 - share) * self._ahead_white_m[i] + share * self._ahead_white_m[i + 1]
        valid, reason = self._validity(time_s, float(white_m))
        return self._maker.pose(time_s, position, velocity, cov, rpy, self._attitude.covariance, valid, reason)

    def _smooth(self, to_s: float) -> list[NavigationPose]:
        """Smoothed poses of the attitude samples up to a time; epochs and samples no longer needed are dropped."""
        epochs = self._epochs
        to_s = min(to_s, epochs[-1].time_s)
        low, high = self._attitude.between(max(self._smoothed_to, epochs[0].time_s - 1e-9), to_s)
        if high <= low or len(epochs) < 2:
            return []
        times = np.array([e.time_s for e in epochs])
        first = max(int(np.searchsorted(times, self._attitude.time_s[low], side="right")) - 1, 0)
        part = epochs[first:]
        x, cov, _, _ = self._kf.rts_smoother(
            np.array([e.x for e in part]),
            np.array([e.P for e in part]),
            Fs=[e.F for e in part],
            Qs=[e.Q for e in part],
        )
        t, rpy, attitude_cov = self._attitude.part(low, high)
        k = np.clip(np.searchsorted(times[first:], t, side="right") - 1, 0, len(part) - 2)
        step = times[first:][k + 1] - times[first:][k]
        position, velocity = quintic(t - times[first:][k], step, x[k], x[k + 1])
        share = ((t - times[first:][k]) / step)[:, None, None]
        position_cov = (1 - share) * cov[k, P, P] + share * cov[k + 1, P, P]
        position_cov = position_cov + self._offset_cov
        R_ln = self.frame.R_ln(position)
        R_lc = R_ln @ matrix_from_navigation(rpy[:, 0], rpy[:, 1], rpy[:, 2]) @ np.asarray(self.options.R_bc)
        angles = angles_from_matrix(R_lc)
        full = np.zeros((len(t), 6, 6))
        full[:, :3, :3] = position_cov
        full[:, 3:, 3:] = opk_covariance_from_navigation(rpy, R_lc, R_ln, attitude_cov)
        full[:, 3:, 3:] += self._attitude_cov
        white = np.sqrt(np.einsum("kii->k", self._H @ cov @ self._H.T))
        fixes = np.array([e.time_s for e in epochs if e.accepted and e.z is not None])
        near = np.abs(fixes[:, None] - t).min(axis=0) if len(fixes) else np.full(len(t), np.inf)
        valid = (near <= self.options.coast_limit_s) & (
            np.maximum(white[k], white[k + 1]) <= self.options.sigma_limit_m
        )
        quaternion = quaternion_from_matrix(R_lc)
        noise_time_s = self._noise_time(part)
        poses = [
            NavigationPose(
                float(t[i]), position[i], angles[i], quaternion[i], velocity[i], full[i], bool(valid[i]),
                "" if valid[i] else "no GNSS", True, noise_time_s,
            )
            for i in range(len(t))
        ]  # fmt: skip
        self._smoothed_to = float(t[-1])
        keep_s = min(epochs[-1].time_s - self.options.lateness_s - 0.5, self._smoothed_to)
        keep = max(int(np.searchsorted(times, keep_s, side="right")) - 1, 0)
        del epochs[:keep]
        self._attitude.forget(min(self._smoothed_to, epochs[-1].time_s - self.options.lateness_s) - 0.5)
        return poses

    def _noise_time(self, epochs: list[_Epoch]) -> float:
        """Correlation time of the smoothed position where fixes come as in these epochs; 0 if there are too few."""
        variance = [float(e.R.trace()) / 3.0 for e in epochs if e.accepted and e.R is not None]
        if len(variance) < 2:
            return 0.0
        step_s = (epochs[-1].time_s - epochs[0].time_s) / (len(epochs) - 1)
        return noise_time(self.options.jerk_psd, float(np.mean(variance)) * step_s)

    def _event(self, time_s: float, text: str) -> None:
        self._events.append(NavigationEvent(time_s, text))
