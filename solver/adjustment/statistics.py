"""What an adjustment is worth: global test, theoretical and empirical accuracy, tests [K 4.54-4.62, A.2]."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ..arrays import Array, IntArray
from ..quantiles import chi2, fisher, student

#: Significance level of the global test, and of the tests of single parameters.
ALPHA = 0.05


@dataclass(frozen=True)
class GlobalTest:
    """Chi-square test of ``v^T P v`` against the a-priori sigma0 of 1.

    Attributes
    ----------
    sigma0 : a-posteriori standard deviation of unit weight, 1 a priori [K 4.54]; 1 without redundancy
    redundancy : n - u
    low, high : limits of sigma0 at the significance level, two-sided
    passed : whether sigma0 lies between them; None without redundancy, since nothing is tested then
    """

    sigma0: float
    redundancy: int
    low: float
    high: float

    @property
    def passed(self) -> bool | None:
        return self.low <= self.sigma0 <= self.high if self.redundancy else None


def global_test(weighted_squares: float, redundancy: int, alpha: float = ALPHA) -> GlobalTest:
    """Test ``v^T P v`` of whitened residuals against its chi-square distribution.

    Raises
    ------
    ValueError : negative squares or redundancy
    """
    if weighted_squares < 0 or redundancy < 0:
        raise ValueError(f"v^T P v and redundancy cannot be negative, got {weighted_squares} and {redundancy}")
    if redundancy == 0:
        return GlobalTest(1.0, 0, 0.0, np.inf)
    low, high = np.sqrt(chi2.ppf([alpha / 2, 1 - alpha / 2], redundancy) / redundancy)
    return GlobalTest(float(np.sqrt(weighted_squares / redundancy)), redundancy, float(low), float(high))


@dataclass(frozen=True)
class PointAccuracy:
    """Empirical and theoretical accuracy of a set of object points, per coordinate X, Y, Z.

    Attributes
    ----------
    n : points
    n_xyz : (3,) coordinates that could be compared
    rmse_m : (3,) root mean square difference [K 4.58]; NaN where nothing can be compared, as below
    mean_m : (3,) mean difference, adjusted minus given [K 4.60]
    max_m : (3,) largest absolute difference
    empirical_sigma_m : (3,) standard deviation about the mean [K 4.61]; NaN for less than two
    sigma_m : (3,) theoretical: root of the mean variance [K 4.56]
    """

    n: int
    n_xyz: IntArray
    rmse_m: Array
    mean_m: Array
    max_m: Array
    empirical_sigma_m: Array
    sigma_m: Array

    @property
    def rmse_xy_m(self) -> float:
        """Planimetric RMSE, root of the mean of both squares [K 4.59]."""
        return planimetric(self.rmse_m)

    @property
    def sigma_xy_m(self) -> float:
        """Planimetric theoretical sigma."""
        return planimetric(self.sigma_m)


def planimetric(xyz: ArrayLike) -> float:
    """One figure for X and Y of (2,) or (3,): ``sqrt((X^2 + Y^2) / 2)`` [K 4.59], in their unit.

    The published ADS40 figures decide against the plain sum: 0.32 and 0.57 m on 0.39 m are quoted as 1.2 px.
    """
    x, y = np.asarray(xyz, dtype=float)[:2]
    return float(np.hypot(x, y) / np.sqrt(2.0))


def point_accuracy(difference_m: ArrayLike, sigma_m: ArrayLike) -> PointAccuracy:
    """Accuracy of object points.

    Parameters
    ----------
    difference_m : (n, 3) adjusted minus given coordinates; NaN where a coordinate is not given
    sigma_m : (k, 3) theoretical sigmas of the same points (or of more, where nothing is given to compare with)
    """
    d = np.asarray(difference_m, dtype=float).reshape(-1, 3)
    s = np.asarray(sigma_m, dtype=float).reshape(-1, 3)
    given = np.isfinite(d)
    n = given.sum(axis=0)
    filled = np.where(given, d, 0.0)
    mean, rmse, largest, spread = (np.full(3, np.nan) for _ in range(4))
    some, two = n > 0, n > 1
    mean[some] = filled.sum(axis=0)[some] / n[some]
    rmse[some] = np.sqrt((filled**2).sum(axis=0)[some] / n[some])
    largest[some] = np.abs(filled).max(axis=0)[some] if len(d) else np.nan
    about = np.where(given, d - mean, 0.0)
    spread[two] = np.sqrt((about**2).sum(axis=0)[two] / (n[two] - 1))
    return PointAccuracy(int(given.any(axis=1).sum()), n, rmse, mean, largest, spread, mean_sigma(s))


def mean_sigma(sigma_m: ArrayLike) -> Array:
    """Root of the mean variance (3,) of coordinates (n, 3) [K 4.56]; NaN without any finite one."""
    s = np.asarray(sigma_m, dtype=float).reshape(-1, 3)
    finite = np.isfinite(s)
    n = finite.sum(axis=0)
    squares = np.where(finite, s, 0.0) ** 2
    return np.sqrt(np.divide(squares.sum(axis=0), n, out=np.full(3, np.nan), where=n > 0))


def student_limit(redundancy: int, alpha: float = ALPHA) -> float:
    """Two-sided critical value of Student's t."""
    return float(student.ppf(1 - alpha / 2, max(redundancy, 1)))


def fisher_value(values: ArrayLike, cofactors: ArrayLike, sigma0: float) -> float:
    """Fisher's F of a group of k parameters: ``x^T Q^-1 x / (k sigma0^2)`` [K 4.53].

    Parameters
    ----------
    values : (k,) estimates
    cofactors : (k, k) their part of Q
    """
    x, Q = np.asarray(values, dtype=float), np.asarray(cofactors, dtype=float)
    scale = np.sqrt(np.diag(Q))
    y = x / scale
    return float(y @ np.linalg.pinv(Q / np.outer(scale, scale), hermitian=True) @ y) / (len(x) * sigma0**2)


def fisher_limit(k: int, redundancy: int, alpha: float = ALPHA) -> float:
    """Critical value of F(k, redundancy)."""
    return float(fisher.ppf(1 - alpha, k, max(redundancy, 1)))


def correlations(covariance: ArrayLike) -> Array:
    """Correlation coefficients (n, n) of a covariance (n, n); zero where a variance is zero."""
    C = np.asarray(covariance, dtype=float)
    s = np.sqrt(np.diag(C))
    scale = np.divide(1.0, s, out=np.zeros_like(s), where=s > 0)
    return C * scale[:, None] * scale


@dataclass(frozen=True)
class CorrelatedPair:
    """Two unknowns and their correlation coefficient."""

    first: str
    second: str
    correlation: float


def strongest_correlations(covariance: ArrayLike, names: tuple[str, ...], above: float = 0.9) -> list[CorrelatedPair]:
    """Pairs of unknowns with ``|r| > above``, the strongest first, from their covariance (n, n) and names (n,)."""
    r = np.triu(correlations(covariance), 1)
    i, j = np.nonzero(np.abs(r) > above)
    order = np.argsort(-np.abs(r[i, j]))
    return [CorrelatedPair(names[i[k]], names[j[k]], float(r[i[k], j[k]])) for k in order]
