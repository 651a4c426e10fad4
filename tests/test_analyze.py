"""Accuracy figures, the evaluation of a recording and its report."""

from __future__ import annotations

import json
import re
from html.parser import HTMLParser

import numpy as np
import pytest
from scipy.optimize import least_squares
from synthetic_flight import flight_messages
from triline.nodes import convert
from triline.nodes.cli import main
from triline.nodes.recording import RecordingWriter
from triline.nodes.report.analysis import analyse
from triline.nodes.report.evaluation import evaluate, evaluate_flight, measured_poses
from triline.nodes.report.flight import collect
from triline.nodes.report.page import page
from triline.solver.accuracy import accuracy, angle_difference, nees_band, normalised_error_squared
from triline.solver.collinearity import project
from triline.solver.sensors import preset
from triline.solver.space_intersection import ImageRays, intersect


@pytest.fixture(scope="module")
def messages():
    return flight_messages(seconds=34.0, points=150)


@pytest.fixture(scope="module")
def recording(messages, tmp_path_factory):
    path = tmp_path_factory.mktemp("analyze") / "flight.mcap"
    with RecordingWriter(path) as writer:
        for message in messages:
            writer.write(message)
    return path


# ---- accuracy


def test_accuracy_of_known_errors():
    error = np.array([[3.0, -1.0], [-4.0, 1.0], [0.0, 3.0], [np.nan, 7.0]])
    a = accuracy(error, np.broadcast_to(np.diag([25.0, 1.0]), (4, 2, 2)))
    assert a.n == 3
    np.testing.assert_allclose(a.rmse, [np.sqrt(25 / 3), np.sqrt(11 / 3)])
    np.testing.assert_allclose(a.mean, [-1 / 3, 1.0])
    np.testing.assert_allclose(a.maximum, [4.0, 3.0])
    np.testing.assert_allclose(a.sigma, [5.0, 1.0])
    assert a.nees == pytest.approx((25 / 25 + 11) / 3 / 2)


def test_accuracy_without_covariance_and_without_errors():
    assert accuracy(np.ones((4, 3))).nees is None
    assert accuracy(np.empty((0, 3))).n == 0
    with pytest.raises(ValueError, match="wanted"):
        accuracy(np.ones((4, 3)), np.ones((4, 2, 2)))


def test_normalised_errors_of_the_right_covariance_lie_in_their_band():
    rng = np.random.default_rng(3)
    root = np.diag([1.0, 1e-4, 50.0]) @ rng.normal(size=(3, 3))
    error = rng.normal(size=(2000, 3)) @ root.T
    covariance = np.broadcast_to(root @ root.T, (2000, 3, 3))
    mean = float(normalised_error_squared(error, covariance).mean()) / 3
    low, high = nees_band(2000, 3, alpha=0.001)
    assert low < mean < high
    assert 0.9 < low < 1.0 < high < 1.1
    wrong = float(normalised_error_squared(error, 1.3 * covariance).mean()) / 3
    assert not low < wrong < high


def test_angle_difference_goes_the_short_way():
    np.testing.assert_allclose(angle_difference([np.pi - 0.01, 0.2], [-np.pi + 0.01, 0.5]), [-0.02, -0.3])


# ---- space intersection


def _rays(rng, n_points, noise_px, orientation_root, common):
    """Three looks at points 1500 m below; orientation errors are common to all looks of a point, or of each look."""
    camera = preset("ads40")
    times = np.array([-10.0, 0.0, 6.0])
    truth = np.column_stack(
        [rng.uniform(-100, 100, n_points), rng.uniform(-600, 600, n_points), rng.normal(0, 30, n_points)]
    )
    point = np.repeat(np.arange(n_points), 3)
    time = np.tile(times, n_points)
    position = np.stack([70.0 * time, np.zeros_like(time), np.full_like(time, 1500.0)], axis=1)
    angles = np.tile([0.01, -0.02, 0.03], (len(time), 1))
    focal = np.full(len(time), camera.focal_length_mm[0])
    image = project(position, angles, truth[point], focal).xy_mm
    pitch = np.tile([0.0, 0.0065], (len(time), 1))
    motion_per_line = np.tile([-0.0065, 0.0], (len(time), 1))
    error = rng.normal(size=(n_points if common else len(time), 6)) @ orientation_root.T
    error = error[point] if common else error
    noise = rng.normal(0, noise_px, (len(time), 2))
    velocity = np.tile([70.0, 0.0, 0.0], (len(time), 1))
    n = len(time)
    period = 0.0065 / (focal[0] * 70.0 / 1500.0)
    rays = ImageRays(
        point, time, np.full(n, period), position + error[:, :3], angles + error[:, 3:], velocity, np.zeros((n, 3)),
        image + noise[:, :1] * motion_per_line + noise[:, 1:] * pitch, pitch, focal,
        np.full(n, noise_px or 0.3), np.full(n, noise_px or 0.3),
        np.broadcast_to(orientation_root @ orientation_root.T, (n, 6, 6)),
    )  # fmt: skip
    return truth, rays


def test_rays_without_errors_meet_in_the_point():
    truth, rays = _rays(np.random.default_rng(0), 50, 0.0, np.zeros((6, 6)), True)
    found = intersect(rays, 51)
    np.testing.assert_allclose(found.xyz_l[:50], truth, atol=1e-6)
    assert not found.known[50] and np.isnan(found.xyz_l[50]).all()
    assert found.rays.tolist() == [3] * 50 + [0]


def test_intersection_agrees_with_a_general_least_squares_solver():
    _, rays = _rays(np.random.default_rng(1), 5, 0.5, np.zeros((6, 6)), True)
    found = intersect(rays, 5)
    for i in range(5):
        mine = rays.point == i

        def misfit(x, mine=mine):
            p = project(rays.position_l[mine], rays.angles[mine], np.tile(x, (3, 1)), rays.focal_length_mm[mine])
            return (rays.xy_mm[mine] - p.xy_mm).ravel() / (0.5 * 0.0065)

        solved = least_squares(misfit, found.xyz_l[i] + 5.0, x_scale="jac")
        # the line's advance in the image varies a little over the field, the test's pitch does not
        np.testing.assert_allclose(found.xyz_l[i], solved.x, atol=0.01)
        sigma = np.sqrt(np.diag(np.linalg.inv(solved.jac.T @ solved.jac)))
        np.testing.assert_allclose(np.sqrt(np.diag(found.covariance[i])), sigma, rtol=0.05)


@pytest.mark.parametrize("common", [True, False])
def test_covariance_of_intersected_points_is_consistent(common):
    root = np.diag([0.5, 0.4, 0.7, 1e-4, 1e-4, 2e-4]) @ np.tril(np.full((6, 6), 0.3) + 0.7 * np.eye(6))
    truth, rays = _rays(np.random.default_rng(2), 1500, 0.3, root, common)
    found = intersect(rays, 1500, correlation_time_s=np.inf if common else 1e-3)
    nees = accuracy(found.xyz_l - truth, found.covariance).nees
    low, high = nees_band(1500, 3, alpha=0.001)
    assert nees is not None and low < nees < high


def test_intersection_refuses_bad_calls():
    _, rays = _rays(np.random.default_rng(0), 3, 0.3, np.zeros((6, 6)), True)
    with pytest.raises(ValueError, match="correlation time"):
        intersect(rays, 3, correlation_time_s=0.0)
    with pytest.raises(ValueError, match="there are 2 points"):
        intersect(rays, 2)


# ---- evaluation


def _by_time(messages, topic):
    return {convert.time_ns(m.body.timestamp): m.body for m in messages if m.topic == topic}


def test_orientation_errors_equal_an_independent_computation(messages, recording):
    result = evaluate(recording)
    truth = _by_time(messages, "truth/trajectory")
    strip = next(m.body for m in messages if m.topic == "configuration/strip")
    first = strip.first_line_time_ns
    last = first + int((strip.lines - 1) / strip.line_rate_hz * 1e9)
    for name in ("filtered", "live", "final"):
        topic = f"{'trajectory' if name == 'filtered' else 'orientation'}/{name}"
        rows = []
        for t, body in _by_time(messages, topic).items():
            if t in truth and first <= t <= last:
                p, q = body.pose.position, truth[t].pose.position
                rows.append([p.x - q.x, p.y - q.y, p.z - q.z, *np.subtract(body.angles, truth[t].angles)])
        rows = np.array(rows)
        found = result["orientation"][name]
        rmse = np.sqrt((rows**2).mean(axis=0))
        # the filtered trajectory is evaluated at 200 Hz, the independent figure at the 20 Hz of the truth
        tolerance = 0.01 if name == "filtered" else 1e-9
        np.testing.assert_allclose(found["rmse_m"], rmse[:3], rtol=tolerance)
        np.testing.assert_allclose(np.radians(found["rmse_deg"]), rmse[3:], rtol=tolerance)
        np.testing.assert_allclose(found["max_m"], np.abs(rows[:, :3]).max(axis=0), rtol=tolerance, atol=1e-9)


def test_point_errors_equal_an_independent_computation(messages, recording):
    result = evaluate(recording)
    truth = {m.body.point: m.body for m in messages if m.topic == "truth/point"}
    final = [m.body for m in messages if m.topic == "point/object" and m.body.status == 1]
    error = np.array([[p.x - truth[p.point].x, p.y - truth[p.point].y, p.z - truth[p.point].z] for p in final])
    np.testing.assert_allclose(result["points"]["adjusted"]["rmse_m"], np.sqrt((error**2).mean(axis=0)))
    nees = np.mean(
        [e @ np.linalg.solve(np.reshape(p.covariance, (3, 3)), e) for e, p in zip(error, final, strict=True)]
    )
    assert result["points"]["adjusted"]["nees"] == pytest.approx(nees / 3)
    check = {m.body.point: m.body for m in messages if m.topic == "observation/control" and m.body.role == 3}
    rows = np.array(
        [[p.x - check[p.point].x, p.y - check[p.point].y, p.z - check[p.point].z] for p in final if p.point in check]
    )
    np.testing.assert_allclose(result["check"]["adjusted"]["mean_m"], rows.mean(axis=0))
    ratio = np.divide(result["points"]["direct_georeferencing"]["rmse_m"], result["points"]["final"]["rmse_m"])
    np.testing.assert_allclose(result["improvement"]["points"], ratio)


def test_better_orientation_gives_better_points(recording):
    points = evaluate(recording)["points"]
    direct, live, final = (np.array(points[n]["rmse_m"]) for n in ("direct_georeferencing", "live", "final"))
    assert (final < live).all() and (live < direct).all()
    assert points["direct_georeferencing"]["n"] == points["final"]["n"]


def test_rejected_rays_take_no_part(messages):
    flight = collect(messages)
    assert len(flight.rejected) >= 2
    kept = evaluate_flight(flight)["points"]["final"]
    flight.rejected.clear()
    spoilt = evaluate_flight(flight)["points"]["final"]
    assert spoilt["max_m"][0] > 2 * kept["max_m"][0]


def test_measured_orientation_is_the_truth_plus_sensor_noise(messages):
    flight = collect(messages)
    row = evaluate_flight(flight)["orientation"]["measured"]
    # GNSS fixes of 0.5 m at 5 Hz, linear in between: two thirds of the variance, half a pitch of platform motion left
    np.testing.assert_allclose(row["rmse_m"], np.full(3, 0.5 * np.sqrt(2 / 3)), rtol=0.2)
    np.testing.assert_allclose(row["rmse_deg"], np.degrees([1.5e-4] * 3), rtol=0.1)
    measured = measured_poses(flight)
    assert measured is not None and np.isfinite(measured.covariance).all()


WITHOUT = [
    ("truth/",),
    ("orientation/", "point/", "adjustment/"),
    ("configuration/",),
    ("trajectory/",),
    ("orientation/", "point/", "adjustment/", "trajectory/", "sensor/", "truth/"),
]


@pytest.mark.parametrize("absent", WITHOUT, ids="+".join)
def test_partial_recordings_are_evaluated_as_far_as_they_go(messages, absent):
    flight = collect(m for m in messages if not m.topic.startswith(absent))
    result = analyse(flight, "part.mcap")
    text = page(flight, result)
    json.dumps(result, allow_nan=False)
    assert len(text) > 3000
    if "truth/" in absent:
        assert not result["orientation"] and not result["points"]
        assert any(line.startswith("truth/trajectory") for line in result["missing"])
    for line in result["missing"]:
        assert line.split(":")[0] in text


def test_unusable_messages_are_counted(messages):
    broken = [m for m in messages if m.topic == "trajectory/filtered"][:50]
    for message in broken[10:15]:
        copy = type(message.body)()
        copy.CopyFrom(message.body)
        copy.pose.position.x = float("nan")
        broken[broken.index(message)] = type(message)(message.topic, message.stamp_ns, copy, "test", message.sequence)
    del broken[20:23]
    flight = collect(broken)
    assert flight.refused["trajectory/filtered"] == 5
    assert flight.gaps["trajectory/filtered"] == 3
    assert len(flight.poses["filtered"]) == 42


# ---- the report


class _Outline(HTMLParser):
    """Checks that tags are balanced and collects what a page would fetch."""

    VOID = frozenset({"meta", "br", "img", "hr", "link", "input"})

    def __init__(self):
        super().__init__()
        self.open: list[str] = []
        self.headings: list[str] = []
        self.fetched: list[str] = []
        self.svgs = 0

    def handle_starttag(self, tag, attrs):
        self.svgs += tag == "svg"
        if tag not in self.VOID:
            self.open.append(tag)
        if tag in ("script", "link", "iframe"):
            self.fetched.append(tag)
        self.fetched += [
            v for k, v in attrs if k in ("src", "href", "xlink:href") and v and not v.startswith(("#", "data:"))
        ]

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open and self.open[-1] == "h2":
            self.headings.append(data)


def test_report_is_one_page_that_fetches_nothing(recording, tmp_path, capsys):
    target = tmp_path / "report.html"
    assert main(["analyze", str(recording), "-o", str(target), "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    text = target.read_text()
    outline = _Outline()
    outline.feed(text)
    assert not outline.open and not outline.fetched
    assert not re.search(r"@import|url\(\s*['\"]?http", text)
    assert outline.svgs == 5
    assert outline.headings == [
        "Flight", "Accuracy", "Errors against truth", "Adjustment", "Correction functions", "Residuals in image space",
        "Rejected observations", "Parameters", "Messages, nodes and events",
    ]  # fmt: skip
    assert len(text) < 6e6
    # page, JSON and evaluation say the same
    expected = evaluate(recording)
    for key in ("orientation", "points", "check", "control", "improvement", "sigma0", "missing"):
        assert printed[key] == expected[key]
    assert f"{expected['points']['adjusted']['rmse_m'][2]:.3f}" in text
    assert printed["topics"]["truth/trajectory"]["messages"] == 681
    assert len(printed["rejected_observations"]) == printed["rejected"]


def test_the_same_recording_gives_the_same_report(recording, tmp_path):
    pages = []
    for name in ("a.html", "b.html"):
        assert main(["analyze", str(recording), "-o", str(tmp_path / name), "-q"]) == 0
        pages.append((tmp_path / name).read_bytes())
    assert pages[0] == pages[1]


def test_bad_input_gets_one_line(tmp_path, capsys):
    foreign = tmp_path / "foreign.mcap"
    foreign.write_bytes(b"this is no recording at all")
    assert main(["analyze", str(foreign)]) == 1
    assert main(["analyze", str(tmp_path / "none.mcap")]) == 1
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 2 and "not an MCAP recording" in lines[0] and "no such file" in lines[1]


def test_a_report_that_cannot_be_written_is_said(recording, tmp_path, capsys):
    assert main(["analyze", str(recording), "-o", str(tmp_path / "no" / "report.html")]) == 1
    assert "report.html: no such file" in capsys.readouterr().err
