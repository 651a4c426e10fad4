"""The places of one strip, looked for in the lines of another one as far as these have come."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from .consistency import Disagreement
from .ground_search import AROUND, FEWEST, LEAST_FOUND, SHARE, TOGETHER
from .kept_strip import StripView
from .line_scan import LineScan
from .looks import Looked, LookMatcher, Track
from .options import MatchedRay, MatchedTie, MatchingOptions, Place
from .pair_prediction import PairPrediction
from .prediction import PAD, WIDE
from .round_earth import RoundHeights
from .search import LEAST_SQUARES_HALF, MARGIN, TurnedImage
from .waiting import BATCH

Array = NDArray[np.floating]

#: Sigma of a match, px, as it is without the floor. Tuned: the median of simulated ones.
MATCH_SIGMA_PX = 0.03


def lone_sigma_px(options: MatchingOptions) -> float:
    """Standard deviation of the line and the sample of a place before anything is matched with it, px: half of the
    variance of a usual match, of which the other half is that of the later look."""
    return float(np.sqrt(0.5 * (MATCH_SIGMA_PX**2 + options.image_sigma_px**2)))


@dataclass(eq=False)
class Master:
    """A view in which places were chosen, with the names of those that have become points.

    Attributes
    ----------
    view : of a strip
    name : first part of the names of its points
    places : as they were chosen; more come while its strip is taken
    names : of places that are points, by their number
    told_px : sigma of their lines and samples, px, where they are told before they are matched; else infinity
    """

    view: StripView
    name: str
    places: list[Place] = field(default_factory=list)
    names: dict[int, str] = field(default_factory=dict)
    told_px: float = np.inf

    def point(self, number: int) -> str:
        """The name of a place, from now on a point."""
        if number not in self.names:
            self.view.strip.points += 1
            self.names[number] = f"{self.name}-M{self.view.strip.points}"
        return self.names[number]


class StripPair:
    """Looks for the places of a master in another view; lines of the later of the two strips may still come.

    Parameters
    ----------
    master, view : the places, and where they are looked for
    late : which of the two (0, 1) was flown later
    options, heights : see `PairPrediction`

    Attributes
    ----------
    counters : places by what became of them
    events : what is worth telling
    """

    def __init__(
        self, master: Master, view: StripView, late: int, options: MatchingOptions, heights: RoundHeights
    ) -> None:
        self.master, self.view = master, view
        self.counters: Counter[str] = Counter()
        self.events: list[str] = []
        self._views, self._late, self._options = (master.view, view), late, options
        self._heights = heights
        self._prediction = PairPrediction(self._views, late, options, heights)
        self._looks = LookMatcher(self._prediction, self._image, 0)
        self._decided: NDArray[np.bool_] = np.zeros(0, dtype=bool)  # places of which nothing more is to be asked
        self._done_to = -np.inf  # looks in lines of the later strip before this one have been matched
        self._begun = self._found = False
        self._wanted = TOGETHER  # so many places are waited for before the ground is looked for
        self._waiting: list[tuple[int, Looked, int]] = []  # found places that are too few to be judged

    def seen(self) -> tuple[NDArray[np.intp], Array]:
        """Numbers (n,) of the places that the view sees, about, and that have not been looked for; and the line and
        sample (n, 2) of the later strip that see each."""
        p, places = self._prediction, self.master.places
        self._decided = np.append(self._decided, np.zeros(len(places) - len(self._decided), dtype=bool))
        fresh = np.flatnonzero(~self._decided)
        if not len(fresh):
            return fresh, np.empty((0, 2))
        own = np.array([[places[i].line, places[i].sample] for i in fresh])
        p.renew(own[:, 0].min() if self._late == 0 else self._done_to - WIDE)
        located = p.seen([places[i] for i in fresh])
        sees = np.isfinite(located[:, 0])
        return fresh[sees], own[sees] if self._late == 0 else located[sees]

    def match(self) -> list[MatchedTie]:
        """Look for the places that have been seen since the last time; the ties and later looks that follow."""
        numbers, at = self._ready()
        out: list[MatchedTie] = []
        if len(numbers) and self._is_found(numbers, at):
            numbers, at = self._ready()  # the ground may have been found at another height
            for part in _batches(at[:, 0], numbers, middle_first=not self._begun):
                out += self._look(part)
            self._begun = True
        if self._found or not len(numbers):
            self._done_to = max(self._done_to, self._ready_to)
        if self._over:
            self.counters["too few looks"] += len(self._waiting)
            self._waiting.clear()
        self.counters.update(self._looks.counters)
        self._looks.counters.clear()
        return out

    @property
    def _over(self) -> bool:
        return self._views[self._late].strip.over

    @property
    def _ready_to(self) -> float:
        """Looks in lines of the later strip before this one have all lines around them."""
        around = MARGIN + LEAST_SQUARES_HALF + PAD // 2 + self._prediction.lines_around(1)
        return np.inf if self._over else self._views[self._late].known_to - around

    def _ready(self) -> tuple[NDArray[np.intp], Array]:
        numbers, at = self.seen()
        ready = at[:, 0] < self._ready_to
        return numbers[ready], at[ready]

    def _image(self, index: int, scan: LineScan, travel: float) -> TurnedImage:
        return self._views[index].image(scan, travel / self._views[0].ground_share)

    def _look(self, numbers: list[int]) -> list[MatchedTie]:
        """Look for some places; the ties that follow, also of places that were found before."""
        self._decided[numbers] = True
        tracks = {number: Track(self.master.places[number], 1) for number in numbers}
        self._looks.look(list(tracks.values()), 0)
        found = [i for i in numbers if tracks[i].found[0]]
        looked = self._looks.finish([tracks[i] for i in found]) if found else None
        if looked is None:
            return []
        self._waiting += [(number, looked, k) for k, number in enumerate(found)]
        return self._judged()

    def _judged(self) -> list[MatchedTie]:
        """Looks that agree with their neighbours become ties; while there are too few to tell, they wait."""
        p, waiting = self._prediction, self._waiting
        parts = [looked.disagreement.select([k]) for _, looked, k in waiting]
        together = Disagreement(
            *(np.concatenate([getattr(d, a) for d in parts]) for a in ("time_s", "across", "residual"))
        )
        good = p.slow.judge(together)
        if good is None:
            return []
        fine = good[:, 0]
        self.counters["contradiction"] += int((~fine).sum())
        out: list[MatchedTie] = []
        strips = [view.strip.id for view in self._views]
        for (number, looked, k), ok, left in zip(waiting, fine, together.residual[:, 0], strict=True):
            if not ok:
                continue
            known = number in self.master.names
            rays = tuple(replace(ray, strip=id) for ray, id in zip(looked.rays[k], strips, strict=True))
            score, off = float(looked.score[k]), float(np.hypot(*left))
            rays = self._later(*rays) if known else rays
            out.append(MatchedTie(self.master.point(number), rays, score, looked.xyz_l[k], off, known))
        places = [looked.xyz_l[k] for (_, looked, k), ok in zip(waiting, fine, strict=True) if ok]
        p.heights.add(np.reshape(places, (-1, 3)))
        self.counters["ties"] += sum(not tie.again for tie in out)
        self.counters["later looks"] += sum(tie.again for tie in out)
        waiting.clear()
        return out

    def _later(self, place: MatchedRay, look: MatchedRay) -> tuple[MatchedRay]:
        """The later look alone, with the variance of the match that its place was not told to have."""
        more = max(place.sigma_line, place.sigma_sample) ** 2 - self.master.told_px**2
        if more <= 0.0:
            return (look,)
        line, sample = (float(np.sqrt(sigma**2 + more)) for sigma in (look.sigma_line, look.sigma_sample))
        return (replace(look, sigma_line=line, sigma_sample=sample),)

    # -- where the view lies, and the ground ---------------------------------------------------------------------------

    def _is_found(self, numbers: NDArray[np.intp], at: Array) -> bool:
        """Whether it is known how high the ground is, and where the view lies as far as searches reach; else look.

        Where it is not found it is looked for again once twice as many places have been seen, and when the strip is
        over.
        """
        p = self._prediction
        if self._found:
            return True
        if not p.tells_heights([self.master.places[number] for number in numbers.tolist()]):
            p.heights = replace(self._heights)  # others are not to take what it finds for the ground
        shifts = p.beside(along_too=True)
        if p.heights.some and len(shifts) == 1:
            self._found = True
            return True
        if len(numbers) < self._wanted and not self._over:
            return False
        tracks = [Track(self.master.places[number], 1) for number in numbers.tolist()]
        some = _some(tracks, self._inner(tracks, at, AROUND))
        self._found = self._find_view(some, shifts) if p.heights.some else self._find_ground(some)
        self._wanted = 2 * len(numbers)
        if self._over and not self._found:
            self._decided[numbers] = True
            with_lines = int(self._inner(tracks, at, MARGIN + LEAST_SQUARES_HALF).sum())
            self.counters["ground not found"] += with_lines
            self.counters["no lines"] += len(numbers) - with_lines
        return self._found

    def _inner(self, tracks: list[Track], at: Array, around: int) -> NDArray[np.bool_]:
        """Which places (n,) have so many lines around them, in their own strip and in the later one as `seen` says."""
        own = np.array([track.place.line for track in tracks])
        good = np.ones(len(tracks), dtype=bool)
        for view, line in ((self._views[0], own), (self._views[self._late], at[:, 0])):
            assert view.ring is not None
            good &= (line >= view.ring.start + around) & (line < view.ring.end - around)
        return good

    def _find_view(self, some: list[Track], shifts: list[Array]) -> bool:
        """Match some places as if the view lay beside where it is looked for; whether it was found."""
        p = self._prediction
        for shift in shifts:
            p.slow.suppose(shift[None], self._options.largest_reach_px / 3)
            points, tried = self._looks.try_height(some, 0, p.heights.prior_m)
            if len(points) >= max(LEAST_FOUND, SHARE * tried):
                return True
        p.slow.forget()
        return False

    def _find_ground(self, some: list[Track]) -> bool:
        """Match some places as if the ground were at one height after another; whether it was found.

        Attitudes may be so uncertain that a view lies beside where it is looked for by more than a search reaches: that
        is tried too. Along the parallax it looks like a height.
        """
        p, o = self._prediction, self._options
        if len(some) < LEAST_FOUND:
            return False
        prior = p.heights.prior_m
        heights = p.heights_tried([track.place for track in some]).tolist()
        tried = [(height, beside, o.largest_reach_px) for beside in p.beside(along_too=False) for height in heights]
        # a narrow search finds the ground in short strips too, where it is as high as it is thought to be
        for height, beside, reach in [(prior, np.zeros(2), o.least_reach_px), *tried]:
            p.slow.forget()
            if beside.any():
                p.slow.suppose(beside[None], reach / 3)
            points, tried = self._looks.try_height(some, 0, height, reach)
            if len(points) < max(LEAST_FOUND, SHARE * tried):
                continue
            p.heights.found(points)
            p.heights_changed()
            if p.heights is self._heights and abs(p.heights.prior_m - prior) > 3 * p.heights.prior_sigma_m:
                found = f"the ground was found at about {p.heights.prior_m:.0f} m above the origin"
                self.events.append(f"{found}, not at {prior:.0f} m")
            return True
        p.slow.forget()
        return False


def _some(tracks: list[Track], inner: NDArray[np.bool_]) -> list[Track]:
    """A few of the places, evenly: of those with lines all around; where these are few, of all but those at the ends,
    about which lines may be missing."""
    ends = len(tracks) // 5
    most = [tracks[i] for i in np.flatnonzero(inner)] if inner.sum() >= FEWEST else tracks[ends : len(tracks) - ends]
    return [most[i] for i in np.linspace(0, len(most) - 1, min(TOGETHER, len(most))).astype(int)]


def _batches(line: Array, number: NDArray[np.intp], middle_first: bool) -> list[list[int]]:
    """Places that are matched together; first some in the middle, whose wide search has lines all around."""
    if not len(line):
        return []
    nearest = np.argsort(np.abs(line - 0.5 * (line.min() + line.max())), kind="stable")
    n = TOGETHER if middle_first else 0
    rest = nearest[n:][np.argsort(line[nearest[n:]], kind="stable")]
    parts = [nearest[:n], *(rest[begin : begin + BATCH] for begin in range(0, len(rest), BATCH))]
    return [number[part].tolist() for part in parts if len(part)]
