"""The bus runner: one node on the bus."""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

from ...schemas import codec, topics
from ...schemas.envelope import RawMessage
from ...schemas.topics import Family, Queue
from ..garbage_collection import RareCollections
from ..node import STOPPING, Message, Node
from ..ordering import Sequencer, StreamCheck, TopicCounts, order_key
from ..step_driver import StepDriver
from .inbox import NEWEST_BYTES, NEWEST_DEPTH, Inbox
from .recall import Recall
from .session import KEPT_S, Bus
from .status import StatusPublisher

#: After so long without any message everything that waits is worked off. A node that lives on the results of others
#: waits longer, so that theirs still come before, and one that lives on what becomes final longer still: the adjuster,
#: which says it, lives on results itself.
IDLE_S, IDLE_RESULTS_S, IDLE_FINAL_S = 1.0, 2.0, 4.0
#: Time in which latched topics arrive before the first message is worked off.
JOIN_S = 0.5
#: Messages worked off before it is looked what has arrived meanwhile.
MOST_AT_ONCE = 64
#: A node that only looks on takes what came in so long together, s, and is not woken for every message.
LOOK_ON_S = 0.05
#: How often a node is told how far it is behind.
LAG_PERIOD_S = 0.1
#: A steady input that says nothing for so long while the flight goes on is an alarm, s; ties may be rare for a while.
QUIET_S, LONG_QUIET_S = 4.0, 15.0
#: What comes while a strip is flown, and not between strips.
IN_STRIPS = ("sensor/lines/", "orientation/", "orthoimage/")
#: What was said before is of the flight that is under way if its stamp is not later by more, ns.
SAME_FLIGHT_NS = 5_000_000_000


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


def _idle_s(inputs: Iterable[str]) -> float:
    if any(name in topics.FINAL for name in inputs):
        return IDLE_FINAL_S
    return IDLE_RESULTS_S if any(topics.find(name).family is Family.RESULT for name in inputs) else IDLE_S


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
        self._sequencer: Sequencer[tuple[Message, int]] = Sequencer(
            self._driver.inputs, problem=self._own_clock
        )  # with the time of reception
        self._inbox = Inbox(newest_depth=NEWEST_DEPTH, newest_bytes=NEWEST_BYTES)
        self._lock = threading.Lock()
        self._malformed: Counter[str] = Counter()
        self._stop = stop or threading.Event()
        self._patience = _Patience()
        self._worked_ns = 0
        self._looked_s = 0.0
        self._busy_s = 0.0  # so far on messages
        self._opened_anew = 0
        self._said_ns = 0  # up to here somebody of this name has spoken before
        self._heard_s: dict[str, float] = {}  # when something of a topic was worked on
        self._open_strip = ""
        self._collections = collections
        self._status = StatusPublisher(bus, node.name)
        # Who publishes nothing needs no order, and must not slow down those who do.
        self._ordered = bool(node.outputs)
        listened = self._driver.inputs
        asked = listened if self._ordered else [name for name in listened if topics.find(name).latched]
        self._recall = Recall(bus, asked, self._check)
        self._idle_s = _idle_s(node.inputs)

    def stop(self) -> None:
        """Ask the runner to finish; safe in a signal handler and in any thread."""
        self._stop.set()

    def run(self) -> None:
        """Work until `stop`, then work off what waits, finish the node and publish what follows."""
        for name in self._driver.inputs:
            self.bus.subscribe(name, self._receive, self._malformed_envelope)
        self.bus.prepare((*self.node.outputs, *self.node.decisions))
        self._declare_queries()
        self.bus.announce(self.node.name)
        self._status.publish("starting", self._statistics(), self.node, 0.0, 0, 0)
        self._join()
        heard = self._patience.now_s()
        while not self._stop.is_set():
            if not self._ordered:
                self._stop.wait(LOOK_ON_S)
            raws = self._inbox.take(0.0 if self._sequencer.ready else 0.02)
            raws = self._recall.complete(raws) if self._ordered else self._recall.once(raws)
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
            self._recall.come_round()
        self._end()

    def _join(self) -> None:
        """Work off what was sent before this node came: configuration and control, before everything else."""
        until = time.monotonic() + JOIN_S
        arrived: list[RawMessage] = []
        while time.monotonic() < until and not self._stop.is_set():
            arrived += self._inbox.take(0.05)
        arrived = self._under_way(arrived)
        latched = [raw for raw in arrived if topics.find(raw.topic).latched]
        rest = [raw for raw in arrived if not topics.find(raw.topic).latched]
        for raw in sorted(latched, key=lambda raw: order_key(raw.topic, raw.envelope)):
            for accepted in self._check.accept(raw.topic, raw.envelope, raw):
                message = self._decode(accepted)
                if message is not None:
                    self._sequencer.hear(accepted.topic, accepted.envelope, self._patience.now_s())
                    self._work(message)
        self._worked_ns = 0  # configuration does not tell how far the flight is
        now = self._patience.now_s()
        for raw in rest:
            self._arrive(raw, now)
        self._recall.come_round()

    def _under_way(self, arrived: list[RawMessage]) -> list[RawMessage]:
        """What has come, and before it what was said lately, if a flight is under way when this node begins.

        What another one of its name has said before, which is gone now, is not said again. A node that only looks on
        asks for what is latched alone.
        """
        joined = self._recall.joined(arrived)
        if self._recall.recalled:
            heard = self.bus.query("heard", "observation/progress", source=self.node.name)
            said_ns, newest_ns = max((body.time_ns for body in heard), default=0), joined[-1].envelope.stamp_ns
            self._said_ns = said_ns if said_ns < newest_ns + SAME_FLIGHT_NS else 0
            self._report(f"{self.node.name}: begins with {self._recall.recalled} messages of the last {KEPT_S:.0f} s")
        return joined

    def _publish(self, output: Message) -> None:
        if output.stamp_ns <= self._said_ns and not topics.find(output.topic).latched:
            self.node.counters["said before"] += 1
            return
        self.bus.publish(output)

    def _end(self) -> None:
        now = self._patience.now_s()
        for raw in self._inbox.take(0.0):
            self._arrive(raw, now)
        self._check.end()
        for message, _ in self._sequencer.flush():
            self._work(message)
        with self._lock:
            outputs = self._driver.finish()
        self._count_refused_later()
        for output in outputs:
            self._publish(output)
        self._tell(force=True, state=STOPPING)
        self._inbox.close()

    # ---- one message

    def _receive(self, raw: RawMessage) -> None:
        if raw.envelope.start == self.bus.start and raw.envelope.source == self.node.name:
            return  # what it says itself on a topic that it listens to as well
        try:
            policy = topics.find(raw.topic).queue
        except KeyError:
            self._malformed_envelope(raw.topic, "unknown topic")
            return
        if not self._ordered:
            policy = Queue.NEWEST
        self._inbox.put(raw, policy)

    def _own_clock(self, kind: str, text: str) -> None:
        self.node.problem(kind, text)
        self.node.alarms[kind] = text

    def _hear(self, topic: str) -> None:
        row = topics.find(topic)
        if not row.latched and row.family is not Family.STATUS:
            self._heard_s[topic] = time.monotonic()

    def _silence(self) -> str:
        """A line for the operator about steady inputs that have fallen silent while the flight goes on."""
        now = time.monotonic()
        flying = self._open_strip or any(now - heard < QUIET_S / 2 for heard in self._heard_s.values())
        missed = []
        for topic, heard in self._heard_s.items():
            row = topics.find(topic)
            in_strips = topic == "observation/tie" or topic.startswith(IN_STRIPS)
            steady = row.rate_hz > 0 and not row.in_bursts and row.family is not Family.DECISION
            quiet_s = LONG_QUIET_S if row.family is Family.OBSERVATION else QUIET_S
            if steady and now - heard > quiet_s and (self._open_strip if in_strips else flying):
                name = "trajectory" if topic.startswith("trajectory/") else topic
                missed.append(f"no {name} for {now - heard:.0f} s")
        return ", ".join(sorted(set(missed)))

    def _malformed_envelope(self, topic: str, why: str) -> None:
        self._malformed[topic] += 1
        self.node.problem("malformed", f"{topic}: {why}")

    def _arrive(self, raw: RawMessage, now: float) -> None:
        for accepted in self._check.accept(raw.topic, raw.envelope, raw):
            if not (self._ordered or self.node.looks_at(accepted.topic, accepted.envelope.stamp_ns)):
                continue
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
        e = raw.envelope
        return Message(raw.topic, e.stamp_ns, body, e.source, e.sequence, e.start)

    def _work(self, message: Message) -> None:
        self._hear(message.topic)
        if message.topic == "configuration/strip":
            self._open_strip = "" if message.body.ended else message.body.id
        failed, malformed, refusals = self.node.counters["failed"], self.node.counters["malformed"], self.node.refusals
        begun = time.monotonic()
        with self._lock:  # queries are answered between steps
            outputs = self._driver.step(message)
        last = self.node.last_problems
        if self.node.counters["failed"] > failed or self.node.refusals > refusals:
            self._check.counts[message.topic].refused += 1
        self._count_refused_later()
        if self.node.counters["failed"] > failed:
            self._report(f"{self.node.name}: {last['failed']}")
        if self.node.counters["malformed"] > malformed == 0:
            self._report(f"{self.node.name}: {last['malformed']}")
        for output in outputs:
            self._publish(output)
        self._worked_ns = max(self._worked_ns, message.stamp_ns)
        self._busy_s += time.monotonic() - begun

    def _count_refused_later(self) -> None:
        """Count messages that had waited in the node where they belong, not with the one at which they were refused."""
        for topic, number in self.node.refused_later.items():
            self._check.counts[topic].refused += number
        self.node.refused_later.clear()

    def _look_behind(self, received_ns: int) -> None:
        """Tell the node for how long its last message has waited and it has worked, and publish what it decides.

        0 = nothing waits. Waiting time, not platform time: a replay may be faster than life.
        """
        now = time.monotonic()
        if now - self._looked_s < LAG_PERIOD_S or not self._worked_ns:
            return
        self._looked_s = now
        with self._lock:
            lag_s = max(time.time_ns() - received_ns, 0) / 1e9 if received_ns else 0.0
            decisions = self._driver.behind(lag_s, now, self._busy_s)
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
        for why in self.bus.opened_anew[self._opened_anew :]:
            self._opened_anew += 1
            self.node.last_problem = f"the session was opened anew: {why}"
            self._report(f"{self.node.name}: {self.node.last_problem}")
        self.node.alarms["silence"] = self._silence() if self._ordered and state is None else ""
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
