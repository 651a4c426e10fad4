"""Distributions that tests and limits are taken from, by the functions of `scipy.special`.

They have the names and the values of `scipy.stats`, which takes half a second to import and forty times as long for one
value. Arguments broadcast; degrees of freedom are positive.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import numpy as np
from scipy import special

from .arrays import Array, IntArray

Numbers = float | Sequence[float] | Array | IntArray


class chi2:
    """Chi-square with ``df`` degrees of freedom."""

    @staticmethod
    def ppf(q: Numbers, df: Numbers) -> Any:
        """Value that is exceeded with probability ``1 - q``."""
        return 2.0 * special.gammaincinv(np.multiply(0.5, df), q)

    @staticmethod
    def isf(q: Numbers, df: Numbers) -> Any:
        """Value that is exceeded with probability ``q``."""
        return special.chdtri(df, q)

    @staticmethod
    def sf(x: Numbers, df: Numbers) -> Any:
        """Probability of more than ``x``."""
        return special.chdtrc(df, x)

    @staticmethod
    def median(df: Numbers) -> Any:
        """Value that is exceeded as often as not."""
        return chi2.ppf(0.5, df)


class norm:
    """Normal distribution of mean 0 and sigma 1."""

    @staticmethod
    def ppf(q: Numbers) -> Any:
        """Value that is exceeded with probability ``1 - q``."""
        return special.ndtri(q)

    @staticmethod
    def isf(q: Numbers) -> Any:
        """Value that is exceeded with probability ``q``."""
        return -special.ndtri(q)

    @staticmethod
    def sf(x: Numbers) -> Any:
        """Probability of more than ``x``."""
        return special.ndtr(np.negative(x))

    @staticmethod
    def cdf(x: Numbers) -> Any:
        """Probability of less than ``x``."""
        return special.ndtr(x)

    @staticmethod
    def pdf(x: Numbers) -> Any:
        """Density at ``x``."""
        return np.exp(-np.square(x) / 2.0) / np.sqrt(2.0 * np.pi)


class student:
    """Student's t with ``df`` degrees of freedom."""

    @staticmethod
    def ppf(q: Numbers, df: Numbers) -> Any:
        """Value that is exceeded with probability ``1 - q``."""
        return special.stdtrit(df, q)

    @staticmethod
    def isf(q: Numbers, df: Numbers) -> Any:
        """Value that is exceeded with probability ``q``."""
        return -special.stdtrit(df, q)


class fisher:
    """Fisher's F with ``dfn`` and ``dfd`` degrees of freedom."""

    @staticmethod
    def ppf(q: Numbers, dfn: Numbers, dfd: Numbers) -> Any:
        """Value that is exceeded with probability ``1 - q``."""
        return special.fdtri(dfn, dfd, q)


@lru_cache
def median_square(redundancy: int) -> float:
    """Median of a sum of so many squares of standard normal values."""
    return float(chi2.median(redundancy))
