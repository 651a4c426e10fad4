"""Tie points as the lines come in: choose places in the master view, match each other look when it is in store, judge.

The master is the CCD line that looks down most steeply.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from ..camera import LineCamera
from .chips import CHIP_HALF, ChipStore
from .consistency import Disagreement
from .current_orientation import CurrentOrientation
from .line_intake import LineIntake
from .line_scan import LineScan, view_of
from .line_store import LineStore
from .looks import Looked, LookMatcher, Track
from .options import MatchedRay, MatchedTie, MatchingOptions
from .places import PlaceChooser
from .prediction import PAD, Prediction
from .search import COARSEST, CORRELATION_HALF, LEAST_SQUARES_HALF, REACH_PX, Image
from .seen_again import SeenAgain
from .waiting import WaitingRoom

Array = NDArray[np.floating]

#: Looks that are wanted from a line store, s, beyond the time between the first look and the last.
STORE_MARGIN_S = 4.0


class TieMatcher:
    """Turns the image lines of one strip after another into tie points.

    Parameters
    ----------
    camera : line camera with at least two lines across the flight
    options : see `MatchingOptions`

    Attributes
    ----------
    counters : places by what became of them, lines by what was wrong with them
    prediction : geometry of the strip; whoever runs the matcher adds poses and corrections to its orientation
    """

    def __init__(self, camera: LineCamera, options: MatchingOptions | None = None):
        self.options = o = options or MatchingOptions()
        if len(camera.lines) < 2:
            raise ValueError("matching wants a camera with at least two CCD lines")
        if len(camera.lenses) != 1:
            raise ValueError(f"matching wants a camera with one lens, {camera.name} has {len(camera.lenses)}")
        self.views = [view_of(camera, i) for i in range(len(camera.lines))]
        master = int(np.argmin([abs(view.forward) for view in self.views]))
        self.counters: Counter[str] = Counter()
        self.prediction = Prediction(self.views, master, o)
        self.chips = ChipStore(int(o.chips_mb * 1e6))
        self._lines = LineIntake({v.ccd: v.pixels for v in self.views}, o, self._make_store)
        self._chooser = PlaceChooser(o, 2 * LEAST_SQUARES_HALF + 1, len(self.prediction.others))
        self._looks = LookMatcher(self.prediction, self._image, CHIP_HALF if o.chips_mb else 0)
        self._waiting = WaitingRoom(self.prediction, self._looks)
        self._again = SeenAgain(self.prediction, self._image, self.chips)
        self._strip = ""
        self._unjudged: list[Looked] = []
        self._next_number = 0

    # -- input ---------------------------------------------------------------------------------------------------------

    @property
    def orientation(self) -> CurrentOrientation:
        """The orientation that places are predicted with; takes poses and corrections."""
        return self.prediction.orientation

    @property
    def strip(self) -> str:
        """The strip that lines belong to, empty before the first one."""
        return self._strip

    @property
    def store(self) -> LineStore | None:
        """The lines of the strip; None before the first poses."""
        return self._lines.store

    def begin_strip(self, strip: str, first_line_time_s: float, line_rate_hz: float) -> None:
        """Lines that follow belong to a strip; lines of the last one are forgotten, patches about its points kept.

        Raises
        ------
        ValueError : a line rate that is not positive
        """
        if not (np.isfinite(line_rate_hz) and line_rate_hz > 0 and np.isfinite(first_line_time_s)):
            raise ValueError(f"strip {strip!r} with {line_rate_hz} lines a second")
        self._strip = strip
        self._unjudged, self._next_number = [], 0
        self._waiting.clear()
        self._lines.begin_strip(line_rate_hz)
        self._chooser.begin_strip()
        self.prediction.begin_strip(first_line_time_s, line_rate_hz)
        self._again.begin_strip(strip)

    def set_mean_height(self, height_m: float) -> None:
        """What the ground's height is taken for before anything is known, local frame."""
        self.prediction.heights.prior_m = height_m

    def window_holds(self, points: int, rays: int) -> None:
        """What the adjustment's window holds, to give it more or less."""
        self._chooser.density.window_holds(points, rays)

    def keep(self, share: float) -> None:
        """So large a share of the places is tried from now on; of those that wait, fewer than before go on as well.

        Raises
        ------
        ValueError : a share outside 0 to 1
        """
        if not 0 <= share <= 1:
            raise ValueError(f"a share of the places of {share}, wanted 0 to 1")
        density = self._chooser.density
        if share < density.load:
            self._waiting.thin(share / density.load)
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
        # a CCD line that is dead is done without, as long as two see
        seeing = self._lines.seeing
        self._looks.least_rays = min(self.options.least_rays, max(len(seeing), 2))
        if store is not None and np.isfinite(self.orientation.end_s):
            if seeing:
                out += self._settle(self._waiting.give_up(seeing))
            ring = store.rings[self.views[self.prediction.master].ccd]
            first = self._waiting.first_useful_line(store)
            self._waiting.add(self._chooser.choose(ring, self.prediction.rate, first, self._lines.saturated))
            self._waiting.add(self._again.find(ring.start, ring.end))
            news = self._chooser.news()
            if news:
                self._lines.tell(news)
            for view, tracks in self._waiting.due(store):
                out += self._look(tracks, view)
        self._collect_counters()
        return out

    def _look(self, tracks: list[Track], view: int) -> list[MatchedTie]:
        """Look for places in a view; the ties among those that are through with all views."""
        self._looks.look(tracks, view)
        over, lost = self._waiting.settle(tracks)
        gone = set(map(id, lost))
        chosen = [track for track in tracks if not track.place.name]
        across = 2 * np.array([t.place.sample for t in chosen]) / self.views[self.prediction.master].pixels - 1
        stage = self._waiting.order.index(view)
        self._chooser.density.judged(across, np.array([id(t) not in gone for t in chosen], dtype=bool), stage)
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
                self.chips.add(self._strip, names, part.chip[new], ground, part.score[new], holes)
        self.counters["ties"] += len(ties)
        self.counters["ties with earlier strips"] += sum(tie.again for tie in ties)
        return ties

    def _tie(self, looked: Looked, i: int, prediction_px: float) -> MatchedTie:
        name = looked.places[i].name
        if not name:
            self._next_number += 1
        return MatchedTie(
            name or f"{self._strip}-M{self._next_number}", looked.rays[i], float(looked.score[i]), looked.xyz_l[i],
            prediction_px, bool(name),
        )  # fmt: skip

    # -- store and counters --------------------------------------------------------------------------------------------

    def _image(self, index: int, scan: LineScan, travel: float) -> Image:
        assert self._lines.store is not None
        return Image(scan, self._lines.store.rings[self.views[index].ccd], travel, self._lines.saturated)

    def _make_store(self, dtype: np.dtype) -> LineStore | None:
        """Rings as long as the looks need; made when the first poses tell how fast the ground goes by."""
        if not np.isfinite(self.orientation.end_s):
            return None
        p = self.prediction
        height, travel = p.height_and_travel()
        earliest = min(view.forward for view in self.views)
        margin = 2 * (CORRELATION_HALF + REACH_PX + 2) * COARSEST + 4 * PAD
        master = self.views[p.master]
        ordered = [master, *(self.views[i] for i in p.others)]
        lines = {
            view.ccd: int((view.forward - earliest) * 1.1 * height / travel + STORE_MARGIN_S * p.rate + margin)
            for view in ordered
        }
        store = LineStore(
            {v.ccd: v.pixels for v in ordered}, lines, int(self.options.budget_mb * 1e6), dtype,
            {v.ccd: self._counterpart(v.ccd, height, travel) for v in ordered},
        )  # fmt: skip
        if store.share < 1:
            share = f"{100 * store.share:.0f} %"
            self._lines.tell(f"{self.options.budget_mb:g} MB hold {share} of the lines that matching wants")
        elif store.cover < 1:
            lanes = f"{len(store.lanes)} lanes, {100 * store.cover:.0f} % of the width"
            self._lines.tell(f"{self.options.budget_mb:g} MB: lines are kept in {lanes}")
        return store

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

    def _collect_counters(self) -> None:
        chooser = self._chooser
        self.counters["places"] += chooser.tried
        self.counters["cells without texture"] += chooser.empty
        chooser.tried = chooser.empty = 0
        for part in (self._lines, self._looks, self._again, self._waiting):
            self.counters.update(part.counters)
            part.counters.clear()


def _joined(parts: Iterable[Disagreement]) -> Disagreement:
    parts = list(parts)
    return Disagreement(*(np.concatenate([getattr(d, a) for d in parts]) for a in ("time_s", "across", "residual")))


__all__ = ["MatchedRay", "MatchedTie", "MatchingOptions", "TieMatcher"]
