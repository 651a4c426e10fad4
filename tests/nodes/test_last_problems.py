"""Each counter of bad input shows its own last problem, whatever other kinds came with it."""

from __future__ import annotations

import json

import pytest
import sample_messages as sample
from places import ROOT
from recording_file import write_recording

from triline.nodes.bus.status import StatusPublisher
from triline.nodes.cli import main
from triline.nodes.cli.live_flight import failed_nodes
from triline.nodes.last_problems import LONGEST_PROBLEM, in_words, last_of
from triline.nodes.monitor.monitor import Overview
from triline.nodes.navigator.navigator import Navigator
from triline.nodes.node import Message
from triline.nodes.recording.reader import RecordingReader
from triline.nodes.recording.summary import findings
from triline.nodes.report.analysis import analyse
from triline.nodes.report.page import page
from triline.nodes.report.source import read
from triline.schemas import codec
from triline.schemas import messages as m

LATE, CUT = "sensor/gnss 7 came 1.250 s behind", "sensor/gnss 9 of 'gnss': latitude is not finite"


class Heard:
    """A bus on which a node says what it has to say of itself."""

    start, platform, opened_anew = 1, "demo", ("the link was frozen for 6 s",)

    def __init__(self) -> None:
        self.said = []

    def subscribe(self, topic, hear) -> None:
        pass

    def publish(self, message) -> None:
        self.said.append(codec.decode(message.topic, codec.encode(message.body)))


@pytest.fixture
def status():
    """What a node says of itself that met two kinds of bad input."""
    node, bus = Navigator(), Heard()
    for kind, text in (
        ("malformed", "sensor/gnss 3"),
        ("late", LATE),
        ("malformed", CUT),
        ("failed", "imu 4: IndexError"),
    ):
        node.problem(kind, text)
    node.counters["attitude frozen"] += 1
    StatusPublisher(bus, "navigator").publish("running", {}, node, 0.0, 0, 0)
    return bus.said[-1]


def older(status):
    """The same of a version that told one for all counters."""
    body = m.NodeStatus()
    body.CopyFrom(status)
    for counter in body.counters:
        counter.ClearField("last_problem")
    return body


OWN = {
    "failed": "imu 4: IndexError", "late": LATE, "malformed": CUT,
    "session opened anew": "the session was opened anew: the link was frozen for 6 s",
}  # fmt: skip


def test_a_status_tells_the_last_problem_of_each_counter(status):
    assert {c.name: c.last_problem for c in status.counters} == OWN | {"attitude frozen": ""}
    assert status.last_problem == "imu 4: IndexError"
    assert {c.name: last_of(status, c) for c in status.counters} == OWN | {"attitude frozen": ""}
    assert {last_of(older(status), c) for c in older(status).counters} == {"imu 4: IndexError"}


def test_a_failed_node_is_told_with_its_failure_whatever_came_after(status):
    status.last_problem = CUT
    assert failed_nodes({"navigator": status})["navigator"].endswith("its last problem: imu 4: IndexError")


def test_the_monitor_tells_programs_each(status):
    overview = Overview()
    overview.take_status("navigator", status)
    assert overview.as_json()["nodes"]["navigator"]["last_problems"] == OWN


@pytest.mark.parametrize("version", ["this", "older"])
def test_a_report_shows_each(status, version, tmp_path, monkeypatch):
    monkeypatch.setattr("triline.nodes.report.page.drawing", lambda figure: "<svg></svg>" if figure else None)
    said = status if version == "this" else older(status)
    flight, held = read(
        write_recording(tmp_path / "a.mcap", [Message("status/navigator", sample.EPOCH_NS, said, "n", 0)])
    )
    result = analyse(flight, held)
    row = page(flight, result).partition("Nodes, newest status")[2]
    if version == "this":
        assert result["nodes"]["navigator"]["last_problems"] == OWN
        assert f"late: {LATE}<br>" in row and "malformed: sensor/gnss 9 of &#39;gnss&#39;: latitude is not" in row
    else:
        assert result["nodes"]["navigator"]["last_problems"] == {}
        assert "imu 4: IndexError</td>" in row and f"late: {LATE}" not in row


def test_in_words_a_kind_is_named_where_there_are_several():
    assert in_words({"late": 2}, {"late": LATE}) == f"the last: {LATE}"
    assert in_words({"late": 2, "malformed": 1}, {"late": LATE}) == f"the last late: {LATE}"
    assert in_words({"late": 2, "gaps": 0}, {"late": LATE, "gaps": "gone"}) == f"the last: {LATE}"
    assert in_words({"late": 2}, {}) == in_words({}, {}) == ""


def test_what_is_kept_of_a_problem_is_bounded():
    node = Navigator()
    for number in range(3):
        node.problem("malformed", f"{number}" * 10 * LONGEST_PROBLEM)
    assert list(node.last_problems) == ["malformed"] and len(node.last_problem) == LONGEST_PROBLEM


@pytest.fixture
def twice_and_cut(tmp_path):
    """A strip in which a fix comes twice, after one that holds no latitude; and one that goes back in time."""
    messages, fixes = [], 0
    for message in RecordingReader(ROOT / "recordings" / "strip.mcap").sorted_messages():
        if message.topic == "sensor/gnss":
            fixes += 1
            if fixes == 20:
                message.stamp_ns -= 2_000_000_000
            if fixes == 40:
                messages.append(message)
        messages.append(message)
    return write_recording(tmp_path / "two.mcap", messages)


def test_process_and_check_name_the_kind_of_each(twice_and_cut, tmp_path, capsys):
    words = ["process", str(twice_and_cut), "-o", str(tmp_path / "out.mcap"), "--nodes", "navigator"]
    assert main([*words, "-q"]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert (
        "left out: 1 duplicate, 1 malformed; the last duplicate: sensor/gnss 39 of 'simulator' came twice; "
        "the last malformed: sensor/gnss 19 of 'simulator': time goes back by 1.8 s"
    ) in said
    found = findings(RecordingReader(twice_and_cut))
    assert any(
        "for their stamps or numbers; the last: sensor/gnss 19 of 'simulator': time goes back" in x for x in found
    )


def test_process_tells_programs_each_of_a_node(monkeypatch, tmp_path, capsys):
    step = Navigator.step

    def refuse(self, message):
        if message.topic == "sensor/gnss":
            self.problem("late" if message.sequence % 2 else "malformed", f"fix {message.sequence}")
        return step(self, message)

    monkeypatch.setattr(Navigator, "step", refuse)
    strip = ROOT / "recordings" / "strip.mcap"
    words = ["process", str(strip), "-o", str(tmp_path / "out.mcap"), "--nodes", "navigator"]
    assert main([*words, "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["problems_by_kind"] == {"navigator": {"late": "fix 165", "malformed": "fix 164"}}
    assert result["problems"] == {"navigator": "fix 165"}
    assert main(words) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "navigator: 83 late, 83 malformed; the last late: fix 165; the last malformed: fix 164" in said
