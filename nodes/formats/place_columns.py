"""Coordinates of places in tables: the names of their columns state the unit that they have in the project's CRS."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from ...schemas.units import PLACE_UNITS, place_columns
from ...solver.geometry.frames import CrsError, Frame
from ..errors import UserError
from .table import Column, Table

#: Columns of a place as tables that are read have them, in metres or in whatever unit the CRS has.
PLACE = place_columns()


def place_column(name: str, *, blank: bool = False) -> Column:
    """The column of a coordinate of `PLACE`, under that name or with another unit (``X_deg``)."""
    others = tuple(f"{name[0]}_{unit}" for unit in PLACE_UNITS[1:])
    return Column(name, blank=blank, other_names=others)


def check_place_units(table: Table, frame: Frame, stated: Mapping[str, str] | None = None) -> None:
    """Refuse columns with a unit that the CRS has not; the plain names ``X_m, Y_m, Z_m`` stand for any.

    Parameters
    ----------
    frame : with the CRS of the coordinates
    stated : units that other names of columns state, by name

    Raises
    ------
    UserError : ``file:1: column: what its coordinates are in``
    """
    for plain, right, unit in zip(PLACE, place_columns(frame.units), frame.units, strict=True):
        name = table.headed.get(plain, plain)
        other_unit = name not in (plain, right) and name in place_column(plain).names
        if other_unit or (stated or {}).get(name, unit) != unit:
            what = f"coordinates in {frame.crs!r} are in {unit}, wanted {right}"
            raise UserError(f"{table.path}:{table.skip + 1}: {name}: {what}")


def to_local(table: Table, xyz: NDArray[np.float64], frame: Frame) -> NDArray[np.float64]:
    """Coordinates in the local frame; a point that the CRS cannot carry is named by its line."""
    try:
        return np.asarray(frame.from_crs(xyz), dtype=float)
    except CrsError as error:
        for row in range(len(xyz)):
            try:
                frame.from_crs(xyz[row : row + 1])
            except CrsError:
                where = f"{table.path}:{table.line_of(row)}: {table.headed.get('X_m', 'X_m')}"
                hint = " (longitude first, then latitude)" if frame.units[0] == "deg" else ""
                raise UserError(f"{where}: {xyz[row].tolist()} lies outside the area of {frame.crs!r}{hint}") from None
        raise UserError(f"{table.path}: {error}") from None
