"""The sliding window, measured: latency, consistency, a long flight. Efficiency: `efficiency.py`.

    python bench/window.py latency [--selfcal] [--interval 0.024]
    python bench/window.py consistency [--seeds 20] [--rough] [--model wander]
    python bench/window.py long [--minutes 20]

Set OPENBLAS_NUM_THREADS=1: the matrices are small, and threads cost more than they give. Times are processor times.
"""

from __future__ import annotations

import argparse
import json
import resource
from concurrent.futures import ProcessPoolExecutor
from functools import partial

import numpy as np

from triline.nodes.collection import RareCollections
from triline.solver.selfcalibration import tls
from triline.solver.simulation.flight import FlightPlan
from triline.solver.simulation.scenario import ObservationPlan, simulate
from triline.solver.simulation.window_study import (
    adjust_online,
    direct_points,
    measured_errors,
    navigate,
    orientation_errors,
    point_errors,
)
from triline.solver.window.results import WindowOptions

COMPONENTS = ("X", "Y", "Z", "omega", "phi", "kappa")


def latency(args: argparse.Namespace) -> dict[str, object]:
    """20 000 rays in a window of 40 s, while it is full; the end of the strip apart.

    Every 0.024 s is the adjuster's pace at 500 rays a second: 12 new rays an update.
    """
    simulation = simulate(FlightPlan(strip_s=110.0), 1, observation_plan=ObservationPlan(tie_points_per_s=300.0))
    RareCollections()
    parameters = tls(simulation.flight.camera) if args.selfcal else None
    options, interval_s = WindowOptions(window_s=40.0), args.interval
    result = adjust_online(simulation, navigate(simulation), options, parameters, live=False, update_s=interval_s)
    rays = np.array([r.rays for r in result.reports[: len(result.update_s)]])
    now_s = interval_s * (1 + np.arange(len(rays)))
    first_s, end_s = simulation.flight.strip_times_s[0]
    full = (now_s > first_s + 45.0) & (now_s < end_s - 2.0)
    rays, all_ms = rays[full], 1e3 * np.array(result.update_s)
    ms = all_ms[full]
    p50, p90, p99 = np.percentile(ms, [50, 90, 99])
    unknowns = max(r.unknowns - 3 * r.points for r in result.reports)
    return {
        "interval_s": interval_s,
        "rays in window": [int(rays.min()), int(rays.max())], "unknowns without points": unknowns,
        "updates": int(full.sum()),
        "p50_ms": p50, "p90_ms": p90, "p99_ms": p99, "max_ms": ms.max(),
        "share of a core": ms.mean() / 1e3 / interval_s,
        "max_ms at the end of the strip": all_ms[now_s > end_s].max(),
    }  # fmt: skip


def _plan(rough: bool, strip_s: float) -> FlightPlan:
    return FlightPlan(strip_s=strip_s, stabilised=not rough, turbulence=2.0 if rough else 1.0)


def _consistency(seed: int, rough: bool, model: str) -> dict[str, object]:
    simulation = simulate(_plan(rough, 60.0), seed)
    poses = navigate(simulation)
    result = adjust_online(simulation, poses, WindowOptions(model=model))
    live, final = orientation_errors(simulation, result.live), orientation_errors(simulation, result.final)
    points = point_errors(simulation, result.final_points)
    return {
        "nees": [live.nees.mean(), final.nees.mean(), points.nees.mean()],
        "sigma0": result.reports[-1].sigma0_total,
        "eo": final.rmse, "measured": measured_errors(simulation, poses, True).rmse,
        "points": points.rmse, "direct": direct_points(simulation, poses).rmse,
    }  # fmt: skip


def _rms(rows: list[dict], key: str) -> np.ndarray:
    return np.sqrt(np.mean([np.square(r[key]) for r in rows], axis=0))


def consistency(args: argparse.Namespace) -> dict[str, object]:
    """Normalised errors squared of live, final and points (1 expected), and the gain over direct georeferencing."""
    rows = _over_seeds(partial(_consistency, rough=args.rough, model=args.model), args.seeds)
    nees = np.array([r["nees"] for r in rows])
    band = 1.96 * nees.std(axis=0, ddof=1) / np.sqrt(len(rows))
    return {
        "seeds": len(rows),
        **{
            f"nees {name}": f"{m:.3f} +- {b:.3f}"
            for name, m, b in zip(("live", "final", "points"), nees.mean(0), band, strict=True)
        },
        "sigma0": float(np.mean([r["sigma0"] for r in rows])),
        "orientation, times better": dict(zip(COMPONENTS, _rms(rows, "measured") / _rms(rows, "eo"), strict=True)),
        "points, times better": dict(zip("XYZ", _rms(rows, "direct") / _rms(rows, "points"), strict=True)),
    }


def long(args: argparse.Namespace) -> dict[str, object]:
    """Strips without end: memory, latency and consistency over time."""
    strips = max(2, int(args.minutes * 60 / 140))
    simulation = simulate(FlightPlan(strips=strips), 1, observation_plan=ObservationPlan(tie_points_per_s=8.0))
    poses = navigate(simulation)
    memory: list[float] = []

    def watch(now: float, window) -> None:
        if int(now) % 60 == 0:
            memory.append(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)

    result = adjust_online(simulation, poses, live=False, watch=watch)
    ms = 1e3 * np.array(result.update_s)
    nees = [
        orientation_errors(simulation, [o for o in result.final if o.strip == s.id]).nees.mean()
        for s in simulation.flight.strips
    ]
    half = len(nees) // 2
    return {
        "minutes": simulation.flight.covered_s[-1, 1] / 60, "strips": strips,
        "peak memory MB, first and last minute (results are kept)": [memory[0], memory[-1]],
        "update ms, first and last quarter": [float(np.mean(ms[: len(ms) // 4])), float(np.mean(ms[-len(ms) // 4 :]))],
        "nees, first and second half": [float(np.mean(nees[:half])), float(np.mean(nees[half:]))],
    }  # fmt: skip


def _over_seeds(work, seeds: int) -> list[dict]:
    with ProcessPoolExecutor(2) as pool:
        return list(pool.map(work, range(1, seeds + 1)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("latency", "consistency", "long"))
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--rough", action="store_true", help="no stabilised mount, twice the turbulence")
    parser.add_argument("--model", default="wander")
    parser.add_argument("--selfcal", action="store_true", help="with TLS-18")
    parser.add_argument("--interval", type=float, default=0.2, help="platform time between updates (latency), s")
    parser.add_argument("--minutes", type=float, default=20.0)
    args = parser.parse_args()
    figures = {"latency": latency, "consistency": consistency, "long": long}[args.what](args)
    print(json.dumps(figures, indent=2, default=lambda v: round(float(v), 4)))


if __name__ == "__main__":
    main()
