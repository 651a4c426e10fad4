"""A rigorous pushbroom sensor as what an aircraft's line camera is: poses in a local frame, and a table of pixels.

On-line triangulation knows rays that are straight from the perspective centre through an image point of a calibrated
table. A sensor in orbit has light time, aberration, refraction and any table of look directions beside. What they do
is the same for all lines of a scene but for a turn, since velocity, height and view hardly change within it: so the
pose of each time is the turn that fits its rays best, and what is left, the same at all times, goes into the table of
pixels. The rays are those to where the rigorous model meets the ground at a height.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..geometry.frames import LocalFrame
from ..geometry.rotation import quaternion_from_matrix
from ..geometry.trajectory import Trajectory
from .pushbroom import PushbroomSensor

Array = NDArray[np.floating]

#: Pixels of a line whose rays are computed; between them the look directions keep their shape.
_NODES = 33
#: Turns are fitted so often: the first time to the table as it is, then to the table with what was left.
_FITS = 3


@dataclass(frozen=True)
class LocalPoses:
    """A line of detectors in a local frame.

    Attributes
    ----------
    trajectory : of the perspective centre and the image frame (x forward, y left, z against the view), local frame
    xy_mm : (samples, 2) image coordinates of the pixels
    focal_length_mm : camera constant they belong to
    misfit_px : largest distance, in pixels of the image, between this model and the rigorous one, between poses and at
        other heights too
    """

    trajectory: Trajectory
    xy_mm: Array = field(repr=False)
    focal_length_mm: float
    misfit_px: float


def local_poses(
    sensor: PushbroomSensor,
    frame: LocalFrame,
    image_coordinates: Callable[[Array], Array],
    R_bc: ArrayLike,
    focal_length_mm: float,
    time_s: ArrayLike,
    height_m: float,
    reach_m: float = 1000.0,
) -> LocalPoses:
    """Poses of a sensor at times (n,) of its motion.

    Parameters
    ----------
    image_coordinates : (m, 2) mm of look directions (m, 3) in the body, as `LensView.image_coordinates`
    R_bc : (3, 3) image frame to body
    height_m, reach_m : ellipsoidal height to which the model is fitted, and how far above and below the misfit is told

    Raises
    ------
    ValueError : times that orbit or attitude do not cover, or rays that miss the ground
    """
    t = np.asarray(time_s, dtype=float)
    xy = image_coordinates(sensor.look.at(np.arange(float(sensor.samples)))[0])
    nodes = np.unique(np.round(np.linspace(0, sensor.samples - 1, min(_NODES, sensor.samples))).astype(np.int64))
    pose = sensor.pose(sensor.line_times.line_of(t))
    R = frame.R_el.T @ pose.R_eb @ np.asarray(R_bc, dtype=float)
    rays = _rays(sensor, frame, t, nodes, height_m)
    for _ in range(_FITS):
        R = _turned(R, rays, xy[nodes], focal_length_mm)
        c = np.einsum("nij,nki->nkj", R, rays)
        left = (-focal_length_mm * c[..., :2] / c[..., 2:] - xy[nodes]).mean(axis=0)
        places = np.arange(sensor.samples)
        xy = xy + np.stack([np.interp(places, nodes, left[:, k]) for k in range(2)], axis=1)
    position = (pose.position_e - frame.origin_e) @ frame.R_el
    trajectory = Trajectory(t, position, quaternion_from_matrix(R))
    ends = np.sort(sensor.line_times.time_of(np.array([0.0, sensor.lines - 1.0])))
    between = 0.5 * (t[1:] + t[:-1])
    between = between[(between >= ends[0]) & (between <= ends[1])]
    pixel = float(np.median(np.linalg.norm(np.diff(xy, axis=0), axis=1)))
    misfit = 0.0
    at = trajectory.at(between)
    for height in (height_m - reach_m, height_m, height_m + reach_m):
        ground = _ground(sensor, frame, between, nodes, height)
        c = np.einsum("nij,nki->nkj", at.R_lc, ground - at.position_l[:, None])
        off = np.linalg.norm(-focal_length_mm * c[..., :2] / c[..., 2:] - xy[nodes], axis=-1)
        misfit = max(misfit, float(off.max(initial=0.0)) / pixel)
    return LocalPoses(trajectory, xy, focal_length_mm, misfit)


def _ground(sensor: PushbroomSensor, frame: LocalFrame, t: Array, nodes: NDArray[np.int64], height_m: float) -> Array:
    """(n, k, 3) local positions where rays reach a height."""
    line = np.repeat(sensor.line_times.line_of(t), len(nodes))
    found = sensor.ground(line, np.tile(nodes.astype(float), len(t)), height_m)
    if not np.isfinite(found).all():
        raise ValueError(f"{sensor.name or 'sensor'}: rays that miss the ground at {height_m:g} m")
    return ((found - frame.origin_e) @ frame.R_el).reshape(len(t), len(nodes), 3)


def _rays(sensor: PushbroomSensor, frame: LocalFrame, t: Array, nodes: NDArray[np.int64], height_m: float) -> Array:
    """(n, k, 3) unit vectors, local frame, from the perspective centre to the ground."""
    centre = (sensor.pose(sensor.line_times.line_of(t)).position_e - frame.origin_e) @ frame.R_el
    d = _ground(sensor, frame, t, nodes, height_m) - centre[:, None]
    return d / np.linalg.norm(d, axis=-1, keepdims=True)


def _turned(R: Array, rays: Array, xy_mm: Array, focal_length_mm: float) -> Array:
    """Rotations (n, 3, 3) that bring the pixels (k, 2) nearest to rays (n, k, 3); small turns of those given."""
    image = np.column_stack([xy_mm, np.full(len(xy_mm), -focal_length_mm)])
    image /= np.linalg.norm(image, axis=1, keepdims=True)
    # Wahba's problem by singular values (Markley 1988)
    U, _, Vt = np.linalg.svd(np.einsum("nki,kj->nij", rays, image))
    sign = np.ones((len(R), 3))
    sign[:, 2] = np.linalg.det(U) * np.linalg.det(Vt)
    return (U * sign[:, None, :]) @ Vt
