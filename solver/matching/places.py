"""Where tie points are tried: evenly across the image, more where matches fail, fewer where a window has enough."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from .interest_points import interest_point
from .line_store import LANE, LineRing
from .options import MatchingOptions, Place

Array = NDArray[np.floating]

#: Places are chosen so often, s, or in so many lines at least.
CHUNK_S, LEAST_CHUNK = 0.25, 8
#: Bands across the image whose success is followed, over so many seconds.
BANDS, MEMORY_S = 8, 10.0
#: At most so many places are tried for one tie point that is wanted; the share that succeeds before anything is known.
MOST_TRIED, FIRST_YIELD = 2.5, 0.5
#: The wanted density is changed within these factors by what the window holds.
LEAST_FACTOR, MOST_FACTOR = 0.2, 2.0
#: Ground is poor where less than this share of the cells has a place, over `POOR_S`; good again above the other.
POOR, RICH, POOR_S = 0.4, 0.6, 3.0


@dataclass
class Density:
    """How many places are tried, and where.

    Attributes
    ----------
    options : see `MatchingOptions`
    """

    options: MatchingOptions

    def __post_init__(self) -> None:
        self._tried = np.zeros(BANDS)
        self._tied = np.zeros(BANDS)
        self._factor = 1.0

    def forget(self) -> None:
        """A new strip begins."""
        self._tried[:] = self._tied[:] = 0.0

    def window_holds(self, points: int, rays: int) -> None:
        """What the adjustment's window holds: few points are given company, too many rays get fewer."""
        o = self.options
        few = min(o.window_points / max(points, 1), MOST_FACTOR)
        many = o.window_rays / max(rays, 1)
        self._factor = float(np.clip(min(max(few, 1.0), many), LEAST_FACTOR, MOST_FACTOR))

    def judged(self, across: Array, tied: NDArray[np.bool_]) -> None:
        """Places at -1 .. 1 across the image have become tie points, or not."""
        band = np.clip((across + 1) / 2 * BANDS, 0, BANDS - 1).astype(int)
        self._tried += np.bincount(band, minlength=BANDS)
        self._tied += np.bincount(band[tied], minlength=BANDS)

    @property
    def share(self) -> Array:
        """(BANDS,) share of the places that became tie points lately."""
        # as if a few had been tried before
        return (self._tied + 3 * FIRST_YIELD) / (self._tried + 3)

    def cells(self, seconds: float) -> tuple[int, Array]:
        """How many places are tried in so many seconds, and the borders (n + 1,) of their cells, 0 .. 1 across."""
        fade = np.exp(-seconds / MEMORY_S)
        self._tried *= fade
        self._tied *= fade
        tries = np.minimum(1.0 / self.share, MOST_TRIED)
        number = self.options.points_per_s * self._factor * seconds * float(tries.mean())
        n = max(round(number), 1)
        sums = np.concatenate([[0.0], np.cumsum(tries)]) / tries.sum()
        return n, np.interp(np.linspace(0, 1, n + 1), sums, np.linspace(0, 1, BANDS + 1))


class PlaceChooser:
    """Goes along the master's lines and chooses places to be matched.

    Parameters
    ----------
    options : see `MatchingOptions`
    window : side of the matching window, px
    """

    def __init__(self, options: MatchingOptions, window: int):
        self.density = Density(options)
        self._options, self._window = options, window
        self._next = 0
        self._found_share = 1.0
        self._poor = False
        self.tried = self.empty = 0

    def begin_strip(self) -> None:
        """Lines begin anew."""
        self._next = 0
        self.density.forget()

    def choose(self, ring: LineRing, rate_hz: float) -> list[Place]:
        """Places in the lines that have come, as many as go into whole chunks."""
        rows = max(round(CHUNK_S * rate_hz), LEAST_CHUNK)
        half = self._window // 2 + 2
        self._next = max(self._next, ring.start)
        places = []
        while self._next + rows + half <= ring.end:
            found, cells = self._chunk(ring, self._next, rows, half, rows / rate_hz)
            places += found
            self.tried += len(found)
            self.empty += cells - len(found)
            # black or missing lines say nothing about the ground
            if ring.read(self._next, self._next + rows, 0, 1).usable.mean() > 0.5:
                keep = np.exp(-rows / rate_hz / POOR_S)
                self._found_share = keep * self._found_share + (1 - keep) * len(found) / max(cells, 1)
            self._next += rows
        return places

    def _chunk(self, ring: LineRing, first: int, rows: int, half: int, seconds: float) -> tuple[list[Place], int]:
        n, borders = self.density.cells(seconds)
        if (first // rows) % 2:  # every other row of cells is shifted by half a cell
            borders = np.clip(borders + 0.5 / n, 0, 1)
            borders = np.unique(np.concatenate([[0.0], borders]))
        found = []
        cells = _cells(borders, ring)
        for left, right in cells:
            stretch = ring.read(first - half, first + rows + half, max(left - half, 0), right + half)
            best = interest_point(
                stretch.pixels.astype(np.float32), stretch.usable, self._window, self._options.largest_sigma_px
            )
            if best is not None:
                found.append(Place(float(stretch.first_line + best[0]), float(max(left - half, 0) + best[1])))
        return found, len(cells)

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
