"""ROS 2 bags: ``sensor_msgs/msg/NavSatFix``, ``Imu`` and ``Image`` (`ros2_images`), decoded by rosbags.

ROS bodies are forward-left-up against east-north-up (REP 103); ours are forward-right-down against north-east-down.

Bag folders and ``.db3`` files are read by rosbags. An MCAP file is read by `RecordingReader`, because rosbags refuses a
file that was cut off, or one of another profile, and stops at the first damaged chunk.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from functools import partial
from heapq import merge
from itertools import chain, islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...schemas import messages as m
from ...schemas.groups import grouped
from ...schemas.topics import rank
from ...solver.geometry.rotation import R_ENU_NED, matrix_from_quaternion, navigation_from_matrix
from ...solver.navigation.inertial_data import GAP_FACTOR
from ..convert import attitude_message, check_angles, check_inertial, check_place, gnss_message
from ..errors import UserError
from ..node import Message
from ..recording.reader import RecordingReader
from .ros2_decoding import FIX, decoded
from .ros2_images import ALL_IMAGES, IMAGE, ImageTopics, ccd_lines, image_messages

Array = NDArray[np.floating]

IMU = "sensor_msgs/msg/Imu"
#: Taken where a message says that its covariance is not known.
FIX_SIGMA_M = (5.0, 5.0, 10.0)
ATTITUDE_SIGMA_RAD = (0.01, 0.01, 0.03)
#: What is counted of messages whose values nodes would refuse, as of other sensors.
IMPOSSIBLE = "with values that no aircraft has"
#: Of the orientation alone; a quaternion of zeros, or the one that a message begins with, without a covariance, is how
#: some say that they measure none.
NO_ROTATION = "with an orientation whose quaternion has not the length 1"
_FLU_FRD = np.array([1.0, -1.0, -1.0])
_DIAGONAL = [0, 4, 8]
#: Inertial samples that are converted at once.
_BATCH = 4096
#: So many steps between the newest inertial messages tell what is usual, as soon as there are the least of them; of
#: these the longest may be where messages were lost.
_STEPS, _LEAST_STEPS, _LOST_STEPS = 31, 16, 2


class _McapBag:
    """An MCAP file, whole or damaged."""

    def __init__(self, path: Path, notes: list[str]) -> None:
        self._reader = RecordingReader(path)
        self._channels = list(self._reader.channels.values())
        if any(channel.known for channel in self._channels):
            raise UserError(f"{path}: is a triline recording already")
        notes += [f"{path.name}: damaged, {damage}" for damage in self._reader.damage[:3]]
        self.topics: Counter[tuple[str, str]] = Counter()
        for channel in self._channels:
            self.topics[channel.topic, channel.type_name] += int((self._reader.index.channel == channel.id).sum())

    def payloads(self, topic: str, kind: str) -> Iterator[bytes | memoryview]:
        ids = [channel.id for channel in self._channels if (channel.topic, channel.type_name) == (topic, kind)]
        for number in np.flatnonzero(np.isin(self._reader.index.channel, ids)):
            yield self._reader.raw(int(number)).data


class _RosbagsBag:
    """A bag folder or a ``.db3`` file."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self.topics: Counter[tuple[str, str]] = Counter()
        with self._opened() as bag:
            for connection in bag.connections:
                self.topics[connection.topic, connection.msgtype] += connection.msgcount

    def payloads(self, topic: str, kind: str) -> Iterator[bytes]:
        with self._opened() as bag:
            chosen = [c for c in bag.connections if (c.topic, c.msgtype) == (topic, kind)]
            yield from (data for _, _, data in bag.messages(chosen))

    @contextmanager
    def _opened(self) -> Iterator[Any]:
        from rosbags.rosbag2 import Reader

        try:
            with Reader(self._path) as bag:
                yield bag
        except Exception as error:  # errors of SQLite, YAML and compression come through rosbags as they are
            raise UserError(f"{self._path}: not a whole ROS 2 bag: {error}") from None


def ros2_messages(
    path: Path, notes: list[str], source: str = "import", given: ImageTopics = ALL_IMAGES
) -> Iterator[Message]:
    """What a bag holds of a flight, sorted by stamp and rank.

    ``configuration/project``, ``sensor/gnss``, ``sensor/imu`` and ``sensor/attitude``, and of images
    ``configuration/strip`` and ``sensor/lines/*``.

    Parameters
    ----------
    path : bag folder, ``.db3`` file or MCAP file
    notes : gets what is not imported. Where several topics have the same type, the one with most messages is taken; of
        images all whose CCD line is known. Messages that cannot be decoded, fixes without a fix and times that do not
        come after the one before are left out and counted.
    given : which topics are image lines

    Raises
    ------
    UserError : not a bag that can be read, nothing in it that can be used, or from `image_messages`
    """
    bag = _RosbagsBag(path) if path.is_dir() or path.suffix == ".db3" else _McapBag(path, notes)
    chosen = {}
    for (topic, kind), count in bag.topics.most_common():
        if kind in (FIX, IMU) and count:
            chosen.setdefault(kind, topic)
    others = [
        f"{count} {kind} of {topic}"
        for (topic, kind), count in sorted(bag.topics.items())
        if count and kind != IMAGE and chosen.get(kind) != topic
    ]
    if others:
        notes.append(f"{path.name}: not imported: {', '.join(others)}")
    images = {topic: count for (topic, kind), count in sorted(bag.topics.items()) if kind == IMAGE and count}
    views = ccd_lines(path, images, given, notes)
    if views and given.camera is None:
        notes.append("no camera given (--camera): recorded without configuration/camera, image lines cannot be matched")
    fixes = fix_messages(bag.payloads(chosen[FIX], FIX), chosen[FIX], notes, source) if FIX in chosen else iter(())
    inertial: Iterator[Message] = iter(())
    if IMU in chosen:
        inertial = inertial_messages(bag.payloads(chosen[IMU], IMU), chosen[IMU], notes, source)
    fix = next(fixes, None)
    readers = {ccd: partial(bag.payloads, topic, IMAGE) for ccd, topic in views.items()}
    messages = merge(
        chain([] if fix is None else [fix], fixes),
        inertial,
        image_messages(path, readers, given, notes, source),
        key=lambda message: (message.stamp_ns, rank(message.topic)),
    )
    first = next(messages, None)
    if first is None:
        raise UserError("; ".join([f"{path}: no usable {FIX}, {IMU} or {IMAGE}", *notes]))
    project = m.Project(name=path.stem, crs="local")
    if fix is not None:
        project.origin_latitude, project.origin_longitude = round(fix.body.latitude, 6), round(fix.body.longitude, 6)
    else:
        notes.append(f"{path.name}: no GNSS fix, so the origin of the local frame is not known")
    yield Message("configuration/project", first.stamp_ns, project, source)
    yield first
    yield from messages


def fix_messages(
    payloads: Iterable[bytes | memoryview],
    topic: str,
    notes: list[str],
    source: str,
    left_out: Counter[str] | None = None,
) -> Iterator[Message]:
    """``sensor/gnss`` of each NavSatFix in CDR; ``left_out``, of a live topic, counts those that cannot be used."""
    live, left_out = left_out is not None, Counter() if left_out is None else left_out
    nominal = 0
    for time_ns, fix in decoded(payloads, FIX, left_out, live):
        variance = fix.position_covariance[_DIAGONAL]
        known = fix.position_covariance_type != 0 and np.isfinite(variance).all() and (variance > 0).all()
        place, sigma = (fix.latitude, fix.longitude, fix.altitude), np.sqrt(variance) if known else FIX_SIGMA_M
        if not _passes(check_place, *place):
            left_out[IMPOSSIBLE] += 1
            continue
        nominal += not known
        yield Message("sensor/gnss", time_ns, gnss_message(time_ns, place, sigma), source)
    _note(notes, topic, left_out)
    if nominal:
        taken = f"{FIX_SIGMA_M[0]:g} m and {FIX_SIGMA_M[2]:g} m in height"
        notes.append(f"{topic}: fixes without covariance: {nominal}, taken with sigmas of {taken}")


def inertial_messages(
    payloads: Iterable[bytes | memoryview],
    topic: str,
    notes: list[str],
    source: str,
    left_out: Counter[str] | None = None,
    at_once: int = _BATCH,
) -> Iterator[Message]:
    """``sensor/imu`` and ``sensor/attitude`` of each Imu in CDR, so many ``at_once``.

    A covariance that begins with -1 marks values that a message lacks. ``left_out``, of a live topic, counts messages
    that cannot be used. Messages do not say how long they measured: from the one before on, but not over lost ones.
    """
    live, left_out = left_out is not None, Counter() if left_out is None else left_out
    samples = decoded(payloads, IMU, left_out, live)
    last, nominal, steps = None, 0, deque[int](maxlen=_STEPS)
    while batch := list(islice(samples, at_once)):
        time_ns = [time for time, _ in batch]
        step_ns = np.diff(time_ns, prepend=time_ns[0] if last is None else last).tolist()
        interval_ns = [_interval_ns(step, steps) for step in step_ns]
        last = time_ns[-1]
        read = [sample for _, sample in batch]
        force = _FLU_FRD * [(v.x, v.y, v.z) for v in (s.linear_acceleration for s in read)]
        rate = _FLU_FRD * [(v.x, v.y, v.z) for v in (s.angular_velocity for s in read)]
        force_variance = np.array([s.linear_acceleration_covariance for s in read])[:, _DIAGONAL]
        rate_variance = np.array([s.angular_velocity_covariance for s in read])[:, _DIAGONAL]
        measured = (force_variance[:, 0] != -1) & (rate_variance[:, 0] != -1)
        angles, sigma, oriented, assumed, bent = _attitudes(read)
        if bent:
            left_out[NO_ROTATION] += bent
        columns = (force, rate, _sigma(force_variance), _sigma(rate_variance))
        for k, (time, interval, f, w, force_sigma, rate_sigma) in enumerate(
            zip(time_ns, interval_ns, *(column.tolist() for column in columns), strict=True)
        ):
            # a first sample has no interval yet
            if measured[k] and not _passes(check_inertial, interval or 1, tuple(f), tuple(w)):
                left_out[IMPOSSIBLE] += 1
            elif measured[k]:
                body = grouped(m.Imu)(
                    time_ns=time, interval_ns=interval, force_x=f[0], force_y=f[1], force_z=f[2],
                    rate_x=w[0], rate_y=w[1], rate_z=w[2], force_sigma=force_sigma, rate_sigma=rate_sigma,
                )  # fmt: skip
                yield Message("sensor/imu", time, body, source)
            if oriented[k] and not _passes(check_angles, *angles[k].tolist()):
                left_out[IMPOSSIBLE] += 1
            elif oriented[k]:
                nominal += int(assumed[k])
                yield Message("sensor/attitude", time, attitude_message(time, angles[k], sigma[k]), source)
    _note(notes, topic, left_out)
    if nominal:
        east, _, heading = np.degrees(ATTITUDE_SIGMA_RAD)
        taken = f"{east:.1f} deg and {heading:.1f} deg in heading"
        notes.append(f"{topic}: orientations without covariance: {nominal}, taken with sigmas of {taken}")


def _interval_ns(step_ns: int, steps: deque[int]) -> int:
    """How long a sample measured, by its distance from the one before, which is added to those of ``steps``.

    Where that is longer than they are, messages were lost, and what was measured then is not known. Distances of those
    that come in bursts are not equal.
    """
    usual = sorted(steps)[:-_LOST_STEPS] if len(steps) >= _LEAST_STEPS else []
    if step_ns > 0:  # the first sample has none
        steps.append(step_ns)
    return round(sum(usual) / len(usual)) if usual and step_ns > GAP_FACTOR * usual[-1] else step_ns


def _attitudes(samples: list[Any]) -> tuple[Array, Array, NDArray[np.bool_], NDArray[np.bool_], int]:
    """Roll, pitch, heading (n, 3) and their sigmas (n, 3), rad; which samples have them; which sigmas are assumed;
    and of how many samples the quaternion is no rotation."""
    q = np.array([(v.x, v.y, v.z, v.w) for v in (s.orientation for s in samples)])
    variance = np.array([s.orientation_covariance for s in samples])[:, _DIAGONAL]
    with np.errstate(over="ignore"):
        length = np.linalg.norm(q, axis=1)
    untouched = (q == [0.0, 0.0, 0.0, 1.0]).all(axis=1) & (variance == 0.0).all(axis=1)  # as a message begins
    stated = (variance[:, 0] != -1) & (length != 0.0) & ~untouched
    oriented = stated & (np.abs(length - 1.0) < 1e-3)
    q[~oriented] = 0.0, 0.0, 0.0, 1.0
    R_nb = R_ENU_NED.T @ matrix_from_quaternion(q) * _FLU_FRD
    known = np.all((variance > 0) & np.isfinite(variance), axis=1)
    sigma = np.where(known[:, None], np.sqrt(np.where(known[:, None], variance, 0.0)), ATTITUDE_SIGMA_RAD)
    return navigation_from_matrix(R_nb), sigma, oriented, oriented & ~known, int((stated & ~oriented).sum())


def _passes(check: Callable[..., None], *values: Any) -> bool:
    """Whether values are such as an aircraft has."""
    try:
        check(*values)
    except ValueError:
        return False
    return True


def _sigma(variance: Array) -> Array:
    """One sigma (n,) from the variances (n, 3) of three axes, 0 where they are not given."""
    with np.errstate(over="ignore", invalid="ignore"):
        mean = variance.mean(axis=1)
    return np.sqrt(np.where(np.isfinite(mean) & (mean > 0), mean, 0.0))


def _note(notes: list[str], topic: str, left_out: Counter[str]) -> None:
    if left_out:
        notes.append(f"{topic}: messages left out: {', '.join(f'{n} {why}' for why, n in sorted(left_out.items()))}")
