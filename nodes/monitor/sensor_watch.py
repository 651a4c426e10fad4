"""What a live flight waits for: which sensors come in at what rate, and which were never seen or have stopped."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

#: Rates are means over so many seconds, of those that the recorder has measured from one status to the next.
RATE_S = 5.0
#: A sensor has stopped when it is silent for so long, s, and for so many of its intervals.
SILENT_S, SILENT_INTERVALS = 2.0, 3.0
#: Who sees everything that sensors send.
COUNTS = "recorder"
NEVER, COMES, STOPPED = "never seen", "comes in", "stopped"


@dataclass(frozen=True)
class SensorRow:
    """A sensor as it is shown.

    Attributes
    ----------
    name : its topic; alternatives that are awaited with "or" between them
    state : "comes in", "never seen" or "stopped"
    rate_hz : messages a second, mean of the last seconds
    received : messages so far
    words : the state with what belongs to it
    """

    name: str
    state: str
    rate_hz: float
    received: int
    words: str


@dataclass
class _Topic:
    received: int = 0
    before: int = 0  # counted by recorders that have ended
    newest: int = 0
    lost: int = 0
    heard_s: float = 0.0
    usual_hz: float = 0.0  # its rate when it was heard last
    rates: deque[tuple[float, float]] = field(default_factory=deque)  # of the last statuses, and when they came

    def count(self, received: int, rate_hz: float, now_s: float) -> None:
        if received < self.newest:  # a recorder was started again
            self.before += self.newest
        self.newest = received
        total, heard = self.before + received, self.before + received > self.received
        self.received = max(total, self.received)
        if self.received:
            self.rates.append((now_s, rate_hz))
        while len(self.rates) > 1 and now_s - self.rates[0][0] >= RATE_S:
            self.rates.popleft()
        if heard:
            self.heard_s, self.usual_hz = now_s, self.rate_hz

    @property
    def rate_hz(self) -> float:
        return sum(rate for _, rate in self.rates) / len(self.rates) if self.rates else 0.0


class SensorWatch:
    """Follows the counts that the recorder publishes.

    Parameters
    ----------
    awaited : topics that the flight needs; several in one entry are alternatives
    clock : monotonic time, s

    Attributes
    ----------
    phase : what the flight as a whole waits for; "" for nothing
    said : what was told last of sensor programs
    """

    def __init__(self, awaited: Sequence[tuple[str, ...]], clock: Callable[[], float] = time.monotonic) -> None:
        self._awaited = list(awaited)
        self._clock = clock
        self._topics: dict[str, _Topic] = {}
        self._status: Any = None  # counted already
        self._counted_s = 0.0  # when it came: what has come since then nobody knows
        self._states: dict[str, str] = {}
        self._pending: list[str] = []
        self.phase = ""
        self.said: deque[str] = deque(maxlen=3)

    def tell(self, text: str) -> None:
        """Show a line."""
        self.said.append(text)
        self._pending.append(text)

    def look(self, nodes: Mapping[str, Any], *, ending: bool = False) -> list[str]:
        """Take in the newest NodeStatus of each node; returns a line for each sensor that began or stopped.

        While a flight is ``ending`` that a sensor stops is meant, and no line says so.
        """
        now = self._clock()
        status = nodes.get(COUNTS)
        new, before, self._status = status is not self._status, self._status, status
        if new and status is not None:
            if before is not None and status.uptime_s < before.uptime_s:  # nobody counted until it was started again
                for known in self._topics.values():
                    known.heard_s += now - self._counted_s
            self._counted_s = now
        for topic in status.topics if new and status is not None else ():
            if topic.topic.startswith(("sensor/", "trajectory/")) and (
                topic.topic.startswith("sensor/") or self._is_awaited(topic.topic)
            ):
                known = self._topics.setdefault(topic.topic, _Topic())
                known.count(int(topic.received), float(topic.rate_hz), now)
                known.lost = int(topic.gaps + topic.malformed)
        lines, self._pending = self._pending, []
        for row in self.rows():
            if row.state != self._states.get(row.name, NEVER) and not (ending and row.state == STOPPED):
                lines.append(f"{row.name} {row.words if row.state == STOPPED else row.state}")
            self._states[row.name] = row.state
        return lines

    def rows(self) -> list[SensorRow]:
        """A row for what is awaited, then for what comes beside it."""
        now, rows, shown = self._counted_s, [], set()
        for group in self._awaited:
            present = [name for name in group if name in self._topics and self._topics[name].received]
            shown.update(present)
            rows += [self._row(name, now) for name in present] or [SensorRow(" or ".join(group), NEVER, 0.0, 0, NEVER)]
        return rows + [self._row(name, now) for name in sorted(set(self._topics) - shown)]

    @property
    def never(self) -> list[str]:
        """What is awaited and was never seen."""
        return [row.name for row in self.rows() if row.state == NEVER]

    def line(self) -> str:
        """All sensors in one line."""
        rows = self.rows()
        parts = [", ".join(f"{row.name} {row.rate_hz:.1f}/s" for row in rows if row.state == COMES)]
        parts += [f"{row.name} {row.words}" for row in rows if row.state != COMES]
        return "; ".join(part for part in (*parts, self.phase) if part)

    def _is_awaited(self, topic: str) -> bool:
        return any(topic in group for group in self._awaited)

    def _row(self, name: str, now_s: float) -> SensorRow:
        topic = self._topics[name]
        rate, usual, silent_s = topic.rate_hz, topic.usual_hz, now_s - topic.heard_s
        lost = f", {topic.lost} lost or refused" if topic.lost else ""
        if silent_s > max(SILENT_S, SILENT_INTERVALS / usual if usual else 0.0):
            return SensorRow(name, STOPPED, rate, topic.received, f"stopped {silent_s:.0f} s ago{lost}")
        return SensorRow(name, COMES, rate, topic.received, COMES + lost)
