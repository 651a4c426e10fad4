"""Rotations: photogrammetric and navigation angles, quaternions, small rotations. All functions are vectorised.

Angles, products, inverses and rotation vectors of quaternions are own code, because SciPy's Rotation takes up to 20
times as long, for one rotation and for a thousand (``python bench/rotation.py``); the rest is SciPy's.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.floating]

#: body (forward-right-down) <- image (forward-left-up), without boresight.
R_BC_NOMINAL: Array = np.diag([1.0, -1.0, -1.0])
#: local east-north-up <- north-east-down, both at the same place.
R_ENU_NED: Array = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])


def matrix_from_angles(omega: ArrayLike, phi: ArrayLike, kappa: ArrayLike) -> Array:
    """Image-to-object rotation ``R_lc = Rx(omega) Ry(phi) Rz(kappa)`` [K A.20].

    Parameters
    ----------
    omega, phi, kappa : (...) radians

    Returns
    -------
    (..., 3, 3)
    """
    so, co = np.sin(omega), np.cos(omega)
    sp, cp = np.sin(phi), np.cos(phi)
    sk, ck = np.sin(kappa), np.cos(kappa)
    R = np.empty((*np.broadcast_shapes(np.shape(so), np.shape(sp), np.shape(sk)), 3, 3))
    R[..., 0, 0] = cp * ck
    R[..., 0, 1] = -cp * sk
    R[..., 0, 2] = sp
    R[..., 1, 0] = co * sk + so * sp * ck
    R[..., 1, 1] = co * ck - so * sp * sk
    R[..., 1, 2] = -so * cp
    R[..., 2, 0] = so * sk - co * sp * ck
    R[..., 2, 1] = so * ck + co * sp * sk
    R[..., 2, 2] = co * cp
    return R


def turned_tilt(omega: ArrayLike, phi: ArrayLike, turn: ArrayLike) -> tuple[Array, Array]:
    """Omega and phi of a camera (...) that is turned about the vertical by ``turn`` radians.

    Of a tilt of 6 deg, turned by 3 deg, 2e-5 rad are left out.
    """
    o, p, s, c = np.asarray(omega), np.asarray(phi), np.sin(turn), np.cos(turn)
    return c * o - s * p, s * o + c * p


def corrected_angles(measured: Array, correction: Array) -> Array:
    """Measured omega, phi, kappa (n, 3) with corrections (n, 3) of an inertial system.

    The heading of an inertial system is wrong about the vertical, so that its omega and phi, right about level axes,
    are told in axes that are turned: kappa's correction turns the measured tilt, and then all three are added.
    """
    angles = np.empty(measured.shape)
    angles[:, 0], angles[:, 1] = turned_tilt(measured[:, 0], measured[:, 1], correction[:, 2])
    angles[:, 2] = measured[:, 2]
    angles += correction
    return angles


def measured_angles(true: Array, error: Array) -> Array:
    """Omega, phi, kappa (n, 3) as measured with errors (n, 3); `corrected_angles` with minus the errors goes back."""
    wrong = true + error
    omega, phi = turned_tilt(wrong[:, 0], wrong[:, 1], error[:, 2])
    return np.stack([omega, phi, wrong[:, 2]], axis=1)


def angles_from_matrix(R_lc: ArrayLike) -> Array:
    """Angles ``(omega, phi, kappa)`` in radians, shape (..., 3), of rotations (..., 3, 3); phi in [-pi/2, pi/2]."""
    R = np.asarray(R_lc, dtype=float)
    omega = np.arctan2(-R[..., 1, 2], R[..., 2, 2])
    phi = np.arcsin(np.minimum(np.maximum(R[..., 0, 2], -1.0), 1.0))
    kappa = np.arctan2(-R[..., 0, 1], R[..., 0, 0])
    return np.stack([omega, phi, kappa], axis=-1)


def angles_jacobian(angles: ArrayLike) -> Array:
    """Derivative of (omega, phi, kappa) with respect to a small rotation vector ``theta_l`` in the local frame.

    ``R' = exp([theta_l]) R`` changes the angles by ``J @ theta_l``. ``inv(J)`` has the three rotation axes as columns.

    Parameters
    ----------
    angles : (..., 3) radians

    Returns
    -------
    J : (..., 3, 3)
    """
    a = np.asarray(angles, dtype=float)
    so, co = np.sin(a[..., 0]), np.cos(a[..., 0])
    sp, cp = np.sin(a[..., 1]), np.cos(a[..., 1])
    # the inverse of [1 0 sp; 0 co -so cp; 0 so co cp], the axes of the three turns
    J = np.zeros((*a.shape[:-1], 3, 3))
    J[..., 0, 0] = 1.0
    J[..., 0, 1] = so * sp / cp
    J[..., 0, 2] = -co * sp / cp
    J[..., 1, 1] = co
    J[..., 1, 2] = so
    J[..., 2, 1] = -so / cp
    J[..., 2, 2] = co / cp
    return J


def matrix_from_navigation(roll: ArrayLike, pitch: ArrayLike, heading: ArrayLike) -> Array:
    """``R_nb = Rz(heading) Ry(pitch) Rx(roll)``, body forward-right-down to north-east-down; radians, (..., 3, 3)."""
    sr, cr = np.sin(roll), np.cos(roll)
    sp, cp = np.sin(pitch), np.cos(pitch)
    sh, ch = np.sin(heading), np.cos(heading)
    R = np.empty((*np.broadcast_shapes(np.shape(sr), np.shape(sp), np.shape(sh)), 3, 3))
    R[..., 0, 0] = ch * cp
    R[..., 0, 1] = ch * sp * sr - sh * cr
    R[..., 0, 2] = ch * sp * cr + sh * sr
    R[..., 1, 0] = sh * cp
    R[..., 1, 1] = sh * sp * sr + ch * cr
    R[..., 1, 2] = sh * sp * cr - ch * sr
    R[..., 2, 0] = -sp
    R[..., 2, 1] = cp * sr
    R[..., 2, 2] = cp * cr
    return R


def navigation_from_matrix(R_nb: ArrayLike) -> Array:
    """``(roll, pitch, heading)`` in radians, shape (..., 3); heading in [0, 2 pi)."""
    R = np.asarray(R_nb, dtype=float)
    roll = np.arctan2(R[..., 2, 1], R[..., 2, 2])
    pitch = np.arcsin(np.clip(-R[..., 2, 0], -1.0, 1.0))
    heading = np.arctan2(R[..., 1, 0], R[..., 0, 0]) % (2 * np.pi)
    return np.stack([roll, pitch, heading], axis=-1)


def skew(v: ArrayLike) -> Array:
    """Cross-product matrix: ``skew(a) @ b = a x b``; (..., 3) to (..., 3, 3)."""
    v = np.asarray(v, dtype=float)
    S = np.zeros((*v.shape, 3))
    S[..., 0, 1], S[..., 0, 2] = -v[..., 2], v[..., 1]
    S[..., 1, 0], S[..., 1, 2] = v[..., 2], -v[..., 0]
    S[..., 2, 0], S[..., 2, 1] = -v[..., 1], v[..., 0]
    return S


def cross(a: Array, b: Array) -> Array:
    """Cross product of (..., 3); several times faster than `numpy.cross` on short arrays."""
    out = np.empty(a.shape if a.shape == b.shape else np.broadcast_shapes(a.shape, b.shape))
    out[..., 0] = a[..., 1] * b[..., 2] - a[..., 2] * b[..., 1]
    out[..., 1] = a[..., 2] * b[..., 0] - a[..., 0] * b[..., 2]
    out[..., 2] = a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
    return out


def quaternion_multiply(p: ArrayLike, q: ArrayLike) -> Array:
    """Product of scalar-last quaternions, (..., 4): the rotation ``q`` first, then ``p``."""
    p, q = np.asarray(p, dtype=float), np.asarray(q, dtype=float)
    x1, y1, z1, w1 = p[..., 0], p[..., 1], p[..., 2], p[..., 3]
    x2, y2, z2, w2 = q[..., 0], q[..., 1], q[..., 2], q[..., 3]
    out = np.empty(np.broadcast_shapes(p.shape, q.shape))
    out[..., 0] = w1 * x2 + x1 * w2 + y1 * z2 - z1 * y2
    out[..., 1] = w1 * y2 - x1 * z2 + y1 * w2 + z1 * x2
    out[..., 2] = w1 * z2 + x1 * y2 - y1 * x2 + z1 * w2
    out[..., 3] = w1 * w2 - x1 * x2 - y1 * y2 - z1 * z2
    return out


def multiply_plain(p: Sequence[float], q: Sequence[float]) -> tuple[float, float, float, float]:
    """The same of two quaternions as plain numbers: 0.6 us, with SciPy's Rotation 24 us."""
    x1, y1, z1, w1 = p
    x2, y2, z2, w2 = q
    return (
        w1 * x2 + x1 * w2 + y1 * z2 - z1 * y2,
        w1 * y2 - x1 * z2 + y1 * w2 + z1 * x2,
        w1 * z2 + x1 * y2 - y1 * x2 + z1 * w2,
        w1 * w2 - x1 * x2 - y1 * y2 - z1 * z2,
    )


def quaternion_conjugate(q: ArrayLike) -> Array:
    """Inverse (..., 4) of unit quaternions (..., 4), scalar last."""
    return np.asarray(q, dtype=float) * np.array([-1.0, -1.0, -1.0, 1.0])


def quaternion_from_vector(theta: ArrayLike) -> Array:
    """Unit quaternion ``xyzw`` of a rotation vector, (..., 3) to (..., 4); exact and smooth at zero."""
    from scipy.spatial.transform import Rotation

    theta = np.asarray(theta, dtype=float)
    return Rotation.from_rotvec(theta.reshape(-1, 3)).as_quat().reshape(*theta.shape[:-1], 4)


def vector_from_quaternion(q: ArrayLike) -> Array:
    """Rotation vectors (..., 3), radians, of unit quaternions ``xyzw`` (..., 4); of length at most pi."""
    q = np.asarray(q, dtype=float)
    q = np.where(q[..., 3:] < 0, -q, q)
    sine = np.linalg.norm(q[..., :3], axis=-1, keepdims=True)
    angle = 2 * np.arctan2(sine, q[..., 3:])
    small = sine < 1e-9
    return np.where(small, 2.0, angle / np.where(small, 1.0, sine)) * q[..., :3]


def matrix_from_quaternion(q: ArrayLike) -> Array:
    """Rotation matrices (..., 3, 3) of quaternions ``xyzw``, which are brought to unit length.

    Raises
    ------
    ValueError : a quaternion without a length
    """
    from scipy.spatial.transform import Rotation

    q = np.asarray(q, dtype=float)
    return Rotation.from_quat(q.reshape(-1, 4)).as_matrix().reshape(*q.shape[:-1], 3, 3)


def quaternion_from_angles(angles: ArrayLike) -> Array:
    """Unit quaternions ``xyzw`` of ``Rx(omega) Ry(phi) Rz(kappa)``, (..., 3) to (..., 4); the scalar part not negative.

    As `quaternion_from_matrix` of `matrix_from_angles`, without the matrices.
    """
    half = 0.5 * np.moveaxis(np.asarray(angles, dtype=float), -1, 0)
    (so, sp, sk), (co, cp, ck) = np.sin(half), np.cos(half)
    a, b, c, d = co * cp, so * sp, so * cp, co * sp
    q = np.stack([c * ck + d * sk, d * ck - c * sk, a * sk + b * ck, a * ck - b * sk], axis=-1)
    return np.where(q[..., 3:] < 0, -q, q)


def quaternion_from_matrix(R: ArrayLike) -> Array:
    """Unit quaternions ``xyzw`` with a non-negative scalar part, (..., 3, 3) to (..., 4).

    The matrices have to be rotations: a check of that would take four times as long as the conversion of one.
    """
    from scipy.spatial.transform import Rotation

    R = np.asarray(R, dtype=float)
    q = Rotation.from_matrix(R.reshape(-1, 3, 3), assume_valid=True).as_quat().reshape(*R.shape[:-2], 4)
    return np.where(q[..., 3:] < 0, -q, q)
