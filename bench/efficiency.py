"""Is the on-line answer as good as a batch adjustment? RMSE of orientation and object points against two yardsticks.

    python bench/efficiency.py table [--seeds 20] [--models dgr ppm lim wander]     one strip: models, mounts, with and
                                                           without self-calibration
    python bench/efficiency.py blocks [--seeds 20] [--models dgr ppm lim wander]    the same for six strips and two
                                                           cross strips
    python bench/efficiency.py block [--seeds 20] [--model wander] [--rough] [--selfcal tls12]     one row of it
    python bench/efficiency.py adjust [--seeds 20]         whole strips and a block against `triline adjust`'s estimator

*final / causal*: what became final against a batch adjustment, from scratch, of just the data that had arrived then, at
some times of each strip. *whole / batch*: after the backward pass, against the batch adjustment of all data. *final /
batch*: what being on line costs. Each figure is the quotient of two RMSE over all seeds, of the same times and points;
of X, Y, Z, omega, phi, kappa (points: X, Y, Z) the mean and the worst. Rows with TLS-12 fly a camera whose parameters
are drawn from their a-priori sigmas; rows of DGR fly without wander, which DGR has no place for.

These batches are the window with all data in one update. ``adjust`` compares with the other estimator instead, that of
``triline adjust``: another network, other normal equations, another covariance; the same models and a-priori sigmas.
Beside the quotients of RMSE: the largest difference of two results in units of the sigma, and the quotient of sigmas.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import frame
import numpy as np

from triline.solver.adjustment.job import Job
from triline.solver.adjustment.job import run as run_batch
from triline.solver.camera.self_calibration import SELF_CALIBRATIONS, SelfCalibration
from triline.solver.camera.sensors import preset
from triline.solver.models.lim import LimOptions
from triline.solver.models.ppm import PpmOptions
from triline.solver.simulation.camera_errors import simulate_with_camera_errors
from triline.solver.simulation.error_models import ErrorModel
from triline.solver.simulation.flight import FlightPlan
from triline.solver.simulation.flight_network import batch_errors, network_of
from triline.solver.simulation.scenario import ObservationPlan, Simulation, simulate
from triline.solver.simulation.window_study import (
    OnlineResult,
    TimedPose,
    adjust_at_once,
    adjust_online,
    navigate,
    orientation_errors,
    point_errors,
    slow_errors_of,
)
from triline.solver.window.results import AdjustedPoint, WindowOptions
from triline.solver.window.state.strip import model_options

#: Attitude at 100 Hz: half the work, and the window interpolates either.
ERRORS = ErrorModel(attitude_rate_hz=100.0)
CAMERA = preset("ads40")
#: Of the a-priori sigmas of additional parameters, about half a pixel at the edge: what a calibration leaves.
CAMERA_SHARE = 0.03
#: Errors that shifts and drifts describe; what wanders is no case for DGR.
CONSTANT = replace(ERRORS, wander_sigma_m=(0.0, 0.0, 0.0), wander_sigma_deg=(0.0, 0.0, 0.0))
MODELS = ("dgr", "ppm", "lim", "wander")


@dataclass(frozen=True)
class Case:
    """One row of the table."""

    model: str
    rough: bool = False
    selfcal: str = "none"
    strips: int = 1
    cross_strips: int = 0
    strip_s: float = 40.0
    samples: int = 2
    height_m: float = 1500.0

    @property
    def title(self) -> str:
        mount = "rough" if self.rough else "stabilised"
        return ", ".join([self.model, mount] + ([self.selfcal] if self.selfcal != "none" else []))

    @property
    def parameters(self) -> SelfCalibration | None:
        return None if self.selfcal == "none" else SELF_CALIBRATIONS[self.selfcal](CAMERA).scaled(CAMERA_SHARE)

    def simulate(self, seed: int) -> Simulation:
        plan = FlightPlan(
            height_m=self.height_m,
            strips=self.strips,
            cross_strips=self.cross_strips,
            strip_s=self.strip_s,
            stabilised=not self.rough,
            turbulence=2.0 if self.rough else 1.0,
            turns=False,
            gap_s=8.0,
            lead_in_s=3.0,
            lead_out_s=2.0,
        )
        ties = ObservationPlan(tie_points_per_s=5.0, control=6 * max(1, self.strips // 3), check=20)
        errors = CONSTANT if self.model == "dgr" else ERRORS
        if self.parameters is not None:
            return simulate_with_camera_errors(plan, seed, self.parameters, errors, ties)
        return simulate(plan, seed, errors, ties)


def one_flight(seed: int, case: Case) -> dict[str, np.ndarray]:
    """Sums of squares and counts of a flight, by what is compared."""
    simulation = case.simulate(seed)
    poses = navigate(simulation)
    parameters = case.parameters
    options = WindowOptions(model=case.model, snoop=False, grid_hz=5.0)
    online = adjust_online(simulation, poses, options, parameters, live=False, update_s=0.5)
    batch = adjust_at_once(simulation, poses, options, parameters)
    both = {name for name, p in batch.final_points.items() if name in online.whole_points and p.rays >= 3}

    def points(found: dict[str, AdjustedPoint], names=both) -> np.ndarray:
        return point_errors(simulation, {n: found[n] for n in names if n in found}).error

    errors = [
        orientation_errors(simulation, online.final), point_errors(simulation, online.final_points),
        orientation_errors(simulation, online.whole), point_errors(simulation, online.whole_points),
    ]  # fmt: skip
    result = {
        "final": orientation_errors(simulation, online.final).error,
        "whole": orientation_errors(simulation, online.whole).error,
        "batch": orientation_errors(simulation, batch.final).error,
        "points final": points(online.final_points),
        "points whole": points(online.whole_points),
        "points batch": points(batch.final_points),
        "nees": np.array([[e.nees.mean() for e in errors]]),
    }
    result |= _causal(simulation, poses, online, case, partial(adjust_at_once, simulation, poses, options, parameters))
    return result


def _causal(
    simulation: Simulation,
    poses: list[TimedPose],
    online: OnlineResult,
    case: Case,
    adjust: Callable[..., OnlineResult],
) -> dict[str, np.ndarray]:
    """Errors of what became final at some times of each strip, and of batch adjustments of what was known then."""
    rows: dict[str, list[np.ndarray]] = {"same": [], "causal": [], "points same": [], "points causal": []}
    for strip in simulation.flight.strips:
        mine = [i for i, o in enumerate(online.final) if o.strip == strip.id]
        # not those of the very end: they become final together with all that is known of the strip
        known = sorted({online.final_known_s[i] for i in mine})
        for known_s in {known[k] for k in np.linspace(0.2 * len(known), len(known) - 1, case.samples).astype(int)}:
            batch = adjust(until_s=known_s)
            assert batch.window is not None
            for i in (i for i in mine if online.final_known_s[i] == known_s):
                final = online.final[i]
                at = batch.window.orientation_at(strip.id, final.time_s)
                rows["same"].append(orientation_errors(simulation, [final]).error)
                rows["causal"].append(orientation_errors(simulation, [at]).error)
            names = [n for n, t in online.points_known_s.items() if t == known_s and n in batch.live_points]
            for key, found in (("points same", online.final_points), ("points causal", batch.live_points)):
                rows[key].append(point_errors(simulation, {n: found[n] for n in names}, rays=1).error)
    return {key: np.concatenate(parts) for key, parts in rows.items()}


def one_adjustment(seed: int, case: Case) -> dict[str, np.ndarray]:
    """Errors of a flight from the window, after the backward pass, and from the batch adjustment of its network."""
    simulation = case.simulate(seed)
    poses = navigate(simulation)
    parameters, options = case.parameters, WindowOptions(model=case.model, snoop=False, grid_hz=5.0)
    online = adjust_online(simulation, poses, options, parameters, live=False, update_s=0.5)
    model = model_options(slow_errors_of(simulation.errors), options, case.strip_s)
    if isinstance(model, PpmOptions):
        model = replace(model, segments=0)  # of each strip as many as its length asks for
    elif isinstance(model, LimOptions):
        model = replace(model, fixes=0)
    found = run_batch(network_of(simulation, poses), Job(model, self_calibration=parameters, eliminate=False))
    names = list(found.network.point_ids)
    place = {name: i for i, name in enumerate(names)}
    seen = {n: p for n, p in online.whole_points.items() if p.rays >= 3 and n in place}
    truth = dict(zip(map(str, simulation.points.id), simulation.points.xyz_l, strict=True))
    whole, batch, sigma = [], [], []
    for strip in simulation.flight.strips:
        parts = [o for o in online.whole if o.strip == strip.id]
        time_s = np.concatenate([o.time_s for o in parts])
        # the ends are extrapolated by either
        inside = (time_s > strip.first_line_time_s + 1.0) & (time_s < strip.time_of(strip.lines - 1) - 1.0)
        whole.append(orientation_errors(simulation, parts).error[inside])
        batch.append(batch_errors(simulation, found, strip.id, time_s[inside]))
        sigma.append(np.concatenate([np.sqrt(np.einsum("nii->ni", o.covariance)) for o in parts])[inside])
    return {
        "whole": np.concatenate(whole),
        "adjusted": np.concatenate(batch),
        "sigma": np.concatenate(sigma),
        "points whole": np.array([p.xyz_l - truth[n] for n, p in seen.items()]),
        "points adjusted": np.array([found.solution.state.points_l[place[n]] - truth[n] for n in seen]),
        "points sigma": np.array([np.sqrt(np.diag(p.covariance)) for p in seen.values()]),
        "points adjusted sigma": np.sqrt([np.diag(found.cofactors.points[place[n]]) for n in seen]),
    }


def run(case: Case, seeds: int, one_by_one: bool = False) -> dict[str, Any]:
    """A row of the table; on the way, where asked for, what it is after each flight."""
    flights = []
    for flight in frame.over_seeds(partial(one_flight, case=case), seeds):
        flights.append(flight)
        if one_by_one:
            show(f"  {len(flights)} flights", _row(flights))
    return _row(flights)


def _row(flights: list[dict[str, np.ndarray]]) -> dict[str, object]:
    rmse = {key: np.sqrt(np.mean(np.concatenate([f[key] for f in flights]) ** 2, axis=0)) for key in flights[0]}
    row: dict[str, object] = {"nees": np.mean(np.concatenate([f["nees"] for f in flights]), axis=0)}
    for name, one, two in (
        ("final / causal", "same", "causal"),
        ("whole / batch", "whole", "batch"),
        ("final / batch", "final", "batch"),
    ):
        row[name] = rmse[one] / rmse[two]
        row["points " + name] = rmse["points " + one] / rmse["points " + two]
    row["batch"] = rmse["batch"], rmse["points batch"]
    return row


COLUMNS = tuple(
    part + name for name in ("final / causal", "whole / batch", "final / batch") for part in ("", "points ")
)


def show(title: str, row: dict) -> None:
    cells = [f"{np.mean(row[c]):6.3f} {np.max(row[c]):6.3f}" for c in COLUMNS]
    print(f"{title:38}" + " | ".join(cells) + " | " + " ".join(f"{v:.2f}" for v in row["nees"]), flush=True)


def header() -> None:
    pairs = " | ".join(f"{name:^29}" for name in ("final / causal", "whole / batch", "final / batch"))
    cells = " | ".join(f"{what:>13}" for what in ("orientation", "points") * 3)
    print(f"{'':38}{pairs} | NEES")
    print(f"{'RMSE over RMSE: mean, worst':38}{cells} | final, points, whole, points", flush=True)


def every_case(models: Sequence[str]) -> Iterator[Case]:
    for model in models:
        for rough in (False, True):
            for selfcal in ("none", "tls12"):
                yield Case(model, rough, selfcal)


def as_block(case: Case, args: argparse.Namespace) -> Case:
    return replace(
        case,
        strips=args.strips,
        cross_strips=args.cross,
        strip_s=args.strip_s,
        samples=args.samples,
        height_m=1000.0,
    )


def table(args: argparse.Namespace) -> None:
    header()
    for case in every_case(args.models):
        show(case.title, run(case, args.seeds))


def blocks(args: argparse.Namespace) -> None:
    print(f"{args.strips} strips, {args.cross} cross strips")
    header()
    for case in every_case(args.models):
        show(case.title, run(as_block(case, args), args.seeds))


def block(args: argparse.Namespace) -> None:
    header()
    case = as_block(Case(args.model, args.rough, args.selfcal), args)
    row = run(case, args.seeds, one_by_one=True)
    show(f"{case.title}, {args.strips} + {args.cross} strips", row)
    print(json.dumps({k: np.round(v, 3).tolist() for k, v in row.items() if k != "batch"}, indent=1))


def adjust(args: argparse.Namespace) -> None:
    print(f"{'':38}{'RMSE over RMSE: mean, worst':^29} | {'largest, sigmas':>15} | sigma over sigma")
    print(f"{'window / triline adjust':38}{'orientation':>13} | {'points':>13} | {'orient., points':>15} | of points")
    for model in MODELS:
        for selfcal in ("none", "tls12"):
            name = f"{model}{', ' + selfcal if selfcal != 'none' else ''}"
            cases = {f"{name}, one strip": Case(model, True, selfcal)}
            cases[f"{name}, 6 strips, 2 cross strips"] = Case(
                model, False, selfcal, 6, 2, args.strip_s, height_m=1000.0
            )
            for title, case in cases.items():
                flights = list(frame.over_seeds(partial(one_adjustment, case=case), args.seeds))
                f = {key: np.concatenate([flight[key] for flight in flights]) for key in flights[0]}
                cells, off = [], []
                for part in ("", "points "):
                    one, two, sigma = (f[part + key] for key in ("whole", "adjusted", "sigma"))
                    ratio = np.sqrt(np.mean(one**2, axis=0) / np.mean(two**2, axis=0))
                    cells.append(f"{ratio.mean():6.3f} {ratio.max():6.3f}")
                    off.append(f"{np.abs((one - two) / sigma).max():6.2f}")
                sigmas = (f["points sigma"] / f["points adjusted sigma"]).mean(axis=0).mean()
                print(f"{title:38}{' | '.join(cells)} | {'  '.join(off):>15} | {sigmas:6.3f}", flush=True)


def main() -> None:
    parser = frame.parser(__doc__, seeds=20)
    parser.add_argument("what", choices=("table", "blocks", "block", "adjust"))
    parser.add_argument("--models", nargs="+", choices=MODELS, default=MODELS, help="of table and blocks")
    parser.add_argument("--model", choices=MODELS, default="wander", help="of block")
    parser.add_argument("--rough", action="store_true")
    parser.add_argument("--selfcal", default="none")
    parser.add_argument("--strips", type=int, default=6)
    parser.add_argument("--cross", type=int, default=2)
    parser.add_argument("--strip-s", type=float, default=30.0)
    parser.add_argument("--samples", type=int, default=2, help="causal batches for each strip of a block")
    args = parser.parse_args()
    {"table": table, "blocks": blocks, "block": block, "adjust": adjust}[args.what](args)


if __name__ == "__main__":
    main()
