"""The matcher on real pixels: two Pleiades looks at Mont Ventoux, matched as image lines are.

    python bench/real_pixels.py [--apart 10] [--largest-sigma 0.1] [--json]

Places are chosen in the left look as the matcher chooses them (the best one of each cell of ``--apart`` px, half a
window apart at least), and found in the right look by its search: correlation on grids on the ground, least squares,
back again, the same verdict. The grids lie at the heights of SRTM and reach the pixels through the RPC of each look.
A search covers 20 px: the heights are off by some metres, the RPC by some pixels.

Nobody knows true places. But the height of the ground moves a match along one line, the epipolar one. What is left
*across* it once an affine bias of each image is taken out is the error of matching, and whatever the looks saw
differently. The figures:

- places that both crops show (a third of the left one), how many were matched, why others were not; matches whose
  stated sigma is larger than ``--largest-sigma`` are left out, as the matcher does: half of them in this thin texture;
- *wrong*: of the matches, those further across than 0.5 px, and those whose height is 15 m off the median of their ten
  neighbours (a wrong place along the line); neither counts in what follows;
- *across*: standard deviation, px of the left look, and the same from the median of the absolute values;
- *stated*: root mean square of what least squares states, without and with the floor of simulated pixels;
- *NEES*: mean square of across over its stated variance, by the floor, with the 95 % band of a bootstrap over tiles of
  80 px, whose matches share errors. 1 is right;
- *floor*: what has to be added (in squares) for a NEES of 1, with its band; and the same in the three thirds of the
  matches by stated sigma: a true floor would be the same in all of them;
- *trend*: the smooth part of across (40 px), which attitude and relief leave behind an affine bias: it is in the floor
  and is no error of matching; and the floor without it.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import frame
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from triline.nodes.formats.height_raster import HeightRaster
from triline.nodes.formats.satellite.read import read_scene
from triline.solver.geometry.frames import LocalFrame
from triline.solver.location.rpc import Rpc
from triline.solver.matching.interest_points import interest_point
from triline.solver.matching.line_store import LineRing
from triline.solver.matching.looks import verdict
from triline.solver.matching.options import REAL_FLOOR_PX, MatchingOptions
from triline.solver.matching.patches import Windows
from triline.solver.matching.search import LEAST_SQUARES_HALF, Found, Ground, Patches, find

Array = NDArray[np.floating]

VENTOUX = Path(__file__).parents[1].parent / "shared" / "data" / "satellites" / "phr_ventoux"
#: Mean height of the ground, and of the geoid, above the ellipsoid, m; reach of the search, px; largest grey value.
HEIGHT_M, GEOID_M, REACH_PX, FULL_SCALE = 510.0, "50.5", 20.0, 4095
#: Further across than this, px, or so far off the heights of its neighbours, m, a match is wrong.
WRONG_PX, WRONG_M, NEIGHBOURS = 0.5, 15.0, 10
#: Side of the tiles of the bootstrap, and the length over which the trend is smooth, px.
TILE_PX, SMOOTH_PX = 80.0, 40.0
#: What a search needs about a place: half a template at its coarsest level, and its reach, px.
AROUND_PX = 40


@dataclass(frozen=True)
class Look:
    """One image, as `search.find` wants it: patches on grids on the ground, through its RPC."""

    rpc: Rpc
    first: Array
    pixels: NDArray[np.uint16]
    ring: LineRing
    local: LocalFrame
    line_m: float

    def select(self, chosen: NDArray[np.bool_]) -> Look:
        """An image is the same for all places."""
        return self

    def place(self, point_l: Array) -> Array:
        """Lines and samples (..., 2) in the crop of points (..., 3)."""
        g = self.local.to_geodetic(point_l.reshape(-1, 3))
        seen = self.rpc.inverse(np.radians(g[:, 0]), np.radians(g[:, 1]), g[:, 2]) - self.first
        return seen.reshape((*point_l.shape[:-1], 2))

    def ground(self, pixel: Array, height_m: Array) -> Array:
        """Local points (n, 3) of pixels (n, 2) at ellipsoidal heights (n,)."""
        line, sample = (pixel + self.first).T
        g = self.rpc.direct(line, sample, height_m)
        return self.local.from_geodetic(np.degrees(g[:, 0]), np.degrees(g[:, 1]), height_m)

    def patches(self, ground: Ground, line: Array, half: int, factor: int) -> Patches:
        """See `Imagery`."""
        grid = factor * np.arange(-half, half + 1.0)
        u, v = np.moveaxis(self.place(ground.points(grid, grid)), -1, 0)
        pad = factor + 2
        row, column = (np.floor(a.min(axis=(1, 2))).astype(np.int64) - pad for a in (u, v))
        size = [int(np.ceil(np.ptp(a, axis=(1, 2)).max())) + 2 * pad + 6 for a in (u, v)]
        n, m = (x // factor * factor + factor for x in size)
        windows, holes = Windows(row, column, *self.ring.windows(row, column, n, m)).mended(0.98 * FULL_SCALE)
        values, known = windows.reduced(factor).sample(u, v, cubic=factor == 1)
        known &= (u >= 0) & (v >= 0) & (u <= self.pixels.shape[0] - 1) & (v <= self.pixels.shape[1] - 1)
        share = known.reshape(len(line), -1).mean(axis=1)
        mean = np.sum(values, axis=(1, 2), where=known) / np.maximum(known.sum(axis=(1, 2)), 1)
        gaps = None if holes is None or factor > 1 else windows.touched(holes, u, v)
        return Patches(
            np.where(known, values, mean[:, None, None].astype(np.float32)), share, np.zeros(len(line)), gaps
        )


def looks() -> tuple[Look, Look]:
    """The two images."""
    import rasterio

    out = []
    local = None
    for side in ("left", "right"):
        with rasterio.open(VENTOUX / f"{side}_image.tif") as file:
            pixels, first = file.read(1), np.array([file.transform.f, file.transform.c])
        rpc = read_scene(VENTOUX / f"{side}_image.geom").rpc
        assert rpc is not None
        line, sample = first + np.array(pixels.shape) / 2
        middle = np.degrees(rpc.direct(line, sample, HEIGHT_M)).ravel()
        local = local or LocalFrame(float(middle[0]), float(middle[1]), HEIGHT_M)
        ring = LineRing(pixels.shape[1], pixels.shape[0])
        ring.add(0, pixels)
        out.append(Look(rpc, first, pixels, ring, local, 1.0))
    return out[0], out[1]


def places(image: NDArray[np.uint16], apart: int, options: MatchingOptions) -> Array:
    """Lines and samples (k, 2) of the places that the matcher would choose, one in each cell."""
    window = 2 * LEAST_SQUARES_HALF + 1
    half, found = window // 2 + 2, []
    taken = np.zeros(image.shape, dtype=bool)
    keep = round(0.75 * window)
    for row in range(half, image.shape[0] - half - apart, apart):
        for column in range(half, image.shape[1] - half - apart, apart):
            part = slice(row - half, row + apart + half), slice(column - half, column + apart + half)
            cell = image[part].astype(np.float32)
            usable = np.ones(len(cell), dtype=bool)
            best = interest_point(cell, usable, window, options.largest_sigma_px, ~taken[part], None, 0.98 * FULL_SCALE)
            if best is not None:
                u, v = row - half + best[0], column - half + best[1]
                found.append((u, v))
                taken[max(u - keep + 1, 0) : u + keep, max(v - keep + 1, 0) : v + keep] = True
    return np.array(found, dtype=float)


def match(apart: int, options: MatchingOptions) -> tuple[Array, Found, NDArray[np.str_], Array, Array]:
    """Places (k, 2), what was found, why not, parallax (k, 2) px a metre, and heights (k,) of the grids."""
    left, right = looks()
    pixel = places(left.pixels, apart, options)
    srtm, z = HeightRaster([VENTOUX / "N44E005.hgt"], None, GEOID_M), np.full(len(pixel), HEIGHT_M)
    line, sample = (pixel + left.first).T
    for _ in range(5):
        g = left.rpc.direct(line, sample, z)
        z = srtm.at(g[:, 0], g[:, 1])
    there = right.place(left.ground(pixel, z))
    shown = ((there > AROUND_PX) & (there < np.array(right.pixels.shape) - AROUND_PX)).all(axis=1)
    pixel, z, there = pixel[shown], z[shown], there[shown]
    at, above = left.ground(pixel, z), left.ground(pixel, z + 1.0)
    along = (left.ground(pixel + np.array([1.0, 0.0]), z) - at)[:, :2].mean(axis=0)
    across = (left.ground(pixel + np.array([0.0, 1.0]), z) - at)[:, :2].mean(axis=0)
    spacing = float(np.linalg.norm(across))
    along = along / np.linalg.norm(along)
    side = np.array([-along[1], along[0]])
    ground = Ground(at, along, side if side @ across > 0 else -side, spacing)
    axes = np.stack([ground.along, ground.across]) / spacing
    moved = (above - at - (right.ground(there, z + 1.0) - right.ground(there, z)))[:, :2] @ axes.T
    found = find(left, pixel[:, 0], ground, right, np.zeros((len(pixel), 2)), there[:, 0], REACH_PX)
    return pixel, found, verdict(found, options), moved, z


def robust(values: Array) -> float:
    """Standard deviation by the median of absolute values."""
    return float(1.4826 * np.median(np.abs(values - np.median(values))))


def across_line(pixel: Array, shift: Array, parallax: Array, z: Array) -> tuple[Array, NDArray[np.bool_], Array]:
    """Distances (k,) across the epipolar line without affine biases, which matches are wrong, and normals (k, 2).

    Two affine biases act across the line as one that is affine in the place and in the parallax, which is the height.
    """
    base = np.linalg.norm(parallax, axis=1)
    normal = np.column_stack([-parallax[:, 1], parallax[:, 0]]) / base[:, None]
    height = z + np.einsum("ki,ki->k", shift, parallax) / base**2
    near = np.asarray(KDTree(pixel).query(pixel, NEIGHBOURS + 1)[1])
    off = np.abs(height - np.median(height[near[:, 1:]], axis=1)) > WRONG_M
    distance = np.einsum("ki,ki->k", shift, normal)
    design = np.column_stack([np.ones(len(pixel)), pixel / 250.0 - 1.0, (height - HEIGHT_M) / 100.0])
    good = ~off & (np.abs(distance - np.median(distance[~off])) < 10.0)
    left = distance
    for _ in range(10):
        bias = np.linalg.lstsq(design[good], distance[good], rcond=None)[0]
        left = distance - design @ bias
        good = ~off & (np.abs(left) < max(3.0 * robust(left[good]), 1e-3))
    wrong = off | (np.abs(left) > WRONG_PX)
    bias = np.linalg.lstsq(design[~wrong], distance[~wrong], rcond=None)[0]
    return distance - design @ bias, wrong, normal


def floor_px(across: Array, variance: Array) -> float:
    """What has to be added to stated variances for a NEES of 1, px; negative where they are too large already."""
    if np.mean(across**2 / variance) < 1.0:
        return -float(np.sqrt(max(np.mean(variance) - np.mean(across**2), 0.0)))
    low, high = 0.0, 1.0
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if np.mean(across**2 / (variance + middle**2)) > 1.0 else (low, middle)
    return low


def trend(pixel: Array, across: Array) -> Array:
    """Of each match the mean of the others near it, with weights that fall off over `SMOOTH_PX`."""
    d2 = np.sum((pixel[:, None] - pixel[None]) ** 2, axis=2)
    weight = np.exp(-0.5 * d2 / SMOOTH_PX**2)
    # windows that overlap share errors: a neighbour within one says nothing of its own
    weight[d2 < (2 * LEAST_SQUARES_HALF + 1) ** 2] = 0.0
    return weight @ across / np.maximum(weight.sum(axis=1), 1e-12)


def over_tiles(pixel: Array, figure, *columns: Array) -> tuple[float, float]:
    """95 % band of a figure by a bootstrap over tiles."""
    tile = (pixel // TILE_PX) @ np.array([1000.0, 1.0])
    parts = [np.flatnonzero(tile == t) for t in np.unique(tile)]
    rng, values = np.random.default_rng(1), []
    for _ in range(400):
        index = np.concatenate([parts[i] for i in rng.integers(0, len(parts), len(parts))])
        values.append(figure(*(c[index] for c in columns)))
    low, high = np.quantile(values, [0.025, 0.975])
    return float(low), float(high)


def figures(apart: int, largest_sigma_px: float) -> dict:
    """All that is printed."""
    options = MatchingOptions(full_scale=FULL_SCALE, largest_sigma_px=largest_sigma_px)
    pixel, found, reason, parallax, z = match(apart, options)
    good = reason == ""
    names, counts = np.unique(reason[~good], return_counts=True)
    pixel, shift, covariance = pixel[good], found.shift[good], found.covariance[good]
    r, wrong, normal = across_line(pixel, shift, parallax[good], z[good])
    keep = ~wrong
    variance = np.einsum("ki,kij,kj->k", normal, covariance, normal)[keep]
    r, at = r[keep], pixel[keep]
    stated = options.image_sigma_px
    out: dict = {
        "places": len(reason), "matched": int(good.sum()),
        "not matched": ", ".join(f"{n} {name}" for name, n in zip(names, counts, strict=True)),
        "pixel a metre of height": float(np.linalg.norm(parallax, axis=1).mean()),
        "wrong of the matches": float(wrong.mean()),
        "across, px: standard deviation": float(r.std()), "across, px: by the median": robust(r),
        "stated, px: least squares alone": float(np.sqrt(variance.mean())),
        f"stated, px: with the floor of {stated:g}": float(np.sqrt((variance + stated**2).mean())),
    }  # fmt: skip
    for floor in (0.0, stated, REAL_FLOOR_PX):

        def nees(r: Array, v: Array, floor: float = floor) -> float:
            return float(np.mean(r**2 / (v + floor**2)))

        out[f"NEES with a floor of {floor:g} px"] = (nees(r, variance), *over_tiles(at, nees, r, variance))
    out["floor for a NEES of 1, px"] = (floor_px(r, variance), *over_tiles(at, floor_px, r, variance))
    order = np.array_split(np.argsort(variance), 3)
    out["floor by thirds of stated sigma, px"] = [floor_px(r[i], variance[i]) for i in order]
    smooth = trend(at, r)
    out["trend, px"] = float(smooth.std())
    out["floor without the trend, px"] = (
        floor_px(r - smooth, variance), *over_tiles(at, floor_px, r - smooth, variance)
    )  # fmt: skip
    return out


def main() -> int:
    parser = frame.parser(__doc__, as_json=True)
    parser.add_argument("--apart", type=int, default=10, help="side of the cells in which places are chosen, px (10)")
    parser.add_argument("--largest-sigma", type=float, default=0.1, help="of matches that are taken, px (0.1)")
    args = parser.parse_args()
    if not VENTOUX.is_dir():
        print("../shared/data/satellites/phr_ventoux is not there: no real pixels to match")
        return 0
    frame.show(figures(args.apart, args.largest_sigma), args.json)
    return 0


if __name__ == "__main__":
    sys.exit(main())
