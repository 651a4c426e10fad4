"""How fast the errors of smoothed poses change, and how fast the slow errors that the adjuster takes for them do.

    python bench/pose_changes.py [--seeds 6] [--grades tactical MEMS] [--strip-s 60] [--strips 2]

Simulated flights with raw inertial data go through the navigator alone. For lags from a tenth of a second on: the root
mean square of what the error of a smoothed pose changes by, and its ratio to what `SlowErrors` states at the begin of
the strip. On the first strip the heading is still being learnt. 1 is as stated, less is cautious.
"""

from __future__ import annotations

from concurrent.futures import ProcessPoolExecutor

import frame
import numpy as np

from triline.nodes import convert
from triline.nodes.adjuster.poses import PoseBuffer
from triline.nodes.adjuster.strips import NEAR_START_S
from triline.nodes.navigator.navigator import Navigator
from triline.nodes.node import Message
from triline.nodes.simulator.simulator import Simulator
from triline.solver.accuracy import angle_difference
from triline.solver.models.gauss_markov import autocorrelation
from triline.solver.models.slow_errors import SlowErrors
from triline.solver.navigation.inertial_data import MEMS, TACTICAL
from triline.solver.simulation.error_models import ErrorModel
from triline.solver.simulation.flight import FlightPlan
from triline.solver.simulation.inertial_sensors import InertialPlan
from triline.solver.simulation.scenario import simulate

EPOCH = 1_700_000_000_000_000_000
GRADES = {"tactical": TACTICAL, "MEMS": MEMS}
STEP_S = 0.1
LAGS_S = (0.1, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0, 128.0)
#: cm and microradians
SHOWN = np.repeat([100.0, 1e6], 3)


def of_seed(grade: str, seed: int, strip_s: float, strips: int) -> list[tuple[SlowErrors, np.ndarray]]:
    """For each strip what is stated, and the mean squares (lags, 6) of changes; NaN for lags that are too long."""
    plan = FlightPlan(strips=strips, strip_s=strip_s, lead_in_s=18.0)
    simulation = simulate(plan, seed, ErrorModel(), inertial=InertialPlan(GRADES[grade], 100.0))
    navigator, poses, smoothed = Navigator(), PoseBuffer(known_only=True), []
    first_s = [strip.first_line_time_s for strip in simulation.flight.strips]
    slow, stated = SlowErrors(), []

    def take(made: list[Message]) -> None:
        for m in (m for m in made if m.topic.startswith("trajectory/")):
            sample, is_smoothed = convert.plain_pose(m.body), m.topic.endswith("smoothed")
            time_s = (sample.time_ns - EPOCH) * 1e-9
            poses.add(time_s, sample, is_smoothed, "")
            if is_smoothed:
                smoothed.append((time_s, sample.position_l, list(m.body.angles)))
            next_s = first_s[len(stated)] if len(stated) < strips else np.inf
            covariance = poses.covariance_after(next_s - NEAR_START_S)
            if (m.stamp_ns - EPOCH) * 1e-9 >= next_s and covariance is not None:
                stated.append(slow.widened(covariance, poses.learnt))

    for message in Simulator(simulation).messages(EPOCH):
        if message.topic == "configuration/project":
            slow = convert.slow_errors_of(message.body)
        if message.topic in navigator.inputs:
            take(list(navigator.step(message)))
    take(list(navigator.finish()))
    t = np.array([time_s for time_s, _, _ in smoothed])
    truth = simulation.flight.truth.at(t)
    e = np.hstack([
        np.array([position for _, position, _ in smoothed]) - truth.position_l,
        angle_difference(np.array([angles for _, _, angles in smoothed]), truth.angles),
    ])  # fmt: skip
    found = []
    for begin_s, slow_of_strip in zip(first_s, stated, strict=True):
        grid = np.arange(max(begin_s, t[0]), begin_s + strip_s, STEP_S)
        at = np.column_stack([np.interp(grid, t, component) for component in e.T])
        steps = [round(lag_s / STEP_S) for lag_s in LAGS_S]
        change = [
            np.mean((at[n:] - at[:-n]) ** 2, axis=0) if n < 0.8 * len(grid) else np.full(6, np.nan) for n in steps
        ]
        found.append((slow_of_strip, np.array(change)))
    return found


def stated_changes(slow: SlowErrors, strip_s: float) -> np.ndarray:
    """Mean squares (lags, 6) of what drift and wander change by."""
    lag_s = np.array(LAGS_S)[:, None]
    sigma, drift = np.array([*slow.wander_m, *slow.wander]), np.array([0.0, 0.0, 0.0, *slow.drift])
    correlation = np.column_stack([autocorrelation(time_s, LAGS_S) for time_s in slow.wander_times_s.tolist()])
    return (drift * lag_s / strip_s) ** 2 + 2.0 * sigma**2 * (1.0 - correlation)


def main() -> None:
    parser = frame.parser(__doc__, seeds=6, processes=True)
    parser.add_argument("--grades", nargs="+", choices=list(GRADES), default=list(GRADES))
    parser.add_argument("--strip-s", type=float, default=60.0)
    parser.add_argument("--strips", type=int, default=2)
    args = parser.parse_args()
    with ProcessPoolExecutor(args.processes) as pool:
        flights = {
            grade: [pool.submit(of_seed, grade, 10 + k, args.strip_s, args.strips) for k in range(args.seeds)]
            for grade in args.grades
        }
        for grade, submitted in flights.items():
            done = [flight.result() for flight in submitted]
            for k in range(args.strips):
                found = np.sqrt(np.mean([flight[k][1] for flight in done], axis=0))
                stated = np.sqrt(np.mean([stated_changes(flight[k][0], args.strip_s) for flight in done], axis=0))
                print(
                    f"{grade}, strip {k + 1}, {args.seeds} seeds: X Y Z cm, omega phi kappa urad; over what is stated"
                )
                for lag_s, changes, ratio in zip(LAGS_S, found * SHOWN, found / stated, strict=True):
                    if np.isfinite(ratio).all():
                        each = "  ".join(f"{c:7.1f}" for c in changes)
                        print(f"  {lag_s:5.1f} s {each}   " + " ".join(f"{r:5.2f}" for r in ratio), flush=True)


if __name__ == "__main__":
    main()
