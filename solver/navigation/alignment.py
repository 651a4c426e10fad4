"""Alignment: attitude, velocity and position to start a navigation from.

What makes the attitude visible (turns, changes of speed, at rest the rotation of the Earth) needs no cases of its own:
a window of data is fitted as a whole (see `alignment_window`), and the covariance tells whether it was enough. A window
that is not is followed by a longer one; in the end a given attitude is taken as it is, the course stands for the
heading, or the alignment is refused in words.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..geometry import earth
from ..geometry.rotation import (
    matrix_from_navigation,
    navigation_from_matrix,
    quaternion_from_matrix,
    skew,
    vector_from_quaternion,
)
from .alignment_window import (
    COURSE_SIGMA,
    SUSPICIOUS_CHI2,
    Curve,
    WindowFit,
    curve,
    fit_window,
    noise_root,
    wahba,
    without_outliers,
)
from .error_state import Estimate, NavigationSettings, Start, sensor_covariance
from .inertial_data import GnssData, InertialData, InertialGrade
from .strapdown import OMEGA_IE, State, rotation_matrix

Array = NDArray[np.floating]

#: Standard deviation of heading, rad, below which an alignment is good enough. Tuned.
HEADING_SIGMA = np.radians(2.0)
#: Below this speed, m/s, the course over ground says nothing about heading. Tuned.
SLOWEST_COURSE_M_S = 4.0
#: Lengths of data, s, from which an alignment is tried, shortest first. Tuned: each is about half as long again.
_WINDOWS_S = (6.0, 10.0, 16.0, 25.0, 40.0, 60.0, 90.0, 130.0, 190.0, 280.0)
#: Mean square of normalised residuals (1 expected) above which a fit is no alignment. Tuned.
LARGEST_CHI2 = 25.0
#: Factor on the sigmas of the alignment. The filter sees the same data again, which then count little twice. Tuned.
_WIDER = 3.0


class AlignmentError(ValueError):
    """The attitude cannot be found from the data; the message says why and what would help."""


class NothingSeenError(AlignmentError):
    """The data are too few, or of a platform that does not move; later ones may show the attitude."""


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


def align(
    inertial: InertialData,
    gnss: GnssData,
    settings: NavigationSettings,
    *,
    start_s: float | None = None,
    prior: AttitudePrior | None = None,
    patience_s: float = 130.0,
    offset_s: float = 0.0,
) -> Start:
    """Start of a navigation from the first stretch of data that shows the attitude.

    Parameters
    ----------
    inertial : as measured (gaps are bridged)
    gnss : fixes
    start_s : start of the navigation; default the beginning of the inertial data
    prior : attitude known beforehand; where the data contradict it, they win, and a note says so
    patience_s : after so much data without a clear heading, a prior is taken as it is, and without one the course
        stands for the heading; where data end before, they do so then, unless it is infinite
    offset_s : added to the times that an error tells

    Raises
    ------
    NothingSeenError : too few fixes, or the heading stays unknown
    AlignmentError : the data do not fit
    """
    t0 = float(inertial.time_s[0] - inertial.dt_s[0]) if start_s is None else start_s
    last = float(inertial.time_s[-1])
    until = min(last, t0 + _WINDOWS_S[-1])
    inside = gnss[(gnss.time_s >= t0) & (gnss.time_s <= until)]
    if len(inside) < 4:
        raise NothingSeenError(
            "alignment needs at least 4 GNSS fixes within the inertial data "
            f"({t0 + offset_s:.1f} to {until + offset_s:.1f} s); {len(inside)} of {len(gnss)} are there"
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
        more = _level(data, inside[:m], t0, settings) if known is None else known[0]
        free, clear = _best_fit(c, settings, root, R_ne, None, more)
        if free.reduced_chi2 > SUSPICIOUS_CHI2:
            trimmed = without_outliers(c, settings)
            trimmed_root = noise_root(trimmed, settings)
            again, clear_again = _best_fit(trimmed, settings, trimmed_root, R_ne, None, more)
            if again.reduced_chi2 < 0.5 * free.reduced_chi2:
                c, root, free, clear = trimmed, trimmed_root, again, clear_again
        heading_sigma, chi2 = _heading_sigma(free, R_ne), free.reduced_chi2
        fits = chi2 < LARGEST_CHI2
        shown = clear and fits and heading_sigma < HEADING_SIGMA
        if shown and known is None:
            return _start(free, settings, t0, "in motion" if _moves(inside[:m]) else "at rest", [])
        if known is not None and clear and fits and heading_sigma < 2.5 * HEADING_SIGMA:
            off, angle = _off(free, known)
            if off > 5.0:
                return _start(free, settings, t0, "in motion", [_contradiction(angle, "inertial and GNSS data show")])
            if shown:
                fit = fit_window(c, settings, known[0], root, known, None, R_ne)
                return _start(fit, settings, t0, "given attitude", [], known)
        if c.tau[-1] < patience_s and (m < len(whole.tau) or np.isinf(patience_s)):
            continue
        course = _course(inside[np.isin(inside.time_s, t0 + c.tau)]) if len(c.tau) < m else _course(inside[:m])
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
    raise NothingSeenError(
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


def _level(data: InertialData, gnss: GnssData, t0: float, settings: NavigationSettings) -> Array | None:
    """Attitude at the start of a window at rest, body to Earth-fixed; None in motion."""
    if _moves(gnss):
        return None
    part = data[(data.time_s > t0) & (data.time_s <= gnss.time_s[-1])]
    length = float(part.dt_s.sum())
    lat, lon = float(gnss.lat[0]), float(gnss.lon[0])
    means = part.dv.sum(axis=0) / length, part.dtheta.sum(axis=0) / length
    angles, _ = static_attitude(*means, lat, settings.grade, length)
    return earth.R_en(lat, lon) @ matrix_from_navigation(*angles)


def _best_fit(
    c: Curve,
    settings: NavigationSettings,
    root: Array,
    R_ne: Array,
    course: tuple[int, float] | None,
    more: Array | None,
) -> tuple[WindowFit, bool]:
    """Best fit from several headings; whether it is clearly better than any that points elsewhere."""
    first = wahba(c, settings)
    starts: list[Array] = [rotation_matrix(a * R_ne[2]) @ first for a in (0.0, np.pi / 2, np.pi, -np.pi / 2)]
    if more is not None:
        starts.append(more)
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
    P[9:, 9:] = sensor_covariance(settings, fit.r0)
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
    return float(np.sqrt(turn @ np.linalg.solve(P, turn))), float(np.linalg.norm(turn))


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
    east = np.gradient(np.unwrap(gnss.lon), gnss.time_s) * (R_E + gnss.height_m) * np.cos(gnss.lat)
    speed = np.hypot(north, east)
    i = 1 + int(np.argmax(speed[1:-1]))
    return (i, float(np.arctan2(east[i], north[i]))) if speed[i] > SLOWEST_COURSE_M_S else None


def _heading_miss(fit: WindowFit, c: Curve, course: tuple[int, float], R_ne: Array) -> float:
    """Course less heading at the fix of a course."""
    forward = R_ne @ (fit.R0 @ c.R[course[0], :, 0])
    return float((course[1] - np.arctan2(forward[1], forward[0]) + np.pi) % (2 * np.pi) - np.pi)
