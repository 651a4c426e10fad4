"""The runner over recordings: nodes one after the other, inputs and outputs in one order."""

from __future__ import annotations

import heapq
import time
from collections import Counter
from collections.abc import Callable, Container, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import count
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...schemas import codec, topics
from ...schemas.envelope import Envelope, RawMessage
from ...schemas.topics import Family
from ..last_problems import shortened
from ..node import Message, Node
from ..ordering import Key, order_key
from ..step_driver import StepDriver, failure_words
from ..voices import VERDICT
from .index import Recorded
from .reader import RecordingReader
from .runner_apart import Ahead
from .summary import time_span_ns
from .usable import usable


@dataclass
class ProcessSummary:
    """What a run over a recording did.

    Attributes
    ----------
    nodes : names of the nodes that ran
    inputs, outputs : messages by topic
    replaced : recorded messages by topic that the nodes made anew
    dropped : messages that were not usable, by kind; ``last_problems`` says what was wrong with the last of each
    notes : what of the recording was used and should be known
    counters : per node, what it counted
    problems, problems_by_kind : per node, its last problem, and the last of each kind that it counts
    failed : per node whose work failed, how often, and at what first
    states : per node, what it said of itself at the end
    first_ns, last_ns : platform time of what was measured and computed, 0 without any
    """

    nodes: list[str] = field(default_factory=list)
    inputs: Counter[str] = field(default_factory=Counter)
    outputs: Counter[str] = field(default_factory=Counter)
    replaced: Counter[str] = field(default_factory=Counter)
    dropped: Counter[str] = field(default_factory=Counter)
    notes: list[str] = field(default_factory=list)
    last_problems: dict[str, str] = field(default_factory=dict)
    counters: dict[str, dict[str, int]] = field(default_factory=dict)
    problems: dict[str, str] = field(default_factory=dict)
    problems_by_kind: dict[str, dict[str, str]] = field(default_factory=dict)
    failed: dict[str, str] = field(default_factory=dict)
    states: dict[str, str] = field(default_factory=dict)
    first_ns: int = 0
    last_ns: int = 0

    def drop(self, kind: str, text: str, n: int = 1) -> None:
        """Count messages that are not usable."""
        self.dropped[kind] += n
        self.last_problems[kind] = shortened(text)

    def add(self, other: ProcessSummary) -> None:
        """What other nodes of the same run did; inputs are counted once."""
        self.outputs += other.outputs
        self.dropped += other.dropped
        self.last_problems |= other.last_problems
        self.counters |= other.counters
        self.problems |= other.problems
        self.problems_by_kind |= other.problems_by_kind
        self.failed |= other.failed
        self.states |= other.states


def active_nodes(nodes: Sequence[Node], recorded: Iterable[str]) -> list[Node]:
    """The nodes that have something to work on, those that make another's input before it.

    A node is active if one of its inputs that is not latched is recorded, or made by an active node.
    """
    available = set(recorded)
    active: list[Node] = []
    waiting = list(nodes)
    while waiting:
        ready = [node for node in waiting if any(_is_made(name, available) for name in node.inputs if _drives(name))]
        if not ready:
            break
        # Of the nodes that are ready, one that needs no other ready node's output goes first.
        chosen = next(
            (n for n in ready if not any(o in n.inputs for other in waiting if other is not n for o in other.outputs)),
            ready[0],
        )
        active.append(chosen)
        waiting.remove(chosen)
        available.update(chosen.outputs)
    return active


def is_remade(topic: str, source: str, made: Container[str], makers: Container[str]) -> bool:
    """Whether a recorded message is left out, because nodes make it anew.

    Observations of somebody else (measured targets beside matched tie points) stay, and strips that were announced.

    ``made`` are the outputs of the nodes that run, ``makers`` their names. Events are left out where one of these told
    them; what live nodes said of their own health is no input of anything.
    """
    if topics.find(topic).family is Family.STATUS:
        return topic.startswith("status/") or source in makers
    if topics.find(topic).family in (Family.OBSERVATION, Family.CONFIGURATION):
        return topic in made and source in makers
    return topic in made


def _drives(name: str) -> bool:
    row = topics.find(name)
    return not row.latched and row.family is not Family.CONFIGURATION and name != VERDICT


def _is_made(name: str, available: set[str]) -> bool:
    row = topics.find(name)
    return any(name == topic or (row.matches(topic) and row.name == name) for topic in available)


def process(
    reader: RecordingReader,
    nodes: Sequence[Node],
    write: Callable[[RawMessage], None],
    progress: Callable[[float], None] | None = None,
    apart: bool = False,
    instead: Mapping[str, bytes] | None = None,
    copy: Callable[[Sequence[Recorded]], None] | None = None,
) -> ProcessSummary:
    """Run nodes over a recording, as fast as it goes.

    Parameters
    ----------
    reader : the recording
    nodes : the nodes; those with nothing to work on stay out
    write : takes inputs and outputs, in the order of `order_key`, of topics that are recorded; receive time = stamp
    progress : told the fraction that is done, now and then
    apart : the nodes before the last may run in a process of their own, if they need nothing of it; what comes out is
        the same
    instead : payload in place of the recorded one, by topic
    copy : takes inputs in place of ``write``, many at once, in the same order; most of them need no envelope
    """
    copy = copy or (lambda messages: _each(write, messages))
    write = _as_recorded(write)
    summary = ProcessSummary()
    running = active_nodes(nodes, reader.topics_with_messages())
    summary.nodes = [node.name for node in running]
    made = {name for node in running for name in node.outputs}
    drivers = [StepDriver(node) for node in running]
    recording, listening = _Recorded(reader, instead or {}), _Listening(drivers)
    found = usable(
        reader, lambda channel: is_remade(channel.topic, channel.source, made, summary.nodes),
        lambda topic: bool(listening[topic]),
    )  # fmt: skip
    numbers = found.numbers
    summary.replaced, summary.dropped, summary.notes = found.replaced, found.left_out, found.notes
    summary.last_problems = found.last_problems
    summary.first_ns, summary.last_ns = time_span_ns(reader, numbers) or (0, 0)
    last = _begin_of_end(reader, numbers, drivers)
    told = _Progress(progress, len(numbers))
    if apart and Ahead.possible() and len(running) > 1 and not _feeds(running[-1], running[:-1]):
        line = _Line(drivers[-1:], write, copy, summary, checked=True)
        ahead = Ahead(
            lambda: _handed_on(recording, numbers, last, drivers[:-1], drivers[-1:]), " and ".join(summary.nodes[:-1])
        )
        try:
            done = 0
            for batch in ahead:
                before, done = done, _take(batch, recording, numbers, done, line, summary)
                told.add(done - before)
        finally:
            ahead.close()
        summary.counters = {name: summary.counters.get(name, {}) for name in summary.nodes[:-1]} | summary.counters
    else:
        line = _Line(drivers, write, copy, summary)
        for part in _parts(numbers[:last]):
            line.take(recording.messages(part))
            told.add(len(part))
        line.begin_end()
        for part in _parts(numbers[last:]):
            line.take(recording.messages(part))
            told.add(len(part))
        line.work_off()
    line.finish()
    for topic in [name for name in summary.outputs if not topics.find(name).recorded]:
        del summary.outputs[topic]
    return summary


#: Messages of a recording that are taken together.
TOGETHER = 256
#: The end of a recording, in which messages wait for their turn at each node, begins so long before its newest message
#: that tells time, ns: sensors of a flight that was ended do not fall silent at the same moment, but within a second.
END_NS = 1_000_000_000
#: Families of messages that tell how far platform time is; observations may be stamped ahead of it.
_TELL_TIME = (Family.CONFIGURATION, Family.SENSOR, Family.RESULT)
#: A message that a node has made, on its way from the other process: topic, stamp, source, number, payload.
Flat = tuple[str, int, str, int, bytes]
#: What is handed on from there: how many recorded messages are next (negative: are next, and are left out), or what a
#: node has made; None where the end begins and after each part of it (`_Line`); at last what the nodes there said.
Item = int | Flat | ProcessSummary | None


def _parts(numbers: NDArray[np.int64]) -> Iterator[NDArray[np.int64]]:
    """Numbers that are taken together."""
    for begin in range(0, len(numbers), TOGETHER):
        yield numbers[begin : begin + TOGETHER]


def _begin_of_end(reader: RecordingReader, numbers: NDArray[np.int64], drivers: Sequence[StepDriver]) -> int:
    """At which of the inputs, which are in order, the end of the recording begins."""
    listening = _Listening(drivers)
    tell = [
        id
        for id, channel in reader.channels.items()
        if channel.known and topics.find(channel.topic).family in _TELL_TIME and listening[channel.topic]
    ]
    stamps = reader.index.stamp_ns[numbers]
    telling = stamps[np.isin(reader.index.channel[numbers], tell)]
    return int(np.searchsorted(stamps, telling.max() - END_NS, side="right")) if len(telling) else len(numbers)


def _handed_on(
    recording: _Recorded,
    numbers: NDArray[np.int64],
    last: int,
    drivers: Sequence[StepDriver],
    others: Sequence[StepDriver],
) -> Iterator[Item]:
    """The first nodes over the recording: what they hand on to the others, in order."""
    summary = ProcessSummary()
    handed: list[Item] = []
    line = _Line(
        drivers, lambda raw: handed.append(_flat(raw)), lambda messages: handed.append(len(messages)), summary, others,
        leave_out=lambda: handed.append(-1), part_over=lambda: handed.append(None),
    )  # fmt: skip
    for part in _parts(numbers[:last]):
        line.take(recording.messages(part))
        yield from handed
        handed.clear()
    yield None
    line.begin_end()
    for part in _parts(numbers[last:]):
        line.take(recording.messages(part))
        yield from handed
        handed.clear()
    line.work_off()
    line.finish()
    yield from handed
    yield summary


def _take(
    batch: list[Item], recording: _Recorded, numbers: NDArray[np.int64], done: int, line: _Line, summary: ProcessSummary
) -> int:
    """The last node's part of a batch, in front of which some of the recording has been done; returns how much has
    been then."""
    for item in batch:
        if isinstance(item, int):
            if item > 0:
                line.take(recording.messages(numbers[done : done + item]))
            done += abs(item)
        elif isinstance(item, tuple):
            topic, stamp_ns, source, sequence, data = item
            line.take_made(RawMessage(topic, Envelope(stamp_ns, source, sequence), data, stamp_ns))
        elif item is not None:
            summary.add(item)
        elif line.ending:
            line.work_off()
        else:
            line.begin_end()
    return done


def _flat(raw: RawMessage) -> Flat:
    return raw.topic, raw.envelope.stamp_ns, raw.envelope.source, raw.envelope.sequence, bytes(raw.data)


@dataclass
class _Recorded:
    """The messages of a recording, some with another payload."""

    reader: RecordingReader
    instead: Mapping[str, bytes]

    def messages(self, numbers: NDArray[np.int64]) -> Iterator[Recorded]:
        """Messages by their numbers."""
        recorded = self.reader.recorded(numbers)
        if not self.instead:
            return recorded
        return ((of, t, number, self.instead.get(of.topic, data), at) for of, t, number, data, at in recorded)


class _Progress:
    """Tells now and then how much is done."""

    def __init__(self, tell: Callable[[float], None] | None, total: int) -> None:
        self._tell, self._total, self._done, self._told_s = tell, total, 0, time.monotonic()

    def add(self, n: int) -> None:
        """So many messages more."""
        before = self._done // 256
        self._done += n
        if self._tell is not None and self._done // 256 > before and time.monotonic() - self._told_s > 0.2:
            self._told_s = time.monotonic()
            self._tell(self._done / self._total)


def _feeds(node: Node, others: Sequence[Node]) -> bool:
    """Whether others need what a node puts out."""
    return any(topics.find(i).matches(o) for other in others for i in other.inputs for o in node.outputs)


class _Listening(dict[str, list[StepDriver]]):
    """Which of some drivers listen to a topic."""

    def __init__(self, drivers: Sequence[StepDriver]) -> None:
        super().__init__()
        self._drivers = drivers

    def __missing__(self, topic: str) -> list[StepDriver]:
        self[topic] = [driver for driver in self._drivers if _listens(driver, topic)]
        return self[topic]


@dataclass
class _Inbox:
    """What waits for a node at the end of a run.

    Attributes
    ----------
    time_ns : how far it knows platform time to be
    waiting : heap of messages with their places, and numbers that tell equal ones apart
    """

    driver: StepDriver
    time_ns: int
    waiting: list[tuple[Key, int, Message]] = field(default_factory=list)

    @property
    def is_due(self) -> bool:
        """Whether the turn of a message has come: observations that are stamped ahead of time wait."""
        return bool(self.waiting) and self.waiting[0][0][0] <= self.time_ns


class _Line:
    """Nodes one after the other: hands inputs and outputs on in order, and has them written.

    The end goes as on the bus (`bus.live`), where each node works on what has come up to the time that it knows of.
    Then one after the other is ended: it works off what is stamped ahead of that time, says its last words, and the
    others hear them. So the last words of a node come before what others have stamped ahead.

    Parameters
    ----------
    drivers : of the nodes, those that make another's input before it
    write : takes what the nodes put out
    copy : takes what is recorded, many at once, in the same order
    summary : where outputs and what nodes say are counted
    others : who is handed messages, and finds those of the recording checked
    checked : whether messages of the recording have been
    leave_out : is called in the place of a recorded message that cannot be decoded
    part_over : is called after each part of the end; what comes then is written at once, else in order at last

    Attributes
    ----------
    ending : whether the end has begun
    """

    def __init__(
        self,
        drivers: Sequence[StepDriver],
        write: Callable[[RawMessage], None],
        copy: Callable[[Sequence[Recorded]], None],
        summary: ProcessSummary,
        others: Sequence[StepDriver] = (),
        checked: bool = False,
        leave_out: Callable[[], None] = lambda: None,
        part_over: Callable[[], None] | None = None,
    ) -> None:
        self._drivers, self._write, self._copy, self._summary = drivers, write, copy, summary
        self._leave_out, self._part_over = leave_out, part_over
        self.ending = False
        self._inboxes: list[_Inbox] = []
        self._numbers = count()
        self._last: list[tuple[Key, int, Recorded | RawMessage]] = []  # of the end, to be written in order
        self._passed: list[Recorded] = []  # messages of the recording that are to be copied
        self._listening, self._needed = _Listening(drivers), _Listening([*drivers, *others])
        self._decode = codec.parse if checked else codec.decode
        self._pending: list[tuple[Key, Message, RawMessage]] = []

    def take(self, messages: Iterable[Recorded]) -> None:
        """The next messages of the recording; what cannot be decoded and a node would need is left out and counted."""
        needed, listening, pending, passed = self._needed, self._listening, self._pending, self._passed
        for recorded in messages:
            channel, stamp_ns, sequence, data, _ = recorded
            topic = channel.topic
            body = None
            if needed[topic]:
                try:
                    body = self._decode(topic, data)
                except ValueError as error:
                    kind = "impossible" if isinstance(error, codec.ImpossibleValues) else "malformed"
                    self._summary.drop(kind, f"{topic} {sequence} of {channel.source!r}: {error}")
                    self._copy_passed()
                    self._leave_out()
                    continue
            if self.ending:
                message = Message(topic, stamp_ns, body, channel.source, sequence, channel.start)
                key = order_key(topic, Envelope(stamp_ns, channel.source, sequence, channel.start))
                self._bring(key, message, recorded)
                continue
            if pending:
                self._hand_on_pending(order_key(topic, Envelope(stamp_ns, channel.source, sequence, channel.start)))
            passed.append(recorded)
            if drivers := listening[topic]:
                message = Message(topic, stamp_ns, body, channel.source, sequence, channel.start)
                for driver in drivers:
                    if outputs := driver.step(message):
                        self._queue(outputs)
        self._copy_passed()

    def _copy_passed(self) -> None:
        """Copy the messages that have been taken since, before anything else is written."""
        if self._passed:
            self._summary.inputs.update(channel.topic for channel, *_ in self._passed)
            self._copy(self._passed)
            self._passed.clear()

    def take_made(self, raw: RawMessage) -> None:
        """The next message, of a node before these."""
        key = order_key(raw.topic, raw.envelope)
        if self._pending:
            self._hand_on_pending(key)
        message = _message(raw, codec.parse(raw.topic, raw.data)) if self._listening[raw.topic] else None
        if self.ending:
            self._bring(key, message, raw)
        else:
            self._hand_on(message, raw)

    def begin_end(self) -> None:
        """What comes from now on waits at each node for its turn."""
        self.ending = True
        self._inboxes = [_Inbox(driver, driver.time_ns) for driver in self._drivers]
        pending, self._pending = self._pending, []
        for key, message, raw in pending:
            self._bring(key, message, raw)

    def work_off(self) -> None:
        """The nodes work on what waits at them, in order, as far as each knows time to be."""
        while due := [inbox for inbox in self._inboxes if inbox.is_due]:
            self._work(min(due, key=lambda inbox: inbox.waiting[0][0]))
        if self._part_over is not None:
            self._part_over()

    def finish(self) -> None:
        """There are no more inputs: the nodes are ended, one after the other."""
        while self._inboxes:
            inbox = self._inboxes.pop(0)
            while inbox.waiting:
                self._work(inbox)
            self._queue(inbox.driver.finish())
            node = inbox.driver.node
            self._summary.counters[node.name] = dict(sorted(node.counters.items()))
            self._summary.states[node.name] = node.state()
            if node.last_problem:
                self._summary.problems[node.name] = node.last_problem
                self._summary.problems_by_kind[node.name] = dict(node.last_problems)
            if inbox.driver.first_failure:
                why = f"the first time at {inbox.driver.first_failure}"
                self._summary.failed[node.name] = failure_words(node.counters["failed"], why)
            self.work_off()
        for _, _, item in sorted(self._last):
            self._hand_out(item)
        self._last.clear()
        self._copy_passed()

    def _bring(self, key: Key, message: Message | None, item: Recorded | RawMessage) -> None:
        """Lay a message of the end before the nodes that listen to it."""
        if self._part_over is None:
            self._last.append((key, next(self._numbers), item))
        else:
            self._hand_out(item)
        if message is None:
            return
        drivers, family = self._listening[message.topic], topics.find(message.topic).family
        for inbox in self._inboxes:
            if inbox.driver in drivers:
                heapq.heappush(inbox.waiting, (key, next(self._numbers), message))
                if family in _TELL_TIME:
                    inbox.time_ns = max(inbox.time_ns, message.stamp_ns)

    def _work(self, inbox: _Inbox) -> None:
        message = heapq.heappop(inbox.waiting)[-1]
        self._queue(inbox.driver.step(message))

    def _hand_out(self, item: Recorded | RawMessage) -> None:
        """Have a message of the end written."""
        if isinstance(item, RawMessage):
            self._copy_passed()
            self._write(item)
        else:
            self._passed.append(item)

    def _queue(self, outputs: list[Message]) -> None:
        for output in outputs:
            raw = RawMessage(
                output.topic, Envelope(output.stamp_ns, output.source, output.sequence), codec.encode(output.body),
                output.stamp_ns,
            )  # fmt: skip
            self._summary.outputs[output.topic] += 1
            key = order_key(output.topic, raw.envelope)
            if self.ending:
                self._bring(key, output, raw)
            else:
                heapq.heappush(self._pending, (key, output, raw))

    def _hand_on(self, message: Message | None, raw: RawMessage) -> None:
        self._copy_passed()
        self._write(raw)
        if message is not None:
            for driver in self._listening[raw.topic]:
                self._queue(driver.step(message))

    def _hand_on_pending(self, until: Key) -> None:
        while self._pending and self._pending[0][0] < until:
            _, message, raw = heapq.heappop(self._pending)
            self._hand_on(message, raw)


def _listens(driver: StepDriver, topic: str) -> bool:
    return any(topics.find(name).matches(topic) for name in (*driver.inputs, *driver.node.decisions))


def _as_recorded(write: Callable[[RawMessage], None]) -> Callable[[RawMessage], None]:
    """Writes what the recorder of a flight keeps: no messages that are there for the order on the bus alone."""
    return lambda raw: write(raw) if topics.find(raw.topic).recorded else None


def _each(write: Callable[[RawMessage], None], messages: Iterable[Recorded]) -> None:
    for recorded in messages:
        write(_raw(recorded))


def _raw(recorded: Recorded) -> RawMessage:
    """A recorded message as nodes have it: received when it was stamped."""
    channel, stamp_ns, sequence, data, _ = recorded
    return RawMessage(channel.topic, Envelope(stamp_ns, channel.source, sequence, channel.start), data, stamp_ns)


def _message(raw: RawMessage, body: Any) -> Message:
    e = raw.envelope
    return Message(raw.topic, e.stamp_ns, body, e.source, e.sequence, e.start)
