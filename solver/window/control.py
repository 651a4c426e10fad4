"""Known coordinates while the strip is flown: which of them contradict the others or the GNSS, refused and taken back.

All of a strip are weighed together, those in the window and those that have left it (`control_biases`,
`control_hypotheses`): none is believed because it came first. Where it cannot be told which are wrong, none of those
counts until later control tells; the datum then rests on what else there is, with its sigma. It may as well be tie
points that drift and bend what control is held against: before any is refused that is weighed, too (`control_or_ties`).
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from .batch import Batch
from .batches import Batches
from .block import Block
from .control_biases import Biases, Discrepancies, LeftControl, biases_of, discrepancies
from .control_hypotheses import Verdict, biases, judge
from .control_or_ties import Drifts, Weighed, weigh
from .drift_border import Cell
from .following import MOVED
from .intake import Intake
from .results import CONTRADICTS, NO_LOOK, TAKEN_BACK, Refusal
from .sources import SourceMonitor
from .state import Marginal, WindowState
from .strip import WindowStrip

Array = NDArray[np.floating]
Bools = NDArray[np.bool_]

#: Coordinates kept that have left the window.
MOST_LEFT = 36
#: Time between two looks without news, s; tie points are weighed again after so long if nothing else asks for it.
LOOK_S, WEIGH_S = 2.0, 10.0
#: Probability that discrepancies of good control are looked into.
LOOKED_INTO = 1e-3
#: A difference to the GNSS of more than so many critical values is more than a doubt.
FAR = 2.0
#: Hypotheses named at most.
NAMED = 3
AXES = "XYZ"


class ControlDesk:
    """Judges control; see the module.

    Parameters
    ----------
    sources : watches for tie points that drift

    Attributes
    ----------
    failed : whether by so much that no sigma can be relied on
    warnings : lines for the operator since they were taken last
    """

    def __init__(
        self,
        state: WindowState,
        strips: dict[str, WindowStrip],
        batches: Batches,
        intake: Intake,
        block: Block,
        critical: float,
        sources: SourceMonitor,
    ) -> None:
        self._state, self._strips, self._batches = state, strips, batches
        self._intake, self._block, self._critical = intake, block, critical
        self._sources = sources
        self._left = LeftControl(MOST_LEFT)
        self._looked_s = self._weighed_s = -np.inf
        self._weighed: Weighed | None = None  # last
        self._told: set[tuple[str, int]] = set()
        self._contradiction, self.failed = "", False
        self.warnings: list[str] = []

    # -- what leaves ---------------------------------------------------------------------------------------------------

    def leaving(self, batches: list[Batch], cells: Mapping[int, Cell]) -> None:
        """Batches leave the window; their unknowns are still in the state. ``cells``: what drifts have to do with them,
        by identity."""
        for batch in batches:
            for part in self._of_batch(batch, cells.get(id(batch))):
                self._left.add(part)

    def marginalised(self, marginal: Marginal) -> None:
        """Unknowns have left the window; those of drifts are among those that stayed."""
        self._left.marginalised(marginal)

    def strip_began(self) -> None:
        """From now on drifts are looked for in another strip."""
        self._left.drop_drifts()
        self._weighed = None

    # -- judgement -----------------------------------------------------------------------------------------------------

    def is_due(self, now_s: float, fresh: list[Batch]) -> bool:
        """Whether there is new control, or it is time to look again."""
        return now_s > self._looked_s + LOOK_S or any(self._of_batch(batch) for batch in fresh)

    def look(self, now_s: float, refused: list[Refusal]) -> bool:
        """Weigh all control; whether the state has changed (it is solved again).

        Parameters
        ----------
        refused : takes the coordinates refused now and those taken back
        """
        self._looked_s = max(now_s, self._looked_s)
        self._state.solve()
        self._left.drop_strips({i for i, s in enumerate(self._strips.values()) if s.is_over(self._state)})
        of_batches = [(batch, part) for batch in self._batches for part in self._of_batch(batch)]
        if not of_batches and not len(self._left):
            return self._nothing_wrong()
        d = discrepancies(self._with_left([part for _, part in of_batches]), self._state)
        verdict = self._judge(d)
        if verdict is None:
            return self._nothing_wrong()
        weighed = self._weighed_lately(now_s, d, verdict)
        if weighed is None:
            weighed = self._weigh(d, verdict, self._sources.unknowns(now_s, self._batches, self._state))
            self._weighed_s = now_s
        if weighed is self._weighed:
            return False
        self._weighed = weighed
        verdict, d = weighed.verdict, weighed.discrepancies
        self._contradiction, self.failed = "", False
        changed = bool((verdict.out != d.out).any())
        if changed:
            self._tell_changes(d, verdict, refused)
            self._apply(of_batches, d, verdict.out)
        if verdict.out.any():
            self._doubt(d, verdict)
        return changed

    def _nothing_wrong(self) -> bool:
        self._weighed, self._contradiction, self.failed = None, "", False
        return False

    @property
    def doubt(self) -> str:
        """What control contradicts, itself, the GNSS or tie points, in words; "" where it does not."""
        last, reasons = self._weighed, [self._contradiction] if self._contradiction else []
        if last is not None and not self._sources.biased:  # what is named is told by itself
            if last.drift:
                reasons.append("control and tie points contradict each other: tie points seem to drift")
            elif last.verdict.out.any() and not last.told:
                reasons.append(
                    "or tie points drift" if reasons else "either the control refused is wrong or tie points drift"
                )
        return "; ".join(reasons)

    def _with_left(self, parts: list[Biases]) -> list[Biases]:
        return [*parts, self._left.biases] if len(self._left) else parts

    def _weighed_lately(self, now_s: float, d: Discrepancies, verdict: Verdict) -> Weighed | None:
        """What holds without weighing control against tie points anew; None if nothing does.

        Parameters
        ----------
        verdict : if nothing drifts
        """
        last, lately = self._weighed, now_s < self._weighed_s + WEIGH_S
        if lately and last is not None and last.drift and last.discrepancies.coordinates == d.coordinates:
            return last
        explained = float(d.v @ np.linalg.lstsq(d.C, d.v, rcond=1e-12)[0])
        if self._sources.least_score(explained) > verdict.score:  # no drift can be a better explanation
            return Weighed(verdict, d, False, True)
        if lately and last is not None and (verdict.out == d.out).all():
            return Weighed(verdict, d, False, last.told)
        return None

    def _weigh(self, d: Discrepancies, verdict: Verdict, drifts: Drifts | None) -> Weighed:
        """Against tie points that drift."""
        if drifts is None:
            return Weighed(verdict, d, False, True)
        parts = [part for batch in self._batches for part in self._of_batch(batch, drifts.cells.get(id(batch)))]
        border = drifts.score, drifts.normal, drifts.coupling
        d = discrepancies(self._with_left(parts), self._state, border)
        return weigh(d, drifts, self._hypotheses, verdict, self._weighed is not None and self._weighed.drift)

    def _hypotheses(self, d: Discrepancies) -> Verdict:
        return judge(d.C, d.v, np.array([c.axis for c in d.coordinates]), self._critical**2, d.out)

    def _of_batch(self, batch: Batch, cell: Cell | None = None) -> list[Biases]:
        """Known coordinates of a batch that can be judged."""
        found = []
        for p, name in enumerate(batch.names):
            control = self._intake.control.get(name)
            if control is None or batch.normals.rank[p] < 3:
                continue
            if not batch.weight[batch.first_ray[p] : batch.first_ray[p + 1]].any():  # nothing to hold it against
                continue
            refused = self._intake.points[name].out
            out = np.array([a in refused for a in range(3)])
            weight = np.where(out, control.weight, batch.control.weight[p])
            if (weight > 0).any():
                found.append(biases_of(batch, p, weight, out & (weight > 0), cell))
        return found

    def _judge(self, d: Discrepancies) -> Verdict | None:
        """None where nothing is refused and nothing contradicts."""
        axis = np.array([c.axis for c in d.coordinates])
        if not d.out.any():
            w = d.v**2 / np.maximum(np.diagonal(d.C), 1e-30)
            together = [
                d.v[axis == a].sum() ** 2 / max(d.C[np.ix_(axis == a, axis == a)].sum(), 1e-30) for a in set(axis)
            ]
            total = float(d.v @ np.linalg.lstsq(d.C, d.v, rcond=1e-12)[0])
            if max(w.max(), *together) <= self._critical**2 and total <= chi2.isf(LOOKED_INTO, len(d.v)):
                return None
        return self._hypotheses(d)

    def _apply(self, of_batches: list[tuple[Batch, Biases]], d: Discrepancies, out: Bools) -> None:
        at = 0
        changed: dict[int, Batch] = {}
        before = {}
        for batch, part in of_batches:
            mine = out[at : at + len(part.coordinates)]
            at += len(part.coordinates)
            if (mine == part.out).all():
                continue
            if id(batch) not in changed:
                changed[id(batch)] = batch
                before[id(batch)] = batch.information
            place = batch.names.index(part.coordinates[0].point)
            for c, lost in zip(part.coordinates, mine.tolist(), strict=True):
                refused = self._intake.points[c.point].out
                (refused.add if lost else refused.discard)(c.axis)
                batch.weigh_control(place, c.axis, 0.0 if lost else c.weight)
        for key, batch in changed.items():
            batch.eliminate()
            self._state.exchange(batch.columns, before[key], batch.information)
        if len(self._left) and (out[at:] != d.out[at:]).any():
            self._sources.recount(*self._left.set_out(out[at:], self._state))
            for c, lost, was in zip(d.coordinates[at:], out[at:], d.out[at:], strict=True):
                if lost != was:
                    self._block.weigh_control(c.point, c.axis, 0.0 if lost else c.weight, c.value)
        self._state.solve()
        for again in (True, False):  # a point that had been held far off was linearised there
            far = False
            for batch in changed.values():
                theta = self._state.values(batch.columns)
                batch.back_substitute(theta)
                if again and batch.points_moved() > MOVED * batch.height_m:
                    self._batches.linearise(batch, theta, reweigh=True)
                    far = True
            if not far:
                break
            self._state.solve()
        self._sources.cells(list(changed.values()), self._state)  # at once, without what is refused

    # -- words ---------------------------------------------------------------------------------------------------------

    def _tell_changes(self, d: Discrepancies, verdict: Verdict, refused: list[Refusal]) -> None:
        either = verdict.out | d.out
        off, sigma = biases(d.C, d.v, verdict.out) if verdict.out.any() else (np.empty(0), np.empty(0))
        by_place = dict(
            zip(np.flatnonzero(verdict.out).tolist(), zip(off.tolist(), sigma.tolist(), strict=True), strict=True)
        )
        in_left = len(d.coordinates) - len(self._left)
        alone = len(verdict.rivals) == 1
        back = ~verdict.out & d.out
        for i in np.flatnonzero(either & (verdict.out != d.out)).tolist():
            c = d.coordinates[i]
            if back[i]:
                refused.append(Refusal(c.point, NO_LOOK, TAKEN_BACK, 0.0, AXES[c.axis]))
                continue
            by, s = by_place[i]
            refused.append(Refusal(c.point, NO_LOOK, CONTRADICTS, abs(by) / s, AXES[c.axis], by))
            if alone:
                late = "; what is final by now leans on it" if i >= in_left else ""
                words = f"{c.point} {AXES[c.axis]} refused: w {abs(by) / s:.1f}, {by:+.2f} m off{late}"
                self.warnings.append(f"control {words}")
        if back.any():
            self.warnings.append(f"control counts again: {', '.join(_names(d, back))}")
        if not alone:
            self.warnings.append(f"{_either(d, verdict)} until more control tells")

    def _doubt(self, d: Discrepancies, verdict: Verdict) -> None:
        """Say what cannot be told, and where control and GNSS contradict each other."""
        reasons = []
        axis = np.array([c.axis for c in d.coordinates])
        if len(verdict.rivals) > 1:
            reasons.append(_either(d, verdict))
        for a in range(3):
            mine = axis == a
            n = int(mine.sum())
            if not (mine & verdict.out).any() or (mine & ~verdict.out).any():
                continue
            if n > 1 and len(d.v) + a not in verdict.chosen:
                continue
            u = mine.astype(float)
            rest = verdict.out & ~mine
            U = np.column_stack([u, np.eye(len(u))[:, rest]])
            shift = np.linalg.solve(U.T @ d.C @ U, np.column_stack([U.T @ d.v, np.eye(U.shape[1])[:, 0]]))
            by, sigma = float(shift[0, 0]), float(np.sqrt(shift[0, 1]))
            points = f"all of {n} points" if n > 1 else d.coordinates[int(np.flatnonzero(mine)[0])].point
            system = "height system (geoid)?" if a == 2 else "datum?"
            text = f"control and GNSS differ by {abs(by):.1f} m in {AXES[a]} ({points}): {system}"
            reasons.append(text)
            self.failed |= abs(by) > FAR * self._critical * sigma
            strip = max(c.strip for c in d.coordinates)
            if (AXES[a], strip) not in self._told and n > 1:
                self._told.add((AXES[a], strip))
                self.warnings.append(f"{text} {AXES[a]} rests on GNSS")
        self._contradiction = "; ".join(reasons)

    def take_warnings(self) -> list[str]:
        """Lines for the operator since the last call."""
        lines, self.warnings = self.warnings, []
        return lines


def _either(d: Discrepancies, verdict: Verdict) -> str:
    ways = sorted(", ".join(_names(d, rival)) for rival in verdict.rivals[:NAMED])
    return f"control contradicts itself, wrong is {' or '.join(ways)}: none of them counts"


def _names(d: Discrepancies, which: Bools) -> list[str]:
    return sorted(f"{d.coordinates[i].point} {AXES[d.coordinates[i].axis]}" for i in np.flatnonzero(which).tolist())
