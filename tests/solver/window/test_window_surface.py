"""Tie points on an elevation model in the sliding window: as the batch adjustment, trees, a shift, and the light."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from noisy_surface import surface_below
from three_strips import PLAN, SENSORS

from triline.solver.simulation.scenario import ObservationPlan, simulate
from triline.solver.simulation.window_study import adjust_at_once, adjust_online, navigate, point_errors
from triline.solver.window.quality.light import WEAK
from triline.solver.window.results import WindowOptions

#: Heights are known to 2.5 m, of which 2 m stay over a strip.
ERRORS = replace(SENSORS, offset_sigma_m=(0.3, 0.3, 2.0))
OPTIONS = WindowOptions(snoop=False, settle_s=1.0, grid_hz=4.0)
STRIPS = replace(PLAN, cross_strips=0, strip_s=16.0)
ONE = replace(STRIPS, strips=1)
TIES = ObservationPlan(tie_points_per_s=4.0, control=0, check=8)


def flown(plan, seed):
    simulation = simulate(plan, seed, ERRORS, TIES)
    return simulation, navigate(simulation)


def online(flight, surface, options=OPTIONS):
    return adjust_online(*flight, options, live=False, update_s=1.0, surface=surface)


def height_error(simulation, points):
    """Mean error of Z of all points, and its RMS sigma."""
    e = point_errors(simulation, points)
    return float(e.error[:, 2].mean()), float(np.sqrt(np.mean(e.covariance[:, 2, 2])))


@pytest.fixture(scope="module")
def two():
    flight = flown(STRIPS, 3)
    return flight, surface_below(flight[0], 3)


def test_whole_strips_are_those_of_the_batch_adjustment(two):
    flight, surface = two
    live, batch = online(flight, surface), adjust_at_once(*flight, OPTIONS, surface=surface)
    told = {p.name: p for p in live.reports[-1].parameters or live.reports[-10].parameters}
    assert told["shift of the surface"].unit == "m"
    assert live.whole_points.keys() == batch.final_points.keys()
    for name, point in live.whole_points.items():
        wanted = batch.final_points[name]
        sigma = np.sqrt(np.diag(wanted.covariance))
        assert np.abs((point.xyz_l - wanted.xyz_l) / sigma).max() < 0.25, name
        assert np.sqrt(np.diag(point.covariance)) == pytest.approx(sigma, rel=0.03)
    assert sum(p.rays > 3 for p in live.whole_points.values()) > 20
    shifts = [(r.window.network.surface.shift_m, r.window.network.surface.free) for r in (live, batch)]
    assert shifts[0] == (pytest.approx(shifts[1][0], abs=0.03), False)
    # what becomes final on the way has the height of the surface, too
    assert abs(height_error(flight[0], live.final_points)[0]) < 3 * height_error(flight[0], live.final_points)[1] < 1.2
    assert height_error(flight[0], adjust_at_once(*flight, OPTIONS).final_points)[1] > 1.2


def test_it_is_the_same_adjustment_as_that_of_a_block(two):
    """`triline adjust` and the window know the same of heights, each with its own model of the trajectory's noise."""
    from triline.solver.adjustment.job import Job, run
    from triline.solver.models import MODELS
    from triline.solver.simulation.flight_network import network_of

    (simulation, poses), surface = two
    window = adjust_at_once(simulation, poses, OPTIONS, surface=surface)
    errors = simulation.errors
    model = MODELS["wander"].from_settings(
        {
            "offset_sigma_m": errors.offset_sigma_m, "shift_sigma_deg": errors.shift_sigma_deg,
            "drift_sigma_deg": errors.drift_sigma_deg, "wander_sigma_m": errors.wander_sigma_m,
            "wander_sigma_deg": errors.wander_sigma_deg, "wander_time_s": errors.wander_time_s,
        }
    )  # fmt: skip
    network = replace(network_of(simulation, poses), surface=surface)
    result = run(network, Job(model))
    index, points, sigma = network.point_index, result.solution.state.points_l, result.point_sigma_m / result.sigma0
    apart, ratio = [], []
    for name, point in window.final_points.items():
        s = np.sqrt(np.diag(point.covariance))
        apart.append((points[index[name]] - point.xyz_l) / s)
        ratio.append(sigma[index[name]] / s)
    assert np.sqrt(np.mean(np.square(apart), axis=0)).max() < 0.35
    assert np.median(ratio, axis=0) == pytest.approx([1.0] * 3, abs=0.12)


def test_error_of_height_is_that_of_its_sigma_over_flights():
    ratios, before = [], []
    for seed in range(20, 32):
        flight = flown(ONE, seed)
        surface = surface_below(flight[0], seed)
        mean, sigma = height_error(flight[0], adjust_at_once(*flight, OPTIONS, surface=surface).final_points)
        assert sigma < 0.45
        ratios.append(mean / sigma)
        if seed < 24:  # of the flights themselves, whatever the surface does
            before.append(abs(height_error(flight[0], adjust_at_once(*flight, OPTIONS).final_points)[0]))
    assert 0.55 < np.sqrt(np.mean(np.square(ratios))) < 1.5  # 12 draws
    assert np.sqrt(np.mean(np.square(before))) > 1.0


def test_points_on_trees_do_not_lift_the_strip():
    flight = flown(ONE, 5)
    tied = np.flatnonzero(flight[0].points.role == "tie")
    rng = np.random.default_rng(1)
    trees = rng.choice(tied, len(tied) // 10, replace=False)
    found = []
    for wood in (None, trees):
        surface = surface_below(flight[0], 5, trees=wood)
        result = online(flight, surface)
        found.append((height_error(flight[0], result.final_points)[0], height_error(flight[0], result.whole_points)[0]))
    assert np.abs(np.subtract(*found)).max() < 0.1, found


def test_a_shifted_surface_is_told_and_the_light_is_not_good_with_it():
    flight = flown(ONE, 6)
    surface = surface_below(flight[0], 6, shift_m=20.0)
    result = online(flight, surface, replace(OPTIONS, snoop=True))
    mean, sigma = height_error(flight[0], result.final_points)
    assert sigma > 1.0 and abs(mean) < 3 * sigma
    warnings = [w for w in result.events if "elevation model is" in w]
    assert len(warnings) == 1 and "above GNSS and control: its vertical datum?" in warnings[0]
    said = float(warnings[0].split("elevation model is ")[1].split()[0])
    assert abs(said - 20.0) < 8.0
    late = result.reports[-1].quality
    assert late.light == WEAK and "elevation model" in late.reason
    assert result.window.network.surface.free


def test_where_the_surface_alone_holds_the_height_its_error_is_in_the_protection_level():
    flight = flown(ONE, 7)
    surface = surface_below(flight[0], 7)
    with_it = online(flight, surface, replace(OPTIONS, snoop=True))
    quality = [r.quality for r in with_it.reports if r.quality and r.quality.exposure is not None][-3]
    assert quality.exposure.observation == "height of the elevation model as a whole"
    assert quality.ground_sigma_m[2] < 1.2
    # GNSS knows the height to 2.5 m, so a shift of four times that would hardly be seen
    assert 4.0 < quality.ground_protection_m[2] < 15.0


def test_a_surface_that_lies_elsewhere_is_told_and_changes_nothing():
    flight = flown(replace(ONE, strip_s=12.0), 10)
    nothing = replace(
        surface_below(flight[0], 10), height=lambda x, y: np.full(np.broadcast_shapes(x.shape, y.shape), np.nan)
    )
    result, alone = online(flight, nothing), online(flight, None)
    assert [e for e in result.events if "no height below" in e] == [e for e in result.events if "elevation" in e]
    assert sum("no height below the tie points" in e for e in result.events) == 1
    for name, point in alone.final_points.items():
        assert result.final_points[name].xyz_l == pytest.approx(point.xyz_l, abs=1e-6)


def test_control_counts_beside_the_surface():
    simulation = simulate(ONE, 8, ERRORS, replace(TIES, control=4))
    flight = simulation, navigate(simulation)
    surface = surface_below(simulation, 8, shift_m=3.0)
    result = online(flight, surface, replace(OPTIONS, snoop=True))
    assert result.window.network.surface.free  # 3 m off control, 10 sigma
    assert result.window.network.surface.shift_m == pytest.approx(3.0, abs=0.4)
    mean, sigma = height_error(simulation, result.final_points)
    assert abs(mean) < 0.25 and sigma < 0.5
