"""A heading that is wrong by degrees: it is wrong about the vertical, and turns what is measured of the tilt."""

import copy
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from triline.solver.geometry.rotation import corrected_angles, matrix_from_angles, measured_angles
from triline.solver.simulation.error_models import ErrorModel
from triline.solver.simulation.flight import FlightPlan
from triline.solver.simulation.scenario import ObservationPlan, simulate
from triline.solver.simulation.window_study import adjust_online, navigate, orientation_errors
from triline.solver.window.results import WindowOptions

RNG = np.random.default_rng(3)
TILTED = np.column_stack([RNG.uniform(-0.05, 0.05, (50, 2)), RNG.uniform(-3, 3, 50)])
#: What is tilted most is seen best.
PLAN = FlightPlan(strip_s=30.0, lead_in_s=3.0, lead_out_s=2.0, turbulence=3.0)
SENSORS = ErrorModel(attitude_rate_hz=100.0, shift_sigma_deg=(0.02, 0.02, 3.0))
TIES = ObservationPlan(tie_points_per_s=6.0, image_sigma_px=0.1, check=0)
WRONG = np.radians(3.0)


def test_a_correction_of_kappa_turns_about_the_vertical():
    turn = RNG.uniform(-0.1, 0.1, 50)
    turned = corrected_angles(TILTED, np.column_stack([np.zeros((50, 2)), turn]))
    expected = Rotation.from_rotvec(np.outer(turn, [0, 0, 1])).as_matrix() @ matrix_from_angles(*TILTED.T)
    assert np.abs(matrix_from_angles(*turned.T) - expected).max() < 3e-4
    assert np.abs(matrix_from_angles(*turned.T)[:, :, 2] - expected[:, :, 2]).max() < 2e-5
    plain = matrix_from_angles(*(TILTED + np.column_stack([np.zeros((50, 2)), turn])).T)
    assert np.abs(plain[:, :, 2] - expected[:, :, 2]).max() > 3e-3


def test_measured_and_corrected_angles_round_trip():
    error = RNG.uniform(-0.1, 0.1, (50, 3))
    np.testing.assert_allclose(corrected_angles(measured_angles(TILTED, error), -error), TILTED, atol=1e-15)


def misheaded(seed):
    """A rough flight whose inertial system takes north for somewhere else."""
    simulation = simulate(PLAN, seed, SENSORS, observation_plan=TIES)
    return replace(simulation, attitude_rpy=simulation.attitude_rpy + np.array([0.0, 0.0, WRONG]))


@pytest.fixture(scope="module")
def flown():
    kept = []

    def watch(now_s, window):
        if now_s > 24.0 and not kept:
            kept.append(copy.deepcopy(max(window.network.batches, key=lambda b: len(b.rays))))

    simulation = misheaded(1)
    options = WindowOptions(grid_hz=5.0)
    result = adjust_online(simulation, navigate(simulation), options, live=False, watch=watch, update_s=1.0)
    return simulation, result, kept[0]


def test_a_window_finds_the_heading_and_refuses_next_to_nothing(flown):
    simulation, result, _ = flown
    errors = orientation_errors(simulation, result.final)
    assert np.abs(np.degrees(errors.error[:, 5])).max() < 0.05
    assert 0.3 < errors.nees.mean() < 1.7
    assert len(result.refused) <= 12
    assert result.reports[-1].sigma0_total == pytest.approx(1.0, abs=0.12)


def test_derivatives_of_a_batch_hold_where_the_heading_is_corrected_by_degrees(flown):
    batch = flown[2]
    theta = batch.theta.copy()
    assert np.abs(batch.layout.corrections(theta)[5]).max() > 0.04
    batch.linearise(theta, reweigh=False)
    rows = batch.full_rows

    def residual(values):
        batch.linearise(values, reweigh=False)
        return batch.lin.residual.T.copy()

    for column in range(len(theta)):
        step = np.zeros(len(theta))
        step[column] = min(1e-2 / np.abs(rows[:, :, column]).max(), 1e-3)
        slope = (residual(theta + step) - residual(theta - step)) / (2 * step[column])
        np.testing.assert_allclose(-slope, rows[:, :, column], atol=2e-5 * np.abs(rows[:, :, column]).max() + 1e-9)
