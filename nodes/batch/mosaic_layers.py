"""Layers of a mosaic: one orthoimage a strip or image, on the cells that all share, in files that tiles are read from.

A layer has three files: grey values, how steeply each cell is seen (1 at the ends of the CCD line, or at the edge of
an image, to 255 in the middle; 0 = nothing known), and where they are wanted the sigmas.
"""

from __future__ import annotations

import shutil
from collections import OrderedDict
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from ...solver.orthoimage.mosaic import Mosaic
from ..errors import UserError
from ..formats.geotiff import SIGMA_BANDS, Draft, Raster, pieces_of_raster
from ..formats.height_raster import RasterFile
from ..formats.raster_open import check_grey_values
from .mosaic_jobs import read_json, write_json

Array = NDArray[np.floating]

#: Cells a side of the pieces of a layer, at most.
PIECE = 512
#: Bytes of a layer that are held in memory; what was written to longest ago goes to the disk.
HELD_BYTES = 256 * 2**20
#: Pixels a side, at most, of the reduced mask in which the distance to the edge of an orthoimage is measured.
MASK_SIDE = 1024


@dataclass(frozen=True)
class Layer:
    """What is known of a layer.

    Attributes
    ----------
    name : for people
    camera : what layers of one fall-off of light share; empty for an orthoimage whose camera is not known
    values, steepness, sigma : its files; sigma None without
    row, column, rows, columns : its cells, numbered over the whole projection as in `GroundGrid`
    bands, dtype, nodata : of its values
    tiles : (row, column) of the tiles of the mosaic with something in them
    told : for people: lines, what was left out
    descriptions, scales, offsets, units : of its bands as a `Raster` has them; empty where nothing is stated
    colors : names of what its bands show, of rasterio's ``ColorInterp``; empty where they are grey or nothing is stated
    """

    name: str
    camera: str
    values: str
    steepness: str
    sigma: str | None
    row: int
    column: int
    rows: int
    columns: int
    bands: int
    dtype: str
    nodata: float
    tiles: list[tuple[int, int]]
    told: dict[str, Any]
    descriptions: tuple[str, ...] = ()
    scales: tuple[float, ...] = ()
    offsets: tuple[float, ...] = ()
    units: tuple[str, ...] = ()
    colors: tuple[str, ...] = ()

    def write(self, path: Path) -> None:
        write_json(path, asdict(self))

    @classmethod
    def read(cls, path: Path) -> Layer:
        found = read_json(path)
        found["tiles"] = [tuple(tile) for tile in found["tiles"]]
        found |= {name: tuple(found.get(name, ())) for name in ("descriptions", "scales", "offsets", "units", "colors")}
        return cls(**found)


class SpillingMosaic(Mosaic):
    """A mosaic that keeps a few tiles in memory and the others as files of a folder.

    Parameters
    ----------
    dtype, tile : as of a `Mosaic`
    folder : of the files; emptied before
    sigma : whether tiles have sigmas
    """

    def __init__(self, dtype: np.dtype, tile: int, folder: Path, sigma: bool) -> None:
        super().__init__(dtype, tile)
        self._folder = folder
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        a_tile = tile * tile * (self.dtype.itemsize + 1 + (8 if sigma else 0))
        self._most = max(HELD_BYTES // a_tile, 4)
        self._order: OrderedDict[tuple[int, int], None] = OrderedDict()
        self._spilled: set[tuple[int, int]] = set()

    @property
    def keys(self) -> list[tuple[int, int]]:
        """All tiles, in order."""
        return sorted(self._spilled | self.tiles.keys())

    def _file(self, key: tuple[int, int], what: str) -> Path:
        return self._folder / f"{key[0]}_{key[1]}_{what}.npy"

    def _tile(self, key: tuple[int, int]) -> tuple[NDArray[np.unsignedinteger], NDArray[np.uint8]]:
        if key not in self.tiles:
            if key in self._spilled:
                self._load(key)
            if len(self._order) >= self._most:
                self._spill(self._order.popitem(last=False)[0])
            self._order[key] = None
        else:
            self._order.move_to_end(key)
        return super()._tile(key)

    def _load(self, key: tuple[int, int]) -> None:
        self.tiles[key] = np.load(self._file(key, "values"))
        self._steepness[key] = np.load(self._file(key, "steepness"))
        if self._file(key, "sigma").exists():
            self._sigma[key] = np.load(self._file(key, "sigma"))

    def _spill(self, key: tuple[int, int]) -> None:
        np.save(self._file(key, "values"), self.tiles.pop(key))
        np.save(self._file(key, "steepness"), self._steepness.pop(key))
        if key in self._sigma:
            np.save(self._file(key, "sigma"), self._sigma.pop(key))
        self._spilled.add(key)

    def whole_tile(
        self, key: tuple[int, int]
    ) -> tuple[NDArray[np.unsignedinteger], NDArray[np.uint8], NDArray[np.float32] | None]:
        """Values, steepness and sigmas (2, tile, tile) of a tile that is there."""
        values, steepness = self._tile(key)
        return values, steepness, self._sigma.get(key)

    def close(self) -> None:
        """Remove the files."""
        shutil.rmtree(self._folder, ignore_errors=True)


def layer_of_mosaic(
    mosaic: SpillingMosaic, folder: Path, stem: str, crs: str | None, gsd: float, tile: int, sigma: bool,
    **told: Any,
) -> Layer | None:  # fmt: skip
    """Write the mosaic of one strip as a layer; None if nothing is in it.

    Parameters
    ----------
    folder, stem : of its files
    crs, gsd : of the cells
    tile : cells a side of the tiles of the mosaic of all layers
    told : name, camera and told of the `Layer`

    Raises
    ------
    UserError : a file cannot be written
    """
    keys = mosaic.keys
    if not keys:
        return None
    piece = mosaic.tile
    first = np.array(keys).min(axis=0)
    rows, columns = ((np.array(keys).max(axis=0) - first + 1) * piece).tolist()
    row, column = (first * piece).tolist()
    raster = Raster(crs, column * gsd, -row * gsd, gsd, rows, columns, 1, mosaic.dtype.name, 0)
    paths = [folder / f"{stem}{end}.tif" for end in ("", ".steepness", ".sigma")]
    tiles: set[tuple[int, int]] = set()
    with (
        pieces_of_raster(paths[0], raster, piece) as values,
        pieces_of_raster(paths[1], _like(raster, "uint8", 1, 0), piece) as steepness,
    ):

        def write(sigmas: Draft | None) -> None:
            for key in keys:
                grey, steep, sigma_m = mosaic.whole_tile(key)
                if not steep.any():
                    continue
                r, c = key[0] * piece - row, key[1] * piece - column
                values.write(r, c, np.where(steep > 0, grey, 0)[None])
                steepness.write(r, c, steep[None])
                if sigmas is not None:
                    empty = np.full((2, piece, piece), np.nan, dtype=np.float32)
                    sigmas.write(r, c, empty if sigma_m is None else sigma_m)
                tiles.add((key[0] * piece // tile, key[1] * piece // tile))

        if sigma:
            with pieces_of_raster(paths[2], _like(raster, "float32", 2, float("nan")), piece) as sigmas:
                write(sigmas)
        else:
            write(None)
    return Layer(
        values=str(paths[0]), steepness=str(paths[1]), sigma=str(paths[2]) if sigma else None, row=row, column=column,
        rows=rows, columns=columns, bands=1, dtype=mosaic.dtype.name, nodata=0.0, tiles=sorted(tiles), **told,
    )  # fmt: skip


def _like(raster: Raster, dtype: str, bands: int, nodata: float) -> Raster:
    return Raster(
        raster.crs, raster.left, raster.top, raster.gsd, raster.rows, raster.columns, bands, dtype, nodata,
        descriptions=SIGMA_BANDS if bands == 2 else (),
    )  # fmt: skip


def layer_of_orthoimage(
    path: Path, sigma: Path | None, folder: Path, stem: str, crs: str, gsd: float, tile: int, name: str
) -> Layer:
    """A finished orthoimage as a layer: its values stay where they are, the steepness is the distance to its edge.

    A mask of the file, or a band that says how opaque the others are (alpha), tells which cells count; such a band
    takes no part itself.

    Parameters
    ----------
    name : of the layer, for people

    Raises
    ------
    UserError : not an orthoimage of that CRS and on those cells, or a file cannot be written
    """
    from rasterio.enums import MaskFlags
    from rasterio.windows import Window

    source = RasterFile(path)
    row, column = _place(path, source, crs, gsd)
    if sigma is not None:
        other = RasterFile(sigma)
        if _place(sigma, other, crs, gsd) != (row, column) or (other.rows, other.columns) != (
            source.rows, source.columns
        ):  # fmt: skip
            raise UserError(f"{sigma}: its cells are not those of {path}")
    dtype, about = np.dtype(source.dtype), source.source
    check_grey_values(path, about)
    bands, masked = _grey_bands(about), any(MaskFlags.per_dataset in flags for flags in about.mask_flag_enums)
    nodata = about.nodata
    if nodata is None:
        nodata = float("nan") if dtype.kind == "f" else 0.0
    factor = max(-(-max(source.rows, source.columns) // MASK_SIDE), 1)
    shape = -(-source.rows // factor), -(-source.columns // factor)
    known = np.zeros(shape, dtype=bool)
    for r in range(0, shape[0], 64):  # the nearest value of each place, a few rows at a time
        high = min(64, shape[0] - r)
        rows = min(high * factor, source.rows - r * factor)
        window = Window(0, r * factor, source.columns, rows)
        values = about.read(bands, window=window, out_shape=(len(bands), high, shape[1]))
        known[r : r + high] = _valid(values, float("nan") if masked else nodata).all(axis=0)
        if masked:
            known[r : r + high] &= about.dataset_mask(window=window, out_shape=(high, shape[1])) != 0
    if not known.any():
        raise UserError(f"{path}: holds no value")
    inside = np.asarray(distance_transform_edt(np.pad(known, 1)))[1:-1, 1:-1].astype(np.float32)
    middle = float(inside.max())
    steepness = folder / f"{stem}.steepness.tif"
    raster = Raster(crs, column * gsd, -row * gsd, gsd, source.rows, source.columns, 1, "uint8", 0)
    tiles: set[tuple[int, int]] = set()
    with pieces_of_raster(steepness, raster, PIECE) as target:
        for r in range(0, source.rows, PIECE):
            for c in range(0, source.columns, PIECE):
                h, w = min(PIECE, source.rows - r), min(PIECE, source.columns - c)
                valid = _valid(_read(source, r, c, h, w), float("nan") if masked else nodata).all(axis=0)
                if masked:
                    valid &= about.dataset_mask(window=Window(c, r, w, h)) != 0
                if not valid.any():
                    continue
                steep = 1.0 + 254.0 * _between(inside, factor, r, c, h, w) / middle
                target.write(r, c, np.where(valid, np.clip(np.rint(steep), 1, 255), 0).astype(np.uint8)[None])
                for i in range((row + r) // tile, (row + r + h - 1) // tile + 1):
                    tiles |= {(i, j) for j in range((column + c) // tile, (column + c + w - 1) // tile + 1)}
    of = np.array(bands) - 1
    scales, offsets, units, words = (
        tuple(np.array(values, dtype=object)[of].tolist())
        for values in (about.scales, about.offsets, about.units, about.descriptions)
    )
    colors = tuple(about.colorinterp[k].name for k in of)
    scaled = any(scale != 1.0 for scale in scales) or any(offsets)
    told = {}
    if len(bands) < source.count:
        told["notes"] = ["its alpha band says which cells count, and is no band of the mosaic"]
    return Layer(
        name, "", str(path), str(steepness), None if sigma is None else str(sigma), row, column, source.rows,
        source.columns, len(bands), dtype.name, float(nodata), sorted(tiles), told,
        descriptions=tuple(text or "" for text in words) if any(words) else (),
        scales=scales if scaled else (), offsets=offsets if scaled else (),
        units=tuple(unit or "" for unit in units) if any(units) else (),
        colors=() if {"gray", "undefined"}.issuperset(colors) else colors,
    )  # fmt: skip


def _grey_bands(source: Any) -> list[int]:
    """Numbers, from 1, of the bands of a dataset that are not how opaque the others are."""
    from rasterio.enums import ColorInterp

    return [k for k, shows in enumerate(source.colorinterp, 1) if shows != ColorInterp.alpha] or list(source.indexes)


def _place(path: Path, source: RasterFile, crs: str, gsd: float) -> tuple[int, int]:
    """First row and column of an orthoimage, numbered over the whole projection."""
    from rasterio.crs import CRS

    t = source.transform
    if source.crs is None:
        raise UserError(f"{path}: has no coordinate reference system; wanted an orthoimage, or --sensor with it")
    if CRS.from_user_input(source.crs) != CRS.from_user_input(crs):
        raise UserError(f"{path}: is not in {crs}: wanted orthoimages of one CRS (--crs of each)")
    if t.b or t.d or abs(t.a + t.e) > 1e-9 * abs(t.a) or abs(t.a / gsd - 1.0) > 1e-9:
        raise UserError(f"{path}: cells of {abs(t.a):g} x {abs(t.e):g}, wanted {gsd:g} (--gsd of each)")
    place = -t.f / gsd, t.c / gsd
    whole = round(place[0]), round(place[1])
    if max(abs(a - b) for a, b in zip(place, whole, strict=True)) > 0.01:
        raise UserError(f"{path}: its cells do not lie at whole multiples of {gsd:g}, as those of triline rectify do")
    return whole


def _read(source: RasterFile, row: int, column: int, rows: int, columns: int) -> NDArray[Any]:
    from rasterio.windows import Window

    window = Window(column, row, columns, rows)
    return source.source.read(_grey_bands(source.source), window=window)


def _valid(values: NDArray[Any], nodata: float) -> NDArray[np.bool_]:
    if np.isnan(nodata):
        return np.isfinite(values)
    return (values != nodata) & np.isfinite(values)


def _between(mask: Array, factor: int, row: int, column: int, rows: int, columns: int) -> Array:
    """Values of a reduced raster at the cells of a window, bilinear."""
    u = np.clip((np.arange(row, row + rows) + 0.5) / factor - 0.5, 0, mask.shape[0] - 1)
    v = np.clip((np.arange(column, column + columns) + 0.5) / factor - 0.5, 0, mask.shape[1] - 1)
    i, j = u.astype(int), v.astype(int)
    i1, j1 = np.minimum(i + 1, mask.shape[0] - 1), np.minimum(j + 1, mask.shape[1] - 1)
    a, b = (u - i)[:, None], (v - j)[None]
    low = mask[np.ix_(i, j)] * (1 - b) + mask[np.ix_(i, j1)] * b
    high = mask[np.ix_(i1, j)] * (1 - b) + mask[np.ix_(i1, j1)] * b
    return low * (1 - a) + high * a


# -- windows of layers -----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Window:
    """A layer in a window of the mosaic.

    Attributes
    ----------
    index : of the layer
    values : (bands, rows, columns) float32
    known : (rows, columns)
    off_middle : (rows, columns) 0 in the middle of the CCD line to 1 at its ends
    """

    index: int
    values: NDArray[np.float32]
    known: NDArray[np.bool_]
    off_middle: NDArray[np.float32]


@lru_cache(maxsize=48)
def _opened(path: str) -> RasterFile:
    return RasterFile(Path(path))


def windows_of_layers(layers: list[Layer], row: int, column: int, rows: int, columns: int) -> list[Window]:
    """The layers with something in a window of the mosaic."""
    out = []
    for index, layer in enumerate(layers):
        steep = _window(layer.steepness, layer, row, column, rows, columns, 0)
        if steep is None or not steep.any():
            continue
        values = _window(layer.values, layer, row, column, rows, columns, layer.nodata)
        assert values is not None
        known = steep[0] > 0
        off = np.where(known, (np.float32(255.0) - steep[0]) / np.float32(254.0), np.float32(1.0)).astype(np.float32)
        out.append(Window(index, np.where(known, values, 0).astype(np.float32), known, off))
    return out


def sigma_of_layer(layer: Layer, row: int, column: int, rows: int, columns: int) -> NDArray[np.float32]:
    """Sigmas (2, rows, columns) of a layer, NaN where not known."""
    found = None
    if layer.sigma is not None:
        found = _window(layer.sigma, layer, row, column, rows, columns, float("nan"))
    return np.full((2, rows, columns), np.nan, dtype=np.float32) if found is None else found


def _window(
    path: str, layer: Layer, row: int, column: int, rows: int, columns: int, fill: float
) -> NDArray[Any] | None:
    r0, r1 = max(row, layer.row), min(row + rows, layer.row + layer.rows)
    c0, c1 = max(column, layer.column), min(column + columns, layer.column + layer.columns)
    if r0 >= r1 or c0 >= c1:
        return None
    part = _read(_opened(path), r0 - layer.row, c0 - layer.column, r1 - r0, c1 - c0)
    if part.shape[1:] == (rows, columns):
        return part
    out = np.full((part.shape[0], rows, columns), fill, dtype=part.dtype)
    out[:, r0 - row : r1 - row, c0 - column : c1 - column] = part
    return out


def forget_files() -> None:
    """Close the files of layers; wanted before they are written anew."""
    _opened.cache_clear()
