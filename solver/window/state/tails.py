"""How many looks fail, and whether the errors of looks have heavier tails than a normal distribution.

Looks that fail their test by far are mismatches. Where many fail narrowly they are the visible part of heavy tails, and
more of the same size have stayed in: at points whose looks check each other by little, and at control.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from ...adjustment.reliability import CRITICAL_W, NARROWLY
from .batch import Batch

#: The share is that of the looks in the window and about so many that have left it. Tuned.
COUNTED = 2000.0
#: Looks needed to say anything.
ENOUGH = 300


class Tails:
    """Counts looks that fail, and those of them that fail narrowly."""

    def __init__(self) -> None:
        self._left = np.zeros(3)  # looks that have left lately, those of them that had failed, and narrowly

    def leaving(self, batches: Iterable[Batch]) -> None:
        """Batches leave the window."""
        self._left += _counts(batches)
        self._left *= min(1.0, COUNTED / max(self._left[0], 1.0))

    def share(self, batches: Iterable[Batch]) -> float:
        """Share of looks that fail narrowly, with those of the batches in the window; 0 while there are few."""
        return self.shares(batches)[1]

    def shares(self, batches: Iterable[Batch]) -> tuple[float, float]:
        """Share of looks that fail, and `share`."""
        looks, failed, narrowly = (self._left + _counts(batches)).tolist()
        return (failed / looks, narrowly / looks) if looks >= ENOUGH else (0.0, 0.0)


def _counts(batches: Iterable[Batch]) -> np.ndarray:
    looks = fail = narrowly = 0
    for batch in batches:
        looks += len(batch.weight)
        if batch.judged is not None and batch.some_rejected:
            failed = batch.weight == 0.0
            fail += int(failed.sum())
            narrowly += int((failed & (batch.judged[2].largest_w < NARROWLY * CRITICAL_W)).sum())
    return np.array([looks, fail, narrowly], dtype=float)
