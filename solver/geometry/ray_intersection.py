"""Forward intersection: object points from rays with known orientation."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating]


def intersect_rays(
    position_l: Array, direction_l: Array, point: NDArray[np.int64], n_points: int
) -> tuple[Array, NDArray[np.bool_]]:
    """Points nearest to their rays, linear: the sum of squared distances to the rays is least.

    Parameters
    ----------
    position_l, direction_l : (n, 3) perspective centre and direction of each ray, any length
    point : (n,) index of each ray's point
    n_points : how many points there are

    Returns
    -------
    xyz_l : (n_points, 3) metres; NaN where it is not known
    known : (n_points,) whether the rays of a point meet: two at least, not parallel (0.1 mrad)
    """
    d = direction_l / np.linalg.norm(direction_l, axis=1, keepdims=True)
    origin = position_l.mean(axis=0) if len(position_l) else np.zeros(3)
    x = position_l - origin
    along = np.einsum("ni,ni->n", d, x)
    sums = [np.bincount(point, minlength=n_points).astype(float)]
    pairs = [(0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)]
    sums += [np.bincount(point, d[:, i] * d[:, j], n_points) for i, j in pairs]
    sums += [np.bincount(point, x[:, i] - along * d[:, i], n_points) for i in range(3)]
    A = np.empty((n_points, 3, 3))
    for (i, j), s in zip(pairs, sums[1:7], strict=True):
        A[:, i, j] = A[:, j, i] = (sums[0] if i == j else 0.0) - s
    smallest = np.linalg.eigvalsh(A)[:, 0]
    known = (sums[0] >= 2) & (smallest > 1e-8)
    xyz = np.full((n_points, 3), np.nan)
    b = np.stack(sums[7:], axis=1)
    xyz[known] = np.linalg.solve(A[known], b[known][:, :, None])[:, :, 0] + origin
    return xyz, known
