"""Simulated scenes of satellites that look through one lens a line, each with an orientation of its own (PRISM)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..adjustment.network import Control, Measurements, Strip, build_network
from ..camera.collinearity import collinearity
from ..camera.line_camera import LineCamera
from ..camera.self_calibration import SelfCalibration
from ..camera.sensors import lens_rotation
from ..geometry.rotation import angles_from_matrix, matrix_from_angles, matrix_from_quaternion, quaternion_from_matrix
from ..geometry.trajectory import Trajectory
from ..models.base import Extent, ModelOptions
from .network import Noise, SimulatedNetwork, disturb_camera, draw_unknowns

Array = NDArray[np.floating]


@dataclass(frozen=True)
class Scene:
    """One overpass along the local X axis.

    Attributes
    ----------
    height_m, speed_m_s : of the satellite above the ground; the Earth is taken as flat over the scene
    line_rate_hz : pixels are square on the ground at this rate
    length_m : of the ground in all images
    view_deg : where each lens looks, degrees forward
    """

    height_m: float
    speed_m_s: float
    line_rate_hz: float
    length_m: float
    view_deg: Mapping[str, float]


def simulate_scene(
    camera: LineCamera,
    scene: Scene,
    points_l: Array,
    control: ArrayLike,
    check: ArrayLike,
    errors: ModelOptions,
    rng: np.random.Generator,
    noise: Noise,
    self_calibration: SelfCalibration | None = None,
    camera_parameters: Mapping[str, float] | None = None,
) -> SimulatedNetwork:
    """Image points of a scene with one strip per lens; arguments as in `network.simulate_network`.

    The jitter of `noise` is not used: a satellite has none that matters within a scene.
    """
    points_l = np.asarray(points_l, dtype=float)
    control, check = (np.asarray(a, dtype=np.int64) for a in (control, check))
    values = dict(camera_parameters or {})
    true = disturb_camera(camera, self_calibration, values) if self_calibration and values else camera
    strips, corrections, looks = [], {}, []
    for k, line in enumerate(camera.lines):
        truth, strip = _pass(scene, line.lens)
        looks.append(_looks(true, k, strip, scene, points_l))
        model = errors.build(Extent(f"strip {strip.id}", truth.start_s, truth.end_s))
        theta = corrections[strip.id] = draw_unknowns(model, rng)
        correction = model.evaluate(theta, truth.time_s)
        angles = angles_from_matrix(matrix_from_quaternion(truth.quaternion)) - correction[:, 3:]
        quaternion = quaternion_from_matrix(matrix_from_angles(*angles.T))
        measured = Trajectory(truth.time_s, truth.position_l - correction[:, :3], quaternion)
        strips.append(replace(strip, trajectory=measured))
    strip_of = np.concatenate([np.full(len(p), k) for k, (p, _, _) in enumerate(looks)])
    point, u, v = (np.concatenate([look[i] for look in looks]) for i in range(3))
    u = u + rng.normal(0.0, noise.image_px, len(u))
    v = v + rng.normal(0.0, noise.image_px, len(v))
    sigma = np.full(len(u), noise.image_px)
    spread = np.tile(np.asarray(noise.control_m, dtype=float), (len(control), 1))
    given = points_l[control] + rng.normal(size=spread.shape) * spread
    network = build_network(
        camera,
        strips,
        [f"P{i}" for i in range(len(points_l))],
        Measurements(point.astype(np.int64), strip_of, strip_of, u, v, sigma, sigma),
        Control(control, given, spread),
        Control(check, points_l[check], np.full((len(check), 3), 1e-6)),
    )
    order = np.array([int(id[1:]) for id in network.point_ids])
    return SimulatedNetwork(network, points_l[order], corrections, values)


def _pass(scene: Scene, lens: str) -> tuple[Trajectory, Strip]:
    """True trajectory of one lens over the scene, two seconds longer on both sides, and its strip."""
    view = np.radians(scene.view_deg[lens])
    centre = -scene.height_m * np.tan(view) / scene.speed_m_s  # when it looks at the middle of the scene
    half = 0.5 * scene.length_m / scene.speed_m_s + 1.0
    t = np.arange(centre - half - 2.0, centre + half + 2.0, 0.05)
    position = np.zeros((len(t), 3))
    position[:, 0] = scene.speed_m_s * t
    position[:, 2] = scene.height_m
    R = np.broadcast_to(lens_rotation(scene.view_deg[lens]), (len(t), 3, 3))
    truth = Trajectory(t + 1000.0, position, quaternion_from_matrix(R))
    first = centre - half + 1000.0
    return truth, Strip(f"T1/{lens}", truth, first, scene.line_rate_hz, int(2 * half * scene.line_rate_hz), lens=lens)


def _looks(
    camera: LineCamera, k: int, strip: Strip, scene: Scene, points_l: Array
) -> tuple[NDArray[np.int64], Array, Array]:
    """Point, line and sample of what one lens sees: Newton's method on the line condition."""
    ccd, c = camera.lines[k], camera.focal_length_mm[k]
    xy = ccd.xy_mm - camera.principal_point_mm[k]
    order = np.argsort(xy[:, 1])
    truth = strip.trajectory
    n = len(points_l)
    focal = np.full(n, c)
    ahead = (scene.height_m - points_l[:, 2]) * np.tan(np.radians(scene.view_deg[ccd.lens]))
    t = np.clip((points_l[:, 0] - ahead) / scene.speed_m_s + 1000.0, truth.start_s, truth.end_s)
    miss, v = np.full(n, np.inf), np.zeros(n)
    for _ in range(8):
        pose = truth.at(t)
        image, d, _, _ = collinearity(pose.position_l.T, pose.angles.T, points_l.T, focal)
        v = np.interp(image[1], xy[order, 1], order.astype(float), left=-1.0, right=-1.0)
        miss = image[0] - np.interp(image[1], xy[order, 1], xy[order, 0])
        motion = np.einsum("kn,nk->n", d[0], np.concatenate([pose.velocity_l, pose.angle_rate], axis=1))
        t = np.clip(t - miss / motion, truth.start_s, truth.end_s)
    u = (t - strip.first_line_time_s) * strip.line_rate_hz
    seen = (np.abs(miss) < 1e-7) & (u > 1) & (u < strip.lines - 2) & (v > 1) & (v < ccd.pixels - 2)
    return np.flatnonzero(seen), u[seen], v[seen]
