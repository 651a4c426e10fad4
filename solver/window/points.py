"""The points of the window: their looks as they arrive, and batches made of them."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..adjustment.network import Rays
from ..adjustment.normal_equations import ControlWeights
from ..camera import LineCamera
from ..intersection import intersect_rays
from ..measured_trajectory import MeasuredPoses, MeasuredTrajectory
from ..models.base import Design
from ..rotation import corrected_angles, matrix_from_angles
from ..selfcalibration import SelfCalibration
from .batch import Batch, join_designs, local_layout
from .pose_noise import PoseNoise
from .results import Look
from .state import WindowState
from .strip import WindowStrip

if TYPE_CHECKING:
    from .ties import EarlierStrips

Array = NDArray[np.floating]
IntArray = NDArray[np.int64]


#: Rounds in which the known point nearest to where a ray meets the ground is looked for.
NEAREST = 3


@dataclass
class ControlPoint:
    """Known coordinates: (3,) m with sigma (3,), infinite where not given; role as in the messages."""

    xyz_l: Array
    sigma_m: Array
    role: str

    @property
    def weight(self) -> Array:
        if self.role == "check":
            return np.zeros(3)
        return np.where(
            np.isfinite(self.sigma_m), 1.0 / np.where(np.isfinite(self.sigma_m), self.sigma_m, 1.0) ** 2, 0.0
        )


@dataclass
class PointLooks:
    """All looks at one point that the window knows; m of them.

    Attributes
    ----------
    looks : as they came
    time_s : (m,)
    weight : (m,) 0 for rejected ones
    returned, reported : looks that were taken back once; looks whose rejection was reported
    batch : where the point is, None while it waits for a second look
    out : control coordinates that were rejected
    alone : does not agree with what earlier strips say of it
    spent : known coordinates have been used by an earlier strip, whether or not the point ties that strip
    """

    looks: list[Look] = field(default_factory=list)
    time_s: list[float] = field(default_factory=list)
    weight: list[float] = field(default_factory=list)
    returned: set[int] = field(default_factory=set)
    reported: set[int] = field(default_factory=set)
    batch: Batch | None = None
    out: set[int] = field(default_factory=set)
    alone: bool = False
    spent: bool = False


@dataclass(frozen=True)
class Draft:
    """Points that are to become a batch; ``earlier`` are the earlier strips if these have seen all of them."""

    names: list[str]
    points: list[PointLooks]
    earlier: EarlierStrips | None = None


@dataclass(frozen=True)
class BatchMaker:
    """Makes batches of points; what it needs to know stands still over a flight."""

    camera: LineCamera
    trajectory: MeasuredTrajectory
    strips: dict[str, WindowStrip]
    state: WindowState
    control: dict[str, ControlPoint]
    self_calibration: SelfCalibration | None
    camera_columns: IntArray
    pose_noise: PoseNoise

    def rays(self, points: list[PointLooks]) -> tuple[Rays, Array, Array, NDArray[np.bool_]]:
        """Rays of points with the measured orientation, its white noise (n, 6, 6), weights (n,), and which of them
        (n,) have the smoothed one."""
        place = {id: i for i, id in enumerate(self.strips)}
        line_index = self.camera.line_index
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
        xy, pitch = self.camera.image_coordinates(ccd, sample)
        period = np.array([1.0 / s.line_rate_hz for s in self.strips.values()])[strip]
        measured, covariance = self._measured(time, strip)
        poses, focal = measured.poses, self.camera.focal_length_mm[ccd]
        rays = Rays(
            point_, strip, ccd, source, line, sample, sigma_line, sigma_sample, time, period,
            poses.position_l, poses.angles, poses.velocity_l, poses.angle_rate, xy, pitch, focal,
        )  # fmt: skip
        return rays, covariance, weight, measured.smoothed

    def _measured(self, time_s: Array, strip: IntArray) -> tuple[MeasuredPoses, Array]:
        """Measured orientation of rays, and the covariance (n, 6, 6) of its noise with what the model leaves out."""
        measured = self.trajectory.at(time_s)
        covariance = self.pose_noise.of_rays(measured)
        ids = list(self.strips)
        for i in np.unique(strip):
            mine = strip == i
            extra = self.strips[ids[i]].left_out_variance(time_s[mine])
            covariance[mine] += extra[:, :, None] * np.eye(6)
        return measured, covariance

    def make(
        self, names: list[str], points: list[PointLooks], known: dict[str, Array]
    ) -> tuple[Batch | None, list[str]]:
        """A batch of points, linearised where they are now, and the points that cannot be placed yet.

        Parameters
        ----------
        known : coordinates of points that were placed before
        """
        return self.make_each([Draft(names, points)], known)[0]

    def make_single(self, names: list[str], points: list[PointLooks], ground_l: Array) -> Batch | None:
        """A batch of points of one look each, linearised where its ray meets the ground at the height of the nearest
        known point.

        Parameters
        ----------
        ground_l : (m, 3) points on the ground
        """
        rays, *_ = self.rays(points)
        image = np.column_stack([rays.xy_mm, -rays.focal_length_mm])
        direction = np.einsum("nij,nj->ni", matrix_from_angles(*rays.angles.T), image)
        direction /= direction[:, 2:]
        height = np.full(len(names), np.median(ground_l[:, 2]))
        for _ in range(NEAREST):
            place = rays.position_l + (height - rays.position_l[:, 2])[:, None] * direction
            apart = ((ground_l[:, :2] - place[:, None, :2]) ** 2).sum(axis=2)
            height = ground_l[np.argmin(apart, axis=1), 2]
        place = rays.position_l + (height - rays.position_l[:, 2])[:, None] * direction
        batch, _ = self.make_each([Draft(names, points)], dict(zip(names, place, strict=True)))[0]
        if batch is not None:  # onto the ray as it is corrected
            theta = self.state.values(batch.columns)
            batch.back_substitute(theta)
            batch.linearise(theta, reweigh=True)
        return batch

    def make_each(self, drafts: list[Draft], known: dict[str, Array]) -> list[tuple[Batch | None, list[str]]]:
        """Batches as `make` makes them, one of each draft; what their rays need is looked up for all at once."""
        if not drafts:
            return []
        rays, covariance, weight, smoothed = self.rays([point for draft in drafts for point in draft.points])
        ids = list(self.strips)
        groups = [np.flatnonzero(rays.strip == i) for i in np.unique(rays.strip)]
        parts = [(mine, self.strips[ids[rays.strip[mine[0]]]].design(rays.time_s[mine])) for mine in groups]
        design = join_designs(parts, len(rays))
        made, point = [], 0
        for draft in drafts:
            low, high = np.searchsorted(rays.point, (point, point + len(draft.names))).tolist()
            part = slice(low, high)
            own = rays.part(part)
            own = replace(own, point=own.point - point)
            columns = Design(design.columns[part], design.coefficients[part])
            provisional = not bool(smoothed[part].all())
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
    ) -> tuple[Batch | None, list[str]]:
        """One of `make_each`."""
        names, points, earlier = draft.names, draft.points, draft.earlier
        columns, layout = local_layout(design, rays.strip, self.self_calibration, self.camera_columns, rays)
        ties = None
        control = self._weights(names, points, np.array([p.spent for p in points]))
        if earlier is not None:
            ties = earlier.ties(names, self._weights(names, points, np.zeros(len(names), dtype=bool)).weight)
            columns = np.concatenate([columns, ties.columns])
            control = self._weights(names, points, earlier.with_control(names))
            # one look places no point
            seen = np.bincount(rays.point, weight > 0, len(names))
            known = {n: xyz for n, xyz, k in zip(names, ties.xyz_l, seen, strict=True) if k < 2} | known
        theta = self.state.values(columns)
        in_doubt = {n for n, p in zip(names, points, strict=True) if p.out}
        points_l = self._place(
            names, rays, weight, layout.corrections(theta), layout.displacement(theta), known, in_doubt
        )
        placed = np.isfinite(points_l)
        lost = [name for i, name in enumerate(names) if not placed[i].all()]
        if lost:
            good = [i for i, n in enumerate(names) if n not in lost]
            if not good:
                return None, lost
            rest = Draft([names[i] for i in good], [points[i] for i in good], earlier)
            return self.make_each([rest], known)[0][0], lost
        batch = Batch(
            list(names), rays, covariance, columns, layout, control, weight, points_l, provisional, ties
        )  # fmt: skip
        batch.noise_version = self.pose_noise.version
        batch.linearise(theta, reweigh=True)
        return batch, []

    def _weights(self, names: list[str], points: list[PointLooks], used: NDArray[np.bool_]) -> ControlWeights:
        """Known coordinates; those ``used`` (p,) by earlier strips take no weight again."""
        weight, xyz = np.zeros((len(names), 3)), np.zeros((len(names), 3))
        for i, name in enumerate(names):
            if name in self.control:
                weight[i], xyz[i] = self.control[name].weight, np.nan_to_num(self.control[name].xyz_l)
                weight[i, list(points[i].out)] = 0.0
        weight[used] = 0.0
        return ControlWeights(weight, xyz, int((weight > 0).sum()))

    def _place(
        self,
        names: list[str],
        rays: Rays,
        weight: Array,
        correction: Array,
        displacement: Array | float,
        known: dict[str, Array],
        in_doubt: set[str],
    ) -> Array:
        """Where points are (p, 3): as known, at full control not in doubt, or where their rays meet; else NaN."""
        angles = corrected_angles(rays.angles, correction[3:].T)
        image = np.column_stack([(rays.xy_mm.T - displacement).T, -rays.focal_length_mm])
        direction = np.einsum("nij,nj->ni", matrix_from_angles(*angles.T), image)
        use = np.flatnonzero(weight > 0)
        xyz, _ = intersect_rays((rays.position_l + correction[:3].T)[use], direction[use], rays.point[use], len(names))
        for i, name in enumerate(names):
            if name in known:
                xyz[i] = known[name]
            elif name in self.control and (self.control[name].weight > 0).all() and name not in in_doubt:
                xyz[i] = self.control[name].xyz_l
        return xyz

    def refresh(self, batches: list[Batch]) -> None:
        """Put newer measured orientation under the rays of batches."""
        rays = [batch.rays for batch in batches]
        measured, covariance = self._measured(
            np.concatenate([r.time_s for r in rays]), np.concatenate([r.strip for r in rays])
        )
        p = measured.poses
        end = np.cumsum([len(r) for r in rays]).tolist()
        for batch, low, high in zip(batches, [0, *end], end, strict=False):
            part = slice(low, high)
            batch.pose_covariance, batch.noise_version = covariance[part], self.pose_noise.version
            batch.rays = replace(
                batch.rays, position_l=p.position_l[part], angles=p.angles[part], velocity_l=p.velocity_l[part],
                angle_rate=p.angle_rate[part],
            )  # fmt: skip
            batch.provisional = not bool(measured.smoothed[part].all())
