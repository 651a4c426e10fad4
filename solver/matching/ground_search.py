"""The search for the ground where nobody says how high it is: places are matched as if it were at many heights.

A search reaches so many pixels, which is a range of heights. The ranges follow one another from the lowest ground that
is thought possible to near the platform. The one that is tried first has the height that the ground is taken for; the
others follow outward from it. The first in which a good part of the places is found has the ground: the places found
are the first heights that are known.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from .line_store import LineStore
from .looks import LookMatcher, Track
from .prediction import PAD, Prediction
from .search import COARSEST, CORRELATION_HALF
from .waiting import PATIENCE_S

Array = NDArray[np.floating]

#: So many places are looked for together, and so many at least; tuned.
TOGETHER, FEWEST = 20, 10
#: The ground is found where this share of them is, but no fewer than so many; tuned: 1 in 100 is found elsewhere.
SHARE, LEAST_FOUND = 0.34, 5
#: Neighbouring ranges of heights overlap by this share of a range.
OVERLAP = 0.25
#: The ground is no nearer than this share of the distance to the lowest one.
NEAREST = 0.12
#: Lines that a template at the coarsest level covers about its place, with those that vibration takes.
AROUND = CORRELATION_HALF * COARSEST + PAD
#: Platform time between two searches, s, and heights that a later one tries: the first one tries them all.
EVERY_S, LATER = 0.5, 10


class GroundSearch:
    """Looks for the ground.

    Parameters
    ----------
    prediction : of the strip
    looks : matches places

    Attributes
    ----------
    in_vain : all heights have had places that both views saw, and the ground was at none of them
    """

    def __init__(self, prediction: Prediction, looks: LookMatcher) -> None:
        self.prediction, self._looks = prediction, looks
        self.begin_strip()

    def begin_strip(self) -> None:
        """Lines begin anew."""
        self._next = 0.0
        self._number = 0
        self._begun = self.in_vain = False
        self._first = np.inf

    def search(self, tracks: Sequence[Track], order: Sequence[int], store: LineStore) -> bool:
        """Match places (that have not been looked for) at many heights; whether the ground was found.

        What was found is added to the heights of the prediction.

        Parameters
        ----------
        order : the other views (numbers among them) in the order in which they see the ground
        """
        p = self.prediction
        ring = store.rings[p.views[p.master].ccd]
        end = min(ring.end, p.known_lines)
        if end < self._next:
            return False
        fresh = [t for t in tracks if not t.tried.any() and ring.start + AROUND <= t.place.line < end - AROUND]
        view = next((j for j in order if p.views[p.others[j]].ccd in self._looks.seeing), -1)
        if len(fresh) < FEWEST or view < 0:
            return False
        self._next = end + EVERY_S * p.rate
        # the lines that see the lowest ground are the furthest from those of the master
        away = abs(float(p.lines_later(p.others[view], np.array([p.heights.lowest_m]))[0])) + 2 * AROUND
        self._first = min(self._first, end)
        heights = self._heights(view)
        if self._begun:
            turn = np.arange(self._number, self._number + min(LATER, len(heights))) % len(heights)
            self._number = int(turn[-1]) + 1
            heights = heights[turn]
        self._begun = True
        for height in heights.tolist():
            found = self._found_at(height, fresh, view, store)
            if found is not None:
                p.heights.found(found)
                self._first = np.inf
                return True
        self.in_vain = end - self._first > away + PATIENCE_S * p.rate
        return False

    def lines_to_last_look(self, order: Sequence[int]) -> float:
        """How many lines after the master the view in which the ground is looked for sees the lowest ground."""
        p = self.prediction
        view = next((j for j in order if p.views[p.others[j]].ccd in self._looks.seeing), -1)
        later = 0.0 if view < 0 else float(p.lines_later(p.others[view], np.array([p.heights.lowest_m]))[0])
        return max(later, 0.0)

    def _heights(self, view: int) -> Array:
        """Heights that are tried, the likeliest first."""
        p = self.prediction
        platform = p.platform_m
        ahead = abs(p.views[p.master].forward - p.views[p.others[view]].forward)
        master = p.views[p.master]
        share = 2 * (1 - OVERLAP) * p.options.largest_reach_px * master.pitch_mm / master.focal_length_mm
        ratio = 1.0 + share / max(ahead, 1e-3)
        likely = max(platform - p.heights.prior_m, 1.0)
        most = max(platform - p.heights.lowest_m, likely)
        lower = int(np.ceil(np.log(most / likely) / np.log(ratio)))
        higher = int(np.ceil(np.log(likely / (NEAREST * most)) / np.log(ratio))) if likely > NEAREST * most else 0
        steps = np.arange(-higher, lower + 1)
        return platform - likely * ratio ** steps[np.argsort(np.abs(steps), kind="stable")]

    def _found_at(self, height: float, tracks: Sequence[Track], view: int, store: LineStore) -> Array | None:
        """Points (n, 3) if the ground is about so high, None if it is not or nobody can tell."""
        p = self.prediction
        index = p.others[view]
        other = store.rings[p.views[index].ccd]
        look = np.array([t.place.line for t in tracks]) + p.lines_later(index, np.array([height]))[0]
        ready = (look - AROUND >= other.start) & (look + AROUND < min(other.end, p.known_lines))
        some = [t for t, r in zip(tracks, ready, strict=True) if r]
        if len(some) < FEWEST:
            return None
        some = [some[i] for i in np.linspace(0, len(some) - 1, min(TOGETHER, len(some))).astype(int)]
        points, _ = self._looks.try_height(some, view, height)
        return points if len(points) >= max(LEAST_FOUND, SHARE * len(some)) else None
