"""ROS 2 recordings (MCAP): ``sensor_msgs/msg/NavSatFix`` and ``sensor_msgs/msg/Imu``, decoded from CDR.

ROS bodies are forward-left-up against east-north-up (REP 103); ours are forward-right-down against north-east-down.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ...schemas import messages as m
from ...schemas.topics import rank
from ...solver.rotation import R_ENU_NED, matrix_from_quaternion, navigation_from_matrix
from ..convert import SECOND_NS, attitude_message, gnss_message
from ..errors import UserError
from ..node import Message
from ..recording import RecordingReader

FIX, IMU = "sensor_msgs/msg/NavSatFix", "sensor_msgs/msg/Imu"
#: Taken where a message says that its covariance is not known.
FIX_SIGMA_M = (5.0, 5.0, 10.0)
ATTITUDE_SIGMA_RAD = (0.01, 0.01, 0.03)
_FLU_FRD = np.diag([1.0, -1.0, -1.0])


@dataclass(frozen=True)
class _Header:
    time_ns: int
    frame_id: str


class _Cdr:
    """Reads one CDR message: numbers stand at multiples of their size behind the four bytes of encapsulation."""

    def __init__(self, data: bytes | memoryview):
        self.data = memoryview(data)
        if len(self.data) < 4 or self.data[0] != 0 or self.data[1] > 1:
            raise ValueError("not plain CDR")
        self.order = "<" if self.data[1] == 1 else ">"
        self.place = 4

    def take(self, kind: str, count: int = 1) -> tuple[Any, ...]:
        size = struct.calcsize(kind)
        self.place += -(self.place - 4) % size
        values = struct.unpack_from(f"{self.order}{count}{kind}", self.data, self.place)
        self.place += size * count
        return values

    def header(self) -> _Header:
        (sec,), (nanosec,) = self.take("i"), self.take("I")
        (length,) = self.take("I")
        text = bytes(self.data[self.place : self.place + length])
        self.place += length
        return _Header(sec * SECOND_NS + nanosec, text.rstrip(b"\0").decode(errors="replace"))


def is_ros2(reader: RecordingReader) -> bool:
    """Whether a recording has topics of the two ROS 2 types."""
    return any(channel.type_name in (FIX, IMU) for channel in reader.channels.values())


def ros2_messages(reader: RecordingReader, notes: list[str], source: str = "import") -> Iterator[Message]:
    """``configuration/project``, ``sensor/gnss``, ``sensor/imu`` and ``sensor/attitude``, sorted by stamp and rank.

    Where several topics have the same type, the one with most messages is taken. Messages that cannot be decoded, fixes
    without a fix and times that do not come after the one before are left out and counted in ``notes``.

    Raises
    ------
    UserError : no NavSatFix and no Imu that can be used
    """
    path = Path(reader.path)
    messages: list[Message] = []
    for kind, decode in ((FIX, _fix_messages), (IMU, _imu_messages)):
        channels = [channel for channel in reader.channels.values() if channel.type_name == kind]
        if not channels:
            continue
        by_topic: dict[str, int] = {}
        for channel in channels:
            count = int((reader.index.channel == channel.id).sum())
            by_topic[channel.topic] = by_topic.get(channel.topic, 0) + count
        topic = max(by_topic, key=lambda t: by_topic[t])
        others = sorted(set(by_topic) - {topic})
        if others:
            notes.append(f"{path.name}: {kind} taken from {topic}, not from {', '.join(others)}")
        ids = [channel.id for channel in channels if channel.topic == topic]
        numbers = np.flatnonzero(np.isin(reader.index.channel, ids))
        messages.extend(decode((reader.raw(int(i)).data for i in numbers), source, topic, notes))
    if not messages:
        raise UserError(f"{path}: no usable {FIX} or {IMU}")
    messages.sort(key=lambda message: (message.stamp_ns, rank(message.topic)))
    fixes = [message.body for message in messages if message.topic == "sensor/gnss"]
    project = m.Project(name=path.stem, crs="local")
    if fixes:
        project.origin_latitude, project.origin_longitude = (
            round(v, 6) for v in (fixes[0].latitude, fixes[0].longitude)
        )
    else:
        notes.append(f"{path.name}: no GNSS fix, the local frame has no place on Earth")
    yield Message("configuration/project", messages[0].stamp_ns, project, source)
    yield from messages


def _fix_messages(
    payloads: Iterator[bytes | memoryview], source: str, topic: str, notes: list[str]
) -> Iterator[Message]:
    last, broken, late, without, nominal = -1, 0, 0, 0, 0
    for payload in payloads:
        try:
            cdr = _Cdr(payload)
            header = cdr.header()
            (status,), _ = cdr.take("b"), cdr.take("H")
            place = cdr.take("d", 3)
            covariance = np.reshape(cdr.take("d", 9), (3, 3))
            (covariance_type,) = cdr.take("B")
        except (ValueError, struct.error):
            broken += 1
            continue
        if status < 0 or not np.isfinite(place).all():
            without += 1
            continue
        if header.time_ns <= last:
            late += 1
            continue
        last = header.time_ns
        variance = np.diagonal(covariance)
        known = covariance_type != 0 and np.isfinite(variance).all() and (variance > 0).all()
        nominal += not known
        sigma = np.sqrt(variance) if known else np.array(FIX_SIGMA_M)
        yield Message("sensor/gnss", header.time_ns, gnss_message(header.time_ns, place, sigma), source)
    _count(notes, topic, {"not CDR": broken, "without a fix": without, "not after the one before": late})
    if nominal:
        notes.append(
            f"{topic}: {nominal} fixes without covariance, taken as {FIX_SIGMA_M[0]:g} m and {FIX_SIGMA_M[2]:g} m"
        )


def _imu_messages(
    payloads: Iterator[bytes | memoryview], source: str, topic: str, notes: list[str]
) -> Iterator[Message]:
    last, broken, late, nominal = -1, 0, 0, 0
    for payload in payloads:
        try:
            cdr = _Cdr(payload)
            header = cdr.header()
            quaternion, cov_q = np.array(cdr.take("d", 4)), cdr.take("d", 9)
            rate, cov_rate = np.array(cdr.take("d", 3)), cdr.take("d", 9)
            force, cov_force = np.array(cdr.take("d", 3)), cdr.take("d", 9)
        except (ValueError, struct.error):
            broken += 1
            continue
        if header.time_ns <= last:
            late += 1
            continue
        interval = header.time_ns - last if last >= 0 else 0
        last = header.time_ns
        if cov_rate[0] != -1 and cov_force[0] != -1:
            f, w = _FLU_FRD @ force, _FLU_FRD @ rate
            body = m.Imu(
                time_ns=last, interval_ns=interval,
                force_x=f[0], force_y=f[1], force_z=f[2], rate_x=w[0], rate_y=w[1], rate_z=w[2],
                force_sigma=_sigma(cov_force), rate_sigma=_sigma(cov_rate),
            )  # fmt: skip
            yield Message("sensor/imu", last, body, source)
        if cov_q[0] != -1 and abs(float(np.linalg.norm(quaternion)) - 1.0) < 1e-3:
            R_nb = R_ENU_NED.T @ matrix_from_quaternion(quaternion / np.linalg.norm(quaternion)) @ _FLU_FRD
            known = all(cov_q[i] > 0 for i in (0, 4, 8))
            nominal += not known
            sigma = np.sqrt([cov_q[0], cov_q[4], cov_q[8]]) if known else np.array(ATTITUDE_SIGMA_RAD)
            yield Message("sensor/attitude", last, attitude_message(last, navigation_from_matrix(R_nb), sigma), source)
    _count(notes, topic, {"not CDR": broken, "not after the one before": late})
    if nominal:
        notes.append(f"{topic}: {nominal} orientations without covariance, taken as 0.6 and 1.7 deg")


def _sigma(covariance: tuple[float, ...]) -> float:
    """One sigma of a 3 x 3 covariance, 0 if it is not given."""
    mean = (covariance[0] + covariance[4] + covariance[8]) / 3
    return float(np.sqrt(mean)) if np.isfinite(mean) and mean > 0 else 0.0


def _count(notes: list[str], topic: str, left_out: dict[str, int]) -> None:
    notes.extend(f"{topic}: {count} messages left out: {why}" for why, count in left_out.items() if count)
