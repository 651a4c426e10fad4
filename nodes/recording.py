"""Recordings: MCAP files of messages with their envelopes. `mcap_scan` and `mcap_write` know the format.

One channel stands for one run of one publisher on one topic. What all else depends on, the configuration, stands in a
chunk of its own at the head, and once more at the end, on channels marked as copies; readers take a copy only where the
first one is lost. Publish time is the platform stamp, log time the time of
reception, and the channel's metadata name the source; so a recording explains itself and keeps both times apart.
"""

from __future__ import annotations

import mmap
import zlib
from collections import Counter
from collections.abc import Iterable, Iterator
from functools import lru_cache
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from ..schemas import codec, topics
from ..schemas.envelope import Envelope, RawMessage
from ..schemas.messages import file_descriptor_set
from . import mcap_scan as scan
from .errors import UserError
from .mcap_write import COMPRESSIONS, McapWriter
from .node import Message
from .recording_index import Channel, Index, IndexColumns

LIBRARY = "triline"
CHANNEL_METADATA = "triline.channel"
_SEQUENCE_MASK = 0xFFFFFFFF
#: Rows of the index that are looked up together.
_TOGETHER = 8192


class RecordingWriter:
    """Writes a recording; the same messages give the same bytes.

    Parameters
    ----------
    target : path of the file, or an open binary file (which stays open)
    compression : ``none``, ``lz4`` or ``zstd``
    platform : name of the platform, kept with each channel
    chunk_size : bytes after which a chunk is closed
    """

    def __init__(
        self,
        target: str | Path | IO[bytes],
        compression: str = "none",
        *,
        platform: str = "demo",
        chunk_size: int = 1 << 20,
    ) -> None:
        if compression not in COMPRESSIONS:
            raise ValueError(f"compression {compression!r}, wanted one of {', '.join(COMPRESSIONS)}")
        self._owned = isinstance(target, (str, Path))
        self._stream: IO[bytes] = (
            open(target, "wb") if isinstance(target, (str, Path)) else target  # noqa: SIM115  # closed by close
        )
        self._writer = McapWriter(self._stream, compression, chunk_size)
        self._platform = platform
        self._schemas: dict[str, int] = {}
        self._channels: dict[tuple[str, str, int, str | None, bool], int] = {}
        self._configuring: dict[str, bool] = {}  # topics that were met
        self._last: dict[tuple[str, str], tuple[int, int]] = {}
        self.counts: Counter[str] = Counter()
        self._head = True
        self._configuration: list[tuple[RawMessage, str | None]] = []
        self._writer.start(LIBRARY)
        self._stream.flush()

    def write(self, message: Message, receive_ns: int | None = None) -> None:
        """Add a message; its log time is ``receive_ns``, or its stamp where none is given.

        A message without a sequence number (-1) gets the next one of its topic and source.

        Raises
        ------
        ValueError : a message without a number whose stamp lies before the one written before it
        KeyError : a topic that is not in the topic table
        """
        sequence = message.sequence
        if sequence < 0:
            key = (message.topic, message.source)
            last, last_stamp = self._last.get(key, (-1, -1))
            if message.stamp_ns < last_stamp:
                raise ValueError(
                    f"{message.topic} of {message.source!r}: stamp {message.stamp_ns} after {last_stamp}; "
                    "messages of one source are written in the order of their stamps"
                )
            sequence = last + 1
            self._last[key] = (sequence, message.stamp_ns)
        envelope = Envelope(message.stamp_ns, message.source, sequence)
        self.write_raw(RawMessage(message.topic, envelope, codec.encode(message.body), receive_ns or message.stamp_ns))

    def write_raw(self, raw: RawMessage, platform: str | None = None) -> None:
        """Add a message that is encoded already."""
        configuring = self._configuring.get(raw.topic)
        if configuring is None:
            configuring = topics.find(raw.topic).family is topics.Family.CONFIGURATION
            self._configuring[raw.topic] = configuring
        if configuring:
            kept = RawMessage(raw.topic, raw.envelope, bytes(raw.data), raw.receive_ns)
            self._configuration.append((kept, platform))
        elif self._head:
            self._head = False
            self.flush()
        self._add(raw, platform)
        self.counts[raw.topic] += 1

    def _add(self, raw: RawMessage, platform: str | None, *, copy: bool = False) -> None:
        topic, (stamp_ns, source, sequence, start), data, receive_ns = raw
        key = (topic, source, start, platform, copy)
        channel = self._channels.get(key)
        if channel is None:
            named = (topic, source, start, platform or self._platform, copy)
            channel = self._channels.get(named)
            if channel is None:
                channel = self._channels[named] = self._register(*named)
            self._channels[key] = channel
        self._writer.add_message(channel, receive_ns, stamp_ns, sequence & _SEQUENCE_MASK, data)

    def _register(self, topic: str, source: str, start: int, platform: str, copy: bool) -> int:
        row = topics.find(topic)
        schema = self._schemas.get(row.type_name)
        if schema is None:
            schema = self._writer.register_schema(row.type_name, "protobuf", file_descriptor_set(row.type_name))
            self._schemas[row.type_name] = schema
        metadata = {"source": source, "platform": platform}
        if start:
            metadata["start"] = str(start)
        if copy:
            metadata["copy"] = "yes"
        channel = self._writer.register_channel(topic, "protobuf", schema, metadata)
        # A channel stands in the first chunk that uses it; written once more outside chunks it survives that chunk.
        self._writer.add_metadata(CHANNEL_METADATA, {"id": str(channel), "topic": topic, **metadata})
        return channel

    def flush(self) -> None:
        """Close the open chunk and hand everything to the operating system."""
        self._writer.flush()

    @property
    def size(self) -> int:
        """Bytes written so far, without the open chunk."""
        return self._stream.tell()

    def close(self) -> None:
        """Write the configuration once more and the index, and close the file."""
        if not self._head:
            self.flush()
            for raw, platform in self._configuration:
                self._add(raw, platform, copy=True)
        self._writer.finish()
        self._stream.flush()
        if self._owned:
            self._stream.close()

    def __enter__(self) -> RecordingWriter:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class RecordingReader:
    """Reads a recording, whole or damaged: what cannot be read is skipped, counted and named.

    Parameters
    ----------
    path : of the file
    salvage : look for chunks even in a file that does not begin as an MCAP file

    Attributes
    ----------
    channels : id -> Channel
    index : where the messages stand
    damage : stretches of the file that cannot be read
    complete : whether the file ends as it should
    problems : counts of messages that were skipped, by kind; ``last_problem`` says what was wrong with the newest
    """

    def __init__(self, path: str | Path, *, salvage: bool = False) -> None:
        self.path = Path(path)
        with open(self.path, "rb") as file:
            self.size = file.seek(0, 2)
            if self.size == 0:
                raise UserError(f"{path}: empty, wanted an MCAP recording")
            self._buffer = memoryview(mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ))
        self._begins = self._buffer[: len(scan.MAGIC)] == scan.MAGIC
        if not self._begins and not salvage:
            raise UserError(f"{path}: not an MCAP recording")
        self.channels: dict[int, Channel] = {}
        self.damage: list[scan.Damage] = []
        self.complete = False
        self.library = ""
        self.problems: Counter[str] = Counter()
        self.last_problem = ""
        self._schemas: dict[int, tuple[int, str]] = {}
        self._data_end: scan.Record | None = None
        self._trust: dict[int, int] = {}
        self._copies: set[int] = set()
        self._chunks: list[scan.Chunk] = []
        self._content = lru_cache(maxsize=64)(self._decompress)
        self.index = self._scan()

    @property
    def n_chunks(self) -> int:
        """Whole chunks."""
        return len(self._chunks)

    # ---- what stands where

    def _scan(self) -> Index:
        columns = IndexColumns()
        if not self._begins:
            self.damage.append(scan.Damage(0, len(scan.MAGIC), "a damaged beginning"))
        for record in scan.records(self._buffer):
            if isinstance(record, scan.Damage):
                self.damage.append(record)
                continue
            offset = record.chunk.offset if isinstance(record, scan.WholeChunk) else record.offset
            try:
                self._note(record, columns)
            except ValueError as error:
                self.damage.append(scan.Damage(offset, 0, str(error)))
        for channel in set(columns.columns[2]) - set(self.channels):
            self.problems["without a channel"] += columns.columns[2].count(channel)
        return self._without_copies(columns.index())

    def _without_copies(self, index: Index) -> Index:
        """Without the copies of messages that are there; those of messages that are lost stand at the head."""

        def whose(c: Channel) -> tuple[str, str, int, str]:
            return c.topic, c.source, c.start, c.platform

        first = {whose(c): c.id for c in self.channels.values() if c.id not in self._copies}
        order = np.arange(len(index))
        channel = index.channel.copy()
        for copy in sorted(self._copies):
            rows = np.flatnonzero(index.channel == copy)
            original = first.get(whose(self.channels[copy]))
            if original is None:
                continue
            del self.channels[copy]
            lost = ~np.isin(index.sequence[rows], index.sequence[index.channel == original])
            channel[rows] = original
            order[rows] = np.where(lost, rows - len(index), len(index))
        if not self._copies:
            return index
        chosen = np.argsort(order, kind="stable")[: int((order < len(index)).sum())]
        columns = (index.chunk, index.place, channel, index.sequence, index.receive_ns, index.stamp_ns)
        return Index(*(column[chosen] for column in columns))

    def _note(self, record: scan.Record | scan.WholeChunk, columns: IndexColumns) -> None:
        if isinstance(record, scan.WholeChunk):
            number = len(self._chunks)
            self._chunks.append(record.chunk)
            done = self._note_messages(number, record.content, columns)
            for opcode, place, body in scan.chunk_records(record.content, done):
                self._note_inner(opcode, number, place, body, columns)
        elif record.opcode == scan.FOOTER:
            self.complete = self._buffer[record.end : record.end + len(scan.MAGIC)] == scan.MAGIC
            self._check_summary(record)
        elif record.opcode == scan.DATA_END:
            self._data_end = record
        elif record.opcode == scan.HEADER:
            _, position = scan.text(record.content, 0)
            self.library, _ = scan.text(record.content, position)
        elif record.opcode == scan.METADATA:
            name, position = scan.text(record.content, 0)
            if name == CHANNEL_METADATA:
                entries = scan.string_map(record.content, position)
                number = entries.get("id", "")
                self._add_channel(int(number) if number.isdigit() else 0, entries.get("topic", ""), None, entries, 1)
        else:
            self._note_inner(record.opcode, -1, record.offset, record.content, columns)

    def _note_messages(self, chunk: int, content: memoryview, columns: IndexColumns) -> int:
        """Note what stands in a chunk up to the first record that is not as it should be; returns where that is.

        As `_note_inner` of each record, in a fraction of the time: nearly all are messages.
        """
        position, last = 0, len(content) - scan.MESSAGE_RECORD.size
        unpack, add = scan.MESSAGE_RECORD.unpack_from, columns.add
        while position <= last:
            opcode, length, channel, sequence, log_time, publish_time = unpack(content, position)
            end = position + scan.RECORD_HEAD_SIZE + length
            if end > len(content):
                break
            if opcode == scan.MESSAGE and length >= scan.MESSAGE_HEAD_SIZE:
                add(chunk, position, channel, sequence, log_time, publish_time)
            else:
                body = content[position + scan.RECORD_HEAD_SIZE : end]
                self._note_inner(opcode, chunk, position, body, columns)
            position = end
        return position

    def check_outside(self) -> str | None:
        """What is wrong with the bytes outside chunks; takes as long as reading the whole file."""
        if self._data_end is None or self.damage:
            return None
        wanted = int.from_bytes(self._data_end.content[:4], "little")
        if wanted and zlib.crc32(self._buffer[: self._data_end.offset]) != wanted:
            return f"a wrong checksum outside the chunks, before byte {self._data_end.offset}"
        return None

    def _check_summary(self, footer: scan.Record) -> None:
        start = int.from_bytes(footer.content[:8], "little")
        wanted = int.from_bytes(footer.content[16:20], "little")
        covered = self._buffer[start : footer.offset + 9 + 16] if start else memoryview(b"")
        if start and wanted and zlib.crc32(covered) != wanted:
            raise ValueError("an index with a wrong checksum")

    def _note_inner(self, opcode: int, chunk: int, place: int, body: memoryview, columns: IndexColumns) -> None:
        if opcode == scan.MESSAGE:
            if len(body) < scan.MESSAGE_HEAD_SIZE:
                raise ValueError("a message without a head")
            channel, sequence, log_time, publish_time = scan.message_head(body)
            columns.add(chunk, place, channel, sequence, log_time, publish_time)
            return
        # A chunk's checksum vouches for what is defined inside; what is repeated outside only fills in.
        trust = 2 if chunk >= 0 else 0
        if opcode == scan.SCHEMA:
            number = int.from_bytes(body[:2], "little")
            if trust >= self._schemas.get(number, (0, ""))[0]:
                self._schemas[number] = trust, scan.text(body, 2)[0]
        elif opcode == scan.CHANNEL:
            number, schema = int.from_bytes(body[:2], "little"), int.from_bytes(body[2:4], "little")
            topic, position = scan.text(body, 4)
            _, position = scan.text(body, position)
            type_name = self._schemas.get(schema, (0, None))[1]  # lost with its chunk: the topic tells
            self._add_channel(number, topic, type_name, scan.string_map(body, position), trust)

    def _add_channel(
        self, number: int, topic: str, type_name: str | None, metadata: dict[str, str], trust: int
    ) -> None:
        if self._trust.get(number, -1) >= trust:
            return
        self._trust[number] = trust
        try:
            wanted = topics.find(topic).type_name
        except KeyError:
            wanted = None
        type_name = wanted if type_name is None else type_name
        if metadata.get("copy"):
            self._copies.add(number)
        start = metadata.get("start", "0")
        self.channels[number] = Channel(
            number, topic, type_name or "", metadata.get("source", ""), metadata.get("platform", ""),
            int(start) if start.isdigit() else 0, wanted is not None and wanted == type_name,
        )  # fmt: skip

    # ---- messages

    def _decompress(self, number: int) -> memoryview:
        content = self._chunks[number].data()
        if isinstance(content, str):  # it was whole when the file was opened
            raise UserError(f"{self.path}: {content}; the file has changed while it was read")
        return content

    def raw(self, number: int) -> RawMessage:
        """A message of the index, not decoded; its data are a view of the file where chunks are not compressed."""
        index = self.index
        chunk = int(index.chunk[number])
        source = self._buffer if chunk < 0 else self._content(chunk)
        body = scan.message_at(source, int(index.place[number]))
        channel = self.channels[int(index.channel[number])]
        envelope = Envelope(int(index.stamp_ns[number]), channel.source, int(index.sequence[number]), channel.start)
        return RawMessage(channel.topic, envelope, body[scan.MESSAGE_HEAD_SIZE :], int(index.receive_ns[number]))

    def raws(self, numbers: NDArray[np.int64]) -> Iterator[RawMessage]:
        """The same for many messages, one after the other."""
        index, channels = self.index, self.channels
        for begin in range(0, len(numbers), _TOGETHER):
            part = numbers[begin : begin + _TOGETHER]
            columns = (index.chunk, index.place, index.channel, index.stamp_ns, index.sequence, index.receive_ns)
            for chunk, place, of, stamp, sequence, receive in zip(*(c[part].tolist() for c in columns), strict=True):
                body = scan.message_at(self._buffer if chunk < 0 else self._content(chunk), place)
                channel = channels[of]
                envelope = Envelope(stamp, channel.source, sequence, channel.start)
                yield RawMessage(channel.topic, envelope, body[scan.MESSAGE_HEAD_SIZE :], receive)

    def select(self, wanted: Iterable[str] | None = None) -> NDArray[np.int64]:
        """Numbers of the messages of some topics (all known topics where none are named), in file order.

        A name of the topic table such as ``sensor/lines/*`` stands for all that it matches.
        """
        names = None if wanted is None else set(wanted)
        rows = [row for row in topics.TOPICS if names is not None and row.name in names]
        chosen = [
            c.id
            for c in self.channels.values()
            if c.known and (names is None or c.topic in names or any(row.matches(c.topic) for row in rows))
        ]
        return np.flatnonzero(np.isin(self.index.channel, chosen))

    def sort(self, numbers: NDArray[np.int64]) -> NDArray[np.int64]:
        """The same messages by stamp, place of the topic in the table, topic, source, start and sequence."""
        if len(numbers) == 0:
            return numbers
        order = {
            c: place
            for place, c in enumerate(
                sorted(
                    (c for c in self.channels.values() if c.known),
                    key=lambda c: (topics.rank(c.topic), c.topic, c.source, c.start, c.id),
                )
            )
        }
        size = max(self.channels, default=0) + 1
        place_of = np.zeros(size, dtype=np.int64)
        for channel, place in order.items():
            place_of[channel.id] = place
        index = self.index
        keys = (index.sequence[numbers], place_of[index.channel[numbers]], index.stamp_ns[numbers])
        return numbers[np.lexsort(keys)]

    def messages(self, wanted: Iterable[str] | None = None) -> Iterator[Message]:
        """Decoded messages in file order."""
        return self.decode(self.select(wanted))

    def sorted_messages(self, wanted: Iterable[str] | None = None) -> Iterator[Message]:
        """Decoded messages by (stamp, rank of the topic, source, sequence)."""
        return self.decode(self.sort(self.select(wanted)))

    def decode(self, numbers: Iterable[int]) -> Iterator[Message]:
        """Messages of the index, decoded; what cannot be decoded is counted in ``problems`` and left out."""
        for number in numbers:
            raw = self.raw(int(number))
            try:
                body = codec.decode(raw.topic, raw.data)
            except ValueError as error:
                self.problems["malformed"] += 1
                self.last_problem = f"{raw.topic} {raw.envelope.sequence} of {raw.envelope.source!r}: {error}"
                continue
            yield Message(raw.topic, raw.envelope.stamp_ns, body, raw.envelope.source, raw.envelope.sequence)

    def first(self, topic: str) -> Any | None:
        """The body of the first message of a topic, None where there is none."""
        message = next(iter(self.messages([topic])), None)
        return None if message is None else message.body
