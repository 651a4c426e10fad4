"""Which of several known coordinates are wrong, judged together: sets of biases against each other.

The coordinates' discrepancies ``b`` have the covariance ``C^-1``, with what the GNSS and the slow errors of the
measured trajectory allow in it. A hypothesis says which of them may have a bias: any single coordinates, and a shift
that all have in common in an axis (the height system). It explains ``v_S' C_SS^-1 v_S`` of the cost; each bias has its
price, the square of the critical value, so that one alone is Baarda's test. Where another set explains the
discrepancies nearly as well it cannot be told which is wrong.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating]
Bools = NDArray[np.bool_]

#: A set is told from another if its cost is so much less: one wrong coordinate less explains the same.
TOLD = 9.0
#: What was decided before holds against a hypothesis that is better by less, and what was in doubt is so much longer.
STEADY = 3.0
#: Sets that are followed at a time, and the biases of one at most.
BEAM, MOST = 24, 12
AXES = 3
#: Eigenvalues of scaled information below this are none.
UNTOLD = 1e-9


@dataclass(frozen=True)
class Verdict:
    """What is wrong with c coordinates.

    Attributes
    ----------
    chosen : the best hypothesis: places of coordinates, and c + axis for a shift of all in an axis
    out : (c,) coordinates not to be used: those of the best hypothesis, and of all others that are nearly as good
    rivals : (k, c) the coordinates of the hypotheses between which it cannot be told, the best one first; k is 1 where
        there is no other
    score : of the best hypothesis, 0 if nothing is wrong; the lower, the better
    """

    chosen: frozenset[int]
    out: Bools
    rivals: tuple[Bools, ...]
    score: float


def judge(C: Array, v: Array, axis: NDArray[np.int64], price: float, before: Bools) -> Verdict:
    """Find the biases that explain the discrepancies.

    Parameters
    ----------
    C, v : (c, c), (c,) information about the biases, see `control_biases.Discrepancies`
    axis : (c,) 0..2
    price : of a bias
    before : (c,) what is refused now
    """
    n = len(v)
    common = [np.where(axis == a, 1.0, 0.0) for a in range(AXES)]
    U = np.column_stack([np.eye(n), *common])
    M, m = U.T @ C @ U, U.T @ v
    usable = np.array([True] * n + [bool((axis == a).sum() >= 2) for a in range(AXES)])
    covers = np.vstack([np.eye(n, dtype=bool), np.array(common, dtype=bool)])
    scale = 1.0 / np.sqrt(np.maximum(np.diagonal(M), 1e-30))
    M, m = M * scale[:, None] * scale, m * scale
    scores = _search(M, m, np.flatnonzero(usable), price)
    best = min(scores, key=scores.__getitem__)
    refused: dict[frozenset[int], Bools] = {s: np.asarray(covers[list(s)].any(axis=0)) for s in scores}
    for s in sorted(scores, key=scores.__getitem__):  # what holds already holds
        if scores[s] > scores[best] + STEADY:
            break
        if (refused[s] == before).all():
            best = s
            break
    mine = refused[best]
    rivals, out = [mine], mine.copy()
    for s in sorted(scores, key=scores.__getitem__):
        other = refused[s]
        if scores[s] > scores[best] + TOLD + (STEADY if before[other].all() else 0.0):
            continue
        if (other & ~mine).any() and (mine & ~other).any() and not any((other == r).all() for r in rivals):
            if any((other | r == other).all() for r in rivals[1:]):
                continue  # one of them with more to it
            rivals.append(other)
            out |= other
    return Verdict(best, out, tuple(rivals), scores[best])


def _search(M: Array, m: Array, usable: NDArray[np.int64], price: float) -> dict[frozenset[int], float]:
    """Scores of the hypotheses worth a look, the lower the better; that of none is 0."""
    scores: dict[frozenset[int], float] = {frozenset(): 0.0}
    beam = [frozenset[int]()]
    best, idle = 0.0, 0
    for size in range(1, min(MOST, len(usable)) + 1):
        sets = sorted({s | {int(i)} for s in beam for i in usable if i not in s}, key=sorted)
        if not sets:
            break
        places = np.array([sorted(s) for s in sets])
        blocks = M[places[:, :, None], places[:, None]] + UNTOLD * np.eye(size)
        right = m[places]
        drop = np.einsum("ki,ki->k", right, np.linalg.solve(blocks, right[:, :, None])[:, :, 0])
        score = price * size - drop
        order = np.argsort(score, kind="stable")[:BEAM]
        beam = [sets[i] for i in order]
        scores.update((sets[i], float(score[i])) for i in order)
        if score[order[0]] < best - 1e-9:
            best, idle = float(score[order[0]]), 0
        else:
            idle += 1
        if idle == 2:
            break
    return scores


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
