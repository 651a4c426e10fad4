"""An adjuster on a machine that is too slow for the data: it keeps up, says how, and `process` gives the same."""

from __future__ import annotations

import sys
import time

import numpy as np
import pytest
from bus_rig import Rig, triline, wait_for
from recording_file import payloads

from triline.nodes.adjuster.pace import Pacing, pace_message
from triline.nodes.bus.session import Bus
from triline.nodes.recording.reader import RecordingReader
from triline.schemas import codec
from triline.solver.matching.thinning import Candidate, Thinning

#: An adjuster on a slow machine: every update of the window takes so much longer per new batch and in any case.
SLOW = """
import sys, time
from triline.solver.window.state import batch
from triline.solver.window.window import Window
plain = Window.update
seen = batch.Batch.linearise
def update(self, now_s):
    time.sleep(0.02)
    return plain(self, now_s)
def linearise(self, theta, reweigh):
    time.sleep(0.024 * len(self.rays) if self._slow() else 0.0)
    return seen(self, theta, reweigh)
batch.Batch._slow = lambda self: 18.0 < self.newest_s < 24.0
batch.Batch.linearise = linearise
Window.update = update
from triline.nodes.cli import main
sys.exit(main())
"""


@pytest.mark.study
def test_an_overloaded_adjuster_keeps_up_says_how_and_recovers(tmp_path):
    flight, live, again = tmp_path / "flight.mcap", tmp_path / "live.mcap", tmp_path / "again.mcap"
    plan = ("--seconds", 34, "--ties", 20, "--attitude-rate", 100, "--seed", 5)
    assert triline("simulate", "-o", flight, *plan, "-q").returncode == 0
    with Rig(tmp_path) as rig:
        recorder, navigator = rig.start("node", "recorder", "-o", live), rig.start("node", "navigator")
        adjuster = rig.start_program([sys.executable, "-c", SLOW, "node", "adjuster"], "adjuster")
        lags, states = [], []
        with Bus(port=rig.port) as bus:

            def status(raw):
                body = codec.decode(raw.topic, raw.data)
                lags.append(body.lag_s)
                states.append(body.state)

            bus.subscribe("status/adjuster", status)
            wait_for(lambda: bus.alive() >= {"recorder", "navigator", "adjuster"}, 20, "the nodes")
            replay = rig.start("replay", flight)
            assert replay.wait(120) == 0
            time.sleep(2.3)
        assert [rig.stop(p) for p in (navigator, adjuster, recorder)] == [0, 0, 0], rig.log("adjuster")
        assert "Traceback" not in rig.log("adjuster")
    paces = [m.body for m in RecordingReader(live).sorted_messages(["adjustment/pace"])]
    reports = [m.body for m in RecordingReader(live).sorted_messages(["adjustment/report"])]
    said = [m.body.message for m in RecordingReader(live).sorted_messages(["event/log"])]
    assert max(lags) < 25.0, "it fell behind by more than a window"
    assert max(p.level for p in paces) >= 3 and paces[-1].level < max(p.level for p in paces)
    assert max(r.left_out_total for r in reports) > 20 and min(r.kept_share for r in reports) < 1.0
    assert lags[-1] < 1.5, "it did not catch up"
    assert any("s behind: updates every" in line for line in said)
    assert any("s behind" in state for state in states)
    assert triline("process", live, "-o", again).returncode == 0
    for topic in ("orientation/live", "orientation/final", "point/object", "adjustment/pace", "event/log"):
        assert payloads(live, topic) == payloads(again, topic), topic


def test_a_pace_holds_from_its_time_on():
    pacing = Pacing()
    pacing.announce(pace_message(3, 2.0, 1_000))
    assert pacing.follow(999) is None and pacing.pace.level == 0
    pace = pacing.follow(1_000)
    assert pace is not None and pace.level == 3 and pace.kept == 0.5
    with pytest.raises(ValueError, match="level 99"):
        pacing.announce(type("Body", (), {"level": 99, "start_ns": 0, "lag_s": 0.0})())


def test_the_points_that_are_kept_tell_more_of_every_stretch_than_points_by_chance():
    rng = np.random.default_rng(3)
    thinning = Thinning()
    candidates = []
    for _ in range(300):  # most points crowd in one corner, some have two looks only
        t, share = (rng.uniform(0, 1), rng.uniform(0, 0.25)) if rng.random() < 0.8 else rng.uniform(0, 10, 2) / (1, 10)
        looks = [(t, "F", share), (t + 8.0, "N", share), (t + 16.0, "B", share)]
        candidates.append(Candidate(looks[: 2 if rng.random() < 0.3 else 3]))

    def told(chosen):
        """Sum of logarithms of the conditions at each place: what a diagonal information would gain."""
        held: dict[tuple[int, str, int], float] = {}
        for i in chosen:
            for time_s, ccd, part in candidates[i].looks:
                key = (int(time_s), ccd, int(4 * part))
                held[key] = held.get(key, 0.0) + candidates[i].conditions
        return sum(np.log1p(v) for v in held.values())

    chosen = thinning.choose(candidates, 40)
    assert len(chosen) == 40 and chosen == sorted(set(chosen))
    by_chance = [told(rng.choice(300, 40, replace=False)) for _ in range(20)]
    assert told(chosen) > 1.3 * max(by_chance)
    assert thinning.choose(candidates, 0) == []
