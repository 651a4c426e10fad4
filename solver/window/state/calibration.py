"""The additional parameters of the camera as unknowns of the window."""

from __future__ import annotations

import numpy as np

from ...adjustment.pose_noise import in_step
from ...arrays import Array
from ...camera.displacement import Displacement, most_certain
from ...camera.line_camera import LineCamera
from ...camera.self_calibration import SelfCalibration
from ...quantiles import chi2
from .beforehand import KnownBeforehand
from .unknowns import WindowState

#: Probability that a camera as calibrated is questioned by one look (statistical level).
QUESTIONED = 1e-3
#: All sigmas are stated so many times as large in one look, at least and at most. Tuned.
LEAST, MOST = 1.5, 3.0
#: Factors that are tried for the likelihood. Tuned.
BANK = (1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0)
#: Sigmas that were stated larger are stated smaller again where twice the logarithm of the likelihood of the data rises
#: by so much. Tuned.
CLEARLY_LESS = 4.0
#: Combinations of parameters count of which the observations say so much, as a share of the a-priori variance: where
#: they say hardly anything nothing speaks against the sigma either. Tuned: the sigmas of a camera 100 px off are far
#: from what is stated, so that looks say little of them at first; with a share of some per cent it is not followed.
LEAST_SEEN = 0.0003


class LiveCalibration(KnownBeforehand):
    """What a calibration leaves open; see `KnownBeforehand`.

    Attributes
    ----------
    parameters : None without any
    factor : what the sigmas of those that are questioned have been multiplied by
    """

    def __init__(self, parameters: SelfCalibration | None, state: WindowState) -> None:
        super().__init__(np.empty(0) if parameters is None else parameters.apriori_sigma, state)
        self.parameters, self.factor, self._stated = parameters, 1.0, self.sigma
        names = () if parameters is None else parameters.unknown_names
        questioned = () if parameters is None else parameters.questioned_names
        self._questioned = np.array([name in questioned for name in names], dtype=bool)

    @property
    def is_questioned(self) -> bool:
        """Whether sigmas may be stated larger."""
        return bool(self._questioned.any())

    def is_contradicted(self, variance: float, unstated: float = 0.0) -> bool:
        """Whether the solution contradicts the sigmas as a whole.

        A lens, or the place of a CCD line, that is not as calibrated is in many parameters, which are correlated: so
        they are questioned together.

        Parameters
        ----------
        variance : of looks, as they disagree, over that of right sigmas; 1 at least
        unstated : share of that variance that nobody stated: it may be a vibration, see `in_step`
        """
        test, m = self._test(variance * in_step(unstated))
        return m > 0 and bool(test > chi2.isf(QUESTIONED, m))

    def state_larger(self, variance: float) -> None:
        """State the sigmas as much larger as the solution asks for; they are contradicted."""
        test, m = self._test(variance)
        factor = min(max(float(np.sqrt(test / m)), LEAST), MOST)
        self.restate(np.where(self._questioned, factor * self.sigma, self.sigma))
        self.factor *= factor

    def state_smaller(self) -> bool:
        """State the sigmas smaller again, but not smaller than at first, where that makes the data clearly more likely;
        whether it does."""
        if self.factor == 1.0:
            return False
        factors = np.maximum(self.factor / np.array(BANK), 1.0)
        cost = self._costs(factors / self.factor)
        best = int(np.argmin(cost))
        if best == 0 or cost[0] - cost[best] < CLEARLY_LESS:
            return False
        self.factor = float(factors[best])
        self.restate(np.where(self._questioned, self.factor, 1.0) * self._stated)
        return True

    def _test(self, variance: float) -> tuple[float, int]:
        """Chi-square value of what has been found, and its degrees of freedom."""
        found, unseen = self._found()
        return float((found**2 / (1.0 + unseen)).sum()) / variance, len(found)

    def gain(self) -> float:
        """By how much minus twice the logarithm of the likelihood of the data falls where the sigmas are stated as much
        larger as is likely best."""
        cost = self._costs(np.array(BANK))
        return float(cost[0] - cost.min())

    def _costs(self, factors: Array) -> Array:
        """Minus twice the logarithm of the likelihood of the data (f,), but for a constant, with these factors (f,) on
        the sigmas as they are now."""
        found, unseen = self._found()
        variance = np.square(factors)[:, None] + unseen
        return (found**2 / variance + np.log(variance)).sum(axis=1)

    def _found(self) -> tuple[Array, Array]:
        """What the observations alone say of independent combinations (m,) of those that are questioned, in units of
        their a-priori sigmas, and its variances."""
        which = self._questioned
        value, Q = self.values()
        scale = self.sigma[which]
        value, left = value[which] / scale, np.eye(len(scale)) - Q[np.ix_(which, which)] / np.outer(scale, scale)
        share, vectors = np.linalg.eigh(left)
        seen = share > LEAST_SEEN
        return (vectors.T @ value)[seen] / share[seen], 1.0 / share[seen] - 1.0

    def worst(self, camera: LineCamera) -> Displacement:
        """Where looks are most certainly off, by what is known of the parameters."""
        assert self.parameters is not None
        return most_certain(camera, self.parameters, *self.values())
