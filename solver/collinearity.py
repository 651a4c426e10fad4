"""The modified collinearity equations: object point to image point and its derivatives [K 4.4-4.7]."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .rotation import matrix_from_angles

Array = NDArray[np.floating]


@dataclass(frozen=True)
class Projection:
    """Projected image points and what they depend on; n rays.

    Attributes
    ----------
    xy_mm : (n, 2) ``-c fx/fz, -c fy/fz``, before additional parameters
    d_orientation : (n, 2, 6) derivative to X0, Y0, Z0 [mm/m], omega, phi, kappa [mm/rad]
    d_point : (n, 2, 3) derivative to the object point [mm/m]
    in_front : (n,) whether the point lies below the camera
    """

    xy_mm: Array
    d_orientation: Array
    d_point: Array
    in_front: NDArray[np.bool_]


def project(position_l: Array, angles: Array, point_l: Array, focal_length_mm: Array) -> Projection:
    """Project object points through orientations.

    Parameters
    ----------
    position_l, angles : (n, 3) orientation of each ray (metres; omega, phi, kappa in radians)
    point_l : (n, 3) object point of each ray, metres
    focal_length_mm : (n,)
    """
    R = matrix_from_angles(angles[:, 0], angles[:, 1], angles[:, 2])
    d = point_l - position_l
    f = np.einsum("nji,nj->ni", R, d)
    c = focal_length_mm
    inv = 1.0 / f[:, 2]
    xy = -(c * inv)[:, None] * f[:, :2]

    d_f = np.zeros((len(d), 2, 3))  # of (x, y) to f
    d_f[:, 0, 0] = d_f[:, 1, 1] = -c * inv
    d_f[:, 0, 2] = -xy[:, 0] * inv
    d_f[:, 1, 2] = -xy[:, 1] * inv
    d_point = d_f @ np.swapaxes(R, 1, 2)

    # f = Rz(-k) Ry(-p) Rx(-o) d: each angle turns d about its own axis
    so, co = np.sin(angles[:, 0]), np.cos(angles[:, 0])
    f_angles = np.empty((len(d), 3, 3))
    zero = np.zeros_like(so)
    dd_omega = np.stack([zero, d[:, 2], -d[:, 1]], axis=1)  # of Rx(-omega) d, turned back to the local frame
    f_angles[:, :, 0] = np.einsum("nji,nj->ni", R, dd_omega)
    axis_phi = np.stack([zero, co, so], axis=1)
    f_angles[:, :, 1] = np.einsum("nji,nj->ni", R, np.cross(d, axis_phi))
    f_angles[:, 0, 2] = f[:, 1]
    f_angles[:, 1, 2] = -f[:, 0]
    f_angles[:, 2, 2] = 0.0

    d_orientation = np.empty((len(d), 2, 6))
    d_orientation[:, :, :3] = -d_point
    d_orientation[:, :, 3:] = d_f @ f_angles
    return Projection(xy, d_orientation, d_point, f[:, 2] < 0)


def image_motion(d_orientation: Array, velocity_l: Array, angle_rate: Array) -> Array:
    """Image motion (n, 2) in mm/s of a ground point: platform velocity and attitude rate through the projection."""
    return np.einsum("nij,nj->ni", d_orientation[:, :, :3], velocity_l) + np.einsum(
        "nij,nj->ni", d_orientation[:, :, 3:], angle_rate
    )
