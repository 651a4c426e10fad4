"""What a-priori sigmas are multiplied by, as learnt from the data; see `screening.sigma_check`."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ...models.base import ERROR_GROUPS

Array = NDArray[np.floating]


@dataclass
class SigmaFactors:
    """Factors in force.

    Attributes
    ----------
    apriori : (4,) of the slow errors, by `ERROR_GROUPS`
    image : of lines and samples
    version : how often `image` has changed
    height_doubt_m : by how much control and GNSS differ in height, which may be the focal length: then the height of
        the camera is off by that, and what is on the ground is right
    disagreement : by how much the looks that came last disagree more than all sigmas allow, 1 where they do not: a
        test of single looks is that much wider as long as it is not known which sigma is wrong
    """

    apriori: Array = field(default_factory=lambda: np.ones(len(ERROR_GROUPS)))
    image: float = 1.0
    version: int = 0
    height_doubt_m: float = 0.0
    disagreement: float = 1.0

    @property
    def doubt(self) -> Array:
        """Covariance (6, 6) of what may be wrong with the orientation and not with what is on the ground."""
        return np.diag([0.0, 0.0, self.height_doubt_m**2, 0.0, 0.0, 0.0])
