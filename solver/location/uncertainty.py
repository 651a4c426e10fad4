"""Covariance of located points: what the errors of orbit, attitude, time, image and height do on the ground.

A ray ``P = C + s d`` that ends on a surface with the normal ``n`` moves by ``dP = (I - d n'/(n'd)) (dC + s dd) +
d/(n'd) dh``; so every source of error has its columns in closed form.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import permutations, product

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..orbit.motion import R_from_orbital
from .frame_camera import FrameCamera
from .pushbroom import PushbroomSensor

Array = NDArray[np.floating]

#: The 24 ways to call the axes of a body forward, right and down: columns of (24, 3, 3).
_WAYS = np.array(
    [
        axes
        for order in permutations(range(3))
        for signs in product((1.0, -1.0), repeat=3)
        if np.linalg.det(axes := np.eye(3)[:, list(order)] * signs) > 0
    ]
)


@dataclass(frozen=True)
class Sigmas:
    """Standard deviations of what a location is computed from; sources are independent of each other.

    Attributes
    ----------
    position_m : (3,) of the orbit along the track, across, and up; of a frame camera east, north, up
    attitude_rad : (3,) of small turns about the axes of the body that point forward, right and down (`named_axes_b`);
        of a frame camera about east, north, up
    time_s : of the times of the lines against orbit and attitude; a frame image has none
    pixel : (2,) of line and sample
    height_m : of the height that is given with a pixel

    Raises
    ------
    ValueError : a sigma that is negative or not finite
    """

    position_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    attitude_rad: tuple[float, float, float] = (0.0, 0.0, 0.0)
    time_s: float = 0.0
    pixel: tuple[float, float] = (0.0, 0.0)
    height_m: float = 0.0

    def __post_init__(self) -> None:
        values = self.values
        if values.shape != (10,) or not (np.isfinite(values) & (values >= 0)).all():
            raise ValueError(f"sigmas {values.tolist()}, wanted ten numbers of at least 0")

    @property
    def values(self) -> Array:
        """All ten of them, in the order above."""
        return np.array([*self.position_m, *self.attitude_rad, self.time_s, *self.pixel, self.height_m], dtype=float)

    @property
    def any(self) -> bool:
        """Whether one of them is above zero."""
        return bool(self.values.any())


def named_axes_b(sensor: PushbroomSensor) -> Array:
    """Axes of the body (columns, (3, 3)) that point most nearly forward, right and down in the middle of the scene.

    Makers name the axes of their bodies as they like: x points across the flight of SPOT-5, and to anywhere in a
    camera. An error of roll is one about what points forward.
    """
    pose = sensor.pose([0.5 * (sensor.lines - 1)])
    velocity = sensor.motion.inertial_velocity(pose.position_e, pose.velocity_e)
    flight = pose.R_eb[0].T @ R_from_orbital(pose.position_e, velocity)[0]
    return _WAYS[int(np.argmax(np.einsum("nij,ij->n", _WAYS, flight)))]


def ground_derivatives(
    sensor: PushbroomSensor | FrameCamera, line: ArrayLike, sample: ArrayLike, height_m: ArrayLike
) -> Array:
    """Derivatives (n, 3, 10) of the ground position in east, north, up by the ten quantities of `Sigmas`.

    Light time and aberration are left out here; they change a derivative by less than 1e-4 of itself.
    """
    u, v, h = (np.array(a, dtype=float) for a in np.broadcast_arrays(*map(np.atleast_1d, (line, sample, height_m))))
    if isinstance(sensor, FrameCamera):
        return _of_frame(sensor, u, v, h)
    P = sensor.ground(u, v, h)
    pose = sensor.pose(u)
    look, slope = sensor.look.at(v)
    d = P - pose.position_e
    s = np.linalg.norm(d, axis=1)
    d = d / s[:, None]
    normal, _ = sensor.ellipsoid.normal_and_height(P)
    nd = np.einsum("ni,ni->n", normal, d)
    # components along the ray of what moves at right angles to the surface
    slide = np.eye(3) - d[:, :, None] * (normal / nd[:, None])[:, None, :]
    J = np.empty((len(u), 3, 10))
    velocity = sensor.motion.inertial_velocity(pose.position_e, pose.velocity_e)
    up = pose.position_e / np.linalg.norm(pose.position_e, axis=1, keepdims=True)
    across = np.cross(velocity, up)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    J[:, :, 0:3] = slide @ np.stack([np.cross(up, across), across, up], axis=-1)
    length = np.linalg.norm(look, axis=1, keepdims=True)
    unit = look / length
    turns = np.cross(named_axes_b(sensor).T[None], unit[:, None, :])  # row k: a small turn about axis k
    J[:, :, 3:6] = slide @ (s[:, None, None] * np.einsum("nij,nkj->nik", pose.R_eb, turns))
    # a later time is a later line: half a line on each side, inside what orbit and attitude cover
    low, high = sensor.covered_lines
    before, after = np.maximum(u - 0.5, low), np.minimum(u + 0.5, high)
    by_line = (sensor.ground(after, v, h) - sensor.ground(before, v, h)) / (after - before)[:, None]
    period = (sensor.line_times.time_of(after) - sensor.line_times.time_of(before)) / (after - before)
    J[:, :, 6] = by_line / period[:, None]
    J[:, :, 7] = by_line
    across_look = (slope - unit * np.einsum("ni,ni->n", unit, slope)[:, None]) / length
    J[:, :, 8] = np.einsum("nij,njk,nk->ni", slide, pose.R_eb, across_look) * s[:, None]
    J[:, :, 9] = d / nd[:, None]
    return np.swapaxes(_R_en(normal, P), -1, -2) @ J


def _of_frame(camera: FrameCamera, u: Array, v: Array, h: Array) -> Array:
    """`ground_derivatives` of a frame camera: what moves a ground point in the image moves the ray of a pixel back."""
    P = camera.ground(u, v, h)
    d = P - camera.position_e
    normal, _ = camera.ellipsoid.normal_and_height(P)
    J = np.zeros((len(u), 3, 10))
    J[:, :, 7] = camera.ground(u + 0.5, v, h) - camera.ground(u - 0.5, v, h)
    J[:, :, 8] = camera.ground(u, v + 0.5, h) - camera.ground(u, v - 0.5, h)
    J[:, :, 0:6] = -J[:, :, 7:9] @ camera.image_derivatives(u, v, h)
    J[:, :, 9] = d / np.einsum("ni,ni->n", normal, d)[:, None]
    return np.swapaxes(_R_en(normal, P), -1, -2) @ J


def ground_covariance(
    sensor: PushbroomSensor | FrameCamera, line: ArrayLike, sample: ArrayLike, height_m: ArrayLike, sigmas: Sigmas
) -> Array:
    """Covariance (n, 3, 3) in m2, east, north, up, of pixels located at heights."""
    J = ground_derivatives(sensor, line, sample, height_m) * sigmas.values
    return J @ np.swapaxes(J, -1, -2)


def pixel_covariance(
    sensor: PushbroomSensor | FrameCamera,
    line: ArrayLike,
    sample: ArrayLike,
    height_m: ArrayLike,
    sigmas: Sigmas,
    ground_covariance_m2: ArrayLike | None = None,
) -> Array:
    """Covariance (n, 2, 2) in pixels2 of line and sample, at which a ground point appears (the inverse location).

    Parameters
    ----------
    line, sample, height_m : (n,) where the point appears, and its height
    sigmas : of the sensor; its height and pixel sigmas are those of the ground point and of a measurement
    ground_covariance_m2 : (n, 3, 3) or (3, 3) of the ground point, east, north, up, in place of the height's sigma
    """
    J = ground_derivatives(sensor, line, sample, height_m)
    M = np.linalg.inv(J[:, :2, 7:9])  # of line and sample by east and north at one height
    sources = list(range(7)) if ground_covariance_m2 is not None else [*range(7), 9]
    B = M @ (J[:, :2, sources] * sigmas.values[sources])
    covariance = B @ np.swapaxes(B, -1, -2) + np.diag(np.square(sigmas.pixel))
    if ground_covariance_m2 is not None:
        # a point that is higher appears where a ray to lower ground passes
        G = M @ np.concatenate([np.broadcast_to(np.eye(2), (len(J), 2, 2)), -J[:, :2, 9:10]], axis=2)
        covariance = covariance + G @ np.asarray(ground_covariance_m2, dtype=float) @ np.swapaxes(G, -1, -2)
    return covariance


def _R_en(normal: Array, P: Array) -> Array:
    """Rotations (n, 3, 3) from east, north, up to Earth-fixed."""
    p = np.hypot(P[:, 0], P[:, 1])
    safe = np.where(p > 0, p, 1.0)
    east = np.stack([-P[:, 1] / safe, np.where(p > 0, P[:, 0] / safe, 1.0), np.zeros(len(P))], axis=1)
    return np.stack([east, np.cross(normal, east), normal], axis=-1)
