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
from ...solver.navigation.clock_check import LARGEST_DELAY_S, offset_in_words
from ..last_problems import shortened
from ..ordering import MAX_JUMP_NS, MILLISECOND_NS, REBASE_AFTER, PlatformTime, StreamCheck, is_orderly
from .index import Channel
from .reader import RecordingReader

#: Whose set-back the navigator sees by itself, and says so.
_WATCHED = "sensor/gnss"
#: Attitudes or inertial data with a longer step between them, ns, tell no time; so many fixes are enough to say that
#: their clock is another one.
_STEADY_NS, _FIXES = 1_000_000_000, 10


@dataclass
class Usable:
    """What of a recording can be used.

    Attributes
    ----------
    numbers : of the messages, in order
    replaced : by topic, recorded messages that are made anew
    left_out : messages that are not used, by kind; ``last_problems`` says what was wrong with the last of each
    notes : what was used all the same, and should be known
    """

    numbers: NDArray[np.int64] = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    replaced: Counter[str] = field(default_factory=Counter)
    left_out: Counter[str] = field(default_factory=Counter)
    last_problems: dict[str, str] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)

    def drop(self, kind: str, text: str, n: int = 1) -> None:
        """Count messages that are not used."""
        self.left_out[kind] += n
        self.last_problems[kind] = shortened(text)

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
    if doubtful:
        numbers = _not_set_back(reader, numbers, heard, found)
    _tell_clocks_apart(reader, numbers, heard, found)
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


def _not_set_back(
    reader: RecordingReader, numbers: NDArray[np.int64], heard: Callable[[str], bool], found: Usable
) -> NDArray[np.int64]:
    """The same without what a sensor said of times that had passed when its clock was set back.

    On the bus it comes late, and the navigator takes no attitude and no inertial data out of order; sorted by their
    stamps they would be mixed with those that were measured then.
    """
    index, timed = reader.index, _timed(reader, numbers, heard)
    left = []
    for id in np.unique(index.channel[timed]).tolist():
        channel = reader.channels[id]
        row = topics.find(channel.topic)
        own = timed[index.channel[timed] == id]
        stamps = index.stamp_ns[own]
        passed = np.maximum.accumulate(stamps)
        if row.family is not Family.SENSOR or channel.topic == _WATCHED or (passed == stamps).all():
            continue
        # how far the others were when it came
        others = timed[index.channel[timed] != id]
        newest = np.maximum.accumulate(np.append(0, index.stamp_ns[others]))[np.searchsorted(others, own)]
        lateness_ns = round(row.allowed_lateness_ms * MILLISECOND_NS)
        in_order = index.sequence[own] == np.maximum.accumulate(index.sequence[own])
        late = in_order & (stamps < passed) & (stamps < newest - lateness_ns)
        if late.any():
            back_s = float((passed - stamps)[late].max()) / 1e9
            text = (
                f"{channel.topic} of {channel.source!r} told times again after its clock was set back by {back_s:g} s"
            )
            found.drop("late", text, int(late.sum()))
            left.append(own[late])
    return np.setdiff1d(numbers, _joined(left))


def _tell_clocks_apart(
    reader: RecordingReader, numbers: NDArray[np.int64], heard: Callable[[str], bool], found: Usable
) -> None:
    """Tell that fixes have other stamps than the inertial data or attitudes that were received with them.

    On the bus their nodes see that by themselves; sorted by their stamps they go together, with the positions of other
    times.
    """
    index, channels = reader.index, reader.channels

    def of(topic: str) -> NDArray[np.int64]:
        ids = [id for id, channel in channels.items() if channel.known and channel.topic == topic and heard(topic)]
        return numbers[np.isin(index.channel[numbers], ids)]

    fixes = of(_WATCHED)
    for topic in ("sensor/imu", "sensor/attitude"):
        own = of(topic)
        at = np.searchsorted(own, fixes)
        inside = (at > 0) & (at < len(own))
        before, after = index.stamp_ns[own[at[inside] - 1]], index.stamp_ns[own[at[inside]]]
        steady = np.abs(after - before) < _STEADY_NS
        behind_s = (before - index.stamp_ns[fixes[inside]])[steady] / 1e9
        if len(behind_s) >= _FIXES and abs(median := float(np.median(behind_s))) > LARGEST_DELAY_S:
            words = offset_in_words(median, "inertial" if topic == "sensor/imu" else "attitude")
            found.notes.append(f"{words}, by what was received together")
