"""A clock that differs: its derivative, in the window and in the batch, and that it is found with its sigma."""

from dataclasses import replace

import numpy as np
import pytest

from triline.solver.adjustment.job import Job
from triline.solver.adjustment.job import run as run_batch
from triline.solver.adjustment.problem import pose_problem
from triline.solver.adjustment.refined_orientation import correction_cofactors, corrections_at
from triline.solver.geometry.rotation import corrected_angles, matrix_from_angles, quaternion_from_matrix
from triline.solver.geometry.trajectory import Trajectory
from triline.solver.models.platform import NO_PLATFORM_ERRORS, PlatformErrors
from triline.solver.models.wander import WanderOptions
from triline.solver.simulation.flight import FlightPlan
from triline.solver.simulation.flight_network import network_of
from triline.solver.simulation.misspecified_study import OBSERVED, SETTINGS
from triline.solver.simulation.misstated import World
from triline.solver.simulation.scenario import simulate
from triline.solver.simulation.window_study import adjust_online, navigate, orientation_errors, slow_errors_of
from triline.solver.window.results import WindowOptions

CLOCK_S = 0.005
PLAN = FlightPlan(strip_s=30.0, turns=False, lead_in_s=3.0, lead_out_s=2.0)
USUAL = PlatformErrors(clock_sigma_s=1e-3)


def swinging(t):
    """A trajectory (n,) that rolls, pitches and yaws at half a hertz."""
    angles = 0.05 * np.sin(3.0 * t[:, None] + np.array([0.0, 1.0, 2.0])) + np.array([0.0, 0.0, 0.7])
    position = np.column_stack([70.0 * t, 3.0 * np.sin(0.4 * t), 1500.0 + 0.0 * t])
    return Trajectory(t, position, quaternion_from_matrix(matrix_from_angles(*angles.T)))


@pytest.mark.parametrize("heading", [True, False])
def test_the_correction_is_the_way_of_the_platform_in_that_time(heading):
    path = swinging(np.arange(0.0, 20.0, 0.01))
    t = np.linspace(3.0, 17.0, 50)
    measured = path.at(t)
    change = USUAL.design(measured, path, heading).evaluate([CLOCK_S])
    turn = change[:, 3:]
    angles = corrected_angles(measured.angles, turn) if heading else measured.angles + turn
    truth = path.at(t + CLOCK_S)
    np.testing.assert_allclose(measured.position_l + change[:, :3], truth.position_l, atol=2e-4)
    # the rate is a mean over 0.1 s: half a per cent less at this frequency, beside the second order of 5 ms
    assert np.abs(angles - truth.angles).max() < 0.02 * np.abs(truth.angles - measured.angles).max()


def test_at_the_ends_of_a_trajectory_there_is_a_rate():
    path = swinging(np.arange(0.0, 5.0, 0.01))
    ends = np.array([path.start_s, path.end_s])
    change = USUAL.design(path.at(ends), path, False).evaluate([CLOCK_S])
    np.testing.assert_allclose(change[:, 3:], CLOCK_S * path.at(ends).angle_rate, atol=1e-4)


def test_the_lever_arm_moves_the_camera_along_its_own_axes_and_comes_after_the_clock():
    path = swinging(np.arange(0.0, 20.0, 0.01))
    measured, arm = path.at(np.linspace(3.0, 17.0, 50)), np.array([0.3, -0.2, 0.1])
    alone = PlatformErrors(lever_arm_sigma_m=0.05)
    both = PlatformErrors(clock_sigma_s=1e-3, lever_arm_sigma_m=0.05)
    assert both.unknown_names == ("clock", "lever x", "lever y", "lever z")
    np.testing.assert_array_equal(both.sigma, [1e-3, 0.05, 0.05, 0.05])
    moved = alone.design(measured, path, True).evaluate(arm)
    np.testing.assert_allclose(moved[:, :3], measured.R_lc @ arm, atol=1e-12)
    assert not moved[:, 3:].any()
    late = USUAL.design(measured, path, True).evaluate([CLOCK_S])
    np.testing.assert_allclose(both.design(measured, path, True).evaluate([CLOCK_S, *arm]), moved + late, atol=1e-12)


def test_strips_of_opposite_headings_find_the_lever_arm_in_window_and_batch():
    arm = np.array([0.3, -0.2, 0.0])  # height is like an offset all along
    plan = FlightPlan(strips=2, strip_s=25.0, turns=False, gap_s=4.0, lead_in_s=3.0, lead_out_s=2.0)
    simulation = simulate(plan, 2, SETTINGS["rtk"], OBSERVED, world=World(lever_arm_m=tuple(arm)))
    poses, unknown = navigate(simulation), PlatformErrors(lever_arm_sigma_m=0.3)
    found = []

    def watch(_, window):
        numbers = window.network.platform.numbers
        found.append((window.state.values(numbers), np.sqrt(np.diagonal(window.state.covariance(numbers)))))

    options = WindowOptions(grid_hz=4.0)
    adjust_online(simulation, poses, options, live=False, watch=watch, update_s=1.0, platform=unknown)
    network = network_of(simulation, poses)
    batch = run_batch(network, Job(WanderOptions(slow_errors_of(simulation.errors)), platform=unknown)).solution
    columns = batch.layout.platform_columns
    of_batch = batch.state.theta[columns], np.sqrt(batch.factor.variances()[columns])
    body_to_camera = simulation.mounting.R_bc.T  # the world states it in the body's axes
    for value, sigma in (found[-1], of_batch):
        assert (sigma[:2] < 0.12).all()  # of 0.3 m beforehand
        assert (np.abs(value + body_to_camera @ arm) < 3.5 * sigma)[:2].all()
    np.testing.assert_allclose(found[-1][0][:2], of_batch[0][:2], atol=2.0 * of_batch[1][:2].max())


def test_a_sigma_must_not_be_negative():
    with pytest.raises(ValueError, match="clock_sigma_s: wanted a sigma not below 0, got -1"):
        PlatformErrors(-1.0)


@pytest.fixture(scope="module")
def late():
    """A flight whose poses are stamped 5 ms late."""
    simulation = simulate(PLAN, 1, SETTINGS["rtk"], OBSERVED, world=World(clock_s=CLOCK_S))
    return simulation, navigate(simulation)


def test_the_window_finds_the_clock(late):
    simulation, poses = late
    values = []

    def watch(now_s, window):
        numbers = window.network.platform.numbers
        values.append((window.state.values(numbers)[0], window.state.covariance(numbers)[0, 0] ** 0.5))

    options = WindowOptions(grid_hz=4.0)
    online = adjust_online(simulation, poses, options, live=False, watch=watch, update_s=0.5, platform=USUAL)
    without = adjust_online(simulation, poses, options, live=False, update_s=0.5)
    value, sigma = values[-1]
    assert sigma < 1.2e-3 and abs(value - CLOCK_S) < 3.5 * sigma
    assert any(event.startswith("clock: poses are stamped") for event in online.events)
    told = [any(event.startswith("control and GNSS differ") for event in r.events) for r in (online, without)]
    assert told == [False, True]  # what the clock explains is no matter of the datum
    assert 0.4 < orientation_errors(simulation, online.whole).nees.mean() < 2.0


def test_no_clock_is_told_while_sigmas_are_being_found():
    """Looks are five times as noisy as stated; poses were told to be 24.7 +- 3.8 ms off, and it was not taken back."""
    simulation = simulate(PLAN, 1, SETTINGS["rtk"], OBSERVED, world=World(noise_factor=5.0))
    options = WindowOptions(grid_hz=4.0)
    online = adjust_online(simulation, navigate(simulation), options, live=False, update_s=0.5, platform=USUAL)
    assert online.window.network.sigmas.image > 3.0
    assert not any(event.startswith("clock: ") for event in online.events)


def test_the_batch_finds_the_clock_and_publishes_it(late):
    simulation, poses = late
    network = network_of(simulation, poses)
    model = WanderOptions(slow_errors_of(simulation.errors))
    found = run_batch(network, Job(model, platform=PlatformErrors(CLOCK_S)))
    layout = found.solution.layout
    (column,) = layout.platform_columns
    value, sigma = found.solution.state.theta[column], np.sqrt(found.solution.factor.variances()[column])
    assert sigma < 1.2e-3 and abs(value - CLOCK_S) < 3.5 * sigma
    t = np.linspace(6.0, 25.0, 20) + simulation.flight.strips[0].first_line_time_s - 3.0
    measured, truth = network.strips[0].trajectory.at(t), simulation.flight.truth.at(t)
    along = measured.position_l[:, 0] + corrections_at(found.solution, 0, t)[:, 0] - truth.position_l[:, 0]
    assert np.abs(along).mean() < 0.3 * 70.0 * CLOCK_S
    spread = np.sqrt(correction_cofactors(found.solution, 0, t)[:, 0, 0])
    assert (spread > 0.5 * 70.0 * sigma).all()


def test_an_unknown_of_several_terms_is_one_wherever_its_terms_stand(late):
    simulation, poses = late
    network, model = network_of(simulation, poses), WanderOptions(slow_errors_of(simulation.errors))
    platform = PlatformErrors(clock_sigma_s=1e-3, lever_arm_sigma_m=0.05)
    alone = run_batch(network, Job(model, platform=PlatformErrors(lever_arm_sigma_m=0.05))).solution
    with_clock = run_batch(network, Job(model, platform=replace(platform, clock_sigma_s=1e-9))).solution
    # a clock that is known to a nanosecond changes nothing, though the terms of the lever arm stand elsewhere
    same = with_clock.state.theta[with_clock.layout.platform_columns[1:]]
    np.testing.assert_allclose(same, alone.state.theta[alone.layout.platform_columns], atol=1e-6)


def test_normal_equations_hold_the_terms_of_one_unknown_together(late):
    simulation, poses = late
    problem = pose_problem(network_of(simulation, poses), WanderOptions(slow_errors_of(simulation.errors)), None, USUAL)
    layout = problem.layout
    rng = np.random.default_rng(1)
    theta = np.zeros(layout.n_unknowns)
    theta[layout.platform_columns] = 1e-3 * rng.standard_normal(1)
    change = layout.corrections(theta)
    rays = problem.network.rays
    np.testing.assert_allclose(change[:3], theta[layout.platform_columns] * rays.velocity_l.T, rtol=1e-9)


def test_a_platform_as_stated_adds_no_unknown(late):
    simulation, poses = late
    network, model = network_of(simulation, poses), WanderOptions(slow_errors_of(simulation.errors))
    plain, none = pose_problem(network, model), pose_problem(network, model, None, NO_PLATFORM_ERRORS)
    assert plain.layout.n_unknowns == none.layout.n_unknowns == plain.layout.n_of_sets
