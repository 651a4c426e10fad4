"""`triline fly` fed by programs that have nothing of triline: all arrives, and `process` gives the same bytes."""

from __future__ import annotations

import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from bus_rig import ENVIRONMENT, PATIENCE, TRILINE, free_port
from driven_flight import write_flight, write_rows
from places import ROOT

from triline.nodes.cli import main
from triline.nodes.recording.reader import RecordingReader

PUBLISHER = ROOT / "docs" / "examples" / "publish_sensors.py"
SENSORS = ("sensor/gnss", "sensor/attitude", "sensor/lines/F", "sensor/lines/N", "sensor/lines/B")
RESULTS = ("configuration/strip", "trajectory/filtered", "trajectory/smoothed", "orientation/live", "orientation/final")


def wait_for_line(process: subprocess.Popen[str], text: str) -> list[str]:
    """Lines up to one with a text; a flight that ends before fails the test with what it said."""
    assert process.stdout is not None
    lines = []
    for line in process.stdout:
        lines.append(line)
        if text in line:
            return lines
    raise AssertionError("".join(lines))


class Flown(NamedTuple):
    """A flight folder, what its drivers measured, the folder of results, what `fly` said."""

    flight: Path
    drivers: Path
    out: Path
    said: str


def publish_in_python(drivers: Path, bus_port: str, _: str) -> None:
    # -I: no folder of the repository on its path
    command = [sys.executable, "-I", str(PUBLISHER), str(drivers), "--platform", "driven", "--port", bus_port]
    sent = subprocess.run(command, capture_output=True, text=True, timeout=300, env=ENVIRONMENT)
    assert sent.returncode == 0, sent.stderr


def publish_in_c(drivers: Path, _: str, stream_port: str) -> None:
    program = drivers.parent / "publish_sensors"
    subprocess.run(["cc", "-o", program, PUBLISHER.with_suffix(".c")], check=True)
    records = write_rows(drivers, drivers.parent / "measured")
    until = time.monotonic() + 20.0 * PATIENCE
    while True:
        with open(drivers.parent / "measured", "rb") as measured:
            sent = subprocess.run(
                [program, "127.0.0.1", stream_port], stdin=measured, capture_output=True, text=True, timeout=300
            )
        if sent.returncode == 0 or "nobody listens" not in sent.stderr or time.monotonic() > until:
            break
        time.sleep(0.2)
    assert sent.returncode == 0, sent.stderr
    assert sent.stdout == f"{records} records\n"


@pytest.fixture(scope="module")
def driven(tmp_path_factory):
    folder = tmp_path_factory.mktemp("driven")
    write_flight(folder, pixels=100, seconds=4.0)
    return folder


@pytest.fixture(
    scope="module",
    params=[
        publish_in_python,
        pytest.param(publish_in_c, marks=pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler")),
    ],
)
def flown(request, driven, tmp_path_factory):
    """The same flight by each of the programs in the documentation."""
    folder = tmp_path_factory.mktemp("fly")
    stream_port = str(free_port())
    shutil.copytree(driven, folder, dirs_exist_ok=True)
    if request.param is publish_in_c:
        with open(folder / "flight" / "flight.toml", "a") as file:
            file.write(f'[[sensor]]\nkind = "stream"\naddress = "listen://127.0.0.1:{stream_port}"\n')
    code, said = fly(folder, request.param, stream_port)
    assert code == 0, said
    return Flown(folder / "flight", folder / "drivers", folder / "out", said)


def fly(folder, publish, stream_port="", nodes="navigator,matcher,adjuster"):
    """Fly what drivers have measured; exit code and what was said."""
    port, out = str(free_port()), folder / "out"
    command = [*TRILINE, "fly", str(folder / "flight"), "--no-viewer", "--no-report", "--port", port]
    command += ["--nodes", nodes, "-o", str(out)]
    fly = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=ENVIRONMENT)
    try:
        said = wait_for_line(fly, "waiting for sensors on triline/driven/sensor")
        publish(folder / "drivers", port, stream_port)
        fly.send_signal(signal.SIGINT)
        rest, _ = fly.communicate(timeout=300)
    finally:
        fly.kill()
    return fly.returncode, "".join(said) + rest


def test_the_publisher_imports_nothing_of_triline():
    text = PUBLISHER.read_text()
    imports = [line for line in text.splitlines() if line.startswith(("import ", "from "))]
    assert imports and not any("triline" in line for line in imports)


def test_everything_that_was_measured_arrives(flown):
    """All of the drivers' files is in the recording: numbers without a gap, values, and every pixel."""
    reader = RecordingReader(flown.out / "flight.mcap")
    for topic in SENSORS:
        messages = list(reader.sorted_messages([topic]))
        assert [message.sequence for message in messages] == list(range(len(messages))), topic
        assert f"{topic} {len(messages)}" in flown.said
        assert f"{topic} comes in" in flown.said
        if topic.startswith("sensor/lines/"):
            measured = np.load(flown.drivers / f"lines_{topic[-1]}.npy")
            np.testing.assert_array_equal(np.concatenate([m.body.pixels for m in messages]), measured)
            continue
        measured = np.loadtxt(flown.drivers / f"{topic[7:]}.csv", delimiter=",")
        stamps = np.array([message.stamp_ns for message in messages])
        np.testing.assert_allclose((stamps - stamps[0]) * 1e-9, measured[:, 0] - measured[0, 0], atol=2e-9)
        names = ("latitude", "longitude", "altitude") if topic == "sensor/gnss" else ("roll", "pitch", "heading")
        values = [[getattr(message.body, name) for name in names] for message in messages]
        assert (np.abs(np.array(values) - measured[:, 1:4]) < [1e-9, 1e-9, 1e-6]).all(), topic
    lost = "".join(line for line in flown.said.splitlines() if line.startswith("lost or late"))
    assert not any(kind in lost for kind in ("gaps", "malformed", "dropped"))
    assert "configuration published" in flown.said


def test_strips_are_found_where_nobody_announces_them(flown):
    begun, ended = RecordingReader(flown.out / "flight.mcap").messages(["configuration/strip"])
    assert begun.source == ended.source == "matcher" and begun.body.id == ended.body.id
    assert begun.body.line_rate_hz == pytest.approx(18.8, rel=1e-6) and (begun.body.ended, ended.body.ended) == (0, 1)
    assert 40 < ended.body.lines <= 76


def test_process_gives_the_bytes_of_the_live_results(flown, tmp_path):
    again = tmp_path / "again.mcap"
    nodes = ["--nodes", "navigator,matcher,adjuster", "--config", str(flown.flight / "flight.toml")]
    assert main(["process", str(flown.out / "flight.mcap"), "-o", str(again), *nodes, "-q"]) == 0
    for topic in RESULTS:
        live, processed = (
            [(m.stamp_ns, m.source, m.body.SerializeToString(deterministic=True)) for m in reader.messages([topic])]
            for reader in (RecordingReader(flown.out / "flight.mcap"), RecordingReader(again))
        )
        if live != processed and " late " in flown.said:
            pytest.skip("the machine was so busy that nodes got messages after their turn")
        assert live == processed, topic
        assert len(live) > (1 if topic == "configuration/strip" else 10), topic


def test_a_flight_whose_image_lines_are_all_refused_ends_with_exit_code_1(driven, tmp_path):
    """A camera.json of other pixels than the camera has: nothing was tied, and a script took that for a good flight."""
    shutil.copytree(driven, tmp_path, dirs_exist_ok=True)
    for path in (tmp_path / "drivers").glob("lines_*.npy"):
        np.save(path, np.load(path)[:, :-10])
    code, said = fly(tmp_path, publish_in_python, nodes="navigator,matcher")
    (line,) = (text for text in said.splitlines() if text.startswith("triline fly: "))
    assert line.startswith(f"triline fly: {tmp_path}/flight: matcher used none of the ")
    assert " messages on sensor/lines/*: " in line and "of 90 samples, wanted 100" in said
    assert code == 1 and (tmp_path / "out" / "flight.mcap").exists()
