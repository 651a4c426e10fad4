"""Options of all commands that connect to the bus."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

from ..errors import UserError
from ..terminal import plain


def add_bus_arguments(parser: argparse.ArgumentParser) -> None:
    """``--platform``, ``--port``, ``--bus`` and ``--secure``."""
    group = parser.add_argument_group("bus")
    group.add_argument("--platform", metavar="NAME", help="name of the platform (default: demo, or that of the bundle)")
    group.add_argument(
        "--port", type=_port, metavar="N", help="meeting port on loopback (default: TRILINE_PORT or 17447)"
    )
    group.add_argument("--bus", type=Path, metavar="FILE", help="a Zenoh configuration file instead")
    group.add_argument(
        "--secure", type=Path, metavar="BUNDLE", help="folder of `triline keys`: certificates, encryption, access list"
    )


def bus_of(args: argparse.Namespace) -> dict[str, Any]:
    """Named arguments of `bus.session.Bus` and of `bus.program.ProgramOptions` by the options of a command.

    Raises
    ------
    UserError : a bundle that cannot be used, or of another platform
    """
    secure = None
    if args.secure is not None:
        from ..bus.bundle import load_bundle

        if args.bus is not None:
            raise UserError("--bus and --secure: wanted one of them, a bundle has its own Zenoh configuration")
        secure = load_bundle(args.secure)
        if secure.kind == "aircraft" and args.platform not in (None, secure.name):
            raise UserError(f"--secure {args.secure}: is of aircraft {secure.name!r}, not of {args.platform!r}")
    own = secure.name if secure is not None and secure.kind == "aircraft" else "demo"
    return {"platform": args.platform or own, "port": args.port, "secure": secure}


def reporter(quiet: bool) -> Callable[[str], None]:
    """A function that prints a line on standard error, or nothing with --quiet.

    Work goes on where that cannot be written any more: its terminal was closed, ``2>&1 | tee`` has ended, the disk of
    the log is full.
    """

    def report(text: str) -> None:
        if not quiet:
            with suppress(OSError):
                print(plain(text), file=sys.stderr, flush=True)

    return report


def _port(text: str) -> int:
    if not text.isdigit() or not 0 < int(text) < 65536:
        raise argparse.ArgumentTypeError(f"{text!r}, wanted a port number")
    return int(text)
