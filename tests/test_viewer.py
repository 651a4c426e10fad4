"""The scene, the viewer node, and the viewers it can draw in."""

from __future__ import annotations

import contextlib
import json
import os
import socket
import subprocess
import sys
import time
import urllib.request
from collections import defaultdict
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from synthetic_flight import START_NS, flight_messages
from triline.nodes import convert, scene
from triline.nodes.canvas import NullCanvas
from triline.nodes.cli import main
from triline.nodes.cli.view import show
from triline.nodes.errors import UserError
from triline.nodes.node import Message
from triline.nodes.recording import RecordingWriter
from triline.nodes.rerun_scene import _ASPECT, _FIELD_OF_VIEW, open_canvas, viewpoint
from triline.nodes.scene_flight import ellipsoid
from triline.nodes.scene_parts import CHECK, CONTROL, FINAL, LIVE, REJECTED, Pieces
from triline.nodes.scene_state import PoseHistory, round_number
from triline.nodes.viewer import Viewer
from triline.nodes.viewer_process import ViewerProcess, _private_folder, viewer_binary
from triline.solver.sensors import preset

GSD_M = 1500.0 * 0.0065 / 62.7


class Notebook(NullCanvas):
    """A canvas that remembers: entity -> what was drawn last, and how often."""

    def __init__(self):
        self.drawn = {}
        self.times = defaultdict(int)
        self.curves = defaultdict(lambda: ([], []))
        self.styles, self.events, self.layouts, self.closed = {}, [], [], 0

    def _note(self, entity, *what):
        self.drawn[entity] = what
        self.times[entity] += 1

    def points(self, entity, xyz, colors, radius, labels=None):
        assert len(colors) == len(xyz) and np.isfinite(xyz).all()
        self._note(entity, np.array(xyz), list(colors), labels)

    def lines(self, entity, strips, colors, radius, labels=None):
        self._note(entity, [np.array(s) for s in strips], colors)

    def arrows(self, entity, origins, vectors, colors, radius, labels=None):
        assert len(origins) == len(vectors) == len(colors)
        self._note(entity, np.array(origins), np.array(vectors), list(colors))

    def ellipsoids(self, entity, centres, half_axes, quaternions, color):
        self._note(entity, centres, half_axes, quaternions)

    def geographic_line(self, entity, lat_lon, color):
        self._note(entity, np.array(lat_lon))

    def geographic_points(self, entity, lat_lon, colors, radius):
        self._note(entity, np.array(lat_lon), list(colors))

    def style(self, entity, series):
        self.styles[entity] = series

    def curve(self, entity, time_s, values):
        self.curves[entity][0].extend(time_s)
        self.curves[entity][1].extend(values)

    def event(self, entity, text, level):
        self.events.append((text, level))

    def layout(self, layout):
        self.layouts.append(layout)

    def close(self):
        self.closed += 1

    def pieces(self, entity, column=0):
        """What all pieces of an entity hold, in order."""
        names = sorted((n for n in self.drawn if n.startswith(entity + "/")), key=lambda n: int(n.rsplit("/")[-1]))
        return [self.drawn[name][column] for name in names]


@pytest.fixture(scope="module")
def messages():
    return flight_messages(seconds=34.0, points=150)


@pytest.fixture(scope="module")
def notes(messages):
    canvas = Notebook()
    show(messages, canvas)
    return canvas


@pytest.fixture(scope="module")
def recording(messages, tmp_path_factory):
    path = tmp_path_factory.mktemp("viewer") / "flight.mcap"
    with RecordingWriter(path) as writer:
        for message in messages:
            writer.write(message)
    return path


# ---- the scene


def test_display_coordinates_are_near_zero(notes):
    for entity, what in notes.drawn.items():
        if entity.startswith(("flight/", "points/")) and isinstance(what[0], np.ndarray) and len(what[0]):
            assert np.abs(what[0]).max() < 10_000
    control = notes.drawn["points/control"][0]
    assert np.abs(control[:, 2]).max() < 50


def test_deviations_are_exaggerated_as_the_title_says(notes, messages):
    title = notes.layouts[-1].title
    factor = float(title.split("3 sigma x ")[1].split(",")[0])
    assert factor == 100
    final = [convert.pose_sample(m.body) for m in messages if m.topic == "orientation/final"]
    origin = final[0].position_l - final[0].correction[:3] + factor * final[0].correction[:3]
    drawn = np.vstack([strips[0] for strips in notes.pieces("flight/final")])
    origin -= drawn[0]
    assert np.allclose(origin, np.round(origin, -1)) and np.allclose(origin[:2], np.round(origin[:2], -2))
    last = next(s for s in reversed(final) if np.isclose((s.time_ns - final[0].time_ns) % 200_000_000, 0))
    expected = last.position_l + (factor - 1) * last.correction[:3] - origin
    np.testing.assert_allclose(drawn[-1], expected, atol=1e-6)
    # truth lies inside the three-sigma ellipsoids where it does without exaggeration
    half = np.vstack(notes.pieces("flight/sigma", 1))
    np.testing.assert_allclose(np.sort(half, axis=1), np.tile([24.0, 24.0, 30.0], (len(half), 1)), rtol=1e-6)


def test_points_are_coloured_by_status(notes, messages):
    final = {m.body.point: m.body for m in messages if m.topic == "point/object" and m.body.status == 1}
    colors = [color for piece in notes.pieces("points/final", 1) for color in piece]
    rejected = sum(any(r.rejected for r in p.residuals) for p in final.values())
    assert rejected >= 2
    assert colors.count(REJECTED) == rejected and colors.count(FINAL) == len(final) - rejected
    assert set(notes.drawn["points/control"][1]) == {CONTROL} and set(notes.drawn["points/check"][1]) == {CHECK}
    assert len(notes.drawn["points/live"][0]) == len(
        {m.body.point for m in messages if m.topic == "point/object"}
    ) - len(final)


def test_live_points_are_shown_until_they_are_final(messages):
    canvas = Notebook()
    show([m for m in messages if not (m.topic == "point/object" and m.body.status == 1)], canvas)
    assert LIVE in canvas.drawn["points/live"][1] and len(canvas.drawn["points/live"][0]) > 50


def test_residuals_in_object_space_have_the_stated_scale(notes, messages):
    scale = float(notes.layouts[-1].title.split("residuals x ")[1])
    assert scale == 500
    final = [m.body for m in messages if m.topic == "point/object" and m.body.status == 1]
    pixels = np.array([[r.v_line, r.v_sample] for p in final for r in p.residuals if not r.rejected])
    vectors = np.vstack(notes.pieces("points/residuals", 1))
    assert len(vectors) == len(pixels)
    # lines advance by speed / line rate, samples by the ground sampling distance
    expected = scale * np.hypot(pixels[:, 0] * 70.0 / 800.0, pixels[:, 1] * GSD_M)
    np.testing.assert_allclose(np.linalg.norm(vectors, axis=1), expected, rtol=0.02)
    given = {m.body.point: m.body for m in messages if m.topic == "observation/control"}
    _, misfits, _ = notes.drawn["points/misfit"]
    adjusted = [p for p in final if p.point in given]
    assert len(misfits) == len(adjusted) >= 3
    p, g = adjusted[0], given[adjusted[0].point]
    np.testing.assert_allclose(misfits[0], scale * np.array([p.x - g.x, p.y - g.y, p.z - g.z]), rtol=1e-9)


def test_residuals_in_image_space_have_the_size_of_the_bar(notes, messages):
    final = [m.body for m in messages if m.topic == "point/object" and m.body.status == 1]
    for line in preset("ads40").lines:
        rays = [r for p in final for r in p.residuals if r.ccd == line.id]
        origins, vectors, _ = notes.drawn[f"image/{line.id}/residuals"]
        bar = notes.drawn[f"image/{line.id}/scale"][1][0, 0]
        kept = sorted((r.sample, r.v_sample, r.v_line) for r in rays if not r.rejected)
        order = np.argsort(origins[:, 0])
        np.testing.assert_allclose(origins[order, 0], [s for s, _, _ in kept])
        np.testing.assert_allclose(vectors[order] / bar, [[x, -y] for _, x, y in kept], rtol=1e-9)
        bad = notes.drawn[f"image/{line.id}/rejected"]
        assert len(bad[0]) == sum(r.rejected for r in rays)
        assert not len(bad[1]) or np.linalg.norm(bad[1], axis=1).max() <= 2.001 * bar


def test_curves_hold_what_the_messages_say(notes, messages):
    reports = [m.body for m in messages if m.topic == "adjustment/report"]
    time_s, sigma0 = notes.curves["plots/sigma0/value"]
    np.testing.assert_allclose(sigma0, [r.sigma0 for r in reports])
    assert (np.diff(time_s) > 0).all() and time_s[0] == pytest.approx(5.0)
    low, high = (np.array(notes.curves[f"plots/sigma0/{n}"][1]) for n in ("low", "high"))
    inside = np.mean((np.array(sigma0) > low) & (np.array(sigma0) < high))
    assert 0.5 < inside < 1.0 and (low < 1).all() and (high > 1).all()
    # the correction functions approach what the truth asks for
    t, final = (np.array(v) for v in notes.curves["plots/corrections/dX/final"])
    true_t, true = (np.array(v) for v in notes.curves["plots/corrections/dX/truth"])
    left = final - np.interp(t, true_t, true)
    assert 0.03 < np.sqrt(np.mean(left**2)) < 0.15
    error = {n: np.mean(notes.curves[f"plots/errors/position/{n}"][1]) for n in ("filtered", "live", "final")}
    assert error["final"] < error["live"] < error["filtered"]
    assert notes.curves["plots/parameters/mdeg/domega"][1][-1] == pytest.approx(np.degrees(9e-5) * 1000)
    assert {"m", "mdeg"} == set(notes.layouts[-1].units)
    assert ("navigator: GNSS outage of 1.4 s, coasting", "WARN") in notes.events


def test_the_map_shows_where_it_is(notes):
    track = np.vstack(notes.pieces("map/final"))
    assert np.abs(track - [47.0, 8.0]).max() < 0.1 and np.ptp(track[:, 0]) > 0.005


def test_truth_is_not_shown_when_it_is_not_wanted(messages):
    canvas = Notebook()
    show(messages, canvas, truth=False)
    assert not any("truth" in entity for entity in [*canvas.drawn, *canvas.curves])
    assert not canvas.layouts[-1].truth


def test_the_strip_is_in_view(notes):
    layout = notes.layouts[-1]
    eye, target = viewpoint(layout)
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    up = np.cross(right, forward)
    view = layout.corners - eye
    depth = view @ forward
    assert (depth > 0).all()
    x, y = np.abs(view @ right) / depth, np.abs(view @ up) / depth
    half = np.tan(_FIELD_OF_VIEW / 2)
    assert x.max() < half * _ASPECT and y.max() < half
    assert x.max() > 0.7 * half * _ASPECT or y.max() > 0.7 * half  # and not a dot in the distance


def test_a_scene_without_configuration_draws_what_it_can(messages):
    canvas = Notebook()
    counts = show([m for m in messages if not m.topic.startswith(("configuration/", "observation/"))], canvas)
    assert counts["trajectory/filtered"] and canvas.pieces("flight/filtered") and canvas.closed == 1


def test_growing_entities_are_drawn_in_bounded_pieces():
    drawn = defaultdict(list)
    pieces = Pieces("a", size=10, joined=True)
    for i in range(95):
        pieces.add(i)
        pieces.draw(lambda entity, rows: drawn[entity].append(list(rows)))
    assert max(len(rows) for versions in drawn.values() for rows in versions) == 10
    last = [drawn[f"a/{k}"][-1] for k in range(len(drawn))]
    assert [row for k, rows in enumerate(last) for row in (rows if k == 0 else rows[1:])] == list(range(95))
    assert all(a[-1] == b[0] for a, b in pairwise(last))
    before = sum(map(len, drawn.values()))
    pieces.draw(lambda entity, rows: drawn[entity].append(rows))
    assert sum(map(len, drawn.values())) == before


def test_pose_history_interpolates():
    history = PoseHistory()
    for t in range(5):
        sample = convert.PoseSample(t * 100, np.array([t, 2.0 * t, 0.0]), np.array([0, 0, 0, 1.0]), None, True)
        history.add(sample)
    place = history.at(250)
    assert place is not None
    np.testing.assert_allclose(place[0], [2.5, 5.0, 0.0])
    assert history.at(401) is None and history.at(-1) is None and history.newest_ns == 400


def test_ellipsoid_has_the_axes_of_its_covariance():
    rng = np.random.default_rng(0)
    root = rng.normal(size=(3, 3))
    half, q = ellipsoid(root @ root.T, 2.0)
    from triline.solver.rotation import matrix_from_quaternion

    R = matrix_from_quaternion(q)
    np.testing.assert_allclose(R @ np.diag((half / 2) ** 2) @ R.T, root @ root.T, atol=1e-12)


@pytest.mark.parametrize(("value", "expected"), [(60, 100), (24, 50), (100, 100), (0.011, 0.02), (387, 500)])
def test_scales_are_round(value, expected):
    assert round_number(value) == pytest.approx(expected)


# ---- the node


def _finish(viewer):
    viewer.finish()
    assert not viewer._thread.is_alive()


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
    def points(self, *args, **kwargs):
        time.sleep(0.3)


def test_a_slow_viewer_drops_and_counts_and_holds_nobody_up(messages):
    viewer = Viewer(canvas=_Stuck(), queue_size=300)
    wanted = [m for m in messages if m.topic in Viewer.inputs]
    longest, begun = 0.0, time.perf_counter()
    for message in wanted:
        start = time.perf_counter()
        viewer.step(message)
        longest = max(longest, time.perf_counter() - start)
    total = time.perf_counter() - begun
    assert total < 1.0 and longest < 0.2
    assert viewer.counters["view dropped"] > 500
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
    assert viewer.counters["view failed"] == 1 and "no more ink" in viewer.state()


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
    return subprocess.run([viewer_binary(), *arguments], capture_output=True, text=True, timeout=60, env=environment)


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
        "/flight/filtered/0", "/flight/live/0", "/flight/final/0", "/flight/truth/0", "/flight/sigma/0",
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


def test_two_web_viewers_take_different_ports():
    first, second = ViewerProcess(web=True), ViewerProcess(web=True)
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
        "from triline.nodes.viewer_process import ViewerProcess; import time;"
        "v = ViewerProcess(web=True); print(v.process.pid, flush=True); time.sleep(60)"
    )
    node = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
    assert node.stdout is not None
    pid = int(node.stdout.readline())
    node.kill()
    node.wait()
    deadline = time.monotonic() + 5
    while _alive(pid) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not _alive(pid)


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


def test_view_command_writes_a_file(recording, messages, tmp_path, capsys):
    target = tmp_path / "view.rrd"
    assert main(["view", str(recording), "--rrd", str(target), "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed["messages"]["orientation/final"] == sum(m.topic == "orientation/final" for m in messages)
    assert _rerun("rrd", "verify", str(target)).returncode == 0
    assert main(["view", str(tmp_path / "none.mcap"), "--rrd", str(target)]) == 1
    assert main(["view", str(recording), "--rrd", str(tmp_path / "no" / "x.rrd")]) == 1
    err = capsys.readouterr().err
    assert "no such file" in err and "cannot be written" in err and "Traceback" not in err
