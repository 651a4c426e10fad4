"""Second voices on a real bus: named, told where the operator looks, and decided by ``triline confirm``."""

from __future__ import annotations

import copy
import json
import threading

import pytest
import sample_messages as sample
from bus_rig import free_port, triline, wait_for

from triline.nodes.bus.live import BusRunner, in_thread
from triline.nodes.bus.session import Bus
from triline.nodes.cli import confirm, main
from triline.nodes.monitor.monitor import Monitor
from triline.nodes.node import Message, Node
from triline.schemas import messages as m
from triline.schemas.envelope import Envelope, RawMessage


class Listening(Node):
    inputs = ("configuration/camera", "sensor/attitude")
    outputs = ("event/log",)

    def __init__(self, name: str) -> None:
        super().__init__()
        self.name = name
        self.given: list[Message] = []

    def step(self, message):
        self.given.append(message)
        return ()


def attitudes(sender: Bus, source: str, stop: threading.Event) -> threading.Thread:
    """Publishes attitudes until told to stop."""

    def fly() -> None:
        i = 0
        while not stop.wait(0.02):
            i += 4
            sender.publish(sample.message("sensor/attitude", i, source))

    flight = threading.Thread(target=fly, daemon=True)
    flight.start()
    return flight


def test_two_nodes_of_one_name_are_told_and_no_longer_when_one_has_ended():
    port, monitor = free_port(), Monitor()
    with (
        Bus(port=port, source="monitor") as bus,
        in_thread(BusRunner(monitor, bus)),
        Bus(port=port, source="adjuster") as one,
        in_thread(BusRunner(Listening("adjuster"), one)),
    ):
        with Bus(port=port, source="adjuster") as two, in_thread(BusRunner(Listening("adjuster"), two)):
            wait_for(monitor.overview.alarms, 10, "the alarm")
            told = "2 nodes 'adjuster' run on platform demo: stop all but one of them"
            assert monitor.overview.alarms() == [told] and told in monitor.overview.line()
        wait_for(lambda: not monitor.overview.alarms(), 10, "the end of the alarm")


def test_several_may_look_on_and_one_may_count():
    """A second monitor disturbs nobody; what a node said last before it ended is no alarm for ever."""
    port, monitor = free_port(), Monitor()
    node = Listening("adjuster")
    node.alarms["test"] = "no sensor/gnss for 9 s"
    with Bus(port=port, source="monitor") as bus, in_thread(BusRunner(monitor, bus)):
        with Bus(port=port, source="adjuster") as one, in_thread(BusRunner(node, one)):
            wait_for(monitor.overview.alarms, 10, "the alarm of the node")
            done = triline("monitor", "--json", "--seconds", 8, "--port", port)
            assert done.returncode == 0, done.stderr
            seen = json.loads(done.stdout)
            assert seen["nodes"]["adjuster"]["state"] == "running" and seen["report"] is None
            assert seen["alarms"] == monitor.overview.alarms() == ["no sensor/gnss for 9 s"]
            monitor.overview.ending = True
            assert not monitor.overview.alarms() and monitor.overview.line().startswith("ending: nodes finish")
            monitor.overview.ending = False
        wait_for(lambda: not monitor.overview.alarms(), 10, "the end of the alarm with its node")


def test_a_source_that_nobody_heard_is_not_chosen(capsys):
    port, node, stop = free_port(), Listening("navigator"), threading.Event()
    with (
        Bus(port=port, source="chain") as bus,
        Bus(port=port, source="receiver") as sender,
        in_thread(BusRunner(node, bus)),
    ):
        wait_for(lambda: "navigator" in sender.alive(), 10, "the node")

        flight = attitudes(sender, "receiver", stop)
        code = main(["confirm", "sensor/attitude", "--source", "reciever", "--port", str(port)])
        stop.set()
        flight.join()
    assert code == 1
    assert "--source reciever: does not speak on sensor/attitude; heard receiver" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("received", "recorded", "said"),
    [
        ((), (), "--source foo: nobody has spoken on sensor/gnss"),
        (("sensor/attitude",), ("sensor/attitude",), "--source foo: nobody has spoken on sensor/gnss"),
        (("sensor/gnss",), ("sensor/gnss",), "--source foo: has not spoken on sensor/gnss; recorded receiver"),
        (("sensor/gnss",), (), "the verdict was sent"),  # it may have been foo
    ],
)
def test_a_source_of_a_silent_topic_is_not_chosen_either(received, recorded, said, monkeypatch, capsys):
    for name, seconds in (("ANSWER_S", 0.1), ("LISTEN_S", 0.2), ("NOBODY_S", 0.2)):
        monkeypatch.setattr(confirm, name, seconds)
    inventory, stop, port = m.Inventory(), threading.Event(), free_port()
    for topic in recorded:
        inventory.streams.add(topic=topic, source="receiver")
    answer = RawMessage("query/inventory", Envelope(0, "recorder", 0), inventory.SerializeToString())
    with Bus(port=port, source="recorder") as bus:
        bus.answer_messages("inventory", lambda _: [answer] if recorded else [])

        def report() -> None:
            while not stop.wait(0.02):
                status = sample.message("status/recorder")
                del status.body.topics[:]
                for topic in received:
                    status.body.topics.add(topic=topic, received=7)
                bus.publish(Message(status.topic, sample.EPOCH_NS, status.body, "recorder"))

        reporting = threading.Thread(target=report, daemon=True)
        reporting.start()
        assert main(["confirm", "sensor/gnss", "--source", "foo", "--port", str(port)]) == 1
        assert said in capsys.readouterr().err
        if recorded:  # who has spoken before may be chosen, and anybody be rejected
            for words in (["--source", "receiver"], ["--source", "foo", "--reject"]):
                assert main(["confirm", recorded[0], *words, "--port", str(port)]) == 1
                assert "the verdict was sent" in capsys.readouterr().err
        stop.set()
        reporting.join()


def test_a_verdict_beside_a_recorder_says_that_no_data_come(monkeypatch, capsys):
    monkeypatch.setattr(confirm, "ANSWER_S", 0.5)
    monkeypatch.setattr(confirm, "LISTEN_S", 0.2)
    port, stop = free_port(), threading.Event()
    newest = [sample.EPOCH_NS]
    with Bus(port=port, source="recorder") as bus:
        bus.subscribe("observation/verdict", lambda raw: newest.append(raw.envelope.stamp_ns))

        def report() -> None:
            while not stop.wait(0.05):
                status = sample.message("status/recorder")
                bus.publish(Message(status.topic, max(newest), status.body, "recorder"))

        reporting = threading.Thread(target=report, daemon=True)
        reporting.start()
        code = main(["confirm", "GCP1", "--port", str(port)])
        stop.set()
        reporting.join()
    assert len(newest) == 2 and code == 1
    assert "GCP1: the verdict was sent, but no data come; it counts when they do" in capsys.readouterr().err


def test_a_verdict_waits_longer_for_nodes_that_live_and_are_heard_late(monkeypatch, capsys):
    """Over a full downlink the first message and the answer come after more than the usual wait."""
    for name, seconds in (("ANSWER_S", 0.3), ("LISTEN_S", 0.2), ("NOBODY_S", 0.3)):
        monkeypatch.setattr(confirm, name, seconds)
    port, stop, sent = free_port(), threading.Event(), threading.Event()
    with Bus(port=port, source="adjuster") as bus:
        bus.announce("adjuster")
        bus.subscribe("observation/verdict", lambda raw: sent.set())

        def report() -> None:
            stop.wait(2.5)  # what waits on the link
            while not sent.wait(0.05) and not stop.is_set():
                bus.publish(Message("status/adjuster", sample.EPOCH_NS, sample.body("status/adjuster"), "adjuster"))
            stop.wait(1.5)
            for said in ("rejected: its coordinates do not count (Ann)", "confirmed (Bob)", "confirmed (Ann)"):
                log = m.Log(name="adjuster", message=f"GCP1 is {said}")  # two desks decide at once
                bus.publish(Message("event/log", sample.EPOCH_NS, log))
                stop.wait(0.2)

        reporting = threading.Thread(target=report, daemon=True)
        reporting.start()
        code = main(["confirm", "GCP1", "--by", "Ann", "--port", str(port)])
        stop.set()
        reporting.join()
    said = capsys.readouterr()
    assert (code, said.out) == (0, "GCP1 is confirmed (Ann)\n"), said.err


def test_a_camera_in_flight_waits_for_triline_confirm_and_an_empty_one_is_malformed(capsys):
    camera = sample.body("configuration/camera")
    other = copy.deepcopy(camera)
    other.lenses[0].focal_length_mm *= 1.05
    node, port = Listening("navigator"), free_port()
    stop = threading.Event()
    with (
        Bus(port=port, source="chain") as bus,
        Bus(port=port, source="test") as sender,
        in_thread(BusRunner(node, bus)),
    ):
        wait_for(lambda: "navigator" in sender.alive(), 10, "the node")

        sender.publish(Message("configuration/camera", sample.EPOCH_NS, camera, "test"))
        flight = attitudes(sender, "test", stop)
        wait_for(lambda: len(node.given) > 10, 10, "attitudes")
        envelope = Envelope(sample.EPOCH_NS, "intruder", 0, 5)
        sender.publish_raw(RawMessage("configuration/camera", envelope, b""))
        wait_for(lambda: node.counters["malformed"], 10, "the empty camera")
        assert "empty, wanted a triline.Camera" in node.last_problem
        sender.publish(Message("configuration/camera", sample.EPOCH_NS + 10**9, other, "test"))
        wait_for(lambda: "is another one than the flight began with" in node.alarm, 10, "the alarm")
        done = triline("confirm", "configuration/camera", "--by", "Ann", "--port", port)
        assert done.returncode == 0, done.stderr
        assert done.stdout == "configuration/camera of 'test' is used from now on (Ann)\n"
        again = ["confirm", "configuration/camera", "--port", str(port)]
        assert main(again) == 1
        told = "triline confirm: configuration/camera: nothing waits for a decision\n"
        assert capsys.readouterr().err == told
        stop.set()
        flight.join()
        assert main(again) == 1 and "no data come; it counts when they do" in capsys.readouterr().err
    cameras = [message.body for message in node.given if message.topic == "configuration/camera"]
    assert cameras == [camera, other] and not node.alarm
    assert main(["confirm", "sensor/nothing", "--source", "x"]) == 1
    assert main(["confirm", "observation/tie"]) == 1
    assert "anybody may speak on it" in capsys.readouterr().err
