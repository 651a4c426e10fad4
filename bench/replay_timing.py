"""How exactly a recording is replayed: lateness of messages on the bus against their stamps, at several rates.

python bench/replay_timing.py
"""

from __future__ import annotations

import json
import tempfile
from pathlib import Path

import frame

#: Times real time.
RATES = (1, 4, 16)


def main() -> None:
    parser = frame.parser(__doc__)
    parser.add_argument("--seconds", type=float, default=20.0, metavar="S", help="replayed at rate 1 (20)")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        flight = Path(folder) / "flight.mcap"
        frame.triline("simulate", "-o", str(flight), "--seconds", "60", "-q")
        print(f"{'rate':>6s}{'messages':>10s}{'mean late, ms':>15s}{'most late, ms':>15s}")
        for rate in RATES:
            to_s = min(args.seconds * rate, 60.0)
            said = frame.triline("replay", str(flight), "--rate", str(rate), "--to", str(to_s), "--json")
            result = json.loads(said)
            late = result["mean_late_ms"], result["worst_late_ms"]
            print(f"{rate:6d}{sum(result['messages'].values()):10d}{late[0]:15.3f}{late[1]:15.2f}")


if __name__ == "__main__":
    main()
