"""Between messages and the solver's arrays: field numbers and quaternion orders are dealt with only here."""

from __future__ import annotations

import math
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..schemas import messages as m
from ..schemas.groups import grouped
from ..solver.camera.line_camera import CcdLine, Lens, LineCamera, quarter_turn
from ..solver.camera.self_calibration import SELF_CALIBRATIONS, calibrated
from ..solver.geometry.frames import LocalFrame
from ..solver.geometry.rotation import (
    R_BC_NOMINAL,
    angles_from_matrix,
    matrix_from_angles,
    matrix_from_navigation,
    matrix_from_quaternion,
    quaternion_from_matrix,
)
from ..solver.models.slow_errors import SlowErrors

Array = NDArray[np.floating]

SECOND_NS = 1_000_000_000
#: A strip has ended when no image line of it has come for so long, s: for the matcher, for sensors, and in bags.
STRIP_SILENT_S = 5.0
LOCAL_FRAME_ID = "local"
#: Times of which ns do not fit into 64 bits, s: of the year 2261. No clock is off by more than a century, s.
LATEST_S, CENTURY_S = 9.2e9, 3.2e9
#: Lines a second that a line camera can have; memory for lines is taken by it.
LINE_RATES_HZ = (0.01, 100_000.0)
#: A stated noise of a single sample beyond these is no noise of an inertial sensor: rad/s, m/s^2.
LARGEST_SIGMAS = {"rate_sigma": 1.0, "force_sigma": 50.0}
#: Longest strip, s, and how far its first line may lie before or after the message that tells it: what goes beyond is
#: no flight, and unknowns for all of it would take the memory and the time of the others.
LONGEST_STRIP_S = 86_400.0

#: Between samples that are further apart nothing is interpolated: s, and times the usual step (both have to be passed).
LARGEST_STEP_S, LARGEST_STEPS = 0.5, 5.0


@dataclass(slots=True)  # not frozen, as messages are not
class PoseSample:
    """A pose message as arrays: image frame in the local frame. Nobody changes one.

    Attributes
    ----------
    time_ns : time of validity
    position_l : (3,) m
    quaternion : (4,) ``R_lc`` xyzw
    covariance : (6, 6) X, Y, Z, omega, phi, kappa; m, rad; None if the message has none
    valid, strip : as in the message
    correction : (6,) m, rad; None if the message has none
    noise_time_s : correlation time of the noise of the position, 0 if it is white
    """

    time_ns: int
    position_l: Array
    quaternion: Array
    covariance: Array | None
    valid: bool
    strip: str = ""
    correction: Array | None = None
    noise_time_s: float = 0.0


class PlainPose(NamedTuple):
    """A pose message as plain numbers; of many, arrays are made at once.

    Attributes
    ----------
    time_ns, valid, noise_time_s : as in `PoseSample`
    position_l, quaternion : 3 and 4 numbers
    covariance : 36 numbers, row by row; None if the message has none
    """

    time_ns: int
    position_l: list[float]
    quaternion: list[float]
    covariance: list[float] | None
    valid: bool
    noise_time_s: float = 0.0


def time_ns(timestamp: Any) -> int:
    """Nanoseconds since the Unix epoch of a protobuf Timestamp."""
    return timestamp.seconds * SECOND_NS + timestamp.nanos


def log_line(node: str, text: str, time_ns: int, warning: bool = False) -> Any:
    """A line for the operator, for ``event/log``, of a node and a time."""
    body = m.Log(name=node, message=text, level=m.Log.Level.Value("WARNING" if warning else "INFO"))
    set_time(body.timestamp, time_ns)
    return body


def set_time(timestamp: Any, time_ns: int) -> None:
    """Set a protobuf Timestamp field in place."""
    timestamp.seconds, timestamp.nanos = divmod(int(time_ns), SECOND_NS)


def pose_message(
    time_ns: int,
    position_l: ArrayLike,
    angles: ArrayLike,
    covariance: ArrayLike | None = None,
    *,
    quaternion: ArrayLike | None = None,
    valid: bool = True,
    reason: str = "",
    strip: str = "",
    correction: ArrayLike | None = None,
    velocity_l: ArrayLike | None = None,
    protection: ArrayLike | None = None,
    noise_time_s: float = 0.0,
) -> Any:
    """A PoseInFrame of the image frame in the local frame; angles are omega, phi, kappa in radians.

    ``quaternion`` (xyzw) spares the conversion where the caller has computed many at once. Lists are flat, and hold
    Python's numbers.
    """
    if quaternion is None:
        quaternion = quaternion_from_matrix(matrix_from_angles(*np.asarray(angles, dtype=float)))
    message = grouped(m.PoseInFrame)(
        frame_id=LOCAL_FRAME_ID, valid=valid, reason=reason, strip=strip, noise_time_s=noise_time_s
    )
    set_time(message.timestamp, time_ns)
    p, q = message.pose.position, message.pose.orientation
    p.x, p.y, p.z = _plain(position_l)
    q.x, q.y, q.z, q.w = _plain(quaternion)
    message.angles.extend(_plain(angles))
    if covariance is not None:
        message.covariance.extend(_plain(covariance))
    if correction is not None:
        message.correction.extend(_plain(correction))
    if protection is not None:
        message.protection.extend(_plain(protection))
    if velocity_l is not None:
        v = message.velocity
        v.x, v.y, v.z = _plain(velocity_l)
    return message


def _plain(values: ArrayLike) -> list[float]:
    """Numbers of an array, one after the other; a list of them is taken as it is, which spares half of the time."""
    if isinstance(values, list):
        return values  # pyrefly: ignore[bad-return]  # flat, of floats
    return np.asarray(values, dtype=float).ravel().tolist()


def check_strip(body: Any, stamp_ns: int) -> None:
    """Whether a strip can be used.

    Raises
    ------
    ValueError : no name, a line rate that no camera has, more than a day long, or more than a day from ``stamp_ns``
    """
    slow, fast = LINE_RATES_HZ
    if not body.id or not slow <= body.line_rate_hz <= fast:
        raise ValueError(f"strip {body.id!r} with {body.line_rate_hz:g} lines a second, wanted {slow:g} to {fast:g}")
    if not 0 <= body.lines <= LONGEST_STRIP_S * body.line_rate_hz:
        raise ValueError(f"strip {body.id!r} of {body.lines} lines, {body.line_rate_hz:g} a second: more than a day")
    away_s = (body.first_line_time_ns - stamp_ns) / SECOND_NS
    if abs(away_s) > LONGEST_STRIP_S:
        raise ValueError(f"strip {body.id!r} that begins {away_s:.0f} s after its message")


def check_place(latitude: float, longitude: float, height: float) -> None:
    """Whether a position can be one, degrees and m; raises ValueError with its values."""
    if not (abs(latitude) <= 90.0 and abs(longitude) <= 360.0 and math.isfinite(height)):
        raise ValueError(f"position {[latitude, longitude, height]} is no latitude, longitude, height")
    if latitude == longitude == 0.0:  # what receivers write before their first fix
        raise ValueError(f"position {[latitude, longitude, height]} is that of a receiver without a fix")


def check_angles(roll: float, pitch: float, heading: float) -> None:
    """Whether an attitude can be one of an aircraft, rad; raises ValueError with its values."""
    if not math.isfinite(roll + pitch + heading):
        raise ValueError("roll, pitch or heading is not finite")
    if max(abs(roll), abs(pitch)) > 2.0 or abs(heading) > 7.0:
        raise ValueError(f"roll, pitch, heading {(roll, pitch, heading)} are not radians of an aircraft")


def check_inertial(interval_ns: int, force: tuple[float, ...], rate: tuple[float, ...]) -> None:
    """Whether an inertial sample can be one of an aircraft, ns, m/s^2 and rad/s; raises ValueError with what cannot."""
    if not math.isfinite(sum(force) + sum(rate)):
        raise ValueError("specific force or angular rate is not finite")
    if max(force) > 500.0 or min(force) < -500.0 or max(rate) > 50.0 or min(rate) < -50.0:
        raise ValueError(f"force {force} m/s^2, rate {rate} rad/s are no motion of an aircraft")
    if not 0 < interval_ns <= SECOND_NS:
        raise ValueError(f"interval {interval_ns} ns, wanted more than 0 and at most a second")


def largest_step_ns(time_ns: NDArray[np.int64]) -> float:
    """From where on a step between samples is a gap."""
    usual = float(np.median(np.diff(time_ns))) if len(time_ns) > 1 else 0.0
    return max(LARGEST_STEP_S * SECOND_NS, LARGEST_STEPS * usual)


def plain_pose(message: Any) -> PlainPose:
    """The numbers of a PoseInFrame, checked.

    Raises
    ------
    ValueError : a value that is not finite, a quaternion that is not a rotation, a covariance of the wrong size
    """
    p, q = message.pose.position, message.pose.orientation
    px, py, pz, x, y, z, w = p.x, p.y, p.z, q.x, q.y, q.z, q.w
    if not math.isfinite(px + py + pz + x + y + z + w):
        raise ValueError("pose is not finite")
    norm = math.sqrt(x * x + y * y + z * z + w * w)
    if abs(norm - 1.0) > 1e-3:
        raise ValueError(f"quaternion of length {norm:.3g}, wanted 1")
    noise_time_s = message.noise_time_s
    if not 0.0 <= noise_time_s < math.inf:
        raise ValueError(f"noise_time_s of {noise_time_s:g} s, wanted 0 or more")
    covariance = _square(message.covariance, 6, "covariance")
    quaternion = [x / norm, y / norm, z / norm, w / norm]
    return PlainPose(time_ns(message.timestamp), [px, py, pz], quaternion, covariance, message.valid, noise_time_s)


def pose_sample(message: Any) -> PoseSample:
    """The arrays of a PoseInFrame.

    Raises
    ------
    ValueError : as `plain_pose`
    """
    stamp_ns, position, quaternion, covariance, valid, noise_time_s = plain_pose(message)
    return PoseSample(
        stamp_ns,
        np.array(position),
        np.array(quaternion),
        None if covariance is None else np.array(covariance).reshape(6, 6),
        valid,
        message.strip,
        np.array(message.correction) if message.correction else None,
        noise_time_s,
    )


def angles_of(quaternion: ArrayLike) -> Array:
    """omega, phi, kappa (..., 3) in radians of ``R_lc`` quaternions (..., 4)."""
    return angles_from_matrix(matrix_from_quaternion(quaternion))


def _square(values: Any, n: int, name: str) -> list[float] | None:
    """The numbers of a flattened (n, n) matrix of a message, None if absent."""
    if len(values) == 0:
        return None
    if len(values) != n * n:
        raise ValueError(f"{name} has {len(values)} values, wanted {n * n}")
    numbers = values[:]  # `list` takes twice as long
    # a sum of large numbers may be infinite where none of them is
    if not (math.isfinite(sum(numbers)) or all(map(math.isfinite, numbers))) or min(numbers[:: n + 1]) < 0:
        raise ValueError(f"{name} is not finite or has a negative variance")
    return numbers


def camera_message(camera: LineCamera) -> Any:
    """A Camera message with the look-up tables of all lines."""
    return m.Camera(
        name=camera.name,
        lenses=[
            m.Lens(
                id=lens.id,
                focal_length_mm=lens.focal_length_mm,
                principal_point_x_mm=lens.principal_point_mm[0],
                principal_point_y_mm=lens.principal_point_mm[1],
            )
            for lens in camera.lenses
        ],
        lines=[
            m.CcdLine(
                id=line.id,
                lens=line.lens,
                x_mm=line.xy_mm[:, 0].tolist(),
                y_mm=line.xy_mm[:, 1].tolist(),
                chip_first_sample=line.chips,
            )
            for line in camera.lines
        ],
    )


def camera_from(message: Any) -> LineCamera:
    """The camera of a Camera message; raises ValueError for one that cannot be used."""
    for lens in message.lenses:
        if not lens.focal_length_mm > 0:
            raise ValueError(f"lens {lens.id!r} has focal length {lens.focal_length_mm}, wanted more than 0 mm")
    lines = []
    for line in message.lines:
        xy = np.array([line.x_mm, line.y_mm]).T if len(line.x_mm) == len(line.y_mm) else np.empty((0, 2))
        if len(xy) < 2 or not np.isfinite(xy).all():
            raise ValueError(f"CCD line {line.id!r} has no usable table of pixel centres")
        lines.append(CcdLine(line.id, line.lens, xy, tuple(line.chip_first_sample)))
    lenses = tuple(
        Lens(lens.id, lens.focal_length_mm, (lens.principal_point_x_mm, lens.principal_point_y_mm))
        for lens in message.lenses
    )
    return LineCamera(message.name, lenses, tuple(lines))


def estimated_camera(camera: LineCamera, told: Iterable[Any]) -> tuple[LineCamera, int]:
    """The camera with the additional parameters of a report, and how many there are (0: the camera itself)."""
    sets = []
    for make in SELF_CALIBRATIONS.values():
        with suppress(ValueError):
            sets.append(make(camera))
    # what is not of the camera, as parameters of a strip, is in none of the sets
    of_camera = {name for parameters in sets for name in parameters.names}
    values = {p.name: p.value for p in told if p.value and p.name in of_camera}
    for parameters in sets if values else ():
        if values.keys() <= set(parameters.names):
            return calibrated(camera, parameters, values), len(values)
    return camera, 0


def local_frame(project: Any) -> LocalFrame:
    """The local frame of a Project message."""
    return LocalFrame(project.origin_latitude, project.origin_longitude, project.origin_height, project.crs or "local")


def same_frame(one: Any, other: Any) -> bool:
    """Whether the local frames of two Project messages are the same, so that coordinates in both can be compared."""
    names = ("origin_latitude", "origin_longitude", "origin_height")
    return all(getattr(one, name) == getattr(other, name) for name in names) and (
        (one.crs or "local") == (other.crs or "local")
    )


def R_bc_of(project: Any) -> Array:
    """Image to body, with the boresight of a Project message."""
    if not project.boresight_deg:
        return R_BC_NOMINAL
    roll, pitch, heading = np.radians(project.boresight_deg)
    return matrix_from_navigation(roll, pitch, heading) @ R_BC_NOMINAL


def mounting_of(project: Any) -> tuple[int, Array]:
    """How the camera is mounted: turned by so many quarters (0 to 3) from forward to the left, and what is left.

    Returns
    -------
    turns
    R_fi : (3, 3) the platform's axes forward-left-up from image axes that are turned by these quarters
    """
    R_fc = R_BC_NOMINAL.T @ R_bc_of(project)
    turns = round(float(np.arctan2(R_fc[1, 0] - R_fc[0, 1], R_fc[0, 0] + R_fc[1, 1])) / (0.5 * np.pi)) % 4
    return turns, R_fc @ quarter_turn(-turns)


def lever_arm_of(project: Any) -> Array:
    """Perspective centre to antenna, body frame, m."""
    return np.array(project.lever_arm_m) if project.lever_arm_m else np.zeros(3)


def slow_errors_of(project: Any) -> SlowErrors:
    """A-priori slow errors of a Project message; what is absent is zero.

    Raises
    ------
    ValueError : naming the value that cannot be
    """

    def three(values: Any, factor: float = 1.0) -> tuple[float, float, float]:
        if not values:
            return (0.0, 0.0, 0.0)
        a, b, c = (float(v) * factor for v in values)
        return (a, b, c)

    to_rad = float(np.radians(1.0))
    return SlowErrors(
        three(project.offset_sigma_m),
        three(project.shift_sigma_deg, to_rad),
        three(project.drift_sigma_deg, to_rad),
        three(project.wander_sigma_m),
        three(project.wander_sigma_deg, to_rad),
        project.wander_time_s or SlowErrors.wander_time_s,
        project.attitude_wander_time_s,
    )


def gnss_message(
    time_ns: int, geodetic_deg_m: ArrayLike, sigma_enu_m: ArrayLike, velocity_enu: ArrayLike | None = None,
    velocity_sigma_enu: ArrayLike | None = None,
) -> Any:  # fmt: skip
    """A LocationFix of latitude, longitude (degrees) and ellipsoidal height, sigmas east-north-up."""
    message = grouped(m.LocationFix)(frame_id="gnss_antenna", position_covariance_type=2)
    set_time(message.timestamp, time_ns)
    message.latitude, message.longitude, message.altitude = (float(v) for v in np.asarray(geodetic_deg_m))
    message.position_covariance.extend(_diagonal(sigma_enu_m))
    if velocity_enu is not None:
        v = message.velocity_enu
        v.x, v.y, v.z = (float(c) for c in np.asarray(velocity_enu))
        if velocity_sigma_enu is not None:
            message.velocity_covariance.extend(_diagonal(velocity_sigma_enu))
    return message


def state_noise(body: Any, noise: tuple[float, float] | None) -> None:
    """Give an inertial sample that states no sigma those of its unit, by its white noise: rad/sqrt(s), m/s/sqrt(s)."""
    if noise is None or body.rate_sigma or body.force_sigma or body.interval_ns <= 0:
        return
    root_s = (body.interval_ns * 1e-9) ** 0.5
    body.rate_sigma, body.force_sigma = noise[0] / root_s, noise[1] / root_s


def attitude_message(time_ns: int, rpy: ArrayLike, sigma: ArrayLike) -> Any:
    """An Attitude message; roll, pitch, heading and their sigmas in radians."""
    roll, pitch, heading = np.asarray(rpy, dtype=float).tolist()
    return grouped(m.Attitude)(
        time_ns=int(time_ns), roll=roll, pitch=pitch, heading=heading, covariance=_diagonal(sigma)
    )


def _diagonal(sigma: ArrayLike) -> list[float]:
    """The nine values of a covariance from three sigmas; a list, because arrays of three cost ten times as much."""
    x, y, z = np.asarray(sigma, dtype=float).tolist()
    return [x * x, 0.0, 0.0, 0.0, y * y, 0.0, 0.0, 0.0, z * z]


def ground_point_message(
    point: str, position_l: ArrayLike, covariance: ArrayLike, role: str, target_radius_m: float = 0.0
) -> Any:
    """A GroundPoint; ``role`` is control, planimetric, height or check; a radius of 0 = not signalised."""
    x, y, z = (float(v) for v in np.asarray(position_l))
    cov = np.asarray(covariance, dtype=float).ravel().tolist()
    return grouped(m.GroundPoint)(
        point=point, x=x, y=y, z=z, covariance=cov, role=m.GroundPoint.Role.Value(role.upper()),
        target_radius=target_radius_m,
    )  # fmt: skip


def enum_name(enum: Any, value: int) -> str:
    """Name of a value of a protobuf enumeration in lower case; the number where it has none."""
    return enum.Name(value).lower() if value in enum.values() else str(value)


def role_of(ground_point: Any) -> str:
    """control, planimetric, height or check."""
    return m.GroundPoint.Role.Name(ground_point.role).lower()


def given_of(ground_point: Any) -> Array:
    """(3,) coordinates of a GroundPoint; NaN where its role says that they are not given, and so are approximate."""
    role = role_of(ground_point)
    xyz = np.array([ground_point.x, ground_point.y, ground_point.z])
    return np.where([role != "height", role != "height", role != "planimetric"], xyz, np.nan)


def tie_message(point: str, images: Iterable[dict[str, Any]]) -> Any:
    """A TiePoint; each image is a dict of ImagePoint's fields."""
    message = grouped(m.TiePoint)(point=point)
    for image in images:
        message.images.add(**image)
    return message


def iso(stamp_ns: int) -> str:
    """A stamp as ISO time, UTC, to the microsecond."""
    seconds, rest = divmod(stamp_ns, SECOND_NS)
    return datetime.fromtimestamp(seconds, UTC).strftime("%Y-%m-%dT%H:%M:%S") + f".{rest // 1000:06d}Z"
