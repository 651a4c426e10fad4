"""Slow blunders: a source of tie points, or a CCD line, whose measurements drift away from those of the others.

Each ray alone looks good; the mean of many does not. For every group of rays, those of one source on one CCD line, a
bias and a drift of its lines and samples are tested as additional unknowns ``b`` would be, without estimating them:
they are a border of the window's normal equations. With the effect ``B`` of ``b`` on the whitened residuals ``v``, and
S that projects out the object points, the border has ``s = sum B^T S (v + A theta)``, ``M = sum B^T S A`` and
``sum B^T S B``; when unknowns leave the window they are eliminated from it as from the rest, so nothing is forgotten
while a strip lasts. Its Schur complement ``V`` is the cofactor matrix of the scores at the solution, and
``s^T V^-1 s`` is chi-square if there is no bias. A bias that a slow error of the trajectory would explain as well
has no score: what remains unseen does no more harm than that error.

The solution is one of just the batches that are in the border: with others in it, a drift that bends the orientation
through them, too, would be looked for in part of its rays only, and be taken for another. Which group it is, or which
ones cannot be told apart, see `suspects`.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular

from ..adjustment.reduced_system import DenseFactor
from .archive import MOST_OF_STRIP
from .batch import Batch, Information, inverse_factors
from .compensation import Border, Compensation, estimated
from .state import Marginal, WindowState
from .suspects import ALL, EACH, FALSE_ALARM, USUAL_PX, BiasedSource, Group, Scores, Suspicion, hypotheses

Array = NDArray[np.floating]
IntArray = NDArray[np.int64]
#: Age at which a batch is taken in, s: data snooping has had its say about it.
SETTLED_S = 3.0
#: Rays of batches taken in at one update, about.
AT_ONCE = 240
#: Time between tests, s; unit of the drift, s.
EVERY_S, DRIFT_S = 1.0, 10.0
#: Groups at most; strips whose drifts are remembered.
MOST_GROUPS, MOST_BORDERS = 16, 40


@dataclass(frozen=True)
class _Cell:
    """Border of one batch: scores (k,) at theta = 0, their normal matrix (k, k) and coupling (k, u) to unknowns.

    Attributes
    ----------
    information, weight : what the batch was when this was computed
    places : (k,) in the border
    groups, rays : which groups have how many rays
    shared : share of the variance of a ray that is noise of its position, summed over the rays
    """

    information: Information
    weight: Array
    places: IntArray
    groups: IntArray
    rays: IntArray
    shared: float
    score: Array
    normal: Array
    numbers: IntArray
    coupling: Array


class SourceMonitor:
    """Watches the groups of the strip that is flown.

    Parameters
    ----------
    noise_time_s : says for how long the noise of measured positions is correlated
    alpha : probability that a good group fails in one test
    """

    def __init__(self, noise_time_s: Callable[[], float], alpha: float = FALSE_ALARM) -> None:
        self._noise_time_s, self._alpha = noise_time_s, alpha
        self._strip = -1
        self._next_s = -np.inf
        self._borders: deque[Border] = deque(maxlen=MOST_BORDERS)
        self._restart(0.0)

    def _restart(self, now_s: float) -> None:
        n = MOST_GROUPS * EACH
        self._start_s = self._tested_s = now_s
        self._groups: dict[Group, int] = {}
        self._cells: dict[int, tuple[Batch, _Cell]] = {}
        self._score, self._normal = np.zeros(n), np.zeros((n, n))
        self._numbers: IntArray = np.empty(0, dtype=np.int64)
        self._coupling = np.zeros((n, 0))
        self._rays = np.zeros(MOST_GROUPS, dtype=np.int64)
        self._shared = 0.0
        self._suspicion = Suspicion(self._alpha)
        self._whole = _WholeStrip()
        self._drift: tuple[IntArray, Array, Array] | None = None
        self.biased: tuple[BiasedSource, ...] = ()

    def forget(self, now_s: float) -> None:
        """What has left the window is known otherwise than it was: begin anew."""
        self._restart(now_s)

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
            self._borders += self._of_whole_strip()
            self._restart(newest.oldest_s)
        mine = [b for b in batches if b.strips[-1] == self._strip]
        # once there is an alarm its effect is taken back, in what has just come, too
        settled_s = SETTLED_S if not self.biased else 0.0
        self._take_some([b for b in mine if b.newest_s <= now_s - settled_s], state, group_of)
        if now_s >= self._next_s:
            self._next_s = now_s + EVERY_S
            self._test(now_s, mine, state)

    def _take_some(self, batches: list[Batch], state: WindowState, group_of: Callable[[Batch], list[Group]]) -> None:
        """Take in new batches, then those that have changed, as many as one update can bear."""
        known = [self._cells.get(id(b)) for b in batches]
        new = [b for b, k in zip(batches, known, strict=True) if k is None]
        if self.biased:
            for batch in new:
                self._take(batch, state, group_of)
            new = []
        new += [b for b, k in zip(batches, known, strict=True) if k and k[1].information is not b.information]
        rays = 0
        for batch in new:
            if rays > AT_ONCE:
                break
            self._take(batch, state, group_of)
            rays += len(batch.rays)

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
            self._shared += cell.shared
            self._whole.add(cell)
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
        return _Cell(
            batch.information, batch.weight.copy(), places, present, count, _shared(batch, use), score, normal,
            batch.columns, coupling,
        )  # fmt: skip

    def _test(self, now_s: float, batches: list[Batch], state: WindowState) -> None:
        """Test with what is in the border, of all batches of the strip."""
        self._tested_s = now_s
        cells = self._in_border(batches)
        scores, count = self._scores(now_s, batches, cells, state)
        found = hypotheses(list(self._groups), count.tolist())
        factor = self._factor(now_s, int(count.sum()), self._shared + sum(c.shared for c in cells.values()))
        self.biased = self._suspicion.judge(now_s, scores, found, factor) if found else ()
        self._drift = None
        if self.biased:
            rows = self._suspected()
            estimate = estimated(scores.score[rows], scores.V[np.ix_(rows, rows)], self._beforehand(rows))
            self._drift = (rows, *estimate)

    def _factor(self, now_s: float, rays: int, shared: float) -> float:
        """By how much the variance of scores is larger than stated, where rays are dense.

        Rays of one CCD line within the correlation time of the measured positions have their noise in common, which
        the adjustment takes for white: the design effect of clusters of m rays with a correlation rho of their errors,
        1 + (m - 1) rho. Without what corrections follow of that noise it is less; this is on the safe side.

        Source: L. Kish, Survey Sampling, 1965, section 5.4.
        """
        if not rays:
            return 1.0
        lines = len({ccd for _, ccd in self._groups})
        m = rays / lines / max(now_s - self._start_s, 1.0) * self._noise_time_s()
        return 1.0 + max(m - 1.0, 0.0) * shared / rays

    def _in_border(self, batches: list[Batch]) -> dict[int, _Cell]:
        """Of the batches, those that have been taken in and have lost no ray since."""
        present = {id(b): b for b in batches}
        self._cells = {key: kept for key, kept in self._cells.items() if key in present}
        return {k: c for k, (b, c) in self._cells.items() if np.array_equal(c.weight, b.weight)}

    def _assembled(self, cells: dict[int, _Cell], state: WindowState) -> tuple[Array, Array, Array, IntArray]:
        """Scores (n,) at theta = 0, normal matrix (n, n), coupling to all unknowns of the state, rays of the groups."""
        m = len(self._groups)
        n = EACH * m
        score, normal, count = self._score[:n].copy(), self._normal[:n, :n].copy(), self._rays[:m].copy()
        coupling = np.zeros((n, len(state)))
        coupling[:, state.places(self._numbers)] = self._coupling[:n]
        for cell in cells.values():
            score[cell.places] += cell.score
            normal[np.ix_(cell.places, cell.places)] += cell.normal
            coupling[np.ix_(cell.places, state.places(cell.numbers))] += cell.coupling
            count[cell.groups] += cell.rays
        return score, normal, coupling, count

    # -- what it does to the solution ----------------------------------------------------------------------------------

    def compensation(self, batches: Iterable[Batch], state: WindowState) -> Compensation | None:
        """What has been named does to the solution of the window; None if nothing has.

        The drift is as estimated at the last test, from a solution of just the data that are in the border.
        """
        if self._drift is None:
            return None
        mine = [b for b in batches if b.strips[-1] == self._strip]
        _, _, coupling, _ = self._assembled(self._in_border(mine), state)
        rows, drift, covariance = self._drift
        return Compensation(state.propagated(coupling[rows].T), drift, covariance)

    def borders(self) -> list[Border]:
        """Of the strips so far in which something was named when they were over, all of their unknowns in them."""
        return [*self._borders, *self._of_whole_strip()]

    def _of_whole_strip(self) -> list[Border]:
        if not self.biased:
            return []
        rows = self._suspected()
        score, normal, numbers, coupling = self._whole.assembled(rows)
        return [Border(score, normal, numbers, coupling, self._beforehand(rows))]

    def _suspected(self) -> IntArray:
        """Unknowns of all groups that may drift."""
        names = [name for s in self.biased for name in s.suspects]
        of = [i for g, i in self._groups.items() if any(n[0] in (ALL, g[0]) and n[1] in (ALL, g[1]) for n in names)]
        return (EACH * np.array(of)[:, None] + np.arange(EACH)).ravel()

    def _beforehand(self, rows: IntArray) -> Array:
        """Sigma of these unknowns: what was named may be as large as that, the others as well."""
        size = max(USUAL_PX, *(max(abs(s.line_px), abs(s.sample_px)) for s in self.biased))
        age = max((self._tested_s - self._start_s) / DRIFT_S, 0.1)
        return np.where(rows % EACH < EACH // 2, size, size / age)

    # -- the test ------------------------------------------------------------------------------------------------------

    def _scores(
        self, now_s: float, batches: list[Batch], cells: dict[int, _Cell], state: WindowState
    ) -> tuple[Scores, IntArray]:
        """Scores of the groups at the solution of the same data, and rays of the groups."""
        score, normal, coupling, count = self._assembled(cells, state)
        N, rhs = state.normal()
        differences: dict[bytes, tuple[IntArray, Array, Array]] = {}  # batches of one segment have the same unknowns
        for batch in batches:
            cell = cells.get(id(batch))
            if cell is not None and cell.information is batch.information:
                continue
            key = batch.columns.tobytes()
            if key not in differences:
                n = len(batch.columns)
                differences[key] = batch.columns, np.zeros((n, n)), np.zeros(n)
            _, matrix, right = differences[key]
            matrix -= batch.information.matrix
            right -= batch.information.rhs
            if cell is not None:
                matrix += cell.information.matrix
                right += cell.information.rhs
        for columns, matrix, right in differences.values():
            place = state.places(columns)
            N[np.ix_(place, place)] += matrix
            rhs[place] += right
        solved = DenseFactor(N).solve(np.column_stack([rhs, coupling.T]))
        score -= coupling @ solved[:, 0]
        V = normal - coupling @ solved[:, 1:]
        return Scores(score, 0.5 * (V + V.T), (now_s - self._start_s) / DRIFT_S, DRIFT_S), count


class _WholeStrip:
    """Border of all batches of a strip that have left, with all its unknowns, unless it is too long for a block."""

    def __init__(self) -> None:
        n = MOST_GROUPS * EACH
        self._score, self._normal = np.zeros(n), np.zeros((n, n))
        self._coupling: dict[int, dict[int, Array]] = {}  # by group, then by unknown
        self._too_long = False

    def add(self, cell: _Cell) -> None:
        """A batch has left."""
        self._score[cell.places] += cell.score
        self._normal[np.ix_(cell.places, cell.places)] += cell.normal
        if self._too_long:
            return
        parts = cell.coupling.reshape(len(cell.groups), EACH, -1)
        for group, part in zip(cell.groups.tolist(), parts, strict=True):
            known = self._coupling.setdefault(group, {})
            for number, column in zip(cell.numbers.tolist(), part.T, strict=True):
                known[number] = known[number] + column if number in known else column
            if len(known) > MOST_OF_STRIP:
                self._too_long, self._coupling = True, {}
                return

    def assembled(self, rows: IntArray) -> tuple[Array, Array, IntArray, Array]:
        """Scores, normal matrix, numbers (u,) and coupling of some of the border's unknowns, whole groups."""
        of = [self._coupling.get(group, {}) for group in (rows[::EACH] // EACH).tolist()]
        numbers = np.array(sorted({number for columns in of for number in columns}), dtype=np.int64)
        coupling = np.zeros((len(of), EACH, len(numbers)))
        for i, columns in enumerate(of):
            if not columns:
                continue
            at = np.searchsorted(numbers, list(columns))
            coupling[i][:, at] = np.array(list(columns.values())).reshape(-1, EACH).T
        return self._score[rows], self._normal[np.ix_(rows, rows)], numbers, coupling.reshape(len(rows), -1)


def _shared(batch: Batch, which: IntArray) -> float:
    """Share of the variance of rays that is noise of the measured position, summed over them."""
    rows = batch.lin.orientation[:, :3].transpose(2, 0, 1)[which]
    return 0.5 * float(np.einsum("nij,njk,nik->", rows, batch.pose_covariance[which, :3, :3], rows))


def _last_strip(batch: Batch) -> int:
    return batch.strips[-1]


def place_of(numbers: IntArray, wanted: IntArray) -> IntArray:
    """Places of numbers among others that hold them all."""
    order = np.argsort(numbers)
    return order[np.searchsorted(numbers, wanted, sorter=order)]
