"""The index of a recording: where its channels and messages stand."""

from __future__ import annotations

from array import array
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class Channel:
    """A channel of a recording; ``known`` where topic and type are in the topic table."""

    id: int
    topic: str
    type_name: str
    source: str
    platform: str
    start: int
    known: bool


#: Times beyond are taken for it: the index holds signed numbers.
LAST_NS = 0x7FFFFFFFFFFFFFFF


@dataclass
class Index:
    """Where every message of a recording stands, in file order: arrays of one length."""

    chunk: NDArray[np.int64]
    place: NDArray[np.int64]
    channel: NDArray[np.int64]
    sequence: NDArray[np.int64]
    receive_ns: NDArray[np.int64]
    stamp_ns: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.chunk)


@dataclass
class IndexColumns:
    """The index while it grows."""

    columns: list[array[int]] = field(default_factory=lambda: [array("q") for _ in range(6)])

    def add(self, chunk: int, place: int, channel: int, sequence: int, receive_ns: int, stamp_ns: int) -> None:
        chunks, places, channels, sequences, received, stamps = self.columns
        chunks.append(chunk)
        places.append(place)
        channels.append(channel)
        sequences.append(sequence)
        received.append(receive_ns if receive_ns < LAST_NS else LAST_NS)
        stamps.append(stamp_ns if stamp_ns < LAST_NS else LAST_NS)

    def index(self) -> Index:
        return Index(*(np.frombuffer(c, dtype=np.int64) if c else np.empty(0, np.int64) for c in self.columns))
