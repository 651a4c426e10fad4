"""On-line navigation: the filter and smoother of a recording, fed sample by sample.

Inertial samples are integrated in short spans, each ends with a pose; a `NavigationChain` carries the filter over
them and takes in fixes where they belong, however late they come. Only the stream decides what is computed: a replay
gives the same poses as the live run.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..geometry.frames import LocalFrame
from .alignment import AttitudePrior
from .carried import CameraMount, NavigationStates, passed_over
from .chain import NavigationChain
from .error_state import Innovation, NavigationSettings, Start
from .gnss_fix import local_fix
from .inertial_data import GAP_FACTOR, GnssData, InertialData
from .online_alignment import Aligned, AlignmentBuffer, GnssWatch
from .online_poses import OnlineOptions, PoseMaker
from .pose import NavigationEvent, NavigationPose
from .refused_positions import RefusedPositions
from .strapdown import State

Array = NDArray[np.floating]
Vector = tuple[float, float, float]
#: A sample that waits: its end, length, angle and velocity increments, additional noise; plain numbers, because they
#: come by the thousand and are worked on together.
Sample = tuple[float, float, float, float, float, float, float, float, float, float]


class InertialNavigator:
    """Navigation engine for raw inertial data and GNSS.

    Parameters
    ----------
    frame : local frame of the poses
    settings : sensors and treatment
    mount : of the camera
    options : how it answers
    prior : attitude at the first sample, where known
    """

    def __init__(
        self,
        frame: LocalFrame,
        settings: NavigationSettings,
        mount: CameraMount | None = None,
        options: OnlineOptions | None = None,
        prior: AttitudePrior | None = None,
    ):
        self.frame, self.settings, self.options = frame, settings, options or OnlineOptions()
        self._maker = PoseMaker(frame, mount or CameraMount(), self.options)
        self.counters: Counter[str] = Counter()
        self._watch_gnss = GnssWatch()
        self._events: list[NavigationEvent] = []
        self._last_s = -np.inf  # stamp of the last inertial sample
        self._previous: tuple[Vector, Vector, float] | None = None  # sample before the open ones
        self._published = -np.inf
        self._published_smooth = -np.inf
        self._replaying = False
        self._forget(prior)

    def _forget(self, prior: AttitudePrior | None = None) -> None:
        """Back to the alignment."""
        self._chain: NavigationChain | None = None
        self._alignment = AlignmentBuffer(self.settings, self.options, prior)
        self._waiting: list[tuple[float, GnssData]] = []
        self._open: list[Sample] = []
        self._ends: list[int] = []  # of chunks among the open ones
        self._next_pose = self._next_answer = -np.inf
        self._next_smooth = -np.inf
        self._restored: list[float] = []
        self._refused = RefusedPositions()
        self._pose_due = False
        self._ahead: tuple[NavigationStates, Array] | None = None  # what the last smoothing said of later times

    @property
    def status(self) -> str:
        return self._alignment.status if self._chain is None else "navigating"

    @property
    def aligned(self) -> bool:
        return self._chain is not None

    @property
    def alarm(self) -> str:
        """What is wrong with GNSS at present; "" if nothing is."""
        return self._refused.alarm

    @property
    def innovations(self) -> list[Innovation]:
        """Of the observations that may still change."""
        return [i for node in (self._chain.nodes if self._chain else []) for i in node.innovations]

    # ------------------------------------------------------------------------------------------------ inertial data

    def add_inertial(
        self, time_s: float, interval_s: float, force: Iterable[float], rate: Iterable[float]
    ) -> list[NavigationPose]:
        """Mean specific force (m/s^2) and angular rate (rad/s), body axes, over the interval that ends at a time.

        The interval may be nominal: where no sample is missing it lasts from the time of the one before, whose clock
        is better than what a data sheet says of the rate.

        Raises
        ------
        ValueError : values that are not finite, or an interval that is not positive
        """
        fx, fy, fz = force
        wx, wy, wz = rate
        step = time_s - self._last_s  # infinite for the first
        t = step if 0.0 < step <= GAP_FACTOR * interval_s else interval_s
        return self.add_increments(time_s, t, (fx * t, fy * t, fz * t), (wx * t, wy * t, wz * t))

    def add_increments(
        self, time_s: float, interval_s: float, dv: Iterable[float], dtheta: Iterable[float]
    ) -> list[NavigationPose]:
        """Velocity (m/s) and angle (rad) increments, body axes, over the interval that ends at a time."""
        vx, vy, vz = map(float, dv)
        ax, ay, az = map(float, dtheta)
        if not (interval_s > 0.0 and math.isfinite(time_s + vx + vy + vz + ax + ay + az)):
            raise ValueError(f"inertial sample at {time_s} s over {interval_s} s is not finite")
        if time_s <= self._last_s:
            self.counters["inertial out of order"] += 1
            return []
        poses: list[NavigationPose] = []
        gap = time_s - interval_s - self._last_s
        step = time_s - self._last_s
        begun = self._last_s > -math.inf
        if begun and step > GAP_FACTOR * interval_s:
            self.counters["inertial gap"] += 1
            if gap > self.settings.longest_gap_s:
                self._event(time_s, f"inertial data missing for {gap:.1f} s: aligning anew")
                self.counters["aligned anew"] += 1
                self._forget()
                self._previous = None
            else:
                poses += self._bridge(time_s, interval_s, (vx, vy, vz), (ax, ay, az))
        elif begun:
            interval_s = step  # stamps are better than the nominal interval
        if said := self._watch_gnss.inertial(time_s):
            self.counters["gnss outage"] += 1
            self._event(time_s, said if self.aligned else f"{said}: the alignment waits for it")
        poses += self._sample((time_s, interval_s, ax, ay, az, vx, vy, vz, 0.0, 0.0))
        return poses

    def add_attitude(self, time_s: float, rpy: ArrayLike, covariance: ArrayLike) -> list[NavigationPose]:
        """Attitude of another system is not used beside raw inertial data; it is counted."""
        self.counters["attitude not used"] += 1
        return []

    def _bridge(self, time_s: float, interval_s: float, v: Vector, th: Vector) -> list[NavigationPose]:
        before = self._newest()
        if before is None:
            return []
        zero = np.zeros(2)
        pair = InertialData(
            np.array([self._last_s, time_s]),
            np.array([before[2], interval_s]),
            np.array([before[0], th]),
            np.array([before[1], v]),
            zero,
            zero,
        ).bridged(self.settings.gap_rate_sigma, self.settings.gap_force_sigma)
        poses: list[NavigationPose] = []
        for sample in _samples(pair)[1:-1]:
            poses += self._sample(sample)
        return poses

    def _newest(self) -> tuple[Vector, Vector, float] | None:
        return _increments(self._open[-1]) if self._open else self._previous

    def _sample(self, sample: Sample) -> list[NavigationPose]:
        time_s = self._last_s = sample[0]
        self._open.append(sample)
        step = self.options.pose_step_s
        if time_s < self._next_pose - 1e-6 and not self._pose_due:
            return []
        self._next_pose = (math.floor(time_s / step + 1e-6) + 1.0) * step
        if time_s < self._next_answer - 1e-6:
            self._ends.append(len(self._open))
            return []
        # an answer can wait for the fix that belongs to it, which may be a little late
        self._next_answer = time_s + 2.0 * self.options.filtered_s
        return self._close_chunk()

    def _close_chunk(self, answer: bool = True, to_s: float = np.inf) -> list[NavigationPose]:
        """Integrate the open samples (up to the one that a time lies in), take in fixes that waited for them, and
        answer."""
        n = len(self._open)
        while n > 1 and self._open[n - 2][0] > to_s - 1e-7:
            n -= 1
        if not n:
            return []
        closed, self._open = self._open[:n], self._open[n:]
        table, newest = np.array(closed), _increments(closed[-1])
        raw = InertialData(table[:, 0], table[:, 1], table[:, 2:5], table[:, 5:8], table[:, 8], table[:, 9])
        ends = [*(end for end in self._ends if end < n), n]
        self._ends = [end - n for end in self._ends if end > n]
        if self._chain is None:
            self._alignment.append(raw)
            self._previous = newest
            return []
        pieces = raw.corrected(self._previous)
        self._previous = newest
        if len(ends) == 1:
            self._chain.append(pieces)
        else:
            self._chain.extend(pieces, ends)
        reach = self._chain.end_s
        ready = [w for w in self._waiting if w[0] <= reach]
        self._waiting = [w for w in self._waiting if w[0] > reach]
        for time_s, fix in ready:
            if self._chain is None:  # the fix before it made the navigator align anew
                self._alignment.add_fix(time_s, fix)
            else:
                self._insert(time_s, fix)
        self._pose_due = False
        if self._chain is None or self._replaying or not answer:
            return []
        return [*self._filtered(), *self._smoothed(self.options.lag_s)]

    # ---------------------------------------------------------------------------------------------------------- GNSS

    def add_gnss(
        self,
        time_s: float,
        antenna_l: ArrayLike,
        covariance: ArrayLike,
        velocity_l: ArrayLike | None = None,
        velocity_covariance: ArrayLike | None = None,
    ) -> list[NavigationPose]:
        """A fix of the antenna, in the local frame, with covariance (3, 3); on request its velocity.

        Raises
        ------
        ValueError : values that are not finite, or a covariance that is not positive definite
        """
        return self.add_fix(local_fix(self.frame, time_s, antenna_l, covariance, velocity_l, velocity_covariance))

    def add_fix(self, fix: GnssData) -> list[NavigationPose]:
        """One fix of the antenna, as `local_fix` makes it; times in seconds as those of inertial data."""
        time_s = float(fix.time_s[0])
        if time_s < self._last_s - self.options.rewind_s:
            self.counters["gnss too late"] += 1
            return []
        if said := self._watch_gnss.fix(time_s):
            self._event(time_s, said)
        if self._chain is None:
            if not self._alignment.add_fix(time_s, fix):
                self.counters["gnss duplicate"] += 1
                return []
            return self._align(time_s)
        if any(abs(time_s - w) < 1e-6 for w, _ in self._waiting):
            self.counters["gnss duplicate"] += 1
            return []
        if time_s > self._last_s:
            self._waiting.append((time_s, fix))
            self._waiting.sort(key=lambda f: f[0])
            return []
        together = self.options.filtered_s > 0.0
        # smoothing can wait for the next sample, the fix cannot; where answers are rare, a chunk ends with the fix
        self._close_chunk(answer=False, to_s=time_s if together else np.inf)
        if self._chain is None or not self._insert(time_s, fix) or self._chain is None:
            return []
        poses = self._filtered()
        if together:
            self._next_answer = self._last_s + 2.0 * self.options.filtered_s
            return [*poses, *self._smoothed(self.options.lag_s)]
        # if no sample has come since the last pose, the next one brings the fix out
        self._pose_due = not poses
        return poses

    def _insert(self, time_s: float, fix: GnssData) -> bool:
        """Take a fix into the chain; whether it was of use."""
        assert self._chain is not None
        wrong = self._chain.insert(time_s, fix)
        if wrong:
            self.counters[f"gnss {wrong}"] += 1
            return False
        self._watch()
        if self._chain is None or self._replaying:
            return True
        of_fix = [i for i in self.innovations if i.kind == "position" and abs(i.time_s - time_s) < 1e-6]
        for text in filter(None, map(self._refused.take, of_fix)):
            self.counters["gnss contradicts inertial data"] += 1
            self._event(time_s, text)
        return True

    def _watch(self) -> None:
        """Align anew where the filter had to be restored again and again."""
        if self._replaying or self._chain is None:
            return
        for i in self.innovations:
            if i.status == "restored" and i.time_s not in self._restored:
                self._restored.append(i.time_s)
                self._event(i.time_s, f"filter and GNSS {i.kind} disagreed for long: covariance enlarged")
        now = self._chain.end_s
        self._restored = [t for t in self._restored if t > now - 60.0]
        if len(self._restored) >= 4:
            self._event(now, "filter and GNSS keep disagreeing: aligning anew")
            self.counters["aligned anew"] += 1
            self._forget()

    # ----------------------------------------------------------------------------------------------------- alignment

    def _align(self, time_s: float) -> list[NavigationPose]:
        if self._open:
            self._close_chunk()
        found, remarks = self._alignment.attempt(self._last_s)
        for text in [*remarks, *(found.remarks if found else [])]:
            self.counters["data suspicious"] += 1
            self._event(time_s, text)
        if found is None:
            return self._unaligned(time_s)
        text = f"aligned {found.start.how} after {found.seen_s:.0f} s"
        self._begin(found)
        self._event(time_s, "; ".join([text, *found.start.notes]))
        return self._filtered()

    def _begin(self, found: Aligned) -> None:
        """Start the filter at the beginning of the kept data and take it to the present."""
        start, raw = found.start, found.raw
        self._chain = NavigationChain(self.settings, Start(start.estimate, start.P), self.options.step_s)
        self._previous, self._waiting, self._replaying = None, list(found.fixes), True
        self._next_pose = self._next_answer = -np.inf
        end = self._last_s
        for sample in _samples(raw):
            self._sample(sample)
        self._close_chunk()
        self._last_s, self._replaying = end, False
        self._waiting = list(found.ahead)
        self._next_smooth = end + self.options.smooth_every_s
        self._published_smooth = max(self._published_smooth, start.estimate.time_s)
        self._alignment = AlignmentBuffer(self.settings, self.options, None)  # lets the kept data go

    def _unaligned(self, time_s: float) -> list[NavigationPose]:
        """A pose that is not valid, at the newest fix."""
        if time_s <= self._published or not self._alignment.fixes:
            return []
        self._published = time_s
        arm = float(np.linalg.norm(self.settings.lever_arm_b))
        return [self._maker.unaligned(time_s, self._alignment.fixes[-1][1], arm, self.status)]

    # --------------------------------------------------------------------------------------------------------- poses

    def _filtered(self) -> list[NavigationPose]:
        """Pose at the end of the inertial data."""
        assert self._chain is not None
        if self._chain.end_s < self._published + self.options.filtered_s - 1e-6:
            return []
        time_s, state, P = self._chain.tip()
        if time_s <= self._published:
            return []
        self._published = time_s
        th, _, dt_s = self._previous or ((0.0, 0.0, 0.0), None, 1.0)
        return self._maker.poses(_states([time_s], [state]), P[None, :9, :9], np.array([th]) / dt_s, smoothed=False)

    def _smoothed(self, lag_s: float) -> list[NavigationPose]:
        """Poses that have become old enough."""
        chain, o = self._chain, self.options
        assert chain is not None
        end = chain.nodes[-1].time_s
        until = end - lag_s
        if (end < self._next_smooth - 1e-9 and lag_s > 0.0) or len(chain.nodes) < 3 or until <= self._published_smooth:
            return []
        self._next_smooth = end + o.smooth_every_s
        trajectory = chain.smoothed()
        ends = trajectory.sample_times
        rows = np.flatnonzero((ends > self._published_smooth + 1e-9) & (ends <= until + 1e-9))
        poses: list[NavigationPose] = []
        if len(rows):
            states = trajectory.at_rows(rows)
            P = trajectory.covariance(states.time_s)
            if self._ahead is not None:
                states, P = passed_over(*self._ahead, states, P, self._published_smooth, o.smooth_every_s)
            later = trajectory.at_rows(np.flatnonzero((ends > until + 1e-9) & (ends <= until + o.smooth_every_s + 0.1)))
            self._ahead = later, trajectory.covariance(later.time_s)
            poses = self._maker.poses(states, P, trajectory.rates(states.time_s), smoothed=True)
            self._published_smooth = float(ends[rows[-1]])
        chain.forget(min(self._published_smooth, end - o.rewind_s) - 2.0 * o.step_s)
        return poses

    def finish(self) -> list[NavigationPose]:
        """The stream has ended: what the smoother still holds."""
        if self._chain is None:
            return []
        poses = self._close_chunk()
        self._chain.close()
        return [*poses, *self._smoothed(0.0)]

    @property
    def has_events(self) -> bool:
        """Whether `take_events` would return some."""
        return bool(self._events)

    def take_events(self) -> list[NavigationEvent]:
        """Events since the last call."""
        events, self._events = self._events, []
        return events

    def _event(self, time_s: float, text: str) -> None:
        self._events.append(NavigationEvent(time_s, text))


def _increments(sample: Sample) -> tuple[Vector, Vector, float]:
    """Angle and velocity increments of a sample, and its length."""
    return sample[2:5], sample[5:8], sample[1]


def _samples(data: InertialData) -> list[Sample]:
    columns = (data.time_s, data.dt_s, data.dtheta, data.dv, data.gyro_psd, data.accel_psd)
    return [tuple(row) for row in np.column_stack(columns).tolist()]


def _states(time_s: list[float], states: list[State]) -> NavigationStates:
    return NavigationStates(
        np.array(time_s),
        np.array([s.r_e for s in states]),
        np.array([s.v_e for s in states]),
        np.array([s.R_eb for s in states]),
    )
