"""How high the ground under a flight is: stated, from a height above ground, or from a raster of heights."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...solver.geometry.frames import LocalFrame
from ..errors import UserError
from .dem import dem_in_frame

Array = NDArray[np.floating]

#: A raster of heights is asked at so many places of the flight.
_PLACES = 200
#: Ground of the Earth lies between these heights above the ellipsoid, m.
LOWEST_M, HIGHEST_M = -500.0, 9000.0


@dataclass(frozen=True)
class GroundGiven:
    """What the user says about the ground; the first that is given counts.

    Attributes
    ----------
    height_m : above the ellipsoid
    dem, dem_crs : raster of heights, and its vertical datum as for `read_dem`
    above_m : so high the platform flies above the ground
    """

    height_m: float | None = None
    dem: Path | None = None
    dem_crs: str | None = None
    above_m: float | None = None

    @property
    def stated(self) -> bool:
        """Whether anything is given."""
        return not (self.height_m is None and self.dem is None and self.above_m is None)

    def height(self, path: Path, geodetic: Array, notes: list[str]) -> float:
        """Height of the ground above the ellipsoid under positions (n, 3; degrees and m); 0 where nobody says.

        Raises
        ------
        UserError : a raster that cannot be read or lies elsewhere, no position to ask at
        """
        if self.height_m is not None:
            return self.height_m
        if not self.stated:
            return 0.0
        if not len(geodetic):
            raise UserError(f"{path}: no positions to tell the ground's height from, wanted --ground-height")
        if self.dem is not None:
            height = self._of_raster(self.dem, geodetic)
            said = f"median height of {self.dem.name} under the flight"
        else:
            assert self.above_m is not None
            height = float(np.median(geodetic[:, 2])) - self.above_m
            said = f"median height of the flight less {self.above_m:g} m"
        notes.append(f"{said}: the ground is taken to be {height:.1f} m above the ellipsoid")
        return round(height, 1)

    def _of_raster(self, dem: Path, geodetic: Array) -> float:
        some = geodetic[np.linspace(0, len(geodetic) - 1, min(len(geodetic), _PLACES)).astype(int)]
        frame = LocalFrame(float(some[0, 0]), float(some[0, 1]), 0.0)
        field = dem_in_frame(dem, frame, self.dem_crs)
        place = frame.from_geodetic(*some.T)
        place[:, 2] = float(np.nanmax(field.z_m)) + 1000.0
        point, met = field.meet(place, np.broadcast_to([0.0, 0.0, -1.0], place.shape))
        if not met.any():
            raise UserError(f"{dem}: has no height under the flight, wanted a raster of the same area")
        return float(np.median(frame.to_geodetic(point[met])[:, 2]))


NOT_GIVEN = GroundGiven()
