"""A live flight: nodes as processes on the bus, watched, started again, stopped in order. `demo` and `fly` share it."""

from __future__ import annotations

import argparse
import json
import os
import shlex
import signal
import socket
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ...schemas.topics import TOPICS, may_be_dropped
from ..bus.folder_lock import locked
from ..bus.processes import NodeGroup, NodeProcess
from ..bus.program import end_by_signal, ending_signals
from ..errors import UserError
from ..formats.new_file import refuse_unless_folder
from ..last_problems import last_of
from ..monitor.monitor import ENDING, display
from ..step_driver import failure_words
from ..terminal import plain, whoever_reads

if TYPE_CHECKING:
    from ..bus.bundle import Bundle, ExpiryWatch
    from ..bus.session import Bus
    from ..monitor.monitor import Overview
    from ..monitor.sensor_watch import SensorWatch

#: Nodes between sensors and orthoimages, in the order in which they are stopped.
ESTIMATORS = ("navigator", "matcher", "adjuster", "rectifier")
#: What tells only how far its publisher is: nothing is lost with one of them.
ORDER_ONLY = frozenset(row.name for row in TOPICS if row.order_only)
#: Longest wait until all nodes are there, s; one that has ended is told at once.
READY_S = 60.0
#: Longest wait after the flight until every node has processed all its messages.
DRAIN_S = 15.0
#: For so long the last messages of a node may be on their way to the others, s.
ON_THE_WAY_S = 0.7
#: A node that is stopped may work for so long on what it has held back, s.
LAST_WORK_S = 45.0
#: A sensor program that has ended by itself is started again after so long, s; twice as long each time, up to a minute.
SENSOR_AGAIN_S, SENSOR_AGAIN_MOST_S = 3.0, 60.0


class LiveFlight:
    """The processes of a flight, from start to results. A command says what its sensors are.

    Parameters
    ----------
    args : of the command: output, port, headless, web, quiet, json
    platform : name on the bus
    title : of the screen
    estimators : nodes between sensors and results, in the order in which they are stopped
    """

    def __init__(self, args: argparse.Namespace, platform: str, title: str, estimators: tuple[str, ...]) -> None:
        self.args, self.platform, self.title, self.estimators = args, platform, title, estimators
        self.secure: Bundle | None = None
        self.expiry: ExpiryWatch | None = None
        if args.secure is not None:
            from ..bus.bundle import ExpiryWatch, load_bundle

            self.secure = load_bundle(args.secure)
            self.expiry = ExpiryWatch(self.secure)
            if self.secure.kind != "aircraft":
                raise UserError(f"--secure {args.secure}: is of a desk, wanted the bundle of an aircraft")
        self.folder: Path = args.output
        self.recording = self.folder / "flight.mcap"
        self.stop = threading.Event()
        self._restarted: Counter[str] = Counter()  # by node, how often it was started again
        self._killed: dict[str, str] = {}  # nodes that did not end by themselves, and what killed them
        self._not_recorded = (0, "")  # how many messages, and why
        self.watch: SensorWatch | None = None
        self._lost: dict[str, int] = {}
        self._failed: dict[str, str] = {}  # by node, of which part of the work failed
        self._again: dict[str, float] = {}  # sensor programs that have ended, and when they are started again
        self._ended: Counter[str] = Counter()  # how often they have
        self.viewer_mode = self._viewer_mode()
        self._silent = args.quiet or args.json

    # ---- what a command says

    def node_arguments(self, name: str) -> tuple[str, ...]:
        """Arguments of ``triline node`` for a node."""
        return ()

    def start_sensors(self, group: NodeGroup) -> None:
        """Start the programs that make data."""
        raise TypeError(f"{type(self).__name__} does not define start_sensors")

    def ready_line(self) -> str:
        """Said when all nodes are there; "" for nothing."""
        return ""

    def sensor_ids(self) -> tuple[str, ...]:
        """The processes that `start_sensors` started."""
        raise TypeError(f"{type(self).__name__} does not define sensor_ids")

    def start_sensor(self, group: NodeGroup, id: str) -> None:
        """Start one of them that has ended by itself again; only where `sensors_go_on`."""

    def tend(self, bus: Bus) -> None:
        """Called again and again in flight."""

    def over(self, group: NodeGroup) -> bool:
        """Whether the flight has ended by itself."""
        raise TypeError(f"{type(self).__name__} does not define over")

    def drain_s(self) -> float:
        """For how long to wait at the end until all messages have been processed, s."""
        return DRAIN_S

    #: Whether a sensor program that ends is started again; else its end is that of the flight.
    sensors_go_on = False

    # ---- the flight

    def fly(self) -> dict[str, Any]:
        """Run the flight; returns the evaluation of its recording. Nobody else writes into its folder meanwhile."""
        refuse_unless_folder(self.folder)
        with locked(self.folder), whoever_reads():
            return self._fly()

    def _fly(self) -> dict[str, Any]:
        self.clear()
        port = self.port()
        bus_file: Path | None = getattr(self.args, "bus", None)
        if bus_file is not None and self.secure is not None:
            raise UserError("--bus and --secure: wanted one of them, a bundle has its own Zenoh configuration")
        logs = self.folder / "log"
        with NodeGroup(logs, self.platform, port, bus_file, self.args.secure) as group, _interruptible(self.stop):
            where = f"127.0.0.1:{port}" if bus_file is None else str(bus_file)
            self.say(f"bus on {where}; logs in {group.log_folder}; Ctrl-C ends the flight")
            if self.expiry is not None and (ends := self.expiry.look()):
                self.say(f"note: {ends}")
            group.start("recorder", "-o", str(self.recording))
            for name in self.estimators:
                group.start(name, *self.node_arguments(name))
            if self.viewer_mode:
                group.start("viewer", "--set", f"mode={json.dumps(self.viewer_mode)}")
            with self._monitor(port) as (bus, overview, alive):
                self._wait_ready(group, alive)
                self._tell_web_address(group)
                if ready := self.ready_line():
                    self.say(ready)
                self.start_sensors(group)
                with display(overview, self.title, quiet=self._silent, watch=self.watch) as show:
                    self._watch(group, bus, show)
                    self._land(group, overview, show)
            self.landed(group)
        return self._evaluate()

    def port(self) -> int:
        """Where the nodes meet."""
        return self.args.port or free_port()

    def clear(self) -> None:
        """Make the folder of results ready."""
        self.folder.mkdir(parents=True, exist_ok=True)

    def landed(self, group: NodeGroup) -> None:
        """Called when all processes have ended; may raise UserError."""

    def _viewer_mode(self) -> str:
        """Setting of the viewer, "" for none."""
        if getattr(self.args, "no_viewer", False):
            return ""
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
                if dead.name == "viewer":  # it also works without a viewer
                    self.say(f"no viewer: {dead.last_line()}")
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
            self.say(f"scene at {address}" if address else f"no address of the scene; see {group.log_folder}")

    # ---- in flight

    def _watch(self, group: NodeGroup, bus: Bus, show: Callable[[], None]) -> None:
        """Wait until the flight has ended; a node that dies is started again."""
        while not self.over(group) and not self.stop.wait(0.25):
            self.tend(bus)
            self._tell_expiry()
            show()
            for dead in group.dead():
                if dead.name in self.sensor_ids():
                    if self.sensors_go_on:
                        self._sensor_ended(dead)
                        del group.processes[dead.name]
                    continue
                if dead.name == "viewer":
                    if self.viewer_mode != "native":  # else the user closed its window
                        self._tell(f"viewer has ended: {dead.last_line()}; nothing more comes into the scene")
                    del group.processes["viewer"]
                    continue
                self._restarted[dead.name] += 1
                self._tell(f"{dead.name} has ended: {dead.last_line()}; it is started again")
                recorder = dead.name == "recorder"
                group.start(
                    dead.name, *(("-o", str(self._next_recording())) if recorder else self.node_arguments(dead.name))
                )
            for id in [id for id, due_s in self._again.items() if time.monotonic() >= due_s]:
                del self._again[id]
                self.start_sensor(group, id)
        for id in self.sensor_ids():
            if id in group.processes:
                group.processes[id].stop()

    def _tell(self, text: str) -> None:
        """Say what has happened in flight."""
        if self.watch is not None:
            self.watch.tell(text)
        else:
            self.say(plain(text))

    def _tell_expiry(self) -> None:
        """On the screen, where it comes nearer that the certificate expires, and when it has."""
        if self.expiry is not None and self.watch is not None and (ends := self.expiry.look()):
            self.watch.tell(ends)

    def _sensor_ended(self, dead: NodeProcess) -> None:
        after_s = min(SENSOR_AGAIN_S * 2 ** self._ended[dead.name], SENSOR_AGAIN_MOST_S)
        self._ended[dead.name] += 1
        self._again[dead.name] = time.monotonic() + after_s
        if self.watch is not None:
            self.watch.tell(f"{dead.name} has ended: {dead.last_line()}; again in {after_s:.0f} s")

    def _next_recording(self) -> Path:
        return self.folder / f"flight-{len(list(self.folder.glob('flight*.mcap'))) + 1}.mcap"

    def _land(self, group: NodeGroup, overview: Overview, show: Callable[[], None]) -> None:
        """Stop the nodes along the data flow, the recorder last, each when it has worked off what has come to it.

        What a node holds back for its order, until others go on or have been silent for long, it works off when it is
        stopped: those that it waits for have ended by then.
        """
        overview.ending = True
        self.say(ENDING)
        show()
        # messages long after the last image line, as the navigator's last second of smoothing, concern no image line
        late = self._lost_so_far(("late",))
        until = time.monotonic() + self.drain_s()
        for name in (*self.estimators, "viewer", "recorder"):
            if name in group.processes:
                node = group.processes[name]
                self._wait_until_worked_off(node, overview, show, until)
                if overview.is_silent(name):
                    self.say(f"{name} is silent: it has {LAST_WORK_S:.0f} s to end")
                if node.stop(LAST_WORK_S, self.folder if name == "recorder" else None) < 0:
                    self._killed[name] = node.last_line()
        show()
        self._lost = late | self._lost_so_far(("gaps", "malformed", "dropped"))
        self._failed = failed_nodes(overview.nodes)
        self._not_recorded = not_recorded(overview.nodes.get("recorder"))

    @staticmethod
    def _wait_until_worked_off(node: NodeProcess, overview: Overview, show: Callable[[], None], until: float) -> None:
        """Return when two statuses in a row tell of no message received or worked off between them.

        At ``until`` (of `time.monotonic`) it returns all the same, but leaves those before it in the data flow
        `ON_THE_WAY_S` for their last messages.
        """
        until = max(until, time.monotonic() + ON_THE_WAY_S)
        said, still, received, queued = overview.said[node.name], False, -1, 0
        while node.running and not still and time.monotonic() < until:
            time.sleep(0.1)
            show()
            if overview.said[node.name] > said:
                said, status = overview.said[node.name], overview.nodes[node.name]
                before, received = received, sum(t.received for t in status.topics if not t.topic.startswith("status/"))
                still = received == before and status.queued >= queued
                queued = status.queued

    @contextmanager
    def _monitor(self, port: int) -> Iterator[tuple[Bus, Any, Callable[[], set[str]]]]:
        """Run the monitor on the bus in a thread; yields the bus, its overview and the nodes that are alive."""
        from ..bus.live import BusRunner, in_thread
        from ..bus.session import Bus
        from ..monitor.monitor import Monitor

        monitor, living = Monitor(), set[str]()
        self._overview = monitor.overview

        def changed(node: str, is_alive: bool) -> None:
            (living.add if is_alive else living.discard)(node)

        bus_file: Path | None = getattr(self.args, "bus", None)
        with Bus(self.platform, source="monitor", port=port, file=bus_file, secure=self.secure) as bus:
            bus.watch(changed)
            self.joined(bus)
            with in_thread(BusRunner(monitor, bus)):
                yield bus, monitor.overview, lambda: set(living)

    def joined(self, bus: Bus) -> None:
        """Called when this program is on the bus, before it looks for nodes."""

    def say(self, text: str) -> None:
        """A line for a person."""
        if not self._silent:
            print(text, flush=True)

    # ---- after it

    def _evaluate(self) -> dict[str, Any]:
        recordings = sorted(self.folder.glob("flight*.mcap"), key=lambda path: path.stat().st_mtime)
        if not recordings:
            raise UserError(f"no recording in {self.folder}; see {self.folder / 'log' / 'recorder.log'}")
        self.recording = max(recordings, key=lambda path: path.stat().st_size)
        result: dict[str, Any] = {}
        if not getattr(self.args, "no_report", False):
            try:
                result = self._report()
            except (UserError, OSError) as error:  # a full disk, for one: what was recorded is said all the same
                result = {"no_report": str(error)}
        result.update(
            recordings=[str(path) for path in recordings], restarts=self._restarted.total(),
            restarted=dict(self._restarted), not_recorded=self._not_recorded[0], killed=self._killed,
            landed_early=self.stop.is_set(), viewer=self.viewer_mode, lost=self._lost, failed=self._failed,
        )  # fmt: skip
        return result

    def _report(self) -> dict[str, Any]:
        from .analyze import write_report

        self.say("evaluating the recording")
        report = self.folder / "report.html"
        return {**write_report(self.recording, report), "report": str(report)}

    def _lost_so_far(self, kinds: tuple[str, ...]) -> dict[str, int]:
        """Messages that nodes lost, by kind; not those of the viewer, nor what a newer message has said as well."""
        sums: dict[str, int] = {}
        for name, status in self._overview.nodes.items():
            for topic in status.topics if name != "viewer" else ():
                for kind in kinds:
                    if getattr(topic, kind) and not (may_be_dropped(topic.topic) or topic.topic in ORDER_ONLY):
                        sums[f"{name}: {topic.topic} {kind}"] = getattr(topic, kind)
            refused = sum(c.value for c in status.counters if c.name == "malformed" and name in self.estimators)
            if "malformed" in kinds and refused:  # what it could read, and could not use, among them
                sums[f"{name}: malformed"] = refused
        return sums

    def summary(self, result: dict[str, Any]) -> str:
        """The lines that are printed at the end."""
        from ..recording.summary import OF_RECORDING
        from ..report.accuracy_table import accuracy_lines

        lines = ["", *(accuracy_lines(result) if "report" in result else [])]
        lines += [f"missing: {text}" for text in result.get("missing", [])]
        lines += [f"{OF_RECORDING}{text}" for text in result.get("damage", [])]
        lines += result.get("not_used", [])
        lines += [f"no report: {result['no_report']}"] if "no_report" in result else []
        lines += self.remarks(result)
        if result["lost"]:
            lines.append("lost or late: " + ", ".join(f"{what} {n}" for what, n in result["lost"].items()))
        lines += [f"{name}: {text} (see {self.folder / 'log'})" for name, text in result.get("failed", {}).items()]
        if result.get("not_recorded"):
            lines.append(f"NOT RECORDED: {result['not_recorded']} messages: {self._not_recorded[1]}")
        for name, text in result.get("killed", {}).items():
            lines.append(f"{name} did not end by itself, and was {text}: what it held back is missing")
        if restarted := result.get("restarted"):
            often = (f"{name} {n} times" if n > 1 else name for name, n in restarted.items())
            lines.append(f"had ended, and started again: {', '.join(often)}")
        parts = result["recordings"]
        if others := [path for path in parts if path != str(self.recording)]:
            lines.append(
                f"this page is of the largest recording alone; another part of the flight: {', '.join(others)}"
            )
        lines += ["", f"recording  {self.recording}"]
        lines += [f"report     {result['report']}"] if "report" in result else []
        recording, processed = shlex.quote(str(self.recording)), shlex.quote(str(self.folder / "processed.mcap"))
        if self.viewer_mode.startswith("rrd:"):
            lines.append(f"scene      {self.viewer_mode[4:]}   (no display: open it with `triline view {recording}`)")
        if others:
            whole = shlex.quote(str(self.folder / "whole.mcap"))
            lines.append(f"join them  triline recover {shlex.join(parts)} -o {whole}")
        lines += [
            f"replay it  triline replay {recording}",
            f"again      triline process {recording} -o {processed} --nodes {','.join(self.estimators)}"
            f"{self.settings_again()}",
        ]
        return "\n".join(lines)

    def remarks(self, result: dict[str, Any]) -> list[str]:
        """Lines of the summary that only this kind of flight has."""
        return []

    def settings_again(self) -> str:
        """Arguments of `process` that give the nodes the settings that they had in flight."""
        return ""


def add_view_arguments(parser: argparse.ArgumentParser) -> None:
    """``--headless``, ``--web`` and ``--secure``."""
    parser.add_argument("--headless", action="store_true", help="no window; the scene goes to a .rrd file instead")
    parser.add_argument("--web", action="store_true", help="show the scene in a browser (loopback only)")
    parser.add_argument("--secure", type=Path, metavar="BUNDLE", help="of the aircraft, by `triline keys`: encrypted")


def failed_nodes(statuses: Mapping[str, Any]) -> dict[str, str]:
    """By node, how often its work failed, by the newest status of each: what it would have given is missing."""
    failed = {}
    for name, status in statuses.items():
        for counter in status.counters:
            if counter.name == "failed" and counter.value:
                failed[name] = failure_words(counter.value, f"its last problem: {last_of(status, counter)}")
    return failed


def not_recorded(status: Any) -> tuple[int, str]:
    """How many messages the recorder lost, by its newest status (or None), and what it said of its disk."""
    counters = {} if status is None else {counter.name: counter for counter in status.counters}
    if "lost" not in counters:
        return 0, ""
    return counters["lost"].value, last_of(status, counters["disk"] if "disk" in counters else counters["lost"])


@contextmanager
def _interruptible(stop: threading.Event) -> Iterator[None]:
    """Make Ctrl-C, SIGTERM and a closed terminal end the flight in good order."""
    handle = end_by_signal(stop)
    previous = {number: signal.signal(number, handle) for number in ending_signals()}
    try:
        yield
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


def free_port() -> int:
    """A port of loopback that nobody listens on."""
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        return s.getsockname()[1]


def seconds_between(least: float, most: float) -> Callable[[str], float]:
    """What argparse takes for a time in seconds within these bounds."""

    def seconds(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = float("nan")
        if not least <= value <= most:
            raise argparse.ArgumentTypeError(f"{text!r}, wanted {least:g} to {most:g} seconds")
        return value

    return seconds
