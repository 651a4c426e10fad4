"""Weight functions of robust estimation: factor on a ray's weight from its normalised residual."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import numpy as np

from ..arrays import Array


class WeightFunction(Protocol):
    """Factors in [0, 1] (n,) for lengths of normalised residuals (n,)."""

    def __call__(self, w: Array) -> Array: ...


def huber(k: float = 2.0) -> WeightFunction:
    """``k / w`` beyond k."""

    def weight(w: Array) -> Array:
        return np.where(w <= k, 1.0, k / np.maximum(w, k))

    return weight


def danish(k: float = 2.0) -> WeightFunction:
    """``exp(1 - (w / k)^2)`` beyond k."""

    def weight(w: Array) -> Array:
        return np.where(w <= k, 1.0, np.exp(1.0 - np.minimum(w / k, 20.0) ** 2))

    return weight


def igg3(k0: float = 1.5, k1: float = 4.0) -> WeightFunction:
    """IGG III: 1 up to k0, falling to 0 at k1, 0 beyond."""
    if not 0 < k0 < k1:
        raise ValueError(f"IGG III wants 0 < k0 < k1, got {k0} and {k1}")

    def weight(w: Array) -> Array:
        falling = k0 / np.maximum(w, k0) * ((k1 - np.minimum(w, k1)) / (k1 - k0)) ** 2
        return np.where(w <= k0, 1.0, falling)

    return weight


#: By the name the command line uses.
WEIGHT_FUNCTIONS: dict[str, Callable[[], WeightFunction]] = {"huber": huber, "danish": danish, "igg3": igg3}
