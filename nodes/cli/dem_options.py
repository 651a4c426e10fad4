"""Options of commands that take heights of a raster as control of tie points."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from ..config import elevation
from ..errors import UserError, flag

_OF_DEM = ("dem_sigma", "dem_shift_sigma", "dem_crs")


def add_dem_options(group: argparse._ArgumentGroup) -> None:
    """Add ``--dem`` and what belongs to it."""
    group.add_argument(
        "--dem", type=Path, metavar="FILE",
        help="heights of a raster as control of all tie points; a flight folder: its [dem]",
    )  # fmt: skip
    group.add_argument("--dem-sigma", type=float, metavar="M", help="of these heights, 1 sigma; wanted with --dem")
    group.add_argument(
        "--dem-shift-sigma", type=float, metavar="M",
        help="of the error that all these heights share, 1 sigma (as --dem-sigma)",
    )  # fmt: skip
    group.add_argument(
        "--dem-crs", metavar="CRS",
        help="of the raster: 'ellipsoid', a vertical CRS (EPSG:5773), or the whole, where it does not say",
    )  # fmt: skip


def dem_settings(args: argparse.Namespace) -> dict[str, Any]:
    """The adjuster's settings ``dem``, ``dem_sigma_m``, ``dem_shift_sigma_m``, ``dem_crs`` that the options state.

    Raises
    ------
    UserError : a raster without sigma, or what belongs to a raster without one
    """
    given = {name: value for name in _OF_DEM if (value := getattr(args, name)) is not None}
    if args.dem is not None and (args.dem / "flight.toml").is_file():
        if given:
            raise UserError(f"{flag(next(iter(given)))}: [dem] of {args.dem / 'flight.toml'} says it")
        return elevation(args.dem / "flight.toml", wanted=True)
    if args.dem is not None and "dem_sigma" not in given:
        raise UserError("--dem and --dem-sigma: wanted both, the raster and the sigma of its heights")
    for name, value in given.items():
        option = flag(name)
        if args.dem is None:
            raise UserError(f"{option} {value}: is of a raster of heights, wanted --dem FILE with it")
        if name != "dem_crs" and not 0 < value < float("inf"):
            raise UserError(f"{option} {value:g}, wanted more than 0")
    if args.dem is None:
        return {}
    return {"dem": str(args.dem)} | {name + "_m" * (name != "dem_crs"): value for name, value in given.items()}
