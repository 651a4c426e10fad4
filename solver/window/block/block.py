"""The block of strips that have left the window: what they hand over, when it is solved, what a later strip gets.

When nothing of the strips flown so far is in the window any more, the block is solved with all that was kept
(`archive`). The strips that are over get the information of the block so far, and the next one meets them in short form
(`ties`). That is work of seconds, while the aircraft turns for about a minute, so it is done in portions: one with each
update, as large as the platform time since the update before. What is left when the next strip brings points is done
before they are looked up.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from ...adjustment.in_parts import Parts
from ...arrays import Array
from ..datum.biases import Coordinate
from ..datum.drifts import Cell, Named
from ..results import AdjustedPoint, Look, RefinedOrientation, Update, WholeStrips
from ..state.batch import Batch
from ..state.network import LiveNetwork
from ..state.points import ControlPoint
from ..state.strip import WindowStrip
from .archive import BLOCK_UNKNOWNS, MOST_OF_STRIP, MOST_POINTS, Archive, KeptStrip
from .backward import LeftOrientation, LeftPoints, Step, backward
from .solution import BlockSolution
from .ties import EarlierStrips

#: Floating point operations of the work on the block for each second of platform time: about a tenth of a core. Tuned.
RATE = 4e9
#: Platform time that the first portion stands for, s: that of a usual update. Tuned.
FIRST_PORTION_S = 0.2
#: What has been refined is published in portions too: stretches of orientation, each of which is a message, and points
#: in one update. Tuned.
MOST_TOLD, MOST_POINTS_TOLD = 8, 320


class Block:
    """See the module.

    Attributes
    ----------
    earlier : what the strip that is flown knows of those before it
    events : lines for the operator since they were taken last
    drifts : drifts of tie points that have been named so far, by strip
    """

    def __init__(self, network: LiveNetwork) -> None:
        self._network = network
        self.earlier = EarlierStrips(network.state, network.shared_columns)
        self.events: list[str] = []
        self.drifts: Sequence[Named] = ()
        self._shared_sigma = network.shared_sigma
        self._archive = Archive(network.shared_columns, self._shared_sigma)
        self._touched: set[str] = set()
        self._new: list[str] = []
        self._solved: tuple[BlockSolution, frozenset[str]] | None = None  # the last solution, and the strips in it
        self._full = 0
        self._work: Parts | None = None
        self._ahead: Parts | None = None  # what need not be done before others go on
        self._worked_s = -np.inf
        self._orientation: dict[tuple[str, float], RefinedOrientation] = {}
        self._points: dict[str, AdjustedPoint] = {}

    # -- what becomes known --------------------------------------------------------------------------------------------

    def begin(self, strip: WindowStrip) -> None:
        """A strip begins."""
        self._archive.strips[strip.id] = KeptStrip(self._network.index(strip), strip.numbers)

    def leave(self, batch: Batch, left: LeftPoints, cell: Cell | None, update: Update) -> None:
        """A batch became final; see `Archive.leave`."""
        self.conclude()
        names = list(self._network.strips)
        self._touched.update(names[i] for i in batch.strips)
        self._archive.leave(batch, left, cell, update)

    def keep_single(self, batch: Batch, looks: Sequence[Look], cell: Cell | None, unplaced: bool) -> None:
        """Keep looks that found no partner in their strip, a batch of one each; see `Archive.keep_single`."""
        self.conclude()
        self._touched.update(look.strip for look in looks)
        self._archive.keep_single(batch, looks, cell, unplaced)

    @property
    def groundless(self) -> bool:
        """Whether looks are kept of which nobody knows how far away their points are."""
        return bool(self._archive.unplaced)

    def unplaced_ray(self, name: str, strip: str) -> tuple[Array, Array] | None:
        """Position (3,) and direction (3,) of a kept look at a point from another strip, if its place is not known."""
        kept = self._archive.points.get(name) if name in self._archive.unplaced else None
        if kept is None or kept.single is None or not kept.unplaced or strip in kept.strips:
            return None
        return kept.single.ray_l

    def ground_found(self, height_m: float) -> None:
        """It is known now how high the ground is, metres in the local frame: looks that waited for it tie later strips,
        at once where nothing else does."""
        self.conclude()
        self._archive.place_single(height_m)
        if self._solved is not None and not len(self.earlier) and not self.earlier.present:
            solution, strips = self._solved
            self.earlier.learn(self._archive, solution, set(self._archive.strips) - strips)

    def orientation(self, strip: WindowStrip, final: LeftOrientation) -> None:
        """Orientation that became final."""
        kept = self._archive.strips.get(strip.id)
        if kept is None:
            return
        kept.orientation.append(final)
        if len(strip.entered) > MOST_OF_STRIP:
            self.conclude()
            self._archive.begin_again()
            self.events.append(
                f"strip {strip.id} has more than {MOST_OF_STRIP} unknowns: it is refined alone, those before it no more"
            )

    def gone(self, strip: WindowStrip) -> None:
        """Nothing of a strip is left in the window."""
        self.conclude()
        if strip.id in self._archive.strips:
            for orientation in self._archive.strips[strip.id].orientation:
                orientation.over(self._network.vibrations)
        self._touched.discard(strip.id)
        self._archive.end_strip(strip)
        self._new.append(strip.id)

    def knows(self, name: str) -> bool:
        """Whether known coordinates count in a point that is final."""
        return self._archive.knows(name)

    def add_control(self, name: str, control: ControlPoint) -> None:
        """Known coordinates, perhaps of a point that is final already, and of which others counted."""
        self.conclude()
        came = "was changed" if self.knows(name) else "came"
        if not self._archive.add_control(name, control):
            return
        if not control.weight.any():
            self.events.append(f"control {name} was taken back after its point was final: what is whole is without it")
        elif self.earlier.add_control(name, control):
            self.events.append(f"control {name} {came} after its point was final: it counts from now on")
        elif self._new or self._archive.over:
            self.events.append(f"control {name} {came} after its point was final: it counts when the strip is over")

    def reweigh_control(self, changes: Iterable[Coordinate]) -> None:
        """Give known coordinates of points that are final other weights."""
        for c in changes:
            self.conclude()
            self._archive.weigh_control(c.point, c.axis, c.weight, c.value)

    def reweigh_surface(self, change: Array) -> None:
        """What is known beforehand of the shift of the surface has another weight, by (m, m) more."""
        if change.any():
            self.conclude()
            self._archive.add(self._network.surface.numbers, change, np.zeros(len(change)))

    def take_events(self) -> list[str]:
        """Lines for the operator since the last call."""
        events, self.events = self.events, []
        return events

    # -- when strips are over ------------------------------------------------------------------------------------------

    @property
    def quiet(self) -> bool:
        """Whether the window holds nothing of the block."""
        return not self._touched and not self.earlier.present

    def refined(self, now_s: float, steps: list[Step], at_the_end: bool) -> WholeStrips | None:
        """Strips that are over with the information of the block so far: those that are new, at the end all of them.

        Parameters
        ----------
        now_s : platform time, by which the portion of the work is measured
        steps : what left the window, from which strips are refined that are no part of a block; emptied when work
            begins
        """
        if at_the_end:
            self.conclude()
        if self._work is None and self.quiet and (self._new or self._archive.changed or at_the_end):
            self._begin_work(steps, at_the_end)
            self._worked_s = now_s - FIRST_PORTION_S
        if self._work is not None or self._ahead is not None:
            left = self._advance(np.inf if at_the_end else RATE * (now_s - self._worked_s))
            if self.quiet and not at_the_end:
                self._prepare(left)
            self._worked_s = now_s
        return self._told(*(None, None) if at_the_end else (MOST_TOLD, MOST_POINTS_TOLD))

    def _told(self, most: int | None, most_points: int | None) -> WholeStrips | None:
        """So many stretches and points of what has been refined; the rest is published with the next updates."""
        if not self._orientation and not self._points:
            return None
        stretches, names = list(self._orientation)[:most], list(self._points)[:most_points]
        return WholeStrips([self._orientation.pop(s) for s in stretches], [self._points.pop(name) for name in names])

    def conclude(self) -> None:
        """Do what is left of the work: what comes now builds on it, or changes the equations that it reads."""
        self._advance(np.inf)

    def _advance(self, portion: float) -> float:
        """Do a portion of the work; returns what is left of the portion when the work is done."""
        for cost in self._work or ():
            portion -= cost
            if portion <= 0.0:
                return 0.0
        self._work = None
        return portion

    def _prepare(self, portion: float) -> None:
        """Do a portion of what the next strip may want to know of earlier ones."""
        if portion <= 0.0:
            return
        for cost in self._ahead or ():
            portion -= cost
            if portion <= 0.0:
                return
        self._ahead = None

    def _restate_shared(self) -> None:
        """Have sigmas of unknowns that all strips share count as they have been restated."""
        before, self._shared_sigma = self._shared_sigma, self._network.shared_sigma
        change = self._shared_sigma**-2.0 - before**-2.0
        if change.any():
            self._archive.add(self._network.shared_columns, np.diag(change), np.zeros(len(change)))

    def _begin_work(self, steps: list[Step], at_the_end: bool) -> None:
        self._restate_shared()
        self._archive.restate_constants(self._network.sigmas.apriori)
        archive, over = self._archive, self._archive.over
        new, self._new = self._new, []
        alone = [id for id in new if id not in archive.strips]
        if alone and steps:
            self._network.state.solve()
            chain = backward(steps, self._network.state)
            told = {name for name, kept in archive.points.items() if kept.single is None}
            points = [p for p in chain.points if p.name not in told]
            self._tell(WholeStrips([o for o in chain.orientation if o.strip in alone], points))
        steps.clear()
        if over and (archive.changed or at_the_end):
            wanted = over if at_the_end or not new else [id for id in new if id in over]
            self._work = self._refining(wanted, at_the_end)
        if self.earlier.full > self._full:
            self._full = self.earlier.full
            self.events.append(f"{self._full} points were seen in too many earlier strips at a time to tie all of them")

    def _refining(self, wanted: Sequence[str], at_the_end: bool) -> Parts:
        """Solve the block, refine strips, close the oldest if there are too many, prepare ties to them; in parts."""
        named = self.drifts
        strips = frozenset(self._archive.over)
        self._solved = self._ahead = None  # their memory is used again
        self.earlier.forget()
        solution = yield from self._archive.solving(named)
        self._solved = solution, strips
        closing = self._archive.beyond()
        for ids in (wanted, *([id] for id in closing)):
            self._tell((yield from self._archive.refining(solution, ids)))
        solution.factor.forget_selected()
        if not at_the_end:
            if gone := self._archive.thin_out():
                self.events.append(
                    f"the block has over {MOST_POINTS} points: {gone} tie no later strip, and stay as they are"
                )
            yield from self._archive.linearise_single(solution)
            self.earlier.learn(self._archive, solution, closing)
            self._ahead = self.earlier.preparing()
        for id in closing:
            if id not in self._archive.strips:  # closed with the one before it
                continue
            too_many = f"the block has over {BLOCK_UNKNOWNS} unknowns"
            if self._archive.is_closable([id], named):
                yield from self._archive.closing([id], named)
                self.events.append(f"strip {id} is refined no more: {too_many}")
            else:
                every = self._archive.over
                yield from self._archive.closing(every, named)
                self.events.append(f"strips {', '.join(every)} are refined no more: {too_many}; another one begins")

    def _tell(self, refined: WholeStrips) -> None:
        """Have something published: once, as it was refined last."""
        self._orientation |= {(o.strip, float(o.time_s[0])): o for o in refined.orientation}
        self._points |= {p.name: p for p in refined.points}
