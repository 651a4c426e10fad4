"""Driving nodes: the parts both runners share, and the runner over recordings.

`StepDriver` is the only caller of `Node.step`. Over the bus (`live`) and over a recording (`process`) it gets the same
messages in the same order, so the same outputs follow, with the same stamps and numbers.
"""

from __future__ import annotations

import heapq
import time
from collections import Counter
from collections.abc import Callable, Container, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ..schemas import codec, topics
from ..schemas.envelope import Envelope, RawMessage
from ..schemas.topics import Family
from .node import Message, Node
from .ordering import Key, StreamCheck, order_key
from .recording import RecordingReader


class StepDriver:
    """Feeds one node and gives its outputs their envelopes.

    An output cannot be known before its cause: its stamp is raised to the newest stamp the node has been given, so that
    the outputs of a node never go back in time.

    Parameters
    ----------
    node : the node
    clock : measures the wall time of a step, s, for messages that tell it (``compute_s``); None = they tell nothing
    """

    def __init__(self, node: Node, clock: Callable[[], float] | None = None) -> None:
        self.node = node
        self.time_ns = 0
        self._clock = clock
        self._sequences: Counter[str] = Counter()

    def step(self, message: Message) -> list[Message]:
        """The outputs that follow from one message."""
        self.time_ns = max(self.time_ns, message.stamp_ns)
        return self._collect(lambda: self.node.step(message), f"{message.topic} {message.sequence}")

    def behind(self, lag_s: float, now_s: float) -> list[Message]:
        """The decisions that follow from being behind; see `Node.behind`."""
        return self._collect(lambda: self.node.behind(lag_s, now_s), "being behind")

    def finish(self) -> list[Message]:
        """The outputs that were held back."""
        return self._collect(self.node.finish, "the end")

    def _collect(self, work: Callable[[], Iterable[Message]], cause: str) -> list[Message]:
        begun = self._clock() if self._clock else 0.0
        outputs: list[Message] = []
        try:
            outputs.extend(work())  # a generator's outputs before a failure count
        except Exception as error:  # whatever a message does to a node, the node lives
            place = _innermost(error)
            self.node.problem("failed", f"{cause}: {type(error).__name__}: {error} ({place})")
        elapsed = self._clock() - begun if self._clock else 0.0
        return [self._stamped(output, elapsed) for output in outputs]

    def _stamped(self, output: Message, elapsed: float) -> Message:
        allowed = (*self.node.outputs, *self.node.decisions)
        if not any(topics.find(name).matches(output.topic) for name in allowed):
            raise ValueError(f"{self.node.name} gave {output.topic}, its outputs are {', '.join(self.node.outputs)}")
        if self._clock and getattr(output.body, "compute_s", None) == 0.0:
            output.body.compute_s = elapsed
        sequence = self._sequences[output.topic]
        self._sequences[output.topic] += 1
        stamp = max(output.stamp_ns, self.time_ns)
        return Message(output.topic, stamp, output.body, self.node.name, sequence)


def _innermost(error: Exception) -> str:
    trace = error.__traceback__
    while trace is not None and trace.tb_next is not None:
        trace = trace.tb_next
    return "" if trace is None else f"{trace.tb_frame.f_code.co_filename.rsplit('/', 1)[-1]}:{trace.tb_lineno}"


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

    Observations of somebody else (measured targets beside matched tie points) stay.

    ``made`` are the outputs of the nodes that run, ``makers`` their names. Events are left out where one of these told
    them; what live nodes said of their own health is no input of anything.
    """
    if topics.find(topic).family is Family.STATUS:
        return topic.startswith("status/") or source in makers
    if topics.find(topic).family is Family.OBSERVATION:
        return topic in made and source in makers
    return topic in made


def _drives(name: str) -> bool:
    row = topics.find(name)
    return not row.latched and row.family is not Family.CONFIGURATION


def _is_made(name: str, available: set[str]) -> bool:
    row = topics.find(name)
    return any(name == topic or (row.matches(topic) and row.name == name) for topic in available)


def process(
    reader: RecordingReader,
    nodes: Sequence[Node],
    write: Callable[[RawMessage], None],
    progress: Callable[[float], None] | None = None,
) -> ProcessSummary:
    """Run nodes over a recording, in one thread, as fast as it goes.

    Parameters
    ----------
    reader : the recording
    nodes : the nodes; those with nothing to work on stay out
    write : takes inputs and outputs, in the order of `order_key`; receive time = stamp
    progress : told the fraction that is done, now and then
    """
    summary = ProcessSummary()
    held = set(reader.index.channel.tolist())  # a channel can be announced by a file whose chunks are gone
    recorded = {c.topic for c in reader.channels.values() if c.known and c.id in held}
    running = active_nodes(nodes, recorded)
    summary.nodes = [node.name for node in running]
    made = {name for node in running for name in node.outputs}
    drivers = [StepDriver(node) for node in running]
    listeners: dict[str, list[StepDriver]] = {}

    def listening(topic: str) -> list[StepDriver]:
        if topic not in listeners:
            listeners[topic] = [
                d for d in drivers if any(topics.find(n).matches(topic) for n in (*d.node.inputs, *d.node.decisions))
            ]
        return listeners[topic]

    pending: list[tuple[Key, Message, RawMessage]] = []

    def queue(outputs: list[Message]) -> None:
        for output in outputs:
            envelope = Envelope(output.stamp_ns, output.source, output.sequence)
            raw = RawMessage(output.topic, envelope, codec.encode(output.body), output.stamp_ns)
            heapq.heappush(pending, (order_key(output.topic, envelope), output, raw))
            summary.outputs[output.topic] += 1

    def hand_on(message: Message | None, raw: RawMessage) -> None:
        write(raw)
        if message is not None:
            for driver in listening(raw.topic):
                queue(driver.step(message))

    def hand_on_pending(until: Key | None) -> None:
        while pending and (until is None or pending[0][0] < until):
            _, message, raw = heapq.heappop(pending)
            hand_on(message, raw)

    for key, message, raw in _inputs(reader, made, listening, summary, progress):
        hand_on_pending(key)
        hand_on(message, raw)
    hand_on_pending(None)
    for driver in drivers:
        queue(driver.finish())
        hand_on_pending(None)
    for node in running:
        summary.counters[node.name] = dict(sorted(node.counters.items()))
        if node.last_problem:
            summary.problems[node.name] = node.last_problem
    return summary


def _inputs(
    reader: RecordingReader,
    made: set[str],
    listening: Callable[[str], list[Any]],
    summary: ProcessSummary,
    progress: Callable[[float], None] | None,
) -> Iterator[tuple[Key, Message | None, RawMessage]]:
    """The usable inputs of a recording in order; decoded where a node listens."""
    numbers = []
    for number in reader.select():
        channel = reader.channels[int(reader.index.channel[number])]
        if is_remade(channel.topic, channel.source, made, summary.nodes):
            summary.replaced[channel.topic] += 1
        else:
            numbers.append(number)

    def problem(kind: str, text: str) -> None:
        summary.dropped[kind] += 1
        summary.last_problem = text

    foreign = len(reader.index) - len(reader.select())
    if foreign:
        summary.dropped["foreign"] = foreign
        summary.last_problem = f"{foreign} messages on topics of other programs"
    check: StreamCheck[int] = StreamCheck(problem)
    kept = []
    for number in numbers:
        channel = reader.channels[int(reader.index.channel[number])]
        stamp, sequence = int(reader.index.stamp_ns[number]), int(reader.index.sequence[number])
        kept.extend(check.accept(channel.topic, Envelope(stamp, channel.source, sequence, channel.start), int(number)))
    ordered = reader.sort(np.array(kept, dtype=np.int64))
    if len(ordered):
        summary.first_ns, summary.last_ns = (int(reader.index.stamp_ns[n]) for n in (ordered[0], ordered[-1]))
    told = time.monotonic()
    for done, number in enumerate(ordered):
        raw = reader.raw(int(number))
        raw = raw._replace(receive_ns=raw.envelope.stamp_ns)
        message = None
        if listening(raw.topic):
            try:
                body = codec.decode(raw.topic, raw.data)
            except ValueError as error:
                problem("malformed", f"{raw.topic} {raw.envelope.sequence} of {raw.envelope.source!r}: {error}")
                continue
            message = Message(raw.topic, raw.envelope.stamp_ns, body, raw.envelope.source, raw.envelope.sequence)
        summary.inputs[raw.topic] += 1
        if progress is not None and time.monotonic() - told > 0.2:
            told = time.monotonic()
            progress(done / len(ordered))
        yield order_key(raw.topic, raw.envelope), message, raw
