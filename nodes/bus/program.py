"""What a program on the bus is started with."""

from __future__ import annotations

import os
import queue
import signal
import sys
import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..config import Tables
from ..registry import SENSORS
from .priority import go_first
from .session import Bus

if TYPE_CHECKING:
    from .bundle import Bundle, ExpiryWatch

#: What is late where another program takes the processor is lost, or comes too late for who flies: these nodes go
#: before others. The matcher and whoever draws use what is left.
GO_FIRST = (*SENSORS, "navigator", "adjuster", "recorder", "router")
#: A program looks so often whether its certificate expires soon, s.
EXPIRY_EVERY_S = 20.0


def _silent(text: str) -> None:
    pass


@dataclass
class ProgramOptions:
    """Options of ``triline node NAME``.

    Attributes
    ----------
    name : of the node
    platform, port, bus_file, secure : which bus; see `session.Bus`
    tables : the configuration file, one table a node; ``--set key=value`` is merged in
    stop : set when the program shall end
    report : takes one line for a person
    """

    name: str
    platform: str = "demo"
    port: int | None = None
    bus_file: Path | None = None
    secure: Bundle | None = None
    tables: Tables = field(default_factory=dict)
    stop: threading.Event = field(default_factory=threading.Event)
    report: Callable[[str], None] = _silent

    @property
    def table(self) -> dict[str, Any]:
        """The configuration of this node."""
        return self.tables.get(self.name, {})

    def open_bus(self) -> Bus:
        """The bus, with the node's name as source; a node that must not wait asks for a higher priority before."""
        niceness = go_first() if self.name in GO_FIRST else 0
        bus = Bus(self.platform, source=self.name, port=self.port, file=self.bus_file, secure=self.secure)
        if alone := bus.why_alone():
            self.report(alone)
        if self.secure is not None:
            from .bundle import ExpiryWatch

            watch = ExpiryWatch(self.secure)
            self.tell_expiry(watch)
            threading.Thread(target=self._watch_expiry, args=(watch,), name="expiry", daemon=True).start()
        if niceness < 0:
            self.report(f"{self.name} goes before other programs (niceness {niceness})")
        return bus

    def _watch_expiry(self, watch: ExpiryWatch) -> None:
        while not self.stop.wait(EXPIRY_EVERY_S):
            self.tell_expiry(watch)

    def tell_expiry(self, watch: ExpiryWatch) -> None:
        """Report where the certificate expires soon, and it has not been told."""
        if line := watch.look():
            self.report(f"{self.name}: {line}")


#: Names the process that a node must not outlive.
PARENT_VARIABLE = "TRILINE_PARENT"


def stop_with_parent(stop: threading.Event) -> None:
    """End cleanly when the program that started this one has died, however it died; only where it asked for that."""
    parent = os.environ.get(PARENT_VARIABLE, "")
    if not parent.isdigit():
        return

    def watch() -> None:
        while os.getppid() == int(parent) and not stop.wait(0.5):
            pass
        stop.set()

    threading.Thread(target=watch, name="parent", daemon=True).start()


def end_by_signal(stop: threading.Event) -> Callable[[int, object], None]:
    """A signal handler that asks for a clean end.

    A handler runs in the main thread between two steps of whatever that thread does, also while it waits for `stop` and
    holds the lock inside it: to set `stop` there would be to wait for oneself for ever. So the handler only puts a word
    into a queue whose `put` may interrupt itself, and a thread of its own sets the event.
    """
    asked: queue.SimpleQueue[None] = queue.SimpleQueue()

    def handle(number: int, frame: object) -> None:
        asked.put(None)

    def wait() -> None:
        asked.get()
        stop.set()

    threading.Thread(target=wait, name="signals", daemon=True).start()
    return handle


def ending_signals() -> list[signal.Signals]:
    """Signals that ask for a clean end: Ctrl-C, SIGTERM, and a closed terminal unless that is ignored (`nohup`)."""
    hangup = [signal.SIGHUP] if hasattr(signal, "SIGHUP") else []
    return [signal.SIGINT, signal.SIGTERM, *(n for n in hangup if signal.getsignal(n) is not signal.SIG_IGN)]


def stop_on_signals(stop: threading.Event) -> None:
    """`ending_signals` ask for a clean end; the third one ends at once."""
    end, count = end_by_signal(stop), 0

    def handle(number: int, frame: object) -> None:
        nonlocal count
        count += 1
        end(number, frame)
        if count > 2:
            sys.exit(1)

    for number in ending_signals():
        signal.signal(number, handle)
