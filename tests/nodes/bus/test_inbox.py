"""Queues between the bus and a node: lossless ones hold their publisher, newest-first ones lose their oldest."""

from __future__ import annotations

import threading
import time

import sample_messages as sample
from bus_rig import free_port, wait_for, wait_for_listener, wait_for_nodes

from triline.nodes.bus.inbox import Inbox
from triline.nodes.bus.live import BusRunner
from triline.nodes.bus.session import Bus
from triline.nodes.node import Message, Node
from triline.schemas.envelope import Envelope, RawMessage
from triline.schemas.topics import Queue


def raw(i, topic="sensor/lines/F"):
    return RawMessage(topic, Envelope(i, "a", i), b"")


def test_a_full_newest_first_queue_loses_its_oldest_and_counts():
    inbox = Inbox(newest_depth=3)
    for i in range(10):
        inbox.put(raw(i), Queue.NEWEST)
        inbox.put(raw(i, "sensor/gnss"), Queue.LOSSLESS)
    taken = inbox.take(0.0)
    assert [r.envelope.sequence for r in taken if r.topic == "sensor/lines/F"] == [7, 8, 9]
    assert [r.envelope.sequence for r in taken if r.topic == "sensor/gnss"] == list(range(10))
    assert inbox.dropped == {"sensor/lines/F": 7}


def test_a_full_lossless_queue_holds_its_publisher():
    inbox = Inbox(lossless_depth=5)
    thread = threading.Thread(target=lambda: [inbox.put(raw(i), Queue.LOSSLESS) for i in range(20)])
    thread.start()
    wait_for(lambda: len(inbox) == 5, what="a full queue")
    time.sleep(0.1)
    assert len(inbox) == 5
    taken = []
    while len(taken) < 20:
        taken += inbox.take(0.5)
    thread.join()
    assert [r.envelope.sequence for r in taken] == list(range(20))


class Slow(Node):
    """Only looks on, and takes its time."""

    name, inputs, outputs = "slow", ("sensor/attitude", "sensor/lines/*"), ()

    def __init__(self) -> None:
        super().__init__()
        self.seen: list[Message] = []

    def step(self, message: Message):
        time.sleep(0.01)
        self.seen.append(message)
        return ()


def test_a_node_that_only_looks_on_slows_nobody():
    port, stop = free_port(), threading.Event()
    with Bus(port=port, source="slow") as bus, Bus(port=port, source="sender") as sender:
        runner = BusRunner(Slow(), bus, stop=stop)
        runner._inbox = Inbox(newest_depth=20)
        thread = threading.Thread(target=runner.run)
        thread.start()
        wait_for_nodes(sender, "slow")
        wait_for_listener(sender._session, sender.key("sensor/attitude"))
        begun = time.monotonic()
        for i in range(1000):
            sender.publish(sample.message("sensor/attitude", i))
        assert time.monotonic() - begun < 6.0  # 10 s of work for the node
        wait_for(lambda: runner.node.seen and runner.node.seen[-1].sequence == 999, 20, "the newest message")
        stop.set()
        thread.join()
    counts = runner._statistics()["sensor/attitude"]
    assert counts.dropped > 500
    assert counts.dropped + len(runner.node.seen) == 1000
    assert counts.gaps == 0


class Refuses(Slow):
    """Can use no attitude that comes."""

    def step(self, message: Message):
        self.seen.append(message)
        if message.topic == "sensor/attitude":
            self.refuse("malformed", f"{message.topic}: no. {len(self.seen)} by design")
        return ()


def test_what_a_node_refuses_first_is_written_to_its_log():
    """All image lines of a camera were refused, and the log said so at the end of the flight."""
    said: list[str] = []
    with Bus(port=free_port(), source="slow") as bus:
        runner = BusRunner(Refuses(), bus, said.append)
        for number in range(3):
            runner._work(sample.message("sensor/attitude", number))
            runner._work(sample.message("sensor/lines/N", number))
        counts = runner._statistics()
    assert said == ["slow: sensor/attitude: no. 1 by design"]
    assert counts["sensor/attitude"].refused == 3 and "sensor/lines/N" not in counts  # which were of use


class RefusesLater(Slow):
    """Keeps image points until a pose comes, and can use none of them."""

    held = 0

    def step(self, message: Message):
        self.held += message.topic == "observation/tie"
        if message.topic == "trajectory/filtered":
            self.refused_later["observation/tie"] += self.held
            self.held = 0
        return ()

    def finish(self):
        self.refused_later["observation/tie"] += self.held
        return ()


def test_what_waited_in_a_node_is_counted_where_it_belongs_when_it_is_refused():
    """The pose was counted as refused, once, and of the image points none."""
    with Bus(port=free_port(), source="slow") as bus:
        runner = BusRunner(RefusesLater(), bus, lambda text: None)
        for number in range(3):
            runner._work(sample.message("observation/tie", number))
        assert runner._statistics() == {}
        runner._work(sample.message("trajectory/filtered", 3))
        assert {topic: counted.refused for topic, counted in runner._statistics().items()} == {"observation/tie": 3}
        runner._work(sample.message("observation/tie", 4))
        runner._end()
        assert runner._statistics()["observation/tie"].refused == 4
