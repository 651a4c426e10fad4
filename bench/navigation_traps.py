"""Users' traps: how often each is named, by GNSS, inertial grade and motion; and how often clean data raise an alarm.

    python bench/navigation_traps.py [--seeds 3] [--cases WORD] [--duration 300]

A cell counts the seeds in which the one finding names the cause (right), something else (wrong: the finding is
printed), or nothing (missed); a right shift beside one that fits as well counts. Metre: GNSS of 2/2/4 m; good:
2/2/4 cm.
"""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from typing import Any

import frame
import numpy as np

from triline.solver.navigation.error_state import NavigationSettings
from triline.solver.navigation.inertial_checks import check
from triline.solver.navigation.inertial_data import MEMS, TACTICAL, GnssData, InertialData
from triline.solver.simulation.inertial import gnss_fixes, survey_flight, with_errors

#: How often each verdict fell, and wrong findings.
Cell = tuple[Counter[str], list[str]]
ARM = (0.5, 0.1, -1.2)
SIGMAS = {"good": (0.02, 0.02, 0.04), "metre": (2.0, 2.0, 4.0)}
GRADES = {"tactical": TACTICAL, "mems": MEMS}
FLU = np.diag([1.0, -1.0, -1.0])
SWAP = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
RFU = SWAP @ np.diag([1.0, 1.0, -1.0])
UPSET = np.diag([1.0, 1.0, -1.0])
DEG = 180.0 / np.pi


def turned(d: InertialData, gyro: np.ndarray, accel: np.ndarray) -> InertialData:
    return replace(d, dtheta=d.dtheta @ gyro.T, dv=d.dv @ accel.T)


#: name -> what is done to inertial data, whether the columns say increments, subject, words of the finding
INERTIAL: dict[str, tuple[Callable[[InertialData], InertialData], bool, str, str]] = {
    "g": (lambda d: replace(d, dv=d.dv / 9.80665), False, "imu.force", "give g, not"),
    "increments as rates": (
        lambda d: replace(d, dtheta=d.dtheta * d.dt_s[:, None], dv=d.dv * d.dt_s[:, None]),
        False, "imu.force", "hold velocity increments",
    ),
    "rates as increments": (
        lambda d: replace(d, dtheta=d.dtheta / d.dt_s[:, None], dv=d.dv / d.dt_s[:, None]),
        True, "imu.force", "hold specific force",
    ),
    "degrees": (lambda d: replace(d, dtheta=d.dtheta * DEG), False, "imu.rate", "degrees, not radians"),
    "angle increments as rates": (
        lambda d: replace(d, dtheta=d.dtheta * d.dt_s[:, None]), False, "imu.rate", "hold angle increments",
    ),
    "angular rates as increments": (
        lambda d: replace(d, dtheta=d.dtheta / d.dt_s[:, None]), True, "imu.rate", "hold angular rates",
    ),
    "forward-left-up": (lambda d: turned(d, FLU, FLU), False, "imu.axes", "forward-left-up"),
    "right-forward-up": (lambda d: turned(d, RFU, RFU), False, "imu.axes", "right-forward-up"),
    "x, y swapped": (lambda d: turned(d, SWAP, SWAP), False, "imu.axes", "right-forward-down"),
    "gyro x, y swapped": (lambda d: turned(d, SWAP, np.eye(3)), False, "imu.axes", "(wy, wx, wz)"),
    "gyro z turned round": (lambda d: turned(d, UPSET, np.eye(3)), False, "imu.axes", "(wx, wy, -wz)"),
    "accelerometers forward-left-up": (lambda d: turned(d, np.eye(3), FLU), False, "imu.axes", "do not belong"),
    "clean": (lambda d: d, False, "", ""),
}  # fmt: skip
SHIFTS = (1.0, -1.0, 2.0, -2.0, 5.0, 18.0, -18.0, 37.0, -37.0, -19.0)


def flight(kind: str, grade: str, gnss: str, seed: int, duration_s: float):
    rng = np.random.default_rng([seed, 5])
    plans: dict[str, dict[str, Any]] = {
        "survey": {}, "straight": {"line_s": 2.0 * duration_s, "turbulence": 0.3}, "after rest": {"static_s": 60.0}
    }  # fmt: skip
    motion = survey_flight(duration_s, rng, **plans[kind])
    time_s = 0.5 + np.arange(int((duration_s - 1.0) * 200.0) + 1) / 200.0
    inertial, _ = with_errors(motion.increments(time_s), GRADES[grade], rng)
    fixes = gnss_fixes(motion, np.arange(1.0, duration_s - 0.6) + 0.0037, SIGMAS[gnss], rng, ARM)
    return inertial, fixes, NavigationSettings(GRADES[grade], lever_arm_b=ARM)


def late(g: GnssData, shift: float) -> GnssData:
    return replace(g, time_s=g.time_s + shift)


def names(part: str) -> list[str]:
    return [n for n in (*INERTIAL, *(f"clock {s:+.0f} s" for s in SHIFTS)) if part in n]


def column(kind: str, sigma: str, grade: str, seeds: int, duration_s: float, part: str) -> dict[str, Cell]:
    """Every case in one column: how often it got which verdict, and what was said wrongly."""
    out: dict[str, Cell] = {}
    flights = [flight(kind, grade, sigma, 300 + i, duration_s) for i in range(seeds)]
    for name in names(part):
        count, wrong = Counter(), []
        for inertial, fixes, settings in flights:
            if name.startswith("clock"):
                shift = float(name.split()[1])
                found = check(inertial, late(fixes, shift), settings, increments=False)
                subject = "gnss.time"
                words = f"{abs(shift):.0f} s {'late' if shift > 0 else 'early'}"
            else:
                change, increments, subject, words = INERTIAL[name]
                found = check(change(inertial), fixes, settings, increments=increments)
            if not found:
                verdict = "right" if name == "clean" else "missed"
            else:
                right = found[0].subject == subject and words in found[0].text and name != "clean"
                verdict = "right" if right else "wrong"
                if not right:
                    wrong.append(f"{name}, {sigma} {grade}: {found[0].subject}: {found[0].text}")
            count[verdict] += 1
        out[name] = count, wrong
    return out


def main() -> int:
    parser = frame.parser(__doc__, seeds=3, processes=True)
    parser.add_argument("--duration", type=float, default=300.0)
    parser.add_argument("--cases", default="", help="only cases that contain this")
    parser.add_argument("--motions", nargs="*", default=["survey", "after rest"])
    args = parser.parse_args()
    seeds, motions = args.seeds, args.motions
    columns = [(sigma, grade) for sigma in SIGMAS for grade in GRADES]
    good = True
    with ProcessPoolExecutor(args.processes) as pool:
        found = {
            (kind, *key): pool.submit(column, kind, *key, seeds, args.duration, args.cases)
            for kind in motions
            for key in columns
        }
        for kind in motions:
            cells = [found[kind, *key].result() for key in columns]
            print(f"{kind}: right/wrong/missed of {seeds}")
            print(f"  {'':32s} " + "   ".join(f"{f'{s} {g}':^14s}" for s, g in columns))
            for name in names(args.cases):
                row = []
                for count, wrong in (cell[name] for cell in cells):
                    good &= count["right"] == seeds
                    row.append(f"{count['right']}/{count['wrong']}/{count['missed']}")
                    for text in wrong:
                        print(f"      {text}")
                print(f"  {name:32s} " + "   ".join(f"{c:^14s}" for c in row), flush=True)
    print("every cause named, no false alarm" if good else "not all as wanted")
    return frame.verdict(good)


if __name__ == "__main__":
    sys.exit(main())
