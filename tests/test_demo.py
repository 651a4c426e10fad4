"""The demo as a user runs it: separate processes on the bus, results, and what happens when nodes are killed."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from bus_rig import free_port, wait_for
from recording_file import bodies_of

from triline.nodes.bus.session import Bus
from triline.nodes.cli.demo import PLATFORM
from triline.nodes.recording.reader import RecordingReader
from triline.nodes.simulator.flight_settings import DEFAULT_EPOCH_NS
from triline.schemas import codec

DEMO = [sys.executable, "-m", "triline.nodes.cli", "demo", "--headless", "--json"]
RESULTS = (
    "trajectory/filtered", "trajectory/smoothed", "observation/tie", "observation/target", "orientation/live",
    "orientation/final", "point/object",
)  # fmt: skip
NODES = "navigator,matcher,adjuster"


def process(recording: Path, output: Path) -> Path:
    command = [sys.executable, "-m", "triline.nodes.cli", "process", str(recording), "-o", str(output), "-q"]
    command += ["--nodes", NODES]
    subprocess.run(command, check=True, capture_output=True, timeout=900)
    return output


@pytest.fixture(scope="module")
def demo(tmp_path_factory):
    """A flight with image lines, and a control point that a surveyor rejects on the way."""
    folder, port = tmp_path_factory.mktemp("demo"), str(free_port())
    command = [*DEMO, "--seconds", "12", "--seed", "3", "-o", str(folder), "--port", port]
    flight = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    try:
        wait_for_simulator(folder)
        with Bus(PLATFORM, source="listener", port=int(port)) as bus:
            seen: set[str] = set()
            bus.subscribe("observation/target", lambda raw: seen.add(codec.decode(raw.topic, raw.data).point))
            wait_for(lambda: "GCP2" in seen or flight.poll() is not None, 120, "the first look at GCP2")
        words = ["confirm", "GCP2", "--reject", "--by", "me", "--port", port]
        said = subprocess.run([*DEMO[:3], *words], capture_output=True, timeout=900)
        out, error = flight.communicate(timeout=900)
    finally:
        flight.kill()
    assert flight.returncode == 0, error.decode()
    assert said.returncode == 0 and b"GCP2 is rejected" in said.stdout, said.stderr.decode()
    return folder, json.loads(out)


def wait_for_simulator(folder: Path) -> None:
    wait_for((folder / "log" / "simulator.log").exists, 30, "the simulator")


def test_demo_leaves_recording_scene_and_report_with_better_orientation(demo):
    folder, result = demo
    assert result["restarts"] == 0 and not result["landed_early"]
    assert (folder / "flight.rrd").stat().st_size > 10_000
    assert "<html" in (folder / "report.html").read_text()[:500].lower()
    points = result["points"]
    for direct, final in zip(points["direct_georeferencing"]["rmse_m"], points["adjusted"]["rmse_m"], strict=True):
        assert final < direct / 2
    assert 0.7 < result["sigma0"] < 1.2
    direct, adjusted = (points[row]["rmse_m"] for row in ("direct_georeferencing", "adjusted"))
    assert result["improvement"] == [a / b for a, b in zip(direct, adjusted, strict=True)]
    assert result["rays"] >= 2 * result["ties"] > 40 and result["redundancy"] > 0
    # on a busy machine the orthoimage may get the end of the strip after the lines it belongs to
    assert not [what for what in result["lost"] if not (what.startswith("rectifier: ") and what.endswith(" late"))]


def test_tie_points_and_targets_come_from_the_image_lines(demo):
    folder, result = demo
    reader = RecordingReader(folder / "flight.mcap")
    messages = list(reader.sorted_messages(["observation/tie", "observation/target", "observation/verdict"]))
    assert {message.source for message in messages if message.topic == "observation/tie"} == {"matcher"}
    matched = [x.body for x in messages if x.topic == "observation/tie" and len(x.body.images) > 2]
    targets = [x.body for x in messages if x.topic == "observation/target"]
    assert len(matched) > 20
    assert sum(look.state == look.MEASURED for look in targets) > 0.9 * len(targets) > 60
    assert [(x.body.point, x.body.accepted, x.body.by) for x in messages if x.topic.endswith("verdict")] == [
        ("GCP2", False, "me")
    ]
    assert result["images"] and max(result["points"]["adjusted"]["rmse_m"]) < 0.3  # pixels of 0.7 m


def test_live_orientation_is_what_process_makes_of_the_recording(demo, tmp_path):
    folder, _ = demo
    processed = process(folder / "flight.mcap", tmp_path / "processed.mcap")
    for topic in RESULTS:
        live, again = bodies_of(folder / "flight.mcap", topic), bodies_of(processed, topic)
        assert len(live) > (60 if topic == "observation/target" else 100)
        assert live == again, f"{topic} differs"


def test_a_flight_that_waits_for_its_nodes_has_a_time_of_its_own(demo):
    """So that a seed gives the same results each time: they follow from the sensors' messages alone (see above)."""
    folder, _ = demo
    stamps = [stamp_ns for stamp_ns, _ in bodies_of(folder / "flight.mcap", "sensor/attitude")]
    assert stamps[0] == DEFAULT_EPOCH_NS
    assert {stamp_ns - stamps[0] for stamp_ns in stamps} == {round(i / 200 * 1e9) for i in range(len(stamps))}


@pytest.mark.study
def test_the_same_seed_gives_the_same_results_on_a_busy_machine(tmp_path):
    busy = [sys.executable, "-c", "while True: pass"]
    for name, loops in (("idle", 0), ("busy", 2)):
        others = [subprocess.Popen(busy) for _ in range(loops)]
        try:
            command = [*DEMO, "--seconds", "20", "--seed", "4", "-o", str(tmp_path / name)]
            subprocess.run(command, check=True, capture_output=True, timeout=900)
        finally:
            for other in others:
                other.kill()
    for topic in (*RESULTS, "orientation/whole", "orthoimage/final", "event/log"):
        idle, loaded = (
            bodies_of(tmp_path / "idle" / "flight.mcap", topic),
            bodies_of(tmp_path / "busy" / "flight.mcap", topic),
        )
        assert idle and idle == loaded, topic


@pytest.mark.study
def test_process_twice_is_byte_identical(demo, tmp_path):
    folder, _ = demo
    first = process(folder / "flight.mcap", tmp_path / "1.mcap")
    second = process(folder / "flight.mcap", tmp_path / "2.mcap")
    assert first.read_bytes() == second.read_bytes()


def node_pid(name: str, port: int) -> int:
    """The process of a node of the demo on a port."""
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                words = (entry / "cmdline").read_bytes().decode(errors="replace").split("\0")
            except OSError:
                continue
            if words[3:5] == ["node", name] and str(port) in words:
                return int(entry.name)
    raise AssertionError(f"no process of {name}")


def test_the_flight_before_is_kept(tmp_path):
    from triline.nodes.cli import parse
    from triline.nodes.cli.demo import Demo

    demo = Demo(parse(["demo", "-o", str(tmp_path), "--headless", "-q"]))
    for content in ("first", "second"):
        demo.clear()
        (tmp_path / "flight.mcap").write_text(content)
    (tmp_path / "flight-2.mcap").write_text("its rest")
    demo.clear()
    demo.clear()
    kept = {path.name: path.read_text() for path in (tmp_path / "before").iterdir()}
    assert kept == {"flight.mcap": "second", "flight-2.mcap": "its rest"}
    assert not list(tmp_path.glob("flight*.mcap"))


@pytest.mark.study
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="finds processes in /proc")
def test_nodes_killed_in_turn_are_started_again_and_the_flight_is_kept(tmp_path):
    port = free_port()
    command = [*DEMO, "--seconds", "25", "--seed", "5", "-o", str(tmp_path), "--port", str(port)]
    demo = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    try:
        wait_for_simulator(tmp_path)
        time.sleep(8)
        for name in ("navigator", "matcher", "adjuster", "viewer", "recorder"):
            os.kill(node_pid(name, port), signal.SIGKILL)
            time.sleep(5)
        out, error = demo.communicate(timeout=900)
    finally:
        demo.kill()
    assert demo.returncode == 0, error.decode()
    result = json.loads(out)
    assert result["restarts"] == 4  # a viewer that is gone is a window that was closed
    assert len(result["recordings"]) == 2
    # the recording that was cut off is readable, and goes on to within half a second of the kill
    cut = min((Path(p) for p in result["recordings"]), key=lambda p: p.stat().st_mtime)
    recovered = tmp_path / "recovered.mcap"
    command = [sys.executable, "-m", "triline.nodes.cli", "recover", str(cut), "-o", str(recovered), "-q"]
    assert subprocess.run(command, capture_output=True, timeout=900).returncode == 0
    attitude = bodies_of(recovered, "sensor/attitude")
    assert len(attitude) > 1000  # how far it was by then depends on the machine
    # the second recording explains itself and holds results of the restarted nodes
    rest = max((Path(p) for p in result["recordings"]), key=lambda p: p.stat().st_mtime)
    assert bodies_of(rest, "configuration/camera") and bodies_of(rest, "observation/control")
    assert len(bodies_of(rest, "orientation/final")) > 50
