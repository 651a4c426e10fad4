"""Which of several adjustments the same check points cannot tell from the best one: the model confidence set.

P. R. Hansen, A. Lunde, J. M. Nason (2011): The model confidence set. Econometrica 79, 453-497; statistic T_max. Losses
are compared point by point, so that what a check point does to all adjustments falls out, and it is allowed for that
the best one was chosen by the same points. Of errors of points take the lengths: of their squares a few points decide
alone, and nothing is told apart.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from ..arrays import Bools
from ..quantiles import norm, student

#: Confidence that the adjustment with the smallest expected loss is in the set; a statistical level.
CONFIDENCE = 0.95

#: Fewer points are too few to resample: nothing is told apart. Tuned: from so many on, 2 to 30 adjustments that are
#: equally good are all kept in 92 to 97 of 100 draws, of fewer points in less.
LEAST_POINTS = 6

#: Resamplings of the points; the level is good to 0.005 with them.
RESAMPLINGS = 2000


def confidence_set(loss: ArrayLike, confidence: float = CONFIDENCE) -> Bools:
    """Which adjustments (m,) are not told from the best one by their losses (m, n) at the same n points.

    The points are resampled with repetition. Of all adjustments the one with the largest mean loss, against its
    scatter, is left out until the largest is no larger than resampling would make it if all were equally good.

    Raises
    ------
    ValueError : losses that are not finite
    """
    L = np.asarray(loss, dtype=float)
    if L.ndim != 2 or not np.isfinite(L).all():
        raise ValueError("losses: wanted finite numbers (m, n)")
    m, n = L.shape
    inside = np.ones(m, dtype=bool)
    if n < LEAST_POINTS:
        return inside
    rng = np.random.default_rng(0)  # the same losses give the same set
    counts = rng.multinomial(n, np.full(n, 1.0 / n), size=RESAMPLINGS) / n
    mean, resampled = L.mean(axis=1), L @ counts.T

    def few(of: int) -> float:
        """Resampled scatters of few points are too small: normal distribution to that of Student, largest of many."""
        level = 1.0 - (1.0 - confidence) / of
        return float(student.ppf(level, n - 1) / norm.ppf(level) * np.sqrt(n / (n - 1)))

    while inside.sum() > 1:
        members = np.flatnonzero(inside)
        d = mean[members] - mean[members].mean()
        scatter = resampled[members] - resampled[members].mean(axis=0) - d[:, None]
        sigma = np.sqrt(np.mean(scatter**2, axis=1))
        rounding = 1e-9 * np.abs(mean[members]).max()
        # what is always larger by the same amount has no scatter; equal adjustments differ by rounding
        t = np.where(d > rounding, np.inf, -np.inf)
        np.divide(d, sigma, out=t, where=sigma > rounding)
        if not np.isfinite(t.max()):
            if t.max() < 0:
                break
        else:
            sure = np.isfinite(t)
            largest = (scatter[sure] / sigma[sure, None]).max(axis=0)
            if np.mean(few(len(d)) * largest >= t.max()) > 1.0 - confidence:
                break
        inside[members[t.argmax()]] = False
    return inside
