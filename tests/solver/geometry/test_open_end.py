"""Behind the last sample but one a pose is interpolated without its right-hand neighbour, and says so."""

import numpy as np
import pytest

from triline.solver.geometry.measured_trajectory import MeasuredTrajectory
from triline.solver.geometry.rotation import matrix_from_angles, quaternion_from_matrix
from triline.solver.geometry.trajectory import Trajectory

STEP_S = 0.1


def motion(held: bool, noise_rad: float = 0.0):
    """Turbulent attitude, of which every second sample may repeat the one before it."""
    random = np.random.default_rng(4)
    t = STEP_S * np.arange(900)
    phases = random.uniform(0, 2 * np.pi, (3, 4))
    rates = np.array([0.2, 0.5, 0.9, 1.4])
    angles = np.radians(0.5) * np.sin(rates * t[:, None, None] + phases).sum(axis=2)
    if held:
        angles[1::2] = angles[::2]
    angles = angles + noise_rad * random.standard_normal(angles.shape)
    return t, np.column_stack([70.0 * t, 0 * t, 0 * t]), quaternion_from_matrix(matrix_from_angles(*angles.T))


def newest(t, position, q, noise_rad):
    """Errors of angles half-way in the newest interval against the whole trajectory, and the variances stated."""
    covariance = np.tile(np.diag([1e-6] * 3 + [noise_rad**2] * 3), (len(t), 1, 1))
    whole, growing = Trajectory(t, position, q), MeasuredTrajectory()
    errors, stated = [], []
    for i in range(len(t)):
        growing.add(t[i : i + 1], position[i : i + 1], q[i : i + 1], covariance[i : i + 1], smoothed=True)
        if i > 100 and i % 7 in (0, 3):
            at = [t[i] - 0.4 * STEP_S]
            measured = growing.at(at)
            errors.append(measured.poses.angles[0] - whole.at(at).angles[0])
            stated.append(measured.open_end[0, 3:])
    return np.array(errors), np.array(stated)


def test_a_motion_in_steps_states_what_its_newest_interval_lacks():
    errors, variance = newest(*motion(held=True), 1e-6)
    assert np.degrees(errors.std()) > 0.005
    assert 0.6 < np.mean(errors**2 / variance) < 1.5


def test_noise_of_a_smooth_motion_is_not_counted_twice():
    noise = 1e-4
    _, variance = newest(*motion(held=False, noise_rad=noise), noise)
    assert variance.mean() < 0.05 * noise**2


def test_between_earlier_samples_nothing_is_added():
    t, position, q = motion(held=True)
    measured = MeasuredTrajectory()
    measured.add(t, position, q, np.tile(np.eye(6) * 1e-12, (len(t), 1, 1)), smoothed=True)
    assert not measured.at(t[:-1]).open_end.any()
    assert measured.at([t[-1] - 0.5 * STEP_S]).open_end[0, 3:].min() > 0
    assert measured.at([t[-1]]).open_end[0] == pytest.approx(0.0, abs=1e-20)
