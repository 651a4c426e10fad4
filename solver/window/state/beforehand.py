"""Constant unknowns of the window that are present from the start, with what is known of them beforehand."""

from __future__ import annotations

import numpy as np

from ...arrays import Array, IntArray
from .unknowns import WindowState


class KnownBeforehand:
    """Unknowns that are zero but for their sigmas, as long as the window flies.

    Parameters
    ----------
    sigma : (m,) a priori

    Attributes
    ----------
    numbers : (m,) in the window
    sigma : (m,) as stated, or as restated
    """

    def __init__(self, sigma: Array, state: WindowState) -> None:
        self.sigma, self._state = sigma, state
        m = len(sigma)
        self.numbers: IntArray = state.new_numbers(m)
        self._equations = self.numbers[:, None].astype(np.int32), np.ones((m, 1)), np.zeros(m)
        state.last(self.numbers)
        if m:
            state.enter(self.numbers)
            state.observe(*self._equations, sigma)

    def values(self) -> tuple[Array, Array]:
        """Values (m,) and cofactors (m, m) at the present solution."""
        return self._state.values(self.numbers), self._state.covariance(self.numbers)

    def restate(self, sigma: Array) -> None:
        """State other sigmas (m,)."""
        before, self.sigma = self.sigma, sigma
        self._state.reweigh(*self._equations, before, sigma)
