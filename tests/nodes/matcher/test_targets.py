"""Signalised targets: found and centred in rendered lines, doubtful ones held, and what a surveyor says of them."""

import numpy as np
import pytest

from triline.nodes.adjuster.adjuster import Adjuster
from triline.nodes.matcher.strip_clock import StripClock
from triline.nodes.matcher.targets import DoubtfulTargets
from triline.nodes.node import Message
from triline.nodes.simulator.flight_settings import simulated_flight
from triline.nodes.simulator.simulator import Simulator
from triline.schemas import messages as m
from triline.solver.geometry.rotation import matrix_from_angles, quaternion_from_matrix
from triline.solver.matching.current_orientation import CurrentOrientation
from triline.solver.matching.line_times import LineTimes
from triline.solver.matching.target_finder import Target, TargetFinder, TargetOptions
from triline.solver.matching.target_image import RING, candidates, fit, pattern
from triline.solver.models.slow_errors import SlowErrors
from triline.solver.simulation.observations import find_looks

FLIGHT = {
    "sensor": "ads40-inner", "pixels": 800, "images": True, "seconds": 16.0, "lead_in": 2.0, "height": 1690.0,
    "speed": 140.0, "relief": 50.0, "seed": 3, "check": 8,
}  # fmt: skip
BLOCK = 12
COORDINATE_SIGMA_M = 0.02
#: What is added to every sigma would hide whether the rest of it is right.
NO_FLOOR = TargetOptions(image_sigma_px=0.001)


@pytest.fixture(scope="module")
def flown():
    return simulated_flight(FLIGHT)


@pytest.fixture(scope="module")
def images(flown):
    return rendered(flown)


def rendered(flown):
    return [flown.imager.render(0, ccd, 0, flown.simulation.flight.strips[0].lines) for ccd in range(3)]


def signalised(flown):
    points = flown.simulation.points
    chosen = np.flatnonzero(points.role != "tie")
    return [str(points.id[i]) for i in chosen], points.xyz_l[chosen]


def looks_at(
    flown, images, names, places, *, seed=1, position_m=1.0, attitude_deg=0.02, options=None, lost=None, wandered=None
):
    """What a finder sees when the orientation is wrong by errors of the size that its covariance tells.

    ``wandered``: slow errors; positions then wander by three sigma in 10 s, after the one correction there is.
    """
    flight = flown.simulation.flight
    strip, camera = flight.strips[0], flight.camera
    rng = np.random.default_rng(seed)
    time_s = np.arange(0.0, flight.truth.end_s, 0.01)
    truth = flight.truth.at(time_s)
    sigma = np.concatenate([np.full(3, position_m), np.full(3, np.radians(attitude_deg))])
    off = sigma * rng.standard_normal(6)
    position = truth.position_l + off[:3]
    if wandered is not None:
        speed_m_s = 0.3 * np.sqrt(wandered.wandered(10.0)[0])
        position[:, 1] += speed_m_s * np.maximum(time_s - strip.first_line_time_s, 0.0)
    angles = truth.angles + off[3:] + np.radians(0.0005) * rng.standard_normal((len(time_s), 3))
    quaternion = quaternion_from_matrix(matrix_from_angles(*angles.T))
    orientation = CurrentOrientation()
    finder = TargetFinder(camera, orientation, options)
    if wandered is not None:
        finder.slow = wandered
        orientation.add_correction(strip.first_line_time_s, np.zeros(6), np.diag(sigma**2))
    radius = flown.imager.texture.target_radius_m
    for name, place in zip(names, places, strict=True):
        finder.set_target(Target(name, place, COORDINATE_SIGMA_M**2 * np.eye(3), radius))
    finder.begin_strip(LineTimes(strip.first_line_time_s, strip.line_rate_hz))
    out, poses = [], 0
    for first in range(0, strip.lines, BLOCK):
        end_s = float(strip.time_of(min(first + BLOCK, strip.lines) - 1))
        while poses < len(time_s) and time_s[poses] <= end_s:
            orientation.add_pose(time_s[poses], position[poses], quaternion[poses], np.diag(sigma**2))
            poses += 1
        for image, line in zip(images, camera.lines, strict=True):
            usable = None if lost is None else ~lost[line.id][first : first + BLOCK]
            finder.add_lines(line.id, first, image[first : first + BLOCK], usable)
            out += finder.measure(line.id)
    return out


def true_looks(flown, names, places):
    flight = flown.simulation.flight
    looks = find_looks(places, flight.strips, flight.camera)
    ids = [line.id for line in flight.camera.lines]
    return {
        (names[p], ids[c]): np.array([u, v])
        for p, c, u, v in zip(looks.point, looks.ccd, looks.line, looks.sample, strict=True)
    }


def errors_of(looks, true):
    """(n, 2) error of line and sample, and their sigma."""
    rows = [(*(np.array([x.line, x.sample]) - true[x.target, x.ccd]), x.sigma_line, x.sigma_sample) for x in looks]
    return np.split(np.array(rows), 2, axis=1)


# ---- one target


def test_the_centre_of_a_pattern_is_found_from_scattered_pixels():
    rng = np.random.default_rng(1)
    radius, pixel, noise, normalised = 2.1, 1.0, 8.0, []
    for _ in range(60):
        centre = rng.uniform(-0.4, 0.4, 2)
        grid = np.stack(np.meshgrid(np.arange(-9, 10.0), np.arange(-9, 10.0)), axis=-1).reshape(-1, 2)
        places = grid + rng.uniform(-0.2, 0.2, grid.shape)  # vibration
        distance = np.hypot(*(places - centre).T)
        grey = np.where(distance > RING * radius, 900.0, 300.0)
        from scipy.special import erf

        grey += (distance < RING * radius) * 2000.0 * 0.5 * (1 + erf((radius - distance) / (np.sqrt(2) * 0.55)))
        found = fit(places, grey + noise * rng.standard_normal(len(grey)), np.zeros(2), radius, pixel)
        assert found.converged and found.score > 0.99
        off = found.xy - centre
        normalised.append(off @ np.linalg.solve(found.covariance, off))
    assert 1.4 < np.mean(normalised) < 2.8  # two degrees of freedom


def test_candidates_are_where_the_pattern_is():
    rng = np.random.default_rng(2)
    values = 500 + 60 * rng.standard_normal((61, 61))
    half = 5
    for row, column in ((20, 30), (45, 12)):
        values[row - half : row + half + 1, column - half : column + half + 1] = 200 + 1500 * pattern(2.0, half)
    places, scores = candidates(values.astype(np.float32), 2.0, 3)
    assert {tuple(p) for p in places[:2]} == {(20, 30), (45, 12)}
    assert scores[1] > 0.9 > scores[2]


# ---- in a flight


@pytest.mark.parametrize("seed", [1, pytest.param(2, marks=pytest.mark.study)])
def test_targets_are_measured_within_a_tenth_of_a_pixel_and_say_how_well(flown, images, seed):
    names, places = signalised(flown)
    true = true_looks(flown, names, places)
    looks = looks_at(flown, images, names, places, seed=seed, options=NO_FLOOR)
    good = [look for look in looks if not look.reason]
    assert len(good) > 0.95 * len(true)
    off, sigma = errors_of(good, true)
    assert np.sqrt(np.mean(off**2, axis=0)).max() < 0.03
    assert np.hypot(*off.T).max() < 0.1
    assert 0.25 < np.mean((off / sigma) ** 2) < 1.3


def test_targets_are_measured_where_few_lines_come_in_a_second():
    """Below 20 lines a second, those about a target came after the time in which targets were looked for."""
    flown = simulated_flight(FLIGHT | {"height": 4000.0, "speed": 60.0, "pixels": 300, "seconds": 60.0, "check": 0})
    strip = flown.simulation.flight.strips[0]
    assert 5.0 < strip.line_rate_hz < 10.0
    names, places = signalised(flown)
    true = {look: at for look, at in true_looks(flown, names, places).items() if 50 < at[0] < strip.lines - 50}
    looks = {(x.target, x.ccd): x for x in looks_at(flown, rendered(flown), names, places) if not x.reason}
    assert len(true) > 4 and set(true) <= set(looks)
    off, _ = errors_of(looks.values(), true_looks(flown, names, places))
    assert np.hypot(*off.T).max() < 0.1


@pytest.mark.study
def test_on_an_unstabilised_mount_they_are_measured_as_well():
    flown = simulated_flight(FLIGHT | {"unstabilised": True, "seconds": 14.0, "seed": 5})
    names, places = signalised(flown)
    looks = [x for x in looks_at(flown, rendered(flown), names, places, options=NO_FLOOR) if not x.reason]
    off, sigma = errors_of(looks, true_looks(flown, names, places))
    assert len(looks) > 30 and np.hypot(*off.T).max() < 0.1
    assert 0.25 < np.mean((off / sigma) ** 2) < 1.5


@pytest.mark.study
def test_lines_that_are_lost_here_and_there_cost_few_targets(flown, images):
    names, places = signalised(flown)
    true = true_looks(flown, names, places)
    rng = np.random.default_rng(4)
    ids = [line.id for line in flown.simulation.flight.camera.lines]
    n = flown.simulation.flight.strips[0].lines
    lost = {ccd: np.convolve(rng.random(n) < 0.05 / 3, np.ones(3))[:n] > 0 for ccd in ids}
    spoilt = [
        np.where(lost[ccd][:, None], 0, image).astype(image.dtype) for ccd, image in zip(ids, images, strict=True)
    ]
    whole = [x for x in looks_at(flown, images, names, places) if not x.reason]
    looks = looks_at(flown, spoilt, names, places, lost=lost, options=NO_FLOOR)
    good = [x for x in looks if not x.reason]
    assert len(good) > 0.75 * len(whole)
    assert any(lost[x.ccd][round(x.line) - 4 : round(x.line) + 5].any() for x in good)
    error, sigma = errors_of(good, true)
    assert np.hypot(*error.T).max() < 0.1 and 0.25 < np.mean((error / sigma) ** 2) < 1.3


@pytest.mark.study
def test_nothing_is_taken_for_a_target_where_there_is_none(flown, images):
    _, places = signalised(flown)
    rng = np.random.default_rng(7)
    elsewhere = rng.uniform(places[:, :2].min(axis=0), places[:, :2].max(axis=0), (150, 2))
    away = np.abs(elsewhere[:, None] - places[None, :, :2]).max(axis=2).min(axis=1)
    elsewhere = elsewhere[away > 60.0]
    height = flown.simulation.flight.terrain.height(*elsewhere.T)
    elsewhere = np.column_stack([elsewhere, height])
    looks = looks_at(flown, images, [f"X{i}" for i in range(len(elsewhere))], elsewhere, position_m=3.0)
    assert len(looks) > 40
    assert sum(not look.reason for look in looks) < 0.01 * len(looks)


def test_targets_are_found_with_an_orientation_that_is_thirty_pixels_wrong(flown, images):
    names, places = signalised(flown)
    pixel = flown.imager.texture.detail_m
    looks = looks_at(flown, images, names, places, position_m=15 * pixel, seed=6)
    true = true_looks(flown, names, places)
    moved = np.median([np.hypot(x.line - x.expected_line, x.sample - x.expected_sample) for x in looks if x.found])
    good = [x for x in looks if not x.reason]
    assert 20 < moved < 45 and len(good) > 0.8 * len(true)  # others are doubtful: two targets in the window
    assert np.hypot(*errors_of(good, true)[0].T).max() < 0.3


def test_coordinates_that_are_two_metres_off_are_not_believed_in_silence(flown, images):
    names, places = signalised(flown)
    wrong = places.copy()
    wrong[::4, 0] += 1.4
    wrong[::4, 1] -= 1.4
    spoilt = set(names[::4])
    looks = looks_at(flown, images, names, wrong, position_m=0.2, attitude_deg=0.004)
    told = {
        (x.target in spoilt): [y.reason for y in looks if (y.target in spoilt) == (x.target in spoilt)] for x in looks
    }
    assert len(told[True]) > 8 and set(told[True]) == {"far from where it should be"}
    assert sum(reason != "" for reason in told[False]) <= 1


def test_a_finder_wants_sensible_options():
    with pytest.raises(ValueError, match="largest_reach_px"):
        TargetOptions(largest_reach_px=2.0)
    with pytest.raises(ValueError, match="scores"):
        TargetOptions(least_score=1.5)


# ---- messages


def test_targets_are_where_the_orientation_has_wandered_since_it_was_corrected(flown, images):
    """As where corrections come every 10 s, in `process` at the pace for throughput."""
    slow = SlowErrors(wander_m=(1.0, 1.0, 1.0), wander_time_s=30.0)
    small = {"position_m": 0.05, "attitude_deg": 0.0005, "wandered": slow}
    looks = [x for x in looks_at(flown, images, *signalised(flown), **small) if x.found]
    assert len(looks) > 20 and not [x for x in looks if x.reason == "far from where it should be"]


@pytest.fixture(scope="module")
def held(flown, images):
    """A desk that holds the looks at a point that lies wrong, and what it told."""
    flight = flown.simulation.flight
    names, places = signalised(flown)
    strip = m.Strip(id="S1", first_line_time_ns=10**18, line_rate_hz=flight.strips[0].line_rate_hz)

    time_s = np.arange(0.0, flight.truth.end_s, 0.01)
    truth = flight.truth.at(time_s)
    quaternion = quaternion_from_matrix(matrix_from_angles(*truth.angles.T))
    orientation, covariance = CurrentOrientation(), np.diag([0.2] * 3 + [1e-4] * 3) ** 2
    for t, p, q in zip(time_s, truth.position_l, quaternion, strict=True):
        orientation.add_pose(t, p, q, covariance)

    def desk():
        desk = DoubtfulTargets()
        desk.configure(flight.camera, orientation)
        for i, (name, place) in enumerate(zip(names, places, strict=True)):
            x, y, z = place + (np.array([3.0, 0.0, 0.0]) if i == 0 else 0.0)
            cov = (COORDINATE_SIGMA_M**2 * np.eye(3)).ravel().tolist()
            radius = flown.imager.texture.target_radius_m
            desk.ground_point(m.GroundPoint(point=name, x=x, y=y, z=z, covariance=cov, target_radius=radius))
        times = LineTimes(flight.strips[0].first_line_time_s, strip.line_rate_hz)
        desk.begin_strip(StripClock(strip, times, 10**18), orientation)
        return desk

    def fly(desk, verdict_at=None, accepted=True):
        out, words = [], []
        for first in range(0, flight.strips[0].lines, 20):
            if verdict_at is not None and first >= verdict_at:
                out += desk.verdict(m.Verdict(point=names[0], accepted=accepted, by="me"), first)
                verdict_at = None
            for image, line in zip(images, flight.camera.lines, strict=True):
                messages, told = desk.lines(line.id, first, image[first : first + 20], first)
                out += messages
                words += told
        return out, words

    return names[0], desk, fly


def states(out, name):
    bodies = [x.body for x in out if x.topic == "observation/target" and x.body.point == name]
    ties = [x.body for x in out if x.topic == "observation/tie" and x.body.point == name]
    return [m.TargetLook.State.Name(b.state) for b in bodies], ties


def test_a_doubtful_target_is_held_and_told(held):
    name, desk, fly = held
    out, words = fly(desk())
    told, ties = states(out, name)
    assert told == ["HELD"] * 3 and not ties
    assert sum(name in text and f"triline confirm {name}" in text for text in words) == 3
    others = [x for x in out if x.topic == "observation/tie"]
    assert len(others) > 30 and all(len(x.body.images) == 1 and x.body.images[0].sigma_line > 0 for x in others)


def test_a_surveyor_lets_it_out_or_stops_it(held):
    name, desk, fly = held
    middle = 500
    told, ties = states(fly(desk(), verdict_at=middle)[0], name)
    assert told == ["HELD", "CONFIRMED", "CONFIRMED", "CONFIRMED"] and len(ties) == 3
    told, ties = states(fly(desk(), verdict_at=middle, accepted=False)[0], name)
    assert told == ["HELD", "REJECTED", "REJECTED", "REJECTED"] and not ties


@pytest.mark.parametrize("accepted", [True, False])
def test_what_he_said_before_the_point_was_stated_counts(held, accepted):
    name, desk, fly = held
    late = desk()
    stated = late._points.pop(name)
    assert late.verdict(m.Verdict(point=name, accepted=accepted), 0) == []
    late._points[name] = stated
    told, ties = states(fly(late)[0], name)
    assert told == ["CONFIRMED" if accepted else "REJECTED"] * 3 and len(ties) == 3 * accepted


def test_what_is_not_signalised_is_left_alone():
    desk = DoubtfulTargets()
    desk.ground_point(m.GroundPoint(point="P", x=1.0))
    assert desk.verdict(m.Verdict(point="P", accepted=True), 0) == []
    with pytest.raises(ValueError, match="radius"):
        desk.ground_point(m.GroundPoint(point="P", target_radius=-1.0, covariance=[0.0] * 9))


@pytest.mark.study
def test_rejected_coordinates_do_not_count_until_they_are_confirmed():
    flown = simulated_flight({"seconds": 20.0, "seed": 4, "lead_in": 3.0, "attitude_rate": 50.0, "check": 0})
    messages = list(Simulator(flown.simulation).messages(10**18))
    from triline.nodes.navigator.navigator import Navigator
    from triline.nodes.step_driver import StepDriver

    def final(verdicts):
        """Final east of a control point that was given 5 m too far east."""
        nodes = [StepDriver(Navigator()), StepDriver(Adjuster(snoop=False))]
        queue, place = [], {}
        for message in messages:
            body = message.body
            if message.topic == "observation/control" and body.point == "GCP3":
                moved = m.GroundPoint()
                moved.CopyFrom(body)
                moved.x += 5.0
                message = Message(message.topic, message.stamp_ns, moved, message.source)
            queue = [message]
            if message.topic == "configuration/strip" and not body.ended:
                queue += [
                    Message("observation/verdict", message.stamp_ns, m.Verdict(point="GCP3", accepted=a))
                    for a in verdicts
                ]
            while queue:
                message = queue.pop(0)
                for node in nodes:
                    if message.topic in node.node.inputs:
                        out = node.step(message)
                        queue += [x for x in out if x.topic.startswith("trajectory/")]
                        place |= {x.body.point: x.body for x in out if x.topic == "point/object"}
        for x in nodes[1].finish():
            if x.topic == "point/object":
                place[x.body.point] = x.body
        return place["GCP3"].x

    points = flown.simulation.points
    true = float(points.xyz_l[list(points.id).index("GCP3"), 0])
    believed, rejected, confirmed = (final(v) - true for v in ([], [False], [False, True]))
    assert believed > 3.0  # without snooping, coordinates said to be good to 2 cm draw the block along
    assert abs(rejected) < 1.0
    assert confirmed == believed
