"""Nodes that must not wait go before other programs of the machine, where it permits them to."""

from __future__ import annotations

import os
import threading
from contextlib import suppress
from pathlib import Path

#: What is asked for: at a niceness of -10 a program gets the processor when it wakes, and nine times the share of one
#: with 0 while both want it.
URGENT = -10
_SESSION = Path("/proc/self/autogroup")


def go_first() -> int:
    """Ask for a higher priority, of the thread that calls and of those it begins; the niceness there is now.

    Who was started with a niceness of its own (``nice -n 5 triline node ..``) keeps it.
    Linux grants what ``ulimit -e`` (``LimitNICE=`` of a systemd unit) or CAP_SYS_NICE permit; less of it is better than
    none. Where each session shares the processor as one (``sched_autogroup``), niceness counts among the programs of a
    session alone; a process that leads its session then asks for all of it.
    """
    if not hasattr(os, "setpriority") or threading.current_thread() is not threading.main_thread():
        return 0  # a node in a thread is part of a program of another kind
    if os.getpriority(os.PRIO_PROCESS, 0) == 0:
        for wanted in (URGENT, min(_permitted(), 0)):
            with suppress(OSError):
                os.setpriority(os.PRIO_PROCESS, 0, wanted)
                break
    granted = os.getpriority(os.PRIO_PROCESS, 0)
    if granted < 0 and os.getsid(0) == os.getpid():
        with suppress(OSError):  # no such file, or not permitted
            _SESSION.write_text(str(granted))
    return granted


def _permitted() -> int:
    """The lowest niceness that the limits of this process allow."""
    import resource  # not there on every system that has priorities

    if not hasattr(resource, "RLIMIT_NICE"):
        return 0
    soft, _ = resource.getrlimit(resource.RLIMIT_NICE)
    return max(20 - soft, URGENT) if soft != resource.RLIM_INFINITY else URGENT
