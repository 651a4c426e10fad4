"""Fit of inertial and GNSS data over a window, however wrong the first attitude.

In the non-rotating frame that is Earth-fixed at ``t0`` (see `strapdown`), the antenna at the fixes ``t0 + tau`` is at::

    r(tau) - int int gamma = r0 + v0 tau + R0 (p(tau) + R(tau) lever_arm)

with the body integrals ``p, R`` known from inertial data alone. That is a straight line plus a rotated curve: with the
line taken out, ``R0`` is the rotation between two sets of vectors (orthogonal Procrustes, Wahba's problem). Then
Gauss-Newton refines everything, sensor biases included, with the full covariance of GNSS and inertial noise.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular

from ..geometry.rotation import quaternion_from_matrix, skew, vector_from_quaternion
from ..models.gauss_markov import damping_rate
from .carried import gravitation
from .error_state import NavigationSettings, bias_variances
from .filter_pass import rates_at
from .inertial_data import GnssData, InertialData, cut
from .strapdown import OMEGA_IE, IncrementBlock, earth_rotation, integrate_to, rotation_matrix

Array = NDArray[np.floating]

#: Standard deviation of the drift angle between heading and course, rad. Tuned.
COURSE_SIGMA = np.radians(12.0)
#: Mean square of normalised residuals (1 expected) above which a cause is looked for. Tuned.
SUSPICIOUS_CHI2 = 2.2


@dataclass(frozen=True)
class Curve:
    """Body integrals from ``t0`` to the m fixes of a window (see `strapdown`), and what GNSS says there."""

    tau: Array  # (m,)
    R: Array  # (m, 3, 3)
    p: Array  # (m, 3)
    v: Array
    A: Array  # (m, 3, 3)
    B: Array
    Jp: Array
    Jv: Array
    Bp: Array
    rate: Array  # (m, 3) angular rate, body
    y: Array  # (m, 3) antenna less gravitation, non-rotating frame
    covariance: Array  # (m, 3, 3) of the fixes
    velocity: Array | None  # (m, 3) antenna velocity less gravitation, non-rotating frame
    velocity_covariance: Array | None

    def until(self, m: int) -> Curve:
        columns: dict[str, Any] = {name: getattr(self, name) for name in self.__dataclass_fields__}
        part: dict[str, Any] = {name: None if c is None else c[:m] for name, c in columns.items()}
        return Curve(**part)

    def without(self, i: int) -> Curve:
        """Without one fix."""
        columns: dict[str, Any] = {name: getattr(self, name) for name in self.__dataclass_fields__}
        part: dict[str, Any] = {name: None if c is None else np.delete(c, i, axis=0) for name, c in columns.items()}
        return Curve(**part)


def curve(inertial: InertialData, gnss: GnssData, t0: float) -> Curve:
    """The curve from corrected inertial data without gaps and the fixes after ``t0``."""
    tau = gnss.time_s - t0
    pieces = cut(inertial, np.concatenate([[t0], gnss.time_s]))[0]
    middle = pieces.time_s - 0.5 * pieces.dt_s
    zero, first = np.zeros(3), int(np.searchsorted(middle, t0))
    ends = np.searchsorted(middle, gnss.time_s) - first
    later = ends[ends > 0].tolist()
    blocks = [IncrementBlock.empty()] * (len(ends) - len(later))  # of fixes before the first piece
    if later:
        blocks += integrate_to(pieces[first : first + later[-1]], later, zero, zero)
    C = np.array([earth_rotation(t).T for t in tau])  # Earth-fixed to non-rotating
    r_e = gnss.position_e
    g = _apply(C, gravitation(r_e))
    # gravitation is linear between fixes, and constant before the first
    h = np.diff(tau, prepend=0.0)[:, None]
    g0 = np.concatenate([g[:1], g[:-1]])
    G1 = np.cumsum(h * (g0 + g) / 2.0, axis=0)
    G2 = np.cumsum(h * (G1 - h * (g0 + g) / 2.0) + h**2 * (2.0 * g0 + g) / 6.0, axis=0)
    velocity = covariance_v = None
    v_e, s_v = gnss.velocity_e, gnss.sigma_velocity_n
    if v_e is not None and s_v is not None and np.isfinite(v_e).all():
        velocity = _apply(C, v_e + np.cross(OMEGA_IE, r_e)) - G1
        A = C @ gnss.R_en * s_v[:, None, :]
        covariance_v = A @ np.swapaxes(A, -1, -2)
    P = C @ gnss.covariance_e() @ np.swapaxes(C, -1, -2)
    names = ("R", "p", "v", "A", "B", "Jp", "Jv", "Bp")
    integrals: dict[str, Array] = {name: np.array([getattr(b, name) for b in blocks]) for name in names}
    return Curve(
        tau,
        rate=rates_at(inertial, gnss.time_s),
        y=_apply(C, r_e) - G2,
        covariance=P,
        velocity=velocity,
        velocity_covariance=covariance_v,
        **integrals,
    )


def _apply(R: Array, v: Array) -> Array:
    return (R @ v[..., None])[..., 0]


def wahba(c: Curve, settings: NavigationSettings) -> Array:
    """``R0`` (3, 3) from the curve with the best straight line taken out of both sides; biases neglected."""
    arm = np.asarray(settings.lever_arm_b)
    w = 1.0 / np.sqrt(np.einsum("mii->m", c.covariance) / 3.0)
    x = c.p + c.R @ arm
    X, Y = x * w[:, None], c.y * w[:, None]
    D = np.column_stack([w, w * c.tau])
    if c.velocity is not None and c.velocity_covariance is not None:
        wv = 1.0 / np.sqrt(np.einsum("mii->m", c.velocity_covariance) / 3.0)
        X = np.vstack([X, wv[:, None] * (c.v + _apply(c.R, np.cross(c.rate, arm)))])
        Y = np.vstack([Y, wv[:, None] * c.velocity])
        D = np.vstack([D, np.column_stack([0.0 * wv, wv])])
    Q = np.linalg.qr(D)[0]
    X, Y = X - Q @ (Q.T @ X), Y - Q @ (Q.T @ Y)
    U, _, Vt = np.linalg.svd(Y.T @ X)
    return U @ np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))]) @ Vt


def _noise(c: Curve, settings: NavigationSettings, down_i: Array) -> Array:
    """Covariance of all observations of the curve: GNSS noise, and the inertial noise that is common to later fixes."""
    g, t = settings.grade, c.tau
    m = len(t)
    lo, hi = np.minimum.outer(t, t), np.maximum.outer(t, t)
    d = hi - lo
    level = np.eye(3) - np.outer(down_i, down_i)  # a tilt moves the level components
    Sa, Sg = g.accel_noise**2, g.gyro_noise**2 * 9.8**2
    pp_a = lo**2 * (3.0 * hi - lo) / 6.0
    # int_0^lo ((lo - s)^2 / 2) ((hi - s)^2 / 2) ds with u = lo - s
    pp_g = (lo**5 / 5.0 + d * lo**4 / 2.0 + d**2 * lo**3 / 3.0) / 4.0
    K = np.einsum("ab,ij->aibj", Sa * pp_a, np.eye(3)) + np.einsum("ab,ij->aibj", Sg * pp_g, level)
    wander = float(np.mean(np.square(settings.wander_sigma_ned_m)))
    b = damping_rate(settings.wander_time_s)
    slow = wander * np.exp(-b * d)
    K = (K + np.einsum("ab,ij->aibj", slow * (1.0 + b * d), np.eye(3))).reshape(3 * m, 3 * m)
    for i in range(m):
        K[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] += c.covariance[i]
    if c.velocity is None or c.velocity_covariance is None:
        return K
    T_p, T_v = t[:, None], t[None, :]
    s = np.minimum(T_p, T_v)
    after = T_p - s
    pv_a = s * after + s**2 / 2.0  # int_0^s (T_p - u) du
    u = T_v - s
    # int_0^s ((T_p - x)^2 / 2) (T_v - x) dx, with x measured back from s
    pv_g = (s**4 / 4 + (2 * after + u) * s**3 / 3 + (after**2 + 2 * after * u) * s**2 / 2 + after**2 * u * s) / 2.0
    vv_g = lo**3 / 3.0 + d * lo**2 / 2.0
    PV = np.einsum("ab,ij->aibj", Sa * pv_a, np.eye(3)) + np.einsum("ab,ij->aibj", Sg * pv_g, level)
    VV = np.einsum("ab,ij->aibj", Sa * lo, np.eye(3)) + np.einsum("ab,ij->aibj", Sg * vv_g, level)
    PV = PV + np.einsum("ab,ij->aibj", slow * b**2 * (T_p - T_v), np.eye(3))  # derivatives
    VV = VV + np.einsum("ab,ij->aibj", slow * b**2 * (1.0 - b * d), np.eye(3))
    PV, VV = PV.reshape(3 * m, 3 * m), VV.reshape(3 * m, 3 * m)
    for i in range(m):
        VV[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] += c.velocity_covariance[i]
    return np.block([[K, PV], [PV.T, VV]])


def noise_root(c: Curve, settings: NavigationSettings) -> Array:
    """Lower Cholesky factor of the covariance of all observations of a curve."""
    return np.linalg.cholesky(_noise(c, settings, c.y[0] / -np.linalg.norm(c.y[0])))


@dataclass(frozen=True)
class WindowFit:
    """Least-squares fit of a window.

    Attributes
    ----------
    r0, v0 : (3,) non-rotating frame at the start, metres, m/s
    R0 : (3, 3) body to that frame
    gyro, accel : (3,) biases
    P : (15, 15) covariance of ``dr0, dv0, psi`` and biases
    reduced_chi2 : of the fit
    cost : weighted sum of squares
    miss : (m,) residuals of the positions over their sigmas
    """

    r0: Array
    v0: Array
    R0: Array
    gyro: Array
    accel: Array
    P: Array
    reduced_chi2: float
    cost: float
    miss: Array


def _linearised(
    c: Curve, r0: Array, v0: Array, R0: Array, gyro: Array, accel: Array, arm: Array
) -> tuple[Array, Array]:
    """The curve that the unknowns of `fit_window` predict, positions and then velocities (m or 2 m, 3), and its
    derivatives (m or 2 m, 3, 18)."""
    tau, eye = c.tau[:, None], np.broadcast_to(np.eye(3), (len(c.tau), 3, 3))
    turned = c.R @ arm
    x = (c.p + c.Jp @ gyro - c.Bp @ accel + turned) @ R0.T
    model = r0 + tau * v0 + x
    sensors = R0 @ (c.Jp + skew(turned) @ c.A), -(R0 @ c.Bp), R0 @ c.R
    J = np.concatenate([eye, tau[:, None] * eye, -skew(x), *sensors], axis=-1)
    if c.velocity is None:
        return model, J
    x = (c.v + c.Jv @ gyro - c.B @ accel + _apply(c.R, np.cross(c.rate, arm))) @ R0.T
    sensors = R0 @ c.Jv, -(R0 @ c.B), R0 @ c.R @ skew(c.rate)
    Jv = np.concatenate([0.0 * eye, eye, -skew(x), *sensors], axis=-1)
    return np.concatenate([model, v0 + x]), np.concatenate([J, Jv])


def offset_equations(c: Curve, settings: NavigationSettings, fit: WindowFit, force: Array) -> tuple[Array, Array]:
    """Equations of a fit with one more unknown: how far the clock of the fixes is behind, s.

    What gravitation and the turning Earth add to its column is a constant and a straight line, which the unknown
    position and velocity take up.

    Parameters
    ----------
    force : (m, 3) specific force at the fixes, body axes, m/s^2

    Returns
    -------
    design, off : (k, 16) derivatives by the unknowns of the fit (without lever arm) and the offset; (k,) residuals
    """
    arm = np.asarray(settings.lever_arm_b, dtype=float)
    model, J = _linearised(c, fit.r0, fit.v0, fit.R0, fit.gyro, fit.accel, arm)
    x = c.v + c.Jv @ fit.gyro - c.B @ fit.accel + _apply(c.R, np.cross(c.rate, arm))
    column, y = fit.v0 + x @ fit.R0.T, c.y
    if c.velocity is not None:
        column = np.concatenate([column, _apply(c.R, force) @ fit.R0.T])
        y = np.concatenate([y, c.velocity])
    design = np.concatenate([J[..., :15], column[..., None]], axis=-1)
    return design.reshape(-1, 16), (y - model).ravel()


def _course_equation(heading: float, forward: Array, R_ne: Array) -> tuple[Array, Array]:
    """Derivatives (1, 3) of the course by the rotation of the frame, and how far it is off (1,), in units of its sigma.

    ``forward`` is the axis of the body in north-east-down, ``heading`` the course it should have, in radians.
    """
    miss = (heading - np.arctan2(forward[1], forward[0]) + np.pi) % (2 * np.pi) - np.pi
    h2 = max(forward[0] ** 2 + forward[1] ** 2, 1e-3)
    turn = (np.array([-forward[1], forward[0], 0.0]) / h2 @ -skew(forward)) @ R_ne
    return turn[None] / COURSE_SIGMA, np.array([miss / COURSE_SIGMA])


def _least_squares(design: Array, off: Array) -> tuple[Array, Array, float]:
    """Covariance (18, 18) and correction (18,) of whitened equations, and the sum of squares before it."""
    scale = np.linalg.norm(design, axis=0)
    Q, T = np.linalg.qr(design / scale)
    T = T + np.diag(np.where(np.abs(np.diag(T)) < 1e-9, 1e-6, 0.0))
    inverse = np.linalg.inv(T) / scale[:, None]
    return inverse @ inverse.T, inverse @ (Q.T @ off), float(off @ off)


def fit_window(
    c: Curve,
    settings: NavigationSettings,
    R0: Array,
    root: Array,
    prior: tuple[Array, Array] | None = None,
    course: tuple[int, float] | None = None,
    R_ne: Array | None = None,
    rounds: int = 12,
    arm_sigma_m: float | None = None,
) -> WindowFit:
    """Gauss-Newton fit of position, velocity, attitude and biases at the start of a window.

    Parameters
    ----------
    R0 : (3, 3) first approximation of the attitude
    root : lower Cholesky factor of the covariance of all observations
    prior : attitude (3, 3) known beforehand with the covariance (3, 3) of its rotation error in the same axes
    course : index of a fix, heading there (radians)
    R_ne : (3, 3) Earth-fixed to north-east-down, for ``course``
    rounds : most iterations
    arm_sigma_m : of the lever arm, if not that of the settings
    """
    arm = arm0 = np.asarray(settings.lever_arm_b, dtype=float)
    arm_sigma = max(settings.lever_arm_sigma_m if arm_sigma_m is None else arm_sigma_m, 1e-5)
    m = len(c.tau)
    y = c.y.ravel() if c.velocity is None else np.concatenate([c.y.ravel(), c.velocity.ravel()])
    sigma_b, k = np.sqrt(bias_variances(settings)), settings.layout.k
    sigma = np.concatenate([sigma_b[:3], sigma_b[k : k + 3], np.full(3, arm_sigma)])
    r0, gyro, accel = c.y[0].copy(), np.zeros(3), np.zeros(3)
    v0 = (c.y[-1] - c.y[0] - R0 @ (c.p[-1] - c.p[0])) / (c.tau[-1] - c.tau[0])
    N, cost, miss = np.eye(18), np.inf, np.zeros(m)
    for _ in range(rounds):
        model, J = _linearised(c, r0, v0, R0, gyro, accel, arm)
        A: list[NDArray[Any]] = [solve_triangular(root, J.reshape(-1, 18), lower=True), np.eye(18)[9:] / sigma[:, None]]
        off = np.concatenate([gyro, accel, arm - arm0])
        r: list[NDArray[Any]] = [solve_triangular(root, y - model.ravel(), lower=True), -off / sigma]
        if prior is not None:
            W = np.linalg.inv(np.linalg.cholesky(prior[1]))
            A.append(W @ np.eye(18)[6:9])
            r.append(W @ vector_from_quaternion(quaternion_from_matrix(prior[0] @ R0.T)))
        if course is not None and R_ne is not None:
            turn, off_course = _course_equation(course[1], R_ne @ (R0 @ c.R[course[0], :, 0]), R_ne)
            A.append(turn @ np.eye(18)[6:9])
            r.append(off_course)
        off_m = np.linalg.norm(c.y - model[:m], axis=1)
        miss = off_m / np.sqrt(np.einsum("mii->m", c.covariance) / 3.0)
        N, dx, cost = _least_squares(np.vstack(A), np.concatenate(r))
        angle = float(np.linalg.norm(dx[6:9]))
        if angle > 0.5:  # far from the solution: turn only so far
            dx *= 0.5 / angle
        r0, v0, R0 = r0 + dx[:3], v0 + dx[3:6], rotation_matrix(dx[6:9]) @ R0
        gyro, accel, arm = gyro + dx[9:12], accel + dx[12:15], arm + dx[15:]
        if angle < 1e-6:
            break
    return WindowFit(r0, v0, R0, gyro, accel, N[:15, :15], cost / max(1, len(y) - 9), cost, miss)


def without_outliers(c: Curve, settings: NavigationSettings, share: float = 0.15) -> Curve:
    """A curve without the fixes that do not fit the others: at most a share of them, one after another."""
    for _ in range(int(share * len(c.tau))):
        fit = fit_window(c, settings, wahba(c, settings), noise_root(c, settings), rounds=6)
        if fit.reduced_chi2 < SUSPICIOUS_CHI2 or len(c.tau) < 6:
            break
        c = c.without(int(np.argmax(fit.miss)))
    return c
