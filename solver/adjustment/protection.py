"""How far a result can be off unseen, in its sigmas: protection levels of a stated risk.

An error that moves a normalised residual by m moves a function of the unknowns by ``m outer`` of its sigmas, ``outer``
being the outer reliability of the observation for it. The test lets it pass with probability ``P(w < critical)``, w of
mean m. Residuals and adjusted values are independent, so that the probability of being beyond K sigma unnoticed is the
product of both; K is such that no m makes it larger than the risk. A marginally detectable error (power 80 %) alone
gives ``K = k + delta_0 outer``; for large ``outer`` errors beyond it, noticed in 98 % of cases but not all, count more.
"""

from __future__ import annotations

from functools import cache

import numpy as np

from ..arrays import Array
from ..quantiles import norm
from .reliability import noncentrality

#: Outer reliability at which the factors are tabled.
OUTER = np.concatenate([np.arange(0.0, 4.0, 0.125), np.arange(4.0, 20.1, 0.5)])
#: Halvings of the interval that the factor is sought in.
HALVINGS = 40


def protection_factor(outer: Array, risk: float, critical: float) -> Array:
    """Protection level over sigma (...) for outer reliabilities (...); never less than ``k + delta_0 outer``."""
    table = _factors(risk, critical)
    beyond = outer > OUTER[-1]
    found = np.interp(outer, OUTER, table)
    slope = (table[-1] - table[-2]) / (OUTER[-1] - OUTER[-2])
    found = np.where(beyond, table[-1] + slope * (outer - OUTER[-1]), found)
    return np.maximum(found, float(norm.isf(risk / 2)) + noncentrality(critical) * outer)


@cache
def _factors(risk: float, critical: float) -> Array:
    """Of `protection_factor` at `OUTER`, by bisection."""
    m = np.arange(0.0, critical + 6.0, 0.02)[:, None]
    passes = norm.cdf(critical - m)
    low, high = np.zeros(len(OUTER)), 10.0 + 10.0 * OUTER
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        beyond = norm.cdf(m * OUTER - middle) + norm.cdf(-m * OUTER - middle)
        too_often = (passes * beyond).max(axis=0) > risk
        low, high = np.where(too_often, middle, low), np.where(too_often, high, middle)
    return high
