"""Alignment: attitude, velocity and position to start a navigation from.

In the non-rotating frame that is Earth-fixed at ``t0`` (see `strapdown`), the antenna at the fixes ``t0 + tau`` is at::

    r(tau) - int int gamma = r0 + v0 tau + R0 (p(tau) + R(tau) lever_arm)

with the body integrals ``p, R`` known from inertial data alone. That is a straight line plus a rotated curve: with
the line taken out, ``R0`` is the rotation between two sets of vectors, found at once however wrong a first guess
would have been (orthogonal Procrustes, Wahba's problem). Gauss-Newton then refines everything, sensor biases
included, with the full covariance of GNSS and inertial noise. What makes the heading visible (turns, changes of
speed, at rest the rotation of the Earth) needs no cases of its own: it all is in the curve, and the covariance tells
whether it was enough.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import solve_triangular

from . import earth
from .filter_pass import rates_at
from .inertial_data import GnssData, InertialData, InertialGrade, cut
from .navigation import Estimate, NavigationSettings, Start, bias_variances
from .navigation_trajectory import gravitation
from .rotation import (
    matrix_from_navigation,
    navigation_from_matrix,
    quaternion_from_matrix,
    skew,
    vector_from_quaternion,
)
from .strapdown import OMEGA_IE, Block, State, earth_rotation, integrate_one, rotation_matrix

Array = NDArray[np.floating]

HEADING_SIGMA = np.radians(2.0)  # an alignment is good enough below this
COURSE_SIGMA = np.radians(12.0)  # drift angle: how far a vehicle's nose may be off its course
SLOWEST_COURSE_M_S = 4.0
_WINDOWS_S = (6.0, 10.0, 16.0, 25.0, 40.0, 60.0, 90.0, 130.0, 190.0, 280.0)
LARGEST_CHI2 = 25.0  # squares of a fit may be so many times what they should be
_WIDER = 3.0  # the filter sees the window's data again: sigmas are widened so that they count little twice


class AlignmentError(ValueError):
    """The attitude cannot be found from the data; the message says why and what would help."""


@dataclass(frozen=True)
class AttitudePrior:
    """Attitude known beforehand at a time.

    Attributes
    ----------
    angles : (3,) roll, pitch, heading, radians
    sigma : (3,) standard deviations, radians
    """

    angles: Array
    sigma: Array


def static_attitude(force: ArrayLike, rate: ArrayLike, lat: float, grade: InertialGrade, duration_s: float):
    """Attitude of a platform at rest by levelling and gyro-compassing.

    Parameters
    ----------
    force, rate : (3,) mean specific force (m/s^2) and angular rate (rad/s), body axes
    lat : latitude, radians
    grade : error model of the sensor
    duration_s : over which the means were taken

    Returns
    -------
    angles : (3,) roll, pitch, heading, radians
    sigma : (3,) radians; heading is pi / sqrt(3) (nothing known) where the gyros are too coarse
    """
    f, w = np.asarray(force, dtype=float), np.asarray(rate, dtype=float)
    g = float(np.linalg.norm(f))
    roll = np.arctan2(-f[1], -f[2])
    pitch = np.arctan2(f[0], np.hypot(f[1], f[2]))
    level = grade.accel_bias / g
    w_level = matrix_from_navigation(roll, pitch, 0.0) @ w
    heading = np.arctan2(-w_level[1], w_level[0]) % (2 * np.pi)
    north = earth.ROTATION_RATE * np.cos(lat)
    sigma = float(np.hypot(grade.gyro_bias, grade.gyro_noise / np.sqrt(duration_s))) / north
    sigma = float(np.hypot(sigma, level * np.tan(lat)))
    return np.array([roll, pitch, heading]), np.array([level, level, min(sigma, np.pi / np.sqrt(3.0))])


@dataclass(frozen=True)
class Curve:
    """Body integrals from ``t0`` to the m fixes of a window (see `strapdown.Block`), and what GNSS says there."""

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
        return Curve(**{name: None if c is None else c[:m] for name, c in columns.items()})


def curve(inertial: InertialData, gnss: GnssData, t0: float) -> Curve:
    """The curve from corrected inertial data without gaps and the fixes after ``t0``."""
    tau = gnss.time_s - t0
    pieces = cut(inertial, np.concatenate([[t0], gnss.time_s]))[0]
    middle = pieces.time_s - 0.5 * pieces.dt_s
    zero = np.zeros(3)
    blocks, total, last = [], Block.empty(), int(np.searchsorted(middle, t0))
    for t in gnss.time_s:
        end = int(np.searchsorted(middle, t))
        if end > last:
            total = total.then(integrate_one(pieces[last:end], zero, zero))
        blocks.append(total)
        last = end
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
    K = K.reshape(3 * m, 3 * m)
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
    PV, VV = PV.reshape(3 * m, 3 * m), VV.reshape(3 * m, 3 * m)
    for i in range(m):
        VV[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] += c.velocity_covariance[i]
    return np.block([[K, PV], [PV.T, VV]])


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
    """

    r0: Array
    v0: Array
    R0: Array
    gyro: Array
    accel: Array
    P: Array
    reduced_chi2: float
    cost: float


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
    tau, eye = c.tau[:, None], np.broadcast_to(np.eye(3), (m, 3, 3))
    swing = skew(c.rate)
    N, cost = np.eye(18), np.inf
    for _ in range(rounds):
        turned = c.R @ arm
        x = (c.p + c.Jp @ gyro - c.Bp @ accel + turned) @ R0.T
        model = r0 + tau * v0 + x
        sensors = R0 @ (c.Jp + skew(turned) @ c.A), -(R0 @ c.Bp), R0 @ c.R
        J = np.concatenate([eye, tau[:, None] * eye, -skew(x), *sensors], axis=-1)
        if c.velocity is not None:
            x = (c.v + c.Jv @ gyro - c.B @ accel + _apply(c.R, np.cross(c.rate, arm))) @ R0.T
            model = np.concatenate([model, v0 + x])
            sensors = R0 @ c.Jv, -(R0 @ c.B), R0 @ c.R @ swing
            Jv = np.concatenate([0.0 * eye, eye, -skew(x), *sensors], axis=-1)
            J = np.concatenate([J, Jv])
        A: list[Array] = [solve_triangular(root, J.reshape(-1, 18), lower=True), np.eye(18)[9:] / sigma[:, None]]
        off = np.concatenate([gyro, accel, arm - arm0])
        r: list[Array] = [solve_triangular(root, y - model.ravel(), lower=True), -off / sigma]
        if prior is not None:
            W = np.linalg.inv(np.linalg.cholesky(prior[1]))
            A.append(W @ np.eye(18)[6:9])
            r.append(W @ vector_from_quaternion(quaternion_from_matrix(prior[0] @ R0.T)))
        if course is not None and R_ne is not None:
            i, heading = course
            forward = R_ne @ (R0 @ c.R[i, :, 0])
            miss = (heading - np.arctan2(forward[1], forward[0]) + np.pi) % (2 * np.pi) - np.pi
            h2 = max(forward[0] ** 2 + forward[1] ** 2, 1e-3)
            turn = (np.array([-forward[1], forward[0], 0.0]) / h2 @ -skew(forward)) @ R_ne
            A.append(turn[None] @ np.eye(18)[6:9] / COURSE_SIGMA)
            r.append(np.array([miss / COURSE_SIGMA]))
        all_r = np.concatenate(r)
        cost = float(all_r @ all_r)
        design = np.vstack(A)
        scale = np.linalg.norm(design, axis=0)
        Q, T = np.linalg.qr(design / scale)
        T = T + np.diag(np.where(np.abs(np.diag(T)) < 1e-9, 1e-6, 0.0))
        inverse = np.linalg.inv(T) / scale[:, None]
        N, dx = inverse @ inverse.T, inverse @ (Q.T @ all_r)
        angle = float(np.linalg.norm(dx[6:9]))
        if angle > 0.5:  # far from the solution: turn only so far
            dx *= 0.5 / angle
        r0, v0, R0 = r0 + dx[:3], v0 + dx[3:6], rotation_matrix(dx[6:9]) @ R0
        gyro, accel, arm = gyro + dx[9:12], accel + dx[12:15], arm + dx[15:]
        if angle < 1e-6:
            break
    return WindowFit(r0, v0, R0, gyro, accel, N[:15, :15], cost / max(1, len(y) - 9), cost)


def align(
    inertial: InertialData,
    gnss: GnssData,
    settings: NavigationSettings,
    *,
    start_s: float | None = None,
    prior: AttitudePrior | None = None,
    patience_s: float = 130.0,
) -> Start:
    """Start of a navigation from the first stretch of data that shows the attitude.

    Parameters
    ----------
    inertial : as measured (gaps are bridged)
    gnss : fixes
    start_s : start of the navigation; default the beginning of the inertial data
    prior : attitude known beforehand; where the data contradict it, they win, and a note says so
    patience_s : after so much data without a clear heading, a prior is taken as it is, and without one the course
        stands for the heading

    Raises
    ------
    AlignmentError : too few fixes, or the heading stays unknown
    """
    t0 = float(inertial.time_s[0] - inertial.dt_s[0]) if start_s is None else start_s
    last = float(inertial.time_s[-1])
    inside = gnss[(gnss.time_s >= t0) & (gnss.time_s <= min(last, t0 + _WINDOWS_S[-1]))]
    if len(inside) < 4:
        raise AlignmentError(
            f"alignment needs at least 4 GNSS fixes within the inertial data ({t0:.1f} to {last:.1f} s); "
            f"{len(inside)} of {len(gnss)} are there"
        )
    inside = _thinned(inside)
    data = inertial[(inertial.time_s > t0) & (inertial.time_s < inside.time_s[-1] + 1.0)]
    data = data.bridged(settings.gap_rate_sigma, settings.gap_force_sigma).corrected()
    whole = curve(data, inside, t0)
    R_ne = earth.R_en(inside.lat[0], inside.lon[0]).T
    known = None if prior is None else _known(prior, R_ne)
    sizes = {int(np.searchsorted(whole.tau, w, side="right")) for w in _WINDOWS_S} | {len(whole.tau)}
    heading_sigma, chi2 = np.pi, 0.0
    for m in sorted(m for m in sizes if m >= 4):
        c = whole.until(m)
        root = noise_root(c, settings)
        free, clear = _best_fit(c, settings, root, R_ne, None, known)
        heading_sigma, chi2 = _heading_sigma(free, R_ne), free.reduced_chi2
        fits = chi2 < LARGEST_CHI2
        shown = clear and fits and heading_sigma < (HEADING_SIGMA if known is None else 2.5 * HEADING_SIGMA)
        if shown and known is None:
            return _start(free, settings, t0, "in motion" if _moves(inside[:m]) else "at rest", [])
        if shown and known is not None:
            off, angle = _off(free, known)
            if off < 5.0:
                fit = fit_window(c, settings, known[0], root, known, None, R_ne)
                return _start(fit, settings, t0, "given attitude", [], known)
            return _start(free, settings, t0, "in motion", [_contradiction(angle, "inertial and GNSS data show")])
        if c.tau[-1] < patience_s and m < len(whole.tau):
            continue
        course = _course(inside[:m])
        if known is not None and fits:
            fit = fit_window(c, settings, known[0], root, known, None, R_ne)
            off = 0.0 if course is None else abs(_heading_miss(fit, c, course, R_ne))
            if off < np.radians(60.0):
                return _start(fit, settings, t0, "given attitude", [], known)
        if course is not None and fits:
            fit, _ = _best_fit(c, settings, root, R_ne, course, None)
            if _heading_sigma(fit, R_ne) < 1.5 * COURSE_SIGMA:
                note = "heading from the course: neither turns nor changes of speed show it"
                if known is not None:
                    note = _contradiction(_off(fit, known)[1], "the course says") + "; " + note
                return _start(fit, settings, t0, "course", [note])
    seen = float(whole.tau[-1])
    if chi2 >= LARGEST_CHI2:
        raise AlignmentError(
            f"inertial and GNSS data do not fit over the first {seen:.0f} s (squares {chi2:.0f} times too large): "
            "check units, axes, time scales and sigmas"
        )
    raise AlignmentError(
        f"heading cannot be found: after {seen:.0f} s its sigma is {np.degrees(min(heading_sigma, np.pi)):.0f} deg "
        "(no turn, change of speed or course shows it, and the gyros are too coarse for gyro-compassing); give one "
        "with its sigma ([initial] heading_deg in platform.toml) or start in motion"
    )


def _known(prior: AttitudePrior, R_ne: Array) -> tuple[Array, Array]:
    """A prior's body-to-Earth rotation, and the covariance of its rotation error in Earth-fixed axes."""
    R_nb = matrix_from_navigation(*prior.angles)
    axes = R_ne.T @ _turn_axes(R_nb)
    return R_ne.T @ R_nb, axes @ np.diag(np.maximum(prior.sigma, 1e-6) ** 2) @ axes.T


def _contradiction(angle: float, whose: str) -> str:
    return f"the initial attitude is {np.degrees(angle):.0f} deg off what {whose}: it was not used"


def noise_root(c: Curve, settings: NavigationSettings) -> Array:
    """Lower Cholesky factor of the covariance of all observations of a curve."""
    return np.linalg.cholesky(_noise(c, settings, c.y[0] / -np.linalg.norm(c.y[0])))


def _best_fit(
    c: Curve,
    settings: NavigationSettings,
    root: Array,
    R_ne: Array,
    course: tuple[int, float] | None,
    known: tuple[Array, Array] | None,
) -> tuple[WindowFit, bool]:
    """Best fit from several headings; whether it is clearly better than any that points elsewhere."""
    first = wahba(c, settings)
    starts = [rotation_matrix(a * R_ne[2]) @ first for a in (0.0, np.pi / 2, np.pi, -np.pi / 2)]
    if known is not None:
        starts.append(known[0])
    fits = sorted((fit_window(c, settings, R, root, None, course, R_ne) for R in starts), key=lambda f: f.cost)
    best = fits[0]
    apart = [f for f in fits[1:] if np.trace(f.R0 @ best.R0.T) < 1.0 + 2.0 * np.cos(np.radians(10.0))]
    return best, not apart or apart[0].cost - best.cost > 25.0


def _start(
    fit: WindowFit,
    settings: NavigationSettings,
    t0: float,
    how: str,
    notes: list[str],
    known: tuple[Array, Array] | None = None,
) -> Start:
    lay = settings.layout
    P = np.zeros((lay.n, lay.n))
    v_e = fit.v0 - np.cross(OMEGA_IE, fit.r0)
    T = np.eye(9)
    T[3:6, :3] = -skew(OMEGA_IE)
    # the window's data come again in the filter: only wider variances are kept, without the correlations they made
    P9 = T @ fit.P[:9, :9] @ T.T * (1.0 if how == "course" else _WIDER**2)
    P[:3, :3] = np.diag(np.diag(P9)[:3] + 0.3**2)
    P[3:6, 3:6] = np.diag(np.diag(P9)[3:6] + 0.05**2)
    P[6:9, 6:9] = P9[6:9, 6:9] + np.eye(3) * np.radians(0.002) ** 2
    if known is not None:  # what was given counts in full, what the window's data added as above
        given = np.linalg.inv(known[1])
        P[6:9, 6:9] = np.linalg.inv(given + _positive(np.linalg.inv(fit.P[6:9, 6:9]) - given) / _WIDER**2)
    i = np.arange(9, lay.n)
    P[i, i] = bias_variances(settings)
    estimate = Estimate(
        t0, State(fit.r0, v_e, fit.R0), np.zeros(lay.k), np.zeros(lay.k), np.array(settings.lever_arm_b)
    )
    return Start(estimate, P, how, notes)


def _positive(N: Array) -> Array:
    """A symmetric matrix without its negative eigenvalues."""
    w, V = np.linalg.eigh(0.5 * (N + N.T))
    return (V * np.maximum(w, 0.0)) @ V.T


def _off(fit: WindowFit, known: tuple[Array, Array]) -> tuple[float, float]:
    """How far a prior attitude is off: in sigmas, and as an angle."""
    turn = vector_from_quaternion(quaternion_from_matrix(fit.R0 @ known[0].T))
    P = fit.P[6:9, 6:9] + known[1]
    return float(np.sqrt(turn @ np.linalg.solve(P, turn) / 3.0)), float(np.linalg.norm(turn))


def _turn_axes(R_nb: Array) -> Array:
    """Columns: what roll, pitch and heading turn about, north-east-down."""
    _, pitch, heading = navigation_from_matrix(R_nb)
    sp, cp, sh, ch = np.sin(pitch), np.cos(pitch), np.sin(heading), np.cos(heading)
    return np.array([[ch * cp, -sh, 0.0], [sh * cp, ch, 0.0], [-sp, 0.0, 1.0]])


def _heading_sigma(fit: WindowFit, R_ne: Array) -> float:
    P_n = R_ne @ fit.P[6:9, 6:9] @ R_ne.T
    return float(np.sqrt(P_n[2, 2]))


def _thinned(gnss: GnssData) -> GnssData:
    """At most about two fixes a second: alignment gains nothing from more."""
    step = float(np.median(np.diff(gnss.time_s)))
    return gnss[:: max(1, round(0.5 / step))] if step < 0.5 else gnss


def _moves(gnss: GnssData) -> bool:
    """Whether the antenna leaves its place by more than its noise explains."""
    r = gnss.position_e
    return float(np.linalg.norm(r - r.mean(axis=0), axis=1).max()) > 2.0 + 5.0 * float(gnss.sigma_ned_m.max())


def _course(gnss: GnssData) -> tuple[int, float] | None:
    """Fix with the highest speed and the course there; None where all is slow."""
    if len(gnss) < 3:
        return None
    R_N, R_E = earth.curvature_radii(gnss.lat)
    north = np.gradient(gnss.lat, gnss.time_s) * (R_N + gnss.height_m)
    east = np.gradient(gnss.lon, gnss.time_s) * (R_E + gnss.height_m) * np.cos(gnss.lat)
    speed = np.hypot(north, east)
    i = 1 + int(np.argmax(speed[1:-1]))
    return (i, float(np.arctan2(east[i], north[i]))) if speed[i] > SLOWEST_COURSE_M_S else None


def _heading_miss(fit: WindowFit, c: Curve, course: tuple[int, float], R_ne: Array) -> float:
    """Course less heading at the fix of a course."""
    forward = R_ne @ (fit.R0 @ c.R[course[0], :, 0])
    return float((course[1] - np.arctan2(forward[1], forward[0]) + np.pi) % (2 * np.pi) - np.pi)
