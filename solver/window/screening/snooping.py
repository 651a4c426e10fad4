"""Data snooping in the window: the tests of the batch adjustment on batches that are new or due, and taking back.

What was left out is tested as a prediction from all others, and is taken back once if it agrees after all.
"""

from __future__ import annotations

import numpy as np

from ...adjustment.snooping import TOGETHER, failing_w, largest_of_group
from ...arrays import Array, Bools, IntArray
from ...quantiles import chi2
from ..block.block import Block
from ..datum.control import ControlTests
from ..results import TAKEN_BACK, Refusal, Update
from ..state.batch import Batch
from ..state.network import LiveNetwork
from ..state.unknowns import WindowState
from .entry import DECISIVE, SUSPECTED, EntryEquations, entry_weight
from .ties import contradicting, set_apart

#: Rounds of one update, which bounds its time; what still fails then comes up again when the batch is due.
ROUNDS_OF_UPDATE = 8
#: Probability that a good point of which nothing was left stays out when it is tested again.
RETURNING = 0.01
#: Variance of the prediction of a ray, in units of the ray's own, up to which a gross error of it would show. Tuned.
SHARP = 30.0


class _Tested:
    """A batch of p points and n rays with its statistics at the present solution.

    Attributes
    ----------
    used : (n,) rays with weight
    w, joint : (n,) larger |w| and joint test value of the rays, 0 at points without a place
    failing : (n,) see `failing_w`
    spread : (n,) larger variance of a predicted ray, in units of its own
    control_w : largest |w| of the control coordinates
    disputed : (n,) rays of known points where it is the known coordinates that they contradict, see `_disputed`
    """

    def __init__(self, batch: Batch, state: WindowState, critical: float, wider: float = 1.0) -> None:
        cofactors, statistics = batch.judge(state)
        placed = batch.normals.rank[batch.rays.point] == 3
        self.batch, self.used = batch, batch.weight > 0
        self.w, self.joint = np.where(placed, statistics.largest_w, 0.0), np.where(placed, statistics.joint, 0.0)
        self.failing = failing_w(self.w, self.joint, critical)
        self.spread = np.einsum("naa->na", cofactors.observed).max(axis=1)
        control = batch.control.normalised(batch.points_l, cofactors.points)
        self.control_w = float(np.abs(control).max(initial=0.0))
        known = np.any(batch.control.weight > 0, axis=1)[batch.rays.point]
        suspect = bool((self.used & known & (self.failing > critical)).any())
        self.disputed = _disputed(batch, state, wider) if suspect else np.zeros(len(known), dtype=bool)

    def bad(self, least: float) -> IntArray:
        """Rays to leave out: the worst of each point that fails by more than this.

        All other rays of the point go with it where leaving out one of these instead would explain the data as well:
        the joint value is what the cost loses when a ray goes. Where it does not tell the rays apart, whichever is kept
        would be trusted by chance.
        """
        point, joint = self.batch.rays.point, self.joint
        out = np.flatnonzero(self.used & (self.failing > least) & ~self.disputed)
        if not len(out):
            return out
        out = out[largest_of_group(point[out], joint[out])]
        best = np.full(self.batch.n_points, np.inf)
        best[point[out]] = joint[out]
        rival = self.used & (joint > best[point] - DECISIVE)
        rival[out] = False
        return np.union1d(out, np.flatnonzero(np.isin(point, point[rival]) & self.used))

    def agreeing(self, critical: float, network: LiveNetwork) -> IntArray:
        """Rays left out that agree with the others now, one of a point, each only once.

        The others are those of the point. At known coordinates they may be those of the whole window, where these
        predict the ray sharply enough, and agree decisively better with this one than with any other left out there.
        """
        batch, points = self.batch, network.intake.points
        if self.used.all():
            return np.empty(0, dtype=np.int64)
        value = np.where(self.used, np.inf, self.joint)
        best = np.minimum.reduceat(value, batch.first_ray[:-1])[batch.rays.point]
        second = np.minimum.reduceat(np.where(value > best, value, np.inf), batch.first_ray[:-1])[batch.rays.point]
        sharp = (self.spread < SHARP) & (value == best) & (second > best + DECISIVE)
        known = np.all(batch.control.weight > 0, axis=1)[batch.rays.point]
        placed = batch.normals.rank[batch.rays.point] == 3
        company = (batch.points_left >= 2)[batch.rays.point]
        back = np.flatnonzero(~self.used & (self.failing <= critical) & placed & (company | (known & sharp)))
        returned = [points[batch.names[p]].returned for p in batch.rays.point[back]]
        first_time = [s not in r for s, r in zip(batch.rays.source[back].tolist(), returned, strict=True)]
        back = back[np.array(first_time, dtype=bool)]
        return back[largest_of_group(batch.rays.point[back], -self.joint[back])]


def _disputed(batch: Batch, state: WindowState, wider: float) -> Bools:
    """Rays (n,) of known points that have three looks or more which agree with each other: what they contradict are
    the known coordinates or the trajectory. Those are weighed as a whole (`datum.control`, `sigma_check`)."""
    point, theta = batch.rays.point, state.values(batch.columns)
    residual = batch.lin.residual.T - batch.full_rows @ (theta - batch.theta)
    derivative = batch.lin.point.transpose(2, 0, 1)
    out = np.zeros(len(point), dtype=bool)
    for p in np.flatnonzero((batch.control.weight > 0).any(axis=1) & (batch.points_left >= 3)):
        mine = np.flatnonzero((point == p) & (batch.weight > 0))
        J, e = derivative[mine].reshape(-1, 3), residual[mine].ravel()
        rest = e - J @ np.linalg.lstsq(J, e)[0]
        out[mine] = rest @ rest < wider**2 * chi2.isf(SUSPECTED, len(e) - 3)
    return out


def snoop(batches: list[Batch], network: LiveNetwork, control: ControlTests, block: Block, update: Update) -> int:
    """Leave out looks and control coordinates that fail; take back looks that agree with the rest after all. Number of
    solutions computed.

    A look goes if it fails (`failing_w`); of several at one point the one with the largest joint value. Looks left out
    come back once, when their prediction does not fail. Points of which nothing was left are judged again as on entry
    when their batch is tested again. Where a control coordinate fails more than any look, all control is weighed first.

    Parameters
    ----------
    batches : to be tested; those that change go through further rounds
    control : weighs all control
    block : keeps known coordinates of points that are final
    """
    state, solutions = network.state, 0
    critical = control.critical * network.sigmas.disagreement
    for batch in batches:
        if batch.tested >= 0 and _try_again(batch, network, update):
            solutions = 1
        batch.tested = update.number
    if solutions:
        state.solve()
    pending, weighed = batches, False
    for _ in range(ROUNDS_OF_UPDATE):
        state.expect([batch.columns for batch in pending])
        tested = [_Tested(batch, state, critical, network.sigmas.disagreement) for batch in pending]
        worst = max((float(t.w[t.used].max(initial=0.0)) for t in tested), default=0.0)
        if max((t.control_w for t in tested), default=0.0) > max(critical, worst) and not weighed:
            changed, of_final = control.weigh(update)
            block.reweigh_control(of_final)
            weighed = not changed
            if not weighed:
                solutions += 1
                continue
        changed, pending = False, []
        for t in tested:
            batch, before = t.batch, t.batch.weight
            out = t.bad(max(critical, TOGETHER * worst))
            back = out[:0] if len(out) else t.agreeing(critical, network)
            if (t.failing[t.used] > critical).any() or len(back):
                pending.append(batch)
            if len(out) or len(back):
                weight = before.copy()
                weight[out], weight[back] = 0.0, 1.0
                network.batches.reweigh(batch, weight)
                update.refused += _note(batch, network, before, t.w)
                changed = True
        if not changed:
            break
        state.solve()
        solutions += 1
    return solutions


def admit(batch: Batch, equations: EntryEquations, network: LiveNetwork) -> list[Refusal]:
    """Set the weights with which the rays of a batch enter that is not in the state; returns the looks left out."""
    before = batch.weight
    weight, w = entry_weight(batch, equations, wider=network.sigmas.disagreement)
    if (weight == before).all():
        return []
    batch.weight = weight
    batch.eliminate()
    return _note(batch, network, before, w)


def reweigh(batches: list[Batch], weights: list[Array], network: LiveNetwork) -> list[Refusal]:
    """Give the rays of batches in the state other weights (see `consensus`); returns what changed.

    What was left out because others were wrong may be taken back once more.
    """
    before = [batch.weight for batch in batches]
    for batch, weight in zip(batches, weights, strict=True):
        network.batches.reweigh(batch, weight)
    network.state.solve()
    changes = []
    for batch, old in zip(batches, before, strict=True):
        changes += _note(batch, network, old, batch.judge(network.state)[1].largest_w)
        for name in batch.names:
            network.intake.points[name].returned.clear()
    return changes


def _try_again(batch: Batch, network: LiveNetwork, update: Update) -> bool:
    """Let points in that were left out as a whole if the orientation as known now agrees with them.

    Looks that agree with each other, but not with what earlier strips say of their point, come without that; a single
    one stays out.
    """
    state, point = network.state, batch.rays.point
    lost = batch.points_left == 0
    if not lost.any():
        return False
    again, w = entry_weight(batch, EntryEquations.of(batch, state), RETURNING, network.sigmas.disagreement)
    before, information, counted = batch.weight, batch.information, batch.counts
    batch.weight = np.where(lost[point], again, before)
    if not (batch.weight > before).any():
        batch.weight = before
        return False
    if batch.ties is not None and (batch.ties.active & lost).any():
        batch.eliminate()
        wrong, several = contradicting(batch, state, which=lost), batch.points_left >= 2
        set_apart(batch, wrong & several, network, update)
        batch.weight = np.where((wrong & ~several)[point], 0.0, batch.weight)
    update.refused += _note(batch, network, before, w)
    batch.eliminate()
    if not (batch.weight > before).any():  # nothing of these points is in the state
        batch.information, batch.counts = information, counted
        return False
    network.batches.exchange(batch, information, counted)
    return True


def _note(batch: Batch, network: LiveNetwork, before: Array, w: Array) -> list[Refusal]:
    """Keep with the points, which outlive the batch, what has changed in its weights; returns what is to be told."""
    refused = []
    out, back = (before > 0) & (batch.weight == 0), (before == 0) & (batch.weight > 0)
    for ray in [*np.flatnonzero(out), *np.flatnonzero(back)]:
        name, source = batch.names[batch.rays.point[ray]], int(batch.rays.source[ray])
        point = network.intake.points[name]
        point.weight[source] = float(back[ray])
        if back[ray]:
            point.returned.add(source)
        if (source in point.reported) == back[ray]:
            (point.reported.discard if back[ray] else point.reported.add)(source)
            reason = TAKEN_BACK if back[ray] else "snooping"
            refused.append(Refusal(name, point.looks[source], reason, float(w[ray])))
    return refused
