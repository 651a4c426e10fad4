"""Slow blunders: a source of tie points, or a CCD line, whose measurements drift away from those of the others.

Each ray alone looks good; the mean of many does not. For every group of rays, those of one source on one CCD line, a
bias and a drift of its lines and samples are tested as additional unknowns ``b`` would be, without estimating them:
they are a border of the window's normal equations. With the effect ``B`` of ``b`` on the whitened residuals ``v``, and
S that projects out the object points, the border has ``s = sum B^T S (v + A theta)``, ``M = sum B^T S A`` and
``sum B^T S B``; when unknowns leave the window they are eliminated from it as from the rest, so nothing is forgotten
while a strip lasts. Its Schur complement ``V`` is the cofactor matrix of the scores at the solution, and
``s^T V^-1 s`` is chi-square if there is no bias. The group that fails most clearly is named, its effect on the scores
of the others taken off, and these are tested again. A bias that a slow error of the trajectory would explain as well
has no score: what remains unseen does no more harm than that error.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular
from scipy.stats import chi2

from .batch import Batch, Information, inverse_factors
from .entry import DECISIVE
from .state import Marginal, WindowState

Array = NDArray[np.floating]
IntArray = NDArray[np.int64]
Group = tuple[str, str]

#: Probability that a good group is named in one test. Tests follow each other with most of their data in common, so
#: this is a false alarm in some hundred hours.
FALSE_ALARM = 1e-6
#: A bias below this, px, is none that matters; one known no better than this, px, tells nothing.
MATTERS_PX, TELLING_PX = 0.08, 0.3
#: Rays of a group needed for a test.
ENOUGH = 12
#: Age at which a batch is taken in, s: data snooping has had its say about it.
SETTLED_S = 3.0
#: Batches taken in at one update.
AT_ONCE = 2
#: Time between tests, s; unit of the drift, s.
EVERY_S, DRIFT_S = 1.0, 10.0
#: Groups at most; unknowns of each.
MOST_GROUPS, EACH = 16, 4


@dataclass(frozen=True)
class BiasedSource:
    """A group whose measurements are biased.

    Attributes
    ----------
    source, ccd : publisher (may be empty) and CCD line
    line_px, sample_px : bias now
    line_px_s, sample_px_s : its drift
    test, limit : chi-square, and what it should stay below
    since_s : time of the first alarm
    rivals : CCD lines (and sources) whose bias would explain the same about as well: on one of them it is
    """

    source: str
    ccd: str
    line_px: float
    sample_px: float
    line_px_s: float
    sample_px_s: float
    test: float
    limit: float
    since_s: float
    rivals: tuple[Group, ...] = ()

    def __str__(self) -> str:
        of = f" of source {self.source}" if self.source else ""
        bias = f"line {self.line_px:+.2f} px, sample {self.sample_px:+.2f} px"
        rivals = [
            ccd if source == self.source else f"{ccd} of {source or 'another source'}" for source, ccd in self.rivals
        ]
        return f"tie points{of} on CCD {self.ccd} drift: {bias}" + (f" (or {' or '.join(rivals)})" if rivals else "")


@dataclass(frozen=True)
class _Cell:
    """Border of one batch: scores (k,) at theta = 0, their normal matrix (k, k) and coupling (k, u) to unknowns.

    Attributes
    ----------
    information : what the batch was when this was computed
    places : (k,) in the border
    groups, rays : which groups have how many rays
    """

    information: Information
    places: IntArray
    groups: IntArray
    rays: IntArray
    score: Array
    normal: Array
    numbers: IntArray
    coupling: Array


class SourceMonitor:
    """Watches the groups of the strip that is flown."""

    def __init__(self, alpha: float = FALSE_ALARM) -> None:
        self._alpha = alpha
        self._strip = -1
        self._next_s = -np.inf
        self._restart(0.0)

    def _restart(self, now_s: float) -> None:
        n = MOST_GROUPS * EACH
        self._start_s = now_s
        self._groups: dict[Group, int] = {}
        self._cells: dict[int, tuple[Batch, _Cell]] = {}
        self._score, self._normal = np.zeros(n), np.zeros((n, n))
        self._numbers: IntArray = np.empty(0, dtype=np.int64)
        self._coupling = np.zeros((n, 0))
        self._rays = np.zeros(MOST_GROUPS, dtype=np.int64)
        self._since: dict[int, float] = {}
        self.biased: tuple[BiasedSource, ...] = ()

    def update(
        self, now_s: float, batches: list[Batch], state: WindowState, group_of: Callable[[Batch], list[Group]]
    ) -> None:
        """Take in what has settled, and test when it is time.

        Parameters
        ----------
        batches : of the window
        state : solved
        group_of : source and CCD line of each ray of a batch
        """
        newest = max(reversed(batches), key=_last_strip, default=None)
        if newest is not None and newest.strips[-1] > self._strip:
            self._strip = newest.strips[-1]
            self._restart(newest.oldest_s)
        mine = [b for b in batches if b.strips[-1] == self._strip and b.newest_s < now_s - SETTLED_S]
        new = [b for b in mine if id(b) not in self._cells or self._cells[id(b)][1].information is not b.information]
        for batch in new[:AT_ONCE]:
            self._take(batch, state, group_of)
        if now_s >= self._next_s:
            self._next_s = now_s + EVERY_S
            present = {id(b) for b in batches}
            self._cells = {key: value for key, value in self._cells.items() if key in present}
            self.biased = self._test(now_s, state)

    def leave(self, batches: list[Batch], state: WindowState, group_of: Callable[[Batch], list[Group]]) -> None:
        """Batches leave the window; call before they are fixed."""
        for batch in batches:
            if batch.strips[-1] != self._strip:
                continue
            known = self._cells.pop(id(batch), None)
            if known is None or known[1].information is not batch.information:
                self._take(batch, state, group_of)
                known = self._cells.pop(id(batch), None)
            if known is None:
                continue
            cell = known[1]
            self._score[cell.places] += cell.score
            self._normal[np.ix_(cell.places, cell.places)] += cell.normal
            self._rays[cell.groups] += cell.rays
            new = np.setdiff1d(cell.numbers, self._numbers)
            self._numbers = np.concatenate([self._numbers, new])
            self._coupling = np.pad(self._coupling, ((0, 0), (0, len(new))))
            self._coupling[np.ix_(cell.places, place_of(self._numbers, cell.numbers))] += cell.coupling

    def marginalised(self, marginal: Marginal) -> None:
        """Unknowns have left the window."""
        gone = np.isin(marginal.gone, self._numbers)
        if not gone.any():
            return
        first = np.zeros((len(self._score), len(marginal.gone)))
        first[:, gone] = self._coupling[:, place_of(self._numbers, marginal.gone[gone])]
        stayed = np.isin(marginal.stayed, self._numbers)
        rest = np.zeros((len(self._score), len(marginal.stayed)))
        rest[:, stayed] = self._coupling[:, place_of(self._numbers, marginal.stayed[stayed])]
        T = solve_triangular(marginal.R11, first.T, trans=1, check_finite=False).T
        self._score = self._score - T @ marginal.d1
        self._normal = self._normal - T @ T.T
        self._numbers, self._coupling = marginal.stayed.copy(), rest - T @ marginal.R12

    def _take(self, batch: Batch, state: WindowState, group_of: Callable[[Batch], list[Group]]) -> None:
        cell = self._cell(batch, state, group_of(batch))
        if cell is not None:
            self._cells[id(batch)] = batch, cell

    def _cell(self, batch: Batch, state: WindowState, groups: list[Group]) -> _Cell | None:
        for group in groups:
            if group not in self._groups and len(self._groups) < MOST_GROUPS:
                self._groups[group] = len(self._groups)
        numbers = np.array([self._groups.get(g, -1) for g in groups])
        use = np.flatnonzero((batch.weight > 0) & (batch.normals.rank[batch.rays.point] == 3) & (numbers >= 0))
        if not len(use):
            return None
        v_px = batch.residuals_px(state)
        present, of_ray = np.unique(numbers[use], return_inverse=True)
        rays, lin, g = batch.rays, batch.lin, batch.whitening.g
        rates = np.concatenate([rays.velocity_l.T, rays.angle_rate.T])
        B = np.zeros((len(use), 2, 2, 2))  # whitened; a line and a sample, constant and drifting
        B[:, :, 0, 0] = -(np.einsum("ckn,kn->cn", lin.orientation, rates) * rays.line_period_s).T[use]
        pitch = rays.pitch_mm.T
        B[:, 0, 0, 1] = (g[0] * pitch[0])[use]
        B[:, 1, 0, 1] = (g[1] * pitch[0] + g[2] * pitch[1])[use]
        v = np.einsum("nij,nj->ni", B[:, :, 0], v_px[use])
        B[:, :, 1] = B[:, :, 0] * ((rays.time_s[use] - self._start_s) / DRIFT_S)[:, None, None]
        B = B.reshape(-1, 2, EACH)
        point = rays.point[use]
        W = batch.lin.point.transpose(2, 0, 1)[use] @ np.swapaxes(inverse_factors(batch.normals), 1, 2)[point]
        rows = batch.full_rows(use) - W @ batch.coupling[point]
        k, n = len(present), len(use)
        full = np.zeros((n, 2, k, EACH))
        full[np.arange(n), :, of_ray] = B
        flat = full.reshape(2 * n, k * EACH)
        begins = np.flatnonzero(np.diff(point, prepend=-1))  # rays are sorted by point
        on_point = np.add.reduceat(np.swapaxes(full.reshape(n, 2, -1), 1, 2) @ W, begins, axis=0)
        on_points = np.swapaxes(on_point, 0, 1).reshape(k * EACH, -1)
        normal = flat.T @ flat - on_points @ on_points.T
        coupling = flat.T @ rows.reshape(2 * n, -1)
        score = flat.T @ v.ravel() + coupling @ state.values(batch.columns)
        places = (EACH * present[:, None] + np.arange(EACH)).ravel()
        count = np.bincount(of_ray, minlength=k)
        return _Cell(batch.information, places, present, count, score, normal, batch.columns, coupling)

    def _test(self, now_s: float, state: WindowState) -> tuple[BiasedSource, ...]:
        m = len(self._groups)
        n = EACH * m
        score, normal, count = self._score[:n].copy(), self._normal[:n, :n].copy(), self._rays[:m].copy()
        coupling = np.zeros((n, len(state)))
        coupling[:, state.places(self._numbers)] = self._coupling[:n]
        for _, cell in self._cells.values():
            score[cell.places] += cell.score
            normal[np.ix_(cell.places, cell.places)] += cell.normal
            coupling[np.ix_(cell.places, state.places(cell.numbers))] += cell.coupling
            count[cell.groups] += cell.rays
        score -= coupling @ state.theta
        V = normal - coupling @ state.propagated(coupling.T)
        found = []
        age = (now_s - self._start_s) / DRIFT_S
        now = np.array([[1.0, 0.0, age, 0.0], [0.0, 1.0, 0.0, age]])
        # scores of a constant and of what grows to one pixel by now: of one size
        scale = np.array([1.0, 1.0, max(age, 0.1), max(age, 0.1)])
        open_ = [i for i in range(m) if count[i] >= ENOUGH]
        while open_:
            tests = {i: _test_of(score, V, i, scale, self._alpha) for i in open_}
            worst = max(open_, key=lambda i: tests[i][0] / tests[i][1])
            test, limit, bias, gain = tests[worst]
            if test <= limit or float(np.abs(now @ bias).max()) < MATTERS_PX:
                break
            open_.remove(worst)
            rivals = [i for i in open_ if tests[i][0] - tests[i][1] > test - limit - DECISIVE]
            found.append((worst, now @ bias, bias[2:] / DRIFT_S, test, limit, rivals))
            own = slice(EACH * worst, EACH * (worst + 1))
            cross = V[:, own] @ gain
            score = score - cross @ score[own]
            V = V - cross @ V[own, :]
        names = {i: group for group, i in self._groups.items()}
        self._since = {i: self._since.get(i, now_s) for i, *_ in found}
        result = []
        for i, bias, drift, test, limit, rivals in found:
            (line, sample), (line_s, sample_s) = bias.tolist(), drift.tolist()
            others = tuple(names[r] for r in rivals)
            result.append(BiasedSource(*names[i], line, sample, line_s, sample_s, test, limit, self._since[i], others))
        return tuple(result)


def _test_of(score: Array, V: Array, i: int, scale: Array, alpha: float) -> tuple[float, float, Array, Array]:
    """Test value of a group, its limit, its bias (4,), and its cofactors (4, 4); of what is known well enough."""
    own = slice(EACH * i, EACH * (i + 1))
    values, vectors = np.linalg.eigh(V[own, own] / scale[:, None] / scale)
    good = values > TELLING_PX**-2
    vectors = vectors[:, good] / scale[:, None]
    Q = (vectors / values[good]) @ vectors.T
    bias = Q @ score[own]
    limit = float(chi2.isf(alpha, max(int(good.sum()), 1)))
    return float(score[own] @ bias), limit, bias, Q


def _last_strip(batch: Batch) -> int:
    return batch.strips[-1]


def place_of(numbers: IntArray, wanted: IntArray) -> IntArray:
    """Places of numbers among others that hold them all."""
    order = np.argsort(numbers)
    return order[np.searchsorted(numbers, wanted, sorter=order)]
