"""What corrections leave of the noise of smoothed positions, and where additional parameters act."""

from __future__ import annotations

import numpy as np
import pytest

from triline.solver.adjustment.adjustment import solve
from triline.solver.adjustment.job import Job, run
from triline.solver.adjustment.pose_noise import followed, in_step, share_left, with_noise_left
from triline.solver.adjustment.problem import pose_problem
from triline.solver.adjustment.robust import Huber
from triline.solver.camera.self_calibration import tls
from triline.solver.navigation.kinematic_model import noise_time
from triline.solver.simulation.flight import FlightPlan
from triline.solver.simulation.flight_network import network_of
from triline.solver.simulation.scenario import ObservationPlan, simulate
from triline.solver.simulation.window_study import adjust_at_once, adjust_online, navigate, slow_errors_of
from triline.solver.window.datum.drift_monitor import design_effect
from triline.solver.window.results import WindowOptions
from triline.solver.window.state.strip import model_options

JERK_PSD, FIX_DENSITY = 1.0, 1.8e-4


def noise_covariance(lag_s: np.ndarray) -> np.ndarray:
    """Of the error of a Wiener smoother of white jerk, by its spectrum; 1 at lag 0."""
    w = np.linspace(0.0, 60.0, 6001)
    spectrum = 1.0 / (1.0 + w**6 * FIX_DENSITY / JERK_PSD)
    spectrum[0] /= 2.0  # by the trapezoidal rule
    return np.cos(np.multiply.outer(lag_s, w)) @ spectrum / spectrum.sum()


def test_noise_time_is_the_lag_at_which_the_error_is_correlated_by_one_over_e():
    assert noise_covariance(np.array(noise_time(JERK_PSD, FIX_DENSITY))) == pytest.approx(np.exp(-1.0), abs=2e-3)


@pytest.mark.parametrize("information", [1e2, 6.6e3, 4e5])
def test_the_share_is_what_a_least_squares_correction_leaves(information):
    """The correction of a twice integrated white noise from white observations, as one system of equations."""
    step_s, n, density = 0.08, 500, 1.46e-3
    second = np.diff(np.eye(n), 2, axis=0) / step_s**1.5  # each of variance `density`
    rays = information * step_s * np.eye(n)
    taken = np.linalg.solve(rays + second.T @ second / density, rays)
    lag_s = step_s * np.arange(n)
    noise = noise_covariance(lag_s)[np.abs(np.subtract.outer(np.arange(n), np.arange(n)))]
    rest = np.eye(n) - taken
    middle = slice(n // 3, 2 * n // 3)
    left = np.diagonal(rest @ noise @ rest.T)[middle].mean()
    bandwidth = (density * information) ** 0.25
    assert share_left(bandwidth, noise_time(JERK_PSD, FIX_DENSITY)) == pytest.approx(left, abs=0.02)
    assert 0.02 < left < 0.95


@pytest.mark.parametrize("rate_hz", [0.5, 5.0, 20.0])
def test_rays_share_the_noise_of_positions_that_nothing_follows(rate_hz):
    """The variance of the mean of many rays over that of as many independent ones."""
    n, share = int(100.0 * rate_hz), 0.4
    pairs = np.abs(np.subtract.outer(np.arange(n), np.arange(n)))
    together = (share * noise_covariance(np.arange(n) / rate_hz)[pairs]).sum() / n + 1.0 - share
    time_s = noise_time(JERK_PSD, FIX_DENSITY)
    effect = design_effect(rate_hz, share, time_s, follows=False)
    # one is the ray itself, which is in the integral as well
    assert max(together, 1.0) <= effect <= together + share + 0.01
    assert design_effect(rate_hz, share, time_s, follows=True) <= effect


def test_each_direction_is_followed_by_its_own_information():
    density = np.array([1e-3, 1e-3, 4e-3, 1e-9, 1e-9, 1e-9])
    information = np.diag([1e3, 0.0, 1e4, 1.0, 1.0, 1.0])
    left = followed(information, density, 0.5)
    want = np.sqrt(share_left([1.0, 0.0, 40.0**0.25], 0.5))
    assert np.diagonal(left)[:3] == pytest.approx(want, rel=1e-6)
    assert np.abs(left - np.diag(np.diagonal(left))).max() < 1e-12
    seen = np.array([1.0, 0.0, 0.0, 0.0, -1500.0, 0.0])  # X and phi, as a ray from 1500 m sees them together
    together = followed(500.0 * np.outer(seen, seen), density, 0.5)
    wanders = density[0] + 1500.0**2 * density[4]
    assert seen @ together[:, 0] == pytest.approx(np.sqrt(share_left((500.0 * wanders) ** 0.25, 0.5)), rel=1e-6)
    assert together[4, 0] > 1e-6  # attitude takes its part
    for nothing in (followed(information, density, 0.0), followed(information, 0.0 * density, 0.5)):
        assert (nothing == np.eye(6)).all()


@pytest.mark.study
def test_many_rays_without_control_do_not_make_the_image_small():
    """Before control the scale is known by the jitter of the attitude alone; noise must not decide it.

    Where additional parameters act on the noise of the samples as well, these three are 3.0, 2.7 and 4.0 sigma off,
    all to the same side.
    """
    off = []
    for seed in (1, 2, 4):
        plan = FlightPlan(strip_s=40.0)
        stated = tls(plan.camera)
        simulation = simulate(plan, seed, observation_plan=ObservationPlan(tie_points_per_s=30.0, control=0, check=0))
        options = WindowOptions(window_s=1e3, grid_hz=1.0)
        result = adjust_online(simulation, navigate(simulation), options, stated, live=False, update_s=1.0)
        known = next(r.parameters for r in reversed(result.reports) if r.parameters)
        off.append(np.mean([p.value / p.sigma for p in known if p.name.startswith("sy")]))
    assert abs(np.mean(off)) < 1.5, off


def test_robust_weights_of_rays_that_are_weighed_anew_are_those_of_their_function():
    plan = FlightPlan(height_m=800.0, strip_s=12.0, lead_in_s=3.0, lead_out_s=2.0)
    flown = simulate(plan, 3, observation_plan=ObservationPlan(tie_points_per_s=15.0))
    model = model_options(slow_errors_of(flown.errors), WindowOptions(snoop=False), plan.strip_s)
    found = run(network_of(flown, navigate(flown)), Job(model, robust=Huber(1.0))).solution
    wanted = Huber(1.0)(np.abs(found.linearisation.residual).max(axis=0))
    assert (wanted < 0.7).sum() > 20
    np.testing.assert_allclose(found.ray_weight, wanted, rtol=1e-2)


def test_the_batch_adjustment_states_as_much_of_the_noise_as_the_window_does():
    """Low and dense, so that the corrections follow much of it; two estimators, one answer."""
    plan = FlightPlan(height_m=800.0, strip_s=12.0, lead_in_s=3.0, lead_out_s=2.0)
    flown = simulate(plan, 3, observation_plan=ObservationPlan(tie_points_per_s=15.0))
    poses = navigate(flown)
    options = WindowOptions(snoop=False)
    network = network_of(flown, poses)
    model = model_options(slow_errors_of(flown.errors), options, plan.strip_s)
    whole = solve(pose_problem(network, model))
    found = run(network, Job(model)).solution
    rays, stated = found.network.rays, with_noise_left(network, found)
    assert stated is not None
    # nothing changes any more when it is looked at again
    left_out = found.problem.layout.sets[0].model.left_out_variance(rays.time_s)[:, :, None] * np.eye(6)
    np.testing.assert_allclose(stated.rays.orientation_noise + left_out, rays.orientation_noise, rtol=0.05, atol=1e-12)
    share = np.sqrt(
        np.einsum("nii->ni", stated.rays.orientation_noise) / np.einsum("nii->ni", network.rays.orientation_noise)
    )[:, :3]
    window = adjust_at_once(flown, poses, options).window
    assert window is not None
    by_window = np.diagonal(window.network.pose_noise.usual)[:3]
    assert np.median(share, axis=0) == pytest.approx(by_window, rel=0.15) and by_window.max() < 0.8
    assert whole.sigma0 < found.sigma0 - 0.05 and found.sigma0 == pytest.approx(1.0, abs=0.12)


def test_looks_in_step_say_less_than_they_count():
    """Three looks at each of many points, of a sine at a random phase, in all delays between the views."""
    phase = np.random.default_rng(5).uniform(0.0, 2.0 * np.pi, (400, 1, 1))
    first, second = np.meshgrid(np.linspace(0.0, 2.0 * np.pi, 49), np.linspace(0.0, 2.0 * np.pi, 49))
    F, N, B = np.sin(phase), np.sin(phase + first), np.sin(phase + first + second)
    of_contrast = ((F - 2.0 * N + B) ** 2).mean(axis=0) / (6.0 * 0.5)
    assert of_contrast.max() == pytest.approx(in_step(1.0), rel=0.05)
    assert of_contrast.mean() == pytest.approx(1.0, rel=0.05)  # over all delays they are as independent ones
    assert in_step(0.0) == 1.0
