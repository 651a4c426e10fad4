"""Bad input and what it gets: the table of the contract, row by row, from outside.

What stands elsewhere is not repeated here:

=====================================================  ================================================================
row                                                    tests
=====================================================  ================================================================
message with NaN, wrong size, unknown version,         here: every node on one bus, every topic; counts of one topic:
time going backwards                                   test_bus (bad messages are counted ...); nodes by themselves:
                                                       test_navigator_node, test_adjuster_node, test_viewer; payloads:
                                                       test_topics (cut payloads), test_recording (envelopes, lines)
GNSS outage, gap, jump, duplicate, 2 s out of order    here: through `process`; filter: test_kinematic,
                                                       test_navigator_node; inertial data: test_inertial_navigator,
                                                       test_navigation, test_inertial_checks, test_navigation_kitti
20 % outlier tie points; unknown CCD, outside strip    here: through `process`; window over seeds: test_window (outliers
                                                       are found ...); batch: test_snooping, test_adjust_command
too few points, no control, degenerate geometry,       here: `adjust` and `process` as commands; batch:
unknowns correlated to 1                               test_weak_networks, test_determinability; on line: test_window
node killed, frozen, restarted                         test_kill (killed in turn, frozen navigator), test_demo; here:
                                                       frozen recorder and adjuster
recorder's disk full                                   here: a real recorder without room; test_kill (at every byte)
truncated, bit-flipped, foreign recording              test_recording, test_cli_recording; here: what `process`, `info`
                                                       and `recover` make of one whose head is lost
block and sensor folders, other formats                test_block_folder, test_damaged_files, test_imports,
                                                       test_camera_json
=====================================================  ================================================================
"""

from __future__ import annotations

import signal
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import sample_messages as sample
import zenoh
from bus_rig import TRILINE, Rig, here, simulated_flight, wait_for, wait_for_nodes

from triline.nodes import convert
from triline.nodes.adjuster.adjuster import Adjuster
from triline.nodes.bus.session import Bus, configuration
from triline.nodes.navigator.navigator import Navigator
from triline.nodes.recorder.recorder import RETRY_S
from triline.nodes.recording.reader import RecordingReader
from triline.nodes.recording.runner import ProcessSummary, process
from triline.nodes.recording.writer import RecordingWriter
from triline.schemas import codec
from triline.schemas.envelope import Envelope, RawMessage, pack
from triline.schemas.topics import TOPICS

# ---- messages: every node on one bus


def _not_finite(topic: str) -> bytes | None:
    """A payload of the topic with a NaN in its first floating-point field, None if it has none."""
    body = sample.body(topic)
    if not hasattr(body, "DESCRIPTOR"):
        return None
    for field in body.DESCRIPTOR.fields:
        if field.cpp_type in (field.CPPTYPE_DOUBLE, field.CPPTYPE_FLOAT):
            if field.is_repeated:
                getattr(body, field.name)[:] = [float("nan")]
            else:
                setattr(body, field.name, float("nan"))
            return body.SerializeToString()
    return None


def _bad_payloads(topic: str) -> list[bytes]:
    good = codec.encode(sample.body(topic))
    cut = good[: len(good) // 2]
    return [p for p in (b"\xff" * 40, cut, b"\x0a\xff\xff\xff\xff\x0f", _not_finite(topic)) if p is not None]


def test_every_node_survives_rubbish_on_every_topic_and_counts_it(tmp_path):
    with Rig(tmp_path) as rig, Bus(port=rig.port, source="test") as bus:
        nodes = {
            "recorder": rig.start("node", "recorder", "-o", tmp_path / "a.mcap"),
            "navigator": rig.start("node", "navigator"),
            "adjuster": rig.start("node", "adjuster"),
            "viewer": rig.start("node", "viewer", "--set", f"mode=rrd:{tmp_path / 'a.rrd'}"),
            "monitor": rig.start("node", "monitor"),
        }
        status: dict = {}
        bus.subscribe("status/*", lambda raw: status.update({raw.topic.split("/")[1]: raw.data}))
        session = zenoh.open(configuration(rig.port))
        wait_for_nodes(bus, *(name for name in nodes if name != "monitor"))
        wait_for(lambda: bus.alive() >= set(nodes), 40, "the nodes")
        alive = bus.key("alive/*")  # who is seen to live has told what it listens to before
        wait_for(lambda: len(list(session.liveliness().get(alive))) >= len(nodes), 40, "the nodes, there too")
        stamp, sent = sample.EPOCH_NS, 0
        for row in TOPICS:
            topic = row.name.replace("*", "x")
            good = codec.encode(sample.body(topic))
            key = bus.key(topic)
            session.put(key, good)  # no envelope
            session.put(key, good, attachment=b"\x63" + pack(Envelope(stamp, "test", 0))[1:])  # unknown version
            session.put(key, good, attachment=pack(Envelope(stamp, "test", 0))[:9])
            for i, payload in enumerate((good, *_bad_payloads(topic), good, good)):
                # the last two: an hour back, and far ahead
                hours = {0: 0, len(_bad_payloads(topic)) + 1: -1, len(_bad_payloads(topic)) + 2: 10_000}.get(i, 0)
                envelope = Envelope(stamp + i + hours * 3_600_000_000_000, "test", i, 1)
                bus.publish_raw(RawMessage(topic, envelope, payload))
                sent += 1
        session.put(bus.key("sensor/unknown"), b"", attachment=pack(Envelope(stamp, "test", 0)))

        def malformed(node: str) -> int:
            return (
                sum(t.malformed for t in codec.decode(f"status/{node}", status[node]).topics) if node in status else 0
            )

        for node in ("navigator", "adjuster"):
            wait_for(lambda node=node: malformed(node) >= 3 * 6, 10, f"the counts of the {node}")
        for name in nodes:
            if name != "monitor":
                problem = lambda name=name: codec.decode(f"status/{name}", status[name]).last_problem  # noqa: E731
                wait_for(problem, 10, f"what the {name} says of it")
        for name, process_ in nodes.items():
            assert process_.poll() is None, rig.log(name)
        session.close()
        for name, process_ in nodes.items():
            assert rig.stop(process_) == 0, rig.log(name)
            assert "Traceback" not in rig.log(name) and "failed" not in rig.log(name), rig.log(name)
    reader = RecordingReader(tmp_path / "a.mcap")
    assert reader.damage == [] and len(reader.index) > 20


# ---- sensors: a doctored recording through the nodes

RATE_NS = 1_000_000_000


@dataclass
class Run:
    """What `process` made of a recording."""

    summary: ProcessSummary
    outputs: list[RawMessage]
    start_ns: int

    def poses(self, topic: str) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[str]]:
        """Seconds of flight, positions, valid, reasons."""
        bodies = [codec.decode(raw.topic, raw.data) for raw in self.outputs if raw.topic == topic]
        t = np.array([convert.time_ns(b.timestamp) - self.start_ns for b in bodies]) / RATE_NS
        xyz = np.array([(b.pose.position.x, b.pose.position.y, b.pose.position.z) for b in bodies])
        return t, xyz, np.array([b.valid for b in bodies]), [b.reason for b in bodies]

    def bodies(self, topic: str) -> list:
        return [codec.decode(raw.topic, raw.data) for raw in self.outputs if raw.topic == topic]

    def errors(self, topic: str, first_s: float, last_s: float) -> np.ndarray:
        """RMSE of positions against the truth, (3,)."""
        t, xyz, _, _ = self.poses(topic)
        truth_t, truth, _, _ = self.poses("truth/trajectory")
        chosen = (t >= first_s) & (t <= last_s)
        true = np.column_stack([np.interp(t[chosen], truth_t, truth[:, axis]) for axis in range(3)])
        return np.sqrt(np.mean((xyz[chosen] - true) ** 2, axis=0))


Change = Callable[[RawMessage, float], list[RawMessage]]


def _doctored(recording: Path, path: Path, change: Change) -> Run:
    """Run a recording with every message changed; numbers stay whole, as if the sensor had done it."""
    reader = RecordingReader(recording)
    raws = [reader.raw(int(n)) for n in reader.sort(reader.select())]
    start_ns = next(raw.envelope.stamp_ns for raw in raws if raw.topic in ("sensor/attitude", "sensor/imu"))
    numbers: dict[str, int] = {}
    with RecordingWriter(path) as writer:
        for raw in raws:
            for out in change(raw, (raw.envelope.stamp_ns - start_ns) / RATE_NS):
                if out.envelope.sequence >= 0:
                    numbers[raw.topic] = numbers.get(raw.topic, -1) + 1
                number = numbers[raw.topic]  # below 0: the message before once more
                writer.write_raw(out._replace(envelope=out.envelope._replace(sequence=number)))
    outputs: list[RawMessage] = []
    # when updates come is not asked for, nor all of the 100 filtered poses a second
    nodes = [Navigator(filtered_s=0.05), Adjuster(update_s=1.0, update_rays=1000)]
    summary = process(RecordingReader(path), nodes, outputs.append)
    assert not any("failed" in counters for counters in summary.counters.values()), summary.problems
    return Run(summary, outputs, start_ns)


@pytest.fixture(scope="module")
def fly(tmp_path_factory):
    """Runs a flight of 28 s with a strip from 10 to 22 s, changed."""
    folder = tmp_path_factory.mktemp("doctored")
    return lambda name, change: _doctored(simulated_flight(12, 100), folder / f"{name}.mcap", change)


@pytest.fixture(scope="module")
def clean(fly) -> Run:
    run = fly("clean", lambda raw, t: [raw])
    assert run.summary.counters == {"navigator": {}, "adjuster": {}} and not run.summary.dropped
    return run


def test_a_pose_before_its_velocity_is_known_is_not_valid(clean):
    t, _, valid, reasons = clean.poses("trajectory/filtered")
    assert not valid[t < 0.15].any() and "sigma" in reasons[1]
    assert valid[t > 1.0].all()


def test_an_outage_of_gnss_is_coasted_flagged_and_left_behind(fly, clean):
    gone = fly("outage", lambda raw, t: [] if raw.topic == "sensor/gnss" and 13 < t < 21 else [raw])
    assert gone.summary.counters["navigator"]["gnss outage"] == 1
    for topic in ("trajectory/filtered", "orientation/live"):
        t, _, valid, reasons = gone.poses(topic)
        assert (np.diff(t) < 0.11).all()  # it coasts: no pose is missing
        inside = (t > 15.6) & (t < 20.9)
        assert inside.sum() > 20 and not valid[inside].any()
        assert all("GNSS" in reasons[i] for i in np.flatnonzero(inside))
        assert valid[((t > 1) & (t < 13)) | (t > 21.5)].all()
    t, _, valid, _ = gone.poses("orientation/final")
    # smoothing bridges an outage from both ends as far as it says
    assert not valid[(t > 15.6) & (t < 18.4)].any() and valid[(t < 13) | (t > 21.5)].all()
    events = [body.message for body in gone.bodies("event/log")]
    assert any("coasting" in text for text in events) and "GNSS is back" in events
    after = gone.errors("trajectory/filtered", 22, 26), clean.errors("trajectory/filtered", 22, 26)
    np.testing.assert_allclose(*after, atol=0.05)


def test_a_gap_in_the_attitude_is_counted_and_left_behind(fly, clean):
    gap = fly("gap", lambda raw, t: [] if raw.topic == "sensor/attitude" and 13 < t < 14 else [raw])
    assert gap.summary.counters["navigator"]["attitude gap"] == 1
    assert any("attitude gap of 1.0" in body.message for body in gap.bodies("event/log"))
    t = gap.poses("orientation/live")[0]
    assert not ((t > 13.1) & (t < 13.9)).any()  # nothing is made up where nothing was measured
    bound = 1.1 * clean.errors("orientation/final", 15, 21) + 0.02
    assert (gap.errors("orientation/final", 15, 21) < bound).all()


def _shifted(raw: RawMessage, north_m: float) -> RawMessage:
    body = codec.decode(raw.topic, raw.data)
    body.latitude += north_m / 111_200.0
    return raw._replace(data=codec.encode(body))


def test_a_position_that_jumps_is_refused_and_named(fly, clean):
    jump = fly("jump", lambda raw, t: [_shifted(raw, 50.0) if raw.topic == "sensor/gnss" and 14.9 < t < 15.1 else raw])
    assert jump.summary.counters["navigator"] == {"gnss refused": 1}
    assert any("off by 50.0 m refused" in body.message for body in jump.bodies("event/log"))
    np.testing.assert_allclose(
        jump.errors("orientation/final", 10.1, 21.9), clean.errors("orientation/final", 10.1, 21.9), atol=0.02
    )


def test_repeated_messages_change_nothing(fly, clean):
    """Once by their number, as the bus would repeat them, once by their content, as a sensor would."""

    def twice(raw: RawMessage, t: float) -> list[RawMessage]:
        if raw.topic not in ("sensor/gnss", "sensor/attitude") or not 12 < t < 14:
            return [raw]
        again = raw._replace(envelope=raw.envelope._replace(sequence=-1))
        return [raw, again] if t < 13 else [raw, raw]

    both = fly("twice", twice)
    assert both.summary.dropped["duplicate"] > 100
    assert both.summary.counters["navigator"]["attitude duplicate"] >= 99
    assert both.summary.counters["navigator"]["gnss duplicate"] >= 4
    for topic in ("trajectory/filtered", "orientation/final"):
        for one, two in zip(both.poses(topic)[:2], clean.poses(topic)[:2], strict=True):
            np.testing.assert_array_equal(one, two)


@pytest.mark.study
def test_positions_two_seconds_out_of_order(fly, clean):
    """Late by what the filter looks back they are filtered in; later, or against the order of stamps, they are left."""

    held: dict[int, bytes | memoryview] = {}

    def late(raw: RawMessage, t: float) -> list[RawMessage]:
        number = round(5 * t)
        if raw.topic != "sensor/gnss":
            return [raw]
        if number in (62, 75):
            held[number] = raw.data
            return []
        comes = {62 + 9: 62, 75 + 13: 75}.get(number)  # 1.8 s and 2.6 s after it was measured
        return [raw] if comes is None else [raw, raw._replace(data=held[comes])]

    mixed = fly("late", late)
    assert mixed.summary.counters["navigator"] == {"gnss late": 1, "gnss too late": 1}
    assert mixed.poses("trajectory/filtered")[2][20:].all()
    np.testing.assert_allclose(
        mixed.errors("orientation/final", 10.1, 21.9), clean.errors("orientation/final", 10.1, 21.9), atol=0.05
    )

    def backwards(raw: RawMessage, t: float) -> list[RawMessage]:
        if raw.topic == "sensor/gnss" and 14.9 < t < 15.1:
            return [raw._replace(envelope=raw.envelope._replace(stamp_ns=raw.envelope.stamp_ns - 2 * RATE_NS))]
        return [raw]

    back = fly("backwards", backwards)
    assert back.summary.dropped == {"malformed": 1}
    assert "time goes back by 1.8 s" in back.summary.last_problems["malformed"]
    np.testing.assert_allclose(
        back.errors("orientation/final", 10.1, 21.9), clean.errors("orientation/final", 10.1, 21.9), atol=0.02
    )


# ---- tie points


@pytest.mark.study
def test_a_fifth_of_the_rays_being_blunders_is_rejected_and_named(tmp_path):
    """What is compared is the same flight with those rays never measured."""
    rng = np.random.default_rng(21)
    blunders: set[tuple[str, str]] = set()
    impossible: dict[str, set[str]] = {"unknown ccd": set(), "outside strip": set()}
    rays = 0

    def spoil(raw: RawMessage, t: float) -> list[RawMessage]:
        nonlocal rays
        if raw.topic != "observation/tie":
            return [raw]
        body = codec.decode(raw.topic, raw.data)
        for image in body.images:
            rays += 1
            if rng.random() < 0.2:
                blunders.add((body.point, image.ccd))
                size, direction = rng.uniform(5.0, 40.0), rng.uniform(0, 2 * np.pi)
                image.line += size * np.cos(direction)
                image.sample = float(np.clip(image.sample + size * np.sin(direction), 0, 11_999))
        if body.point.endswith("3"):
            body.images.add(strip="S1", ccd="Q", line=1000.0, sample=6000.0, time_ns=raw.envelope.stamp_ns)
            body.images.add(strip="S1", ccd="N", line=9e6, sample=6000.0, time_ns=raw.envelope.stamp_ns)
            for points in impossible.values():
                points.add(body.point)
        return [raw._replace(data=codec.encode(body))]

    def leave_out(raw: RawMessage, t: float) -> list[RawMessage]:
        if raw.topic != "observation/tie":
            return [raw]
        body = codec.decode(raw.topic, raw.data)
        kept = [image for image in body.images if (body.point, image.ccd) not in blunders]
        del body.images[:]
        body.images.extend(kept)
        return [raw._replace(data=codec.encode(body))] if kept else []

    spoiled = _doctored(simulated_flight(26), tmp_path / "spoiled.mcap", spoil)
    without = _doctored(simulated_flight(26), tmp_path / "without.mcap", leave_out)
    assert 0.17 < len(blunders) / rays < 0.23
    rejected = [r for report in spoiled.bodies("adjustment/report") for r in report.rejected]
    for reason, points in impossible.items():
        assert len(points) > 5 and {r.point for r in rejected if r.reason == reason} == points
    found = {(r.point, r.ccd) for r in rejected if r.reason == "snooping"}
    assert len(found & blunders) > 0.75 * len(blunders)  # the others are alone on their point, or hide along the ray

    def point_errors(run: Run) -> dict[str, np.ndarray]:
        truth = {b.point: (b.x, b.y, b.z) for b in run.bodies("truth/point")}
        final = [b for b in run.bodies("point/object") if b.status == 1 and b.rays >= 3]
        return {b.point: np.array((b.x, b.y, b.z)) - truth[b.point] for b in final}

    one, two = point_errors(spoiled), point_errors(without)
    common = sorted(set(one) & set(two))
    assert len(common) > 0.9 * len(two) > 40
    rmse = [np.sqrt(np.mean([errors[point] ** 2 for point in common], axis=0)) for errors in (one, two)]
    assert (rmse[0] < 1.1 * rmse[1]).all()
    orientation = [np.linalg.norm(run.errors("orientation/final", 10.1, 35.9)) for run in (spoiled, without)]
    assert orientation[0] < 1.1 * orientation[1]


# ---- frozen nodes, full disks


@pytest.mark.study
def test_others_go_on_while_recorder_and_adjuster_are_frozen(tmp_path):
    """Both stand still for seconds and catch up; nobody who publishes waits for them."""
    with Rig(tmp_path) as rig, Bus(port=rig.port, source="listener") as bus:
        heard: dict[str, list[float]] = {}
        for name in ("sensor/attitude", "trajectory/filtered", "adjustment/report"):
            bus.subscribe(name, lambda raw: heard.setdefault(raw.topic, []).append(time.monotonic()))
        recorder = rig.start("node", "recorder", "-o", tmp_path / "a.mcap")
        adjuster, navigator = rig.start("node", "adjuster"), rig.start("node", "navigator")
        wait_for(lambda: bus.alive() >= {"recorder", "navigator", "adjuster"}, 40, "the nodes")
        replay = rig.start("replay", simulated_flight(90, 100), "--rate", 1.5, "--wait-for", "navigator,adjuster")
        wait_for(lambda: len(heard.get("adjustment/report", ())) > 3, 30, "reports")
        for process_ in (recorder, adjuster):
            process_.send_signal(signal.SIGSTOP)
        frozen = time.monotonic()
        time.sleep(3.0)
        for topic in ("sensor/attitude", "trajectory/filtered"):
            times = np.array([frozen, *(t for t in heard[topic] if t > frozen), frozen + 3.0])
            assert len(times) > 300 and np.diff(times).max() < 1.0, topic  # 150 a second; nobody waited for the frozen
        back = time.monotonic()
        for process_ in (recorder, adjuster):
            process_.send_signal(signal.SIGCONT)
        wait_for(lambda: sum(t > back for t in heard["adjustment/report"]) > 5, 10, "reports after the standstill")
        assert rig.stop(replay) == 0, rig.log("replay")
        assert [rig.stop(p) for p in (navigator, adjuster, recorder)] == [0, 0, 0], rig.log("recorder")
        for name in ("navigator", "adjuster", "recorder", "replay"):
            assert "Traceback" not in rig.log(name) and "FATAL" not in rig.log(name), rig.log(name)
    reader = RecordingReader(tmp_path / "a.mcap")
    assert reader.complete and reader.damage == []


@pytest.mark.skipif(not hasattr(__import__("resource"), "prlimit"), reason="needs prlimit")
def test_a_recorder_without_room_says_so_and_goes_on_when_there_is_room(tmp_path):
    """A real recorder whose files may not grow; the limit on the file stands for the end of the disk."""
    import resource

    with Rig(tmp_path) as rig, Bus(port=rig.port, source="listener") as bus:
        states: list[str] = []
        bus.subscribe("status/recorder", lambda raw: states.append(codec.decode(raw.topic, raw.data).state))
        heard: list[float] = []
        bus.subscribe("sensor/attitude", lambda raw: heard.append(time.monotonic()))
        # -B: of byte code there would be room for a part, too, and other tests would trip over that
        words = [sys.executable, "-B", *TRILINE[1:], "node", "recorder", "-o", str(tmp_path / "a.mcap")]
        recorder = rig.start_program(words, "recorder")
        wait_for(lambda: "recorder" in bus.alive(), 40, "the recorder")
        replay = rig.start("replay", simulated_flight(90, 100), "--rate", 1.5, "--wait-for", "navigator,adjuster")
        wait_for(lambda: len(heard) > 450, 30, "some chunks")
        whole = (tmp_path / "a.mcap").stat().st_size
        _, hard = resource.prlimit(recorder.pid, resource.RLIMIT_FSIZE)
        resource.prlimit(recorder.pid, resource.RLIMIT_FSIZE, (1000, hard))
        full = time.monotonic()
        wait_for(lambda: any(state.startswith("not recording: ") for state in states), 10, "the message")
        assert "a.mcap: file too large" in next(state for state in states if state.startswith("not recording"))
        time.sleep(RETRY_S + 0.5)  # it tries again, and fails again
        assert states[-1].startswith("not recording: ") and recorder.poll() is None
        before, since = np.diff([t for t in heard if t <= full]), np.diff([full, *(t for t in heard if t > full)])
        # the sensors notice nothing: a recorder that held them up would do so until it tries again
        assert since.max() < max(RETRY_S, 2.0 * before.max())
        resource.prlimit(recorder.pid, resource.RLIMIT_FSIZE, (hard, hard))
        wait_for(lambda: states[-1] == "recording", 10, "recording again")
        again = len(heard)
        wait_for(lambda: len(heard) > again + 100, 10, "what is recorded now")
        rig.stop(replay)
        assert rig.stop(recorder) == 1  # it did not keep everything, and says so
        assert "lost" in rig.log("recorder") and "Traceback" not in rig.log("recorder")
    first, second = RecordingReader(tmp_path / "a.mcap"), RecordingReader(tmp_path / "a_0001.mcap")
    assert first.damage == [] and first.size >= whole and len(first.select(["sensor/attitude"])) > 250
    assert second.damage == [] and second.complete and len(second.select(["sensor/attitude"])) > 50
    assert here("check", tmp_path / "a_0001.mcap") in (0, 1)
    assert here("recover", tmp_path / "a.mcap", "-o", tmp_path / "whole.mcap") == 0
    assert len(RecordingReader(tmp_path / "whole.mcap").index) == len(first.index)
