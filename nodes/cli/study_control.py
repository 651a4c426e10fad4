"""``triline study control``: a block with many configurations and numbers of control points, held against check points.

Known points of the block become control, spread out over it; the rest are check points. Every trajectory model, number
of segments, order and set of additional parameters is adjusted with every number of control points.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...solver.adjustment.confidence_set import CONFIDENCE
from ...solver.camera.self_calibration import SELF_CALIBRATIONS
from ...solver.models import MODELS
from ..batch.scene_adjustment import SETS
from ..errors import UserError
from ..formats.json_text import json_text, plain
from ..formats.new_file import new_file, refuse_unless_writable
from ..formats.scene_block import is_scene_block, read_scene_block
from ..formats.table import write_table
from ..worker_pool import cores
from .adjust import read_input
from .common_options import refuse_less
from .control_runs import (
    AirborneBlock,
    Axes,
    Block,
    Configuration,
    Pool,
    SceneBlock,
    Settings,
    Work,
    default_numbers,
    pool_of,
    run_all,
    with_control,
)
from .control_verdict import Row, Study, judge, metres, verdict
from .outputs import refuse_unless_picture, write_picture
from .progress import progress

EXAMPLE = """triline study control block/ --snoop --plot control.png
  triline study control block/ --control 0 4 9 16 --model dgr ppm --segments 2 4 --selfcal none tls18 --csv runs.csv"""

#: A study of the user's own data: `triline study all` leaves it out.
WANTS_INPUT = True
RULE = (
    "control is spread out: the two known points farthest apart, then always the one farthest from all chosen; a "
    "single one is that nearest the middle"
)

Array = NDArray[np.floating]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("block", metavar="BLOCK", help="as for 'triline adjust': block folder, scenes, or recording")
    parser.add_argument(
        "--control",
        type=int,
        nargs="+",
        metavar="N",
        help="numbers of control points (0 4 9 16 25, as far as there are)",
    )
    parser.add_argument(
        "--control-sigma", type=float, metavar="M", help="of known points without a sigma, so that they can be control"
    )
    parser.add_argument("--model", nargs="+", choices=sorted(MODELS), help="trajectory models (dgr ppm lim)")
    parser.add_argument("--then", nargs="+", choices=("none", *sorted(MODELS)), help="second models (none)")
    parser.add_argument("--segments", type=int, nargs="+", metavar="N", help="of ppm (2 4; satellites 1 2)")
    parser.add_argument("--order", type=int, nargs="+", choices=(1, 2), help="of the polynomials of ppm (1 2)")
    parser.add_argument("--fixes", type=int, nargs="+", metavar="N", help="of lim (4 8; satellites 4)")
    parser.add_argument(
        "--selfcal", nargs="+", choices=("none", *SELF_CALIBRATIONS),
        help="additional parameters (none, and tls18 for one lens, lens for several and for satellites)",
    )  # fmt: skip
    parser.add_argument("--sets", nargs="+", choices=SETS, help="satellites: corrections a lens or a scene (lens)")
    parser.add_argument(
        "--correction", nargs="+", choices=("shift", "affine"), help="satellites: of scenes with RPC (both)"
    )
    parser.add_argument("--snoop", action="store_true", help="data snooping in every run")
    parser.add_argument("--iterations", type=int, metavar="N", help="of an adjustment, at most (30)")
    parser.add_argument("--jobs", type=int, metavar="N", help="processes (one a core)")
    parser.add_argument("--csv", type=Path, metavar="FILE", help="write one row a run")
    parser.add_argument("--plot", type=Path, metavar="FILE", help="write a picture (PNG, SVG, PDF)")
    parser.add_argument("--page", type=Path, metavar="FILE", help="write picture, table and points as a page (HTML)")


def run(args: argparse.Namespace) -> int:
    for path in (args.csv, args.page):
        if path:
            refuse_unless_writable(path)
    if args.plot:
        refuse_unless_picture(args.plot)
    refuse_less(args, 1, "segments", "fixes", "iterations", "jobs")
    if args.control_sigma is not None and not 0 < args.control_sigma < float("inf"):
        raise UserError(f"--control-sigma {args.control_sigma:g}, wanted more than 0")
    path = Path(args.block)
    block: Block = SceneBlock(read_scene_block(path)) if is_scene_block(path) else AirborneBlock(read_input(path))
    block = _with_sigma(block, args.control_sigma)
    pool = pool_of(block)
    numbers = _numbers(args.control, block, pool)
    configurations = block.configurations(
        Axes(**{name: tuple(dict.fromkeys(getattr(args, name) or ())) for name in Axes.__dataclass_fields__})
    )
    parts = {number: with_control(block, pool, number) for number in numbers}
    work = Work(
        {number: part for number, (part, _) in parts.items()},
        tuple((number, c) for number in numbers for c in configurations),
        Settings(args.snoop, args.iterations, pool.single),
    )
    with progress("configurations", args.quiet or args.json) as tell:
        runs = run_all(work, args.jobs or cores(), tell)
    if all(r.found is None for r in runs):
        raise UserError(f"{block.name}: none of {len(runs)} runs could be adjusted; {runs[0].failed}")
    study = judge(block, pool, {number: ids for number, (_, ids) in parts.items()}, runs)
    if args.csv:
        _write_csv(args.csv, study)
    if args.plot:
        write_picture(args.plot, lambda: _figure(study), dpi=130)
    if args.page:
        _page(args.page, study)
    if args.json:
        print(json_text(_content(study)))
    else:
        for line in _text(study, args.verbose, args.snoop):
            print(line)
    return 0


def _with_sigma(block: Block, sigma_m: float | None) -> Block:
    """The block with a sigma for full control and check points that state none."""
    if sigma_m is None:
        return block
    ground = block.ground
    variance = np.einsum("nii->ni", ground.covariance).reshape(-1, 3)
    covariance = ground.covariance.copy()
    covariance[~(variance > 0).all(axis=1) & np.isin(ground.role, ("control", "check"))] = sigma_m**2 * np.eye(3)
    return block.with_ground(replace(ground, covariance=covariance))


def _numbers(wanted: Sequence[int] | None, block: Block, pool: Pool) -> tuple[int, ...]:
    if wanted is None:
        return default_numbers(pool)
    for number in wanted:
        if 0 <= number <= pool.most:
            continue
        n, bare = len(pool.possible) + len(pool.always), len(pool.always)
        why = f"{bare} of its {n} known points state no sigma and can only be check points (--control-sigma M)"
        if not bare:
            why = f"of its {n} known points one at least must be left to check"
        raise UserError(f"--control {number}: wanted 0 to {pool.most} for {block.name}; {why}")
    return tuple(sorted(set(wanted)))


# what is printed and written


def _text(study: Study, verbose: bool, snooped: bool) -> Iterator[str]:
    pool, block = study.pool, study.block
    n = len(pool.possible) + len(pool.always)
    rays = "one image point each" if pool.single else "two image points or more"
    yield f"{block.name}: {n} known points with {rays}, {len(pool.possible)} of them can be control"
    if pool.single:
        yield "check points are compared in plan, at their given heights: no image point but one sees them"
    if len(pool.always):
        yield f"{len(pool.always)} state no sigma and are check points in every run"
    if len(pool.fixed):
        yield f"{len(pool.fixed)} planimetric and height points are control in every run and not counted"
    if len(pool.lost):
        missing = "no image point" if pool.single else "less than two image points"
        yield f"{len(pool.lost)} have {missing} and take no part"
    yield from (f"note: {note}" for note in block.notes)
    yield RULE
    if verbose:
        for number, ids in study.control.items():
            yield f"  {number}: {' '.join(ids) or '-'}"
    yield from _table(study)
    yield ""
    yield from verdict(study)
    for id, times in study.suspicious.items():
        yield f"check point {id} is off by {times:.1f} times its sigma with the best, too: are its coordinates right?"
    large = [row for row in study.rows if (f := row.run.found) and f.passed is False and f.sigma0 > 1.0]
    if 2 * len(large) > len(study.rows) and not snooped:
        yield f"sigma0 is too large in {len(large)} of {len(study.rows)} runs: gross errors? try --snoop"


def _table(study: Study) -> Iterator[str]:
    width = max(len("configuration"), *(len(row.run.configuration.label) for row in study.rows))
    common = f"{len(study.common)} common"
    yield ""
    yield f"{'':{width + 8}s}{'':>23s}{'RMSE of check points, m':>29s} {'predicted sigma, m':>26s} {'RMSE of the':>12s}"
    yield (
        f"control {'configuration':{width}s}{'check':>6s}{'unknowns':>9s}{'sigma0':>8s} "
        + (" {:>8s}" * 3).format(*study.block.axes) + (" {:>8s}" * 3).format(*study.block.axes) + f" {common:>12s}"
    )  # fmt: skip
    before = None
    for row in study.rows:
        number = str(row.run.control) if row.run.control != before else ""
        before = row.run.control
        start = f"{number:>7s} {row.run.configuration.label:{width}s}"
        found = row.run.found
        if found is None:
            yield f"{start}  {row.note}"
            continue
        figures = "".join(f" {metres(value)}" for value in (*row.rmse_m, *row.sigma_m))
        marks = "best" if row is study.best else "as good" if row.as_good and study.enough else ""
        fails = "!" if found.passed is False else " "
        yield (
            f"{start}{row.n_check:6d}{found.n_unknowns:9d}{found.sigma0:7.3f}{fails} {figures}"
            f" {metres(row.rmse_3d_m):>12s}  {marks or row.note}"
        ).rstrip()
    if any(row.run.found and row.run.found.passed is False for row in study.rows):
        yield "! sigma0 fails its chi-square test (95 %): errors or a-priori sigmas are not as stated"


def _content(study: Study) -> dict[str, Any]:
    ground, pool = study.block.ground, study.pool
    return {
        "project": study.block.name,
        "rule": RULE,
        "points": {
            name: [ground.id[k] for k in getattr(pool, name)] for name in ("possible", "always", "fixed", "lost")
        },
        "control": {number: list(ids) for number, ids in study.control.items()},
        "common_check": list(study.common),
        "axes": list(study.block.axes),
        "compared": study.where,
        "notes": list(study.block.notes),
        "confidence": CONFIDENCE,
        "check_points_enough": study.enough,
        "rows": [_entry(row) for row in study.rows],
        "best": None if study.best is None else study.rows.index(study.best),
        "simplest": None if study.simplest is None else study.rows.index(study.simplest),
        "suspicious_check": study.suspicious,
        "verdict": list(verdict(study)),
    }


def _entry(row: Row) -> dict[str, Any]:
    c, found = row.run.configuration, row.run.found
    figures: dict[str, Any] = dict.fromkeys(("n_unknowns", "redundancy", "sigma0", "sigma0_passed", "converged"))
    if found is not None:
        figures = {
            "n_unknowns": found.n_unknowns, "redundancy": found.redundancy, "sigma0": found.sigma0,
            "sigma0_passed": found.passed, "converged": found.converged,
        }  # fmt: skip
    return {
        "control": row.run.control, "configuration": c.label, "options": c.options,
        **{name: getattr(c, name) for name in Configuration.__dataclass_fields__},
        "n_check": row.n_check, **figures, "rmse_m": row.rmse_m, "sigma_m": row.sigma_m,
        "rmse_3d_common_m": row.rmse_3d_m, "expected_3d_common_m": row.expected_3d_m,
        "told_apart": row.told_apart, "as_good": row.as_good,
        "seconds": row.run.seconds, "note": row.note,
    }  # fmt: skip


def _write_csv(path: Path, study: Study) -> None:
    columns: dict[str, list[Any]] = {}
    for row in study.rows:
        entry = _entry(row)
        for name in ("rmse_m", "sigma_m"):
            kind = name.removesuffix("_m")
            entry |= {f"{kind}_{axis}_m": v for axis, v in zip(study.block.axes, entry.pop(name), strict=True)}
        for key, value in entry.items():
            if isinstance(value, bool):
                value = int(value)
            columns.setdefault(key, []).append("" if value is None else value)
    formats = {key: ".6g" for key in columns if key.endswith("_m") or key in ("sigma0", "seconds")}
    for key in formats:  # what failed has no figures
        columns[key] = [np.nan if v == "" else v for v in columns[key]]
    with new_file(path) as part:
        write_table(part, columns, formats)


def _figure(study: Study) -> Any:
    """Planimetry and height: a row for each configuration, a colour for each number of control points."""
    from matplotlib import colormaps
    from matplotlib.lines import Line2D
    from matplotlib.ticker import AutoLocator, LogLocator, NullFormatter

    from ..report.style import figure

    labels = list(dict.fromkeys(row.run.configuration.label for row in study.rows))
    numbers = list(study.control)
    colours = {n: colormaps["viridis"](0.9 * k / max(len(numbers) - 1, 1)) for k, n in enumerate(numbers)}
    x, y, z = study.block.axes
    fig = figure(1.5 + 0.24 * len(labels))
    shown_in = [(slice(0, 2), f"{x}, {y}")] + ([] if study.pool.single else [(slice(2, 3), z)])
    panels = fig.subplots(1, len(shown_in), sharey=True, squeeze=False)[0]
    for ax, (part, name) in zip(panels, shown_in, strict=True):
        for row in study.rows:
            if not np.isfinite(row.rmse_m[part]).all():
                continue
            n, colour = row.run.control, colours[row.run.control]
            at = labels.index(row.run.configuration.label) + 0.5 * (numbers.index(n) + 0.5) / len(numbers) - 0.25
            rmse, sigma = _mean(row.rmse_m[part]), _mean(row.sigma_m[part])
            ax.plot([rmse, sigma], [at, at], color=colour, linewidth=0.8)
            ax.plot(sigma, at, "|", color=colour, markersize=6)
            ax.plot(rmse, at, "o", color=colour, markersize=4)
            if row is study.best:
                ax.plot(rmse, at, "o", markersize=9, markerfacecolor="none", markeredgecolor="#d62728")
        ax.set_xscale("log")
        least, most = ax.get_xlim()
        ax.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)) if most > 5 * least else AutoLocator())
        ax.xaxis.set_major_formatter("{x:g}")
        ax.xaxis.set_minor_formatter(NullFormatter())
        ax.set_xlabel("m")
        ax.set_title(name)
    panels[0].set_yticks(range(len(labels)), labels)
    panels[0].set_ylim(len(labels) - 0.5, -0.5)
    shown = [Line2D([], [], color=colours[n], marker="o", markersize=4, label=f"{n} control") for n in numbers]
    shown.append(Line2D([], [], color="#555555", marker="o", linestyle="", markersize=4, label="RMSE of check points"))
    shown.append(Line2D([], [], color="#555555", marker="|", linestyle="", label="predicted sigma"))
    ring = {"markerfacecolor": "none", "markeredgecolor": "#d62728", "markersize": 9}
    shown += [Line2D([], [], marker="o", linestyle="", label="best", **ring)] if study.best else []
    fig.legend(handles=shown, loc="outside lower center", ncols=len(shown), fontsize=7.5)
    return fig


def _page(path: Path, study: Study) -> None:
    from ..report.render import drawing, render
    from ..report.style import styled

    heads = [f"{what} {axis}, m" for what in ("RMSE", "sigma") for axis in study.block.axes]
    rows = []
    for r in study.rows:
        found = r.run.found
        said = "best" if r is study.best else "as good" if r.as_good and study.enough else r.note.partition(":")[0]
        figures = [metres(v).strip() for v in (*r.rmse_m, *r.sigma_m, r.rmse_3d_m)]
        counts = [r.n_check, found.n_unknowns, f"{found.sigma0:.3f}"] if found else [None] * 3
        rows.append([r.run.control, r.run.configuration.label, *counts, *figures, said])
    why = [f"{r.run.control} control points, {r.run.configuration.label}: {r.note}" for r in study.rows if r.note]
    with styled():
        picture = drawing(_figure(study))
    with new_file(path) as part:
        page = render("control.html", study=plain(_content(study)), heads=heads, rows=rows, picture=picture, why=why)
        part.write_text(page, encoding="utf-8")


def _mean(values: Array) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
