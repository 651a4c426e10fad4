"""The sliding window against the batch adjustment of the same data, and what it does with bad data."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from triline.solver.adjustment.adjustment import adjust
from triline.solver.adjustment.network import Control, Measurements, Strip, build_network
from triline.solver.camera.self_calibration import tls
from triline.solver.geometry.trajectory import Trajectory
from triline.solver.models.base import ModelOptions
from triline.solver.simulation.error_models import ErrorModel
from triline.solver.simulation.flight import FlightPlan
from triline.solver.simulation.scenario import ObservationPlan, simulate
from triline.solver.simulation.window_study import (
    adjust_online,
    direct_points,
    measured_errors,
    navigate,
    orientation_errors,
    point_errors,
    slow_errors_of,
)
from triline.solver.window.results import Look, WindowOptions
from triline.solver.window.window import Window

PLAN = FlightPlan(strip_s=30.0, lead_in_s=3.0, lead_out_s=2.0)
TIES = ObservationPlan(tie_points_per_s=5.0, check=10)
SENSORS = ErrorModel(attitude_rate_hz=100.0)
NEVER = 1e6


@pytest.fixture(scope="module")
def flight():
    simulation = simulate(PLAN, 3, SENSORS, TIES)
    return simulation, navigate(simulation)


@pytest.fixture(scope="module")
def adjusted(flight):
    """The flight adjusted with the usual options."""
    return adjust_online(*flight, live=False, update_s=1.0)


class Same(ModelOptions):
    """Options that give a model that is there already."""

    name = "same"

    def __init__(self, model):
        self.model = model

    @classmethod
    def from_settings(cls, settings):
        return cls(None)

    def build(self, extent):
        return self.model


def as_network(simulation, poses):
    chosen = [p.pose for p in poses if p.pose.smoothed]
    trajectory = Trajectory([p.time_s for p in chosen], [p.position_l for p in chosen], [p.quaternion for p in chosen])
    strips = [Strip(s.id, trajectory, s.first_line_time_s, s.line_rate_hz, s.lines) for s in simulation.flight.strips]
    looks, sigma = simulation.images.looks, np.full(len(simulation.images), TIES.image_sigma_px)
    measurements = Measurements(
        looks.point, looks.strip, looks.ccd, simulation.images.line, simulation.images.sample, sigma, sigma
    )
    control = np.flatnonzero(simulation.points.role == "control")
    given = Control(control, simulation.surveyed_l[control], np.tile(TIES.control_sigma_m, (len(control), 1)))
    return build_network(simulation.flight.camera, strips, [str(i) for i in simulation.points.id], measurements, given)


@pytest.mark.parametrize("model", ["wander", "dgr", "ppm", "lim"])
def test_a_window_that_lets_nothing_go_is_the_batch_adjustment(flight, model):
    simulation, poses = flight
    options = WindowOptions(model=model, segment_s=1.0, window_s=NEVER, settle_s=NEVER, snoop=False)
    slow = slow_errors_of(simulation.errors)
    smoothed = [p for p in poses if p.pose.smoothed]
    # poses whose covariance is that of the slow errors: white noise at its floor, as the batch assumes none
    exact = np.diag(np.concatenate([slow.position_sigma, slow.attitude_sigma]) ** 2)
    smoothed = [replace(p, pose=replace(p.pose, covariance=exact)) for p in smoothed]
    seen = {}
    end = simulation.flight.covered_s[-1, 1]

    def watch(now, window):
        if now >= end - 0.5 and not seen:
            strip = window.strips["S1"]
            seen["values"], seen["cov"] = window.state.values(strip.numbers), window.state.covariance(strip.numbers)
            seen["model"] = strip.model
            seen["rays"] = sum(b.counts.rays for b in window.network.batches)
            seen["points"] = {n: x for b in window.network.batches for n, x in zip(b.names, b.points_l, strict=True)}

    adjust_online(simulation, smoothed, options, live=False, watch=watch, update_s=0.5)
    network = as_network(simulation, poses)
    solution = adjust(network, Same(seen["model"]))
    assert seen["rays"] == len(network.rays)
    time = np.linspace(4.0, 32.0, 50)
    design = seen["model"].design(time)
    difference = design.evaluate(seen["values"]) - design.evaluate(solution.state.theta)
    A = np.zeros((50, 6, len(seen["values"]) + 1))
    A[np.arange(50)[:, None, None], np.arange(6), design.columns] += design.coefficients[:, :, None]
    A = A[:, :, :-1]
    online = np.sqrt(np.einsum("ncu,uv,ncv->nc", A, seen["cov"], A))
    batch = np.sqrt(np.einsum("ncu,uv,ncv->nc", A, solution.factor.cofactors(np.arange(A.shape[2])), A))
    assert np.abs(difference / batch).max() < 0.1
    assert online / batch == pytest.approx(1.0, abs=0.02)


def test_marginalisation_loses_nothing_and_invents_nothing(flight):
    simulation, poses = flight
    runs = [
        adjust_online(simulation, poses, WindowOptions(window_s=w, snoop=False, settle_s=NEVER), update_s=1.0)
        for w in (20.0, NEVER)
    ]
    short, long = ({round(float(o.time_s[0]), 3): o for o in run.live if o.time_s[0] > 25.0} for run in runs)
    assert len(short) > 100 and short.keys() == long.keys()
    assert min(len(r.final) for r in runs[:1]) > 3  # something had left by then
    for time, o in short.items():
        sigma = np.sqrt(np.diag(long[time].covariance[0]))
        assert np.abs((o.correction[0] - long[time].correction[0]) / sigma).max() < 0.01
        assert np.sqrt(np.diag(o.covariance[0])) == pytest.approx(sigma, rel=0.001)


def test_the_backward_pass_gives_every_time_what_the_whole_strip_knows(flight):
    simulation, poses = flight
    online = adjust_online(simulation, poses, WindowOptions(window_s=20.0, snoop=False), live=False, update_s=1.0)
    batch = adjust_online(
        simulation, poses, WindowOptions(window_s=NEVER, settle_s=NEVER, snoop=False), live=False, update_s=1.0
    )  # the same, with nothing let go before the end
    joined = [
        [np.concatenate([getattr(o, name) for o in run]) for name in ("time_s", "correction", "covariance", "angles")]
        for run in (online.whole, batch.final, online.final)
    ]
    (t1, c1, S1, a1), (t2, c2, S2, a2), (t3, c3, _, _) = joined
    assert t1 == pytest.approx(t2) and t1 == pytest.approx(t3)
    sigma = np.sqrt(np.einsum("nii->ni", S2))
    assert np.abs((c1 - c2) / sigma).max() < 0.01
    assert np.abs((a1 - a2) / sigma[:, 3:]).max() < 0.01
    assert np.einsum("nii->ni", S1) == pytest.approx(sigma**2, rel=0.01)
    assert np.abs((c3 - c2) / sigma).max() > 0.5  # which the first final answer could not know
    assert online.whole_points.keys() == batch.final_points.keys()
    for name, point in online.whole_points.items():
        sigma = np.sqrt(np.diag(batch.final_points[name].covariance))
        assert np.abs((point.xyz_l - batch.final_points[name].xyz_l) / sigma).max() < 0.05
        assert np.sqrt(np.diag(point.covariance)) == pytest.approx(sigma, rel=0.02)


@pytest.mark.study
def test_several_strips():
    simulation = simulate(
        FlightPlan(strips=2, strip_s=20.0, turns=False, gap_s=4.0, lead_in_s=3.0, lead_out_s=2.0), 7, SENSORS, TIES
    )
    poses = navigate(simulation)
    result = adjust_online(simulation, poses, WindowOptions(settle_s=1.0), update_s=0.5)
    assert [o.strip for o in result.final] == sorted(o.strip for o in result.final)
    assert {o.strip for o in result.whole} == {"S1", "S2"}
    assert len(result.window.state) == 0
    errors = orientation_errors(simulation, result.final)
    measured = measured_errors(simulation, poses, True)
    assert np.linalg.norm(errors.rmse[:3]) < 0.5 * np.linalg.norm(measured.rmse[:3])
    assert 0.2 < errors.nees.mean() < 4.0


def test_additional_parameters_are_estimated_along(flight):
    simulation, poses = flight
    options = WindowOptions(determine=False)
    result = adjust_online(simulation, poses, options, tls(simulation.flight.camera), live=False, update_s=1.0)
    names = [p.name for p in result.reports[-5].parameters]
    assert names[9:] == list(tls(simulation.flight.camera).names)
    values = {p.name: p for p in result.reports[-5].parameters}
    assert all(abs(values[n].t) < 4.5 for n in names[9:])  # the camera is as calibrated
    assert values["k1"].sigma < 0.5 * tls(simulation.flight.camera).sigma[1]
    assert 0.3 < orientation_errors(simulation, result.final).nees.mean() < 3.0


@pytest.mark.parametrize("seeds", [4, pytest.param(20, marks=pytest.mark.study)])
def test_consistent_over_seeds_and_better_than_direct_georeferencing(seeds):
    ratio = {"live": [], "final": [], "live points": [], "final points": []}
    sigma0, eo, direct_eo, points, direct = [], [], [], [], []
    for seed in range(seeds):
        simulation = simulate(PLAN, seed, SENSORS, TIES)
        poses = navigate(simulation)
        result = adjust_online(simulation, poses, WindowOptions(grid_hz=4.0), update_s=1.0)
        ratio["live"].append(orientation_errors(simulation, result.live).nees.mean())
        final = orientation_errors(simulation, result.final)
        ratio["final"].append(final.nees.mean())
        ratio["live points"].append(point_errors(simulation, result.live_points).nees.mean())
        adjusted = point_errors(simulation, result.final_points)
        ratio["final points"].append(adjusted.nees.mean())
        sigma0.append(result.reports[-1].sigma0_total)
        eo.append(final.rmse)
        direct_eo.append(measured_errors(simulation, poses, True).rmse)
        points.append(adjusted.rmse)
        direct.append(direct_points(simulation, poses).rmse)
    for name, values in ratio.items():
        assert 0.75 < np.mean(values) < 1.3, f"{name}: {np.mean(values):.2f}"
    assert 0.9 < np.mean(sigma0) < 1.05
    rms = [np.sqrt(np.mean(np.square(v), axis=0)) for v in (eo, direct_eo, points, direct)]
    assert (rms[0] < rms[1]).all()
    assert (5.0 * rms[2] < rms[3]).all()


def test_without_control_there_is_a_result_with_large_honest_sigma():
    simulation = simulate(PLAN, 5, SENSORS, replace(TIES, control=0))
    result = adjust_online(simulation, navigate(simulation), live=False, update_s=1.0)
    errors = orientation_errors(simulation, result.final)
    sigma = np.sqrt(np.einsum("nii->ni", errors.covariance))
    assert sigma[:, 0].min() > 0.3  # the datum rests on the a-priori offset
    assert 0.05 < errors.nees.mean() < 4.0
    assert result.reports[-1].control == 0


def test_without_any_tie_point_the_measured_trajectory_comes_back_with_its_sigma(flight):
    simulation, poses = flight
    nothing = replace(simulation, images=simulation.images.select(np.zeros(len(simulation.images), dtype=bool)))
    result = adjust_online(nothing, poses, live=False, update_s=1.0)
    errors = orientation_errors(simulation, result.final)
    slow = slow_errors_of(simulation.errors)
    sigma = np.sqrt(errors.covariance[:, 0, 0])
    assert sigma == pytest.approx(slow.position_sigma[0], rel=0.01)
    assert np.abs(np.concatenate([o.correction for o in result.final])).max() == 0.0
    assert np.isnan(result.reports[-1].sigma0)


@pytest.mark.parametrize("seeds", [1, pytest.param(8, marks=pytest.mark.study)])
def test_outliers_are_found_and_the_result_is_as_good_as_without_them(seeds):
    """20 % of the rays are blunders. What is compared is the same flight with those rays never measured."""
    plan = replace(TIES, tie_points_per_s=8.0)
    clean, dirty, clean_points, dirty_points, missed, lost, kept = [], [], [], [], [], 0, 0
    for seed in range(seeds):
        simulation = simulate(PLAN, seed, SENSORS, replace(plan, outlier_share=0.2))
        poses = navigate(simulation)
        without = replace(simulation, images=simulation.images.select(~simulation.images.outlier))
        good = adjust_online(without, poses, live=False, update_s=1.0)
        result = adjust_online(simulation, poses, live=False, update_s=1.0)
        clean.append(orientation_errors(simulation, good.final).rmse)
        dirty.append(orientation_errors(simulation, result.final).rmse)
        common = [
            name
            for name, p in good.final_points.items()
            if p.rays >= 3 and name in result.final_points and result.final_points[name].rays >= 3
        ]
        for rmse, run in ((clean_points, good), (dirty_points, result)):
            rmse.append(point_errors(simulation, {name: run.final_points[name] for name in common}).rmse)
        used, wanted = (
            {
                (p.name, r.look.ccd)
                for p in run.final_points.values()
                for r in p.residuals
                if p.rays >= 3 and not r.rejected
            }
            for run in (result, good)
        )
        looks, lines = simulation.images.looks, simulation.flight.camera.lines
        truth = {
            (str(simulation.points.id[p]), lines[c].id): bool(o)
            for p, c, o in zip(looks.point, looks.ccd, simulation.images.outlier, strict=True)
        }
        missed.append(np.mean([truth[ray] for ray in used]))
        lost, kept = lost + len(wanted - used), kept + len(wanted & used)
    assert np.mean(missed) < 0.005
    assert lost < 0.01 * kept
    for one, two in ((clean, dirty), (clean_points, dirty_points)):
        ratio = np.linalg.norm(two, axis=1) / np.linalg.norm(one, axis=1)
        assert 0.85 < np.mean(ratio) < 1.1 and ratio.max() < 1.25, ratio


def test_a_wrong_control_coordinate_is_left_out(flight, adjusted):
    simulation, poses = flight
    wrong = np.flatnonzero(simulation.points.role == "control")[2]
    surveyed = simulation.surveyed_l.copy()
    surveyed[wrong, 2] += 5.0
    result = adjust_online(replace(simulation, surveyed_l=surveyed), poses, live=False, update_s=1.0)
    height = [orientation_errors(simulation, r.final).rmse[2] for r in (result, adjusted)]
    assert height[0] < 2.0 * height[1] + 0.1


LOOK = Look("S1", "N", 2000.0, 6000.0, 0.3, 0.3)


def empty_window(simulation, **options):
    window = Window(simulation.flight.camera, slow_errors_of(simulation.errors), WindowOptions(**options))
    window.begin_strip("S1", 3.0, 450.0, 13500)
    return window


@pytest.mark.parametrize(
    ("look", "reason"),
    [
        (replace(LOOK, line=float("nan")), "value is not finite"),
        (replace(LOOK, sample=float("inf")), "value is not finite"),
        (replace(LOOK, sigma_line_px=0.0), "sigma is not positive"),
        (replace(LOOK, sigma_line_px=1e200), "sigma of no measurement"),
        (replace(LOOK, sigma_sample_px=1e-300), "sigma of no measurement"),
        (replace(LOOK, ccd="X"), "unknown ccd"),
        (replace(LOOK, strip="S9"), "unknown strip"),
        (replace(LOOK, sample=12000.0), "beyond the ccd line"),
        (replace(LOOK, line=13500.0), "outside strip"),
        (replace(LOOK, line=-1.0), "outside strip"),
        (replace(LOOK, time_s=20.0), "time is not that of its line"),
    ],
)
def test_looks_that_cannot_be_are_refused_and_named(flight, look, reason):
    window = empty_window(flight[0])
    assert window.add_look("P", look) == reason
    update = window.update(4.0)
    assert [(r.point, r.look.ccd, r.reason) for r in update.refused] == [("P", look.ccd, reason)]


@pytest.mark.parametrize(("stated_s", "time_s"), [(np.nan, 3.0 + 2000 / 450.0), (7.6, 7.6)])
def test_a_look_has_its_own_time_or_that_of_the_rate(flight, stated_s, time_s):
    window = empty_window(flight[0])
    assert window.add_look("P", replace(LOOK, time_s=stated_s)) == ""
    assert window.network.intake.points["P"].time_s == [pytest.approx(time_s, abs=1e-12)]


def test_duplicates_single_looks_and_looks_without_orientation_are_refused(flight):
    simulation, poses = flight
    window = empty_window(simulation, window_s=5.0)
    assert window.add_look("P", LOOK) == ""
    assert window.add_look("P", LOOK) == "duplicate"
    slow = slow_errors_of(simulation.errors)
    early = [p.pose for p in poses if p.pose.smoothed and p.pose.time_s < 12.0 and not 5.0 < p.pose.time_s < 5.5]
    window.trajectory.add(
        [p.time_s for p in early], np.array([p.position_l for p in early]), np.array([p.quaternion for p in early]),
        slow.without(np.array([p.covariance for p in early])), True,
    )  # fmt: skip
    assert window.add_look("gap", replace(LOOK, line=2.25 * 450)) == ""
    reasons = [r.reason for t in np.arange(3.2, 20.0, 0.2) for r in window.update(t).refused]
    assert sorted(reasons) == ["duplicate", "no orientation", "too few looks"]


def test_looks_of_a_time_without_poses_wait_for_smoothed_ones(flight, adjusted):
    """A filter that has aligned itself in motion says later what was before its first filtered pose."""
    simulation, poses = flight
    begin_s = 12.0
    late = [p for p in poses if p.pose.smoothed or p.pose.time_s > begin_s]
    late = [replace(p, known_s=max(p.known_s, begin_s + 0.5)) if p.pose.smoothed else p for p in late]
    waited = adjust_online(simulation, sorted(late, key=lambda p: p.known_s), live=False, update_s=1.0)
    usual, used = (
        (sum(r.reason == "no orientation" for r in result.refused), len(result.final_points))
        for result in (adjusted, waited)
    )
    assert used == usual and used[1] > 100


def test_what_is_final_stays_final(flight):
    simulation, poses = flight
    # an own one: looks are added to its window
    result = adjust_online(simulation, poses, live=False, update_s=1.0)
    times = np.concatenate([o.time_s for o in result.final])
    assert (np.diff(times) > 0).all() and np.diff(times).max() == pytest.approx(0.05)
    strip = simulation.flight.strips[0]
    assert times[0] == pytest.approx(strip.first_line_time_s)
    assert times[-1] == pytest.approx(float(strip.time_of(strip.lines - 1)), abs=0.06)
    window = result.window
    name = next(iter(result.final_points))
    assert window.add_look(name, replace(LOOK, strip="S1", line=10.0)) == "too late"
    assert window.add_look("new", replace(LOOK, line=10.0)) == "too late"
    assert len(window.state) == 0


def test_a_window_that_is_shorter_than_from_view_to_view_is_named(flight, adjusted):
    """Without a point that is seen twice the light said how many are wanted, not why there are none."""
    short = adjust_online(*flight, WindowOptions(window_s=3.0), live=False, update_s=1.0)
    why = "of the looks came when the window had passed them: is it shorter than from one view to the next?"
    assert any(why in report.quality.reason for report in short.reports)
    assert not any("had passed" in report.quality.reason for report in adjusted.reports)


def test_control_that_comes_late_still_counts(flight):
    simulation, poses = flight
    names = [str(simulation.points.id[i]) for i in np.flatnonzero(simulation.points.role == "control")]
    blind = replace(
        simulation, points=replace(simulation.points, role=np.where(np.isin(simulation.points.role, ["control"]), "tie",
                                                                    simulation.points.role))
    )  # fmt: skip
    given = dict(zip([str(i) for i in simulation.points.id], simulation.surveyed_l, strict=True))
    sigma = {}

    def watch(now, window):
        if abs(now - 28.0) < 0.05:
            sigma["before"] = window.live(27.9).covariance[0, 0, 0]
            for name in names:
                window.add_control(name, given[name], np.full(3, 0.02), "control")
        if abs(now - 29.0) < 0.05:
            sigma["after"] = window.live(27.9).covariance[0, 0, 0]

    adjust_online(blind, poses, WindowOptions(window_s=NEVER), live=False, watch=watch, update_s=1.0)
    assert sigma["after"] < 0.5 * sigma["before"]


def test_options_are_checked():
    with pytest.raises(ValueError, match="window_s"):
        WindowOptions(window_s=-1.0)
    with pytest.raises(ValueError, match="grid_hz"):
        WindowOptions(grid_hz=0.0)
