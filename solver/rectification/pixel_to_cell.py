"""From the pixels of an image to the cells of a map (direct rectification, as the source does it [D 4]).

Every pixel's ray is led to the terrain: its place at three heights gives the place at any height between them, and the
relief is met by iteration (heights taken anew where the ray is, secant steps), or by a search along the ray from above
where the relief is as steep as the ray. The ground points of neighbouring pixels form a mesh of triangles; cells inside
a triangle take line and sample from its corners. What the sensor does not see gets no triangle, but for those that
bridge hidden ground; these are much longer than their neighbours and are left out.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .grid import MapGrid
from .terrain import Terrain, bilinear, squares

Array = NDArray[np.floating]
Mask = NDArray[np.bool_]

#: Heights on the terrain are found to this, metres.
TOLERANCE_M = 1e-3
#: Rounds of the secant; rays it does not bring to rest are searched.
ROUNDS = 12
#: Rounds in which the geoid is taken where the ray before met the terrain. Derived: it slopes by less than a metre in a
#: kilometre, so that a round leaves a thousandth of the one before.
GEOID_ROUNDS = 3
#: Steps of the search, in cells of the raster, and at most.
STEPS_A_CELL, MOST_STEPS = 3.0, 2000
#: Triangles with a side this much longer than the median bridge hidden ground. Tuned.
LONGEST = 4.0


class Direct(Protocol):
    """Any model with direct location."""

    @property
    def lines(self) -> int:
        """Lines of the image."""
        ...

    @property
    def samples(self) -> int:
        """Samples of a line."""
        ...

    def direct(self, line: ArrayLike, sample: ArrayLike, height_m: ArrayLike) -> Array:
        """Latitude, longitude (radians) and height, (n, 3)."""
        ...


@dataclass(frozen=True)
class GroundPoints:
    """Where rays of n pixels meet the terrain.

    Attributes
    ----------
    lat, lon : (n,) radians; NaN where they do not
    height_m : (n,) above the ellipsoid
    """

    lat: Array
    lon: Array
    height_m: Array


def meet_terrain(
    model: Direct, line: Array, sample: Array, terrain: Terrain | float, low_m: float = 0.0, high_m: float = 0.0
) -> GroundPoints:
    """Ground points of pixels.

    Parameters
    ----------
    line, sample : (n,)
    terrain : raster of heights, or one height above the ellipsoid
    low_m, high_m : between which heights above the ellipsoid the raster lies

    Returns
    -------
    points ; NaN where a ray misses the planet, or passes where no height is known
    """
    if isinstance(terrain, float | int):
        located = model.direct(line, sample, np.full(len(line), float(terrain)))
        return GroundPoints(located[:, 0], located[:, 1], np.full(len(line), float(terrain)))
    middle, half = 0.5 * (low_m + high_m), max(0.5 * (high_m - low_m), 0.5) + 1.0
    n = len(line)
    levels = middle + half * np.array([-1.0, 0.0, 1.0])
    located = model.direct(np.tile(line, 3), np.tile(sample, 3), np.repeat(levels, n)).reshape(3, n, 3)
    lat, lon = located[..., 0], located[..., 1]
    lon = lon[1] + (lon - lon[1] + np.pi) % (2 * np.pi) - np.pi
    row, column = (a.reshape(3, n) for a in terrain.place(lat.ravel(), lon.ravel()))
    seen = np.flatnonzero(np.isfinite(row).all(axis=0) & np.isfinite(column).all(axis=0))
    t = np.full(n, np.nan)
    if len(seen):
        N = _known_or_near(terrain.undulation(lat[1, seen], lon[1, seen]))
        for part in squares(row[1, seen], column[1, seen]):
            some = seen[part]
            places = lat[:, some], lon[:, some], row[:, some], column[:, some]
            t[some] = _share(*places, N[part], middle, half, terrain)
    return GroundPoints(_at(lat, t), _at(lon, t), middle + half * t)


def _share(
    lat: Array, lon: Array, row: Array, column: Array, N: Array, middle: float, half: float, terrain: Terrain
) -> Array:
    """Share of the height range (n,) at which rays meet the raster above its geoid, NaN where they do not.

    ``N`` : (n,) of the geoid, where rays pass the middle of the range
    """
    N, t = N.copy(), np.full(len(N), np.nan)
    for _ in range(GEOID_ROUNDS):
        t = _meet(row, column, N, middle, half, terrain)
        met = np.flatnonzero(np.isfinite(t))
        if not len(met):
            break
        there = terrain.undulation(_at(lat[:, met], t[met]), _at(lon[:, met], t[met]))
        there = np.where(np.isfinite(there), there, N[met])
        if not (np.abs(there - N[met]) > TOLERANCE_M).any():
            break
        N[met] = there
    return t


def _known_or_near(N: Array) -> Array:
    """Heights of the geoid (n,); the mean one where it is not known, as beyond its raster, to begin with."""
    known = np.isfinite(N)
    return np.where(known, N, N[known].mean()) if known.any() else N


def _at(values: Array, t: Array) -> Array:
    """Values (n,) of a quadratic through values (3, n) at -1, 0, 1."""
    return values[1] + t * (0.5 * (values[2] - values[0]) + t * (0.5 * (values[2] + values[0]) - values[1]))


def _meet(row: Array, column: Array, N: Array, middle: float, half: float, terrain: Terrain) -> Array:
    """Share of the height range (n,) at which rays meet the raster, NaN where they do not."""
    top, left = int(np.floor(row.min())) - 1, int(np.floor(column.min())) - 1
    height, width = int(np.ceil(row.max())) + 2 - top, int(np.ceil(column.max())) + 2 - left
    z = terrain.heights(top, left, height, width)
    row, column = row - top, column - left

    def above(t: Array, which: Any = slice(None)) -> Array:
        """How far the ground lies above the rays, metres."""
        ground = bilinear(z, _at(row[:, which], t), _at(column[:, which], t)) + N[which]
        return ground - (middle + half * t)

    n = row.shape[1]
    t0 = np.zeros(n)
    f0 = above(t0)
    t1 = t0 + f0 / half
    for _ in range(ROUNDS):
        f1 = above(t1)
        if not (np.abs(f1) > TOLERANCE_M).any():
            break
        step, fall = (t1 - t0) * half, f1 - f0
        guide = np.abs(fall + step) < 0.9 * np.abs(step)
        change = np.where(guide, -f1 * step / np.where(guide, fall, 1.0), f1)
        t0, f0, t1 = t1, f1, np.clip(t1 + change / half, -1.5, 1.5)
    good = np.abs(above(t1)) <= TOLERANCE_M
    # several crossings are possible where the relief is steeper than the ray: the first from above counts
    way = np.hypot(row[2] - row[0], column[2] - column[0]) / (2.0 * half)  # cells a metre of height
    steep = np.nanmax(np.hypot(*_steepest(z)), initial=0.0) * np.max(way, initial=0.0) >= 1.0
    search = np.ones(n, dtype=bool) if steep else ~good
    t = np.where(good, t1, np.nan)
    if search.any():
        t[search] = _search(above, np.flatnonzero(search), float(np.max(way[search], initial=0.0)) * 2.0 * half)
    return t


def _steepest(z: NDArray[np.float32]) -> tuple[Array, Array]:
    with np.errstate(invalid="ignore"):
        rows, columns = np.abs(np.diff(z, axis=0)), np.abs(np.diff(z, axis=1))
    return (
        np.array(np.nanmax(rows) if np.isfinite(rows).any() else 0.0),
        np.array(np.nanmax(columns) if np.isfinite(columns).any() else 0.0),
    )


def _search(above: Any, which: NDArray[np.intp], way_cells: float) -> Array:
    """Share (n,) of the first crossing of rays from above, NaN where there is none."""
    steps = int(np.clip(np.ceil(STEPS_A_CELL * way_cells), 8, MOST_STEPS))
    n = len(which)
    high, low, before = np.full(n, np.nan), np.full(n, np.nan), np.full(n, 1.0)
    open_ = np.arange(n)
    for t in np.linspace(1.0, -1.0, steps + 1):
        crossed = above(np.full(len(open_), t), which[open_]) >= 0
        hit = open_[crossed]
        low[hit], high[hit] = t, before[hit]
        open_ = open_[~crossed]
        before[open_] = t
        if not len(open_):
            break
    for _ in range(30):
        middle = 0.5 * (low + high)
        under = above(middle, which) >= 0
        low, high = np.where(under, middle, low), np.where(under, high, middle)
    t = 0.5 * (low + high)
    return np.where(np.abs(above(t, which)) < 10 * TOLERANCE_M, t, np.nan)


@dataclass(frozen=True)
class MeshCells:
    """Cells under a block of pixels.

    Attributes
    ----------
    row, column : of the first cell
    line, sample : (rows, columns) of the cells, NaN where no triangle covers one
    height_m : (rows, columns)
    """

    row: int
    column: int
    line: Array
    sample: Array
    height_m: Array


def mesh_cells(
    model: Direct, grid: MapGrid, line: Array, sample: Array, terrain: Terrain | float, low_m: float, high_m: float
) -> MeshCells | None:
    """Cells of a grid under a block of pixels.

    Parameters
    ----------
    line, sample : (n,), (m,) of the nodes of the mesh, ascending
    terrain, low_m, high_m : see `meet_terrain`

    Returns
    -------
    cells ; None where no ray meets the ground inside the grid
    """
    u, v = np.meshgrid(line, sample, indexing="ij")
    ground = meet_terrain(model, u.ravel(), v.ravel(), terrain, low_m, high_m)
    x, y = (a.reshape(u.shape) for a in grid.cells(ground.lat, ground.lon))
    h = ground.height_m.reshape(u.shape)
    with np.errstate(invalid="ignore"):
        near = (x >= -1) & (x <= grid.columns) & (y >= -1) & (y <= grid.rows)
    if not near.any():
        return None
    # half a triangle reaches beyond the pixels at the edge of the block: neighbours share their nodes
    left, right = max(int(np.ceil(np.nanmin(x))), 0), min(int(np.floor(np.nanmax(x))), grid.columns - 1)
    top, bottom = max(int(np.ceil(np.nanmin(y))), 0), min(int(np.floor(np.nanmax(y))), grid.rows - 1)
    if right < left or bottom < top:
        return None
    shape = bottom - top + 1, right - left + 1
    out = np.full((3, *shape), np.nan)
    corners = np.stack([x - left, y - top], axis=-1)
    values = np.stack([u, v, h], axis=-1)
    p00, p01, p10, p11 = corners[:-1, :-1], corners[:-1, 1:], corners[1:, :-1], corners[1:, 1:]
    v00, v01, v10, v11 = values[:-1, :-1], values[:-1, 1:], values[1:, :-1], values[1:, 1:]
    for p, q in (((p00, p01, p11), (v00, v01, v11)), ((p00, p11, p10), (v00, v11, v10))):
        _fill(out, tuple(a.reshape(-1, 2) for a in p), tuple(a.reshape(-1, 3) for a in q))
    return MeshCells(top, left, out[0], out[1], out[2])


def _fill(out: Array, p: tuple[Array, ...], q: tuple[Array, ...]) -> None:
    """Write values inside triangles with corners ``p`` and values ``q`` (n, .) into the cells they cover."""
    low, high = np.minimum(np.minimum(p[0], p[1]), p[2]), np.maximum(np.maximum(p[0], p[1]), p[2])
    size = (high - low).max(axis=1)
    known = np.isfinite(size)
    if not known.any():
        return
    known &= size <= LONGEST * np.median(size[known])
    a, b = p[1] - p[0], p[2] - p[0]
    with np.errstate(invalid="ignore"):
        area = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
        known &= np.abs(area) > 1e-12
    k = np.flatnonzero(known)
    if not len(k):
        return
    first = np.ceil(low[k] - 1e-9).astype(int)
    count = np.floor(high[k] + 1e-9).astype(int) - first + 1
    rows, columns = out.shape[1:]
    for dy in range(int(count[:, 1].max(initial=0))):
        for dx in range(int(count[:, 0].max(initial=0))):
            some = np.flatnonzero((dx < count[:, 0]) & (dy < count[:, 1]))
            if not len(some):
                continue
            i = k[some]
            cx, cy = first[some, 0] + dx, first[some, 1] + dy
            d = np.stack([cx, cy], axis=1) - p[0][i]
            s = (d[:, 0] * b[i, 1] - d[:, 1] * b[i, 0]) / area[i]
            t = (a[i, 0] * d[:, 1] - a[i, 1] * d[:, 0]) / area[i]
            inside = (s >= -1e-9) & (t >= -1e-9) & (s + t <= 1 + 1e-9)
            inside &= (cx >= 0) & (cx < columns) & (cy >= 0) & (cy < rows)
            i, s, t, cx, cy = i[inside], s[inside, None], t[inside, None], cx[inside], cy[inside]
            value = q[0][i] + s * (q[1][i] - q[0][i]) + t * (q[2][i] - q[0][i])
            # of two surfaces over one cell the higher one is seen
            old = out[2, cy, cx]
            take = ~(value[:, 2] < old)
            out[:, cy[take], cx[take]] = value[take].T
