"""The index of a whole recording from its end, so that of a file elsewhere only what is asked for is fetched.

At the end of a recording stands where its chunks are, and behind each chunk where the messages of each channel stand in
it. So channels and places of all messages are known after a few small requests; stamps and numbers stand in the
messages themselves, and are fetched with those.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

import numpy as np
from mcap.opcode import Opcode
from mcap.records import Channel, ChunkIndex, Footer, McapRecord, Statistics
from numpy.typing import NDArray

from . import mcap_scan as scan
from .index import LAST_NS, Index
from .remote import RemoteFile

#: Of the end so much is fetched at once, bytes; most indices are smaller.
_END = 1 << 16
_INDEX_HEAD = struct.Struct("<HI")
_ENTRY = np.dtype([("time", "<u8"), ("place", "<u8")])
#: Sequence number of a message whose head was not fetched yet.
UNKNOWN = -1
_HEAD = scan.RECORD_HEAD.size + scan.MESSAGE_HEAD.size
_HEAD_DTYPE = np.dtype(
    [("opcode", "u1"), ("length", "<u8"), ("channel", "<u2"), ("sequence", "<u4"), ("log", "<u8"), ("publish", "<u8")]
)


class NoIndexError(ValueError):
    """A recording whose end does not say where everything stands."""


@dataclass
class Ranged:
    """A recording of which parts are here.

    Attributes
    ----------
    file : where it is
    chunks : as its end names them; starts, ends : of what is inside each, bytes of the file (uncompressed ones)
    summary : records that stand at the end beside those; footer : of the file
    index : all messages; numbers and stamps are those of messages whose heads were fetched (see `heads`)
    until : (n,) where each message ends in its chunk
    """

    file: RemoteFile
    chunks: list[ChunkIndex]
    starts: NDArray[np.int64]
    ends: NDArray[np.int64]
    summary: list[McapRecord]
    footer: Footer
    index: Index
    until: NDArray[np.int64]

    def take(self, rows: NDArray[np.int64]) -> None:
        """Keep some of the messages, in this order."""
        self.index, self.until = self.index.take(rows), self.until[rows]

    def heads(self, numbers: NDArray[np.int64]) -> None:
        """Fetch number and stamps of messages.

        Raises
        ------
        NoIndexError : what stands there is another message
        """
        index = self.index
        wanted = numbers[index.sequence[numbers] == UNKNOWN]
        packed = self._packed[index.chunk[wanted]]
        rows = wanted[packed]
        for number in np.unique(index.chunk[rows]).tolist():
            content = self.content(number)  # once for all of its messages
            for row in rows[index.chunk[rows] == number].tolist():
                self._note(row, content, int(index.place[row]))
        rows = wanted[~packed]
        if not len(rows):
            return
        begin = self.starts[index.chunk[rows]] + index.place[rows]
        self.file.fetch(begin, begin + _HEAD)
        places = begin[:, None] + np.arange(_HEAD)
        heads = np.frombuffer(self.file.buffer, np.uint8)[places].view(_HEAD_DTYPE)[:, 0]
        if not ((heads["opcode"] == Opcode.MESSAGE) & (heads["channel"] == index.channel[rows])).all():
            raise NoIndexError("the index of the recording names places where no message of that channel stands")
        index.sequence[rows] = heads["sequence"]
        index.stamp_ns[rows] = np.minimum(heads["publish"], np.uint64(LAST_NS)).astype(np.int64)

    def payloads(self, numbers: NDArray[np.int64]) -> None:
        """Fetch messages."""
        rows = numbers[~self._packed[self.index.chunk[numbers]]]
        start = self.starts[self.index.chunk[rows]]
        self.file.fetch(start + self.index.place[rows], start + self.until[rows])

    def content(self, number: int) -> memoryview:
        """The inside of a chunk; of an uncompressed one what was fetched.

        Raises
        ------
        ValueError : a compressed chunk that is not whole
        """
        chunk = self.chunks[number]
        if not chunk.compression:
            return self.file.buffer[self.starts[number] : self.ends[number]]
        begin, end = chunk.chunk_start_offset, chunk.chunk_start_offset + chunk.chunk_length
        self.file.fetch(begin, end)
        record = scan.parse(self.file.buffer[begin:end])
        return scan.chunk_content(record)  # pyrefly: ignore[bad-argument-type]  # the index says that it is a chunk

    @property
    def _packed(self) -> NDArray[np.bool_]:
        return np.array([bool(chunk.compression) for chunk in self.chunks], dtype=bool)

    def _note(self, row: int, content: memoryview, place: int) -> None:
        channel, sequence, _, publish = scan.MESSAGE_HEAD.unpack_from(content, place + scan.RECORD_HEAD.size)
        if content[place] != Opcode.MESSAGE or channel != self.index.channel[row]:
            raise NoIndexError("the index of the recording names places where no message of that channel stands")
        self.index.sequence[row], self.index.stamp_ns[row] = sequence, min(publish, LAST_NS)


def open_ranged(file: RemoteFile) -> Ranged:
    """Read where everything stands in a recording.

    Raises
    ------
    NoIndexError : that does not stand at its end, or not for all messages
    """
    size, buffer = file.size, file.buffer
    file.fetch([0, max(size - _END, 0)], [scan.RECORD_HEAD.size * 2, size])
    footer = _footer(buffer)
    file.fetch(footer.summary_start, size)
    summary = _summary(buffer, footer)
    chunks = [record for record in summary if isinstance(record, ChunkIndex)]
    chunks.sort(key=lambda chunk: chunk.chunk_start_offset)
    counted = [record.message_count for record in summary if isinstance(record, Statistics)]
    behind = np.array([c.chunk_start_offset + c.chunk_length for c in chunks], dtype=np.int64)
    lengths = np.array([c.message_index_length for c in chunks], dtype=np.int64)
    if not counted or (behind + lengths > footer.summary_start).any():
        raise NoIndexError("no index of the messages")
    file.fetch(behind, behind + lengths)
    tables = [
        _of_chunk(k, c, buffer[b : b + n]) for k, (c, b, n) in enumerate(zip(chunks, behind, lengths, strict=True))
    ]
    table = np.concatenate([*tables, np.empty((5, 0), np.int64)], axis=1)
    if table.shape[1] != counted[0]:
        raise NoIndexError("an index that leaves messages out")
    number, place, until, channel, log = table
    unknown = np.full(len(number), UNKNOWN)
    index = Index(number, place, channel, unknown, log, np.zeros(len(number), np.int64))
    starts = behind - np.array([c.compressed_size for c in chunks], dtype=np.int64)
    return Ranged(file, chunks, starts, behind, summary, footer, index, until)


def counts_at_end(buffer: memoryview) -> dict[str, int]:
    """How many messages a whole recording has on each topic, as its end says.

    Raises
    ------
    NoIndexError : its end does not say it
    """
    summary = _summary(buffer, _footer(buffer))
    counts: dict[str, int] = {}
    topic = {record.id: record.topic for record in summary if isinstance(record, Channel)}
    for record in summary:
        for channel, n in record.channel_message_counts.items() if isinstance(record, Statistics) else ():
            name = topic.get(channel, "")
            counts[name] = counts.get(name, 0) + n
    return counts


def _footer(buffer: memoryview) -> Footer:
    end = len(buffer) - len(scan.MAGIC)
    if buffer[max(end, 0) :] != scan.MAGIC or end < scan.FOOTER_SIZE + len(scan.MAGIC):
        raise NoIndexError("no end")
    footer = _parse(buffer[end - scan.FOOTER_SIZE : end])
    if not isinstance(footer, Footer) or not len(scan.MAGIC) <= footer.summary_start < end:
        raise NoIndexError("no summary")
    return footer


def _summary(buffer: memoryview, footer: Footer) -> list[McapRecord]:
    return _records(buffer[footer.summary_start : len(buffer) - len(scan.MAGIC) - scan.FOOTER_SIZE])


def _of_chunk(number: int, chunk: ChunkIndex, data: memoryview) -> NDArray[np.int64]:
    """Chunk, place, end, channel and log time (5, n) of the messages of a chunk, as they stand in it."""
    parts, position = [], 0
    while position + scan.RECORD_HEAD.size + _INDEX_HEAD.size <= len(data):
        opcode, length = scan.RECORD_HEAD.unpack_from(data, position)
        position += scan.RECORD_HEAD.size
        channel, size = _INDEX_HEAD.unpack_from(data, position)
        if opcode != Opcode.MESSAGE_INDEX or size + _INDEX_HEAD.size != length or position + length > len(data):
            raise NoIndexError("an index of messages that makes no sense")
        rows = np.frombuffer(data, _ENTRY, size // _ENTRY.itemsize, position + _INDEX_HEAD.size)
        place, log = (np.minimum(rows[name], np.uint64(LAST_NS)).astype(np.int64) for name in ("place", "time"))
        parts.append(np.stack([place, np.full(len(rows), channel), log]))
        position += length
    place, channel, log = np.concatenate([*parts, np.empty((3, 0), np.int64)], axis=1)
    order = np.argsort(place, kind="stable")
    place, channel, log = place[order], channel[order], log[order]
    inside = chunk.uncompressed_size
    if len(place) and (place[0] < 0 or place[-1] + _HEAD > inside):
        raise NoIndexError("an index of messages that makes no sense")
    return np.stack([np.full(len(place), number), place, np.append(place[1:], inside)[: len(place)], channel, log])


def _records(data: memoryview) -> list[McapRecord]:
    found, position = [], 0
    while position < len(data):
        if position + scan.RECORD_HEAD.size > len(data):
            raise NoIndexError("a summary that ends inside a record")
        _, length = scan.RECORD_HEAD.unpack_from(data, position)
        end = position + scan.RECORD_HEAD.size + length
        if end > len(data):
            raise NoIndexError("a summary that ends inside a record")
        found.append(_parse(data[position:end]))
        position = end
    return found


def _parse(data: memoryview) -> McapRecord:
    try:
        return scan.parse(data)
    except (ValueError, StopIteration):
        raise NoIndexError("a record that makes no sense") from None
