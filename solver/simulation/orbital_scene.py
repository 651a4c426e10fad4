"""Satellite sensors on a circular orbit over the turning Earth: true scenes, for tests and worked examples.

Figures are the published nominal ones, rounded: PRISM [K], SPOT-5/HRS and ASTER [P], EROS-A1 (one lens, which turns
back while it images, so that the ground moves by more slowly than the satellite), MOMS-02 on the shuttle, MISR (nine
lenses).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..camera.line_camera import LineCamera
from ..camera.sensors import lens_rotation, lens_views_deg, multi_lens_camera, preset, with_pixels
from ..geometry.earth import GM, ROTATION_RATE, SEMI_MAJOR_M
from ..geometry.rotation import R_BC_NOMINAL, matrix_from_navigation
from ..location.look_directions import TableLook
from ..location.pushbroom import PushbroomSensor
from ..orbit.ephemeris import check_covered
from ..orbit.line_times import UniformLineTimes
from ..orbit.motion import Motion

Array = NDArray[np.floating]

#: Orbit and attitude are given so long before the first and after the last line, seconds.
_MARGIN_S = 10.0
_MISR_HEIGHT_M = 705_000.0


@dataclass(frozen=True)
class OrbitalSensor:
    """A camera on its orbit.

    Attributes
    ----------
    camera : one lens a line
    view_deg : where each lens looks, degrees forward
    height_m : of the orbit above the equator
    inclination_deg : of the orbit
    period_s : from line to line
    lines : of a scene
    pitch_rate_deg_s : at which the body turns forward while it images; negative: the ground is held back
    yaw_steered : the body flies with its x axis along the track over the turning Earth, so that all lenses see the same
        swath; otherwise along the velocity against the stars
    """

    camera: LineCamera
    view_deg: Mapping[str, float]
    height_m: float
    inclination_deg: float
    period_s: float
    lines: int
    pitch_rate_deg_s: float = 0.0
    yaw_steered: bool = False


def _misr() -> tuple[LineCamera, dict[str, float]]:
    # its angles are published as zenith angles on the ground; at the satellite they are smaller
    zenith = {"Df": 70.5, "Cf": 60.0, "Bf": 45.6, "Af": 26.1, "An": 0.0}
    zenith |= {"Aa": -26.1, "Ba": -45.6, "Ca": -60.0, "Da": -70.5}
    ratio = SEMI_MAJOR_M / (SEMI_MAJOR_M + _MISR_HEIGHT_M)
    views = {id: float(np.degrees(np.arcsin(ratio * np.sin(np.radians(angle))))) for id, angle in zenith.items()}
    focal = {"A": 59.3, "B": 73.4, "C": 95.3, "D": 123.7}
    camera = multi_lens_camera("misr", 59.3, dict.fromkeys(views, 1504), 0.021)
    lenses = tuple(replace(lens, focal_length_mm=focal[lens.id[0]]) for lens in camera.lenses)
    return replace(camera, lenses=lenses), views


def _presets() -> dict[str, OrbitalSensor]:
    misr, misr_views = _misr()
    moms = multi_lens_camera("moms-02", 237.2, {"F": 8304, "B": 8304}, 0.010)
    eros = multi_lens_camera("eros-a1", 3450.0, {"P": 7043}, 0.013)
    views_of = {name: lens_views_deg(name) for name in ("alos-prism", "spot5-hrs", "aster-vnir")}
    known = {name: (preset(name), views) for name, views in views_of.items()}
    # the same fields in pixels of 40 to 400 m: image lines that are soon rendered
    prism = multi_lens_camera("alos-prism-300", 1939.0, dict.fromkeys("FNB", 300), 0.007 * 14_496 / 300)
    aster = multi_lens_camera("aster-vnir-300", 329.0, {"3N": 300, "3B": 366}, 0.007 * 4100 / 300)
    hrs = with_pixels(preset("spot5-hrs"), 300)
    return {
        "alos-prism": OrbitalSensor(*known["alos-prism"], 691_650.0, 98.16, 0.37e-3, 14_496),
        "spot5-hrs": OrbitalSensor(*known["spot5-hrs"], 832_000.0, 98.7, 0.752e-3, 12_000),
        "spot5-hrs-small": OrbitalSensor(hrs, views_of["spot5-hrs"], 832_000.0, 98.7, 0.060, 150),
        "alos-prism-small": OrbitalSensor(
            prism, views_of["alos-prism"], 691_650.0, 98.16, 0.0179, 300, yaw_steered=True
        ),
        "aster-vnir-small": OrbitalSensor(aster, views_of["aster-vnir"], 705_000.0, 98.2, 0.0301, 307),
        "aster-vnir": OrbitalSensor(*known["aster-vnir"], 705_000.0, 98.2, 2.199e-3, 4200),
        "eros-a1": OrbitalSensor(eros, {"P": 0.0}, 480_000.0, 97.3, 1.4e-3, 6600, -0.63),
        "eros-a1-small": OrbitalSensor(with_pixels(eros, 300), {"P": 0.0}, 480_000.0, 97.3, 0.0308, 300, -0.63),
        "moms-02": OrbitalSensor(moms, {"F": 21.4, "B": -21.4}, 296_000.0, 28.5, 1.8e-3, 8000),
        "misr": OrbitalSensor(misr, misr_views, _MISR_HEIGHT_M, 98.2, 40.8e-3, 512),
    }


#: The sensors by name.
ORBITAL_SENSORS = _presets()


@dataclass(frozen=True)
class CircularOrbit:
    """A circle in inertial space, told in Earth-fixed axes.

    Attributes
    ----------
    radius_m, inclination_rad : of the orbit
    node_rad : longitude of its ascending node at time 0
    phase_rad : angle from the node at time 0
    start_s, end_s : span in which it is given
    """

    radius_m: float
    inclination_rad: float
    node_rad: float
    phase_rad: float
    start_s: float = -np.inf
    end_s: float = np.inf

    @property
    def mean_motion(self) -> float:
        """Angular velocity, rad/s."""
        return float(np.sqrt(GM / self.radius_m**3))

    def at(self, time_s: ArrayLike) -> tuple[Array, Array]:
        """Position (n, 3) in metres and velocity (n, 3) in m/s over the turning Earth.

        Raises
        ------
        ValueError : a time outside the span
        """
        t = np.atleast_1d(np.asarray(time_s, dtype=float))
        check_covered(t, self.start_s, self.end_s, "the orbit")
        n, ci, si = self.mean_motion, np.cos(self.inclination_rad), np.sin(self.inclination_rad)
        u, node = self.phase_rad + n * t, self.node_rad - ROTATION_RATE * t
        cu, su, cn, sn = np.cos(u), np.sin(u), np.cos(node), np.sin(node)
        P = np.stack([cn * cu - sn * su * ci, sn * cu + cn * su * ci, su * si], axis=1)
        V = np.stack([-cn * su - sn * cu * ci, -sn * su + cn * cu * ci, cu * si], axis=1) * n
        turning = np.stack([-P[:, 1], P[:, 0], np.zeros(len(t))], axis=1) * ROTATION_RATE
        return P * self.radius_m, (V - turning) * self.radius_m


@dataclass(frozen=True)
class SteadyAttitude:
    """Roll, pitch and yaw in the orbital frame that change at constant rates.

    Attributes
    ----------
    angles_rad, rates_rad_s : (3,) roll, pitch, yaw at time 0, and their rates
    start_s, end_s : span in which it is given
    """

    angles_rad: tuple[float, float, float] = (0.0, 0.0, 0.0)
    rates_rad_s: tuple[float, float, float] = (0.0, 0.0, 0.0)
    start_s: float = -np.inf
    end_s: float = np.inf

    def at(self, time_s: ArrayLike) -> Array:
        """Rotations (n, 3, 3) from the body to the orbital frame."""
        t = np.atleast_1d(np.asarray(time_s, dtype=float))
        check_covered(t, self.start_s, self.end_s, "the attitude")
        return matrix_from_navigation(*(a + r * t for a, r in zip(self.angles_rad, self.rates_rad_s, strict=True)))


@dataclass(frozen=True)
class OrbitalScene:
    """One overpass: the sensor of every line of detectors, and what they are made of.

    Attributes
    ----------
    sensors : by the id of the line
    motion : of the body; time 0 is when the satellite is nearest to the place
    first_line_s : of every line
    endless_orbit : the orbit of the motion, without a beginning and an end
    """

    sensor: OrbitalSensor
    sensors: Mapping[str, PushbroomSensor]
    motion: Motion
    first_line_s: Mapping[str, float] = field(repr=False)
    endless_orbit: CircularOrbit


def overpass(
    sensor: OrbitalSensor,
    lat_deg: float,
    lon_deg: float,
    roll_deg: float = 0.0,
    *,
    ascending: bool = False,
    light_time: bool = True,
    aberration: bool = True,
) -> OrbitalScene:
    """Scenes of all lines of a sensor, with their middles near a place below the satellite.

    Parameters
    ----------
    sensor : camera and orbit
    lat_deg, lon_deg : geocentric latitude and longitude that the satellite passes over at time 0
    roll_deg : look to the left of the track (roll to the right is negative)
    ascending : northwards

    Raises
    ------
    ValueError : a latitude that the orbit does not reach
    """
    i, lat = np.radians(sensor.inclination_deg), np.radians(lat_deg)
    reach = np.sin(lat) / np.sin(i)
    if abs(reach) > 1.0 + 1e-12:
        raise ValueError(
            f"latitude {lat_deg:g} deg, wanted one that an orbit of {sensor.inclination_deg:g} deg reaches"
        )
    phase = float(np.arcsin(np.clip(reach, -1.0, 1.0)))
    phase = phase if ascending else np.pi - phase
    node = np.radians(lon_deg) - np.arctan2(np.sin(phase) * np.cos(i), np.cos(phase))
    half = 0.5 * (sensor.lines - 1) * sensor.period_s
    radius = SEMI_MAJOR_M + sensor.height_m
    orbit = CircularOrbit(radius, i, float(node), phase)
    first = {
        line.id: _time_over(sensor.view_deg[line.lens], radius, orbit.mean_motion) - half
        for line in sensor.camera.lines
    }
    start, end = min(first.values()) - _MARGIN_S, max(first.values()) + 2 * half + _MARGIN_S
    rate = np.radians(sensor.pitch_rate_deg_s)
    yaw = _yaw_along_track(orbit) if sensor.yaw_steered else 0.0
    motion = Motion(
        replace(orbit, start_s=start, end_s=end),
        SteadyAttitude((np.radians(roll_deg), 0.0, yaw), (0.0, rate, 0.0), start, end),
        attitude_frame="o",
    )
    sensors = {
        line.id: PushbroomSensor(
            motion,
            UniformLineTimes(first[line.id], sensor.period_s, sensor.lines),
            look_of(sensor.camera, k, sensor.view_deg[line.lens]),
            light_time=light_time,
            aberration=aberration,
            name=f"{sensor.camera.name}/{line.id}",
        )
        for k, line in enumerate(sensor.camera.lines)
    }
    return OrbitalScene(sensor, sensors, motion, first, orbit)


def overpass_beside(sensor: OrbitalSensor, lat_deg: float, lon_deg: float, roll_deg: float) -> OrbitalScene:
    """An overpass that looks aside at a place: the middle of the steepest line's scene lies there.

    Parameters
    ----------
    sensor : camera and orbit
    lat_deg, lon_deg : geocentric latitude and longitude of the place
    roll_deg : look to the left of the track

    Raises
    ------
    ValueError : a latitude that the orbit does not reach
    """
    lat, lon = lat_deg, lon_deg
    steepest = min(sensor.camera.lines, key=lambda line: abs(sensor.view_deg[line.lens])).id
    scene = overpass(sensor, lat, lon, roll_deg)
    if not roll_deg:
        return scene
    for _ in range(3):
        seen = scene.sensors[steepest]
        ground = seen.ground([(seen.lines - 1) / 2], [(seen.samples - 1) / 2], 0.0)[0]
        lat += lat_deg - float(np.degrees(np.arctan2(ground[2], np.hypot(ground[0], ground[1]))))
        lon += lon_deg - float(np.degrees(np.arctan2(ground[1], ground[0])))
        lon = (lon + 180.0) % 360.0 - 180.0
        scene = overpass(sensor, lat, lon, roll_deg)
    return scene


def _yaw_along_track(orbit: CircularOrbit) -> float:
    """Yaw at time 0, rad, that brings the body's x axis from the inertial velocity to that over the turning Earth."""
    (position,), (velocity,) = orbit.at(0.0)
    inertial = velocity + ROTATION_RATE * np.array([-position[1], position[0], 0.0])
    right = np.cross(-position, inertial)
    x, y = (axis @ velocity / np.linalg.norm(axis) for axis in (inertial, right))
    return float(np.arctan2(y, x))


def look_of(camera: LineCamera, k: int, view_deg: float) -> TableLook:
    """Directions in the body of the pixels of line ``k``, whose lens looks ``view_deg`` forward."""
    xy = camera.lines[k].xy_mm - camera.principal_point_mm[k]
    focal = camera.focal_length_mm[k]
    image = np.column_stack([xy, np.full(len(xy), -focal)]) / focal
    return TableLook(np.arange(len(xy)), image @ (R_BC_NOMINAL @ lens_rotation(view_deg)).T, len(xy))


def _time_over(view_deg: float, radius_m: float, mean_motion: float) -> float:
    """When a lens that looks forward sees what is below the satellite at time 0 (round Earth), seconds."""
    view = np.radians(view_deg)
    incidence = np.arcsin(np.clip(radius_m / SEMI_MAJOR_M * np.sin(view), -1.0, 1.0))
    return float(-(incidence - view) / mean_motion)
