"""Distributions that tests and limits are taken from, by the functions of `scipy.special`.

They have the names and the values of `scipy.stats`, which takes half a second to import and forty times as long for one
value. Arguments broadcast; degrees of freedom are positive.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy import special


class chi2:
    """Chi-square with ``df`` degrees of freedom."""

    @staticmethod
    def ppf(q: ArrayLike, df: ArrayLike) -> Any:
        """Value that is exceeded with probability ``1 - q``."""
        return 2.0 * special.gammaincinv(np.multiply(0.5, df), q)

    @staticmethod
    def isf(q: ArrayLike, df: ArrayLike) -> Any:
        """Value that is exceeded with probability ``q``."""
        return special.chdtri(df, q)

    @staticmethod
    def sf(x: ArrayLike, df: ArrayLike) -> Any:
        """Probability of more than ``x``."""
        return special.chdtrc(df, x)

    @staticmethod
    def median(df: ArrayLike) -> Any:
        """Value that is exceeded as often as not."""
        return chi2.ppf(0.5, df)


class norm:
    """Normal distribution of mean 0 and sigma 1."""

    @staticmethod
    def ppf(q: ArrayLike) -> Any:
        """Value that is exceeded with probability ``1 - q``."""
        return special.ndtri(q)

    @staticmethod
    def isf(q: ArrayLike) -> Any:
        """Value that is exceeded with probability ``q``."""
        return -special.ndtri(q)

    @staticmethod
    def sf(x: ArrayLike) -> Any:
        """Probability of more than ``x``."""
        return special.ndtr(np.negative(x))

    @staticmethod
    def cdf(x: ArrayLike) -> Any:
        """Probability of less than ``x``."""
        return special.ndtr(x)

    @staticmethod
    def pdf(x: ArrayLike) -> Any:
        """Density at ``x``."""
        return np.exp(-np.square(x) / 2.0) / np.sqrt(2.0 * np.pi)


class student:
    """Student's t with ``df`` degrees of freedom."""

    @staticmethod
    def ppf(q: ArrayLike, df: ArrayLike) -> Any:
        """Value that is exceeded with probability ``1 - q``."""
        return special.stdtrit(df, q)

    @staticmethod
    def isf(q: ArrayLike, df: ArrayLike) -> Any:
        """Value that is exceeded with probability ``q``."""
        return -special.stdtrit(df, q)


class fisher:
    """Fisher's F with ``dfn`` and ``dfd`` degrees of freedom."""

    @staticmethod
    def ppf(q: ArrayLike, dfn: ArrayLike, dfd: ArrayLike) -> Any:
        """Value that is exceeded with probability ``1 - q``."""
        return special.fdtri(dfn, dfd, q)


@lru_cache
def median_square(redundancy: int) -> float:
    """Median of a sum of so many squares of standard normal values."""
    return float(chi2.median(redundancy))
