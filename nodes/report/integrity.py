"""The operator's light and the protection levels of a flight: how long, why, and whether they held."""

from __future__ import annotations

import re
from itertools import pairwise
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter
from numpy.typing import NDArray

from .. import convert
from .evaluation import orientation_errors
from .flight import Flight
from .strip_time import StripTime
from .style import FILTERED, FINAL, LIVE, TRUTH, figure

Array = NDArray[np.floating]

LIGHTS = ("good", "weak", "failed")
_COLORS = {"good": "#dff1e5", "weak": "#fdebc8", "failed": "#f9d2cd"}
_SYMBOLS = ("X", "Y", "Z", "ω", "φ", "κ")
_MDEG = 1000.0 * float(np.degrees(1.0))
_SCALE = np.array([1.0, 1.0, 1.0, _MDEG, _MDEG, _MDEG])
_LONGEST_S = 6.0  # a report counts for no longer than this, or than updates are apart
_NEAR_S = 0.3  # largest distance in time between an error and the protection level it is compared with
_NUMBER = re.compile(r"[+-]?\b\d+(\.\d+)?\b")


def integrity(flight: Flight) -> dict[str, Any] | None:
    """Lights, protection levels and drifting sources, over the time on strips; None where no report has a light.

    Returns
    -------
    dict with

    - ``seconds``: time on strips; ``share``: of "good", "weak" and "failed", 0 to 1;
    - ``reasons``: ``light, reason, seconds, times`` (how often it began), the longest first; reasons that differ in
      their numbers only count as one, with the numbers of the first;
    - ``protection_m``, ``sigma_m`` (X, Y, Z), ``protection_deg``, ``sigma_deg`` (omega, phi, kappa): medians;
    - ``alert_limit_m`` and ``ground_m`` (worst protection level on the ground), medians, and ``below_limit``, the share
      of the reports in which it is below;
    - with truth ``compared`` (orientations) and ``exceeded`` (by component: errors beyond the protection level);
    - ``sources``: those that drifted: ``source, ccd, since_s, seconds, line_px, sample_px`` (largest bias), ``rivals``.
    """
    lit = _lit(flight)
    if not lit:
        return None
    lasting = _lasting(flight, lit)
    total = sum(lasting)
    share = {light: 0.0 for light in LIGHTS}
    reasons: dict[tuple[str, str], dict[str, Any]] = {}
    before = ("", "")
    for (_, r), seconds in zip(lit, lasting, strict=True):
        share[r.light] = share.get(r.light, 0.0) + seconds / max(total, 1e-9)
        kind = r.light, _NUMBER.sub("#", r.light_reason)
        row = reasons.setdefault(kind, {"light": r.light, "reason": r.light_reason, "seconds": 0.0, "times": 0})
        row["seconds"] += seconds
        row["times"] += kind != before
        before = kind
    result: dict[str, Any] = {"seconds": total, "share": share}
    result["reasons"] = sorted(reasons.values(), key=lambda row: -row["seconds"])
    _levels(flight, result)
    limited = [
        (max(r.ground_protection), r.alert_limit_m) for _, r in lit if r.alert_limit_m > 0 and r.ground_protection
    ]
    if limited:
        worst, limit = np.array(limited).T
        result["alert_limit_m"], result["ground_m"] = float(np.median(limit)), float(np.median(worst))
        result["below_limit"] = float(np.mean(worst < limit))
    result["sources"] = _sources(flight, lit, lasting)
    return result


def _lit(flight: Flight) -> list[tuple[int, Any]]:
    """Reports that show a light, on strips."""
    flying = flight.during_strips(np.array([stamp for stamp, _ in flight.reports], dtype=np.int64))
    return [row for row, on in zip(flight.reports, flying, strict=True) if on and row[1].light and row[1].strip]


def _lasting(flight: Flight, lit: list[tuple[int, Any]]) -> list[float]:
    """Time until the next report or the end of the strip, s, for each report with a light."""
    following, longest_s = dict(pairwise(stamp for stamp, r in flight.reports if r.light)), _longest_s(flight)
    ends = {id: span[1] for id in flight.strips if (span := flight.strip_times(id)) is not None}
    until = [min(following.get(ns, ns), max(ends.get(r.strip, ns), ns)) for ns, r in lit]
    return [min((end - ns) / convert.SECOND_NS, longest_s) for (ns, _), end in zip(lit, until, strict=True)]


def _longest_s(flight: Flight) -> float:
    """How long a report counts at most, s: a little longer than updates are apart (10 s at the pace for throughput)."""
    return max(_LONGEST_S, 1.2 * max((report.update_interval_s for _, report in flight.reports), default=0.0))


def _levels(flight: Flight, result: dict[str, Any]) -> None:
    found = levels(flight)
    if found is None:
        return
    _, protection, sigma, error = found
    for name, values in (("protection", protection), ("sigma", sigma)):
        middle = np.median(values, axis=0)
        result[f"{name}_m"], result[f"{name}_deg"] = middle[:3].tolist(), np.degrees(middle[3:]).tolist()
    known = np.isfinite(error).all(axis=1)
    if known.any():
        result["compared"] = int(known.sum())
        result["exceeded"] = (np.abs(error[known]) > protection[known]).sum(axis=0).tolist()


def levels(flight: Flight) -> tuple[Array, Array, Array, Array] | None:
    """Time (n,) s, protection level, sigma and error of the live orientation (n, 6), m and rad; None without any.

    Errors are NaN where there is no truth, or no live orientation of about that time.
    """
    rows = [(stamp, r.protection, r.sigma, r.strip) for stamp, r in flight.reports if r.strip]
    rows = [row for row in rows if len(row[1]) == len(row[2]) == 6 and np.isfinite([*row[1], *row[2]]).all()]
    if not rows:
        return None
    stamps = np.array([row[0] for row in rows], dtype=np.int64)
    protection, sigma = (np.array([row[k] for row in rows], dtype=float) for k in (1, 2))
    error = np.full((len(rows), 6), np.nan)
    live = orientation_errors(flight).get("live")
    if live is not None:
        strips = np.array([row[3] for row in rows])
        for strip in np.unique(strips):
            own, of_strip = strips == strip, (live.strip == strip) | (live.strip == "")
            if of_strip.any():
                error[own] = _errors_at(stamps[own], live.time_ns[of_strip], live.error[of_strip])
    return flight.seconds(stamps), protection, sigma, error


def _errors_at(stamps: NDArray[np.int64], time_ns: NDArray[np.int64], error: Array) -> Array:
    """Errors (n, 6) at the times (k,) that are nearest to stamps (n,); NaN where none of them is near."""
    nearest = np.clip(np.searchsorted(time_ns, stamps), 1, len(time_ns) - 1) if len(time_ns) > 1 else stamps * 0
    if len(time_ns) > 1:
        nearest -= stamps - time_ns[nearest - 1] < time_ns[nearest] - stamps
    near = np.abs(time_ns[nearest] - stamps) <= _NEAR_S * convert.SECOND_NS
    return np.where(near[:, None], error[nearest], np.nan)


def _sources(flight: Flight, lit: list[tuple[int, Any]], lasting: list[float]) -> list[dict[str, Any]]:
    found: dict[tuple[str, str], dict[str, Any]] = {}
    for (_, report), seconds in zip(lit, lasting, strict=True):
        for s in report.sources:
            since_s = float(flight.seconds(s.since_ns)) if s.since_ns else None
            new = {"source": s.source, "ccd": s.ccd, "since_s": since_s, "seconds": 0.0}
            row = found.setdefault((s.source, s.ccd), {**new, "line_px": 0.0, "sample_px": 0.0, "rivals": []})
            row["seconds"] += seconds
            if np.hypot(s.line, s.sample) >= np.hypot(row["line_px"], row["sample_px"]):
                row["line_px"], row["sample_px"] = s.line, s.sample
            row["rivals"] = sorted({*row["rivals"], *s.rivals})
    return sorted(found.values(), key=lambda row: -row["seconds"])


def protection_figure(flight: Flight) -> Figure | None:
    """Protection level and sigma of the newest orientation, its error where there is truth; the light as background.

    None where no report on a strip has them, as where strips are matched when they are over.
    """
    found = levels(flight)
    if found is None:
        return None
    t, protection, sigma, error = found
    fig = figure(5.2)
    axes = fig.subplots(3, 2, sharex=True)
    axis = StripTime(flight)
    lights = _lights(flight)
    curves = [("σ", sigma, FINAL, 1.0), ("protection level", protection, LIVE, 1.5)]
    if np.isfinite(error).any():
        curves.insert(0, ("error of the live orientation", np.abs(error), TRUTH, 0.7))
    for i, ax in enumerate(axes.T.ravel()):
        drawn = {}
        for name, values, color, width in curves:
            x, y = axis.curve(t, _SCALE[i] * values[:, i : i + 1], _longest_s(flight))
            drawn[name] = y[np.isfinite(y)]
            ax.plot(x, y[:, 0], color=color, lw=width, label=name)
            lone = _lone(y[:, 0])
            ax.plot(x[lone], y[lone, 0], color=color, ls="", marker=".", ms=3.0 + 2.0 * width)
        if not drawn["protection level"].size:
            return None
        ax.set_yscale("log")
        low = float(drawn["σ"].min(initial=np.inf))
        high = float(drawn["protection level"].max(initial=0.0))
        low = min(low, high)  # nothing is drawn of reports between strips
        bottom, top = 0.2 * max(low, 1e-6 * high, 1e-9), 1.5 * max(high, 1e-9)
        ax.set_ylim(bottom, top)
        ax.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5) if top < 300 * bottom else (1,)))
        ax.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
        ax.yaxis.set_minor_formatter(NullFormatter())
        ax.set_title(f"{_SYMBOLS[i]} [{'m' if i < 3 else 'mdeg'}]")
        _shade(ax, axis, *lights, _longest_s(flight))
    axis.dress(axes.ravel(), axes[-1])
    fig.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=6)
    return fig


def _lone(values: Array) -> NDArray[np.bool_]:
    """Which values no line shows, because those before and after them are missing."""
    known = np.concatenate([[False], np.isfinite(values), [False]])
    return known[1:-1] & ~known[:-2] & ~known[2:]


def _lights(flight: Flight) -> tuple[Array, Array]:
    """Time (n,) s and the light (n,) from then on, place in LIGHTS or -1 for none: reports on strips, and where the
    last of several ceases to count."""
    lit = _lit(flight)
    code = np.array([LIGHTS.index(r.light) if r.light in LIGHTS else -1 for _, r in lit], dtype=float)
    time_s = np.atleast_1d(flight.seconds(np.array([stamp for stamp, _ in lit], dtype=np.int64)))
    ends = time_s + _lasting(flight, lit)
    last = np.append(time_s[1:] > ends[:-1] + 1e-6, True)[: len(time_s)]  # none without a light
    places = np.flatnonzero(last) + 1
    return np.insert(time_s, places, ends[last]), np.insert(code, places, -1.0)


def _shade(ax: Axes, axis: StripTime, time_s: Array, code: Array, longest_s: float) -> None:
    """The light as the colour of the background."""
    if not len(time_s):
        return
    x, values = axis.curve(time_s, code[:, None], longest_s)
    for k, light in enumerate(LIGHTS):
        burning = np.isfinite(x[1:] - x[:-1]) & (values[:-1, 0] == k)  # a light holds until the next report
        edges = np.flatnonzero(np.diff(burning, prepend=False, append=False))
        spans = [(float(x[a]), float(x[b] - x[a])) for a, b in zip(edges[::2], edges[1::2], strict=True)]
        if spans:
            style = {"color": _COLORS[light], "lw": 0, "zorder": 0, "label": light}
            ax.broken_barh(spans, (0.0, 1.0), transform=ax.get_xaxis_transform(), **style)
    ax.grid(True, axis="y", color=FILTERED, alpha=0.25)
