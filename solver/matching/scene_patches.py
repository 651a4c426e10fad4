"""Patches of images that have a location model, on grids that are those of a master image's pixels.

A grid about a place of the master follows its lines and samples; its nodes lie on the ground at one height and are seen
by any other image where its location model says. So rotation, other pixel sizes and the motion of the satellite are in
the patch, and what is left to find is the error of the models, the height, and the slope of the ground.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .patches import Windows, any_of
from .search import Ground, Patches

Array = NDArray[np.floating]

#: Half of the way over which the mapping from image to image is differentiated, px of the master: from a grid's middle
#: the mapping is linear, as it is over the largest patch to some thousandths of a pixel.
DIFFERENCE_PX = 4.0
#: So far outside an image its location model still answers where it can, px.
OUTSIDE_PX = 20_000.0
#: Half of the change of height by which parallax is found, m.
PARALLAX_M = 20.0


class Location(Protocol):
    """A location model; latitude and longitude are radians, heights metres above the ellipsoid.

    Attributes
    ----------
    lines, samples : of the scene, 0 where they are not known
    """

    @property
    def lines(self) -> int: ...

    @property
    def samples(self) -> int: ...

    def direct(self, line: ArrayLike, sample: ArrayLike, height_m: ArrayLike) -> Array: ...

    def inverse(self, lat: ArrayLike, lon: ArrayLike, height_m: ArrayLike, margin_px: float = 0.0) -> Array: ...


class Pixels(Protocol):
    """Grey values of an image, in pieces.

    Attributes
    ----------
    first, end : (line, sample) of the scene with which the image begins, and behind which it ends
    saturated : grey value from which on pixels are saturated
    """

    first: tuple[int, int]
    end: tuple[int, int]
    saturated: float

    def window(self, line: int, sample: int, lines: int, samples: int) -> NDArray[np.float32]:
        """(lines, samples) from a pixel of the scene on; 0 where there are none."""
        ...


@dataclass(frozen=True, eq=False)
class SceneView:
    """An image, and where its pixels lie.

    Attributes
    ----------
    name : for people
    location : of the pixels of the scene
    pixels : the image, all of the scene or a part
    """

    name: str
    location: Location
    pixels: Pixels

    def inside(self, pixel: Array, margin_px: float = 0.0) -> NDArray[np.bool_]:
        """Which pixels (..., 2) lie in the image, or no further than a margin outside."""
        with np.errstate(invalid="ignore"):
            low, high = np.array(self.pixels.first) - margin_px, np.array(self.pixels.end) - 1 + margin_px
            return np.asarray(((pixel >= low) & (pixel <= high)).all(axis=-1))

    def grid(self, number: int) -> Array:
        """(number^2, 2) pixels evenly over the image."""
        axes = [np.linspace(a, b - 1, number) for a, b in zip(self.pixels.first, self.pixels.end, strict=True)]
        return np.stack([a.ravel() for a in np.meshgrid(*axes, indexing="ij")], axis=1)


def transferred(master: SceneView, other: SceneView, pixel: Array, height_m: Array) -> Array:
    """Pixels (k, 2) of another image at which the ground under pixels (k, 2) of the master is seen; NaN for none."""
    if master is other:
        return np.array(pixel, dtype=float)
    located = master.location.direct(pixel[:, 0], pixel[:, 1], height_m)
    out, known = np.full((len(pixel), 2), np.nan), np.isfinite(located).all(axis=1)
    lat, lon, height = located[known].T
    out[known] = other.location.inverse(lat, lon, height, OUTSIDE_PX)
    return out


def mapping(master: SceneView, other: SceneView, pixel: Array, height_m: Array) -> tuple[Array, Array]:
    """`transferred` (k, 2), and its derivatives (k, 2, 2) by line and sample of the master."""
    if master is other:
        return np.array(pixel, dtype=float), np.repeat(np.eye(2)[None], len(pixel), axis=0)
    steps = DIFFERENCE_PX * np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]])
    at = transferred(master, other, (pixel[:, None] + steps).reshape(-1, 2), np.repeat(height_m, 5))
    at = at.reshape(-1, 5, 2)
    return at[:, 0], np.stack([at[:, 1] - at[:, 2], at[:, 3] - at[:, 4]], axis=2) / (2 * DIFFERENCE_PX)


def parallaxes(master: SceneView, other: SceneView, pixel: Array, height_m: Array) -> Array:
    """(k, 2) lines and samples of the master by which ground moves in another image's patch for a metre of height."""
    high, low = (transferred(master, other, pixel, height_m + dh) for dh in (PARALLAX_M, -PARALLAX_M))
    _, slope = mapping(master, other, pixel, height_m)
    slope = np.where(np.isfinite(slope).all(axis=(1, 2), keepdims=True), slope, np.eye(2))
    return np.linalg.solve(slope, (high - low)[:, :, None])[:, :, 0] / (2 * PARALLAX_M)


class ScenePatches:
    """One image as `search.Imagery`.

    Grids (`search.Ground`) have the line, the sample and the height of the master's places as their middles, and pixels
    of the master as their metres.
    """

    #: `find` only passes on lines that are made of it, which nobody needs here
    line_m = 1.0

    def __init__(self, master: SceneView, view: SceneView):
        self.master, self.view = master, view

    def select(self, chosen: NDArray[np.bool_]) -> ScenePatches:
        """An image is the same for all places."""
        return self

    def patches(self, ground: Ground, line: Array, half: int, factor: int) -> Patches:
        """See `search.Imagery`; the lines are not needed. What is not known is among the holes."""
        middle, slope = mapping(self.master, self.view, ground.centre_l[:, :2], ground.centre_l[:, 2])
        k = len(middle)
        seen = np.asarray(np.isfinite(middle).all(axis=1) & np.isfinite(slope).all(axis=(1, 2)))
        slope = np.where(seen[:, None, None], slope, np.eye(2))
        # outside, wherever the image is
        middle = np.where(seen[:, None], np.clip(middle, -1e8, 1e8), np.array(self.view.pixels.end) + 1e5)
        grid = factor * ground.spacing_m * np.arange(-half, half + 1.0)
        at = middle[:, :, None, None] + slope[:, :, :1, None] * grid[:, None] + slope[:, :, 1:, None] * grid
        scale = float(np.sqrt(np.median(np.abs(np.linalg.det(slope[seen]))))) if seen.any() else 1.0
        # as many pixels are put together as fall on a node, so that both images are of the same sharpness
        reduce = max(round(factor * ground.spacing_m * scale), 1)
        windows = self._windows(at, reduce)
        windows, holes = windows.mended(self.view.pixels.saturated)
        none = windows.values <= 0.0  # no data; single pixels of 0 and saturated ones are mended
        windows = windows.reduced(reduce)
        values, known = windows.sample(at[:, 0], at[:, 1], cubic=factor == 1)
        good = known & ~windows.touched(any_of(none, reduce), at[:, 0], at[:, 1]) if none.any() else known
        if factor > 1:  # `find` takes holes of full-size patches alone
            known = good
        # beside what has no data, large edges would correlate with anything
        mean = np.sum(values, axis=(1, 2), where=good) / np.maximum(good.sum(axis=(1, 2)), 1)
        values = np.where(good, values, mean[:, None, None].astype(np.float32))
        touched = ~good
        if holes is not None and factor == 1:
            touched |= windows.touched(any_of(holes, reduce), at[:, 0], at[:, 1])
        return Patches(values, known.reshape(k, -1).mean(axis=1), np.zeros(k), touched if touched.any() else None)

    def _windows(self, at: Array, reduce: int) -> Windows:
        """The pixels around lines and samples (k, 2, n, n), a whole number of blocks that are put together."""
        pixels, pad = self.view.pixels, 2 + 2 * reduce
        first = np.floor(at.min(axis=(2, 3))).astype(np.int64) - pad
        size = np.ceil((at.max(axis=(2, 3)) - first).max(axis=0)).astype(int) + pad
        lines, samples = (int(-(-s // reduce) * reduce) for s in size)
        values = np.stack([pixels.window(line, sample, lines, samples) for line, sample in first.tolist()])
        known = [
            (first[:, k, None] + np.arange(length) >= pixels.first[k])
            & (first[:, k, None] + np.arange(length) < pixels.end[k])
            for k, length in enumerate((lines, samples))
        ]
        return Windows(first[:, 0], first[:, 1], values, known[0], known[1], np.zeros((len(values), lines), dtype=bool))
