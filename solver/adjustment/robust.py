"""Weight functions of robust estimation: factor on a ray's weight from its normalised residual.

They can be sent to other processes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from ..arrays import Array


class WeightFunction(Protocol):
    """Factors in [0, 1] (n,) for lengths of normalised residuals (n,)."""

    def __call__(self, w: Array) -> Array: ...


@dataclass(frozen=True)
class Huber:
    """``k / w`` beyond k."""

    k: float = 2.5

    def __call__(self, w: Array) -> Array:
        return np.where(w <= self.k, 1.0, self.k / np.maximum(w, self.k))


@dataclass(frozen=True)
class Danish:
    """``exp(1 - (w / k)^2)`` beyond k."""

    k: float = 3.0

    def __call__(self, w: Array) -> Array:
        return np.where(w <= self.k, 1.0, np.exp(1.0 - np.minimum(w / self.k, 20.0) ** 2))


@dataclass(frozen=True)
class Igg3:
    """IGG III: 1 up to k0, falling to 0 at k1, 0 beyond.

    Raises
    ------
    ValueError : k0 and k1 that are not positive and rising
    """

    k0: float = 3.0
    k1: float = 6.0

    def __post_init__(self) -> None:
        if not 0 < self.k0 < self.k1:
            raise ValueError(f"IGG III wants 0 < k0 < k1, got {self.k0} and {self.k1}")

    def __call__(self, w: Array) -> Array:
        k0, k1 = self.k0, self.k1
        falling = k0 / np.maximum(w, k0) * ((k1 - np.minimum(w, k1)) / (k1 - k0)) ** 2
        return np.where(w <= k0, 1.0, falling)


#: By the name the command line uses.
WEIGHT_FUNCTIONS: dict[str, Callable[[], WeightFunction]] = {"huber": Huber, "danish": Danish, "igg3": Igg3}
