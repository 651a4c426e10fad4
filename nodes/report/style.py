"""How figures of a report look, and how they become part of a page."""

from __future__ import annotations

import io
from typing import Any, Literal, cast

from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure

FILTERED, LIVE, FINAL, TRUTH = "#8a94a6", "#e08a00", "#1b8a4b", "#111111"
CONTROL, CHECK, REJECTED, TIE = "#d62728", "#1f77c9", "#c218b0", "#5d9c76"
CCDS = ("#d1495b", "#b08900", "#3366cc", "#8e44ad", "#00838f")
WIDTH_IN = 9.6
_RC: dict[str, Any] = {
    "font.family": "DejaVu Sans",
    "font.size": 8.5,
    "axes.titlesize": 9.5,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.titley": 1.0,  # where it comes anyway: to find that out takes a sixth of the time of a page
    "axes.labelsize": 8.5,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "#e3e5ea",
    "grid.linewidth": 0.6,
    "axes.edgecolor": "#777777",
    "axes.axisbelow": True,
    "legend.frameon": False,
    "legend.fontsize": 8,
    "lines.linewidth": 1.2,
    "svg.fonttype": "path",
    "svg.hashsalt": "triline",
    "figure.dpi": 100,
    "savefig.dpi": 170,  # of artists that are drawn as pixels because there are many of them
}


def figure(height_in: float) -> Figure:
    """An empty figure as wide as the page."""
    return Figure(figsize=(WIDTH_IN, height_in), layout="constrained")


def styled() -> Any:
    """Context in which figures are made and written."""
    return rc_context(cast(Any, _RC))


def svg(fig: Figure) -> str:
    """The figure as an SVG element, without the XML head; the same figure gives the same text."""
    buffer = io.StringIO()
    FigureCanvasSVG(fig).print_svg(buffer, metadata={"Date": None, "Creator": None})
    text = buffer.getvalue()
    return text[text.index("<svg") :]


def scale_note(ax: Axes, text: str, side: Literal["left", "right"] = "right") -> None:
    """A note above an upper corner of the axes."""
    place = 0.0 if side == "left" else 1.0
    ax.text(place, 1.01, text, transform=ax.transAxes, ha=side, va="bottom", fontsize=8, color="#444444")
