"""Simulated networks for adjustments: orientation, points and camera are known, every error is drawn as assumed.

Measured orientation = true - correction, where the corrections are drawn from the a-priori knowledge of a trajectory
model, so that an adjustment with the same model has exactly the errors it expects. Camera errors are additional
parameters; image noise, control noise and the wander that no model describes come on top.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..adjustment.network import Control, Measurements, Network, Strip, build_network
from ..camera.collinearity import collinearity
from ..camera.line_camera import CcdLine, LineCamera
from ..camera.self_calibration import SelfCalibration
from ..geometry.rotation import (
    angles_from_matrix,
    matrix_from_quaternion,
    quaternion_from_angles,
)
from ..geometry.trajectory import Trajectory
from ..models.base import CorrectionModel, Extent, ModelOptions
from .spectra import band_limited_noise

Array = NDArray[np.floating]
IntArray = NDArray[np.int64]

#: Spectrum of the wander of the measured orientation: corner and cutoff, Hz.
WANDER_HZ = (0.01, 0.1)


@dataclass(frozen=True)
class FlightLine:
    """One straight pass.

    Attributes
    ----------
    id : name of the strip
    start : (X, Y) of the first line, metres
    azimuth_deg : direction of flight, from X to Y
    length_m : between first and last line
    height_m : Z of the camera
    speed_m_s, line_rate_hz : of camera and lines
    """

    id: str
    start: tuple[float, float]
    azimuth_deg: float
    length_m: float
    height_m: float
    speed_m_s: float
    line_rate_hz: float

    @property
    def duration_s(self) -> float:
        return self.length_m / self.speed_m_s


@dataclass(frozen=True)
class Noise:
    """What is drawn at random besides the corrections of the model.

    Attributes
    ----------
    image_px : sigma of line and of sample
    control_m : sigmas X, Y, Z of control
    jitter_deg : attitude jitter of the platform (motion, not error): 0.05 on a stabilised mount, 0.4 without one
    jitter_hz : corner and cutoff frequency of its spectrum
    wander_m, wander_deg : slow errors of the measured orientation that no model describes
    """

    image_px: float = 0.3
    control_m: tuple[float, float, float] = (0.02, 0.02, 0.02)
    jitter_deg: float = 0.05
    jitter_hz: tuple[float, float] = (0.3, 2.0)
    wander_m: float = 0.0
    wander_deg: float = 0.0


@dataclass(frozen=True)
class SimulatedNetwork:
    """A network and the truth about it.

    Attributes
    ----------
    network : as it would be measured
    points_l : (p, 3) true object points, in the network's order
    corrections : true corrections of the model, by strip
    camera_parameters : true additional parameters, by name
    """

    network: Network
    points_l: Array
    corrections: dict[str, Array]
    camera_parameters: dict[str, float]


def parallel_and_cross(
    camera: LineCamera,
    height_m: float,
    strips: int,
    cross: int,
    length_m: float,
    speed_m_s: float = 70.0,
    sidelap: float = 0.4,
    ground_m: float = 0.0,
) -> tuple[FlightLine, ...]:
    """Parallel strips in alternating direction, and cross strips; pixels square on the ground.

    ``length_m`` is that of the part of the ground all lines of the camera see; strips are longer by the stereo base.
    """
    half_m, fore, aft, pixel = _field_of_view(camera)
    above = height_m - ground_m
    swath = 2 * half_m * above
    rate = speed_m_s / (pixel * above)
    spacing = swath * (1 - sidelap)
    width = swath + (strips - 1) * spacing
    base = (fore - aft) * above

    def line(id: str, along: float, across: float, azimuth: float, length: float) -> FlightLine:
        direction = np.radians(azimuth)
        u = np.array([np.cos(direction), np.sin(direction)])
        first = -length / 2 - fore * above
        start = along * u + across * np.array([-u[1], u[0]]) + first * u
        return FlightLine(id, (start[0], start[1]), azimuth, length + base, height_m, speed_m_s, rate)

    lines = []
    for i in range(strips):
        aside = (i - (strips - 1) / 2) * spacing
        back = i % 2 == 1
        lines.append(line(f"S{i + 1}", 0.0, -aside if back else aside, 180.0 if back else 0.0, length_m))
    for i in range(cross):
        aside = ((i + 1) / (cross + 1) - 0.5) * length_m
        lines.append(line(f"C{i + 1}", 0.0, -aside, 90.0, width))
    return tuple(lines)


def regular_block(
    camera: LineCamera,
    rng: np.random.Generator,
    errors: ModelOptions,
    points: int = 60,
    strips: int = 2,
    cross: int = 1,
    control: int = 5,
    length_m: float = 3000.0,
    height_m: float = 1800.0,
    noise: Noise = Noise(),
    self_calibration: SelfCalibration | None = None,
    camera_parameters: Mapping[str, float] | None = None,
) -> SimulatedNetwork:
    """A block over rolling ground: parallel and cross strips, points at random, every seventh one a check point.

    Up to five points are control: those nearest the corners and the middle. The other arguments are as in
    `parallel_and_cross` and `simulate_network`.
    """
    lines = parallel_and_cross(camera, height_m, strips, cross, length_m)
    half_x, half_y = length_m / 2, (1 + 0.6 * (strips - 1)) * _field_of_view(camera)[0] * height_m
    xyz = scatter_points(
        points, (-half_x, half_x, -half_y, half_y), lambda x, y: 60 * np.sin(x / 700) + 40 * np.cos(y / 500), rng
    )
    wanted = ((-0.8, -0.8), (0.8, 0.8), (-0.8, 0.8), (0.8, -0.8), (0.0, 0.0))
    near = [int(np.argmin(np.hypot(xyz[:, 0] - a * half_x, xyz[:, 1] - b * half_y))) for a, b in wanted]
    check = [i for i in range(0, points, 7) if i not in near]
    roles = {i: "control" for i in near[:control]}
    return simulate_network(camera, lines, xyz, roles, check, errors, rng, noise, self_calibration, camera_parameters)


def simulate_network(
    camera: LineCamera,
    lines: tuple[FlightLine, ...],
    points_l: Array,
    control: Mapping[int, str],
    check: ArrayLike,
    errors: ModelOptions,
    rng: np.random.Generator,
    noise: Noise = Noise(),
    self_calibration: SelfCalibration | None = None,
    camera_parameters: Mapping[str, float] | None = None,
    pose_rate_hz: float = 100.0,
) -> SimulatedNetwork:
    """Fly, measure, disturb.

    Parameters
    ----------
    camera : as calibrated; the true one differs by `camera_parameters` of `self_calibration`
    lines : what is flown
    points_l : (p, 3) true object points
    control : role (control, planimetric, height) of some points, by index
    check : indices of check points
    errors : model whose unknowns are drawn from its a-priori knowledge
    rng : source of all noise
    noise : sigmas
    pose_rate_hz : of the trajectory
    """
    points_l = np.asarray(points_l, dtype=float)
    values = dict(camera_parameters or {})
    true_camera = disturb_camera(camera, self_calibration, values) if self_calibration and values else camera
    strips, corrections, looks = [], {}, []
    for s, line in enumerate(lines):
        truth = fly(line, noise, pose_rate_hz, rng)
        first = truth.start_s + 0.5
        strip = Strip(line.id, truth, first, line.line_rate_hz, int(line.duration_s * line.line_rate_hz))
        looks.append(looks_of(true_camera, strip, line, points_l, s))
        model = errors.build(Extent(f"strip {line.id}", truth.start_s, truth.end_s))
        corrections[line.id] = draw_unknowns(model, rng)
        measured = measured_trajectory(truth, model, corrections[line.id], noise, rng)
        strips.append(replace(strip, trajectory=measured))
    point, strip_of, ccd, u, v = (np.concatenate(a) for a in zip(*looks, strict=True))
    u = u + rng.normal(0.0, noise.image_px, len(u))
    v = v + rng.normal(0.0, noise.image_px, len(v))
    sigma = np.full(len(u), noise.image_px)
    ids = [f"P{i}" for i in range(len(points_l))]
    network = build_network(
        camera,
        strips,
        ids,
        Measurements(point, strip_of, ccd, u, v, sigma, sigma),
        control_of(points_l, control, noise, rng),
        known_points(points_l, np.asarray(check, dtype=np.int64)),
    )
    order = np.array([int(id[1:]) for id in network.point_ids])
    return SimulatedNetwork(network, points_l[order], corrections, values)


def disturb_camera(camera: LineCamera, self_calibration: SelfCalibration, values: Mapping[str, float]) -> LineCamera:
    """The true camera: pixels where the additional parameters put them, ``projection = measured - D(measured)``."""
    ap = np.array([values.get(name, 0.0) for name in self_calibration.unknown_names])
    lines: list[CcdLine] = []
    for k, line in enumerate(camera.lines):
        sample = np.arange(line.pixels, dtype=float)
        ccd = np.full(line.pixels, k)
        xy = line.xy_mm - camera.principal_point_mm[k]
        design = self_calibration.design(ccd, sample, xy, camera.focal_length_mm[ccd])
        lines.append(replace(line, xy_mm=line.xy_mm - design.evaluate(ap).T))
    return replace(camera, lines=tuple(lines))


def draw_unknowns(model: CorrectionModel, rng: np.random.Generator) -> Array:
    """Unknowns of a model (n_unknowns,) drawn from its a-priori knowledge, continuity included."""
    prior = model.pseudo_observations()
    A = np.zeros((len(prior), model.n_unknowns + 1))
    np.add.at(A, (np.arange(len(prior))[:, None], prior.columns), prior.coefficients)
    A = A[:, :-1] / prior.sigma[:, None]
    scale = 1.0 / np.linalg.norm(A, axis=0)
    factor = np.linalg.cholesky((A * scale).T @ (A * scale))
    return scale * np.linalg.solve(factor.T, rng.standard_normal(model.n_unknowns))


def scatter_points(
    n: int, extent: tuple[float, float, float, float], relief: Callable[[Array, Array], Array], rng: np.random.Generator
) -> Array:
    """Points (n, 3) spread evenly at random over ``(x_min, x_max, y_min, y_max)`` on a surface ``z = relief(x, y)``."""
    x = rng.uniform(extent[0], extent[1], n)
    y = rng.uniform(extent[2], extent[3], n)
    return np.column_stack([x, y, relief(x, y)])


def swath_m(camera: LineCamera, above_m: float) -> float:
    """Width of a strip on the ground, from a height above it."""
    return 2 * _field_of_view(camera)[0] * above_m


def _field_of_view(camera: LineCamera) -> tuple[float, float, float, float]:
    """Tangents: half the swath, foremost and rearmost view; and the angle of a pixel."""
    xy = [
        (line.xy_mm - camera.principal_point_mm[k]) / camera.focal_length_mm[k] for k, line in enumerate(camera.lines)
    ]
    half = min(float(np.abs(t[[0, -1], 1]).min()) for t in xy)
    fore, aft = max(float(t[:, 0].max()) for t in xy), min(float(t[:, 0].min()) for t in xy)
    return half, fore, aft, float(np.linalg.norm(xy[0][1] - xy[0][0]))


def fly(line: FlightLine, noise: Noise, rate_hz: float, rng: np.random.Generator) -> Trajectory:
    """True trajectory, half a second longer than the strip on both sides."""
    step = 1.0 / rate_hz
    t = np.arange(-0.5, line.duration_s + 0.5 + step, step)
    azimuth = np.radians(line.azimuth_deg)
    position = np.empty((len(t), 3))
    position[:, 0] = line.start[0] + line.speed_m_s * np.cos(azimuth) * t
    position[:, 1] = line.start[1] + line.speed_m_s * np.sin(azimuth) * t
    position[:, 2] = line.height_m
    angles = np.radians(noise.jitter_deg) * band_limited_noise(rng, len(t), step, np.ones(3), *noise.jitter_hz)
    angles[:, 2] += azimuth
    return Trajectory(t + 0.5, position, quaternion_from_angles(angles))


def measured_trajectory(
    truth: Trajectory, model: CorrectionModel, theta: Array, noise: Noise, rng: np.random.Generator
) -> Trajectory:
    """Measured = true - correction + wander; ``theta`` (u,) are the unknowns of the correction."""
    correction = model.evaluate(theta, truth.time_s)
    sigma = np.array([noise.wander_m] * 3 + [np.radians(noise.wander_deg)] * 3)
    if sigma.any():
        step = float(truth.time_s[1] - truth.time_s[0])
        correction = correction + sigma * band_limited_noise(rng, len(truth), step, np.ones(6), *WANDER_HZ)
    angles = angles_from_matrix(matrix_from_quaternion(truth.quaternion)) - correction[:, 3:]
    quaternion = quaternion_from_angles(angles)
    return Trajectory(truth.time_s, truth.position_l - correction[:, :3], quaternion)


def looks_of(
    camera: LineCamera, strip: Strip, line: FlightLine, points_l: Array, index: int
) -> tuple[IntArray, IntArray, IntArray, Array, Array]:
    """Point, strip, CCD line, image line and sample (n,) of all that a strip sees of points (p, 3).

    Newton's method on the line condition.
    """
    truth = strip.trajectory
    azimuth = np.radians(line.azimuth_deg)
    along = (points_l[:, 0] - line.start[0]) * np.cos(azimuth) + (points_l[:, 1] - line.start[1]) * np.sin(azimuth)
    found = []
    for k, ccd in enumerate(camera.lines):
        xy = ccd.xy_mm - camera.principal_point_mm[k]
        order = np.argsort(xy[:, 1])
        c = camera.focal_length_mm[k]
        ahead = (line.height_m - points_l[:, 2]) * float(xy[ccd.pixels // 2, 0] / c)
        t = strip.first_line_time_s + (along - ahead) / line.speed_m_s
        p = np.flatnonzero((t > truth.start_s - 1.0) & (t < truth.end_s + 1.0))
        t = np.clip(t[p], truth.start_s, truth.end_s)
        miss, v = np.full(len(p), np.inf), np.zeros(len(p))
        for _ in range(8):
            pose = truth.at(t)
            image, d, _, _ = collinearity(pose.position_l.T, pose.angles.T, points_l[p].T, np.full(len(p), c))
            v = np.interp(image[1], xy[order, 1], order.astype(float), left=-1.0, right=-1.0)
            miss = image[0] - np.interp(image[1], xy[order, 1], xy[order, 0])
            motion = np.einsum("kn,nk->n", d[0], np.concatenate([pose.velocity_l, pose.angle_rate], axis=1))
            step = np.clip(-miss / motion, -1.0, 1.0)
            t = np.clip(t + step, truth.start_s, truth.end_s)
        u = (t - strip.first_line_time_s) * strip.line_rate_hz
        seen = (np.abs(miss) < 1e-7) & (u > 1) & (u < strip.lines - 2) & (v > 1) & (v < ccd.pixels - 2)
        found.append((p[seen], u[seen], v[seen], np.full(int(seen.sum()), k)))
    p, u, v, k = (np.concatenate(a) for a in zip(*found, strict=True))
    return p, np.full(len(p), index), k, u, v


def control_of(points_l: Array, roles: Mapping[int, str], noise: Noise, rng: np.random.Generator) -> Control:
    """Control with its noise for some of the points (p, 3), by index and role."""
    index = np.array(sorted(roles), dtype=np.int64)
    sigma = np.tile(np.array(noise.control_m, dtype=float), (len(index), 1))
    xyz = points_l[index] + rng.normal(size=(len(index), 3)) * sigma
    role = np.array([roles[int(i)] for i in index], dtype=object)
    sigma[role == "planimetric", 2] = np.inf
    sigma[role == "height", :2] = np.inf
    return Control(index, xyz, sigma)


def known_points(points_l: Array, index: IntArray) -> Control:
    """True coordinates of some of the points (p, 3), by index (k,), as check points."""
    return Control(index, points_l[index], np.full((len(index), 3), 1e-6))
