"""Grey values between pixels: windows of image lines about many places at once, reduced levels, patches out of them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter, uniform_filter

from ..cubic_weights import cubic_weights

Array = NDArray[np.floating]
Float32 = NDArray[np.floating]
Mask = NDArray[np.bool_]
#: The first of the pixels that a value comes from (k, ...), and their weights.
Between = tuple[NDArray[np.int64], tuple[Float32, ...]]

#: A value counts as measured if no more of it comes from pixels that were not: a bicubic value has less of them.
MOST_HOLE = 0.1
#: NumPy adds so many values in a row, and more, in another order than one after the other. Definition.
SUMMED_IN_PAIRS = 8
#: Saturated and dead pixels get the mean of those within so many pixels.
MENDED_PX = 2


@dataclass(frozen=True)
class Windows:
    """Pieces of one CCD's lines about k places, perhaps reduced.

    Attributes
    ----------
    first_line, first_sample : (k,) full-size pixel that each begins with
    values : (k, n, m) grey values
    lines_known, samples_known : (k, n), (k, m) which lines and samples are there and fit for use
    lines_filled : (k, n) which lines are known only from those around them
    factor : full-size pixels to one of these, along and across
    """

    first_line: NDArray[np.int64]
    first_sample: NDArray[np.int64]
    values: Float32
    lines_known: Mask
    samples_known: Mask
    lines_filled: Mask
    factor: int = 1

    def reduced(self, factor: int) -> Windows:
        """The same with blocks of ``factor`` x ``factor`` pixels put together."""
        if factor == 1:
            return self
        k = len(self.values)
        n, m = (size // factor * factor for size in self.values.shape[1:])
        values = _means(self.values[:, :n, :m], factor)
        lines = self.lines_known[:, :n].reshape(k, -1, factor).min(axis=2)
        samples = self.samples_known[:, :m].reshape(k, -1, factor).min(axis=2)
        filled = self.lines_filled[:, :n].reshape(k, -1, factor).max(axis=2)
        return Windows(self.first_line, self.first_sample, values, lines, samples, filled, factor * self.factor)

    def mended(self, saturated: float) -> tuple[Windows, Mask | None]:
        """The same with the mean of their neighbours for saturated pixels (from a grey value on) and those that are 0.

        Also what was not measured (k, n, m): these, with those beside them, which share their values once they are
        interpolated, and lines that lie between others; None for no such pixel.
        """
        bad = (self.values >= saturated) | (self.values <= 0.0)
        some = np.flatnonzero((bad & self.lines_known[:, :, None] & self.samples_known[:, None]).any(axis=(1, 2)))
        if not len(some):
            if not self.lines_filled.any():
                return self, None
            return self, np.broadcast_to(self.lines_filled[:, :, None], self.values.shape)
        good, values = np.where(bad[some], np.float32(0.0), np.float32(1.0)), self.values.copy()
        side = 2 * MENDED_PX + 1
        number, total = (uniform_filter(a, side, mode="nearest", axes=(1, 2)) for a in (good, good * values[some]))
        inside = bad[some] & (number > 1e-3)
        values[some] = np.where(inside, total / np.maximum(number, np.float32(1e-3)), values[some])
        holes = np.zeros(bad.shape, dtype=bool)
        holes[some] = maximum_filter(bad[some], 3, axes=(1, 2))
        return replace(self, values=values), holes | self.lines_filled[:, :, None]

    def sample(self, line: Array, sample: Array, cubic: bool) -> tuple[Float32, Mask]:
        """Bicubic (Keys) or bilinear grey values at full-size lines and samples (k, ...), and which are known."""
        k, n, m = self.values.shape
        u, v = self._inside(line, sample)
        before, taps = (1, 4) if cubic else (0, 2)
        if n < taps or m < taps:
            return np.zeros(u.shape, dtype=np.float32), np.zeros(u.shape, dtype=bool)
        i, j = np.floor(u), np.floor(v)
        a, b = (u - i).astype(np.float32), (v - j).astype(np.float32)
        known = (i >= before) & (i + taps - before <= n) & (j >= before) & (j + taps - before <= m)
        i = np.clip(i, before, n - taps + before).astype(np.int64) - before
        j = np.clip(j, before, m - taps + before).astype(np.int64) - before
        for at, there in ((i, self.lines_known), (j, self.samples_known)):
            if not there.all():
                gaps = np.concatenate([np.zeros((k, 1), np.int64), np.cumsum(~there, axis=1)], axis=1)
                flat = at.reshape(k, -1)
                none = np.take_along_axis(gaps, flat + taps, axis=1) == np.take_along_axis(gaps, flat, axis=1)
                known &= none.reshape(known.shape)
        weights = (cubic_weights(a), cubic_weights(b)) if cubic else ((1 - a, a), (1 - b, b))
        total = _weighted(self.values, i, j, *weights)
        return total, known

    def touched(self, holes: Mask, line: Array, sample: Array) -> Mask:
        """Which grey values at lines and samples (k, ...) come from holes (k, n, m) to a part that counts."""
        return holes_at(holes, *self._inside(line, sample)) > MOST_HOLE

    def _inside(self, line: Array, sample: Array) -> tuple[Array, Array]:
        """Rows and columns of full-size lines and samples (k, ...)."""
        off, wide = 0.5 * (self.factor - 1), (len(self.values),) + (1,) * (line.ndim - 1)
        u = (line - self.first_line.reshape(wide) - off) / self.factor
        return u, (sample - self.first_sample.reshape(wide) - off) / self.factor


def _means(values: Float32, factor: int) -> Float32:
    """Means of blocks of ``factor`` x ``factor`` of (k, n, m).

    For small blocks in the order in which NumPy adds them, but over all blocks at once.
    """
    k, n, m = values.shape
    if factor >= SUMMED_IN_PAIRS or values.dtype.kind != "f":
        return values.reshape(k, n // factor, factor, m // factor, factor).mean(axis=(2, 4))
    total = np.zeros((k, n // factor, m // factor), dtype=values.dtype)
    for a in range(factor):
        row = values[:, a::factor, ::factor].copy()
        for b in range(1, factor):
            row += values[:, a::factor, b::factor]
        total += row
    total /= values.dtype.type(factor * factor)
    return total


def any_of(mask: Mask, factor: int) -> Mask:
    """Whether any of each block of ``factor`` x ``factor`` of (k, n, m) is set; without what makes no whole block."""
    n, m = (size // factor * factor for size in mask.shape[1:])
    whole = mask[:, :n, :m]
    found = whole[:, ::factor, ::factor].copy()
    for a in range(factor):
        for b in range(factor):
            found |= whole[:, a::factor, b::factor]
    return found


def holes_at(holes: Mask, y: Array, x: Array) -> Float32:
    """How much of the values at rows and columns (k, ...) comes from holes (k, n, m), interpolated linearly, 0 .. 1."""
    n, m = holes.shape[1:]
    y, x = np.clip(y, 0.0, n - 1.001), np.clip(x, 0.0, m - 1.001)
    i, j = y.astype(np.int64), x.astype(np.int64)
    a, b = (y - i).astype(np.float32), (x - j).astype(np.float32)
    return _weighted(holes.astype(np.float32), i, j, (1 - a, a), (1 - b, b))


def interpolate_stack(stack: Float32, y: Array, x: Array) -> Float32:
    """Bicubic values of patches (k, n, m) at rows and columns (k, ...), each in its own; beyond the border its edge."""
    return interpolate_between(stack, between(y, stack.shape[1]), between(x, stack.shape[2]))


def between(at: Array, size: int) -> Between:
    """Where bicubic values at rows or columns (k, ...) come from, of patches with so many of them."""
    at = np.clip(at, 1.0, size - 2.001)
    i = at.astype(np.int64)
    return i - 1, cubic_weights((at - i).astype(np.float32))


def interpolate_between(stack: Float32, rows: Between, columns: Between) -> Float32:
    """Those of `interpolate_stack`, where several are wanted at the same rows or columns."""
    return _weighted(stack, rows[0], columns[0], rows[1], columns[1])


def _weighted(
    stack: Float32, i: NDArray[np.int64], j: NDArray[np.int64], wu: tuple[Float32, ...], wv: tuple[Float32, ...]
) -> Float32:
    """Sums of pixels from rows ``i`` and columns ``j`` (k, ...) of patches (k, n, m) on, with weights."""
    k, n, m = stack.shape
    flat = stack.ravel()
    at = (np.arange(k) * n * m).reshape((k,) + (1,) * (i.ndim - 1)) + i * m + j
    total = np.zeros(at.shape, dtype=np.float32)
    for a, w in enumerate(wu):
        row = wv[0] * flat[a * m :].take(at)
        for b in range(1, len(wv)):
            row += wv[b] * flat[a * m + b :].take(at)
        total += w * row
    return total
