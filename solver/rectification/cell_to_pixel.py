"""From the cells of a tile to the pixels of an image, by any location model (indirect rectification).

Line and sample are smooth in column, row and height. The model is asked at nodes of the tile and at some heights; the
polynomial through them is held against the model between the nodes, and has more of both until it agrees, or the tile
is quartered. So only the nodes pay for orbit, attitude and refraction, and the relief acts on every cell.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .nodes import lagrange, over_tile, places
from .terrain import Terrain, bilinear

Array = NDArray[np.floating]
Float32 = NDArray[np.float32]
Mask = NDArray[np.bool_]

#: Largest difference, pixels, between polynomial and model where they are compared.
TOLERANCE_PX = 0.005
#: Largest difference of places in the raster of heights, its cells. Derived: a hundredth of a cell of 30 m moves the
#: height by less than the heights are good for, even on a slope of 45 degrees.
TOLERANCE_HEIGHT_CELLS = 0.01
#: Nodes a side and heights that are tried; beyond the last the tile is quartered. Of a satellite three heights do; over
#: relief of a third of the flying height seven.
NODES = ((3, 3), (5, 3), (5, 5), (9, 5), (9, 7))
#: A tile of fewer cells a side is not quartered any more: each of its cells is asked.
SMALLEST_TILE = 24
#: Pixels around the image, beside its own size, for which the model is asked, so that tiles at the edge have all nodes.
MARGIN_PX = 64.0

#: Latitude and longitude (radians) of columns and rows (n,), (n,).
CellPlaces = Callable[[Array, Array], tuple[Array, Array]]


class Inverse(Protocol):
    """Any model with inverse location."""

    lines: int
    samples: int

    def inverse(self, lat: ArrayLike, lon: ArrayLike, height_m: ArrayLike, margin_px: float) -> Array:
        """Line and sample, (n, 2), NaN further than the margin outside the image."""
        ...


@dataclass(frozen=True)
class Tile:
    """A rectangle of cells; the first row and column, and how many."""

    row: int
    column: int
    rows: int
    columns: int

    def quarters(self) -> Iterator[Tile]:
        """Four tiles, or two where it is narrow."""
        rows = [self.rows // 2, self.rows - self.rows // 2] if self.rows > 1 else [self.rows]
        columns = [self.columns // 2, self.columns - self.columns // 2] if self.columns > 1 else [self.columns]
        for i, height in enumerate(rows):
            for j, width in enumerate(columns):
                yield Tile(self.row + i * rows[0], self.column + j * columns[0], height, width)


@dataclass(frozen=True)
class Pixels:
    """Pixels of the cells of a tile.

    Attributes
    ----------
    line, sample : (rows, columns) less the whole numbers of `origin`; NaN where no height is known, or no pixel
    origin : line and sample
    height_m : (rows, columns) above the ellipsoid, None where it is the same everywhere
    nodes : a side, of the polynomial that was used; 0 where every cell was asked
    """

    line: Float32
    sample: Float32
    origin: tuple[int, int]
    height_m: Float32 | None
    nodes: int


@dataclass(frozen=True)
class HeightsOfTile:
    """Heights of the cells of a tile and what they were taken from.

    Attributes
    ----------
    height_m : (rows, columns) above the ellipsoid
    row, column : (rows, columns) places in `values`
    values : (m, k) window of the raster
    undulation : (rows, columns) or one
    """

    height_m: Float32
    row: Float32
    column: Float32
    values: Float32
    undulation: Float32


def node_grid(tile: Tile, count: int) -> tuple[Array, Array]:
    """Columns and rows (k, m), (k, m) of the nodes of a tile."""
    rows = tile.row + places(tile.rows, min(count, tile.rows))
    columns = tile.column + places(tile.columns, min(count, tile.columns))
    return tuple(np.meshgrid(columns, rows))


def heights_of_tile(tile: Tile, where: CellPlaces, terrain: Terrain, reach: float = 0.0) -> HeightsOfTile | None:
    """Heights of all cells of a tile; None where the raster knows none of them.

    Parameters
    ----------
    reach : how far around the tile values are wanted, cells of the raster
    """
    for count in (3, 5, 9, 17):
        column, row = node_grid(tile, count)
        lat, lon = where(column.ravel(), row.ravel())
        y, x = (a.reshape(column.shape) for a in terrain.place(lat, lon))
        if count == 17 or _smooth(tile, where, terrain, y, x):
            break
    if not (np.isfinite(y).all() and np.isfinite(x).all()):
        return None
    top, left = int(np.floor(y.min() - reach)) - 1, int(np.floor(x.min() - reach)) - 1
    height, width = int(np.ceil(y.max() + reach)) + 2 - top, int(np.ceil(x.max() + reach)) + 2 - left
    values = terrain.heights(top, left, height, width)
    if not np.isfinite(values).any():
        return None
    at_row, at_column = over_tile(y - top, tile.rows, tile.columns), over_tile(x - left, tile.rows, tile.columns)
    N = terrain.undulation(lat, lon).reshape(column.shape)
    if np.isfinite(N).all():
        N = over_tile(N, tile.rows, tile.columns)
    else:  # what lies beyond the raster would spoil the polynomial
        every = np.meshgrid(tile.column + np.arange(tile.columns), tile.row + np.arange(tile.rows))
        lat, lon = where(*(np.ravel(a).astype(float) for a in every))
        N = terrain.undulation(lat, lon).reshape(tile.rows, tile.columns).astype(np.float32)
    z = bilinear(values, at_row, at_column)
    z += N
    return HeightsOfTile(z, at_row, at_column, values, N) if np.isfinite(z).any() else None


def _smooth(tile: Tile, where: CellPlaces, terrain: Terrain, y: Array, x: Array) -> bool:
    """Whether the polynomial through places in the raster holds between its nodes."""
    (rows, columns), A, B = _between(tile, y.shape)
    column, row = np.meshgrid(columns, rows)
    lat, lon = where(column.ravel(), row.ravel())
    true = terrain.place(lat, lon)
    return all(
        not np.abs((A @ got @ B.T).ravel() - want).max() > TOLERANCE_HEIGHT_CELLS
        for got, want in zip((y, x), true, strict=True)
    )


def _between(tile: Tile, shape: tuple[int, ...]) -> tuple[tuple[Array, Array], Array, Array]:
    """Rows and columns between the nodes of a tile, and the matrices from the nodes to them."""
    axes, matrices = [], []
    for first, length, count in zip((tile.row, tile.column), (tile.rows, tile.columns), shape, strict=True):
        nodes = places(length, count)
        middle = 0.5 * (nodes[1:] + nodes[:-1]) if count > 1 else nodes
        axes.append(first + middle)
        matrices.append(lagrange(nodes, middle))
    return (axes[0], axes[1]), matrices[0], matrices[1]


def pixels_of_tile(
    model: Inverse,
    tile: Tile,
    where: CellPlaces,
    terrain: Terrain | float,
    ellipsoidal: HeightsOfTile | None = None,
    tolerance_px: float = TOLERANCE_PX,
    footprint: Array | None = None,
) -> Iterator[tuple[Tile, Pixels]]:
    """Pixels of the cells of a tile, part by part; parts without any are left out.

    Parameters
    ----------
    model : location model
    where : latitude and longitude of cells
    terrain : raster of heights, or one height above the ellipsoid
    ellipsoidal : heights of the tile, where they are at hand already
    tolerance_px : the polynomial's
    footprint : (n, 2) columns and rows of ground points of the image, so that an image smaller than a tile is found

    Yields
    ------
    tile, pixels : the parts of the tile that may see the image
    """
    height: Float32 | float
    if isinstance(terrain, float | int):
        height = float(terrain)
    else:
        heights = ellipsoidal or heights_of_tile(tile, where, terrain)
        if heights is None:
            return
        height = heights.height_m
    yield from _part(_Work(model, where, tolerance_px, tile, height, footprint), tile)


@dataclass(frozen=True)
class _Work:
    """What all parts of a tile share."""

    model: Inverse
    where: CellPlaces
    tolerance: float
    whole: Tile
    height: Float32 | float
    footprint: Array | None

    @property
    def margin(self) -> float:
        """Pixels outside the image at which nodes are still answered: its own size, and that of the tile."""
        size = float(max(self.model.lines, self.model.samples))
        if self.footprint is not None and np.isfinite(self.footprint).any():
            cells = max(float(np.nanmax(np.nanmax(self.footprint, axis=0) - np.nanmin(self.footprint, axis=0))), 1.0)
            return MARGIN_PX + size * (1.0 + 2.0 * max(self.whole.rows, self.whole.columns) / cells)
        return MARGIN_PX + 2.0 * size

    def ask(self, column: Array, row: Array, levels: Array) -> Array:
        """Line and sample (levels, k, m, 2) of the model at columns and rows (k, m) and heights."""
        lat, lon = self.where(column.ravel(), row.ravel())
        n = len(lat)
        pixel = self.model.inverse(
            np.tile(lat, len(levels)), np.tile(lon, len(levels)), np.repeat(levels, n), self.margin
        )
        return pixel.reshape(len(levels), *column.shape, 2)

    def height_of(self, tile: Tile) -> Float32 | None:
        """Heights of the cells of a part, None where it is the same everywhere."""
        if not isinstance(self.height, np.ndarray):
            return None
        row, column = tile.row - self.whole.row, tile.column - self.whole.column
        return self.height[row : row + tile.rows, column : column + tile.columns]

    def range_of(self, height: Float32 | None) -> tuple[float, float]:
        """Lowest and highest height of a part; of the whole tile where the part has none."""
        if not isinstance(self.height, np.ndarray):
            return self.height, self.height
        some = height if height is not None and np.isfinite(height).any() else self.height
        return float(np.nanmin(some)), float(np.nanmax(some))


def _part(work: _Work, tile: Tile) -> Iterator[tuple[Tile, Pixels]]:
    h = work.height_of(tile)
    low, high = work.range_of(h)
    found, levels = None, np.array([low])
    level = high - low < 1e-3
    for count, heights in dict.fromkeys((count, 1) for count, _ in NODES) if level else NODES:
        levels = _levels(low, high, heights)
        values = work.ask(*node_grid(tile, count), levels)
        missed = np.isnan(values).any(axis=-1)
        if missed.all() and not _touches(work.footprint, tile):
            return
        if missed.any():
            break
        if not _may_see(work.model, values):
            return
        if _agrees(work, tile, values, levels):
            found = values
            break
    if found is not None:
        yield tile, _dense(tile, found, levels, h)
    elif max(tile.rows, tile.columns) > SMALLEST_TILE:
        for quarter in tile.quarters():
            yield from _part(work, quarter)
    else:
        yield tile, _every(work, tile, low, h)


def _touches(footprint: Array | None, tile: Tile) -> bool:
    """Whether a ground point (column, row) of the image lies in a tile, or next to it."""
    if footprint is None:
        return False
    low = np.array([tile.column, tile.row]) - 2.0
    high = np.array([tile.column + tile.columns, tile.row + tile.rows]) + 1.0
    return bool(((footprint >= low) & (footprint <= high)).all(axis=1).any())


def _may_see(model: Inverse, values: Array) -> bool:
    """Whether pixels at the nodes leave it possible that one of the tile is in the image."""
    flat = values.reshape(-1, 2)
    low, high = flat.min(axis=0), flat.max(axis=0)
    room = 1.0 + 0.1 * (high - low)
    return bool((high + room >= -0.5).all() and (low - room <= np.array([model.lines, model.samples]) - 0.5).all())


def _levels(low: float, high: float, count: int) -> Array:
    """Heights, ``count`` of them, that the model is asked at."""
    return np.array([low]) if count == 1 else low + (high - low) / (count - 1) * places(count, count)


def _agrees(work: _Work, tile: Tile, values: Array, levels: Array) -> bool:
    """Whether the polynomial gives what the model gives between the nodes, and between the heights."""
    (rows, columns), A, B = _between(tile, values.shape[1:3])
    column, row = np.meshgrid(columns, rows)
    middle = len(levels) // 2
    between = levels if len(levels) == 1 else 0.5 * levels[middle - 1 : middle] + 0.5 * levels[middle]
    true = work.ask(column, row, between)[0]
    if np.isnan(true).any():
        return False
    at = np.einsum("i,ijkc->jkc", lagrange(levels, between)[0], values)
    got = np.einsum("ij,jkc,lk->ilc", A, at, B)
    return not np.abs(got - true).max() > work.tolerance


def _taylor(values: Array) -> Array:
    """Coefficients (n, k, m) of a polynomial in the height, from -1 (lowest) to 1, of values at n heights."""
    n = len(values)
    share = 2.0 / (n - 1) * places(n, n) - 1.0
    return np.einsum("ij,jkm->ikm", np.linalg.inv(np.vander(share, increasing=True)), values)


def _dense(tile: Tile, values: Array, levels: Array, height: Float32 | None) -> Pixels:
    """The polynomial at all cells."""
    base = values[len(levels) // 2]
    origin = np.floor(base.reshape(-1, 2).mean(axis=0))
    coordinates = []
    t = None
    if height is not None and len(levels) > 1:
        low, high = levels[0], levels[-1]
        t = (height - np.float32(0.5 * (low + high))) * np.float32(2.0 / (high - low))
    for k in range(2):
        out = over_tile(base[..., k] - origin[k], tile.rows, tile.columns)
        if t is not None:
            terms = list(_taylor(values[..., k])[1:])
            while len(terms) > 1 and np.abs(terms[-1]).max() < 0.1 * TOLERANCE_PX:
                terms.pop()
            slope = _flat_or_dense(terms.pop(), tile)
            while terms:
                slope = _flat_or_dense(terms.pop(), tile) + t * slope
            out += slope * t
        elif height is not None:
            out += np.where(np.isfinite(height), np.float32(0.0), np.float32(np.nan))
        coordinates.append(out)
    count = max(values.shape[1:3])
    return Pixels(coordinates[0], coordinates[1], (int(origin[0]), int(origin[1])), height, count)


def _flat_or_dense(values: Array, tile: Tile) -> Float32 | np.float32:
    middle = 0.5 * (values.max() + values.min())
    if np.abs(values - middle).max() < 0.1 * TOLERANCE_PX:
        return np.float32(middle)
    return over_tile(values, tile.rows, tile.columns)


def _every(work: _Work, tile: Tile, level: float, height: Float32 | None) -> Pixels:
    """Every cell asked, at the edge of what the model covers."""
    row, column = np.mgrid[tile.row : tile.row + tile.rows, tile.column : tile.column + tile.columns].astype(float)
    lat, lon = work.where(column.ravel(), row.ravel())
    h = np.full(len(lat), level) if height is None else height.ravel().astype(float)
    pixel = np.full((len(lat), 2), np.nan)
    known = np.isfinite(h)
    if known.any():
        pixel[known] = work.model.inverse(lat[known], lon[known], h[known], 0.5)
    seen = np.isfinite(pixel[:, 0])
    origin = np.floor(pixel[seen].mean(axis=0)) if seen.any() else np.zeros(2)
    line, sample = (pixel - origin).T.reshape(2, tile.rows, tile.columns).astype(np.float32)
    return Pixels(line, sample, (int(origin[0]), int(origin[1])), height, 0)
