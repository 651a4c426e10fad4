"""Whether a point seen again agrees with what earlier strips say of it; ties that fail are dropped, the looks stay."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ...adjustment.normal_equations import without_point
from ...adjustment.snooping import TOGETHER
from ...arrays import Array, Bools
from ...quantiles import chi2
from ..results import Update
from ..state.batch import Batch, PointTies
from ..state.network import LiveNetwork
from ..state.unknowns import WindowState

#: Probability that a good tie fails the test on entry, and the one in the window.
ON_ENTRY, INSIDE = 1e-5, 1e-3
#: Two rays place a point well if its sigma along them is below this share of the distance. Tuned.
WELL = 0.02


def drop_weak(batch: Batch) -> None:
    """Drop the ties of points that lie on one ray and on a single look of an earlier strip which is nearly parallel.

    Such points are placed badly; linearised far off, the tie would say more than it knows.
    """
    if batch.ties is None:
        return
    rows = batch.ties.rows(batch.origin_l, len(batch.columns))
    weak = np.zeros(batch.n_points, dtype=bool)
    for i in np.flatnonzero(_of_two_strips(batch, batch.ties)):
        _, J, _, origin = batch.equations(int(i))
        least = np.linalg.eigvalsh(J.T @ J + rows.point[i].T @ rows.point[i])[0]
        away = np.linalg.norm(origin - batch.rays.position_l[batch.first_ray[i]])
        weak[i] = least < (WELL * away) ** -2
    drop_ties(batch, weak)


def meet(batch: Batch, state: WindowState) -> None:
    """Linearise points of one look anew where its ray meets that of a single look of an earlier strip, which has said
    only that they lie somewhere on it."""
    if batch.ties is not None and _of_two_strips(batch, batch.ties).any():
        theta = state.values(batch.columns)
        batch.back_substitute(theta)
        batch.linearise(theta, reweigh=True)


def _of_two_strips(batch: Batch, ties: PointTies) -> Bools:
    """Which points (p,) lie on one ray of the batch and on a single look of an earlier strip."""
    return ties.active & ties.single & (np.diff(batch.first_ray) == 1)


def contradicting(batch: Batch, state: WindowState, alpha: float = INSIDE, which: Bools | None = None) -> Bools:
    """Which points (p,) have ties that their rays contradict, where neither of both are in the state.

    The place where the rays meet, with the orientation as known, is compared with what the earlier strips say of it.
    Where they do not meet, as a single one, the rays and what these strips say must agree on some place.

    Parameters
    ----------
    alpha : probability that a good tie fails
    which : points (p,) to be tested; by default all
    """
    ties = batch.ties
    fails = np.zeros(batch.n_points, dtype=bool)
    if ties is None or not ties.active.any():
        return fails
    theta, Q = state.values(batch.columns), state.covariance(batch.columns)
    tied = ties.rows(batch.origin_l, len(batch.columns))
    for i in np.flatnonzero(ties.active if which is None else ties.active & which):
        A, J, residual, _ = batch.equations(int(i))
        used = (J != 0).any(axis=1)
        A, J, residual = A[used], J[used], residual[used]
        m = ties.observations[i]
        D, P, off = tied.design[i, :m], tied.point[i, :m], tied.residual[i, :m]
        N = J.T @ J
        if len(J) < 3 or np.linalg.cond(N) > 1e12:
            D, off = without_point(np.concatenate([A, D]), np.concatenate([J, P]), np.concatenate([residual, off]))
            C = np.eye(len(off))
        else:
            through = P @ np.linalg.inv(N) @ J.T
            D, off = D - through @ A, off - through @ residual
            C = np.eye(m) + through @ through.T
        off = off - D @ theta
        C = C + D @ Q @ D.T
        fails[i] = len(off) > 0 and off @ np.linalg.solve(C, off) > chi2.isf(alpha, len(off))
    return fails


def snoop_ties(batches: Sequence[Batch], network: LiveNetwork, update: Update) -> bool:
    """Drop ties of batches in the state that fail; whether there are any: then the state has to be solved again."""
    tests = [(b, b.ties, _joint(b, b.ties, network.state)) for b in batches if b.ties is not None]
    worst = max((float(value.max(initial=0.0)) for *_, value in tests), default=0.0)
    failed = False
    for batch, ties, value in tests:
        before, counted = batch.information, batch.counts
        limit = chi2.isf(INSIDE, ties.observations)
        set_apart(batch, value > np.maximum(limit, TOGETHER * worst), network, update)
        if batch.information is not before:
            network.batches.exchange(batch, before, counted)
            failed = True
    return failed


def _joint(batch: Batch, ties: PointTies, state: WindowState) -> Array:
    """By how much the weighted squares fall without each tie (p,); 0 for points without."""
    theta = state.values(batch.columns)
    batch.back_substitute(theta)
    rows = ties.rows(batch.origin_l, len(batch.columns))
    through = rows.point @ np.swapaxes(batch.inverse_factors, 1, 2)
    design = rows.design - through @ batch.coupling
    C = design @ state.covariance(batch.columns) @ np.swapaxes(design, 1, 2) + through @ np.swapaxes(through, 1, 2)
    v = rows.residual - rows.design @ theta - np.einsum("pij,pj->pi", rows.point, batch.points_l - batch.origin_l)
    value = np.einsum("pi,pij,pj->p", v, np.linalg.pinv(np.eye(3) - C, rcond=1e-6, hermitian=True), v)
    return np.where(rows.active & (batch.normals.rank == 3), value, 0.0)


def set_apart(batch: Batch, fails: Bools, network: LiveNetwork, update: Update) -> None:
    """Points (p,) that do not agree with earlier strips are points of their own, without ties."""
    drop_ties(batch, fails)
    for i in np.flatnonzero(fails):
        point = network.intake.points[batch.names[i]]
        point.alone, point.spent = True, False
        update.alone.append(batch.names[i])


def drop_ties(batch: Batch, fails: Bools) -> None:
    """Take the weight from ties of points (p,); known coordinates that they stood for count themselves."""
    if batch.ties is None or not fails.any():
        return
    batch.ties = replace(batch.ties, active=batch.ties.active & ~fails)
    weight = np.where(fails[:, None], batch.ties.control, batch.control.weight)
    batch.control = replace(batch.control, weight=weight)
    batch.eliminate()
