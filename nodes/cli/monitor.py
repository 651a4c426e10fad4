"""``triline monitor``: the health of a platform, or of all aircraft of a fleet, on one screen."""

from __future__ import annotations

import argparse
import threading

from ..bus.program import ProgramOptions, stop_on_signals
from ..errors import UserError
from ..formats.json_text import json_text
from .bus_options import add_bus_arguments, bus_of, reporter

EXAMPLE = "triline monitor --fleet --secure survey/ann"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--fleet", action="store_true", help="all aircraft that a router knows, a row each")
    parser.add_argument(
        "--seconds", type=float, metavar="X", help="end after so long; with --json the way to get a table"
    )
    add_bus_arguments(parser)


def run(args: argparse.Namespace) -> int:
    from ..bus.session import Bus
    from ..monitor import fleet, monitor

    if args.seconds is not None and not args.seconds > 0:
        raise UserError(f"--seconds {args.seconds}: wanted more than 0")
    where = bus_of(args)
    stop = threading.Event()
    stop_on_signals(stop)
    if args.seconds is not None:
        timer = threading.Timer(args.seconds, stop.set)
        timer.daemon = True
        timer.start()
    report = reporter(args.quiet)
    if not args.fleet:
        options = ProgramOptions("monitor", bus_file=args.bus, stop=stop, report=report, **where)
        seen = monitor.watch_platform(options, quiet=args.quiet or args.json)
        if args.json:
            print(json_text(seen.as_json()))
        return 0
    if args.platform is not None:
        raise UserError("--fleet and --platform: wanted one of them")
    where["platform"] = fleet.FLEET
    with Bus(source="monitor", file=args.bus, **where) as bus:
        if alone := bus.why_alone():
            report(alone)
        overview = fleet.watch(bus, stop, "fleet", args.quiet or args.json)
    if args.json:
        print(json_text({"ground": overview.ground, "aircraft": overview.rows()}))
    return 0
