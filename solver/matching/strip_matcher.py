"""Tie points between strips: of a satellite's telescopes, which see a place minutes apart, or of overpasses.

Each strip has its own lines, line times and poses, and is kept. Its views are matched with those that came before:
places are chosen in a view that looks down more steeply than all that see the same ground, looked for in the earlier
views, and later in each that follows. A point is told when a second view has it; its later looks follow one by one
under its name.

With several lenses strips are matched when they are over. With one lens alone a second view may come much later:
places are chosen while the strip is taken and told at once, so that an adjustment keeps these looks, and they are
looked for in other strips as lines come in.
"""

from __future__ import annotations

from collections import Counter, deque
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ..camera.line_camera import LineCamera
from .current_orientation import CurrentOrientation
from .kept_strip import KeptStrip, StripView
from .line_intake import LineIntake
from .line_scan import view_of
from .line_store import LineStore
from .line_times import LineTimes
from .options import MatchedRay, MatchedTie, MatchingOptions, Place, first_part_of_names
from .places import PlaceChooser
from .round_earth import RoundHeights
from .search import LEAST_SQUARES_HALF
from .strip_pair import Master, StripPair, lone_sigma_px

Array = NDArray[np.floating]

#: Poses so long before the first line of a strip belong to it, s; strips that follow each other lie further apart.
POSES_BEFORE_S = 1.0
#: Poses kept for a strip whose lines have not come yet.
POSES_KEPT = 512
#: A view is steeper than another if it looks down more steeply by this, rad. Tuned: two lenses that look forward and
#: backward alike count as equal.
STEEPER = np.radians(2.0)
#: Bands across the image in which places are chosen or not: none where the lines see so large a share of as many places
#: of other strips. Tuned.
BANDS, ENOUGH_SEEN = 16, 0.5
#: While a strip of one lens is taken, it is matched so often, s. Tuned: looks have to come before the window of the
#: adjustment has left them behind, and a few dozen of them cost hardly more than one.
EVERY_S = 2.0


class StripMatcher:
    """Turns the image lines of strips into tie points between them.

    Parameters
    ----------
    camera : line camera, of one line or of several lenses
    options : see `MatchingOptions`; ``least_rays`` counts as 2, since each look comes minutes after the one before

    Attributes
    ----------
    counters : places by what became of them, lines by what was wrong with them
    orientation : of the strip whose lines came last

    Raises
    ------
    ValueError : a CCD line that does not run across the flight
    """

    def __init__(self, camera: LineCamera, options: MatchingOptions | None = None):
        self.options = replace(options or MatchingOptions(), least_rays=2)
        self.counters: Counter[str] = Counter()
        self.orientation = CurrentOrientation()
        self._views = {line.id: view_of(camera, i) for i, line in enumerate(camera.lines)}
        self._at_once, self._lone = max(len(camera.lenses), 2), len(camera.lenses) == 1
        self._heights = RoundHeights(0.0, self.options.relief_sigma_m)
        self._poses: deque[tuple[float, Array, Array, Array]] = deque(maxlen=POSES_KEPT)
        self._strip = ""
        self._strips: dict[str, KeptStrip] = {}
        self._masters: list[Master] = []
        self._pairs: dict[tuple[Master, StripView], StripPair] = {}
        self._events: list[str] = []
        self._held, self._share = (0, 0), 1.0
        self._first_parts: dict[str, str] = {}  # of the names of points, by strip

    # -- input ---------------------------------------------------------------------------------------------------------

    @property
    def strip(self) -> str:
        """The strip whose lines came last."""
        return self._strip

    @property
    def ground_found(self) -> bool:
        """Whether heights of the ground have been measured."""
        return self._heights.some

    @property
    def ground_m(self) -> float | None:
        """Height of the ground as far as it is known or taken to be, above the sphere where the platform is in orbit;
        None while it is looked for."""
        return None if self._heights.unknown else self._heights.prior_m

    @property
    def ground_missing(self) -> bool:
        """Whether the ground has not been found at any height: strips that overlap are searched at all of them."""
        return self._heights.unknown

    def set_mean_height(self, height_m: float) -> None:
        """What the ground's height is taken for before anything is known."""
        self._heights.say(height_m)

    def search_ground(self, lowest_m: float) -> None:
        """The ground's height is not known: it is looked for, from a lowest height on."""
        self._heights.lose(lowest_m)

    def window_holds(self, points: int, rays: int) -> None:
        """What the adjustment's window holds, to give it more or less."""
        self._held = points, rays

    def keep(self, share: float) -> None:
        """So large a share of the places is tried from now on.

        Raises
        ------
        ValueError : a share outside 0 to 1
        """
        if not 0 <= share <= 1:
            raise ValueError(f"a share of the places of {share}, wanted 0 to 1")
        self._share = share

    def add_pose(self, time_s: float, position_l: Array, quaternion: Array, covariance: Array) -> bool:
        """Add a measured pose to the strips that are being taken; False for one that does not come after the last."""
        if self._poses and time_s <= self._poses[-1][0]:
            return False
        self._poses.append((time_s, position_l, quaternion, covariance))
        for strip in self._strips.values():
            if not strip.over:
                strip.orientation.add_pose(time_s, position_l, quaternion, covariance)
        return True

    def orientation_of(self, strip: str) -> CurrentOrientation | None:
        """The orientation of a strip that is kept; takes corrections."""
        known = self._strips.get(strip)
        return None if known is None else known.orientation

    def begin_strip(self, strip: str, times: LineTimes, first_line: int = 0) -> None:
        """Lines that follow, from ``first_line`` on, belong to a strip, new or begun before, with the times of its
        lines.
        """
        self._strip = strip
        if strip not in self._strips:
            self._first_parts[strip] = first_part_of_names(strip, first_line)
            begun = self._strips[strip] = KeptStrip(strip, times)
            for pose in self._poses:
                if pose[0] >= times.first_s - POSES_BEFORE_S:
                    begun.orientation.add_pose(*pose)
        self.orientation = self._strips[strip].orientation

    def add_lines(self, ccd: str, first_line: int, pixels: NDArray[np.unsignedinteger]) -> NDArray[np.bool_]:
        """Lines of one CCD line; returns which of them (n,) are fit for use.

        Raises
        ------
        ValueError : a CCD line the camera does not have, lines of another length or pixel type, no strip
        """
        if not self._strip:
            raise ValueError(f"lines of {ccd} before their strip")
        if ccd not in self._views:
            raise ValueError(f"unknown CCD line {ccd!r}")
        strip = self._strips[self._strip]
        if ccd not in strip.views:
            samples = {ccd: self._views[ccd].pixels}
            lines = LineIntake(samples, self.options, lambda dtype: self._store(samples, dtype))
            lines.begin_strip(strip.times.rate, first_line)
            chooser = PlaceChooser(self.options, 2 * LEAST_SQUARES_HALF + 1, 1)
            strip.views[ccd] = StripView(strip, self._views[ccd], lines, chooser, first_line)
        lines = strip.views[ccd].lines
        usable = lines.add(ccd, first_line, pixels)
        self._events += lines.take_events()
        self.counters.update(lines.counters)
        lines.counters.clear()
        return usable

    def _store(self, samples: dict[str, int], dtype: np.dtype) -> LineStore:
        """All lines of a strip, as far as its part of the budget goes."""
        budget = int(self.options.budget_mb * 1e6 / self._at_once)
        wanted = budget // sum(n * np.dtype(dtype).itemsize + 1 for n in samples.values())
        return LineStore(samples, dict.fromkeys(samples, max(wanted, 8)), budget, dtype)

    def take_events(self) -> list[str]:
        """What is worth telling since the last call."""
        events, self._events = self._events, []
        return events

    # -- matching ------------------------------------------------------------------------------------------------------

    def match(self) -> list[MatchedTie]:
        """The tie points of the strip that is taken; with several lenses none before it is over."""
        strip = self._strips.get(self._strip)
        if strip is None or strip.over or not self._lone:
            return []
        return [tie for view in strip.views.values() if self._is_time(view) for tie in self._match(view)]

    def _is_time(self, view: StripView) -> bool:
        """Whether enough lines have come since the last time."""
        if not view.known:
            return False
        assert view.ring is not None
        return view.known_to - max(view.chosen_to, view.ring.start) >= EVERY_S * view.strip.times.rate

    def finish(self) -> list[MatchedTie]:
        """Nothing more comes: the tie points of strips that were not over."""
        return [tie for strip in list(self._strips) for tie in self.end_strip(strip)]

    def end_strip(self, strip: str) -> list[MatchedTie]:
        """A strip is over: its tie points with those that were over before."""
        ended = self._strips.get(strip)
        if ended is None or ended.over:
            return []
        ended.over = True
        ended.orientation.close()
        self._make_room(ended)
        out = [tie for view in ended.views.values() if view.known for tie in self._match(view)]
        self._pairs = {(m, v): pair for (m, v), pair in self._pairs.items() if ended not in (m.view.strip, v.strip)}
        return out

    def _make_room(self, ended: KeptStrip) -> None:
        """Forget the oldest strips where the budget is used up; tell where it did not hold all lines of a strip."""
        for ccd, view in ended.views.items():
            ring = view.ring
            if ring is not None and ring.start > view.first_line:
                held, come = f"{self.options.budget_mb / self._at_once:g} MB hold", ring.end - view.first_line
                self._events.append(f"{ccd}: {held} the last {ring.end - ring.start} of {come} lines")
        while sum(s.nbytes for s in self._strips.values()) > 1e6 * self.options.budget_mb and len(self._strips) > 2:
            oldest = next(s for s in self._strips.values() if s is not ended)
            del self._strips[oldest.id]
            self._masters = [master for master in self._masters if master.view.strip is not oldest]
            self._pairs = {k: pair for k, pair in self._pairs.items() if oldest not in (k[0].view.strip, k[1].strip)}

    def _match(self, view: StripView) -> list[MatchedTie]:
        """Match the lines of a view that have come since the last time with strips that are over."""
        pairs = [self._pair(m, view, 1) for m in self._masters if m.view.strip is not view.strip and m.view.strip.over]
        seen = [at[at[:, 0] >= view.chosen_to] for _, at in (pair.seen() for pair in pairs)]
        out = [tie for pair in pairs for tie in self._matched(pair)]
        if self._lone:
            out += self._add_places(view, np.concatenate([np.empty((0, 2)), *seen])[:, 1])
        else:
            by = [pair.master.view for pair, at in zip(pairs, seen, strict=True) if len(at)]
            if all(view.tilt() < other.tilt() - STEEPER for other in by):
                out += self._begin_master(view)
        view.chosen_to = view.known_to
        return out

    def _pair(self, master: Master, view: StripView, late: int) -> StripPair:
        if (master, view) not in self._pairs:
            self._pairs[master, view] = StripPair(master, view, late, self.options, self._heights)
        return self._pairs[master, view]

    def _matched(self, pair: StripPair) -> list[MatchedTie]:
        """The ties of a pair, and what it has to tell."""
        out = pair.match()
        self.counters.update(pair.counters)
        pair.counters.clear()
        self._events += pair.events
        pair.events.clear()
        return out

    def _add_places(self, view: StripView, seen: Array) -> list[MatchedTie]:
        """Choose places in the lines of a view that have come since the last time, for strips that come much later, as
        points of one look.

        Parameters
        ----------
        seen : (n,) samples at which these lines see places of others: no more are chosen beside them
        """
        master = next((m for m in self._masters if m.view is view), None)
        if master is None:
            master = Master(view, self._first_parts[view.strip.id], told_px=lone_sigma_px(self.options))
            self._masters.append(master)
        chosen, sigma_px = self._chosen(view), master.told_px
        # each of them is a point at once, so that no more are needed than points are wanted
        view.chooser.density.judged(
            np.array([2 * p.sample / view.view.pixels - 1 for p in chosen]), np.ones(len(chosen), dtype=bool)
        )
        band, seen_band = (_band(at, view.view.pixels) for at in (np.array([p.sample for p in chosen]), seen))
        enough = np.bincount(seen_band, minlength=BANDS) >= ENOUGH_SEEN * np.bincount(band, minlength=BANDS)
        out = []
        for place in (p for p, b in zip(chosen, band, strict=True) if not enough[b]):
            master.places.append(place)
            ray = MatchedRay(view.view.ccd, place.line, place.sample, sigma_px, sigma_px, view.strip.id)
            out.append(MatchedTie(master.point(len(master.places) - 1), (ray,), 1.0, np.full(3, np.nan), 0.0))
        return out

    def _begin_master(self, view: StripView) -> list[MatchedTie]:
        """Choose places in all lines of a view, and match them with the earlier ones, those most like it first."""
        mine = view.middle()[1]
        others = [v for s in self._strips.values() if s.over for v in s.views.values() if v is not view and v.known]
        others.sort(key=lambda v: -float(mine @ v.middle()[1]))
        if not others:
            return []
        master = Master(view, self._first_parts[view.strip.id], self._chosen(view))
        out = [tie for other in others for tie in self._matched(self._pair(master, other, 0))]
        if out:  # else another one may have better luck
            self._masters.append(master)
        return out

    def _chosen(self, view: StripView) -> list[Place]:
        """Places in the lines of a view that have come since the last time."""
        ring, chooser = view.ring, view.chooser
        assert ring is not None
        chooser.density.load = self._share
        chooser.density.window_holds(*self._held)
        tried, empty = chooser.tried, chooser.empty
        places = chooser.choose(ring, view.strip.times.rate, ring.start, view.lines.saturated)
        self.counters["places"] += chooser.tried - tried
        self.counters["cells without texture"] += chooser.empty - empty
        return places


def _band(sample: Array, pixels: int) -> NDArray[np.intp]:
    """The band across the image (n,) of samples (n,)."""
    return np.clip(sample / pixels * BANDS, 0, BANDS - 1).astype(np.intp)
