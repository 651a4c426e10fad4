"""The operator's light: what lies on the ground, its memory, and whole flights."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest

from triline.solver.adjustment.drift_hypotheses import BiasedSource
from triline.solver.geometry.rotation import matrix_from_angles
from triline.solver.simulation.error_models import ErrorModel
from triline.solver.simulation.flight import FlightPlan
from triline.solver.simulation.scenario import ObservationPlan, simulate
from triline.solver.simulation.window_study import adjust_online, navigate, orientation_errors
from triline.solver.window.quality.exposure import Exposure
from triline.solver.window.quality.ground import LIMIT_GSD, LIMIT_SHARE, Ground
from triline.solver.window.quality.light import (
    FAILED,
    GOOD,
    HOLD_S,
    KIND_S,
    LEAST_POINTS,
    WEAK,
    WORDS_S,
    Fit,
    LightDisplay,
    QualityFindings,
    light,
)
from triline.solver.window.results import WindowOptions

RANK = {GOOD: 0, WEAK: 1, FAILED: 2}
BELOW = Ground(1500.0, 0.15, 900.0)
SENSORS = ErrorModel(attitude_rate_hz=100.0)
CALM = Exposure(np.full(6, 0.2), np.full(6, 0.1), "ray of point T1")
FINE = QualityFindings(
    strip="S1", length_s=25.0, since_s=60.0, fit=Fit(1.0, 500, 1.0, 900), points=200, refused=2, tied=190,
    control=np.full(3, 2.0), control_refused=0, control_doubt="", control_failed=False, apriori_m=np.full(3, 1.0),
    sources=(), time_s=60.0, exposure=CALM, sigma=np.full(6, 0.1), protection=np.full(6, 0.5),
    ground_sigma_m=np.full(4, 0.1), ground_protection_m=np.full(4, 0.5), alert_limit_m=1.0,
)  # fmt: skip
NONE = np.empty(0)
OFF = replace(FINE, ground_protection_m=np.full(4, 2.0))
OVER = replace(FINE, strip="", control=np.zeros(3), exposure=None, ground_protection_m=NONE, ground_sigma_m=NONE)
TORN = replace(FINE, fit=replace(FINE.fit, sigma0=2.0))
STEPPED = replace(FINE, trajectory=(1.0, 1.0, 3.4))
SWUNG = replace(FINE, attitude_at_most_s=6.0)


# ---- on the ground


def test_functions_on_the_ground_are_the_derivatives_of_the_plumb_point_and_of_the_ends_of_the_swath():
    def on_ground(orientation):
        """Where the camera's axis, and the end of its line to the left, meet the plane at height 0."""
        R = matrix_from_angles(*orientation[3:])
        ends = R @ np.array([[0.0, 0.0, -1.0], [0.0, BELOW.half_swath_m / BELOW.height_m, -1.0]]).T
        axis, end = (orientation[:3, None] - ends * (orientation[2] / ends[2])).T
        return np.array([axis[0], axis[1], orientation[2], end[0] - axis[0]])

    level = np.array([20.0, -30.0, BELOW.height_m, 0.0, 0.0, 0.0])
    steps = np.diag([0.1, 0.1, 0.1, 1e-5, 1e-5, 1e-5])
    numeric = np.array([(on_ground(level + d) - on_ground(level - d)) / (2 * d.max()) for d in steps]).T
    numeric[3] *= np.sign(numeric[3, 5])  # to one side or the other
    assert BELOW.functions[:3] == pytest.approx(numeric[:3], abs=1e-3)
    assert BELOW.functions[3] == pytest.approx(numeric[3], abs=1e-2)


def test_errors_that_cancel_on_the_ground_have_no_sigma_there():
    sigma = 1.0 / BELOW.height_m
    C = np.diag([1.0, 0.0, 0.0, 0.0, sigma**2, 0.0])
    together = C.copy()
    together[0, 4] = together[4, 0] = sigma  # a shift along X, and the pitch that takes it back
    assert BELOW.sigma_m(together)[0] == pytest.approx(0.0, abs=1e-6)
    assert BELOW.sigma_m(C)[0] == pytest.approx(np.sqrt(2.0))
    assert BELOW.sigma_m(np.stack([C, together])).shape == (2, 4)


def test_the_limit_follows_the_pixel_and_where_that_is_coarse_the_height_of_flight():
    assert replace(BELOW, gsd_m=0.1).limit_m == pytest.approx(LIMIT_GSD * 0.1)
    assert replace(BELOW, gsd_m=1.0).limit_m == pytest.approx(LIMIT_SHARE * 1500.0)
    with pytest.raises(ValueError, match="alert_limit_m"):
        WindowOptions(alert_limit_m=-1.0)


# ---- at one time


def test_control_that_is_there_is_no_reason_to_be_good():
    """One ray at one control point, or a datum that is bad all the same."""
    poor = np.array([4.3, 3.6, 8.4, 2.0])
    assert light(replace(FINE, points=1, refused=0, tied=0, fit=replace(FINE.fit, redundancy=1)))[0] == WEAK
    got, reason = light(replace(FINE, ground_protection_m=poor, alert_limit_m=3.0))
    assert got == WEAK and "height up to 8.4 m off unseen, limit 3.0 m" in reason
    assert light(replace(FINE, ground_protection_m=poor, alert_limit_m=8.4))[0] == GOOD


def test_how_many_sigmas_an_error_is_does_not_count():
    """Sharper sigmas with the same error in metres: the light stays."""
    for sigma in (0.2, 0.02, 0.002):
        sharp = Exposure(np.full(6, 0.3), np.full(6, sigma), "Z of control point GCP1", ("GCP1",), 0.4)
        assert light(replace(FINE, exposure=sharp, ground_sigma_m=np.full(4, sigma)))[0] == GOOD


def test_what_contradicts_is_said_with_what_it_comes_from():
    drift = BiasedSource("m1", "F", 0.1, 1.2, 0.0, 0.02, 90.0, 28.5, 40.0)
    torn = replace(FINE, control_refused=2)
    assert light(torn) == (FAILED, "2 control points contradict the orientation")
    colour, reason = light(replace(torn, sources=(drift,)))  # looks that drift contradict control
    assert colour == WEAK and reason.startswith("tie points of source m1 on CCD F drift")
    colour, reason = light(replace(FINE, sources=(drift,), control_doubt="control and GNSS differ"))
    assert colour == WEAK and reason.startswith("control and GNSS differ; tie points of source m1")
    assert light(replace(FINE, sources=(drift,), control_doubt="they differ", control_failed=True))[0] == FAILED


def test_more_of_anything_never_makes_it_worse():
    """Fewer and more ties, control and protection, in all combinations: the better situation has no worse light."""
    ties, control = (0, LEAST_POINTS - 1, LEAST_POINTS, 50), (0.0, 1.0, 4.0)
    sigmas, levels = (2.0, 0.6, 0.1), (np.inf, 3.0, 1.01, 0.99, 0.1)
    grid = list(itertools.product(*(range(len(v)) for v in (ties, control, sigmas, levels))))

    def rank(at):
        n, k, s, level = ties[at[0]], control[at[1]], sigmas[at[2]], levels[at[3]]
        situation = replace(
            FINE, points=n, tied=n, control=np.full(3, k), exposure=replace(CALM, sigma=np.full(6, s)),
            ground_protection_m=np.full(4, level),
        )  # fmt: skip
        return RANK[light(situation)[0]]

    ranks = {at: rank(at) for at in grid}
    assert set(ranks.values()) == {0, 1}
    for at in grid:
        for i in range(4):
            better = (*at[:i], at[i] + 1, *at[i + 1 :])
            assert ranks.get(better, 0) <= ranks[at], (at, better)


EXPOSED = Exposure(np.full(6, 2.0), np.full(6, 0.1), "Z of control point GCP3", ("GCP3",), 2.14)
HIGH = np.array([0.3, 0.3, 4.4, 0.2])
DRIFT = BiasedSource("matcher-2", "B", 0.0, 0.5, 0.0, 0.02, 60.0, 36.0, 10.0)


@pytest.mark.parametrize(
    ("change", "colour", "words"),
    [
        ({}, GOOD, ""),
        ({"fit": replace(FINE.fit, sigma0=2.1)}, FAILED, "observations contradict each other: sigma0 2.1"),
        ({"refused": 120}, FAILED, "120 of 200 tie points contradict the others"),
        ({"control_refused": 2}, FAILED, "2 control points contradict"),
        ({"control_doubt": "GCP1 Z or GCP2 Z"}, WEAK, "GCP1 Z or GCP2 Z"),
        ({"control_doubt": "GNSS differs in Z", "control_failed": True}, FAILED, "GNSS differs in Z"),
        ({"points": 0, "refused": 0}, WEAK, "no tie points within 40 s"),
        ({"points": 0, "refused": 0, "since_s": 5.0}, WEAK, "no tie points yet"),
        ({"narrowly": 0.04}, WEAK, "4 % of the looks fail narrowly: their errors have heavier tails than stated"),
        ({"narrowly": 0.015}, GOOD, ""),
        ({"failing": 0.07}, WEAK, "7 % of the looks contradict the others and are left out: more stay unseen"),
        ({"failing": 0.03, "narrowly": 0.01}, GOOD, ""),
        ({"sources": (DRIFT,)}, WEAK, "source matcher-2 on CCD B drift: line +0.00 px, sample +0.50 px"),
        ({"control": np.zeros(3)}, GOOD, "no control within 40 s; earlier control holds the datum"),
        (
            {"control": np.zeros(3), "exposure": replace(CALM, sigma=np.array([0.1, 0.1, 0.8, 0.1, 0.1, 0.1]))},
            WEAK, "no control within 40 s; height datum rests on GNSS",
        ),
        (
            {"control": np.zeros(3), "exposure": replace(CALM, sigma=np.full(6, 0.8))},
            WEAK, "no control within 40 s; position and height datum rest on GNSS",
        ),
        (
            {"control": np.array([1.0, 1.0, 0.0]), "exposure": replace(CALM, sigma=np.full(6, 0.8))},
            WEAK, "no height control within 40 s; height datum rests on GNSS",
        ),
        (
            {"exposure": EXPOSED, "ground_protection_m": HIGH},
            WEAK, "the datum rests on GCP3 alone: an error of 2.1 m in its Z would not be seen "
            "(height up to 4.4 m off unseen, limit 1.0 m)",
        ),
        (
            {"exposure": replace(EXPOSED, names=("GCP1", "GCP2", "GCP3")), "ground_protection_m": HIGH},
            WEAK, "the datum rests on GCP1, GCP2 and GCP3: an error of 2.1 m in one of them would not be seen",
        ),
        ({"exposure": EXPOSED}, GOOD, ""),  # it rests on it, but not so that it matters
        (
            {"ground_protection_m": HIGH},
            WEAK, "an error in the ray of point T1 would not be seen (height up to 4.4 m off unseen",
        ),
        (
            {"ground_protection_m": HIGH, "ground_sigma_m": np.array([0.1, 0.1, 0.8, 0.1])},
            WEAK, "height known to 0.8 m, 1 sigma (height up to 4.4 m off unseen, limit 1.0 m)",
        ),
        ({"ground_protection_m": HIGH, "alert_limit_m": 4.5}, GOOD, ""),
        (
            {"ground_protection_m": HIGH, "alert_limit_m": 4.38},
            WEAK, "(height up to 4.4 m off unseen, just beyond the limit)",
        ),
        ({"ground_protection_m": np.full(4, np.nan)}, WEAK, "not known yet"),
        ({"ground_protection_m": NONE}, WEAK, "not known yet"),
        ({"tied": 1}, WEAK, "too few tie points within 40 s: 1 are seen twice, wanted 6"),
        ({"tied": 1, "length_s": 0.0}, WEAK, "too few tie points yet: 1 are seen twice, wanted 6"),
        ({"tied": 1, "late": 0.2}, WEAK, "within 40 s: 1 are seen twice, wanted 6"),
        (
            {"tied": 1, "late": 0.4}, WEAK,
            "wanted 6; 40 % of the looks came when the window had passed them: is it shorter than from one view to",
        ),
        ({"trajectory": (2.5, 1.0, 1.9)}, WEAK, "the trajectory is worse than stated: offset 2.5 times"),
        ({"attitude_at_most_s": 6.0}, WEAK, "the trajectory is worse than stated: the attitude wanders within 6 s"),
    ],
)  # fmt: skip
def test_the_light_says_why(change, colour, words):
    got, reason = light(replace(FINE, **({"length_s": 40.0, "since_s": 100.0} | change)))
    assert got == colour and words in reason and bool(words) == bool(reason)


# ---- over time


def shown(display, situations, step_s=0.4, from_s=0.0):
    return [display.look(from_s + step_s * i, s) for i, s in enumerate(situations)]


def test_worse_at_once_better_when_it_has_held():
    said = shown(LightDisplay(), [FINE] * 3 + [OFF] + [FINE] * 20)
    colours = [colour for colour, _ in said]
    back = colours.index(GOOD, 4)
    assert colours[:4] == [GOOD, GOOD, GOOD, WEAK]
    assert 0.4 * (back - 3) == pytest.approx(HOLD_S, abs=0.5)
    assert set(colours[back:]) == {GOOD}


def test_it_does_not_chatter():
    """Good and weak in turn, and words whose figures and names change."""
    assert {colour for colour, _ in shown(LightDisplay(), [OFF, FINE] * 40)} == {WEAK}
    one, two = (
        replace(OFF, exposure=replace(CALM, observation=f"Y of control point {n}", names=(n,), detectable_m=3.0 + i))
        for i, n in enumerate(("GCP1", "GCP2"))
    )
    words = [reason for _, reason in shown(LightDisplay(), [one, two] * 60)]
    changes = sum(a != b for a, b in itertools.pairwise(words))
    assert 1 <= changes <= 0.4 * len(words) / WORDS_S + 1


def test_words_of_another_kind_come_soon():
    """Not those that are no longer true."""
    display = LightDisplay()
    begun = replace(FINE, points=0, refused=0, tied=0, since_s=1.0)
    assert shown(display, [begun] * 5)[-1][1].startswith("no tie points yet")
    words = [reason for _, reason in shown(display, [OFF] * 10, from_s=2.0)]
    changed = next(i for i, w in enumerate(words) if w.startswith("an error in"))
    assert 0.4 * changed <= KIND_S + 0.4


def flown(display, situations, times=20, protection=0.5, strip="S1"):
    """A strip that is over: the situations, then final orientation so far off, then nothing is flown."""
    shown(display, [replace(s, strip=strip) for s in situations])
    display.records[strip].became_final(times, np.full((times, 4), protection), 1.0)
    return display.look(1000.0, OVER)


def test_before_the_first_strip_there_is_nothing_to_say():
    assert LightDisplay().look(0.0, OVER) == (GOOD, "no strip is flown")


@pytest.mark.parametrize(
    ("situations", "protection", "colour", "words"),
    [
        ([FINE] * 20, 0.5, GOOD, "strip S1 over: within the limit of 1.0 m"),
        ([OFF] * 10 + [FINE] * 10, 0.5, GOOD, "strip S1 over"),  # weak on the way, but what became final is good
        ([OFF] * 20, 2.0, WEAK, "100 % of its final orientation beyond the limit of 1.0 m"),
        ([FINE] * 16 + [TORN] * 4, 0.5, FAILED, "strip S1 over: observations contradict each other: sigma0 2.0"),
        ([FINE] * 10 + [TORN] * 4 + [FINE] * 6, 0.5, FAILED, "sigma0 2.0 (for 20 % of its time)"),
        ([FINE] * 19 + [TORN] + [FINE] * 20, 0.5, GOOD, "strip S1 over"),  # a moment only
        ([replace(FINE, control_doubt="GCP2 Z refused")] * 20, 0.5, WEAK, "strip S1 over: GCP2 Z refused"),
        # a step of the GNSS on the way stays in the strip, a moment does not
        ([FINE] * 10 + [STEPPED] * 4 + [FINE] * 6, 0.5, WEAK, "worse than stated: wander of position 3.4 times"),
        ([FINE] * 19 + [STEPPED] + [FINE] * 20, 0.5, GOOD, "strip S1 over"),
        # a correlation time holds for all of the strip, or for nothing of it
        ([FINE] * 10 + [SWUNG] * 10, 0.5, WEAK, "worse than stated: the attitude wanders within 6 s"),
        ([FINE] * 5 + [SWUNG] * 10 + [FINE] * 5, 0.5, GOOD, "strip S1 over"),
        (
            [replace(FINE, control=np.zeros(3), exposure=replace(CALM, sigma=np.full(6, 0.9)))] * 20, 0.5,
            WEAK, "strip S1 over: no control within 25 s; position and height datum rest on GNSS",
        ),
        # of a strip that nothing ties, as of a camera with one CCD line, control is not what is missing
        (
            [replace(FINE, control=np.zeros(3), exposure=None, points=3, refused=3, tied=0)] * 20, 2.0,
            WEAK, "strip S1 over: no tie points: the orientation is the measured one",
        ),
    ],
)  # fmt: skip
def test_the_verdict_on_a_strip_stays_until_the_next_begins(situations, protection, colour, words):
    display = LightDisplay()
    got, reason = flown(display, situations, protection=protection)
    assert got == colour and words in reason
    assert display.look(1030.0, OVER) == (got, reason)
    young = replace(FINE, strip="S2", points=0, refused=0, tied=0, since_s=1.0)
    assert display.look(1031.0, young) == (WEAK, "no tie points yet: the orientation is the measured one")
    assert flown(display, [FINE] * 20, strip="S2")[1].startswith("strip S2 over: within")


def test_a_strip_without_final_orientation_is_not_good():
    display = LightDisplay()
    shown(display, [replace(FINE, points=0, refused=0, tied=0)] * 20)
    got, reason = display.look(1000.0, OVER)
    assert got == WEAK and "no tie points" in reason


# ---- whole flights


def fly(seed, ties=8.0, control=6, strip_s=60.0, limit_m=0.0):
    """Light and errors (4,) on the ground at each update, and the result."""
    plan = FlightPlan(strip_s=strip_s, lead_in_s=3.0, lead_out_s=2.0)
    simulation = simulate(plan, seed, SENSORS, ObservationPlan(tie_points_per_s=ties, control=control, check=0))
    rows = []

    def watch(now, window):
        watched = window._quality.last
        if watched is None or not watched.strip:
            return
        orientation = window.live(now) if window.trajectory.covers([now])[0] else None
        if orientation is not None:
            error = orientation_errors(simulation, [orientation]).error[0]
            on_ground = np.abs(BELOW.functions @ error)
            rows.append((now, watched, on_ground))

    options = WindowOptions(grid_hz=2.0, alert_limit_m=limit_m)
    result = adjust_online(simulation, navigate(simulation), options, watch=watch, update_s=1.0, live=False)
    return rows, result


def summary(rows):
    colour = np.array([w.light for _, w, _ in rows])
    level = np.array([w.ground_protection_m.max(initial=0.0) for _, w, _ in rows])
    limit = np.array([w.alert_limit_m for _, w, _ in rows])
    return colour, level, limit, np.array([e.max() for _, _, e in rows])


def test_a_flight_is_green_where_it_is_protected_and_there_alone():
    rows, result = fly(1)
    time = np.array([t for t, _, _ in rows])
    colour, level, limit, error = summary(rows)
    good = colour == GOOD
    assert ((level > 0) & (level <= limit))[good].all() and (error[good] < limit[good]).all()
    assert not good[time < 20.0].any()  # no control, then one pair of it
    settled = time > 45.0
    assert 0.55 < good[settled].mean() <= 1.0
    assert 0.15 < good.mean() < 0.5
    assert (np.diff(good.astype(int)) != 0).sum() <= 4
    held = level[settled] < 0.9 * limit[settled]
    assert good[settled][held].mean() > 0.7  # and where it could be, it mostly is
    verdict = result.reports[-1].quality
    assert verdict.reason.startswith("strip S1 over: ")


def test_the_limit_is_the_users():
    """A flight that the default limit never lets be green."""
    for limit_m, least, most in ((1.0, 0.0, 0.0), (20.0, 0.12, 0.5)):  # from control on
        rows, _ = fly(2, ties=4.0, control=4, strip_s=30.0, limit_m=limit_m)
        assert least <= (summary(rows)[0] == GOOD).mean() <= most and {w.alert_limit_m for _, w, _ in rows} == {limit_m}


@pytest.mark.study
def test_more_tie_points_do_not_make_the_light_worse():
    few, many = (summary(fly(2, ties=ties, control=4, strip_s=30.0, limit_m=5.5)[0])[0] == GOOD for ties in (3.0, 15.0))
    assert many.mean() > few.mean() - 0.02 and many.mean() > 0.12


def test_without_control_it_is_weak_and_says_so():
    rows, result = fly(1, control=0, strip_s=24.0)
    assert GOOD not in summary(rows)[0]
    assert "height datum rest on GNSS" in rows[-1][1].reason
    assert result.reports[-1].quality.light == WEAK and "on GNSS" in result.reports[-1].quality.reason


def test_protection_levels_are_those_of_the_present_equations():
    """Kept figures against all batches judged anew: where the datum rests on a pair of control points."""
    found: list[np.ndarray] = []

    def watch(now, window):
        integrity, state, last = window._quality.integrity, window.state, window._quality.last
        if now < 20.0 or last is None or not last.strip:
            return
        strip = window.strips[last.strip]
        kept = dict(integrity._of_batch)
        said = window._quality.exposure_at(strip, now)
        for batch in window.network.batches:
            batch.judge(state)
        integrity._of_batch.clear()
        integrity.note(window.network.batches)
        anew = window._quality.exposure_at(strip, now)
        integrity._of_batch = kept
        if said is not None and anew is not None and len(said.bias) == len(anew.bias) == 10:
            found.append(said.bias[6:] / anew.bias[6:])

    plan = FlightPlan(strip_s=40.0, lead_in_s=3.0, lead_out_s=2.0)
    simulation = simulate(plan, 11, SENSORS, ObservationPlan(tie_points_per_s=8.0, check=0))
    adjust_online(simulation, navigate(simulation), WindowOptions(grid_hz=2.0), watch=watch, update_s=1.0, live=False)
    ratios = np.array(found)
    assert len(ratios) > 20
    assert (ratios > 0.8).mean() > 0.95 and np.median(ratios) < 1.3


def test_ground_points_alone_are_never_good():
    assert light(FINE)[0] == GOOD
    assert light(replace(FINE, free=150))[0] == GOOD
    colour, reason = light(replace(FINE, free=0))
    assert colour == WEAK and "nothing but ground points is matched" in reason and "height of the ground" in reason


def test_a_flight_in_which_only_targets_were_found_says_so():
    plan = FlightPlan(strip_s=20.0, lead_in_s=3.0, lead_out_s=2.0)
    seen = ObservationPlan(tie_points_per_s=0.0, control=40, check=0)
    simulation = simulate(plan, 2, SENSORS, seen)
    reports = adjust_online(simulation, navigate(simulation), WindowOptions(), update_s=0.5).reports
    shown = {(r.quality.light, r.quality.reason) for r in reports}
    assert {words for colour, words in shown if colour == GOOD} <= {"no strip is flown"}
    assert any("nothing but ground points" in words for _, words in shown)
