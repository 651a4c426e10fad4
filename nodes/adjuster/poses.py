"""What the adjuster keeps of poses: measured ones on their way into the window, refined ones for those who ask."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...solver.camera.line_camera import LineCamera, finest_pixel
from ...solver.geometry.trajectory import Trajectory
from ...solver.models.slow_errors import LEARNT_SHARE, LEAST_NOISE, NOTHING_LEARNT, SlowErrors
from .. import convert

Array = NDArray[np.floating]
Poses = tuple[list[float], Array, Array, Array, bool, float]

#: Of so long, s, each measured pose's validity is remembered, longer than any window; of earlier ones the stretches.
REMEMBERED_S = 300.0
#: Smoothed poses may come so much later than filtered ones, s.
PATIENCE_S = 30.0
#: So many older ones may be kept, until they are forgotten together.
MOST_OLD = 1024
#: Times this near are the same, s.
SAME_TIME_S = 1e-6
#: A pose whose attitude is more uncertain than this, rad, is none: that of a filter which is still aligning.
KNOWN_ATTITUDE_RAD = 0.2
#: A filter that begins needs a fix before its poses are valid. For so long, s, its first poses do not say how good the
#: trajectory of a strip is. Tuned: a few fixes at 1 Hz; longer only delays strips that have no GNSS at all.
FIRST_FIX_S = 3.0
#: So many statements about slow errors are remembered.
MOST_STATED = 200
#: Refined orientation is kept this long for queries, s.
KEPT_S = 600.0


#: No attitude has less white noise than this share of a pixel. Derived: with an image sigma of a third of a pixel it
#: takes part with a thousandth.
LEAST_NOISE_PX = 0.01


def least_noise(camera: LineCamera) -> tuple[float, float]:
    """White noise, m and rad, that no pose of a camera is without: small against a pixel, in orbit too."""
    finest = finest_pixel(camera)
    metres, radians = LEAST_NOISE
    return metres, min(radians, LEAST_NOISE_PX * finest) if finest > 0 else radians


class SlowHistory:
    """Which slow errors hold from when on.

    Parameters
    ----------
    least : white noise, m and rad, that no pose is without
    """

    def __init__(self, least: tuple[float, float] = LEAST_NOISE) -> None:
        self._least = least
        self._from_s: list[float] = []
        self._slow: list[SlowErrors] = []

    @property
    def newest(self) -> SlowErrors:
        return self._slow[-1] if self._slow else SlowErrors()

    def add(self, from_s: float, slow: SlowErrors) -> None:
        """From a time on, not before the last one that was given."""
        self._from_s.append(max([from_s, *self._from_s[-1:]]))
        self._slow.append(slow)
        del self._from_s[:-MOST_STATED], self._slow[:-MOST_STATED]

    def without(self, time_s: list[float], covariance: Array) -> Array:
        """White part of pose covariances (n, 6, 6) at times (n,)."""
        which = np.maximum(np.searchsorted(self._from_s, time_s, side="right") - 1, 0)
        if not self._slow:
            return covariance
        out = np.empty_like(covariance)
        for i in np.unique(which):
            out[which == i] = self._slow[i].without(covariance[which == i], self._least)
        return out


class PoseBuffer:
    """Measured poses since the last hand-over.

    Parameters
    ----------
    known_only : leave out poses that say that they do not know the attitude
    smoothed_only : hand over smoothed poses alone, unless there are none for `PATIENCE_S`

    Attributes
    ----------
    first_known_s : of the first pose with a known attitude
    """

    def __init__(self, known_only: bool = False, smoothed_only: bool = False) -> None:
        self._known_only, self._smoothed_only = known_only, smoothed_only
        self._latest: dict[bool, tuple[float, list[float]]] = {}
        self._attitude_lost = self._valid_seen = False
        self._left_out = (0.0, 0.0)
        self.filtered_seen = False
        self.first_known_s = np.inf
        self._waiting: dict[bool, list[tuple[float, convert.PlainPose]]] = {False: [], True: []}
        self._seen: dict[bool, tuple[list[float], list[str | None]]] = {False: ([], []), True: ([], [])}
        self._invalid: dict[bool, list[tuple[float, float, str]]] = {False: [], True: []}

    def clear(self) -> None:
        """Forget all poses: times count from another moment from now on."""
        for waiting in self._waiting.values():
            waiting.clear()
        self._latest.clear()
        self._seen = {False: ([], []), True: ([], [])}
        self._invalid = {False: [], True: []}
        self._attitude_lost = self._valid_seen = False
        self._left_out = (0.0, 0.0)
        self.first_known_s = np.inf

    def add(self, time_s: float, pose: convert.PlainPose, smoothed: bool, reason: str) -> None:
        """Take a pose; ``reason`` why it is not valid.

        Raises
        ------
        ValueError : a pose without covariance
        """
        covariance = pose.covariance
        if covariance is None:
            raise ValueError("pose without covariance")
        self.filtered_seen |= not smoothed
        known = max(covariance[21], covariance[28], covariance[35]) < KNOWN_ATTITUDE_RAD**2
        if not smoothed and self._latest:
            self._attitude_lost |= not known
        if known:
            self.first_known_s = min(self.first_known_s, time_s)
            self._valid_seen |= pose.valid
        if known or not self._known_only:
            self._waiting[smoothed].append((time_s, pose))
        if known and (smoothed not in self._latest or time_s >= self._latest[smoothed][0]):
            self._latest[smoothed] = time_s, covariance
        times, reasons = self._seen[smoothed]
        place = bisect_left(times, time_s) if times and time_s <= times[-1] else len(times)
        times.insert(place, time_s)
        reasons.insert(place, None if pose.valid else reason)
        forgotten_s = times[-1] - REMEMBERED_S
        if len(times) > MOST_OLD and times[MOST_OLD] < forgotten_s:
            old = bisect_left(times, forgotten_s)
            self._invalid[smoothed] += _stretches(times[: old + 1], reasons[: old + 1])
            del times[:old], reasons[:old]

    def covariance_after(self, time_s: float) -> Array | None:
        """Covariance (6, 6) of the newest pose with a known attitude, None if there is none after a time, or the filter
        has just begun and no pose is valid yet."""
        if not self._latest:
            return None
        newest_s, covariance = max(self._latest.values(), key=lambda latest: latest[0])
        if not self._valid_seen and newest_s < self.first_known_s + FIRST_FIX_S:
            return None
        return _matrix(covariance) if newest_s >= time_s else None

    @property
    def learnt(self) -> Sequence[bool]:
        """(6,) in which components the newest smoothed pose is clearly more certain than the newest filtered one."""
        if len(self._latest) < 2:
            return NOTHING_LEARNT
        smoothed, filtered = (np.array(self._latest[key][1][::7]) for key in (True, False))
        return (smoothed < (1.0 - LEARNT_SHARE) * filtered).tolist()

    @property
    def leading(self) -> tuple[float, Array] | None:
        """Time and covariance (6, 6) of the newest pose with a known attitude: filtered ones where there are any."""
        latest = self._latest.get(not self.filtered_seen)
        return None if latest is None else (latest[0], _matrix(latest[1]))

    def started_anew(self) -> bool:
        """Whether attitude is known again after it was not: the filter has started anew. True once."""
        newest = self._latest.get(False)
        if not self._attitude_lost or newest is None or newest[0] < self._seen[False][0][-1]:
            return False
        self._attitude_lost = False
        return True

    def leave_out(self, begin_s: float, end_s: float) -> None:
        """Poses between two times are not to be handed over."""
        self._left_out = begin_s, end_s

    def take(self, slow: SlowHistory) -> Iterator[Poses]:
        """Times, positions, quaternions, covariance of the noise, smoothed or not, correlation time of
        the noise; filtered ones first."""
        begin_s, end_s = self._left_out
        for smoothed in (False, True):
            if not smoothed and self._smoothed_only and self._smoothed_follow():
                continue
            waiting = [w for w in self._waiting[smoothed] if not begin_s < w[0] < end_s]
            self._waiting[smoothed] = []
            if waiting:
                times, poses = map(list, zip(*waiting, strict=True))
                covariance = np.array([pose.covariance for pose in poses]).reshape(-1, 6, 6)
                yield (
                    times,
                    np.array([pose.position_l for pose in poses]),
                    np.array([pose.quaternion for pose in poses]),
                    slow.without(times, covariance),
                    smoothed,
                    poses[-1].noise_time_s,
                )

    def _smoothed_follow(self) -> bool:
        """Whether smoothed poses have come, or may still; filtered ones are then not kept."""
        waiting = self._waiting[False]
        if self._seen[True][0]:
            waiting.clear()
            return True
        return not waiting or waiting[-1][0] - waiting[0][0] < PATIENCE_S

    def validity(self, time_s: float) -> tuple[bool, str]:
        """Whether the measured poses between which the one at a time was interpolated are valid, and why not.

        Smoothed poses count where there are any, as in the window; a pose at the time itself stands alone.
        """
        smoothed_s = self._seen[True][0]
        by_smoothed = bool(smoothed_s) and time_s <= smoothed_s[-1] + SAME_TIME_S
        times, reasons = self._seen[by_smoothed]
        if times and time_s < times[0] - SAME_TIME_S:
            found = (r for a, b, r in self._invalid[by_smoothed] if a - SAME_TIME_S < time_s < b + SAME_TIME_S)
            return (False, old) if (old := next(found, None)) is not None else (True, "")
        low, high = bisect_left(times, time_s - SAME_TIME_S), bisect_right(times, time_s + SAME_TIME_S)
        if low == high:
            low, high = max(low - 1, 0), high + 1
        reason = next((r for r in reasons[low:high] if r is not None), None)
        return reason is None, reason or ""


def _matrix(covariance: list[float]) -> Array:
    return np.array(covariance).reshape(6, 6)


def _stretches(times: list[float], reasons: list[str | None]) -> list[tuple[float, float, str]]:
    """Begin, end and reason of what is not valid, each with the pose before and after it."""
    out = []
    for i, reason in enumerate(reasons):
        if reason is None:
            continue
        if i and reasons[i - 1] is not None and out:
            out[-1] = out[-1][0], times[min(i + 1, len(times) - 1)], out[-1][2]
        else:
            out.append((times[max(i - 1, 0)], times[min(i + 1, len(times) - 1)], reason))
    return out


class OrientationStore:
    """Refined orientation of the last minutes: of whole strips where there is, else final, else live."""

    def __init__(self) -> None:
        self._whole: tuple[list[int], list[Any]] = ([], [])
        self._final: tuple[list[int], list[Any]] = ([], [])
        self._live: tuple[list[int], list[Any]] = ([], [])

    def add_whole(self, bodies: list[Any]) -> None:
        """Add, or put in place of those of an earlier backward pass."""
        times, poses = self._whole
        for body in bodies:
            time_ns = convert.time_ns(body.timestamp)
            i = bisect_left(times, time_ns)
            if i < len(times) and times[i] == time_ns:
                poses[i] = body
            else:
                times.insert(i, time_ns)
                poses.insert(i, body)
        self._add(self._whole, [])

    def add_final(self, bodies: list[Any]) -> None:
        self._add(self._final, bodies)

    def add_live(self, bodies: list[Any]) -> None:
        self._add(self._live, bodies)

    @staticmethod
    def _add(kept: tuple[list[int], list[Any]], bodies: list[Any]) -> None:
        times, poses = kept
        for body in bodies:
            time_ns = convert.time_ns(body.timestamp)
            if not times or time_ns > times[-1]:
                times.append(time_ns)
                poses.append(body)
        old = bisect_right(times, times[-1] - round(KEPT_S * convert.SECOND_NS)) if times else 0
        if old > 256:
            del times[:old], poses[:old]

    def at(self, time_ns: int) -> Any:
        """Pose message at a time, interpolated between its neighbours; None outside."""
        for times, poses in (self._whole, self._final, self._live):
            i = bisect_right(times, time_ns) - 1
            if i >= 0 and times[i] == time_ns:
                return poses[i]
            if 0 <= i < len(times) - 1 and times[i + 1] - times[i] < convert.SECOND_NS:
                return _between(poses[max(i - 1, 0) : i + 3], times[max(i - 1, 0) : i + 3], poses[i], time_ns)
        return None


def _between(poses: list[Any], times: list[int], before: Any, time_ns: int) -> Any:
    samples = [convert.pose_sample(p) for p in poses]
    reference = times[0]
    trajectory = Trajectory(
        [(t - reference) * 1e-9 for t in times], [s.position_l for s in samples], [s.quaternion for s in samples]
    )
    at = trajectory.at([(time_ns - reference) * 1e-9])
    nearest = samples[int(np.argmin([abs(t - time_ns) for t in times]))]
    return convert.pose_message(
        time_ns,
        at.position_l[0],
        at.angles[0],
        nearest.covariance,
        valid=nearest.valid,
        strip=before.strip,
        correction=nearest.correction,
    )
