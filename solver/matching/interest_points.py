"""Places in an image that can be measured well in both directions, spread evenly."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, uniform_filter

Array = NDArray[np.floating]


@dataclass(frozen=True)
class InterestPoints:
    """Whole pixels worth measuring; n points.

    Attributes
    ----------
    row, column : (n,) place in the image
    sigma_px : (n,) to be expected of matching in the direction that is worse
    cells : how many cells were looked at
    """

    row: NDArray[np.int64]
    column: NDArray[np.int64]
    sigma_px: Array
    cells: int


def image_noise(image: NDArray[np.floating]) -> float:
    """Standard deviation of the noise, from second differences along and across: texture is smooth, noise is not."""
    d = image[1:, 1:] - image[1:, :-1] - image[:-1, 1:] + image[:-1, :-1]
    return float(np.median(np.abs(d)) / (0.6745 * 2.0)) if d.size else 0.0


def interest_points(
    image: NDArray[np.floating],
    usable: NDArray[np.bool_],
    cell_columns: NDArray[np.int64],
    rows: tuple[int, int],
    window: int,
    largest_sigma_px: float,
) -> InterestPoints:
    """The best place of every cell, if it is good enough: least variance of a shift, the larger of two directions.

    The variance is ``noise^2`` times the inverse of the structure tensor over the window.

    Parameters
    ----------
    image : (n, m)
    usable : (n,) lines that may be used
    cell_columns : (cells + 1,) borders of the cells across
    rows : first and last row (excluded) in which points are wanted
    window : side of the matching window; places nearer than its half to the border or to an unusable line are left out
    largest_sigma_px : places that would be measured worse are left out
    """
    cells = len(cell_columns) - 1
    none = InterestPoints(np.empty(0, np.int64), np.empty(0, np.int64), np.empty(0), cells)
    half = window // 2 + 1
    first, end = max(rows[0], half), min(rows[1], len(image) - half)
    if first >= end:
        return none
    image = image[first - half : end + half]
    usable = usable[first - half : end + half]
    smooth = gaussian_filter(image, 0.7)
    gu, gv = np.gradient(smooth)
    area = float(window * window)
    a, b, c = (area * uniform_filter(g, window) for g in (gu * gu, gu * gv, gv * gv))
    least = 0.5 * (a + c) - np.sqrt(0.25 * (a - c) ** 2 + b * b)
    noise = max(image_noise(image[usable]), 0.5) if usable.sum() > 2 else 1.0
    bad = np.flatnonzero(~usable)
    for line in bad:
        least[max(line - half, 0) : line + half + 1] = 0.0
    least = least[half:-half]
    least[:, :half] = least[:, -half:] = 0.0
    # template and searched image are both noisy
    floor = 2 * noise**2 / largest_sigma_px**2
    found = []
    for left, right in pairwise(cell_columns):
        part = least[:, left:right]
        row, column = np.unravel_index(int(part.argmax()), part.shape)
        if part[row, column] > floor:
            found.append((row + first, column + left, np.sqrt(2 * noise**2 / part[row, column])))
    if not found:
        return none
    row, column, sigma = (np.array(x) for x in zip(*found, strict=True))
    return InterestPoints(row.astype(np.int64), column.astype(np.int64), sigma, cells)
