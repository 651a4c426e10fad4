"""Order of many unknowns by nested dissection: regions of a block that meet in their borders only come first.

The graph of unknowns is cut where it is narrow: by one of the levels that a walk from its rim meets one after the
other, about in the middle. What is left on either side is cut again, until a part is small. Unknowns that meet nearly
all others (constants of strips, additional parameters) come last, as the border of everything.

Source: A. George and J. W. H. Liu, An automatic nested dissection algorithm for irregular finite element problems,
1978.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import breadth_first_order, connected_components

from ..arrays import Bools, IntArray

#: Unknowns of a part that is cut no more. Tuned: smaller parts save work, and cost calls.
PART = 160
#: A group of unknowns that meets so many times the usual number of groups is put to the end.
HUB = 4.0
#: Levels are cut between these shares of a part, where they are narrowest.
LEAST_SHARE = 0.3


@dataclass(frozen=True)
class Dissection:
    """Order of n unknowns in fronts; each has entries with itself and with some unknowns of later fronts only.

    Attributes
    ----------
    position : (n,) place of each unknown in the order
    bounds : (T + 1,) limits of the fronts' own places
    rows : for each front the places (r,) of later unknowns that it has entries with, after elimination, ascending
    parent : (T,) the front that its own remainder goes to; -1 for the last ones
    """

    position: IntArray
    bounds: IntArray
    rows: tuple[IntArray, ...]
    parent: IntArray

    @property
    def work(self) -> float:
        """Multiplications of a factorisation, about."""
        own, below = np.diff(self.bounds).astype(float), np.array([len(r) for r in self.rows], dtype=float)
        return float((own**3 / 6 + own**2 * below / 2 + own * below**2 / 2).sum())

    @property
    def entries(self) -> int:
        """Numbers that are stored."""
        own = np.diff(self.bounds)
        return int(sum(int(m) * (int(m) + len(r)) for m, r in zip(own, self.rows, strict=True)))

    def local(self, t: int, place: IntArray) -> IntArray:
        """Rows (k,) of a front that places (k,) stand in: its own unknowns come first, then those of later fronts."""
        first, end = self.bounds[t], self.bounds[t + 1]
        return np.where(place < end, place - first, np.searchsorted(self.rows[t], place) + (end - first))


@dataclass
class _Node:
    groups: IntArray
    children: list[_Node]


def dissect(
    graph: csr_array, size: IntArray, last: Bools | None = None, most: int | None = None
) -> list[tuple[IntArray, int]]:
    """Fronts of a graph in the order of elimination: groups of each, and the place of the front it hangs on (-1: none).

    Parameters
    ----------
    graph : (g, g) which groups of unknowns meet
    size : (g,) unknowns of each group
    last : (g,) whether a group is in the last front, which all others hang on
    most : unknowns of a front, at most, but for the last one and single groups; larger ones become a chain of them
    """
    if not len(size):
        return []
    degree = np.diff(graph.indptr)
    hub = degree > HUB * max(float(np.median(degree)), 1.0)
    if size[hub].sum() > size.sum() // 4:
        hub[:] = False
    kept = np.zeros(len(size), dtype=bool) if last is None else last
    border = np.flatnonzero(hub & ~kept)
    nodes = _cut(graph, np.flatnonzero(~hub & ~kept), size)
    if len(border):
        nodes = [_Node(border, nodes)]
    if most is not None:
        nodes = [_chained(node, size, most) for node in nodes]
    if kept.any():
        nodes = [_Node(np.flatnonzero(kept), nodes)]
    out: list[tuple[IntArray, int]] = []

    def number(node: _Node) -> int:
        below = [number(child) for child in node.children]
        out.append((node.groups, -1))
        place = len(out) - 1
        for child in below:
            out[child] = (out[child][0], place)
        return place

    for node in nodes:
        number(node)
    return out


def _chained(node: _Node, size: IntArray, most: int) -> _Node:
    """The same with fronts of so many unknowns at most."""
    below = [_chained(child, size, most) for child in node.children]
    part = (np.cumsum(size[node.groups]) - 1) // most
    found = _Node(node.groups[part == part[0]], below) if len(part) else _Node(node.groups, below)
    for i in np.unique(part)[1:].tolist():
        found = _Node(node.groups[part == i], [found])
    return found


def _cut(graph: csr_array, groups: IntArray, size: IntArray) -> list[_Node]:
    """Trees of fronts for some groups, one for each part that hangs together."""
    own = csr_array(graph[groups][:, groups])
    count, label = connected_components(own, directed=False)
    if count > 1:
        small = np.bincount(label, size[groups], count) <= PART
        loose = groups[small[label]]
        nodes = [_Node(loose, [])] if len(loose) else []
        for part in np.flatnonzero(~small).tolist():
            nodes += _cut(graph, groups[label == part], size)
        return nodes
    if size[groups].sum() <= PART:
        return [_Node(groups, [])] if len(groups) else []
    level = _levels(own)
    weight = np.bincount(level, size[groups])
    if len(weight) < 3:
        return [_Node(groups, [])]
    before = np.cumsum(weight) - weight
    share = (before + weight / 2) / weight.sum()
    inner = np.flatnonzero((share > LEAST_SHARE) & (share < 1 - LEAST_SHARE))
    inner = inner[(inner > 0) & (inner < len(weight) - 1)]
    if not len(inner):
        inner = np.array([np.clip(np.argmin(np.abs(share - 0.5)), 1, len(weight) - 2)])
    at = int(inner[np.argmin(weight[inner])])
    # of the level only what touches the far side has to go into the border
    far = level > at
    touches = (own @ far.astype(np.int8)) > 0
    border = (level == at) & touches
    near = ~far & ~border
    below = _cut(graph, groups[near], size) + _cut(graph, groups[far], size)
    return [_Node(groups[border], below)]


def _levels(graph: csr_array) -> IntArray:
    """Level of each node in a walk from the rim of a graph that hangs together."""
    count = len(graph.indptr) - 1
    start, depth, level = 0, -1, np.zeros(count, dtype=np.int64)
    for _ in range(6):
        walk = breadth_first_order(graph, start, directed=False)
        order, before = cast(tuple[IntArray, IntArray], walk)
        found = np.zeros(count, dtype=np.int64)
        for node in order[1:].tolist():
            found[node] = found[before[node]] + 1
        if found.max() <= depth:
            break
        level, depth = found, int(found.max())
        furthest = np.flatnonzero(found == depth)
        start = int(furthest[np.argmin(np.diff(graph.indptr)[furthest])])
    return level


def find_fronts(
    graph: csr_array, group: IntArray, size: IntArray, last: Bools | None = None, most: int | None = None
) -> Dissection:
    """Order and fronts of unknowns, given the group (n,) of each; see `dissect`.

    Unknowns of a group keep their order, one after the other.
    """
    fronts = dissect(graph, size, last, most)
    place = np.empty(len(size), dtype=np.int64)  # of a group in the order
    ordered = np.concatenate([own for own, _ in fronts])
    place[ordered] = np.arange(len(ordered))
    parent = np.array([up for _, up in fronts], dtype=np.int64)
    first = np.concatenate([[0], np.cumsum([len(own) for own, _ in fronts])])
    start = np.concatenate([[0], np.cumsum(size[ordered])])
    below: list[IntArray] = [np.empty(0, dtype=np.int64)] * len(fronts)
    children: list[list[int]] = [[] for _ in fronts]
    for t, (own, up) in enumerate(fronts):
        meets = place[_neighbours(graph, own)]
        parts = [meets[meets >= first[t + 1]], *(below[c][below[c] >= first[t + 1]] for c in children[t])]
        below[t] = np.unique(np.concatenate(parts))
        if up >= 0:
            children[up].append(t)
    rows = tuple(_expanded(b, start) for b in below)
    position = np.empty(len(group), dtype=np.int64)
    position[np.argsort(place[group], kind="stable")] = np.arange(len(group))
    return Dissection(position, start[first].astype(np.int64), rows, parent)


def _neighbours(graph: csr_array, groups: IntArray) -> IntArray:
    parts = [graph.indices[graph.indptr[g] : graph.indptr[g + 1]] for g in groups.tolist()]
    return np.unique(np.concatenate(parts)).astype(np.int64)


def _expanded(groups: IntArray, start: IntArray) -> IntArray:
    """Places of the unknowns of groups, by their places."""
    if not len(groups):
        return np.empty(0, dtype=np.int64)
    limits = start.tolist()
    return np.concatenate([np.arange(limits[g], limits[g + 1], dtype=np.int64) for g in groups.tolist()])
