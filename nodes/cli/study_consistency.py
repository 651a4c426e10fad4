"""``triline study consistency``: whether the errors of adjusted blocks are as large as their sigmas say."""

from __future__ import annotations

import argparse
import math

from ...solver.simulation.consistency import MODELS, Consistency, consistency
from ..formats.json_text import json_text
from .common_options import refuse_less
from .progress import progress

EXAMPLE = "triline study consistency --seeds 200"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--seeds", type=int, default=200, metavar="N", help="simulated blocks a model (200)")


def run(args: argparse.Namespace) -> int:
    refuse_less(args, 1, "seeds")
    cases = [(name, calibrated) for name in MODELS for calibrated in (False, True)]
    found: dict[str, Consistency] = {}
    for name, calibrated in cases:
        label = f"{name}{' + TLS-18' if calibrated else ''}"
        with progress(label, args.quiet or args.json) as tell:
            found[label] = consistency(MODELS[name], calibrated, args.seeds, tell)
    if args.json:
        print(json_text({"seeds": args.seeds, "models": {k: _plain(c) for k, c in found.items()}}))
        return 0
    low, high = next(iter(found.values())).passed_band
    print(
        f"{args.seeds} simulated blocks a model, errors drawn as assumed; 1 is right; of chi-square tests "
        f"{100 * low:.0f} to {100 * high:.0f} % should pass"
    )
    ratio = "RMSE / sigma of points, +- sigma"
    print(f"{'':16s}{ratio:>48s}{'orientation':>22s}{'camera':>9s}{'sigma0':>9s}{'test':>8s}")
    print(f"{'':16s}{'X':>16s}{'Y':>16s}{'Z':>16s}{'NEES (95 % band)':>22s}{'NEES':>9s}{'':>9s}{'passed':>8s}")
    for label, c in found.items():
        x, y, z = (f"{r:.3f} +- {s:.3f}" for r, s in zip(c.points, c.points_sigma, strict=True))
        band = f"{c.orientation:.3f} ({c.band[0]:.2f}-{c.band[1]:.2f})"
        camera = "-" if math.isnan(c.parameters) else f"{c.parameters:.3f}"
        print(f"{label:16s}{x:>16s}{y:>16s}{z:>16s}{band:>22s}{camera:>9s}{c.sigma0:9.4f}{100 * c.passed:7.0f} %")
    return 0


def _plain(c: Consistency) -> dict[str, object]:
    return {
        "rmse_over_sigma": c.points.tolist(),
        "rmse_over_sigma_sigma": c.points_sigma.tolist(),
        "orientation_nees": c.orientation,
        "orientation_nees_band": list(c.band),
        "camera_nees": c.parameters,
        "sigma0": c.sigma0,
        "chi_square_passed": c.passed,
        "chi_square_passed_band": list(c.passed_band),
    }
