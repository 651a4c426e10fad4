"""How nodes keep up under load: a pace in levels, decided live, announced in a message, followed from its time on.

What a node can do is measured: the time that it works for a second of the flight. It is the sum of what every second
costs and of what each level saves, so that the time at a level that was never tried is known, too. A heap of messages
alone is no reason to shed work, since it goes away if there is time enough. Where there is not, as much is shed as lets
the node keep up once the heap is half as large as one that hurts, and only of one that hurts as much as lets it go away
within some seconds.
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
#: From this share of it on the node has to keep up. Tuned.
PRESSES = 0.5
#: Behind by more, levels are used that lose nothing, s. Tuned.
NOTICED_S = 0.5
#: Behind by this share of the window, a level at which nothing is seen may be used. Tuned.
ALARM = 0.4
#: A heap is to go away within so long, s, in this share of the time there is. Tuned.
DRAIN_S, USED = 5.0, 0.95
#: The cost is measured over so much of the flight or of work, s; of the rate so much counts on. Tuned.
MEASURED_S, KEPT = 0.5, 0.8
#: One measurement of the rate at which the flight comes is not taken for more than this times the one before. Tuned.
MOST_FASTER = 2.0
#: Time between two changes, s. Tuned.
CHANGED_S = 1.0
#: A level at which nothing is seen is left after so long, s, to see whether there is time again. Tuned.
BLIND_S = 10.0
#: Before anything is known, this share of the work is there at any level, more or less. Tuned.
FIXED, FIXED_SIGMA, FIXED_RANGE = 0.3, 0.15, (0.02, 0.98)
#: From one measurement to the next the logarithm of all work changes by so much, the fixed share by so much; a measured
#: cost scatters by so much of itself. Tuned.
TOTAL_CHANGES, FIXED_CHANGES, COST_SIGMA = 0.1, 0.01, 0.2
#: A cost is no less, s a second.
LEAST_COST = 1e-3


class Cost:
    """Work a second of the flight, ``total (fixed u + (1 - fixed) v)``, at levels of the parts u and v of all there is.

    How much there is to do changes within seconds, which part of it no level saves hardly does: an extended Kalman
    filter of the logarithm of the total and of that part, of which one level alone tells the former only.
    """

    def __init__(self) -> None:
        self._state: Array | None = None  # logarithm of the total, s a second; the fixed part
        self._covariance = np.diag([1.0, FIXED_SIGMA**2])

    def measure(self, parts: tuple[float, float], cost: float) -> None:
        """At a level of these parts a second of the flight took ``cost`` seconds."""
        measured = np.log(max(cost, LEAST_COST))
        state = self._state
        if state is None:
            state = np.array([measured - np.log(self._share(parts, FIXED)), FIXED])
        self._covariance = self._covariance + np.diag([TOTAL_CHANGES**2, FIXED_CHANGES**2])
        share = self._share(parts, state[1])
        row = np.array([1.0, (parts[0] - parts[1]) / share])
        told = self._covariance @ row
        gain = told / (row @ told + COST_SIGMA**2)
        self._covariance = self._covariance - np.outer(gain, told)
        total, fixed = state + gain * (measured - state[0] - np.log(share))
        self._state = np.array([total, np.clip(fixed, *FIXED_RANGE)])

    def at(self, parts: tuple[float, float]) -> float:
        """Seconds of work a second of the flight at a level of these parts."""
        if self._state is None:
            return 0.0
        return float(np.exp(self._state[0])) * (self._share(parts, self._state[1]) if any(parts) else 0.0)

    @staticmethod
    def _share(parts: tuple[float, float], fixed: float) -> float:
        return fixed * parts[0] + (1.0 - fixed) * parts[1]


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
        much_s = max(HURTS * window_s, HURTS_S)
        presses, hurts = lag_s > PRESSES * much_s, lag_s > much_s
        in_need = lag_s > ALARM * window_s
        if not self._known or (now_s - self._changed_s < CHANGED_S and not in_need):
            return False
        if not self.level and lag_s <= NOTICED_S:
            return False
        wanted = self._wanted(lag_s, presses, hurts, in_need)
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
            # so does what was held back for its order and leaves together: no single measurement counts for much
            came = np.clip(came, self._rate / MOST_FASTER, self._rate * MOST_FASTER)
            self._rate += (1.0 - KEPT) * float(came - self._rate)
            self._known = True
        self._begun = busy_s, flown_s, now_s, lag_s

    def _wanted(self, lag_s: float, presses: bool, hurts: bool, in_need: bool) -> int:
        """The best level that keeps up, and leaves time to work a heap off that hurts."""
        most = USED / (self._rate * (1.0 + lag_s / DRAIN_S if hurts else 1.0))
        last = max(k for k, parts in enumerate(self._parts) if parts[0] > 0 or in_need)
        if not presses:  # work is shed where it has to be only; what was shed comes back when there is time
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
