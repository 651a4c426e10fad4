"""A sensor folder as the messages of a flight."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ...schemas import messages as m
from ...schemas.groups import grouped
from ...schemas.topics import rank
from ...solver.adjustment.block_data import Apriori
from ...solver.arrays import Array
from ...solver.geometry.rotation import R_ENU_NED
from ...solver.navigation.inertial_cleaning import Finding, clean_gnss, clean_inertial
from ...solver.navigation.inertial_data import InertialData, InertialGrade
from ..convert import SECOND_NS, attitude_message, gnss_message
from ..errors import UserError
from ..node import Message
from .sensor_folder import SensorFolder

#: Places of a flight that are enough to tell where it was.
SOME = 300


def sensor_messages(
    folder: SensorFolder, notes: list[str], source: str = "import", grade: InertialGrade | None = None
) -> Iterator[Message]:
    """``configuration/project``, ``sensor/imu``, ``sensor/gnss`` and ``sensor/attitude`` of a folder that was read,
    sorted by stamp and rank.

    Times in the files count from the Unix epoch. Increments are divided by their interval. Each sample carries
    the noise of the inertial unit as its sigma; messages have no field for its biases, the initial attitude, and where
    it sits: the project has the lever arm from the camera to the antenna, and slow errors of GNSS.
    ``grade`` takes the place of the unit in platform.toml.

    Raises
    ------
    UserError : ``file:line: column: what is wrong``, or nothing usable in the folder
    """
    path = folder.path
    if grade is not None:
        folder = replace(folder, platform=replace(folder.platform, grade=grade))
    notes.extend(note for note in folder.notes if grade is None or not note.startswith("platform.toml"))
    if grade is None and folder.time_s is not None and any(folder.platform.camera_lever_arm_m):
        how = "the navigator gets it as camera_lever_arm_m of [navigator] (--config)"
        notes.append(f"platform.toml: camera_lever_arm_m: a recording has no place for it; {how}")
    unit = folder.platform.grade
    usual = InertialGrade.of_noise(unit.gyro_noise, unit.accel_noise)
    biases = (unit.gyro_bias, unit.accel_bias, unit.gyro_scale, unit.accel_scale)
    if grade is None and not np.allclose(
        biases, (usual.gyro_bias, usual.accel_bias, usual.gyro_scale, usual.accel_scale), rtol=0.5, atol=0.0
    ):
        how = "the navigator gets them as settings of [navigator] (--config), else as usual for the noise"
        notes.append(f"platform.toml: [imu]: a recording has no place for biases and scale factors; {how}")
    messages = [*_imu(folder, notes, source), *_gnss(folder, notes, source), *_attitude(folder, source)]
    if not messages:
        raise UserError(f"{path}: no usable sample in imu.csv, {folder.gnss_file} or attitude.csv")
    messages.sort(key=lambda message: (message.stamp_ns, rank(message.topic)))
    if folder.gnss is None:
        notes.append(f"{path / folder.gnss_file}: no such file: without GNSS the navigator makes no poses")
    platform = folder.platform
    arm = np.asarray(platform.lever_arm_m) - np.asarray(platform.camera_lever_arm_m)
    project = m.Project(
        name=folder.name,
        crs="local",
        lever_arm_m=arm.tolist(),
        boresight_deg=platform.boresight_deg,
        image_sigma_px=Apriori.image_sigma_px,
    )
    if any(platform.wander_sigma_ned_m):
        north, east, down = platform.wander_sigma_ned_m
        project.wander_sigma_m.extend((east, north, down))
        project.wander_time_s = platform.wander_time_s
    if folder.gnss is not None:
        project.origin_latitude = round(float(np.degrees(np.nanmedian(folder.gnss.lat))), 6)
        lon = np.unwrap(folder.gnss.lon[np.isfinite(folder.gnss.lon)])
        project.origin_longitude = round(float((np.degrees(np.median(lon)) + 180.0) % 360.0 - 180.0), 6)
    yield Message("configuration/project", messages[0].stamp_ns, project, source)
    yield from messages


def sensor_extent(folder: SensorFolder) -> tuple[tuple[int, int], Array]:
    """UTC of the first and the last moment at which a sensor folder has GNSS and, where it has any, inertial data or
    attitudes; (n, 2) latitude and longitude of some of its fixes, degrees.

    Raises
    ------
    UserError : no GNSS
    """
    if folder.gnss is None:
        raise UserError(f"{folder.path / folder.gnss_file}: no such file, wanted GNSS positions")
    times = [folder.gnss.time_s]
    times += [folder.time_s] if folder.time_s is not None else []
    times += [folder.attitude.time_s] if folder.attitude is not None and folder.time_s is None else []
    begin, end = _ns(np.array([max(np.nanmin(t) for t in times), min(np.nanmax(t) for t in times)]))
    places = np.degrees(np.column_stack([folder.gnss.lat, folder.gnss.lon]))
    return (begin, end), some(places[np.isfinite(places).all(axis=1)])


def sensor_fixes(folder: SensorFolder) -> Array:
    """Latitude and longitude, degrees, and height (n, 3) of the fixes that `sensor_messages` makes messages of.

    Raises
    ------
    UserError : fixes of which nothing can be made
    """
    if folder.gnss is None:
        return np.empty((0, 3))
    gnss, findings = clean_gnss(folder.gnss)
    _told(folder, findings, [])
    return np.column_stack([np.degrees(gnss.lat), np.degrees(gnss.lon), gnss.height_m])


def some(places: Array) -> Array:
    """Some hundred rows (n, k) of many."""
    return places[:: max(len(places) // SOME, 1)]


def _ns(time_s: NDArray[np.floating]) -> list[int]:
    whole = np.floor(time_s)
    return (whole.astype(np.int64) * SECOND_NS + np.rint((time_s - whole) * 1e9).astype(np.int64)).tolist()


def _told(folder: SensorFolder, findings: list[Finding], notes: list[str]) -> None:
    for finding in findings:
        if finding.fatal:
            raise UserError(f"{folder.path}: {folder.named(finding)}")
        notes.append(folder.named(finding))


def _imu(folder: SensorFolder, notes: list[str], source: str) -> Iterator[Message]:
    if folder.time_s is None or folder.rotation is None or folder.force is None:
        return
    time, rotation, force, findings = clean_inertial(
        folder.time_s, folder.rotation, folder.force, increments=folder.increments
    )
    _told(folder, findings, notes)
    if len(time) < 2:
        raise UserError(f"{folder.path / 'imu.csv'}: {len(time)} usable samples, wanted at least 2")
    make = InertialData.from_increments if folder.increments else InertialData.from_rates
    data = make(time, rotation, force)
    rate, force = data.dtheta / data.dt_s[:, None], data.dv / data.dt_s[:, None]
    grade, root = folder.platform.grade, np.sqrt(data.dt_s)
    for i, stamp in enumerate(_ns(data.time_s)):
        f, w = force[i], rate[i]
        body = grouped(m.Imu)(
            time_ns=stamp, interval_ns=round(float(data.dt_s[i]) * 1e9),
            force_x=f[0], force_y=f[1], force_z=f[2], rate_x=w[0], rate_y=w[1], rate_z=w[2],
            force_sigma=grade.accel_noise / root[i], rate_sigma=grade.gyro_noise / root[i],
        )  # fmt: skip
        yield Message("sensor/imu", stamp, body, source)


def _gnss(folder: SensorFolder, notes: list[str], source: str) -> Iterator[Message]:
    if folder.gnss is None:
        return
    gnss, findings = clean_gnss(folder.gnss)
    _told(folder, findings, notes)
    place = np.column_stack([np.degrees(gnss.lat), np.degrees(gnss.lon), gnss.height_m])
    sigma = np.abs(gnss.sigma_ned_m @ R_ENU_NED.T)
    velocity = None if gnss.velocity_n is None else gnss.velocity_n @ R_ENU_NED.T
    sigma_v = None if gnss.sigma_velocity_n is None else np.abs(gnss.sigma_velocity_n @ R_ENU_NED.T)
    for i, stamp in enumerate(_ns(gnss.time_s)):
        has_velocity = velocity is not None and bool(np.isfinite(velocity[i]).all())
        body = gnss_message(
            stamp,
            place[i],
            sigma[i],
            velocity[i] if velocity is not None and has_velocity else None,
            sigma_v[i] if sigma_v is not None and has_velocity else None,
        )
        yield Message("sensor/gnss", stamp, body, source)


def _attitude(folder: SensorFolder, source: str) -> Iterator[Message]:
    if folder.attitude is None:
        return
    table = folder.attitude
    for i, stamp in enumerate(_ns(table.time_s)):
        yield Message("sensor/attitude", stamp, attitude_message(stamp, table.angles[i], table.sigma[i]), source)
