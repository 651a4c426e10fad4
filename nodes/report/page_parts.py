"""What sections of the page are made of: figures with a caption, numbers, tables."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from html import escape
from typing import Any

from .style import svg


def captioned(figure: Any, caption: str) -> str:
    """A figure with what is said below it; nothing without a figure."""
    if figure is None:
        return ""
    note = f"<figcaption>{escape(caption)}</figcaption>" if caption else ""
    return f"<figure>{svg(figure)}{note}</figure>"


def number(value: float | None, digits: int) -> str:
    """A number with so many digits, a dash without one."""
    return "–" if value is None else f"{value:.{digits}f}"


def table(heads: Sequence[str], rows: Iterable[Sequence[Any]], left: int = 1, wrapped: Sequence[int] = ()) -> str:
    """``left`` columns are set to the left; text in those that are ``wrapped`` takes as many lines as it needs."""

    def mark(i: int) -> str:
        names = ["left"] * (i < left) + ["wrap"] * (i in wrapped)
        return f' class="{" ".join(names)}"' if names else ""

    head = "".join(f"<th{' class=left' if i < left else ''}>{escape(h)}</th>" for i, h in enumerate(heads))
    body = "".join(
        "<tr>" + "".join(f"<td{mark(i)}>{escape(str(v))}</td>" for i, v in enumerate(row)) + "</tr>" for row in rows
    )
    return f'<div class="scroll"><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>'
