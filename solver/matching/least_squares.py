"""Least squares matching of many patches at once: affine in geometry, linear in grey values."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter

from .patches import MOST_HOLE, between, holes_at, interpolate_between

Array = NDArray[np.floating]
Mask = NDArray[np.bool_]

#: A shift that changes less has converged, px.
CONVERGED_PX = 0.003
#: Gaussian weight of the window: its standard deviation as a share of the side.
WEIGHT_SHARE = 0.3
#: Residuals are alike over so many pixels, px, at most. Tuned.
BOX = 7
#: The eight unknowns take out of the residuals what moves them: over boxes of this size, white noise then shows only
#: 1 / 1.7 of what it does (derived by `tests/solver/matching/test_least_squares_matching.py`).
SHORTFALL = 1.7
#: Share of white noise's variance that is left in residuals of patches that were resampled: bicubic values keep 0.81
#: along and 0.81 across (mean of the squared weights over all phases). The searched patch is taken from where it was
#: found, so that interpolating it again changes nothing; of the master, whose samples are those of the grid, only the
#: lines are interpolated: (0.66 + 0.81) / 2 (derived). What moves a patch, the low frequencies of the noise, stays.
SMOOTHED = 0.73
#: Difference of bicubic values half a pixel to either side (derived).
GRADIENT_TAPS = np.array([-1.0, 10.0, 0.0, -10.0, 1.0]) / 16.0
#: Scale and shear stay within this of none.
LARGEST_SHEAR = 0.35
#: Which pixels are covered by holes of the searched patch is looked up in so many iterations, then it is settled.
SETTLING = 3
#: Weights are taken for no less than this in sum.
LEAST_WEIGHT = 1e-6
#: Fewer gradients of residuals than this do not tell the noise.
FEWEST_GRADIENTS = 30


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
    measured : (k,) share of the window's weight that lies on pixels which both images measured
    """

    shift: Array
    covariance: Array
    affine: Array
    score: Array
    converged: Mask
    measured: Array


def match_patches(
    template: NDArray[np.floating],
    search: NDArray[np.floating],
    start: Array,
    iterations: int = 8,
    holes: tuple[Mask, Mask] | None = None,
) -> PatchMatch:
    """Find templates (k, t, t) in search patches (k, s, s) from shifts (k, 2) that are good to a pixel or so.

    ``template(r, c) = gain search(a + A (r, c)) + offset``: eight unknowns, Gauss-Newton, both images taken as noisy.
    ``holes`` are the pixels of both that were not measured: they have no weight, whatever their grey values.
    """
    k, t, _ = template.shape
    window, wanted = _Window(t), template.reshape(len(template), -1).astype(float)
    shift, affine, weight, moved = _settled(window, wanted, search, start, iterations, holes)
    design, residual, found = window.linearise(search, wanted, shift, affine, weight)
    covariance = _shift_covariance(design, weight, residual, t)
    measured = np.broadcast_to(weight.sum(axis=1) / window.weight.sum(), k)
    return PatchMatch(shift, covariance, affine, _score(found, wanted, weight), moved < 0.05, measured)


def shifts(
    template: NDArray[np.floating],
    search: NDArray[np.floating],
    start: Array,
    iterations: int,
    holes: tuple[Mask, Mask] | None = None,
) -> Array:
    """Only the shifts (k, 2) of `match_patches`."""
    wanted = template.reshape(len(template), -1).astype(float)
    return _settled(_Window(template.shape[1]), wanted, search, start, iterations, holes)[0]


def _settled(
    window: _Window, wanted: Array, search: NDArray[np.floating], start: Array, iterations: int,
    holes: tuple[Mask, Mask] | None,
) -> tuple[Array, Array, Array, Array]:  # fmt: skip
    """Shifts (k, 2), affine (k, 2, 2), weights (k or 1, p) and the last steps (k,) of Gauss-Newton."""
    k = len(wanted)
    shift, affine = np.array(start, dtype=float), np.repeat(np.eye(2)[None], k, axis=0)
    moved = np.full(k, np.inf)
    # of each pixel, the same for all patches unless some have holes
    weight = np.broadcast_to(window.weight, (1 if holes is None else k, wanted.shape[1]))
    for turn in range(iterations):
        on = np.flatnonzero(moved >= CONVERGED_PX)
        if not len(on):
            break
        if holes is not None and turn < SETTLING:
            weight = window.weight_beside(holes, shift, affine)
        here = weight if holes is None else weight[on]
        design, residual, _ = window.linearise(search[on], wanted[on], shift[on], affine[on], here)
        weighted = design * here[:, :, None]
        cofactors = np.linalg.inv(_normal(design, weighted))
        step = (cofactors @ np.einsum("kpi,kp->ki", weighted, residual)[:, :, None])[:, :, 0]
        step[:, [0, 3]] = np.clip(step[:, [0, 3]], -1.0, 1.0)
        shift[on] += step[:, [0, 3]]
        change = np.clip(step[:, [[1, 2], [4, 5]]], -0.1, 0.1)
        affine[on] = np.eye(2) + np.clip(affine[on] + change - np.eye(2), -LARGEST_SHEAR, LARGEST_SHEAR)
        moved[on] = np.abs(step[:, [0, 3]]).max(axis=1)
    return shift, affine, weight, moved


class _Window:
    """The pixels of a template of side ``t`` about its middle, and their weights."""

    def __init__(self, t: int):
        r = np.arange(t) - 0.5 * (t - 1)
        self.rows, self.columns = (a.ravel() for a in np.meshgrid(r, r, indexing="ij"))
        self.weight = np.exp(-0.5 * (self.rows**2 + self.columns**2) / (WEIGHT_SHARE * t) ** 2)
        self.shape = np.stack([np.ones_like(self.rows), self.rows, self.columns])

    def places(self, search: NDArray[Any], shift: Array, affine: Array) -> tuple[Array, Array]:
        """Rows and columns (k, p) of search patches on which the pixels fall."""
        middle = 0.5 * (search.shape[1] - 1)
        y = middle + shift[:, :1] + affine[:, 0, :1] * self.rows + affine[:, 0, 1:] * self.columns
        return y, middle + shift[:, 1:] + affine[:, 1, :1] * self.rows + affine[:, 1, 1:] * self.columns

    def weight_beside(self, holes: tuple[Mask, Mask], shift: Array, affine: Array) -> Array:
        """Weights (k, p) without what falls on holes of templates (k, t, t) or of search patches (k, s, s)."""
        covered = holes_at(holes[1], *self.places(holes[1], shift, affine)) > MOST_HOLE
        return np.where(covered | holes[0].reshape(len(shift), -1), 0.0, self.weight)

    def linearise(
        self, search: NDArray[np.floating], wanted: Array, shift: Array, affine: Array, weight: Array
    ) -> tuple[Array, Array, Array]:
        """Design (k, p, 8), residuals (k, p) and grey values that were found (k, p)."""
        y, x = self.places(search, shift, affine)
        before, rows, after = (between(at, search.shape[1]) for at in (y - 0.5, y, y + 0.5))
        left, columns, right = (between(at, search.shape[2]) for at in (x - 0.5, x, x + 0.5))
        found = interpolate_between(search, rows, columns).astype(float)
        gy = interpolate_between(search, after, columns).astype(float) - interpolate_between(search, before, columns)
        gx = interpolate_between(search, rows, right).astype(float) - interpolate_between(search, rows, left)
        # gain and offset of the grey values, so that the residual is one of the search image
        gain, offset = _grey_fit(found, wanted, weight)
        residual = (wanted - offset) / gain - found
        spread = np.maximum(found.std(axis=1), 1.0)[:, None]
        design = np.empty((*found.shape, 8))
        design[:, :, 0:3] = gy[:, :, None] * self.shape.T
        design[:, :, 3:6] = gx[:, :, None] * self.shape.T
        design[:, :, 6] = (found - found.mean(axis=1, keepdims=True)) / spread
        design[:, :, 7] = 1.0
        return design, residual, found


def _normal(design: Array, weighted: Array) -> Array:
    """Normal equations (k, 8, 8), kept regular."""
    normal = np.swapaxes(design, 1, 2) @ weighted
    return normal + 1e-6 * np.einsum("kii->ki", normal)[:, :, None] * np.eye(8) + 1e-9 * np.eye(8)


def _shift_covariance(design: Array, weight: Array, left: Array, t: int) -> Array:
    """Covariance (k, 2, 2) of the shifts from the residuals (k, p): noise, and everything the model does not know.

    Gradients are taken from a noisy image: what noise adds to their squares is taken off the normal equations, else
    strong noise would look like strong texture. Noise is nearly white, but what else two images do not have in common
    (tree crowns, waves, relief) is alike over several pixels and moves the result more. Sums of what residuals do to
    the shift over boxes show it (a long-run variance with triangular weights); it counts where it is more than white
    noise makes of the same residuals.
    """
    k = len(left)
    total = np.maximum(weight.sum(axis=1), LEAST_WEIGHT)
    square = np.sum(weight * left**2, axis=1) / np.maximum(total - 8 * np.sum(weight**2, axis=1) / total, LEAST_WEIGHT)
    normal = _normal(design, design * weight[:, :, None])
    cofactors = np.linalg.inv(normal - _gradient_noise(weight, left, square, t))
    gain = (cofactors[:, [0, 3]] @ np.swapaxes(design, 1, 2)) * weight[:, None]  # (k, 2, p)
    white = square[:, None, None] / SMOOTHED * (gain @ np.swapaxes(gain, 1, 2))
    moves = (gain * left[:, None]).reshape(k, 2, t, t)
    padded = np.zeros((k, 2, t + 2 * BOX, t + 2 * BOX))
    padded[:, :, BOX : BOX + t, BOX : BOX + t] = moves
    sums = (BOX * uniform_filter(padded, BOX, mode="constant", axes=(2, 3))).reshape(k, 2, -1)
    alike = sums @ np.swapaxes(sums, 1, 2)
    more = np.einsum("kii->k", alike) / np.maximum(np.einsum("kii->k", white), 1e-12)
    covariance = white * np.maximum(SHORTFALL * more, 1.0)[:, None, None]
    # less texture than noise: nothing was measured
    lost = ~(np.diagonal(cofactors, axis1=1, axis2=2)[:, :6] > 0).all(axis=1)
    covariance[lost] = np.inf
    return covariance


def _gradient_noise(weight: Array, left: Array, square: Array, t: int) -> Array:
    """What noise adds to normal equations (k, 8, 8) through the gradients of the searched image, from the residuals.

    Half of a residual's variance is the searched image's. The gradients of the residuals are taken as those of the
    image are: bicubic values half a pixel to either side. Their median counts: at sharp edges residuals are no noise.
    Where too few lie beside holes, they are as large as the variance of the residuals (``square``) makes them.
    """
    k = len(left)
    whole = len(weight) == 1
    grid = (left if whole else np.where(weight > 0.0, left, np.nan)).reshape(k, t, t)
    shape = _Window(t).shape
    blocks = (shape * weight[:, None]) @ shape.T
    out = np.zeros((k, 8, 8))
    for at, values in ((0, grid), (3, np.swapaxes(grid, 1, 2))):
        g = np.abs(sum(tap * values[:, i : i + t - 4] for i, tap in enumerate(GRADIENT_TAPS))).reshape(k, -1)
        if whole:
            variance = 0.5 * (1.4826 * np.median(g, axis=1)) ** 2
        else:
            number = np.isfinite(g).sum(axis=1)
            median = np.sort(g, axis=1)[np.arange(k), np.maximum(number - 1, 0) // 2]  # those of holes come last
            few = 2.0 * np.sum(GRADIENT_TAPS**2) * square
            variance = 0.5 * np.where(number < FEWEST_GRADIENTS, few, (1.4826 * median) ** 2)
        out[:, at : at + 3, at : at + 3] = variance[:, None, None] * blocks
    return out


def _grey_fit(found: Array, wanted: Array, weight: Array) -> tuple[Array, Array]:
    """Gain and offset (k, 1) that turn found grey values (k, p) into the wanted ones best, equal to both images."""
    total = np.maximum(weight.sum(axis=1, keepdims=True), LEAST_WEIGHT)
    mf, mw = _sum(found, weight) / total, _sum(wanted, weight) / total
    sf = np.sqrt(_sum((found - mf) ** 2, weight))
    sw = np.sqrt(_sum((wanted - mw) ** 2, weight))
    gain = np.maximum(sw, 1e-3) / np.maximum(sf, 1e-3)
    return gain, mw - gain * mf


def _score(found: Array, wanted: Array, weight: Array) -> Array:
    total = np.maximum(weight.sum(axis=1, keepdims=True), LEAST_WEIGHT)
    f, w = found - _sum(found, weight) / total, wanted - _sum(wanted, weight) / total
    fw, ff, ww = (_sum(a, weight)[:, 0] for a in (f * w, f * f, w * w))
    return fw / np.sqrt(np.maximum(ff, 1e-6) * np.maximum(ww, 1e-6))


def _sum(values: Array, weight: Array) -> Array:
    """Weighted sums (k, 1) of values (k, p); weights are (k, p), or (1, p) for all."""
    return (values @ weight[0])[:, None] if len(weight) == 1 else np.einsum("kp,kp->k", values, weight)[:, None]
