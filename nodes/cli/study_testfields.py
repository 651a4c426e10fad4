"""``triline study testfields``: published accuracies beside those of the same networks on simulated data."""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Iterator
from typing import Any

from ...solver.simulation.testfield_study import Row, study
from ...solver.simulation.testfields import TESTFIELDS
from ..errors import UserError
from .progress import progress

EXAMPLE = "triline study testfields --seeds 10 --only pavia2000 zurich"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--seeds", type=int, default=5, metavar="N", help="simulated measurements of each network (5)")
    parser.add_argument(
        "--only", nargs="+", metavar="FIELD", help=f"some testfields only, of {', '.join(TESTFIELDS)}", default=[]
    )


def run(args: argparse.Namespace) -> int:
    unknown = [name for name in args.only if name not in TESTFIELDS]
    if unknown:
        raise UserError(f"--only {unknown[0]}: no such testfield, wanted {', '.join(TESTFIELDS)}")
    if args.seeds < 1:
        raise UserError(f"--seeds {args.seeds}, wanted 1 at least")
    fields = tuple(make() for name, make in TESTFIELDS.items() if not args.only or name in args.only)
    with progress("testfields", args.quiet or args.json) as tell:
        rows = study(fields, args.seeds, tell)
    if args.json:
        print(json.dumps({"seeds": args.seeds, "rows": [_plain(row) for row in rows]}, indent=2))
    else:
        for line in table(rows, args.seeds):
            print(line)
    return 0


def table(rows: list[Row], seeds: int) -> Iterator[str]:
    """Lines of the table; metres, RMSE of check points."""
    yield f"RMSE and sigma of check points, m; means over {seeds} simulated measurements"
    yield (
        f"{'':26s}{'':>7s} {'published RMSE':>15s} {'ours':>15s} {'published sigma':>15s} {'ours':>15s} "
        f"{'RMSE / sigma':>13s} {'sigma0, px':>17s}"
    )
    yield (
        f"{'testfield':26s}{'control':>7s}" + 4 * f" {'XY':>7s} {'Z':>7s}" + f" {'XY':>6s} {'Z':>6s} "
        f"{'published':>10s} {'ours':>6s}"
    )
    key = ""
    for row in rows:
        if row.field.key != key:
            key = row.field.key
            yield f"{row.field.name} (GSD {row.field.gsd_m:.3g} m)"
        c, p = row.configuration, row.configuration.published
        yield (
            f"  {c.label:24s}{c.control:7d} {_m(p.rmse_xy)} {_m(p.rmse_z)} {_m(row.rmse_xy)} {_m(row.rmse_z)} "
            f"{_m(p.sigma_xy)} {_m(p.sigma_z)} {_m(row.sigma_xy)} {_m(row.sigma_z)} "
            f"{row.ratio_xy:6.2f} {row.ratio_z:6.2f} "
            f"{_range(p.sigma0_px):>10s} {_two(row.sigma0_px):>6s}"
        )
        yield f"      {c.reason}"


def _m(value: float) -> str:
    return f"{'-':>7s}" if math.isnan(value) else f"{value:7.3f}"


def _two(value: float) -> str:
    return "-" if math.isnan(value) else f"{value:.2f}"


def _range(values: tuple[float, float]) -> str:
    low, high = values
    if math.isnan(low):
        return "-"
    return f"{low:.2f}" if low == high else f"{low:.2f}-{high:.2f}"


def _plain(row: Row) -> dict[str, Any]:
    p = row.configuration.published
    return {
        "testfield": row.field.key,
        "name": row.field.name,
        "configuration": row.configuration.label,
        "control": row.configuration.control,
        "gsd_m": row.field.gsd_m,
        "published": {
            "rmse_xy_m": _number(p.rmse_xy),
            "rmse_z_m": _number(p.rmse_z),
            "sigma_xy_m": _number(p.sigma_xy),
            "sigma_z_m": _number(p.sigma_z),
            "sigma0_px": [_number(v) for v in p.sigma0_px],
        },
        "rmse_xy_m": row.rmse_xy,
        "rmse_z_m": row.rmse_z,
        "sigma_xy_m": row.sigma_xy,
        "sigma_z_m": row.sigma_z,
        "rmse_over_sigma": [row.ratio_xy, row.ratio_z],
        "sigma0_px": _number(row.sigma0_px),
        "additional_parameters": row.parameters,
        "reason": row.configuration.reason,
    }


def _number(value: float) -> float | None:
    return None if math.isnan(value) else value
