"""Orthoimages as cloud-optimised GeoTIFF, and heights out of any raster that GDAL reads.

Rasterio is imported where it is used: it takes half a second, and most commands need none.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...solver.orthoimage.ground_grid import GroundGrid
from ...solver.orthoimage.mosaic import Mosaic
from ..errors import UserError
from .new_file import new_file

Array = NDArray[np.floating]

#: Cells a side of the blocks in the file.
BLOCK = 512
#: A raster of heights has no more cells than this.
MOST_HEIGHTS = 100_000_000


@dataclass(frozen=True)
class Heights:
    """A raster of heights.

    Attributes
    ----------
    crs : what PROJ understands
    z_m : (rows, columns), NaN where not known
    x0, y0 : CRS coordinates of the first value
    dx, dy : from column to column, from row to row
    """

    crs: str
    z_m: Array
    x0: float
    y0: float
    dx: float
    dy: float


def read_heights(path: Path) -> Heights:
    """A raster of heights, first band; values stand for the middle of their cells.

    Raises
    ------
    UserError : not there, not a raster, without CRS, turned, too large, or without a single height
    """
    import rasterio
    from rasterio.errors import NotGeoreferencedWarning, RasterioError

    if not path.exists():
        raise UserError(f"{path}: no such file")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", NotGeoreferencedWarning)
            with rasterio.open(path) as source:
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
    except RasterioError as error:
        raise UserError(f"{path}: not a raster that can be read: {' '.join(str(error).split())}") from None
    z = np.ma.filled(band.astype(float), np.nan)
    if not np.isfinite(z).any():
        raise UserError(f"{path}: holds no height")
    return Heights(crs, z, t.c + 0.5 * t.a, t.f + 0.5 * t.e, t.a, t.e)


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
    with (
        new_file(path) as part,
        rasterio.open(
            part, "w", driver="GTiff", width=columns, height=rows, count=1, dtype="float32", crs=heights.crs,
            transform=transform, nodata=np.nan, compress="deflate", predictor=3, tiled=True,
        ) as target,
    ):  # fmt: skip
        target.write(heights.z_m.astype(np.float32), 1)


def write_orthoimage(path: Path, mosaic: Mosaic, grid: GroundGrid, tags: dict[str, str]) -> tuple[int, int]:
    """A mosaic as cloud-optimised GeoTIFF with overviews; 0 is no data. Returns rows and columns.

    Raises
    ------
    UserError : nothing in the mosaic, or the file cannot be written
    """
    import rasterio
    import rasterio.shutil
    from rasterio.crs import CRS
    from rasterio.errors import NotGeoreferencedWarning, RasterioError
    from rasterio.windows import Window

    try:
        row0, row1, column0, column1 = mosaic.extent()
    except ValueError as error:
        raise UserError(f"{path}: {error}") from None
    x, y = grid.corner(column0, row0)
    crs = None if grid.frame.crs == "local" else CRS.from_user_input(grid.frame.crs)
    shape = row1 - row0, column1 - column0
    profile = {
        "width": shape[1], "height": shape[0], "count": 1, "dtype": mosaic.dtype.name, "crs": crs,
        "transform": rasterio.Affine(grid.gsd, 0.0, x, 0.0, -grid.gsd, y), "nodata": 0,
    }  # fmt: skip
    with new_file(path) as part, warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        draft = part.with_suffix(".draft")
        try:
            # a cloud-optimised file is made from a whole one: overviews stand before the pixels
            with rasterio.open(
                draft, "w", driver="GTiff", tiled=True, blockxsize=BLOCK, blockysize=BLOCK, bigtiff="if_safer",
                sparse_ok=True, compress="lzw", **profile,
            ) as target:  # fmt: skip
                target.update_tags(**tags)
                for r in range(0, shape[0], BLOCK):
                    for c in range(0, shape[1], BLOCK):
                        height, width = min(BLOCK, shape[0] - r), min(BLOCK, shape[1] - c)
                        cells = mosaic.read(row0 + r, row0 + r + height, column0 + c, column0 + c + width)
                        if cells.any():
                            target.write(cells, 1, window=Window(c, r, width, height))  # type: ignore[call-arg]
            rasterio.shutil.copy(
                draft, part, driver="COG", compress="deflate", predictor="yes", blocksize=BLOCK,
                overview_resampling="average", bigtiff="if_safer",
            )  # fmt: skip
        except RasterioError as error:
            raise UserError(f"{path}: cannot be written: {' '.join(str(error).split())}") from None
        finally:
            draft.unlink(missing_ok=True)
    return shape
