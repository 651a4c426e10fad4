"""A location model with an affine correction in the image, estimated from control points.

``line = model_line + a0 + a1 x + a2 y`` and ``sample = model_sample + b0 + b1 x + b2 y`` with ``x, y`` the model's line
and sample from the middle of the points, in units of their half extent (Fraser and Hanley 2003; Grodecki and Dial
2003). Errors of orbit and attitude of a satellite are nearly such a correction.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..quantiles import norm
from .in_image import in_image

Array = NDArray[np.floating]

#: Step of the numerical derivative by a ground coordinate, metres. Derived: models are linear over it to 1e-9 pixels.
_STEP_M = 1.0
#: Points nearer to a line than this, pixels and as a share of its length, do not tell what is beside it. Derived: a
#: tenth of a pixel of theirs would be many pixels across the image.
_NARROW_PX, _NARROW = 1.0, 1e-3
#: A correction that moves pixels by more than this share of their distance is told. Tuned: no metadata of an image are
#: as wrong; a heading that is five degrees off is not told yet.
LARGE_TURN = 0.1
#: Two-sided level of the test of one point, the usual one of data snooping.
SNOOPING_LEVEL = 0.001


class LocationPair(Protocol):
    """Any model with direct and inverse location."""

    @property
    def lines(self) -> int:
        """Of the image; 0 where unknown."""
        ...

    @property
    def samples(self) -> int:
        """Of a line; 0 where unknown."""
        ...

    def direct(self, line: ArrayLike, sample: ArrayLike, height_m: ArrayLike) -> Array:
        """Latitude, longitude (radians) and height, (n, 3)."""
        ...

    def inverse(self, lat: ArrayLike, lon: ArrayLike, height_m: ArrayLike, margin_px: float = ...) -> Array:
        """Line and sample, (n, 2)."""
        ...


@dataclass(frozen=True)
class AffineBias:
    """An affine correction.

    Attributes
    ----------
    coefficients : (2, 3) of line and sample: constant, along line, along sample; pixels
    covariance : (6, 6) of the coefficients, row by row
    middle, half : (2,) where the constant holds, and the extent in which the others are told; line and sample
    """

    coefficients: Array
    covariance: Array
    middle: Array
    half: Array

    def at(self, pixel: Array) -> Array:
        """Corrections (n, 2) at the model's lines and samples (n, 2)."""
        return self._terms(pixel) @ self.coefficients.T

    def _terms(self, pixel: Array) -> Array:
        return np.concatenate([np.ones((len(pixel), 1)), (pixel - self.middle) / self.half], axis=1)

    @property
    def turn(self) -> Array:
        """(2, 2) from differences of the model's lines and samples to corrected ones; the identity for a shift."""
        return np.eye(2) + self.coefficients[:, 1:] / self.half

    @property
    def turned(self) -> float:
        """By which share of their distance two pixels are moved against each other at most."""
        return float(np.linalg.norm(self.turn - np.eye(2), 2))

    def without(self, pixel: Array) -> Array:
        """The model's lines and samples (n, 2) of corrected ones (n, 2)."""
        shift = self.coefficients[:, 0] - self.coefficients[:, 1:] @ (self.middle / self.half)
        return np.linalg.solve(self.turn, (pixel - shift).T).T


@dataclass(frozen=True)
class CorrectedModel:
    """A location model with its correction: the same pair of functions."""

    model: LocationPair
    bias: AffineBias

    @property
    def lines(self) -> int:
        return self.model.lines

    @property
    def samples(self) -> int:
        return self.model.samples

    def inverse(self, lat: ArrayLike, lon: ArrayLike, height_m: ArrayLike, margin_px: float | None = None) -> Array:
        """Line and sample, (n, 2), of latitudes and longitudes (radians) at heights.

        Parameters
        ----------
        margin_px : points further outside the image become NaN; None for what the model does by itself
        """
        if margin_px is None:
            pixel = self.model.inverse(lat, lon, height_m)
            return pixel + self.bias.at(pixel)
        corners = np.array([(u, v) for u in (0.0, self.lines - 1.0) for v in (0.0, self.samples - 1.0)])
        reach = float(np.abs(self.bias.at(corners)).max()) + 1.0
        pixel = self.model.inverse(lat, lon, height_m, margin_px + 2.0 * reach)
        pixel = pixel + self.bias.at(pixel)
        if self.lines and self.samples:
            pixel[~in_image(pixel, self.lines, self.samples, margin_px)] = np.nan
        return pixel

    def direct(self, line: ArrayLike, sample: ArrayLike, height_m: ArrayLike) -> Array:
        """Latitude, longitude (radians) and height, (n, 3), of pixels (n,)."""
        line, sample = np.broadcast_arrays(*np.atleast_1d(line, sample))
        pixel = self.bias.without(np.stack([line, sample], axis=1).astype(float))
        return self.model.direct(pixel[:, 0], pixel[:, 1], height_m)


@dataclass(frozen=True)
class BiasFit:
    """Result of `fit_bias`.

    Attributes
    ----------
    bias : the correction
    residual_px : (n, 2) measured minus corrected model, line and sample, of all points
    w : (n, 2) normalised residuals of the points that take part; of those rejected, as they were when rejected
    rejected : (n,) points that data snooping left out
    sigma0 : 1 where all sigmas are right
    redundancy : equations less coefficients
    """

    bias: AffineBias
    residual_px: Array
    w: Array
    rejected: NDArray[np.bool_]
    sigma0: float
    redundancy: int


def fit_bias(
    model: LocationPair,
    lat: ArrayLike,
    lon: ArrayLike,
    height_m: ArrayLike,
    line: ArrayLike,
    sample: ArrayLike,
    sigma_px: ArrayLike = 0.5,
    sigma_ground_m: ArrayLike = (0.0, 0.0, 0.0),
    *,
    affine: bool = True,
    snoop: bool = True,
    stated: bool = True,
) -> BiasFit:
    """Estimate the correction of a model from control points.

    Parameters
    ----------
    lat, lon, height_m : (n,) of the points, radians and metres
    line, sample : (n,) as measured
    sigma_px : (n,) or one, of the measurements
    sigma_ground_m : (n, 3) or (3,) east, north, up, of the points
    affine : False for a shift alone
    snoop : leave out points whose normalised residuals are too large, the largest first
    stated : whether the sigmas are known; else points are as much worse as the middle one of their residuals tells

    Raises
    ------
    ValueError : fewer points than coefficients want, or points that the model does not see; points on a line, which
        determine no affine correction; points that see the image as in a mirror
    """
    lat, lon, h, u, v = (np.array(np.broadcast_to(a, np.shape(lat)), dtype=float).ravel()
                         for a in (lat, lon, height_m, line, sample))  # fmt: skip
    n, terms = len(lat), 3 if affine else 1
    if n < terms:
        raise ValueError(f"{n} control points, wanted at least {terms}")
    pixel = model.inverse(lat, lon, h)
    if np.isnan(pixel).any():
        raise ValueError(
            f"control point {int(np.argmax(np.isnan(pixel).any(axis=1)))} is not in the image of the model"
        )
    low, high = pixel.min(axis=0), pixel.max(axis=0)
    middle, half = 0.5 * (low + high), np.where(high > low, 0.5 * (high - low), 1.0)
    covariance = _covariances(model, lat, lon, h, pixel, sigma_px, sigma_ground_m)
    T = np.concatenate([np.ones((n, 1)), (pixel - middle) / half], axis=1)[:, :terms]
    A = np.zeros((n, 2, 2 * terms))
    A[:, 0, :terms], A[:, 1, terms:] = T, T
    y = np.stack([u, v], axis=1) - pixel
    weight = np.linalg.inv(covariance)
    used, w = np.ones(n, dtype=bool), np.zeros((n, 2))
    limit = float(norm.ppf(1.0 - SNOOPING_LEVEL / 2.0))
    while True:
        if affine and _on_a_line(pixel[used]):
            raise ValueError(
                "its points lie on a line, which does not determine an affine correction; wanted others beside it, or "
                "a shift alone"
            )
        N = np.einsum("nki,nkl,nlj->ij", A[used], weight[used], A[used])
        Q = np.linalg.pinv(N, hermitian=True)
        x = Q @ np.einsum("nki,nkl,nl->i", A[used], weight[used], y[used])
        residual = y - A @ x
        Qv = covariance - A @ Q @ np.swapaxes(A, -1, -2)
        with np.errstate(divide="ignore", invalid="ignore"):
            test = np.einsum("nkl,nl->nk", weight, residual)
            spread = np.sqrt(np.einsum("nkl,nlm,nmk->nk", weight, Qv, weight))
            now = np.where(spread > 1e-6 * np.sqrt(np.einsum("nkk->nk", weight)), test / spread, 0.0)
        w[used] = now[used]
        worst = int(np.argmax(np.where(used, np.abs(now).max(axis=1), -1.0)))
        scale = 1.0 if stated else max(float(np.median(np.abs(now[used])) / norm.ppf(0.75)), 1.0)
        if not snoop or np.abs(now[worst]).max() <= limit * scale or used.sum() - 1 <= terms:
            break
        used[worst] = False
    redundancy = 2 * (int(used.sum()) - terms)
    square = float(np.einsum("nk,nkl,nl->", residual[used], weight[used], residual[used]))
    keep = np.array([k for row in (0, 3) for k in range(row, row + terms)])
    coefficients, full = np.zeros(6), np.zeros((6, 6))
    coefficients[keep], full[np.ix_(keep, keep)] = x, Q
    sigma0 = float(np.sqrt(square / redundancy)) if redundancy else float("nan")
    bias = AffineBias(coefficients.reshape(2, 3), full, middle, half)
    if np.linalg.det(bias.turn) <= 0.0:
        mirror = "its points see the image as in a mirror"
        raise ValueError(f"{mirror}: wanted rows counted from above, columns from the left")
    return BiasFit(bias, residual, w, ~used, sigma0, redundancy)


def _on_a_line(pixel: Array) -> bool:
    """Whether pixels (n, 2) lie on a line, or in one place."""
    long, wide = np.linalg.svd(pixel - pixel.mean(axis=0), compute_uv=False) / np.sqrt(len(pixel))
    return bool(wide < max(_NARROW_PX, _NARROW * long))


def _covariances(
    model: LocationPair, lat: Array, lon: Array, h: Array, pixel: Array, sigma_px: ArrayLike, sigma_ground_m: ArrayLike
) -> Array:
    """Covariance (n, 2, 2) of measured minus modelled lines and samples."""
    n = len(lat)
    spread = np.broadcast_to(np.asarray(sigma_px, dtype=float).reshape(-1, 1), (n, 2)) ** 2
    covariance = np.zeros((n, 2, 2))
    covariance[:, 0, 0], covariance[:, 1, 1] = spread.T
    ground = np.broadcast_to(np.asarray(sigma_ground_m, dtype=float), (n, 3))
    if ground.any():
        radius = 6.371e6  # of the Earth, for a derivative
        steps = ((0.0, _STEP_M / radius / np.cos(lat), 0.0), (_STEP_M / radius, 0.0, 0.0), (0.0, 0.0, _STEP_M))
        for axis, (dlat, dlon, dh) in enumerate(steps):
            slope = (model.inverse(lat + dlat, lon + dlon, h + dh) - pixel) / _STEP_M
            slope = np.where(np.isfinite(slope), slope, 0.0) * ground[:, axis : axis + 1]
            covariance += slope[:, :, None] * slope[:, None, :]
    return covariance
