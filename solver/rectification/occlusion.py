"""Which cells of a tile the sensor does not see because the relief stands between."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter

from ..geometry.ellipsoid import Ellipsoid
from .cell_to_pixel import HeightsOfTile
from .sampled import SomeCells, ground_steps, metres_a_radian, over_cells
from .terrain import Terrain, bilinear, slopes, squares

Array = NDArray[np.floating]

#: Step along a ray, cells of the raster; and how far the ground must stand above the ray, metres.
STEP_CELLS, CLEAR_M = 0.5, 0.05
#: Clearances are computed at cells so far apart, cells of the raster. Tuned: shadows end within a tenth of a cell.
KNOT_CELLS = 0.25


def hidden(
    model: Any, cells: SomeCells, heights: HeightsOfTile, terrain: Terrain, inside: NDArray[np.bool_],
    ellipsoid: Ellipsoid,
) -> NDArray[np.bool_]:  # fmt: skip
    """Cells (rows, columns) whose ray to the sensor meets higher ground.

    Parameters
    ----------
    model : location model
    cells : some cells of the tile
    heights : of the tile, with the raster around it as far as rays reach below its highest ground
    inside : (rows, columns) cells that see the image
    """
    _, by_height, lat, lon = ground_steps(model, cells, ellipsoid)
    by_place = place_slopes(terrain, lat, lon, cells.height_m, ellipsoid)
    along = over_cells(cells, np.einsum("nij,nj->ni", by_place, by_height), inside.shape)
    # the clearance of a ray changes as slowly as the raster does: some cells are enough where its cells are larger
    knots = [_knots(n, axis, heights) for axis, n in enumerate(inside.shape)]
    net = np.ix_(*knots)
    N = np.broadcast_to(heights.undulation, inside.shape)[net]
    clear = clearance(heights.values, N, heights.row[net], heights.column[net], heights.height_m[net], along[net])
    if clear.shape == inside.shape:
        return inside & (clear < -CLEAR_M)
    place = np.ix_(*[np.interp(np.arange(n), k, np.arange(len(k))) for n, k in zip(inside.shape, knots, strict=True)])
    return inside & (bilinear(clear, *np.broadcast_arrays(*place)) < -CLEAR_M)


def _knots(length: int, axis: int, heights: HeightsOfTile) -> NDArray[np.intp]:
    """Cells along an axis that are a share of a cell of the raster apart, the first and the last among them."""
    if length < 3:
        return np.arange(length)
    row, column = (np.moveaxis(a, axis, 0) for a in (heights.row, heights.column))
    step = float(np.hypot(row[-1] - row[0], column[-1] - column[0]).max()) / (length - 1)
    apart = int(np.clip(KNOT_CELLS / max(step, 1e-6), 1, length - 1))
    return np.unique(np.append(np.arange(0, length - 1, apart), length - 1))


def clearance(
    values: NDArray[np.float32], N: Array, row: Array, column: Array, h: Array, along: Array
) -> NDArray[np.float32]:
    """How far rays stay above the ground on their way to the sensor (...), metres; below zero where they do not.

    Parameters
    ----------
    values : (m, k) heights of the ground, metres; NaN, which hides nothing, where none is known
    N : (...) height that these count from, in the system of ``h``, metres
    row, column : (...) places in ``values`` where the rays meet the ground
    h : (...) heights there, metres; NaN for rays that nothing is asked of
    along : (..., 2) change of row and column a metre of height along the rays
    """
    shape = h.shape
    row, column, h, N = (np.ravel(a).astype(np.float32) for a in (row, column, h, N))
    by_row, by_column = along[..., 0].ravel(), along[..., 1].ravel()
    out = np.full(h.shape, np.inf, dtype=np.float32)
    speed = float(np.hypot(by_row, by_column).max())
    top = _tops(values, row, column, h - N, speed) + N
    left = np.flatnonzero(np.isfinite(h) & (h < top))
    step = STEP_CELLS / speed if speed > 0 else np.inf
    up = np.float32(0.0)
    while len(left) and np.isfinite(step):
        up += np.float32(step)
        ground = bilinear(values, row[left] + up * by_row[left], column[left] + up * by_column[left])
        room = h[left] + up - N[left] - ground
        out[left] = np.fmin(out[left], room)
        left = left[h[left] + up < top[left]]
    # above the highest ground everywhere: a number that can be carried between cells
    return np.minimum(out, np.float32(1e4)).reshape(shape)


def _tops(values: NDArray[np.float32], row: Array, column: Array, h: Array, speed: float) -> NDArray[np.float32]:
    """Highest ground (n,) that rays from places (n,) and heights (n,) may meet on their way up, metres.

    ``speed`` : cells of the raster that they move at most a metre of height
    """
    highest, rows, columns = np.float32(np.nanmax(values)), *values.shape
    low = np.nanmin(h) if np.isfinite(h).any() else highest
    side = int(np.ceil(speed * max(float(highest - low), 0.0))) + 2
    if 4 * side > max(rows, columns):
        return np.full(row.shape, highest, dtype=np.float32)
    # of squares as wide as the longest way, and of those around
    tops = np.where(np.isnan(values), -np.inf, values)
    for axis, size in enumerate((rows, columns)):
        tops = np.maximum.reduceat(tops, np.arange(0, size, side), axis=axis)
    tops = maximum_filter(tops, size=3, mode="nearest")
    at = (
        np.clip(np.nan_to_num(a) // side, 0, n - 1).astype(np.intp)
        for a, n in zip((row, column), tops.shape, strict=True)
    )
    return np.asarray(tops[tuple(at)], dtype=np.float32)


def place_slopes(terrain: Terrain, lat: Array, lon: Array, height_m: Array, ellipsoid: Ellipsoid) -> Array:
    """Change (n, 2, 2) of row and column in the raster a metre east and north."""
    east, north = metres_a_radian(lat, height_m, ellipsoid)
    step = 10.0
    base = np.stack(terrain.place(lat, lon), axis=-1)
    to_east = np.stack(terrain.place(lat, lon + step / east), axis=-1)
    to_north = np.stack(terrain.place(lat + step / north, lon), axis=-1)
    return np.stack([to_east - base, to_north - base], axis=-1) / step


def ground_slopes(terrain: Terrain, lat: Array, lon: Array, height_m: Array, ellipsoid: Ellipsoid) -> Array:
    """Slope (n, 2) of the terrain at places (n,), metres of height a metre east and north; NaN where none is known."""
    row, column = terrain.place(lat, lon)
    by_cell = np.empty((len(row), 2))
    for part in squares(row, column):
        y, x = row[part], column[part]
        top, left = int(np.floor(y.min())) - 1, int(np.floor(x.min())) - 1
        z = terrain.heights(top, left, int(np.ceil(y.max())) + 2 - top, int(np.ceil(x.max())) + 2 - left)
        by_cell[part] = np.stack(slopes(z, y - top, x - left), axis=-1)
    return np.einsum("nij,ni->nj", place_slopes(terrain, lat, lon, height_m, ellipsoid), by_cell)


def reach_cells(model: Any, terrain: Terrain, low_m: float, high_m: float) -> float:
    """How far, in cells of the raster, rays of an image move between two heights."""
    u, v = np.meshgrid(np.linspace(0, model.lines - 1, 5), np.linspace(0, model.samples - 1, 5))
    u, v = u.ravel(), v.ravel()
    places = []
    for h in (low_m, high_m):
        located = model.direct(u, v, np.full(len(u), h))
        places.append(np.stack(terrain.place(located[:, 0], located[:, 1]), axis=1))
    way = np.linalg.norm(places[1] - places[0], axis=1)
    return float(np.nanmax(way)) if np.isfinite(way).any() else 0.0
