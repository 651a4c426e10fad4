"""What makes messages of image lines: blocks with their stamps, and the strip that they belong to."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...schemas import messages as m
from ...schemas.image_lines import LineBlock
from ..node import Message
from .program import Clock

#: Length of a block, s.
BLOCK_S = 0.1


def block_message(clock: Clock, block: LineBlock) -> Message:
    """A block on its topic, stamped when its last line has been read."""
    last_ns = int(block.times_ns()[-1])
    return Message(f"sensor/lines/{block.ccd}", clock.stamp(last_ns), block)


def strip_message(id: str, first_ns: int, rate_hz: float, stamp_ns: int, lines: int | None = None) -> Message:
    """A strip begins, or (with the number of its lines) ends."""
    body: Any = m.Strip(
        id=id, first_line_time_ns=first_ns, line_rate_hz=rate_hz, lines=lines or 0, ended=lines is not None
    )
    return Message("configuration/strip", stamp_ns, body)


def pixels_of(data: bytes, samples: int, kind: np.dtype[Any]) -> NDArray[Any]:
    """(n, samples) uint8 or uint16 of the bytes of whole lines, whatever their byte order."""
    values = np.frombuffer(data, kind).reshape(-1, samples)
    return np.ascontiguousarray(values, values.dtype.newbyteorder("<"))
