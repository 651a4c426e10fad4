"""Unknowns of drifting tie points as a border of the normal equations: of a batch, of what has left, of a whole strip.

The unknowns ``b``, four for a group of rays, are held at zero. With the effect ``B`` of ``b`` on whitened residuals
``v``, and S that projects out the object points, the border has the scores ``s = sum B^T S (v + A theta)``, the
coupling ``M = sum B^T S A`` to the other unknowns, and the normal matrix ``sum B^T S B``. When unknowns leave the
window they are eliminated from it as from the rest.

Where an object point is known, ``b`` and the biases of its coordinates (`control_biases`) are coupled as well; there
the unknowns of the border have the numbers -1, -2, ... beside those of the state.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular

from .batch import Information
from .block_normals import MOST_OF_STRIP
from .state import Marginal
from .suspects import EACH

Array = NDArray[np.floating]
IntArray = NDArray[np.int64]

#: Groups at most.
MOST_GROUPS = 16


@dataclass(frozen=True)
class OnPoints:
    """What drifts do to the points of a batch, given the orientation.

    Attributes
    ----------
    strip : index
    unknowns : (k,) places in the border of the strip
    points : (m,) places in the batch, ascending
    effect : (m, k, 3) by how much a unit of an unknown shifts the coordinates, m
    """

    strip: int
    unknowns: IntArray
    points: IntArray
    effect: Array

    def of_unknowns(self, rows: IntArray, points: int) -> Array:
        """Of some unknowns, ascending, on all points (p, 3, r) of the batch."""
        mine = np.isin(self.unknowns, rows)
        at = np.searchsorted(rows, self.unknowns[mine])
        result = np.zeros((points, 3, len(rows)))
        result[self.points[:, None, None], np.arange(3)[:, None], at] = np.swapaxes(self.effect[:, mine], 1, 2)
        return result


@dataclass(frozen=True)
class Cell:
    """Border of one batch: scores (k,) at theta = 0, their normal matrix (k, k) and coupling (k, u) to unknowns.

    Attributes
    ----------
    information, weight : what the batch was when this was computed
    places : (k,) in the border
    groups, rays : which groups have how many rays
    shared : share of the variance of a ray that is noise of its position, summed over the rays
    on_points : what the unknowns do to points
    """

    information: Information
    weight: Array
    places: IntArray
    groups: IntArray
    rays: IntArray
    shared: float
    score: Array
    normal: Array
    numbers: IntArray
    coupling: Array
    on_points: OnPoints

    def on_point(self, place: int) -> tuple[IntArray, Array]:
        """Numbers (k,) of the unknowns, as of `control_biases`, and what they do to a point (k, 3)."""
        points = self.on_points.points
        at = int(np.searchsorted(points, place))
        if at < len(points) and points[at] == place:
            return -1 - self.places, self.on_points.effect[at]
        return np.empty(0, np.int64), np.empty((0, 3))


class LeftBorder:
    """Border of all batches of a strip that have left the window, as far as its unknowns are still there."""

    def __init__(self) -> None:
        n = MOST_GROUPS * EACH
        self.score, self.normal = np.zeros(n), np.zeros((n, n))
        self.numbers: IntArray = np.empty(0, dtype=np.int64)
        self.coupling = np.zeros((n, 0))
        self.rays = np.zeros(MOST_GROUPS, dtype=np.int64)
        self.shared = 0.0
        self.whole = WholeStrip()

    def add(self, cell: Cell) -> None:
        """A batch leaves; its unknowns are still there."""
        self.rays[cell.groups] += cell.rays
        self.shared += cell.shared
        self.whole.add(cell.places, cell.score, cell.normal, cell.numbers, cell.coupling)
        self._add(cell.places, cell.score, cell.normal, cell.numbers, cell.coupling)

    def _add(self, places: IntArray, score: Array, normal: Array, numbers: IntArray, coupling: Array) -> None:
        self.score[places] += score
        self.normal[np.ix_(places, places)] += normal
        new = np.setdiff1d(numbers, self.numbers)
        self.numbers = np.concatenate([self.numbers, new])
        self.coupling = np.pad(self.coupling, ((0, 0), (0, len(new))))
        self.coupling[np.ix_(places, _place_of(self.numbers, numbers))] += coupling

    def marginalised(self, marginal: Marginal, groups: int) -> Marginal:
        """Unknowns have left the window; what left, with the unknowns of so many groups among those that stayed."""
        n = EACH * groups
        T = np.zeros((len(self.score), len(marginal.gone)))
        gone = np.isin(marginal.gone, self.numbers)
        if gone.any():
            first = np.zeros_like(T)
            first[:, gone] = self.coupling[:, _place_of(self.numbers, marginal.gone[gone])]
            stayed = np.isin(marginal.stayed, self.numbers)
            rest = np.zeros((len(self.score), len(marginal.stayed)))
            rest[:, stayed] = self.coupling[:, _place_of(self.numbers, marginal.stayed[stayed])]
            T = solve_triangular(marginal.R11, first.T, trans=1, check_finite=False).T
            self.score = self.score - T @ marginal.d1
            self.normal = self.normal - T @ T.T
            self.numbers, self.coupling = marginal.stayed.copy(), rest - T @ marginal.R12
        stayed = np.concatenate([marginal.stayed, -1 - np.arange(n)])
        R12 = np.concatenate([marginal.R12, T[:n].T], axis=1)
        return Marginal(marginal.gone, stayed, marginal.R11, R12, marginal.d1)

    def exchange(self, numbers: IntArray, change: Information) -> None:
        """Known coordinates that have left count otherwise: numbers of unknowns of the state and of the border."""
        self._add(*_of_border(numbers, change))

    def exchange_in_whole(self, numbers: IntArray, change: Information) -> None:
        """The same where no unknown has left."""
        self.whole.add(*_of_border(numbers, change))


class WholeStrip:
    """Border of all batches of a strip that have left, with all its unknowns, unless it is too long for a block."""

    def __init__(self) -> None:
        n = MOST_GROUPS * EACH
        self._score, self._normal = np.zeros(n), np.zeros((n, n))
        self._coupling: dict[int, dict[int, Array]] = {}  # by group, then by unknown
        self._too_long = False

    def add(self, places: IntArray, score: Array, normal: Array, numbers: IntArray, coupling: Array) -> None:
        """Add the border of a batch: of whole groups."""
        self._score[places] += score
        self._normal[np.ix_(places, places)] += normal
        if self._too_long:
            return
        parts = coupling.reshape(-1, EACH, len(numbers))
        for group, part in zip((places[::EACH] // EACH).tolist(), parts, strict=True):
            known = self._coupling.setdefault(group, {})
            for number, column in zip(numbers.tolist(), part.T, strict=True):
                known[number] = known[number] + column if number in known else column
            if len(known) > MOST_OF_STRIP:
                self._too_long, self._coupling = True, {}
                return

    def assembled(self, rows: IntArray) -> tuple[Array, Array, IntArray, Array]:
        """Scores, normal matrix, numbers (u,) and coupling of some of the border's unknowns, whole groups."""
        of = [self._coupling.get(group, {}) for group in (rows[::EACH] // EACH).tolist()]
        numbers = np.array(sorted({number for columns in of for number in columns}), dtype=np.int64)
        coupling = np.zeros((len(of), EACH, len(numbers)))
        for i, columns in enumerate(of):
            if not columns:
                continue
            at = np.searchsorted(numbers, list(columns))
            coupling[i][:, at] = np.array(list(columns.values())).reshape(-1, EACH).T
        return self._score[rows], self._normal[np.ix_(rows, rows)], numbers, coupling.reshape(len(rows), -1)


def _of_border(numbers: IntArray, change: Information) -> tuple[IntArray, Array, Array, IntArray, Array]:
    """The border's part of a change of the normal equations: places, scores, normal matrix, unknowns, coupling."""
    own = np.flatnonzero(numbers < 0)
    own = own[np.argsort(-numbers[own])]  # by their places
    other = np.flatnonzero(numbers >= 0)
    matrix = change.matrix
    return -1 - numbers[own], change.rhs[own], matrix[np.ix_(own, own)], numbers[other], matrix[np.ix_(own, other)]


def _place_of(numbers: IntArray, wanted: IntArray) -> IntArray:
    """Places of numbers among others that hold them all."""
    order = np.argsort(numbers)
    return order[np.searchsorted(numbers, wanted, sorter=order)]
