"""Make the golden recording and what follows from it anew: ``make golden``."""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

import pandas as pd

from triline.nodes.recording.access import Recording

FOLDER = Path(__file__).parent
FLIGHT = FOLDER / "strip.mcap"
EXPECTED = FOLDER / "strip.expected.csv"
COLUMNS = ["kind", "name", "x", "y", "z", "omega", "phi", "kappa"]


def triline(*arguments: object) -> None:
    """Run a command quietly."""
    command = [sys.executable, "-m", "triline.nodes.cli", *map(str, arguments), "-q"]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)


def results(flight: Path) -> pd.DataFrame:
    """Final orientations (name: time in ns) and object points of ``triline process`` at the pace of flight; m, rad."""
    with tempfile.TemporaryDirectory() as folder:
        processed = Path(folder) / "processed.mcap"
        triline("process", flight, "-o", processed, "--pace", "load")
        recording = Recording(processed)
        final = recording.poses("orientation/final")
        rows = [
            ["orientation", str(t), *xyz, *angles]
            for t, xyz, angles in zip(final.time_ns, final.position_l, final.angles, strict=True)
        ]
        for message in recording.messages("point/object"):
            body = message.body
            if body.status == 1:
                rows.append(["point", body.point, body.x, body.y, body.z, 0.0, 0.0, 0.0])
    return pd.DataFrame(rows, columns=COLUMNS)


if __name__ == "__main__":
    triline("simulate", "--seconds", 25, "--lead-in", 3, "--seed", 2, "--ties", 4, "--check", 6, "--attitude-rate", 100,
            "--compression", "zstd", "-o", FLIGHT)  # fmt: skip
    results(FLIGHT).to_csv(EXPECTED, index=False, float_format="%.9g")
