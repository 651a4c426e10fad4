"""Positions without the steps and the noise of their fixes.

A filter moves the position at every fix, by centimetres, and between two fixes it is wrong by what it took over. All
patches that look through the same lines are bent alike by that: an error that many ties have in common, where each
ought to have its own. A platform does not step: a curve through a second of positions follows its motion.
"""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating]

#: A parabola is laid through the positions within so many seconds of a knot, with normal weights of that sigma, s.
REACH_S, WEIGHT_S = 0.75, 0.375
#: Distance of the knots, s.
POSITION_KNOT_S = 0.1
#: With fewer positions about a knot than this they are taken as they are.
FEWEST = 12
#: What is learnt is the median over so many blocks of so many seconds; nothing is known before there are so many.
BLOCKS, BLOCK_S, FEWEST_BLOCKS = 15, 1.0, 2
#: Fourth differences, and how large they get at a step: 1, -3, 3, -1 times it (derived).
FOURTH, HIGHEST = np.array([1.0, -4.0, 6.0, -4.0, 1.0]), 3.0
#: Motion is smooth enough if what positions leave the curve by is no more than this share of the largest steps of a
#: block (mean squares). Noise of fixes, 1 to 10 a second, comes to 0.1 to 0.2.
LARGEST_SHARE = 0.35
#: White noise reaches no higher in a block than so many of its sigmas (of fourth differences); it is no step.
WHITE = 4.0


class SteadyPositions:
    """Positions in, a curve through them out; as they came where the platform itself shakes too much for that.

    Parameters
    ----------
    kept_s : the curve is kept so long, s
    """

    def __init__(self, kept_s: float = np.inf) -> None:
        self._kept = float(np.rint(kept_s / POSITION_KNOT_S))
        self._time, self._position, self._size = np.empty(256), np.empty((256, 3)), 0
        self._knots: dict[int, tuple[Array, Array] | None] = {}
        self._open: dict[int, tuple[Array, Array] | None] = {}
        self._next: int | None = None
        self._blocks: deque[tuple[float, float]] = deque(maxlen=BLOCKS)
        self._block = 0
        self._fourth: list[Array] = []
        self._left: list[Array] = []

    @property
    def smooth(self) -> bool:
        """Whether what positions leave the curve by is explained by their steps."""
        if len(self._blocks) < FEWEST_BLOCKS:
            return False
        left, step = np.median(self._blocks, axis=0)
        return bool(left <= LARGEST_SHARE * step)

    def add(self, time_s: float, position_l: Array) -> None:
        """Add a position (3,) that comes after the last."""
        if self._size == len(self._time):
            self._make_room()
        n = self._size
        self._time[n], self._position[n] = time_s, position_l
        self._size = n + 1
        self._open.clear()
        if n < 4:
            if n == 0:
                self._next = int(np.floor(time_s / POSITION_KNOT_S))
            elif time_s - self._time[n - 1] > 2.0 * REACH_S:  # so few before it are none about a knot
                self._next = int(np.floor((time_s - REACH_S) / POSITION_KNOT_S))
            return
        steps = np.diff(self._time[n - 4 : n + 1])
        if np.ptp(steps) <= 0.05 * steps.mean():
            self._fourth.append(FOURTH @ self._position[n - 4 : n + 1])
        assert self._next is not None
        last_s = float(self._time[n - 1])
        if time_s - last_s > 2.0 * REACH_S:  # no knot between them has positions about it
            while self._next * POSITION_KNOT_S <= last_s + REACH_S:
                self._settle(self._next)
                self._next += 1
            self._next = max(self._next, int(np.floor((time_s - REACH_S) / POSITION_KNOT_S)))
            oldest = self._next - self._kept
            self._knots = {number: knot for number, knot in self._knots.items() if number > oldest}
        while self._next * POSITION_KNOT_S + REACH_S <= time_s:
            self._settle(self._next)
            self._next += 1

    def at(self, time_s: Array, position_l: Array) -> Array:
        """The curve (n, 3) at times (n,), inside the positions; ``position_l`` is what stands where there is none."""
        if not self.smooth or not len(time_s):
            return position_l
        number = np.floor(time_s / POSITION_KNOT_S).astype(int)
        first = int(number.min())
        knots = [self._knot(k) for k in range(first, int(number.max()) + 2)]
        there = np.array([knot is not None for knot in knots])
        value, slope = (np.stack([np.zeros(3) if knot is None else knot[i] for knot in knots]) for i in (0, 1))
        i = number - first
        s = (time_s / POSITION_KNOT_S - number)[:, None]
        before, after = 1 - s * s * (3 - 2 * s), s * s * (3 - 2 * s)
        turn, turn_after = POSITION_KNOT_S * s * (1 - s) ** 2, -POSITION_KNOT_S * s * s * (1 - s)
        curve = before * value[i] + after * value[i + 1] + turn * slope[i] + turn_after * slope[i + 1]
        return np.where((there[i] & there[i + 1])[:, None], curve, position_l)

    def _knot(self, number: int) -> tuple[Array, Array] | None:
        """Position and velocity at a knot; None for lack of positions about it."""
        if number in self._knots:
            return self._knots[number]
        if number not in self._open:
            self._open[number] = self._fit(number * POSITION_KNOT_S)
        return self._open[number]

    def _fit(self, at_s: float) -> tuple[Array, Array] | None:
        time = self._time[: self._size]
        first, end = np.searchsorted(time, (at_s - REACH_S, at_s + REACH_S))
        dt = time[first:end] - at_s
        if end - first < FEWEST or dt[-1] - dt[0] < REACH_S:
            return None
        weight = np.exp(-0.5 * (dt / WEIGHT_S) ** 2)
        design = np.stack([np.ones_like(dt), dt, dt * dt])
        # about one of them, for the sake of the digits
        middle = self._position[(first + end) // 2]
        weighted = design * weight
        fit = np.linalg.solve(weighted @ design.T, weighted @ (self._position[first:end] - middle))
        return fit[0] + middle, fit[1]

    def _settle(self, number: int) -> None:
        """All positions about a knot have come."""
        at_s = number * POSITION_KNOT_S
        knot = self._knots[number] = self._fit(at_s)
        if np.isfinite(self._kept):
            self._knots.pop(number - int(self._kept), None)
        if knot is None:
            return
        i = int(np.searchsorted(self._time[: self._size], at_s))
        value, slope = knot
        left = self._position[i] - value - slope * (self._time[i] - at_s)
        self._left.append(left)
        if number * POSITION_KNOT_S >= (self._block + 1) * BLOCK_S:
            # steps are those of the newest positions; blocks need not be the same
            self._blocks.append((float(np.square(self._left).mean()), _steps_m2(np.array(self._fourth))))
            self._block = int(number * POSITION_KNOT_S / BLOCK_S)
            self._fourth.clear()
            self._left.clear()

    def _make_room(self) -> None:
        """Drop what is out of reach, or take more room."""
        start = int(np.searchsorted(self._time[: self._size], self._time[self._size - 1] - 4 * REACH_S))
        kept = self._size - start
        size = max(2 * kept, 256)
        time, position = np.empty(size), np.empty((size, 3))
        time[:kept], position[:kept] = self._time[start : self._size], self._position[start : self._size]
        self._time, self._position, self._size = time, position, kept


def _steps_m2(fourth: Array) -> float:
    """Mean square over X, Y and Z of the largest step, from fourth differences (n, 3), without what noise makes."""
    if not len(fourth):
        return 0.0
    size = np.abs(fourth)
    square = size.max(axis=0) ** 2 - (WHITE * 1.4826 * np.median(size, axis=0)) ** 2
    return float(np.maximum(square, 0.0).mean()) / HIGHEST**2
