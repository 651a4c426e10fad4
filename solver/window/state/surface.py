"""The surface that tie points lie on, as the window knows it: its shift is an unknown that all strips share."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...adjustment.surface_control import SurfaceControl, SurfaceShift
from ...arrays import Array
from .unknowns import WindowState


class LiveSurface:
    """Parameters and attributes:

    control : the surface and its sigmas; None for none
    numbers : (1,) of its shift among the unknowns; (0,) without a surface
    free : the shift contradicts all else that is known of heights, so that what was stated of it does not count
    """

    def __init__(self, control: SurfaceControl | None, state: WindowState) -> None:
        self.control, self._state = control, state
        self.numbers = state.new_numbers(0 if control is None else 1)
        self.free = False
        state.last(self.numbers)
        if control is not None:
            state.enter(self.numbers)
            state.observe(self._columns, np.ones((1, 1)), np.zeros(1), self.sigma)

    @property
    def sigma(self) -> Array:
        """(1,) of the shift as stated, m; (0,) without a surface."""
        return np.empty(0) if self.control is None else np.array([self.control.shift_sigma_m])

    @property
    def _columns(self) -> NDArray[np.int32]:
        return self.numbers[:, None].astype(np.int32)

    @property
    def shift_m(self) -> float:
        """As estimated; 0 without a surface."""
        return float(self._state.values(self.numbers).sum())

    def test(self, critical: float) -> SurfaceShift:
        """The shift at the present solution against what was stated of it."""
        assert self.control is not None
        variance = float(self._state.covariance(self.numbers)[0, 0])
        return SurfaceShift.of(self.shift_m, variance, self.control.shift_sigma_m, self.free, critical)

    def release(self, free: bool) -> Array:
        """Have what was stated of the shift count no more, or again; change of its weight (1, 1) in the equations."""
        before, now = (np.where(f, np.inf, self.sigma) for f in (self.free, free))
        self._state.reweigh(self._columns, np.ones((1, 1)), np.zeros(1), before, now)
        self.free = free
        return np.diag(now**-2.0 - before**-2.0)

    def hidden(self, Qg: Array, delta: float) -> Array:
        """By how much functions are off (1, k) if the surface is shifted by as much as its test does not notice.

        Nothing (0, k) without a surface, and where its shift is free.

        Parameters
        ----------
        Qg : (n, k) cofactors of the unknowns with the functions
        delta : non-centrality of the test
        """
        if self.free or not len(self.numbers):
            return np.zeros((0, Qg.shape[1]))
        S = self.sigma[0]
        redundancy = max(1.0 - float(self._state.covariance(self.numbers)[0, 0]) / S**2, 1e-9)
        return delta / (S * np.sqrt(redundancy)) * np.abs(Qg[self._state.places(self.numbers)])
