"""What the strips of a block have said so far, kept after they have left the window.

The window lets go of unknowns by marginalisation, one strip at a time. So that a later strip can still tell an earlier
one something, the information of every batch that became final is kept here a second time, before marginalisation: the
normal equations of all strips, dense, and for every object point its coordinates given the unknowns its rays touched
(`LeftPoints`). A point that is seen again in a later strip thus ties both, and its earlier looks are never counted
twice. Drifts of tie points are unknowns as well, held at zero until they are named (`drift_border`). Solving the whole
gives every line and every point the information of the block: it is the backward pass of `backward` for several strips.
"""

from __future__ import annotations

from collections.abc import Generator, Iterable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from ..adjustment.normal_equations import PointNormals
from ..adjustment.reduced_system import DenseFactor
from ..models.base import Design
from .backward import LeftPoints, again
from .batch import Batch
from .block_normals import LOOKED_UP, ROWS, BlockNormals
from .block_solution import BlockSolution, Cost, Parts, Workspace, factorised, in_one_go, inverted, solved
from .compensation import Border, Named
from .drift_border import MOST_GROUPS, Cell, of_block
from .kept_points import KeptPoint, SingleLook, eliminated
from .output import checks
from .points import ControlPoint
from .results import TAKEN_BACK, AdjustedPoint, Look, RefinedOrientation, Refusal, WholeStrips
from .suspects import EACH

Array = NDArray[np.floating]
IntArray = NDArray[np.int64]

#: Unknowns of the strips kept together; beyond that the oldest strip is refined no more. The solution is dense: about
#: two seconds of one core; with the equations it takes 210 MB, which are kept.
MOST_UNKNOWNS = 4200
#: A strip with more unknowns is no part of a block.
MOST_OF_STRIP = 1500
#: What it costs to refine a second or so of orientation, and the points of a batch, in operations.
AGAIN, AGAIN_POINTS = 4e7, 8e6
#: Object points kept; beyond that those of the oldest strip are forgotten. Single looks beside them.
MOST_POINTS, MOST_SINGLE = 30000, 1500


@dataclass
class KeptStrip:
    """A strip: numbers of its unknowns, a-priori equations, orientation that became final."""

    id: str
    index: int
    numbers: IntArray
    prior: tuple[NDArray[np.int32], Array, Array, Array] | None = None
    entered: IntArray = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    orientation: list[tuple[RefinedOrientation, Design, Array]] = field(default_factory=list)


class Archive:
    """The strips of a block that are over or being flown; see the module.

    Parameters
    ----------
    camera_columns : (m,) numbers of the additional parameters, which all strips share
    camera_sigma : (m,) a priori

    Attributes
    ----------
    strips, points : by name, oldest first
    changed : whether there is news since the last solution
    """

    def __init__(self, camera_columns: IntArray, camera_sigma: Array):
        self.strips: dict[str, KeptStrip] = {}
        self.points: dict[str, KeptPoint] = {}
        self.changed = False
        self._begun = 0
        self._camera, self._camera_sigma = camera_columns, camera_sigma
        self._normals, self._workspace = BlockNormals(), Workspace()

    def begin_strip(self, id: str, numbers: IntArray) -> None:
        """A strip begins, whose unknowns have these numbers (consecutive)."""
        self.strips[id] = KeptStrip(id, self._begun, numbers)
        self._begun += 1

    def holds(self, columns: IntArray) -> bool:
        """Whether all these unknowns are kept."""
        kept = np.isin(columns, self._camera) | (columns < 0)
        for strip in self.strips.values():
            if len(strip.numbers):
                kept |= (columns >= strip.numbers[0]) & (columns <= strip.numbers[-1])
        return bool(kept.all())

    # -- what becomes final --------------------------------------------------------------------------------------------

    def add(self, columns: IntArray, matrix: Array, rhs: Array) -> None:
        """Add information (u, u), (u,) about unknowns (u,); without effect if some are kept no more."""
        if not self.holds(columns):
            return
        self.changed = True
        self._normals.add(columns, matrix, rhs)

    def leave(self, batch: Batch, published: Sequence[AdjustedPoint], cell: Cell | None = None) -> list[Refusal]:
        """A batch became final; returns the single looks of earlier strips that count now.

        Points that tie strips come in batches of their own (`Batch.ties`). Theirs is the information of the new rays
        and of the earlier strip's coordinates, with all unknowns of that strip instead of what stood for it on line.

        Parameters
        ----------
        published : its points, those of full rank
        cell : what drifts of its strip have to do with it, None if nothing
        """
        if not self.holds(batch.columns[: len(batch.columns) - batch.n_tied]):
            return []
        if batch.ties is None:
            left = LeftPoints.of(batch, published)
            matrix, rhs = batch.information.matrix, batch.information.rhs
            if cell is not None:
                matrix = np.block([[matrix, cell.coupling.T], [cell.coupling, cell.normal]])
                rhs = np.concatenate([rhs, cell.score])
                coupling = np.concatenate([left.coupling, cell.roots(batch.normals)], axis=2)
                left = replace(left, columns=np.concatenate([left.columns, cell.of_block]), coupling=coupling)
            self.add(left.columns, matrix, rhs)
            time_s = np.add.reduceat(batch.rays.time_s, batch.first_ray[:-1]) / np.diff(batch.first_ray)
            for i, point in zip(left.order.tolist(), left.points, strict=True):
                seen = frozenset(r.look.strip for r in point.residuals)
                self._keep(point.name, KeptPoint(left, i, seen, float(time_s[i]), batch.control.weight[i]))
            return []
        by_name = {p.name: p for p in published}
        told, returned = [], []
        for i, name in enumerate(batch.names):
            old = self.points.get(name)
            tie = self._tie(batch, i, by_name.get(name), cell)
            if tie is None:
                continue
            told.append(tie)
            if old is not None and old.single is not None and batch.ties.active[i]:
                returned.append(Refusal(name, old.single.look, TAKEN_BACK))
        if not told:
            return []
        columns = np.unique(np.concatenate([c for c, _, _ in told]))
        matrix, rhs = np.zeros((len(columns), len(columns))), np.zeros(len(columns))
        for own, N, right in told:
            at = np.searchsorted(columns, own)
            matrix[at[:, None], at] += N
            rhs[at] += right
        self.add(columns, matrix, rhs)
        return returned

    def keep_single(self, batch: Batch, looks: Sequence[Look], cell: Cell | None) -> None:
        """Keep looks that found no partner in their strip: a batch of points with one each."""
        for i, look in enumerate(looks if self.holds(batch.columns) else ()):
            name = batch.names[i]
            if name in self.points and self.points[name].single is None:
                continue
            single = SingleLook(batch, i, look, cell)
            seen, time_s = frozenset((look.strip,)), float(batch.rays.time_s[i])
            self._keep(name, KeptPoint(single.left(), 0, seen, time_s, np.zeros(3), single))

    def linearise_single(self, solution: BlockSolution) -> Parts:
        """Linearise single looks at a solution, so that what is said of them on line is as good as it; in parts.

        Of too many the oldest are forgotten.
        """
        names = [name for name, kept in self.points.items() if kept.single is not None]
        for name in names[: max(len(names) - MOST_SINGLE, 0)]:
            del self.points[name]
        batches: dict[int, list[tuple[KeptPoint, SingleLook]]] = {}
        for kept in self.points.values():
            if kept.single is not None:
                batches.setdefault(id(kept.single.batch), []).append((kept, kept.single))
        for members in batches.values():
            batch = members[0][1].batch
            theta, _ = solution.of(batch.columns)
            batch.back_substitute(theta)
            batch.linearise(theta, reweigh=True)
            for kept, single in members:
                kept.left = single.left()
            yield AGAIN_POINTS

    def _keep(self, name: str, kept: KeptPoint) -> None:
        """Put a point in place of what is known of it, as the newest."""
        self.points.pop(name, None)
        self.points[name] = kept

    def _tie(
        self, batch: Batch, i: int, published: AdjustedPoint | None, cell: Cell | None
    ) -> tuple[IntArray, Array, Array] | None:
        """Keep a point of a batch that ties strips; its information (u, u), (u,) about unknowns (u,), if it has any."""
        assert batch.ties is not None
        if published is None:
            return None
        name, own = batch.names[i], batch.columns[: len(batch.columns) - batch.n_tied]
        A, J, residual, origin = batch.equations(i)
        A = A[:, : len(own)]
        if cell is not None:
            A = np.column_stack([A, cell.on_rays(range(batch.first_ray[i], batch.first_ray[i + 1]))])
            own = np.concatenate([own, cell.of_block])
        old = self.points.get(name)
        if old is None or not self.holds(old.left.columns) or not batch.ties.active[i]:
            old = None
        if old is not None and old.single is not None:
            old = replace(old, left=old.single.left(batch.points_l[i]))
        columns = np.union1d(own, [] if old is None else old.left.columns).astype(np.int64)
        rows, points, values = [_spread(A, own, columns)], [J], [residual]
        before = np.zeros(3) if old is None else old.control
        control = np.where(before > 0, 0.0, batch.ties.control[i])
        if old is not None:
            L, D, y = old.root
            rows.append(_spread(D, old.left.columns, columns))
            points.append(L)
            values.append(y - L @ (origin - old.left.origin_l[old.place]))
        if control.any():
            root = np.sqrt(control)
            rows.append(np.zeros((3, len(columns))))
            points.append(np.diag(root))
            values.append(root * (batch.control.xyz_l[i] - origin))
        A, J, residual = np.concatenate(rows), np.concatenate(points), np.concatenate(values)
        normal = J.T @ J
        if np.linalg.cond(normal) > 1e12:
            return None
        left, matrix, rhs = eliminated(A, J, residual, normal, columns, origin, published)
        seen = frozenset(r.look.strip for r in published.residuals)
        if old is not None:
            seen |= old.strips
            then = old.point
            rays, looks = published.rays + then.rays, then.residuals + published.residuals
            merged = replace(
                published, rays=rays, residuals=looks, checked=checks(rays, len(looks), bool(control.any()))
            )
            left = replace(left, points=(merged,))
        time_s = float(batch.rays.time_s[batch.first_ray[i] : batch.first_ray[i + 1]].mean())
        self._keep(name, KeptPoint(left, 0, seen, time_s, before + control))
        return columns, matrix, rhs

    def add_control(self, name: str, control: ControlPoint) -> bool:
        """Known coordinates of a point that is final; whether they count."""
        kept, weight = self.points.get(name), control.weight
        if kept is None or kept.with_control or not weight.any() or not self.holds(kept.left.columns):
            return False
        if kept.single is not None:
            place_l = kept.single.place_at(control)
            if place_l is None:
                return False
            kept = replace(kept, left=kept.single.left(place_l))
        L, D, y = kept.root
        origin = kept.left.origin_l[kept.place]
        root, u = np.sqrt(weight), len(kept.left.columns)
        A, J = np.concatenate([D, np.zeros((3, u))]), np.concatenate([L, np.diag(root)])
        residual = np.concatenate([y, root * (np.nan_to_num(control.xyz_l) - origin)])
        point = replace(kept.point, role=control.role)
        left, matrix, rhs = eliminated(A, J, residual, J.T @ J, kept.left.columns, origin, point)
        # the looks themselves are in already: they leave nothing but L^T p + D theta = y, which p takes up
        self.add(kept.left.columns, matrix, rhs)
        self.points[name] = KeptPoint(left, 0, kept.strips, kept.time_s, weight)
        return True

    def weigh_control(self, name: str, axis: int, weight: float, value: float) -> None:
        """Give a known coordinate of a point that is final another weight, 0 to refuse it."""
        kept = self.points.get(name)
        if kept is None or not self.holds(kept.left.columns) or (weight > 0) == (kept.control[axis] > 0):
            return
        change = weight - kept.control[axis]
        L, D, y = kept.root  # (3, 3), (3, u), (3,)
        origin = kept.left.origin_l[kept.place]
        normal, into, moment = L.T @ L, L.T @ D, L.T @ y
        normal[axis, axis] += change
        values, vectors = np.linalg.eigh(normal)
        normal = vectors * np.maximum(values, 1e-12 * values[-1]) @ vectors.T  # one ray alone does not place it
        moment[axis] += change * (value - origin[axis])
        L_inv = np.linalg.inv(np.linalg.cholesky(normal))
        D_new, y_new = L_inv @ into, L_inv @ moment
        normals = PointNormals(L_inv[np.tril_indices(3)][:, None], y_new[:, None], np.array([3]))
        order = np.zeros(1, dtype=np.int64)
        left = LeftPoints(kept.left.columns, origin[None], normals, D_new[None], order, (kept.point,))
        self.add(kept.left.columns, D.T @ D - D_new.T @ D_new, D.T @ y - D_new.T @ y_new)
        control = np.where(np.arange(3) == axis, weight, kept.control)
        self.points[name] = replace(kept, left=left, place=0, control=control)

    # -- solution ------------------------------------------------------------------------------------------------------

    @property
    def n_unknowns(self) -> int:
        return len(self._camera) + sum(len(s.entered) for s in self.strips.values())

    def solve(self) -> BlockSolution:
        """Values and cofactors of all unknowns from all that is kept. The next solution takes its place."""
        return in_one_go(self.solving())

    def solving(self) -> Generator[Cost, None, BlockSolution]:
        """The same in parts, each with what it costs; nothing may become final meanwhile."""
        self.changed = False
        numbers = np.sort(np.concatenate([self._camera, *(s.entered for s in self.strips.values())]))
        N = self._workspace.square(len(numbers))
        rhs, scale = yield from self._equations(numbers, N)
        try:
            yield from factorised(N)
        except np.linalg.LinAlgError:  # something is hardly determined, even beforehand
            rhs, scale = yield from self._equations(numbers, N)
            factor = DenseFactor(np.tril(N) + np.tril(N, -1).T)
            N[:] = factor.inverse() * scale[:, None] * scale
            return BlockSolution(numbers, scale * factor.solve(rhs), N)
        values = scale * solved(N, rhs)
        yield from inverted(N, scale)
        return BlockSolution(numbers, values, N)

    def _equations(self, numbers: IntArray, N: Array) -> Generator[Cost, None, tuple[Array, Array]]:
        """Put the scaled normal equations of sorted unknowns into the lower triangle of N; right-hand side, scale."""
        n, rhs = len(numbers), self._normals.rhs(numbers)
        for begin in range(0, n, ROWS):
            rows = range(begin, min(begin + ROWS, n))
            self._normals.lower(numbers, N, rows)
            yield LOOKED_UP * len(rows) * rows.stop
        at = np.searchsorted(numbers, self._camera)
        N[at, at] += 1.0 / self._camera_sigma[: len(at)] ** 2
        for strip in self.strips.values():
            _add_prior(N, rhs, numbers, strip)
        diagonal = N.diagonal()
        scale = np.where(diagonal > 0, 1.0 / np.sqrt(np.where(diagonal > 0, diagonal, 1.0)), 1.0)
        for row in range(n):
            N[row, : row + 1] *= scale[row] * scale[: row + 1]
        return rhs * scale, scale

    def without(self, named: Iterable[Named], solution: BlockSolution) -> BlockSolution:
        """A solution without the drifts of tie points that have been named."""
        kept = {s.index for s in self.strips.values()}
        mine = [drift for drift in named if drift.strip in kept]
        if not mine:
            return solution
        numbers = np.concatenate([of_block(drift.strip, drift.rows) for drift in mine])
        order = np.argsort(numbers)
        numbers, sigma = numbers[order], np.concatenate([drift.sigma for drift in mine])[order]
        N = self._normals
        border = Border(N.rhs(numbers), N.rows(numbers, numbers), N.rows(numbers, solution.numbers), sigma)
        return solution.without(numbers, border)

    def refining(self, solution: BlockSolution, strips: Iterable[str]) -> Generator[Cost, None, WholeStrips]:
        """Orientation and points of strips with the information of the block; a point goes with its last strip.

        In parts, each with what it costs.
        """
        wanted = set(strips)
        orientation = []
        for strip in self.strips.values():
            if strip.id in wanted:
                for old, design, noise in strip.orientation:
                    orientation.append(again(old, design, noise, solution.numbers, solution.values, solution.cofactors))
                    yield AGAIN
        groups: dict[int, tuple[LeftPoints, set[str]]] = {}
        for name, kept in self.points.items():
            if kept.strips & wanted and kept.single is None:
                groups.setdefault(id(kept.left), (kept.left, set()))[1].add(name)
        points = []
        for left, names in groups.values():
            points += [p for p in left.refined(*solution.of(left.columns)) if p.name in names]
            yield AGAIN_POINTS
        return WholeStrips(orientation, points)

    # -- bounds --------------------------------------------------------------------------------------------------------

    def too_long(self, id: str) -> bool:
        """Whether a strip has too many unknowns for a block."""
        return id in self.strips and len(self.strips[id].entered) > MOST_OF_STRIP

    def beyond(self) -> list[str]:
        """The strips that must be closed so that the block keeps its bounds, oldest first."""
        unknowns, left = self.n_unknowns, list(self.strips)
        points = [p for p in self.points.values() if p.single is None]
        found = []
        while len(left) > 1 and (unknowns > MOST_UNKNOWNS or len(points) > MOST_POINTS):
            id = left.pop(0)
            unknowns -= len(self.strips[id].entered)
            points = [p for p in points if id not in p.strips]
            found.append(id)
        return found

    def drop(self, id: str) -> None:
        """Forget a strip as if it had never been tied to others."""
        numbers = self._forget(id)
        self._normals.drop(self._normals.numbers[np.isin(self._normals.numbers, numbers)])

    def close(self, id: str, named: Iterable[Named] = ()) -> None:
        """Let a strip's unknowns go, also the drifts in it that are named; what they say of the others stays: their
        solution does too."""
        in_one_go(self.closing(id, named))

    def closing(self, id: str, named: Iterable[Named] = ()) -> Parts:
        """The same in parts, each with what it costs; where the last solution stood."""
        strip = self.strips[id]
        drifts = [(of_block(d.strip, d.rows), d.sigma) for d in named if d.strip == strip.index]
        numbers = np.sort(np.concatenate([strip.entered, *(own for own, _ in drifts)]))
        n = len(numbers)
        own, through = self._workspace.pair(n, len(self._normals))
        rhs = self._normals.rhs(numbers)
        self._normals.lower(numbers, own, range(n))
        _add_prior(own, rhs, numbers, strip)
        for of_drift, sigma in drifts:
            at = np.searchsorted(numbers, of_drift)
            own[at, at] += 1.0 / sigma**2
        yield LOOKED_UP * n * n / 2.0
        yield from self._normals.close(numbers, own, rhs, through)
        self._forget(id)

    def _forget(self, id: str) -> IntArray:
        """A strip and its points are kept no more; numbers of its unknowns."""
        self.points = {name: p for name, p in self.points.items() if id not in p.strips}
        strip = self.strips.pop(id)
        drifts = of_block(strip.index, np.arange(MOST_GROUPS * EACH))
        self._normals.drop(np.intersect1d(drifts, self._normals.numbers))
        return strip.numbers


def _spread(part: Array, columns: IntArray, wanted: IntArray) -> Array:
    """Rows (m, u) over other, sorted columns that contain theirs."""
    result = np.zeros((len(part), len(wanted)))
    result[:, np.searchsorted(wanted, columns)] = part
    return result


def _add_prior(N: Array, rhs: Array, numbers: IntArray, strip: KeptStrip) -> None:
    """Add a strip's a-priori equations to the lower triangle of normal equations of sorted unknowns."""
    if strip.prior is None:
        return
    columns, coefficients, value, sigma = strip.prior
    weighted, right = coefficients / sigma[:, None], value / sigma
    place = np.where(columns >= 0, np.searchsorted(numbers, columns), 0)
    weighted = np.where(columns >= 0, weighted, 0.0)
    row, column = np.broadcast_arrays(place[:, :, None], place[:, None, :])
    lower = (row >= column) & (columns >= 0)[:, :, None] & (columns >= 0)[:, None, :]
    np.add.at(N, (row[lower], column[lower]), (weighted[:, :, None] * weighted[:, None, :])[lower])
    np.add.at(rhs, place, weighted * right[:, None])
