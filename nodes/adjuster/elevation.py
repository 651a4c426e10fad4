"""The elevation model that tie points lie on, as the settings of the adjuster name it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from ...solver.adjustment.surface_control import SurfaceControl
from ...solver.geometry.frames import LocalFrame
from ..formats.dem import read_dem, surface_control


@dataclass(frozen=True)
class Elevation:
    """A raster of heights and how well it is known.

    Attributes
    ----------
    path, crs : raster; see `read_dem`
    sigma_m, shift_sigma_m : of its heights, and of the error that all of them share; see `surface_control`
    """

    path: Path
    crs: str | None
    sigma_m: float
    shift_sigma_m: float | None

    @classmethod
    def stated(cls, dem: str, crs: str, sigma_m: float, shift_sigma_m: float) -> Elevation | None:
        """As settings state it; None where they state none.

        Raises
        ------
        ValueError : a raster without sigma, a sigma without raster or below zero
        UserError : as `read_dem`
        """
        if not dem:
            if crs or sigma_m or shift_sigma_m:
                raise ValueError("dem_crs, dem_sigma_m and dem_shift_sigma_m: are of a raster of heights, wanted dem")
            return None
        if not 0 < sigma_m < float("inf"):
            raise ValueError(f"dem_sigma_m is {sigma_m:g}, wanted the sigma of the heights of {dem}, more than 0 m")
        if not 0 <= shift_sigma_m < float("inf"):
            raise ValueError(f"dem_shift_sigma_m is {shift_sigma_m:g}, wanted more than 0 m, or 0 for dem_sigma_m")
        read_dem(Path(dem), crs or None)
        return cls(Path(dem), crs or None, sigma_m, shift_sigma_m or None)

    def surface(self, frame: LocalFrame) -> SurfaceControl:
        """In a local frame.

        Raises
        ------
        UserError : a raster that lies far away
        """
        return surface_control(self.path, frame, self.crs, self.sigma_m, self.shift_sigma_m)
