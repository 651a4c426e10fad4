"""A block as the messages of a flight, in the order in which an on-line system would receive them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from heapq import merge
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...schemas import messages as m
from ...schemas.groups import grouped
from ...schemas.topics import rank
from ...solver.adjustment.block_data import BlockData
from ...solver.adjustment.network import Strip
from ...solver.geometry.measured_trajectory import POSE_GAP_S
from ...solver.geometry.rotation import angles_from_matrix, matrix_from_quaternion, quaternion_from_matrix
from ...solver.geometry.trajectory import Trajectory
from ...solver.models import WANDER_TIMES
from ...solver.models.dgr import DgrOptions
from ..convert import SECOND_NS, camera_message, ground_point_message, largest_step_ns, pose_message
from ..first_of import first_of
from ..node import Message

#: Time between strips whose times overlap in the files, after they are shifted, s.
GAP_S = 10.0
#: Poses that are put in between are so far apart, s; over longer steps than a minute there are none.
FILLED_S, LONGEST_FILLED_S = 0.1, 60.0
#: Strips that a note names.
MOST_NAMED = 3
#: A-priori sigmas of the trajectory that a project message carries.
SIGMAS = ("offset_sigma_m", "shift_sigma_deg", "drift_sigma_deg", "wander_sigma_m", "wander_sigma_deg")


def block_messages(block: BlockData, source: str = "import") -> Iterator[Message]:
    """All messages of a block, sorted by stamp and rank.

    Time in the files counts from the Unix epoch. Strips whose times overlap are shifted by whole seconds, so that one
    follows the other. Configuration and control come first. A pose has the time it is valid for; where they are too far
    apart for an on-line adjustment, there are others in between (`filled`). The image points of an object point come
    strip by strip, at the time when the last of them in the strip was imaged.
    """
    times = _Times(block)
    start = min((begin for begin, _ in times.extents), default=0)
    first = [
        Message("configuration/project", start, _project(block), source),
        Message("configuration/camera", start, camera_message(block.camera), source),
    ]
    ground = block.ground
    radius = ground.target_radius_m or (0.0,) * len(ground.id)
    columns = ground.id, ground.xyz_l, ground.covariance, ground.role, radius
    for id, xyz, covariance, role, target_radius_m in zip(*columns, strict=True):
        body = ground_point_message(id, xyz, covariance, role, target_radius_m)
        first.append(Message("observation/control", start, body, source))
    streams: list[Iterable[Message]] = [first, _tie_messages(block, times, source)]
    for i in range(len(block.strips)):
        streams += [_pass_messages(block, times, i, source), _pose_messages(block, times, i, source)]
    yield from merge(*streams, key=lambda message: (message.stamp_ns, rank(message.topic)))


def not_carried(block: BlockData) -> list[str]:
    """The parts of a block that messages cannot hold, and what they hold instead, a line each."""
    notes = []
    keys = [key for key in block.apriori.trajectory if key not in (*SIGMAS, *WANDER_TIMES)]
    keys += [f"then.{key}" for key in block.apriori.then]
    if keys:
        notes.append(f"project.toml: trajectory.{', trajectory.'.join(keys)}: not carried by a recording")
    for strip in block.strips:
        if strip.line_time_s is not None:
            u = np.arange(len(strip.line_time_s))
            rate = strip.line_rate_hz
            off = float(np.abs((strip.line_time_s - strip.line_time_s[0]) * rate - u).max())
            notes.append(
                f"strip {strip.id}: its line times are off a constant rate by {off:.2f} lines at most: image points "
                "keep theirs, the strip has the rate"
            )
        if not strip.lines:
            notes.append(
                f"strip {strip.id}: number of lines not known, taken as the {lines_of(strip)} under its trajectory"
            )
    for strip in block.strips:
        more = len(filled(strip.trajectory)) - len(strip.trajectory)
        if more > len(strip.trajectory):
            usual = float(np.median(np.diff(strip.trajectory.time_s)))
            notes.append(
                f"strip {strip.id}: poses are {usual:.3g} s apart: {more} interpolated ones are put in between"
            )
    shift = strip_shifts(block)
    moved = shift - min(shift, default=0.0)
    later = [f"{strip.id} by {by:.0f} s" for strip, by in zip(block.strips, moved.tolist(), strict=True) if by]
    if later:
        notes.append(
            "times of strips overlap: the recording, and all that is made of it, has strips later than the files do: "
            + first_of(later, MOST_NAMED)
        )
    return notes


def lines_of(strip: Strip) -> int:
    """Number of lines of a strip; where it is not known, that of the lines that its trajectory goes on over."""
    if strip.lines:
        return strip.lines
    last = (strip.trajectory.end_s - strip.first_line_time_s) * strip.line_rate_hz
    return max(int(np.floor(last + 1e-6)) + 1, 0)  # the end may be the time of a line


def strip_shifts(block: BlockData) -> NDArray[np.float64]:
    """Seconds (strips,) to add to the times of each strip so that no two trajectories overlap.

    Lenses that share a trajectory come one after the other, too, as an on-line adjustment takes them.
    """
    spans = []
    for strip in block.strips:
        ends = [strip.trajectory.start_s, strip.trajectory.end_s]
        if strip.lines:
            ends.extend(strip.time_of(np.array([0.0, strip.lines - 1.0])).tolist())
        spans.append((min(ends), max(ends)))
    shift = np.zeros(len(spans))
    after = max(0.0, -np.floor(min(low for low, _ in spans))) if spans else 0.0
    end = -np.inf
    for i in sorted(range(len(spans)), key=lambda i: spans[i][0]):
        low, high = spans[i]
        if low + after <= end:
            after += np.ceil(end + GAP_S - low - after)
        shift[i] = after
        end = high + after
    return shift


class _Times:
    """Times of a block as stamps.

    Attributes
    ----------
    shift : (strips,) seconds added to the times of each strip
    extents : begin and end of each strip, ns; it ends after its last pose and line, at which image points may stand
    """

    def __init__(self, block: BlockData):
        self._reference_ns = block.time_reference_ns
        self.shift = strip_shifts(block)
        self.extents: list[tuple[int, int]] = []
        for strip, seconds in zip(block.strips, self.shift, strict=True):
            lines = strip.time_of(np.array([0.0, max(strip.lines - 1.0, 0.0)]))
            both = self.ns(np.array([strip.trajectory.start_s, strip.trajectory.end_s, *lines]) + seconds)
            self.extents.append((int(both.min()), int(both.max()) + 1))

    def ns(self, time_s: Any) -> NDArray[np.int64]:
        """Stamps of shifted times in seconds."""
        t = np.asarray(time_s, dtype=float)
        whole = np.floor(t)
        return self._reference_ns + whole.astype(np.int64) * SECOND_NS + np.rint((t - whole) * 1e9).astype(np.int64)

    def of_looks(self, block: BlockData) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """When the image points (n,) were imaged, ns, 0 where that is out of the question; and their stamps: the same
        within their strip, those without strip come last.
        """
        strip, time = block.image.strip, block.image.time_s
        stamps = np.full(len(strip), max(end for _, end in self.extents), dtype=np.int64)
        imaged = np.zeros(len(strip), dtype=np.int64)
        for i, (begin, end) in enumerate(self.extents):
            mine = np.flatnonzero(strip == i)
            low, high = ((edge - self._reference_ns) * 1e-9 for edge in (begin, end))
            shifted = time[mine] + self.shift[i]
            near = np.clip(shifted, low - 1.0, high + 1.0)
            imaged[mine] = np.where(near == shifted, self.ns(near), 0)
            stamps[mine] = np.clip(self.ns(near), begin, end - 1)
        return imaged, stamps


def _project(block: BlockData) -> Any:
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
    for key in WANDER_TIMES:
        if key in settings:
            setattr(project, key, float(np.asarray(settings[key], dtype=float)))
    return project


def _sigmas(block: BlockData) -> dict[str, list[float]]:
    """A-priori sigmas of the trajectory; shift, offset and drift by default where the project gives none."""
    settings = block.apriori.trajectory
    dgr = DgrOptions.from_settings(settings)
    given = {key: settings[key] for key in SIGMAS if key in settings}
    given |= {key: getattr(dgr, key) for key in SIGMAS[:3]}
    return {key: np.broadcast_to(np.asarray(value, dtype=float), 3).tolist() for key, value in given.items()}


def _pose_covariance(block: BlockData) -> NDArray[np.float64]:
    """(6, 6) of each pose: the sum of all a-priori variances that the project states for the trajectory."""
    known = {key: np.square(values) for key, values in _sigmas(block).items()}
    position = known["offset_sigma_m"] + known.get("wander_sigma_m", 0.0)
    attitude = known["shift_sigma_deg"] + known["drift_sigma_deg"] + known.get("wander_sigma_deg", 0.0)
    return np.diag(np.concatenate([position, attitude * np.radians(1.0) ** 2]))


def _pass_messages(block: BlockData, times: _Times, i: int, source: str) -> Iterator[Message]:
    """Begin and end of a strip."""
    strip = block.strips[i]
    first_line = int(times.ns(strip.time_of(np.zeros(1)) + times.shift[i])[0])
    for stamp, ended in zip(times.extents[i], (False, True), strict=True):
        body = m.Strip(
            id=strip.id,
            first_line_time_ns=first_line,
            line_rate_hz=strip.line_rate_hz,
            lines=lines_of(strip),
            ended=ended,
        )
        yield Message("configuration/strip", stamp, body, source)


def _pose_messages(block: BlockData, times: _Times, i: int, source: str) -> Iterator[Message]:
    strip = block.strips[i]
    trajectory = filled(strip.trajectory)
    angles = angles_from_matrix(matrix_from_quaternion(trajectory.quaternion))
    velocity = trajectory.at(trajectory.time_s).velocity_l
    covariance = _pose_covariance(block)
    for k, stamp in enumerate(times.ns(trajectory.time_s + times.shift[i]).tolist()):
        body = pose_message(
            stamp,
            trajectory.position_l[k],
            angles[k],
            covariance,
            quaternion=trajectory.quaternion[k],
            strip="" if block.heading else strip.id,
            velocity_l=velocity[k],
        )
        yield Message("trajectory/smoothed", stamp, body, source)


def filled(trajectory: Trajectory) -> Trajectory:
    """A trajectory whose samples come less often than five times a second with others in between, as a batch adjustment
    interpolates them; none in gaps."""
    time_s = trajectory.time_s
    step = np.diff(time_s)
    longest = min(largest_step_ns(np.rint(time_s * SECOND_NS).astype(np.int64)) / SECOND_NS, LONGEST_FILLED_S)
    thin = (step > POSE_GAP_S) & (step <= longest)
    if not thin.any():
        return trajectory
    number = np.where(thin, np.ceil(step / FILLED_S - 1e-6), 1.0).astype(np.int64)
    place = np.arange(number.sum()) - np.repeat(np.cumsum(number) - number, number)
    times = np.append(np.repeat(time_s[:-1], number) + place * np.repeat(step / number, number), time_s[-1])
    poses = trajectory.at(times)
    return Trajectory(times, poses.position_l, quaternion_from_matrix(poses.R_lc))


def _tie_messages(block: BlockData, times: _Times, source: str) -> Iterator[Message]:
    """One message a point and strip, in order of their stamps."""
    image = block.image
    if not len(image):
        return
    of_sample = image.sigma_px if image.sigma_sample_px is None else image.sigma_sample_px
    imaged, time_ns = times.of_looks(block)
    order = np.lexsort((time_ns, image.strip, image.point))
    key = np.stack([image.point[order], image.strip[order]])
    first = np.flatnonzero(np.concatenate([[True], (np.diff(key, axis=1) != 0).any(axis=0)]))
    after = np.append(first[1:], len(order))
    stamps = time_ns[order[after - 1]]
    for group in np.argsort(stamps, kind="stable"):
        rows = order[first[group] : after[group]]
        body = grouped(m.TiePoint)(point=block.point_ids[image.point[rows[0]]])
        for row in rows.tolist():
            _, strip, ccd = block.image_name(row)
            body.images.add(
                strip=block.strips[image.strip[row]].id if image.strip[row] >= 0 else strip,
                ccd=ccd,
                line=image.line[row],
                sample=image.sample[row],
                sigma_line=image.sigma_px[row],
                sigma_sample=of_sample[row],
                time_ns=int(imaged[row]),
            )
        yield Message("observation/tie", int(stamps[group]), body, source)
