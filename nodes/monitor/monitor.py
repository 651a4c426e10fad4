"""The monitor: what all nodes say of themselves, on one screen."""

from __future__ import annotations

import sys
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from ...schemas import messages as m
from ...schemas.topics import may_be_dropped
from ...solver.window.quality.determinability import ESTIMATED
from .. import convert
from ..config import build
from ..node import STOPPING, Message, Node
from ..terminal import drawing, plain, redraws

if TYPE_CHECKING:
    from ..bus.program import ProgramOptions
    from .sensor_watch import SensorWatch

#: Counters of a topic that are zero on a good day.
LOSSES: tuple[str, ...] = ("gaps", "duplicates", "late", "malformed", "dropped")
#: Nodes that are shown, and characters of a name and of a state or event; others would fill the screen at will.
MOST_NODES, LONGEST_NAME, LONGEST_TEXT = 40, 24, 200
#: Alarms on the screen, at most.
MOST_ALARMS = 6
#: A node is silent that has said nothing of itself while another one has so often (twice a second).
SILENT = 20
#: Whose silence is an alarm: without them a flight is not what it seems. Sensors and onlookers may come and go.
WATCHED = ("navigator", "matcher", "adjuster", "rectifier", "recorder")
#: Said while nodes are stopped along the flow of data.
ENDING = "ending: nodes finish what they have"

#: Messages by topic and by what became of them.
TopicSums = Counter[tuple[str, str]]


def topic_sums(status: Any) -> TopicSums:
    """Of a node how many messages it was given, could not use, and was given twice."""
    kinds = ("received", "refused", "duplicates")
    return Counter({(row.topic, kind): getattr(row, kind) for row in status.topics for kind in kinds})


@dataclass
class Overview:
    """What is known of a running system; the newest values seen."""

    nodes: dict[str, Any] = field(default_factory=dict)  # node -> NodeStatus
    report: Any = None  # newest AdjustmentReport
    parameters: Any = ()  # of the newest report that has any
    updates: int = 0
    rejected: int = 0
    final_until_ns: int = 0
    events: deque[tuple[int, str, str]] = field(default_factory=lambda: deque(maxlen=5))  # stamp, level, text
    earlier: dict[str, TopicSums] = field(default_factory=dict)  # of nodes before they were started again
    said: Counter[str] = field(default_factory=Counter)  # how often each node has told its status
    said_then: dict[str, Counter[str]] = field(default_factory=dict)  # the same when a node told its own last
    ending: bool = False  # nodes are being stopped on purpose: that they fall silent is no alarm
    silent: int = SILENT  # a node is that has said nothing while another one has so often

    @property
    def estimated(self) -> int:
        """Number of parameters that the network sees by now."""
        return sum(p.status == ESTIMATED for p in self.parameters)

    def not_yet(self, most: int) -> str:
        """Parameters that the network does not see yet, each with what it goes with: the strongest first."""
        rest = sorted((p for p in self.parameters if p.status != ESTIMATED), key=lambda p: -abs(p.correlation))
        told = [f"{p.name} ({p.correlation:+.2f} {p.partner})" if p.partner else p.name for p in rest[:most]]
        return ", ".join(told) + (f", {len(rest) - most} more" if len(rest) > most else "")

    def topic_rates(self) -> dict[str, float]:
        """Messages a second of every topic, as the node that receives most of it counts them."""
        rates: dict[str, float] = {}
        for status in self.nodes.values():
            for topic in status.topics:
                rates[topic.topic] = max(rates.get(topic.topic, 0.0), topic.rate_hz)
        return rates

    def losses(self) -> dict[str, int]:
        """Sums over all nodes of what should be zero on a good day."""
        each = [losses_of(status) for status in self.nodes.values()]
        return {kind: sum(of[kind] for of in each) for kind in LOSSES}

    def take_status(self, name: str, status: Any) -> None:
        """The newest status of a node."""
        before = self.nodes.get(name)
        if before is not None and status.uptime_s < before.uptime_s:
            self.earlier[name] = self.earlier.get(name, Counter()) + topic_sums(before)
        self.nodes[name] = status
        self.said[name] += 1
        self.said_then[name] = self.said.copy()

    def is_silent(self, name: str) -> bool:
        """Whether a node has fallen silent that was not stopped: what it said last holds no longer."""
        then, status = self.said_then.get(name), self.nodes.get(name)
        if then is None or status is None or status.state == STOPPING:
            return False
        return any(n - then[other] >= self.silent for other, n in self.said.items())

    def alarms(self) -> list[str]:
        """What nodes want an operator to look at, each once, and which have fallen silent; not those that are being
        stopped."""
        if self.ending:
            return []
        silent = [name for name in WATCHED if self.is_silent(name)]
        told = [f"{plain(name, LONGEST_NAME)} is silent: it stands still, has died, or is cut off" for name in silent]
        running = [s for name, s in self.nodes.items() if s.state != STOPPING and not self.is_silent(name)]
        return list(dict.fromkeys([*told, *(plain(s.alarm, LONGEST_TEXT) for s in running if s.alarm)]))

    def state_of(self, name: str) -> str:
        """What a node says of itself, or that it has fallen silent."""
        state = self.nodes[name].state
        return f"silent, last known: {state}" if self.is_silent(name) else state

    def _light(self, name: str) -> dict[str, str]:
        s = self.nodes[name]
        if s.light and self.is_silent(name):
            return {"light": "unknown", "reason": f"silent; last known: {s.light}"}
        return {"light": s.light, "reason": s.light_reason}

    def as_json(self) -> dict[str, Any]:
        """For programs: state, light and troubles of each node, rates of topics, figures of the newest report."""
        nodes = {
            name: {
                "state": self.state_of(name), "lag_s": s.lag_s, "queued": s.queued, **self._light(name),
                "alarm": s.alarm, "last_problem": s.last_problem, "counters": {c.name: c.value for c in s.counters},
                "last_problems": {c.name: c.last_problem for c in s.counters if c.last_problem},
                **losses_of(s),
            }
            for name, s in sorted(self.nodes.items())
        }  # fmt: skip
        r = self.report
        report = None if r is None else {
            "updates": self.updates, "sigma0": r.sigma0 if r.redundancy > 0 else None, "redundancy": r.redundancy,
            "window_s": _window_s(r), "rays": r.rays, "points": r.points, "control": r.control,
            "rejected": self.rejected, "update_ms": 1e3 * r.compute_s,
        }  # fmt: skip
        rates = {topic: rate for topic, rate in sorted(self.topic_rates().items()) if rate > 0}
        return {"nodes": nodes, "rates_hz": rates, "alarms": self.alarms(), "losses": self.losses(), "report": report}

    def line(self) -> str:
        """One line for logs and terminals that cannot be redrawn."""
        parts = [ENDING] if self.ending else []
        parts.append(f"{len(self.nodes)} nodes")
        if self.report is not None:
            r = self.report
            parts += [
                f"sigma0 {r.sigma0:.2f}" if r.redundancy > 0 else "sigma0 -",
                f"window {_window_s(r):.0f} s",
                f"{r.rays} rays",
                f"{r.points} points",
                f"{self.rejected} rejected",
                f"update {1e3 * r.compute_s:.0f} ms",
            ]
        lag = max((status.lag_s for status in self.nodes.values()), default=0.0)
        if self.parameters:
            parts.append(f"{self.estimated} of {len(self.parameters)} parameters estimated")
        parts.append(f"lag {lag:.2f} s")
        parts += [
            text for text in (s.state.removeprefix("flying at ") for s in self.nodes.values()) if "real time" in text
        ]
        parts += [f"ALARM: {text}" for text in self.alarms()]
        lost = {kind: n for kind, n in self.losses().items() if n}
        if lost:
            parts.append(", ".join(_counted(n, kind) for kind, n in lost.items()))
        return plain(" | ".join(parts))


class Monitor(Node):
    """Collects status, reports and events into an `Overview`; publishes nothing."""

    name = "monitor"
    inputs = ("status/*", "adjustment/report", "event/log")
    outputs = ()
    onlooker = True

    def __init__(self) -> None:
        super().__init__()
        self.overview = Overview()

    def step(self, message: Message) -> Iterable[Message]:
        view, body = self.overview, message.body
        if message.topic.startswith("status/"):
            name = message.topic.partition("/")[2]
            if name in view.nodes or len(view.nodes) < MOST_NODES:
                view.take_status(name, body)
            else:
                self.problem("too many nodes", f"status of a node {plain(name, LONGEST_NAME)} is not shown")
        elif message.topic == "adjustment/report":
            view.report = body
            view.parameters = body.parameters or view.parameters
            view.updates += 1
            view.rejected = body.rejected_total - body.returned_total  # as the report of the flight counts them
            view.final_until_ns = max(view.final_until_ns, body.window_start_ns)
        elif message.topic == "event/log":
            level = convert.enum_name(m.Log.Level, body.level)
            view.events.append((message.stamp_ns, level, plain(f"{body.name}: {body.message}", LONGEST_TEXT)))
        return ()


def screen(overview: Overview, title: str, watch: SensorWatch | None = None) -> Any:
    """The overview as one rich renderable, at most 80 columns; by 24 lines without sensors that are watched."""
    from rich.console import Group
    from rich.panel import Panel
    from rich.table import Table
    from rich.text import Text

    nodes = Table(box=None, pad_edge=False, expand=True)
    for name, justify in (
        ("node", "left"),
        ("state", "left"),
        ("lag", "right"),
        ("queue", "right"),
        ("problems", "left"),
    ):
        room = 1 if name == "state" else None  # gives way where the terminal is narrow
        nodes.add_column(name, justify=justify, no_wrap=True, ratio=room)
    for name in sorted(overview.nodes):
        s = overview.nodes[name]
        text = ", ".join(_counted(n, kind) for kind, n in losses_of(s).items() if n)
        nodes.add_row(
            Text(plain(name, LONGEST_NAME)), Text(plain(overview.state_of(name), LONGEST_TEXT)), f"{s.lag_s:.2f} s",
            str(s.queued), Text(text or "-", style="yellow" if text else "dim"),
        )  # fmt: skip

    rates = "   ".join(
        f"{t} {r:.0f}/s"
        for t, r in sorted(overview.topic_rates().items())
        if r >= 0.5 and "status" not in t and not (watch is not None and t.startswith("sensor/"))
    )
    lines: list[Any] = [nodes, Text(plain(rates, 8 * LONGEST_TEXT), style="dim")]
    if watch is not None:
        lines = [_sensor_table(watch), Text(), *lines]
    if overview.report is not None:
        r = overview.report
        good = r.redundancy <= 0 or 0.8 <= r.sigma0 <= 1.25
        lines.append(
            Text.assemble(
                "sigma0 ",
                (f"{r.sigma0:.3f}" if r.redundancy > 0 else "-", "green" if good else "bold red"),
                f"   window {_window_s(r):.1f} s, {r.rays} rays, {r.points} points, {r.control} control",
                f"   rejected {overview.rejected}   update {1e3 * r.compute_s:.0f} ms",
            )
        )
    if overview.parameters:
        text = f"parameters: {overview.estimated} of {len(overview.parameters)} estimated"
        rest = overview.not_yet(3)
        text += f"; not yet {plain(rest, LONGEST_TEXT)}" if rest else ""
        lines.append(Text(text, no_wrap=True, overflow="ellipsis"))
    if overview.ending:
        lines.append(Text(ENDING, style="bold"))
    lines += [Text(text, style="bold red") for text in overview.alarms()[:MOST_ALARMS]]
    lines += [Text(text, style="red" if level in ("error", "fatal") else "dim") for _, level, text in overview.events]
    return Panel(Group(*lines), title=Text(plain(title)), title_align="left")


def _sensor_table(watch: SensorWatch) -> Any:
    """What comes in at what rate, what is missing, and what sensor programs said last."""
    from rich.console import Group
    from rich.table import Table
    from rich.text import Text

    table = Table(box=None, pad_edge=False, expand=True)
    for name, justify in (("sensor", "left"), ("rate", "right"), ("messages", "right"), ("", "left")):
        room = None if name else 1
        table.add_column(name, justify=justify, no_wrap=True, ratio=room)
    for row in watch.rows():
        style = {"comes in": "green", "stopped": "bold red"}.get(row.state, "yellow")
        rate = f"{row.rate_hz:.1f}/s" if row.state == "comes in" else "-"
        name = Text(plain(row.name, LONGEST_NAME))
        table.add_row(name, rate, str(row.received), Text(plain(row.words, LONGEST_TEXT), style=style))
    said = [Text(plain(text, LONGEST_TEXT), style="yellow", no_wrap=True, overflow="ellipsis") for text in watch.said]
    return Group(table, *([Text(watch.phase, style="bold")] if watch.phase else []), *said)


def _window_s(report: Any) -> float:
    """Length of the window in seconds; 0 while there are no rays in it."""
    return (report.window_end_ns - report.window_start_ns) / convert.SECOND_NS if report.rays else 0.0


@contextmanager
def display(
    overview: Overview, title: str, quiet: bool = False, watch: SensorWatch | None = None
) -> Iterator[Callable[[], None]]:
    """Gives a function that shows the overview: one screen on a terminal, a line every 5 s elsewhere.

    Sensors that are watched are shown as well; without a screen a line tells at once when one begins or stops.
    """

    def look() -> list[str]:
        return [] if watch is None else watch.look(overview.nodes, ending=overview.ending)

    if quiet:
        yield lambda: (look(), None)[1]
    elif redraws(sys.stdout):
        from rich.console import Console
        from rich.live import Live

        console = Console(file=drawing(sys.stdout))
        with Live(screen(overview, title, watch), console=console, refresh_per_second=4) as live:

            def draw() -> None:
                look()
                live.update(screen(overview, title, watch))

            yield draw
    else:
        begun = last = time.monotonic()

        def line() -> None:
            nonlocal last
            now = time.monotonic()
            told = [f"{now - begun:4.0f} s  {text}\n" for text in look()]
            if now - last >= 5.0:
                last = now
                told += [f"{now - begun:4.0f} s  {watch.line()}\n"] if watch is not None else []
                told.append(f"{now - begun:4.0f} s  {overview.line()}\n")
            if told:
                sys.stdout.write("".join(told))
                sys.stdout.flush()

        yield line


def run(options: ProgramOptions) -> int:
    """Watch a platform until told to stop: what `triline node monitor` calls, by the name in `nodes.registry`."""
    watch_platform(options)
    return 0


def watch_platform(options: ProgramOptions, quiet: bool = False) -> Overview:
    """Watch a platform until told to stop; returns what is known in the end. Shows nothing meanwhile if ``quiet``."""
    from ..bus.live import BusRunner, in_thread

    monitor = build(Monitor, options.tables)
    title = f"platform {options.platform}"
    with options.open_bus() as bus, in_thread(BusRunner(monitor, bus)), display(monitor.overview, title, quiet) as show:
        while not options.stop.wait(0.25):
            show()
    if not quiet and not redraws(sys.stdout):
        sys.stdout.write(f"{monitor.overview.line()}\n")
        sys.stdout.flush()
    return monitor.overview


def losses_of(status: Any) -> dict[str, int]:
    """What a node lost, by kind; not a status that was dropped on the way, since a newer one followed."""
    return {
        kind: sum(getattr(t, kind) for t in status.topics if kind != "gaps" or not may_be_dropped(t.topic))
        for kind in LOSSES
    }


def _counted(n: int, kind: str) -> str:
    """One gap, two gaps."""
    return f"{n} {kind.removesuffix('s') if n == 1 else kind}"
