"""Page of a sensitivity study, in one file: for every scene its table, maps of errors, convergence of Monte Carlo."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Ellipse
from numpy.typing import NDArray

from ...solver.sensitivity.scene_map import SceneMap
from .render import drawing, render
from .style import figure, styled

Array = NDArray[np.floating] | NDArray[np.int64]

#: Colours of parameters, by their place among those of the scene.
_COLORS = (
    "#1f77c9", "#e08a00", "#1b8a4b", "#d1495b", "#8e44ad", "#8c6d4f", "#c218b0", "#5f6b7a", "#b0a300", "#00838f",
)  # fmt: skip
_METHODS = (("share", "covariance"), ("fast_first", "FAST, first"), ("sobol_first", "Sobol, first"))


def write_page(path: Path, results: Sequence[dict[str, Any]], maps: Sequence[SceneMap]) -> None:
    """Write the page.

    Parameters
    ----------
    results : of `triline study sensitivity --json`, a scene each
    maps : of the same scenes
    """
    with styled():
        drawn = [
            {
                "table": result,
                "map": drawing(_map(found, _row_names(result, found))),
                "shares": drawing(_shares(result)),
                "convergence": drawing(_convergence(result)),
            }
            for result, found in zip(results, maps, strict=True)
        ]
    path.write_text(render("sensitivity.html", scenes=drawn, degrees=float(np.degrees(1.0))), encoding="utf-8")


def _row_names(result: dict[str, Any], found: SceneMap) -> list[str] | None:
    """Names of lines of detectors where the rows of a map are such lines."""
    rows = list(dict.fromkeys(place["row"] for place in result["map"]))
    return rows if rows and isinstance(rows[0], str) and len(rows) == len(found.rows) else None


def _map(found: SceneMap, row_names: list[str] | None) -> Figure | None:
    """Ellipses over the image, coloured by the parameter that dominates; beside them its share."""
    if (found.dominating < 0).all():
        return None
    fig = figure(4.6 if row_names is None else 3.2)
    left, right = fig.subplots(1, 2)
    across = float(np.ptp(found.columns)) / max(len(found.columns) - 1, 1) or 1.0
    down = float(np.ptp(found.rows)) / max(len(found.rows) - 1, 1) or 1.0
    larger, smaller, azimuth = found.ellipses
    unit = 0.42 / float(np.nanmax(larger))  # the largest ellipse nearly reaches its neighbours
    names = sorted({int(k) for k in found.dominating.ravel() if k >= 0})
    for i, j in np.argwhere(found.dominating >= 0):
        color = _COLORS[found.dominating[i, j] % len(_COLORS)]
        # drawn in steps of the grid, so that ellipses keep their shape; azimuth is clockwise from north
        left.add_patch(
            Ellipse(
                (float(found.columns[j]) / across, -float(found.rows[i]) / down),
                2 * unit * float(larger[i, j]), 2 * unit * float(smaller[i, j]),
                angle=90.0 - math.degrees(azimuth[i, j]),
                facecolor=color, alpha=0.35, edgecolor=color,
            )
        )  # fmt: skip
    left.set_aspect("equal")
    left.autoscale_view()
    left.margins(0.03)
    left.grid(visible=False)
    _ticks(left, found, found.columns / across, -found.rows / down, row_names)
    left.set_title(f"error ellipses (1 sigma, north up); the largest has {np.nanmax(larger):.3g} m")
    entries = [Line2D([], [], color=_COLORS[k % len(_COLORS)], marker="o", ls="", label=found.names[k]) for k in names]
    left.legend(handles=entries, title="dominates", loc="upper left", bbox_to_anchor=(1.0, 1.0))
    image = right.imshow(
        found.sigma, aspect="auto", cmap="viridis",
        extent=(-0.5, len(found.columns) - 0.5, len(found.rows) - 0.5, -0.5),
    )  # fmt: skip
    for i, j in np.argwhere(found.dominating >= 0):
        if found.dominating.size <= 200:
            k = found.dominating[i, j]
            color = "white" if image.norm(found.sigma[i, j]) < 0.7 else "black"  # viridis ends in yellow
            right.text(j, i, f"{100 * found.share[i, j, k]:.0f} %", ha="center", va="center", fontsize=5.5, color=color)
    right.grid(visible=False)
    _ticks(right, found, np.arange(len(found.columns)), np.arange(len(found.rows)), row_names)
    right.set_title("planimetric sigma, and the share of what dominates")
    fig.colorbar(image, ax=right, label="m")
    return fig


def _ticks(ax: Axes, found: SceneMap, x: Array, y: Array, row_names: list[str] | None) -> None:
    """Five columns and five rows of the map, or all named ones, at their places ``x`` and ``y`` in the axes."""
    columns = _five_of(len(found.columns))
    rows = np.arange(len(found.rows)) if row_names else _five_of(len(found.rows))
    ax.set_xticks(x[columns], [f"{found.columns[k]:.0f}" for k in columns])
    ax.set_yticks(y[rows], row_names or [f"{found.rows[k]:.0f}" for k in rows])
    ax.set_xlabel("column")
    ax.set_ylabel("line of detectors" if row_names else "row")


def _five_of(n: int) -> NDArray[np.int64]:
    return np.unique(np.linspace(0, n - 1, 5).round().astype(np.int64))


def _shares(result: dict[str, Any]) -> Figure:
    """Bars of the shares in the variance, by each method."""
    fig = figure(2.6)
    for ax, (name, of) in zip(fig.subplots(1, 2), result["results"].items(), strict=True):
        parameters = [(p, values) for p, values in of["parameters"].items() if values["sigma"]]
        width = 0.8 / len(_METHODS)
        for k, (key, label) in enumerate(_METHODS):
            heights = [np.nan if values[key] is None else values[key] for _, values in parameters]
            ax.bar(np.arange(len(parameters)) + (k - 1) * width, heights, width, label=label, color=_COLORS[k])
        ax.set_xticks(range(len(parameters)), [p for p, _ in parameters], rotation=30)
        ax.set_ylabel("share of the variance")
        ax.set_title(name)
    fig.axes[0].legend()
    return fig


def _convergence(result: dict[str, Any]) -> Figure:
    """Sigma of Monte Carlo after so many runs, over that by covariance."""
    fig = figure(2.2)
    ax = fig.subplots()
    for k, (name, of) in enumerate(result["results"].items()):
        if of["sigma_m"]:
            runs = [step["runs"] for step in of["convergence"]]
            ratio = [step["sigma_m"] / of["sigma_m"] for step in of["convergence"]]
            ax.semilogx(runs, ratio, marker="o", markersize=3, color=_COLORS[k], label=name)
    ax.axhline(1.0, color="#777777", linewidth=0.8)
    ax.set_xlabel("runs of Monte Carlo")
    ax.set_ylabel("its sigma over that\nby covariance")
    ax.legend()
    return fig
