"""The observations that the orientation is most exposed to, in the window and after it; the algebra of their lambda.

See `integrity` for what lambda is.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular

from .batch import Batch
from .state import Marginal, WindowState

Array = NDArray[np.floating]
IntArray = NDArray[np.int64]

#: Observations that have left the window, kept exactly.
MOST_LEFT = 24
#: Cofactors of residuals below this are those of a direction that nothing checks: along the base at two rays.
UNCHECKED = 1e-6
AXES = "XYZ"


@dataclass
class Exposed:
    """An observation: an image ray (place in its batch), or a control coordinate (ray -1).

    Attributes
    ----------
    rows : (k, u) with the points eliminated
    own : (k, k) cofactors of its residuals if the orientation were known
    inverse : (k, k) ``C^-1``
    leverage : lambda, as last computed; it can only become smaller
    """

    batch: Batch
    ray: int
    point: int
    axis: int
    rows: Array
    own: Array
    inverse: Array
    leverage: float

    @property
    def counts(self) -> bool:
        """Whether it has not been rejected since."""
        weight = self.batch.weight[self.ray] if self.ray >= 0 else self.batch.control.weight[self.point, self.axis]
        return bool(weight > 0)

    def renew(self, R: Array) -> None:
        """Figures for other cofactors (k, k) of its prediction."""
        C = self.own - R
        self.inverse = inverse_of(C)
        self.leverage = float(ratio_of(R, C))

    @property
    def control_point(self) -> str:
        """Name of the control point whose coordinate it is, "" for a ray."""
        return "" if self.ray >= 0 else self.batch.names[self.point]

    def told(self, delta: float) -> tuple[str, bool, float]:
        """It in words, whether it is a control coordinate, and its marginal detectable error if it is one, else 0."""
        name = self.batch.names[self.point]
        if self.ray >= 0:
            return f"ray of point {name}", False, 0.0
        detectable = delta * float(np.sqrt(self.inverse[0, 0] / self.batch.control.weight[self.point, self.axis]))
        return f"{AXES[self.axis]} of control point {name}", True, detectable


@dataclass
class Departed:
    """An observation that has left the window: what is needed of `Exposed`, without the batch."""

    rows: Array
    inverse: Array
    leverage: float
    control_point: str
    told_at_last: tuple[str, bool, float]

    def told(self, delta: float) -> tuple[str, bool, float]:
        """As `Exposed.told` when it left."""
        return self.told_at_last


Observation = Exposed | Departed


class Departures:
    """Observations that left the window: how an error in each moves the right-hand side of what stayed.

    Attributes
    ----------
    exposed : the most exposed of them
    """

    def __init__(self) -> None:
        self._numbers: IntArray = np.empty(0, dtype=np.int64)
        self._rhs = np.empty((0, 0))
        self.exposed: list[Departed] = []
        self._bounds: deque[tuple[float, float]] = deque()
        self._newest_s = -np.inf

    def add(self, exposed: list[Departed], columns: IntArray, rest: float, time_s: float, state: WindowState) -> None:
        """Observations that leave, unknowns (u,) of their rows, and the largest lambda of the others of their batch."""
        new = np.setdiff1d(state.numbers, self._numbers)
        self._numbers = np.concatenate([self._numbers, new])
        width = sum(len(e.rows) for e in exposed)
        self._rhs = np.pad(self._rhs, ((0, len(new)), (0, width)))
        place = {int(n): i for i, n in enumerate(self._numbers)}
        column = self._rhs.shape[1] - width
        rows = [place[n] for n in columns.tolist()]
        for e in exposed:
            self._rhs[rows, column : column + len(e.rows)] = e.rows.T
            column += len(e.rows)
        self.exposed += exposed
        self._bounds.append((time_s, rest))
        self._newest_s = max(self._newest_s, time_s)

    def marginalise(self, marginal: Marginal) -> None:
        """Eliminate unknowns from the right-hand sides."""
        gone, stayed = np.isin(self._numbers, marginal.gone), np.isin(self._numbers, marginal.stayed)
        if gone.any():
            order = np.argsort(marginal.gone)
            first = np.zeros((len(marginal.gone), self._rhs.shape[1]))
            first[order[np.searchsorted(marginal.gone, self._numbers[gone], sorter=order)]] = self._rhs[gone]
            moved = marginal.R12.T @ solve_triangular(marginal.R11, first, trans=1, check_finite=False)
            rest = np.zeros((len(marginal.stayed), self._rhs.shape[1]))
            order = np.argsort(marginal.stayed)
            rest[order[np.searchsorted(marginal.stayed, self._numbers[stayed], sorter=order)]] = self._rhs[stayed]
            self._numbers, self._rhs = marginal.stayed.copy(), rest - moved

    def effects(self, Qg: Array, state: WindowState) -> Array:
        """How their rows, one below the other, move functions of the unknowns; Qg (n, 6)."""
        if not self.exposed:
            return np.empty((0, Qg.shape[1]))
        return self._rhs.T @ Qg[state.places(self._numbers)]

    def thin(self, state: WindowState) -> None:
        """Keep the most exposed; of the others the bound."""
        if len(self.exposed) <= 2 * MOST_LEFT:
            return
        place = state.places(self._numbers)
        G = np.zeros((len(state), self._rhs.shape[1]))
        G[place] = self._rhs
        R = self._rhs.T @ state.propagated(G)[place]
        pair = np.stack(rows_of(self.exposed), axis=1)
        products = inverses(self.exposed) @ R[pair[:, :, None], pair[:, None]]
        leverages = np.linalg.eigvals(products).real.max(axis=1)
        for e, leverage in zip(self.exposed, leverages.tolist(), strict=True):
            e.leverage = leverage
        order = np.argsort([-e.leverage for e in self.exposed])
        keep = np.sort(order[:MOST_LEFT])
        self._bounds.append((self._newest_s, self.exposed[order[MOST_LEFT]].leverage))
        kept = np.repeat(np.isin(np.arange(len(order)), keep), [len(e.rows) for e in self.exposed])
        columns = np.flatnonzero(kept)
        self._rhs, self.exposed = self._rhs[:, columns], [self.exposed[i] for i in keep]

    def bound(self) -> float:
        return max((value for _, value in self._bounds), default=0.0)

    def forget(self, before_s: float) -> None:
        while self._bounds and self._bounds[0][0] < before_s:
            self._bounds.popleft()


def control_points(observations: list[Observation]) -> tuple[str, ...]:
    """Names of the control points among observations."""
    return tuple(sorted({e.control_point for e in observations if e.control_point}))


def leverage_of(e: Observation) -> float:
    return e.leverage


def rows_of(exposed: Sequence[Observation]) -> tuple[IntArray, IntArray]:
    """First and last row (n,) of each where the rows of all stand one below the other."""
    widths = np.array([len(e.rows) for e in exposed], dtype=np.int64)
    ends = np.cumsum(widths)
    return ends - widths, ends - 1


def inverses(exposed: Sequence[Observation]) -> Array:
    """``C^-1`` (n, 2, 2) of each; of a control coordinate it stands first, and the rest is zero."""
    values = [(*e.inverse.ravel().tolist(), 0.0, 0.0, 0.0)[:4] for e in exposed]
    return np.array(values).reshape(-1, 2, 2)


def squares_of(exposed: Sequence[Observation], h: Array) -> Array:
    """``h^T C^-1 h`` (n, k) of each; the rows (m, k) of all stand one below the other."""
    first, last = rows_of(exposed)
    a, b, c, d = inverses(exposed).reshape(-1, 4).T[:, :, None]
    squares = a * h[first] ** 2 + (b + c) * h[first] * h[last] + d * h[last] ** 2
    return np.maximum(squares, 0.0)  # rounding


def inverse_of(C: Array) -> Array:
    """Inverse (k, k) without the directions that nothing checks."""
    if len(C) == 2:  # the usual case, without an eigenvalue decomposition
        (a, b), (_, d) = C.tolist()
        det, trace = a * d - b * b, a + d
        if trace > 0 and det > 10 * UNCHECKED * trace:
            return np.array([[d / det, -b / det], [-b / det, a / det]])
    values, vectors = np.linalg.eigh(C)
    good = values > UNCHECKED
    return (vectors * np.where(good, 1.0 / np.where(good, values, 1.0), 0.0)) @ vectors.T


def ratio_of(R: Array, C: Array) -> float:
    """Largest eigenvalue of ``C^-1 R`` (k, k)."""
    if len(C) == 1:
        return float(R[0, 0] / max(C[0, 0], UNCHECKED))
    (r, s), (_, t) = R.tolist()
    (a, b), (_, d) = C.tolist()
    a, d = a + UNCHECKED, d + UNCHECKED
    det = max(a * d - b * b, UNCHECKED**2)
    half = 0.5 * (d * r - 2.0 * b * s + a * t) / det
    return max(half + math.sqrt(max(half * half - (r * t - s * s) / det, 0.0)), 0.0)


def largest_ratios(R: Array, C: Array) -> Array:
    """(n,) largest eigenvalue of ``C^-1 R`` of symmetric (n, 2, 2), without directions in which C is nothing."""
    a, b, d = C[:, 0, 0] + UNCHECKED, C[:, 0, 1], C[:, 1, 1] + UNCHECKED
    det = np.maximum(a * d - b * b, UNCHECKED**2)
    r, s, t = R[:, 0, 0], R[:, 0, 1], R[:, 1, 1]
    trace = (d * r - 2.0 * b * s + a * t) / det
    product = (r * t - s * s) / det
    half = 0.5 * trace
    return np.maximum(half + np.sqrt(np.maximum(half * half - product, 0.0)), 0.0)
