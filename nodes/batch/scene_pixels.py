"""Images of satellite scenes in pieces: grey values of one band, of a weighted sum, or the mean of all bands."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Hashable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import UserError
from ..formats.satellite.read import IMAGES
from ..formats.scene_block import ImageEntry
from ..formats.tiff_image import open_tiff
from .image_rectification import SourceImage

#: Side of the pieces that are read at once, px, and how many are kept of all images together: 256 MB.
TILE, KEPT = 512, 256
#: Pieces that are looked at to judge the range of the values of an image that is not as it is taken.
LOOKED_AT = 16
#: Values of other images become grey values up to this.
GREY = 4000.0


class Tiles:
    """Pieces of images that were read last."""

    def __init__(self) -> None:
        self._kept: OrderedDict[Hashable, NDArray[np.float32]] = OrderedDict()

    def get(self, key: Hashable, read: Callable[[], NDArray[np.float32]]) -> NDArray[np.float32]:
        """A piece, read where it is not among them."""
        if key in self._kept:
            self._kept.move_to_end(key)
        else:
            self._kept[key] = read()
            if len(self._kept) > KEPT:
                self._kept.popitem(last=False)
        return self._kept[key]


class ScenePixels:
    """An image as `solver.matching.scene_patches.Pixels`; 8 and 16 bits of one band are grey values as they are.

    Parameters
    ----------
    image : on disk
    weights : of its bands, by index from 0
    first : (line, sample) of the scene with which the image begins
    tiles : that images share
    """

    def __init__(self, image: SourceImage, weights: dict[int, float], first: tuple[int, int], tiles: Tiles):
        self.image, self.weights, self.first, self._tiles = image, weights, first, tiles
        self._name = image.path, tuple(weights.items())  # scenes may be bands of one file
        self.end = first[0] + image.lines, first[1] + image.samples
        kind = image.dtype
        plain = list(weights.values()) == [1.0] and kind.kind == "u" and kind.itemsize <= 2
        self.saturated = float(np.iinfo(kind).max) if plain else np.inf
        self._span = None if plain else self._range()

    def window(self, line: int, sample: int, lines: int, samples: int) -> NDArray[np.float32]:
        """Grey values (lines, samples) from a pixel of the scene on; 0 outside the image and where it has no data."""
        out = np.zeros((lines, samples), dtype=np.float32)
        line, sample = line - self.first[0], sample - self.first[1]
        low, high = (max(line, 0), max(sample, 0)), (
            min(line + lines, self.image.lines), min(sample + samples, self.image.samples)
        )  # fmt: skip
        if low[0] >= high[0] or low[1] >= high[1]:
            return out
        for row in range(low[0] // TILE, -(-high[0] // TILE)):
            for column in range(low[1] // TILE, -(-high[1] // TILE)):
                tile = self._tiles.get((self._name, row, column), lambda r=row, c=column: self._tile(r, c))
                top, left = max(row * TILE, low[0]), max(column * TILE, low[1])
                bottom, right = min((row + 1) * TILE, high[0]), min((column + 1) * TILE, high[1])
                out[top - line : bottom - line, left - sample : right - sample] = tile[
                    top - row * TILE : bottom - row * TILE, left - column * TILE : right - column * TILE
                ]
        return out

    def _tile(self, row: int, column: int) -> NDArray[np.float32]:
        """Grey values of a piece."""
        values, there = self._values(row, column)
        if self._span is not None:
            low, high = self._span
            values = np.clip(1.0 + (values - low) * ((GREY - 1.0) / (high - low)), 1.0, GREY)
        return np.where(there, values, 0.0).astype(np.float32)

    def _values(self, row: int, column: int) -> tuple[NDArray[np.floating], NDArray[np.bool_]]:
        """The weighted sum of the bands in a piece, and where all of them have data."""
        from rasterio.errors import RasterioError

        line, sample = row * TILE, column * TILE
        size = min(TILE, self.image.lines - line), min(TILE, self.image.samples - sample)
        try:
            bands = self.image.window(line, sample, *size)
        except RasterioError as error:
            where = f"lines {line} to {line + size[0] - 1}"
            raise UserError(f"{self.image.path}: {where}: {' '.join(str(error).split())}; damaged?") from None
        total, there = np.zeros(size), np.ones(size, dtype=bool)
        for band, weight in self.weights.items():
            valid = self.image.valid(bands[band])
            there &= True if valid is None else valid
            total += weight * np.where(there, bands[band], 0.0)
        return total, there

    def _range(self) -> tuple[float, float]:
        """Values that nearly all pixels lie between, by some pieces.

        Raises
        ------
        UserError : an image without data, or of one value
        """
        rows, columns = (-(-n // TILE) for n in (self.image.lines, self.image.samples))
        number = rows * columns
        values = []
        for k in np.unique(np.linspace(0, number - 1, min(LOOKED_AT, number)).astype(int)):
            piece, there = self._values(int(k) // columns, int(k) % columns)
            values.append(piece[there])
        seen = np.concatenate(values)
        low, high = np.percentile(seen, [0.1, 99.9]).tolist() if len(seen) else (0.0, 0.0)
        if not low < high:
            raise UserError(f"{self.image.path}: nothing but one value, wanted an image")
        return low, high


def image_of(folder: Path, entry: ImageEntry) -> Path | None:
    """The image of a scene, or of one of its lines of detectors; None where nobody names it."""
    if entry.image:
        return folder / entry.image
    own = folder / entry.scene.metadata  # polynomials in the tags of the image itself, or in a file beside it
    return own if own.suffix.lower() in IMAGES else None


def open_scene_image(path: Path, entry: ImageEntry, tiles: Tiles, notes: list[str]) -> ScenePixels:
    """An image of `image_of`.

    Raises
    ------
    UserError : one that cannot be read, or that is not as large as its scene
    """
    image = SourceImage(path)
    if image.file.crs is not None and not image.file.transform.is_identity:
        notes.append(
            f"{path.name}: has coordinates; its pixels are taken as the scene's: an orthoimage has none any more"
        )
    weights = _weights(entry, image, notes)
    return ScenePixels(image, weights, _first_pixel(entry, image, notes), tiles)


def _weights(entry: ImageEntry, image: SourceImage, notes: list[str]) -> dict[int, float]:
    """Of the bands: those that project.toml names, or the mean of all."""
    if entry.scene.band:
        return open_tiff(image.path).weights(entry.scene.band)
    bands = [k for k, shown in enumerate(image.colors) if shown.name != "alpha"]
    if len(bands) > 1:
        notes.append(f"{image.path.name}: the mean of {len(bands)} bands (`band` of its scene takes others)")
    return {k: 1.0 / len(bands) for k in bands}


def _first_pixel(entry: ImageEntry, image: SourceImage, notes: list[str]) -> tuple[int, int]:
    """Line and sample of the scene with which the image begins."""
    size = entry.size_px
    given = entry.scene.first_pixel
    crop = image.crop() if given is None else (given[1], given[0])
    if given is None and crop is not None and not entry.image:
        raise UserError(
            f"{image.path}: a part of a scene by its geotransform, with RPC of its own: wanted first_pixel = "
            f"[{crop[1]}, {crop[0]}] of its scene if these are of the whole scene, else [0, 0]"
        )
    if crop is None:
        if size is not None and size != (image.lines, image.samples):
            raise UserError(
                f"{image.path}: {image.lines} lines of {image.samples} samples, wanted {size[0]} of {size[1]} as scene "
                f"{entry.name} has, or `first_pixel = [column, row]` of a part of it"
            )
        return 0, 0
    line, sample = crop
    if given is None:
        notes.append(f"{image.path.name}: a part of the scene, first pixel at column {sample}, row {line} by its "
                     "geotransform")  # fmt: skip
    end = line + image.lines, sample + image.samples
    if min(crop) < 0 or (size is not None and (end[0] > size[0] or end[1] > size[1])):
        of = f" of {size[1]} x {size[0]} pixels" if size else ""
        raise UserError(
            f"{image.path}: columns {sample} to {end[1] - 1}, rows {line} to {end[0] - 1} do not lie in scene "
            f"{entry.name}{of}"
        )
    return line, sample
