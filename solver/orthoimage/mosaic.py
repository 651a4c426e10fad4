"""Patches put together: a mosaic in square tiles that are there only where there is something in them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .ground_grid import CellWindow
from .strip import Patch

TILE = 512


class Mosaic:
    """An orthoimage that grows.

    Where several strips show a cell, the one that sees it most steeply counts.

    Parameters
    ----------
    dtype : of the pixels
    tile : cells a side

    Attributes
    ----------
    tiles : (row, column) of a tile -> (tile, tile) grey values, 0 = nothing known
    changed : tiles that were written to since somebody emptied this set
    """

    def __init__(self, dtype: np.dtype | type = np.uint16, tile: int = TILE) -> None:
        self.dtype, self.tile = np.dtype(dtype), tile
        self.tiles: dict[tuple[int, int], NDArray[np.unsignedinteger]] = {}
        self.changed: set[tuple[int, int]] = set()
        self._steepness: dict[tuple[int, int], NDArray[np.uint8]] = {}
        self._sigma: dict[tuple[int, int], NDArray[np.float32]] = {}

    @property
    def nbytes(self) -> int:
        return len(self.tiles) * self.tile**2 * (self.dtype.itemsize + 1)

    def add(self, patch: Patch) -> None:
        """Put a patch where it belongs."""
        tile = self.tile
        at = 0
        for row, column, length in zip(patch.row.tolist(), patch.column.tolist(), patch.length.tolist(), strict=True):
            i, r = divmod(row, tile)
            end = at + length
            while at < end:
                j, c = divmod(column, tile)
                n = min(end - at, tile - c)
                pixels, steepness = self._tile((i, j))
                new = patch.steepness[at : at + n]
                old = steepness[r, c : c + n]
                better = new > old
                np.copyto(pixels[r, c : c + n], patch.values[at : at + n], where=better)
                np.copyto(old, new, where=better)
                if patch.sigma_m is not None:
                    mine = self._sigma_tile((i, j))[:, r, c : c + n]
                    np.copyto(mine, patch.sigma_m[at : at + n].T, where=better)
                at += n
                column += n

    def _tile(self, key: tuple[int, int]) -> tuple[NDArray[np.unsignedinteger], NDArray[np.uint8]]:
        self.changed.add(key)
        found = self.tiles.get(key)
        if found is None:
            found = self.tiles[key] = np.zeros((self.tile, self.tile), dtype=self.dtype)
            self._steepness[key] = np.zeros((self.tile, self.tile), dtype=np.uint8)
        return found, self._steepness[key]

    def _sigma_tile(self, key: tuple[int, int]) -> NDArray[np.float32]:
        if key not in self._sigma:
            self._sigma[key] = np.full((2, self.tile, self.tile), np.nan, dtype=np.float32)
        return self._sigma[key]

    def clip(self, part: CellWindow) -> None:
        """Forget what lies beside a part."""
        for i, j in list(self.tiles):
            inside = np.zeros((self.tile, self.tile), dtype=bool)
            inside[
                max(part.row0 - i * self.tile, 0) : max(part.row1 - i * self.tile, 0),
                max(part.column0 - j * self.tile, 0) : max(part.column1 - j * self.tile, 0),
            ] = True
            self.tiles[i, j][~inside] = self._steepness[i, j][~inside] = 0
            if (i, j) in self._sigma:
                self._sigma[i, j][:, ~inside] = np.nan
            if not self.tiles[i, j].any():
                del self.tiles[i, j], self._steepness[i, j]
                self._sigma.pop((i, j), None)

    def extent(self) -> tuple[int, int, int, int]:
        """First and last-plus-one row, first and last-plus-one column of cells with something in them.

        Raises
        ------
        ValueError : there are none
        """
        box = None
        for (i, j), pixels in self.tiles.items():
            rows, columns = np.flatnonzero(pixels.any(axis=1)), np.flatnonzero(pixels.any(axis=0))
            if not len(rows):
                continue
            mine = np.array([i * self.tile + rows[0], j * self.tile + columns[0]])
            end = np.array([i * self.tile + rows[-1] + 1, j * self.tile + columns[-1] + 1])
            box = (mine, end) if box is None else (np.minimum(box[0], mine), np.maximum(box[1], end))
        if box is None:
            raise ValueError("the orthoimage is empty")
        return int(box[0][0]), int(box[1][0]), int(box[0][1]), int(box[1][1])

    def read(self, row0: int, row1: int, column0: int, column1: int) -> NDArray[np.unsignedinteger]:
        """Cells of a window (rows, columns), 0 where nothing is known."""
        out = np.zeros((row1 - row0, column1 - column0), dtype=self.dtype)
        self._fill(out, self.tiles, row0, column0)
        return out

    def read_sigma(self, row0: int, row1: int, column0: int, column1: int) -> NDArray[np.float32]:
        """Sigmas of a window (2, rows, columns), m: in the plane, of the height; NaN where nothing is known."""
        out = np.full((2, row1 - row0, column1 - column0), np.nan, dtype=np.float32)
        self._fill(out, self._sigma, row0, column0)
        return out

    def _fill(self, out: NDArray[Any], tiles: Mapping[tuple[int, int], NDArray[Any]], row0: int, column0: int) -> None:
        """Copy what tiles (..., tile, tile) hold of a window (..., rows, columns) into it."""
        tile = self.tile
        row1, column1 = row0 + out.shape[-2], column0 + out.shape[-1]
        for i in range(row0 // tile, -(-row1 // tile)):
            for j in range(column0 // tile, -(-column1 // tile)):
                found = tiles.get((i, j))
                if found is None:
                    continue
                r0, r1 = max(row0, i * tile), min(row1, (i + 1) * tile)
                c0, c1 = max(column0, j * tile), min(column1, (j + 1) * tile)
                out[..., r0 - row0 : r1 - row0, c0 - column0 : c1 - column0] = found[
                    ..., r0 - i * tile : r1 - i * tile, c0 - j * tile : c1 - j * tile
                ]
