"""Weights and linearised observation equations of all rays, whitened; the ray is the last axis everywhere."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from ..arrays import Array
from ..camera.collinearity import collinearity
from ..geometry.rotation import corrected_angles
from .layout import Layout, RayShift
from .network import Rays

#: Rays worked on at a time: so many that a call's overhead is small, so few that the arrays stay in the cache.
CHUNK = 8192
#: Lines and samples by which a ray may be fitted elsewhere than measured: blunders and bad starts go no further.
MOST_PIXELS = 200.0


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
        return np.array([self.g[0] * xy[0], self.g[1] * xy[0] + self.g[2] * xy[1]])


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


def residual_covariance(rays: Rays, d_orientation: Array, motion: Array | None = None) -> Array:
    """Covariance (3, n) of the residuals, elements xx, xy, yy in mm^2: ``Ju su^2 Ju^T + Jv sv^2 Jv^T``.

    ``Ju`` is the image motion during one line: platform velocity and attitude rate through the collinearity equations;
    ``Jv`` the pixel pitch along the CCD line. The white noise of the orientation, where it is known, goes the same way:
    `orientation_noise`.

    Parameters
    ----------
    rays : n rays
    d_orientation : (2, 6, n) derivative of the projection to the orientation
    motion : (2, n) image motion in mm/s where it has been computed already
    """
    motion = _image_motion(d_orientation, _rates(rays)) if motion is None else motion
    u = motion * (rays.line_period_s * rays.sigma_line_px)
    v = rays.pitch_mm.T * rays.sigma_sample_px
    return _outer(u) + _outer(v) + orientation_noise(rays, d_orientation)


def _outer(a: Array) -> Array:
    """Elements xx, xy, yy of ``a a^T`` for (2, n)."""
    return np.array([a[0] * a[0], a[0] * a[1], a[1] * a[1]])


def orientation_noise(rays: Rays, d_orientation: Array) -> Array | float:
    """What the white noise of the measured orientation adds to the covariance (3, n) of the residuals."""
    if rays.orientation_noise is None:
        return 0.0
    of_ray = d_orientation.transpose(2, 0, 1)
    noise = of_ray @ rays.orientation_noise @ of_ray.transpose(0, 2, 1)
    return np.array([noise[:, 0, 0], noise[:, 0, 1], noise[:, 1, 1]])


def pitch_covariance(rays: Rays) -> Array:
    """Covariance (3, n) from the pixel pitch alone, x and y alike; what adjustments of frame images do."""
    pitch = np.linalg.norm(rays.pitch_mm, axis=1)
    zero = np.zeros(len(rays))
    return np.array([(pitch * rays.sigma_line_px) ** 2, zero, (pitch * rays.sigma_sample_px) ** 2])


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
    return Whitening(np.array([1.0 / l11, -l21 / (l11 * l22), 1.0 / l22]))


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
    result = _not_filled(layout, len(rays), camera)
    for part, _, residual, d_orientation, d_point, _ in _by_chunks(rays, layout, theta, points_l):
        g = whitening.g[:, part]
        _whiten_into(result.residual, residual, g, part)
        _whiten_into(result.orientation, d_orientation, g, part)
        _whiten_into(result.point, d_point, g, part)
        if camera is None and layout.camera is not None:
            _whiten_into(result.camera, layout.camera.coefficients(part), g, part)
    return result


def _not_filled(layout: Layout, n: int, camera: Array | None = None) -> Linearisation:
    """Place for the equations of n rays; the effect of the additional parameters where it is known."""
    if camera is None:
        camera = np.empty((2, 0 if layout.camera is None else len(layout.camera.kinds), n))
    return Linearisation(np.empty((2, n)), np.empty((2, 6, n)), camera, np.empty((2, 3, n)))


class Weighed(NamedTuple):
    """Weights, the observation equations with them, and the layout, in which the rays are where they are fitted now."""

    whitening: Whitening
    linearisation: Linearisation
    layout: Layout


def linearise_and_weigh(
    rays: Rays, layout: Layout, theta: Array, points_l: Array, whitening: Whitening | None = None
) -> Weighed:
    """Weights from the image motion at the given values, and the observation equations with them; see `linearise`.

    With additional parameters the rays are fitted anew before that; see `fit_rays`.

    Parameters
    ----------
    theta, points_l : (u,) unknowns, (p, 3) points in the local frame
    whitening : weights to be kept
    """
    n, kept = len(rays), whitening is not None
    # of few rays they are computed once for both
    correction = layout.corrections(theta) if layout.camera is not None and n <= CHUNK else None
    layout = fit_rays(rays, layout, theta, points_l, correction)
    whitening = whitening or Whitening(np.empty((3, n)))
    result = _not_filled(layout, n)
    for part, own, residual, d_orientation, d_point, _ in _by_chunks(rays, layout, theta, points_l, correction):
        if not kept:
            whitening.g[:, part] = whiten(residual_covariance(own, d_orientation)).g
        g = whitening.g[:, part]
        _whiten_into(result.residual, residual, g, part)
        _whiten_into(result.orientation, d_orientation, g, part)
        _whiten_into(result.point, d_point, g, part)
        if layout.camera is not None:
            _whiten_into(result.camera, layout.camera.coefficients(part), g, part)
    return Weighed(whitening, result, layout)


def fit_rays(rays: Rays, layout: Layout, theta: Array, points_l: Array, correction: Array | None = None) -> Layout:
    """The layout with every ray where it is by what is known of it: line, sample and orientation less their residuals.

    What is linearised at measured values has their noise in its derivatives as well as in its residuals, and the
    product of both does not vanish on average: noise of lines and samples is smallest in the smallest image, that of
    the orientation in the largest. Where many rays know the scale of the image by the jitter of the attitude or by
    parallaxes along the flight alone, it decides the scale. Observations less their residuals are not correlated with
    these. Without additional parameters the scale is known otherwise, and rays stay where they were measured.

    A residual ``r`` of covariance ``C`` is made up of ``S J^T C^-1 r`` of observations of covariance ``S`` that act on
    it by ``J``: lines and samples, and the orientation where its noise is known.

    Parameters
    ----------
    rays, layout, theta, points_l : as in `linearise`
    correction : (6, n) of the orientation at these values, where it has been computed already

    Source: A. J. Pope, Some pitfalls to be avoided in the iterative adjustment of nonlinear problems, 1972.
    """
    if layout.camera is None:
        return layout
    n = len(rays)
    fitted, moved, image = np.empty((2, n)), np.empty((n, 6)), np.empty((2, n))
    for part, own, residual, d_orientation, _, _ in _by_chunks(rays, layout, theta, points_l, correction):
        rates = _rates(own)
        motion, pitch = _image_motion(d_orientation, rates), own.pitch_mm.T
        white = whiten(residual_covariance(own, d_orientation, motion))
        a = white.apply(residual)
        multiplier = np.array([white.g[0] * a[0] + white.g[1] * a[1], white.g[2] * a[1]])  # C^-1 r
        later_s = (own.line_period_s * own.sigma_line_px) ** 2 * (motion * multiplier).sum(axis=0)
        samples = own.sigma_sample_px**2 * (pitch * multiplier).sum(axis=0)
        far = np.maximum(np.abs(later_s) / (MOST_PIXELS * own.line_period_s), np.abs(samples) / MOST_PIXELS)
        share = 1.0 / np.maximum(far, 1.0)
        change = later_s * rates
        if own.orientation_noise is not None:
            acting = np.einsum("cln,cn->nl", d_orientation, multiplier)[:, :, None]
            change += (own.orientation_noise @ acting)[:, :, 0].T
        change *= share
        image[:, part] = np.einsum("ckn,kn->cn", d_orientation, change)
        moved[part] = change.T
        fitted[:, part] = own.xy_mm.T - share * samples * pitch
    return layout.fitted(fitted, RayShift(moved, image))


def _rates(rays: Rays) -> Array:
    """Velocity and attitude rate (6, n) of the platform."""
    rates = np.empty((6, len(rays)))
    rates[:3], rates[3:] = rays.velocity_l.T, rays.angle_rate.T
    return rates


def _image_motion(d_orientation: Array, rates: Array) -> Array:
    """Image motion (2, n) in mm/s by rates (6, n) of the platform; whitened if `d_orientation` is."""
    return np.einsum("ckn,kn->cn", d_orientation, rates)


def _by_chunks(
    rays: Rays, layout: Layout, theta: Array, points_l: Array, correction: Array | None = None
) -> Iterator[tuple[slice, Rays, Array, Array, Array, Array]]:
    """Range, rays, residual in mm, derivatives and depth of one chunk after the other; corrections (6, n) of all rays
    may be given."""
    for low in range(0, len(rays), CHUNK):
        part = slice(low, min(low + CHUNK, len(rays)))
        own = rays if len(rays) <= CHUNK else rays.part(part)
        xy_mm = own.xy_mm.T
        if layout.shift is not None:
            position_l = own.position_l + layout.shift.orientation[part, :3]
            angles = own.angles + layout.shift.orientation[part, 3:]
            own, xy_mm = replace(own, position_l=position_l, angles=angles), xy_mm + layout.shift.image_mm[:, part]
        change = layout.corrections(theta, part) if correction is None else correction[:, part]
        position, angles = corrected(own, layout, change)
        xy, d_orientation, d_point, depth = collinearity(
            position, angles, points_l.take(own.point, axis=0).T, own.focal_length_mm
        )
        if layout.heading:  # kappa's correction has turned the tilt
            omega, phi = angles[:2] - change[3:5]
            d_orientation[:, 5] += omega * d_orientation[:, 4] - phi * d_orientation[:, 3]
        residual = xy_mm - layout.displacement(theta, part) - xy
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


def refresh_weights(rays: Rays, whitening: Whitening, lin: Linearisation) -> tuple[Whitening, Linearisation]:
    """Weights from the image motion at the linearisation, and the same equations with these weights."""
    u = _image_motion(lin.orientation, _rates(rays)) * (rays.line_period_s * rays.sigma_line_px)
    v = whitening.apply(rays.pitch_mm.T * rays.sigma_sample_px)
    turn = whiten(_outer(u) + _outer(v) + orientation_noise(rays, lin.orientation))
    a, b, c = turn.g
    g = whitening.g
    fresh = Whitening(np.array([a * g[0], b * g[0] + c * g[1], c * g[2]]))
    arrays = []
    for old in (lin.residual, lin.orientation, lin.camera, lin.point):
        new = np.empty_like(old)
        np.multiply(old[0], a, out=new[0])
        np.multiply(old[1], c, out=new[1])
        new[1] += old[0] * b
        arrays.append(new)
    return fresh, Linearisation(*arrays)
