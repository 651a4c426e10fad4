"""The relief between points whose heights are known."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .surface import HeightField

Array = NDArray[np.floating]

#: Nodes of the field along its longer side; it reaches beyond the points by this share of their extent.
NODES, BEYOND = 200, 0.25
#: A point this many times farther from its neighbours' median height than they are among themselves is left out.
OUTLIER, NEIGHBOURS = 5.0, 9


def heights_of_points(point_l: Array, spacing_m: float = 0.0) -> HeightField:
    """Heights between points (n, 3), linear over their triangles, beyond them the height of the nearest.

    Parameters
    ----------
    spacing_m : between nodes; 0 = so that there are some `NODES` a side

    Raises
    ------
    ValueError : fewer than three points, or all on a line
    """
    from scipy.interpolate import LinearNDInterpolator, NearestNDInterpolator
    from scipy.spatial import QhullError

    point_l = np.asarray(point_l, dtype=float).reshape(-1, 3)
    if len(point_l) < 3:
        raise ValueError(f"{len(point_l)} points with a height, wanted at least 3")
    point_l = point_l[_trusted(point_l)]
    low, high = point_l[:, :2].min(axis=0), point_l[:, :2].max(axis=0)
    margin = BEYOND * float((high - low).max())
    low, high = low - margin, high + margin
    step = spacing_m or float((high - low).max()) / NODES
    if not step > 0:
        raise ValueError("all points with a height lie in one place")
    nx, ny = (np.ceil((high - low) / step).astype(int) + 2).tolist()
    x, y = np.meshgrid(low[0] + step * np.arange(nx), low[1] + step * np.arange(ny))
    try:
        z = LinearNDInterpolator(point_l[:, :2], point_l[:, 2])(x, y)
    except QhullError:
        raise ValueError("all points with a height lie on a line") from None
    outside = ~np.isfinite(z)
    z[outside] = NearestNDInterpolator(point_l[:, :2], point_l[:, 2])(x[outside], y[outside])
    return HeightField(float(low[0]), float(low[1]), step, z, endless=True)


def _trusted(point_l: Array) -> NDArray[np.bool_]:
    """Points whose height is like that of the points around; all of them where there are few."""
    from scipy.spatial import KDTree

    if len(point_l) <= NEIGHBOURS:
        return np.ones(len(point_l), dtype=bool)
    around = np.asarray(KDTree(point_l[:, :2]).query(point_l[:, :2], k=NEIGHBOURS)[1])
    away = point_l[:, 2] - np.median(point_l[around[:, 1:], 2], axis=1)
    scale = 1.4826 * float(np.median(np.abs(away)))
    return np.abs(away) <= OUTLIER * max(scale, 1e-6)
