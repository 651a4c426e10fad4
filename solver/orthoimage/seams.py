"""Which orthoimage a mosaic shows where: seams that run where the orthoimages agree, by graph cuts.

Every node (some cells square) of a tile gets the label of one orthoimage. What is made small is the sum of costs of the
labels (a place far from the middle of its CCD line, a place known less well, a place near the edge of the orthoimage)
and of the seam: between neighbouring nodes ``p, q`` of labels ``a, b`` it costs

    V = d_ab(p) + d_ab(q) + 2 LENGTH_COST

with ``d_ab`` how much the two orthoimages differ there in units of what they differ by anyhow. ``d`` is a metric of the
labels, so that moves of one label at a time ("alpha expansion": Boykov, Veksler and Zabih, 2001) each are a least cut
of a graph, which SciPy finds.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt, uniform_filter
from scipy.sparse import csr_array
from scipy.sparse.csgraph import breadth_first_order, maximum_flow

Array = NDArray[np.floating]
IntArray = NDArray[np.integer]
Mask = NDArray[np.bool_]

#: What a node of seam costs anyhow, in units of the usual difference: keeps seams short. Tuned
#: (python bench/mosaic.py --constants): between a quarter and four times of it the step across seams is the same.
LENGTH_COST = 0.25
#: What a whole step from the middle of the CCD line to its end costs a node; and a sigma twice the best one. Tuned as
#: above: smaller ones leave seams freer, larger ones keep them nearer to the middle of the overlap.
OFF_MIDDLE_COST, SIGMA_COST = 0.5, 0.5
#: Nodes nearer to the edge of an orthoimage than this cost more, and how much the last one does.
EDGE_NODES, EDGE_COST = 4, 4.0
#: A difference counts no more than so many usual ones, and where one of the two is not known so many.
MOST_DIFFERENCE, UNKNOWN_DIFFERENCE = 20.0, 40.0
#: Costs are whole numbers of this part of a usual difference, for the flow; and no cost is above this.
STEPS, MOST_COST = 64, 2**26
#: Rounds over all labels; a second one seldom changes anything.
ROUNDS = 2


def label_cost(known: Mask, off_middle: Array, sigma_m: Array | None) -> Array:
    """Cost (L, rows, columns) of showing each of L orthoimages at each node, infinite where it is not known.

    Parameters
    ----------
    known, off_middle : (L, rows, columns) whether it is known there; 0 in the middle of its lines to 1 at their ends
    sigma_m : (L, rows, columns) planimetric sigma, None without
    """
    cost = OFF_MIDDLE_COST * np.asarray(off_middle, dtype=float)
    if sigma_m is not None:
        with np.errstate(invalid="ignore"):
            s = np.where(known & np.isfinite(sigma_m), sigma_m, np.inf)
            best = s.min(axis=0)
            ratio = np.where(np.isfinite(s) & (best > 0), s / np.where(best > 0, best, 1.0) - 1.0, 0.0)
        cost = cost + SIGMA_COST * np.minimum(ratio, 1.0)
    for k, there in enumerate(known):
        if there.all():
            continue
        inside = np.asarray(distance_transform_edt(there))
        cost[k] += EDGE_COST * np.clip(1.0 - (inside - 1.0) / EDGE_NODES, 0.0, 1.0)
    return np.where(known, cost, np.inf)


def seam_labels(cost: Array, difference: Array, fixed: IntArray | None = None) -> IntArray:
    """Labels (rows, columns) with the least sum of costs, -1 where nothing is known.

    Parameters
    ----------
    cost : (L, rows, columns) of each label, `label_cost`
    difference : (L, L, rows, columns) of each pair of orthoimages in units of the usual one, NaN where not known
    fixed : (rows, columns) labels that nodes have already, -1 where free
    """
    layers = len(cost)
    none = ~np.isfinite(cost).any(axis=0)
    labels = np.where(none, -1, np.argmin(cost, axis=0))
    free = ~none
    if fixed is not None:
        held = (fixed >= 0) & ~none
        labels = np.where(held, fixed, labels)
        free &= ~held
    if layers < 2 or not free.any():
        return labels
    seam = np.where(np.isfinite(difference), np.minimum(difference, MOST_DIFFERENCE), UNKNOWN_DIFFERENCE)
    for k in range(layers):
        seam[k, k] = 0.0
    seam = np.rint(STEPS * (seam + LENGTH_COST * (1 - np.eye(layers))[..., None, None])).astype(np.int64)
    own = np.rint(np.minimum(STEPS * np.where(np.isfinite(cost), cost, 0.0), MOST_COST)).astype(np.int64)
    for _ in range(ROUNDS):
        before = labels.copy()
        for alpha in range(layers):
            may = free & np.isfinite(cost[alpha]) & (labels != alpha)
            if may.any():
                labels = _expanded(labels, alpha, may, own, seam)
        if np.array_equal(labels, before):
            break
    return labels


def _expanded(labels: IntArray, alpha: int, may: Mask, own: IntArray, seam: IntArray) -> IntArray:
    """Labels after the best move in which some of the nodes that may take label ``alpha`` do."""
    number = np.full(labels.shape, -1)
    number[may] = np.arange(int(may.sum()))
    n = int(may.sum())
    r, c = np.nonzero(may)
    change = own[alpha, r, c] - own[labels[r, c], r, c]  # cost of taking alpha, less that of staying
    tails, heads, capacities = [], [], []
    for dr, dc in ((0, 1), (1, 0)):
        p = (slice(0, labels.shape[0] - dr), slice(0, labels.shape[1] - dc))
        q = (slice(dr, None), slice(dc, None))
        some = (may[p] | may[q]) & (labels[p] >= 0) & (labels[q] >= 0)
        i, j = np.nonzero(some)
        a, b = labels[p][i, j], labels[q][i, j]
        at_p, at_q = (i, j), (i + dr, j + dc)

        def between(one, other, at_p=at_p, at_q=at_q):
            return seam[(one, other, *at_p)] + seam[(one, other, *at_q)]

        stay, q_moves, p_moves = between(a, b), between(a, alpha), between(alpha, b)
        mp, mq = may[at_p], may[at_q]
        only_p, only_q, both = mp & ~mq, mq & ~mp, mp & mq
        np.add.at(change, number[at_p][only_p], (p_moves - stay)[only_p])
        np.add.at(change, number[at_q][only_q], (q_moves - stay)[only_q])
        np.add.at(change, number[at_p][both], (p_moves - stay)[both])
        np.add.at(change, number[at_q][both], -p_moves[both])
        apart = np.maximum(q_moves + p_moves - stay, 0)  # a metric has no negative one; rounding may
        keep = both & (apart > 0)
        tails.append(number[at_p][keep])
        heads.append(number[at_q][keep])
        capacities.append(apart[keep])
    source, sink = n, n + 1
    dear, cheap = np.flatnonzero(change > 0), np.flatnonzero(change < 0)
    if not len(cheap):
        return labels
    tail = np.concatenate([*tails, np.full(len(dear), source), cheap])
    head = np.concatenate([*heads, dear, np.full(len(cheap), sink)])
    capacity = np.minimum(np.concatenate([*capacities, change[dear], -change[cheap]]), MOST_COST).astype(np.int32)
    graph = csr_array((capacity, (tail, head)), shape=(n + 2, n + 2))
    left = csr_array(graph - maximum_flow(graph, source, sink).flow)
    left.eliminate_zeros()
    left.data = (left.data > 0).astype(np.int32)
    left.eliminate_zeros()
    reached = breadth_first_order(csr_array(left.T), sink, return_predecessors=False)  # what can still reach the sink
    takes = np.zeros(n + 2, dtype=bool)
    takes[reached] = True
    out = labels.copy()
    out[r[takes[:n]], c[takes[:n]]] = alpha
    return out


def feather_weights(labels: IntArray, known: Mask, width: int) -> NDArray[np.float32]:
    """Weights (L, rows, columns) of L orthoimages, their sum 1 where anything is known.

    Across a seam they change from one orthoimage to the other over ``width`` cells; an orthoimage has none at its edge.

    Parameters
    ----------
    labels : (rows, columns) cells, -1 where nothing is known
    known : (L, rows, columns)
    width : cells; 1 or less for no transition
    """
    out = np.zeros(known.shape, dtype=np.float32)
    for k, there in enumerate(known):
        mine = (labels == k) & there
        if width <= 1:
            out[k] = mine
            continue
        if not mine.any():
            continue
        weight = np.asarray(uniform_filter(mine.astype(np.float32), size=width, mode="nearest"))
        weight = np.where(weight < 1e-4, np.float32(0.0), weight)
        if not weight.any():
            continue
        near = _around(weight > 0, width)  # an edge further off takes no weight
        if not there[near].all():
            inside = np.asarray(distance_transform_edt(there[near]), dtype=np.float32)
            weight[near] *= np.minimum(inside / np.float32(width), np.float32(1.0))
        out[k] = np.where(there, weight, 0.0)
    total = out.sum(axis=0)
    # where nothing has a weight (a label that is not known there) the first that is known counts
    bare = (total <= 0) & known.any(axis=0)
    if bare.any():
        first = np.argmax(known, axis=0)
        out[(first[bare], *np.nonzero(bare))] = 1.0
        total = out.sum(axis=0)
    return (out / np.where(total > 0, total, 1.0)).astype(np.float32)


def _around(some: Mask, cells: int) -> tuple[slice, slice]:
    """Rows and columns of the rectangle that some cells, and so many on each side of them, lie in."""
    row, column = np.flatnonzero(some.any(axis=1)), np.flatnonzero(some.any(axis=0))
    return slice(max(row[0] - cells, 0), row[-1] + cells + 1), slice(max(column[0] - cells, 0), column[-1] + cells + 1)


@dataclass(frozen=True)
class SeamLine:
    """A piece of the border between two labels.

    Attributes
    ----------
    labels : the two, the smaller one first
    corners : (n, 2) row and column of its corners, of the corners of nodes
    """

    labels: tuple[int, int]
    corners: IntArray


def seam_lines(labels: IntArray, shared: bool = False) -> list[SeamLine]:
    """Borders between the labels of nodes (rows, columns), -1 apart; each piece ends where another one begins.

    Parameters
    ----------
    shared : the last row and column are those of the next tiles, to which borders inside them belong
    """
    inner = labels[: len(labels) - shared, :], labels[:, : labels.shape[1] - shared]
    pieces: dict[tuple[int, int], list[tuple[tuple[int, int], tuple[int, int]]]] = {}
    for one, other, down in ((inner[0][:, :-1], inner[0][:, 1:], 1), (inner[1][:-1], inner[1][1:], 0)):
        r, c = np.nonzero((one != other) & (one >= 0) & (other >= 0))
        a, b = one[r, c], other[r, c]
        low, high = np.minimum(a, b).tolist(), np.maximum(a, b).tolist()
        for i, j, x, y in zip(r.tolist(), c.tolist(), low, high, strict=True):
            begin = (i, j + 1) if down else (i + 1, j)
            end = (i + 1, j + 1)
            pieces.setdefault((x, y), []).append((begin, end))
    out = []
    for pair in sorted(pieces):
        out += [SeamLine(pair, _straight(np.array(chain))) for chain in _chains(pieces[pair])]
    return out


def _chains(edges: list[tuple[tuple[int, int], tuple[int, int]]]) -> list[list[tuple[int, int]]]:
    """Edges put together to lines; where more than two meet, lines end."""
    at: dict[tuple[int, int], list[int]] = {}
    for k, ends in enumerate(edges):
        for corner in ends:
            at.setdefault(corner, []).append(k)
    unused = set(range(len(edges)))
    out = []
    # lines with ends first, then closed ones
    starts = [corner for corner in sorted(at) if len(at[corner]) != 2] + sorted(at)
    for corner in starts:
        for first in at[corner]:
            if first not in unused:
                continue
            chain, k, here = [corner], first, corner
            while True:
                unused.discard(k)
                here = edges[k][1] if edges[k][0] == here else edges[k][0]
                chain.append(here)
                following = [e for e in at[here] if e in unused]
                if len(at[here]) != 2 or not following:
                    break
                k = following[0]
            out.append(chain)
    return out


def _straight(corners: IntArray) -> IntArray:
    """Without the corners at which a line goes straight on."""
    if len(corners) < 3:
        return corners
    step = np.diff(corners, axis=0)
    turns = (step[1:] != step[:-1]).any(axis=1)
    return corners[np.concatenate([[True], turns, [True]])]
