"""When each image line was taken: a first time and a rate, or a table of times."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.floating]


class LineTimes(Protocol):
    """Times of image lines (0-based, integer at the centre of a line) and back."""

    lines: int

    def time_of(self, line: ArrayLike) -> Array:
        """Seconds (n,) of lines (n,), which may have fractions and lie outside the image."""
        ...

    def line_of(self, time_s: ArrayLike) -> Array:
        """Lines (n,) at times (n,) in seconds."""
        ...


class UniformLineTimes:
    """Line ``u`` is taken at ``first_s + u * period_s``.

    Raises
    ------
    ValueError : no lines, or a period of zero (a negative one is a scene stored against the flight)
    """

    def __init__(self, first_s: float, period_s: float, lines: int):
        if lines < 1:
            raise ValueError(f"{lines} lines, wanted at least 1")
        if not (np.isfinite(first_s) and np.isfinite(period_s) and period_s != 0):
            raise ValueError(
                f"first line at {first_s} s, period {period_s} s, wanted numbers and a period that is not 0"
            )
        self.first_s, self.period_s, self.lines = float(first_s), float(period_s), int(lines)

    def time_of(self, line: ArrayLike) -> Array:
        return self.first_s + np.asarray(line, dtype=float) * self.period_s

    def line_of(self, time_s: ArrayLike) -> Array:
        return (np.asarray(time_s, dtype=float) - self.first_s) / self.period_s


class TabulatedLineTimes:
    """Times of some lines, linear between them and with the first and last rate beyond.

    Parameters
    ----------
    line : (n,) strictly increasing line numbers, n >= 2
    time_s : (n,) strictly increasing or strictly decreasing
    lines : number of lines of the image

    Raises
    ------
    ValueError : fewer than two, or numbers that do not increase
    """

    def __init__(self, line: ArrayLike, time_s: ArrayLike, lines: int):
        u, t = np.asarray(line, dtype=float), np.asarray(time_s, dtype=float)
        if len(u) < 2 or u.shape != t.shape:
            raise ValueError(f"line times: {u.shape} lines and {t.shape} times, wanted two or more of each")
        if not (np.diff(u) > 0).all():
            raise ValueError(
                f"line times: line {u[int(np.argmin(np.diff(u) > 0)) + 1]:g} does not follow the one before"
            )
        rising = np.diff(t) * np.sign(t[-1] - t[0])
        if not (rising > 0).all():
            raise ValueError(f"line times: the time of line {u[int(np.argmin(rising > 0)) + 1]:g} goes back")
        self.lines = int(lines)
        self._u, self._t = u, t

    def time_of(self, line: ArrayLike) -> Array:
        return _linear(np.asarray(line, dtype=float), self._u, self._t)

    def line_of(self, time_s: ArrayLike) -> Array:
        t, order = np.asarray(time_s, dtype=float), 1 if self._t[-1] > self._t[0] else -1
        return _linear(t, self._t[::order], self._u[::order])


def _linear(x: Array, nodes: Array, values: Array) -> Array:
    k = np.clip(np.searchsorted(nodes, x, side="right") - 1, 0, len(nodes) - 2)
    return values[k] + (x - nodes[k]) * (values[k + 1] - values[k]) / (nodes[k + 1] - nodes[k])
