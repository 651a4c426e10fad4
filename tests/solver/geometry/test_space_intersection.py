"""Accuracy figures and space intersection."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares

from triline.solver.accuracy import accuracy, angle_difference, nees_band, normalised_error_squared
from triline.solver.camera.collinearity import project
from triline.solver.camera.sensors import preset
from triline.solver.geometry.space_intersection import ImageRays, intersect


def test_accuracy_of_known_errors():
    error = np.array([[3.0, -1.0], [-4.0, 1.0], [0.0, 3.0], [np.nan, 7.0]])
    a = accuracy(error, np.broadcast_to(np.diag([25.0, 1.0]), (4, 2, 2)))
    assert a.n == 3
    np.testing.assert_allclose(a.rmse, [np.sqrt(25 / 3), np.sqrt(11 / 3)])
    np.testing.assert_allclose(a.mean, [-1 / 3, 1.0])
    np.testing.assert_allclose(a.maximum, [4.0, 3.0])
    np.testing.assert_allclose(a.sigma, [5.0, 1.0])
    assert a.nees == pytest.approx((25 / 25 + 11) / 3 / 2)


def test_accuracy_without_covariance_and_without_errors():
    assert accuracy(np.ones((4, 3))).nees is None
    assert accuracy(np.empty((0, 3))).n == 0
    with pytest.raises(ValueError, match="wanted"):
        accuracy(np.ones((4, 3)), np.ones((4, 2, 2)))


def test_normalised_errors_of_the_right_covariance_lie_in_their_band():
    rng = np.random.default_rng(3)
    root = np.diag([1.0, 1e-4, 50.0]) @ rng.normal(size=(3, 3))
    error = rng.normal(size=(2000, 3)) @ root.T
    covariance = np.broadcast_to(root @ root.T, (2000, 3, 3))
    mean = float(normalised_error_squared(error, covariance).mean()) / 3
    low, high = nees_band(2000, 3, alpha=0.001)
    assert low < mean < high
    assert 0.9 < low < 1.0 < high < 1.1
    wrong = float(normalised_error_squared(error, 1.3 * covariance).mean()) / 3
    assert not low < wrong < high


def test_angle_difference_goes_the_short_way():
    np.testing.assert_allclose(angle_difference([np.pi - 0.01, 0.2], [-np.pi + 0.01, 0.5]), [-0.02, -0.3])


# ---- space intersection


def _rays(rng, n_points, noise_px, orientation_root, common):
    """Three looks at points 1500 m below; orientation errors are common to all looks of a point, or of each look."""
    camera = preset("ads40")
    times = np.array([-10.0, 0.0, 6.0])
    truth = np.column_stack(
        [rng.uniform(-100, 100, n_points), rng.uniform(-600, 600, n_points), rng.normal(0, 30, n_points)]
    )
    point = np.repeat(np.arange(n_points), 3)
    time = np.tile(times, n_points)
    position = np.stack([70.0 * time, np.zeros_like(time), np.full_like(time, 1500.0)], axis=1)
    angles = np.tile([0.01, -0.02, 0.03], (len(time), 1))
    focal = np.full(len(time), camera.focal_length_mm[0])
    image = project(position, angles, truth[point], focal).xy_mm
    pitch = np.tile([0.0, 0.0065], (len(time), 1))
    motion_per_line = np.tile([-0.0065, 0.0], (len(time), 1))
    error = rng.normal(size=(n_points if common else len(time), 6)) @ orientation_root.T
    error = error[point] if common else error
    noise = rng.normal(0, noise_px, (len(time), 2))
    velocity = np.tile([70.0, 0.0, 0.0], (len(time), 1))
    n = len(time)
    period = 0.0065 / (focal[0] * 70.0 / 1500.0)
    rays = ImageRays(
        point, time, np.full(n, period), position + error[:, :3], angles + error[:, 3:], velocity, np.zeros((n, 3)),
        image + noise[:, :1] * motion_per_line + noise[:, 1:] * pitch, pitch, focal,
        np.full(n, noise_px or 0.3), np.full(n, noise_px or 0.3),
        np.broadcast_to(orientation_root @ orientation_root.T, (n, 6, 6)),
    )  # fmt: skip
    return truth, rays


def test_rays_without_errors_meet_in_the_point():
    truth, rays = _rays(np.random.default_rng(0), 50, 0.0, np.zeros((6, 6)), True)
    found = intersect(rays, 51)
    np.testing.assert_allclose(found.xyz_l[:50], truth, atol=1e-6)
    assert not found.known[50] and np.isnan(found.xyz_l[50]).all()
    assert found.rays.tolist() == [3] * 50 + [0]


def test_intersection_agrees_with_a_general_least_squares_solver():
    _, rays = _rays(np.random.default_rng(1), 5, 0.5, np.zeros((6, 6)), True)
    found = intersect(rays, 5)
    for i in range(5):
        mine = rays.point == i

        def misfit(x, mine=mine):
            p = project(rays.position_l[mine], rays.angles[mine], np.tile(x, (3, 1)), rays.focal_length_mm[mine])
            return (rays.xy_mm[mine] - p.xy_mm).ravel() / (0.5 * 0.0065)

        solved = least_squares(misfit, found.xyz_l[i] + 5.0, x_scale="jac")
        # the line's advance in the image varies a little over the field, the test's pitch does not
        np.testing.assert_allclose(found.xyz_l[i], solved.x, atol=0.01)
        sigma = np.sqrt(np.diag(np.linalg.inv(solved.jac.T @ solved.jac)))
        np.testing.assert_allclose(np.sqrt(np.diag(found.covariance[i])), sigma, rtol=0.05)


@pytest.mark.parametrize(("common", "by_strip"), [(True, False), (False, False), (False, True)])
def test_covariance_of_intersected_points_is_consistent(common, by_strip):
    """Errors common to all rays of a point, or of each ray its own: short-lived, or each ray of another strip."""
    root = np.diag([0.5, 0.4, 0.7, 1e-4, 1e-4, 2e-4]) @ np.tril(np.full((6, 6), 0.3) + 0.7 * np.eye(6))
    truth, rays = _rays(np.random.default_rng(2), 1500, 0.3, root, common)
    rays = replace(rays, strip=np.tile([0, 1, 2], 1500)) if by_strip else rays
    found = intersect(rays, 1500, correlation_time_s=np.inf if common or by_strip else 1e-3)
    nees = accuracy(found.xyz_l - truth, found.covariance).nees
    low, high = nees_band(1500, 3, alpha=0.001)
    assert nees is not None and low < nees < high


def test_intersection_refuses_bad_calls():
    _, rays = _rays(np.random.default_rng(0), 3, 0.3, np.zeros((6, 6)), True)
    with pytest.raises(ValueError, match="correlation time"):
        intersect(rays, 3, correlation_time_s=0.0)
    with pytest.raises(ValueError, match="there are 2 points"):
        intersect(rays, 2)
