"""Page with the plots of a navigation, in one file: trajectory, attitude, sigmas, innovations, biases, gaps."""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence
from html import escape
from pathlib import Path
from typing import Any

from matplotlib.backends.backend_agg import FigureCanvasAgg

from ...solver.navigation.inertial_data import GnssData
from ...solver.navigation.post_processing import Navigated
from . import navigation_plots as plots
from .page_style import CSS
from .style import styled

_DPI = 160
#: Gaps beyond so many are counted only.
_MOST_GAPS = 50
_SHADES = "Grey: no GNSS. Red: no inertial data."
_PLOTS = (
    ("Trajectory", plots.trajectory, f"What was navigated, and the fixes of the antenna. {_SHADES}"),
    ("Attitude", plots.attitude, "Of the body, forward-right-down, against north-east-down."),
    ("Standard deviations", plots.sigmas, "Thin and pale: filtered; bold: smoothed. Logarithmic."),
    (
        "Innovations with their 3 sigma bands",
        plots.innovations,
        "Observed minus predicted by the filter before the observation was used.",
    ),
    ("Biases", plots.biases, "With bands of one sigma. Body axes: x forward, y right, z down."),
)


def write_page(path: Path, stretches: list[Navigated], gnss: GnssData, result: dict[str, Any]) -> None:
    """Write the page.

    Parameters
    ----------
    stretches : what was navigated
    gnss : all fixes
    result : what stands in result.json
    """
    sections = []
    with styled():
        for title, draw, note in _PLOTS:
            picture = io.BytesIO()
            FigureCanvasAgg(draw(stretches, gnss)).print_figure(picture, format="png", dpi=_DPI)
            data = base64.b64encode(picture.getvalue()).decode("ascii")
            sections.append(
                f'<h2>{title}</h2><figure><img alt="{title}" src="data:image/png;base64,{data}">'
                f"<figcaption>{note}</figcaption></figure>"
            )
    name, offset_s = escape(result["input"]), result["stretches"][0]["time_offset_s"]
    remarks = "".join(f"<li>{escape(note)}</li>" for note in result["notes"]) or "<li>none</li>"
    path.write_text(
        f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>Navigation: {name}</title>\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<style>{CSS}figure img {{ width: 100%; height: auto; display: block; }}</style></head>\n"
        f"<body><main><h1>Navigation: {name}</h1>\n"
        f'<p class="soft">{result["n_inertial"]} inertial samples at {result["inertial_rate_hz"]:g} Hz, '
        f"{result['n_gnss']} fixes; {'smoothed' if result['smoothed'] else 'filtered'}."
        f"{f' Times in plots count from {offset_s:.3f} s.' if offset_s else ''}</p>\n"
        f"{_tiles(result['stretches'])}<h2>Remarks</h2><ul>{remarks}</ul>\n"
        f"<h2>Gaps</h2>{_gaps(result['stretches'], gnss)}\n{''.join(sections)}\n"
        f"<h2>Figures</h2>{''.join(_figures(s) for s in result['stretches'])}\n"
        "<footer>triline navigate. The same figures stand in result.json.</footer></main></body></html>\n",
        encoding="utf-8",
    )


def _tiles(stretches: list[dict[str, Any]]) -> str:
    """The few figures that say how good it is, of the longest stretch."""
    s = max(stretches, key=lambda s: s["end_s"] - s["start_s"])
    median = s["sigma_median"]
    tiles = [
        (_joined([1e3 * v for v in median["position_m"]], "mm"), "sigma north / east / down, median", ""),
        (_joined(median["attitude_deg"], "deg"), "sigma roll / pitch / heading, median", ""),
    ]
    for kind, i in s["innovations"].items():
        if i["n"]:
            ratio = i["nis_per_degree_of_freedom"]
            text = f"squares of {kind} innovations over sigma, 1 expected"
            tiles.append((f"{ratio:.2f}", text, "good" if 0.7 < ratio < 1.4 else "bad"))
    if "held_out" in s:
        h = s["held_out"]
        tiles.append((_joined([1e3 * v for v in h["rms_m"]], "mm"), f"misses of {h['n']} held-out fixes, RMS", ""))
    tiles.append((s["alignment"], "alignment", ""))
    if len(stretches) > 1:
        tiles.append((str(len(stretches)), "stretches; figures of the longest", ""))
    cells = (f'<div class="tile {c}"><b>{escape(v)}</b><span>{escape(t)}</span></div>' for v, t, c in tiles)
    return f'<div class="tiles">{"".join(cells)}</div>'


def _gaps(stretches: list[dict[str, Any]], gnss: GnssData) -> str:
    inertial = [(a, b) for s in stretches for a, b in s["gaps"]]
    offset = stretches[0]["time_offset_s"]
    rows = []
    for what, found in (
        ("inertial data", inertial),
        ("GNSS", [(a + offset, b + offset) for a, b in plots.outages(gnss)]),
    ):
        rows += [[what, f"{a:.3f}", f"{b:.3f}", f"{b - a:.3f}"] for a, b in found[:_MOST_GAPS]]
        if len(found) > _MOST_GAPS:
            rows.append([what, f"and {len(found) - _MOST_GAPS} more", "", ""])
    return _table(["missing", "from, s", "to, s", "for, s"], rows) if rows else "<p>none</p>"


def _figures(s: dict[str, Any]) -> str:
    """Tables of one stretch."""
    out = [f"<h3>{s['start_s']:.3f} to {s['end_s']:.3f} s, aligned {escape(s['alignment'])}</h3>"]
    rows = []
    for what, key, axes, factor in (
        ("position, mm", "position_m", "north, east, down", 1e3),
        ("velocity, mm/s", "velocity_m_s", "north, east, down", 1e3),
        ("attitude, deg", "attitude_deg", "roll, pitch, heading", 1.0),
    ):
        for name, values in (("median", s["sigma_median"][key]), ("RMS", s["sigma_rms"][key])):
            rows.append([f"sigma of {what}, {name}", axes, *_numbers([factor * v for v in values])])
    for what, key in (("gyro bias, deg/h", "gyro_bias_deg_h"), ("accelerometer bias, mGal", "accel_bias_mgal")):
        rows.append([f"{what}, half-way", "x, y, z", *_numbers(s[key])])
        rows.append(["its sigma", "x, y, z", *_numbers(s[f"{key}_sigma"])])
    if "lever_arm_m" in s:
        rows.append(["lever arm of the antenna, m", "forward, right, down", *_numbers(s["lever_arm_m"])])
        rows.append(["its sigma", "forward, right, down", *_numbers(s["lever_arm_m_sigma"])])
    if "held_out" in s:
        h = s["held_out"]
        rows.append([f"misses of {h['n']} held-out fixes, m, RMS", "north, east, down", *_numbers(h["rms_m"])])
        rows.append(["the same over sigma", "north, east, down", *_numbers(h["rms_over_sigma"])])
    out.append(_table(["", "components", "1", "2", "3"], rows))
    kinds = [
        [
            kind,
            str(i["n"]),
            *(str(i.get(k, 0)) for k in ("used", "weighted", "rejected", "restored")),
            f"{i['nis_per_degree_of_freedom']:.3f}",
        ]
        for kind, i in s["innovations"].items()
        if i["n"]
    ]
    head = ["observations", "number", "used", "weighted down", "rejected", "restored", "squares over sigma"]
    out.append(_table(head, kinds))
    if s["observations_outside"]:
        outside = ", ".join(f"{n} {kind}" for kind, n in s["observations_outside"].items())
        out.append(f'<p class="note">Outside the inertial data: {escape(outside)}.</p>')
    return "".join(out)


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [f"<tr>{''.join(f'<th>{escape(h)}</th>' for h in head)}</tr>"]
    lines += [f"<tr>{''.join(f'<td>{escape(c)}</td>' for c in row)}</tr>" for row in rows]
    return f'<div class="scroll"><table>{"".join(lines)}</table></div>'


def _numbers(values: Sequence[float]) -> list[str]:
    return [f"{v:.0f}" if abs(v) >= 1000.0 else f"{v:.4g}" for v in values]


def _joined(values: Sequence[float], unit: str) -> str:
    return f"{' / '.join(f'{v:.2g}' if abs(v) < 10 else f'{v:.0f}' for v in values)} {unit}"
