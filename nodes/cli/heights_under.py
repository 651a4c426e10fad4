"""Rasters of heights that a command line names, and between which heights they lie under what a sensor sees."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...solver.location.frame_camera import FrameCamera
from ..errors import UserError
from ..formats.height_raster import HeightRaster
from .named_files import named_files

Array = NDArray[np.floating]

#: Rounds in which pixels are looked up between the heights of the round before; they end where none is new.
MOST_ROUNDS = 10
#: Rays are looked at from so far below a frame camera on; the terrain is searched from one metre more.
BELOW_CAMERA_M = 2.0
#: Rasters that are looked for in a folder of heights.
_NAMES = (".hgt", ".tif", ".tiff", ".bil", ".img", ".dt1", ".dt2", ".vrt")
#: Note on sigmas of an orthoimage whose heights nobody has said anything about.
NO_HEIGHT_SIGMA = "sigma: the heights of the ground are taken as without error; --height-sigma states theirs"


def rasters_of_heights(names: Iterable[str]) -> list[Path]:
    """Rasters that are named, and those in folders.

    Raises
    ------
    UserError : a folder without any
    """
    return named_files(map(Path, names), _NAMES, "rasters of heights")


class NothingUnder(UserError):
    """No height of a raster is known under any of the pixels."""


def height_range(
    places: Callable[[float], tuple[Array, Array]], raster: HeightRaster, guess_m: float, sensor: object, what: str
) -> tuple[float, float]:
    """Lowest and highest height above the ellipsoid of the raster under pixels.

    Parameters
    ----------
    places : latitudes and longitudes (n,), radians, of the pixels at a height, NaN where they miss
    guess_m : height at which to look first; where the raster has none there, along the rays between its own heights
    sensor, what : named in errors: the metadata, and whose pixels they are

    Raises
    ------
    NothingUnder : the pixels do not see the ground, or the raster does not lie there
    """
    low = high = guess_m
    known = np.inf, -np.inf
    for _ in range(MOST_ROUNDS):
        lat, lon = _seen(places, {low, high})
        if not len(lat):
            raise NothingUnder(f"{sensor}: {what} see no ground at {low:g} m")
        found = raster.range_over(lat, lon)
        if found is None and not np.isfinite(known).all():
            found = _along_rays(places, raster, lat, lon)
        if found is None:
            degrees = f"{np.degrees(lat.mean()):.4f} N, {np.degrees(lon.mean()):.4f} E"
            raise NothingUnder(f"{raster.name}: does not cover {what} around {degrees}")
        low, high = min(known[0], found[0]), max(known[1], found[1])
        if (low, high) == known:
            break
        known = low, high
    return low, high


def below_camera(model: object, low_m: float, high_m: float) -> tuple[float, float]:
    """Lowest and highest height of a terrain that the sensor can see: a frame camera sees what is below it alone."""
    if isinstance(model, FrameCamera):
        high_m = min(high_m, float(model.ellipsoid.geodetic(model.position_e)[2]) - BELOW_CAMERA_M)
    return min(low_m, high_m), high_m


def _along_rays(
    places: Callable[[float], tuple[Array, Array]], raster: HeightRaster, lat: Array, lon: Array
) -> tuple[float, float] | None:
    """The heights under rays between the lowest and the highest height of the whole raster; None for none."""
    whole = raster.range_over(lat, lon, everywhere=True)
    if whole is None:
        return None
    lat, lon = _seen(places, set(whole))
    return raster.range_over(lat, lon) if len(lat) else None


def _seen(places: Callable[[float], tuple[Array, Array]], heights_m: set[float]) -> tuple[Array, Array]:
    """Latitudes and longitudes of the pixels at heights, of those that do not miss."""
    lat, lon = (np.concatenate(a) for a in zip(*(places(h) for h in sorted(heights_m)), strict=True))
    return lat[np.isfinite(lat)], lon[np.isfinite(lat)]
