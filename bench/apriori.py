"""A-priori weights from the trajectory: squares of the errors of the refined orientation over what it says of itself.

    python bench/apriori.py [--seeds 16] [--cases flight outage restart]

Simulated flights with raw inertial data go through navigator and adjuster as on line, heading found in motion 18 s
before the first strip. In the middle of a strip GNSS is out for 23 s (outage), or the navigator is killed and started
again (restart). 1 is expected; the mean over seeds must lie within three standard errors
(Student's, since they come from few seeds), and 15 %, of it.
"""

from __future__ import annotations

import sys
from concurrent.futures import ProcessPoolExecutor

import frame
import numpy as np
from scipy.stats import t as student_t

from triline.nodes import convert
from triline.nodes.adjuster.adjuster import Adjuster
from triline.nodes.navigator.navigator import Navigator
from triline.nodes.node import Message
from triline.nodes.simulator.simulator import Simulator
from triline.solver.accuracy import angle_difference
from triline.solver.navigation.inertial_data import MEMS, TACTICAL, InertialGrade
from triline.solver.simulation.error_models import ErrorModel
from triline.solver.simulation.flight import FlightPlan
from triline.solver.simulation.inertial_sensors import InertialPlan
from triline.solver.simulation.scenario import Simulation, simulate

EPOCH = 1_700_000_000_000_000_000
GRADES: dict[str, InertialGrade] = {"tactical": TACTICAL, "MEMS": MEMS}
#: GNSS is out, s; at its beginning the navigator is killed.
HOLE_S = (35.0, 58.0)


def fly(grade: InertialGrade, seed: int, case: str) -> tuple[Simulation, list[Message]]:
    """What the adjuster puts out over a flight."""
    plan = FlightPlan(strip_s=25.0, lead_in_s=18.0) if case == "flight" else FlightPlan(strips=1, lead_in_s=25.0)
    simulation = simulate(plan, seed, ErrorModel(gnss_rate_hz=2.0), inertial=InertialPlan(grade, 50.0))
    navigator, adjuster = Navigator(), Adjuster(apriori="trajectory")
    out: list[Message] = []

    def adjust(messages: list[Message]) -> None:
        for message in messages:
            if message.topic in adjuster.inputs:
                out.extend(adjuster.step(message))

    project, killed = None, case != "restart"
    for message in Simulator(simulation).messages(EPOCH):
        time_s = (message.stamp_ns - EPOCH) * 1e-9
        project = message if message.topic == "configuration/project" else project
        if case == "outage" and message.topic == "sensor/gnss" and HOLE_S[0] < time_s < HOLE_S[1]:
            continue
        if not killed and project is not None and time_s > HOLE_S[0]:
            navigator, killed = Navigator(), True
            adjust(list(navigator.step(project)))
        adjust([message, *(navigator.step(message) if message.topic in navigator.inputs else ())])
    adjust(list(navigator.finish()))
    return simulation, [*out, *adjuster.finish()]


def normalised_squares(out: list[Message], simulation: Simulation, topic: str, every: int = 4) -> np.ndarray:
    """(n, 7): e^T C^-1 e / 6, and the squares of errors over sigma of X, Y, Z, omega, phi, kappa."""
    bodies = [o.body for o in out if o.topic == topic][::every]
    t = np.array([(convert.time_ns(b.timestamp) - EPOCH) * 1e-9 for b in bodies])
    truth = simulation.flight.truth.at(t)
    samples = [convert.pose_sample(b) for b in bodies]
    position = np.array([s.position_l for s in samples])
    angles = np.array([list(b.angles) for b in bodies])
    e = np.hstack([position - truth.position_l, angle_difference(angles, truth.angles)])
    C = np.array([s.covariance for s in samples])
    whole = np.einsum("ni,ni->n", e, np.linalg.solve(C, e[:, :, None])[:, :, 0]) / 6.0
    return np.column_stack([whole, e**2 / np.einsum("nii->ni", C)])


def of_seed(grade: str, seed: int, case: str) -> dict[str, np.ndarray]:
    """Mean (7,) of the normalised squares over one flight, live and final."""
    simulation, out = fly(GRADES[grade], seed, case)
    return {t: normalised_squares(out, simulation, f"orientation/{t}").mean(axis=0) for t in ("live", "final")}


def main() -> int:
    parser = frame.parser(__doc__, seeds=16, processes=True)
    parser.add_argument("--cases", nargs="+", default=["flight", "outage", "restart"])
    parser.add_argument("--grades", nargs="+", default=list(GRADES))
    args = parser.parse_args()
    seeds, good = args.seeds, True
    with ProcessPoolExecutor(args.processes) as pool:
        done = {
            (case, name): [pool.submit(of_seed, name, seed, case) for seed in range(10, 10 + seeds)]
            for case in args.cases
            for name in args.grades
        }
        for (case, name), flights in done.items():
            for topic in ("live", "final"):
                rows = [f.result()[topic] for f in flights]
                mean = np.mean(rows, axis=0)
                error = float(np.std([r[0] for r in rows], ddof=1)) / np.sqrt(seeds)
                held = abs(mean[0] - 1.0) < student_t.ppf(0.99865, seeds - 1) * error + 0.15
                good &= bool(held)
                each = " ".join(f"{x:.2f}" for x in np.sqrt(mean[1:]))
                print(
                    f"{case:8s} {name:8s} {topic:5s} {seeds} seeds: {mean[0]:.2f} +- {error:.2f} "
                    f"{'in' if held else 'OUT OF'} its band; X Y Z omega phi kappa over sigma {each}",
                    flush=True,
                )
    print("all as wanted" if good else "not all as wanted")
    return frame.verdict(good)


if __name__ == "__main__":
    sys.exit(main())
