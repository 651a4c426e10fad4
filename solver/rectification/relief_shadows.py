"""Which cells of the orthoimage of a strip lie behind higher ground, as its lines look."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..orthoimage.ground_grid import GroundGrid
from ..orthoimage.surface import HeightField
from .occlusion import CLEAR_M, KNOT_CELLS, clearance

Array = NDArray[np.floating]


@dataclass(frozen=True)
class ReliefShadows:
    """What a relief hides, as `solver.orthoimage.strip.Shadows`; rays are straight near the ground.

    Attributes
    ----------
    relief : heights in the local frame
    """

    relief: HeightField

    @property
    def knot_m(self) -> float:
        """How far places may be apart whose room tells that of those between, metres."""
        return KNOT_CELLS * self.relief.step_m

    def room(self, grid: GroundGrid, column: Array, row: Array, slope: Array) -> NDArray[np.float32]:
        """See `Shadows.room`; NaN slopes, and places without a height, are not hidden."""
        field = self.relief
        x, y, z = np.moveaxis(grid.on_relief(column, row, field), -1, 0)
        known = np.isfinite(z) & np.isfinite(slope).all(axis=-1)
        if not known.any():
            return np.full(column.shape, CLEAR_M, dtype=np.float32)
        at_row, at_column = (y - field.y_m) / field.step_m, (x - field.x_m) / field.step_m
        along = np.where(known[..., None], slope[..., ::-1] / np.float32(field.step_m), np.float32(0.0))
        # the window of heights that rays may pass below the highest ground
        rise = field.range_m[2] - z[known]
        ends = [(at[known], at[known] + rise * along[known][:, k]) for k, at in enumerate((at_row, at_column))]
        window = []
        for size, both in zip(field.z_m.shape, ends, strict=True):
            first = np.clip(np.floor(np.min(both)) - 1, 0, size - 2)
            window.append(slice(int(first), int(np.clip(np.ceil(np.max(both)) + 2, first + 2, size))))
        top, left = (part.start for part in window)
        values = field.z_m[tuple(window)].astype(np.float32)
        h = np.where(known, z, np.nan)
        return clearance(values, np.zeros_like(h), at_row - top, at_column - left, h, along) + np.float32(CLEAR_M)
