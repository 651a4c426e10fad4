"""Whether a point seen again agrees with what earlier strips say of it; ties that fail are dropped, the looks stay."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from ..adjustment.normal_equations import ControlWeights
from .batch import Batch, inverse_factors
from .state import WindowState
from .ties import without_point

Array = NDArray[np.floating]

#: Probability that a good tie fails, at the door and in the window.
AT_THE_DOOR, INSIDE = 1e-5, 1e-3
#: Ties of one batch that are dropped before it is solved again: those that fail by this share of the worst, at least.
TOGETHER = 0.5
#: Sigma along the rays, of the distance, up to which two of them place a point well.
WELL = 0.02


def admit_ties(batch: Batch, state: WindowState) -> list[str]:
    """Drop the ties of a batch that is not in the state which contradict its rays; names of their points."""
    return drop_ties(batch, contradicting(batch, state, AT_THE_DOOR))


def drop_weak(batch: Batch) -> None:
    """Drop the ties of points that one ray and a single look of an earlier strip, nearly parallel to it, place badly:
    linearised far off they would tell what they do not know."""
    if batch.ties is None:
        return
    rows = batch.ties.rows(batch.origin_l, len(batch.columns))
    weak = np.zeros(batch.n_points, dtype=bool)
    for i in np.flatnonzero(batch.ties.active & batch.ties.single & (np.diff(batch.first_ray) == 1)):
        _, J, _, origin = batch.equations(int(i))
        least = np.linalg.eigvalsh(J.T @ J + rows.point[i].T @ rows.point[i])[0]
        away = np.linalg.norm(origin - batch.rays.position_l[batch.first_ray[i]])
        weak[i] = least < (WELL * away) ** -2
    drop_ties(batch, weak)


def contradicting(
    batch: Batch, state: WindowState, alpha: float = INSIDE, which: NDArray[np.bool_] | None = None
) -> NDArray[np.bool_]:
    """Which points (p,) have ties that their rays contradict, neither of which are in the state; a good one is called
    so with probability ``alpha``. Of some points (p,), if these are given.

    The place where the new rays meet, with the orientation as known, is compared with what the earlier strips say of
    it; where they do not meet, as a single one, the rays and what these strips say must agree on some place.
    """
    ties = batch.ties
    if ties is None or not ties.active.any():
        return np.zeros(batch.n_points, dtype=bool)
    theta, Q = state.values(batch.columns), state.covariance(batch.columns)
    fails = np.zeros(batch.n_points, dtype=bool)
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


def snoop_ties(batches: Sequence[Batch], state: WindowState) -> list[str]:
    """Drop ties of batches in the state that fail; names of their points. The state has to be solved again if any."""
    limits = {n: float(chi2.isf(INSIDE, n)) for n in (2, 3)}
    values = [_joint(b, state) for b in batches]
    worst = max((float(v.max(initial=0.0)) for v in values), default=0.0)
    names = []
    for batch, value in zip(batches, values, strict=True):
        limit = 0.0 if batch.ties is None else np.where(batch.ties.single, limits[2], limits[3])
        fails = value > np.maximum(limit, TOGETHER * worst)
        if fails.any():
            state.add(batch.columns, batch.information, -1)
            names += drop_ties(batch, fails)
            state.add(batch.columns, batch.information)
    return names


def _joint(batch: Batch, state: WindowState) -> Array:
    """What the cost loses without each tie (p,); 0 for points without."""
    if batch.ties is None or not batch.ties.active.any():
        return np.zeros(batch.n_points)
    theta = state.values(batch.columns)
    batch.back_substitute(theta)
    rows = batch.ties.rows(batch.origin_l, len(batch.columns))
    through = rows.point @ np.swapaxes(inverse_factors(batch.normals), 1, 2)
    design = rows.design - through @ batch.coupling
    C = design @ state.covariance(batch.columns) @ np.swapaxes(design, 1, 2) + through @ np.swapaxes(through, 1, 2)
    v = rows.residual - rows.design @ theta - np.einsum("pij,pj->pi", rows.point, batch.points_l - batch.origin_l)
    left = np.eye(3) - C
    value = np.einsum("pi,pij,pj->p", v, np.linalg.pinv(left, rcond=1e-6, hermitian=True), v)
    return np.where(rows.active & (batch.normals.rank == 3), value, 0.0)


def drop_ties(batch: Batch, fails: NDArray[np.bool_]) -> list[str]:
    """Take the weight from ties; known coordinates that they stood for count themselves."""
    if batch.ties is None or not fails.any():
        return []
    batch.ties = replace(batch.ties, active=batch.ties.active & ~fails)
    weight = np.where(fails[:, None], batch.ties.control, batch.control.weight)
    batch.control = ControlWeights(weight, batch.control.xyz_l, int((weight > 0).sum()))
    batch.eliminate()
    return [batch.names[i] for i in np.flatnonzero(fails)]
