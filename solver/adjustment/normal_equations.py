"""Normal equations with the object points eliminated (Schur complement), and the way back to the points.

With whitened equations ``r = J x + Jp p + v`` and ``V = Jp^T Jp + P_control = L L^T`` per point, the reduced system is
``S = J^T J + P_prior - D^T D``, ``b = J^T r + .. - D^T y`` with ``D = L^-1 Jp^T J``, ``y = L^-1 (Jp^T r + ..)``.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.sparse import csr_array

from ..arrays import Array, Bools, IntArray
from ..models.base import PseudoObservations
from .elimination import Cell, Cluster, Elimination
from .layout import Layout
from .linearisation import Linearisation
from .network import Control
from .normal_matrix import DENSE_UP_TO, NormalMatrix
from .reliability import normalised_residuals
from .surface_control import SurfaceRows

#: A pivot of a point's 3x3 matrix below this share of its diagonal counts as zero: that direction is not determined.
POINT_PIVOT = 1e-10
#: A singular value of a point's equations below this share of the largest counts as zero.
DETERMINED = 1e-6
#: Equations for which products are formed at a time.
BATCH = 32768
#: Rays that clusters are joined up to while their rays are worked on.
SHARED = 6144


@dataclass(frozen=True)
class Prior:
    """Whitened a-priori equations ``value = matrix @ theta`` and their normal matrix; without those of no weight."""

    matrix: csr_array
    value: Array
    normal: csr_array

    @classmethod
    def of(cls, matrix: csr_array, value: Array) -> Prior:
        """From whitened equations."""
        return cls(matrix, value, csr_array(matrix.T.tocsr() @ matrix))

    @property
    def n_observations(self) -> int:
        return len(self.value)

    def residual(self, theta: Array) -> Array:
        """Whitened residuals (m,)."""
        return self.value - self.matrix @ theta

    def without(self, column: int) -> Prior:
        """Without the equations of an unknown, which is free then."""
        keep = np.flatnonzero(np.asarray(abs(self.matrix[:, [column]]).sum(axis=1)).ravel() == 0.0)
        return Prior.of(csr_array(self.matrix[keep]), self.value[keep])


def whiten_prior(prior: PseudoObservations, n_unknowns: int) -> Prior:
    """Sparse matrix and right-hand side of the pseudo-observations that carry weight."""
    keep = np.flatnonzero(np.isfinite(prior.sigma))
    weight = 1.0 / prior.sigma[keep]
    columns, coefficients = prior.columns[keep], prior.coefficients[keep] * weight[:, None]
    present = columns >= 0
    ends = np.append(0, np.cumsum(present.sum(axis=1)))
    matrix = csr_array((coefficients[present], columns[present], ends), shape=(len(keep), n_unknowns))
    return Prior.of(matrix, prior.value[keep] * weight)


def row_variances(B: Any, factor: Any) -> Array:
    """Diagonal (m,) of ``B Q B^T`` for whitened equations B (m, n_unknowns) of a factorised reduced system."""
    entries = np.diff(B.indptr)
    if entries.max(initial=0) <= 1:
        square = B.multiply(B)
        return np.asarray(square @ factor.variances()).ravel()
    if B.shape[1] > DENSE_UP_TO:
        found = np.empty(B.shape[0])
        for row in range(B.shape[0]):
            own = slice(*B.indptr[row : row + 2].tolist())
            b = B.data[own]
            found[row] = b @ factor.cofactors(B.indices[own].astype(np.int64)) @ b
        return found
    Q = factor.cofactors(np.arange(B.shape[1]))
    return np.asarray(B.multiply(B @ Q).sum(axis=1)).ravel()


@dataclass(frozen=True)
class ControlWeights:
    """Weights (p, 3) and target coordinates (p, 3) of all points; weight 0 where nothing is given.

    ``surface``: equations of points that lie on a surface, None if there is none.
    """

    weight: Array
    xyz_l: Array
    surface: SurfaceRows | None = None

    @property
    def n_observations(self) -> int:
        """Coordinates with weight."""
        return int(np.count_nonzero(self.weight > 0))

    def residual(self, points_l: Array) -> Array:
        """Whitened (p, 3): given minus estimated."""
        return np.sqrt(self.weight) * (self.xyz_l - points_l)

    def normalised(self, points_l: Array, cofactors: Array) -> Array:
        """Normalised residuals (p, 3), estimated minus given, with cofactors (p, 3, 3) of the points; 0 where nothing
        is given or nothing else controls a coordinate."""
        q = 1.0 - self.weight * np.einsum("pii->pi", cofactors)
        return np.where(self.weight > 0, normalised_residuals(-self.residual(points_l), q), 0.0)


def weigh_control(control: Control, n_points: int) -> ControlWeights:
    """Spread control over all points; a point given twice gets the weighted mean."""
    weight, moment = np.zeros((n_points, 3)), np.zeros((n_points, 3))
    given = np.isfinite(control.sigma_m)
    w = np.where(given, 1.0 / np.where(given, control.sigma_m, 1.0) ** 2, 0.0)
    np.add.at(weight, control.point, w)
    np.add.at(moment, control.point, w * np.where(given, control.xyz_l, 0.0))
    return ControlWeights(weight, moment / np.where(weight > 0, weight, 1.0))


@dataclass(frozen=True)
class PointNormals:
    """Per point: inverse Cholesky factor ``L^-1`` and ``y``.

    Attributes
    ----------
    inverse_factor : (6, p) lower triangle 00, 10, 11, 20, 21, 22; rows of undetermined directions are zero
    y : (3, p)
    rank : (p,) number of determined directions
    surface : (3, p) coupling of each point to the shift of the surface it lies on, times the inverse factor
    """

    inverse_factor: Array
    y: Array
    rank: IntArray
    surface: Array | None = None

    def back(self, t: Array) -> Array:
        """``L^-T t`` for (3, p)."""
        a, b, c, d, e, f = self.inverse_factor
        return np.array([a * t[0] + b * t[1] + d * t[2], c * t[1] + e * t[2], f * t[2]])

    def covariance(self) -> Array:
        """``(L L^T)^-1`` as (p, 3, 3): what the points would have with known orientation."""
        a, b, c, d, e, f = self.inverse_factor
        zero = np.zeros_like(a)
        rows = np.array([np.array([a, zero, zero]), np.array([b, c, zero]), np.array([d, e, f])])
        return np.einsum("kin,kjn->nij", rows, rows)


def inverse_factors(normals: PointNormals) -> Array:
    """``L^-1`` (p, 3, 3) of the points' normal matrices ``L L^T``."""
    a, b, c, d, e, f = normals.inverse_factor
    zero = np.zeros_like(a)
    return np.stack([a, zero, zero, b, c, zero, d, e, f], axis=1).reshape(-1, 3, 3)


def without_point(design: Array, point: Array, residual: Array) -> tuple[Array, Array]:
    """What whitened equations (m, u), (m, 3), (m,) of one point say of the unknowns alone: (r, u), (r,), whitened."""
    U, s, _ = np.linalg.svd(point)
    left = U[:, int((s > DETERMINED * s[0]).sum()) :]
    return left.T @ design, left.T @ residual


@dataclass(frozen=True)
class Reduced:
    """The reduced system ``matrix @ d_theta = rhs`` and what leads back to the points."""

    matrix: NormalMatrix
    rhs: Array
    points: PointNormals


def point_normals(
    lin: Linearisation,
    index: IntArray,
    p: int,
    control: ControlWeights,
    points_l: Array,
    damping: float = 0.0,
    shift_m: float = 0.0,
) -> PointNormals:
    """Normal matrices of p points, factorised; ``index`` (n,) is the point of each ray, ``shift_m`` of the surface."""
    j, r = lin.point, lin.residual

    def total(values: Array) -> Array:
        return np.bincount(index, values, p).astype(float, copy=False)

    pairs = ((0, 0), (1, 0), (1, 1), (2, 0), (2, 1), (2, 2))
    v = [total(j[0, a] * j[0, b] + j[1, a] * j[1, b]) for a, b in pairs]
    g = np.array([total(j[0, a] * r[0] + j[1, a] * r[1]) for a in range(3)])
    g += (control.weight * (control.xyz_l - points_l)).T
    surface, m = control.surface, np.empty((3, 0))
    if surface is not None:
        m = surface.normal.T * surface.weight
        v = [own + m[a] * surface.normal[:, b] for own, (a, b) in zip(v, pairs, strict=True)]
        g += m * np.where(surface.weight > 0, surface.off(points_l, shift_m), 0.0)
    for axis, diagonal in enumerate((0, 2, 5)):
        v[diagonal] = (v[diagonal] + control.weight[:, axis]) * (1.0 + damping)

    def pivot(value: Array, whole: Array) -> tuple[Array, Bools]:
        good = value > POINT_PIVOT * whole
        return np.where(good, 1.0 / np.sqrt(np.where(good, value, 1.0)), 0.0), good

    a, good_a = pivot(v[0], v[0])
    l10, l20 = v[1] * a, v[3] * a
    c, good_c = pivot(v[2] - l10 * l10, v[2])
    l21 = (v[4] - l20 * l10) * c
    f, good_f = pivot(v[5] - l20 * l20 - l21 * l21, v[5])
    b = -l10 * a * c
    e = -l21 * c * f
    d = -(l20 * a + l21 * b) * f
    y = np.array([a * g[0], b * g[0] + c * g[1], d * g[0] + e * g[1] + f * g[2]])
    rank = good_a.astype(np.int64) + good_c + good_f
    of_shift = None
    if surface is not None:
        of_shift = np.array([a * m[0], b * m[0] + c * m[1], d * m[0] + e * m[1] + f * m[2]])
    return PointNormals(np.array([a, b, c, d, e, f]), y, rank, of_shift)


def reduce_normals(
    lin: Linearisation,
    layout: Layout,
    elimination: Elimination,
    prior: Prior,
    control: ControlWeights,
    theta: Array,
    points_l: Array,
    damping: float = 0.0,
) -> Reduced:
    """Reduced normal equations at a linearisation: at unknowns ``theta`` (u,) and points (p, 3), local frame.

    ``damping`` multiplies all diagonals by ``1 + damping`` (Levenberg-Marquardt).
    """
    matrix = elimination.new_matrix()
    matrix.add_sparse(prior.normal)
    rhs = prior.matrix.T @ prior.residual(theta)
    add_cells(matrix, rhs, lin, layout, elimination)
    surface, shift_m = control.surface, layout.shift_of(theta)
    if surface is not None:
        place = np.array([layout.shift_column])
        matrix.add_each(place[None], surface.weight.sum()[None, None, None])
        rhs[place] += np.sqrt(surface.weight) @ surface.residual(points_l, shift_m)
    if damping:
        matrix.damp(damping)
    matrix.keep_scale()
    points = point_normals(lin, elimination.point, elimination.n_points, control, points_l, damping, shift_m)
    for cluster, D in couplings(lin, layout, elimination, points):
        D[:, -1] = points.y[:, cluster.points].ravel()
        product = D.T @ D
        rhs[cluster.columns] -= product[:-1, -1]
        matrix.subtract(cluster.columns, product[:-1, :-1])
    return Reduced(matrix, rhs, points)


def add_cells(matrix: NormalMatrix, rhs: Array, lin: Linearisation, layout: Layout, elimination: Elimination) -> None:
    """Add ``J^T J`` to a matrix and ``J^T r`` to its right-hand side (n_unknowns,), one dense product per cell."""
    batch: list[Cell] = []
    held = 0
    for cell in elimination.cells:
        batch.append(cell)
        held += cell.high - cell.low
        if held >= BATCH:
            _add_batch(matrix, rhs, lin, layout, elimination, batch)
            batch, held = [], 0
    if batch:
        _add_batch(matrix, rhs, lin, layout, elimination, batch)


def _add_batch(
    matrix: NormalMatrix,
    rhs: Array,
    lin: Linearisation,
    layout: Layout,
    elimination: Elimination,
    batch: list[Cell],
) -> None:
    low = batch[0].low
    J = _rows(lin, layout, elimination.by_cell[low : batch[-1].high])
    columns = np.stack([cell.columns for cell in batch])
    m = layout.platform.n_unknowns
    if m:  # an unknown of the platform acts on several components: its terms, one after the other, are one
        T = len(layout.node)
        first = T - int(np.isin(layout.columns[:, 0], layout.platform_columns).sum())
        ends = np.searchsorted(layout.columns[first:, 0], layout.platform_columns)
        J = np.concatenate([J[:first], np.add.reduceat(J[first:T], ends), J[T:]])
        of_platform = np.broadcast_to(layout.platform_columns, (len(batch), m))
        columns = np.concatenate([columns[:, :first], of_platform, columns[:, T:]], axis=1)
    blocks = np.empty((len(batch), len(J), len(J)))
    for cell, block in zip(batch, blocks, strict=True):
        own = J[:, cell.low - low : cell.high - low]
        np.matmul(own, own.T, out=block)
    matrix.add_each(columns, blocks[:, :-1, :-1])
    counts = columns >= 0
    np.add.at(rhs, columns[counts], blocks[:, :-1, -1][counts])


def _rows(lin: Linearisation, layout: Layout, equations: IntArray) -> Array:
    """Some whitened equations (m,), as `Elimination.by_cell` counts them: (q + 1, m) by their terms, and residuals."""
    T, slots, n = len(layout.node), lin.camera.shape[1], lin.residual.shape[1]
    of_y = equations >= n
    rays = equations - n * of_y
    J = np.empty((T + slots + 1, len(rays)))

    def gather(values: Array, into: Array) -> None:
        """Rows (k, n) of x and of y, each into a row (m,) of its own."""
        flat, place = values.reshape(-1), rays + values.shape[1] * n * of_y
        for row in into:
            flat.take(place, out=row, mode="clip")  # the default mode would copy once more
            place += n

    orientation = np.empty((6, len(rays)))
    gather(lin.orientation, orientation)
    gather(lin.camera, J[T:-1])
    gather(lin.residual[:, None], J[-1:])
    coefficients = layout.coefficients.take(rays, axis=1)
    for t, (k, c) in enumerate(zip(layout.node, layout.component, strict=True)):
        np.multiply(orientation[c], coefficients[k], out=J[t])
    return J


def couplings(
    lin: Linearisation, layout: Layout, elimination: Elimination, points: PointNormals
) -> Iterator[tuple[Cluster, Array]]:
    """Clusters with their ``D`` (3 points, U + 1), rows axis by axis; the last column is nothing."""
    clusters = elimination.clusters
    first = 0
    while first < len(clusters):  # neighbouring clusters share the work on single rays
        last = first + 1
        while last < len(clusters) and clusters[last].rays.stop - clusters[first].rays.start <= SHARED:
            last += 1
        rays = slice(clusters[first].rays.start, clusters[last - 1].rays.stop)
        terms = _coupling_terms(lin, layout, points, elimination.point, rays)
        for cluster in clusters[first:last]:
            own = terms[:, :, cluster.rays.start - rays.start : cluster.rays.stop - rays.start]
            D = _coupling(own, cluster)
            if points.surface is not None:
                place = int(np.searchsorted(cluster.columns, layout.shift_column))
                D.reshape(3, cluster.n_points, -1)[:, :, place] += points.surface[:, cluster.points]
            yield cluster, D
        first = last


def _coupling_terms(lin: Linearisation, layout: Layout, points: PointNormals, point: IntArray, rays: slice) -> Array:
    """``L^-1 Jp^T J`` of rays: (3, q, n) by the terms they have."""
    T, slots = len(layout.node), lin.camera.shape[1]
    a, b, c, d, e, f = points.inverse_factor.take(point[rays], axis=1)
    j0, j1, j2 = lin.point[:, 0, rays], lin.point[:, 1, rays], lin.point[:, 2, rays]
    orientation, camera = lin.orientation[:, :, rays], lin.camera[:, :, rays]
    coefficients = layout.coefficients[:, rays]
    terms = np.empty((3, T + slots, len(a)))
    for k, w in enumerate((a * j0, b * j0 + c * j1, d * j0 + e * j1 + f * j2)):
        eo = w[0] * orientation[0]
        eo += w[1] * orientation[1]
        for t, (node, component) in enumerate(zip(layout.node, layout.component, strict=True)):
            np.multiply(coefficients[node], eo[component], out=terms[k, t])
        if slots:
            np.multiply(w[0], camera[0], out=terms[k, T:])
            terms[k, T:] += w[1] * camera[1]
    return terms


def _coupling(terms: Array, cluster: Cluster) -> Array:
    place = cluster.place.ravel().astype(np.intp)
    D = np.zeros((3, cluster.n_points * (len(cluster.columns) + 1)))
    for of_axis, values in zip(D, terms, strict=True):
        np.add.at(of_axis, place, values.ravel())  # two thirds of what np.bincount takes
    return D.reshape(3 * cluster.n_points, -1)


def change_of_rays(lin: Linearisation, layout: Layout, d_theta: Array) -> Array:
    """``J d_theta`` (2, n): what a change of the reduced unknowns does to the computed coordinates, whitened."""
    d_eo = layout.corrections(d_theta)
    change = np.einsum("ckn,kn->cn", lin.orientation, d_eo)
    if layout.camera is not None:
        change += np.einsum("csn,sn->cn", lin.camera, layout.camera.values_of(d_theta[layout.n_model :]))
    return change


def back_substitute(
    lin: Linearisation, layout: Layout, elimination: Elimination, points: PointNormals, d_theta: Array
) -> Array:
    """Change of the object points (p, 3) that goes with a change of the reduced unknowns."""
    change = change_of_rays(lin, layout, d_theta)
    p, index = elimination.n_points, elimination.point
    t = [np.bincount(index, lin.point[0, a] * change[0] + lin.point[1, a] * change[1], p) for a in range(3)]
    a, b, c, d, e, f = points.inverse_factor
    rest = points.y - np.array([a * t[0], b * t[0] + c * t[1], d * t[0] + e * t[1] + f * t[2]])
    if points.surface is not None:
        rest -= points.surface * layout.shift_of(d_theta)
    return points.back(rest).T
