"""Image support data of the community sensor model (JSON of usgscsm and ALE): line scanners about any planet.

Conventions. Lines and samples of the file count from 0.5 at the centre of the first pixel. Times are ephemeris seconds
(TDB past J2000); those of ``line_scan_rate`` and of the tables with ``t0`` and ``dt`` count from the centre time. Focal
plane coordinates in millimetres follow from detector line and sample through ``focal2pixel``; a detector looks along
the line ``(x, y, f)`` of the camera, on the side where the planet is. Two forms are read: ``sensor_position`` and
``sensor_orientation`` (body-fixed; quaternions scalar last, camera to body-fixed), and ``instrument_position``,
``instrument_pointing`` and ``body_rotation`` (J2000; quaternions scalar first, J2000 to camera and J2000 to
body-fixed). Light time and aberration are in them already.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ....solver.location.look_directions import TableLook
from ....solver.location.pushbroom import PushbroomSensor
from ....solver.orbit.attitude import SplineAttitude, TableAttitude, unit_quaternions
from ....solver.orbit.ephemeris import InterpolatedOrbit
from ....solver.orbit.line_times import LineTimes, TabulatedLineTimes, UniformLineTimes
from ....solver.orbit.motion import Motion
from ....solver.orbit.time_scales import tai_from_day
from ...errors import UserError
from ..keys import Keys, read_json
from ..other_kinds import other_kind
from .scene import GAP_STEPS, SAME_VELOCITY_M_S, SatelliteScene, ellipsoid_of, stated_velocity, velocity_misfit

Array = NDArray[np.floating]

_LINE_SCANNER = "USGS_ASTRO_LINE_SCANNER_SENSOR_MODEL"
_UNITS = {"m": 1.0, "km": 1000.0}
_J2000_TAI_NS = tai_from_day(51544, 43_200_000_000_000, "TT")
#: Share of a step by which lines may be taken before the first and after the last node.
_BEYOND = 1.0


def read_isd(path: Path) -> SatelliteScene:
    """The scene of an ISD.

    Raises
    ------
    UserError : naming file, key and what was wanted
    """
    file, notes = read_json(path), list[str]()
    if file.has("exterior") and not file.has("name_model"):
        raise UserError(
            f"{path}: orientation of a frame camera, which `triline locate` and `rectify --sensor` take; wanted a scene"
        )
    if not file.has("name_model") and (other := other_kind(path)):
        raise UserError(f"{path}: {other}; wanted a scene")
    model = file.text("name_model")
    if model != _LINE_SCANNER:
        raise file.refuse("name_model", _LINE_SCANNER)
    centre_s = file.number("center_ephemeris_time")
    radii = file.table("radii")
    scale = _unit(radii, "km")
    ellipsoid = ellipsoid_of(
        radii.number("semimajor", positive=True) * scale, radii.number("semiminor", positive=True) * scale
    )
    lines, samples = file.integer("image_lines", low=1), file.integer("image_samples", low=2)
    build = _body_fixed(file, notes) if file.has("sensor_position") else _inertial(file, centre_s, notes)
    try:
        motion, times, look = build(), _line_times(file, lines), _look(file)
        middle = motion.at(times.time_of(np.array([0.5 * (lines - 1)])))
        away = middle.position_e[0] @ middle.R_eb[0] @ look(0.5 * (samples - 1)) > 0
        detectors = np.arange(samples, dtype=float)
        sensor = PushbroomSensor(
            motion,
            times,
            TableLook(detectors, look(detectors) * (-1.0 if away else 1.0), samples),
            ellipsoid=ellipsoid,
            reference_ns=_J2000_TAI_NS + round(centre_s * 1e9),
            name=path.stem,
        )
    except ValueError as error:
        raise UserError(f"{path}: {error}") from None
    return SatelliteScene("isd", sensor, None, notes)


def _unit(keys: Keys, default: str) -> float:
    unit = keys.text("unit", default)
    if unit not in _UNITS:
        raise keys.refuse("unit", "m or km")
    return _UNITS[unit]


def _array(keys: Keys, name: str, columns: int, least: int = 2) -> Array:
    """A list of rows of numbers."""
    value = keys.raw(name)
    try:
        rows = np.array(value, dtype=float)
    except (TypeError, ValueError):
        rows = np.empty(0)
    if rows.ndim != 2 or rows.shape[-1] != columns or len(rows) < least or not np.isfinite(rows).all():
        raise keys.refuse(name, f"at least {least} rows of {columns} numbers")
    return rows


def _times(keys: Keys, count: int) -> Array:
    value = keys.raw("ephemeris_times")
    try:
        times = np.array(value, dtype=float)
    except (TypeError, ValueError):
        times = np.empty(0)
    if times.shape != (count,) or not np.isfinite(times).all() or not (np.diff(times) > 0).all():
        raise keys.refuse("ephemeris_times", f"{count} numbers that increase")
    return times


def _body_fixed(file: Keys, notes: list[str]) -> Callable[[], Motion]:
    place, turn = file.table("sensor_position"), file.table("sensor_orientation")
    scale = _unit(place, "m")
    P = _array(place, "positions", 3) * scale
    q = _array(turn, "quaternions", 4)
    t = file.number("t0_ephemeris") + np.arange(len(P)) * file.number("dt_ephemeris", positive=True)
    tq = file.number("t0_quaternion") + np.arange(len(q)) * file.number("dt_quaternion", positive=True)
    V = _array(place, "velocities", 3) * scale if place.has("velocities") else None
    if V is not None and len(V) != len(P):
        raise place.refuse("velocities", f"{len(P)} rows, as many as positions")
    if len(P) >= 8:
        V = None
    if V is not None:
        V = stated_velocity(file.path.name, t, P, V, 0.0, notes)

    def build() -> Motion:
        return Motion(
            InterpolatedOrbit(t, P, V, margin_s=_BEYOND * (t[1] - t[0])),
            SplineAttitude(tq, q, margin_s=_BEYOND * (tq[1] - tq[0])),
            rotation_rate=0.0,
        )

    return build


def _inertial(file: Keys, centre_s: float, notes: list[str]) -> Callable[[], Motion]:
    from scipy.spatial.transform import Rotation

    for name in ("instrument_position", "instrument_pointing", "body_rotation"):
        if not file.has(name):
            raise file.refuse(
                name, "the ephemeris of the spacecraft" if "pos" in name else "its attitude and the planet's"
            )
    place, pointing, body = (file.table(n) for n in ("instrument_position", "instrument_pointing", "body_rotation"))
    scale = _unit(place, "km")
    P = _array(place, "positions", 3) * scale
    V = _array(place, "velocities", 3) * scale if place.has("velocities") else None
    t = _times(place, len(P)) - centre_s
    q, qb = _array(pointing, "quaternions", 4), _array(body, "quaternions", 4)
    tq, tb = _times(pointing, len(q)) - centre_s, _times(body, len(qb)) - centre_s
    _refuse_gap(pointing, tq)
    if V is not None and len(V) != len(P):
        raise place.refuse("velocities", f"{len(P)} rows, as many as positions")
    apart = V is not None and velocity_misfit(t, P, V) > SAME_VELOCITY_M_S
    if apart:
        notes.append(f"{file.path.name}: velocities are not the slope of the positions and were not used")
    fixed = [np.array(keys.numbers("constant_rotation", 9, tuple(np.eye(3).ravel()))).reshape(3, 3)
             for keys in (pointing, body)]  # fmt: skip

    def build() -> Motion:
        planet = _PlanetRotation(TableAttitude(tb, qb[:, [1, 2, 3, 0]], margin_s=tb[1] - tb[0]), fixed[1])
        camera_from_inertial = fixed[0] @ Rotation.from_quat(unit_quaternions(q[:, [1, 2, 3, 0]])).as_matrix()
        inertial_from_camera = Rotation.from_matrix(np.swapaxes(camera_from_inertial, -1, -2)).as_quat()
        return Motion(
            InterpolatedOrbit(t, P, None if apart else V, margin_s=_BEYOND * (t[1] - t[0])),
            SplineAttitude(tq, inertial_from_camera, margin_s=_BEYOND * (tq[1] - tq[0])),
            orbit_frame="i",
            attitude_frame="i",
            earth=planet,
            rotation_rate=0.0,
        )

    return build


class _PlanetRotation:
    """Rotation of a planet from a table: turns J2000 to body-fixed at a constant rate between its nodes."""

    def __init__(self, attitude: TableAttitude, fixed: Array):
        self._attitude, self._fixed = attitude, fixed

    def R_ie(self, time_s: ArrayLike) -> Array:
        return np.swapaxes(self._fixed @ self._attitude.at(time_s), -1, -2)


def _refuse_gap(keys: Keys, t: Array) -> None:
    """Refuse a pointing table with a gap; only even tables are judged, reduced ones have steps of all lengths."""
    steps = np.diff(t)
    even = np.ptp(steps[steps < np.median(steps) * 1.5]) < 0.01 * np.median(steps) and len(steps) > 3
    if even and steps.max() > GAP_STEPS * np.median(steps):
        k = int(np.argmax(steps))
        raise UserError(
            f"{keys.path}: {keys.where}: gap from {t[k]:.3f} to {t[k + 1]:.3f} s from the centre time, wanted a value "
            f"every {np.median(steps):g} s"
        )


def _line_times(file: Keys, lines: int) -> LineTimes:
    rates = _array(file, "line_scan_rate", 3, least=1)
    if not (np.diff(rates[:, 0]) > 0).all() or not (rates[:, 2] != 0).all():
        raise file.refuse("line_scan_rate", "rows of first line, time, seconds a line; lines that increase")
    if len(rates) == 1:
        first, start, period = rates[0]
        return UniformLineTimes(start + period * (1.0 - first), period, lines)
    u = np.arange(max(lines, 2), dtype=float)
    k = np.clip(np.searchsorted(rates[:, 0], u + 0.5, side="right") - 1, 0, len(rates) - 1)
    return TabulatedLineTimes(u, rates[k, 1] + rates[k, 2] * (u + 1.0 - rates[k, 0]), lines)


def _look(file: Keys) -> Callable[[ArrayLike], Array]:
    """A function from samples (n,) or one, 0-based, to look directions in the camera, (n, 3) or (3,)."""
    focal = file.table("focal_length_model").number("focal_length")
    if focal == 0:
        raise file.table("focal_length_model").refuse("focal_length", "a number that is not 0")
    centre = file.table("detector_center")
    to_line, to_sample = (
        np.array(file.numbers("focal2pixel_lines", 3)),
        np.array(file.numbers("focal2pixel_samples", 3)),
    )
    matrix = np.array([to_line[1:], to_sample[1:]])
    if abs(np.linalg.det(matrix)) < 1e-12:
        raise file.refuse("focal2pixel_samples", "a transformation that can be inverted, with focal2pixel_lines")
    summing = file.number("detector_sample_summing", 1.0, positive=True)
    line = file.number("starting_detector_line", 0.0) - centre.number("line") - to_line[0]
    first = file.number("starting_detector_sample", 0.0) - centre.number("sample") - to_sample[0]

    def directions(sample: ArrayLike) -> Array:
        v = np.asarray(sample, dtype=float)
        x, y = np.tensordot(np.linalg.inv(matrix), np.stack([np.full_like(v, line), (v + 0.5) * summing + first]), 1)
        x, y = _undistorted(file, x, y, focal)
        return np.stack([x / focal, y / focal, np.ones_like(v)], axis=-1)

    return directions


def _undistorted(file: Keys, x: Array, y: Array, focal: float) -> tuple[Array, Array]:
    """Focal plane coordinates (mm) without the distortion of the lens."""
    models = file.table("optical_distortion")
    for name in ("radial", "lrolrocnac", "radtan"):
        if not models.has(name):
            continue
        keys = models.table(name)
        values = keys.raw("coefficients")
        count = {"radial": 3, "lrolrocnac": 1, "radtan": 5}[name]
        k = keys.numbers("coefficients", len(values) if isinstance(values, list) and name == "radial" else count)
        if name == "radial":
            r2 = x * x + y * y
            shift = sum((c * r2**i for i, c in enumerate(k)), np.zeros_like(x))
            return x * (1.0 - shift), y * (1.0 - shift)
        if name == "lrolrocnac":
            return x, y / (1.0 + k[0] * y * y)
        u, v = _without_brown(x / focal, y / focal, k)
        return u * focal, v * focal
    others = [name for name in models.values if name not in ("radial", "lrolrocnac", "radtan")]
    if others:
        raise models.refuse(others[0], "radial, radtan or lrolrocnac, the distortions that are read")
    return x, y


def _without_brown(xd: Array, yd: Array, k: tuple[float, ...]) -> tuple[Array, Array]:
    """Inverse of Brown's distortion (k1, k2, p1, p2, k3) in units of the focal length, by fixed-point steps."""
    k1, k2, p1, p2, k3 = k
    u, v = xd, yd
    for _ in range(50):
        r2 = u * u + v * v
        radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        u, v = (
            (xd - 2.0 * p1 * u * v - p2 * (r2 + 2.0 * u * u)) / radial,
            (yd - p1 * (r2 + 2.0 * v * v) - 2.0 * p2 * u * v) / radial,
        )
    return u, v
