"""Normal equations of a block of strips, in one buffer that is kept.

They grow while a strip is flown and shrink when one is closed, hour after hour. Matrices of their own for strips and
pairs of them, made and given back with each strip, leave holes in memory that nothing else fits into; so all unknowns
stand in the lower triangle of one matrix, in which they move up when others go. What was touched once stays.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular

from .block_solution import Parts, factorised, reduced

Array = NDArray[np.floating]
IntArray = NDArray[np.int64]

#: Room for unknowns at first, and by how much it grows; what nothing was written to costs nothing.
ROOM, GROWTH = 512, 1.5
#: Rows worked on at once.
ROWS = 256
#: What it costs to look up an element, in operations.
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
        self._matrix, self._rhs = np.zeros((ROOM, ROOM)), np.zeros(ROOM)

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
        new = numbers[self._places(numbers) < 0]
        if len(new):
            n = len(self.numbers) + len(new)
            if n > len(self._rhs):
                self._make_room(n)
            self.numbers = np.concatenate([self.numbers, new])
            self._order = np.argsort(self.numbers)
        return self._places(numbers)

    def _make_room(self, n: int) -> None:
        old, size = len(self.numbers), max(n, int(GROWTH * len(self._rhs)))
        matrix, rhs = np.zeros((size, size)), np.zeros(size)
        for row in range(old):
            matrix[row, : row + 1] = self._matrix[row, : row + 1]
        rhs[:old] = self._rhs[:old]
        self._matrix, self._rhs = matrix, rhs

    def add(self, numbers: IntArray, matrix: Array, rhs: Array) -> None:
        """Add information (u, u), (u,) about different unknowns (u,)."""
        place = self._enter(numbers)
        self._rhs[place] += rhs
        order = np.argsort(place)
        row, column = np.tril_indices(len(order))
        row, column = order[row], order[column]
        self._matrix[place[row], place[column]] += matrix[row, column]

    def _row(self, place: int, others: IntArray) -> Array:
        """Elements (m,) of a row."""
        return self._matrix[np.maximum(place, others), np.minimum(place, others)]

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

    def rows(self, numbers: IntArray, others: IntArray) -> Array:
        """Elements (n, m) between unknowns; 0 where nothing is known."""
        place, at = self._places(numbers), self._places(others)
        result, known = np.zeros((len(numbers), len(others))), np.flatnonzero(at >= 0)
        for i in np.flatnonzero(place >= 0):
            result[i, known] = self._row(int(place[i]), at[known])
        return result

    def close(self, numbers: IntArray, own: Array, rhs: Array, room: Array) -> Parts:
        """Let unknowns (n,) go, of which nothing else will be said: what they say of others stays (Schur complement).

        In parts, each with what it costs.

        Parameters
        ----------
        own, rhs : lower triangle (n, n), (n,) of the normal equations of them alone, all that is known; used up
        room : (n m,) for m = all unknowns at least, whatever it holds

        Raises
        ------
        numpy.linalg.LinAlgError : unknowns that are undetermined
        """
        n = len(own)
        scale = 1.0 / np.sqrt(own.diagonal())
        for row in range(n):
            own[row, : row + 1] *= scale[row] * scale[: row + 1]
        yield from factorised(own)
        gone = self._places(numbers)
        stay = np.setdiff1d(np.arange(len(self)), gone)
        known = np.flatnonzero(gone >= 0)
        tied = np.zeros(len(stay), dtype=bool)
        for place in gone[known].tolist():
            tied |= self._row(place, stay) != 0.0
        at = stay[tied]
        yield LOOKED_UP * len(known) * len(stay)
        through = room[: n * len(at)].reshape(n, len(at))
        through[:] = 0.0
        for i in known.tolist():
            through[i] = self._row(int(gone[i]), at) * scale[i]
        y = rhs * scale
        yield LOOKED_UP * len(known) * len(at)
        yield from reduced(own, through)
        y = solve_triangular(own, y, lower=True, check_finite=False)
        self._rhs[at] -= through.T @ y
        for begin in range(0, len(at), ROWS):
            part = slice(begin, begin + ROWS)
            less = through[:, part].T @ through[:, : begin + ROWS]
            for i, row in enumerate(at[part].tolist()):
                self._matrix[row, at[: begin + i + 1]] -= less[i, : begin + i + 1]
            yield 2.0 * n * less.size
        self.drop(numbers)

    def drop(self, numbers: IntArray) -> None:
        """Forget unknowns and what was known of others by them."""
        n = len(self)
        stay = np.setdiff1d(np.arange(n), self._places(numbers))
        for i, row in enumerate(stay.tolist()):
            self._matrix[i, : i + 1] = self._matrix[row, stay[: i + 1]]
        for i in range(len(stay), n):
            self._matrix[i, : i + 1] = 0.0
        self._rhs[: len(stay)] = self._rhs[stay]
        self._rhs[len(stay) : n] = 0.0
        self.numbers = self.numbers[stay]
        self._order = np.argsort(self.numbers)
