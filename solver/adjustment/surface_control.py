"""Heights of a known surface as control: tie points lie on a digital elevation model, within a stated sigma."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from .job import BatchResult, Job, Progress, run
from .network import Control, Network

Array = NDArray[np.floating]

#: Adjustments with the surface at most; and change of a point, in sigmas of the surface, from which there is another.
ROUNDS, STILL = 6, 0.05
#: Distance from the surface, in sigmas, at which a height counts half (Cauchy's weight function). Tuned: heights with
#: normal errors lose a tenth of their weight; trees and houses, which no elevation model has, nearly all of it.
HALF_WEIGHT = 2.5


@dataclass(frozen=True)
class SurfaceFit:
    """What came of the heights of a surface; p points of the network.

    Attributes
    ----------
    sigma_m : as stated
    difference_m : (p,) adjusted height minus surface; NaN where the surface gave none
    weight : (p,) 0..1 that it counted with
    rounds : adjustments with it
    """

    sigma_m: float
    difference_m: Array
    weight: Array
    rounds: int


def run_with_surface(
    network: Network,
    job: Job,
    height: Callable[[Array, Array], Array],
    sigma_m: float,
    progress: Progress | None = None,
) -> tuple[BatchResult, SurfaceFit]:
    """Adjust with the height of a surface below every point that has no given coordinates.

    The surface is read where a point lies; as the point moves it is read again. Heights that stay far off lose their
    weight (iteratively, from an adjustment in which all heights count alike).

    Parameters
    ----------
    height : Z of the surface at X, Y (n,), NaN where it has none; local frame, metres
    sigma_m : of the surface at a point, 1 sigma

    Raises
    ------
    ValueError : a sigma that is not positive, a surface that has no height below any point
    NotAdjustableError : see `job.run`
    """
    if not 0 < sigma_m < np.inf:
        raise ValueError(f"sigma of heights {sigma_m:g} m, wanted more than 0")
    free = np.ones(network.n_points, dtype=bool)
    free[network.control.point] = free[network.check.point] = False
    points = run(network, replace(job, snoop=False), progress).adjusted_points()
    weight = np.ones(network.n_points)
    difference = np.full(network.n_points, np.nan)
    result, rounds = None, 0
    used, z = np.empty(0, dtype=np.int64), difference
    for rounds in range(1, ROUNDS + 1):
        z = np.full(network.n_points, np.nan)
        placed = free & np.isfinite(points).all(axis=1)
        z[placed] = height(points[placed, 0], points[placed, 1])
        used = np.flatnonzero(np.isfinite(z))
        if not len(used):
            raise ValueError("the surface has no height below any tie point")
        if rounds > 1:
            difference = points[:, 2] - z
            weight = 1.0 / (1.0 + np.square(np.nan_to_num(difference) / (HALF_WEIGHT * sigma_m)))
        given = np.full((len(used), 3), np.inf)
        given[:, 2] = sigma_m / np.sqrt(weight[used])
        xyz = np.column_stack([points[used, :2], z[used]])
        joined = Control(
            np.concatenate([network.control.point, used]),
            np.concatenate([network.control.xyz_l, xyz]),
            np.concatenate([network.control.sigma_m, given]),
        )
        result = run(replace(network, control=joined), job, progress)
        before, points = points, result.adjusted_points()
        moved = np.abs(points[used] - before[used])
        if rounds > 2 and np.nanmax(moved) < STILL * sigma_m:
            break
    assert result is not None
    known = np.zeros(network.n_points, dtype=bool)
    known[used] = True
    difference = np.where(known, points[:, 2] - z, np.nan)
    return result, SurfaceFit(sigma_m, difference, np.where(known, weight, 0.0), rounds)
