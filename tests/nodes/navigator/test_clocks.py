"""GNSS times of another clock are named, and their fixes are left out; those that are only late are used."""

from __future__ import annotations

import functools
import re

import numpy as np
import pytest
from stepped_node import stepped

from triline.nodes import convert
from triline.nodes.navigator.navigator import Navigator
from triline.nodes.node import Message
from triline.nodes.simulator.simulator import Simulator
from triline.schemas import messages as schema
from triline.solver.navigation.clock_check import ClockCheck, offset_in_words
from triline.solver.navigation.inertial_data import TACTICAL
from triline.solver.simulation.error_models import ErrorModel
from triline.solver.simulation.flight import FlightPlan
from triline.solver.simulation.inertial_sensors import InertialPlan
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
    out = stepped(node, messages)
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
    out = stepped(node, flight())
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


def test_a_clock_that_was_set_back_after_the_first_fixes_is_told_without_a_figure():
    """It was told as set back by a thousand years: the first fix counted as one a period after 1970."""
    fixes = [m for m in flight() if m.topic == "sensor/gnss"]
    later, period_s = fixes[18].stamp_ns, (fixes[1].stamp_ns - fixes[0].stamp_ns) * 1e-9
    off_s = (fixes[0].stamp_ns - later) * 1e-9 + 0.4 * period_s
    moved = [shifted(m, off_s, stamp=True) if m.topic == "sensor/gnss" and m.stamp_ns >= later else m for m in flight()]
    _, events, _ = flown([flight()[0], *sorted(moved[1:], key=lambda m: m.stamp_ns)])
    assert any("GNSS clock was set back: GNSS is left out" in text for text in events), events


def test_fixes_are_used_again_when_the_clock_is_right_again():
    third = flight()[len(flight()) // 3].stamp_ns
    wrong = (third, third + 6 * SECOND)
    messages = [
        shifted(m, -18.0) if m.topic == "sensor/gnss" and wrong[0] < m.stamp_ns < wrong[1] else m for m in flight()
    ]
    node, events, off_m = flown(messages)
    assert "GNSS clock agrees again: fixes are used" in events
    assert not node.alarm and off_m < 3.0


# ---- tenths of a second


@functools.cache
def turning(imu: bool) -> tuple[Message, ...]:
    """A turn between two strips: the sensors alone, numbered."""
    plan = FlightPlan(strips=2, strip_s=10.0, lead_in_s=20.0, lead_out_s=20.0, bank_deg=40.0)
    # centimetres: what an offset of attitudes hides in is the slow error of the GNSS
    errors = ErrorModel(attitude_rate_hz=50.0, wander_sigma_m=(0.05, 0.05, 0.1), gnss_rate_hz=2.0)
    unit = InertialPlan(TACTICAL, 50.0) if imu else None
    numbers: dict[str, int] = {}
    out = []
    for m in Simulator(simulate(plan, 1, errors, inertial=unit)).messages(EPOCH):
        if m.topic in Navigator.inputs:
            n = numbers[m.topic] = numbers.get(m.topic, -1) + 1
            out.append(Message(m.topic, m.stamp_ns, m.body, "simulator", n))
    return tuple(out)


def heard(messages, node: Navigator | None = None) -> tuple[Navigator, list[str], list]:
    """The node, its event log and its smoothed poses."""
    node = node or Navigator(filtered_s=1.0, smooth_every_s=4.0)  # answers are rarely wanted here
    out = stepped(node, messages)
    events = [o.body.message for o in out if o.topic == "event/log"]
    return node, events, [o.body for o in out if o.topic == "trajectory/smoothed"]


@functools.cache
def in_step(imu: bool) -> tuple[Navigator, list[str], list]:
    """The same of clocks that agree."""
    return heard(turning(imu))


def late_receiver(offset_s: float, imu: bool) -> list[Message]:
    """A receiver whose clock is off all along; its fixes come when they come."""
    return [shifted(m, offset_s) if m.topic == "sensor/gnss" else m for m in turning(imu)]


@pytest.mark.parametrize("imu", [False, True])
def test_clocks_that_agree_are_not_accused(imu):
    node, events, _ = in_step(imu)
    assert not any("clock" in text for text in events) and not node.alarm
    assert "GNSS clock" not in node.state()  # the turn has shown it


@pytest.mark.parametrize("seed", [1, pytest.param(2, marks=pytest.mark.study)])
def test_strips_without_the_turns_between_them_accuse_no_clock(seed):
    """Recorders that are switched off in turns: nobody knows how the aircraft came from one strip to the next."""
    plan = FlightPlan(strips=2, strip_s=60.0, turns=False)
    simulated = simulate(plan, seed, ErrorModel(attitude_rate_hz=50.0, gnss_rate_hz=2.0))
    messages = [m for m in Simulator(simulated).messages(EPOCH) if m.topic in Navigator.inputs]
    node, events, _ = heard(messages)
    assert not any("clock" in text for text in events) and not node.counters["gnss of another clock"]


@pytest.mark.parametrize(
    ("offset_s", "imu"), [(0.1, True), pytest.param(0.9, True, marks=pytest.mark.study), (0.9, False)]
)
def test_tenths_of_a_second_are_named_after_a_turn_and_corrected_on_the_operators_word(offset_s, imu):
    messages = late_receiver(offset_s, imu)
    node, events, poses = heard(messages)
    named = [text for text in events if "GNSS is left out" in text]
    found = re.search(r"GNSS clock ([0-9.]+) s (behind|ahead of) the (inertial|attitude) clock", named[0])
    assert found, named
    ahead_s = float(found[1]) * (1.0 if found[2] == "ahead of" else -1.0)
    assert ahead_s == pytest.approx(offset_s, abs=0.03 if imu else 0.12)
    assert "GNSS is left out" in node.alarm and "triline confirm sensor/gnss --clock" in node.alarm
    assert node.counters["gnss of another clock"] > 20
    newest = max(convert.time_ns(b.timestamp) for b in poses) if poses else 0
    assert newest < messages[-1].stamp_ns - 10 * SECOND  # nothing is said of the end of the flight
    # the same with the operator's word from the start
    verdict = schema.Verdict(topic="sensor/gnss", accepted=True, by="ann", clock_s=-offset_s)
    first = next(i for i, message in enumerate(messages) if message.topic != "configuration/project")
    told = Message("observation/verdict", messages[first].stamp_ns, verdict, "surveyor", 0)
    node, events, poses = heard([*messages[:first], told, *messages[first:]])
    assert f"sensor/gnss is corrected by {-offset_s:+.3f} s from now on (ann)" in events
    assert not node.alarm and not any("left out" in text for text in events)
    right = positions(in_step(imu)[2])
    off = [np.linalg.norm(p - right[t]) for t, p in positions(poses).items() if t in right]
    assert len(off) > 300 and max(off) < 0.5


def test_another_project_in_flight_leaves_what_the_clocks_have_shown():
    messages = late_receiver(0.9, False)
    k = 3 * len(messages) // 10  # before the turn
    project = type(messages[0].body).FromString(messages[0].body.SerializeToString())
    project.image_sigma_px *= 2.0
    again = Message("configuration/project", messages[k].stamp_ns, project, "surveyor", 1)
    node, events, _ = heard([*messages[:k], again, *messages[k:]])
    assert any("GNSS clock 0.8" in text and "left out" in text for text in events), events
    assert "GNSS is left out" in node.alarm


def test_a_recording_is_processed_with_the_clock_set_right():
    _, events, poses = heard(late_receiver(0.9, True), Navigator(filtered_s=1.0, smooth_every_s=4.0, gnss_clock_s=-0.9))
    assert not any("clock" in text for text in events) and len(poses) > 300
    with pytest.raises(ValueError, match="gnss_clock_s is 1e"):
        Navigator(gnss_clock_s=1e6)
    node = Navigator()
    bad = schema.Verdict(topic="sensor/gnss", accepted=True, clock_s=float("nan"))
    assert not list(node.step(Message("observation/verdict", EPOCH, bad))) and node.counters["malformed"] == 1


def test_without_a_turn_nothing_shows_tenths_and_the_node_says_so():
    node, events, _ = heard([shifted(m, 0.1) if m.topic == "sensor/gnss" else m for m in flight()])
    assert not any("clock" in text for text in events)
    assert node.state() == "running, GNSS clock not seen: no turn yet"


@pytest.mark.study
@pytest.mark.parametrize("imu", [False, True])
def test_offsets_are_as_uncertain_as_they_say(imu):
    found = []
    for seed in range(12):
        plan = FlightPlan(strips=2, strip_s=15.0, lead_in_s=20.0, lead_out_s=25.0)
        unit = InertialPlan(TACTICAL, 50.0) if imu else None
        node = Navigator()
        for message in Simulator(
            simulate(plan, seed, ErrorModel(attitude_rate_hz=50.0, gnss_rate_hz=2.0), inertial=unit)
        ).messages(EPOCH):
            if message.topic in Navigator.inputs:
                node.step(message)
        assert not node.alarm
        found.append(node._offset._last)
    w = np.array([f.offset_s / f.sigma_s for f in found if f])
    assert len(w) > 9 and 0.3 < np.sqrt(np.mean(w**2)) < 1.8


# ---- positions that drift


def drifting(message: Message, first_s: float, to_s: float, rate_m_s: float) -> Message:
    """A forged fix in the receiver's name: north of the true one, by more and more."""
    t = (message.stamp_ns - EPOCH) / SECOND
    if message.topic != "sensor/gnss" or not first_s < t < to_s:
        return message
    body = type(message.body)()
    body.CopyFrom(message.body)
    body.latitude += rate_m_s * (t - first_s) / 111_200.0
    return Message(message.topic, message.stamp_ns, body, message.source, message.sequence)


def test_gnss_forged_with_a_drift_is_named_and_genuine_fixes_are_used_afterwards():
    first, to = 40.0, 60.0
    node = Navigator(filtered_s=1.0, smooth_every_s=4.0)
    events, poses, alarms = [], [], set()
    for message in turning(True):
        out = list(node.step(drifting(message, first, to, 0.5)))
        events += [o.body.message for o in out if o.topic == "event/log"]
        poses += [o.body for o in out if o.topic == "trajectory/smoothed"]
        alarms.add(node.alarm)
    poses += [o.body for o in node.finish() if o.topic == "trajectory/smoothed"]
    named = [text for text in events if "GNSS positions contradict the inertial data" in text]
    rate = re.search(r"most north, changing by ([0-9.]+) m/s: not used", named[0])
    assert len(named) == 1 and rate and float(rate[1]) == pytest.approx(0.5, abs=0.1)
    assert any("GNSS positions contradict" in alarm for alarm in alarms) and not node.alarm
    assert any(text.startswith("GNSS positions agree again after") for text in events)
    right = positions(in_step(True)[2])
    off = {t: np.linalg.norm(p - right[t]) for t, p in positions(poses).items() if t in right}
    assert max(off.values()) < 1.5  # of the 10 m that were forged
    after = [o for t, o in off.items() if t > EPOCH + round((to + 3.0) * SECOND)]
    assert len(after) > 100 and max(after) < 0.1


def test_with_attitude_alone_the_jump_back_is_named_and_genuine_fixes_are_used_after_a_second():
    half = (flight()[len(flight()) // 2].stamp_ns - EPOCH) / SECOND
    node, events, poses = heard([drifting(message, half - 12.0, half, 0.5) for message in flight()])
    assert any("GNSS position jumped by" in text and "wrong is what was before" in text for text in events), events
    right = positions(right_poses())
    after = EPOCH + round((half + 4.0) * SECOND)
    off = [np.linalg.norm(p - right[t]) for t, p in positions(poses).items() if t in right and t > after]
    assert len(off) > 100 and max(off) < 1.0
    assert node.counters["gnss refused"] < 8


def test_attitudes_that_are_silent_accuse_no_clock_and_frozen_ones_are_not_used():
    half = flight()[len(flight()) // 2].stamp_ns
    silent, frozen, held = [], [], None
    for message in flight():
        inside = message.topic == "sensor/attitude" and half < message.stamp_ns < half + 5 * SECOND
        if inside:
            held = held or message.body
            body = type(held)()
            body.CopyFrom(message.body)
            body.roll, body.pitch, body.heading = held.roll, held.pitch, held.heading
            frozen.append(Message(message.topic, message.stamp_ns, body, message.source, message.sequence))
        else:
            silent.append(message)
            frozen.append(message)
    node, events, _ = heard(silent)
    assert not any("clock" in text for text in events) and not node.alarm
    node, events, poses = heard(frozen)
    assert any("attitude has been the same for 1.0 s" in text for text in events) and not node.alarm
    assert "attitude changes again" in events and node.counters["attitude frozen"] > 100
    times = [convert.time_ns(b.timestamp) for b in poses if b.valid]
    assert not [t for t in times if half + 2 * SECOND < t < half + 4 * SECOND]


def test_attitudes_of_a_clock_that_was_set_back_are_an_alarm_until_their_times_go_on():
    """They are out of order, so that nothing is navigated; a single one that a link held up says nothing."""
    attitudes = [m for m in flight() if m.topic == "sensor/attitude"]
    half = len(attitudes) // 2

    def back(message: Message, seconds: float) -> Message:
        body = type(message.body)()
        body.CopyFrom(message.body)
        body.time_ns -= round(seconds * SECOND)
        return Message(message.topic, message.stamp_ns, body, message.source, message.sequence)

    before = [m for m in flight() if m.stamp_ns < attitudes[half].stamp_ns]
    node, events, _ = heard([*before, back(attitudes[half], 5.0), attitudes[half + 1]])
    assert not events and not node.alarm
    node, events, _ = heard([*before, *(back(m, 10.0) for m in attitudes[half : half + 100])])
    told = "the clock of attitude was set back by 10 s: nothing is navigated until it is past that"
    assert events == [told] and node.alarm == told
    node, events, _ = heard(attitudes[half + 100 :], node)
    assert events[0] == "attitude is used again, its times go on" and not node.alarm


def test_attitudes_that_no_aircraft_can_have_turned_to_are_not_published():
    """Headings 90 deg off for a fifth of a second were poses with a sigma of hundredths."""
    attitudes = [m for m in flight() if m.topic == "sensor/attitude"]
    spoilt = {m.sequence for m in attitudes[len(attitudes) // 2 :][:10]}
    messages = []
    for message in flight():
        if message.topic == "sensor/attitude" and message.sequence in spoilt:
            body = type(message.body)()
            body.CopyFrom(message.body)
            body.heading = (body.heading + np.pi / 2) % (2 * np.pi)
            message = Message(message.topic, message.stamp_ns, body, message.source, message.sequence)
        messages.append(message)
    node, events, poses = heard(messages)
    assert "attitude jumps by 90.0 deg: left out until it goes on from before, or stays so" in events
    assert node.counters["attitude jump"] == 10 and not node.alarm
    right = {convert.time_ns(b.timestamp): convert.pose_sample(b).quaternion for b in right_poses()}
    for body in poses:
        cosine = abs(np.dot(convert.pose_sample(body).quaternion, right[convert.time_ns(body.timestamp)]))
        assert np.degrees(2.0 * np.arccos(min(cosine, 1.0))) < 0.1
