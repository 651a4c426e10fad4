"""Fuzz campaign: every reader and every node on hostile files and messages, checksums kept right.

    python bench/fuzz.py [--cases 1000000] [--seconds 7200] [--seed 1] [--only WORD]

A case is one file that was read, one NMEA sentence or record of a driver that was parsed, or one message that a node
was given; the number is counted where that happens, so duplicates that hypothesis draws count, and examples it discards
do not. Findings are tracebacks, nodes that failed inside, cases of more than 2 s of processor time, and memory beyond
ten times the file (and 64 MB to start with). Each target has a process of its own, whose address space is bounded: what
takes more fails as a finding of that case, and a process that dies is a finding with its last case. The campaign ends
after the cases or the seconds of processor time, whichever is first; nine of ten cases go to nodes and sentences, which
are fast. ``longest`` is the processor time of the longest case, ``most`` by how much one raised the memory of its
process.
"""

from __future__ import annotations

import argparse
import resource
import sys
import tempfile
from functools import partial
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
for folder in ("tests/support", "tests/nodes/formats"):
    sys.path.insert(0, str(ROOT / folder))
HEAD = f"{'target':<34}{'cases':>9}{'refused':>9}{'longest ms':>12}{'most MB':>9}{'findings':>10}"


def used_s() -> float:
    """Processor time of the processes that have ended."""
    children = resource.getrusage(resource.RUSAGE_CHILDREN)
    return children.ru_utime + children.ru_stime


def main() -> int:
    from fuzzing import (
        SENTENCES,
        Campaign,
        file_targets,
        flown,
        in_a_process,
        node_names,
        run_files,
        run_node,
        run_sentences,
    )

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=int, default=1_000_000)
    parser.add_argument("--seconds", type=float, default=7200.0, help="of processor time")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", default="", help="targets whose name has this word")
    args = parser.parse_args()
    campaign = Campaign()

    with tempfile.TemporaryDirectory() as folder:
        slow = {target.name: partial(run_files, target) for target in file_targets(Path(folder))}
        nodes = {name: partial(run_node, name) for name in node_names()}
        fast = nodes | {name: partial(run_sentences, name) for name in SENTENCES}
        works = {name: work for name, work in (slow | fast).items() if args.only in name}
        files = len(works.keys() & slow)
        if works.keys() & nodes:
            flown()  # once, before processes are made
        per_file = args.cases // 10 // files if len(works) > files > 0 else args.cases // max(1, files)
        per_fast = (args.cases - per_file * files) // max(1, len(works) - files)
        print(HEAD, flush=True)
        for i, (name, work) in enumerate(works.items()):
            share_s = (args.seconds - used_s()) / (len(works) - i)
            in_a_process(campaign, name, work, per_file if name in slow else per_fast, args.seed, share_s)
            print(row(campaign, name), flush=True)
            print("".join(told(f) for f in campaign.findings.values() if f.target == name), end="", flush=True)
    most = f"{max(campaign.most_bytes.values(), default=0) / 1e6:.0f}"
    longest = f"{1e3 * max(campaign.longest_s.values(), default=0):.0f}"
    total, refused = campaign.cases.total(), campaign.refused.total()
    print(f"{'all':<34}{total:>9}{refused:>9}{longest:>12}{most:>9}{len(campaign.findings):>10}")
    print(f"{used_s():.0f} s of processor time")
    return 1 if campaign.findings else 0


def row(campaign, name: str) -> str:
    """The line of a target."""
    found = sum(f.target == name for f in campaign.findings.values())
    longest, most = f"{1e3 * campaign.longest_s.get(name, 0):.0f}", f"{campaign.most_bytes[name] / 1e6:.0f}"
    return f"{name:<34}{campaign.cases[name]:>9}{campaign.refused[name]:>9}{longest:>12}{most:>9}{found:>10}"


def told(finding) -> str:
    """What was wrong, and with what."""
    times = f" ({finding.times} times)" if finding.times > 1 else ""
    return f"    {finding.what}{times}\n    {finding.example[:1500]!r}\n"


if __name__ == "__main__":
    sys.exit(main())
