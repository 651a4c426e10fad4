"""The measured trajectory as it arrives: filtered at once, smoothed a little later, both interpolated the same way."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .rotation import quaternion_conjugate, quaternion_multiply, vector_from_quaternion
from .trajectory import Poses, Trajectory, noise_between, sample_before, slopes

Array = NDArray[np.floating]

#: Poses farther apart, s, have a gap between them on line, in which there is no orientation. Tuned: poses that come
#: less often do not tell how the platform moves in turbulence.
POSE_GAP_S = 0.2
#: Smoothed poses are waited for so long, s, after the time they belong to: longer than a smoother lags behind, and than
#: a filter that has aligned itself in motion reaches back to its first data. Tuned: a shorter one makes orientation
#: final on filtered poses, a longer one only delays what a gap in the data has spoilt anyway.
SMOOTHED_LATE_S = 12.0
#: So many samples tell how far the motion strays from a parabola. Tuned: enough for a mean, few enough for turbulence
#: that begins.
LIVELY_SAMPLES = 64
#: Mean square of the change of a slope by its next sample that white noise of 1 makes: a third difference has 20 times
#: its variance, and half of it counts.
_SLOPE_NOISE = 5.0


class GrowingTrajectory(Trajectory):
    """A trajectory to which samples are added, and whose old ones are dropped, at constant cost per sample.

    Slopes of new samples are computed when a pose is asked for: samples come one by one and poses are asked for less
    often, and twenty slopes take hardly longer than one.
    """

    def __init__(self) -> None:
        self._size = self._start = self._sloped = 0
        self._buffer: dict[str, Array] = {
            "time_s": np.empty(64),
            "position_l": np.empty((64, 3)),
            "quaternion": np.empty((64, 4)),
            "_turn": np.empty((64, 3)),
            "_velocity": np.empty((64, 3)),
            "_rate": np.empty((64, 3)),
            "covariance": np.empty((64, 6, 6)),
        }
        self._view()

    def _view(self) -> None:
        part = slice(self._start, self._size)
        self.time_s, self.position_l = self._buffer["time_s"][part], self._buffer["position_l"][part]
        self.quaternion, self.covariance = self._buffer["quaternion"][part], self._buffer["covariance"][part]
        self._velocity, self._rate = self._buffer["_velocity"][part], self._buffer["_rate"][part]
        self._turn = self._buffer["_turn"][self._start : max(self._size - 1, self._start)]

    def append(self, time_s: Array, position_l: Array, quaternion: Array, covariance: Array) -> None:
        """Add n samples after the last one; times increase."""
        n = len(time_s)
        if self._size + n > len(self._buffer["time_s"]):
            self._make_room(n)
        new = slice(self._size, self._size + n)
        b = self._buffer
        b["time_s"][new], b["position_l"][new], b["covariance"][new] = time_s, position_l, covariance
        b["quaternion"][new] = quaternion / np.linalg.norm(quaternion, axis=1, keepdims=True)
        self._size += n
        self._view()

    def at(self, time_s: ArrayLike) -> Poses:
        self._slope()
        return super().at(time_s)

    def angles_at(self, time_s: ArrayLike) -> Array:
        self._slope()
        return super().angles_at(time_s)

    def _slope(self) -> None:
        """Slopes at the samples that have come since the last time."""
        if self._sloped == self._size:
            return
        b = self._buffer
        # the slope at the last sample of before changes with its new neighbour
        first = max(self._sloped - 2, self._start)
        self._sloped = self._size
        q = b["quaternion"][first : self._size]
        if len(q) >= 2:
            turn = vector_from_quaternion(quaternion_multiply(quaternion_conjugate(q[:-1]), q[1:]))
            step = np.diff(b["time_s"][first : self._size])
            velocity = slopes(step, np.diff(b["position_l"][first : self._size], axis=0))
            rate = slopes(step, turn)
            b["_turn"][first : self._size - 1] = turn
            keep = first + (1 if first > self._start else 0)
            b["_velocity"][keep : self._size] = velocity[keep - first :]
            b["_rate"][keep : self._size] = rate[keep - first :]
        self._view()

    def open_end(self, time_s: Array) -> Array:
        """Variance (m, 6) of positions and angles behind the last sample but one, m^2 and rad^2; 0 before it.

        There the slope at the last sample is a guess, a parabola through the last three: what it lacks is taken as
        large as it was lately, less what the noise of the samples explains.
        """
        self._slope()
        variance = np.zeros((len(time_s), 6))
        inside = time_s > self.time_s[-2]
        n = min(len(self), LIVELY_SAMPLES)
        if not inside.any() or n < 5:
            return variance
        t, step = self.time_s[-n:], np.diff(self.time_s[-n:])
        change = np.hstack([np.diff(self.position_l[-n:], axis=0), self._turn[-(n - 1) :]])
        slope = slopes(step, change)
        guess = 2.0 * change[1:-1] / step[1:-1, None] - slope[1:-2]  # at samples 2 .. n-2, without the next one
        lacking = np.square(step[1:-1, None] * (slope[2:-1] - guess)).mean(axis=0)
        noise = np.einsum("nii->i", self.covariance[-n:]) / n
        excess = np.maximum(lacking - _SLOPE_NOISE * noise, 0.0)
        s = (time_s[inside] - t[-2]) / step[-1]
        variance[inside] = np.square(s * s * (s - 1.0))[:, None] * excess
        return variance

    def forget(self, before_s: float) -> None:
        """Drop samples older than a time, but for two."""
        self._slope()
        self._start += max(int(np.searchsorted(self.time_s, before_s)) - 2, 0)
        self._view()

    def _make_room(self, n: int) -> None:
        self._slope()
        used = slice(self._start, self._size)
        size = max(2 * (self._size - self._start + n), 64)
        for name, old in self._buffer.items():
            fresh = np.empty((size, *old.shape[1:]))
            fresh[: self._size - self._start] = old[used]
            self._buffer[name] = fresh
        self._start, self._size = 0, self._size - self._start
        self._sloped = self._size


@dataclass(frozen=True)
class MeasuredPoses:
    """Measured orientation at n times.

    Attributes
    ----------
    poses : the orientation
    covariance : (n, 6, 6) of its white noise
    smoothed : (n,) whether from the smoother
    open_end : (n, 6) variance of the interpolation behind the last sample but one, m^2 and rad^2; no noise
    """

    poses: Poses
    covariance: Array
    smoothed: NDArray[np.bool_]
    open_end: Array


class MeasuredTrajectory:
    """Filtered and smoothed poses of one flight, the best of both at any time.

    Parameters
    ----------
    gap_s : samples farther apart than this have a gap between them, in which there is no orientation

    Attributes
    ----------
    noise_time_s : lag at which the noise of smoothed positions is correlated by 1/e, as stated last; 0 = white
    """

    def __init__(self, gap_s: float = POSE_GAP_S):
        self.gap_s = gap_s
        self._filtered, self._smoothed = GrowingTrajectory(), GrowingTrajectory()
        self.noise_time_s = 0.0

    def add(
        self,
        time_s: ArrayLike,
        position_l: ArrayLike,
        quaternion: ArrayLike,
        covariance: ArrayLike,
        smoothed: bool,
        noise_time_s: float = 0.0,
    ) -> int:
        """Add poses (n,) in time order; returns how many came too late or twice and were left out.

        Parameters
        ----------
        covariance : (n, 6, 6) of the noise, slow errors apart
        noise_time_s : lag at which that of smoothed positions is correlated by 1/e; 0 = white
        """
        if smoothed:
            self.noise_time_s = noise_time_s
        target = self._smoothed if smoothed else self._filtered
        t = np.asarray(time_s, dtype=float)
        last = target.end_s if len(target) else -np.inf
        keep = t > np.maximum.accumulate(np.concatenate([[last], t[:-1]]))
        if keep.any():
            target.append(
                t[keep], np.asarray(position_l)[keep], np.asarray(quaternion)[keep], np.asarray(covariance)[keep]
            )
        return int((~keep).sum())

    @property
    def end_s(self) -> float:
        """Newest pose; minus infinity before the second one."""
        ends = [t.end_s for t in (self._filtered, self._smoothed) if len(t) >= 2]
        return max(ends, default=-np.inf)

    @property
    def start_s(self) -> float:
        starts = [t.start_s for t in (self._filtered, self._smoothed) if len(t) >= 2]
        return min(starts, default=np.inf)

    @property
    def smoothed_to_s(self) -> float:
        return self._smoothed.end_s if len(self._smoothed) >= 2 else -np.inf

    def covers(self, time_s: ArrayLike) -> NDArray[np.bool_]:
        """Which times (n,) have an orientation: inside, and not in a gap."""
        t = np.atleast_1d(np.asarray(time_s, dtype=float))
        by_smoothed = self._is_smoothed(t)
        good = np.zeros(len(t), dtype=bool)
        for source, mine in ((self._smoothed, by_smoothed), (self._filtered, ~by_smoothed)):
            if len(source) < 2 or not mine.any():
                continue
            i = sample_before(source.time_s, t[mine])
            step = source.time_s[i + 1] - source.time_s[i]
            good[mine] = source.covers(t[mine]) & (step <= self.gap_s)
        return good

    def _is_smoothed(self, t: Array) -> NDArray[np.bool_]:
        """Which times (n,) lie between smoothed samples; those in a gap of them do not (a smoother that was killed)."""
        if len(self._smoothed) < 2:
            return np.zeros(len(t), dtype=bool)
        times = self._smoothed.time_s
        i = sample_before(times, t)
        near = (times[i + 1] - times[i] <= self.gap_s) | (t == times[i])
        return near & (t >= self._smoothed.start_s) & (t <= self._smoothed.end_s)

    def _only(self, by_smoothed: NDArray[np.bool_]) -> GrowingTrajectory | None:
        """The samples that all times hang on, if these are either smoothed or filtered."""
        if not len(by_smoothed) or by_smoothed.any() != by_smoothed.all():
            return None
        source = self._smoothed if by_smoothed[0] else self._filtered
        return source if len(source) >= 2 else None

    def at(self, time_s: ArrayLike) -> MeasuredPoses:
        """Orientation at times (n,) that are covered.

        Raises
        ------
        ValueError : a time outside
        """
        t = np.atleast_1d(np.asarray(time_s, dtype=float))
        by_smoothed = self._is_smoothed(t)
        if (source := self._only(by_smoothed)) is not None:
            covariance = noise_between(source.time_s, source.covariance, t)
            return MeasuredPoses(source.at(t), covariance, by_smoothed, source.open_end(t))
        values = np.empty((4, len(t), 3))
        covariance, open_end = np.empty((len(t), 6, 6)), np.zeros((len(t), 6))
        for source, mine in ((self._smoothed, by_smoothed), (self._filtered, ~by_smoothed)):
            if not mine.any():
                continue
            if len(source) < 2:
                raise ValueError("no orientation yet")
            p = source.at(t[mine])
            values[:, mine] = p.position_l, p.angles, p.velocity_l, p.angle_rate
            covariance[mine] = noise_between(source.time_s, source.covariance, t[mine])
            open_end[mine] = source.open_end(t[mine])
        return MeasuredPoses(Poses(t, *values), covariance, by_smoothed, open_end)

    def angles_at(self, time_s: ArrayLike) -> Array:
        """Omega, phi, kappa (n, 3) at times (n,) that are covered."""
        t = np.atleast_1d(np.asarray(time_s, dtype=float))
        by_smoothed = self._is_smoothed(t)
        if (source := self._only(by_smoothed)) is not None:
            return source.angles_at(t)
        angles = np.empty((len(t), 3))
        for source, mine in ((self._smoothed, by_smoothed), (self._filtered, ~by_smoothed)):
            if mine.any():
                angles[mine] = source.angles_at(t[mine])
        return angles

    def forget(self, before_s: float) -> None:
        """Drop what is older."""
        for trajectory in (self._filtered, self._smoothed):
            if len(trajectory):
                trajectory.forget(before_s)
