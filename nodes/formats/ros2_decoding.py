"""CDR of ROS 2 messages with a header, decoded by rosbags; what cannot be used is counted."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from functools import cache
from typing import Any

import numpy as np

from ...schemas.envelope import Envelope
from ..convert import SECOND_NS
from ..ordering import StreamCheck

FIX = "sensor_msgs/msg/NavSatFix"
#: Why a message is left out whose time does not go on.
NOT_LATER = "not later than the one before"


@cache
def _types() -> Any:
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.LATEST)


def decoded(
    payloads: Iterable[bytes | memoryview], kind: str, left_out: Counter[str], live: bool = False
) -> Iterator[tuple[int, Any]]:
    """Header time in ns and message of each that can be used, each later than the one before.

    A time far ahead that the next one does not confirm is left out, not all that follow it. Of a ``live`` topic, times
    that have gone on from an earlier one for some messages are those of a clock that was set back.
    """
    from rosbags.serde import SerdeError

    def refuse(problem: str, _: str) -> None:
        left_out[NOT_LATER] += problem == "malformed"

    types, check, number, last = _types(), StreamCheck[tuple[int, Any]](refuse), 0, -1
    for payload in payloads:
        try:
            message = types.deserialize_cdr(payload, kind)
        except SerdeError:
            left_out["not decodable"] += 1
            continue
        time_ns = message.header.stamp.sec * SECOND_NS + message.header.stamp.nanosec
        if kind == FIX and not (message.status.status >= 0 and np.isfinite(message.latitude + message.longitude)):
            left_out["without a fix"] += 1
        elif time_ns == last or (time_ns < last and not live):
            left_out[NOT_LATER] += 1
        else:
            number += 1
            for last, passed in check.accept("sensor/imu", Envelope(time_ns, "", number), (time_ns, message)):
                yield last, passed
    check.end()
