"""What a node says of itself on the bus: ``status/<node>``."""

from __future__ import annotations

import time
from collections import Counter

from ...schemas import messages as m
from ...schemas.envelope import RawMessage
from ..node import Message, Node
from ..ordering import TopicCounts
from .session import Bus

STATUS_PERIOD_S = 0.5
#: What an alarm says without which nothing can be right.
NO_TRAJECTORY = "no trajectory for"
#: Counts how often the session of a node was opened anew.
ANEW = "session opened anew"
#: Another node of the same name that was heard twice within this time is there, s.
ANOTHER_S = 3.0


class StatusPublisher:
    """Publishes ``status/<node>`` at 2 Hz."""

    def __init__(self, bus: Bus, name: str) -> None:
        self._bus = bus
        self._name = name
        self._begun = time.monotonic()
        self._last = 0.0
        self._received: Counter[str] = Counter()
        self._others: dict[int, list[float]] = {}  # when others of the same name were heard
        bus.subscribe(f"status/{name}", self._hear)

    def _hear(self, raw: RawMessage) -> None:
        """Somebody of this name: this node, the run before it that is ending, or another one beside it."""
        if raw.envelope.start != self._bus.start:
            self._others.setdefault(raw.envelope.start, []).append(time.monotonic())

    def _another(self) -> str:
        """A line for the operator where another node of the same name goes on speaking; "" where none does."""
        now = time.monotonic()
        for start, heard in list(self._others.items()):
            heard[:] = [moment for moment in heard if now - moment < ANOTHER_S]
            if not heard:
                del self._others[start]
        twice = sum(len(heard) >= 2 for heard in self._others.values())
        if not twice:
            return ""
        return f"{twice + 1} nodes '{self._name}' run on platform {self._bus.platform}: stop all but one of them"

    def due(self) -> bool:
        """Whether it is time for the next."""
        return time.monotonic() - self._last >= STATUS_PERIOD_S

    def publish(
        self,
        state: str,
        counts: dict[str, TopicCounts],
        node: Node,
        lag_s: float,
        queued: int,
        stamp_ns: int,
        malformed_envelopes: dict[str, int] | None = None,
    ) -> None:
        """Publish what the arguments say; ``stamp_ns`` is the newest platform time known (0: none yet)."""
        now = time.monotonic()
        if self._bus.opened_anew:
            node.counters[ANEW] = len(self._bus.opened_anew)
            node.last_problems[ANEW] = f"the session was opened anew: {self._bus.opened_anew[-1]}"
        node.alarms["another"] = "" if node.onlooker else self._another()
        light, reason = node.light()
        if node.alarm and light:  # not all is well, whatever the figures say
            worse = "failed" if NO_TRAJECTORY in node.alarm else "weak" if light == "good" else light
            light, reason = worse, "; ".join(filter(None, (node.alarm, reason)))
        elapsed = now - self._last if self._last else 0.0
        self._last = now
        status = m.NodeStatus(
            node=self._name, state=state, uptime_s=now - self._begun, lag_s=lag_s, queued=queued,
            last_problem=node.last_problem, light=light, light_reason=reason, alarm=node.alarm,
        )  # fmt: skip
        extra = malformed_envelopes or {}
        for topic in sorted(set(counts) | set(extra)):
            c = counts.get(topic, TopicCounts())
            rate = (c.received - self._received[topic]) / elapsed if elapsed else 0.0
            self._received[topic] = c.received
            status.topics.add(
                topic=topic, received=c.received, gaps=c.gaps, duplicates=c.duplicates, late=c.late,
                malformed=c.malformed + extra.get(topic, 0), dropped=c.dropped, rate_hz=rate,
                refused=c.malformed + c.refused,
            )  # fmt: skip
        for name, value in sorted(node.counters.items()):
            status.counters.add(name=name, value=int(value), last_problem=node.last_problems.get(name, ""))
        self._bus.publish(Message(f"status/{self._name}", stamp_ns, status, self._name))
