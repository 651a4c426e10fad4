"""How well what a line shows is placed on the ground: from the covariance of its orientation, the relief and matching.

A ray from ``C`` along ``d`` that reaches the ground ``t d`` farther is moved over level ground by

    J e = A dC + t A (dtheta x d) + t A R dr         A = [I | -g],   g = d_xy / d_z

by errors of the perspective centre, of the attitude (a rotation vector) and of the measurement in the image; ``g`` is
the way of the ray a metre of height. On terrain of slope ``s`` whose height is wrong by ``h``, `on_slope` follows.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..geometry.rotation import angles_from_matrix, angles_jacobian

Array = NDArray[np.floating]

#: Smallest 1 - s'g that counts; below it the ray touches the slope. Definition.
LEAST_ANGLE = 0.02


@dataclass(frozen=True)
class GroundErrors:
    """What is wrong besides the orientation.

    Attributes
    ----------
    image_mm : sigma of a measurement in the image, each way
    height_m : sigma of the height of the ground

    Raises
    ------
    ValueError : a negative sigma, or one that is no number
    """

    image_mm: float = 0.0
    height_m: float = 0.0

    def __post_init__(self) -> None:
        if not (0 <= self.image_mm < np.inf and 0 <= self.height_m < np.inf):
            raise ValueError(f"sigmas of {self.image_mm} mm and {self.height_m} m, wanted at least 0")


def on_slope(
    e00: Array, e01: Array, e11: Array, g0: Array, g1: Array, s0: Array, s1: Array, variance: Array | float
) -> tuple[Array, Array]:
    """Variances in the plane (of both coordinates together) and of the height, m2, on sloping ground.

    The moved ray and the wrong ground meet where ``dEN = J e + g dh`` and ``dh = s' dEN + h``, so that
    ``dh = (s' J e + h) / (1 - s' g)``. Where the slope is as steep as the ray both are NaN.

    Parameters
    ----------
    e00, e01, e11 : covariance of ``J e`` over level ground, m2
    g0, g1 : way of the ray a metre of height
    s0, s1 : slope of the ground
    variance : of its height, m2
    """
    angle = 1.0 - s0 * g0 - s1 * g1
    angle = np.where(np.abs(angle) < LEAST_ANGLE, np.nan, angle)
    es0, es1 = e00 * s0 + e01 * s1, e01 * s0 + e11 * s1
    height = (s0 * es0 + s1 * es1 + variance) / (angle * angle)
    plane = e00 + e11 + 2.0 * (g0 * es0 + g1 * es1) / angle + (g0 * g0 + g1 * g1) * height
    return plane, height


def sigmas_of_lines(
    position_l: Array, R_lc: Array, covariance: Array, ray_c: Array, point_l: Array, slope: Array, errors: GroundErrors
) -> Array:
    """Sigma in the plane ``sqrt(sX^2 + sY^2)`` and of the height of what lines show, metres.

    Parameters
    ----------
    position_l, R_lc : (n, 3), (n, 3, 3) orientation of each line
    covariance : (n, 6, 6) of its errors: X, Y, Z, omega, phi, kappa; m, rad
    ray_c : (k, 3) directions of some pixels, image frame, mm
    point_l : (n, k, 3) where they meet the ground, NaN where they do not
    slope : (n, k, 2) of the ground there, dZ/dX and dZ/dY
    errors : of measurement and ground

    Returns
    -------
    (n, k, 2), NaN where there is none
    """
    d = ray_c @ np.swapaxes(R_lc, 1, 2)
    g = d[..., :2] / d[..., 2:]
    t = (point_l[..., 2] - position_l[:, None, 2]) / d[..., 2]
    A = np.zeros((*d.shape[:2], 2, 3))
    A[..., 0, 0] = A[..., 1, 1] = 1.0
    A[..., 2] = -g
    axes = np.linalg.inv(angles_jacobian(angles_from_matrix(R_lc)))  # columns: rotation vector of each angle
    turned = np.cross(np.moveaxis(axes, 2, 1)[:, None], d[:, :, None, :])  # (n, k, angle, 3)
    J = np.concatenate([A, t[..., None, None] * (A @ np.swapaxes(turned, 2, 3))], axis=-1)
    E = J @ covariance[:, None] @ np.swapaxes(J, 2, 3)
    I = t[..., None, None] * (A @ R_lc[:, None, :, :2])
    E += errors.image_mm**2 * (I @ np.swapaxes(I, 2, 3))
    plane, height = on_slope(
        E[..., 0, 0], E[..., 0, 1], E[..., 1, 1], g[..., 0], g[..., 1], slope[..., 0], slope[..., 1],
        errors.height_m**2,
    )  # fmt: skip
    return np.sqrt(np.maximum(np.stack([plane, height], axis=-1), 0.0))
