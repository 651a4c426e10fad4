"""The adjuster node: a demo flight through navigator and adjuster, bad input, restart, queries."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from stepped_node import stepped

from triline.nodes import convert
from triline.nodes.adjuster.adjuster import Adjuster
from triline.nodes.navigator.navigator import Navigator
from triline.nodes.node import Message
from triline.nodes.simulator.simulator import Simulator
from triline.schemas import messages as m
from triline.solver.simulation.error_models import ErrorModel
from triline.solver.simulation.flight import FlightPlan
from triline.solver.simulation.scenario import ObservationPlan, simulate

EPOCH = 1_700_000_000_000_000_000
#: Where it is not asked when updates come: they take most of the time.
SELDOM = {"update_s": 1.0, "update_rays": 1000}


@pytest.fixture(scope="module")
def flight():
    """Simulation, and what the adjuster gets: configuration, navigator's poses, control and tie points, in order."""
    simulation = simulate(
        FlightPlan(strip_s=28.0, lead_in_s=2.0, lead_out_s=1.0),
        4,
        ErrorModel(attitude_rate_hz=100.0),
        ObservationPlan(tie_points_per_s=5.0, check=8),
    )
    navigator, messages = Navigator(), []
    for message in Simulator(simulation).messages(EPOCH):
        if message.topic in Navigator.inputs:
            messages += [o for o in navigator.step(message) if o.topic in Adjuster.inputs]
        if message.topic in Adjuster.inputs:
            messages.append(message)
    messages += [o for o in navigator.finish() if o.topic in Adjuster.inputs]
    return simulation, messages


@pytest.fixture(scope="module")
def done(flight):
    node = Adjuster(grid_hz=10.0)
    return node, stepped(node, flight[1])


def bodies(outputs, topic):
    return [o.body for o in outputs if o.topic == topic]


def seconds(body):
    return (convert.time_ns(body.timestamp) - EPOCH) * 1e-9


def errors(simulation, poses):
    truth = simulation.flight.truth.at([seconds(p) for p in poses])
    position = np.array([convert.pose_sample(p).position_l for p in poses]) - truth.position_l
    return np.sqrt(np.mean(np.hstack([position, np.array([p.angles for p in poses]) - truth.angles]) ** 2, axis=0))


def test_it_publishes_what_it_says(done, flight):
    node, outputs = done
    assert {o.topic for o in outputs} == set(node.outputs)
    assert node.state() == "running"
    stamps = [o.stamp_ns for o in outputs]
    assert stamps == sorted(stamps)
    live, final = bodies(outputs, "orientation/live"), bodies(outputs, "orientation/final")
    for poses in (live, final):
        times = np.array([seconds(p) for p in poses])
        if poses is live:  # besides the grid it follows updates for waiting image points
            times = times[np.abs(10 * times - np.round(10 * times)) < 1e-6]
            times = np.unique(times.round(6))
        assert np.diff(times) == pytest.approx(0.1)
        assert times[0] == pytest.approx(2.0, abs=0.11) and times[-1] > 29.8
        assert all(p.strip == "S1" and p.valid and len(p.correction) == 6 for p in poses)
    assert {p.status for p in bodies(outputs, "point/object")} == {0, 1, 2}
    whole = bodies(outputs, "orientation/whole")
    assert [p.timestamp for p in whole] == [p.timestamp for p in final]  # once: one strip, and nothing came after it
    assert {p.point for p in bodies(outputs, "point/object") if p.status == 1} == {
        p.point for p in bodies(outputs, "point/object") if p.status == 2
    }
    # what is learnt late helps what became final early: attitude and position are more certain
    early = [np.diag(convert.pose_sample(p[20]).covariance) for p in (whole, final)]
    assert (early[0] < early[1]).all()
    final_points = [p for p in bodies(outputs, "point/object") if p.status == 1]
    assert len({p.point for p in final_points}) == len(final_points) > 100
    assert all(len(p.residuals) >= 2 and len(p.covariance) == 9 for p in final_points)
    control = [p for p in final_points if p.role == "control"]
    assert len(control) >= 4 and all(p.covariance[0] < 0.02**2 for p in control)


def test_the_refined_orientation_is_better_than_the_measured_one_in_every_component(done, flight):
    simulation, messages = flight
    final = errors(simulation, bodies(done[1], "orientation/final"))
    smoothed = [x.body for x in messages if x.topic == "trajectory/smoothed" and 2.0 <= seconds(x.body) < 30.0]
    assert (final < errors(simulation, smoothed)).all()


def test_reports_add_up(done):
    reports = bodies(done[1], "adjustment/report")
    last = reports[-3]
    assert [r.update for r in reports] == list(range(len(reports)))
    assert 0.85 < last.sigma0_total < 1.15 and last.redundancy_total > 200
    assert last.window_start_ns > EPOCH and last.window_end_ns < EPOCH + 32e9
    busy = max(reports, key=lambda r: r.rays)
    assert busy.observations - busy.unknowns > 0 and busy.control >= 3 and busy.strip == "S1"
    names = [p.name for p in busy.parameters]
    of_strip = ["dX", "dY", "dZ", "domega", "dphi", "dkappa", "omega drift", "phi drift", "kappa drift"]
    assert names == [
        *of_strip,
        "clock",
        "dc",
        "k1",
        "k2",
        "p1",
        "p2",
        *(f"{k}_{line}" for k in ("xp", "yp", "sy", "th") for line in "BF"),
    ]
    assert all(p.sigma > 0 and p.t == pytest.approx(p.value / p.sigma) for p in busy.parameters)
    assert 0.0 < busy.data_latency_s < 1.0


def test_the_operator_is_told_what_the_result_rests_on(done, flight):
    texts = [b.message for b in bodies(done[1], "event/log")]
    assert texts[0] == "strip S1 began" and "strip S1 ended" in texts
    assert any(t.startswith("weak: no tie points") for t in texts) and "good" in texts
    blind = stepped(Adjuster(grid_hz=2.0, **SELDOM), [x for x in flight[1] if x.topic != "observation/control"])
    last = [b.message for b in bodies(blind, "event/log") if b.message.startswith(("good", "weak", "failed"))]
    assert "good" not in last[:-1]
    in_flight = [text for text in last if "over: " not in text]
    assert any("datum rest on GNSS" in text for text in in_flight), "the reason has changed under a light that has not"


def test_a_strip_that_is_flown_again_under_its_name_is_told_and_left_out(done, flight):
    """It was told as begun, and all of it was lost without a word."""
    last = flight[1][-1].stamp_ns
    strip = next(x.body for x in reversed(flight[1]) if x.topic == "configuration/strip")
    again, same = m.Strip(), m.Strip()
    for body, later_s in ((again, 300), (same, 0)):
        body.CopyFrom(strip)
        body.ended, body.lines, body.first_line_time_ns = (
            False,
            0,
            strip.first_line_time_ns + later_s * convert.SECOND_NS,
        )
    node = Adjuster(grid_hz=2.0, **SELDOM)
    for message in flight[1]:
        node.step(message)
    texts = [
        o.body.message for o in node.step(Message("configuration/strip", last + 1, again)) if o.topic == "event/log"
    ]
    assert texts == [
        "strip S1 has ended and begins once more, 300 s after its first line: what is flown now is left out; it wants "
        "the name of another strip"
    ]
    assert node.counters["strip flown again"] == 1
    texts = [
        o.body.message for o in node.step(Message("configuration/strip", last + 2, same)) if o.topic == "event/log"
    ]
    assert not any("once more" in text for text in texts)  # who announces it was started again


def test_same_messages_same_bytes(done, flight):
    again = stepped(Adjuster(grid_hz=10.0), flight[1])
    first, second = (
        [(o.topic, o.stamp_ns, o.body.SerializeToString(deterministic=True)) for o in outputs]
        for outputs in (done[1], again)
    )
    assert first == second


def test_queries(done):
    node, outputs = done
    final = bodies(outputs, "orientation/final")[37]
    t = convert.time_ns(final.timestamp)
    whole = node.query("orientation", {"t": str(t)}).body  # the strip is over: with the information of all of it
    assert convert.time_ns(whole.timestamp) == t and whole.strip == "S1"
    sigma = np.sqrt(final.covariance[0])
    assert abs(whole.pose.position.x - final.pose.position.x) < 4.0 * sigma
    assert whole.covariance[0] <= final.covariance[0]
    between = node.query("orientation", {"t": str(t + 40_000_000)}).body
    assert convert.time_ns(between.timestamp) == t + 40_000_000
    assert between.pose.position.x - whole.pose.position.x == pytest.approx(2.8, abs=0.1)
    assert node.query("orientation", {"t": str(t * 1e-9 + 1e5)}) is None
    assert node.query("orientation", {"t": "soon"}) is None
    assert node.query("weather", {}) is None


def test_bad_tie_points_are_rejected_and_named_and_change_nothing_else(done, flight):
    image = dict(strip="S1", ccd="N", line=2000.0, sample=6000.0)
    bad = [
        ("unknown ccd", {**image, "ccd": "X"}),
        ("unknown strip", {**image, "strip": "S7"}),
        ("outside strip", {**image, "line": 1e6}),
        ("beyond the ccd line", {**image, "sample": 13000.0}),
        ("value is not finite", {**image, "line": float("nan")}),
    ]
    messages = list(flight[1])
    middle = next(i for i, x in enumerate(messages) if x.stamp_ns > EPOCH + 15e9)
    stamp = messages[middle].stamp_ns
    ties = [Message("observation/tie", stamp, convert.tie_message(f"bad{i}", [f])) for i, (_, f) in enumerate(bad)]
    node = Adjuster(grid_hz=10.0)
    outputs = stepped(node, messages[:middle] + ties + messages[middle:])
    for reason, _ in bad:
        assert node.counters[reason] == 1, reason
    rejected = {(r.point, r.reason) for report in bodies(outputs, "adjustment/report") for r in report.rejected}
    assert {(f"bad{i}", reason) for i, (reason, _) in enumerate(bad)} <= rejected
    assert bodies(outputs, "orientation/final") == bodies(done[1], "orientation/final")


@pytest.mark.parametrize(
    ("topic", "body"),
    [
        ("trajectory/filtered", m.PoseInFrame()),
        ("observation/control", m.GroundPoint(point="P", x=float("nan"), covariance=[1.0] * 9)),
        ("observation/control", m.GroundPoint(point="P", x=1.0, covariance=[0.0] * 9)),
        ("observation/control", m.GroundPoint(x=1.0, covariance=[1.0] * 9)),
        ("configuration/strip", m.Strip(id="S2", line_rate_hz=0.0)),
        ("configuration/strip", m.Strip(line_rate_hz=100.0)),
        ("configuration/camera", m.Camera(name="empty", lines=[m.CcdLine(id="N", lens="L1")])),
        ("configuration/project", m.Project(wander_sigma_m=[-1.0, 0.0, 0.0])),
    ],
)
def test_bad_messages_are_counted_and_the_node_goes_on(done, flight, topic, body):
    messages = flight[1][:1200]
    node = Adjuster(grid_hz=10.0)
    for message in messages:
        node.step(message)
    assert list(node.step(Message(topic, messages[-1].stamp_ns, body))) == []
    assert node.counters["malformed"] == 1 and topic in node.last_problem
    assert any(o.topic == "orientation/live" for x in flight[1][1200:1400] for o in node.step(x))


def test_it_waits_for_its_configuration(flight):
    node = Adjuster()
    assert node.state() == "waiting for configuration/project, configuration/camera"
    rest = [x for x in flight[1][:300] if not x.topic.startswith(("configuration/", "observation/control"))]
    assert stepped(node, rest) == []
    assert node.counters["before configuration"] == len(rest)


def test_killed_and_restarted_in_flight_it_catches_up(done, flight):
    simulation, messages = flight
    latched = [x for x in messages if x.topic.startswith("configuration/") or x.topic == "observation/control"]
    again = [x for x in latched if x.stamp_ns < EPOCH + 9e9] + [x for x in messages if x.stamp_ns >= EPOCH + 9e9]
    node = Adjuster(grid_hz=10.0, **SELDOM)
    outputs = stepped(node, again)
    final = bodies(outputs, "orientation/final")
    assert seconds(final[0]) < 9.2 and seconds(final[-1]) > 29.8
    error = errors(simulation, [p for p in final if seconds(p) > 12.0])
    sigma = np.sqrt(np.mean([np.diag(convert.pose_sample(p).covariance) for p in final if seconds(p) > 12.0], axis=0))
    assert (error < 3.0 * sigma).all()
    assert node.counters["no orientation"] > 0  # looks from before it was born


def test_invalid_poses_make_invalid_orientation(flight):
    messages = []
    for x in flight[1]:
        if x.topic.startswith("trajectory/") and 12.0 < seconds(x.body) < 13.0:
            body = m.PoseInFrame()
            body.CopyFrom(x.body)
            body.valid, body.reason = False, "no GNSS for 3.0 s"
            x = Message(x.topic, x.stamp_ns, body)
        messages.append(x)
    outputs = stepped(Adjuster(grid_hz=10.0, **SELDOM), messages)
    for topic in ("orientation/live", "orientation/final"):
        invalid = [p for p in bodies(outputs, topic) if not p.valid]
        assert 8 <= len(invalid) <= 12 and all(p.reason == "no GNSS for 3.0 s" for p in invalid)


def test_an_imported_trajectory_without_filter_output_works_too(flight):
    outputs = stepped(Adjuster(grid_hz=10.0, **SELDOM), [x for x in flight[1] if x.topic != "trajectory/filtered"])
    assert len(bodies(outputs, "orientation/live")) > 250
    assert len(bodies(outputs, "orientation/final")) > 270


@pytest.mark.parametrize("grid_hz", [1.0, 0.5, 3.0])
def test_live_orientation_comes_at_every_time_of_a_coarse_grid(flight, grid_hz):
    simulation, messages = flight
    ((begin, end),) = simulation.flight.strip_times_s
    outputs = stepped(Adjuster(grid_hz=grid_hz), [x for x in messages if not x.topic.startswith("observation/")])
    live = [seconds(p) for p in bodies(outputs, "orientation/live")]
    assert live[0] < begin + 1.0 / grid_hz and live[-1] > end - 1.0 / grid_hz
    assert np.diff(live) == pytest.approx(1.0 / grid_hz, abs=1e-6)


def test_settings_are_checked():
    with pytest.raises(ValueError, match="update_s"):
        Adjuster(update_s=0.0)
    with pytest.raises(ValueError, match="tls18"):
        Adjuster(self_calibration="tls99")
    with pytest.raises(ValueError, match="camera_sigma: wanted more than 0, got -1"):
        Adjuster(camera_sigma=-1)
    with pytest.raises(ValueError, match="clock_sigma_s: wanted 0 or more, and less than 0"):
        Adjuster(clock_sigma_s=-1)
    with pytest.raises(ValueError, match="lever_arm_sigma_m: wanted 0 or more, and less than 100 m, got nan"):
        Adjuster(lever_arm_sigma_m=float("nan"))
    with pytest.raises(ValueError, match="window_s"):
        Adjuster(window_s=-1.0)
    with pytest.raises(ValueError, match="spline"):
        Adjuster(model="spline")


def with_control(messages, change):
    """The flight with other control: what `change` makes of each ground point, None to leave it out."""
    for message in messages:
        if message.topic != "observation/control" or message.body.role == m.GroundPoint.Role.Value("CHECK"):
            yield message
            continue
        body = m.GroundPoint()
        body.CopyFrom(message.body)
        yield from change(replace(message, body=body))


def lines(outputs):
    return [(o.body.message, o.body.level) for o in outputs if o.topic == "event/log"]


def test_refused_control_is_in_the_report_and_in_the_log(flight):
    def raised(message):
        message.body.z += 47.0
        return [message]

    # a focal length that is unknown takes a little of 47 m, and Y of a point at the edge of the image is refused, too
    adjuster = Adjuster(grid_hz=2.0, datum="gnss", self_calibration="none", **SELDOM)
    outputs = stepped(adjuster, with_control(flight[1], raised))
    refused = [r for body in bodies(outputs, "adjustment/report") for r in body.rejected if r.coordinate]
    assert refused and {(r.coordinate, r.reason) for r in refused} == {("Z", "contradicts")}
    assert all(r.w > 5.0 and r.off == pytest.approx(47.0, abs=8.0) and not r.ccd for r in refused)
    warning = m.Log.Level.Value("WARNING")
    for r in refused:
        assert any(text.startswith(f"control {r.point} Z refused: w ") and level == warning
                   for text, level in lines(outputs))  # fmt: skip
    assert sum("height system (geoid)?" in text and "rests on GNSS" in text for text, _ in lines(outputs)) == 1
    lights = [b for b in bodies(outputs, "adjustment/report") if b.control >= 2]
    assert lights and all(b.light == "failed" for b in lights)


def test_every_look_that_a_test_refused_has_its_w(flight):
    rng = np.random.default_rng(2)
    messages = []
    for message in flight[1]:
        if message.topic == "observation/tie" and rng.random() < 0.1:
            body = m.TiePoint()
            body.CopyFrom(message.body)
            body.images[0].sample += rng.choice([-1.0, 1.0]) * rng.uniform(10.0, 80.0)
            message = replace(message, body=body)
        messages.append(message)
    outputs = stepped(Adjuster(grid_hz=2.0, **SELDOM), messages)
    rejected = [r for body in bodies(outputs, "adjustment/report") for r in body.rejected if r.reason == "snooping"]
    assert len(rejected) > 20 and all(r.w > 0.0 for r in rejected)
    assert np.median([r.w for r in rejected]) > 5.0


def test_control_that_comes_or_changes_in_flight_is_told(done, flight):
    control = [x for x in flight[1] if x.topic == "observation/control"]
    late = max(x.stamp_ns for x in flight[1]) - 15 * convert.SECOND_NS
    first = next(i for i, x in enumerate(flight[1]) if x.stamp_ns >= late)
    mine = [x for x in control if x.body.role == m.GroundPoint.Role.Value("CONTROL")]
    rest = [x for x in flight[1] if x is not mine[0]]
    changed = m.GroundPoint()
    changed.CopyFrom(mine[1].body)
    changed.z += 0.5
    surer = m.GroundPoint()
    surer.CopyFrom(mine[2].body)
    del surer.covariance[:]
    surer.covariance.extend([1e-4, 0.0, 0.0, 0.0, 1e-4, 0.0, 0.0, 0.0, 2.5e-3])
    news = [replace(mine[0], stamp_ns=late), *(Message("observation/control", late, b) for b in (changed, surer))]
    said = [text for text, _ in lines(stepped(Adjuster(grid_hz=2.0, **SELDOM), rest[:first] + news + rest[first:]))]
    assert f"control came in flight: {mine[0].body.point}" in said
    words = f"{surer.point} in its sigmas, from 0.02, 0.02, 0.02 to 0.01, 0.01, 0.05 m"
    assert f"control changed in flight: {changed.point} by 0.00, 0.00, 0.50 m, {words}" in said
    assert not [text for text, _ in lines(done[1]) if "in flight" in text]


@pytest.mark.parametrize("accepted", [True, False])
def test_a_verdict_counts_that_comes_before_its_ground_point(flight, accepted):
    """A router or a recorder may hand on what an operator said before it hands on the point."""
    messages = [x for x in flight[1] if not x.topic.startswith("sensor/")]
    point = next(x.body.point for x in messages if x.topic == "observation/control")
    of_point = next(i for i, x in enumerate(messages) if x.topic == "observation/control")
    said = Message("observation/verdict", messages[of_point].stamp_ns, m.Verdict(point=point, accepted=accepted))
    nodes = []
    for place in (of_point, of_point + 1):  # before it, and after it
        node, log = Adjuster(grid_hz=10.0), []
        for message in [*messages[:place], said, *messages[place : place + 400]]:
            log += [o.body.message for o in node.step(message) if o.topic == "event/log"]
        nodes.append((node, log))
        assert not node.counters["malformed"]
    (early, said_early), (late, _) = nodes
    assert early._window.network.intake.control[point].role == late._window.network.intake.control[point].role
    assert (late._window.network.intake.control[point].role == "check") != accepted
    assert any(text.startswith(f"{point} is ") and "no ground point so far" in text for text in said_early)


def test_a_strip_joined_in_its_middle_says_so_and_begins_there(done, flight):
    start = next(x.body.first_line_time_ns for x in flight[1] if x.topic == "configuration/strip")
    joined = start + 15 * convert.SECOND_NS
    known = ("configuration/", "observation/control")
    late = [x for x in flight[1] if x.topic.startswith(known) or x.stamp_ns >= joined]
    node = Adjuster(grid_hz=2.0, **SELDOM)
    outputs = stepped(node, late)
    said = [text for text, _ in lines(outputs) if "joined" in text]
    assert len(said) == 1 and said[0].startswith("strip S1 is joined 1") and "neither final nor whole" in said[0]
    model = node._window.strips["S1"].model
    assert model.extent.start_s * 1e9 + node._reference_ns == pytest.approx(joined - 10e9, abs=6e9)
    assert min(seconds(p) for p in bodies(outputs, "orientation/final")) > (joined - EPOCH) * 1e-9 - 6.0
    assert not [text for text, _ in lines(done[1]) if "joined" in text]


@pytest.mark.parametrize("another", ["image_sigma_px", "origin_latitude"])
def test_another_project_in_flight_starts_the_window_again_and_live_orientation_goes_on(flight, another):
    messages = flight[1]
    was = next(x for x in messages if x.topic == "configuration/project").body
    project = type(was).FromString(was.SerializeToString())
    setattr(project, another, getattr(project, another) + 0.01)
    k = next(i for i, x in enumerate(messages) if x.stamp_ns > EPOCH + 18e9)
    again = Message("configuration/project", messages[k].stamp_ns, project, "surveyor", 1)
    spoilt = []
    for x in messages[:k]:  # an attitude that is not known yet, early in the flight
        if x.topic.startswith("trajectory/") and seconds(x.body) < 5.0:
            body = type(x.body).FromString(x.body.SerializeToString())
            body.valid, body.reason = False, "aligning"
            x = replace(x, body=body)
        spoilt.append(x)
    node = Adjuster(grid_hz=10.0, **SELDOM)
    outputs = stepped(node, [*spoilt, again, *messages[k:]])
    times = np.array([seconds(p) for p in bodies(outputs, "orientation/live")])
    grid = np.unique(times[np.abs(10 * times - np.round(10 * times)) < 1e-6].round(6))
    assert len(grid) > 0.9 * 280 and np.diff(grid).max() < 1.0
    kinds = ("orientation/live", "orientation/final", "orientation/whole")
    after = [p for topic in kinds for p in bodies(outputs, topic) if seconds(p) > 19]
    assert len(after) > 300 and all(p.valid for p in after)
    (told,) = [p.message for p in bodies(outputs, "event/log") if "the window starts again" in p.message]
    assert ("another origin or CRS" in told) == (another == "origin_latitude")
    assert ("ground points do not count" in told) == (another == "origin_latitude")
    assert bool(node._control.bodies) == (another != "origin_latitude")  # stated in the frame before
    assert node.counters["another local frame"] == (another == "origin_latitude")
    early = node.query("orientation", {"t": str(EPOCH + 10 * 10**9)})
    assert (early is None) == (another == "origin_latitude")  # in the frame before


def test_a_tie_point_that_waited_for_a_pose_is_counted_when_it_is_refused(flight):
    """The pose was counted in its place, and with one of several."""
    messages = flight[1]
    node = Adjuster(**SELDOM)
    for topic in ("configuration/project", "configuration/camera", "configuration/strip"):
        node.step(next(x for x in messages if x.topic == topic))
    first = next(x for x in messages if x.topic == "observation/tie")
    for name in ("a", "b"):
        tie = m.TiePoint(point=name)
        tie.images.add(strip=first.body.images[0].strip, ccd="none", line=5.0, sample=5.0)
        node.step(replace(first, body=tie))
    node.step(first)
    assert not node.refusals and not node.refused_later
    poses = (x for x in messages if x.topic == "trajectory/filtered")
    for pose in poses:
        node.step(pose)
        if node.refused_later:
            break
    assert node.refused_later == {"observation/tie": 2} and not node.refusals
    node.step(replace(first, body=tie))  # this one does not wait
    assert node.refused_later == {"observation/tie": 2} and node.refusals == 1
