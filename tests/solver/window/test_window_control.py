"""Control weighed together while the strip is flown: what contradicts is refused, told and taken back."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from triline.solver.adjustment.bias_search import UNTOLD, _search, judge
from triline.solver.adjustment.reliability import CRITICAL_W
from triline.solver.simulation.error_models import ErrorModel
from triline.solver.simulation.flight import FlightPlan
from triline.solver.simulation.misspecified_study import ROWS, SETTINGS
from triline.solver.simulation.scenario import ObservationPlan, simulate
from triline.solver.simulation.window_study import adjust_online, navigate, orientation_errors
from triline.solver.window.datum.biases import Biases, Coordinate, LeftControl, discrepancies
from triline.solver.window.results import CONTRADICTS, TAKEN_BACK, WindowOptions
from triline.solver.window.state.unknowns import Border, Information, WindowState

# ---- biases carried through marginalisation

UNKNOWNS, BIASES = 7, 4


def normal_equations(seed: int):
    """Of unknowns and biases together, from random rows: matrix, right-hand side, square."""
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(30, UNKNOWNS + BIASES))
    values = rng.normal(size=30)
    return A.T @ A, A.T @ values, float(values @ values)


def window_with(N, rhs, square):
    """A state in which all biases are held at zero, and their columns."""
    state = WindowState()
    numbers = state.new_numbers(UNKNOWNS)
    state.enter(numbers)
    x, b = slice(0, UNKNOWNS), slice(UNKNOWNS, None)
    information = Information(N[x, x], rhs[x], square, 30)
    state.add(numbers, information)
    state.fix(numbers, information)
    left = LeftControl(20)
    coordinates = [Coordinate(f"P{i}", 2, 0, 1.0, 0.0) for i in range(BIASES)]
    left.add(Biases(coordinates, np.zeros(BIASES, dtype=bool), Border(numbers, N[x, b], N[b, b], rhs[b])))
    return state, left, numbers


def known_directly(N, rhs, out, gone):
    """Normal equations of the unknowns that stay, with free biases and others left out, eliminated at once."""
    free = [*gone, *(UNKNOWNS + np.flatnonzero(out))]
    stay = [i for i in range(UNKNOWNS) if i not in gone]
    inner = np.linalg.inv(N[np.ix_(free, free)])
    cross = N[np.ix_(stay, free)]
    return N[np.ix_(stay, stay)] - cross @ inner @ cross.T, rhs[stay] - cross @ inner @ rhs[free]


def flags(*places):
    return np.isin(np.arange(BIASES), places)


def test_control_is_refused_and_taken_back_exactly_long_after_it_has_left():
    N, rhs, square = normal_equations(1)
    state, left, numbers = window_with(N, rhs, square)
    gone: list[int] = []
    for leaving, out in (([0, 3], flags()), ([1], flags(1)), ([5], flags(1, 2)), ([], flags(0, 3)), ([2], flags(0)),
                         ([], flags())):  # fmt: skip
        left.set_out(out, state)
        if leaving:
            left.marginalised(state.marginalise(numbers[leaving]))
            gone += leaving
        got = state.normal()
        for a, b in zip(got, known_directly(N, rhs, out, gone), strict=True):
            assert a == pytest.approx(b, rel=1e-9, abs=1e-9)
        state.solve()
        everything = np.linalg.solve(*known_directly(N, rhs, flags(0, 1, 2, 3), gone))
        d = discrepancies([left], state)
        whole = np.linalg.inv(N)
        biases = (whole @ rhs)[UNKNOWNS:]
        assert np.linalg.solve(d.C, d.v) == pytest.approx(biases, rel=1e-7)
        assert np.linalg.inv(d.C) == pytest.approx(whole[UNKNOWNS:, UNKNOWNS:], rel=1e-7)
        assert everything == pytest.approx((whole @ rhs)[[i for i in range(UNKNOWNS) if i not in gone]], rel=1e-7)


def test_what_is_kept_no_more_stays_as_it_is():
    N, rhs, square = normal_equations(2)
    state, left, numbers = window_with(N, rhs, square)
    left.set_out(flags(1), state)
    left._most = 2
    left.add(Biases([], flags()[:0], Border.of(0, numbers)))
    assert len(left) == 2
    for a, b in zip(state.normal(), known_directly(N, rhs, flags(1), []), strict=True):
        assert a == pytest.approx(b, rel=1e-9, abs=1e-9)
    left.set_out(np.array([True, False]), state)
    for a, b in zip(state.normal(), known_directly(N, rhs, flags(1, 2), []), strict=True):
        assert a == pytest.approx(b, rel=1e-9, abs=1e-9)


# ---- hypotheses

PRICE = CRITICAL_W**2


def heights(values, gnss_m=1.5, pairs_m=0.8, own_m=0.1):
    """Information about biases of heights, in pairs, from discrepancies."""
    b = np.asarray(values, dtype=float)
    n = len(b)
    pair = np.arange(n) // 2
    covariance = gnss_m**2 + pairs_m**2 * (pair[:, None] == pair) + own_m**2 * np.eye(n)
    C = np.linalg.inv(covariance)
    return C, C @ b, np.full(n, 2), covariance


def verdict(values, before=None, shifted=None):
    C, v, axis, _ = heights(values)
    before = np.zeros(len(v), dtype=bool) if before is None else np.asarray(before, dtype=bool)
    return judge(C, v, axis, PRICE, before, shifted)


@pytest.mark.parametrize(
    ("values", "out", "told"),
    [
        ([0.3, 0.2, 0.4, 0.3], [], True),
        ([0.3, 5.2, 0.4, 0.3], [1], True),  # one
        ([-0.3, 0.7], [0, 1], False),  # one of two, and the GNSS cannot tell
        ([0.1, 30.0], [1], True),  # one of two, and the GNSS tells
        ([0.0, 0.1, 6.0, 6.1], [2, 3], True),  # two, and the GNSS tells
        ([-3.0, -2.9, 3.0, 3.1], [0, 1, 2, 3], False),  # two against two
        ([-3.0, -2.9, 3.0, 3.1, 3.0, 2.9], [0, 1], True),  # two against four: those that came first are wrong
        ([47.0, 47.1, 47.6, 47.5], [0, 1, 2, 3], True),  # all of them
    ],
)  # fmt: skip
def test_hypotheses(values, out, told):
    found = verdict(values)
    assert np.flatnonzero(found.out).tolist() == out
    assert (len(found.rivals) == 1) == told


def test_a_shift_in_common_is_one_cause():
    assert verdict([47.0, 47.1, 47.6, 47.5]).chosen == {4 + 2}
    found = verdict([47.0, 47.1, 52.0, 47.5])
    assert found.chosen == {2, 4 + 2} and found.out.all()


def test_in_the_datum_of_control_a_shift_in_common_refuses_nothing():
    found = verdict([47.0, 47.1, 47.6, 47.5], shifted=())
    assert found.chosen == {4 + 2} and not found.out.any()
    # one that differs from the others as well is refused all the same
    assert np.flatnonzero(verdict([47.0, 47.1, 52.0, 47.5], shifted=()).out).tolist() == [2]


def test_one_coordinate_says_no_more_against_a_trajectory_that_is_known_to_be_off():
    assert verdict([47.0], shifted=()).out.all()  # it may be wrong itself
    assert not verdict([47.0], shifted=(2,)).out.any()
    assert verdict([47.0], shifted=(0,)).out.all()  # known of another axis


def test_what_was_decided_stands_against_a_little():
    w = np.sqrt(1.5**2 + 0.8**2 + 0.1**2) * (CRITICAL_W - 0.1)
    assert not verdict([w]).out.any()
    assert verdict([w], [True]).out.all()
    assert not verdict([0.5 * w], [True]).out.any()


def test_good_control_is_rarely_refused():
    rng = np.random.default_rng(7)
    covariance = heights(np.zeros(6))[3]
    root = np.linalg.cholesky(covariance)
    refused = sum(verdict(root @ rng.normal(size=6)).out.any() for _ in range(2000))
    assert 0 < refused < 2000 * 8 * 1.5e-3  # seven tests of 0.1 % each, not all of them independent


@pytest.mark.parametrize("tilt", [0.6, 0.01, 0.001, 0.0])
def test_a_point_of_one_look_keeps_a_coordinate_and_comes_back(tilt):
    """A look is two conditions: two of the three coordinates out are all that it can contradict. With all three out the
    point would have no place, and could not be judged again. Of a look that goes nearly straight down it is rounding
    what is left of the third."""
    look = np.array([[1.0, 0.0, -tilt], [0.0, 1.0, 0.3 * tilt]])
    axis, nothing, weight = np.arange(3), np.zeros(3, dtype=bool), 1e4 * np.eye(3)
    for orientation_m, out in ((0.1, [0, 1]), (2.0, [])):  # as stated; and when that is known to be worse
        N = look.T @ look / (0.1**2 + orientation_m**2)
        C = weight - weight @ np.linalg.inv(N + weight) @ weight
        v = N @ np.array([1.3, 1.1, 0.0])
        found = judge(C, v, axis, PRICE, nothing, ())
        assert np.flatnonzero(found.out).tolist() == out
        if out:
            assert (judge(C, v, axis, PRICE, found.out, ()).out == found.out).all()


# ---- flights

PLAN = FlightPlan(strip_s=60.0, lead_in_s=3.0, lead_out_s=2.0)
FIRST_M = 5.0


@pytest.fixture(scope="module")
def flight():
    simulation = simulate(PLAN, 5, ErrorModel(attitude_rate_hz=100.0), ObservationPlan(tie_points_per_s=3.0, control=6))
    return simulation, navigate(simulation)


def spoilt(flight, by, datum="control", live=False, update_s=1.0):
    """A flight whose control is off by so many metres in height, by place in the order in which it is flown over."""
    simulation, poses = flight
    control = np.flatnonzero(simulation.points.role == "control")
    along = simulation.points.xyz_l[control] @ np.diff(simulation.flight.truth.at([5.0, 55.0]).position_l, axis=0)[0]
    control = control[np.argsort(along)]
    surveyed = simulation.surveyed_l.copy()
    for place, metres in by.items():
        surveyed[control[place], 2] += metres
    options = WindowOptions(grid_hz=4.0, datum=datum)
    online = adjust_online(replace(simulation, surveyed_l=surveyed), poses, options, live=live, update_s=update_s)
    return online, [str(simulation.points.id[i]) for i in control]


def beyond(errors, sigmas=4.5):
    return np.abs(errors.error[:, :3]) > sigmas * np.sqrt(np.einsum("nii->ni", errors.covariance))[:, :3]


def test_control_in_another_height_system_is_named_and_its_datum_published(flight):
    online, _ = spoilt(flight, dict.fromkeys(range(6), 47.0), update_s=0.5)
    out = set()
    for r in online.refused:
        if r.coordinate:
            (out.discard if r.reason == TAKEN_BACK else out.add)(r.point)
    assert not out, "control that agrees with itself is not refused"
    line = next(e for e in online.events if "GNSS" in e)
    assert "in Z" in line and "height system (geoid)? Z is published in the datum of control" in line
    assert "failed" in {r.quality.light for r in online.reports}, "beyond the alert limit"
    errors = orientation_errors(flight[0], online.whole)
    errors.error[:, 2] -= 47.0
    assert not beyond(errors).any() and np.sqrt(np.mean(errors.error[:, 2] ** 2)) < 0.5


def test_control_in_another_height_system_is_refused_where_gnss_is_the_datum(flight):
    online, names = spoilt(flight, dict.fromkeys(range(6), 47.0), datum="gnss", live=True)
    refused = [r for r in online.refused if r.reason == CONTRADICTS]
    assert {(r.point, r.coordinate) for r in refused} == {(name, "Z") for name in names}
    assert all(r.w > 5.0 and r.off_m == pytest.approx(47.0, abs=6.0) for r in refused)
    (line,) = [e for e in online.events if "GNSS" in e]
    assert "in Z" in line and "points): height system (geoid)?" in line
    lights = [r.quality for r in online.reports if r.strip and r.control]
    assert lights and all(w.light == "failed" and "control and GNSS differ by" in w.reason for w in lights)
    for run in (online.live, online.final, online.whole):
        assert not beyond(orientation_errors(flight[0], run)).any()


def test_wrong_control_that_came_first_gives_way_to_what_comes_later(flight):
    online, names = spoilt(flight, {0: FIRST_M, 1: FIRST_M})
    out = set()
    for r in online.refused:
        if r.reason == CONTRADICTS:
            out.add(r.point)
        elif r.reason == TAKEN_BACK and r.coordinate:
            out.discard(r.point)
    assert out == set(names[:2])
    assert not beyond(orientation_errors(flight[0], online.whole)).any()
    errors = orientation_errors(flight[0], online.whole)
    assert np.sqrt(np.mean(errors.error[:, 2] ** 2)) < 0.3


def test_one_wrong_coordinate_is_named_and_good_control_is_not(flight):
    online, names = spoilt(flight, {3: -8.0})
    (refused,) = [r for r in online.refused if r.reason == CONTRADICTS]
    assert (refused.point, refused.coordinate) == (names[3], "Z")
    assert refused.w > CRITICAL_W and refused.off_m == pytest.approx(-8.0, abs=3.0)
    assert any(e.startswith(f"control {names[3]} Z refused: w ") for e in online.events)
    right, _ = spoilt(flight, {})
    assert not [r for r in right.refused if r.coordinate]
    whole = [orientation_errors(flight[0], r.whole).rmse[2] for r in (online, right)]
    assert whole[0] < 1.3 * whole[1] + 0.02


def test_control_of_one_look_counts_again_when_the_trajectory_is_known_to_be_worse():
    plan, ties = FlightPlan(strip_s=40.0, lead_in_s=3.0, lead_out_s=2.0), ObservationPlan(4.0, control=4)
    flown = simulate(plan, 2, SETTINGS["rtk"], ties, world=ROWS["boresight"].world)
    point = flown.images.looks.point
    later = np.append(False, point[1:] == point[:-1]) & (flown.points.role[point] == "control")
    flown = replace(flown, images=flown.images.select(~later))
    online = adjust_online(flown, navigate(flown), WindowOptions(grid_hz=4.0), update_s=1.0)
    contradicting, back = (
        [(r.point, r.coordinate) for r in online.refused if r.coordinate and r.reason == reason]
        for reason in (CONTRADICTS, TAKEN_BACK)
    )
    assert contradicting and sorted(back) == sorted(contradicting)
    assert len({axis for _, axis in contradicting}) == 2


@pytest.mark.study
@pytest.mark.parametrize("datum", ["control", "gnss"])
def test_control_in_another_height_system_moves_no_strip_of_a_block(datum):
    plan = FlightPlan(
        strips=2, cross_strips=1, strip_s=24.0, sidelap=0.4, turns=False, gap_s=6.0, lead_in_s=3.0, lead_out_s=2.0
    )
    ties = ObservationPlan(tie_points_per_s=4.0, control=4)
    simulation = simulate(plan, 11, ErrorModel(attitude_rate_hz=100.0), ties)
    surveyed = simulation.surveyed_l + np.where(simulation.points.role == "control", 47.0, 0.0)[:, None] * [0, 0, 1]
    poses = navigate(simulation)
    options = WindowOptions(grid_hz=4.0, datum=datum)
    online = adjust_online(replace(simulation, surveyed_l=surveyed), poses, options, update_s=0.5)
    seen = [p.rays for p in online.whole_points.values() if p.role == "control"]
    assert max(seen) > 3  # from several strips: their ties hold
    assert {r.coordinate for r in online.refused if r.reason == CONTRADICTS} <= {"Z"}
    for run in (online.final, online.whole) if datum == "gnss" else (online.whole,):
        errors = orientation_errors(simulation, run)
        errors.error[:, 2] -= 47.0 if datum == "control" else 0.0
        assert not beyond(errors).any()


def test_biases_whose_equations_are_singular_are_weighed():
    """In a flight whose camera is hundreds of pixels off this ended the adjuster."""
    scores = _search(-UNTOLD * np.eye(2), np.array([3.0, 1.0]), np.arange(2), 2.0)
    assert all(np.isfinite(score) for score in scores.values())
