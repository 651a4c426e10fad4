"""Who reads a recording takes the project, the camera and the control that nodes used, and no others."""

from __future__ import annotations

import csv
import json
import re
from dataclasses import replace

import numpy as np
import pytest
from recording_file import write_recording
from synthetic_flight import flight_messages

from triline.nodes.batch.relief import known_points
from triline.nodes.cli import main, view
from triline.nodes.cli.damage import tell_other_camera
from triline.nodes.convert import iso
from triline.nodes.formats.block_recording import TOPICS, block_from_messages
from triline.nodes.node import Message
from triline.nodes.recording.access import Recording
from triline.nodes.recording.reader import RecordingReader
from triline.nodes.report.evaluation import evaluate, evaluate_flight, orientation_errors, usable_rays
from triline.nodes.report.figures import residuals_by_ccd
from triline.nodes.report.flight import collect
from triline.nodes.voices import RecordedVoices
from triline.schemas import messages as m

SECOND = 1_000_000_000


@pytest.fixture(scope="module")
def messages():
    return flight_messages(seconds=34.0, points=150)


def _of(messages, topic):
    return next(x for x in messages if x.topic == topic)


def _moved(messages, seconds: float, **more) -> Message:
    """The project with another origin, so long after the first fix."""
    was = _of(messages, "configuration/project")
    body = type(was.body).FromString(was.body.SerializeToString())
    body.origin_latitude += 0.1
    stamp = _of(messages, "sensor/gnss").stamp_ns + round(seconds * SECOND)
    return replace(was, body=body, stamp_ns=stamp, sequence=was.sequence + 1, **more)


def _said(messages, seconds: float) -> Message:
    body = m.Verdict(topic="configuration/project", accepted=True, by="Ann")
    stamp = _of(messages, "sensor/gnss").stamp_ns + round(seconds * SECOND)
    return Message("observation/verdict", stamp, body, "surveyor", 0)


def _latitude(path) -> float:
    return Recording(path).project().origin_latitude


@pytest.mark.parametrize(("seconds", "more"), [(5.0, {}), (5.0, {"source": "intruder"})])
def test_a_project_that_nodes_refused_does_not_count(messages, tmp_path, seconds, more):
    was = _of(messages, "configuration/project").body.origin_latitude
    path = write_recording(tmp_path / "flight.mcap", [*messages, _moved(messages, seconds, **more)])
    assert _latitude(path) == was
    right = evaluate(write_recording(tmp_path / "right.mcap", messages))["orientation"]
    assert evaluate(path)["orientation"]["measured"] == right["measured"]  # places of GNSS are in its frame


def test_a_project_counts_before_the_flight_and_on_an_operators_word(messages, tmp_path):
    other = _moved(messages, 5.0)
    path = write_recording(tmp_path / "said.mcap", [*messages, other, _said(messages, 6.0)])
    assert _latitude(path) == other.body.origin_latitude
    early = replace(other, stamp_ns=_of(messages, "configuration/project").stamp_ns)  # sensors begin with this stamp
    assert _latitude(write_recording(tmp_path / "early.mcap", [*messages, early])) == other.body.origin_latitude


def test_results_in_a_local_frame_that_was_given_up_are_left_out_and_told(messages, tmp_path):
    path = write_recording(tmp_path / "said.mcap", [*messages, _moved(messages, 15.0), _said(messages, 16.0)])
    flight = collect(RecordingReader(path).sorted_messages())
    change = _said(messages, 16.0).stamp_ns
    kept = [x for x in messages if x.topic == "trajectory/filtered" and x.stamp_ns > change]
    assert len(flight.poses["filtered"]) == len(kept) < sum(x.topic == "trajectory/filtered" for x in messages)
    block = block_from_messages(RecordedVoices().all_used(RecordingReader(path).sorted_messages(TOPICS)), "flight")
    assert block.strips[0].trajectory.start_s * SECOND + block.time_reference_ns > change
    line = flight.not_used[0]
    assert re.match(r"\d+ poses and object points of before the project got another origin or CRS", line)


def test_exports_have_no_results_in_a_local_frame_that_was_given_up(messages, tmp_path, capsys):
    """They would be drawn 11 km from where they are; what is left out is told."""
    change = _said(messages, 16.0).stamp_ns
    early = [x.topic == "point/object" and x.body.point < "P0050" for x in messages]
    messages = [replace(x, stamp_ns=change - SECOND) if e else x for x, e in zip(messages, early, strict=True)]
    path = write_recording(tmp_path / "said.mcap", [*messages, _moved(messages, 15.0), _said(messages, 16.0)])
    after = {x.body.point for x in messages if x.topic == "point/object" and x.stamp_ns >= change}
    assert after < {x.body.point for x in messages if x.topic == "point/object"}
    told = f"before {iso(change)} poses and points are in another local frame and left out"
    for words in (["--points"], ["--per-line"], ["--topic", "trajectory/filtered", "--geojson"]):
        target = tmp_path / "out"
        assert main(["export", str(path), *words, str(target), "-q"]) == 0
        assert told in capsys.readouterr().err
        if words[-1] == "--geojson":
            features = json.loads(target.read_text())["features"]
            times = [f["properties"]["time_ns"] for f in features if f["geometry"]["type"] == "Point"]
            assert len(times) > 100 and min(times) >= change
            continue
        rows = list(csv.DictReader(target.read_text().splitlines()))
        if words[-1] == "--points":
            assert {row["point"] for row in rows} == after
        else:
            assert min(float(row["time_s"]) for row in rows) * SECOND > change - 1000
    assert Recording(path).poses("trajectory/filtered").time_ns.min() >= change
    assert len(known_points(Recording(path))) < len(known_points(Recording(write_recording(tmp_path / "a", messages))))
    # another project in the same frame changes nothing
    same = _moved(messages, 15.0)
    same.body.origin_latitude = _of(messages, "configuration/project").body.origin_latitude
    same.body.image_sigma_px = 0.7
    path = write_recording(tmp_path / "same.mcap", [*messages, same, _said(messages, 16.0)])
    assert main(["export", str(path), "--points", str(tmp_path / "out"), "-q"]) == 0
    assert not capsys.readouterr().err


@pytest.mark.usefixtures("undrawn")
def test_the_report_says_what_was_not_used(messages, tmp_path, capsys):
    path = write_recording(tmp_path / "flight.mcap", [*messages, _moved(messages, 5.0)])
    page = tmp_path / "report.html"
    assert main(["analyze", str(path), "-o", str(page), "--json"]) == 0
    (line,) = json.loads(capsys.readouterr().out)["not_used"]
    assert line.startswith("configuration/project: 1 not used by the nodes: ") and "than the flight began with" in line
    assert "another one than the flight began with" in page.read_text()
    assert main(["analyze", str(path), "-o", str(page)]) == 0
    assert line in capsys.readouterr().out.splitlines()


def test_a_scene_has_no_project_that_nodes_refused(messages, tmp_path):
    path = write_recording(tmp_path / "flight.mcap", [*messages, _moved(messages, 5.0)])
    shown = list(view._messages(RecordingReader(path)))
    assert [x.body.origin_latitude for x in shown if x.topic == "configuration/project"] == [
        _of(messages, "configuration/project").body.origin_latitude
    ]
    assert {x.topic for x in shown} >= {"trajectory/filtered", "orientation/final", "point/object"}
    path = write_recording(tmp_path / "said.mcap", [*messages, _moved(messages, 5.0), _said(messages, 6.0)])
    topics = [x.topic for x in view._messages(RecordingReader(path))]
    assert topics.count("configuration/project") == 2 and "observation/verdict" not in topics


def test_adjust_takes_control_of_the_source_that_nodes_hear(messages, tmp_path):
    was = _of(messages, "observation/control")
    body = type(was.body).FromString(was.body.SerializeToString())
    body.z += 100.0
    stamp = _of(messages, "sensor/gnss").stamp_ns + 5 * SECOND
    other = replace(was, body=body, stamp_ns=stamp, source="intruder", sequence=0)
    path = write_recording(tmp_path / "flight.mcap", [*messages, other])
    voices = RecordedVoices()
    used = [*voices.all_used(RecordingReader(path).sorted_messages(TOPICS))]
    heights = [x.body.z for x in used if x.topic == was.topic and x.body.point == was.body.point]
    assert heights == [was.body.z]
    assert voices.left_out["observation/control"][0] == 1


# ---- control whose coordinates do not count


def _refused(messages) -> tuple[list[Message], str]:
    """The flight with a control point 5 m wrong in height that an operator refused, and its name."""
    was = next(x for x in messages if x.topic == "observation/control" and x.body.role == m.GroundPoint.CONTROL)
    body = type(was.body).FromString(was.body.SerializeToString())
    body.z += 5.0
    verdict = Message(
        "observation/verdict", was.stamp_ns + SECOND, m.Verdict(point=body.point, accepted=False), "surveyor", 0
    )
    return [replace(x, body=body) if x is was else x for x in messages] + [verdict], body.point


def test_control_that_an_operator_refused_counts_in_no_accuracy(messages):
    spoilt, name = _refused(messages)
    flight = collect(spoilt)
    result, right = evaluate_flight(flight), evaluate_flight(collect(messages))
    for row, before in zip(result["control"].values(), right["control"].values(), strict=True):
        assert row["n"] == before["n"] - 1 and row["max_m"][2] < 3.0
    assert result["points"]["adjusted"]["n"] == right["points"]["adjusted"]["n"] + 1  # a result as all others
    assert flight.not_used == [f"ground point {name}: its coordinates do not count, as an operator said in flight"]


def test_a_coordinate_that_the_adjuster_left_out_counts_in_no_accuracy_of_the_control(messages):
    spoilt, name = _refused(messages)
    spoilt.pop()
    *_, last = (x for x in spoilt if x.topic == "adjustment/report")
    report = type(last.body).FromString(last.body.SerializeToString())
    report.rejected.add(point=name, coordinate="Z", reason="contradicts", w=9.0, off=5.0)
    flight = collect(replace(x, body=report) if x is last else x for x in spoilt)
    assert np.isnan(flight.given(name)).tolist() == [False, False, True]
    row = evaluate_flight(flight)["control"]["adjusted"]
    assert row["n"] == evaluate_flight(collect(messages))["control"]["adjusted"]["n"] - 1
    assert row["max_m"][2] < 3.0


def test_adjust_takes_no_coordinates_that_an_operator_refused(messages):
    spoilt, name = _refused(messages)
    block, before = (block_from_messages(x, "flight") for x in (spoilt, messages))
    assert name in before.ground.id and set(before.ground.id) - set(block.ground.id) == {name}
    assert any(name in note and "an operator said" in note for note in block.notes)
    accepted = replace(spoilt[-1], body=m.Verdict(point=name, accepted=True))
    assert name in block_from_messages([*spoilt, accepted], "flight").ground.id


def test_control_in_a_local_frame_that_was_given_up_does_not_count_until_it_is_stated_again(messages, tmp_path, capsys):
    """Its coordinates would be 11 km away in the new one."""
    stated = {x.body.point: x for x in messages if x.topic == "observation/control"}
    name, was = next((k, x) for k, x in stated.items() if x.body.role != m.GroundPoint.PLANIMETRIC)
    body = type(was.body).FromString(was.body.SerializeToString())
    body.y -= 11_000.0
    again = replace(was, body=body, stamp_ns=_said(messages, 17.0).stamp_ns, sequence=was.sequence + 1)
    change = [_moved(messages, 15.0), _said(messages, 16.0)]
    for more, left in (([], set()), ([again], {name})):
        path = write_recording(tmp_path / "said.mcap", [*messages, *change, *more])
        flight = collect(RecordingReader(path).sorted_messages())
        assert set(flight.ground) == left and len(stated) > 1
        assert any(line.startswith(f"{len(stated)} ground points stated before") for line in flight.not_used)
        block = block_from_messages(RecordedVoices().all_used(RecordingReader(path).sorted_messages(TOPICS)), "flight")
        assert set(block.ground.id) == left
        no_points = [x for x in [*messages, *change, *more] if x.topic != "point/object"]
        assert len(known_points(Recording(write_recording(tmp_path / "control.mcap", no_points)))) == len(left)
    target = tmp_path / "control"
    assert main(["export", str(path), "--topic", "observation/control", "--geojson", str(target), "-q"]) == 0
    assert "another local frame" in capsys.readouterr().err
    assert [f["properties"]["point"] for f in json.loads(target.read_text())["features"]] == [name]


def test_truth_in_a_local_frame_that_was_given_up_is_not_compared(messages, tmp_path, capsys):
    """A simulator goes on with the origin that it has; the other one lies 11 km away."""
    change = [_moved(messages, 15.0, source="surveyor"), _said(messages, 16.0)]
    path = write_recording(tmp_path / "said.mcap", [*messages, *change])
    flight = collect(RecordingReader(path).sorted_messages())
    assert "truth" not in flight.poses and not flight.truth_points
    assert any("true poses and points are in another local frame" in line for line in flight.not_used)
    rows = evaluate_flight(flight)["orientation"]
    assert not rows
    assert not len(Recording(path).poses("truth/trajectory").time_ns)
    own = [_moved(messages, 15.0), _said(messages, 16.0)]  # of the simulator itself: it has that origin from then on
    path = write_recording(tmp_path / "own.mcap", [*messages, *own])
    assert len(collect(RecordingReader(path).sorted_messages()).poses["truth"]) > 10
    assert len(Recording(path).poses("truth/trajectory").time_ns) > 10


def test_a_point_that_is_stated_again_in_another_frame_was_not_left_out_in_it(messages, tmp_path):
    """What the adjuster left out were its coordinates in the frame before."""
    was = next(x for x in messages if x.topic == "observation/control" and x.body.role == m.GroundPoint.CONTROL)
    body = type(was.body).FromString(was.body.SerializeToString())
    body.y -= 11_000.0
    again = replace(was, body=body, stamp_ns=_said(messages, 17.0).stamp_ns, sequence=was.sequence + 1)
    out = m.AdjustmentReport(rejected=[m.RejectedObservation(point=body.point, coordinate=axis) for axis in "XYZ"])
    rest = [x for x in messages if x.topic not in ("adjustment/report", "point/object")]
    for second, wanted in ((10.0, True), (20.0, False)):
        report = Message("adjustment/report", _said(messages, second).stamp_ns, out, "adjuster", 10**6)
        path = write_recording(
            tmp_path / "said.mcap", [*rest, _moved(messages, 15.0), _said(messages, 16.0), again, report]
        )
        flight = collect(RecordingReader(path).sorted_messages())
        assert np.isfinite(flight.given(body.point)).all() == wanted
        assert len(known_points(Recording(path))) == wanted


def _changed(messages, stamp_ns: int) -> list[Message]:
    """Another project and camera in the same local frame, each with an operator's word: lever arm, boresight and image
    sigma; and lines that lie elsewhere."""
    found = []
    for topic in ("configuration/project", "configuration/camera"):
        was = _of(messages, topic)
        body = type(was.body).FromString(was.body.SerializeToString())
        if topic == "configuration/project":
            body.lever_arm_m[:] = [10.0, 0.0, 5.0]
            body.boresight_deg[:] = [1.0, 0.0, 0.0]
            body.image_sigma_px = 20.0
        else:
            for line in body.lines:
                line.x_mm[:] = [x + 1.0 for x in line.x_mm]
        said = m.Verdict(topic=topic, accepted=True, by="Ann")
        found += [
            replace(was, body=body, stamp_ns=stamp_ns, sequence=was.sequence + 1),
            Message("observation/verdict", stamp_ns + 1, said, "surveyor", 0),
        ]
    return found


def test_what_was_measured_before_a_change_is_computed_with_what_held_then(messages):
    """A mounting and a camera that an operator lets in when the strip is over say nothing of the lines before."""
    strip = _of(messages, "configuration/strip").body
    over = strip.first_line_time_ns + round(strip.lines / strip.line_rate_hz * SECOND)
    right = evaluate_flight(collect(messages))
    order = sorted([*messages, *_changed(messages, over + SECOND)], key=lambda x: x.stamp_ns)
    found = collect(order)
    assert found.project.image_sigma_px == 20.0 and not found.not_used
    found = evaluate_flight(found)
    for rows in ("orientation", "points", "check", "control"):
        assert found[rows] == right[rows]


def test_what_is_measured_after_a_change_is_computed_with_what_holds_from_then_on(messages):
    strip = _of(messages, "configuration/strip").body
    half = strip.first_line_time_ns + round(0.5 * strip.lines / strip.line_rate_hz * SECOND)
    begun = [replace(x, stamp_ns=_of(messages, x.topic).stamp_ns) for x in _changed(messages, half)[::2]]
    other = [next((y for y in begun if y.topic == x.topic), x) for x in messages]
    changed = sorted([*messages, *_changed(messages, half)], key=lambda x: x.stamp_ns)
    before, after, found = (collect(told) for told in (messages, other, changed))
    errors = [orientation_errors(flight)["measured"] for flight in (before, after, found)]
    late = errors[2][0] > half
    for got, first, then in zip(errors[2], errors[0], errors[1], strict=True):
        np.testing.assert_array_equal(got[~late], first[~late])
        np.testing.assert_array_equal(got[late], then[late])
    assert late.any() and not late.all() and not np.allclose(errors[0][1], errors[1][1])
    rays = [usable_rays(flight)[1] for flight in (before, after, found)]
    late = rays[2].time_s > found.seconds(half)
    for name in ("xy_mm", "focal_length_mm", "sigma_sample_px"):
        got, first, then = (getattr(of, name) for of in (rays[2], rays[0], rays[1]))
        np.testing.assert_array_equal(got[~late], first[~late])
        np.testing.assert_array_equal(got[late], then[late])


def test_lines_of_a_camera_that_was_replaced_have_their_residuals(messages):
    strip = _of(messages, "configuration/strip").body
    other = _changed(messages, strip.first_line_time_ns + 10 * SECOND)[2:]
    for line in other[0].body.lines:
        line.id += "2"
    found = collect(sorted([*messages, *other], key=lambda x: x.stamp_ns))
    right = residuals_by_ccd(collect(messages))
    assert right and {ccd: len(rows) for ccd, rows in residuals_by_ccd(found).items()} == {
        ccd: len(rows) for ccd, rows in right.items()
    }


def test_who_has_one_camera_for_a_flight_with_two_says_so(messages, tmp_path, capsys):
    """`rectify` and `adjust` take what was imaged before another camera was let in with that one."""
    strip = _of(messages, "configuration/strip").body
    half = strip.first_line_time_ns + 10 * SECOND
    camera, said = _changed(messages, half)[2:]
    early = replace(camera, stamp_ns=_of(messages, "configuration/camera").stamp_ns)
    for k, (more, told) in enumerate((([], False), ([camera], False), ([early], False), ([camera, said], True))):
        reader = RecordingReader(write_recording(tmp_path / f"{k}.mcap", [*messages, *more]))
        tell_other_camera("rectify", reader)
        words = f"before {iso(half + 1)} nodes used another camera"
        assert (words in capsys.readouterr().err) == told
        block = block_from_messages(RecordedVoices().all_used(reader.sorted_messages(TOPICS)), "flight")
        assert any(words in note for note in block.notes) == told
