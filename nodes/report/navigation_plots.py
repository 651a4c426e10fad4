"""Plots of a navigation: trajectory, attitude, standard deviations, innovations, biases, and times without data."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import AutoLocator, Locator, LogLocator, NullFormatter

from ...solver.accuracy import angle_difference
from ...solver.navigation.error_state import Innovation
from ...solver.navigation.inertial_data import GnssData
from ...solver.navigation.post_processing import Navigated
from .style import figure

_MOST_POINTS = 4000
_NED = ("north", "east", "down")
_RPY = ("roll", "pitch", "heading")
_COLOURS = ("#1f6fb4", "#d1602a", "#3c8d4f")
_GAP, _OUTAGE = "#d33", "#777"
#: Fixes farther apart than so many usual intervals have an outage between them.
_OUTAGE_FACTOR = 4.5
#: An axis of innovations shows so many median sigmas on either side, or more so that this share of the values lies
#: inside; the others are drawn at its edge.
_SHOWN_SIGMAS, _SHOWN_SHARE = 5.0, 0.98


def trajectory(stretches: list[Navigated], gnss: GnssData) -> Figure:
    """Plan, and height against time."""
    scale = 6378137.0
    lat0, lon0 = float(gnss.lat[0]), float(gnss.lon[0])
    east, north = angle_difference(gnss.lon, lon0) * scale * np.cos(lat0), (gnss.lat - lat0) * scale
    wide = float(np.ptp(east)) > 1.8 * float(np.ptp(north))
    fig = figure(5.8 if wide else 5.2)
    plan, height = fig.subplots(2, 1) if wide else fig.subplots(1, 2, width_ratios=(1.0, 1.15))
    plan.plot(east, north, ".", color="#999", ms=4, label="GNSS antenna")
    height.plot(gnss.time_s, gnss.height_m, ".", color="#999", ms=3)
    for s in stretches:
        t = _times(s)
        g = s.best.at(t).geodetic
        name = "inertial sensor" if s is stretches[0] else None
        flown = angle_difference(g[:, 1], lon0) * scale * np.cos(lat0), (g[:, 0] - lat0) * scale
        plan.plot(*flown, color=_COLOURS[0], label=name)
        height.plot(t, g[:, 2], color=_COLOURS[0])
    plan.plot(east[:1], north[:1], "^", color="k", ms=6, label="first fix")
    plan.set(xlabel="east, m", ylabel="north, m")
    for line, limits in ((north, plan.set_ylim), (east, plan.set_xlim)):  # a straight flight gets some room beside it
        room = 0.1 * max(float(np.ptp(east)), float(np.ptp(north)), 10.0)
        if np.ptp(line) < 2.0 * room:
            limits(line.min() + 0.5 * np.ptp(line) - room, line.min() + 0.5 * np.ptp(line) + room)
    plan.set_aspect("equal", adjustable="box")
    plan.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=3, columnspacing=1.0, handletextpad=0.4)
    height.set_ylabel("height, m")
    _time_axis([height], stretches, gnss)
    return fig


def attitude(stretches: list[Navigated], gnss: GnssData) -> Figure:
    """Roll, pitch, heading against time."""
    fig = figure(6.2)
    axes = fig.subplots(3, 1, sharex=True)
    for s in stretches:
        t = _times(s)
        angles = np.degrees(s.best.at(t).angles)
        jump = np.abs(np.diff(angles[:, 2], prepend=angles[0, 2])) > 180.0
        angles[jump, 2] = np.nan
        for i, axis in enumerate(axes):
            axis.plot(t, angles[:, i], color=_COLOURS[i], lw=0.9)
            axis.set_ylabel(f"{_RPY[i]}, deg")
    if np.ptp(axes[2].get_ylim()) > 180.0:
        axes[2].set(ylim=(-10.0, 370.0), yticks=np.arange(0.0, 361.0, 90.0))
    _time_axis(axes, stretches, gnss)
    return fig


def sigmas(stretches: list[Navigated], gnss: GnssData) -> Figure:
    """Standard deviations of position, velocity and attitude, filtered and smoothed."""
    fig = figure(7.6)
    axes = fig.subplots(3, 1, sharex=True)
    for s in stretches:
        t = _times(s)
        for kind, path in (("filtered", s.filtered), ("smoothed", s.smoothed)):
            if path is None:
                continue
            late = kind == "smoothed" or s.smoothed is None
            sigma = path.sigmas(t)
            sigma[:, 6:] = np.degrees(sigma[:, 6:])
            for row, axis in enumerate(axes):
                for i, name in enumerate(_RPY if row == 2 else _NED):
                    axis.semilogy(
                        t, sigma[:, 3 * row + i], color=_COLOURS[i], lw=1.4 if late else 0.7,
                        alpha=1.0 if late else 0.45, label=f"{name}, {kind}" if s is stretches[0] else None,
                    )  # fmt: skip
    for axis, unit in zip(axes, ("position, m", "velocity, m/s", "attitude, deg"), strict=True):
        axis.set_ylabel(unit)
        axis.yaxis.set_major_locator(_ticks(axis))
        axis.yaxis.set_major_formatter(lambda v, _: f"{v:g}")
        axis.yaxis.set_minor_formatter(NullFormatter())
    for axis in (axes[0], axes[2]):
        axis.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=6, borderaxespad=0.0)
    _time_axis(axes, stretches, gnss)
    return fig


def innovations(stretches: list[Navigated], gnss: GnssData) -> Figure:
    """Observed minus predicted of every vector observation, with the band of three sigma."""
    found = [i for s in stretches for i in s.forward.innovations if len(i.value) == 3]
    kinds = sorted({i.kind for i in found})
    fig = figure(6.8)
    axes = fig.subplots(3, max(1, len(kinds)), sharex=True, squeeze=False)
    for column, kind in enumerate(kinds):
        rows = [i for i in found if i.kind == kind]
        for k in range(3):
            _innovation(axes[k, column], rows, k)
            axes[k, column].set_ylabel(f"{kind} {_NED[k]}, {'m' if kind == 'position' else 'm/s'}")
        handles, labels = axes[0, column].get_legend_handles_labels()
        axes[0, column].legend(
            handles, labels, loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=5, borderaxespad=0.0,
            handletextpad=0.3, columnspacing=1.0,
        )  # fmt: skip
        _time_axis(axes[:, column], stretches, gnss)
    return fig


def _innovation(axis: Any, rows: list[Innovation], k: int) -> None:
    """Component ``k``; the marks tell used, weighted, rejected and held-out observations apart."""
    t = np.array([i.time_s for i in rows])
    value, sigma = np.array([i.value[k] for i in rows]), np.array([i.sigma[k] for i in rows])
    status = np.array([i.status for i in rows])
    limit = max(_SHOWN_SIGMAS * float(np.median(sigma)), 1.1 * float(np.quantile(np.abs(value), _SHOWN_SHARE)))
    usual = float(np.median(np.diff(t))) if len(t) > 1 else 1.0
    for part in np.split(np.arange(len(t)), np.flatnonzero(np.diff(t) > _OUTAGE_FACTOR * usual) + 1):
        band = 3.0 * sigma[part]
        axis.fill_between(t[part], -band, band, color=_COLOURS[k], alpha=0.15, lw=0)
    beyond = np.abs(value) > limit
    for names, mark, colour, size in (
        (("used", "weighted"), ".", _COLOURS[k], 3.0),
        (("held out",), "o", "#8e44ad", 2.5),
        (("rejected",), "x", "#111111", 4.0),
        (("restored",), "+", "#c0392b", 6.0),
    ):
        mine = np.isin(status, names)
        if mine.any():
            inside = mine & ~beyond
            axis.plot(t[inside], value[inside], mark, color=colour, ms=size, label=names[0])
    if beyond.any():
        up = value > 0.0
        for side, mark in ((up, "^"), (~up, "v")):
            mine = beyond & side
            label = f"beyond the axis ({int(beyond.sum())})" if mark == "^" or not (beyond & up).any() else None
            edge = np.full(int(mine.sum()), 0.96 * limit if mark == "^" else -0.96 * limit)
            if mine.any():
                axis.plot(t[mine], edge, mark, color="#111111", ms=4, label=label, clip_on=False)
    axis.set_ylim(-limit, limit)


def biases(stretches: list[Navigated], gnss: GnssData) -> Figure:
    """Estimated biases with the band of one sigma."""
    fig = figure(5.2)
    axes = fig.subplots(2, 1, sharex=True)
    for s in stretches:
        lay, e = s.forward.settings.layout, s.best.nodes
        sigma = np.sqrt(np.einsum("kii->ki", s.best.P))
        for axis, values, part, factor in (
            (axes[0], e.gyro, lay.gyro, np.degrees(3600.0)),
            (axes[1], e.accel, lay.accel, 1e5),
        ):
            for i in range(3):
                v, w = values[:, i] * factor, sigma[:, part][:, i] * factor
                axis.plot(e.time_s, v, color=_COLOURS[i], label="xyz"[i] if s is stretches[0] else None)
                axis.fill_between(e.time_s, v - w, v + w, color=_COLOURS[i], alpha=0.15, lw=0)
    axes[0].set_ylabel("gyro bias, deg/h")
    axes[1].set_ylabel("accelerometer bias, mGal")
    axes[0].legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=3, borderaxespad=0.0)
    _time_axis(axes, stretches, gnss)
    return fig


def outages(gnss: GnssData) -> list[tuple[float, float]]:
    """Begin and end of the stretches without fixes, s."""
    step = np.diff(gnss.time_s)
    if not len(step):
        return []
    wide = np.flatnonzero(step > max(_OUTAGE_FACTOR * float(np.median(step)), 2.0))
    return [(float(gnss.time_s[i]), float(gnss.time_s[i + 1])) for i in wide]


def _times(stretch: Navigated) -> Any:
    n = min(_MOST_POINTS, len(stretch.best.sample_times))
    return np.linspace(stretch.best.start_s, stretch.best.end_s, n)


def _ticks(axis: Any) -> Locator:
    """Where a logarithmic axis has ticks: at multiples of powers of ten, and where few are in view at even steps."""
    low, high = axis.get_ylim()
    decades = float(np.log10(high / low))
    if decades < 0.6:
        return AutoLocator()
    several = (1.0, 2.0, 5.0) if decades > 1.0 else (1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 7.0)
    return LogLocator(10.0, subs=(1.0,) if decades > 2.0 else several, numticks=15)


def _time_axis(axes: Any, stretches: list[Navigated], gnss: GnssData) -> None:
    """The same times on every plot; times without inertial data are shaded red, those without GNSS grey."""
    begin, end = stretches[0].best.start_s, stretches[-1].best.end_s
    for axis in axes:
        for a, b in outages(gnss):
            axis.axvspan(a, b, color=_OUTAGE, alpha=0.13, lw=0)
        for s in stretches:
            for a, b in s.forward.gaps:
                if b - a > 0.1:
                    axis.axvspan(a, b, color=_GAP, alpha=0.4, lw=0.8)
        axis.set_xlim(begin - 0.01 * (end - begin), end + 0.01 * (end - begin))
        axis.ticklabel_format(axis="x", useOffset=False, style="plain")
    axes[-1].set_xlabel("time, s")
