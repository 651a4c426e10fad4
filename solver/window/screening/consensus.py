"""Robust start of the window: which of the points that came first agree, all of them judged at once.

With little in the window, a gross error that enters first bends the orientation. What comes later is tested against
that orientation, so that good points are refused, and nothing ever takes the bad one out. So while a strip is young,
and whenever half of what comes is refused, its points are judged again together: for each the conditions that its looks
must meet whatever its coordinates (all looks, and all but one or two), as functions of the orientation alone. The
orientation that most of the points agree on is found by iteratively re-weighted least squares whose kernel narrows from
the whole spread to the noise. Looks that were refused because others were wrong come back that way; data snooping tests
the result.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import combinations
from operator import attrgetter

import numpy as np

from ...adjustment.normal_equations import without_point
from ...adjustment.snooping import largest_of_group
from ...arrays import Array, Bools, IntArray
from ...quantiles import chi2
from ..state.batch import Batch
from ..state.network import Batches
from ..state.unknowns import WindowState

#: Numbers of points of a strip at which they are judged together, each 1.6 times the one before; later points are
#: tested against many others.
YOUNG = (6, 10, 16, 26, 42, 68, 110, 178)
#: Later they are judged again where of so many newest points more than this share has no look left. Tuned.
RECENT, REFUSED_SHARE = 24, 0.6
#: Points judged together at most, the newest ones and those with control. Bounds the time.
MOST_POINTS = 200
#: Probability that a good point is said not to agree.
DISAGREES = 1e-4
#: Squared width of the kernel at the end, in squared sigmas, and the factor from one solution to the next. Tuned.
NARROWEST, NARROWING = 8.0, 0.4
#: Points of more rays are judged with all of them only. Bounds the number of subsets.
SUBSET_RAYS = 6
#: Share of the points that has to agree on an orientation for it to be used. Tuned.
MAJORITY = 0.4


@dataclass
class ConsensusSchedule:
    """Decides when the points of a strip are judged together.

    Attributes
    ----------
    asked : by strip, the number of points when they were judged last
    refused : by strip, the number of control points without a look left at the last update
    """

    asked: dict[int, int] = field(default_factory=dict)
    refused: dict[int, int] = field(default_factory=dict)

    def due(self, batches: Batches, fresh: Sequence[Batch]) -> list[Batch]:
        """The batches to judge together, the newest first; none if it is not time, or no look is refused."""
        if not fresh:
            return []
        strip = max(batch.strips[-1] for batch in fresh)
        count = batches.points_in(strip)
        refused = sum(batch.control_refused for batch in batches.with_control() if strip in batch.strips)
        asked, before = self.asked.get(strip, 0), self.refused.get(strip, 0)
        step = next((n for n in YOUNG if n > asked), np.inf)
        if step == np.inf and count < asked:  # points that were counted have left
            asked = max(count, YOUNG[-1])
        due = count >= step or refused > before
        few_lost = batches.counts.lost <= REFUSED_SHARE * RECENT
        if not due and (few_lost or count < asked + RECENT):
            self.asked[strip], self.refused[strip] = asked, refused
            return []
        mine = [batch for batch in batches if strip in batch.strips]
        mine.sort(key=attrgetter("newest_s"), reverse=True)
        due = due or _mostly_refused(mine)
        self.asked[strip], self.refused[strip] = max(count, asked) if due else asked, refused
        chosen: list[Batch] = []
        points = 0
        for batch in mine if due else ():
            if not chosen or points + batch.n_points <= MOST_POINTS or batch.counts.control:
                chosen.append(batch)
                points += batch.n_points
        return chosen if any((b.weight == 0).any() for b in chosen) else []


def _mostly_refused(newest_first: Sequence[Batch]) -> bool:
    """Whether of the newest points most have no look left."""
    seen = none = 0
    for batch in newest_first:
        seen += batch.n_points
        none += int((batch.points_left == 0).sum())
        if seen >= RECENT:
            return none > REFUSED_SHARE * seen
    return False


def _subsets(rays: int) -> list[tuple[int, ...]]:
    """Looks of a point that may be left out together: none, one, or two of many; two stay.

    At known coordinates one look alone would be two conditions, but the orientation can bend to any one look.
    """
    most = min(rays - 2, 2) if rays <= SUBSET_RAYS else 0
    return [out for n in range(max(most, 0) + 1) for out in combinations(range(rays), n)]


def consensus_weights(batches: list[Batch], state: WindowState) -> list[Array] | None:
    """Weights of the rays of batches that most of their points agree on; None if they agree no better than now.

    Parameters
    ----------
    batches : in the state
    state : solved
    """
    c = _Conditions(batches, state)
    if not c.rays:
        return None
    now = c.agreeing(state.theta)
    theta = _consensus(c, *state.normal((batch.columns, batch.information) for batch in batches))
    then = c.agreeing(theta)
    if not then.sum() > now.sum() or then.sum() < MAJORITY * (c.point[-1] + 1):
        return None
    weights = [batch.weight.copy() for batch in batches]
    for i, own, _ in c.rays:
        weights[i][own] = 0.0
    for k in np.flatnonzero(then):
        i, _, kept = c.rays[k]
        weights[i][kept] = 1.0
    return weights


def _consensus(c: _Conditions, N: Array, rhs: Array) -> Array:
    """Orientation (n,) that most points agree on, with what else is known of it as prior (n, n), (n,)."""
    scale = 1.0 / np.sqrt(np.maximum(np.diagonal(N), 1e-30))
    weight = np.where(c.n_out == 0, 1.0, 0.0)
    width = np.inf
    while True:
        rows = np.repeat(weight, c.rows)
        use = np.flatnonzero(rows)
        A = c.design[use] * np.sqrt(rows[use])[:, None] * scale
        full = A.T @ A + N * scale[:, None] * scale
        theta = scale * np.linalg.solve(full, scale * rhs + A.T @ (np.sqrt(rows[use]) * c.misclosure[use]))
        if width <= NARROWEST:
            return theta
        square = c.squares(theta)
        over = np.maximum(square - c.rows, 0.0)
        widest = width if np.isfinite(width) else max(float(over[c.n_out == 0].max()), NARROWEST)
        width = max(NARROWING * widest, NARROWEST)
        chosen = c.choose(square, width)
        weight = np.zeros(len(over))
        weight[chosen] = (width / (width + over[chosen])) ** 2


class _Conditions:
    """Conditions ``design @ theta = misclosure`` with unit noise that looks must meet wherever their point is.

    They come in m sets: of each point one of all its looks, and one for each choice of looks that may be left out.

    Attributes
    ----------
    point : (m,) number of the point of each set
    rays : (m) place of the batch, the rays of the point in it, and those of the set
    n_out : (m,) number of looks left out
    rows : (m,) conditions of the set
    design, misclosure : (n, u), (n,) of all sets, one after the other
    """

    def __init__(self, batches: list[Batch], state: WindowState) -> None:
        self.rays: list[tuple[int, IntArray, IntArray]] = []
        number, point, designs = 0, [], [np.empty((0, len(state)))]
        misclosures: list[Array] = [np.empty(0)]
        for i, batch in enumerate(batches):
            every, u, place = np.arange(len(batch.rays)), len(batch.columns), state.places(batch.columns)
            A, J = batch.full_rows, batch.lin.point.transpose(2, 0, 1)
            e = batch.lin.residual.T + A @ batch.theta
            root, off = np.sqrt(batch.control.weight), batch.control.residual(batch.origin_l)
            for p in range(batch.n_points):
                own = every[batch.first_ray[p] : batch.first_ray[p + 1]]
                given = np.flatnonzero(root[p])
                for out in _subsets(len(own)):
                    kept = np.delete(own, out)
                    if 2 * len(kept) + len(given) <= 3:
                        continue
                    design, misclosure = without_point(
                        np.concatenate([A[kept].reshape(-1, u), np.zeros((len(given), u))]),
                        np.concatenate([J[kept].reshape(-1, 3), np.diag(root[p])[given]]),
                        np.concatenate([e[kept].ravel(), off[p, given]]),
                    )
                    full = np.zeros((len(design), len(state)))
                    full[:, place] = design
                    designs.append(full)
                    misclosures.append(misclosure)
                    point.append(number + p)
                    self.rays.append((i, own, kept))
            number += batch.n_points
        self.point = np.array(point, dtype=np.int64)
        self.n_out = np.array([len(own) - len(kept) for _, own, kept in self.rays], dtype=np.int64)
        self.rows = np.array([len(m) for m in misclosures[1:]], dtype=np.int64)
        self.design, self.misclosure = np.concatenate(designs), np.concatenate(misclosures)

    def squares(self, theta: Array) -> Array:
        """(m,) sum of squares of each set."""
        return np.add.reduceat((self.misclosure - self.design @ theta) ** 2, np.cumsum(self.rows) - self.rows)

    def choose(self, square: Array, price: float) -> IntArray:
        """The set of each point with the least squares, where a look left out costs a price."""
        return largest_of_group(self.point, -(square - self.rows + price * self.n_out))

    def agreeing(self, theta: Array) -> Bools:
        """(m,) the sets that agree with an orientation, one of a point at most."""
        square = self.squares(theta)
        chosen = self.choose(square, NARROWEST)
        result = np.zeros(len(square), dtype=bool)
        result[chosen] = square[chosen] <= chi2.isf(DISAGREES, self.rows[chosen])
        return result
