"""Which of the known points of a block become control: so many, spread out over the block."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.distance import cdist


def spread_order(xy_m: ArrayLike) -> NDArray[np.int64]:
    """The order in which points (n, 2) become control: the two that are farthest apart, then always the one farthest
    from all those before it (Gonzalez 1985, farthest-point traversal).

    The first k of them are spread out for every k >= 2, and among the first k + 1; of equal points the first counts.

    Raises
    ------
    ValueError : coordinates that are not finite, no plane
    """
    xy = np.asarray(xy_m, dtype=float)
    if xy.ndim != 2 or xy.shape[1] != 2 or not np.isfinite(xy).all():
        raise ValueError(f"points: wanted finite coordinates (n, 2), got an array {xy.shape}")
    n = len(xy)
    if n < 2:
        return np.arange(n)
    distance = cdist(xy, xy)
    order = list(np.unravel_index(int(distance.argmax()), distance.shape)) if distance.any() else [0, 1]
    order = [int(p) for p in order]
    nearest = distance[order].min(axis=0)
    left = np.ones(n, dtype=bool)
    left[order] = False
    while left.any():
        chosen = int(np.where(left, nearest, -1.0).argmax())
        order.append(chosen)
        left[chosen] = False
        nearest = np.minimum(nearest, distance[chosen])
    return np.array(order, dtype=np.int64)


def spread_choice(xy_m: ArrayLike, number: int) -> NDArray[np.int64]:
    """So many of the points (n, 2) as `spread_order` takes them; a single one is that nearest the middle of all.

    Raises
    ------
    ValueError : more points than there are, and as `spread_order`
    """
    xy = np.asarray(xy_m, dtype=float)
    if not 0 <= number <= len(xy):
        raise ValueError(f"number: wanted 0 to {len(xy)}, got {number}")
    if number == 1:
        return np.array([np.linalg.norm(xy - xy.mean(axis=0), axis=1).argmin()], dtype=np.int64)
    return spread_order(xy)[:number]
