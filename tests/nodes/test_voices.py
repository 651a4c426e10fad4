"""One voice a topic: who spoke first is heard, others are named and not used, until an operator says so."""

from __future__ import annotations

import copy
import functools
from collections.abc import Callable, Iterable
from pathlib import Path

import sample_messages as sample

from triline.nodes.adjuster.adjuster import Adjuster
from triline.nodes.navigator.navigator import Navigator
from triline.nodes.node import Message, Node
from triline.nodes.recording.reader import RecordingReader
from triline.nodes.recording.runner import process
from triline.nodes.step_driver import StepDriver
from triline.nodes.voices import AGAIN_S, ALARM_S
from triline.schemas import codec
from triline.schemas import messages as m
from triline.schemas.envelope import RawMessage

SECOND = 1_000_000_000


class Witness(Node):
    """Keeps what it is given."""

    name = "witness"
    inputs = ("configuration/project", "configuration/camera", "sensor/gnss", "sensor/attitude", "observation/control")
    outputs = ("event/log",)

    def __init__(self) -> None:
        super().__init__()
        self.given: list[Message] = []

    def step(self, message):
        self.given.append(message)
        return ()


class Rig:
    def __init__(self) -> None:
        self.node = Witness()
        self.driver = StepDriver(self.node)

    def hear(self, topic: str, seconds: float, source: str = "a", start: int = 1, body=None) -> list[str]:
        """Lines of the event log that follow from a message."""
        stamp = sample.EPOCH_NS + round(seconds * SECOND)
        message = Message(topic, stamp, sample.body(topic) if body is None else body, source, 0, start)
        return [out.body.message for out in self.driver.step(message)]

    def count(self, topic: str, source: str = "") -> int:
        return sum(g.topic == topic and source in ("", g.source) for g in self.node.given)

    def verdict(self, seconds: float, topic: str, source: str = "", accepted: bool = True) -> list[str]:
        body = m.Verdict(topic=topic, publisher=source, accepted=accepted, by="Ann")
        return self.hear("observation/verdict", seconds, "surveyor", body=body)


def test_a_second_source_of_a_sensor_is_named_once_in_a_while_and_not_used():
    rig, told = Rig(), []
    for i in range(200):
        assert rig.hear("sensor/gnss", 0.2 * i) == []
        told += rig.hear("sensor/gnss", 0.2 * i + 0.01, "intruder")
    assert rig.count("sensor/gnss", "a") == 200 and rig.count("sensor/gnss", "intruder") == 0
    assert "'intruder' and is not used: sensor/gnss belongs to 'a'" in told[0]
    assert len(told) == 40 // AGAIN_S  # and not two hundred times
    assert "intruder" in rig.node.alarm and rig.node.counters["not used"] == 200
    rig.hear("sensor/gnss", 40 + ALARM_S)
    assert rig.node.alarm == ""


def test_an_operator_chooses_the_source():
    rig = Rig()
    rig.hear("sensor/gnss", 0)
    rig.hear("sensor/gnss", 0.1, "b")
    assert rig.verdict(0.5, "sensor/gnss", "b") == ["sensor/gnss of 'b' is used from now on (Ann)"]
    assert rig.node.alarm == ""
    rig.hear("sensor/gnss", 1.0, "b")
    assert "an operator chose" not in rig.hear("sensor/gnss", 1.1, "a")[0]
    assert rig.count("sensor/gnss", "b") == 1 and rig.count("sensor/gnss", "a") == 1
    # and a verdict against it leaves things as they are
    assert rig.verdict(2.0, "sensor/gnss", accepted=False) == ["sensor/gnss of 'a' stays refused (Ann)"]
    rig.hear("sensor/gnss", 3.0, "a")
    assert rig.count("sensor/gnss", "a") == 1
    assert rig.verdict(4.0, "sensor/attitude") == []  # a node that does not hear the topic knows nothing of it
    rig.hear("sensor/attitude", 5.0)
    assert rig.verdict(6.0, "sensor/attitude") == ["sensor/attitude: nothing waits for a decision"]


def test_a_program_that_was_started_again_takes_over_and_one_beside_it_does_not():
    rig = Rig()
    for i in range(10):
        rig.hear("sensor/gnss", 0.2 * i, start=1)
    assert rig.hear("sensor/gnss", 1.9, start=2) == []  # the first may have ended
    rig.hear("sensor/gnss", 2.0, start=1)
    assert "two programs speak as 'a'" in rig.hear("sensor/gnss", 2.1, start=2)[0]
    for i in range(11, 20):
        rig.hear("sensor/gnss", 0.2 * i, start=1)
    assert rig.count("sensor/gnss") == 20
    for i in range(10):  # the first is silent since 3.8 s
        rig.hear("sensor/gnss", 5.0 + 0.2 * i, start=2)
    assert rig.count("sensor/gnss") == 30
    rig.hear("sensor/gnss", 7.0, start=1)  # the first one again
    assert rig.count("sensor/gnss") == 30


def test_a_program_that_was_started_again_and_says_all_once_more_is_no_second_one():
    """Its operator was told to stop one of them: there is but one."""
    rig = Rig()
    for i in range(100):
        rig.hear("sensor/lines/N", 0.1 * i, start=1)
    told = [text for i in range(120) for text in rig.hear("sensor/lines/N", 0.1 * i, start=2)]
    assert told == [] and rig.node.alarm == ""
    assert [given.start for given in rig.node.given].count(2) > 110


def test_the_same_flight_played_once_more_beside_itself_is_not_used_and_after_it_is():
    rig = Rig()
    for i in range(2000):  # 10 s of both, the second from the start of the flight
        rig.hear("sensor/attitude", 30.0 + 0.005 * i)
        rig.hear("sensor/attitude", 0.005 * i, start=2)
    assert rig.count("sensor/attitude") == 2000 and all(given.start == 1 for given in rig.node.given)
    assert "two programs speak as 'a'" in rig.node.alarm
    for i in range(2000, 3000):  # the first has ended
        rig.hear("sensor/attitude", 0.005 * i, start=2)
    later = [given for given in rig.node.given if given.start == 2]
    assert 880 <= len(later) <= 900  # half a second passes until it is believed
    assert rig.node.alarm == ""


def test_another_camera_before_the_flight_is_taken_and_in_flight_only_on_the_operators_word():
    camera = sample.body("configuration/camera")
    better, forged = copy.deepcopy(camera), copy.deepcopy(camera)
    better.lenses[0].focal_length_mm, forged.lenses[0].focal_length_mm = 62.8, 65.8
    rig = Rig()
    rig.hear("configuration/camera", 0, body=camera)
    assert rig.hear("configuration/camera", 1, body=better) == []  # on the ground
    rig.hear("sensor/attitude", 2)
    assert rig.hear("configuration/camera", 3, body=better) == []  # the same again is no change
    told = rig.hear("configuration/camera", 4, body=forged)
    assert "is another one than the flight began with and is not used" in told[0]
    assert "triline confirm configuration/camera" in rig.node.alarm
    rig.hear("sensor/attitude", 4 + 2 * ALARM_S)
    assert rig.node.alarm  # until somebody decides
    given = [g.body.lenses[0].focal_length_mm for g in rig.node.given if g.topic == "configuration/camera"]
    assert 65.8 not in given
    rig.verdict(5 + 2 * ALARM_S, "configuration/camera")
    assert rig.node.given[-1].body == forged and rig.node.alarm == ""


def test_an_intruders_camera_is_refused_before_and_in_flight():
    camera = sample.body("configuration/camera")
    forged = copy.deepcopy(camera)
    forged.lenses[0].focal_length_mm = 65.8
    rig = Rig()
    rig.hear("configuration/camera", 0, body=camera)
    assert "belongs to 'a'" in rig.hear("configuration/camera", 1, "b", body=forged)[0]
    assert rig.hear("configuration/camera", 1, "b", body=camera) == []  # saying the same is all right
    rig.hear("sensor/attitude", 2)
    rig.hear("configuration/camera", 3, "b", body=forged)
    assert forged not in [g.body for g in rig.node.given]


def test_control_of_a_point_belongs_to_who_stated_it_and_others_may_state_more_points():
    one, other, more = (sample.body("observation/control", i) for i in (0, 0, 1))
    other.z += 5.0
    rig = Rig()
    rig.hear("observation/control", 0, body=one)
    assert "of G0 also comes from 'b'" in rig.hear("observation/control", 1, "b", body=other)[0]
    assert rig.hear("observation/control", 1, "b", body=more) == []
    assert [g.body for g in rig.node.given] == [one, more]
    rig.hear("observation/control", 2, body=other)  # its owner may correct it
    assert rig.node.given[-1].body == other


# ---- through the nodes of a flight


@functools.cache
def _navigated() -> tuple[RawMessage, ...]:
    """What an adjuster hears of the first part of a flight, until its 60th tie point."""
    out: list[RawMessage] = []
    path = Path(__file__).parents[2] / "recordings" / "strip.mcap"
    process(RecordingReader(path), [Navigator(filtered_s=0.1)], out.append)
    ties = [i for i, raw in enumerate(out) if raw.topic == "observation/tie"]
    return tuple(raw for raw in out[: ties[60]] if raw.topic in Adjuster.inputs)


def _adjusted(forge: Callable[[Message], Iterable[Message]]) -> tuple[Adjuster, list[Message]]:
    """An adjuster after a part of a flight, with messages of ``forge`` before its 20th tie point."""
    node = Adjuster(pace="normal", update_s=1.0, update_rays=1000)
    driver, ties = StepDriver(node), 0
    out: list[Message] = []
    for raw in _navigated():
        e = raw.envelope
        message = Message(raw.topic, e.stamp_ns, codec.decode(raw.topic, raw.data), e.source, e.sequence)
        ties += raw.topic == "observation/tie"
        if ties == 20 and raw.topic == "observation/tie":
            for forged in forge(message):
                out += driver.step(forged)
        out += driver.step(message)
    return node, out + driver.finish()


def _first(topic: str) -> Message:
    raw = next(raw for raw in _navigated() if raw.topic == topic)
    return Message(topic, 0, codec.decode(topic, raw.data), raw.envelope.source)


def _finals(out: list[Message]) -> list[bytes]:
    return [o.body.SerializeToString(deterministic=True) for o in out if o.topic == "orientation/final"]


def _events(out: list[Message]) -> str:
    return "\n".join(o.body.message for o in out if o.topic == "event/log")


def test_a_forged_camera_project_or_control_in_flight_changes_no_orientation_and_is_an_alarm():
    camera, project, control = map(_first, ("configuration/camera", "configuration/project", "observation/control"))

    def forge(message: Message) -> Iterable[Message]:
        for source in (camera.source, "intruder"):
            longer, turned = copy.deepcopy(camera.body), copy.deepcopy(project.body)
            for lens in longer.lenses:
                lens.focal_length_mm *= 1.05
            turned.boresight_deg[:] = [0.5, 0.0, 0.0]
            yield Message("configuration/camera", message.stamp_ns, longer, source, 7)
            yield Message("configuration/project", message.stamp_ns, turned, source, 7)
        moved = copy.deepcopy(control.body)
        moved.x += 10.0
        yield Message("observation/control", message.stamp_ns, moved, "intruder", 7)

    node, clean = _adjusted(lambda message: ())
    assert len(_finals(clean)) > 20 and not node.alarm
    node, attacked = _adjusted(forge)
    assert _finals(attacked) == _finals(clean)
    assert "configuration/" in node.alarm
    for wanted in ("configuration/camera of", "configuration/project of", "also comes from 'intruder'"):
        assert wanted in _events(attacked)


def test_control_that_becomes_check_points_is_told_with_what_is_left():
    def forge(message: Message) -> Iterable[Message]:
        for raw in _navigated():
            if raw.topic == "observation/control":
                body = codec.decode(raw.topic, raw.data)
                body.role = type(body).Role.Value("CHECK")
                yield Message(raw.topic, message.stamp_ns, body, raw.envelope.source, raw.envelope.sequence + 100)

    _, out = _adjusted(forge)
    assert "control became check points in flight and counts no more: " in _events(out)
    assert "no control points left" in _events(out)
