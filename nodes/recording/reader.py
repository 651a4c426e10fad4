"""Reading recordings, whole or damaged: MCAP files of messages with their envelopes, laid out as `writer` says.

Of a recording that lies elsewhere (a URL) can be fetched only what is asked for; see `ranges`.
"""

from __future__ import annotations

import mmap
import zlib
from array import array
from collections import Counter
from collections.abc import Iterable, Iterator
from functools import lru_cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from mcap.opcode import Opcode
from mcap.records import Channel as McapChannel
from mcap.records import Chunk, DataEnd, Footer, Header, McapRecord, Metadata, Schema
from mcap.records import Message as McapMessage
from numpy.typing import NDArray

from ...schemas import codec, topics
from ...schemas.envelope import Envelope, RawMessage
from ..convert import same_frame
from ..errors import UserError
from ..node import Message
from ..truth_frames import TruthFrames
from ..voices import FIXED, VERDICT, RecordedVoices
from . import mcap_scan as scan
from .index import CHANNEL_METADATA, Channel, Index, Recorded
from .ranges import Ranged, open_ranged
from .remote import RemoteFile, RemotePath, path_of

_PROJECT, _CAMERA = FIXED
#: Rows of the index that are looked up together.
_TOGETHER = 8192
#: Records that the index is made of; the others repeat it for readers that take the file as whole.
_NOTED = {
    Opcode.HEADER, Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE, Opcode.METADATA, Opcode.DATA_END, Opcode.FOOTER,
}  # fmt: skip
#: What the index behind a chunk begins with: channel, length of what follows; a message has its number in this place.
_INDEX_HEAD = 6


class RecordingReader:
    """Reads a recording, whole or damaged: what cannot be read is skipped, counted and named.

    Parameters
    ----------
    path : of the file, or its URL
    salvage : look for chunks even in a file that does not begin as an MCAP file
    by_ranges : fetch only those messages of a URL that are asked for; nothing then compares the checksums of
        uncompressed chunks. One whose end does not say where its messages stand is fetched whole all the same

    Attributes
    ----------
    channels : id -> Channel
    remote : the file elsewhere, None for one that is here
    damage : stretches of the file that cannot be read
    complete : whether the file ends as it should
    attachments : files in the recording, which no command reads
    problems : counts of messages that were skipped, by kind; ``last_problems`` says what was wrong with the newest
    """

    def __init__(self, path: str | Path, *, salvage: bool = False, by_ranges: bool = False) -> None:
        self.path = path_of(path)
        self.remote = RemoteFile(self.path) if isinstance(self.path, RemotePath) else None
        if self.remote is not None:
            self.size, self._buffer = self.remote.size, self.remote.buffer
            self.remote.fetch(0, len(scan.MAGIC))
        else:
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
        self.attachments = 0
        self.library = ""
        self._frame_begins_ns: int | None = None
        self.problems: Counter[str] = Counter()
        self.last_problems: dict[str, str] = {}
        self._schemas: dict[int, tuple[int, str]] = {}
        self._data_end: tuple[int, int] | None = None  # where it begins, checksum of all before
        self._trust: dict[int, int] = {}
        self._copies: set[int] = set()
        self._chunks: list[Chunk] = []
        self._content = lru_cache(maxsize=64)(self._load)
        self._ranged: Ranged | None = None
        if self.remote is not None:
            if by_ranges and self._begins:
                self._ranged = self._scan_end(self.remote)
            if self._ranged is None:
                self.remote.fetch_all()
        self._index = self._scan() if self._ranged is None else self._ranged.index

    @property
    def n_chunks(self) -> int:
        """Whole chunks."""
        return len(self._chunks if self._ranged is None else self._ranged.chunks)

    @property
    def compression(self) -> str:
        """Of the first whole chunk, as `RecordingWriter` takes it."""
        return (self._chunks[0].compression if self._chunks else "") or "none"

    @property
    def by_ranges(self) -> bool:
        """Whether messages are fetched when they are asked for."""
        return self._ranged is not None

    @property
    def channel_of(self) -> NDArray[np.int64]:
        """The channel of each message of the index (n,), without looking at the messages."""
        return self._index.channel

    def stamps(self, numbers: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Stamps, ns, and sequence numbers of messages of the index, both (k,)."""
        self._know(numbers)
        return self._index.stamp_ns[numbers], self._index.sequence[numbers]

    @property
    def index(self) -> Index:
        """Where the messages stand, and when they were sent."""
        if self._ranged is not None:
            self._know(np.arange(len(self._index)))
        return self._index

    # ---- what stands where

    def _scan(self) -> Index:
        rows = array("Q")
        if not self._begins:
            self.damage.append(scan.Damage(0, len(scan.MAGIC), "a damaged beginning"))
        for found in scan.records(self._buffer):
            if isinstance(found, scan.Damage):
                self.damage.append(found)
                continue
            try:
                if isinstance(found, scan.WholeChunk):
                    self._chunks.append(found.chunk)
                    self._note_content(found.content, rows)
                elif found.opcode in _NOTED:
                    self._note(found, rows)
                elif found.opcode == Opcode.ATTACHMENT:
                    self.attachments += 1
            except ValueError as error:
                self.damage.append(scan.Damage(found.offset, 0, str(error)))
        index = Index.of_rows(rows)
        self.problems["without a channel"] += int((~np.isin(index.channel, list(self.channels))).sum())
        return index.take(self._without_copies(index)) if self._copies else index

    def _scan_end(self, file: RemoteFile) -> Ranged | None:
        """The same from the end of a file elsewhere; None where the end does not say it."""
        try:
            ranged = open_ranged(file)
            end = self.size - len(scan.MAGIC)
            self._check_summary(ranged.footer, end)
            header = scan.parse(self._first_record(file))
            self.library = header.library if isinstance(header, Header) else ""
            for record in ranged.summary:
                self._define(record, 2)
            index = ranged.index
            self.problems["without a channel"] += int((~np.isin(index.channel, list(self.channels))).sum())
            copied = {self.channels[number].topic for number in self._copies}
            twice = [c.id for c in self.channels.values() if c.topic in copied]
            ranged.heads(np.flatnonzero(np.isin(index.channel, twice)))
            ranged.take(self._without_copies(index))
        except ValueError:
            self.channels, self._schemas, self._trust, self._copies = {}, {}, {}, set()
            self.problems.clear()
            return None
        self.complete = True
        return ranged

    def _first_record(self, file: RemoteFile) -> memoryview:
        begin = len(scan.MAGIC)
        end = begin + scan.RECORD_HEAD.size + min(scan.RECORD_HEAD.unpack_from(self._buffer, begin)[1], 1 << 16)
        file.fetch(begin, end)
        return self._buffer[begin:end]

    def _know(self, numbers: NDArray[np.int64]) -> None:
        """Have number and stamps of messages here."""
        if self._ranged is not None:
            try:
                self._ranged.heads(numbers)
            except ValueError as error:
                raise UserError(f"{self.path}: {error}; a copy on this machine can be checked and recovered") from None

    def _without_copies(self, index: Index) -> NDArray[np.int64]:
        """Which messages to take, in order: no copies of messages that are there; those of lost ones come first."""

        def whose(c: Channel) -> tuple[str, str, int, str]:
            return c.topic, c.source, c.start, c.platform

        first = {whose(c): c.id for c in self.channels.values() if c.id not in self._copies}
        order = np.arange(len(index))
        before = index.channel.copy()
        for copy in sorted(self._copies):
            rows = np.flatnonzero(before == copy)
            original = first.get(whose(self.channels[copy]))
            if original is None:
                continue
            del self.channels[copy]
            lost = ~np.isin(index.sequence[rows], index.sequence[before == original])
            index.channel[rows] = original
            order[rows] = np.where(lost, rows - len(index), len(index))
        return np.argsort(order, kind="stable")[: int((order < len(index)).sum())]

    def _note(self, found: scan.Record, rows: array[int]) -> None:
        """Note a record outside chunks."""
        record = scan.parse(found.data)
        match record:
            case McapMessage() if self._data_end is not None:
                raise ValueError("a message behind the end of the data")
            case McapMessage() if (
                self._chunks and scan.MESSAGE_HEAD.size + len(record.data) == _INDEX_HEAD + record.sequence
            ):
                # one flipped bit makes a message of the index behind a chunk; its length then stands for the number
                raise ValueError("a message with the shape of an index")
            case McapMessage():
                rows.extend((0, found.offset, record.channel_id, record.sequence, record.log_time, record.publish_time))
            case Header():
                self.library = record.library
            case Metadata(name=name, metadata=entries) if name == CHANNEL_METADATA:
                number = entries.get("id", "")
                self._add_channel(int(number) if number.isdigit() else 0, entries.get("topic", ""), None, entries, 0)
            case DataEnd():
                self._data_end = found.offset, record.data_section_crc
            case Footer():
                self.complete = self._buffer[found.end : found.end + len(scan.MAGIC)] == scan.MAGIC
                self._check_summary(record, found.end)
            case _:
                self._define(record, 1)

    def _note_content(self, content: memoryview, rows: array[int]) -> None:
        """Note what stands in a chunk: messages, and what defines their channels.

        The library makes an object of each message it reads, which takes four times as long.
        """
        chunk, position, size = len(self._chunks), 0, len(content)
        head, head_size, message_head = scan.RECORD_HEAD.unpack_from, scan.RECORD_HEAD.size, scan.MESSAGE_HEAD
        while position < size:
            if position + head_size > size:
                raise ValueError("a chunk that ends inside a record")
            opcode, length = head(content, position)
            end = position + head_size + length
            if end > size:
                raise ValueError("a chunk that ends inside a record")
            if opcode == Opcode.MESSAGE:
                if length < message_head.size:
                    raise ValueError("a message without a head")
                rows.extend((chunk, position, *message_head.unpack_from(content, position + head_size)))
            elif opcode in _NOTED:
                self._define(scan.parse(content[position:end]), 2)
            position = end

    @property
    def grows(self) -> bool:
        """Whether the file has become longer since it was opened; one elsewhere is not looked at again."""
        try:
            return self.remote is None and self.path.stat().st_size > self.size
        except OSError:
            return False

    def check_outside(self) -> str | None:
        """What is wrong with the bytes outside chunks; takes as long as reading the whole file."""
        if self._data_end is None or self.damage:
            return None
        end, wanted = self._data_end
        if wanted and zlib.crc32(self._buffer[:end]) != wanted:
            return f"a wrong checksum outside the chunks, before byte {end}"
        return None

    def _check_summary(self, footer: Footer, end: int) -> None:
        """Raise ValueError where the checksum of summary and footer is wrong; the footer ends there."""
        start, wanted = footer.summary_start, footer.summary_crc
        if start and wanted and zlib.crc32(self._buffer[start : end - 4]) != wanted:
            raise ValueError("an index with a wrong checksum")

    def _define(self, record: McapRecord, trust: int) -> None:
        """Note a schema or a channel.

        A chunk's checksum vouches for what is defined inside (``trust`` 2); what stands outside (1) only fills in, and
        metadata that repeat a channel (0) where it is lost: other programs keep them and number channels anew.
        """
        if isinstance(record, Schema):
            if trust >= self._schemas.get(record.id, (0, ""))[0]:
                self._schemas[record.id] = trust, record.name
        elif isinstance(record, McapChannel):
            type_name = self._schemas.get(record.schema_id, (0, None))[1]  # lost with its chunk: the topic tells
            self._add_channel(record.id, record.topic, type_name, record.metadata, trust)

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
        (self._copies.add if metadata.get("copy") else self._copies.discard)(number)
        start, every = (metadata.get(name, "") for name in ("start", "every"))
        self.channels[number] = Channel(
            number, topic, type_name or "", metadata.get("source", ""), metadata.get("platform", ""),
            int(start) if start.isdigit() else 0, wanted is not None and wanted == type_name,
            max(int(every), 1) if every.isdigit() else 1,
        )  # fmt: skip

    # ---- messages

    def _load(self, number: int) -> memoryview:
        try:
            if self._ranged is not None:
                return self._ranged.content(number)
            return scan.chunk_content(self._chunks[number])
        except ValueError as error:  # it was whole when the file was opened
            raise UserError(f"{self.path}: {error}; the file has changed while it was read") from None

    def raw(self, number: int) -> RawMessage:
        """A message of the index, not decoded; its data are a view of the file where chunks are not compressed."""
        return next(self.raws(np.array([number])))

    def raws(self, numbers: NDArray[np.int64]) -> Iterator[RawMessage]:
        """The same for many messages, one after the other."""
        for channel, stamp, sequence, data, receive in self.recorded(numbers):
            yield RawMessage(channel.topic, Envelope(stamp, channel.source, sequence, channel.start), data, receive)

    def recorded(self, numbers: NDArray[np.int64]) -> Iterator[Recorded]:
        """The same without their envelopes, which take half of the time."""
        index, channels = self._index, self.channels
        content, of_chunk = self._buffer, -1
        for begin in range(0, len(numbers), _TOGETHER):
            part = numbers[begin : begin + _TOGETHER]
            if self._ranged is not None:
                self._know(part)
                self._ranged.payloads(part)
            columns = (index.chunk, index.place, index.channel, index.stamp_ns, index.sequence, index.receive_ns)
            for chunk, place, of, stamp, sequence, receive in zip(*(c[part].tolist() for c in columns), strict=True):
                if chunk != of_chunk:
                    content, of_chunk = self._buffer if chunk < 0 else self._content(chunk), chunk
                yield channels[of], stamp, sequence, scan.payload_at(content, place), receive

    def topics_with_messages(self) -> set[str]:
        """Known topics that have messages: a file can announce a channel whose chunks are gone."""
        held = set(self._index.channel.tolist())
        return {c.topic for c in self.channels.values() if c.known and c.id in held}

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
        return np.flatnonzero(np.isin(self._index.channel, chosen))

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
        self._know(numbers)
        index = self._index
        keys = (index.sequence[numbers], place_of[index.channel[numbers]], index.stamp_ns[numbers])
        return numbers[np.lexsort(keys)]

    def messages(self, wanted: Iterable[str] | None = None) -> Iterator[Message]:
        """Decoded messages in file order."""
        return self.decode(self.select(wanted))

    def sorted_messages(self, wanted: Iterable[str] | None = None) -> Iterator[Message]:
        """Decoded messages by (stamp, rank of the topic, source, sequence)."""
        return self.decode(self.sort(self.select(wanted)))

    def decode(self, numbers: NDArray[np.int64]) -> Iterator[Message]:
        """Messages of the index, decoded; what cannot be decoded is counted in ``problems`` and left out."""
        for raw in self.raws(numbers):
            try:
                body = codec.decode(raw.topic, raw.data)
            except ValueError as error:
                kind = "impossible" if isinstance(error, codec.ImpossibleValues) else "malformed"
                self.note_problem(kind, f"{raw.topic} {raw.envelope.sequence} of {raw.envelope.source!r}: {error}")
                continue
            e = raw.envelope
            yield Message(raw.topic, e.stamp_ns, body, e.source, e.sequence, e.start)

    def note_problem(self, kind: str, text: str) -> None:
        """Count a message that is skipped."""
        self.problems[kind] += 1
        self.last_problems[kind] = text

    def first(self, topic: str) -> Any | None:
        """The body of the first message of a topic, None where there is none."""
        message = next(iter(self.messages([topic])), None)
        return None if message is None else message.body

    def last(self, topic: str) -> Any | None:
        """The body of the last message of a topic by stamp, which replaces the others; None where there is none.

        Of project and camera: of the last that nodes use, which take no other one in flight without an operator's word.
        """
        numbers = self.sort(self.select([topic]))
        if topic in FIXED and len(numbers) > 1:
            bodies = [message.body for message in self.decode(numbers)]
            if any(body != bodies[0] for body in bodies):
                return self._last_used(topic)[0]
        message = next(iter(self.decode(numbers[::-1])), None)
        return None if message is None else message.body

    def frame_begins_ns(self) -> int:
        """Stamp from which on results are in the local frame of the project; 0 where it has been the same all along.

        Another project that an operator lets in in flight may have another origin or CRS.
        """
        if self._frame_begins_ns is None:
            bodies = [message.body for message in self.sorted_messages([_PROJECT])]
            changes = any(not same_frame(body, bodies[0]) for body in bodies)
            self._frame_begins_ns = self._last_used(_PROJECT)[1] if changes else 0
        return self._frame_begins_ns

    def camera_begins_ns(self) -> int:
        """Stamp from which on nodes used the last camera; 0 where it was not let in in flight."""
        used = list(self._all_used(_CAMERA)) if len(self.select([_CAMERA])) > 1 else []
        changes = [other.stamp_ns for one, other in pairwise(used) if one.body != other.body]
        if not changes:
            return 0
        flown_ns, _ = self.stamps(self.first_flown())
        return changes[-1] if (flown_ns < changes[-1]).any() else 0

    def in_frame(self, messages: Iterable[Message]) -> Iterator[Message]:
        """Those of results that are in the local frame of the project; of truth, those whose source had it."""
        begin_ns = self.frame_begins_ns()
        if not begin_ns:
            return iter(messages)
        # of each source the project that it had since then: a change of it would be another begin
        project, frames = None, TruthFrames()
        for used in self._all_used(_PROJECT):
            project = used.body
            frames.note(used)
        return (x for x in messages if x.stamp_ns >= begin_ns and not frames.is_elsewhere(x, project))

    def first_flown(self) -> NDArray[np.int64]:
        """Numbers of the first message of each channel that tells that a flight has begun."""
        flown = [c.id for c in self.channels.values() if c.known and topics.begins_flight(c.topic)]
        numbers = np.flatnonzero(np.isin(self.channel_of, flown))
        return numbers[np.unique(self.channel_of[numbers], return_index=True)[1]]

    def _last_used(self, topic: str) -> tuple[Any | None, int]:
        """The last project or camera that nodes use; and when the local frame of a project was last given up, ns."""
        body, given_up_ns = None, 0
        for used in self._all_used(topic):
            if topic == _PROJECT and body is not None and not same_frame(used.body, body):
                given_up_ns = used.stamp_ns
            body = used.body
        return body, given_up_ns

    def _all_used(self, topic: str) -> Iterator[Message]:
        """The projects or cameras that nodes use, in order of time."""
        voices = RecordedVoices()
        for message in self.decode(self.sort(np.union1d(self.select([topic, VERDICT]), self.first_flown()))):
            yield from (used for used in voices.used(message) if used.topic == topic)
