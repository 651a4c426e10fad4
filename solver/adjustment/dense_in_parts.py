"""Dense linear algebra in parts, so that it can be spread over many updates of some milliseconds each.

Cholesky factor, its inverse and their product take the place of the matrix, tile by tile, so that nothing of its size
is needed beside it. The functions are generators: each part yields what it cost, in floating point operations, about,
and the caller may do something else before it asks for the next one.
"""

from __future__ import annotations

from collections.abc import Generator, Iterator
from typing import TypeVar

import numpy as np
from scipy.linalg import get_lapack_funcs, solve_triangular

from ..arrays import Array

Cost = float
Parts = Generator[Cost, None, None]

#: Rows and columns of a tile, and how many tiles in a row make one part: small enough for an update, large enough for
#: the processor's caches to matter little. Tuned.
TILE, TOGETHER = 192, 3
#: Pivots of the scaled matrix below this are taken as zero.
SINGULAR = 1e-11

_potrf, _trtri = get_lapack_funcs(("potrf", "trtri"), dtype=float)


T = TypeVar("T")


def in_one_go(parts: Generator[Cost, None, T]) -> T:
    """Do all parts; returns what the generator returns."""
    while True:
        try:
            next(parts)
        except StopIteration as end:
            return end.value


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
