"""Whether known coordinates are wrong or tie points drift, where they contradict each other.

A drift of tie points bends the orientation until it contradicts control that is right; control that is wrong bends the
orientation until tie points seem to drift. So neither is judged with the other taken for granted, and both over the
same data: a hypothesis is a drift (`adjustment.drift_hypotheses`), or none, together with the coordinates that are
wrong if it is there (`adjustment.bias_search`). Its score is the price of all quantities that it estimates, less what
the squares of the adjustment lose by that. Drifts have the price at which they would be named without control.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ...adjustment.bias_search import TOLD, Verdict
from ...arrays import Array
from .biases import Discrepancies

#: Drifts that are weighed together with biases of control: those that alone explain most. Bounds the time.
MOST_WEIGHED = 3
#: By how much another explanation has to be better, in squares, to replace the one decided before. Tuned.
CAUSE_STEADY = 6.0


@dataclass(frozen=True)
class Weighed:
    """What the contradiction comes from.

    Attributes
    ----------
    verdict, discrepancies : of control, and what it rests on: without the drift if there is one
    drift : whether tie points drift
    told : whether it can be told from what is second best
    """

    verdict: Verdict
    discrepancies: Discrepancies
    drift: bool
    told: bool


def weigh(
    d: Discrepancies, drifts: Sequence[tuple[Array, float]], price: float, control: Verdict, blamed: bool,
    shifted: Collection[int] | None = None,
) -> Weighed:  # fmt: skip
    """Find what explains the discrepancies best.

    Parameters
    ----------
    d : with k drift unknowns
    drifts : what may drift, unknowns of sigma 1 as combinations (k, m) of these, and the price of each
    price : of a bias of control, see `bias_search`
    control : the verdict if nothing drifts
    blamed : whether it was the tie points so far
    shifted : see `bias_search.judge`
    """
    explained = []
    for choice, price_of_drift in drifts:
        s = choice.T @ d.score
        gain = np.linalg.solve(choice.T @ d.V @ choice + np.eye(len(s)), np.column_stack([s, choice.T @ d.X.T]))
        explained.append((price_of_drift - float(s @ gain[:, 0]), d.X @ choice, gain))
    explained.sort(key=lambda e: e[0])
    alone = Weighed(control, d, False, True)
    best, lowest = alone, np.inf
    for score, X, gain in explained[:MOST_WEIGHED]:
        given = replace(d, C=d.C - X @ gain[:, 1:], v=d.v - X @ gain[:, 0])
        verdict = given.judge(price, shifted)
        if score + verdict.score < lowest:
            best, lowest = Weighed(verdict, given, True, True), score + verdict.score
    lead = control.score - lowest + (CAUSE_STEADY if blamed else -CAUSE_STEADY)
    return replace(best if lead > 0.0 else alone, told=abs(lead) > TOLD)
