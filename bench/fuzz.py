"""Fuzz campaign: every reader and every node on hostile files and messages, checksums kept right.

    python bench/fuzz.py [--cases 1000000] [--seconds 3600] [--seed 1] [--only WORD]

A case is one file that was read, one NMEA sentence that was parsed, or one message that a node was given; the number is
counted where that happens, so duplicates that hypothesis draws count, and examples it discards do not. Findings are
tracebacks, nodes that failed inside, cases of more than 2 s, and memory beyond ten times the file (and 64 MB to start
with). The campaign ends after the cases or the seconds, whichever is first; nine of ten cases go to nodes and NMEA,
which are fast.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
for folder in ("tests/support", "tests/nodes/formats"):
    sys.path.insert(0, str(ROOT / folder))


def main() -> int:
    from fuzzing import Campaign, NodeTarget, file_targets, node_names, run_files, run_nmea, run_node

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=int, default=1_000_000)
    parser.add_argument("--seconds", type=float, default=3600.0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", default="", help="targets whose name has this word")
    args = parser.parse_args()
    campaign, begun = Campaign(), time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        files = [t for t in file_targets(Path(folder)) if args.only in t.name]
        nodes = [name for name in node_names() if args.only in name]
        per_file = args.cases // 10 // max(1, len(files))
        per_fast = (args.cases - per_file * len(files)) // max(1, len(nodes) + ("NMEA".find(args.only) >= 0))
        rest = [(run_files, t, per_file) for t in files] + [(run_node, NodeTarget(n), per_fast) for n in nodes]
        turns = len(rest) + 1
        for i, (run, target, cases) in enumerate(rest):
            share = (args.seconds - (time.monotonic() - begun)) / (turns - i)
            run(campaign, target, cases, args.seed, time.monotonic() + share)
        if "NMEA".find(args.only) >= 0:
            run_nmea(campaign, per_fast, args.seed, begun + args.seconds)
    print(f"{'target':<34}{'cases':>9}{'refused':>9}{'longest ms':>12}{'findings':>10}")
    for name, cases in campaign.cases.items():
        found = sum(f.target == name for f in campaign.findings.values())
        longest = f"{1e3 * campaign.longest_s[name]:.0f}"
        print(f"{name:<34}{cases:>9}{campaign.refused[name]:>9}{longest:>12}{found:>10}")
    print(f"{'all':<34}{campaign.cases.total():>9}{campaign.refused.total():>9}{'':>12}{len(campaign.findings):>10}")
    for finding in campaign.findings.values():
        print(f"{finding.target}: {finding.what} ({finding.times} times)")
        print(f"    {finding.example[:300]!r}")
    return 1 if campaign.findings else 0


if __name__ == "__main__":
    sys.exit(main())
