"""What the parameters of a function scatter by."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import ndtri

Array = NDArray[np.floating]
#: Parameters (n, d) to results (n, k).
Function = Callable[[Array], Array]


class Inputs(Protocol):
    """Parameters that scatter independently of each other."""

    names: tuple[str, ...]

    def from_unit(self, share: Array) -> Array:
        """Parameters (n, d) of shares (n, d) between 0 and 1 of their distributions."""
        ...


class Normal:
    """Normally distributed parameters.

    Parameters
    ----------
    mean, sigma : (d,)
    names : for tables; numbered without them

    Raises
    ------
    ValueError : shapes that differ, a sigma that is negative or not finite
    """

    def __init__(self, mean: ArrayLike, sigma: ArrayLike, names: tuple[str, ...] = ()):
        self.mean, self.sigma = np.atleast_1d(np.asarray(mean, float)), np.atleast_1d(np.asarray(sigma, float))
        if self.mean.shape != self.sigma.shape or not (np.isfinite(self.sigma) & (self.sigma >= 0)).all():
            raise ValueError(f"sigmas {self.sigma.tolist()}, wanted {self.mean.size} numbers of at least 0")
        self.names = _names(names, self.mean.size)

    def from_unit(self, share: Array) -> Array:
        return self.mean + self.sigma * ndtri(share)


class Uniform:
    """Parameters that lie anywhere between two limits.

    Parameters
    ----------
    low, high : (d,)
    names : for tables; numbered without them

    Raises
    ------
    ValueError : shapes that differ, limits in the wrong order
    """

    def __init__(self, low: ArrayLike, high: ArrayLike, names: tuple[str, ...] = ()):
        self.low, self.high = np.atleast_1d(np.asarray(low, float)), np.atleast_1d(np.asarray(high, float))
        if self.low.shape != self.high.shape or not (self.high >= self.low).all():
            raise ValueError(f"limits {self.low.tolist()} to {self.high.tolist()}, wanted the lower one first")
        self.names = _names(names, self.low.size)

    def from_unit(self, share: Array) -> Array:
        return self.low + (self.high - self.low) * share


def _names(names: tuple[str, ...], n: int) -> tuple[str, ...]:
    if names and len(names) != n:
        raise ValueError(f"{len(names)} names of {n} parameters, wanted one each")
    return tuple(names) or tuple(str(k + 1) for k in range(n))


def results_of(function: Function, parameters: Array) -> Array:
    """Results (n, k) of parameters (n, d).

    Raises
    ------
    ValueError : results of another length
    """
    out = np.asarray(function(parameters), dtype=float)
    out = out[:, None] if out.ndim == 1 else out
    if out.ndim != 2 or len(out) != len(parameters):
        raise ValueError(f"the function gave {out.shape} for {len(parameters)} sets of parameters, wanted one row each")
    return out


def checked_results(function: Function, parameters: Array) -> Array:
    """The same for indices, which want every result.

    Raises
    ------
    ValueError : a result that is not a number
    """
    out = results_of(function, parameters)
    bad = np.flatnonzero(~np.isfinite(out).all(axis=1))
    if len(bad):
        raise ValueError(
            f"the function gave no number in {len(bad)} of {len(out)} runs, first at {parameters[bad[0]].tolist()}"
        )
    return out
