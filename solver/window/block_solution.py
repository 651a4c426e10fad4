"""The solution of a block in parts: a turn lasts a minute, an update some milliseconds.

Cholesky factor, its inverse and their product take the place of the matrix, tile by tile, so that nothing of its size
is needed beside it; what each part costs is told, and whoever asked for it may go on with something else in between.
Generators of costs, in floating point operations, about.
"""

from __future__ import annotations

from collections.abc import Generator, Iterator
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import get_lapack_funcs, solve_triangular

from .compensation import Border, Compensation

Array = NDArray[np.floating]
IntArray = NDArray[np.int64]
Cost = float
Parts = Generator[Cost, None, None]

#: Rows and columns of a tile, and how many tiles in a row are worked on at once.
TILE, TOGETHER = 192, 3
#: Pivots of the scaled matrix below this are taken as zero.
SINGULAR = 1e-11

_potrf, _trtri = get_lapack_funcs(("potrf", "trtri"), dtype=float)


T = TypeVar("T")


def in_one_go(parts: Generator[Cost, None, T]) -> T:
    """What comes out when all parts are done."""
    while True:
        try:
            next(parts)
        except StopIteration as end:
            return end.value


@dataclass(frozen=True)
class BlockSolution:
    """Values (n,) and cofactors (n, n) of the unknowns ``numbers`` (n,), ascending.

    Beside them stand those of drifts of tie points, with negative numbers: they are zero and certain, unless they have
    been taken back.
    """

    numbers: IntArray
    values: Array
    cofactors: Array
    _drift: tuple[IntArray, Compensation] | None = None

    def places(self, numbers: IntArray) -> IntArray:
        return np.searchsorted(self.numbers, numbers)

    def of(self, numbers: IntArray) -> tuple[Array, Array]:
        """Values and cofactors of some, also of drifts."""
        own = numbers >= 0
        at = self.places(numbers[own])
        if own.all():
            return self.values[at], self.cofactors[np.ix_(at, at)]
        values, Q = np.zeros(len(numbers)), np.zeros((len(numbers), len(numbers)))
        values[own], Q[np.ix_(own, own)] = self.values[at], self.cofactors[np.ix_(at, at)]
        if self._drift is not None:
            known, drift = self._drift
            here = np.flatnonzero(np.isin(numbers, known))
            k = np.searchsorted(known, numbers[here])
            values[here], Q[np.ix_(here, here)] = drift.drift[k], drift.covariance[np.ix_(k, k)]
            across = -drift.through[at] @ drift.covariance[:, k]
            Q[np.ix_(own, here)], Q[np.ix_(here, own)] = across, across.T
        return values, Q

    def without(self, numbers: IntArray, border: Border) -> BlockSolution:
        """What it is without drifts; its arrays are used up.

        Parameters
        ----------
        numbers, border : of the unknowns (k,) of the drifts, ascending; coupled to all others
        """
        drift = border.compensation(self.values, self.cofactors, np.arange(len(self.numbers)))
        drift.apply(self.values, self.cofactors)
        return BlockSolution(self.numbers, self.values, self.cofactors, (numbers, drift))


class Workspace:
    """Memory that is used again and again; grows when it must, and is not given back."""

    def __init__(self) -> None:
        self._buffer = np.empty(0)

    def square(self, n: int) -> Array:
        """(n, n), whatever it holds; what was asked for before is no more."""
        return self._of(n * n).reshape(n, n)

    def pair(self, n: int, m: int) -> tuple[Array, Array]:
        """(n, n) and (n m,), likewise."""
        both = self._of(n * n + n * m)
        return both[: n * n].reshape(n, n), both[n * n :]

    def _of(self, size: int) -> Array:
        if size > len(self._buffer):
            self._buffer = np.empty(0)  # first let go of the old one
            self._buffer = np.empty(size + size // 8)  # a strip is a little longer than another
        return self._buffer[:size]


def factorised(A: Array) -> Parts:
    """Put the Cholesky factor L into the lower triangle of A; tiles on the diagonal become lower triangular.

    Raises
    ------
    numpy.linalg.LinAlgError : a pivot that is not clearly positive
    """
    n = len(A)
    for begin, end in _tiles(n):
        panel = A[:, begin:end]
        panel[begin:end] = np.tril(panel[begin:end])  # what stands above is whatever the memory held, no numbers maybe
        for first in range(begin, n, TOGETHER * TILE):
            last = min(first + TOGETHER * TILE, n)
            panel[first:last] -= A[first:last, :begin] @ A[begin:end, :begin].T
            yield 2.0 * (last - first) * begin * (end - begin)
        L, failed = _potrf(panel[begin:end], lower=1, clean=1)
        if failed or (np.diagonal(L) ** 2).min() <= SINGULAR:
            raise np.linalg.LinAlgError(f"pivot {begin + failed} of {n} is not positive")
        panel[begin:end] = L
        if end < n:
            panel[end:] = solve_triangular(L, panel[end:].T, lower=True, check_finite=False).T
        yield 1.0 * (n - begin) * (end - begin) ** 2


def solved(L: Array, rhs: Array) -> Array:
    """``(L L^T)^-1 rhs`` (n,) with what `factorised` made."""
    x = rhs.copy()
    tiles = list(_tiles(len(L)))
    for begin, end in tiles:
        x[begin:end] -= L[begin:end, :begin] @ x[:begin]
        x[begin:end] = solve_triangular(L[begin:end, begin:end], x[begin:end], lower=True, check_finite=False)
    for begin, end in reversed(tiles):
        x[begin:end] -= L[end:, begin:end].T @ x[end:]
        x[begin:end] = solve_triangular(L[begin:end, begin:end], x[begin:end], lower=True, trans=1, check_finite=False)
    return x


def reduced(L: Array, B: Array) -> Parts:
    """Put ``L^-1 B`` (n, m) in the place of B, with what `factorised` made."""
    for begin, end in _tiles(len(L)):
        B[begin:end] -= L[begin:end, :begin] @ B[:begin]
        B[begin:end] = solve_triangular(L[begin:end, begin:end], B[begin:end], lower=True, check_finite=False)
        yield 2.0 * B.shape[1] * end * (end - begin)


def inverted(L: Array, scale: Array) -> Parts:
    """Put ``S (L L^T)^-1 S`` with ``S = diag(scale)`` in the place of what `factorised` made, all of it."""
    n = len(L)
    for begin, end in _tiles(n):  # X = L^-1, row by row
        own, _ = _trtri(L[begin:end, begin:end], lower=1)
        row, cost = L[begin:end], 0.0
        for first, last in _tiles(begin):
            row[:, first:last] = -own @ (row[:, first:begin] @ L[first:begin, first:last])
            cost += 2.0 * (end - begin) * (begin - first + end - begin) * (last - first)
            if cost > 1e8:
                yield cost
                cost = 0.0
        L[begin:end, begin:end] = own
        yield cost
    for begin, end in _tiles(n):  # X^T X, row by row
        for first in range(0, end, TOGETHER * TILE):  # the tile on the diagonal, which all need, comes last
            last = min(first + TOGETHER * TILE, end)
            part = L[begin:, begin:end].T @ L[begin:, first:last]
            part *= scale[begin:end, None]
            part *= scale[first:last]
            L[begin:end, first:last], L[first:last, begin:end] = part, part.T
            yield 2.0 * (n - begin) * (end - begin) * (last - first)


def _tiles(n: int) -> Iterator[tuple[int, int]]:
    for begin in range(0, n, TILE):
        yield begin, min(begin + TILE, n)
