"""Data snooping in the window: the tests of the batch adjustment, on batches that are new or due; rehabilitation."""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

from .reliability import normalised_residuals
from .snooping import TOGETHER, joint_limit
from .window_batch import Batch
from .window_points import PointLooks
from .window_results import Refusal
from .window_state import WindowState

Array = NDArray[np.floating]
IntArray = NDArray[np.int64]

#: Rounds of one update; what still fails then comes up again when the batch is due.
MOST_ROUNDS = 8
#: By how much the joint value of the worst ray of a point must exceed the next one's (chi-square, 0.1 %).
DECISIVE = 10.8


def snoop(
    batches: list[Batch], state: WindowState, points: dict[str, PointLooks], critical: float, serial: int
) -> tuple[list[Refusal], int]:
    """Leave out looks and control coordinates that fail; take back looks that agree with the rest after all.

    A look goes if one of its two w exceeds the critical value and the joint test fails too; of several at one point the
    one with the largest joint value. Looks left out come back once, when their prediction passes both tests; points of
    which nothing was left are tried once more as a whole when their batch is tested again.

    Parameters
    ----------
    batches : to be tested; those that change go through further rounds
    serial : number of the update, noted in the batches

    Returns
    -------
    refused : looks left out now
    rounds : solutions computed
    """
    limit = _joint_limit(critical)
    refused: list[Refusal] = []
    rounds = 0
    for batch in batches:
        if batch.tested >= 0 and _try_again(batch, state, points):
            rounds = 1
        batch.tested = serial
    if rounds:
        state.solve()
    pending = batches
    for _ in range(MOST_ROUNDS):
        judged = [(batch, *_judge(batch, state)) for batch in pending]
        worst = max((float(w[batch.weight > 0].max(initial=0.0)) for batch, w, _, _ in judged), default=0.0)
        worst = max([worst, *(float(c.max(initial=0.0)) for _, _, _, c in judged)])
        least = max(critical, TOGETHER * worst)
        changed, next_time = False, []
        for batch, w, joint, control_w in judged:
            out = np.flatnonzero((batch.weight > 0) & (joint > limit) & (w > least))
            out = _worst_of_point(batch.rays.point[out], joint[out], out)
            out = _with_rivals(batch, out, joint)
            fails = control_w > least
            back = (
                np.empty(0, dtype=np.int64)
                if len(out) or fails.any()
                else _agreeing(batch, points, w, joint, critical, limit)
            )
            if (w[(batch.weight > 0) & (joint > limit)] > critical).any() or (control_w > critical).any() or len(back):
                next_time.append(batch)
            if not (len(out) or len(back) or fails.any()):
                continue
            state.add(batch.columns, batch.information, -1)
            batch.weight[out], batch.weight[back] = 0.0, 1.0
            refused += _note(batch, points, out, back, w)
            if fails.any():
                _leave_out_control(batch, points, fails & (control_w == control_w.max()))
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


def _try_again(batch: Batch, state: WindowState, points: dict[str, PointLooks]) -> bool:
    """Give points that were rejected as a whole their weight back for one more test; whether there were any."""
    lost = np.bincount(batch.rays.point, batch.weight, batch.n_points) == 0
    lost &= np.array([not points[name].tried_again for name in batch.names])
    if not lost.any():
        return False
    for i in np.flatnonzero(lost):
        point = points[batch.names[i]]
        point.tried_again = True
        point.weight[:] = [1.0] * len(point.weight)
    state.add(batch.columns, batch.information, -1)
    batch.weight[lost[batch.rays.point]] = 1.0
    batch.eliminate()
    state.add(batch.columns, batch.information)
    return True


def _judge(batch: Batch, state: WindowState) -> tuple[Array, Array, Array]:
    """Larger |w| (n,), joint value (n,) of the rays, and |w| (p, 3) of control coordinates."""
    cofactors, statistics = batch.judge(state)
    weight = batch.control.weight
    v = -batch.control.residual(batch.points_l)
    q = 1.0 - weight * np.einsum("pii->pi", cofactors.points)
    control_w = np.where(weight > 0, np.abs(normalised_residuals(v, q)), 0.0)
    known = batch.normals.rank[batch.rays.point] == 3
    return np.where(known, statistics.largest_w, 0.0), np.where(known, statistics.joint, 0.0), control_w


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
    batch: Batch, points: dict[str, PointLooks], w: Array, joint: Array, critical: float, limit: float
) -> IntArray:
    """Rays left out that agree with the others now, one of a point, each only once."""
    out = np.flatnonzero((batch.weight == 0) & ((w <= critical) | (joint <= limit)))
    out = out[batch.normals.rank[batch.rays.point[out]] == 3]
    first_time = [batch.rays.source[r] not in points[batch.names[batch.rays.point[r]]].returned for r in out]
    out = out[np.array(first_time, dtype=bool)]
    return _worst_of_point(batch.rays.point[out], -joint[out], out)


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
    return refused


def _leave_out_control(batch: Batch, points: dict[str, PointLooks], fails: NDArray[np.bool_]) -> None:
    for p, axis in zip(*np.nonzero(fails), strict=True):
        points[batch.names[p]].out.add(int(axis))
    batch.leave_out_control(fails)
