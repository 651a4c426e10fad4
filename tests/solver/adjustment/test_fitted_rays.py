"""With additional parameters rays are linearised where they are by what is known of them, not on their noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from adjustment_networks import CAMERA, simulate
from scipy.stats import chi2

from triline.solver.adjustment.adjustment import AdjustmentOptions, adjust, pose_problem, solve
from triline.solver.adjustment.linearisation import (
    MOST_PIXELS,
    Whitening,
    fit_rays,
    linearise,
    linearise_and_weigh,
)
from triline.solver.camera.self_calibration import tls
from triline.solver.models.dgr import DgrOptions
from triline.solver.models.wander import WanderOptions
from triline.solver.simulation.camera_errors import drawn_parameters, simulate_with_camera_errors
from triline.solver.simulation.error_models import ErrorModel
from triline.solver.simulation.flight import FlightPlan
from triline.solver.simulation.flight_network import network_of
from triline.solver.simulation.scenario import ObservationPlan
from triline.solver.simulation.window_study import navigate, slow_errors_of

MODEL = DgrOptions()


@pytest.fixture(scope="module")
def network():
    return simulate(3, MODEL, points=40).network


@pytest.fixture(scope="module")
def there(network):
    """A problem, and values of its unknowns."""
    problem, rng = pose_problem(network, MODEL, tls(CAMERA)), np.random.default_rng(2)
    theta = 1e-4 * rng.normal(size=problem.layout.n_unknowns)
    theta[problem.layout.n_model :] = 1e-2 * tls(CAMERA).apriori_sigma * rng.normal(size=problem.layout.n_camera)
    return problem, theta, network.approximate_l


def bare(rays, layout, theta, points):
    """Residuals (2, n) in mm, image motion (2, n) in mm/s, derivatives to the orientation (2, 6, n)."""
    one = np.ones(len(rays))
    lin = linearise(rays, layout, Whitening(np.stack([one, 0.0 * one, one])), theta, points)
    rates = np.concatenate([rays.velocity_l.T, rays.angle_rate.T])
    return lin.residual, np.einsum("ckn,kn->cn", lin.orientation, rates), lin.orientation


def test_a_residual_is_taken_apart_into_lines_and_samples(network, there):
    problem, theta, points = there
    rays, n, rng = network.rays, len(network.rays), np.random.default_rng(1)
    residual, motion, _ = bare(rays, problem.layout, theta, points)
    later, samples = 2e-4 * rng.normal(size=n), 0.4 * rng.normal(size=n)
    spoilt = replace(rays, xy_mm=rays.xy_mm + (later * motion + samples * rays.pitch_mm.T - residual).T)
    fitted = fit_rays(spoilt, problem.layout, theta, points)
    assert fitted.shift is not None and fitted.camera is not None and problem.layout.camera is not None
    wanted = later[:, None] * np.hstack([rays.velocity_l, rays.angle_rate])
    np.testing.assert_allclose(fitted.shift.orientation, wanted, rtol=1e-5, atol=1e-9)
    np.testing.assert_allclose(fitted.shift.image_mm, later * motion, atol=1e-9)
    on_line = spoilt.xy_mm.T - samples * rays.pitch_mm.T
    np.testing.assert_allclose(fitted.camera.xy_mm, on_line, rtol=1e-5)


def test_noise_of_the_orientation_takes_its_part(network, there):
    """By its share of the covariance, direction by direction; the parts add up to the residual."""
    problem, theta, points = there
    noise = np.diag(np.square([0.05, 0.03, 0.02, 1e-5, 1e-5, 2e-5]))
    rays = replace(network.rays, orientation_noise=np.broadcast_to(noise, (len(network.rays), 6, 6)))
    residual, motion, J = bare(rays, problem.layout, theta, points)
    shift = fit_rays(rays, problem.layout, theta, points).shift
    assert shift is not None
    of_lines, of_samples = motion * rays.line_period_s * rays.sigma_line_px, rays.pitch_mm.T * rays.sigma_sample_px
    for i in range(0, len(rays), 7):
        image = np.outer(of_lines[:, i], of_lines[:, i]) + np.outer(of_samples[:, i], of_samples[:, i])
        multiplier = np.linalg.solve(image + J[:, :, i] @ noise @ J[:, :, i].T, residual[:, i])
        later = (rays.line_period_s * rays.sigma_line_px)[i] ** 2 * motion[:, i] @ multiplier
        wanted = noise @ J[:, :, i].T @ multiplier + later * np.append(rays.velocity_l[i], rays.angle_rate[i])
        np.testing.assert_allclose(shift.orientation[i], wanted, rtol=1e-8, atol=1e-12)
        samples = rays.sigma_sample_px[i] ** 2 * rays.pitch_mm[i] @ multiplier
        np.testing.assert_allclose(shift.image_mm[:, i] + samples * rays.pitch_mm[i], residual[:, i], atol=1e-12)


def test_blunders_do_not_take_rays_far(network, there):
    problem, theta, points = there
    spoilt = replace(network.rays, xy_mm=network.rays.xy_mm + 40.0)
    shift = fit_rays(spoilt, problem.layout, theta, points).shift
    assert shift is not None
    most = 1.001 * MOST_PIXELS * spoilt.line_period_s * np.linalg.norm(spoilt.velocity_l, axis=1)
    assert (np.linalg.norm(shift.orientation[:, :3], axis=1) <= most).all()


def test_without_additional_parameters_rays_stay_where_they_were_measured(network):
    layout = pose_problem(network, MODEL).layout
    assert fit_rays(network.rays, layout, np.zeros(layout.n_unknowns), network.approximate_l) is layout
    assert adjust(network, MODEL).layout.shift is None


@pytest.mark.parametrize("keep", [False, True], ids=["motion", "pitch"])
def test_the_equations_are_those_of_the_layout_that_comes_with_them(network, there, keep):
    problem, theta, points = there
    n = len(network.rays)
    white = Whitening(np.stack([np.full(n, 300.0), np.full(n, 20.0), np.full(n, 200.0)])) if keep else None
    whitening, lin, layout = linearise_and_weigh(network.rays, problem.layout, theta, points, white)
    assert (whitening is white) == keep
    again = linearise(network.rays, layout, whitening, theta, points)
    for name in ("residual", "orientation", "camera", "point"):
        np.testing.assert_allclose(getattr(again, name), getattr(lin, name), rtol=1e-9, atol=1e-9)
    # what is taken apart here is the residual at the measured values, but for its square
    before, _, _ = bare(network.rays, problem.layout, theta, points)
    after, _, _ = bare(network.rays, layout, theta, points)
    assert np.abs(after - before).max() < 0.02 * np.abs(before).max()


@pytest.mark.parametrize("weights", ["motion", "pitch"])
def test_the_solution_has_rays_at_its_own_residuals(network, weights):
    solution = adjust(network, MODEL, tls(CAMERA), AdjustmentOptions(weights))
    at = solution.state.theta, solution.state.points_l
    again = fit_rays(network.rays, solution.layout, *at)
    now, wanted = solution.layout.shift, again.shift
    assert now is not None and wanted is not None
    assert np.abs(now.image_mm - wanted.image_mm).max() < 1e-2 * np.abs(wanted.image_mm).max()
    rest = solve(solution.problem, solution, np.ones(len(network.rays)))
    assert rest.iterations == 0 and rest.cost == pytest.approx(solution.cost, rel=1e-9)


@pytest.mark.study
def test_dense_rays_of_a_batch_do_not_decide_the_scale():
    """100 tie points a second: on measured coordinates the image comes out too small, and NEES of parameters is 1.6."""
    squares, off, stated = [], [], tls(FlightPlan().camera).scaled(0.1)
    for seed in range(1, 9):
        plan = FlightPlan(strip_s=40.0, lead_in_s=3.0, lead_out_s=2.0)
        errors, ties = ErrorModel(attitude_rate_hz=100.0), ObservationPlan(tie_points_per_s=100.0)
        simulation = simulate_with_camera_errors(plan, seed, stated, errors, ties)
        strip = simulation.flight.strips[0]
        during = strip.first_line_time_s - 0.5, float(strip.time_of(strip.lines)) + 0.5
        poses = [p for p in navigate(simulation) if during[0] < p.pose.time_s < during[1]]
        network = network_of(simulation, poses)
        solution = adjust(network, WanderOptions(slow_errors_of(simulation.errors)), stated)
        columns = np.arange(solution.layout.n_model, solution.layout.n_unknowns)
        Q = solution.factor.cofactors(columns)
        s = np.sqrt(np.diag(Q))
        e = (solution.camera_parameters - drawn_parameters(seed, stated)) / s
        squares.append(e @ np.linalg.solve(Q / np.outer(s, s), e))
        off.append(e[[stated.unknown_names.index(f"sy_{line}") for line in "BNF"]].mean())
    low, high = chi2.ppf([0.005, 0.995], 18 * len(squares)) / (18 * len(squares))
    assert low < np.sum(squares) / (18 * len(squares)) < high, squares
    assert abs(np.mean(off)) < 1.0, off
