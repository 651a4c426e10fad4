"""Clocks of sensors against each other: an offset of the GNSS times that no transmission explains is found and named.

A fix reaches the navigator a fraction of a second after the attitude or inertial sample of its time. Fixes that are
seconds older or newer than these, one like the other, have another clock: GPS time is ahead of UTC by the leap seconds,
receivers count weeks modulo 1 024, computers are set to local time.
"""

from __future__ import annotations

from collections import deque
from statistics import median

#: Fixes that come later or earlier by more than this have another clock, s (tuned: no receiver computes for so long).
LARGEST_DELAY_S = 2.5
#: So many fixes decide, and so many right ones take it back (tuned).
DECIDING, TAKING_BACK = 3, 5
#: What offsets are known by: seconds, how far off they are recognised, name.
KNOWN_OFFSETS = (
    (1024 * 604_800.0, 400_000.0, "1 024 weeks: the receiver's count of weeks has begun again"),
    (604_800.0, 20.0, "a week"),
    (86_400.0, 20.0, "a day"),
    (3_600.0, 20.0, "an hour: local time?"),
    (18.0, 1.0, "the leap seconds between GPS time and UTC"),
)


def offset_in_words(offset_s: float, other: str) -> str:
    """An offset (other clock minus GNSS clock, s) as a line for the operator.

    Parameters
    ----------
    offset_s : how far the GNSS clock is behind; negative = ahead
    other : what it is compared with, e.g. "inertial"
    """
    size = abs(offset_s)
    text = f"GNSS clock {size:.2f} s {'behind' if offset_s > 0 else 'ahead of'} the {other} clock"
    for unit, within, name in KNOWN_OFFSETS:
        times = round(size / unit)
        if times >= 1 and abs(size - times * unit) <= within and (unit > 18.0 or times == 1):
            return f"{text} ({name})" if times == 1 else f"{text} ({times} times {name.partition(':')[0]})"
    return text


class ClockCheck:
    """Compares the times of fixes with those of attitude or inertial samples, as they come.

    Attributes
    ----------
    offset_s : of a clock that is wrong, other minus GNSS; None while it is right
    """

    def __init__(self) -> None:
        self.offset_s: float | None = None
        self._delays: deque[float] = deque(maxlen=DECIDING)
        self._usual: deque[float] = deque(maxlen=25)
        self._right = 0
        self._newest_s = float("-inf")

    def fix(self, time_s: float, newest_s: float) -> bool:
        """Take a fix of a time that came when the newest other sample was of another; whether it can be used."""
        if newest_s <= self._newest_s:  # nothing else has come: who is silent tells no time
            return self.offset_s is None
        self._newest_s = newest_s
        delay = newest_s - time_s
        self._delays.append(delay)
        usual = median(self._usual) if self._usual else 0.0
        if abs(delay - usual) <= LARGEST_DELAY_S:
            self._right += 1
            if self.offset_s is None:
                self._usual.append(delay)
                return True
            if self._right >= TAKING_BACK:
                self.offset_s = None
                return True
            return False
        self._right = 0
        if len(self._delays) == DECIDING and all(abs(d - usual) > LARGEST_DELAY_S for d in self._delays):
            offset = median(self._delays) - usual
            if max(self._delays) - min(self._delays) <= LARGEST_DELAY_S or abs(offset) > 60.0:
                self.offset_s = offset
        return self.offset_s is None and delay > usual  # a single late one is the filter's to judge
