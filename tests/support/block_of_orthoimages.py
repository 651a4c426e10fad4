"""Orthoimages of overlapping strips over one known ground, with gains and offsets that are known."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import rasterio
from scipy.ndimage import gaussian_filter

GSD, LEFT, TOP = 2.0, 500_000.0, 5_400_000.0


@dataclass(frozen=True)
class Block:
    """Files, the ground (rows, columns) and what each file has as gain and offset."""

    files: list[Path]
    sigmas: list[Path]
    ground: np.ndarray
    gain: np.ndarray
    offset: np.ndarray
    sigma_m: np.ndarray


def ground_of(rows: int, columns: int, seed: int) -> np.ndarray:
    """Fields of different brightness, with texture."""
    rng = np.random.default_rng(seed)
    fields = np.kron(rng.uniform(500, 2500, (rows // 40 + 1, columns // 40 + 1)), np.ones((40, 40)))[:rows, :columns]
    return fields + 60 * gaussian_filter(rng.normal(size=(rows, columns)), 1.5)


def make_block(
    folder: Path, strips: int = 3, columns: int = 700, width: int = 240, apart: int = 160, seed: int = 1,
    moved: bool = True, noise: float = 8.0,
) -> Block:  # fmt: skip
    """Strips that run east, each ``width`` cells across and ``apart`` from the next."""
    rng = np.random.default_rng([seed, strips])
    rows = width + (strips - 1) * apart
    ground = ground_of(rows, columns, seed)
    gain = 1.0 + 0.1 * rng.normal(size=strips)
    gain /= gain.mean()
    offset = 40.0 * rng.normal(size=strips)
    offset -= offset.mean()
    sigma_m = np.linspace(0.3, 0.6, strips)
    files, sigmas = [], []
    for k in range(strips):
        part = slice(k * apart, k * apart + width)
        seen = ground[part].copy()
        if moved:  # a truck that stands elsewhere when the next strip is flown
            at = rng.integers(50, columns - 80)
            seen[width - 60 : width - 40, at : at + 30] = 3500.0
        grey = gain[k] * seen + offset[k] + noise * rng.normal(size=seen.shape)
        values = np.clip(np.rint(grey), 1, 65535).astype(np.uint16)
        values[:2, : columns // 2] = 0  # an edge that is not straight
        top = TOP - k * apart * GSD
        profile = {
            "driver": "GTiff", "height": width, "width": columns, "crs": "EPSG:32632", "tiled": True, "blockxsize": 256,
            "blockysize": 256, "transform": rasterio.Affine(GSD, 0, LEFT, 0, -GSD, top),
        }  # fmt: skip
        files.append(folder / f"strip{k}.tif")
        with rasterio.open(files[-1], "w", count=1, dtype="uint16", nodata=0, **profile) as target:
            target.write(values, 1)
        sigmas.append(folder / f"strip{k}.sigma.tif")
        with rasterio.open(sigmas[-1], "w", count=2, dtype="float32", nodata=np.nan, **profile) as target:
            target.write(np.full((2, width, columns), sigma_m[k], dtype=np.float32))
    return Block(files, sigmas, ground, gain, offset, sigma_m)
