"""Nodes that must not wait ask for a higher priority, and take what they get."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from triline.nodes import registry
from triline.nodes.bus import priority
from triline.nodes.bus.program import GO_FIRST


@pytest.fixture
def system(monkeypatch):
    """A system that grants no less than ``system.lowest``, and whose limit says so."""

    class System:
        lowest, now = 0, 0

        def set(self, which, who, value):
            if value < min(self.lowest, self.now):
                raise PermissionError("not permitted")
            self.now = value

    made = System()
    monkeypatch.setattr(os, "setpriority", made.set)
    monkeypatch.setattr(os, "getpriority", lambda which, who: made.now)
    monkeypatch.setattr(os, "getsid", lambda process: -1)
    monkeypatch.setattr("resource.getrlimit", lambda which: (20 - made.lowest, 40))
    return made


@pytest.mark.parametrize(("lowest", "granted"), [(0, 0), (-4, -4), (-20, priority.URGENT)])
def test_it_takes_what_the_system_grants(system, lowest, granted):
    system.lowest = lowest
    assert priority.go_first() == granted == system.now


@pytest.mark.parametrize("stated", [-15, 5])
def test_who_was_started_with_a_niceness_keeps_it(system, stated):
    system.lowest, system.now = -20, stated
    assert priority.go_first() == stated == system.now


@pytest.mark.parametrize(("stated", "written"), [(0, "-10"), (-5, "-5"), (5, "")])
def test_who_leads_its_session_asks_for_the_session_too(system, stated, written, monkeypatch, tmp_path):
    """With a priority that it has of the program that started it as well."""
    system.lowest, system.now = -20, stated
    monkeypatch.setattr(os, "getsid", lambda process: os.getpid())
    monkeypatch.setattr(priority, "_SESSION", tmp_path / "autogroup")
    (tmp_path / "autogroup").touch()
    priority.go_first()
    assert (tmp_path / "autogroup").read_text() == written


def test_it_is_asked_of_the_system_itself():
    """In a process of its own, which may or may not be allowed to: it says what there is then."""
    code = "import os; from triline.nodes.bus import priority; print(priority.go_first(), os.getpriority(0, 0))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, start_new_session=True)
    said, there_is = map(int, done.stdout.split())
    mine = os.getpriority(os.PRIO_PROCESS, 0)
    assert said == there_is and min(priority.URGENT, mine) <= said <= mine


def test_who_goes_first_is_a_node():
    assert set(GO_FIRST) < set(registry.names()) and not {"matcher", "rectifier", "viewer", "simulator"} & set(GO_FIRST)
