"""A block as the messages of a flight, in the order an on-line system would have had them, and back."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...schemas import messages as m
from ...schemas.topics import rank
from ...solver.block import Apriori, Block, GroundPoints, ImagePoints
from ...solver.models.dgr import DgrOptions
from ...solver.network import Strip
from ...solver.rotation import angles_from_matrix, matrix_from_quaternion
from ...solver.trajectory import Trajectory
from ..convert import (
    SECOND_NS,
    camera_from,
    camera_message,
    ground_point_message,
    local_frame,
    pose_message,
    role_of,
)
from ..errors import UserError
from ..node import Message

#: Strips whose times overlap in the files are set apart by this much.
GAP_S = 10.0
#: What `block_from_messages` reads.
TOPICS = (
    *("configuration/project", "configuration/camera", "configuration/strip"),
    *("observation/control", "observation/tie", "trajectory/filtered", "trajectory/smoothed"),
)
_SIGMAS = ("offset_sigma_m", "shift_sigma_deg", "drift_sigma_deg", "wander_sigma_m", "wander_sigma_deg")


def block_messages(block: Block, source: str = "import") -> Iterator[Message]:
    """All messages of a block, sorted by stamp and rank.

    Time in the files counts from the Unix epoch. Strips whose times overlap are set one after the other by whole
    seconds. Configuration and control come first; a pose has the time it is valid for; the looks at a point come strip
    by strip, when the last one in the strip has been imaged.
    """
    shift = strip_shifts(block)
    timed = [*_strip_messages(block, shift, source), *_tie_messages(block, shift, source)]
    start = min((message.stamp_ns for message in timed), default=0)
    first = [
        Message("configuration/project", start, _project(block), source),
        Message("configuration/camera", start, camera_message(block.camera), source),
    ]
    ground = block.ground
    for id, xyz, covariance, role in zip(ground.id, ground.xyz_l, ground.covariance, ground.role, strict=True):
        first.append(Message("observation/control", start, ground_point_message(id, xyz, covariance, role), source))
    yield from sorted([*first, *timed], key=lambda message: (message.stamp_ns, rank(message.topic)))


def not_carried(block: Block) -> list[str]:
    """What of a block has no place in the messages, in words."""
    notes = []
    keys = [key for key in block.apriori.trajectory if key not in (*_SIGMAS, "wander_time_s")]
    if keys:
        notes.append(f"project.toml: trajectory.{', trajectory.'.join(keys)}: not carried by a recording")
    for strip in block.strips:
        if strip.line_time_s is not None:
            u = np.arange(len(strip.line_time_s))
            rate = strip.line_rate_hz
            off = float(np.abs((strip.line_time_s - strip.line_time_s[0]) * rate - u).max())
            notes.append(f"strip {strip.id}: line times become a constant rate, off by {off:.2f} lines at most")
    return notes


def strip_shifts(block: Block) -> NDArray[np.float64]:
    """Seconds (strips,) to add to the times of each strip so that no two overlap; lenses of a strip stay together."""
    names = [_file_name(strip) for strip in block.strips]
    spans: dict[str, tuple[float, float]] = {}
    for name, strip in zip(names, block.strips, strict=True):
        ends = [strip.trajectory.start_s, strip.trajectory.end_s]
        if strip.lines:
            ends.extend(strip.time_of(np.array([0.0, strip.lines - 1.0])).tolist())
        low, high = spans.get(name, (np.inf, -np.inf))
        spans[name] = min(low, *ends), max(high, *ends)
    shift: dict[str, float] = {}
    after = max(0.0, -np.floor(min(low for low, _ in spans.values()))) if spans else 0.0
    end = -np.inf
    for name in sorted(spans, key=lambda n: spans[n][0]):
        low, high = spans[name]
        if low + after <= end:
            after += np.ceil(end + GAP_S - low - after)
        shift[name] = after
        end = high + after
    return np.array([shift[name] for name in names])


def _file_name(strip: Strip) -> str:
    return strip.id if strip.lens is None else strip.id.removesuffix(f"/{strip.lens}")


def _ns(block: Block, time_s: Any) -> NDArray[np.int64]:
    """Nanoseconds of times in seconds."""
    t = np.asarray(time_s, dtype=float)
    whole = np.floor(t)
    return block.time_reference_ns + whole.astype(np.int64) * SECOND_NS + np.rint((t - whole) * 1e9).astype(np.int64)


def _project(block: Block) -> Any:
    settings = block.apriori.trajectory
    frame, known = block.frame, _sigmas(block)
    project = m.Project(
        name=block.name,
        crs=frame.crs,
        origin_latitude=frame.lat_deg,
        origin_longitude=frame.lon_deg,
        origin_height=frame.height_m,
        image_sigma_px=block.apriori.image_sigma_px,
    )
    for key, values in known.items():
        getattr(project, key).extend(values)
    if "wander_time_s" in settings:
        project.wander_time_s = float(np.asarray(settings["wander_time_s"], dtype=float))
    return project


def _sigmas(block: Block) -> dict[str, list[float]]:
    """A-priori sigmas of the trajectory; shift, offset and drift by default where the project gives none."""
    settings = block.apriori.trajectory
    dgr = DgrOptions.from_settings(settings)
    given = {key: settings[key] for key in _SIGMAS if key in settings}
    given |= {key: getattr(dgr, key) for key in _SIGMAS[:3]}
    return {key: np.broadcast_to(np.asarray(value, dtype=float), 3).tolist() for key, value in given.items()}


def _pose_covariance(block: Block) -> NDArray[np.float64]:
    """(6, 6) of each pose: all that is told to be wrong with the trajectory, taken together."""
    known = {key: np.square(values) for key, values in _sigmas(block).items()}
    position = known["offset_sigma_m"] + known.get("wander_sigma_m", 0.0)
    attitude = known["shift_sigma_deg"] + known["drift_sigma_deg"] + known.get("wander_sigma_deg", 0.0)
    return np.diag(np.concatenate([position, attitude * np.radians(1.0) ** 2]))


def _strip_messages(block: Block, shift: NDArray[np.float64], source: str) -> Iterator[Message]:
    for strip, seconds in zip(block.strips, shift, strict=True):
        trajectory = strip.trajectory
        time_ns = _ns(block, trajectory.time_s + seconds)
        first_line = int(_ns(block, strip.time_of(np.zeros(1)) + seconds)[0])
        # a strip ends after its last pose and line, whose looks may come with that very stamp
        last_line = int(_ns(block, strip.time_of(np.array([max(strip.lines - 1.0, 0.0)])) + seconds)[0])
        start, end = min(int(time_ns[0]), first_line), max(int(time_ns[-1]), last_line) + 1
        for stamp, ended in ((start, False), (end, True)):
            body = m.Strip(
                id=strip.id,
                first_line_time_ns=first_line,
                line_rate_hz=strip.line_rate_hz,
                lines=strip.lines,
                ended=ended,
            )
            yield Message("configuration/strip", stamp, body, source)
        angles = angles_from_matrix(matrix_from_quaternion(trajectory.quaternion))
        velocity = trajectory.at(trajectory.time_s).velocity_l
        covariance = _pose_covariance(block)
        for i, stamp in enumerate(time_ns.tolist()):
            body = pose_message(
                stamp,
                trajectory.position_l[i],
                angles[i],
                covariance,
                quaternion=trajectory.quaternion[i],
                strip=strip.id,
                velocity_l=velocity[i],
            )
            yield Message("trajectory/smoothed", stamp, body, source)


def _tie_messages(block: Block, shift: NDArray[np.float64], source: str) -> Iterator[Message]:
    """One message a point and strip; rays of unknown strips, which have no time, come when the last strip ends."""
    image = block.image
    if not len(image):
        return
    known = image.strip >= 0
    time_ns = np.zeros(len(image), dtype=np.int64)
    time_ns[known] = _ns(block, image.time_s[known] + shift[image.strip[known]])
    trajectories = [strip.trajectory.end_s for strip in block.strips]
    last = int(_ns(block, np.array(trajectories) + shift).max()) + 1
    order = np.lexsort((time_ns, image.strip, image.point))
    key = np.stack([image.point[order], image.strip[order]])
    first = np.flatnonzero(np.concatenate([[True], (np.diff(key, axis=1) != 0).any(axis=0)]))
    for rows in np.split(order, first[1:]):
        looks = []
        for row in rows.tolist():
            _, strip, ccd = block.image_name(row)
            looks.append(
                m.ImagePoint(
                    strip=block.strips[image.strip[row]].id if known[row] else strip,
                    ccd=ccd,
                    line=image.line[row],
                    sample=image.sample[row],
                    sigma_line=image.sigma_px[row],
                    sigma_sample=image.sigma_px[row],
                    time_ns=int(time_ns[row]),
                )
            )
        stamp = int(time_ns[rows[-1]]) if known[rows[-1]] else last
        body = m.TiePoint(point=block.point_ids[image.point[rows[0]]], images=looks)
        yield Message("observation/tie", stamp, body, source)


@dataclass
class _Collected:
    """What the messages of a flight hold, before it becomes arrays."""

    project: Any = None
    camera: Any = None
    strips: dict[str, Any] = field(default_factory=dict)
    ground: dict[str, Any] = field(default_factory=dict)
    ties: list[tuple[str, Any]] = field(default_factory=list)
    poses: dict[str, list[tuple[int, str, Any]]] = field(default_factory=dict)

    def add(self, message: Message) -> None:
        body = message.body
        if message.topic == "configuration/project":
            self.project = self.project or body
        elif message.topic == "configuration/camera":
            self.camera = body
        elif message.topic == "configuration/strip":
            self.strips[body.id] = body
        elif message.topic == "observation/control":
            self.ground[body.point] = body
        elif message.topic == "observation/tie":
            self.ties.extend((body.point, image) for image in body.images)
        elif message.topic in ("trajectory/filtered", "trajectory/smoothed"):
            stamp = body.timestamp.seconds * SECOND_NS + body.timestamp.nanos
            self.poses.setdefault(message.topic, []).append((stamp, body.strip, body.pose))


def block_from_messages(messages: Iterable[Message], name: str) -> Block:
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
    poses = found.poses.get("trajectory/smoothed") or found.poses.get("trajectory/filtered")
    if not poses:
        raise UserError(
            f"{name}: no message on trajectory/smoothed or trajectory/filtered; run `triline process` first?"
        )
    try:
        camera = camera_from(found.camera)
    except ValueError as error:
        raise UserError(f"{name}: configuration/camera: {error}") from None
    project = found.project or m.Project(name=name)
    notes: list[str] = []
    poses.sort(key=lambda pose: pose[0])
    # times near the start of the epoch are those of a project; others lose digits unless they count from their start
    reference = 0 if poses[-1][0] < 10**8 * SECOND_NS else poses[0][0] // SECOND_NS * SECOND_NS
    strips = _strips_of(found, poses, reference, notes, {lens.id for lens in camera.lenses})
    if not strips:
        raise UserError(f"{name}: no strip with a trajectory; {notes[0] if notes else ''}")
    settings: dict[str, object] = {key: tuple(getattr(project, key)) for key in _SIGMAS if getattr(project, key)}
    if project.wander_time_s:
        settings["wander_time_s"] = project.wander_time_s
    apriori = Apriori(project.image_sigma_px or Apriori.image_sigma_px, settings)
    ground = _ground_of(found, notes)
    point_ids, image = _image_of(found, camera, strips, ground, apriori)
    frame = local_frame(project)
    return Block(
        project.name or name, frame, camera, strips, point_ids, ground, image, apriori, tuple(notes), reference
    )


def _strips_of(
    found: _Collected, poses: list[tuple[int, str, Any]], reference: int, notes: list[str], lenses: set[str]
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
        p = [poses[row][2] for row in rows]
        trajectory = Trajectory(
            (time_ns[rows] - reference) * 1e-9,
            [(q.position.x, q.position.y, q.position.z) for q in p],
            [(q.orientation.x, q.orientation.y, q.orientation.z, q.orientation.w) for q in p],
        )
        lens = id.rpartition("/")[2] if "/" in id else None
        strips.append(Strip(id, trajectory, first, rate, lines, lens=lens if lens in lenses else None))
    return tuple(strips)


def _ground_of(found: _Collected, notes: list[str]) -> GroundPoints:
    ids, xyz, covariance, roles = [], [], [], []
    for id, body in found.ground.items():
        if len(body.covariance) != 9 or not np.isfinite([body.x, body.y, body.z, *body.covariance]).all():
            notes.append(f"ground point {id} has no usable covariance or coordinates and was left out")
            continue
        ids.append(id)
        xyz.append((body.x, body.y, body.z))
        covariance.append(np.reshape(body.covariance, (3, 3)))
        roles.append(role_of(body))
    return GroundPoints(tuple(ids), np.array(xyz).reshape(-1, 3), np.array(covariance).reshape(-1, 3, 3), tuple(roles))


def _image_of(
    found: _Collected, camera: Any, strips: tuple[Strip, ...], ground: GroundPoints, apriori: Apriori
) -> tuple[tuple[str, ...], ImagePoints]:
    ids = {id: i for i, id in enumerate(ground.id)}
    place = {strip.id: i for i, strip in enumerate(strips)}
    n = len(found.ties)
    index = np.empty((3, n), dtype=np.int64)
    value = np.empty((3, n))
    unknown: dict[int, tuple[str, str]] = {}
    for i, (point, image) in enumerate(found.ties):
        index[:, i] = ids.setdefault(point, len(ids)), place.get(image.strip, -1), camera.line_index.get(image.ccd, -1)
        value[:, i] = image.line, image.sample, max(image.sigma_line, image.sigma_sample) or apriori.image_sigma_px
        if index[1:, i].min() < 0:
            unknown[i] = (image.strip, image.ccd)
    time = np.full(n, np.nan)
    for i, strip in enumerate(strips):
        mine = index[1] == i
        time[mine] = strip.time_of(value[0, mine])
    line, sample, sigma = value
    return tuple(ids), ImagePoints(index[0], index[1], index[2], line, sample, sigma, time, unknown)
