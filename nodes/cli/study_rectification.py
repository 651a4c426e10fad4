"""``triline study rectification``: transforms of the plane, RPC and the differential method on the same points.

A frame image like BILSAT's (2048 x 2048 pixels of 27.6 m) over level ground and over relief. Each method is estimated
from the control points and judged by check points that it has not seen; RMSE of check points in east and north, metres,
and what an estimation takes. A second table has control with blunders, a third starts of the differential method that
are far off.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ...solver.rectification.comparison import METHODS, Compared, Noise, compare
from ..errors import UserError, flag
from ..formats.json_text import json_text
from ..formats.new_file import new_file, refuse_unless_writable
from ..formats.table import write_table
from .outputs import refuse_unless_picture, write_picture

if TYPE_CHECKING:
    from matplotlib.figure import Figure

EXAMPLE = "triline study rectification --control 25 --plot comparison.png --csv comparison.csv"
#: Errors of starts: position m, attitude degrees.
_STARTS = ((100.0, 0.02), (1e3, 0.1), (1e4, 1.0), (3e4, 4.0))
#: Share of control points that are blunders in the second table.
_BLUNDERS = 0.12


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--control", type=int, default=25, metavar="N", help="control points (25)")
    parser.add_argument("--check", type=int, default=100, metavar="N", help="check points (100)")
    parser.add_argument("--relief", type=float, default=1000.0, metavar="M", help="from valley to top (1000)")
    parser.add_argument("--pixel-sigma", type=float, default=0.3, metavar="PX", help="of what is measured (0.3)")
    parser.add_argument("--ground-sigma", type=float, default=5.0, metavar="M", help="of control, each way (5)")
    parser.add_argument("--height-sigma", type=float, default=5.0, metavar="M", help="of the terrain model (5)")
    parser.add_argument("--seeds", type=int, default=10, metavar="N", help="draws (10)")
    parser.add_argument("--csv", metavar="FILE", help="write one row a scene and method")
    parser.add_argument("--plot", metavar="FILE", help="write a picture of the comparison (PNG, SVG, PDF)")
    parser.add_argument("--page", metavar="FILE", help="write picture and tables as a page (HTML)")


def run(args: argparse.Namespace) -> int:
    if args.control < 3 or args.check < 1 or args.seeds < 1:
        raise UserError("--control: wanted at least 3, --check and --seeds: at least 1")
    for name in ("relief", "pixel_sigma", "ground_sigma", "height_sigma"):
        if not (np.isfinite(getattr(args, name)) and getattr(args, name) >= 0):
            raise UserError(f"{flag(name)} {getattr(args, name)}: wanted a number of at least 0")
    if args.pixel_sigma == args.ground_sigma == 0:
        raise UserError("--pixel-sigma, --ground-sigma: wanted one above 0")
    for path in (args.csv, args.page):
        if path:
            refuse_unless_writable(Path(path))
    if args.plot:
        refuse_unless_picture(Path(args.plot))
    noise = Noise(args.pixel_sigma, args.ground_sigma, args.height_sigma)
    sizes = (args.control, args.check)
    wrong = replace(noise, blunders=_BLUNDERS)
    tables: dict[str, dict[str, Compared]] = {
        "level ground": compare(METHODS, *sizes, 0.0, noise, args.seeds),
        f"relief of {args.relief:g} m": compare(METHODS, *sizes, args.relief, noise, args.seeds),
        f"relief, {round(wrong.blunders * args.control)} blunders": compare(
            METHODS, *sizes, args.relief, wrong, args.seeds
        ),
    }
    starts = {}
    for position, attitude in _STARTS:
        sigma = np.array([position] * 3 + [np.radians(attitude)] * 3)
        found = compare(
            ("differential",),
            *sizes,
            args.relief,
            noise,
            args.seeds,
            lambda rng, s=sigma: s * rng.choice([-1.0, 1.0], 6),
        )
        starts[f"{position / 1e3:g} km, {attitude:g} deg"] = found["differential"]
    if args.csv:
        _write_csv(Path(args.csv), tables)
    if args.plot:
        write_picture(Path(args.plot), lambda: _figure(tables), dpi=120)
    if args.page:
        _page(Path(args.page), args, tables, starts)
    if args.json:
        scenes = {scene: {name: _plain(got) for name, got in table.items()} for scene, table in tables.items()}
        print(json_text({"scenes": scenes, "starts": {name: _plain(got) for name, got in starts.items()}}))
    else:
        print(_text(args, tables, starts))
    return 0


def _plain(got: Compared) -> dict[str, Any]:
    return {
        "rmse_east_m": got.rmse_m[0], "rmse_north_m": got.rmse_m[1], "control_rmse_east_m": got.control_rmse_m[0],
        "control_rmse_north_m": got.control_rmse_m[1], "seconds": got.seconds, "failed": got.failed,
    }  # fmt: skip


def _text(args: argparse.Namespace, tables: dict[str, dict[str, Compared]], starts: dict[str, Compared]) -> str:
    lines = [
        f"{_what(args)}; RMSE of check points east, north, m (a pixel is 27.6 m)",
        f"{'':14s}" + "".join(f"{scene:>26s}" for scene in tables) + f"{'ms':>10s}",
    ]
    for name in METHODS:
        row = f"{name:14s}"
        for table in tables.values():
            row += f"{_rmse(table[name], 'too few points'):>26s}"
        lines.append(row + f"{1e3 * next(iter(tables.values()))[name].seconds:10.1f}")
    lines += [
        "",
        "differential method, first orientation wrong by",
        f"{'':22s}{'RMSE east, north, m':>22s}{'failed':>8s}",
    ]
    for name, got in starts.items():
        lines.append(f"{name:22s}{_rmse(got, '-'):>22s}{got.failed:8d}")
    return "\n".join(lines)


def _what(args: argparse.Namespace) -> str:
    return f"{args.control} control points, {args.check} check points, {args.seeds} draws"


def _rmse(got: Compared, none: str) -> str:
    return f"{got.rmse_m[0]:.1f} {got.rmse_m[1]:7.1f}" if np.isfinite(got.rmse_m).all() else none


def _write_csv(path: Path, tables: dict[str, dict[str, Compared]]) -> None:
    rows = [
        {"scene": scene, "method": name, **_plain(got)}
        for scene, table in tables.items()
        for name, got in table.items()
    ]
    formats = dict.fromkeys((key for key in rows[0] if key.endswith("_m")), ".3f") | {"seconds": ".6f"}
    with new_file(path) as part:
        write_table(part, {key: [row[key] for row in rows] for key in rows[0]}, formats)


def _figure(tables: dict[str, dict[str, Compared]]) -> Figure:
    from ..report.style import figure

    fig = figure(4.5)
    axes = fig.subplots()
    width = 0.8 / len(tables)
    for k, (scene, table) in enumerate(tables.items()):
        rmse = [float(np.hypot(*table[name].rmse_m)) for name in METHODS]
        axes.bar(np.arange(len(METHODS)) + (k - 0.5 * (len(tables) - 1)) * width, rmse, width, label=scene)
    axes.axhline(27.6, color="black", linewidth=0.8, linestyle=":", label="one pixel")
    axes.set_yscale("log")
    axes.set_xticks(range(len(METHODS)), METHODS, rotation=30, ha="right")
    axes.set_ylabel("RMSE of check points, m")
    axes.legend()
    return fig


def _page(
    path: Path, args: argparse.Namespace, tables: dict[str, dict[str, Compared]], starts: dict[str, Compared]
) -> None:
    from ..report.render import drawing, render
    from ..report.style import styled

    first = next(iter(tables.values()))
    methods = [
        [name, *(_rmse(table[name], "too few points") for table in tables.values()), f"{1e3 * first[name].seconds:.1f}"]
        for name in METHODS
    ]
    rows = [[name, _rmse(got, "-"), got.failed] for name, got in starts.items()]
    with styled():
        picture = drawing(_figure(tables))
    what = f"A frame image over level ground and over relief: {_what(args)}."
    with new_file(path) as part:
        page = render(
            "rectification.html", what=what, heads=list(tables), methods=methods, starts=rows, picture=picture
        )
        part.write_text(page, encoding="utf-8")
