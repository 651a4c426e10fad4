"""Sensitivity over a whole scene: error ellipses on a grid of pixels, and the parameter that dominates each."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .inputs import Function, Normal
from .propagation import propagate

Array = NDArray[np.floating]


@dataclass(frozen=True)
class SceneMap:
    """Covariance propagated to the ground at pixels of a grid of r rows and c columns; d parameters.

    Attributes
    ----------
    columns, rows : (c,), (r,) of the image
    covariance : (r, c, 2, 2) of east and north, square metres; NaN where a pixel sees no ground
    share : (r, c, d) of each parameter in the variance of east and north together; adds up to 1
    names : of the parameters
    """

    columns: Array
    rows: Array
    covariance: Array
    share: Array
    names: tuple[str, ...]

    @property
    def sigma(self) -> Array:
        """(r, c) planimetric sigma, m: the root of the summed variances of east and north."""
        return np.sqrt(np.trace(self.covariance, axis1=2, axis2=3))

    @property
    def dominating(self) -> NDArray[np.int64]:
        """(r, c) number of the parameter with the largest share; -1 where a pixel sees no ground."""
        seen = np.isfinite(self.share).all(axis=2)
        return np.where(seen, np.argmax(np.nan_to_num(self.share), axis=2), -1)

    @property
    def ellipses(self) -> tuple[Array, Array, Array]:
        """Semi-axes of the error ellipses (r, c), m, the larger first, and the azimuth of the larger, radians
        clockwise from north in (-pi/2, pi/2]."""
        seen = self.dominating >= 0
        values, vectors = np.linalg.eigh(np.where(seen[..., None, None], self.covariance, 0.0))
        axes = np.where(seen[..., None], np.sqrt(np.maximum(values, 0.0)), np.nan)
        east, north = vectors[..., 0, 1], vectors[..., 1, 1]
        azimuth = np.arctan2(east, north)
        azimuth = np.where(
            azimuth > np.pi / 2, azimuth - np.pi, np.where(azimuth <= -np.pi / 2, azimuth + np.pi, azimuth)
        )
        return axes[..., 1], axes[..., 0], np.where(seen, azimuth, np.nan)


def scene_map(
    pixel: Callable[[float, float], Function], inputs: Normal, columns: ArrayLike, rows: ArrayLike
) -> SceneMap:
    """Propagate the covariance of the parameters to the ground at every pixel of a grid.

    Parameters
    ----------
    pixel : column and row to the function of that pixel, whose first two results are east and north; a pixel that it
        refuses by ValueError sees no ground
    inputs : normal, independent
    columns, rows : (c,), (r,)

    Raises
    ------
    ValueError : no parameter that scatters
    """
    if not inputs.sigma.any():
        raise ValueError("no parameter has a sigma above 0")
    u, v = np.asarray(columns, dtype=float), np.asarray(rows, dtype=float)
    covariance = np.full((len(v), len(u), 2, 2), np.nan)
    share = np.full((len(v), len(u), len(inputs.names)), np.nan)
    for i, row in enumerate(v):
        for j, column in enumerate(u):
            try:
                found = propagate(pixel(float(column), float(row)), inputs.mean, inputs.sigma**2)
            except ValueError:
                continue
            covariance[i, j] = found.covariance[:2, :2]
            moved = np.sum((found.jacobian[:2] * inputs.sigma) ** 2, axis=0)
            share[i, j] = moved / moved.sum()
    return SceneMap(u, v, covariance, share, inputs.names)
