"""The report as one HTML page that needs nothing else: figures and tables."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from html import escape
from typing import Any

from ...solver.window.determinability import LEFT_OF_PRIOR, NOT_YET
from ...solver.window.output import BETTER
from . import figures
from .accuracy_table import early_lines
from .evaluation import triangulated
from .flight import Flight
from .integrity_section import integrity_section
from .page_parts import captioned, number, table
from .page_style import CSS
from .style import styled

_MDEG = 1000.0
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
#: The flight is over: what was not determined by now will not be.
_OVER = {NOT_YET: "not determined by this flight"}
_PARAMETERS_NOTE = (
    f'<p class="note">Estimated: the sigma is at most {BETTER:g} of the a-priori one (of the camera: '
    f"{LEFT_OF_PRIOR**0.5:g}, if those that are not determined were known, and the tests of significance and "
    "correlation are passed), since the time in the flight that is given. What is not determined is in the sigmas of "
    "all results. The correlation is with another parameter of this table.</p>"
)
_SHOWN_REJECTED = 40
_SHOWN_EVENTS = 60


def page(flight: Flight, result: dict[str, Any]) -> str:
    """The page of a flight and its `analyse` result."""
    recording = result["recording"]
    title = f"Flight report: {recording['project'] or recording['file']}"
    with styled():
        body = [
            f"<h1>{escape(title)}</h1>",
            f'<p class="soft">{escape(_about(recording))}</p>',
            f'<p class="summary">{summary(result)}</p>',
            _warnings(result),
            _tiles(result),
            _missing(result["missing"]),
            _section("Flight", captioned(figures.trajectory_map(flight), _MAP_NOTE)),
            _section("Accuracy", *_accuracy(result)),
            _section("Errors against truth", captioned(figures.errors(flight), _ERRORS_NOTE)),
            _section("Integrity", *integrity_section(flight, result)),
            _section("Adjustment", captioned(figures.progress(flight), "")),
            _section("Correction functions", captioned(figures.correction_functions(flight), _CORRECTIONS_NOTE)),
            _section("Residuals in image space", captioned(figures.residuals(flight), _RESIDUALS_NOTE)),
            _section("Rejected observations", _rejected(result)),
            _section("Parameters", _parameters(result)),
            _section("Messages, nodes and events", *_operation(result)),
        ]
    return (
        f'<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8"><title>{escape(title)}</title>\n'
        f'<meta name="viewport" content="width=device-width, initial-scale=1"><style>{CSS}</style></head>\n'
        f"<body><main>\n{chr(10).join(part for part in body if part)}\n"
        f"<footer>triline analyze, {escape(recording['file'])}. Angles in tables of the orientation are in "
        "thousandths of a degree (mdeg).</footer>\n</main></body></html>\n"
    )


_MAP_NOTE = (
    "Flown trajectory and strips with object points. Arrows and bars are adjusted minus given coordinates, enlarged."
)
_ERRORS_NOTE = (
    "Estimate minus truth on the strips. The band is what the final orientation states of itself, three sigma."
)
_CORRECTIONS_NOTE = (
    "What is added to the measured orientation. The dashed line is what would have been right (truth minus measured)."
)
_RESIDUALS_NOTE = (
    "Measured minus computed at the last estimate of each point. Crosses: rejected rays at their place, without those "
    "that were taken back."
)


def summary(result: dict[str, Any]) -> str:
    """One line: how good it is."""
    parts = []
    points, better = result["points"] or result["check"], result.get("improvement", {})
    against = "truth" if result["points"] else "check points"
    direct, name = points.get("direct_georeferencing"), triangulated(points)
    if direct and name:
        d, f = (" / ".join(f"{v:.2f}" for v in points[n]["rmse_m"]) for n in ("direct_georeferencing", name))
        parts.append(
            f"object points {d} m by direct georeferencing, <b>{f} m</b> by on-line triangulation "
            f"({_POINTS[name]}; RMSE X / Y / Z of {points[name]['n']} points against {against})"
        )
    if "points" in better and all(better["points"]):
        parts.append(f"{min(better['points']):.1f} times better at least")
    if "sigma0" in result:
        parts.append(f"sigma0 <b>{result['sigma0']:.3f}</b>")
        parts.append(f"{result['rejected']} observations rejected")
    return (
        "; ".join(parts)[:1].upper() + "; ".join(parts)[1:] + "."
        if parts
        else "Nothing was adjusted in this recording."
    )


def _about(recording: dict[str, Any]) -> str:
    parts = [
        recording["file"],
        recording["start"],
        f"{recording['seconds']:.1f} s",
        f"{recording['messages']} messages",
    ]
    if recording["camera"]:
        parts.append(f"camera {recording['camera']}")
    parts.append(f"{recording['strips']} strip{'s' if recording['strips'] != 1 else ''}")
    return " · ".join(parts)


def _tiles(result: dict[str, Any]) -> str:
    recording = result["recording"]
    tiles = []
    if "sigma0" in result:
        # below 1 observations are better than they say: results are, too
        good = "good" if 0.9 <= result["sigma0"] <= 1.1 else "careful" if result["sigma0"] < 0.9 else "bad"
        text = "sigma0, 1 expected" + (": observations are better than they say" if good == "careful" else "")
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
            tiles.append(
                (f"{low:.1f}–{high:.1f} ×", f"better {text} than direct georeferencing", "good" if low > 1 else "bad")
            )
    tiles.append((f"{recording['tie_points']}", f"object points in {recording['rays']} rays", ""))
    tiles.append((f"{recording['control_points']} / {recording['check_points']}", "control / check points", ""))
    if "latency_s" in result:
        tiles.append((f"{1000 * result['latency_s']['median']:.0f} ms", "latency, newest ray to answer (median)", ""))
    lost = sum(topic["gaps"] for topic in result["topics"].values())
    tiles.append((str(lost), "messages missing by their numbers", "bad" if lost else "good"))
    cells = (f'<div class="tile {c}"><b>{escape(v)}</b><span>{escape(t)}</span></div>' for v, t, c in tiles)
    return f'<div class="tiles">{"".join(cells)}</div>'


def _warnings(result: dict[str, Any]) -> str:
    """What a reader must know before any figure: damage, and a flight that was not flown to its end."""
    lines = [f"Damaged recording: {line}. The figures are of what is left." for line in result["damage"]]
    lines += [f"{line[0].upper()}{line[1:]}." for line in early_lines(result)]
    return "".join(f'<div class="missing bad">{escape(line)}</div>' for line in lines)


def _missing(lines: list[str]) -> str:
    if not lines:
        return ""
    items = "".join(f"<li>{escape(line)}</li>" for line in lines)
    return f'<div class="missing">Not in this recording:<ul>{items}</ul></div>'


def _section(title: str, *parts: str) -> str:
    content = "\n".join(part for part in parts if part)
    return f"<section><h2>{escape(title)}</h2>\n{content}\n</section>" if content else ""


def _accuracy(result: dict[str, Any]) -> Iterable[str]:
    if result["orientation"]:
        yield "<h3>Exterior orientation against truth</h3>"
        heads = [
            ("RMSE [m]", "X Y Z"),
            ("RMSE [mdeg]", "ω φ κ"),
            ("σ stated [m]", "X Y Z"),
            ("σ stated [mdeg]", "ω φ κ"),
        ]
        rows = [
            (
                _ORIENTATION[name],
                row["n"],
                [row["rmse_m"], _times(row["rmse_deg"]), row.get("sigma_m"), _times(row.get("sigma_deg"))],
                None if name == "measured" else row.get("nees"),  # sensors state their noise, not their slow errors
                name == "final",
            )
            for name, row in result["orientation"].items()
        ]
        yield _accuracy_table(heads, rows, [3, 2, 3, 2])
    for key, title in (
        ("points", "Object points against truth"),
        ("check", "Object points against check points"),
        ("control", "Object points against control points"),
    ):
        if result[key]:
            yield f"<h3>{title}</h3>"
            heads = [("RMSE [m]", "X Y Z"), ("mean [m]", "X Y Z"), ("largest [m]", "X Y Z"), ("σ stated [m]", "X Y Z")]
            rows = [
                (
                    _POINTS[name],
                    row["n"],
                    [row["rmse_m"], row["mean_m"], row["max_m"], row.get("sigma_m")],
                    row.get("nees"),
                    name == triangulated(result[key]),
                )
                for name, row in result[key].items()
            ]
            yield _accuracy_table(heads, rows, [3, 3, 3, 3])
    if result["orientation"] or result["points"] or result["check"]:
        yield (
            '<p class="note">σ stated: root mean of the variances the estimates came with. NEES: mean normalised error '
            "squared per component, 1 if the stated covariance is right; sensors state their noise only. Direct "
            "georeferencing: intersection with the trajectory before triangulation; intersected: the same rays with "
            "the orientation of the adjustment, for the orientation's sake; adjusted: as published, the result. All "
            "rows count points that have both. Control points count only under control points. "
            "Orientations are compared on the strips, over the time the final orientation covers."
            f"{_left_out(result['poses_left_out'])}</p>"
        )


def _left_out(poses: dict[str, int]) -> str:
    if not poses:
        return ""
    counts = ", ".join(f"{n} {escape(name)}" for name, n in poses.items())
    return f" Poses that are not valid by their own account are left out: {counts}."


def _times(values: Sequence[float] | None) -> list[float] | None:
    return None if values is None else [_MDEG * v for v in values]


def _accuracy_table(heads: list[tuple[str, str]], rows: list[Any], digits: list[int]) -> str:
    top = '<tr><th rowspan="2">&nbsp;</th><th rowspan="2">n</th>'
    top += "".join(f'<th class="group" colspan="3">{escape(head)}</th>' for head, _ in heads)
    top += '<th rowspan="2" class="edge">NEES</th></tr><tr>'
    for _, names in heads:
        top += "".join(f"<th{_edge(i)}>{name}</th>" for i, name in enumerate(names.split()))
    body = ""
    for label, n, groups, nees, main in rows:
        body += f"<tr{' class=main' if main else ''}><td>{escape(label)}</td><td>{n}</td>"
        for values, d in zip(groups, digits, strict=True):
            for i in range(3):
                body += f"<td{_edge(i)}>{number(None if values is None else values[i], d)}</td>"
        body += f'<td class="edge">{number(nees, 2)}</td></tr>'
    return f'<div class="scroll"><table><thead>{top}</tr></thead><tbody>{body}</tbody></table></div>'


def _edge(i: int) -> str:
    return ' class="edge"' if i == 0 else ""


def _rejected(result: dict[str, Any]) -> str:
    rows = result["rejected_observations"]
    if not rows:
        return "<p>None.</p>" if "rejected" in result else ""
    shown = [
        (
            r["point"], r["strip"] or "–", r["ccd"] or r["coordinate"] or "–", r["reason"],
            *(number(r[k] if r["ccd"] else None, 2) for k in ("line", "sample")), number(r["w"], 1),
        )
        for r in rows[:_SHOWN_REJECTED]
    ]  # fmt: skip
    more = (
        f'<p class="note">The {_SHOWN_REJECTED} largest of {result["rejected"]}.</p>' if len(rows) > len(shown) else ""
    )
    return (
        table(("point", "strip", "CCD or coordinate", "reason", "line [px]", "sample [px]", "w"), shown, left=4) + more
    )


def _parameters(result: dict[str, Any]) -> str:
    rows = []
    for p in result["parameters"]:
        unit, scale = p["unit"], 1.0
        if unit.startswith("rad"):
            unit, scale = "mdeg" + unit[3:], figures.MDEG
        value, sigma = (None if p[k] is None else scale * p[k] for k in ("value", "sigma"))
        status = _OVER.get(p["status"], p["status"])
        since = "–" if p["estimated_since_s"] is None else f"{p['estimated_since_s']:.0f}"
        goes_with = f"{p['correlation']:+.2f} {p['partner']}" if p["partner"] else "–"
        numbers = since, _figures(value), _figures(sigma), number(p["t"], 1), goes_with
        rows.append((p["name"], unit, status, p["reason"] or "–", *numbers))
    heads = ("parameter", "unit", "status", "why", "since [s]", "value", "sigma", "t", "strongest correlation")
    return table(heads, rows, left=4, wrapped=(3,)) + _PARAMETERS_NOTE if rows else ""


def _figures(value: float | None) -> str:
    return "–" if value is None else f"{value:.4g}"


def _count(value: int | None) -> str:
    return "–" if value is None else str(value)


def _operation(result: dict[str, Any]) -> Iterable[str]:
    rows = [
        (name, t["messages"], number(t["rate_hz"], 1), t["gaps"], _count(t["unusable"]))
        for name, t in result["topics"].items()
    ]
    yield table(("topic", "messages", "rate [1/s]", "missing numbers", "unusable"), rows)
    yield (
        '<p class="note">Rate: between the first and the last message of the topic. Image lines and inertial data are '
        "counted, not looked at.</p>"
    )
    if result["nodes"]:
        rows = []
        for name, node in result["nodes"].items():
            counters = ", ".join(f"{key} {value}" for key, value in node["counters"].items() if value)
            rows.append((name, node["state"], counters or "–", node["last_problem"] or "–"))
        yield "<h3>Nodes, newest status</h3>" + table(
            ("node", "state", "counters", "last problem"), rows, left=4, wrapped=(1, 2, 3)
        )
    if result["events"]:
        rows = [(f"{e['time_s']:.2f}", e["level"], e["node"], e["text"]) for e in result["events"][-_SHOWN_EVENTS:]]
        yield "<h3>Events</h3>" + table(("time [s]", "level", "node", "event"), rows, left=4, wrapped=(3,))
