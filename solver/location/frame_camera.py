"""The rigorous model of a frame image: direct and inverse location of an image taken at one instant.

The image lies in the plane ``z = -c`` below the projection centre: ``x`` goes with the columns, ``y`` against the rows,
from the middle of the image. A point appears at its ideal place ``-c (dx, dy) / dz`` plus principal point plus
distortion (Brown), where ``d`` is its direction in the camera.
"""

from __future__ import annotations

from copy import copy

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..camera.sensors import brown_distortion
from ..geometry.ellipsoid import WGS84, Ellipsoid
from .in_image import in_image
from .refraction import Refraction

Array = NDArray[np.floating]

#: Newton's method that takes the distortion off, and what it may miss by where it has found a place.
_MOST_STEPS, _CONVERGED_MM, _FOUND_MM = 50, 1e-11, 1e-7
#: Directions further from the axis than this, as tangents, are not looked at: Brown's polynomial folds far outside.
_WIDEST = 20.0
_PORTION = 8192


class FrameCamera:
    """A frame camera with its orientation.

    Parameters
    ----------
    position_e : (3,) perspective centre, Earth-fixed, metres
    R_ec : (3, 3) from the image frame (x with the columns, y against the rows, z back to the centre) to Earth-fixed
    focal_length_mm : camera constant
    pixel_mm : (2,) or one: width (along x) and height (along y) of a pixel
    lines, samples : size of the image
    principal_point_mm : (2,) from the middle of the image
    distortion : (5,) k1, k2, k3, p1, p2, in powers of mm
    ellipsoid : heights are above it
    refraction : what the air does to the rays; None for straight rays

    Raises
    ------
    ValueError : sizes that are not positive, a matrix that is no rotation
    """

    def __init__(
        self,
        position_e: ArrayLike,
        R_ec: ArrayLike,
        focal_length_mm: float,
        pixel_mm: ArrayLike,
        lines: int,
        samples: int,
        *,
        principal_point_mm: ArrayLike = (0.0, 0.0),
        distortion: ArrayLike = (0.0, 0.0, 0.0, 0.0, 0.0),
        ellipsoid: Ellipsoid = WGS84,
        refraction: Refraction | None = None,
    ):
        self.position_e, self.R_ec = np.asarray(position_e, dtype=float), np.asarray(R_ec, dtype=float)
        if self.position_e.shape != (3,) or not np.isfinite(self.position_e).all():
            raise ValueError(f"position {self.position_e}, wanted three numbers")
        if self.R_ec.shape != (3, 3) or not np.allclose(self.R_ec @ self.R_ec.T, np.eye(3), atol=1e-9):
            raise ValueError("orientation: no rotation")
        self.pixel_mm = np.broadcast_to(np.asarray(pixel_mm, dtype=float), 2)
        self.focal_length_mm = float(focal_length_mm)
        if not (self.focal_length_mm > 0 and (self.pixel_mm > 0).all() and lines >= 1 and samples >= 1):
            raise ValueError(f"focal length {focal_length_mm}, pixels of {self.pixel_mm} mm, wanted more than 0")
        self.lines, self.samples = int(lines), int(samples)
        self.principal_point_mm = np.asarray(principal_point_mm, dtype=float)
        self.distortion = np.asarray(distortion, dtype=float)
        self.ellipsoid, self.refraction = ellipsoid, refraction

    def with_refraction(self, refraction: Refraction | None) -> FrameCamera:
        """The same camera with other air, or without."""
        other = copy(self)
        other.refraction = refraction
        return other

    def with_orientation(self, position_e: ArrayLike, R_ec: ArrayLike) -> FrameCamera:
        """The same camera elsewhere."""
        other = copy(self)
        other.position_e, other.R_ec = np.asarray(position_e, dtype=float), np.asarray(R_ec, dtype=float)
        return other

    # -- the camera ----------------------------------------------------------------------------------------------------

    def image_mm(self, line: ArrayLike, sample: ArrayLike) -> Array:
        """Image coordinates (n, 2), mm, of pixels, reduced to the principal point and without distortion.

        NaN where no ideal place is distorted to the pixel: Brown's polynomial turns back before.
        """
        v, u = np.asarray(sample, dtype=float), np.asarray(line, dtype=float)
        x = (v - 0.5 * (self.samples - 1)) * self.pixel_mm[0]
        y = (0.5 * (self.lines - 1) - u) * self.pixel_mm[1]
        measured = np.stack(np.broadcast_arrays(x, y), axis=-1) - self.principal_point_mm
        return self._undistorted(measured) if self.distortion.any() else measured

    def _undistorted(self, measured_mm: Array) -> Array:
        """Ideal image coordinates (..., 2) of measured ones (..., 2); NaN where there are none."""
        ideal, slope = measured_mm, np.empty(0)
        miss = np.full(measured_mm.shape, np.nan)
        with np.errstate(all="ignore"):  # what is not found does not count
            for _ in range(_MOST_STEPS):
                miss = measured_mm - ideal - brown_distortion(ideal, *self.distortion)
                slope = self._distorted(ideal)
                step = np.stack(
                    [
                        slope[..., 1, 1] * miss[..., 0] - slope[..., 0, 1] * miss[..., 1],
                        slope[..., 0, 0] * miss[..., 1] - slope[..., 1, 0] * miss[..., 0],
                    ],
                    axis=-1,
                ) / _determinant(slope)[..., None]  # fmt: skip
                if not np.nanmax(np.abs(step), initial=0.0) > _CONVERGED_MM:
                    break
                ideal = ideal + step
            found = (np.abs(miss).max(axis=-1) < _FOUND_MM) & _unfolded(slope)
        return np.where(found[..., None], ideal, np.nan)

    def pixel_of(self, ideal_mm: Array) -> Array:
        """Line and sample (n, 2) of ideal image coordinates (n, 2); the inverse of `image_mm`."""
        xy = ideal_mm + self.principal_point_mm
        if self.distortion.any():
            xy = xy + brown_distortion(ideal_mm, *self.distortion)
        u = 0.5 * (self.lines - 1) - xy[:, 1] / self.pixel_mm[1]
        v = 0.5 * (self.samples - 1) + xy[:, 0] / self.pixel_mm[0]
        return np.stack([u, v], axis=1)

    # -- location ------------------------------------------------------------------------------------------------------

    def ground(self, line: ArrayLike, sample: ArrayLike, height_m: ArrayLike) -> Array:
        """Earth-fixed positions (n, 3) where the rays of pixels (n,) reach heights; NaN where they miss."""
        u, v, h = np.broadcast_arrays(*(np.atleast_1d(np.asarray(a, dtype=float)) for a in (line, sample, height_m)))
        out = np.empty((len(u), 3))
        for k in range(0, len(u), _PORTION):
            part = slice(k, k + _PORTION)
            xy = self.image_mm(u[part], v[part])
            d = np.column_stack([xy, np.full(len(xy), -self.focal_length_mm)]) @ self.R_ec.T
            d /= np.linalg.norm(d, axis=1, keepdims=True)
            C = np.broadcast_to(self.position_e, d.shape)
            P = C + self.ellipsoid.intersect(C, d, h[part])[:, None] * d
            out[part] = P if self.refraction is None else self.refraction.true_ground(P, C)
        return out

    def direct(self, line: ArrayLike, sample: ArrayLike, height_m: ArrayLike) -> Array:
        """Latitude, longitude (radians) and height, (n, 3), of pixels (n,) at heights above the ellipsoid."""
        located = self.ellipsoid.geodetic(self.ground(line, sample, height_m))
        located[:, 2] = np.where(np.isnan(located[:, 0]), np.nan, np.broadcast_to(height_m, len(located)))
        return located

    def inverse(self, lat: ArrayLike, lon: ArrayLike, height_m: ArrayLike, margin_px: float = 0.0) -> Array:
        """Line and sample, (n, 2), of latitudes and longitudes (n,) in radians at heights above the ellipsoid.

        NaN for points behind the camera or the horizon, or more than ``margin_px`` outside the image.
        """
        lat, lon, h = np.broadcast_arrays(*map(np.atleast_1d, (lat, lon, height_m)))
        P = self.ellipsoid.cartesian(lat, lon, h)
        C = np.broadcast_to(self.position_e, P.shape)
        visible = np.einsum("ni,ni->n", self.ellipsoid.normal_and_height(P)[0], C - P) > 0
        if self.refraction is not None:
            P = self.refraction.straight_ground(P, C)
        d = (P - C) @ self.R_ec
        with np.errstate(divide="ignore", invalid="ignore"):
            tangent = d[:, :2] / -d[:, 2:]
            seen = visible & (d[:, 2] < 0) & (np.abs(tangent) < _WIDEST).all(axis=1)
            ideal = np.where(seen[:, None], tangent, 0.0) * self.focal_length_mm
            pixel = self.pixel_of(ideal)
        # far outside the image the distortion's polynomial may bring a point back in
        widest = 1.5 * np.linalg.norm(self._half_mm) + margin_px * self.pixel_mm.max()
        folded = np.linalg.norm(tangent, axis=1) * self.focal_length_mm > widest
        if self.distortion.any():
            folded |= ~_unfolded(self._distorted(ideal))
        inside = in_image(pixel, self.lines, self.samples, margin_px)
        pixel[~(inside & seen & ~folded)] = np.nan
        return pixel

    @property
    def _half_mm(self) -> Array:
        return 0.5 * np.array([self.samples, self.lines]) * self.pixel_mm + np.abs(self.principal_point_mm)

    # -- errors --------------------------------------------------------------------------------------------------------

    def image_derivatives(self, line: ArrayLike, sample: ArrayLike, height_m: ArrayLike) -> Array:
        """Derivatives (n, 2, 6) of line and sample by position (east, north, up; m) and small turns about them (rad).

        Refraction is left out; it changes a derivative by 1e-4 of itself.
        """
        P = self.ellipsoid.geodetic(self.ground(line, sample, height_m))
        X = self.ellipsoid.cartesian(P[:, 0], P[:, 1], P[:, 2])
        lat, lon, _ = self.ellipsoid.geodetic(self.position_e)
        sl, cl, sp, cp = np.sin(lon), np.cos(lon), np.sin(lat), np.cos(lat)
        axes = np.array([[-sl, cl, 0.0], [-sp * cl, -sp * sl, cp], [cp * cl, cp * sl, sp]])
        d = X - self.position_e
        moved = np.concatenate([-np.broadcast_to(axes, (len(d), 3, 3)), np.cross(d[:, None, :], axes[None])], axis=1)
        dc, slopes = d @ self.R_ec, moved @ self.R_ec
        tangent = dc[:, :2] / -dc[:, 2:]
        by = -(slopes[:, :, :2] + tangent[:, None, :] * slopes[:, :, 2:]) / dc[:, None, 2:] * self.focal_length_mm
        if self.distortion.any():
            by = np.swapaxes(self._distorted(tangent * self.focal_length_mm) @ np.swapaxes(by, 1, 2), 1, 2)
        out = np.empty((len(d), 2, 6))
        out[:, 0], out[:, 1] = -by[:, :, 1] / self.pixel_mm[1], by[:, :, 0] / self.pixel_mm[0]
        return out

    def _distorted(self, ideal_mm: Array) -> Array:
        """Derivatives (..., 2, 2) of image coordinates by ideal ones (..., 2)."""
        k1, k2, k3, p1, p2 = self.distortion
        x, y = ideal_mm[..., 0], ideal_mm[..., 1]
        r2 = x * x + y * y
        radial, by_r2 = r2 * (k1 + r2 * (k2 + r2 * k3)), k1 + r2 * (2.0 * k2 + r2 * 3.0 * k3)
        mixed = 2.0 * (x * y * by_r2 + y * p1 + x * p2)
        along = 1.0 + radial + 2.0 * x * x * by_r2 + 6.0 * x * p1 + 2.0 * y * p2
        across = 1.0 + radial + 2.0 * y * y * by_r2 + 6.0 * y * p2 + 2.0 * x * p1
        return np.stack([np.stack([along, mixed], axis=-1), np.stack([mixed, across], axis=-1)], axis=-2)


def _determinant(M: Array) -> Array:
    """Of matrices (..., 2, 2)."""
    return M[..., 0, 0] * M[..., 1, 1] - M[..., 0, 1] * M[..., 1, 0]


def _unfolded(slope: Array) -> NDArray[np.bool_]:
    """Where derivatives (..., 2, 2) neither mirror nor turn round: before the distortion turns back."""
    return (_determinant(slope) > 0) & (slope[..., 0, 0] + slope[..., 1, 1] > 0)
