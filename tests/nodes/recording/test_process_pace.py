"""Recordings through `process`: in two processes as in one, and at the pace for throughput as good as live."""

from __future__ import annotations

import io
from dataclasses import replace

import numpy as np
import pytest
from recording_file import write_recording

from triline.nodes import convert, registry
from triline.nodes.cli.process import at_pace
from triline.nodes.config import build
from triline.nodes.errors import UserError
from triline.nodes.ordering import order_key
from triline.nodes.recording.reader import RecordingReader
from triline.nodes.recording.runner import process
from triline.nodes.recording.runner_apart import Ahead
from triline.nodes.recording.writer import RecordingWriter
from triline.nodes.simulator.simulator import Simulator
from triline.nodes.step_driver import StepDriver
from triline.schemas import topics
from triline.schemas.envelope import Envelope
from triline.solver.accuracy import angle_difference
from triline.solver.navigation.inertial_data import TACTICAL
from triline.solver.simulation.error_models import ErrorModel
from triline.solver.simulation.flight import FlightPlan
from triline.solver.simulation.inertial_sensors import InertialPlan
from triline.solver.simulation.misspecified_study import OBSERVED, SETTINGS
from triline.solver.simulation.misstated import Sine, World
from triline.solver.simulation.scenario import simulate

EPOCH = 1_700_000_000_000_000_000
KINDS = ("attitude", "inertial")


@pytest.fixture(scope="module")
def flights(tmp_path_factory):
    return recorded(tmp_path_factory, 12.0, 50.0)


@pytest.fixture(scope="module")
def long_flights(tmp_path_factory):
    return recorded(tmp_path_factory, 30.0, 100.0)


def recorded(tmp_path_factory, strip_s, rate_hz):
    """Recordings of a strip with its truth, by kind of navigation data, at a rate of attitudes and inertial samples."""
    found = {}
    for kind in KINDS:
        inertial = InertialPlan(TACTICAL, rate_hz) if kind == "inertial" else None
        # an inertial filter aligns first
        plan = FlightPlan(strip_s=strip_s, lead_in_s=20.0 if inertial else 3.0)
        simulation = simulate(plan, 4, ErrorModel(attitude_rate_hz=rate_hz, gnss_rate_hz=5.0), inertial=inertial)
        path = tmp_path_factory.mktemp(kind) / "flight.mcap"
        write_recording(path, Simulator(simulation).messages(EPOCH))
        found[kind] = simulation, path
    return found


def processed(path, pace="load", apart=False, copied=False):
    """Bytes of what comes out; ``copied``: recorded messages go into the output without an envelope."""
    nodes = [build(registry.node_class(name), at_pace({}, pace)) for name in registry.ESTIMATING]
    out = io.BytesIO()
    with RecordingWriter(out) as writer:
        copy = writer.write_recorded if copied else None
        summary = process(RecordingReader(path), nodes, writer.write_raw, apart=apart, copy=copy)
    assert summary.nodes == ["navigator", "adjuster"]
    assert not any("failed" in counters for counters in summary.counters.values())
    return summary, out.getvalue()


@pytest.mark.study
@pytest.mark.skipif(not Ahead.possible(), reason="one processor only, or no fork")
def test_two_processes_give_the_bytes_of_one(flights):
    _, path = flights["attitude"]
    (alone, expected), (apart, found) = processed(path), processed(path, apart=True)
    assert found == expected
    assert (apart.outputs, apart.counters, apart.states) == (alone.outputs, alone.counters, alone.states)


@pytest.mark.skipif(not Ahead.possible(), reason="one processor only, or no fork")
@pytest.mark.parametrize("kind", [pytest.param("attitude", marks=pytest.mark.study), "inertial"])
def test_what_only_the_last_node_needs_is_checked_by_the_process_ahead(flights, tmp_path, kind):
    path, reader = tmp_path / "spoilt.mcap", RecordingReader(flights[kind][1])
    spoilt = 0
    with RecordingWriter(path) as writer:
        for raw in reader.raws(reader.select()):
            wrong = raw.topic in ("observation/tie", "sensor/gnss") and raw.envelope.sequence % 15 == 7
            writer.write_raw(raw._replace(data=b"\xff\xff") if wrong else raw)
            spoilt += wrong
    (alone, expected), (apart, found) = (processed(path, "throughput", two, copied=two) for two in (False, True))
    assert spoilt > 10 and alone.dropped == {"malformed": spoilt}
    assert found == expected
    assert (apart.inputs, apart.outputs, apart.dropped) == (alone.inputs, alone.outputs, alone.dropped)
    assert (apart.counters, apart.states) == (alone.counters, alone.states)


def test_a_strip_that_was_cut_short_ends_as_on_the_bus(flights, tmp_path):
    """Ties are stamped ahead, and the navigator's last words come before those that are stamped after the last sensor:
    each node is given all its inputs in the order of their stamps."""
    reader, path = RecordingReader(flights["attitude"][1]), tmp_path / "cut.mcap"
    end_ns = reader.first("configuration/strip").first_line_time_ns + 8 * 10**9
    kept = []
    for raw in reader.raws(reader.select()):
        if raw.envelope.stamp_ns <= end_ns:
            ahead_ns = 8 * 10**8 if raw.topic == "observation/tie" else 0
            envelope = raw.envelope._replace(stamp_ns=raw.envelope.stamp_ns + ahead_ns)
            kept.append(raw._replace(envelope=envelope, data=bytes(raw.data)))
    kept.sort(key=lambda raw: order_key(raw.topic, raw.envelope))
    with RecordingWriter(path) as writer:
        for raw in kept:
            writer.write_raw(raw)

    def driven(name, given):
        driver = StepDriver(build(registry.node_class(name), at_pace({}, "load")))
        heard = [one for one in given if any(topics.find(row).matches(one.topic) for row in driver.inputs)]
        heard.sort(key=lambda one: order_key(one.topic, Envelope(one.stamp_ns, one.source, one.sequence, one.start)))
        return [output for one in heard for output in driver.step(one)] + driver.finish()

    recorded = list(RecordingReader(path).sorted_messages())
    poses = driven("navigator", recorded)
    last_ns = max(pose.stamp_ns for pose in poses)
    assert sum(one.topic == "observation/tie" and one.stamp_ns > last_ns for one in recorded) > 5
    expected = [(one.topic, one.stamp_ns, one.body) for one in [*poses, *driven("adjuster", [*recorded, *poses])]]
    for apart in (False, True) if Ahead.possible() else (False,):
        out = tmp_path / "out.mcap"
        out.write_bytes(processed(path, apart=apart)[1])
        made = RecordingReader(out).sorted_messages(sorted({topic for topic, *_ in expected}))
        found = [(one.topic, one.stamp_ns, one.body) for one in made if one.source in ("navigator", "adjuster")]
        for topic in {topic for topic, *_ in expected}:
            mine, theirs = ([row for row in rows if row[0] == topic] for rows in (found, expected))
            assert mine == theirs, topic


@pytest.mark.skipif(not Ahead.possible(), reason="one processor only, or no fork")
def test_a_process_that_is_killed_is_told_in_one_line(flights, monkeypatch):
    _, path = flights["attitude"]
    listen = Ahead.__iter__

    def kill(self):
        self._process.kill()
        self._process.join()
        return listen(self)

    monkeypatch.setattr(Ahead, "__iter__", kill)
    with pytest.raises(UserError, match=r"the process of the navigator has ended \(exit code -9\)"):
        processed(path, apart=True)


@pytest.mark.skipif(not Ahead.possible(), reason="one processor only, or no fork")
def test_what_is_wrong_in_the_other_process_is_told_here():
    def broken():
        yield from range(5)
        raise UserError("flight.mcap: 12 bytes are gone")

    ahead = Ahead(broken, "navigator")
    with pytest.raises(UserError, match="12 bytes are gone"):
        list(ahead)
    ahead.close()


@pytest.mark.study
@pytest.mark.parametrize("kind", KINDS)
def test_results_for_throughput_are_as_good(long_flights, tmp_path, kind):
    simulation, path = long_flights[kind]
    found = {}
    for pace in ("load", "throughput"):
        summary, content = processed(path, pace)
        (tmp_path / pace).write_bytes(content)
        found[pace] = summary, *errors(RecordingReader(tmp_path / pace), simulation)
    (live, final, ratio, points), (quick, quick_final, quick_ratio, quick_points) = found["load"], found["throughput"]
    assert quick.outputs["adjustment/report"] < 0.4 * live.outputs["adjustment/report"]
    assert quick.outputs["trajectory/filtered"] < 0.2 * live.outputs["trajectory/filtered"]
    assert quick.outputs["orientation/final"] == live.outputs["orientation/final"]
    assert quick.outputs["orientation/live"] > 0.7 * live.outputs["orientation/live"]
    # the same to a tenth of what the results differ from the truth, or better
    assert (quick_final < 1.1 * final).all()
    assert quick_ratio < max(1.1 * ratio, 1.5)
    assert quick_points < 1.1 * points
    # and once a strip is over it does not matter that answers were wanted early: X, Y, Z, omega, phi, kappa differ by
    # less than what they are stated to be off
    whole, quick_whole = (component_errors(RecordingReader(tmp_path / p), simulation) for p in ("load", "throughput"))
    assert len(whole) == len(quick_whole) == live.outputs["orientation/final"]
    sigma = np.sqrt(np.einsum("nii->ni", covariances(RecordingReader(tmp_path / "load"))).mean(axis=0))
    assert (rms(whole - quick_whole) < 1.2 * sigma).all()
    # the last of it, too, of which the smoothed poses come when it is over
    assert (rms((whole - quick_whole)[-60:]) < 1.5 * sigma).all()


def test_what_is_in_doubt_is_looked_at_more_often(tmp_path):
    """A vibration that nobody stated is found at the pace for throughput, too, and the sigmas hold over flights."""
    world = World(sines=(Sine((0.01, 0.01, 0.01), 3.0),))
    plan, path, done = FlightPlan(strip_s=40.0, lead_in_s=3.0, lead_out_s=3.0), tmp_path / "in", tmp_path / "out"
    nees = []
    for seed in (2, 4):
        simulation = simulate(plan, seed, replace(SETTINGS["rtk"], attitude_rate_hz=100.0), OBSERVED, world=world)
        write_recording(path, Simulator(simulation).messages(EPOCH))
        done.write_bytes(processed(path, "throughput")[1])
        reader = RecordingReader(done)
        assert any("the attitude vibrates by" in m.body.message for m in reader.messages(["event/log"]))
        reports = [m.stamp_ns for m in reader.messages(["adjustment/report"])]
        flight_s = plan.lead_in_s + plan.strip_s + plan.lead_out_s
        assert 10 < len(reports) < 2.2 * flight_s  # each half second at most
        off, C = component_errors(reader, simulation), covariances(reader)
        nees.append(np.einsum("ni,ni->n", off, np.linalg.solve(C, off[:, :, None])[:, :, 0]).mean() / 6.0)
    assert 0.6 < np.mean(nees) < 1.6


def covariances(reader):
    """Covariances (n, 6, 6) of whole orientation in the order of time; what was said last counts."""
    last = {convert.time_ns(m.body.timestamp): m.body for m in reader.messages(["orientation/whole"])}
    return np.array([convert.pose_sample(last[t]).covariance for t in sorted(last)])


def rms(e):
    return np.sqrt(np.mean(e**2, axis=0))


def component_errors(reader, simulation, topic="orientation/whole"):
    """Errors (n, 6) of orientation in the order of time; what was said last counts."""
    last = {convert.time_ns(m.body.timestamp): m.body for m in reader.messages([topic])}
    bodies = [last[t] for t in sorted(last)]
    truth = simulation.flight.truth.at((np.array(sorted(last)) - EPOCH) * 1e-9)
    position = np.array([convert.pose_sample(body).position_l for body in bodies])
    angles = np.array([list(body.angles) for body in bodies])
    return np.hstack([position - truth.position_l, angle_difference(angles, truth.angles)])


def errors(reader, simulation):
    """Root mean squares (2,) of position and attitude of final orientation, its normalised square, and of points, m."""
    off = component_errors(reader, simulation, "orientation/final")
    C = np.array([convert.pose_sample(m.body).covariance for m in reader.messages(["orientation/final"])])
    ratio = np.einsum("ni,ni->n", off, np.linalg.solve(C, off[:, :, None])[:, :, 0]).mean() / 6.0
    true = {m.body.point: m.body for m in reader.messages(["truth/point"])}
    last = {m.body.point: m.body for m in reader.messages(["point/object"])}
    e = np.array([[p.x - true[n].x, p.y - true[n].y, p.z - true[n].z] for n, p in last.items()])
    return np.sqrt([(off[:, :3] ** 2).mean(), (off[:, 3:] ** 2).mean()]), ratio, float(np.sqrt((e**2).mean()))


def test_a_pace_that_is_not_known_and_poses_too_far_apart_are_refused():
    with pytest.raises(UserError, match="filtered_s is 3, wanted 0 to 1 s"):
        build(registry.node_class("navigator"), {"navigator": {"filtered_s": 3.0}})
    with pytest.raises(UserError, match="wanted one of load, normal, throughput"):
        build(registry.node_class("adjuster"), {"adjuster": {"pace": "fast"}})
    # what a configuration says goes before the pace
    assert at_pace({"adjuster": {"pace": "normal"}}, "throughput")["adjuster"]["pace"] == "normal"
