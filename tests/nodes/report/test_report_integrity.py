"""What the page says of integrity: the light, protection levels and whether they held, drifting sources."""

from __future__ import annotations

import copy
import re
from types import SimpleNamespace

import numpy as np
import pytest
from recording_file import write_recording
from synthetic_flight import LIVE_SIGMA, START_NS, flight_messages

from triline.nodes import convert
from triline.nodes.cli import main
from triline.nodes.node import Message
from triline.nodes.recording.summary import Holdings
from triline.nodes.report.analysis import analyse
from triline.nodes.report.evaluation import orientation_errors
from triline.nodes.report.flight import Look, collect, rejected_key
from triline.nodes.report.integrity import integrity, levels, protection_figure
from triline.nodes.report.page import page
from triline.nodes.report.source import read
from triline.nodes.report.style import FINAL, LIVE
from triline.schemas import messages as m

WEAK_S = 10.0  # of 26 s on the strip
FACTOR = np.array([8.0, 8.0, 8.0, 8.0, 8.0, 0.5])  # protection over sigma: kappa's is too small


def _light(message):
    """What a report says of integrity, by its time."""
    body = message.body
    t = (message.stamp_ns - START_NS) / convert.SECOND_NS
    body.strip = "S1"
    if t < 2.0 + WEAK_S:
        body.light, body.light_reason = "weak", f"no control within {t:.0f} s, {np.sin(t):+.2f} px"
    else:
        body.light, body.light_reason = "good", ""
    body.protection.extend(FACTOR * LIVE_SIGMA)
    body.sigma.extend(LIVE_SIGMA)
    body.ground_protection.extend([0.5, 3.0 if body.light == "weak" else 1.0, 0.4, 0.2])
    body.alert_limit_m = 2.0
    if 15.0 < t < 20.0:
        body.sources.append(
            m.BiasedSource(
                source="matcher", ccd="F", line=0.2, sample=-0.01 * t, since_ns=START_NS + 15 * convert.SECOND_NS,
                rivals=["matcher/B"],
            )
        )  # fmt: skip


@pytest.fixture(scope="module")
def messages():
    told = flight_messages(seconds=30.0, points=60)
    for message in told:
        if message.topic == "adjustment/report":
            _light(message)
    return told


def test_shares_of_the_light_and_its_reasons(messages):
    flight = collect(messages)
    said = integrity(flight)
    assert said is not None
    first = min(stamp for stamp, _ in flight.reports)
    weak = 2.0 + WEAK_S - (first - START_NS) / convert.SECOND_NS
    assert said["share"]["good"] + said["share"]["weak"] == pytest.approx(1.0) and said["share"]["failed"] == 0.0
    assert said["share"]["weak"] * said["seconds"] == pytest.approx(weak, abs=0.6)
    # reasons that differ in numbers only are one
    assert [(r["light"], r["times"]) for r in said["reasons"]] == [("good", 1), ("weak", 1)]
    assert sum(r["seconds"] for r in said["reasons"]) == pytest.approx(said["seconds"])
    assert (said["alert_limit_m"], said["ground_m"]) == (2.0, 1.0)
    assert said["below_limit"] == pytest.approx(said["share"]["good"], abs=0.05)
    (source,) = said["sources"]
    assert (source["source"], source["ccd"], source["rivals"]) == ("matcher", "F", ["matcher/B"])
    assert source["since_s"] == pytest.approx(15.0, abs=0.1) and 3.5 < source["seconds"] < 5.5
    assert source["sample_px"] == pytest.approx(-0.2, abs=0.01)


def test_errors_beyond_the_protection_level_are_counted(messages):
    flight = collect(messages)
    said, found = integrity(flight), levels(flight)
    assert said is not None and found is not None
    np.testing.assert_allclose(said["protection_m"], FACTOR[:3] * LIVE_SIGMA[:3])
    np.testing.assert_allclose(said["sigma_deg"], np.degrees(LIVE_SIGMA[3:]))
    assert said["compared"] > 20 and said["exceeded"][:5] == [0] * 5
    assert 0.3 * said["compared"] < said["exceeded"][5] < said["compared"]  # half a sigma holds 38 % of normal errors
    # against the errors themselves, at the reports' own times
    time_ns, error, *_ = orientation_errors(flight)["live"]
    t, _, _, matched = found
    for k in np.flatnonzero(np.isfinite(matched[:, 0]))[::7]:
        nearest = np.argmin(np.abs(flight.seconds(time_ns) - t[k]))
        np.testing.assert_array_equal(matched[k], error[nearest])


def test_without_truth_levels_stand_alone_and_without_lights_nothing_is_said(messages):
    said = integrity(collect([k for k in messages if not k.topic.startswith("truth/")]))
    assert said is not None and "protection_m" in said and "exceeded" not in said
    assert integrity(collect(flight_messages(seconds=12.0, points=20))) is None


def test_reports_that_are_as_far_apart_as_the_pace_for_throughput_makes_them(messages):
    """Updates each 10 s: each report counts until the next, and the figure joins what they say."""
    kept, last_ns = [], 0
    for message in messages:
        if message.topic == "adjustment/report":
            if message.stamp_ns - last_ns < 10 * convert.SECOND_NS:
                continue
            last_ns, body = message.stamp_ns, m.AdjustmentReport()
            body.CopyFrom(message.body)
            body.update_interval_s = 10.0
            message = Message(message.topic, message.stamp_ns, body, message.source, message.sequence)
        kept.append(message)
    flight = collect(kept)
    said, figure = integrity(flight), protection_figure(flight)
    assert said is not None and figure is not None
    assert len(flight.reports) == 3 and said["seconds"] == pytest.approx(20.0, abs=0.1)
    drawn = {line.get_label(): np.asarray(line.get_ydata()) for line in figure.axes[0].get_lines()}
    assert np.isfinite(drawn["protection level"]).all() and len(drawn["protection level"]) == 3
    dots = [line for line in figure.axes[0].get_lines() if line.get_marker() == "."]
    assert not any(len(line.get_xdata()) for line in dots)
    lone = collect([k for k in kept if k.topic != "adjustment/report" or k.stamp_ns == last_ns])
    figure = protection_figure(lone)
    assert figure is not None
    dots = [line for line in figure.axes[0].get_lines() if line.get_marker() == "." and len(line.get_xdata())]
    assert {line.get_color() for line in dots} >= {LIVE, FINAL}, "a single report is seen"
    # the table and the background end with the strip, not with the last report on it or the next one
    start = (min(stamp for stamp, _ in flight.reports) - flight.start_ns) / convert.SECOND_NS
    flight.strips["S1"] = copy.deepcopy(flight.strips["S1"])
    flight.strips["S1"].lines = int(flight.strips["S1"].line_rate_hz * (start + 17.0 - 2.0)) + 1
    said, figure = integrity(flight), protection_figure(flight)
    assert said is not None and figure is not None and said["seconds"] == pytest.approx(17.0, abs=0.1)
    shades = [patch.get_extents() for kind in figure.axes[0].collections for patch in kind.get_paths()]
    assert min(box.x0 for box in shades) == pytest.approx(start, abs=0.1)
    assert max(box.x1 for box in shades) == pytest.approx(start + 17.0, abs=0.1)


def test_a_report_between_strips_does_not_set_the_scale_of_the_levels(messages):
    """The window runs dry after a strip, and states protection levels of thousands of kilometres that are not drawn."""
    flight = collect(messages)
    stamp, last = next((stamp, r) for stamp, r in reversed(flight.reports) if len(r.protection) == 6)
    flight.strips["S2"] = later = copy.deepcopy(flight.strips["S1"])
    later.id, later.first_line_time_ns = "S2", stamp + 100 * convert.SECOND_NS
    before = protection_figure(flight)
    dry = m.AdjustmentReport()
    dry.CopyFrom(last)
    dry.protection[:] = [3e7] * 6
    flight.reports.append((stamp + 50 * convert.SECOND_NS, dry))
    after = protection_figure(flight)
    assert before is not None and after is not None
    for a, b in zip(before.axes, after.axes, strict=True):
        assert a.get_ylim() == pytest.approx(b.get_ylim())
    # where all of them come between strips there is no figure: it was empty, with an axis of 2e-10 m
    stamp, lit = next((stamp, r) for stamp, r in flight.reports if r.light and r.strip)
    bare = copy.deepcopy(lit)
    del bare.protection[:]
    flight.reports = [(stamp, bare), flight.reports[-1]]
    assert levels(flight) is not None and protection_figure(flight) is None


def test_the_page_has_a_section_with_figure_and_units(messages, tmp_path, request):
    path = write_recording(tmp_path / "flight.mcap", messages)
    target = tmp_path / "report.html"
    assert main(["analyze", str(path), "-o", str(target), "-q"]) == 0
    text = target.read_text()
    section = text[text.index("<h2>Integrity</h2>") :]
    section = section[: section.index("</section>")]
    assert re.search(r"good (69|70|71) %, weak (29|30|31) %, failed 0 %", section)
    assert section.count("<svg") == 1 and "protection level, median" in section and "κ [mdeg]" in section
    assert re.search(r"1\.00 m \(median\); below the alert limit of 2\.00 m in (69|7[0-2]) % of", section)
    assert "matcher/B" in section and "-0.20" in section
    request.getfixturevalue("undrawn")
    plain = write_recording(tmp_path / "plain.mcap", flight_messages(seconds=12.0, points=20))
    assert main(["analyze", str(plain), "-o", str(target), "-q"]) == 0
    assert "<h2>Integrity</h2>" not in target.read_text()


def test_what_is_said_again_of_a_whole_strip_replaces_what_was_said_before(messages, tmp_path):
    """The backward pass of a single strip comes when it is over and when the flight is: the last one counts."""
    final = [k for k in messages if k.topic == "orientation/final"]
    told = list(messages)
    for turn, shift in ((31, 5.0), (33, 0.25)):
        for k in final:
            body = type(k.body)()
            body.CopyFrom(k.body)
            body.pose.position.x += shift
            told.append(type(k)("orientation/whole", START_NS + turn * convert.SECOND_NS, body, "test", len(told)))
    flight, _ = read(write_recording(tmp_path / "flight.mcap", told))
    whole, before = flight.poses["whole"], flight.poses["final"]
    assert len(whole) == len(final)
    np.testing.assert_allclose(whole.position_l - before.position_l, [[0.25, 0.0, 0.0]] * len(whole), atol=1e-9)


@pytest.mark.usefixtures("undrawn")
def test_coordinates_of_a_control_point_are_refused_one_by_one():
    """They have no image point, so that only the coordinate tells them apart; the table shows no line 0."""
    refused = [
        SimpleNamespace(point="GCP1", strip="", ccd="", line=0.0, sample=0.0, coordinate=c, w=9.0, reason="contradicts")
        for c in ("X", "Z")
    ]
    assert len({rejected_key(r) for r in refused}) == 2
    look = Look("P1", "S1", "F", 10.0, 20.0, 0.3, 0.3)
    assert look.key == rejected_key(m.RejectedObservation(point="P1", strip="S1", ccd="F", line=10.0, sample=20.0))
    flight = collect(flight_messages(seconds=12.0, points=20))
    flight.rejected = refused
    text = page(flight, analyse(flight, Holdings("x.mcap", 0, 0, None, [], [], [])))
    html = text[text.index("<h2>Rejected observations</h2>") :]
    html = html[: html.index("</section>")]
    assert html.count("GCP1") == 2 and ">X<" in html and ">Z<" in html and "0.00" not in html
