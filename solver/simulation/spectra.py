"""Band-limited random motion: what turbulence does to an aircraft's position and to its attitude."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.fft import irfft, next_fast_len

Array = NDArray[np.floating]


def band_limited_noise(
    rng: np.random.Generator, n: int, step_s: float, sigma: ArrayLike, corner_hz: float, cutoff_hz: float
) -> Array:
    """Gaussian noise with spectrum ``1 / (1 + (f / corner)^2)^2``, nothing beyond ``cutoff_hz``.

    Parameters
    ----------
    n : samples
    step_s : time between them
    sigma : (k,) standard deviation of each column
    corner_hz, cutoff_hz : where the spectrum begins to fall, and where it ends (cosine taper over the upper half)

    Returns
    -------
    (n, k)
    """
    sigma = np.atleast_1d(np.asarray(sigma, dtype=float))
    # long enough for the slowest part, and so that the end knows nothing of the beginning
    length = int(next_fast_len(max(2 * n, int(40.0 / corner_hz / step_s)), real=True) or 0)
    f = np.fft.rfftfreq(length, step_s)
    f = f[f < cutoff_hz]
    taper = 0.5 * (1.0 + np.cos(np.pi * np.clip(2.0 * f / cutoff_hz - 1.0, 0.0, 1.0)))
    amplitude = taper / (1.0 + (f / corner_hz) ** 2)
    amplitude[0] = 0.0
    amplitude *= length / np.sqrt(2.0 * 2.0 * np.sum(amplitude**2))
    draws = rng.standard_normal((2, len(f), len(sigma)))
    spectrum = amplitude[:, None] * (draws[0] + 1j * draws[1]) * sigma
    return np.asarray(irfft(spectrum, n=length, axis=0))[:n]
