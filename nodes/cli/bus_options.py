"""Options of all commands that go onto the bus."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from pathlib import Path


def add_bus_arguments(parser: argparse.ArgumentParser) -> None:
    """``--platform``, ``--port`` and ``--bus``."""
    group = parser.add_argument_group("bus")
    group.add_argument("--platform", default="demo", metavar="NAME", help="name of the platform (default: demo)")
    group.add_argument(
        "--port", type=_port, metavar="N", help="meeting port on loopback (default: TRILINE_PORT or 17447)"
    )
    group.add_argument("--bus", type=Path, metavar="FILE", help="a Zenoh configuration file instead")


def reporter(quiet: bool) -> Callable[[str], None]:
    """Prints lines for a person on standard error, nothing where quiet."""

    def report(text: str) -> None:
        if not quiet:
            print(text, file=sys.stderr, flush=True)

    return report


def _port(text: str) -> int:
    if not text.isdigit() or not 0 < int(text) < 65536:
        raise argparse.ArgumentTypeError(f"{text!r}, wanted a port number")
    return int(text)
