"""What users get wrong with inertial and GNSS data, found in the data themselves.

Gravity shows the unit of the specific force and which way is up. Everything else shows in the fit of inertial and
GNSS data over short stretches with turns (see `alignment`): if it is bad as given, and ten times better with the
gyros in another unit, with other axes or with clocks a whole second apart, that is what is wrong.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import permutations, product

import numpy as np
from numpy.typing import NDArray

from .alignment_window import (
    SUSPICIOUS_CHI2,
    Curve,
    WindowFit,
    curve,
    fit_window,
    noise_root,
    wahba,
    without_outliers,
)
from .inertial_cleaning import Finding
from .inertial_data import GnssData, InertialData
from .navigation import NavigationSettings

Array = NDArray[np.floating]

WINDOW_S = 20.0
_BAD = SUSPICIOUS_CHI2
_GOOD = 1.5  # a cause is named if it brings them down to this,
_BETTER = 10.0  # or makes them so many times smaller
_NAMES = ("forward", "right", "down")


def check(inertial: InertialData, gnss: GnssData, settings: NavigationSettings, *, increments: bool) -> list[Finding]:
    """Look for wrong units, axes and time scales.

    Parameters
    ----------
    increments : whether the data came as increments (else as rates)

    Returns
    -------
    findings : the first that explains the data; none if they fit
    """
    overlap = min(inertial.time_s[-1], gnss.time_s[-1]) - max(inertial.time_s[0], gnss.time_s[0])
    if overlap <= 0:
        text = (
            f"times do not overlap: inertial data {inertial.time_s[0]:.1f} to {inertial.time_s[-1]:.1f} s, "
            f"GNSS {gnss.time_s[0]:.1f} to {gnss.time_s[-1]:.1f} s (two time scales?)"
        )
        return [Finding("time scale", "gnss.time", text, True)]
    unit = _force_unit(inertial, increments)
    if unit is not None:
        return [unit]
    windows = _windows(inertial, gnss)
    if not windows:
        return _upside_down(inertial)
    given = _misfit(windows, settings)
    if given > _BAD and _misfit_without_outliers(windows, settings) > _BAD:
        cause = _other_unit(windows, settings, given, inertial.interval_s, increments)
        cause = cause or _other_time(gnss, windows, settings, given)
        cause = cause or _other_axes(windows, settings)
        if cause is not None:
            return [cause]
    return _turned_axes(windows, settings) or _upside_down(inertial)


def _force_unit(inertial: InertialData, increments: bool) -> Finding | None:
    dt = inertial.interval_s
    ratio = float(np.median(np.linalg.norm(inertial.dv, axis=1) / inertial.dt_s)) / 9.80665
    if 0.6 < ratio < 1.7:
        return None
    known = [
        (1.0 / 9.80665, "accelerometers give g, not m/s^2"),
        (100.0, "accelerometers give cm/s^2 (Gal) or thousandths of g, not m/s^2"),
        (1.0 / 0.3048, "accelerometers give ft/s^2, not m/s^2"),
    ]
    if increments:
        known.append((1.0 / dt, "the columns say velocity increments, but they hold specific force (rates)"))
    else:
        known.append((dt, "the columns say specific force, but they hold velocity increments"))
    factor, cause = min(known, key=lambda k: abs(np.log(max(ratio, 1e-12) / k[0])))
    figure = f"gravity comes out as {ratio * 9.80665:.4g} m/s^2"
    if abs(np.log(max(ratio, 1e-12) / factor)) < 0.4:
        return Finding("force unit", "imu.force", f"{cause}: {figure}", True)
    if ratio < 0.3:
        return Finding("force unit", "imu.force", f"gravity is not in the accelerations: {figure}", True)
    return Finding("force unit", "imu.force", f"not in m/s^2: {figure}", True)


@dataclass(frozen=True)
class _Window:
    """A stretch with few, long samples, and its fixes."""

    start_s: float
    inertial: InertialData
    gnss: GnssData

    def with_axes(self, gyro: Array, accel: Array | None = None) -> _Window:
        """With the gyros, and the accelerometers, turned, mirrored or scaled by a matrix."""
        d = self.inertial
        dv = d.dv if accel is None else d.dv @ accel.T
        return replace(self, inertial=replace(d, dtheta=d.dtheta @ gyro.T, dv=dv))

    def curve(self) -> Curve:
        return curve(self.inertial.corrected(), self.gnss, self.start_s)

    def shifted(self, gnss: GnssData, shift_s: float) -> _Window:
        """With the fixes that fall into it if GNSS clocks are late by ``shift_s``."""
        t = gnss.time_s - shift_s
        k = np.flatnonzero((t > self.start_s) & (t <= self.inertial.time_s[-1]))
        k = k[:: max(1, len(k) // 24)]
        return replace(self, gnss=replace(gnss[k], time_s=t[k]))


def _windows(inertial: InertialData, gnss: GnssData, most: int = 3) -> list[_Window]:
    """The stretches without gaps where the velocity turns most."""
    if len(gnss) < 8:
        return []
    t, r = gnss.time_s, gnss.position_e
    v = np.diff(r, axis=0) / np.diff(t)[:, None]
    out, taken = [], []
    length = min(WINDOW_S, 0.8 * float(t[-1] - t[0]))
    starts = np.arange(max(t[0], inertial.time_s[0]) + 0.01, min(t[-1], inertial.time_s[-1]) - length, length / 4.0)
    turning, usual = [], float(np.median(np.diff(t)))
    for s in starts:
        k = np.flatnonzero((t[1:] >= s) & (t[1:] <= s + length))
        # an outlier is not a turn: what is beyond a vehicle's means does not count
        change = np.linalg.norm(np.diff(v[k], axis=0), axis=1)
        turning.append(float(change[change < 12.0 * usual].sum()) if len(k) >= 6 else -1.0)
    for i in np.argsort(turning)[::-1]:
        s = float(starts[i])
        if turning[i] < 0 or any(abs(s - x) < length for x in taken):
            continue
        part = inertial[(inertial.time_s - inertial.dt_s >= s - 1e-9) & (inertial.time_s <= s + length)]
        fixes = gnss[(t > s) & (t <= s + length - 0.05)]
        if len(part) < 50 or part.gaps() or len(fixes) < 6:
            continue
        taken.append(s)
        step = max(1, len(fixes) // 24)
        out.append(_Window(float(part.time_s[0] - part.dt_s[0]), _coarse(part), fixes[::step]))
        if len(out) == most:
            break
    return out


def _coarse(data: InertialData, step_s: float = 0.02) -> InertialData:
    """Sums of neighbouring increments: enough for a check."""
    m = max(1, round(step_s / data.interval_s))
    n = len(data) // m * m

    def total(x: Array) -> Array:
        return x[:n].reshape(n // m, m, *x.shape[1:]).sum(axis=1)

    zero = np.zeros(n // m)
    return InertialData(data.time_s[m - 1 : n : m], total(data.dt_s), total(data.dtheta), total(data.dv), zero, zero)


def _misfit(windows: list[_Window], settings: NavigationSettings, arm_sigma_m: float = 0.0) -> float:
    """How many times too large the squares of the best fit are; median of the windows."""
    fits = [_fit(w.curve(), settings, arm_sigma_m) for w in windows if len(w.gnss) >= 5]
    return float(np.median([f.reduced_chi2 for f in fits])) if len(fits) == len(windows) else np.inf


def _misfit_without_outliers(windows: list[_Window], settings: NavigationSettings) -> float:
    return float(
        np.median([_fit(without_outliers(w.curve(), settings, 0.3), settings, 0.0).reduced_chi2 for w in windows])
    )


def _fit(c: Curve, settings: NavigationSettings, arm_sigma_m: float) -> WindowFit:
    return fit_window(c, settings, wahba(c, settings), noise_root(c, settings), rounds=6, arm_sigma_m=arm_sigma_m)


def _cures(given: float, better: float) -> bool:
    return better < _GOOD if given < _BETTER * _GOOD else better < given / _BETTER


def _other_unit(
    windows: list[_Window], settings: NavigationSettings, given: float, dt: float, increments: bool
) -> Finding | None:
    factors = [
        (np.pi / 180.0, "gyros give degrees, not radians"),
        (1.0 / dt, "the columns say angular rates, but they hold angle increments")
        if not increments
        else (dt, "the columns say angle increments, but they hold angular rates"),
        (
            np.pi / 180.0 * (dt if increments else 1.0 / dt),
            "gyros give degrees, and increments are mixed up with rates",
        ),
    ]
    fits = [(_misfit([w.with_axes(np.eye(3) * f) for w in windows], settings), cause) for f, cause in factors]
    best, cause = min(fits)
    if not _cures(given, best):
        return None
    return Finding("rate unit", "imu.rate", f"{cause}: turns of the track fit only so ({_times(given, best)})", True)


def _other_time(gnss: GnssData, windows: list[_Window], settings: NavigationSettings, given: float) -> Finding | None:
    shifts = [s for k in (*range(1, 21), 37) for s in (k, -k)]
    fits = [(_misfit([w.shifted(gnss, float(s)) for w in windows], settings), s) for s in shifts]
    best, shift = min(fits)
    if not _cures(given, best):
        return None
    known = {18: " (GPS time against UTC)", 37: " (TAI against UTC)", 19: " (GPS time against TAI)"}.get(abs(shift), "")
    text = f"GNSS times are {abs(shift)} s {'late' if shift > 0 else 'early'} against the inertial ones{known}: "
    return Finding("time scale", "gnss.time", text + f"the motion fits only so ({_times(given, best)})", True)


def _other_axes(windows: list[_Window], settings: NavigationSettings) -> Finding | None:
    """Left-handed axes, or gyro axes that do not belong to the accelerometer axes: all 48 signed permutations."""
    arm = float(np.linalg.norm(settings.lever_arm_b))  # in other axes it is another one
    given = _misfit(windows, settings, arm)
    if given < _BAD:
        return None
    mirror = np.diag([1.0, -1.0, 1.0])
    for sense in (1.0, -1.0):  # turning counted as before, or the other way
        mirrored = [w.with_axes(sense * mirror, mirror) for w in windows]
        best = _misfit(mirrored, settings, arm)
        if _cures(given, best):
            M = _mean_axes(mirrored, settings)
            which = "" if M is None else f": {_named_axes(M @ mirror)}"
            text = f"body axes are left-handed{which}, wanted forward-right-down ({_times(given, best)})"
            return Finding("axes", "imu.axes", text, True)
    fits = []
    for order in permutations(range(3)):
        for signs in product((1.0, -1.0), repeat=3):
            M = np.zeros((3, 3))
            M[range(3), order] = signs
            fits.append((_misfit([windows[0].with_axes(M)], settings, arm), order, signs))
    best, order, signs = min(fits)
    if not _cures(given, best) or (order == (0, 1, 2) and min(signs) > 0):
        return None
    wanted = ", ".join(f"{'-' if s < 0 else ''}w{'xyz'[i]}" for i, s in zip(order, signs, strict=True))
    text = f"gyro axes do not belong to the accelerometer axes: with ({wanted}) for (wx, wy, wz) they fit"
    return Finding("axes", "imu.axes", f"{text} ({_times(given, best)})", True)


def _turned_axes(windows: list[_Window], settings: NavigationSettings) -> list[Finding]:
    """Body axes against the track: forward is where the platform goes, down is down."""
    M = _mean_axes(windows, settings)
    if M is None or np.trace(M) > 2.9:
        return []
    text = f"body axes are {_named_axes(M)}, wanted forward-right-down (gravity and course show it)"
    return [Finding("axes", "imu.axes", text, True)]


def _mean_axes(windows: list[_Window], settings: NavigationSettings) -> Array | None:
    """Nearest turn by right angles from the measured axes to forward, right, down of the track; None where unclear."""
    total, n = np.zeros((3, 3)), 0
    for w in windows:
        c = w.curve()
        fit = _fit(c, settings, float(np.linalg.norm(settings.lever_arm_b)))
        if fit.P[6:9, 6:9].trace() > np.radians(15.0) ** 2 or fit.reduced_chi2 > 9.0:
            continue
        R_ne = np.swapaxes(w.gnss.R_en, -1, -2)
        v = np.gradient(w.gnss.position_e, w.gnss.time_s, axis=0)
        for k in range(1, len(c.tau) - 1):
            north, east, _ = (R_ne[k] @ v[k]).tolist()
            speed = float(np.hypot(north, east))
            if speed < 5.0:
                continue
            T = np.array([[north, east, 0.0], [-east, north, 0.0], [0.0, 0.0, speed]]) / speed
            total += T @ R_ne[k] @ fit.R0 @ c.R[k]
            n += 1
    if n < 5:
        return None
    U, _, Vt = np.linalg.svd(total)
    mean = U @ Vt
    nearest = max(_rotations(), key=lambda M: float(np.trace(mean @ M.T)))
    return nearest if np.trace(mean @ nearest.T) > 1.0 + 2.0 * np.cos(np.radians(40.0)) else None


def _named_axes(M: Array) -> str:
    """Where the measured x, y and z axes point."""
    names = []
    for column in M.T:
        i = int(np.argmax(np.abs(column)))
        opposite = {"forward": "backward", "right": "left", "down": "up"}
        names.append(_NAMES[i] if column[i] > 0 else opposite[_NAMES[i]])
    return "-".join(names)


def _rotations() -> list[Array]:
    out = []
    for order in permutations(range(3)):
        for signs in product((1.0, -1.0), repeat=3):
            M = np.zeros((3, 3))
            M[range(3), order] = signs
            if np.linalg.det(M) > 0:
                out.append(M)
    return out


def _upside_down(inertial: InertialData) -> list[Finding]:
    """Where no turn tells more, gravity still says which way is down."""
    f = inertial.dv.sum(axis=0) / inertial.dt_s.sum()
    if -f[2] > 0.6 * np.linalg.norm(f):
        return []
    i = int(np.argmax(np.abs(f)))
    axis = f"{'xyz'[i]} axis points {'up' if f[i] > 0 else 'down'}"
    hint = ": forward-left-up data? wanted forward-right-down" if i == 2 else ", wanted z down"
    return [Finding("axes", "imu.axes", f"by gravity ({f[i]:.2f} m/s^2) the {axis}{hint}", True)]


def _times(given: float, better: float) -> str:
    return f"misfit {np.sqrt(given / max(better, 1e-9)):.0f} times smaller"
