"""Tie point published to refined orientation received, over the bus: publisher and adjuster are two processes.

    python bench/tie_latency.py [--rays 500] [--window 40] [--seconds 75] [--selfcal none]
                                 [--computed] [--loops 0]

A flight with so many tie rays a second is simulated and navigated beforehand; then its poses, tie points and control
are published at the pace of their stamps, and an adjuster (``triline node adjuster``) answers. A tie point is answered
by the first ``orientation/live`` that comes after the ``point/object`` of that point: it was computed with the point in
the window. Tie points count once the window is full. Times are wall time, or with ``--computed``, which needs no bus,
processor times, for machines that others use as well. With ``--loops N`` other programs keep N cores busy meanwhile.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import frame
import numpy as np
from tie_latency_computed import computed

from triline.nodes.bus.pacing import publish_paced
from triline.nodes.bus.priority import go_first
from triline.nodes.bus.processes import NodeGroup
from triline.nodes.bus.session import Bus
from triline.nodes.node import Message
from triline.nodes.recording.reader import RecordingReader
from triline.schemas import codec
from triline.schemas.envelope import RawMessage

TOPICS = [
    "configuration/project", "configuration/camera", "configuration/strip", "observation/control", "observation/tie",
    "trajectory/filtered", "trajectory/smoothed",
]  # fmt: skip
#: Rays of a tie point of a single ADS40 strip, about.
RAYS_A_POINT = 2.9


class Ears:
    """What is published and what comes back, with the times."""

    def __init__(self) -> None:
        self.published: dict[str, float] = {}
        self.answers_s: list[tuple[float, float]] = []  # time of publication, latency
        self.compute_s: list[tuple[float, float]] = []
        self.lives = 0
        self.pace = 0
        self._solved: list[str] = []
        self._begun = time.perf_counter()

    def messages(self, path: Path) -> Iterator[Message]:
        for message in RecordingReader(path).sorted_messages(TOPICS):
            yield message
            if message.topic == "observation/tie":
                self.published.setdefault(message.body.point, time.perf_counter())

    def point(self, raw: RawMessage) -> None:
        self._solved.append(codec.decode(raw.topic, raw.data).point)

    def live(self, raw: RawMessage) -> None:
        now = time.perf_counter()
        self.lives += 1
        for name in self._solved:
            then = self.published.pop(name, None)
            if then is not None:
                self.answers_s.append((then, now - then))
        self._solved.clear()

    def report(self, raw: RawMessage) -> None:
        self.compute_s.append((time.perf_counter(), codec.decode(raw.topic, raw.data).compute_s))

    def paced(self, raw: RawMessage) -> None:
        self.pace = max(self.pace, codec.decode(raw.topic, raw.data).level)


def prepare(folder: Path, args: argparse.Namespace) -> Path:
    """A recording with poses and tie points."""
    flight, navigated = folder / "flight.mcap", folder / "navigated.mcap"
    ties = args.rays / RAYS_A_POINT
    plan = ["--seconds", str(args.seconds), "--ties", f"{ties:.1f}", "--strips", "1", "-q"]
    frame.triline("simulate", "-o", str(flight), *plan)
    frame.triline("process", str(flight), "-o", str(navigated), "--nodes", "navigator", "-q")
    return navigated


def busy_loop(over: ExitStack) -> None:
    """A program of another session that takes all that it gets of a core, till the end."""
    loop = "import os\nos.setpriority(os.PRIO_PROCESS, 0, 0)\nwhile True: pass"
    program = subprocess.Popen([sys.executable, "-c", loop], start_new_session=True)
    over.callback(program.wait)
    over.callback(program.kill)


def in_its_own_session() -> None:
    """Go on as the nodes do for which this program stands: leading a session, and before other programs."""
    if os.getsid(0) != os.getpid():
        with subprocess.Popen([sys.executable, *sys.argv], start_new_session=True) as program:
            try:
                sys.exit(program.wait())
            finally:
                program.kill()
    go_first()


def main() -> None:
    parser = frame.parser(__doc__, as_json=True)
    parser.add_argument("--rays", type=float, default=500.0, help="tie rays a second")
    parser.add_argument("--window", type=float, default=40.0, help="s")
    parser.add_argument("--seconds", type=float, default=75.0, help="of the strip")
    parser.add_argument("--selfcal", default="none", help="set of additional parameters")
    parser.add_argument("--update-rays", type=int, default=12, help="an update as soon as so many wait")
    parser.add_argument("--computed", action="store_true", help="from processor times, without the bus")
    parser.add_argument("--loops", type=int, default=0, help="cores that other programs keep busy")
    parser.add_argument("--port", type=int, default=17621)
    args = parser.parse_args()
    if not args.computed:
        in_its_own_session()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        recording = prepare(folder, args)
        if args.computed:
            named = {"self_calibration": args.selfcal, "update_rays": args.update_rays, "window_s": args.window}
            # the strip begins 10 s after the first message; at its end everything leaves
            found = computed(recording, TOPICS, named, 11.0 + args.window, 8.0 + args.seconds)
            frame.show(found, args.json)
            return
        ears = Ears()
        with (
            ExitStack() as over,
            NodeGroup(folder, "bench", args.port) as group,
            Bus("bench", source="bench", port=args.port) as bus,
        ):
            for _ in range(args.loops):
                busy_loop(over)
            settings = (
                f"window_s={args.window}",
                f'self_calibration="{args.selfcal}"',
                f"update_rays={args.update_rays}",
            )
            group.start("adjuster", *(word for setting in settings for word in ("--set", setting)))
            while "adjuster" not in bus.alive():
                time.sleep(0.1)
            bus.subscribe("point/object", ears.point)
            bus.subscribe("orientation/live", ears.live)
            bus.subscribe("adjustment/report", ears.report)
            bus.subscribe("adjustment/pace", ears.paced)
            begun = time.perf_counter()
            pacer = publish_paced(bus, ears.messages(recording), 1.0, threading.Event())
            time.sleep(1.0)
    full = begun + 12.0 + args.window  # the strip begins 10 s after the first message; a second to settle
    latency = 1e3 * np.array([s for then, s in ears.answers_s if then > full])
    compute = 1e3 * np.array([s for then, s in ears.compute_s if then > full])
    p50, p90, p99 = np.percentile(latency, [50, 90, 99])
    figures = {
        "tie points": len(latency), "p50_ms": round(p50, 1), "p90_ms": round(p90, 1), "p99_ms": round(p99, 1),
        "max_ms": round(latency.max(), 1),
        "update wall time p50, p99, ms": np.percentile(compute, [50, 99]).round(1).tolist(),
        "updates a second": round(len(compute) / (args.seconds - args.window - 2.0), 1),
        "live messages": ears.lives, "highest level of the pace": ears.pace,
        "publisher late at worst, ms": round(1e3 * pacer.worst_late_s, 1),
    }  # fmt: skip
    frame.show(figures, args.json)


if __name__ == "__main__":
    main()
