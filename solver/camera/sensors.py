"""Cameras: lines from parameters with a lens's distortion, and the named presets."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .line_camera import CcdLine, Lens, LineCamera, straight_line, three_line_camera

Array = NDArray[np.float64]


def brown_distortion(xy_mm: ArrayLike, k1: float, k2: float, k3: float, p1: float, p2: float) -> Array:
    """Brown's radial and decentring distortion (..., 2) in mm at image points (..., 2) reduced to the principal point.

    The terms and signs are those of the self-calibration set [K 4.43]; k in mm^-2, mm^-4, mm^-6, p in mm^-1.
    """
    xy = np.asarray(xy_mm, dtype=float)
    x, y = xy[..., 0], xy[..., 1]
    r2 = x * x + y * y
    radial = r2 * (k1 + r2 * (k2 + r2 * k3))
    dx = x * radial + (r2 + 2 * x * x) * p1 + 2 * x * y * p2
    dy = y * radial + (r2 + 2 * y * y) * p2 + 2 * x * y * p1
    return np.stack([dx, dy], axis=-1)


def line_from_parameters(
    id: str,
    lens: Lens,
    pixels: int,
    pixel_size_mm: float,
    centre_mm: tuple[float, float],
    inclination_rad: float = 0.0,
    chips: tuple[int, ...] = (),
) -> CcdLine:
    """The look-up table of a straight line behind a lens: nominal pixel centres plus the lens's distortion.

    The distortion is what calibration adds to a nominal place, ``(x, y) + D(x - xp, y - yp)``, like ``dr`` in [K 4.3].
    Additional parameters of a self-calibration stand on the computed side of the equations: to take them over into the
    distortion of a lens, turn their sign.
    """
    line = straight_line(id, lens.id, pixels, pixel_size_mm, centre_mm, inclination_rad, chips=chips)
    if not lens.distortion:
        return line
    reduced = line.xy_mm - np.asarray(lens.principal_point_mm)
    return replace(line, xy_mm=line.xy_mm + brown_distortion(reduced, *lens.distortion))


def multi_lens_camera(
    name: str, focal_length_mm: float, pixels: dict[str, int], pixel_size_mm: float, chips: tuple[int, ...] = ()
) -> LineCamera:
    """One line in the middle of each of several lenses; lenses and lines have the same ids.

    The lenses look separately: where each looks is part of its own orientation (see `lens_rotation`), not of its line.
    """
    lenses = {id: Lens(id, focal_length_mm) for id in pixels}
    lines = (line_from_parameters(id, lenses[id], n, pixel_size_mm, (0.0, 0.0), 0.0, chips) for id, n in pixels.items())
    return LineCamera(name, tuple(lenses.values()), tuple(lines))


def lens_rotation(view_deg: float) -> Array:
    """Image frame of a lens that looks ``view_deg`` forward to the image frame of the platform, (3, 3)."""
    phi = -np.radians(view_deg)
    s, c = np.sin(phi), np.cos(phi)
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])


def _with_overlap(chips: int, pixels: int, overlap: int) -> tuple[int, tuple[int, ...]]:
    """Samples of a line of chips, and the first sample of each."""
    step = pixels - overlap
    return step * (chips - 1) + pixels, tuple(step * i for i in range(chips))


def _prism() -> LineCamera:
    # up to 4 of the 6 (nadir) or 8 chips make an image of 35 km swath
    samples, chips = _with_overlap(4, 4992, 32)
    return multi_lens_camera("alos-prism", 1939.0, dict.fromkeys(("F", "N", "B"), samples), 0.007, chips)


#: Airborne scanners with one lens: camera constant, pixels, pixel size, viewing angles.
#: ADS40 of Pavia: the seed gives 28.4 (F/N), 42.6 (F/B) and again 28.4 (N/B), but 42.6 - 28.4 leaves 14.2 for the last.
_ONE_LENS: dict[str, tuple[float, int, float, dict[str, float]]] = {
    "ads40": (62.7, 12000, 0.0065, {"F": 26.0, "N": 0.0, "B": -16.0}),
    "ads40-small": (62.7, 1200, 0.065, {"F": 26.0, "N": 0.0, "B": -16.0}),
    # the inner half of the field in pixels four times as large: 200 lines a second from 1690 m at 140 m/s
    "ads40-inner": (62.7, 1500, 0.026, {"F": 26.0, "N": 0.0, "B": -16.0}),
    "ads40-pavia": (62.77, 12000, 0.0065, {"F": 28.4, "N": 0.0, "B": -14.2}),
    "si-100": (60.0, 10200, 0.007, {"F": 21.0, "N": 0.0, "B": -21.0}),
    "si-290": (93.0, 14400, 0.005, {"F": 15.0, "N": 0.0, "B": -23.0}),
}

#: Satellite sensors with a telescope a line, and where each telescope looks (degrees forward).
_MANY_LENSES: dict[str, tuple[LineCamera, dict[str, float]]] = {
    "alos-prism": (_prism(), {"F": 23.8, "N": 0.0, "B": -23.8}),
    "spot5-hrs": (multi_lens_camera("spot5-hrs", 580.0, {"F": 12000, "B": 12000}, 0.0065), {"F": 20.0, "B": -20.0}),
    "aster-vnir": (multi_lens_camera("aster-vnir", 329.0, {"3N": 4100, "3B": 5000}, 0.007), {"3N": 0.0, "3B": -27.6}),
}

#: Names of all presets.
PRESETS: tuple[str, ...] = (*_ONE_LENS, *_MANY_LENSES)


def preset(name: str) -> LineCamera:
    """A camera by name; one of `PRESETS`.

    Raises
    ------
    ValueError : a name that is not known; the message lists those that are
    """
    if name in _ONE_LENS:
        return three_line_camera(name, *_ONE_LENS[name])
    if name in _MANY_LENSES:
        return _MANY_LENSES[name][0]
    raise ValueError(f"unknown camera preset {name!r}; known: {', '.join(PRESETS)}")


def with_pixels(camera: LineCamera, pixels: int) -> LineCamera:
    """The same camera with lines of so many pixels over the same field.

    Raises
    ------
    ValueError : fewer than 16 pixels, or a camera whose lines are made of chips
    """
    if pixels < 16:
        raise ValueError(f"lines of {pixels} pixels, wanted at least 16")
    lines = []
    for line in camera.lines:
        if line.chips:
            raise ValueError(f"CCD line {line.id!r} is made of chips: its pixels cannot be put together")
        centre = (np.arange(pixels) + 0.5) * line.pixels / pixels - 0.5
        lines.append(replace(line, xy_mm=line.image_coordinates(centre)[0]))
    return replace(camera, name=f"{camera.name}-{pixels}", lines=tuple(lines))


def lens_views_deg(name: str) -> dict[str, float]:
    """Where each lens of a preset looks, degrees forward of the platform's nadir; 0 for cameras with one lens.

    Raises
    ------
    ValueError : a name that is not known
    """
    camera = preset(name)
    return dict(_MANY_LENSES[name][1]) if name in _MANY_LENSES else {lens.id: 0.0 for lens in camera.lenses}
