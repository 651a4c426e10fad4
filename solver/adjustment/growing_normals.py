"""Normal equations of a block of strips, which grow while strips are flown and shrink when one is closed.

Looks tie an unknown of a strip to those some seconds before and after it, and to those of other strips that see the
same ground, so nearly all of a large matrix is zero. It is kept in square cells of `CELL` unknowns with consecutive
numbers, those only that something is known of. All cells stand in one array in which the place of one that is gone is
taken by the next: matrices of their own, made and given back hour after hour, would leave gaps in memory that nothing
else fits into. A solution takes the unknowns apart by nested dissection, in fronts.
"""

from __future__ import annotations

from collections.abc import Generator, Iterable
from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_triangular
from scipy.sparse import csr_array

from ..arrays import Array, Bools, IntArray
from .frontal import FrontalFactor, FrontalMatrix, Fronts
from .in_parts import Cost, Parts
from .nested_dissection import Dissection, find_fronts
from .reduced_system import ROUNDING, cholesky, mirror, scale_of

#: Unknowns of a cell, some seconds of a strip. Tuned: a solution takes a tenth longer with half as many, and a fifth
#: less with twice as many, which take half as much memory again.
CELL = 48
#: Cells that there is room for at first, and the factor by which the room grows. Memory that nothing was written to is
#: not taken from the system.
ROOM, GROWTH = 64, 1.5
#: Unknowns of a front, at most, so that its elimination is no long part.
OWN = 256
#: Cost of looking up a cell, in floating point operations, about.
LOOKED_UP = 2e4


@dataclass(frozen=True)
class _Groups:
    """Unknowns (n,) in groups, which are of one cell each and stay together.

    Attributes
    ----------
    cell : of each of g groups
    members, begin : (n,), (g + 1,) ``members[begin[i] : begin[i + 1]]`` are the places of group i among the unknowns
    of_unknown : (n,) group of each
    kept : (g,) whether a group stays when the others are closed
    """

    cell: list[int]
    members: IntArray
    begin: list[int]
    of_unknown: IntArray
    kept: Bools

    def of(self, g: int) -> IntArray:
        return self.members[self.begin[g] : self.begin[g + 1]]


class BlockNormals:
    """See the module; unknowns go by their numbers, in any order."""

    def __init__(self) -> None:
        self._row: dict[int, int] = {}  # of a cell in the arrays of its unknowns
        self._slot: dict[tuple[int, int], int] = {}  # of two cells, the later one first, among the blocks
        self._rhs: Array = np.zeros((ROOM, CELL))
        self._known: Bools = np.zeros((ROOM, CELL), dtype=bool)
        self._blocks: Array = np.zeros((ROOM, CELL, CELL))
        self._free_rows: list[int] = list(range(ROOM - 1, -1, -1))
        self._free_slots: list[int] = list(range(ROOM - 1, -1, -1))

    @property
    def numbers(self) -> IntArray:
        """(n,) of the unknowns that something is known of, ascending."""
        return self._known_in(self._row)

    def _known_in(self, cells: Iterable[int]) -> IntArray:
        """Numbers, ascending, of the unknowns of cells that something is known of."""
        parts = [cell * CELL + np.flatnonzero(self._known[self._row[cell]]) for cell in sorted(cells)]
        return np.concatenate([np.empty(0, dtype=np.int64), *parts])

    def add(self, numbers: IntArray, matrix: Array, rhs: Array) -> None:
        """Add information (u, u), (u,) about different unknowns (u,)."""
        cells, of = np.unique(numbers // CELL, return_inverse=True)
        within = numbers % CELL
        rows = np.array([self._enter(cell) for cell in cells.tolist()], dtype=np.int64)[of]
        self._rhs[rows, within] += rhs
        self._known[rows, within] = True
        slots = np.zeros((len(cells), len(cells)), dtype=np.int64)
        for i, later in enumerate(cells.tolist()):
            for k, earlier in enumerate(cells[: i + 1].tolist()):
                slots[i, k] = self._pair(later, earlier)
        lower = of[:, None] >= of
        place = (slots[np.ix_(of, of)] * CELL + within[:, None]) * CELL + within
        self._blocks.reshape(-1)[place[lower]] += matrix[lower]

    def _enter(self, cell: int) -> int:
        row = self._row.get(cell)
        if row is None:
            if not self._free_rows:
                n = len(self._rhs)
                self._rhs, self._known = _larger(self._rhs), _larger(self._known)
                self._free_rows = list(range(len(self._rhs) - 1, n - 1, -1))
            row = self._row[cell] = self._free_rows.pop()
        return row

    def _pair(self, later: int, earlier: int) -> int:
        slot = self._slot.get((later, earlier))
        if slot is None:
            if not self._free_slots:
                n = len(self._blocks)
                self._blocks = _larger(self._blocks)
                self._free_slots = list(range(len(self._blocks) - 1, n - 1, -1))
            slot = self._slot[later, earlier] = self._free_slots.pop()
        return slot

    def matrix(self, numbers: IntArray) -> Array:
        """(n, n) of unknowns, all of it; 0 where nothing is known."""
        found = np.zeros((len(numbers), len(numbers)))
        cell, within = numbers // CELL, numbers % CELL
        for (later, earlier), slot in self._slot.items():
            rows, columns = np.flatnonzero(cell == later), np.flatnonzero(cell == earlier)
            part = self._blocks[slot][np.ix_(within[rows], within[columns])]
            found[np.ix_(rows, columns)], found[np.ix_(columns, rows)] = part, part.T
        return found

    def rhs(self, numbers: IntArray) -> Array:
        """Right-hand side (n,) of unknowns; 0 where nothing is known."""
        rows = np.array([self._row.get(cell, -1) for cell in (numbers // CELL).tolist()], dtype=np.int64)
        return np.where(rows >= 0, self._rhs[rows, numbers % CELL], 0.0)

    def solving(self, numbers: IntArray, weight: Array) -> Generator[Cost, None, tuple[Array, FrontalFactor]]:
        """Values (n,) of unknowns (n,), ascending, and the factor of their equations, where all others are zero.

        In parts, each with what it costs.

        Parameters
        ----------
        weight : (n,) of each unknown as an observation of zero, beside the equations
        """
        groups = self._groups(numbers, np.empty(0, dtype=np.int64))
        dissection = self._dissect(groups)
        panels = yield from self._panels(groups, numbers, weight, dissection)
        reference = np.concatenate([np.diagonal(panel) for panel in panels])
        factor = yield from FrontalFactor.in_parts(dissection, panels, reference)
        del panels  # as large as the factor, and as what comes now
        yield from factor.selecting()
        return factor.solve(self.rhs(numbers)), factor

    def met(self, numbers: IntArray) -> IntArray:
        """Numbers, ascending, of the unknowns in cells that unknowns (n,) have entries with, without these."""
        own = set((numbers // CELL).tolist())
        cells = {b if a in own else a for a, b in self._slot if (a in own) or (b in own)} | own
        return np.setdiff1d(self._known_in(cells & self._row.keys()), numbers)

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
        met = self.met(numbers)
        every = np.union1d(numbers, met)
        heavy = np.zeros(len(every))
        heavy[np.searchsorted(every, numbers)] = weight
        groups = self._groups(every, met)
        d = self._dissect(groups)
        panels = yield from self._panels(groups, every, heavy, d)
        rhs = np.empty(len(every))
        rhs[d.position] = self.rhs(every)
        own = int(d.bounds[-2]) if len(met) else len(every)
        scale = scale_of(np.concatenate([np.diagonal(panel) for panel in panels]))
        scale[own:] = 1.0
        fronts = Fronts(d, panels)
        for t in range(len(panels) - bool(len(met))):
            here = slice(int(d.bounds[t]), int(d.bounds[t + 1]))
            panels[t] *= np.concatenate([scale[here], scale[d.rows[t]]])[:, None]
            panels[t] *= scale[here]
            columns, rest = fronts.assembled(t)
            m = columns.shape[1]
            L, sound = cholesky(columns[:m], 0.0, 10 * ROUNDING)
            if not sound:
                raise np.linalg.LinAlgError("unknowns that are to be closed are undetermined")
            factor = yield from fronts.eliminating(t, columns, rest, L)
            y = solve_triangular(L, rhs[here] * scale[here], lower=True, check_finite=False)
            rhs[d.rows[t]] -= (factor[m:] @ y) / scale[d.rows[t]]
        self.drop(numbers)
        if len(met):
            panels[-1][:] = 0.0
            less, _ = fronts.assembled(len(panels) - 1)
            mirror(less)
            place = d.position[np.searchsorted(every, met)] - own
            less = less[np.ix_(place, place)]
            self.add(met, less, rhs[own:][place] - self.rhs(met))
            yield 10.0 * less.size

    def _groups(self, numbers: IntArray, kept: IntArray) -> _Groups:
        """Unknowns (n,), ascending, by cells, with those that are kept apart from the others."""
        key = 2 * (numbers // CELL) + np.isin(numbers, kept)
        keys, of = np.unique(key, return_inverse=True)
        begin = np.concatenate([[0], np.cumsum(np.bincount(of, minlength=len(keys)))]).tolist()
        return _Groups((keys // 2).tolist(), np.argsort(of, kind="stable"), begin, of, keys % 2 == 1)

    def _pairs(self, groups: _Groups) -> list[tuple[int, int, int]]:
        """Groups that meet, each pair once, the one of the later cell first, and the slot of their cells."""
        of_cell: dict[int, list[int]] = {}
        for g, cell in enumerate(groups.cell):
            of_cell.setdefault(cell, []).append(g)
        none: list[int] = []
        return [
            (g, h, slot)
            for (a, b), slot in self._slot.items()
            for g in of_cell.get(a, none)
            for h in of_cell.get(b, none)
            if a != b or g >= h
        ]

    def _dissect(self, groups: _Groups) -> Dissection:
        pairs = self._pairs(groups)
        own = range(len(groups.cell))
        row = np.array([*own, *(p[0] for p in pairs), *(p[1] for p in pairs)])
        column = np.array([*own, *(p[1] for p in pairs), *(p[0] for p in pairs)])
        graph = csr_array((np.ones(len(row)), (row, column)), shape=(len(own), len(own)))
        last = groups.kept if groups.kept.any() else None
        return find_fronts(graph, groups.of_unknown, np.diff(groups.begin), last, OWN)

    def _panels(
        self, groups: _Groups, numbers: IntArray, weight: Array, dissection: Dissection
    ) -> Generator[Cost, None, list[Array]]:
        """The equations of unknowns (n,) as columns of the fronts, without what each says of its own unknowns above the
        diagonal."""
        d = dissection
        panels = FrontalMatrix(d).panels
        first = d.position[groups.members[groups.begin[:-1]]]
        front = np.searchsorted(d.bounds, first, side="right") - 1
        within = numbers % CELL
        cost = 0.0
        for g, h, slot in self._pairs(groups):
            block = self._blocks[slot][np.ix_(within[groups.of(g)], within[groups.of(h)])]
            if first[g] < first[h]:
                g, h, block = h, g, block.T
            t = int(front[h])
            row, column = int(d.local(t, first[g])), int(first[h] - d.bounds[t])
            panels[t][row : row + len(block), column : column + block.shape[1]] = block
            cost += LOOKED_UP
            if cost > 1e8:
                yield cost
                cost = 0.0
        heavy = np.empty(len(numbers))
        heavy[d.position] = weight
        for t, panel in enumerate(panels):
            i = np.arange(panel.shape[1])
            panel[i, i] += heavy[d.bounds[t] : d.bounds[t + 1]]
        yield cost
        return panels

    def drop(self, numbers: IntArray) -> None:
        """Forget unknowns and what was known of others by them."""
        cells, of = np.unique(numbers // CELL, return_inverse=True)
        within = {cell: numbers[of == i] % CELL for i, cell in enumerate(cells.tolist()) if cell in self._row}
        for cell, own in within.items():
            self._rhs[self._row[cell], own] = 0.0
            self._known[self._row[cell], own] = False
        gone = {cell for cell in within if not self._known[self._row[cell]].any()}
        for pair, slot in list(self._slot.items()):
            later, earlier = pair
            if later in gone or earlier in gone:
                self._blocks[slot] = 0.0
                self._free_slots.append(slot)
                del self._slot[pair]
                continue
            if later in within:
                self._blocks[slot][within[later]] = 0.0
            if earlier in within:
                self._blocks[slot][:, within[earlier]] = 0.0
        for cell in gone:
            self._free_rows.append(self._row.pop(cell))


def _larger(array: np.ndarray) -> np.ndarray:
    """The same with more room."""
    found = np.zeros((int(GROWTH * len(array)) + 1, *array.shape[1:]), dtype=array.dtype)
    found[: len(array)] = array
    return found
