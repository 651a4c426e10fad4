"""A block from the messages of a flight."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...schemas import messages as m
from ...solver.adjustment.block_data import Apriori, BlockData, ImagePoints, KnownPoints
from ...solver.adjustment.network import SAME_S, Strip, most_off
from ...solver.arrays import Array
from ...solver.geometry.frames import CrsError
from ...solver.geometry.trajectory import Trajectory
from ...solver.models import WANDER_TIMES
from ...solver.models.slow_errors import LEARNT_SHARE, SlowErrors
from ..convert import SECOND_NS, camera_from, iso, largest_step_ns, local_frame, role_of, same_frame, slow_errors_of
from ..errors import UserError
from ..node import Message
from .block_messages import SIGMAS
from .projection import notes_of_heights

#: What `block_from_messages` reads.
TOPICS = (
    *("configuration/project", "configuration/camera", "configuration/strip"),
    *("observation/control", "observation/verdict", "observation/tie", "trajectory/filtered", "trajectory/smoothed"),
)
#: Topics of the measured trajectory, the best first.
POSES = ("trajectory/smoothed", "trajectory/filtered")

#: Differences below this share of a variance are rounding.
ROUNDING = 1e-9
#: Strips that begin before a filter has found its attitude are adjusted with the wander of one that is learnt, 0.4 s
#: from border to border, where they last so many seconds together; of longer ones it would take minutes. Tuned.
FAST_WANDER_S = 240.0


@dataclass
class _Collected:
    """What the messages of a flight hold, before it becomes arrays."""

    project: Any = None
    camera: Any = None
    camera_ns: int = 0  # since when, where there was another one before
    strips: dict[str, Any] = field(default_factory=dict)
    ground: dict[str, Any] = field(default_factory=dict)
    refused: set[str] = field(default_factory=set)
    ties: list[tuple[str, Any]] = field(default_factory=list)
    times: dict[str, list[tuple[float, int]]] = field(default_factory=dict)  # lines of strips and their UTC, ns
    poses: dict[str, list[tuple[int, str, Any]]] = field(default_factory=dict)

    def add(self, message: Message) -> None:
        body = message.body
        if message.topic == "configuration/project":
            if self.project is not None and not same_frame(body, self.project):
                self.poses.clear()  # those are in another local frame
                self.ground.clear()
            self.project = body
        elif message.topic == "configuration/camera":
            if self.camera is not None and body != self.camera:
                self.camera_ns = message.stamp_ns
            self.camera = body
        elif message.topic == "configuration/strip":
            self.strips[body.id] = body
        elif message.topic == "observation/control":
            self.ground[body.point] = body
        elif message.topic == "observation/verdict" and not body.topic:
            (self.refused.discard if body.accepted else self.refused.add)(body.point)
        elif message.topic == "observation/tie":
            self.ties.extend((body.point, image) for image in body.images)
            for image in body.images:
                if image.time_ns:
                    self.times.setdefault(image.strip, []).append((image.line, image.time_ns))
        elif message.topic in POSES:
            stamp = body.timestamp.seconds * SECOND_NS + body.timestamp.nanos
            self.poses.setdefault(message.topic, []).append((stamp, body.strip, body))


def block_from_messages(messages: Iterable[Message], name: str) -> BlockData:
    """The block in the messages of a recording (those of `TOPICS`): smoothed trajectory if there is one, else filtered.

    Parameters
    ----------
    messages : in any order
    name : of the recording, for errors

    Raises
    ------
    UserError : a recording without camera, strips, trajectory or image points
    """
    found = _Collected()
    for message in messages:
        found.add(message)
    for what, topic in (
        ("camera", "configuration/camera"),
        ("strips", "configuration/strip"),
        ("ties", "observation/tie"),
    ):
        if not getattr(found, what):
            raise UserError(f"{name}: no message on {topic}; it cannot be adjusted as a block")
    for of_topic in found.poses.values():
        of_topic.sort(key=lambda pose: pose[0])
    poses = next((found.poses[topic] for topic in POSES if found.poses.get(topic)), None)
    if poses is None:
        raise UserError(
            f"{name}: no message on trajectory/smoothed or trajectory/filtered; run `triline process` first?"
        )
    try:
        camera = camera_from(found.camera)
    except ValueError as error:
        raise UserError(f"{name}: configuration/camera: {error}") from None
    project = found.project or m.Project(name=name)
    notes: list[str] = []
    # times near the start of the epoch are a project's own; others count from their start, to keep all digits
    reference = 0 if poses[-1][0] < 10**8 * SECOND_NS else poses[0][0] // SECOND_NS * SECOND_NS
    stated = any(getattr(project, key) for key in SIGMAS)
    slow = slow_errors_of(project) if stated else None
    of_filter, uncertain = ({}, []) if slow is None else _errors_of_filter(slow, found)
    strips = _strips_of(found, poses, reference, notes, {lens.id for lens in camera.lenses}, slow, of_filter)
    if not strips:
        raise UserError(f"{name}: no strip with a trajectory; {notes[0] if notes else ''}")
    settings: dict[str, object] = {key: tuple(getattr(project, key)) for key in SIGMAS if getattr(project, key)}
    settings |= {key: getattr(project, key) for key in WANDER_TIMES if getattr(project, key)}
    own = {strip.id: _settings_of(of_filter[strip.id]) for strip in strips if strip.id in of_filter}
    if uncertain := [id for id in own if id in uncertain]:
        notes.append(
            f"{name}: where strip {', '.join(uncertain)} begins poses are less certain than the project states; so are "
            "slow errors there, as they are adjusted"
        )
    apriori = Apriori(project.image_sigma_px or Apriori.image_sigma_px, settings, of_strip=own, wide=bool(uncertain))
    if poses[0][0] < found.camera_ns:
        notes.append(
            f"{name}: before {iso(found.camera_ns)} nodes used another camera; image points of then are adjusted with "
            "the same one as those after"
        )
    ground = _ground_of(found, notes)
    point_ids, image = _image_of(found, camera, strips, ground, apriori, reference)
    frame = local_frame(project)
    notes += _notes_of_heights(frame.crs, name)
    return BlockData(
        project.name or name, frame, camera, strips, point_ids, ground, image, apriori, tuple(notes), reference,
        heading=not any(pose[1] for pose in poses),  # poses that name a strip come from a block folder
        refused=frozenset(found.refused & found.ground.keys()),
    )  # fmt: skip


def _notes_of_heights(crs: str, name: str) -> list[str]:
    """Notes where tables in the CRS cannot have its heights or positions here."""
    try:
        return [f"{name}: {note}" for note in notes_of_heights(crs)]
    except CrsError:  # whoever writes tables in it says so
        return []


def _strips_of(
    found: _Collected,
    poses: list[tuple[int, str, Any]],
    reference: int,
    notes: list[str],
    lenses: set[str],
    slow: SlowErrors | None,
    of_filter: Mapping[str, SlowErrors],
) -> tuple[Strip, ...]:
    time_ns = np.array([pose[0] for pose in poses], dtype=np.int64)
    label = np.array([pose[1] for pose in poses], dtype=object)
    strips = []
    for id, body in found.strips.items():
        lines, rate = int(body.lines), body.line_rate_hz
        first = (body.first_line_time_ns - reference) * 1e-9
        start, end = body.first_line_time_ns, body.first_line_time_ns
        if lines and rate > 0:
            end += round((lines - 1) / rate * 1e9)
        looks = _times_stated(found, body) if rate > 0 else None
        if looks is not None and len(looks[1]):
            end = max(end, int(looks[1][-1]))
        own = np.flatnonzero(label == id)
        if len(own):
            start, end = min(start, int(time_ns[own[0]])), max(end, int(time_ns[own[-1]]))
        candidates = np.flatnonzero((label == id) | (label == ""))
        low = max(int(np.searchsorted(time_ns[candidates], start, side="right")) - 1, 0)
        high = int(np.searchsorted(time_ns[candidates], end, side="left"))
        rows = candidates[low : high + 1]
        rows = rows[np.concatenate([[True], np.diff(time_ns[rows]) > 0])] if len(rows) else rows
        if len(rows) < 2 or not rate > 0:
            notes.append(f"strip {id} has no trajectory or no line rate and was left out")
            continue
        bodies = [poses[row][2] for row in rows]
        notes += _notes_of_validity(id, bodies)
        p = [body.pose for body in bodies]
        trajectory = Trajectory(
            (time_ns[rows] - reference) * 1e-9,
            [(q.position.x, q.position.y, q.position.z) for q in p],
            [(q.orientation.x, q.orientation.y, q.orientation.z, q.orientation.w) for q in p],
        )
        noise = _noise_of(bodies, of_filter.get(id, slow))
        lens = id.rpartition("/")[2] if "/" in id else None
        strip = Strip(
            id,
            trajectory,
            first,
            rate,
            lines,
            lens=lens if lens in lenses else None,
            noise=noise,
            noise_time_s=bodies[-1].noise_time_s,
            gap_s=largest_step_ns(time_ns[rows]) / SECOND_NS,
        )
        if looks is not None:
            strip = replace(strip, line_time_s=_line_times(strip, looks[0], (looks[1] - reference) * 1e-9))
        strips.append(strip)
    return tuple(strips)


def _times_stated(found: _Collected, body: Any) -> tuple[Array, NDArray[np.int64]]:
    """Lines (k,) of a strip and their UTC (k,), ns, as image points state them: in the order of the lines, later and
    later. Times that cannot be those of their lines are left out, as on line."""
    stated = found.times.get(body.id, [])
    line, time_ns = np.array([u for u, _ in stated]), np.array([t for _, t in stated], dtype=np.int64)
    since_s = line / body.line_rate_hz
    good = np.abs((time_ns - body.first_line_time_ns) * 1e-9 - since_s) <= most_off(since_s)
    good &= line >= -0.5
    line, first = np.unique(line[good], return_index=True)
    time_ns = time_ns[good][first]
    later = np.concatenate([[True], time_ns[1:] > np.maximum.accumulate(time_ns)[:-1]])[: len(line)]
    return line[later], time_ns[later]


def _line_times(strip: Strip, line: Array, time_s: Array) -> Array | None:
    """Times of all lines of a strip through those that are known (k,); None where these are as its rate says."""
    count = strip.lines or int(np.ceil(line.max(initial=0.0))) + 1
    if count < 2 or not len(line) or np.abs(time_s - strip.time_of(line)).max() <= SAME_S:
        return None
    u = np.arange(count)
    beyond = np.minimum(u - line[0], 0.0) + np.maximum(u - line[-1], 0.0)
    return np.interp(u, line, time_s) + beyond / strip.line_rate_hz


def _notes_of_validity(strip: str, poses: list[Any]) -> list[str]:
    """What a navigator says against the poses of a strip, which the adjustment takes as they are."""
    # reasons without how long and how much, which differ from pose to pose
    reasons = Counter(re.sub(r"( for)? [\d.]+ m?s?$", "", pose.reason) for pose in poses if not pose.valid)
    if not reasons:
        return []
    reason = reasons.most_common(1)[0][0] or "no reason is said"
    return [
        f"strip {strip}: {reasons.total()} of {len(poses)} poses are not valid ({reason}), and were taken as they are"
    ]


def _errors_of_filter(slow: SlowErrors, found: _Collected) -> tuple[dict[str, SlowErrors], list[str]]:
    """By its name, slow errors of each strip whose poses do not err as the project states, and the strips at whose
    begin they are clearly less certain than that.

    As on line, what a filter does not know at the begin of a strip is an error for long, and no noise of single poses
    (`SlowErrors.widened`); its wander is as fast as there, unless such strips are so long that this would take too many
    unknowns (`FAST_WANDER_S`): then the attitude's is as slow as the project states. Of an inertial filter that learns
    the positions err faster than stated in all strips (`SlowErrors.with_taken_back`).
    """
    usual, wider = {}, {}
    times = {topic: np.array([pose[0] for pose in poses], dtype=np.int64) for topic, poses in found.poses.items()}
    for id, body in found.strips.items():
        smoothed, filtered = (_variance_at(found, times, topic, body.first_line_time_ns) for topic in POSES)
        at_begin = filtered if smoothed is None else smoothed
        if at_begin is None:
            continue
        learns = smoothed is not None and filtered is not None and _learns(smoothed, filtered)
        usual[id] = slow.with_taken_back() if learns and any(slow.wander_m) else slow
        own = slow.widened(np.diag(at_begin))
        if own is not slow:
            wider[id] = own
    bodies = [found.strips[id] for id in wider]
    lasts_s = sum(body.lines / body.line_rate_hz if body.line_rate_hz > 0 else 0.0 for body in bodies)
    if not all(body.lines for body in bodies) or lasts_s > FAST_WANDER_S:
        wider = {id: _slowly(own, usual[id], slow) for id, own in wider.items()}
    return {id: own for id, own in (usual | wider).items() if own is not slow}, list(wider)


def _variance_at(
    found: _Collected, times: dict[str, NDArray[np.int64]], topic: str, time_ns: int
) -> NDArray[np.floating] | None:
    """Variances (6,) of the first pose of a topic from a time on; None where it states none."""
    poses = found.poses.get(topic)
    if not poses:
        return None
    covariance = poses[min(int(np.searchsorted(times[topic], time_ns)), len(poses) - 1)][2].covariance
    variance = np.array(covariance).reshape(6, 6).diagonal() if len(covariance) == 36 else np.full(6, np.nan)
    return variance if np.isfinite(variance).all() else None


def _learns(smoothed: NDArray[np.floating], filtered: NDArray[np.floating]) -> bool:
    """Whether smoothing makes the variances (6,) of an attitude smaller. They stay as they are where the filter takes
    over a measured attitude.
    """
    return bool((smoothed[3:] < (1.0 - LEARNT_SHARE) * filtered[3:]).any())


def _slowly(wider: SlowErrors, usual: SlowErrors, stated: SlowErrors) -> SlowErrors:
    """Widened errors with a wander as slow as that of the other strips."""
    metres = np.sqrt(np.square(usual.wander_m) + np.square(wider.offset_m) - np.square(stated.offset_m)).tolist()
    times_s = {"wander_time_s": usual.wander_time_s, "attitude_time_s": usual.attitude_time_s}
    return replace(wider, wander_m=(metres[0], metres[1], metres[2]), **times_s)


def _settings_of(slow: SlowErrors) -> dict[str, object]:
    """Slow errors as settings of a project."""
    degrees = {name: tuple(np.degrees(getattr(slow, name)).tolist()) for name in ("shift", "drift", "wander")}
    return {
        "offset_sigma_m": slow.offset_m, "wander_sigma_m": slow.wander_m,
        **{f"{name}_sigma_deg": value for name, value in degrees.items()},
        "wander_time_s": slow.wander_time_s,
        **({"attitude_wander_time_s": slow.attitude_time_s} if slow.attitude_time_s else {}),
    }  # fmt: skip


def _noise_of(poses: list[Any], slow: SlowErrors | None) -> NDArray[np.floating] | None:
    """(n, 6, 6) white noise of poses: their covariance without the slow errors that the project states.

    None where it states none, since then the white part of the covariance is not known, or where nothing is left.
    """
    if slow is None or not all(len(pose.covariance) == 36 for pose in poses):
        return None
    stated = np.array([pose.covariance for pose in poses]).reshape(-1, 6, 6)
    noise = slow.without(stated, least=(0.0, 0.0))
    variances = np.einsum("nii->ni", noise), np.einsum("nii->ni", stated)
    return noise if np.isfinite(noise).all() and (variances[0] > ROUNDING * variances[1]).any() else None


def _ground_of(found: _Collected, notes: list[str]) -> KnownPoints:
    ids, xyz, covariance, roles, radius = [], [], [], [], []
    for id, body in found.ground.items():
        if id in found.refused:
            notes.append(f"ground point {id}: its coordinates do not count, as an operator said in flight")
            continue
        given = {"control": (0, 1, 2), "planimetric": (0, 1), "height": (2,)}.get(role_of(body), ())
        usable = len(body.covariance) == 9 and np.isfinite([body.x, body.y, body.z, *body.covariance]).all()
        if not usable or not all(body.covariance[4 * axis] > 0 for axis in given):  # as on line
            notes.append(f"ground point {id} has no usable covariance or coordinates and was left out")
            continue
        ids.append(id)
        xyz.append((body.x, body.y, body.z))
        covariance.append(np.reshape(body.covariance, (3, 3)))
        roles.append(role_of(body))
        radius.append(body.target_radius)
    places, covariances = np.array(xyz).reshape(-1, 3), np.array(covariance).reshape(-1, 3, 3)
    return KnownPoints(tuple(ids), places, covariances, tuple(roles), tuple(radius))


def _image_of(
    found: _Collected,
    camera: Any,
    strips: tuple[Strip, ...],
    ground: KnownPoints,
    apriori: Apriori,
    reference: int,
) -> tuple[tuple[str, ...], ImagePoints]:
    ids = {id: i for i, id in enumerate(ground.id)}
    place = {strip.id: i for i, strip in enumerate(strips)}
    n = len(found.ties)
    index = np.empty((3, n), dtype=np.int64)
    value = np.empty((4, n))
    unknown: dict[int, tuple[str, str]] = {}
    usual = apriori.image_sigma_px
    for i, (point, image) in enumerate(found.ties):
        index[:, i] = ids.setdefault(point, len(ids)), place.get(image.strip, -1), camera.line_index.get(image.ccd, -1)
        value[:2, i] = image.line, image.sample
        value[2:, i] = image.sigma_line or usual, image.sigma_sample or usual
        if index[1:, i].min() < 0:
            unknown[i] = (image.strip, image.ccd)
    time = np.full(n, np.nan)
    stated_ns = np.array([image.time_ns for _, image in found.ties], dtype=np.int64)
    for i, strip in enumerate(strips):
        mine = np.flatnonzero(index[1] == i)
        line, stated_s = value[0, mine], np.where(stated_ns[mine] == 0, np.nan, (stated_ns[mine] - reference) * 1e-9)
        by_rate = replace(strip, line_time_s=None).time_of(line)
        off_s = np.abs(stated_s - by_rate)
        own = (off_s > SAME_S) & (off_s <= most_off(line / strip.line_rate_hz))
        time[mine] = np.where(own, stated_s, strip.time_of(line))
    line, sample, sigma, of_sample = value
    return tuple(ids), ImagePoints(index[0], index[1], index[2], line, sample, sigma, time, unknown, of_sample)
