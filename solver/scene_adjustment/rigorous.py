"""A scene with a rigorous model: correction functions of orbit and attitude, additional parameters of its lens.

Corrections are those of the trajectory models (`triline.solver.models`): X, Y, Z of the position along the track,
across it to the right, and up; omega, phi, kappa about axes fixed in the body that point forward, to the right and down
in the middle of the scene. The perspective centre becomes ``C + B (dX, dY, dZ)``, the attitude ``R_eb exp(A (domega,
dphi, dkappa))``.

The equations of a ray compare the direction in which the point appears in the body with the look direction of a sample,
and bring the difference to line and sample by Newton's method: once from the measured pixel, and again from what that
gave, where the derivatives are taken. Two steps are the full inverse location, as the first one starts some pixels off.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..camera.line_camera import CcdLine, Lens, LineCamera
from ..camera.self_calibration import SelfCalibration
from ..geometry.rotation import R_BC_NOMINAL, cross
from ..location.look_directions import LookDirections
from ..location.pushbroom import SPEED_OF_LIGHT, PushbroomSensor, miss_of
from ..models.base import CorrectionModel, direct_observations
from ..orbit.motion import FixedPoses, Motion, R_from_orbital
from .images import CAMERA, ORIENTATION, Equations, UnknownGroup

Array = NDArray[np.floating]

#: Pixel of an image whose focal length is not known: units of its additional parameters count on it, mm.
NOMINAL_PIXEL_MM = 0.01
#: Step of the derivative of a look direction by the sample, pixels. Derived: chips are tens of pixels apart.
_STEP_PX = 0.5
#: Step of the rate of directions, lines. Derived: over a line of MISR (280 m) the rate changes by 2e-4.
_STEP_LINES = 0.1


@dataclass(frozen=True)
class LensView:
    """The image frame of a line of detectors in the body, in which its additional parameters act.

    Attributes
    ----------
    R_bc : (3, 3) image frame (x forward, y left, z against the view) to body
    focal_length_mm : camera constant
    chips : first sample of each chip, () for a line in one piece
    """

    R_bc: Array
    focal_length_mm: float
    chips: tuple[int, ...] = ()

    def image_coordinates(self, look_b: Array) -> Array:
        """Image coordinates (n, 2) in mm of directions in the body (n, 3)."""
        c = look_b @ self.R_bc
        return -self.focal_length_mm * c[:, :2] / c[:, 2:]

    def depth(self, look_b: Array) -> Array:
        """Components (n,) of directions in the body (n, 3) along the view."""
        return -(look_b @ self.R_bc[:, 2])

    def camera(self, id: str, look: LookDirections) -> LineCamera:
        """The line as a camera of its own, for sets of additional parameters."""
        xy = self.image_coordinates(look.at(np.arange(float(look.samples)))[0])
        return LineCamera(id, (Lens(id, self.focal_length_mm),), (CcdLine(id, id, xy, self.chips),))


def lens_view(sensor: PushbroomSensor, focal_length_mm: float | None = None, chips: tuple[int, ...] = ()) -> LensView:
    """Image frame about the middle of a line of detectors: z against its view, y along it to the left of the flight.

    Parameters
    ----------
    focal_length_mm : None to take one with which a pixel is as large as `NOMINAL_PIXEL_MM`
    """
    ends = sensor.look.at(np.array([0.0, 0.5 * (sensor.samples - 1), sensor.samples - 1.0]))[0]
    ends = ends / np.linalg.norm(ends, axis=1, keepdims=True)
    z = -ends[1]
    y = ends[2] - ends[0]
    y = y - z * (y @ z)
    length = float(np.linalg.norm(y))
    y = y / length
    pose = sensor.pose([0.5 * (sensor.lines - 1)])
    forward_b = pose.R_eb[0].T @ sensor.motion.inertial_velocity(pose.position_e, pose.velocity_e)[0]
    if np.cross(y, z) @ forward_b < 0:
        y = -y
    c = focal_length_mm if focal_length_mm is not None else NOMINAL_PIXEL_MM * (sensor.samples - 1) / length
    return LensView(np.stack([np.cross(y, z), y, z], axis=1), float(c), chips)


def lens_view_of(camera: LineCamera, ccd: str, R_bc: ArrayLike = R_BC_NOMINAL) -> LensView:
    """Image frame of a line of a calibrated camera whose lens has the rotation ``R_bc`` to the body."""
    k = camera.line_index[ccd]
    return LensView(np.asarray(R_bc, dtype=float), float(camera.focal_length_mm[k]), camera.lines[k].chips)


@dataclass(frozen=True)
class CorrectionSet:
    """Correction functions of one or more lines of detectors on one body.

    Attributes
    ----------
    key : of the set
    model : the functions
    axes_b : (3, 3) columns: axes in the body about which the attitude is corrected
    refined : orbit and attitude are those of an earlier model, and nobody stated how good they are: a-priori sigmas,
        which are those of the measured ones, are wide, see `UnknownGroup`
    """

    key: str
    model: CorrectionModel
    axes_b: Array = field(repr=False)
    refined: bool = False


def flight_axes_b(sensor: PushbroomSensor, time_s: float) -> Array:
    """Forward, right and down (columns, (3, 3)) in the body at a time of the sensor's motion."""
    pose = sensor.motion.at([time_s])
    velocity = sensor.motion.inertial_velocity(pose.position_e, pose.velocity_e)
    return pose.R_eb[0].T @ R_from_orbital(pose.position_e, velocity)[0]


def track_axes_e(position_e: Array, velocity_e: Array) -> Array:
    """Along the track, across it to the right, and up: columns of (n, 3, 3), from inertial velocities (n, 3)."""
    up = position_e / np.linalg.norm(position_e, axis=1, keepdims=True)
    across = cross(velocity_e, up)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    return np.stack([cross(up, across), across, up], axis=-1)


@dataclass(frozen=True)
class Calibration:
    """Additional parameters of a lens.

    Attributes
    ----------
    key : of the lens; images with the same key share them
    parameters : of a camera of this one line (`LensView.camera`)
    view : its image frame
    """

    key: str
    parameters: SelfCalibration
    view: LensView


class RigorousImage:
    """An image of a pushbroom sensor in an adjustment.

    Parameters
    ----------
    name : of the image
    sensor : its rigorous model
    corrections : of orbit and attitude
    calibration : of its lens; None for none
    """

    kind = "rigorous"
    locates = True

    def __init__(
        self, name: str, sensor: PushbroomSensor, corrections: CorrectionSet, calibration: Calibration | None = None
    ):
        self.name, self.sensor, self.corrections, self.calibration = name, sensor, corrections, calibration
        model = corrections.model
        prior = model.pseudo_observations()
        assumed = (corrections.refined,) * len(prior)
        groups = [UnknownGroup(corrections.key, ORIENTATION, model.unknown_names, prior, assumed)]
        if calibration is not None:
            names = calibration.parameters.unknown_names
            prior = direct_observations(calibration.parameters.apriori_sigma, names)
            # nobody states them: they are those of a camera that was never calibrated
            groups.append(UnknownGroup(calibration.key, CAMERA, names, prior, (True,) * len(names)))
        self.groups = tuple(groups)

    def measured(self, line: Array, sample: Array) -> RigorousRays:
        return RigorousRays(self, np.asarray(line, dtype=float), np.asarray(sample, dtype=float))

    def start(self, line: Array, sample: Array, position_e: Array) -> Array:
        return np.zeros(sum(map(len, self.groups)))

    def located(self, values: Array) -> PushbroomSensor:
        """The sensor with its corrections."""
        u = self.corrections.model.n_unknowns
        motion = CorrectedMotion(self.sensor.motion, self.corrections, values[:u])
        look = self.sensor.look
        if self.calibration is not None:
            look = CorrectedLook(look, self.calibration, values[u:])
        return self.sensor.changed(motion, look)


class RigorousRays:
    """Measured pixels of a rigorous image; poses at their lines are computed once.

    One step of Newton's method from the measured pixel gives the computed one but for its square; the equations stand
    there, so that they are those of the full inverse location.
    """

    def __init__(self, image: RigorousImage, u: Array, v: Array):
        self._image, self._pixel = image, np.stack([u, v], axis=1)
        self._start = _Lines(image, u, v)

    def equations(self, position_e: Array, values: Array) -> Equations:
        image = self._image
        first, _ = self._start.computed(position_e, values)
        ends = np.array(image.sensor.covered_lines)
        near = np.asarray(np.isfinite(first).all(axis=1))
        place = np.where(near[:, None], first, self._pixel)
        place[:, 0] = np.clip(place[:, 0], ends[0], ends[1])
        lines = _Lines(image, place[:, 0], place[:, 1], held=True)  # the time of an end may be rounded beyond it
        computed, geometry = lines.computed(position_e, values)
        return lines.equations(self._pixel - computed, geometry, position_e)


@dataclass(frozen=True)
class _Step:
    """What derivatives are made from: rays in the body and their rates."""

    pose: FixedPoses
    turn_b: Array
    direction: Array
    look: Array
    across: Array
    along: Array
    depth: Array
    f: Array
    g: Array
    f_rate: Array
    g_rate: Array
    along_px: Array


class _Lines:
    """Pixels of an image with the poses at their lines."""

    def __init__(self, image: RigorousImage, u: Array, v: Array, held: bool = False):
        self._image, sensor = image, image.sensor
        self._pixel = np.stack([u, v], axis=1)
        self._pose = sensor.pose(u, held=held)
        high = sensor.covered_lines[1]
        self._step = np.where(u + _STEP_LINES <= high, _STEP_LINES, -_STEP_LINES)
        self._next = sensor.pose(u + self._step, held=held)
        times = sensor.line_times.time_of(u), sensor.line_times.time_of(u + self._step)
        self._numbers, self._functions = image.corrections.model.design(times[0]).functions()
        self._next_functions = image.corrections.model.design(times[1]).functions()
        self._track = track_axes_e(
            self._pose.position_e, sensor.motion.inertial_velocity(self._pose.position_e, self._pose.velocity_e)
        )
        self._look, self._slope = sensor.look.at(v)
        self._effect: Array | None = None
        if image.calibration is not None:
            view = image.calibration.view
            scale = (view.focal_length_mm / view.depth(self._look))[:, None]
            low, high_look = (sensor.look.at(v + step)[0] for step in (-_STEP_PX, _STEP_PX))
            effects = [camera_effect(image.calibration, look, v) for look in (self._look, low, high_look)]
            self._effect, self._effect_slope = effects[0], (effects[2] - effects[1]) / (2.0 * _STEP_PX)
            self._look, self._slope = self._look * scale, self._slope * scale

    def computed(self, position_e: Array, values: Array) -> tuple[Array, _Step]:
        """Lines and samples (n, 2) of points (n, 3), NaN behind the sensor, by a step of Newton's method from here.

        Across the line of detectors the direction in the body gives the time, along it the detector, as in the inverse
        location.
        """
        image, sensor = self._image, self._image.sensor
        model, A_b = image.corrections.model, image.corrections.axes_b
        theta, ap = values[: model.n_unknowns], values[model.n_unknowns :]
        six = self._functions @ theta[self._numbers]
        pose = _corrected(self._pose, six, self._track, A_b)
        numbers, functions = self._next_functions
        later = _corrected(self._next, functions @ theta[numbers], self._track, A_b)
        look, slope = self._look, self._slope
        if self._effect is not None:
            look, slope = look - self._effect @ ap, slope - self._effect_slope @ ap
        d = sensor.appearance(position_e, pose)
        rate = (sensor.appearance(position_e, later) - d) / self._step[:, None]
        across, along, square, depth, f, g, f_rate, g_rate = miss_of(d, rate, look, slope)
        along_px = square / _dot(along, along)
        du = -f / f_rate
        computed = self._pixel + np.stack([du, (g + g_rate * du) * along_px], axis=1)
        computed = np.where((depth > 0)[:, None], computed, np.nan)
        return computed, _Step(pose, six[:, 3:] @ A_b.T, d, look, across, along, depth, f, g, f_rate, g_rate, along_px)

    def equations(self, misclosure_px: Array, s: _Step, position_e: Array) -> Equations:
        """Equations with the derivatives here."""
        image = self._image
        model, A_b = image.corrections.model, image.corrections.axes_b
        d, pose = s.direction, s.pose
        by_f = (s.across - s.f[:, None] * s.look) / s.depth[:, None]
        by_g = (s.along - s.g[:, None] * s.look) / s.depth[:, None]
        line = -by_f / s.f_rate[:, None]
        sample = (by_g + s.g_rate[:, None] * line) * s.along_px[:, None]
        by_direction = np.stack([line, sample], axis=1)  # (n, 2, 3), of the direction in the body
        ray = position_e - pose.position_e
        distance = np.linalg.norm(ray, axis=1)
        ray = ray / distance[:, None]
        by_point = by_direction @ np.swapaxes(pose.R_eb, -1, -2)
        by_point = by_point - (by_point @ ray[:, :, None]) * ray[:, None, :]
        if image.sensor.aberration:  # directions crowd ahead by this, to the first order of the velocity
            velocity = image.sensor.motion.inertial_velocity(pose.position_e, pose.velocity_e)
            distance = distance * (1.0 + _dot(ray, velocity) / SPEED_OF_LIGHT)
        by_point = by_point / distance[:, None, None]
        by_position = -by_point @ self._track
        # the body turned by a: the direction turns by -a, d x a; after a turn t by a - t x a / 2
        axes = A_b.T[None, :, :] - 0.5 * cross(s.turn_b[:, None, :], A_b.T[None, :, :])
        turned = cross(d[:, None, :], axes)  # (n, axis, 3)
        by_turn = by_direction @ np.swapaxes(turned, -1, -2)
        by_six = np.concatenate([by_position, by_turn], axis=2)
        by_theta = np.zeros((len(d), 2, model.n_unknowns))
        by_theta[:, :, self._numbers] = by_six @ self._functions
        if self._effect is None:
            return Equations(misclosure_px, by_point, by_theta)
        # a detector that looks away by -D sees what appears at d as one of nominal look sees d + D
        by_ap = by_direction @ (self._effect / np.linalg.norm(s.look, axis=1)[:, None, None])
        return Equations(misclosure_px, by_point, np.concatenate([by_theta, by_ap], axis=2))


def camera_effect(calibration: Calibration, look_b: Array, sample: Array) -> Array:
    """Displacements (n, 3, k) in the body, mm in the image per unit of the k additional parameters.

    ``D`` is added to the projection, so that a detector at a measured place ``m`` looks along ``m - D``.

    Parameters
    ----------
    look_b : (n, 3) nominal look directions
    sample : (n,) which decide on the chip
    """
    view = calibration.view
    xy = view.image_coordinates(look_b)
    n, focal = len(xy), np.full(len(xy), view.focal_length_mm)
    design = calibration.parameters.design(np.zeros(n, dtype=np.int64), np.asarray(sample, dtype=float), xy, focal)
    D = np.zeros((n, 2, calibration.parameters.n_unknowns + 1))
    columns = design.columns[design.pattern]  # (n, slots)
    for axis, coefficients in enumerate(design.coefficients()):
        np.add.at(D[:, axis], (np.arange(n)[:, None], columns), coefficients.T)
    return np.einsum("ij,njk->nik", view.R_bc[:, :2], D[:, :, :-1])


def _corrected(pose: FixedPoses, six: Array, track_e: Array, axes_b: Array) -> FixedPoses:
    """Poses with corrections (n, 6) of position and attitude."""
    from scipy.spatial.transform import Rotation

    turn = Rotation.from_rotvec(six[:, 3:] @ axes_b.T).as_matrix()
    position = pose.position_e + np.einsum("nij,nj->ni", track_e, six[:, :3])
    return replace(pose, position_e=position, R_eb=pose.R_eb @ turn)


class CorrectedMotion(Motion):
    """Orbit and attitude with correction functions."""

    def __init__(self, base: Motion, corrections: CorrectionSet, theta: ArrayLike):
        self.orbit, self.attitude, self.earth = base.orbit, base.attitude, base.earth
        self.orbit_frame, self.attitude_frame = base.orbit_frame, base.attitude_frame
        self.start_s, self.end_s, self.omega_e = base.start_s, base.end_s, base.omega_e
        self._base, self._corrections, self._theta = base, corrections, np.asarray(theta, dtype=float)

    def at(self, time_s: ArrayLike) -> FixedPoses:
        t = np.atleast_1d(np.asarray(time_s, dtype=float))
        pose = self._base.at(t)
        track = track_axes_e(pose.position_e, self.inertial_velocity(pose.position_e, pose.velocity_e))
        six = self._corrections.model.evaluate(self._theta, t)
        return _corrected(pose, six, track, self._corrections.axes_b)


class CorrectedLook:
    """Look directions with additional parameters."""

    def __init__(self, base: LookDirections, calibration: Calibration, values: ArrayLike):
        self.samples = base.samples
        self._base, self._calibration, self._values = base, calibration, np.asarray(values, dtype=float)

    def at(self, sample: ArrayLike) -> tuple[Array, Array]:
        v = np.asarray(sample, dtype=float)
        flat = v.ravel()
        low, middle, high = (self._look(flat + step) for step in (-_STEP_PX, 0.0, _STEP_PX))
        slope = (high - low) / (2.0 * _STEP_PX)
        return middle.reshape(*v.shape, 3), slope.reshape(*v.shape, 3)

    def _look(self, v: Array) -> Array:
        look, view = self._base.at(v)[0], self._calibration.view
        full = look * (view.focal_length_mm / view.depth(look))[:, None]
        return full - camera_effect(self._calibration, look, v) @ self._values


def calibration_of(
    key: str, sensor: PushbroomSensor, view: LensView, make: Callable[[LineCamera], SelfCalibration]
) -> Calibration:
    """A set of additional parameters for the lens of a sensor."""
    id = key.rsplit("/", 1)[-1]
    return Calibration(key, make(view.camera(id, sensor.look)), view)


def _dot(a: Array, b: Array) -> Array:
    return np.einsum("...i,...i->...", a, b)
