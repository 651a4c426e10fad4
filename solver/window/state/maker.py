"""Batches made of points: their rays with the measured orientation, their unknowns, and where the points are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ...adjustment.layout import Layout
from ...adjustment.network import Rays
from ...arrays import Array, Bools, IntArray
from ...geometry.measured_trajectory import MeasuredPoses
from ...geometry.ray_intersection import intersect_rays
from ...geometry.rotation import corrected_angles, matrix_from_angles
from ...models.base import Design, PseudoObservations
from .batch import Batch, PointTies
from .network import LiveNetwork
from .points import PointLooks

_NO_PRIOR = PseudoObservations(np.empty((0, 1), np.int32), np.empty((0, 1)), np.empty(0), np.empty(0), ())

_DIAGONAL = np.eye(6)

#: Rounds in which the known point nearest to where a ray meets the ground is looked for.
NEAREST = 3


@dataclass(frozen=True)
class Draft:
    """Points that are to become a batch, with what earlier strips say of them if these have seen all of them."""

    names: list[str]
    points: list[PointLooks]
    ties: PointTies | None = None


@dataclass(frozen=True)
class BatchMaker:
    """Makes batches of points; what it needs to know stands still over a flight."""

    network: LiveNetwork

    def rays(self, points: list[PointLooks]) -> tuple[Rays, Array, Array, MeasuredPoses]:
        """Rays of points, the white noise (n, 6, 6) of their orientation, weights (n,), and the orientation itself.

        To the noise belongs what the model leaves out, which is added where its design is looked up.
        """
        place = {id: i for i, id in enumerate(self.network.strips)}
        line_index = self.network.camera.line_index
        rows = []
        for p, point in enumerate(points):
            for source in sorted(range(len(point.looks)), key=point.time_s.__getitem__):
                k = point.looks[source]
                rows.append(
                    (p, place[k.strip], line_index[k.ccd], source, k.line, k.sample, k.sigma_line_px,
                     k.sigma_sample_px, point.time_s[source], point.weight[source])
                )  # fmt: skip
        table = np.array(rows)
        point_, strip, ccd, source = table[:, :4].T.astype(np.int64)
        line, sample, sigma_line, sigma_sample, time, weight = table[:, 4:].T
        xy, pitch = self.network.camera.image_coordinates(ccd, sample)
        period = np.array([1.0 / s.line_rate_hz for s in self.network.strips.values()])[strip]
        measured = self.network.trajectory.at(time)
        covariance = self.network.pose_noise.of_rays(measured)
        poses, focal = measured.poses, self.network.camera.focal_length_mm[ccd]
        sigma_line, sigma_sample = sigma_line * self.network.sigmas.image, sigma_sample * self.network.sigmas.image
        rays = Rays(
            point_, strip, ccd, source, line, sample, sigma_line, sigma_sample, time, period,
            poses.position_l, poses.angles, poses.velocity_l, poses.angle_rate, xy, pitch, focal,
        )  # fmt: skip
        return rays, covariance, weight, measured

    def _measured(self, time_s: Array, strip: IntArray) -> tuple[MeasuredPoses, Array]:
        """Measured orientation of rays, and the covariance (n, 6, 6) of its noise with what the model leaves out."""
        measured = self.network.trajectory.at(time_s)
        covariance = self.network.pose_noise.of_rays(measured)
        ids = list(self.network.strips)
        for i, mine in _by_strip(strip):
            extra = self.network.strips[ids[i]].model.left_out_variance(time_s[mine])
            covariance[mine] += extra[:, :, None] * _DIAGONAL
        return measured, covariance

    def make(self, draft: Draft, known: dict[str, Array]) -> Batch | None:
        """A batch of those points that can be placed, linearised where they are now; None if there are none.

        Parameters
        ----------
        known : coordinates of points that were placed before
        """
        return self.make_each([draft], known)[0]

    def make_single(self, names: list[str], points: list[PointLooks], ground_l: Array) -> Batch | None:
        """A batch of points of one look each, linearised where its ray meets the ground: the surface that points lie
        on, or else the height of the nearest known point.

        Parameters
        ----------
        ground_l : (m, 3) points on the ground
        """
        rays, *_ = self.rays(points)
        image = np.column_stack([rays.xy_mm, -rays.focal_length_mm])
        direction = np.einsum("nij,nj->ni", matrix_from_angles(*rays.angles.T), image)
        direction /= direction[:, 2:]
        height = np.full(len(names), np.median(ground_l[:, 2]))
        surface = self.network.surface.control
        for _ in range(NEAREST):
            place = rays.position_l + (height - rays.position_l[:, 2])[:, None] * direction
            apart = ((ground_l[:, :2] - place[:, None, :2]) ** 2).sum(axis=2)
            height = ground_l[np.argmin(apart, axis=1), 2]
            if surface is not None:
                on_surface = surface.height(place[:, 0], place[:, 1])
                height = np.where(np.isfinite(on_surface), on_surface, height)
        place = rays.position_l + (height - rays.position_l[:, 2])[:, None] * direction
        batch = self.make(Draft(names, points), dict(zip(names, place, strict=True)))
        if batch is not None:  # onto the ray as it is corrected
            theta = self.network.state.values(batch.columns)
            batch.back_substitute(theta)
            batch.linearise(theta, reweigh=True)
        return batch

    def make_each(self, drafts: list[Draft], known: dict[str, Array]) -> list[Batch | None]:
        """Batches as `make` makes them, one of each draft; what their rays need is looked up for all at once."""
        if not drafts:
            return []
        rays, covariance, weight, measured = self.rays([point for draft in drafts for point in draft.points])
        ids = list(self.network.strips)
        parts = []
        for i, mine in _by_strip(rays.strip):
            strip, poses = self.network.strips[ids[i]], measured.poses.part(mine)
            of_strip, extra = strip.design_and_left_out(rays.time_s[mine], poses)
            covariance[mine] += extra[:, :, None] * _DIAGONAL
            parts.append((mine, of_strip))
        design = join_designs(parts, len(rays))
        made, point = [], 0
        for draft in drafts:
            low, high = np.searchsorted(rays.point, (point, point + len(draft.names))).tolist()
            part = slice(low, high)
            own = rays.part(part)
            if point:
                own = replace(own, point=own.point - point)
            columns = Design(design.columns[part], design.coefficients[part])
            provisional = not bool(measured.smoothed[part].all())
            made.append(self._batch(draft, known, own, columns, covariance[part], weight[part], provisional))
            point += len(draft.names)
        return made

    def _batch(
        self,
        draft: Draft,
        known: dict[str, Array],
        rays: Rays,
        design: Design,
        covariance: Array,
        weight: Array,
        provisional: bool,
    ) -> Batch | None:
        """One of `make_each`."""
        names, points, ties = draft.names, draft.points, draft.ties
        columns, layout = self._layout(rays, design)
        used = np.array([p.spent for p in points])
        if ties is not None:
            columns, used = np.concatenate([columns, ties.columns]), ties.used
            # one look places no point
            seen = np.bincount(rays.point, weight > 0, len(names))
            known = {n: xyz for n, xyz, k in zip(names, ties.xyz_l, seen, strict=True) if k < 2} | known
        control = self.network.intake.known_coordinates(names, used)
        theta = self.network.state.values(columns)
        points_l = self._place(draft, rays, weight, layout, theta, known)
        placed = np.flatnonzero(np.isfinite(points_l).all(axis=1))
        if not len(placed):
            return None
        if len(placed) < len(names):
            part = ties.part(placed) if ties is not None else None
            return self.make(Draft([names[i] for i in placed], [points[i] for i in placed], part), known)
        batch = Batch(
            list(names), rays, covariance, columns, layout, control, weight, points_l, provisional, ties,
            self.network.surface.control, self._on_surface(names, points, ties),
        )  # fmt: skip
        batch.noise_version, batch.image_factor = self.network.noise_version, self.network.sigmas.image
        batch.linearise(theta, reweigh=True)
        return batch

    def _on_surface(self, names: list[str], points: list[PointLooks], ties: PointTies | None) -> Bools:
        """Points (p,) that a height of the surface is wanted for: seen twice, without coordinates of their own, and
        without what an earlier strip says of them, which has it."""
        control = self.network.intake.control
        new = np.array([name not in control and not p.spent for name, p in zip(names, points, strict=True)])
        if ties is not None:
            return new & ties.single
        return new & np.array([len(p.looks) >= 2 for p in points])

    def _layout(self, rays: Rays, design: Design) -> tuple[IntArray, Layout]:
        """The unknowns that rays touch, by their number in the window, and a layout that counts them from 0.

        All additional parameters and the shift of the surface count as touched.
        """
        place = np.full(int(design.columns.max()) + 2, -1)  # of each unknown; the last one is that of -1, none
        place[design.columns] = 0
        touched = np.flatnonzero(place[:-1] == 0)
        place[touched], place[-1] = np.arange(len(touched)), -1
        local = place[design.columns]
        node, component = np.nonzero((design.columns >= 0).any(axis=0))
        camera, of_camera, of_surface = None, self.network.camera_columns, self.network.surface.numbers
        if self.network.self_calibration is not None:
            camera = self.network.self_calibration.design(rays.ccd, rays.sample, rays.xy_mm, rays.focal_length_mm)
        layout = Layout(
            (), rays.strip, node, component, np.ascontiguousarray(local[:, node, component].T.astype(np.int32)),
            np.ascontiguousarray(design.coefficients.T), camera, len(touched), len(of_camera), (), _NO_PRIOR,
            heading=True, n_surface=len(of_surface),
        )  # fmt: skip
        return np.concatenate([touched, of_camera, of_surface]), layout

    def _place(
        self, draft: Draft, rays: Rays, weight: Array, layout: Layout, theta: Array, known: dict[str, Array]
    ) -> Array:
        """Where points are (p, 3): as known, at full control not in doubt, or where their rays meet; else NaN."""
        names, correction, displacement = draft.names, layout.corrections(theta), layout.displacement(theta)
        angles = corrected_angles(rays.angles, correction[3:].T)
        image = np.column_stack([(rays.xy_mm.T - displacement).T, -rays.focal_length_mm])
        direction = np.einsum("nij,nj->ni", matrix_from_angles(*angles.T), image)
        use = np.flatnonzero(weight > 0)
        xyz, _ = intersect_rays((rays.position_l + correction[:3].T)[use], direction[use], rays.point[use], len(names))
        control = self.network.intake.control
        for i, (name, point) in enumerate(zip(names, draft.points, strict=True)):
            if name in known:
                xyz[i] = known[name]
            elif name in control and (control[name].weight > 0).all() and not point.out:
                xyz[i] = control[name].xyz_l
        return xyz

    def refresh(self, batches: list[Batch]) -> None:
        """Put newer measured orientation under the rays of batches, with the noise that is known now."""
        rays = [batch.rays for batch in batches]
        measured, covariance = self._measured(
            np.concatenate([r.time_s for r in rays]), np.concatenate([r.strip for r in rays])
        )
        p = measured.poses
        end = np.cumsum([len(r) for r in rays]).tolist()
        for batch, low, high in zip(batches, [0, *end], end, strict=False):
            part = slice(low, high)
            batch.pose_covariance, batch.noise_version = covariance[part], self.network.noise_version
            image = self.network.sigmas.image / batch.image_factor
            batch.image_factor = self.network.sigmas.image
            batch.rays = replace(
                batch.rays, position_l=p.position_l[part], angles=p.angles[part], velocity_l=p.velocity_l[part],
                angle_rate=p.angle_rate[part], sigma_line_px=image * batch.rays.sigma_line_px,
                sigma_sample_px=image * batch.rays.sigma_sample_px,
            )  # fmt: skip
            batch.provisional = not bool(measured.smoothed[part].all())


def _by_strip(strip: IntArray) -> list[tuple[int, slice | IntArray]]:
    """Which of n rays are of each strip, from the strips (n,) of all."""
    first = int(strip[0])
    if (strip == first).all():
        return [(first, slice(None))]
    return [(i, np.flatnonzero(strip == i)) for i in np.unique(strip).tolist()]


def join_designs(parts: Sequence[tuple[slice | IntArray, Design]], n: int) -> Design:
    """One design for n rays from designs of groups of them (places, design)."""
    if len(parts) == 1:
        return parts[0][1]
    width = max(d.coefficients.shape[1] for _, d in parts)
    columns = np.full((n, width, 6), -1, dtype=np.int32)
    coefficients = np.zeros((n, width))
    for place, d in parts:
        k = d.coefficients.shape[1]
        columns[place, :k] = d.columns
        coefficients[place, :k] = d.coefficients
    return Design(columns, coefficients)
