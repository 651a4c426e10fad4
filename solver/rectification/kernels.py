"""Grey values between the pixels of an image: nearest, bilinear, cubic and Lanczos, for many bands at once."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..cubic_weights import cubic_weights
from .terrain import PORTION

Float32 = NDArray[np.float32]
Mask = NDArray[np.bool_]

#: Method -> pixels before the place, and pixels in all, each way. Cubic is Keys' kernel (a = -1/2), Lanczos has a = 3.
TAPS: dict[str, tuple[int, int]] = {"nearest": (0, 1), "bilinear": (0, 2), "cubic": (1, 4), "lanczos": (2, 6)}
#: Where pixels without data leave less weight than this to the others, the nearest pixel's value is taken. Tuned.
LEAST_WEIGHT = 0.5


class Sampler:
    """Places in an image, ready for its bands.

    Parameters
    ----------
    line, sample : (n,) rows and columns of an array, single precision
    shape : of the array; every place has all its `TAPS` in it
    method : of `TAPS`

    Raises
    ------
    ValueError : an unknown method, an array that is too small
    """

    def __init__(self, line: Float32, sample: Float32, shape: tuple[int, int], method: str):
        if method not in TAPS:
            raise ValueError(f"resampling {method!r}, wanted one of {', '.join(TAPS)}")
        before, taps = TAPS[method]
        if min(shape) < taps:
            raise ValueError(f"image {shape}, wanted at least {taps} pixels each way")
        self.method, self._taps, self._columns = method, taps, shape[1]
        if method == "nearest":
            self._at = np.rint(line).astype(np.intp) * shape[1]
            self._at += np.rint(sample).astype(np.intp)
            return
        # places are above zero, so that a whole number by truncation is the floor
        i, j = line.astype(np.int32), sample.astype(np.int32)
        self._a, self._b = line - i, sample - j
        self._at = i.astype(np.intp)
        self._at *= shape[1]
        self._at += j
        self._at -= before * shape[1] + before

    def values(self, band: NDArray[np.generic]) -> NDArray[np.floating]:
        """Values (n,) of a band, an array of the shape; single precision, or double for 32-bit integers and doubles."""
        flat: NDArray[Any] = band.ravel()
        if self.method == "nearest":
            return flat.take(self._at, mode="clip")
        single = band.dtype.itemsize <= 2 or band.dtype == np.float32
        kind = np.dtype(np.float32) if single else np.dtype(np.float64)
        if self.method == "bilinear":
            columns = self._columns
            low = _linear(flat, self._at, self._b, kind)
            high = _linear(flat[columns:], self._at, self._b, kind)
            high -= low
            high *= self._a
            low += high
            return low
        kernel = cubic_weights if self.method == "cubic" else _lanczos
        across, down = kernel(self._b), kernel(self._a)
        total = np.zeros(self._at.shape, dtype=kind)
        for r, weight in enumerate(down):
            row = flat[r * self._columns :]
            part = across[0] * row.take(self._at, mode="clip")
            for k in range(1, self._taps):
                part += across[k] * row[k:].take(self._at, mode="clip")
            part *= weight
            total += part
        return total


def _in_portions(
    bands: list[NDArray[np.generic]], valid: list[Mask | None], line: Float32, sample: Float32, method: str
) -> tuple[list[NDArray[np.floating]], list[Mask | None]]:
    """`resampled`, a portion at a time."""
    good = [None if mask is None or mask.all() else mask for mask in valid]
    values: list[NDArray[Any]] = []
    known: list[Mask | None] = [None if mask is None else np.empty(len(line), dtype=bool) for mask in good]
    for k in range(0, len(line), PORTION):
        here = slice(k, min(k + PORTION, len(line)))
        part, there = resampled(bands, good, line[here], sample[here], method)
        if not values:
            values = [np.empty(len(line), dtype=value.dtype) for value in part]
        for out, value, mask, where in zip(values, part, known, there, strict=True):
            out[here] = value
            if mask is not None and where is not None:
                mask[here] = where
    return values, known


def _linear(flat: NDArray[np.generic], at: NDArray[np.intp], b: Float32, kind: np.dtype) -> NDArray[np.floating]:
    left = flat.take(at, mode="clip").astype(kind, copy=False)
    right = flat[1:].take(at, mode="clip").astype(kind, copy=False)
    right -= left
    right *= b
    right += left
    return right


def _lanczos(s: Float32) -> list[NDArray[Any]]:
    """Weights of the six pixels around a place, which add up to one."""
    weights = [np.sinc(s - k) * np.sinc((s - k) / 3.0) for k in range(-2, 4)]
    total = np.sum(weights, axis=0)
    return [(w / total).astype(np.float32, copy=False) for w in weights]


def resampled(
    bands: list[NDArray[np.generic]], valid: list[Mask | None], line: Float32, sample: Float32, method: str
) -> tuple[list[NDArray[np.floating]], list[Mask | None]]:
    """Values of several bands at places, and where they are known.

    Parameters
    ----------
    bands : arrays of one shape
    valid : which pixels of each band have a value, None for all
    line, sample : (n,) places that have all their `TAPS` in the arrays
    method : of `TAPS`

    Returns
    -------
    values, known : (n,) a band; known None for everywhere. A place is known where its nearest pixel is; pixels without
        a value take no part, and the weights of the others are scaled up
    """
    n = len(line)
    if n > PORTION:
        return _in_portions(bands, valid, line, sample, method)
    sampler = Sampler(line, sample, bands[0].shape, method)
    values: list[NDArray[np.floating]] = []
    known: list[Mask | None] = []
    nearest: Sampler | None = None
    for band, good in zip(bands, valid, strict=True):
        if good is None or good.all():
            values.append(sampler.values(band))
            known.append(None)
            continue
        nearest = nearest or Sampler(line, sample, band.shape, "nearest")
        there = nearest.values(good).astype(bool)
        close = nearest.values(band)
        if method != "nearest":
            weight = sampler.values(good.astype(np.float32))
            sums = sampler.values(np.where(good, band, np.zeros(1, dtype=band.dtype)))
            with np.errstate(divide="ignore", invalid="ignore"):
                close = np.where(weight >= LEAST_WEIGHT, sums / weight, close)
        values.append(close)
        known.append(there)
    return values, known
