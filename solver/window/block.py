"""The block a window flies over: what strips leave behind, when it is solved, and what a next strip is told.

When nothing of the strips flown so far is in the window any more, the block is solved with all that was kept
(`archive`); the strips that are over get the information of the block so far, and the next one meets them in
short form (`ties`).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from ..models.base import Design
from .archive import MOST_OF_STRIP, MOST_POINTS, MOST_UNKNOWNS, Archive, BlockSolution
from .backward import Step, backward
from .batch import Batch
from .points import ControlPoint
from .results import AdjustedPoint, RefinedOrientation, WholeStrips
from .state import WindowState
from .strip import WindowStrip
from .ties import EarlierStrips

Array = NDArray[np.floating]
IntArray = NDArray[np.int64]


class Block:
    """See the module.

    Attributes
    ----------
    earlier : what the strip that is flown knows of those before it
    events : lines for the operator since they were taken last
    """

    def __init__(
        self, state: WindowState, strips: dict[str, WindowStrip], camera_columns: IntArray, camera_sigma: Array
    ):
        self.earlier = EarlierStrips(state, camera_columns)
        self.events: list[str] = []
        self._archive = Archive(camera_columns, camera_sigma)
        self._state, self._strips = state, strips
        self._touched: set[str] = set()
        self._new: list[str] = []
        self._full = 0

    # -- what becomes known --------------------------------------------------------------------------------------------

    def begin(self, strip: WindowStrip) -> None:
        """A strip begins."""
        self._archive.begin_strip(strip.id, strip.numbers)

    def leave(self, batch: Batch, points: Sequence[AdjustedPoint]) -> None:
        """A batch became final, with the points it published."""
        names = list(self._strips)
        self._archive.leave(batch, points)
        self._touched.update(names[i] for i in batch.strips)

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
        if not self._archive.add_control(name, control):
            return
        over = set(self._new) | {s for s in self._archive.strips if len(self._archive.strips[s].entered)}
        if self.earlier.add_control(name, control):
            self.events.append(f"control {name} came after its point was final: it counts from now on")
        elif over:
            self.events.append(f"control {name} came after its point was final: it counts when the strip is over")

    def take_events(self) -> list[str]:
        """Lines for the operator since the last call."""
        events, self.events = self.events, []
        return events

    # -- when strips are over ------------------------------------------------------------------------------------------

    @property
    def quiet(self) -> bool:
        """Whether the window holds nothing of the block."""
        return not self._touched and not self.earlier.present

    def refined(self, steps: list[Step], at_the_end: bool) -> WholeStrips | None:
        """Strips that are over with the information of the block so far: those that are new, at the end all of them.

        Parameters
        ----------
        steps : what left the window, from which strips are refined that are no part of a block
        """
        if not (self._new or self._archive.changed or at_the_end) or not self.quiet:
            return None
        alone = [id for id in self._new if id not in self._archive.strips]
        late = not self._new
        over = [s.id for s in self._archive.strips.values() if len(s.entered)]
        parts = []
        if alone and steps:
            self._state.solve()
            chain = backward(steps, self._state)
            points = [p for p in chain.points if p.name not in self._archive.points]
            parts.append(WholeStrips([o for o in chain.orientation if o.strip in alone], points))
        if over and (self._archive.changed or at_the_end or set(self._new) & set(over)):
            solution = self._archive.solve()  # not kept: with all its cofactors it is the largest thing there is
            wanted = over if at_the_end or late else [id for id in self._new if id in over]
            parts.append(self._archive.whole(solution, wanted))
            parts += self._close_oldest(solution)
            if not at_the_end:
                self.earlier.learn(self._archive, solution)
        self._new = []
        if self.earlier.full > self._full:
            self._full = self.earlier.full
            self.events.append(f"{self._full} points were seen in too many earlier strips at a time to tie all of them")
        return _joined(parts)

    def _close_oldest(self, solution: BlockSolution) -> Iterable[WholeStrips]:
        """Keep the bounds; strips that are closed are refined a last time."""
        while (id := self._archive.oldest_beyond()) is not None:
            yield self._archive.whole(solution, [id])
            self._archive.close(id)
            self.events.append(
                f"strip {id} is refined no more: the block has over {MOST_UNKNOWNS} unknowns or {MOST_POINTS} points"
            )


def _joined(parts: Sequence[WholeStrips]) -> WholeStrips | None:
    """Several results as one; a point counts once, as it was given last."""
    if not parts:
        return None
    points = {p.name: p for part in parts for p in part.points}
    return WholeStrips([o for part in parts for o in part.orientation], list(points.values()))
