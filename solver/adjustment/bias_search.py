"""Which of several known coordinates are wrong, judged together: sets of biases against each other.

The coordinates' discrepancies ``b`` have the covariance ``C^-1``, which allows for the errors of the GNSS and the slow
errors of the measured trajectory. A hypothesis is a set S of biases: any single coordinates, and a shift that all have
in common in an axis (the height system). It explains ``v_S' C_SS^-1 v_S`` of the weighted squares. Each bias has the
square of the critical value as its price, so that one alone is Baarda's test; the score of a set is the price of its
biases less what they explain. Where another set has nearly as low a score, it cannot be told which one is right.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np

from ..arrays import Array, Bools, IntArray

#: A set is told from another if its score is lower by so much: a little less than the price of one bias. Tuned.
TOLD = 9.0
#: By how much the score of another hypothesis has to be lower to replace what was decided before; a doubt lasts until
#: `TOLD` is exceeded by so much. Tuned.
BIAS_STEADY = 3.0
#: Sets that are followed at a time, and the biases of one at most. Bounds the time of the search.
BEAM, MOST = 24, 12
AXES = 3
#: Eigenvalues of information scaled to unit diagonal that are below this are rounding.
UNTOLD = 1e-9


@dataclass(frozen=True)
class Verdict:
    """What is wrong with c coordinates.

    Attributes
    ----------
    chosen : the best hypothesis: places of coordinates, and c + axis for a shift of all in an axis
    out : (c,) coordinates not to be used: those of the best hypothesis, and of all others that are nearly as good;
        without those of a shift that all have in common where that is one of the trajectory, and without those that
        say nothing any more once the others are out: of a point of one look, which is two conditions, the third stays
    rivals : (k, c) the coordinates of the hypotheses between which it cannot be told, the best one first; k is 1 where
        there is no other
    score : of the best hypothesis, 0 if nothing is wrong; the lower, the better
    """

    chosen: frozenset[int]
    out: Bools
    rivals: tuple[Bools, ...]
    score: float


def judge(
    C: Array, v: Array, axis: IntArray, price: float, before: Bools, shifted: Collection[int] | None = None
) -> Verdict:
    """Find the biases that explain the discrepancies.

    Parameters
    ----------
    C, v : (c, c), (c,) information about the biases, the unknowns of the adjustment eliminated
    axis : (c,) 0..2
    price : of a bias
    before : (c,) what is refused now
    shifted : axes in which the trajectory is known to be off, so that one coordinate says no more against it; a shift
        that all have in common is then one of the trajectory. None: such a shift is one of the coordinates, all are out
    """
    n = len(v)
    common = axis == np.arange(AXES)[:, None]
    covers = np.vstack([np.eye(n, dtype=bool), common])  # the coordinates that each bias concerns
    U = covers.T.astype(float)
    M, m = U.T @ C @ U, U.T @ v
    least = [1 if a in (shifted or ()) else 2 for a in range(AXES)]
    usable = np.flatnonzero(np.append(np.full(n, True), common.sum(axis=1) >= least))
    scale = 1.0 / np.sqrt(np.maximum(np.diagonal(M), 1e-30))
    scores = _search(M * scale[:, None] * scale, m * scale, usable, price)
    ranked = sorted(scores, key=scores.__getitem__)
    counted = covers if shifted is None else np.where(np.arange(len(covers))[:, None] < n, covers, False)
    refused: dict[frozenset[int], Bools] = {s: np.asarray(counted[list(s)].any(axis=0)) for s in scores}
    lowest = scores[ranked[0]]
    as_before = (s for s in ranked if scores[s] <= lowest + BIAS_STEADY and (refused[s] == before).all())
    best = next(as_before, ranked[0])
    if shifted is not None:  # a trajectory that is off is nothing unusual: coordinates have to be clearly worse
        steady = BIAS_STEADY if before.any() else 0.0
        kept = (s for s in ranked if scores[s] <= lowest + TOLD - steady and not refused[s].any())
        best = next(kept, best)
    mine = refused[best]
    rivals, out = [mine], mine.copy()
    for s in ranked:
        other = refused[s]
        if scores[s] > scores[best] + TOLD + (BIAS_STEADY if before[other].all() else 0.0):
            continue
        if (other & ~mine).any() and (mine & ~other).any() and not any((other | r == other).all() for r in rivals[1:]):
            rivals.append(other)  # and not one of them with more to it
            out |= other
    return Verdict(best, _telling(C, out), tuple(rivals), scores[best])


def _telling(C: Array, out: Bools) -> Bools:
    """Those of the coordinates that are out (c,) of which something is known when the ones before them are out.

    The others say nothing anyway. But with all coordinates of a point of one look out it would have no place, and could
    never be judged again.
    """
    out, own = out.copy(), np.flatnonzero(out)
    left = C[np.ix_(own, own)]
    nothing = UNTOLD * float(np.diagonal(left).max(initial=0.0))  # a look straight down says little of a height at all
    for k, place in enumerate(own.tolist()):
        if left[k, k] <= nothing:
            out[place] = False
        else:
            left = left - np.outer(left[:, k], left[k]) / left[k, k]
    return out


def _search(M: Array, m: Array, usable: IntArray, price: float) -> dict[frozenset[int], float]:
    """Scores of the hypotheses worth a look, the lower the better; that of none is 0."""
    scores: dict[frozenset[int], float] = {frozenset(): 0.0}
    beam = np.empty((1, 0), dtype=np.int64)  # sets, the places of each in order
    best, idle = 0.0, 0
    for size in range(1, min(MOST, len(usable)) + 1):
        places = _with_one_more(beam, usable)
        blocks = M[places[:, :, None], places[:, None]] + UNTOLD * np.eye(size)
        right = m[places]
        drop = np.einsum("ki,ki->k", right, _solved(blocks, right))
        score = price * size - drop
        order = np.argsort(score, kind="stable")[:BEAM]
        beam = places[order]
        scores.update(zip(map(frozenset, beam.tolist()), score[order].tolist(), strict=True))
        lowest = float(score[order[0]])
        best, idle = (lowest, 0) if lowest < best - 1e-9 else (best, idle + 1)
        if idle == 2:
            break
    return scores


def _solved(blocks: Array, right: Array) -> Array:
    """Solutions (k, s) of symmetric equations (k, s, s); of those that have none the least ones."""
    try:
        return np.linalg.solve(blocks, right[:, :, None])[:, :, 0]
    except np.linalg.LinAlgError:
        return (np.linalg.pinv(blocks, hermitian=True) @ right[:, :, None])[:, :, 0]


def _with_one_more(sets: IntArray, usable: IntArray) -> IntArray:
    """All different sets (k, s + 1) of one place more than sets (b, s) have, each in order, and they among each other
    as well."""
    (b, s), n = sets.shape, len(usable)
    more = np.column_stack([np.repeat(sets, n, axis=0), np.tile(usable, b)])
    more = np.sort(more[(more[:, :s] != more[:, s:]).all(axis=1)], axis=1)
    more = more[np.lexsort(more.T[::-1])]
    return more[np.append(True, (more[1:] != more[:-1]).any(axis=1))]


def biases(C: Array, v: Array, out: Bools) -> tuple[Array, Array]:
    """Biases (k,) of the coordinates that are out and their sigmas, the others taken for right.

    Of what nothing else tells, as of a point of one look, biases are the smallest that explain it, with large sigmas.
    """
    own = C[np.ix_(out, out)]
    scale = 1.0 / np.sqrt(np.maximum(np.diagonal(own), 1e-30))
    values, vectors = np.linalg.eigh(own * scale[:, None] * scale)
    root = scale[:, None] * vectors / np.sqrt(np.maximum(values, UNTOLD))
    covariance = root @ root.T
    return covariance @ v[out], np.sqrt(np.diagonal(covariance))
