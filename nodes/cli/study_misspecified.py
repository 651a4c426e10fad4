"""``triline study misspecified``: worlds that are not as they are stated, on line beside the batch."""

from __future__ import annotations

import argparse
import csv
import hashlib
import sys
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from ...solver.simulation.misspecified_study import (
    ROWS,
    SETTINGS,
    Cell,
    FlightFigures,
    cells_of,
    fly,
    through_window,
)
from ...solver.simulation.real_motion import RealMotion
from ..errors import UserError
from ..formats.json_text import json_text, plain
from ..formats.new_file import new_file, refuse_unless_writable
from ..simulator.flight_settings import GROUND_M
from ..simulator.motion_track import motion_of
from ..simulator.world_settings import world_text
from .misspecified_flights import Flown, KeptFlights, code_digest
from .misspecified_nodes import through_nodes
from .study_flights import each

ONLINE = {"nodes": through_nodes, "window": through_window}
EXAMPLE = "triline study misspecified --seeds 3 --rows stated sine-slow boresight --settings rtk"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--seeds", type=int, default=6, metavar="N", help="flights a row and setting (6)")
    parser.add_argument("--first", type=int, default=1, metavar="N", help="first seed (1)")
    parser.add_argument("--strips", type=int, default=1, metavar="N", help="parallel strips (1)")
    parser.add_argument("--seconds", type=float, default=60.0, metavar="X", help="length of a strip (60)")
    text = f"of {', '.join(ROWS)} (all)"
    parser.add_argument("--rows", nargs="+", choices=list(ROWS), default=list(ROWS), metavar="ROW", help=text)
    parser.add_argument("--settings", nargs="+", choices=list(SETTINGS), default=list(SETTINGS), help="stated (all)")
    parser.add_argument(
        "--online", choices=list(ONLINE), default="nodes",
        help="nodes: a recording through navigator and adjuster, as `process` does (default); window: the window alone "
        "with updates at fixed times, in two thirds of the time",
    )  # fmt: skip
    parser.add_argument(
        "--told", action="store_true",
        help="state the true sigmas and correlation times of the wander: what the data allow at best",
    )  # fmt: skip
    parser.add_argument("--motion", metavar="FILE", help="fly the motion recorded there, with the camera for 20 km")
    parser.add_argument("--from", type=float, default=0.0, dest="from_s", metavar="X", help="first second of it (0)")
    parser.add_argument(
        "--ground", type=float, default=GROUND_M, metavar="X",
        help=f"height of the ground under it above the ellipsoid, m ({GROUND_M:g})",
    )  # fmt: skip
    parser.add_argument("--jobs", type=int, default=2, metavar="N", help="processes (2)")
    parser.add_argument("--csv", metavar="FILE", help="also write a row of figures for each row and setting")
    parser.add_argument("--page", metavar="FILE", help="also write tables and pictures as a page (HTML)")
    parser.add_argument(
        "--flights", metavar="FILE",
        help="keep each flight there as soon as it is flown, and take from there what the same code has flown before: "
        "a study of hours goes on where it was stopped",
    )  # fmt: skip


def run(args: argparse.Namespace) -> int:
    if min(args.seeds, args.jobs, args.strips) < 1 or args.first < 0 or not args.seconds > 0:
        raise UserError("wanted --seeds, --jobs, --strips 1 at least, --first 0 at least, --seconds more than 0")
    if args.motion and args.strips > 1:
        raise UserError("a motion is one strip: wanted --motion or --strips")
    if not args.motion and (args.from_s or args.ground != GROUND_M):
        raise UserError("--from and --ground belong to a motion: wanted --motion")
    for path in (args.csv, args.page):
        if path:
            refuse_unless_writable(Path(path))
    motion = _motion(args) if args.motion else None
    rows = [row for row in ROWS if row in args.rows]
    keys = [(setting, row) for setting in args.settings for row in rows]
    flights = _flights(args, keys, motion)
    cells = cells_of(flights)
    if args.csv:
        write_csv(cells, Path(args.csv))
    if args.page:
        from ..report.misspecified_page import write_page  # draws with matplotlib

        words = {setting: remarks([cell for cell in cells if cell.setting == setting]) for setting in args.settings}
        with new_file(Path(args.page)) as part:
            write_page(part, cells, f"{args.seeds} flights a row, {_flown(args)}.", words, limits_line(cells))
    if args.json:
        print(json_text(document(args, cells, flights)))
    else:
        print("\n".join(lines(cells, args.seeds, _flown(args))))
    return 0


def _flights(
    args: argparse.Namespace, keys: Sequence[tuple[str, str]], motion: RealMotion | None
) -> dict[tuple[str, str], list[FlightFigures]]:
    """Every row with the first seed, then with the next: a study that is stopped has something of each."""
    kept = KeptFlights(Path(args.flights)) if args.flights else None
    plan, code = _plan(args), code_digest() if kept is not None else ""
    if kept is not None and (other := kept.of_other_code(code)):
        print(f"{kept.path}: {other} of {len(kept)} flights are of other code and are not taken", file=sys.stderr)
    seeds = range(args.first, args.first + args.seeds)
    wanted = [Flown(setting, row, seed, plan, code) for seed in seeds for setting, row in keys]
    found = {flown: kept.get(flown) if kept is not None else None for flown in wanted}
    missing = [flown for flown in wanted if found[flown] is None]
    cases = [(f.setting, f.row, f.seed, args.strips, args.seconds, args.online, motion, args.told) for f in missing]
    for flown, figures in zip(missing, each(_fly, cases, args.quiet or args.json, args.jobs), strict=True):
        found[flown] = figures
        if kept is not None:
            kept.add(flown, figures)
    flights: dict[tuple[str, str], list[FlightFigures]] = {key: [] for key in keys}
    for flown, figures in found.items():
        if figures is not None:
            flights[flown.setting, flown.row].append(figures)
    return flights


def _plan(args: argparse.Namespace) -> str:
    """What was asked for but rows, settings and seeds; a motion by what is in its file."""
    words = {name: getattr(args, name) for name in ("strips", "seconds", "online", "told")}
    if args.motion:
        words |= {"motion": hashlib.sha256(Path(args.motion).read_bytes()).hexdigest()[:12]}
        words |= {"from": args.from_s, "ground": args.ground}
    return ", ".join(f"{name} {value}" for name, value in words.items())


def _motion(args: argparse.Namespace) -> RealMotion:
    try:
        return motion_of(Path(args.motion), args.ground, args.from_s, args.seconds)[0]
    except ValueError as error:
        raise UserError(str(error)) from None


def _fly(case: tuple[str, str, int, int, float, str, RealMotion | None, bool]) -> FlightFigures:
    setting, row, seed, strips, seconds, online, motion, told = case
    return fly(setting, row, seed, strips, seconds, ONLINE[online], motion, told)


def document(
    args: argparse.Namespace, cells: Sequence[Cell], flights: dict[tuple[str, str], list[FlightFigures]]
) -> dict[str, Any]:
    """The machine-readable result: figures of each row and setting, and of each flight."""
    return {
        "seeds": args.seeds, "first": args.first, "strips": args.strips, "seconds": args.seconds, "online": args.online,
        "motion": args.motion or "", "told": args.told,
        "cells": [
            {**plain(asdict(cell)), "true": world_text(ROWS[cell.row].world),
             "each": [plain(asdict(f)) for f in flights[cell.setting, cell.row]]}
            for cell in cells
        ],
    }  # fmt: skip


def write_csv(cells: Sequence[Cell], path: Path) -> None:
    """One line a row and setting; a column a figure, `limit ...` 1 where it holds."""
    table = []
    for cell in cells:
        row = plain(asdict(cell))
        limits, lights = row.pop("limits"), row.pop("lights")
        table.append(
            {**row, **{name: lights.get(name, 0) for name in ("good", "weak", "failed")}}
            | {f"limit {name}": int(held) for name, held in limits.items()}
        )
    with new_file(path) as part, part.open("w", newline="") as out:
        writer = csv.DictWriter(out, list(table[0]))
        writer.writeheader()
        writer.writerows(table)


def _flown(args: argparse.Namespace) -> str:
    return _what(args) + (", true wander stated" if args.told else "")


def _what(args: argparse.Namespace) -> str:
    if args.motion:
        return f"{args.seconds:g} s of {Path(args.motion).name}"
    return f"{args.strips} strip{'s' if args.strips > 1 else ''} of {args.seconds:g} s"


def lines(cells: Sequence[Cell], seeds: int, flown: str) -> list[str]:
    """The figures as a table a setting, what the light said in the worst flight, and which limits do not hold."""
    out = [f"worlds that are not as stated: {seeds} flights a row, {flown}; 3D RMSE of points, m"]
    for setting in dict.fromkeys(cell.setting for cell in cells):
        out += ["", _HEAD.format(setting)]
        mine = [cell for cell in cells if cell.setting == setting]
        out += [_line(cell) for cell in mine]
        out += [f"  {line}" for line in remarks(mine)]
    return [*out, "", limits_line(cells)]


def remarks(cells: Sequence[Cell]) -> list[str]:
    """What is to be said of rows of a setting beside their figures."""
    out = []
    for cell in cells:
        if ROWS[cell.row].unknowable:
            title = ROWS[cell.row].title
            out.append(f"{title}: in the datum of control; against truth on line {cell.in_truth_m:.2f} m")
    return out + [f"the worst of {ROWS[c.row].title}, seed {c.worst_seed}: {c.worst_words or '-'}" for c in cells]


def limits_line(cells: Sequence[Cell]) -> str:
    """How many limits hold, and what the study took."""
    missed = sum(not held for cell in cells for held in cell.limits.values())
    total, took = sum(len(cell.limits) for cell in cells), sum(cell.seconds for cell in cells)
    count = sum(cell.flights for cell in cells)
    return f"{total - missed} of {total} limits hold; {count} flights, {took:.0f} s of processor time"


_HEAD = (
    "stated: {:<18s} on line  worst(seed)  direct   batch  +vc   position attitude  NEES     NEES  sigma0 rejected "
    "control  good/weak/  not met\n"
    "                                                                         m      mdeg  orient. points"
    "                refused     failed"
)


def _line(c: Cell) -> str:
    lights = "/".join(str(c.lights.get(name, 0)) for name in ("good", "weak", "failed"))
    missed = ", ".join(name for name, held in c.limits.items() if not held) or "-"
    return (
        f"  {ROWS[c.row].title:<25s}{c.online_m:7.3f} {c.worst_m:7.2f} ({c.worst_seed:2d}) {c.direct_m:8.2f} "
        f"{c.batch_m:7.3f} {c.components_m:6.3f} {c.position_m:7.3f} {1e3 * c.attitude_deg:8.2f} "
        f"{c.orientation_nees:7.2f} {c.points_nees:7.2f} {c.sigma0:7.2f} {100 * c.rejected:6.1f} % "
        f"{c.control_refused:7.1f}  {lights:>10s}  {missed}"
    )
