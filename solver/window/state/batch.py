"""Object points that became known together: their rays, linearised, with the points eliminated; a block of its own.

A batch gives the window one dense block of information about the unknowns its rays touch, and can take it back.
Residuals, weights, models and statistics are those of the batch adjustment.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from ...adjustment.covariance import Cofactors
from ...adjustment.drift_hypotheses import Group
from ...adjustment.layout import Layout
from ...adjustment.linearisation import Linearisation, linearise, linearise_and_weigh
from ...adjustment.network import Rays
from ...adjustment.normal_equations import ControlWeights, inverse_factors, point_normals
from ...adjustment.ray_statistics import InSigmas, RayStatistics
from ...adjustment.surface_control import SurfaceControl
from ...arrays import Array, Bools, IntArray
from .unknowns import Border, Information, WindowState

_UNIT = np.eye(3)


@dataclass(frozen=True)
class TieRows:
    """Whitened equations of p points: ``design @ theta + point @ (xyz - origin) = residual``; three a point."""

    design: Array
    point: Array
    residual: Array
    active: Bools

    def joined(self, lin: Linearisation, point: IntArray) -> tuple[Linearisation, IntArray]:
        """With the observations of rays, as two more rays a point."""
        p = len(self.point)
        first, second = self.point[:, :2].transpose(1, 2, 0), np.zeros((2, 3, p))
        second[0] = self.point[:, 2].T
        rest = np.stack([self.residual[:, 2], np.zeros(p)])
        both = replace(
            lin,
            residual=np.concatenate([lin.residual, self.residual[:, :2].T, rest], axis=1),
            point=np.concatenate([lin.point, first, second], axis=2),
        )
        return both, np.concatenate([point, np.tile(np.arange(p), 2)])


@dataclass
class PointTies:
    """What earlier strips say of the p points of a batch.

    Attributes
    ----------
    columns : (m,) unknowns of the window that stand for earlier strips, the last ones of the batch
    xyz_l, modes, root : (p, 3), (p, 3, m), (p, 3, 3) see `EarlierPoint`
    control : (p, 3) weights of known coordinates, whether or not an earlier strip has used them
    active : (p,) False where the tie failed its test
    single : (p,) of one look
    used : (p,) whether an earlier strip has used known coordinates of the point
    """

    columns: IntArray
    xyz_l: Array
    modes: Array
    root: Array
    control: Array
    active: Bools
    single: Bools
    used: Bools

    def part(self, which: IntArray) -> PointTies:
        """Of some of the points."""
        return replace(
            self, xyz_l=self.xyz_l[which], modes=self.modes[which], root=self.root[which], control=self.control[which],
            active=self.active[which], single=self.single[which], used=self.used[which],
        )  # fmt: skip

    @property
    def placed(self) -> Bools:
        """Which points (p,) have a place from earlier strips."""
        return self.active & ~self.single

    @property
    def observations(self) -> IntArray:
        """How many each tie stands for (p,), active or not: that of a single look two."""
        return np.where(self.single, 2, 3)

    def rows(self, origin_l: Array, n_unknowns: int) -> TieRows:
        """Equations of all points, zero where they are not active."""
        root = np.where(self.active[:, None, None], self.root, 0.0)
        design = np.zeros((len(root), 3, n_unknowns))
        design[:, :, n_unknowns - len(self.columns) :] = -root @ self.modes
        return TieRows(design, root, np.einsum("pij,pj->pi", root, self.xyz_l - origin_l), self.active)


class Counts(NamedTuple):
    """What a batch, or several, count for.

    Attributes
    ----------
    redundancy : observations less object coordinates
    determined : object coordinates
    rays, control : with weight; of control whole points
    points : with or without any
    lost : points no ray of which has weight
    """

    redundancy: int
    determined: int
    rays: int
    control: int
    points: int
    lost: int


@dataclass
class Batch:
    """A mini network of p points with n rays (sorted by point).

    Attributes
    ----------
    names : (p,) points
    rays : image measurements with the measured orientation
    pose_covariance : (n, 6, 6) white noise of the measured orientation, with what the model leaves out
    columns : (u,) unknowns of the window that the rays touch, by their number; then those of the camera, and at the
        end those that stand for earlier strips
    layout : the same, counted from 0
    control : weighted coordinates of the points
    weight : (n,) factor on each ray's weight; 0 = left out
    points_l : (p, 3)
    provisional : whether a ray leans on a filtered pose that a smoothed one will replace
    ties : what earlier strips say of the points
    surface, on_surface : that points lie on, None for none, and which of them (p,) do
    surface_factor : (p,) on the weights of its heights
    surface_rows : its equations, at full weight
    noise_version : of the noise of poses and images that the weights are for, see `LiveNetwork.noise_version`
    image_factor : what the sigmas of its lines and samples have been multiplied by
    counted : whether its rays are counted there
    tested : number of the update that tested it last
    judged : cofactors and statistics of the last test, and the solution of the window they are for
    groups : source and CCD line of each ray, where they were asked for, see `Intake.sources_of`
    n_points : p
    first_ray : (p + 1,) where the rays of each point begin
    newest_s, oldest_s, strips, height_m : times of its rays, places of their strips, and how high these were flown
    theta, origin_l : where it is linearised
    lin, whitening : the linear equations of its rays
    normals : of its points
    inverse_factors : (p, 3, 3) ``L^-1`` of the points' normal matrices ``L L^T``
    coupling : (p, 3, u) how the points hang on the unknowns, times their inverse factors
    information : about the unknowns
    counts : of `information`
    """

    names: list[str]
    rays: Rays
    pose_covariance: Array
    columns: IntArray
    layout: Layout
    control: ControlWeights
    weight: Array
    points_l: Array
    provisional: bool
    ties: PointTies | None = None
    surface: SurfaceControl | None = None
    on_surface: Bools = field(default_factory=lambda: np.zeros(0, dtype=bool))
    noise_version: int = 0
    image_factor: float = 1.0
    counted: bool = False
    tested: int = -1
    groups: list[Group] | None = None
    judged: tuple[int, Cofactors, RayStatistics] | None = field(init=False, repr=False, default=None)
    _of_rays: tuple[Linearisation, Array] | None = field(init=False, repr=False, default=None)
    _in_sigmas: tuple[Linearisation, Rays, InSigmas] | None = field(init=False, repr=False, default=None)
    _without_points: tuple[Array, Array] | None = field(init=False, repr=False, default=None)
    _left: tuple[Array, IntArray, bool] | None = field(init=False, repr=False, default=None)

    def __post_init__(self) -> None:
        self.n_points = len(self.names)
        self.newest_s, self.oldest_s = float(self.rays.time_s.max()), float(self.rays.time_s.min())
        self.strips = tuple(int(i) for i in np.unique(self.rays.strip))
        above = np.sort(self.rays.position_l[:, 2] - self.points_l[self.rays.point, 2])
        self.height_m = abs(float(0.5 * (above[(len(above) - 1) // 2] + above[len(above) // 2])))
        self.first_ray = np.searchsorted(self.rays.point, np.arange(self.n_points + 1))
        self.surface_factor: Array = np.ones(self.n_points)
        self._template()

    def linearise(self, theta: Array, reweigh: bool) -> None:
        """Linearise at values (u,) of the unknowns and the present points; ``reweigh`` renews the rays' weights."""
        self.theta, self.origin_l = theta, self.points_l
        if reweigh:
            rays = replace(self.rays, orientation_noise=self.pose_covariance)
            self.whitening, self.lin, self.layout = linearise_and_weigh(rays, self.layout, theta, self.points_l)
        else:
            self.lin = linearise(self.rays, self.layout, self.whitening, theta, self.points_l)
        if self.surface is not None:
            self.surface_rows = self.surface.rows(self.points_l, self.on_surface)
            self.weigh_surface(self.surface_factor)
        self.eliminate()

    def weigh_surface(self, factor: Array) -> None:
        """Give the heights of the surface other weights (p,) between 0 and 1; `eliminate` makes them count."""
        self.surface_factor = factor
        rows = self.surface_rows.weighed(self.surface_rows.weight * factor)
        self.control = replace(self.control, surface=rows)

    def surface_equation(self, point: int) -> tuple[Array, Array, Array] | None:
        """Rows (1, u) and (1, 3) and the right-hand side (1,) of a point on the surface, as `equations`; None if it is
        not on it."""
        rows = self.control.surface
        if rows is None or not rows.weight[point] > 0:
            return None
        root = np.sqrt(rows.weight[point])
        design = np.zeros((1, len(self.columns)))
        design[0, self.layout.shift_column] = root
        off = rows.residual(self.origin_l, 0.0)[point : point + 1]
        return design, root * rows.normal[point : point + 1], off

    def eliminate(self) -> None:
        """Information about the orientation, with the points eliminated, at the present linearisation and weights."""
        n, u, p = len(self.rays), len(self.columns), self.n_points
        lin = self.lin if (self.weight == 1.0).all() else self.lin.reweighted(self.weight)
        A = self.full_rows if lin is self.lin else self.full_rows * np.sqrt(self.weight)[:, None, None]
        flat = A.reshape(2 * n, u)
        # the right-hand side for theta counted from zero, the points from where they are
        lin = replace(lin, residual=lin.residual + (flat @ self.theta).reshape(n, 2).T)
        tied = self.ties.rows(self.origin_l, u) if self.ties is not None else None
        all_rows, plan = (lin, self.rays.point) if tied is None else tied.joined(lin, self.rays.point)
        normals = point_normals(all_rows, plan, p, self.control, self.origin_l)
        a, b, c, d, e, f = normals.inverse_factor[:, self.rays.point]
        j = lin.point
        w = np.empty((n, 3, 2))
        w[:, 0] = (a * j[:, 0]).T
        w[:, 1] = (b * j[:, 0] + c * j[:, 1]).T
        w[:, 2] = (d * j[:, 0] + e * j[:, 1] + f * j[:, 2]).T
        D = np.add.reduceat(w @ A, self.first_ray[:-1], axis=0)  # (p, 3, u)
        self.inverse_factors = inverse_factors(normals)
        if tied is not None:
            D += self.inverse_factors @ np.swapaxes(tied.point, 1, 2) @ tied.design
        surface, place = self.control.surface, self.layout.shift_column
        if surface is not None and normals.surface is not None:
            D[:, :, place] += normals.surface.T
        of_points = D.reshape(3 * p, u)
        y = normals.y.T.ravel()
        matrix = flat.T @ flat - of_points.T @ of_points
        rhs = lin.residual.T.ravel() @ flat - y @ of_points
        off = self.control.residual(self.origin_l)
        square = float(np.vdot(lin.residual, lin.residual) + np.vdot(off, off) - y @ y)
        active_rays, determined = int(np.count_nonzero(self.weight)), int(normals.rank.sum())
        rows = 2 * active_rays + self.control.n_observations - determined
        if surface is not None:
            above = surface.residual(self.origin_l, 0.0)
            matrix[place, place] += surface.weight.sum()
            rhs[place] += np.sqrt(surface.weight) @ above
            square += float(above @ above)
            rows += surface.n_observations
        if tied is not None and self.ties is not None:
            matrix += np.einsum("pku,pkv->uv", tied.design, tied.design)
            rhs += np.einsum("pku,pk->u", tied.design, tied.residual)
            square += float(np.vdot(tied.residual, tied.residual))
            rows += int(self.ties.observations[tied.active].sum())
        self.normals, self.information = normals, Information(matrix, rhs, square, rows)
        control = int(np.count_nonzero(self.control.weight.any(axis=1)))
        lost = 0 if active_rays == n else int((self.points_left == 0).sum())
        self.counts = Counts(rows, determined, active_rays, control, p, lost)
        self.judged = self._without_points = None
        self._rows, self.coupling = A, D

    @property
    def n_tied(self) -> int:
        """Number of unknowns that stand for earlier strips."""
        return 0 if self.ties is None else len(self.ties.columns)

    def equations(self, point: int) -> tuple[Array, Array, Array, Array]:
        """Rows (2 m, u) and (2 m, 3) of a point's rays, by unknowns and point; the right-hand side (2 m,) for unknowns
        counted from zero and the point from an origin; the origin (3,)."""
        mine = slice(self.first_ray[point], self.first_ray[point + 1])
        root = np.sqrt(self.weight[mine])
        A = self._rows[mine]
        residual = self.lin.residual[:, mine].T * root[:, None] + A @ self.theta
        J = self.lin.point[:, :, mine].transpose(2, 0, 1) * root[:, None, None]
        return A.reshape(-1, A.shape[2]), J.reshape(-1, 3), residual.ravel(), self.origin_l[point]

    def back_substitute(self, theta: Array) -> None:
        """Put the points where they belong for values (u,) of the unknowns."""
        rest = self.normals.y.T - self.coupling @ theta
        self.points_l = self.origin_l + self.normals.back(rest.T).T

    def has_moved(self, theta: Array, far: float) -> bool:
        """Whether a correction of a ray has changed by more since the linearisation, rad or flying heights."""
        change = np.abs(self.layout.corrections(theta - self.theta))
        return bool(change[:3].max() > far * self.height_m or change[3:].max() > far)

    def points_moved(self) -> float:
        """How far a point has moved at most since the linearisation, m."""
        return float(np.abs(self.points_l - self.origin_l).max(initial=0.0))

    @property
    def points_left(self) -> IntArray:
        """(p,) rays with weight of each point."""
        return self._weighed()[1]

    @property
    def some_rejected(self) -> bool:
        """Whether a ray has no weight."""
        return self._weighed()[2]

    def _weighed(self) -> tuple[Array, IntArray, bool]:
        """Weights of the rays, rays with weight of each point, and whether another one has none."""
        if self._left is None or self._left[0] is not self.weight:  # weights are replaced, never written into
            left = np.bincount(self.rays.point, self.weight > 0, self.n_points).astype(np.int64)
            self._left = self.weight, left, int(left.sum()) < len(self.rays)
        return self._left

    @property
    def control_refused(self) -> int:
        """Control points of which no ray is left."""
        return int((self.control.weight.any(axis=1) & (self.points_left == 0)).sum()) if self.counts.control else 0

    def weigh_control(self, point: int, axis: int, weight: float) -> None:
        """Give a control coordinate another weight; `eliminate` makes it count."""
        weights = self.control.weight.copy()
        weights[point, axis] = weight
        if self.ties is not None:
            self.ties.control[point, axis] = weight
        self.control = replace(self.control, weight=weights)

    def cofactors(self, Q: Array) -> Cofactors:
        """Cofactor blocks of points and rays from those of the unknowns (u, u)."""
        L = self.inverse_factors
        n, p = len(self.rays), self.n_points
        D, u = self.coupling, len(self.columns)
        inner = (D.reshape(3 * p, u) @ Q).reshape(p, 3, u) @ D.swapaxes(1, 2) + _UNIT
        points = L.swapaxes(1, 2) @ inner @ L
        W, rows = self.without_points
        through = (rows.reshape(2 * n, u) @ Q).reshape(n, 2, u)
        observed = through @ rows.swapaxes(1, 2) + W @ W.swapaxes(1, 2)
        return Cofactors(Q.diagonal().copy(), points, observed)

    @property
    def full_rows(self) -> Array:
        """Rows (n, 2, u) of the rays at full weight."""
        if self._of_rays is None or self._of_rays[0] is not self.lin:
            self._of_rays = self.lin, self._design_rows()
        return self._of_rays[1]

    @property
    def through_points(self) -> Array:
        """How the rays at full weight hang on the points, times their inverse factors (n, 2, 3)."""
        return self.lin.point.transpose(2, 0, 1) @ self.inverse_factors.swapaxes(1, 2)[self.rays.point]

    @property
    def without_points(self) -> tuple[Array, Array]:
        """`through_points`, and rows (n, 2, u) of the rays from which the points are eliminated."""
        if self._without_points is None:
            W = self.through_points
            self._without_points = W, self.full_rows - W @ self.coupling[self.rays.point]
        return self._without_points

    def border(self, effect: Array, coupling: Array) -> Border:
        """Equations of k quantities that are held at zero, beside the unknowns of the batch, at unknowns of zero.

        With the equations ``A theta + W t = r`` of rays, where ``t`` stands for the points, and what all else says of a
        point, ``t + D theta = y``, the effect B of the quantities has the coupling ``C = sum W^T B`` to the points,
        ``A^T B - D^T C`` to the unknowns, and the scores ``B^T r - C^T y``.

        Parameters
        ----------
        effect : (n, 2, k) on the equations of the rays at full weight
        coupling : (p, 3, k) its sums ``W^T B`` over the rays of each point
        """
        k = effect.shape[2]
        rows, B, C = self.full_rows.reshape(2 * len(self.rays), -1), effect.reshape(-1, k), coupling.reshape(-1, k)
        residual = self.lin.residual.T.ravel() + rows @ self.theta
        return Border(
            self.columns,
            rows.T @ B - self.coupling.reshape(len(C), -1).T @ C,
            B.T @ B - C.T @ C,
            residual @ B - self.normals.y.T.ravel() @ C,
        )

    def _design_rows(self) -> Array:
        """Derivatives (n, 2, u) of all rays to the unknowns."""
        n, u, lin = len(self.rays), len(self.columns), self.lin
        place, of_camera = self._places
        rows = np.zeros(2 * n * u + u + 1)  # the last ones take what a ray does not have
        for axis in range(2):
            terms = self._coefficients * lin.orientation[axis].take(self.layout.component, axis=0)
            if self._first_terms is not None:
                terms = np.add.reduceat(terms, self._first_terms, axis=0)
            rows[place + axis * u] = terms
            if self.layout.camera is not None:
                rows[of_camera + axis * u] = lin.camera[axis]
        return rows[: 2 * n * u].reshape(n, 2, u)

    def _template(self) -> None:
        """Where the terms of the design stand in the rows of all rays, one row after the other."""
        layout, n, u = self.layout, len(self.rays), len(self.columns)
        first = 2 * u * np.arange(n)
        nowhere = 2 * n * u
        # terms of one unknown that acts on several components stand one after the other
        new = np.append(True, (layout.columns[1:] != layout.columns[:-1]).any(axis=1))
        self._first_terms = None if new.all() else np.flatnonzero(new)
        columns = layout.columns[new]
        place = np.where(columns >= 0, first + columns, nowhere)
        of_camera = np.empty((0, n), dtype=np.int64)
        if layout.camera is not None:
            column = layout.camera.columns[layout.camera.pattern].T
            of_camera = np.where(column >= 0, first + column + layout.n_model, nowhere)
        self._places = place, of_camera
        self._coefficients = layout.coefficients.take(layout.node, axis=0)

    def judge(self, state: WindowState) -> tuple[Cofactors, RayStatistics]:
        """Points, cofactors and statistics at the present solution; computed once for each solution."""
        if self.judged is None or self.judged[0] != state.solution:
            theta = state.values(self.columns)
            self.back_substitute(theta)
            cofactors = self.cofactors(state.covariance(self.columns))
            statistics = self._measured().statistics(self._residual_at(theta), self.weight, cofactors)
            self.judged = state.solution, cofactors, statistics
        return self.judged[1], self.judged[2]

    def _measured(self) -> InSigmas:
        """What makes lines and samples of the residuals at the present linearisation."""
        known = self._in_sigmas
        if known is None or known[0] is not self.lin or known[1] is not self.rays:
            self._in_sigmas = known = self.lin, self.rays, InSigmas.of(self.rays, self.lin, self.whitening)
        return known[2]

    def _residual_at(self, theta: Array) -> Array:
        """Whitened residuals (2, n) of the linear equations at values (u,) of the unknowns and the present points.

        They are as good as the linearisation, which follows the unknowns (`relinearisation`).
        """
        n = len(self.rays)
        rows = self.full_rows.reshape(2 * n, -1)
        shift = (self.points_l - self.origin_l).take(self.rays.point, axis=0)
        moved = np.einsum("ckn,nk->cn", self.lin.point, shift) + (rows @ (theta - self.theta)).reshape(n, 2).T
        return self.lin.residual - moved
