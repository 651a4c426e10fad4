"""Points of earlier strips, found again in the lines of a later one."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from .chips import ChipStore, StripChips
from .consistency import Disagreement
from .line_scan import LineScan
from .looks import verdict
from .options import Place
from .places import CHUNK_S, LEAST_CHUNK
from .prediction import WIDE, Prediction, sample_m
from .search import CORRELATION_HALF, REACH_PX, Image, TurnedImage, coarsest_factor, find

Array = NDArray[np.floating]

#: Cells across the image; each gets one point of an earlier strip in every chunk of lines at most.
CELLS = 12
#: How far a point is searched before other points of its strip tell where, and then, px; the chips reach no further.
FIRST_REACH, LATER_REACH = 40.0, 6.0
#: Matches that wait for company longer than this are given up, s.
PATIENCE_S = 4.0


class SeenAgain:
    """Finds chips in the master view of a later strip.

    Parameters
    ----------
    prediction : of the strip
    image : gives the lines of the master: (index of the view, scan, way from line to line) -> `Image`
    chips : of earlier strips
    """

    def __init__(self, prediction: Prediction, image: Callable[[int, LineScan, float], Image], chips: ChipStore):
        self.prediction, self.chips = prediction, chips
        self.counters: Counter[str] = Counter()
        self._image = image
        self._strip = ""
        self._next = 0

    def begin_strip(self, strip: str) -> None:
        """Lines begin anew."""
        self._strip, self._next = strip, 0
        for chips in self.chips.strips.values():
            chips.slow.forget()
            chips.waiting.clear()

    def find(self, start: int, end: int) -> list[Place]:
        """Places of earlier points in the master's lines from ``start`` on, as far as lines and orientation go."""
        p = self.prediction
        rows = max(round(CHUNK_S * p.rate), LEAST_CHUNK)
        around = int((CORRELATION_HALF + REACH_PX + 2) * coarsest_factor(FIRST_REACH))
        ready = min(end, p.known_lines) - around
        self._next = max(self._next, start)
        others = [(name, s) for name, s in self.chips.strips.items() if name != self._strip and len(s)]
        places: list[Place] = []
        while self._next + rows <= ready:
            first = self._next
            self._next += rows
            if others:
                scan = p.scan(p.master, first - WIDE, first + rows + WIDE)
                for _, strip in others:
                    if scan is not None:
                        places += self._in_chunk(strip, scan, first, rows)
        return places

    def _in_chunk(self, strip: StripChips, scan: LineScan, first: int, rows: int) -> list[Place]:
        p = self.prediction
        line, sample, chosen = _visible(strip, scan, first, rows)
        if not len(chosen):
            return []
        ground, (_, travel) = strip.ground(chosen), p.height_and_travel()
        time_s, across = p.times.time_of(line), 2 * sample / scan.view.pixels - 1
        expected = strip.slow.expected(time_s, across)[:, 0]
        here = p.ground(scan, ground.centre_l)
        turn = np.array([[a @ b for b in (strip.along, strip.across)] for a in (here.along, here.across)])
        reach = FIRST_REACH
        if strip.slow.known:
            scale = strip.slow.scale_px
            reach = float(np.clip(3 * np.where(np.isfinite(scale), scale, FIRST_REACH).max(), LATER_REACH, FIRST_REACH))
        # along a grid's rows the lines of this strip lie in another direction: each patch finds its own
        image = TurnedImage(self._image(p.master, scan, travel), here.along)
        found = find(strip.chips(chosen), line, ground, image, expected, line, reach)
        reason = verdict(found, p.options)
        good = reason == ""
        self.counters["earlier points tried"] += len(chosen)
        self.counters["earlier points not found"] += int((~good).sum())
        place_l = ground.moved(np.where(good[:, None], found.shift, 0.0)).centre_l
        u, v, inside = scan.locate(place_l, line)
        good &= inside
        if not good.any():
            return []
        px = strip.spacing_m / np.array([travel, sample_m(scan, place_l, line)])
        variance = np.einsum("ij,kjl,il->ki", turn, found.covariance[good], turn) * px**2 / 2
        variance += 0.5 * p.options.image_sigma_px**2
        places = [
            Place(float(a), float(b), strip.names[i], (float(w[0]), float(w[1])))
            for i, a, b, w in zip(chosen[good], u[good], v[good], variance, strict=True)
        ]
        return self._judged(strip, places, Disagreement(time_s[good], across[good], found.shift[good][:, None]))

    def _judged(self, strip: StripChips, places: list[Place], new: Disagreement) -> list[Place]:
        """Places that agree with the others of their strip."""
        strip.waiting = [w for w in strip.waiting if w[0].time_s.max() > new.time_s.max() - PATIENCE_S]
        strip.waiting.append((new, places))
        together = Disagreement(
            *(np.concatenate([getattr(d, a) for d, _ in strip.waiting]) for a in ("time_s", "across", "residual"))
        )
        places = [place for _, waiting in strip.waiting for place in waiting]
        agrees = strip.slow.judge(together)
        if agrees is None:
            return []
        strip.waiting.clear()
        fine = np.asarray(agrees.all(axis=1))
        self.counters["contradiction between strips"] += int((~fine).sum())
        return [place for place, ok in zip(places, fine, strict=True) if ok]


def _visible(strip: StripChips, scan: LineScan, first: int, rows: int) -> tuple[Array, Array, NDArray[np.int64]]:
    """Line and sample of chips that the lines see, one a cell, and which chips they are."""
    middle = len(scan.position_l) // 2
    pixels = scan.view.pixels
    ends, _ = scan.to_plane(
        np.full(2, scan.first_line + middle), np.array([0.0, pixels - 1.0]), np.full(2, float(strip.xyz_l[:, 2].mean()))
    )
    centre, reach = ends.mean(axis=0)[:2], 0.75 * np.linalg.norm(np.diff(ends[:, :2], axis=0))
    near = np.flatnonzero(np.hypot(*(strip.xyz_l[:, :2] - centre).T) < reach)
    if not len(near):
        return np.empty(0), np.empty(0), near
    line, sample, inside = scan.locate(strip.xyz_l[near], np.full(len(near), float(first + rows // 2)), rounds=6)
    inside &= (line >= first) & (line < first + rows) & (sample > 12) & (sample < pixels - 13)
    near, line, sample = near[inside], line[inside], sample[inside]
    order = np.lexsort((-strip.score[near], (sample * CELLS / pixels).astype(int)))
    best = order[np.flatnonzero(np.diff((sample * CELLS / pixels).astype(int)[order], prepend=-1))]
    return line[best], sample[best], near[best]
