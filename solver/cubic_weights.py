"""Cubic interpolation between pixels."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Float32 = NDArray[np.floating]


def cubic_weights(s: Float32) -> tuple[Float32, Float32, Float32, Float32]:
    """Weights of the four pixels around a place, ``s`` behind the second one (0 to 1): Keys' kernel with a = -1/2."""
    s2 = s * s
    s3 = s2 * s
    half = np.float32(0.5)
    return (half * (2 * s2 - s3 - s), half * (3 * s3 - 5 * s2 + 2), half * (4 * s2 - 3 * s3 + s), half * (s3 - s2))
