"""The bus runner: one node on the bus."""

from __future__ import annotations

import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

from ..schemas import codec, topics
from ..schemas import messages as m
from ..schemas.envelope import RawMessage
from ..schemas.topics import Family, Queue
from .bus import Bus
from .collection import RareCollections
from .node import Message, Node
from .ordering import Sequencer, StreamCheck, TopicCounts, order_key
from .step_driver import StepDriver

#: Waiting messages of lossless topics after which publishers are slowed down.
LOSSLESS_DEPTH = 20_000
#: Waiting messages of each newest-first topic; fewer, but 16 at least, where they take more bytes than this.
NEWEST_DEPTH, NEWEST_LEAST, NEWEST_BYTES = 2_000, 16, 32 << 20
#: After so long without any message everything that waits is worked off. A node that lives on the results of others
#: waits longer, so that theirs still come before.
IDLE_S = 1.0
IDLE_RESULTS_S = 2.0
#: Time in which latched topics arrive before the first message is worked off.
JOIN_S = 0.5
STATUS_PERIOD_S = 0.5
#: Messages worked off before it is looked what has arrived meanwhile.
MOST_AT_ONCE = 64
#: How often a node is told how far it is behind.
LAG_PERIOD_S = 0.1
#: Between the last message and the end of the session, for what is still on its way.
LAST_WORDS_S = 0.2


class Inbox:
    """The bounded queue between the bus and a worker: lossless topics block, newest-first topics lose their oldest."""

    def __init__(
        self, lossless_depth: int = LOSSLESS_DEPTH, newest_depth: int = NEWEST_DEPTH, newest_bytes: int = NEWEST_BYTES
    ) -> None:
        self._condition = threading.Condition()
        self._entries: deque[list[RawMessage | None]] = deque()
        self._newest: dict[str, deque[list[RawMessage | None]]] = {}
        self._lossless = 0
        self._lossless_depth = lossless_depth
        self._newest_depth = newest_depth
        self._newest_bytes = newest_bytes
        self._closed = False
        self.dropped: Counter[str] = Counter()

    def put(self, raw: RawMessage, policy: Queue) -> None:
        """Add a message; waits while the queue is full of lossless messages."""
        with self._condition:
            entry: list[RawMessage | None] = [raw]
            if policy is Queue.LOSSLESS:
                while self._lossless >= self._lossless_depth and not self._closed:
                    self._condition.wait(0.5)
                self._lossless += 1
            else:
                waiting = self._newest.setdefault(raw.topic, deque())
                n = len(waiting)
                if n >= self._newest_depth or (n >= NEWEST_LEAST and n * len(raw.data) > self._newest_bytes):
                    waiting.popleft()[0] = None
                    self.dropped[raw.topic] += 1
                waiting.append(entry)
            self._entries.append(entry)
            self._condition.notify_all()

    def take(self, timeout_s: float) -> list[RawMessage]:
        """All waiting messages, in the order of arrival; waits for one at most ``timeout_s``."""
        with self._condition:
            if not self._entries:
                self._condition.wait(timeout_s)
            taken = [entry[0] for entry in self._entries if entry[0] is not None]
            self._entries.clear()
            self._newest.clear()
            self._lossless = 0
            self._condition.notify_all()
            return taken

    def __len__(self) -> int:
        return len(self._entries)

    def close(self) -> None:
        """Let go of whoever waits to put."""
        with self._condition:
            self._closed = True
            self._condition.notify_all()


class _Patience:
    """Waiting time: a clock that stands still while this process works or is frozen.

    What the others have sent in that time has not been looked at yet, so it must not count as their silence.
    """

    LONGEST_WAIT_S = 0.1

    def __init__(self) -> None:
        self._seen_s = time.monotonic()
        self._waited_s = 0.0

    def now_s(self) -> float:
        seen_s = time.monotonic()
        self._waited_s += min(seen_s - self._seen_s, self.LONGEST_WAIT_S)
        self._seen_s = seen_s
        return self._waited_s


class BusRunner:
    """Runs a node on the bus until told to stop.

    Parameters
    ----------
    node : the node
    bus : an open bus
    report : called with one line for things a person should see
    stop : set from outside when the node shall end
    collections : where garbage is collected only when the runner says so
    """

    def __init__(
        self,
        node: Node,
        bus: Bus,
        report: Callable[[str], None] | None = None,
        *,
        stop: threading.Event | None = None,
        collections: RareCollections | None = None,
    ) -> None:
        self.node = node
        self.bus = bus
        self._report = report or (lambda text: None)
        self._driver = StepDriver(node, time.perf_counter)
        self._check: StreamCheck[RawMessage] = StreamCheck(node.problem)
        self._sequencer: Sequencer[tuple[Message, int]] = Sequencer(node.inputs)  # with the time of reception
        self._inbox = Inbox(newest_depth=NEWEST_DEPTH, newest_bytes=NEWEST_BYTES)
        self._lock = threading.Lock()
        self._malformed: Counter[str] = Counter()
        self._stop = stop or threading.Event()
        self._patience = _Patience()
        self._worked_ns = 0
        self._looked_s = 0.0
        self._collections = collections
        self._status = StatusPublisher(bus, node.name)
        results = any(topics.find(name).family is Family.RESULT for name in node.inputs)
        # Who publishes nothing needs no order, and must not slow down those who do.
        self._ordered = bool(node.outputs)
        self._idle_s = IDLE_RESULTS_S if results else IDLE_S

    def stop(self) -> None:
        """Ask the runner to finish; safe in a signal handler and in any thread."""
        self._stop.set()

    def run(self) -> None:
        """Work until `stop`, then work off what waits, finish the node and publish what follows."""
        for name in self.node.inputs:
            self.bus.subscribe(name, self._receive, self._malformed_envelope)
        self.bus.prepare((*self.node.outputs, *self.node.decisions))
        self._declare_queries()
        self.bus.announce(self.node.name)
        self._status.publish("starting", self._statistics(), self.node, 0.0, 0, 0)
        self._join()
        heard = self._patience.now_s()
        while not self._stop.is_set():
            raws = self._inbox.take(0.0 if self._sequencer.ready else 0.02)
            now = self._patience.now_s()
            if raws:
                heard = now
            for raw in raws:
                self._arrive(raw, now)
            turn = self._sequencer.pop(now, MOST_AT_ONCE)
            for message, _ in turn:
                self._work(message)
            # what is held back for its order does not mean that too much is to be done
            self._look_behind(turn[-1][1] if self._sequencer.ready else 0)
            if len(self._sequencer) and now - heard > self._idle_s:
                for message, _ in self._sequencer.flush(ahead=False):
                    self._work(message)
            self._tell()
        self._end()

    def _join(self) -> None:
        """Work off what was sent before this node came: configuration and control, before everything else."""
        until = time.monotonic() + JOIN_S
        arrived: list[RawMessage] = []
        while time.monotonic() < until and not self._stop.is_set():
            arrived += self._inbox.take(0.05)
        latched = [raw for raw in arrived if topics.find(raw.topic).latched]
        for raw in sorted(latched, key=lambda raw: order_key(raw.topic, raw.envelope)):
            for accepted in self._check.accept(raw.topic, raw.envelope, raw):
                message = self._decode(accepted)
                if message is not None:
                    self._sequencer.hear(accepted.topic, accepted.envelope, self._patience.now_s())
                    self._work(message)
        self._worked_ns = 0  # configuration does not tell how far the flight is
        now = self._patience.now_s()
        for raw in arrived:
            if not topics.find(raw.topic).latched:
                self._arrive(raw, now)

    def _end(self) -> None:
        now = self._patience.now_s()
        for raw in self._inbox.take(0.0):
            self._arrive(raw, now)
        for message, _ in self._sequencer.flush():
            self._work(message)
        with self._lock:
            outputs = self._driver.finish()
        for output in outputs:
            self.bus.publish(output)
        self._tell(force=True, state="stopping")
        self._inbox.close()
        time.sleep(LAST_WORDS_S)

    # ---- one message

    def _receive(self, raw: RawMessage) -> None:
        try:
            policy = topics.find(raw.topic).queue
        except KeyError:
            self._malformed_envelope(raw.topic, "unknown topic")
            return
        if not self._ordered:
            policy = Queue.NEWEST
        self._inbox.put(raw, policy)

    def _malformed_envelope(self, topic: str, why: str) -> None:
        self._malformed[topic] += 1
        self.node.problem("malformed", f"{topic}: {why}")

    def _arrive(self, raw: RawMessage, now: float) -> None:
        for accepted in self._check.accept(raw.topic, raw.envelope, raw):
            message = self._decode(accepted)
            if message is None:
                continue
            if not self._ordered:
                self._work(message)
                continue
            item = message, accepted.receive_ns
            late = self._sequencer.push(accepted.topic, accepted.envelope, item, now)
            if late is not None:
                self._check.counts[accepted.topic].late += 1
                behind_s = ((self._sequencer.newest_ns or 0) - accepted.envelope.stamp_ns) / 1e9
                self.node.problem("late", f"{accepted.topic} {accepted.envelope.sequence} came {behind_s:.3f} s behind")
                self._work(message)

    def _decode(self, raw: RawMessage) -> Message | None:
        try:
            body = codec.decode(raw.topic, raw.data)
        except ValueError as error:
            self._check.counts[raw.topic].malformed += 1
            self.node.problem("malformed", f"{raw.topic} {raw.envelope.sequence} of {raw.envelope.source!r}: {error}")
            return None
        return Message(raw.topic, raw.envelope.stamp_ns, body, raw.envelope.source, raw.envelope.sequence)

    def _work(self, message: Message) -> None:
        failed = self.node.counters["failed"]
        with self._lock:  # queries are answered between steps
            outputs = self._driver.step(message)
        if self.node.counters["failed"] > failed:
            self._report(f"{self.node.name}: {self.node.last_problem}")
        for output in outputs:
            self.bus.publish(output)
        self._worked_ns = max(self._worked_ns, message.stamp_ns)

    def _look_behind(self, received_ns: int) -> None:
        """Tell the node for how long the message has waited that it worked on last, and publish what it decides.

        0 = nothing waits. Waiting time, not platform time: a replay may be faster than life.
        """
        now = time.monotonic()
        if now - self._looked_s < LAG_PERIOD_S or not self._worked_ns:
            return
        self._looked_s = now
        with self._lock:
            lag_s = max(time.time_ns() - received_ns, 0) / 1e9 if received_ns else 0.0
            decisions = self._driver.behind(lag_s, now)
        for decision in decisions:
            self.bus.publish(decision)

    # ---- what others see

    def _declare_queries(self) -> None:
        query = getattr(self.node, "query", None)
        for name in getattr(self.node, "queries", ("orientation",) if query is not None else ()):

            def answer(parameters: dict[str, str], name: str = name) -> Any:
                assert query is not None
                with self._lock:
                    found = query(name, parameters)
                return None if found is None else found.body

            self.bus.answer(name, answer)

    def _statistics(self) -> dict[str, TopicCounts]:
        counts = {topic: replace(counted) for topic, counted in self._check.counts.items()}
        for topic, number in self._inbox.dropped.items():
            counted = counts.setdefault(topic, TopicCounts())
            counted.dropped = number
            counted.gaps = max(0, counted.gaps - number)  # what was thrown away here was not lost on the way
        return counts

    def _tell(self, force: bool = False, state: str | None = None) -> None:
        if not force and not self._status.due():
            return
        if self._collections is not None:
            self._collections.if_due()
        newest = self._sequencer.newest_ns or self._worked_ns
        queued = len(self._inbox) + len(self._sequencer)
        lag_s = max(0, newest - self._worked_ns) / 1e9 if self._worked_ns else 0.0
        extra = dict(self._malformed)
        self._status.publish(state or self.node.state(), self._statistics(), self.node, lag_s, queued, newest, extra)


@contextmanager
def in_thread(runner: BusRunner) -> Iterator[None]:
    """Run a node beside other work; it has finished when the block is left."""
    thread = threading.Thread(target=runner.run, name=runner.node.name)
    thread.start()
    try:
        yield
    finally:
        runner.stop()
        thread.join()


class StatusPublisher:
    """Publishes ``status/<node>`` at 2 Hz."""

    def __init__(self, bus: Bus, name: str) -> None:
        self._bus = bus
        self._name = name
        self._begun = time.monotonic()
        self._last = 0.0
        self._received: Counter[str] = Counter()

    def due(self) -> bool:
        """Whether it is time for the next."""
        return time.monotonic() - self._last >= STATUS_PERIOD_S

    def publish(
        self,
        state: str,
        counts: dict[str, TopicCounts],
        node: Node,
        lag_s: float,
        queued: int,
        stamp_ns: int,
        malformed_envelopes: dict[str, int] | None = None,
    ) -> None:
        """Publish what the arguments say; ``stamp_ns`` is the newest platform time known (0: none yet)."""
        now = time.monotonic()
        light, reason = node.light()
        elapsed = now - self._last if self._last else 0.0
        self._last = now
        status = m.NodeStatus(
            node=self._name, state=state, uptime_s=now - self._begun, lag_s=lag_s, queued=queued,
            last_problem=node.last_problem, light=light, light_reason=reason,
        )  # fmt: skip
        extra = malformed_envelopes or {}
        for topic in sorted(set(counts) | set(extra)):
            c = counts.get(topic, TopicCounts())
            rate = (c.received - self._received[topic]) / elapsed if elapsed else 0.0
            self._received[topic] = c.received
            status.topics.add(
                topic=topic, received=c.received, gaps=c.gaps, duplicates=c.duplicates, late=c.late,
                malformed=c.malformed + extra.get(topic, 0), dropped=c.dropped, rate_hz=rate,
            )  # fmt: skip
        for name, value in sorted(node.counters.items()):
            status.counters.add(name=name, value=int(value))
        self._bus.publish(Message(f"status/{self._name}", stamp_ns, status, self._name))
