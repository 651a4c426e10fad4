"""What a pose costs a node: orientation asked for after each pose, and after several as in flight.

    python bench/poses.py [--poses 4000]

Poses come one by one, 200 a second; orientation is asked for when image lines or tie points come. The matcher smooths
poses and the adjuster interpolates them; both take all that have come when they are asked. Processor time, the least of
three turns.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import frame
import numpy as np

from triline.solver.geometry.measured_trajectory import MeasuredTrajectory
from triline.solver.geometry.rotation import quaternion_from_vector
from triline.solver.matching.current_orientation import CurrentOrientation

EVERY, ROUNDS, RATE_HZ = (1, 5, 20, 100), 3, 200.0


def matcher() -> tuple[Callable[..., object], Callable[[float], object]]:
    """Taking a pose, and asking for orientation at a time."""
    orientation = CurrentOrientation()
    return orientation.add_pose, lambda _: orientation.end_s


def adjuster() -> tuple[Callable[..., object], Callable[[float], object]]:
    """The same."""
    trajectory = MeasuredTrajectory()

    def add(time_s: float, *pose: np.ndarray) -> None:
        trajectory.add([time_s], *(value[None] for value in pose), smoothed=False)

    return add, lambda time_s: trajectory.at([time_s]) if time_s > 1.0 / RATE_HZ else None


def main() -> None:
    parser = frame.parser(__doc__)
    parser.add_argument("--poses", type=int, default=4000, help="of a turn (4000)")
    args = parser.parse_args()
    n, rng = args.poses, np.random.default_rng(1)
    time_s = np.arange(n) / RATE_HZ
    position = np.column_stack([70.0 * time_s, np.sin(time_s), 1500.0 + 0.01 * rng.standard_normal(n)])
    quaternion = quaternion_from_vector(0.01 * np.sin(time_s)[:, None] + 2e-5 * rng.standard_normal((n, 3)))
    covariance = np.eye(6)
    print("us a pose, asked for after" + "".join(f"{every:>8}" for every in EVERY))
    for node in (matcher, adjuster):
        row = []
        for every in EVERY:
            turns = []
            for _ in range(ROUNDS):
                add, ask = node()
                begun = time.process_time()
                for i in range(n):
                    add(float(time_s[i]), position[i], quaternion[i], covariance)
                    if i % every == every - 1:
                        ask(float(time_s[i]))
                turns.append(time.process_time() - begun)
            row.append(min(turns) / n * 1e6)
        print(f"{node.__name__:26}" + "".join(f"{us:8.1f}" for us in row))


if __name__ == "__main__":
    main()
