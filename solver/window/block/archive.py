"""The normal equations of the strips flown so far, kept after they have left the window.

The window lets go of unknowns by marginalisation, one strip at a time. So that a later strip can still tell an earlier
one something, the information of every batch that became final is kept here a second time, before marginalisation: the
normal equations of all strips, and for every object point its coordinates as a function of the unknowns that its
rays touched (`LeftPoints`). A point that is seen again in a later strip thus ties both, and its earlier looks are never
counted twice. Drifts of tie points are unknowns as well, held at zero until they are named (`datum.drifts`). A solution
of the whole gives every line and every point the information of the block: it is the backward pass for several strips.
"""

from __future__ import annotations

from collections.abc import Collection, Generator, Iterable, Sequence
from dataclasses import dataclass, field, replace
from zlib import crc32

import numpy as np

from ...adjustment.drift_hypotheses import EACH
from ...adjustment.eliminated_points import eliminated
from ...adjustment.growing_normals import BlockNormals
from ...adjustment.in_parts import Cost, Parts
from ...adjustment.normal_equations import whiten_prior
from ...arrays import Array, IntArray
from ...models.base import PseudoObservations
from ..datum.drifts import MOST_GROUPS, Cell, Named, of_block
from ..results import TAKEN_BACK, AdjustedPoint, Look, Refusal, Update, WholeStrips, checks
from ..state.batch import Batch
from ..state.points import ControlPoint
from ..state.strip import StatedConstants, WindowStrip
from .backward import LeftOrientation, LeftPoints
from .points import KeptPoint, SingleLook, rows_of
from .solution import BlockSolution

#: Unknowns of the strips kept together, about half an hour of strips; beyond that the oldest strip is refined no more.
#: Tuned by memory: with 20 000 the adjuster has peaks of 1.9 GB (`bench/long_flight.py`).
BLOCK_UNKNOWNS = 12000
#: Unknowns of one strip, at most, for it to be part of a block: about 25 minutes. Two of them are still solved
#: together when the second is over; then the first one is closed. Tuned.
MOST_OF_STRIP = 10000
#: Unknowns that a strip which is closed may have met, at most: what it says of them is a full matrix, in all solutions
#: from then on. Where one has met more all strips are closed, which leave what they say of the camera and of the
#: platform. Tuned: a matrix of 200 MB.
MOST_MET = 5000
#: A-priori equations of a strip that are added to those of the block at a time: all unknowns of a long strip as one
#: dense matrix would be 60 MB, several times over.
PRIOR_TOGETHER = 120
#: Cost of refining a second or so of orientation, and the points of a batch, in floating point operations, about.
REFINED_ORIENTATION, REFINED_POINTS = 4e7, 8e6
#: Object points kept, and single looks beside them, which are thinned out beyond that; all control is kept. They bound
#: the memory: a single look takes 20 kB. Tuned.
MOST_POINTS, MOST_SINGLE = 30000, 6000
#: Condition number of its normal matrix up to which a point counts as placed; rounding spoils what is beyond.
PLACED = 1e12


@dataclass
class KeptStrip:
    """A strip of the block.

    Attributes
    ----------
    index : its place among the strips of the flight
    numbers : of all its unknowns, consecutive
    entered : numbers of those that were ever needed; none until nothing of the strip is left in the window
    orientation : what became final of it
    constants : what was known beforehand of its offset, shift and drift; None until nothing of it is left in the window
    """

    index: int
    numbers: IntArray
    entered: IntArray = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    orientation: list[LeftOrientation] = field(default_factory=list)
    constants: StatedConstants | None = None


class Archive:
    """The strips of a block that are over or being flown; see the module.

    Parameters
    ----------
    shared_columns : (m,) numbers of the unknowns that all strips share
    shared_sigma : (m,) a priori

    Attributes
    ----------
    strips, points : by name, oldest first
    unplaced : names of single looks whose points were not about known when they were kept (`KeptPoint.unplaced`)
    changed : whether information was added since the last solution
    """

    def __init__(self, shared_columns: IntArray, shared_sigma: Array):
        self.strips: dict[str, KeptStrip] = {}
        self.points: dict[str, KeptPoint] = {}
        self.unplaced: set[str] = set()
        self._shared = shared_columns
        self._normals = BlockNormals()
        n = len(shared_columns)
        self._shared_known = np.zeros((n, n)), np.zeros(n)  # beforehand
        self.add(shared_columns, np.diag(shared_sigma**-2.0), np.zeros(len(shared_columns)))
        self.changed = False

    def holds(self, columns: IntArray) -> bool:
        """Whether all these unknowns are kept; drifts (negative numbers) are."""
        kept = columns < 0
        for strip in self.strips.values():
            if len(strip.numbers):
                kept |= (columns >= strip.numbers[0]) & (columns <= strip.numbers[-1])
        return bool(kept.all()) or bool(np.isin(columns[~kept], self._shared).all())

    @property
    def over(self) -> list[str]:
        """Strips of which nothing is left in the window."""
        return [id for id, strip in self.strips.items() if len(strip.entered)]

    # -- what becomes final --------------------------------------------------------------------------------------------

    def add(self, columns: IntArray, matrix: Array, rhs: Array) -> None:
        """Add information (u, u), (u,) about unknowns (u,); without effect if some are kept no more."""
        if self.holds(columns):
            self.changed = True
            self._normals.add(columns, matrix, rhs)
            if np.isin(columns, self._shared).all():
                at = np.nonzero(columns[:, None] == self._shared)[1]
                self._shared_known[0][np.ix_(at, at)] += matrix
                self._shared_known[1][at] += rhs

    def end_strip(self, strip: WindowStrip) -> None:
        """Nothing of a strip is left in the window: its unknowns, with their a-priori equations, are all known."""
        kept = self.strips.get(strip.id)
        if kept is not None:
            kept.entered, kept.constants = strip.entered, strip.constants()
            columns, coefficients, value, sigma = strip.apriori()
            for begin in range(0, len(columns), PRIOR_TOGETHER):
                rows = slice(begin, begin + PRIOR_TOGETHER)
                numbers = np.unique(columns[rows][columns[rows] >= 0]).astype(np.int64)
                places = np.where(columns[rows] >= 0, np.searchsorted(numbers, columns[rows]), -1).astype(np.int32)
                stated = PseudoObservations(places, coefficients[rows], value[rows], sigma[rows], ())
                prior = whiten_prior(stated, len(numbers))
                self.add(numbers, prior.normal.toarray(), prior.matrix.T @ prior.value)

    def restate_constants(self, factor: Array) -> None:
        """State offset, shift and drift of the strips that are over with factors (4,) that later ones have shown, where
        these are larger than their own.

        One strip alone often fits a boresight or a datum that is far beyond its sigma, and a later one with another
        heading contradicts it. The earlier one was measured with the same instruments.
        """
        for kept in self.strips.values():
            found = None if kept.constants is None else kept.constants.restated(factor)
            if found is not None:
                kept.constants, numbers, matrix, rhs = found
                self.add(numbers, matrix, rhs)

    def leave(self, batch: Batch, left: LeftPoints, cell: Cell | None, update: Update) -> None:
        """A batch became final; single looks of earlier strips that count now are told.

        Points that tie strips come in batches of their own (`Batch.ties`). Theirs is the information of the new rays
        and of the earlier strip's coordinates, with all unknowns of that strip instead of the modes that stood for it.
        Where both contradict each other the point is where more looks say that it is.

        Parameters
        ----------
        left : its points, those of full rank
        cell : equations of the drifts of its strip, None if there are none
        """
        if not self.holds(batch.columns[: len(batch.columns) - batch.n_tied]):
            return
        placed = np.flatnonzero(batch.normals.rank == 3)
        if batch.ties is not None:
            for i, point in zip(placed.tolist(), left.points, strict=True):
                self._tie(batch, i, point, cell, update)
            return
        columns, matrix, rhs = batch.columns, batch.information.matrix, batch.information.rhs
        if cell is not None:
            b = cell.border
            matrix, rhs = np.block([[matrix, b.G], [b.G.T, b.H]]), np.concatenate([rhs, b.r])
            columns = np.concatenate([columns, cell.of_block])
            coupling = np.concatenate([left.functions.coupling, cell.coupling[placed]], axis=2)
            left = LeftPoints(replace(left.functions, columns=columns, coupling=coupling), left.points)
        self.add(columns, matrix, rhs)
        time_s = np.add.reduceat(batch.rays.time_s, batch.first_ray[:-1]) / np.diff(batch.first_ray)
        for i, (at, point) in enumerate(zip(placed.tolist(), left.points, strict=True)):
            seen = frozenset(r.look.strip for r in point.residuals)
            known = batch.control.weight[at], batch.control.xyz_l[at]
            self._keep(point.name, KeptPoint(left, i, seen, float(time_s[at]), *known))

    def keep_single(self, batch: Batch, looks: Sequence[Look], cell: Cell | None, unplaced: bool) -> None:
        """Keep looks that found no partner in their strip: a batch of points with one each.

        Parameters
        ----------
        unplaced : nobody knows yet how far away their points are; see `place_single`
        """
        for i, look in enumerate(looks if self.holds(batch.columns) else ()):
            name = batch.names[i]
            if name in self.points and self.points[name].single is None:
                continue
            single = SingleLook(batch, i, look, cell)
            seen, time_s = frozenset((look.strip,)), float(batch.rays.time_s[i])
            if (left := single.left()) is not None:
                self._keep(name, KeptPoint(left, 0, seen, time_s, np.zeros(3), np.zeros(3), single, unplaced))
                if unplaced:
                    self.unplaced.add(name)

    def place_single(self, height_m: float) -> None:
        """Linearise the looks that are not placed where their rays come to the height of the ground; those whose rays
        do not are forgotten."""
        for name in sorted(self.unplaced):
            kept = self.points.get(name)
            if kept is None or kept.single is None or not kept.unplaced:
                continue
            place_l = kept.single.place_above(height_m)
            left = None if place_l is None else kept.single.left(place_l)
            if left is None:
                del self.points[name]
            else:
                self.points[name] = replace(kept, left=left, unplaced=False)
        self.unplaced.clear()

    def thin_out(self) -> int:
        """Forget some of too many points and single looks; returns how many points that were published.

        They go evenly over the flight, so that those of each strip are left to strips that cross it later: batch by
        batch, which looks share, and of all that ever came the same share, by a number that a batch has once and for
        all. What points that are forgotten said of the orientation stays.
        """
        single = [name for name, kept in self.points.items() if kept.single is not None]
        placed = [name for name, kept in self.points.items() if kept.single is None]
        gone = sorted(placed, key=self._turn)[MOST_POINTS:] if len(placed) > MOST_POINTS else []
        gone = [name for name in gone if not self.points[name].control.any()]
        for name in gone + sorted(single, key=self._turn)[MOST_SINGLE:]:
            del self.points[name]
        return len(gone)

    def linearise_single(self, solution: BlockSolution) -> Parts:
        """Linearise single looks at a solution, so that the ties to them in the window are as good as it; in parts."""
        done: set[int] = set()
        for kept in self.points.values():
            if kept.single is not None:
                batch = kept.single.batch
                if id(batch) not in done:
                    theta = solution.values_of(batch.columns)
                    batch.back_substitute(theta)
                    batch.linearise(theta, reweigh=True)
                    done.add(id(batch))
                    yield REFINED_POINTS
                kept.left = kept.single.left() or kept.left

    def _turn(self, name: str) -> int:
        """Points are forgotten from the highest number on."""
        kept = self.points[name]
        first = kept.left.points[0].name if kept.single is None else kept.single.batch.names[0]
        return crc32(first.encode())

    def _keep(self, name: str, kept: KeptPoint) -> None:
        """Put a point in place of what is known of it, as the newest."""
        self.points.pop(name, None)
        self.points[name] = kept

    def _tie(self, batch: Batch, i: int, published: AdjustedPoint, cell: Cell | None, update: Update) -> None:
        """A point of a batch that ties strips became final."""
        assert batch.ties is not None
        rays, origin = rows_of(batch, i, cell)
        old, apart = self.points.get(published.name), None
        if old is not None and not (batch.ties.active[i] and self.holds(old.functions.columns)):
            old, apart = None, old if self.holds(old.functions.columns) else None
        if old is not None and old.single is not None:
            left = old.single.left(batch.points_l[i])
            old = None if left is None else replace(old, left=left)
        before, known_l = (np.zeros(3), np.zeros(3)) if old is None else (old.control, old.known_l)
        control = np.where(before > 0, 0.0, batch.ties.control[i])
        known_l = np.where(before > 0, known_l, batch.control.xyz_l[i])
        rows = [rays] if old is None else [rays, old.functions.rows(old.place, origin)]
        point, matrix, rhs, _ = eliminated(rows, np.diag(control), batch.control.xyz_l[i], origin)
        # a point that no look is left of lies where it is known to be, and says nothing
        if not len(point.columns) or np.linalg.cond(point.factor[0]) ** 2 > PLACED:
            return
        self.add(point.columns, matrix, rhs)
        if apart is not None and apart.point.rays > published.rays:  # more looks say where it is than contradict them
            self._keep(published.name, apart.doubted())
            return
        seen = frozenset(r.look.strip for r in published.residuals)
        if old is not None:
            seen |= old.strips
            n, looks = published.rays + old.point.rays, old.point.residuals + published.residuals
            published = published._replace(rays=n, residuals=looks, checked=checks(n, len(looks), bool(control.any())))
        time_s = float(batch.rays.time_s[batch.first_ray[i] : batch.first_ray[i + 1]].mean())
        left = LeftPoints(point, (published,))
        self._keep(published.name, KeptPoint(left, 0, seen, time_s, before + control, known_l))
        if old is not None and old.single is not None:
            update.refused.append(Refusal(published.name, old.single.look, TAKEN_BACK))

    def knows(self, name: str) -> bool:
        """Whether known coordinates count in a point that is final."""
        return name in self.points and bool(self.points[name].control.any())

    def add_control(self, name: str, control: ControlPoint) -> bool:
        """Known coordinates of a point that is final, in place of others that count; whether that changes something."""
        kept, weight = self.points.get(name), control.weight
        if kept is None or not self.holds(kept.functions.columns):
            return False
        if kept.control.any():
            return self._restate(name, weight, np.nan_to_num(control.xyz_l), control.role)
        if not weight.any():
            return False
        if kept.single is not None:
            place_l = kept.single.place_at(control)
            left = None if place_l is None else kept.single.left(place_l)
            if left is None:
                return False
            kept = replace(kept, left=left)
        self._weigh(name, kept, weight, np.nan_to_num(control.xyz_l), control.role)
        return True

    def _restate(self, name: str, weight: Array, xyz_l: Array, role: str) -> bool:
        """Known coordinates (3,) with weights (3,), 0 where there are none, in place of those that count."""
        old = self.points[name]
        if (weight == old.control).all() and (xyz_l == old.known_l)[weight > 0].all():
            return False
        for change, value in ((weight, xyz_l), (-old.control, old.known_l)):
            self._weigh(name, self.points[name], change, value, role)
        return True

    def weigh_control(self, name: str, axis: int, weight: float, value: float) -> None:
        """Give a known coordinate (m) of a point that is final another weight, 0 to refuse it."""
        kept = self.points.get(name)
        if kept is None or not self.holds(kept.functions.columns) or (weight > 0) == (kept.control[axis] > 0):
            return
        change = (weight - kept.control[axis]) * (np.arange(3) == axis)
        self._weigh(name, kept, change, np.full(3, value), kept.point.role)

    def _weigh(self, name: str, kept: KeptPoint, change: Array, xyz_l: Array, role: str) -> None:
        """Change the weights (3,) of known coordinates (3,) of a point; its looks are in the equations already."""
        origin = kept.functions.origin_l[kept.place]
        rows = kept.functions.rows(kept.place, origin)
        point, matrix, rhs, _ = eliminated([rows], np.diag(change), xyz_l, origin)
        self.add(point.columns, matrix, rhs)
        left = LeftPoints(point, (kept.point._replace(role=role),))
        known_l = np.where(change > 0, xyz_l, kept.known_l)
        self.points[name] = KeptPoint(left, 0, kept.strips, kept.time_s, kept.control + change, known_l)

    # -- solution ------------------------------------------------------------------------------------------------------

    def solving(self, named: Iterable[Named] = ()) -> Generator[Cost, None, BlockSolution]:
        """Values and cofactors of all unknowns from all that is kept.

        In parts, each with what it costs; nothing may become final meanwhile.

        Parameters
        ----------
        named : drifts of tie points that are unknowns too, so that the others are free of them
        """
        self.changed = False
        numbers, weight = self._unknowns(self.strips.values(), named, self._shared)
        values, factor = yield from self._normals.solving(numbers, weight)
        return BlockSolution(numbers, values, factor)

    def _unknowns(
        self, strips: Collection[KeptStrip], named: Iterable[Named], others: IntArray | tuple[()] = ()
    ) -> tuple[IntArray, Array]:
        """Numbers (n,), ascending, of the unknowns of strips, of the drifts named in them, and others; their weights
        (n,) beforehand, beyond what the equations hold."""
        drifts = [drift for drift in named if drift.strip in {strip.index for strip in strips}]
        own = np.concatenate([others, *(strip.entered for strip in strips)]).astype(np.int64)
        numbers = np.concatenate([own, *(of_block(drift.strip, drift.rows) for drift in drifts)])
        weight = np.concatenate([np.zeros(len(own)), *(drift.sigma**-2.0 for drift in drifts)])
        order = np.argsort(numbers)
        return numbers[order], weight[order]

    def refining(self, solution: BlockSolution, strips: Iterable[str]) -> Generator[Cost, None, WholeStrips]:
        """Orientation and points of strips with the information of the block; a point goes with its last strip.

        In parts, each with what it costs.
        """
        refined, wanted = WholeStrips([], []), set(strips)
        for strip in [strip for name, strip in self.strips.items() if name in wanted]:  # others begin meanwhile
            for orientation in strip.orientation:
                refined.orientation.append(orientation.refined(solution))
                yield REFINED_ORIENTATION
        mine = {name: k.left for name, k in self.points.items() if k.strips & wanted and k.single is None}
        for left in {id(left): left for left in mine.values()}.values():
            refined.points.extend(p for p in left.refined(solution) if mine.get(p.name) is left)
            yield REFINED_POINTS
        return refined

    # -- bounds --------------------------------------------------------------------------------------------------------

    def beyond(self) -> list[str]:
        """The strips that must be closed so that the block keeps its bounds, oldest first."""
        left, found = list(self.strips), []
        unknowns = {id: len(strip.entered) for id, strip in self.strips.items()}
        while len(left) > 1 and len(self._shared) + sum(unknowns[id] for id in left) > BLOCK_UNKNOWNS:
            found.append(left.pop(0))
        return found

    def is_closable(self, ids: Collection[str], named: Iterable[Named] = ()) -> bool:
        """Whether what strips say of the others can be kept; see `MOST_MET`."""
        strips = [self.strips[id] for id in ids]
        return len(self._normals.met(self._unknowns(strips, named)[0])) <= MOST_MET

    def closing(self, ids: Collection[str], named: Iterable[Named] = ()) -> Parts:
        """Eliminate the unknowns of strips, also the drifts in them that are named: the others keep their solution.

        In parts, each with what it costs.
        """
        yield from self._normals.close(*self._unknowns([self.strips[id] for id in ids], named))
        for id in ids:
            self._forget(id)

    def begin_again(self) -> None:
        """Forget all strips, and what they say of the unknowns that all share: one that is being flown is too long."""
        self.strips, self.points = {}, {}
        self.unplaced.clear()
        self._normals = BlockNormals()
        self._normals.add(self._shared, *self._shared_known)

    def _forget(self, id: str) -> KeptStrip:
        """A strip, its points and its drifts are kept no more; returns it."""
        self.points = {name: p for name, p in self.points.items() if id not in p.strips}
        strip = self.strips.pop(id)
        self._normals.drop(of_block(strip.index, np.arange(MOST_GROUPS * EACH)))
        return strip
