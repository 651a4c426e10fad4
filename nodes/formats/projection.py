"""Map projections of files that give no more than easting and northing."""

from __future__ import annotations

import re
import warnings
from functools import cache, cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...solver.geometry.ellipsoid import WGS84
from ...solver.geometry.frames import CrsError, LocalFrame, known_crs
from ..errors import UserError

#: A CRS by the code of an authority.
_CODE = re.compile(r"[A-Za-z]+:\d+")
#: A CRS that is written with more letters (WKT) is told by its name.
LONGEST_NAME = 60


class Projection:
    """A projected CRS: to longitude and latitude (WGS 84), and its meridian convergence.

    Raises
    ------
    CrsError : a CRS that PROJ does not know or that is not projected
    """

    def __init__(self, crs: str):
        self._crs = known_crs(crs)
        if not self._crs.is_projected:
            raise CrsError(f"{crs!r} is not a projected CRS, wanted one with easting and northing")

    def to_lonlat(self, x: ArrayLike, y: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Longitude and latitude (n,) in degrees of easting and northing (n,)."""
        lon, lat = self._to_wgs84.transform(np.asarray(x), np.asarray(y))
        if not (np.isfinite(lon).all() and np.isfinite(lat).all()):
            raise CrsError(f"coordinates outside the area of {self._crs.name!r}")
        return lon, lat

    def convergence(self, lon_deg: ArrayLike, lat_deg: ArrayLike) -> NDArray[np.float64]:
        """Meridian convergence (n,) in radians: true heading minus heading against grid north."""
        import pyproj

        factors = pyproj.Proj(self._crs).get_factors(np.asarray(lon_deg), np.asarray(lat_deg))
        return np.radians(factors.meridian_convergence)

    @cached_property
    def _to_wgs84(self):
        import pyproj

        return pyproj.Transformer.from_crs(self._crs, "EPSG:4326", always_xy=True)


def with_heights(crs: str, datum: str) -> str:
    """A horizontal and a vertical CRS as one: by their codes, or as WKT where one of them has none.

    Raises
    ------
    CrsError : PROJ does not know one of them, or cannot put them together
    """
    codes = crs.strip(), datum.strip()
    if all(_CODE.fullmatch(code) for code in codes):
        return "+".join(codes)
    from pyproj.crs import CRS, CompoundCRS
    from pyproj.exceptions import CRSError

    try:
        flat, heights = known_crs(crs), CRS.from_user_input(datum)
        return CompoundCRS(f"{flat.name} + {heights.name}", [flat, heights]).to_wkt()
    except CRSError as error:
        raise CrsError(f"{crs!r} with heights in {datum!r}: {str(error).splitlines()[0]}") from None


def unit_of(crs: str) -> str:
    """Unit of the coordinates of a map: m, ft, ft_us, deg, grad, or crs_unit."""
    return LocalFrame(0.0, 0.0, 0.0, crs).units[0]


def missing_grids(crs: str) -> list[str]:
    """Names of the grids (geoids, datum shifts) that PROJ's best path from a CRS to WGS 84 needs and cannot find.

    Raises
    ------
    CrsError : as of `known_crs`
    """
    return list(_missing_grids(crs))


@cache
def _missing_grids(crs: str) -> tuple[str, ...]:
    """The same; PROJ takes half a second for heights of some countries, and which grids there are stays as it is."""
    from pyproj.transformer import TransformerGroup

    known = known_crs(crs)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        group = TransformerGroup(known if len(known.axis_info) == 3 else known.to_3d(), "EPSG:4979", always_xy=True)
    if group.best_available:
        return ()
    return tuple(sorted({g.short_name for way in group.unavailable_operations for g in way.grids if not g.available}))


def off_without_grids(crs: str) -> str:
    """What would be off without the grids that `missing_grids` names, and by what; "" where it names none."""
    grids = set(missing_grids(crs))
    shifts = set(missing_grids(_horizontal(crs).to_string())) if grids else set()
    parts = ["positions would be off by the datum shift"] * bool(grids & shifts)
    parts += ["heights would be off by the geoid"] * bool(grids - shifts)
    return ", ".join(parts)


@cache
def unknown_heights(crs: str) -> str:
    """Name of the vertical part of a CRS, if PROJ knows no way from it to the ellipsoid, whatever grids there are.

    "" where it knows one, and of a CRS without a vertical part.

    PROJ takes such heights for ellipsoidal ones, as it does where a grid is missing (`missing_grids`).

    Raises
    ------
    CrsError : as of `known_crs`
    """
    from pyproj.crs import CompoundCRS
    from pyproj.exceptions import ProjError
    from pyproj.transformer import Transformer, TransformerGroup

    known = known_crs(crs)
    if not known.is_compound:
        return ""
    vertical = known.sub_crs_list[1]
    alone = CompoundCRS("WGS 84 and heights", ["EPSG:4326", vertical])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        if TransformerGroup(alone, "EPSG:4979", always_xy=True).unavailable_operations:
            return ""
        try:
            Transformer.from_crs(alone, "EPSG:4979", always_xy=True, allow_ballpark=False)
        except ProjError:
            return str(vertical.name)
    return ""


def notes_of_heights(crs: str) -> list[str]:
    """What is to be said of places in a CRS that PROJ cannot bring to WGS 84 as they are meant, here or anywhere.

    Raises
    ------
    CrsError : as of `known_crs`
    """
    if crs == "local":
        return []
    if grids := missing_grids(crs):
        what = "heights or positions may be off by the geoid or datum shift, all alike"
        return [f"PROJ has no grid {', '.join(grids[:3])} here for {crs!r}; {what}"]
    if name := unknown_heights(crs):
        return [f"PROJ knows no geoid of {name!r}: heights count as ellipsoidal ones and may be off by it, all alike"]
    return []


def notes_of_map(crs: str, given: str = "local", what: str = "the map") -> list[str]:
    """What is to be said of a map in a CRS to which PROJ knows a better way from WGS 84 than it has grids for.

    Parameters
    ----------
    crs : of the map; nothing is said of one in the local frame or of another planet
    given : of the control that places rest on: what it is off by, the way back to the same CRS takes off again
    what : in words, what lies in the CRS

    Raises
    ------
    CrsError : as of `known_crs`
    """
    if crs == "local":
        return []
    flat = _horizontal(crs)
    ellipsoid = flat.ellipsoid
    if ellipsoid is None or abs(ellipsoid.semi_major_metre / WGS84.semi_major_m - 1.0) > 1e-3:
        return []
    if given != "local" and flat == _horizontal(given):
        return []
    grids = missing_grids(flat.to_string())
    off = f"{what} may be off by the datum shift, metres, all alike"
    name = crs if len(crs) < LONGEST_NAME else flat.name
    return [
        f"PROJ has no grid {', '.join(grids[:3])} here for {name!r}; {off} (`projsync --file {grid}` fetches it)"
        for grid in grids[:1]
    ]


def _horizontal(crs: str):
    """The part of a CRS of pyproj without heights."""
    known = known_crs(crs)
    return known.sub_crs_list[0] if known.is_compound else known


def refuse_missing_grids(crs: str, where: object) -> None:
    """Raise UserError where PROJ would take heights in a CRS for ellipsoidal ones, because it lacks the geoid or knows
    none, or where it has no place for a point.
    """
    try:
        grids = [] if crs == "local" else missing_grids(crs)
        unknown = "" if crs == "local" or grids else unknown_heights(crs)
    except CrsError as error:
        raise UserError(f"{where}: {error}") from None
    if grids:
        name = known_crs(crs).name
        raise UserError(
            f"{where}: PROJ lacks the grid {', '.join(grids[:3])} for {name!r}: {off_without_grids(crs)} "
            f"(`projsync --file {grids[0]}` fetches it)"
        )
    if unknown:
        raise UserError(
            f"{where}: PROJ knows no geoid of {unknown!r} in {known_crs(crs).name!r}: heights would be off by it; "
            "wanted heights above the ellipsoid, or a vertical CRS with a geoid"
        )
