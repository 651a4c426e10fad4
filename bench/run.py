"""All benchmarks, one after the other: ``make bench``. Each is a program of its own and can be run alone."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

FOLDER = Path(__file__).parent
#: What is measured, and the program that measures it with its arguments.
BENCHMARKS = {
    "bus and recorder under the load of three full image lines": ["bus_load.py"],
    "timing of a replay": ["replay_timing.py"],
    "batch adjustment against Ceres": ["ceres/compare.py"],
    "batch adjustment: time and memory against size": ["adjustment_scaling.py", "-o", "out/bench"],
    "batch job: snooping, elimination, covariances": ["adjustment_job.py"],
    "inertial navigation": ["navigation.py"],
    "users' traps in inertial and GNSS data": ["navigation_traps.py", "--seeds", "2"],
    "a-priori weights from the trajectory": ["apriori.py", "--quick"],
    "how fast the errors of smoothed poses change": ["pose_changes.py", "--seeds", "2"],
    "sliding window: latency of updates": ["window.py", "latency", "--selfcal", "--interval", "0.024"],
    "sliding window beside GTSAM and Ceres": ["window_peers.py"],
    "tie point to orientation over the bus": ["tie_latency.py"],
    "the same with self-calibration": ["tie_latency.py", "--selfcal", "tls18"],
    "the same from processor times": ["tie_latency.py", "--selfcal", "tls18", "--computed"],
    "an hour through process, pace for throughput": ["process_hour.py", "--imu", "--pace", "throughput"],
    "a tenth of it at the pace of a live flight": ["process_hour.py", "--imu", "--share", "0.1"],
    "memory and latency over hours": ["long_flight.py", "--hours", "1"],
    "sliding window against the batch adjustment, one strip": ["efficiency.py", "table", "--seeds", "6"],
    "the same, a block of strips": ["efficiency.py", "block", "--seeds", "4", "--strip-s", "24"],
    "the same against `triline adjust`": ["efficiency.py", "adjust", "--seeds", "2", "--strip-s", "24"],
    "sliding window: normalised errors": ["consistency.py", "seeds"],
    "the same as time goes on": ["drift.py", "--minutes", "45"],
    "self-calibration with dense rays, batch and window": ["self_calibration.py", "--ties", "100", "--seeds", "6"],
    "protection levels with wrong control": ["consistency.py", "control", "--seeds", "20"],
    "data snooping against the batch adjustment's": ["outliers.py", "--seeds", "6"],
    "tie points that drift": ["drifting_sources.py", "--seeds", "1", "--dense", "1"],
    "orthoimage": ["orthoimage.py"],
    "tie points of spoilt image lines": ["bad_imagery.py", "--seeds", "1"],
    "image matching at full rate, and beside OpenCV": ["matcher.py"],
}


def main() -> int:
    failed = []
    for title, (program, *arguments) in BENCHMARKS.items():
        print(f"\n=== {title}: bench/{program}", flush=True)
        if subprocess.run([sys.executable, str(FOLDER / program), *arguments]).returncode:
            failed.append(program)
    if failed:
        print(f"\nfailed: {', '.join(failed)}")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
