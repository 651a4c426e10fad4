"""What a live flight says at its end, and that it comes there."""

from __future__ import annotations

import argparse
import errno
import io
import shlex
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import pytest

from triline.nodes.cli import main
from triline.nodes.cli.bus_options import reporter
from triline.nodes.cli.demo import Demo
from triline.nodes.cli.live_flight import LiveFlight, failed_nodes, not_recorded
from triline.nodes.monitor.monitor import ENDING, Overview, display
from triline.schemas import messages as m

RESULT = {"lost": {}, "waited_s": 0.0}


def demo(folder: Path, quiet: bool = True) -> Demo:
    options = {"no_images": False, "seed": 1, "secure": None, "web": False, "headless": True}
    return Demo(argparse.Namespace(output=folder, quiet=quiet, json=False, **options))


def test_commands_at_the_end_of_a_flight_can_be_pasted(tmp_path):
    folder = tmp_path / "two words"
    said = demo(folder).summary({**RESULT, "recordings": [str(folder / "flight.mcap")]}).splitlines()
    (again,) = (line for line in said if line.startswith("again"))
    words = shlex.split(again.removeprefix("again"))
    assert words[:5] == ["triline", "process", f"{folder}/flight.mcap", "-o", f"{folder}/processed.mcap"]
    (replay,) = (line for line in said if line.startswith("replay it"))
    assert shlex.split(replay.removeprefix("replay it"))[-1] == f"{folder}/flight.mcap"
    assert not any("largest" in line for line in said)


def test_a_flight_in_several_recordings_names_those_that_its_page_leaves_out(tmp_path):
    """The recorder was killed and started again, and wrote a file of its own from then on."""
    recordings = [str(tmp_path / name) for name in ("flight.mcap", "flight-2.mcap")]
    said = demo(tmp_path).summary({**RESULT, "recordings": recordings})
    assert f"of the largest recording alone; another part of the flight: {recordings[1]}\n" in said
    (join,) = (line for line in said.splitlines() if line.startswith("join them"))
    words = shlex.split(join.removeprefix("join them"))
    assert words == ["triline", "recover", *recordings, "-o", str(tmp_path / "whole.mcap")]


def test_what_was_not_recorded_is_told_at_the_end(tmp_path, monkeypatch):
    """The folder was deleted in flight: the page was of what came later, and nothing said so."""
    status, flight = m.NodeStatus(node="recorder", last_problem="recording again"), demo(tmp_path)
    assert not_recorded(None) == not_recorded(status) == (0, "")
    why = f"{tmp_path}/flight.mcap: was deleted while it was written"
    status.counters.add(name="disk", value=1, last_problem=why)
    status.counters.add(name="lost", value=10225)
    flight._not_recorded = not_recorded(status)
    (tmp_path / "flight_0001.mcap").write_text("no recording")
    result = {**LiveFlight._evaluate(flight), "waited_s": 0.0}
    assert result["not_recorded"] == 10225
    assert f"\nNOT RECORDED: 10225 messages: {why}\n" in flight.summary(result)


def test_nodes_that_end_are_named_in_flight_and_at_its_end(tmp_path, monkeypatch, capsys):
    flight, started = demo(tmp_path, quiet=False), []
    flight.viewer_mode = "rrd:flight.rrd"
    nodes = {n: SimpleNamespace(name=n, last_line=lambda: "killed by SIGKILL") for n in ("recorder", "viewer")}
    dead = [list(nodes.values())]
    group = SimpleNamespace(
        processes=nodes, dead=lambda: dead.pop(), start=lambda name, *words: started.append((name, *words))
    )
    monkeypatch.setattr(flight, "over", lambda group: not dead)
    flight._watch(group, None, lambda: None)
    assert started == [("recorder", "-o", str(tmp_path / "flight-1.mcap"))] and list(nodes) == ["recorder"]
    told = "recorder has ended: killed by SIGKILL; it is started again\nviewer has ended: killed by SIGKILL; nothing"
    assert capsys.readouterr().out.startswith(told)
    said = flight.summary({**RESULT, "recordings": [], "restarted": {"recorder": 1, "adjuster": 2}})
    assert "\nhad ended, and started again: recorder, adjuster 2 times\n" in said


def test_a_flight_whose_report_cannot_be_made_says_what_was_recorded(tmp_path):
    flight = demo(tmp_path)
    (tmp_path / "flight.mcap").write_text("no recording")
    result = LiveFlight._evaluate(flight)
    assert result["no_report"] == f"{tmp_path}/flight.mcap: not an MCAP recording"
    said = flight.summary({**result, "waited_s": 0.0})
    assert f"no report: {result['no_report']}\n" in said and f"recording  {tmp_path}/flight.mcap\n" in said
    assert "report     " not in said


def test_a_node_whose_work_failed_is_named_at_the_end(tmp_path):
    """An adjuster that failed at the end of a flight wrote no last orientations, and its log alone said so."""
    status = m.NodeStatus(node="adjuster", last_problem="the end: ValueError: by design (results.py:61)")
    status.counters.add(name="wander restated", value=19)
    statuses = {"adjuster": status, "matcher": m.NodeStatus(node="matcher")}
    assert failed_nodes(statuses | {"adjuster": m.NodeStatus()}) == {}
    status.counters.add(name="failed", value=1)
    failed = failed_nodes(statuses)
    assert list(failed) == ["adjuster"]
    said = demo(tmp_path).summary({**RESULT, "recordings": [], "failed": failed})
    assert "adjuster: failed once, its results are not complete; its last problem: the end: ValueError: by" in said


def test_a_file_is_neither_a_flight_nor_a_folder_of_results(tmp_path, capsys):
    file = tmp_path / "flight.mcap"
    file.write_text("mine")
    for words, said in (
        (["fly", str(file)], f"triline fly: {file}: is a file, wanted a folder with flight.toml\n"),
        (["fly", str(tmp_path / "a b")], f"no flight.toml; `triline new flight '{tmp_path}/a b'` writes one\n"),
        (["demo", "--headless", "-o", str(file)], f"triline demo: {file}: is a file, wanted a folder for the result\n"),
    ):
        assert main(words) == 1
        assert said in capsys.readouterr().err
    assert file.read_text() == "mine"


class Gone(io.StringIO):
    """A terminal that was closed, or a pipe whose reader has ended."""

    def __init__(self, terminal: bool) -> None:
        super().__init__()
        self.isatty = lambda: terminal

    def write(self, text: str) -> int:
        raise OSError(errno.EIO, "Input/output error") if self.isatty() else BrokenPipeError

    def flush(self) -> None:
        self.write("")


@pytest.mark.parametrize("terminal", [True, False])
def test_a_flight_lands_when_nobody_reads_any_more_what_it_says(tmp_path, monkeypatch, terminal):
    """Behind `| tee` Ctrl-C ended both programs, and in a closed terminal the flight ended as by a failure."""
    flight, out = demo(tmp_path, quiet=False), Gone(terminal)

    def fly_and_land():
        with display(Overview(), "flight") as show:
            show()
            flight.say(ENDING)
        return {"landed": True}

    monkeypatch.setattr(flight, "_fly", fly_and_land)
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setattr("sys.stdout", out)
    assert flight.fly() == {"landed": True} and sys.stdout is out


def test_a_node_goes_on_when_nobody_reads_any_more_what_it_says(monkeypatch):
    monkeypatch.setattr("sys.stderr", Gone(terminal=True))
    reporter(quiet=False)("recording to flight.mcap")


def test_a_node_that_stands_still_at_the_end_is_named(tmp_path, capsys):
    """A navigator that was frozen: the flight waited 45 s for it, and said neither that nor that it was killed."""
    flight, overview = demo(tmp_path, quiet=False), Overview()
    codes, why = {"navigator": -9, "adjuster": 0, "recorder": 0}, "killed by SIGKILL"
    nodes = {
        name: SimpleNamespace(name=name, running=False, stop=lambda *_, code=code: code, last_line=lambda: why)
        for name, code in codes.items()
    }
    group = SimpleNamespace(processes=nodes)
    for name in ("navigator", *["adjuster"] * 20):
        overview.take_status(name, m.NodeStatus(node=name))
    flight._overview = overview
    flight._land(group, overview, lambda: None)
    assert capsys.readouterr().out.splitlines() == [ENDING, "navigator is silent: it has 45 s to end"]
    (tmp_path / "flight.mcap").write_text("no recording")
    said = flight.summary({**LiveFlight._evaluate(flight), "waited_s": 0.0})
    assert "\nnavigator did not end by itself, and was killed by SIGKILL: what it held back is missing\n" in said


def test_a_node_is_stopped_when_it_has_worked_off_what_came_however_much_it_holds_back():
    """Lines that waited for a trajectory which had ended counted as work to do: every flight took ten seconds more."""
    told = [(100, 604), (180, 604), (180, 420), (180, 404), (180, 404), (180, 404), (180, 404)]  # received, queued
    overview = Overview()
    node = SimpleNamespace(name="matcher", running=True)

    def show():
        received, queued = told[overview.said["matcher"]]
        topics = [
            m.TopicStatistics(topic="trajectory/smoothed", received=received),
            m.TopicStatistics(topic="status/navigator", received=7 * overview.said["matcher"]),  # come for ever
        ]
        overview.take_status("matcher", m.NodeStatus(node="matcher", queued=queued, topics=topics))

    LiveFlight._wait_until_worked_off(node, overview, show, time.monotonic() + 60.0)
    assert overview.said["matcher"] == 5
    node.running = False  # it has died: nothing to wait for
    LiveFlight._wait_until_worked_off(node, overview, show, time.monotonic() + 60.0)
    assert overview.said["matcher"] == 5


def test_what_newer_messages_have_said_as_well_is_not_lost(tmp_path):
    flight, overview = demo(tmp_path), Overview()
    topics = [
        m.TopicStatistics(topic=topic, gaps=1)
        for topic in ("observation/progress", "status/matcher", "observation/tie", "sensor/lines/N")
    ]
    overview.take_status("adjuster", m.NodeStatus(node="adjuster", topics=topics))
    flight._overview = overview
    assert flight._lost_so_far(("gaps",)) == {"adjuster: observation/tie gaps": 1, "adjuster: sensor/lines/N gaps": 1}
