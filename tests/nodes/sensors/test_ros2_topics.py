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
from triline.nodes.formats.keys import Keys
from triline.nodes.sensors.ros2 import Ros2, Ros2Settings, image_messages, key_expression

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
    messages = list(image_messages(come, "N", given, left_out))
    np.testing.assert_array_equal(messages[0].body.pixels, PIXELS)
    assert [(m.body.strip, m.body.first_line) for m in messages] == [("A092750", 0), ("A092750", 8), ("A092800", 0)]
    assert left_out == {"image lines missing": 4, "images that are not grey": 1, "not decodable": 1}


@pytest.mark.parametrize(
    ("table", "wanted"),
    [
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
