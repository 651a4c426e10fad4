"""The test at the door: looks at a point are judged against the orientation as known without them, before they enter.

Once several gross errors are in the window together, its orientation follows them, and what is tested against it is
judged by its own fault. So each point is tested alone: its looks must meet, and meet its known coordinates, within what
their noise and the orientation's covariance allow. The covariance knows that the slow errors of looks a few seconds
apart are nearly the same; that makes the test sharp even before anything has been adjusted.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from ..adjustment.reliability import UNCONTROLLED
from .batch import Batch
from .state import WindowState

Array = NDArray[np.floating]
Bools = NDArray[np.bool_]

#: Probability that the looks at a good point are suspected; data snooping tests more sharply afterwards.
SUSPECTED = 1e-5
#: By how much the cost lost with one look must exceed that of the next for it to be told that it is the bad one
#: (chi-square, 0.1 %).
DECISIVE = 10.8
#: Variance, in units of the observation's, that leaves an observation out.
LEFT_OUT = 1e10


def entry_weight(batch: Batch, state: WindowState, suspected: float = SUSPECTED) -> tuple[Array, Array]:
    """Weights (n,) with which the rays of a batch should enter: 1, or 0 for those that contradict the others; and their
    w (n,), the larger residual against what the others predict over its sigma.

    Where looks of a point contradict each other and it cannot be told which is bad, all go; but not those of known
    coordinates, where the fault may lie with the coordinates: these are left to data snooping. So are those of three
    and more looks that agree with each other.

    Parameters
    ----------
    batch : linearised; the points that are judged must not be in the state
    state : solved
    suspected : probability that the looks at a good point are
    """
    equations = _Equations.of(batch, state)
    active = equations.present.copy()
    known = batch.control.weight > 0
    open_ = np.ones(batch.n_points, dtype=bool)
    limits = _limits(2 * active.shape[1] + 3, suspected)
    w = np.zeros(active.shape)
    unknown = np.zeros_like(batch.control.weight)
    for _ in range(active.shape[1]):
        square, loss, now_w = equations.test(active, batch.control.weight)
        w = np.where(active, now_w, w)
        redundancy = 2 * active.sum(axis=1) + known.sum(axis=1) - 3
        fails = open_ & (square > limits[np.maximum(redundancy, 0)])
        among = fails & known.any(axis=1) & (active.sum(axis=1) >= 3)
        if among.any():
            alike = equations.test(active, unknown)[0] <= limits[np.maximum(2 * active.sum(axis=1) - 3, 0)]
            open_ &= ~(among & alike)
            fails &= open_
        if not fails.any():
            break
        ordered = np.sort(loss, axis=1)
        decided = fails & (ordered[:, -1] > (ordered[:, -2] if loss.shape[1] > 1 else 0.0) + DECISIVE)
        undecided = fails & ~decided
        active[undecided & ~known.any(axis=1)] = False
        open_ &= ~undecided
        active[np.flatnonzero(decided), np.argmax(loss, axis=1)[decided]] = False
    # one look is left: nothing checks it; a look that never had company is let in at coordinates known or from before
    before = known.all(axis=1) if batch.ties is None else known.all(axis=1) | batch.ties.active
    alone = (active.sum(axis=1) < 2) & ((equations.present.sum(axis=1) > 1) | ~before)
    active[alone] = False
    place = batch.rays.point, equations.slot
    return np.where(active[place], 1.0, 0.0), w[place]


@cache
def _limits(most: int, suspected: float) -> Array:
    return np.concatenate([[np.inf], chi2.isf(suspected, np.arange(1, most + 1))])


@dataclass(frozen=True)
class _Equations:
    """Whitened observations of p points, each with room for the same number k of rays.

    Attributes
    ----------
    slot : (n,) place of each ray at its point
    present : (p, k)
    residual : (p, 2k) at the state's orientation and the batch's points
    point : (p, 2k, 3) derivative to the object point
    covariance : (p, 2k, 2k) of noise and orientation together
    off : (p, 3) how far the points are from known coordinates
    """

    slot: NDArray[np.int64]
    present: Bools
    residual: Array
    point: Array
    covariance: Array
    off: Array

    @classmethod
    def of(cls, batch: Batch, state: WindowState) -> _Equations:
        n, p, u = len(batch.rays), batch.n_points, len(batch.columns)
        of_point = batch.rays.point
        slot = np.arange(n) - batch.first_ray[of_point]
        k = int(slot.max()) + 1
        present = np.zeros((p, k), dtype=bool)
        present[of_point, slot] = True
        rows = batch.full_rows(np.arange(n))
        A, J, e = np.zeros((p, k, 2, u)), np.zeros((p, k, 2, 3)), np.zeros((p, k, 2))
        A[of_point, slot] = rows
        J[of_point, slot] = batch.lin.point.transpose(2, 0, 1)
        e[of_point, slot] = batch.lin.residual.T - rows @ (state.values(batch.columns) - batch.theta)
        A = A.reshape(p, 2 * k, u)
        through = (A.reshape(-1, u) @ state.covariance(batch.columns)).reshape(p, 2 * k, u)
        covariance = through @ np.swapaxes(A, 1, 2) + np.eye(2 * k)
        off = np.where(batch.control.weight > 0, batch.control.xyz_l - batch.origin_l, 0.0)
        residual, point = e.reshape(p, 2 * k), J.reshape(p, 2 * k, 3)
        return cls(slot, present, residual, point, covariance, off)

    def test(self, active: Bools, control: Array) -> tuple[Array, Array, Array]:
        """Weighted square sum (p,) of active rays about their best points, with weights (p, 3) of known coordinates;
        what it loses without each ray (p, k); the larger |w| of each ray (p, k)."""
        p, k = active.shape
        out = np.where(np.repeat(active, 2, axis=1), 0.0, LEFT_OUT)
        W = np.linalg.inv(self.covariance + out[:, :, None] * np.eye(2 * k))
        WJ = W @ self.point
        N = np.swapaxes(self.point, 1, 2) @ WJ + control[:, :, None] * np.eye(3)
        N += 1e-9 * np.einsum("pii->p", N)[:, None, None] * np.eye(3)
        rhs = np.einsum("pik,pi->pk", WJ, self.residual) + control * self.off
        shift = np.linalg.solve(N, rhs[:, :, None])[:, :, 0]
        rest = self.residual - np.einsum("pik,pk->pi", self.point, shift)
        h = np.einsum("pij,pj->pi", W, rest)
        square = np.einsum("pi,pi->p", rest, h) + (control * (self.off - shift) ** 2).sum(axis=1)
        S = W - WJ @ np.linalg.solve(N, np.swapaxes(WJ, 1, 2))
        each = np.arange(k)
        own = S.reshape(p, k, 2, k, 2)[:, each, :, each].transpose(1, 0, 2, 3)
        own = np.where(active[:, :, None, None], own, np.eye(2))
        h = np.where(active[:, :, None], h.reshape(p, k, 2), 0.0)
        loss = np.einsum("pka,pkab,pkb->pk", h, np.linalg.pinv(own, rcond=1e-6, hermitian=True), h)
        checked = np.maximum(np.einsum("pkaa->pka", own), 0.0)
        w = np.where(checked > UNCONTROLLED, np.abs(h) / np.sqrt(np.maximum(checked, UNCONTROLLED)), 0.0)
        return square, loss, w.max(axis=2)
