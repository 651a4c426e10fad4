"""What has arrived becomes batches: points all of whose looks have an orientation, judged at the door."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from ..camera import LineCamera
from .batch import Batch
from .batches import Batches
from .block import Block
from .intake import Intake
from .points import BatchMaker, Draft
from .results import WindowUpdate
from .snooping import admit
from .state import WindowState
from .tie_snooping import admit_ties, drop_weak

Array = NDArray[np.floating]


class Arrivals:
    """Makes batches of the points that have news.

    Parameters
    ----------
    step_s : points whose first looks lie within so much time go into a batch together
    snoop : whether looks are judged at the door
    dropped : told of a batch that is taken apart, because one of its points got another look
    """

    def __init__(
        self,
        batches: Batches,
        state: WindowState,
        maker: BatchMaker,
        intake: Intake,
        block: Block,
        step_s: float,
        snoop: bool,
        dropped: Callable[[Batch], None],
    ) -> None:
        self._batches, self._state, self._maker = batches, state, maker
        self._intake, self._block = intake, block
        self._step_s, self._snoop, self._dropped = step_s, snoop, dropped

    def take(self, now_s: float, result: WindowUpdate) -> list[Batch]:
        """Batches of the points that have new looks with a measured orientation; others wait."""
        ready: dict[tuple[int, bool], list[str]] = {}
        again: list[Batch] = []
        names = self._intake.ready(now_s)
        if names:
            self._block.conclude()  # points are about to be looked up among those of earlier strips
        for name in names:
            point = self._intake.points[name]
            if point.batch is not None:
                again.append(point.batch)
                continue
            if point.looks:
                ready.setdefault(self._share(name), []).append(name)
        known: dict[str, Array] = {}
        for batch in {id(b): b for b in again}.values():
            known |= dict(zip(batch.names, batch.points_l, strict=True))
            self._batches.remove(batch)
            self._dropped(batch)
            for name in batch.names:
                self._intake.place(name, None)
                ready.setdefault(self._share(name), []).append(name)
        if ready:  # what is known of the orientation says where points are, and judges them
            self._state.solve()
        drafts = []
        for (_, tied), names in ready.items():
            few = [n for n in names if len(self._intake.points[n].looks) < 2 and not tied]
            few = [n for n in few if n not in self._intake.control or self._intake.points[n].spent]
            names = [n for n in names if n not in few]
            if names:
                points = [self._intake.points[n] for n in names]
                drafts.append(Draft(names, points, self._block.earlier if tied else None))
        fresh = [batch for batch, _ in self._maker.make_each(drafts, known) if batch is not None]
        for batch in fresh:
            for name in batch.names:
                self._intake.place(name, batch)
            drop_weak(batch)
        if self._snoop:
            self._state.expect(sum(len(batch.columns) for batch in fresh))
            for batch in fresh:
                result.refused += admit(batch, self._state, self._intake.points)
                self.apart(admit_ties(batch, self._state), result)
        for batch in fresh:
            self._batches.enter(batch)
        return fresh

    def _share(self, name: str) -> tuple[int, bool]:
        """Which points go into a batch together: those of a time, and those that tie strips apart."""
        point, earlier = self._intake.points[name], self._block.earlier.points.get(name)
        point.spent = earlier is not None and earlier.with_control and not point.alone
        tied = not point.alone and self._block.earlier.enter(name, max(point.time_s))
        return int(min(point.time_s) // self._step_s), tied

    def apart(self, names: list[str], result: WindowUpdate) -> None:
        """Points that do not agree with earlier strips are points of their own."""
        for name in names:
            self._intake.points[name].alone, self._intake.points[name].spent = True, False
        if names:
            result.events.append(f"do not agree with earlier strips: {', '.join(names)}")


def look_time(camera: LineCamera, batch: Batch) -> float:
    """Time between the first and the last look at a point, from view angles, height and speed."""
    rays = batch.rays
    tangent = np.array([line.centre_mm[0] for line in camera.lines]) - camera.principal_point_mm[:, 0]
    tangent = tangent / camera.focal_length_mm
    height = float(np.median(rays.position_l[:, 2] - batch.points_l[rays.point, 2]))
    speed = float(np.median(np.linalg.norm(rays.velocity_l, axis=1)))
    return float(np.ptp(tangent)) * height / max(speed, 1.0)
