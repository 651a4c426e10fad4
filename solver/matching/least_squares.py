"""Least squares matching of many patches at once: affine in geometry, linear in grey values."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter

from .patches import interpolate_stack

Array = NDArray[np.floating]

#: A shift that changes less has converged, px.
CONVERGED_PX = 0.003
#: Gaussian weight of the window: its standard deviation as a share of the side.
WEIGHT_SHARE = 0.3
#: Residuals are alike over so many pixels, at most.
BOX = 7
#: A window hardly larger than the box, with eight unknowns fitted in it, shows less than all of it.
SHORTFALL = 1.6
#: Scale and shear stay within this of none.
LARGEST_SHEAR = 0.35


@dataclass(frozen=True)
class PatchMatch:
    """Where templates were found; k patches.

    Attributes
    ----------
    shift : (k, 2) row and column of the template's middle against the middle of the search patch, px
    covariance : (k, 2, 2) of the shift, px^2
    affine : (k, 2, 2) change of row and column in the search patch per row and column of the template
    score : (k,) correlation coefficient at the solution
    converged : (k,)
    """

    shift: Array
    covariance: Array
    affine: Array
    score: Array
    converged: NDArray[np.bool_]


def match_patches(
    template: NDArray[np.floating], search: NDArray[np.floating], start: Array, iterations: int = 8
) -> PatchMatch:
    """Find templates (k, t, t) in search patches (k, s, s) from shifts (k, 2) that are good to a pixel or so.

    ``template(r, c) = gain search(a + A (r, c)) + offset``: eight unknowns, Gauss-Newton, both images taken as noisy.
    """
    k, t, _ = template.shape
    n = search.shape[1]
    middle = 0.5 * (n - 1)
    r = np.arange(t) - 0.5 * (t - 1)
    rows, columns = (a.ravel() for a in np.meshgrid(r, r, indexing="ij"))
    weight = np.exp(-0.5 * (rows**2 + columns**2) / (WEIGHT_SHARE * t) ** 2)
    wanted = template.reshape(k, -1).astype(float)
    shift, affine = np.array(start, dtype=float), np.repeat(np.eye(2)[None], k, axis=0)
    moved = np.full(k, np.inf)
    shape = np.stack([np.ones_like(rows), rows, columns])
    design = np.empty((k, t * t, 8))
    cofactors = np.zeros((k, 8, 8))
    residual, found = wanted, wanted
    for _ in range(iterations):
        y = middle + shift[:, :1] + affine[:, 0, :1] * rows + affine[:, 0, 1:] * columns
        x = middle + shift[:, 1:] + affine[:, 1, :1] * rows + affine[:, 1, 1:] * columns
        found = interpolate_stack(search, y, x).astype(float)
        gy = interpolate_stack(search, y + 0.5, x).astype(float) - interpolate_stack(search, y - 0.5, x)
        gx = interpolate_stack(search, y, x + 0.5).astype(float) - interpolate_stack(search, y, x - 0.5)
        # gain and offset of the grey values, so that the residual is one of the search image
        gain, offset = _grey_fit(found, wanted, weight)
        residual = (wanted - offset) / gain - found
        spread = np.maximum(found.std(axis=1), 1.0)[:, None]
        design[:, :, 0:3] = gy[:, :, None] * shape.T
        design[:, :, 3:6] = gx[:, :, None] * shape.T
        design[:, :, 6] = (found - found.mean(axis=1, keepdims=True)) / spread
        design[:, :, 7] = 1.0
        weighted = design * weight[None, :, None]
        normal = np.swapaxes(design, 1, 2) @ weighted
        normal += 1e-6 * np.einsum("kii->ki", normal)[:, :, None] * np.eye(8) + 1e-9 * np.eye(8)
        cofactors = np.linalg.inv(normal)
        step = (cofactors @ np.einsum("kpi,kp->ki", weighted, residual)[:, :, None])[:, :, 0]
        step[:, [0, 3]] = np.clip(step[:, [0, 3]], -1.0, 1.0)
        shift += step[:, [0, 3]]
        affine[:, 0] += np.clip(step[:, 1:3], -0.1, 0.1)
        affine[:, 1] += np.clip(step[:, 4:6], -0.1, 0.1)
        affine = np.eye(2) + np.clip(affine - np.eye(2), -LARGEST_SHEAR, LARGEST_SHEAR)
        moved = np.abs(step[:, [0, 3]]).max(axis=1)
        if (moved < CONVERGED_PX).all():
            break
    gain, offset = _grey_fit(found, wanted, weight)
    left = (wanted - offset) / gain - found
    covariance = _shift_covariance(design, weight, cofactors, left, t)
    return PatchMatch(shift, covariance, affine, _score(found, wanted, weight), moved < 0.05)


def _shift_covariance(design: Array, weight: Array, cofactors: Array, left: Array, t: int) -> Array:
    """Covariance (k, 2, 2) of the shifts from the residuals (k, p): noise, and everything the model does not know.

    Noise is white, but what else two images do not have in common (tree crowns, waves, relief) is alike over several
    pixels and moves the result more. Sums of what residuals do to the shift over boxes show it (a long-run variance
    with triangular weights); it counts where it is more than white noise makes of the same residuals.
    """
    k = len(left)
    total = weight.sum()
    square = np.sum(weight * left**2, axis=1) / (total - 8 * np.sum(weight**2) / total)
    gain = (cofactors[:, [0, 3]] @ np.swapaxes(design, 1, 2)) * weight  # (k, 2, p)
    white = square[:, None, None] * (gain @ np.swapaxes(gain, 1, 2))
    moves = (gain * left[:, None]).reshape(k, 2, t, t)
    padded = np.zeros((k, 2, t + 2 * BOX, t + 2 * BOX))
    padded[:, :, BOX : BOX + t, BOX : BOX + t] = moves
    sums = (BOX * uniform_filter(padded, BOX, mode="constant", axes=(2, 3))).reshape(k, 2, -1)
    alike = sums @ np.swapaxes(sums, 1, 2)
    more = np.einsum("kii->k", alike) / np.maximum(np.einsum("kii->k", white), 1e-12)
    return white * np.maximum(SHORTFALL * more, 1.0)[:, None, None]


def _grey_fit(found: Array, wanted: Array, weight: Array) -> tuple[Array, Array]:
    """Gain and offset (k, 1) that turn found grey values (k, p) into the wanted ones best, equal to both images."""
    total = weight.sum()
    mf, mw = (found @ weight)[:, None] / total, (wanted @ weight)[:, None] / total
    sf = np.sqrt(((found - mf) ** 2) @ weight)[:, None]
    sw = np.sqrt(((wanted - mw) ** 2) @ weight)[:, None]
    gain = np.maximum(sw, 1e-3) / np.maximum(sf, 1e-3)
    return gain, mw - gain * mf


def _score(found: Array, wanted: Array, weight: Array) -> Array:
    total = weight.sum()
    f, w = found - (found @ weight)[:, None] / total, wanted - (wanted @ weight)[:, None] / total
    return ((f * w) @ weight) / np.sqrt(np.maximum((f * f) @ weight, 1e-6) * np.maximum((w * w) @ weight, 1e-6))
