"""What was missed on the way is asked for again: publishers keep the last minute."""

from __future__ import annotations

import threading
import time

import sample_messages as sample
import zenoh
from bus_rig import Rig, free_port, here, simulated_flight, wait_for

from triline.nodes import convert
from triline.nodes.bus.recall import Recall
from triline.nodes.bus.session import Bus
from triline.nodes.ordering import StreamCheck
from triline.nodes.player.player import play
from triline.nodes.recording.reader import RecordingReader
from triline.schemas import codec
from triline.schemas.envelope import Envelope, RawMessage, pack

TOPIC = "sensor/attitude"


def attitude(number: int) -> RawMessage:
    return RawMessage(TOPIC, Envelope(number * 5_000_000, "simulator", number, 7), codec.encode(sample.body(TOPIC)))


def test_missing_numbers_are_asked_for_and_come_once_in_order():
    port = free_port()
    with Bus(port=port, source="simulator") as speaker, Bus(port=port, source="navigator") as listener:
        wait_for(listener.peers, 20, "the link")
        for number in range(100):
            speaker.publish_raw(attitude(number))
        check: StreamCheck[RawMessage] = StreamCheck()
        recall = Recall(listener, [TOPIC, "sensor/lines/*", "status/*"], check)
        wait_for(lambda: len(listener.recall([TOPIC])) == 100, 20, "what the publisher keeps")

        def taken(*numbers: int) -> list[int]:
            raws = recall.complete([attitude(n) for n in numbers])
            return [a.envelope.sequence for r in raws for a in check.accept(r.topic, r.envelope, r)]

        assert taken(*range(30)) == list(range(30)) and recall.recalled == 0
        # 30 to 39 are missing; what comes after 41 has been said already
        assert taken(40, 41) == list(range(30, 100)) and recall.recalled == 68
        # and is still on its way
        assert taken(*range(42, 100)) == [] and check.counts[TOPIC].duplicates == 0 == check.counts[TOPIC].gaps
        # what nobody keeps stays missing, and is not asked for without an end
        assert taken(150) == [150] and check.counts[TOPIC].gaps == 50


def test_what_was_recalled_and_comes_all_the_same_is_taken_once_by_who_only_looks_on():
    port = free_port()
    with Bus(port=port, source="simulator") as speaker, Bus(port=port, source="recorder") as listener:
        wait_for(listener.peers, 20, "the link")
        for number in range(10):
            speaker.publish_raw(attitude(number))
        recall = Recall(listener, [TOPIC], StreamCheck())
        wait_for(lambda: len(listener.recall([TOPIC])) == 10, 20, "what the publisher keeps")
        assert len(recall.joined([attitude(0)])) == 10
        assert [raw.envelope.sequence for raw in recall.once([attitude(n) for n in range(1, 12)])] == [10, 11]


def test_a_publisher_that_does_not_answer_in_time_is_asked_again():
    port, held = free_port(), []

    def answer(query: zenoh.Query) -> None:
        if not held:  # as by a machine that does something else
            held.append(query)
        else:
            query.reply(speaker.key(TOPIC), attitude(3).data, attachment=pack(attitude(3).envelope))

    with Bus(port=port, source="simulator") as speaker, Bus(port=port, source="navigator") as listener:
        wait_for(listener.peers, 20, "the link")
        cache = speaker._session.declare_queryable(f"{speaker.key(TOPIC)}/@adv/**", answer)
        said: list[RawMessage] = []

        def asked() -> list[zenoh.Query]:
            said[:] = listener.recall([TOPIC], timeout_s=0.2)
            return held

        wait_for(asked, 20, "the first question")
        assert [raw.envelope.sequence for raw in said] == [3]
        held.clear()
        cache.undeclare()


def test_what_speaks_no_more_and_what_is_too_much_is_not_recalled():
    port = free_port()
    with Bus(port=port, source="navigator") as listener:
        with Bus(port=port, source="simulator") as speaker:
            wait_for(listener.peers, 20, "the link")
            speaker.publish_raw(attitude(0))
            speaker.publish_raw(RawMessage("sensor/lines/nadir", Envelope(0, "simulator", 0, 7), b"x"))
            speaker.publish_raw(RawMessage("status/simulator", Envelope(0, "simulator", 0, 7), b"x"))
            wait_for(lambda: listener.recall([TOPIC]), 20, "what the publisher keeps")
            said = listener.recall([TOPIC, "sensor/lines/*", "status/*", "configuration/project"])
            assert [(raw.topic, raw.envelope.sequence) for raw in said] == [(TOPIC, 0)]
            speaker.publish(sample.message("sensor/gnss"))
            wait_for(lambda: listener.recall(["sensor/gnss"]), 20, "what the publisher keeps")
            assert speaker.recall(["sensor/gnss"]) == []  # nobody asks for what he has said himself
        assert listener.recall([TOPIC]) == []


def test_a_flight_whose_recorder_and_adjuster_were_killed_is_whole(tmp_path):
    """The flight goes on by parts, so that it is not over before the nodes are killed on a busy machine."""
    recorded = RecordingReader(simulated_flight(12, 100))
    said = allowed = 0

    def hold() -> float:
        nonlocal said
        begun = time.monotonic()
        while said >= allowed:
            time.sleep(0.01)
        said += 1
        return time.monotonic() - begun

    def go_on_to(share: float) -> None:
        nonlocal allowed
        allowed = round(share * len(recorded.index))

    with Rig(tmp_path) as rig, Bus(port=rig.port, source="listener") as bus:
        nodes = {name: rig.start("node", name) for name in ("navigator", "adjuster")}
        nodes["recorder"] = rig.start("node", "recorder", "-o", tmp_path / "live.mcap")
        wait_for(lambda: bus.alive() >= set(nodes), 40, "the nodes")
        starts: list[int] = []
        bus.subscribe("orientation/live", lambda raw: starts.append(raw.envelope.start))
        options = {"rate": 3.0, "start": bus.start + 1, "hold": hold}
        arguments = (recorded, bus.publish_raw, threading.Event())
        flying = threading.Thread(target=play, args=arguments, kwargs=options, daemon=True)
        flying.start()
        go_on_to(0.5)
        wait_for(lambda: len(starts) > 20, 60, "live orientation")
        for name, share in (("recorder", 0.55), ("adjuster", 0.6)):
            nodes[name].kill()
            nodes[name].wait()
            go_on_to(share)  # what is said meanwhile is missed
            wait_for(lambda: said == allowed, 60, "the next part of the flight")
            more = ["-o", tmp_path / "live.mcap"] if name == "recorder" else []
            nodes[name] = rig.start("node", name, *more)
            wait_for(lambda name=name: name in bus.alive(), 40, name)
            if name == "recorder":  # it says how far the adjuster was heard
                wait_for(lambda: bus.query("heard", "observation/progress", source="adjuster"), 40, "the recorder")
        go_on_to(1.0)
        flying.join()
        wait_for(lambda: len(set(starts)) == 2, 40, "the adjuster that took over")
        time.sleep(2.5)
        stopped = [rig.stop(nodes[name]) for name in ("navigator", "adjuster", "recorder")]
        assert stopped == [0, 0, 0], rig.log("adjuster")
        assert "begins with" in rig.log("adjuster") and "; 0 missing" in rig.log("recorder")
    assert here("process", simulated_flight(12, 100), "-o", tmp_path / "processed.mcap", "--processes", 1) == 0
    here("recover", tmp_path / "live.mcap", "-o", tmp_path / "first.mcap")
    parts = [RecordingReader(tmp_path / name) for name in ("first.mcap", "live_0001.mcap")]
    numbers = {raw.envelope.sequence for reader in parts for raw in reader.raws(reader.select([TOPIC]))}
    assert numbers == set(range(len(numbers)))  # every attitude is in one of them
    told = {(raw.topic, *raw.envelope): raw for reader in parts for raw in results(reader)}
    final = [time_of(raw) for raw in told.values() if raw.topic == "orientation/final"]
    whole = RecordingReader(tmp_path / "processed.mcap").messages(["orientation/final"])
    assert sorted(final) == sorted(convert.time_ns(message.body.timestamp) for message in whole)
    live: dict[int, list[int]] = {}
    for raw in told.values():
        if raw.topic == "orientation/live":
            live.setdefault(raw.envelope.start, []).append(time_of(raw))
    before, after = (live[start] for start in sorted(live))
    assert max(before) < min(after)  # the second goes on where the first was heard last


def results(reader: RecordingReader):
    return reader.raws(reader.select(["orientation/live", "orientation/final"]))


def time_of(raw: RawMessage) -> int:
    return convert.time_ns(codec.decode(raw.topic, raw.data).timestamp)
