"""What has arrived becomes batches: points all of whose looks have an orientation, tested before they enter."""

from __future__ import annotations

import numpy as np

from ...arrays import Array
from ...camera.line_camera import LineCamera
from ..block.block import Block
from ..results import Update
from ..state.batch import Batch
from ..state.maker import BatchMaker, Draft
from ..state.network import LiveNetwork
from .disagreement import Disagreement
from .entry import EntryEquations, JudgedLooks, disagreement
from .first_ground import FirstGround
from .snooping import admit
from .ties import ON_ENTRY, contradicting, drop_weak, meet, set_apart

#: Window of a camera with one view, s: its points hang on other strips and on control, for which no window waits long
#: enough. Tuned: with 10, 20 and 40 s whole points are the same as long as all of them tie; a longer one makes updates
#: slower and final orientation later, and meets so much of the strips beside it at a time that not all points tie.
SINGLE_VIEW_WINDOW_S = 10.0


class Arrivals:
    """Makes batches of the points that have news.

    Parameters
    ----------
    step_s : points whose first looks lie within so much time go into a batch together
    snoop : whether looks are tested before they enter
    """

    def __init__(self, network: LiveNetwork, block: Block, newest: Disagreement, step_s: float, snoop: bool) -> None:
        self._network, self._block, self._newest, self._maker = network, block, newest, BatchMaker(network)
        self._step_s, self._snoop = step_s, snoop
        self._first_ground = FirstGround(network, block, self._maker)

    def take(self, update: Update) -> list[Batch]:
        """Batches of the points that have new looks with a measured orientation; others wait."""
        network, intake = self._network, self._network.intake
        news = {name: intake.points[name] for name in intake.ready(update.now_s)}
        if not news:
            return []
        self._block.conclude()  # points are about to be looked up among those of earlier strips
        names = [name for name, point in news.items() if point.batch is None and point.looks]
        if self._block.groundless:
            names = list(dict.fromkeys(names + self._first_ground.look()))
        known: dict[str, Array] = {}
        for batch in {id(p.batch): p.batch for p in news.values() if p.batch is not None}.values():
            known |= dict(zip(batch.names, batch.points_l, strict=True))
            network.batches.remove(batch)
            for name in batch.names:
                intake.place(name, None)
            names += batch.names
        if not names:
            return []
        shares: dict[tuple[int, bool], list[str]] = {}
        for name in names:
            shares.setdefault(self._share(name), []).append(name)
        network.state.solve()  # what is known of the orientation says where points are, and judges them
        drafts = [self._draft(names, tied) for (_, tied), names in shares.items()]
        made = self._maker.make_each([d for d in drafts if d.names], known)
        fresh = [batch for batch in made if batch is not None]
        for batch in fresh:
            for name in batch.names:
                intake.place(name, batch)
            drop_weak(batch)
            meet(batch, network.state)
        if self._snoop:
            network.state.expect([batch.columns for batch in fresh])
            equations = [EntryEquations.of(batch, network.state) for batch in fresh]
            self._newest.entered(
                (point for of_batch in equations for point in disagreement(of_batch)),
                [JudgedLooks.of(batch, of_batch) for batch, of_batch in zip(fresh, equations, strict=True)],
            )
            for batch, of_batch in zip(fresh, equations, strict=True):
                update.refused += admit(batch, of_batch, network)
                set_apart(batch, contradicting(batch, network.state, ON_ENTRY), network, update)
        for batch in fresh:
            network.batches.enter(batch)
        return fresh

    def _draft(self, names: list[str], tied: bool) -> Draft:
        """Of the points of a share, those that two looks, known coordinates or an earlier strip place."""
        intake, points = self._network.intake, self._network.intake.points
        ties = None
        if tied:
            weight = intake.known_coordinates(names, np.zeros(len(names), dtype=bool)).weight
            ties = self._block.earlier.ties(names, weight)
        else:
            names = [n for n in names if len(points[n].looks) > 1 or (n in intake.control and not points[n].spent)]
        return Draft(names, [points[n] for n in names], ties)

    def _share(self, name: str) -> tuple[int, bool]:
        """Which points go into a batch together: those of a time, and those that tie strips apart."""
        point = self._network.intake.points[name]
        point.spent = self._block.earlier.has_control(name) and not point.alone
        tied = not point.alone and self._block.earlier.enter(name, max(point.time_s))
        return int(min(point.time_s) // self._step_s), tied


def usual_length(camera: LineCamera, batch: Batch, looks: float) -> float:
    """Length of the window, s: so many times the time between the first and the last look at a point, from view angles,
    height and speed. For a camera with several views."""
    base = float(np.ptp(camera.ahead_mm / camera.focal_length_mm))
    height = float(np.median(batch.rays.position_l[:, 2] - batch.points_l[batch.rays.point, 2]))
    speed = float(np.median(np.linalg.norm(batch.rays.velocity_l, axis=1)))
    return looks * base * height / max(speed, 1.0)
