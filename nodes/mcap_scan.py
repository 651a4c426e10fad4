"""Walking through the bytes of an MCAP file, whole or damaged, without trusting them.

The layout is that of the MCAP specification: a magic, then records of (opcode, length, content), messages in chunks.
Everything here is a view of the file's bytes; only compressed chunks are copied.
"""

from __future__ import annotations

import re
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass

import lz4.frame
import zstandard

MAGIC = b"\x89MCAP0\r\n"
HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK = 1, 2, 3, 4, 5, 6
MESSAGE_INDEX, CHUNK_INDEX, METADATA, DATA_END = 7, 8, 12, 15
_RECORD = struct.Struct("<BQ")
_CHUNK_HEAD = struct.Struct("<QQQI")
_MESSAGE_HEAD = struct.Struct("<HIQQ")
#: No writer of recordings makes larger records; a larger length is damage.
MAX_RECORD = 1 << 32
#: A record outside chunks that is larger is looked into: its length may be damaged, and skipping it skip whole chunks.
_LARGE = 1 << 16
#: What a chunk may unpack to; more is damage, or an attack on the memory.
MAX_CHUNK = 1 << 30
_FIRST, _LAST = 0x01, 0x0F
#: A chunk's opcode and the zeros in the upper half of its length; a look-ahead, since finds may overlap.
_CHUNK_START = re.compile(rb"(?=\x06.{4}\x00{4})", re.DOTALL)


@dataclass(frozen=True, slots=True)
class Damage:
    """Bytes that cannot be read.

    Attributes
    ----------
    offset : first byte
    length : bytes that are lost
    reason : what is wrong
    """

    offset: int
    length: int
    reason: str

    def __str__(self) -> str:
        return f"{self.reason} at byte {self.offset} ({self.length} bytes)"


@dataclass(frozen=True, slots=True)
class Record:
    """A record outside chunks: its opcode, where it begins, its content."""

    opcode: int
    offset: int
    content: memoryview

    @property
    def end(self) -> int:
        return self.offset + _RECORD.size + len(self.content)


def records(buffer: memoryview, start: int = len(MAGIC)) -> Iterator[Record | WholeChunk | Damage]:
    """The records of a file up to its footer, and the damaged stretches between them.

    After something that makes no sense the walk goes on at the next chunk that does, so that every chunk that is whole
    is found, whatever stands around it.
    """
    position, size = start, len(buffer)
    while position < size:
        found, following = _examine(buffer, position)
        if following is None:
            at = _next_chunk(buffer, position + 1)
            if at is None:
                cut = _cut(buffer, position)
                yield Damage(position, size - position, "the file ends inside a record" if cut else "garbage")
                return
            reason = found.reason if isinstance(found, Damage) else "a damaged record"
            found, following = Damage(position, at - position, reason), at
        yield found
        if isinstance(found, Record) and found.opcode == FOOTER:
            return
        position = following


def _examine(buffer: memoryview, position: int) -> tuple[Record | WholeChunk | Damage, int | None]:
    """What stands there, and where the walk goes on; None where that cannot be told."""
    record = _record_at(buffer, position)
    if record is None:
        return Damage(position, 0, "a damaged record"), None
    trusted = record.opcode == FOOTER or _plausible(buffer, record.end)
    following = record.end if trusted else None
    if record.opcode == CHUNK:
        chunk = parse_chunk(record)
        if chunk is None or not chunk.plausible():
            return Damage(position, record.end - position, "a chunk with a damaged head"), following
        content = chunk.data()
        if isinstance(content, str):
            return Damage(position, record.end - position, content), following
        return WholeChunk(chunk, content), record.end
    if len(record.content) > _LARGE and _next_chunk(buffer, position + 1, record.end) is not None:
        return Damage(position, 0, "a record of the wrong length"), None
    return record, following


def _record_at(buffer: memoryview, position: int) -> Record | None:
    if position + _RECORD.size > len(buffer):
        return None
    opcode, length = _RECORD.unpack_from(buffer, position)
    begin = position + _RECORD.size
    if not (_FIRST <= opcode <= _LAST) or length > MAX_RECORD or begin + length > len(buffer):
        return None
    return Record(opcode, position, buffer[begin : begin + length])


def _plausible(buffer: memoryview, position: int) -> bool:
    """Whether a record, whole or cut by the end of the file, may begin there."""
    if position + _RECORD.size > len(buffer):
        return True
    opcode, length = _RECORD.unpack_from(buffer, position)
    return _FIRST <= opcode <= _LAST and length <= MAX_RECORD


_cut = _plausible


def _next_chunk(buffer: memoryview, position: int, end: int | None = None) -> int | None:
    """Where the next whole chunk begins."""
    for match in _CHUNK_START.finditer(buffer, position, len(buffer) if end is None else end):
        record = _record_at(buffer, match.start())
        chunk = parse_chunk(record) if record is not None else None
        if chunk is not None and chunk.plausible() and not isinstance(chunk.data(), str):
            return match.start()
    return None


@dataclass(frozen=True, slots=True)
class Chunk:
    """A chunk of messages, still compressed."""

    offset: int
    start_ns: int
    end_ns: int
    uncompressed_size: int
    crc: int
    compression: str
    stored: memoryview

    def plausible(self) -> bool:
        """Whether the head can be that of a chunk."""
        if self.compression not in ("", "lz4", "zstd") or self.start_ns > self.end_ns:
            return False
        if self.uncompressed_size > MAX_CHUNK:
            return False
        return self.compression != "" or self.uncompressed_size == len(self.stored)

    def data(self) -> memoryview | str:
        """The records inside, or what is wrong with them."""
        try:
            if self.compression == "":
                content: memoryview = self.stored
            elif self.compression == "lz4":
                content = memoryview(lz4.frame.decompress(self.stored))
            elif self.compression == "zstd":
                content = memoryview(zstandard.decompress(self.stored, self.uncompressed_size))
            else:
                return f"a chunk with unknown compression {self.compression!r}"
        except (RuntimeError, zstandard.ZstdError, MemoryError):
            return "a chunk that cannot be decompressed"
        if len(content) != self.uncompressed_size:
            return "a chunk of the wrong size"
        if self.crc and zlib.crc32(content) != self.crc:
            return "a chunk with a wrong checksum"
        return content


@dataclass(frozen=True, slots=True)
class WholeChunk:
    """A chunk whose checksum is right, and the records inside."""

    chunk: Chunk
    content: memoryview


def parse_chunk(record: Record) -> Chunk | None:
    """The chunk of a chunk record; None where its head makes no sense."""
    content = record.content
    if len(content) < _CHUNK_HEAD.size + 12:
        return None
    start_ns, end_ns, size, crc = _CHUNK_HEAD.unpack_from(content)
    length = int.from_bytes(content[28:32], "little")
    begin = 32 + length
    if length > 16 or begin + 8 > len(content):
        return None
    try:
        compression = bytes(content[32:begin]).decode("ascii")
    except UnicodeDecodeError:
        return None
    stored = int.from_bytes(content[begin : begin + 8], "little")
    if begin + 8 + stored > len(content):
        return None
    return Chunk(record.offset, start_ns, end_ns, size, crc, compression, content[begin + 8 : begin + 8 + stored])


def chunk_records(content: memoryview, position: int = 0) -> Iterator[tuple[int, int, memoryview]]:
    """(opcode, place, content) of the records inside a chunk, from a place on; raises ValueError where they run over
    its end."""
    size = len(content)
    while position < size:
        if position + _RECORD.size > size:
            raise ValueError("a chunk that ends inside a record")
        opcode, length = _RECORD.unpack_from(content, position)
        begin = position + _RECORD.size
        if begin + length > size:
            raise ValueError("a chunk that ends inside a record")
        yield opcode, position, content[begin : begin + length]
        position = begin + length


def message_at(content: memoryview, place: int) -> memoryview:
    """The content of the message record at a place inside a chunk."""
    _, length = _RECORD.unpack_from(content, place)
    return content[place + _RECORD.size : place + _RECORD.size + length]


def message_head(content: memoryview) -> tuple[int, int, int, int]:
    """(channel, sequence, log time, publish time) of a message record; its payload begins at byte 22."""
    return _MESSAGE_HEAD.unpack_from(content)


RECORD_HEAD_SIZE, MESSAGE_HEAD_SIZE = _RECORD.size, _MESSAGE_HEAD.size
#: Head of a record and of the message in it.
MESSAGE_RECORD = struct.Struct("<BQHIQQ")


def text(content: memoryview, position: int) -> tuple[str, int]:
    """A length-prefixed string and the place after it; raises ValueError where it runs over the end."""
    length = int.from_bytes(content[position : position + 4], "little")
    end = position + 4 + length
    if end > len(content):
        raise ValueError("a string that runs over its record")
    return bytes(content[position + 4 : end]).decode("utf-8", "replace"), end


def string_map(content: memoryview, position: int) -> dict[str, str]:
    """A map of strings as in channel and metadata records."""
    end = position + 4 + int.from_bytes(content[position : position + 4], "little")
    if end > len(content):
        raise ValueError("a map that runs over its record")
    position += 4
    out: dict[str, str] = {}
    while position < end:
        key, position = text(content, position)
        out[key], position = text(content, position)
    return out
