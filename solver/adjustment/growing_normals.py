"""Normal equations of a block of strips and their solution, in buffers that are kept.

The equations grow while a strip is flown and shrink when one is closed, hour after hour. Matrices of their own for
strips and pairs of strips, made and given back with each strip, would leave gaps in memory that nothing else fits into.
So all unknowns stand in the lower triangle of one matrix, row after row without the other half, in which they move up
when others go, and a second buffer holds whatever a solution or an elimination needs. Both only grow.
"""

from __future__ import annotations

from collections.abc import Generator
from typing import TypeVar

import numpy as np
from scipy.linalg import solve_triangular

from ..arrays import Array, IntArray
from .dense_in_parts import Cost, Parts, factorised, inverted, reduced, solved
from .reduced_system import DenseFactor

#: Unknowns that there is room for at first, and the factor by which the room grows. Memory that nothing was written to
#: is not taken from the system.
ROOM, GROWTH = 512, 1.5
#: Rows worked on in one part.
ROWS = 256
#: Cost of looking up an element, in floating point operations, about.
LOOKED_UP = 500.0


class BlockNormals:
    """See the module; unknowns go by their numbers, in any order.

    Attributes
    ----------
    numbers : (n,) of the unknowns that something is known of, as they came
    """

    def __init__(self) -> None:
        self.numbers: IntArray = np.empty(0, dtype=np.int64)
        self._order: IntArray = np.empty(0, dtype=np.int64)
        self._lower, self._rhs = np.zeros(_begin(ROOM)), np.zeros(ROOM)
        self._memory = np.empty(0)

    def __len__(self) -> int:
        return len(self.numbers)

    def _places(self, numbers: IntArray) -> IntArray:
        """Places of unknowns; -1 where nothing is known of one."""
        if not len(self.numbers):
            return np.full(len(numbers), -1, dtype=np.int64)
        at = np.searchsorted(self.numbers, numbers, sorter=self._order)
        place = self._order[np.minimum(at, len(self._order) - 1)]
        return np.where(self.numbers[place] == numbers, place, -1)

    def _enter(self, numbers: IntArray) -> IntArray:
        """Places of unknowns, with room for those that are new."""
        place = self._places(numbers)
        new = place < 0
        if new.any():
            before = len(self.numbers)
            self.numbers = np.concatenate([self.numbers, numbers[new]])
            if len(self.numbers) > len(self._rhs):
                self._make_room(before, len(self.numbers))
            self._order = np.argsort(self.numbers)
            place[new] = np.arange(before, len(self.numbers))
        return place

    def _make_room(self, old: int, n: int) -> None:
        size = max(n, int(GROWTH * len(self._rhs)))
        lower, rhs = np.zeros(_begin(size)), np.zeros(size)
        lower[: _begin(old)], rhs[:old] = self._lower[: _begin(old)], self._rhs[:old]
        self._lower, self._rhs = lower, rhs

    def add(self, numbers: IntArray, matrix: Array, rhs: Array) -> None:
        """Add information (u, u), (u,) about different unknowns (u,)."""
        place = self._enter(numbers)
        self._rhs[place] += rhs
        order = np.argsort(place)
        place, matrix = place[order], matrix.take(order, axis=0).take(order, axis=1)
        lower = np.tri(len(order), dtype=bool)
        self._lower[(_begin(place)[:, None] + place)[lower]] += matrix[lower]

    def _row(self, place: int, others: IntArray) -> Array:
        """Elements (m,) of a row."""
        return self._lower.take(_begin(np.maximum(place, others)) + np.minimum(place, others))

    def rhs(self, numbers: IntArray) -> Array:
        """Right-hand side (n,) of unknowns; 0 where nothing is known."""
        place = self._places(numbers)
        return np.where(place >= 0, self._rhs[place], 0.0)

    def lower(self, numbers: IntArray, out: Array, rows: range) -> None:
        """Put rows of the matrix of unknowns (n,) into the lower triangle of ``out`` (n, n); the upper one stays."""
        place = self._places(numbers)
        known = np.flatnonzero(place >= 0)
        for i in rows:
            out[i, : i + 1] = 0.0
            if place[i] >= 0:
                here = known[: np.searchsorted(known, i, side="right")]
                out[i, here] = self._row(int(place[i]), place[here])

    def solving(self, numbers: IntArray, weight: Array) -> Generator[Cost, None, tuple[Array, Array]]:
        """Values (n,) and cofactors (n, n) of unknowns, where all others are zero.

        In parts, each with what it costs. The cofactors last until the next solution or elimination.

        Parameters
        ----------
        weight : (n,) of each unknown as an observation of zero, beside the equations
        """
        n = len(numbers)
        N = self._kept(n * n).reshape(n, n)
        rhs, scale = yield from self._equations(numbers, weight, N)
        try:
            yield from factorised(N)
        except np.linalg.LinAlgError:  # something is hardly determined, even beforehand
            rhs, scale = yield from self._equations(numbers, weight, N)
            factor = DenseFactor(np.tril(N) + np.tril(N, -1).T)
            N[:] = factor.inverse() * scale[:, None] * scale
            return scale * factor.solve(rhs), N
        values = scale * solved(N, rhs)
        yield from inverted(N, scale)
        return values, N

    def close(self, numbers: IntArray, weight: Array) -> Parts:
        """Let unknowns (n,) go, of which nothing else will be said: what they say of others stays (Schur complement).

        In parts, each with what it costs.

        Parameters
        ----------
        weight : (n,) as in `solving`

        Raises
        ------
        numpy.linalg.LinAlgError : unknowns that are undetermined
        """
        n = len(numbers)
        memory = self._kept(n * (n + len(self)))
        own = memory[: n * n].reshape(n, n)
        rhs, scale = yield from self._equations(numbers, weight, own)
        yield from factorised(own)
        gone = self._places(numbers)
        stay = np.setdiff1d(np.arange(len(self)), gone)
        known = np.flatnonzero(gone >= 0)
        tied = np.zeros(len(stay), dtype=bool)
        for place in gone[known].tolist():
            tied |= self._row(place, stay) != 0.0
        at = stay[tied]
        yield LOOKED_UP * len(known) * len(stay)
        through = memory[n * n :][: n * len(at)].reshape(n, len(at))
        through[:] = 0.0
        for i in known.tolist():
            through[i] = self._row(int(gone[i]), at) * scale[i]
        yield LOOKED_UP * len(known) * len(at)
        yield from reduced(own, through)
        self._rhs[at] -= through.T @ solve_triangular(own, rhs, lower=True, check_finite=False)
        for begin in range(0, len(at), ROWS):
            part = slice(begin, begin + ROWS)
            less = through[:, part].T @ through[:, : begin + ROWS]
            for i, row in enumerate(at[part].tolist()):
                self._lower[_begin(row) + at[: begin + i + 1]] -= less[i, : begin + i + 1]
            yield 2.0 * n * less.size
        self.drop(numbers)

    def _equations(self, numbers: IntArray, weight: Array, out: Array) -> Generator[Cost, None, tuple[Array, Array]]:
        """Put the equations of unknowns (n,) into the lower triangle of ``out`` (n, n), scaled to a diagonal of one;
        returns the scaled right-hand side (n,) and the scale (n,)."""
        n = len(numbers)
        for begin in range(0, n, ROWS):
            rows = range(begin, min(begin + ROWS, n))
            self.lower(numbers, out, rows)
            yield LOOKED_UP * len(rows) * rows.stop
        out[np.arange(n), np.arange(n)] += weight
        diagonal = out.diagonal()
        scale = 1.0 / np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
        for row in range(n):
            out[row, : row + 1] *= scale[row] * scale[: row + 1]
        return self.rhs(numbers) * scale, scale

    def _kept(self, size: int) -> Array:
        """Memory (size,) that is used again and again, whatever it holds; what was asked for before is no more."""
        if size > len(self._memory):
            self._memory = np.empty(0)  # first let go of the old one
            self._memory = np.empty(size + size // 8)  # a strip is a little longer than another
        return self._memory[:size]

    def drop(self, numbers: IntArray) -> None:
        """Forget unknowns and what was known of others by them."""
        n = len(self)
        stay = np.setdiff1d(np.arange(n), self._places(numbers))
        for i, row in enumerate(stay.tolist()):
            self._lower[_begin(i) : _begin(i + 1)] = self._lower[_begin(row) + stay[: i + 1]]
        self._lower[_begin(len(stay)) : _begin(n)] = 0.0
        self._rhs[: len(stay)] = self._rhs[stay]
        self._rhs[len(stay) : n] = 0.0
        self.numbers = self.numbers[stay]
        self._order = np.argsort(self.numbers)


Places = TypeVar("Places", int, IntArray)


def _begin(row: Places) -> Places:
    """Where a row of the lower triangle begins."""
    return row * (row + 1) // 2
