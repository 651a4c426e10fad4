"""The evaluation of a recording and its report."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from html.parser import HTMLParser
from itertools import pairwise

import numpy as np
import pytest
from matplotlib.backends.backend_svg import FigureCanvasSVG
from recording_file import write_recording
from synthetic_flight import flight_messages, spoilt_copy

from triline.nodes import convert
from triline.nodes.cli import main
from triline.nodes.cli.demo import for_programs
from triline.nodes.report.analysis import analyse
from triline.nodes.report.evaluation import evaluate, evaluate_flight, measured_poses, orientation_errors
from triline.nodes.report.figures import errors
from triline.nodes.report.flight import Flight, collect, updates_with_new_rays
from triline.nodes.report.page import page
from triline.nodes.report.source import read
from triline.nodes.report.strip_time import StripTime
from triline.nodes.report.style import figure, styled


@pytest.fixture(scope="module")
def messages():
    return flight_messages(seconds=34.0, points=150)


@pytest.fixture(scope="module")
def recording(messages, tmp_path_factory):
    path = tmp_path_factory.mktemp("analyze") / "flight.mcap"
    return write_recording(path, messages)


def analysed(messages, folder):
    """Flight and analysis of messages, by way of a recording of them."""
    path = folder / "flight.mcap"
    write_recording(path, messages)
    flight, held = read(path)
    return flight, analyse(flight, held)


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
        # the filtered trajectory is evaluated at 40 Hz, the independent figure at the 20 Hz of the truth
        tolerance = 0.01 if name == "filtered" else 1e-9
        np.testing.assert_allclose(found["rmse_m"], rmse[:3], rtol=tolerance)
        np.testing.assert_allclose(np.radians(found["rmse_deg"]), rmse[3:], rtol=tolerance)
        np.testing.assert_allclose(found["max_m"], np.abs(rows[:, :3]).max(axis=0), rtol=tolerance, atol=1e-9)


def test_point_errors_equal_an_independent_computation(messages, recording):
    result = evaluate(recording)
    truth = {m.body.point: m.body for m in messages if m.topic == "truth/point"}
    final = [m.body for m in messages if m.topic == "point/object" and m.body.status == 1]
    error = np.array([[p.x - truth[p.point].x, p.y - truth[p.point].y, p.z - truth[p.point].z] for p in final])
    control = {m.body.point for m in messages if m.topic == "observation/control" and m.body.role != 3}
    used = np.array([p.point not in control for p in final])  # what was put in is no result
    assert len(control) > 2 and result["points"]["adjusted"]["n"] == used.sum() == len(final) - len(control)
    final, error = [p for p, u in zip(final, used, strict=True) if u], error[used]
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
    both = [np.add(p.covariance, check[p.point].covariance).reshape(3, 3) for p in final if p.point in check]
    nees = np.mean([e @ np.linalg.solve(C, e) for e, C in zip(rows, both, strict=True)]) / 3
    assert result["check"]["adjusted"]["nees"] == pytest.approx(nees)  # given coordinates have errors of their own
    assert [name for name, row in result["control"].items() if "nees" in row] == ["direct_georeferencing"]
    ratio = np.divide(result["points"]["direct_georeferencing"]["rmse_m"], result["points"]["adjusted"]["rmse_m"])
    assert result["improvement"]["of"] == "adjusted"
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
def test_partial_recordings_are_evaluated_as_far_as_they_go(messages, absent, tmp_path):
    flight, result = analysed([m for m in messages if not m.topic.startswith(absent)], tmp_path)
    text = page(flight, result)
    json.dumps(result, allow_nan=False)
    assert len(text) > 3000
    if "truth/" in absent:
        assert not result["orientation"] and not result["points"]
        assert any(line.startswith("truth/trajectory") for line in result["missing"])
    for line in result["missing"]:
        assert line.split(":")[0] in text


@pytest.mark.usefixtures("undrawn")
def test_poses_that_are_not_valid_are_left_out_and_counted(messages, tmp_path):
    whole = evaluate_flight(collect(messages))
    copies = []
    for message in messages:
        if message.topic == "trajectory/filtered":
            body = type(message.body).FromString(message.body.SerializeToString())
            if 10.0 < (message.stamp_ns - messages[0].stamp_ns) / 1e9 < 14.0:
                body.valid = False
                body.pose.position.x += 500.0
            message = replace(message, body=body)
        copies.append(message)
    flight, result = analysed(copies, tmp_path)
    left_out = result["poses_left_out"]
    assert set(left_out) == {"filtered"} and left_out["filtered"] > 100 and whole["poses_left_out"] == {}
    n = result["orientation"]["filtered"]["n"]
    assert n + left_out["filtered"] == whole["orientation"]["filtered"]["n"]
    assert result["orientation"]["filtered"]["rmse_m"][0] < 2 * whole["orientation"]["filtered"]["rmse_m"][0]
    points, all_points = (r["points"]["direct_georeferencing"] for r in (result, whole))
    assert points["rmse_m"][0] < 2 * all_points["rmse_m"][0] and points["n"] < all_points["n"]
    assert f"are left out: {left_out['filtered']} filtered." in page(flight, result)


@pytest.mark.filterwarnings("error")
def test_a_recording_with_nothing_but_measurements_and_truth_draws_no_warning(messages):
    kept = [m for m in messages if not m.topic.startswith(("orientation/", "point/", "adjustment/", "trajectory/"))]
    flight = collect(kept)
    assert set(orientation_errors(flight)) == {"measured"}
    assert errors(flight) is None


def test_unusable_messages_are_counted(messages, tmp_path):
    broken = [m for m in messages if m.topic == "trajectory/filtered"][:50]
    for message in broken[10:15]:
        copy = type(message.body)()
        copy.CopyFrom(message.body)
        copy.pose.position.x = float("nan")
        broken[broken.index(message)] = type(message)(message.topic, message.stamp_ns, copy, "test", message.sequence)
    del broken[20:23]
    flight, result = analysed(broken, tmp_path)
    assert result["topics"]["trajectory/filtered"]["unusable"] == 5
    assert result["topics"]["trajectory/filtered"]["gaps"] == 3
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


@pytest.mark.study
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
    assert "report.html: no folder" in capsys.readouterr().err


def test_a_smoothed_trajectory_takes_the_place_of_a_filtered_one(messages):
    renamed = [
        type(m)("trajectory/smoothed", m.stamp_ns, m.body, m.source, m.sequence)
        if m.topic == "trajectory/filtered"
        else m
        for m in messages
    ]
    usual, other = evaluate_flight(collect(messages)), evaluate_flight(collect(renamed))
    assert other["points"]["direct_georeferencing"] == usual["points"]["direct_georeferencing"]
    assert other["improvement"] == usual["improvement"] and other["missing"] == usual["missing"] == []


# ---- axes and small parts


def test_strips_stand_side_by_side_on_the_time_axis(messages):
    flight = collect(m for m in messages if m.topic.startswith("configuration/"))
    flight.start_ns = 0
    second = type(flight.strips["S1"])()
    second.CopyFrom(flight.strips["S1"])
    for strip, first_s in ((flight.strips["S1"], 100), (second, 500)):
        strip.first_line_time_ns, strip.line_rate_hz, strip.lines = first_s * 10**9, 100.0, 2001
    t = np.arange(90.0, 600.0)
    x, y = StripTime(flight).curve(t, t)
    assert x[np.isfinite(x)].min() == 90.0  # one strip: the time itself
    flight.strips["S2"] = second
    x, y = StripTime(flight).curve(t, t)
    first, later = (y >= 100) & (y <= 120), (y >= 500) & (y <= 520)
    assert first.sum() == later.sum() == 21 and np.isnan(x).sum() == 1
    np.testing.assert_allclose(x[first], y[first] - 100.0)
    np.testing.assert_allclose(x[later] - x[later][0], y[later] - 500.0)
    assert 20.0 < x[later][0] < 22.0


@pytest.mark.parametrize("name", ["S", "strip_over_the_northern_valley_"])
def test_names_and_begins_of_many_strips_do_not_lie_upon_each_other(messages, name):
    flight, template = Flight(), next(m.body for m in messages if m.topic == "configuration/strip")
    for k, lines in enumerate([2000] * 18 + [30000, 30000]):
        flight.strips[f"{name}{k}"] = strip = type(template)()
        strip.first_line_time_ns, strip.line_rate_hz, strip.lines = (10 + 400 * k) * 10**9, 100.0, lines + 1
    with styled():
        fig = figure(5.9)
        axes = fig.subplots(3, 2, sharex=True)
        StripTime(flight).dress(axes.ravel(), axes[-1])
        for ax in axes[:, 0]:
            ax.set_xlim(-30.0, 1000.0)
        FigureCanvasSVG(fig)
        fig.draw_without_rendering()
        for texts in (axes[0, 0].texts, axes[2, 0].get_xticklabels()):
            boxes = [text.get_window_extent() for text in texts if text.get_text()]
            assert len(boxes) >= 2 and all(a.x1 <= b.x0 for a, b in pairwise(boxes))
        shown = [text.get_text() for text in axes[0, 0].texts]
        assert shown[-1].endswith("19") and (name == "S" or shown[-1].startswith("…"))


def test_updates_without_new_rays_do_not_count_as_latency():
    report = type("Report", (), {})
    ends, rays = [5, 5, 9, 9, 12], [3, 3, 7, 7, 0]
    reports = []
    for end, n in zip(ends, rays, strict=True):
        reports.append(report())
        reports[-1].window_end_ns, reports[-1].rays = end, n
    assert updates_with_new_rays(reports) == [True, False, True, False, False]


@pytest.mark.parametrize("seed", [0, 1, pytest.param(2, marks=pytest.mark.study)])
def test_numbers_that_are_not_finite_do_no_harm(messages, seed, tmp_path):
    rng = np.random.default_rng(seed)
    keep = () if seed else ("configuration/",)
    spoilt = [
        type(m)(m.topic, m.stamp_ns, spoilt_copy(m.body, rng), m.source, m.sequence)
        if rng.random() < 0.1 and not m.topic.startswith(keep or ("configuration/project",))
        else m
        for m in messages
        if m.topic != "trajectory/filtered" or rng.random() < 0.3
    ]
    _, read_back = analysed(spoilt, tmp_path)
    for topic in ("point/object", "sensor/gnss"):
        assert read_back["topics"][topic]["unusable"]
    flight = collect(spoilt)  # past the decoder, which would keep them out
    result = analyse(flight, read(tmp_path / "flight.mcap")[1])
    json.dumps(result, allow_nan=False)
    assert page(flight, result)
    assert flight.refused["point/object"] and flight.refused["sensor/gnss"]
    # what is left is as good as before
    assert max(result["points"]["adjusted"]["max_m"]) < 1.0


def test_figures_of_a_demo_for_programs_stand_at_the_top_level(recording):
    flight, held = read(recording)
    result = analyse(flight, held)
    told = for_programs(result)
    assert told["improvement"] == result["improvement"]["points"] and len(told["improvement"]) == 3
    assert told["improvement_in_full"] == result["improvement"]
    # signalised points that were measured are no tie points
    measured = {look.point for look in flight.looks}
    assert measured & flight.ground.keys() and told["ties"] == len(measured - flight.ground.keys())
    assert told["rays"] == len(flight.looks)
    assert {"redundancy", "sigma0"} <= told.keys()
    assert for_programs({"no_report": "disk full"}) == {"no_report": "disk full"}
