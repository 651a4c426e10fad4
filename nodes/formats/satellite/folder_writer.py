"""Writes a simulated overpass as a plain folder of a scene: worked examples."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ....solver.geometry.rotation import navigation_from_matrix, quaternion_from_matrix
from ....solver.orbit.time_scales import parse_time, unix_from_tai
from ....solver.simulation.orbital_scene import OrbitalScene
from ..camera_json import write_camera
from ..table import write_table

Array = NDArray[np.floating]

#: Time 0 of an overpass, unless another one is given.
EPOCH = "2006-06-17T01:30:00Z"


def write_overpass(
    folder: Path,
    scene: OrbitalScene,
    *,
    epoch: str = EPOCH,
    orbit_step_s: float = 60.0,
    attitude_step_s: float = 0.1,
    earth_fixed: bool = False,
) -> None:
    """Write an overpass as ephemeris.csv, attitude.csv, line_times.csv, camera.json and scene.toml.

    Parameters
    ----------
    folder : made if it is not there
    scene : from `overpass`
    epoch : UTC of time 0
    orbit_step_s, attitude_step_s : between the rows of the tables
    earth_fixed : attitude as quaternions against the Earth, in place of angles in the orbital frame
    """
    folder.mkdir(parents=True, exist_ok=True)
    camera, motion = scene.sensor.camera, scene.motion
    period, last = scene.sensor.period_s, scene.sensor.lines - 1
    zero = parse_time(epoch)
    first_s, last_s = min(scene.first_line_s.values()), max(scene.first_line_s.values()) + last * period
    # four nodes of the orbit on each side; those of the simulator hold everywhere
    t = _steps(first_s - 4 * orbit_step_s, last_s + 4 * orbit_step_s, orbit_step_s)
    position, velocity = scene.endless_orbit.at(t)
    columns: dict[str, Array] = dict(
        zip(("X_m", "Y_m", "Z_m", "VX_m_s", "VY_m_s", "VZ_m_s"), np.hstack([position, velocity]).T, strict=True)
    )
    _write(folder / "ephemeris.csv", zero, t, columns, ".9f")
    t = _steps(max(first_s - 5.0, motion.start_s), min(last_s + 5.0, motion.end_s), attitude_step_s)
    t = t[(t >= motion.start_s) & (t <= motion.end_s)]
    if earth_fixed:
        q = quaternion_from_matrix(motion.at(t).R_eb)
        turns: dict[str, Array] = dict(zip(("qx", "qy", "qz", "qw"), q.T, strict=True))
    else:
        roll, pitch, yaw = np.degrees(navigation_from_matrix(motion.attitude.at(t))).T
        turns = {"roll_deg": roll, "pitch_deg": pitch, "yaw_deg": (yaw + 180.0) % 360.0 - 180.0}
    _write(folder / "attitude.csv", zero, t, turns, ".15f")
    ids = [line.id for line in camera.lines]
    starts = np.array([scene.first_line_s[id] for id in ids])
    write_table(
        folder / "line_times.csv",
        {
            "ccd": np.repeat(ids, 2),
            "line": np.tile([0.0, float(last)], len(ids)),
            "time_utc": _texts(zero, np.stack([starts, starts + last * period], axis=1).ravel()),
        },
        {"line": ".0f"},
    )
    write_camera(folder / "camera.json", camera)
    sensors = next(iter(scene.sensors.values()))
    rows = [
        "[frames]",
        f'attitude = "{"earth" if earth_fixed else "orbital"}"',
        "[model]",
        f"light_time = {str(sensors.light_time).lower()}",
        f"aberration = {str(sensors.aberration).lower()}",
    ]
    for lens in camera.lenses:
        rows += [f'[lens."{lens.id}"]', f"boresight_deg = [0.0, {scene.sensor.view_deg[lens.id]!r}, 0.0]"]
    (folder / "scene.toml").write_text("\n".join([*rows, ""]), encoding="utf-8")


def _steps(first: float, last: float, step: float) -> Array:
    return np.arange(np.floor(first / step), np.ceil(last / step) + 1) * step


def _texts(zero: int, time_s: Array) -> list[str]:
    stamps = unix_from_tai(zero + np.round(time_s * 1e9).astype(np.int64))
    return [f"{text}Z" for text in stamps.astype("datetime64[ns]").astype(str)]


def _write(path: Path, zero: int, time_s: Array, columns: dict[str, Array], form: str) -> None:
    write_table(path, {"time_utc": _texts(zero, time_s), **columns}, dict.fromkeys(columns, form))
