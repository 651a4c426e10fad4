"""Robust start of the window: which of the points that came first agree, all of them asked at once.

With little in the window, a gross error that enters first bends the orientation, and what comes after is judged by its
fault: good points are refused, and nothing ever takes the bad one out. So while a strip is young, and whenever half of
what comes is refused, the points are asked again together: for each the conditions that its looks must meet whatever
its coordinates (all looks, and all but one), as functions of the orientation alone; the orientation that most of them
agree on is found by iteratively re-weighted least squares whose kernel narrows from the whole spread to the noise.
What was refused by the fault of others comes back that way, and data snooping has the last word.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from .batch import Batch
from .state import WindowState

Array = NDArray[np.floating]
IntArray = NDArray[np.int64]

#: Points of a strip at which it is asked again; the later ones are judged by many.
YOUNG = (6, 10, 16, 26, 42, 68, 110, 178)
#: Newest points, and share of them that is refused, from which on it is asked again later.
RECENT, MOSTLY = 24, 0.6
#: Points asked at once at most, the newest ones; and the control points.
MOST_POINTS = 200
#: Probability that a good point is said not to agree.
DISAGREES = 1e-4
#: Squared width of the kernel, in squared sigmas, at the end; and by how much it narrows from one solution to the next.
NARROWEST, NARROWING = 8.0, 0.4
#: Rays of a point of which subsets are tried.
MOST_RAYS = 6
#: Share of the points that has to agree for their opinion to count.
MAJORITY = 0.4


@dataclass
class Settler:
    """Decides when to ask again.

    Attributes
    ----------
    asked : by strip, the number of points at which it was asked last
    refused : by strip, the number of control points of which nothing was left then
    """

    asked: dict[int, int] = field(default_factory=dict)
    refused: dict[int, int] = field(default_factory=dict)

    def due(self, batches: Sequence[Batch], fresh: Sequence[Batch]) -> list[Batch]:
        """The batches to ask, the newest points of a strip first; none if there is nothing to ask about."""
        if not fresh:
            return []
        strip = max(batch.strips[-1] for batch in fresh)
        mine = [b for b in batches if strip in b.strips]
        count = sum(b.n_points for b in mine)
        asked = self.asked.get(strip, 0)
        step = next((n for n in YOUNG if n > asked), None)
        if step is None and count < asked:  # what was counted has left
            self.asked[strip] = asked = max(count, YOUNG[-1])
        due = step is not None and count >= step
        due = due or (count >= asked + RECENT and self._mostly_refused(mine))
        before, refused = self.refused.get(strip, 0), sum(map(refused_control, mine))
        self.refused[strip] = min(before, refused)
        if not due and refused <= before:
            return []
        self.refused[strip] = refused
        self.asked[strip] = max(count, asked)
        chosen: list[Batch] = []
        points = 0
        for batch in sorted(mine, key=lambda b: -b.newest_s):
            if chosen and points + batch.n_points > MOST_POINTS and not batch.active_control:
                continue
            chosen.append(batch)
            points += batch.n_points
        return chosen if any((b.weight == 0).any() for b in chosen) else []

    @staticmethod
    def _mostly_refused(batches: Sequence[Batch]) -> bool:
        seen = refused = 0
        for batch in sorted(batches, key=lambda b: -b.newest_s):
            kept = np.bincount(batch.rays.point, batch.weight > 0, batch.n_points)
            seen += batch.n_points
            refused += int((kept == 0).sum())
            if seen >= RECENT:
                break
        return seen >= RECENT and refused > MOSTLY * seen


def refused_control(batch: Batch) -> int:
    """Control points of a batch of which no ray is left."""
    if not batch.active_control:
        return 0
    kept = np.bincount(batch.rays.point, batch.weight > 0, batch.n_points)
    return int((batch.control.weight.any(axis=1) & (kept == 0)).sum())


def _subsets(rays: int) -> list[tuple[int, ...]]:
    """Looks of a point that may be left out together: none, one, or two of many; two stay.

    At known coordinates one look alone would be two conditions, but the orientation can bend to any one look.
    """
    most = min(rays - 2, 2) if rays <= MOST_RAYS else 0
    return [out for n in range(max(most, 0) + 1) for out in combinations(range(rays), n)]


def settle(batches: list[Batch], state: WindowState) -> list[Array] | None:
    """Weights of the rays of batches that most of their points agree on; None if they agree no better than now.

    The state is left as it was found.

    Parameters
    ----------
    batches : in the state
    state : solved
    """
    for batch in batches:
        state.add(batch.columns, batch.information, -1)
    N, rhs = state.normal()
    for batch in batches:
        state.add(batch.columns, batch.information)
    state.solve()
    c = _Conditions.of(batches, state)
    if c is None:
        return None
    now = c.agreeing(state.theta)
    theta = _consensus(c, N, rhs)
    then = c.agreeing(theta)
    points = int(c.point.max()) + 1
    if not then.sum() > now.sum() or then.sum() < MAJORITY * points:
        return None
    return c.weights(theta, batches)


def _consensus(c: _Conditions, N: Array, rhs: Array) -> Array:
    """Orientation (n,) that most points agree on, with what else is known of it as prior (n, n), (n,)."""
    scale = 1.0 / np.sqrt(np.maximum(np.diagonal(N), 1e-30))
    weight = np.where(c.n_out == 0, 1.0, 0.0)
    width = np.inf
    theta = np.zeros(len(rhs))
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
        if not np.isfinite(width):
            width = max(float(over[c.n_out == 0].max()), NARROWEST)
        width = max(NARROWING * width, NARROWEST)
        chosen = c.choose(square, width)
        weight = np.zeros(len(over))
        weight[chosen] = (width / (width + over[chosen])) ** 2


@dataclass(frozen=True)
class _Conditions:
    """What the looks at points must meet: ``design @ theta = misclosure`` with unit noise, in m sets of rows.

    Attributes
    ----------
    point : (m,) place of the point among those of all batches
    left_out : (m) places of the looks at its point that are left out
    n_out : (m,) how many
    rows : (m,) conditions of the set
    first : (m,) where they begin
    design, misclosure : (n, u), (n,)
    limit : (m,) of the squares of the set for its looks to agree
    """

    point: IntArray
    left_out: tuple[tuple[int, ...], ...]
    n_out: IntArray
    rows: IntArray
    first: IntArray
    design: Array
    misclosure: Array
    limit: Array

    @classmethod
    def of(cls, batches: list[Batch], state: WindowState) -> _Conditions | None:
        """None where there are no conditions: all points have one look."""
        point: list[int] = []
        left_out: list[tuple[int, ...]] = []
        rows: list[int] = []
        designs, misclosures = [], []
        number = 0
        for batch in batches:
            A = batch.full_rows(np.arange(len(batch.rays)))
            e = batch.lin.residual.T + A @ batch.theta
            J = batch.lin.point.transpose(2, 0, 1)
            root = np.sqrt(batch.control.weight)
            off = batch.control.residual(batch.origin_l)
            place = state.places(batch.columns)
            for p in range(batch.n_points):
                own = np.arange(batch.first_ray[p], batch.first_ray[p + 1])
                given = np.flatnonzero(root[p])
                for out in _subsets(len(own)):
                    rays = np.delete(own, out)
                    k = 2 * len(rays) + len(given) - 3
                    if k < 1:
                        continue
                    j = np.vstack([J[rays].reshape(-1, 3), np.diag(root[p])[given]])
                    free = np.linalg.qr(j, mode="complete")[0][:, 3:].T
                    image, ground = free[:, : 2 * len(rays)], free[:, 2 * len(rays) :]
                    full = np.zeros((k, len(state)))
                    full[:, place] = image @ A[rays].reshape(2 * len(rays), -1)
                    designs.append(full)
                    misclosures.append(image @ e[rays].ravel() + ground @ off[p, given])
                    point.append(number + p)
                    left_out.append(out)
                    rows.append(k)
            number += batch.n_points
        if not rows:
            return None
        rows_ = np.array(rows, dtype=np.int64)
        return cls(
            np.array(point, dtype=np.int64),
            tuple(left_out),
            np.array([len(out) for out in left_out]),
            rows_,
            np.concatenate([[0], np.cumsum(rows_)[:-1]]).astype(np.int64),
            np.concatenate(designs),
            np.concatenate(misclosures),
            chi2.isf(DISAGREES, rows_),
        )

    def squares(self, theta: Array) -> Array:
        """(m,) sum of squares of each set."""
        return np.add.reduceat((self.misclosure - self.design @ theta) ** 2, self.first)

    def choose(self, square: Array, price: float) -> IntArray:
        """The set of each point with the least squares, where a look left out costs a price."""
        cost = square - self.rows + price * self.n_out
        order = np.lexsort((cost, self.point))
        return order[np.concatenate([[True], np.diff(self.point[order]) != 0])]

    def agreeing(self, theta: Array) -> NDArray[np.bool_]:
        """(m,) the sets that agree with an orientation, one of a point at most."""
        square = self.squares(theta)
        result = np.zeros(len(square), dtype=bool)
        chosen = self.choose(square, NARROWEST)
        result[chosen] = square[chosen] <= self.limit[chosen]
        return result

    def weights(self, theta: Array, batches: list[Batch]) -> list[Array]:
        """Weights of the rays of the batches: 1 in sets that agree, else 0; without conditions as they are."""
        tested = set(self.point.tolist())
        taken = {int(self.point[i]): self.left_out[i] for i in np.flatnonzero(self.agreeing(theta))}
        result, number = [], 0
        for batch in batches:
            weight = np.zeros(len(batch.rays))
            for p in range(batch.n_points):
                if number + p not in tested:
                    own = slice(batch.first_ray[p], batch.first_ray[p + 1])
                    weight[own] = batch.weight[own]
                if number + p in taken:
                    weight[batch.first_ray[p] : batch.first_ray[p + 1]] = 1.0
                    weight[batch.first_ray[p] + np.array(taken[number + p], dtype=np.int64)] = 0.0
            result.append(weight)
            number += batch.n_points
        return result
