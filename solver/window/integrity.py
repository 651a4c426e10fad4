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

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from heapq import nlargest
from itertools import chain

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular

from ..adjustment.reliability import CRITICAL_W, noncentrality
from .batch import Batch, Information, inverse_factors
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
#: Cofactors of residuals below this are those of a direction that nothing checks: along the base at two rays.
UNCHECKED = 1e-6
#: Control points are named together whose errors do as much, up to this share.
ALIKE = 0.6
AXES = "XYZ"


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
class _Exposed:
    """An observation: an image ray (place in its batch), or a control coordinate (ray -1).

    Attributes
    ----------
    rows : (k, u) with the points eliminated
    own : (k, k) cofactors of its residuals if the orientation were known
    inverse : (k, k) ``C^-1``
    leverage : lambda, as last computed; it can only become smaller
    """

    batch: Batch
    ray: int
    point: int
    axis: int
    rows: Array
    own: Array
    inverse: Array
    leverage: float

    @property
    def counts(self) -> bool:
        """Whether it has not been rejected since."""
        weight = self.batch.weight[self.ray] if self.ray >= 0 else self.batch.control.weight[self.point, self.axis]
        return bool(weight > 0)

    def renew(self, R: Array) -> None:
        """Figures for other cofactors (k, k) of its prediction."""
        C = self.own - R
        self.inverse = _inverse(C)
        self.leverage = float(_ratio(R, C))

    @property
    def control_point(self) -> str:
        """Name of the control point whose coordinate it is, "" for a ray."""
        return "" if self.ray >= 0 else self.batch.names[self.point]

    def told(self, delta: float) -> tuple[str, bool, float]:
        """It in words, whether it is a control coordinate, and its marginal detectable error if it is one, else 0."""
        name = self.batch.names[self.point]
        if self.ray >= 0:
            return f"ray of point {name}", False, 0.0
        detectable = delta * float(np.sqrt(self.inverse[0, 0] / self.batch.control.weight[self.point, self.axis]))
        return f"{AXES[self.axis]} of control point {name}", True, detectable


@dataclass
class _Departed:
    """An observation that has left the window: what is needed of `_Exposed`, without the batch."""

    rows: Array
    inverse: Array
    leverage: float
    control_point: str
    told_at_last: tuple[str, bool, float]

    def told(self, delta: float) -> tuple[str, bool, float]:
        """As `_Exposed.told` when it left."""
        return self.told_at_last


_Observation = _Exposed | _Departed


@dataclass
class _OfBatch:
    """The most exposed observations of a batch, the largest lambda of its others, and what they are for.

    Cofactors of residuals are a small difference of large figures, a thousandth of them where the datum rests on a
    control point. So rows of one linearisation do not go with the solution of another, and such figures are not renewed
    where the batch has been linearised or weighted anew since.
    """

    batch: Batch
    exposed: list[_Exposed]
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
        return max(map(_leverage, self.exposed), default=0.0)


class Integrity:
    """Keeps the most exposed observations of every batch, and what those that left did to the normal equations.

    Attributes
    ----------
    most_exposed : batch of the observation that the newest position was most exposed to
    """

    def __init__(self, critical: float) -> None:
        self._critical, self._delta = critical, noncentrality(critical)
        self._of_batch: dict[int, _OfBatch] = {}
        self._left = _Left()
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
                    _Departed(e.rows, e.inverse, e.leverage, e.control_point, e.told(self._delta)) for e in counting
                ]
                self._left.add(departed, batch.columns, known.rest, batch.newest_s, state)
        self._left.forget(before_s)

    def marginalised(self, marginal: Marginal) -> None:
        """Unknowns have left the window."""
        self._left.marginalise(marginal)

    def drop(self, batch: Batch) -> None:
        """A batch is taken apart."""
        self._of_batch.pop(id(batch), None)

    def _look_at(self, batch: Batch) -> tuple[list[_Exposed], float]:
        """The most exposed observations, and the largest lambda of the others."""
        assert batch.judged is not None
        cofactors = batch.judged[1]
        L = inverse_factors(batch.normals)
        J = batch.lin.point.transpose(2, 0, 1)
        W = J @ np.swapaxes(L, 1, 2)[batch.rays.point]
        C = np.eye(2) - cofactors.observed
        R = cofactors.observed - W @ np.swapaxes(W, 1, 2)
        used = (batch.weight > 0) & (batch.normals.rank[batch.rays.point] == 3)
        of_rays = np.where(used, _largest_ratio(R, C), 0.0)
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
                chosen.append(_Exposed(batch, i, p, -1, rows, own, _inverse(C[i]), float(value[i])))
            else:
                p, a = divmod(i - n, 3)
                rows = -np.sqrt(weight[p, a]) * (L[p][:, a] @ batch.coupling[p])[None]
                inverse = np.array([[1.0 / max(1.0 - q[p, a], UNCHECKED)]])
                own = np.array([[1.0 - own_control[p, a]]])
                chosen.append(_Exposed(batch, -1, p, a, rows, own, inverse, float(value[i])))
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
        ranked = nlargest(OF_WINDOW + 1 + RENEWED, everyone, key=_leverage)
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
        ranked.sort(key=_leverage, reverse=True)
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
        observations: list[_Observation] = [*near, *self._left.exposed]
        worst: _Observation | None = None
        names: tuple[str, ...] = ()
        if observations:
            h = np.concatenate([*on_near, self._left.effects(Qg, state)])
            effect = self._delta * np.sqrt(_squares(observations, h))
            size = effect[:, 6:].max(axis=1) if k > 6 else np.linalg.norm(effect[:, :3], axis=1)
            if size.max() > float(bias[6:].max() if k > 6 else np.linalg.norm(bias[:3])):
                worst = observations[int(np.argmax(size))]
                names = _control_points([e for e, s in zip(observations, size, strict=True) if s > ALIKE * size.max()])
            bias = np.maximum(bias, effect.max(axis=0))
        if renew:
            self._left.thin(state)
            self.most_exposed = worst.batch if isinstance(worst, _Exposed) else None
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


class _Left:
    """Observations that left the window: how an error in each moves the right-hand side of what stayed.

    Attributes
    ----------
    exposed : the most exposed of them
    """

    def __init__(self) -> None:
        self._numbers: IntArray = np.empty(0, dtype=np.int64)
        self._rhs = np.empty((0, 0))
        self.exposed: list[_Departed] = []
        self._bounds: deque[tuple[float, float]] = deque()
        self._newest_s = -np.inf

    def add(self, exposed: list[_Departed], columns: IntArray, rest: float, time_s: float, state: WindowState) -> None:
        """Observations that leave, unknowns (u,) of their rows, and the largest lambda of the others of their batch."""
        new = np.setdiff1d(state.numbers, self._numbers)
        self._numbers = np.concatenate([self._numbers, new])
        width = sum(len(e.rows) for e in exposed)
        self._rhs = np.pad(self._rhs, ((0, len(new)), (0, width)))
        place = {int(n): i for i, n in enumerate(self._numbers)}
        column = self._rhs.shape[1] - width
        rows = [place[n] for n in columns.tolist()]
        for e in exposed:
            self._rhs[rows, column : column + len(e.rows)] = e.rows.T
            column += len(e.rows)
        self.exposed += exposed
        self._bounds.append((time_s, rest))
        self._newest_s = max(self._newest_s, time_s)

    def marginalise(self, marginal: Marginal) -> None:
        """Eliminate unknowns from the right-hand sides."""
        gone, stayed = np.isin(self._numbers, marginal.gone), np.isin(self._numbers, marginal.stayed)
        if gone.any():
            order = np.argsort(marginal.gone)
            first = np.zeros((len(marginal.gone), self._rhs.shape[1]))
            first[order[np.searchsorted(marginal.gone, self._numbers[gone], sorter=order)]] = self._rhs[gone]
            moved = marginal.R12.T @ solve_triangular(marginal.R11, first, trans=1, check_finite=False)
            rest = np.zeros((len(marginal.stayed), self._rhs.shape[1]))
            order = np.argsort(marginal.stayed)
            rest[order[np.searchsorted(marginal.stayed, self._numbers[stayed], sorter=order)]] = self._rhs[stayed]
            self._numbers, self._rhs = marginal.stayed.copy(), rest - moved

    def effects(self, Qg: Array, state: WindowState) -> Array:
        """How their rows, one below the other, move functions of the unknowns; Qg (n, 6)."""
        if not self.exposed:
            return np.empty((0, Qg.shape[1]))
        return self._rhs.T @ Qg[state.places(self._numbers)]

    def thin(self, state: WindowState) -> None:
        """Keep the most exposed; of the others the bound."""
        if len(self.exposed) <= 2 * OF_WINDOW:
            return
        place = state.places(self._numbers)
        G = np.zeros((len(state), self._rhs.shape[1]))
        G[place] = self._rhs
        R = self._rhs.T @ state.propagated(G)[place]
        pair = np.stack(_rows_of(self.exposed), axis=1)
        products = _inverses(self.exposed) @ R[pair[:, :, None], pair[:, None]]
        leverages = np.linalg.eigvals(products).real.max(axis=1)
        for e, leverage in zip(self.exposed, leverages.tolist(), strict=True):
            e.leverage = leverage
        order = np.argsort([-e.leverage for e in self.exposed])
        keep = np.sort(order[:OF_WINDOW])
        self._bounds.append((self._newest_s, self.exposed[order[OF_WINDOW]].leverage))
        kept = np.repeat(np.isin(np.arange(len(order)), keep), [len(e.rows) for e in self.exposed])
        columns = np.flatnonzero(kept)
        self._rhs, self.exposed = self._rhs[:, columns], [self.exposed[i] for i in keep]

    def bound(self) -> float:
        return max((value for _, value in self._bounds), default=0.0)

    def forget(self, before_s: float) -> None:
        while self._bounds and self._bounds[0][0] < before_s:
            self._bounds.popleft()


def _control_points(observations: list[_Observation]) -> tuple[str, ...]:
    """Names of the control points among observations."""
    return tuple(sorted({e.control_point for e in observations if e.control_point}))


def _leverage(e: _Observation) -> float:
    return e.leverage


def _rows_of(exposed: Sequence[_Observation]) -> tuple[IntArray, IntArray]:
    """First and last row (n,) of each where the rows of all stand one below the other."""
    widths = np.array([len(e.rows) for e in exposed], dtype=np.int64)
    ends = np.cumsum(widths)
    return ends - widths, ends - 1


def _inverses(exposed: Sequence[_Observation]) -> Array:
    """``C^-1`` (n, 2, 2) of each; of a control coordinate it stands first, and the rest is zero."""
    values = [(*e.inverse.ravel().tolist(), 0.0, 0.0, 0.0)[:4] for e in exposed]
    return np.array(values).reshape(-1, 2, 2)


def _squares(exposed: Sequence[_Observation], h: Array) -> Array:
    """``h^T C^-1 h`` (n, k) of each; the rows (m, k) of all stand one below the other."""
    first, last = _rows_of(exposed)
    a, b, c, d = _inverses(exposed).reshape(-1, 4).T[:, :, None]
    squares = a * h[first] ** 2 + (b + c) * h[first] * h[last] + d * h[last] ** 2
    return np.maximum(squares, 0.0)  # rounding


def _inverse(C: Array) -> Array:
    """Inverse (k, k) without the directions that nothing checks."""
    if len(C) == 2:  # the usual case, without an eigenvalue decomposition
        (a, b), (_, d) = C.tolist()
        det, trace = a * d - b * b, a + d
        if trace > 0 and det > 10 * UNCHECKED * trace:
            return np.array([[d / det, -b / det], [-b / det, a / det]])
    values, vectors = np.linalg.eigh(C)
    good = values > UNCHECKED
    return (vectors * np.where(good, 1.0 / np.where(good, values, 1.0), 0.0)) @ vectors.T


def _ratio(R: Array, C: Array) -> float:
    """Largest eigenvalue of ``C^-1 R`` (k, k)."""
    if len(C) == 1:
        return float(R[0, 0] / max(C[0, 0], UNCHECKED))
    (r, s), (_, t) = R.tolist()
    (a, b), (_, d) = C.tolist()
    a, d = a + UNCHECKED, d + UNCHECKED
    det = max(a * d - b * b, UNCHECKED**2)
    half = 0.5 * (d * r - 2.0 * b * s + a * t) / det
    return max(half + math.sqrt(max(half * half - (r * t - s * s) / det, 0.0)), 0.0)


def _largest_ratio(R: Array, C: Array) -> Array:
    """(n,) largest eigenvalue of ``C^-1 R`` of symmetric (n, 2, 2), without directions in which C is nothing."""
    a, b, d = C[:, 0, 0] + UNCHECKED, C[:, 0, 1], C[:, 1, 1] + UNCHECKED
    det = np.maximum(a * d - b * b, UNCHECKED**2)
    r, s, t = R[:, 0, 0], R[:, 0, 1], R[:, 1, 1]
    trace = (d * r - 2.0 * b * s + a * t) / det
    product = (r * t - s * s) / det
    half = 0.5 * trace
    return np.maximum(half + np.sqrt(np.maximum(half * half - product, 0.0)), 0.0)
