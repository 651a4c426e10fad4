"""The index of a recording: where its channels and messages stand."""

from __future__ import annotations

from array import array
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

#: Name of the metadata record that repeats a channel outside the chunks.
CHANNEL_METADATA = "triline.channel"


@dataclass(frozen=True, slots=True)
class Channel:
    """A channel of a recording.

    Attributes
    ----------
    known : whether topic and type are in the topic table
    every : only messages whose number this divides are meant to be there
    """

    id: int
    topic: str
    type_name: str
    source: str
    platform: str
    start: int
    known: bool
    every: int = 1


#: A message as it stands in a recording: channel, stamp, sequence number, payload, time of reception.
Recorded = tuple[Channel, int, int, bytes | memoryview, int]
#: Times beyond are taken for it: the index holds signed numbers.
LAST_NS = 0x7FFFFFFFFFFFFFFF


@dataclass
class Index:
    """Where every message of a recording stands, in file order: arrays of one length.

    Attributes
    ----------
    chunk : number of the chunk, -1 for a message outside chunks
    place : where the record begins, in its chunk or in the file
    channel, sequence : as in the record
    receive_ns, stamp_ns : log time and publish time, ns since the Unix epoch
    """

    chunk: NDArray[np.int64]
    place: NDArray[np.int64]
    channel: NDArray[np.int64]
    sequence: NDArray[np.int64]
    receive_ns: NDArray[np.int64]
    stamp_ns: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.chunk)

    def take(self, rows: NDArray[np.int64]) -> Index:
        """Some of the messages, in this order."""
        return Index(*(getattr(self, name)[rows] for name in self.__dataclass_fields__))

    @classmethod
    def of_rows(cls, rows: array[int]) -> Index:
        """The index from its rows, one behind the other; in them the first chunk is 1, and 0 is outside chunks."""
        table = np.frombuffer(rows, dtype=np.uint64).reshape(-1, 6) if rows else np.empty((0, 6), np.uint64)
        columns = np.minimum(table.T, LAST_NS).astype(np.int64, order="C")
        columns[0] -= 1
        return cls(*columns)
