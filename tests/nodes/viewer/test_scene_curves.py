"""Curves and deviations of the scene: the window's part, gaps in turns, what stays in view."""

from __future__ import annotations

import numpy as np
import pytest
from notebook import Notebook
from synthetic_flight import LIVE_SIGMA, START_NS, flight_messages

from triline.nodes import convert
from triline.nodes.cli.view import show
from triline.nodes.node import Message
from triline.nodes.viewer.rerun_canvas import _corrections, _overview, viewpoint
from triline.nodes.viewer.scene import Scene
from triline.schemas import messages as m

WINDOW_S = 9.0
TURN_S = 60.0


def _shifted(message, seconds, strip):
    """A message of a later strip."""
    ns = round(seconds * convert.SECOND_NS)
    body = type(message.body)()
    body.CopyFrom(message.body)
    if message.topic == "configuration/strip":
        body.id, body.first_line_time_ns = strip, body.first_line_time_ns + ns
    elif hasattr(body, "timestamp"):
        convert.set_time(body.timestamp, convert.time_ns(body.timestamp) + ns)
    if getattr(body, "strip", "") == "S1":
        body.strip = strip
    if message.topic == "adjustment/report":
        body.window_start_ns, body.window_end_ns = body.window_start_ns + ns, body.window_end_ns + ns
    return Message(message.topic, message.stamp_ns + ns, body, message.source, message.sequence)


@pytest.fixture(scope="module")
def strip():
    """One strip, with reports that say where the window begins."""
    told = []
    for message in flight_messages(seconds=34.0, points=60):
        if message.topic == "adjustment/report":
            body = message.body
            body.strip, body.update_interval_s = "S1", 0.2
            body.window_start_ns = max(
                message.stamp_ns - round(WINDOW_S * convert.SECOND_NS), START_NS + 2 * convert.SECOND_NS
            )
            body.protection.extend([1.0, 2.0, 1.5, 1e-4, 1e-4, 1e-4])
            body.ground_protection.extend([0.5, 0.9, 0.7, 0.6])
            body.alert_limit_m = 2.5
            body.sigma.extend([0.1, 0.2, 0.3, 1e-5, 1e-5, 1e-5])
        told.append(message)
    return told


@pytest.fixture(scope="module")
def block(strip):
    """Two strips with a turn between."""
    later = [_shifted(k, 34.0 + TURN_S, "S2") for k in strip if not k.topic.startswith(("configuration/p", "observ"))]
    return sorted(strip + later, key=lambda message: message.stamp_ns)


@pytest.fixture(scope="module")
def notes(block):
    canvas = Notebook()
    show(block, canvas)
    return canvas


def test_curves_are_not_drawn_across_a_turn(notes):
    checked = 0
    for entity, (time_s, values) in notes.curves.items():
        if entity.endswith(("/filtered", "events")) or "window/" in entity or len(time_s) < 50:
            continue
        t, v = np.array(time_s), np.array(values)
        assert (np.diff(t) > 0).all(), entity
        joined = np.isfinite(v[1:]) & np.isfinite(v[:-1])
        assert np.diff(t)[joined].max() < 5.0, entity
        assert np.isnan(v).sum() >= 1, entity
        checked += 1
    for entity in ("sigma0/value", "corrections/dX/final", "overview/position/dX", "overview/integrity/protection",
                   "errors/position/final", "integrity/position/X_protection"):  # fmt: skip
        t, v = notes.curves[f"plots/{entity}"]
        assert np.isnan(v).sum() == 1 and 34.0 < t[int(np.flatnonzero(np.isnan(v))[0])] < 34.0 + TURN_S, entity
    assert checked > 30
    assert set(np.array(notes.curves["plots/overview/integrity/limit"][1])[:10]) == {2.5}
    assert set(np.array(notes.curves["plots/overview/integrity/ground"][1])[:10]) == {0.9}


def test_curves_of_a_recording_come_in_few_pieces_and_with_all_that_a_live_scene_draws(strip):
    drawn, pieces = [], []
    for recorded in (False, True):
        canvas = Notebook()
        calls, curve = [], canvas.curve
        canvas.curve = lambda *words, calls=calls, curve=curve: (calls.append(words), curve(*words))
        scene = Scene(canvas, recorded)
        for message in strip:
            scene.take(message)
            scene.draw()
        scene.close()
        drawn.append(canvas.curves)
        pieces.append(len(calls))
    assert drawn[0].keys() == drawn[1].keys()
    for entity, curves in drawn[0].items():
        np.testing.assert_array_equal(curves, drawn[1][entity], entity)
    assert pieces[1] == len(drawn[1]) < 0.1 * pieces[0]


def test_deviations_are_not_joined_from_strip_to_strip(notes):
    for entity in ("flight/live", "flight/final", "flight/truth"):
        pieces = notes.pieces(entity)
        assert len(pieces) > 0, entity
        for strips in pieces:
            steps = np.linalg.norm(np.diff(strips[0], axis=0), axis=1)
            assert steps.max() < 200.0, entity  # 14 m between samples, and exaggerated errors


def test_names_stand_on_the_side_of_the_eye_on_strips_that_are_flown_back(strip, block):
    canvas, back = Notebook(), Notebook()
    show(strip, canvas)
    turned = []
    for k in block:
        body = k.body
        if k.stamp_ns > START_NS + 40 * convert.SECOND_NS and hasattr(body, "pose"):
            body = type(body)()
            body.CopyFrom(k.body)
            q = body.pose.orientation
            q.x, q.y, q.z, q.w = q.y, -q.x, q.w, -q.z  # half a turn about the vertical
        turned.append(Message(k.topic, k.stamp_ns, body, k.source, k.sequence))
    show(turned, back)
    to_eye, target = viewpoint(back.layouts[-1])
    for notes in (canvas, back):
        name = notes.drawn["flight/window/live/name"][0][0]
        outline = notes.drawn["flight/window/live"][0][0]
        assert (name - outline.mean(axis=0))[:2] @ (to_eye - target)[:2] > 0


def test_the_window_s_part_of_the_correction_functions_has_the_band_of_live(notes, block):
    scale = np.array([1.0, 1.0, 1.0, *[1000 * np.degrees(1.0)] * 3])
    for i, name in enumerate(("dX", "dY", "dZ", "domega", "dphi", "dkappa")):
        _, value = notes.curves[f"plots/corrections/{name}/window"]
        for bound, sign in (("upper", 1.0), ("lower", -1.0)):
            _, limit = notes.curves[f"plots/corrections/{name}/window_{bound}"]
            width = np.array(limit) - np.array(value)
            np.testing.assert_allclose(width[np.isfinite(width)], sign * 3 * LIVE_SIGMA[i] * scale[i], rtol=1e-6)
    live, final = (notes.styles[f"plots/corrections/dX/{n}"] for n in ("window", "final"))
    assert live.color != final.color
    t, _ = notes.curves["plots/corrections/dX/window"]
    newest = max(convert.time_ns(k.body.timestamp) for k in block if k.topic == "orientation/live")
    assert t[-1] == pytest.approx((newest - START_NS) / convert.SECOND_NS, abs=0.25)


def test_no_more_of_it_is_shown_than_the_window_holds(notes):
    """Views count back from the time cursor, as far as the reports say."""
    layout = notes.layouts[-1]
    assert layout.window_s == pytest.approx(WINDOW_S, rel=0.25) and layout.strip_s == pytest.approx(30.0)
    plots = {view.origin: view for view in _corrections(layout).contents}
    for name in ("dX", "dkappa"):
        ranges = plots[f"/plots/corrections/{name}"].visualizer_overrides
        hidden = {f"/plots/corrections/{name}/{kind}" for kind in ("window", "window_upper", "window_lower")}
        assert set(ranges) == hidden
        bound = next(iter(ranges.values())).ranges.as_arrow_array().to_pylist()[0]["range"]["start"]
        assert bound == pytest.approx(-layout.window_s * convert.SECOND_NS, abs=1)
    # until something has left the window all of it is live
    early = notes.layouts[0]
    assert early.window_s is None
    assert not {view.origin: view for view in _corrections(early).contents}[
        "/plots/corrections/dX"
    ].visualizer_overrides
    assert _overview(layout) is not None


@pytest.mark.parametrize("sigma_m", [0.3, 1.5, 6.0])
def test_deviations_as_large_as_the_project_expects_stay_in_view(strip, sigma_m):
    project = m.Project(name="p", crs="local", origin_latitude=47.0, origin_longitude=8.0, wander_time_s=30.0)
    project.wander_sigma_m.extend([sigma_m] * 3)
    canvas = Notebook()
    first = Message("configuration/project", strip[0].stamp_ns, project, "test", 0)
    show([first, *(k for k in strip if k.topic != "configuration/project")], canvas)
    factor = float(canvas.layouts[-1].title.split("3 sigma x ")[1].split(",")[0])
    corners = canvas.layouts[-1].corners
    air = corners[corners[:, 2] > 750.0]
    assert np.ptp(air[:, 2]) >= 2 * 3 * factor * sigma_m
    assert 0.08 * 1500 < 3 * factor * sigma_m < 0.4 * 1500  # seen, and not larger than the flight is high


def test_what_has_failed_stays_in_view(strip, notes):
    """A sigma0 beyond 1.3 was drawn outside of its plot, and one level of a young window made all others a line."""
    told, reports = [], 0
    for message in strip:
        if message.topic == "adjustment/report":
            body = type(message.body)()
            body.CopyFrom(message.body)
            body.redundancy, body.sigma0, reports = 300, 2.2, reports + 1
            if reports == 3:
                body.sigma0, body.protection[1], body.ground_protection[1] = 90.0, 2e5, 3e5
            message = Message(message.topic, message.stamp_ns, body, message.source, message.sequence)
        told.append(message)
    canvas = Notebook()
    show(told, canvas)
    assert notes.layouts[-1].sigma0 == (0.7, 1.3) and canvas.layouts[-1].sigma0 == (0.7, 4.0 * 1.3)
    for curve, usual in (("protection", 2.0), ("ground", 0.9)):
        values = np.array(canvas.curves[f"plots/overview/integrity/{curve}"][1])
        assert (values.min(), values.max()) == (usual, 25.0), curve
    assert max(canvas.curves["plots/integrity/position/Y_protection"][1]) == 2e5
