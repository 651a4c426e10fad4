"""Cleaning of inertial and GNSS data: what cannot be used is taken out, and what was found is said."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .inertial_data import GAP_FACTOR, GnssData, InertialData

Array = NDArray[np.floating]


@dataclass(frozen=True)
class Finding:
    """Something wrong with the data.

    Attributes
    ----------
    code : short name of the kind
    subject : what it is in: ``imu.time``, ``imu.rate``, ``imu.force``, ``imu.axes``, ``gnss.time``, ``gnss.sigma``,
        ``gnss.position``
    text : one line: the cause, and the figure that shows it
    fatal : navigating on would give nonsense
    place : row of the data as they were given and place among the columns of the subject, where it is one value
    """

    code: str
    subject: str
    text: str
    fatal: bool
    place: tuple[int, int] | None = None


#: A value beyond these, rad/s and m/s^2, and so many times what nearly all others stay below is no measurement.
_RATE_LIMIT, _FORCE_LIMIT, _TIMES = 35.0, 500.0, 20.0


def clean_inertial(
    time_s: ArrayLike, a: ArrayLike, b: ArrayLike, *, increments: bool = False
) -> tuple[Array, Array, Array, list[Finding]]:
    """Times that increase and values that are finite and possible: takes out what is not, and a first interval that is
    garbage.

    Parameters
    ----------
    time_s : (n,)
    a, b : (n, 3) rates and forces, or increments
    increments : which of both

    Returns
    -------
    time_s, a, b : what is left
    findings
    """
    t, a, b = (np.asarray(x, dtype=float) for x in (time_s, a, b))
    findings = []
    good = np.isfinite(t) & np.isfinite(a).all(axis=1) & np.isfinite(b).all(axis=1)
    if not good.all():
        findings.append(
            Finding("not finite", "imu.rate", f"{int((~good).sum())} samples are not numbers: dropped", False)
        )
        t, a, b = t[good], a[good], b[good]
    if len(t) > 8:
        possible, more = _possible(t, a, b, np.flatnonzero(good), increments)
        findings += more
        t, a, b = t[possible], a[possible], b[possible]
        rows, more = in_order(t, "imu.time", "samples")
        findings += more
        t, a, b = t[rows], a[rows], b[rows]
        step = np.diff(t)
        nominal = float(np.median(step)) if len(step) else 0.0
        early = np.flatnonzero(step[:4] > max(20.0 * nominal, nominal + 0.2))
        if len(early) and nominal > 0:
            k = int(early[-1]) + 1
            what = (
                f"the first interval lasts {step[k - 1]:.3f} s, the others {nominal:.4f} s: first {k} sample(s) dropped"
            )
            findings.append(Finding("first interval", "imu.time", what, False))
            t, a, b = t[k:], a[k:], b[k:]
    return t, a, b, findings


def _possible(
    t: Array, a: Array, b: Array, rows: NDArray[np.int64], increments: bool
) -> tuple[NDArray[np.bool_], list[Finding]]:
    """Which samples (n,) have no value that is impossible, and a finding for each kind of sensor that has some."""
    findings = []
    possible = np.ones(len(t), dtype=bool)
    scale = abs(float(np.median(np.diff(t)))) if increments else 1.0
    unit = ("rad", "m/s") if increments else ("rad/s", "m/s^2")
    kinds = (("imu.rate", a, _RATE_LIMIT, unit[0]), ("imu.force", b, _FORCE_LIMIT, unit[1]))
    for subject, values, most, name in kinds:
        limit = np.maximum(most * scale, _TIMES * np.quantile(np.abs(values), 0.99, axis=0))
        bad = np.abs(values) > limit
        wrong = np.flatnonzero(bad.any(axis=1))
        if not len(wrong):
            continue
        i, k = wrong[0], int(np.argmax(bad[wrong[0]]))
        more = f" (and {len(wrong) - 1} more like it)" if len(wrong) > 1 else ""
        text = f"{values[i, k]:g} {name} cannot be, wanted less than {limit[k]:.3g}: sample dropped{more}"
        findings.append(Finding("impossible", subject, text, False, (int(rows[i]), k)))
        possible[wrong] = False
    return possible, findings


def in_order(time_s: Array, subject: str, name: str) -> tuple[NDArray[np.intp], list[Finding]]:
    """Rows whose times (n,) increase, in that order, and what is to be said of it.

    Rows are kept in runs without a gap, which are put in the order of their beginnings: a file may have its parts in
    another order, and a single stamp that is far ahead does not make all that follow seem late. What goes back within
    that is left out, so that runs which overlap, as of a clock that was set back, are not mixed.
    """
    step = np.diff(time_s)
    if not len(step) or (step > 0).all():
        return np.arange(len(time_s)), []
    sorted_step = np.diff(np.sort(time_s))
    usual = float(np.median(sorted_step[sorted_step > 0])) if (sorted_step > 0).any() else 0.0
    runs = np.split(np.arange(len(time_s)), np.flatnonzero((step <= 0) | (step > GAP_FACTOR * usual)) + 1)
    rows = np.concatenate(sorted(runs, key=lambda run: float(time_s[run[0]])))
    newest = np.maximum.accumulate(time_s[rows])
    rows = rows[np.concatenate([[True], time_s[rows[1:]] > newest[:-1]])]
    findings = []
    if (np.diff(rows) < 0).any():
        text = f"{name} go back in time at {int((step < 0).sum())} place(s): put in order"
        findings.append(Finding("time order", subject, text, False))
    if len(rows) < len(time_s):
        text = f"{len(time_s) - len(rows)} {name} repeat or go back in time: dropped"
        findings.append(Finding("time order", subject, text, False))
    return rows, findings


def clean_gnss(gnss: GnssData) -> tuple[GnssData, list[Finding]]:
    """Fixes with positions on Earth, times that increase and sigmas above zero.

    A position that is not on Earth is left out, and is fatal where most are so. Latitude 0 with longitude 0, which
    receivers without a fix write, is left out, too. A sigma that is zero or not a number is replaced by the median of
    the good ones of its component.
    """
    findings = []
    rows = np.arange(len(gnss))
    position = np.column_stack([gnss.lat, gnss.lon, gnss.height_m])
    good = np.isfinite(gnss.time_s) & np.isfinite(position).all(axis=1) & position[:, :2].any(axis=1)
    if not good.all():
        findings.append(
            Finding("no position", "gnss.position", f"{int((~good).sum())} fixes without a position: dropped", False)
        )
    gnss, rows = gnss[good], rows[good]
    off = np.column_stack([np.abs(gnss.lat) > np.pi / 2, np.abs(gnss.lon) > 2 * np.pi])
    wrong = np.flatnonzero(off.any(axis=1))
    if len(wrong) and 2 * len(wrong) < len(gnss):
        i, k = wrong[0], int(np.argmax(off[wrong[0]]))
        more = f" (and {len(wrong) - 1} more like it)" if len(wrong) > 1 else ""
        value = float(np.degrees((gnss.lat, gnss.lon)[k][i]))
        text = f"{value:g}, wanted {'-90 to 90' if k == 0 else '-360 to 360'} deg: fix dropped{more}"
        findings.append(Finding("not geodetic", "gnss.position", text, False, (int(rows[i]), k)))
        gnss = gnss[np.flatnonzero(~off.any(axis=1))]
    order, more = in_order(gnss.time_s, "gnss.time", "fixes")
    findings += more
    gnss = gnss[order]
    if len(gnss) and (np.abs(gnss.lat).max() > np.pi / 2 or np.abs(gnss.lon).max() > 2 * np.pi):
        text = "latitude beyond 90 deg or longitude beyond 360 deg: not degrees, or the columns are swapped"
        findings.append(Finding("not geodetic", "gnss.position", text, True))
    sigma = gnss.sigma_ned_m.copy()
    for i, name in enumerate(("north", "east", "down")):
        bad = ~(np.isfinite(sigma[:, i]) & (sigma[:, i] > 0.0))
        if bad.all() and len(bad):
            text = f"sigma {name} is zero or not a number in all {len(bad)} fixes: wanted metres above zero"
            findings.append(Finding("sigma", "gnss.sigma", text, True))
        elif bad.any():
            middle = float(np.median(sigma[~bad, i]))
            sigma[bad, i] = middle
            text = f"sigma {name} is zero or not a number in {int(bad.sum())} of {len(bad)} fixes: {middle:.3g} m taken"
            findings.append(Finding("sigma", "gnss.sigma", text, False))
    velocity, sigma_v = gnss.velocity_n, gnss.sigma_velocity_n
    if velocity is not None and sigma_v is not None:
        usable = np.asarray((np.isfinite(velocity) & np.isfinite(sigma_v) & (sigma_v > 0)).all(axis=1))
        if not usable.all():
            text = f"{int((~usable).sum())} velocities without a value or a sigma above zero: not used"
            findings.append(Finding("velocity", "gnss.velocity", text, False))
            velocity = np.where(usable[:, None], velocity, np.nan)
    return replace(gnss, sigma_ned_m=sigma, velocity_n=velocity), findings


def gap_findings(inertial: InertialData, offset_s: float = 0.0) -> list[Finding]:
    """Gaps in the inertial data, by name where they are few; ``offset_s`` is added to the times that are told."""
    gaps = inertial.gaps()
    if not gaps:
        return []
    long = [g for g in gaps if g[1] - g[0] > max(5.0 * inertial.interval_s, 0.1)]
    lost = sum(max(1, round((b - a) / inertial.interval_s)) for a, b in gaps)
    shown = ", ".join(f"{a + offset_s:.2f}-{b + offset_s:.2f}" for a, b in (long or gaps)[:5])
    more = f" and {len(long or gaps) - 5} more" if len(long or gaps) > 5 else ""
    text = f"{len(gaps)} gap(s), {lost} sample(s) lost ({shown} s{more}): bridged, with the noise that this costs"
    return [Finding("gap", "imu.time", text, False)]


def outage_findings(gnss: GnssData, start_s: float, end_s: float, offset_s: float = 0.0) -> list[Finding]:
    """Times without fixes that are much longer than the usual interval, told with ``offset_s`` added."""
    t = np.concatenate([[start_s], gnss.time_s[(gnss.time_s > start_s) & (gnss.time_s < end_s)], [end_s]])
    if len(t) < 4:
        return []
    step = np.diff(t)
    usual = float(np.median(step))
    long = np.flatnonzero(step > max(GAP_FACTOR * 1.5 * usual, usual + 1.0))
    if not len(long):
        return []
    shown = ", ".join(f"{t[i] + offset_s:.1f}-{t[i + 1] + offset_s:.1f}" for i in long[:5])
    more = f" and {len(long) - 5} more" if len(long) > 5 else ""
    return [Finding("outage", "gnss.time", f"{len(long)} outage(s) ({shown} s{more}): coasted", False)]
