"""Do all tests pass, run after run, while other programs keep the cores busy?

    python bench/busy_tests.py [--runs 20] [--loops 1] [--log FILE]

Each run is that of `make test`, beside endless loops. It is written into the log as soon as it has ended, and runs of
the same version of the program that stand there already count: twenty runs may be spread over as many evenings. Exit
code 3 where one has failed.
"""

from __future__ import annotations

import csv
import datetime
import re
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import frame

ROOT = Path(__file__).parents[1]
FIELDS = ("version", "day", "loops", "passed", "failed", "seconds", "exit_code")
LOOP = "while True: pass"


def version() -> str:
    """The commit, which must be all that is there but for pages that benchmarks write: runs of other files tell nothing
    of it."""
    status = ["git", "status", "--porcelain", "--", ".", ":!docs"]
    changed = subprocess.run(status, cwd=ROOT, check=True, capture_output=True, text=True)
    if changed.stdout.strip():
        raise SystemExit("busy_tests: files are changed, wanted a clean checkout, whose commit says what was tested")
    head = subprocess.run(["git", "rev-parse", "HEAD"], cwd=ROOT, check=True, capture_output=True, text=True)
    return head.stdout.strip()[:12]


@contextmanager
def busy(loops: int) -> Iterator[None]:
    """Programs that do nothing but use a core each."""
    others = [subprocess.Popen([sys.executable, "-c", LOOP]) for _ in range(loops)]
    try:
        yield
    finally:
        for other in others:
            other.kill()
            other.wait()


def one_run(loops: int) -> dict[str, str]:
    """All tests once; what pytest counted is in its last line."""
    begun = time.monotonic()
    with busy(loops):
        done = subprocess.run(["make", "test"], cwd=ROOT, capture_output=True, text=True)
    counted = {word: number for number, word in re.findall(r"(\d+) (passed|failed|errors?)\b", done.stdout[-400:])}
    for line in done.stdout.splitlines():
        if line.startswith(("FAILED", "ERROR")):
            print(line, file=sys.stderr, flush=True)
    bad = sum(int(number) for word, number in counted.items() if word != "passed")
    return {
        "day": datetime.date.today().isoformat(),
        "loops": str(loops),
        "passed": counted.get("passed", "0"),
        "failed": str(bad),
        "seconds": f"{time.monotonic() - begun:.0f}",
        "exit_code": str(done.returncode),
    }


def runs_of(log: Path, now: str, loops: int) -> list[dict[str, str]]:
    """Those in the log of this version beside so many loops."""
    if not log.exists():
        return []
    with log.open(newline="") as file:
        return [row for row in csv.DictReader(file) if row["version"] == now and row["loops"] == str(loops)]


def main() -> int:
    parser = frame.parser(__doc__)
    parser.add_argument("--runs", type=int, default=20, help="in all, with those in the log (20)")
    parser.add_argument("--loops", type=int, default=1, help="endless loops beside each (1)")
    parser.add_argument("--log", type=Path, default=ROOT / "build" / "busy_tests.csv", help="kept there (%(default)s)")
    args = parser.parse_args()
    now = version()
    rows = runs_of(args.log, now, args.loops)
    args.log.parent.mkdir(parents=True, exist_ok=True)
    while len(rows) < args.runs:
        row = {"version": now, **one_run(args.loops)}
        rows.append(row)
        new = not args.log.exists()
        with args.log.open("a", newline="") as file:
            writer = csv.DictWriter(file, FIELDS)
            if new:
                writer.writeheader()
            writer.writerow(row)
        print(f"run {len(rows)}: {row['passed']} passed, {row['failed']} failed in {row['seconds']} s", flush=True)
    bad = [row for row in rows if row["exit_code"] != "0"]
    print(f"{len(rows)} runs of {now} beside {args.loops} busy: {len(bad)} with a failure")
    return frame.NOT_MET if bad else 0


if __name__ == "__main__":
    raise SystemExit(main())
