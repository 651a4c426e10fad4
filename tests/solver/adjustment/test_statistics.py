"""Accuracy figures and tests against their definitions."""

import numpy as np
import pytest
from scipy import stats

from triline.solver.adjustment.reliability import noncentrality, normalised_residuals, reliability
from triline.solver.adjustment.statistics import (
    correlations,
    fisher_limit,
    fisher_value,
    global_test,
    planimetric,
    point_accuracy,
    strongest_correlations,
    student_limit,
)


def test_global_test_limits_hold_their_share():
    rng = np.random.default_rng(1)
    inside = [global_test(rng.chisquare(40), 40).passed for _ in range(4000)]
    assert 0.94 < np.mean(inside) < 0.96


def test_global_test_without_redundancy_says_nothing():
    test = global_test(0.0, 0)
    assert test.sigma0 == 1.0 and test.passed is None and test.high == np.inf


def test_global_test_fails_on_both_sides():
    assert not global_test(2.0 * 100, 100).passed
    assert not global_test(0.5 * 100, 100).passed


def test_global_test_refuses_nonsense():
    with pytest.raises(ValueError, match="cannot be negative"):
        global_test(-1.0, 5)


def test_accuracy_by_hand():
    d = np.array([[1.0, 0.0, np.nan], [-1.0, 2.0, np.nan], [3.0, -5.0, 4.0]])
    a = point_accuracy(d, np.array([[3.0, 1.0, 1.0], [4.0, 1.0, 1.0]]))
    assert a.n == 3 and a.n_xyz.tolist() == [3, 3, 1]
    np.testing.assert_allclose(a.mean_m, [1.0, -1.0, 4.0])
    np.testing.assert_allclose(a.rmse_m, np.sqrt([11 / 3, 29 / 3, 16.0]))
    np.testing.assert_allclose(a.max_m, [3.0, 5.0, 4.0])
    np.testing.assert_allclose(a.empirical_sigma_m, [2.0, np.std([0, 2, -5], ddof=1), np.nan])
    np.testing.assert_allclose(a.sigma_m, [np.sqrt(12.5), 1.0, 1.0])


def test_empirical_sigma_follows_from_rmse_and_mean():
    d = np.random.default_rng(2).normal(0.3, 1.0, (50, 3))
    a = point_accuracy(d, np.ones((50, 3)))
    np.testing.assert_allclose(a.empirical_sigma_m, np.sqrt(50 / 49 * (a.rmse_m**2 - a.mean_m**2)))


def test_accuracy_of_nothing_is_not_a_number():
    a = point_accuracy(np.empty((0, 3)), np.empty((0, 3)))
    assert a.n == 0 and np.isnan(a.rmse_m).all() and np.isnan(a.sigma_m).all()


def test_planimetric_reproduces_the_published_pixels():
    # direct georeferencing of Pavia 4000 m: 0.32 and 0.57 m on 0.39 m, printed as 1.2 px
    assert round(planimetric([0.32, 0.57, 1.79]) / 0.39, 1) == 1.2


def test_student_and_fisher_hold_their_level():
    rng = np.random.default_rng(3)
    A = rng.normal(size=(30, 4))
    Q = np.linalg.inv(A.T @ A)
    t_hits, f_hits = 0, 0
    runs = 3000
    for _ in range(runs):
        y = rng.normal(size=30)
        x = Q @ A.T @ y
        v = y - A @ x
        sigma0 = np.sqrt(v @ v / 26)
        t_hits += abs(x[0]) / (sigma0 * np.sqrt(Q[0, 0])) > student_limit(26)
        f_hits += fisher_value(x[:3], Q[:3, :3], sigma0) > fisher_limit(3, 26)
    assert 0.04 < t_hits / runs < 0.06
    assert 0.04 < f_hits / runs < 0.06


def test_fisher_of_one_parameter_is_t_squared():
    assert fisher_value([3.0], [[4.0]], 0.5) == pytest.approx((3.0 / (0.5 * 2.0)) ** 2)


def test_correlations_scan():
    C = np.array([[4.0, 3.9, 0.0], [3.9, 4.0, 0.0], [0.0, 0.0, 0.0]])
    assert correlations(C)[0, 1] == pytest.approx(0.975)
    (pair,) = strongest_correlations(C, ("a", "b", "c"))
    assert (pair.first, pair.second) == ("a", "b") and pair.correlation == pytest.approx(0.975)


def test_noncentrality_is_baardas():
    assert noncentrality() == pytest.approx(4.13, abs=0.005)


def test_detectable_error_is_found_with_the_power_stated():
    rng = np.random.default_rng(4)
    A = rng.normal(size=(12, 5))
    R = np.eye(12) - A @ np.linalg.inv(A.T @ A) @ A.T
    r = reliability(np.diag(R), np.full(12, 0.3))
    i = 7
    found = 0
    for _ in range(4000):
        y = rng.normal(0.0, 0.3, 12)
        y[i] += r.detectable[i]
        w = normalised_residuals(R @ y / 0.3, np.diag(R))
        found += abs(w[i]) > 3.29
    assert 0.78 < found / 4000 < 0.82


def test_outer_reliability_bounds_the_shift_of_the_unknowns():
    rng = np.random.default_rng(5)
    A = rng.normal(size=(12, 5))
    Q = np.linalg.inv(A.T @ A)
    R = np.eye(12) - A @ Q @ A.T
    r = reliability(np.diag(R), np.ones(12))
    for i in range(12):
        shift = Q @ A[i] * r.detectable[i]
        assert np.sqrt(shift @ A.T @ A @ shift) == pytest.approx(r.outer[i])
        assert (np.abs(shift) <= r.outer[i] * np.sqrt(np.diag(Q)) + 1e-12).all()


def test_uncontrolled_observation_has_no_w_and_no_bound():
    assert normalised_residuals([1e-9, 2.0], [0.0, 0.25]).tolist() == [0.0, 4.0]
    r = reliability([0.0], [1.0])
    assert np.isinf(r.detectable[0]) and np.isinf(r.outer[0])


def test_w_is_standard_normal():
    rng = np.random.default_rng(6)
    A = rng.normal(size=(20, 6))
    R = np.eye(20) - A @ np.linalg.inv(A.T @ A) @ A.T
    w = np.concatenate([normalised_residuals(R @ rng.normal(size=20), np.diag(R)) for _ in range(500)])
    assert stats.kstest(w, "norm").pvalue > 1e-3 and 0.97 < w.std() < 1.03
