"""Are errors as large as the window says? Mean normalised error squared (1 expected), over seeds.

    python bench/consistency.py seeds [--seeds 50] [--model wander] [--rough] [--camera 0.03]
    python bench/consistency.py held [--seeds 20] [--camera 0.03]
    python bench/consistency.py control [--seeds 100]

*seeds*: one strip of 40 s a seed; the band is 95 % of the mean of so many flights, from their scatter. With *camera*,
the true camera has TLS-12 parameters drawn from that share of their usual a-priori sigmas, and they are estimated;
without wander (*--constant*) the errors are those that "dgr" describes. *held*: live orientation with such a camera,
three ways: as it is, all parameters in the state from the start; with those that are not determined by then held at
zero; and these held, but with what they leave open in the covariance ("considered", after Schmidt). *control*: one
coordinate of a control point is wrong by 2 to 12 of its sigmas; how often a component is beyond its protection level
(0.1 % allowed), and beyond 3.29 sigma.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from functools import partial

import frame
import numpy as np
from scipy.stats import norm

from triline.solver.camera.self_calibration import tls
from triline.solver.simulation.camera_errors import simulate_with_camera_errors
from triline.solver.simulation.error_models import ErrorModel
from triline.solver.simulation.flight import FlightPlan
from triline.solver.simulation.scenario import ObservationPlan, simulate
from triline.solver.simulation.window_study import adjust_online, navigate, orientation_errors, point_errors
from triline.solver.window.quality.determinability import ESTIMATED
from triline.solver.window.results import WindowOptions
from triline.solver.window.window import Window

ERRORS = ErrorModel(attitude_rate_hz=100.0)
CONSTANT = replace(ERRORS, wander_sigma_m=(0.0, 0.0, 0.0), wander_sigma_deg=(0.0, 0.0, 0.0))
WAYS = ("estimated", "held", "considered")
KINDS = ("live", "final", "whole", "live points", "final points", "whole points")


def one_flight(seed: int, model: str, rough: bool, camera: float, constant: bool) -> list[float]:
    """Ratios by KINDS."""
    plan = FlightPlan(
        strip_s=40.0, stabilised=not rough, turbulence=2.0 if rough else 1.0, lead_in_s=3.0, lead_out_s=2.0
    )
    errors, ties = CONSTANT if constant else ERRORS, ObservationPlan(tie_points_per_s=5.0)
    stated = tls(plan.camera, 12).scaled(camera) if camera else None
    if stated is not None:
        simulation = simulate_with_camera_errors(plan, seed, stated, errors, ties)
    else:
        simulation = simulate(plan, seed, errors, ties)
    options = WindowOptions(model=model, grid_hz=5.0)
    result = adjust_online(simulation, navigate(simulation), options, stated, update_s=0.5)
    ratios = [orientation_errors(simulation, o).nees.mean() for o in (result.live, result.final, result.whole)]
    points = (result.live_points, result.final_points, result.whole_points)
    return ratios + [point_errors(simulation, p).nees.mean() for p in points]


def seeds(args: argparse.Namespace) -> None:
    work = partial(one_flight, model=args.model, rough=args.rough, camera=args.camera, constant=args.constant)
    for name, mean, band in zip(KINDS, *frame.mean_and_band(list(frame.over_seeds(work, args.seeds))), strict=True):
        print(f"{name:14} {frame.banded(mean, band)}")


def one_held(seed: int, camera: float) -> dict[str, np.ndarray]:
    """Sums of squared errors (6,) and of NEES, and the number of orientations, of the three ways."""
    plan = FlightPlan(strip_s=40.0, lead_in_s=3.0, lead_out_s=2.0)
    stated = tls(plan.camera, 12).scaled(camera)
    simulation = simulate_with_camera_errors(plan, seed, stated, ERRORS, ObservationPlan(tie_points_per_s=5.0))
    sums = {way: np.zeros(8) for way in WAYS}

    def watch(now: float, window: Window) -> None:
        live, found = window.live(now), window._quality.last
        if live is None or found is None or not found.standing:
            return
        design = window.strips[live.strip].design(live.time_s)
        columns = np.unique(design.columns[design.columns >= 0]).astype(np.int64)
        held = window.network.camera_columns[[s.status != ESTIMATED for s in found.standing]]
        A = np.zeros((6, len(columns)))
        node, component = np.nonzero(design.columns[0] >= 0)
        place = np.searchsorted(columns, design.columns[0, node, component])
        np.add.at(A, (component, place), design.coefficients[0, node])
        Q = window.state.covariance(np.concatenate([columns, held]))
        u = len(columns)
        gain = A @ np.linalg.solve(Q[u:, u:], Q[u:, :u]).T
        open_ = gain * stated.apriori_sigma[np.isin(window.network.camera_columns, held)]
        error = orientation_errors(simulation, [live]).error[0]
        less = error - gain @ window.state.values(held)
        known = live.covariance[0] - gain @ Q[u:, u:] @ gain.T
        for way, e, C in zip(
            WAYS, (error, less, less), (live.covariance[0], known, known + open_ @ open_.T), strict=True
        ):
            sums[way] += [*e**2, e @ np.linalg.solve(C, e) / 6.0, 1.0]

    adjust_online(
        simulation, navigate(simulation), WindowOptions(grid_hz=1.0), stated, live=False, watch=watch, update_s=0.5
    )
    return sums


def held(args: argparse.Namespace) -> None:
    flights = list(frame.over_seeds(partial(one_held, camera=args.camera or 0.03), args.seeds))
    rmse = {}
    for way in WAYS:
        each = np.array([f[way][6] / f[way][7] for f in flights])
        rmse[way] = np.sqrt(np.sum([f[way][:6] for f in flights], axis=0) / np.sum([f[way][7] for f in flights]))
        ratio = rmse[way] / rmse[WAYS[0]]
        mean, band = frame.mean_and_band(each)
        print(
            f"{way:11} NEES {mean:6.2f} +- {band:.2f}, largest flight {each.max():6.1f}; RMSE over that of "
            f"{WAYS[0]}: mean {ratio.mean():.3f}, worst component {ratio.max():.3f}"
        )


def one_wrong_control(seed: int) -> dict[str, tuple[int, int, int]]:
    """Components of orientation: beyond the protection level, beyond 3.29 sigma, all."""
    plan = FlightPlan(strip_s=40.0, lead_in_s=3.0, lead_out_s=2.0)
    simulation = simulate(plan, seed, ERRORS, ObservationPlan(tie_points_per_s=5.0))
    rng = np.random.default_rng(seed)
    surveyed = simulation.surveyed_l.copy()
    point = rng.choice(np.flatnonzero(simulation.points.role == "control"))
    sigma = np.array(simulation.observation_plan.control_sigma_m)
    axis = rng.integers(3)
    surveyed[point, axis] += rng.choice([-1.0, 1.0]) * rng.uniform(2.0, 12.0) * sigma[axis]
    spoilt = replace(simulation, surveyed_l=surveyed)
    result = adjust_online(spoilt, navigate(simulation), WindowOptions(grid_hz=2.0), update_s=0.5)
    counts = {}
    for name, run in (("live", result.live), ("final", result.final)):
        told = [o for o in run if o.protection is not None]
        errors = orientation_errors(simulation, told)
        level = np.concatenate([o.protection for o in told if o.protection is not None])
        beyond = np.abs(errors.error) > level
        far = np.abs(errors.error) > norm.isf(0.5e-3) * np.sqrt(np.einsum("nii->ni", errors.covariance))
        counts[name] = int(beyond.sum()), int(far.sum()), beyond.size
    return counts


def control(args: argparse.Namespace) -> None:
    flights = list(frame.over_seeds(one_wrong_control, args.seeds))
    for name in ("live", "final"):
        beyond, far, n = np.sum([f[name] for f in flights], axis=0)
        of_flights = sum(f[name][0] > 0 for f in flights)
        print(
            f"{name:6} beyond the protection level {100 * beyond / n:.3f} % of {n} ({of_flights} of {len(flights)} "
            f"flights); beyond 3.29 sigma {100 * far / n:.2f} %"
        )


def main() -> None:
    parser = frame.parser(__doc__, seeds=50)
    parser.add_argument("what", choices=("seeds", "held", "control"))
    parser.add_argument("--model", default="wander")
    parser.add_argument("--rough", action="store_true", help="no stabilised mount, twice the turbulence")
    parser.add_argument("--camera", type=float, default=0.0, help="share of the a-priori sigmas of TLS-12")
    parser.add_argument("--constant", action="store_true", help="no wander")
    args = parser.parse_args()
    {"seeds": seeds, "held": held, "control": control}[args.what](args)


if __name__ == "__main__":
    main()
