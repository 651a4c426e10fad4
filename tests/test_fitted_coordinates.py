"""Additional parameters act where a ray meets its CCD line, not on the noise of its measured sample."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from adjustment_networks import CAMERA, simulate
from scipy.stats import chi2

from triline.solver.adjustment.adjustment import AdjustmentOptions, adjust, pose_problem, solve
from triline.solver.adjustment.linearisation import (
    MOST_SAMPLES,
    Whitening,
    fitted_coordinates,
    linearise,
    linearise_and_weigh,
    refresh_weights,
)
from triline.solver.models.dgr import DgrOptions
from triline.solver.models.wander import WanderOptions
from triline.solver.selfcalibration import tls
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


def test_the_residual_along_the_ccd_line_is_taken_out(network):
    rays, n = network.rays, len(network.rays)
    rng = np.random.default_rng(1)
    motion = np.stack([np.full(n, 9.0), rng.normal(0.0, 2.0, n)])  # a turning platform moves the image aslant
    samples, lines = rng.normal(0.0, 0.4, (2, n))
    residual = samples * rays.pitch_mm.T + 1e-3 * lines * motion
    wanted = rays.xy_mm.T - samples * rays.pitch_mm.T
    np.testing.assert_allclose(fitted_coordinates(rays, residual, motion, rays.pitch_mm.T), wanted, atol=1e-12)
    white = Whitening(np.stack([rng.uniform(50, 500, n), rng.normal(0, 50, n), rng.uniform(50, 500, n)]))
    whitened = (white.apply(a) for a in (residual, motion, rays.pitch_mm.T))
    np.testing.assert_allclose(fitted_coordinates(rays, *whitened), wanted, atol=1e-12)


def test_blunders_and_motion_along_the_line_go_nowhere(network):
    rays, n = network.rays, len(network.rays)
    motion = np.stack([np.full(n, 9.0), np.zeros(n)])
    far = fitted_coordinates(rays, 1e6 * rays.pitch_mm.T, motion, rays.pitch_mm.T)
    np.testing.assert_allclose(far, (rays.xy_mm - MOST_SAMPLES * rays.pitch_mm).T, atol=1e-9)
    along = fitted_coordinates(rays, rays.pitch_mm.T, 3.0 * rays.pitch_mm.T, rays.pitch_mm.T)
    np.testing.assert_array_equal(along, rays.xy_mm.T)


@pytest.mark.parametrize("keep", [False, True], ids=["motion", "pitch"])
def test_weighing_again_is_weighing_at_once(network, keep):
    problem = pose_problem(network, MODEL, tls(CAMERA))
    rays, u = network.rays, problem.layout.n_unknowns
    rng = np.random.default_rng(2)
    theta = 1e-4 * rng.normal(size=u)
    theta[problem.layout.n_model :] = 1e-2 * tls(CAMERA).apriori_sigma * rng.normal(size=problem.layout.n_camera)
    at = theta, network.approximate_l
    white = Whitening(np.stack([np.full(len(rays), 300.0), np.full(len(rays), 20.0), np.full(len(rays), 200.0)]))
    lin = linearise(rays, problem.layout, white, *at)
    again = refresh_weights(rays, problem.layout, white, lin, theta, keep)
    once = linearise_and_weigh(rays, problem.layout, *at, white if keep else None)
    np.testing.assert_allclose(again.whitening.g, once.whitening.g, rtol=1e-9)
    for name in ("residual", "orientation", "camera", "point"):
        a, b = getattr(again.linearisation, name), getattr(once.linearisation, name)
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-9 * np.abs(b).max())
    # and the equations are those of the layout that comes with them
    alike = linearise(rays, once.layout, once.whitening, *at)
    np.testing.assert_allclose(alike.residual, once.linearisation.residual, atol=1e-7)
    np.testing.assert_allclose(alike.camera, once.linearisation.camera)


@pytest.mark.parametrize("weights", ["motion", "pitch"])
def test_the_solution_has_them_at_its_own_residuals(network, weights):
    solution = adjust(network, MODEL, tls(CAMERA), AdjustmentOptions(weights))
    white, lin = solution.whitening, solution.linearisation
    again = refresh_weights(network.rays, solution.layout, white, lin, solution.state.theta, keep=True)
    assert solution.layout.camera is not None and again.layout.camera is not None
    moved = np.abs(again.linearisation.residual - lin.residual).max()
    assert moved < 1e-5
    measured = pose_problem(network, MODEL, tls(CAMERA)).layout.camera
    assert measured is not None
    assert np.abs(solution.layout.camera.coefficients - measured.coefficients).max() > 0.0
    rest = solve(solution.problem, solution, np.ones(len(network.rays)))
    assert rest.iterations == 0 and rest.cost == pytest.approx(solution.cost, rel=1e-9)


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


def test_coefficients_elsewhere_are_those_of_a_design_there(network):
    design = tls(CAMERA).design(network.rays.ccd, network.rays.sample, network.rays.xy_mm, network.rays.focal_length_mm)
    part = slice(5, 17)
    xy = network.rays.xy_mm.T + 0.5
    moved = replace(network.rays, xy_mm=xy.T)
    there = tls(CAMERA).design(moved.ccd, moved.sample, moved.xy_mm, moved.focal_length_mm)
    np.testing.assert_array_equal(design.coefficients_at(xy[:, part], part), there.coefficients[:, :, part])
