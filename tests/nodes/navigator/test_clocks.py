"""GNSS times of another clock are named, and their fixes are left out; those that are only late are used."""

from __future__ import annotations

import functools

import numpy as np
import pytest

from triline.nodes import convert
from triline.nodes.navigator.navigator import Navigator
from triline.nodes.node import Message
from triline.nodes.simulator.simulator import Simulator
from triline.solver.navigation.clock_check import ClockCheck, offset_in_words
from triline.solver.simulation.error_models import ErrorModel
from triline.solver.simulation.flight import FlightPlan
from triline.solver.simulation.scenario import simulate

EPOCH = 1_700_000_000_000_000_000
SECOND = convert.SECOND_NS


@functools.cache
def flight() -> tuple[Message, ...]:
    plan = FlightPlan(strip_s=36.0, lead_in_s=3.0, lead_out_s=1.0)
    messages = Simulator(simulate(plan, 1, ErrorModel(attitude_rate_hz=50.0))).messages(EPOCH)
    numbers: dict[str, int] = {}
    out = []
    for m in messages:
        if m.topic in Navigator.inputs:
            n = numbers[m.topic] = numbers.get(m.topic, -1) + 1
            out.append(Message(m.topic, m.stamp_ns, m.body, "simulator", n))
    return tuple(out)


def shifted(message: Message, seconds: float, stamp: bool = False) -> Message:
    """A fix whose clock is off; on request its stamp is the receiver's, too."""
    body = type(message.body)()
    body.CopyFrom(message.body)
    convert.set_time(body.timestamp, convert.time_ns(body.timestamp) + round(seconds * SECOND))
    stamp_ns = message.stamp_ns + (round(seconds * SECOND) if stamp else 0)
    return Message(message.topic, stamp_ns, body, message.source, message.sequence)


def flown(messages) -> tuple[Navigator, list[str], float]:
    """The node, its event log, and the largest error of valid poses against the flight with a right clock, m."""
    node = Navigator()
    out = [o for message in messages for o in node.step(message)] + list(node.finish())
    events = [o.body.message for o in out if o.topic == "event/log"]
    right = positions(right_poses())
    off = [
        np.linalg.norm(p - right[t])
        for t, p in positions([o.body for o in out if o.topic == "trajectory/smoothed"]).items()
        if t in right
    ]
    return node, events, max(off, default=0.0)


@functools.cache
def right_poses():
    node = Navigator()
    out = [o for message in flight() for o in node.step(message)] + list(node.finish())
    assert not node.alarm and not [o for o in out if o.topic == "event/log"]
    return tuple(o.body for o in out if o.topic == "trajectory/smoothed")


def positions(bodies):
    samples = (convert.pose_sample(body) for body in bodies)
    return {s.time_ns: s.position_l for s in samples if s.valid}


def test_seconds_are_told_in_words_that_name_what_they_are_known_by():
    assert offset_in_words(18.0, "inertial") == (
        "GNSS clock 18.00 s behind the inertial clock (the leap seconds between GPS time and UTC)"
    )
    assert offset_in_words(-7200.3, "attitude").endswith("ahead of the attitude clock (2 times an hour)")
    assert "(a week)" in offset_in_words(604_800.1, "inertial")
    assert "(1 024 weeks" in offset_in_words(619_315_201.0, "inertial")
    assert offset_in_words(7.31, "inertial") == "GNSS clock 7.31 s behind the inertial clock"


def test_delays_of_a_link_and_single_late_fixes_are_no_clock():
    check = ClockCheck()
    rng = np.random.default_rng(1)
    for i in range(200):
        assert check.fix(0.2 * i, 0.2 * i + rng.uniform(0.0, 1.5))
    check.fix(40.0, 60.0)
    check.fix(40.2, 55.0)
    assert check.fix(60.0, 60.3) and check.offset_s is None


@pytest.mark.parametrize(
    ("offset_s", "words"),
    [
        (-18.0, "GNSS clock 18.00 s behind the attitude clock (the leap seconds"),
        (-3600.0, "behind the attitude clock (an hour"),
        (18.0, "ahead of the attitude clock (the leap seconds"),
        (-5.5, "GNSS clock 5.50 s behind the attitude clock"),
    ],
)
def test_a_receiver_whose_clock_is_off_from_the_middle_of_a_flight_is_left_out_and_named(offset_s, words):
    half = flight()[len(flight()) // 2].stamp_ns
    messages = [shifted(m, offset_s) if m.topic == "sensor/gnss" and m.stamp_ns > half else m for m in flight()]
    node, events, off_m = flown(messages)
    assert any(words in text for text in events), events
    assert "GNSS is left out" in node.alarm
    assert off_m < 3.0  # of poses that say they are valid: coasting at first, then none


@pytest.mark.parametrize("offset_s", [-3600.0, 604_800.0, -604_800.0, -1024 * 604_800.0])
def test_a_clock_that_is_off_from_the_start_gives_no_pose_and_is_named(offset_s):
    node, events, _ = flown([shifted(m, offset_s) if m.topic == "sensor/gnss" else m for m in flight()])
    assert any("GNSS clock" in text and "left out" in text for text in events), events
    assert node.counters["gnss of another clock"] > 100


@pytest.mark.parametrize("offset_s", [-3600.0, -604_800.0])
def test_a_recording_whose_fixes_are_sorted_long_before_the_flight_names_the_clock(offset_s):
    project, rest = flight()[0], flight()[1:]
    moved = [shifted(m, offset_s, stamp=True) if m.topic == "sensor/gnss" else m for m in rest]
    _, events, _ = flown([project, *sorted(moved, key=lambda m: m.stamp_ns)])
    assert any("GNSS clock" in text and "behind the attitude clock" in text for text in events), events


def test_a_recording_of_a_clock_that_was_set_back_in_flight_is_seen_by_the_numbers_of_its_fixes():
    half = flight()[len(flight()) // 2].stamp_ns
    moved = [
        shifted(m, -18.0, stamp=True) if m.topic == "sensor/gnss" and m.stamp_ns > half else m for m in flight()[1:]
    ]
    node, events, off_m = flown([flight()[0], *sorted(moved, key=lambda m: m.stamp_ns)])
    assert any("GNSS clock was set back by about 18 s" in text for text in events), events
    assert off_m < 3.0 and node.counters["gnss of another clock"] > 50


def test_fixes_are_used_again_when_the_clock_is_right_again():
    third = flight()[len(flight()) // 3].stamp_ns
    wrong = (third, third + 6 * SECOND)
    messages = [
        shifted(m, -18.0) if m.topic == "sensor/gnss" and wrong[0] < m.stamp_ns < wrong[1] else m for m in flight()
    ]
    node, events, off_m = flown(messages)
    assert (
        events[-1] == "GNSS clock agrees again: fixes are used" or "GNSS clock agrees again: fixes are used" in events
    )
    assert not node.alarm and off_m < 3.0
