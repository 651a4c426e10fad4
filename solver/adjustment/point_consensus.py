"""Object points of which many rays were left out: which of their rays belong together, and whether that is certain.

Where most rays of a point are wrong, leaving out the worst one after the other can end with a few wrong rays that agree
by chance. Here every pair of rays is asked which others agree with it, with the orientation as adjusted; the largest
set that agrees wins. A point stays doubtful where it lost half of its rays, or where another set as large as the one
that was kept gives another place.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from ..arrays import Array, Bools, IntArray
from ..quantiles import chi2
from .adjustment import Solution
from .linearisation import linearise, linearise_and_weigh

Places = IntArray

#: The orientation, which is taken as known here, adds so much to the sigma of a prediction.
ORIENTATION_SHARE = 1.3

#: Rays of a point whose pairs are all tried; of more, pairs of this many.
MOST_RAYS = 24

#: Variance of a whitened residual from which on it is controlled by other rays.
CONTROLLED = 1e-6

#: Linearisations: the first point may lie far off.
PASSES = 3

#: Values of rays and pairs worked on at a time, a few hundred bytes each.
BATCH = 100_000


@dataclass(frozen=True)
class Consensus:
    """Rays of m object points that agree; all of these points have k rays.

    Attributes
    ----------
    found : (m,) whether any two rays agree; where they do not, nothing is chosen and the shift is zero
    chosen : (m, k) which rays agree
    shift_m : (m, 3) from the point of linearisation to the intersection
    rival : (m,) whether another set of as many rays gives another place
    """

    found: Bools
    chosen: Bools
    shift_m: Array
    rival: Bools


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


def consensus(residual: Array, design: Array, limit: float) -> Consensus:
    """Largest set of rays that agree on one place, for each of m points with k rays.

    Parameters
    ----------
    residual : (m, k, 2) whitened
    design : (m, k, 2, 3) whitened derivatives to the point
    limit : of the squared residual of one ray in its sigmas (see `snooping.joint_limit`)
    """
    m, k = residual.shape[:2]
    chosen, shift, rival = np.zeros((m, k), dtype=bool), np.zeros((m, 3)), np.zeros(m, dtype=bool)
    sets = _grown(residual, design, limit)
    # the largest set of each point, of these the one with the smallest residuals
    order = np.lexsort((sets.squares, -sets.size, sets.point))
    best = order[np.diff(sets.point[order], prepend=-1) != 0]
    found = np.zeros(m, dtype=bool)
    found[sets.point[best]] = True
    chosen[sets.point[best]], shift[sets.point[best]] = sets.inside[best], sets.shift_m[best]
    best_of = np.empty(m, dtype=np.int64)
    best_of[sets.point[best]] = best
    of = best_of[sets.point]
    others = np.flatnonzero((sets.size == sets.size[of]) & (sets.inside != sets.inside[of]).any(axis=1))
    of = of[others]
    d, C = sets.shift_m[others] - sets.shift_m[of], sets.cofactors[others] + sets.cofactors[of]
    apart = (d * np.linalg.solve(C, d[:, :, None])[:, :, 0]).sum(axis=1) / ORIENTATION_SHARE**2
    rival[sets.point[others[apart > float(chi2.isf(chi2.sf(limit, 2), 3))]]] = True
    return Consensus(found, chosen, shift, rival)


class _Sets(NamedTuple):
    """Sets of rays that agree: point (s,), rays (s, k), ``v^T v`` (s,), shift (s, 3), cofactors (s, 3, 3)."""

    point: IntArray
    inside: Bools
    squares: Array
    shift_m: Array
    cofactors: Array

    @property
    def size(self) -> IntArray:
        return self.inside.sum(axis=1)


def _grown(residual: Array, design: Array, limit: float) -> _Sets:
    """Sets that agree, from every pair of rays of m points; see `consensus` for the arguments.

    A set takes in who agrees best and drops who disagrees most, until nothing changes. Pairs that contradict themselves
    or do not fix a point are absent.
    """
    m, k = residual.shape[:2]
    tried = np.unique(np.linspace(0, k - 1, min(k, MOST_RAYS)).astype(int))
    pairs = np.stack(np.triu_indices(len(tried), 1), axis=1)
    point = np.repeat(np.arange(m), len(pairs))
    inside = np.zeros((len(point), k), dtype=bool)
    np.put_along_axis(inside, np.tile(tried[pairs], (m, 1)), True, axis=1)
    dropped = np.zeros_like(inside)
    normal = np.swapaxes(design, 2, 3) @ design  # of each ray
    moment = (np.swapaxes(design, 2, 3) @ residual[..., None])[..., 0]
    ended: list[tuple[IntArray, _Sets]] = []
    number = np.arange(len(point))
    while len(number):
        weight = inside[:, None].astype(float)
        N = (weight @ normal[point].reshape(-1, k, 9)).reshape(-1, 3, 3)
        values = np.linalg.eigvalsh(N)
        fixed = values[:, 0] >= 1e-8 * values[:, 2]
        if not fixed.all():
            number, point, inside, dropped = number[fixed], point[fixed], inside[fixed], dropped[fixed]
            N, weight = N[fixed], weight[fixed]
        Q = np.linalg.inv(N)
        shift = (Q @ (weight @ moment[point])[:, 0, :, None])[:, :, 0]
        A = design[point]
        v = residual[point] - (A @ shift[:, None, :, None])[..., 0]
        joint = _joint(v, A @ Q[:, None] @ np.swapaxes(A, 2, 3), inside)
        every = np.arange(len(number))
        worst = np.argmax(np.where(inside, joint, -1.0), axis=1)
        disagrees = joint[every, worst] > limit
        nearest = np.argmin(np.where(inside | dropped, np.inf, joint), axis=1)
        free = ~(inside | dropped)[every, nearest]
        grows = ~disagrees & free & (joint[every, nearest] <= limit)
        done = ~(disagrees | grows)
        squares = ((v**2).sum(axis=2) * inside).sum(axis=1)
        ended.append((number[done], _Sets(point[done], inside[done], squares[done], shift[done], Q[done])))
        more = grows | (disagrees & (inside.sum(axis=1) > 2))
        out, taken = every[disagrees], every[grows]
        inside[out, worst[out]], dropped[out, worst[out]] = False, True
        inside[taken, nearest[taken]] = True
        number, point, inside, dropped = number[more], point[more], inside[more], dropped[more]
    # in the order of the pairs they began with
    order = np.argsort(np.concatenate([n for n, _ in ended]))
    return _Sets(*(np.concatenate(part)[order] for part in zip(*(sets for _, sets in ended), strict=True)))


def _joint(v: Array, AQA: Array, inside: Bools) -> Array:
    """Squared residuals (s, k) in their own sigmas, those of rays outside as predictions.

    Directions of a residual whose variance is as good as zero do not count.
    """
    C = np.where(inside, -1.0, 1.0)[..., None, None] * AQA
    a, b, d = 1.0 + C[..., 0, 0], C[..., 0, 1], 1.0 + C[..., 1, 1]
    x, y = v[..., 0], v[..., 1]
    middle, half = 0.5 * (a + d), np.hypot(0.5 * (a - d), b)
    larger, det = middle + half, a * d - b * b
    one = larger > CONTROLLED
    both = one & (det > CONTROLLED * larger)
    squares = (d * x * x - 2.0 * b * x * y + a * y * y) / np.where(both, det, 1.0)
    smaller = middle - half  # where only the larger counts, the part of v along it
    along2 = ((a - smaller) * x * x + 2.0 * b * x * y + (d - smaller) * y * y) / np.where(half > 0, 2.0 * half, 1.0)
    squares = np.where(both, squares, np.where(one, along2 / np.where(one, larger, 1.0), 0.0))
    return squares / ORIENTATION_SHARE**2


def consensus_of_points(solution: Solution, points: Places, limit: float) -> dict[int, tuple[Places, bool, Array]]:
    """Rays (places in the network) that agree best, whether there is a rival, and where they meet (3,), of some points.

    Points of which no two rays agree are absent.
    """
    if solution.problem.parts is not None:
        return solution.problem.parts.consensus(solution, points, limit)
    if not len(points):
        return {}
    network, state = solution.network, solution.state
    place, lin = state.points_l.copy(), solution.linearisation
    # one that its rays have left is where it is given, which may be far from where they meet, and so are their weights
    given = np.intersect1d(points, network.control.point)
    place[given] = network.where_rays_meet(given)
    found: dict[int, tuple[Places, bool, Array]] = {}
    for number in range(PASSES):
        if len(given):
            fresh = linearise_and_weigh(network.rays, solution.layout, state.theta, place)
            # what the sigmas of the image were multiplied by is in the weights alone
            factor = float(np.median(solution.whitening.g[0] / fresh.whitening.g[0]))
            lin = fresh.linearisation.reweighted(np.full(len(network.rays), factor**2))
        elif number:
            lin = linearise(network.rays, solution.layout, solution.whitening, state.theta, place)
        found = {}
        for own in _alike(points, network.rays_per_point):
            rays = network.first_ray[own][:, None] + np.arange(int(network.rays_per_point[own[0]]))
            best = consensus(
                np.moveaxis(lin.residual[:, rays], 0, 2), np.moveaxis(lin.point[:, :, rays], (0, 1), (2, 3)), limit
            )
            place[own] += best.shift_m
            for i in np.flatnonzero(best.found).tolist():
                found[int(own[i])] = rays[i, best.chosen[i]], bool(best.rival[i]), place[own[i]].copy()
    return {p: found[p] for p in points.tolist() if p in found}


def _alike(points: Places, rays_per_point: IntArray) -> Iterator[Places]:
    """Points with the same number of rays, not too many at a time; those with less than two rays are left out."""
    k = rays_per_point[points]
    for rays in np.unique(k[k >= 2]).tolist():
        own = points[k == rays]
        tried = min(rays, MOST_RAYS)
        step = max(1, BATCH // (rays * tried * (tried - 1) // 2))
        for low in range(0, len(own), step):
            yield own[low : low + step]


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
