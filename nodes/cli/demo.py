"""``triline demo``: a simulated flight, triangulated while it is flown."""

from __future__ import annotations

import argparse
import json
import os
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from ..errors import UserError
from ..monitor import display
from ..processes import NodeGroup, NodeProcess

EXAMPLE = "triline demo --headless --seconds 60 --seed 7"

PLATFORM = "demo"
#: What turns sensors into orientation and orthoimages, in the order in which it is stopped at the end: with image lines
#: and without.
ESTIMATORS = ("navigator", "matcher", "adjuster", "rectifier")
ESTIMATORS_OF_TIES = ("navigator", "adjuster")
#: The flight with image lines: 3 x 1500 pixels, 200 times a second.
IMAGERY = {"images": "true", "sensor": '"ads40-inner"', "height": "1690", "speed": "140", "relief": "50"}
READY_S = 20.0
#: Once the flight has landed: longest wait until every node has worked off what it has.
DRAIN_S = 15.0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--headless", action="store_true", help="no window; the scene goes to a .rrd file instead")
    parser.add_argument(
        "--no-images", action="store_true", help="no image lines: tie points are simulated, not matched"
    )
    parser.add_argument("--web", action="store_true", help="show the scene in a browser (loopback only)")
    parser.add_argument("--seconds", type=_seconds, default=60.0, metavar="N", help="length of the strip (default 60)")
    parser.add_argument("--seed", type=int, default=1, metavar="N", help="of the simulated flight (default 1)")
    parser.add_argument(
        "-o", "--output", type=Path, default=Path("out/demo"), metavar="DIR", help="folder of results (out/demo)"
    )
    parser.add_argument("--port", type=int, metavar="N", help="meeting port of the bus (default: a free one)")


def run(args: argparse.Namespace) -> int:
    demo = Demo(args)
    result = demo.fly()
    if args.json:
        print(json.dumps(result, indent=2))
    else:
        print(demo.summary(result))
    return 0


class Demo:
    """The processes of a demo flight, from start to results."""

    def __init__(self, args: argparse.Namespace):
        self.args = args
        self.folder: Path = args.output
        self.recording = self.folder / "flight.mcap"
        self.stop = threading.Event()
        self.restarts = 0
        self._lost: dict[str, int] = {}
        self.estimators = ESTIMATORS_OF_TIES if args.no_images else ESTIMATORS
        self.viewer_mode = self._viewer_mode()
        self._silent = args.quiet or args.json

    def fly(self) -> dict[str, Any]:
        """Run the demo; returns the evaluation of its recording."""
        self._clear()
        port = self.args.port or _free_port()
        with NodeGroup(self.folder / "log", PLATFORM, port) as group, _interruptible(self.stop):
            self._say(f"bus on 127.0.0.1:{port}; logs in {group.log_folder}; Ctrl-C ends the flight early")
            group.start("recorder", "-o", str(self.recording))
            for name in self.estimators:
                group.start(name)
            group.start("viewer", "--set", f"mode={json.dumps(self.viewer_mode)}")
            with self._monitor(port) as (overview, alive):
                self._wait_ready(group, alive)
                self._tell_web_address(group)
                simulator = group.start("simulator", *self._flight())
                with display(overview, f"triline demo, seed {self.args.seed}", quiet=self._silent) as show:
                    self._watch(group, simulator, show)
                    self._land(group, overview, show)
            if simulator.process.returncode and not self.stop.is_set():
                raise UserError(f"the simulator failed: {simulator.last_line()} (see {simulator.log_path})")
        return self._evaluate()

    # ---- before the flight

    def _clear(self) -> None:
        """The flight before goes to ``before``, its logs and scene go; nothing else in the folder is touched."""
        self.folder.mkdir(parents=True, exist_ok=True)
        before, earlier = self.folder / "before", sorted(self.folder.glob("flight*.mcap"))
        for old in [*(before.glob("flight*.mcap") if earlier else ()), *self.folder.glob("log/*.log"),
                    self.folder / "flight.rrd"]:  # fmt: skip
            old.unlink(missing_ok=True)
        for recording in earlier:
            before.mkdir(exist_ok=True)
            recording.replace(before / recording.name)
        if earlier:
            self._say(f"the flight before is kept in {before}")

    def _viewer_mode(self) -> str:
        if self.args.web:
            return "web"
        no_display = sys.platform.startswith("linux") and not (
            os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
        )
        if self.args.headless or no_display:
            return f"rrd:{self.folder / 'flight.rrd'}"
        return "native"

    def _wait_ready(self, group: NodeGroup, alive: Callable[[], set[str]]) -> None:
        wanted = set(group.processes)
        until = time.monotonic() + READY_S
        while not wanted <= alive():
            for dead in group.dead():
                if dead.name == "viewer":  # a demo without a picture is still a demo
                    self._say(f"no viewer: {dead.last_line()}")
                    wanted.discard("viewer")
                    del group.processes["viewer"]
                    continue
                raise UserError(f"the {dead.name} failed: {dead.last_line()} (see {dead.log_path})")
            if time.monotonic() > until:
                missing = ", ".join(sorted(wanted - alive()))
                raise UserError(f"{missing} did not come up within {READY_S:.0f} s (see {group.log_folder})")
            if self.stop.wait(0.1):
                break

    def _tell_web_address(self, group: NodeGroup) -> None:
        if self.viewer_mode == "web" and "viewer" in group.processes:
            log = group.processes["viewer"].log_path.read_text(errors="replace")
            address = next((word for word in log.split() if word.startswith("http://")), None)
            self._say(f"scene at {address}" if address else f"no address of the scene; see {group.log_folder}")

    def _flight(self) -> list[str]:
        """Settings of the simulator."""
        settings = {"seed": self.args.seed, "seconds": self.args.seconds}
        if not self.args.no_images:
            settings |= IMAGERY | {"wait_for": json.dumps(",".join(self.estimators))}
        return [word for key, value in settings.items() for word in ("--set", f"{key}={value}")]

    # ---- in flight

    def _watch(self, group: NodeGroup, simulator: NodeProcess, show: Callable[[], None]) -> None:
        """Until the flight has ended; a node that dies is started again."""
        while simulator.running and not self.stop.wait(0.25):
            show()
            for dead in group.dead():
                if dead is simulator:
                    continue
                if dead.name == "viewer":  # its window was closed
                    del group.processes["viewer"]
                    continue
                self.restarts += 1
                arguments = ("-o", str(self._next_recording())) if dead.name == "recorder" else ()
                group.start(dead.name, *arguments)
        simulator.stop()

    def _next_recording(self) -> Path:
        return self.folder / f"flight-{len(list(self.folder.glob('flight*.mcap'))) + 1}.mcap"

    def _land(self, group: NodeGroup, overview: Any, show: Callable[[], None]) -> None:
        """Let the nodes work off what they have, then stop them along the flow, the recorder last."""
        # what comes late after the last image line, as the navigator's last second of smoothing, is about none of them
        late = self._lost_so_far(("late",))
        until = time.monotonic() + DRAIN_S
        quiet_since = time.monotonic()
        seen = -1
        while time.monotonic() < until and time.monotonic() - quiet_since < 2.5:
            time.sleep(0.1)
            show()
            received = sum(
                t.received for s in overview.nodes.values() for t in s.topics if not t.topic.startswith("st")
            )
            busy = any(s.queued or s.lag_s > 0.5 for n, s in overview.nodes.items() if n in self.estimators)
            if received != seen or busy:
                seen, quiet_since = received, time.monotonic()
        self._lost = late | self._lost_so_far(("gaps", "malformed", "dropped"))
        for name in (*self.estimators, "viewer", "recorder"):
            if name in group.processes:
                group.processes[name].stop(30.0)
                time.sleep(0.7)  # its last words are still on their way to the others
                show()

    @contextmanager
    def _monitor(self, port: int) -> Iterator[tuple[Any, Callable[[], set[str]]]]:
        """The monitor on the bus, in a thread; gives its overview and who is alive."""
        from ..bus import Bus
        from ..live import BusRunner, in_thread
        from ..monitor import Monitor

        monitor, living = Monitor(), set[str]()
        self._overview = monitor.overview

        def changed(node: str, is_alive: bool) -> None:
            (living.add if is_alive else living.discard)(node)

        with Bus(PLATFORM, source="monitor", port=port) as bus:
            bus.watch(changed)
            with in_thread(BusRunner(monitor, bus)):
                yield monitor.overview, lambda: set(living)

    def _say(self, text: str) -> None:
        if not self._silent:
            print(text, flush=True)

    # ---- after it

    def _evaluate(self) -> dict[str, Any]:
        from .analyze import write_report

        recordings = sorted(self.folder.glob("flight*.mcap"), key=lambda path: path.stat().st_mtime)
        if not recordings:
            raise UserError(f"no recording in {self.folder}; see {self.folder / 'log' / 'recorder.log'}")
        self.recording = max(recordings, key=lambda path: path.stat().st_size)
        self._say("evaluating the recording")
        report = self.folder / "report.html"
        result = write_report(self.recording, report)
        result.update(
            report=str(report), recordings=[str(path) for path in recordings], restarts=self.restarts,
            landed_early=self.stop.is_set(), viewer=self.viewer_mode, images=not self.args.no_images,
            lost=self._lost, waited_s=self._waited_s(),
        )  # fmt: skip
        return result

    def _lost_so_far(self, kinds: tuple[str, ...]) -> dict[str, int]:
        """What the nodes lost on the way, by kind; the viewer may."""
        sums: dict[str, int] = {}
        for name, status in self._overview.nodes.items():
            for topic in status.topics if name != "viewer" else ():
                for kind in kinds:
                    if getattr(topic, kind):
                        sums[f"{name}: {topic.topic} {kind}"] = getattr(topic, kind)
        return sums

    def _waited_s(self) -> float:
        """For how long the flight had to wait for nodes that were behind."""
        status = self._overview.nodes.get("simulator")
        counted = {} if status is None else {c.name: c.value for c in status.counters}
        return counted.get("ms waited for slow nodes", 0) / 1e3

    def summary(self, result: dict[str, Any]) -> str:
        """What a person wants to know at the end."""
        from ..report.accuracy_table import accuracy_lines

        lines = ["", *accuracy_lines(result)]
        lines += [f"missing: {text}" for text in result.get("missing", [])]
        lines += [f"damaged recording: {text}" for text in result["damage"]]
        if result["waited_s"]:
            lines.append(
                f"this machine is slow: the flight waited {result['waited_s']:.1f} s for nodes that were behind"
            )
        if result["lost"]:
            lines.append("lost or late: " + ", ".join(f"{what} {n}" for what, n in result["lost"].items()))
        if self.restarts:
            lines.append(f"{self.restarts} nodes were started again")
        lines += ["", f"recording  {self.recording}", f"report     {result['report']}"]
        if self.viewer_mode.startswith("rrd:"):
            lines.append(
                f"scene      {self.viewer_mode[4:]}   (no display: open it with `triline view {self.recording}`)"
            )
        lines += [
            f"replay it  triline replay {self.recording}",
            f"again      triline process {self.recording} -o {self.folder / 'processed.mcap'} "
            f"--nodes {','.join(self.estimators)}",
        ]
        return "\n".join(lines)


@contextmanager
def _interruptible(stop: threading.Event) -> Iterator[None]:
    """Ctrl-C, SIGTERM and a terminal that is closed land the flight instead of breaking off."""
    numbers = [signal.SIGINT, signal.SIGTERM, *([signal.SIGHUP] if hasattr(signal, "SIGHUP") else [])]
    previous = {number: signal.signal(number, lambda *_: stop.set()) for number in numbers}
    try:
        yield
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


def _seconds(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 10.0 <= value <= 7200.0:
        raise argparse.ArgumentTypeError(f"{text!r}, wanted 10 to 7200 seconds")
    return value


def _free_port() -> int:
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        return s.getsockname()[1]
