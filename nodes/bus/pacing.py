"""Messages onto the bus at the pace of their stamps."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable

from ...schemas import topics
from ..node import Message
from .session import Bus

SECOND_NS = 1_000_000_000
#: Time for others to take in configuration and control before the first measurement goes out.
SETTLE_S = 1.0


class Pacer:
    """Lets things happen at their time: ``due_s`` seconds after the start, divided by the rate.

    Parameters
    ----------
    rate : speed, 1 = as it was; 0 = as fast as it goes
    stop : ends every waiting
    """

    def __init__(self, rate: float, stop: threading.Event) -> None:
        self._rate = rate
        self._stop = stop
        self._begun = time.perf_counter()
        self.worst_late_s = 0.0
        self._late_sum_s = 0.0
        self._n = 0

    @property
    def mean_late_s(self) -> float:
        return self._late_sum_s / max(self._n, 1)

    def postpone(self, seconds: float) -> None:
        """Let everything that is still to come happen later."""
        self._begun += seconds

    def wait(self, due_s: float) -> bool:
        """Wait until it is time; False where the waiting was ended."""
        if self._rate:
            target = self._begun + due_s / self._rate
            remaining = target - time.perf_counter()
            while remaining > 0:
                if remaining > 0.002:
                    self._stop.wait(remaining - 0.001)
                else:
                    time.sleep(min(remaining, 0.0002))
                if self._stop.is_set():
                    return False
                remaining = target - time.perf_counter()
            self.worst_late_s = max(self.worst_late_s, -remaining)
            self._late_sum_s -= remaining
            self._n += 1
        return not self._stop.is_set()


def publish_paced(
    bus: Bus, messages: Iterable[Message], rate: float, stop: threading.Event, *, settle_s: float = SETTLE_S,
    hold: Callable[[], float] | None = None,
) -> Pacer:  # fmt: skip
    """Publish `Message` objects at the pace of their stamps; used by programs that make messages, such as a simulator.

    Latched messages at the beginning go out at once; the others follow ``settle_s`` later, so that all who listen know
    the configuration by then. ``hold`` is called before each message; it may wait, and returns for how long, s.
    """
    bus.prepare(row.name for row in topics.TOPICS if row.latched)
    pacer: Pacer | None = None
    first_ns = 0
    for message in messages:
        if pacer is None:
            if topics.find(message.topic).latched:
                bus.publish(message)
                continue
            stop.wait(settle_s)
            pacer, first_ns = Pacer(rate, stop), message.stamp_ns
        if hold is not None:
            pacer.postpone(hold())
        if not pacer.wait((message.stamp_ns - first_ns) / SECOND_NS):
            break
        bus.publish(message)
    return pacer or Pacer(rate, stop)
