"""Ties whose places are chosen in one view, the master: matched in the others as their looks come, then judged."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable

import numpy as np

from .chips import CHIP_HALF, ChipStore
from .consistency import Disagreement
from .ground_search import GroundSearch
from .line_intake import LineIntake
from .line_scan import LineScan
from .line_store import LineStore
from .looks import Looked, LookMatcher, Track
from .options import MatchedTie, MatchingOptions, Place
from .places import PlaceChooser
from .prediction import Prediction
from .search import LEAST_SQUARES_HALF, Image
from .seen_again import SeenAgain
from .waiting import PATIENCE_S, WaitingRoom

#: So many places in a row that are found in no other view: the ground is somewhere else. Tuned.
LOST = 40


class MasterView:
    """The ties of one strip that begin in one view.

    Parameters
    ----------
    prediction : of the strip, seen from this view
    options : see `MatchingOptions`
    image : gives the lines of a view: (index of the view, scan, way from line to line) -> `Image`
    chips : of earlier strips, and those of this one
    new_name : gives the name of the next tie point

    Attributes
    ----------
    counters : places by what became of them
    until : places are chosen in lines before this one; infinite while this is the master
    """

    def __init__(
        self,
        prediction: Prediction,
        options: MatchingOptions,
        image: Callable[[int, LineScan, float], Image],
        chips: ChipStore,
        new_name: Callable[[], str],
    ):
        self.prediction, self.counters = prediction, Counter[str]()
        self.chooser = PlaceChooser(options, 2 * LEAST_SQUARES_HALF + 1, len(prediction.others))
        self.waiting = WaitingRoom(
            prediction, looks := LookMatcher(prediction, image, CHIP_HALF if chips.budget else 0)
        )
        self.until = np.inf
        self._looks, self._chips, self._new_name = looks, chips, new_name
        self._again = SeenAgain(prediction, image, chips)
        self._ground = GroundSearch(prediction, looks)
        self._in_vain = 0
        self._strip, self._first = "", 0
        self._unjudged: list[Looked] = []

    @property
    def ccd(self) -> str:
        """Name of the CCD line."""
        return self.prediction.views[self.prediction.master].ccd

    @property
    def over(self) -> bool:
        """Whether nothing more is to be expected."""
        return np.isfinite(self.until) and not self.waiting.tracks

    @property
    def ground_missing(self) -> bool:
        """Whether the ground was looked for at all heights in vain, and is not known yet."""
        return self.prediction.heights.unknown and self._ground.in_vain

    def begin_strip(self, strip: str, first_line: int = 0) -> None:
        """Places are chosen from a line on; what waited is given up. The prediction is up to who made it."""
        self._strip = strip
        self._unjudged = []
        self.waiting.clear()
        self.chooser.begin_strip()
        self._again.begin_strip(strip)
        self._ground.begin_strip()
        self._in_vain = 0
        self.resume(first_line)

    def resume(self, first_line: int) -> None:
        """This is the master from a line on; what still waits goes on."""
        self._first, self.until = first_line, np.inf

    def lines_to_last_look(self, seeing: frozenset[str]) -> float:
        """How many lines after this view the last of those that see sees the ground."""
        p = self.prediction
        p.height_and_travel()
        ground = np.array([p.nadir_m])
        later = [float(p.lines_later(i, ground)[0]) for i in p.others if p.views[i].ccd in seeing]
        return max([0.0, *later])

    # -- matching ------------------------------------------------------------------------------------------------------

    def match(self, lines: LineIntake, store: LineStore, named: set[str]) -> list[MatchedTie]:
        """The tie points that have become known.

        Parameters
        ----------
        lines, store : of the strip
        named : points of earlier strips that have been found in this one; more are added
        """
        out: list[MatchedTie] = []
        seeing = self._looks.seeing = lines.seeing
        self._looks.sees_from = lines.sees_from
        if len(seeing) >= 2:
            out += self._settle(self.waiting.give_up(seeing))
        ring = store.rings[self.ccd]
        if ring.end < self.until and len(seeing) >= 2:
            begin = ring.start if self.prediction.heights.unknown else self.waiting.first_useful_line(store, seeing)
            first = max(begin, self._first)
            self.waiting.add(self.chooser.choose(ring, self.prediction.rate, first, lines.saturated))
        if self.prediction.heights.unknown and not self._find_ground(store, seeing):
            return out
        if np.isinf(self.until):
            self.waiting.add(self._new(self._again.find(max(ring.start, self._first), ring.end), named))
        for view, tracks in self.waiting.due(store):
            out += self._look(tracks, view)
        return out

    def _find_ground(self, store: LineStore, seeing: frozenset[str]) -> bool:
        """Look for the ground with the places that wait; whether it is known now."""
        waiting, p = self.waiting, self.prediction
        if len(seeing) < 2 or not self._ground.search(waiting.tracks, waiting.order, store):
            ring = store.rings[self.ccd]
            looked_for = ring.end - self._ground.lines_to_last_look(waiting.order) - PATIENCE_S * p.rate
            self.counters["ground not found"] += waiting.forget_before(max(looked_for, ring.start))
            return False
        p.heights_changed()
        waiting.forget_before(waiting.first_useful_line(store, seeing))
        self._in_vain = 0
        return True

    def take_counters(self) -> Counter[str]:
        """What was counted since the last call."""
        chooser, out = self.chooser, self.counters
        out["places"] += chooser.tried
        out["cells without texture"] += chooser.empty
        chooser.tried = chooser.empty = 0
        for part in (self._looks, self._again, self.waiting):
            out.update(part.counters)
            part.counters.clear()
        self.counters = Counter()
        return out

    @staticmethod
    def _new(places: list[Place], named: set[str]) -> list[Place]:
        """Places of points that were not found in this strip before, in whatever view."""
        new = [place for place in places if place.name not in named]
        named.update(place.name for place in new)
        return new

    def _look(self, tracks: list[Track], view: int) -> list[MatchedTie]:
        """Look for places in a view; the ties among those that are through with all views."""
        self._looks.look(tracks, view)
        self._in_vain = 0 if any(track.found.any() for track in tracks) else self._in_vain + len(tracks)
        if self._in_vain >= LOST:
            self.prediction.heights.lose(self.prediction.heights.lowest_m)
            self._in_vain = 0
        over, lost = self.waiting.settle(tracks)
        gone = set(map(id, lost))
        chosen = [track for track in tracks if not track.place.name]
        pixels = self.prediction.views[self.prediction.master].pixels
        across = 2 * np.array([t.place.sample for t in chosen]) / pixels - 1
        stage = self.waiting.order.index(view)
        self.chooser.density.judged(across, np.array([id(t) not in gone for t in chosen], dtype=bool), stage)
        return self._settle((over, lost))

    def _settle(self, settled: tuple[list[Track], list[Track]]) -> list[MatchedTie]:
        """The ties among places that are through with all views; the lost ones are counted."""
        over, lost = settled
        self.counters["too few looks"] += len(lost)
        looked = self._looks.finish(over) if over else None
        return self._judge(looked) if looked is not None else []

    def _judge(self, looked: Looked) -> list[MatchedTie]:
        self._unjudged.append(looked)
        p, parts = self.prediction, self._unjudged
        d = _joined(part.disagreement for part in parts)
        good = p.slow.judge(d)
        if good is None:
            return []
        self._unjudged = []
        # a view without a match is no contradiction, a point with a contradiction is dropped
        fine = (good | ~np.isfinite(d.residual).all(axis=2)).min(axis=1)
        self.counters["contradiction"] += int((~fine).sum())
        p.heights.add(np.concatenate([part.xyz_l for part in parts])[fine])
        distance = np.nanmax(np.hypot(*np.moveaxis(d.residual, 2, 0)), axis=1)
        ties, begin = [], 0
        for part in parts:
            index = np.flatnonzero(fine[begin : begin + len(part)])
            accepted = [self._tie(part, i, float(distance[begin + i])) for i in index.tolist()]
            begin += len(part)
            ties += accepted
            new = [i for i, tie in zip(index, accepted, strict=True) if not tie.again]
            if part.chip.size and new:
                names = [tie.name for tie in accepted if not tie.again]
                holes = None if part.holes is None else part.holes[new]
                ground = part.ground.select(np.array(new))
                self._chips.add(self._strip, names, part.chip[new], ground, part.score[new], holes)
        self.counters["ties"] += len(ties)
        self.counters["ties with earlier strips"] += sum(tie.again for tie in ties)
        return ties

    def _tie(self, looked: Looked, i: int, prediction_px: float) -> MatchedTie:
        name = looked.places[i].name
        return MatchedTie(
            name or self._new_name(), looked.rays[i], float(looked.score[i]), looked.xyz_l[i], prediction_px,
            bool(name),
        )  # fmt: skip


def _joined(parts: Iterable[Disagreement]) -> Disagreement:
    parts = list(parts)
    return Disagreement(*(np.concatenate([getattr(d, a) for d in parts]) for a in ("time_s", "across", "residual")))
