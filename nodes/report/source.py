"""The messages of a recording that a report or a view needs."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from ...schemas.topics import TOPICS
from ..node import Message
from ..recording.reader import RecordingReader
from ..recording.summary import Holdings, holdings
from .flight import Flight, collect

#: Topics that reports and views do not use; most bytes of a recording are theirs.
LEFT_OUT = frozenset({"sensor/imu", "sensor/lines/*"})
WANTED = tuple(row.name for row in TOPICS if row.name not in LEFT_OUT)


def messages_of(recording: str | Path) -> Iterator[Message]:
    """Messages of a recording in the order of their stamps, without raw image lines and inertial data.

    Raises
    ------
    UserError : not a recording
    FileNotFoundError : no such file
    """
    return RecordingReader(recording, by_ranges=True).sorted_messages(WANTED)


def read(recording: str | Path) -> tuple[Flight, Holdings]:
    """The flight in a recording, and what the recording holds; both count time from the same start.

    Raises
    ------
    UserError : not a recording
    FileNotFoundError : no such file
    """
    reader = RecordingReader(recording, by_ranges=True)
    flight = collect(reader.sorted_messages(WANTED))
    held = holdings(reader)
    if held.span_ns:
        flight.start_ns, flight.end_ns = held.span_ns
    flight.not_used += held.unfit
    return flight, held
