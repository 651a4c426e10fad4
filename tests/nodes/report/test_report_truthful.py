"""What a reader of a report must not be misled about: damage, which figures, on how many points, cut figures."""

from __future__ import annotations

import json
import re
from copy import deepcopy
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from matplotlib.backends.backend_svg import FigureCanvasSVG
from recording_file import write_recording
from synthetic_flight import flight_messages

from triline.nodes import convert
from triline.nodes.adjuster.pace import Pacing, pace_message
from triline.nodes.cli import main
from triline.nodes.node import Message
from triline.nodes.report.accuracy_table import accuracy_lines
from triline.nodes.report.analysis import analyse
from triline.nodes.report.evaluation import evaluate, evaluate_flight, missing
from triline.nodes.report.figures import progress, residuals, residuals_by_ccd, trajectory_map
from triline.nodes.report.flight import collect
from triline.nodes.report.page import page
from triline.nodes.report.render import needs_room, number
from triline.nodes.report.source import read
from triline.nodes.report.style import styled
from triline.nodes.report.tracks import tracks
from triline.schemas import messages as m


@pytest.fixture(scope="module")
def messages():
    return flight_messages(seconds=30.0, points=120)


@pytest.fixture(scope="module")
def recording(messages, tmp_path_factory):
    return write_recording(tmp_path_factory.mktemp("truthful") / "flight.mcap", messages)


# ---- damage


@pytest.mark.usefixtures("undrawn")
def test_damage_is_named_on_the_terminal_in_the_json_and_at_the_top_of_the_report(recording, tmp_path, capsys):
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(recording.read_bytes()[: recording.stat().st_size * 2 // 3])
    target = tmp_path / "report.html"
    assert main(["analyze", str(cut), "-o", str(target), "-q"]) == 0
    said = capsys.readouterr()
    assert said.out == "" and len(said.err.splitlines()) == 1
    ends = "the file ends inside a record at byte"
    assert ends in said.err and "it is being written, was cut off" in said.err
    text = target.read_text()
    assert 0 < text.index(f"Recording: {ends}") < text.index("<section>")
    assert main(["analyze", str(cut), "-o", str(target), "--json"]) == 0
    assert ends in json.loads(capsys.readouterr().out)["damage"][0]
    assert main(["analyze", str(recording), "-o", str(target)]) == 0
    assert "damage" not in capsys.readouterr().err and "Recording: " not in target.read_text()


@pytest.mark.usefixtures("undrawn")
def test_values_that_cannot_be_are_not_called_damage_of_the_recording(messages, tmp_path, capsys):
    """The page named a recording damaged in which a receiver had said NaN."""
    changed = []
    for message in messages:
        if message.topic == "sensor/gnss":
            body = deepcopy(message.body)
            body.latitude = float("nan")
            message = replace(message, body=body)
        changed.append(message)
    path, target = write_recording(tmp_path / "nan.mcap", changed), tmp_path / "report.html"
    n = sum(message.topic == "sensor/gnss" for message in messages)
    assert main(["analyze", str(path), "-o", str(target)]) == 0
    said = f"{n} messages sent with impossible values; the last: sensor/gnss {n - 1} of "
    assert said in capsys.readouterr().out and "Recording: " not in target.read_text()
    assert f"Not used here, as in flight: {said}" in target.read_text()
    assert main(["analyze", str(path), "-o", str(target), "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["damage"] == [] and said in result["not_used"][-1]


def test_a_page_is_not_written_under_the_name_of_something_else(recording, tmp_path, capsys):
    """A file .pdf held the page, and viewers called it damaged."""
    assert main(["analyze", str(recording), "-o", str(tmp_path / "r.PDF")]) == 1
    assert f"the report is a page, wanted {tmp_path / 'r.html'}" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_nothing_but_configuration_is_said_to_be_too_little(messages, tmp_path, capsys):
    kept = [x for x in messages if x.topic.startswith(("configuration/", "observation/control"))]
    path = write_recording(tmp_path / "head.mcap", kept)
    assert main(["analyze", str(path), "-o", str(tmp_path / "r.html")]) == 1
    said = capsys.readouterr()
    assert "no measurement and no result in it, only configuration/project" in said.err and said.out == ""
    assert sorted(p.name for p in tmp_path.iterdir()) == ["head.mcap"]


@pytest.mark.usefixtures("undrawn")
def test_sensors_alone_give_what_is_missing_instead_of_an_empty_line(messages, tmp_path, capsys):
    path = write_recording(
        tmp_path / "raw.mcap", [x for x in messages if x.topic.startswith(("configuration/", "sensor/"))]
    )
    assert main(["analyze", str(path), "-o", str(tmp_path / "r.html")]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert all(lines) and any(line.startswith("not in this recording: orientation/final") for line in lines)


@pytest.mark.parametrize(("dropped", "why"), [("", "too short, or no"), ("observation/tie", "no tie point in it")])
def test_a_flight_without_a_tie_point_says_so(messages, dropped, why):
    gone = ("point/", "configuration/camera", dropped) if dropped else ("point/", "configuration/camera")
    result = evaluate_flight(collect([x for x in messages if not x.topic.startswith(gone)]))
    assert [why in line for line in accuracy_lines(result) if line.startswith("  none: ")] == [True]
    assert bool(dropped) == any(line == "observation/tie: no object points" for line in result["missing"])


def test_check_points_that_are_not_measured_are_told(messages):
    """Of hundreds of points that were adjusted the table said that none got two looks."""
    check = {x.body.point for x in messages if x.topic == "observation/control" and x.body.role == x.body.CHECK}
    measured = [x for x in messages if not (x.topic.startswith("point/") and x.body.point in check)]
    result = evaluate_flight(collect([x for x in measured if x.topic != "configuration/camera"]))
    assert "check points: none of them is measured in an image" in result["missing"]
    result |= {"points": {}, "check": {}}
    for missing_too in ([], ["truth/point: no error of the object points"]):
        told = accuracy_lines(result | {"missing": [*result["missing"], *missing_too]})
        assert [line for line in told if line.startswith("  none: no check point is measured in an image")]
    assert not any(line.startswith("check points") for line in evaluate_flight(collect(messages))["missing"])


def test_a_place_that_cannot_be_written_is_refused_before_the_work(recording, tmp_path, capsys, monkeypatch):
    worked = []
    monkeypatch.setattr("triline.nodes.report.source.read", lambda path: worked.append(path))
    (tmp_path / "file").write_text("")
    for target in (tmp_path / "file" / "r.html", tmp_path / "none" / "r.html", tmp_path):
        assert main(["analyze", str(recording), "-o", str(target)]) == 1
        assert len(capsys.readouterr().err.splitlines()) == 1
    assert not worked


def test_an_old_report_stays_when_the_new_one_fails(tmp_path, capsys):
    target = tmp_path / "r.html"
    target.write_text("old")
    (tmp_path / "bad.mcap").write_bytes(b"no recording")
    assert main(["analyze", str(tmp_path / "bad.mcap"), "-o", str(target)]) == 1
    assert target.read_text() == "old" and "not an MCAP recording" in capsys.readouterr().err


# ---- one kind of figure


@pytest.mark.parametrize(("metres", "small"), [(0.05, False), (99.9, False), (164.6, True), (1429.5, True)])
def test_a_table_of_large_figures_is_set_small(metres, small):
    """Of MISR, its last columns were out of sight; of a PRISM block with 164.617 m the NEES."""
    groups = [(key, key, 3) for key in ("rmse_m", "mean_m", "max_m", "sigma_m")]
    rows = {"final": {key: [-0.01, metres / 9, -metres] for _, key, _ in groups}, "measured": {"rmse_m": [0.0] * 3}}
    assert needs_room(rows, groups) is small
    assert number(-0.0004, 3) == "0.000" and number(-0.0006, 3) == "-0.001"


@pytest.mark.usefixtures("undrawn")
def test_equal_figures_are_told_once_and_a_ccd_line_without_residuals_has_no_axes(messages, tmp_path):
    """Of a flight that nothing ties the page had "1.0–1.0 ×", and an empty histogram from 0 to 1."""
    path = write_recording(tmp_path / "flight.mcap", [x for x in messages if x.topic != "point/object"])
    flight, held = read(path)
    result = analyse(flight, held) | {"improvement": {"orientation": [1.01, 1.02, 1.04]}}
    assert "<b>1.0 ×</b>" in page(flight, result)
    flight.rejected = [m.RejectedObservation(point="T1", strip="S1", ccd="N", line=5.0, sample=7.0, w=9.0)]
    assert [ax.axison for ax in residuals(flight).axes] == [True, False]


@pytest.mark.usefixtures("undrawn")
def test_a_rejected_ray_to_which_no_test_applied_has_no_test_value(recording):
    """Rays without orientation had a w of 0.0, as if they fitted perfectly."""
    flight, held = read(recording)
    lost = m.RejectedObservation(point="T1", strip="S1", ccd="N", line=5.0, sample=7.0, reason="no orientation")
    flight.rejected = [lost, m.RejectedObservation(point="T2", strip="S1", ccd="N", line=6.0, sample=8.0, w=-9.04)]
    text = page(flight, analyse(flight, held))
    rows = re.findall(r"<td>(T[12])</td>.*<td>(\S+)</td></tr>", text[text.index("Rejected observations") :])
    assert rows == [("T2", "-9.0"), ("T1", "–")]


@pytest.mark.usefixtures("undrawn")
def test_terminal_headline_tile_and_highlighted_row_say_the_same(recording):
    flight, held = read(recording)
    result = analyse(flight, held)
    row = result["points"]["adjusted"]
    assert row["rmse_m"] != result["points"]["final"]["rmse_m"]
    text = page(flight, result)
    bold = re.findall(r"<tr class=main><td>([^<]*)</td><td>(\d+)</td>", text)
    assert ("adjusted, final", str(row["n"])) in bold and not any("intersected" in name for name, _ in bold)
    headline = " / ".join(f"{v:.2f}" for v in row["rmse_m"])
    assert f"<b>{headline} m</b> by on-line triangulation (adjusted, final; RMSE X / Y / Z of {row['n']} points" in text
    assert "better object points (adjusted, final)" in text
    lines = accuracy_lines(result)
    line = next(line for line in lines if line.startswith("  adjusted on-line, final"))
    numbers = [float(v) for v in re.findall(r"[\d.]+", line)]
    assert numbers == pytest.approx([row["n"], *row["rmse_m"], *row["sigma_m"], row["nees"]], abs=0.006)
    result["points"]["adjusted"]["sigma_m"] = [1531.781, 2130.435, 999.9]  # large figures stay apart
    assert any(line.split()[-5:-1] == ["1532", "2130", "999.900", "m"] for line in accuracy_lines(result))
    direct = result["points"]["direct_georeferencing"]
    gain = next(line for line in lines if "improvement" in line)
    found = [float(v) for v in re.findall(r"([\d.]+)x", gain)]
    assert found == pytest.approx(np.divide(direct["rmse_m"], row["rmse_m"]), abs=0.06) and direct["n"] == row["n"]
    assert max(map(len, lines)) <= 100 and not any("intersected" in line for line in lines)


def test_every_row_has_n_and_what_it_states_of_itself(recording):
    flight, held = read(recording)
    lines = accuracy_lines(analyse(flight, held))
    rows = [line for line in lines if line.startswith("  ") and "improvement" not in line]
    assert len(rows) == 7
    for line in rows:
        assert re.search(r" \d+ +\d+\.\d{3} .* (\d\.\d\d|-)$", line), line


def test_points_that_only_one_of_both_has_are_not_compared(messages):
    gone = {x.body.point for x in messages if x.topic == "point/object"}
    gone = set(sorted(gone)[::2])
    few = [x for x in messages if x.topic != "point/object" or x.body.point not in gone]
    points, whole = evaluate_flight(collect(few))["points"], evaluate_flight(collect(messages))["points"]
    assert points["direct_georeferencing"]["n"] == points["adjusted"]["n"] < whole["adjusted"]["n"]


def test_refined_orientation_goes_with_the_camera_that_was_estimated_with_it(messages):
    flight = collect(messages)
    right = evaluate_flight(flight)["points"]
    line = flight.camera.lines[0]
    off = replace(line, xy_mm=line.xy_mm + np.array([0.05, 0.0]))
    flight.camera = replace(flight.camera, lines=(off, *flight.camera.lines[1:]))
    flight.reports[-1][1].parameters.add(name=f"xp_{line.id}", value=0.05)
    found = evaluate_flight(flight)["points"]
    assert found["final"]["rmse_m"] == pytest.approx(right["final"]["rmse_m"], abs=1e-6)
    assert found["live"]["rmse_m"] == pytest.approx(right["live"]["rmse_m"], abs=1e-6)
    before, wrong = (rows["direct_georeferencing"]["rmse_m"] for rows in (right, found))
    assert np.abs(np.subtract(before, wrong)).max() > 0.1  # before triangulation the camera is the one that is stated


def test_without_truth_the_table_is_of_check_points(messages, tmp_path):
    path = write_recording(tmp_path / "real.mcap", [x for x in messages if not x.topic.startswith("truth/")])
    flight, held = read(path)
    result = analyse(flight, held)
    lines = accuracy_lines(result)
    assert lines[0].startswith("RMSE against check points")
    assert any(re.match(rf"  adjusted on-line, final +{result['check']['adjusted']['n']} ", line) for line in lines)


def test_sigma0_since_the_start_is_drawn_where_that_of_the_window_waits(messages):
    """After sigmas were restated the window says nothing for a while, and the flight as a whole does."""
    flight = collect(messages)
    flight.reports = [(stamp, type(r).FromString(r.SerializeToString())) for stamp, r in flight.reports]
    for k, (_, r) in enumerate(flight.reports):
        r.sigma0_total, r.redundancy_total = 1.2, 10 * k
        if k >= len(flight.reports) // 2:
            r.sigma0, r.redundancy = 0.0, 0
    top = progress(flight).axes[0]
    lines = {line.get_label(): np.asarray(line.get_ydata()) for line in top.get_lines()}
    since, window = lines["σ₀ since the start"], lines["σ₀ of the window"]
    half = len(since) // 2
    assert np.isfinite(since[3:]).all() and np.isnan(window[half:]).all()
    low, high = top.get_ylim()
    assert low < 1.0 < 1.2 < high


# ---- a flight that was not flown to its end


@pytest.mark.usefixtures("undrawn")
def test_a_flight_that_ended_early_is_named(messages, tmp_path):
    longer = []
    for x in messages:
        if x.topic == "configuration/strip":
            body = type(x.body).FromString(x.body.SerializeToString())
            body.lines, body.ended = 2 * body.lines, False
            x = replace(x, body=body)
        longer.append(x)
    flight, held = read(write_recording(tmp_path / "early.mcap", longer))
    result = analyse(flight, held)
    (early,) = result["ended_early"]
    assert early["planned_s"] == pytest.approx(52.0, abs=0.1) and early["flown_s"] == pytest.approx(28.0, abs=0.1)
    said = "light ended early: strip S1 after 28.0 s of 52.0 s planned"
    assert f"f{said}" in accuracy_lines(result) and f"F{said}" in page(flight, result)
    flight, held = read(write_recording(tmp_path / "whole.mcap", messages))
    assert analyse(flight, held)["ended_early"] == []


def test_a_strip_whose_end_was_not_recorded_counts(messages):
    """Drivers say how many lines a strip has when it ends: up to then it was on no map and under no light."""
    cut, ended = [], None
    for x in messages:
        if x.topic == "configuration/strip":
            body = type(x.body).FromString(x.body.SerializeToString())
            ended = m.Strip(id="S0", first_line_time_ns=body.first_line_time_ns - 10 * 10**9, lines=100, ended=True)
            ended.line_rate_hz = body.line_rate_hz  # one before, whose number of lines is known
            cut.append(replace(x, body=ended))
            body.lines, body.ended = 0, False
            x = replace(x, body=body)
        cut.append(x)
    whole, found = collect(messages), collect(cut)
    first, last = whole.strip_times("S1")
    assert found.strip_times("S1")[0] == first and abs(found.strip_times("S1")[1] - last) < 10**8
    assert [track["strip"] for track in tracks(found)] == ["S1"]
    result, wanted = (evaluate_flight(flight)["orientation"]["final"]["n"] for flight in (found, whole))
    assert abs(result - wanted) <= 1
    assert evaluate_flight(found)["ended_early"] == []


@pytest.mark.parametrize(("field", "value"), [("line_rate_hz", 0.0), ("first_line_time_ns", 10**15), ("lines", 2**31)])
def test_a_strip_that_nodes_refuse_does_not_take_the_place_of_the_one_that_is_flown(messages, field, value):
    was = next(x for x in messages if x.topic == "configuration/strip")
    body = type(was.body).FromString(was.body.SerializeToString())
    setattr(body, field, value)
    flight = collect([*messages, replace(was, body=body, stamp_ns=was.stamp_ns + 10**9, sequence=1)])
    assert flight.refused["configuration/strip"] == 1 and flight.strips["S1"] == was.body
    assert evaluate_flight(flight)["orientation"] == evaluate_flight(collect(messages))["orientation"]


@pytest.mark.parametrize(("topic", "field", "value"), [("gnss", "latitude", 4700.0), ("attitude", "heading", 150.0)])
def test_measurements_that_nodes_refuse_are_unusable_here_too(messages, topic, field, value):
    k = next(
        i for i, x in enumerate(messages) if x.topic == f"sensor/{topic}" and x.stamp_ns > messages[0].stamp_ns + 10**10
    )
    body = type(messages[k].body).FromString(messages[k].body.SerializeToString())
    setattr(body, field, value)
    flight = collect([*messages[:k], replace(messages[k], body=body), *messages[k + 1 :]])
    assert flight.refused[f"sensor/{topic}"] == 1
    right = evaluate_flight(collect(messages))["orientation"]["measured"]
    found = evaluate_flight(flight)["orientation"]["measured"]
    assert found["rmse_m"] == pytest.approx(right["rmse_m"], rel=0.05)
    assert found["rmse_deg"] == pytest.approx(right["rmse_deg"], rel=0.05)


def test_measured_orientation_has_the_clock_that_an_operator_said(messages):
    """Fixes half a second late, and the word on it in the middle of the flight, which holds for all of them."""
    late = []
    for message in messages:
        if message.topic == "sensor/gnss":
            body = type(message.body).FromString(message.body.SerializeToString())
            convert.set_time(body.timestamp, convert.time_ns(body.timestamp) + 5 * 10**8)
            message = replace(message, body=body)
        late.append(message)
    right, wrong = (evaluate_flight(collect(told))["orientation"]["measured"] for told in (messages, late))
    assert np.hypot(*wrong["rmse_m"][:2]) > 30  # half a second of 70 m/s
    middle = len(late) // 2
    said = m.Verdict(topic="sensor/gnss", accepted=True, clock_s=-0.5, by="Ann")
    late.insert(middle, Message("observation/verdict", late[middle].stamp_ns, said, "confirm"))
    found = evaluate_flight(collect(late))["orientation"]["measured"]
    assert found["rmse_m"] == pytest.approx(right["rmse_m"], rel=1e-6)


# ---- info and the report


@pytest.mark.usefixtures("undrawn")
def test_info_and_report_say_the_same_of_messages_rates_and_duration(messages, tmp_path, capsys):
    stamp = messages[-1].stamp_ns
    image = m.RawImage(width=4, height=1, encoding="mono8", step=4, data=b"1234")
    convert.set_time(image.timestamp, stamp)
    lines = [replace(messages[0], topic="sensor/lines/N", body=image, stamp_ns=stamp, sequence=i) for i in range(3)]
    path = write_recording(tmp_path / "flight.mcap", [*messages, *lines])
    assert main(["info", str(path), "--json"]) == 0
    info = json.loads(capsys.readouterr().out)
    assert main(["analyze", str(path), "-o", str(tmp_path / "r.html"), "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["recording"]["messages"] == info["messages"] == len(messages) + 3
    assert report["recording"]["seconds"] == info["duration_s"]
    assert report["recording"]["start"][:19] == info["start"][:19]
    assert [*report["topics"]] == [row["topic"] for row in info["topics"]] and "sensor/lines/N" in report["topics"]
    for row in info["topics"]:
        told = report["topics"][row["topic"]]
        assert told["messages"] == row["messages"] and told["rate_hz"] == row["rate_hz"], row["topic"]


def test_the_duration_is_of_the_flight_not_of_what_was_known_before(messages, tmp_path):
    early = [
        replace(x, stamp_ns=x.stamp_ns - 20 * 10**9) if x.topic in ("observation/control", "truth/point") else x
        for x in messages
    ]
    _, held = read(write_recording(tmp_path / "flight.mcap", early))
    assert held.duration_s == pytest.approx(37.0, abs=3.0)


# ---- figures


@pytest.mark.parametrize("east, north", [(0.3, 4.0), (2.0, 1.0), (8.0, 4.0)])
def test_nothing_of_the_map_is_cut_off(messages, east, north):
    flight = collect(messages)
    for id, point in flight.points.items():  # blocks of many shapes
        flight.points[id] = moved = type(point).FromString(point.SerializeToString())
        moved.x, moved.y = east * point.x, north * point.y
    with styled():
        figure = trajectory_map(flight)
        assert figure is not None
        FigureCanvasSVG(figure)
        figure.draw_without_rendering()
        whole = figure.bbox
        (axes,), (legend,) = figure.axes, figure.legends
        assert legend.get_tightbbox().y1 <= axes.get_tightbbox().y0  # and nothing lies upon another
        assert axes.get_tightbbox().y1 <= figure.texts[0].get_tightbbox().y0
        for artist in [*figure.texts, *figure.legends, *figure.axes]:
            box = artist.get_tightbbox()
            assert box.y1 <= whole.y1 + 0.1 and box.y0 >= whole.y0 - 0.1 and box.x0 >= whole.x0 - 0.1, artist


def test_the_map_of_a_straight_flight_has_a_width(messages):
    """It was a line with the numbers of its axis upon each other."""
    flight = collect([x for x in messages if x.topic in ("configuration/project", "trajectory/filtered")])
    flight.poses["filtered"].position_l[:, 1] = 1e-3 * np.arange(len(flight.poses["filtered"]))
    with styled():
        figure = trajectory_map(flight)
        figure.draw_without_rendering()
    (axes,) = figure.axes
    assert np.ptp(axes.get_ylim()) > 0.09 * np.ptp(axes.get_xlim())
    names = [label.get_tightbbox() for label in axes.get_yticklabels() if label.get_text()]
    inside = [box for box in names if axes.bbox.y0 - 9 < box.y0 < axes.bbox.y1]
    assert len(inside) >= 2 and all(a.y1 < b.y0 for a, b in pairwise(inside))


@pytest.mark.usefixtures("undrawn")
def test_points_that_came_out_worse_are_not_called_better(recording):
    flight, held = read(recording)
    result = analyse(flight, held)
    assert "times better" in page(flight, result)
    result["improvement"]["points"] = [0.8, 1.4, 1.3]
    text = " ".join(page(flight, result).split())
    assert "not better in every axis, at least 0.8 times as good" in text and "times better" not in text


@pytest.mark.parametrize("role", ["planimetric", "height"])
def test_misfits_of_the_map_are_of_given_coordinates_alone(messages, role):
    """A planimetric point stands at any height, and a height point at any place."""
    flight = collect(messages)

    def largest():
        with styled():
            figure = trajectory_map(flight)
        return next(
            re.search(r"largest (.*) m", t.get_text()).group(1)
            for t in figure.axes[0].texts
            if "largest" in t.get_text()
        )

    before = float(largest())
    for id, given in flight.ground.items():
        flight.ground[id] = moved = type(given).FromString(given.SerializeToString())
        moved.role = m.GroundPoint.Role.Value(role.upper())
        far = ("z",) if role == "planimetric" else ("x", "y")
        for axis in far:
            setattr(moved, axis, getattr(moved, axis) + 60.0)
    assert 0.0 < float(largest()) <= before < 10.0


def test_rejected_rays_are_marked_though_their_points_are_gone(messages):
    marked = {x.body.point for x in messages if x.topic == "point/object" for r in x.body.residuals if r.rejected}
    given_up = sorted(marked)[0]
    kept = [x for x in messages if x.topic != "point/object" or x.body.point != given_up]
    flight = collect(kept)
    named = [r for r in flight.rejected if r.point == given_up]
    assert named
    rows = residuals_by_ccd(flight)[named[0].ccd]
    bad = rows[rows[:, 5] > 0]
    assert (np.abs(bad[:, :2] - [named[0].line, named[0].sample]).max(axis=1) < 0.01).sum() == 1
    assert sum(int(r[:, 5].sum()) for r in residuals_by_ccd(flight).values()) == len(flight.rejected)
    figure = residuals(flight)
    assert figure is not None
    titles = [ax.get_title(loc="left") or ax.get_title() for ax in figure.axes]
    assert any(f"{len(bad)} rejected (×), all drawn" in title for title in titles)


def test_rays_that_were_taken_back_are_not_rejected(messages):
    at, report = next((i, x) for i, x in enumerate(messages) if x.topic == "adjustment/report" and x.body.rejected)
    taken_back = report.body.rejected[0]
    body = type(report.body)(returned=[taken_back], returned_total=1)
    points = [x for x in messages if x.topic != "point/object" or x.body.point != taken_back.point]
    later = replace(report, body=body, stamp_ns=messages[-1].stamp_ns)
    names = {(r.point, r.ccd) for r in collect(points).rejected}
    assert (taken_back.point, taken_back.ccd) in names and at
    assert {(r.point, r.ccd) for r in collect([*points, later]).rejected} == names - {
        (taken_back.point, taken_back.ccd)
    }


@pytest.mark.usefixtures("undrawn")
def test_parameters_are_said_to_be_undetermined_for_good_with_the_criterion(messages, tmp_path):
    changed = []
    for x in messages:
        if x.topic == "adjustment/report" and x.body.parameters:
            body = type(x.body).FromString(x.body.SerializeToString())
            body.parameters[0].status = "not yet determined"
            body.parameters[0].reason = "its sigma is 0.93 of the a-priori one"
            x = replace(x, body=body)
        changed.append(x)
    flight, held = read(write_recording(tmp_path / "flight.mcap", changed))
    text = page(flight, analyse(flight, held))
    assert "not determined by this flight</td>" in text and "its sigma is 0.93 of the a-priori one</td>" in text
    assert "not yet" not in text and "at most 0.7 of the a-priori one" in text


@pytest.mark.usefixtures("undrawn")
def test_long_counters_wrap(messages, tmp_path):
    status = next(x for x in messages if x.topic == "status/adjuster")
    body = type(status.body).FromString(status.body.SerializeToString())
    for i in range(40):
        body.counters.append(m.Counter(name=f"reason number {i}", value=i + 1))
    flight, held = read(write_recording(tmp_path / "flight.mcap", [*messages[:-1], replace(status, body=body)]))
    cell = re.search(r"<td([^>]*)>[^<]*reason number 39", page(flight, analyse(flight, held)))
    assert cell is not None and "wrap" in cell.group(1)


# ---- text of others in the page


def _hostile(value, text):
    """The same with a text in place of every other, in lists and dictionaries, too; numbers stay."""
    if isinstance(value, dict):
        return {key: _hostile(v, text) for key, v in value.items()}
    if isinstance(value, list):
        return [_hostile(v, text) for v in value]
    return text if isinstance(value, str) else value


def test_names_and_texts_of_a_recording_are_no_part_of_the_page_s_markup(messages, tmp_path):
    text = "<img src=x onerror=alert(1)>\"'&amp;-->"
    renamed = []
    for x in messages:
        if x.topic == "configuration/strip":
            body = type(x.body).FromString(x.body.SerializeToString())
            body.id = text
            x = replace(x, body=body)
        renamed.append(x)
    flight, held = read(write_recording(tmp_path / "flight.mcap", renamed))
    result = analyse(flight, held)
    result["events"] = [{"time_s": 1.0, "level": "info", "node": "n", "text": "t"}]
    result |= {"damage": ["d"], "missing": ["m"], "poses_left_out": {text: 3}}
    for key in ("recording", "damage", "missing", "rejected_observations", "nodes", "events", "parameters"):
        assert result[key], key
        result[key] = _hostile(result[key], text)
    result["nodes"], result["topics"] = ({text: next(iter(result[key].values()))} for key in ("nodes", "topics"))
    light = {"light": text, "reason": text, "seconds": 9.0, "times": 1}
    source = {"source": text, "ccd": text, "since_s": None, "seconds": 1.0, "line_px": 0.1, "sample_px": 0.1}
    result["integrity"] = {
        "seconds": 9.0, "share": {text: 1.0}, "reasons": [light], "sources": [{**source, "rivals": [text, text]}]
    }  # fmt: skip
    html = page(flight, result)
    assert "<img" not in html and html.count("&lt;img src=x onerror=alert(1)&gt;") > 40


# ---- words


def test_a_pace_that_eases_off_is_not_said_to_be_behind():
    pacing = Pacing()
    for start_ns, (level, lag_s) in enumerate([(2, 3.1), (1, 0.0), (2, 1.4), (0, 0.0)]):
        pacing.announce(pace_message(level, lag_s, start_ns))
    said = []
    for start_ns in range(4):
        begun = pacing.follow(start_ns)
        assert begun is not None
        said.append((begun.words(0.2), begun.eased))
    assert said == [
        ("3.1 s behind: updates every 1 s", False),
        ("catching up, eased off: updates every 0.4 s", True),
        ("1.4 s behind: updates every 1 s", False),
        ("caught up: normal pace again", True),
    ]


# ---- a recorder that stood still


def test_nothing_is_compared_across_a_gap_of_the_truth(messages, tmp_path):
    """The recorder was frozen for 5 s in a turn of the trajectory: what is interpolated over them is no truth."""
    start = messages[0].stamp_ns
    lost = start + 12 * convert.SECOND_NS, start + 17 * convert.SECOND_NS

    def heard(message):
        return message.topic == "truth/trajectory" and lost[0] <= message.stamp_ns < lost[1]

    bent = []
    for message in messages:
        if message.topic == "truth/trajectory" or message.topic.startswith(("orientation/", "trajectory/")):
            body = type(message.body)()
            body.CopyFrom(message.body)
            t = (convert.time_ns(body.timestamp) - lost[0]) / convert.SECOND_NS
            body.pose.position.z += 40.0 * np.sin(np.clip(t / 5.0, 0.0, 1.0) * np.pi)  # a climb nobody recorded
            message = type(message)(message.topic, message.stamp_ns, body, message.source, message.sequence)
        if not heard(message):
            bent.append(message)
    whole = evaluate(write_recording(tmp_path / "whole.mcap", messages))["orientation"]["final"]
    result = evaluate(write_recording(tmp_path / "gap.mcap", bent))
    found = result["orientation"]["final"]
    assert found["nees"] < 1.5 * whole["nees"] + 0.5
    assert 0.5 * whole["n"] < found["n"] < 0.95 * whole["n"]
    assert any("truth/trajectory from 1" in text and "nothing is compared there" in text for text in result["missing"])
    # a turn that the simulator left out, or nobody recorded, is no part of what is compared
    flight = collect(bent)
    flight.strips["S1"].lines = int(flight.strips["S1"].line_rate_hz)
    assert flight.strip_times("S1")[1] < lost[0]
    assert not any("truth/trajectory from" in text for text in missing(flight))
