"""Strapdown mechanisation on the ellipsoid, block by block.

Over a block (a fraction of a second) the inertial data are integrated once in the body axes of the block's start, which
needs neither position nor attitude::

    R(t) = body(t) -> body(start)      v(t) = int R f dt      p(t) = int v dt

The rest is exact in the non-rotating frame *i* that coincides with the Earth-fixed one at the start of the block::

    v_i(t) = v_i(0) + R_ib v(t) + int gamma dt       r_i(t) = r_i(0) + v_i(0) t + R_ib p(t) + int int gamma dt dt

with ``gamma`` the gravitation (normal gravity less centrifugal acceleration). Turning the result by the Earth's
rotation over the block gives it in the Earth-fixed frame: Earth rate, Coriolis and transport rate are in that, without
approximation and without a singular latitude. All integrals of a block are sums over arrays, hence fast.

To first order, the integrals depend on sensor errors ``x = (bias, scale factor)`` through Jacobians that are integrated
alongside. Measured = true (1 + scale) + bias.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate

import numpy as np
from numpy.typing import NDArray

from ..geometry import earth
from ..geometry.rotation import cross, matrix_from_quaternion, multiply_plain, quaternion_from_vector, skew
from .inertial_data import InertialData

Array = NDArray[np.floating]

_EYE = np.eye(3)
#: Pieces up to which the rotations of one block are multiplied as plain numbers. Tuned.
PLAIN = 150
#: Rotation of the Earth in axes fixed to it, rad/s.
OMEGA_IE = np.array([0.0, 0.0, earth.ROTATION_RATE])
_OMEGA_X = skew(OMEGA_IE)
#: Rotation squared, rad^2/s^2; semi-minor axis, m; second eccentricity squared; ratio of centrifugal force to gravity.
_WIE2 = earth.ROTATION_RATE**2
_B = earth.SEMI_MAJOR_M * (1.0 - earth.FLATTENING)
_EP2 = earth.ECCENTRICITY2 / (1.0 - earth.ECCENTRICITY2)
_M = _WIE2 * earth.SEMI_MAJOR_M**3 * (1.0 - earth.FLATTENING) / earth.GM


def gravitation_e(position_e: Array) -> Array:
    """Gravitation (3,), m/s^2, at an Earth-fixed position (3,), m: normal gravity less the centrifugal acceleration.

    Scalar arithmetic, because it is called twice a block; the same as `earth.gravity_n`.
    """
    x, y, z = position_e.tolist()
    p = math.hypot(x, y)
    a, e2, f = earth.SEMI_MAJOR_M, earth.ECCENTRICITY2, earth.FLATTENING
    beta = math.atan2(z * a, p * _B)
    s = c = 0.0
    for _ in range(2):
        sb, cb = math.sin(beta), math.cos(beta)
        lat = math.atan2(z + _EP2 * _B * sb**3, p - e2 * a * cb**3)
        s, c = math.sin(lat), math.cos(lat)
        beta = math.atan2((1.0 - f) * s, c)
    s2 = s * s
    w = math.sqrt(1.0 - e2 * s2)
    h = (p * c + z * s - a / w * (1.0 - e2 * s2)) / a
    g = earth.GRAVITY_EQUATOR * (1.0 + earth.SOMIGLIANA_K * s2) / w
    g *= 1.0 - 2.0 * (1.0 + f + _M - 2.0 * f * s2) * h + 3.0 * h * h
    north = -2.0 * earth.GRAVITY_LEAN * earth.SEMI_MAJOR_M * h * s * c
    k = (g * c + north * s) / p if p > 0.0 else 0.0
    return np.array([-(k + _WIE2) * x, -(k + _WIE2) * y, north * c - g * s])


@dataclass(slots=True)
class IncrementBlock:
    """Integrals over a block, in the body axes of its start.

    ``k`` is 3 (biases) or 6 (biases, scale factors).

    Attributes
    ----------
    duration_s : length
    R : (3, 3) body at the end to body at the start
    v, p : (3,) integral of the turned specific force, and the integral of that
    A : (3, k) integral of the turned unit (and rate): what a gyro error turns
    B : (3, k) the same of unit and specific force: what an accelerometer error does to ``v``
    Jv, Jp : (3, k) derivative of ``v`` and ``p`` with respect to the gyro errors
    Bp : (3, k) integral of ``B``
    gyro_variance, accel_variance : additional variance of made-up samples, rad^2 and (m/s)^2
    """

    duration_s: float
    R: Array
    v: Array
    p: Array
    A: Array
    B: Array
    Jv: Array
    Jp: Array
    Bp: Array
    gyro_variance: float = 0.0
    accel_variance: float = 0.0

    def then(self, b: IncrementBlock) -> IncrementBlock:
        """Integrals over this block and the one that follows it."""
        R, vb, pb, T = self.R, self.R @ b.v, self.R @ b.p, b.duration_s
        RB = R @ b.B
        return IncrementBlock(
            self.duration_s + T,
            R @ b.R,
            self.v + vb,
            self.p + T * self.v + pb,
            self.A + R @ b.A,
            self.B + RB,
            self.Jv + skew(vb) @ self.A + R @ b.Jv,
            self.Jp + T * self.Jv + skew(pb) @ self.A + R @ b.Jp,
            self.Bp + T * self.B + R @ b.Bp,
            self.gyro_variance + b.gyro_variance,
            self.accel_variance + b.accel_variance,
        )

    @classmethod
    def empty(cls, k: int = 3) -> IncrementBlock:
        z = np.zeros
        return cls(0.0, np.eye(3), z(3), z(3), z((3, k)), z((3, k)), z((3, k)), z((3, k)), z((3, k)))

    def for_errors(self, gyro: Array, accel: Array) -> tuple[Array, Array, Array]:
        """``(R, v, p)`` for sensor errors (k,) that differ by so much from those taken off in the integration."""
        turn = rotation_matrix(-(self.A @ gyro))
        return turn @ self.R, self.v + self.Jv @ gyro - self.B @ accel, self.p + self.Jp @ gyro - self.Bp @ accel


@dataclass(frozen=True)
class Integrals:
    """Integrals of many blocks: the running values at every piece, and the totals.

    Attributes
    ----------
    duration_s : (b, m) time since the start of the block at the end of each piece
    quaternion, v, p : (b, m, 4), (b, m, 3), (b, m, 3) running values
    R, A, B, Jv : (b, m, 3, 3), (b, m, 3, k) the same of the others (see `IncrementBlock`)
    Jp, Bp : (b, m, 3, k) what each piece adds to the totals
    variances : (b, m, 2) the same of gyro and accelerometer variance
    blocks : the totals
    """

    duration_s: Array
    quaternion: Array
    v: Array
    p: Array
    R: Array
    A: Array
    B: Array
    Jv: Array
    Jp: Array
    Bp: Array
    variances: Array
    blocks: list[IncrementBlock]

    def running(self, ends: Sequence[int]) -> list[IncrementBlock]:
        """Integrals of the first block from its start to several ends (numbers of pieces)."""
        Jp, Bp, variances = (np.cumsum(x[0], axis=0) for x in (self.Jp, self.Bp, self.variances))
        durations, noise = self.duration_s[0].tolist(), variances.tolist()
        R, v, p, A, B, Jv = (x[0] for x in (self.R, self.v, self.p, self.A, self.B, self.Jv))
        return [
            IncrementBlock(durations[i], R[i], v[i], p[i], A[i], B[i], Jv[i], Jp[i], Bp[i], *noise[i])
            for i in (end - 1 for end in ends)
        ]


def integrate(
    dt: Array,
    phi: Array,
    dv: Array,
    scale_factors: bool = False,
    gyro_psd: Array | None = None,
    accel_psd: Array | None = None,
) -> Integrals:
    """Integrals of blocks of pieces.

    Parameters
    ----------
    dt : (b, m) lengths, s; blocks with fewer pieces end with zeros
    phi, dv : (b, m, 3) rotation vectors and velocity increments, corrected for coning and sculling
    scale_factors : whether Jacobians include scale factors
    gyro_psd, accel_psd : (b, m) additional noise density, rad^2/s and (m/s)^2/s
    """
    q = running_product(quaternion_from_vector(phi))
    R_end = matrix_from_quaternion(q)
    R = np.empty_like(R_end)  # at the start of each piece
    R[:, 0], R[:, 1:] = _EYE, R_end[:, :-1]
    # within a piece rate and force are constant
    turned = cross(phi, dv)
    df = _apply(R, dv + 0.5 * turned + cross(phi, turned) / 6.0)
    dp = _apply(R, dv / 2.0 + turned / 6.0)
    v = np.cumsum(df, axis=1)
    t = dt[..., None]
    p = np.cumsum((v - df) * t + dp * t, axis=1)
    M = R + 0.5 * (R @ skew(phi))  # mean attitude over the piece
    A, B = M * t[..., None], M * t[..., None]
    if scale_factors:
        A = np.concatenate([A, M * phi[..., None, :]], axis=-1)
        B = np.concatenate([B, M * dv[..., None, :]], axis=-1)
    At, Bt = np.cumsum(A, axis=1), np.cumsum(B, axis=1)
    J = skew(df) @ (At - 0.5 * A)
    Jt = np.cumsum(J, axis=1)
    T = t[..., None]
    dJp, dBp = (Jt - 0.5 * J) * T, (Bt - 0.5 * B) * T
    Jp, Bp = dJp.sum(axis=1), dBp.sum(axis=1)
    duration = np.cumsum(dt, axis=1)
    n = len(dt)
    variances = np.zeros((*dt.shape, 2))
    for i, psd in enumerate((gyro_psd, accel_psd)):
        if psd is not None:
            variances[:, :, i] = psd * dt
    vg, va = variances.sum(axis=1).T
    blocks = [
        IncrementBlock(
            float(duration[i, -1]),
            R_end[i, -1],
            v[i, -1],
            p[i, -1],
            At[i, -1],
            Bt[i, -1],
            Jt[i, -1],
            Jp[i],
            Bp[i],
            float(vg[i]),
            float(va[i]),
        )
        for i in range(n)
    ]
    return Integrals(duration, q, v, p, R_end, At, Bt, Jt, dJp, dBp, variances, blocks)


def integrate_one(pieces: InertialData, gyro: Array, accel: Array) -> IncrementBlock:
    """Integrals over one block of pieces (corrected), with sensor errors (k,) taken off."""
    return _integrated(pieces, gyro, accel).blocks[0]


def integrate_to(pieces: InertialData, ends: Sequence[int], gyro: Array, accel: Array) -> list[IncrementBlock]:
    """The same from the start of the pieces to each of several ends (numbers of pieces)."""
    return _integrated(pieces, gyro, accel).running(ends)


def _integrated(pieces: InertialData, gyro: Array, accel: Array) -> Integrals:
    phi, dv = without_errors(pieces, gyro, accel)
    psd = pieces.gyro_psd[None], pieces.accel_psd[None]
    return integrate(pieces.dt_s[None], phi[None], dv[None], len(gyro) == 6, *psd)


def without_errors(pieces: InertialData, gyro: Array, accel: Array) -> tuple[Array, Array]:
    """Rotation vectors and velocity increments (n, 3) after taking off biases and scale factors."""
    t = pieces.dt_s[:, None]
    phi, dv = pieces.dtheta - t * gyro[:3], pieces.dv - t * accel[:3]
    if len(gyro) == 6:
        phi, dv = phi / (1.0 + gyro[3:]), dv / (1.0 + accel[3:])
    return phi, dv


def running_product(q: Array) -> Array:
    """Products ``q_0 q_1 ... q_k`` along the last but one axis, (..., m, 4), by doubling: log2(m) vectorised steps.

    Those of one short block are made one after the other of plain numbers, in a sixth of the time of forty.
    """
    if len(q) == 1 and q.ndim == 3 and q.shape[1] <= PLAIN:
        return np.array([list(accumulate(q[0].tolist(), multiply_plain))])
    out = np.ascontiguousarray(np.moveaxis(q, -1, 0))
    step, m = 1, q.shape[-2]
    while step < m:
        x1, y1, z1, w1 = out[..., :-step]
        x2, y2, z2, w2 = out[..., step:]
        new = out.copy()
        new[0, ..., step:] = w1 * x2 + x1 * w2 + y1 * z2 - z1 * y2
        new[1, ..., step:] = w1 * y2 - x1 * z2 + y1 * w2 + z1 * x2
        new[2, ..., step:] = w1 * z2 + x1 * y2 - y1 * x2 + z1 * w2
        new[3, ..., step:] = w1 * w2 - x1 * x2 - y1 * y2 - z1 * z2
        out = new
        step *= 2
    return np.moveaxis(out, 0, -1)


def _apply(R: Array, v: Array) -> Array:
    return (R @ v[..., None])[..., 0]


def rotation_matrix(theta: Array) -> Array:
    """Rotation matrix (3, 3) of one rotation vector (3,); a seventh of SciPy's time (``python bench/rotation.py``)."""
    x, y, z = theta.tolist()
    n2 = x * x + y * y + z * z
    if n2 < 1e-8:
        s, c = 1.0 - n2 / 6.0, 0.5 - n2 / 24.0
    else:
        n = math.sqrt(n2)
        s, c = math.sin(n) / n, (1.0 - math.cos(n)) / n2
    return np.array(
        [
            [1.0 - c * (y * y + z * z), c * x * y - s * z, c * x * z + s * y],
            [c * x * y + s * z, 1.0 - c * (x * x + z * z), c * y * z - s * x],
            [c * x * z - s * y, c * y * z + s * x, 1.0 - c * (x * x + y * y)],
        ]
    )


@dataclass(slots=True)
class State:
    """Position, velocity and attitude, Earth-fixed.

    Attributes
    ----------
    r_e, v_e : (3,) metres, m/s relative to the Earth
    R_eb : (3, 3) body to Earth-fixed
    """

    r_e: Array
    v_e: Array
    R_eb: Array


def earth_rotation(duration_s: float) -> Array:
    """Non-rotating frame (Earth-fixed at the start) to Earth-fixed after so many seconds, (3, 3)."""
    a = earth.ROTATION_RATE * duration_s
    c, s = math.cos(a), math.sin(a)
    return np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])


def propagate(state: State, duration_s: float, R: Array, v: Array, p: Array) -> State:
    """State at the end of a block from the one at its start and the block's ``R, v, p`` (see the module's page)."""
    T = duration_s
    C = earth_rotation(T)
    r0, R_ib = state.r_e, state.R_eb
    v0 = state.v_e + cross(OMEGA_IE, r0)
    gamma0 = gravitation_e(r0)
    ballistic = r0 + T * v0 + R_ib @ p
    gamma1 = C.T @ gravitation_e(C @ (ballistic + (0.5 * T * T) * gamma0))
    # linear between both ends, less the curvature that the Earth's rotation gives it
    curvature = cross(OMEGA_IE, cross(OMEGA_IE, gamma0))
    r1 = C @ (ballistic + (T * T / 6.0) * (2.0 * gamma0 + gamma1) - (T**4 / 24.0) * curvature)
    v1 = C @ (v0 + R_ib @ v + (0.5 * T) * (gamma0 + gamma1) - (T**3 / 12.0) * curvature) - cross(OMEGA_IE, r1)
    R1 = C @ R_ib @ R
    R1 = 0.5 * (R1 @ (3.0 * _EYE - R1.T @ R1))  # keeps it a rotation over hours
    return State(r1, v1, R1)


def transition(state: State, block: IncrementBlock) -> Array:
    """Transition matrix of the errors ``(dr, dv, psi, gyro errors, accelerometer errors)`` over a block.

    ``r = r_hat + dr``, ``v = v_hat + dv`` (Earth-fixed), ``R_eb = exp([psi]) R_eb_hat``; exact to first order but for
    the gradient of gravitation, which is that of a sphere. Sensor errors are taken as constant over the block.

    Returns
    -------
    (9 + 2k, 9 + 2k)
    """
    T, R_ib = block.duration_s, state.R_eb
    k = block.A.shape[1]
    C = earth_rotation(T)
    r = state.r_e
    r2 = float(r @ r)
    gradient = (-earth.GM / (r2 * math.sqrt(r2))) * (_EYE - (3.0 / r2) * np.outer(r, r))
    F = np.eye(9 + 2 * k)
    i_v, i_a, i_g, i_f = slice(3, 6), slice(6, 9), slice(9, 9 + k), slice(9 + k, 9 + 2 * k)
    CR = C @ R_ib
    # in the non-rotating frame, then turned: dv_i = dv_e + omega x dr_e at both ends
    rr = _EYE + T * _OMEGA_X + (0.5 * T * T) * gradient
    vr = _OMEGA_X + T * gradient
    top = np.empty((3, 9 + 2 * k))
    top[:, :3], top[:, i_v], top[:, i_a] = C @ rr, T * C, -C @ skew(R_ib @ block.p)
    top[:, i_g], top[:, i_f] = CR @ block.Jp, -(CR @ block.Bp)
    F[:3] = top
    F[i_v, :3], F[i_v, i_v], F[i_v, i_a] = C @ vr, C, -C @ skew(R_ib @ block.v)
    F[i_v, i_g], F[i_v, i_f] = CR @ block.Jv, -(CR @ block.B)
    F[i_v] -= _OMEGA_X @ top
    F[i_a, i_a] = C
    F[i_a, i_g] = -(CR @ block.A)
    return F


def process_noise(state: State, block: IncrementBlock, gyro_psd: float, accel_psd: float) -> Array:
    """Covariance (9, 9) that white noise of gyros and accelerometers adds over a block; force taken as constant.

    Parameters
    ----------
    gyro_psd : rad^2/s
    accel_psd : (m/s)^2/s
    """
    T = block.duration_s
    Q = np.zeros((9, 9))
    if T <= 0.0:
        return Q
    Sg, Sa = gyro_psd + block.gyro_variance / T, accel_psd + block.accel_variance / T
    a = earth_rotation(T) @ (state.R_eb @ block.v) / T
    X = skew(a)
    XX = -(X @ X)
    Q[:3, :3] = (Sa * T**3 / 3.0) * _EYE + (Sg * T**5 / 20.0) * XX
    Q[:3, 3:6] = (Sa * T**2 / 2.0) * _EYE + (Sg * T**4 / 8.0) * XX
    Q[:3, 6:] = (-Sg * T**3 / 6.0) * X
    Q[3:6, 3:6] = (Sa * T) * _EYE + (Sg * T**3 / 3.0) * XX
    Q[3:6, 6:] = (-Sg * T**2 / 2.0) * X
    Q[6:, 6:] = (Sg * T) * _EYE
    Q[3:6, :3], Q[6:, :3], Q[6:, 3:6] = Q[:3, 3:6].T, Q[:3, 6:].T, Q[3:6, 6:].T
    return Q
