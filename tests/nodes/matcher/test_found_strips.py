"""Strips that nobody announces are found from their image lines, and serve as announced ones do."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import sample_messages as sample
from driven_flight import SETTINGS

from triline.nodes.convert import camera_message
from triline.nodes.matcher.found_strips import FoundStrips
from triline.nodes.matcher.matcher import Matcher
from triline.nodes.matcher.side_by_side import SideBySide
from triline.nodes.navigator.navigator import Navigator
from triline.nodes.node import Message
from triline.nodes.rectifier.rectifier import Rectifier
from triline.nodes.simulator.flight_settings import simulated_flight
from triline.nodes.simulator.simulator import Simulator
from triline.schemas import messages as m
from triline.schemas.image_lines import LineBlock
from triline.schemas.topics import find
from triline.solver.camera.sensors import preset

EPOCH_NS = 1_700_000_000_000_000_000
PERIOD_NS = 5_000_000


def block(strip: str, first: int, n: int = 20, period_ns: int = PERIOD_NS, late_ns: int = 0, times=None) -> LineBlock:
    t = EPOCH_NS + first * PERIOD_NS + late_ns
    return LineBlock(np.zeros((n, 4), np.uint8), "N", strip, first, t, period_ns, times)


def test_rate_and_first_line():
    strip = FoundStrips().begin(block("S1", 40))
    assert (strip.id, strip.first_line_time_ns, strip.line_rate_hz) == ("S1", EPOCH_NS, 200.0)
    times = EPOCH_NS + 40 * PERIOD_NS + np.arange(20) * PERIOD_NS
    strip = FoundStrips().begin(block("S2", 40, period_ns=0, times=times))
    assert (strip.first_line_time_ns, strip.line_rate_hz, strip.ended) == (EPOCH_NS, 200.0, False)
    for wrong in (block("", 0), block("S1", 0, n=1, period_ns=0), block("S1", 0, period_ns=0)):
        with pytest.raises(ValueError, match="wanted both"):
            FoundStrips().begin(wrong)


def test_a_strip_ends_with_another_one_or_with_silence():
    found = FoundStrips()
    for first in (0, 20):
        if not first:
            found.begin(block("S1", first))
        assert found.note(block("S1", first), EPOCH_NS + first * PERIOD_NS) == ""
    assert found.ended(EPOCH_NS + 1_000_000_000) == []
    (ended,) = found.ended(EPOCH_NS + 1_000_000_000, block("S2", 0))
    assert (ended.id, ended.lines, ended.ended) == ("S1", 40, True)
    found.begin(block("S2", 0))
    found.note(block("S2", 0), EPOCH_NS)
    (ended,) = found.ended(EPOCH_NS + 6_000_000_000)
    assert (ended.id, ended.lines) == ("S2", 20) and found.finish() == []


def test_of_strips_at_once_the_first_one_is_flown():
    strips = {id: m.Strip(id=id) for id in ("S1", "S2", "T1")}
    flown = SideBySide()

    def at(strip, seconds, stamp_s=None):
        of = replace(block(strip, 0), time_ns=EPOCH_NS + round(seconds * 1e9))
        return flown.lines(of, EPOCH_NS + round((seconds if stamp_s is None else stamp_s) * 1e9), strips)

    assert at("S1", 0.0) == at("T1", 0.1) == (False, "")
    assert at("S1", 0.2) == (False, "T1: its lines come beside those of S1")
    assert at("T1", 0.3) == at("T1", 0.9) == (True, "") and at("S1", 1.0) == (False, "")
    assert at("T1", 6.1) == (False, "")  # S1 has fallen silent
    assert at("S2", 7.0) == (False, "") and at("T1", 6.9, stamp_s=7.1) == (True, "")  # late, not at once
    assert at("S2", 7.2) == (False, "")
    strips["S2"].ended = True
    assert at("S1", 7.3) == (False, "") and at("S1", 7.4) == (False, "")  # flown again, as in a loop


def test_lines_that_are_off_the_rate_are_told_once():
    found = FoundStrips()
    found.begin(block("S1", 0))
    assert found.note(block("S1", 100, late_ns=2_000_000), EPOCH_NS) == ""
    assert "S1: line 200 came +0.8 lines off the 200.0000 lines/s" in found.note(
        block("S1", 200, late_ns=4_000_000), EPOCH_NS
    )
    assert found.note(block("S1", 300, late_ns=9_000_000), EPOCH_NS) == ""


@pytest.mark.parametrize("own", [False, True])
def test_lines_that_are_off_the_rate_of_an_announced_strip_are_told_once(own):
    """A nominal rate: tie points would be metres off for it, unless the lines have times of their own."""
    node = Matcher()
    node.step(Message("configuration/camera", EPOCH_NS, camera_message(preset("ads40-small")), "x"))
    strip = m.Strip(id="S1", first_line_time_ns=EPOCH_NS, line_rate_hz=199.0)
    node.step(Message("configuration/strip", EPOCH_NS, strip, "x"))
    told = []
    for first in range(0, 400, 20):
        times = EPOCH_NS + (first + np.arange(20)) * PERIOD_NS
        which = {"period_ns": 0, "times": times} if own else {}
        lines = replace(block("S1", first, **which), pixels=np.zeros((20, 1500), np.uint8))
        out = node.step(Message("sensor/lines/N", EPOCH_NS + (first + 19) * PERIOD_NS, lines, "x"))
        told += [o.body.message for o in out if o.topic == "event/log" and "lines/s" in o.body.message]
    assert len(told) == (0 if own else 1)
    for text in told:
        assert text.startswith(
            "S1: line 100 came -0.5 lines off the 199.0000 lines/s that the strip was announced with"
        )


def test_a_strip_whose_lines_have_times_of_their_own_ends_when_they_do():
    found = FoundStrips()
    times = EPOCH_NS + np.arange(100) * PERIOD_NS + (np.arange(100) * 1e-2) ** 2 * 1e8  # slower and slower
    for first in range(0, 100, 20):
        part = block("S1", first, period_ns=0, times=times[first : first + 20].astype(np.int64))
        if not first:
            found.begin(part)
        assert found.note(part, EPOCH_NS) == ""
    (ended,) = found.finish()
    last_ns = ended.first_line_time_ns + (ended.lines - 1) * 10**9 / ended.line_rate_hz
    assert ended.lines == 100 and last_ns == pytest.approx(times[-1], abs=1000)


def test_a_strip_that_begins_anew_under_its_name_is_refused():
    found = FoundStrips()
    found.begin(block("S1", 0))
    found.note(block("S1", 0), EPOCH_NS)
    for again in (block("S1", 0, late_ns=60 * 10**9), block("S1", 20, late_ns=10**9)):
        with pytest.raises(ValueError, match=r"strip 'S1' came \+\d+ lines off .* wants another name"):
            found.note(again, EPOCH_NS)
    (ended,) = found.finish()
    assert ended.lines == 20
    node = Matcher()
    node.step(Message("configuration/camera", EPOCH_NS, camera_message(preset("ads40-small")), "x"))
    node.step(Message("sensor/lines/N", EPOCH_NS, block("S1", 0), "x"))
    node.step(Message("sensor/lines/N", EPOCH_NS + 10**11, block("S1", 20, late_ns=10**11), "x"))
    assert node.counters["malformed"] >= 1 and "wants another name" in node.last_problem


def test_a_strip_that_goes_on_after_its_end_is_told():
    """Its numbers go with its times, so that it is not refused; what refines the orientation has ended the strip."""
    found = FoundStrips()
    found.begin(block("S1", 0))
    assert found.note(block("S1", 0), EPOCH_NS) == ""
    assert not found.ended(EPOCH_NS + 4 * 10**9)
    assert [strip.id for strip in found.ended(EPOCH_NS + 6 * 10**9)] == ["S1"]
    again = block("S1", round(8 * 10**9 / PERIOD_NS))
    told = found.note(again, EPOCH_NS + 8 * 10**9)
    assert told.startswith(f"S1: lines come again from line {again.first_line} on, after the strip has ended")
    assert found.note(block("S1", again.first_line + 20), EPOCH_NS + 8 * 10**9 + 10**8) == ""  # once


def test_what_follows_from_the_matcher_does_not_move_the_end_of_a_strip():
    """The adjuster's last words come before or after the matcher's, as it happens when a flight is ended."""
    ends = []
    for late in (False, True):
        node = Matcher()
        node.step(Message("configuration/camera", EPOCH_NS, camera_message(preset("ads40-small")), "x"))
        node.step(Message("sensor/lines/N", EPOCH_NS, block("S1", 0), "x"))
        if late:
            node.step(Message("adjustment/report", EPOCH_NS + 10**9, sample.body("adjustment/report"), "adjuster"))
        ends += [message.stamp_ns for message in node.finish() if message.topic == "configuration/strip"]
    assert len(ends) == 2 and ends[0] == ends[1]


def test_ties_are_those_of_the_announced_strip():
    """A flight for two matchers, one of which does not hear of its strip; the rectifier hears of it from that one."""
    navigator, told, found, rectifier = Navigator(), Matcher(), Matcher(), Rectifier()
    flight = simulated_flight({**SETTINGS, "pixels": 100, "seconds": 5.0, "lead_in": 2.0, "control": 10})
    ties: dict[Matcher, list[Message]] = {told: [], found: []}
    strips, announced = [], []
    late: list[tuple[int, Message]] = []
    lines = 0

    def give(node, message: Message) -> list[Message]:
        """What a node makes of a message that it listens to."""
        if not any(find(name).matches(message.topic) for name in node.inputs):
            return []
        return [Message(m.topic, m.stamp_ns, m.body, node.name) for m in node.step(message)]

    for message in Simulator(flight.simulation, flight.imager).messages(EPOCH_NS):
        poses = give(navigator, message)
        if message.topic == "configuration/strip":
            announced.append(message.body)
            give(told, message)
            continue
        while late and late[0][0] <= message.stamp_ns:
            give(rectifier, late.pop(0)[1])
        for given in (message, *poses):
            lines += len(given.body.pixels) if given.topic == "sensor/lines/N" else 0
            give(rectifier, given)
            for matcher, made in ties.items():
                out = give(matcher, given)
                made += [m for m in out if m.topic == "observation/tie"]
                if matcher is found:
                    new = [m for m in out if m.topic == "configuration/strip"]
                    strips += new
                    late += [(m.stamp_ns, m) for m in new]
    strips += found.finish()
    begun, ended = (message.body for message in strips)
    strip = announced[0]
    assert (begun.id, begun.ended, ended.ended, ended.lines) == (strip.id, False, True, strip.lines)
    # the period of the lines is a whole number of ns
    assert begun.line_rate_hz == pytest.approx(strip.line_rate_hz, rel=1e-7)
    assert abs(begun.first_line_time_ns - strip.first_line_time_ns) < 100
    assert len(ties[found]) == len(ties[told]) > 3
    for a, b in zip(ties[told], ties[found], strict=True):
        one, other = ([(i.line, i.sample) for i in m.body.images] for m in (a, b))
        np.testing.assert_allclose(one, other, atol=1e-5)
    assert not told.finish() and lines > 80
    # lines wait for their strip, and none of them is lost
    assert not rectifier.counters["unknown strip"] and rectifier._next_line[strip.id] == lines
    assert found.step(Message("configuration/strip", strips[0].stamp_ns, begun, "matcher")) == ()
