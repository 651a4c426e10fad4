"""Page with the plots of a navigation, in one file: trajectory, attitude, sigmas, innovations, biases, gaps."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ...solver.navigation.inertial_data import GnssData
from ...solver.navigation.post_processing import Navigated
from . import navigation_plots as plots
from .render import picture, render
from .style import styled

#: Gaps beyond so many are counted only.
_MOST_GAPS = 50
_SHADES = "Grey: no GNSS. Red: no inertial data."
_PLOTS = (
    ("Trajectory", plots.trajectory, f"The inertial sensor as navigated, and the fixes of the antenna. {_SHADES}"),
    ("Attitude", plots.attitude, "Of the body, forward-right-down, against north-east-down."),
    ("Standard deviations", plots.sigmas, "Thin and pale: filtered; bold: smoothed. Logarithmic."),
    (
        "Innovations with their 3 sigma bands",
        plots.innovations,
        "Observed minus predicted by the filter before the observation was used.",
    ),
    ("Biases", plots.biases, "With bands of one sigma. Body axes: x forward, y right, z down."),
)
#: Sigmas in the table of a stretch: what, key in the result, components, factor of the unit.
_SIGMAS = (
    ("position, mm", "position_m", "north, east, down", 1e3),
    ("velocity, mm/s", "velocity_m_s", "north, east, down", 1e3),
    ("attitude, deg", "attitude_deg", "roll, pitch, heading", 1.0),
)


def write_page(path: Path, stretches: list[Navigated], gnss: GnssData, result: dict[str, Any]) -> None:
    """Write the page.

    Parameters
    ----------
    stretches : what was navigated
    gnss : all fixes
    result : what stands in result.json
    """
    with styled():
        drawn = [(title, picture(draw(stretches, gnss), title), note) for title, draw, note in _PLOTS]
    text = render(
        "navigation.html",
        result=result,
        offset_s=result["stretches"][0]["time_offset_s"],
        all_tiles=_tiles(result["stretches"]),
        gaps=_gaps(result["stretches"], gnss),
        plots=drawn,
        sigmas=_SIGMAS,
    )
    path.write_text(text, encoding="utf-8")


def _tiles(stretches: list[dict[str, Any]]) -> list[tuple[str, str, str]]:
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
        text = f"given minus predicted at {h['n']} held-out fixes, RMS"
        tiles.append((_joined([1e3 * v for v in h["rms_m"]], "mm"), text, ""))
    tiles.append((s["alignment"], "alignment", ""))
    if len(stretches) > 1:
        tiles.append((str(len(stretches)), "stretches without a long gap; these figures are of the longest", ""))
    return tiles


def _gaps(stretches: list[dict[str, Any]], gnss: GnssData) -> list[list[str]]:
    """Rows of what is missing, from when, to when and for how long."""
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
    return rows


def _joined(values: Sequence[float], unit: str) -> str:
    return f"{' / '.join(f'{v:.2g}' if abs(v) < 10 else f'{v:.0f}' for v in values)} {unit}"
