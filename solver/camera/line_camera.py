"""The line camera: lenses, CCD lines as look-up tables of calibrated pixel centres."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.floating]


@dataclass(frozen=True)
class Lens:
    """One lens; Brown's ``distortion`` k1, k2, k3, p1, p2 (mm-based) goes into lines that are built from parameters."""

    id: str
    focal_length_mm: float
    principal_point_mm: tuple[float, float] = (0.0, 0.0)
    distortion: tuple[float, ...] = ()


@dataclass(frozen=True)
class CcdLine:
    """One CCD line behind a lens: calibrated pixel centres, linear between neighbours [K 4.1].

    Attributes
    ----------
    id, lens : names
    xy_mm : (pixels, 2) image coordinates of the pixel centres, before reduction to the principal point
    chips : (m,) first sample of each chip, () for a line in one piece
    """

    id: str
    lens: str
    xy_mm: Array = field(repr=False)
    chips: tuple[int, ...] = ()

    @property
    def pixels(self) -> int:
        return len(self.xy_mm)

    def contains(self, sample: ArrayLike) -> NDArray[np.bool_]:
        """Whether samples lie on the line (half a pixel beyond the outermost centres is still on it)."""
        v = np.asarray(sample, dtype=float)
        return (v >= -0.5) & (v <= self.pixels - 0.5)

    def image_coordinates(self, sample: ArrayLike) -> tuple[Array, Array]:
        """Image coordinates (n, 2) in mm of samples (n,), and their derivative per pixel (n, 2)."""
        v = np.asarray(sample, dtype=float)
        i = np.clip(np.floor(v).astype(int), 0, self.pixels - 2)
        pitch = self.xy_mm[i + 1] - self.xy_mm[i]
        return self.xy_mm[i] + (v - i)[..., None] * pitch, pitch

    @cached_property
    def centre_mm(self) -> Array:
        """Image coordinates of the middle of the line."""
        return self.image_coordinates((self.pixels - 1) / 2.0)[0]


@dataclass(frozen=True)
class LineCamera:
    """A camera of one or more lenses and CCD lines.

    Raises
    ------
    ValueError : a line that names an unknown lens, or two lines with the same id
    """

    name: str
    lenses: tuple[Lens, ...]
    lines: tuple[CcdLine, ...]

    def __post_init__(self) -> None:
        known = {lens.id for lens in self.lenses}
        for line in self.lines:
            if line.lens not in known:
                raise ValueError(f"CCD line {line.id!r} names lens {line.lens!r}; known lenses: {sorted(known)}")
        if len(self.line_index) != len(self.lines):
            raise ValueError("two CCD lines of a camera have the same id")

    @cached_property
    def line_index(self) -> dict[str, int]:
        return {line.id: i for i, line in enumerate(self.lines)}

    @cached_property
    def nadir_line(self) -> CcdLine:
        """The line that looks down: its middle is nearest to the principal point along the track."""
        return self.lines[int(np.argmin(np.abs(self.ahead_mm)))]

    @cached_property
    def ahead_mm(self) -> Array:
        """(lines,) how far the middle of each line is from the principal point along the track: at right angles to the
        lines, which run along y or, where the image axes are mounted a quarter of a turn off, along x."""
        way = np.abs([line.xy_mm[-1] - line.xy_mm[0] for line in self.lines]).sum(axis=0)
        axis = int(way[0] > way[1])
        return np.array([line.centre_mm[axis] for line in self.lines]) - self.principal_point_mm[:, axis]

    @cached_property
    def lens_of_line(self) -> NDArray[np.int_]:
        """(lines,) index of the lens behind each line."""
        index = {lens.id: i for i, lens in enumerate(self.lenses)}
        return np.array([index[line.lens] for line in self.lines], dtype=int)

    @cached_property
    def focal_length_mm(self) -> Array:
        """(lines,) camera constant of the lens behind each line."""
        return np.array([self.lenses[i].focal_length_mm for i in self.lens_of_line])

    @cached_property
    def principal_point_mm(self) -> Array:
        """(lines, 2) principal point of the lens behind each line."""
        return np.array([self.lenses[i].principal_point_mm for i in self.lens_of_line], dtype=float)

    def image_coordinates(self, line: NDArray[np.int_], sample: ArrayLike) -> tuple[Array, Array]:
        """Image coordinates reduced to the principal point, (n, 2) mm, and derivative per pixel (n, 2).

        Parameters
        ----------
        line : (n,) index of the CCD line
        sample : (n,) pixels
        """
        line = np.asarray(line)
        v = np.asarray(sample, dtype=float)
        xy_mm, first, last = self._pixels
        i = np.minimum(np.maximum(np.floor(v).astype(int), 0), last[line])
        of_pixel = first[line] + i
        begin = xy_mm[of_pixel]
        pitch = xy_mm[of_pixel + 1] - begin
        return begin + (v - i)[:, None] * pitch - self.principal_point_mm[line], pitch

    def turned(self, quarters: int) -> LineCamera:
        """The camera turned about z by so many quarters of a turn, from x to y; itself for none."""
        if quarters % 4 == 0:
            return self
        R = quarter_turn(quarters)[:2, :2]
        lenses = []
        for lens in self.lenses:
            x, y = (R @ lens.principal_point_mm).tolist()
            lenses.append(Lens(lens.id, lens.focal_length_mm, (x, y)))
        lines = tuple(CcdLine(line.id, line.lens, line.xy_mm @ R.T, line.chips) for line in self.lines)
        return LineCamera(self.name, tuple(lenses), lines)

    @cached_property
    def _pixels(self) -> tuple[Array, NDArray[np.int_], NDArray[np.int_]]:
        """Pixel centres of all lines one after the other (k, 2), where each line begins there, and the last pixel but
        one of each (lines,)."""
        count = np.array([line.pixels for line in self.lines], dtype=int)
        return np.concatenate([line.xy_mm for line in self.lines]), np.cumsum(count) - count, count - 2


def quarter_turn(quarters: int) -> Array:
    """Rotation (3, 3) about z by so many quarters of a turn, from x to y; its numbers are whole."""
    cosine, sine = ((1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0))[quarters % 4]
    return np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])


def finest_pixel(camera: LineCamera) -> float:
    """Angle of the smallest pixel of a camera, radians."""
    sizes = [
        float(np.linalg.norm(np.diff(line.xy_mm, axis=0), axis=1).min(initial=np.inf)) / focal
        for line, focal in zip(camera.lines, camera.focal_length_mm.tolist(), strict=True)
    ]
    return min(sizes)


def straight_line(
    id: str,
    lens: str,
    pixels: int,
    pixel_size_mm: float,
    centre_mm: tuple[float, float],
    inclination_rad: float = 0.0,
    radial: tuple[float, float, float] = (0.0, 0.0, 0.0),
    chips: tuple[int, ...] = (),
) -> CcdLine:
    """A CCD line from parameters [K 4.2, 4.3]: straight, turned by ``inclination``, then radially distorted.

    ``radial`` is ``a1, a3, a5`` in ``dr = a1 r + a3 r^3 + a5 r^5`` with r in mm.
    """
    v = np.arange(pixels) - (pixels - 1) / 2.0
    x = centre_mm[0] + v * pixel_size_mm * np.sin(inclination_rad)
    y = centre_mm[1] + v * pixel_size_mm * np.cos(inclination_rad)
    r2 = x * x + y * y
    scale = 1.0 + radial[0] + radial[1] * r2 + radial[2] * r2 * r2
    return CcdLine(id, lens, np.stack([x * scale, y * scale], axis=1), chips)


def three_line_camera(
    name: str,
    focal_length_mm: float,
    pixels: int,
    pixel_size_mm: float,
    view_deg: dict[str, float],
    lens: str = "L1",
) -> LineCamera:
    """A single-lens camera with parallel lines looking forward (positive) or backward (negative) by ``view_deg``."""
    lines = tuple(
        straight_line(id, lens, pixels, pixel_size_mm, (focal_length_mm * float(np.tan(np.radians(angle))), 0.0))
        for id, angle in view_deg.items()
    )
    return LineCamera(name, (Lens(lens, focal_length_mm),), lines)
