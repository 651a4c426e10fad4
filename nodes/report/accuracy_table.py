"""The accuracy of a flight as a few lines of text, for the ends of commands."""

from __future__ import annotations

from typing import Any

_ORIENTATIONS = {
    "measured": "measured (GNSS, INS)",
    "filtered": "filtered",
    "smoothed": "smoothed",
    "live": "on-line, at once",
    "final": "on-line, final",
    "whole": "after the strips",
}
_POINTS = {
    "direct_georeferencing": "direct georeferencing",
    "final": "on-line, final",
    "adjusted_whole": "after the strips",
}


def accuracy_lines(result: dict[str, Any]) -> list[str]:
    """RMSE against truth of an evaluation (`evaluation.evaluate_flight`); no lines where no truth is recorded."""
    orientation, points = result["orientation"], result["points"]
    if not orientation and not points:
        return []
    lines = ["RMSE against truth            X       Y       Z          omega     phi   kappa", "exterior orientation"]
    # the smoothed trajectory says something of its own only where nothing else was measured
    shown = [
        name for name in _ORIENTATIONS if name in orientation and (name != "smoothed" or "filtered" not in orientation)
    ]
    lines += [_row(_ORIENTATIONS[name], orientation[name]["rmse_m"], orientation[name]["rmse_deg"]) for name in shown]
    lines.append("object points")
    lines += [_row(title, points[name]["rmse_m"]) for name, title in _POINTS.items() if name in points]
    gain = result.get("improvement", {}).get("points")
    if gain:
        lines.append("  improvement           " + "".join(f"{v:7.1f}x" if v else "       -" for v in gain))
    elif not points:
        lines.append("  none: the flight was too short, or no point got two looks")
    if "sigma0" in result:
        lines.append(
            f"sigma0 {result['sigma0']:.3f}, redundancy {result['redundancy']}, {result['updates']} updates, "
            f"{result['rejected']} observations rejected"
        )
    return lines


def _row(title: str, metres: list[float], degrees: list[float] | None = None) -> str:
    text = f"  {title:<22}" + "".join(f"{v:8.3f}" for v in metres) + " m"
    return text + ("   " + "".join(f"{1e3 * v:8.2f}" for v in degrees) + " mdeg" if degrees else "")
