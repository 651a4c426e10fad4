"""Looks that find no partner in their strip: they say nothing of it, but a later strip may see their point again.

Before the unknowns of their time leave the window they are linearised, and kept for the block (`archive`).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np
from numpy.typing import NDArray

from ..measured_trajectory import MeasuredTrajectory
from .batch import Batch
from .batches import Batches
from .block import Block
from .intake import Intake
from .points import BatchMaker
from .results import Refusal
from .state import WindowState
from .strip import WindowStrip
from .watch import Watch

Array = NDArray[np.floating]

#: Time between two looks for looks that wait in vain, s, unless unknowns leave.
EVERY_S = 1.0
#: Looks that are kept together.
TOGETHER = 12
#: Batches whose points say about how far away the ground is.
ASKED = 32


class SingleLooks:
    """Gives up waiting, and keeps what can be kept."""

    def __init__(
        self,
        state: WindowState,
        strips: Mapping[str, WindowStrip],
        trajectory: MeasuredTrajectory,
        intake: Intake,
        maker: BatchMaker,
        batches: Batches,
        block: Block,
        watch: Watch,
    ) -> None:
        self._state, self._strips, self._trajectory, self._intake = state, strips, trajectory, intake
        self._maker, self._batches, self._block, self._watch = maker, batches, block, watch
        self._looked_s = -np.inf

    def leave(self, now_s: float, limits_s: Mapping[str, float], at_once: bool) -> list[Refusal]:
        """Looks older than the limits of their strips leave, now and then; told as refused: their strip has no use for
        them.

        Parameters
        ----------
        limits_s : by strip
        at_once : unknowns are about to leave
        """
        if not at_once and now_s < self._looked_s + EVERY_S:
            return []
        self._looked_s = now_s
        names = self._intake.without_partner(limits_s)
        by_strip: dict[str, list[str]] = {}
        for name in names:
            point = self._intake.points[name]
            if len(point.looks) == 1 and not point.alone and self._trajectory.covers(point.time_s)[0]:
                by_strip.setdefault(point.looks[0].strip, []).append(name)
        for id, single in by_strip.items():
            for begin in range(0, len(single), TOGETHER):
                self._keep(self._strips[id], single[begin : begin + TOGETHER])
        return self._intake.give_up(names)

    def _keep(self, strip: WindowStrip, names: list[str]) -> None:
        """Keep looks of a strip, if its unknowns are there and ground is known near it."""
        index = list(self._strips).index(strip.id)
        ground = [b for b in self._batches if index in b.strips]
        points = [self._intake.points[name] for name in names]
        times = [p.time_s[0] for p in points]
        if not ground or strip.is_gone(self._state) or (self._state.places(_needed(strip, times)) < 0).any():
            return
        ground.sort(key=lambda b: abs(b.oldest_s - times[0]))
        near = _placed(ground[:ASKED])
        batch = self._maker.make_single(names, points, near) if len(near) else None
        if batch is not None:
            looks = [p.looks[0] for p in points]
            self._block.keep_single(batch, looks, self._watch.cell_of_single(batch))


def _needed(strip: WindowStrip, times: list[float]) -> NDArray[np.int64]:
    numbers = np.unique(strip.design(times).columns)
    return numbers[numbers >= 0].astype(np.int64)


def _placed(batches: Iterable[Batch]) -> Array:
    """The points (m, 3) of batches that have a place."""
    return np.concatenate([b.points_l[b.normals.rank == 3] for b in batches])
