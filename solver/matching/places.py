"""Where tie points are tried: evenly across the image, more where matches fail, fewer where a window has enough."""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from .interest_points import interest_point
from .line_store import LANE, LineRing
from .options import MatchingOptions, Place

Array = NDArray[np.floating]

#: Places are chosen so often, s, or in so many lines at least.
CHUNK_S, LEAST_CHUNK = 0.25, 8
#: Cells are gone through in this share of the time in which the next chunk comes.
PROMPT = 0.8
#: Bands across the image whose success is followed, over so many seconds.
BANDS, MEMORY_S = 8, 10.0
#: At most so many places are tried for one tie point that is wanted; the share that succeeds before anything is known.
MOST_TRIED, FIRST_YIELD = 2.5, 0.5
#: The wanted density is changed within these factors by what the window holds; what comes within so many seconds
#: anyway is as good as there: without that, a strip with many points would begin with twice as many as it needs.
LEAST_FACTOR, MOST_FACTOR, SOON_S = 0.2, 2.0, 2.0
#: Two places are so much of the matching window apart at least, along or across: what lies on the border of two cells
#: would be the best of both. Errors at one place are the same (correlation 0.98; 0.5 at 5 px, 0.2 at 10, 0.05 at 16).
APART = 0.75
#: Ground is poor where less than this share of the cells has a place, over `POOR_S`; good again above the other.
POOR, RICH, POOR_S = 0.4, 0.6, 3.0


@dataclass
class Density:
    """How many places are tried, and where.

    Attributes
    ----------
    options : see `MatchingOptions`
    stages : views in which a place is looked for, one after another
    load : share of the places that are tried, as far as the machine keeps up
    """

    options: MatchingOptions
    stages: int = 1
    load: float = 1.0

    def __post_init__(self) -> None:
        self._tried = np.zeros((self.stages, BANDS))
        self._left = np.zeros((self.stages, BANDS))
        self._factor = 1.0

    def forget(self) -> None:
        """A new strip begins."""
        self._tried[:] = self._left[:] = 0.0

    def like(self, other: Density) -> None:
        """As many places as another density has wanted lately."""
        self.load, self._factor = other.load, other._factor

    def window_holds(self, points: int, rays: int) -> None:
        """What the adjustment's window holds: few points are given company, too many rays get fewer."""
        o = self.options
        few = min(o.window_points / (points + SOON_S * o.points_per_s), MOST_FACTOR)
        many = o.window_rays / max(rays, 1)
        self._factor = float(np.clip(min(max(few, 1.0), many), LEAST_FACTOR, MOST_FACTOR))

    def judged(self, across: Array, left: NDArray[np.bool_], stage: int = 0) -> None:
        """Places at -1 .. 1 across the image were looked for in a view; some can still become tie points."""
        band = np.clip((across + 1) / 2 * BANDS, 0, BANDS - 1).astype(int)
        self._tried[stage] += np.bincount(band, minlength=BANDS)
        self._left[stage] += np.bincount(band[left], minlength=BANDS)

    @property
    def share(self) -> Array:
        """(BANDS,) share of the places that become tie points."""
        # as if a few had been tried before
        first = FIRST_YIELD ** (1.0 / self.stages)
        return ((self._left + 3 * first) / (self._tried + 3)).prod(axis=0)

    def cells(self, seconds: float) -> tuple[int, Array]:
        """How many places are tried in so many seconds, and the borders (n + 1,) of their cells, 0 .. 1 across."""
        fade = np.exp(-seconds / MEMORY_S)
        self._tried *= fade
        self._left *= fade
        tries = np.minimum(1.0 / self.share, MOST_TRIED)
        number = self.options.points_per_s * self._factor * self.load * seconds * float(tries.mean())
        n = max(round(number), 1 if self.load else 0)
        sums = np.concatenate([[0.0], np.cumsum(tries)]) / tries.sum()
        return n, np.interp(np.linspace(0, 1, n + 1), sums, np.linspace(0, 1, BANDS + 1))


@dataclass
class _Chunk:
    """Lines from ``first`` on, and the cells (first and end sample) in which no place has been chosen yet."""

    first: int
    number: int
    done: int
    cells: list[tuple[int, int]] = field(default_factory=list)
    found: int = 0


class PlaceChooser:
    """Goes along the master's lines and chooses places to be matched.

    Parameters
    ----------
    options : see `MatchingOptions`
    window : side of the matching window, px
    stages : views in which a place is looked for
    """

    def __init__(self, options: MatchingOptions, window: int, stages: int):
        self.density = Density(options, stages)
        self._options, self._window = options, window
        self._next = 0
        self._chunk = _Chunk(0, 0, 0)
        self._apart = round(APART * window)
        self._chosen: list[tuple[int, int]] = []  # line and sample of places, as far back as they are near new ones
        self._found_share = 1.0
        self._poor = False
        self.tried = self.empty = 0

    def begin_strip(self) -> None:
        """Lines begin anew."""
        self._next = 0
        self._chunk = _Chunk(0, 0, 0)
        self._chosen.clear()
        self.density.forget()

    def choose(self, ring: LineRing, rate_hz: float, first_line: float = 0.0, saturated: float = np.inf) -> list[Place]:
        """Places in the lines that have come.

        Lines are gone through in chunks, and the cells of a chunk while the lines of the next one come: so the work is
        spread evenly.

        Parameters
        ----------
        first_line : places before it are of no use
        saturated : grey value from which on pixels are saturated
        """
        rows = max(round(CHUNK_S * rate_hz), LEAST_CHUNK)
        half = self._window // 2 + 2
        self._next = max(self._next, ring.start, int(max(first_line, 0.0)))
        places: list[Place] = []
        while True:
            chunk = self._chunk
            if chunk.cells:
                come = (ring.end - chunk.first - rows - half + 1) / (PROMPT * rows)
                while chunk.cells and chunk.done < come * chunk.number:
                    places += self._best(ring, chunk, rows, half, saturated)
            if chunk.cells or self._next + rows + half > ring.end:
                return places
            if chunk.number:
                # black or missing lines say nothing about the ground
                seen = ring.read(chunk.first, chunk.first + rows, 0, 1).usable
                self._count(chunk, rows / rate_hz, seen.mean() > 0.5 if len(seen) else False)
            self._chunk = self._divide(ring, self._next, rows / rate_hz, rows)
            self._next += rows

    def _divide(self, ring: LineRing, first: int, seconds: float, rows: int) -> _Chunk:
        n, borders = self.density.cells(seconds)
        if not n:
            return _Chunk(first, 0, 0)
        if (first // rows) % 2:  # every other row of cells is shifted by half a cell
            borders = np.clip(borders + 0.5 / n, 0, 1)
            borders = np.unique(np.concatenate([[0.0], borders]))
        cells = _cells(borders, ring)
        return _Chunk(first, len(cells), 0, cells)

    def _best(self, ring: LineRing, chunk: _Chunk, rows: int, half: int, saturated: float) -> list[Place]:
        """The best place of the next cell, if there is a good one."""
        left, right = chunk.cells.pop(0)
        chunk.done += 1
        stretch = ring.read(chunk.first - half, chunk.first + rows + half, max(left - half, 0), right + half)
        largest, begin = self._options.largest_sigma_px, max(left - half, 0)
        free = self._free(stretch.first_line, begin, stretch.pixels.shape)
        image = stretch.pixels.astype(np.float32)
        best = interest_point(image, stretch.usable, self._window, largest, free, stretch.filled, saturated)
        if best is None:
            return []
        chunk.found += 1
        line, sample = stretch.first_line + best[0], begin + best[1]
        self._chosen.append((line, sample))
        return [Place(float(line), float(sample))]

    def _free(self, first_line: int, first_sample: int, shape: tuple[int, ...]) -> NDArray[np.bool_]:
        """Where in a stretch no place is near."""
        apart = self._apart
        self._chosen = [place for place in self._chosen if place[0] > first_line - apart]
        free = np.ones(shape, dtype=bool)
        for line, sample in self._chosen:
            u, v = line - first_line, sample - first_sample
            if v > -apart:
                free[max(u - apart + 1, 0) : max(u + apart, 0), max(v - apart + 1, 0) : v + apart] = False
        return free

    def _count(self, chunk: _Chunk, seconds: float, seen: bool) -> None:
        self.tried += chunk.found
        self.empty += chunk.number - chunk.found
        if not seen:
            return
        keep = np.exp(-seconds / POOR_S)
        self._found_share = keep * self._found_share + (1 - keep) * chunk.found / max(chunk.number, 1)

    def news(self) -> str:
        """One line where the ground becomes poor in texture, or has some again; else empty."""
        poor = self._found_share < (RICH if self._poor else POOR)
        if poor == self._poor:
            return ""
        self._poor = poor
        return "the ground is poor in texture: few tie points" if poor else "the ground has texture again"


def _cells(borders: Array, ring: LineRing) -> list[tuple[int, int]]:
    """First and end sample of cells; of a ring with lanes, in the middles of these."""
    if len(ring.lanes) == 1:
        edges = np.rint(borders * ring.samples).astype(int)
        return [(int(a), int(b)) for a, b in pairwise(edges) if b > a]
    n = len(borders) - 1
    # places keep a search away from the borders of a lane
    margin = 5 * LANE // 16
    in_lane = np.array_split(np.arange(n), len(ring.lanes)) if n >= len(ring.lanes) else [[0]] * len(ring.lanes)
    out = []
    for (first, end), cells in zip(ring.lanes, in_lane, strict=True):
        edges = np.linspace(first + margin, end - margin, len(cells) + 1).astype(int)
        out += [(int(a), int(b)) for a, b in pairwise(edges)]
    if n < len(ring.lanes):  # some of the lanes, evenly
        out = [out[i] for i in np.linspace(0, len(out) - 1, n).round().astype(int)]
    return out
