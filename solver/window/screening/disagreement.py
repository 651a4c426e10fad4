"""Whether looks that come disagree more than the sigmas say.

Each point that comes is compared with the orientation as it is known without it, and without the look that disagrees
most. Its weighted squares over their median under the chi-square distribution have a median of about 0.3 over many
points if all sigmas are right, also where every fifth look is a gross error. Where that of the newest points is clearly
larger, tests of single looks are made wider by that much. A strip begins with points of two looks, of which none can be
spared; they count until there are others.

An attitude that jumps for some seconds spoils one of three looks at each point: the one that is spared. So looks are
compared by the second in which they were taken, too. Mismatches come singly. Where most looks of a second, on each CCD
line, are the ones that contradict their points, it is the trajectory of that second that is worse than stated.
"""

from __future__ import annotations

from collections.abc import Iterable
from statistics import median

import numpy as np

from ...arrays import Array
from ...quantiles import chi2, median_square
from ..state.sigma_factors import SigmaFactors
from .entry import JudgedLooks

#: Points whose disagreement is remembered, if no more come at once, those wanted to say anything, the variance ratio
#: where all is right (the median of chi-square values of one degree of freedom that are the least of three), and that
#: from which it counts. Tuned.
REMEMBERED, ENOUGH, RIGHT, CLEARLY = 60, 15, 0.3, 1.5
#: Disagreements of two looks beyond so many standard deviations may be gross errors, and this share of them is taken
#: for good: usual, and tuned, for points of which a third are spoilt. Rounds that find out.
WITHIN, SURELY_GOOD, MOST_ROUNDS = 2.5, 0.3, 30
#: Looks of a CCD line in a second, and CCD lines, that are wanted to say that a second is worse than others; the share
#: of looks that have to be wrong; how long looks are remembered, s, until the points of a second are complete. Tuned.
LOOKS_OF_A_SECOND, CCD_LINES, MOST_OF_THEM, REMEMBERED_S = 5, 2, 0.6, 25.0
#: What is left of the variance of a normal distribution within these. Derived.
KEPT_INSIDE = float((1.0 - chi2.sf(WITHIN**2, 3)) / (1.0 - chi2.sf(WITHIN**2, 1)))


class Disagreement:
    """Of the points that came last; says in `SigmaFactors.disagreement` by how much tests are to be wider.

    Attributes
    ----------
    enough : whether enough points have come to tell
    """

    def __init__(self, sigmas: SigmaFactors) -> None:
        self._sigmas = sigmas
        self._ratios: list[float] = []
        self._of_two: list[float] = []
        self._looks = JudgedLooks.none()
        self.enough = False

    @property
    def in_doubt(self) -> bool:
        """Whether they disagree more than the sigmas say, or are too few to tell."""
        return not self.enough or self._sigmas.disagreement > 1.0

    def entered(self, squares: Iterable[tuple[float, int, bool]], looks: Iterable[JudgedLooks] = ()) -> None:
        """Points have come, and looks at them.

        All that come at once count: the last 60 of some hundred would have one orientation and its error in common.

        Parameters
        ----------
        squares : each point as `entry.disagreement` judges it; those of two looks count until enough have more
        looks : of points with more
        """
        ratios, of_two = [], []
        for square, redundancy, spared in squares:
            if spared:
                ratios.append(square / median_square(redundancy))
            else:
                of_two.append(square)
        self._ratios = (self._ratios + ratios)[-max(REMEMBERED, len(ratios)) :]
        self._of_two = (self._of_two + of_two)[-max(REMEMBERED, len(of_two)) :]
        self.enough, ratio = True, RIGHT
        if len(self._ratios) >= ENOUGH:
            ratio = median(self._ratios)  # NumPy's takes fifty times as long for so few
        elif len(self._of_two) >= ENOUGH:
            ratio = RIGHT * variance_of_most(np.array(self._of_two))
        else:
            self.enough = False
        disagreement = np.sqrt(ratio / RIGHT) if ratio > CLEARLY else 1.0
        self._sigmas.disagreement = max(disagreement, self._of_worst_second(looks))

    def _of_worst_second(self, looks: Iterable[JudgedLooks]) -> float:
        """By how many sigmas the looks of that second contradict those of others which do so most; 1 where none do."""
        parts = [self._looks, *looks]
        time_s, ccd, square, wrong = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
        kept = time_s > time_s.max(initial=0.0) - REMEMBERED_S
        time_s, ccd, square, wrong = self._looks = JudgedLooks(time_s[kept], ccd[kept], square[kept], wrong[kept])
        if not wrong.any():
            return 1.0
        seconds, second = np.unique(np.floor(time_s), return_inverse=True)
        shape = len(seconds), int(ccd.max()) + 1
        number, of_them = np.zeros(shape), np.zeros(shape)
        np.add.at(number, (second, ccd), 1.0)
        np.add.at(of_them, (second, ccd), wrong)
        enough = number >= LOOKS_OF_A_SECOND
        most = ~enough | (of_them >= MOST_OF_THEM * number)
        contradict = most.all(axis=1) & (enough.sum(axis=1) >= CCD_LINES)
        squares = [float(np.median(square[wrong & (second == k)])) for k in np.flatnonzero(contradict)]
        return float(np.sqrt(max(squares) / median_square(2))) if squares else 1.0


def variance_of_most(squares: Array) -> float:
    """Variance of which squares (n,) with one degree of freedom each are, but for gross errors among them.

    With one gross error among three values their median is three times that of good ones. So the search begins with a
    smaller quantile, and goes on with the mean of those within `WITHIN` standard deviations, until nothing changes. It
    is not more than their median says: a vibration has fewer small squares than a normal distribution.

    Source: P. J. Rousseeuw, A. M. Leroy, Robust regression and outlier detection, 1987, section 5.1 (reweighted).
    """
    variance = float(np.quantile(squares, SURELY_GOOD)) / float(chi2.ppf(SURELY_GOOD, 1))
    for _ in range(MOST_ROUNDS):
        inside = squares < WITHIN**2 * variance
        before, variance = variance, float(squares[inside].mean()) / KEPT_INSIDE if inside.any() else variance
        if np.isclose(variance, before):
            break
    return min(variance, float(np.median(squares)) / median_square(1))
