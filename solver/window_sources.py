"""Slow blunders: a source of tie points, or a CCD line, whose measurements drift away from those of the others.

Each ray alone looks good; the mean of many does not. For every group of rays, those of one source on one CCD line, a
bias of its lines and samples is tested as an additional pair of unknowns would be, without estimating it: with the
effect ``B`` of the bias on the whitened residuals ``v``, the score ``s = sum B^T v`` has the cofactors
``V = B^T S B - B^T S A Q A^T S B`` (S projects out the object points), and ``s^T V^-1 s`` is chi-square of two
degrees of freedom if there is no bias. The group that fails most clearly is named, its effect on the scores of the
others taken off, and these are tested again.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from .window_batch import Batch, inverse_factors
from .window_state import WindowState

Array = NDArray[np.floating]
IntArray = NDArray[np.int64]
Group = tuple[str, str]

#: Probability that a good group is named in one test. Tests follow each other with most of their data in common, so
#: this is a false alarm in some hundred hours.
FALSE_ALARM = 1e-6
#: A bias below this, px, is none that matters.
MATTERS_PX = 0.08
#: Rays of a group needed for a test.
ENOUGH = 12
#: Age at which a batch is taken in, s: data snooping has had its say about it.
SETTLED_S = 1.5
#: Batches taken in at one update.
AT_ONCE = 2
#: Time between tests, s; how far back they look, s.
EVERY_S, MEMORY_S = 1.0, 20.0
#: Groups at most.
MOST_GROUPS = 24


@dataclass(frozen=True)
class BiasedSource:
    """A group whose measurements are biased.

    Attributes
    ----------
    source, ccd : publisher (may be empty) and CCD line
    line_px, sample_px : bias over the last while
    sigma_px : of the larger one
    test, limit : chi-square with two degrees of freedom, and what it should stay below
    since_s : time of the first alarm
    """

    source: str
    ccd: str
    line_px: float
    sample_px: float
    sigma_px: float
    test: float
    limit: float
    since_s: float

    def __str__(self) -> str:
        of = f" of source {self.source}" if self.source else ""
        return f"tie points{of} on CCD {self.ccd} drift: line {self.line_px:+.2f} px, sample {self.sample_px:+.2f} px"


@dataclass(frozen=True)
class _Cell:
    """Scores (2g,) at theta = 0, their normal matrix (2g, 2g) and coupling (2g, u) to unknowns, of one batch."""

    time_s: float
    groups: IntArray
    rays: IntArray
    score: Array
    normal: Array
    numbers: IntArray
    coupling: Array


class SourceMonitor:
    """Watches the groups."""

    def __init__(self, alpha: float = FALSE_ALARM) -> None:
        self._limit = float(chi2.isf(alpha, 2))
        self._groups: dict[Group, int] = {}
        self._cells: list[_Cell] = []
        self._taken: dict[int, Batch] = {}
        self._next_s = -np.inf
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
        settled = [b for b in batches if id(b) not in self._taken and b.newest_s < now_s - SETTLED_S]
        for batch in settled[:AT_ONCE]:
            self._taken[id(batch)] = batch
            cell = self._cell(batch, state, group_of(batch))
            if cell is not None:
                self._cells.append(cell)
        if now_s < self._next_s:
            return
        self._next_s = now_s + EVERY_S
        present = {id(b) for b in batches}
        self._taken = {key: b for key, b in self._taken.items() if key in present}
        self._cells = [c for c in self._cells if c.time_s > now_s - MEMORY_S and (state.places(c.numbers) >= 0).all()]
        self.biased = self._test(now_s, state)

    def _cell(self, batch: Batch, state: WindowState, groups: list[Group]) -> _Cell | None:
        for group in groups:
            if group not in self._groups and len(self._groups) < MOST_GROUPS:
                self._groups[group] = len(self._groups)
        numbers = np.array([self._groups.get(g, -1) for g in groups])
        use = np.flatnonzero((batch.weight > 0) & (batch.normals.rank[batch.rays.point] == 3) & (numbers >= 0))
        if not len(use):
            return None
        _, statistics = batch.judge(state)
        present, of_ray = np.unique(numbers[use], return_inverse=True)
        rays, lin, g = batch.rays, batch.lin, batch.whitening.g
        rates = np.concatenate([rays.velocity_l.T, rays.angle_rate.T])
        B = np.zeros((len(use), 2, 2))  # whitened, by one line and one sample
        B[:, :, 0] = -(np.einsum("ckn,kn->cn", lin.orientation, rates) * rays.line_period_s).T[use]
        pitch = rays.pitch_mm.T
        B[:, 0, 1] = (g[0] * pitch[0])[use]
        B[:, 1, 1] = (g[1] * pitch[0] + g[2] * pitch[1])[use]
        v = np.einsum("nij,nj->ni", B, statistics.v_px[use])
        point = rays.point[use]
        W = batch.lin.point.transpose(2, 0, 1)[use] @ np.swapaxes(inverse_factors(batch.normals), 1, 2)[point]
        k, u = len(present), len(batch.columns)
        score = np.zeros((k, 2))
        np.add.at(score, of_ray, np.einsum("nia,ni->na", B, v))
        rows = batch.full_rows(use) - W @ batch.coupling[point]
        coupling = np.zeros((k, 2, u))
        np.add.at(coupling, of_ray, np.einsum("nia,niu->nau", B, rows))
        normal = np.zeros((k, 2, k, 2))
        np.add.at(normal, (of_ray, slice(None), of_ray), np.einsum("nia,nib->nab", B, B))
        on_point = np.zeros((batch.n_points, k, 2, 3))
        np.add.at(on_point, (point, of_ray), np.einsum("nia,nik->nak", B, W))
        normal -= np.einsum("pgak,phbk->gahb", on_point, on_point)
        coupling = coupling.reshape(2 * k, u)
        theta = state.values(batch.columns)
        return _Cell(
            batch.newest_s, present, np.bincount(of_ray, minlength=k), score.ravel() + coupling @ theta,
            normal.reshape(2 * k, 2 * k), batch.columns, coupling,
        )  # fmt: skip

    def _test(self, now_s: float, state: WindowState) -> tuple[BiasedSource, ...]:
        m = len(self._groups)
        if not self._cells or not m:
            return ()
        score, normal, coupling = np.zeros(2 * m), np.zeros((2 * m, 2 * m)), np.zeros((2 * m, len(state)))
        count = np.zeros(m, dtype=np.int64)
        for cell in self._cells:
            at = (2 * cell.groups[:, None] + np.arange(2)).ravel()
            score[at] += cell.score
            normal[np.ix_(at, at)] += cell.normal
            coupling[np.ix_(at, state.places(cell.numbers))] += cell.coupling
            count[cell.groups] += cell.rays
        score -= coupling @ state.theta
        V = normal - coupling @ state.factor.solve(coupling.T)
        found = []
        open_ = [i for i in range(m) if count[i] >= ENOUGH]
        while open_:
            tests = {i: _test_of(score, V, i) for i in open_}
            worst = max(open_, key=lambda i: tests[i][0])
            test, bias, sigma = tests[worst]
            if test <= self._limit or float(np.abs(bias).max()) < MATTERS_PX:
                break
            open_.remove(worst)
            found.append((worst, test, bias, sigma))
            own = slice(2 * worst, 2 * worst + 2)
            gain = V[:, own] @ np.linalg.pinv(V[own, own], rcond=1e-9, hermitian=True)
            score = score - gain @ score[own]
            V = V - gain @ V[own, :]
        names = {i: group for group, i in self._groups.items()}
        self._since = {i: self._since.get(i, now_s) for i, *_ in found}
        return tuple(
            BiasedSource(*names[i], float(b[0]), float(b[1]), sigma, float(t), self._limit, self._since[i])
            for i, t, b, sigma in found
        )


def _test_of(score: Array, V: Array, i: int) -> tuple[float, Array, float]:
    """Test value of a group, its bias (2,) and the sigma of the larger one, px."""
    own = slice(2 * i, 2 * i + 2)
    block = V[own, own]
    if np.diagonal(block).min() <= 1e-9:
        return 0.0, np.zeros(2), 0.0
    Q = np.linalg.pinv(block, rcond=1e-6, hermitian=True)
    bias = Q @ score[own]
    return float(score[own] @ bias), bias, float(np.sqrt(Q[np.abs(bias).argmax(), np.abs(bias).argmax()]))
