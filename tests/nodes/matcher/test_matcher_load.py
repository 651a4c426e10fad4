"""A matcher on a machine that is too slow for the image lines: it makes fewer ties, keeps up, and `process` agrees."""

from __future__ import annotations

import sys
import time

import numpy as np
import pytest
from bus_rig import Rig, triline, wait_for
from recording_file import payloads
from test_matcher_node import EPOCH_NS, SETTINGS, run

from triline.nodes.bus.session import Bus
from triline.nodes.cli.process import at_pace
from triline.nodes.config import build
from triline.nodes.matcher.matcher import Matcher
from triline.nodes.matcher.pace import SHARES, MatcherPace
from triline.nodes.node import Message
from triline.nodes.recording.reader import RecordingReader
from triline.nodes.simulator.flight_settings import simulated_flight
from triline.nodes.simulator.simulator import Simulator
from triline.schemas import codec
from triline.schemas import messages as m
from triline.solver.camera.sensors import preset
from triline.solver.matching.options import MatchingOptions, Place
from triline.solver.matching.places import Density
from triline.solver.matching.tie_matcher import TieMatcher

#: A matcher on a slow machine: for some time, every place takes so much longer to look for.
SLOW = """
import sys, time
from triline.solver.matching.looks import LookMatcher
plain = LookMatcher.look
def look(self, tracks, view):
    if 200 < tracks[0].place.line < 380:
        time.sleep(0.04 * len(tracks))
    return plain(self, tracks, view)
LookMatcher.look = look
from triline.nodes.cli import main
sys.exit(main())
"""


@pytest.mark.study
def test_an_overloaded_matcher_makes_fewer_ties_says_so_and_recovers(tmp_path):
    flight, live, again, config = (tmp_path / f"{x}" for x in ("flight.mcap", "live.mcap", "again.mcap", "nodes.toml"))
    config.write_text("[matcher]\npoints_per_s = 12\n")
    plan = ("--sensor", "ads40-small", "--pixels", 500, "--images", "--height", 600, "--seconds", 20, "--lead-in", 2)
    assert triline("simulate", "-o", flight, *plan, "--attitude-rate", 100, "--seed", 6, "-q").returncode == 0
    with Rig(tmp_path) as rig:
        recorder, navigator = rig.start("node", "recorder", "-o", live), rig.start("node", "navigator")
        adjuster = rig.start("node", "adjuster")
        program = [sys.executable, "-c", SLOW, "node", "matcher", "--config", str(config)]
        matcher = rig.start_program(program, "matcher")
        states, lags = [], []
        with Bus(port=rig.port) as bus:

            def status(raw):
                body = codec.decode(raw.topic, raw.data)
                states.append(body.state)
                lags.append(body.lag_s)

            bus.subscribe("status/matcher", status)
            wait_for(lambda: bus.alive() >= {"recorder", "navigator", "matcher", "adjuster"}, 20, "the nodes")
            replay = rig.start("replay", flight)
            assert replay.wait(120) == 0
            time.sleep(2.3)
        assert [rig.stop(p) for p in (navigator, matcher, adjuster, recorder)] == [0, 0, 0, 0], rig.log("matcher")
        assert "Traceback" not in rig.log("matcher")
    reader = RecordingReader(live)
    paces = [message.body for message in reader.sorted_messages(["matching/pace"])]
    said = [m.body.message for m in reader.sorted_messages(["event/log"]) if m.body.name == "matcher"]
    levels = [pace.level for pace in paces]
    assert max(levels) >= 2 and levels[-1] < max(levels), levels
    better = next(pace.start_ns for pace in paces[int(np.argmax(levels)) :] if pace.level < max(levels))
    assert max(lags) < 6.0, "it fell behind without bound"
    assert any("s behind:" in text for text in said) and any("s behind:" in state for state in states)
    stamps = np.array([stamp for stamp, _, _ in payloads(live, "observation/tie")])
    assert (stamps > better).any(), "no ties after the load"  # how many is a matter of the machine
    nodes = "--nodes", "navigator,matcher,adjuster", "--config", config
    assert triline("process", live, "-o", again, *nodes).returncode == 0
    for topic in ("observation/tie", "observation/target", "matching/pace", "event/log", "orientation/final"):
        assert payloads(live, topic) == payloads(again, topic), topic


@pytest.mark.study
def test_recorded_paces_are_followed(tmp_path):
    flight = simulated_flight(SETTINGS)
    messages = list(Simulator(flight.simulation, flight.imager).messages(EPOCH_NS))
    begin = next(m.stamp_ns for m in messages if m.topic.startswith("sensor/lines"))
    spoken = [(11.0, 3), (14.5, 7), (15.5, 0)]
    for s, level in spoken:
        stamp = begin + int(s * 1e9)
        messages.append(Message("matching/pace", stamp, MatcherPace(level, 1.0).message(stamp + 1), "matcher"))
    messages.sort(key=lambda message: message.stamp_ns)
    summary, ties, told = run(tmp_path, messages, points_per_s=8.0)
    at_s = np.sort([(max(image.time_ns for image in tie.images) - begin) * 1e-9 for tie in ties])
    counted = summary.counters["matcher"]
    rate = flight.simulation.flight.strips[0].line_rate_hz
    assert counted["lines gone by"] == pytest.approx(3 * rate, abs=30) and counted["left out by load"] > 10
    assert any("35 % of the tie points" in text for text in told) and any("lines go by unseen" in text for text in told)
    assert any("lines are missing" in text for text in told) and any("normal density" in text for text in told)
    full, few = ((at_s > a) & (at_s < b) for a, b in ((8.2, 9.5), (11.0, 12.3)))
    assert 0 < few.sum() < 0.6 * full.sum()
    assert not ((at_s > 14.7) & (at_s < 15.5)).any()


def test_a_pace_holds_from_its_time_on_and_levels_there_are_not_are_refused():
    matcher = Matcher()
    list(matcher.step(Message("matching/pace", 1_000, MatcherPace(2, 2.4).message(2_000))))
    assert matcher.state().startswith("waiting") and not matcher.counters
    assert not [x for x in matcher.step(Message("trajectory/filtered", 1_999, m.PoseInFrame())) if "log" in x.topic]
    said = [
        x.body.message for x in matcher.step(Message("trajectory/filtered", 2_000, m.PoseInFrame())) if "log" in x.topic
    ]
    assert said == ["2.4 s behind: 50 % of the tie points"]
    list(matcher.step(Message("matching/pace", 3_000, m.Pace(start_ns=4_000, level=len(SHARES)))))
    assert matcher.counters["malformed"] == 1 and "level 8" in matcher.last_problem


def test_at_the_pace_for_throughput_the_load_in_flight_leaves_nothing_out():
    """`process --pace throughput` of a flight under load left out the places that were left out in flight."""
    shares = {}
    for pace in ("load", "throughput"):
        matcher = build(Matcher, at_pace({}, pace))
        for topic, stamp in (("matching/pace", 1_000), ("trajectory/filtered", 3_000)):
            body = MatcherPace(2, 2.4).message(2_000) if topic == "matching/pace" else m.PoseInFrame()
            list(matcher.step(Message(topic, stamp, body)))
        shares[pace] = matcher._pace.share
    assert shares == {"load": 0.5, "throughput": 1.0}


def test_fewer_places_keep_their_spread_and_those_of_earlier_strips_stay():
    matcher = TieMatcher(preset("ads40"))
    across = np.linspace(100.0, 11_900.0, 60)
    places = [Place(float(row * 200 + 50), float(s)) for row in range(4) for s in across]
    matcher._master.waiting.add(places)
    matcher._master.waiting.add([Place(50.0, 500.0, "S1-M3", (0.01, 0.01))] * 3)
    matcher.keep(0.35)
    left = [track.place for track in matcher._master.waiting.tracks]
    assert sum(bool(place.name) for place in left) == 3
    free = np.array([(place.line, place.sample) for place in left if not place.name])
    assert len(free) == round(0.35 * len(places))
    for row in range(4):
        steps = np.diff(np.sort(free[free[:, 0] == row * 200 + 50, 1]))
        assert len(steps) in range(19, 23) and steps.max() < 4 * across[1] - 4 * across[0]
    with pytest.raises(ValueError, match="0 to 1"):
        matcher.keep(1.5)


def test_the_density_follows_the_load_down_to_nothing():
    density = Density(MatchingOptions(points_per_s=8.0))
    density.load = 0.5
    assert density.cells(10.0)[0] == pytest.approx(80, abs=2)
    density.load = 0.0
    assert density.cells(10.0)[0] == 0
