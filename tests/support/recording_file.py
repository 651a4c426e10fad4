"""Recordings of messages, for tests of what reads them."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from mcap.reader import make_reader

from triline.nodes.node import Message
from triline.nodes.recording.reader import RecordingReader
from triline.nodes.recording.writer import RecordingWriter


def write_recording(path: Path, messages: Iterable[Message], **options) -> Path:
    """Write messages in their order; return the path."""
    with RecordingWriter(path, **options) as writer:
        for message in messages:
            writer.write(message)
    return path


def without_topics(path: Path, out: Path, *topics: str) -> Path:
    """Write a recording again, without topics that begin so; return the path of what is left."""
    messages = RecordingReader(path).sorted_messages()
    return write_recording(out, (message for message in messages if not message.topic.startswith(topics)))


def payloads(path: Path, topic: str) -> list[tuple[int, int, bytes]]:
    """Stamp, number and payload of the messages of a topic, in order."""
    reader = RecordingReader(path)
    raws = [reader.raw(int(n)) for n in reader.sort(reader.select([topic]))]
    return [(raw.envelope.stamp_ns, raw.envelope.sequence, bytes(raw.data)) for raw in raws]


def bodies_of(path: Path, topic: str) -> list[tuple[int, bytes]]:
    """Stamp and content of the messages of a topic, in order; the same content gives the same bytes."""
    messages = RecordingReader(path).sorted_messages([topic])
    return [(message.stamp_ns, message.body.SerializeToString(deterministic=True)) for message in messages]


def chunk_spans(path: Path) -> list[tuple[int, int]]:
    """Where each chunk of a whole recording begins and ends, as the MCAP library reads it in the summary."""
    with open(path, "rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    return [(c.chunk_start_offset, c.chunk_start_offset + c.chunk_length) for c in summary.chunk_indexes]
