"""Which CRS the heights of a raster are in: the vertical datum is asked for where a file does not state it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from ...solver.adjustment.surface_control import SurfaceControl
from ...solver.geometry.frames import LocalFrame
from ...solver.orthoimage.ground_grid import heights_in_frame
from ...solver.orthoimage.surface import HeightField
from ..errors import UserError
from .geotiff import Heights, read_heights
from .projection import refuse_missing_grids

ELLIPSOID = "ellipsoid"
_WANTED = (
    f"wanted --dem-crs {ELLIPSOID} (heights above the ellipsoid), a vertical CRS such as EPSG:5773 (EGM96), "
    "or the whole, as EPSG:32632+EPSG:5773"
)


def read_dem(path: Path, dem_crs: str | None = None) -> Heights:
    """A raster of heights whose vertical datum is known.

    Parameters
    ----------
    path : raster
    dem_crs : ``ellipsoid``; a vertical CRS, which is put beside the horizontal one of the raster; or a CRS with
        heights in place of the raster's. None where the raster itself states the datum

    Raises
    ------
    UserError : a raster that cannot be read, a datum that nobody states, a geoid that PROJ does not have
    """
    import pyproj
    import pyproj.exceptions
    from pyproj.crs import CompoundCRS

    heights = read_heights(path)
    own = pyproj.CRS.from_user_input(heights.crs)
    if dem_crs is None:
        if heights.above_ellipsoid or len(own.axis_info) >= 3:
            return _checked(path, heights)
        raise UserError(f"{path}: {own.name!r} does not say what its heights count from, {_WANTED}")
    flat = own.sub_crs_list[0] if own.is_compound else own
    if dem_crs == ELLIPSOID:
        return _checked(path, replace(heights, crs=flat.to_wkt(), above_ellipsoid=True))
    try:
        given = pyproj.CRS.from_user_input(dem_crs)
        if given.is_vertical and not given.is_compound:
            given = CompoundCRS(f"{flat.name} + {given.name}", [flat, given])
    except pyproj.exceptions.CRSError as error:
        raise UserError(f"--dem-crs {dem_crs}: {str(error).splitlines()[0]}") from None
    if len(given.axis_info) < 3:
        raise UserError(f"--dem-crs {dem_crs}: says nothing of heights, {_WANTED}")
    return _checked(path, replace(heights, crs=given.to_wkt(), above_ellipsoid=False))


def _checked(path: Path, heights: Heights) -> Heights:
    import pyproj

    axes = pyproj.CRS.from_user_input(heights.crs).axis_info
    if heights.unit and (len(axes) < 3 or axes[2].unit_conversion_factor == 1.0):  # PROJ knows that of the CRS alone
        raise UserError(f"{path}: heights in {heights.unit}, wanted metres, or a vertical CRS with that unit")
    refuse_missing_grids(heights.crs, path)
    return heights


def dem_in_frame(path: Path, frame: LocalFrame, dem_crs: str | None = None) -> HeightField:
    """A raster of heights as a field in the local frame.

    Raises
    ------
    UserError : as `read_dem`, and where the raster lies far away
    """
    heights = read_dem(path, dem_crs)
    try:
        return heights_in_frame(frame, heights.crs, heights.z_m, heights.x0, heights.y0, heights.dx, heights.dy)
    except ValueError as error:
        raise UserError(f"{path}: {error}") from None


def surface_control(
    path: Path, frame: LocalFrame, dem_crs: str | None, sigma_m: float, shift_sigma_m: float | None = None
) -> SurfaceControl:
    """A raster of heights as control of the heights of tie points.

    Parameters
    ----------
    sigma_m : of a height, independent from place to place
    shift_sigma_m : of the error that all heights share; None = as large as `sigma_m`

    Raises
    ------
    UserError : as `dem_in_frame`
    """
    field = dem_in_frame(path, frame, dem_crs)
    return SurfaceControl(field.height, field.step_m, sigma_m, shift_sigma_m or sigma_m)
