"""The correlation time of the attitude's wander: stated, or shorter where the looks say so."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from triline.solver.models.base import ATTITUDE_WANDER, WANDERS
from triline.solver.models.slow_errors import SlowErrors
from triline.solver.simulation.flight import FlightPlan
from triline.solver.simulation.misspecified_study import OBSERVED, ROWS, SETTINGS
from triline.solver.simulation.scenario import simulate
from triline.solver.simulation.window_study import adjust_online, navigate, point_errors
from triline.solver.window.quality.light import GOOD
from triline.solver.window.results import WindowOptions
from triline.solver.window.screening.likelihood import NOTHING, Likelihood, likely
from triline.solver.window.state.strip import ATTITUDE_TIMES_S, WindowStrip
from triline.solver.window.state.unknowns import WindowState

SLOW = SlowErrors((0.3, 0.3, 0.5), (1e-4, 1e-4, 2e-4), (5e-5,) * 3, (0.1, 0.1, 0.2), (4e-5,) * 3, 30.0)
OPTIONS = WindowOptions(grid_hz=4.0)
(FAST_S,) = ATTITUDE_TIMES_S
#: Borders are far apart and close together, and the last segment is another length.
LEARNT = replace(SLOW, wander_time_s=6.2, attitude_time_s=30.0)
LINES, LAST_S = 4050, 30.0


def strip_in(state: WindowState, slow: SlowErrors = SLOW, at_most_s: float = np.inf) -> WindowStrip:
    strip = WindowStrip("S1", 0.0, 100.0, LINES, slow, OPTIONS, state, attitude_at_most_s=at_most_s)
    strip.activate(LAST_S, state)
    return strip


def swung(strip: WindowStrip, state: WindowState, size: float) -> tuple[np.ndarray, np.ndarray]:
    """Attitudes that swing within 10 s, and what stays of positions, observed; the design (m, u) of all of them in
    units of their sigmas, and their values."""
    rng, rows, values = np.random.default_rng(3), [], []
    for t in np.arange(0.5, LAST_S, 0.7):
        d = strip.design([t])
        for c in range(6):
            columns, sigma = d.columns[0][None, :, c], [0.1, 3e-5][c > 2]
            value = rng.normal(0.0, sigma, 1) + (c > 2) * size * np.sin(2 * np.pi * t / 10.0)
            state.observe(columns, d.coefficients[0][None], value, np.full(1, sigma))
            row = np.zeros(len(state))
            np.add.at(row, state.places(columns[0][columns[0] >= 0]), d.coefficients[0][columns[0] >= 0])
            rows.append(row / sigma)
            values.append(value[0] / sigma)
    return np.array(rows), np.array(values)


def known_before(strip: WindowStrip, state: WindowState, factor: np.ndarray, at_most_s: float) -> np.ndarray:
    """Covariance (u, u) of the unknowns before any observation, from a strip that is begun with that."""
    own = WindowState()
    other = WindowStrip("S1", 0.0, 100.0, LINES, strip.slow, OPTIONS, own, factor=factor, attitude_at_most_s=at_most_s)
    other.activate(LAST_S, own)
    assert (own.numbers == state.numbers).all()
    N, scale = own.normal()[0], np.diagonal(own.normal()[0]) ** -0.5
    return scale[:, None] * np.linalg.inv(scale[:, None] * N * scale) * scale


@pytest.mark.parametrize("slow", [SLOW, LEARNT])
def test_the_cost_of_a_time_is_the_likelihood_of_the_observations(slow):
    """From the normal equations beside the normal distribution of the observations, which needs none."""
    state = WindowState()
    strip = strip_in(state, slow)
    A, y = swung(strip, state, 1e-4)
    state.solve()
    cost, expected, found = Likelihood(strip, state, WANDERS), [], []
    assert cost.times_s == (np.inf, FAST_S)
    for time, f, g in ((0, 1.0, 1.0), (1, 1.0, 1.0), (1, 1.0, 5.5), (0, 2.3, 15.0), (1, 9.0, 1.5)):
        S = np.eye(len(y)) + A @ known_before(strip, state, np.array([1.0, 1.0, f, g]), cost.times_s[time]) @ A.T
        expected.append(np.linalg.slogdet(S)[1] + y @ np.linalg.solve(S, y))
        found.append(cost.of(f, g, 1.0, time) - NOTHING.cost(f, g))
    assert np.subtract(found, found[0]) == pytest.approx(np.subtract(expected, expected[0]), rel=1e-5, abs=1e-3)


def test_what_is_known_of_a_time_follows_a_wander_that_is_stated_anew():
    state = WindowState()
    strip = strip_in(state)
    for _ in range(2):
        for at_most_s in (np.inf, FAST_S, np.inf):
            strip.bound_attitude_time(at_most_s, np.ones(4), state)
            of_time, _ = strip.attitude_information(at_most_s, state)
            expected = strip.apriori_information(ATTITUDE_WANDER, state)[1]
            assert of_time == pytest.approx(expected, rel=1e-9, abs=1e-12 * np.abs(expected).max())
        strip.restate(12.0, replace(SLOW, wander=(4e-4,) * 3))


@pytest.mark.parametrize("slow", [SLOW, LEARNT])
def test_a_time_stated_anew_is_that_stated_from_the_start(slow):
    expected_state, state = WindowState(), WindowState()
    expected, strip = strip_in(expected_state, slow, FAST_S), strip_in(state, slow)
    before = state.normal()[0]
    strip.restate_sigmas(np.array([1.0, 1.0, 1.0, 40.0]), state)  # of the other time: it says nothing of this one
    strip.bound_attitude_time(FAST_S, np.ones(4), state)
    strip.factor = np.ones(4)
    for s, of in ((expected, expected_state), (strip, state)):
        s.activate(38.0, of)  # what comes later has it, too
        swung(s, of, 1e-4)
        of.solve()
    scale = np.diagonal(expected_state.normal()[0]) ** 0.5
    assert state.theta * scale == pytest.approx(expected_state.theta * scale, rel=1e-6, abs=1e-9)
    for got, want in zip(strip.apriori(), expected.apriori(), strict=True):
        assert got == pytest.approx(want, rel=1e-12)
    again = WindowState()
    other = strip_in(again, slow, FAST_S)
    other.bound_attitude_time(np.inf, np.ones(4), again)
    assert again.normal()[0] == pytest.approx(before, rel=1e-9, abs=1e-9 * before.max())


@pytest.mark.parametrize(("size", "at_most_s"), [(0.0, np.inf), (1.5e-4, FAST_S)])
def test_an_attitude_that_swings_is_faster_and_one_as_stated_is_not(size, at_most_s):
    state = WindowState()
    strip = strip_in(state)
    swung(strip, state, size)
    state.solve()
    found = likely(Likelihood(strip, state, WANDERS), (1.0, 1.0))
    assert found.at_most_s == at_most_s
    assert (3.0 < found.attitude < 10.0) if size else found.attitude < 2.0
    # a time that is in force stays where the data do not tell
    now = WindowState()
    begun = strip_in(now, at_most_s=FAST_S)
    nothing = likely(Likelihood(begun, now, WANDERS, at_most_s=FAST_S), (1.0, 1.0))
    assert nothing.at_most_s == FAST_S


def test_an_attitude_that_is_learnt_is_fast_already():
    state = WindowState()
    strip = strip_in(state, replace(SLOW, attitude_time_s=6.0))
    assert strip.attitude_times_s == (np.inf,) and Likelihood(strip, state, WANDERS).times_s == (np.inf,)


@cache
def flown(row: str):
    plan = FlightPlan(strips=2, strip_s=30.0, turns=False, gap_s=8.0, lead_in_s=5.0, lead_out_s=3.0)
    simulation = simulate(plan, 4, SETTINGS["rtk"], OBSERVED, world=ROWS[row].world)
    return simulation, adjust_online(simulation, navigate(simulation), OPTIONS, live=False, update_s=1.0)


def test_a_swinging_attitude_is_told_and_later_strips_begin_with_it():
    """A swing of 0.02 deg in 10 s, where 0.002 deg in 30 s are stated: as slow as that it would have to be ninety times
    as large, and all that is slow would be as uncertain."""
    simulation, online = flown("sine-slow")
    told = [event for event in online.events if event.startswith("sigmas: the attitude wanders")]
    assert told == [f"sigmas: the attitude wanders within {FAST_S:g} s, faster than stated"]
    window = online.window
    assert window.network.sigmas.attitude_at_most_s == FAST_S
    assert online.reports[-1].quality.attitude_at_most_s == FAST_S and online.reports[-1].quality.light != GOOD
    assert 4.0 < window.network.sigmas.apriori[ATTITUDE_WANDER] < 20.0
    assert 0.5 < point_errors(simulation, online.whole_points).nees.mean() < 1.6


def test_a_flight_as_stated_wanders_as_slowly_as_stated():
    _, online = flown("stated")
    assert online.window.network.sigmas.attitude_at_most_s == np.inf
    assert not any("wanders" in event for event in online.events)
