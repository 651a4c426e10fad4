"""``triline study testfields``: published accuracies beside sigmas and simulated errors of the same networks."""

from __future__ import annotations

import argparse
import math
import textwrap
from collections.abc import Iterator
from typing import Any

from ...solver.simulation.published_network import NetworkSigma, network_sigmas
from ...solver.simulation.published_tables import NETWORKS
from ...solver.simulation.testfield_study import Row, study
from ...solver.simulation.testfields import TESTFIELDS, Published
from ..errors import UserError
from ..formats.json_text import json_text
from .common_options import refuse_less
from .progress import progress

EXAMPLE = "triline study testfields --seeds 10 --only pavia2000 zurich"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--seeds",
        type=int,
        default=5,
        metavar="N",
        help="placements of points, and simulated measurements (5)",
    )
    parser.add_argument(
        "--only", nargs="+", metavar="FIELD", help=f"some testfields only, of {', '.join(NETWORKS)}", default=[]
    )
    parser.add_argument("--sigmas", action="store_true", help="sigmas of the networks alone, nothing simulated")


def run(args: argparse.Namespace) -> int:
    unknown = [name for name in args.only if name not in NETWORKS]
    if unknown:
        raise UserError(f"--only {unknown[0]}: no such testfield, wanted {', '.join(NETWORKS)}")
    refuse_less(args, 1, "seeds")
    networks = tuple(make() for name, make in NETWORKS.items() if not args.only or name in args.only)
    with progress("sigmas", args.quiet or args.json) as tell:
        promised = network_sigmas(networks, args.seeds, tell)
    fields = tuple(make() for name, make in TESTFIELDS.items() if not args.only or name in args.only)
    rows: list[Row] = []
    if fields and not args.sigmas:
        with progress("testfields", args.quiet or args.json) as tell:
            rows = study(fields, args.seeds, tell)
    if args.json:
        plain = {"networks": [_plain_sigma(row) for row in promised], "rows": [_plain(row) for row in rows]}
        print(json_text({"seeds": args.seeds, **plain}))
        return 0
    for line in sigma_table(promised, args.seeds):
        print(line)
    if rows:
        print()
        for line in table(rows, args.seeds):
            print(line)
    return 0


def sigma_table(rows: list[NetworkSigma], placements: int) -> Iterator[str]:
    """Lines of the table of what networks promise; metres."""
    yield (
        "Published RMSE beside the sigma of the same network, m; no error is drawn, medians over "
        f"{placements} placements of points"
    )
    yield (
        f"{'':24s}{'points':>15s} {'published RMSE':>15s} {'published sigma':>15s} {'sigma here':>15s} "
        f"{'Z between':>13s} {'RMSE / sigma':>13s} {'sigma here':>14s}"
    )
    yield (
        f"{'testfield':24s}{'control':>8s}{'check':>7s}"
        + 3 * f" {'XY':>7s} {'Z':>7s}"
        + (f" {'':13s} {'XY':>6s} {'Z':>6s} {'/ published':>14s}")
    )
    key = ""
    for i, row in enumerate(rows):
        if row.network.key != key:
            key = row.network.key
            yield row.network.name
        p = row.row.published
        yield (
            f"  {row.row.label:22s}{row.row.control:8d}{row.row.check:7d} {_m(p.rmse_xy)} {_m(p.rmse_z)} "
            f"{_m(p.sigma_xy)} {_m(p.sigma_z)} {_m(row.sigma_xy)} {_m(row.sigma_z)} "
            f"{min(row.sigma_m[:, 2]):6.3f}-{max(row.sigma_m[:, 2]):<6.3f} "
            f"{_two(p.rmse_xy / row.sigma_xy):>6s} {_two(p.rmse_z / row.sigma_z):>6s} "
            f"{_two(row.sigma_xy / p.sigma_xy):>7s} {_two(row.sigma_z / p.sigma_z):>6s}"
        )
        if i + 1 == len(rows) or rows[i + 1].network.key != key:
            yield textwrap.fill(row.network.unsaid, 132, initial_indent=6 * " ", subsequent_indent=6 * " ")


def table(rows: list[Row], seeds: int) -> Iterator[str]:
    """Lines of the table of simulated measurements; metres, RMSE of check points."""
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


def _plain_sigma(row: NetworkSigma) -> dict[str, Any]:
    p = row.row.published
    return {
        "testfield": row.network.key,
        "name": row.network.name,
        "configuration": row.row.label,
        "control": row.row.control,
        "check": row.row.check,
        "published": _published(p),
        "sigma_xy_m": row.sigma_xy,
        "sigma_z_m": row.sigma_z,
        "sigma_m_of_placements": row.sigma_m.tolist(),
        "published_rmse_over_sigma": [p.rmse_xy / row.sigma_xy, p.rmse_z / row.sigma_z],
        "sigma_over_published": [row.sigma_xy / p.sigma_xy, row.sigma_z / p.sigma_z],
        "unsaid": row.network.unsaid,
    }


def _plain(row: Row) -> dict[str, Any]:
    return {
        "testfield": row.field.key,
        "name": row.field.name,
        "configuration": row.configuration.label,
        "control": row.configuration.control,
        "gsd_m": row.field.gsd_m,
        "published": _published(row.configuration.published),
        "rmse_xy_m": row.rmse_xy,
        "rmse_z_m": row.rmse_z,
        "sigma_xy_m": row.sigma_xy,
        "sigma_z_m": row.sigma_z,
        "rmse_over_sigma": [row.ratio_xy, row.ratio_z],
        "sigma0_px": row.sigma0_px,
        "additional_parameters": row.parameters,
        "reason": row.configuration.reason,
    }


def _published(p: Published) -> dict[str, Any]:
    return {
        "rmse_xy_m": p.rmse_xy,
        "rmse_z_m": p.rmse_z,
        "sigma_xy_m": p.sigma_xy,
        "sigma_z_m": p.sigma_z,
        "sigma0_px": list(p.sigma0_px),
    }
