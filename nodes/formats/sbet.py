"""SBET: smoothed best estimate of trajectory, records of 17 float64."""

from __future__ import annotations

import re
from datetime import date
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...solver.geometry.frames import LocalFrame, navigation_from_R_lc
from ..errors import UserError
from .gps_time import DAY_S, gps_from_utc_ns
from .smrmsg import beside, read_smrmsg
from .track import NavigationTrack, checked, times_from_gps

#: Fields of a record: seconds; radians; metres; m/s and m/s^2 in the wander frame; rad/s in the body.
FIELDS = (
    *("time", "lat", "lon", "alt", "x_velocity", "y_velocity", "z_velocity"),
    *("roll", "pitch", "platform_heading", "wander_angle"),
    *("x_acceleration", "y_acceleration", "z_acceleration", "x_rate", "y_rate", "z_rate"),
)
RECORD = 8 * len(FIELDS)
#: Datums off WGS 84 that programs put into the name of an SBET, which has no place for one.
_DATUMS = "NAD27|NAD83|ETRS89|GDA94|GDA2020|JGD2011|CSRS|ED50|SIRGAS"


def is_sbet(path: Path) -> bool:
    """Whether a file looks like SBET: whole records, the first with a time of the week and a place on Earth."""
    size = path.stat().st_size
    if size < RECORD or size % RECORD:
        return "sbet" in path.name.lower()
    first = np.fromfile(path, "<f8", count=len(FIELDS))
    time, lat, lon = first[:3]
    return bool(0 <= time < 2 * 604800 and abs(lat) <= np.pi / 2 and abs(lon) <= 2 * np.pi and np.isfinite(first).all())


def read_sbet(
    path: Path, day: date | None = None, *, seconds_of_day: bool | None = None, accuracies: Path | None = None
) -> NavigationTrack:
    """Poses of an SBET file. True heading is the platform heading less the wander angle.

    Times are GPS seconds, or of UTC where the name of the file has ``UTC`` or ``UTCtime`` as a word that does not stand
    behind a number, of the week or of the day: ``seconds_of_day`` says which; None takes them as seconds of the day
    where all are below one day and ``day`` is not a Sunday or Monday. ``accuracies`` is the SMRMSG file with the
    accuracies of the poses; None takes the one beside the file under its name, if there is one.

    Raises
    ------
    UserError : a file that is not whole records, values that no pose can have, or accuracies of other poses
    """
    size = path.stat().st_size
    if size == 0 or size % RECORD:
        raise UserError(f"{path}: {size} bytes, wanted a whole number of SBET records of {RECORD} bytes; truncated?")
    values = np.fromfile(path, "<f8").reshape(-1, len(FIELDS))
    column = dict(zip(FIELDS, values.T, strict=True))
    notes: list[str] = []
    of_day = seconds_of_day
    if of_day is None:
        below = day is not None and float(column["time"].max()) < DAY_S
        of_day = day is not None and below and day.isoweekday() not in (7, 1)
        if of_day:
            notes.append(f"{path.name}: times below one day, taken as seconds of {day}")
        elif day is not None and below and day.isoweekday() == 1:
            notes.append(f"{path.name}: times below one day; if they count from midnight, wanted --seconds-of-day")
    word = re.search(r"(?<![a-z])utc(time)?(?![a-z])", path.stem, re.IGNORECASE)
    # in sbet_20211021_1200UTC it goes with a time of day
    utc = word is not None and re.search(r"(?<![a-zA-Z0-9])\d+[-_ .]*$", path.stem[: word.start()]) is None
    if word is not None:
        scale = "of UTC, as its name says" if utc else "of GPS: UTC in its name goes with the number before it"
        notes.append(f"{path.name}: times are taken as seconds {scale}")
    if datum := re.search(rf"(?<![a-z0-9])({_DATUMS})(?![0-9])", path.stem, re.IGNORECASE):
        notes.append(f"{path.name}: positions are taken as WGS 84, though its name says {datum[1]}")
    time = times_from_gps(path, column["time"], day, notes, of_day=of_day, utc=utc)
    with np.errstate(over="ignore"):  # a damaged file overflows here and is refused below
        lat_lon = np.degrees(np.column_stack([column["lat"], column["lon"]]))
    heading = column["platform_heading"] - column["wander_angle"]
    source = accuracies or beside(path)
    accuracy = None if source is None else read_smrmsg(source, column["time"])
    if source is not None and accuracy is not None:
        notes.extend((f"{path.name}: accuracies of the poses are those of {source.name}", *accuracy.notes))
    track = NavigationTrack(
        path.stem,
        time,
        np.column_stack([lat_lon, column["alt"]]),
        np.column_stack([column["roll"], column["pitch"], (heading + np.pi) % (2 * np.pi) - np.pi]),
        None if accuracy is None else accuracy.sigma_ned_m,
        None if accuracy is None else accuracy.sigma_rpy,
        notes=tuple(notes),
    )
    return checked(track, path)


def write_sbet(
    path: Path,
    seconds_of_week: ArrayLike,
    geodetic: NDArray[np.floating],
    rpy: NDArray[np.floating],
    velocity_ned: NDArray[np.floating],
) -> None:
    """Write poses as SBET with wander angle 0; accelerations and rates, which an orientation has not, are 0.

    Parameters
    ----------
    seconds_of_week : (n,) GPS seconds
    geodetic : (n, 3) latitude, longitude in degrees, height in metres
    rpy : (n, 3) roll, pitch, heading, radians
    velocity_ned : (n, 3) m/s
    """
    values = np.zeros((len(geodetic), len(FIELDS)), dtype="<f8")
    values[:, 0] = seconds_of_week
    values[:, 1:3] = np.radians(geodetic[:, :2])
    values[:, 3] = geodetic[:, 2]
    values[:, 4:7] = velocity_ned
    values[:, 7:10] = rpy
    path.write_bytes(values.tobytes())


def write_sbet_poses(
    path: Path,
    time_ns: NDArray[np.int64],
    position_l: NDArray[np.floating],
    R_lc: NDArray[np.floating],
    velocity_l: NDArray[np.floating],
    frame: LocalFrame,
    R_bc: NDArray[np.floating],
) -> None:
    """Write poses of an image as SBET of the body, at the perspective centre.

    Parameters
    ----------
    time_ns : (n,) UTC
    position_l, velocity_l : (n, 3) of the perspective centre, local frame, m and m/s
    R_lc : (n, 3, 3) image to local
    frame : the local frame
    R_bc : image to body
    """
    rpy = navigation_from_R_lc(frame, position_l, R_lc, R_bc)
    velocity_ned = np.einsum("nji,nj->ni", frame.R_ln(position_l), velocity_l)
    write_sbet(path, gps_from_utc_ns(time_ns)[1], frame.to_geodetic(position_l), rpy, velocity_ned)
