"""Nodes on the bus: real sessions, real processes."""

from __future__ import annotations

import signal
import threading
import time

import numpy as np
import pytest
import sample_messages as sample
import zenoh
from bus_rig import (
    PATIENCE,
    Rig,
    free_port,
    here,
    simulated_flight,
    triline,
    wait_for,
    wait_for_listener,
    wait_for_nodes,
)
from recording_file import payloads, write_recording

from triline.nodes import convert
from triline.nodes.bus.live import BusRunner
from triline.nodes.bus.session import Bus, configuration
from triline.nodes.errors import UserError
from triline.nodes.node import Message, Node
from triline.nodes.recording.reader import RecordingReader
from triline.nodes.recording.runner import process
from triline.nodes.recording.writer import RecordingWriter
from triline.schemas import codec
from triline.schemas import messages as m
from triline.schemas.envelope import Envelope, RawMessage


@pytest.fixture
def rig(tmp_path):
    with Rig(tmp_path) as rig:
        yield rig


# ---- the same live and from a recording


@pytest.mark.study
def test_live_and_process_give_the_same_messages(rig, tmp_path):
    flight, live, processed = simulated_flight(), tmp_path / "live.mcap", tmp_path / "processed.mcap"
    recorder = rig.start("node", "recorder", "-o", live)
    navigator = rig.start("node", "navigator")
    adjuster = rig.start("node", "adjuster", "--set", 'pace="normal"')  # a slow machine has another test
    with Bus(port=rig.port) as bus:
        wait_for(lambda: bus.alive() >= {"recorder", "navigator", "adjuster"}, 20, "the nodes")
    replay = rig.start("replay", flight, "--rate", 5, "--wait-for", "navigator,adjuster")
    assert replay.wait(120) == 0
    time.sleep(2.3)  # until all that waits in the nodes has been worked off
    assert [rig.stop(p) for p in (navigator, adjuster, recorder)] == [0, 0, 0], rig.log("recorder")
    for name in ("navigator", "adjuster", "recorder", "replay"):
        assert "FATAL" not in rig.log(name) and "Traceback" not in rig.log(name)
    done = triline("process", live, "-o", processed)
    assert done.returncode == 0, done.stderr
    for topic in (
        "trajectory/filtered",
        "trajectory/smoothed",
        "orientation/live",
        "orientation/final",
        "point/object",
    ):
        assert len(payloads(live, topic)) > 20
        assert payloads(live, topic) == payloads(processed, topic), topic
    reports = [RecordingReader(path).sorted_messages(["adjustment/report"]) for path in (live, processed)]
    for one, two in zip(*reports, strict=True):
        assert one.body.compute_s > 0
        one.body.compute_s = two.body.compute_s
        assert one == two
    # and the same as from the flight itself, which never was on a bus
    again = tmp_path / "again.mcap"
    assert triline("process", flight, "-o", again, "--pace", "load").returncode == 0
    assert payloads(again, "orientation/final") == payloads(processed, "orientation/final")


def test_nobody_is_waited_for_who_is_not_there(rig, tmp_path):
    """A tie point is worked in as soon as a pose after it has come, with no matcher that could have others.

    Platform time stands still until the answer is there; what is told again meanwhile keeps the node from taking the
    silence for the end.
    """
    navigated = tmp_path / "navigated.mcap"
    assert here("process", simulated_flight(), "-o", navigated, "--nodes", "navigator", "--processes", 1) == 0
    wanted = (
        "configuration/project", "configuration/camera", "configuration/strip", "observation/control",
        "observation/tie", "trajectory/filtered", "trajectory/smoothed",
    )  # fmt: skip
    messages = list(RecordingReader(navigated).sorted_messages(wanted))
    first_ns = min(message.stamp_ns for message in messages if message.topic == "trajectory/smoothed")
    times = [m.stamp_ns for m in messages if m.topic == "observation/tie" and m.stamp_ns > first_ns + 200_000_000]
    asked = times[:: max(len(times) // 6, 1)]
    assert len(asked) >= 6
    rig.start("node", "adjuster", "--set", "update_rays=1", "--set", 'pace="normal"')
    answered: set[int] = set()
    with Bus(port=rig.port) as bus:
        bus.prepare(wanted)
        bus.subscribe("adjustment/report", lambda raw: answered.add(raw.envelope.stamp_ns))
        wait_for(lambda: "adjuster" in bus.alive(), 20, "the adjuster")
        for message in messages:
            while asked and message.stamp_ns > asked[0] + 15_000_000:  # poses come every 5 ms

                def told(stamp_ns: int = asked[0]) -> bool:
                    bus.publish(messages[0])
                    return stamp_ns in answered

                wait_for(told, 20, f"the answer to the tie point of {asked.pop(0)}")
            bus.publish(message)
    assert not asked


class Chain(Node):
    """An order-dependent node: its output is a running product over all inputs."""

    name = "chain"
    inputs = ("configuration/project", "sensor/attitude", "sensor/gnss", "observation/tie")
    outputs = ("event/log",)

    def __init__(self) -> None:
        super().__init__()
        self.value = 1

    def step(self, message: Message):
        self.value = (self.value * 31 + hash((message.topic, message.sequence))) % 2**61
        log = m.Log(message=f"{message.topic} {message.sequence} {self.value}")
        return [Message("event/log", message.stamp_ns, log)]

    def finish(self):
        return [Message("event/log", 0, m.Log(message=f"end {self.value}"))]


def jittered(messages, seed):
    """The same messages in an order of arrival with delays up to 19 ms, each stream in its own order."""
    rng = np.random.default_rng(seed)
    arrived: dict[str, int] = {}
    timed = []
    for i, message in enumerate(messages):
        arrived[message.topic] = max(arrived.get(message.topic, 0), message.stamp_ns + int(rng.uniform(0, 19e6)))
        timed.append((arrived[message.topic], i, message))
    return [message for *_, message in sorted(timed, key=lambda t: t[:2])]


@pytest.mark.parametrize("seed", [1, pytest.param(2, marks=pytest.mark.study)])
def test_jitter_of_arrival_does_not_change_a_result(tmp_path, seed):
    messages = [m for m in sample.flight(3.0) if m.topic in Chain.inputs]
    write_recording(tmp_path / "a.mcap", messages)
    expected = []
    process(RecordingReader(tmp_path / "a.mcap"), [Chain()], lambda raw: expected.append(raw))
    expected = [bytes(raw.data) for raw in expected if raw.topic == "event/log"]

    port, got, stop = free_port(), [], threading.Event()
    with Bus(port=port, source="sender") as sender, Bus(port=port, source="chain") as bus:
        sender.subscribe("event/log", lambda raw: got.append(raw.data))
        runner = BusRunner(Chain(), bus, stop=stop)
        thread = threading.Thread(target=runner.run)
        thread.start()
        wait_for_nodes(sender, "chain")
        for topic in Chain.inputs:
            wait_for_listener(sender._session, sender.key(topic))
        arrival = jittered(messages, seed)
        assert [a.topic for a in arrival] != [a.topic for a in messages]
        for message in arrival:
            sender.publish(message)
            time.sleep(0.0005)
        wait_for(lambda: len(got) == len(messages), what="all outputs")
        stop.set()
        thread.join()
        wait_for(lambda: len(got) == len(messages) + 1, what="the last output")
    assert got == expected
    assert not any(c.late for c in runner._statistics().values())


# ---- bad input


def test_bad_messages_are_counted_reported_and_dropped(rig):
    navigator = rig.start("node", "navigator")
    statuses = []
    session = zenoh.open(configuration(rig.port))
    with Bus(port=rig.port, source="test") as bus:
        bus.subscribe("status/*", lambda raw: statuses.append(codec.decode(raw.topic, raw.data)))
        wait_for_nodes(bus, "navigator")
        for opened in (session, bus._session):
            wait_for_listener(opened, bus.key("sensor/gnss"))
        good = codec.encode(sample.body("sensor/gnss"))
        key = bus.key("sensor/gnss")
        session.put(key, good)  # no envelope
        session.put(key, good, attachment=b"\x63" + bytes(24))  # unknown version
        session.put(key, good, attachment=b"\x01\x02")  # cut short

        def send(sequence, data, t=0):
            envelope = Envelope(sample.EPOCH_NS + t, "test", sequence, 1)
            bus.publish_raw(RawMessage("sensor/gnss", envelope, data))

        send(0, good)
        send(1, b"\xff\xff\xff")  # not decodable
        nan = sample.body("sensor/gnss")
        nan.latitude = float("nan")
        send(2, codec.encode(nan))
        wrong = sample.body("sensor/gnss")
        wrong.position_covariance.append(1.0)
        send(3, codec.encode(wrong))
        send(4, good, t=10**9)
        send(5, good, t=0)  # time goes back
        send(6, good, t=2 * 10**9)
        send(6, good, t=2 * 10**9)  # twice
        send(9, good, t=3 * 10**9)  # two missing

        def counts():
            rows = [t for s in statuses if s.node == "navigator" for t in s.topics if t.topic == "sensor/gnss"]
            return (rows[-1].malformed, rows[-1].duplicates, rows[-1].gaps) if rows else None

        wait_for(lambda: counts() == (7, 1, 2), what=f"the counts (last {counts()})")
        assert statuses[-1].last_problem
    session.close()
    assert navigator.poll() is None
    assert rig.stop(navigator) == 0


class Fragile(Chain):
    """Fails on every third message."""

    def step(self, message: Message):
        if message.sequence % 3 == 2:
            raise ZeroDivisionError("by design")
        return super().step(message)


def test_a_node_whose_step_fails_lives_and_says_so(tmp_path):
    with RecordingWriter(tmp_path / "a.mcap") as writer:
        for i in range(9):
            writer.write(sample.message("sensor/gnss", i))
    out = []
    summary = process(RecordingReader(tmp_path / "a.mcap"), [Fragile()], out.append)
    assert summary.counters == {"chain": {"failed": 3}}
    assert summary.outputs == {"event/log": 7}
    assert "ZeroDivisionError: by design (test_bus.py:" in summary.problems["chain"]


# ---- the bus itself


def test_late_joiners_get_configuration_and_control_before_all_else(rig):
    replay = rig.start("replay", simulated_flight(), "--rate", 0.5)
    steps: list[Message] = []

    class Witness(Chain):
        inputs = ("configuration/camera", "observation/control", "sensor/attitude")

        def step(self, message: Message):
            steps.append(message)
            return ()

    with Bus(port=rig.port, source="witness") as bus:
        heard: list[int] = []
        bus.subscribe("sensor/attitude", lambda raw: heard.append(raw.envelope.sequence))
        wait_for(lambda: heard and heard[-1] > 60, 30, "the middle of the flight")
        stop = threading.Event()
        thread = threading.Thread(target=BusRunner(Witness(), bus, stop=stop).run)
        thread.start()
        wait_for(lambda: sum(s.topic == "sensor/attitude" for s in steps) > 20, what="measurements")
        stop.set()
        thread.join()
    topics = [s.topic for s in steps]
    first = topics.index("sensor/attitude")
    assert topics.count("configuration/camera") == 1 and topics.count("observation/control") > 3
    assert set(topics[first:]) == {"sensor/attitude"}
    numbers = [step.sequence for step in steps[first:]]  # what was said before is asked for
    assert numbers == list(range(len(numbers)))
    assert rig.stop(replay, signal.SIGTERM) == 0


def test_the_port_is_taken_over_when_its_owner_is_killed(rig):
    first = rig.start("node", "navigator", name="first")
    with Bus(port=rig.port, source="a") as a:
        wait_for(lambda: a.peers() == 1, 20, "the owner")
        with Bus(port=rig.port, source="b") as b:
            wait_for(lambda: a.peers() == b.peers() == 2, what="links")
            got = []
            b.subscribe("sensor/gnss", lambda raw: got.append((raw.envelope.source, raw.envelope.sequence)))
            first.kill()
            wait_for(lambda: a.peers() == 1, what="the end of the owner")
            wait_for_listener(a._session, a.key("sensor/gnss"))  # b: the owner listened, too
            a.publish(sample.message("sensor/gnss", source="a"))
            wait_for(lambda: got == [("a", 0)], what="a message without the owner")
            with Bus(port=rig.port, source="c") as c:  # comes later: takes the port, and all find it
                wait_for(lambda: c.peers() == 2, what="links of the newcomer")
                wait_for_listener(c._session, c.key("sensor/gnss"))
                c.publish(sample.message("sensor/gnss", source="c"))
                wait_for(lambda: ("c", 0) in got, what="a message of the newcomer")


def test_nodes_are_seen_to_live_and_to_die(rig):
    seen = []
    with Bus(port=rig.port, source="watcher") as bus:
        bus.watch(lambda node, alive: seen.append((node, alive)))
        navigator = rig.start("node", "navigator")
        wait_for(lambda: ("navigator", True) in seen, 20, "the navigator")
        navigator.kill()
        wait_for(lambda: ("navigator", False) in seen, what="its end")
        assert bus.alive() == set()


def test_queries_are_answered(tmp_path):
    class Answering(Chain):
        def query(self, name, parameters):
            if "t" not in parameters:
                raise ValueError("t is missing, wanted a time in ns")
            time_ns = int(parameters["t"])
            return Message("query/orientation", time_ns, convert.pose_message(time_ns, (1, 2, 3), (0, 0, 0)))

    port, stop = free_port(), threading.Event()
    with Bus(port=port, source="chain") as bus, Bus(port=port, source="other") as other:
        thread = threading.Thread(target=BusRunner(Answering(), bus, stop=stop).run)
        thread.start()
        wait_for(lambda: "chain" in other.alive(), what="the node")
        (pose,) = other.query("orientation", "orientation/live", t=sample.EPOCH_NS)
        assert convert.time_ns(pose.timestamp) == sample.EPOCH_NS
        with pytest.raises(ValueError, match="t is missing"):
            other.query("orientation", "orientation/live")
        assert other.query("weather", "orientation/live", timeout_s=0.5) == []
        stop.set()
        thread.join()


# nodes that are stopped by SIGINT end well in the tests of what is recalled and of nodes that are killed
@pytest.mark.parametrize("number", [pytest.param(signal.SIGINT, marks=pytest.mark.study), signal.SIGTERM])
def test_a_stop_under_load_is_clean(rig, number, tmp_path):
    recorder = rig.start("node", "recorder", "-o", tmp_path / "a.mcap")
    navigator = rig.start("node", "navigator")
    replay = rig.start("replay", simulated_flight(), "--rate", 3, "--wait-for", "navigator")
    with Bus(port=rig.port) as bus:
        poses: list[RawMessage] = []
        bus.subscribe("trajectory/filtered", poses.append)
        wait_for(lambda: bus.alive() >= {"recorder", "navigator", "player"}, 20, "the nodes")
        wait_for(lambda: len(poses) > 300, 20, "the middle of the flight")
    assert [rig.stop(p, number) for p in (navigator, replay, recorder)] == [0, 0, 0]
    for name in ("navigator", "replay", "recorder"):
        assert "FATAL" not in rig.log(name) and "Traceback" not in rig.log(name), rig.log(name)
    assert here("check", tmp_path / "a.mcap") == 0


def test_a_recorder_that_is_stopped_takes_what_is_on_its_way(rig, tmp_path):
    recorder = rig.start("node", "recorder", "-o", tmp_path / "a.mcap")
    with Bus(port=rig.port, source="last") as bus:
        wait_for_nodes(bus, "recorder")
        bus.prepare(["sensor/gnss"])
        wait_for_listener(bus._session, bus.key("sensor/gnss"))
        for number in range(40):
            bus.publish(sample.message("sensor/gnss", number, source="last"))
            if number == 20:
                recorder.send_signal(signal.SIGTERM)
            time.sleep(0.02)
        assert recorder.wait(20 * PATIENCE) == 0
    assert len(payloads(tmp_path / "a.mcap", "sensor/gnss")) == 40


def test_a_zenoh_configuration_file_is_accepted(tmp_path):
    port = free_port()
    good = tmp_path / "bus.json5"
    listen = f'listen: {{endpoints: ["tcp/127.0.0.1:{port}"]}}'
    good.write_text(f'{{mode: "peer", scouting: {{multicast: {{enabled: false}}}}, {listen}}}')
    got = []
    with Bus(file=good, source="a") as a, Bus(port=port, source="b") as b:
        b.subscribe("observation/control", got.append)
        wait_for(lambda: b.peers() >= 1, what="the link")
        a.publish(sample.message("observation/control"))
        wait_for(lambda: len(got) == 1, what="the message")
    bad = tmp_path / "bad.json5"
    bad.write_text("{mode: ")
    for file, text in ((bad, "not a Zenoh configuration"), (tmp_path / "none", "no such Zenoh configuration file")):
        with pytest.raises(UserError, match=text):
            Bus(file=file)
    bad.write_text('{mode: "peer", listen: {endpoints: ["tcp/127.0.0.1:99999"]}}')
    with pytest.raises(UserError, match=r"bad\.json5: cannot open the bus: invalid port value$"):
        Bus(file=bad)


def test_a_platform_hears_only_itself():
    port, got = free_port(), []
    with Bus("one", port=port, source="a") as a, Bus("two", port=port, source="b") as b, Bus("one", port=port) as c:
        for bus in (b, c):
            bus.subscribe("sensor/gnss", lambda raw, bus=bus: got.append(bus.platform))
        wait_for(lambda: a.peers() == 2, what="links")
        wait_for_listener(a._session, a.key("sensor/gnss"))
        a.publish(sample.message("sensor/gnss"))
        wait_for(lambda: got, what="the message")
        time.sleep(0.1)
    assert got == ["one"]
    with pytest.raises(UserError, match="wanted a name without"):
        Bus("a/b", port=port)


def test_who_ends_waits_until_all_has_been_taken_that_was_said():
    """The last results of an adjuster were lost where a recorder was busy for a moment and said something meanwhile."""
    port, heard, spoken = free_port(), [], threading.Event()

    def take(raw: RawMessage) -> None:
        heard.append(raw.envelope.sequence)
        if len(heard) == 20:
            time.sleep(0.5)

    def raw(topic: str, bus: Bus, number: int) -> RawMessage:
        return RawMessage(topic, Envelope(number, bus.source, number, bus.start), bytes(500))

    with Bus(port=port, source="recorder") as recorder:
        recorder.subscribe("orientation/whole", take)

        def talk() -> None:
            for number in range(2000):
                recorder.publish_raw(raw("status/recorder", recorder, number))
                if spoken.wait(0.01):
                    return

        talking = threading.Thread(target=talk)
        with Bus(port=port, source="adjuster") as adjuster:
            adjuster.prepare(["orientation/whole"])
            adjuster.subscribe("status/recorder", lambda raw: None)
            wait_for(lambda: adjuster.peers() == 1, 10, "the recorder")
            talking.start()
            time.sleep(0.5)
            for number in range(400):
                adjuster.publish_raw(raw("orientation/whole", adjuster, number))
        found = len(heard)
        spoken.set()
        talking.join()
    assert found == 400
