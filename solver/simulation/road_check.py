"""How straight the simulated roads are in an orthoimage, measured in the image and held against where they are."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import erf

from ..orthoimage.ground_grid import GroundGrid
from ..orthoimage.mosaic import Mosaic
from ..orthoimage.resampling import resample
from .ground_texture import PSF_SIGMA_PX, GroundTexture
from .terrain import Terrain

Array = NDArray[np.floating]

#: Step across a road, cells, and how far beyond the road its surroundings are looked at.
STEP, SURROUNDINGS = 0.25, 4.0
#: Rows along the road that are put together to one profile, and from one profile to the next, cells.
TOGETHER, APART = 5, 10.0
#: A place counts if it is this near, cells, to the median of so many neighbours each way: tracks along parcels look
#: much like roads, but here and there only. Nearer to another road than this many widths no road is looked for.
AGREES, NEIGHBOURS, CROSSING = 1.5, 4, 4.0
#: A road stands out by this share of its brightness against both sides, and the model explains so much of a profile.
CONTRAST, EXPLAINED = 0.12, 0.9


@dataclass(frozen=True)
class RoadPlaces:
    """Where roads were found; n places.

    Attributes
    ----------
    road : (n,) number of the road
    along_m : (n,) along it
    offset : (n,) from its true centre line, cells, to the right of the way along it
    """

    road: NDArray[np.int64]
    along_m: Array
    offset: Array

    def rms(self) -> float:
        """Root mean square of the offsets from the truth, cells."""
        return float(np.sqrt(np.mean(self.offset**2)))

    def wiggle(self) -> float:
        """Root mean square of what is left when each road has been given its own straight line, cells."""
        left = []
        for road in np.unique(self.road):
            mine = self.road == road
            if mine.sum() > 3:
                left.append(
                    self.offset[mine]
                    - np.polyval(np.polyfit(self.along_m[mine], self.offset[mine], 1), self.along_m[mine])
                )
        return float(np.sqrt(np.mean(np.concatenate(left) ** 2))) if left else float("nan")


def find_roads(mosaic: Mosaic, grid: GroundGrid, texture: GroundTexture, terrain: Terrain, reach: float) -> RoadPlaces:
    """The centre lines of the roads of a texture in an orthoimage.

    A profile across a road is explained by three grey values (left, road, right) with blurred edges between; the place
    that explains it best is searched within ``reach`` cells of the true one, and refined by a parabola.

    Raises
    ------
    ValueError : an empty orthoimage
    """
    row0, row1, column0, column1 = mosaic.extent()
    image = mosaic.read(row0, row1, column0, column1)
    corners = [grid.centre(np.array(c), np.array(r)) for r in (row0, row1) for c in (column0, column1)]
    x, y = (np.array(v, dtype=float) for v in zip(*corners, strict=True))
    middle_h = grid.frame.height_m + terrain.height_m
    local = grid.frame.from_crs(np.column_stack([x, y, np.full(4, middle_h)]))
    parts: list[tuple[NDArray[np.int64], Array, Array]] = []
    name = 0
    for roads in texture.roads:
        c, s = np.cos(roads.azimuth_rad), np.sin(roads.azimuth_rad)
        across, along = local[:, 0] * c + local[:, 1] * s, c * local[:, 1] - s * local[:, 0]
        t = np.arange(along.min(), along.max(), grid.gsd * APART)
        for number in range(int(across.min() // roads.spacing_m), int(across.max() // roads.spacing_m) + 1):
            place = (number + 0.5 + roads.shift[number % len(roads.shift)]) * roads.spacing_m
            xy = np.stack([c * place - s * t, s * place + c * t], axis=1)
            cells = grid.cells(np.column_stack([xy, terrain.height(xy[:, 0], xy[:, 1])])) - [column0, row0]
            offset, good = _offsets(image, cells, roads.width_m / grid.gsd, texture.detail_m / grid.gsd, reach)
            for other in texture.roads:
                if other is not roads:
                    slant = abs(np.sin(other.azimuth_rad - roads.azimuth_rad))
                    good &= (
                        np.abs(other.place(xy[:, 0], xy[:, 1])[0]) > slant * reach * grid.gsd + CROSSING * roads.width_m
                    )
            found = np.flatnonzero(good)
            good[found] = _agreeing(offset[found], t[found], grid.gsd)
            parts.append((np.full(int(good.sum()), name), t[good], offset[good]))
            name += 1
    road, along_m, offset = (np.concatenate(p) for p in zip(*parts, strict=True))
    return RoadPlaces(road, along_m, offset)


def _agreeing(offset: Array, along_m: Array, gsd: float) -> NDArray[np.bool_]:
    """Which places (n,) lie where their neighbours on the same road do."""
    good = np.zeros(len(offset), dtype=bool)
    for i in range(len(offset)):
        near = np.flatnonzero(np.abs(along_m - along_m[i]) < (NEIGHBOURS + 0.5) * APART * gsd)
        near = near[near != i]
        good[i] = len(near) >= NEIGHBOURS and abs(offset[i] - np.median(offset[near])) < AGREES
    return good


def _offsets(
    image: NDArray[np.unsignedinteger], cells: Array, width: float, pixel: float, reach: float
) -> tuple[Array, NDArray[np.bool_]]:
    """Offset (n,) of a road from its true places (n, 2: column, row), and where it was found."""
    way = np.gradient(cells, axis=0)
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    right = np.stack([-way[:, 1], way[:, 0]], axis=1)  # rows go down
    half = 0.5 * width + SURROUNDINGS
    d = np.arange(-reach - half, reach + half + STEP / 2, STEP)
    total, known = np.zeros((len(cells), len(d))), np.ones((len(cells), len(d)), dtype=bool)
    for k in np.arange(TOGETHER) - TOGETHER // 2:
        at = cells[:, None] + k * way[:, None] + d[None, :, None] * right[:, None]
        line, sample = at[..., 1].astype(np.float32).ravel(), at[..., 0].astype(np.float32).ravel()
        value, inside = resample(image, None, line, sample, "bilinear")
        total += value.reshape(total.shape)
        known &= (inside & (value > 0.5)).reshape(known.shape)
    profile = total / TOGETHER
    n_window = round(2 * half / STEP) + 1
    window = STEP * (np.arange(n_window) - (n_window - 1) / 2)
    sigma = np.hypot(PSF_SIGMA_PX * pixel, 0.6)  # of the sensor, and of two resamplings
    edge = [0.5 * (1 + erf((window + sign * 0.5 * width) / (np.sqrt(2) * sigma))) for sign in (1, -1)]
    design = np.stack([1 - edge[0], edge[0] - edge[1], edge[1]], axis=1)
    Q, R = np.linalg.qr(design)
    shifts = len(d) - n_window + 1
    views = np.lib.stride_tricks.sliding_window_view(profile, n_window, axis=1)  # (n, shifts, window)
    c = views @ Q
    power = np.einsum("nsw,nsw->ns", views, views)
    left = power - np.einsum("nsk,nsk->ns", c, c)
    grey = c @ np.linalg.inv(R).T
    stands_out = np.minimum(grey[..., 1] - grey[..., 0], grey[..., 1] - grey[..., 2]) > CONTRAST * grey[..., 1]
    spread = power - views.sum(axis=2) ** 2 / n_window
    fits = stands_out & (left < (1 - EXPLAINED) * spread)
    left = np.where(fits, left, np.inf)
    best = np.argmin(left, axis=1)
    rows = np.arange(len(cells))
    inner = np.clip(best, 1, shifts - 2)
    a, b, e = (left[rows, inner + k] for k in (-1, 0, 1))
    good = known.all(axis=1) & (best == inner) & np.isfinite(a) & np.isfinite(b) & np.isfinite(e)
    with np.errstate(invalid="ignore", divide="ignore"):
        finer = 0.5 * (a - e) / (a - 2 * b + e)
    offset = STEP * (inner - (shifts - 1) / 2 + np.where(good, finer, 0.0))
    return offset, good
