"""A trajectory as CSV: navigation angles with latitude and longitude, or photogrammetric angles in a CRS."""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from datetime import date
from pathlib import Path

import numpy as np

from ...solver.geometry.frames import CrsError, LocalFrame, R_lc_from_navigation, navigation_from_R_lc
from ...solver.geometry.rotation import angles_jacobian, matrix_from_angles
from ..errors import UserError
from .place_columns import PLACE, check_place_units, place_column
from .plausible import check_units
from .projection import refuse_missing_grids
from .table import Column, Table, column_names_of, read_table, separator_hint
from .time_columns import WANTED, time_columns, times_of
from .track import NavigationTrack, checked

#: Poses of one time that differ by no more are the same one, written twice.
SAME_M, SAME_RAD = 1e-3, 1e-6
#: Places in a local frame and latitudes and longitudes beside them are the same within their decimals, m, and the frame
#: is found in so many rounds at most.
BESIDE_M, MOST_ROUNDS = 0.01, 10
#: Places in a CRS that are farther from latitudes and longitudes beside them, m, are in another one: datums differ by
#: less. Heights that are farther from those beside them, m, may count from something else. Tuned.
ELSEWHERE_M, OTHER_HEIGHT_M = 500.0, 1.0
#: Quantity -> how files call it, without unit.
_NAMES = {
    "lat": ("lat", "latitude"),
    "lon": ("lon", "lng", "long", "longitude"),
    "height": ("height", "ellipsoidal_height", "h_ell", "alt", "altitude"),
    "roll": ("roll",),
    "pitch": ("pitch",),
    "heading": ("heading", "true_heading", "yaw"),
}
_NAVIGATION = ("lat_deg", "lon_deg", "height_m", "roll_deg", "pitch_deg", "heading_deg")
_GEODETIC = _NAVIGATION[:3]
_OPK = ("omega_deg", "phi_deg", "kappa_deg")
_PHOTOGRAMMETRIC = (*(place_column(name) for name in PLACE), *(Column(name) for name in _OPK))
_NED = ("sigma_n_m", "sigma_e_m", "sigma_d_m")
_RPY = ("sigma_roll_deg", "sigma_pitch_deg", "sigma_heading_deg")
_XYZ_OPK = tuple(f"sigma_{name}" for name in (*PLACE, *_OPK))
#: Of a table with several strips: which one a row is of.
_STRIP = Column("strip", "text", blank=True)
_UNITS = {"deg": "deg", "degree": "deg", "degrees": "deg", "rad": "rad", "radian": "rad", "radians": "rad", "m": "m"}

#: Perspective centres (n, 3) in the local frame, rotations image to local (n, 3, 3), and UTC (n,) in ns.
Poses = tuple[np.ndarray, np.ndarray, np.ndarray]


def is_trajectory_csv(path: Path) -> bool:
    """Whether the header of a CSV file has the columns of a trajectory."""
    names = column_names_of(path)
    if not time_columns(names):
        return False
    return _is_photogrammetric(names) or {"lat", "lon", "roll"} <= {_quantity(name)[0] for name in names}


def csv_has_latitudes(path: Path) -> bool:
    """Whether the header of a CSV file has latitude and longitude, and not coordinates in a CRS."""
    names = column_names_of(path)
    return not _is_photogrammetric(names) and {"lat", "lon"} <= {_quantity(name)[0] for name in names}


def read_trajectory_csv(path: Path, crs: str | None = None, day: date | None = None) -> NavigationTrack:
    """Poses with a time that `time_columns` knows; ``time_s`` from another start than 1970 is taken as it is.

    Columns are ``lat_deg,lon_deg,height_m,roll_deg,pitch_deg,heading_deg`` (or ``lat_rad``, ``Roll [rad]``: names state
    the unit) with optional sigmas as ``triline navigate`` writes them, or ``X_m,Y_m,Z_m,omega_deg,phi_deg,kappa_deg``
    in the CRS given, where its units may stand in the names (``X_deg``), with optional sigmas along its axes as tables
    of refined orientation have them (``sigma_X_m`` .. ``sigma_kappa_deg``, empty where they are not known). Those of a
    local frame need no CRS where ``lat_deg,lon_deg,height_m`` beside them tell where it lies, as in the table of
    `write_oriented_lines`; roll, pitch and heading there are of the body, and are not read. With a CRS these tell
    whether it is the right one.

    Parameters
    ----------
    path : file
    crs : of X_m, Y_m, Z_m; None or "local" for those of a local frame
    day : of the flight; needed for GPS seconds of the week without a week, compared with all others

    Raises
    ------
    UserError : ``file:line: column: what is wrong``, angles that cannot be in the unit that the header states
    """
    notes: list[str] = []
    return _track(_track_table(path, crs, notes), crs, day, notes)


def _track_table(path: Path, crs: str | None, notes: list[str], *more: Column) -> Table:
    """The columns that `_track` needs, with more of them where the file has them."""
    header, time = _header(path)
    photogrammetric = _is_photogrammetric(header)
    names = {} if photogrammetric else _columns(path, header)
    wanted = _PHOTOGRAMMETRIC if photogrammetric else tuple(Column(name) for name in names.values())
    local = crs in (None, "local")
    columns = [*time, *wanted, *_beside(header, blank=not local)] if photogrammetric else [*time, *wanted]
    sigmas = _sigmas_of(header)
    columns += [Column(name, low=0.0, blank=photogrammetric) for name in sigmas if name in header]
    table = read_table(path, [*columns, *more], notes)
    for some, of in ((sigmas[:3], "position"), (sigmas[3:], "attitude")):
        missing = [name for name in some if name not in table]
        if 0 < len(missing) < len(some):
            notes.append(f"{path.name}: no column {', '.join(missing)}: the other sigmas of the {of} do not count")
    return table


def _track(table: Table, crs: str | None, day: date | None, notes: list[str]) -> NavigationTrack:
    """The poses of a table, which `_track_table` has read, or of some of its rows."""
    path, time, photogrammetric = table.path, time_columns(table.values), _is_photogrammetric(table.values)
    names = {} if photogrammetric else _columns(path, list(table.values))
    sigmas = _sigmas_of(table.values)
    time_ns = times_of(table, time, day, notes)
    late = np.concatenate([[False], np.diff(time_ns) <= 0])
    seconds = time_ns * 1e-9
    shown = (lambda i: table["time_s"][i]) if "time_s" in table else (lambda i: seconds[i])
    table.refuse(late, time[0].name, lambda i: f"{shown(i):.6f} does not come after {shown(i - 1):.6f}")
    if photogrammetric:
        geodetic, rpy, covariance = _from_crs(path, table, crs, notes)
        sigma_m = sigma_rpy = None
    else:
        geodetic = np.column_stack([_in_degrees(table, names[q]) for q in ("lat", "lon", "height")])
        if "alt" in names["height"].lower():
            notes.append(f"{path.name}: {names['height']} is taken as height above the ellipsoid (WGS 84)")
        rpy = np.radians(np.column_stack([_in_degrees(table, names[q]) for q in ("roll", "pitch", "heading")]))
        covariance = None
        sigma_m = table.stack(*sigmas[:3]) if all(name in table for name in sigmas[:3]) else None
        sigma_rpy = np.radians(table.stack(*sigmas[3:])) if all(name in table for name in sigmas[3:]) else None
    track = NavigationTrack(
        path.stem, time_ns, geodetic, rpy, sigma_m, sigma_rpy, notes=tuple(notes), covariance_n=covariance
    )
    return check_units(checked(track, path, table.rows), path, names)


def _local_table(path: Path, *more: Column) -> Table:
    """The columns that `_local_poses` needs, with more of them where the file has them."""
    header, time = _header(path)
    beside = _beside(header, blank=False)
    return read_table(path, [*time, *(Column(column.name) for column in _PHOTOGRAMMETRIC), *beside, *more], [])


def _local_poses(table: Table, frame: LocalFrame) -> Poses:
    """The poses of a table, which `_local_table` has read, or of some of its rows.

    They are in the local frame given, or in the one that latitudes, longitudes and heights beside them tell.

    Raises
    ------
    UserError : two poses at one time, fewer than two times, places in no local frame by latitudes beside them
    """
    path, time, notes = table.path, time_columns(table.values), list[str]()
    time_ns, first, of = np.unique(times_of(table, time, None, notes), return_index=True, return_inverse=True)
    if len(time_ns) < 2:
        raise UserError(f"{path}: {len(time_ns)} poses, wanted at least 2")
    position, R = table.stack(*PLACE), matrix_from_angles(*np.radians(table.stack(*_OPK)).T)
    kept = first[of]
    other = (np.abs(position - position[kept]) > SAME_M).any(axis=1) | (np.abs(R - R[kept]) > SAME_RAD).any(axis=(1, 2))
    shown = (lambda i: f"{table['time_s'][i]:.6f}") if "time_s" in table else (lambda i: f"{time_ns[of[i]] * 1e-9:.6f}")
    table.refuse(
        other,
        time[0].name,
        lambda i: f"{shown(i)} comes twice with two poses, wanted those of one lens or strip a time",
    )
    position, R = position[first], R[first]
    if frame.is_placed and all(name in table for name in _GEODETIC):
        beside = table.stack(*_GEODETIC)
        if not np.abs(frame.from_geodetic(*beside.T) - table.stack(*PLACE)).max() < BESIDE_M:
            other_frame = _frame_of(path, table, table.stack(*PLACE))
            rpy = navigation_from_R_lc(other_frame, position, R)
            position = frame.from_geodetic(*other_frame.to_geodetic(position).T)
            R = R_lc_from_navigation(frame, position, rpy)
    return position, R, time_ns


@dataclass(frozen=True)
class PosesOfStrips:
    """Poses of a table with several strips, or of one flight.

    Attributes
    ----------
    path : file
    rows : of each strip that the column ``strip`` names, in its order; empty where there is no such column, or no name
    table : all rows
    poses : of a table or some of its rows
    """

    path: Path
    rows: dict[str, Table]
    table: Table
    poses: Callable[[Table], Poses]

    def of(self, strip: str | None) -> Poses:
        """Those of a strip (None: all) in time order.

        Raises
        ------
        UserError : ``file:line: column: what is wrong``, the table has not this strip, two poses at one time
        """
        if strip is not None and strip not in self.rows:
            raise UserError(f"{self.path}: strip: no rows of {strip!r}, there are: {', '.join(self.rows)}")
        rows = self.table if strip is None else self.rows[strip]
        if len(rows) < 2:
            raise UserError(f"{self.path}: {len(rows)} poses{f' of strip {strip!r}' * bool(strip)}, wanted at least 2")
        return self.poses(rows)


def read_poses_of_strips(path: Path, frame: LocalFrame) -> PosesOfStrips:
    """Poses in the local frame of a project, strip by strip where there is a column ``strip``, as in the tables of
    `triline adjust` and of `write_oriented_lines`.

    Of a table as `read_trajectory_csv` reads it; of a project without a CRS
    ``time_s,X_m,Y_m,Z_m,omega_deg,phi_deg,kappa_deg`` in its local frame, or in another one where
    ``lat_deg,lon_deg,height_m`` beside them say so, in any order, where a pose may come twice.

    Raises
    ------
    UserError : ``file:line: column: what is wrong``
    """
    more = (_STRIP,) if _STRIP.name in column_names_of(path) else ()

    def in_frame(table: Table) -> Poses:
        track = _track(table, frame.crs, None, [])
        position = frame.from_geodetic(*track.geodetic.T)
        return position, R_lc_from_navigation(frame, position, track.rpy), track.time_ns

    def in_local_frame(table: Table) -> Poses:
        return _local_poses(table, frame)

    if frame.crs == "local":
        table, poses = _local_table(path, *more), in_local_frame
    else:
        refuse_missing_grids(frame.crs, path)
        table, poses = _track_table(path, frame.crs, [], *more), in_frame
    named = dict.fromkeys(table[_STRIP.name].tolist()) if more else {}
    return PosesOfStrips(
        path, {strip: table.part(table[_STRIP.name] == strip) for strip in named if strip}, table, poses
    )


def _header(path: Path) -> tuple[list[str], list[Column]]:
    """Names of the columns, and those with the time.

    Raises
    ------
    UserError : there are none
    """
    header = column_names_of(path)
    time = time_columns(header)
    if not time:
        raise UserError(f"{path}:1: time_s: column missing, wanted {WANTED}{separator_hint(header, 'time_s')}")
    return header, time


def _sigmas_of(header: Collection[str]) -> tuple[str, ...]:
    """Names of columns with sigmas, as far as a table has them."""
    if _is_photogrammetric(header):
        return _XYZ_OPK
    return (*_NED, *_RPY) if {*_NED, *_RPY} & set(header) else tuple(f"{name}_sigma" for name in _NAVIGATION)


def _is_photogrammetric(header: Collection[str]) -> bool:
    return all(set(column.names) & set(header) for column in _PHOTOGRAMMETRIC)


def _quantity(name: str) -> tuple[str, str]:
    """Quantity and unit of a column name such as ``lat_deg``, ``Roll [rad]``, ``Altitude (m)``; "" if not known."""
    plain = re.sub(r"[\s\[\]()]+", "_", name.strip().lower()).strip("_")
    base, _, end = plain.rpartition("_")
    unit = _UNITS.get(end, "")
    base = base if unit else plain
    return next((quantity for quantity, known in _NAMES.items() if base in known), ""), unit


def _columns(path: Path, header: Sequence[str]) -> dict[str, str]:
    """Quantity -> column; every one with its unit."""
    found: dict[str, str] = {}
    for name in header:
        quantity, unit = _quantity(name)
        if not quantity:
            continue
        if quantity in found:
            raise UserError(f"{path}:1: {name}: {quantity} comes twice, also as {found[quantity]}")
        right = ("m",) if quantity == "height" else ("deg", "rad")
        if unit not in right:
            stated = " or ".join(f"{quantity}_{u}" for u in right)
            raise UserError(f"{path}:1: {name}: the unit is not stated, wanted {stated}")
        found[quantity] = name
    for quantity, wanted in zip(_NAMES, _NAVIGATION, strict=True):
        if quantity not in found:
            raise UserError(f"{path}:1: {wanted}: column missing, wanted {','.join(_NAVIGATION)}")
    return found


def _in_degrees(table: Table, name: str) -> np.ndarray:
    if _quantity(name)[1] != "rad":
        return table[name]
    values = table[name]
    table.refuse(np.abs(values) > 2 * np.pi + 1e-3, name, lambda i: f"{values[i]:g}, wanted radians; are they degrees?")
    return np.degrees(values)


def _from_crs(path: Path, table: Table, crs: str | None, notes: list[str]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Latitude, longitude and height (n, 3), roll, pitch and heading (n, 3), and covariances as of a track."""
    xyz, angles = table.stack(*PLACE), np.radians(table.stack(*_OPK))
    if not crs or crs == "local":
        for name in PLACE:
            if (named := table.headed.get(name, name)) != name:
                raise UserError(f"{path}:1: {named}: coordinates of no local frame, wanted the --crs that they are in")
        frame = _frame_of(path, table, xyz)
        position, R_l_crs = xyz, np.tile(np.eye(3), (len(xyz), 1, 1))
    else:
        refuse_missing_grids(crs, path)
        try:
            frame = LocalFrame.around(xyz, crs)
            check_place_units(table, frame)
            position = frame.from_crs(xyz)
            R_l_crs = frame.R_l_crs(xyz)
        except CrsError as error:
            raise UserError(f"{path}: {error}") from None
        _compare_beside(path, table, frame, position, crs, notes)
    geodetic, rpy = (
        frame.to_geodetic(position),
        navigation_from_R_lc(frame, position, R_l_crs @ matrix_from_angles(*angles.T)),
    )
    R_n_crs = np.swapaxes(frame.R_ln(position), 1, 2) @ R_l_crs
    covariance = np.zeros((len(xyz), 6, 6))
    unknown = np.zeros(len(xyz), dtype=bool)
    for part, unit, T in (
        (slice(0, 3), 1.0, R_n_crs),
        (slice(3, 6), np.pi / 180.0, R_n_crs @ np.linalg.inv(angles_jacobian(angles))),
    ):
        names = _XYZ_OPK[part]
        sigma = table.stack(*names) * unit if all(name in table for name in names) else np.full((len(xyz), 3), np.nan)
        covariance[:, part, part] = T @ (np.square(sigma)[:, :, None] * np.swapaxes(T, 1, 2))
        lacks = np.isnan(sigma).any(axis=1)
        covariance[lacks, part, part] = np.nan
        unknown |= lacks & ~lacks.all()
    if unknown.any():
        what = "they get the accuracies of poses that have none (--position-sigma, --attitude-sigma)"
        notes.append(f"{path.name}: {int(unknown.sum())} poses without sigmas: {what}")
    return geodetic, rpy, covariance


def _beside(header: Collection[str], *, blank: bool) -> list[Column]:
    """Latitude, longitude and height beside coordinates, where a table has all three."""
    return [Column(name, blank=blank) for name in _GEODETIC] if set(_GEODETIC) <= set(header) else []


def _compare_beside(
    path: Path, table: Table, frame: LocalFrame, position: np.ndarray, crs: str, notes: list[str]
) -> None:
    """Refuse a CRS in which places (n, 3) are not where latitudes and longitudes in the same rows say; note heights.

    Raises
    ------
    UserError : how far off they are
    """
    if not all(name in table for name in _GEODETIC):
        return
    beside = table.stack(*_GEODETIC)
    known = ~np.isnan(beside).any(axis=1)
    if not known.any():
        return
    off = np.median(position[known] - frame.from_geodetic(*beside[known].T), axis=0)
    if not (far := float(np.hypot(*off[:2]))) < ELSEWHERE_M:
        beside_them = f"{far / 1e3:.1f} km from lat_deg, lon_deg beside them"
        raise UserError(f"{path}: X_m, Y_m in {crs!r} are {beside_them}, wanted the CRS that they are in")
    if abs(off[2]) > OTHER_HEIGHT_M:
        beside_them = f"{abs(off[2]):.1f} m {'above' if off[2] > 0 else 'below'} height_m beside them"
        what = "do they count from a geoid (EPSG:32632+EPSG:5773)?"
        notes.append(f"{path.name}: heights Z_m in {crs!r} are {beside_them}: {what}")


def _frame_of(path: Path, table: Table, xyz: np.ndarray) -> LocalFrame:
    """The local frame of places (n, 3), by latitudes, longitudes and heights in the same rows.

    Raises
    ------
    UserError : there are none, or no local frame has these places there
    """
    wanted = "wanted --crs (for example EPSG:32632)"
    if not all(name in table for name in _GEODETIC):
        beside = f"or of a local frame {', '.join(_GEODETIC)} beside them, as `triline export --per-line` writes"
        raise UserError(f"{path}: X_m, Y_m, Z_m of an unknown CRS, {wanted}, {beside}")
    geodetic = table.stack(*_GEODETIC)
    frame = LocalFrame(*geodetic[0].tolist())
    for _ in range(MOST_ROUNDS):
        off = frame.from_geodetic(*geodetic.T) - xyz
        frame = LocalFrame(*frame.to_geodetic(off.mean(axis=0)).tolist())
    off = np.abs(frame.from_geodetic(*geodetic.T) - xyz).max()
    if not off < BESIDE_M:
        raise UserError(f"{path}: X_m, Y_m, Z_m are in no local frame by {', '.join(_GEODETIC)} beside them, {wanted}")
    return frame
