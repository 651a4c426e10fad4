"""ROS 2 over Zenoh: CDR made by rosbags, published under rmw_zenoh's keys, becomes `sensor/*`."""

from __future__ import annotations

import json
import threading
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
import zenoh
from bus_rig import free_port
from rosbags.typesys import Stores, get_typestore

from triline.nodes.convert import time_ns
from triline.nodes.errors import UserError
from triline.nodes.formats.image_lines import strip_name
from triline.nodes.formats.keys import Keys
from triline.nodes.formats.ros2 import fix_messages, inertial_messages
from triline.nodes.formats.ros2_images import image_rows
from triline.nodes.matcher.found_strips import FoundStrips
from triline.nodes.sensors.ros2 import LiveStrips, Ros2, Ros2Settings, key_expression
from triline.solver.matching.line_times import LineTimes

T = 1_795_339_670_000_000_000
#: Of ROS 2 Jazzy's sensor_msgs/msg/Imu; any hash is taken.
HASH = "RIHS01_7d9a00ff131080897a5ec7e26e315954b8eae3353c3f995c55faf71574000b5b"
ROS = get_typestore(Stores.ROS2_HUMBLE)
PIXELS = np.arange(24, dtype=np.uint16).reshape(4, 6) * 1000


def header(t: int, frame="body"):
    Time, Header = ROS.types["builtin_interfaces/msg/Time"], ROS.types["std_msgs/msg/Header"]
    return Header(Time(t // 10**9, t % 10**9), frame)


def cdr(message) -> bytes:
    return bytes(ROS.serialize_cdr(message, message.__msgtype__))


def fix(t: int, status=0) -> bytes:
    NavSatStatus, NavSatFix = ROS.types["sensor_msgs/msg/NavSatStatus"], ROS.types["sensor_msgs/msg/NavSatFix"]
    covariance = np.diag([0.01, 0.04, 0.09]).ravel()
    return cdr(NavSatFix(header(t), NavSatStatus(status, 1), 47.9, 11.1, 1500.0, covariance, 2))


def imu(t: int) -> bytes:
    Vector3, Quaternion = ROS.types["geometry_msgs/msg/Vector3"], ROS.types["geometry_msgs/msg/Quaternion"]
    level_to_the_north = Quaternion(0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5))  # forward-left-up against east-north-up
    none, small = np.zeros(9), np.diag([1e-6] * 3).ravel()
    rate, force = Vector3(0.01, 0.02, 0.03), Vector3(0.1, 0.2, 9.8)
    return cdr(ROS.types["sensor_msgs/msg/Imu"](header(t), level_to_the_north, small, rate, none, force, none))


def image(t: int, pixels=PIXELS, encoding="mono16", big=0, step=None) -> bytes:
    rows = pixels.astype(">u2" if big else "<u2").view(np.uint8).reshape(len(pixels), -1)
    step = step or rows.shape[1]
    rows = np.pad(rows, ((0, 0), (0, step - rows.shape[1])))
    Image = ROS.types["sensor_msgs/msg/Image"]
    return cdr(Image(header(t), *pixels.shape, encoding, big, step, rows.ravel()))


def settings(**table) -> Ros2Settings:
    return Ros2Settings.read(Keys(Path("flight.toml"), table, "sensor[0]"), Path())


def test_the_key_of_a_topic():
    key = "0/robot/imu/data/sensor_msgs::msg::dds_::Imu_/*"
    assert key_expression(0, "/robot/imu/data", "sensor_msgs/msg/Imu") == key


def test_topics_of_ros_nodes_become_sensor_messages():
    port, stop, n = free_port(), threading.Event(), 6
    config = zenoh.Config()
    config.insert_json5("listen/endpoints", json.dumps([f"tcp/127.0.0.1:{port}"]))
    config.insert_json5("scouting/multicast/enabled", "false")
    table = {"imu": "/imu/data", "fix": "/gps/fix", "images": {"N": "/camera/nadir"}, "line_rate_hz": 100.0}
    sensor = Ros2(settings(endpoint=f"tcp/127.0.0.1:{port}", domain=3, **table, clock_offset_s=0.5))
    keys = [
        f"3/{name}/sensor_msgs::msg::dds_::{kind}_/{HASH}"
        for name, kind in (("gps/fix", "NavSatFix"), ("imu/data", "Imu"), ("camera/nadir", "Image"))
    ]
    with zenoh.open(config) as ros:
        publishers = [ros.declare_publisher(key) for key in keys]
        come = sensor.messages(stop)
        while not all(publisher.matching_status.matching for publisher in publishers):
            assert next(come) is None
        for i in range(n):
            t = T + i * 40_000_000
            for publisher, payload in zip(publishers, (fix(t), imu(t), image(t)), strict=True):
                publisher.put(payload)
        publishers[0].put(b"\x00\x01\x00\x00rubbish")
        publishers[0].put(fix(T + 10**9, status=-1))
        ros.put(f"3/other/topic/std_msgs::msg::dds_::String_/{HASH}", b"123")
        wanted = {"sensor/gnss": n, "sensor/attitude": n, "sensor/imu": n - 1, "sensor/lines/N": n}
        messages = []
        while Counter(m.topic for m in messages) != wanted or sum(sensor.counters.values()) < 2:
            message = next(come)
            messages += [] if message is None else [message]
        stop.set()
        assert [m for m in come if m is not None] == []
    assert sensor.counters == {"not decodable": 1, "without a fix": 1}
    by_topic = {topic: [m for m in messages if m.topic == topic] for topic in wanted}
    utc = [T - 500_000_000 + i * 40_000_000 for i in range(n)]  # its clock is half a second ahead
    gnss = by_topic["sensor/gnss"][0]
    assert (gnss.body.latitude, gnss.body.longitude, gnss.body.altitude) == (47.9, 11.1, 1500.0)
    np.testing.assert_allclose(np.sqrt(gnss.body.position_covariance[::4]), [0.1, 0.2, 0.3])
    assert [m.stamp_ns for m in by_topic["sensor/gnss"]] == utc == [
        time_ns(m.body.timestamp) for m in by_topic["sensor/gnss"]
    ]  # fmt: skip
    b = by_topic["sensor/imu"][0].body  # forward, right, down
    np.testing.assert_allclose([b.force_x, b.force_y, b.force_z], [0.1, -0.2, -9.8])
    np.testing.assert_allclose([b.rate_x, b.rate_y, b.rate_z], [0.01, -0.02, -0.03])
    assert (b.time_ns, b.interval_ns) == (utc[1], 40_000_000)
    attitude = by_topic["sensor/attitude"][0].body
    np.testing.assert_allclose([attitude.roll, attitude.pitch, attitude.heading], 0.0, atol=1e-12)
    blocks = [m.body for m in by_topic["sensor/lines/N"]]
    assert [block.first_line for block in blocks] == list(range(0, 4 * n, 4)) and len({b.strip for b in blocks}) == 1
    np.testing.assert_array_equal(blocks[2].pixels, PIXELS)
    assert [block.time_ns for block in blocks] == utc and blocks[0].line_period_ns == 10_000_000
    assert by_topic["sensor/lines/N"][0].stamp_ns == utc[0] + 30_000_000


def test_images_with_padding_other_byte_order_and_gaps():
    given = settings(images={"N": "/c"}, line_rate_hz=100.0, strip="A")
    left_out: Counter[str] = Counter()
    step = 40_000_000
    come = [
        image(T, big=1, step=16),
        image(T + 2 * step + 3_000_000),  # one is lost, and this one has come a little late
        image(T + 3 * step, encoding="rgb8"),
        image(T + 4 * step)[:-9],
        image(T + 10 * 10**9),
    ]
    strips = LiveStrips(given, {"/c": left_out})
    messages = [message for image in image_rows(come, left_out) for message in strips.add("N", *image)]
    np.testing.assert_array_equal(messages[0].body.pixels, PIXELS)
    assert [(m.body.strip, m.body.first_line) for m in messages] == [("A092750", 0), ("A092750", 8), ("A092800", 0)]
    assert left_out == {"image lines missing": 4, "images that are not grey": 1, "not decodable": 1}


STEP = 40_000_000  # from image to image of four rows at 100 lines a second
CAMERA = {"F": "/camera/forward", "N": "/camera/nadir", "B": "/camera/backward"}


def numbered(come, **table):
    """Strip, CCD line and number of the first row of each image; ``come`` are CCD lines and stamps. And the counts."""
    given = settings(images=CAMERA, line_rate_hz=100.0, **table)
    left_out = {topic: Counter() for topic in CAMERA.values()}
    strips = LiveStrips(given, left_out)
    out = [message for ccd, t in come for message in strips.add(ccd, t, PIXELS)] + strips.begin()
    for message in out:  # numbers go with times, whichever CCD line it is
        assert message.topic == f"sensor/lines/{message.body.ccd}"
    return [(m.body.strip, m.body.ccd, m.body.first_line) for m in out], left_out, out


def test_topics_of_one_camera_have_one_strip_and_one_count_of_lines_though_they_begin_apart():
    t = T + 10**9 - STEP // 2  # the backward line begins in the next second
    come = [("N", t), ("N", t + STEP), ("F", t - 30_000_000), ("N", t + 2 * STEP), ("F", t + 10_000_000)]
    come += [("B", t + 3 * STEP + 4_000_000), ("F", t + 50_000_000), ("B", t + 4 * STEP + 4_000_000)]
    found, left_out, out = numbered(come)
    assert {strip for strip, _, _ in found} == {"092750"} and not sum(left_out.values(), Counter())
    assert sorted(line for _, ccd, line in found if ccd == "F") == [0, 4, 8]
    assert sorted(line for _, ccd, line in found if ccd == "N") == [3, 7, 11]
    assert sorted(line for _, ccd, line in found if ccd == "B") == [15, 19]
    for message in out:
        off = (message.body.time_ns - (t - 30_000_000)) / 10_000_000 - message.body.first_line
        assert abs(off) <= 0.5


@pytest.mark.parametrize("live", [True, False])
def test_one_stamp_far_ahead_does_not_silence_a_topic(live):
    """All that followed was left out, for an hour."""
    times = [T + i * STEP + (3600 * 10**9 if i == 5 else 0) for i in range(20)]
    left_out = Counter() if live else None
    found = list(fix_messages(map(fix, times), "/fix", notes := [], "", left_out))
    assert [m.stamp_ns for m in found] == [t for i, t in enumerate(times) if i != 5]
    told = "/fix: messages left out: 1 not later than the one before"
    assert left_out == {"not later than the one before": 1} if live else told in notes


def test_a_clock_of_ros_that_is_set_back_in_flight_is_followed():
    """All was left out until the clock had come to where it was before."""
    back = [T + i * STEP - (20 * 10**9 if i >= 50 else 0) for i in range(100)]
    left_out = Counter()
    found = list(inertial_messages(map(imu, back), "/imu", [], "", left_out, at_once=1))
    of_attitude = [m.stamp_ns for m in found if m.topic == "sensor/attitude"]
    assert of_attitude == back[:50] + back[54:]
    samples = [m.body for m in found if m.topic == "sensor/imu"]
    assert [b.time_ns for b in samples] == back[:50] + back[55:]  # of the first one nobody knows the interval
    assert left_out["not later than the one before"] == 4

    given = settings(images=CAMERA, line_rate_hz=100.0)
    come = {ccd: list(image_rows(map(image, back), Counter(), live=True)) for ccd in CAMERA}
    strips = LiveStrips(given, {topic: Counter() for topic in CAMERA.values()})
    blocks = [m.body for i in range(96) for ccd in CAMERA for m in strips.add(ccd, *come[ccd][i])]
    assert {b.strip for b in blocks} == {"092750", strip_name(back[54])}
    for strip, times in (("092750", back[:50]), (strip_name(back[54]), back[54:])):
        for ccd in CAMERA:
            of = [b for b in blocks if (b.strip, b.ccd) == (strip, ccd)]
            assert [(b.first_line, b.time_ns) for b in of] == [(4 * i, t) for i, t in enumerate(times)]


def test_a_camera_that_keeps_another_rate_than_the_nominal_one():
    """Half a per cent: by the nominal rate lines would be refused after 20 of them, as of another strip."""
    rng = np.random.default_rng(4)
    true_ns = 10_050_000  # of a line, stamps of a program that are off by a millisecond
    given = settings(images=CAMERA, line_rate_hz=100.0)
    strips, found = LiveStrips(given, {topic: Counter() for topic in CAMERA.values()}), FoundStrips()
    times, off = LineTimes(0.0, 100.0), []
    for strip in (0, 1):
        for i in range(1500):
            for ccd in CAMERA:
                stamp = T + strip * 10**12 + round(4 * i * true_ns + 1e6 * rng.standard_normal())
                for message in strips.add(ccd, stamp, PIXELS):
                    block = message.body
                    if block.first_line == 0 and block.ccd == "F":
                        found.begin(block)
                        start_ns = T + strip * 10**12
                        times = LineTimes(0.0, 1e9 / (block.line_period_ns or true_ns))
                    if block.line_times_ns is not None:
                        times.add(block.first_line, (block.line_times_ns - start_ns) * 1e-9)
                    found.note(block, message.stamp_ns)  # raises where a line is far off
                    if i > 100:
                        true_s = (4 * i + np.arange(4)) * true_ns * 1e-9
                        off.append((strip, np.abs(times.time_of(block.first_line + np.arange(4)) - true_s).max()))
    assert len(off) == 2 * 1399 * 3
    # to half a line, where stamps alone are off by up to four tenths; by the nominal rate it would be 30 lines
    assert max(o for _, o in off) < 5e-3 and np.mean([o for _, o in off]) < 2e-3
    assert len(strips.told) == 1
    assert "lines/s come, not 100.00 as line_rate_hz or the strip before says" in strips.told[0]


def test_a_publisher_that_begins_anew_goes_on_in_the_strip_of_the_others():
    run = [(ccd, T + i * STEP) for i in range(250) for ccd in "FNB"]  # ten seconds
    gone = [(ccd, t) for ccd, t in run if ccd != "N" or not 2 * 10**9 < t - T < 9 * 10**9]
    found, left_out, _ = numbered(gone)
    whole, _, _ = numbered(run)
    assert found == [row for row, (ccd, t) in zip(whole, run, strict=True) if (ccd, t) in set(gone)]
    assert left_out["/camera/nadir"] == {"image lines missing": 4 * (len(run) - len(gone))}
    # all of them silent for more than five seconds: another strip, whoever is the first
    again = [(ccd, T + 20 * 10**9 + k) for k, ccd in ((2 * STEP, "B"), (STEP, "F"), (0, "N"))]
    found, _, _ = numbered(run[:30] + again)
    assert found[30:] == [("092810", "B", 8), ("092810", "F", 4), ("092810", "N", 0)]


def test_two_cameras_over_zenoh_one_of_which_begins_anew_and_loses_images():
    port, stop, n = free_port(), threading.Event(), 30
    config = zenoh.Config()
    config.insert_json5("listen/endpoints", json.dumps([f"tcp/127.0.0.1:{port}"]))
    config.insert_json5("scouting/multicast/enabled", "false")
    images = {ccd: CAMERA[ccd] for ccd in "FN"}
    sensor = Ros2(settings(endpoint=f"tcp/127.0.0.1:{port}", images=images, line_rate_hz=100.0, id="cameras"))
    key = {ccd: f"0{topic}/sensor_msgs::msg::dds_::Image_/{HASH}" for ccd, topic in images.items()}
    found = []

    def take():
        message = next(come)
        found.extend([] if message is None else [message.body])

    def declared(ccd):
        publisher = ros.declare_publisher(key[ccd])
        while not publisher.matching_status.matching:
            take()
        return publisher

    with zenoh.open(config) as ros:
        come = sensor.messages(stop)
        forward, nadir = declared("F"), declared("N")
        for i in range(n):
            if i == 10:
                while len(found) < 19:
                    take()
                nadir.undeclare()  # the node of this camera ends; six seconds later it is here again
            late = 0 if i < 10 else 6 * 10**9
            if i == 20:
                nadir = declared("N")
            if i != 5:  # lost on its way
                forward.put(image(T + i * STEP + late))
            if not 10 <= i < 20:
                nadir.put(image(T + i * STEP + late, PIXELS + 1))
        nadir.put(image(T + (n - 1) * STEP + 6 * 10**9))  # twice
        while len(found) < 2 * n - 11 or len(sensor.counters) < 2:
            take()
        stop.set()
        assert [message for message in come if message is not None] == []
    assert all((block.pixels[0, 0] == 1) == (block.ccd == "N") for block in found)
    strips = list(dict.fromkeys(block.strip for block in found))
    assert strips == ["092750", "092756"]
    for ccd, there in (("F", [*range(5), *range(6, 10)]), ("N", range(10))):
        assert [b.first_line for b in found if b.ccd == ccd and b.strip == strips[0]] == [4 * i for i in there]
    for ccd, there in (("F", range(10, 30)), ("N", range(20, 30))):
        assert [b.first_line for b in found if b.ccd == ccd and b.strip == strips[1]] == [4 * (i - 10) for i in there]
    assert sensor.counters == {"image lines missing": 4, "not later than the one before": 1}


def test_a_ccd_line_that_never_comes_holds_the_others_back_for_a_second_only():
    # what comes too late for it is counted, and what comes then has the number that its time says
    come = [("F", T + i * STEP) for i in range(40)]
    found, left_out, _ = numbered([*come[:35], ("N", T - 10**8), *come[35:], ("N", T + 36 * STEP)])
    assert [line for _, ccd, line in found if ccd == "F"] == list(range(0, 160, 4))
    assert [line for _, ccd, line in found if ccd == "N"] == [144]
    assert left_out["/camera/nadir"] == {"images before their strip": 1}


@pytest.mark.parametrize(
    ("table", "wanted"),
    [
        ({"images": {"N": "/c", "F": "c/"}, "line_rate_hz": 1.0}, "sensor[0]: one topic for N, F, wanted a topic for"),
        ({}, "sensor[0]: no topic, wanted imu"),
        ({"imu": "/a/*"}, "sensor[0]: '/a/*', wanted a ROS topic as /imu/data"),
        ({"images": {"N": "/c"}}, "sensor[0].line_rate_hz: missing, wanted a number above 0"),
        ({"imu": "/a", "domain": -1}, "sensor[0].domain: -1, wanted an integer of at least 0"),
    ],
)
def test_settings_that_cannot_be(table, wanted):
    with pytest.raises(UserError) as error:
        settings(**table)
    assert str(error.value).startswith(f"flight.toml: {wanted}")


def test_an_endpoint_that_cannot_be():
    sensor = Ros2(settings(imu="/a", endpoint="here"))
    with pytest.raises(UserError, match="here: "):
        next(sensor.messages(threading.Event()))
