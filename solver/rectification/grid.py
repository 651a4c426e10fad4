"""The cells of an orthoimage in any CRS, and where they lie on the Earth."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..geometry.ellipsoid import WGS84, Ellipsoid
from ..geometry.frames import known_crs

Array = NDArray[np.floating]


@dataclass(frozen=True)
class MapGrid:
    """Cells in a map projection or in degrees; columns go with x, rows against y.

    Attributes
    ----------
    crs : what PROJ understands
    left, top : CRS coordinates of the upper left corner of the first cell
    gsd : size of a cell, units of the CRS
    rows, columns : of the orthoimage
    ellipsoid : latitudes and longitudes are on it
    """

    crs: str
    left: float
    top: float
    gsd: float
    rows: int
    columns: int
    ellipsoid: Ellipsoid = WGS84

    @cached_property
    def _transformer(self) -> Any:
        """From latitude and longitude to the horizontal CRS."""
        return transformer_to(self.crs, self.ellipsoid)

    def where(self, column: Array, row: Array) -> tuple[Array, Array]:
        """Latitude and longitude (n,), radians, of columns and rows (n,); NaN outside the CRS."""
        x = self.left + (np.asarray(column) + 0.5) * self.gsd
        y = self.top - (np.asarray(row) + 0.5) * self.gsd
        lon, lat = self._transformer.transform(x, y, direction="INVERSE")
        lat, lon = np.asarray(lat, dtype=float), np.asarray(lon, dtype=float)
        good = np.isfinite(lat) & np.isfinite(lon)
        return np.radians(np.where(good, lat, np.nan)), np.radians(np.where(good, lon, np.nan))

    def cells(self, lat: ArrayLike, lon: ArrayLike) -> tuple[Array, Array]:
        """Column and row (n,) of latitudes and longitudes (n,), radians."""
        x, y = self.map(lat, lon)
        return (x - self.left) / self.gsd - 0.5, (self.top - y) / self.gsd - 0.5

    def map(self, lat: ArrayLike, lon: ArrayLike) -> tuple[Array, Array]:
        """CRS coordinates (n,) of latitudes and longitudes (n,), radians; NaN where there are none."""
        x, y = self._transformer.transform(np.degrees(lon), np.degrees(lat))
        x, y = np.asarray(x, dtype=float), np.asarray(y, dtype=float)
        return np.where(np.isfinite(x), x, np.nan), np.where(np.isfinite(y), y, np.nan)

    def over(self, x: Array, y: Array, margin: float = 1.0) -> MapGrid:
        """The same cells over points in CRS coordinates, edges at whole multiples of the cell size.

        Raises
        ------
        ValueError : no point
        """
        if not (np.isfinite(x).any() and np.isfinite(y).any()):
            raise ValueError("no point lies in the area of the CRS")
        # what a bound is off by rounding is no reason for one more cell
        first = np.floor(np.array([np.nanmin(x), np.nanmin(y)]) / self.gsd + 1e-6) - margin
        last = np.ceil(np.array([np.nanmax(x), np.nanmax(y)]) / self.gsd - 1e-6) + margin
        columns, rows = (int(n) for n in last - first)
        left, top = float(first[0] * self.gsd), float(last[1] * self.gsd)
        return MapGrid(self.crs, left, top, self.gsd, rows, columns, self.ellipsoid)


def transformer_to(crs: str, ellipsoid: Ellipsoid = WGS84) -> Any:
    """PROJ transformer from longitude and latitude (degrees) to the horizontal part of a CRS.

    Raises
    ------
    ValueError : PROJ does not know the CRS, it has no horizontal part, or it is of another planet
    """
    import pyproj
    from pyproj.exceptions import ProjError

    flat = known_crs(crs, geocentric=False)
    if flat.is_compound:
        flat = flat.sub_crs_list[0]
    if len(flat.axis_info) > 2:
        flat = flat.to_2d()
    axis = 0.0 if flat.ellipsoid is None else flat.ellipsoid.semi_major_metre
    if abs(axis / ellipsoid.semi_major_m - 1.0) > 1e-3:
        raise ValueError(f"{crs!r} is of another planet than the sensor's")
    base = "EPSG:4326" if abs(ellipsoid.semi_major_m / WGS84.semi_major_m - 1.0) < 1e-6 else flat.geodetic_crs
    try:
        return pyproj.Transformer.from_crs(base, flat, always_xy=True)
    except ProjError as error:
        raise ValueError(f"PROJ cannot transform to {crs!r}: {str(error).splitlines()[0]}") from None


def default_crs(lat: float, lon: float, ellipsoid: Ellipsoid = WGS84) -> str:
    """The UTM zone (on other planets: transverse Mercator through the place; at poles: stereographic), radians."""
    if abs(ellipsoid.semi_major_m / WGS84.semi_major_m - 1.0) > 1e-6:
        axes = f"+a={ellipsoid.semi_major_m} +b={ellipsoid.semi_minor_m} +units=m +no_defs"
        return f"+proj=tmerc +lat_0={np.degrees(lat):.6f} +lon_0={np.degrees(lon):.6f} {axes}"
    if lat > np.radians(84.0):
        return "EPSG:3413"
    if lat < np.radians(-80.0):
        return "EPSG:3031"
    zone = int((np.degrees(lon) + 180.0) // 6.0) % 60 + 1
    return f"EPSG:{(32600 if lat >= 0 else 32700) + zone}"
