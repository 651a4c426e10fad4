"""What a terminal shows that is narrow, or on which nothing can be drawn over."""

from __future__ import annotations

import io
import sys

import pytest
from rich.console import Console

from triline.nodes.cli.adjust import _ProgressLines
from triline.nodes.cli.progress import progress
from triline.nodes.monitor.monitor import Overview, display, screen
from triline.nodes.terminal import redraws, width
from triline.schemas import messages as m
from triline.solver.adjustment.job import Phase


class _Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.mark.parametrize("term, over", [("xterm-256color", True), ("dumb", False)])
def test_a_dumb_terminal_gets_lines(monkeypatch, term, over):
    """The shell of an editor showed nothing of a flight but its end."""
    monkeypatch.setenv("TERM", term)
    assert redraws(_Terminal()) is over and not redraws(io.StringIO())
    out, err = _Terminal(), _Terminal()
    monkeypatch.setattr("sys.stdout", out)
    monkeypatch.setattr("sys.stderr", err)
    monkeypatch.setattr("time.monotonic", iter(range(0, 10_000, 6)).__next__)
    with display(Overview(), "platform demo") as show:
        show()
    assert ("nodes | lag" in out.getvalue()) is not over
    if not over:
        with progress("processing") as told:
            told(0.5)
        assert "processing: 50 %" in err.getvalue() and "\x1b" not in out.getvalue() + err.getvalue()


def test_a_status_that_was_dropped_is_nothing_lost():
    """It may be, so that it slows nobody down; on a busy machine the line of a flight said "1 gap" to its end."""
    overview, status = Overview(), m.NodeStatus(node="recorder")
    status.topics.add(topic="status/simulator", gaps=2)
    overview.take_status("recorder", status)
    assert "gap" not in overview.line() and overview.losses()["gaps"] == 0
    status.topics.add(topic="sensor/gnss", gaps=1)
    assert overview.line().endswith("1 gap") and overview.as_json()["nodes"]["recorder"]["gaps"] == 1


def test_lag_and_queue_are_whole_on_a_narrow_terminal():
    overview = Overview()
    state = "running, GNSS clock not seen: no turns were flown so far"
    overview.take_status("navigator", m.NodeStatus(node="navigator", state=state, lag_s=1.25, queued=17))
    console = Console(file=io.StringIO(), width=60)
    console.print(screen(overview, "platform demo"))
    row = next(line for line in console.file.getvalue().splitlines() if "navigator" in line)
    assert "1.25 s" in row and " 17 " in row and "running, GNSS" in row


def test_progress_that_is_written_over_stays_on_one_line(monkeypatch):
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "60")
    monkeypatch.setattr("sys.stderr", _Terminal())
    lines = _ProgressLines(type("Args", (), {"quiet": False, "json": False, "verbose": False}))
    lines(Phase("a name of a phase that is longer than the terminal, as of models with many words in their names"))
    shown = sys.stderr.getvalue().replace("\r\x1b[K", "")
    assert len(shown) == width() == 59
