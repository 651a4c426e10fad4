"""A scene as a plain folder, for any pushbroom: ephemeris.csv, attitude.csv, line_times.csv, camera.json, scene.toml.

docs/satellites.md describes columns and keys. Times are UTC texts (``time_utc``) or seconds (``time_s``) from the epoch
in ``scene.toml``. Quaternions are scalar last and turn the body (forward, right, down) to the frame of the attitude;
angles are roll, pitch, yaw: ``R = Rz(yaw) Ry(pitch) Rx(roll)``.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ....solver.camera.line_camera import LineCamera
from ....solver.geometry.earth import ROTATION_RATE
from ....solver.geometry.ellipsoid import WGS84, Ellipsoid
from ....solver.geometry.rotation import R_BC_NOMINAL, matrix_from_navigation
from ....solver.location.look_directions import TableLook
from ....solver.location.pushbroom import PushbroomSensor
from ....solver.location.uncertainty import Sigmas
from ....solver.orbit.attitude import Attitude, SplineAttitude, TableAttitude
from ....solver.orbit.earth_orientation import EarthOrientation, R_bias
from ....solver.orbit.ephemeris import InterpolatedOrbit, Orbit, PolynomialOrbit
from ....solver.orbit.line_times import LineTimes, TabulatedLineTimes
from ....solver.orbit.motion import EarthRotation, Motion
from ....solver.orbit.time_scales import SCALES, parse_time
from ....solver.scene_adjustment.rigorous import lens_view_of
from ...convert import CENTURY_S
from ...errors import UserError
from ..camera_json import read_camera
from ..keys import Keys, read_toml
from ..table import Column, Table, read_table
from .earth_orientation_file import installed_table
from .scene import SatelliteScene, ellipsoid_of, refuse_gap, stated_velocity

Array = NDArray[np.floating]

FILES = ("ephemeris.csv", "attitude.csv", "line_times.csv", "camera.json")
#: Words of scene.toml for the frames of the solver.
_FRAMES = {"earth": "e", "gcrs": "i", "eme2000": "i", "orbital": "o"}
#: Ellipsoids whose half axes differ by a larger share are of different planets.
SAME_PLANET = 1e-3
_TIME = (Column("time_utc", "text", optional=True), Column("time_s", optional=True))


@dataclass(frozen=True)
class _Settings:
    """What scene.toml says; every key has a default."""

    scale: str
    epoch_ns: int | None
    orbit_frame: str
    attitude_frame: str
    orbit_model: str
    orbit_order: int
    attitude_model: str
    light_time: bool
    aberration: bool
    lever_arm_m: tuple[float, ...]
    boresight_deg: tuple[float, ...]
    lens_boresight_deg: dict[str, tuple[float, ...]]
    ellipsoid: Ellipsoid
    rotation_rate: float
    sigmas: Sigmas


def is_scene_folder(path: Path) -> bool:
    """Whether a folder has the files of a scene."""
    return (path / "ephemeris.csv").is_file() or (path / "line_times.csv").is_file()


def read_scene_folder(path: Path) -> SatelliteScene:
    """The scene in a folder; one sensor for each CCD line that has line times.

    Raises
    ------
    UserError : a file that is missing or wrong: file, line, column, what was wanted
    """
    notes: list[str] = []
    for name in FILES:
        if not (path / name).is_file():
            raise UserError(f"{path / name}: no such file, wanted {', '.join(FILES)} in a folder of a scene")
    settings = _settings(path / "scene.toml", notes)
    camera = read_camera(path / "camera.json", notes)
    known = {lens.id for lens in camera.lenses}
    unknown = [id for id in settings.lens_boresight_deg if id not in known]
    if unknown:
        raise UserError(f"{path / 'scene.toml'}: lens.{unknown[0]}: no lens of camera.json, wanted {', '.join(known)}")
    times = read_table(
        path / "line_times.csv",
        (Column("ccd", "text", optional=True), Column("line", low=-1e9), *_TIME),
        notes,
    )
    ephemeris = read_table(path / "ephemeris.csv", _EPHEMERIS, notes)
    away = np.linalg.norm(ephemeris.stack("X_m", "Y_m", "Z_m"), axis=1)
    ephemeris.refuse(
        away < settings.ellipsoid.semi_minor_m,
        "X_m, Y_m, Z_m",
        lambda k: f"{away[k]:.0f} m from the centre of the planet, which is inside it; wanted metres from there",
    )
    attitude = read_table(path / "attitude.csv", _ATTITUDE, notes)
    line_ns, orbit_ns, attitude_ns = (_stamps(table, settings) for table in (times, ephemeris, attitude))
    reference, first, last = int(line_ns[0]), int(line_ns.min()), int(line_ns.max())
    for table, stamps in ((ephemeris, orbit_ns), (attitude, attitude_ns)):
        refuse_gap(table.path, "time", stamps.tolist(), first, last)
    try:
        motion = Motion(
            _orbit(ephemeris, orbit_ns, reference, settings, notes),
            _attitude(attitude, attitude_ns, reference, settings),
            _FRAMES[settings.orbit_frame],
            _FRAMES[settings.attitude_frame],
            _earth(settings, reference, first, last, notes),
            settings.rotation_rate,
        )
        sensors = {
            ccd: PushbroomSensor(
                motion,
                line_times,
                _look(camera, ccd, settings),
                light_time=settings.light_time,
                aberration=settings.aberration,
                lever_arm_b=settings.lever_arm_m,
                ellipsoid=settings.ellipsoid,
                reference_ns=reference,
                name=f"{path.name}/{ccd}",
            )
            for ccd, line_times in _line_times(times, line_ns, reference, camera).items()
        }
    except ValueError as error:
        raise UserError(f"{path}: {error}") from None
    views = {ccd: lens_view_of(camera, ccd, _R_bc(camera, ccd, settings)) for ccd in sensors}
    first = next(iter(sensors.values()))
    return SatelliteScene("folder", first, None, notes, sensors, settings.sigmas, views, camera.name)


_EPHEMERIS = (
    *_TIME, Column("X_m"), Column("Y_m"), Column("Z_m"),
    Column("VX_m_s", optional=True), Column("VY_m_s", optional=True), Column("VZ_m_s", optional=True),
)  # fmt: skip
_ATTITUDE = (
    *_TIME,
    *(Column(name, optional=True) for name in ("qx", "qy", "qz", "qw", "roll_deg", "pitch_deg", "yaw_deg")),
)


def _settings(path: Path, notes: list[str]) -> _Settings:
    file = read_toml(path) if path.is_file() else Keys(path, {})
    time, frames, model = file.table("time"), file.table("frames"), file.table("model")
    mounting, body, sigma = file.table("mounting"), file.table("planet"), file.table("sigma")
    lenses = file.table("lens")
    scale = _choice(time, "scale", "UTC", SCALES)
    epoch = None
    if time.has("epoch"):
        value = time.raw("epoch")
        try:
            epoch = parse_time(value if isinstance(value, str) else str(value).replace("+00:00", "Z"), scale)
        except ValueError as error:
            raise UserError(f"{path}: time.epoch: {error}") from None
    ellipsoid = WGS84
    if body.has("semi_major_m"):
        a = body.number("semi_major_m", positive=True)
        ellipsoid = ellipsoid_of(a, body.number("semi_minor_m", a, positive=True))
        if abs(a / WGS84.semi_major_m - 1.0) > SAME_PLANET:
            for name in ("ephemeris", "attitude"):
                if _FRAMES.get(str(frames.raw(name))) == "i":
                    raise frames.refuse(name, "earth or orbital: how this planet turns against the stars is not known")
            if not body.has("rotation_rate_rad_s"):
                raise body.refuse("rotation_rate_rad_s", "that of this planet, which is not the Earth")
    degrees = sigma.numbers("attitude_deg", 3, (0.0, 0.0, 0.0))
    try:
        sigmas = Sigmas(
            _three(sigma.numbers("position_m", 3, (0.0, 0.0, 0.0))),
            _three(tuple(np.radians(degrees).tolist())),
            sigma.number("time_s", 0.0),
            (sigma.number("line_px", 0.0), sigma.number("sample_px", 0.0)),
            sigma.number("height_m", 0.0),
        )
    except ValueError as error:
        raise UserError(f"{path}: sigma: {error}") from None
    settings = _Settings(
        scale,
        epoch,
        _choice(frames, "ephemeris", "earth", ("earth", "gcrs", "eme2000")),
        _choice(frames, "attitude", "orbital", tuple(_FRAMES)),
        _choice(model, "orbit", "interpolated", ("interpolated", "lagrange", "polynomial")),
        model.integer("orbit_order", 2, low=1),
        _choice(model, "attitude", "spline", ("spline", "linear")),
        _switch(model, "light_time", True),
        _switch(model, "aberration", True),
        mounting.numbers("lever_arm_m", 3, (0.0, 0.0, 0.0)),
        mounting.numbers("boresight_deg", 3, (0.0, 0.0, 0.0)),
        {id: lenses.table(id).numbers("boresight_deg", 3) for id in lenses.values},
        ellipsoid,
        body.number("rotation_rate_rad_s", ROTATION_RATE),
        sigmas,
    )
    for keys in (file, time, frames, model, mounting, body, sigma):
        notes.extend(f"{path.name}: key {key} is not known and was ignored" for key in keys.unread())
    return settings


def _three(values: tuple[float, ...]) -> tuple[float, float, float]:
    x, y, z = values
    return x, y, z


def _choice(keys: Keys, name: str, default: str, words: tuple[str, ...]) -> str:
    value = keys.text(name, default)
    if value not in words:
        raise keys.refuse(name, f"one of {', '.join(words)}")
    return value


def _switch(keys: Keys, name: str, default: bool) -> bool:
    value: Any = keys.raw(name, default)
    if not isinstance(value, bool):
        raise keys.refuse(name, "true or false")
    return value


def _stamps(table: Table, settings: _Settings) -> NDArray[np.int64]:
    """``tai_ns`` of the rows."""
    if "time_utc" in table:
        out = np.empty(len(table), dtype=np.int64)
        for row, text in enumerate(table["time_utc"]):
            try:
                out[row] = parse_time(str(text), settings.scale)
            except ValueError as error:
                raise UserError(f"{table.path}:{table.line_of(row)}: time_utc: {error}") from None
        return out
    if "time_s" not in table:
        raise UserError(
            f"{table.path}:1: time_utc: column missing, wanted time_utc, or time_s and an epoch in scene.toml"
        )
    if settings.epoch_ns is None:
        where = table.path.parent / "scene.toml"
        raise UserError(f"{where}: time.epoch: missing, wanted the time from which time_s of {table.path.name} counts")
    table.refuse(
        ~(np.abs(table["time_s"]) < CENTURY_S), "time_s", lambda i: f"{table['time_s'][i]:.6g} s after the epoch"
    )
    return settings.epoch_ns + np.round(table["time_s"] * 1e9).astype(np.int64)


def _increasing(table: Table, stamps: NDArray[np.int64]) -> None:
    table.refuse(np.diff(stamps, prepend=stamps[0] - 1) <= 0, "time", lambda row: "does not follow the time before")


def _orbit(table: Table, stamps: NDArray[np.int64], reference: int, settings: _Settings, notes: list[str]) -> Orbit:
    _increasing(table, stamps)
    t = (stamps - reference) * 1e-9
    P = table.stack("X_m", "Y_m", "Z_m")
    V = None
    if all(name in table for name in ("VX_m_s", "VY_m_s", "VZ_m_s")):
        V = table.stack("VX_m_s", "VY_m_s", "VZ_m_s")
    if V is not None and settings.orbit_model != "lagrange":
        turning = settings.rotation_rate if settings.orbit_frame == "earth" else 0.0
        V = stated_velocity(table.path.name, t, P, V, turning, notes)
    if settings.orbit_frame == "eme2000":
        P, V = P @ R_bias(), None if V is None else V @ R_bias()
    if settings.orbit_model == "polynomial":
        orbit = PolynomialOrbit(t, P, settings.orbit_order, V)
        largest = float(np.abs(orbit.residual_m).max())
        order = settings.orbit_order
        notes.append(
            f"{table.path.name}: positions differ from the polynomial of order {order} by up to {largest:.3g} m"
        )
        return orbit
    return InterpolatedOrbit(t, P, None if settings.orbit_model == "lagrange" else V)


def _attitude(table: Table, stamps: NDArray[np.int64], reference: int, settings: _Settings) -> Attitude:
    from scipy.spatial.transform import Rotation

    _increasing(table, stamps)
    t = (stamps - reference) * 1e-9
    if all(name in table for name in ("qx", "qy", "qz", "qw")):
        q = table.stack("qx", "qy", "qz", "qw")
        table.refuse(np.linalg.norm(q, axis=1) < 1e-6, "qw", lambda row: "a quaternion of length zero")
    elif all(name in table for name in ("roll_deg", "pitch_deg", "yaw_deg")):
        angles = np.radians(table.stack("roll_deg", "pitch_deg", "yaw_deg"))
        q = Rotation.from_matrix(matrix_from_navigation(*angles.T)).as_quat()
    else:
        raise UserError(f"{table.path}:1: qx: column missing, wanted qx,qy,qz,qw or roll_deg,pitch_deg,yaw_deg")
    if settings.attitude_frame == "eme2000":
        q = (Rotation.from_matrix(R_bias().T) * Rotation.from_quat(q)).as_quat()
    return (TableAttitude if settings.attitude_model == "linear" else SplineAttitude)(t, q)


def _earth(settings: _Settings, reference: int, first: int, last: int, notes: list[str]) -> EarthRotation | None:
    if "i" not in (_FRAMES[settings.orbit_frame], _FRAMES[settings.attitude_frame]):
        return None
    earth = EarthOrientation(installed_table(), reference)
    ends_s = ((first - reference) * 1e-9, (last - reference) * 1e-9)
    earth.R_ie(ends_s)  # refuses dates before the table
    warning = earth.warning(*ends_s)
    if warning:
        notes.append(warning)
    return earth


def _line_times(table: Table, stamps: NDArray[np.int64], reference: int, camera: LineCamera) -> dict[str, LineTimes]:
    """Line times of each CCD line; a file without the column ``ccd`` holds for all of them."""
    ids = [line.id for line in camera.lines]
    column = table.values.get("ccd")
    if column is not None:
        unknown = ~np.isin(column, ids)
        table.refuse(unknown, "ccd", lambda row: f"{column[row]!r}, wanted one of {', '.join(ids)} of camera.json")
    out: dict[str, LineTimes] = {}
    for id in ids:
        rows = np.arange(len(table)) if column is None else np.flatnonzero(column == id)
        if not len(rows):
            continue
        order = rows[np.argsort(table["line"][rows], kind="stable")]
        line = table["line"][order]
        if len(order) < 2:
            raise UserError(
                f"{table.path}: line: {len(order)} row of CCD line {id}, wanted the first and the last line"
            )
        out[id] = TabulatedLineTimes(line, (stamps[order] - reference) * 1e-9, int(line[-1]) + 1)
    if not out:
        raise UserError(f"{table.path}: ccd: no line times of any CCD line of camera.json")
    return out


def _look(camera: LineCamera, ccd: str, settings: _Settings) -> TableLook:
    """Directions in the body of the pixels of a CCD line."""
    k = camera.line_index[ccd]
    xy = camera.lines[k].xy_mm - camera.principal_point_mm[k]
    image = np.column_stack([xy, np.full(len(xy), -camera.focal_length_mm[k])])
    turn = _R_bc(camera, ccd, settings)
    return TableLook(np.arange(len(xy)), image @ turn.T / camera.focal_length_mm[k], len(xy))


def _R_bc(camera: LineCamera, ccd: str, settings: _Settings) -> Array:
    """Rotation (3, 3) from the image frame of the lens behind a CCD line to the body."""
    lens = camera.lines[camera.line_index[ccd]].lens
    turn = matrix_from_navigation(*np.radians(settings.boresight_deg))
    if lens in settings.lens_boresight_deg:
        turn = turn @ matrix_from_navigation(*np.radians(settings.lens_boresight_deg[lens]))
    return turn @ R_BC_NOMINAL
