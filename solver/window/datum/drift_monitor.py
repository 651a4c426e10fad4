"""Slow blunders: a source of tie points, or a CCD line, whose measurements drift away from those of the others.

Each ray alone looks good; the mean of many does not. For every group of rays, those of one source on one CCD line, a
bias and a drift of its lines and samples are tested as additional unknowns ``b`` would be, without estimating them:
they are a border of the window's normal equations (`drifts`), from which nothing is forgotten while a strip lasts. Its
Schur complement ``V`` is the cofactor matrix of the scores ``s`` at the solution, and ``s^T V^-1 s`` is chi-square if
there is no bias. A bias that a slow error of the trajectory would explain as well has no score: what remains unseen
does no more harm than that error.

The test uses the solution of exactly those batches that are in the border. A drift bends the orientation through all
its rays; with other batches in the solution it would be looked for in part of its rays only, and be taken for the drift
of another group. Which group it is, or which ones cannot be told apart, see `adjustment.drift_hypotheses`.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Sequence

import numpy as np

from ...adjustment.drift_hypotheses import (
    ALL,
    EACH,
    FALSE_ALARM,
    LEAST_AGE,
    USUAL_PX,
    BiasedSource,
    Group,
    Hypothesis,
    Scores,
    Suspicion,
    covers,
    hypotheses,
)
from ...adjustment.pose_noise import in_step
from ...arrays import Array, IntArray
from ...navigation.kinematic_model import NOISE_TIMES_BANDWIDTH
from ..state.batch import Batch, Information
from ..state.network import LiveNetwork
from ..state.unknowns import Border, Marginal
from .cells import Drifting, cells_of
from .drifts import MOST_GROUPS, Cell, Compensation, Named, estimated

#: Age at which a batch is taken in, s: by then data snooping has removed its gross errors. Tuned.
JUDGED_S = 3.0
#: Rays of batches taken in at one update, about; bounds the time of an update. Tuned.
AT_ONCE = 240
#: Unit of time of the drift unknowns, s, so that bias and drift are numbers of like size.
DRIFT_S = 10.0
#: Integral of the correlation of position noise over all lags, in units of the lag at which it is 1/e (see
#: `MeasuredTrajectory.noise_time_s`).
NOISE_INTEGRAL = 3.0 / NOISE_TIMES_BANDWIDTH
#: By which factor a test value may have grown since the last test; decides only whether drifts are worth weighing
#: against control. Tuned.
SINCE = 1.5
#: Strips whose drifts are remembered.
MOST_NAMED = 40


class DriftMonitor:
    """Watches the groups of the strip that is flown.

    Parameters
    ----------
    follows : whether the corrections follow the slow part of the noise of measured positions
    alpha : probability that a good group fails in one test

    Attributes
    ----------
    biased : the groups that drift, as found by the last test
    """

    def __init__(self, network: LiveNetwork, follows: bool = True, alpha: float = FALSE_ALARM) -> None:
        self._network, self._follows, self._alpha = network, follows, alpha
        self._strip = -1
        self._named: deque[Named] = deque(maxlen=MOST_NAMED)
        self._restart(0.0)

    def _restart(self, now_s: float) -> None:
        self._start_s = self._tested_s = now_s
        self._groups: dict[Group, int] = {}
        self._cells: dict[int, tuple[Batch, Cell]] = {}
        self._left = Border.of(MOST_GROUPS * EACH)  # of all batches that have left the window
        self._left_rays, self._left_shares = np.zeros(MOST_GROUPS, dtype=np.int64), np.zeros(2)
        self._suspicion = Suspicion(self._alpha)
        self._limit = 0.0
        self._drift: tuple[IntArray, Array, Array] | None = None
        self.biased: tuple[BiasedSource, ...] = ()

    def begin(self) -> bool:
        """Whether a strip has begun; from now on it is the one that is watched.

        If something drifted in the strip before, its effect on the unknowns that stay, as those of the camera, is taken
        back for good.
        """
        state, left = self._network.state, self._left
        strip = max((b.strips[-1] for b in self._network.batches), default=self._strip)
        if strip <= self._strip:
            return False
        if self.biased:
            named, cost = self._suspected(), state.cost()
            self._named.append(named)
            gained = left.freed(named.rows[:0]) - left.freed(named.rows, named.sigma**-2.0)
            state.add(left.numbers, gained)
            state.fix(left.numbers, gained)
            state.solve()
            state.square += cost - state.cost()  # what it has cost stays: sigma0 is of what comes
        self._strip = strip
        self._restart(self._mine(self._network.batches)[-1].oldest_s)
        return True

    def take_in(self, now_s: float) -> None:
        """Take in batches that have settled; the state is solved."""
        mine = self._mine(self._network.batches)
        # once there is an alarm, new batches come in at once, so that the drift is taken out of them, too
        settled = [b for b in mine if b.newest_s <= now_s - (0.0 if self.biased else JUDGED_S)]
        new = [b for b in settled if id(b) not in self._cells]
        changed = [b for b in settled if (k := self._cells.get(id(b))) and k[1].information is not b.information]
        if self.biased:
            self._take(new)
        rays, turn = 0, list[Batch]()
        for batch in changed if self.biased else new + changed:
            if rays > AT_ONCE:
                break
            turn.append(batch)
            rays += len(batch.rays)
        self._take(turn)

    def _mine(self, batches: Iterable[Batch]) -> list[Batch]:
        return [b for b in batches if b.strips[-1] == self._strip]

    # -- cells: the drifts of single batches ---------------------------------------------------------------------------

    def cells(self, batches: Iterable[Batch]) -> dict[int, Cell]:
        """Drifts of the rays of batches as these are now, by identity of the batch."""
        mine = self._mine(batches)
        return {id(b): cell for b, cell in zip(mine, self._take(mine), strict=True) if cell is not None}

    def cell_of_single(self, batch: Batch) -> Cell | None:
        """Drifts of the rays of a batch of points with one look each, which is no part of the window."""
        return self._made(self._mine([batch]), 2)[0] if batch.strips[-1] == self._strip else None

    def leave(self, batches: list[Batch]) -> dict[int, Cell]:
        """Batches leave the window; call before they are fixed. Returns their cells, by identity of the batch."""
        cells = self.cells(batches)
        for cell in cells.values():
            self._left.join(cell.places, cell.border)
            self._left_rays += cell.rays
            self._left_shares += cell.shares
        return cells

    def _take(self, batches: Sequence[Batch]) -> list[Cell | None]:
        """The cells of batches as these are now; they are kept."""
        known = [self._cells.get(id(b)) for b in batches]
        changed = [b for b, k in zip(batches, known, strict=True) if k is None or k[1].information is not b.information]
        for batch, cell in zip(changed, self._made(changed), strict=True):
            if cell is not None:
                self._cells[id(batch)] = batch, cell
            else:
                self._cells.pop(id(batch), None)
        return [kept[1] if (kept := self._cells.get(id(b))) is not None else None for b in batches]

    def _made(self, batches: Sequence[Batch], rank: int = 3) -> list[Cell | None]:
        """Cells of rays with weight at points of that rank at least; None where no group that is watched has any."""
        cells: list[Cell | None] = [None] * len(batches)
        alike: dict[bytes, list[tuple[int, Drifting]]] = {}
        for i, batch in enumerate(batches):
            groups = self._network.intake.sources_of(batch)
            for group in dict.fromkeys(groups):
                if group not in self._groups and len(self._groups) < MOST_GROUPS:
                    self._groups[group] = len(self._groups)
            numbers = np.array([self._groups.get(group, -1) for group in groups])
            use = np.flatnonzero((batch.weight > 0) & (batch.normals.rank[batch.rays.point] >= rank) & (numbers >= 0))
            if len(use):
                present = np.array(sorted(set(numbers[use].tolist())))
                of_ray = np.searchsorted(present, numbers[use])
                alike.setdefault(present.tobytes(), []).append((i, Drifting(batch, use, present, of_ray)))
        for some in alike.values():
            of_some = [drifting for _, drifting in some]
            made = cells_of(of_some, self._strip, self._start_s, DRIFT_S, self._network.pose_noise.vibration)
            for (i, _), cell in zip(some, made, strict=True):
                cells[i] = cell
        return cells

    # -- the border: the drifts of all batches of the strip ------------------------------------------------------------

    def marginalised(self, marginal: Marginal) -> Marginal:
        """Unknowns have left the window; returns that with the unknowns of drifts among those that stayed."""
        n = EACH * len(self._groups)
        q = self._left.marginalise(marginal)
        stayed = np.concatenate([marginal.stayed, -1 - np.arange(n)])
        R12 = np.concatenate([marginal.R12, q[:, :n]], axis=1)
        return Marginal(marginal.gone, stayed, marginal.R11, R12, marginal.d1)

    def recount(self, numbers: IntArray, gained: Information) -> None:
        """Coordinates that have left the window are refused or count again (see `LeftControl.set_out`)."""
        own, other = np.flatnonzero(numbers < 0), np.flatnonzero(numbers >= 0)
        across = gained.matrix[np.ix_(other, own)]
        self._left.add(-1 - numbers[own], numbers[other], across, gained.matrix[np.ix_(own, own)], gained.rhs[own])

    def _in_border(self, batches: list[Batch]) -> dict[int, Cell]:
        """Cells of those of the batches that have been taken in and have lost no ray since."""
        present = {id(b): b for b in batches}
        self._cells = {key: kept for key, kept in self._cells.items() if key in present}
        return {k: c for k, (b, c) in self._cells.items() if c.weight is b.weight or np.array_equal(c.weight, b.weight)}

    def _assembled(self, now_s: float, cells: dict[int, Cell]) -> tuple[Border, list[Hypothesis], float]:
        """The border of these batches and those that have left, beside all unknowns of the state, at theta = 0; what
        may drift; and the `design_effect` by which the variance of scores is larger than stated."""
        rays, shares = self._left_rays.copy(), self._left_shares.copy()
        border = Border.of(len(self._left), self._network.state.numbers)
        border.join(np.arange(len(self._left)), self._left)
        border.join_all((cell.places, cell.border) for cell in cells.values())
        for cell in cells.values():
            rays += cell.rays
            shares += cell.shares
        border.keep(np.arange(EACH * len(self._groups)))
        total = int(rays.sum())
        if not total:
            return border, [], 1.0
        rate = total / len({ccd for _, ccd in self._groups}) / max(now_s - self._start_s, 1.0)
        share, vibrating = (shares / total).tolist()
        factor = design_effect(rate, share, self._network.trajectory.noise_time_s, self._follows)
        factor += in_step(vibrating) - 1.0
        return border, hypotheses(list(self._groups), rays[: len(self._groups)].tolist()), factor

    # -- the test ------------------------------------------------------------------------------------------------------

    def _age(self, now_s: float) -> float:
        """Time since the strip began, in units of the drift's."""
        return (now_s - self._start_s) / DRIFT_S

    @property
    def is_suspicious(self) -> bool:
        """Whether the last test has failed and nothing is named yet."""
        return not self.biased and bool(self._limit < self._suspicion.strongest < np.inf)

    def test(self, now_s: float, of_all: bool = True, instead: float = 0.0) -> None:
        """Test with what is in the border, of all batches of the strip; the state is solved.

        Parameters
        ----------
        of_all : whether a drift that all CCD lines share may be named; not where something else explains it
        instead : what speaks for another explanation, see `Suspicion.judge`
        """
        self._tested_s, batches = now_s, self._mine(self._network.batches)
        cells = self._in_border(batches)
        border, found, factor = self._assembled(now_s, cells)
        scores = self._scores(now_s, batches, cells, border)
        suspected = self._suspicion.judge(now_s, scores, found, factor, instead) if found else ()
        self.biased = tuple(source for source in suspected if of_all or source.ccd != ALL)
        self._limit = self._suspicion.limit(factor)
        self._drift = None
        if self.biased:
            named = self._suspected()
            rows = named.rows
            self._drift = rows, *estimated(scores.score[rows], scores.V[np.ix_(rows, rows)], named.sigma)

    def _scores(self, now_s: float, batches: list[Batch], cells: dict[int, Cell], border: Border) -> Scores:
        """Scores of the groups at the solution of the same data as are in the border."""
        now, then = [], []  # information of batches of the window, and what of it is in the border
        for batch in batches:
            cell = cells.get(id(batch))
            if cell is not None and cell.information is batch.information:
                continue
            now.append((batch.columns, batch.information))
            if cell is not None:
                then.append((batch.columns, cell.information))
        score, V = border.scores(*self._network.state.normal(less=now, more=then))
        return Scores(score, V, self._age(now_s), DRIFT_S)

    def least_score(self, control: float) -> float:
        """Lower bound of the score of a drift, see `hypotheses`, where biases of control explain so much.

        Together both explain no more than the sum of what each explains alone; the drift about as at the last test.
        """
        return self._limit - SINCE * self._suspicion.strongest - control

    def unknowns(self, now_s: float) -> tuple[Border, list[tuple[Array, float]]] | None:
        """The drifts (k,) that can be weighed now, with all batches of the strip; None if there are too few rays.

        Returns their border beside all unknowns of the state; and what may drift or has been named, as unknowns of
        sigma 1, combinations (k, m) of these, with the price of each.
        """
        border, found, factor = self._assembled(now_s, self.cells(self._network.batches))
        if not found:
            return None
        price = self._suspicion.limit(factor)
        choices = [(USUAL_PX * h.choice(len(border), self._age(now_s)), price) for h in found]
        if self.biased:
            named = self._suspected()
            choices.append((np.eye(len(border))[:, named.rows] * named.sigma, price * len(self.biased)))
        return border, choices

    # -- effect of what has been named on the solution -----------------------------------------------------------------

    def compensation(self) -> Compensation | None:
        """Effect of the drifts that have been named on the solution of the window; None if there are none.

        The drift is as estimated at the last test, from a solution of just the data that are in the border.
        """
        if self._drift is None:
            return None
        border, *_ = self._assembled(self._tested_s, self._in_border(self._mine(self._network.batches)))
        rows, drift, covariance = self._drift
        return Compensation(self._network.state.propagated(border.G[:, rows]), drift, covariance)

    def on_points(self, batch: Batch, drift: Compensation | None) -> tuple[Array, Array] | None:
        """Effect of a compensation on the points of a batch (p, 3), and on their covariance (p, 3, 3)."""
        if drift is None:
            return None
        A = batch.coupling @ drift.through[self._network.state.places(batch.columns)]
        cell = self._take([batch])[0] if self._drift is not None and batch.strips[-1] == self._strip else None
        if cell is not None and self._drift is not None:
            mine = np.isin(cell.places, self._drift[0])
            A[:, :, np.searchsorted(self._drift[0], cell.places[mine])] -= cell.coupling[:, :, mine]
        A = np.swapaxes(batch.inverse_factors, 1, 2) @ A
        return A @ drift.drift, A @ drift.covariance @ np.swapaxes(A, 1, 2)

    def named(self) -> list[Named]:
        """The strips so far in which something was named when they were over."""
        return [*self._named, self._suspected()] if self.biased else [*self._named]

    def _suspected(self) -> Named:
        """Unknowns of all groups that may drift; their a-priori sigma is at least as large as the bias named, px."""
        names = [name for s in self.biased for name in s.suspects]
        of = [i for group, i in self._groups.items() if any(covers(name, group) for name in names)]
        rows = (EACH * np.array(of)[:, None] + np.arange(EACH)).ravel()
        size = max([USUAL_PX, *(max(abs(s.line_px), abs(s.sample_px)) for s in self.biased)])
        age = max(self._age(self._tested_s), LEAST_AGE)
        return Named(self._strip, rows, np.where(rows % EACH < EACH // 2, size, size / age))


def design_effect(rate_hz: float, share: float, noise_time_s: float, follows: bool) -> float:
    """Factor by which the variance of a sum over rays is larger than that of independent ones, where rays are dense.

    Rays of one CCD line have the noise of measured positions in common, which the adjustment takes for white. The
    factor is the design effect of clusters of m rays with a correlation rho of their errors, 1 + (m - 1) rho. Where
    corrections follow the slow part of the noise, a cluster are the rays within the correlation time. Where they do
    not, a ray has as many others as come within the integral of the correlation, and the factor is 1 + m rho.

    Source: L. Kish, Survey Sampling, 1965, section 5.4.

    Parameters
    ----------
    rate_hz : rays of a CCD line a second
    share : of the variance of a ray that is noise of the position
    noise_time_s : lag at which that is correlated by 1/e
    """
    m = rate_hz * noise_time_s
    return 1.0 + (max(m - 1.0, 0.0) if follows else NOISE_INTEGRAL * m) * share
