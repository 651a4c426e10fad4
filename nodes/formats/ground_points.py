"""Tables of control and check points: ``ground_points.csv``, and lists as other programs and survey crews head them."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from itertools import takewhile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...solver.adjustment.block_data import KnownPoints
from ...solver.adjustment.network import ROLES
from ...solver.geometry.frames import GEOGRAPHIC, CrsError, Frame, LocalFrame, known_crs
from ..errors import UserError
from ..first_of import first_of
from .place_columns import PLACE, check_place_units, place_column, to_local
from .projection import LONGEST_NAME
from .table import Column, Table, column_names_of, read_table

_SIGMAS = tuple(f"sigma_{name}" for name in PLACE)
_COLUMNS = (
    Column("point", "text"),
    *(place_column(name, blank=True) for name in PLACE),
    *(Column(name, optional=True, blank=True, low=0.0) for name in _SIGMAS),
    Column("role", "text", optional=True, choices=ROLES),
    Column("target_radius_m", optional=True, blank=True, low=0.0),
    Column("accuracy", "text", optional=True, blank=True),
    Column("level_accuracy", optional=True, blank=True, low=0.0),
    Column("enabled", "text", optional=True, choices=("1", "0", "True", "False", "true", "false")),
    Column("type", "text", optional=True, blank=True),
)
#: Roles by what Pix4D calls them, in small letters without blanks.
_ROLE_OF_TYPE = {
    "3dgcp": "control", "gcp": "control", "2dgcp": "planimetric", "1dgcp": "height", "checkpoint": "check",
    "3dcheckpoint": "check",
}  # fmt: skip
#: Control whose nearest point is farther from the flight, m, is in another CRS or of another flight.
FAR_M = 50e3
#: Pairs of names that are told.
_MOST_NAMED = 3
#: Places by the CRS that a list states and by the project's lie so close, m, in level and in height: datum shifts of
#: the same system in two programs are some metres apart, models of the same geoid up to one; zones and feet far more.
_SAME_PLACE_M, _SAME_HEIGHT_M = 10.0, 1.0
_FIRST_OF_GCP_LIST = re.compile(r"EPSG:\d+$|\+proj=|WGS84 UTM \d+", re.IGNORECASE)
_STATED_CRS = re.compile(r"#\s*CoordinateSystem:\s*(.*\S)")
#: A unit that ends the name of a column.
_UNIT = re.compile(r"[\[(](?:(?P<m>m|met(?:er|re)s?)|(?P<deg>°|deg(?:rees?)?))[\])]$")
#: Names of columns in lists of other programs and of survey crews, in small letters without blanks, _, # and unit; the
#: first that a list has is the one that counts.
_EASTING = ("x", "e", "east", "easting", "eastings", "x/east", "x/easting")
_NORTHING = ("y", "n", "north", "northing", "northings", "y/north", "y/northing")
_LONGITUDE, _LATITUDE = ("x/longitude", "longitude", "lon"), ("y/latitude", "latitude", "lat")
_ELLIPSOIDAL = ("ellipsoidalheight", "h-ell")
_ABOVE_SEA = ("altitude", "elevation")
_OTHER_NAMES = {
    "point": ("point", "label", "name", "id", "pointid", "pointname", "gcplabel", "p"),
    "X_m": _EASTING + _LONGITUDE,
    "Y_m": _NORTHING + _LATITUDE,
    "Z_m": ("z", "h", "height", *_ABOVE_SEA, "z/altitude"),
    "sigma_X_m": ("accuracyx", "eastingrms"),
    "sigma_Y_m": ("accuracyy", "northingrms"),
    "sigma_Z_m": ("accuracyz", "verticalaccuracy", "accuracyvertical", "accuracyvert", "elevationrms"),
    "accuracy": ("accuracyx/y/z", "accuracy"),
    "level_accuracy": ("accuracyx/y", "horizontalaccuracy", "accuracyhorizontal", "accuracyhorz"),
    "enabled": ("enable", "enabled"),
    "type": ("type",),
}


def read_ground_table(path: Path, crs: str, notes: list[str], *, may_be_empty: bool = False) -> Table:
    """The columns of a table of points in a CRS, for `known_points`.

    ``point,X_m,Y_m,Z_m,sigma_X_m,sigma_Y_m,sigma_Z_m,role`` and ``target_radius_m``, or names of other programs: of
    Metashape ``Enable`` is 1 for control and 0 for a check point, one accuracy is for all axes; of Pix4D ``Type`` says
    what a point is. Without a role all points are control, with a note. Lines of remarks (``# ...``) may stand above
    the header; a ``CoordinateSystem`` that they state must be the CRS.

    Raises
    ------
    UserError : ``file:line: column: what is wrong``
    """
    skip = _remarks(path)
    header = column_names_of(path, skip)
    if len(header) == 1 and _FIRST_OF_GCP_LIST.match(header[0]):
        raise UserError(
            f"{path}:{skip + 1}: a list of OpenDroneMap (gcp_list.txt), with pixels of frame images and no sigmas, "
            "wanted a header with point,X_m,Y_m,Z_m,sigma_X_m,sigma_Y_m,sigma_Z_m"
        )
    # what stands for columns that are there says nothing
    ours = {"enabled", "type"} if "role" in header else set[str]()
    ours |= {"accuracy", "level_accuracy"} if set(_SIGMAS) <= set(header) else set()
    wanted = [column for column in _COLUMNS if column.name not in ours]
    columns = [_as_headed(column, header, crs, f"{path}:{skip + 1}") for column in wanted]
    table = read_table(path, columns, notes, may_be_empty=may_be_empty, skip=skip)
    height = table.headed.get("Z_m", "Z_m")
    if _plain(height) in _ABOVE_SEA and not _has_heights(crs):
        notes.append(f"{path.name}: {height} is taken as height above the ellipsoid, for the CRS has no other heights")
    _refuse_other_crs(table, crs, notes)
    values: dict[str, NDArray[Any]] = dict.fromkeys(_SIGMAS, np.full(len(table), np.nan))
    if "accuracy" in table:
        values |= dict(zip(_SIGMAS, _accuracies(table).T, strict=True))
    if "level_accuracy" in table:
        values |= dict.fromkeys(_SIGMAS[:2], table["level_accuracy"])
    if "enabled" in table:
        enabled = np.isin(table["enabled"].astype(str), ("1", "True", "true"))
        values["role"] = np.where(enabled, "control", "check").astype(object)
    elif "role" not in table:
        roles = _roles_of_types(table, notes) if "type" in table else None
        values["role"] = np.full(len(table), "control", dtype=object) if roles is None else roles
        if len(table) and roles is None:
            notes.append(f"{path.name}: no column role: all points are control")
    return replace(table, values=values | dict(table.values))


def _roles_of_types(table: Table, notes: list[str]) -> NDArray[Any] | None:
    """Roles (n,) by the types that Pix4D has; None, with a note, where none of them is one."""
    types = table["type"]
    roles = np.array([_ROLE_OF_TYPE.get(_small(word), "") for word in types], dtype=object)
    if not (roles != "").any():
        if len(table):
            notes.append(f"{table.path.name}: column {table.headed.get('type', 'type')!r} is not known and was ignored")
        return None
    wanted = "wanted 3D GCP, 2D GCP, 1D GCP or Check Point"
    table.refuse(roles == "", "type", lambda i: f"{repr(types[i]) if types[i] else 'missing'}, {wanted}")
    return roles


def _remarks(path: Path) -> int:
    """How many lines above the header are remarks: a ``#`` and a blank, and no column of names behind them."""
    names = {"point", *_OTHER_NAMES["point"]}
    with open(path, encoding="utf-8-sig", errors="replace") as file:
        remarks = takewhile(
            lambda line: (
                _STATED_CRS.match(line)
                or (line.startswith("# ") and not names & set(map(_plain, re.split("[,;]", line))))
            ),
            file,
        )
        return sum(1 for _ in remarks)


def _refuse_other_crs(table: Table, crs: str, notes: list[str]) -> None:
    """Raise UserError where a remark above the header states another CRS than the points are taken to be in."""
    with open(table.path, encoding="utf-8-sig", errors="replace") as file:
        lines = [(n, found[1]) for n in range(table.skip) if (found := _STATED_CRS.match(file.readline()))]
    whole = table.stack("X_m", "Y_m", "Z_m")
    whole = whole[np.isfinite(whole).all(axis=1)][:1]
    if not lines or not len(whole) or crs == "local":
        return
    line, stated = lines[0]
    where = f"{table.path}:{line + 1}: CoordinateSystem"
    try:
        told = known_crs(stated)
    except CrsError:
        notes.append(f"{table.path.name}: CoordinateSystem {stated[:40]!r} is none that PROJ knows, and was ignored")
        return
    project = "EPSG:4979" if crs == GEOGRAPHIC else crs
    try:
        mine = known_crs(project)
    except CrsError:  # told where the points are brought into it
        return
    wanted = repr(crs if len(crs) < LONGEST_NAME else mine.name)
    if told.is_compound and not mine.is_compound:
        what = f"heights are of {told.sub_crs_list[1].name!r}, wanted those above the ellipsoid, as {wanted} has them"
        raise UserError(f"{where}: {what}")
    try:
        frame = LocalFrame.around(whole, project)
        off = LocalFrame(frame.lat_deg, frame.lon_deg, 0.0, stated).from_crs(whole) - frame.from_crs(whole)
    except CrsError:
        if told.name == mine.name:  # the points are told where they are brought into it
            return
        raise UserError(f"{where}: {told.name!r}, wanted points in {wanted}") from None
    away, above = float(np.hypot(*off[0, :2])), abs(float(off[0, 2]))
    if away > _SAME_PLACE_M or (told.is_compound and above > _SAME_HEIGHT_M):
        apart = f"{1e-3 * away:.0f} km" if away > 1e3 else f"{max(away, above):.0f} m"
        raise UserError(f"{where}: points in {told.name!r} lie {apart} away, wanted them in {wanted}")


def _as_headed(column: Column, header: Sequence[str], crs: str, where: str) -> Column:
    """The column under the name that a header has for it, where that has none of ours."""
    if set(column.names) & set(header):
        return column
    others = list(_OTHER_NAMES.get(column.name, ()))
    if column.name == "Z_m" and not _has_heights(crs) and set(_ELLIPSOIDAL) & set(map(_plain, header)):
        others = list(_ELLIPSOIDAL)
    if _is_geographic(crs):
        others.sort(key=lambda name: name not in _LONGITUDE + _LATITUDE)  # of lists that have both
    units = ("", "m", "deg") if column.name in PLACE else ("", "m")
    found = sorted({(others.index(_plain(name)), name) for name in header
                    if _plain(name) in others and _unit(name) in units})  # fmt: skip
    if not found:
        return column
    names = [name for _, name in found]
    if len(found) > 1 and column.name == "Z_m":  # nobody knows which of them is above the ellipsoid
        raise UserError(f"{where}: {names[1]}: heights stand in {names[0]}, too; wanted one column of them, or Z_m")
    if len(found) > 1 and found[0][0] == found[1][0]:
        raise UserError(f"{where}: {names[1]}: this column comes twice, also as {names[0]}")
    return replace(column, other_names=(*column.other_names, names[0]))


def _is_geographic(crs: str) -> bool:
    try:
        return crs == GEOGRAPHIC or (crs != "local" and known_crs(crs).is_geographic)
    except CrsError:  # told where the points are brought into it
        return False


def _has_heights(crs: str) -> bool:
    """Whether heights count from something else than the ellipsoid."""
    try:
        return crs == "local" or (crs != GEOGRAPHIC and known_crs(crs).is_compound)
    except CrsError:  # as above
        return True


def _plain(name: str) -> str:
    return _UNIT.sub("", _small(name))


def _unit(name: str) -> str:
    """The unit that a name of a column states: m, deg, or "" for none."""
    found = _UNIT.search(_small(name))
    return (found.lastgroup or "") if found else ""


def _small(name: str) -> str:
    return re.sub(r"[\s_#]", "", name).lower()


def _check_units(table: Table, frame: Frame) -> None:
    """Refuse coordinates in another unit than the CRS has; beside feet, what is in metres has to say so."""
    degrees = _LONGITUDE + _LATITUDE
    stated = {name: _unit(name) or "deg" * (_plain(name) in degrees) for name in table.headed.values()}
    check_place_units(table, frame, {name: unit for name, unit in stated.items() if unit})
    if frame.units[0] in ("m", "deg", "grad"):
        return
    in_metres = (*_SIGMAS, "accuracy", "level_accuracy", *("Z_m",) * (frame.units[2] == "m"))
    for column in in_metres:
        name = table.headed.get(column, column)
        if name != column and not _unit(name):
            wanted = f"{column}, or {name} (m)" if column in (*PLACE, *_SIGMAS) else f"{name} (m)"
            what = f"no unit, beside coordinates in {frame.units[0]}; wanted {wanted}"
            raise UserError(f"{table.path}:{table.skip + 1}: {name}: {what}")


def _accuracies(table: Table) -> NDArray[np.float64]:
    """Sigmas (n, 3) along X, Y and Z of ``0.02``, ``0.02/0.05`` (in level and in height) or ``0.02/0.03/0.05``."""
    out = np.full((len(table), 3), np.nan)
    for row, text in enumerate(table["accuracy"]):
        try:
            parts = [float(part.replace(",", ".")) for part in text.split("/") if part]
        except ValueError:
            parts = [np.nan]
        if len(parts) > 3 or any(not 0.0 <= part < np.inf for part in parts):
            bad = np.arange(len(table)) == row
            table.refuse(bad, "accuracy", lambda i: f"{table['accuracy'][i]!r}, wanted metres")
        if parts:
            out[row] = {1: parts * 3, 2: [*parts[:1], *parts], 3: parts}[len(parts)]
    return out


def read_ground_points(
    path: Path, crs: str, frame: LocalFrame | None, notes: list[str]
) -> tuple[KnownPoints, LocalFrame]:
    """Control and check points of a CSV as ``ground_points.csv`` in a block folder.

    Parameters
    ----------
    path : file
    crs : of the points, anything that PROJ understands
    frame : that they get; None puts one at their middle, on the ellipsoid
    notes : gets remarks

    Returns
    -------
    points, and their frame

    Raises
    ------
    UserError : ``file:line: column: what is wrong``, a CRS that PROJ does not know
    """
    table = read_ground_table(path, crs, notes)
    xyz = table.stack("X_m", "Y_m", "Z_m")
    whole = np.isfinite(xyz).all(axis=1)  # planimetric points may have no height
    try:
        around = LocalFrame.around(xyz[whole] if whole.any() else np.nan_to_num(xyz), crs)
    except CrsError as error:
        raise UserError(f"{path}: {error}") from None
    frame = around if frame is None else LocalFrame(frame.lat_deg, frame.lon_deg, frame.height_m, crs)
    return known_points(table, frame, notes), frame


def known_points(table: Table, frame: Frame, notes: list[str]) -> KnownPoints:
    """Control and check points of a table of `read_ground_table`, in a frame.

    Raises
    ------
    UserError : ``file:line: column: what is wrong``
    """
    n = len(table)
    if not n:
        notes.append(f"{table.path.name}: no points: the block stands on its trajectories alone")
        return KnownPoints((), np.empty((0, 3)), np.empty((0, 3, 3)), ())
    _check_units(table, frame)
    ids, role = table["point"], table["role"].astype(str)
    repeated = np.ones(n, dtype=bool)
    repeated[np.unique(ids.astype(str), return_index=True)[1]] = False
    table.refuse(repeated, "point", lambda i: f"{ids[i]} comes twice")
    xyz, sigma = table.stack("X_m", "Y_m", "Z_m"), table.stack("sigma_X_m", "sigma_Y_m", "sigma_Z_m")
    # what a point must have: coordinates that its role makes observations, with their sigma; check points need no sigma
    needs = np.ones((n, 3), dtype=bool)
    needs[role == "planimetric", 2] = False
    needs[role == "height", :2] = False
    for axis, letter in enumerate("XYZ"):
        column = f"{letter}_m"
        must = needs[:, axis] if axis == 2 else np.ones(n, dtype=bool)  # height points: as approximate values
        table.refuse(must & np.isnan(xyz[:, axis]), column, lambda i: f"missing, wanted a number ({role[i]} point)")
        weighted = needs[:, axis] & (role != "check")
        s = sigma[:, axis]
        table.refuse(weighted & ~(s > 0), f"sigma_{column}", lambda i, s=s: f"{_shown(s[i])}, wanted a number above 0")
    no_height = np.isnan(xyz[:, 2])
    if no_height.any():
        height = float(np.mean(xyz[~no_height, 2])) if (~no_height).any() else 0.0
        notes.append(f"{table.path.name}: {no_height.sum()} points without height were put at {height:.1f} m")
        xyz[no_height, 2] = height
    xyz_l = to_local(table, xyz, frame)  # names a point outside the area
    R = frame.R_l_crs(xyz)
    covariance = R @ (np.square(np.nan_to_num(sigma))[:, :, None] * np.swapaxes(R, -1, -2))
    radius = np.nan_to_num(table["target_radius_m"]) if "target_radius_m" in table else np.zeros(n)
    return KnownPoints(tuple(ids), xyz_l, covariance, tuple(role.tolist()), tuple(radius.tolist()))


def notes_of_names(ids: Sequence[str], n_known: int, measured: NDArray[np.int64]) -> list[str]:
    """What is said of known points that no image has, where one has their name but for capitals and zeros.

    Parameters
    ----------
    ids : names of all points, the known ones first
    n_known : how many these are
    measured : numbers of the points that images have
    """
    missing = np.setdiff1d(np.arange(n_known), measured)
    if not len(missing):
        return []
    others = {_spelt(id): id for id in ids[n_known:]}
    pairs = [f"{ids[k]} and {others[_spelt(ids[k])]}" for k in missing if _spelt(ids[k]) in others]
    if not pairs:
        return []
    names = "names differ by capitals or zeros alone, and count as different points"
    return [f"ground_points.csv and image_points.csv: {names}: {first_of(pairs, _MOST_NAMED)}"]


def _spelt(id: str) -> str:
    """A name as spreadsheets leave it: 007 becomes 7, or 7.0."""
    return re.sub(r"(?<!\d)0+(?=\d)", "", id.lower()).removesuffix(".0")


def _shown(value: float) -> str:
    return "missing" if np.isnan(value) else f"{value:g}"
