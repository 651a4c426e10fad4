"""The orientation of a frame image: interior and exterior in one small JSON file (docs/rectification.md)."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ...solver.geometry.earth import ROTATION_RATE
from ...solver.geometry.ellipsoid import WGS84
from ...solver.geometry.frames import CrsError, LocalFrame
from ...solver.geometry.rotation import (
    R_BC_NOMINAL,
    R_ENU_NED,
    matrix_from_angles,
    matrix_from_navigation,
    matrix_from_quaternion,
)
from ...solver.location.frame_camera import FrameCamera
from ...solver.orbit.motion import R_from_orbital
from ..errors import UserError
from .keys import Keys, read_json
from .projection import refuse_missing_grids

_DISTORTION = ("k1", "k2", "k3", "p1", "p2")
#: Places a side of the image at which the distortion is looked at, and by how much of the distance from the principal
#: point it may move one without a word. Tuned: fisheye lenses, which are not Brown's, are beyond.
_PLACES, MOST_BENT = 21, 0.4
_WAYS = (
    "omega_phi_kappa_deg or roll_pitch_heading_deg with lat_deg, lon_deg, height_m or crs and position; "
    "roll_pitch_yaw_deg (orbital frame) or quaternion_xyzw with position_e_m"
)


def is_frame_json(path: Path) -> bool:
    """Whether a file is the orientation of a frame image."""
    if path.suffix.lower() != ".json" or not path.is_file():
        return False
    with open(path, "rb") as file:
        return b'"exterior"' in file.read(65536)


def read_frame(path: Path, notes: list[str]) -> tuple[FrameCamera, dict[str, tuple[float, float, float]]]:
    """A frame camera with its orientation, and its sigmas: ``position_m`` (east, north, up), ``attitude_rad``.

    Raises
    ------
    UserError : naming file, key and what was wanted
    """
    file = read_json(path)
    interior, exterior = file.table("interior"), file.table("exterior")
    pixel = interior.raw("pixel_size_mm")
    size = interior.numbers("pixel_size_mm", 2, positive=True) if isinstance(pixel, list) else (
        (interior.number("pixel_size_mm", positive=True),) * 2
    )  # fmt: skip
    lens = interior.table("distortion")
    C, R = _orientation(path, exterior)
    sigma = file.table("sigma")
    position = sigma.numbers("position_m", 3, (0.0, 0.0, 0.0))
    attitude = sigma.numbers("attitude_deg", 3, (0.0, 0.0, 0.0))
    try:
        camera = FrameCamera(
            C, R, interior.number("focal_length_mm", positive=True), size, interior.integer("lines", low=1),
            interior.integer("samples", low=1),
            principal_point_mm=interior.numbers("principal_point_mm", 2, (0.0, 0.0)),
            distortion=[lens.number(name, 0.0) for name in _DISTORTION],
        )  # fmt: skip
    except ValueError as error:
        raise UserError(f"{path}: {error}") from None
    notes += _of_distortion(camera, lens)
    file.raw("name")
    for keys in (file, interior, exterior, lens, sigma):
        notes.extend(f"{path.name}: key {key} is not known and was ignored" for key in keys.unread())
    x, y, z = np.radians(attitude).tolist()
    return camera, {"position_m": (position[0], position[1], position[2]), "attitude_rad": (x, y, z)}


def _of_distortion(camera: FrameCamera, lens: Keys) -> list[str]:
    """A note where the distortion turns back before the edge of the image, or bends more than lenses do.

    Raises
    ------
    UserError : it does before half of the image
    """
    line, sample = (
        a.ravel() for a in np.meshgrid(*(np.linspace(0.0, n - 1.0, _PLACES) for n in (camera.lines, camera.samples)))
    )
    measured = np.stack([(sample - 0.5 * (camera.samples - 1)), (0.5 * (camera.lines - 1) - line)], axis=1)
    measured = measured * camera.pixel_mm - camera.principal_point_mm
    ideal = camera.image_mm(line, sample)
    lost = float(np.isnan(ideal).any(axis=1).mean())
    units = "in powers of mm, of places in mm"
    if lost > 0.5:
        wanted = f"a distortion {units} that does not turn back before {100 * lost:.0f} % of the image"
        raise lens.refuse(next(name for name in _DISTORTION if lens.number(name, 0.0)), wanted)
    if lost:
        return [f"{lens.path.name}: {lens.where}: turns back within the image, {100 * lost:.1f} % of it have no place"]
    bent = float((np.linalg.norm(measured - ideal, axis=1) / np.maximum(np.linalg.norm(measured, axis=1), 1e-9)).max())
    if bent > MOST_BENT:
        return [f"{lens.path.name}: {lens.where}: moves places by up to {100 * bent:.0f} % of their distance: {units}?"]
    return []


def _within(keys: Keys, key: str, most: float) -> float:
    value = keys.number(key)
    if not abs(value) <= most:
        raise keys.refuse(key, f"degrees from {-most:g} to {most:g}")
    return value


def _orientation(path: Path, exterior: Keys) -> tuple[np.ndarray, np.ndarray]:
    """Perspective centre and rotation from the image frame, Earth-fixed."""
    if exterior.has("position_e_m"):
        C = np.array(exterior.numbers("position_e_m", 3))
        if exterior.has("quaternion_xyzw"):
            q = np.array(exterior.numbers("quaternion_xyzw", 4))
            if not np.linalg.norm(q) > 1e-6:
                raise exterior.refuse("quaternion_xyzw", "a quaternion with a length")
            return C, matrix_from_quaternion(q)
        velocity = np.array(exterior.numbers("velocity_e_m_s", 3))
        R_eo = R_from_orbital(C, velocity + np.cross([0.0, 0.0, ROTATION_RATE], C))
        angles = np.radians(exterior.numbers("roll_pitch_yaw_deg", 3))
        return C, R_eo @ matrix_from_navigation(*angles) @ R_BC_NOMINAL
    if exterior.has("crs"):
        position = np.array(exterior.numbers("position", 3))
        if exterior.text("crs") == "local":  # which of a flight begin where its project says, of an image nowhere
            raise exterior.refuse("crs", "a projected or geographic CRS such as EPSG:32633")
        refuse_missing_grids(exterior.text("crs"), path)
        try:
            frame = LocalFrame.around(position, exterior.text("crs"))
            local = frame.from_crs(position[None])[0]
            R_axes = frame.R_l_crs(position[None])[0]
        except CrsError as error:
            raise UserError(f"{path}: {exterior.name('crs')}: {error}") from None
        C, R_axes_e = frame.origin_e + frame.R_el @ local, frame.R_el @ R_axes
    elif exterior.has("lat_deg"):
        lat, lon = np.radians([_within(exterior, "lat_deg", 90.0), _within(exterior, "lon_deg", 360.0)])
        C = WGS84.cartesian(lat, lon, exterior.number("height_m"))
        R_axes_e = LocalFrame(float(np.degrees(lat)), float(np.degrees(lon)), 0.0).R_el
    else:
        raise UserError(f"{path}: {exterior.where}: no orientation, wanted {_WAYS}")
    if exterior.has("omega_phi_kappa_deg"):
        return C, R_axes_e @ matrix_from_angles(*np.radians(exterior.numbers("omega_phi_kappa_deg", 3)))
    rph = np.radians(exterior.numbers("roll_pitch_heading_deg", 3))
    return C, R_axes_e @ R_ENU_NED @ matrix_from_navigation(*rph) @ R_BC_NOMINAL
