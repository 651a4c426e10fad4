"""Integrity on line: how wrong the published orientation can be although no test has noticed anything.

Baarda's reliability theory: an observation hides a gross error up to its marginal detectable error; the most that such
an error moves a function ``g`` of the unknowns is ``delta_0 sqrt(h^T C^-1 h)`` with ``h = A_r Q g``, where ``A_r`` are
the rows of the observation with the object points eliminated and ``C`` the cofactors of its residuals. A larger error
is noticed more surely but not always, and where the network checks an observation badly it moves the result by far
more: the protection level is exceeded, with any one error, no more often than the stated risk
(`adjustment.protection`).

By Cauchy and Schwarz no function moves by more than ``delta_0 sqrt(lambda)`` of its sigmas, ``lambda`` the largest
eigenvalue of ``C^-1 A_r Q A_r^T``. So the effects of the few observations of largest lambda are computed exactly, and
the bound stands for all others, those that have left the window included: their lambda can only have become smaller.
One error is assumed at a time, in an image ray, in a coordinate of a control point, or in the height of the surface
that tie points lie on.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property
from heapq import nlargest

import numpy as np

from ...adjustment.protection import protection_factor
from ...adjustment.reliability import CRITICAL_W, noncentrality
from ...arrays import Array, IntArray
from ..results import RefinedOrientation
from ..state.batch import Batch, Information
from ..state.network import LiveNetwork
from ..state.unknowns import Border, Marginal, WindowState

#: Risk that a component of the orientation is further off than its protection level (statistical level).
RISK = 1e-3
#: Observations whose effects are computed exactly: of one batch, and of the window and again of those that left it
#: (tuned: more of them cost time, fewer leave a larger bound).
OF_BATCH, OF_WINDOW = 12, 24
#: Of a batch, observations of a smaller lambda are left to the bound (tuned): that is 0.4 delta_0 sigmas at most.
SMALL = 0.15
#: Observations whose lambda is computed anew in one update (tuned, for speed).
RENEWED = 4
#: From this lambda on, ``C`` is too small a difference of large figures to be taken between the present solution and
#: equations of an earlier linearisation (tuned).
CANCELS = 3.0
#: Cofactors of whitened residuals that are smaller count as this (rounding). Of two rays to a point, no other
#: observation checks the direction along the base; but the orientation does not depend on it either.
UNCHECKED = 1e-6
#: The observation that the shift of a surface is about zero, in words.
SURFACE = "height of the elevation model as a whole"
#: Control points are named together with the worst one if an error in them does this share of its effect (tuned).
ALIKE = 0.6


@dataclass
class Exposed:
    """An observation that an error in the orientation may come from: an image ray, or a coordinate of a control point.

    A control coordinate has a second row as a ray has, of zeros.

    Attributes
    ----------
    batch : it belongs to; None when that has left the window
    place : in the batch, of the ray or of the control point
    name, axis : of the point, and of the control coordinate; axis -1 for a ray
    sigma_m : a-priori sigma of the control coordinate; 0 for a ray
    columns, rows : numbers (u,) of unknowns and ``A_r`` (2, u), whitened, the point eliminated
    own : (2, 2) cofactors of its residuals if the orientation were known
    inverse : (2, 2) ``C^-1``
    leverage : lambda, as last computed; it can only become smaller
    """

    batch: Batch | None
    place: int
    name: str
    axis: int
    sigma_m: float
    columns: IntArray
    rows: Array
    own: Array
    inverse: Array
    leverage: float

    @property
    def counts(self) -> bool:
        """Whether it has not been rejected since; what left the window was not."""
        if self.batch is None:
            return True
        batch, place = self.batch, self.place
        return bool((batch.weight[place] if self.axis < 0 else batch.control.weight[place, self.axis]) > 0)

    @property
    def in_words(self) -> str:
        return f"ray of point {self.name}" if self.axis < 0 else f"{'XYZ'[self.axis]} of control point {self.name}"


def largest_ratios(R: Array, C: Array) -> Array:
    """(n,) largest eigenvalue of ``C^-1 R`` of symmetric (n, 2, 2), without directions in which C is zero."""
    a, b, d = C[:, 0, 0] + UNCHECKED, C[:, 0, 1], C[:, 1, 1] + UNCHECKED
    det = np.maximum(a * d - b * b, UNCHECKED**2)
    r, s, t = R[:, 0, 0], R[:, 0, 1], R[:, 1, 1]
    half = 0.5 * (d * r - 2.0 * b * s + a * t) / det
    return np.maximum(half + np.sqrt(np.maximum(half * half - (r * t - s * s) / det, 0.0)), 0.0)


def inverses_of(C: Array) -> Array:
    """Inverses of symmetric (n, 2, 2), no eigenvalue of which counts as less than `UNCHECKED`."""
    values, vectors = np.linalg.eigh(C)
    return (vectors / np.maximum(values, UNCHECKED)[:, None]) @ np.swapaxes(vectors, 1, 2)


@dataclass(frozen=True)
class Exposure:
    """What could be wrong unseen at one time, of the six components of the orientation and g functions on the ground.

    Attributes
    ----------
    bias : (6 + g,) largest effect of one undetected error, m and rad, and m on the ground (`ground`)
    sigma : (6 + g,) of the same, from the unknowns alone
    observation : the one that they are most exposed to, in words: the ground, or X, Y and Z where it is not known
    names : if that is a control coordinate, its point and other control points that they are about as exposed to
    detectable_m : if it is one, its marginal detectable error, else 0
    critical : value of the test that ought to notice
    """

    bias: Array
    sigma: Array
    observation: str
    names: tuple[str, ...] = ()
    detectable_m: float = 0.0
    critical: float = CRITICAL_W

    @cached_property
    def factor(self) -> Array:
        """(6 + g,) protection level over sigma."""
        outer = self.bias / (noncentrality(self.critical) * np.maximum(self.sigma, 1e-300))
        return protection_factor(outer, RISK, self.critical)

    def protected(self, orientation: RefinedOrientation) -> RefinedOrientation:
        """Orientation with its protection levels."""
        sigma = np.sqrt(np.einsum("nii->ni", orientation.covariance))
        return replace(orientation, protection=self.factor[:6] * sigma)


class LeftObservations:
    """Observations that left the window: how an error in each moves the right-hand side of what stayed.

    Attributes
    ----------
    exposed : the most exposed of them
    border : two columns of the normal equations for each of these
    """

    def __init__(self) -> None:
        self.border = Border()
        self.exposed: list[Exposed] = []
        self._bounds: deque[tuple[float, float]] = deque()

    def add(self, exposed: list[Exposed], rest: float, time_s: float) -> None:
        """Observations of one batch leave; ``rest`` is the largest lambda of its others, ``time_s`` its newest time."""
        if exposed:
            rows = np.concatenate([e.rows for e in exposed])
            self.border.add(len(self.border) + np.arange(len(rows)), exposed[0].columns, rows.T)
        self.exposed += [replace(e, batch=None) for e in exposed]
        self._bounds.append((time_s, rest))

    def restated(self, point: str) -> None:
        """Known coordinates of a point that left count no more."""
        keep = np.array([e.axis < 0 or e.name != point for e in self.exposed], dtype=bool)
        self.border.keep(np.repeat(keep, 2))
        self.exposed = [e for e, k in zip(self.exposed, keep, strict=True) if k]

    def thin(self, state: WindowState) -> None:
        """Keep the most exposed, and of the others the bound."""
        n, border = len(self.exposed), self.border
        if n <= 2 * OF_WINDOW:
            return
        place = state.places(border.numbers)
        G = np.zeros((len(state), len(border)))
        G[place] = border.G
        R = (border.G.T @ state.propagated(G)[place]).reshape(n, 2, n, 2)[np.arange(n), :, np.arange(n)]
        leverages = np.linalg.eigvals(np.array([e.inverse for e in self.exposed]) @ R).real.max(axis=1)
        order = np.argsort(-leverages)
        keep = np.sort(order[:OF_WINDOW])
        newest_s = max((time_s for time_s, _ in self._bounds), default=-np.inf)
        self._bounds.append((newest_s, float(leverages[order[OF_WINDOW]])))
        border.keep((2 * keep[:, None] + np.arange(2)).ravel())
        self.exposed = [replace(self.exposed[i], leverage=float(leverages[i])) for i in keep]

    def bound(self) -> float:
        """Largest lambda of all that are not among the most exposed."""
        return max((value for _, value in self._bounds), default=0.0)

    def forget(self, before_s: float) -> None:
        """Drop bounds of batches that left before a time."""
        while self._bounds and self._bounds[0][0] < before_s:
            self._bounds.popleft()


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
        """Whether the batch still has the same equations."""
        return self.batch.information is self.information

    @property
    def largest(self) -> float:
        """Largest lambda."""
        return max((e.leverage for e in self.exposed), default=0.0)


class Integrity:
    """Keeps the most exposed observations of every batch, and what those that left did to the normal equations.

    Attributes
    ----------
    most_exposed : batch of the observation that the newest position was most exposed to
    """

    def __init__(self, critical: float, network: LiveNetwork) -> None:
        self._network = network
        self._critical, self._delta = critical, noncentrality(critical)
        self._of_batch: dict[int, _OfBatch] = {}
        self._gone = 0  # batches when those taken apart were forgotten
        self._left = LeftObservations()
        self.most_exposed: Batch | None = None

    def note(self, batches: Iterable[Batch]) -> None:
        """Find the most exposed observations of batches that have been judged since; forget those taken apart."""
        if self._network.batches.gone > self._gone:
            self._gone = self._network.batches.gone
            for key in self._network.batches.missing(self._of_batch.keys()):
                del self._of_batch[key]
        for batch in batches:
            if batch.judged is None:
                continue
            known = self._of_batch.get(id(batch))
            if known is None or known.solution != batch.judged[0]:
                found = self._most_exposed_of(batch)
                self._of_batch[id(batch)] = _OfBatch(batch, *found, batch.judged[0], batch.information)

    def leave(self, batches: list[Batch], before_s: float) -> None:
        """Batches leave, judged before; bounds of those that left before a time are dropped."""
        self.note(batches)
        for batch in batches:
            known = self._of_batch.pop(id(batch), None)
            if known is not None:
                self._left.add([e for e in known.exposed if e.counts], known.rest, batch.newest_s)
        self._left.forget(before_s)

    def marginalised(self, marginal: Marginal) -> None:
        """Unknowns have left the window."""
        self._left.border.marginalise(marginal)

    def restated(self, point: str) -> None:
        """Known coordinates of a point are stated anew: no error is in those that left."""
        self._left.restated(point)

    def _most_exposed_of(self, batch: Batch) -> tuple[list[Exposed], float]:
        """The most exposed observations, and the largest lambda of the others."""
        assert batch.judged is not None
        cofactors, rays, weight = batch.judged[1], batch.rays, batch.control.weight
        L, n = batch.inverse_factors, len(rays)
        W, rows_of_rays = batch.without_points
        point, axis = np.nonzero(weight > 0)
        through_point = (weight * np.einsum("pia,pia->pa", L, L))[point, axis]
        adjusted = (weight * np.einsum("pii->pi", cofactors.points))[point, axis]
        own = np.concatenate([np.eye(2) - W @ np.swapaxes(W, 1, 2), _with_second(1.0 - through_point)])
        C = np.concatenate([np.eye(2) - cofactors.observed, _with_second(1.0 - adjusted)])
        leverages = largest_ratios(own - C, C)
        leverages[:n][(batch.weight == 0) | (batch.normals.rank[rays.point] < 3)] = 0.0
        order = np.argsort(-leverages)
        chosen = order[: max(1, int((leverages[order[:OF_BATCH]] > SMALL).sum()))]
        found = []
        for i, inverse in zip(chosen.tolist(), inverses_of(C[chosen]), strict=True):
            if i < n:
                place, p, a, sigma_m = i, int(rays.point[i]), -1, 0.0
                rows = rows_of_rays[i]
            else:
                place = p = int(point[i - n])
                a = int(axis[i - n])
                sigma_m = float(weight[p, a] ** -0.5)
                rows = np.outer([-1.0 / sigma_m, 0.0], L[p][:, a] @ batch.coupling[p])
            name, leverage = batch.names[p], float(leverages[i])
            found.append(Exposed(batch, place, name, a, sigma_m, batch.columns, rows, own[i], inverse, leverage))
        return found, float(leverages[order[len(chosen)]]) if len(order) > len(chosen) else 0.0

    def at(self, numbers: IntArray, design: Array, state: WindowState, renew: bool = False) -> Exposure:
        """Exposure of the orientation at one time.

        Parameters
        ----------
        numbers, design : (u,), (6 + g, u) unknowns of the window it depends on, and how; from the seventh on, functions
            on the ground: then these say which observation it is most exposed to
        state : solved
        renew : compute anew lambda of some of the observations that seem most exposed
        """
        ranked = self._renewed(state) if renew else self._ranked(OF_WINDOW + 1)
        k = len(design)
        G = np.zeros((len(state), k))
        G[state.places(numbers)] = design.T
        Qg = state.propagated(G)
        sigma = np.sqrt(np.maximum(np.einsum("uk,uk->k", G, Qg), 0.0))
        rest = [*(b.rest for b in self._of_batch.values()), *(e.leverage for e in ranked[OF_WINDOW:])]
        bound = self._delta * np.sqrt(max([self._left.bound(), *rest])) * sigma
        observations = [e for e in ranked[:OF_WINDOW] if e.counts]
        h = [e.rows @ Qg[state.places(e.columns)] for e in observations]
        observations += self._left.exposed
        border = self._left.border
        h = np.concatenate([*h, border.G.T @ Qg[state.places(border.numbers)]]).reshape(-1, 2, k)
        inverse = np.array([e.inverse for e in observations]).reshape(-1, 2, 2)
        squares = np.maximum(np.einsum("nik,nij,njk->nk", h, inverse, h), 0.0)  # rounding
        shifted = self._network.surface.hidden(Qg, self._delta)
        effect = np.vstack([bound, self._delta * np.sqrt(squares), shifted])
        size = effect[:, 6:].max(axis=1) if k > 6 else np.linalg.norm(effect[:, :3], axis=1)
        of_surface = bool(size.argmax() > len(observations))
        worst = observations[size.argmax() - 1] if size.argmax() and not of_surface else None
        if renew:
            self._left.thin(state)
            self.most_exposed = worst.batch if worst is not None else None
        bias = effect.max(axis=0)
        if worst is None:
            return Exposure(bias, sigma, SURFACE if of_surface else "", critical=self._critical)
        alike = [e for e, s in zip(observations, size[1:], strict=False) if s > ALIKE * size.max()]
        names = sorted({e.name for e in alike if e.axis >= 0}) if worst.axis >= 0 else []
        detectable_m = self._delta * worst.sigma_m * float(worst.inverse[0, 0]) ** 0.5
        return Exposure(bias, sigma, worst.in_words, tuple(names), detectable_m, self._critical)

    def _ranked(self, most: int) -> list[Exposed]:
        """The most exposed observations in the window, largest lambda first."""
        everyone = (e for b in self._of_batch.values() for e in b.exposed)
        return nlargest(most, everyone, key=lambda e: e.leverage)

    def _renewed(self, state: WindowState) -> list[Exposed]:
        """As `_ranked`, some lambdas computed anew: those of the largest, and of the batch with the largest bound."""
        changed = [b for b in self._of_batch.values() if not b.current and b.largest > CANCELS]
        if changed:
            self._judge(max(changed, key=lambda b: b.largest).batch, state)
        # where all that are renewed fall behind, as many others come up
        ranked = self._ranked(OF_WINDOW + 1 + RENEWED)
        again = [e for e in ranked if e.leverage < CANCELS or self._of_batch[id(e.batch)].current][:RENEWED]
        if again:
            G = np.zeros((len(state), 2 * len(again)))
            for i, e in enumerate(again):
                G[state.places(e.columns), 2 * i : 2 * i + 2] = e.rows.T
            QG = state.propagated(G)
            R = np.array([e.rows @ QG[state.places(e.columns), 2 * i : 2 * i + 2] for i, e in enumerate(again)])
            C = np.array([e.own for e in again]) - R
            for e, inverse, leverage in zip(again, inverses_of(C), largest_ratios(R, C), strict=True):
                e.inverse, e.leverage = inverse, float(leverage)
            ranked.sort(key=lambda e: e.leverage, reverse=True)
        if ranked:
            loosest = max(self._of_batch.values(), key=lambda b: b.rest)
            if loosest.rest > ranked[min(OF_WINDOW, len(ranked) - 1)].leverage:
                self._judge(loosest.batch, state)
        return ranked

    def _judge(self, batch: Batch, state: WindowState) -> None:
        batch.judge(state)
        self.note([batch])


def _with_second(first: Array) -> Array:
    """Cofactors (n, 2, 2) of residuals: (n,) of the first coordinate, and a second one that depends on nothing."""
    C = np.zeros((len(first), 2, 2))
    C[:, 0, 0], C[:, 1, 1] = first, 1.0
    return C
