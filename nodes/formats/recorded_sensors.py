"""Raw inertial and GNSS data of a recording, as a sensor folder holds them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...solver.geometry.rotation import R_ENU_NED
from ...solver.navigation.inertial_cleaning import Finding
from ...solver.navigation.inertial_data import TACTICAL, GnssData, InertialGrade
from .. import convert
from ..errors import UserError
from ..node import Message
from ..recording.reader import RecordingReader
from ..recording.remote import path_of
from ..recording.summary import left_out_lines
from ..voices import VERDICT, RecordedVoices
from .sensor_folder import Platform, SensorFolder, read_platform

_FIELDS = {
    "imu.time": "sensor/imu: time_ns",
    "imu.force": "sensor/imu: force_x,force_y,force_z",
    "imu.rate": "sensor/imu: rate_x,rate_y,rate_z",
    "imu.axes": "sensor/imu: force_x,force_y,force_z,rate_x,rate_y,rate_z",
    "imu.noise": "sensor/imu: force_sigma,rate_sigma",
    "gnss.time": "sensor/gnss: timestamp",
    "gnss.sigma": "sensor/gnss: position_covariance",
    "gnss.position": "sensor/gnss: latitude,longitude,altitude",
    "gnss.velocity": "sensor/gnss: velocity_enu,velocity_covariance",
}


@dataclass(frozen=True)
class RecordedSensors(SensorFolder):
    """Sensor data of a recording; times count from ``offset_s`` (Unix seconds)."""

    def named(self, finding: Finding) -> str:
        where = _FIELDS.get(finding.subject)
        return finding.text if where is None else f"{where}: {finding.text}"


def read_recorded_sensors(path: str | Path, platform_file: Path | None = None) -> RecordedSensors:
    """Read inertial data, fixes and the mounting from a recording.

    Parameters
    ----------
    platform_file : platform.toml with what a recording does not hold (biases of the unit, initial attitude)

    Raises
    ------
    UserError : not a recording, or no inertial data in it
    """
    reader = RecordingReader(path, by_ranges=True)
    voices, corrections = RecordedVoices(), list[Message]()
    imu: list[Any] = []
    fixes_of: list[Message] = []
    for message in voices.all_used(reader.sorted_messages(["sensor/imu", "sensor/gnss", VERDICT])):
        if message.topic == "sensor/imu":
            imu.append(message.body)
        elif message.topic == "sensor/gnss":
            fixes_of.append(message)
        elif message.body.topic == "sensor/gnss":  # of a clock: others are the voices' own
            corrections.append(message)
    if not imu:
        raise UserError(f"{path}: no sensor/imu in this recording, wanted raw inertial data")
    if not fixes_of:
        raise UserError(f"{path}: no sensor/gnss in this recording, wanted GNSS positions")
    start_ns = imu[0].time_ns // convert.SECOND_NS * convert.SECOND_NS
    time_s = (np.array([b.time_ns for b in imu], dtype=np.int64) - start_ns) * 1e-9
    rate = np.array([(b.rate_x, b.rate_y, b.rate_z) for b in imu])
    force = np.array([(b.force_x, b.force_y, b.force_z) for b in imu])
    notes = [*left_out_lines(reader), *voices.lines()]
    if platform_file is not None:
        platform = read_platform(platform_file, notes)
    else:
        project = reader.last("configuration/project")
        arm = np.zeros(3) if project is None else convert.lever_arm_of(project)
        notes.append(_place_of_unit(arm))
        x, y, z = (float(v) for v in arm)
        wander = (0.0, 0.0, 0.0)
        if project is not None and len(project.wander_sigma_m) == 3:
            east, north, up = project.wander_sigma_m
            wander = (float(north), float(east), float(up))
        platform = Platform(lever_arm_m=(x, y, z), grade=_grade(imu, notes), wander_sigma_ned_m=wander)
        if project is not None and project.wander_time_s > 0.0:
            platform = replace(platform, wander_time_s=project.wander_time_s)
    fixes = _fixes([message.body for message in fixes_of], start_ns)
    if corrections:
        said = ", then ".join(f"{c.body.clock_s:+.3f} s ({c.body.by or 'an operator'})" for c in corrections)
        notes.append(f"sensor/gnss: times of fixes are corrected as was said in flight, from the start on: {said}")
        added_s = added_to_times([message.stamp_ns for message in fixes_of], corrections)
        fixes = replace(fixes, time_s=fixes.time_s + added_s)
    offset_s = start_ns / convert.SECOND_NS
    return RecordedSensors(path_of(path), time_s, rate, force, False, fixes, None, platform, notes, offset_s)


def added_to_times(stamps_ns: ArrayLike, corrections: Sequence[Message]) -> NDArray[np.floating]:
    """What an operator said in flight that is to be added to the times of fixes (n,), s: what holds from a verdict on
    holds from the last one before it, and from the first one on it holds for what was before it, too.

    Parameters
    ----------
    stamps_ns : (n,) of the messages with the fixes
    corrections : verdicts on the clock of ``sensor/gnss`` in order of their stamps; none = 0
    """
    said = np.array([c.body.clock_s for c in corrections] or [0.0])
    stamps = np.array([c.stamp_ns for c in corrections] or [0], dtype=np.int64)
    return said[np.maximum(np.searchsorted(stamps, stamps_ns, side="right") - 1, 0)]


def _place_of_unit(arm: NDArray[np.floating]) -> str:
    """What positions are of: a recording knows where the antenna is from the camera, not from the inertial unit."""
    if not arm.any():
        return "configuration/project: no lever arm; the antenna is taken to sit on the inertial unit (--platform)"
    return (
        "configuration/project: the lever arm goes from the camera to the antenna; the inertial unit is taken to sit "
        "in the perspective centre, and positions are of that (--platform gives the lever arm of the unit)"
    )


def _grade(imu: list[Any], notes: list[str]) -> InertialGrade:
    """Noise from the sigmas of the samples; biases, which they do not have, as usual for units of such noise."""
    root = np.sqrt(np.median([b.interval_ns for b in imu]) * 1e-9)
    noise = []
    for field, limit in convert.LARGEST_SIGMAS.items():
        stated = np.array([getattr(b, field) for b in imu])
        usable = (stated >= 0.0) & (stated < limit)  # false for NaN
        noise.append(float(np.median(stated[usable]) * root) if usable.any() else 0.0)
        if not usable.all():
            text = f"{int((~usable).sum())} samples with a {field} that no unit has: not counted"
            notes.append(f"sensor/imu: {text}")
    gyro, accel = noise
    grade = InertialGrade.of_noise(gyro, accel)
    name = "tactical" if grade.gyro_bias == TACTICAL.gyro_bias else "MEMS"
    notes.append(f"sensor/imu: a recording holds no biases; a {name} unit is assumed (--platform gives others)")
    return grade


def _fixes(gnss: list[Any], start_ns: int) -> GnssData:
    time_s = np.array([convert.time_ns(b.timestamp) - start_ns for b in gnss], dtype=np.int64) * 1e-9
    place = np.array([(b.latitude, b.longitude, b.altitude) for b in gnss])
    sigma = _sigmas([b.position_covariance for b in gnss])
    velocity = sigma_v = None
    if any(len(b.velocity_covariance) == 9 for b in gnss):
        velocity = np.array([(b.velocity_enu.x, b.velocity_enu.y, b.velocity_enu.z) for b in gnss]) @ R_ENU_NED
        sigma_v = _sigmas([b.velocity_covariance for b in gnss])
    lat, lon = np.radians(place[:, 0]), np.radians(place[:, 1])
    return GnssData(time_s, lat, lon, place[:, 2], sigma, velocity, sigma_v)


def _sigmas(covariances: list[Any]) -> NDArray[np.floating]:
    """Standard deviations (m, 3) north, east, down of covariances east, north, up; NaN where there is none."""
    variance = np.array([[c[4], c[0], c[8]] if len(c) == 9 else [np.nan] * 3 for c in covariances], dtype=float)
    return np.sqrt(np.where(variance >= 0.0, variance, np.nan))
