"""How well an orthoimage's cells are placed: planimetric and height sigma of what is read from them.

A feature appears in the image with an error (orientation and measurement), which moves its ray over level ground; the
terrain model may be wrong, too. Where the moved ray meets the terrain says `..orthoimage.error_band.on_slope`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..geometry.ellipsoid import Ellipsoid
from ..orthoimage.error_band import LEAST_ANGLE, on_slope
from .cell_to_pixel import HeightsOfTile
from .occlusion import place_slopes
from .sampled import SomeCells, ground_steps, over_cells
from .terrain import Terrain, slopes

Array = NDArray[np.floating]

#: Covariance (n, 2, 2), pixels2, of where points appear, and (n,) variance of their place on the ground, m2 each way,
#: by lines, samples and heights (n,).
ImageErrors = Callable[[Array, Array, Array], tuple[Array, Array]]


def sigmas_of_tile(
    model: Any, cells: SomeCells, errors: ImageErrors, height_sigma_m: float,
    shape: tuple[int, int], ellipsoid: Ellipsoid, heights: HeightsOfTile | None = None, terrain: Terrain | None = None,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:  # fmt: skip
    """Planimetric sigma ``sqrt(sE^2 + sN^2)`` and height sigma (rows, columns) of the cells of a tile, metres.

    Parameters
    ----------
    cells : some cells of the tile
    errors : of the image
    height_sigma_m : of the terrain model
    heights, terrain : None on ground of constant height
    """
    by_pixel, by_height, lat, lon = ground_steps(model, cells, ellipsoid)
    Q, level = errors(cells.line, cells.sample, cells.height_m)
    E = by_pixel @ Q @ np.swapaxes(by_pixel, 1, 2)
    E[:, 0, 0] += level
    E[:, 1, 1] += level
    dense = over_cells(cells, np.column_stack([E[:, 0, 0], E[:, 0, 1], E[:, 1, 1], by_height]), shape)
    e00, e01, e11, g0, g1 = np.moveaxis(dense, -1, 0)
    variance = height_sigma_m**2
    if heights is None or terrain is None:
        planimetric = e00 + e11 + (g0 * g0 + g1 * g1) * variance
        return _root(planimetric), np.full(shape, height_sigma_m, dtype=np.float32)
    M = np.mean(place_slopes(terrain, lat, lon, cells.height_m, ellipsoid), axis=0).astype(np.float32)
    by_row, by_column = slopes(heights.values, heights.row, heights.column)
    s0, s1 = by_row * M[0, 0] + by_column * M[1, 0], by_row * M[0, 1] + by_column * M[1, 1]
    planimetric, height = on_slope(e00, e01, e11, g0, g1, s0, s1, variance)
    return _root(planimetric), _root(height)


def derivatives_on_terrain(level: Array, slope: Array) -> Array:
    """What errors do to the place (n, 3, k) in east, north, up at which rays meet sloping ground.

    A moved ray finds another height, too: ``dh = (s' J e + h) / (1 - s' g)`` and ``dEN = J e + g dh``.

    Parameters
    ----------
    level : (n, 3, k) derivatives at a given height; the last source is the height, and has the way ``g`` of the ray
    slope : (n, 2) ``s``, metres of height a metre east and north

    Returns
    -------
    derivatives ; NaN where the slope is as steep as the ray
    """
    way = level[:, :2, -1]
    angle = 1.0 - np.einsum("ni,ni->n", slope, way)
    angle = np.where(np.abs(angle) < LEAST_ANGLE, np.nan, angle)
    moved = level[:, :2].copy()
    moved[:, :, -1] = 0.0
    height = np.einsum("ni,nik->nk", slope, moved)
    height[:, -1] = 1.0
    height /= angle[:, None]
    return np.concatenate([moved + way[:, :, None] * height[:, None], height[:, None]], axis=1)


def _root(variance: Array) -> NDArray[np.float32]:
    return np.sqrt(np.maximum(variance, 0.0)).astype(np.float32)
