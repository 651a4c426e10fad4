"""Slow blunders: a source of tie points, or a CCD line, whose measurements drift away from those of the others.

Each ray alone looks good; the mean of many does not. For every group of rays, those of one source on one CCD line, a
bias and a drift of its lines and samples are tested as additional unknowns ``b`` would be, without estimating them:
they are a border of the window's normal equations (`drift_border`), from which nothing is forgotten while a strip
lasts. Its Schur complement ``V`` is the cofactor matrix of the scores ``s`` at the solution, and ``s^T V^-1 s`` is
chi-square if there is no bias. A bias that a slow error of the trajectory would explain as well has no score: what
remains unseen does no more harm than that error.

The solution is one of just the batches that are in the border: with others in it, a drift that bends the orientation
through them, too, would be looked for in part of its rays only, and be taken for another. Which group it is, or which
ones cannot be told apart, see `suspects`.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable

import numpy as np
from numpy.typing import NDArray

from ..adjustment.reduced_system import DenseFactor
from ..navigation.kinematic_model import NOISE_TIMES_BANDWIDTH
from .batch import Batch, Information, inverse_factors
from .compensation import Compensation, Named, estimated
from .control_or_ties import Drifts
from .drift_border import MOST_GROUPS, Cell, LeftBorder, OnPoints
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
#: Integral of the correlation of that noise over all lags, in units of that at which it is 1/e (see `noise_time`).
NOISE_INTEGRAL = 3.0 / NOISE_TIMES_BANDWIDTH
#: How many times its last test value a drift explains at most by now.
SINCE = 1.5
#: Strips whose drifts are remembered.
MOST_NAMED = 40


class SourceMonitor:
    """Watches the groups of the strip that is flown.

    Parameters
    ----------
    groups_of : says source and CCD line of each ray of a batch
    noise_time_s : says for how long the noise of measured positions is correlated
    follows : whether the corrections follow its slow part
    alpha : probability that a good group fails in one test
    """

    def __init__(
        self,
        groups_of: Callable[[Batch], list[Group]],
        noise_time_s: Callable[[], float],
        follows: bool = True,
        alpha: float = FALSE_ALARM,
    ) -> None:
        self._groups_of, self._noise_time_s, self._follows, self._alpha = groups_of, noise_time_s, follows, alpha
        self._strip = -1
        self._next_s = -np.inf
        self._named: deque[Named] = deque(maxlen=MOST_NAMED)
        self._restart(0.0)

    def _restart(self, now_s: float) -> None:
        self._start_s = self._tested_s = now_s
        self._groups: dict[Group, int] = {}
        self._cells: dict[int, tuple[Batch, Cell]] = {}
        self._left = LeftBorder()
        self._suspicion = Suspicion(self._alpha)
        self._limit = 0.0
        self._drift: tuple[IntArray, Array, Array] | None = None
        self.biased: tuple[BiasedSource, ...] = ()

    def begin(self, batches: list[Batch], state: WindowState) -> bool:
        """Whether a strip has begun; from now on it is the one that is watched.

        What the one before says of unknowns that stay, as those of the camera, is without what drifted in it for good.
        """
        newest = max(reversed(batches), key=_last_strip, default=None)
        if newest is None or newest.strips[-1] <= self._strip:
            return False
        for named in self._in_this_strip():
            self._named.append(named)
            if len(self._left.numbers):
                change, cost = self._left.free(named), state.cost()
                state.add(self._left.numbers, change)
                state.fix(self._left.numbers, change)
                state.solve()
                state.square += cost - state.cost()  # what it has cost stays: sigma0 is of what comes
        self._strip = newest.strips[-1]
        self._restart(newest.oldest_s)
        return True

    def update(self, now_s: float, batches: list[Batch], state: WindowState) -> None:
        """Take in what has settled, and test when it is time.

        Parameters
        ----------
        batches : of the window
        state : solved
        """
        mine = self._mine(batches)
        # once there is an alarm its effect is taken back, in what has just come, too
        settled_s = SETTLED_S if not self.biased else 0.0
        self._take_some([b for b in mine if b.newest_s <= now_s - settled_s], state)
        if now_s >= self._next_s:
            self._next_s = now_s + EVERY_S
            self._test(now_s, mine, state)

    def _take_some(self, batches: list[Batch], state: WindowState) -> None:
        """Take in new batches, then those that have changed, as many as one update can bear."""
        known = [self._cells.get(id(b)) for b in batches]
        new = [b for b, k in zip(batches, known, strict=True) if k is None]
        if self.biased:
            for batch in new:
                self._take(batch, state)
            new = []
        new += [b for b, k in zip(batches, known, strict=True) if k and k[1].information is not b.information]
        rays = 0
        for batch in new:
            if rays > AT_ONCE:
                break
            self._take(batch, state)
            rays += len(batch.rays)

    def _mine(self, batches: Iterable[Batch]) -> list[Batch]:
        return [b for b in batches if b.strips[-1] == self._strip]

    def cells(self, batches: list[Batch], state: WindowState) -> dict[int, Cell]:
        """Borders of batches as they are, by identity."""
        return {id(b): cell for b in self._mine(batches) if (cell := self._up_to_date(b, state)) is not None}

    def cell_of_single(self, batch: Batch, state: WindowState) -> Cell | None:
        """Border of a batch of points with one look each, which is no part of the window."""
        return self._cell(batch, state, self._groups_of(batch), 2) if self._mine([batch]) else None

    def leave(self, batches: list[Batch], state: WindowState) -> dict[int, Cell]:
        """Batches leave the window; call before they are fixed. Returns their borders, by identity."""
        left = {}
        for batch in self._mine(batches):
            cell = self._up_to_date(batch, state)
            self._cells.pop(id(batch), None)
            if cell is not None:
                self._left.add(cell)
                left[id(batch)] = cell
        return left

    def marginalised(self, marginal: Marginal) -> Marginal:
        """Unknowns have left the window; what left, with the border's unknowns, see `drift_border`."""
        return self._left.marginalised(marginal, len(self._groups))

    def recount(self, numbers: IntArray, change: Information) -> None:
        """Known coordinates that have left the window count otherwise: what unknowns gain, negative ones of drifts."""
        self._left.exchange(numbers, change)

    def least_score(self, control: float) -> float:
        """What the score of a drift is at least, see `control_or_ties`, where biases of control explain so much.

        Together they explain no more than the sum of what each does alone, the drift about as at the last test.
        """
        return self._limit - SINCE * self._suspicion.strongest - control

    def unknowns(self, now_s: float, batches: Iterable[Batch], state: WindowState) -> Drifts | None:
        """The drifts that can be weighed now, with all batches of the strip; None if there are too few rays."""
        mine = self._mine(batches)
        cells = self.cells(mine, state)
        score, normal, coupling, count = self._assembled(cells, state)
        found = hypotheses(list(self._groups), count.tolist())
        if not found:
            return None
        limit = self._suspicion.limit(self._factor(now_s, int(count.sum()), self._shared(cells)))
        named = self._suspected() if self.biased else np.empty(0, np.int64)
        return Drifts(
            score, normal, coupling, cells, found, (now_s - self._start_s) / DRIFT_S, limit,
            named, self._beforehand(named), len(self.biased),
        )  # fmt: skip

    def _shared(self, cells: dict[int, Cell]) -> float:
        return self._left.shared + sum(c.shared for c in cells.values())

    def _up_to_date(self, batch: Batch, state: WindowState) -> Cell | None:
        known = self._cells.get(id(batch))
        if known is None or known[1].information is not batch.information:
            self._take(batch, state)
            known = self._cells.get(id(batch))
        return known[1] if known is not None else None

    def _take(self, batch: Batch, state: WindowState) -> None:
        cell = self._cell(batch, state, self._groups_of(batch))
        if cell is not None:
            self._cells[id(batch)] = batch, cell
        else:
            self._cells.pop(id(batch), None)

    def _cell(self, batch: Batch, state: WindowState, groups: list[Group], rank: int = 3) -> Cell | None:
        for group in groups:
            if group not in self._groups and len(self._groups) < MOST_GROUPS:
                self._groups[group] = len(self._groups)
        numbers = np.array([self._groups.get(g, -1) for g in groups])
        use = np.flatnonzero((batch.weight > 0) & (batch.normals.rank[batch.rays.point] >= rank) & (numbers >= 0))
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
        seen = point[begins]
        on_points = OnPoints(self._strip, places, seen, on_point @ inverse_factors(batch.normals)[seen])
        return Cell(
            batch.information, batch.weight.copy(), places, present, count, _shared(batch, use), score, normal,
            batch.columns, coupling, on_points, use, of_ray, B,
        )  # fmt: skip

    def _test(self, now_s: float, batches: list[Batch], state: WindowState) -> None:
        """Test with what is in the border, of all batches of the strip."""
        self._tested_s = now_s
        cells = self._in_border(batches)
        scores, count = self._scores(now_s, batches, cells, state)
        found = hypotheses(list(self._groups), count.tolist())
        factor = self._factor(now_s, int(count.sum()), self._shared(cells))
        self.biased = self._suspicion.judge(now_s, scores, found, factor) if found else ()
        self._limit = self._suspicion.limit(factor)
        self._drift = None
        if self.biased:
            rows = self._suspected()
            estimate = estimated(scores.score[rows], scores.V[np.ix_(rows, rows)], self._beforehand(rows))
            self._drift = (rows, *estimate)

    def _factor(self, now_s: float, rays: int, shared: float) -> float:
        """By how much the variance of scores is larger than stated."""
        if not rays:
            return 1.0
        lines = len({ccd for _, ccd in self._groups})
        rate = rays / lines / max(now_s - self._start_s, 1.0)
        return design_effect(rate, shared / rays, self._noise_time_s(), self._follows)

    def _in_border(self, batches: list[Batch]) -> dict[int, Cell]:
        """Of the batches, those that have been taken in and have lost no ray since."""
        present = {id(b): b for b in batches}
        self._cells = {key: kept for key, kept in self._cells.items() if key in present}
        return {k: c for k, (b, c) in self._cells.items() if np.array_equal(c.weight, b.weight)}

    def _assembled(self, cells: dict[int, Cell], state: WindowState) -> tuple[Array, Array, Array, IntArray]:
        """Scores (n,) at theta = 0, normal matrix (n, n), coupling to all unknowns of the state, rays of the groups."""
        m = len(self._groups)
        n = EACH * m
        left = self._left
        score, normal, count = left.score[:n].copy(), left.normal[:n, :n].copy(), left.rays[:m].copy()
        coupling = np.zeros((n, len(state)))
        coupling[:, state.places(left.numbers)] = left.coupling[:n]
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
        _, _, coupling, _ = self._assembled(self._in_border(self._mine(batches)), state)
        rows, drift, covariance = self._drift
        return Compensation(state.propagated(coupling[rows].T), drift, covariance)

    def on_points(self, batch: Batch, state: WindowState, drift: Compensation) -> tuple[Array, Array]:
        """What a compensation does to the points of a batch (p, 3) and their covariance (p, 3, 3)."""
        L = inverse_factors(batch.normals)
        A = np.swapaxes(L, 1, 2) @ batch.coupling @ drift.through[state.places(batch.columns)]
        cell = self._up_to_date(batch, state) if self._drift is not None and batch.strips[-1] == self._strip else None
        if cell is not None and self._drift is not None:
            A -= cell.on_points.of_unknowns(self._drift[0], len(A))
        return A @ drift.drift, A @ drift.covariance @ np.swapaxes(A, 1, 2)

    def named(self) -> list[Named]:
        """The strips so far in which something was named when they were over."""
        return [*self._named, *self._in_this_strip()]

    def _in_this_strip(self) -> list[Named]:
        rows = self._suspected() if self.biased else np.empty(0, np.int64)
        return [Named(self._strip, rows, self._beforehand(rows))] if len(rows) else []

    def _suspected(self) -> IntArray:
        """Unknowns of all groups that may drift."""
        names = [name for s in self.biased for name in s.suspects]
        of = [i for g, i in self._groups.items() if any(n[0] in (ALL, g[0]) and n[1] in (ALL, g[1]) for n in names)]
        return (EACH * np.array(of)[:, None] + np.arange(EACH)).ravel()

    def _beforehand(self, rows: IntArray) -> Array:
        """Sigma of these unknowns: what was named may be as large as that, the others as well."""
        size = max([USUAL_PX, *(max(abs(s.line_px), abs(s.sample_px)) for s in self.biased)])
        age = max((self._tested_s - self._start_s) / DRIFT_S, 0.1)
        return np.where(rows % EACH < EACH // 2, size, size / age)

    # -- the test ------------------------------------------------------------------------------------------------------

    def _scores(
        self, now_s: float, batches: list[Batch], cells: dict[int, Cell], state: WindowState
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


def design_effect(rate_hz: float, share: float, noise_time_s: float, follows: bool) -> float:
    """By how much the variance of a sum over rays is larger than that of independent ones, where rays are dense.

    Rays of one CCD line have the noise of measured positions in common, which the adjustment takes for white: the
    design effect of clusters of m rays with a correlation rho of their errors, 1 + (m - 1) rho. A cluster are those
    within the correlation time where corrections follow the slow part of the noise. Where they do not, a ray has as
    many others as come within the integral of the correlation, and it is 1 + m rho.

    Source: L. Kish, Survey Sampling, 1965, section 5.4.

    Parameters
    ----------
    rate_hz : rays of a CCD line a second
    share : of the variance of a ray that is noise of the position
    noise_time_s : lag at which that is correlated by 1/e
    """
    m = rate_hz * noise_time_s
    return 1.0 + (max(m - 1.0, 0.0) if follows else NOISE_INTEGRAL * m) * share


def _shared(batch: Batch, which: IntArray) -> float:
    """Share of the variance of rays that is noise of the measured position, summed over them."""
    rows = batch.lin.orientation[:, :3].transpose(2, 0, 1)[which]
    return 0.5 * float(np.einsum("nij,njk,nik->", rows, batch.pose_covariance[which, :3, :3], rows))


def _last_strip(batch: Batch) -> int:
    return batch.strips[-1]
