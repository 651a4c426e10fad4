"""Quantiles and probabilities beside `scipy.stats`, to the last bit."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from triline.solver import quantiles

Q = np.array([1e-9, 1e-4, 0.025, 0.5, 0.9, 0.999])
X = np.array([0.01, 0.5, 1.0, 3.29, 12.0, 80.0])


@pytest.mark.parametrize("df", [1, 2, 3, 17, 2400.0])
def test_chi_square_and_student(df):
    for name in ("ppf", "isf"):
        np.testing.assert_array_equal(getattr(quantiles.chi2, name)(Q, df), getattr(stats.chi2, name)(Q, df))
    np.testing.assert_array_equal(quantiles.chi2.sf(X, df), stats.chi2.sf(X, df))
    assert quantiles.chi2.median(df) == stats.chi2.median(df)
    np.testing.assert_array_equal(quantiles.student.ppf(Q, df), stats.t.ppf(Q, df))
    np.testing.assert_array_equal(quantiles.student.isf(Q, df), stats.t.isf(Q, df))
    np.testing.assert_allclose(quantiles.fisher.ppf(Q, 3, df), stats.f.ppf(Q, 3, df), rtol=1e-12)


def test_normal():
    for name in ("ppf", "isf"):
        np.testing.assert_array_equal(getattr(quantiles.norm, name)(Q), getattr(stats.norm, name)(Q))
    for name in ("sf", "cdf", "pdf"):
        np.testing.assert_array_equal(getattr(quantiles.norm, name)(X), getattr(stats.norm, name)(X))
