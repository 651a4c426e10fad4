"""When the lines of a strip were imaged: at a constant rate, or as the camera says of each of them."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.floating]

#: Times that are off a constant rate by less, lines, are rounded ones of that rate. Definition.
SAME_LINES = 0.02
#: Lines that come again with a time that is off by more, lines, are others: their numbers have begun anew. Definition.
OTHER_LINES = 20.0
#: Lines go on so much later than by the rate at most, s, or earlier by this share of the lines: four times as fast.
#: Definition: what is beyond is no time of the line, and a wrong number would need room for all lines between.
PAUSE_S, FASTER = 5.0, 0.75
#: Lines for which there is room at first.
_ROOM = 4096


class LineTimes:
    """Times of lines and lines of times, both of any fraction.

    Line u is imaged at ``first_s + u / rate``, until times of lines come that say otherwise: from there on these hold,
    between lines that have come they are interpolated, and after the last one the rate goes on.

    Parameters
    ----------
    first_s : time of line 0
    rate : lines a second, at least about

    Raises
    ------
    ValueError : values that are not finite, a rate that is not positive
    """

    def __init__(self, first_s: float, rate: float) -> None:
        if not (np.isfinite(rate) and rate > 0 and np.isfinite(first_s)):
            raise ValueError(f"{rate} lines a second from {first_s} s on, wanted a positive rate")
        self.first_s, self.rate = first_s, rate
        self._seen = 0  # lines before this one have come, or never will
        self._begin = self._count = 0
        self._table = np.empty(0)  # times of lines from `_begin` on

    @property
    def is_constant(self) -> bool:
        """Whether no line was off the rate so far."""
        return self._count == 0

    def add(self, first_line: int, time_s: ArrayLike) -> None:
        """Times (n,) of lines that follow each other; of lines that are known already they are compared only.

        A time that is a little before that of an earlier line, as stamps of two views may be, is passed over.

        Raises
        ------
        ValueError : times that are not finite, far off those that lines had before, or far off where lines go on
        """
        t = np.asarray(time_s, dtype=float)
        line = np.arange(first_line, first_line + len(t))
        if not np.isfinite(t).all():
            raise ValueError(f"times of the lines from {first_line} on are not finite")
        off = (t - self.time_of(line)) * self.rate
        fresh = line >= self._seen
        pause, ahead = (PAUSE_S * self.rate, FASTER * (line - self._seen + 1)) if self._seen else (np.inf, np.inf)
        wrong = np.where(fresh, (off > pause) | (off < -ahead - OTHER_LINES), np.abs(off) > OTHER_LINES)
        if wrong.any():
            k = int(np.argmax(wrong))
            raise ValueError(
                f"line {line[k]} came {off[k]:+.0f} lines off its time; a strip that begins anew wants another name"
            )
        before = float(self.time_of(self._seen - 1)) if self._seen else -np.inf
        fresh &= t > np.maximum.accumulate(np.append(before, t))[:-1]
        if not fresh.any():
            return
        line, t = line[fresh], t[fresh]
        if self._count or np.abs(off[fresh]).max() >= SAME_LINES:
            self._enter(line, t)
        self._seen = int(line[-1]) + 1

    def _enter(self, line: NDArray[np.int_], time_s: Array) -> None:
        """Put times of lines into the table, and between them those of lines that have not come."""
        if self._count:
            known = self._begin + self._count - 1
            line, time_s = np.append(known, line), np.append(self._table[self._count - 1], time_s)
        else:
            self._begin = int(line[0])
        count = int(line[-1]) + 1 - self._begin
        if count > len(self._table):
            grown = np.empty(max(2 * count, _ROOM))
            grown[: self._count] = self._table[: self._count]
            self._table = grown
        self._table[self._count : count] = np.interp(np.arange(self._begin + self._count, line[-1] + 1), line, time_s)
        self._count = count

    def time_of(self, line: ArrayLike) -> Array:
        """Times (...) of lines (...), s."""
        u = np.asarray(line, dtype=float)
        constant = self.first_s + u / self.rate
        if not self._count:
            return np.asarray(constant)
        place = u - self._begin
        below = np.clip(np.floor(place), 0, self._count - 1).astype(np.intp)
        above = np.minimum(below + 1, self._count - 1)
        step = np.where(above > below, self._table[above] - self._table[below], 1.0 / self.rate)
        return np.where(place < 0, constant, self._table[below] + (place - below) * step)

    def line_of(self, time_s: ArrayLike) -> Array:
        """Lines (...) of times (...), s; the inverse of `time_of`."""
        t = np.asarray(time_s, dtype=float)
        constant = (t - self.first_s) * self.rate
        if not self._count:
            return np.asarray(constant)
        table = self._table[: self._count]
        inside = self._begin + np.interp(t, table, np.arange(self._count))
        after = np.maximum(t - table[-1], 0.0) * self.rate
        return np.where(t < table[0], np.minimum(constant, self._begin), inside + after)
