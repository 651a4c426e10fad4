"""Heights of the ground out of one or several rasters, window by window, with the vertical datum that was stated."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...solver.geometry.ellipsoid import WGS84, Ellipsoid
from ...solver.rectification.terrain import bilinear, squares
from ..errors import UserError
from .keys import is_there
from .projection import notes_of_map
from .raster_open import known_heights, open_raster, unit_of_heights

Array = NDArray[np.floating]

#: What ``--dem-datum`` may be, in words.
DATUMS = "ellipsoid, a vertical CRS (EPSG:5773), a raster of geoid heights, or the geoid's height in metres"
ELLIPSOID = ("ellipsoid", "ellipsoidal")
#: Ellipsoids whose half axes differ by a larger share are of different planets.
SAME_PLANET = 1e-3
#: The range of heights is looked up in at most so many values a side; then it is widened by so much, metres. Tuned.
MOST_SIDE, THIN_SLACK_M = 3000, 100.0
#: Places that are beyond the outer values by less, cells, are so by rounding alone.
EDGE_CELLS = 1e-6


class RasterFile:
    """One raster, open once in every thread that reads it.

    Parameters
    ----------
    path : of the raster
    overviews : see `open_raster`

    Raises
    ------
    UserError : not there, not a raster
    """

    def __init__(self, path: Path, *, overviews: bool = True):
        from rasterio.errors import RasterioError

        self.path, self._overviews = path, overviews
        self._local = threading.local()
        if not is_there(path):
            raise UserError(f"{path}: no such file")
        try:
            source = self.source
        except RasterioError as error:
            raise UserError(f"{path}: not a raster that can be read: {' '.join(str(error).split())}") from None
        self.rows, self.columns, self.count = source.height, source.width, source.count
        self.crs, self.transform, self.dtype = source.crs, source.transform, np.dtype(source.dtypes[0])

    @property
    def source(self) -> Any:
        """The dataset of this thread."""
        if not hasattr(self._local, "source"):
            self._local.source = open_raster(self.path, overviews=self._overviews)
        return self._local.source


class HeightRaster:
    """Heights of one or several rasters on one grid, as `solver.rectification.terrain.Terrain`.

    Parameters
    ----------
    paths : rasters of one CRS and cell size (tiles of SRTM, say); values stand for the middle of their cells
    crs : in place of that of the files; or, as where rasters are put under a recording, ``ellipsoid`` or a vertical CRS
        alone, which are the datum
    datum : of the heights, of `DATUMS`; may be left out where the CRS says it. Heights are in the unit of the vertical
        CRS, where there is one, and depths where it counts downwards
    ellipsoid : of the sensor that looks at them

    Attributes
    ----------
    name, datum : for people
    notes : what is to be said of the places of the heights

    Raises
    ------
    UserError : no raster, turned, without CRS, of another planet, in feet that no CRS states, without a vertical
        datum, rasters that do not fit, a geoid that is not at hand
    """

    def __init__(
        self, paths: list[Path], crs: str | None = None, datum: str | None = None, ellipsoid: Ellipsoid = WGS84
    ):
        self._files = [RasterFile(path) for path in paths]
        first = self._files[0]
        self.name = ", ".join(path.name for path in paths)
        self.ellipsoid = ellipsoid
        if datum is None and crs is not None and _says_heights_alone(crs):
            crs, datum = None, crs
        whole = _crs(first, crs)
        self._check_planet(first.path, whole, ellipsoid)
        flat, stated = _split(whole)
        self._flat = flat
        self.notes = [f"{self.name}: {note}" for note in notes_of_map(flat.to_string(), what="these heights")]
        for file in self._files:
            self._check_file(file, first, crs is not None)
        t = first.transform
        self._t = t
        self._geographic = bool(flat.is_geographic)
        self._rows, self._columns = self._offsets()
        self.rows = max(row + file.rows for row, file in zip(self._rows, self._files, strict=True))
        self.columns = max(column + file.columns for column, file in zip(self._columns, self._files, strict=True))
        self._turn = self._columns_a_turn()
        self._middle: float | None = None
        from pyproj import Transformer

        base = flat.geodetic_crs if ellipsoid != WGS84 else "EPSG:4326"
        self._to_flat = Transformer.from_crs(base, flat, always_xy=True)
        width = abs(t.a), abs(t.e)
        if self._geographic:
            middle = np.radians(t.f + 0.5 * t.e * first.rows)
            metres = np.radians(1.0) * ellipsoid.semi_major_m
            width = width[0] * metres * max(float(np.cos(middle)), 1e-3), width[1] * metres
        self.cell_m = float(min(width))
        self._unit_m = _unit_m(whole)
        self.datum, self._above = self._datum(first.path, datum, stated)
        for file in self._files:
            unit = unit_of_heights(file.source)
            if unit and self._unit_m == 1.0:
                raise UserError(f"{file.path}: heights in {unit}, wanted metres, or a vertical CRS with that unit")

    # -- what is checked -----------------------------------------------------------------------------------------------

    @staticmethod
    def _check_planet(path: Path, crs: Any, ellipsoid: Ellipsoid) -> None:
        axis = crs.ellipsoid.semi_major_metre if crs.ellipsoid is not None else None
        if axis is not None and abs(axis / ellipsoid.semi_major_m - 1.0) > SAME_PLANET:
            raise UserError(
                f"{path}: heights of another planet: half axis {axis / 1e3:.1f} km, the sensor's is "
                f"{ellipsoid.semi_major_m / 1e3:.1f} km"
            )

    @staticmethod
    def _check_file(file: RasterFile, first: RasterFile, has_crs: bool) -> None:
        t, path = file.transform, file.path
        if t.b or t.d:
            raise UserError(f"{path}: is turned, wanted a raster along its axes")
        if file.rows < 2 or file.columns < 2:
            raise UserError(f"{path}: {file.rows} x {file.columns} heights, wanted at least 2 x 2")
        other = abs(t.a / first.transform.a - 1.0) + abs(t.e / first.transform.e - 1.0)
        if other * max(file.rows, file.columns) > 0.01 or (not has_crs and file.crs != first.crs):
            raise UserError(f"{path}: another CRS or cell size than {first.path.name}, wanted rasters of one grid")

    def _offsets(self) -> tuple[list[int], list[int]]:
        """First row and column of every raster, counted from the first raster's upper left after shifting to 0.

        Tiles in degrees on both sides of the date line are neighbours.
        """
        t = self._t
        rows, columns = [], []
        for file in self._files:
            east = file.transform.c - t.c
            if self._geographic:
                east -= 360.0 * round(east / 360.0)
            row, column = (file.transform.f - t.f) / t.e, east / t.a
            if abs(row - round(row)) > 0.01 or abs(column - round(column)) > 0.01:
                raise UserError(f"{file.path}: lies between the cells of {self._files[0].path.name}")
            rows.append(round(row))
            columns.append(round(column))
        top, left = min(rows), min(columns)
        self._t = type(t)(t.a, 0.0, t.c + left * t.a, 0.0, t.e, t.f + top * t.e)
        return [row - top for row in rows], [column - left for column in columns]

    def _columns_a_turn(self) -> int:
        """Columns round the planet where the raster has all of them, so that the last is next to the first; else 0."""
        columns = abs(360.0 / self._t.a) if self._geographic else 0.0
        whole = round(columns)
        return whole if self.columns >= whole and abs(columns - whole) < 0.01 else 0

    def _datum(self, path: Path, datum: str | None, stated: Any) -> tuple[str, Any]:
        """Words of the datum, and a function of latitudes and longitudes (degrees) that gives its height."""
        if datum is None and stated is None:
            raise UserError(
                f"{path}: its CRS ({self._flat.name}) does not say what its heights are above: wanted --dem-datum "
                f"{DATUMS}"
            )
        if datum is not None:
            if datum.lower() in ELLIPSOID:
                return "above the ellipsoid", None
            try:
                constant = float(datum)
            except ValueError:
                constant = None
            if constant is not None:
                if not abs(constant) < 1e5:
                    raise UserError(f"--dem-datum {datum}: wanted {DATUMS}")
                return f"{constant:g} m above the ellipsoid", lambda lat, lon: np.full(np.shape(lat), constant)
            if Path(datum).exists():
                return f"above {Path(datum).name}", _GeoidRaster(Path(datum), self.ellipsoid)
            stated, self._unit_m = _vertical(datum)
        if isinstance(stated, str):
            return "above the ellipsoid", None
        t = self._t
        x, y = t.c + 0.5 * t.a * self.columns, t.f + 0.5 * t.e * self.rows
        lon, lat = self._to_flat.transform(x, y, direction="INVERSE")
        return f"above {stated.name}", _proj_geoid(path, stated, np.array([lat]), np.array([lon]))

    # -- terrain -------------------------------------------------------------------------------------------------------

    def place(self, lat: Array, lon: Array) -> tuple[Array, Array]:
        """See `Terrain.place`; columns of a raster round the planet go on beyond its ends."""
        x, y = self._to_flat.transform(np.degrees(lon), np.degrees(lat))
        x, y = np.asarray(x, dtype=float), np.asarray(y, dtype=float)
        t = self._t
        if self._geographic:
            middle = self._longitude(x)
            x = middle + (x - middle + 180.0) % 360.0 - 180.0
        x, y = np.where(np.isfinite(x), x, np.nan), np.where(np.isfinite(y), y, np.nan)
        return (y - t.f) / t.e - 0.5, (x - t.c) / t.a - 0.5

    def _longitude(self, x: Array) -> float:
        """Longitude opposite to the one at which columns jump, degrees.

        It is that of the middle; of a raster round the planet, that of the first places that were looked up, so that
        columns do not jump under an image.
        """
        middle = self._middle
        if middle is None:
            middle = self._t.c + 0.5 * self._t.a * self.columns
            seen = np.radians(x[np.isfinite(x)])
            if self._turn and len(seen):
                middle = float(np.degrees(np.arctan2(np.sin(seen).mean(), np.cos(seen).mean())))
            if len(seen):
                self._middle = middle
        return middle

    def undulation(self, lat: Array, lon: Array) -> Array:
        """See `Terrain.undulation`; NaN beyond the raster where nobody knows it.

        Raises
        ------
        UserError : it is not known where the raster has a height
        """
        if self._above is None:
            return np.zeros(np.shape(lat))
        N = self._above(np.degrees(lat), np.degrees(lon))
        unknown = ~np.isfinite(N)
        if not unknown.any():
            return N
        row, column = self.place(lat, lon)
        for at, count in ((row, self.rows), (column, self.columns))[: 1 if self._turn else 2]:
            unknown &= (at > EDGE_CELLS) & (at < count - 1 - EDGE_CELLS)
        if unknown.any():
            k = int(np.argmax(np.ravel(unknown)))
            where = f"{np.degrees(np.ravel(lat)[k]):.4f} N, {np.degrees(np.ravel(lon)[k]):.4f} E"
            raise UserError(f"{self.name}: {self.datum.removeprefix('above ')}: no geoid height at {where}")
        return np.where(np.isfinite(N), N, np.nan)

    def heights(self, row: int, column: int, rows: int, columns: int) -> NDArray[np.float32]:
        """See `Terrain.heights`."""
        out = np.full((rows, columns), np.nan, dtype=np.float32)
        for file, first_row, first_column in self._placed(column, columns):
            top, left = max(row, first_row), max(column, first_column)
            bottom = min(row + rows, first_row + file.rows)
            right = min(column + columns, first_column + file.columns)
            if top >= bottom or left >= right:
                continue
            z = self._window(file, top - first_row, left - first_column, bottom - top, right - left)
            part = out[top - row : bottom - row, left - column : right - column]
            part[:] = np.where(np.isnan(part), z, part)
        return out

    def _placed(self, column: int, columns: int) -> Iterator[tuple[RasterFile, int, int]]:
        """Files with their first row and column; of a raster round the planet those in a window, each time they are."""
        for file, first_row, first_column in zip(self._files, self._rows, self._columns, strict=True):
            turns = range(1)
            if self._turn:
                first, last = column - first_column - file.columns, column + columns - first_column
                turns = range(first // self._turn + 1, -(-last // self._turn))
            for turn in turns:
                yield file, first_row, first_column + turn * self._turn

    def _window(self, file: RasterFile, *place: int) -> NDArray[np.float32]:
        """Heights of a window of one file, metres."""
        z = _read(file, *place)
        return z if self._unit_m == 1.0 else z * np.float32(self._unit_m)

    def range_over(self, lat: Array, lon: Array, *, everywhere: bool = False) -> tuple[float, float] | None:
        """Lowest and highest height above the ellipsoid around points, by a thinned-out window; None for none.

        ``everywhere`` : of the whole raster, above the ellipsoid by the geoid where it is nearest to the points.
        """
        row, column = self.place(lat, lon)
        if not (np.isfinite(row).any() and np.isfinite(column).any()):
            return None
        top, left = int(np.nanmin(row)) - 2, int(np.nanmin(column)) - 2
        height, width = int(np.nanmax(row)) + 3 - top, int(np.nanmax(column)) + 3 - left
        if everywhere:
            top, left, height, width = 0, 0, self.rows, self.columns
        low, high, slack = np.inf, -np.inf, 0.0
        for file, first_row, first_column in self._placed(left, width):
            r0, c0 = max(top, first_row) - first_row, max(left, first_column) - first_column
            r1 = min(top + height, first_row + file.rows) - first_row
            c1 = min(left + width, first_column + file.columns) - first_column
            if r0 >= r1 or c0 >= c1:
                continue
            thin = max(1, -(-max(r1 - r0, c1 - c0) // MOST_SIDE))
            z = self._window(file, r0, c0, r1 - r0, c1 - c0, thin)
            if np.isfinite(z).any():
                low, high = min(low, float(np.nanmin(z))), max(high, float(np.nanmax(z)))
                slack = THIN_SLACK_M if thin > 1 else slack
        if low > high:
            return None
        low, high = low - slack, high + slack
        N = self.undulation(*self._nearest(row, column))
        return low + float(np.nanmin(N)), high + float(np.nanmax(N))

    def _nearest(self, row: Array, column: Array) -> tuple[Array, Array]:
        """Latitudes and longitudes (n,), radians, of the places of the raster that are nearest to some."""
        t = self._t
        x = t.c + t.a * ((column if self._turn else np.clip(column, 0, self.columns - 1)) + 0.5)
        y = t.f + t.e * (np.clip(row, 0, self.rows - 1) + 0.5)
        lon, lat = self._to_flat.transform(x, y, direction="INVERSE")
        return np.radians(lat), np.radians(lon)

    def at(self, lat: Array, lon: Array) -> Array:
        """Heights above the ellipsoid (n,) at latitudes and longitudes (n,), radians."""
        row, column = self.place(lat, lon)
        row = _within_edge(row, self.rows)
        if not self._turn:
            column = _within_edge(column, self.columns)
        known = np.flatnonzero(np.isfinite(row) & np.isfinite(column))
        out = np.full(np.shape(lat), np.nan)
        for part in squares(row[known], column[known]):
            some = known[part]
            out[some] = self._between(row[some], column[some]) + self.undulation(lat[some], lon[some])
        return out

    def _between(self, row: Array, column: Array) -> Array:
        """Values between the cells at rows and columns (n,), by one window; NaN beyond the raster."""
        top, left = max(int(row.min()) - 1, -2), int(np.floor(column.min())) - 1
        bottom, right = min(int(row.max()) + 3, self.rows + 2), int(np.floor(column.max())) + 3
        if not self._turn:
            left, right = max(left, -2), min(right, self.columns + 2)
        if bottom - top < 2 or right - left < 2:
            return np.full(len(row), np.nan)
        return bilinear(self.heights(top, left, bottom - top, right - left), row - top, column - left)


def _read(file: RasterFile, row: int, column: int, rows: int, columns: int, thin: int = 1) -> NDArray[np.float32]:
    """Values of a window of one file, every ``thin``-th.

    Raises
    ------
    UserError : the file is damaged there
    """
    from rasterio.errors import RasterioError
    from rasterio.windows import Window

    source = file.source
    window = Window(column, row, columns, rows)
    shape = None if thin == 1 else (-(-rows // thin), -(-columns // thin))
    try:
        band = source.read(1, window=window, masked=True, out_shape=shape)
    except RasterioError as error:
        place = f"rows {row} to {row + rows - 1}, columns {column} to {column + columns - 1}"
        raise UserError(f"{file.path}: heights of {place} cannot be read: {' '.join(str(error).split())}") from None
    return known_heights(source, band, np.float32)


def _within_edge(at: Array, count: int) -> Array:
    """Places (n,) among so many values, where those beside the first or the last one by rounding alone are on it."""
    inside = np.clip(at, 0, count - 1)
    return np.where(np.abs(at - inside) < EDGE_CELLS, inside, at)


class _GeoidRaster:
    """Geoid heights out of a raster, bilinear; NaN beside it."""

    def __init__(self, path: Path, ellipsoid: Ellipsoid):
        self._raster = HeightRaster([path], None, "ellipsoid", ellipsoid)

    def __call__(self, lat_deg: Array, lon_deg: Array) -> Array:
        shape = np.shape(lat_deg)
        return self._raster.at(np.radians(np.ravel(lat_deg)), np.radians(np.ravel(lon_deg))).reshape(shape)


def _says_heights_alone(crs: str) -> bool:
    """Whether a CRS is ``ellipsoid`` or a vertical one, and leaves the places to the raster."""
    import pyproj
    from pyproj.exceptions import CRSError

    if crs.lower() in ELLIPSOID:
        return True
    try:
        given = pyproj.CRS.from_user_input(crs)
    except CRSError:
        return False
    return bool(given.is_vertical and not given.is_compound)


def _crs(file: RasterFile, wanted: str | None) -> Any:
    import pyproj
    from pyproj.exceptions import CRSError

    if wanted is None and file.crs is None:
        raise UserError(f"{file.path}: has no coordinate reference system, wanted --dem-crs")
    try:
        return pyproj.CRS.from_user_input(wanted if wanted is not None else file.crs.to_wkt())
    except CRSError as error:
        raise UserError(f"--dem-crs {wanted}: PROJ does not know it: {str(error).splitlines()[0]}") from None


def _split(crs: Any) -> tuple[Any, Any]:
    """The horizontal CRS, and the vertical one, "ellipsoid", or None where nothing is said."""
    if crs.is_compound:
        return crs.sub_crs_list[0], crs.sub_crs_list[1]
    if len(crs.axis_info) > 2:
        return crs.to_2d(), "ellipsoid"
    return crs, None


def _unit_m(crs: Any) -> float:
    """Metres that a unit of the heights of a CRS is, less than zero for depths; 1 where it says nothing of heights."""
    axis = crs.axis_info[-1]
    direction = axis.direction.lower()
    return {"up": 1.0, "down": -1.0}.get(direction, 0.0) * axis.unit_conversion_factor or 1.0


def _vertical(name: str) -> tuple[Any, float]:
    """The vertical CRS of a name, or "ellipsoid", and the unit of its heights in metres."""
    import pyproj
    from pyproj.exceptions import CRSError

    try:
        crs = pyproj.CRS.from_user_input(name)
    except CRSError:
        raise UserError(f"--dem-datum {name}: neither a file nor a CRS that PROJ knows, wanted {DATUMS}") from None
    if crs.is_compound:
        crs = crs.sub_crs_list[1]
    if crs.is_vertical:
        return crs, _unit_m(crs)
    if len(crs.axis_info) > 2:
        return "ellipsoid", _unit_m(crs)
    raise UserError(f"--dem-datum {name}: {crs.name} says nothing of heights, wanted {DATUMS}")


def _proj_geoid(path: Path, vertical: Any, lat_deg: Array, lon_deg: Array) -> Any:
    """Geoid heights by PROJ, not finite beyond its grid, which has to be installed and to reach to a place in the
    raster.
    """
    import pyproj
    from pyproj.crs import CompoundCRS
    from pyproj.exceptions import ProjError

    source = CompoundCRS("WGS 84 and heights", ["EPSG:4326", vertical])
    wanted = pyproj.CRS.from_epsg(4979)
    missing = UserError(
        f"{path}: PROJ cannot tell {vertical.name} from the ellipsoid: its geoid grid is not installed (projsync gets "
        "it) or does not reach there, wanted --dem-datum with a raster of geoid heights or the geoid's height in metres"
    )
    try:
        transformer = pyproj.Transformer.from_crs(source, wanted, always_xy=True, allow_ballpark=False, only_best=True)
    except ProjError:
        raise missing from None

    def above(lat_deg: Array, lon_deg: Array) -> Array:
        return np.asarray(transformer.transform(lon_deg, lat_deg, np.zeros(np.shape(lat_deg)))[2])

    if not np.isfinite(above(lat_deg, lon_deg)).all():
        raise missing
    return above
