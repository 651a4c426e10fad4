"""Reliability after Baarda: what an adjustment can detect, and what escapes it [K A.2]."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ..arrays import Array
from ..quantiles import norm

#: Critical value of the normalised residual for alpha = 0.001 [K A.17].
CRITICAL_W = 3.29
#: A look fails narrowly up to so many critical values. Of a normal distribution 0.1 % fail so, of a Student
#: distribution with three degrees of freedom 4 to 7 %. Beyond are mismatches. Tuned.
NARROWLY = 2.0
#: Share of looks that fail narrowly which says that their errors have heavy tails, so that sigmas of points are too
#: small. Tuned.
HEAVY_TAILS = 0.02
#: Share of looks that fail which says that others have stayed in unseen, at points of two looks: with 5 to 8 % of the
#: looks wrong the normalised square error of points is up to 4. Tuned.
MISMATCHES = 0.05

#: Power of the test that marginal detectable errors are stated for.
POWER = 0.80

#: Observations with less redundancy than this are not controlled by the others.
UNCONTROLLED = 1e-6


def noncentrality(critical: float = CRITICAL_W, power: float = POWER) -> float:
    """``delta_0``: shift of a normalised residual that a test with this critical value finds with this power (4.13)."""
    return critical + float(norm.ppf(power))


def normalised_residuals(v: ArrayLike, redundancy_numbers: ArrayLike) -> Array:
    """Baarda's ``w = v / sqrt(q_vv)`` of whitened residuals; zero for uncontrolled observations [K A.17].

    Parameters
    ----------
    v : (...) residuals divided by their a-priori sigmas
    redundancy_numbers : (...) diagonal of ``Q_vv P``, the cofactors of whitened residuals
    """
    v, r = np.asarray(v, dtype=float), np.asarray(redundancy_numbers, dtype=float)
    controlled = r > UNCONTROLLED
    return np.where(controlled, v / np.sqrt(np.where(controlled, r, 1.0)), 0.0)


@dataclass(frozen=True)
class Reliability:
    """Inner and outer reliability of n observations.

    Attributes
    ----------
    redundancy : (n,) redundancy numbers, 0 (uncontrolled) to 1
    detectable : (n,) marginal detectable error ``sigma delta_0 / sqrt(r)``, unit of sigma; infinite where uncontrolled
    outer : (n,) ``delta_0 sqrt((1 - r) / r)``: the most an undetected error shifts any function of the unknowns, in
        standard deviations of that function
    """

    redundancy: Array
    detectable: Array
    outer: Array


def reliability(redundancy_numbers: ArrayLike, sigma: ArrayLike, critical: float = CRITICAL_W) -> Reliability:
    """Reliability from redundancy numbers (n,) and a-priori sigmas (n,)."""
    r = np.clip(np.asarray(redundancy_numbers, dtype=float), 0.0, 1.0)
    delta = noncentrality(critical)
    controlled = r > UNCONTROLLED
    root = np.sqrt(np.where(controlled, r, 1.0))
    detectable = np.where(controlled, np.asarray(sigma, dtype=float) * delta / root, np.inf)
    outer = np.where(controlled, delta * np.sqrt(1.0 - r) / root, np.inf)
    return Reliability(r, detectable, outer)
