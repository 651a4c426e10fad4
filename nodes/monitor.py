"""The monitor: what all nodes say of themselves, on one screen."""

from __future__ import annotations

import sys
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from ..schemas import messages as m
from ..solver.window.determinability import ESTIMATED
from . import convert
from .config import build
from .node import Message, Node

if TYPE_CHECKING:
    from .program import ProgramOptions

#: Counters of a topic that are zero on a good day.
LOSSES: tuple[str, ...] = ("gaps", "duplicates", "late", "malformed", "dropped")


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
        sums: dict[str, int] = dict.fromkeys(LOSSES, 0)
        for status in self.nodes.values():
            for topic in status.topics:
                for kind in sums:
                    sums[kind] += getattr(topic, kind)
        return sums

    def line(self) -> str:
        """One line for logs and terminals that cannot be redrawn."""
        parts = [f"{len(self.nodes)} nodes"]
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
        lost = {kind: n for kind, n in self.losses().items() if n}
        if lost:
            parts.append(", ".join(f"{n} {kind}" for kind, n in lost.items()))
        return " | ".join(parts)


class Monitor(Node):
    """Collects status, reports and events into an `Overview`; publishes nothing."""

    name = "monitor"
    inputs = ("status/*", "adjustment/report", "event/log")
    outputs = ()

    def __init__(self) -> None:
        super().__init__()
        self.overview = Overview()

    def step(self, message: Message) -> Iterable[Message]:
        view, body = self.overview, message.body
        if message.topic.startswith("status/"):
            view.nodes[body.node] = body
        elif message.topic == "adjustment/report":
            view.report = body
            view.parameters = body.parameters or view.parameters
            view.updates += 1
            view.rejected = max(view.rejected, body.rejected_total)
            view.final_until_ns = max(view.final_until_ns, body.window_start_ns)
        elif message.topic == "event/log":
            level = m.Log.Level.Name(body.level).lower()
            view.events.append((message.stamp_ns, level, f"{body.name}: {body.message}"))
        return ()


def screen(overview: Overview, title: str) -> Any:
    """The overview as one rich renderable, at most 80 columns by 24 lines."""
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
        nodes.add_column(name, justify=justify, no_wrap=True)  # pyright: ignore[reportArgumentType]
    for name in sorted(overview.nodes):
        s = overview.nodes[name]
        bad = {k: sum(getattr(t, k) for t in s.topics) for k in LOSSES}
        text = ", ".join(f"{n} {k}" for k, n in bad.items() if n)
        nodes.add_row(
            name, s.state, f"{s.lag_s:.2f} s", str(s.queued), Text(text or "-", style="yellow" if text else "dim")
        )

    rates = "   ".join(
        f"{t} {r:.0f}/s" for t, r in sorted(overview.topic_rates().items()) if r >= 0.5 and "status" not in t
    )
    lines: list[Any] = [nodes, Text(rates, style="dim")]
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
        lines.append(Text(text + (f"; not yet {rest}" if rest else ""), no_wrap=True, overflow="ellipsis"))
    lines += [Text(text, style="red" if level in ("error", "fatal") else "dim") for _, level, text in overview.events]
    return Panel(Group(*lines), title=title, title_align="left")


def _window_s(report: Any) -> float:
    """Length of the window in seconds; 0 while there are no rays in it."""
    return (report.window_end_ns - report.window_start_ns) / convert.SECOND_NS if report.rays else 0.0


@contextmanager
def display(overview: Overview, title: str, quiet: bool = False) -> Iterator[Callable[[], None]]:
    """Gives a function that shows the overview: one screen on a terminal, a line every 5 s elsewhere."""
    if quiet:
        yield lambda: None
    elif sys.stdout.isatty():
        from rich.live import Live

        with Live(screen(overview, title), refresh_per_second=4) as live:
            yield lambda: live.update(screen(overview, title))
    else:
        begun = last = time.monotonic()

        def line() -> None:
            nonlocal last
            if time.monotonic() - last >= 5.0:
                last = time.monotonic()
                sys.stdout.write(f"{last - begun:4.0f} s  {overview.line()}\n")
                sys.stdout.flush()

        yield line


def run(options: ProgramOptions) -> int:
    """Watch a platform until told to stop."""
    from .live import BusRunner, in_thread

    monitor = build(Monitor, options.tables)
    title = f"platform {options.platform}"
    with options.open_bus() as bus, in_thread(BusRunner(monitor, bus)), display(monitor.overview, title) as show:
        while not options.stop.wait(0.25):
            show()
    return 0
