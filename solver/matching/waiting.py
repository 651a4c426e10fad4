"""Places that wait for their looks: which of them can be matched in which view."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from .line_store import LineStore
from .looks import LookMatcher, Track
from .options import Place
from .prediction import PAD, Prediction
from .search import LEAST_SQUARES_HALF, MARGIN

Array = NDArray[np.floating]

#: A place waits no longer than this for its other looks once they should be there.
PATIENCE_S = 5.0
#: Ground may be lower than thought: places are looked at more closely so long before they are due, s.
SOON_S = 0.3
#: Looks that complete a point are matched together: at most so many; fewer than `ENOUGH` wait until lines of so many
#: seconds have come.
BATCH, FULL_BATCH, BATCH_S = 64, 12, 0.08
#: The others have time: so many at once, which wait for company so long.
EARLY_BATCH, EARLY_S = 12, 0.4
#: Places within so many lines lie beside each other.
ROW_LINES = 200


class WaitingRoom:
    """Keeps places until the next view of each has seen them.

    Parameters
    ----------
    prediction : of the strip
    looks : guesses heights

    Attributes
    ----------
    tracks : the places that wait
    order : the other views (numbers among them) in the order in which they see the ground
    """

    def __init__(self, prediction: Prediction, looks: LookMatcher):
        self.prediction, self._looks = prediction, looks
        self.counters: Counter[str] = Counter()
        self.tracks: list[Track] = []
        views, master = prediction.views, prediction.views[prediction.master]
        later = [master.forward - views[i].forward for i in prediction.others]
        self.order = sorted(range(len(later)), key=lambda j: later[j])
        self._early = [j for j in self.order if later[j] <= 0]
        self._matched_to = np.full(len(later), -np.inf)

    def clear(self) -> None:
        """A new strip begins."""
        self.tracks = []
        self._matched_to[:] = -np.inf

    def add(self, places: Sequence[Place]) -> None:
        """Places that wait from now on."""
        self.tracks += [Track(place, len(self.order)) for place in places]

    def thin(self, share: float) -> None:
        """Keep a share of the places, evenly; all of those that earlier strips have."""
        chosen = [track for track in self.tracks if not track.place.name]
        # neighbours follow each other: rows of cells, then across
        chosen.sort(key=lambda track: (track.tried.sum(), track.place.line // ROW_LINES, track.place.sample))
        kept = np.diff(np.floor(share * np.arange(len(chosen) + 1) + 0.5)) > 0
        left_out = {id(track) for track, keep in zip(chosen, kept, strict=True) if not keep}
        self.counters["left out by load"] += len(left_out)
        self.tracks = [track for track in self.tracks if id(track) not in left_out]

    def first_useful_line(self, store: LineStore, seeing: frozenset[str]) -> float:
        """Line of the master before which too few of the views that see have seen the ground: the strip began later."""
        p = self.prediction
        first = []
        for j in self.order:
            if p.views[p.others[j]].ccd not in seeing:
                continue
            ring, later = store.rings[p.views[p.others[j]].ccd], self._lines_later(j)
            first.append(ring.start - later if later < 0 else -np.inf)
        return sorted(first)[max(self._looks.least_rays - 2, 0)] if first else np.inf

    def forget_before(self, line: float) -> int:
        """Give up places of earlier lines in which nothing was looked for yet; how many there were."""
        kept = [track for track in self.tracks if track.place.line >= line or track.tried.any() or track.place.name]
        gone = len(self.tracks) - len(kept)
        self.tracks = kept
        return gone

    def due(self, store: LineStore) -> list[tuple[int, list[Track]]]:
        """Places whose next look is in store, with the view; they do not wait any more."""
        p = self.prediction
        if not self.tracks:
            return []
        ends = {view.ccd: store.rings[view.ccd].end for view in p.views}
        here = min(ends[p.views[p.master].ccd], p.known_lines)
        newest, gone = max(ends.values()), set()
        out = []
        for j in self.order:
            tracks = [track for track in self.tracks if track.next_view(self.order) == j]
            if not tracks:
                continue
            line = np.array([track.place.line for track in tracks])
            around = MARGIN + LEAST_SQUARES_HALF + PAD // 2 + p.lines_around(p.others[j])
            until = min(ends[p.views[p.others[j]].ccd], p.known_lines)
            looked_at = line + self._look_lines(tracks, j, until - around)
            ready = (line + around < here) & (looked_at + around < until)
            chosen = self._batch(j, np.flatnonzero(ready), line + around, here, until)
            if len(chosen):
                out.append((j, [tracks[i] for i in chosen]))
            overdue = ~ready & (np.maximum(line, looked_at) + around < newest - PATIENCE_S * p.rate)
            gone.update(id(tracks[i]) for i in np.flatnonzero(overdue))
            self.counters["looks never came"] += int(overdue.sum())
        gone.update(id(track) for _, tracks in out for track in tracks)
        self.tracks = [track for track in self.tracks if id(track) not in gone]
        return out

    def give_up(self, seeing: frozenset[str]) -> tuple[list[Track], list[Track]]:
        """Places that wait for a CCD line that sees nothing any more do without it; returned as by `settle`."""
        p = self.prediction
        dead = [j for j in self.order if p.views[p.others[j]].ccd not in seeing]
        waiting = [track for track in self.tracks if track.next_view(self.order) in dead] if dead else []
        if not waiting:
            return [], []
        for track in waiting:
            while track.next_view(self.order) in dead:
                track.tried[track.next_view(self.order)] = True
        gone = set(map(id, waiting))
        self.tracks = [track for track in self.tracks if id(track) not in gone]
        return self.settle(waiting)

    def settle(self, tracks: Sequence[Track]) -> tuple[list[Track], list[Track]]:
        """Places that were looked for: those that are through with all views, and lost ones; the rest waits on."""
        over, lost = [], []
        for track in tracks:
            if 1 + track.found.sum() + (~track.tried).sum() < self._looks.least_rays_of(track):
                lost.append(track)
            elif track.tried.all():
                over.append(track)
            else:
                self.tracks.append(track)
        return over, lost

    def _lines_later(self, j: int) -> float:
        """How many lines after the master a view sees the ground."""
        p = self.prediction
        p.height_and_travel()
        return float(p.lines_later(p.others[j], np.array([p.nadir_m]))[0])

    def _look_lines(self, tracks: list[Track], j: int, until: float) -> Array:
        """How many lines after the master a view sees places (k,): at their heights, as soon as that matters."""
        p = self.prediction
        later = np.full(len(tracks), self._lines_later(j))
        if later[0] <= 0:
            return later
        # ground may be lower than thought
        soon = [t for t, n in zip(tracks, later, strict=True) if t.place.line + n < until + SOON_S * p.rate]
        unknown = [track for track in soon if not track.found.any()]
        if unknown:
            self._looks.guess_heights(unknown)
        height = np.array([track.height_m for track in tracks])
        return np.where(np.isnan(height), later, p.lines_later(p.others[j], height))

    def _batch(self, j: int, ready: NDArray[np.intp], due: Array, here: float, until: float) -> NDArray[np.intp]:
        """Those of the ready places that are matched now; a batch shares one search, so they lie near each other."""
        p = self.prediction
        if not len(ready):
            return ready
        ready = ready[np.argsort(due[ready], kind="stable")]
        if j in self._early:
            waits = len(ready) < EARLY_BATCH and here - due[ready[0]] < EARLY_S * p.rate
            return ready[:0] if waits else ready[:EARLY_BATCH]
        if len(ready) < FULL_BATCH and until < self._matched_to[j] + BATCH_S * p.rate:
            return ready[:0]
        self._matched_to[j] = until
        return ready[:BATCH]
