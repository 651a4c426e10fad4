"""The newest image lines of every CCD line, in rings that together stay within a budget of bytes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

IntArray = NDArray[np.int64]

#: A lane is so wide, samples: the search window at the coarsest level of matching, and as much again to choose from.
LANE = 512
#: Fewer lanes than this do not carry an adjustment: then the lines are kept for a shorter time as well.
FEWEST_LANES = 4
#: Gaps of no more lines than this are closed: what lies between the lines around them is put in, and marked.
LONGEST_FILLED = 8
#: What a ring knows of a line (definition).
NOTHING, SEEN, FILLED = 0, 1, 2


@dataclass(frozen=True)
class Stretch:
    """Lines out of a ring.

    Attributes
    ----------
    first_line : number of the first one
    pixels : (n, samples) grey values, 0 where nothing usable is known
    usable : (n,) whether a line came and is fit for use
    filled : (n,) whether it did not, but lies between two near ones that did: interpolated
    """

    first_line: int
    pixels: NDArray[np.unsignedinteger]
    usable: NDArray[np.bool_]
    filled: NDArray[np.bool_]


class LineRing:
    """The newest ``capacity`` lines of one CCD line, or of lanes of it.

    Lines that never came are known as missing; lines that come twice or out of order are left out. Short gaps are
    closed by what lies between the lines before and after, once that has come.

    Parameters
    ----------
    samples, capacity : length of a line, and how many lines
    dtype : of the pixels
    lanes : (l, 2) first and end sample of each stretch of the line that is kept, in order, apart; None = all of it

    Raises
    ------
    ValueError : nothing to keep, lanes that overlap or lie outside
    """

    def __init__(self, samples: int, capacity: int, dtype: np.dtype | type = np.uint16, lanes: IntArray | None = None):
        if samples < 1 or capacity < 1:
            raise ValueError(f"a ring of {capacity} lines of {samples} samples, wanted at least one of each")
        self.lanes = np.array([[0, samples]]) if lanes is None else np.asarray(lanes, dtype=np.int64)
        borders = self.lanes.ravel()
        if not (len(borders) and borders[0] >= 0 and borders[-1] <= samples and (np.diff(borders) >= 0).all()):
            raise ValueError(f"lanes {self.lanes.tolist()} of a line of {samples} samples")
        self.samples = samples
        wide = np.diff(self.lanes, axis=1)[:, 0]
        self._column = np.full(samples, -1, dtype=np.int64)
        for (first, end), at in zip(self.lanes, np.cumsum(wide) - wide, strict=True):
            self._column[first:end] = at + np.arange(end - first)
        self._pixels = np.zeros((capacity, int(wide.sum())), dtype=dtype)
        self._state = np.full(capacity, NOTHING, dtype=np.uint8)
        self.start = self.end = 0  # lines from start to end - 1 are in the ring
        self._seen_end = 0  # after the newest line that was fit for use

    @property
    def capacity(self) -> int:
        return len(self._pixels)

    @property
    def nbytes(self) -> int:
        return self._pixels.nbytes + self._state.nbytes

    def clear(self) -> None:
        """Forget all lines; the next may have any number."""
        self.start = self.end = self._seen_end = 0
        self._state[:] = NOTHING

    def add(
        self, first_line: int, pixels: NDArray[np.unsignedinteger], usable: NDArray[np.bool_] | None = None
    ) -> tuple[int, int]:
        """Add lines; returns how many were missing before them, and how many of them came too late.

        Raises
        ------
        ValueError : lines of another length
        """
        if pixels.shape[1:] != (self.samples,):
            width = " x ".join(map(str, pixels.shape[1:])) or "no"
            raise ValueError(f"lines of {width} samples, wanted {self.samples}")
        usable = np.ones(len(pixels), dtype=bool) if usable is None else usable
        if self.start == self.end:
            self.start = self.end = self._seen_end = first_line
        late = min(max(self.end - first_line, 0), len(pixels))
        pixels, usable, first_line = pixels[late:], usable[late:], first_line + late
        if not len(pixels):
            return 0, late
        missing = first_line - self.end
        gone = np.arange(max(self.end, first_line - self.capacity), first_line) % self.capacity
        self._state[gone] = NOTHING
        self._pixels[gone] = 0
        end = first_line + len(pixels)
        kept = min(len(pixels), self.capacity)
        at = np.arange(end - kept, end) % self.capacity
        turn = int(np.argmin(at))  # two runs: up to the end of the ring, and from its start
        for run in (slice(0, turn), slice(turn, kept)):
            if at[run].size:
                self._put(int(at[run][0]), pixels[len(pixels) - kept :][run])
        self._state[at] = np.where(usable[-kept:], SEEN, NOTHING)
        self.end = end
        self.start = max(self.start, end - self.capacity)
        if usable.any():
            if self._seen_end < first_line or not usable.all():
                self._fill()
            self._seen_end = end - int(np.argmax(usable[::-1]))
        return missing, late

    def _fill(self) -> None:
        """Close short gaps from the newest line that was known on."""
        first = max(self._seen_end - 1, self.start)
        line = first + np.flatnonzero(self._state[np.arange(first, self.end) % self.capacity] == SEEN)
        for before, after in pairwise(line.tolist()):
            n = after - before
            if not 1 < n <= LONGEST_FILLED + 1:
                continue
            a, b = (self._pixels[i % self.capacity].astype(np.float32) for i in (before, after))
            for i in range(1, n):
                self._pixels[(before + i) % self.capacity] = np.rint(a + (b - a) * (i / n))
            self._state[np.arange(before + 1, after) % self.capacity] = FILLED

    def _put(self, row: int, pixels: NDArray[np.unsignedinteger]) -> None:
        at = 0
        for first, end in self.lanes:
            self._pixels[row : row + len(pixels), at : at + end - first] = pixels[:, first:end]
            at += end - first

    def read(self, first_line: int, end_line: int, first_sample: int = 0, end_sample: int | None = None) -> Stretch:
        """Lines ``first_line .. end_line - 1`` as far as they are in the ring (a copy), perhaps some samples of them.

        Samples that are not kept are 0.
        """
        first, end = max(first_line, self.start), min(end_line, self.end)
        at = np.arange(first, max(end, first)) % self.capacity
        column, state = self._column[first_sample:end_sample], self._state[at]
        if len(column) and column[0] >= 0 and column[-1] - column[0] == len(column) - 1:
            pixels = self._pixels[at, column[0] : column[-1] + 1]
        else:
            pixels = self._pixels[at[:, None], column]
            pixels[:, column < 0] = 0
        return Stretch(first, pixels, state == SEEN, state == FILLED)

    def windows(
        self, first_line: IntArray, first_sample: IntArray, lines: int, samples: int
    ) -> tuple[NDArray[np.floating], NDArray[np.bool_], NDArray[np.bool_], NDArray[np.bool_]]:
        """Pieces of (lines, samples) pixels that begin at given pixels (k,), as 32-bit floats (k, lines, samples).

        Also which lines (k, lines) and samples (k, samples) are known - what is not known is arbitrary -, and which
        lines (k, lines) are known only from those around them.
        """
        line = first_line[:, None] + np.arange(lines)
        row = line % self.capacity
        state = self._state[row]
        lines_known = (line >= self.start) & (line < self.end) & (state != NOTHING)
        sample = first_sample[:, None] + np.arange(samples)
        column = self._column[np.clip(sample, 0, self.samples - 1)]
        samples_known = (sample >= 0) & (sample < self.samples) & (column >= 0)
        values = self._pixels[row[:, :, None], np.maximum(column, 0)[:, None, :]].astype(np.float32)
        return values, lines_known, samples_known, state == FILLED


class LineStore:
    """Rings for the CCD lines of a camera that together stay within a budget.

    If the budget holds all lines that are wanted, they are kept. If not, lanes of them are kept: `LANE` samples wide,
    evenly spread across the first CCD line, as many as go in; if fewer than `FEWEST_LANES` do, the rings are shortened.

    Parameters
    ----------
    samples : length of each CCD line
    lines : how many lines of each are wanted
    budget_bytes : all rings together take no more
    dtype : of the pixels
    counterpart : sample of each CCD line that sees what the first one sees at given samples, for lanes; None = the same

    Attributes
    ----------
    rings : by CCD line
    share : of the lines that are wanted in memory: 1, or less for rings that had to be shortened
    lanes : (l, 2) first and end sample of the lanes of the first CCD line; all of it where the budget suffices

    Raises
    ------
    ValueError : a budget that does not hold eight lines of each
    """

    def __init__(
        self,
        samples: Mapping[str, int],
        lines: Mapping[str, int],
        budget_bytes: int,
        dtype: np.dtype | type = np.uint16,
        counterpart: Mapping[str, NDArray[np.floating]] | None = None,
    ):
        item = np.dtype(dtype).itemsize
        leading = next(iter(samples))
        whole = sum(lines[ccd] * (samples[ccd] * item + 1) for ccd in samples)
        slice_bytes = sum(lines[ccd] * (LANE * item + 1) for ccd in samples)
        fitting = min(budget_bytes // slice_bytes if slice_bytes else 0, min(samples.values()) // LANE)
        kept: dict[str, IntArray | None] = dict.fromkeys(samples)
        self.share = 1.0
        if whole > budget_bytes and fitting >= 1 and min(samples.values()) >= FEWEST_LANES * LANE:
            number = max(int(fitting), FEWEST_LANES)
            self.share = min(1.0, budget_bytes / (number * slice_bytes))
            middle = (np.arange(number) + 0.5) * samples[leading] / number
            for ccd in samples:
                there = middle
                if counterpart is not None:
                    there = np.interp(middle, np.arange(samples[leading]), counterpart[ccd])
                kept[ccd] = _lanes(there, samples[ccd])
        elif whole > budget_bytes:
            self.share = budget_bytes / whole
        capacity = {ccd: int(lines[ccd] * self.share) for ccd in samples}
        if min(capacity.values(), default=0) < 8:
            raise ValueError(f"a budget of {budget_bytes} bytes for image lines is too small: {whole} are wanted")
        self.rings = {ccd: LineRing(samples[ccd], capacity[ccd], dtype, kept[ccd]) for ccd in samples}
        self.lanes = self.rings[leading].lanes

    @property
    def nbytes(self) -> int:
        return sum(ring.nbytes for ring in self.rings.values())

    @property
    def cover(self) -> float:
        """Share of the lines' width that is kept."""
        ring = next(iter(self.rings.values()))
        return float(np.diff(self.lanes, axis=1).sum() / ring.samples)

    def clear(self) -> None:
        """Forget all lines."""
        for ring in self.rings.values():
            ring.clear()


def _lanes(middle: NDArray[np.floating], samples: int) -> IntArray:
    """Lanes about given samples, pushed inside the line and apart."""
    first = np.clip(np.sort(np.rint(middle).astype(np.int64)) - LANE // 2, 0, samples - LANE)
    for i in range(1, len(first)):
        first[i] = max(first[i], first[i - 1] + LANE)
    for i in range(len(first) - 1, -1, -1):
        first[i] = min(first[i], samples - LANE * (len(first) - i))
    return np.stack([first, first + LANE], axis=1)
