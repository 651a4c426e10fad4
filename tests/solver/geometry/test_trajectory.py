"""Interpolation of pose: order of accuracy, rates, locality, refusals."""

import numpy as np
import pytest

from triline.solver.geometry.rotation import matrix_from_angles, quaternion_from_matrix
from triline.solver.geometry.trajectory import Trajectory


def flight(step_s: float, n: int):
    t = np.arange(n) * step_s
    position = np.column_stack([70 * t, 30 * np.sin(0.5 * t), 1500 + 10 * np.cos(0.8 * t)])
    angles = np.column_stack([0.02 * np.sin(3 * t), 0.03 * np.cos(2 * t), 0.4 + 0.05 * np.sin(t)])
    return t, position, angles


def trajectory(step_s: float, n: int) -> Trajectory:
    t, position, angles = flight(step_s, n)
    return Trajectory(t, position, quaternion_from_matrix(matrix_from_angles(*angles.T)))


def errors(step_s: float) -> tuple[float, float]:
    path = trajectory(step_s, int(4 / step_s))
    t = np.linspace(1, 3, 301)
    position = np.column_stack([70 * t, 30 * np.sin(0.5 * t), 1500 + 10 * np.cos(0.8 * t)])
    angles = np.column_stack([0.02 * np.sin(3 * t), 0.03 * np.cos(2 * t), 0.4 + 0.05 * np.sin(t)])
    poses = path.at(t)
    return np.abs(poses.position_l - position).max(), np.abs(poses.angles - angles).max()


def test_error_falls_with_the_third_power_of_the_step():
    coarse, fine = errors(0.1), errors(0.05)
    assert coarse[0] / fine[0] > 6.5 and coarse[1] / fine[1] > 6.5
    assert errors(0.005)[1] < 1e-8


def test_samples_are_met():
    path = trajectory(0.01, 100)
    _, position, angles = flight(0.01, 100)
    poses = path.at(path.time_s)
    np.testing.assert_allclose(poses.position_l, position, atol=1e-9)
    np.testing.assert_allclose(poses.angles, angles, atol=1e-12)


def test_rates_are_the_derivatives():
    path = trajectory(0.05, 80)
    t, h = np.linspace(0.7, 3.1, 77), 1e-5
    plus, minus, here = path.at(t + h), path.at(t - h), path.at(t)
    np.testing.assert_allclose(here.velocity_l, (plus.position_l - minus.position_l) / (2 * h), atol=1e-4)
    np.testing.assert_allclose(
        here.angle_rate, (plus.angles - minus.angles) / (2 * h), atol=5e-6
    )  # a knot may lie between


def test_pose_depends_only_on_the_four_samples_about_it():
    whole = trajectory(0.01, 100)
    part = Trajectory(whole.time_s[40:44], whole.position_l[40:44], whole.quaternion[40:44])
    t = np.array([0.413, 0.419])
    np.testing.assert_array_equal(part.at(t).position_l, whole.at(t).position_l)
    np.testing.assert_array_equal(part.at(t).angles, whole.at(t).angles)


def test_kappa_passes_through_pi():
    kappa = np.pi + np.linspace(-0.05, 0.05, 11)
    q = quaternion_from_matrix(matrix_from_angles(np.zeros(11), np.zeros(11), kappa))
    path = Trajectory(np.arange(11.0), np.zeros((11, 3)), q)
    middle = path.at(np.array([4.5, 5.5])).angles[:, 2] % (2 * np.pi)
    np.testing.assert_allclose(middle, [np.pi - 0.005, np.pi + 0.005], atol=1e-9)


@pytest.mark.parametrize(
    ("times", "message"),
    [([0.0], "at least 2"), ([0.0, 1.0, 1.0], "sample 2"), ([0.0, 1.0], "do not match")],
)
def test_bad_trajectories_are_refused(times, message):
    n = 3 if message == "do not match" else len(times)
    with pytest.raises(ValueError, match=message):
        Trajectory(times, np.zeros((n, 3)), np.tile([0, 0, 0, 1.0], (n, 1)))


def test_time_outside_is_named():
    with pytest.raises(ValueError, match=r"9\.000000 s outside"):
        trajectory(0.1, 20).at([9.0])
