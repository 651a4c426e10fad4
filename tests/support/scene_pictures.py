"""Small pictures of a textured ground with relief, by parallel rays from high above, and RPC that are wrong."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import rasterio
from rasterio.errors import NotGeoreferencedWarning

from triline.nodes.formats.satellite.rpc_files import write_rpb
from triline.solver.location.rpc_fit import fit_to_model
from triline.solver.simulation.ground_texture import GroundTexture, ground_texture

#: The middle of all of it, rad, and metres a radian there.
LAT, LON = np.radians(47.0), np.radians(11.0)
METRES = np.array([6.37e6 * np.cos(LAT), 6.37e6])
#: Heights between which the RPC hold, m.
LOW_M, HIGH_M = 100.0, 400.0


def relief(east: np.ndarray, north: np.ndarray) -> np.ndarray:
    """Heights, m: 200 to 280."""
    return 240.0 + 25.0 * np.sin(east / 110.0) + 15.0 * np.cos(north / 90.0 + 1.0)


@dataclass(frozen=True)
class View:
    """An image of parallel rays.

    Attributes
    ----------
    azimuth_deg : of its lines
    tilt : metres east and north by which rays lie further for a metre of height
    gsd_m : size of a pixel
    at_m : its middle, east and north
    """

    azimuth_deg: float
    tilt: tuple[float, float]
    gsd_m: float = 1.0
    lines: int = 300
    samples: int = 300
    at_m: tuple[float, float] = (0.0, 0.0)
    middle: np.ndarray = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "middle", 0.5 * np.array([self.lines - 1, self.samples - 1]))

    @property
    def turn(self) -> np.ndarray:
        """(2, 2) from line and sample to east and north."""
        a = np.radians(self.azimuth_deg)
        return self.gsd_m * np.array([[np.sin(a), np.cos(a)], [-np.cos(a), np.sin(a)]])

    def direct(self, line, sample, height_m) -> np.ndarray:
        u, v, h = np.broadcast_arrays(*map(np.atleast_1d, (line, sample, height_m)))
        en = (np.stack([u, v], axis=1) - self.middle) @ self.turn.T + self.at_m + h[:, None] * self.tilt
        lonlat = en / METRES + [LON, LAT]
        return np.column_stack([lonlat[:, 1], lonlat[:, 0], h])

    def inverse(self, lat, lon, height_m, margin_px: float | None = None) -> np.ndarray:
        lat, lon, h = np.broadcast_arrays(*map(np.atleast_1d, (lat, lon, height_m)))
        en = (np.stack([lon, lat], axis=1) - [LON, LAT]) * METRES
        return (en - self.at_m - h[:, None] * self.tilt) @ np.linalg.inv(self.turn).T + self.middle

    def on_ground(self, pixel: np.ndarray) -> np.ndarray:
        """(k, 3) latitude, longitude, height where pixels (k, 2) see the relief."""
        h = np.full(len(pixel), 240.0)
        for _ in range(40):
            lat, lon, _ = self.direct(*pixel.T, h).T
            before, h = h, relief(*((np.stack([lon, lat]) - [[LON], [LAT]]) * METRES[:, None]))
            if np.abs(h - before).max() < 1e-9:
                break
        return self.direct(*pixel.T, h)

    def picture(self, texture: GroundTexture, rng: np.random.Generator, noise: float = 8.0) -> np.ndarray:
        """What it sees, 12 bit, with the point spread of its own pixels."""
        pixel = np.stack([a.ravel() for a in np.indices((self.lines, self.samples))], axis=1).astype(float)
        lat, lon, _ = self.on_ground(pixel).T
        x, y = (np.stack([lon, lat]) - [[LON], [LAT]]) * METRES[:, None]
        seen = texture.seen_by(self.gsd_m).reflectance(x, y).reshape(self.lines, self.samples)
        return np.clip(np.rint(100 + 2500 * seen + noise * rng.standard_normal(seen.shape)), 1, 4095).astype(np.uint16)


def textured(seed: int, detail_m: float = 1.0) -> GroundTexture:
    """A ground without what looks different from each direction."""
    texture = ground_texture(np.random.default_rng(seed), detail_m)
    return replace(texture, unsteady=np.zeros_like(texture.unsteady))


def write_block(folder: Path, views: dict[str, View], errors: dict[str, View], seed: int, noise: float = 8.0) -> None:
    """A block of pictures by true views, with RPC of views that are wrong, and an empty image_points.csv."""
    texture, rng = textured(seed), np.random.default_rng(seed + 1)
    folder.mkdir(parents=True, exist_ok=True)
    text = "[rpc]\nshift_sigma_px = 30\nslope_sigma_px = 3\n"
    for name, view in views.items():
        write_image(folder / f"{name}.tif", view.picture(texture, rng, noise))
        write_rpb(folder / f"{name}.RPB", fit_to_model(errors[name], LOW_M, HIGH_M).rpc)
        text += f'[scenes.{name}]\nmetadata = "{name}.RPB"\nimage = "{name}.tif"\n'
    (folder / "project.toml").write_text(text)


def write_image(path: Path, *bands: np.ndarray, **how) -> None:
    """Bands as a TIFF without coordinates."""
    profile = {"driver": "GTiff", "count": len(bands), "dtype": bands[0].dtype, **how}
    lines, samples = bands[0].shape
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        with rasterio.open(path, "w", height=lines, width=samples, **profile) as file:
            file.write(np.stack(bands))


def moved(view: View, east_m: float, north_m: float, turned_deg: float = 0.0) -> View:
    """A view that is wrong by so much."""
    at = view.at_m[0] + east_m, view.at_m[1] + north_m
    return replace(view, at_m=at, azimuth_deg=view.azimuth_deg + turned_deg)


class ArrayPixels:
    """An image as `solver.matching.scene_patches.Pixels`."""

    saturated = np.inf

    def __init__(self, image: np.ndarray):
        self.image, self.first, self.end = image, (0, 0), image.shape

    def window(self, line: int, sample: int, lines: int, samples: int) -> np.ndarray:
        out = np.zeros((lines, samples), dtype=np.float32)
        a, b = max(line, 0), max(sample, 0)
        piece = self.image[a : max(line + lines, 0), b : max(sample + samples, 0)]
        out[a - line : a - line + len(piece), b - sample : b - sample + piece.shape[1]] = piece
        return out


def errors_of(views: list[View], points) -> tuple[np.ndarray, np.ndarray, list[tuple[int, int]]]:
    """What looks (k, 2) of tie points are off by the true views, px, their NEES (k,), and master and other view.

    The look of the master is the one in the middle of a pixel.
    """
    off, nees, pairs = [], [], []
    for point in points:
        master = next(k for k, ray in point.rays.items() if ray[0] == round(ray[0]) and ray[1] == round(ray[1]))
        ground = views[master].on_ground(np.array([point.rays[master][:2]]))
        for k in point.rays.keys() - {master}:
            e = np.array(point.rays[k][:2]) - views[k].inverse(*ground.T)[0]
            own = point.rays[master][2] * views[master].gsd_m / views[k].gsd_m
            off.append(e)
            nees.append(e @ e / (2 * (point.rays[k][2] ** 2 + own**2)))
            pairs.append((master, k))
    return np.array(off), np.array(nees), pairs
