"""``triline study scenes``: whether errors of adjusted satellite scenes are as large as their sigmas say."""

from __future__ import annotations

import argparse

from ...solver.simulation.scene_study import CONFIGURATIONS, SENSORS, ErrorRatio, error_over_sigma
from ..formats.json_text import json_text
from .common_options import refuse_less
from .progress import progress

EXAMPLE = "triline study scenes --seeds 50"

_BAND = (0.95, 1.05)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--seeds", type=int, default=50, metavar="N", help="simulated blocks a row (50)")
    parser.add_argument("--sensor", choices=SENSORS, help="one of the sensors (all)")


def run(args: argparse.Namespace) -> int:
    refuse_less(args, 1, "seeds")
    found: dict[tuple[str, str, str], ErrorRatio] = {}
    sensors = SENSORS if args.sensor is None else (args.sensor,)
    for sensor in sensors:
        for model, calibration in CONFIGURATIONS:
            with progress(f"{sensor} {model} {calibration}", args.quiet or args.json):
                found[sensor, model, calibration] = error_over_sigma(sensor, model, calibration, range(args.seeds))
    if args.json:
        rows = [
            {
                "sensor": key[0], "model": key[1], "selfcal": key[2] == "selfcal", "points": r.points,
                "unknowns": r.unknowns, "sigma0": r.sigma0, "rmse_m": r.rmse_m.tolist(), "sigma_m": r.sigma_m.tolist(),
            }
            for key, r in found.items()
        ]  # fmt: skip
        print(json_text({"seeds": args.seeds, "rows": rows}))
        return 0
    print(f"{args.seeds} simulated blocks a row, 80 points, 9 of them control; errors drawn as assumed")
    print(f"{'':34s}{'RMSE / sigma':>20s}{'RMSE, m':>24s}{'sigma, m':>24s}")
    print(f"{'':34s}{'points':>10s}{'unknowns':>10s}" + f"{'east':>8s}{'north':>8s}{'up':>8s}" * 2)
    for (sensor, model, calibration), r in found.items():
        name = f"{sensor}, {model.upper()}{' + self-calibration' if calibration == 'selfcal' else ''}"
        metres = "".join(f"{value:8.2f}" for value in (*r.rmse_m, *r.sigma_m))
        print(f"{name:34s}{r.points:10.3f}{r.unknowns:10.3f}{metres}")
    inside = sum(_BAND[0] < value < _BAND[1] for r in found.values() for value in (r.points, r.unknowns))
    print(f"{inside} of {2 * len(found)} ratios between {_BAND[0]} and {_BAND[1]}")
    return 0
