"""GNSS positions that leave the inertial data: a drift or a jump that no motion explains, put into words.

The filter refuses such fixes by itself. A fix that was refused leaves nothing behind, so that genuine fixes are used as
soon as they come; here a run of them is told, with how fast it grows, and its end.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .error_state import Innovation

Array = NDArray[np.floating]

#: Positions refused in a row, and for so long, s, before it is told (tuned: single bad fixes are ordinary).
FEW, FOR_S = 5, 1.5
#: Positions used in a row that end it (tuned).
AGREEING = 3
_AXES = ("north", "east", "down")


class RefusedPositions:
    """Watches innovations of positions, in the order in which fixes come.

    Attributes
    ----------
    alarm : for the operator while positions are refused; "" else
    """

    def __init__(self) -> None:
        self.alarm = ""
        self._run: list[tuple[float, Array]] = []
        self._used = 0

    def take(self, innovation: Innovation) -> str:
        """Take what a position said; a line for the operator where something begins or ends."""
        if innovation.status == "rejected":
            self._used = 0
            self._run.append((innovation.time_s, np.asarray(innovation.value)))
            text = self._words()
            told, self.alarm = bool(self.alarm), text
            return text if text and not told else ""
        self._used += 1
        if self._used < AGREEING or not self._run:
            return ""
        began, run = self._run[0][0], self._run
        told, self.alarm, self._run = bool(self.alarm), "", []
        if not told:
            return ""
        most = max(float(np.linalg.norm(value)) for _, value in run)
        why = "agree again" if innovation.status != "restored" else "were taken for true"
        return f"GNSS positions {why} after {run[-1][0] - began:.0f} s, in which they were up to {most:.1f} m off"

    def _words(self) -> str:
        """What is to be said of the run so far; "" as long as it is short."""
        if len(self._run) < FEW or self._run[-1][0] - self._run[0][0] < FOR_S:
            return ""
        times = np.array([t for t, _ in self._run])
        off = np.array([value for _, value in self._run])
        rate = np.polyfit(times - times[0], off, 1)[0]
        axis = int(np.argmax(np.abs(off[-1])))
        return (
            f"GNSS positions contradict the inertial data: {np.linalg.norm(off[-1]):.1f} m off, most {_AXES[axis]}, "
            f"changing by {np.linalg.norm(rate):.2f} m/s: not used"
        )
