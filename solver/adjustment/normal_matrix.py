"""The reduced normal matrix while it is being summed up: dense, or blocks along a band with a border."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Protocol

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import reverse_cuthill_mckee

from ..arrays import Array, IntArray
from .frontal import FrontalMatrix, that_count
from .nested_dissection import Dissection, find_fronts
from .reduced_system import BandedFactor, DenseFactor, Factor, mirror

#: Systems up to this size are dense whatever their structure.
DENSE_UP_TO = 600
#: Systems from this size on are tried in fronts. Tuned: below, a band is as fast.
FRONTS_FROM = 1200
#: Fronts are taken if a band, or a dense matrix, takes so many times their work. Tuned: they do it in smaller pieces.
WORTH = 4.0
#: Elements of a block for each pair of ranges from which on it is added range by range: what a slice costs in elements,
#: by order of magnitude.
LONG_RANGES = 200
#: Levels of the band are joined to blocks of at least this size.
BLOCK = 48


@dataclass(frozen=True)
class Structure:
    """Order and blocks of the unknowns: block i has entries with blocks i - 1, i, i + 1 and the border only.

    Attributes
    ----------
    position : (n,) place of each unknown in the order of the band
    bounds : (T + 1,) limits of the blocks; behind ``bounds[-1]`` stands the border
    """

    position: IntArray
    bounds: IntArray


class NormalMatrix(Protocol):
    """A symmetric matrix that blocks are added to and subtracted from."""

    def add_each(self, columns: IntArray, blocks: Array) -> None:
        """Add small symmetric blocks (k, m, m), each at its unknowns (k, m) in any order, -1 for none."""
        ...

    def subtract(self, columns: IntArray, block: Array) -> None:
        """Subtract a symmetric block (m, m) at some unknowns (m,), which ascend."""
        ...

    def add_sparse(self, matrix: csr_array) -> None:
        """Add a symmetric sparse matrix (n, n), which has every entry once."""
        ...

    def damp(self, damping: float) -> None:
        """Multiply the diagonal by ``1 + damping``."""
        ...

    def keep_scale(self) -> None:
        """Remember the diagonal as it is now: the scale that the rounding of what is subtracted later is judged by."""
        ...

    def take_scale(self, diagonal: Array) -> None:
        """Take a diagonal (n,) for that scale."""
        ...

    def factorise(self) -> Factor: ...


class DenseMatrix:
    """All of it.

    Attributes
    ----------
    lower : (n, n); what stands above the diagonal means nothing before `whole` is called
    """

    def __init__(self, n: int):
        self.lower = np.zeros((n, n))
        self.reference: Array | None = None

    def add_each(self, columns: IntArray, blocks: Array) -> None:
        if columns.min(initial=0) < 0:
            counts = columns >= 0
            columns, blocks = np.maximum(columns, 0), blocks * (counts[:, :, None] & counts[:, None, :])
        place = columns[:, :, None] * len(self.lower) + columns[:, None, :]
        np.add.at(self.lower.reshape(-1), place.ravel(), blocks.ravel())

    def subtract(self, columns: IntArray, block: Array) -> None:
        ranges = _ranges(columns)
        for i, (row, own_row) in enumerate(ranges):
            band, part = self.lower[row], block[own_row]
            for column, own_column in ranges[: i + 1]:
                band[:, column] -= part[:, own_column]

    def whole(self) -> Array:
        """(n, n) with both triangles."""
        mirror(self.lower)
        return self.lower

    def add_sparse(self, matrix: csr_array) -> None:
        row = np.repeat(np.arange(len(self.lower)), np.diff(matrix.indptr))
        self.lower[row, matrix.indices] += matrix.data

    def damp(self, damping: float) -> None:
        self.lower[np.diag_indices_from(self.lower)] *= 1.0 + damping

    def keep_scale(self) -> None:
        self.reference = np.diagonal(self.lower).copy()

    def take_scale(self, diagonal: Array) -> None:
        self.reference = diagonal.copy()

    def factorise(self) -> Factor:
        """Factor, which overwrites the matrix."""
        return DenseFactor(self.whole(), self.reference)


class BandedMatrix:
    """Diagonal blocks, the blocks below them, the border below all, and its corner."""

    def __init__(self, structure: Structure):
        self.structure = structure
        size = np.diff(structure.bounds)
        edge = len(structure.position) - int(structure.bounds[-1])
        self.diagonal: list[Array] = [np.zeros((m, m)) for m in size]
        self.below: list[Array] = [np.zeros((low, m)) for m, low in pairwise(size)]
        self.border: list[Array] = [np.zeros((edge, m)) for m in size]
        self.corner = np.zeros((edge, edge))
        self.reference: Array | None = None

    def add_each(self, columns: IntArray, blocks: Array) -> None:
        for own, block in that_count(columns, blocks):
            self.subtract(own, -block)

    def subtract(self, columns: IntArray, block: Array) -> None:
        bounds = self.structure.bounds
        place = self.structure.position[columns]
        if not (np.diff(place) > 0).all():
            order = np.argsort(place)
            place, block = place[order], block[np.ix_(order, order)]
        cut = np.searchsorted(place, bounds)
        first = int(np.searchsorted(bounds, place[0], side="right")) - 1
        last = len(bounds) - 1
        edge = slice(int(cut[-1]), len(place))
        at_edge = place[edge] - bounds[-1]
        for i in range(first, last):
            own = slice(int(cut[i]), int(cut[i + 1]))
            if own.start == len(place) or own.start == own.stop:
                if i > first:
                    break
                continue
            here = place[own] - bounds[i]
            _subtract_at(self.diagonal[i], here, here, block[own, own])
            if i + 1 < last and cut[i + 1] < cut[i + 2]:
                following = slice(int(cut[i + 1]), int(cut[i + 2]))
                _subtract_at(self.below[i], place[following] - bounds[i + 1], here, block[following, own])
            if len(at_edge):
                _subtract_at(self.border[i], at_edge, here, block[edge, own])
        _subtract_at(self.corner, at_edge, at_edge, block[edge, edge])

    def add_sparse(self, matrix: csr_array) -> None:
        entries = matrix.tocoo()
        row, column = (self.structure.position[i] for i in entries.coords)
        bounds, last = self.structure.bounds, len(self.structure.bounds) - 1
        block_row, block_column = (np.searchsorted(bounds, p, side="right") - 1 for p in (row, column))
        keep = np.flatnonzero(block_row >= block_column)  # the upper blocks are not stored
        keep = keep[np.argsort(block_column[keep], kind="stable")]
        limits = np.searchsorted(block_column[keep], np.arange(last + 2))
        for i in range(last + 1):
            own = keep[limits[i] : limits[i + 1]]
            for target, j in self._column(i):
                mine = own[block_row[own] == j]
                if len(mine):
                    np.add.at(target, (row[mine] - bounds[j], column[mine] - bounds[i]), entries.data[mine])

    def _column(self, i: int) -> list[tuple[Array, int]]:
        """Stored blocks of column i with their block rows."""
        last = len(self.diagonal)
        if i == last:
            return [(self.corner, last)]
        below = [(self.below[i], i + 1)] if i + 1 < last else []
        return [(self.diagonal[i], i), *below, (self.border[i], last)]

    def damp(self, damping: float) -> None:
        for block in (*self.diagonal, self.corner):
            block[np.diag_indices_from(block)] *= 1.0 + damping

    def keep_scale(self) -> None:
        self.reference = np.concatenate([np.diagonal(block) for block in (*self.diagonal, self.corner)])

    def take_scale(self, diagonal: Array) -> None:
        self.reference = np.empty(len(diagonal))
        self.reference[self.structure.position] = diagonal

    def factorise(self) -> Factor:
        if self.reference is None:
            self.keep_scale()
        assert self.reference is not None
        s = self.structure
        return BandedFactor(s.position, s.bounds, self.diagonal, self.below, self.border, self.corner, self.reference)


def new_matrix(n: int, structure: Structure | Dissection | None) -> NormalMatrix:
    """A zero matrix for n unknowns."""
    if structure is None:
        return DenseMatrix(n)
    return FrontalMatrix(structure) if isinstance(structure, Dissection) else BandedMatrix(structure)


def _subtract_at(target: Array, rows: IntArray, columns: IntArray, block: Array) -> None:
    """``target[rows, columns] -= block``, range by range where they are long, else by flat places.

    Flat places are three times as fast as rows and columns, ranges ten times.
    """
    of_rows = _ranges(rows)
    of_columns = of_rows if columns is rows else _ranges(columns)
    if len(of_rows) * len(of_columns) * LONG_RANGES > block.size:
        place = (rows[:, None] * target.shape[1] + columns).ravel()
        target.reshape(-1)[place] -= block.ravel()
        return
    for row, own_row in of_rows:
        band, part = target[row], block[own_row]
        for column, own_column in of_columns:
            band[:, column] -= part[:, own_column]


def _ranges(places: IntArray) -> list[tuple[slice, slice]]:
    """Ranges of successive places (m,), and where among the m each of them stands."""
    ends = [0, *((places[1:] - places[:-1] != 1).nonzero()[0] + 1).tolist(), len(places)]
    return [
        (slice(first := int(places[low]), first + high - low), slice(low, high))
        for low, high in pairwise(ends)
        if high > low
    ]


def find_structure(
    n_model: int, n_unknowns: int, cliques: Sequence[IntArray], prior: csr_array
) -> Structure | Dissection | None:
    """Order and blocks for a matrix with the entries of `prior` and within some cliques; None where dense is as good.

    A large system is taken apart by nested dissection where that saves work against a band.

    Unknowns from `n_model` on (additional parameters) go to the border. The others are ordered by reverse
    Cuthill-McKee; its levels, joined until they are worth a block, are the blocks.

    Parameters
    ----------
    n_model, n_unknowns : numbers of unknowns
    cliques : sets of columns that have entries with each other
    prior : (n_unknowns, n_unknowns)
    """
    if n_unknowns <= DENSE_UP_TO:
        return None
    group, n_groups = _alike(n_model, cliques)
    size = np.bincount(group, minlength=n_groups)
    member = np.zeros((len(cliques), n_groups), dtype=bool)
    for own, c in zip(member, cliques, strict=True):
        own[group[c[c < n_model]]] = True
    touch = csr_array(member, dtype=float)
    row, column = (c.astype(np.int64) for c in prior.tocoo().coords)
    inner = (row < n_model) & (column < n_model)
    pairs = (np.ones(int(inner.sum())), (group[row[inner]], group[column[inner]]))
    graph = csr_array(touch.T @ touch + csr_array(pairs, shape=(n_groups, n_groups)))
    order = np.asarray(reverse_cuthill_mckee(graph, symmetric_mode=True), dtype=np.int64)
    place = np.empty(n_groups, dtype=np.int64)
    place[order] = np.arange(n_groups)
    # furthest group that any group up to here has entries with
    reach = np.arange(n_groups)
    of_row = np.repeat(np.arange(n_groups), np.diff(graph.indptr))
    np.maximum.at(reach, place[of_row], place[graph.indices])
    reach = np.maximum.accumulate(reach)
    start = np.concatenate([[0], np.cumsum(size[order])])
    bounds = [0]
    end = 1  # groups in the blocks so far
    while end < n_groups and start[end] < BLOCK:
        end += 1
    bounds.append(int(start[end]))
    while end < n_groups:
        following = max(int(reach[end - 1]) + 1, end + 1)
        while following < n_groups and start[following] - start[end] < BLOCK:
            following += 1
        end = following
        bounds.append(int(start[end]))
    blocks = np.diff(bounds)
    edge = n_unknowns - n_model
    work = (blocks**3).sum() / 3 + (blocks[:-1] ** 2 * blocks[1:] + blocks[:-1] * blocks[1:] ** 2).sum()
    work += edge * (blocks**2).sum() * 2 + edge**2 * n_model
    dense_work = n_unknowns**3 / 3
    if n_unknowns >= FRONTS_FROM:
        dissection = find_fronts(*_whole_graph(group, n_groups, n_unknowns, cliques, prior))
        if WORTH * dissection.work < min(work, dense_work):
            return dissection
    if 2 * work > dense_work:
        return None
    position = np.empty(n_unknowns, dtype=np.int64)
    by_group = np.argsort(place[group], kind="stable")
    position[by_group] = np.arange(n_model)
    position[n_model:] = np.arange(n_model, n_unknowns)
    return Structure(position, np.array(bounds, dtype=np.int64))


def _whole_graph(
    group: IntArray, n_groups: int, n_unknowns: int, cliques: Sequence[IntArray], prior: csr_array
) -> tuple[csr_array, IntArray, IntArray]:
    """Which groups meet, the group of each unknown, and their sizes; each unknown of the border is one by itself."""
    edge = n_unknowns - len(group)
    every = np.concatenate([group, n_groups + np.arange(edge)])
    total = n_groups + edge
    member = [np.unique(every[c]) for c in cliques]
    rows = np.repeat(np.arange(len(member)), [len(m) for m in member])
    touch = csr_array((np.ones(len(rows)), (rows, np.concatenate(member))), shape=(len(member), total))
    row, column = (every[c] for c in prior.tocoo().coords)
    pairs = csr_array((np.ones(len(row)), (row, column)), shape=(total, total))
    return csr_array(touch.T @ touch + pairs), every, np.bincount(every, minlength=total)


def _alike(n_model: int, cliques: Sequence[IntArray]) -> tuple[IntArray, int]:
    """Groups of unknowns that belong to the same cliques: group of each (n_model,), and their number."""
    key = np.zeros(n_model, dtype=np.uint64)
    with np.errstate(over="ignore"):
        for k, c in enumerate(cliques):
            mine = c[c < n_model]
            key[mine] = (key[mine] ^ np.uint64(k + 1)) * np.uint64(0x9E3779B97F4A7C15)
            key[mine] ^= key[mine] >> np.uint64(29)
    unique, group = np.unique(key, return_inverse=True)
    return group.astype(np.int64), len(unique)
