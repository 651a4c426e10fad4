"""Coordinates of places in tables: the names of their columns state the unit that they have in the project's CRS."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from ...schemas.units import PLACE_UNITS, place_columns
from ...solver.geometry.frames import Frame
from ..errors import UserError
from .table import Column

#: Columns of a place as tables that are read have them, in metres or in whatever unit the CRS has.
PLACE = place_columns()


def place_column(name: str, *, blank: bool = False) -> Column:
    """The column of a coordinate of `PLACE`, under that name or with another unit (``X_deg``)."""
    others = tuple(f"{name[0]}_{unit}" for unit in PLACE_UNITS[1:])
    return Column(name, blank=blank, other_names=others)


def check_place_units(path: Path, headed: Mapping[str, str], frame: Frame) -> None:
    """Refuse columns with a unit that the CRS has not; the plain names ``X_m, Y_m, Z_m`` stand for any.

    Parameters
    ----------
    path, headed : of a `Table`
    frame : with the CRS of the coordinates

    Raises
    ------
    UserError : ``file:1: column: what its coordinates are in``
    """
    for plain, right, unit in zip(PLACE, place_columns(frame.units), frame.units, strict=True):
        name = headed.get(plain, plain)
        if name not in (plain, right):
            raise UserError(f"{path}:1: {name}: coordinates in {frame.crs!r} are in {unit}, wanted {right}")
