"""Flights whose a-priori sigmas are wrong: the window finds out before it throws looks or control out."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest

from triline.solver.adjustment.reliability import HEAVY_TAILS
from triline.solver.camera.self_calibration import focal_length, left_by_calibration
from triline.solver.models.base import ATTITUDE_WANDER, CONSTANT, OFFSET, POSITION_WANDER, SHIFT, WANDERS, error_groups
from triline.solver.models.slow_errors import SlowErrors
from triline.solver.models.wander import GLOBALS
from triline.solver.simulation.error_models import ErrorModel
from triline.solver.simulation.flight import FlightPlan
from triline.solver.simulation.misspecified_study import OBSERVED, ROWS, SETTINGS
from triline.solver.simulation.misstated import Sine, World
from triline.solver.simulation.scenario import ObservationPlan, simulate
from triline.solver.simulation.window_study import (
    adjust_online,
    direct_points,
    navigate,
    orientation_errors,
    point_errors,
)
from triline.solver.window.quality.light import BADLY_CALIBRATED
from triline.solver.window.results import TAKEN_BACK, WindowOptions
from triline.solver.window.screening.disagreement import ENOUGH, RIGHT, Disagreement, variance_of_most
from triline.solver.window.screening.entry import JudgedLooks
from triline.solver.window.screening.kept_wanders import KeptWanders
from triline.solver.window.screening.likelihood import (
    FROM_STRIP_TO_STRIP_LOG,
    NOTHING,
    USUAL_LOG,
    Beforehand,
    Likelihood,
    LookNoise,
    likely,
)
from triline.solver.window.screening.look_noise import MAY_VIBRATE
from triline.solver.window.screening.sigma_check import MEMORY_S, SigmaCheck
from triline.solver.window.state.network import LiveNetwork
from triline.solver.window.state.sigma_factors import changed
from triline.solver.window.state.strip import WindowStrip
from triline.solver.window.state.unknowns import WindowState

SLOW = SlowErrors((0.3, 0.3, 0.5), (1e-4, 1e-4, 2e-4), (5e-5,) * 3, (0.1, 0.1, 0.2), (4e-5,) * 3, 30.0)
OPTIONS = WindowOptions(grid_hz=4.0)
#: As those of the study, with half as many measurements of the attitude.
RTK, DEF = (replace(SETTINGS[name], attitude_rate_hz=100.0) for name in ("rtk", "def"))
PLAN = FlightPlan(strip_s=40.0, lead_in_s=3.0, lead_out_s=2.0)


@cache
def measured(row: str, strip_s: float = 40.0, seed: int = 4):
    """A flight with carrier-phase GNSS in a world of the study, and its poses as navigated."""
    plan, sensors = (FlightPlan(), SETTINGS["rtk"]) if row == "sine-fast" else (PLAN, RTK)
    simulation = simulate(replace(plan, strip_s=strip_s), seed, sensors, OBSERVED, world=ROWS[row].world)
    return simulation, navigate(simulation)


@cache
def flown(row: str, strip_s: float = 40.0, seed: int = 4):
    """Such a flight through the window."""
    simulation, poses = measured(row, strip_s, seed)
    return simulation, adjust_online(simulation, poses, OPTIONS, live=False, update_s=1.0)


def rejected(online) -> int:
    """Looks that are left out in the end."""
    out = set()
    for r in online.refused:
        if r.reason in ("snooping", TAKEN_BACK) and not r.coordinate:
            (out.discard if r.reason == TAKEN_BACK else out.add)((r.point, r.look))
    return len(out)


def refused_control(online) -> set:
    out = set()
    for r in online.refused:
        if r.coordinate:
            (out.discard if r.reason == TAKEN_BACK else out.add)((r.point, r.coordinate))
    return out


def rmse(row: str) -> float:
    simulation, online = flown(row)
    return float(np.sqrt((point_errors(simulation, online.whole_points).error ** 2).sum(axis=1).mean()))


def test_a_flight_as_stated_keeps_its_sigmas():
    _, online = flown("stated")
    assert not [event for event in online.events if event.startswith("sigmas:")]
    assert online.window.network.sigmas.image == 1.0 and (online.window.network.sigmas.apriori == 1.0).all()


@pytest.mark.parametrize("row", ["sine-slow", "boresight", "gnss-datum"])
def test_what_nobody_stated_is_found_and_costs_little(row):
    """Before, the first lost a third of its looks and the others all control; all of them were 0.6 to 1.5 m off."""
    simulation, online = flown(row)
    assert any(event.startswith("sigmas: ") for event in online.events)
    assert rejected(online) < 0.02 * len(simulation.images) and not refused_control(online)
    assert rmse(row) < 1.8 * rmse("stated")
    assert 0.5 < point_errors(simulation, online.whole_points).nees.mean() < 1.8
    assert 0.3 < orientation_errors(simulation, online.whole).nees.mean() < 2.5


def test_a_datum_difference_is_told_with_its_sigma():
    _, online = flown("gnss-datum")
    lines = [event for event in online.events if "GNSS differ by" in event]
    assert lines and all("+-" in line and "is published in the datum of control" in line for line in lines)
    assert not [name for r in online.reports for name in r.quality.names]  # no healthy source is accused
    assert all(r.quality.light != "good" for r in online.reports[-20:])


@cache
def with_focal_length(row: str, seed: int = 4):
    """The same with the focal length as an unknown, as the adjuster has it by default."""
    simulation, poses = measured(row, seed=seed)
    parameters = focal_length(simulation.flight.camera)
    online = adjust_online(simulation, poses, OPTIONS, parameters, live=False, update_s=1.0)
    return simulation, online


def height_nees(simulation, online) -> float:
    """Mean normalised square of the error of the camera's height."""
    errors = orientation_errors(simulation, online.whole)
    return float(np.mean(errors.error[:, 2] ** 2 / errors.covariance[:, 2, 2]))


def test_the_height_of_the_camera_is_as_sure_as_the_focal_length():
    """20 um are 0.48 m at 1500 m: without the unknown the camera was that far off, with a sigma of 5 cm."""
    assert height_nees(*flown("focal-length")) > 8.0
    simulation, online = with_focal_length("focal-length")
    assert height_nees(simulation, online) < 4.0
    points, without = (point_errors(*flight) for flight in ((simulation, online.whole_points), (
        flown("focal-length")[0], flown("focal-length")[1].whole_points)))  # fmt: skip
    size, before = (float(np.sqrt((e.error**2).sum(axis=1).mean())) for e in (points, without))
    assert size < 1.05 * before  # points are right with either


def test_an_offset_is_questioned_that_a_focal_length_would_hide():
    """0.2 m of lever arm in Z are 8 um of focal length, which nobody would be surprised at."""
    _, online = with_focal_length("lever-arm")
    assert online.window.network.sigmas.apriori[OFFSET] > 1.0
    _, right = with_focal_length("stated")
    assert (right.window.network.sigmas.apriori == 1.0).all()
    assert len(right.window.network.like_an_offset) == 1


def test_heavy_tails_are_told_and_cost_no_control():
    """Before, coordinates of control were refused for outlying looks at them, and the light was green."""
    simulation, online = flown("noise-t3", 60.0, 1)
    share = online.window.network.tails.share(online.window.network.batches)
    assert 0.03 < share < 0.1
    assert not refused_control(online) and "fail narrowly" in online.reports[-1].quality.reason
    assert np.sqrt((point_errors(simulation, online.whole_points).error ** 2).sum(axis=1).mean()) < 0.35


def test_mismatches_are_no_heavy_tails():
    plan = replace(OBSERVED, outlier_share=0.08)
    simulation = simulate(PLAN, 4, RTK, plan)
    online = adjust_online(simulation, navigate(simulation), OPTIONS, live=False, update_s=1.0)
    assert rejected(online) > 0.05 * len(simulation.images)
    assert online.window.network.tails.share(online.window.network.batches) < HEAVY_TAILS
    assert "of the looks contradict the others and are left out" in online.reports[-1].quality.reason


def test_vibration_is_not_taken_for_a_wander():
    """Before, the wander was stated up to 60 times as large, and a tenth of the looks rejected."""
    simulation, online = flown("sine-fast")
    assert any("vibrates" in event for event in online.events)
    assert rejected(online) < 0.02 * len(simulation.images)
    points = point_errors(simulation, online.whole_points)
    direct = float(np.sqrt((direct_points(*measured("sine-fast")).error ** 2).sum(axis=1).mean()))
    assert 0.3 * direct < rmse("sine-fast") < 1.1 * direct
    assert 0.6 < points.nees.mean() < 1.6
    assert 0.5 < orientation_errors(simulation, online.whole).nees.mean() < 2.0
    assert max(r.quality.trajectory[2] for r in online.reports[len(online.reports) // 2 :]) < 3.0


def test_no_source_is_named_while_sigmas_are_questioned():
    """A vibration of 13 pixels was named as tie points that drift while its noise was being found."""
    world = World(sines=(Sine((0.03, 0.03, 0.03), 3.0),))
    simulation = simulate(replace(PLAN, strip_s=15.0), 5, SETTINGS["rtk"], OBSERVED, world=world)
    online = adjust_online(simulation, navigate(simulation), OPTIONS, live=False, update_s=0.5)
    assert any("which are being questioned" in r.quality.reason for r in online.reports)
    assert not any(r.quality.sources for r in online.reports)


def vibrating(size_deg: float, seed: int, *, strip_s: float = 30.0, part_s: tuple[float, ...] = ()):
    """A strip with a vibration that nobody stated, all along or in a part of it, through the window."""
    world = World(sines=(Sine((size_deg,) * 3, 3.0, *part_s),))
    simulation = simulate(replace(PLAN, strip_s=strip_s), seed, RTK, OBSERVED, world=world)
    return simulation, adjust_online(simulation, navigate(simulation), OPTIONS, live=False, update_s=1.0)


def attitude_nees(simulation, online) -> np.ndarray:
    """Of the whole strip, of each third of it."""
    errors = orientation_errors(simulation, online.whole)
    squares = errors.error[:, 3:] ** 2 / np.diagonal(errors.covariance, axis1=1, axis2=2)[:, 3:]
    return np.array([part.mean() for part in np.array_split(squares[np.argsort(errors.time_s)], 3)])


def test_a_vibration_that_is_found_late_was_there_from_the_start():
    """It was in the sigmas of the last two thirds alone: NEES of the attitude was 5.8, 0.6 and 0.6."""
    simulation, online = vibrating(0.03, 3)
    nees = attitude_nees(simulation, online)
    assert ((nees > 0.4) & (nees < 1.6)).all(), nees


def test_a_vibration_that_calms_down_stays_in_the_sigmas_of_where_it_was():
    """Noise of the looks is one for all of the window: it faded away before these seconds left it, and NEES of the
    attitude was 2.3, 8.3 and 0.3 under a green light."""
    simulation, online = vibrating(0.02, 1, strip_s=40.0, part_s=(10.0, 25.0))
    nees = attitude_nees(simulation, online)
    assert ((nees[:2] > 0.3) & (nees[:2] < 1.6)).all() and nees[2] < 1.6, nees


def test_noise_that_may_be_a_vibration_is_in_the_sigmas_of_the_attitude():
    """Looks are ten times as noisy as stated, and too few to tell why: NEES of the attitude was 10, 10 and 9."""
    simulation, online = vibrating(0.02, 3)
    assert not any("the attitude vibrates by" in event and "image" not in event for event in online.events)
    assert any(" times as large as stated, or the attitude vibrates by 1" in event for event in online.events)
    nees = attitude_nees(simulation, online)
    assert ((nees > 0.3) & (nees < 1.6)).all(), nees


def test_noise_of_the_image_is_no_vibration_of_the_attitude():
    simulation = simulate(replace(PLAN, strip_s=30.0), 3, RTK, OBSERVED, world=World(noise_factor=5.0))
    online = adjust_online(simulation, navigate(simulation), OPTIONS, live=False, update_s=1.0)
    network = online.window.network
    assert network.sigmas.image > MAY_VIBRATE and network.pose_noise.possible_vibration == 0.0
    nees = attitude_nees(simulation, online)
    assert ((nees > 0.3) & (nees < 2.5)).all(), nees


@pytest.mark.study
def test_vibration_is_told_from_image_noise():
    _, vibrating = flown("sine-fast")
    _, noisy = flown("noise")
    assert any("vibrates" in event for event in vibrating.events)
    assert not any("vibrates" in event for event in noisy.events)
    assert noisy.window.network.sigmas.image == pytest.approx(2.0, rel=0.25)


# ---- the mechanism


def strip_in(state: WindowState, factor=None) -> WindowStrip:
    strip = WindowStrip("S1", 0.0, 100.0, 2000, SLOW, OPTIONS, state, factor=factor)
    strip.activate(9.0, state)
    return strip


@pytest.mark.parametrize("limit_s", [-np.inf, -5.0, 3.0])
def test_borders_that_a_new_wander_no_longer_uses_make_nothing_final(limit_s):
    """Before the first look nothing may leave (limit -inf): the strip was taken for over, or its begin for lost."""
    learning = replace(SLOW, wander=(4e-3, 4e-3, 2e-2), attitude_time_s=6.0)
    state = WindowState()
    strip = WindowStrip("S1", 0.0, 100.0, 0, learning, OPTIONS, state)
    strip.activate(9.0, state)
    strip.restate(2.0, replace(learning, wander=(4e-2, 4e-2, 2e-1)))
    strip.activate(11.0, state)
    strip.restate(3.0, learning)
    numbers, final_to_s = strip.leaving(limit_s, state)
    assert len(numbers) and not strip.ended  # there are such borders
    assert 0.0 <= final_to_s <= max(limit_s, 0.0)


def seen(strip: WindowStrip, state: WindowState) -> None:
    """Observations of the corrections at some times."""
    rng = np.random.default_rng(3)
    for t in np.arange(0.5, 9.0, 0.7):
        d = strip.design([t])
        for c in range(6):
            columns, scale = d.columns[0][None, :, c], [0.1, 3e-5][c > 2]
            state.observe(columns, d.coefficients[0][None], rng.normal(0, scale, 1), np.full(1, scale))


@pytest.mark.parametrize("when", ["before", "after"])
def test_sigmas_stated_anew_are_those_stated_from_the_start(when):
    factor = np.array([2.0, 3.0, 1.5, 5.0])
    from_start, anew = WindowState(), WindowState()
    expected, strip = strip_in(from_start, factor), strip_in(anew)
    if when == "before":
        strip.restate_sigmas(factor, anew)
    for s, state in ((expected, from_start), (strip, anew)):
        seen(s, state)
    if when == "after":
        strip.restate_sigmas(factor, anew)
    for s, state in ((expected, from_start), (strip, anew)):
        s.activate(15.0, state)  # what comes later has them, too
        state.solve()
    assert anew.theta == pytest.approx(from_start.theta, rel=1e-7, abs=1e-12)
    got, want = (np.diagonal(s.covariance(s.numbers)) for s in (anew, from_start))
    assert got == pytest.approx(want, rel=1e-7)
    assert anew.cost() == pytest.approx(from_start.cost(), rel=1e-9)


def test_a_wander_that_is_present_keeps_its_factor_when_that_falls():
    """What comes later wanders as stated; offset, shift and drift are the same errors and are stated anew."""
    one, factor = np.ones(4), np.array([2.0, 3.0, 1.5, 5.0])
    expected_state, state = WindowState(), WindowState()
    expected, strip = strip_in(expected_state, np.where(np.arange(4) < POSITION_WANDER, one, factor)), strip_in(state)
    expected.factor = one
    strip.restate_sigmas(factor, state)
    for s, of in ((expected, expected_state), (strip, state)):
        seen(s, of)
    strip.restate_sigmas(one, state, kept=(True, True))
    for s, of in ((expected, expected_state), (strip, state)):
        s.activate(15.0, of)
        of.solve()
    assert state.theta == pytest.approx(expected_state.theta, rel=1e-7, abs=1e-12)
    got, want = (np.diagonal(of.covariance(of.numbers)) for of in (state, expected_state))
    assert got == pytest.approx(want, rel=1e-7)


@pytest.mark.parametrize(("image", "left"), [(1.0, 5.0), (2.0, 1.0)])
def test_a_wander_falls_where_noise_of_looks_was_taken_for_it(camera_network, monkeypatch, image, left):
    state, check = camera_network.state, SigmaCheck(camera_network, Disagreement(camera_network.sigmas))
    strip = strip_in(state)
    stated = strip.apriori()[3]
    camera_network.strips["S1"], camera_network.sigmas.image = strip, image
    monkeypatch.setattr(camera_network, "batches", [SimpleNamespace(judged=None)])
    for factor in (5.0, 1.0):
        monkeypatch.setattr(check, "_slow_errors", lambda *_, f=factor: (np.full(4, f), np.inf, False))
        check.look(9.0, due=True)
        strip.final_to_s = 9.0  # what asked for the larger one has left
    assert strip.apriori()[3] == pytest.approx(np.where(np.arange(len(stated)) < GLOBALS, 1.0, left) * stated)


def kept(wanders: KeptWanders, *factors: list[float], equations=30, final_to_s=0.0):
    """What is said of factors of the wanders of position and attitude, one after the other."""
    return [wanders.keeps(np.array(f), np.full(2, equations), final_to_s) for f in factors]


def test_a_wander_falls_where_the_other_one_was_meant():
    """A step of the GNSS stays large; what the position was blamed for and the attitude did does not."""
    step, swing = KeptWanders(), KeptWanders()
    assert kept(step, [3.0, 1.0], [4.0, 1.5]) + kept(step, [1.0, 1.2], final_to_s=9.0) == [(True, True)] * 3
    assert kept(swing, [4.0, 7.0]) + kept(swing, [3.0, 12.0], final_to_s=9.0) == [(True, True)] * 2
    # it has fallen, and keeps that
    assert kept(swing, [2.0, 26.0], [1.5, 26.0], final_to_s=9.0) == [(False, True), (True, True)]


@pytest.mark.parametrize(
    ("factor", "equations", "final_to_s", "keeps"),
    [
        (2.0, 32, 7.0, False),  # the same data and more ask for less
        (2.8, 64, 7.0, True),  # a step: its square is spread over twice as many equations
        (2.0, 32, 8.0, True),  # what asked for it may have left
    ],
)
def test_a_wander_that_the_same_data_no_longer_ask_for_falls(factor, equations, final_to_s, keeps):
    """Position and attitude are both blamed at first, until more data tell which of them it was."""
    wanders = KeptWanders()
    assert kept(wanders, [4.0, 9.0], final_to_s=7.0) == [(True, True)]
    assert kept(wanders, [factor, 9.0], equations=equations, final_to_s=final_to_s) == [(keeps, True)]


@pytest.mark.parametrize("spoilt", [0.0, 0.36])
@pytest.mark.parametrize("sigma", [1.0, 4.0])
def test_the_variance_of_two_looks_is_that_of_the_good_ones(sigma, spoilt):
    """Every fifth look a gross error: every third point of two looks has one."""
    rng, found = np.random.default_rng(3), []
    for _ in range(300):
        value = sigma * rng.standard_normal(30)
        gross = rng.random(30) < spoilt
        value[gross] += rng.choice([-1.0, 1.0], gross.sum()) * rng.uniform(8.0, 60.0, gross.sum()) * sigma
        found.append(variance_of_most(value**2) / sigma**2)
    assert 0.8 < np.median(found) < 1.15
    assert np.percentile(found, 2) > 0.3 and np.percentile(found, 98) < 2.4


@pytest.mark.parametrize("seed", [pytest.param(2, marks=pytest.mark.study), 7])
def test_gross_errors_of_a_strip_that_begins_are_not_taken_for_sigmas(seed):
    """Its points have two looks at first, of which none can be spared. Sigmas of the image became twenty times as
    large, tests of single looks as much wider, and the orientation was twice as bad to the end of the strip."""
    plan = ObservationPlan(tie_points_per_s=8.0, check=10, outlier_share=0.2)
    simulation = simulate(replace(PLAN, strip_s=20.0), seed, ErrorModel(attitude_rate_hz=100.0), plan)
    poses = navigate(simulation)
    clean = replace(simulation, images=simulation.images.select(~simulation.images.outlier))
    with_errors, without = (adjust_online(s, poses, OPTIONS, live=False, update_s=1.0) for s in (simulation, clean))
    assert with_errors.window.network.sigmas.image == 1.0
    worse, rms = (np.linalg.norm(orientation_errors(simulation, of.whole).rmse[:3]) for of in (with_errors, without))
    assert worse < 1.15 * rms


def test_the_likelihood_of_a_factor_is_that_of_one_for_all_that_is_present():
    """What is in force now, and for which part of the wander, is no matter."""
    as_stated, mixed = WindowState(), WindowState()
    strips = strip_in(as_stated), strip_in(mixed)
    for strip, state in zip(strips, (as_stated, mixed), strict=True):
        seen(strip, state)
    strips[1].restate_sigmas(np.array([2.0, 3.0, 4.0, 5.0]), mixed)
    strips[1].restate_sigmas(np.ones(4), mixed, kept=(True, True))
    for strip, state in zip(strips, (as_stated, mixed), strict=True):
        strip.activate(15.0, state)
        state.solve()
    assert np.linalg.norm(mixed.theta - as_stated.theta) > 1e-6
    expected, found = (
        likely(Likelihood(s, of, WANDERS), (1.0, 1.0)) for s, of in zip(strips, (as_stated, mixed), strict=True)
    )
    assert found == pytest.approx(expected, rel=1e-6)


def over_all(state, numbers, as_stated, in_force, rows):
    """Information of a-priori equations about all unknowns of the state."""
    place, n = state.places(numbers), len(state)
    spread = np.zeros((2, n, n))
    spread[:, place[:, None], place] = as_stated, in_force
    return *spread, rows


@pytest.mark.parametrize("pair", [(OFFSET, SHIFT), WANDERS])
def test_the_cost_of_factors_is_that_of_the_whole_system(pair):
    """Elimination in parts beside the formula, with all unknowns at once."""
    state = WindowState()
    strip = strip_in(state)
    seen(strip, state)
    size = np.sqrt(np.diagonal(state.normal()[0]))
    J = 0.1 * size * np.random.default_rng(3).standard_normal((30, len(size)))
    state.observe(np.tile(state.numbers, (30, 1)), J, np.ones(30), np.ones(30))
    state.solve()
    N, rhs = state.normal()
    noise = LookNoise(0.1, 1e-4, 0.3, 30, 40.0, J.T @ J, J.T @ np.ones(30))
    (A, A_now, a), (B, B_now, b) = (over_all(state, *strip.apriori_information(g, state)) for g in pair)
    cost, expected = Likelihood(strip, state, pair), []
    cost.noise = noise
    choices = [(1.0, 1.0, 1.0), (3.5, 1.0, 1.0), (1.0, 9.0, 1.45), (60.0, 2.3, 2.1)]
    for f, g, h in choices:
        less = 1.0 - 1.0 / h**2
        matrix = N - A_now - B_now + A / f**2 + B / g**2 - less * noise.matrix
        n = rhs - less * noise.rhs
        value = np.linalg.slogdet(matrix)[1] + 2.0 * (a * np.log(f) + b * np.log(g)) - n @ np.linalg.solve(matrix, n)
        value += 2.0 * noise.rows * np.log(h) - less * noise.square
        expected.append(value + np.sum(np.square(np.log([f, g, h]))) / USUAL_LOG**2)
    assert [cost.of(*choice) for choice in choices] == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("times", [3.0, 15.0])
def test_noise_of_looks_is_no_wander_however_large_it_is(times):
    """Of a vibration of 0.03 deg, 13 pixels. The noise was 5 times as stated at most, and the rest of it a wander."""
    state, rng = WindowState(), np.random.default_rng(3)
    strip = strip_in(state)
    size = np.sqrt(np.diagonal(state.normal()[0]))
    J, y = 0.1 * size * rng.standard_normal((120, len(size))), times * rng.standard_normal(120)
    state.observe(np.tile(state.numbers, (120, 1)), J, y, np.ones(120))
    state.solve()
    cost = Likelihood(strip, state, WANDERS)
    cost.noise = LookNoise(0.1, 1e-4, 0.3, 120, float(y @ y), J.T @ J, J.T @ y)
    found = likely(cost, (1.0, 1.0))
    assert found.noise == pytest.approx(times, rel=0.25)
    assert max(found.position, found.attitude) < 4.0
    cost = Likelihood(strip, state, WANDERS)  # where the noise is taken as stated
    assert max(likely(cost, (1.0, 1.0))[:2]) > times


def test_costs_hold_while_nothing_changes_but_their_factors(camera_network):
    state, check = camera_network.state, SigmaCheck(camera_network, Disagreement(camera_network.sigmas))
    strip = camera_network.strips["S1"] = strip_in(state)
    seen(strip, state)
    cost = check._likelihood(strip, WANDERS)
    assert check._likelihood(strip, WANDERS) is cost
    choices = [(1.0, 1.0, 1.0), (3.5, 9.0, 1.0)]
    before = [cost.of(*choice) for choice in choices]
    check._restate(strip, np.array([1.0, 1.0, 2.0, 5.0]), np.inf)
    assert check._likelihood(strip, WANDERS) is cost
    assert [Likelihood(strip, state, WANDERS).of(*choice) for choice in choices] == pytest.approx(before, rel=1e-6)
    check._restate(strip, np.array([2.0, 1.0, 2.0, 5.0]), np.inf)  # those of another pair
    assert check._likelihood(strip, WANDERS) is not cost
    cost = check._likelihood(strip, WANDERS)
    check._restate(strip, np.array([2.0, 1.0, 2.0, 1.5]), 6.0)  # another correlation time
    assert check._likelihood(strip, WANDERS).times_s[0] == 6.0 != cost.times_s[0]
    cost = check._likelihood(strip, WANDERS)
    seen(strip, state)  # another look
    assert check._likelihood(strip, WANDERS) is not cost


def test_residuals_and_redundancies_of_what_was_known_beforehand():
    """The redundancies are those of the definition, and no group has more than it has equations."""
    state = WindowState()
    strip = strip_in(state)
    seen(strip, state)
    state.solve()
    group, square, redundancy = strip.apriori_fit(state, -np.inf)
    total = np.trace(np.eye(len(state)) - state.covariance(state.numbers) @ sum(
        over_all(state, *strip.apriori_information(g, state))[0] for g in range(4)))  # fmt: skip
    assert len(state) - total == pytest.approx(len(group) - redundancy.sum(), abs=1e-6)
    assert (square >= 0).all() and (np.bincount(group, redundancy) <= np.bincount(group) + 1e-9).all()


@pytest.mark.parametrize("factor", [1.3, 3.0])
def test_a_strip_that_begins_keeps_what_earlier_ones_have_shown(camera_network, factor):
    """Its first looks say little of its sigmas, and where data cannot tell all factors of the bank are averaged."""
    state, check = camera_network.state, SigmaCheck(camera_network, Disagreement(camera_network.sigmas))
    strip = camera_network.strips["S2"] = strip_in(state)
    camera_network.sigmas.apriori[:] = factor
    assert min(likely(Likelihood(strip, state, WANDERS), (factor, factor))[:2]) > 4.0
    check._remember(strip, strip.first_line_time_s + 1.0)
    for pair in (WANDERS, CONSTANT):
        kept = likely(check._likelihood(strip, pair), (factor, factor))[:2]
        assert kept == pytest.approx((factor, factor), rel=0.15)
    check._remember(strip, strip.first_line_time_s + MEMORY_S + 1.0)  # by now it has looks of its own
    seen(strip, state)
    assert check._likelihood(strip, WANDERS).beforehand == NOTHING != check._likelihood(strip, CONSTANT).beforehand


def test_what_is_as_stated_is_not_kept_from_strip_to_strip():
    assert Beforehand.of_earlier_strips((1.0, 1.0)) == NOTHING
    mixed = Beforehand.of_earlier_strips((1.0, 3.0))
    assert mixed.sigma[0] == USUAL_LOG and mixed.sigma[1] == FROM_STRIP_TO_STRIP_LOG
    assert np.exp(mixed.mean[1] + mixed.sigma[1] ** 2) == pytest.approx(3.0)  # root of the mean square


def test_a_factor_of_next_to_nothing_is_none():
    assert changed(1.3, 1.1 / 1.3) == 1.0
    assert changed(1.3, 1.2 / 1.3) == 1.3 and changed(1.3, 1.5) == pytest.approx(1.95)


def test_groups_go_by_the_words_of_the_labels():
    labels = ("X offset of strip shift", "kappa shift of strip S1", "phi drift of strip S1")
    wander = ("Y wander value at border 3 of strip S1", "wander of omega over segment 2 of strip S1")
    assert error_groups((*labels, *wander)).tolist() == [OFFSET, SHIFT, SHIFT, POSITION_WANDER, ATTITUDE_WANDER]


def test_looks_that_disagree_make_tests_wider(camera_network):
    rng = np.random.default_rng(1)
    newest = Disagreement(camera_network.sigmas)
    good = RIGHT * rng.chisquare(1, 100)
    newest.entered((s, 1, True) for s in good)
    assert camera_network.sigmas.disagreement == 1.0
    newest.entered((9.0 * s, 1, True) for s in good)
    assert 2.2 < camera_network.sigmas.disagreement < 4.0


def test_points_of_two_looks_tell_until_there_are_others(camera_network):
    """Of them no look can be spared: they disagree three times as much where nothing is wrong."""
    rng = np.random.default_rng(1)
    newest = Disagreement(camera_network.sigmas)
    of_two = rng.chisquare(1, 40)
    newest.entered((s, 1, False) for s in of_two)
    assert camera_network.sigmas.disagreement == 1.0
    newest.entered((9.0 * s, 1, False) for s in rng.chisquare(1, 60))
    assert 2.2 < camera_network.sigmas.disagreement < 4.0
    newest.entered((RIGHT * s, 1, True) for s in rng.chisquare(1, ENOUGH))
    assert camera_network.sigmas.disagreement == 1.0


def test_all_points_that_come_at_once_tell(camera_network):
    """The last ones of a long update have the error of one orientation in common."""
    ratios = RIGHT * np.random.default_rng(1).chisquare(1, 300)
    ratios[-80:] *= 20.0
    newest = Disagreement(camera_network.sigmas)
    newest.entered((s, 1, True) for s in ratios)
    assert camera_network.sigmas.disagreement == 1.0
    newest.entered((s, 1, True) for s in ratios[-40:])  # nothing older is left of them than of any others
    assert camera_network.sigmas.disagreement > 2.0


def judged(wrong: float, second: int = 0, lines: tuple[int, ...] = (0, 1, 2)) -> JudgedLooks:
    """Ten looks a second on each of three CCD lines, some of them wrong: a share anywhere, and eight of ten in one
    second on some of the lines."""
    rng = np.random.default_rng(2)
    time_s, ccd = np.repeat(np.arange(10.05, 30.0, 0.1), 3), np.tile([0, 1, 2], 200)
    spoilt = (np.floor(time_s) == second) & np.isin(ccd, lines)
    out = rng.uniform(size=600) < np.where(spoilt, 0.8, wrong)
    return JudgedLooks(time_s, ccd, np.where(out, 900.0, 1.0) * rng.chisquare(2, 600), out)


def test_mismatches_that_come_singly_do_not_make_tests_wider(camera_network):
    newest = Disagreement(camera_network.sigmas)
    newest.entered((), [judged(0.15)])
    assert camera_network.sigmas.disagreement == 1.0
    newest.entered((), [judged(0.0, 20, (1,))])  # of one CCD line: it is that line
    assert camera_network.sigmas.disagreement == 1.0


def test_a_second_most_of_whose_looks_are_wrong_makes_tests_wider(camera_network):
    newest = Disagreement(camera_network.sigmas)
    looks = judged(0.05, 20)
    for part in np.array_split(np.argsort(looks.ccd, kind="stable"), 7):  # as the points become complete
        newest.entered((), [JudgedLooks(*(array[part] for array in looks))])
    assert camera_network.sigmas.disagreement == pytest.approx(30.0, rel=0.3)
    later = JudgedLooks(np.array([46.5]), np.array([0]), np.ones(1), np.zeros(1, dtype=bool))
    newest.entered((), [later])
    assert camera_network.sigmas.disagreement == 1.0


def test_an_attitude_that_jumps_for_seconds_is_questioned_and_its_looks_stay():
    """By 0.02 deg for 5 s: 18 % of the looks were taken for mismatches, and the sigmas were too small by half."""
    simulation = simulate(replace(PLAN, strip_s=30.0), 4, RTK, OBSERVED)
    middle = np.abs(simulation.attitude_time_s - simulation.flight.strip_times_s[0].mean()) < 2.5
    jumped = simulation.attitude_rpy + np.where(middle[:, None], np.radians(0.02), 0.0)
    simulation = replace(simulation, attitude_rpy=jumped)
    online = adjust_online(simulation, navigate(simulation), OPTIONS, live=False, update_s=1.0)
    assert rejected(online) < 0.02 * len(simulation.images)
    assert orientation_errors(simulation, online.whole).nees.mean() < 1.6
    assert point_errors(simulation, online.whole_points).nees.mean() < 1.6


def test_a_large_wander_is_taken_for_the_camera_no_longer_than_it_could_be():
    """Six times as large: in the first ten seconds the camera explained it as well, and stayed blamed."""
    simulation = simulate(replace(PLAN, strip_s=25.0), 1, RTK, OBSERVED, world=World(wander_factor=6.0))
    online = adjust_online(
        simulation, navigate(simulation), OPTIONS, left_by_calibration(PLAN.camera), live=False, update_s=1.0
    )
    calibration = online.window.network.calibration
    told = [float(e.split()[6]) for e in online.events if e.startswith("sigmas: calibration of the camera is")]
    assert max(told) > BADLY_CALIBRATED and calibration.factor < 4.0
    assert told[-1] == pytest.approx(calibration.factor, rel=0.05)
    larger = calibration.sigma / left_by_calibration(PLAN.camera).apriori_sigma
    assert larger[0] == 1.0 and larger[1:] == pytest.approx(calibration.factor)  # the focal length is not questioned


def test_a_few_points_say_nothing(camera_network):
    newest = Disagreement(camera_network.sigmas)
    newest.entered([(100.0, 3, True)] * (ENOUGH - 1))
    assert camera_network.sigmas.disagreement == 1.0


@pytest.fixture
def camera_network() -> LiveNetwork:
    from triline.solver.camera.sensors import preset

    return LiveNetwork(preset("ads40"))


def test_a_wander_of_the_attitude_that_is_faster_is_stated_apart():
    """GNSS wanders over a minute, attitude over six seconds; one time for both has to be the shorter one."""
    true = replace(DEF, wander_time_s=60.0, attitude_wander_time_s=6.0)
    alike = replace(true, wander_time_s=6.0, attitude_wander_time_s=0.0)
    flight = simulate(replace(PLAN, strip_s=18.0), 1, true, OBSERVED)
    found = []
    for told in (true, alike):
        simulation = replace(flight, errors=told)
        online = adjust_online(simulation, navigate(simulation), OPTIONS, live=False, update_s=1.0)
        points = point_errors(simulation, online.whole_points)
        found.append((np.mean(np.sum(points.error**2, axis=1)), points.nees.mean()))
    (apart, nees), (together, _) = found
    assert apart < 0.7 * together and 0.6 < nees < 1.6
