"""Messages of a recording that is still being written, found again by their numbers.

A recorder closes its chunks every few tenths of a second. What is remembered is small: between which bytes of which
file a stretch stands, and the lowest and highest number of each stream in it. Who asks for some numbers makes the
reader walk over the heads of the messages in these stretches; payloads of others, image lines above all, are not
touched.
"""

from __future__ import annotations

import mmap
import threading
from array import array
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple, cast

from mcap.opcode import Opcode
from mcap.records import Chunk

from ...schemas.envelope import Envelope, RawMessage
from . import mcap_scan as scan
from .writer import RecordingWriter


class Stream(NamedTuple):
    """One run of one publisher on one topic."""

    topic: str
    source: str
    start: int


@dataclass
class _Marks:
    """Where the messages of a stream stand: of each stretch its place in the list, lowest and highest number."""

    stretch: array[int] = field(default_factory=lambda: array("Q"))
    lowest: array[int] = field(default_factory=lambda: array("Q"))
    highest: array[int] = field(default_factory=lambda: array("Q"))


class Reread:
    """Finds messages again that a recorder has written; safe in several threads."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._stretches: list[tuple[Path, int, int]] = []
        self._marks: dict[Stream, _Marks] = {}
        self._channels: dict[tuple[Path, Stream], int] = {}
        self._open: dict[Stream, tuple[int, int]] = {}

    def note(self, raw: RawMessage) -> None:
        """A message was handed to the writer."""
        stream, number = Stream(raw.topic, raw.envelope.source, raw.envelope.start), raw.envelope.sequence
        lowest, highest = self._open.get(stream, (number, number))
        self._open[stream] = min(lowest, number), max(highest, number)

    def closed(self, path: Path, begin: int, end: int, writer: RecordingWriter) -> None:
        """All that was noted stands between two bytes of a file."""
        with self._lock:
            self._stretches.append((path, begin, end))
            for stream, (lowest, highest) in self._open.items():
                marks = self._marks.setdefault(stream, _Marks())
                marks.stretch.append(len(self._stretches) - 1)
                marks.lowest.append(lowest)
                marks.highest.append(highest)
                channel = writer.channel_of(*stream)
                if channel is not None:
                    self._channels[path, stream] = channel
        self._open.clear()

    def forget_open(self) -> None:
        """What was noted since the last stretch never came to the disk."""
        self._open.clear()

    def streams(self) -> dict[Stream, tuple[int, int]]:
        """Lowest and highest number of each stream on the disk."""
        with self._lock:
            return {stream: (min(marks.lowest), max(marks.highest)) for stream, marks in self._marks.items()}

    def read(self, stream: Stream, runs: Sequence[tuple[int, int]], every: int = 1) -> list[RawMessage]:
        """Messages of a stream with numbers in runs (first and last, both included) that ``every`` divides; by number.

        Stretches that are gone from the disk are passed over.
        """
        with self._lock:
            marks = self._marks.get(stream, _Marks())
            found = [
                self._stretches[stretch]
                for stretch, lowest, highest in zip(marks.stretch, marks.lowest, marks.highest, strict=True)
                if any(lowest <= last and highest >= first for first, last in runs)
            ]
            channels = {path: self._channels.get((path, stream)) for path, _, _ in found}
        wanted: dict[int, RawMessage] = {}
        for path, begin, end in found:
            channel = channels[path]
            for number, log_ns, stamp_ns, data in () if channel is None else _messages(path, begin, end, channel):
                if number % every == 0 and any(first <= number <= last for first, last in runs):
                    envelope = Envelope(stamp_ns, stream.source, number, stream.start)
                    wanted[number] = RawMessage(stream.topic, envelope, data, log_ns)
        return [wanted[number] for number in sorted(wanted)]


def _messages(path: Path, begin: int, end: int, channel: int) -> list[tuple[int, int, int, bytes]]:
    """Number, time of reception, stamp and payload of the messages of a channel in a stretch of a file."""
    try:
        with (
            open(path, "rb") as file,
            mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content,
            memoryview(content) as whole,
            whole[begin:end] as stretch,
        ):
            return _of_channel(stretch, channel)
    except (OSError, ValueError):  # moved away, or cut
        return []


def _of_channel(stretch: memoryview, channel: int) -> list[tuple[int, int, int, bytes]]:
    found, position, head = [], 0, scan.RECORD_HEAD
    while position + head.size <= len(stretch):
        opcode, length = head.unpack_from(stretch, position)
        end = position + head.size + length
        if end > len(stretch):
            break
        if opcode == Opcode.CHUNK:
            chunk = cast(Chunk, scan.parse(stretch[position:end]))
            # what is not compressed is not read as a whole, so its checksum is not looked at
            packed = bool(chunk.compression)
            records = scan.chunk_content(chunk) if packed else memoryview(chunk.data)
            found += _in_records(records, channel)
            if not packed:
                records.release()
            del chunk
        position = end
    return found


def _in_records(records: memoryview, channel: int) -> list[tuple[int, int, int, bytes]]:
    found, position, head, size = [], 0, scan.RECORD_HEAD, scan.MESSAGE_HEAD.size
    while position + head.size <= len(records):
        opcode, length = head.unpack_from(records, position)
        body, position = position + head.size, position + head.size + length
        if opcode == Opcode.MESSAGE and length >= size:
            of, number, log_ns, stamp_ns = scan.MESSAGE_HEAD.unpack_from(records, body)
            if of == channel:
                found.append((number, log_ns, stamp_ns, bytes(records[body + size : position])))
    return found
