"""Is self-calibration honest where rays are dense? Batch adjustment and window of the same flights, errors over sigmas.

    python bench/self_calibration.py [--seeds 12] [--ties 8] [--parameters 18] [--share 0.1] [--control 6] [--no-window]
                                       [--px 0.3] [--seconds 40] [--exact]

One strip a seed, by a camera whose TLS parameters are drawn from a share of their usual a-priori sigmas; with *exact*
it is as calibrated, and the sigmas say nothing of that.
*batch* is what `triline adjust` runs, *final* and *whole* are the window's. NEES: mean normalised error squared of
orientation on a grid of 5 Hz, object points and additional parameters (1 expected), with the 95 % band from the
scatter of the flights. *Z*: mean error of Z over the strip in units of its mean sigma, root of the mean square over the
flights. *batch / whole*: RMSE over RMSE, and sigma over sigma, of the same points.
"""

from __future__ import annotations

import argparse
from functools import partial

import frame
import numpy as np

from triline.solver.adjustment.job import BatchResult, Job, run
from triline.solver.adjustment.refined_orientation import correction_cofactors
from triline.solver.camera.self_calibration import SelfCalibration, tls
from triline.solver.geometry.trajectory import noise_between
from triline.solver.models.wander import WanderOptions
from triline.solver.simulation.camera_errors import drawn_parameters, simulate_with_camera_errors
from triline.solver.simulation.error_models import ErrorModel
from triline.solver.simulation.flight import FlightPlan
from triline.solver.simulation.flight_network import batch_errors, network_of
from triline.solver.simulation.scenario import ObservationPlan, Simulation, simulate
from triline.solver.simulation.window_study import (
    Errors,
    OnlineResult,
    TimedPose,
    adjust_online,
    navigate,
    orientation_errors,
    point_errors,
    slow_errors_of,
)
from triline.solver.window.results import WindowOptions

#: Attitude at 100 Hz: half the work, and the trajectory interpolates either.
ERRORS = ErrorModel(attitude_rate_hz=100.0)
Figures = dict[str, float]


def adjust_batch(simulation: Simulation, poses: list[TimedPose], stated: SelfCalibration) -> BatchResult:
    """The batch adjustment with the window's default model and segments, all parameters kept."""
    model = WanderOptions(slow_errors_of(simulation.errors))
    return run(network_of(simulation, poses), Job(model, self_calibration=stated, eliminate=False))


def of_batch(simulation: Simulation, found: BatchResult, times: np.ndarray) -> tuple[Errors, Errors, list[str]]:
    """Errors of orientation at times, of tie points, and the names of these."""
    solution, strip = found.solution, found.network.strips[0]
    assert strip.noise is not None
    off = batch_errors(simulation, found, strip.id, times)
    noise = noise_between(strip.trajectory.time_s, strip.noise, times)
    left_out = solution.layout.sets[0].model.left_out_variance(times)
    covariance = correction_cofactors(solution, 0, times) + noise + left_out[:, :, None] * np.eye(6)
    place = {str(id): i for i, id in enumerate(simulation.points.id)}
    rays = np.bincount(found.network.rays.point, minlength=found.network.n_points)
    chosen = [
        i for i, name in enumerate(found.network.point_ids)
        if simulation.points.role[place[name]] != "control" and rays[i] >= 2
    ]  # fmt: skip
    names = [found.network.point_ids[i] for i in chosen]
    error = solution.state.points_l[chosen] - simulation.points.xyz_l[[place[n] for n in names]]
    return Errors(off, covariance, times), Errors(error, found.cofactors.points[chosen], np.zeros(len(names))), names


def normalised(error: np.ndarray, covariance: np.ndarray) -> float:
    """``e^T C^-1 e / k``."""
    s = np.sqrt(np.diag(covariance))
    z = error / s
    return float(z @ np.linalg.solve(covariance / np.outer(s, s), z)) / len(z)


def off_in_z(errors: Errors) -> float:
    """Mean error of Z over the mean of its sigma."""
    return float(errors.error[:, 2].mean() / np.sqrt(errors.covariance[:, 2, 2]).mean())


def one_flight(seed: int, args: argparse.Namespace) -> Figures:
    plan = FlightPlan(strip_s=args.seconds, lead_in_s=3.0, lead_out_s=2.0)
    stated = tls(plan.camera, args.parameters).scaled(args.share)
    observed = ObservationPlan(tie_points_per_s=args.ties, control=args.control, image_sigma_px=args.px)
    true = drawn_parameters(seed, stated)
    if args.exact:
        true = np.zeros(stated.n_unknowns)
        simulation = simulate(plan, seed, ERRORS, observed)
    else:
        simulation = simulate_with_camera_errors(plan, seed, stated, ERRORS, observed)
    poses = navigate(simulation)
    strip = simulation.flight.strips[0]
    times = np.arange(strip.first_line_time_s + 0.2, float(strip.time_of(strip.lines - 1)) - 0.2, 0.2)
    found = adjust_batch(simulation, poses, stated)
    orientation, points, names = of_batch(simulation, found, times)
    columns = np.arange(found.solution.layout.n_model, found.solution.layout.n_unknowns)
    off = found.solution.camera_parameters - true
    result = {
        "batch orientation": orientation.nees.mean(), "batch points": points.nees.mean(),
        "batch parameters": normalised(off, found.solution.factor.cofactors(columns)),
        "batch Z": off_in_z(orientation),
    }  # fmt: skip
    if args.window:
        online = adjust_online(simulation, poses, WindowOptions(grid_hz=5.0), stated, live=False, update_s=0.5)
        result |= of_window(simulation, online)
        both = [i for i, n in enumerate(names) if n in online.whole_points and online.whole_points[n].rays >= 2]
        whole = point_errors(simulation, {names[i]: online.whole_points[names[i]] for i in both})
        for i, c in enumerate("XYZ"):
            result[f"squares {c}"] = float(np.sum(points.error[both, i] ** 2))
            result[f"squares {c} whole"] = float(np.sum(whole.error[:, i] ** 2))
            ratio = np.sqrt(points.covariance[both, i, i] / whole.covariance[:, i, i])
            result[f"sigma {c}"] = float(ratio.mean())
    return {k: float(v) for k, v in result.items()}


def of_window(simulation: Simulation, online: OnlineResult) -> Figures:
    result: Figures = {}
    for name, run_, found in (
        ("final", online.final, online.final_points), ("whole", online.whole, online.whole_points),
    ):  # fmt: skip
        orientation = orientation_errors(simulation, run_)
        result[f"{name} orientation"] = orientation.nees.mean()
        result[f"{name} points"] = point_errors(simulation, found).nees.mean()
        result[f"{name} Z"] = off_in_z(orientation)
    return result


def main() -> None:
    parser = frame.parser(__doc__, seeds=12)
    parser.add_argument("--ties", type=float, default=8.0, help="tie points a second")
    parser.add_argument("--parameters", type=int, default=18, choices=(12, 16, 18), help="TLS set")
    parser.add_argument("--share", type=float, default=0.1, help="of the usual a-priori sigmas")
    parser.add_argument("--control", type=int, default=6)
    parser.add_argument("--px", type=float, default=0.3, help="noise of lines and samples")
    parser.add_argument("--seconds", type=float, default=40.0, help="length of the strip")
    parser.add_argument("--exact", action="store_true", help="the camera is as calibrated")
    parser.add_argument("--no-window", dest="window", action="store_false", help="the batch adjustment alone")
    args = parser.parse_args()
    flights = list(frame.over_seeds(partial(one_flight, args=args), args.seeds))
    for key in flights[0]:
        values = np.array([f[key] for f in flights])
        if key.endswith(" Z") and key.split()[0] in ("batch", "final", "whole"):
            print(f"{key:20} {np.sqrt(np.mean(values**2)):.2f} sigma, mean {values.mean():+.2f}")
        elif not key.startswith(("squares", "sigma")):
            print(f"{key:20} {frame.banded(*frame.mean_and_band(values))}, largest {values.max():.2f}")
    if args.window:
        sums = {k: sum(f[k] for f in flights) for k in flights[0] if k.startswith(("squares", "sigma"))}
        rmse = [np.sqrt(sums[f"squares {c}"] / sums[f"squares {c} whole"]) for c in "XYZ"]
        sigma = [sums[f"sigma {c}"] / len(flights) for c in "XYZ"]
        print(f"points, batch / whole: RMSE {np.round(rmse, 3)}, sigma {np.round(sigma, 3)} (X, Y, Z)")


if __name__ == "__main__":
    main()
