"""Writing recordings: MCAP files of messages with their envelopes.

One channel stands for one run of one publisher on one topic. What all else depends on, the configuration, stands in a
chunk of its own at the head, and once more at the end, on channels marked as copies; readers take a copy only where the
first one is lost. Publish time is the platform stamp, log time the time of reception, and the channel's metadata name
the source; so a recording explains itself and keeps both times apart.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import IO

from mcap.well_known import MessageEncoding, SchemaEncoding
from mcap_protobuf.schema import build_file_descriptor_set

from ...schemas import codec, topics
from ...schemas.envelope import Envelope, RawMessage
from ..node import Message
from .index import CHANNEL_METADATA, Recorded
from .mcap_writer import McapWriter

LIBRARY = "triline"
COMPRESSIONS = {"none": "", "lz4": "lz4", "zstd": "zstd"}
_SEQUENCE_MASK = 0xFFFFFFFF


class RecordingWriter:
    """Writes a recording; the same messages give the same bytes.

    Parameters
    ----------
    target : path of the file, or an open binary file (which stays open)
    compression : ``none``, ``lz4`` or ``zstd``
    platform : name of the platform, kept with each channel
    chunk_size : bytes after which a chunk is closed
    every : of a topic only each message whose number this divides is meant to be there (`bus.downlink`); kept with each
        channel, so that the others are not taken for lost. Channels of another recording keep what they say there
    """

    def __init__(
        self,
        target: str | Path | IO[bytes],
        compression: str = "none",
        *,
        platform: str = "demo",
        chunk_size: int = 1 << 20,
        every: Callable[[str], int] = lambda topic: 1,
    ) -> None:
        if compression not in COMPRESSIONS:
            raise ValueError(f"compression {compression!r}, wanted one of {', '.join(COMPRESSIONS)}")
        self._owned = isinstance(target, (str, Path))
        self._stream: IO[bytes] = (
            open(target, "wb") if isinstance(target, (str, Path)) else target  # noqa: SIM115  # closed by close
        )
        self._writer = McapWriter(self._stream, chunk_size, COMPRESSIONS[compression], LIBRARY)
        self._platform = platform
        self._every = every
        self._schemas: dict[str, int] = {}
        self._channels: dict[tuple[str, str, int, str, bool], int] = {}
        self._configuring: dict[str, bool] = {}  # topics that were met
        self._last: dict[tuple[str, str], tuple[int, int]] = {}
        self._plain: dict[tuple[str, str, int], int] = {}  # channels of messages that need nothing else
        self._head = True
        self._configuration: list[tuple[RawMessage, str | None]] = []
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

    def write_raw(self, raw: RawMessage, platform: str | None = None, every: int = 1) -> None:
        """Add a message that is encoded already, of a channel of which only every so many are meant to be there."""
        topic, (stamp_ns, source, sequence, start), data, receive_ns = raw
        channel = self._plain.get((topic, source, start)) if platform is None else None
        if channel is None:
            self._write_first(raw, platform, every)
        else:
            self._writer.add_message(channel, receive_ns, data, stamp_ns, sequence & _SEQUENCE_MASK)

    def write_recorded(self, messages: Iterable[Recorded]) -> None:
        """Add messages of another recording, received when they were stamped."""
        plain, add = self._plain, self._writer.add_message
        for of, stamp_ns, sequence, data, _ in messages:
            channel = plain.get((of.topic, of.source, of.start))
            if channel is None:
                envelope = Envelope(stamp_ns, of.source, sequence, of.start)
                self._write_first(RawMessage(of.topic, envelope, data, stamp_ns), None, of.every)
            else:
                add(channel, stamp_ns, data, stamp_ns, sequence & _SEQUENCE_MASK)

    def _write_first(self, raw: RawMessage, platform: str | None, every: int) -> None:
        """Add a message of the configuration, or one that may be the first of its channel or platform."""
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
        channel = self._add(raw, platform, every)
        if platform is None and not configuring:
            self._plain[raw.topic, raw.envelope.source, raw.envelope.start] = channel

    def _add(self, raw: RawMessage, platform: str | None, every: int = 1, *, copy: bool = False) -> int:
        topic, (stamp_ns, source, sequence, start), data, receive_ns = raw
        key = (topic, source, start, platform or self._platform, copy)
        channel = self._channels.get(key)
        if channel is None:
            channel = self._channels[key] = self._register(*key, max(every, self._every(topic)))
        number = sequence & _SEQUENCE_MASK
        self._writer.add_message(channel, receive_ns, data, stamp_ns, number)
        return channel

    def _register(self, topic: str, source: str, start: int, platform: str, copy: bool, every: int) -> int:
        row = topics.find(topic)
        schema = self._schemas.get(row.type_name)
        if schema is None:
            content = build_file_descriptor_set(row.type).SerializeToString()
            schema = self._writer.register_schema(row.type_name, SchemaEncoding.Protobuf, content)
            self._schemas[row.type_name] = schema
        metadata = {"source": source, "platform": platform}
        if start:
            metadata["start"] = str(start)
        if copy:
            metadata["copy"] = "yes"
        if every > 1:
            metadata["every"] = str(every)
        channel = self._writer.register_channel(topic, MessageEncoding.Protobuf, schema, metadata)
        # A channel stands in the first chunk that uses it; written once more outside chunks it survives that chunk.
        self._writer.add_metadata(CHANNEL_METADATA, {"id": str(channel), "topic": topic, **metadata})
        return channel

    @property
    def counts(self) -> Counter[str]:
        """Messages by topic."""
        counts, by_channel = Counter[str](), self._writer.counts
        for (topic, _, _, _, copy), channel in self._channels.items():
            if not copy:
                counts[topic] += by_channel[channel]
        return counts

    def channel_of(self, topic: str, source: str, start: int) -> int | None:
        """Id of the channel of a run of a publisher on a topic; None before its first message."""
        return self._channels.get((topic, source, start, self._platform, False))

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
