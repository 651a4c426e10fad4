"""What an error of the orientation does on the ground, and how much of it is too much: the alert limit.

Errors of a projection centre and of its attitude go together: a shift along the track and the pitch that takes it back
on the ground cannot be told apart by rays that look down, and need not be. What counts is object space. Straight below
the camera, at the height h of flight above ground, with small tilt,

    X = X0 - h phi,   Y = Y0 + h omega,   Z = Z0,

and a turn kappa moves the ends of the swath along the track by half its width times kappa.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ...arrays import Array
from ...camera.line_camera import LineCamera
from ..state.batch import Batch

#: Functions of the orientation on the ground, in words: X, Y, Z below the camera, and the ends of the swath.
WHERE = ("position in X", "position in Y", "height", "ends of the swath")
#: The alert limit unless it is given: so many ground sample distances, and no more than this share of the height of
#: flight where pixels are coarse (docs/accuracy.md says why).
LIMIT_GSD, LIMIT_SHARE = 25.0, 0.0025
#: The height of flight is another one if it differs by this share; batches that are asked for it.
OTHER, ASKED = 0.15, 16


@dataclass(frozen=True)
class Ground:
    """The ground below a strip.

    Attributes
    ----------
    height_m : of flight above it
    gsd_m : ground sample distance
    half_swath_m : half the width of what the camera sees
    """

    height_m: float
    gsd_m: float
    half_swath_m: float

    @cached_property
    def functions(self) -> Array:
        """(4, 6) derivatives of the errors on the ground, m, see `WHERE`, with respect to X0, Y0, Z0 and the angles."""
        G = np.zeros((4, 6))
        G[[0, 1, 2], [0, 1, 2]] = 1.0
        G[0, 4], G[1, 3], G[3, 5] = -self.height_m, self.height_m, self.half_swath_m
        return G

    def sigma_m(self, covariance: Array) -> Array:
        """Sigmas (..., 4) on the ground of orientation with covariance (..., 6, 6)."""
        G = self.functions
        return np.sqrt(np.maximum(np.einsum("gi,...ij,gj->...g", G, covariance, G), 0.0))

    @property
    def limit_m(self) -> float:
        """The alert limit where none is given."""
        return min(LIMIT_GSD * self.gsd_m, LIMIT_SHARE * self.height_m)


class GroundBelow:
    """Keeps the ground below the camera as the points of the window say, and does not follow each of its hills."""

    def __init__(self, camera: LineCamera) -> None:
        line = camera.nadir_line
        self._focal_mm = float(camera.focal_length_mm[camera.line_index[line.id]])
        self._pitch_mm = float(np.median(np.linalg.norm(np.diff(line.xy_mm[:2], axis=0), axis=1)))
        self._half_mm = 0.5 * float(np.ptp(line.xy_mm[:, 1]))
        self.ground: Ground | None = None

    def look(self, batches: Sequence[Batch]) -> Ground | None:
        """The ground below the newest batches of the window; None as long as there never were any."""
        above = [np.abs(b.rays.position_l[:, 2] - b.points_l[b.rays.point, 2]) for b in batches[-ASKED:]]
        if above:
            height = float(np.median(np.concatenate(above)))
            if self.ground is None or abs(height - self.ground.height_m) > OTHER * self.ground.height_m:
                scale = height / self._focal_mm
                self.ground = Ground(height, scale * self._pitch_mm, scale * self._half_mm)
        return self.ground
