"""The two Pleiades looks at Mont Ventoux: rectified by their RPC, and by RPC with an affine correction."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import rasterio
from scipy.ndimage import gaussian_filter
from scipy.signal import correlate

from triline.nodes.cli import main

#: Height of the geoid EGM96 above the ellipsoid at Mont Ventoux, metres.
GEOID_M = 50.5
#: Half sizes of patches and of the search for them, cells; least correlation; how many cells patches are apart.
HALF, SEARCH, LEAST, APART = 15, 18, 0.75, 12


def rectified(folder: Path, out: Path, side: str, name: str, *more: str) -> Path:
    path = out / f"{name}.tif"
    args = ["--sensor", str(folder / f"{side}_image.geom"), "--dem", str(folder / "N44E005.hgt"), *more]
    args += ["--dem-datum", str(GEOID_M), "--gsd", "0.5", "--resampling", "cubic", "-o", str(path), "-q"]
    assert main(["rectify", str(folder / f"{side}_image.tif"), *args]) == 0
    return path


def matches(left: Path, right: Path) -> tuple[np.ndarray, np.ndarray]:
    """Places (n, 2; x, y) of patches of the left orthoimage, and how far their match in the right one is off (n, 2), m.

    Normalised cross-correlation; a parabola gives parts of a cell.
    """
    with rasterio.open(left) as a, rasterio.open(right) as b:
        one, two, t, gsd = a.read(1).astype(float), b.read(1).astype(float), a.transform, a.res[0]
        column, row = round((t.c - b.transform.c) / gsd), round((b.transform.f - t.f) / gsd)
    known = [gaussian_filter(image, 0.7) for image in (one, two)]
    places, offsets = [], []
    reach = HALF + SEARCH
    for i in range(HALF, one.shape[0] - HALF, APART):
        for j in range(HALF, one.shape[1] - HALF, APART):
            p, q = i + row, j + column
            if not (reach <= p < two.shape[0] - reach and reach <= q < two.shape[1] - reach):
                continue
            patch = known[0][i - HALF : i + HALF + 1, j - HALF : j + HALF + 1]
            area = known[1][p - reach : p + reach + 1, q - reach : q + reach + 1]
            if (one[i - HALF : i + HALF + 1, j - HALF : j + HALF + 1] == 0).any():
                continue
            if (two[p - reach : p + reach + 1, q - reach : q + reach + 1] == 0).any():
                continue
            found = _peak(patch, area)
            if found is not None:
                places.append((t.c + (j + 0.5) * gsd, t.f - (i + 0.5) * gsd))
                offsets.append((found[1] * gsd, -found[0] * gsd))
    return np.array(places).reshape(-1, 2), np.array(offsets).reshape(-1, 2)


def _peak(patch: np.ndarray, area: np.ndarray) -> tuple[float, float] | None:
    a, b = patch - patch.mean(), area - area.mean()
    variance = _sums(b * b, len(a)) - _sums(b, len(a)) ** 2 / a.size
    norm = np.sqrt((a * a).sum() * np.maximum(variance, 0.0))
    score = correlate(b, a, mode="valid", method="fft") / np.where(norm > 0, norm, 1.0)
    i, j = np.unravel_index(np.argmax(score), score.shape)
    if score[i, j] < LEAST or not (0 < i < score.shape[0] - 1 and 0 < j < score.shape[1] - 1):
        return None
    sub = []
    for line, k in ((score[:, j], i), (score[i], j)):
        left, middle, right = line[k - 1 : k + 2]
        sub.append(k - SEARCH + 0.5 * (left - right) / (left - 2 * middle + right))
    return sub[0], sub[1]


def _sums(values: np.ndarray, side: int) -> np.ndarray:
    """Sums over all squares of so many cells a side."""
    total = np.zeros((values.shape[0] + 1, values.shape[1] + 1))
    total[1:, 1:] = values.cumsum(axis=0).cumsum(axis=1)
    return total[side:, side:] - total[:-side, side:] - total[side:, :-side] + total[:-side, :-side]


def offsets_px(folder: Path, out: Path) -> tuple[np.ndarray, np.ndarray]:
    """Offsets (n, 2) in pixels (0.5 m; east, north) between the orthoimages: by RPC, and after an affine correction.

    Control of the right look: places of half of the matches in the left orthoimage, on the same heights; the offsets
    after it are those of a new matching.
    """
    left = rectified(folder, out, "left", "left")
    right = rectified(folder, out, "right", "right")
    places, before = matches(left, right)
    from pyproj import Transformer

    from triline.nodes.formats.height_raster import HeightRaster
    from triline.nodes.formats.satellite.read import read_scene

    with rasterio.open(left) as a:
        to_degrees = Transformer.from_crs(a.crs, "EPSG:4326", always_xy=True)
    heights = HeightRaster([folder / "N44E005.hgt"], None, str(GEOID_M))
    rpc = read_scene(folder / "right_image.geom").model()
    with rasterio.open(folder / "right_image.tif") as image:
        first = np.array([image.transform.f, image.transform.c])
    lon, lat = to_degrees.transform(*places.T)
    lon_seen, lat_seen = to_degrees.transform(*(places + before).T)
    h, h_seen = (heights.at(np.radians(y), np.radians(x)) for y, x in ((lat, lon), (lat_seen, lon_seen)))
    pixel = rpc.inverse(np.radians(lat_seen), np.radians(lon_seen), h_seen) - first
    rows = [
        f"{x!r},{y!r},{z!r},{v!r},{u!r}"
        for x, y, z, (u, v) in list(zip(lon.tolist(), lat.tolist(), h.tolist(), pixel.tolist(), strict=True))[::2]
    ]
    control = out / "control.csv"
    control.write_text("lon_deg,lat_deg,height_m,column,row\n" + "\n".join(rows) + "\n")
    corrected = rectified(folder, out, "right", "corrected", "--control", str(control), "--pixel-sigma", "1.0")
    _, after = matches(left, corrected)
    return before / 0.5, after / 0.5


def parallax(folder: Path) -> np.ndarray:
    """(2,) east and north, metres, by which the two orthoimages move apart a metre that the heights are wrong by."""
    from triline.nodes.formats.satellite.read import read_scene
    from triline.solver.geometry.ellipsoid import WGS84
    from triline.solver.rectification.sampled import SomeCells, ground_steps

    ways = []
    for side in ("left", "right"):
        rpc = read_scene(folder / f"{side}_image.geom").model()
        middle = SomeCells(np.zeros((1, 2)), np.array([5250.0]), np.array([5250.0]), np.array([600.0]))
        ways.append(ground_steps(rpc, middle, WGS84)[1][0])
    return ways[1] - ways[0]


def summary(folder: Path, out: Path) -> dict[str, float]:
    """Medians of the offsets, pixels: of the vectors, of their lengths, and across the direction of height errors."""
    before, after = offsets_px(folder, out)
    along = parallax(folder)
    base = float(np.linalg.norm(along))
    normal = np.array([-along[1], along[0]]) / base
    result = {"matches": len(after), "base": base}
    for name, offset in (("rpc", before), ("corrected", after)):
        result[f"{name}_median"] = float(np.linalg.norm(np.median(offset, axis=0)))
        result[f"{name}_length"] = float(np.median(np.linalg.norm(offset, axis=1)))
        result[f"{name}_across"] = float(np.median(np.abs(offset @ normal)))
    return result
