"""CDR of ROS 2 messages with a header, decoded by rosbags; what cannot be used is counted."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from functools import cache
from typing import Any

import numpy as np

from ..convert import SECOND_NS

FIX = "sensor_msgs/msg/NavSatFix"


@cache
def _types() -> Any:
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.LATEST)


def decoded(payloads: Iterable[bytes | memoryview], kind: str, left_out: Counter[str]) -> Iterator[tuple[int, Any]]:
    """Header time in ns and message of each that can be used, each later than the one before."""
    from rosbags.serde import SerdeError

    types, last = _types(), -1
    for payload in payloads:
        try:
            message = types.deserialize_cdr(payload, kind)
        except SerdeError:
            left_out["not decodable"] += 1
            continue
        time_ns = message.header.stamp.sec * SECOND_NS + message.header.stamp.nanosec
        if kind == FIX and not (message.status.status >= 0 and np.isfinite(message.latitude + message.longitude)):
            left_out["without a fix"] += 1
        elif time_ns <= last:
            left_out["not later than the one before"] += 1
        else:
            last = time_ns
            yield time_ns, message
