"""Does a live flight keep up on two cores, and what does each of its processes take of one?

    python bench/demo_cores.py [--seconds 60] [--seed 1] [--cores 2]

`triline demo` flies in real time, where nodes that are too slow leave work out, and once more with the simulator held
back while one is behind, where nothing is left out. Printed are the tie points of both, image lines that went by
unseen, and for the flight in real time the share of a core that each process takes while the strip is flown.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import frame
import psutil

#: Of the tie points of the flight that waits, so many are to come in real time.
WANTED = 0.95
#: Shares of a core that are to be kept, by process.
MOST = {"simulator": 0.2, "viewer": 0.1}
#: Processes begin, and the platform flies in, for so long, s.
LEAD_IN_S = 16.0


def fly(folder: Path, seconds: float, seed: int, *, real_time: bool) -> tuple[dict, dict[str, float]]:
    """What a demo says as JSON, and the share of a core of each of its nodes."""
    words = ["demo", "--headless", "--seconds", str(seconds), "--seed", str(seed), "-o", str(folder), "--json", "-q"]
    with subprocess.Popen(
        [*frame.TRILINE, *words, *(["--real-time"] if real_time else [])], stdout=subprocess.PIPE, text=True
    ) as demo:
        samples = _watch(demo.pid, LEAD_IN_S, seconds)
        said = demo.communicate()[0]
    if demo.returncode:
        sys.exit(f"triline demo ended with {demo.returncode}")
    shares = {name: (last[1] - first[1]) / (last[0] - first[0]) for name, (first, last) in samples.items()}
    return json.loads(said), shares


def _watch(pid: int, from_s: float, seconds: float) -> dict[str, tuple[tuple[float, float], tuple[float, float]]]:
    """Time and core time of the nodes, at the begin and at the end of the strip."""
    time.sleep(from_s)
    first = _core_times(pid)
    time.sleep(0.8 * (seconds - 6.0))
    last = _core_times(pid)
    return {name: (first[name], last[name]) for name in first if name in last}


def _core_times(pid: int) -> dict[str, tuple[float, float]]:
    found: dict[str, tuple[float, float]] = {}
    for child in psutil.Process(pid).children(recursive=True):
        try:
            words, used = child.cmdline(), child.cpu_times()
        except psutil.Error:
            continue
        if "node" in words[:-1]:
            found[words[words.index("node") + 1]] = time.monotonic(), used.user + used.system
    own = psutil.Process(pid).cpu_times()
    found["demo"] = time.monotonic(), own.user + own.system
    return found


def main() -> int:
    parser = frame.parser(__doc__, as_json=True)
    parser.add_argument("--seconds", type=float, default=60.0, help="length of the strip (60)")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--cores", type=int, default=2, help="for all processes together (2)")
    args = parser.parse_args()
    available = sorted(os.sched_getaffinity(0))
    os.sched_setaffinity(0, available[-args.cores :])  # children inherit it
    with tempfile.TemporaryDirectory() as name:
        live, shares = fly(Path(name) / "live", args.seconds, args.seed, real_time=True)
        held, _ = fly(Path(name) / "held", args.seconds, args.seed, real_time=False)
    ties = live["recording"]["tie_points"], held["recording"]["tie_points"]
    unseen = live["nodes"]["matcher"]["counters"].get("lines gone by", 0)
    figures = {
        "tie points in real time": ties[0], "tie points where the simulator waits": ties[1],
        "image lines unseen": unseen, "the simulator waited, s": held["waited_s"],
        **{f"{name}, share of a core": share for name, share in sorted(shares.items(), key=lambda item: -item[1])},
        "all together, cores": sum(shares.values()),
    }  # fmt: skip
    frame.show(figures, args.json)
    kept = all(shares.get(name, 0.0) <= most for name, most in MOST.items())
    return frame.verdict(ties[0] >= WANTED * ties[1] and not unseen and kept)


if __name__ == "__main__":
    sys.exit(main())
