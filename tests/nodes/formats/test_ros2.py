"""ROS 2 bags as flights: both storages, folders and files, compressed, damaged; what is not imported is named."""

from __future__ import annotations

import warnings
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from triline.nodes.cli import main
from triline.nodes.errors import UserError
from triline.nodes.formats.detect import Options, kind_of_path, read_any
from triline.nodes.formats.ros2 import inertial_messages
from triline.nodes.recording.reader import RecordingReader
from triline.schemas.topics import rank
from triline.solver.navigation.inertial_data import TACTICAL

STORE = get_typestore(Stores.ROS2_HUMBLE)
MCAP, SQLITE = StoragePlugin.MCAP, StoragePlugin.SQLITE3
START_NS, STEP_NS = 1_700_000_000 * 10**9, 10**7
IMU, FIX, IMAGE = (f"sensor_msgs/msg/{name}" for name in ("Imu", "NavSatFix", "Image"))
STRING = "std_msgs/msg/String"
QUARTER = np.radians(30) / 2  # level, turned 30 deg to the left of east: heading 60 deg


def _type(name, *values, **named):
    return STORE.types[name](*values, **named)


def _header(time_ns, frame):
    return _type("std_msgs/msg/Header", _type("builtin_interfaces/msg/Time", *divmod(time_ns, 10**9)), frame)


def imu(time_ns, *, orientation_known=True, covariance_known=True, measured=True, noise_known=True):
    variance = np.diag([1e-4, 2e-4, 4e-4]) if covariance_known else np.zeros((3, 3))
    unknown = np.full(9, -1.0)
    return _type(
        IMU,
        _header(time_ns, "imu"),
        _type("geometry_msgs/msg/Quaternion", 0.0, 0.0, np.sin(QUARTER), np.cos(QUARTER)),
        variance.ravel() if orientation_known else unknown,
        _type("geometry_msgs/msg/Vector3", 0.1, 0.2, 0.3),
        np.eye(3).ravel() * 1e-6 * noise_known if measured else unknown,
        _type("geometry_msgs/msg/Vector3", 1.0, 2.0, 9.81),
        np.eye(3).ravel() * 1e-2 * noise_known if measured else unknown,
    )


def fix(time_ns, height_m, *, status=0, covariance_type=2):
    state = _type("sensor_msgs/msg/NavSatStatus", status=status, service=1)
    variance = np.diag([1.0, 4.0, 9.0]).ravel()
    return _type(FIX, _header(time_ns, "gps"), state, 48.1, 11.5, height_m, variance, covariance_type)


def image(time_ns):
    return _type(IMAGE, _header(time_ns, "camera"), 2, 3, "mono8", 0, 3, np.arange(6, dtype=np.uint8))


def write_bag(folder: Path, messages, storage=MCAP, compression: CompressionMode | None = None) -> Path:
    """A bag folder of (topic, log time, message or bytes with their type); returns the folder."""
    writer = Writer(folder, version=9, storage_plugin=storage)
    if compression is not None:
        writer.set_compression(compression, CompressionFormat.ZSTD)
    with writer:
        connections = {}
        for topic, time_ns, message in messages:
            data, kind = message if isinstance(message, tuple) else (None, message.__msgtype__)
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=STORE)
            writer.write(connections[topic], time_ns, STORE.serialize_cdr(message, kind) if data is None else data)
    return folder


def flight_of(n=20):
    """Inertial data at 100 Hz, of which one message is cut, fixes at 20 Hz of which the first is none, and images."""
    for i in range(n):
        t = START_NS + i * STEP_NS
        if i == 7:
            yield "/imu", t, (bytes(STORE.serialize_cdr(imu(t), IMU))[:40], IMU)
        else:
            yield "/imu", t, imu(t)
        if i % 5 == 0:
            yield "/fix", t, fix(t, 600.0 + i, status=-1 if i == 0 else 0)
            yield "/camera", t, image(t)
        if i == 0:
            yield "/fix2", t, fix(t, 0.0)


def by_topic(messages):
    return {t: [m for m in messages if m.topic == t] for t in ("sensor/imu", "sensor/attitude", "sensor/gnss")}


BAGS = {
    "MCAP folder": (MCAP, None, ""),
    "MCAP folder, compressed": (MCAP, CompressionMode.STORAGE, ""),
    "MCAP folder, messages compressed": (MCAP, CompressionMode.MESSAGE, ""),
    "MCAP file": (MCAP, None, "bag.mcap"),
    "MCAP file, compressed": (MCAP, CompressionMode.STORAGE, "bag.mcap"),
    "db3 folder": (SQLITE, None, ""),
    "db3 folder, compressed": (SQLITE, CompressionMode.FILE, ""),
    "db3 folder, messages compressed": (SQLITE, CompressionMode.MESSAGE, ""),
    "db3 file": (SQLITE, None, "bag.db3"),
}


@pytest.mark.parametrize("bag", BAGS)
def test_every_kind_of_bag_gives_the_same_flight_in_our_frames(tmp_path, bag):
    storage, compression, file = BAGS[bag]
    path = write_bag(tmp_path / "bag", flight_of(), storage, compression) / file
    assert kind_of_path(path) == "ros2"
    imported = read_any(path)
    messages = list(imported.messages)
    found = by_topic(messages)
    assert [len(v) for v in found.values()] == [19, 19, 3]
    imus = [m.body for m in found["sensor/imu"]]
    # specific force and rate: forward-left-up to forward-right-down
    assert (imus[1].force_x, imus[1].force_y, imus[1].force_z) == (1.0, -2.0, -9.81)
    assert (imus[1].rate_x, imus[1].rate_y, imus[1].rate_z) == (0.1, -0.2, -0.3)
    assert imus[1].rate_sigma == pytest.approx(1e-3) and imus[1].force_sigma == pytest.approx(0.1)
    assert [i.interval_ns for i in imus[:2]] == [0, STEP_NS] and imus[7].interval_ns == 2 * STEP_NS
    attitude = found["sensor/attitude"][0].body
    assert np.degrees([attitude.roll, attitude.pitch, attitude.heading]) == pytest.approx([0, 0, 60])
    assert [attitude.covariance[i] for i in (0, 4, 8)] == pytest.approx([1e-4, 2e-4, 4e-4])
    first = found["sensor/gnss"][0].body
    assert (first.latitude, first.longitude, first.altitude) == (48.1, 11.5, 605.0)
    assert [first.position_covariance[i] for i in (0, 4, 8)] == pytest.approx([1, 4, 9])
    assert sorted(imported.notes) == [
        "/fix: messages left out: 1 without a fix",
        "/imu: messages left out: 1 not decodable",
        f"{path.name}: not imported: 1 {FIX} of /fix2",
        "no camera given (--camera): recorded without configuration/camera, image lines cannot be matched",
    ]
    blocks = [m.body for m in messages if m.topic == "sensor/lines/camera"]
    assert [(b.first_line, b.time_ns - START_NS) for b in blocks] == [(2 * i, 5 * i * STEP_NS) for i in range(4)]
    stamps = [(message.stamp_ns, rank(message.topic)) for message in messages]
    assert stamps == sorted(stamps) and messages[0].topic == "configuration/project"
    assert messages[0].body.origin_latitude == 48.1


def test_intervals_go_on_over_batches_and_times_that_go_back_are_left_out(tmp_path, monkeypatch):
    monkeypatch.setattr("triline.nodes.formats.ros2._BATCH", 3)
    times = [0, 1, 2, 3, 2, 4, 4, 5, 6, 7, 9]
    bag = write_bag(
        tmp_path / "bag", [("/imu", START_NS + i, imu(START_NS + t * STEP_NS)) for i, t in enumerate(times)]
    )
    imported = read_any(bag)
    imus = [m.body for m in imported.messages if m.topic == "sensor/imu"]
    assert [(i.time_ns - START_NS) // STEP_NS for i in imus] == [0, 1, 2, 3, 4, 5, 6, 7, 9]
    assert [i.interval_ns // STEP_NS for i in imus] == [0, 1, 1, 1, 1, 1, 1, 1, 2]
    assert "/imu: messages left out: 2 not later than the one before" in imported.notes
    assert any("no GNSS fix" in note for note in imported.notes)


@pytest.mark.parametrize("at_once", [1, 4096])
def test_an_interval_does_not_reach_over_lost_messages(at_once):
    """Of what was lost nothing was measured: the navigator is to see a gap, and not a sample of 0.8 s."""
    steady = np.full(60, STEP_NS)
    lost = steady.copy()
    lost[[20, 40, 41]] = [80 * STEP_NS, 2 * STEP_NS, 3 * STEP_NS]
    bursts = np.tile([STEP_NS // 10, STEP_NS // 10, 28 * STEP_NS // 10], 20)  # of three, as over a slow port
    torn = bursts.copy()
    torn[29] = 60 * STEP_NS
    slower = np.repeat([STEP_NS, 4 * STEP_NS], 30)  # by a setting
    for steps, wanted in (
        (steady, steady),
        (lost, steady),
        (bursts, bursts),
        (torn, np.where(torn > 10 * STEP_NS, STEP_NS, torn)),
        (slower, np.where(np.arange(60) < 33, STEP_NS, 4 * STEP_NS)),
    ):
        times = START_NS + np.concatenate([[0], np.cumsum(steps)])
        payloads = [bytes(STORE.serialize_cdr(imu(t), IMU)) for t in times.tolist()]
        found = inertial_messages(payloads, "/imu", [], "test", at_once=at_once)
        intervals = np.array([m.body.interval_ns for m in found if m.topic == "sensor/imu"])
        assert intervals[0] == 0 and np.abs(intervals[1:] - wanted).max() <= 0.25 * STEP_NS


@pytest.mark.parametrize("huge", [1e200, np.inf, np.nan])
def test_numbers_of_no_orientation_and_no_noise_are_left_out_without_a_warning(tmp_path, huge):
    spoilt = imu(START_NS)
    spoilt.orientation.x = huge
    spoilt.angular_velocity_covariance[:] = 1e308 if huge == 1e200 else huge
    imported = read_any(
        write_bag(tmp_path / "bag", [("/imu", START_NS, spoilt), ("/imu", START_NS + STEP_NS, imu(START_NS + STEP_NS))])
    )
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        found = by_topic(list(imported.messages))
    assert [x.stamp_ns for x in found["sensor/attitude"]] == [START_NS + STEP_NS]
    assert found["sensor/imu"][0].body.rate_sigma == 0.0
    assert "/imu: messages left out: 1 with an orientation whose quaternion has not the length 1" in imported.notes


def test_a_quaternion_of_zeros_is_no_orientation(tmp_path):
    """That of a sensor which measures none is nothing to tell; one of another length was left out as silently, and the
    one that a message begins with was an aircraft that flies east."""
    samples = [imu(START_NS + i * STEP_NS, covariance_known=i < 4) for i in range(5)]
    samples[4].orientation.z, samples[4].orientation.w = 0.0, 1.0
    for i, length in enumerate((0.0, 0.998, 0.998)):
        q = samples[i].orientation
        q.z, q.w = length * q.z, length * q.w
    imported = read_any(write_bag(tmp_path / "bag", [("/imu", s.header.stamp.nanosec, s) for s in samples]))
    found = by_topic(list(imported.messages))
    assert len(found["sensor/attitude"]) == 1 and len(found["sensor/imu"]) == 5
    assert "/imu: messages left out: 2 with an orientation whose quaternion has not the length 1" in imported.notes


def test_values_that_no_aircraft_has_are_left_out_as_of_other_sensors(tmp_path):
    t = [START_NS + i * STEP_NS for i in range(6)]
    samples, fixes = [imu(time) for time in t], [fix(time, 1.0) for time in t]
    samples[1].linear_acceleration.x = 9806.65  # in mm/s^2
    samples[2].angular_velocity.z = np.nan
    samples[3].orientation = _type("geometry_msgs/msg/Quaternion", 1.0, 0.0, 0.0, 0.0)  # on its back
    samples[4].orientation_covariance[:] = np.inf
    fixes[0].latitude = 4810.0  # degrees and minutes
    fixes[3].altitude = np.nan
    fixes[5].latitude = fixes[5].longitude = 0.0  # of a receiver without a fix, whatever its status says
    bag = [
        *(("/imu", s.header.stamp.nanosec, s) for s in samples),
        *(("/fix", f.header.stamp.nanosec, f) for f in fixes),
    ]
    imported = read_any(write_bag(tmp_path / "bag", bag))
    messages = list(imported.messages)
    found = by_topic(messages)
    assert [(x.stamp_ns - START_NS) // STEP_NS for x in found["sensor/imu"]] == [0, 3, 4, 5]
    assert [(x.stamp_ns - START_NS) // STEP_NS for x in found["sensor/attitude"]] == [0, 1, 2, 4, 5]
    assert np.isfinite([x.body.covariance[0] for x in found["sensor/attitude"]]).all()
    assert [(x.stamp_ns - START_NS) // STEP_NS for x in found["sensor/gnss"]] == [1, 2, 4]
    assert messages[0].topic == "configuration/project"
    assert messages[0].body.origin_latitude == 48.1  # of the first fix that can be one
    assert "/imu: messages left out: 3 with values that no aircraft has" in imported.notes
    assert "/fix: messages left out: 3 with values that no aircraft has" in imported.notes


def test_what_a_message_does_not_know_is_left_out_or_assumed_with_a_note(tmp_path):
    t = [START_NS + i * STEP_NS for i in range(5)]
    samples = [
        imu(t[0]), imu(t[1], orientation_known=False), imu(t[2], covariance_known=False), imu(t[3], measured=False)
    ]  # fmt: skip
    samples.append(imu(t[4]))
    samples[4].orientation.w = 0.0  # no rotation
    bag = [*(("/imu", m.header.stamp.nanosec, m) for m in samples), ("/fix", t[0], fix(t[0], 1.0, covariance_type=0))]
    imported = read_any(write_bag(tmp_path / "bag", bag, SQLITE))
    found = by_topic(list(imported.messages))
    assert [(m.stamp_ns - START_NS) // STEP_NS for m in found["sensor/imu"]] == [0, 1, 2, 4]
    assert [(m.stamp_ns - START_NS) // STEP_NS for m in found["sensor/attitude"]] == [0, 2, 3]
    assert [found["sensor/attitude"][1].body.covariance[i] for i in (0, 4, 8)] == pytest.approx([1e-4, 1e-4, 9e-4])
    assert [found["sensor/gnss"][0].body.position_covariance[i] for i in (0, 4, 8)] == [25.0, 25.0, 100.0]
    notes = " | ".join(imported.notes)
    assert "/imu: orientations without covariance: 1, taken with sigmas of 0.6 deg and 1.7 deg in heading" in notes
    assert "/fix: fixes without covariance: 1, taken with sigmas of 5 m and 10 m in height" in notes


@pytest.mark.parametrize("noise_known", [True, False])
def test_samples_without_noise_get_that_of_the_unit_that_is_given(tmp_path, noise_known):
    """As `triline fly` does; else the navigator would take any unit for a MEMS unit."""
    times = [START_NS + i * STEP_NS for i in range(9)]
    path = write_bag(tmp_path / "bag", [("/imu", t, imu(t, noise_known=noise_known)) for t in times])
    bodies = [m.body for m in read_any(path, options=Options(grade=TACTICAL)).messages if m.topic == "sensor/imu"]
    assert len(bodies) == 9
    wanted = (1e-3, 0.1) if noise_known else (10 * TACTICAL.gyro_noise, 10 * TACTICAL.accel_noise)  # at 100 Hz
    for body in bodies[1:]:
        assert (body.rate_sigma, body.force_sigma) == pytest.approx(wanted)
    plain = [m.body for m in read_any(path).messages if m.topic == "sensor/imu"]
    assert all((body.rate_sigma > 0) == noise_known for body in plain)


def test_an_mcap_file_that_was_cut_is_imported_as_far_as_it_is_whole(tmp_path):
    whole = write_bag(tmp_path / "bag", flight_of(8000)) / "bag.mcap"
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(whole.read_bytes()[: whole.stat().st_size // 2])
    imported = read_any(cut)
    imus = [m.body for m in imported.messages if m.topic == "sensor/imu"]
    assert 1000 < len(imus) < 7000
    assert {b.time_ns - a.time_ns for a, b in pairwise(imus[7:])} == {STEP_NS}
    assert imported.notes[0].startswith("cut.mcap: damaged, ")


def test_bags_that_cannot_be_read_get_one_line(tmp_path, capsys):
    out = tmp_path / "out.mcap"
    bag = write_bag(tmp_path / "bag", flight_of(300), SQLITE)
    data = (bag / "bag.db3").read_bytes()
    (tmp_path / "cut.db3").write_bytes(data[: len(data) // 2])
    broken = bytearray(data)
    broken[len(data) // 3 : len(data) // 2] = bytes(len(data) // 2 - len(data) // 3)
    (tmp_path / "broken.db3").write_bytes(broken)
    bare = tmp_path / "bare"
    bare.mkdir()
    (bare / "metadata.yaml").write_text("rosbag2_bagfile_information: {version: 9}\n")
    foreign = write_bag(tmp_path / "foreign", [("/told", START_NS, _type(STRING, "a"))]) / "foreign.mcap"
    expected = {
        tmp_path / "cut.db3": "not a whole ROS 2 bag: ",
        tmp_path / "broken.db3": "not a whole ROS 2 bag: ",
        bare: "not a whole ROS 2 bag: A metadata key is missing",
        foreign: f"no usable {FIX}, {IMU} or {IMAGE}; foreign.mcap: not imported: 1 {STRING} of /told",
    }
    for path, said in expected.items():
        assert main(["import", str(path), "-o", str(out)]) == 1
        (line,) = capsys.readouterr().err.strip().splitlines()
        assert f"{path}: {said}" in line and not out.exists()
    with pytest.raises(UserError, match=r"none of block folder .* sensor folder .* and ROS 2 bag"):
        read_any(tmp_path)


def test_a_bag_through_the_command_line_becomes_a_recording(tmp_path, capsys):
    out = tmp_path / "out.mcap"
    bag = write_bag(tmp_path / "bag", flight_of(), SQLITE)
    assert main(["import", str(bag), "-o", str(out), "--camera", "si-100"]) == 0
    said = capsys.readouterr().out
    assert "sensor/imu" in said
    assert f"note: bag: not imported: 4 {IMAGE} of /camera; --lines F=/camera takes its rows as image lines" in said
    assert [m.topic for m in RecordingReader(out).sorted_messages()][:2] == [
        "configuration/project", "configuration/camera"
    ]  # fmt: skip
    assert main(["import", str(out), "-o", str(tmp_path / "again.mcap")]) == 1
    assert "is a triline recording already" in capsys.readouterr().err
