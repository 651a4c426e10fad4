"""Gross errors: the window's data snooping against the batch adjustment's, of the same data.

    python bench/outliers.py [--seeds 20] [--share 0.2] [--px 5 40]

One strip of 40 s a seed; a share of the rays of tie points are blunders of so many pixels. Compared are RMSE over all
seeds of X, Y, Z, omega, phi, kappa and of object points with three rays or more: the whole strip from the window
(after the backward pass) against the batch adjustment with data snooping; and each against itself without the
blunders. A figure that comes from a few bad flights is told by the worst flight beside it.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import frame
import numpy as np

from triline.solver.adjustment.job import BatchResult, Job, run
from triline.solver.models.wander import WanderOptions
from triline.solver.simulation.error_models import ErrorModel
from triline.solver.simulation.flight import FlightPlan
from triline.solver.simulation.flight_network import batch_errors, network_of
from triline.solver.simulation.scenario import ObservationPlan, Simulation, simulate
from triline.solver.simulation.window_study import (
    OnlineResult,
    TimedPose,
    adjust_online,
    navigate,
    orientation_errors,
    slow_errors_of,
)
from triline.solver.window.results import WindowOptions

ERRORS = ErrorModel(attitude_rate_hz=100.0)
PLAN = FlightPlan(strip_s=40.0, lead_in_s=3.0, lead_out_s=2.0)
Rays = set[tuple[str, str]]


def batch(simulation: Simulation, poses: list[TimedPose], snoop: bool) -> BatchResult:
    """The batch adjustment with the window's default model and segments."""
    return run(network_of(simulation, poses), Job(WanderOptions(slow_errors_of(simulation.errors)), snoop=snoop))


def batch_points(found: BatchResult) -> tuple[dict[str, np.ndarray], Rays]:
    """Object points, and the rays that take part by point and CCD line."""
    network, kept = found.network, found.solution.ray_weight > 0
    ccd = [line.id for line in network.camera.lines]
    rays = {
        (network.point_ids[p], ccd[c]) for p, c in zip(network.rays.point[kept], network.rays.ccd[kept], strict=True)
    }
    return dict(zip(network.point_ids, found.solution.state.points_l, strict=True)), rays


def window_points(result: OnlineResult) -> tuple[dict[str, np.ndarray], Rays]:
    """The same of the window, after the backward pass."""
    points = result.whole_points
    rays = {(p.name, r.look.ccd) for p in points.values() for r in p.residuals if not r.rejected}
    return {p.name: p.xyz_l for p in points.values()}, rays


def one_flight(seed: int, share: float, px: tuple[float, float]) -> dict[str, np.ndarray]:
    """Errors of orientation and of points, counts of rays."""
    ties = ObservationPlan(tie_points_per_s=8.0, check=10, outlier_share=share, outlier_px=px)
    simulation = simulate(PLAN, seed, ERRORS, ties)
    poses = navigate(simulation)
    clean = replace(simulation, images=simulation.images.select(~simulation.images.outlier))
    options = WindowOptions(grid_hz=5.0)
    online = {
        "window": adjust_online(simulation, poses, options, live=False, update_s=0.5),
        "window clean": adjust_online(clean, poses, options, live=False, update_s=0.5),
    }
    at_once = {"batch": batch(simulation, poses, True), "batch clean": batch(clean, poses, False)}
    found = {n: window_points(r) for n, r in online.items()} | {n: batch_points(r) for n, r in at_once.items()}
    sets = {n: {p for p, _ in rays} for n, (_, rays) in found.items()}
    place = {str(id): i for i, id in enumerate(simulation.points.id)}
    looks, lines = simulation.images.looks, simulation.flight.camera.lines
    good = {
        (str(simulation.points.id[p]), lines[c].id)
        for p, c, bad in zip(looks.point, looks.ccd, simulation.images.outlier, strict=True)
        if not bad
    }
    counts: dict[str, int] = {}
    for p, _ in good:
        counts[p] = counts.get(p, 0) + 1
    names = sorted(p for p, n in counts.items() if n >= 3 and all(p in s for s in sets.values()) and
                   simulation.points.role[place[p]] != "control")  # fmt: skip
    truth = simulation.points.xyz_l[[place[p] for p in names]]
    strip, times = simulation.flight.strips[0].id, np.concatenate([o.time_s for o in online["window"].whole])
    result = {n: orientation_errors(simulation, r.whole).error for n, r in online.items()}
    result |= {n: batch_errors(simulation, r, strip, times) for n, r in at_once.items()}
    result["final"] = orientation_errors(simulation, online["window"].final).error
    result["final clean"] = orientation_errors(simulation, online["window clean"].final).error
    result |= {f"points {n}": np.array([xyz[p] for p in names]) - truth for n, (xyz, _) in found.items()}
    looked = np.bincount(looks.point, minlength=len(simulation.points))
    checked = {str(id) for id, n in zip(simulation.points.id, looked, strict=True) if n >= 3}
    of_these = {r for r in good if r[0] in checked}
    for n in ("window", "batch"):
        rays = {r for r in found[n][1] if r[0] in checked}
        result[f"rays {n}"] = np.array([[len(rays - good), len(of_these - rays), len(of_these)]])
    return result


PAIRS = (
    ("window", "batch"), ("window clean", "batch clean"), ("window", "window clean"),
    ("final", "final clean"), ("batch", "batch clean"),
    ("points window", "points batch"), ("points window", "points window clean"), ("points batch", "points batch clean"),
)  # fmt: skip


def main() -> None:
    parser = frame.parser(__doc__, seeds=20)
    parser.add_argument("--share", type=float, default=0.2, help="of the rays of tie points that are blunders")
    parser.add_argument("--px", type=float, nargs=2, default=(5.0, 40.0), help="least and largest blunder")
    args = parser.parse_args()
    flights = list(frame.over_seeds(partial(one_flight, share=args.share, px=tuple(args.px)), args.seeds))
    print(
        f"{100 * args.share:.0f} % blunders of {args.px[0]:g} to {args.px[1]:g} px, {args.seeds} flights: RMSE / RMSE"
    )
    for one, two in PAIRS:
        a, b = (np.sqrt(np.mean(np.concatenate([f[n] for f in flights]) ** 2, axis=0)) for n in (one, two))
        each = [np.linalg.norm(np.sqrt(np.mean(np.square(f[one]), 0))[:3]) for f in flights]
        other = [np.linalg.norm(np.sqrt(np.mean(np.square(f[two]), 0))[:3]) for f in flights]
        worst = np.max(np.array(each) / np.array(other))
        print(
            f"{one + ' / ' + two:36} mean {np.mean(a / b):.3f}, worst component {np.max(a / b):.3f}; "
            f"position of the worst flight {worst:.2f}"
        )
    for n in ("window", "batch"):
        missed, lost, good = np.sum([f[f"rays {n}"][0] for f in flights], axis=0)
        print(
            f"{n}: of points seen three times {missed} blunders used, {lost} of {good} good rays left out "
            f"({100 * lost / good:.2f} %)"
        )


if __name__ == "__main__":
    main()
