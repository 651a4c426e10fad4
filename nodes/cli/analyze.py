"""``triline analyze``: one self-contained HTML report of a recording."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

from ..errors import UserError
from ..formats.importable import refuse_importable
from ..formats.json_text import json_text
from ..formats.new_file import new_file
from ..recording.remote import path_of
from ..recording.summary import Holdings
from ..report.accuracy_table import accuracy_lines

#: Ends of names of what a page is not.
_NO_PAGE = (".pdf", ".docx", ".odt", ".json", ".csv", ".png", ".mcap")
EXAMPLE = "triline analyze flight.mcap -o report.html"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "recording", type=path_of, help="MCAP recording or URL, with results of the adjuster for a full report"
    )
    parser.add_argument("-o", "--output", type=Path, default=Path("report.html"), help="HTML file (report.html)")


def write_report(recording: Path, output: Path) -> dict[str, Any]:
    """Analyse a recording, write the HTML page, and return the numbers in it.

    Raises
    ------
    UserError : nothing to analyse, or the page cannot be written
    """
    if not recording.exists():
        raise UserError(f"{recording}: no such file or folder")
    refuse_importable(recording)
    if output.suffix.lower() in _NO_PAGE:
        raise UserError(f"{output}: the report is a page, wanted {output.with_suffix('.html')}, which browsers print")
    from ..report.analysis import analyse
    from ..report.page import page
    from ..report.source import read

    with new_file(output) as part, open(part, "w", encoding="utf-8") as file:  # before the work begins
        flight, held = read(recording)
        if held.span_ns is None or not flight.counts:
            raise UserError(f"{recording}: {_nothing(held)}")
        result = analyse(flight, held)
        file.write(page(flight, result))
    return result


def _nothing(held: Holdings) -> str:
    """Why there is nothing to analyse."""
    topics = ", ".join(row.topic for row in held.topics if row.messages)
    why = "; ".join(held.damage)
    what = f"no measurement and no result in it, only {topics}" if topics else "no message in it"
    return f"{what}{'; ' + why if why else ''}"


def run(args: argparse.Namespace) -> int:
    result = write_report(args.recording, args.output)
    if args.json:
        print(json_text({"report": str(args.output), **result}))
    elif not args.quiet:
        lines = accuracy_lines(result)
        compared = result["orientation"] or result["points"] or result["check"]
        if args.verbose or not compared:
            for line in result["missing"]:
                print(f"not in this recording: {line}")
        if args.verbose:
            for name, n in result["poses_left_out"].items():
                print(f"{name}: {n} poses that are not valid, left out of the statistics")
        lines += result["not_used"]
        if not compared:
            lines.append("no accuracy: neither truth nor check points to compare with")
        print("\n".join(lines))
        print(f"{args.output}: {args.output.stat().st_size / 1e6:.1f} MB")
    if result["damage"] and not args.json:
        print(f"triline analyze: {args.recording}: {'; '.join(result['damage'])}", file=sys.stderr)
    return 0
