"""The runner over recordings: nodes one after the other, inputs and outputs in one order."""

from __future__ import annotations

import heapq
import time
from collections import Counter, deque
from collections.abc import Callable, Container, Iterable, Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ...schemas import codec, topics
from ...schemas.envelope import Envelope, RawMessage
from ...schemas.topics import Family
from ..node import Message, Node
from ..ordering import Key, StreamCheck, is_orderly, order_key
from ..step_driver import StepDriver
from ..voices import VERDICT
from .reader import RecordingReader
from .runner_apart import BATCH, UNDER_WAY, Apart, Item, flat_from, raw_from, raw_of


@dataclass
class ProcessSummary:
    """What a run over a recording did.

    Attributes
    ----------
    nodes : names of the nodes that ran
    inputs, outputs : messages by topic
    replaced : recorded messages by topic that the nodes made anew
    dropped : messages that were not usable, by kind
    counters : per node, what it counted
    problems : per node, its last problem
    states : per node, what it said of itself at the end
    first_ns, last_ns : platform time covered
    """

    nodes: list[str] = field(default_factory=list)
    inputs: Counter[str] = field(default_factory=Counter)
    outputs: Counter[str] = field(default_factory=Counter)
    replaced: Counter[str] = field(default_factory=Counter)
    dropped: Counter[str] = field(default_factory=Counter)
    last_problem: str = ""
    counters: dict[str, dict[str, int]] = field(default_factory=dict)
    problems: dict[str, str] = field(default_factory=dict)
    states: dict[str, str] = field(default_factory=dict)
    first_ns: int = 0
    last_ns: int = 0


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
) -> ProcessSummary:
    """Run nodes over a recording, as fast as it goes.

    Parameters
    ----------
    reader : the recording
    nodes : the nodes; those with nothing to work on stay out
    write : takes inputs and outputs, in the order of `order_key`; receive time = stamp
    progress : told the fraction that is done, now and then
    apart : the last node may run in a process of its own, if no other needs its outputs; what comes out is the same
    """
    summary = ProcessSummary()
    held = set(reader.index.channel.tolist())  # a channel can be announced by a file whose chunks are gone
    recorded = {c.topic for c in reader.channels.values() if c.known and c.id in held}
    running = active_nodes(nodes, recorded)
    summary.nodes = [node.name for node in running]
    made = {name for node in running for name in node.outputs}
    drivers = [StepDriver(node) for node in running]
    if apart and Apart.possible() and len(running) > 1 and not _feeds(running[-1], running[:-1]):
        line: _Line = _LineApart(reader, drivers, write, summary)
    else:
        line = _Line(drivers, write, summary)
    try:
        for number, message, raw in _inputs(reader, made, line.is_heard, summary, progress):
            line.take(number, message, raw)
        line.finish()
    finally:
        line.close()
    return summary


def _feeds(node: Node, others: Sequence[Node]) -> bool:
    """Whether others need what a node puts out."""
    return any(topics.find(i).matches(o) for other in others for i in other.inputs for o in node.outputs)


class _Line:
    """Nodes one after the other: hands inputs and outputs on in order, and has them written.

    Parameters
    ----------
    drivers : of the nodes, those that make another's input before it
    write : takes what is handed on
    summary : where outputs and what nodes say are counted
    """

    def __init__(
        self, drivers: Sequence[StepDriver], write: Callable[[RawMessage], None], summary: ProcessSummary
    ) -> None:
        self._drivers, self._write, self._summary = drivers, write, summary
        self._listeners: dict[str, list[StepDriver]] = {}
        self._pending: list[tuple[Key, Message, RawMessage]] = []

    def is_heard(self, topic: str) -> bool:
        """Whether a node listens to a topic."""
        return bool(self._listening(topic))

    def take(self, number: int, message: Message | None, raw: RawMessage) -> None:
        """The next input, and its number in the recording; decoded if a node listens."""
        if self._pending:
            self._hand_on_pending(order_key(raw.topic, raw.envelope))
        self._hand_on(message, raw, number)

    def finish(self) -> None:
        """There are no more inputs."""
        self._hand_on_pending(None)
        for driver in self._drivers:
            self._queue(driver.finish())
            self._hand_on_pending(None)
            node = driver.node
            self._conclude(node.name, node.counters, node.last_problem, node.state())

    def close(self) -> None:
        """Give back what the nodes needed."""

    def _conclude(self, name: str, counters: Counter[str], problem: str, state: str) -> None:
        self._summary.counters[name] = dict(sorted(counters.items()))
        self._summary.states[name] = state
        if problem:
            self._summary.problems[name] = problem

    def _listening(self, topic: str) -> list[StepDriver]:
        if topic not in self._listeners:
            self._listeners[topic] = [d for d in self._drivers if _listens(d, topic)]
        return self._listeners[topic]

    def _queue(self, outputs: list[Message]) -> None:
        for output in outputs:
            raw = raw_of(output)
            heapq.heappush(self._pending, (order_key(output.topic, raw.envelope), output, raw))
            self._summary.outputs[output.topic] += 1

    def _hand_on(self, message: Message | None, raw: RawMessage, number: int | None = None) -> None:
        self._write(raw)
        if message is not None:
            for driver in self._listening(raw.topic):
                self._queue(driver.step(message))

    def _hand_on_pending(self, until: Key | None) -> None:
        while self._pending and (until is None or self._pending[0][0] < until):
            _, message, raw = heapq.heappop(self._pending)
            self._hand_on(message, raw)


class _LineApart(_Line):
    """The same with the last node in a process of its own: what is handed on waits for its answer to be written."""

    def __init__(
        self,
        reader: RecordingReader,
        drivers: Sequence[StepDriver],
        write: Callable[[RawMessage], None],
        summary: ProcessSummary,
    ) -> None:
        super().__init__(drivers[:-1], write, summary)
        self._last_driver = drivers[-1]
        self._last = drivers[-1].node
        self._heard_apart: dict[str, bool] = {}
        self._apart = Apart(reader, drivers[-1])
        self._batch: list[RawMessage] = []
        self._items: list[Item] = []
        self._waiting: deque[list[RawMessage]] = deque()
        self._answered: list[tuple[Key, RawMessage]] = []

    def is_heard(self, topic: str) -> bool:
        return super().is_heard(topic) or self._is_heard_apart(topic)

    def finish(self) -> None:
        self._hand_on_pending(None)
        self._write_up_to()
        super().finish()
        self._write_up_to()
        end = self._apart.finish()
        left = [raw_from(flat) for flat in end.outputs]
        self._count(left)
        for raw in sorted(left, key=lambda raw: order_key(raw.topic, raw.envelope)):
            self._write(raw)
        self._conclude(self._last.name, end.counters, end.problem, end.state)

    def close(self) -> None:
        self._apart.close()

    def _is_heard_apart(self, topic: str) -> bool:
        if topic not in self._heard_apart:
            self._heard_apart[topic] = _listens(self._last_driver, topic)
        return self._heard_apart[topic]

    def _hand_on(self, message: Message | None, raw: RawMessage, number: int | None = None) -> None:
        if self._is_heard_apart(raw.topic):
            self._items.append((len(self._batch), flat_from(raw) if number is None else number))
        self._batch.append(raw)
        if message is not None:
            for driver in self._listening(raw.topic):
                self._queue(driver.step(message))
        if len(self._batch) >= BATCH:
            self._send()
            while self._apart.under_way > UNDER_WAY or self._apart.ready():
                self._write_answered()

    def _send(self) -> None:
        self._apart.send(self._items)
        self._waiting.append(self._batch)
        self._batch, self._items = [], []

    def _write_up_to(self) -> None:
        """Write all that was handed on so far, and what came of it."""
        self._send()
        while self._waiting:
            self._write_answered()
        self._write_before(None)

    def _write_answered(self) -> None:
        """Write the oldest batch, with what the node answered to it."""
        batch, answer = self._waiting.popleft(), iter(self._apart.answer())
        place, outputs = next(answer, (-1, []))
        for i, raw in enumerate(batch):
            if self._answered:
                self._write_before(order_key(raw.topic, raw.envelope))
            self._write(raw)
            if i == place:
                made = [raw_from(flat) for flat in outputs]
                self._count(made)
                for output in made:
                    heapq.heappush(self._answered, (order_key(output.topic, output.envelope), output))
                place, outputs = next(answer, (-1, []))

    def _write_before(self, until: Key | None) -> None:
        while self._answered and (until is None or self._answered[0][0] < until):
            self._write(heapq.heappop(self._answered)[1])

    def _count(self, outputs: list[RawMessage]) -> None:
        for raw in outputs:
            self._summary.outputs[raw.topic] += 1


def _listens(driver: StepDriver, topic: str) -> bool:
    return any(topics.find(name).matches(topic) for name in (*driver.inputs, *driver.node.decisions))


def _inputs(
    reader: RecordingReader,
    made: set[str],
    is_heard: Callable[[str], bool],
    summary: ProcessSummary,
    progress: Callable[[float], None] | None,
) -> Iterator[tuple[int, Message | None, RawMessage]]:
    """The usable inputs of a recording in order, with their numbers; decoded where a node listens."""
    index, known = reader.index, reader.select()
    streams: dict[tuple[str, str, int], list[NDArray[np.int64]]] = {}
    for id in np.unique(index.channel[known]).tolist():
        channel = reader.channels[id]
        own = known[index.channel[known] == id]
        if is_remade(channel.topic, channel.source, made, summary.nodes):
            summary.replaced[channel.topic] += len(own)
        else:
            streams.setdefault((channel.topic, channel.source, channel.start), []).append(own)

    def problem(kind: str, text: str) -> None:
        summary.dropped[kind] += 1
        summary.last_problem = text

    foreign = len(index) - len(known)
    if foreign:
        summary.dropped["foreign"] = foreign
        summary.last_problem = f"{foreign} messages on topics of other programs"
    kept, doubtful = [], []
    for (topic, _, _), parts in streams.items():
        own = np.sort(np.concatenate(parts))
        (kept if is_orderly(topic, index.sequence[own], index.stamp_ns[own]) else doubtful).append(own)
    check: StreamCheck[int] = StreamCheck(problem)
    for number in np.sort(np.concatenate([*doubtful, np.empty(0, dtype=np.int64)])).tolist():
        channel = reader.channels[int(index.channel[number])]
        stamp, sequence = int(index.stamp_ns[number]), int(index.sequence[number])
        accepted = check.accept(channel.topic, Envelope(stamp, channel.source, sequence, channel.start), number)
        kept.append(np.array(accepted, dtype=np.int64))
    ordered = reader.sort(np.concatenate([*kept, np.empty(0, dtype=np.int64)]))
    if len(ordered):
        summary.first_ns, summary.last_ns = (int(index.stamp_ns[n]) for n in (ordered[0], ordered[-1]))
    told = time.monotonic()
    for done, (number, recorded) in enumerate(zip(map(int, ordered), reader.raws(ordered), strict=True)):
        raw = RawMessage(recorded.topic, recorded.envelope, recorded.data, recorded.envelope.stamp_ns)
        message = None
        if is_heard(raw.topic):
            try:
                body = codec.decode(raw.topic, raw.data)
            except ValueError as error:
                problem("malformed", f"{raw.topic} {raw.envelope.sequence} of {raw.envelope.source!r}: {error}")
                continue
            e = raw.envelope
            message = Message(raw.topic, e.stamp_ns, body, e.source, e.sequence, e.start)
        summary.inputs[raw.topic] += 1
        if progress is not None and not done % 256 and time.monotonic() - told > 0.2:
            told = time.monotonic()
            progress(done / len(ordered))
        yield number, message, raw
