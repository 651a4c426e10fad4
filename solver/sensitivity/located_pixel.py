"""A located pixel as a function of what its location is computed from: pushbroom satellites, frames, airborne strips.

Results are metres east, north and up from where the pixel is located without errors.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ..geometry.earth import R_en
from ..geometry.rotation import R_ENU_NED, matrix_from_angles
from ..location.frame_camera import FrameCamera
from ..location.pushbroom import PushbroomSensor, Rays, without_aberration
from ..location.uncertainty import Sigmas, named_axes_b
from ..orbit.motion import FixedPoses, turned_on
from .inputs import Normal

Array = NDArray[np.floating]

#: Lines beyond the end of orbit and attitude that are still located, at the rate of the last one. Tuned: errors of time
#: are a share of a line or a few of them.
_BEYOND_LINES = 10.0
#: Results of every function here.
RESULTS = ("east", "north", "up")
#: Parameters of a satellite, in the order of `Sigmas`, and their units.
SATELLITE = {
    "along": "m", "across": "m", "radial": "m", "roll": "rad", "pitch": "rad", "yaw": "rad", "time": "s",
    "line": "px", "sample": "px", "height": "m",
}  # fmt: skip
#: Parameters of an aircraft, and their units.
AIRCRAFT = {
    "X0": "m", "Y0": "m", "Z0": "m", "omega": "rad", "phi": "rad", "kappa": "rad", "c": "mm", "x": "px", "y": "px",
    "height": "m",
}  # fmt: skip

#: Parameters of a frame image, and their units: position and turns about east, north and up, camera constant, pixel.
FRAME = {
    "east": "m", "north": "m", "up": "m", "omega": "rad", "phi": "rad", "kappa": "rad", "c": "mm", "line": "px",
    "sample": "px", "height": "m",
}  # fmt: skip


def satellite_inputs(sigmas: Sigmas) -> Normal:
    """Errors of a satellite scene, independent and normal about zero."""
    values = [*sigmas.position_m, *sigmas.attitude_rad, sigmas.time_s, *sigmas.pixel, sigmas.height_m]
    return Normal(np.zeros(10), values, tuple(SATELLITE))


class SatellitePixel:
    """One pixel of a pushbroom scene.

    Parameters
    ----------
    sensor : rigorous model, with refraction or without
    line, sample, height_m : the pixel and the height of the ground above the ellipsoid

    Raises
    ------
    ValueError : a pixel whose ray misses the ground, a line that orbit and attitude do not cover
    """

    def __init__(self, sensor: PushbroomSensor, line: float, sample: float, height_m: float):
        self._sensor, self._line, self._sample, self._height = sensor, line, sample, height_m
        self._ground = sensor.ground(line, sample, height_m)[0]
        self._axes_b = named_axes_b(sensor)
        if not np.isfinite(self._ground).all():
            raise ValueError(f"line {line:g}, sample {sample:g}: the ray misses the ground at {height_m:g} m")
        lat, lon, _ = sensor.ellipsoid.geodetic(self._ground)
        self._R_ne = R_ENU_NED @ R_en(lat, lon).T

    def __call__(self, errors: Array) -> Array:
        """Metres east, north, up (n, 3) by errors (n, 10) of the parameters `SATELLITE`; NaN where a ray misses."""
        errors = np.asarray(errors, dtype=float)
        sensor = self._sensor
        time = sensor.line_times.time_of(np.array([self._line])) + errors[:, 6]
        line = sensor.line_times.line_of(time) + errors[:, 7]
        inside, pose = self._pose(line)
        C, velocity = pose.position_e, sensor.motion.inertial_velocity(pose.position_e, pose.velocity_e)
        up = C / np.linalg.norm(C, axis=1, keepdims=True)
        across = np.cross(velocity, up)
        across /= np.linalg.norm(across, axis=1, keepdims=True)
        axes = np.stack([np.cross(up, across), across, up], axis=-1)
        look = sensor.look.at(self._sample + errors[:, 8])[0]
        look = np.einsum("nij,nj->ni", Rotation.from_rotvec(errors[:, 3:6] @ self._axes_b.T).as_matrix(), look)
        d = np.einsum("nij,nj->ni", pose.R_eb, look)
        d /= np.linalg.norm(d, axis=1, keepdims=True)
        if sensor.aberration:
            d = without_aberration(d, velocity)
        moved = C + np.einsum("nij,nj->ni", axes, errors[:, :3])
        P = sensor.reach(Rays(moved, d), self._height + errors[:, 9])
        return np.where(inside[:, None], (P - self._ground) @ self._R_ne.T, np.nan)

    def _pose(self, line: Array) -> tuple[NDArray[np.bool_], FixedPoses]:
        """Whether lines (n,) have a pose, and their poses: as of the line inside where orbit and attitude end close by.

        They may end with the image, whose first and last pixels have errors of time and line as the others.
        """
        low, high = self._sensor.covered_lines
        within = np.clip(line, low, high)
        pose, beyond = self._sensor.pose(within), line - within
        out = np.flatnonzero(beyond)
        if not len(out) or high - low < 1.0:
            return beyond == 0, pose
        inner = self._sensor.pose(within[out] - np.sign(beyond[out]))
        position, R, share = pose.position_e.copy(), pose.R_eb.copy(), np.abs(beyond[out])
        position[out] += share[:, None] * (position[out] - inner.position_e)
        R[out] = turned_on(R[out], inner.R_eb, share)
        return np.abs(beyond) <= _BEYOND_LINES, replace(pose, position_e=position, R_eb=R)


class FramePixel:
    """One pixel of a frame image.

    Parameters
    ----------
    camera : with its orientation, with refraction or without
    line, sample, height_m : the pixel and the height of the ground above the ellipsoid

    Raises
    ------
    ValueError : a pixel whose ray misses the ground
    """

    def __init__(self, camera: FrameCamera, line: float, sample: float, height_m: float):
        self._camera, self._line, self._sample, self._height = camera, line, sample, height_m
        self._ground = camera.ground(line, sample, height_m)[0]
        if not np.isfinite(self._ground).all():
            raise ValueError(f"line {line:g}, sample {sample:g}: the ray misses the ground at {height_m:g} m")
        lat, lon, _ = camera.ellipsoid.geodetic(self._ground)
        self._R_ne = R_ENU_NED @ R_en(lat, lon).T
        lat, lon, _ = camera.ellipsoid.geodetic(camera.position_e)
        self._R_ce = R_ENU_NED @ R_en(lat, lon).T  # Earth-fixed to east, north, up below the camera

    def __call__(self, errors: Array) -> Array:
        """Metres east, north, up (n, 3) by errors (n, 10) of the parameters `FRAME`; NaN where a ray misses."""
        errors = np.asarray(errors, dtype=float)
        camera, R = self._camera, self._R_ce
        xy = camera.image_mm(self._line + errors[:, 7], self._sample + errors[:, 8])
        d = np.column_stack([xy, -(camera.focal_length_mm + errors[:, 6])]) @ camera.R_ec.T
        d = np.einsum("nij,nj->ni", R.T @ Rotation.from_rotvec(errors[:, 3:6]).as_matrix() @ R, d)
        d /= np.linalg.norm(d, axis=1, keepdims=True)
        C = camera.position_e + errors[:, :3] @ R
        P = C + camera.ellipsoid.intersect(C, d, self._height + errors[:, 9])[:, None] * d
        if camera.refraction is not None:
            P = camera.refraction.true_ground(P, C)
        return (P - self._ground) @ self._R_ne.T


@dataclass(frozen=True)
class AircraftPixel:
    """One pixel of a line camera on an aircraft, over ground of constant height in a local frame.

    Attributes
    ----------
    position_m : (3,) perspective centre: east, north, up
    angles_rad : (3,) omega, phi, kappa
    xy_mm : (2,) of the pixel, reduced to the principal point; x along the flight
    focal_length_mm : of the lens
    pixel_mm : size of a pixel
    height_m : of the ground
    """

    position_m: tuple[float, float, float]
    angles_rad: tuple[float, float, float]
    xy_mm: tuple[float, float]
    focal_length_mm: float
    pixel_mm: float
    height_m: float

    def __call__(self, errors: Array) -> Array:
        """Metres east, north, up (n, 3) by errors (n, 10) of the parameters `AIRCRAFT`; NaN where a ray misses."""
        errors = np.asarray(errors, dtype=float)
        return self._located(errors) - self._located(np.zeros((1, 10)))

    def _located(self, errors: Array) -> Array:
        C = np.asarray(self.position_m) + errors[:, :3]
        angles = np.asarray(self.angles_rad) + errors[:, 3:6]
        x = self.xy_mm[0] + self.pixel_mm * errors[:, 7]
        y = self.xy_mm[1] + self.pixel_mm * errors[:, 8]
        image = np.stack([x, y, -(self.focal_length_mm + errors[:, 6])], axis=1)
        d = np.einsum("nij,nj->ni", matrix_from_angles(*angles.T), image)
        scale = (self.height_m + errors[:, 9] - C[:, 2]) / d[:, 2]
        return C + np.where(scale > 0, scale, np.nan)[:, None] * d


def camera_inputs(names: Iterable[str], sigmas: Sigmas, focal_length_mm: float) -> Normal:
    """Errors of a frame image (`FRAME`) or of an airborne strip (`AIRCRAFT`), independent and normal about zero."""
    parts = [*sigmas.position_m, *sigmas.attitude_rad, focal_length_mm, *sigmas.pixel, sigmas.height_m]
    return Normal(np.zeros(10), parts, tuple(names))
