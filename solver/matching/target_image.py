"""Signalised targets in grey values: a white disc in a black ring, found by pattern and centred by least squares."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import erf

from .correlation import correlate

Array = NDArray[np.floating]

#: Radius of the black ring, in radii of the white disc.
RING = 2.2
#: Blur of an edge where the fit begins, pixels; and the limits of what it may find.
BLUR_PX, LEAST_BLUR_PX, LARGEST_BLUR_PX = 0.55, 0.3, 1.5
#: The outer edge of the ring is left out by this much, pixels: what lies beyond it is not known.
EDGE_PX = 1.0
#: The centre has settled, pixels.
CONVERGED_PX = 1e-3


@dataclass(frozen=True)
class Centre:
    """A target's centre.

    Attributes
    ----------
    xy : (2,) in the units of the places of the pixels
    covariance : (2, 2) from the residuals of the grey values
    score : correlation coefficient of grey values and model
    white, black : grey values of disc and ring
    converged :
    """

    xy: Array
    covariance: Array
    score: float
    white: float
    black: float
    converged: bool


def pattern(radius: float, half: int) -> Array:
    """The target on a grid (n, n), n = 2 half + 1, with a spacing of 1: disc 1, ring 0, beyond it the mean of both."""
    r = np.arange(-half, half + 1.0)
    distance = np.hypot(r[:, None], r[None, :])
    out = _disc(distance, radius, BLUR_PX)
    inside = distance <= RING * radius
    out[~inside] = out[inside].mean()
    return out


def candidates(values: NDArray[np.floating], radius: float, most: int) -> tuple[NDArray[np.int64], Array]:
    """Places (k, 2), row and column, in a patch (n, n) that look most like a target, best first; and how much (k,).

    Places are local maxima of the correlation coefficient; the radius is in pixels of the patch.

    Raises
    ------
    ValueError : a patch that is smaller than the target
    """
    half = int(np.ceil(RING * radius))
    score = correlate(pattern(radius, half)[None].astype(np.float32), values[None])[0]
    taken, tops = [], []
    reach = max(int(radius), 1)
    for _ in range(most):
        at = int(np.argmax(score))
        row, column = divmod(at, score.shape[1])
        top = float(score[row, column])
        if not top > 0:
            break
        taken.append((row + half, column + half))
        tops.append(top)
        score[max(row - reach, 0) : row + reach + 1, max(column - reach, 0) : column + reach + 1] = -1.0
    return np.array(taken, dtype=np.int64).reshape(-1, 2), np.array(tops)


def fit(xy: Array, grey: Array, start: Array, radius: float, pixel: float, rounds: int = 15) -> Centre:
    """Centre of a target among pixels at places (n, 2) with grey values (n,), from a start that is good to a pixel.

    The places need not lie on a grid, so that vibration costs nothing. Unknowns are centre, blur and two grey values;
    Gauss-Newton. ``radius`` of the disc and size of a ``pixel`` are in the units of the places.
    """
    centre, blur = np.array(start, dtype=float), BLUR_PX * pixel
    reach = max(RING * radius - EDGE_PX * pixel, radius + 0.7 * pixel)
    nothing = Centre(centre, np.full((2, 2), np.inf), 0.0, 0.0, 0.0, False)
    moved = np.inf
    covariance, score, levels = nothing.covariance, 0.0, np.zeros(2)
    for _ in range(rounds):
        off = xy - centre
        distance = np.hypot(*off.T)
        chosen = distance < reach
        d, o, g = distance[chosen], off[chosen], grey[chosen]
        if len(g) < 9:
            return nothing
        cover = _disc(d, radius, blur)
        levels = np.linalg.lstsq(np.column_stack([cover, 1 - cover]), g, rcond=None)[0]
        residual = g - levels[1] - (levels[0] - levels[1]) * cover
        steep = (levels[0] - levels[1]) * np.exp(-0.5 * ((radius - d) / blur) ** 2) / (np.sqrt(2 * np.pi) * blur)
        outward = o / np.maximum(d, 1e-9)[:, None]
        design = np.column_stack([steep[:, None] * outward, -steep * (radius - d) / blur, cover, 1 - cover])
        normal = design.T @ design
        normal[np.diag_indices(5)] *= 1 + 1e-9
        normal[2, 2] += 1e-6 * normal[0, 0] + 1e-12
        try:
            cofactors = np.linalg.inv(normal)
        except np.linalg.LinAlgError:
            return nothing
        step = cofactors @ (design.T @ residual)
        length = float(np.hypot(*step[:2]))
        centre = centre + step[:2] * min(1.0, 0.5 * pixel / max(length, 1e-12))
        blur = float(np.clip(blur + step[2], LEAST_BLUR_PX * pixel, LARGEST_BLUR_PX * pixel))
        total = float(np.sum((g - g.mean()) ** 2))
        score = float(np.sqrt(max(1.0 - float(residual @ residual) / max(total, 1e-9), 0.0)))
        covariance = cofactors[:2, :2] * float(residual @ residual) / max(len(g) - 5, 1)
        moved = length / pixel
        if moved < CONVERGED_PX:
            break
    far = float(np.hypot(*(centre - start))) > 2.0 * pixel
    return Centre(centre, covariance, score, float(levels[0]), float(levels[1]), moved < 0.02 and not far)


def _disc(distance: Array, radius: float, blur: float) -> Array:
    """How much of the blurred disc is seen at distances from its centre."""
    return 0.5 * (1.0 + erf((radius - distance) / (np.sqrt(2.0) * blur)))
