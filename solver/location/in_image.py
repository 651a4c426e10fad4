"""Which pixels lie in an image."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def in_image(pixel: NDArray[np.floating], lines: int, samples: int, margin_px: float = 0.0) -> NDArray[np.bool_]:
    """Whether pixels (n, 2), line and sample, lie in an image or at most so far outside; not those that are NaN.

    An image reaches half a pixel beyond the centres of its outermost pixels. Of one whose size is not known (0) it is
    known where it begins.
    """
    ends = np.array([lines or np.inf, samples or np.inf]) - 0.5 + margin_px
    with np.errstate(invalid="ignore"):
        return np.asarray(((pixel >= -0.5 - margin_px) & (pixel <= ends)).all(axis=1))
