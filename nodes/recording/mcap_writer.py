"""Writing an MCAP file of many small messages.

Records are those of the MCAP library, which writes them; only messages and their index, which come by the thousand, are
packed here. The library's own writer makes an object of each message, and writes each field of it and of its index by
itself, which takes five times as long (`bench/recordings.py`). The bytes are the same.
"""

from __future__ import annotations

import struct
import zlib
from collections import Counter
from collections.abc import Callable, Sequence
from typing import IO, Any

import lz4.frame
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)

from .mcap_scan import MAGIC, MESSAGE_HEAD

#: How chunks can be compressed, by the name that stands in them.
COMPRESSORS: dict[str, Callable[[bytearray], Any]] = {
    "": lambda content: content, "lz4": lz4.frame.compress, "zstd": zstandard.compress,
}  # fmt: skip
#: A message up to its data: opcode, length of what follows; channel, sequence number, log time, publish time.
_MESSAGE = struct.Struct("<BQ" + MESSAGE_HEAD.format.removeprefix("<"))
_IS_MESSAGE, _HEAD_LENGTH = int(Opcode.MESSAGE), MESSAGE_HEAD.size
#: A footer before its checksum.
_FOOTER = struct.Struct("<BQQQ")


class McapWriter:
    """Writes messages into chunks, with all checksums and indexes; the same calls give the same bytes.

    Parameters
    ----------
    stream : open binary file at its beginning; stays open
    chunk_size : bytes after which a chunk is closed
    compression : of chunks, one of `COMPRESSORS`
    library : name of the writing program
    """

    def __init__(self, stream: IO[bytes], chunk_size: int, compression: str, library: str) -> None:
        self._stream, self._chunk_size, self._compression = stream, chunk_size, compression
        self._crc = 0  # of all that has been written
        self._schemas: list[Schema] = []
        self._channels: list[Channel] = []
        self._metadata: list[MetadataIndex] = []
        self._chunks: list[ChunkIndex] = []
        self._counts: Counter[int] = Counter()  # messages by channel
        self._begin_chunk()
        self._write(MAGIC)
        self._write(_bytes_of(Header("", library)))

    def register_schema(self, name: str, encoding: str, data: bytes) -> int:
        """Id of a new schema."""
        self._schemas.append(Schema(id=len(self._schemas) + 1, data=data, encoding=encoding, name=name))
        self._open += _bytes_of(self._schemas[-1])
        self._close_full_chunk()
        return len(self._schemas)

    def register_channel(self, topic: str, encoding: str, schema: int, metadata: dict[str, str]) -> int:
        """Id of a new channel."""
        number = len(self._channels) + 1
        self._channels.append(Channel(number, topic, encoding, metadata, schema))
        self._open += _bytes_of(self._channels[-1])
        self._close_full_chunk()
        return number

    def add_message(
        self, channel: int, log_time: int, data: bytes | memoryview, publish_time: int, sequence: int
    ) -> None:
        """Add a message of a channel; times in ns."""
        chunk = self._open
        head = _MESSAGE.pack(_IS_MESSAGE, _HEAD_LENGTH + len(data), channel, sequence, log_time, publish_time)
        rows = self._index.get(channel)
        if rows is None:
            rows = self._index[channel] = []
        rows += (log_time, len(chunk))
        chunk += head
        chunk += data
        if len(chunk) > self._chunk_size:
            self._close_chunk()

    def add_metadata(self, name: str, metadata: dict[str, str]) -> None:
        """Write metadata, before the open chunk."""
        record = _bytes_of(Metadata(name=name, metadata=metadata))
        self._metadata.append(MetadataIndex(offset=self._stream.tell(), length=len(record), name=name))
        self._write(record)

    def flush(self) -> None:
        """Close the open chunk, if there are messages in it, and hand everything to the operating system."""
        self._close_chunk()
        self._stream.flush()

    def finish(self) -> None:
        """Write the last chunk and the index."""
        self._close_chunk()
        self._stream.write(_bytes_of(DataEnd(self._crc)))
        begin = self._stream.tell()
        summary, offsets = RecordBuilder(), list[SummaryOffset]()
        for opcode, records in (
            (Opcode.SCHEMA, self._schemas), (Opcode.CHANNEL, self._channels), (Opcode.STATISTICS, [self._statistics()]),
            (Opcode.CHUNK_INDEX, self._chunks), (Opcode.ATTACHMENT_INDEX, []), (Opcode.METADATA_INDEX, self._metadata),
        ):  # fmt: skip
            place = summary.count
            _write_all(records, summary)
            offsets.append(SummaryOffset(opcode, begin + place, summary.count - place))
        offsets_begin = begin + summary.count
        _write_all(offsets, summary)
        content = summary.end()
        head = _FOOTER.pack(Opcode.FOOTER, 20, begin, offsets_begin)
        self._stream.write(content)
        self._stream.write(_bytes_of(Footer(begin, offsets_begin, zlib.crc32(head, zlib.crc32(content)))))
        self._stream.write(MAGIC)

    @property
    def counts(self) -> Counter[int]:
        """Messages by channel."""
        return self._counts + Counter({channel: len(rows) // 2 for channel, rows in self._index.items()})

    def _begin_chunk(self) -> None:
        self._open = bytearray()
        self._index: dict[int, list[int]] = {}  # of each channel: log time and place in the chunk, in turn

    def _close_full_chunk(self) -> None:
        if len(self._open) > self._chunk_size:
            self._close_chunk()

    def _close_chunk(self) -> None:
        if not self._index:
            return
        content, index = self._open, self._index
        data = COMPRESSORS[self._compression](content)
        chunk = Chunk(
            self._compression, data, max(max(rows[::2]) for rows in index.values()),
            min(min(rows[::2]) for rows in index.values()), zlib.crc32(content), len(content),
        )  # fmt: skip
        record, begin = _bytes_of(chunk), self._stream.tell()
        self._write(record)
        places, rows_begin = {}, self._stream.tell()
        builder = RecordBuilder()
        for channel, rows in index.items():
            places[channel] = rows_begin + builder.count
            builder.start_record(Opcode.MESSAGE_INDEX)
            builder.write2(channel)
            builder.write4(8 * len(rows))
            builder.write(struct.pack(f"<{len(rows)}Q", *rows))
            builder.finish_record()
            self._counts[channel] += len(rows) // 2
        rows_length = builder.count
        self._write(builder.end())
        self._chunks.append(
            ChunkIndex(
                len(record), begin, chunk.compression, len(data), chunk.message_end_time, rows_length, places,
                chunk.message_start_time, chunk.uncompressed_size,
            )
        )  # fmt: skip
        self._begin_chunk()

    def _statistics(self) -> Statistics:
        return Statistics(
            attachment_count=0,
            channel_count=len(self._channels),
            channel_message_counts=self._counts,
            chunk_count=len(self._chunks),
            message_count=self._counts.total(),
            message_end_time=max((c.message_end_time for c in self._chunks), default=0),
            message_start_time=min((c.message_start_time for c in self._chunks), default=0),
            metadata_count=len(self._metadata),
            schema_count=len(self._schemas),
        )

    def _write(self, data: bytes) -> None:
        self._crc = zlib.crc32(data, self._crc)
        self._stream.write(data)


def _bytes_of(record: McapRecord) -> bytes:
    builder = RecordBuilder()
    record.write(builder)
    return builder.end()


def _write_all(records: Sequence[McapRecord], builder: RecordBuilder) -> None:
    for record in records:
        record.write(builder)
