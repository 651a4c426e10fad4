"""How exactly a recording is replayed: lateness of messages on the bus against their stamps, at several rates.

python bench/replay_timing.py
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path

#: Times real time.
RATES = (1, 4, 16)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=20.0, metavar="S", help="replayed at rate 1 (20)")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        flight = Path(folder) / "flight.mcap"
        _triline("simulate", "-o", str(flight), "--seconds", "60", "-q")
        print(f"{'rate':>6s}{'messages':>10s}{'mean late, ms':>15s}{'most late, ms':>15s}")
        for rate in RATES:
            to_s = min(args.seconds * rate, 60.0)
            said = _triline("replay", str(flight), "--rate", str(rate), "--to", str(to_s), "--json")
            result = json.loads(said)
            late = result["mean_late_ms"], result["worst_late_ms"]
            print(f"{rate:6d}{sum(result['messages'].values()):10d}{late[0]:15.3f}{late[1]:15.2f}")
    return 0


def _triline(*words: str) -> str:
    done = subprocess.run([sys.executable, "-m", "triline.nodes.cli", *words], capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(done.stderr)
    return done.stdout


if __name__ == "__main__":
    sys.exit(main())
