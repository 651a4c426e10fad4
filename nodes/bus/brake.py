"""Elastic time: a simulated or replayed flight waits for those who cannot follow it.

Real sensors wait for nobody: what a machine cannot take in is lost. A simulation and a recording can wait, so that what
comes out does not depend on the machine; then the flight takes longer than it should, and says so.
"""

from __future__ import annotations

import threading
import time
from typing import Any

from ...schemas import codec
from ...schemas.envelope import RawMessage
from .session import Bus

#: A node that has so much to work off, s on the clock, slows the flight down until it has less. A load control
#: (`governor.HURTS_S`) sheds work beyond that.
HOLD_S, RELEASE_S = 2.0, 1.4
#: ... by so much a message, s, and by more where a node is this many times as far behind. The flight never stands
#: still: nodes take silence for the end and work off what they hold back.
STEP_S, LONG_STEP_S, FAR_BEHIND = 0.02, 0.2, 1.5
#: A living node that says nothing for so long is busy, s; after that time it is given up.
SILENT_S, GIVEN_UP_S = 2.5, 15.0


class Brake:
    """Watches how far behind the nodes on a bus are.

    Parameters
    ----------
    bus : an open bus
    names : nodes that are waited for, with commas between them; "" for none
    stop : ends every waiting
    rate : seconds of the flight a second on the clock; nodes say how far behind they are in seconds of the flight.
        Below 1 it counts as 1, so that nothing that is slower than life is further behind
    """

    def __init__(self, bus: Bus, names: str, stop: threading.Event, rate: float = 1.0) -> None:
        self._rate = max(rate, 1.0)
        self._names = frozenset(name.strip() for name in names.split(",") if name.strip())
        self._stop = stop
        self._lock = threading.Lock()
        self._lag_s: dict[str, float] = {}
        self._heard_s: dict[str, float] = {}
        self._holding = False
        self.held_s = 0.0
        bus.watch(self._changed)
        bus.subscribe("status/*", self._take)

    def wait(self) -> float:
        """Wait a moment if somebody is behind; returns for how long, s."""
        self._holding = self._behind(RELEASE_S if self._holding else HOLD_S)
        if not self._holding:
            return 0.0
        begun = time.monotonic()
        self._stop.wait(LONG_STEP_S if self._behind(FAR_BEHIND * HOLD_S) else STEP_S)
        waited = time.monotonic() - begun
        self.held_s += waited
        return waited

    def _behind(self, limit_s: float) -> bool:
        now = time.monotonic()
        with self._lock:
            return any(
                lag > limit_s or SILENT_S < now - self._heard_s[name] < GIVEN_UP_S
                for name, lag in self._lag_s.items()
                if now - self._heard_s[name] < GIVEN_UP_S
            )

    def _take(self, raw: RawMessage) -> None:
        name = raw.topic.rpartition("/")[2]
        if name not in self._names:
            return
        try:
            body: Any = codec.decode(raw.topic, raw.data)
        except ValueError:
            return
        with self._lock:
            self._lag_s[name], self._heard_s[name] = body.lag_s / self._rate, time.monotonic()

    def _changed(self, name: str, alive: bool) -> None:
        if not alive:
            with self._lock:
                self._lag_s.pop(name, None)
