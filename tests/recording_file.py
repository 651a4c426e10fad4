"""Recordings of messages, for tests of what reads them."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from triline.nodes.node import Message
from triline.nodes.recording import RecordingWriter


def write_recording(path: Path, messages: Iterable[Message], **options) -> Path:
    """Write messages in their order; return the path."""
    with RecordingWriter(path, **options) as writer:
        for message in messages:
            writer.write(message)
    return path
