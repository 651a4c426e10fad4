"""What `bench/known_orientation.py` calls the best estimator, beside the integral of the distribution."""

import importlib

import numpy as np
import pytest
from places import ROOT


@pytest.fixture
def bench(monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / "bench"))
    return importlib.import_module("known_orientation")


@pytest.mark.parametrize("wrong", [0.0, 15.0])
def test_the_mean_is_that_of_the_distribution(bench, wrong):
    """Three looks, forward, down and backward: across the flight each measures Y, and nothing else does."""
    rng, grid = np.random.default_rng(4), np.linspace(-30.0, 30.0, 1201)
    A = np.zeros((3, 2, 3))
    A[:, 0, 0], A[:, 0, 2], A[:, 1, 1] = 1.0, [-0.5, 0.0, 0.4], 1.0
    off, of_least_squares = [], []
    for _ in range(20):
        v = rng.standard_t(3, (3, 2))
        v[0, 1] += wrong
        log = bench.log_student(v[:, 1, None] - grid).sum(axis=0)
        expected = np.average(grid, weights=np.exp(log - log.max()))
        found = bench.mean_of_distribution(v.ravel(), A.reshape(-1, 3), bench.log_student, rng)
        off.append(found[1] - expected)
        of_least_squares.append(v[:, 1].mean() - expected)
    assert np.sqrt(np.mean(np.square(off))) < 0.1
    assert np.sqrt(np.mean(np.square(of_least_squares))) > (3.0 if wrong else 0.3)
