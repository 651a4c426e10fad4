"""Any image of a sensor that can be located becomes an orthoimage: tile by tile, on all cores, in bounded memory."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...solver.geometry.ellipsoid import WGS84, Ellipsoid
from ...solver.rectification.cell_to_pixel import HeightsOfTile, Tile, heights_of_tile, pixels_of_tile
from ...solver.rectification.error_map import ImageErrors, sigmas_of_tile
from ...solver.rectification.grid import MapGrid
from ...solver.rectification.kernels import TAPS, resampled
from ...solver.rectification.occlusion import hidden, reach_cells
from ...solver.rectification.pixel_to_cell import meet_terrain, mesh_cells
from ...solver.rectification.sampled import some_cells
from ..errors import UserError
from ..formats.geotiff import BLOCK, SIGMA_BANDS, Raster, tiled_orthoimage
from ..formats.height_raster import HeightRaster, RasterFile
from ..formats.raster_open import check_grey_values, open_raster
from ..worker_pool import cores

Array = NDArray[np.floating]
Mask = NDArray[np.bool_]

#: Cells a side of the tiles of the orthoimage, and pixels a side of the blocks of the direct way.
TILE, BLOCK_PX = BLOCK, 256
#: Values of the raster of heights, a side, that a tile takes at most; else it has fewer cells, down to `LEAST_TILE`.
MOST_VALUES, LEAST_TILE = 4096, 32
#: Places along each edge of the image whose ground points give the extent of the orthoimage.
EDGE_PLACES = 400
#: Megabytes that GDAL may hold of blocks it has read.
CACHE_MB = 192
#: What a cell of the mask of missing cells means.
MISSING = {
    0: "value", 1: "outside the image", 2: "height not known", 3: "hidden by relief", 4: "no data in the image",
}  # fmt: skip


@dataclass(frozen=True)
class Ground:
    """The ground under an image.

    Attributes
    ----------
    terrain : raster of heights, or one height above the ellipsoid
    low_m, high_m : between which heights above the ellipsoid it lies
    covered : share of the image whose ground the raster knows
    words : for people
    """

    terrain: HeightRaster | float
    low_m: float
    high_m: float
    covered: float
    words: str


@dataclass
class Counts:
    """Cells by what is in them (`MISSING`), and nodes that were needed."""

    cells: dict[str, int] = field(default_factory=lambda: dict.fromkeys(MISSING.values(), 0))

    def add(self, classes: NDArray[np.uint8]) -> None:
        for k, n in enumerate(np.bincount(classes.ravel(), minlength=len(MISSING))):
            self.cells[MISSING[k]] += int(n)


class SourceImage:
    """An image of any number of bands and any real data type.

    Raises
    ------
    UserError : not there, not an image, complex numbers, numbers of a colour table, a no-data value that its type does
        not hold
    """

    def __init__(self, path: Path, nodata: float | None = None):
        self.file = RasterFile(path, overviews=False)  # pixels that are put together are means of all of them
        from rasterio.enums import MaskFlags

        source = self.file.source
        self.path, self.lines, self.samples = path, self.file.rows, self.file.columns
        self.bands, self.dtype = self.file.count, np.dtype(self.file.dtype)
        check_grey_values(path, source)
        self._mixed = len(set(source.dtypes)) > 1
        if self._mixed:
            self.dtype = np.result_type(*[np.dtype(name) for name in source.dtypes])
        if nodata is not None and self.dtype.kind in "iu":
            low, high = np.iinfo(self.dtype).min, np.iinfo(self.dtype).max
            if not low <= nodata <= high or nodata != int(nodata):
                raise UserError(f"--nodata {nodata:g}: wanted a whole number from {low} to {high}, as {path} has")
        self.nodata = nodata if nodata is not None else source.nodata
        # GDAL leaves out of means what the file states; what the command line does, it does not know
        stated = np.array([np.inf if source.nodata is None else source.nodata])
        self._unstated = nodata is not None and not np.array_equal(stated, [nodata], equal_nan=True)
        # a mask beside the bands or in a file of its own; one that is a band goes into the orthoimage as such
        self._masked = any(MaskFlags.per_dataset in flags for flags in source.mask_flag_enums)
        if self._masked:
            self._unstated = True
            if self.nodata is None:
                self.nodata = float("nan") if self.dtype.kind == "f" else 0.0
        with open_raster(path) as whole:  # without its overviews GDAL does not tell the names of the bands
            self.descriptions = tuple(text or "" for text in whole.descriptions)
        self.scales, self.offsets = tuple(source.scales), tuple(source.offsets)
        self.units = tuple(unit or "" for unit in source.units)
        self.colors = tuple(source.colorinterp)

    def crop(self) -> tuple[int, int] | None:
        """Line and sample of the first pixel in the scene, where the geotransform tells it: no CRS, cells of 1."""
        t = self.file.transform
        if self.file.crs is not None or (t.a, t.b, t.d, t.e) != (1.0, 0.0, 0.0, 1.0) or (t.c, t.f) == (0.0, 0.0):
            return None
        return (round(t.f), round(t.c)) if t.c == round(t.c) and t.f == round(t.f) else None

    def window(self, line: int, sample: int, lines: int, samples: int, factor: int = 1) -> NDArray[Any]:
        """Pixels (bands, lines, samples), each the mean of ``factor`` x ``factor`` of the file; inside the image."""
        from rasterio.enums import Resampling
        from rasterio.windows import Window

        window = Window(sample * factor, line * factor, samples * factor, lines * factor)
        if factor > 1 and not self._unstated:
            return self._read(window=window, out_shape=(lines, samples), resampling=Resampling.average)
        pixels = self._read(window=window)
        if self._masked:
            there = self.file.source.dataset_mask(window=window) != 0
            pixels = np.where(there, self._apart(pixels), np.array(self.nodata, dtype=self.dtype))
        return pixels if factor == 1 else self._means(pixels, lines, samples, factor)

    def _read(self, **how: Any) -> NDArray[Any]:
        """All bands in the one type of the orthoimage; rasterio reads bands of different types one by one alone."""
        read = self.file.source.read
        if not self._mixed:
            if "out_shape" in how:
                how["out_shape"] = (self.bands, *how["out_shape"])
            return read(**how)
        return np.stack([read(band, **how).astype(self.dtype) for band in range(1, self.bands + 1)])

    def _means(self, pixels: NDArray[Any], lines: int, samples: int, factor: int) -> NDArray[Any]:
        """Means (bands, lines, samples) of the data among pixels, no data where there is none of it."""
        assert self.nodata is not None
        blocks = pixels.reshape(len(pixels), lines, factor, samples, factor)
        there = self.valid(blocks)
        if there is None:
            there = np.ones(blocks.shape, dtype=bool)
        count = there.sum(axis=(2, 4))
        mean = np.where(there, blocks, 0).sum(axis=(2, 4), dtype=np.float64) / np.maximum(count, 1)
        if self.dtype.kind in "iu":
            mean = self._apart(np.rint(mean))
        return np.where(count > 0, mean, self.nodata).astype(self.dtype)

    def _apart(self, values: NDArray[Any]) -> NDArray[Any]:
        """Values of which none would be taken for no data."""
        if self.dtype.kind not in "iu" or self.nodata is None:
            return values
        step = 1 if self.nodata < np.iinfo(self.dtype).max else -1
        return np.where(values == self.nodata, np.array(self.nodata + step, dtype=values.dtype), values)

    def valid(self, band: NDArray[Any]) -> Mask | None:
        """Which values of a band are data, None for all."""
        if self.nodata is None:
            return np.isfinite(band) if band.dtype.kind == "f" else None
        if np.isnan(self.nodata):
            return np.isfinite(band)
        return band != self.nodata


@dataclass(frozen=True)
class ErrorMap:
    """What a map of sigmas is computed from: errors in the image, and the sigma of the heights."""

    path: Path
    errors: ImageErrors
    height_sigma_m: float


@dataclass
class ImageRectification:
    """One image to one orthoimage.

    Attributes
    ----------
    model : location model of the image
    image, grid, ground : what is rectified, onto what, over what
    resampling : of `kernels.TAPS`
    factor : pixels that are put together each way
    nodata : of the orthoimage
    occlusions : mark cells that the sensor does not see
    direct : pixel to ground, instead of ground to pixel
    tolerance_px : of the polynomial of the indirect way
    workers : threads
    """

    model: Any
    image: SourceImage
    grid: MapGrid
    ground: Ground
    resampling: str = "bilinear"
    factor: int = 1
    nodata: float = 0.0
    occlusions: bool = False
    direct: bool = False
    tolerance_px: float = 0.005
    workers: int = field(default_factory=cores)
    ellipsoid: Ellipsoid = WGS84
    counts: Counts = field(default_factory=Counts)

    def __post_init__(self) -> None:
        self._reach = 0.0
        terrain = self.ground.terrain
        if self.occlusions and isinstance(terrain, HeightRaster):
            self._reach = reach_cells(self.model, terrain, self.ground.low_m, self.ground.high_m) + 1.0
        lat, lon = edge_of(self.model, self.ground)
        self._footprint = np.stack(self.grid.cells(lat, lon), axis=1)
        self._side = TILE
        while self._side > LEAST_TILE and self._side * self._heights_a_cell() > MOST_VALUES:
            self._side //= 2

    def _heights_a_cell(self) -> float:
        """How many values of the raster of heights, a side, a cell in the middle of the orthoimage has."""
        if not isinstance(self.ground.terrain, HeightRaster):
            return 0.0
        column, row = 0.5 * self.grid.columns, 0.5 * self.grid.rows
        lat, lon = self.grid.where(np.array([column, column + 1.0, column]), np.array([row, row, row + 1.0]))
        y, x = self.ground.terrain.place(lat, lon)
        return float(np.max([np.hypot(y[k] - y[0], x[k] - x[0]) for k in (1, 2)]))

    # -- the whole -----------------------------------------------------------------------------------------------------

    def run(
        self,
        output: Path,
        *,
        mask: Path | None = None,
        sigma: ErrorMap | None = None,
        tags: dict[str, str] | None = None,
        compress: str = "deflate",
        told: Callable[[float], None] | None = None,
    ) -> Counts:
        """Write the orthoimage, and beside it the mask of missing cells and the sigmas where they are wanted.

        Raises
        ------
        UserError : nothing of the image lies in the grid, a file cannot be written
        """
        import rasterio

        with ExitStack() as stack:
            stack.enter_context(rasterio.Env(GDAL_CACHEMAX=CACHE_MB))
            words = (tags or {}, self.image.descriptions)
            raster = self._raster(self.image.bands, self.image.dtype.name, self.nodata, *words)
            image = self.image
            raster = replace(raster, scales=image.scales, offsets=image.offsets, units=image.units, colors=image.colors)
            target = stack.enter_context(tiled_orthoimage(output, raster, compress))
            classes = sigmas = None
            if mask is not None:
                meaning = {"classes": ", ".join(f"{k} {text}" for k, text in MISSING.items())}
                raster = self._raster(1, "uint8", None, meaning, ("what is missing",))
                classes = stack.enter_context(tiled_orthoimage(mask, raster, compress, "nearest"))
            if sigma is not None:
                raster = self._raster(2, "float32", float("nan"), tags or {}, SIGMA_BANDS)
                sigmas = stack.enter_context(tiled_orthoimage(sigma.path, raster, compress))
            if self.direct:
                self._run_direct(target, classes, told)
            else:
                self._run_indirect(target, classes, sigma, sigmas, told)
            if not self.counts.cells[MISSING[0]]:
                raise UserError(f"{self.image.path}: nothing of it lies in the orthoimage: {self._why()}")
        return self.counts

    def _why(self) -> str:
        seen = {name: n for name, n in self.counts.cells.items() if n and name != MISSING[0]}
        return ", ".join(f"{n} cells {name}" for name, n in seen.items()) or "the grid lies elsewhere"

    def _raster(
        self, bands: int, dtype: str, nodata: float | None, tags: dict[str, str], descriptions: tuple[str, ...]
    ) -> Raster:
        g = self.grid
        tags = {"TIFFTAG_SOFTWARE": "triline", **tags}
        return Raster(g.crs, g.left, g.top, g.gsd, g.rows, g.columns, bands, dtype, nodata, tags, descriptions)

    def tiles(self) -> Iterator[Tile]:
        """The tiles of the orthoimage, row by row."""
        for row in range(0, self.grid.rows, self._side):
            rows = min(self._side, self.grid.rows - row)
            for column in range(0, self.grid.columns, self._side):
                yield Tile(row, column, rows, min(self._side, self.grid.columns - column))

    def _run_indirect(self, target: Any, classes: Any, sigma: ErrorMap | None, sigmas: Any, told: Any) -> None:
        tiles = list(self.tiles())

        def work(tile: Tile) -> tuple[Tile, Any, Any, Any]:
            return (tile, *self.tile(tile, sigma))

        for k, (tile, values, missing, sigma_values) in enumerate(_in_order(work, tiles, self.workers)):
            self._put(tile, values, missing, sigma_values, target, classes, sigmas)
            if told is not None:
                told((k + 1) / len(tiles))

    def _put(
        self, tile: Tile, values: Any, missing: Any, sigma_values: Any, target: Any, classes: Any, sigmas: Any
    ) -> None:
        self.counts.add(missing)
        if values is not None:
            target.write(tile.row, tile.column, values)
        if classes is not None:
            classes.write(tile.row, tile.column, missing[None])
        if sigmas is not None and sigma_values is not None:
            sigmas.write(tile.row, tile.column, sigma_values)

    # -- one tile, ground to pixel -------------------------------------------------------------------------------------

    def tile(self, tile: Tile, sigma: ErrorMap | None) -> tuple[Any, NDArray[np.uint8], Any]:
        """Values (bands, rows, columns) or None, what is missing (rows, columns), and sigmas (2, rows, columns)."""
        missing = np.full((tile.rows, tile.columns), 1, dtype=np.uint8)
        heights: HeightsOfTile | None = None
        terrain = self.ground.terrain
        if isinstance(terrain, HeightRaster):
            heights = heights_of_tile(tile, self.grid.where, terrain, self._reach)
            if heights is None:
                missing[:] = 2
                return None, missing, None
        values, sigma_values = None, None
        parts = pixels_of_tile(
            self.model, tile, self.grid.where, terrain, heights, self.tolerance_px, self._footprint
        )  # fmt: skip
        for part, pixels in parts:
            here = (
                slice(part.row - tile.row, part.row - tile.row + part.rows),
                slice(part.column - tile.column, part.column - tile.column + part.columns),
            )
            inside = self._inside(pixels.line, pixels.sample, pixels.origin)
            known = missing[here]
            if pixels.height_m is not None:
                known[np.isnan(pixels.height_m)] = 2
            if not inside.any():
                continue
            part_heights = None if heights is None else _part_of(heights, here)
            cells = None
            if sigma is not None or self._reach:
                line, sample = pixels.line + np.float64(pixels.origin[0]), pixels.sample + np.float64(pixels.origin[1])
                height = pixels.height_m if pixels.height_m is not None else self.ground.low_m
                cells = some_cells(line, sample, height, inside)
            raster = terrain if isinstance(terrain, HeightRaster) else None
            if self._reach and cells is not None and part_heights is not None and raster is not None:
                blocked = hidden(self.model, cells, part_heights, raster, inside, self.ellipsoid)
                known[blocked] = 3
                inside &= ~blocked
                if not inside.any():
                    continue
            if values is None:
                values = np.full((self.image.bands, tile.rows, tile.columns), self.nodata, dtype=self.image.dtype)
            self.fill(values[:, here[0], here[1]], known, pixels.line, pixels.sample, pixels.origin, inside)
            if sigma is not None and cells is not None:
                if sigma_values is None:
                    sigma_values = np.full((2, tile.rows, tile.columns), np.nan, dtype=np.float32)
                both = sigmas_of_tile(
                    self.model, cells, sigma.errors, sigma.height_sigma_m, inside.shape, self.ellipsoid, part_heights,
                    raster,
                )  # fmt: skip
                for k, band in enumerate(both):
                    sigma_values[k][here] = np.where(known == 0, band, np.float32(np.nan))
        return values, missing, sigma_values

    def _inside(self, line: Array, sample: Array, origin: tuple[int, int]) -> Mask:
        """Cells (rows, columns) whose place is in the image, half a pixel around its pixels' centres."""
        u0, v0 = -0.5 - origin[0], -0.5 - origin[1]
        with np.errstate(invalid="ignore"):
            return (line >= u0) & (line <= u0 + self.model.lines) & (sample >= v0) & (sample <= v0 + self.model.samples)

    def fill(
        self, values: NDArray[Any], missing: NDArray[np.uint8], line: Array, sample: Array, origin: tuple[int, int],
        inside: Mask,
    ) -> None:  # fmt: skip
        """Resample: values (bands, rows, columns) and what is missing (rows, columns), in place."""
        everywhere = bool(inside.all())
        u, v = (line.ravel(), sample.ravel()) if everywhere else (line[inside], sample[inside])
        factor = self.factor
        lines, samples = self.model.lines // factor, self.model.samples // factor
        u, v = u + np.float32(0.0), v + np.float32(0.0)
        first = np.array(origin, dtype=float)
        if factor > 1:  # places in the image whose pixels were put together
            u, v = u / np.float32(factor), v / np.float32(factor)
            first = (first - 0.5 * (factor - 1)) / factor
        before, taps = TAPS[self.resampling]
        room = before + 1
        u0, v0 = int(np.floor(u.min() + first[0])) - room, int(np.floor(v.min() + first[1])) - room
        u1 = int(np.ceil(u.max() + first[0])) + taps - before + 1
        v1 = int(np.ceil(v.max() + first[1])) + taps - before + 1
        top, left = min(max(u0, 0), lines - 1), min(max(v0, 0), samples - 1)
        bottom, right = max(min(u1, lines), top + 1), max(min(v1, samples), left + 1)
        window = self.image.window(top, left, bottom - top, right - left, factor)
        pad = ((0, 0), (top - u0, u1 - bottom), (left - v0, v1 - right))
        if any(n for pair in pad for n in pair):  # the image goes on as its edge
            window = np.pad(window, pad, mode="edge")
        u += np.float32(first[0] - u0)
        v += np.float32(first[1] - v0)
        valid = [self.image.valid(band) for band in window]
        got, known = resampled(list(window), valid, u, v, self.resampling)
        worst = np.zeros(len(u), dtype=np.uint8)
        some = np.zeros(len(u), dtype=bool)
        for band, (value, there) in enumerate(zip(got, known, strict=True)):
            final = self._finished(value)
            if there is not None:
                final[~there] = self.nodata
                some |= there
            else:
                some[:] = True
            if everywhere:
                values[band] = final.reshape(inside.shape)
            else:
                values[band][inside] = final
        worst[~some] = 4
        missing[inside] = worst

    def _finished(self, value: NDArray[Any]) -> NDArray[Any]:
        """Values in the type of the image; those that would be taken for no data are moved by one step."""
        dtype = self.image.dtype
        if dtype.kind in "iu":
            info = np.iinfo(dtype)
            if value.dtype.kind == "f":
                np.rint(value, out=value)
                if self.resampling in ("cubic", "lanczos"):  # they overshoot
                    np.clip(value, info.min, info.max, out=value)
                value = value.astype(dtype)
            clash = value == self.nodata
            if clash.any():
                value = np.where(clash, dtype.type(self.nodata + (1 if self.nodata < info.max else -1)), value)
            return value
        return value.astype(dtype)

    # -- pixel to ground -----------------------------------------------------------------------------------------------

    def _run_direct(self, target: Any, classes: Any, told: Any) -> None:
        blocks = [(u, v) for u in range(0, self.model.lines, BLOCK_PX) for v in range(0, self.model.samples, BLOCK_PX)]
        total = self.grid.rows * self.grid.columns
        filled = 0
        for k, patch in enumerate(_in_order(self._block, blocks, self.workers)):
            if patch is not None:
                row, column, values, missing, got = patch
                old = target.read(row, column, *missing.shape)
                values = np.where(got, values, old)
                target.write(row, column, values)
                new = got & ~self._held(old).any(axis=0)
                filled += int(new.sum())
                self.counts.cells[MISSING[4]] += int((new & (missing == 4)).sum())
                if classes is not None:
                    before = classes.read(row, column, *missing.shape)[0]
                    classes.write(row, column, np.where(got, missing + 10, before).astype(np.uint8)[None])
            if told is not None:
                told((k + 1) / len(blocks))
        self.counts.cells[MISSING[0]] = filled - self.counts.cells[MISSING[4]]
        self.counts.cells[MISSING[1]] = total - filled
        if classes is not None:  # what no pixel came to is outside; marks of values are taken off
            for tile in self.tiles():
                m = classes.read(tile.row, tile.column, tile.rows, tile.columns)
                classes.write(tile.row, tile.column, np.where(m >= 10, m - 10, 1).astype(np.uint8))

    def _held(self, values: NDArray[Any]) -> Mask:
        """Where values of the orthoimage are something."""
        return ~np.isnan(values) if np.isnan(self.nodata) else values != self.nodata

    def _block(self, first: tuple[int, int]) -> Any:
        """Patch of the orthoimage under a block of pixels: row, column, values, missing, and which cells are new."""
        line, sample = (
            _with_edges(start, min(start + BLOCK_PX, size - 1), size)
            for start, size in zip(first, (self.model.lines, self.model.samples), strict=True)
        )
        mesh = mesh_cells(
            self.model, self.grid, line, sample, self.ground.terrain, self.ground.low_m, self.ground.high_m
        )
        if mesh is None:
            return None
        inside = self._inside(mesh.line, mesh.sample, (0, 0))
        if not inside.any():
            return None
        values = np.full((self.image.bands, *inside.shape), self.nodata, dtype=self.image.dtype)
        missing = np.full(inside.shape, 1, dtype=np.uint8)
        origin = int(mesh.line[inside].min()), int(mesh.sample[inside].min())
        local = ((mesh.line - origin[0]).astype(np.float32), (mesh.sample - origin[1]).astype(np.float32))
        self.fill(values, missing, *local, origin, inside)
        return mesh.row, mesh.column, values, missing, inside


def _with_edges(start: int, stop: int, size: int) -> Array:
    """Pixels from start to stop, and the edge of the image half a pixel outside where they reach it."""
    centres = np.arange(start, stop + 1, dtype=float)
    before = [-0.5] if start == 0 else []
    after = [size - 0.5] if stop == size - 1 else []
    return np.concatenate([before, centres, after])


def _part_of(heights: HeightsOfTile, here: tuple[slice, slice]) -> HeightsOfTile:
    return HeightsOfTile(
        heights.height_m[here], heights.row[here], heights.column[here], heights.values, heights.undulation[here]
    )


def _in_order(work: Callable[[Any], Any], items: list[Any], workers: int) -> Iterator[Any]:
    """Results in the order of the items, worked on by threads; no more than twice as many wait as there are threads."""
    if workers <= 1:
        yield from map(work, items)
        return
    with ThreadPoolExecutor(workers) as pool:
        waiting: deque[Future[Any]] = deque()
        try:
            for item in items:
                waiting.append(pool.submit(work, item))
                if len(waiting) > 2 * workers:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        finally:
            for future in waiting:
                future.cancel()


def edge_of(model: Any, ground: Ground, places: int = EDGE_PLACES) -> tuple[Array, Array]:
    """Latitudes and longitudes (n,), radians, of the ground under the edge of an image and under a net over it."""
    u, v = (np.linspace(-0.5, size - 0.5, min(size + 1, places)) for size in (model.lines, model.samples))
    inner_u, inner_v = (a.ravel() for a in np.meshgrid(u[:: max(len(u) // 20, 1)], v[:: max(len(v) // 20, 1)]))
    line = np.concatenate([u, u, np.full(len(v), u[0]), np.full(len(v), u[-1]), inner_u])
    sample = np.concatenate([np.full(len(u), v[0]), np.full(len(u), v[-1]), v, v, inner_v])
    line = np.clip(line, 0.0, model.lines - 1.0)  # orbit and attitude may end with the image
    points = meet_terrain(model, line, sample, ground.terrain, ground.low_m, ground.high_m)
    return points.lat, points.lon
