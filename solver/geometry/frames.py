"""Between coordinate reference systems, the local frame and the platform's navigation frame."""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from . import earth
from .ellipsoid import Ellipsoid
from .rotation import (
    R_BC_NOMINAL,
    R_ENU_NED,
    angles_from_matrix,
    angles_jacobian,
    matrix_from_navigation,
    navigation_from_matrix,
)

Array = NDArray[np.floating]

#: Coordinates that need no PROJ, see `BodyFrame`.
GEOGRAPHIC = "geographic"
#: No point lies deeper, m: coordinates of a map, taken for geocentric ones, lie about the centre of the Earth.
DEEPEST_M = -1e5
#: Heights above two ellipsoids that differ by no more, m, are those above the same one, but for rounding.
SAME_ELLIPSOID_M = 1e-3
#: Axes X and Y that make a left-handed system with heights: it is a mirror image, and no angles turn an image to it.
_LEFT_HANDED = (("south", "west"), ("west", "north"), ("east", "south"))
#: WKT or a PROJ string with the code of a vertical CRS behind it.
_HEIGHTS_BEHIND = re.compile(r"(\]|\+proj=.*)\s*\+\s*[A-Za-z]+:\d+\s*$", re.DOTALL)
_UNITS = {"metre": "m", "degree": "deg", "grad": "grad", "foot": "ft", "US survey foot": "ft_us"}


class CrsError(ValueError):
    """A coordinate reference system that PROJ does not know, or cannot transform here."""


@dataclass(frozen=True)
class LocalFrame:
    """Topocentric east-north-up frame at an origin on the ellipsoid.

    Parameters
    ----------
    lat_deg, lon_deg, height_m : origin (WGS 84, ellipsoidal height)
    crs : what project files are written in: ``"local"`` (already this frame) or anything PROJ understands
    """

    lat_deg: float
    lon_deg: float
    height_m: float
    crs: str = "local"

    @cached_property
    def origin_e(self) -> Array:
        return earth.ecef_from_geodetic(np.radians(self.lat_deg), np.radians(self.lon_deg), self.height_m)

    @cached_property
    def R_el(self) -> Array:
        """Local to Earth-fixed."""
        return earth.R_en(np.radians(self.lat_deg), np.radians(self.lon_deg)) @ R_ENU_NED.T

    def from_geodetic(self, lat_deg: ArrayLike, lon_deg: ArrayLike, height_m: ArrayLike) -> Array:
        """Local coordinates (..., 3) in metres of WGS 84 latitude, longitude (degrees) and ellipsoidal height."""
        return (
            earth.ecef_from_geodetic(np.radians(lat_deg), np.radians(lon_deg), height_m) - self.origin_e
        ) @ self.R_el

    def to_geodetic(self, position_l: ArrayLike) -> Array:
        """``(lat_deg, lon_deg, height_m)``, (..., 3), of local coordinates (..., 3)."""
        g = earth.geodetic_from_ecef(np.asarray(position_l) @ self.R_el.T + self.origin_e)
        g[..., :2] = np.degrees(g[..., :2])
        return g

    def R_ln(self, position_l: ArrayLike) -> Array:
        """North-east-down at a position (..., 3) to the local frame; includes meridian convergence and curvature."""
        g = self.to_geodetic(position_l)
        return self.R_ln_at(g[..., 0], g[..., 1])

    def R_ln_at(self, lat_deg: ArrayLike, lon_deg: ArrayLike) -> Array:
        """The same at a latitude and longitude (...), degrees."""
        return self.R_el.T @ earth.R_en(np.radians(lat_deg), np.radians(lon_deg))

    def from_crs(self, xyz: ArrayLike) -> Array:
        """Local coordinates of points (n, 3) in the project CRS (east, north, height order; degrees if geographic).

        Raises
        ------
        CrsError : PROJ does not know the CRS or a point lies outside its area
        """
        xyz = np.asarray(xyz, dtype=float)
        if self.crs == "local":
            return xyz.copy()
        lon, lat, h = self._to_wgs84.transform(xyz[..., 0], xyz[..., 1], xyz[..., 2])
        out = self.from_geodetic(lat, lon, h)
        if not np.isfinite(out).all() or np.any(np.abs(lat) > 90.0) or np.any(h < DEEPEST_M):
            raise CrsError(f"coordinates outside the area of {self.crs!r}")
        return out

    def to_crs(self, position_l: ArrayLike, *, may_lie_outside: bool = False) -> Array:
        """Project CRS coordinates of local points (n, 3); NaN of those that are not known.

        Parameters
        ----------
        may_lie_outside : NaN, too, of points outside the area of the CRS

        Raises
        ------
        CrsError : PROJ does not know the CRS or a point lies outside its area
        """
        position_l = np.asarray(position_l, dtype=float)
        if self.crs == "local":
            return position_l.copy()
        g = self.to_geodetic(position_l)
        out = np.stack(self._to_wgs84.transform(g[..., 1], g[..., 0], g[..., 2], direction="INVERSE"), axis=-1)
        known = np.isfinite(position_l).all(axis=-1)
        if not (may_lie_outside or np.isfinite(out[known]).all()):
            raise CrsError(f"coordinates outside the area of {self.crs!r}")
        out[~(known & np.isfinite(out).all(axis=-1))] = np.nan
        return out

    def R_l_crs(self, xyz: ArrayLike) -> Array:
        """Rotation (n, 3, 3) from the CRS axes at points (n, 3) to the local frame: scale removed, convergence kept.

        Raises
        ------
        CrsError : as of `from_crs`; left-handed axes, to which no rotation leads
        """
        xyz = np.atleast_2d(np.asarray(xyz, dtype=float))
        if self.crs == "local":
            return np.broadcast_to(np.eye(3), (len(xyz), 3, 3)).copy()
        _refuse_left_handed(self._crs, self.crs)
        step = 1e-5 if self.is_geographic else 1.0
        columns = []
        for axis in range(3):
            d = np.zeros(3)
            d[axis] = 1.0 if axis == 2 else step
            v = self.from_crs(xyz + d) - self.from_crs(xyz - d)
            columns.append(v / np.linalg.norm(v, axis=-1, keepdims=True))
        U, _, Vt = np.linalg.svd(np.stack(columns, axis=-1))
        return U @ Vt

    @property
    def is_placed(self) -> bool:
        """Whether it is known where on the Earth the frame lies; a project in local coordinates may have no origin."""
        return not self.lat_deg == self.lon_deg == self.height_m == 0.0

    @property
    def is_geographic(self) -> bool:
        return self.crs != "local" and self._crs.is_geographic

    def near(self, x: ArrayLike, middle: float) -> Array:
        """X coordinates (...) in the CRS, longitudes counted so that they lie within half a turn of a middle."""
        x = np.asarray(x, dtype=float)
        if not self.is_geographic:
            return x
        circle = _circle(self._crs)
        return x - circle * np.round((x - middle) / circle)

    @property
    def units(self) -> tuple[str, str, str]:
        """Units of the coordinates in the project CRS: m, deg, grad, ft, ft_us; crs_unit for all others."""
        if self.crs == "local":
            return "m", "m", "m"
        names = [_UNITS.get(axis.unit_name, "crs_unit") for axis in self._crs.axis_info]
        return names[0], names[1], names[2] if len(names) > 2 else "m"

    @cached_property
    def _crs(self):
        return known_crs(self.crs)

    @cached_property
    def _to_wgs84(self):
        return _transformer(self._crs)

    @classmethod
    def around(cls, xyz: ArrayLike, crs: str) -> LocalFrame:
        """Frame at the middle of points (n, 3) given in ``crs``, on the ellipsoid below them (height 0).

        Raises
        ------
        CrsError : PROJ does not know the CRS, a point lies outside its area, or its axes are left-handed
        """
        if crs == "local":
            return cls(0.0, 0.0, 0.0)
        xyz, parsed = np.array(np.atleast_2d(xyz), dtype=float), known_crs(crs)
        _refuse_left_handed(parsed, crs)
        if parsed.is_geographic:
            circle = _circle(parsed)
            if np.ptp(xyz[:, 0]) > 0.5 * circle:  # on both sides of the date line
                xyz[:, 0] %= circle
        x, y, z = np.mean(xyz, axis=0)
        to_wgs84 = _transformer(parsed)
        lon, lat, _ = to_wgs84.transform(x, y, z)
        if not np.isfinite([lon, lat]).all():
            raise CrsError(f"coordinates outside the area of {crs!r}")
        frame = cls(round(float(lat), 6), round(float((lon + 180.0) % 360.0 - 180.0), 6), 0.0, crs)
        frame.__dict__["_to_wgs84"] = to_wgs84  # PROJ takes a fifth of a second to look for one with a geoid
        return frame


@dataclass(frozen=True)
class BodyFrame:
    """Body-fixed axes, with files in longitude, latitude (degrees) and height on an ellipsoid: of any planet, no PROJ.

    Parameters
    ----------
    ellipsoid : of the coordinates
    """

    ellipsoid: Ellipsoid
    crs: str = GEOGRAPHIC
    is_geographic: bool = True
    units: tuple[str, str, str] = ("deg", "deg", "m")

    @property
    def origin_e(self) -> Array:
        return np.zeros(3)

    @property
    def R_el(self) -> Array:
        return np.eye(3)

    def from_crs(self, xyz: ArrayLike) -> Array:
        """Positions (n, 3) of longitude, latitude (degrees) and height.

        Raises
        ------
        CrsError : a latitude beyond 90 degrees
        """
        x = np.asarray(xyz, dtype=float)
        if np.any(np.abs(x[..., 1]) > 90.0):
            raise CrsError("a latitude beyond 90 degrees")
        return self.ellipsoid.cartesian(np.radians(x[..., 1]), np.radians(x[..., 0]), x[..., 2])

    def to_crs(self, position_l: ArrayLike) -> Array:
        """Longitude, latitude (degrees) and height (n, 3) of positions."""
        g = self.ellipsoid.geodetic(position_l)
        return np.stack([np.degrees(g[..., 1]), np.degrees(g[..., 0]), g[..., 2]], axis=-1)

    def R_l_crs(self, xyz: ArrayLike) -> Array:
        """East, north and up (n, 3, 3) at points (n, 3)."""
        x = np.radians(np.atleast_2d(np.asarray(xyz, dtype=float)))
        return earth.R_en(x[:, 1], x[:, 0]) @ R_ENU_NED.T


#: A Cartesian frame with the coordinates that files are written in.
Frame = LocalFrame | BodyFrame


def known_crs(crs: str, *, geocentric: bool = True):
    """The CRS of pyproj, which gives a place: not heights alone.

    Parameters
    ----------
    geocentric : whether it may be geocentric, in which points have coordinates, but maps have none

    Raises
    ------
    CrsError : PROJ does not know it, or it is of another kind
    """
    import pyproj.exceptions

    # PROJ reads as far as the last bracket, and passes over words of a PROJ string that it does not know
    if _HEIGHTS_BEHIND.search(crs):
        raise CrsError(f"crs {crs!r}: a vertical CRS behind '+' goes with codes, wanted them as one compound WKT")
    try:
        known = pyproj.CRS.from_user_input(crs)
    except pyproj.exceptions.CRSError as error:
        raise CrsError(f"PROJ does not know the CRS {crs!r}: {str(error).splitlines()[0]}") from None
    if known.is_projected or known.is_geographic or (geocentric and known.is_geocentric):
        return known
    kind = "a geocentric" if known.is_geocentric else "a vertical" if known.is_vertical else "another"
    raise CrsError(f"crs {crs!r}: {kind} system, wanted a projected or geographic one (with heights)")


def outside_area(crs: str, lat_deg: float, lon_deg: float) -> tuple[float, str]:
    """How far, in degrees, a place lies outside of the area that a CRS is made for, and the bounds of that in words.

    0 inside it, and where nobody states an area.

    Raises
    ------
    CrsError : PROJ does not know the CRS
    """
    area = known_crs(crs).area_of_use
    if area is None:
        return 0.0, ""
    width = (area.east - area.west) % 360.0 or 360.0
    east = (lon_deg - area.west) % 360.0
    beside = 0.0 if east <= width else min(east - width, 360.0 - east)
    bounds = f"latitude {area.south:g} to {area.north:g}, longitude {area.west:g} to {area.east:g} deg"
    return max(beside, lat_deg - area.north, area.south - lat_deg, 0.0), bounds


def _refuse_left_handed(known, crs: str) -> None:
    """Raise CrsError where an image has no omega, phi, kappa in the axes of a CRS."""
    axes, height = tuple(axis.direction.lower() for axis in known.axis_info[:2]), known.axis_info[2:]
    if height and height[0].direction.lower() == "down":
        what = "its heights count downwards, and angles in a left-handed system are none"
        raise CrsError(f"crs {crs!r}: {what}, wanted the one of the same map with heights upwards")
    if axes in _LEFT_HANDED:
        what = f"its axes go {' and '.join(axes)}, and angles in a left-handed system are none"
        raise CrsError(f"crs {crs!r}: {what}, wanted the one of the same map with axes to the east and north")


def _circle(crs) -> float:
    """The longitude once round the Earth in the units of a geographic CRS."""
    return 2.0 * np.pi / crs.axis_info[0].unit_conversion_factor


class _HeightsOfWGS84:
    """A transformer of a CRS without heights: these count from the ellipsoid of WGS 84, as those of GNSS do.

    PROJ takes them from the ellipsoid of the CRS, 40 to 50 m from it in national systems of Europe; and where it has an
    operation in the plane alone, as in parts of EPSG:5514, from WGS 84's, with a step between.
    """

    def __init__(self, of_own_ellipsoid):
        self._transformer = of_own_ellipsoid

    def transform(self, x, y, z, direction="FORWARD"):
        """Longitude, latitude and height of east, north and height, or the reverse; as of PROJ."""
        first, second, third = self._transformer.transform(x, y, z, direction=direction)
        above = np.subtract(third, z)
        if direction == "FORWARD" and (np.abs(above) > SAME_ELLIPSOID_M).any():
            # the places have other heights above the ellipsoid of the CRS
            first, second, _ = self._transformer.transform(x, y, np.subtract(z, above))
        return first, second, np.where(np.isfinite(third), z, third)[()]


def _transformer(crs):
    """To WGS 84 with ellipsoidal heights; where PROJ has the geoid of the heights, of its area alone.

    Beyond it PROJ would take heights as they stand, and a block would have a step at a border.
    """
    import pyproj.exceptions

    target = pyproj.CRS.from_epsg(4979)
    if crs.is_compound:
        try:
            return pyproj.Transformer.from_crs(crs, target, always_xy=True, allow_ballpark=False)
        except pyproj.exceptions.ProjError:  # it has not; that is told by whoever reads the CRS
            pass
    try:
        if len(crs.axis_info) < 3:
            return _HeightsOfWGS84(pyproj.Transformer.from_crs(crs.to_3d(), target, always_xy=True))
        return pyproj.Transformer.from_crs(crs, target, always_xy=True)
    except pyproj.exceptions.ProjError as error:
        raise CrsError(f"PROJ cannot transform {crs.name!r} to WGS 84: {str(error).splitlines()[0]}") from None


def R_lc_from_navigation(
    frame: LocalFrame, position_l: ArrayLike, rpy: ArrayLike, R_bc: ArrayLike = R_BC_NOMINAL
) -> Array:
    """Image-to-local rotation (n, 3, 3) from roll, pitch, heading (n, 3) in radians at local positions (n, 3)."""
    rpy = np.asarray(rpy, dtype=float)
    return frame.R_ln(position_l) @ matrix_from_navigation(rpy[..., 0], rpy[..., 1], rpy[..., 2]) @ np.asarray(R_bc)


def navigation_from_R_lc(
    frame: LocalFrame, position_l: ArrayLike, R_lc: ArrayLike, R_bc: ArrayLike = R_BC_NOMINAL
) -> Array:
    """Roll, pitch, heading (n, 3) in radians of image-to-local rotations; inverse of `R_lc_from_navigation`."""
    R_nl = np.swapaxes(frame.R_ln(position_l), -1, -2)
    return navigation_from_matrix(R_nl @ np.asarray(R_lc) @ np.asarray(R_bc).T)


def opk_covariance_from_navigation(rpy: ArrayLike, R_lc: ArrayLike, R_ln: ArrayLike, cov_rpy: ArrayLike) -> Array:
    """Covariance (..., 3, 3) of omega, phi, kappa from that of roll, pitch, heading; all radians."""
    J = _opk_of_rpy(rpy, R_lc, R_ln)
    return J @ np.asarray(cov_rpy) @ np.swapaxes(J, -1, -2)


def navigation_covariance_from_opk(rpy: ArrayLike, R_lc: ArrayLike, R_ln: ArrayLike, cov_opk: ArrayLike) -> Array:
    """Covariance (..., 3, 3) of roll, pitch, heading from that of omega, phi, kappa; all radians; inverse of
    `opk_covariance_from_navigation`."""
    J = np.linalg.inv(_opk_of_rpy(rpy, R_lc, R_ln))
    return J @ np.asarray(cov_opk) @ np.swapaxes(J, -1, -2)


def _opk_of_rpy(rpy: ArrayLike, R_lc: ArrayLike, R_ln: ArrayLike) -> Array:
    """Derivatives (..., 3, 3) of omega, phi, kappa with respect to roll, pitch, heading."""
    rpy = np.asarray(rpy, dtype=float)
    sp, cp = np.sin(rpy[..., 1]), np.cos(rpy[..., 1])
    sh, ch = np.sin(rpy[..., 2]), np.cos(rpy[..., 2])
    axes_n = np.zeros((*rpy.shape[:-1], 3, 3))  # columns: where roll, pitch and heading turn about
    axes_n[..., 0, 0], axes_n[..., 1, 0], axes_n[..., 2, 0] = ch * cp, sh * cp, -sp
    axes_n[..., 0, 1], axes_n[..., 1, 1] = -sh, ch
    axes_n[..., 2, 2] = 1.0
    return angles_jacobian(angles_from_matrix(R_lc)) @ np.asarray(R_ln) @ axes_n
