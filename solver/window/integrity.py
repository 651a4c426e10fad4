"""Live integrity: how wrong the published orientation can be without anything having been noticed.

Baarda's reliability theory: an observation hides a gross error up to its marginal detectable error; the most that such
an error moves a function ``g`` of the unknowns is ``delta_0 sqrt(h^T C^-1 h)`` with ``h = A_r Q g``, where ``A_r`` are
the rows of the observation with the points eliminated and ``C`` the cofactors of its residuals. A larger error is
noticed more surely but not always, and where the network checks an observation badly it moves the result by far more:
the protection level is exceeded, with any one error, no more often than the stated risk (`protection`). By Cauchy and
Schwarz no function moves by more than ``delta_0 sqrt(lambda)`` of its sigmas, ``lambda`` the largest eigenvalue of
``C^-1 A_r Q A_r^T``. So the few observations of largest lambda are looked at exactly, and the bound stands for all
others, those that have left the window included: their lambda can only have become smaller. One error is thought of at
a time, in an image ray or a control coordinate.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from heapq import nlargest
from itertools import chain

import numpy as np
from numpy.typing import NDArray

from ..adjustment.reliability import CRITICAL_W, noncentrality
from .batch import Batch, Information, inverse_factors
from .exposed_observations import (
    UNCHECKED,
    Departed,
    Departures,
    Exposed,
    Observation,
    control_points,
    inverse_of,
    largest_ratios,
    leverage_of,
    squares_of,
)
from .protection import protection_factor
from .state import Marginal, WindowState

Array = NDArray[np.floating]
IntArray = NDArray[np.int64]

#: Risk that a component of the orientation is further off than its protection level.
RISK = 1e-3
#: Observations of a batch, and of the window, that are looked at exactly, if their lambda is not small.
OF_BATCH, OF_WINDOW, SMALL = 12, 24, 0.15
#: Observations whose lambda is computed anew in one update.
RENEWED = 4
#: From this lambda on cofactors of residuals are a difference too small to be taken between old equations and new ones.
CANCELS = 3.0
#: Control points are named together whose errors do as much, up to this share.
ALIKE = 0.6


@dataclass(frozen=True)
class Exposure:
    """What could be wrong unseen, at one time.

    Attributes
    ----------
    bias : (6,) largest effect of one undetected error on the orientation, m and rad
    sigma : (6,) of the orientation, from the unknowns alone
    observation : the one that X, Y and Z are most exposed to, in words
    control : whether that is a control coordinate
    detectable_m : its marginal detectable error if it is one, else 0
    critical : of the test that ought to notice
    names : the control points that it is about as exposed to, if it is most exposed to one
    ground_bias, ground_sigma : (g,) the same on the ground, m, see `ground`; none where it was not asked for
    """

    bias: Array
    sigma: Array
    observation: str
    control: bool
    detectable_m: float
    critical: float = CRITICAL_W
    names: tuple[str, ...] = ()
    ground_bias: Array = field(default_factory=lambda: np.empty(0))
    ground_sigma: Array = field(default_factory=lambda: np.empty(0))

    def protection(self, sigma: Array, risk: float = RISK) -> Array:
        """Protection levels (n, 6) where the orientation has standard deviations (n, 6)."""
        return self._factor(self.bias, self.sigma, risk) * sigma

    def ground_protection(self, sigma: Array, risk: float = RISK) -> Array:
        """Protection levels (..., g) on the ground where its functions have standard deviations (..., g)."""
        return self._factor(self.ground_bias, self.ground_sigma, risk) * sigma

    def _factor(self, bias: Array, sigma: Array, risk: float) -> Array:
        outer = bias / (noncentrality(self.critical) * np.maximum(sigma, 1e-300))
        return protection_factor(outer, risk, self.critical)


@dataclass
class _OfBatch:
    """The most exposed observations of a batch, the largest lambda of its others, and what they are for.

    Cofactors of residuals are a small difference of large figures, a thousandth of them where the datum rests on a
    control point. So rows of one linearisation do not go with the solution of another, and such figures are not renewed
    where the batch has been linearised or weighted anew since.
    """

    batch: Batch
    exposed: list[Exposed]
    rest: float
    solution: int
    information: Information

    @property
    def current(self) -> bool:
        """Whether the batch has the same equations still."""
        return self.batch.information is self.information

    @property
    def largest(self) -> float:
        """Largest lambda."""
        return max(map(leverage_of, self.exposed), default=0.0)


class Integrity:
    """Keeps the most exposed observations of every batch, and what those that left did to the normal equations.

    Attributes
    ----------
    most_exposed : batch of the observation that the newest position was most exposed to
    """

    def __init__(self, critical: float) -> None:
        self._critical, self._delta = critical, noncentrality(critical)
        self._of_batch: dict[int, _OfBatch] = {}
        self._left = Departures()
        self.most_exposed: Batch | None = None

    def note(self, batches: list[Batch]) -> None:
        """Look at batches that have been judged since."""
        for batch in batches:
            if batch.judged is None:
                continue
            known = self._of_batch.get(id(batch))
            if known is None or known.solution != batch.judged[0]:
                found = self._look_at(batch)
                self._of_batch[id(batch)] = _OfBatch(batch, *found, batch.judged[0], batch.information)

    def leave(self, batches: list[Batch], state: WindowState, before_s: float) -> None:
        """Batches leave that have been noted; what left before a time is forgotten where only a bound is known."""
        for batch in batches:
            known = self._of_batch.pop(id(batch), None)
            if known is not None:
                counting = [e for e in known.exposed if e.counts]
                departed = [
                    Departed(e.rows, e.inverse, e.leverage, e.control_point, e.told(self._delta)) for e in counting
                ]
                self._left.add(departed, batch.columns, known.rest, batch.newest_s, state)
        self._left.forget(before_s)

    def marginalised(self, marginal: Marginal) -> None:
        """Unknowns have left the window."""
        self._left.marginalise(marginal)

    def drop(self, batch: Batch) -> None:
        """A batch is taken apart."""
        self._of_batch.pop(id(batch), None)

    def _look_at(self, batch: Batch) -> tuple[list[Exposed], float]:
        """The most exposed observations, and the largest lambda of the others."""
        assert batch.judged is not None
        cofactors = batch.judged[1]
        L = inverse_factors(batch.normals)
        J = batch.lin.point.transpose(2, 0, 1)
        W = J @ np.swapaxes(L, 1, 2)[batch.rays.point]
        C = np.eye(2) - cofactors.observed
        R = cofactors.observed - W @ np.swapaxes(W, 1, 2)
        used = (batch.weight > 0) & (batch.normals.rank[batch.rays.point] == 3)
        of_rays = np.where(used, largest_ratios(R, C), 0.0)
        weight = batch.control.weight
        q = weight * np.einsum("pii->pi", cofactors.points)
        own_control = weight * np.einsum("pia,pia->pa", L, L)
        of_control = np.where(weight > 0, np.maximum(q - own_control, 0.0) / np.maximum(1.0 - q, UNCHECKED), 0.0)
        value = np.concatenate([of_rays, of_control.ravel()])
        n = len(of_rays)
        order = np.argsort(-value)[: OF_BATCH + 1]
        chosen = []
        for i in order[:OF_BATCH].tolist():
            if value[i] <= SMALL and len(chosen):
                break
            if i < n:
                p = int(batch.rays.point[i])
                rows = batch.full_rows(np.array([i]))[0] - W[i] @ batch.coupling[p]
                own = np.eye(2) - W[i] @ W[i].T
                chosen.append(Exposed(batch, i, p, -1, rows, own, inverse_of(C[i]), float(value[i])))
            else:
                p, a = divmod(i - n, 3)
                rows = -np.sqrt(weight[p, a]) * (L[p][:, a] @ batch.coupling[p])[None]
                inverse = np.array([[1.0 / max(1.0 - q[p, a], UNCHECKED)]])
                own = np.array([[1.0 - own_control[p, a]]])
                chosen.append(Exposed(batch, -1, p, a, rows, own, inverse, float(value[i])))
        return chosen, float(value[order[len(chosen)]]) if len(order) > len(chosen) else 0.0

    def at(self, numbers: IntArray, design: Array, state: WindowState, renew: bool = False) -> Exposure:
        """Exposure of the orientation at one time.

        Parameters
        ----------
        numbers, design : (u,), (6 + g, u) unknowns of the window it depends on, and how; from the seventh on, functions
            on the ground: then these say which observation it is most exposed to
        state : solved
        renew : look again at some of the observations that seem most exposed
        """
        if renew:
            self._judge_changed(state)
        everyone = chain.from_iterable(b.exposed for b in self._of_batch.values())
        # of those that are renewed none can come behind so many others and still count
        ranked = nlargest(OF_WINDOW + 1 + RENEWED, everyone, key=leverage_of)
        again = [e for e in ranked if e.leverage < CANCELS or self._of_batch[id(e.batch)].current][:RENEWED]
        again = again if renew else []
        widths = [len(e.rows) for e in again]
        k = len(design)
        G = np.zeros((len(state), k + sum(widths)))
        G[state.places(numbers), :k] = design.T
        ends = k + np.cumsum(widths, dtype=np.int64)
        for e, width, end in zip(again, widths, ends, strict=True):
            G[state.places(e.batch.columns), end - width : end] = e.rows.T
        S = state.propagated(G)
        for e, width, end in zip(again, widths, ends, strict=True):
            e.renew(e.rows @ S[state.places(e.batch.columns), end - width : end])
        Qg = S[:, :k]
        sigma = np.sqrt(np.maximum(np.einsum("uk,uk->k", G[:, :k], Qg), 0.0))
        ranked.sort(key=leverage_of, reverse=True)
        if renew and self._of_batch:  # the one whose bound is the largest is judged anew
            loosest = max(self._of_batch.values(), key=lambda b: b.rest)
            if loosest.exposed and loosest.rest > ranked[min(OF_WINDOW, len(ranked) - 1)].leverage:
                loosest.batch.judge(state)
                self.note([loosest.batch])
        rest = max((b.rest for b in self._of_batch.values()), default=0.0)
        rest = max([rest, self._left.bound(), *(e.leverage for e in ranked[OF_WINDOW:][:1])])
        bias = self._delta * np.sqrt(rest) * sigma
        near = [e for e in ranked[:OF_WINDOW] if e.counts]
        on_near = [e.rows @ Qg[state.places(e.batch.columns)] for e in near]
        observations: list[Observation] = [*near, *self._left.exposed]
        worst: Observation | None = None
        names: tuple[str, ...] = ()
        if observations:
            h = np.concatenate([*on_near, self._left.effects(Qg, state)])
            effect = self._delta * np.sqrt(squares_of(observations, h))
            size = effect[:, 6:].max(axis=1) if k > 6 else np.linalg.norm(effect[:, :3], axis=1)
            if size.max() > float(bias[6:].max() if k > 6 else np.linalg.norm(bias[:3])):
                worst = observations[int(np.argmax(size))]
                names = control_points([e for e, s in zip(observations, size, strict=True) if s > ALIKE * size.max()])
            bias = np.maximum(bias, effect.max(axis=0))
        if renew:
            self._left.thin(state)
            self.most_exposed = worst.batch if isinstance(worst, Exposed) else None
        said = ("", False, 0.0) if worst is None else worst.told(self._delta)
        return Exposure(
            bias[:6], sigma[:6], *said, self._critical, names if said[1] else (), bias[6:].copy(), sigma[6:].copy()
        )

    def _judge_changed(self, state: WindowState) -> None:
        """Look again at the most exposed of the batches that have been linearised or weighted anew."""
        changed = [b for b in self._of_batch.values() if not b.current and b.largest > CANCELS]
        if changed:
            batch = max(changed, key=lambda b: b.largest).batch
            batch.judge(state)
            self.note([batch])
