"""A block as arrays: strips, rays, object points, control; what an adjustment works on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..arrays import Array, Bools, IntArray
from ..camera.line_camera import LineCamera
from ..geometry.ray_intersection import intersect_rays
from ..geometry.rotation import matrix_from_angles
from ..geometry.trajectory import Trajectory, noise_between, sample_before
from .surface_control import SurfaceControl

#: A look whose own time is off that by the rate of its strip by less, s, has that of the rate, rounded. Definition.
SAME_S = 1e-6
#: A time that is farther off is not that of the line: s, and share of the time since the strip began. Definition.
OTHER_S, OTHER_SHARE = 5.0, 0.2
#: Roles of ground points.
ROLES = ("control", "planimetric", "height", "check")


def most_off(since_s: Array | float) -> Array | float:
    """How far the times (...) of lines may be off those by the rate of their strip, which began so long before, s."""
    return OTHER_S + OTHER_SHARE * abs(since_s)


@dataclass(frozen=True)
class Strip:
    """One pass: image lines with their times and the measured trajectory below them.

    Attributes
    ----------
    id : name
    trajectory : measured orientation, local frame, over the extent of the strip
    first_line_time_s, line_rate_hz : line ``u`` is imaged at ``first_line_time_s + u / line_rate_hz``
    lines : number of image lines; 0 when it is not known
    line_time_s : (lines,) times of the lines where a camera does not keep a constant rate; replaces the two above
    lens : lens of the camera this strip was taken through, where strips are given lens by lens
    noise : (k, 6, 6) covariance of the noise of the trajectory's k samples, m and rad; None where it is not known
    noise_time_s : lag at which that of the positions is correlated by 1/e; 0 = white
    gap_s : between samples of the trajectory that are farther apart there is no orientation
    """

    id: str
    trajectory: Trajectory
    first_line_time_s: float = 0.0
    line_rate_hz: float = 1.0
    lines: int = 0
    line_time_s: Array | None = field(default=None, repr=False)
    lens: str | None = None
    noise: Array | None = field(default=None, repr=False)
    noise_time_s: float = 0.0
    gap_s: float = np.inf

    def time_of(self, line: ArrayLike) -> Array:
        """Times of (fractional) image lines, seconds."""
        u = np.asarray(line, dtype=float)
        if self.line_time_s is None:
            return self.first_line_time_s + u / self.line_rate_hz
        return self._table(u) + (u - self._below(u)) * self.line_period(u)

    def line_period(self, line: ArrayLike) -> Array:
        """Time from one line to the next at image lines, seconds."""
        u = np.asarray(line, dtype=float)
        if self.line_time_s is None:
            return np.full(u.shape, 1.0 / self.line_rate_hz)
        return np.diff(self.line_time_s)[self._below(u)]

    def contains(self, line: ArrayLike, time_s: ArrayLike | None = None) -> Bools:
        """Which lines, imaged at times, lie on the strip and below its trajectory."""
        u = np.asarray(line, dtype=float)
        count = self.lines if self.line_time_s is None else len(self.line_time_s)
        inside = (u >= -0.5) & (u <= count - 0.5) if count else np.ones(u.shape, dtype=bool)
        return inside & self.oriented(self.time_of(u) if time_s is None else time_s)

    def oriented(self, time_s: ArrayLike) -> Bools:
        """Which times lie on the trajectory, and not in a gap of it."""
        t, samples_s = np.asarray(time_s, dtype=float), self.trajectory.time_s
        before = sample_before(samples_s, t)
        near = (samples_s[before + 1] - samples_s[before] <= self.gap_s) | (t == samples_s[before])
        return self.trajectory.covers(t) & (near | (t == samples_s[before + 1]))

    def _below(self, u: Array) -> NDArray[np.int_]:
        assert self.line_time_s is not None
        return np.clip(np.floor(u).astype(int), 0, len(self.line_time_s) - 2)

    def _table(self, u: Array) -> Array:
        assert self.line_time_s is not None
        return self.line_time_s[self._below(u)]


@dataclass(frozen=True)
class Rays:
    """Image measurements with everything that does not change in an adjustment; n rays, sorted by point.

    Attributes
    ----------
    point, strip, ccd : (n,) indices into the network's points, strips and the camera's CCD lines
    source : (n,) place of the ray in the arrays the network was built from
    line, sample : (n,) pixels, as measured
    sigma_line_px, sigma_sample_px : (n,)
    time_s, line_period_s : (n,)
    position_l, angles, velocity_l, angle_rate : (n, 3) measured orientation at the ray's time, local frame
    xy_mm : (n, 2) calibrated image coordinates, reduced to the principal point
    pitch_mm : (n, 2) their change per pixel along the CCD line
    focal_length_mm : (n,)
    orientation_noise : (n, 6, 6) covariance of the white noise of the measured orientation, or None
    """

    point: IntArray
    strip: IntArray
    ccd: IntArray
    source: IntArray
    line: Array
    sample: Array
    sigma_line_px: Array
    sigma_sample_px: Array
    time_s: Array
    line_period_s: Array
    position_l: Array
    angles: Array
    velocity_l: Array
    angle_rate: Array
    xy_mm: Array
    pitch_mm: Array
    focal_length_mm: Array
    orientation_noise: Array | None = None

    def __len__(self) -> int:
        return len(self.point)

    def part(self, which: slice | IntArray) -> Rays:
        """Some of the rays; a range of them as views."""
        given = {name: value for name, value in vars(self).items() if value is not None}
        return Rays(**{name: value[which] for name, value in given.items()})


@dataclass(frozen=True)
class Control:
    """Weighted coordinates of object points; m entries.

    Attributes
    ----------
    point : (m,) index of the point
    xyz_l : (m, 3) metres, local frame
    sigma_m : (m, 3); infinite where a coordinate is not given (heights of planimetric points and vice versa)
    """

    point: IntArray
    xyz_l: Array
    sigma_m: Array

    def __len__(self) -> int:
        return len(self.point)

    @property
    def n_observations(self) -> int:
        return int(np.isfinite(self.sigma_m).sum())


@dataclass(frozen=True)
class Network:
    """A block. Build it with `build_network`.

    Points stand in an order of neighbourhood, not in the caller's: look them up by `point_index`.

    Attributes
    ----------
    camera, strips : what took the images
    point_ids : (p,) names
    rays : image measurements, sorted by point
    first_ray : (p + 1,) rays of point i are ``first_ray[i]:first_ray[i + 1]``
    approximate_l : (p, 3) object points from linear intersection with the measured orientation
    control : weighted coordinates
    check : coordinates to compare with; their rays take part as those of tie points
    refused : rays left out when the network was built: (place in the caller's arrays, reason)
    heading : the attitude comes from an inertial system, so that an error of kappa is one of heading (`Layout.heading`)
    surface : on which points without given coordinates lie; None for none
    """

    camera: LineCamera
    strips: tuple[Strip, ...]
    point_ids: tuple[str, ...]
    rays: Rays
    first_ray: IntArray
    approximate_l: Array
    control: Control
    check: Control
    refused: tuple[tuple[int, str], ...] = ()
    heading: bool = False
    surface: SurfaceControl | None = None

    @property
    def n_points(self) -> int:
        return len(self.point_ids)

    @property
    def rays_per_point(self) -> IntArray:
        return np.diff(self.first_ray)

    def where_rays_meet(self, points: IntArray) -> Array:
        """Intersection (m, 3) of the measured rays of some points (m,), each named once, without what is given of them;
        the approximate place of a point that its rays do not determine."""
        place = np.full(self.n_points, -1)
        place[points] = np.arange(len(points))
        rays = self.rays.part(np.flatnonzero(place[self.rays.point] >= 0))
        met, known = intersect_rays(rays.position_l, _directions(rays), place[rays.point], len(points))
        return np.where(known[:, None], met, self.approximate_l[points])

    @cached_property
    def point_index(self) -> dict[str, int]:
        return {id: i for i, id in enumerate(self.point_ids)}

    @cached_property
    def strip_index(self) -> dict[str, int]:
        return {strip.id: i for i, strip in enumerate(self.strips)}

    def role(self) -> NDArray[np.str_]:
        """(p,) role of each point: control, planimetric, height, check or tie."""
        role = np.full(self.n_points, "tie", dtype="<U11")
        role[self.check.point] = "check"
        given = np.isfinite(self.control.sigma_m)
        full, flat = given.all(axis=1), given[:, :2].any(axis=1)
        role[self.control.point] = np.where(full, "control", np.where(flat, "planimetric", "height"))
        return role

    def with_orientation(self, position_l: Array, angles: Array) -> Network:
        """The same network with other orientations of the rays (n, 3), as a first adjustment refined them."""
        return replace(self, rays=replace(self.rays, position_l=position_l, angles=angles))


@dataclass(frozen=True)
class Measurements:
    """Image measurements as they come: n rays in any order.

    Attributes
    ----------
    point, strip, ccd : (n,) indices into the caller's point ids, strips, and the camera's CCD lines (-1: not known)
    line, sample : (n,) pixels
    sigma_line_px, sigma_sample_px : (n,)
    time_s : (n,) when the lines were imaged; None where that is as their strips say
    """

    point: IntArray
    strip: IntArray
    ccd: IntArray
    line: Array
    sample: Array
    sigma_line_px: Array
    sigma_sample_px: Array
    time_s: Array | None = None

    def times(self, strip: Strip, which: IntArray) -> Array:
        """Times of some (k,) of a strip."""
        return strip.time_of(self.line[which]) if self.time_s is None else self.time_s[which]


def build_network(
    camera: LineCamera,
    strips: Sequence[Strip],
    point_ids: Sequence[str],
    measurements: Measurements,
    control: Control,
    check: Control | None = None,
) -> Network:
    """Put a block together: times, poses and image coordinates of all rays, approximate points, order of neighbourhood.

    Rays on an unknown strip or CCD, beyond the line's pixels, outside strip or trajectory, or with values that are not
    finite are left out and named in ``refused``. Points without rays stay where they are control, otherwise they go.

    Raises
    ------
    ValueError : no usable ray at all; indices of points that do not exist
    """
    if check is None:
        check = Control(np.empty(0, dtype=np.int64), np.empty((0, 3)), np.empty((0, 3)))
    m = measurements
    for name, points in (("rays", m.point), ("control", control.point), ("check points", check.point)):
        if len(points) and (np.min(points) < 0 or np.max(points) >= len(point_ids)):
            raise ValueError(f"{name} name point {int(np.max(points))}; there are {len(point_ids)} points")
    reasons = _reasons(camera, strips, m)
    good = np.flatnonzero(reasons == "")
    if not len(good):
        raise ValueError(f"none of {len(m.point)} rays can be used: {_first(reasons) or 'there are none'}")
    refused = tuple((int(i), str(reasons[i])) for i in np.flatnonzero(reasons != ""))

    rays = _rays(camera, strips, m, good)
    directions = _directions(rays)
    xyz, known = intersect_rays(rays.position_l, directions, rays.point, len(point_ids))
    ground = float(np.median(xyz[known, 2])) if known.any() else 0.0
    on_ground = _on_ground(rays, directions, ground, len(point_ids))
    xyz[~known] = on_ground[~known]
    xyz[control.point] = np.where(np.isfinite(control.sigma_m), control.xyz_l, xyz[control.point])
    used = np.asarray(np.isfinite(xyz).all(axis=1))
    used[control.point] = True
    xyz = np.where(np.isfinite(xyz), xyz, [0.0, 0.0, ground])

    order = np.flatnonzero(used)[neighbourhood_order(xyz[used, :2])]
    place = np.full(len(point_ids), -1)
    place[order] = np.arange(len(order))
    by_point = np.lexsort((rays.time_s, rays.strip, place[rays.point]))
    rays = rays.part(by_point)
    rays = replace(rays, point=place[rays.point])
    first_ray = np.searchsorted(rays.point, np.arange(len(order) + 1))
    seen = used[check.point]
    return Network(
        camera,
        tuple(strips),
        tuple(point_ids[int(i)] for i in order),
        rays,
        first_ray,
        xyz[order],
        Control(place[control.point], np.asarray(control.xyz_l, float), np.asarray(control.sigma_m, float)),
        Control(place[check.point[seen]], check.xyz_l[seen], check.sigma_m[seen]),
        refused,
    )


def _reasons(camera: LineCamera, strips: Sequence[Strip], m: Measurements) -> NDArray[np.str_]:
    """(n,) why a ray cannot be used; "" where it can."""
    reason = np.full(len(m.point), "", dtype="<U40")
    values = np.stack([m.line, m.sample, m.sigma_line_px, m.sigma_sample_px])
    reason[~np.isfinite(values).all(axis=0)] = "value is not finite"
    reason[(m.sigma_line_px <= 0) | (m.sigma_sample_px <= 0)] = "sigma is not positive"
    reason[(m.strip < 0) | (m.strip >= len(strips))] = "unknown strip"
    reason[(m.ccd < 0) | (m.ccd >= len(camera.lines))] = "unknown CCD line"
    for i, strip in enumerate(strips):
        mine = np.flatnonzero((m.strip == i) & (reason == ""))
        time = m.times(strip, mine)
        reason[mine[~strip.contains(m.line[mine], time)]] = "outside strip or trajectory"
        reason[mine[strip.trajectory.covers(time) & ~strip.oriented(time)]] = "in a gap of the trajectory"
        if strip.lens is not None:
            other = np.array([line.lens != strip.lens for line in camera.lines])
            reason[mine[other[m.ccd[mine]]]] = "CCD line of another lens"
    for k, line in enumerate(camera.lines):
        mine = np.flatnonzero((m.ccd == k) & (reason == ""))
        reason[mine[~line.contains(m.sample[mine])]] = "beyond the CCD line"
    return reason


def _first(reasons: NDArray[np.str_]) -> str:
    return next((str(r) for r in reasons if r), "")


def _rays(camera: LineCamera, strips: Sequence[Strip], m: Measurements, good: NDArray[np.int_]) -> Rays:
    strip, ccd, line, sample = m.strip[good], m.ccd[good], m.line[good], m.sample[good]
    n = len(good)
    time, period = np.empty(n), np.empty(n)
    pose = np.empty((4, n, 3))
    noise = np.zeros((n, 6, 6)) if any(s.noise is not None for s in strips) else None
    for i in np.unique(strip):
        mine = strip == i
        time[mine] = m.times(strips[i], good[mine])
        period[mine] = strips[i].line_period(line[mine])
        p = strips[i].trajectory.at(time[mine])
        pose[:, mine] = p.position_l, p.angles, p.velocity_l, p.angle_rate
        of_samples = strips[i].noise
        if noise is not None and of_samples is not None:
            noise[mine] = noise_between(strips[i].trajectory.time_s, of_samples, time[mine])
    xy, pitch = camera.image_coordinates(ccd, sample)
    return Rays(
        np.asarray(m.point)[good].astype(np.int64),
        strip.astype(np.int64),
        ccd.astype(np.int64),
        good.astype(np.int64),
        line,
        sample,
        m.sigma_line_px[good],
        m.sigma_sample_px[good],
        time,
        period,
        pose[0],
        pose[1],
        pose[2],
        pose[3],
        xy,
        pitch,
        camera.focal_length_mm[ccd],
        noise,
    )


def _directions(rays: Rays) -> Array:
    """Directions (n, 3) of the rays in the local frame, towards the ground."""
    image = np.column_stack([rays.xy_mm, -rays.focal_length_mm])
    return np.einsum("nij,nj->ni", matrix_from_angles(*rays.angles.T), image)


def _on_ground(rays: Rays, directions: Array, height: float, points: int) -> Array:
    """(points, 3) where a ray of each point meets a plane; NaN without rays."""
    xyz = np.full((points, 3), np.nan)
    down = np.flatnonzero(directions[:, 2] < 0)
    reach = (height - rays.position_l[down, 2]) / directions[down, 2]
    xyz[rays.point[down]] = rays.position_l[down] + reach[:, None] * directions[down]
    return xyz


def neighbourhood_order(xy: Array) -> IntArray:
    """Order of points (n, 2) along a Hilbert curve, so that near ones are near in the order too."""
    n = len(xy)
    if n < 2:
        return np.arange(n)
    low, side = xy.min(axis=0), float(np.ptp(xy, axis=0).max()) or 1.0
    cells = 1 << 16
    grid = np.minimum((xy - low) / side * cells, cells - 1).astype(np.int64)
    x, y = grid[:, 0], grid[:, 1]
    key = np.zeros(n, dtype=np.int64)
    s = cells >> 1
    while s:
        rx, ry = ((x & s) > 0).astype(np.int64), ((y & s) > 0).astype(np.int64)
        key += s * s * ((3 * rx) ^ ry)
        turn = (ry == 0) & (rx == 1)
        x, y = np.where(turn, s - 1 - (x & (s - 1)), x & (s - 1)), np.where(turn, s - 1 - (y & (s - 1)), y & (s - 1))
        x, y = np.where(ry == 0, y, x), np.where(ry == 0, x, y)
        s >>= 1
    return np.argsort(key, kind="stable")
