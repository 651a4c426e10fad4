"""All aircraft of a fleet on one screen: light, accuracy, lag, link, and when each was heard last."""

from __future__ import annotations

import sys
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from ...schemas import codec, topics
from ...schemas.envelope import RawMessage
from ..bus.authority import DESK_STATUSES
from ..bus.downlink import share_of
from ..bus.session import Bus
from ..node import STOPPING
from ..terminal import drawing, plain, redraws
from .monitor import LONGEST_NAME, LONGEST_TEXT, MOST_NODES, SILENT, Overview

#: What is listened to.
TOPICS = ("status/*", "adjustment/report", "event/log")
#: Aircraft that are shown; others would fill the screen at will.
MOST_AIRCRAFT = 40
#: An aircraft that has said nothing for so long, s, has no light: nobody knows it.
SILENT_S = 15.0
#: The platform under which the recorder on the ground speaks.
FLEET = "fleet"
#: Between two lines where the screen cannot be redrawn, s.
LINE_S = 5.0
#: Of every node each n-th status comes down.
_STATUS = share_of("status/navigator")
_EVERY = 1 if _STATUS is None else _STATUS.every
_COLORS = {"good": "green", "weak": "yellow", "failed": "bold red"}


@dataclass
class Aircraft:
    """What is known of an aircraft; the newest values heard.

    Attributes
    ----------
    name : its platform
    nodes : what its nodes say of themselves, and which have fallen silent
    report : newest AdjustmentReport
    linked : whether its router is linked with the ground
    heard_s : when something of it was heard last, of a steady clock; adjuster_s : the same of its adjuster's status
    """

    name: str
    nodes: Overview = field(default_factory=lambda: Overview(silent=SILENT // _EVERY))
    report: Any = None
    linked: bool = False
    heard_s: float = 0.0
    adjuster_s: float = 0.0

    @property
    def light(self) -> tuple[str, str]:
        """Light and reason of its adjuster; empty without one."""
        status = self.nodes.nodes.get("adjuster")
        return (status.light, status.light_reason) if status is not None else ("", "")

    @property
    def lag_s(self) -> float:
        """Lag of the node that is furthest behind, of those that run, s."""
        of = self.nodes
        running = [s for name, s in of.nodes.items() if s.state != STOPPING and not of.is_silent(name)]
        return max((status.lag_s for status in running), default=0.0)

    @property
    def accuracy_m(self) -> tuple[float, float] | None:
        """Worst sigma and worst protection level of the position, m; None before there is any."""
        if self.report is None or len(self.report.sigma) < 3:
            return None
        return max(self.report.sigma[:3]), max(self.report.protection[:3], default=0.0)

    @property
    def sigma0(self) -> float | None:
        """Of the newest report; None while nothing is redundant."""
        return self.report.sigma0 if self.report is not None and self.report.redundancy > 0 else None

    @property
    def alarms(self) -> list[str]:
        """What its nodes want an operator to look at, and which have fallen silent while others speak."""
        return self.nodes.alarms()


class FleetOverview:
    """What is known of a fleet; safe in several threads.

    Parameters
    ----------
    clock : steady time, s
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._lock = threading.Lock()
        self._aircraft: dict[str, Aircraft] = {}
        self._missing: dict[str, int] = {}  # by the recorder on the ground
        self.ground = ""  # what it says of itself
        self.events: deque[str] = deque(maxlen=5)

    def take(self, platform: str, raw: RawMessage) -> None:
        """A message of an aircraft; what cannot be read is passed over."""
        try:
            topics.find(raw.topic)
            body = codec.decode(raw.topic, raw.data)
        except (KeyError, ValueError):
            return
        with self._lock:
            if raw.topic == "status/ground":
                self.ground = body.state
                self._missing = {c.name.removesuffix(" missing"): c.value for c in body.counters if "missing" in c.name}
                return
            if raw.topic in DESK_STATUSES:  # a desk that looks at an aircraft, or at none, is not the aircraft
                return
            aircraft = self._of(platform)
            if aircraft is None:
                return
            aircraft.heard_s = self._clock()
            if raw.topic.startswith("status/"):
                node = raw.topic.partition("/")[2]
                if node in aircraft.nodes.nodes or len(aircraft.nodes.nodes) < MOST_NODES:
                    aircraft.nodes.take_status(node, body)
                if raw.topic == "status/adjuster":
                    aircraft.adjuster_s = aircraft.heard_s
            elif raw.topic == "adjustment/report":
                aircraft.report = body
            elif raw.topic == "event/log":
                self.events.append(plain(f"{platform}: {body.message}", LONGEST_TEXT))

    def link(self, platform: str, node: str, alive: bool) -> None:
        """A node of an aircraft has come or gone; its router is its link."""
        if node == "router":
            with self._lock:
                aircraft = self._of(platform)
                if aircraft is not None:
                    aircraft.linked = alive

    def _of(self, platform: str) -> Aircraft | None:
        if platform == FLEET or (platform not in self._aircraft and len(self._aircraft) >= MOST_AIRCRAFT):
            return None
        return self._aircraft.setdefault(platform, Aircraft(platform))

    def rows(self) -> list[dict[str, Any]]:
        """One row an aircraft, by name: name, light, reason, sigma_m, protection_m, sigma0, lag_s, link, heard_s (ago),
        missing (messages that the ground still lacks; None without a recorder there), alarms."""
        with self._lock:
            now_s, rows = self._clock(), []
            for aircraft in sorted(self._aircraft.values(), key=lambda a: a.name):
                ago_s = now_s - aircraft.heard_s if aircraft.heard_s else None
                # another node may go on speaking: the light is the adjuster's
                silent = ago_s is None or now_s - aircraft.adjuster_s > SILENT_S
                light, reason = aircraft.light
                sigma_m, protection_m = aircraft.accuracy_m or (None, None)
                rows.append(
                    {
                        "name": aircraft.name,
                        "light": "unknown" if silent or not light else light,
                        "reason": f"silent; last known: {light}" if silent and light else reason,
                        "sigma_m": sigma_m,
                        "protection_m": protection_m,
                        "sigma0": aircraft.sigma0,
                        "lag_s": aircraft.lag_s,
                        "link": "linked" if aircraft.linked else "gone",
                        "heard_s": ago_s,
                        "missing": self._missing.get(aircraft.name) if self.ground else None,
                        "alarms": aircraft.alarms,
                    }
                )
            return rows

    def line(self) -> str:
        """One line for logs and terminals that cannot be redrawn."""
        parts = []
        for row in self.rows():
            text = f"{row['name']} {row['light']} {row['link']}, heard {_ago(row['heard_s'])}"
            text += f", {row['missing']} to come" if row["missing"] else ""
            parts.append(text + "".join(f", ALARM: {alarm}" for alarm in row["alarms"]))
        return plain(" | ".join(parts or ["no aircraft heard"]))


def screen(overview: FleetOverview, title: str) -> Any:
    """The fleet as one rich renderable."""
    from rich.console import Group
    from rich.panel import Panel
    from rich.table import Table
    from rich.text import Text

    table = Table(box=None, pad_edge=False, expand=True)
    columns = ("aircraft", "light", "sigma", "protection", "sigma0", "lag", "link", "heard", "to come")
    for i, name in enumerate(columns):
        table.add_column(name, justify="right" if 2 <= i <= 5 or i >= 7 else "left", no_wrap=True)
    notes = []
    for row in overview.rows():
        name = plain(row["name"], LONGEST_NAME)
        table.add_row(
            Text(name),
            Text(plain(row["light"], LONGEST_NAME), style=_COLORS.get(row["light"], "dim")),
            _metres(row["sigma_m"]),
            _metres(row["protection_m"]),
            "-" if row["sigma0"] is None else f"{row['sigma0']:.2f}",
            f"{row['lag_s']:.1f} s",
            Text(row["link"], style="green" if row["link"] == "linked" else "bold red"),
            _ago(row["heard_s"]),
            "-" if row["missing"] is None else str(row["missing"]),
        )
        if row["reason"] and row["light"] != "good":
            notes.append(Text(plain(f"{name}: {row['reason']}", LONGEST_TEXT), style=_COLORS.get(row["light"], "dim")))
        notes += [Text(plain(f"{name}: {alarm}", LONGEST_TEXT), style="bold red") for alarm in row["alarms"][:2]]
    ground = [Text(plain(f"ground: {overview.ground}", LONGEST_TEXT), style="dim")] if overview.ground else []
    events = [Text(text, style="dim", no_wrap=True, overflow="ellipsis") for text in list(overview.events)]
    return Panel(Group(table, *notes, *ground, *events), title=Text(plain(title)), title_align="left")


def watch(bus: Bus, stop: threading.Event, title: str, quiet: bool = False) -> FleetOverview:
    """Show a fleet until told to stop: a screen on a terminal, a line every 5 s elsewhere; returns what is known."""
    overview = FleetOverview()
    for topic in TOPICS:
        bus.hear(topic, overview.take)
    bus.watch_fleet(overview.link)
    if redraws(sys.stdout) and not quiet:
        from rich.console import Console
        from rich.live import Live

        with Live(screen(overview, title), console=Console(file=drawing(sys.stdout)), refresh_per_second=2) as live:
            while not stop.wait(0.5):
                live.update(screen(overview, title))
        return overview
    begun, over = time.monotonic(), False
    while not over:
        over = stop.wait(LINE_S)  # a last line for those who watch for less than that
        if not quiet:
            sys.stdout.write(f"{time.monotonic() - begun:4.0f} s  {overview.line()}\n")
            sys.stdout.flush()
    return overview


def _metres(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f} m"


def _ago(seconds: float | None) -> str:
    if seconds is None:
        return "never"
    if seconds < 120.0:
        return f"{seconds:.0f} s ago"
    return f"{seconds / 60.0:.0f} min ago"
