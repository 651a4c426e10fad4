"""Normalised cross-correlation of many small patches at once."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfft2, next_fast_len, rfft2

Array = NDArray[np.floating]


def correlate(template: NDArray[np.floating], search: NDArray[np.floating]) -> NDArray[np.floating]:
    """Correlation coefficients of templates (k, t, t) at all places in search patches (k, s, s): (k, s-t+1, s-t+1).

    Raises
    ------
    ValueError : templates larger than what they are searched in
    """
    k, t, _ = template.shape
    s = search.shape[1]
    if s < t or len(search) != k:
        raise ValueError(f"templates {template.shape} and search patches {search.shape} do not go together")
    size = next_fast_len(s, real=True)
    zero_mean = template - template.mean(axis=(1, 2), keepdims=True)
    energy = np.sum(zero_mean**2, axis=(1, 2))
    level = search - search.mean(axis=(1, 2), keepdims=True)
    spectra = (np.asarray(rfft2(a, (size, size))) for a in (level, zero_mean))
    product = np.asarray(irfft2(np.multiply(next(spectra), np.conj(next(spectra))), (size, size)))
    places = s - t + 1
    product = product[:, :places, :places]
    sums, squares = _box_sums(level, t), _box_sums(level * level, t)
    variance = np.maximum(squares - sums**2 / (t * t), 1e-6 * squares + 1e-3)
    return (product / np.sqrt(np.maximum(energy, 1e-3)[:, None, None] * variance)).astype(np.float32)


def best_place(score: NDArray[np.floating]) -> tuple[NDArray[np.int64], NDArray[np.int64], Array]:
    """Row and column of the largest score of each (k, n, n), and that score."""
    k, _, m = score.shape
    flat = score.reshape(k, -1)
    best = flat.argmax(axis=1)
    return best // m, best % m, flat[np.arange(k), best]


def _box_sums(values: NDArray[np.floating], t: int) -> Array:
    """Sums over t x t boxes of (k, s, s)."""
    total = np.zeros((len(values), values.shape[1] + 1, values.shape[2] + 1))
    np.cumsum(np.cumsum(values, axis=1, dtype=float), axis=2, out=total[:, 1:, 1:])
    return total[:, t:, t:] - total[:, :-t, t:] - total[:, t:, :-t] + total[:, :-t, :-t]
