"""The entry test: looks at a point are judged against the orientation as known without them, before they enter.

Once several gross errors are in the window together, its orientation follows them and they no longer show. So each
point is tested alone: its looks must meet, and meet its known coordinates, within what their noise and the
orientation's covariance allow. In that covariance the slow errors of looks a few seconds apart are nearly the same,
which makes the test sharp even before anything has been adjusted.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from ...adjustment.reliability import normalised_residuals
from ...arrays import Array, Bools, IntArray
from ...quantiles import chi2
from ..state.batch import Batch
from ..state.unknowns import WindowState

#: Probability that the looks at a good point are suspected; data snooping tests more sharply afterwards.
SUSPECTED = 1e-5
#: A look is known to be the bad one if the weighted squares fall by so much more without it than without any other look
#: at its point (chi-square, 0.1 %).
DECISIVE = 10.8
#: Variance, in units of the observation's, that leaves an observation out.
LEFT_OUT = 1e10
#: Ratio of its two variances below which a covariance of line and sample is singular. Numerical: far above rounding.
SINGULAR = 1e-6
_UNIT = np.eye(3)


def entry_weight(
    batch: Batch, equations: EntryEquations, suspected: float = SUSPECTED, wider: float = 1.0
) -> tuple[Array, Array]:
    """Weights (n,) with which the rays of a batch should enter, 1 or 0, and their larger normalised residual (n,).

    Where the looks at a point contradict each other and it cannot be told which is bad, all of them go. At known
    coordinates, which may be wrong themselves, they stay and are left to data snooping; so do three looks and more at
    known coordinates that agree with each other.

    Parameters
    ----------
    batch, equations : linearised; the points that are judged must not be in the state
    suspected : probability that the looks at a good point are
    wider : the test is so many times as wide, see `SigmaFactors.disagreement`
    """
    active, control = equations.present.copy(), batch.control.weight
    given = (control > 0).sum(axis=1)
    open_ = np.ones(batch.n_points, dtype=bool)
    limits = wider**2 * np.append(np.inf, chi2.isf(suspected, np.arange(1, 2 * active.shape[1] + 1)))  # by redundancy
    w = np.zeros(active.shape)
    for _ in range(active.shape[1]):
        first = not control.any() and (active == equations.present).all()
        square, loss, now_w = equations.by_themselves if first else equations.test(active, control)
        w = np.where(active, now_w, w)
        looks = active.sum(axis=1)
        fails = open_ & (square > limits[np.maximum(2 * looks + given - 3, 0)])
        among = fails & (given > 0) & (looks >= 3)
        if among.any():
            alone, *_ = equations.test(active, np.zeros_like(control))
            open_ &= ~among | (alone > limits[np.maximum(2 * looks - 3, 0)])
            fails &= open_
        if not fails.any():
            break
        decided = fails & _stands_out(loss)
        undecided = fails & ~decided
        active[undecided & (given == 0)] = False
        open_ &= ~undecided
        active[np.flatnonzero(decided), np.argmax(loss, axis=1)[decided]] = False
    # nothing checks a look that is left alone; one that came alone enters where known coordinates or a tie check it
    placed = given == 3 if batch.ties is None else (given == 3) | batch.ties.active
    active[(active.sum(axis=1) < 2) & ((equations.present.sum(axis=1) > 1) | ~placed)] = False
    place = batch.rays.point, equations.slot
    return np.where(active[place], 1.0, 0.0), w[place]


def disagreement(equations: EntryEquations) -> list[tuple[float, int, bool]]:
    """Of each point with two rays or more, not in the state: weighted squares of its looks about their best place, with
    all that is known of the orientation without them; their redundancy; and whether a single gross error is spared. Of
    three rays or more the look whose loss makes the squares smallest is left out, so that it is."""
    square, loss, _ = equations.by_themselves
    looks = equations.present.sum(axis=1)
    spared = looks > 2
    best = np.where(spared, np.maximum(square - loss.max(axis=1), 0.0), square)
    return [
        (float(s), 2 * int(n) - (5 if more else 3), bool(more))
        for s, n, more in zip(best, looks, spared, strict=True)
        if n > 1
    ]


def _stands_out(loss: Array) -> Bools:
    """Whether the look at each point (p, k) without which the squares fall most is decisively the bad one (p,)."""
    ordered = np.sort(np.pad(loss, ((0, 0), (1, 0))), axis=1)
    return np.asarray(ordered[:, -1] > ordered[:, -2] + DECISIVE)


class JudgedLooks(NamedTuple):
    """Looks at points with three or more, and which of them each point would be right without.

    Attributes
    ----------
    time_s, ccd : (n,) of the looks
    square : (n,) by how much the weighted squares of the point fall without it; chi-square, two degrees of freedom
    wrong : (n,) whether that is decisively more than without any other look at its point
    """

    time_s: Array
    ccd: IntArray
    square: Array
    wrong: Bools

    @classmethod
    def none(cls) -> JudgedLooks:
        return cls(np.empty(0), np.empty(0, dtype=np.int64), np.empty(0), np.empty(0, dtype=bool))

    @classmethod
    def of(cls, batch: Batch, equations: EntryEquations) -> JudgedLooks:
        """Of a batch that is not in the state, with all that is known of the orientation without it."""
        _, loss, _ = equations.by_themselves
        point, slot = batch.rays.point, equations.slot
        many = equations.present.sum(axis=1)[point] > 2
        wrong = _stands_out(loss)[point] & (np.argmax(loss, axis=1)[point] == slot)
        return cls(batch.rays.time_s[many], batch.rays.ccd[many], loss[point, slot][many], wrong[many])


@dataclass(frozen=True)
class EntryEquations:
    """Whitened observations of p points, each with room for k rays, the most that any of them has.

    Attributes
    ----------
    slot : (n,) place of each ray at its point
    present : (p, k)
    residual : (p, 2k) at the state's orientation and the batch's points
    point : (p, 2k, 3) derivative to the object point
    covariance : (p, 2k, 2k) of noise and orientation together
    off : (p, 3) how far the points are from known coordinates
    """

    slot: IntArray
    present: Bools
    residual: Array
    point: Array
    covariance: Array
    off: Array

    @classmethod
    def of(cls, batch: Batch, state: WindowState) -> EntryEquations:
        """Of the points of a batch that is linearised and not in the state, which is solved."""
        n, p, u = len(batch.rays), batch.n_points, len(batch.columns)
        of_point = batch.rays.point
        slot = np.arange(n) - batch.first_ray[of_point]
        k = int(slot.max()) + 1
        present = np.zeros((p, k), dtype=bool)
        present[of_point, slot] = True
        rows = batch.full_rows
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

    @cached_property
    def by_themselves(self) -> tuple[Array, Array, Array]:
        """`test` of all looks, without known coordinates."""
        return self.test(self.present, np.zeros_like(self.off))

    def test(self, active: Bools, control: Array) -> tuple[Array, Array, Array]:
        """Weighted square sum (p,) of active rays about their best points, with weights (p, 3) of known coordinates;
        what it loses without each ray (p, k); the larger |w| of each ray (p, k)."""
        p, k = active.shape
        out = np.where(np.repeat(active, 2, axis=1), 0.0, LEFT_OUT)
        W = np.linalg.inv(self.covariance + out[:, :, None] * np.eye(2 * k))
        WJ = W @ self.point
        N = np.swapaxes(self.point, 1, 2) @ WJ + control[:, :, None] * _UNIT
        N += 1e-9 * np.einsum("pii->p", N)[:, None, None] * _UNIT
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
        loss = np.einsum("pka,pkab,pkb->pk", h, _inverses(own), h)
        return square, loss, np.abs(normalised_residuals(h, np.einsum("pkaa->pka", own))).max(axis=2)


def _inverses(C: Array) -> Array:
    """Inverses (..., 2, 2) of symmetric matrices; of those that are nearly singular the pseudo-inverse.

    In closed form, since that of NumPy takes ten times as long for the few looks of a point.
    """
    a, b, d = C[..., 0, 0], C[..., 0, 1], C[..., 1, 1]
    half, root = 0.5 * (a + d), np.sqrt(0.25 * (a - d) ** 2 + b * b)
    larger, det = half + root, a * d - b * b
    regular = det > SINGULAR * larger * larger
    out = np.empty(C.shape)
    out[..., 0, 0], out[..., 1, 1], out[..., 0, 1] = d, a, -b
    out[..., 1, 0] = -b
    out /= np.where(regular, det, 1.0)[..., None, None]
    if not regular.all():  # along the larger axis only: C - smaller I is that axis times the difference of both
        axis = C - (half - root)[..., None, None] * np.eye(2)
        weight = np.where(larger > 0, 2.0 * root * larger, np.inf)
        single = axis / np.where(weight > 0, weight, np.inf)[..., None, None]
        out = np.where(regular[..., None, None], out, single)
    return out
