"""Known coordinates while the strip is flown: which of them contradict the others or the GNSS; refused and taken back.

All coordinates of a strip are weighed together, those in the window and those that have left it (`biases`,
`adjustment.bias_search`): none is believed because it came first. Where it cannot be told which are wrong, none of
those counts until later control tells; the datum then rests on the other observations, and its sigma says so. Tie
points that drift may as well bend the orientation that control is compared with: before any coordinate is refused,
that explanation is weighed, too (`hypotheses`).
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import replace

import numpy as np

from ...adjustment.bias_search import Verdict, biases
from ...arrays import Array, Bools
from ...quantiles import chi2
from ..results import CONTRADICTS, NO_LOOK, TAKEN_BACK, Refusal, Update
from ..state.batch import Batch
from ..state.network import LiveNetwork
from ..state.relinearisation import MOVED
from ..state.unknowns import Marginal
from .biases import AXES, Biases, Coordinate, Discrepancies, LeftControl, biases_of, discrepancies
from .drift_monitor import DriftMonitor
from .drifts import Cell
from .hypotheses import Weighed, weigh

#: Coordinates that have left the window and can still be judged. Bounds the time of the search.
MOST_LEFT = 36
#: Time between two judgements without new control, s; time after which drifts of tie points are weighed again if
#: nothing else has changed, s. Tuned.
LOOK_S, WEIGH_S = 2.0, 10.0
#: Probability that hypotheses are searched for although all control is good (chi-square of all discrepancies).
LOOKED_INTO = 1e-3
#: Control and GNSS are known to contradict each other, and no sigma can be relied on, beyond so many critical values.
FAR = 2.0
#: A difference to the GNSS that lies across the flight by less than this share of what lies along it may be one of
#: clocks, slower flight than this, m/s, shows none; two strips say the same if their clocks agree within that share,
#: and their directions differ by more than the angle of this cosine. Flight is averaged over so long, s. Tuned.
ALONG, SLOWEST_M_S, OTHER_WAY, AVERAGED_S = 0.3, 5.0, 0.5, 4.0
#: Where more looks than this share fail narrowly (`state.tails`), there are errors of that size at control, too: a
#: coordinate has to contradict the rest by more, in proportion, twice as much where `TAILED` more do. Tuned.
USUAL_SHARE, TAILED = 0.01, 0.03
#: Hypotheses named in a line for the operator at most.
NAMED = 3


class ControlTests:
    """Judges control; see the module.

    Parameters
    ----------
    sources : watches for tie points that drift
    critical : of Baarda's |w|
    datum : whose datum is published where control and GNSS differ: "control" or "gnss"

    Attributes
    ----------
    warnings : lines for the operator since they were taken last
    """

    def __init__(self, network: LiveNetwork, sources: DriftMonitor, critical: float, datum: str = "control") -> None:
        self._network, self.sources, self.critical = network, sources, critical
        self._of_gnss = datum == "gnss"
        self._differ: dict[int, tuple[str, float, bool]] = {}  # by axis: words, metres, whether it is clear by far
        self._left = LeftControl(MOST_LEFT)
        self._looked_s = self._weighed_s = -np.inf
        self._weighed: Weighed | None = None  # last
        self._told: set[tuple[int, int]] = set()  # axes and strips whose contradiction with the GNSS has been told
        self._contradiction = ""
        self._along: dict[int, tuple[float, Array]] = {}  # by strip: clock that would explain it, s; direction (2,)
        self._clock_told = False
        self.warnings: list[str] = []

    # -- what leaves ---------------------------------------------------------------------------------------------------

    def leaving(self, batches: list[Batch], cells: Mapping[int, Cell]) -> None:
        """Batches leave the window; their unknowns are still in the state.

        ``cells``: drifts of the rays of the batches, by identity of the batch.
        """
        for batch in batches:
            for part in self._of_batch(batch, cells.get(id(batch))):
                self._left.add(part)

    def marginalised(self, marginal: Marginal) -> None:
        """Unknowns have left the window; those of drifts are among those that stayed."""
        self._left.marginalised(marginal)

    def restated(self, point: str) -> None:
        """Coordinates of a point are stated anew: those that have left the window count no more."""
        of_point = np.array([c.point == point for c in self._left.coordinates], dtype=bool)
        if of_point.any():
            self.sources.recount(*self._left.take_out(of_point, self._network.state))
            self._weighed = None

    def strip_began(self) -> None:
        """From now on drifts are looked for in another strip."""
        self._left.drop_drifts()
        self._weighed = None
        self._differ.clear()

    # -- judgement -----------------------------------------------------------------------------------------------------

    def is_due(self, now_s: float, fresh: list[Batch]) -> bool:
        """Whether there is new control, or it is time to look again."""
        return now_s > self._looked_s + LOOK_S or any(self._of_batch(batch) for batch in fresh)

    def weigh(self, update: Update) -> tuple[bool, list[Coordinate]]:
        """Weigh all control: that of the window and that of the strip that has left it.

        Whether the state has changed, then it has been solved again; coordinates of points that are final, which the
        block keeps, with the weight that they have from now on if that has changed.
        """
        network, now_s = self._network, update.now_s
        self._looked_s = max(now_s, self._looked_s)
        network.state.solve()
        self._left.drop_strips({i for i, s in enumerate(network.strips.values()) if s.is_over(network.state)})
        of_batches = [(batch, part) for batch in network.batches for part in self._of_batch(batch)]
        d = verdict = None
        if of_batches or len(self._left):
            d = discrepancies([*(part for _, part in of_batches), self._left], network.state)
            verdict = d.judge(self._price, self._shifted) if self._is_suspect(d) else None
        if d is None or verdict is None:
            self._weighed = None
            self._tell_differences([])
            return False, []
        weighed = self._weighed_lately(now_s, d, verdict)
        if weighed is None:
            weighed = self._weigh(now_s, d, verdict)
            self._weighed_s = now_s
        if weighed is self._weighed:
            return False, []
        self._weighed = weighed
        verdict, d = weighed.verdict, weighed.discrepancies
        changed, of_final = bool((verdict.out != d.out).any()), list[Coordinate]()
        if changed:
            self._tell_changes(d, verdict, update)
            of_final = self._apply(of_batches, d, verdict.out)
        reasons = [_either(d, verdict)] if len(verdict.rivals) > 1 else []
        self._against_gnss(d, verdict)
        self._tell_differences(reasons)
        return changed, of_final

    def _tell_differences(self, reasons: list[str]) -> None:
        """Put into words what control contradicts."""
        self._contradiction = "; ".join(reasons + [text for text, *_ in self._differ.values()])

    @property
    def doubt(self) -> str:
        """What control contradicts, itself, the GNSS or tie points, in words; "" where it does not."""
        last, reasons = self._weighed, [self._contradiction] if self._contradiction else []
        if last is not None and not self.sources.biased:  # drifts that have been named are reported by themselves
            if last.drift:
                reasons.append("control and tie points contradict each other: tie points seem to drift")
            elif last.verdict.out.any() and not last.told:
                reasons.append(f"{'or' if reasons else 'either the control refused is wrong or'} tie points drift")
        return "; ".join(reasons)

    @property
    def differs_from_gnss(self) -> bool:
        """Whether all control of the strip differs from the GNSS along an axis."""
        return bool(self._differ)

    def fails(self, limit_m: float) -> bool:
        """Whether control and GNSS differ by so much that no sigma can be relied on.

        In the datum of control the sigmas follow the difference, unless it is beyond the alert limit.
        """
        return any(far and (self._of_gnss or metres > limit_m) for _, metres, far in self._differ.values())

    @property
    def _shifted(self) -> Collection[int] | None:
        """Axes in which GNSS is known to be off the datum of control; None where GNSS is the datum."""
        return None if self._of_gnss else self._differ

    @property
    def _price(self) -> float:
        """Of a bias of control: square of the critical value, which heavy tails of the looks make larger."""
        beyond = self._network.tails.share(self._network.batches) - USUAL_SHARE
        return (self.critical * (1.0 + min(max(beyond / TAILED, 0.0), 1.0))) ** 2

    def _is_suspect(self, d: Discrepancies) -> bool:
        """Whether a coordinate is refused, or one alone, all of an axis or all together fail their test."""
        if d.out.any():
            return True
        singles = d.v**2 / np.maximum(np.diagonal(d.C), 1e-30)
        axes = np.array([d.axis == a for a in set(d.axis.tolist())], dtype=float)
        together = (axes @ d.v) ** 2 / np.maximum(np.einsum("ai,ij,aj->a", axes, d.C, axes), 1e-30)
        return bool(
            max(singles.max(), together.max()) > self.critical**2 or d.explained > chi2.isf(LOOKED_INTO, len(d.v))
        )

    def _weighed_lately(self, now_s: float, d: Discrepancies, verdict: Verdict) -> Weighed | None:
        """What holds without weighing control against tie points anew; None if nothing does.

        ``verdict``: of control if nothing drifts.
        """
        last, lately = self._weighed, now_s < self._weighed_s + WEIGH_S
        if lately and last is not None and last.drift and last.discrepancies.coordinates == d.coordinates:
            return last
        if self.sources.least_score(d.explained) > verdict.score:  # no drift can be a better explanation
            return Weighed(verdict, d, False, True)
        if lately and last is not None and (verdict.out == d.out).all():
            return Weighed(verdict, d, False, last.told)
        return None

    def _weigh(self, now_s: float, d: Discrepancies, verdict: Verdict) -> Weighed:
        """Weigh control against tie points that drift; ``verdict``: of control if nothing drifts."""
        drifts = self.sources.unknowns(now_s)
        if drifts is None:
            return Weighed(verdict, d, False, True)
        batches, blamed = self._network.batches, self._weighed is not None and self._weighed.drift
        cells = self.sources.cells(batches)
        parts = [part for batch in batches for part in self._of_batch(batch, cells.get(id(batch)))]
        d = discrepancies([*parts, self._left], self._network.state, drifts[0])
        return weigh(d, drifts[1], self._price, verdict, blamed, self._shifted)

    def _of_batch(self, batch: Batch, cell: Cell | None = None) -> list[Biases]:
        """Biases of the coordinates of a batch that can be judged, by point."""
        found, intake = [], self._network.intake
        if intake.control.keys().isdisjoint(batch.names):
            return []
        checkable = (batch.normals.rank == 3) & (batch.points_left > 0)
        for p, name in enumerate(batch.names):
            if name not in intake.control or not checkable[p]:
                continue
            out = np.isin(np.arange(3), list(intake.points[name].out))
            weight = np.where(out, intake.control[name].weight, batch.control.weight[p])
            if (weight > 0).any():
                found.append(biases_of(batch, p, weight, out & (weight > 0), cell))
        return found

    def _apply(self, of_batches: list[tuple[Batch, Biases]], d: Discrepancies, out: Bools) -> list[Coordinate]:
        """Refuse and take back in the state; returns the changes at points that are final."""
        state, batches, points = self._network.state, self._network.batches, self._network.intake.points
        at = 0
        changed: dict[int, Batch] = {}
        for batch, part in of_batches:
            mine = out[at : at + len(part)]
            at += len(part)
            if (mine == part.out).all():
                continue
            changed[id(batch)] = batch
            for c, lost in zip(part.coordinates, mine.tolist(), strict=True):
                (points[c.point].out.add if lost else points[c.point].out.discard)(c.axis)
                batch.weigh_control(batch.names.index(c.point), c.axis, 0.0 if lost else c.weight)
        for batch in changed.values():
            batches.eliminate(batch)
        of_final = [
            replace(c, weight=0.0 if lost else c.weight)
            for c, lost, was in zip(d.coordinates[at:], out[at:], d.out[at:], strict=True)
            if lost != was
        ]
        if of_final:
            self.sources.recount(*self._left.set_out(out[at:], state))
        state.solve()
        for batch in changed.values():
            theta = state.values(batch.columns)
            batch.back_substitute(theta)
            if batch.points_moved() > MOVED * batch.height_m:  # the point had been held far off, and linearised there
                batches.linearise(batch, theta, reweigh=True)
        state.solve()
        for batch in changed.values():
            batch.back_substitute(state.values(batch.columns))
        self.sources.cells(changed.values())  # at once, without what is refused
        return of_final

    # -- words ---------------------------------------------------------------------------------------------------------

    def _tell_changes(self, d: Discrepancies, verdict: Verdict, update: Update) -> None:
        """Coordinates refused and taken back, with lines for the operator."""
        refused, told = update.refused, len(verdict.rivals) == 1
        off, sigma = np.zeros(len(d.v)), np.ones(len(d.v))
        off[verdict.out], sigma[verdict.out] = biases(d.C, d.v, verdict.out)
        for i in np.flatnonzero(verdict.out != d.out).tolist():
            c, by, w = d.coordinates[i], float(off[i]), float(abs(off[i]) / sigma[i])
            if not verdict.out[i]:
                refused.append(Refusal(c.point, NO_LOOK, TAKEN_BACK, 0.0, AXES[c.axis]))
                continue
            refused.append(Refusal(c.point, NO_LOOK, CONTRADICTS, w, AXES[c.axis], by))
            if told:
                late = "; what is final by now leans on it" if i >= len(d.v) - len(self._left) else ""
                self.warnings.append(f"control {c} refused: w {w:.1f}, {by:+.2f} m off{late}")
        back = ~verdict.out & d.out
        if back.any():
            self.warnings.append(f"control counts again: {d.names(back)}")
        if not told:
            self.warnings.append(f"{_either(d, verdict)} until more control tells")

    def _against_gnss(self, d: Discrepancies, verdict: Verdict) -> None:
        """Notes the axes in which all control differs from the GNSS, and whether one of them does by far.

        In the datum of control the difference is one of the trajectory, whose sigmas follow it
        (`screening.sigma_check`), so that it does not show any more: it is told until the strip is over. In the datum
        of GNSS control is refused.
        """
        if self._of_gnss:
            self._differ.clear()
        off: dict[int, float] = {}
        for a in range(3):
            mine = d.axis == a
            n = int(mine.sum())
            common = len(d.v) + a in verdict.chosen
            alone = self._of_gnss and n == 1 and bool(verdict.out[mine].all())
            if not n or not (common or alone):
                continue
            U = np.column_stack([mine, np.eye(len(mine))[:, verdict.out & ~mine]])
            every = np.ones(U.shape[1], dtype=bool)
            by, sigma = (float(x[0]) for x in biases(U.T @ d.C @ U, U.T @ d.v, every))
            off[a] = by
            points = f"all of {n} points" if n > 1 else d.coordinates[int(np.flatnonzero(mine)[0])].point
            system = "height system (geoid)?" if a == 2 else "datum?"
            text = f"control and GNSS differ by {abs(by):.2f} +- {sigma:.2f} m in {AXES[a]} ({points}): {system}"
            self._differ[a] = text, abs(by), abs(by) > FAR * self.critical * sigma
            place = a, max(c.strip for c in d.coordinates)
            if place not in self._told and n > 1:
                self._told.add(place)
                rests = (
                    f"{AXES[a]} rests on GNSS" if self._of_gnss else f"{AXES[a]} is published in the datum of control"
                )
                other = "control" if self._of_gnss else "gnss"
                self.warnings.append(f"{text} {rests}; set datum = {other} to turn it")

        if off.keys() & {0, 1}:
            self._name_clock(off, max(c.strip for c in d.coordinates))

    def _name_clock(self, off: Mapping[int, float], strip: int) -> None:
        """Name the clock where control and GNSS differ along the flight alone: one strip hints, two say it."""
        end_s = self._network.trajectory.smoothed_to_s
        times = np.array([end_s - AVERAGED_S, end_s])
        if not self._network.trajectory.covers(times).all():
            return
        velocity = np.diff(self._network.trajectory.at(times).poses.position_l[:, :2], axis=0)[0] / AVERAGED_S
        speed = float(np.linalg.norm(velocity))
        if speed < SLOWEST_M_S:
            return
        direction = velocity / speed
        by = np.array([off.get(0, 0.0), off.get(1, 0.0)])
        along, across = float(by @ direction), float(by[1] * direction[0] - by[0] * direction[1])
        if abs(across) > ALONG * abs(along):
            self._along.pop(strip, None)
            return
        ahead_s = along / speed
        self._along[strip] = ahead_s, direction
        words = f"GNSS clock {abs(ahead_s):.3f} s {'ahead of' if ahead_s > 0 else 'behind'} the image lines"
        for a in off.keys() & {0, 1}:
            text, metres, far = self._differ[a]
            self._differ[a] = text.replace("datum?", f"datum, or {words}?"), metres, far
        others = [(s, w) for i, (s, w) in self._along.items() if i != strip and float(w @ direction) < OTHER_WAY]
        if others and not self._clock_told and all(abs(s - ahead_s) < ALONG * abs(ahead_s) for s, _ in others):
            self._clock_told = True
            self.warnings.append(f"{words}: control of strips that were flown in other directions agrees on it")

    def take_warnings(self) -> list[str]:
        """Lines for the operator since the last call."""
        lines, self.warnings = self.warnings, []
        return lines


def _either(d: Discrepancies, verdict: Verdict) -> str:
    ways = sorted(d.names(rival) for rival in verdict.rivals[:NAMED])
    what = "itself" if len({c.point for c in d.coordinates}) > 1 else "the trajectory"
    return f"control contradicts {what}, wrong is {' or '.join(ways)}: none of them counts"
