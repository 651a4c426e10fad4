"""The accuracy of a flight as a few lines of text, which commands print at their end."""

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
#: Rows of points as they were published; a recording without them shows those intersected with the final orientation.
_POINTS = {
    "direct_georeferencing": "direct georeferencing",
    "adjusted_live": "adjusted on-line, at once",
    "adjusted": "adjusted on-line, final",
    "adjusted_whole": "adjusted after the strips",
}
_INTERSECTED = {"direct_georeferencing": "direct georeferencing", "final": "intersected, final pose"}
_HEAD = f"{'n':>6}       X       Y       Z  "
#: How the lines begin that say in ``missing`` of an evaluation that nothing was measured in images, and that there is
#: nothing to compare object points with.
NO_TIES, NO_TRUTH, NO_CHECK = "observation/tie", "truth/point", "check points"
#: What is said of check points that are no object points.
NONE_MEASURED = "none of them is measured in an image"
_NOTE = "sigma: root mean of the stated variances; NEES: squared errors over stated variances, 1 expected"


def accuracy_lines(result: dict[str, Any]) -> list[str]:
    """RMSE against truth of an evaluation (`evaluation.evaluate_flight`), with n and stated sigmas.

    The lines have 100 columns at most. Points are compared with check points where no truth is recorded. Where there is
    neither, only strips that were not flown to their end are named.
    """
    orientation, points = result["orientation"], result["points"] or result["check"]
    if not orientation and not points:
        return early_lines(result)
    against = "truth" if orientation or result["points"] else "check points"
    lines = [f"{'RMSE against ' + against:<28}{_HEAD}   omega     phi   kappa        NEES"]
    if orientation:
        lines.append("exterior orientation")
    # the smoothed trajectory is shown only where there is no filtered one
    shown = [
        name for name in _ORIENTATIONS if name in orientation and (name != "smoothed" or "filtered" not in orientation)
    ]
    for name in shown:
        row = orientation[name]
        nees = None if name == "measured" else row.get("nees")  # sensors state their noise, not their slow errors
        lines.append(_row(_ORIENTATIONS[name], row, [_figure(1e3 * v, 2) for v in row["rmse_deg"]], "mdeg", nees))
    title = "object points" if result["points"] or not points else "object points, check points"
    lines.append(f"{title:<60} sigma X       Y       Z")
    titles = _POINTS if "adjusted" in points else _INTERSECTED
    for name in (n for n in titles if n in points):
        row = points[name]
        sigma = [_figure(v) for v in row["sigma_m"]] if "sigma_m" in row else ["       -"] * 3
        lines.append(_row(titles[name], row, sigma, "m", row.get("nees")))
    lines += _conclusion(result, points)
    return [line.rstrip() for line in lines]


def _conclusion(result: dict[str, Any], points: dict[str, Any]) -> list[str]:
    lines = []
    gain = result.get("improvement", {}).get("points")
    if gain:
        lines.append(f"{'  improvement, final':<34}" + "".join(f"{v:7.1f}x" if v else "       -" for v in gain))
    elif not points:
        why = "the flight was too short, or no point got two looks"
        lacks = {name for name in (NO_TIES, NO_TRUTH, NO_CHECK) for line in result["missing"] if line.startswith(name)}
        if NO_TIES in lacks:
            why = "there is no tie point in it"
        elif f"{NO_CHECK}: {NONE_MEASURED}" in result["missing"]:
            why = "no check point is measured in an image, and tie points have no truth"
        elif {NO_TRUTH, NO_CHECK} <= lacks:
            why = "there is no check point in it, and no truth of the tie points"
        lines.append(f"  none: {why}")
    lines.append(_NOTE)
    if "sigma0" in result:
        lines.append(
            f"sigma0 {result['sigma0']:.3f}, redundancy {result['redundancy']}, {result['updates']} updates, "
            f"{result['rejected']} observations rejected"
        )
    return lines + early_lines(result)


def early_lines(result: dict[str, Any]) -> list[str]:
    """A line for each strip that was planned longer than it was recorded."""
    what = "the recording ends early" if result.get("damage") else "flight ended early"
    return [
        f"{what}: strip {s['strip']} after {s['flown_s']:.1f} s of {s['planned_s']:.1f} s planned"
        for s in result["ended_early"]
    ]


def _row(title: str, row: dict[str, Any], others: list[str], unit: str, nees: float | None) -> str:
    text = f"  {title:<26}{row['n']:6d}" + "".join(_figure(v) for v in row["rmse_m"]) + " m"
    return f"{text}{''.join(others)} {unit:<4}" + (f"{nees:7.2f}" if nees is not None else f"{'-':>7}")


def _figure(value: float, digits: int = 3) -> str:
    """Eight characters, a blank before the figure: without decimals where it is large, so that columns stay apart."""
    return f"{value:8.{digits if abs(value) < 1000.0 else 0}f}"
