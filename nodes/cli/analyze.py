"""``triline analyze``: one self-contained HTML report of a recording."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from ..errors import UserError
from ..report.accuracy_table import accuracy_lines

EXAMPLE = "triline analyze flight.mcap -o report.html"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("recording", type=Path, help="MCAP recording, best one that went through the adjuster")
    parser.add_argument("-o", "--output", type=Path, default=Path("report.html"), help="HTML file (report.html)")


def write_report(recording: Path, output: Path) -> dict[str, Any]:
    """Analyse a recording, write the HTML page, and return the numbers in it.

    Raises
    ------
    UserError : nothing to analyse, or the page cannot be written
    """
    from ..report.analysis import analyse
    from ..report.flight import collect
    from ..report.page import page
    from ..report.source import messages_of

    flight = collect(messages_of(recording))
    if not flight.counts:
        raise UserError(f"{recording}: nothing in it that can be analysed")
    if output.exists() and output.samefile(recording):
        raise UserError(f"{output}: is the recording itself")
    result = analyse(flight, recording.name, recording.stat().st_size)
    try:
        output.write_text(page(flight, result), encoding="utf-8")
    except OSError as error:
        raise UserError(f"{output}: {(error.strerror or 'cannot be written').lower()}") from None
    return result


def run(args: argparse.Namespace) -> int:
    result = write_report(args.recording, args.output)
    if args.json:
        print(json.dumps({"report": str(args.output), **result}, indent=2))
    elif not args.quiet:
        if args.verbose:
            for line in result["missing"]:
                print(f"not in this recording: {line}")
            for name, n in result["poses_left_out"].items():
                print(f"{name}: {n} poses that are not valid, left out of the statistics")
        print("\n".join(accuracy_lines(result)))
        print(f"{args.output}: {args.output.stat().st_size / 1e6:.1f} MB")
    return 0
