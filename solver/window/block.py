"""The block a window flies over: what strips leave behind, when it is solved, and what a next strip is told.

When nothing of the strips flown so far is in the window any more, the block is solved with all that was kept
(`archive`); the strips that are over get the information of the block so far, and the next one meets them in
short form (`ties`). That is work of seconds, and a turn takes a minute: it is done in portions, one with each update,
as large as the platform time since the one before. What is left when a next strip brings points is done before they
are looked up.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from ..models.base import Design
from .archive import MOST_OF_STRIP, MOST_POINTS, MOST_UNKNOWNS, Archive
from .backward import Step, backward
from .batch import Batch
from .block_solution import Parts
from .compensation import Named
from .drift_border import Cell
from .points import ControlPoint
from .results import AdjustedPoint, Look, RefinedOrientation, Refusal, WholeStrips
from .state import WindowState
from .strip import WindowStrip
from .ties import EarlierStrips

Array = NDArray[np.floating]
IntArray = NDArray[np.int64]

#: Operations of the work on the block for each second of platform time: about a tenth of a core.
RATE = 4e9
#: The first portion is that of so long, s.
FIRST_PORTION_S = 0.2
#: Of what has been refined, stretches of orientation (of seconds) that are told with one update, and points with each.
MOST_TOLD, POINTS_TOLD = 8, 40


class Block:
    """See the module.

    Attributes
    ----------
    earlier : what the strip that is flown knows of those before it
    events : lines for the operator since they were taken last
    drifts : says in which strips tie points drift
    """

    def __init__(
        self, state: WindowState, strips: dict[str, WindowStrip], camera_columns: IntArray, camera_sigma: Array
    ):
        self.earlier = EarlierStrips(state, camera_columns)
        self.events: list[str] = []
        self.drifts: Callable[[], list[Named]] = list
        self._archive = Archive(camera_columns, camera_sigma)
        self._state, self._strips = state, strips
        self._touched: set[str] = set()
        self._new: list[str] = []
        self._full = 0
        self._work: Parts | None = None
        self._worked_s = -np.inf
        self._orientation: dict[tuple[str, float], RefinedOrientation] = {}
        self._points: dict[str, AdjustedPoint] = {}

    # -- what becomes known --------------------------------------------------------------------------------------------

    def begin(self, strip: WindowStrip) -> None:
        """A strip begins."""
        self._archive.begin_strip(strip.id, strip.numbers)

    def leave(self, batch: Batch, points: Sequence[AdjustedPoint], cell: Cell | None) -> list[Refusal]:
        """A batch became final, with the points it published; ``cell``: what drifts have to do with it.

        Returns the single looks of earlier strips that count now.
        """
        self.conclude()
        names = list(self._strips)
        self._touched.update(names[i] for i in batch.strips)
        return self._archive.leave(batch, points, cell)

    def keep_single(self, batch: Batch, looks: Sequence[Look], cell: Cell | None) -> None:
        """Keep looks that found no partner in their strip, a batch of one each."""
        self.conclude()
        self._touched.update(look.strip for look in looks)
        self._archive.keep_single(batch, looks, cell)

    def orientation(self, strip: WindowStrip, final: RefinedOrientation, design: Design, noise: Array) -> None:
        """Orientation that became final."""
        kept = self._archive.strips.get(strip.id)
        if kept is None:
            return
        kept.orientation.append((final, design, noise))
        if len(strip.entered) > MOST_OF_STRIP:
            self._archive.drop(strip.id)
            self.events.append(
                f"strip {strip.id} has more than {MOST_OF_STRIP} unknowns: it is refined alone, and ties no others"
            )

    def gone(self, strip: WindowStrip) -> None:
        """Nothing of a strip is left in the window."""
        self._touched.discard(strip.id)
        kept = self._archive.strips.get(strip.id)
        if kept is not None:
            kept.prior, kept.entered = strip.apriori(), strip.entered
        self._new.append(strip.id)

    def add_control(self, name: str, control: ControlPoint) -> None:
        """Known coordinates, perhaps of a point that is final already."""
        self.conclude()
        if not self._archive.add_control(name, control):
            return
        over = set(self._new) | {s for s in self._archive.strips if len(self._archive.strips[s].entered)}
        if self.earlier.add_control(name, control):
            self.events.append(f"control {name} came after its point was final: it counts from now on")
        elif over:
            self.events.append(f"control {name} came after its point was final: it counts when the strip is over")

    def weigh_control(self, name: str, axis: int, weight: float, value: float) -> None:
        """Give a known coordinate of a point that is final another weight, 0 to refuse it."""
        self._archive.weigh_control(name, axis, weight, value)

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
        now_s : the portion of the work is as large as the time since the one before
        steps : what left the window, from which strips are refined that are no part of a block; emptied when work
            begins
        """
        if at_the_end:
            self.conclude()
        if self._work is None and self.quiet and (self._new or self._archive.changed or at_the_end):
            self._begin_work(steps, at_the_end)
            self._worked_s = now_s - FIRST_PORTION_S
        if self._work is not None:
            self._advance(np.inf if at_the_end else RATE * (now_s - self._worked_s))
            self._worked_s = now_s
        return self._told(np.inf if at_the_end else MOST_TOLD)

    def _told(self, most: float) -> WholeStrips | None:
        """What has been refined, some of it now and the rest with the next updates: it goes out as many messages."""
        if not self._orientation and not self._points:
            return None
        stretches = list(islice(self._orientation, int(min(most, len(self._orientation)))))
        names = list(islice(self._points, int(min(POINTS_TOLD * most, len(self._points)))))
        return WholeStrips([self._orientation.pop(s) for s in stretches], [self._points.pop(name) for name in names])

    def conclude(self) -> None:
        """Do what is left of the work: what comes now builds on it."""
        self._advance(np.inf)

    def _advance(self, portion: float) -> None:
        while self._work is not None and portion > 0:
            cost = next(self._work, None)
            if cost is None:
                self._work = None
            else:
                portion -= cost

    def _begin_work(self, steps: list[Step], at_the_end: bool) -> None:
        alone = [id for id in self._new if id not in self._archive.strips]
        over = [s.id for s in self._archive.strips.values() if len(s.entered)]
        new, self._new = self._new, []
        if alone and steps:
            self._state.solve()
            chain = backward(steps, self._state)
            told = {name for name, kept in self._archive.points.items() if kept.single is None}
            points = [p for p in chain.points if p.name not in told]
            self._tell(WholeStrips([o for o in chain.orientation if o.strip in alone], points))
        steps.clear()
        if over and (self._archive.changed or at_the_end or set(new) & set(over)):
            wanted = over if at_the_end or not new else [id for id in new if id in over]
            self._work = self._refining(wanted, at_the_end)
        if self.earlier.full > self._full:
            self._full = self.earlier.full
            self.events.append(f"{self._full} points were seen in too many earlier strips at a time to tie all of them")

    def _refining(self, wanted: Sequence[str], at_the_end: bool) -> Parts:
        """Solve the block, refine strips, close the oldest if there are too many, tell the next one; in parts."""
        solution = yield from self._archive.solving()
        named = self.drifts()
        solution = self._archive.without(named, solution)
        closing = self._archive.beyond()
        for ids in (wanted, *([id] for id in closing)):
            self._tell((yield from self._archive.refining(solution, ids)))
        if not at_the_end:
            yield from self._archive.linearise_single(solution)
            yield from self.earlier.learning(self._archive, solution, closing)
        for id in closing:
            yield from self._archive.closing(id, named)
            self.events.append(
                f"strip {id} is refined no more: the block has over {MOST_UNKNOWNS} unknowns or {MOST_POINTS} points"
            )

    def _tell(self, refined: WholeStrips) -> None:
        """Have something told; once, as it was refined last."""
        self._orientation |= {(o.strip, float(o.time_s[0])): o for o in refined.orientation}
        self._points |= {p.name: p for p in refined.points}
