"""Pages of HTML from the templates of this package: one style, one file a page; every value is escaped."""

from __future__ import annotations

import base64
import io
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from .style import svg

_DPI = 160


def render(template: str, **values: Any) -> str:
    """A page; ``None`` among the values is shown as a dash.

    Raises
    ------
    jinja2.UndefinedError : the template needs a value that is not among them
    """
    return _PAGES.get_template(template).render(values)


def number(value: float | None, digits: int) -> str | None:
    """A number with so many digits behind the point."""
    return None if value is None else f"{value:.{digits}f}"


def mdeg(degrees: float | None, digits: int) -> str | None:
    """An angle in thousandths of a degree."""
    return None if degrees is None else number(1000.0 * degrees, digits)


def four_figures(value: float, factor: float = 1.0) -> str:
    """A number with four figures."""
    value *= factor
    return f"{value:.0f}" if abs(value) >= 1000.0 else f"{value:.4g}"


def drawing(figure: Figure | None) -> Markup | None:
    """A figure as an SVG element for a page."""
    return None if figure is None else Markup(svg(figure))


def picture(figure: Figure, title: str) -> Markup:
    """A figure as pixels, for one with so many points that an SVG element would be large."""
    file = io.BytesIO()
    FigureCanvasAgg(figure).print_figure(file, format="png", dpi=_DPI)
    data = base64.b64encode(file.getvalue()).decode("ascii")
    return Markup('<img alt="{}" src="data:image/png;base64,{}">').format(title, data)


def _shown(value: Any) -> Any:
    return "–" if value is None else value


_PAGES = Environment(
    loader=PackageLoader("triline.nodes.report"),
    autoescape=True,
    undefined=StrictUndefined,
    finalize=_shown,
    trim_blocks=True,
    lstrip_blocks=True,
)
_PAGES.filters |= {"number": number, "mdeg": mdeg, "four_figures": four_figures}
