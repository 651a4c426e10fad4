"""Tenths of a second between the clock of GNSS and that of an inertial or attitude sensor, from motion that both see.

In straight flight at constant speed an offset is a constant shift along the flight, and nothing shows it but ground
control. In a turn it does: the velocity changes at another time than turn rates and specific force say.

- Inertial data: the fit of a stretch (`alignment_window`) gets the offset as one more unknown. Its derivative is the
  velocity of the antenna, that of GNSS velocities its acceleration.
- Attitude: the heading turns the velocity through the air, to which a constant wind is added; beside it, an aircraft
  that turns without slipping accelerates sideways by ``g tan(roll)``. Slip looks like an offset in the first and not in
  the second, so both have to agree; on a stabilised mount, whose roll is not the aircraft's, the first alone has to be
  beyond what a slip can be.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular

from .alignment_window import SUSPICIOUS_CHI2, fit_window, noise_root, offset_equations, wahba
from .error_state import NavigationSettings, bias_variances
from .gnss_fix import stacked
from .inertial_data import GAP_FACTOR, GnssData, InertialData
from .inertial_windows import DataWindow, data_windows, tells

Array = NDArray[np.floating]
Complex = NDArray[np.complexfloating]  # north + i east

#: An offset is looked for in the newest stretch of this length, s, with inertial data and with attitudes, which want
#: the straight flight before and after a turn; and again after so long, s (tuned).
INERTIAL_STRETCH_S, ATTITUDE_STRETCH_S, AGAIN_S = 40.0, 100.0, 10.0
#: Smaller offsets are not told, s: fixes of ordinary receivers are late by some hundredths; from the second on fixes
#: are not used (tuned; the fixes of the KITTI drive that the tests have are 0.058 s behind its inertial data).
LEAST_S, TOO_LARGE_S = 0.04, 0.08
#: A step of the search for an offset, s, after which the next would change it by less than what is ever told.
SMALL_STEP_S = 0.25 * LEAST_S
#: An offset is told beyond so many sigma, found in two stretches that agree within a half of it (tuned).
CERTAIN = 5.0
#: Largest offset that is searched for, s: more is seen in the delays of messages (`clock_check`).
LARGEST_S = 3.0
#: Behind a longer gap in the samples, s, a stretch begins anew (tuned: attitudes may come once a second).
LONGEST_GAP_S = 2.0
#: Without roll, an offset has to turn the heading by more than an aircraft slips, rad (tuned).
SLIP = np.radians(2.5)
#: Turn, rad, and turn rate, rad/s, that a stretch must have for attitudes to show an offset (tuned).
LEAST_TURN, LEAST_RATE = np.radians(40.0), np.radians(1.0)
#: Share of the sideways acceleration that the roll must explain, and its scale, to be that of the aircraft (tuned).
ROLL_EXPLAINS, ROLL_SCALE = 0.9, (0.7, 1.3)
_GRAVITY = 9.81


@dataclass(frozen=True)
class Offset:
    """How far the GNSS clock is behind the other one, s (negative: ahead), and its standard deviation."""

    offset_s: float
    sigma_s: float

    def is_certain(self, told: bool = False) -> bool:
        """Whether it is to be told; one that has been told is taken back at half of that."""
        return abs(self.offset_s) > (0.5 if told else 1.0) * max(LEAST_S, CERTAIN * self.sigma_s)

    @property
    def is_too_large(self) -> bool:
        """Whether fixes are of no use."""
        return abs(self.offset_s) > TOO_LARGE_S


def inertial_offset(inertial: InertialData, gnss: GnssData, settings: NavigationSettings) -> Offset | None:
    """Offset of a stretch of inertial data and fixes; None where the motion shows none.

    Parameters
    ----------
    inertial : without gaps, as measured
    gnss : fixes, a few more at both ends than the stretch has
    """
    length_s = float(min(inertial.time_s[-1], gnss.time_s[-1]) - max(inertial.time_s[0], gnss.time_s[0])) - 0.2
    windows = data_windows(inertial, gnss, length_s, most=1) if length_s > 10.0 else []
    if not windows or not tells(windows[0].gnss):
        return None
    window, total, sigma = windows[0], 0.0, np.inf
    for _ in range(8):
        step, sigma, chi2 = _inertial_step(window, settings)
        total += float(np.clip(step, -0.5, 0.5))
        if abs(total) > LARGEST_S:
            return None
        window = windows[0].shifted(gnss, -total)
        if len(window.gnss) < 8:
            return None
        if abs(step) < SMALL_STEP_S:
            return Offset(total, sigma) if chi2 < 2.0 * SUSPICIOUS_CHI2 else None
    return None


def inertial_offsets(
    inertial: InertialData, gnss: GnssData, settings: NavigationSettings
) -> list[tuple[float, Offset]]:
    """Offsets of a flight as `OffsetWatch` tells them: from which time on, s, and how large."""
    watch, told, k = OffsetWatch(), [], 0
    watch.settings = settings
    dt = inertial.dt_s[:, None]
    samples = np.column_stack([inertial.time_s, dt, inertial.dv / dt, inertial.dtheta / dt]).tolist()
    for i, time_s in enumerate(gnss.time_s.tolist()):
        while k < len(samples) and samples[k][0] <= time_s:
            watch.sample(*samples[k])
            k += 1
        if watch.fix(gnss[i : i + 1]) and watch.offset is not None:
            told.append((time_s, watch.offset))
    return told


def _inertial_step(window: DataWindow, settings: NavigationSettings) -> tuple[float, float, float]:
    """Correction of the offset, its sigma (with that of the misfit) and the misfit after it."""
    c = window.curve()
    root = noise_root(c, settings)
    fit = fit_window(c, settings, wahba(c, settings), root, rounds=6)
    d = window.inertial
    force = np.column_stack([np.interp(window.gnss.time_s, d.time_s - 0.5 * d.dt_s, f) for f in (d.dv.T / d.dt_s)])
    design, off = offset_equations(c, settings, fit, force)
    sigma_b, k = np.sqrt(bias_variances(settings)), settings.layout.k
    prior = np.concatenate([sigma_b[:3], sigma_b[k : k + 3]])
    A = np.vstack([solve_triangular(root, design, lower=True), np.eye(16)[9:15] / prior[:, None]])
    r = np.concatenate([solve_triangular(root, off, lower=True), -np.concatenate([fit.gyro, fit.accel]) / prior])
    scale = np.linalg.norm(A, axis=0)
    Q, T = np.linalg.qr(A / scale)
    if np.abs(np.diag(T)).min() < 1e-9:
        return 0.0, np.inf, np.inf
    inverse = np.linalg.inv(T) / scale[:, None]
    dx = inverse @ (Q.T @ r)
    misfit = float(np.square(r - A @ dx).sum()) / max(1, len(off) - 10)
    return float(dx[15]), float(np.linalg.norm(inverse[15])) * max(1.0, misfit) ** 0.5, misfit


def attitude_offset(time_s: Array, rpy: Array, gnss: GnssData) -> Offset | None:
    """Offset of a stretch of attitudes and fixes; None where the motion shows none.

    Parameters
    ----------
    time_s, rpy : (n,), (n, 3) roll, pitch, heading, rad
    gnss : fixes
    """
    heading = np.unwrap(rpy[:, 2])
    if len(gnss) < 20 or len(time_s) < 100 or np.ptp(heading) < LEAST_TURN:
        return None
    step = 0.05
    t = np.arange(time_s[0], time_s[-1], step)
    psi, roll = np.interp(t, time_s, heading), np.interp(t, time_s, rpy[:, 0])
    smooth = np.convolve(psi, np.ones(21) / 21.0, "valid")
    fastest = float(np.quantile(np.abs(np.diff(smooth)) / step, 0.9))
    if fastest < LEAST_RATE:
        return None
    north, east = _metres(gnss)
    p, ahead = north + 1j * east, np.exp(1j * psi)
    heading_of, roll_of = _Heading(t, ahead, gnss.time_s, p), _Roll(t, ahead, roll, gnss.time_s, p)
    if min(len(heading_of), len(roll_of)) < 12:
        return None
    by_heading, by_roll = _best(heading_of), _best(roll_of)
    if by_heading is None:
        return None
    if by_roll is not None and roll_of.explains(by_roll.offset_s):
        apart = abs(by_roll.offset_s - by_heading.offset_s)
        return by_roll if apart < max(0.3 * abs(by_roll.offset_s), 0.08) else None
    known = abs(by_heading.offset_s) * fastest > SLIP
    return replace(by_heading, sigma_s=max(by_heading.sigma_s, 0.0 if known else float(SLIP) / fastest))


def _metres(gnss: GnssData) -> tuple[Array, Array]:
    """North and east of the first fix, m."""
    d = np.einsum("ij,mi->mj", gnss.R_en[0], gnss.position_e - gnss.position_e[0])
    return d[:, 0], d[:, 1]


def _best(misfit: Callable[[float], tuple[float, float]]) -> Offset | None:
    """Offset of the smallest misfit, by a search and a parabola; None where it is smallest at an end.

    ``misfit`` gives the sum of squares and the number of independent residuals; sigmas are those of the residuals.
    """
    taus = np.arange(-LARGEST_S, LARGEST_S + 0.01, 0.1)
    i = int(np.argmin([misfit(tau)[0] for tau in taus.tolist()]))
    if not 0 < i < len(taus) - 1:
        return None
    near = np.linspace(-0.1, 0.1, 9)
    a, b, c = np.polyfit(near, [misfit(tau)[0] for tau in (taus[i] + near).tolist()], 2).tolist()
    if a <= 0:
        return None
    n = misfit(float(taus[i]))[1]
    return Offset(float(taus[i]) - b / (2 * a), float(np.sqrt(max(c - b * b / (4 * a), 1e-12) / n / a)))


class _Heading:
    """Distances flown between fixes a second apart against the velocity along the heading and a wind."""

    def __init__(self, t: Array, ahead: Complex, fixes: Array, p: Complex) -> None:
        slowly = max(1, round(1.0 / float(np.median(np.diff(fixes)))))
        at, p = fixes[::slowly], p[::slowly]
        inside = (at > t[0] + LARGEST_S) & (at < t[-1] - LARGEST_S)
        self._t, self._at, self._flown = t, at[inside], np.diff(p[inside])
        self._ahead = np.concatenate([[0.0], np.cumsum(0.5 * (ahead[1:] + ahead[:-1]) * np.diff(t))])

    def __len__(self) -> int:
        return len(self._flown)

    def __call__(self, tau: float) -> tuple[float, float]:
        x = _at(self._at + tau, self._t, self._ahead)
        A = np.column_stack([np.diff(x), np.diff(self._at).astype(complex)])
        left = self._flown - A @ np.linalg.lstsq(A, self._flown, rcond=None)[0]
        return float(np.square(np.abs(left)).sum()), max(1.0, (2 * len(self) - 5) / 3.0)


class _Roll:
    """Second differences of positions across the heading against the sideways acceleration that the roll makes."""

    HALF_S = 1.5

    def __init__(self, t: Array, ahead: Complex, roll: Array, fixes: Array, p: Complex) -> None:
        self._t, self._ahead, dt = t, ahead, t[1] - t[0]
        side = 1j * ahead
        self._turn = np.cumsum(np.cumsum(_GRAVITY * np.tan(np.clip(roll, -1.2, 1.2)) * side)) * dt * dt
        self._bias = np.cumsum(np.cumsum(side)) * dt * dt
        margin = LARGEST_S + self.HALF_S
        self._at = np.arange(max(t[0], fixes[0]) + margin, min(t[-1], fixes[-1]) - margin, 0.5)
        self._seen = self._second(self._at, fixes, p)

    def __len__(self) -> int:
        return len(self._at)

    def _second(self, at: Array, t: Array, x: Complex) -> Complex:
        return _at(at + self.HALF_S, t, x) - 2.0 * _at(at, t, x) + _at(at - self.HALF_S, t, x)

    def _fit(self, tau: float) -> tuple[Array, Array, Array]:
        """Factor of the roll and its bias (2,), residuals and what is explained (n,)."""
        across = (1j * _at(self._at + tau, self._t, self._ahead)).conj()
        seen = (self._seen * across).real
        told = [(self._second(self._at + tau, self._t, x) * across).real for x in (self._turn, self._bias)]
        A = np.column_stack(told)
        x = np.linalg.lstsq(A, seen, rcond=None)[0]
        return x, seen - A @ x, seen

    def __call__(self, tau: float) -> tuple[float, float]:
        return float(np.square(self._fit(tau)[1]).sum()), max(1.0, len(self) / 6.0)

    def explains(self, tau: float) -> bool:
        """Whether it is the roll of an aircraft that turns without slipping."""
        x, left, seen = self._fit(tau)
        share = 1.0 - float(np.square(left).sum()) / max(float(np.square(seen - seen.mean()).sum()), 1e-12)
        return share > ROLL_EXPLAINS and ROLL_SCALE[0] < float(x[0]) < ROLL_SCALE[1]


def _at(times: Array, t: Array, x: Complex) -> Complex:
    """Complex values between samples."""
    return np.interp(times, t, x.real) + 1j * np.interp(times, t, x.imag)


class OffsetWatch:
    """Keeps the newest stretch of data, and looks for an offset again and again.

    Attributes
    ----------
    offset : that is told; None while there is none
    seen : whether the motion has shown the offset of the clocks at all
    """

    def __init__(self) -> None:
        self.offset: Offset | None = None
        self.seen = False
        self.settings: NavigationSettings | None = None  # of inertial data
        self._samples: deque[tuple[float, ...]] = deque()
        self._fixes: deque[GnssData] = deque()
        self._last: Offset | None = None
        self._next_s = -np.inf
        self._stretch_s = INERTIAL_STRETCH_S

    def sample(self, *values: float) -> None:
        """An inertial sample (time, interval, force, rate: 8 numbers) or an attitude (time, roll, pitch, heading)."""
        held = self._samples
        if held and values[0] > held[-1][0] + LONGEST_GAP_S:  # nobody knows what the aircraft did in between
            held.clear()
            self._fixes.clear()
        self._stretch_s = INERTIAL_STRETCH_S if len(values) == 8 else ATTITUDE_STRETCH_S
        if held and (values[0] <= held[-1][0] or len(values) != len(held[-1])):
            if values[0] > held[-1][0] or values[0] < held[-1][0] - self._stretch_s:
                held.clear()
            else:
                return
        held.append(values)
        while held[0][0] < values[0] - self._stretch_s:
            held.popleft()

    def fix(self, fix: GnssData) -> bool:
        """A fix; whether what is told has changed."""
        time_s = float(fix.time_s[0])
        if self._fixes and time_s <= self._fixes[-1].time_s[0]:
            return False
        self._fixes.append(fix)
        while self._fixes[0].time_s[0] < time_s - self._stretch_s:
            self._fixes.popleft()
        if time_s < self._next_s or time_s - self._fixes[0].time_s[0] < 0.6 * self._stretch_s or not self._samples:
            return False
        self._next_s = time_s + AGAIN_S
        found, last = self._estimate(), self._last
        if found is None:
            return False
        self.seen, self._last = True, found
        if last is None or abs(found.offset_s - last.offset_s) > max(0.5 * abs(found.offset_s), LEAST_S):
            return False  # two stretches have to say the same
        was = self.offset
        self.offset = found if found.is_certain(was is not None) else None
        if was is None or self.offset is None:
            return was is not self.offset
        return was.is_too_large != self.offset.is_too_large

    def _estimate(self) -> Offset | None:
        gnss = stacked(list(self._fixes))
        if self._stretch_s == INERTIAL_STRETCH_S and not tells(gnss):
            return None
        table = np.array(self._samples)
        table = table[table[:, 0] > gnss.time_s[0] - LARGEST_S]
        if len(table) < 100:
            return None
        if table.shape[1] == 4:
            return attitude_offset(table[:, 0], table[:, 1:], gnss)
        if self.settings is None:
            return None
        dt, step = table[1:, 1:2], np.diff(table[:, :1], axis=0)
        table = table[1:]
        dt = np.where(step < GAP_FACTOR * dt, step, dt)  # stamps are better than the nominal interval
        zero = np.zeros(len(table))
        data = InertialData(table[:, 0], dt[:, 0], table[:, 5:8] * dt, table[:, 2:5] * dt, zero, zero)
        return None if data.gaps() else inertial_offset(data, gnss, self.settings)
