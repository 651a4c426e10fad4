"""A node of a run over a recording in a process of its own, so that two processors share the work.

The nodes before it run ahead in the first process. What concerns it goes over in batches, in the order in which it
would have come; its outputs come back with the place of the message that caused them. So nothing depends on which
process is faster.
"""

from __future__ import annotations

import multiprocessing
import signal
import threading
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from queue import Queue
from typing import Any, Protocol

from ...schemas import codec
from ...schemas.envelope import Envelope, RawMessage
from ..errors import UserError
from ..garbage_collection import RareCollections
from ..node import Message, Node
from .reader import RecordingReader

#: Messages of a batch, and batches under way before the first process waits.
BATCH, UNDER_WAY = 2000, 24


class Driver(Protocol):
    """What drives a node."""

    node: Node

    def step(self, message: Message) -> list[Message]: ...

    def finish(self) -> list[Message]: ...


@dataclass
class End:
    """What a node said at the end.

    Attributes
    ----------
    outputs : that were held back
    counters, problem, state : of the node
    """

    outputs: list[Flat] = field(default_factory=list)
    counters: Counter[str] = field(default_factory=Counter)
    problem: str = ""
    state: str = ""


#: A message of a node on its way to the other process: topic, stamp, source, number, payload.
Flat = tuple[str, int, str, int, bytes]
#: A message for the node: its place in the batch, and its number in the recording or the message itself.
Item = tuple[int, int | Flat]
#: Outputs with the place in the batch of what caused them.
Answer = list[tuple[int, list[Flat]]]


def raw_of(output: Message) -> RawMessage:
    """A message as it is written, received when it was made."""
    return raw_from(flat_of(output))


def flat_of(output: Message) -> Flat:
    """A message as it goes to the other process."""
    return output.topic, output.stamp_ns, output.source, output.sequence, codec.encode(output.body)


def flat_from(raw: RawMessage) -> Flat:
    """The same of one that is encoded already."""
    return raw.topic, raw.envelope.stamp_ns, raw.envelope.source, raw.envelope.sequence, bytes(raw.data)


def raw_from(flat: Flat) -> RawMessage:
    """A message that came from the other process."""
    topic, stamp_ns, source, sequence, data = flat
    return RawMessage(topic, Envelope(stamp_ns, source, sequence), data, stamp_ns)


class Apart:
    """The node in its process.

    Parameters
    ----------
    reader : the recording; the other process reads it for itself
    driver : drives the node there; here it stays as it is
    """

    def __init__(self, reader: RecordingReader, driver: Driver) -> None:
        context = multiprocessing.get_context("fork")
        here: Any
        there: Any
        here, there = context.Pipe()
        self._name = driver.node.name
        self._process = context.Process(target=_work, args=(there, here, reader, driver), daemon=True)
        self._process.start()
        there.close()
        self._connection: Connection = here
        self._answers: Queue[Answer | End | None] = Queue()
        self.under_way = 0
        threading.Thread(target=self._listen, daemon=True).start()

    @staticmethod
    def possible() -> bool:
        """Whether this system can do it, and has a second processor for it."""
        return "fork" in multiprocessing.get_all_start_methods() and multiprocessing.cpu_count() > 1

    def send(self, batch: list[Item]) -> None:
        """The next messages."""
        self.under_way += 1
        self._send(batch)

    def ready(self) -> bool:
        """Whether the answer to the oldest batch has come."""
        return not self._answers.empty()

    def answer(self) -> Answer:
        """To the oldest batch that has none; waits for it."""
        found = self._receive()
        assert isinstance(found, list)
        self.under_way -= 1
        return found

    def finish(self) -> End:
        """No more messages come; all batches have been answered."""
        self._send(None)
        found = self._receive()
        assert isinstance(found, End)
        return found

    def close(self) -> None:
        """End the process, whatever it does."""
        self._process.terminate()
        self._process.join()
        self._connection.close()

    def _send(self, what: list[Item] | None) -> None:
        try:
            self._connection.send(what)
        except OSError:
            raise self._gone() from None

    def _receive(self) -> Answer | End:
        found = self._answers.get()
        if found is None:
            raise self._gone()
        return found

    def _gone(self) -> UserError:
        self._process.join(1.0)
        return UserError(f"the process of the {self._name} has ended (exit code {self._process.exitcode})")

    def _listen(self) -> None:
        """Take answers off the line, so that neither process waits for the other to read."""
        try:
            while True:
                self._answers.put(self._connection.recv())
        except (EOFError, OSError):
            self._answers.put(None)


def _work(connection: Connection, other: Connection, reader: RecordingReader, driver: Driver) -> None:
    """The other process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the first process ends this one
    other.close()
    decode: Callable[[int | Flat], Message] = _Decoder(reader)
    collections = RareCollections()
    while True:
        collections.if_due()
        try:
            batch: list[Item] | None = connection.recv()
        except (EOFError, OSError):
            return
        if batch is None:
            node, left = driver.node, driver.finish()
            connection.send(End([flat_of(m) for m in left], node.counters, node.last_problem, node.state()))
            return
        answer: Answer = []
        for place, item in batch:
            outputs = driver.step(decode(item))
            if outputs:
                answer.append((place, [flat_of(output) for output in outputs]))
        connection.send(answer)


class _Decoder:
    """Messages of batches; what came so far has been checked in the first process."""

    def __init__(self, reader: RecordingReader) -> None:
        self._reader = reader

    def __call__(self, item: int | Flat) -> Message:
        if isinstance(item, int):
            topic, e, data, _ = self._reader.raw(item)
            return Message(topic, e.stamp_ns, codec.parse(topic, data), e.source, e.sequence, e.start)
        topic, stamp_ns, source, sequence, data = item
        return Message(topic, stamp_ns, codec.parse(topic, data), source, sequence)
