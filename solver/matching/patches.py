"""Grey values between pixels: image stretches, their reduced levels, and patches out of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating]
Float32 = NDArray[np.floating]


@dataclass(frozen=True)
class Picture:
    """Lines of one CCD as an image, perhaps reduced.

    Attributes
    ----------
    first_line : number of its first full-size line
    values : (n, m) grey values
    usable : (n,) rows that may be used
    factor : full-size pixels to one of these, along and across
    """

    first_line: int
    values: Float32
    usable: NDArray[np.bool_]
    factor: int = 1

    def reduced(self, factor: int) -> Picture:
        """The picture with blocks of ``factor`` x ``factor`` pixels put together."""
        if factor == 1:
            return self
        n, m = (size // factor * factor for size in self.values.shape)
        values = self.values[:n, :m].reshape(n // factor, factor, m // factor, factor).mean(axis=(1, 3))
        usable = self.usable[:n].reshape(-1, factor).min(axis=1)
        return Picture(self.first_line, values.astype(np.float32), usable, factor * self.factor)

    def sample(self, line: Array, sample: Array, cubic: bool) -> tuple[Float32, NDArray[np.bool_]]:
        """Grey values at lines and samples (...), full-size pixels; and which of them are known."""
        off = 0.5 * (self.factor - 1)
        u = (line - self.first_line - off) / self.factor
        v = (sample - off) / self.factor
        return interpolate(self.values, self.usable, u, v, cubic)


def interpolate(
    values: Float32, usable: NDArray[np.bool_], u: Array, v: Array, cubic: bool
) -> tuple[Float32, NDArray[np.bool_]]:
    """Bicubic (Keys) or bilinear values of an image (n, m) at rows and columns (...); False where some are missing."""
    before, taps = (1, 4) if cubic else (0, 2)
    i, j = np.floor(u), np.floor(v)
    a, b = (u - i).astype(np.float32), (v - j).astype(np.float32)
    n, m = values.shape
    known = (i >= before) & (i + taps - before <= n) & (j >= before) & (j + taps - before <= m)
    i = np.clip(i, before, max(n - taps + before, before)).astype(np.int64) - before
    j = np.clip(j, before, max(m - taps + before, before)).astype(np.int64) - before
    if n < taps or m < taps:
        return np.zeros(u.shape, dtype=np.float32), np.zeros(u.shape, dtype=bool)
    through = np.concatenate([[0], np.cumsum(~usable)])
    known &= through[i + taps] == through[i]
    flat, at = values.ravel(), i * m + j
    wu, wv = (_cubic(a), _cubic(b)) if cubic else ((1 - a, a), (1 - b, b))
    total = np.zeros(u.shape, dtype=np.float32)
    for k in range(taps):
        row = wv[0] * flat[at + k * m]
        for l in range(1, taps):
            row += wv[l] * flat[at + k * m + l]
        total += wu[k] * row
    return total, known


def interpolate_stack(stack: Float32, y: Array, x: Array) -> Float32:
    """Bicubic values of patches (k, n, m) at rows and columns (k, ...), each in its own; beyond the border its edge."""
    k, n, m = stack.shape
    y, x = np.clip(y, 1.0, n - 2.001), np.clip(x, 1.0, m - 2.001)
    i, j = y.astype(np.int64), x.astype(np.int64)
    wu, wv = _cubic((y - i).astype(np.float32)), _cubic((x - j).astype(np.float32))
    flat = stack.ravel()
    at = (np.arange(k) * n * m).reshape((k,) + (1,) * (y.ndim - 1)) + (i - 1) * m + (j - 1)
    total = np.zeros(y.shape, dtype=np.float32)
    for a in range(4):
        row = wv[0] * flat[at + a * m]
        for b in range(1, 4):
            row += wv[b] * flat[at + a * m + b]
        total += wu[a] * row
    return total


def _cubic(s: Float32) -> tuple[Float32, Float32, Float32, Float32]:
    s2, s3 = s * s, s * s * s
    half = np.float32(0.5)
    return (half * (2 * s2 - s3 - s), half * (3 * s3 - 5 * s2 + 2), half * (4 * s2 - 3 * s3 + s), half * (s3 - s2))
