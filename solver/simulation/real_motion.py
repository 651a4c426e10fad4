"""A three-line camera on the motion of a real flight: pose files become the truth of a simulation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import median_filter

from ..adjustment.network import Strip
from ..camera.line_camera import LineCamera, three_line_camera
from ..geometry.frames import LocalFrame, R_lc_from_navigation
from ..geometry.rotation import measured_angles, quaternion_from_angles, quaternion_from_matrix
from ..geometry.trajectory import Trajectory
from .error_models import ErrorModel, ErrorRealisation
from .flight import Flight, line_rate
from .terrain import fractal_terrain

Array = NDArray[np.floating]

#: Errors put on a real motion at high altitude: a good inertial unit (0.005 deg are 1.7 m on the ground), positions
#: without corrections; noise as a smoothed trajectory has it.
HIGH_ALTITUDE_ERRORS = ErrorModel(
    offset_sigma_m=(8.0, 8.0, 12.0),
    wander_sigma_m=(3.0, 3.0, 4.0),
    shift_sigma_deg=(0.005, 0.005, 0.01),
    drift_sigma_deg=(0.003, 0.003, 0.003),
    wander_sigma_deg=(0.001, 0.001, 0.002),
    wander_time_s=60.0,
    gnss_noise_m=(0.02, 0.02, 0.02),
    attitude_noise_deg=(0.0002, 0.0002, 0.0004),
)
#: Flight before the first and after the last line of the strip, seconds.
MARGIN_S = 3.0
#: Samples over which the velocity is compared with its neighbours, and the step (m) that counts as a jump.
_JUMP_WINDOW, JUMP_M = 9, 0.05


@dataclass(frozen=True)
class RealMotion:
    """A recorded motion as a trajectory.

    Attributes
    ----------
    frame : local frame at the middle of the flight
    trajectory : time from 0
    first_time_s : time of its first sample in the recording's own count
    jumps : steps of the recorded positions that were taken out
    """

    frame: LocalFrame
    trajectory: Trajectory
    first_time_s: float
    jumps: int


def high_altitude_camera() -> LineCamera:
    """A three-line camera for 20 km: pixels of 1.6 m; at 200 m/s its base is flown in a minute."""
    return three_line_camera("high-altitude", 80.0, 12000, 0.0065, {"F": 18.0, "N": 0.0, "B": -18.0})


def control_for(duration_s: float) -> int:
    """Control points that a strip of some duration is given: a pair a minute, and one at its end."""
    return 2 * (1 + max(2, int(np.ceil(duration_s / 60.0))))


def real_motion(
    time_s: ArrayLike,
    latitude_deg: ArrayLike,
    longitude_deg: ArrayLike,
    height_m: ArrayLike,
    rpy: ArrayLike,
    ground_height_m: float = 200.0,
    from_s: float = 0.0,
    duration_s: float | None = None,
) -> RealMotion:
    """The motion of a pose file, taken as that of the camera.

    Steps of the recorded position that no aircraft can fly (resets of the navigation solution) are taken out: what
    comes after is shifted back.

    Parameters
    ----------
    time_s : (n,) increasing, any origin
    latitude_deg, longitude_deg, height_m : (n,)
    rpy : (n, 3) roll, pitch, heading, radians
    ground_height_m : mean ellipsoidal height of the ground, origin of the local frame
    from_s, duration_s : which part to take, from its first sample; to its end if no duration is given

    Raises
    ------
    ValueError : arrays that do not match, values not finite, times that do not increase, a part too short for a strip
    """
    time = np.asarray(time_s, dtype=float)
    lat, lon, height = (np.asarray(v, dtype=float) for v in (latitude_deg, longitude_deg, height_m))
    angles = np.asarray(rpy, dtype=float)
    if not (time.shape == lat.shape == lon.shape == height.shape) or angles.shape != (len(time), 3):
        raise ValueError(
            f"pose arrays do not match: {len(time)} times, {lat.shape}, {lon.shape}, {height.shape}, {angles.shape}"
        )
    if not all(np.isfinite(v).all() for v in (time, lat, lon, height, angles)):
        raise ValueError("a pose is not finite")
    if len(time) == 0 or not (np.diff(time) > 0).all():
        raise ValueError("pose times must increase")
    until = np.inf if duration_s is None else from_s + duration_s
    part = (time - time[0] >= from_s) & (time - time[0] <= until)
    if part.sum() < 10 or np.ptp(time[part]) < 4 * MARGIN_S:
        raise ValueError(f"only {int(part.sum())} poses between {from_s:g} s and {until:g} s: too short for a strip")
    time, lat, lon, height, angles = time[part], lat[part], lon[part], height[part], angles[part]
    middle = len(time) // 2
    frame = LocalFrame(round(float(lat[middle]), 4), round(float(lon[middle]), 4), ground_height_m)
    position, jumps = without_jumps(time, frame.from_geodetic(lat, lon, height))
    quaternion = quaternion_from_matrix(R_lc_from_navigation(frame, position, angles))
    return RealMotion(frame, Trajectory(time - time[0], position, quaternion), float(time[0]), jumps)


def without_jumps(time_s: Array, position_l: Array) -> tuple[Array, int]:
    """Positions (n, 3) with steps taken out that do not fit the velocity around them, and how many there were."""
    step = np.diff(position_l, axis=0)
    dt = np.diff(time_s)[:, None]
    usual = median_filter(step / dt, size=(_JUMP_WINDOW, 1), mode="nearest") * dt
    jump = np.linalg.norm(step - usual, axis=1) > JUMP_M
    excess = np.where(jump[:, None], step - usual, 0.0)
    moved = position_l.copy()
    moved[1:] -= np.cumsum(excess, axis=0)
    return moved, int(jump.sum())


def fly_real_motion(
    motion: RealMotion, relief: np.random.Generator, camera: LineCamera | None = None, relief_m: float = 150.0
) -> Flight:
    """One strip over the whole motion; the line rate makes pixels square on mean ground.

    Raises
    ------
    ValueError : a motion that is not above the ground
    """
    camera = camera or high_altitude_camera()
    truth = motion.trajectory
    terrain = fractal_terrain(relief, amplitude_m=relief_m)
    x, y, z = truth.position_l.T
    height = float(np.median(z - terrain.height(x, y)))
    if height < 2 * relief_m or height <= 0:
        raise ValueError(f"the flight is {height:.0f} m above mean ground with a relief of +-{relief_m:g} m")
    speed = float(np.median(np.linalg.norm(np.diff(truth.position_l, axis=0), axis=1) / np.diff(truth.time_s)))
    rate = line_rate(camera, height, speed)
    first = float(np.ceil((truth.start_s + MARGIN_S) * 10.0) / 10.0)
    lines = int((truth.end_s - MARGIN_S - first) * rate) + 1
    strip = Strip("S1", truth, first, rate, lines)
    covered = np.array([[truth.start_s, truth.end_s]])
    return Flight("real motion", motion.frame, camera, terrain, truth, (strip,), covered, recorded=True)


def degrade(
    truth: Trajectory,
    slow: ErrorRealisation,
    errors: ErrorModel,
    position: np.random.Generator,
    attitude: np.random.Generator,
) -> Trajectory:
    """The trajectory with slow errors and noise, at its own sample times."""
    n = len(truth)
    error = slow.at(truth.time_s)
    poses = truth.at(truth.time_s)
    angles = measured_angles(poses.angles, error[:, 3:])
    angles += attitude.standard_normal((n, 3)) * np.radians(errors.attitude_noise_deg)
    place = truth.position_l + error[:, :3] + position.standard_normal((n, 3)) * errors.gnss_noise_m
    return Trajectory(truth.time_s, place, quaternion_from_angles(angles))
