"""Messages to bytes and back, with the checks every receiver makes before a node sees a message."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from functools import cache
from operator import attrgetter
from typing import Any, NamedTuple

import numpy as np
from google.protobuf.message import DecodeError

from . import image_lines, topics
from . import messages as m
from .groups import grouped
from .image_lines import LineBlock

#: type -> field -> how many values it has where it has any.
_SIZES: dict[str, dict[str, int]] = {
    "foxglove.LocationFix": {"position_covariance": 9, "velocity_covariance": 9},
    "foxglove.PoseInFrame": {"covariance": 36, "correction": 6, "angles": 3},
    "triline.Attitude": {"covariance": 9},
    "triline.GroundPoint": {"covariance": 9},
    "triline.ObjectPoint": {"covariance": 9},
    "triline.TargetLook": {"off": 2},
    "triline.Project": dict.fromkeys(
        ("lever_arm_m", "boresight_deg", "offset_sigma_m", "shift_sigma_deg", "drift_sigma_deg", "wander_sigma_m",
         "wander_sigma_deg"), 3,
    ),
}  # fmt: skip


class ImpossibleValues(ValueError):
    """A message that came as it was sent, with values that no publisher may send."""


def encode(body: Any) -> bytes:
    """The payload of a message body (a protobuf message or a `LineBlock`); the same body gives the same bytes."""
    if isinstance(body, LineBlock):
        return body.encode()
    return body.SerializeToString(deterministic=True)


def decode(topic: str, data: bytes | memoryview) -> Any:
    """The body of a payload: a protobuf message, or a `LineBlock` for image lines.

    Raises
    ------
    ImpossibleValues : it holds values no publisher may send (not finite, of the wrong size)
    ValueError : it cannot be decoded
    KeyError : the topic is not in the topic table
    """
    if not len(data) and topics.find(topic).family in (topics.Family.CONFIGURATION, topics.Family.SENSOR):
        raise ValueError(f"empty, wanted a {topics.find(topic).type_name}")
    body = parse(topic, data)
    if not isinstance(body, LineBlock):
        validate(body)
    return body


def parse(topic: str, data: bytes | memoryview) -> Any:
    """The same of a payload that has been checked before.

    Raises
    ------
    ValueError : it cannot be decoded
    KeyError : the topic is not in the topic table
    """
    row = topics.find(topic)
    if row.type is m.RawImage:
        return image_lines.decode(data)
    try:
        return grouped(row.type).from_bytes(data)
    except DecodeError as error:
        raise ValueError(f"not a {row.type_name}: {error}") from None


class _Numbers(NamedTuple):
    """Where a message type has numbers, itself or in the messages that it always has: what gets fields of one, and of
    many with how many there may be (0: any); and what gets lists of messages."""

    single: Callable[[Any], Iterable[float]]
    many: tuple[tuple[Callable[[Any], Any], int], ...]
    messages: tuple[Callable[[Any], Any], ...]


@cache
def _numbers_of(cls: Any) -> _Numbers:
    single: list[str] = []
    many: list[tuple[Callable[[Any], Any], int]] = []
    messages: list[Callable[[Any], Any]] = []

    def collect(empty: Any, path: str) -> None:
        sizes = _SIZES.get(empty.DESCRIPTOR.full_name, {})
        for field in empty.DESCRIPTOR.fields:
            name, value = f"{path}{field.name}", getattr(empty, field.name)
            repeated = hasattr(value, "extend")
            if field.cpp_type in (field.CPPTYPE_DOUBLE, field.CPPTYPE_FLOAT):
                if repeated:
                    many.append((attrgetter(name), sizes.get(field.name, 0)))
                else:
                    single.append(name)
            elif field.cpp_type == field.CPPTYPE_MESSAGE:
                if repeated:
                    messages.append(attrgetter(name))
                else:
                    collect(value, f"{name}.")

    collect(cls(), "")
    return _Numbers(_getter(single), tuple(many), tuple(messages))


def _getter(names: list[str]) -> Callable[[Any], Iterable[float]]:
    """What gets the values of fields."""
    if len(names) > 1:
        return attrgetter(*names)
    getters = [attrgetter(name) for name in names]
    return lambda body: [get(body) for get in getters]


def validate(body: Any) -> None:
    """Raise ImpossibleValues for a message with values that are not finite, or with the wrong number of values."""
    if not _is_fine(body):
        _find_fault(body)
    of_type = type(body)
    if of_type is m.LocationFix and not abs(body.latitude) <= 90:
        raise ImpossibleValues(f"latitude {body.latitude}, wanted -90 to 90 degrees")
    if of_type is m.Camera and not (body.lenses and body.lines):
        raise ImpossibleValues(f"camera {body.name!r} with {len(body.lenses)} lenses and {len(body.lines)} CCD lines")
    if of_type is m.PoseInFrame:
        q = body.pose.orientation
        norm = math.hypot(q.x, q.y, q.z, q.w)
        if abs(norm - 1) > 1e-3:
            raise ImpossibleValues(f"quaternion of length {norm:.3g}, wanted 1")


def _is_fine(body: Any) -> bool:
    """Whether all numbers together are finite (those of a sane message do not overflow) and vectors have their size.

    What a message does not have reads as zero, or as no value.
    """
    numbers = _numbers_of(type(body))
    total = sum(numbers.single(body))
    for get, size in numbers.many:
        values = get(body)
        if values:
            if size and len(values) != size:
                return False
            total += sum(values[:])  # a list of them takes half as long as the field itself
    for get in numbers.messages:
        for part in get(body):
            if not _is_fine(part):
                return False
    return math.isfinite(total)


def _find_fault(body: Any) -> None:
    """Raise ImpossibleValues for the first field that is at fault, if one is."""
    sizes = _SIZES.get(body.DESCRIPTOR.full_name, {})
    for field, value in body.ListFields():  # only fields that are set: a default is always finite
        size = sizes.get(field.name)
        if size is not None and len(value) != size:
            raise ImpossibleValues(f"{field.name} has {len(value)} values, wanted {size}")
        kind = field.cpp_type
        if kind in (field.CPPTYPE_DOUBLE, field.CPPTYPE_FLOAT):
            finite = math.isfinite(value) if isinstance(value, float) else np.isfinite(np.asarray(value)).all()
            if not finite:
                raise ImpossibleValues(f"{field.name} is not finite")
        elif kind == field.CPPTYPE_MESSAGE:
            for part in (value,) if hasattr(value, "ListFields") else value:
                _find_fault(part)
