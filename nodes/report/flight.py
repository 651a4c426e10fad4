"""A flight as arrays: orientation, points, residuals and the progress of the adjustment, from a recording."""

from __future__ import annotations

from bisect import bisect_right
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from ...schemas import messages as m
from ...solver.camera.line_camera import LineCamera
from ...solver.geometry.trajectory import Trajectory
from .. import convert
from ..formats.recorded_sensors import added_to_times
from ..node import Message
from ..truth_frames import TruthFrames
from ..voices import FIXED, VERDICT, RecordedVoices

Array = NDArray[np.floating]
Key = tuple[str, str, str, int, int, str]
T = TypeVar("T")
SECOND_NS = convert.SECOND_NS

#: Topics of poses, and the name a report gives them.
POSE_TOPICS = {
    "trajectory/filtered": "filtered",
    "trajectory/smoothed": "smoothed",
    "orientation/live": "live",
    "orientation/final": "final",
    "orientation/whole": "whole",
    "truth/trajectory": "truth",
}


def in_gap(known_ns: NDArray[np.int64], time_ns: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Whether times (n,) lie in a gap of ascending times (k,), or outside of them."""
    if len(known_ns) < 2:
        return np.ones(len(time_ns), dtype=bool)
    after = np.searchsorted(known_ns, time_ns)
    outside = (time_ns < known_ns[0]) | (time_ns > known_ns[-1])
    after = np.clip(after, 1, len(known_ns) - 1)
    far = known_ns[after] - known_ns[after - 1] > convert.largest_step_ns(known_ns)
    return outside | (far & (time_ns != known_ns[after]) & (time_ns != known_ns[after - 1]))


@dataclass(frozen=True)
class PoseSeries:
    """Orientation over time, in order of time; n samples, several of a time where strips are imaged at the same time.

    Attributes
    ----------
    time_ns : (n,) UTC
    position_l : (n, 3) m; quaternion : (n, 4) ``R_lc`` xyzw; angles : (n, 3) omega, phi, kappa, rad
    covariance : (n, 6, 6) X, Y, Z, omega, phi, kappa; m, rad; NaN where the message has none
    correction : (n, 6) m, rad; NaN where the message has none
    valid : (n,); strip : (n,) "" between strips
    """

    time_ns: NDArray[np.int64]
    position_l: Array
    quaternion: Array
    angles: Array
    covariance: Array
    correction: Array
    valid: NDArray[np.bool_]
    strip: NDArray[np.str_]

    def __len__(self) -> int:
        return len(self.time_ns)

    def take(self, which: Any) -> PoseSeries:
        """A selection by index or mask."""
        return PoseSeries(*(getattr(self, name)[which] for name in self.__dataclass_fields__))

    @property
    def is_of_several_strips(self) -> bool:
        """Whether there are several samples of a time."""
        return bool((np.diff(self.time_ns) == 0).any())

    def of(self, strip: str) -> PoseSeries:
        """The samples that name a strip, or none."""
        return self.take((self.strip == strip) | (self.strip == ""))

    def known_at(self, time_ns: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Whether times (n,) lie between neighbours of this series and not in a gap of it."""
        return ~in_gap(self.time_ns, time_ns)

    def gaps(self) -> list[tuple[int, int]]:
        """Gaps of the series, each from and to, ns."""
        k = np.flatnonzero(np.diff(self.time_ns) > convert.largest_step_ns(self.time_ns))
        return [(int(self.time_ns[i]), int(self.time_ns[i + 1])) for i in k]

    def trajectory(self, start_ns: int) -> Trajectory:
        """Interpolator over seconds since ``start_ns``; raises ValueError for fewer than two samples."""
        time_ns, first = np.unique(self.time_ns, return_index=True)
        return Trajectory((time_ns - start_ns) / SECOND_NS, self.position_l[first], self.quaternion[first])


@dataclass(frozen=True)
class Look:
    """One image measurement of a point: ids, line and sample in px, their sigma (0: the project's), and UTC of the line
    (0: as the rate of its strip says)."""

    point: str
    strip: str
    ccd: str
    line: float
    sample: float
    sigma_line: float
    sigma_sample: float
    time_ns: int = 0

    @property
    def key(self) -> Key:
        """The key by which a list of rejected observations names it."""
        return _key(self)


@dataclass
class Flight:
    """Everything a report needs, collected from the messages of one recording.

    Attributes
    ----------
    start_ns : stamp of the first message that is not configuration; times in seconds count from it
    project, camera : the newest that nodes used; earlier_projects, earlier_cameras : those of before, each with the
        stamp from which on it held no more
    poses : by name, see POSE_TOPICS; names without messages are absent
    gnss, attitude : messages as measured, in order of arrival
    gnss_ns : times of the fixes, UTC, as an operator corrected them in flight
    live_points, points, whole_points : first LIVE, last FINAL (or last LIVE, without one) and last WHOLE message of
        each object point
    ground : control and check points by id; refused_ground : those whose coordinates do not count on an operator's
        word; truth_points : true coordinates by id
    reports : adjustment reports in order; rejected : the rejected observations they name, once each, without those
        that were accepted again later
    counts : messages looked at, by topic; refused : messages that hold no usable value
    not_used : lines about messages that nodes did not use either
    status : newest status of each node
    """

    start_ns: int = 0
    end_ns: int = 0
    project: Any = None
    camera: LineCamera | None = None
    earlier_projects: list[tuple[int, Any]] = field(default_factory=list)
    earlier_cameras: list[tuple[int, LineCamera]] = field(default_factory=list)
    strips: dict[str, Any] = field(default_factory=dict)
    poses: dict[str, PoseSeries] = field(default_factory=dict)
    gnss: list[Any] = field(default_factory=list)
    gnss_ns: NDArray[np.int64] = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    attitude: list[Any] = field(default_factory=list)
    looks: list[Look] = field(default_factory=list)
    live_points: dict[str, Any] = field(default_factory=dict)
    points: dict[str, Any] = field(default_factory=dict)
    whole_points: dict[str, Any] = field(default_factory=dict)
    ground: dict[str, Any] = field(default_factory=dict)
    refused_ground: set[str] = field(default_factory=set)
    truth_points: dict[str, Array] = field(default_factory=dict)
    reports: list[tuple[int, Any]] = field(default_factory=list)
    rejected: list[Any] = field(default_factory=list)
    events: list[tuple[int, Any]] = field(default_factory=list)
    status: dict[str, Any] = field(default_factory=dict)
    counts: Counter[str] = field(default_factory=Counter)
    refused: Counter[str] = field(default_factory=Counter)
    not_used: list[str] = field(default_factory=list)

    @property
    def measured(self) -> str:
        """Name of the trajectory before triangulation: "filtered", else "smoothed"; "" without either."""
        return next((name for name in ("filtered", "smoothed") if len(self.poses.get(name, ())) >= 2), "")

    def seconds(self, time_ns: Any) -> Any:
        """Seconds since the start of the flight."""
        return (np.asarray(time_ns) - self.start_ns) / SECOND_NS

    def projects_at(self, time_ns: NDArray[np.int64]) -> list[tuple[NDArray[np.bool_], Any]]:
        """The projects that held at times (n,), each with the times (n,) at which it did."""
        return _at(time_ns, self.earlier_projects, self.project)

    def cameras_at(self, time_ns: NDArray[np.int64]) -> list[tuple[NDArray[np.bool_], LineCamera | None]]:
        """The cameras that held at times (n,), each with the times (n,) at which it did."""
        return _at(time_ns, self.earlier_cameras, self.camera)

    @property
    def ccds(self) -> dict[str, int]:
        """Pixels of the CCD lines of all cameras by id, those of the newest one first."""
        cameras = [self.camera, *(camera for _, camera in reversed(self.earlier_cameras))]
        found: dict[str, int] = {}
        for line in (line for camera in cameras if camera is not None for line in camera.lines):
            found.setdefault(line.id, line.pixels)
        return found

    def parameters_at(self, time_ns: NDArray[np.int64]) -> list[tuple[NDArray[np.bool_], Any]]:
        """What adjustment reports said last of parameters while a camera held, each with the times (n,) at which it
        did."""
        ends = [end for end, _ in self.earlier_cameras]
        told: list[Any] = [()] * (len(ends) + 1)
        for stamp, report in self.reports:
            told[bisect_right(ends, stamp)] = report.parameters or told[bisect_right(ends, stamp)]
        return _at(time_ns, list(zip(ends, told, strict=False)), told[-1])

    def given(self, point: str) -> Array:
        """(3,) coordinates of a ground point that count; NaN for those that are not given, or were left out."""
        xyz = convert.given_of(self.ground[point])
        out = [r.coordinate for r in self.rejected if r.point == point and r.coordinate]
        return np.where([point in self.refused_ground or axis in out for axis in "XYZ"], np.nan, xyz)

    def strip_times(self, strip: str) -> tuple[int, int] | None:
        """First and last line of a strip, UTC ns; up to the last pose that names it where the number of lines is not
        known, as of a strip whose end was not recorded. None where there is none."""
        message = self.strips.get(strip)
        if message is None or not message.line_rate_hz > 0:
            return None
        if message.lines:
            length = int((message.lines - 1) / message.line_rate_hz * SECOND_NS)
            return message.first_line_time_ns, message.first_line_time_ns + length
        named = [poses.time_ns[poses.strip == strip] for poses in self.poses.values()]
        last = max((int(times[-1]) for times in named if len(times)), default=0)
        return (message.first_line_time_ns, last) if last > message.first_line_time_ns else None

    def during_strips(self, time_ns: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Which times lie on a strip; all of them where no strip is known."""
        spans = [span for span in map(self.strip_times, self.strips) if span is not None]
        if not spans:
            return np.ones(len(time_ns), dtype=bool)
        inside = np.zeros(len(time_ns), dtype=bool)
        for first, last in spans:
            inside |= (time_ns >= first) & (time_ns <= last)
        return inside


def _at(time_ns: NDArray[np.int64], earlier: Sequence[tuple[int, T]], newest: T) -> list[tuple[NDArray[np.bool_], T]]:
    """What held at times: of things that held one after the other until a time each, and the newest."""
    number = np.searchsorted([end for end, _ in earlier], time_ns, side="right")
    return [(number == i, one) for i, one in enumerate([*(one for _, one in earlier), newest])]


def collect(messages: Iterable[Message]) -> Flight:
    """Read the messages of a recording once; messages that cannot be used are counted and raise no error.

    Of configuration, sensors and control those count that nodes use, see `RecordedVoices`.
    """
    flight, voices = Flight(), RecordedVoices()
    before, stated = 0, 0  # poses and points of a local frame that has been given up, and its ground points
    truth_frames, truth_elsewhere = TruthFrames(), 0
    rows: dict[str, list[Any]] = {name: [] for name in POSE_TOPICS.values()}
    rejected: dict[Any, Any] = {}
    configured_ns: list[int] = []
    fixed_ns: list[int] = []  # stamps of the fixes
    clock: list[Message] = []  # what an operator said of it
    held: dict[str, Any] = {}  # project and camera that nodes used last
    for message in messages:
        topic, stamp = message.topic, message.stamp_ns
        flight.counts[topic] += 1
        if topic.startswith(("configuration/", "observation/control", "truth/point", "status/")):
            configured_ns.append(stamp)
        else:
            flight.start_ns = min(flight.start_ns or stamp, stamp)
            flight.end_ns = max(flight.end_ns, stamp)
        if truth_frames.is_elsewhere(message, flight.project):
            truth_elsewhere += topic != "truth/world"
            continue
        for used in voices.used(message):
            truth_frames.note(used)
            if used.topic == "configuration/project" and _is_another_frame(flight, used.body):
                before += _forget_results(flight, rows)
                stated += len(flight.ground)
                flight.ground.clear()
                for key in [key for key, one in rejected.items() if one.coordinate]:  # of coordinates in that frame
                    del rejected[key]
                truth_elsewhere += len(flight.truth_points)
                flight.truth_points.clear()
            if used.topic in FIXED and held.get(used.topic) == used.body:
                continue
            try:
                _take(flight, rows, rejected, used.topic, used.stamp_ns, used.body)
                if used.topic in FIXED:
                    held[used.topic] = used.body
                elif used.topic == "sensor/gnss":
                    fixed_ns.append(used.stamp_ns)
                elif used.topic == VERDICT and used.body.topic == "sensor/gnss":  # others are the voices' own
                    clock.append(used)
            except (ValueError, IndexError):
                flight.refused[used.topic] += 1
    times = np.array([convert.time_ns(fix.timestamp) for fix in flight.gnss], dtype=np.int64)
    flight.gnss_ns = times + np.rint(added_to_times(fixed_ns, clock) * convert.SECOND_NS).astype(np.int64)
    flight.not_used = voices.lines()
    if before:
        what = "poses and object points of before the project got another origin or CRS"
        flight.not_used.append(f"{before} {what}: they are in another local frame")
    if truth_elsewhere:
        what = "true poses and points are in another local frame than the project's"
        flight.not_used.append(f"{truth_elsewhere} {what}: nothing is compared with them")
    if stated:
        what = "ground points stated before the project got another origin or CRS"
        flight.not_used.append(f"{stated} {what}: they count where they were stated again")
    flight.not_used += [
        f"ground point {point}: its coordinates do not count, as an operator said in flight"
        for point in sorted(flight.refused_ground & flight.ground.keys())
    ]
    if not flight.start_ns and configured_ns:
        flight.start_ns, flight.end_ns = min(configured_ns), max(configured_ns)
    flight.poses = {name: _poses(samples, keep_first=name == "live") for name, samples in rows.items() if samples}
    for point in flight.points.values():
        for r in point.residuals:
            if r.rejected:
                named = m.RejectedObservation(point=point.point, strip=r.strip, ccd=r.ccd, line=r.line, sample=r.sample)
                named.w, named.reason = r.w, "snooping"
                rejected.setdefault(rejected_key(named), named)
    flight.rejected = list(rejected.values())
    return flight


def updates_with_new_rays(reports: Iterable[Any]) -> list[bool]:
    """Which adjustment reports contain rays that the one before did not; between strips there are none."""
    newest, new = 0, []
    for r in reports:
        new.append(r.rays > 0 and r.window_end_ns > newest)
        newest = max(newest, r.window_end_ns)
    return new


def rejected_key(r: Any) -> Key:
    """The key of a rejected observation; the same as `Look.key` of the measurement."""
    return _key(r)


def _key(r: Any) -> Key:
    """Ids; line and sample in hundredths of a pixel, (0, 0) where they are not finite; the coordinate of control."""
    line, sample = (round(100 * v) if np.isfinite(v) else 0 for v in (r.line, r.sample))
    return r.point, r.strip, r.ccd, line, sample, getattr(r, "coordinate", "")


def _is_another_frame(flight: Flight, project: Any) -> bool:
    return flight.project is not None and not convert.same_frame(project, flight.project)


def _forget_results(flight: Flight, rows: dict[str, list[Any]]) -> int:
    """Forget poses and object points; returns how many there were."""
    points = (flight.live_points, flight.points, flight.whole_points)
    n = sum(map(len, rows.values())) + len({id for of in points for id in of})
    for results in (*rows.values(), *points):
        results.clear()
    return n


def _take(flight: Flight, rows: dict[str, list[Any]], rejected: dict[Any, Any], topic: str, stamp: int, body: Any):
    if topic in POSE_TOPICS:
        rows[POSE_TOPICS[topic]].append(convert.pose_sample(body))
    elif topic == "observation/tie":
        for i in body.images:
            flight.looks.append(
                Look(body.point, i.strip, i.ccd, i.line, i.sample, i.sigma_line, i.sigma_sample, i.time_ns)
            )
    elif topic == "point/object":
        _finite(body, body.x, body.y, body.z)
        if body.status == body.WHOLE:
            flight.whole_points[body.point] = body
            return
        if body.status == body.LIVE:
            flight.live_points.setdefault(body.point, body)
        known = flight.points.get(body.point)
        if known is None or body.status >= known.status:
            flight.points[body.point] = body
    elif topic == "adjustment/report":
        flight.reports.append(
            (stamp, _finite(body, body.sigma0, body.sigma0_total, body.data_latency_s, body.compute_s))
        )
        for r in body.rejected:
            rejected[rejected_key(r)] = r
        for r in body.returned:
            rejected.pop(rejected_key(r), None)
    elif topic == "sensor/gnss":
        convert.check_place(body.latitude, body.longitude, body.altitude)
        flight.gnss.append(_finite(body, *body.position_covariance))
    elif topic == "sensor/attitude":
        convert.check_angles(body.roll, body.pitch, body.heading)
        flight.attitude.append(_finite(body, *body.covariance))
    elif topic == "observation/control":
        flight.ground[body.point] = _finite(body, body.x, body.y, body.z)
    elif topic == "observation/verdict" and not body.topic:
        (flight.refused_ground.discard if body.accepted else flight.refused_ground.add)(body.point)
    elif topic == "truth/point":
        _finite(body, body.x, body.y, body.z)
        flight.truth_points[body.point] = np.array([body.x, body.y, body.z])
    elif topic == "configuration/project":
        if flight.project is not None:
            flight.earlier_projects.append((stamp, flight.project))
        flight.project = body
    elif topic == "configuration/camera":
        camera = convert.camera_from(body)
        if flight.camera is not None:
            flight.earlier_cameras.append((stamp, flight.camera))
        flight.camera = camera
    elif topic == "configuration/strip":
        convert.check_strip(body, stamp)
        known = flight.strips.get(body.id)
        if known is None or body.lines or not known.lines:
            flight.strips[body.id] = body
    elif topic == "event/log":
        flight.events.append((stamp, body))
    elif topic.startswith("status/"):
        flight.status[topic.removeprefix("status/")] = body


def _finite(body: Any, *values: float) -> Any:
    """The message, if all of the values are finite; raises ValueError otherwise."""
    if not np.isfinite(values).all():
        raise ValueError("value is not finite")
    return body


def _poses(samples: list[convert.PoseSample], keep_first: bool) -> PoseSeries:
    """Samples in order of time; of two of a strip at the same time the first or the last is kept."""
    of = {(s.time_ns, s.strip): s for s in (samples[::-1] if keep_first else samples)}
    kept = [of[key] for key in sorted(of)]
    none6, none66 = np.full(6, np.nan), np.full((6, 6), np.nan)
    quaternion = np.array([s.quaternion for s in kept])
    return PoseSeries(
        np.array([s.time_ns for s in kept], dtype=np.int64),
        np.array([s.position_l for s in kept]),
        quaternion,
        convert.angles_of(quaternion),
        np.array([none66 if s.covariance is None else s.covariance for s in kept]),
        np.array([none6 if s.correction is None or len(s.correction) != 6 else s.correction for s in kept]),
        np.array([s.valid for s in kept]),
        np.array([s.strip for s in kept]),
    )
