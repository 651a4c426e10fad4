"""What options say of the location of pixels: the air, sigmas, heights of a raster."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ...solver.geometry.ellipsoid import WGS84, Ellipsoid
from ...solver.location.refraction import STANDARD, Atmosphere, Refraction
from ...solver.location.rpc import Rpc
from ...solver.location.uncertainty import Sigmas
from ..errors import UserError, flag

#: Option (as attribute) -> the field of `Sigmas` that it states.
_SIGMAS: dict[str, Callable[[Any], dict[str, Any]]] = {
    "position_sigma": lambda m: {"position_m": tuple(m)},
    "attitude_sigma": lambda deg: {"attitude_rad": tuple(np.radians(deg).tolist())},
    "time_sigma": lambda s: {"time_s": s},
    "pixel_sigma": lambda px: {"pixel": (px, px)},
    "height_sigma": lambda m: {"height_m": m},
}


def add_orientation_sigmas(parser: argparse.ArgumentParser | argparse._ArgumentGroup) -> None:
    """``--position-sigma`` and ``--attitude-sigma`` of any sensor."""
    parser.add_argument(
        "--position-sigma", type=float, nargs=3, metavar=("ALONG", "ACROSS", "UP"),
        help="of the orbit, m; of a frame camera east, north, up",
    )  # fmt: skip
    parser.add_argument(
        "--attitude-sigma", type=float, nargs=3, metavar=("X", "Y", "Z"),
        help="roll, pitch, yaw of the satellite, degrees; of a frame camera about east, north, up",
    )  # fmt: skip


def stated_sigmas(args: argparse.Namespace, stated: Sigmas) -> Sigmas:
    """Sigmas of the command line, and those stated elsewhere where it has none.

    Raises
    ------
    UserError : a sigma that is negative or not finite
    """
    options = [name for name in _SIGMAS if hasattr(args, name)]
    try:
        for name in options:
            if (value := getattr(args, name)) is not None:
                stated = replace(stated, **_SIGMAS[name](value))
    except ValueError:
        raise UserError(f"{', '.join(map(flag, options))}: wanted numbers of at least 0") from None
    return stated


def with_refraction(args: argparse.Namespace, model: Any) -> Any:
    """The model with the air that the command line asks for.

    Raises
    ------
    UserError : a model that knows no rays, and as of `refraction_of`
    """
    if args.refraction is None:
        return model
    if isinstance(model, Rpc):
        raise UserError(f"{args.sensor}: --refraction goes with a rigorous model, this is an RPC")
    return model.with_refraction(refraction_of(args.refraction, model.ellipsoid, args.sensor))


def refraction_of(values: Sequence[float], ellipsoid: Ellipsoid, what: str) -> Refraction:
    """The air that ``--refraction`` asks for, over the ellipsoid of what is located.

    Raises
    ------
    UserError : another planet, another number of values than none and three, values that no air has
    """
    if abs(ellipsoid.semi_major_m / WGS84.semi_major_m - 1.0) > 1e-3:
        raise UserError(f"{what}: --refraction knows the air of the Earth only, this is another planet")
    if len(values) not in (0, 3):
        raise UserError(
            f"--refraction: {len(values)} values, wanted none, or temperature (K), pressure (hPa) and vapour "
            "pressure (hPa)"
        )
    try:
        return Refraction(Atmosphere(*values) if values else STANDARD, ellipsoid)
    except ValueError as error:
        raise UserError(f"--refraction: {error}") from None


def refuse_datum_without_raster(args: argparse.Namespace) -> None:
    """Raise UserError for options that say what heights of a raster are above, where there is no raster."""
    for name in ("dem_crs", "dem_datum"):
        if getattr(args, name) is not None and not args.dem:
            raise UserError(f"{flag(name)}: goes with --dem")
