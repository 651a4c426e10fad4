"""SMRMSG: accuracies of the poses of an SBET, records of 10 float64 that usually come once a second."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...solver.geometry.frames import LocalFrame, navigation_covariance_from_opk, navigation_from_R_lc
from ..errors import UserError
from .gps_time import WEEK_S, gps_from_utc_ns, unwrap_weeks

Array = NDArray[np.floating]

#: Fields of a record: seconds as in the SBET; metres; m/s; arc minutes. All but the time are 1-sigma.
FIELDS = (
    *("time", "north", "east", "down", "north_velocity", "east_velocity", "down_velocity"),
    *("roll", "pitch", "heading"),
)
RECORD = 8 * len(FIELDS)
#: No inertial unit knows roll and pitch better, arc minutes (0.0003 deg): those that are smaller are in other units.
LEAST_ARCMIN = 0.02
#: More m or arc minutes than a pose that is worth its name is uncertain by.
MOST_SIGMA = 1e5
_ARCMIN = np.pi / 180 / 60


@dataclass(frozen=True)
class PoseAccuracies:
    """Accuracies of poses; n of them.

    Attributes
    ----------
    sigma_ned_m : (n, 3) of the position along north, east and down, m; NaN where it is not known
    sigma_rpy : (n, 3) of roll, pitch and heading, radians; NaN where it is not known
    notes : remarks of the reader
    """

    sigma_ned_m: Array
    sigma_rpy: Array
    notes: tuple[str, ...]


def is_smrmsg(path: Path) -> bool:
    """Whether a file is called SMRMSG and has whole records."""
    return "smrmsg" in path.name.lower() and path.stat().st_size % RECORD == 0


def beside(sbet: Path) -> Path | None:
    """The SMRMSG in the folder of an SBET under its name, if there is one.

    That of ``sbet_7.out`` is ``smrmsg_7.out`` or ``sbet_7-smrmsg.out``; some programs write one word in capitals.
    """
    words = ("smrmsg", "SMRMSG")
    names = [re.sub("sbet", word, sbet.name, flags=re.IGNORECASE) for word in words]
    names += [f"{sbet.stem}{sign}{word}{sbet.suffix}" for word in words for sign in "-_"]
    return next((path for path in map(sbet.with_name, names) if path != sbet and path.is_file()), None)


def read_smrmsg(path: Path, seconds: Array) -> PoseAccuracies:
    """Accuracies at times of poses, interpolated between the records.

    Parameters
    ----------
    seconds : (n,) of the poses, as in their SBET

    Raises
    ------
    UserError : a file that is not whole records, times that are none or of another flight, no accuracy above 0
    """
    size = path.stat().st_size
    if size == 0 or size % RECORD:
        raise UserError(f"{path}: {size} bytes, wanted a whole number of SMRMSG records of {RECORD} bytes; truncated?")
    values = np.fromfile(path, "<f8").reshape(-1, len(FIELDS))
    time, sigma = values[:, 0], values[:, [1, 2, 3, 7, 8, 9]]
    bad = np.flatnonzero(~((time >= 0) & (time < 2 * WEEK_S)))
    if len(bad):
        raise UserError(f"{path}: record {bad[0] + 1}: time: {time[bad[0]]:.6g}, wanted seconds of the SBET")
    time, poses = unwrap_weeks(time), unwrap_weeks(seconds)
    good = ((sigma > 0) & (sigma < MOST_SIGMA)).all(axis=1) & _rising(time)
    notes: list[str] = []
    if not good.all():
        what = "without accuracies above 0, or not after the one before them,"
        notes.append(f"{path.name}: {int((~good).sum())} records {what} were left out")
    time, sigma = time[good], sigma[good]
    if not len(time):
        raise UserError(f"{path}: no record with accuracies above 0, wanted m and arc minutes")
    step_s = float(np.median(np.diff(time))) if len(time) > 1 else 1.0
    known = (poses >= time[0] - step_s) & (poses <= time[-1] + step_s)
    if not known.any():
        raise UserError(
            f"{path}: accuracies from {time[0]:.1f} to {time[-1]:.1f} s, but poses from {poses[0]:.1f} to "
            f"{poses[-1]:.1f} s: of another flight, wanted those of this SBET"
        )
    if not known.all():
        outside = f"{int((~known).sum())} of {len(known)} poses lie before or behind its accuracies"
        notes.append(f"{path.name}: {outside}, and have those that are stated or usual")
    roll_pitch = float(np.median(sigma[:, 3:5]))
    if roll_pitch < LEAST_ARCMIN:
        notes.append(
            f"{path.name}: roll and pitch known to {roll_pitch:.2g} arc minutes, better than by any inertial unit: "
            "other units? SMRMSG has arc minutes"
        )
    at = np.column_stack([np.interp(poses, time, column) for column in sigma.T])
    at[~known] = np.nan
    return PoseAccuracies(at[:, :3], at[:, 3:] * _ARCMIN, tuple(notes))


def _rising(time: Array) -> NDArray[np.bool_]:
    """Which times come after all those before them, (n,)."""
    return np.concatenate([[True], time[1:] > np.maximum.accumulate(time)[:-1]])


def write_smrmsg(path: Path, seconds: ArrayLike, sigma_ned_m: Array, sigma_rpy: Array) -> None:
    """Write accuracies of poses; those of the velocity, which an orientation has not, are 0.

    Parameters
    ----------
    seconds : (n,) GPS seconds of the week
    sigma_ned_m : (n, 3) of the position along north, east and down, m
    sigma_rpy : (n, 3) of roll, pitch and heading, radians
    """
    values = np.zeros((len(sigma_ned_m), len(FIELDS)), dtype="<f8")
    values[:, 0] = seconds
    values[:, 1:4] = sigma_ned_m
    values[:, 7:10] = sigma_rpy / _ARCMIN
    path.write_bytes(values.tobytes())


def write_smrmsg_poses(
    path: Path,
    time_ns: NDArray[np.int64],
    position_l: Array,
    R_lc: Array,
    covariance: Array,
    frame: LocalFrame,
    R_bc: Array,
) -> int:
    """Write accuracies of poses of an image as those of the body, and return the number of poses that have some.

    Parameters
    ----------
    time_ns : (n,) UTC
    position_l : (n, 3) of the perspective centre, local frame, m
    R_lc : (n, 3, 3) image to local
    covariance : (n, 6, 6) of X, Y, Z, omega, phi, kappa in the local frame, m and rad; NaN where it is not known
    frame : the local frame
    R_bc : image to body

    Raises
    ------
    UserError : no pose with a covariance
    """
    known = np.isfinite(covariance).all(axis=(1, 2))
    if not known.any():
        raise UserError("no pose with a covariance, wanted at least one")
    position, R, C = position_l[known], R_lc[known], covariance[known]
    R_ln = frame.R_ln(position)
    cov_ned = np.swapaxes(R_ln, -1, -2) @ C[:, :3, :3] @ R_ln
    cov_rpy = navigation_covariance_from_opk(navigation_from_R_lc(frame, position, R, R_bc), R, R_ln, C[:, 3:, 3:])
    sigma_ned_m, sigma_rpy = (np.sqrt(np.maximum(np.einsum("nii->ni", some), 0.0)) for some in (cov_ned, cov_rpy))
    write_smrmsg(path, gps_from_utc_ns(time_ns[known])[1], sigma_ned_m, sigma_rpy)
    return int(known.sum())
