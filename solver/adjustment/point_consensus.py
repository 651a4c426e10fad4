"""Object points of which many rays were left out: which of their rays belong together, and whether that is certain.

Where most rays of a point are wrong, leaving out the worst one after the other can end with a few wrong rays that agree
by chance. Here every pair of rays is asked which others agree with it, with the orientation as adjusted; the largest
set that agrees wins. A point stays doubtful where it lost half of its rays, or where another set as large as the one
that was kept gives another place.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from ..arrays import Array, Bools, IntArray
from ..quantiles import chi2
from .adjustment import Solution
from .linearisation import linearise

Places = IntArray

#: The orientation, which is taken as known here, adds so much to the sigma of a prediction.
ORIENTATION_SHARE = 1.3

#: Rays of a point whose pairs are all tried; of more, pairs of this many.
MOST_RAYS = 24

#: Linearisations: the first point may lie far off.
PASSES = 3


@dataclass(frozen=True)
class Consensus:
    """Rays of an object point that agree.

    Attributes
    ----------
    rays : places among the k rays of the point
    shift_m : (3,) from the point of linearisation to the intersection
    rival : whether another set of as many rays gives another place
    """

    rays: Places
    shift_m: Array
    rival: bool


@dataclass(frozen=True)
class Doubt:
    """An object point whose coordinates the remaining rays do not confirm.

    Attributes
    ----------
    point : place in the network
    lost, rays : how many of its rays were left out, and how many it has
    reason : in words
    """

    point: int
    lost: int
    rays: int
    reason: str


def consensus(residual: Array, design: Array, limit: float) -> Consensus | None:
    """Largest set of rays that agree on one place; None where no two do.

    Parameters
    ----------
    residual : (2, k) whitened
    design : (2, 3, k) whitened derivatives to the point
    limit : of the squared residual of one ray in its sigmas (see `snooping.joint_limit`)
    """
    k = residual.shape[1]
    found: dict[tuple[int, ...], tuple[float, Array, Array]] = {}
    for pair in combinations(np.unique(np.linspace(0, k - 1, min(k, MOST_RAYS)).astype(int)).tolist(), 2):
        grown = _grown(np.array(pair), residual, design, limit)
        if grown is not None:
            chosen, squares, shift, Q = grown
            found[tuple(chosen.tolist())] = (squares, shift, Q)
    if not found:
        return None
    best = min(found, key=lambda rays: (-len(rays), found[rays][0]))
    _, shift, Q = found[best]
    apart = float(chi2.isf(chi2.sf(limit, 2), 3))
    rival = any(
        len(rays) == len(best) and _distance(other[1] - shift, Q + other[2]) > apart
        for rays, other in found.items()
        if rays != best
    )
    return Consensus(np.array(best, dtype=np.int64), shift, rival)


def _grown(start: Places, residual: Array, design: Array, limit: float) -> tuple[Places, float, Array, Array] | None:
    """A set that agrees, from a pair: takes in who agrees best and drops who disagrees, until nothing changes.

    Returns its rays, ``v^T v``, shift and cofactors (3, 3); None where the pair contradicts itself or does not fix a
    point.
    """
    k = residual.shape[1]
    inside = np.zeros(k, dtype=bool)
    inside[start] = True
    dropped = np.zeros(k, dtype=bool)
    while True:
        fit = _fit(inside, residual, design)
        if fit is None:
            return None
        shift, Q = fit
        v = residual - np.einsum("cpk,p->ck", design, shift)
        joint = _joint(v, np.einsum("apk,pq,bqk->kab", design, Q, design), inside)
        worst = int(np.argmax(np.where(inside, joint, -1.0)))
        if joint[worst] > limit:
            if inside.sum() <= 2:
                return None
            inside[worst], dropped[worst] = False, True
            continue
        outside = np.where(inside | dropped, np.inf, joint)
        nearest = int(np.argmin(outside))
        if outside[nearest] > limit:
            return np.flatnonzero(inside), float((v[:, inside] ** 2).sum()), shift, Q
        inside[nearest] = True


def _fit(inside: Bools, residual: Array, design: Array) -> tuple[Array, Array] | None:
    A = design[:, :, inside].transpose(0, 2, 1).reshape(-1, 3)
    N = A.T @ A
    values = np.linalg.eigvalsh(N)
    if values[0] < 1e-8 * values[2]:
        return None
    Q = np.linalg.inv(N)
    return Q @ (A.T @ residual[:, inside].reshape(-1)), Q


def _joint(v: Array, AQA: Array, inside: Bools) -> Array:
    """Squared residuals (k,) in their own sigmas, those of rays outside as predictions."""
    C = np.eye(2) + np.where(inside, -1.0, 1.0)[:, None, None] * AQA
    values, vectors = np.linalg.eigh(C)
    along = np.einsum("kab,ak->kb", vectors, v)
    controlled = values > 1e-6
    squares = np.where(controlled, along**2 / np.where(controlled, values, 1.0), 0.0).sum(axis=1)
    return squares / ORIENTATION_SHARE**2


def _distance(d: Array, C: Array) -> float:
    return float(d @ np.linalg.solve(C, d)) / ORIENTATION_SHARE**2


def consensus_of_points(solution: Solution, points: Places, limit: float) -> dict[int, tuple[Places, bool]]:
    """Rays (places in the network) that agree best, and whether there is a rival, for each of some points.

    Points of which no two rays agree are absent.
    """
    if solution.problem.parts is not None:
        return solution.problem.parts.consensus(solution, points, limit)
    network, state = solution.network, solution.state
    own = {int(p): np.flatnonzero(network.rays.point == p) for p in points}
    place, lin = state.points_l.copy(), solution.linearisation
    found: dict[int, tuple[Places, bool]] = {}
    for number in range(PASSES):
        if number:
            lin = linearise(network.rays, solution.layout, solution.whitening, state.theta, place)
        for p, rays in own.items():
            best = consensus(lin.residual[:, rays], lin.point[:, :, rays], limit)
            if best is None:
                found.pop(p, None)
            else:
                found[p] = rays[best.rays], best.rival
                place[p] += best.shift_m
    return found


def doubts(solution: Solution, lost: Places, limit: float) -> tuple[Doubt, ...]:
    """Points without given coordinates that the rays they kept do not confirm; points without a place are not listed.

    Parameters
    ----------
    lost : places of the rays that were left out
    limit : see `consensus`
    """
    network = solution.network
    n_lost = np.bincount(network.rays.point[lost], minlength=network.n_points)
    n_rays = np.bincount(network.rays.point, minlength=network.n_points)
    candidate = (n_lost > 0) & (solution.points.rank == 3)
    candidate[network.control.point] = False
    out = []
    places = np.flatnonzero(candidate)
    # two places have at most two rays in common, so a rival as large as what was kept needs almost as many lost ones
    twice = 2 * n_lost[places]
    rivals = consensus_of_points(solution, places[(twice >= n_rays[places] - 2) & (twice < n_rays[places])], limit)
    for p in places.tolist():
        d = Doubt(p, int(n_lost[p]), int(n_rays[p]), "half of the rays or more are left out")
        if 2 * d.lost >= d.rays:
            out.append(d)
        elif p in rivals and rivals[p][1]:
            out.append(replace(d, reason="other rays agree as well on another place"))
    return tuple(out)
