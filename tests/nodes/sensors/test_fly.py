"""`triline fly` fed by a program that imports nothing of triline: all arrives, and `process` gives the same bytes."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from bus_rig import ENVIRONMENT, TRILINE, free_port
from driven_flight import write_flight
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


@pytest.fixture(scope="module")
def flown(tmp_path_factory):
    """Folder of results, what the publisher sent, what `fly` said."""
    folder = tmp_path_factory.mktemp("fly")
    write_flight(folder, pixels=100, seconds=4.0)
    port, out = str(free_port()), folder / "out"
    command = [*TRILINE, "fly", str(folder / "flight"), "--no-viewer", "--no-report", "--port", port]
    command += ["--nodes", "navigator,matcher,adjuster", "-o", str(out)]
    fly = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=ENVIRONMENT)
    try:
        said = wait_for_line(fly, "waiting for sensors on triline/driven/sensor")
        # -I: no folder of the repository on its path
        driver = [sys.executable, "-I", str(PUBLISHER), str(folder / "drivers"), "--platform", "driven", "--port", port]
        sent = subprocess.run(driver, capture_output=True, text=True, timeout=300, env=ENVIRONMENT)
        assert sent.returncode == 0, sent.stderr
        fly.send_signal(signal.SIGINT)
        rest, _ = fly.communicate(timeout=300)
    finally:
        fly.kill()
    assert fly.returncode == 0, rest
    return out, json.loads(sent.stdout), "".join(said) + rest


def test_the_publisher_imports_nothing_of_triline():
    text = PUBLISHER.read_text()
    imports = [line for line in text.splitlines() if line.startswith(("import ", "from "))]
    assert imports and not any("triline" in line for line in imports)


def test_everything_arrives_and_nothing_is_lost(flown):
    out, sent, said = flown
    reader = RecordingReader(out / "flight.mcap")
    for topic in SENSORS:
        sequence = [message.sequence for message in reader.sorted_messages([topic])]
        assert sequence == list(range(sent[topic])), topic
        assert f"{topic} {sent[topic]}" in said
        assert f"{topic} comes in" in said
    lost = "".join(line for line in said.splitlines() if line.startswith("lost or late"))
    assert not any(kind in lost for kind in ("gaps", "malformed", "dropped"))
    assert "configuration published" in said


def test_strips_are_found_where_nobody_announces_them(flown):
    out, _, _ = flown
    begun, ended = RecordingReader(out / "flight.mcap").messages(["configuration/strip"])
    assert begun.source == ended.source == "matcher" and begun.body.id == ended.body.id
    assert begun.body.line_rate_hz == pytest.approx(18.8, rel=1e-6) and (begun.body.ended, ended.body.ended) == (0, 1)
    assert 40 < ended.body.lines <= 76


def test_process_gives_the_bytes_of_the_live_results(flown, tmp_path):
    out, _, said = flown
    again = tmp_path / "again.mcap"
    config = Path(out).parent / "flight" / "flight.toml"
    nodes = ["--nodes", "navigator,matcher,adjuster", "--config", str(config)]
    assert main(["process", str(out / "flight.mcap"), "-o", str(again), *nodes, "-q"]) == 0
    for topic in RESULTS:
        live, processed = (
            [(m.stamp_ns, m.source, m.body.SerializeToString(deterministic=True)) for m in reader.messages([topic])]
            for reader in (RecordingReader(out / "flight.mcap"), RecordingReader(again))
        )
        if live != processed and " late " in said:
            pytest.skip("the machine was so busy that nodes got messages after their turn")
        assert live == processed, topic
        assert len(live) > (1 if topic == "configuration/strip" else 10), topic
