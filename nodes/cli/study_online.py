"""``triline study online``: the demo flight with many seeds through `process`, held against truth."""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from ...solver.accuracy import nees_band, normalised_error_squared
from ..adjuster.adjuster import Adjuster
from ..formats.json_text import json_text
from ..navigator.navigator import Navigator
from ..report.evaluation import evaluate_flight, orientation_errors
from ..report.flight import collect
from ..report.source import messages_of
from ..simulator.flight_settings import simulated_flight
from ..simulator.simulator import Simulator
from .common_options import refuse_less
from .study_flights import EPOCH_NS, each, processed

EXAMPLE = "triline study online --seeds 20"
KINDS = ("live", "final")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--seeds", type=int, default=20, metavar="N", help="simulated flights (20)")
    parser.add_argument("--seconds", type=float, default=60.0, metavar="X", help="length of the strip (60)")
    parser.add_argument("--unstabilised", action="store_true", help="no stabilised mount: 0.4 deg of jitter")


def run(args: argparse.Namespace) -> int:
    refuse_less(args, 2, "seeds")
    settings = {"seconds": args.seconds, "unstabilised": args.unstabilised}
    cases = [{**settings, "seed": seed} for seed in range(args.seeds)]
    result = summary(list(each(fly, cases, args.quiet or args.json)))
    print(json_text(result) if args.json else "\n".join(lines(result)))
    return 0


def fly(settings: dict[str, Any]) -> dict[str, Any]:
    """One flight: simulate, record, process the recording, evaluate."""
    messages = Simulator(simulated_flight(settings).simulation).messages(EPOCH_NS)
    with tempfile.TemporaryDirectory() as folder:
        flight = collect(messages_of(processed(messages, [Navigator(), Adjuster()], Path(folder))))
    evaluated = evaluate_flight(flight)
    middle = {}
    for kind, (_, error, covariance, _) in orientation_errors(flight).items():
        half = len(error) // 2
        middle[kind] = float(normalised_error_squared(error[half : half + 1], covariance[half : half + 1])[0]) / 6.0
    return {**evaluated, "middle_nees": middle}


def summary(flights: list[dict[str, Any]]) -> dict[str, Any]:
    """Root mean squares and normalised errors over flights."""
    n = len(flights)
    sigma0 = [f["sigma0"] for f in flights]

    def rms(*keys: str) -> list[float]:
        values = [_pick(f, keys) for f in flights]
        return np.sqrt(np.mean(np.square(values), axis=0)).tolist()

    consistency = {}
    for kind in KINDS:
        over_strip = np.array([f["orientation"][kind]["nees"] for f in flights])
        consistency[kind] = {
            "middle": float(np.mean([f["middle_nees"][kind] for f in flights])),
            "band": list(nees_band(n, 6)),
            "strip": float(over_strip.mean()),
            "strip_95": float(1.96 * over_strip.std(ddof=1) / np.sqrt(n)),
        }
    points = np.array([f["points"]["adjusted"]["nees"] for f in flights])
    consistency["points"] = {"strip": float(points.mean()), "strip_95": float(1.96 * points.std(ddof=1) / np.sqrt(n))}
    return {
        "flights": n,
        "orientation": {
            kind: {"rms_m": rms("orientation", kind, "rmse_m"), "rms_deg": rms("orientation", kind, "rmse_deg")}
            for kind in ("filtered", *KINDS)
        },
        "points": {kind: rms("points", kind, "rmse_m") for kind in ("direct_georeferencing", "adjusted")},
        "sigma0": {"mean": float(np.mean(sigma0)), "least": min(sigma0), "largest": max(sigma0)},
        "consistency": consistency,
    }


def lines(result: dict[str, Any]) -> list[str]:
    """The summary as a table."""
    out = [f"{result['flights']} flights, RMS against truth    X       Y       Z         omega     phi   kappa"]
    for kind, title in (("filtered", "filtered"), ("live", "on-line, at once"), ("final", "on-line, final")):
        row = result["orientation"][kind]
        out.append(
            f"  {title:<24}" + "".join(f"{v:8.3f}" for v in row["rms_m"]) + " m  "
            + "".join(f"{1e3 * v:8.2f}" for v in row["rms_deg"]) + " mdeg"
        )  # fmt: skip
    direct, adjusted = result["points"]["direct_georeferencing"], result["points"]["adjusted"]
    out.append("  direct georeferencing   " + "".join(f"{v:8.3f}" for v in direct) + " m   object points")
    out.append("  object points, final    " + "".join(f"{v:8.3f}" for v in adjusted) + " m")
    out.append("  improvement             " + "".join(f"{a / b:7.1f}x" for a, b in zip(direct, adjusted, strict=True)))
    s = result["sigma0"]
    out.append(f"sigma0 {s['mean']:.3f} ({s['least']:.3f} to {s['largest']:.3f})")
    out.append("normalised errors squared, 1 is right:")
    for kind, row in result["consistency"].items():
        text = f"  {kind:<8} over the strip {row['strip']:.2f} +- {row['strip_95']:.2f}"
        if "middle" in row:
            text += f"; in its middle {row['middle']:.2f}, 95 % band {row['band'][0]:.2f} to {row['band'][1]:.2f}"
        out.append(text)
    return out


def _pick(value: Any, keys: tuple[str, ...]) -> Any:
    for key in keys:
        value = value[key]
    return value
