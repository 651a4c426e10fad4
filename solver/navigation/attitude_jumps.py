"""Attitudes that no aircraft can have turned to: blunders of a sensor, told from a jump that stays.

An attitude filter that loses its fix, or a driver that mixes up two messages, gives some attitudes that are tens of
degrees off under a sigma of hundredths. No other sensor contradicts them, and a pose is published with them as it is.
But no aircraft turns by more than `LARGEST_RATE` between two samples. What comes then is left out until it goes on from
where the attitude was; or, where it has gone on from itself for `STAYS_S`, it is how the sensor is aligned from now on.
"""

from __future__ import annotations

from collections import deque
from math import pi, radians

import numpy as np

from ..geometry.rotation import matrix_from_navigation

#: No aircraft turns faster, rad/s (tuned: multicopters reach some 300 deg/s), and no sensor that is any good scatters
#: more between two samples, rad.
LARGEST_RATE, LARGEST_SCATTER = radians(500.0), radians(3.0)
#: Attitudes that have jumped are used when they have gone on by themselves for so long, s (tuned).
STAYS_S = 0.5
#: After a silence of so many seconds an aircraft may have turned to anywhere.
SILENCE_S = 0.5
#: The longest of so many steps is how far samples are apart: they may come in bursts (tuned).
RECENT = 16
#: Roll, pitch and heading, rad.
Angles = tuple[float, float, float]


class AttitudeJumps:
    """See the module.

    Attributes
    ----------
    by_deg : how far the newest attitude that was left out is from the last that was used, degrees
    """

    def __init__(self) -> None:
        self.by_deg = 0.0
        self._used: tuple[float, Angles] | None = None
        self._steps_s: deque[float] = deque(maxlen=RECENT)
        self._newest_s = -np.inf
        self._jumped: tuple[float, float, Angles] | None = None  # since when, and the newest of these

    def is_left_out(self, time_s: float, angles: Angles) -> bool:
        """Take the next attitude; whether it must not be used.

        Parameters
        ----------
        time_s : its time, s
        angles : roll, pitch, heading, rad
        """
        newest_s, self._newest_s = self._newest_s, max(time_s, self._newest_s)
        if time_s <= newest_s:
            return False  # told by who puts them in order
        if self._used is None or time_s - newest_s > SILENCE_S:
            self._use(time_s, angles)
            return False
        self._steps_s.append(time_s - newest_s)
        used_s, used = self._used
        turn = turn_between(used, angles)
        if turn <= LARGEST_SCATTER + LARGEST_RATE * min(time_s - used_s, max(self._steps_s)):
            self._use(time_s, angles)
            return False
        self.by_deg = np.degrees(turn)
        since_s, last_s, last = self._jumped or (time_s, time_s, angles)
        if turn_between(last, angles) > LARGEST_SCATTER + LARGEST_RATE * (time_s - last_s):
            since_s = time_s
        self._jumped = since_s, time_s, angles
        if time_s - since_s < STAYS_S:
            return True
        self._use(time_s, angles)
        return False

    def _use(self, time_s: float, angles: Angles) -> None:
        self._used, self._jumped = (time_s, angles), None


def turn_between(one: Angles, other: Angles) -> float:
    """Angle of the rotation from one attitude to another, rad; a bound of it where that is below `LARGEST_SCATTER`."""
    d = [abs((a - b + pi) % (2.0 * pi) - pi) for a, b in zip(one, other, strict=True)]
    if sum(d) <= LARGEST_SCATTER:  # the rotation is no larger; nearly all are so
        return sum(d)
    R = matrix_from_navigation(*one).T @ matrix_from_navigation(*other)
    return float(np.arccos(np.clip((np.trace(R) - 1.0) / 2.0, -1.0, 1.0)))
