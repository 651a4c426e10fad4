"""Indices of functions whose indices are known, and beside SALib where it is installed."""

from __future__ import annotations

import numpy as np
import pytest

from triline.solver.sensitivity.indices import fast, sobol
from triline.solver.sensitivity.inputs import Normal, Uniform
from triline.solver.sensitivity.monte_carlo import monte_carlo
from triline.solver.sensitivity.propagation import propagate

FIRST, TOTAL = np.array([0.314, 0.442, 0.0]), np.array([0.558, 0.442, 0.244])
CUBE = Uniform(-np.pi * np.ones(3), np.pi * np.ones(3))


def ishigami(x):
    return np.sin(x[:, 0]) + 7.0 * np.sin(x[:, 1]) ** 2 + 0.1 * x[:, 2] ** 4 * np.sin(x[:, 0])


A = np.array([[1.0, 2.0, -3.0, 0.0], [0.5, 0.0, 0.0, 4.0], [0.0, 0.0, 0.0, 0.0]])
SIGMA = np.array([1.0, 0.5, 0.1, 0.2])
MEAN = np.array([10.0, -5.0, 3.0, 0.0])


def linear(x):
    return x @ A.T + 7.0


def test_ishigami_by_fast():
    found = fast(ishigami, CUBE, 4097, np.random.default_rng(1), curves=4)
    np.testing.assert_allclose(found.first[0], FIRST, atol=0.01)
    np.testing.assert_allclose(found.total[0], TOTAL, atol=0.01)


def test_ishigami_by_sobol():
    found = sobol(ishigami, CUBE, 8192)
    np.testing.assert_allclose(found.first[0], FIRST, atol=0.01)
    np.testing.assert_allclose(found.total[0], TOTAL, atol=0.01)
    assert found.runs == 5 * 8192


def test_ishigami_by_monte_carlo():
    # mean 3.5 and variance 13.84 are those of uniform parameters: drawn through the normal distribution
    def function(z):
        from scipy.special import ndtr

        return ishigami(CUBE.from_unit(ndtr(z)))

    found = monte_carlo(function, np.zeros(3), np.ones(3), 40_000, np.random.default_rng(3))
    assert found.mean[0] == pytest.approx(3.5, abs=0.06)
    assert found.sigma[0] == pytest.approx(np.sqrt(13.845), abs=4 * found.sigma_error[0])
    assert found.converged and found.stops[-1] == 40_000


def test_a_linear_function_by_all():
    share = (A[:2] * SIGMA) ** 2
    sigma = np.sqrt(share.sum(axis=1))
    share /= share.sum(axis=1, keepdims=True)
    by_derivatives = propagate(linear, MEAN, SIGMA**2)
    np.testing.assert_allclose(by_derivatives.jacobian, A, atol=1e-9)
    np.testing.assert_allclose(by_derivatives.share[:2], share, atol=1e-9)
    np.testing.assert_allclose(by_derivatives.sigma, [*sigma, 0.0], atol=1e-9)
    drawn = monte_carlo(linear, MEAN, SIGMA**2, 20_000, np.random.default_rng(4))
    assert (np.abs(drawn.sigma[:2] - sigma) < 4 * drawn.sigma_error[:2]).all()
    # a sigma of n normal draws is known to 1 / sqrt(2 n)
    np.testing.assert_allclose(drawn.sigma_error[:2] / sigma, 1 / np.sqrt(40_000), rtol=0.1)
    limits = linear(MEAN[None])[0, 0] + np.array([-1.96, 1.96]) * sigma[0]
    np.testing.assert_allclose(drawn.percentiles[[0, 4], 0], limits, atol=0.08)
    inputs = Normal(MEAN, SIGMA)
    for found, tolerance in ((fast(linear, inputs), 0.015), (sobol(linear, inputs, 4096), 0.01)):
        np.testing.assert_allclose(found.first[:2], share, atol=tolerance)
        np.testing.assert_allclose(found.total[:2], share, atol=tolerance)
        assert np.isnan(found.first[2]).all()  # a result that does not scatter has no indices


def test_correlated_parameters():
    C = np.array([[1.0, 0.9], [0.9, 1.0]])
    found = propagate(lambda x: x[:, :1] - x[:, 1:], [0.0, 0.0], C)
    assert found.covariance[0, 0] == pytest.approx(0.2)
    drawn = monte_carlo(lambda x: x[:, 0] - x[:, 1], [0.0, 0.0], C, 20_000, np.random.default_rng(5))
    assert drawn.sigma[0] == pytest.approx(np.sqrt(0.2), rel=0.02)


def test_runs_that_miss_are_counted():
    def function(x):
        return np.where(x[:, 0] > 1.0, np.nan, x[:, 0])

    drawn = monte_carlo(function, [0.0], [1.0], 10_000, np.random.default_rng(6))
    assert 0.14 < drawn.missed / drawn.runs < 0.18
    with pytest.raises(ValueError, match="gave no number in"):
        sobol(function, Normal([0.0], [1.0]), 256)


def test_few_runs_have_not_converged():
    assert not monte_carlo(linear, MEAN, SIGMA**2, 200, np.random.default_rng(7)).converged


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: fast(linear, Normal(MEAN, SIGMA), 256), "256 samples of FAST, wanted more than 256"),
        (lambda: sobol(linear, Normal(MEAN, SIGMA), 100), "100 samples of a Sobol sequence, wanted a power of 2"),
        (lambda: monte_carlo(linear, MEAN, SIGMA**2, 10, np.random.default_rng(0)), "10 runs, wanted at least 100"),
        (lambda: monte_carlo(linear, MEAN[:2], [[1, 2], [2, 1]], 100, np.random.default_rng(0)), "negative eigenvalue"),
        (lambda: Normal([0.0], [-1.0]), "wanted 1 numbers of at least 0"),
        (lambda: Uniform([1.0], [0.0]), "wanted the lower one first"),
    ],
)
def test_bad_input(call, message):
    with pytest.raises(ValueError, match=message):
        call()


@pytest.mark.filterwarnings("ignore:FAST confidence")
def test_beside_salib():
    pytest.importorskip("SALib")
    from SALib.analyze import fast as salib_analyze
    from SALib.sample import fast_sampler

    problem = {"num_vars": 3, "names": ["1", "2", "3"], "bounds": [[-np.pi, np.pi]] * 3}
    theirs = salib_analyze.analyze(problem, ishigami(fast_sampler.sample(problem, 1025, M=4, seed=2)), M=4)
    ours = fast(ishigami, CUBE, 1025, np.random.default_rng(2), curves=4, harmonics=4)
    np.testing.assert_allclose(ours.first[0], theirs["S1"], atol=0.03)
    np.testing.assert_allclose(ours.total[0], theirs["ST"], atol=0.05)
    from SALib.analyze import sobol as sobol_analyze
    from SALib.sample import sobol as sobol_sample

    # without a seed it scrambles its sequence anew in each run, and one in some hundred is 0.03 off
    drawn = sobol_sample.sample(problem, 4096, calc_second_order=False, seed=1)
    theirs = sobol_analyze.analyze(problem, ishigami(drawn), calc_second_order=False, seed=1)
    ours = sobol(ishigami, CUBE, 4096)
    np.testing.assert_allclose(ours.first[0], theirs["S1"], atol=0.01)
    np.testing.assert_allclose(ours.total[0], theirs["ST"], atol=0.01)
