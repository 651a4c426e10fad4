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
    disagreement : by how much the looks that came last disagree more than all sigmas allow, 1 where they do not: a
        test of single looks is that much wider as long as it is not known which sigma is wrong
    """

    apriori: Array = field(default_factory=lambda: np.ones(len(ERROR_GROUPS)))
    image: float = 1.0
    version: int = 0
    disagreement: float = 1.0
