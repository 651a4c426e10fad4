"""A flight of which nodes could use nothing that came ends with exit code 1, and says what was refused."""

from __future__ import annotations

import pytest
from places import ROOT

from triline.nodes.adjuster.adjuster import Adjuster
from triline.nodes.cli.live_flight import ESTIMATORS
from triline.nodes.cli.refused import refused_inputs
from triline.nodes.monitor.monitor import Overview
from triline.nodes.navigator.navigator import Navigator
from triline.nodes.recording.reader import RecordingReader
from triline.nodes.step_driver import StepDriver
from triline.schemas import messages as m

WHY = "sensor/lines/N: lines of N of 90 samples, wanted 100"


def matcher(refused: dict[str, tuple[int, int]], **counted) -> m.NodeStatus:
    """What a matcher says of itself that refused so many of so many messages of topics."""
    status = m.NodeStatus(node="matcher", last_problem="adjustment/report 7 came 0.2 s behind")
    status.counters.add(name="late", value=900, last_problem=status.last_problem)
    status.counters.add(name="malformed", value=114, last_problem=WHY)
    for topic, (of, all_) in refused.items():
        status.topics.add(topic=topic, received=all_, refused=of, **counted)
    return status


def told(*statuses: m.NodeStatus) -> list[str]:
    return refused_inputs({status.node: status for status in statuses}, ESTIMATORS)


def test_all_image_lines_refused():
    lines = matcher({f"sensor/lines/{id}": (38, 38) for id in "FNB"} | {"trajectory/filtered": (0, 900)})
    assert told(lines) == [f"matcher used none of the 114 messages on sensor/lines/*: malformed: {WHY}"]
    one = matcher({"sensor/lines/N": (36, 38)}, duplicates=2)
    assert told(one) == [f"matcher used none of the 38 messages on sensor/lines/N: malformed: {WHY}"]


@pytest.mark.parametrize(
    "refused",
    [
        {},  # nothing came
        {"sensor/lines/N": (0, 0)},
        {"sensor/lines/N": (0, 38)},
        {"sensor/lines/N": (37, 38)},  # some bad records
        {"sensor/lines/N": (38, 38), "sensor/lines/F": (0, 38)},  # one of several CCD lines
        {"trajectory/filtered": (5, 5)},  # no sensor
    ],
)
def test_of_some_bad_records_nothing_is_said(refused):
    assert told(matcher(refused)) == []


def test_gnss_that_comes_twice_and_is_used_is_not_refused():
    assert told(matcher({"sensor/gnss": (0, 10)}, duplicates=10)) == []


def test_inertial_data_or_attitude_is_enough():
    assert told(matcher({"sensor/imu": (10, 10), "sensor/attitude": (0, 5)})) == []
    (line,) = told(matcher({"sensor/imu": (10, 10), "sensor/attitude": (5, 5)}))
    assert line.startswith("matcher used none of the 15 messages on sensor/attitude and sensor/imu: ")


@pytest.mark.parametrize("used", [0, 1])
def test_a_node_that_was_started_again_is_judged_by_the_whole_flight(used):
    """One that died at the end of a good flight, and then got nothing of use, made of it a flight that failed."""
    overview = Overview()
    runs = [(10.0, 300, 300), (3600.0, 9000, 9000 + used), (0.1, 0, 0), (8.0, 5, 5)]
    for uptime_s, of, all_ in runs:
        status = matcher({"sensor/lines/N": (of, all_)})
        status.uptime_s = uptime_s
        overview.take_status("matcher", status)
    lines = refused_inputs(overview.nodes, ESTIMATORS, overview.earlier)
    assert lines == ([] if used else [f"matcher used none of the 9005 messages on sensor/lines/N: malformed: {WHY}"])


def over_a_strip(node, change):
    """A node over the strip that is recorded here, messages changed first; how many of them were changed."""
    driver, changed = StepDriver(node), 0
    for message in RecordingReader(ROOT / "recordings" / "strip.mcap").sorted_messages([*node.inputs, "sensor/gnss"]):
        if any(message.topic == name for name in driver.inputs):
            changed += bool(change(message))
            driver.step(message)
    return changed


def another_strip(message):
    if message.topic == "observation/tie":
        for image in message.body.images:
            image.strip = "S9"
        return True
    return False


def half_of_them(message):
    return another_strip(message) if message.sequence % 2 else False


@pytest.mark.parametrize(("change", "number"), [(another_strip, 112), (half_of_them, 56), (lambda message: False, 0)])
def test_ties_on_an_unknown_strip_are_refused_by_the_adjuster(change, number):
    adjuster = Adjuster()
    assert over_a_strip(adjuster, change) == number == adjuster.refusals
    said = adjuster.last_problems.get("unknown strip", "")
    assert said.startswith("observation/tie: point ") is bool(number) and ("in strip 'S9', CCD line " in said) is bool(
        number
    )


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ("covariance", "malformed: sensor/gnss: position covariance"),
        ("clock", "clock: sensor/gnss: GNSS clock 18.00 s ahead of"),
    ],
)
def test_fixes_that_cannot_be_used_are_refused_by_the_navigator(change, why):
    navigator = Navigator()

    def spoil(message):
        if message.topic != "sensor/gnss":
            return False
        if change == "covariance":
            message.body.position_covariance[:] = [0.0] * 9
        else:
            message.body.timestamp.seconds += 18  # GPS time in place of UTC
        return True

    fixes = over_a_strip(navigator, spoil)
    assert fixes > 100 and navigator.refusals >= fixes - 3
    # of another clock they come late, too, which is not why they are not used
    status = m.NodeStatus(node="navigator", last_problem="sensor/gnss 7 came 1.2 s behind")
    status.topics.add(topic="sensor/gnss", received=fixes, refused=fixes)
    navigator.counters["late"], navigator.last_problems["late"] = 10 * fixes, status.last_problem
    for name, value in navigator.counters.items():
        status.counters.add(name=name, value=value, last_problem=navigator.last_problems.get(name, ""))
    (line,) = told(status)
    assert line.startswith(f"navigator used none of the {fixes} messages on sensor/gnss: {why}")
