"""The report of a flight as one HTML page with figures and tables, which needs no other file."""

from __future__ import annotations

from typing import Any

from ...schemas.topics import may_be_dropped
from ...solver.window.output import BETTER
from ...solver.window.quality.determinability import LEFT_OF_PRIOR, NOT_YET
from . import figures
from .accuracy_table import early_lines
from .evaluation import triangulated
from .flight import Flight
from .integrity import protection_figure
from .render import drawing, number, render
from .style import styled

_ORIENTATION = {
    "measured": "measured (GNSS, INS)",
    "filtered": "filtered trajectory",
    "smoothed": "smoothed trajectory",
    "live": "on-line, live",
    "final": "on-line, final",
    "whole": "after the strips (backward pass)",
}
_POINTS = {
    "direct_georeferencing": "direct georeferencing",
    "live": "intersected, live orientation",
    "final": "intersected, final orientation",
    "adjusted_live": "adjusted, live",
    "adjusted": "adjusted, final",
    "adjusted_whole": "adjusted, after the strips",
}
_AGAINST = {"points": "truth", "check": "check points", "control": "control points"}
#: The flight is over, so that a parameter that is not yet determined will not be.
_OVER = {NOT_YET: "not determined by this flight"}


def page(flight: Flight, result: dict[str, Any]) -> str:
    """The page of a flight and its `analyse` result."""
    points = result["points"] or result["check"]
    better = result.get("improvement", {}).get("points")
    with styled():
        drawings = {
            "map": drawing(figures.trajectory_map(flight)),
            "errors": drawing(figures.errors(flight)),
            "protection": drawing(protection_figure(flight)) if "integrity" in result else None,
            "progress": drawing(figures.progress(flight)),
            "corrections": drawing(figures.correction_functions(flight)),
            "residuals": drawing(figures.residuals(flight)),
        }
    return render(
        "flight.html",
        result=result,
        recording=result["recording"],
        figures=drawings,
        early=early_lines(result),
        points=points,
        compared=triangulated(points) if "direct_georeferencing" in points else None,
        least_gain=min(better) if better and all(better) else None,
        all_tiles=_tiles(result),
        orientation_names=_ORIENTATION,
        point_names=_POINTS,
        point_tables=[(key, name, triangulated(result[key])) for key, name in _AGAINST.items() if result[key]],
        parameters=[_parameter(p) for p in result["parameters"]],
        better=f"{BETTER:g}",
        better_camera=f"{LEFT_OF_PRIOR**0.5:g}",
    )


def _tiles(result: dict[str, Any]) -> list[tuple[str, str, str]]:
    """Value, what it is, and "good", "careful", "bad" or nothing."""
    recording = result["recording"]
    tiles = []
    if "sigma0" in result:
        # below 1 the observations are better than their sigmas, and so are the results
        good = "good" if 0.9 <= result["sigma0"] <= 1.1 else "careful" if result["sigma0"] < 0.9 else "bad"
        text = "sigma0, 1 expected" + (": observations are better than their sigmas" if good == "careful" else "")
        tiles.append((f"{result['sigma0']:.3f}", text, good))
    final = result["orientation"].get("final", {})
    if "nees" in final:
        good = "good" if 0.5 <= final["nees"] <= 2.0 else "bad"
        tiles.append((f"{final['nees']:.2f}", "normalised error squared of the final orientation, 1 expected", good))
    better = result.get("improvement", {})
    points = f"object points ({_POINTS[better['of']]})" if "of" in better else ""
    for key, text in (("points", points), ("orientation", "orientation (on-line, final)")):
        if all(better.get(key) or [None]):
            low, high = min(better[key]), max(better[key])
            times = "–".join(dict.fromkeys((f"{low:.1f}", f"{high:.1f}")))
            tiles.append((f"{times} ×", f"better {text} than direct georeferencing", "good" if low > 1 else "bad"))
    tiles.append((f"{recording['tie_points']}", f"tie points; {recording['rays']} rays of all points", ""))
    tiles.append((f"{recording['control_points']} / {recording['check_points']}", "control / check points", ""))
    if "latency_s" in result:
        text = "from the newest ray to the result that contains it, median"
        tiles.append((f"{1000 * result['latency_s']['median']:.0f} ms", text, ""))
    lost = sum(topic["gaps"] for name, topic in result["topics"].items() if not may_be_dropped(name))
    return [*tiles, (str(lost), "messages missing by their numbers", "bad" if lost else "good")]


def _parameter(p: dict[str, Any]) -> list[str | None]:
    """Cells of the row of a parameter; angles in thousandths of a degree."""
    unit, scale = p["unit"], 1.0
    if unit.startswith("rad"):
        unit, scale = "mdeg" + unit[3:], figures.MDEG
    value, sigma = (None if p[k] is None else f"{scale * p[k]:.4g}" for k in ("value", "sigma"))
    goes_with = f"{p['correlation']:+.2f} {p['partner']}" if p["partner"] else None
    status, since = _OVER.get(p["status"], p["status"]), number(p["estimated_since_s"], 0)
    return [p["name"], unit, status, p["reason"], since, value, sigma, number(p["t"], 1), goes_with]
