"""Between the ground and the lines of one CCD line, with the orientation of each line."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..camera.line_camera import LineCamera

Array = NDArray[np.floating]


@dataclass(frozen=True)
class View:
    """One CCD line as curves over y; made by `view_of`.

    Attributes
    ----------
    ccd : its name
    focal_length_mm : camera constant of its lens
    y_mm, x_mm, sample : (pixels,) increasing in y
    forward : tangent of the angle by which its middle looks forward when the platform flies level
    """

    ccd: str
    focal_length_mm: float
    y_mm: Array
    x_mm: Array
    sample: Array
    forward: float

    @property
    def pixels(self) -> int:
        return len(self.sample)

    @property
    def pitch_mm(self) -> float:
        return float(np.ptp(self.y_mm)) / (self.pixels - 1)

    def rays_c(self, sample: Array) -> Array:
        """(n, 3) image vectors of samples (n,)."""
        turned = self.sample[0] > self.sample[-1]
        s, x, y = (a[::-1] if turned else a for a in (self.sample, self.x_mm, self.y_mm))
        return np.stack(
            [np.interp(sample, s, x), np.interp(sample, s, y), np.full(len(sample), -self.focal_length_mm)], axis=1
        )


def view_of(camera: LineCamera, line: int, R_fi: Array | None = None) -> View:
    """A CCD line of a camera as a view.

    Parameters
    ----------
    R_fi : (3, 3) the platform's axes forward-left-up from the image axes, of a camera that does not look straight down

    Raises
    ------
    ValueError : a line that does not run across the flight
    """
    pixels = camera.lines[line].pixels
    xy = camera.image_coordinates(np.full(pixels, line), np.arange(pixels))[0]
    sample = np.arange(pixels, dtype=float)
    if xy[-1, 1] < xy[0, 1]:
        xy, sample = xy[::-1], sample[::-1]
    if not (np.diff(xy[:, 1]) > 0).all():
        raise ValueError(f"CCD line {camera.lines[line].id!r} must run across the flight for matching")
    c = float(camera.focal_length_mm[line])
    ray = (np.eye(3) if R_fi is None else R_fi) @ np.append(xy[pixels // 2], -c)
    return View(camera.lines[line].id, c, xy[:, 1], xy[:, 0], sample, float(ray[0] / -ray[2]))


@dataclass(frozen=True)
class LineScan:
    """The lines of a view with their orientation.

    Attributes
    ----------
    view : the CCD line
    first_line : number of the first line
    position_l, R_lc : (n, 3), (n, 3, 3) orientation of each line
    ground_share : way of the view on the ground as a share of the platform's; a satellite may turn while it images
    """

    view: View
    first_line: int
    position_l: Array
    R_lc: Array
    ground_share: float = 1.0

    @property
    def way(self) -> Array:
        """(2,) horizontal direction of the flight from its first line to its last, of length 1; X where it hovers."""
        way = self.position_l[-1, :2] - self.position_l[0, :2]
        length = float(np.linalg.norm(way))
        return way / length if length else np.array([1.0, 0.0])

    def to_plane(self, line: Array, sample: Array, height_m: Array) -> tuple[Array, Array]:
        """Ground points (n, 3) of pixels at given heights, and the rays' slopes dX/dZ, dY/dZ (n, 2).

        Between two lines, both are linear.
        """
        u = np.clip(np.asarray(line) - self.first_line, 0, len(self.position_l) - 1)
        rays = self.view.rays_c(sample)
        i = np.floor(u).astype(int)
        share = (u - i)[:, None]
        xy, slope = self._on_plane(i, rays, height_m)
        if share.any():
            after_xy, after_slope = self._on_plane(np.minimum(i + 1, len(self.position_l) - 1), rays, height_m)
            xy, slope = xy + share * (after_xy - xy), slope + share * (after_slope - slope)
        return np.column_stack([xy, height_m]), slope

    def _on_plane(self, i: NDArray[np.int_], rays: Array, height_m: Array) -> tuple[Array, Array]:
        direction = np.einsum("nij,nj->ni", self.R_lc[i], rays)
        slope = direction[:, :2] / direction[:, 2:]
        position = self.position_l[i]
        return position[:, :2] + slope * (height_m - position[:, 2])[:, None], slope

    def locate(self, point_l: Array, line: Array, rounds: int = 3) -> tuple[Array, Array, NDArray[np.bool_]]:
        """Line and sample (n,) of ground points (n, 3), from guesses of the line; and which lie on the lines at hand.

        Between two lines, image coordinates are linear. The search steps by the mean motion over the lines or, where
        that makes sense, by what it has seen on its way; last by the two lines themselves.
        """
        last = len(self.position_l) - 2
        u = np.clip(np.asarray(line, dtype=float) - self.first_line, 0, last + 1)
        travel = max(float(np.linalg.norm(self.position_l[-1] - self.position_l[0])) / (last + 1), 1e-9)
        travel *= self.ground_share
        before, ahead_before = u, np.zeros(len(u))
        pixel = np.ones(len(u))
        for turn in range(rounds):
            whole = np.clip(np.rint(u), 0, last + 1)
            ahead, _, depth = self._ahead(point_l, whole.astype(int))
            pixel = self.view.focal_length_mm * travel / depth
            slope = pixel
            if turn:
                step = whole - before
                secant = (ahead_before - ahead) / np.where(step == 0, 1.0, step)
                slope = np.where((step != 0) & (secant > 0.3 * pixel) & (secant < 3 * pixel), secant, pixel)
            before, ahead_before = whole, ahead
            u = whole + np.clip(ahead / slope, -2 * last - 4, 2 * last + 4)
        i = np.clip(np.floor(u), 0, last).astype(int)
        g0, y0, _ = self._ahead(point_l, i)
        g1, y1, _ = self._ahead(point_l, i + 1)
        fall = g0 - g1
        share = np.clip(g0 / np.where(fall > 0.1 * pixel, fall, pixel), -2, 3)
        u = i + share
        y = y0 + share * (y1 - y0)
        sample = np.interp(y, self.view.y_mm, self.view.sample)
        inside = (u >= 0) & (u <= last + 1) & (np.abs(share - 0.5) < 2)
        inside &= (y > self.view.y_mm[0]) & (y < self.view.y_mm[-1])
        return u + self.first_line, sample, inside

    def _ahead(self, point_l: Array, i: NDArray[np.int_]) -> tuple[Array, Array, Array]:
        """How far (mm) points lie ahead of the CCD line in the images of lines ``i``, their y (mm), and depth (m)."""
        d = point_l - self.position_l[i]
        f = np.einsum("nji,nj->ni", self.R_lc[i], d)
        scale = -self.view.focal_length_mm / f[:, 2]
        y = scale * f[:, 1]
        return scale * f[:, 0] - np.interp(y, self.view.y_mm, self.view.x_mm), y, -f[:, 2]
