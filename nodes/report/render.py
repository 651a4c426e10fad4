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
_MOST_CHARACTERS = 76  # of the columns of a table of statistics in letters of usual size


def render(template: str, **values: Any) -> str:
    """A page; ``None`` among the values is shown as a dash.

    Raises
    ------
    jinja2.UndefinedError : the template needs a value that is not among them
    """
    return _PAGES.get_template(template).render(values)


def number(value: float | None, digits: int) -> str | None:
    """A number with so many digits behind the point, and no minus before zeros."""
    return None if value is None else f"{value:z.{digits}f}"


def mdeg(degrees: float | None, digits: int) -> str | None:
    """An angle in thousandths of a degree."""
    return None if degrees is None else number(1000.0 * degrees, digits)


def needs_room(rows: dict[str, Any], groups: list[tuple[str, str, int]]) -> bool:
    """Whether a table of statistics (see `accuracy` of parts.html) is wider than the page in letters of usual size."""
    wanted = 0
    for _, key, digits in groups:
        write = mdeg if key.endswith("_deg") else number
        told = [row[key] for row in rows.values() if key in row]
        wanted += sum(max((len(write(values[i], digits) or "") for values in told), default=1) for i in range(3))
    return wanted > _MOST_CHARACTERS


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
_PAGES.filters |= {"number": number, "mdeg": mdeg, "four_figures": four_figures, "needs_room": needs_room}
