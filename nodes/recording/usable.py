"""Which messages of a recording can be used, by the rules that hold on the bus, and in which order."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ...schemas import topics
from ...schemas.envelope import Envelope
from ...schemas.topics import Family
from ..ordering import MAX_JUMP_NS, REBASE_AFTER, PlatformTime, StreamCheck, is_orderly
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
    numbers = np.sort(_joined(kept))
    numbers = _of_one_clock(reader, numbers, heard, found)
    found.numbers = reader.sort(numbers)
    return found


def _joined(parts: list[NDArray[np.int64]]) -> NDArray[np.int64]:
    return np.concatenate([*parts, np.empty(0, dtype=np.int64)])


def _envelope(reader: RecordingReader, number: int) -> Envelope:
    index = reader.index
    channel = reader.channels[int(index.channel[number])]
    return Envelope(int(index.stamp_ns[number]), channel.source, int(index.sequence[number]), channel.start)


def _timed(reader: RecordingReader, numbers: NDArray[np.int64], heard: Callable[[str], bool]) -> NDArray[np.int64]:
    """Those of messages, in file order, by whose stamps nodes see how far time is."""
    families = (Family.SENSOR, Family.OBSERVATION, Family.RESULT)
    ids = [
        c.id
        for c in reader.channels.values()
        if c.known and topics.find(c.topic).family in families and not topics.find(c.topic).latched and heard(c.topic)
    ]
    return numbers[np.isin(reader.index.channel[numbers], ids)]


def _of_one_clock(
    reader: RecordingReader, numbers: NDArray[np.int64], heard: Callable[[str], bool], found: Usable
) -> NDArray[np.int64]:
    """The same without streams that are stamped far ahead of all others, as a `Sequencer` leaves them out."""
    timed = _timed(reader, numbers, heard)
    stamps = reader.index.stamp_ns[timed]
    if not len(timed) or not (stamps[1:] - np.maximum.accumulate(stamps)[:-1] > MAX_JUMP_NS).any():
        return numbers
    time, waiting, left = PlatformTime(), dict[tuple[str, str], list[int]](), list[int]()
    for number in timed.tolist():
        topic, envelope = reader.channels[int(reader.index.channel[number])].topic, _envelope(reader, number)
        ahead, key = time.ahead(topic, envelope), (topic, envelope.source)
        if not ahead:
            waiting.pop(key, None)
            continue
        waiting.setdefault(key, []).append(number)
        if ahead > REBASE_AFTER:
            found.drop("clock", time.own_clock(topic, envelope), len(waiting[key]))
            left += waiting[key]
            waiting[key].clear()
    return np.setdiff1d(numbers, left)
