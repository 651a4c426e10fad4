"""Protection factors: the risk they state, found by trying."""

import numpy as np
import pytest

from triline.solver.adjustment.protection import protection_factor
from triline.solver.adjustment.reliability import CRITICAL_W, noncentrality

RISK = 1e-3


@pytest.mark.parametrize("outer", [0.0, 0.5, 1.2, 2.0, 4.3, 30.0])
def test_no_error_is_passed_and_beyond_more_often_than_stated(outer):
    """One observation checked by another: the mean of x1 (outer sigma of a function) with an error of any size."""
    factor = float(protection_factor(np.array(outer), RISK, CRITICAL_W))
    rng = np.random.default_rng(int(10 * outer))
    n, worst = 200_000, 0.0
    w, moved = rng.standard_normal(n), rng.standard_normal(n)
    for m in np.arange(0.0, 8.0, 0.25):
        worst = max(worst, float(np.mean((np.abs(w + m) < CRITICAL_W) & (np.abs(moved + m * outer) > factor))))
    band = 4.0 * np.sqrt(RISK / n)
    assert worst < RISK + band
    if (
        outer >= 2.0
    ):  # there what a marginally detectable error does would not be enough, and this is no more than needed
        assert worst > 0.7 * RISK
        short = 3.29 + noncentrality(CRITICAL_W) * outer
        assert factor > short
        m = 5.0 if outer < 3.0 else 5.5
        assert np.mean((np.abs(w + m) < CRITICAL_W) & (np.abs(moved + m * outer) > short)) > 2.0 * RISK


def test_it_grows_with_the_outer_reliability_and_is_at_least_what_a_detectable_error_does():
    outer = np.linspace(0.0, 60.0, 500)
    factor = protection_factor(outer, RISK, CRITICAL_W)
    assert (np.diff(factor) > 0).all()
    assert (factor >= 3.29 + noncentrality(CRITICAL_W) * outer - 0.001).all()
