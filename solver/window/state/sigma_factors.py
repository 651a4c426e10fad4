"""What a-priori sigmas are multiplied by, as learnt from the data; see `screening.sigma_check`."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ...arrays import Array
from ...models.base import ERROR_GROUPS

#: A factor is applied if it differs by so much from the one in force, and changes by so much at most in one look.
CHANGED, MOST_UP, MOST_DOWN = 1.15, 3.0, 0.7
#: No factor becomes larger.
LARGEST = 1000.0


@dataclass
class SigmaFactors:
    """Factors in force.

    Attributes
    ----------
    apriori : (4,) of the slow errors, by `ERROR_GROUPS`
    attitude_at_most_s : correlation time that the attitude's wander has where a longer one is stated; inf where it is
        as stated
    image : of lines and samples
    version : how often `image` has changed
    disagreement : by how much the looks that came last disagree more than all sigmas allow, 1 where they do not: a
        test of single looks is that much wider as long as it is not known which sigma is wrong
    """

    apriori: Array = field(default_factory=lambda: np.ones(len(ERROR_GROUPS)))
    attitude_at_most_s: float = np.inf
    image: float = 1.0
    version: int = 0
    disagreement: float = 1.0


def changed(factor: float, ratio: float) -> float:
    """A factor that residuals ask to be multiplied by a ratio: itself, or 1, where that makes little difference."""
    new = min(max(factor * min(max(ratio, MOST_DOWN), MOST_UP), 1.0), LARGEST)
    if new < CHANGED:
        return 1.0
    return factor if max(new / factor, factor / new) < CHANGED and new > 1.0 else new
