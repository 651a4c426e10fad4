"""``triline view``: a recording in Rerun, through the same scene as a live flight."""

from __future__ import annotations

import argparse
import shlex
import signal
import sys
import threading
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from ..errors import UserError
from ..formats.importable import refuse_importable
from ..formats.json_text import json_text
from ..formats.new_file import new_file
from ..node import Message
from ..voices import VERDICT, RecordedVoices
from .bus_options import add_bus_arguments, bus_of, reporter
from .damage import tell_damage
from .outputs import refuse_input_as_output

if TYPE_CHECKING:
    from ..recording.reader import RecordingReader

EXAMPLE = """triline view flight.mcap --web
  triline view --fleet --secure survey/ann      # all aircraft in the air: docs/fleet.md"""
_DRAW_STEP_NS = 500_000_000


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "recording", type=Path, nargs="*", help="MCAP recording; with --fleet several, or none for aircraft in the air"
    )
    parser.add_argument("--fleet", action="store_true", help="all aircraft in one view")
    where = parser.add_mutually_exclusive_group()
    where.add_argument("--native", action="store_true", help="open a window (the default)")
    where.add_argument("--web", action="store_true", help="serve a web viewer on 127.0.0.1 until interrupted")
    where.add_argument("--rrd", metavar="FILE", type=Path, help="write a Rerun file instead of showing anything")
    parser.add_argument("--no-truth", action="store_true", help="do not show the truth of a simulation")
    add_bus_arguments(parser)


def run(args: argparse.Namespace) -> int:
    if args.fleet:
        return _fleet(args)
    if len(args.recording) != 1:
        raise UserError(f"{len(args.recording)} recordings, wanted one (--fleet shows several)")
    args.recording = args.recording[0]
    refuse_importable(args.recording)
    from ..recording.reader import RecordingReader
    from ..recording.summary import in_brackets, left_out_lines

    reader = RecordingReader(args.recording)
    from ..viewer.rerun_canvas import RerunCanvas, open_canvas

    messages = _messages(reader)
    signal.signal(signal.SIGTERM, _stop)
    process = None
    try:
        with _mode(args, [args.recording]) as mode:
            canvas = open_canvas(mode)
            process = canvas.process if isinstance(canvas, RerunCanvas) else None
            counts = show(messages, canvas, truth=not args.no_truth)
            if not counts.total():
                why = in_brackets(left_out_lines(reader))
                raise UserError(f"{args.recording}: nothing in it that can be shown{why}")
        mode = f"rrd:{args.rrd}" if args.rrd is not None else mode
        _say(args, mode, counts, None if process is None else process.web_url)
        tell_damage("view", reader)
        if process is not None:
            process.wait()
    except KeyboardInterrupt:
        pass
    finally:
        if process is not None:
            process.close()
    return 0


def _messages(reader: RecordingReader) -> Iterator[Message]:
    """What a recording holds for a scene, without the configuration and control that nodes did not use."""
    from ..viewer.scene import TOPICS, TRUTH_TOPICS, is_shown

    used = RecordedVoices().all_used(reader.sorted_messages((*TOPICS, *TRUTH_TOPICS, VERDICT)))
    return (message for message in used if is_shown(message.topic))


@contextmanager
def _mode(args: argparse.Namespace, recordings: list[Path]) -> Iterator[str]:
    """Mode of the canvas; a file has its name when the canvas is closed, and the one before stays where that fails.

    Raises
    ------
    UserError : the file to write is one of the recordings, or cannot be written
    """
    if args.rrd is None:
        yield "web" if args.web else "native"
        return
    refuse_input_as_output(args, "rrd")
    if not recordings:  # of aircraft in the air: what has been seen stays, whatever happens
        yield f"rrd:{args.rrd}"
        return
    with new_file(args.rrd) as part:
        yield f"rrd:{part}"


def _fleet(args: argparse.Namespace) -> int:
    """All aircraft of some recordings, or of those in the air until interrupted."""
    if args.platform is not None:
        raise UserError("--fleet and --platform: wanted one of them")
    from ..bus.program import stop_on_signals
    from ..viewer import fleet_live
    from ..viewer.rerun_canvas import RerunCanvas, open_canvas

    readers = []
    if args.recording:
        from ..recording.reader import RecordingReader

        readers = [RecordingReader(path) for path in args.recording]
    stop = threading.Event()
    stop_on_signals(stop)
    bus = None
    if not readers:
        from ..bus.session import Bus

        where = bus_of(args)
        where["platform"] = "fleet"
        bus = Bus(source="viewer", file=args.bus, **where)
        if alone := bus.why_alone():
            reporter(args.quiet)(alone)
    process = None
    try:
        with _mode(args, args.recording) as mode:
            canvas = open_canvas(mode)
            process = canvas.process if isinstance(canvas, RerunCanvas) else None
            if mode == "web" and process is not None:
                print(f"{process.web_url}\nCtrl-C stops the viewer", flush=True)
            if bus is None:
                used = fleet_live.show_recordings(readers, canvas)
                if not used:
                    raise UserError(f"{args.recording[0]}: nothing in it that can be shown")
            else:
                used = fleet_live.show_live(bus, canvas, stop)
        if bus is None and process is not None:
            process.wait()
    finally:
        if bus is not None:
            bus.close()
        if process is not None:
            process.close()
    if args.rrd is not None and args.json:
        shown = {"recordings": [str(path) for path in args.recording], "mode": f"rrd:{args.rrd}", "messages": used}
        print(json_text(shown))
    elif args.rrd is not None and not args.quiet:
        print(f"{args.rrd}: {used} messages; open it with `rerun {shlex.quote(str(args.rrd))}`", flush=True)
    return 0


def show(messages, canvas, truth: bool = True) -> Counter[str]:
    """Draw messages, in the order of their stamps, and close the canvas; returns how many of each topic were used."""
    from ..viewer import scene

    picture = scene.Scene(canvas, recorded=True)
    hidden = frozenset(() if truth else scene.TRUTH_TOPICS)
    counts: Counter[str] = Counter()
    next_ns = 0
    for message in messages:
        if not scene.is_shown(message.topic) or message.topic in hidden:
            continue
        try:
            picture.take(message)
        except ValueError:
            continue  # messages that a node would drop are not shown
        counts[message.topic] += 1
        if message.stamp_ns >= next_ns:
            picture.draw()
            next_ns = message.stamp_ns + _DRAW_STEP_NS
    picture.close()
    return counts


def _say(args: argparse.Namespace, mode: str, counts: Counter[str], url: str | None) -> None:
    if args.json:
        shown = {"recording": str(args.recording), "mode": mode, "messages": dict(sorted(counts.items()))}
        print(json_text(shown | ({"url": url} if mode == "web" else {})), flush=True)
    elif mode == "web":
        print(f"{url}\nCtrl-C stops the viewer", flush=True)
    elif args.rrd is not None and not args.quiet:
        print(f"{args.rrd}: {counts.total()} messages; open it with `rerun {shlex.quote(str(args.rrd))}`", flush=True)


def _stop(*_: object) -> None:
    sys.exit(0)
