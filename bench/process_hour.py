"""An hour of flight through ``triline process``: 200 Hz attitude or inertial data, 5 Hz GNSS, 100 tie rays a second.

    python bench/process_hour.py [--imu] [--pace throughput] [--recording FILE] [--share 1.0]

Prints wall and processor time of the whole command and how many times faster than life it is. ``--share`` flies a part
of the hour and says what the whole would take.
"""

from __future__ import annotations

import json
import resource
import subprocess
import tempfile
import time
from pathlib import Path

import frame

#: Strips of the hour, their length in seconds, and tie points a second that give 100 rays a second.
STRIPS, STRIP_S, TIES = 11, 238, 23


def main() -> None:
    parser = frame.parser(__doc__, as_json=True)
    parser.add_argument("--imu", action="store_true", help="inertial data, not attitude")
    parser.add_argument("--pace", choices=("load", "throughput"), default="load", help="as of triline process")
    parser.add_argument("--recording", type=Path, help="a recording instead of a simulated flight")
    parser.add_argument("--share", type=float, default=1.0)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        recording = args.recording or Path(name) / "hour.mcap"
        if args.recording is None:
            plan = ["--strips", str(max(1, round(STRIPS * args.share))), "--seconds", str(STRIP_S), "--ties", str(TIES)]
            sensor = ["--imu", "tactical"] if args.imu else []
            frame.triline("simulate", "-o", str(recording), *plan, *sensor, "-q")
        before, begun = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
        output = Path(name) / "out.mcap"
        done = subprocess.run(
            [*frame.TRILINE, "process", str(recording), "-o", str(output), "--pace", args.pace, "--json"],
            check=True, capture_output=True,
        )  # fmt: skip
        wall, after = time.perf_counter() - begun, resource.getrusage(resource.RUSAGE_CHILDREN)
        result = json.loads(done.stdout)
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    flight = result["flight_s"]
    figures = {
        "flight, s": round(flight), "messages in": sum(result["inputs"].values()),
        "messages out": sum(result["outputs"].values()), "wall, s": round(wall, 1), "processor, s": round(cpu, 1),
        "times real time": round(flight / wall, 1), "an hour takes, s": round(3600.0 * wall / flight, 1),
        "an hour takes, processor s": round(3600.0 * cpu / flight, 1),
    }  # fmt: skip
    frame.show(figures, args.json)


if __name__ == "__main__":
    main()
