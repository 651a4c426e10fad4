"""The viewer node, and the viewers it can draw in."""

from __future__ import annotations

import contextlib
import json
import os
import socket
import subprocess
import sys
import threading
import time
import urllib.request
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from bus_rig import wait_for
from full_disk import files_of_at_most
from notebook import Notebook
from recording_file import write_recording
from synthetic_flight import START_NS, flight_messages, spoilt_copy

from triline.nodes.cli import main
from triline.nodes.errors import UserError
from triline.nodes.node import Message
from triline.nodes.viewer import rerun_process, scene
from triline.nodes.viewer.canvas import NullCanvas
from triline.nodes.viewer.rerun_canvas import RerunCanvas, open_canvas
from triline.nodes.viewer.rerun_process import ViewerProcess, _free_port, _private_folder, viewer_binary
from triline.nodes.viewer.viewer import Viewer
from triline.schemas import codec


@pytest.fixture(scope="module")
def messages():
    return flight_messages(seconds=34.0, points=150)


@pytest.fixture(scope="module")
def recording(messages, tmp_path_factory):
    path = tmp_path_factory.mktemp("viewer") / "flight.mcap"
    return write_recording(path, messages)


# ---- the node


def _finish(viewer):
    viewer.finish()
    assert not viewer._thread.is_alive()


def test_poses_that_come_faster_than_they_are_drawn_are_not_decoded():
    viewer = Viewer(canvas=NullCanvas())
    step_ns = 5_000_000
    assert sum(viewer.looks_at("trajectory/filtered", START_NS + i * step_ns) for i in range(200)) == 23
    assert all(viewer.looks_at("trajectory/filtered", START_NS + 250 * step_ns) for _ in range(3)), "of one stamp"
    assert all(viewer.looks_at("orientation/live", START_NS + i * step_ns) for i in range(20))
    _finish(viewer)


def test_node_shows_what_it_is_given(messages):
    canvas = Notebook()
    viewer = Viewer(canvas=canvas)
    for message in messages:
        if message.topic in Viewer.inputs:
            assert list(viewer.step(message)) == []
    _finish(viewer)
    assert canvas.closed == 1 and viewer.state() == "running" and not viewer.counters
    assert canvas.pieces("flight/final") and canvas.curves["plots/sigma0/value"][0]


class _Stuck(Notebook):
    def __init__(self):
        super().__init__()
        self.released = threading.Event()

    def points(self, *args, **kwargs):
        self.released.wait()


def test_a_stuck_viewer_drops_and_counts_and_holds_nobody_up(messages):
    canvas = _Stuck()
    viewer = Viewer(canvas=canvas, queue_size=300)
    for message in messages:  # would hang here if a step waited for the picture
        if message.topic in Viewer.inputs:
            viewer.step(message)
    assert viewer.counters["view dropped"] > 500
    canvas.released.set()
    viewer.finish()


class _Broken(Notebook):
    def lines(self, *args, **kwargs):
        raise RuntimeError("no more ink")


def test_a_viewer_that_breaks_takes_nothing_with_it(messages):
    viewer = Viewer(canvas=_Broken())
    for message in messages:
        if message.topic in Viewer.inputs:
            viewer.step(message)
    _finish(viewer)
    assert viewer.counters["view failed"] >= 1 and "no more ink" in viewer.state()


class _BreaksOnce(Notebook):
    def __init__(self):
        super().__init__()
        self.left = 1

    def lines(self, *args, **kwargs):
        if self.left:
            self.left -= 1
            raise RuntimeError("no more ink")
        super().lines(*args, **kwargs)


def test_a_viewer_that_could_not_draw_draws_again(messages):
    canvas = _BreaksOnce()
    viewer = Viewer(canvas=canvas)
    for message in messages:
        if message.topic in Viewer.inputs:
            viewer.step(message)
    wait_for(lambda: viewer.counters["view failed"] == 1, 10, "the failure")
    wait_for(lambda: viewer.state() == "running", 10, "the recovery")
    _finish(viewer)
    assert canvas.drawn


def test_unusable_messages_are_counted(messages):
    canvas = Notebook()
    viewer = Viewer(canvas=canvas)
    good = next(m for m in messages if m.topic == "orientation/live")
    body = type(good.body)()
    body.CopyFrom(good.body)
    body.covariance.append(1.0)
    viewer.step(Message("orientation/live", START_NS, body, "test", 0))
    _finish(viewer)
    assert viewer.counters["unusable"] == 1 and "covariance has 37 values" in viewer.last_problem


def test_nothing_is_drawn_without_a_display(messages):
    viewer = Viewer(mode="none")
    for message in messages[:200]:
        viewer.step(message)
    _finish(viewer)
    assert isinstance(viewer.canvas, NullCanvas) and viewer.url is None


def test_viewer_takes_topics_of_the_table_only():
    from triline.schemas import topics

    for topic in Viewer.inputs:
        assert topics.find(topic).name == topic
    assert set(scene.TRUTH_TOPICS) <= set(Viewer.inputs) and Viewer.outputs == ()


def test_unknown_mode_is_refused(tmp_path):
    with pytest.raises(ValueError, match="wanted native, web"):
        Viewer(mode="hologram")
    with pytest.raises(UserError, match="cannot be written"):
        Viewer(mode=f"rrd:{tmp_path}/no/flight.rrd")


# ---- Rerun


def _rerun(*arguments):
    environment = {**os.environ, "RUST_LOG": "error", "XDG_CONFIG_HOME": str(_private_folder())}
    return subprocess.run([viewer_binary(), *arguments], capture_output=True, text=True, timeout=600, env=environment)


def test_file_is_whole_and_holds_the_views(messages, tmp_path):
    path = tmp_path / "flight.rrd"
    begun = time.process_time()
    viewer = Viewer(mode=f"rrd:{path}")
    for message in messages:
        if message.topic in Viewer.inputs:
            viewer.step(message)
    _finish(viewer)
    cost = time.process_time() - begun
    assert not viewer.counters and viewer.state() == "running"
    assert cost < 0.25 * 34, "drawing a flight takes a quarter of a core"
    verified = _rerun("rrd", "verify", str(path))
    assert verified.returncode == 0, verified.stderr
    listing = _rerun("rrd", "print", str(path)).stdout
    for entity in (
        "/flight/trajectory/0", "/flight/live/0", "/flight/final/0", "/flight/truth/0", "/flight/sigma/0",
        "/points/final/0",
        "/points/control", "/points/misfit", "/image/F/residuals", "/image/N/residuals", "/image/B/residuals",
        "/plots/sigma0/value", "/plots/latency/data", "/plots/corrections/dkappa/upper", "/map/gnss/0", "/log",
        "/legend",
    ):  # fmt: skip
        assert entity in listing, entity


def _listening_ports(pids):
    """(address, port) of the TCP sockets that processes listen on, from the kernel's tables."""
    inodes = set()
    for pid in pids:
        for fd in os.listdir(f"/proc/{pid}/fd"):
            with contextlib.suppress(OSError):
                inodes.add(os.readlink(f"/proc/{pid}/fd/{fd}").removeprefix("socket:[").rstrip("]"))
    found = set()
    for table in ("tcp", "tcp6"):
        for line in Path(f"/proc/net/{table}").read_text().splitlines()[1:]:
            fields = line.split()
            if fields[3] == "0A" and fields[9] in inodes:
                address, port = fields[1].split(":")
                name = socket.inet_ntoa(bytes.fromhex(address)[::-1]) if table == "tcp" else address
                found.add((name, int(port, 16)))
    return found


def _family(pid):
    """A process and all that descend from it."""
    children = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    return [pid, *(p for child in children for p in _family(int(child)))]


def test_web_viewer_listens_on_loopback_only_and_goes_with_us(messages):
    if not sys.platform.startswith("linux"):
        pytest.skip("reads the kernel's tables")
    viewer = Viewer(mode="web")
    process = viewer.canvas.process
    pids = _family(process.process.pid)
    ports = _listening_ports(pids)
    assert ports == {("127.0.0.1", process.grpc_port), ("127.0.0.1", process.web_port)}
    settings = json.loads((_private_folder() / "rerun" / "analytics.json").read_text())
    assert settings["analytics_enabled"] is False
    assert viewer.url and viewer.url.startswith(f"http://127.0.0.1:{process.web_port}/")
    with urllib.request.urlopen(f"http://127.0.0.1:{process.web_port}/", timeout=10) as answer:
        assert answer.status == 200 and b"rerun" in answer.read().lower()
    for message in messages[:3000]:
        if message.topic in Viewer.inputs:
            viewer.step(message)
    _finish(viewer)
    assert viewer.state() == "the viewer was closed" and not viewer.counters
    assert not any(_alive(pid) for pid in pids)


def test_two_web_viewers_that_start_at_once_take_different_ports(monkeypatch):
    """Both had the same ports: the second ended, and what it was to show went into the first."""
    free = _free_port(0), _free_port(0)  # as the usual ones are where no viewer runs
    monkeypatch.setattr(rerun_process, "_FIRST_PORTS", dict(zip(("grpc", "web"), free, strict=True)))
    with ThreadPoolExecutor() as pool:
        first, second = pool.map(lambda _: ViewerProcess(web=True), range(2))
    try:
        assert len({first.grpc_port, first.web_port, second.grpc_port, second.web_port}) == 4
    finally:
        first.close()
        second.close()
    assert not first.running and not second.running


def test_web_viewer_ends_with_a_killed_node(tmp_path):
    if not sys.platform.startswith("linux"):
        pytest.skip("only Linux ends a child with its parent")
    code = (
        "from triline.nodes.viewer.rerun_process import ViewerProcess; import time;"
        "v = ViewerProcess(web=True); print(v.process.pid, flush=True); time.sleep(60)"
    )
    node = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
    assert node.stdout is not None
    pid = int(node.stdout.readline())
    node.kill()
    node.wait()
    wait_for(lambda: not _alive(pid), 10, "the end of the viewer")


def _alive(pid):
    try:
        with open(f"/proc/{pid}/stat") as file:
            return file.read().rsplit(")", 1)[1].split()[0] != "Z"
    except FileNotFoundError:
        return False


def test_native_viewer_without_a_display_is_refused(monkeypatch, recording, capsys):
    if not sys.platform.startswith("linux"):
        pytest.skip("other systems always have a display")
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    with pytest.raises(UserError, match="no display"):
        open_canvas("native")
    assert main(["view", str(recording)]) == 1
    assert "--web or --rrd" in capsys.readouterr().err
    assert main(["node", "viewer"]) == 1
    assert "triline node viewer: --set mode=web" in capsys.readouterr().err


class _Stream:
    """A stream whose first two flushes fail."""

    def __init__(self):
        self.flushes, self.disconnected = 0, False

    def log(self, *args, **kwargs):
        pass

    def flush(self, timeout_sec):
        self.flushes += 1
        if self.flushes <= 2:
            raise RuntimeError("Flush timed out - not all log messages were sent")

    def disconnect(self):
        self.disconnected = True


def _ended(tmp_path, code):
    """The viewer as a program that says something and ends with a code; None: it goes on."""
    viewer = ViewerProcess.__new__(ViewerProcess)
    viewer._log = tmp_path / "viewer.log"
    viewer._log.write_text("\x1b[2mstarting\x1b[0m\n\x1b[31mError\x1b[0m: no graphics adapter\n")
    program = "import time; time.sleep(60)" if code is None else f"raise SystemExit({code})"
    viewer.process = subprocess.Popen([sys.executable, "-c", program])
    if code is not None:
        viewer.process.wait(20)
    return viewer


def test_a_viewer_that_is_slow_gets_all(tmp_path):
    viewer, stream = _ended(tmp_path, None), _Stream()
    try:
        RerunCanvas(stream, viewer).close()
        assert stream.flushes == 3 and stream.disconnected
    finally:
        viewer.process.kill()
        viewer.process.wait(20)


def test_a_window_that_is_closed_while_it_loads_is_no_fault(tmp_path):
    stream = _Stream()
    RerunCanvas(stream, _ended(tmp_path, 0)).close()
    assert stream.flushes == 1 and stream.disconnected


def test_a_viewer_that_cannot_go_on_says_why(tmp_path):
    viewer, stream = _ended(tmp_path, 1), _Stream()
    with pytest.raises(UserError, match=r"^the viewer ended: Error: no graphics adapter; .*--web"):
        RerunCanvas(stream, viewer).close()
    assert stream.disconnected
    with pytest.raises(UserError, match="no graphics adapter"):
        viewer.wait()


def test_a_viewer_that_was_killed_says_so(tmp_path):
    """It gave the last line of the log, whatever that was, as the reason."""
    viewer = _ended(tmp_path, None)
    viewer.process.kill()
    with pytest.raises(UserError, match=r"^the viewer ended: it was killed, as by the system where memory runs out; "):
        viewer.wait()


def test_view_command_writes_a_file(recording, messages, tmp_path, capsys):
    target = tmp_path / "view.rrd"
    assert main(["view", str(recording), "--rrd", str(target), "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed["messages"]["orientation/final"] == sum(m.topic == "orientation/final" for m in messages)
    assert _rerun("rrd", "verify", str(target)).returncode == 0
    assert printed["mode"] == f"rrd:{target}"
    assert main(["view", str(tmp_path / "none.mcap"), "--rrd", str(target)]) == 1
    assert main(["view", str(recording), "--rrd", str(tmp_path / "no" / "x.rrd")]) == 1
    err = capsys.readouterr().err
    assert "no such file" in err and f"{tmp_path / 'no' / 'x.rrd'}: no folder" in err and "Traceback" not in err
    assert main(["view", "--fleet", str(recording), "--rrd", str(tmp_path / "fleet.rrd"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["messages"] > 0


def test_a_scene_stays_where_there_is_none_to_take_its_place(recording, tmp_path, capsys):
    target, empty = tmp_path / "view.rrd", write_recording(tmp_path / "empty.mcap", [])
    target.write_text("the one before")
    assert main(["view", str(empty), "--rrd", str(target)]) == 1
    assert "nothing in it that can be shown" in capsys.readouterr().err
    for size in (20_000, 0):
        with files_of_at_most(size):
            assert main(["view", str(recording), "--rrd", str(target)]) == 1
        err = capsys.readouterr().err
        assert f"triline view: {target}: cannot be written: its writer has given up, as on a full disk" in err
    assert target.read_text() == "the one before" and len(list(tmp_path.iterdir())) == 2


@pytest.mark.parametrize("seed", range(3))
def test_numbers_that_are_not_finite_do_not_end_the_view(messages, seed):
    rng = np.random.default_rng(seed)
    canvas = Notebook()
    viewer = Viewer(canvas=canvas)
    refused = 0
    for m in messages:
        if m.topic in Viewer.inputs:
            body = spoilt_copy(m.body, rng) if rng.random() < 0.1 else m.body
            try:
                body = codec.decode(m.topic, codec.encode(body))  # as bus and recordings hand it to every node
            except ValueError:
                refused += 1
            else:
                viewer.step(Message(m.topic, m.stamp_ns, body, m.source, m.sequence))
    _finish(viewer)
    assert viewer.state() == "running", viewer.last_problem
    assert not viewer.counters["view failed"] and refused > 20
    for entity, what in canvas.drawn.items():
        for values in what:
            if isinstance(values, np.ndarray):
                assert np.isfinite(values).all(), entity


def test_view_command_serves_until_it_is_told_to_stop(messages, tmp_path):
    if not sys.platform.startswith("linux"):
        pytest.skip("reads the kernel's tables")
    end_ns = START_NS + 5 * 10**9  # what is shown does not matter
    recording = write_recording(tmp_path / "flight.mcap", [x for x in messages if x.stamp_ns < end_ns])
    command = [sys.executable, "-m", "triline.nodes.cli", "view", str(recording), "--web"]
    view = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert view.stdout is not None and view.stderr is not None
    assert view.stdout.readline().startswith("http://127.0.0.1:")
    family = _family(view.pid)
    assert len(family) >= 2 and {address for address, _ in _listening_ports(family)} == {"127.0.0.1"}
    view.terminate()
    assert view.wait(120) == 0 and view.stderr.read() == ""
    assert not any(_alive(pid) for pid in family)
