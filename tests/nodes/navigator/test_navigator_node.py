"""The navigator node: topics, stamps, bad input."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from stepped_node import stepped

from triline.nodes import convert
from triline.nodes.navigator.navigator import Navigator
from triline.nodes.node import Message
from triline.nodes.simulator.simulator import Simulator
from triline.schemas import messages as m
from triline.solver.simulation.error_models import ErrorModel
from triline.solver.simulation.flight import FlightPlan
from triline.solver.simulation.scenario import simulate

EPOCH = 1_700_000_000_000_000_000


@pytest.fixture(scope="module")
def sensors():
    simulation = simulate(FlightPlan(strip_s=6.0, lead_in_s=3.0, lead_out_s=1.0), 1, ErrorModel(attitude_rate_hz=100.0))
    return [message for message in Simulator(simulation).messages(EPOCH) if message.topic in Navigator.inputs]


def test_every_attitude_message_gives_one_pose_of_each_kind_with_the_stamp_of_its_cause(sensors):
    node = Navigator()
    count = {"trajectory/filtered": 0, "trajectory/smoothed": 0}
    for message in sensors:
        for output in node.step(message):
            assert output.topic in node.outputs
            assert output.stamp_ns == message.stamp_ns
            if output.topic == "trajectory/filtered":
                assert message.topic == "sensor/attitude"
                assert convert.time_ns(output.body.timestamp) == message.body.time_ns
            count[output.topic] = count.get(output.topic, 0) + 1
    for output in node.finish():
        count[output.topic] += 1
    n = sum(message.topic == "sensor/attitude" for message in sensors)
    assert count["trajectory/smoothed"] == n
    assert n - 1 <= count["trajectory/filtered"] <= n
    assert node.state() == "running, GNSS clock not seen: no turn yet" and not node.counters


def test_poses_are_complete(sensors):
    poses = [o.body for o in stepped(Navigator(), sensors) if o.topic == "trajectory/smoothed"]
    sample = convert.pose_sample(poses[500])
    assert sample.covariance is not None and np.linalg.eigvalsh(sample.covariance).min() > 0
    assert sample.valid and poses[500].velocity.x ** 2 + poses[500].velocity.y ** 2 == pytest.approx(4900.0, rel=0.1)
    assert convert.angles_of(sample.quaternion) == pytest.approx(np.array(poses[500].angles), abs=1e-12)


def test_same_messages_same_bytes(sensors):
    first, second = (
        [(o.topic, o.stamp_ns, o.body.SerializeToString(deterministic=True)) for o in stepped(Navigator(), sensors)]
        for _ in range(2)
    )
    assert first == second


def test_fixes_far_from_the_project_are_told_once(sensors):
    """Of a flight with the project of another place (or latitude and longitude exchanged) nothing was said."""

    def exchanged(message):
        if message.topic != "sensor/gnss":
            return message
        body = type(message.body)()
        body.CopyFrom(message.body)
        body.latitude, body.longitude = message.body.longitude, message.body.latitude
        return replace(message, body=body)

    node = Navigator()
    out = stepped(node, map(exchanged, sensors))
    (said,) = (o.body for o in out if o.topic == "event/log" and "away from the origin" in o.body.message)
    assert said.message.startswith("GNSS is 5") and said.message.endswith("that of another flight?")
    assert node.alarms["far"] == said.message and node.counters["far from project"] == 1
    right = next(x for x in sensors if x.topic == "sensor/gnss")
    node.step(replace(right, stamp_ns=sensors[-1].stamp_ns))
    assert "far" not in node.alarms


def test_a_project_without_a_place_has_no_fix_far_from_it(sensors):
    node = Navigator()
    for message in sensors:
        if message.topic == "configuration/project":
            body = type(message.body)()
            body.CopyFrom(message.body)
            body.origin_latitude = body.origin_longitude = body.origin_height = 0.0
            message = replace(message, body=body)
        node.step(message)
    assert "far" not in node.alarms


def bad_attitudes():
    good = dict(time_ns=EPOCH, roll=0.0, pitch=0.0, heading=1.0, covariance=np.diag([1e-9] * 3).ravel().tolist())
    yield {**good, "roll": float("nan")}
    yield {**good, "heading": 90.0}
    yield {**good, "covariance": []}
    yield {**good, "covariance": [1e-9] * 8}
    yield {**good, "covariance": [0.0] * 9}


def bad_fixes():
    good = dict(latitude=48.9, longitude=8.9, altitude=1800.0, position_covariance=np.eye(3).ravel().tolist())
    yield {**good, "latitude": float("nan")}
    yield {**good, "latitude": 4890.0}
    yield {**good, "position_covariance": []}
    yield {**good, "position_covariance": [-1.0] * 9}
    yield {**good, "altitude": float("inf")}


@pytest.mark.parametrize(
    ("topic", "body"),
    [("sensor/attitude", m.Attitude(**f)) for f in bad_attitudes()]
    + [("sensor/gnss", m.LocationFix(**f)) for f in bad_fixes()],
)
def test_bad_values_are_counted_and_dropped_and_the_node_goes_on(sensors, topic, body):
    clean, node = Navigator(), Navigator()
    middle = len(sensors) // 2
    bad = Message(topic, sensors[middle].stamp_ns, body)
    good = stepped(clean, sensors)
    out = stepped(node, [*sensors[:middle], bad, *sensors[middle:]])
    assert node.counters["malformed"] == 1 and topic in node.last_problem
    assert len(out) == len(good)
    assert out[-1].body == good[-1].body


def test_without_configuration_it_waits_and_says_so(sensors):
    node = Navigator()
    without = [message for message in sensors if message.topic != "configuration/project"]
    assert stepped(node, without) == []
    assert node.state() == "waiting for configuration/project"
    assert node.counters["before configuration"] == len(without)


def test_bad_configuration_is_refused_and_a_good_one_taken_afterwards(sensors):
    node = Navigator()
    bad = m.Project(crs="local", offset_sigma_m=[-1.0, 1.0, 1.0])
    (log,) = node.step(Message("configuration/project", EPOCH, bad))
    assert log.topic == "event/log" and "offset_m" in log.body.message
    assert len(stepped(node, sensors)) > 1000


def test_duplicates_disorder_and_an_outage_are_counted(sensors):
    node = Navigator()
    out = []
    for message in sensors:
        gone = message.topic == "sensor/gnss" and 4.0 < (message.stamp_ns - EPOCH) / 1e9 < 8.0
        for copy in () if gone else (message, message):
            out += node.step(copy)
    out += node.finish()
    n = sum(message.topic == "sensor/attitude" for message in sensors)
    assert node.counters["attitude duplicate"] == n
    assert node.counters["gnss duplicate"] > 10
    assert node.counters["gnss outage"] == 1
    poses = [o.body for o in out if o.topic == "trajectory/filtered"]
    invalid = [p for p in poses if not p.valid and (convert.time_ns(p.timestamp) - EPOCH) > 5e9]
    assert any("no GNSS" in p.reason for p in invalid) and all(p.reason for p in invalid)
    assert poses[-1].valid
    assert any(o.topic == "event/log" and "coasting" in o.body.message for o in out)


def test_a_restart_in_flight_catches_up(sensors):
    middle = len(sensors) // 2
    latched = [message for message in sensors if message.topic.startswith("configuration/")]
    out = stepped(Navigator(), latched + [x for x in sensors[middle:] if not x.topic.startswith("configuration/")])
    whole = {
        o.body.timestamp.ToNanoseconds(): o.body
        for o in stepped(Navigator(), sensors)
        if o.topic == "trajectory/smoothed"
    }
    late = [o.body for o in out if o.topic == "trajectory/smoothed"][-100:]
    assert len(late) == 100
    for body in late:
        other = whole[body.timestamp.ToNanoseconds()]
        assert body.pose.position.x == pytest.approx(other.pose.position.x, abs=0.05)
