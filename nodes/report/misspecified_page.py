"""Page of a study of worlds that are not as stated, in one file: a table and a picture for each setting."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from ...solver.simulation.misspecified_study import ROWS, Cell
from .render import drawing, number, render
from .style import FINAL, LIVE, TIE, figure, styled


def write_page(path: Path, cells: Sequence[Cell], what: str, words: Mapping[str, Sequence[str]], end: str) -> None:
    """Write the page.

    Parameters
    ----------
    what : was flown
    words : setting -> what is to be said beside its table
    end : how many limits hold
    """
    settings = []
    with styled():
        for setting in dict.fromkeys(cell.setting for cell in cells):
            mine = [cell for cell in cells if cell.setting == setting]
            rows = [_row(cell) for cell in mine]
            settings.append(
                {"name": setting, "rows": rows, "picture": drawing(_picture(mine)), "words": words[setting]}
            )
    path.write_text(render("misspecified.html", settings=settings, what=what, end=end), encoding="utf-8")


def _row(c: Cell) -> list[Any]:
    lights = "/".join(str(c.lights.get(name, 0)) for name in ("good", "weak", "failed"))
    missed = ", ".join(name for name, held in c.limits.items() if not held)
    return [
        ROWS[c.row].title, number(c.online_m, 3), number(c.worst_m, 2), c.worst_seed, number(c.direct_m, 2),
        number(c.batch_m, 3), number(c.components_m, 3), number(c.position_m, 3), number(1e3 * c.attitude_deg, 2),
        number(c.orientation_nees, 2), number(c.points_nees, 2), number(c.sigma0, 2), number(100.0 * c.rejected, 1),
        number(c.control_refused, 1), lights, missed,
    ]  # fmt: skip


def _picture(cells: Sequence[Cell]) -> Figure:
    """Bars of the errors of points, on line and of the two batches."""
    fig = figure(3.4)
    ax = fig.subplots()
    at = np.arange(len(cells))
    bars = (
        ("on line", [c.online_m for c in cells], LIVE),
        ("batch", [c.batch_m for c in cells], FINAL),
        ("batch with variance components", [c.components_m for c in cells], TIE),
    )
    for k, (label, heights, color) in enumerate(bars):
        ax.bar(at + 0.27 * (k - 1), heights, 0.27, label=label, color=color)
    ax.plot(at - 0.27, [c.worst_m for c in cells], "_", color="#111111", markersize=8)
    ax.set_yscale("log")
    ax.set_xticks(at, [ROWS[c.row].title for c in cells], rotation=30, ha="right")
    ax.set_ylabel("RMSE, m")
    ax.legend()
    return fig
