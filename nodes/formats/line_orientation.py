"""Refined orientation line by line, as a table: time, place and attitude in the terms of both trades, with sigmas."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TextIO

import numpy as np
from numpy.typing import NDArray

from ...solver.geometry.frames import LocalFrame, navigation_from_R_lc
from ...solver.geometry.rotation import R_BC_NOMINAL, angles_from_matrix

Array = NDArray[np.floating]

_PLACES = ("X_m", "Y_m", "Z_m", "omega_deg", "phi_deg", "kappa_deg")
_SIGMAS = tuple(f"sigma_{name}" for name in _PLACES)
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
    sigma : (n, 6) of X, Y, Z, omega, phi, kappa, m and rad; NaN where it is not known
    """

    strip: str
    line: NDArray[np.int64]
    time_ns: NDArray[np.int64]
    position_l: Array
    R_lc: Array
    sigma: Array


def write_oriented_lines(
    path: Path, parts: Iterable[OrientedLines], frame: LocalFrame, R_bc: Array = R_BC_NOMINAL
) -> int:
    """Write a table with one row an image line, and return the number of rows.

    ``strip,line,time_s``, ``X_m`` .. ``kappa_deg`` in the project's CRS and its axes, their sigmas; where the place of
    the local frame is known also latitude, longitude (WGS 84), height above the ellipsoid, and roll, pitch and heading
    of the body (without boresight).

    Parameters
    ----------
    R_bc : image to body
    """
    placed = not frame.lat_deg == frame.lon_deg == frame.height_m == 0.0
    names = ("strip", "line", "time_s", *_PLACES, *_SIGMAS, *(_GEODETIC if placed else ()))
    count = 0
    with open(path, "w", encoding="utf-8", newline="") as file:
        file.write(",".join(names) + "\n")
        for part in parts:
            for i in range(0, len(part.line), CHUNK):
                _rows(file, part, slice(i, i + CHUNK), frame, R_bc, placed)
            count += len(part.line)
    return count


def _rows(file: TextIO, part: OrientedLines, rows: slice, frame: LocalFrame, R_bc: Array, placed: bool) -> None:
    position, R = part.position_l[rows], part.R_lc[rows]
    place, R_crs = frame.to_crs(position), R
    if frame.crs != "local":
        R_crs = np.swapaxes(frame.R_l_crs(place), 1, 2) @ R
    angles = np.degrees(angles_from_matrix(R_crs))
    angles[:, 2] = (angles[:, 2] + 180.0) % 360.0 - 180.0
    sigma = part.sigma[rows] * np.repeat([1.0, 180.0 / np.pi], 3)
    flat = "%.9f" if frame.is_geographic else "%.4f"
    formats = [flat, flat, "%.4f", *["%.7f"] * 3, *["%.4f"] * 3, *["%.7f"] * 3]
    columns = [place, angles, sigma]
    if placed:
        rpy = np.degrees(navigation_from_R_lc(frame, position, R, R_bc))
        columns += [frame.to_geodetic(position), rpy]
        formats += ["%.10f", "%.10f", "%.4f", *["%.7f"] * 3]
    form = ",".join(formats) + "\n"
    stamps = (f"{part.strip},{n},{t // 10**9}.{t % 10**9:09d}," for n, t in zip(
        part.line[rows].tolist(), part.time_ns[rows].tolist(), strict=True))  # fmt: skip
    table = np.concatenate(columns, axis=1)
    text = [start + form % tuple(row) for start, row in zip(stamps, table.tolist(), strict=True)]
    file.writelines(text if np.isfinite(table).all() else (row.replace("nan", "") for row in text))
