"""A block of satellite scenes as a block in a local frame: what `block_messages` makes a recording of.

The origin lies on the ground in the middle of the known points and the scenes; the ellipsoid is curved in this frame.
Each line of detectors is a strip of its own lens, with its own poses: orbit and attitude as the sensor interpolates
them, turned by where its lens looks (`triline.solver.location.local_poses`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ...solver.adjustment.block_data import Apriori, BlockData, ImagePoints, KnownPoints
from ...solver.adjustment.network import Strip
from ...solver.camera.line_camera import CcdLine, Lens, LineCamera
from ...solver.geometry.ellipsoid import WGS84
from ...solver.geometry.frames import LocalFrame
from ...solver.geometry.rotation import angles_from_matrix, angles_jacobian
from ...solver.geometry.trajectory import Trajectory
from ...solver.location.local_poses import LocalPoses, local_poses
from ...solver.location.pushbroom import PushbroomSensor
from ...solver.orbit.time_scales import unix_from_tai
from ...solver.scene_adjustment.rigorous import LensView, flight_axes_b, track_axes_e
from ..convert import SECOND_NS
from ..errors import UserError
from .scene_block import ImageEntry, SceneBlockData

Array = NDArray[np.floating]

#: Between two poses of a strip, seconds. Tuned: orbits bend by 8 m/s^2; star trackers give ten quaternions a second.
POSE_STEP_S = 0.1
#: Poses reach so many steps beyond the first and last line, where orbit and attitude do.
_BEYOND = 3
#: A model in the local frame that is off by more than this is told, pixels.
_TOLD_PX = 0.01
#: Scenes of one camera share its pixels; one whose pixels look further beside them than this is of another camera.
_MOST_OFF_PX = 0.5
#: A scene whose lines leave a constant rate by more than this cannot be a strip, lines.
_MOST_OFF_LINES = 0.1
#: The sigmas of a project that a recording carries.
_CARRIED = ("offset_sigma_m", "shift_sigma_deg", "drift_sigma_deg")
#: Orbit and attitude of a scene do not wander in its seconds, where a project says nothing else.
_NO_WANDER = {"wander_sigma_m": (0.0, 0.0, 0.0), "wander_sigma_deg": (0.0, 0.0, 0.0)}


@dataclass(frozen=True)
class _Image:
    entry: ImageEntry
    sensor: PushbroomSensor
    view: LensView
    poses: LocalPoses
    lens: str


def local_block(data: SceneBlockData) -> BlockData:
    """The block in a local frame, strips named as the images are.

    Raises
    ------
    UserError : scenes without a rigorous model, of another planet, against the flight, or whose lines keep no rate
    """
    notes = list(data.notes)
    if data.ellipsoid != WGS84:
        raise UserError(f"{data.name}: scenes of another planet, wanted WGS 84, on which local frames are")
    sensors = [_rigorous(data, entry) for entry in data.images]
    frame = _frame(data, sensors)
    of_unix = [int(unix_from_tai(sensor.reference_ns)) for sensor in sensors]
    reference = min(of_unix) // SECOND_NS * SECOND_NS
    cameras = list(dict.fromkeys(entry.scene.camera for entry in data.images))
    images: list[_Image] = []
    strips: list[Strip] = []
    for entry, sensor, unix_ns in zip(data.images, sensors, of_unix, strict=True):
        assert entry.view is not None
        first, period = _rate(entry, sensor)
        time_s = _times(sensor)
        try:
            poses = local_poses(
                sensor, frame, entry.view.image_coordinates, entry.view.R_bc, entry.view.focal_length_mm, time_s,
                frame.height_m,
            )  # fmt: skip
        except ValueError as error:
            raise UserError(f"{data.name}: scene {entry.name}: {error}") from None
        lens = entry.ccd or entry.scene.camera
        if len(cameras) > 1 and entry.ccd:
            lens = f"{entry.scene.camera}-{entry.ccd}"
        images.append(_Image(entry, sensor, entry.view, poses, lens))
        if poses.misfit_px > _TOLD_PX:
            notes.append(f"scene {entry.name}: the model in the local frame is off by {poses.misfit_px:.3f} px at most")
        later = (unix_ns - reference) * 1e-9
        t = poses.trajectory
        trajectory = Trajectory(t.time_s + later, t.position_l, t.quaternion)
        id = f"{entry.scene.name}/{lens}"
        strips.append(Strip(id, trajectory, first + later, 1.0 / period, sensor.lines, lens=lens))
    camera = _camera(data, cameras, images, notes)
    image = _image_points(data, images, strips, camera)
    ground = _ground(data, frame)
    apriori = Apriori(data.image_sigma_px, _sigmas(data, images, frame))
    return BlockData(
        data.name, frame, camera, tuple(strips), data.point_ids, ground, image, apriori, tuple(notes), reference,
        heading=True,  # as the window has it
    )  # fmt: skip


def _rigorous(data: SceneBlockData, entry: ImageEntry) -> PushbroomSensor:
    if entry.scene.model != "rigorous" or not isinstance(entry.location, PushbroomSensor) or entry.view is None:
        raise UserError(
            f"{data.name}: scene {entry.name}: model {entry.scene.model}, wanted the rigorous one: "
            "a recording holds orbit and attitude"
        )
    return entry.location


def _rate(entry: ImageEntry, sensor: PushbroomSensor) -> tuple[float, float]:
    """Time of the first line and period of the lines, seconds."""
    line = np.arange(float(sensor.lines))
    time = sensor.line_times.time_of(line)
    period = float(time[-1] - time[0]) / max(sensor.lines - 1, 1)
    if not period > 0:
        raise UserError(f"scene {entry.name}: lines stored against the flight, wanted them in the order of their times")
    off = float(np.abs((time - time[0]) / period - line).max())
    if off > _MOST_OFF_LINES:
        raise UserError(
            f"scene {entry.name}: its lines keep no constant rate (off by {off:.2f} lines), wanted one: a recording "
            "has a first time and a rate for each strip"
        )
    return float(time[0]), period


def _times(sensor: PushbroomSensor) -> Array:
    ends = np.sort(sensor.line_times.time_of(np.array([-0.5, sensor.lines - 0.5])))
    inside = max(ends[0], sensor.motion.start_s), min(ends[1], sensor.motion.end_s)
    steps = max(int(np.ceil((inside[1] - inside[0]) / POSE_STEP_S)), 1)
    t = inside[0] + (inside[1] - inside[0]) / steps * np.arange(-_BEYOND, steps + _BEYOND + 1)
    return t[(t >= sensor.motion.start_s) & (t <= sensor.motion.end_s)]


def _frame(data: SceneBlockData, sensors: list[PushbroomSensor]) -> LocalFrame:
    """At the middle of what the scenes see, as high as the ground points are in the mean."""
    height = 0.0
    if len(data.ground):
        e = data.ground.xyz_l @ data.frame.R_el.T + data.frame.origin_e
        known = WGS84.geodetic(e)[:, 2]
        known = known[np.isfinite(known)]
        height = float(np.round(known.mean(), 0)) if len(known) else 0.0
    middles = np.concatenate([s.ground((s.lines - 1) / 2, (s.samples - 1) / 2, height) for s in sensors])
    middles = middles[np.isfinite(middles).all(axis=1)]
    if not len(middles):
        raise UserError(f"{data.name}: no scene sees the ground in its middle")
    lat, lon, _ = WGS84.geodetic(middles.mean(axis=0)[None])[0]
    return LocalFrame(round(float(np.degrees(lat)), 6), round(float(np.degrees(lon)), 6), height, "EPSG:4979")


def _camera(data: SceneBlockData, cameras: list[str], images: list[_Image], notes: list[str]) -> LineCamera:
    """A lens and a line for each line of detectors; scenes of one camera share them.

    Raises
    ------
    UserError : scenes of one camera whose detectors look elsewhere
    """
    tables: dict[str, list[_Image]] = {}
    for image in images:
        tables.setdefault(image.lens, []).append(image)
    lenses: list[Lens] = []
    lines: list[CcdLine] = []
    for id, many in tables.items():
        focal_length_mm = many[0].view.focal_length_mm
        for image in many[1:]:
            if image.sensor.samples != many[0].sensor.samples:
                what = f"{image.sensor.samples} samples, scene {many[0].entry.name} {many[0].sensor.samples}"
                raise _another_camera(data, image, what)
        own = [image.poses.xy_mm * (focal_length_mm / image.view.focal_length_mm) for image in many]
        table = np.mean(own, axis=0)
        pixel = float(np.median(np.linalg.norm(np.diff(table, axis=0), axis=1)))
        for image, xy in zip(many, own, strict=True):
            off = float(np.linalg.norm(xy - table, axis=1).max()) / pixel
            if off > _MOST_OFF_PX:
                raise _another_camera(data, image, f"detectors that look {off:.1f} px beside those of the others")
            if off > _TOLD_PX:
                name = image.entry.name
                notes.append(f"scene {name}: its detectors look up to {off:.3f} px beside those of its camera")
        lenses.append(Lens(id, focal_length_mm))
        lines.append(CcdLine(id, id, table, many[0].view.chips))
    return LineCamera(", ".join(cameras), tuple(lenses), tuple(lines))


def _another_camera(data: SceneBlockData, image: _Image, what: str) -> UserError:
    entry = image.entry
    return UserError(
        f"{data.name}: scene {entry.name} of camera {entry.scene.camera!r} has {what}: in a recording they share their "
        "pixels, wanted another camera for it"
    )


def _image_points(data: SceneBlockData, images: list[_Image], strips: list[Strip], camera: LineCamera) -> ImagePoints:
    rays = data.rays
    ccd = np.array([camera.line_index[image.lens] for image in images], dtype=np.int64)[rays.image]
    time = np.empty(len(rays))
    for k, strip in enumerate(strips):
        mine = rays.image == k
        time[mine] = strip.time_of(rays.line[mine])
    line, sample, sigma = (np.asarray(c, dtype=np.float64) for c in (rays.line, rays.sample, rays.sigma_px))
    return ImagePoints(rays.point, rays.image, ccd, line, sample, sigma, time)


def _ground(data: SceneBlockData, frame: LocalFrame) -> KnownPoints:
    """Known points, from the frame of the scenes to the local one."""
    turn = frame.R_el.T @ data.frame.R_el
    e = data.ground.xyz_l @ data.frame.R_el.T + data.frame.origin_e
    return replace(
        data.ground, xyz_l=(e - frame.origin_e) @ frame.R_el, covariance=turn @ data.ground.covariance @ turn.T
    )


def _sigmas(data: SceneBlockData, images: list[_Image], frame: LocalFrame) -> dict[str, object]:
    """Sigmas of the corrections: those of scenes are along the track and about the body, these of X .. kappa."""
    stated: dict[str, object] = {key: value for key, value in data.trajectory.items() if key not in _CARRIED}
    found: list[Array] = []
    for image in images:
        settings = data.trajectory_settings([image.entry])
        offset, shift, drift = (np.asarray(settings[key], dtype=float) for key in _CARRIED)
        ends = np.sort(image.sensor.line_times.time_of(np.array([0.0, image.sensor.lines - 1.0])))
        middle = float(ends.mean())
        pose = image.sensor.motion.at([middle])
        velocity = image.sensor.motion.inertial_velocity(pose.position_e, pose.velocity_e)
        track = frame.R_el.T @ track_axes_e(pose.position_e, velocity)[0]
        R_lb = frame.R_el.T @ pose.R_eb[0]
        J = angles_jacobian(angles_from_matrix(R_lb @ image.view.R_bc)[None])[0]
        turns = J @ R_lb @ flight_axes_b(image.sensor, middle)
        pairs = ((track, offset), (turns, shift), (turns, drift))
        found.append(np.stack([np.linalg.norm(A * s, axis=1) for A, s in pairs]))
    largest = np.max(found, axis=0)
    return _NO_WANDER | stated | {key: tuple(map(float, row)) for key, row in zip(_CARRIED, largest, strict=True)}
