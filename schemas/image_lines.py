"""Blocks of image lines without copying the pixels.

A block is a `foxglove.RawImage` on the wire. Protobuf's own classes copy the pixels when they are set, when they are
serialised, when they are parsed and at every look. Fields of a protobuf message may stand in any order: written with
the pixels last, a block is its small header followed by the array's memory, and a reader takes the array from there.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from . import messages as m

_DATA_FIELD = 6
_DATA_TAG = bytes([_DATA_FIELD << 3 | 2])  # field 6, length-delimited
_DTYPES = {"mono8": np.dtype(np.uint8), "mono16": np.dtype("<u2")}
SECOND_NS = 1_000_000_000


@dataclass(frozen=True, slots=True)
class LineBlock:
    """Lines of one CCD, one after the other.

    Attributes
    ----------
    pixels : (n_lines, n_samples) uint8 or uint16
    ccd : id of the CCD line
    strip : strip the lines belong to
    first_line : number of the first line in the strip, 0-based
    time_ns : UTC time of the first line, ns since the Unix epoch
    line_period_ns : ns between lines; 0 where ``line_times_ns`` is given
    line_times_ns : (n_lines,) int64, or None for equally spaced lines
    """

    pixels: NDArray[Any]
    ccd: str
    strip: str
    first_line: int
    time_ns: int
    line_period_ns: int = 0
    line_times_ns: NDArray[np.int64] | None = None

    def times_ns(self) -> NDArray[np.int64]:
        """(n_lines,) UTC time of each line, ns since the Unix epoch."""
        if self.line_times_ns is not None:
            return self.line_times_ns
        return self.time_ns + np.arange(len(self.pixels), dtype=np.int64) * self.line_period_ns

    def encode(self) -> bytes:
        """The wire form of a RawImage, with the pixels last: they are copied once, into the result."""
        encoding = next((name for name, dtype in _DTYPES.items() if dtype == self.pixels.dtype), None)
        if encoding is None or self.pixels.ndim != 2:
            raise ValueError(f"pixels are {self.pixels.dtype} of shape {self.pixels.shape}, wanted 2-D uint8 or uint16")
        pixels = np.ascontiguousarray(self.pixels)
        height, width = pixels.shape
        head = m.RawImage(
            width=width, height=height, encoding=encoding, step=width * pixels.itemsize, frame_id=self.ccd,
            strip=self.strip, first_line=self.first_line, line_period_ns=self.line_period_ns,
        )  # fmt: skip
        head.timestamp.seconds, head.timestamp.nanos = divmod(self.time_ns, SECOND_NS)
        if self.line_times_ns is not None:
            head.line_times_ns.extend(np.asarray(self.line_times_ns).tolist())
        return b"".join((head.SerializeToString(), _DATA_TAG, _varint(pixels.nbytes), pixels.data.cast("B")))

    def message(self) -> Any:
        """The same as a RawImage message (copies the pixels)."""
        return m.RawImage.FromString(self.encode())


def decode(data: bytes | memoryview) -> LineBlock:
    """The block in a serialised RawImage; ``pixels`` is a read-only view of ``data``.

    Raises
    ------
    ValueError : not a RawImage, or sizes that do not fit together
    """
    buffer = memoryview(data)
    start, end, tag_start = _find_data(buffer)
    try:
        head = m.RawImage.FromString(b"".join((buffer[:tag_start], buffer[end:])))
    except Exception as error:  # protobuf's DecodeError has no stable home
        raise ValueError(f"not a RawImage: {error}") from None
    dtype = _DTYPES.get(head.encoding)
    if dtype is None:
        raise ValueError(f"image encoding {head.encoding!r}, wanted mono8 or mono16")
    if head.step != head.width * dtype.itemsize or end - start != head.step * head.height:
        raise ValueError(
            f"{end - start} bytes of pixels in lines of {head.step} bytes, "
            f"wanted {head.height} lines of {head.width} {head.encoding} pixels"
        )
    times = np.array(head.line_times_ns, dtype=np.int64) if head.line_times_ns else None
    if times is not None and len(times) != head.height:
        raise ValueError(f"{len(times)} line times for {head.height} lines")
    pixels = np.frombuffer(buffer[start:end], dtype).reshape(head.height, head.width)
    time_ns = head.timestamp.seconds * SECOND_NS + head.timestamp.nanos
    return LineBlock(pixels, head.frame_id, head.strip, head.first_line, time_ns, head.line_period_ns, times)


def _find_data(buffer: memoryview) -> tuple[int, int, int]:
    """First and last byte of the pixels, and where their tag begins; the last such field counts, as in protobuf."""
    found = (len(buffer), len(buffer), len(buffer))
    position = 0
    while position < len(buffer):
        tag_start = position
        tag, position = _read_varint(buffer, position)
        wire_type = tag & 7
        if wire_type == 0:
            _, position = _read_varint(buffer, position)
        elif wire_type == 1:
            position += 8
        elif wire_type == 5:
            position += 4
        elif wire_type == 2:
            length, position = _read_varint(buffer, position)
            if tag >> 3 == _DATA_FIELD:
                if found[0] != len(buffer):
                    raise ValueError("two pixel fields in one block")
                found = (position, position + length, tag_start)
            position += length
        else:
            raise ValueError(f"not a RawImage: wire type {wire_type}")
    if position != len(buffer):
        raise ValueError("not a RawImage: it ends inside a field")
    return found


def _varint(value: int) -> bytes:
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    out.append(value)
    return bytes(out)


def _read_varint(buffer: memoryview, position: int) -> tuple[int, int]:
    value = shift = 0
    while True:
        if position >= len(buffer) or shift > 63:
            raise ValueError("not a RawImage: it ends inside a number")
        byte = buffer[position]
        position += 1
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value, position
        shift += 7
