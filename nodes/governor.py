"""How nodes keep up under load: a pace in levels, decided live, announced in a message, followed from its time on."""

from __future__ import annotations

from typing import Generic, TypeVar

P = TypeVar("P")

#: Waiting time between two steps up, before a step down, and the longest that this grows to.
UP_S, DOWN_S, LONGEST_DOWN_S = 0.3, 5.0, 80.0
#: Of the window, the share to be behind at which nothing is tried out any more.
ALARM = 0.4


class Governor:
    """Decides on the pace from how far behind the node is. Only live runs ask it; times are waiting times.

    Parameters
    ----------
    levels : how many there are; level 0 is the normal pace
    behind_s, caught_up_s : behind by more (and an interval), a level up, unless it is catching up; behind by less for a
        while, one down
    down_s : that while; it grows where steps down were too early
    patience_s : for so long it looks whether a heap goes away by itself, as one does that was held up by others
    """

    def __init__(
        self, levels: int, behind_s: float = 0.4, caught_up_s: float = 0.2, down_s: float = DOWN_S,
        patience_s: float = 0.0,
    ) -> None:  # fmt: skip
        self.level = 0
        self._patience_s = patience_s
        self._top, self._behind_s, self._caught_up_s = levels - 1, behind_s, caught_up_s
        self._changed_s = -1e9
        self._went_down = False
        self._fine_since_s: float | None = None
        self._behind_since_s: float | None = None
        self._down_s = down_s
        self._worst_s = 0.0  # behind by so much at the last look

    def look(self, lag_s: float, now_s: float, interval_s: float, window_s: float) -> bool:
        """Look at the lag of platform time, s; whether the level has changed."""
        before = self.level
        behind = lag_s > self._behind_s + interval_s
        if behind:
            self._fine_since_s = None
            if self._behind_since_s is None:
                self._behind_since_s = now_s
                self._worst_s = lag_s if self._patience_s else self._worst_s
            growing = lag_s > 0.95 * self._worst_s
            waited = now_s - self._changed_s > UP_S and now_s - self._behind_since_s >= self._patience_s
            if growing and (waited or (self._patience_s and lag_s > ALARM * window_s)):
                step = self._top if lag_s > ALARM * window_s else 2 if lag_s > 0.5 * ALARM * window_s else 1
                self.level = min(self.level + step, self._top)
                if self._went_down and now_s - self._changed_s < self._down_s:  # that was too early
                    self._down_s = min(2.0 * self._down_s, LONGEST_DOWN_S)
                self._changed_s, self._worst_s, self._went_down = now_s, lag_s, False
            elif not growing:
                self._worst_s = max(0.98 * self._worst_s, lag_s)
        elif lag_s < self._caught_up_s + interval_s:
            self._behind_since_s = None
            if self._fine_since_s is None:
                self._fine_since_s = now_s
            if self.level and now_s - max(self._fine_since_s, self._changed_s) > self._down_s:
                self.level -= 1
                self._changed_s, self._worst_s, self._went_down = now_s, 0.0, True
        return self.level != before


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
