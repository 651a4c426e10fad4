"""Data snooping in the window: the tests of the batch adjustment, on batches that are new or due; rehabilitation."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numpy as np
from numpy.typing import NDArray

from ..adjustment.reliability import normalised_residuals
from ..adjustment.snooping import TOGETHER, joint_limit
from .batch import Batch
from .entry import DECISIVE, entry_weight
from .points import PointLooks
from .results import TAKEN_BACK, Refusal
from .state import WindowState
from .tie_snooping import contradicting, drop_ties

Array = NDArray[np.floating]
IntArray = NDArray[np.int64]

#: Rounds of one update; what still fails then comes up again when the batch is due.
MOST_ROUNDS = 8
#: Probability that a good point that was left out as a whole is left out once more.
RETURNING = 0.01
#: Variance of a predicted ray, in units of its own, up to which a gross error in it would show.
SHARP = 30.0


def snoop(
    batches: list[Batch],
    state: WindowState,
    points: dict[str, PointLooks],
    critical: float,
    serial: int,
    control: Callable[[list[Refusal]], bool],
    apart: Callable[[list[str]], None],
) -> tuple[list[Refusal], int]:
    """Leave out looks and control coordinates that fail; take back looks that agree with the rest after all.

    A look goes if one of its two w exceeds the critical value and the joint test fails too; of several at one point the
    one with the largest joint value. Looks left out come back once, when their prediction passes both tests; points of
    which nothing was left are judged again as at the door when their batch is tested again. Where a control coordinate
    fails more than any look, all control is weighed first.

    Parameters
    ----------
    batches : to be tested; those that change go through further rounds
    serial : number of the update, noted in the batches
    control : weighs all control, notes what it refuses, and says whether the state has changed
    apart : told the points that do not agree with earlier strips

    Returns
    -------
    refused : looks left out now, and those taken back
    rounds : solutions computed
    """
    limit = _joint_limit(critical)
    refused: list[Refusal] = []
    rounds = 0
    for batch in batches:
        if batch.tested >= 0 and _try_again(batch, state, points, refused, apart):
            rounds = 1
        batch.tested = serial
    if rounds:
        state.solve()
    pending = batches
    weighed = False
    for _ in range(MOST_ROUNDS):
        state.expect(sum(len(batch.columns) for batch in pending))
        judged = [(batch, *_judge(batch, state)) for batch in pending]
        worst = max((float(w[batch.weight > 0].max(initial=0.0)) for batch, w, *_ in judged), default=0.0)
        worst_control = max((float(c.max(initial=0.0)) for *_, c in judged), default=0.0)
        if worst_control > max(critical, worst) and not weighed:
            weighed = not control(refused)
            if not weighed:
                rounds += 1
                continue
        least = max(critical, TOGETHER * worst)
        changed, next_time = False, []
        for batch, w, joint, spread, _ in judged:
            out = np.flatnonzero((batch.weight > 0) & (joint > limit) & (w > least))
            out = _worst_of_point(batch.rays.point[out], joint[out], out)
            out = _with_rivals(batch, out, joint)
            back = out[:0] if len(out) else _agreeing(batch, points, w, joint, spread, critical, limit)
            if (w[(batch.weight > 0) & (joint > limit)] > critical).any() or len(back):
                next_time.append(batch)
            if not (len(out) or len(back)):
                continue
            state.add(batch.columns, batch.information, -1)
            batch.weight[out], batch.weight[back] = 0.0, 1.0
            refused += _note(batch, points, out, back, w)
            batch.eliminate()
            state.add(batch.columns, batch.information)
            changed = True
        if not changed:
            break
        state.solve()
        rounds += 1
        pending = next_time
    return refused, rounds


_joint_limit = cache(joint_limit)


def admit(batch: Batch, state: WindowState, points: dict[str, PointLooks]) -> list[Refusal]:
    """Set the weights with which the rays of a batch enter that is not in the state; returns the looks left out."""
    weight, w = entry_weight(batch, state)
    out, back = np.flatnonzero((batch.weight > 0) & (weight == 0)), np.flatnonzero((batch.weight == 0) & (weight > 0))
    if not len(out) and not len(back):
        return []
    batch.weight = weight
    refused = _note(batch, points, out, back, w)
    batch.eliminate()
    return refused


def reweigh(
    batches: list[Batch], weights: list[Array], state: WindowState, points: dict[str, PointLooks]
) -> list[Refusal]:
    """Give the rays of batches in the state other weights (see `settle`); returns what changed.

    Looks may be taken back once more, as they were judged by the fault of others.
    """
    changed = []
    for batch, weight in zip(batches, weights, strict=True):
        out = np.flatnonzero((batch.weight > 0) & (weight == 0))
        back = np.flatnonzero((batch.weight == 0) & (weight > 0))
        changed.append((batch, out, back))
        state.add(batch.columns, batch.information, -1)
        batch.weight = weight
        batch.eliminate()
        state.add(batch.columns, batch.information)
    state.solve()
    changes = []
    for batch, out, back in changed:
        changes += _note(batch, points, out, back, batch.judge(state)[1].largest_w)
        for name in batch.names:  # what was taken back may be taken back once more
            points[name].returned.clear()
    return changes


def _try_again(
    batch: Batch,
    state: WindowState,
    points: dict[str, PointLooks],
    changes: list[Refusal],
    apart: Callable[[list[str]], None],
) -> bool:
    """Let points in that were left out as a whole if the orientation as known now agrees with them.

    Looks that agree with each other, but not with what earlier strips say of their point, come without that; a single
    one stays out.
    """
    lost = np.bincount(batch.rays.point, batch.weight, batch.n_points) == 0
    if not lost.any():
        return False
    again, w = entry_weight(batch, state, RETURNING)
    before, information = batch.weight, batch.information
    weight = np.where(lost[batch.rays.point], again, before)
    if not (weight > before).any():
        return False
    batch.weight = weight
    if batch.ties is not None and (batch.ties.active & lost).any():
        batch.eliminate()
        wrong = contradicting(batch, state, which=lost)
        several = np.bincount(batch.rays.point, weight > 0, batch.n_points) >= 2
        apart(drop_ties(batch, wrong & several))
        batch.weight = np.where((wrong & ~several)[batch.rays.point], 0.0, weight)
    back = np.flatnonzero((batch.weight > 0) & (before == 0))
    changes += _note(batch, points, back[:0], back, w)
    batch.eliminate()
    if not len(back):  # nothing of these points is in the state
        batch.information = information
        return False
    state.exchange(batch.columns, information, batch.information)
    return True


def _judge(batch: Batch, state: WindowState) -> tuple[Array, Array, Array, Array]:
    """Larger |w| (n,), joint value (n,), largest cofactor (n,) of the rays, and |w| (p, 3) of control coordinates."""
    cofactors, statistics = batch.judge(state)
    weight = batch.control.weight
    v = -batch.control.residual(batch.points_l)
    q = 1.0 - weight * np.einsum("pii->pi", cofactors.points)
    control_w = np.where(weight > 0, np.abs(normalised_residuals(v, q)), 0.0)
    known = batch.normals.rank[batch.rays.point] == 3
    spread = np.einsum("naa->na", cofactors.observed).max(axis=1)
    return np.where(known, statistics.largest_w, 0.0), np.where(known, statistics.joint, 0.0), spread, control_w


def _worst_of_point(point: IntArray, joint: Array, rays: IntArray) -> IntArray:
    order = np.lexsort((-joint, point))
    first = np.concatenate([[True], np.diff(point[order]) != 0]) if len(order) else np.empty(0, dtype=bool)
    return rays[order[first]]


def _with_rivals(batch: Batch, out: IntArray, joint: Array) -> IntArray:
    """The rays that go, and all others of a point where leaving out another ray would explain the data as well.

    The joint value is what the cost loses when a ray goes. Where it does not tell the rays of a point apart, whichever
    is kept would be trusted by chance.
    """
    if not len(out):
        return out
    best = np.full(batch.n_points, np.inf)
    best[batch.rays.point[out]] = joint[out]
    rival = (batch.weight > 0) & (joint > best[batch.rays.point] - DECISIVE)
    rival[out] = False
    lost = np.unique(batch.rays.point[rival])
    return np.union1d(out, np.flatnonzero(np.isin(batch.rays.point, lost) & (batch.weight > 0)))


def _agreeing(
    batch: Batch, points: dict[str, PointLooks], w: Array, joint: Array, spread: Array, critical: float, limit: float
) -> IntArray:
    """Rays left out that agree with the others now, one of a point, each only once.

    The others are those of the point. At known coordinates they may be those of the whole window, where these say
    sharply enough what the ray should be, and that it is this one of those left out.
    """
    out = np.flatnonzero((batch.weight == 0) & ((w <= critical) | (joint <= limit)))
    company = np.bincount(batch.rays.point, batch.weight > 0, batch.n_points) >= 2
    known = np.all(batch.control.weight > 0, axis=1)
    of_point = batch.rays.point[out]
    alone = known[of_point] & (spread[out] < SHARP) & _alone_in_agreeing(batch, joint)[out]
    out = out[(batch.normals.rank[of_point] == 3) & (company[of_point] | alone)]
    first_time = [batch.rays.source[r] not in points[batch.names[batch.rays.point[r]]].returned for r in out]
    out = out[np.array(first_time, dtype=bool)]
    return _worst_of_point(batch.rays.point[out], -joint[out], out)


def _alone_in_agreeing(batch: Batch, joint: Array) -> NDArray[np.bool_]:
    """Rays left out (n,) that agree decisively better than any other left out at their point."""
    value = np.where(batch.weight == 0, joint, np.inf)
    best = np.minimum.reduceat(value, batch.first_ray[:-1])[batch.rays.point]
    rest = np.where(value > best, value, np.inf)
    second = np.minimum.reduceat(rest, batch.first_ray[:-1])[batch.rays.point]
    return (value == best) & (second > best + DECISIVE)


def _note(batch: Batch, points: dict[str, PointLooks], out: IntArray, back: IntArray, w: Array) -> list[Refusal]:
    """Keep the decision with the points, which outlive the batch."""
    refused = []
    for ray in out:
        name, source = batch.names[batch.rays.point[ray]], int(batch.rays.source[ray])
        points[name].weight[source] = 0.0
        if source not in points[name].reported:
            points[name].reported.add(source)
            refused.append(Refusal(name, points[name].looks[source], "snooping", float(w[ray])))
    for ray in back:
        name, source = batch.names[batch.rays.point[ray]], int(batch.rays.source[ray])
        points[name].weight[source] = 1.0
        points[name].returned.add(source)
        if source in points[name].reported:
            points[name].reported.discard(source)
            refused.append(Refusal(name, points[name].looks[source], TAKEN_BACK, float(w[ray])))
    return refused
