"""Stretches of a recording that show whether inertial and GNSS data belong together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from .alignment_window import Curve, WindowFit, curve, fit_window, noise_root, wahba, without_outliers
from .error_state import NavigationSettings
from .inertial_data import GnssData, InertialData

Array = NDArray[np.floating]

#: Lengths of stretches, s. Against centimetres a part of a turn tells everything; against metres only a turn with the
#: lines before and after it does, since a part of one can be turned and moved until it fits.
SHORT_S, LONG_S = 20.0, 100.0
#: GNSS with a larger standard deviation, m, is looked at over long stretches as well.
COARSE_M = 0.2
#: So many fixes of a stretch are enough, and that much of a second between inertial samples.
_FIXES, _STEP_S = {SHORT_S: 24, LONG_S: 60}, 0.02
#: Where the velocity changes by less, m/s, a stretch shows nothing of units, axes and clocks.
_LEAST_CHANGE_M_S = 4.0


@dataclass(frozen=True)
class DataWindow:
    """A stretch with few, long samples, and its fixes."""

    start_s: float
    inertial: InertialData
    gnss: GnssData

    def with_axes(self, gyro: Array, accel: Array | None = None) -> DataWindow:
        """With the gyros, and the accelerometers, turned, mirrored or scaled by a matrix."""
        d = self.inertial
        dv = d.dv if accel is None else d.dv @ accel.T
        return replace(self, inertial=replace(d, dtheta=d.dtheta @ gyro.T, dv=dv))

    def curve(self) -> Curve:
        return curve(self.inertial.corrected(), self.gnss, self.start_s)

    def shifted(self, gnss: GnssData, shift_s: float) -> DataWindow:
        """With the fixes that fall into it if GNSS clocks are late by ``shift_s``."""
        t = gnss.time_s - shift_s
        k = np.flatnonzero((t > self.start_s) & (t <= self.inertial.time_s[-1]))
        k = k[:: max(1, len(k) // _most_fixes(float(self.inertial.time_s[-1]) - self.start_s))]
        return replace(self, gnss=replace(gnss[k], time_s=t[k]))


def _most_fixes(length_s: float) -> int:
    return _FIXES[SHORT_S] if length_s <= 1.5 * SHORT_S else _FIXES[LONG_S]


def window_lengths(inertial: InertialData, gnss: GnssData) -> list[float]:
    """Lengths of stretches to look at, s, the last of them the one that tells most."""
    overlap = float(min(inertial.time_s[-1], gnss.time_s[-1]) - max(inertial.time_s[0], gnss.time_s[0]))
    coarse = float(np.median(gnss.sigma_ned_m[:, :2])) > COARSE_M
    lengths = [min(SHORT_S, 0.8 * overlap)]
    if coarse and 0.8 * overlap > 1.5 * SHORT_S:
        lengths.append(min(LONG_S, 0.8 * overlap))
    return lengths


def data_windows(inertial: InertialData, gnss: GnssData, length_s: float, most: int = 3) -> list[DataWindow]:
    """The stretches of a length, without gaps and apart, where the velocity turns most."""
    if len(gnss) < 8:
        return []
    t = gnss.time_s
    starts = np.arange(max(t[0], inertial.time_s[0]) + 0.01, min(t[-1], inertial.time_s[-1]) - length_s, length_s / 4.0)
    turning = _turning(gnss, starts, length_s)
    out: list[DataWindow] = []
    taken: list[float] = []
    for i in np.argsort(turning)[::-1]:
        s = float(starts[i])
        if turning[i] < 0 or any(abs(s - x) < length_s for x in taken):
            continue
        part = inertial[(inertial.time_s - inertial.dt_s >= s - 1e-9) & (inertial.time_s <= s + length_s)]
        fixes = gnss[(t > s) & (t <= s + length_s - 0.05)]
        if len(part) < 50 or part.gaps() or len(fixes) < 6:
            continue
        taken.append(s)
        step = max(1, len(fixes) // _most_fixes(length_s))
        out.append(DataWindow(float(part.time_s[0] - part.dt_s[0]), _coarse(part), fixes[::step]))
        if len(out) == most:
            break
    return out


def tells(g: GnssData) -> bool:
    """Whether the velocity changes enough between the fixes of a stretch for units, axes and clocks to show."""
    usual = float(np.median(np.diff(g.time_s)))
    far = max(1, round(3.0 * float(np.median(g.sigma_ned_m[:, :2])) / usual))
    t, r = g.time_s[::far], g.position_e[::far]
    if len(t) < 3:
        return False
    v = np.diff(r, axis=0) / np.diff(t)[:, None]
    return float(np.linalg.norm(v - np.median(v, axis=0), axis=1).max()) > _LEAST_CHANGE_M_S


def _turning(gnss: GnssData, starts: Array, length_s: float) -> Array:
    """How much (m/s) the velocity changes in stretches that begin at given times; -1 where fixes are missing.

    Velocities are over so many fixes that noise makes less than half a metre a second of them.
    """
    t = gnss.time_s
    usual = float(np.median(np.diff(t)))
    far = max(1, round(3.0 * float(np.median(gnss.sigma_ned_m[:, :2])) / usual))
    t, r = t[::far], gnss.position_e[::far]
    v = np.diff(r, axis=0) / np.diff(t)[:, None]
    out = []
    for s in starts:
        k = np.flatnonzero((t[1:] >= s) & (t[1:] <= s + length_s))
        # an outlier is not a turn: what is beyond a vehicle's means does not count
        change = np.linalg.norm(np.diff(v[k], axis=0), axis=1)
        out.append(float(change[change < 12.0 * usual * far].sum()) if len(k) * far >= 6 and len(k) >= 3 else -1.0)
    return np.array(out)


def _coarse(data: InertialData) -> InertialData:
    """Sums of neighbouring increments: enough for a check."""
    m = max(1, round(_STEP_S / data.interval_s))
    n = len(data) // m * m

    def total(x: Array) -> Array:
        return x[:n].reshape(n // m, m, *x.shape[1:]).sum(axis=1)

    zero = np.zeros(n // m)
    return InertialData(data.time_s[m - 1 : n : m], total(data.dt_s), total(data.dtheta), total(data.dv), zero, zero)


def misfit(windows: Sequence[DataWindow], settings: NavigationSettings, arm_sigma_m: float = 0.0) -> float:
    """How many times too large the squares of the best fit are; median of the windows."""
    fits = [best_fit(w.curve(), settings, arm_sigma_m) for w in windows if len(w.gnss) >= 5]
    return float(np.median([f.reduced_chi2 for f in fits])) if len(fits) == len(windows) else np.inf


def misfit_without_outliers(windows: Sequence[DataWindow], settings: NavigationSettings) -> float:
    """The same after up to 3 of 10 fixes have been left out."""
    return float(
        np.median([best_fit(without_outliers(w.curve(), settings, 0.3), settings).reduced_chi2 for w in windows])
    )


def best_fit(c: Curve, settings: NavigationSettings, arm_sigma_m: float = 0.0) -> WindowFit:
    """Fit from the attitude that the curves themselves show."""
    return fit_window(c, settings, wahba(c, settings), noise_root(c, settings), rounds=6, arm_sigma_m=arm_sigma_m)
