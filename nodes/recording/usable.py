"""Which messages of a recording can be used, by the rules that hold on the bus, and in which order."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ...schemas.envelope import Envelope
from ..ordering import StreamCheck, is_orderly
from .index import Channel
from .reader import RecordingReader


@dataclass
class Usable:
    """What of a recording can be used.

    Attributes
    ----------
    numbers : of the messages, in order
    replaced : by topic, recorded messages that are made anew
    left_out : messages that are not used, by kind; ``last_problem`` says what was wrong with the last of them
    notes : what was used all the same, and should be known
    """

    numbers: NDArray[np.int64] = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    replaced: Counter[str] = field(default_factory=Counter)
    left_out: Counter[str] = field(default_factory=Counter)
    last_problem: str = ""
    notes: list[str] = field(default_factory=list)

    def drop(self, kind: str, text: str, n: int = 1) -> None:
        """Count messages that are not used."""
        self.left_out[kind] += n
        self.last_problem = text

    def told(self, kind: str, text: str) -> None:
        """What a `StreamCheck` tells: of a clock that was set back it believes the messages."""
        if kind == "clock":
            self.notes.append(text)
        else:
            self.drop(kind, text)


def usable(reader: RecordingReader, remade: Callable[[Channel], bool], heard: Callable[[str], bool]) -> Usable:
    """Messages of a recording that nodes are given.

    Parameters
    ----------
    reader : the recording
    remade : whether the messages of a channel are left out, because nodes make them anew
    heard : whether a node listens to a topic
    """
    found, index, known = Usable(), reader.index, reader.select()
    streams: dict[tuple[str, str, int], list[NDArray[np.int64]]] = {}
    for id in np.unique(index.channel[known]).tolist():
        channel = reader.channels[id]
        own = known[index.channel[known] == id]
        if remade(channel):
            found.replaced[channel.topic] += len(own)
        else:
            streams.setdefault((channel.topic, channel.source, channel.start), []).append(own)
    foreign = len(index) - len(known)
    if foreign:
        found.drop("foreign", f"{foreign} messages on topics of other programs", foreign)
    kept, doubtful = [], []
    for (topic, _, _), parts in streams.items():
        own = np.sort(np.concatenate(parts))
        (kept if is_orderly(topic, index.sequence[own], index.stamp_ns[own]) else doubtful).append(own)
    check: StreamCheck[int] = StreamCheck(found.told)
    for number in np.sort(_joined(doubtful)).tolist():
        channel = reader.channels[int(index.channel[number])]
        kept.append(np.array(check.accept(channel.topic, _envelope(reader, number), number), dtype=np.int64))
    check.end()
    found.numbers = reader.sort(_joined(kept))
    return found


def _joined(parts: list[NDArray[np.int64]]) -> NDArray[np.int64]:
    return np.concatenate([*parts, np.empty(0, dtype=np.int64)])


def _envelope(reader: RecordingReader, number: int) -> Envelope:
    index = reader.index
    channel = reader.channels[int(index.channel[number])]
    return Envelope(int(index.stamp_ns[number]), channel.source, int(index.sequence[number]), channel.start)
