"""Residuals of image points as the surveyor measured them: lines and samples, with cofactors, w and reliability."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ..arrays import Array
from .adjustment import Solution
from .covariance import Cofactors
from .linearisation import Linearisation, Whitening
from .network import Rays
from .reliability import UNCONTROLLED


@dataclass(frozen=True)
class RayStatistics:
    """Residuals of n rays; component 0 is the line, 1 the sample.

    For a ray that is left out they are those of its prediction from all others.

    Attributes
    ----------
    v_px : (n, 2) measured minus computed
    sigma_px : (n, 2) a-priori
    redundancy : (n, 2) redundancy numbers
    w : (n, 2) normalised residuals [K A.17]; 0 where the observation is not controlled
    joint : (n,) ``v^T Qvv^-1 v`` of both coordinates, chi-square with two degrees of freedom (one where only one
        direction is controlled); what tells which of several rays is wrong
    """

    v_px: Array
    sigma_px: Array
    redundancy: Array
    w: Array
    joint: Array

    @cached_property
    def largest_w(self) -> Array:
        """(n,) larger |w| of line and sample."""
        return np.abs(self.w).max(axis=1)


def ray_statistics(solution: Solution, cofactors: Cofactors) -> RayStatistics:
    """`statistics_of_rays` of a solution."""
    if cofactors.statistics is not None:
        return cofactors.statistics
    rays, lin = solution.network.rays, solution.linearisation
    return statistics_of_rays(rays, lin, solution.whitening, solution.ray_weight, cofactors)


@dataclass(frozen=True)
class InSigmas:
    """What turns whitened residuals of n rays into lines and samples in their sigmas.

    The covariance of a residual is ``M M^T``, where the columns of M are what one sigma of the line and one sigma of
    the sample move it by; so ``M^-1 v`` are the residuals of line and sample in their sigmas.

    Attributes
    ----------
    back : (n, 2, 2) ``M^-1``
    unit : (n, 2) cofactors of line and sample: 1, or sigma0^-2 where the image sigma was re-estimated
    sigma_px : (n, 2) a-priori
    """

    back: Array
    unit: Array
    sigma_px: Array

    @classmethod
    def of(cls, rays: Rays, lin: Linearisation, whitening: Whitening) -> InSigmas:
        sigma = np.stack([rays.sigma_line_px, rays.sigma_sample_px], axis=1)
        back = _inverse(whitened_pixels(rays, lin, whitening) * sigma[:, None])
        return cls(back, np.einsum("nij,nij->ni", back, back), sigma)

    def statistics(self, residual: Array, weight: Array, cofactors: Cofactors) -> RayStatistics:
        """Statistics of whitened residuals (2, n) of rays with weights (n,)."""
        # robust weights fade away; what hardly has any is as good as left out
        weight = np.where(weight > 1e-6, weight, 0.0)
        Qvv, unit, back = cofactors.residuals(weight), self.unit, self.back
        if not ((weight == 0.0) | (weight >= 1.0)).all():
            # a ray with part of its weight: P^-1 - A Q A^T, in the units of full weight
            part = np.where((weight > 0) & (weight < 1), 1.0 / np.where(weight > 0, weight, 1.0) - 1.0, 0.0)
            Qvv, unit = Qvv + part[:, None, None] * np.eye(2), unit * (1.0 + part[:, None])
        v = np.einsum("nij,jn->ni", back, residual)
        C = back @ Qvv @ back.swapaxes(1, 2)
        q = np.einsum("nii->ni", C)
        share = q / unit
        controlled = share > UNCONTROLLED
        redundancy = np.where((weight > 0)[:, None], share, 0.0)
        w = np.where(controlled, v / np.sqrt(np.where(controlled, q, 1.0)), 0.0)
        sigma, number = self.sigma_px, np.minimum(np.maximum(redundancy, 0.0), 1.0)
        return RayStatistics(v * sigma, sigma * np.sqrt(unit), number, w, _joint(v, C, unit))


def statistics_of_rays(
    rays: Rays, lin: Linearisation, whitening: Whitening, weight: Array, cofactors: Cofactors
) -> RayStatistics:
    """Whitened residuals of rays with weights (n,) turned back into lines and samples."""
    return InSigmas.of(rays, lin, whitening).statistics(lin.residual, weight, cofactors)


def whitened_pixels(rays: Rays, lin: Linearisation, whitening: Whitening) -> Array:
    """What moves the whitened residuals (n, 2, 2): one pixel in the line, the first column, or in the sample."""
    rates = np.concatenate([rays.velocity_l, rays.angle_rate], axis=1)
    return pixels_of_motion(rates, rays.line_period_s, rays.pitch_mm, lin.orientation, whitening.g)


def pixels_of_motion(rates: Array, line_period_s: Array, pitch_mm: Array, orientation: Array, g: Array) -> Array:
    """`whitened_pixels` of rays with the rates (n, 6) of the measured orientation; ``orientation``, ``g``: see
    `Linearisation` and `Whitening`."""
    pitch = pitch_mm.T
    M = np.empty((len(rates), 2, 2))
    # a later line lets the computed point move on: the residual goes against the image motion
    M[:, :, 0] = -(np.einsum("ckn,kn->cn", orientation, rates.T) * line_period_s).T
    M[:, 0, 1] = g[0] * pitch[0]
    M[:, 1, 1] = g[1] * pitch[0] + g[2] * pitch[1]
    return M


def _inverse(M: Array) -> Array:
    """Inverses (n, 2, 2), kept finite where the image moves along the CCD line, so that line and sample are one."""
    det = M[:, 0, 0] * M[:, 1, 1] - M[:, 0, 1] * M[:, 1, 0]
    floor = 1e-6 * np.einsum("nij,nij->n", M, M)
    det = np.where(np.abs(det) > floor, det, np.where(det < 0, -floor, floor))
    rows = [M[:, 1, 1], -M[:, 0, 1], -M[:, 1, 0], M[:, 0, 0]]
    return (np.stack(rows, axis=1) / det[:, None]).reshape(-1, 2, 2)


def _joint(v: Array, C: Array, unit: Array) -> Array:
    """``v^T C^+ v`` (n,), without directions that are not controlled."""
    limit = UNCONTROLLED * unit.max(axis=1)
    a, b, d = C[:, 0, 0], C[:, 0, 1], C[:, 1, 1]
    smaller = 0.5 * (a + d) - np.sqrt(0.25 * (a - d) ** 2 + b * b)
    x, y = v.T
    det = a * d - b * b
    regular = smaller > 10 * limit
    joint = np.divide(d * x * x - 2 * b * x * y + a * y * y, det, out=np.zeros_like(det), where=regular)
    rest = np.flatnonzero(~regular)
    if len(rest):
        values, vectors = np.linalg.eigh(C[rest])
        along = np.einsum("nij,ni->nj", vectors, v[rest])
        good = values > limit[rest, None]
        joint[rest] = np.where(good, along**2 / np.where(good, values, 1.0), 0.0).sum(axis=1)
    return joint
