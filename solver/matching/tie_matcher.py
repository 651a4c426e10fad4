"""Tie points as the lines come in: choose places in the master view, match each other look when it is in store, judge.

Places are chosen in the CCD line that looks down most steeply of those that see, the master.
"""

from __future__ import annotations

from collections import Counter

import numpy as np
from numpy.typing import NDArray

from ..camera.line_camera import LineCamera
from .chips import ChipStore
from .current_orientation import CurrentOrientation
from .line_intake import LineIntake
from .line_scan import LineScan, view_of
from .line_store import LineStore
from .line_times import LineTimes
from .master_view import MasterView
from .options import MatchedRay, MatchedTie, MatchingOptions, first_part_of_names
from .prediction import PAD, Prediction
from .search import COARSEST, CORRELATION_HALF, REACH_PX, Image

Array = NDArray[np.floating]

#: Looks that are wanted from a line store, s, beyond the time between the first look and the last.
STORE_MARGIN_S = 4.0


class TieMatcher:
    """Turns the image lines of one strip after another into tie points.

    Parameters
    ----------
    camera : line camera with at least two lines across the flight
    options : see `MatchingOptions`
    R_fi : (3, 3) the platform's axes forward-left-up from the image axes; where the camera looks when it flies level

    Attributes
    ----------
    counters : places by what became of them, lines by what was wrong with them
    """

    def __init__(self, camera: LineCamera, options: MatchingOptions | None = None, R_fi: Array | None = None):
        self.options = o = options or MatchingOptions()
        if len(camera.lines) < 2:
            raise ValueError("matching wants a camera with at least two CCD lines")
        if len(camera.lenses) != 1:
            raise ValueError(f"matching wants a camera with one lens, {camera.name} has {len(camera.lenses)}")
        self.views = [view_of(camera, i, R_fi) for i in range(len(camera.lines))]
        self.counters: Counter[str] = Counter()
        self.chips = ChipStore(int(o.chips_mb * 1e6))
        self._lines = LineIntake({v.ccd: v.pixels for v in self.views}, o, self._make_store)
        # places are chosen in the last of these; what began in the others goes on
        self._at_work = [self._view(min(range(len(self.views)), key=self._tilt))]
        self._strip = self._first_part = ""
        self._named: set[str] = set()
        self._next_number = 0

    # -- input ---------------------------------------------------------------------------------------------------------

    @property
    def _master(self) -> MasterView:
        return self._at_work[-1]

    @property
    def prediction(self) -> Prediction:
        """Geometry of the strip, seen from the master."""
        return self._master.prediction

    @property
    def orientation(self) -> CurrentOrientation:
        """The orientation that places are predicted with; takes poses and corrections."""
        return self.prediction.orientation

    def add_pose(self, time_s: float, position_l: Array, quaternion: Array, covariance: Array) -> bool:
        """Add a measured pose; False for one that does not come after the last."""
        return self.orientation.add_pose(time_s, position_l, quaternion, covariance)

    def orientation_of(self, strip: str) -> CurrentOrientation | None:
        """What takes corrections of a strip; None where its lines are not those that are matched."""
        return self.orientation if strip == self._strip else None

    @property
    def strip(self) -> str:
        """The strip that lines belong to, empty before the first one."""
        return self._strip

    @property
    def store(self) -> LineStore | None:
        """The lines of the strip; None before the first poses."""
        return self._lines.store

    def begin_strip(self, strip: str, times: LineTimes, first_line: int = 0) -> None:
        """Lines that follow, from ``first_line`` on, belong to a strip, with the times of its lines; lines of the last
        one are forgotten, patches about its points kept.
        """
        self._strip, self._first_part = strip, first_part_of_names(strip, first_line)
        self._next_number = 0
        self._named.clear()
        self._lines.begin_strip(times.rate, first_line)
        self._at_work = [self._master]
        self.prediction.begin_strip(times)
        self._master.begin_strip(strip)

    def set_mean_height(self, height_m: float) -> None:
        """What the ground's height is taken for before anything is known, local frame."""
        self.prediction.heights.say(height_m)

    def search_ground(self, lowest_m: float) -> None:
        """The ground's height is not known: it is looked for, from a lowest height on; local frame."""
        self.prediction.heights.lose(lowest_m)

    @property
    def ground_found(self) -> bool:
        """Whether heights of the ground have been measured."""
        return self.prediction.heights.some

    @property
    def ground_m(self) -> float | None:
        """Height of the ground in the local frame as far as it is known or taken to be; None while it is looked for."""
        heights = self.prediction.heights
        return None if heights.unknown else heights.prior_m

    @property
    def ground_missing(self) -> bool:
        """Whether the ground was looked for at all heights in this strip, and found at none."""
        return self._master.ground_missing

    def window_holds(self, points: int, rays: int) -> None:
        """What the adjustment's window holds, to give it more or less."""
        for view in self._at_work:
            view.chooser.density.window_holds(points, rays)

    def keep(self, share: float) -> None:
        """So large a share of the places is tried from now on; of those that wait, fewer than before go on as well.

        Raises
        ------
        ValueError : a share outside 0 to 1
        """
        if not 0 <= share <= 1:
            raise ValueError(f"a share of the places of {share}, wanted 0 to 1")
        for view in self._at_work:
            density = view.chooser.density
            if share < density.load:
                view.waiting.thin(share / density.load)
            density.load = share

    def add_lines(self, ccd: str, first_line: int, pixels: NDArray[np.unsignedinteger]) -> NDArray[np.bool_]:
        """Lines of one CCD; returns which of them (n,) are fit for use.

        Raises
        ------
        ValueError : a CCD line the camera does not have, lines of another length or pixel type, no strip
        """
        if not self._strip:
            raise ValueError(f"lines of {ccd} before their strip")
        return self._lines.add(ccd, first_line, pixels)

    def take_events(self) -> list[str]:
        """What is worth telling since the last call."""
        return self._lines.take_events()

    # -- matching ------------------------------------------------------------------------------------------------------

    def match(self) -> list[MatchedTie]:
        """The tie points that have become known."""
        store = self._lines.store
        out: list[MatchedTie] = []
        if store is not None and np.isfinite(self.orientation.end_s):
            self._choose_master(store, self._lines.seeing)
            heights = self.prediction.heights
            thought_m, looked_for = heights.prior_m, heights.unknown
            for view in self._at_work:
                out += view.match(self._lines, store, self._named)
            if looked_for and not heights.unknown and abs(heights.prior_m - thought_m) > 3 * heights.prior_sigma_m:
                found = f"the ground was found at about {heights.prior_m:.0f} m in the local frame"
                self._lines.tell(f"{found}, not at {thought_m:.0f} m")
            news = self._master.chooser.news()
            if news:
                self._lines.tell(news)
        for view in self._at_work:
            self.counters.update(view.take_counters())
        self._at_work = [view for view in self._at_work if not view.over]
        self.counters.update(self._lines.counters)
        self._lines.counters.clear()
        return out

    def end_strip(self, strip: str) -> list[MatchedTie]:
        """A strip is over: what its lines tell has been told while they came."""
        return []

    def finish(self) -> list[MatchedTie]:
        """Nothing more comes: as `end_strip`."""
        return []

    def _choose_master(self, store: LineStore, seeing: frozenset[str]) -> None:
        """Places are chosen in the steepest of the views that see; what began in another one goes on."""
        steepest = min((i for i, v in enumerate(self.views) if v.ccd in seeing), key=self._tilt, default=-1)
        old = self._master
        if len(seeing) < 2 or steepest == old.prediction.master:
            return
        new = next((view for view in self._at_work if view.prediction.master == steepest), None)
        first = store.rings[self.views[steepest].ccd].end
        if new is None:
            new = self._view(steepest)
            new.prediction.orientation, new.prediction.heights = self.orientation, old.prediction.heights
            new.prediction.times = old.prediction.times
            new.chooser.density.like(old.chooser.density)
            new.begin_strip(self._strip, first)
        else:
            new.resume(first)
            self._at_work.remove(new)
        # the old one bridges the time until the new one's looks are complete
        ring, over = store.rings[old.ccd], new.lines_to_last_look(seeing) - old.lines_to_last_look(seeing)
        old.until = ring.end + over if old.ccd in seeing else -np.inf
        self._at_work.append(new)
        again = f"{new.ccd} sees again" if old.ccd in seeing else f"{old.ccd} sees nothing"
        self._lines.tell(f"{again}: tie points begin in {new.ccd}, the steepest CCD line that sees")

    def _tilt(self, index: int) -> float:
        return abs(self.views[index].forward)

    def _view(self, index: int) -> MasterView:
        prediction = Prediction(self.views, index, self.options)
        return MasterView(prediction, self.options, self._image, self.chips, self._new_name)

    def _new_name(self) -> str:
        self._next_number += 1
        return f"{self._first_part}-M{self._next_number}"

    # -- store and counters --------------------------------------------------------------------------------------------

    def _image(self, index: int, scan: LineScan, travel: float) -> Image:
        assert self._lines.store is not None
        return Image(scan, self._lines.store.rings[self.views[index].ccd], travel, self._lines.saturated)

    def _make_store(self, dtype: np.dtype) -> LineStore | None:
        """Rings as long as the looks need; made when the first poses tell how fast the ground goes by."""
        p = self.prediction
        if not p.knows_travel:
            return None
        if p.heights.unknown:
            # room for ground lower than it is thought to be, where there is any
            store = self._sized(dtype, p.platform_m - p.heights.lowest_m)
            if store.share == 1 and store.cover == 1:
                return store
        store = self._sized(dtype, p.height_and_travel()[0])
        if store.share < 1:
            share = f"{100 * store.share:.0f} %"
            self._lines.tell(f"{self.options.budget_mb:g} MB hold {share} of the lines that matching wants")
        elif store.cover < 1:
            lanes = f"{len(store.lanes)} lanes, {100 * store.cover:.0f} % of the width"
            self._lines.tell(f"{self.options.budget_mb:g} MB: lines are kept in {lanes}")
        return store

    def _sized(self, dtype: np.dtype, height: float) -> LineStore:
        """A store for looks at ground so far below."""
        p = self.prediction
        _, travel = p.height_and_travel()
        earliest = min(view.forward for view in self.views)
        margin = 2 * (CORRELATION_HALF + REACH_PX + 2) * COARSEST + 4 * PAD
        master = self.views[p.master]
        ordered = [master, *(self.views[i] for i in p.others)]
        lines = {
            view.ccd: int((view.forward - earliest) * 1.1 * height / travel + STORE_MARGIN_S * p.rate + margin)
            for view in ordered
        }
        return LineStore(
            {v.ccd: v.pixels for v in ordered}, lines, int(self.options.budget_mb * 1e6), dtype,
            {v.ccd: self._counterpart(v.ccd, height, travel) for v in ordered},
        )  # fmt: skip

    def _counterpart(self, ccd: str, height: float, travel: float) -> Array:
        """Sample of a CCD line that sees what each sample of the master sees, as the platform flies now (crab)."""
        p, o = self.prediction, self.orientation
        at = np.array([o.end_s - 20.0 / p.rate, o.end_s])
        position, R = o.at(at)
        velocity = (position[1] - position[0]) / 20
        master, view = self.views[p.master], next(v for v in self.views if v.ccd == ccd)
        samples = np.arange(0, master.pixels, 16, dtype=float)
        rays = master.rays_c(samples) @ R[1].T
        point = position[1] + rays * (-height / rays[:, 2])[:, None]
        away = np.zeros(len(samples))
        seen = samples
        for _ in range(3):
            f = (point - position[1] - away[:, None] * velocity) @ R[1]
            x, y = (-view.focal_length_mm * f[:, i] / f[:, 2] for i in (0, 1))
            ahead = x - np.interp(y, view.y_mm, view.x_mm)
            away += ahead * height / (view.focal_length_mm * travel)
            seen = np.interp(y, view.y_mm, view.sample)
        return np.interp(np.arange(master.pixels), samples, seen)


__all__ = ["MatchedRay", "MatchedTie", "MatchingOptions", "TieMatcher"]
