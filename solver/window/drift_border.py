"""Unknowns of drifting tie points as a border of the normal equations: of a batch, and of what has left.

The unknowns ``b``, four for a group of rays, are held at zero. With the effect ``B`` of ``b`` on whitened residuals
``v``, and S that projects out the object points, the border has the scores ``s = sum B^T S (v + A theta)``, the
coupling ``M = sum B^T S A`` to the other unknowns, and the normal matrix ``sum B^T S B``. When unknowns leave the
window they are eliminated from it as from the rest.

Where an object point is known, ``b`` and the biases of its coordinates (`control_biases`) are coupled as well; there
the unknowns of the border have the numbers -1, -2, ... beside those of the state. In a block of strips they are
unknowns as others are, but for their numbers (`of_block`) and that they are held at zero until they are named.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular

from ..adjustment.normal_equations import PointNormals, inverse_factors
from .batch import Information
from .compensation import Named
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

    def on_point(self, place: int) -> Array:
        """On a point of the batch (k, 3); none on one that it does not have."""
        at = int(np.searchsorted(self.points, place))
        there = at < len(self.points) and self.points[at] == place
        return self.effect[at] if there else np.zeros((len(self.unknowns), 3))

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
    used, of_ray, effect : (n,) rays of the batch, (n,) the group of each as a place in ``groups``, (n, 2, 4) what its
        unknowns do to the whitened residuals
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
    used: IntArray
    of_ray: IntArray
    effect: Array

    @property
    def of_block(self) -> IntArray:
        """Numbers of the unknowns (k,), see `of_block`."""
        return of_block(self.on_points.strip, self.places)

    def roots(self, normals: PointNormals) -> Array:
        """What they do to points (p, 3, k) of the batch as its coupling says it of others, see `Batch`."""
        L = np.linalg.inv(inverse_factors(normals)[self.on_points.points])
        result = np.zeros((len(normals.rank), 3, len(self.places)))
        result[self.on_points.points] = np.swapaxes(self.on_points.effect @ L, 1, 2)
        return result

    def on_rays(self, rays: range) -> Array:
        """What the unknowns do to the whitened residuals of rays (2 m, k)."""
        B = np.zeros((len(rays), 2, len(self.groups), EACH))
        mine = (self.used >= rays.start) & (self.used < rays.stop)
        B[self.used[mine] - rays.start, :, self.of_ray[mine]] = self.effect[mine]
        return B.reshape(2 * len(rays), -1)

    def on_point(self, place: int) -> tuple[IntArray, Array]:
        """Numbers (k,) of the unknowns, as of `control_biases`, and what they do to a point (k, 3)."""
        return -1 - self.places, self.on_points.on_point(place)


class LeftBorder:
    """Border of all batches of a strip that have left the window, as far as its unknowns are still there."""

    def __init__(self) -> None:
        n = MOST_GROUPS * EACH
        self.score, self.normal = np.zeros(n), np.zeros((n, n))
        self.numbers: IntArray = np.empty(0, dtype=np.int64)
        self.coupling = np.zeros((n, 0))
        self.rays = np.zeros(MOST_GROUPS, dtype=np.int64)
        self.shared = 0.0

    def add(self, cell: Cell) -> None:
        """A batch leaves; its unknowns are still there."""
        self.rays[cell.groups] += cell.rays
        self.shared += cell.shared
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

    def free(self, named: Named) -> Information:
        """What the unknowns of the state gain where drifts are free, but for what is known of them beforehand."""
        rows = named.rows
        M, s = self.coupling[rows], self.score[rows]
        known = np.linalg.solve(self.normal[np.ix_(rows, rows)] + np.diag(named.sigma**-2.0), np.column_stack([M, s]))
        return Information(-M.T @ known[:, :-1], -M.T @ known[:, -1], -float(s @ known[:, -1]), 0)

    def exchange(self, numbers: IntArray, change: Information) -> None:
        """Known coordinates that have left count otherwise: numbers of unknowns of the state and of the border."""
        if not (numbers < 0).any():
            return
        own = np.flatnonzero(numbers < 0)
        own = own[np.argsort(-numbers[own])]  # by their places
        other = np.flatnonzero(numbers >= 0)
        matrix = change.matrix
        self._add(
            -1 - numbers[own], change.rhs[own], matrix[np.ix_(own, own)], numbers[other], matrix[np.ix_(own, other)]
        )


def of_block(strip: int, places: IntArray) -> IntArray:
    """Numbers of a border's unknowns beside those of a block of strips: negative ones."""
    return -1 - (strip * MOST_GROUPS * EACH + places)


def _place_of(numbers: IntArray, wanted: IntArray) -> IntArray:
    """Places of numbers among others that hold them all."""
    order = np.argsort(numbers)
    return order[np.searchsorted(numbers, wanted, sorter=order)]
