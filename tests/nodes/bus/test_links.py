"""Links that are gone after a standstill: when a session is opened anew, and that nothing is missing after it."""

from __future__ import annotations

import signal
import threading
import time

import sample_messages as sample
from bus_rig import Rig, free_port, wait_for

from triline.nodes.bus import live, recall, session
from triline.nodes.bus.links import BEAT_S, LOOK_S, MISSED_S, REST_S, TOLD, LinkWatch
from triline.nodes.bus.live import BusRunner, in_thread
from triline.nodes.bus.session import Bus
from triline.nodes.node import Message, Node
from triline.schemas import codec

PEERS = frozenset("abcde")


def beats(watch: LinkWatch, begin: float, seconds: float, peers: frozenset[str] = PEERS) -> list[str]:
    """Reasons that the watch gives while time goes on without a standstill."""
    times = [begin + BEAT_S * i for i in range(round(seconds / BEAT_S))]
    return [why for t in times if (why := watch.beat(t, peers))]


def test_links_that_are_gone_after_a_standstill_open_the_session_anew():
    watch = LinkWatch()
    assert beats(watch, 0.0, 5.0) == []
    assert beats(watch, 9.6, 1.0) == []  # all links are there after 4.85 s
    why = watch.beat(10.6, PEERS - {"b"})
    assert why == "stood still for 4.8 s, 1 of 5 links are gone"
    watch.opened(10.7)
    assert beats(watch, 10.75, 60.0, frozenset("xyz")) == []  # others have new sessions, too


def test_peers_that_leave_without_a_standstill_or_long_after_it_do_not():
    watch = LinkWatch()
    assert beats(watch, 0.0, 5.0) == [] and beats(watch, 5.0, 5.0, frozenset("ab")) == []
    assert beats(watch, 15.0, LOOK_S + 1.0, frozenset("ab")) == []
    assert beats(watch, 26.0, 5.0, frozenset("a")) == []


def test_what_others_receive_and_this_node_does_not_opens_the_session_anew():
    watch = LinkWatch()
    for i in range(20):
        watch.heard("sensor/imu", 0.25 * i)
        assert watch.beat(0.25 * i, PEERS) == ""
    found = []
    for i in range(20, 60):
        t = 0.25 * i
        watch.told("sensor/imu", t)
        watch.told("sensor/gnss", t)  # never heard here: no input of this node
        found += [(t, why)] if (why := watch.beat(t, PEERS)) else []
    assert found[0][0] - 4.75 > MISSED_S and found[0][0] - 4.75 < MISSED_S + 1.0
    assert found[0][1].startswith("sensor/imu is received by others and not here for 3.")
    watch.opened(20.0)
    for i in range(80, 80 + round(REST_S / 0.25) - 2):  # time to be heard again
        watch.told("sensor/imu", 0.25 * i)
        assert watch.beat(0.25 * i, PEERS) == ""


def test_a_publisher_that_has_ended_is_not_missed():
    watch = LinkWatch()
    watch.heard("sensor/imu", 0.0)
    for i in range(TOLD - 1):  # what others had received last is told after the end
        watch.told("sensor/imu", 0.5 * i)
    assert beats(watch, 0.0, 60.0) == []


def test_a_topic_that_a_node_has_ended_is_not_missed():
    watch = LinkWatch()
    for topic in ("sensor/lines/F", "sensor/lines/B", "sensor/gnss"):
        watch.heard(topic, 0.0)
    watch.unwanted("sensor/lines/*")
    watch.unwanted("sensor/gnss")
    watch.heard("sensor/gnss", 0.1)  # by another part of this node
    for i in range(40):
        for topic in ("sensor/lines/F", "sensor/lines/B"):
            watch.told(topic, 0.25 * i)
        watch.heard("sensor/gnss", 0.25 * i)
        assert watch.beat(0.25 * i, PEERS) == ""
    found = []
    for i in range(40, 60):
        watch.told("sensor/gnss", 0.25 * i)
        found.append(watch.beat(0.25 * i, PEERS))
    assert found[-1].startswith("sensor/gnss is received by others and not here")


def test_who_has_ended_a_subscription_goes_on_with_its_session():
    port = free_port()
    with Bus(port=port, source="test") as bus, Bus(port=port, source="sender") as sender:
        heard: list[object] = []
        end = bus.subscribe("sensor/attitude", heard.append)
        wait_for(lambda: bus.peers() == 1, 10, "the link")
        wait_for(lambda: sender.publish(sample.message("sensor/attitude")) or heard, 10, "an attitude")
        end()
        assert not bus._links._heard_s
        sender.publish(sample.message("sensor/attitude", 1))
        time.sleep(0.3)
        assert not bus._links._heard_s


class Keeps(Node):
    name = "keeps"
    inputs = ("configuration/camera", "sensor/attitude", "trajectory/filtered")
    outputs = ("event/log",)

    def __init__(self) -> None:
        super().__init__()
        self.given: list[Message] = []

    def step(self, message):
        self.given.append(message)
        return ()

    def light(self):
        return "good", ""

    def query(self, name, parameters):
        return sample.message("orientation/final")


def identity(bus: Bus) -> str:
    return str(bus._session.info.zid())


def linked_with(bus: Bus) -> list[str]:
    return [str(peer) for peer in bus._session.info.peers_zid()]


def test_a_session_that_was_opened_anew_misses_nothing_that_was_declared():
    port, node = free_port(), Keeps()
    with (
        Bus(port=port, source="chain") as bus,
        Bus(port=port, source="test") as sender,
        in_thread(BusRunner(node, bus)),
    ):
        wait_for(lambda: sender.alive() == {"keeps"}, 10, "the node")
        sender.publish(sample.message("configuration/camera"))
        wait_for(lambda: len(node.given) == 1, 10, "the camera")
        bus._open_anew("a test")
        sender._open_anew("a test")
        # the sessions of before answer, too, as long as they are linked
        wait_for(lambda: linked_with(sender) == [identity(bus)], 10, "the link of the new sessions")
        wait_for(lambda: linked_with(bus) == [identity(sender)], 10, "the link of the new sessions")
        wait_for(lambda: sender.alive() == {"keeps"}, 10, "the node, again")
        assert len(sender.query("orientation", "orientation/final", t=1)) == 1
        for i in range(20):
            sender.publish(sample.message("sensor/attitude", i))
        wait_for(lambda: len(node.given) == 21, 10, "attitudes")
        late = Keeps()
        with Bus(port=port, source="late") as third, in_thread(BusRunner(late, third)):
            wait_for(lambda: late.given, 10, "the camera of before")
        wait_for(lambda: bus.peers() == 1, 10, "the end of the other sessions")
    assert [message.topic for message in node.given[:2]] == ["configuration/camera", "sensor/attitude"]
    assert late.given[0].topic == "configuration/camera"
    assert node.counters["session opened anew"] == 1


def test_a_node_whose_question_for_the_configuration_was_lost_asks_again(monkeypatch):
    """On a busy machine the answer that a subscriber waits for once can come too late: it must not be mute for ever."""

    def without_history(session, key, handler, history):
        return session.declare_subscriber(key, handler)

    monkeypatch.setattr(session.zenoh.ext, "declare_advanced_subscriber", without_history)
    monkeypatch.setattr(recall, "CONFIGURATION_AGAIN_S", 0.5)
    for at_once in (True, False):  # what is said before the node begins, and after that where nobody hears it
        port, node = free_port(), Keeps()
        with Bus(port=port, source="test") as sender:
            if at_once:
                sender.publish(sample.message("configuration/camera"))
            with Bus(port=port, source="chain") as bus, in_thread(BusRunner(node, bus)):
                wait_for(lambda sender=sender: sender.alive() == {"keeps"}, 10, "the node")
                if not at_once:
                    wait_for(lambda bus=bus: bus.peers() == 1, 10, "the link")
                    bus._generation += 1  # nothing that comes by itself is handed on
                    sender.publish(sample.message("configuration/camera"))
                wait_for(lambda node=node: node.given, 10, "the camera")
                time.sleep(1.2)  # it is asked for no more
        assert [message.topic for message in node.given] == ["configuration/camera"]


def test_a_session_that_takes_long_to_close_does_not_stop_the_watch(monkeypatch):
    """What waits to be sent over a link that is gone can hold it for minutes; meanwhile the new session is watched."""
    closed, reasons = threading.Event(), ["one", "another"]
    withdraw = session._withdraw
    monkeypatch.setattr(session, "_withdraw", lambda old, declared: (closed.wait(60), withdraw(old, declared)))
    with Bus(port=free_port()) as bus:
        monkeypatch.setattr(bus._links, "beat", lambda now_s, peers: reasons.pop(0) if reasons else "")
        wait_for(lambda: bus.opened_anew == ["one", "another"], 10, "the second session")
        closed.set()


def test_a_node_that_was_stopped_for_longer_than_the_lease_hears_its_sensors_again(tmp_path):
    with Rig(tmp_path) as rig, Bus(port=rig.port, source="sender") as bus:
        received, sent = [0], [0]

        def take(raw) -> None:
            for row in codec.decode(raw.topic, raw.data).topics:
                received[0] = row.received if row.topic == "sensor/attitude" else received[0]

        navigator = rig.start("node", "navigator")
        bus.subscribe("status/navigator", take)
        wait_for(lambda: "navigator" in bus.alive(), 30, "the navigator")
        stop = threading.Event()

        def publish() -> None:
            while not stop.wait(0.02):
                sent[0] += 1
                bus.publish(sample.message("sensor/attitude", 4 * sent[0]))

        publishing = threading.Thread(target=publish, daemon=True)
        publishing.start()
        wait_for(lambda: received[0] > 20, 20, "the first attitudes")
        navigator.send_signal(signal.SIGSTOP)
        time.sleep(4.7)
        navigator.send_signal(signal.SIGCONT)
        before = sent[0]  # more than this cannot have been on its way
        wait_for(lambda: received[0] > before + 20, 20, "attitudes after the standstill")
        stop.set()
        publishing.join()


def test_a_trajectory_that_falls_silent_while_a_strip_is_flown_turns_the_light_to_failed(monkeypatch):
    monkeypatch.setattr(live, "QUIET_S", 0.5)
    port, node, told = free_port(), Keeps(), []
    strip = sample.body("configuration/strip")
    strip.ended = False
    with Bus(port=port, source="chain") as bus, Bus(port=port, source="test") as sender:
        sender.subscribe("status/keeps", lambda raw: told.append(codec.decode(raw.topic, raw.data)))
        node.inputs = (*Keeps.inputs, "configuration/strip")
        with in_thread(BusRunner(node, bus)):
            wait_for(lambda: sender.alive() == {"keeps"}, 10, "the node")
            sender.publish(Message("configuration/strip", sample.EPOCH_NS, strip, "test"))
            sender.publish(sample.message("trajectory/filtered"))
            wait_for(lambda: told and told[-1].light == "failed", 10, "the light")
            assert told[-1].light_reason.startswith("no trajectory for ")
            strip.ended = True
            sender.publish(Message("configuration/strip", sample.EPOCH_NS + 10**9, strip, "test"))
            wait_for(lambda: told[-1].light == "good" and not told[-1].alarm, 10, "the end of the strip")


def test_after_a_strip_nobody_misses_its_orientation():
    """Between strips the flight goes on without orientation, and without GNSS it is an alarm all the same."""
    runner, now = object.__new__(BusRunner), time.monotonic()
    runner._heard_s = {"trajectory/filtered": now, "orientation/live": now - 10.2, "sensor/gnss": now - 10.2}
    runner._open_strip = False
    assert runner._silence() == "no sensor/gnss for 10 s"
    runner._open_strip = True
    assert runner._silence() == "no orientation/live for 10 s, no sensor/gnss for 10 s"
