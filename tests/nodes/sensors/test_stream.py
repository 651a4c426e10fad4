"""Records of somebody's own driver, and the C program of the documentation as one."""

from __future__ import annotations

import shutil
import socket
import subprocess
import threading
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from bus_rig import free_port
from places import ROOT

from triline.nodes.convert import time_ns
from triline.nodes.errors import UserError
from triline.nodes.formats.keys import Keys
from triline.nodes.matcher.found_strips import FoundStrips
from triline.nodes.sensors.program import Clock
from triline.nodes.sensors.stream import Stream, StreamParser, StreamSettings

T = 1_795_339_670_000_000_000
PIXELS = np.arange(12, dtype="<u2").reshape(3, 4) * 1000


def parse(data: bytes, size: int = 0, clock: Clock | None = None):
    counts: Counter[str] = Counter()
    parser = StreamParser(clock or Clock(), lambda kind, text: counts.update([kind]))
    parts = [data[i : i + size] for i in range(0, len(data), size)] if size else [data]
    return [message for part in parts for message in parser.feed(part)], counts


ALL = (
    f"GNSS {T} 47.9 11.1 1500 0.02 0.03 0.05\nIMU {T + 5} 5000000 0.1 0.2 -9.8 0.01 0.02 0.03\n"
    f"ATTITUDE {T + 6} 0.01 0.02 1.5 0.001 0.001 0.002\n"
    f"LINES N S1 40 {T} 5000000 3 4 16\n"
).encode() + PIXELS.tobytes()


@pytest.mark.parametrize("size", [0, 1, 7])
def test_records_become_messages(size):
    (gnss, imu, attitude, lines), counts = parse(ALL * 2, size)[0][:4], parse(ALL * 2, size)[1]
    assert not counts and [m.topic for m in (gnss, imu, attitude, lines)] == [
        "sensor/gnss", "sensor/imu", "sensor/attitude", "sensor/lines/N"
    ]  # fmt: skip
    assert time_ns(gnss.body.timestamp) == gnss.stamp_ns == T
    np.testing.assert_allclose(np.sqrt(gnss.body.position_covariance[::4]), [0.02, 0.03, 0.05])
    b = imu.body
    values = [b.force_x, b.force_y, b.force_z, b.rate_x, b.rate_y, b.rate_z]
    assert values == [0.1, 0.2, -9.8, 0.01, 0.02, 0.03] and (b.time_ns, b.interval_ns) == (T + 5, 5_000_000)
    assert (attitude.body.roll, attitude.body.pitch, attitude.body.heading) == (0.01, 0.02, 1.5)
    block = lines.body
    np.testing.assert_array_equal(block.pixels, PIXELS)
    assert (block.ccd, block.strip, block.first_line, block.time_ns) == ("N", "S1", 40, T)
    assert lines.stamp_ns == T + 10_000_000  # when the last of its lines has been read
    assert len(parse(ALL * 2, size)[0]) == 8


def test_the_clock_of_a_driver():
    messages, _ = parse(ALL, clock=Clock(offset_ns=1_000_000, delay_ns=300))
    assert [m.stamp_ns - T for m in messages] == [-999_700, -999_695, -999_694, 9_000_300]
    assert messages[3].body.time_ns == T - 1_000_000


@pytest.mark.parametrize(
    ("bad", "kind"),
    [
        (b"HELLO 1 2\n", "not a record"),
        (b"\x00" * 2000 + b"\n", "not a record"),
        (b"GNSS 1 2 3\n", "not readable"),
        (b"IMU x 5000000 0 0 0 0 0 0\n", "not readable"),
        (b"GNSS %d 47.9 nan 1500 1 1 1\n" % T, "not readable"),
        (b"GNSS %d 95 11.1 1500 1 1 1\n" % T, "not readable"),
        (b"GNSS %d 47.9 11.1 1500 1 0 1\n" % T, "not readable"),
        (b"IMU %d -5000000000 0 0 0 0 0 0\n" % T, "not readable"),
        (b"IMU %d 5000000 0 0 -9806 0 0 0\n" % T, "not readable"),
        (b"ATTITUDE %d 0.01 0.02 150 1 1 1\n" % T, "not readable"),
        (b"LINES N S1 0 %d 5000000 3 4 12\n" % T, "not readable"),
        (b"LINES N S1 0 %d 5000000 0 4 16\n" % T, "not readable"),
    ],
)
def test_what_cannot_be_read_is_counted_and_the_next_record_comes(bad, kind):
    messages, counts = parse(bad + ALL)
    assert len(messages) == 4 and counts == {kind: 1}


def test_what_no_aircraft_measures_is_said_with_its_record():
    said: list[str] = []
    parser = StreamParser(Clock(), lambda kind, text: said.append(text))
    assert not parser.feed(b"GNSS %d 95 11.1 1500 1 1 1\nIMU %d -5000000000 0 0 0 0 0 0\n" % (T, T))
    assert said[0] == f"GNSS {T} 95 11.1 1500 1 1 1: position [95.0, 11.1, 1500.0] is no latitude, longitude, height"
    assert said[1].endswith("interval -5000000000 ns, wanted more than 0 and at most a second")


def test_address():
    def read(address):
        return StreamSettings.read(Keys(Path("flight.toml"), {"address": address}, "sensor[0]"), Path()).address

    assert read("listen://127.0.0.1:5555") == "listen://127.0.0.1:5555"
    for wrong in ("listen://127.0.0.1", "5555", "listen://x:99999"):
        with pytest.raises(UserError, match=r"sensor\[0\].address: .* wanted listen://HOST:PORT, serial"):
            read(wrong)
    with socket.create_server(("127.0.0.1", 0)) as held, pytest.raises(UserError, match="address already in use"):
        settings = StreamSettings("s", f"listen://127.0.0.1:{held.getsockname()[1]}", 115200, Clock())
        next(Stream(settings).messages(threading.Event()))


@pytest.fixture(scope="module")
def program(tmp_path_factory):
    """The C program of the documentation, compiled."""
    if shutil.which("cc") is None:
        pytest.skip("no C compiler")
    path = tmp_path_factory.mktemp("c") / "publish_sensors"
    source = ROOT / "docs" / "examples" / "publish_sensors.c"
    compiled = subprocess.run(
        ["cc", "-std=gnu11", "-Wall", "-Wextra", "-Werror", "-o", path, source], capture_output=True, text=True
    )
    assert compiled.returncode == 0, compiled.stderr
    return path


#: What the devices give: two rows, 8 lines of 16 bits as two blocks, inertial data in between.
GREY = (np.arange(8 * 5) * 1500 + 10).astype("<u2").reshape(8, 5)
ROWS = (
    b"gnss 0 47.9 11.1 1500.25 0.02\nattitude 0 0.01 -0.02 1.5 0.001\n"
    + b"lines 0 N 0 5000000 4 5 16\n" + GREY[:4].tobytes()
    + b"imu 15000000 5000000 0.1 0 -9.81 0 0 0.001\n"
    + b"lines 20000000 N 4 5000000 4 5 16\n" + GREY[4:].tobytes()
)  # fmt: skip


def run_c(program: Path, rows: bytes, awaited: int):
    """Run it into a stream: the messages that came, the stream's counters, the finished process."""
    port, stop = free_port(), threading.Event()
    sensor = Stream(StreamSettings("camera", f"listen://127.0.0.1:{port}", 115200, Clock()))
    come = sensor.messages(stop)
    assert next(come) is None  # it listens
    done: list[subprocess.CompletedProcess[bytes]] = []
    command = [str(program), "127.0.0.1", str(port)]
    driver = threading.Thread(target=lambda: done.append(subprocess.run(command, input=rows, capture_output=True)))
    driver.start()
    messages = []
    while len(messages) < awaited:
        message = next(come)
        messages += [] if message is None else [message]
    driver.join(60)
    stop.set()
    return messages, sensor.counters, done[0]


def test_the_program_in_c(program):
    messages, counters, done = run_c(program, ROWS, 5)
    assert done.returncode == 0 and done.stdout == b"5 records\n" and not counters
    gnss, attitude, first, imu, second = messages
    assert [m.topic[7:] for m in messages] == ["gnss", "attitude", "lines/N", "imu", "lines/N"]
    t = gnss.stamp_ns
    assert [m.stamp_ns - t for m in messages] == [0, 0, 15_000_000, 15_000_000, 35_000_000]
    assert (gnss.body.latitude, gnss.body.longitude, gnss.body.altitude) == (47.9, 11.1, 1500.25)
    assert (attitude.body.roll, attitude.body.pitch, attitude.body.heading) == (0.01, -0.02, 1.5)
    assert (imu.body.force_x, imu.body.force_z, imu.body.rate_z) == (0.1, -9.81, 0.001)
    assert imu.body.interval_ns == 5_000_000
    np.testing.assert_array_equal(np.concatenate([first.body.pixels, second.body.pixels]), GREY)
    assert (first.body.first_line, second.body.first_line) == (0, 4) and first.body.strip == second.body.strip
    assert first.body.strip.startswith("S") and first.body.time_ns == t


@pytest.mark.parametrize(
    "bad",
    [
        b"odometer 1 2 3\n",
        b"gnss 0 47.9 north\n",
        b"lines 0 N 0 5000000 4 5 16\n12",
        b"lines 0 N 0 1 -1 9 16\n",
        b"gnss",
    ],
)
def test_the_program_in_c_names_a_row_that_it_cannot_read(program, bad):
    messages, _, done = run_c(program, ROWS + bad, 5)
    assert len(messages) == 5 and done.returncode == 1 and done.stdout == b"5 records\n"
    assert done.stderr == b"row 6 of %s: cannot be read\n" % bad.split()[0]


def test_the_program_in_c_says_when_nobody_listens(program):
    done = subprocess.run([program, "127.0.0.1", str(free_port())], input="", capture_output=True, text=True)
    assert done.returncode == 1 and "nobody listens" in done.stderr


def lines_at(rate_hz: float, period: str, first: int, lines: int = 100):
    """The block from a line on that a driver sends which counts by the rate; it states this period."""
    t = T + round(first * 1e9 / rate_hz)
    (message,), counts = parse(f"LINES N S1 {first} {t} {period} {lines} 2 8\n".encode() + bytes(2 * lines))
    assert not counts
    return message


def test_a_period_that_is_no_whole_number_of_ns_keeps_the_times_of_the_source():
    """753 lines/s: 0.25 ns a line were lost, after 20 minutes 0.2 ms, or 1.6 cm in flight."""
    rate_hz, lines = 753.0, np.arange(900_000, 900_100)
    exact = T + np.rint(lines * 1e9 / rate_hz).astype(np.int64)
    for period, off_ns in (("1328021.248339973", 2), ("1328021", 30)):
        message = lines_at(rate_hz, period, 900_000)
        assert abs(message.body.times_ns() - exact).max() <= off_ns and message.stamp_ns == message.body.times_ns()[-1]
        strip = FoundStrips().begin(lines_at(rate_hz, period, 0).body)
        drift_s = abs(900_000 / strip.line_rate_hz - 900_000 / rate_hz)
        assert drift_s < 2e-5 if "." in period else drift_s == pytest.approx(2.2e-4, rel=0.05)
    # tie points have the times of the lines themselves, as far as they are told
    assert lines_at(rate_hz, "1328021.248339973", 0).body.line_times_ns is not None
    whole = lines_at(rate_hz, "1328021.0", 0).body
    assert whole.line_times_ns is None and whole.line_period_ns == 1_328_021
    assert lines_at(rate_hz, "1328021.25", 0, lines=1).body.line_period_ns == 1_328_021


@pytest.mark.parametrize("period", ["0.5", "nan", "inf", "-3.5", "1e30", "x"])
def test_a_period_that_no_camera_has_is_refused(period):
    _, counts = parse(f"LINES N S1 0 {T} {period} 3 4 16\n".encode() + PIXELS.tobytes())
    assert counts["not readable"] == 1
