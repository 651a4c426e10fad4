"""Places in an image that can be measured well in both directions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, maximum_filter, uniform_filter

Array = NDArray[np.floating]

#: Larger cells than this, px, are looked over in steps first, so that the work does not grow with them.
LARGE_CELL = 160 * 160
#: Gradients far above so many times the noise count as that: texture all over a window is measured better than one hard
#: edge, which detectors alias and which moves where it lies in front of something.
STRONG = 8.0
#: No more than this share of a window may lie on pixels that were not measured.
MOST_HOLES = 0.35


def image_noise(image: NDArray[np.floating], holes: NDArray[np.bool_] | None = None) -> float:
    """Standard deviation of the noise in grey values, from second differences along and across: texture is smooth.

    Parameters
    ----------
    image, holes : (rows, columns) grey values, and where there are none
    """
    d = image[1:, 1:] - image[1:, :-1] - image[:-1, 1:] + image[:-1, :-1]
    if holes is not None:
        d = d[~(holes[1:, 1:] | holes[1:, :-1] | holes[:-1, 1:] | holes[:-1, :-1])]
    return float(np.median(np.abs(d)) / (0.6745 * 2.0)) if d.size else 0.0


def interest_point(
    image: NDArray[np.floating],
    usable: NDArray[np.bool_],
    window: int,
    largest_sigma_px: float,
    free: NDArray[np.bool_] | None = None,
    filled: NDArray[np.bool_] | None = None,
    saturated: float = np.inf,
) -> tuple[int, int, float] | None:
    """Row and column of the best place of a cell, and the sigma (px) to be expected there; None if none is good enough.

    The variance of a shift is ``noise^2`` times the inverse of the structure tensor over the window; the worse of the
    two directions counts.

    Parameters
    ----------
    image : (n, m) the cell, with half a window more on every side, in which no places are wanted
    usable : (n,) lines that may be used; places nearer than half a window to one that may not are left out
    window : side of the matching window
    largest_sigma_px : places that would be measured worse are not good enough
    free : (n, m) where a place may be; everywhere, if not given
    filled : (n,) lines that did not come, with what lies between those around them: they say nothing, a few do no harm
    saturated : grey value from which on pixels, as those that are 0, do not say anything either
    """
    half = window // 2 + 1
    if min(image.shape) < 2 * half + 1 or not usable.any():
        return None
    some = image[usable]
    holes = _holes(image, usable, filled, saturated)
    some_holes = None if holes is None else holes[usable]
    if filled is not None:
        usable = usable | filled
    first = max(LARGE_CELL // some.shape[1], 2)
    some_holes = None if some_holes is None else some_holes[:first]
    noise = max(image_noise(some[:first], some_holes), 0.5) if len(some) > 2 else 1.0
    step = int(np.ceil(np.sqrt(image.size / LARGE_CELL)))
    top = left = 0
    if free is None:
        free = np.ones(image.shape, dtype=bool)
    if step > 1:
        coarse = _worth(
            image[::step, ::step], usable[::step], max(window // step, 3), max(half // step, 2), noise,
            free[::step, ::step], None if holes is None else holes[::step, ::step],
        )  # fmt: skip
        row, column, _ = coarse.best(0.0)
        reach = half + max(window, 2 * step)
        top, left = max(row * step - reach, 0), max(column * step - reach, 0)
        rows, columns = slice(top, row * step + reach + 1), slice(left, column * step + reach + 1)
        image, usable, free = image[rows, columns], usable[rows], free[rows, columns]
        holes = None if holes is None else holes[rows, columns]
        if min(image.shape) < 2 * half + 1:
            return None
    # template and searched image are both noisy
    worth = _worth(image, usable, window, half, noise, free, holes)
    row, column, least = worth.best(2 * noise**2 / largest_sigma_px**2)
    if least <= 0.0:
        return None
    return row + top, column + left, float(np.sqrt(2 * noise**2 / least))


@dataclass(frozen=True)
class Worth:
    """What windows about the pixels (n, m) of a cell are worth.

    Attributes
    ----------
    least : smaller eigenvalue of the structure tensor over the window
    even : the same over its quarters, their harmonic mean: what a part of a window without texture would have to tell
        is told by one edge in another, and an edge that two views do not see alike moves the result. Fails less often.
    """

    least: Array
    even: Array

    def best(self, above: float) -> tuple[int, int, float]:
        """Row and column of the most even texture where ``least`` is more than ``above``, and its ``least`` (or 0)."""
        value = np.where(self.least > above, self.even, 0.0)
        row, column = (int(i) for i in np.unravel_index(int(value.argmax()), value.shape))
        return row, column, float(self.least[row, column]) if value[row, column] > 0.0 else 0.0


def _holes(
    image: NDArray[np.floating], usable: NDArray[np.bool_], filled: NDArray[np.bool_] | None, saturated: float
) -> NDArray[np.bool_] | None:
    """Pixels (n, m) of the lines that may be used that were not measured; None for no such pixel."""
    out = None
    if image.max() >= saturated or image.min() <= 0.0:
        out = ((image >= saturated) | (image <= 0.0)) & usable[:, None]
    if filled is not None and filled.any():
        out = filled[:, None] | (np.zeros(image.shape, dtype=bool) if out is None else out)
    return out if out is None or out.any() else None


def _worth(
    image: NDArray[np.floating], usable: NDArray[np.bool_], window: int, half: int, noise: float,
    free: NDArray[np.bool_], holes: NDArray[np.bool_] | None = None,
) -> Worth:  # fmt: skip
    """What a window about each pixel is worth; 0 where no place is wanted."""
    gu, gv = np.gradient(gaussian_filter(image, 0.7))
    strong = 1.0 / np.sqrt(1.0 + (gu * gu + gv * gv) / np.float32(STRONG * noise) ** 2)
    covered = None
    if holes is not None:
        covered = np.asarray(maximum_filter(holes.astype(np.float32), 3))
        strong = np.where(covered > 0.0, np.float32(0.0), strong)
    gu, gv = gu * strong, gv * strong
    quarter = window // 2 + 1
    sums = np.stack([float(quarter**2) * uniform_filter(g, quarter) for g in (gu * gu, gu * gv, gv * gv)])
    # the middles of a window's quarters; their sums overlap by a row and a column
    before = quarter // 2 - window // 2
    quarters = [(u, v) for u in (before, before + window - quarter) for v in (before, before + window - quarter)]
    part = _smaller(*sums)
    whole = np.sum([_moved(sums, u, v) for u, v in quarters], axis=0) * (window / (2 * quarter)) ** 2
    least = _smaller(*whole)
    even = 4.0 / np.sum([1.0 / np.maximum(_moved(part, u, v), 1e-6) for u, v in quarters], axis=0)
    wanted = np.zeros(image.shape, dtype=bool)
    wanted[half:-half, half:-half] = free[half:-half, half:-half]
    for line in np.flatnonzero(~usable):
        wanted[max(line - half, 0) : line + half + 1] = False
    if covered is not None:
        wanted &= uniform_filter(covered, window) <= MOST_HOLES
    return Worth(np.where(wanted, least, 0.0), np.where(wanted, even, 0.0))


def _smaller(a: Array, b: Array, c: Array) -> Array:
    """Smaller eigenvalue of ``[[a, b], [b, c]]``."""
    return 0.5 * (a + c) - np.sqrt(0.25 * (a - c) ** 2 + b * b)


def _moved(values: Array, rows: int, columns: int) -> Array:
    """What lies so many rows and columns further; at the border, anything."""
    return np.roll(values, (-rows, -columns), axis=(-2, -1))
