"""Places in an image that can be measured well in both directions."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, uniform_filter

Array = NDArray[np.floating]

#: Larger cells than this, px, are looked over in steps first, so that the work does not grow with them.
LARGE_CELL = 160 * 160
#: Gradients far above so many times the noise count as that: texture all over a window is measured better than one hard
#: edge, which detectors alias and which moves where it lies in front of something.
STRONG = 8.0


def image_noise(image: NDArray[np.floating]) -> float:
    """Standard deviation of the noise, from second differences along and across: texture is smooth, noise is not."""
    d = image[1:, 1:] - image[1:, :-1] - image[:-1, 1:] + image[:-1, :-1]
    return float(np.median(np.abs(d)) / (0.6745 * 2.0)) if d.size else 0.0


def interest_point(
    image: NDArray[np.floating], usable: NDArray[np.bool_], window: int, largest_sigma_px: float
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
    """
    half = window // 2 + 1
    if min(image.shape) < 2 * half + 1:
        return None
    some = image[usable]
    noise = max(image_noise(some[: max(LARGE_CELL // some.shape[1], 2)]), 0.5) if len(some) > 2 else 1.0
    step = int(np.ceil(np.sqrt(image.size / LARGE_CELL)))
    top = left = 0
    if step > 1:
        coarse = _least(image[::step, ::step], usable[::step], max(window // step, 3), max(half // step, 2), noise)
        row, column = (int(i) for i in np.unravel_index(int(coarse.argmax()), coarse.shape))
        reach = half + max(window, 2 * step)
        top, left = max(row * step - reach, 0), max(column * step - reach, 0)
        image, usable = (
            image[top : row * step + reach + 1, left : column * step + reach + 1],
            usable[top : row * step + reach + 1],
        )
        if min(image.shape) < 2 * half + 1:
            return None
    least = _least(image, usable, window, half, noise)
    row, column = (int(i) for i in np.unravel_index(int(least.argmax()), least.shape))
    # template and searched image are both noisy
    if least[row, column] <= 2 * noise**2 / largest_sigma_px**2:
        return None
    return row + top, column + left, float(np.sqrt(2 * noise**2 / least[row, column]))


def _least(image: NDArray[np.floating], usable: NDArray[np.bool_], window: int, half: int, noise: float) -> Array:
    """Smaller eigenvalue of the structure tensor, summed over the window; 0 where no place is wanted."""
    gu, gv = np.gradient(gaussian_filter(image, 0.7))
    strong = 1.0 / np.sqrt(1.0 + (gu * gu + gv * gv) / (STRONG * noise) ** 2)
    gu, gv = gu * strong, gv * strong
    a, b, c = (float(window * window) * uniform_filter(g, window) for g in (gu * gu, gu * gv, gv * gv))
    least = 0.5 * (a + c) - np.sqrt(0.25 * (a - c) ** 2 + b * b)
    for line in np.flatnonzero(~usable):
        least[max(line - half, 0) : line + half + 1] = 0.0
    inner = np.zeros_like(least)
    inner[half:-half, half:-half] = least[half:-half, half:-half]
    return inner
