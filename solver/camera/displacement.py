"""Where looks fall with other additional parameters, along the CCD lines of a camera."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..arrays import Array, IntArray
from .line_camera import LineCamera
from .self_calibration import SelfCalibration

#: Places along each CCD line that are looked at.
PLACES = 21


class Displacement(NamedTuple):
    """By how much looks are off at a place of the camera.

    Attributes
    ----------
    off_px, sigma_px : size, and its standard deviation
    ccd, sample : CCD line and pixel
    """

    off_px: float
    sigma_px: float
    ccd: str
    sample: int

    def __str__(self) -> str:
        return f"{self.off_px:.1f} +- {self.sigma_px:.1f} px at {self.ccd} {self.sample}"


def displacements(
    parameters: SelfCalibration, ccd: IntArray, sample: Array, xy_mm: Array, focal_length_mm: Array
) -> Array:
    """Displacement (2, n, m) in mm of looks (n,) by one unit of each of the m estimated parameters."""
    design = parameters.design(ccd, sample, xy_mm, focal_length_mm)
    coefficients, columns, n = design.coefficients(), design.columns[design.pattern], len(ccd)
    raw = np.zeros((2, n, parameters.n_unknowns + 1))  # the last one takes what a CCD line does not have
    for slot in range(columns.shape[1]):
        raw[:, np.arange(n), columns[:, slot]] += coefficients[:, slot]
    return raw[:, :, :-1]


def most_certain(camera: LineCamera, parameters: SelfCalibration, value: Array, Q: Array) -> Displacement:
    """The displacement that is most of its sigma, by parameters (m,) with cofactors (m, m)."""
    best = Displacement(0.0, 1.0, camera.lines[0].id, 0)
    for i, line in enumerate(camera.lines):
        sample, ccd = np.round(np.linspace(0.0, line.pixels - 1.0, PLACES)), np.full(PLACES, i)
        xy_mm, pitch = camera.image_coordinates(ccd, sample)
        pitch_mm = np.linalg.norm(pitch, axis=1)
        moved = displacements(parameters, ccd, sample, xy_mm, camera.focal_length_mm[ccd])
        off = np.hypot(*(moved @ value)) / pitch_mm
        sigma = np.sqrt(np.einsum("cnm,mk,cnk->n", moved, Q, moved)) / pitch_mm
        at = int(np.argmax(off / np.maximum(sigma, 1e-300)))
        if off[at] * best.sigma_px > best.off_px * sigma[at]:
            best = Displacement(float(off[at]), float(sigma[at]), line.id, int(sample[at]))
    return best
