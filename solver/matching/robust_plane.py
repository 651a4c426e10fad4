"""A plane through values of which some are wrong."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating]


def robust_plane(
    design: Array, values: Array, least_scale: float, rounds: int, slope_weight: float = 0.0
) -> tuple[Array, float]:
    """Coefficients (3,) of a plane and the robust standard deviation of the values (n,) about it, by weights anew.

    Parameters
    ----------
    design : (n, 3) of the level and two slopes
    least_scale : the standard deviation is not taken to be smaller
    slope_weight : of slopes of zero, for each value: slopes stay small where the values do not decide them
    """
    damping = np.diag([0.0, slope_weight, slope_weight]) * len(values)
    fit, scale = np.array([np.median(values), 0.0, 0.0]), least_scale
    for _ in range(rounds):
        left = values - design @ fit
        scale = max(1.4826 * float(np.median(np.abs(left))), least_scale)
        w = 1.0 / (1.0 + (left / (2.0 * scale)) ** 2) ** 2
        N = design.T @ (design * w[:, None]) + damping + 1e-9 * np.eye(3)
        fit = np.linalg.solve(N, design.T @ (w * values))
    return fit, scale
