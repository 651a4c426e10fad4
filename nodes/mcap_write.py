"""Writing MCAP: messages in chunks with checksums and indices, as the specification has it.

The bytes are those of the MCAP library's writer, which takes many times as long for small messages: of an hour of
flight there are millions.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterable
from typing import IO

import lz4.frame
import zstandard

from .mcap_scan import (
    CHANNEL,
    CHUNK,
    CHUNK_INDEX,
    DATA_END,
    FOOTER,
    HEADER,
    MAGIC,
    MESSAGE,
    MESSAGE_INDEX,
    METADATA,
    SCHEMA,
)

ATTACHMENT_INDEX, STATISTICS, METADATA_INDEX, SUMMARY_OFFSET = 10, 11, 13, 14
COMPRESSIONS = ("none", "lz4", "zstd")
_MESSAGE = struct.Struct("<BQHIQQ")
_ENTRY_BYTES, _MESSAGE_FIELDS = 16, 22


class McapWriter:
    """Writes records to a stream, which stays open.

    Parameters
    ----------
    stream : binary, where the file begins
    compression : ``none``, ``lz4`` or ``zstd``
    chunk_size : bytes after which a chunk is closed
    """

    def __init__(self, stream: IO[bytes], compression: str, chunk_size: int) -> None:
        self._stream, self._chunk_size = stream, chunk_size
        self._compression = "" if compression == "none" else compression
        self._crc = 0
        self._schemas: list[bytes] = []
        self._channels: list[bytes] = []
        self._chunk_indices: list[bytes] = []
        self._metadata_indices: list[bytes] = []
        self._counts: dict[int, int] = {}
        self._first_ns: int | None = None
        self._last_ns = 0
        self._chunk = bytearray()
        self._begin_ns: int | None = None  # of the messages in the open chunk
        self._end_ns = 0
        self._entries: dict[int, list[int]] = {}  # log time and offset of each, by channel

    def start(self, library: str) -> None:
        """Magic and header."""
        self._put(MAGIC)
        self._put(_record(HEADER, _text("") + _text(library)))

    def register_schema(self, name: str, encoding: str, data: bytes) -> int:
        """A schema; returns its number."""
        number = len(self._schemas) + 1
        content = struct.pack("<H", number) + _text(name) + _text(encoding) + struct.pack("<I", len(data)) + data
        self._schemas.append(_record(SCHEMA, content))
        self._add(self._schemas[-1])
        return number

    def register_channel(self, topic: str, encoding: str, schema: int, metadata: dict[str, str]) -> int:
        """A channel; returns its number."""
        number = len(self._channels) + 1
        content = struct.pack("<HH", number, schema) + _text(topic) + _text(encoding) + _map(metadata)
        self._channels.append(_record(CHANNEL, content))
        self._add(self._channels[-1])
        return number

    def add_message(self, channel: int, log_ns: int, publish_ns: int, sequence: int, data: bytes | memoryview) -> None:
        """A message of a channel."""
        chunk = self._chunk
        entries = self._entries.get(channel)
        if entries is None:
            entries = self._entries[channel] = []
        entries += (log_ns, len(chunk))
        chunk += _MESSAGE.pack(MESSAGE, _MESSAGE_FIELDS + len(data), channel, sequence, log_ns, publish_ns)
        chunk += data
        if self._begin_ns is None or log_ns < self._begin_ns:
            self._begin_ns = log_ns
        if log_ns > self._end_ns:
            self._end_ns = log_ns
        if len(chunk) > self._chunk_size:
            self._close_chunk()

    def add_metadata(self, name: str, data: dict[str, str]) -> None:
        """Metadata, outside chunks."""
        record = _record(METADATA, _text(name) + _map(data))
        place = struct.pack("<QQ", self._stream.tell(), len(record))
        self._metadata_indices.append(_record(METADATA_INDEX, place + _text(name)))
        self._put(record)

    def flush(self) -> None:
        """Close the open chunk and hand everything to the operating system."""
        self._close_chunk()
        self._stream.flush()

    def finish(self) -> None:
        """Close the open chunk, write summary and footer."""
        self._close_chunk()
        self._put(_record(DATA_END, struct.pack("<I", self._crc)))
        begin = self._stream.tell()
        summary, offsets = bytearray(), bytearray()
        for opcode, parts in (
            (SCHEMA, self._schemas), (CHANNEL, self._channels), (STATISTICS, [self._statistics()]),
            (CHUNK_INDEX, self._chunk_indices), (ATTACHMENT_INDEX, []), (METADATA_INDEX, self._metadata_indices),
        ):  # fmt: skip
            group = b"".join(parts)
            offsets += _record(SUMMARY_OFFSET, struct.pack("<BQQ", opcode, begin + len(summary), len(group)))
            summary += group
        places = struct.pack("<QQ", begin, begin + len(summary))
        summary += offsets
        crc = zlib.crc32(struct.pack("<BQ", FOOTER, 20) + places, zlib.crc32(summary))
        self._stream.write(summary)
        self._stream.write(_record(FOOTER, places + struct.pack("<I", crc)))
        self._stream.write(MAGIC)

    def _add(self, record: bytes) -> None:
        """A record other than a message to the open chunk."""
        self._chunk += record
        if len(self._chunk) > self._chunk_size:
            self._close_chunk()

    def _put(self, data: bytes | bytearray) -> None:
        """Bytes outside chunks."""
        self._crc = zlib.crc32(data, self._crc)
        self._stream.write(data)

    def _close_chunk(self) -> None:
        """Write the open chunk and the index of its messages, if there are any."""
        if self._begin_ns is None:
            return
        content, self._chunk = bytes(self._chunk), bytearray()
        data = content
        if self._compression:
            data = (lz4.frame.compress if self._compression == "lz4" else zstandard.compress)(content)
        times = struct.pack("<QQ", self._begin_ns, self._end_ns)
        name = _text(self._compression)
        head = times + struct.pack("<QI", len(content), zlib.crc32(content)) + name + struct.pack("<Q", len(data))
        chunk = b"".join((struct.pack("<BQ", CHUNK, len(head) + len(data)), head, data))
        begin = self._stream.tell()
        end = begin + len(chunk)
        index, places = bytearray(), bytearray()
        for channel, entries in self._entries.items():
            places += struct.pack("<HQ", channel, end + len(index))
            packed = struct.pack(f"<{len(entries)}Q", *entries)
            index += _record(MESSAGE_INDEX, struct.pack("<HI", channel, len(packed)) + packed)
            self._counts[channel] = self._counts.get(channel, 0) + len(packed) // _ENTRY_BYTES
        self._put(chunk + index)  # at once: a full disk takes all of it or nothing
        lengths = struct.pack("<QQ", len(data), len(content))
        where = struct.pack("<QQI", begin, end - begin, len(places)) + places + struct.pack("<Q", len(index))
        self._chunk_indices.append(_record(CHUNK_INDEX, times + where + name + lengths))
        self._first_ns = self._begin_ns if self._first_ns is None else min(self._first_ns, self._begin_ns)
        self._last_ns = max(self._last_ns, self._end_ns)
        self._begin_ns, self._end_ns, self._entries = None, 0, {}

    def _statistics(self) -> bytes:
        counts = b"".join(struct.pack("<HQ", channel, n) for channel, n in self._counts.items())
        return _record(
            STATISTICS,
            struct.pack(
                "<QHIIIIQQI", sum(self._counts.values()), len(self._schemas), len(self._channels), 0,
                len(self._metadata_indices), len(self._chunk_indices), self._first_ns or 0, self._last_ns, len(counts),
            )
            + counts,
        )  # fmt: skip


def _record(opcode: int, content: bytes | bytearray) -> bytes:
    return struct.pack("<BQ", opcode, len(content)) + content


def _text(text: str) -> bytes:
    data = text.encode()
    return struct.pack("<I", len(data)) + data


def _map(pairs: dict[str, str]) -> bytes:
    data = b"".join(_text(part) for part in _flat(pairs.items()))
    return struct.pack("<I", len(data)) + data


def _flat(pairs: Iterable[tuple[str, str]]) -> Iterable[str]:
    for key, value in pairs:
        yield key
        yield value
