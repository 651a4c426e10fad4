"""``triline check``: whether a recording is whole."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from ..errors import UserError
from ..recording import RecordingReader
from ..recording_summary import findings

EXAMPLE = "triline check flight.mcap"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("recording", type=Path, metavar="RECORDING", help="flight.mcap")


def run(args: argparse.Namespace) -> int:
    reader = RecordingReader(args.recording)
    found = findings(reader)
    if args.json:
        print(json.dumps({"file": str(args.recording), "whole": not found, "findings": found}, indent=2))
        return 1 if found else 0
    if found:
        more = f" (and {len(found) - 1} more)" if len(found) > 1 and not args.verbose else ""
        if args.verbose:
            print("\n".join(found))
        raise UserError(f"{args.recording}: {found[0]}{more}")
    if not args.quiet:
        print(f"{args.recording}: whole, {len(reader.index)} messages in {reader.n_chunks} chunks")
    return 0
