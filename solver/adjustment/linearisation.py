"""Weights and linearised observation equations of all rays, whitened; the ray is the last axis everywhere."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..collinearity import collinearity
from ..rotation import corrected_angles
from .layout import Layout
from .network import Rays

Array = NDArray[np.floating]

#: Rays worked on at a time: so many that a call's overhead is small, so few that the arrays stay in the cache.
CHUNK = 4096
#: Samples by which a fitted image coordinate may differ from the measured one: blunders and bad starts go no further.
MOST_SAMPLES = 200.0


@dataclass(frozen=True)
class Whitening:
    """Lower triangular ``G`` with ``G C G^T = I`` for the covariance C of each ray's residual (mm^2).

    Attributes
    ----------
    g : (3, n) elements 11, 21, 22
    """

    g: Array

    def scaled(self, weight: Array) -> Whitening:
        """With the weight of every ray multiplied by (n,) factors; 0 leaves a ray out."""
        return Whitening(self.g * np.sqrt(weight))

    def apply(self, xy: Array) -> Array:
        """Whitened (2, ..., n) of (2, ..., n) in mm."""
        return np.stack([self.g[0] * xy[0], self.g[1] * xy[0] + self.g[2] * xy[1]])


@dataclass(frozen=True)
class Linearisation:
    """Whitened observation equations ``residual = orientation @ d_eo + camera @ d_ap + point @ d_p + v``.

    Attributes
    ----------
    residual : (2, n) measured minus computed
    orientation : (2, 6, n) derivative of the computed coordinates to the orientation corrections
    camera : (2, slots, n) to the additional parameters of `Layout.camera`; slots = 0 without
    point : (2, 3, n) to the object point
    """

    residual: Array
    orientation: Array
    camera: Array
    point: Array

    def reweighted(self, factor: Array) -> Linearisation:
        """With every ray's weight multiplied by (n,) factors."""
        root = np.sqrt(factor)
        return Linearisation(self.residual * root, self.orientation * root, self.camera * root, self.point * root)


def residual_covariance(rays: Rays, d_orientation: Array, attitude_rate: bool = True) -> Array:
    """Covariance (3, n) of the residuals, elements xx, xy, yy in mm^2: ``Ju su^2 Ju^T + Jv sv^2 Jv^T``.

    ``Ju`` is the image motion during one line: platform velocity and attitude rate through the collinearity equations;
    ``Jv`` the pixel pitch along the CCD line.

    Parameters
    ----------
    rays : n rays
    d_orientation : (2, 6, n) derivative of the projection to the orientation
    attitude_rate : False leaves the attitude rate out, which holds for a stabilised mount only

    The white noise of the orientation, where it is known, goes the same way: `orientation_noise`.
    """
    u = _image_motion(rays, d_orientation, attitude_rate) * (rays.line_period_s * rays.sigma_line_px)
    v = rays.pitch_mm.T * rays.sigma_sample_px
    return _outer(u) + _outer(v) + orientation_noise(rays, d_orientation)


def _outer(a: Array) -> Array:
    """Elements xx, xy, yy of ``a a^T`` for (2, n)."""
    return np.stack([a[0] * a[0], a[0] * a[1], a[1] * a[1]])


def orientation_noise(rays: Rays, d_orientation: Array) -> Array | float:
    """What the white noise of the measured orientation adds to the covariance (3, n) of the residuals."""
    if rays.orientation_noise is None:
        return 0.0
    through = np.einsum("akn,nkl->anl", d_orientation, rays.orientation_noise)
    xx, xy, yy = (np.einsum("nk,kn->n", through[a], d_orientation[b]) for a, b in ((0, 0), (0, 1), (1, 1)))
    return np.stack([xx, xy, yy])


def pitch_covariance(rays: Rays) -> Array:
    """Covariance (3, n) from the pixel pitch alone, x and y alike; what adjustments of frame images do."""
    pitch = np.linalg.norm(rays.pitch_mm, axis=1)
    zero = np.zeros(len(rays))
    return np.stack([(pitch * rays.sigma_line_px) ** 2, zero, (pitch * rays.sigma_sample_px) ** 2])


def whiten(covariance: Array) -> Whitening:
    """Inverse Cholesky factor of covariances (3, n).

    A ray whose image motion runs along its CCD line has a singular covariance; it gets a floor of 1e-6 of its larger
    variance.
    """
    xx, xy, yy = covariance
    floor = 1e-6 * (xx + yy)
    l11 = np.sqrt(np.maximum(xx, floor))
    l21 = xy / l11
    l22 = np.sqrt(np.maximum(yy - l21 * l21, floor))
    return Whitening(np.stack([1.0 / l11, -l21 / (l11 * l22), 1.0 / l22]))


def linearise(
    rays: Rays, layout: Layout, whitening: Whitening, theta: Array, points_l: Array, camera: Array | None = None
) -> Linearisation:
    """Whitened observation equations of all rays at the given values.

    Parameters
    ----------
    rays : n rays
    layout : unknowns
    whitening : weights
    theta : (n_unknowns,) of the reduced system
    points_l : (p, 3)
    camera : (2, slots, n) of another linearisation with the same weights and layout; it does not depend on the values
    """
    n = len(rays)
    result = Linearisation(
        np.empty((2, n)),
        np.empty((2, 6, n)),
        whitening.apply(_camera(layout, n)) if camera is None else camera,
        np.empty((2, 3, n)),
    )
    for part, _, residual, d_orientation, d_point, _ in _by_chunks(rays, layout, theta, points_l):
        g = whitening.g[:, part]
        _whiten_into(result.residual, residual, g, part)
        _whiten_into(result.orientation, d_orientation, g, part)
        _whiten_into(result.point, d_point, g, part)
    return result


class Weighed(NamedTuple):
    """Weights, the observation equations with them, and the layout with additional parameters where they act now."""

    whitening: Whitening
    linearisation: Linearisation
    layout: Layout


def linearise_and_weigh(
    rays: Rays, layout: Layout, theta: Array, points_l: Array, whitening: Whitening | None = None
) -> Weighed:
    """Weights from the image motion at the given values, and the observation equations with them; see `linearise`.

    Additional parameters are evaluated anew at the fitted image coordinates (`fitted_coordinates`).

    Parameters
    ----------
    whitening : weights to be kept
    """
    n, kept = len(rays), whitening is not None
    camera = np.empty_like(_camera(layout, n))
    whitening = whitening or Whitening(np.empty((3, n)))
    result = Linearisation(np.empty((2, n)), np.empty((2, 6, n)), np.empty(camera.shape), np.empty((2, 3, n)))
    for part, own, residual, d_orientation, d_point, _ in _by_chunks(rays, layout, theta, points_l):
        if layout.camera is not None:
            fitted = fitted_coordinates(own, residual, _image_motion(own, d_orientation), own.pitch_mm.T)
            camera[:, :, part] = layout.camera.coefficients_at(fitted, part)
            residual += layout.change_of_displacement(camera[:, :, part], theta, part)
        if not kept:
            whitening.g[:, part] = whiten(residual_covariance(own, d_orientation)).g
        g = whitening.g[:, part]
        _whiten_into(result.residual, residual, g, part)
        _whiten_into(result.orientation, d_orientation, g, part)
        _whiten_into(result.point, d_point, g, part)
        _whiten_into(result.camera, camera[:, :, part], g, part)
    return Weighed(whitening, result, layout.with_camera(camera))


def fitted_coordinates(rays: Rays, residual: Array, motion: Array, pitch: Array) -> Array:
    """Image coordinates (2, n) in mm without the residual along the CCD line, where additional parameters act.

    A ray meets its CCD line at the measured sample less its error. Taken at the measured sample, the parameters would
    act on the noise, too: it is smallest in the smallest image, and many rays that know the scale of the image by the
    jitter of the attitude alone would make it small. Adjusted coordinates are not correlated with the residuals.

    Parameters
    ----------
    residual : (2, n), mm or whitened
    motion, pitch : (2, n) change of the image coordinates with lines (of any length) and with samples, likewise
    """
    across = motion[0] * pitch[1] - motion[1] * pitch[0]
    along = motion[0] * residual[1] - motion[1] * residual[0]
    # image motion along the CCD line: lines and samples are not to be told apart
    least = 1e-3 * np.hypot(*motion) * np.hypot(*pitch)
    samples = np.where(np.abs(across) > least, along / np.where(across == 0.0, 1.0, across), 0.0)
    return (rays.xy_mm - rays.pitch_mm * np.clip(samples, -MOST_SAMPLES, MOST_SAMPLES)[:, None]).T


def _image_motion(rays: Rays, d_orientation: Array, attitude_rate: bool = True) -> Array:
    """Image motion (2, n) in mm/s by velocity and attitude rate of the platform; whitened if `d_orientation` is."""
    rates = np.concatenate([rays.velocity_l.T, rays.angle_rate.T if attitude_rate else np.zeros((3, len(rays)))])
    return np.einsum("ckn,kn->cn", d_orientation, rates)


def _camera(layout: Layout, n: int) -> Array:
    """Effect of the additional parameters (2, slots, n), unwhitened."""
    return layout.camera.coefficients if layout.camera is not None else np.empty((2, 0, n))


def _by_chunks(
    rays: Rays, layout: Layout, theta: Array, points_l: Array
) -> Iterator[tuple[slice, Rays, Array, Array, Array, Array]]:
    """Range, rays, residual in mm, derivatives and depth of one chunk after the other."""
    for low in range(0, len(rays), CHUNK):
        part = slice(low, min(low + CHUNK, len(rays)))
        own = rays.part(part)
        correction = layout.corrections(theta, part)
        position, angles = corrected(own, layout, correction)
        xy, d_orientation, d_point, depth = collinearity(
            position, angles, points_l.take(own.point, axis=0).T, own.focal_length_mm
        )
        if layout.heading:  # kappa's correction has turned the tilt
            omega, phi = angles[:2] - correction[3:5]
            d_orientation[:, 5] += omega * d_orientation[:, 4] - phi * d_orientation[:, 3]
        residual = own.xy_mm.T - layout.displacement(theta, part) - xy
        yield part, own, residual, d_orientation, d_point, depth


def corrected(rays: Rays, layout: Layout, correction: Array) -> tuple[Array, Array]:
    """Perspective centres and angles (3, n) of rays with corrections (6, n)."""
    angles = rays.angles.T + correction[3:]
    if layout.heading:
        angles = np.ascontiguousarray(corrected_angles(rays.angles, correction[3:].T).T)
    return rays.position_l.T + correction[:3], angles


def _whiten_into(target: Array, raw: Array, g: Array, part: slice) -> None:
    """``target[..., part] = G raw`` for (2, ..., m)."""
    np.multiply(raw[0], g[0], out=target[0, ..., part])
    np.multiply(raw[1], g[2], out=target[1, ..., part])
    target[1, ..., part] += raw[0] * g[1]


def refresh_weights(
    rays: Rays, layout: Layout, whitening: Whitening, lin: Linearisation, theta: Array, keep: bool = False
) -> Weighed:
    """As `linearise_and_weigh`, from the linearisation at the same values with older weights.

    Parameters
    ----------
    keep : the weights stay; additional parameters alone are evaluated anew
    """
    motion, pitch = _image_motion(rays, lin.orientation), whitening.apply(rays.pitch_mm.T)
    fresh, turned = whitening, lin
    if not keep:
        u, v = motion * (rays.line_period_s * rays.sigma_line_px), pitch * rays.sigma_sample_px
        a, b, c = whiten(_outer(u) + _outer(v) + orientation_noise(rays, lin.orientation)).g
        g = whitening.g
        fresh = Whitening(np.stack([a * g[0], b * g[0] + c * g[1], c * g[2]]))
        arrays = []
        for old in (lin.residual, lin.orientation, lin.camera, lin.point):
            new = np.empty_like(old)
            np.multiply(old[0], a, out=new[0])
            np.multiply(old[1], c, out=new[1])
            new[1] += old[0] * b
            arrays.append(new)
        turned = Linearisation(*arrays)
    if layout.camera is None:
        return Weighed(fresh, turned, layout)
    camera = layout.camera.coefficients_at(fitted_coordinates(rays, lin.residual, motion, pitch))
    residual = turned.residual + fresh.apply(layout.change_of_displacement(camera, theta))
    return Weighed(fresh, replace(turned, residual=residual, camera=fresh.apply(camera)), layout.with_camera(camera))
