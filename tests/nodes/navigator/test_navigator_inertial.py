"""The navigator node with raw inertial data: consistency, replay over the bus, restart, bad input, outages."""

from __future__ import annotations

import subprocess
import time
from pathlib import Path

import inertial_flights as sim
import numpy as np
import pytest
from bus_rig import ENVIRONMENT, TRILINE, free_port, triline, wait_for
from recording_file import bodies_of
from stepped_node import stepped

from triline.nodes import convert
from triline.nodes.bus.processes import NodeGroup
from triline.nodes.bus.session import Bus
from triline.nodes.navigator.navigator import Navigator
from triline.nodes.node import Message
from triline.nodes.recording.reader import RecordingReader
from triline.nodes.simulator.simulator import Simulator
from triline.schemas import codec
from triline.schemas import messages as m
from triline.solver.accuracy import angle_difference
from triline.solver.geometry.frames import LocalFrame
from triline.solver.geometry.trajectory import Trajectory
from triline.solver.navigation.inertial_data import MEMS, TACTICAL
from triline.solver.navigation.inertial_navigator import InertialNavigator
from triline.solver.simulation.error_models import ErrorModel
from triline.solver.simulation.flight import FlightPlan
from triline.solver.simulation.inertial_sensors import InertialPlan
from triline.solver.simulation.scenario import simulate

EPOCH = 1_700_000_000_000_000_000
TOPICS = ("trajectory/filtered", "trajectory/smoothed")
#: Two short strips, so that the flight is mostly a turn: heading comes from turns.
FLIGHT = ("--imu", "tactical", "--imu-rate", 100, "--gnss-rate", 2, "--strips", 2, "--seconds", 15, "--lead-in", 20)


@pytest.fixture(scope="module")
def flight(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("inertial") / "flight.mcap"
    done = triline("simulate", "-o", path, *FLIGHT, "--seed", 1, "--ties", 0, "-q")
    assert done.returncode == 0, done.stderr
    return path


@pytest.fixture(scope="module")
def processed(flight: Path) -> Path:
    out = flight.with_name("processed.mcap")
    done = triline("process", flight, "-o", out, "--nodes", "navigator", "-q")
    assert done.returncode == 0, done.stderr
    return out


def poses_of(recording: Path, topic: str) -> list:
    return [message.body for message in RecordingReader(recording).sorted_messages([topic])]


def truth_of(recording: Path) -> Trajectory:
    samples = [convert.pose_sample(body) for body in poses_of(recording, "truth/trajectory")]
    first = samples[0].time_ns
    return Trajectory(
        [(s.time_ns - first) * 1e-9 for s in samples], [s.position_l for s in samples], [s.quaternion for s in samples]
    )


def normalised_squares(bodies: list, truth: Trajectory, first_ns: int) -> np.ndarray:
    """Squares of errors over variances (n, 6) of valid poses within the truth."""
    t = np.array([(convert.time_ns(b.timestamp) - first_ns) * 1e-9 for b in bodies])
    keep = np.array([b.valid for b in bodies]) & truth.covers(t)
    at = truth.at(t[keep])
    kept = [b for b, k in zip(bodies, keep, strict=True) if k]
    position = np.array([[b.pose.position.x, b.pose.position.y, b.pose.position.z] for b in kept])
    angles = np.array([list(b.angles) for b in kept])
    variance = np.array([np.reshape(b.covariance, (6, 6)).diagonal() for b in kept])
    return np.hstack([position - at.position_l, angle_difference(angles, at.angles)]) ** 2 / variance


def check_aligning(bodies: list) -> float:
    """Poses are not valid, with a reason, until the filter is aligned; returns when it was, s after the first."""
    valid = [b.valid for b in bodies]
    assert True in valid
    first = valid.index(True)
    assert first > 5, "no pose while aligning"
    for body in bodies[:first]:
        assert body.reason.startswith("aligning")
        assert np.sqrt(np.reshape(body.covariance, (6, 6))[5, 5]) > 1.0  # rad: nothing is known of the heading
    assert all(valid[first:])
    return (convert.time_ns(bodies[first].timestamp) - convert.time_ns(bodies[0].timestamp)) * 1e-9


@pytest.mark.study
def test_a_recorded_flight_is_aligned_in_motion_and_navigated(flight: Path, processed: Path):
    filtered, smoothed = (poses_of(processed, topic) for topic in TOPICS)
    assert 8.0 < check_aligning(filtered) < 40.0
    truth = truth_of(flight)
    first_ns = convert.time_ns(poses_of(flight, "truth/trajectory")[0].timestamp)
    for bodies in (filtered, smoothed):
        squares = normalised_squares(bodies, truth, first_ns)
        assert len(squares) > 5000
        assert squares.mean(axis=0).max() < 6.0
    # the turn gives heading: from a degree to less than a tenth
    sigma = np.degrees([np.sqrt(np.reshape(b.covariance, (6, 6))[5, 5]) for b in filtered if b.valid])
    assert sigma[0] > 0.5 and sigma[-1] < 0.1
    times = [convert.time_ns(b.timestamp) for b in smoothed]
    assert times == sorted(set(times))


def messages_of(seed: int, grade=TACTICAL, seconds: float = 75.0, **plan: float) -> tuple[list[Message], Trajectory]:
    """The first seconds of a simulated flight, up to the middle of the turn, and the truth."""
    flight = FlightPlan(strips=2, strip_s=15.0, lead_in_s=20.0)
    simulation = simulate(
        flight, seed, ErrorModel(gnss_rate_hz=2.0, **plan), inertial=InertialPlan(grade, 50.0)
    )  # fmt: skip
    end = EPOCH + round(seconds * 1e9)
    every = Simulator(simulation).messages(EPOCH)
    return [x for x in every if x.topic in Navigator.inputs and x.stamp_ns < end], simulation.flight.truth


@pytest.mark.study
def test_errors_are_as_large_as_the_covariance_says_over_seeds():
    mean = {topic: [] for topic in TOPICS}
    for seed in range(1, 5):
        messages, truth = messages_of(seed, MEMS if seed % 2 else TACTICAL)
        out = stepped(Navigator(), messages)
        for topic in TOPICS:
            bodies = [o.body for o in out if o.topic == topic][::10]
            mean[topic].append(normalised_squares(bodies, truth, EPOCH).mean(axis=0))
    for topic in TOPICS:
        # the errors are slow: one or two independent values a component and flight, 24 to 48 in all
        assert 0.45 < np.mean(mean[topic]) < 1.8, topic
        assert np.max(np.mean(mean[topic], axis=0)) < 3.0, topic


class Platform:
    """Recorder and navigator on a bus of their own."""

    def __init__(self, folder: Path, port: int) -> None:
        self.port = port
        self.recording = folder / f"{port}.mcap"
        self.group = NodeGroup(folder / str(port), "demo", port)
        self.group.start("recorder", "-o", str(self.recording))
        self.group.start("navigator")

    def replay(self, flight: Path, rate: float, *more: object) -> subprocess.Popen[bytes]:
        command = [*TRILINE, "replay", flight, "--rate", rate, "--wait-for", "navigator", "-q"]
        command += ["--platform", "demo", "--port", self.port, *more]
        return subprocess.Popen([*map(str, command)], env=ENVIRONMENT)

    def finish(self) -> None:
        assert self.group.processes["navigator"].stop() == 0
        time.sleep(0.5)
        assert self.group.processes["recorder"].stop() == 0


@pytest.mark.study
def test_over_the_bus_it_is_the_same_trajectory_and_a_killed_navigator_aligns_anew(
    flight: Path, processed: Path, tmp_path: Path
):
    whole, killed = Platform(tmp_path, free_port()), Platform(tmp_path, free_port())
    with whole.group, killed.group, Bus(port=killed.port, source="listener") as bus:
        heard: list[tuple[int, bool, str]] = []  # start of the navigator, valid, reason

        def hear(raw) -> None:
            body = codec.decode(raw.topic, raw.data)
            heard.append((raw.envelope.start, body.valid, body.reason))

        bus.subscribe("trajectory/filtered", hear)
        wait_for(lambda: bus.alive() >= {"recorder", "navigator"}, 30, "the nodes")
        replays = [whole.replay(flight, 10.0), killed.replay(flight, 6.0, "--to", 100)]
        wait_for(lambda: any(valid for _, valid, _ in heard), 30, "a valid pose")
        victim = killed.group.processes["navigator"].process
        victim.kill()
        victim.wait()
        killed.group.start("navigator")
        assert [replay.wait(180) for replay in replays] == [0, 0]
        time.sleep(1.0)
        whole.finish()
        killed.finish()

    for topic in TOPICS:
        live = bodies_of(whole.recording, topic)
        assert len(live) > 5000
        assert live == bodies_of(processed, topic), f"{topic} differs between the bus and `process`"

    runs = list(dict.fromkeys(start for start, _, _ in heard))
    assert len(runs) == 2
    second = [(valid, reason) for start, valid, reason in heard if start == runs[1]]
    aligned = [valid for valid, _ in second].index(True)
    assert aligned > 5 and all(reason.startswith("aligning") for _, reason in second[:aligned])
    assert all(valid for valid, _ in second[aligned:]) and len(second) - aligned > 500
    first_ns = convert.time_ns(poses_of(flight, "truth/trajectory")[0].timestamp)
    last = poses_of(killed.recording, "trajectory/filtered")[-300:]
    assert normalised_squares(last, truth_of(flight), first_ns).mean() < 4.0


def damaged(message: Message, **changes: float) -> Message:
    body = m.Imu()
    body.CopyFrom(message.body)
    for name, value in changes.items():
        setattr(body, name, value)
    return Message(message.topic, message.stamp_ns, body)


@pytest.fixture(scope="module")
def short():
    """Enough to align, with the truth."""
    return messages_of(3, seconds=36.0)


def inertial(messages: list[Message]) -> list[int]:
    return [i for i, message in enumerate(messages) if message.topic == "sensor/imu"]


def last_errors(out: list[Message], truth: Trajectory) -> np.ndarray:
    """Normalised squares of the last 2 s."""
    bodies = [o.body for o in out if o.topic == "trajectory/filtered"]
    end_ns = convert.time_ns(bodies[-1].timestamp)
    bodies = [b for b in bodies if end_ns - convert.time_ns(b.timestamp) < 2 * convert.SECOND_NS]
    assert all(b.valid for b in bodies)
    return normalised_squares(bodies, truth, EPOCH)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"rate_sigma": float("nan"), "force_sigma": -0.1}, "rate_sigma is nan and force_sigma is -0.1"),
        ({"rate_sigma": float("inf")}, "rate_sigma is inf"),
        ({"rate_sigma": 0.0, "force_sigma": 0.0}, ""),  # not given
    ],
)
def test_a_first_sample_without_usable_noise_means_a_mems_unit(short, changes, said):
    messages, truth = short
    node = Navigator(filtered_s=0.1)
    wrong = [damaged(x, **changes) if x.topic == "sensor/imu" else x for x in messages]
    out = stepped(node, wrong)
    assert isinstance(node._engine, InertialNavigator) and node._engine.settings.grade.gyro_bias == MEMS.gyro_bias
    assert node.counters["inertial noise"] == (1 if said else 0)  # once, not with every sample
    warnings = [o.body.message for o in out if o.topic == "event/log" and o.body.level == 3]
    assert len(warnings) == (1 if said else 0) and all(said in text for text in warnings)
    assert node.counters["malformed"] == 0
    assert last_errors(out, truth).mean() < 4.0


@pytest.mark.parametrize(
    ("changes", "said", "filtered_s"),
    [
        ({"force_x": float("nan")}, "not finite", 0.0),  # a pose with every sample, as for live orientation
        ({"rate_z": float("inf")}, "not finite", 0.1),
        ({"force_z": -980665.0}, "no motion of an aircraft", 0.1),
        ({"interval_ns": 0}, "interval 0 ns", 0.1),
        ({"interval_ns": -5_000_000}, "interval -5000000 ns", 0.1),
        ({"time_ns": EPOCH + 10**15}, "after the stamp", 0.1),
    ],
)
def test_bad_samples_are_counted_and_bridged(short, changes, said, filtered_s):
    messages, truth = short
    node, rows = Navigator(filtered_s=filtered_s), inertial(messages)
    wrong = list(messages)
    for i in (rows[0], rows[len(rows) // 3], rows[len(rows) // 3 + 1], rows[-200]):
        wrong[i] = damaged(messages[i], **changes)
    out = stepped(node, wrong)
    # the first sample of a bag has no interval: nobody knows since when it measured
    counted = 3 if changes == {"interval_ns": 0} else 4
    assert node.counters["malformed"] == counted and said in node.last_problem and "failed" not in node.counters
    assert last_errors(out, truth).mean() < 4.0


def test_samples_without_an_interval_are_counted_but_for_the_first_one(short):
    """A unit that never says how long it measured is not left out without a word."""
    messages = [x for x in short[0] if x.topic == "configuration/project"]
    node, samples = Navigator(), [short[0][i] for i in inertial(short[0])[:20]]
    stepped(node, messages + [damaged(x, interval_ns=0) for x in samples])
    assert node.counters["malformed"] == 19 and "interval 0 ns" in node.last_problem


def test_duplicates_and_disorder_of_samples_change_nothing(short):
    messages = [x for x in short[0] if x.stamp_ns < EPOCH + 28 * convert.SECOND_NS]  # aligned for 9 s
    clean, node, rows = Navigator(), Navigator(), inertial(messages)
    again = list(messages)
    again.insert(rows[-300], messages[rows[-310]])
    again.insert(rows[500], messages[rows[499]])
    good, out = stepped(clean, messages), stepped(node, again)
    assert node.counters["inertial out of order"] == 2
    assert [o.body for o in out] == [o.body for o in good]


@pytest.mark.study
def test_measured_attitude_beside_inertial_data_is_left_aside_and_counted(short):
    messages, _ = short
    node = Navigator()
    middle = inertial(messages)[100]
    attitude = convert.attitude_message(EPOCH, (0.0, 0.0, 1.0), (1e-4, 1e-4, 1e-4))
    out = stepped(node, [*messages[:middle], Message("sensor/attitude", EPOCH, attitude), *messages[middle:]])
    assert node.counters["attitude beside inertial data"] == 1
    assert [o.body for o in out] == [o.body for o in stepped(Navigator(), messages)]


@pytest.mark.study
def test_an_outage_is_told_once_the_pose_is_too_uncertain_and_ends_with_it():
    messages, truth = messages_of(4, MEMS, 110.0)
    lost = [x for x in messages if not (x.topic == "sensor/gnss" and 40.0 < (x.stamp_ns - EPOCH) / 1e9 < 90.0)]
    out = stepped(Navigator(), lost)
    bodies = [o.body for o in out if o.topic == "trajectory/filtered"]
    after = np.array([(convert.time_ns(b.timestamp) - EPOCH) * 1e-9 for b in bodies])
    valid = np.array([b.valid for b in bodies])
    assert valid[(after > 30.0) & (after < 41.0)].all(), "it coasts before it gives up"
    during = (after > 80.0) & (after < 90.0)
    assert during.sum() > 400 and not valid[during].any()
    assert all(
        b.reason in ("position uncertain", "attitude uncertain") for b, d in zip(bodies, during, strict=True) if d
    )
    assert valid[after > 95.0].all() and (after > 95.0).any()
    late = [b for b, t in zip(bodies, after, strict=True) if t > 95.0]
    assert normalised_squares(late, truth, EPOCH).mean() < 4.0


@pytest.mark.study
def test_slow_gnss_errors_of_many_metres_do_not_make_every_pose_invalid():
    messages, _ = messages_of(5, seconds=40.0, offset_sigma_m=(8.0, 8.0, 12.0))
    poses = [o.body for o in stepped(Navigator(), messages) if o.topic == "trajectory/filtered"]
    assert poses[-1].valid and np.reshape(poses[-1].covariance, (6, 6))[2, 2] > 100.0


def test_a_unit_that_does_not_sit_in_the_perspective_centre():
    """The antenna is known from the camera; where the camera is from the unit is a setting. Poses are of the camera."""
    f, camera = sim.flight(duration_s=80.0, rate_hz=50, seed=9, line_s=30.0), np.array([0.1, 0.0, 0.6])
    lat, lon = np.degrees(f.gnss.lat[0]), np.degrees(f.gnss.lon[0])
    frame = LocalFrame(lat, lon, 0.0)
    project = m.Project(origin_latitude=lat, origin_longitude=lon, lever_arm_m=np.subtract(sim.ARM, camera))
    root = np.sqrt(f.inertial.dt_s)
    rate, force = f.inertial.dtheta / f.inertial.dt_s[:, None], f.inertial.dv / f.inertial.dt_s[:, None]
    messages = []
    for i, time_s in enumerate(f.inertial.time_s):
        body = m.Imu(
            time_ns=EPOCH + round(1e9 * time_s), interval_ns=round(1e9 * f.inertial.dt_s[i]),
            **dict(zip(("force_x", "force_y", "force_z"), force[i], strict=True)),
            **dict(zip(("rate_x", "rate_y", "rate_z"), rate[i], strict=True)),
            rate_sigma=TACTICAL.gyro_noise / root[i], force_sigma=TACTICAL.accel_noise / root[i],
        )  # fmt: skip
        messages.append(Message("sensor/imu", body.time_ns, body))
    for i, time_s in enumerate(f.gnss.time_s):
        place = np.degrees(f.gnss.lat[i]), np.degrees(f.gnss.lon[i]), f.gnss.height_m[i]
        stamp, sigma = EPOCH + round(1e9 * time_s), f.gnss.sigma_ned_m[i, [1, 0, 2]]
        messages.append(Message("sensor/gnss", stamp, convert.gnss_message(stamp, place, sigma)))
    messages.sort(key=lambda message: message.stamp_ns)
    worst = {}
    for arm in (camera, np.zeros(3)):
        node = Navigator(camera_lever_arm_m=arm.tolist(), filtered_s=0.1)
        list(node.step(Message("configuration/project", EPOCH, project)))
        out = [o for message in messages for o in node.step(message)]
        for topic in TOPICS:
            bodies = [o.body for o in out if o.topic == topic and o.body.valid]
            time_s = np.array([(convert.time_ns(b.timestamp) - EPOCH) * 1e-9 for b in bodies])
            bodies, time_s = [b for b, t in zip(bodies, time_s, strict=True) if t > 50.0], time_s[time_s > 50.0]
            true = f.motion.at(time_s)
            R_lb = frame.R_ln_at(np.degrees(true.lat), np.degrees(true.lon)) @ true.R_nb
            at = frame.from_geodetic(np.degrees(true.lat), np.degrees(true.lon), true.height_m) + R_lb @ camera
            swing = (R_lb @ np.cross(f.motion.felt(time_s)[0], camera)[..., None])[..., 0]
            moves = (R_lb @ np.swapaxes(true.R_nb, 1, 2) @ true.velocity_n[..., None])[..., 0] + swing
            found = np.array([(b.pose.position.x, b.pose.position.y, b.pose.position.z) for b in bodies])
            speed = np.array([(b.velocity.x, b.velocity.y, b.velocity.z) for b in bodies])
            worst[topic, bool(arm.any())] = np.abs(found - at).max(), np.abs(speed - moves).max()
    for topic in TOPICS:
        assert worst[topic, True][0] < 0.06 and worst[topic, True][1] < 0.03
        assert worst[topic, False][0] > 0.15
