"""Orthoimages as cloud-optimised GeoTIFF, and heights out of any raster that GDAL reads.

Rasterio is imported where it is used: it takes half a second, and most commands need none.
"""

from __future__ import annotations

import errno
import os
import shutil
import warnings
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...solver.orthoimage.ground_grid import CellWindow, GroundGrid
from ...solver.orthoimage.mosaic import Mosaic
from ..errors import UserError
from .keys import is_there
from .new_file import new_file
from .raster_open import known_heights, open_raster, unit_of_heights

Array = NDArray[np.floating]

#: Cells a side of the blocks in the file.
BLOCK = 512
#: Megabytes of blocks that GDAL holds while it makes a cloud-optimised file of tiles.
CACHE_MB = 192
#: A disk on which writing fails is full where fewer bytes are free.
FULL = 1_000_000
#: A raster of heights has no more cells than this.
MOST_HEIGHTS = 100_000_000
#: Names of the bands of a file of sigmas.
SIGMA_BANDS = ("planimetric sigma, m", "height sigma, m")
#: Tag by which a file of ours says what its heights count from.
_DATUM = "VERTICAL_DATUM"


@dataclass(frozen=True)
class Heights:
    """A raster of heights.

    Attributes
    ----------
    crs : what PROJ understands
    z_m : (rows, columns), NaN where not known
    x0, y0 : CRS coordinates of the first value
    dx, dy : from column to column, from row to row
    above_ellipsoid : the file says that they count from the ellipsoid
    unit : of the values as the file states it, "" for metres
    """

    crs: str
    z_m: Array
    x0: float
    y0: float
    dx: float
    dy: float
    above_ellipsoid: bool = False
    unit: str = ""


def read_heights(path: Path) -> Heights:
    """A raster of heights, first band; values stand for the middle of their cells.

    Raises
    ------
    UserError : not there, not a raster, without CRS, turned, too large, or without a single height
    """
    from rasterio.errors import RasterioError

    if not is_there(path):
        raise UserError(f"{path}: no such file")
    try:
        with open_raster(path) as source:
            if source.crs is None:
                raise UserError(f"{path}: has no coordinate reference system")
            t = source.transform
            if t.b or t.d:
                raise UserError(f"{path}: is turned, wanted a raster along its axes")
            if source.width * source.height > MOST_HEIGHTS:
                size = f"{source.width} x {source.height}"
                raise UserError(f"{path}: {size} heights are too many, wanted at most {MOST_HEIGHTS:.0e}")
            band = source.read(1, masked=True)
            crs = source.crs.to_wkt()
            ellipsoidal = source.tags().get(_DATUM) == "ellipsoid"
            unit = unit_of_heights(source)
            z = known_heights(source, band, float)
    except RasterioError as error:
        raise UserError(f"{path}: not a raster that can be read: {' '.join(str(error).split())}") from None
    if not np.isfinite(z).any():
        raise UserError(f"{path}: holds no height")
    return Heights(crs, z, t.c + 0.5 * t.a, t.f + 0.5 * t.e, t.a, t.e, ellipsoidal, unit)


def write_heights(path: Path, heights: Heights) -> None:
    """Heights as GeoTIFF (float32).

    Raises
    ------
    UserError : the file cannot be written
    """
    import rasterio

    rows, columns = heights.z_m.shape
    corner = heights.x0 - 0.5 * heights.dx, heights.y0 - 0.5 * heights.dy
    transform = rasterio.Affine(heights.dx, 0.0, corner[0], 0.0, heights.dy, corner[1])
    with new_file(path) as part:
        with _told(path), rasterio.open(
            part, "w", driver="GTiff", width=columns, height=rows, count=1, dtype="float32", crs=heights.crs,
            transform=transform, nodata=np.nan, compress="deflate", predictor=3, tiled=True,
        ) as target:  # fmt: skip
            target.write(heights.z_m.astype(np.float32), 1)
            if heights.above_ellipsoid:
                target.update_tags(bidx=0, **{_DATUM: "ellipsoid"})
        _refuse_cut(part, path)


@dataclass(frozen=True)
class Raster:
    """What a raster of a map is, before there is anything in it.

    Attributes
    ----------
    crs : what rasterio understands; None for the local frame
    left, top, gsd : CRS coordinates of the upper left corner, and size of a cell
    rows, columns, bands, dtype, nodata : no data where nothing is written
    tags, descriptions : of the file, of its bands
    scales, offsets, units : of the values of its bands; empty for values that are meant as they stand
    colors : what its bands show, of rasterio's ``ColorInterp``; empty for grey values
    """

    crs: str | None
    left: float
    top: float
    gsd: float
    rows: int
    columns: int
    bands: int
    dtype: str
    nodata: float | None
    tags: dict[str, str] = field(default_factory=dict)
    descriptions: tuple[str, ...] = ()
    scales: tuple[float, ...] = ()
    offsets: tuple[float, ...] = ()
    units: tuple[str, ...] = ()
    colors: tuple[Any, ...] = ()


class Draft:
    """A raster that is written piece by piece, in any order; made by `tiled_orthoimage`.

    Raises
    ------
    UserError : the file cannot be written
    """

    def __init__(self, path: Path, target: Any):
        self._path, self._target = path, target

    def write(self, row: int, column: int, values: NDArray[Any]) -> None:
        """Values (bands, rows, columns) at a place."""
        from rasterio.windows import Window

        window = Window(column, row, values.shape[2], values.shape[1])
        with _told(self._path):
            self._target.write(values, window=window)

    def read(self, row: int, column: int, rows: int, columns: int) -> NDArray[Any]:
        """What stands at a place so far, (bands, rows, columns)."""
        from rasterio.windows import Window

        with _told(self._path):
            return self._target.read(window=Window(column, row, columns, rows))


@contextmanager
def tiled_orthoimage(
    path: Path, raster: Raster, compress: str = "deflate", overview_resampling: str = "average"
) -> Iterator[Draft]:
    """A cloud-optimised GeoTIFF with overviews, which gets its name when it is whole.

    Parameters
    ----------
    compress : deflate, zstd, lzw or none; "plain" for a tiled file without overviews, which is written but once
    overview_resampling : how overviews are made; ``nearest`` for classes

    Raises
    ------
    UserError : the file cannot be written
    """
    import rasterio
    import rasterio.shutil
    from rasterio.crs import CRS

    predictor: dict[str, Any] = {}
    if compress != "none" and _differences(raster.dtype):
        predictor = {"predictor": "yes"}
    with new_file(path) as part:
        draft = part.with_suffix(".draft")
        try:
            with _told(path):
                target = rasterio.open(
                    draft, "w+", driver="GTiff", tiled=True, blockxsize=BLOCK, blockysize=BLOCK, bigtiff="if_safer",
                    sparse_ok=True, interleave="band", width=raster.columns, height=raster.rows, count=raster.bands,
                    dtype=raster.dtype, nodata=raster.nodata, crs=raster.crs and CRS.from_user_input(raster.crs),
                    transform=rasterio.Affine(raster.gsd, 0.0, raster.left, 0.0, -raster.gsd, raster.top),
                    photometric="MINISBLACK",  # else the last of four bands of bytes is how opaque the others are
                )  # fmt: skip
            with target:
                if raster.colors:
                    target.colorinterp = raster.colors
                target.update_tags(bidx=0, **raster.tags)
                for k, text in enumerate(raster.descriptions):
                    target.set_band_description(k + 1, text)
                if any(scale != 1.0 for scale in raster.scales) or any(raster.offsets):
                    target.scales, target.offsets = raster.scales, raster.offsets
                if any(raster.units):
                    target.units = raster.units
                yield Draft(path, target)
            _refuse_cut(draft, path)
            if compress == "plain":
                draft.replace(part)
                return
            with _told(path):
                rasterio.shutil.copy(
                    draft, part, driver="COG", compress=compress, blocksize=BLOCK, bigtiff="if_safer",
                    overview_resampling=overview_resampling, num_threads="all_cpus", **predictor,
                )  # fmt: skip
            _refuse_cut(part, path)
        finally:
            draft.unlink(missing_ok=True)


def write_tile(path: Path, raster: Raster, values: NDArray[Any], block: int = BLOCK) -> None:
    """A small raster (bands, rows, columns) at once, compressed, which gets its name when it is whole.

    Raises
    ------
    UserError : the file cannot be written
    """
    with pieces_of_raster(path, raster, block) as target:
        target.write(0, 0, values)


@contextmanager
def pieces_of_raster(path: Path, raster: Raster, block: int = BLOCK) -> Iterator[Draft]:
    """A compressed raster without overviews, written block by block, each once; it gets its name when it is whole.

    Parameters
    ----------
    block : cells a side of the blocks in the file

    Raises
    ------
    UserError : the file cannot be written
    """
    import rasterio
    from rasterio.crs import CRS
    from rasterio.errors import NotGeoreferencedWarning

    predictor = 3 if np.dtype(raster.dtype).kind == "f" else 2 if _differences(raster.dtype) else 1
    with warnings.catch_warnings(), new_file(path) as part:
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        with _told(path):
            target = rasterio.open(
                part, "w", driver="GTiff", tiled=True, blockxsize=block, blockysize=block, bigtiff="if_safer",
                sparse_ok=True, interleave="band", width=raster.columns, height=raster.rows, count=raster.bands,
                dtype=raster.dtype, nodata=raster.nodata, crs=raster.crs and CRS.from_user_input(raster.crs),
                transform=rasterio.Affine(raster.gsd, 0.0, raster.left, 0.0, -raster.gsd, raster.top),
                compress="deflate", zlevel=1, predictor=predictor,
            )  # fmt: skip
        with _told(path), target:
            for k, text in enumerate(raster.descriptions):
                target.set_band_description(k + 1, text)
            yield Draft(path, target)
        _refuse_cut(part, path)


@dataclass(frozen=True)
class TilePlace:
    """A tile of a larger raster.

    Attributes
    ----------
    path : its file
    row, column : its first cell in the larger raster; may lie before its beginning
    rows, columns : of the tile
    """

    path: Path
    row: int
    column: int
    rows: int
    columns: int


def is_virtual(path: Path) -> bool:
    """Whether a raster of that name is a virtual one."""
    return path.suffix.lower() == ".vrt"


def write_virtual(path: Path, raster: Raster, tiles: list[TilePlace]) -> None:
    """A virtual raster (VRT of GDAL) over tiles, with paths as seen from its folder.

    Raises
    ------
    UserError : the file cannot be written
    """
    from xml.sax.saxutils import escape

    from rasterio.crs import CRS

    kinds = {"uint8": "Byte", "int8": "Int8", "uint16": "UInt16", "int16": "Int16", "uint32": "UInt32",
             "int32": "Int32", "uint64": "UInt64", "int64": "Int64", "float32": "Float32",
             "float64": "Float64"}  # fmt: skip
    out = [f'<VRTDataset rasterXSize="{raster.columns}" rasterYSize="{raster.rows}">']
    if raster.crs:
        wkt = CRS.from_user_input(raster.crs).to_wkt()
        out.append(f"<SRS>{escape(wkt)}</SRS>")  # columns go east, whatever axis of the CRS is the first
    transform = (raster.left, raster.gsd, 0.0, raster.top, 0.0, -raster.gsd)
    out.append("<GeoTransform>" + ", ".join(map(repr, transform)) + "</GeoTransform>")
    if raster.tags:
        items = "".join(f'<MDI key="{escape(k)}">{escape(v)}</MDI>' for k, v in raster.tags.items())
        out.append(f"<Metadata>{items}</Metadata>")
    for band in range(1, raster.bands + 1):
        out.append(f'<VRTRasterBand dataType="{kinds[raster.dtype]}" band="{band}">')
        if band <= len(raster.descriptions):
            out.append(f"<Description>{escape(raster.descriptions[band - 1])}</Description>")
        if raster.nodata is not None:
            out.append(f"<NoDataValue>{raster.nodata:.17g}</NoDataValue>")
        for name, values in (("UnitType", raster.units), ("Offset", raster.offsets), ("Scale", raster.scales)):
            if values:
                out.append(f"<{name}>{escape(str(values[band - 1]))}</{name}>")
        if raster.colors:
            out.append(f"<ColorInterp>{raster.colors[band - 1].name.capitalize()}</ColorInterp>")
        for tile in tiles:
            top, left = max(tile.row, 0), max(tile.column, 0)
            height = min(tile.row + tile.rows, raster.rows) - top
            width = min(tile.column + tile.columns, raster.columns) - left
            if height <= 0 or width <= 0:
                continue
            source = escape(tile.path.relative_to(path.parent).as_posix())
            out.append(
                f'<SimpleSource><SourceFilename relativeToVRT="1">{source}</SourceFilename>'
                f"<SourceBand>{band}</SourceBand>"
                f'<SourceProperties RasterXSize="{tile.columns}" RasterYSize="{tile.rows}" '
                f'DataType="{kinds[raster.dtype]}" BlockXSize="{BLOCK}" BlockYSize="{BLOCK}"/>'
                f'<SrcRect xOff="{left - tile.column}" yOff="{top - tile.row}" xSize="{width}" ySize="{height}"/>'
                f'<DstRect xOff="{left}" yOff="{top}" xSize="{width}" ySize="{height}"/></SimpleSource>'
            )
        out.append("</VRTRasterBand>")
    out.append("</VRTDataset>")
    with new_file(path) as part:
        part.write_text("\n".join(out) + "\n", encoding="utf-8")


def cloud_optimised(path: Path, source: Path, compress: str = "deflate", overview_resampling: str = "average") -> None:
    """Any raster as cloud-optimised GeoTIFF with overviews, in bounded memory.

    Raises
    ------
    UserError : the file cannot be written
    """
    import rasterio
    import rasterio.shutil
    from rasterio.errors import NotGeoreferencedWarning

    with warnings.catch_warnings(), new_file(path) as part, rasterio.Env(GDAL_CACHEMAX=CACHE_MB), _told(path):
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        with rasterio.open(source) as raster:
            differences = compress != "none" and _differences(raster.dtypes[0])
        predictor: dict[str, Any] = {"predictor": "yes"} if differences else {}
        rasterio.shutil.copy(
            source, part, driver="COG", compress=compress, blocksize=BLOCK, bigtiff="if_safer",
            overview_resampling=overview_resampling, num_threads="all_cpus", **predictor,
        )  # fmt: skip
        _refuse_cut(part, path)


def _differences(dtype: str) -> bool:
    """Whether differences of neighbours are compressed: not of 64-bit whole numbers, as libtiff up to 4.3 cannot read
    them."""
    kind = np.dtype(dtype)
    return kind.kind == "f" or kind.itemsize < 8


@contextmanager
def _told(path: Path) -> Iterator[None]:
    from rasterio._err import CPLE_BaseError  # of GDAL itself, as copying raises them
    from rasterio.errors import RasterioError

    try:
        yield
    except (RasterioError, CPLE_BaseError) as error:
        raise _not_written(path, " ".join(str(error.__cause__ or error).split())) from None


def _not_written(path: Path, why: str) -> UserError:
    """What is told where a file cannot be written; GDAL does not say that a disk is full."""
    full = shutil.disk_usage(path.parent).free < FULL
    return UserError(f"{path}: cannot be written: {os.strerror(errno.ENOSPC).lower() if full else why}")


def _refuse_cut(part: Path, path: Path) -> None:
    """Raise UserError where blocks of a new file lie beyond its end.

    What GDAL cannot write any more when it closes a file, on a disk that is full, it leaves out without an error.
    """
    import rasterio
    from rasterio.errors import NotGeoreferencedWarning

    size = part.stat().st_size
    with warnings.catch_warnings(), _told(path):
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        with rasterio.open(part) as source:
            whole = all(end <= size for end in _ends_of_blocks(source))
    if not whole:
        raise _not_written(path, "its end is missing")


def _ends_of_blocks(source: Any) -> Iterator[int]:
    """Where in the file each block of a GeoTIFF ends that is there, those of overviews, too."""
    for band, (rows, columns) in zip(source.indexes, source.block_shapes, strict=True):
        for level, factor in [(None, 1), *enumerate(source.overviews(band))]:
            for row in range(-(-source.height // (factor * rows))):
                for column in range(-(-source.width // (factor * columns))):
                    place, size = (
                        source.get_tag_item(f"BLOCK_{what}_{column}_{row}", "TIFF", bidx=band, ovr=level)
                        for what in ("OFFSET", "SIZE")
                    )
                    if place is not None and size is not None:  # else it holds nothing
                        yield int(place) + int(size)


def write_orthoimage(
    path: Path, mosaic: Mosaic, grid: GroundGrid, tags: dict[str, str], sigma: Path | None = None,
    part: CellWindow | None = None,
) -> tuple[int, int]:  # fmt: skip
    """A mosaic as cloud-optimised GeoTIFF with overviews; 0 is no data. Returns rows and columns.

    Parameters
    ----------
    sigma : file for its sigmas in the plane and of the height, if it has them
    part : the cells of the file; None for all up to the outermost that have something in them

    Raises
    ------
    UserError : nothing in the mosaic, or a file cannot be written
    """
    from rasterio.errors import NotGeoreferencedWarning

    try:
        part = CellWindow(*mosaic.extent()) if part is None else part
    except ValueError as error:
        raise UserError(f"{path}: {error}") from None
    x, y = grid.corner(part.column0, part.row0)
    shape = part.shape
    crs = None if grid.frame.crs == "local" else grid.frame.crs
    raster = Raster(crs, x, y, grid.gsd, *shape, 1, mosaic.dtype.name, 0, tags)
    with warnings.catch_warnings(), ExitStack() as stack:
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        target = stack.enter_context(tiled_orthoimage(path, raster))
        sigmas = None
        if sigma is not None:
            raster = replace(raster, bands=2, dtype="float32", nodata=float("nan"), descriptions=SIGMA_BANDS)
            sigmas = stack.enter_context(tiled_orthoimage(sigma, raster))
        for r in range(0, shape[0], BLOCK):
            for c in range(0, shape[1], BLOCK):
                end = min(r + BLOCK, shape[0]), min(c + BLOCK, shape[1])
                window = part.row0 + r, part.row0 + end[0], part.column0 + c, part.column0 + end[1]
                cells = mosaic.read(*window)
                if cells.any():
                    target.write(r, c, cells[None])
                    if sigmas is not None:
                        sigmas.write(r, c, mosaic.read_sigma(*window))
    return shape
