"""Errors against known values: RMSE, mean, maximum, and whether the stated covariance explains them [K 4.55-4.62]."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .quantiles import chi2

Array = NDArray[np.floating]


@dataclass(frozen=True)
class Accuracy:
    """Errors of n estimates of k components, in the unit of the errors.

    Attributes
    ----------
    n : number of estimates
    rmse, mean, maximum : (k,) root mean square, mean, largest absolute error
    sigma : (k,) theoretical: root mean of the stated variances; None where no covariance is stated
    nees : mean normalised error squared ``e^T C^-1 e / k``, 1 expected; None where no covariance is stated
    """

    n: int
    rmse: Array
    mean: Array
    maximum: Array
    sigma: Array | None = None
    nees: float | None = None


def accuracy(error: ArrayLike, covariance: ArrayLike | None = None) -> Accuracy:
    """Accuracy of errors (n, k) with their stated covariances (n, k, k); rows that are not finite do not count.

    Raises
    ------
    ValueError : shapes that do not match
    """
    e = np.asarray(error, dtype=float)
    if e.ndim != 2:
        raise ValueError(f"errors have shape {e.shape}, wanted (n, k)")
    k = e.shape[1]
    finite = np.isfinite(e).all(axis=1)
    C = np.full((len(e), k, k), np.nan) if covariance is None else np.asarray(covariance, dtype=float)
    if C.shape != (len(e), k, k):
        raise ValueError(f"covariances have shape {C.shape}, wanted {(len(e), k, k)}")
    stated = finite & np.isfinite(C).all(axis=(1, 2))
    C, e_stated, e = C[stated], e[stated], e[finite]
    if not len(e):
        nothing = np.full(k, np.nan)
        return Accuracy(0, nothing, nothing, nothing)
    rmse, mean, maximum = np.sqrt(np.mean(e * e, axis=0)), e.mean(axis=0), np.abs(e).max(axis=0)
    if not len(C):
        return Accuracy(len(e), rmse, mean, maximum)
    sigma = np.sqrt(np.mean(np.diagonal(C, axis1=1, axis2=2), axis=0))
    return Accuracy(len(e), rmse, mean, maximum, sigma, float(np.mean(normalised_error_squared(e_stated, C))) / k)


def normalised_error_squared(error: ArrayLike, covariance: ArrayLike) -> Array:
    """``e^T C^-1 e`` (n,) of errors (n, k) and covariances (n, k, k): chi-square, k degrees of freedom, if C is right.

    Components are scaled to their sigma first (metres beside radians); a singular covariance is pseudo-inverted.
    """
    e, C = np.asarray(error, dtype=float), np.asarray(covariance, dtype=float)
    s = np.sqrt(np.diagonal(C, axis1=-2, axis2=-1))
    s = np.where(s > 0, s, 1.0)
    correlation = C / (s[..., :, None] * s[..., None, :])
    z = e / s
    return np.einsum("...i,...ij,...j->...", z, np.linalg.pinv(correlation, hermitian=True), z)


def nees_band(n: int, k: int, alpha: float = 0.05) -> tuple[float, float]:
    """Two-sided band of the mean of n independent normalised errors squared of k components, divided by k."""
    if n < 1 or k < 1:
        raise ValueError(f"n = {n} and k = {k}, wanted 1 at least")
    low, high = chi2.ppf([alpha / 2, 1 - alpha / 2], n * k) / (n * k)
    return float(low), float(high)


def angle_difference(a: ArrayLike, b: ArrayLike) -> Array:
    """``a - b`` of angles in radians, brought into [-pi, pi)."""
    d = np.asarray(a, dtype=float) - np.asarray(b, dtype=float)
    return (d + np.pi) % (2 * np.pi) - np.pi
