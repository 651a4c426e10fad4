"""Page with the plots of a navigation, in one file: trajectory, attitude, sigmas, innovations, biases, gaps."""

from __future__ import annotations

import base64
import html
import io
import json
from pathlib import Path
from typing import Any

import numpy as np

from ...solver.inertial_data import GnssData
from ...solver.post_processing import Navigated

_MOST_POINTS = 3000
_NED = ("north", "east", "down")
_RPY = ("roll", "pitch", "heading")
_COLOURS = ("#1f6fb4", "#d1602a", "#3c8d4f")


def write_page(path: Path, stretches: list[Navigated], gnss: GnssData, result: dict[str, Any]) -> None:
    """Write the page.

    Parameters
    ----------
    stretches : what was navigated
    gnss : all fixes
    result : what stands in result.json
    """
    import matplotlib

    matplotlib.use("Agg", force=False)
    from matplotlib.figure import Figure

    sections = []
    for title, draw in (
        ("Trajectory", _trajectory),
        ("Attitude", _attitude),
        ("Standard deviations", _sigmas),
        ("Innovations with their 3 sigma bands", _innovations),
        ("Biases", _biases),
    ):
        figure = Figure(figsize=(11, 6 if title == "Trajectory" else 7.5), layout="constrained")
        draw(figure, stretches, gnss)
        picture = io.BytesIO()
        figure.savefig(picture, format="png", dpi=90)
        data = base64.b64encode(picture.getvalue()).decode("ascii")
        sections.append(f'<h2>{title}</h2><img alt="{title}" src="data:image/png;base64,{data}">')
    notes = "".join(f"<li>{html.escape(note)}</li>" for note in result["notes"]) or "<li>none</li>"
    gaps = "".join(
        f"<li>{a:.3f} to {b:.3f} s ({b - a:.3f} s)</li>" for s in result["stretches"] for a, b in s["gaps"][:50]
    )
    numbers = html.escape(json.dumps(result["stretches"], indent=2))
    name = html.escape(result["input"])
    page = f"""<!doctype html><html lang="en"><head><meta charset="utf-8"><title>Navigation: {name}</title><style>
body{{font:15px/1.45 system-ui,sans-serif;max-width:1040px;margin:2em auto;padding:0 1em;color:#222}}
img{{max-width:100%}}h1{{font-size:1.4em}}h2{{font-size:1.1em;margin-top:1.8em}}pre{{background:#f4f4f4;padding:1em;overflow:auto}}
</style></head><body><h1>Navigation: {name}</h1>
<p>{result["n_inertial"]} inertial samples at {result["inertial_rate_hz"]:g} Hz, {result["n_gnss"]} fixes;
{"smoothed" if result["smoothed"] else "filtered"}.</p>
<h2>Remarks</h2><ul>{notes}</ul><h2>Gaps in the inertial data</h2><ul>{gaps or "<li>none</li>"}</ul>
{"".join(sections)}<h2>Figures</h2><pre>{numbers}</pre></body></html>
"""
    path.write_text(page, encoding="utf-8")


def _times(stretch: Navigated) -> Any:
    n = min(_MOST_POINTS, len(stretch.best.sample_times))
    return np.linspace(stretch.best.start_s, stretch.best.end_s, n)


def _trajectory(figure: Any, stretches: list[Navigated], gnss: GnssData) -> None:
    plan, height = figure.subplots(1, 2)
    scale = 6378137.0
    lat0, lon0 = float(gnss.lat[0]), float(gnss.lon[0])
    plan.plot(
        (gnss.lon - lon0) * scale * np.cos(lat0), (gnss.lat - lat0) * scale, ".", color="#999", ms=2, label="GNSS"
    )
    height.plot(gnss.time_s, gnss.height_m, ".", color="#999", ms=2)
    for s in stretches:
        t = _times(s)
        g = s.best.at(t).geodetic
        plan.plot((g[:, 1] - lon0) * scale * np.cos(lat0), (g[:, 0] - lat0) * scale, color=_COLOURS[0], lw=1)
        height.plot(t, g[:, 2], color=_COLOURS[0], lw=1)
        _shade(height, s)
    plan.set(xlabel="east, m", ylabel="north, m", aspect="equal")
    plan.set_aspect("equal", adjustable="datalim")
    plan.legend()
    height.set(xlabel="time, s", ylabel="height, m")


def _attitude(figure: Any, stretches: list[Navigated], gnss: GnssData) -> None:
    axes = figure.subplots(3, 1, sharex=True)
    for s in stretches:
        t = _times(s)
        angles = np.degrees(s.best.at(t).angles)
        jump = np.abs(np.diff(angles[:, 2], prepend=angles[0, 2])) > 180.0
        angles[jump, 2] = np.nan
        for i, axis in enumerate(axes):
            axis.plot(t, angles[:, i], color=_COLOURS[i], lw=0.8)
            axis.set_ylabel(f"{_RPY[i]}, deg")
            _shade(axis, s)
    axes[-1].set_xlabel("time, s")


def _sigmas(figure: Any, stretches: list[Navigated], gnss: GnssData) -> None:
    axes = figure.subplots(3, 1, sharex=True)
    for s in stretches:
        t = _times(s)
        for trajectory, style in ((s.filtered, ":"), (s.smoothed, "-")):
            if trajectory is None:
                continue
            sigma = trajectory.sigmas(t)
            sigma[:, 6:] = np.degrees(sigma[:, 6:])
            for row, axis in enumerate(axes):
                for i in range(3):
                    name = (_RPY if row == 2 else _NED)[i]
                    label = f"{name}, {'smoothed' if style == '-' else 'filtered'}" if s is stretches[0] else None
                    axis.semilogy(t, sigma[:, 3 * row + i], style, color=_COLOURS[i], lw=1, label=label)
    for axis, unit in zip(axes, ("position, m", "velocity, m/s", "attitude, deg"), strict=True):
        axis.set_ylabel(unit)
        axis.legend(ncols=2, fontsize=7)
        axis.grid(alpha=0.3)
    axes[-1].set_xlabel("time, s")


def _innovations(figure: Any, stretches: list[Navigated], gnss: GnssData) -> None:
    kinds = sorted({i.kind for s in stretches for i in s.forward.innovations if len(i.value) == 3})
    axes = np.atleast_2d(figure.subplots(3, max(1, len(kinds)), sharex=True, squeeze=False))
    for column, kind in enumerate(kinds):
        rows = [i for s in stretches for i in s.forward.innovations if i.kind == kind]
        t = np.array([i.time_s for i in rows])
        value, sigma = np.array([i.value for i in rows]), np.array([i.sigma for i in rows])
        good = np.array([i.status in ("used", "weighted", "held out") for i in rows])
        for k in range(3):
            axis = axes[k, column]
            axis.fill_between(t, -3 * sigma[:, k], 3 * sigma[:, k], color=_COLOURS[k], alpha=0.15, lw=0)
            axis.plot(t[good], value[good, k], ".", color=_COLOURS[k], ms=3)
            axis.plot(
                t[~good], np.clip(value[~good, k], -6 * sigma[~good, k], 6 * sigma[~good, k]), "x", color="k", ms=4
            )
            limit = 5.0 * float(np.median(sigma[:, k]))
            axis.set_ylim(-limit, limit)
            axis.set_ylabel(f"{kind} {_NED[k]}, {'m' if kind == 'position' else 'm/s'}")
        axes[-1, column].set_xlabel("time, s")


def _biases(figure: Any, stretches: list[Navigated], gnss: GnssData) -> None:
    axes = figure.subplots(2, 1, sharex=True)
    for s in stretches:
        lay, e, P = s.forward.settings.layout, s.best.nodes, s.best.P
        sigma = np.sqrt(np.einsum("kii->ki", P))
        for axis, values, part, factor in (
            (axes[0], e.gyro, lay.gyro, np.degrees(3600.0)),
            (axes[1], e.accel, lay.accel, 1e5),
        ):
            for i in range(3):
                v, w = values[:, i] * factor, sigma[:, part][:, i] * factor
                axis.plot(e.time_s, v, color=_COLOURS[i], lw=1, label="xyz"[i] if s is stretches[0] else None)
                axis.fill_between(e.time_s, v - w, v + w, color=_COLOURS[i], alpha=0.15, lw=0)
    axes[0].set_ylabel("gyro bias, deg/h")
    axes[1].set_ylabel("accelerometer bias, mGal")
    axes[0].legend()
    axes[1].set_xlabel("time, s")


def _shade(axis: Any, stretch: Navigated) -> None:
    for a, b in stretch.forward.gaps:
        if b - a > 0.1:
            axis.axvspan(a, b, color="#d33", alpha=0.25, lw=0)
