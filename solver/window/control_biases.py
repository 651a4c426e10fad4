"""What known coordinates would be off by: a bias for each, that could be there and is not, in window and after it.

A given coordinate ``z = p + b`` has a bias ``b`` that is held at zero where the coordinate counts, and free where it
is refused, which is the same as leaving it out. With a column for each bias the normal equations are

    [N  G] [x]   [n]
    [G' H] [b] = [r]

and keep that form when unknowns are marginalised. So a coordinate can be tested, refused and taken back exactly, also
long after its rays have left the window, and several of them together. The unknowns of tie points that drift
(`drift_border`) have rows in G as those of the state have; their numbers are negative.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular

from .batch import Batch, Information, inverse_factors
from .drift_border import Cell
from .state import Marginal, WindowState

Array = NDArray[np.floating]
IntArray = NDArray[np.int64]
Bools = NDArray[np.bool_]


@dataclass(frozen=True)
class Coordinate:
    """A known coordinate in use somewhere: point, axis 0..2 and strip that saw it; weight and value as given."""

    point: str
    axis: int
    strip: int
    weight: float
    value: float

    @property
    def key(self) -> tuple[str, int]:
        """What it is refused under."""
        return self.point, self.axis


@dataclass(frozen=True)
class Biases:
    """Columns of c biases, all of them free.

    Attributes
    ----------
    coordinates : (c,)
    out : (c,) whether it is refused
    columns : (u,) numbers of unknowns, negative ones of drifts
    G, H, r : (u, c), (c, c), (c,)
    """

    coordinates: list[Coordinate]
    out: Bools
    columns: IntArray
    G: Array
    H: Array
    r: Array


def biases_of(batch: Batch, p: int, weight: Array, out: Bools, cell: Cell | None = None) -> Biases:
    """Of a point of a batch with given weights (3,), of which those that are out (3,) do not count in it now.

    ``cell``: what drifts have to do with the batch.
    """
    axes = np.flatnonzero(weight > 0)
    L = inverse_factors(batch.normals)[p]
    Q, moment = L.T @ L, L.T @ batch.normals.y[:, p]  # of the point given the orientation, from where it is counted
    into = L.T @ batch.coupling[p]
    off = batch.control.xyz_l[p] - batch.origin_l[p]
    drifts, on = cell.on_point(p) if cell is not None else (np.empty(0, np.int64), np.empty((0, 3)))
    lost = np.where(out, weight, 0.0)
    if lost.any():  # as if all counted
        update = np.linalg.inv(np.eye(3) + Q * lost)
        Q, moment, into, on = update @ Q, update @ (moment + Q @ (lost * off)), update @ into, on @ update.T
    w = weight[axes]
    H = np.diag(w) - w[:, None] * Q[np.ix_(axes, axes)] * w
    strip = int(batch.rays.strip[batch.first_ray[p]])
    coordinates = [
        Coordinate(batch.names[p], int(a), strip, float(weight[a]), float(batch.control.xyz_l[p, a])) for a in axes
    ]
    G = -(w[:, None] * np.concatenate([into, on.T], axis=1)[axes]).T
    return Biases(coordinates, out[axes], np.concatenate([batch.columns, drifts]), G, H, w * (off - moment)[axes])


@dataclass(frozen=True)
class Discrepancies:
    """c biases after the unknowns are eliminated: information ``C``, ``v`` with ``b = C^-1 v`` if all were free.

    Attributes
    ----------
    V, score, X : (k, k), (k,), (c, k) the same of k drifts, if asked for, and what they have to do with each other
    """

    coordinates: list[Coordinate]
    out: Bools
    C: Array
    v: Array
    V: Array
    score: Array
    X: Array


def discrepancies(
    parts: list[Biases], state: WindowState, drifts: tuple[Array, Array, Array] | None = None
) -> Discrepancies:
    """Of biases of several points and of what left, from all that the solved state knows.

    Parameters
    ----------
    drifts : scores (k,), normal matrix (k, k) and coupling (k, n) to all unknowns of drifts to be looked at, as they
        are with what is refused left out
    """
    coordinates = [c for part in parts for c in part.coordinates]
    out = np.concatenate([part.out for part in parts])
    r = np.concatenate([part.r for part in parts])
    c = len(coordinates)
    score, D, M = drifts if drifts is not None else (np.empty(0), np.empty((0, 0)), np.empty((0, len(state))))
    n, k = len(state), len(score)
    G, H = np.zeros((n + k, c)), np.zeros((c, c))
    at = 0
    for part in parts:
        own = slice(at, at + len(part.coordinates))
        of_state = part.columns >= 0
        G[state.places(part.columns[of_state]), own] = part.G[of_state]
        if k:
            G[n - 1 - part.columns[~of_state], own] = part.G[~of_state]
        H[own, own] = part.H
        at = own.stop
    G, K = G[:n], G[n:]
    if k and out.any():  # as if all counted
        into = K[:, out] @ np.linalg.inv(H[np.ix_(out, out)])
        score, D, M = score + into @ r[out], D + into @ K[:, out].T, M + into @ G[:, out].T
    G, H, r = np.column_stack([G, M.T]), np.block([[H, K.T], [K, D]]), np.concatenate([r, score])
    S, t = G.T @ state.propagated(G), G.T @ state.theta
    if out.any():  # what is refused is put back first
        back = np.concatenate([out, np.zeros(k, dtype=bool)])
        gain = S[:, back] @ np.linalg.inv(H[np.ix_(back, back)] + S[np.ix_(back, back)])
        t = t + gain @ (r[back] - t[back])
        S = S - gain @ S[back]
    C, v = H - S, r - t
    return Discrepancies(coordinates, out, C[:c, :c], v[:c], C[c:, c:], v[c:], C[:c, c:])


class LeftControl:
    """Coordinates whose batches have left the window.

    Parameters
    ----------
    most : kept at most; the oldest ones stay what they are for good
    """

    def __init__(self, most: int) -> None:
        self._most = most
        self._forget_all()

    def _forget_all(self) -> None:
        none = np.empty(0)
        self._kept = Biases([], np.empty(0, bool), np.empty(0, np.int64), none.reshape(0, 0), none.reshape(0, 0), none)

    def __len__(self) -> int:
        return len(self._kept.coordinates)

    @property
    def biases(self) -> Biases:
        return self._kept

    def add(self, new: Biases) -> None:
        """A point leaves with its batch; its unknowns are still there."""
        old = self._kept
        numbers = np.union1d(old.columns, new.columns)
        k, m = len(old.coordinates), len(new.coordinates)
        G, H = np.zeros((len(numbers), k + m)), np.zeros((k + m, k + m))
        G[np.searchsorted(numbers, old.columns), :k] = old.G
        G[np.searchsorted(numbers, new.columns), k:] = new.G
        H[:k, :k], H[k:, k:] = old.H, new.H
        coordinates, out = old.coordinates + new.coordinates, np.concatenate([old.out, new.out])
        self._kept = Biases(coordinates, out, numbers, G, H, np.concatenate([old.r, new.r]))
        if len(coordinates) > self._most:
            self._keep(np.arange(len(coordinates)) >= len(coordinates) - self._most)

    def _keep(self, which: Bools) -> None:
        """Forget the others: those that count go on counting, those that are refused stay out for good."""
        old = self._kept
        H, G, r = old.H, old.G, old.r
        gone = old.out & ~which
        if gone.any():
            through = np.linalg.solve(H[np.ix_(gone, gone)], np.column_stack([H[gone], G[:, gone].T, r[gone]]))
            n = len(r)
            H, G, r = (
                H - H[:, gone] @ through[:, :n], G - (H[:, gone] @ through[:, n:-1]).T, r - H[:, gone] @ through[:, -1],
            )  # fmt: skip
        kept = [c for c, k in zip(old.coordinates, which, strict=True) if k]
        self._kept = Biases(kept, old.out[which], old.columns, G[:, which], H[np.ix_(which, which)], r[which])

    def drop_drifts(self) -> None:
        """The drifts that were watched are no unknowns any more."""
        kept = self._kept
        own = kept.columns >= 0
        self._kept = replace(kept, columns=kept.columns[own], G=kept.G[own])

    def drop_strips(self, over: set[int]) -> None:
        """Forget the coordinates seen from strips that are over."""
        which = np.array([c.strip not in over for c in self._kept.coordinates], dtype=bool)
        if which.all():
            return
        if which.any():
            self._keep(which)
        else:
            self._forget_all()

    def marginalised(self, m: Marginal) -> None:
        """Unknowns have left the window; they left as they were with those refused left out."""
        old = self._kept
        if not len(self) or not np.isin(old.columns, m.gone).any():
            return
        first, rest = _rows(old, m.gone), _rows(old, m.stayed)
        R11, R12, d = m.R11, m.R12, m.d1
        out = old.out
        if out.any() and first[:, out].any():
            K = np.linalg.inv(old.H[np.ix_(out, out)])
            N11 = R11.T @ R11 + first[:, out] @ K @ first[:, out].T
            N12 = R11.T @ R12 + first[:, out] @ K @ rest[:, out].T
            n1 = R11.T @ d + first[:, out] @ K @ old.r[out]
            scale = 1.0 / np.sqrt(np.diagonal(N11))
            R11 = np.linalg.cholesky(N11 * scale[:, None] * scale).T / scale
            R12 = solve_triangular(R11, N12, trans=1, check_finite=False)
            d = solve_triangular(R11, n1, trans=1, check_finite=False)
        q = solve_triangular(R11, first, trans=1, check_finite=False)
        G, H, r = rest - R12.T @ q, old.H - q.T @ q, old.r - q.T @ d
        self._kept = Biases(old.coordinates, old.out, m.stayed.copy(), G, H, r)

    def set_out(self, out: Bools, state: WindowState) -> tuple[IntArray, Information]:
        """Refuse coordinates and take others back: the state is changed. Returns by what, with unknowns of drifts."""
        old = self._kept
        columns, before, after = old.columns, _taken_away(old, old.out), _taken_away(old, out)
        change = Information(
            before.matrix - after.matrix, before.rhs - after.rhs, before.square - after.square, before.rows - after.rows
        )
        own = np.flatnonzero(columns >= 0)
        of_state = replace(change, matrix=change.matrix[np.ix_(own, own)], rhs=change.rhs[own])
        state.add(columns[own], of_state)
        state.fix(columns[own], of_state)
        self._kept = replace(old, out=out.copy())
        return columns, change


def _taken_away(b: Biases, out: Bools) -> Information:
    """What the unknowns lose when biases are free."""
    G = b.G[:, out]
    K = np.linalg.inv(b.H[np.ix_(out, out)])
    return Information(G @ K @ G.T, G @ (K @ b.r[out]), float(b.r[out] @ K @ b.r[out]), int(out.sum()))


def _rows(b: Biases, numbers: IntArray) -> Array:
    """Rows of G for unknowns, zero for those it does not have."""
    found = np.zeros((len(numbers), b.G.shape[1]))
    if not len(b.columns):
        return found
    place = np.searchsorted(b.columns, numbers, sorter=(order := np.argsort(b.columns)))
    place = order[np.minimum(place, len(order) - 1)]
    has = b.columns[place] == numbers
    found[has] = b.G[place[has]]
    return found
