"""The page over all flights of a batch: where they lie, how good they are, and links to the report of each."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
from markupsafe import Markup
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from ..jobs.records import write_whole
from .batch_rows import light_words
from .integrity import LIGHTS
from .render import number, picture, render
from .strip_time import shortened
from .style import FILTERED, FINAL, LIVE, REJECTED, figure, styled

_COLORS = {"good": FINAL, "weak": LIVE, "failed": "#c0392b", "": FILTERED}
#: Flights that are named on the map; names of more would cover each other.
_MOST_NAMES = 25
_NAME = 30  # letters of a flight on the map


def write_page(path: Path, result: dict[str, Any]) -> None:
    """Write the page.

    Parameters
    ----------
    result : ``flights`` (see `batch_rows.flight_rows`), ``jobs`` and ``seconds``
    """
    rows = result["flights"]
    with styled():
        drawn = {"map": _picture(_map(rows), "Strips of all flights"), "curves": _picture(_curves(rows), "Quality")}
    text = render(
        "batch.html",
        result=result,
        figures=drawn,
        all_tiles=_tiles(result),
        heads=_heads(rows),
        flights=[_cells(row, adjusted=_adjusted(rows)) for row in rows],
        adjusted=_adjusted(rows),
        failures=[cells for row in rows for cells in _failures(row)],
        incomplete=[[row["flight"], "; ".join(row["incomplete"])] for row in rows if row["incomplete"]],
        damaged=[[row["flight"], "; ".join(row["damage"])] for row in rows if row["damage"]],
        steps=list(dict.fromkeys(name for row in rows for name in row["steps"])),
    )
    write_whole(path, text)


def _picture(drawn: Figure | None, title: str) -> Markup | None:
    return None if drawn is None else picture(drawn, title)


def _tiles(result: dict[str, Any]) -> list[tuple[str, str, str]]:
    rows, jobs = result["flights"], result["jobs"]
    done = sum(row["state"] == "finished" for row in rows)
    whole = "good" if done == len(rows) else "bad" if jobs["failed"] else "careful"
    tiles = [(f"{done} of {len(rows)}", "flights with all that was asked for", whole)]
    tiles += [(str(jobs["failed"]), "jobs failed, see below", "bad")] if jobs["failed"] else []
    hours = sum(row["seconds"] or 0.0 for row in rows) / 3600.0
    tiles.append((f"{hours:.1f} h" if hours >= 1 else f"{60 * hours:.1f} min", "of flight", ""))
    sigma0 = [row["sigma0"] for row in rows if row["sigma0"] is not None]
    if sigma0:
        text = f"sigma0, median; {min(sigma0):.2f} to {max(sigma0):.2f}; 1 expected"
        tiles.append((f"{np.median(sigma0):.3f}", text, "good" if max(sigma0) <= 1.1 else "careful"))
    nees = [row["nees"] for row in rows if row["nees"] is not None]
    if nees:
        text = f"NEES of the final orientation, mean of {len(nees)} flights with truth; 1 expected"
        tiles.append((f"{np.mean(nees):.2f}", text, "good" if 0.5 <= np.mean(nees) <= 2.0 else "bad"))
    lit = [row for row in rows if row["light"]]
    if lit:
        bad = sum(_mood(row) == "failed" for row in lit)
        time = np.array([row["lit_s"] or 0.0 for row in lit])
        share = float(np.average([row["light"]["good"] for row in lit], weights=time if time.sum() else None))
        tiles.append((f"{100 * share:.0f} %", "of the time on strips under a good light", ""))
        tiles += [(str(bad), "flights mostly under a failed light", "bad")] if bad else []
    return tiles


def _mood(row: dict[str, Any]) -> str:
    """The light that was on for longest, "" where none is known."""
    share = row["light"]
    return max(LIGHTS, key=lambda name: share.get(name, 0.0)) if share else ""


def _adjusted(rows: Sequence[dict[str, Any]]) -> bool:
    """Whether any flight was adjusted in a batch."""
    return any(row["adjust"] for row in rows)


def _heads(rows: Sequence[dict[str, Any]]) -> list[str]:
    """Heads of the columns of `_cells`."""
    adjusted = ["adjusted: sigma0", "RMSE X, m", "Y, m", "Z, m"] if _adjusted(rows) else []
    return [
        "flight", "state", "camera", "flown, s", "strips", "rays", "rejected", "sigma0", "NEES", "good / weak / failed",
        "RMSE X, m", "Y, m", "Z, m", *adjusted, "files",
    ]  # fmt: skip


def _cells(row: dict[str, Any], adjusted: bool) -> list[Any]:
    rmse, batch = row["rmse_m"] or (None,) * 3, row["adjust"] or {}
    check = batch.get("check_rmse_m") or (None,) * 3
    report = row["steps"].get("analyze", {}).get("output")
    others = [
        Markup('<a href="{}">{}</a>').format(quote(step["output"]), name)
        for name, step in row["steps"].items()
        if step["output"] and name != "analyze"
    ]
    return [
        Markup('<a href="{}">{}</a>').format(quote(report), row["flight"]) if report else row["flight"],
        row["state"],
        row["camera"],
        number(row["seconds"], 1),
        row["strips"],
        row["rays"],
        row["rejected"],
        number(row["sigma0"], 3),
        number(row["nees"], 2),
        light_words(row["light"]) if row["light"] else None,
        *(number(v, 3) for v in rmse),
        *((number(batch.get("sigma0"), 3), *(number(v, 3) for v in check)) if adjusted else ()),
        Markup(" ").join(others),
    ]


def _failures(row: dict[str, Any]) -> list[list[Any]]:
    return [
        [
            row["flight"], name, step["reason"], step["attempts"],
            Markup('<a href="{}">log</a>').format(quote(step["log"])) if step["log"] else None,
        ]
        for name, step in row["steps"].items()
        if step["state"] == "failed"
    ]  # fmt: skip


def _map(rows: Sequence[dict[str, Any]]) -> Figure | None:
    """The strips of all flights in the colour of their light."""
    lines = [
        (row, np.array(track["lon_deg"]), np.array(track["lat_deg"])) for row in rows for track in row["tracks"] or ()
    ]
    if not lines:
        return None
    lon, lat = np.concatenate([line[1] for line in lines]), np.concatenate([line[2] for line in lines])
    if np.ptp(lon) > 180.0:  # on both sides of the date line
        lines = [(row, np.where(x < 0, x + 360.0, x), y) for row, x, y in lines]
        lon = np.where(lon < 0, lon + 360.0, lon)
    shrink = max(float(np.cos(np.radians(lat.mean()))), 0.05)
    wide, high = max(np.ptp(lon) * shrink, 1e-4), max(np.ptp(lat), 1e-4)
    drawn = figure(float(np.clip(9.0 * high / wide, 2.4, 7.5)))
    ax = drawn.add_subplot()
    ax.set_aspect(1.0 / shrink, adjustable="datalim")
    for mood, color in _COLORS.items():
        chosen = [(x, y) for row, x, y in lines if _mood(row) == mood]
        for k, (x, y) in enumerate(chosen):
            label = (f"mostly {mood}" if mood else "light not known") if k == 0 else None
            dot = {"marker": ".", "markersize": 4.0, "markevery": [0]}  # seen where flights are far apart
            ax.plot(x, y, color=color, lw=1.6, solid_capstyle="butt", label=label, **dot)
    if len(rows) <= _MOST_NAMES:
        first = {row["flight"]: (float(x[0]), float(y[0])) for row, x, y in reversed(lines)}
        apart = 0.03 * max(float(np.ptp(lon)), float(np.ptp(lat)) / shrink)
        for (x, y), names in _by_place(first, apart):
            left = x <= (lon.min() + lon.max()) / 2
            text = {"fontsize": 7, "color": "#34495e", "ha": "left" if left else "right"}
            name = shortened(names[0], _NAME) + (f" + {len(names) - 1}" if len(names) > 1 else "")
            ax.annotate(name, (x, y), xytext=(3 if left else -3, 3), textcoords="offset points", **text)
    ax.set_xlabel("longitude [deg]")
    ax.set_ylabel("latitude [deg]")
    ax.ticklabel_format(useOffset=False)
    drawn.legend(loc="outside lower center", ncols=4)
    return drawn


def _by_place(first: dict[str, tuple[float, float]], apart: float) -> list[tuple[tuple[float, float], list[str]]]:
    """Places, longitude and latitude in degrees, each with the flights that begin less than ``apart`` from it."""
    found: list[tuple[tuple[float, float], list[str]]] = []
    for name, (x, y) in sorted(first.items()):
        names = next((names for (a, b), names in found if max(abs(a - x), abs(b - y)) < apart), None)
        if names is None:
            found.append(((x, y), [name]))
        else:
            names.append(name)
    return found


def _curves(rows: Sequence[dict[str, Any]]) -> Figure | None:
    """Sigma0, NEES and the share of rejected rays, flight by flight."""
    share = [
        100.0 * row["rejected"] / row["rays"] if row["rays"] and row["rejected"] is not None else None for row in rows
    ]
    curves = [
        ("sigma0", [row["sigma0"] for row in rows], 1.0),
        ("NEES", [row["nees"] for row in rows], 1.0),
        ("rejected observations in 100 rays", share, None),
    ]
    curves = [curve for curve in curves if any(v is not None for v in curve[1])]
    if not curves or len(rows) < 2:
        return None
    drawn = figure(0.5 + 1.35 * len(curves))
    axes = drawn.subplots(len(curves), 1, sharex=True, squeeze=False)[:, 0]
    for ax, (name, values, wanted) in zip(axes, curves, strict=True):
        known = [(k + 1, v) for k, v in enumerate(values) if v is not None]
        colors = [_COLORS[_mood(rows[k - 1])] for k, _ in known]
        ax.scatter([k for k, _ in known], [v for _, v in known], c=colors, s=14)
        if wanted is not None:
            ax.axhline(wanted, color=REJECTED, lw=0.8)
        ax.set_ylim(bottom=0.0, top=1.1 * max(1.0, *(v for _, v in known)))
        ax.set_title(name)
    axes[-1].xaxis.set_major_locator(MaxNLocator(integer=True))
    axes[-1].set_xlabel("flight, in the order of the table")
    return drawn
