"""Derivatives and the propagation of covariance: the answer where the function is nearly linear."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .inputs import Function, results_of

Array = NDArray[np.floating]

#: Step of the derivative in sigmas. Derived: the error is the third derivative over 6 times its square, rounding over
#: it; a thousandth of both where the function bends within a sigma.
_STEP = 0.03


@dataclass(frozen=True)
class Propagated:
    """Covariance of results by derivatives.

    Attributes
    ----------
    jacobian : (k, d) derivatives of the results by the parameters
    covariance : (k, k)
    share : (k, d) of each parameter in the variance of a result; adds up to 1 where parameters are independent; NaN
        where the result does not scatter
    """

    jacobian: Array
    covariance: Array
    share: Array

    @property
    def sigma(self) -> Array:
        """(k,) of the results."""
        return np.sqrt(np.diag(self.covariance))


def derivatives(function: Function, mean: ArrayLike, step: ArrayLike) -> Array:
    """Derivatives (k, d) at ``mean`` (d,) by central differences of ``step`` (d,).

    Raises
    ------
    ValueError : a result that is not a number, a step of zero
    """
    x, h = np.asarray(mean, dtype=float), np.broadcast_to(np.asarray(step, dtype=float), np.shape(mean))
    if not (h > 0).all():
        raise ValueError(f"steps {h.tolist()} of a derivative, wanted numbers above 0")
    out = results_of(function, np.concatenate([x + np.diag(h), x - np.diag(h)]))
    J = (out[: len(x)] - out[len(x) :]).T / (2.0 * h)
    if not np.isfinite(J).all():
        raise ValueError("the function gives no number beside the place of the derivative")
    return J


def propagate(function: Function, mean: ArrayLike, covariance: ArrayLike) -> Propagated:
    """Covariance of results from that of the parameters, ``J C J'``.

    Parameters
    ----------
    function : parameters (n, d) to results (n, k)
    mean : (d,)
    covariance : (d, d), or (d,) variances of independent parameters; a variance of zero keeps the parameter

    Raises
    ------
    ValueError : a result that is not a number
    """
    x, C = np.asarray(mean, dtype=float), np.asarray(covariance, dtype=float)
    C = np.diag(C) if C.ndim == 1 else C
    sigma = np.sqrt(np.diag(C))
    J = np.zeros((results_of(function, x[None]).shape[1], len(x)))
    free = np.flatnonzero(sigma > 0)

    def of_the_free(values: Array) -> Array:
        full = np.tile(x, (len(values), 1))
        full[:, free] = values
        return function(full)

    if len(free):
        J[:, free] = derivatives(of_the_free, x[free], _STEP * sigma[free])
    total = J @ C @ J.T
    variance = np.diag(total)[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        share = np.where(variance > 0, (J * sigma) ** 2 / variance, np.nan)
    return Propagated(J, total, share)
