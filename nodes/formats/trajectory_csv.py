"""A trajectory as CSV: navigation angles with latitude and longitude, or photogrammetric angles in a CRS."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ...solver.frames import CrsError, LocalFrame, navigation_from_R_lc
from ...solver.rotation import matrix_from_angles
from ..errors import UserError
from .table import Column, Table, read_table
from .track import NavigationTrack, checked

_NAVIGATION = ("lat_deg", "lon_deg", "height_m", "roll_deg", "pitch_deg", "heading_deg")
_PHOTOGRAMMETRIC = ("X_m", "Y_m", "Z_m", "omega_deg", "phi_deg", "kappa_deg")


def is_trajectory_csv(path: Path) -> bool:
    """Whether the header of a CSV file has the columns of a trajectory."""
    with open(path, encoding="utf-8-sig", errors="replace") as file:
        names = {name.strip() for name in file.readline(4096).split(",")}
    return "time_s" in names and (set(_NAVIGATION) <= names or set(_PHOTOGRAMMETRIC) <= names)


def read_trajectory_csv(path: Path, crs: str | None = None) -> NavigationTrack:
    """Poses with ``time_s`` in seconds since the Unix epoch (UTC), or since any other start, which then stands for it.

    Columns are ``time_s,lat_deg,lon_deg,height_m,roll_deg,pitch_deg,heading_deg`` with optional sigmas as ``triline
    navigate`` writes them (``lat_deg_sigma`` in metres ...), or ``time_s,X_m,Y_m,Z_m,omega_deg,phi_deg,kappa_deg`` in
    the CRS given.

    Raises
    ------
    UserError : ``file:line: column: what is wrong``
    """
    notes: list[str] = []
    with open(path, encoding="utf-8-sig", errors="replace") as file:
        header = {name.strip() for name in file.readline(4096).split(",")}
    photogrammetric = set(_PHOTOGRAMMETRIC) <= header
    wanted = _PHOTOGRAMMETRIC if photogrammetric else _NAVIGATION
    sigmas = tuple(f"{name}_sigma" for name in wanted)
    columns = [Column("time_s"), *(Column(name) for name in wanted)]
    columns += [Column(name, optional=True, low=0.0) for name in sigmas]
    table = read_table(path, columns, notes)
    time = table["time_s"]
    late = np.concatenate([[False], np.diff(time) <= 0])
    table.refuse(late, "time_s", lambda i: f"{time[i]:.6f} does not come after {time[i - 1]:.6f}")
    time_ns = np.rint(time).astype(np.int64) * 1_000_000_000 + np.rint((time - np.rint(time)) * 1e9).astype(np.int64)
    if photogrammetric:
        geodetic, rpy = _from_crs(path, table, crs)
        sigma_m = sigma_rpy = None
    else:
        geodetic = table.stack(*_NAVIGATION[:3])
        rpy = np.radians(table.stack(*_NAVIGATION[3:]))
        given = all(name in table for name in sigmas)
        sigma_m = table.stack(*sigmas[:3]) if given else None
        sigma_rpy = np.radians(table.stack(*sigmas[3:])) if given else None
    return checked(NavigationTrack(path.stem, time_ns, geodetic, rpy, sigma_m, sigma_rpy, notes=tuple(notes)), path)


def _from_crs(path: Path, table: Table, crs: str | None) -> tuple[np.ndarray, np.ndarray]:
    if not crs or crs == "local":
        raise UserError(f"{path}: X_m, Y_m, Z_m of an unknown CRS, wanted --crs (for example EPSG:32632)")
    xyz = table.stack(*_PHOTOGRAMMETRIC[:3])
    try:
        frame = LocalFrame.around(xyz, crs)
        position = frame.from_crs(xyz)
        R_lc = frame.R_l_crs(xyz) @ matrix_from_angles(*np.radians(table.stack(*_PHOTOGRAMMETRIC[3:])).T)
    except CrsError as error:
        raise UserError(f"{path}: {error}") from None
    return frame.to_geodetic(position), navigation_from_R_lc(frame, position, R_lc)
