"""Regularised least squares: closed forms, choice of the parameter, bias and variance over draws."""

from __future__ import annotations

import numpy as np
import pytest

from triline.solver.estimation.regularisation import Regularisation, iterate

RNG = np.random.default_rng(0)
A = RNG.normal(size=(12, 4)) @ np.diag([1.0, 1.0, 0.1, 1e-3])
Y = RNG.normal(size=12)
SIGMA = np.linspace(0.5, 2.0, 12)
PRIOR = np.array([1.0, -1.0, 2.0, 0.0])
M = RNG.normal(size=(4, 4))
P = M @ M.T + np.eye(4)
W = np.diag(1.0 / SIGMA**2)


def nine_pixels(low, high, order=4):
    """Powers of the column (2048 wide, from the middle) at nine pixels: one coordinate of a camera's model."""
    x = (np.linspace(low, high, 9) - 1024.0) / 1024.0
    return x[:, None] ** np.arange(order)


def test_closed_forms():
    found = Regularisation(A, Y, SIGMA, PRIOR, P).fictitious()  # [D 5.18] with prior values
    N = A.T @ W @ A
    np.testing.assert_allclose(found.x, np.linalg.solve(N + P, A.T @ W @ Y + P @ PRIOR), rtol=1e-10)
    inverse = np.linalg.inv(N + P)
    np.testing.assert_allclose(found.covariance, inverse @ N @ inverse, atol=1e-12)
    np.testing.assert_allclose(found.bias_of, inverse @ N - np.eye(4), atol=1e-10)
    np.testing.assert_allclose(found.expected_bias2, inverse @ P @ inverse, atol=1e-10)
    assert found.effective_parameters == pytest.approx(np.trace(inverse @ N))
    alpha = 0.3  # [D 5.21]
    plain = Regularisation(A, Y).tikhonov(alpha)
    np.testing.assert_allclose(plain.x, np.linalg.solve(A.T @ A + alpha**2 * np.eye(4), A.T @ Y), rtol=1e-10)
    fro = np.linalg.norm
    after = A.T @ A + alpha**2 * np.eye(4)
    assert plain.condition_after == pytest.approx(fro(after) * fro(np.linalg.inv(after)))
    assert plain.condition_before == pytest.approx(fro(A.T @ A) * fro(np.linalg.inv(A.T @ A)), rel=1e-6)
    s = np.linalg.svd(A, compute_uv=False)
    np.testing.assert_allclose(plain.filters, s**2 / (s**2 + alpha**2))


def test_none_is_least_squares_and_truncation_is_the_pseudo_inverse():
    least = np.linalg.lstsq(A, Y)[0]
    for found in (Regularisation(A, Y).tikhonov(0.0), Regularisation(A, Y).truncated(4)):
        np.testing.assert_allclose(found.x, least, rtol=1e-8)
        assert found.effective_parameters == pytest.approx(4.0)
        np.testing.assert_allclose(found.bias_of, 0.0, atol=1e-8)
    cut = Regularisation(A, Y).truncated(3)
    s = np.linalg.svd(A, compute_uv=False)
    np.testing.assert_allclose(cut.x, np.linalg.pinv(A, rcond=1.01 * s[3] / s[0]) @ Y, rtol=1e-8)
    assert cut.kept == 3 and cut.condition_after < 1e-3 * cut.condition_before


def test_fewer_observations_than_parameters():
    found = Regularisation(A[:2], Y[:2]).tikhonov(0.1)
    expected = np.linalg.solve(A[:2].T @ A[:2] + 0.01 * np.eye(4), A[:2].T @ Y[:2])
    np.testing.assert_allclose(found.x, expected, atol=1e-10)
    assert found.condition_before == np.inf and np.isfinite(found.condition_after)


def test_residual_and_prior_norm():
    found = Regularisation(A, Y, SIGMA, PRIOR).tikhonov(0.5)
    assert found.residual_norm == pytest.approx(np.linalg.norm((Y - A @ found.x) / SIGMA))
    assert found.prior_norm == pytest.approx(np.linalg.norm(found.x - PRIOR))


def test_cross_validation_is_that_by_leaving_rotated_observations_out():
    # the minimum over a fine row of values of n |r|^2 / (n - trace of the influence)^2
    def score(alpha):
        H = A @ np.linalg.solve(A.T @ A + alpha**2 * np.eye(4), A.T)
        return np.sum((Y - H @ Y) ** 2) / (12 - np.trace(H)) ** 2

    found = Regularisation(A, Y).tikhonov("gcv")
    assert score(found.alpha) <= min(score(a) for a in np.geomspace(1e-4, 10.0, 400)) * (1 + 1e-6)


@pytest.mark.parametrize(("how", "times"), [("gcv", 2.0), ("l-curve", 6.0)])
def test_a_found_parameter_is_near_the_best_one(how, times):
    # a smooth curve seen through a blur: so many times larger are errors than with the best parameter; without
    # regularisation it is more than a thousand times
    t = np.linspace(0.0, 1.0, 40)
    blur = np.exp(-((t[:, None] - t) ** 2) / 0.02) / 40
    true = np.sin(np.pi * t) + 0.5 * np.sin(2 * np.pi * t)
    ratios = []
    for seed in range(10):
        y = blur @ true + 1e-3 * np.random.default_rng(seed).normal(size=40)
        problem = Regularisation(blur, y, 1e-3)
        best = min(np.linalg.norm(problem.tikhonov(a).x - true) for a in np.geomspace(1e-3, 1e2, 60))
        ratios.append(np.linalg.norm(problem.tikhonov(how).x - true) / best)
        cut = problem.truncated(how)
        assert np.linalg.norm(cut.x - true) < 0.3 * np.linalg.norm(true) and 2 < cut.kept < 15
        assert np.linalg.norm(problem.tikhonov(1e-9).x - true) > 1000.0 * best
    assert np.median(ratios) < times


def test_narrow_pixels_total_error_is_smaller_and_as_told():
    rng = np.random.default_rng(1)
    prior_sigma, noise = np.array([1.0, 0.5, 0.2, 0.1]), 0.3
    narrow = nine_pixels(950, 1050)
    square = {"with": np.zeros(4), "without": np.zeros(4)}
    draws = 400
    for _ in range(draws):
        true = prior_sigma * rng.normal(size=4)
        problem = Regularisation(narrow, narrow @ true + noise * rng.normal(size=9), noise, None, 1.0 / prior_sigma**2)
        held, free = problem.fictitious(), problem.tikhonov(0.0)
        square["with"] += (held.x - true) ** 2 / draws
        square["without"] += (free.x - true) ** 2 / draws
    told = np.diag(held.covariance) + np.diag(held.expected_bias2)
    assert (square["with"] < square["without"]).all()
    assert (square["with"][1:] < 1e-1 * square["without"][1:]).all()
    assert np.sqrt(square["with"] / told) == pytest.approx(1.0, abs=0.12)
    assert np.sqrt(square["without"] / np.diag(free.covariance)) == pytest.approx(1.0, abs=0.12)
    assert held.effective_parameters < 2.0


def test_order_of_the_published_condition_numbers():
    # [D]: narrow is far worse than wide without, and both are alike with fictitious observations
    before, after = {}, {}
    for name, ends in (("narrow", (950, 1050)), ("wide", (1, 2048))):
        found = Regularisation(nine_pixels(*ends, 6), np.zeros(9), 1.0, None, np.full(6, 1e-2)).fictitious()
        before[name], after[name] = found.condition_before, found.condition_after
    assert before["narrow"] > 1e6 * before["wide"]
    assert after["narrow"] < 1e4 and after["wide"] < 1e4 and 0.1 < after["narrow"] / after["wide"] < 10.0


def test_a_model_that_is_not_linear():
    t = np.linspace(0.0, 1.0, 30)

    def model(x):
        e = np.exp(-x[1] * t)
        return x[0] * e, np.stack([e, -x[0] * t * e], axis=1)

    y = model(np.array([2.0, 1.5]))[0]
    found = iterate(model, [1.5, 1.0], y, lambda equations: equations.tikhonov(0.0), 0.01)
    np.testing.assert_allclose(found.x, [2.0, 1.5], atol=1e-8)
    held = iterate(model, [1.5, 1.0], y, lambda equations: equations.tikhonov(30.0), 0.01)
    assert 1 < held.iterations < 20 and 1.0 < held.x[1] < 1.5


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: Regularisation(A, Y[:5]), r"observations \(5,\), wanted"),
        (lambda: Regularisation(A, Y * np.nan), "a value that is not a number"),
        (lambda: Regularisation(A, Y, 0.0), "wanted numbers above 0"),
        (lambda: Regularisation(A, Y, 1.0, PRIOR, -P), "positive definite"),
        (lambda: Regularisation(A, Y).tikhonov(-1.0), "alpha -1.0, wanted a number of at least 0"),
        (lambda: Regularisation(A, Y).tikhonov("best"), "choice 'best', wanted"),
        (lambda: Regularisation(A, Y).truncated(9), "9 singular values, wanted 1 to 4"),
    ],
)
def test_bad_input(call, message):
    with pytest.raises(ValueError, match=message):
        call()
