"""The mosaic of a block: layers are balanced, parted by seams and blended, tile by tile, in bounded memory.

The stages, each of jobs that leave a file (`mosaic_jobs`): layers (by the caller), tones of places in overlaps, the
balance, labels of nodes, cells of tiles; then the tiles are put together to one file.

Seams do not end at the borders of tiles, although tiles are jobs of their own: they are worked on in four rounds, those
of even rows and columns first, so that no two tiles of a round touch. Each one sees some nodes beyond its border, and
nodes there that an earlier round has labelled keep their labels.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...solver.matching.line_quality import FULL_SCALES
from ...solver.orthoimage.seams import feather_weights, label_cost, seam_labels, seam_lines
from ...solver.orthoimage.tone_balance import ToneBalance, ToneSamples, balance, held_out
from ...solver.rectification.grid import transformer_to
from ..errors import UserError
from ..formats.geojson import write_line_features
from ..formats.geotiff import (
    SIGMA_BANDS,
    Raster,
    TilePlace,
    cloud_optimised,
    is_virtual,
    write_tile,
    write_virtual,
)
from ..formats.new_file import new_file
from .mosaic_jobs import Job, Workers, read_json, write_json
from .mosaic_layers import Layer, Window, sigma_of_layer, windows_of_layers

Array = NDArray[np.floating]
Key = tuple[int, int]

#: Cells a side of the nodes that seams go between, and nodes beyond its border that a tile sees.
NODE, BEYOND = 4, 16
#: Layers are left as they are where places that the balance was not computed from agree less than so many times as well
#: with it. Tuned: what does no harm to see is kept, so that its gains and sigmas are told.
WORTH = 0.95
#: Cells a side of the places whose mean grey values are balanced, and how many a tile gives at most.
PLACE, MOST_PLACES = 16, 200
#: Places a side of the parts of a tile whose errors are taken to be alike in the sigmas of the balance.
PART = 8
#: Balances: none, gain and offset, these and the fall-off of light along the CCD line.
BALANCES = ("none", "gain", "fall-off")
#: Seams: least cuts, or halfway between the middles of the strips.
SEAMS = ("cut", "middle")


@dataclass(frozen=True)
class MosaicSettings:
    """How layers are put together.

    Attributes
    ----------
    crs : of the cells; None for the local frame
    gsd : size of a cell
    tile : cells a side of a tile
    balance, seams : of `BALANCES`, `SEAMS`
    feather : cells over which one layer changes to the next
    sigma : whether there are sigmas
    """

    crs: str | None
    gsd: float
    tile: int
    balance: str
    seams: str
    feather: int
    sigma: bool

    def halo(self) -> int:
        """Cells beyond its border that a tile is blended from: whole nodes."""
        return -(-max(self.feather, 1) // NODE) * NODE + NODE


def layers_in(folder: Path) -> list[Layer]:
    """The layers that were written, in order; those with nothing in them are left out."""
    return [Layer.read(path) for path in sorted((folder / "layers").glob("*.json")) if not _is_empty(path)]


def empty_layers(folder: Path) -> list[str]:
    """Names of strips of which nothing could be rectified."""
    return [read_json(path) for path in sorted((folder / "layers").glob("*.json")) if _is_empty(path)]


def _is_empty(path: Path) -> bool:
    return not isinstance(read_json(path), dict)


def _check_layers(layers: list[Layer]) -> None:
    """Refuse layers that cannot be put together.

    Raises
    ------
    UserError : nothing in any of them, other numbers of bands or data types, values of other scales or units, bands of
        other colours
    """
    if not layers:
        raise UserError("nothing to put together: no strip or image has a cell in the mosaic")
    one = layers[0]
    for layer in layers[1:]:
        if (layer.bands, layer.dtype) != (one.bands, one.dtype):
            raise UserError(
                f"{layer.name}: {layer.bands} bands of {layer.dtype}, but {one.name} has {one.bands} of {one.dtype}: "
                "wanted one kind of image"
            )
        for what in ("scales", "offsets", "units"):
            mine, others = getattr(layer, what), getattr(one, what)
            if mine != others:
                raise UserError(
                    f"{layer.name}: {what} of its bands: {_listed(mine)}, but {one.name} has {_listed(others)}: "
                    "wanted values that mean the same"
                )
    coloured = [layer for layer in layers if layer.colors]
    for layer in coloured[1:]:
        if layer.colors != coloured[0].colors:
            raise UserError(
                f"{layer.name}: its bands are {_listed(layer.colors)}, but those of {coloured[0].name} "
                f"{_listed(coloured[0].colors)}: wanted bands that mean the same"
            )


def _listed(values: tuple[object, ...]) -> str:
    return ", ".join(map(str, values)) or "none"


def tiles_of(layers: list[Layer]) -> dict[Key, list[int]]:
    """Tile -> layers with something in it, in order of tiles."""
    out: dict[Key, list[int]] = {}
    for k, layer in enumerate(layers):
        for tile in layer.tiles:
            out.setdefault(tile, []).append(k)
    return dict(sorted(out.items()))


def make_mosaic(
    folder: Path, layers: list[Layer], settings: MosaicSettings, workers: Workers,
    told: Callable[[float], None] | None = None,
) -> dict[str, int]:  # fmt: skip
    """Do all jobs after the layers; returns how many of each kind there are, and how many were done already.

    Raises
    ------
    UserError : of a job
    """
    _check_layers(layers)
    tiles = tiles_of(layers)
    for name in ("tones", "labels", "tiles"):
        (folder / name).mkdir(exist_ok=True)
    done: dict[str, int] = {"tiles": len(tiles), "layers": len(layers), "done before": 0}
    size = settings.tile

    def near(key: Key, beyond: int) -> list[int]:
        """Layers in a tile and as far beyond it as is looked at."""
        reach = -(-beyond // size)
        around = range(-reach, reach + 1)
        return sorted({k for i in around for j in around for k in tiles.get((key[0] + i, key[1] + j), [])})

    def stage(work: Callable[..., None], jobs: list[Job], begin: float, end: float) -> None:
        def mine(share: float) -> None:
            if told is not None:
                told(begin + (end - begin) * share)

        done["done before"] += workers.run(work, jobs, mine)

    several = [key for key, there in tiles.items() if len(there) > 1]
    jobs = [
        Job(_file(folder, "tones", key, "npz"), (folder, key, _some(layers, tiles[key]), settings)) for key in several
    ]
    stage(tones_job, jobs, 0.0, 0.15)
    write_balance(folder, layers, several, settings)
    rounds = {(i, j): [key for key in tiles if (key[0] % 2, key[1] % 2) == (i, j)] for i in (0, 1) for j in (0, 1)}
    share = 0.15
    for keys in rounds.values():
        jobs = [
            Job(_file(folder, "labels", key, "npy"), (folder, key, _some(layers, near(key, BEYOND * NODE)), settings))
            for key in keys
        ]
        following = share + 0.35 * len(keys) / len(tiles)
        stage(labels_job, jobs, share, following)
        share = following
    jobs = [
        Job(
            _file(folder, "tiles", key, "json"),
            (folder, key, _some(layers, near(key, settings.halo())), settings, layers[0].nodata),
        )
        for key in tiles
    ]
    stage(cells_job, jobs, 0.5, 1.0)
    return done


def _some(layers: list[Layer], indices: list[int]) -> dict[int, Layer]:
    return {k: layers[k] for k in indices}


def _file(folder: Path, kind: str, key: Key, end: str) -> Path:
    return folder / kind / f"{key[0]}_{key[1]}.{end}"


def _save(path: Path, **arrays: NDArray[Any]) -> None:
    with new_file(path) as part, open(part, "wb") as file:
        np.savez_compressed(file, allow_pickle=False, **arrays)


# -- tones ---------------------------------------------------------------------------------------------------------


def tones_job(folder: Path, key: Key, layers: dict[int, Layer], settings: MosaicSettings) -> None:
    """Mean grey values of some places of a tile that several layers show."""
    size = settings.tile
    windows = _windows(layers, key[0] * size, key[1] * size, size, size)
    n = size // PLACE
    seen, values, off, rough = [], [], [], []
    for w in windows:
        whole = _places(w.known, n).mean(axis=(2, 3)) == 1.0
        largest = _largest(layers[w.index].dtype, w.values)
        for band in w.values:  # what is saturated says nothing of its radiance
            whole &= _places(band, n).max(axis=(2, 3)) < largest
        seen.append(whole)
        values.append([_places(band, n).mean(axis=(2, 3)) for band in w.values])
        off.append(np.sqrt(_places(w.off_middle.astype(np.float64) ** 2, n).mean(axis=(2, 3))))
    stack = np.array(seen).reshape(len(windows), n, n)
    r, c = np.nonzero(stack.sum(axis=0) >= 2)
    if len(r) > MOST_PLACES:
        pick = np.sort(np.random.default_rng([abs(key[0]), abs(key[1])]).choice(len(r), MOST_PLACES, replace=False))
        r, c = r[pick], c[pick]
    place, layer, grey, middle = [], [], [], []
    for k in range(len(r)):
        at = (r[k], c[k])
        there = [m for m in range(len(windows)) if stack[m][at]]
        cells = (slice(r[k] * PLACE, (r[k] + 1) * PLACE), slice(c[k] * PLACE, (c[k] + 1) * PLACE))
        first, other = windows[there[0]], windows[there[1]]
        d = first.values[:, cells[0], cells[1]] - other.values[:, cells[0], cells[1]]
        rough.append(float((d - d.mean(axis=(1, 2), keepdims=True)).std()))
        for m in there:
            place.append(k)
            layer.append(windows[m].index)
            grey.append([band[at] for band in values[m]])
            middle.append(off[m][at])
    _save(
        _file(folder, "tones", key, "npz"),
        place=np.array(place, dtype=np.int64), layer=np.array(layer, dtype=np.int64),
        value=np.array(grey, dtype=float).reshape(len(place), next(iter(layers.values())).bands),
        off_middle=np.array(middle, dtype=float),
        rough=np.array(rough, dtype=float), part=(r // PART) * (n // PART + 1) + c // PART,
    )  # fmt: skip


def _places(cells: NDArray[Any], n: int) -> NDArray[Any]:
    """Cells (rows, columns) as places: (n, n, PLACE, PLACE)."""
    return cells.reshape(n, PLACE, n, PLACE).swapaxes(1, 2)


def _largest(dtype: str, values: NDArray[np.float32]) -> float:
    """Grey value at which a layer is saturated, by its type and its values: those of 12 bits stand in 16."""
    kind = np.dtype(dtype)
    if kind.kind not in "iu":
        return np.inf
    top = float(values.max(initial=0.0))
    return top if kind.itemsize > 1 and top in FULL_SCALES else float(np.iinfo(kind).max)


def _windows(layers: dict[int, Layer], row: int, column: int, rows: int, columns: int) -> list[Window]:
    found = windows_of_layers(list(layers.values()), row, column, rows, columns)
    names = list(layers)
    return [replace(w, index=names[w.index]) for w in found]


def write_balance(folder: Path, layers: list[Layer], several: list[Key], settings: MosaicSettings) -> None:
    """Adjust gains, offsets and fall-offs, band by band, and keep them with the usual difference between layers."""
    cameras = list(dict.fromkeys(layer.camera or f"of {layer.name}" for layer in layers))
    camera = np.array([cameras.index(layer.camera or f"of {layer.name}") for layer in layers])
    known = {layer.camera for layer in layers if layer.camera}
    fall_off = np.array([settings.balance == "fall-off" and name in known for name in cameras])
    parts = []
    for number, key in enumerate(several):
        with np.load(_file(folder, "tones", key, "npz")) as found:
            parts.append((number, {name: found[name] for name in found}))
    rough = np.concatenate([p["rough"] for _, p in parts] or [np.ones(0)])
    # of a mean absolute difference; a whole grey value keeps it from nothing
    usual = max(0.8 * float(np.median(rough)), 0.5 if layers[0].dtype[0] in "iu" else 1e-12) if len(rough) else 1.0
    samples, worth = [], None
    if settings.balance != "none" and len(rough):
        samples = [_samples(parts, band, settings.tile) for band in range(layers[0].bands)]
        worth = float(np.exp(np.mean([np.log(held_out(s, camera, fall_off)) for s in samples])))
    if worth is None or worth < WORTH:
        results = [ToneBalance.none(camera)] * layers[0].bands
    else:
        results = [balance(s, camera, fall_off) for s in samples]
    bands = [{k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in asdict(r).items()} for r in results]
    told = {"cameras": cameras, "usual_difference": usual, "bands": bands, "places": len(rough), "worth": worth}
    write_json(folder / "balance.json", told)


def _samples(parts: list[tuple[int, dict[str, Any]]], band: int, tile: int) -> ToneSamples:
    """What the tiles measured in a band, by their numbers."""
    places, group, first = [], [], 0
    for number, p in parts:
        places.append(p["place"] + first)
        first += len(p["rough"])
        group.append(number * (tile // PLACE) ** 2 + p["part"])
    return ToneSamples(
        np.concatenate(places), np.concatenate([p["layer"] for _, p in parts]),
        np.concatenate([p["value"][:, band] for _, p in parts]),
        np.concatenate([p["off_middle"] for _, p in parts]), np.concatenate(group),
    )  # fmt: skip


def balance_left_out(folder: Path) -> str:
    """Why layers have the tone that they came with although a balance was asked for; "" if they are balanced."""
    found = read_json(folder / "balance.json")
    worth = found.get("worth")
    if worth is None or worth >= WORTH:
        return ""
    return (
        f"one that is computed from half of the {found['places']} places makes the others agree {1 / worth:.1f} times "
        "worse: too few places, or layers that do not show the same ground"
    )


def read_balance(folder: Path) -> tuple[list[ToneBalance], float]:
    """The balance of each band, and the usual difference between balanced layers."""
    found = read_json(folder / "balance.json")
    bands = [
        ToneBalance(
            np.array(b["gain"]), np.array(b["offset"]), np.array(b["fall_off"]), np.array(b["camera"]),
            np.array(b["covariance"]), b["sigma0"], b["places"], b["refused"], np.array(b["tied"]),
        )
        for b in found["bands"]
    ]  # fmt: skip
    return bands, found["usual_difference"]


def _balanced(windows: list[Window], bands: list[ToneBalance]) -> list[NDArray[np.float32]]:
    """Balanced values (bands, rows, columns) of each window."""
    out = []
    for w in windows:
        off = np.minimum(w.off_middle, np.float32(1.0))
        out.append(np.stack([b.radiance(w.index, v, off) for b, v in zip(bands, w.values, strict=True)]))
    return out


# -- seams ---------------------------------------------------------------------------------------------------------


def labels_job(folder: Path, key: Key, layers: dict[int, Layer], settings: MosaicSettings) -> None:
    """Labels of the nodes of a tile: numbers of layers, -1 where there is none."""
    size, n = settings.tile, settings.tile // NODE
    target = _file(folder, "labels", key, "npy")
    wide = n + 2 * BEYOND
    row, column = key[0] * size - BEYOND * NODE, key[1] * size - BEYOND * NODE
    windows = _windows(layers, row, column, wide * NODE, wide * NODE)
    labels = np.full((wide, wide), -1)
    if windows:
        bands, usual = read_balance(folder)
        # a node is known where one of its cells is, so that none of them is lost
        some = np.stack([_nodes(w.known, wide).any(axis=(2, 3)) for w in windows])
        whole = np.stack([_nodes(w.known, wide).all(axis=(2, 3)) for w in windows])
        known = np.where(whole.any(axis=0), whole, some)
        off = np.stack([_nodes(w.off_middle, wide).mean(axis=(2, 3)) for w in windows])
        sigma = None
        if settings.sigma:
            sigma = np.stack(
                [
                    _nodes(sigma_of_layer(layers[w.index], row, column, wide * NODE, wide * NODE)[0], wide)[
                        :, :, NODE // 2, NODE // 2
                    ]
                    for w in windows
                ]
            )
        cost = label_cost(known, off, sigma)
        if settings.seams == "middle":
            nearest = np.argmin(np.where(known, off, np.inf), axis=0)
            found = np.where(known.any(axis=0), nearest, -1)
        else:
            difference = _differences(windows, _balanced(windows, bands), known, wide) / usual
            fixed = _labelled(folder, key, wide, [w.index for w in windows], n)
            found = seam_labels(cost, difference, fixed)
        numbers = np.array([w.index for w in windows] + [-1])
        labels = numbers[found]
    core = labels[BEYOND : BEYOND + n, BEYOND : BEYOND + n].astype(np.int16)
    with new_file(target) as part, open(part, "wb") as file:
        np.save(file, core, allow_pickle=False)


def _nodes(cells: NDArray[Any], n: int) -> NDArray[Any]:
    return cells.reshape(n, NODE, n, NODE).swapaxes(1, 2)


def _differences(windows: list[Window], values: list[NDArray[np.float32]], known: Any, n: int) -> Array:
    """Mean absolute difference (L, L, n, n) of layers in nodes, NaN where one of them is not known."""
    count = len(windows)
    out = np.full((count, count, n, n), np.nan)
    for a in range(count):
        for b in range(a + 1, count):
            both = windows[a].known & windows[b].known
            d = np.where(both, np.abs(values[a] - values[b]).mean(axis=0), np.float32(0.0))
            cells = _nodes(both, n).sum(axis=(2, 3))
            mean = _nodes(d, n).sum(axis=(2, 3)) / np.maximum(cells, 1)
            out[a, b] = out[b, a] = np.where((cells > 0) & known[a] & known[b], mean, np.nan)
    return out


def _around(folder: Path, key: Key, n: int, beyond: int) -> NDArray[np.int16]:
    """Labels of a tile and of nodes beyond its border, -2 where they are not known yet."""
    wide = n + 2 * beyond
    out = np.full((wide, wide), -2, dtype=np.int16)
    for i in (-1, 0, 1):
        for j in (-1, 0, 1):
            path = _file(folder, "labels", (key[0] + i, key[1] + j), "npy")
            if not path.exists():
                continue
            found = np.load(path, mmap_mode="r")
            r0, r1 = max(beyond + i * n, 0), min(beyond + (i + 1) * n, wide)
            c0, c1 = max(beyond + j * n, 0), min(beyond + (j + 1) * n, wide)
            out[r0:r1, c0:c1] = found[
                r0 - beyond - i * n : r1 - beyond - i * n, c0 - beyond - j * n : c1 - beyond - j * n
            ]
    return out


def _labelled(folder: Path, key: Key, wide: int, indices: list[int], n: int) -> NDArray[np.int64]:
    """Labels (of the windows) that earlier rounds have given to nodes beyond the border, -1 where free."""
    early = (key[0] % 2) * 2 + key[1] % 2
    around = _around(folder, key, n, BEYOND)
    out = np.full((wide, wide), -1)
    for k, index in enumerate(indices):
        out[around == index] = k
    # a second run may find labels of later rounds, which the first one did not see
    for i in (-1, 0, 1):
        for j in (-1, 0, 1):
            if ((key[0] + i) % 2) * 2 + (key[1] + j) % 2 >= early:
                r = slice(max(BEYOND + i * n, 0), min(BEYOND + (i + 1) * n, wide))
                c = slice(max(BEYOND + j * n, 0), min(BEYOND + (j + 1) * n, wide))
                out[r, c] = -1
    return out


# -- cells ---------------------------------------------------------------------------------------------------------


def cells_job(folder: Path, key: Key, layers: dict[int, Layer], settings: MosaicSettings, nodata: float) -> None:
    """Cells of a tile, the layer that each is mostly of, their sigmas, and the seams in the tile.

    Parameters
    ----------
    nodata : of the mosaic; layers may have others
    """
    size, n, halo = settings.tile, settings.tile // NODE, settings.halo()
    row, column, wide = key[0] * size - halo, key[1] * size - halo, size + 2 * halo
    windows = _windows(layers, row, column, wide, wide)
    target = _file(folder, "tiles", key, "json")
    some = next(iter(layers.values()))
    bands, _ = read_balance(folder)
    around = _around(folder, key, n, halo // NODE)
    core = (slice(halo, halo + size), slice(halo, halo + size))
    told: dict[str, Any] = {"box": None, "cells": {}, "seams": []}
    known = np.stack([w.known for w in windows]) if windows else np.zeros((0, wide, wide), dtype=bool)
    if not windows or not known[:, core[0], core[1]].any():
        write_json(target, told)
        return
    values = _balanced(windows, bands)
    cells = np.repeat(np.repeat(around, NODE, axis=0), NODE, axis=1)
    labels = np.full(cells.shape, -1)
    for k, w in enumerate(windows):
        labels[cells == w.index] = k
    weights = feather_weights(labels, known, settings.feather)[:, core[0], core[1]]
    mine = [v[:, core[0], core[1]] for v in values]
    mixed = sum(w[None] * v for w, v in zip(weights, mine, strict=True))
    there = known[:, core[0], core[1]].any(axis=0)
    dtype = np.dtype(some.dtype)
    raster = replace(_raster(settings, key, some), nodata=nodata)
    write_tile(_file(folder, "tiles", key, "tif"), raster, _finished(mixed, there, dtype, nodata))
    source = np.where(there, np.array([w.index for w in windows])[np.argmax(weights, axis=0)] + 1, 0)
    raster = replace(raster, bands=1, dtype="uint16", nodata=0, descriptions=())
    write_tile(_file(folder, "tiles", key, "source.tif"), raster, source[None].astype(np.uint16))
    if settings.sigma:
        total = np.zeros((2, size, size), dtype=np.float32)
        for w, weight in zip(windows, weights, strict=True):
            found = sigma_of_layer(layers[w.index], row, column, wide, wide)[:, core[0], core[1]]
            total += np.where(weight > 0, weight * found**2, np.float32(0.0))
        raster = replace(raster, bands=2, dtype="float32", nodata=float("nan"), descriptions=SIGMA_BANDS)
        sigma = np.where(there, np.sqrt(total), np.float32(np.nan)).astype(np.float32)
        write_tile(_file(folder, "tiles", key, "sigma.tif"), raster, sigma)
    rows, columns = np.flatnonzero(np.any(there, axis=1)), np.flatnonzero(np.any(there, axis=0))
    top, left = key[0] * size, key[1] * size
    told["box"] = [int(top + rows[0]), int(top + rows[-1] + 1), int(left + columns[0]), int(left + columns[-1] + 1)]
    numbers, counts = np.unique(source[source > 0], return_counts=True)
    told["cells"] = {str(a - 1): b for a, b in zip(numbers.tolist(), counts.tolist(), strict=True)}
    told["seams"] = _seams_of_tile(windows, values, around, key, settings)
    write_json(target, told)


def _raster(settings: MosaicSettings, key: Key, layer: Layer) -> Raster:
    size, gsd = settings.tile, settings.gsd
    return Raster(
        settings.crs, key[1] * size * gsd, -key[0] * size * gsd, gsd, size, size, layer.bands, layer.dtype, layer.nodata
    )


def _finished(mixed: Any, there: Any, dtype: np.dtype, nodata: float) -> NDArray[Any]:
    """Values in the data type of the layers; none of a known cell is the one that says nothing is known."""
    if dtype.kind in "iu":
        info = np.iinfo(dtype)
        whole = np.clip(np.rint(mixed), info.min, info.max).astype(dtype)
        clash = whole == dtype.type(nodata)
        whole = np.where(clash, dtype.type(nodata + (1 if nodata < info.max else -1)), whole)
    else:
        whole = mixed.astype(dtype)
    return np.where(there[None], whole, dtype.type(nodata))


def _seams_of_tile(
    windows: list[Window], values: list[NDArray[np.float32]], around: NDArray[np.int16], key: Key,
    settings: MosaicSettings,
) -> list[dict[str, Any]]:  # fmt: skip
    """Seam lines of a tile with the steps across them, before and after the balance."""
    n, ring = settings.tile // NODE, settings.halo() // NODE
    # the tile and its first nodes to the right and below, so that a seam along a border belongs to one tile
    nodes = around[ring : ring + n + 1, ring : ring + n + 1].astype(int)
    at = {w.index: k for k, w in enumerate(windows)}
    wide = n + 2 * ring
    out = []
    for line in seam_lines(np.where(nodes < 0, -1, nodes), shared=True):
        a, b = line.labels
        told = {"layers": [a, b], "corners": [], "nodes": 0, "raw": [0.0, 0.0], "balanced": [0.0, 0.0]}
        corners = line.corners + np.array([key[0] * n, key[1] * n])
        told["corners"] = (corners * NODE).tolist()
        if a in at and b in at:
            one, other = windows[at[a]], windows[at[b]]
            both = one.known & other.known
            r, c = _nodes_along(line.corners)
            r, c = np.clip(r + ring, 0, wide - 1), np.clip(c + ring, 0, wide - 1)
            whole = _nodes(both, wide)[r, c].all(axis=(1, 2))
            r, c = r[whole], c[whole]
            for name, x, y in (
                ("raw", one.values, other.values), ("balanced", values[at[a]], values[at[b]])
            ):  # fmt: skip
                step = np.array([_nodes(p - q, wide)[r, c].mean(axis=(1, 2)) for p, q in zip(x, y, strict=True)])
                told[name] = [float((step**2).mean(axis=0).sum()), float(step.mean(axis=0).sum())]
            told["nodes"] = len(r)
        out.append(told)
    return out


def _nodes_along(corners: NDArray[np.integer]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Nodes beside the steps of a line of corners."""
    rows, columns = [], []
    for (r0, c0), (r1, c1) in zip(corners[:-1].tolist(), corners[1:].tolist(), strict=True):
        for k in range(max(abs(r1 - r0), abs(c1 - c0))):
            rows.append(min(r0, r1) + k if r0 != r1 else r0)
            columns.append(min(c0, c1) + k if c0 != c1 else c0)
    return np.array(rows, dtype=np.int64), np.array(columns, dtype=np.int64)


# -- the whole -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Outputs:
    """Files of a mosaic; each raster is a cloud-optimised GeoTIFF, or with the ending ``.vrt`` virtual, over the tiles.

    Attributes
    ----------
    mosaic : grey values
    source : which layer each cell is mostly of, 1 for the first
    seams : the seam lines, GeoJSON
    sigma : in the plane and of the height, m; None without
    """

    mosaic: Path
    source: Path
    seams: Path
    sigma: Path | None

    @property
    def need_tiles(self) -> bool:
        """Whether one of them shows the tiles, which then have to stay."""
        return any(path is not None and is_virtual(path) for path in (self.mosaic, self.source, self.sigma))


def put_together(
    folder: Path, layers: list[Layer], settings: MosaicSettings, outputs: Outputs, tags: dict[str, str],
    compress: str = "deflate",
) -> dict[str, Any]:  # fmt: skip
    """Write the files of a mosaic from its tiles; returns extent, cells of each layer, and steps across the seams.

    Raises
    ------
    UserError : a file cannot be written, nothing in the mosaic
    """
    from rasterio.enums import ColorInterp

    told = {key: read_json(_file(folder, "tiles", key, "json")) for key in tiles_of(layers)}
    boxes = np.array([t["box"] for t in told.values() if t["box"] is not None])
    if not len(boxes):
        raise UserError(f"{outputs.mosaic}: nothing in the mosaic")
    row, column = int(boxes[:, 0].min()), int(boxes[:, 2].min())
    rows, columns = int(boxes[:, 1].max()) - row, int(boxes[:, 3].max()) - column
    size, gsd, one = settings.tile, settings.gsd, layers[0]
    filled = [key for key, t in told.items() if t["box"] is not None]
    raster = Raster(
        settings.crs, column * gsd, -row * gsd, gsd, rows, columns, one.bands, one.dtype, one.nodata,
        {"TIFFTAG_SOFTWARE": "triline", **tags},
    )  # fmt: skip
    # what is meant by the values is said of them alone, not of numbers of layers and sigmas
    colors = next((layer.colors for layer in layers if layer.colors), ())
    values = replace(
        raster, descriptions=one.descriptions, scales=one.scales, offsets=one.offsets, units=one.units,
        colors=tuple(ColorInterp[name] for name in colors),
    )  # fmt: skip
    names = {"layers": ", ".join(f"{k + 1} {layer.name}" for k, layer in enumerate(layers))}
    source = replace(raster, bands=1, dtype="uint16", nodata=0, tags=names, descriptions=("layer of the cell",))
    kinds: list[tuple[str, Path, Raster, str]] = [
        ("tif", outputs.mosaic, values, "average"), ("source.tif", outputs.source, source, "nearest")
    ]  # fmt: skip
    if outputs.sigma is not None:
        sigma = replace(raster, bands=2, dtype="float32", nodata=float("nan"), descriptions=SIGMA_BANDS)
        kinds.append(("sigma.tif", outputs.sigma, sigma, "average"))
    for end, path, about, overview in kinds:
        tiles = [
            TilePlace(_file(folder, "tiles", k, end), k[0] * size - row, k[1] * size - column, size, size)
            for k in filled
        ]
        if is_virtual(path):
            tiles = [replace(tile, path=Path(os.path.abspath(tile.path))) for tile in tiles]
            write_virtual(Path(os.path.abspath(path)), about, tiles)
        else:
            virtual = folder / f"whole.{end.removesuffix('tif')}vrt"
            write_virtual(virtual, about, tiles)
            cloud_optimised(path, virtual, compress, overview)
    lines = _features(told, layers, settings)
    seams = write_line_features(outputs.seams, lines, geographic=settings.crs is not None)
    return {"rows": rows, "columns": columns, "row": row, "column": column, "seams": seams, **_summary(told, layers)}


def _features(
    told: dict[Key, Any], layers: list[Layer], settings: MosaicSettings
) -> Iterator[tuple[NDArray[np.float64], dict[str, Any]]]:
    to_map = None if settings.crs is None else transformer_to(settings.crs)
    for key, t in told.items():
        for seam in t["seams"]:
            corners = np.array(seam["corners"], dtype=float)
            x, y = corners[:, 1] * settings.gsd, -corners[:, 0] * settings.gsd
            if to_map is not None:
                x, y = to_map.transform(x, y, direction="INVERSE")
            places = np.column_stack([x, y]).astype(float)
            a, b = seam["layers"]
            n = max(seam["nodes"], 1)
            steps = {f"step_{name}": round(seam[name][1] / n, 4) for name in ("raw", "balanced")}
            yield places, {"layers": [layers[a].name, layers[b].name], "tile": list(key), **steps}


def _summary(told: dict[Key, Any], layers: list[Layer]) -> dict[str, Any]:
    cells = [0] * len(layers)
    total = np.zeros(5)
    for t in told.values():
        for k, n in t["cells"].items():
            cells[int(k)] += n
        for seam in t["seams"]:
            n = max(seam["nodes"], 1)
            tones = [seam[name][1] ** 2 / n for name in ("raw", "balanced")]  # of the seam as a whole
            total += [seam["nodes"], seam["raw"][0], seam["balanced"][0], *tones]
    n = max(total[0], 1.0)
    rms = np.sqrt(total[1:] / n).tolist()
    names = ("raw_rms", "balanced_rms", "raw_tone_rms", "balanced_tone_rms")
    return {
        "cells": cells,
        "step_across_seams": {"nodes": int(total[0]), **dict(zip(names, rms, strict=True))},
    }
