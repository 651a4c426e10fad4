"""Biases of known coordinates, estimable at any time: while their rays are in the window and after they have left it.

A given coordinate ``z = p + b`` has a bias ``b``. Where the coordinate counts, the bias is held at zero; where the
coordinate is refused, the bias is free, which is the same as leaving the coordinate out. With a column for each bias
the normal equations keep the form of a `Border` when unknowns are marginalised. So a coordinate can be tested, refused
and taken back exactly, also long after its rays have left the window, and several coordinates together.

The unknowns of drifts of tie points (see `drifts`) are held at zero as well. They have rows in a border of biases, as
the unknowns of the state have, under the numbers -1, -2, ...
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import solve_triangular

from ...adjustment.bias_search import Verdict, judge
from ...arrays import Array, Bools, IntArray
from ..state.batch import Batch, Information
from ..state.unknowns import Border, Marginal, WindowState
from .drifts import Cell

AXES = "XYZ"


@dataclass(frozen=True)
class Coordinate:
    """A known coordinate: point, axis 0..2, place of the strip that saw it, weight (1/m^2) and value (m)."""

    point: str
    axis: int
    strip: int
    weight: float
    value: float

    def __str__(self) -> str:
        return f"{self.point} {AXES[self.axis]}"


@dataclass
class Biases:
    """Biases of c known coordinates.

    Attributes
    ----------
    coordinates : (c,)
    out : (c,) whether the coordinate is refused
    border : the biases beside the unknowns, as if all coordinates counted
    """

    coordinates: list[Coordinate]
    out: Bools
    border: Border

    def __len__(self) -> int:
        return len(self.coordinates)


def biases_of(batch: Batch, p: int, weight: Array, out: Bools, cell: Cell | None = None) -> Biases:
    """Biases of the coordinates of one point of a batch.

    Parameters
    ----------
    p : place of the point
    weight : (3,) of its coordinates as given, 0 where there is none
    out : (3,) coordinates that are refused, so that the batch does not have them
    cell : drifts of the rays of the batch
    """
    axes = np.flatnonzero(weight > 0)
    columns, coupling = batch.columns, batch.coupling[p]
    if cell is not None:
        columns = np.concatenate([columns, -1 - cell.places])
        coupling = np.concatenate([coupling, cell.coupling[p]], axis=1)
    L = batch.inverse_factors[p]
    Q, moment, into = L.T @ L, L.T @ batch.normals.y[:, p], L.T @ coupling  # of the point given the orientation
    off = batch.control.xyz_l[p] - batch.origin_l[p]
    lost = np.where(out, weight, 0.0)
    if lost.any():  # as if all counted
        update = np.linalg.inv(np.eye(3) + Q * lost)
        Q, moment, into = update @ Q, update @ (moment + Q @ (lost * off)), update @ into
    w = weight[axes]
    H = np.diag(w) - w[:, None] * Q[np.ix_(axes, axes)] * w
    strip = int(batch.rays.strip[batch.first_ray[p]])
    coordinates = [
        Coordinate(batch.names[p], int(a), strip, float(weight[a]), float(batch.control.xyz_l[p, a])) for a in axes
    ]
    return Biases(coordinates, out[axes], Border(columns, -(w[:, None] * into[axes]).T, H, w * (off - moment)[axes]))


@dataclass(frozen=True)
class Discrepancies:
    """Information about c biases, and about k drifts where asked for, with all unknowns eliminated.

    Attributes
    ----------
    C, v : (c, c), (c,) normal equations of the biases: ``b = C^-1 v`` if all of them were free
    V, score, X : (k, k), (k,), (c, k) the same of the drifts, and between both
    """

    coordinates: list[Coordinate]
    out: Bools
    C: Array
    v: Array
    V: Array
    score: Array
    X: Array

    @property
    def axis(self) -> IntArray:
        """Axis 0..2 of each coordinate (c,)."""
        return np.array([c.axis for c in self.coordinates], dtype=np.int64)

    @property
    def explained(self) -> float:
        """By how much the weighted squares of the adjustment fall if all biases are estimated."""
        return float(self.v @ np.linalg.lstsq(self.C, self.v, rcond=1e-12)[0])

    def judge(self, price: float, shifted: Collection[int] | None = None) -> Verdict:
        """Which coordinates are wrong; each bias has this price, see `bias_search`."""
        return judge(self.C, self.v, self.axis, price, self.out, shifted)

    def names(self, which: Bools) -> str:
        """Coordinates (c,) in words."""
        return ", ".join(sorted(str(self.coordinates[i]) for i in np.flatnonzero(which)))


def discrepancies(parts: Sequence[Biases], state: WindowState, drifts: Border | None = None) -> Discrepancies:
    """Eliminate the unknowns from the joint normal equations of several parts.

    Parameters
    ----------
    state : solved
    drifts : beside the unknowns of the state, as they are without the coordinates that are refused
    """
    drifts = drifts or Border.of(0, state.numbers)
    out = np.concatenate([part.out for part in parts])
    n, c, k = len(state), len(out), len(drifts)
    joint = Border.of(c + k, np.concatenate([state.numbers, -1 - np.arange(k)]))
    at = 0
    for part in parts:
        joint.join(at + np.arange(len(part)), part.border)
        at += len(part)
    joint.join(c + np.arange(k), drifts)
    G, H, r = joint.G[:n], joint.H, joint.r
    K = joint.G[n : n + k, :c]  # between drifts and biases
    if k and out.any():  # as if all counted
        own = np.flatnonzero(out)
        into = K[:, own] @ np.linalg.inv(H[np.ix_(own, own)])
        G[:, c:] += G[:, own] @ into.T
        H[c:, c:] += into @ K[:, own].T
        r[c:] += into @ r[own]
    H[c:, :c], H[:c, c:] = K, K.T
    S, t = G.T @ state.propagated(G), G.T @ state.theta
    if out.any():  # the state does not have what is refused: that is put back
        back = np.flatnonzero(out)
        gain = S[:, back] @ np.linalg.inv(H[np.ix_(back, back)] + S[np.ix_(back, back)])
        t = t + gain @ (r[back] - t[back])
        S = S - gain @ S[back]
    C, v = H - S, r - t
    coordinates = [coordinate for part in parts for coordinate in part.coordinates]
    return Discrepancies(coordinates, out, C[:c, :c], v[:c], C[c:, c:], v[c:], C[:c, c:])


class LeftControl(Biases):
    """Biases of coordinates whose batches have left the window.

    Parameters
    ----------
    most : coordinates kept at most; what has been decided about the oldest ones is then final
    """

    def __init__(self, most: int) -> None:
        super().__init__([], np.empty(0, dtype=bool), Border())
        self._most = most

    def add(self, new: Biases) -> None:
        """A point leaves with its batch; call while its unknowns are still in the state."""
        total = len(self) + len(new)
        self.border.join(np.arange(len(self), total), new.border)
        self.coordinates, self.out = self.coordinates + new.coordinates, np.concatenate([self.out, new.out])
        if total > self._most:
            self._keep(np.arange(total) >= total - self._most)

    def _keep(self, which: Bools) -> None:
        """Forget the others: those that count go on counting, those that are refused stay out for good."""
        border, gone = self.border, self.out & ~which
        if gone.any():
            H, G, r = border.H, border.G, border.r
            known = np.linalg.inv(H[np.ix_(gone, gone)])
            border.G, border.r = G - G[:, gone] @ known @ H[gone], r - H[:, gone] @ known @ r[gone]
            border.H = H - H[:, gone] @ known @ H[gone]
        border.keep(which)
        self.coordinates = [c for c, k in zip(self.coordinates, which, strict=True) if k]
        self.out = self.out[which]

    def take_out(self, which: Bools, state: WindowState) -> tuple[IntArray, Information]:
        """Refuse coordinates (c,) for good, in the state as well; returns what `set_out` returns."""
        gained = self.set_out(self.out | which, state)
        self._keep(~which)
        return gained

    def drop_drifts(self) -> None:
        """The strip whose drifts were watched is over: they have no rows here any more."""
        own = self.border.numbers >= 0
        self.border.numbers, self.border.G = self.border.numbers[own], self.border.G[own]

    def drop_strips(self, over: set[int]) -> None:
        """Forget the coordinates seen from strips that are over."""
        which = np.array([c.strip not in over for c in self.coordinates], dtype=bool)
        if not which.all():
            self._keep(which)

    def marginalised(self, m: Marginal) -> None:
        """Unknowns have left the window. They left without the coordinates refused, which are put back first."""
        border, out = self.border, self.out
        first = border.rows(m.gone)[:, out]
        if first.any():
            K = first @ np.linalg.inv(border.H[np.ix_(out, out)])
            N11 = m.R11.T @ m.R11 + K @ first.T
            N12 = m.R11.T @ m.R12 + K @ border.rows(m.stayed)[:, out].T
            n1 = m.R11.T @ m.d1 + K @ border.r[out]
            scale = 1.0 / np.sqrt(np.diagonal(N11))
            R11 = np.linalg.cholesky(N11 * scale[:, None] * scale).T / scale
            R12, d = (solve_triangular(R11, n, trans=1, check_finite=False) for n in (N12, n1))
            m = Marginal(m.gone, m.stayed, R11, R12, d)
        border.marginalise(m)

    def set_out(self, out: Bools, state: WindowState) -> tuple[IntArray, Information]:
        """Refuse coordinates (c,) and take the others back, in the state as well.

        Returns the numbers of the unknowns, negative ones of drifts among them, and the information that they gain.
        """
        numbers, gained = self.border.numbers, self.border.freed(self.out) - self.border.freed(out)
        own = np.flatnonzero(numbers >= 0)
        of_state = replace(gained, matrix=gained.matrix[np.ix_(own, own)], rhs=gained.rhs[own])
        state.add(numbers[own], of_state)
        state.fix(numbers[own], of_state)
        self.out = out.copy()
        return numbers, gained
