"""Block folders of an independent program whose trajectory was disturbed by hand, on line beside the batch.

    python bench/disturbed_folders.py [--seeds 4] [--pace throughput]

The folder is ../shared/data/blocks/dgr: three strips, 4 rays a second, nothing stated of a wander. On line:
`triline import` and `triline process`; batch: `triline adjust` with a wander and variance components. RMSE of all
points but control against truth, 3D, and the mean of their normalised errors squared (1 expected), over seeds, which
choose strip, time and sign of the step and the phases of the sines; worst: the largest RMSE on line.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import frame
import numpy as np

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "tests" / "support"))

from disturbed_folder import DISTURBANCES, disturbed, errors_of  # noqa: E402

#: Those that a seed makes no other.
CONSTANT = ("nothing", "clock 5 ms", "lever arm 0.2 m", "boresight 0.05 deg", "GNSS datum + 0.5 m")


def one(name: str, seed: int, work: Path, pace: str) -> tuple[tuple[float, float], tuple[float, float]]:
    """RMSE and NEES on line, and of the batch."""
    folder = disturbed(name, seed, work / "block")
    flight, done, points, batch = work / "flight.mcap", work / "done.mcap", work / "points.csv", work / "batch"
    frame.triline("import", str(folder), "-o", str(flight), "-q")
    frame.triline("process", str(flight), "-o", str(done), "-q", "--pace", pace)
    frame.triline("export", str(done), "--points", str(points), "-q")
    frame.triline("adjust", str(folder), "--model", "wander", "--variance-components", "-o", str(batch), "-q")
    return errors_of(points, folder), errors_of(batch / "points.csv", folder)


def row(name: str, seeds: int, pace: str) -> str:
    found = []
    for seed in range(1, 2 if name in CONSTANT else seeds + 1):
        with tempfile.TemporaryDirectory() as work:
            found.append(one(name, seed, Path(work), pace))
    figures = np.array(found)
    rmse = np.sqrt(np.mean(figures[:, :, 0] ** 2, axis=0))
    nees = np.mean(figures[:, :, 1], axis=0)
    worst = figures[:, 0, 0].max()
    return f"{name:<28}{len(found):5d}{rmse[0]:10.3f}{worst:8.3f}{nees[0]:7.2f}{rmse[1]:10.3f}{nees[1]:7.2f}"


def main() -> None:
    parser = frame.parser(__doc__, seeds=4)
    parser.add_argument("--pace", choices=("throughput", "load"), default="throughput", help="of `process`")
    args = parser.parse_args()
    print(f"{'disturbed by':<28}{'seeds':>5}{'on line':>10}{'worst':>8}{'NEES':>7}{'batch':>10}{'NEES':>7}")
    for name in DISTURBANCES:
        print(row(name, args.seeds, args.pace), flush=True)


if __name__ == "__main__":
    main()
