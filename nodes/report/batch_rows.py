"""What came out of many flights: one row a flight, as a table on a terminal, as CSV and as JSON."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ..formats.json_text import json_text
from ..jobs.driver import Progress
from ..jobs.plan import Plan
from ..jobs.records import read_record, write_whole
from ..jobs.steps import STEPS
from ..recording.summary import OF_RECORDING
from .evaluation import triangulated
from .integrity import LIGHTS

#: So many rows are printed; the files have all.
MOST_LINES = 60
_COLUMNS = (
    "flight", "state", "camera", "seconds", "strips", "rays", "rejected", "sigma0", "nees", "good", "weak", "failed",
    "rmse_X_m", "rmse_Y_m", "rmse_Z_m", "against", "adjust_sigma0", "adjust_rejected", "adjust_rmse_X_m",
    "adjust_rmse_Y_m", "adjust_rmse_Z_m", "damage", "incomplete", "reason", "recording",
)  # fmt: skip


def flight_rows(plans: Sequence[Plan], progress: Progress) -> list[dict[str, Any]]:
    """One row a flight, in order.

    Returns
    -------
    dicts with

    - ``flight, recording, bytes``; ``state``: "finished", "failed" or "unfinished"; ``reason``: of the first failure;
      ``damage``: what of the recording could not be read, a line each, as the first step that met it said;
      ``incomplete``: nodes whose work failed at some messages, a line each;
    - ``steps``: by name ``state`` ("finished", "failed", "not begun"), ``reason``, ``seconds`` (of the job),
      ``attempts``, ``output`` and ``log`` (paths below the folder of results, None where they are not);
    - ``camera``: its name;
    - ``seconds, strips, rays, rejected, sigma0, nees, light`` (shares of LIGHTS in ``lit_s``, the time on strips),
      ``rmse_m`` (X, Y, Z) of object points
      ``against`` "truth" or "check points", ``tracks``: of the report, see `analysis.analyse`; None without one;
    - ``adjust``: ``sigma0, rejected, check_rmse_m`` of the batch adjustment; None without one.
    """
    return [_row(plan, progress) for plan in plans]


def _row(plan: Plan, progress: Progress) -> dict[str, Any]:
    steps = {name: _step(plan, name, progress) for name in plan.jobs}
    states = {step["state"] for step in steps.values()}
    state = "failed" if "failed" in states else "unfinished" if "not begun" in states else "finished"
    told = {name: _told(plan, name) if step["state"] == "finished" else {} for name, step in steps.items()}
    report, adjusted = told.get("analyze", {}), told.get("adjust", {})
    held = report.get("recording", {})
    against = next((key for key in ("points", "check") if report.get(key)), None)
    of = triangulated(report[against]) if against else None
    check = adjusted.get("check") or {}
    return {
        "flight": plan.source.name,
        "recording": plan.source.path,
        "bytes": plan.source.size,
        "state": state,
        "reason": next((f"{name}: {step['reason']}" for name, step in steps.items() if step["reason"]), None),
        "damage": next(filter(None, map(_damage, told.values())), []),
        "incomplete": [f"{node} {text}" for node, text in (told.get("process", {}).get("failed") or {}).items()],
        "steps": steps,
        "camera": held.get("camera"),
        "seconds": held.get("seconds"),
        "strips": held.get("strips"),
        "rays": held.get("rays"),
        "rejected": report.get("rejected"),
        "sigma0": report.get("sigma0"),
        "nees": report.get("orientation", {}).get("final", {}).get("nees"),
        "light": report.get("integrity", {}).get("share"),
        "lit_s": report.get("integrity", {}).get("seconds"),
        "rmse_m": report[against][of]["rmse_m"] if against and of else None,
        "against": {"points": "truth", "check": "check points"}[against] if against and of else None,
        "tracks": report.get("tracks"),
        "adjust": {
            "sigma0": adjusted.get("sigma0"), "rejected": len(adjusted.get("rejected") or ()),
            "check_rmse_m": check.get("rmse_m"),
        } if adjusted else None,
    }  # fmt: skip


def _step(plan: Plan, name: str, progress: Progress) -> dict[str, Any]:
    folder, key = Path(plan.jobs[name].folder), (plan.source.name, name)
    outcome = progress.outcomes.get(key)
    good = name in plan.finished or (outcome is not None and outcome.good)
    failed = outcome is not None and not outcome.good
    record = read_record(folder, name) if good else None
    log = folder / f"{name}.log"
    return {
        "state": "finished" if good else "failed" if failed else "not begun",
        "reason": outcome.reason if outcome is not None and failed else None,
        "seconds": record["seconds"] if record else None,
        "attempts": outcome.attempts if outcome is not None else 0,
        "output": f"{plan.source.name}/{STEPS[name].output}" if good else None,
        "log": f"{plan.source.name}/{log.name}" if log.is_file() else None,
    }


def _damage(told: dict[str, Any]) -> list[str]:
    """What of a recording a command could not read; `adjust` says it among its notes."""
    sign = OF_RECORDING
    noted = [note.removeprefix(sign) for note in told.get("notes") or () if note.startswith(sign)]
    return told.get("damage") or noted


def _told(plan: Plan, name: str) -> dict[str, Any]:
    """What a command said of its result."""
    try:
        told = json.loads((Path(plan.jobs[name].folder) / f"{name}.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return told if isinstance(told, dict) else {}


def write_tables(out: Path, result: dict[str, Any]) -> None:
    """Write summary.json and summary.csv."""
    write_whole(out / "summary.json", json_text(result, indent=1) + "\n")
    file = io.StringIO()
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow(_COLUMNS)
    for row in result["flights"]:
        light, rmse, adjusted = row["light"] or {}, row["rmse_m"] or (None,) * 3, row["adjust"] or {}
        check = adjusted.get("check_rmse_m") or (None,) * 3
        cells = {
            **row, **{key: "; ".join(row[key]) or None for key in ("damage", "incomplete")},
            **{name: light.get(name) for name in LIGHTS},
            "rmse_X_m": rmse[0], "rmse_Y_m": rmse[1], "rmse_Z_m": rmse[2],
            "adjust_sigma0": adjusted.get("sigma0"), "adjust_rejected": adjusted.get("rejected"),
            **{f"adjust_rmse_{axis}_m": value for axis, value in zip("XYZ", check, strict=True)},
        }  # fmt: skip
        writer.writerow("" if cells[name] is None else cells[name] for name in _COLUMNS)
    write_whole(out / "summary.csv", file.getvalue())


def table_lines(rows: Sequence[dict[str, Any]], every: bool = False) -> list[str]:
    """The rows as lines of text; of very many only those that failed and the first ones, unless all are wanted."""
    shown = list(rows)
    if len(shown) > MOST_LINES and not every:
        shown = sorted(rows, key=lambda row: row["state"] == "finished")[:MOST_LINES]
    width = max((len(row["flight"]) for row in shown), default=0)
    width = min(max(width, 6), 40)
    lines = [
        f"{'flight':<{width}}  {'flown':>8}  {'rays':>7} {'rejected':>8}  {'sigma0':>6}  {'NEES':>5}  "
        f"{'good/weak/failed':>16}  {'RMSE X':>7} {'Y':>7} {'Z':>7}"
    ]
    for row in shown:
        name = row["flight"] if len(row["flight"]) <= width else "…" + row["flight"][1 - width :]
        if row["state"] != "finished":
            lines.append(f"{name:<{width}}  {row['state']}: {row['reason'] or 'to be done'}")
            continue
        flown = "-" if row["seconds"] is None else f"{row['seconds']:.1f} s"
        rmse = " ".join("      -" if v is None else f"{v:7.3f}" for v in row["rmse_m"] or (None,) * 3)
        lines.append(
            f"{name:<{width}}  {flown:>8}  {_whole(row['rays']):>7} {_whole(row['rejected']):>8}  "
            f"{_number(row['sigma0'], 3):>6}  {_number(row['nees'], 2):>5}  {light_words(row['light']):>16}  {rmse}"
            + (" m" if row["rmse_m"] else "")
        )
        if row["damage"]:
            lines.append(f"{'':<{width}}  {OF_RECORDING}{'; '.join(row['damage'])}")
        lines += [f"{'':<{width}}  {text}" for text in row["incomplete"]]
    if len(shown) < len(rows):
        lines.append(f"... and {len(rows) - len(shown)} more, in summary.csv (-v prints all)")
    return lines


def light_words(share: dict[str, float] | None) -> str:
    """Time under each light, in per cent."""
    return "-" if not share else "/".join(f"{100 * share.get(name, 0.0):.0f}" for name in LIGHTS) + " %"


def _whole(value: int | None) -> str:
    return "-" if value is None else str(value)


def _number(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"
