"""Elevation models of known ground: with noise, a shift, and points that stand above it as on trees."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.ndimage import gaussian_filter

from triline.solver.adjustment.surface_control import SurfaceControl
from triline.solver.orthoimage.surface import HeightField
from triline.solver.simulation.scenario import Simulation

STEP_M, SIGMA_M, SHIFT_M = 15.0, 0.3, 0.3


def noisy_surface(
    ground: Callable[[np.ndarray, np.ndarray], np.ndarray],
    xyz: np.ndarray,
    rng: np.random.Generator,
    shift_m: float | None = None,
    trees: np.ndarray | None = None,
    shift_sigma_m: float = SHIFT_M,
    alike_m: float = 0.0,
) -> SurfaceControl:
    """Ground around points (n, 3), sampled with noise and shifted: by what is drawn from its sigma, or as given.

    ``trees`` are places of points that stand 15 m above it. Noise is correlated over ``alike_m``, by 1/e there.
    """
    low, high = xyz[:, :2].min(axis=0) - 200.0, xyz[:, :2].max(axis=0) + 200.0
    x, y = (np.arange(a, b, STEP_M) for a, b in zip(low, high, strict=True))
    z = ground(*np.meshgrid(x, y))
    shift = rng.normal(0.0, shift_sigma_m) if shift_m is None else shift_m
    # bilinear interpolation leaves 4/9 of the variance of the samples on average; what is stated is that of a point
    noise = rng.normal(0.0, 1.5 * SIGMA_M, z.shape)
    if alike_m:
        noise = gaussian_filter(noise, 0.5 * alike_m / STEP_M)
        noise *= SIGMA_M / noise.std()
    z = z + noise + shift
    for i in () if trees is None else trees:
        u, v = ((xyz[i, :2] - [x[0], y[0]]) // STEP_M).astype(int)
        z[v - 1 : v + 3, u - 1 : u + 3] -= 15.0
    field = HeightField(x[0], y[0], STEP_M, z)
    return SurfaceControl(field.height, STEP_M, SIGMA_M, shift_sigma_m)


def surface_below(simulation: Simulation, seed: int, **more) -> SurfaceControl:
    """The same below a simulated flight."""
    return noisy_surface(simulation.flight.terrain.height, simulation.points.xyz_l, np.random.default_rng(seed), **more)
