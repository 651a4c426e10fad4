"""Putting messages in order: what arrives with jitter leaves in the order of its stamps.

Two steps, both without clocks and files. `StreamCheck` looks at one publisher's stream on one topic: gaps, duplicates,
time that goes backwards, clock jumps. `Sequencer` merges the streams of several topics by (stamp, place of the topic in
the table, topic, source, start, sequence), which is the order a recording is processed in; so a node gets the same
messages in the same order live and from a recording, as long as none comes later than its topic allows.
"""

from __future__ import annotations

import heapq
from collections import defaultdict
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from ..schemas import topics
from ..schemas.envelope import Envelope
from ..schemas.topics import Family

T = TypeVar("T")
Key = tuple[int, int, str, str, int, int]

MILLISECOND_NS = 1_000_000
#: A sensor whose stamps jump ahead by more is believed when its next message confirms it.
MAX_JUMP_NS = 60_000_000_000
#: So many messages in a row on an earlier time base mean that a clock was set back.
REBASE_AFTER = 5
#: So many messages in a row of one stream, with none of another source between, mean that time has gone on so far.
LEAPS_TO_CONFIRM = 3
#: Missing sequence numbers that are remembered, to tell a message out of order from a duplicate.
_REMEMBERED = 10_000
#: A number that jumps ahead by more is believed when `REBASE_AFTER` messages in a row go on from it.
MAX_SEQUENCE_JUMP = _REMEMBERED


def order_key(topic: str, envelope: Envelope) -> Key:
    """Place of a message among all others."""
    return (envelope.stamp_ns, topics.rank(topic), topic, envelope.source, envelope.start, envelope.sequence)


@dataclass
class TopicCounts:
    """What happened to the messages of a topic; names as in ``triline.TopicStatistics``."""

    received: int = 0
    gaps: int = 0
    duplicates: int = 0
    late: int = 0
    malformed: int = 0
    dropped: int = 0
    refused: int = 0  # by the node; those that are malformed come to it for a status


@dataclass
class _Stream(Generic[T]):
    """What is remembered of one run of a publisher on one topic."""

    first: int
    last: int
    last_stamp: int
    missing: dict[int, None] = field(default_factory=dict)
    before_first: set[int] = field(default_factory=set)
    base_stamp: int = 0  # newest stamp of a possible earlier time base ...
    base_count: int = 0  # ... and how many messages support it
    held: tuple[int, T] | None = None  # stamp and message after a jump ahead, waiting to be confirmed
    # messages whose numbers jumped far ahead, waiting for others that go on from them
    ahead: list[tuple[Envelope, T]] = field(default_factory=list)


def is_orderly(topic: str, sequence: NDArray[np.int64], stamp_ns: NDArray[np.int64]) -> bool:
    """Whether `StreamCheck` would let all messages of a stream pass, each at once."""
    row = topics.find(topic)
    numbers = np.diff(sequence)
    if (numbers < 1).any() or (numbers > MAX_SEQUENCE_JUMP).any():
        return False
    if row.latched or row.family is Family.STATUS:
        return True
    step = np.diff(stamp_ns)
    longest = MAX_JUMP_NS if row.family in (Family.SENSOR, Family.OBSERVATION) else np.inf
    return bool(((step >= 0) & (step <= longest)).all())


class StreamCheck(Generic[T]):
    """Checks the streams of all publishers by their envelopes alone.

    The verdict on a message depends on the messages of its own stream only, never on how streams interleave.

    Parameters
    ----------
    problem : called with (kind, text) for every message that is dropped
    """

    def __init__(self, problem: Callable[[str, str], None] | None = None) -> None:
        self.counts: defaultdict[str, TopicCounts] = defaultdict(TopicCounts)
        self._streams: dict[tuple[str, str, int], _Stream[T]] = {}
        self._problem = problem or (lambda kind, text: None)

    def accept(self, topic: str, envelope: Envelope, item: T) -> list[T]:
        """The messages that may go on because of this one: none, itself, or one held back before and itself."""
        counts = self.counts[topic]
        counts.received += 1
        key = (topic, envelope.source, envelope.start)
        stream = self._streams.get(key)
        if stream is None:
            self._streams[key] = _Stream(envelope.sequence, envelope.sequence, envelope.stamp_ns)
            return [item]
        sequence = envelope.sequence
        if sequence - stream.last > MAX_SEQUENCE_JUMP:
            return self._numbers_jump(stream, envelope, item, counts, topic)
        if stream.ahead:  # the numbers go on as before: those ahead were not of this stream
            self._drop_ahead(stream, counts, topic, envelope.source)
        if sequence <= stream.last:
            return [item] if self._is_new(stream, sequence, counts, topic, envelope) else []
        return self._next(stream, envelope, item, counts, topic)

    def end(self) -> None:
        """Nothing more comes: what is held is dropped, since nothing has confirmed it."""
        for (topic, source, _), stream in self._streams.items():
            if stream.ahead:
                self._drop_ahead(stream, self.counts[topic], topic, source, "nothing goes on from them")
            if stream.held is not None:
                self._drop_held(stream, self.counts[topic], topic, source)

    def last(self, topic: str, envelope: Envelope) -> int | None:
        """Newest number of the stream of a message; None before the first one."""
        stream = self._streams.get((topic, envelope.source, envelope.start))
        return None if stream is None else stream.last

    def lacks(self, topic: str, envelope: Envelope) -> bool:
        """Whether `accept` would take this message for one that has not come yet."""
        stream, number = self._streams.get((topic, envelope.source, envelope.start)), envelope.sequence
        if stream is None or number > stream.last:
            return True
        return number in stream.missing or (number < stream.first and number not in stream.before_first)

    def _next(self, stream: _Stream[T], envelope: Envelope, item: T, counts: TopicCounts, topic: str) -> list[T]:
        """A message with a number beyond the newest."""
        sequence = envelope.sequence
        self._note_gap(stream, sequence, counts)
        stream.last = sequence
        row = topics.find(topic)
        if row.latched or row.family is Family.STATUS:  # handed out again and again; said before time is known
            return [item]
        if envelope.stamp_ns < stream.last_stamp and stream.held is None:
            return self._earlier(stream, envelope, item, counts, topic)
        stream.base_count = 0
        if row.family in (Family.SENSOR, Family.OBSERVATION):
            return self._check_jump(stream, envelope, item, counts, topic)
        stream.last_stamp = envelope.stamp_ns
        return [item]

    def _numbers_jump(
        self, stream: _Stream[T], envelope: Envelope, item: T, counts: TopicCounts, topic: str
    ) -> list[T]:
        """A number far ahead is held until others go on from it: a long loss, and not somebody in another's name."""
        if stream.ahead and not 0 < envelope.sequence - stream.ahead[-1][0].sequence <= MAX_SEQUENCE_JUMP:
            self._drop_ahead(stream, counts, topic, envelope.source)
        stream.ahead.append((envelope, item))
        if len(stream.ahead) < REBASE_AFTER:
            return []
        ahead, stream.ahead = stream.ahead, []
        return [out for e, held in ahead for out in self._next(stream, e, held, counts, topic)]

    def _drop_ahead(
        self, stream: _Stream[T], counts: TopicCounts, topic: str, source: str, why: str = "others go on before it"
    ) -> None:
        jump, number = stream.ahead[0][0].sequence - stream.last, len(stream.ahead)
        counts.malformed += number
        stream.ahead.clear()
        for _ in range(number):
            self._problem("malformed", f"{topic} of {source!r}: numbers jump ahead by {jump}, and {why}")

    def _drop_held(self, stream: _Stream[T], counts: TopicCounts, topic: str, source: str) -> None:
        assert stream.held is not None
        ahead_s = (stream.held[0] - stream.last_stamp) / 1e9
        stream.held = None
        counts.malformed += 1
        self._problem("malformed", f"{topic} of {source!r}: a stamp jumps ahead by {ahead_s:g} s")

    def _is_new(self, stream: _Stream[T], sequence: int, counts: TopicCounts, topic: str, envelope: Envelope) -> bool:
        """Whether a number below the newest is a message out of order and not a duplicate."""
        if sequence in stream.missing:
            del stream.missing[sequence]
            counts.gaps -= 1
            return True
        if sequence < stream.first and sequence not in stream.before_first:
            stream.before_first.add(sequence)
            return True
        counts.duplicates += 1
        self._problem("duplicate", f"{topic} {sequence} of {envelope.source!r} came twice")
        return False

    @staticmethod
    def _note_gap(stream: _Stream[T], sequence: int, counts: TopicCounts) -> None:
        missing = sequence - stream.last - 1
        counts.gaps += missing
        for number in range(max(stream.last + 1, sequence - _REMEMBERED), sequence):
            stream.missing[number] = None
        while len(stream.missing) > _REMEMBERED:
            del stream.missing[next(iter(stream.missing))]

    def _earlier(self, stream: _Stream[T], envelope: Envelope, item: T, counts: TopicCounts, topic: str) -> list[T]:
        """A stamp before the one of the message before it."""
        stream.base_count = stream.base_count + 1 if envelope.stamp_ns >= stream.base_stamp else 1
        stream.base_stamp = envelope.stamp_ns
        if stream.base_count >= REBASE_AFTER:
            back_s = (stream.last_stamp - envelope.stamp_ns) / 1e9
            stream.base_count, stream.last_stamp = 0, envelope.stamp_ns
            self._problem("clock", f"{topic} of {envelope.source!r}: the clock was set back by {back_s:g} s")
            return [item]
        counts.malformed += 1
        back = f"time goes back by {(stream.last_stamp - envelope.stamp_ns) / 1e9:g} s"
        self._problem("malformed", f"{topic} {envelope.sequence} of {envelope.source!r}: {back}")
        return []

    def _check_jump(self, stream: _Stream[T], envelope: Envelope, item: T, counts: TopicCounts, topic: str) -> list[T]:
        """A stamp far ahead is held until the next message shows whether time really went on."""
        stamp = envelope.stamp_ns
        out: list[T] = []
        if stream.held is not None:
            held_stamp, held = stream.held
            if 0 <= stamp - held_stamp <= MAX_JUMP_NS:
                out.append(held)
                stream.held, stream.last_stamp = None, held_stamp
            else:
                self._drop_held(stream, counts, topic, envelope.source)
                if stamp < stream.last_stamp:
                    return self._earlier(stream, envelope, item, counts, topic)
        if stamp - stream.last_stamp > MAX_JUMP_NS:
            stream.held = (stamp, item)
            return out
        stream.last_stamp = stamp
        return [*out, item]


@dataclass
class _Watermark:
    """How far one stream (or a topic nobody has spoken on) has come."""

    place: tuple[int, str, str]
    lateness_ns: int
    grace_s: float
    on_events: bool
    in_bursts: bool
    latest_ns: int
    heard_s: float


class PlatformTime:
    """How far platform time is, by all that has come, and which streams have another time than all others.

    One clock that is an hour ahead is not the time of the platform; all of them are, after a pause. Another source
    confirms a stamp far ahead of all that has come, or a third message of its stream with nothing between: two of them
    come together where a clock has jumped, since `StreamCheck` holds the first one.

    Attributes
    ----------
    newest_ns : newest stamp that has come; None before the first one
    """

    def __init__(self) -> None:
        self.newest_ns: int | None = None
        self._time_ns: int | None = None  # the same without observations
        self._ahead: dict[tuple[str, str], int] = {}  # messages in a row that were far ahead, by topic and source
        # since the last message that was not far ahead: of each stream how many were, and the last one's stamp
        self._leapt: dict[tuple[str, str], tuple[int, int]] = {}

    @property
    def ns(self) -> int | None:
        """Newest stamp that has come; observations count only where nothing else has."""
        return self.newest_ns if self._time_ns is None else self._time_ns

    def ahead(self, topic: str, envelope: Envelope) -> int:
        """How many messages of a stream in a row, with this one, were far ahead of all others.

        A message that is not tells how far time is.
        """
        stamp, key = envelope.stamp_ns, (topic, envelope.source)
        if self._leaps(topic, envelope):
            self._ahead[key] = self._ahead.get(key, 0) + 1
            return self._ahead[key]
        self._ahead.pop(key, None)
        if self.newest_ns is None or stamp > self.newest_ns:
            self.newest_ns = stamp
        of_time = topics.find(topic).family is not Family.OBSERVATION
        if of_time and (self._time_ns is None or stamp > self._time_ns):
            self._time_ns = stamp
        return 0

    def own_clock(self, topic: str, envelope: Envelope) -> str:
        """What is said of a stream that has a clock of its own."""
        ahead_s = (envelope.stamp_ns - (self.ns or 0)) / 1e9
        return (
            f"{topic} of {envelope.source!r} is stamped {ahead_s:.1f} s ahead of everything else and is left out: "
            "its clock is wrong, or all others are"
        )

    def _leaps(self, topic: str, envelope: Envelope) -> bool:
        stamp, time_ns = envelope.stamp_ns, self.ns
        if time_ns is None or stamp - time_ns <= MAX_JUMP_NS:
            self._leapt.clear()
            return False
        key = topic, envelope.source
        near = {of: n for of, (n, before) in self._leapt.items() if abs(stamp - before) <= MAX_JUMP_NS}
        number = near.get(key, 0) + 1
        self._leapt[key] = number, stamp
        if number < LEAPS_TO_CONFIRM and all(source == envelope.source for _, source in near):
            return True
        self._leapt.clear()
        return False


class Sequencer(Generic[T]):
    """Merges streams into the order of `order_key`.

    A message leaves when no other stream can still bring one that belongs before it: the stream has passed it, or has
    been silent while platform time went on by more than the allowed lateness of its topic. A steady stream (one with a
    high rate, or that the table grants grace) must also have been silent for ``grace_s`` (or that grace) of waiting
    time, so that a machine that hesitates does not change the order. A topic on which something is said only now and
    then (control, strips) or in bursts holds nothing up while its publisher is heard on other topics: a session
    delivers in the order in which it was published, and the stamps of a source never go back from one of its topics to
    the next. A burst may go on with the stamp of what its publisher has said last on another topic. A topic without
    allowed lateness holds nothing up while nobody speaks on it: before it was heard, and after its grace. What arrives
    after its place has passed leaves at once, and is called late. Observations may be stamped ahead (when they are to
    be used), so they do not tell how far platform time is, unless nobody else does or a steady stream has died. What
    only tells how far its publisher is is heard, and goes no further: who begins to speak while others are already past
    what it says has told nothing wrong.

    Parameters
    ----------
    inputs : topics of the table that are listened to
    grace_s : waiting time granted to steady streams, s
    problem : called with (kind, text) for every message that is left out, because its stream has a clock of its own
    """

    STEADY_HZ = 100.0

    def __init__(
        self, inputs: Iterable[str], *, grace_s: float = 0.5, problem: Callable[[str, str], None] | None = None
    ) -> None:
        self._problem = problem or (lambda kind, text: None)
        self._heap: list[tuple[Key, int, T]] = []
        self._grace_s = grace_s
        self.ready = False
        self._arrivals = 0
        self._time = PlatformTime()
        self._released: Key | None = None
        self._flushed = False  # since it was released
        self._streams: dict[tuple[str, str], _Watermark] = {}
        self._sources: dict[str, tuple[int, tuple[int, str, str]]] = {}  # newest stamp of each, and its place
        self._unheard = {row.name: row for row in topics.TOPICS if row.name in set(inputs)}
        self._started_s: float | None = None

    def __len__(self) -> int:
        return len(self._heap)

    @property
    def newest_ns(self) -> int | None:
        """Newest stamp that has arrived; observations count only where nothing else has."""
        return self._time.ns

    def push(self, topic: str, envelope: Envelope, item: T, now_s: float) -> T | None:
        """Take a message that arrived at waiting time ``now_s`` (any steady clock); returns it if it came late."""
        stamp = envelope.stamp_ns
        if self._started_s is None:
            self._started_s = now_s
        ahead = self._time.ahead(topic, envelope)
        if ahead > REBASE_AFTER:
            if ahead == REBASE_AFTER + 1:
                self._leave_out(topic, envelope)
            self._problem("clock", self._time.own_clock(topic, envelope))
            return None
        if ahead:  # it waits for its place, and tells nothing about how far time is
            self._arrivals += 1
            heapq.heappush(self._heap, (order_key(topic, envelope), self._arrivals, item))
            return None
        row = topics.find(topic)
        self.hear(topic, envelope, now_s)
        if row.order_only:
            return None
        key = order_key(topic, envelope)
        if self._released is not None and key < self._released and not (self._flushed and stamp == self._released[0]):
            return item
        self._arrivals += 1
        heapq.heappush(self._heap, (key, self._arrivals, item))
        return None

    def _leave_out(self, topic: str, envelope: Envelope) -> None:
        """Drop those messages of a stream that wait far ahead: it has a clock of its own."""
        latest_ns, before = (self._time.newest_ns or 0) + MAX_JUMP_NS, len(self._heap)
        self._heap = [x for x in self._heap if x[0][0] <= latest_ns or (x[0][2], x[0][3]) != (topic, envelope.source)]
        heapq.heapify(self._heap)
        for _ in range(before - len(self._heap)):
            self._problem("clock", self._time.own_clock(topic, envelope))

    def hear(self, topic: str, envelope: Envelope, now_s: float) -> None:
        """Note who speaks on a topic, and how far they are; all there is to it for what is worked off elsewhere."""
        stream = self._streams.get((topic, envelope.source))
        if stream is None:
            row = topics.find(topic)
            self._unheard.pop(row.name, None)
            place = (topics.rank(topic), topic, envelope.source)
            lateness, grace_s = self._patience(row)
            on_events = row.in_bursts or row.rate_hz == 0
            stream = _Watermark(place, lateness, grace_s, on_events, row.in_bursts, envelope.stamp_ns, now_s)
            self._streams[topic, envelope.source] = stream
        stream.latest_ns = max(stream.latest_ns, envelope.stamp_ns)
        said = envelope.stamp_ns, (topics.rank(topic), topic, envelope.source)
        self._sources[envelope.source] = max(self._sources.get(envelope.source, said), said)
        stream.heard_s = now_s

    def pop(self, now_s: float, most: int | None = None) -> list[T]:
        """The messages whose turn has come, in order; if there are more than ``most``, `ready` is set."""
        out: list[T] = []
        self.ready = False
        while self._heap and self._may_leave(self._heap[0][0], now_s):
            if most is not None and len(out) == most:
                self.ready = True
                break
            out.append(self._take())
            self._flushed = False
        return out

    def flush(self, ahead: bool = True) -> list[T]:
        """Everything that waits, in order; on request without observations that are stamped ahead of time.

        What comes later with the stamp of the last of it, as from a node that ends, is not late.
        """
        out: list[T] = []
        self._flushed = True
        newest_ns = self.newest_ns
        while self._heap and (ahead or newest_ns is None or self._heap[0][0][0] <= newest_ns):
            out.append(self._take())
        return out

    def _take(self) -> T:
        key, _, item = heapq.heappop(self._heap)
        self._released = key
        return item

    def _may_leave(self, key: Key, now_s: float) -> bool:
        stamp, rank, topic, source = key[:4]
        newest_ns, time_ns = self._time.newest_ns, self._time.ns
        assert newest_ns is not None and time_ns is not None and self._started_s is not None
        place = (rank, topic, source)
        for stream in self._streams.values():
            if stream.place == place:
                continue
            silent = not now_s - stream.heard_s < stream.grace_s
            if silent and not stream.lateness_ns:
                continue
            bound = stream.latest_ns, stream.place
            if stream.on_events:
                said = self._sources[stream.place[2]]
                # two updates may have one stamp: the report of the first does not end the points of the second
                bound = max(bound, min(said, (said[0], stream.place)) if stream.in_bursts else said)
            if silent:
                bound = max(bound, ((newest_ns if stream.grace_s else time_ns) - stream.lateness_ns, stream.place))
            if bound < (stamp, place):
                return False
        for row in self._unheard.values():
            lateness, grace_s = self._patience(row)
            if now_s - self._started_s < min(grace_s, self._grace_s):
                return False
            if lateness and (newest_ns if grace_s else time_ns) - lateness <= stamp:
                return False
        return True

    def _patience(self, row: topics.Topic) -> tuple[int, float]:
        """Allowed lateness in ns, and the waiting time granted to a topic that is expected to speak all the time."""
        steady = row.rate_hz >= Sequencer.STEADY_HZ and not row.latched
        grace_s = self._grace_s if steady else row.grace_s
        return round(row.allowed_lateness_ms * MILLISECOND_NS), grace_s
