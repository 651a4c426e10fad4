"""Monte Carlo: what results scatter by, however bent the function is, and whether the number of runs was enough."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .inputs import Function, results_of

Array = NDArray[np.floating]

#: Percentiles that are told: the middle, and the limits of 68.3 and 95 %.
PERCENTILES = (2.5, 15.85, 50.0, 84.15, 97.5)
_FIRST_STOP = 64


@dataclass(frozen=True)
class MonteCarlo:
    """What was drawn.

    Attributes
    ----------
    mean : (k,)
    covariance : (k, k)
    percentiles : (len(PERCENTILES), k)
    sigma_error : (k,) standard error of the sigmas, from the fourth moments
    stops : (m,) numbers of runs, doubling, after which sigmas were taken down
    sigma_at_stops : (m, k)
    converged : whether the standard errors of all sigmas are below the tolerance, as shares of the sigmas
    runs, missed : drawn, and how many of them gave no number (left out)
    """

    mean: Array
    covariance: Array
    percentiles: Array
    sigma_error: Array
    stops: NDArray[np.int_]
    sigma_at_stops: Array
    converged: bool
    runs: int
    missed: int

    @property
    def sigma(self) -> Array:
        """(k,) of the results."""
        return np.sqrt(np.diag(self.covariance))


def monte_carlo(
    function: Function,
    mean: ArrayLike,
    covariance: ArrayLike,
    runs: int,
    rng: np.random.Generator,
    tolerance: float = 0.02,
) -> MonteCarlo:
    """Draw normally distributed parameters and look at the results.

    Parameters
    ----------
    function : parameters (n, d) to results (n, k)
    mean : (d,)
    covariance : (d, d), or (d,) variances
    runs : at least 100
    rng : of the draws
    tolerance : of the sigmas, relative

    Raises
    ------
    ValueError : too few runs, a covariance that is none, fewer than 100 results that are numbers
    """
    x, C = np.asarray(mean, dtype=float), np.asarray(covariance, dtype=float)
    C = np.diag(C) if C.ndim == 1 else C
    if runs < 100:
        raise ValueError(f"{runs} runs, wanted at least 100")
    values, vectors = np.linalg.eigh(C)
    if not values.min() >= -1e-9 * max(values.max(), 0.0):
        raise ValueError("the covariance of the parameters has a negative eigenvalue")
    draws = rng.standard_normal((runs, len(x))) @ (vectors * np.sqrt(np.maximum(values, 0.0))).T
    out = results_of(function, x + draws)
    good = np.isfinite(out).all(axis=1)
    if good.sum() < 100:
        raise ValueError(f"the function gave numbers in {int(good.sum())} of {runs} runs, wanted at least 100")
    kept = out[good]
    stops = [int(n) for n in _FIRST_STOP * 2 ** np.arange(40) if n < len(kept)] + [len(kept)]
    at_stops = np.array([kept[:n].std(axis=0, ddof=1) for n in stops])
    centred = kept - kept.mean(axis=0)
    variance = np.mean(centred**2, axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        # variance of a variance is (m4 - m2^2) / n; half of its relative size is that of the sigma
        relative = 0.5 * np.sqrt(np.maximum(np.mean(centred**4, axis=0) / variance**2 - 1.0, 0.0) / len(kept))
    relative = np.where(variance > 0, relative, 0.0)
    return MonteCarlo(
        kept.mean(axis=0), np.atleast_2d(np.cov(kept, rowvar=False)), np.percentile(kept, PERCENTILES, axis=0),
        relative * at_stops[-1], np.array(stops), at_stops, bool((relative < tolerance).all()), runs,
        int((~good).sum()),
    )  # fmt: skip
