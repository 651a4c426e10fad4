"""How nodes keep up under load: a pace in levels, decided live, announced in a message, followed from its time on.

What a node can do is measured: the time that it works for a second of the flight. It is the sum of what every second
costs and of what each level saves, so that the time at a level that was never tried is known, too. A heap of messages
alone is no reason to shed work, since it goes away if there is time enough; only one that hurts is, and then as much is
shed as lets it go away within some seconds.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating]

P = TypeVar("P")

#: Behind by this share of the window, and by so much at least, hurts: answers come late. Tuned.
HURTS, HURTS_S = 0.15, 2.0
#: Behind by more, levels are used that lose nothing, s. Tuned.
NOTICED_S = 0.5
#: Behind by this share of the window, a level at which nothing is seen may be used. Tuned.
ALARM = 0.4
#: A heap is to go away within so long, s, in this share of the time there is. Tuned.
DRAIN_S, USED = 5.0, 0.95
#: The cost is measured over so much of the flight or of work, s; so much of what was known counts on. Tuned.
MEASURED_S, KEPT = 0.5, 0.8
#: Time between two changes, s. Tuned.
CHANGED_S = 1.0
#: A level at which nothing is seen is left after so long, s, to see whether there is time again. Tuned.
BLIND_S = 10.0
#: Before anything is known, this share of the work is there at any level. Tuned.
FIXED = 0.3


class Cost:
    """Work a second of the flight, ``fixed u + saved v``, at levels that do the parts u and v of all there is to do."""

    def __init__(self) -> None:
        self._parts: Array | None = None  # fixed and saved, s a second
        # what is known beforehand is the ratio of the two, and little of that
        row = np.array([1.0 - FIXED, -FIXED])
        self._information = 0.1 * np.outer(row, row) + 1e-3 * np.eye(2)

    def measure(self, parts: tuple[float, float], cost: float) -> None:
        """At a level of these parts a second of the flight took ``cost`` seconds.

        Only what the level tells is forgotten (directional forgetting): how the two parts are to each other, which one
        level alone cannot tell, stays known.
        """
        row = np.array(parts)
        if self._parts is None:
            share = np.array([FIXED, 1.0 - FIXED])
            self._parts = share * cost / max(float(row @ share), 1e-3)
        told = self._information @ row
        forgotten = np.outer(told, told) / float(row @ told)
        self._information = self._information - (1.0 - KEPT) * forgotten + np.outer(row, row)
        found = self._parts + np.linalg.solve(self._information, row) * (cost - float(row @ self._parts))
        for k in np.flatnonzero(found < 0):  # then the other one is all there is
            found[k], found[1 - k] = 0.0, cost / max(row[1 - k], 1e-3)
        self._parts = found

    def at(self, parts: tuple[float, float]) -> float:
        """Seconds of work a second of the flight at a level of these parts."""
        return 0.0 if self._parts is None else float(self._parts @ parts)


class Governor:
    """Decides on the pace from what the node can do and from how far behind it is. Only live runs ask it.

    Parameters
    ----------
    parts : of each level, of the work that is there in any case and of the rest, the share that it does; level 0 is the
        normal pace and does all
    lossless : levels up to this one lose nothing
    """

    def __init__(self, parts: Sequence[tuple[float, float]], lossless: int = 0) -> None:
        self.level = 0
        self._parts, self._lossless = tuple(parts), lossless
        self._cost = Cost()
        self._known = False
        self._rate = 1.0  # seconds of the flight that come a second
        self._begun: tuple[float, float, float, float] | None = None  # work, flight, time, lag at the last measurement
        self._changed_s = -np.inf

    def look(self, lag_s: float, now_s: float, busy_s: float, flown_s: float, window_s: float) -> bool:
        """Look how far behind the node is; whether the level has changed.

        Parameters
        ----------
        lag_s : for how long the message waited that was worked on last, s
        now_s : a steady clock, s
        busy_s : for how long the node has worked so far, s
        flown_s : platform time that it has reached, s
        window_s : of the node
        """
        self._measure(lag_s, now_s, busy_s, flown_s)
        hurts = lag_s > max(HURTS * window_s, HURTS_S)
        in_need = lag_s > ALARM * window_s
        if not self._known or (now_s - self._changed_s < CHANGED_S and not in_need):
            return False
        if not self.level and lag_s <= NOTICED_S:
            return False
        wanted = self._wanted(lag_s, hurts, in_need)
        if not any(self._parts[self.level]) and not hurts and now_s - self._changed_s > BLIND_S:
            wanted = min(wanted, self.level - 1)
        if wanted == self.level:
            return False
        self.level, self._changed_s, self._begun = wanted, now_s, None
        return True

    def _measure(self, lag_s: float, now_s: float, busy_s: float, flown_s: float) -> None:
        if self._begun is None:
            self._begun = busy_s, flown_s, now_s, lag_s
            return
        worked, flown, passed = busy_s - self._begun[0], flown_s - self._begun[1], now_s - self._begun[2]
        if passed <= 0 or max(worked, flown) < MEASURED_S:
            return
        parts = self._parts[self.level]
        if flown > 0 and any(parts):
            self._cost.measure(parts, worked / flown)
            # a heap that grows says that more comes than is worked off
            came = flown / passed / max(1.0 - (lag_s - self._begun[3]) / passed, 0.1)
            self._rate = came if not self._known else self._rate + (1.0 - KEPT) * (came - self._rate)
            self._known = True
        self._begun = busy_s, flown_s, now_s, lag_s

    def _wanted(self, lag_s: float, hurts: bool, in_need: bool) -> int:
        """The best level that leaves time to work a heap off, or, without one that hurts, that keeps up."""
        drain = 1.0 + lag_s / DRAIN_S if hurts else 1.0
        most = USED / (self._rate * drain)
        last = max(k for k, parts in enumerate(self._parts) if parts[0] > 0 or in_need)
        if not hurts:  # work is shed where it hurts only; what was shed comes back when there is time
            last = max(self.level, self._lossless)
        wanted = next((k for k in range(last) if self._cost.at(self._parts[k]) <= most), last)
        return max(wanted, self.level) if hurts else wanted


class Announced(Generic[P]):
    """What was announced to begin at some platform time."""

    def __init__(self) -> None:
        self._items: list[tuple[int, P]] = []

    def add(self, start_ns: int, item: P) -> None:
        """Something that begins at a time."""
        self._items.append((start_ns, item))

    def take(self, stamp_ns: int) -> P | None:
        """The newest that has begun by now, if one has since the last call."""
        begun = [item for start_ns, item in self._items if start_ns <= stamp_ns]
        del self._items[: len(begun)]
        return begun[-1] if begun else None
