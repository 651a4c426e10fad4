"""Relief with known heights, as a terrain for the solver and as a raster."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np


@dataclass
class Waves:
    """Waves of 1 000 m from top to bottom in a raster of latitude and longitude, bilinear between its values.

    Attributes
    ----------
    lat_deg, lon_deg : of the upper left value
    step_deg : from value to value
    rows, columns : how many
    low_m, high_m : lowest and highest height above the ellipsoid
    waves : over the raster, each way
    """

    lat_deg: float
    lon_deg: float
    step_deg: float
    rows: int
    columns: int
    low_m: float = 0.0
    high_m: float = 1000.0
    waves: float = 3.0

    def __post_init__(self) -> None:
        i, j = np.mgrid[0 : self.rows, 0 : self.columns]
        wave = np.sin(2 * np.pi * self.waves * i / self.rows) * np.cos(2 * np.pi * self.waves * j / self.columns)
        self.z = (0.5 * (self.low_m + self.high_m) + 0.5 * (self.high_m - self.low_m) * wave).astype(np.float32)
        self.cell_m = np.radians(self.step_deg) * 6.37e6 * np.cos(np.radians(self.lat_deg))

    @classmethod
    def under(cls, model, cells: int = 200, **kwargs) -> Waves:
        """Relief under the whole image of a model, at all its heights."""
        u, v = (a.ravel() for a in np.meshgrid([0.0, model.lines - 1.0], [0.0, model.samples - 1.0]))
        ground = np.concatenate([model.direct(u, v, np.full(4, h)) for h in (-200.0, 1200.0)])
        lat, lon = np.degrees(ground[:, 0]), np.degrees(ground[:, 1])
        step = max(np.ptp(lat), np.ptp(lon)) / (cells - 40)
        return cls(lat.max() + 10 * step, lon.min() - 10 * step, step, cells, cells, **kwargs)

    def place(self, lat, lon):
        return (self.lat_deg - np.degrees(lat)) / self.step_deg, (np.degrees(lon) - self.lon_deg) / self.step_deg

    def undulation(self, lat, lon):
        return np.zeros(np.shape(lat))

    def heights(self, row: int, column: int, rows: int, columns: int) -> np.ndarray:
        i, j = np.arange(row, row + rows), np.arange(column, column + columns)
        out = np.full((rows, columns), np.nan, dtype=np.float32)
        good_i, good_j = (i >= 0) & (i < self.rows), (j >= 0) & (j < self.columns)
        out[np.ix_(good_i, good_j)] = self.z[np.ix_(i[good_i], j[good_j])]
        return out

    def at(self, lat, lon):
        """Heights at places, written down a second time."""
        row, column = self.place(np.asarray(lat), np.asarray(lon))
        i = np.clip(np.floor(row).astype(int), 0, self.rows - 2)
        j = np.clip(np.floor(column).astype(int), 0, self.columns - 2)
        a, b, z = row - i, column - j, self.z.astype(float)
        upper, lower = z[i, j] * (1 - b) + z[i, j + 1] * b, z[i + 1, j] * (1 - b) + z[i + 1, j + 1] * b
        return upper * (1 - a) + lower * a

    def write(self, path: Path, crs: str = "EPSG:4326") -> Path:
        import rasterio

        s = self.step_deg
        transform = rasterio.Affine(s, 0.0, self.lon_deg - 0.5 * s, 0.0, -s, self.lat_deg + 0.5 * s)
        with rasterio.open(
            path, "w", driver="GTiff", width=self.columns, height=self.rows, count=1, dtype="float32", crs=crs,
            transform=transform,
        ) as target:  # fmt: skip
            target.write(self.z, 1)
        return path
