"""``triline view``: a recording in Rerun, through the same scene as a live flight."""

from __future__ import annotations

import argparse
import json
import signal
import sys
from collections import Counter
from pathlib import Path

from ..errors import UserError

EXAMPLE = "triline view flight.mcap --web"
_DRAW_STEP_NS = 500_000_000


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("recording", type=Path, help="MCAP recording")
    where = parser.add_mutually_exclusive_group()
    where.add_argument("--native", action="store_true", help="open a window (the default)")
    where.add_argument("--web", action="store_true", help="serve a web viewer on 127.0.0.1 until interrupted")
    where.add_argument("--rrd", metavar="FILE", type=Path, help="write a Rerun file instead of showing anything")
    parser.add_argument("--no-truth", action="store_true", help="do not show the truth of a simulation")


def run(args: argparse.Namespace) -> int:
    from ..recording.reader import RecordingReader

    reader = RecordingReader(args.recording)
    from ..viewer.rerun_canvas import RerunCanvas, open_canvas
    from ..viewer.scene import TOPICS, TRUTH_TOPICS

    messages = reader.sorted_messages((*TOPICS, *TRUTH_TOPICS))
    if args.rrd is not None and args.rrd.exists() and args.rrd.samefile(args.recording):
        raise UserError(f"{args.rrd}: is the recording itself")
    mode = f"rrd:{args.rrd}" if args.rrd is not None else "web" if args.web else "native"
    signal.signal(signal.SIGTERM, _stop)
    canvas = open_canvas(mode)
    process = canvas.process if isinstance(canvas, RerunCanvas) else None
    try:
        counts = show(messages, canvas, truth=not args.no_truth)
        if not counts.total():
            raise UserError(f"{args.recording}: nothing in it that can be shown")
        _say(args, mode, counts, None if process is None else process.web_url)
        if process is not None:
            process.wait()
    except KeyboardInterrupt:
        pass
    finally:
        if process is not None:
            process.close()
    return 0


def show(messages, canvas, truth: bool = True) -> Counter[str]:
    """Draw messages, in the order of their stamps, and close the canvas; returns how many of each topic were used."""
    from ..viewer import scene

    picture = scene.Scene(canvas)
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
        print(json.dumps(shown | ({"url": url} if mode == "web" else {}), indent=2), flush=True)
    elif mode == "web":
        print(f"{url}\nCtrl-C stops the viewer", flush=True)
    elif args.rrd is not None and not args.quiet:
        print(f"{args.rrd}: {counts.total()} messages; open it with 'rerun {args.rrd}'", flush=True)


def _stop(*_: object) -> None:
    sys.exit(0)
