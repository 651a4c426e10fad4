"""A location model of an image that was cut out of a scene."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .in_image import in_image

Array = NDArray[np.floating]


@dataclass(frozen=True)
class CroppedModel:
    """The model of a scene for an image whose first pixel is at ``line``, ``sample`` of the scene.

    Attributes
    ----------
    model : of the scene, with ``direct`` and ``inverse``
    line, sample : of the scene, at the centre of the first pixel
    lines, samples : size of the image
    """

    model: Any
    line: float
    sample: float
    lines: int
    samples: int

    def direct(self, line: ArrayLike, sample: ArrayLike, height_m: ArrayLike) -> Array:
        """Latitude, longitude (radians) and height, (n, 3), of pixels (n,)."""
        return self.model.direct(np.asarray(line) + self.line, np.asarray(sample) + self.sample, height_m)

    def inverse(self, lat: ArrayLike, lon: ArrayLike, height_m: ArrayLike, margin_px: float | None = None) -> Array:
        """Line and sample, (n, 2); NaN further than ``margin_px`` outside the image (None: no limit of its own)."""
        if margin_px is None:
            return self.model.inverse(lat, lon, height_m) - [self.line, self.sample]
        pixel = self.model.inverse(lat, lon, height_m, margin_px) - [self.line, self.sample]
        pixel[~in_image(pixel, self.lines, self.samples, margin_px)] = np.nan
        return pixel
