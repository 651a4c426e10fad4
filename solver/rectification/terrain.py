"""Heights of the ground: a constant height above the ellipsoid, or a raster with a vertical datum."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating]


#: Places that are spread over more cells than twice as many a side are looked up in squares with so many a side, each
#: by a window of the raster of its own. Tuned: larger takes more memory, smaller more time.
SQUARE_CELLS = 1024
#: Places that are worked on at once. Tuned: what is computed on the way stays in the processor's cache.
PORTION = 32_768


class Terrain(Protocol):
    """A raster of heights of any extent; rows and columns are whole numbers at the places of its values."""

    #: size of a cell, metres, the smaller of its two sides
    cell_m: float

    def place(self, lat: Array, lon: Array) -> tuple[Array, Array]:
        """Row and column (...) of latitudes and longitudes (...), radians."""
        ...

    def undulation(self, lat: Array, lon: Array) -> Array:
        """Height (...) of the zero of the raster's heights above the ellipsoid, metres; NaN where unknown."""
        ...

    def heights(self, row: int, column: int, rows: int, columns: int) -> NDArray[np.float32]:
        """Values of a window, NaN where nothing is known or the raster ends."""
        ...


def squares(row: Array, column: Array) -> Iterator[NDArray[np.intp]]:
    """Indices of places (n,) of a raster, square by square, so that none takes a window of more than its own."""
    every = np.arange(len(row))
    if not len(row):
        return
    if max(np.ptp(row), np.ptp(column)) <= 2 * SQUARE_CELLS:
        yield every
        return
    i, j = (np.floor((at - at.min()) / SQUARE_CELLS).astype(np.int64) for at in (row, column))
    key = i * (int(j.max()) + 1) + j
    order = np.argsort(key, kind="stable")
    yield from np.split(every[order], np.flatnonzero(np.diff(key[order])) + 1)


def bilinear(z: NDArray[np.float32], row: Array, column: Array) -> NDArray[np.float32]:
    """Values between the nodes of a grid at rows and columns (...), NaN next to unknown nodes and outside."""
    rows, columns = z.shape
    if row.size and row.min() >= 0 and row.max() < rows - 1 and column.min() >= 0 and column.max() < columns - 1:
        return _inside(z, row, column).reshape(np.shape(row))
    i, j = np.floor(row), np.floor(column)
    a, b = (row - i).astype(np.float32), (column - j).astype(np.float32)
    with np.errstate(invalid="ignore"):
        inside = (i >= 0) & (i <= rows - 1) & (j >= 0) & (j <= columns - 1)
    whole = bool(inside.all())
    if not whole:
        i, j = np.where(inside, i, 0.0), np.where(inside, j, 0.0)
    # on the last row or column the neighbour beyond has no weight
    at_row, at_column = i.astype(np.intp), j.astype(np.intp)
    below, right = np.minimum(at_row + 1, rows - 1), np.minimum(at_column + 1, columns - 1)
    flat = z.ravel()
    at_row *= columns
    below *= columns
    upper = flat.take(at_row + at_column)
    upper += b * (flat.take(at_row + right) - upper)
    lower = flat.take(below + at_column)
    lower += b * (flat.take(below + right) - lower)
    lower -= upper
    lower *= a
    upper += lower
    if not whole:
        upper[~inside] = np.nan
    return upper


def _inside(z: NDArray[np.float32], row: Array, column: Array) -> NDArray[np.float32]:
    """The same where all places have their four nodes; in portions that stay in the processor's cache."""
    flat, columns = np.ravel(z), z.shape[1]
    row, column = np.ravel(row), np.ravel(column)
    out = np.empty(row.shape, dtype=np.float32)
    for k in range(0, len(row), PORTION):
        y, x = row[k : k + PORTION], column[k : k + PORTION]
        i, j = y.astype(np.int32), x.astype(np.int32)
        a, b = (y - i).astype(np.float32, copy=False), (x - j).astype(np.float32, copy=False)
        i *= columns
        i += j
        at = i.astype(np.intp)
        upper, lower = (_along(flat[start:], at, b) for start in (0, columns))
        lower -= upper
        lower *= a
        upper += lower
        out[k : k + PORTION] = upper
    return out


def _along(flat: NDArray[np.float32], at: NDArray[np.intp], b: NDArray[np.float32]) -> NDArray[np.float32]:
    left, right = flat.take(at, mode="clip"), flat[1:].take(at, mode="clip")
    right -= left
    right *= b
    right += left
    return right


def slopes(z: NDArray[np.float32], row: Array, column: Array) -> tuple[Array, Array]:
    """Change of height per row and per column (...) of the bilinear surface, NaN as in `bilinear`."""
    rows, columns = z.shape
    with np.errstate(invalid="ignore"):
        i = np.clip(np.floor(np.nan_to_num(row)), 0, max(rows - 2, 0)).astype(np.intp)
        j = np.clip(np.floor(np.nan_to_num(column)), 0, max(columns - 2, 0)).astype(np.intp)
    a, b = row - i, column - j
    z00, z01, z10, z11 = z[i, j], z[i, j + 1], z[i + 1, j], z[i + 1, j + 1]
    return (1 - b) * (z10 - z00) + b * (z11 - z01), (1 - a) * (z01 - z00) + a * (z11 - z10)
