"""Walking through an MCAP file, whole or damaged, from record to record.

What a record says is read by the MCAP library. The library's readers stop at the first byte that is wrong, and believe
every length that stands in a file; so the way from one record to the next is found here. Each record is cut out before
the library sees it, and behind damage the walk goes on at the next chunk that is whole. What is found are views of the
file's bytes; only compressed chunks are copied.
"""

from __future__ import annotations

import re
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from typing import IO, cast

import zstandard
from mcap.exceptions import EndOfFile, McapError
from mcap.opcode import Opcode
from mcap.records import Chunk, McapRecord
from mcap.stream_reader import StreamReader, get_chunk_data_stream
from mcap.writer import MCAP0_MAGIC as MAGIC

#: What every record begins with: opcode, length of what follows.
RECORD_HEAD = struct.Struct("<BQ")
#: What a message begins with behind that: channel, sequence number, log time, publish time.
MESSAGE_HEAD = struct.Struct("<HIQQ")
#: Bytes of a footer: one flipped bit makes a chunk look like one, behind which nothing would be read.
FOOTER_SIZE = RECORD_HEAD.size + 20
#: No writer of recordings makes larger records; a larger length is damage.
MAX_RECORD = 1 << 32
#: Opcodes from here on are for records of other programs' own, which readers pass over.
PRIVATE = 0x80
#: A record outside chunks that is larger is looked into: its length may be damaged, and skipping it skip whole chunks.
_LARGE = 1 << 16
#: What is wrong with the last bytes of a file that was cut off, or that is just being written.
_CUT = "the file ends inside a record"
#: What a chunk may unpack to; more is damage, or an attack on the memory.
MAX_CHUNK = 1 << 30
#: What a chunk record holds beside the name of its compression and its data.
_CHUNK_HEAD = struct.Struct("<BQQQQIIQ")
#: How a chunk begins: opcode, length, times, unpacked size, checksum, compression. A look-ahead: finds may overlap.
_CHUNK_START = re.compile(rb"(?=\x06.{4}\0{4}.{20}\0{4}.{4}(?:\0{4}|\x03\0{3}lz4|\x04\0{3}zstd))", re.DOTALL)


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

    @property
    def is_cut(self) -> bool:
        """Whether it is the end of a file that may have gone on."""
        return self.reason == _CUT

    def __str__(self) -> str:
        return f"{self.reason} at byte {self.offset} ({self.length} bytes)"


@dataclass(frozen=True, slots=True)
class Record:
    """A record outside chunks: its opcode, where it begins, its bytes."""

    opcode: int
    offset: int
    data: memoryview

    @property
    def end(self) -> int:
        return self.offset + len(self.data)


@dataclass(frozen=True, slots=True)
class WholeChunk:
    """A chunk whose checksum is right, where it begins, and the records inside."""

    offset: int
    chunk: Chunk
    content: memoryview


class _Views:
    """A stream from which the library reads views of a buffer, where a file would give it copies.

    A file gives what is left where less is left than was asked for, and the library takes that for all.
    """

    def __init__(self, buffer: memoryview) -> None:
        self._buffer, self._place = buffer, 0

    def read(self, size: int) -> memoryview:
        begin, self._place = self._place, self._place + size
        if not begin <= self._place <= len(self._buffer):
            raise EndOfFile
        return self._buffer[begin : self._place]


def parse(data: memoryview) -> McapRecord:
    """What the library reads in the bytes of one record; bytes in it are views. Raises ValueError for nonsense."""
    try:
        return next(StreamReader(cast(IO[bytes], _Views(data)), skip_magic=True, emit_chunks=True).records)
    except (McapError, struct.error, UnicodeDecodeError):
        raise ValueError("a record that makes no sense") from None


def chunk_content(chunk: Chunk) -> memoryview:
    """The records inside a chunk; raises ValueError where it is not whole."""
    size = chunk.uncompressed_size
    if chunk.compression not in ("", "lz4", "zstd"):
        raise ValueError(f"a chunk with unknown compression {chunk.compression!r}")
    if chunk.message_start_time > chunk.message_end_time or size > MAX_CHUNK:
        raise ValueError("a chunk with a damaged head")
    try:
        content = memoryview(chunk.data)
        if chunk.compression:  # the library would copy what is not compressed, too
            stream, unpacked = get_chunk_data_stream(chunk)
            content = memoryview(stream.read(unpacked))
    except (RuntimeError, zstandard.ZstdError, MemoryError):
        raise ValueError("a chunk that cannot be decompressed") from None
    if len(content) != size:
        raise ValueError("a chunk of the wrong size")
    if chunk.uncompressed_crc and zlib.crc32(content) != chunk.uncompressed_crc:
        raise ValueError("a chunk with a wrong checksum")
    return content


def payload_at(buffer: memoryview, place: int) -> memoryview:
    """The payload of the message whose record begins at a place."""
    _, length = RECORD_HEAD.unpack_from(buffer, place)
    begin = place + RECORD_HEAD.size
    return buffer[begin + MESSAGE_HEAD.size : begin + length]


def records(buffer: memoryview) -> Iterator[Record | WholeChunk | Damage]:
    """The records of a file up to its footer, and the damaged stretches between them and behind.

    After something that makes no sense the walk goes on at the next chunk that does, so that every chunk that is whole
    is found, whatever stands around it.
    """
    position, size = len(MAGIC), len(buffer)
    while position < size:
        found, following = _examine(buffer, position)
        if following is None:
            at = _next_chunk(buffer, position + 1, size)
            if at is None:
                cut = _plausible(buffer, position)
                yield Damage(position, size - position, _CUT if cut else "garbage")
                return
            reason = found.reason if isinstance(found, Damage) else "a damaged record"
            found, following = Damage(position, at - position, reason), at
        yield found
        if isinstance(found, Record) and found.opcode == Opcode.FOOTER:
            yield from _behind(buffer, found.end)
            return
        position = following


def _behind(buffer: memoryview, end: int) -> Iterator[Damage]:
    """What stands behind the footer, which ends there, and the magic bytes that close a file, or a part of them."""
    end += len(MAGIC)
    if end < len(buffer):
        follows = buffer[end : end + len(MAGIC)] == MAGIC
        reason = (
            "a second recording behind the end of the first" if follows else "bytes behind the end of the recording"
        )
        yield Damage(end, len(buffer) - end, reason)


def _examine(buffer: memoryview, position: int) -> tuple[Record | WholeChunk | Damage, int | None]:
    """What stands there, and where the walk goes on; None where that cannot be told."""
    record = _record_at(buffer, position)
    if record is None:
        return Damage(position, 0, "a damaged record"), None
    trusted = record.opcode == Opcode.FOOTER or _plausible(buffer, record.end)
    following = record.end if trusted else None
    if record.opcode == Opcode.CHUNK:
        try:
            return _whole_chunk(record), record.end
        except ValueError as error:
            return Damage(position, len(record.data), str(error)), following
    if len(record.data) > _LARGE and _next_chunk(buffer, position + 1, record.end) is not None:
        return Damage(position, 0, "a record of the wrong length"), None
    return record, following


def _record_at(buffer: memoryview, position: int) -> Record | None:
    """The record that begins there; None where none can, or where it runs over the end."""
    if position + RECORD_HEAD.size > len(buffer) or not _plausible(buffer, position):
        return None
    opcode, length = RECORD_HEAD.unpack_from(buffer, position)
    end = position + RECORD_HEAD.size + length
    return Record(opcode, position, buffer[position:end]) if end <= len(buffer) else None


def _plausible(buffer: memoryview, position: int) -> bool:
    """Whether a record, whole or cut by the end of the file, may begin there."""
    if position + RECORD_HEAD.size > len(buffer):
        return True
    opcode, length = RECORD_HEAD.unpack_from(buffer, position)
    if opcode == Opcode.FOOTER:
        return length == FOOTER_SIZE - RECORD_HEAD.size
    return (Opcode.HEADER <= opcode <= Opcode.DATA_END or opcode >= PRIVATE) and length <= MAX_RECORD


def _whole_chunk(record: Record) -> WholeChunk:
    """The chunk of a chunk record; raises ValueError where it is not whole."""
    chunk = cast(Chunk, parse(record.data))
    if len(record.data) != _CHUNK_HEAD.size + len(chunk.compression.encode()) + len(chunk.data):
        raise ValueError("a chunk with a damaged head")
    return WholeChunk(record.offset, chunk, chunk_content(chunk))


def _next_chunk(buffer: memoryview, position: int, end: int) -> int | None:
    """Where the next whole chunk begins."""
    for match in _CHUNK_START.finditer(buffer, position, end):
        record = _record_at(buffer, match.start())
        try:
            if record is not None and _whole_chunk(record):
                return match.start()
        except ValueError:
            continue
    return None
