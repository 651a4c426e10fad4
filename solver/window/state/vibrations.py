"""How much the attitude has vibrated, or may have."""

from __future__ import annotations

import numpy as np

from ...arrays import Array


class LargestSince:
    """The largest value that was noted at a time or later.

    A value is forgotten as soon as one is noted that is as large, so that those that are kept fall with time.
    """

    def __init__(self) -> None:
        self._times_s: list[float] = []
        self._values: list[float] = []

    def note(self, now_s: float, value: float) -> None:
        """Another value, not before the last one."""
        while self._values and self._values[-1] <= value:
            self._times_s.pop()
            self._values.pop()
        self._times_s.append(now_s)
        self._values.append(value)

    def at(self, time_s: Array) -> Array:
        """For times (n,) the largest (n,) since then; the newest one for later times, 0 before any was noted."""
        if not self._values:
            return np.zeros(np.shape(time_s))
        place = np.searchsorted(self._times_s, time_s)
        return np.array(self._values)[np.minimum(place, len(self._values) - 1)]


class Vibrations:
    """What was estimated of a vibration of the attitude as time went on.

    The window states one noise for all its looks. A vibration that begins is told some time later, and one that calms
    down fades out of the estimate while looks at it are still there. So a pose has vibrated as much as was ever
    estimated from its time on.
    """

    def __init__(self) -> None:
        self._known, self._doubtful = LargestSince(), LargestSince()

    def note(self, now_s: float, known: float, possible: float | None) -> None:
        """The vibration that is known, and the one that may be, rad; None where it is certain that there is no other,
        so that what may have been was none."""
        self._known.note(now_s, known)
        if possible is None:
            self._doubtful = LargestSince()
        else:
            self._doubtful.note(now_s, possible)

    def since(self, time_s: Array) -> Array:
        """Vibration (n,) of the attitude at times (n,), known or possible, rad."""
        return np.maximum(self._known.at(time_s), self._doubtful.at(time_s))
