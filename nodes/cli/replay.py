"""``triline replay``: a recording onto the bus."""

from __future__ import annotations

import argparse
import threading
import time
from pathlib import Path

from ..bus.brake import Brake
from ..bus.program import stop_on_signals
from ..bus.session import Bus
from ..convert import iso
from ..formats.importable import refuse_importable
from ..formats.json_text import json_text
from ..player.player import first_stamp_ns, play, time_argument
from ..recording.reader import RecordingReader
from ..recording.summary import lacking
from .bus_options import add_bus_arguments, bus_of, reporter
from .damage import tell_damage
from .progress import progress

EXAMPLE = "triline replay flight.mcap --rate 4 --from 20 --to 50"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("recording", type=Path, metavar="RECORDING", help="flight.mcap")
    parser.add_argument("--rate", type=_rate, default=1.0, metavar="R", help="speed; 0 = as fast as it goes")
    parser.add_argument("--from", dest="from_", metavar="T", help="first platform time: seconds from start or ISO time")
    parser.add_argument("--to", metavar="T", help="last platform time: seconds from start or ISO time")
    parser.add_argument(
        "--loop",
        action="store_true",
        help="again and again; later rounds have shifted times and new names of strips and points",
    )
    parser.add_argument("--all", action="store_true", help="also what nodes make anew: trajectories, orientations, ...")
    parser.add_argument(
        "--wait-for", default="", metavar="NODES", help="wait for nodes (navigator,adjuster) that are too far behind"
    )
    add_bus_arguments(parser)


def run(args: argparse.Namespace) -> int:
    refuse_importable(args.recording)
    reader = RecordingReader(args.recording)
    if not len(reader.index.stamp_ns):
        raise lacking(reader, "nothing to play: no message in it")
    first = first_stamp_ns(reader)
    report = reporter(args.quiet or args.json)
    stop = threading.Event()
    stop_on_signals(stop)
    if args.loop:
        report("looping: later rounds have shifted stamps and times, and new names of strips and points (S1~2)")
    with Bus(source="player", file=args.bus, **bus_of(args)) as bus:
        nobody = bus.why_alone() or _nobody(bus, args.wait_for)
        bus.announce("player")
        bus.prepare({channel.topic for channel in reader.channels.values() if channel.known})
        brake = Brake(bus, args.wait_for, stop, args.rate)
        report(f"{args.recording}: from {iso(first)} at rate {args.rate:g}")
        tell_damage("replay", reader)
        if nobody:
            report(nobody)
        with progress("playing", args.quiet or args.json) as told:
            result = play(
                reader,
                bus.publish_raw,
                stop,
                rate=args.rate,
                from_ns=None if args.from_ is None else time_argument(args.from_, first),
                to_ns=None if args.to is None else time_argument(args.to, first),
                loop=args.loop,
                everything=args.all,
                start=bus.start,
                progress=told,
                hold=brake.wait,
            )
        stop.wait(0.5)  # time for messages that are still on their way
    if args.json:
        print(json_text({
            "messages": dict(sorted(result.counts.items())), "left_out": dict(sorted(result.left_out.items())),
            "rounds": result.rounds, "worst_late_ms": round(1e3 * result.worst_late_s, 3),
            "mean_late_ms": round(1e3 * result.mean_late_s, 4), "waited_s": round(brake.held_s, 3),
        }))  # fmt: skip
        return 0
    left_out = sum(result.left_out.values())
    print(
        f"played {sum(result.counts.values())} messages"
        + (f", left out {left_out} that nodes make anew" if left_out else "")
        + f"; at most {1e3 * result.worst_late_s:.1f} ms late, {1e3 * result.mean_late_s:.2f} ms on average"
        + (f"; waited {brake.held_s:.1f} s for nodes that were behind" if brake.held_s else "")
    )
    return 0


def _nobody(bus: Bus, awaited: str = "", patience_s: float = 0.5) -> str:
    """A line which says that no node is there, or not one that is to be waited for, or ""; waits a little for nodes
    that have just been started."""
    names = {name.strip() for name in awaited.split(",") if name.strip()}
    until = time.monotonic() + patience_s
    while not (alive := bus.alive()) or not alive >= names:
        if time.monotonic() > until:
            if not alive:
                return f"no node lives on platform {bus.platform} yet; who comes later gets the last minute"
            missing, there = ", ".join(sorted(names - alive)), ", ".join(sorted(alive))
            return f"--wait-for {missing}: not on platform {bus.platform} yet, so not waited for; there: {there}"
        time.sleep(0.05)
    return ""


def _rate(text: str) -> float:
    try:
        rate = float(text)
    except ValueError:
        rate = -1.0
    if not 0 <= rate < 1e6:
        raise argparse.ArgumentTypeError(f"{text!r}, wanted a number of at least 0")
    return rate
