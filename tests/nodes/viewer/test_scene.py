"""The scene: what is drawn of the messages, where, how large and in which colour."""

from __future__ import annotations

import re
from collections import defaultdict
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from notebook import Notebook
from synthetic_flight import START_NS, flight_messages

from triline.nodes import convert
from triline.nodes.cli.view import show
from triline.nodes.convert import PoseSample
from triline.nodes.node import Message
from triline.nodes.viewer.incoming_lines import LinesPart
from triline.nodes.viewer.orthoimages import MosaicPart
from triline.nodes.viewer.rerun_canvas import _ASPECT, _FIELD_OF_VIEW, _overview, viewpoint
from triline.nodes.viewer.scene_part import CHECK, CONTROL, FINAL, LIVE, REJECTED, Pieces
from triline.nodes.viewer.scene_state import PoseHistory, SceneState, round_number
from triline.nodes.viewer.trajectories import FlightPart, ellipsoid
from triline.schemas.image_lines import LineBlock
from triline.schemas.messages import GroundTile, ImagePoint, TiePoint
from triline.solver.camera.sensors import preset
from triline.solver.geometry.rotation import matrix_from_quaternion

GSD_M = 1500.0 * 0.0065 / 62.7


@pytest.fixture(scope="module")
def messages():
    return flight_messages(seconds=34.0, points=150)


@pytest.fixture(scope="module")
def notes(messages):
    canvas = Notebook()
    show(messages, canvas)
    return canvas


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


def test_misfits_are_of_given_coordinates_alone(messages):
    """A planimetric point stands at any height."""
    canvas, own = Notebook(), ("configuration/", "observation/control", "trajectory/", "point/object")
    chosen = [m for m in messages if m.topic.startswith(own)]
    for k, message in enumerate(chosen):
        if message.topic == "observation/control":
            body = type(message.body).FromString(message.body.SerializeToString())
            body.role, body.z = body.PLANIMETRIC, body.z + 60.0
            chosen[k] = replace(message, body=body)
    show(chosen, canvas)
    vectors = canvas.drawn["points/misfit"][1]
    assert len(vectors) and np.abs(vectors[:, :2]).max() > 0.0 and np.abs(vectors[:, 2]).max() == 0.0


def test_residuals_in_image_space_have_the_size_of_the_bar(notes, messages, bar_px=1.0):
    final = [m.body for m in messages if m.topic == "point/object" and m.body.status == 1]
    for line in preset("ads40").lines:
        rays = [r for p in final for r in p.residuals if r.ccd == line.id]
        origins, vectors, _ = notes.drawn[f"image/{line.id}/residuals"]
        bar = notes.drawn[f"image/{line.id}/scale"][1][0, 0]
        kept = sorted((r.sample, r.v_sample, r.v_line) for r in rays if not r.rejected)
        order = np.argsort(origins[:, 0])
        np.testing.assert_allclose(origins[order, 0], [s for s, _, _ in kept])
        np.testing.assert_allclose(vectors[order] / bar * bar_px, [[x, -y] for _, x, y in kept], rtol=1e-9)
        bad = notes.drawn[f"image/{line.id}/rejected"]
        assert len(bad[0]) == sum(r.rejected for r in rays)
        assert not len(bad[1]) or np.linalg.norm(bad[1], axis=1).max() <= 2.001 * bar


def test_residuals_of_points_that_several_strips_see_are_shown(messages):
    """Each look of another strip had wiped what the views showed: of scenes nearly all."""
    strip = next(m for m in messages if m.topic == "configuration/strip")
    scenes = [replace(strip, body=type(strip.body).FromString(strip.body.SerializeToString())) for _ in "FNB"]
    for ccd, scene in zip("FNB", scenes, strict=True):
        scene.body.id = f"scene/{ccd}"
    points = []
    for message in messages:
        if message.topic == "point/object":
            body = type(message.body).FromString(message.body.SerializeToString())
            for r in body.residuals:
                r.strip = f"scene/{r.ccd}"
            points.append(replace(message, body=body))
    configuration = [m for m in messages if m.topic in ("configuration/project", "configuration/camera")]
    canvas = Notebook()
    show([*configuration, *scenes, *points], canvas)
    for ccd in "FNB":
        told = {(m.body.point, round(r.line)) for m in points for r in m.body.residuals if r.ccd == ccd}
        shown = sum(len(canvas.drawn[f"image/{ccd}/{name}"][0]) for name in ("residuals", "rejected"))
        assert shown == len(told) > 100


def test_an_earlier_strip_does_not_come_back_into_view(messages):
    strip = next(m for m in messages if m.topic == "configuration/strip")
    before = type(strip.body).FromString(strip.body.SerializeToString())
    before.id, before.first_line_time_ns = "S0", before.first_line_time_ns - 10**11
    chosen = [m for m in messages if m.topic.startswith("configuration/")]
    points = [m for m in messages if m.topic == "point/object"]
    late = type(points[-1].body).FromString(points[-1].body.SerializeToString())
    for r in late.residuals:
        r.strip = "S0"
    canvas, usual = Notebook(), Notebook()
    show([*chosen, *points], usual)
    show([replace(strip, body=before), *chosen, *points, replace(points[-1], body=late)], canvas)
    assert len(canvas.drawn["image/N/residuals"][0]) == len(usual.drawn["image/N/residuals"][0]) > 100


def test_times_count_from_the_start_also_where_stamps_begin_at_zero(messages):
    """Sensor folders count seconds from where they will: all that was flown stood at 0 s."""
    kept = [m for m in messages if m.topic == "event/log"]
    canvas = Notebook()
    show([replace(m, stamp_ns=m.stamp_ns - START_NS) for m in kept], canvas)
    assert len(canvas.moments) >= 2 and canvas.moments[-1] == pytest.approx(17.0)


def test_a_swath_lies_where_the_ccd_line_of_its_strip_looks(messages):
    """Of a scene that looks forward it lay under the platform, kilometres from its points."""
    chosen = [m for m in messages if m.topic.startswith(("configuration/", "observation/control", "trajectory/"))]
    tie = next(m for m in messages if m.topic == "observation/tie")
    body = type(tie.body).FromString(tie.body.SerializeToString())
    forward = [image for image in body.images if image.ccd == "F"]
    del body.images[:]
    body.images.extend(forward)
    ahead, usual = Notebook(), Notebook()
    show(chosen, usual)
    show([*chosen, replace(tie, body=body, stamp_ns=chosen[-1].stamp_ns)], ahead)
    swath, under = (canvas.drawn["flight/window/live"][0][0] for canvas in (ahead, usual))
    line = preset("ads40").lines[0]
    reach = line.xy_mm[0, 0] / preset("ads40").focal_length_mm[0] * 1500.0
    np.testing.assert_allclose(np.linalg.norm((swath - under)[:, :2], axis=1), abs(reach), rtol=0.05)


def test_a_trajectory_alone_is_in_view(messages):
    """Without a strip the views were never arranged: the viewer showed its own panels, and a piece of the line."""
    canvas = Notebook()
    show([m for m in messages if m.topic in ("configuration/project", "sensor/gnss", "trajectory/filtered")], canvas)
    layout = canvas.layouts[-1]
    flown = np.vstack([strips[0] for strips in canvas.pieces("flight/trajectory")])
    low, high = layout.corners.min(axis=0), layout.corners.max(axis=0)
    assert (low <= flown.min(axis=0)).all() and (high >= flown.max(axis=0)).all()
    assert np.ptp(layout.corners, axis=0).max() < 1.2 * np.ptp(flown, axis=0).max()
    assert layout.title == "Trajectory, filtered" and not layout.adjusted and layout.geographic_centre is not None
    assert len(canvas.layouts) < 8  # each moves the eye of who looks on


def test_fixes_alone_are_in_view(messages):
    """As long as the inertial unit is off, or of a flight that had none."""
    canvas = Notebook()
    fixes = [m for m in messages if m.topic == "sensor/gnss"]
    show([*(m for m in messages if m.topic == "configuration/project"), *fixes], canvas)
    layout = canvas.layouts[-1]
    middle = [np.mean([m.body.latitude for m in fixes]), np.mean([m.body.longitude for m in fixes])]
    np.testing.assert_allclose(layout.geographic_centre, middle, atol=2e-3)
    assert np.ptp(layout.corners, axis=0).max() > 1000 and np.vstack(canvas.pieces("map/gnss")).shape[0] > 10
    assert layout.title == "No trajectory yet; fixes are on the map"


def test_before_the_first_strip_the_views_are_arranged(messages):
    canvas = Notebook()
    until = START_NS + 15 * 10**8
    show([m for m in messages if m.stamp_ns < until], canvas)
    assert canvas.layouts and canvas.layouts[-1].adjusted and set(canvas.layouts[-1].ccds) == set("FNB")


def test_small_residuals_get_a_smaller_bar(messages):
    small = []
    for m in messages:
        body = type(m.body)()
        body.CopyFrom(m.body)
        if m.topic == "point/object":
            for r in body.residuals:
                r.v_line, r.v_sample = 0.1 * r.v_line, 0.1 * r.v_sample
        small.append(Message(m.topic, m.stamp_ns, body, m.source, m.sequence))
    canvas = Notebook()
    show(small, canvas)
    titles = canvas.layouts[-1].ccds.values()
    assert {re.sub(".* bar = ", "", title) for title in titles} == {"0.1 px"}
    test_residuals_in_image_space_have_the_size_of_the_bar(canvas, small, bar_px=0.1)


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
    assert len(notes.curves["plots/errors/position/live"][0]) > 0.9 * len(notes.curves["plots/corrections/dX/live"][0])
    error = {n: np.mean(notes.curves[f"plots/errors/position/{n}"][1]) for n in ("filtered", "live", "final")}
    assert error["final"] < error["live"] < error["filtered"]
    assert notes.curves["plots/parameters/mdeg/domega"][1][-1] == pytest.approx(np.degrees(9e-5) * 1000)
    assert {"m", "mdeg", "determined"} == set(notes.layouts[-1].units)
    assert ("navigator: GNSS outage of 1.4 s, coasting", "WARN") in notes.events


def test_the_map_shows_where_it_is(notes):
    track = np.vstack(notes.pieces("map/final"))
    assert np.abs(track - [47.0, 8.0]).max() < 0.1 and np.ptp(track[:, 0]) > 0.005


def test_a_project_without_a_place_is_on_no_map(messages):
    """It was at 0 N 0 E."""
    canvas = Notebook()
    nowhere = []
    for x in messages:
        if x.topic == "configuration/project":
            body = type(x.body).FromString(x.body.SerializeToString())
            body.origin_latitude = body.origin_longitude = body.origin_height = 0.0
            x = replace(x, body=body)
        if x.topic != "sensor/gnss":
            nowhere.append(x)
    show(nowhere, canvas)
    assert canvas.layouts[-1].geographic_centre is None
    assert not [entity for entity in canvas.drawn if entity.startswith("map/")]
    assert canvas.pieces("flight/final")


def test_the_map_draws_no_final_track_from_strip_to_strip(messages):
    final = [m for m in messages if m.topic == "orientation/final"]
    begin, end = (convert.time_ns(final[len(final) * k // 6].body.timestamp) for k in (2, 3))
    assert end - begin > 3e9
    canvas = Notebook()
    show([m for m in messages if m not in final or not begin < convert.time_ns(m.body.timestamp) < end], canvas)
    lines = canvas.pieces("map/final")
    assert len(lines) == 2
    north = [np.abs(np.diff(line[:, 0])).max() for line in lines]
    assert max(north) < 2e-3  # degrees a second of flight: nothing is drawn across the gap


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


@pytest.mark.parametrize(("lines", "residuals", "images"), [(1, 1, 1), (3, 1, 3), (9, 2, 5)])
def test_views_of_many_ccd_lines_stand_in_rows_and_columns(notes, lines, residuals, images):
    """Residuals of nine lay one upon the other, 50 points high, and left the curves a hundred; image lines of nine
    were 76 points wide, with three letters of their names."""
    names = {f"L{k}": f"Residuals L{k}" for k in range(lines)}
    layout = replace(notes.layouts[-1], ccds=names, image_size=(12000.0, 1920.0), lines_size=(400.0, 1240.0))
    side, plots = _overview(layout).contents[1].contents
    assert (side.grid_columns, len(side.contents)) == (residuals, lines) and len(plots.contents) == 4
    lines_shown = _overview(replace(layout, lines=tuple(names))).contents[1].contents[0]
    assert (lines_shown.grid_columns, len(lines_shown.contents)) == (images, lines)


def test_a_scene_without_configuration_draws_what_it_can(messages):
    canvas = Notebook()
    counts = show([m for m in messages if not m.topic.startswith(("configuration/", "observation/"))], canvas)
    assert counts["trajectory/filtered"] and canvas.pieces("flight/trajectory") and canvas.closed == 1


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
    R = matrix_from_quaternion(q)
    np.testing.assert_allclose(R @ np.diag((half / 2) ** 2) @ R.T, root @ root.T, atol=1e-12)


@pytest.mark.parametrize(("value", "expected"), [(60, 50), (75, 100), (24, 20), (100, 100), (0.011, 0.01), (387, 500)])
def test_scales_are_round(value, expected):
    assert round_number(value) == pytest.approx(expected)


def test_a_recording_with_a_smoothed_trajectory_only_is_shown(messages):
    canvas = Notebook()
    renamed = [
        Message("trajectory/smoothed", m.stamp_ns, m.body, m.source, m.sequence)
        if m.topic == "trajectory/filtered"
        else m
        for m in messages
    ]
    show(renamed, canvas)
    assert canvas.pieces("flight/trajectory") and "Deviations from smoothed" in canvas.layouts[-1].title
    assert canvas.curves["plots/errors/position/smoothed"][0]
    both = Notebook()
    show(sorted(messages + renamed, key=lambda m: m.stamp_ns), both)
    assert "Deviations from filtered" in both.layouts[-1].title


def test_a_simulated_flight_that_no_navigator_has_seen_is_shown(messages):
    canvas = Notebook()
    kept = ("configuration/", "sensor/", "observation/", "truth/")
    show([m for m in messages if m.topic.startswith(kept)], canvas)
    drawn = np.vstack([strips[0] for strips in canvas.pieces("flight/trajectory")])
    assert np.ptp(drawn[:, :2], axis=0).max() > 1500
    assert "Deviations from truth" in canvas.layouts[-1].title


def test_who_joins_late_sees_the_whole_strip_in_its_place(messages):
    late = START_NS + 15 * convert.SECOND_NS
    canvas, usual = Notebook(), Notebook()
    latched = ("configuration/", "observation/control")
    show([m for m in messages if m.topic.startswith(latched) or m.stamp_ns > late], canvas)
    show(messages, usual)
    # display origins are the same (from control), so the corners can be compared; the flight weaves a little
    np.testing.assert_allclose(canvas.layouts[-1].corners, usual.layouts[-1].corners, atol=120)


def test_the_window_is_shown_on_the_ground_and_the_light_beside_it(messages):
    """Outlines of the marginal and the live part meet where the window begins; residuals of live points are bright."""
    canvas = Notebook()
    show(messages, canvas)
    assert not any(entity.startswith("light") for entity in canvas.drawn)  # reports that do not say: no light
    told = []
    for message in messages:
        body = message.body
        if message.topic == "adjustment/report":
            body = type(body)()
            body.CopyFrom(message.body)
            body.light, body.light_reason, body.strip = (
                "weak",
                "no control within 40 s; height datum rests on GNSS",
                "S1",
            )
            body.window_start_ns = max(body.window_end_ns - 8 * convert.SECOND_NS, 0)
            body.protection.extend([1.0] * 6)
        told.append(Message(message.topic, message.stamp_ns, body, message.source, message.sequence))
    show([m for m in told if not (m.topic == "point/object" and m.body.status == 1)], canvas)
    _, colors, labels = canvas.drawn["light/reason"]
    assert labels[0].startswith("WEAK: no control within 40 s;") and colors[0][0] > colors[0][2]
    assert len(canvas.drawn["light/lamp"][0]) == 1
    marginal, live = (canvas.drawn[f"flight/window/{name}"][0][0] for name in ("marginal", "live"))
    assert len(canvas.drawn["flight/window/border"][0]) == 1
    assert np.abs(marginal[:, None] - live[None]).sum(axis=2).min() < 1e-6
    lengths = [np.ptp(outline[:, :2], axis=0).max() for outline in (marginal, live)]
    assert lengths[0] > lengths[1] > 300.0
    assert len(canvas.drawn["points/fresh"][0]) > 20
    assert canvas.curves["plots/integrity/position/X_protection"][1][-1] == 1.0


def test_a_strip_without_rays_up_to_its_end_is_whole_when_it_is_over(messages):
    """It stayed "live window" where the last ray was more than a second before its end, or where there was none."""
    reports = [m for m in messages if m.topic == "adjustment/report"]
    last, body = reports[-1], type(reports[-1].body)()
    body.update, body.window_start_ns = 99, last.stamp_ns + 5 * convert.SECOND_NS
    over = Message(last.topic, body.window_start_ns, body, last.source, last.sequence + 1)
    canvas = Notebook()
    show([*(m for m in messages if m.topic != last.topic), over], canvas)
    assert canvas.drawn["flight/window/marginal/name"][2] == ["whole strip"]
    assert not canvas.drawn["flight/window/live"][0]


def test_image_lines_of_cameras_that_look_at_once_are_shown_together():
    """Each makes a strip of its own: every block had wiped those of the other, and all views stayed empty."""
    state, canvas = SceneState(), Notebook()
    state.camera = preset("ads40-small")
    part = LinesPart(state)
    pixels = np.tile(np.arange(state.camera.lines[0].pixels, dtype=np.uint16), (50, 1))
    looks = {"F": "S1", "N": "S2"}
    for k in range(4):  # half a second of lines
        for ccd, strip in looks.items():
            block = LineBlock(pixels, ccd, strip, 50 * k, START_NS)
            part.take(Message(f"sensor/lines/{ccd}", START_NS, block))
    images = [ImagePoint(ccd=ccd, strip=strip, line=20.0, sample=99.0) for ccd, strip in looks.items()]
    images.append(ImagePoint(ccd="N", strip="S1", line=30.0, sample=99.0))  # not in the strip that is shown
    part.take(Message("observation/tie", START_NS, TiePoint(point="T1", images=images)))
    part.draw(canvas)
    for ccd in looks:
        assert f"lines/{ccd}/strip/tile/0" in canvas.drawn and len(canvas.drawn[f"lines/{ccd}/strip/ties"][0]) == 1
    part.take(Message("sensor/lines/N", START_NS, LineBlock(pixels, "N", "S3", 0, START_NS)))  # begins anew
    part.draw(canvas)
    assert canvas.drawn["lines/N/strip"][0] == (0.0, 0.0) and canvas.drawn["lines/F/strip"][0][1] > 0.0


def test_looks_have_their_names_where_others_do_not_meet_the_ground():
    """In a steep turn or climb some look above the horizon: all after them had the name of another."""
    state, canvas = SceneState(), Notebook()
    state.camera = preset("ads40")
    part = FlightPart(state)
    for pitch_deg, seen in ((0.0, "FNB"), (70.0, "NB"), (-80.0, "FN"), (180.0, "")):
        half = np.radians(pitch_deg) / 2
        quaternion = np.array([0.0, -np.sin(half), 0.0, np.cos(half)])  # about the axis to the left: the nose goes up
        sample = PoseSample(START_NS, np.array([0.0, 0.0, 1500.0]), quaternion, None, True)
        state.newest = sample
        part.pose("trajectory", sample)
        part.draw(canvas)
        assert "".join(canvas.names["flight/looks"]) == seen, pitch_deg


def test_in_another_local_frame_nothing_of_the_one_before_stays_drawn(messages):
    """Control of before does not count, and all of it would stand 11 km from where it is."""
    project = next(x for x in messages if x.topic == "configuration/project")
    control = [x for x in messages if x.topic == "observation/control"]
    change = START_NS + 17 * 10**9
    body = type(project.body).FromString(project.body.SerializeToString())
    body.origin_latitude += 0.1
    stated = [replace(x, stamp_ns=change + 2) for x in control[:2]]
    truth = [replace(x, source="simulator") for x in messages if x.topic.startswith("truth/")]
    rest = [replace(x, source="simulator") if x is project else x for x in messages if not x.topic.startswith("truth/")]
    said = [replace(project, source="desk", body=body, stamp_ns=change), *stated]
    order = sorted([*rest, *truth, *said], key=lambda x: x.stamp_ns)
    before, canvas = Notebook(), Notebook()
    show([x for x in order if x.stamp_ns < change], before)
    show(order, canvas)
    given = [what for name, what in canvas.drawn.items() if name in ("points/control", "points/check")]
    assert sum(len(what[0]) for what in given) == 2 == sum(map(len, canvas.pieces("map/ground")))
    late = [x for x in messages if x.topic == "point/object" and x.stamp_ns > change and x.body.status == 1]
    assert sum(map(len, canvas.pieces("points/final"))) == len({x.body.point for x in late})
    assert before.pieces("flight/truth") and not canvas.pieces("flight/truth")
    after = sum(len(line[0]) for line in canvas.pieces("flight/trajectory"))
    assert 0 < after < sum(len(line[0]) for line in before.pieces("flight/trajectory")) + 30
    assert len(canvas.layouts) > len(before.layouts)
    lat = [layout.geographic_centre[0] for layout in (before.layouts[-1], canvas.layouts[-1])]
    assert lat[1] - lat[0] == pytest.approx(0.1, abs=0.02)
    assert len(canvas.pieces("map/final")) > len(before.pieces("map/final"))  # where it was flown


def test_tiles_of_another_ccd_line_take_the_place_of_all_before():
    """Tiles of the lens that looks forward stayed beside those of the one that looks down."""
    state, canvas = SceneState(), Notebook()
    state.newest = PoseSample(START_NS, np.array([0.0, 0.0, 1500.0]), np.array([0.0, 0.0, 0.0, 1.0]), None, True)
    part = MosaicPart(state)

    def tile(version, ccd, column):
        grey = bytes([100]) * 16
        body = GroundTile(column=column, size=4, gsd_m=1.0, x=4.0 * column, encoding="mono8", data=grey, ccd=ccd)
        part.take(Message(f"orthoimage/{version}", START_NS, body))

    for version, ccd, column in (("live", "F", 0), ("final", "F", 0), ("live", "F", 1)):
        tile(version, ccd, column)
    part.draw(canvas)
    tile("live", "F", 2)
    tile("live", "N", 3)
    part.draw(canvas)
    assert set(canvas.drawn) == {"mosaic/live/0_3", "mosaic/final/0_0"}
    tile("final", "N", 1)
    tile("live", "N", 4)
    part.draw(canvas)
    assert set(canvas.drawn) == {"mosaic/live/0_3", "mosaic/live/0_4", "mosaic/final/0_1"}
