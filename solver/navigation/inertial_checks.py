"""What users get wrong with inertial and GNSS data, found in the data themselves.

Gravity shows the unit of the specific force and which way is up. Everything else shows in the fit of inertial and
GNSS data over short stretches with turns (see `alignment`): if it is bad as given, and ten times better with the
gyros in another unit, with other axes or with clocks a whole second apart, that is what is wrong.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import permutations, product

import numpy as np
from numpy.typing import NDArray

from .alignment_window import SUSPICIOUS_CHI2
from .error_state import NavigationSettings
from .inertial_cleaning import Finding
from .inertial_data import GnssData, InertialData
from .inertial_windows import DataWindow, best_fit, data_windows, misfit, misfit_without_outliers, tells, window_lengths

Array = NDArray[np.floating]

#: Misfit (mean square of normalised residuals, 1 expected) above which a cause is looked for.
_BAD = SUSPICIOUS_CHI2
#: A cause is named if it brings the misfit down to the first of these, or makes it so many times smaller. Tuned.
_GOOD, _BETTER = 1.5, 10.0
#: Another cause whose misfit is less than so many times that of the best is named beside it. Tuned.
_CLEARLY = 1.3
#: A factor on gravity is that of a cause within this logarithm; causes whose logarithms differ by less than the second
#: are both named: turns and vibration move the median by some per cent. Tuned.
_FITS, _ALIKE = 0.4, 0.1
_NAMES = ("forward", "right", "down")


def check(
    inertial: InertialData, gnss: GnssData, settings: NavigationSettings, *, increments: bool, offset_s: float = 0.0
) -> list[Finding]:
    """Look for wrong units, axes and time scales.

    Parameters
    ----------
    increments : whether the data came as increments (else as rates)
    offset_s : added to the times that are told

    Returns
    -------
    findings : the first that explains the data; none if they fit
    """
    overlap = min(inertial.time_s[-1], gnss.time_s[-1]) - max(inertial.time_s[0], gnss.time_s[0])
    if overlap <= 0:
        spans = [f"{t[0] + offset_s:.1f} to {t[-1] + offset_s:.1f} s" for t in (inertial.time_s, gnss.time_s)]
        text = f"times do not overlap: inertial data {spans[0]}, GNSS {spans[1]} (two time scales?)"
        return [Finding("time scale", "gnss.time", text, True)]
    unit = _force_unit(inertial, increments)
    if unit is not None:
        return [unit]
    windows: list[DataWindow] = []
    for length_s in window_lengths(inertial, gnss):
        windows = data_windows(inertial, gnss, length_s) or windows
        if not windows:
            continue
        given = misfit(windows, settings)
        if given < _BAD or not all(tells(w.gnss) for w in windows):
            continue
        if misfit_without_outliers(windows, settings) < _BAD:  # then a cause must explain all
            given = min(given, _BETTER * _GOOD)
        cause = _cause(inertial, gnss, windows, settings, given, increments=increments)
        if cause is not None:
            return [cause]
    return (_turned_axes(windows, settings) if windows else []) or _upside_down(inertial)


def _force_unit(inertial: InertialData, increments: bool) -> Finding | None:
    dt = inertial.interval_s
    ratio = float(np.median(np.linalg.norm(inertial.dv, axis=1) / inertial.dt_s)) / 9.80665
    if 0.6 < ratio < 1.7:
        return None
    mixed_up = (
        (1.0 / dt, "the columns say velocity increments, but they hold specific force (rates)")
        if increments
        else (dt, "the columns say specific force, but they hold velocity increments")
    )
    known = [
        mixed_up,
        (1.0 / 9.80665, "accelerometers give g, not m/s^2"),
        (100.0, "accelerometers give cm/s^2 (Gal) or thousandths of g, not m/s^2"),
        (1.0 / 0.3048, "accelerometers give ft/s^2, not m/s^2"),
    ]
    off = [abs(float(np.log(max(ratio, 1e-12) / factor))) for factor, _ in known]
    figure = f"gravity comes out as {ratio * 9.80665:.4g} m/s^2"
    if min(off) < _FITS:  # at 100 Hz a mix-up looks like cm/s^2, at 10 Hz like g
        alike = [cause for miss, (_, cause) in zip(off, known, strict=True) if miss < min(off) + _ALIKE]
        return Finding("force unit", "imu.force", f"{'; or '.join(alike)}: {figure}", True)
    if ratio < 0.3:
        return Finding("force unit", "imu.force", f"gravity is not in the accelerations: {figure}", True)
    return Finding("force unit", "imu.force", f"not in m/s^2: {figure}", True)


@dataclass(frozen=True)
class _Cause:
    """A cause and how well the data fit with it taken away."""

    misfit: float
    finding: Finding


def _cause(
    inertial: InertialData,
    gnss: GnssData,
    windows: Sequence[DataWindow],
    settings: NavigationSettings,
    given: float,
    *,
    increments: bool,
) -> Finding | None:
    """What explains a misfit best; None if nothing does."""
    causes = [
        _other_unit(windows, settings, given, inertial.interval_s, increments),
        _other_time(gnss, windows, settings, given),
        *_other_axes(windows, settings),
    ]
    found = sorted((c for c in causes if c is not None), key=lambda c: c.misfit)
    if not found:
        return None
    best = found[0].finding
    if len(found) > 1 and found[1].misfit < _CLEARLY * found[0].misfit:
        return replace(best, text=f"{best.text}; or, nearly as likely, {found[1].finding.text}")
    return best


def _cures(given: float, better: float) -> bool:
    return better < _GOOD if given <= _BETTER * _GOOD else better < given / _BETTER


def _other_unit(
    windows: Sequence[DataWindow], settings: NavigationSettings, given: float, dt: float, increments: bool
) -> _Cause | None:
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
    fits = [(misfit([w.with_axes(np.eye(3) * f) for w in windows], settings), cause) for f, cause in factors]
    best, cause = min(fits)
    if not _cures(given, best):
        return None
    text = f"{cause}: turns of the track fit only so ({_times(given, best)})"
    return _Cause(best, Finding("rate unit", "imu.rate", text, True))


def _other_time(
    gnss: GnssData, windows: Sequence[DataWindow], settings: NavigationSettings, given: float
) -> _Cause | None:
    shifts = [s for k in (*range(1, 21), 37) for s in (k, -k)]
    fits = [(misfit([w.shifted(gnss, float(s)) for w in windows], settings), s) for s in shifts]
    best = min(fits)[0]
    if not _cures(given, best):
        return None
    alike = [s for f, s in sorted(fits) if f < _CLEARLY * best]
    shift = next((s for s in alike if abs(s) in (18, 37)), alike[0])  # of shifts alike, one that has a reason
    name = {18: " (GPS time against UTC)", 37: " (TAI against UTC)", 19: " (GPS time against TAI)"}.get(abs(shift), "")
    others = [_late(s) for s in alike if s != shift][:3]
    text = f"GNSS times are {_late(shift)} against the inertial ones{name}: the motion fits only so"
    text += f" ({_times(given, best)}{'; nearly as well ' + ', '.join(others) if others else ''})"
    return _Cause(best, Finding("time scale", "gnss.time", text, True))


def _late(shift: int) -> str:
    return f"{abs(shift)} s {'late' if shift > 0 else 'early'}"


def _other_axes(windows: Sequence[DataWindow], settings: NavigationSettings) -> list[_Cause]:
    """Left-handed axes, or gyro axes that do not belong to the accelerometer axes: all 48 signed permutations."""
    arm = float(np.linalg.norm(settings.lever_arm_b))  # in other axes it is another one
    given = misfit(windows, settings, arm)
    if given < _BAD:
        return []
    out = []
    mirror = np.diag([1.0, -1.0, 1.0])
    for sense in (1.0, -1.0):  # turning counted as before, or the other way
        mirrored = [w.with_axes(sense * mirror, mirror) for w in windows]
        best = misfit(mirrored, settings, arm)
        if _cures(given, best):
            M = _mean_axes(mirrored, settings)
            which = "" if M is None else f": {_named_axes(M @ mirror)}"
            text = f"body axes are left-handed{which}, wanted forward-right-down ({_times(given, best)})"
            out.append(_Cause(best, Finding("axes", "imu.axes", text, True)))
    fits = []
    for order in permutations(range(3)):
        for signs in product((1.0, -1.0), repeat=3):
            M = np.zeros((3, 3))
            M[range(3), order] = signs
            if (order, signs) != ((0, 1, 2), (1.0, 1.0, 1.0)):
                fits.append((misfit([windows[0].with_axes(M)], settings, arm), order, signs, M))
    few = sorted(fits, key=lambda f: f[0])[:4]
    best, order, signs = min((misfit([w.with_axes(M) for w in windows], settings, arm), o, s) for _, o, s, M in few)
    if _cures(given, best):
        wanted = ", ".join(f"{'-' if s < 0 else ''}w{'xyz'[i]}" for i, s in zip(order, signs, strict=True))
        text = f"gyro axes do not belong to the accelerometer axes: with ({wanted}) for (wx, wy, wz) they fit"
        out.append(_Cause(best, Finding("axes", "imu.axes", f"{text} ({_times(given, best)})", True)))
    return out


def _turned_axes(windows: Sequence[DataWindow], settings: NavigationSettings) -> list[Finding]:
    """Body axes against the track: forward is where the platform goes, down is down."""
    M = _mean_axes(windows, settings)
    if M is None or np.trace(M) > 2.9:
        return []
    text = f"body axes are {_named_axes(M)}, wanted forward-right-down (gravity and course show it)"
    return [Finding("axes", "imu.axes", text, True)]


def _mean_axes(windows: Sequence[DataWindow], settings: NavigationSettings) -> Array | None:
    """Nearest turn by right angles from the measured axes to forward, right, down of the track; None where unclear."""
    total, n = np.zeros((3, 3)), 0
    for w in windows:
        c = w.curve()
        fit = best_fit(c, settings, float(np.linalg.norm(settings.lever_arm_b)))
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
    out: list[Array] = []
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
    times = float(np.sqrt(given / max(better, 1e-9)))
    return f"misfit {times:.{0 if times > 9.5 else 1}f} times smaller"
