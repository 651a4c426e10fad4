"""The trajectory of a platform from files of position and attitude, and its messages."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from datetime import date, timedelta
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...schemas import messages as m
from ...solver.adjustment.block_data import Apriori
from ...solver.geometry.earth import ecef_from_geodetic
from ...solver.geometry.frames import LocalFrame, R_lc_from_navigation, opk_covariance_from_navigation
from ...solver.geometry.rotation import (
    R_BC_NOMINAL,
    angles_from_matrix,
    angles_jacobian,
    matrix_from_navigation,
    quaternion_from_matrix,
)
from ...solver.geometry.trajectory import Trajectory
from ...solver.models.dgr import DgrOptions
from ..convert import pose_message
from ..errors import UserError
from ..node import Message
from .course import attitude_remarks
from .gps_time import DAY_S, WEEK_S, gps_week, unwrap_weeks, utc_ns_from_gps, utc_ns_from_utc

Array = NDArray[np.floating]

#: More than aircraft that carry cameras do, m/s^2.
MOST_ACCELERATION = 50.0
#: Components of a lever arm, m, and angles of a boresight, degrees, are not larger than these.
MOST_LEVER_ARM_M, MOST_BORESIGHT_DEG = 50.0, 360.0


@dataclass(frozen=True)
class Mounting:
    """How the camera sits on the body whose poses a file gives.

    Attributes
    ----------
    lever_arm_m : from the body's reference point to the perspective centre, forward-right-down
    boresight_deg : roll, pitch, heading of the camera against the body
    """

    lever_arm_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    boresight_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @property
    def R_bc(self) -> Array:
        return matrix_from_navigation(*np.radians(self.boresight_deg)) @ R_BC_NOMINAL


@dataclass(frozen=True)
class Accuracy:
    """1-sigma accuracies of poses for files that give none, and in place of those in the file where they are stated.

    Attributes
    ----------
    position_m : X, Y, Z (east, north, up)
    attitude_deg : omega, phi, kappa
    position_stated, attitude_stated : given by the user
    """

    position_m: tuple[float, float, float] = DgrOptions.offset_sigma_m
    attitude_deg: tuple[float, float, float] = DgrOptions.shift_sigma_deg
    position_stated: bool = False
    attitude_stated: bool = False

    @property
    def covariance(self) -> Array:
        """(6, 6) of a pose."""
        return np.diag(np.concatenate([self.position_m, np.radians(self.attitude_deg)])) ** 2

    def of_poses(self, covariance: Array) -> Array:
        """Covariances (n, 6, 6) of poses, with those of this for positions and attitudes that are stated or that the
        file does not know (NaN)."""
        out = covariance.copy()
        for part, stated in ((slice(0, 3), self.position_stated), (slice(3, 6), self.attitude_stated)):
            these = stated | ~np.isfinite(out[:, part, part]).all(axis=(1, 2))
            out[these, part, :] = out[these, :, part] = 0.0
            out[these, part, part] = self.covariance[part, part]
        return out


@dataclass(frozen=True)
class NavigationTrack:
    """Poses of the body (forward-right-down) against north-east-down, with time; n of them.

    Attributes
    ----------
    name : of the flight line
    time_ns : (n,) UTC, rising
    geodetic : (n, 3) latitude and longitude in degrees (WGS 84), height in metres
    rpy : (n, 3) roll, pitch, heading against true north, radians
    sigma_ned_m, sigma_rpy : (n, 3), each or None; metres, radians
    covariance_n : (n, 6, 6) or None, in their place: of the position along north, east and down, m, and, independent
        of it, of a small turn about them, radians; NaN where either is not known
    line_rate_hz : image lines a second where each pose belongs to an image line, 0 otherwise
    notes : remarks of the reader
    """

    name: str
    time_ns: NDArray[np.int64] = field(repr=False)
    geodetic: Array = field(repr=False)
    rpy: Array = field(repr=False)
    sigma_ned_m: Array | None = field(default=None, repr=False)
    sigma_rpy: Array | None = field(default=None, repr=False)
    line_rate_hz: float = 0.0
    notes: tuple[str, ...] = ()
    covariance_n: Array | None = field(default=None, repr=False)

    def __len__(self) -> int:
        return len(self.time_ns)

    @property
    def has_position_sigmas(self) -> bool:
        """Whether the file says how good its positions are."""
        if self.covariance_n is not None:
            return bool(np.isfinite(self.covariance_n[:, 0, 0]).any())
        return self.sigma_ned_m is not None

    @property
    def has_attitude_sigmas(self) -> bool:
        """Whether the file says how good its attitudes are."""
        if self.covariance_n is not None:
            return bool(np.isfinite(self.covariance_n[:, 3, 3]).any())
        return self.sigma_rpy is not None


def checked(track: NavigationTrack, path: Path, rows: NDArray[np.intp] | None = None) -> NavigationTrack:
    """The track without poses of a receiver without a fix, and those that do not come after the one before them.

    Parameters
    ----------
    rows : (n,) number of each pose's record in the file, from 0; None where the track has all of them

    Raises
    ------
    UserError : values that no pose can have (by the number of the record), or fewer than two poses
    """
    number = np.arange(len(track)) + 1 if rows is None else rows + 1
    placed = (track.geodetic[:, 0] != 0.0) | (track.geodetic[:, 1] != 0.0)
    if placed.any() and not placed.all():
        note = f"{int((~placed).sum())} poses at latitude 0, longitude 0 (no fix) were left out"
        track, number = _part(track, placed, f"{path.name}: {note}"), number[placed]
    lat, lon, height = track.geodetic.T
    for name, values, low, high, unit in (
        ("latitude", lat, -90, 90, "deg"),
        ("longitude", lon, -180, 360, "deg"),
        ("height", height, -1000, 2e6, "m"),
        ("roll", np.degrees(track.rpy[:, 0]), -180, 180, "deg"),
        ("pitch", np.degrees(track.rpy[:, 1]), -90, 90, "deg"),
        ("heading", np.degrees(track.rpy[:, 2]), -360, 720, "deg"),
    ):
        bad = np.flatnonzero(~((values >= low) & (values <= high)))
        if len(bad):
            more = f" (and {len(bad) - 1} more like it)" if len(bad) > 1 else ""
            what = f"{values[bad[0]]:.6g}, wanted {low:g} to {high:g} {unit}"
            raise UserError(f"{path}: record {number[bad[0]]}: {name}: {what}{more}")
    old = np.flatnonzero(track.time_ns < 0)
    if len(old):
        when = np.datetime64(int(track.time_ns[old[0]]), "ns").astype("datetime64[s]")
        raise UserError(f"{path}: record {number[old[0]]}: time: {when} is before 1970, wanted UTC since then")
    newest = np.maximum.accumulate(track.time_ns)
    rising = np.concatenate([[True], track.time_ns[1:] > newest[:-1]])
    if rising.sum() < 2:
        raise UserError(f"{path}: {int(rising.sum())} poses with rising time, wanted at least 2")
    if not rising.all():
        note = f"{path.name}: {int((~rising).sum())} poses do not come after the one before them and were left out"
        track, number = _part(track, rising, note), number[rising]
    remarks = attitude_remarks((track.time_ns - track.time_ns[0]) * 1e-9, track.geodetic, track.rpy)
    notes = (*track.notes, *(f"{path.name}: {remark}" for remark in remarks))
    return _with_jumps(replace(track, notes=notes), path, number)


def _part(track: NavigationTrack, which: NDArray[np.bool_], note: str) -> NavigationTrack:
    """Some of the poses, with a note."""
    parts: dict[str, Any] = {
        name: None if getattr(track, name) is None else getattr(track, name)[which]
        for name in ("time_ns", "geodetic", "rpy", "sigma_ned_m", "sigma_rpy", "covariance_n")
    }
    return replace(track, **parts, notes=(*track.notes, note))


def _with_jumps(track: NavigationTrack, path: Path, number: NDArray[np.intp]) -> NavigationTrack:
    """The track with a note about steps of the position that no aircraft can fly, given the velocity before them.

    ``number`` (n,) is that of each pose's record in the file, from 1.
    """
    lat, lon, height = track.geodetic.T
    position = ecef_from_geodetic(np.radians(lat), np.radians(lon), height)
    step_s = np.diff(track.time_ns) * 1e-9
    velocity = np.diff(position, axis=0) / step_s[:, None]
    off = np.linalg.norm(np.diff(velocity, axis=0), axis=1) * step_s[1:]
    # behind a gap, as between strips, there was more time to become another velocity than a step
    apart_s = np.maximum(step_s[1:], 0.5 * (step_s[1:] + step_s[:-1]))
    bad = np.flatnonzero(off > np.maximum(MOST_ACCELERATION * step_s[1:] * apart_s, 0.5))
    if not len(bad):
        return track
    first = bad[np.concatenate([[True], np.diff(bad) > 3])]
    record = number[first[0] + 2]
    note = f"position jumps at {len(first)} places, by {off[bad].max():.1f} m at most, first at record {record}"
    return replace(track, notes=(*track.notes, f"{path.name}: {note}"))


def times_from_gps(
    path: Path, seconds: Array, day: date | None, notes: list[str], *, of_day: bool = False, utc: bool = False
) -> NDArray[np.int64]:
    """UTC nanoseconds of GPS seconds of the week (or of the day), given the day of the flight.

    Without a day the times count from the start of GPS time, and a note says so. With ``utc`` the seconds are of UTC.

    Raises
    ------
    UserError : seconds that no week has, or that say another day of the week than the day given
    """
    bad = np.flatnonzero(~((seconds >= 0) & (seconds < 2 * WEEK_S)))
    if len(bad):
        what = f"{seconds[bad[0]]:.6g}, wanted GPS seconds of the week, 0 to {WEEK_S}"
        raise UserError(f"{path}: record {bad[0] + 1}: time: {what}")
    ns_of = utc_ns_from_utc if utc else utc_ns_from_gps
    seconds = unwrap_weeks(seconds, DAY_S if of_day else WEEK_S)
    if day is None:
        notes.append(f"{path.name}: the day of the flight is not known (--date); times count from 1980-01-06")
        return ns_of(0, seconds)
    week, weekday = gps_week(day)
    seconds = seconds - seconds[0] // WEEK_S * WEEK_S  # of a flight over the end of a week that was cut behind it
    if of_day:
        return ns_of(week, seconds + weekday * DAY_S)
    said = int(seconds[0] // DAY_S) % 7
    apart = (said - weekday + 3) % 7 - 3  # UTC and GPS days, and flights over midnight, may differ by one
    if abs(apart) > 1:
        names = ("Sunday", "Monday", "Tuesday", "Wednesday", "Thursday", "Friday", "Saturday")
        raise UserError(f"{path}: GPS seconds of the week say {names[said]}, but {day} is a {names[weekday]}")
    if apart and abs(said - weekday) > 1:  # the week begins or ends between the two
        week += 1 if said < weekday else -1
    if apart:
        other = day + timedelta(days=apart)
        what = f"of {other}, the day {'after' if apart > 0 else 'before'} --date"
        notes.append(f"{path.name}: times are taken as seconds of the week, {what}")
    return ns_of(week, seconds)


def frame_of(track: NavigationTrack) -> LocalFrame:
    """Local frame in the middle of a track, on the ellipsoid."""
    lat, lon, _ = track.geodetic.T
    lon = np.degrees(np.unwrap(np.radians(lon)))
    middle = (lon.min() + lon.max()) / 2
    return LocalFrame(round(float(lat.min() + lat.max()) / 2, 6), round(float((middle + 180) % 360 - 180), 6), 0.0)


def camera_poses(
    track: NavigationTrack, frame: LocalFrame, mounting: Mounting = Mounting()
) -> tuple[Array, Array, Array]:
    """Perspective centres (n, 3), rotations image to local (n, 3, 3), covariances (n, 6, 6), NaN where not known."""
    body_l = frame.from_geodetic(*track.geodetic.T)
    R_ln = frame.R_ln(body_l)
    R_nb = matrix_from_navigation(*track.rpy.T)
    position = body_l + np.einsum("nij,njk,k->ni", R_ln, R_nb, np.asarray(mounting.lever_arm_m))
    R_lc = R_lc_from_navigation(frame, body_l, track.rpy, mounting.R_bc)
    covariance = np.zeros((len(track), 6, 6))
    if track.covariance_n is not None:
        angles_of_turn = angles_jacobian(angles_from_matrix(R_lc)) @ R_ln
        for part, T in ((slice(0, 3), R_ln), (slice(3, 6), angles_of_turn)):
            covariance[:, part, part] = T @ track.covariance_n[:, part, part] @ np.swapaxes(T, 1, 2)
        return position, R_lc, covariance
    covariance[:, :3, :3] = covariance[:, 3:, 3:] = np.nan
    if track.sigma_ned_m is not None:
        covariance[:, :3, :3] = R_ln @ (np.square(track.sigma_ned_m)[:, :, None] * np.swapaxes(R_ln, -1, -2))
    if track.sigma_rpy is not None:
        cov_rpy = np.square(track.sigma_rpy)[:, :, None] * np.eye(3)
        covariance[:, 3:, 3:] = opk_covariance_from_navigation(track.rpy, R_lc, R_ln, cov_rpy)
    return position, R_lc, covariance


def track_messages(
    track: NavigationTrack,
    source: str,
    mounting: Mounting = Mounting(),
    frame: LocalFrame | None = None,
    accuracy: Accuracy = Accuracy(),
) -> Iterator[Message]:
    """The track as ``configuration/project``, ``configuration/strip`` (of line-by-line poses), ``trajectory/smoothed``.

    A pose is stamped with the time it is valid for. Errors of such trajectories change slowly, so the project states
    the accuracy of the poses, too: as a-priori sigma of offset and shift, and of the drift.
    """
    frame = frame_of(track) if frame is None else frame
    start = int(track.time_ns[0])
    position, R_lc, covariance = camera_poses(track, frame, mounting)
    covariance = accuracy.of_poses(covariance)
    sigma = np.sqrt(np.median(np.einsum("nii->ni", covariance), axis=0))
    attitude_deg = np.degrees(sigma[3:]).tolist()
    project = m.Project(
        name=track.name,
        crs=frame.crs,
        origin_latitude=frame.lat_deg,
        origin_longitude=frame.lon_deg,
        origin_height=frame.height_m,
        boresight_deg=mounting.boresight_deg,
        image_sigma_px=Apriori.image_sigma_px,
        offset_sigma_m=sigma[:3].tolist(),
        shift_sigma_deg=attitude_deg,
        drift_sigma_deg=attitude_deg,
    )
    yield Message("configuration/project", start, project, source)
    strip = track.name if track.line_rate_hz > 0 else ""
    if strip:
        yield Message("configuration/strip", start, _strip(track, ended=False), source)
    quaternion = quaternion_from_matrix(R_lc)
    angles = angles_from_matrix(R_lc)
    time_s = (track.time_ns - start) * 1e-9
    velocity = Trajectory(time_s, position, quaternion).at(time_s).velocity_l
    for i, time in enumerate(track.time_ns.tolist()):
        body = pose_message(
            time,
            position[i],
            angles[i],
            covariance[i],
            quaternion=quaternion[i],
            strip=strip,
            velocity_l=velocity[i],
        )
        yield Message("trajectory/smoothed", time, body, source)
    if strip:
        yield Message("configuration/strip", int(track.time_ns[-1]) + 1, _strip(track, ended=True), source)


def _strip(track: NavigationTrack, *, ended: bool) -> Any:
    return m.Strip(
        id=track.name,
        first_line_time_ns=int(track.time_ns[0]),
        line_rate_hz=track.line_rate_hz,
        lines=len(track),
        ended=ended,
    )
