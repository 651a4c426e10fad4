"""Tie points on a surface in the batch adjustment: the equation, what it tells, trees, a surface that is shifted."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from adjustment_networks import CAMERA, simulate
from noisy_surface import SHIFT_M, SIGMA_M, noisy_surface
from scipy.optimize import least_squares

from triline.solver.adjustment.job import Job, NotAdjustableError, run
from triline.solver.adjustment.linearisation import linearise
from triline.solver.adjustment.surface_control import SurfaceControl, SurfaceShift
from triline.solver.camera.self_calibration import tls
from triline.solver.models import MODELS
from triline.solver.orthoimage.surface import HeightField
from triline.solver.simulation.network import parallel_and_cross, scatter_points, simulate_network

#: Errors of the trajectory, as they are drawn and as they are stated: heights are known to 2 m.
ERRORS = MODELS["dgr"].from_settings(
    {"offset_sigma_m": [0.3, 0.3, 2.0], "shift_sigma_deg": [0.003] * 3, "drift_sigma_deg": [0.002] * 3}
)
JOB = Job(ERRORS)


def ground(x, y):
    """Of `regular_block`."""
    return 60 * np.sin(x / 700) + 40 * np.cos(y / 500)


def level(x, y):
    return np.zeros(np.broadcast_shapes(np.shape(x), np.shape(y)))


def block(seed, control=0, points=150):
    simulated = simulate(seed, ERRORS, points=points, control=control)
    return simulated.network, simulated.points_l


def adjusted(network, surface, job=JOB):
    return run(replace(network, surface=surface), job)


def height_error(result, truth):
    """Z of check points minus truth: RMSE and sigma."""
    check = result.network.check.point
    z = result.solution.state.points_l[check, 2] - truth[check, 2]
    return float(np.sqrt(np.mean(z**2))), float(np.sqrt(np.mean(result.point_sigma_m[check, 2] ** 2)))


def test_slope_is_that_of_the_ground_and_noise_alone_makes_none():
    rng = np.random.default_rng(1)
    x, y = rng.uniform(-1000, 1000, (2, 400))
    steep = SurfaceControl(ground, 10.0, 0.01, 1.0)
    wanted = np.stack([60 / 700 * np.cos(x / 700), -40 / 500 * np.sin(y / 500)], axis=1)
    assert steep.slope(x, y) == pytest.approx(wanted, abs=2e-4)
    axis = np.arange(-1100.0, 1100.0, 10.0)
    noise = HeightField(-1100.0, -1100.0, 10.0, rng.normal(0.0, 1.0, (len(axis),) * 2))
    said = SurfaceControl(noise.height, 10.0, 1.0, 1.0).slope(x, y)
    believed = SurfaceControl(noise.height, 10.0, 0.001, 1.0).slope(x, y)
    assert np.sqrt(np.mean(believed**2)) == pytest.approx(1.0 / (10.0 * np.sqrt(50.0)), rel=0.25)
    assert np.mean(said**2) < 0.2 * np.mean(believed**2)


def test_equation_of_a_point_is_the_height_of_the_surface_at_its_place():
    rng = np.random.default_rng(2)
    surface = SurfaceControl(ground, 10.0, 0.01, 1.0)
    there = np.column_stack([*rng.uniform(-1000, 1000, (2, 50)), rng.uniform(-50, 50, 50)])
    rows = surface.rows(there, np.arange(50) < 40)
    assert (rows.weight[:40] == 1e4).all() and not rows.weight[40:].any() and rows.n_observations == 40
    near = there + rng.uniform(-1.0, 1.0, there.shape)
    wanted = ground(near[:, 0], near[:, 1]) - near[:, 2] - 0.7  # a surface that lies 0.7 m too high
    assert rows.off(near, 0.7)[:40] == pytest.approx(wanted[:40], abs=5e-4)
    assert not rows.residual(near, 0.7)[40:].any()


def test_adjustment_is_that_of_a_general_solver():
    """Rays, a-priori equations, and heights of the ground as it is, not linearised, with derivatives by differences."""
    network, _ = block(5, points=40)
    result = adjusted(network, SurfaceControl(ground, 10.0, SIGMA_M, SHIFT_M))
    solution = result.solution
    rows, layout = solution.problem.control.surface, solution.layout
    assert rows is not None
    used = rows.weight > 0
    u, p = layout.n_unknowns, solution.network.n_points

    def residuals(values):
        theta, points = values[:u], values[u:].reshape(p, 3)
        rays = linearise(solution.network.rays, layout, solution.whitening, theta, points).residual
        x, y, z = points[used].T
        heights = (ground(x, y) - z - theta[-1]) * np.sqrt(rows.weight[used])
        return np.concatenate([rays.ravel(), solution.problem.prior.residual(theta), heights])

    scale = np.concatenate([np.sqrt(solution.factor.variances()), np.full(3 * p, 0.1)])
    start = np.concatenate([np.zeros(u), solution.state.points_l.ravel() + 0.5])
    found = least_squares(residuals, start, x_scale=scale, method="trf")
    points = found.x[u:].reshape(p, 3)
    sigma = result.point_sigma_m / result.sigma0
    assert np.abs((points - solution.state.points_l) / sigma).max() < 0.05
    spread = np.sqrt(np.diagonal(np.linalg.inv(found.jac.T @ found.jac)))
    assert spread[u:].reshape(p, 3) == pytest.approx(sigma, rel=0.02)
    assert spread[u - 1] == pytest.approx(np.sqrt(solution.factor.variances()[-1]), rel=0.02)
    assert found.x[u - 1] == pytest.approx(solution.state.theta[-1], abs=0.02 * spread[u - 1])
    assert 2 * found.cost == pytest.approx(solution.cost, rel=1e-3)


def test_a_block_without_control_gets_its_height_from_the_surface_with_an_honest_sigma():
    before, after, shifts, nees, groups = [], [], [], [], []
    for seed in range(24):
        network, truth = block(seed)
        rng = np.random.default_rng(1000 + seed)
        held = adjusted(network, noisy_surface(ground, truth, rng))
        before.append(height_error(run(network, JOB), truth))
        after.append(height_error(held, truth))
        check = held.network.check.point
        e = (held.solution.state.points_l - truth)[check].mean(axis=0)
        C = held.sigma0**2 * held.cofactors.points[check].mean(axis=0)  # they are off together
        nees.append(e @ np.linalg.solve(C, e) / 3)
        fit = held.surface
        assert fit is not None and not fit.shift.free
        shifts.append(fit.shift.w)
        groups.append(held.groups["surface"][1:])
        shares = [redundancy for _, _, redundancy in held.groups.values()]
        assert sum(shares) <= held.solution.redundancy + 0.1  # the shift's own equation is in none of the groups
        assert sum(shares) > held.solution.redundancy - 1.1
    squares, redundancy = np.sum(groups, axis=0)
    assert np.sqrt(squares / redundancy) == pytest.approx(1.0, abs=0.06)
    before, after = np.array(before), np.array(after)
    rmse = np.sqrt(np.mean(before[:, 0] ** 2)), np.sqrt(np.mean(after[:, 0] ** 2))
    assert rmse[0] > 0.8 and rmse[1] < 0.45
    assert 0.7 < rmse[1] / np.sqrt(np.mean(after[:, 1] ** 2)) < 1.35  # mostly one shift a block: 24 of them
    assert 0.6 < np.mean(nees) < 1.5
    assert 0.65 < np.sqrt(np.mean(np.square(shifts))) < 1.4


@pytest.mark.study
@pytest.mark.parametrize(("alike_m", "limit"), [(30.0, 1.2), (300.0, 1.35), (600.0, 1.6)])
def test_errors_of_the_surface_that_are_alike_over_some_distance(alike_m, limit):
    """The noise of heights counts as independent: where it is not, sigmas of X and Y are too small."""
    squares = []
    for seed in range(24):
        network, truth = block(seed)
        rng = np.random.default_rng(2000 + seed)
        result = adjusted(network, noisy_surface(ground, truth, rng, alike_m=alike_m))
        check = result.network.check.point
        e = (result.solution.state.points_l - truth)[check]
        squares.append([(e**2).mean(axis=0), (result.point_sigma_m[check] ** 2).mean(axis=0)])
    rmse, sigma = np.mean(squares, axis=0)
    ratio = np.sqrt(rmse / sigma)
    print(f"alike over {alike_m:g} m: RMSE/sigma of X, Y, Z", ratio.round(2))
    assert (ratio > 0.7).all() and (ratio < limit).all() and ratio[2] < 1.3


@pytest.mark.parametrize("noise", [False, True])
def test_level_ground_tells_nothing_of_the_plane_and_relief_does(noise):
    lines = parallel_and_cross(CAMERA, 1800.0, 2, 1, 3000.0)
    change = []
    for relief in (level, lambda x, y: 120 * np.sin(x / 300) + 120 * np.cos(y / 300)):
        rng = np.random.default_rng(3)
        xyz = scatter_points(150, (-1500, 1500, -1000, 1000), relief, rng)
        simulated = simulate_network(CAMERA, lines, xyz, {}, range(0, 150, 7), ERRORS, rng)
        surface = SurfaceControl(relief, 15.0, SIGMA_M, SHIFT_M)
        if noise:
            surface = noisy_surface(relief, simulated.points_l, rng)
        sigma = [
            (r.point_sigma_m[:, :2] / r.sigma0).mean(axis=0)
            for r in (adjusted(simulated.network, s) for s in (None, surface))
        ]
        change.append(sigma[1] / sigma[0])
    assert change[0] == pytest.approx([1.0, 1.0], abs=0.03)
    assert (change[1] < 0.8).all()


def test_points_on_trees_do_not_lift_the_block():
    errors = []
    for seed in range(6):
        network, truth = block(seed)
        rng = np.random.default_rng(50 + seed)
        trees = rng.choice(len(truth), len(truth) // 10, replace=False)
        clean = adjusted(network, noisy_surface(ground, truth, np.random.default_rng(seed)))
        wooded = adjusted(network, noisy_surface(ground, truth, np.random.default_rng(seed), trees=trees))
        fit = wooded.surface
        assert fit is not None
        stand = np.isin(np.arange(len(truth)), trees) & np.isfinite(fit.off_m)
        assert (fit.weight[stand] < 0.05).all() and stand.sum() >= 8
        assert (fit.weight[np.isfinite(fit.off_m) & ~stand] > 0.5).mean() > 0.9
        errors.append([height_error(r, truth)[0] for r in (clean, wooded)])
        assert abs(errors[-1][0] - errors[-1][1]) < 0.06  # 15 m on a tenth of them would lift it by 1.5 m
    assert np.mean(np.square(errors), axis=0)[1] < 1.2 * np.mean(np.square(errors), axis=0)[0]


@pytest.mark.parametrize("control", [0, 5])
def test_a_surface_that_is_shifted_is_told_and_holds_no_height(control):
    network, truth = block(9, control)
    surface = noisy_surface(ground, truth, np.random.default_rng(3), shift_m=20.0)
    result, alone = adjusted(network, surface), run(network, JOB)
    fit = result.surface
    assert fit is not None and fit.shift.free
    assert abs(fit.shift.shift_m - 20.0) < 3.5 * fit.shift.sigma_m < 6.0
    assert fit.shift.w > 8
    (rmse, sigma), (_, sigma_alone) = height_error(result, truth), height_error(alone, truth)
    assert rmse < 3.0 * sigma and sigma == pytest.approx(sigma_alone, rel=0.15)


def test_the_test_of_the_shift_is_that_of_its_a_priori_equation():
    stated, other, value = 0.5, 2.0, 6.0  # the others alone say 6 +- 2 m
    weight = stated**-2 + other**-2
    with_it = SurfaceShift.of(value * other**-2 / weight, 1 / weight, stated, was_free=False)
    free = SurfaceShift.of(value, other**2, stated, was_free=True)
    for shift in (with_it, free):
        assert (shift.shift_m, shift.sigma_m) == pytest.approx((value, other))
        assert shift.w == pytest.approx(value / np.hypot(stated, other))
        assert not shift.free
    assert SurfaceShift.of(7.0, other**2, stated, was_free=True).free


def test_snooping_and_self_calibration_go_with_a_surface():
    network, truth = block(4, control=5)
    surface = noisy_surface(ground, truth, np.random.default_rng(8))
    result = adjusted(network, surface, Job(ERRORS, self_calibration=tls(network.camera), snoop=True))
    assert result.solution.converged and result.surface is not None
    assert len(result.solution.camera_parameters) == result.solution.layout.n_camera
    assert result.test.sigma0 == pytest.approx(1.0, abs=0.15)
    assert len(result.removed) + result.solution.layout.n_camera == len(tls(network.camera).unknown_names)


def test_a_surface_without_heights_below_the_points_is_refused():
    network, _ = block(1)
    nowhere = SurfaceControl(
        lambda x, y: np.full(np.broadcast_shapes(np.shape(x), np.shape(y)), np.nan), 10.0, 1.0, 1.0
    )
    with pytest.raises(NotAdjustableError, match="no height below any tie point"):
        adjusted(network, nowhere)
    with pytest.raises(ValueError, match="shift_sigma_m of a surface is 0, wanted more than 0"):
        SurfaceControl(ground, 10.0, 1.0, 0.0)


def test_a_second_model_goes_on_with_the_surface():
    network, truth = block(6)
    surface = noisy_surface(ground, truth, np.random.default_rng(8), shift_m=20.0)
    result = adjusted(network, surface, Job(ERRORS, replace(ERRORS)))
    assert len(result.stages) == 2 and result.solution.converged
    assert result.surface is not None and result.surface.shift.free
    once = adjusted(network, surface)
    apart = result.solution.state.points_l - once.solution.state.points_l
    assert np.abs(apart).max() < 0.1 * once.point_sigma_m.max()
