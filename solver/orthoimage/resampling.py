"""Grey values of an image between its pixels, for long lists of places."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..cubic_weights import cubic_weights

Float32 = NDArray[np.floating]
Mask = NDArray[np.bool_]

#: Method -> pixels before the place, and pixels in all, each way.
TAPS: dict[str, tuple[int, int]] = {"nearest": (0, 1), "bilinear": (0, 2), "cubic": (1, 4)}


def resample(
    image: NDArray[np.unsignedinteger], usable: Mask | None, line: Float32, sample: Float32, method: str
) -> tuple[Float32, Mask]:
    """Values at lines and samples (n,) of an image (lines, samples), and whether all pixels they need are there.

    Parameters
    ----------
    usable : (lines,) which lines may be used, None for all
    line, sample : rows and columns; not finite where there is no place
    method : of `TAPS`; cubic is Keys' kernel (a = -1/2)

    Raises
    ------
    ValueError : an unknown method
    """
    if method not in TAPS:
        raise ValueError(f"resampling {method!r}, wanted one of {', '.join(TAPS)}")
    before, taps = TAPS[method]
    rows, columns = image.shape
    n = line.shape
    if rows < taps or columns < taps:
        return np.zeros(n, dtype=np.float32), np.zeros(n, dtype=bool)
    if method == "nearest":
        line, sample = line + np.float32(0.5), sample + np.float32(0.5)
    i, j = np.floor(line), np.floor(sample)
    a, b = line - i, sample - j
    i -= before
    j -= before
    known = (i >= 0) & (i <= rows - taps) & (j >= 0) & (j <= columns - taps)
    if not known.all():
        lost = ~known
        i[lost] = j[lost] = a[lost] = b[lost] = 0
    row = i.astype(np.intp)
    if usable is not None and not usable.all():
        bad = np.concatenate([[0], np.cumsum(~usable)])
        known &= (bad[taps:] == bad[:-taps])[row]
    flat = np.ravel(image)
    at = row * columns
    at += j.astype(np.intp)
    if method == "nearest":
        return flat.take(at).astype(np.float32), known
    if method == "bilinear":
        low = _linear(flat, at, b)
        at += columns
        return low + a * (_linear(flat, at, b) - low), known
    weights = cubic_weights(b)
    total = np.zeros(n, dtype=np.float32)
    for weight in cubic_weights(a):
        across = weights[0] * flat.take(at)
        for k in range(1, 4):
            across += weights[k] * flat.take(at + k)
        total += weight * across
        at += columns
    return total, known


def _linear(flat: NDArray[np.unsignedinteger], at: NDArray[np.intp], b: Float32) -> Float32:
    left = flat.take(at).astype(np.float32)
    right = flat.take(at + 1).astype(np.float32)
    right -= left
    right *= b
    right += left
    return right
