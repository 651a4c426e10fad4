"""Values and cofactors of unknowns, of one moment of the window or of a block of strips."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from ...adjustment.frontal import FrontalFactor, Root
from ...arrays import Array, Bools, IntArray


class Solution(Protocol):
    """Drifts of tie points (`datum.drifts.of_block`) have negative numbers; those that are not among the unknowns are
    zero and certain."""

    def of(self, numbers: IntArray) -> tuple[Array, Array]:
        """Values (m,) and cofactors (m, m) of some unknowns, drifts among them."""
        ...


@dataclass(frozen=True)
class DenseSolution:
    """Values (n,) and cofactors (n, n) of the unknowns ``numbers`` (n,), which ascend."""

    numbers: IntArray
    values: Array
    cofactors: Array

    def of(self, numbers: IntArray) -> tuple[Array, Array]:
        """See `Solution`."""
        known, at = _places(self.numbers, numbers)
        return _among(known, self.values[at], self.cofactors[np.ix_(at, at)])


@dataclass(frozen=True)
class BlockSolution:
    """Values (n,) of the unknowns ``numbers`` (n,), which ascend, and the factor that gives their cofactors."""

    numbers: IntArray
    values: Array
    factor: FrontalFactor

    def of(self, numbers: IntArray) -> tuple[Array, Array]:
        """See `Solution`; cheap for unknowns that observations have in common."""
        known, at = _places(self.numbers, numbers)
        return _among(known, self.values[at], self.factor.cofactors(at))

    def values_of(self, numbers: IntArray) -> Array:
        """Values (m,) of some unknowns, drifts among them."""
        known, at = _places(self.numbers, numbers)
        values = np.zeros(len(numbers))
        values[known] = self.values[at]
        return values

    def of_any(self, numbers: IntArray) -> tuple[Array, Array]:
        """The same as `of` for unknowns that observations need not have in common."""
        known, at = _places(self.numbers, numbers)
        root = self.factor.rooted(at, np.eye(len(at)))
        return _among(known, self.values[at], root.joint(root))

    def rooted(self, numbers: IntArray, functions: Array) -> Root:
        """Functions (k, m) of unknowns (m,), so that `Root.joint` gives cofactors between any two of them."""
        return self.factor.rooted(np.searchsorted(self.numbers, numbers), functions)


def _places(own: IntArray, numbers: IntArray) -> tuple[Bools, IntArray]:
    """Whether unknowns (m,) are among some own ones, as all but drifts are, and the places (k,) of those that are."""
    known = numbers >= 0
    if not known.all():
        known |= np.isin(numbers, own)
    return known, np.searchsorted(own, numbers[known])


def _among(known: Bools, values: Array, Q: Array) -> tuple[Array, Array]:
    """Values (k,) and cofactors (k, k) of those of unknowns (m,) that are known, with zeros for the others."""
    if known.all():
        return values, Q
    all_values, all_Q = np.zeros(len(known)), np.zeros((len(known), len(known)))
    all_values[known], all_Q[np.ix_(known, known)] = values, Q
    return all_values, all_Q
