"""Refined orientation line by line, as a table: time, place and attitude in the terms of both trades, with sigmas."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TextIO

import numpy as np
from numpy.typing import NDArray

from ...schemas.units import place_columns
from ...solver.geometry.frames import LocalFrame, navigation_from_R_lc
from ...solver.geometry.rotation import R_BC_NOMINAL, angles_from_matrix, angles_jacobian
from ..errors import UserError
from .sbet import write_sbet_poses
from .smrmsg import write_smrmsg_poses
from .table import csv_field

Array = NDArray[np.floating]

_ANGLES = ("omega_deg", "phi_deg", "kappa_deg")
_SIGMAS = tuple(f"sigma_{name}" for name in (*place_columns(), *_ANGLES))
_GEODETIC = ("lat_deg", "lon_deg", "height_m", "roll_deg", "pitch_deg", "heading_deg")
#: Lines written at a time.
CHUNK = 5000


@dataclass(frozen=True)
class OrientedLines:
    """Lines of one strip; n of them.

    Attributes
    ----------
    strip : id
    line : (n,) number, from 0
    time_ns : (n,) UTC, or the project's own count
    position_l : (n, 3) perspective centre, local frame, m
    R_lc : (n, 3, 3) image to local
    covariance : (n, 6, 6) of X, Y, Z, omega, phi, kappa in the local frame, m and rad; NaN where it is not known
    """

    strip: str
    line: NDArray[np.int64]
    time_ns: NDArray[np.int64]
    position_l: Array
    R_lc: Array
    covariance: Array


def write_oriented_lines(
    path: Path, parts: Iterable[OrientedLines], frame: LocalFrame, R_bc: Array = R_BC_NOMINAL
) -> int:
    """Write a table with one row an image line, and return the number of rows.

    ``strip,line,time_s``, ``X_m`` .. ``kappa_deg`` in the project's CRS and its axes (``X_deg, Y_deg`` where it is
    geographic), their sigmas in m and deg; where the place of
    the local frame is known also latitude, longitude (WGS 84), height above the ellipsoid, and roll, pitch and heading
    of the body (without boresight).

    Parameters
    ----------
    R_bc : image to body
    """
    placed = frame.is_placed
    names = ("strip", "line", "time_s", *place_columns(frame.units), *_ANGLES, *_SIGMAS, *(_GEODETIC if placed else ()))
    count = 0
    with open(path, "w", encoding="utf-8", newline="") as file:
        file.write(",".join(names) + "\n")
        for part in parts:
            for i in range(0, len(part.line), CHUNK):
                _rows(file, part, slice(i, i + CHUNK), frame, R_bc, placed)
            count += len(part.line)
    return count


def write_patb_lines(path: Path, parts: Iterable[OrientedLines], frame: LocalFrame) -> int:
    """Write lines as photos of a PATB table, and return their number.

    A row is ``id X Y Z r11 r12 r13 r21 r22 r23 r31 r32 r33`` between blanks, without a header: ``id`` is strip and
    line (``S1_120``, blanks of the strip as ``_``), X, Y, Z the perspective centre in the project's CRS, ``r`` the
    matrix from the image frame (x along flight, y to the left, z up) to the axes of the CRS, row by row.

    Raises
    ------
    UserError : strips whose names are the same with ``_``
    """
    count, of_name = 0, dict[str, str]()
    flat = "%.9f" if frame.is_geographic else "%.4f"
    form = " ".join([flat, flat, "%.4f", *["%.12f"] * 9]) + "\n"
    with open(path, "w", encoding="utf-8", newline="") as file:
        for part in parts:
            strip = "_".join(part.strip.split())
            other = of_name.setdefault(strip, part.strip)
            if other != part.strip:
                raise UserError(
                    f"strips {other!r} and {part.strip!r} have the same name in PATB, {strip}: wanted --format csv"
                )
            for i in range(0, len(part.line), CHUNK):
                place, R = _in_crs(part.position_l[i : i + CHUNK], part.R_lc[i : i + CHUNK], frame)
                values = np.concatenate([place, R.reshape(-1, 9)], axis=1).tolist()
                numbers = part.line[i : i + CHUNK].tolist()
                file.writelines(f"{strip}_{n} " + form % tuple(row) for n, row in zip(numbers, values, strict=True))
            count += len(part.line)
    return count


def write_sbet_lines(path: Path, parts: Iterable[OrientedLines], frame: LocalFrame, R_bc: Array = R_BC_NOMINAL) -> int:
    """Write lines as SBET records in order of time, and return their number; a time comes once.

    Position is the perspective centre, attitude that of the body (without boresight), velocity that of the strip's
    lines (0 where a strip has one line alone).

    Raises
    ------
    UserError : the place of the local frame is not known; no line
    """
    time_ns, position, R, velocity, _ = _by_time(parts, frame)
    write_sbet_poses(path, time_ns, position, R, velocity, frame, R_bc)
    return len(time_ns)


def write_smrmsg_lines(
    path: Path, parts: Iterable[OrientedLines], frame: LocalFrame, R_bc: Array = R_BC_NOMINAL
) -> int:
    """Write the accuracies of what `write_sbet_lines` writes as SMRMSG records, and return their number.

    Raises
    ------
    UserError : the place of the local frame is not known; no line with a covariance
    """
    time_ns, position, R, _, covariance = _by_time(parts, frame)
    return write_smrmsg_poses(path, time_ns, position, R, covariance, frame, R_bc)


def _by_time(parts: Iterable[OrientedLines], frame: LocalFrame) -> tuple[NDArray[np.int64], Array, Array, Array, Array]:
    """Times, places, rotations, velocities and covariances of lines in order of time; a time comes once.

    Raises
    ------
    UserError : the place of the local frame is not known; no line
    """
    if not frame.is_placed:
        raise UserError(
            "SBET has latitude and longitude, wanted the origin of the local frame in configuration/project"
        )
    times, columns = [], []
    for part in parts:
        time_ns, first = np.unique(part.time_ns, return_index=True)
        position = part.position_l[first]
        time_s = (time_ns - time_ns[0]) * 1e-9
        velocity = np.gradient(position, time_s, axis=0) if len(time_s) > 1 else np.zeros((1, 3))
        times.append(time_ns)
        columns.append((position, part.R_lc[first], velocity, part.covariance[first]))
    if not times:
        raise UserError("no image line with an orientation, wanted at least one")
    time_ns, first = np.unique(np.concatenate(times), return_index=True)
    position, R, velocity, covariance = (np.concatenate(some)[first] for some in zip(*columns, strict=True))
    return time_ns, position, R, velocity, covariance


def _in_crs(position_l: Array, R_lc: Array, frame: LocalFrame) -> tuple[Array, Array]:
    """Places (n, 3) in the CRS, and rotations (n, 3, 3) from image to its axes."""
    place = frame.to_crs(position_l)
    if frame.crs == "local":
        return place, R_lc
    return place, np.swapaxes(frame.R_l_crs(place), 1, 2) @ R_lc


def poses_in_crs(position_l: Array, R_lc: Array, covariance: Array, frame: LocalFrame) -> tuple[Array, Array, Array]:
    """Poses in the CRS and along its axes.

    Parameters
    ----------
    position_l, R_lc : (n, 3) m and (n, 3, 3), local frame
    covariance : (n, 6, 6) of X, Y, Z, omega, phi, kappa in the local frame, m and rad

    Returns
    -------
    place : (n, 3), units of the CRS
    angles : (n, 3) omega, phi, kappa, rad; kappa within half a turn
    sigma : (n, 6) of X, Y, Z, omega, phi, kappa, m and rad
    """
    place, R = _in_crs(position_l, R_lc, frame)
    angles = angles_from_matrix(R)
    C = covariance
    if frame.crs != "local":
        turn = R @ np.swapaxes(R_lc, 1, 2)  # local axes to those of the CRS
        T = np.zeros((len(place), 6, 6))
        T[:, :3, :3] = turn
        T[:, 3:, 3:] = angles_jacobian(angles) @ turn @ np.linalg.inv(angles_jacobian(angles_from_matrix(R_lc)))
        C = T @ C @ np.swapaxes(T, 1, 2)
    angles[:, 2] = (angles[:, 2] + np.pi) % (2 * np.pi) - np.pi
    return place, angles, np.sqrt(np.maximum(np.einsum("nii->ni", C), 0.0))


def _rows(file: TextIO, part: OrientedLines, rows: slice, frame: LocalFrame, R_bc: Array, placed: bool) -> None:
    position, R = part.position_l[rows], part.R_lc[rows]
    place, angles, sigma = poses_in_crs(position, R, part.covariance[rows], frame)
    angles, sigma = np.degrees(angles), sigma * np.repeat([1.0, 180.0 / np.pi], 3)
    flat = "%.9f" if frame.is_geographic else "%.4f"
    formats = [flat, flat, "%.4f", *["%.7f"] * 3, *["%.4f"] * 3, *["%.7f"] * 3]
    columns = [place, angles, sigma]
    if placed:
        rpy = np.degrees(navigation_from_R_lc(frame, position, R, R_bc))
        columns += [frame.to_geodetic(position), rpy]
        formats += ["%.10f", "%.10f", "%.4f", *["%.7f"] * 3]
    form = ",".join(formats) + "\n"
    strip = csv_field(part.strip)
    stamps = (f"{strip},{n},{t // 10**9}.{t % 10**9:09d}," for n, t in zip(
        part.line[rows].tolist(), part.time_ns[rows].tolist(), strict=True))  # fmt: skip
    table = np.concatenate(columns, axis=1)
    numbers = [form % tuple(row) for row in table.tolist()]
    if not np.isfinite(table).all():  # the name of a strip may have these letters, too
        numbers = [row.replace("nan", "") for row in numbers]
    file.writelines(start + row for start, row in zip(stamps, numbers, strict=True))
