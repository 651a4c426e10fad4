"""Whether known coordinates are wrong or tie points drift, where they contradict each other.

A drift of tie points bends the orientation until it contradicts control that is right; control that is wrong bends the
orientation until tie points seem to drift. So neither is judged with the other taken for granted, and both over the
same data: a hypothesis is a drift (`suspects`), or none, together with the coordinates that are wrong if it is there
(`control_hypotheses`). Its score is the price of all that is free in it less what the squares of the adjustment lose by
that. Drifts have the price at which they would be named without control.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from .control_biases import Discrepancies
from .control_hypotheses import TOLD, Verdict
from .drift_border import Cell
from .suspects import USUAL_PX, Hypothesis, Scores

Array = NDArray[np.floating]
IntArray = NDArray[np.int64]

#: Drifts that are weighed, those that alone explain most.
MOST_WEIGHED = 3
#: What was decided before holds against the other if that is better by less.
STEADY = 6.0


@dataclass(frozen=True)
class Drifts:
    """Unknowns (k,) of drifts, of all rays of a strip.

    Attributes
    ----------
    score, normal, coupling : (k,), (k, k), (k, n) beside the n unknowns of the state
    cells : borders of the batches, by identity
    hypotheses, age : see `suspects`
    price : of a drift
    named, sigma, alarms : (m,) unknowns of those that have been named, as they may be beforehand, and how many drifts
    """

    score: Array
    normal: Array
    coupling: Array
    cells: Mapping[int, Cell]
    hypotheses: Sequence[Hypothesis]
    age: float
    price: float
    named: IntArray
    sigma: Array
    alarms: int

    def choices(self, score: Array, V: Array) -> list[tuple[Array, float]]:
        """What may drift, and what has been named: choice (k, m) of unknowns of sigma 1, and its price."""
        scores = Scores(score, V, self.age, 1.0)
        found = [(USUAL_PX * scores.of(h)[0], self.price) for h in self.hypotheses]
        if len(self.named):
            choice = np.zeros((len(score), len(self.named)))
            choice[self.named, np.arange(len(self.named))] = self.sigma
            found.append((choice, self.price * self.alarms))
        return found


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
    d: Discrepancies, drifts: Drifts, judge: Callable[[Discrepancies], Verdict], control: Verdict, blamed: bool
) -> Weighed:
    """Find what explains the discrepancies best.

    Parameters
    ----------
    d : with the drifts
    judge, control : judges control; its verdict if nothing drifts
    blamed : whether it was the tie points so far
    """
    explained = []
    for choice, price in drifts.choices(d.score, d.V):
        s = choice.T @ d.score
        gain = np.linalg.solve(choice.T @ d.V @ choice + np.eye(len(s)), np.column_stack([s, choice.T @ d.X.T]))
        explained.append((price - float(s @ gain[:, 0]), d.X @ choice, gain))
    explained.sort(key=lambda e: e[0])
    best: tuple[float, Weighed] | None = None
    for score, X, gain in explained[:MOST_WEIGHED]:
        given = replace(d, C=d.C - X @ gain[:, 1:], v=d.v - X @ gain[:, 0])
        verdict = judge(given)
        score += verdict.score
        if best is None or score < best[0]:
            best = score, Weighed(verdict, given, True, True)
    alone = Weighed(control, d, False, True)
    if best is None:
        return alone
    lead = control.score - best[0] + (STEADY if blamed else -STEADY)
    chosen = best[1] if lead > 0.0 else alone
    return replace(chosen, told=abs(lead) > TOLD)
