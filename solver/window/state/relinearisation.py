"""Batches follow what becomes known: smoothed orientation, and unknowns that move on since they were linearised."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import chain

import numpy as np

from ...camera.line_camera import finest_pixel
from .batch import Batch
from .maker import BatchMaker, Draft
from .network import LiveNetwork

#: Change of a correction, rad, and m for each metre of flying height, beyond which a batch is linearised again. What
#: the linear equations then miss goes with its square: two hundredths of a pixel.
MOVED = 1.5e-3
#: For finer pixels, from orbit, it is less: no more of a pixel is missed. Derived from the usual ones of 1e-4 rad.
MISSED_PX = 0.022
#: Every so many turns it is looked whether a batch has moved, if new data did not move far.
LOOKED_AFTER = 16
#: So many batches at most are linearised again in one turn. Where new data moved far, or weights have changed, so many
#: rays, the oldest first, which leave first, the others in the turns after it: by platform time, and so many at least.
MOST_AGAIN = 6
AGAIN_HZ, LEAST_AGAIN = 4000.0, 400
REWEIGHED_HZ, LEAST_REWEIGHED = 2000.0, 200
#: Rays that get their smoothed orientation in one update, about, or half of those that wait; the others in the next.
MOST_REPLACED = 600
#: Batches of one time are joined up to so many rays when they get their smoothed orientation. None waits for others: of
#: two batches of one time, one with filtered and one with smoothed orientation, good rays would fail their tests.
JOINED_RAYS = 160


class Relinearisation:
    """Keeps the batches where the window is.

    Parameters
    ----------
    step_s : points whose first looks lie within so much time go into a batch together
    """

    def __init__(self, network: LiveNetwork, step_s: float) -> None:
        self._network, self._maker, self._step_s = network, BatchMaker(network), step_s
        self._moved = min(MOVED, float(np.sqrt(MISSED_PX * finest_pixel(network.camera))))
        self._suspects: dict[int, Batch] = {}  # batches that may have moved, by id, the oldest first
        self._pace: tuple[int, float] | None = None  # of what was left when new data moved far, or weights changed
        self._turn = 0
        self._looked_s = -np.inf
        self._passed_s = 0.0  # between the last two turns

    # -- smoothed orientation ------------------------------------------------------------------------------------------

    def replace_filtered(self, all_at_once: bool = False) -> list[Batch]:
        """Put smoothed orientation under batches that had to do with the filtered one, the oldest first.

        Small ones are joined then, so that a window into which rays come a few at a time costs no more than others;
        returns the batches that came about that way.

        Parameters
        ----------
        all_at_once : however many they are
        """
        smoothed_s = self._network.trajectory.smoothed_to_s
        due = [b for b in self._network.batches.provisional() if b.newest_s <= smoothed_s]
        number = sum(len(b.rays) for b in due)
        alone: list[Batch] = []
        groups: dict[int, list[list[Batch]]] = {}
        rays = 0
        for batch in due:
            if rays > max(MOST_REPLACED, number // 2) and not all_at_once:
                break
            rays += len(batch.rays)
            if batch.ties is not None:
                alone.append(batch)
                continue
            chunks = groups.setdefault(int(batch.oldest_s // self._step_s), [[]])
            if sum(len(b.rays) for b in chunks[-1]) + len(batch.rays) > JOINED_RAYS:
                chunks.append([])
            chunks[-1].append(batch)
        joined: list[Batch] = []
        for chunk in chain.from_iterable(groups.values()):
            if len(chunk) > 1:
                joined.append(self._join(chunk))
            else:
                alone += chunk
        if alone:
            self._maker.refresh(alone)
            for batch in alone:
                self._network.batches.linearise(batch, self._network.state.values(batch.columns), reweigh=True)
        for batch in (*alone, *joined):
            batch.provisional = False  # in a gap of the smoothed poses it stays with the filtered ones
        return joined

    def _join(self, parts: Sequence[Batch]) -> Batch:
        """One batch in place of several."""
        known = {name: xyz for b in parts for name, xyz in zip(b.names, b.points_l, strict=True)}
        names = list(known)
        joined = self._maker.make(Draft(names, [self._network.intake.points[name] for name in names]), known)
        assert joined is not None and joined.names == names
        joined.tested = min(b.tested for b in parts)
        for batch in parts:
            self._network.batches.remove(batch)
        self._network.batches.enter(joined)
        for name in names:
            self._network.intake.place(name, joined)
        return joined

    # -- what has moved ------------------------------------------------------------------------------------------------

    def look_after(self, now_s: float) -> None:
        """Linearise again what has moved, in turn; before the solution, for which it then counts."""
        self._passed_s, self._looked_s = now_s - self._looked_s, now_s
        if not self._suspects:
            self._pace = None
            self._turn += 1
            turn = list(self._network.batches)[self._turn % LOOKED_AFTER :: LOOKED_AFTER]
            self._suspects = {id(b): b for b in turn}
        self._again(self._pace)

    def reweigh(self) -> None:
        """Other noise of poses has become known: all batches are linearised again, the oldest first."""
        self._suspects = {id(b): b for b in self._network.batches}
        self._pace = self._pace or (LEAST_REWEIGHED, REWEIGHED_HZ)
        self._again((LEAST_REWEIGHED, REWEIGHED_HZ))

    def follow(self, fresh: list[Batch]) -> bool:
        """After a solution, linearise again new batches that have moved far; whether there were any.

        Where unknowns have, all other batches are looked after, too.
        """
        values = [self._network.state.values(batch.columns) for batch in fresh]
        far = any(b.has_moved(theta, self._moved) for b, theta in zip(fresh, values, strict=True))
        due = [(b, t) for b, t in zip(fresh, values, strict=True) if far or b.points_moved() > self._moved * b.height_m]
        for batch, theta in due:
            self._network.batches.linearise(batch, theta, reweigh=True)  # rays were fitted to where points were
        if far:
            new = {id(b) for b in fresh}
            self._suspects = {id(b): b for b in self._network.batches if id(b) not in new}
            self._pace = LEAST_AGAIN, AGAIN_HZ
            self._again(self._pace)
        return bool(due)

    def _again(self, pace: tuple[int, float] | None) -> None:
        """Linearise suspects again that have moved, up to so many rays, at least and a second; None: some batches."""
        rays = batches = 0
        most_rays = max(pace[0], pace[1] * self._passed_s) if pace else 0.0
        for key, batch in list(self._suspects.items()):
            if rays > most_rays if most_rays else batches >= MOST_AGAIN:
                break
            del self._suspects[key]
            if batch not in self._network.batches:
                continue
            theta = self._network.state.values(batch.columns)
            reweigh = batch.noise_version != self._network.noise_version
            if reweigh or batch.has_moved(theta, self._moved):
                if reweigh:
                    self._maker.refresh([batch])
                batch.back_substitute(theta)
                self._network.batches.linearise(batch, theta, reweigh=reweigh)
                batches += 1
                rays += len(batch.rays)
