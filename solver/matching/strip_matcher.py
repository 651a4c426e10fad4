"""Tie points between whole strips: of a satellite's telescopes, which see a place minutes apart, or of overpasses.

Each strip has its own lines, line times and poses, and is kept. When it is over its views are matched with those that
came before: places are chosen in a view that looks down more steeply than all that see the same ground, looked for in
the earlier views, and later in each that follows. A point is told when a second view has it; its later looks follow one
by one under its name. With one lens alone a second view may come days later: places are told as soon as their strip is
over, so that an adjustment keeps these looks.
"""

from __future__ import annotations

from collections import Counter, deque
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ..camera.line_camera import LineCamera
from .consistency import Disagreement
from .current_orientation import CurrentOrientation
from .ground_search import LEAST_FOUND, OVERLAP, SHARE, TOGETHER
from .line_intake import LineIntake
from .line_scan import LineScan, View, view_of
from .line_store import LineRing, LineStore
from .line_times import LineTimes
from .looks import Looked, LookMatcher, Track
from .options import MatchedRay, MatchedTie, MatchingOptions, Place, first_part_of_names
from .places import PlaceChooser
from .prediction import Prediction
from .round_earth import RADIUS_M, RoundHeights, above_sphere
from .search import LEAST_SQUARES_HALF, Image, TurnedImage
from .waiting import BATCH

Array = NDArray[np.floating]

#: Poses so long before the first line of a strip belong to it, s; strips that follow each other lie further apart.
POSES_BEFORE_S = 1.0
#: Poses kept for a strip whose lines have not come yet.
POSES_KEPT = 512
#: A view is steeper than another if it looks down more steeply by this, rad. Tuned: two lenses that look forward and
#: backward alike count as equal.
STEEPER = np.radians(2.0)
#: No ground lies higher above the sphere, m, than the highest mountain, or nearer below the platform than this share of
#: the way down to the lowest.
HIGHEST_GROUND_M, LEAST_ABOVE = 9000.0, 0.1
#: Standard deviation of a place before anything is matched with it, px: half of what it may be at most. Tuned.
LONE_SIGMA_PX = 0.05
#: A satellite that turns holds the view on the ground back to this share of its own way at most; and the largest angle
#: from the way down for which the share is computed, rad. Bounds for what makes no sense.
LEAST_SHARE, LARGEST_TILT = 0.05, np.radians(75.0)


@dataclass(eq=False)
class _Strip:
    """A strip.

    Attributes
    ----------
    id : its name
    times : of its lines
    views : its CCD lines, by name
    over : whether its last line has come
    """

    id: str
    times: LineTimes
    orientation: CurrentOrientation = field(default_factory=CurrentOrientation)
    views: dict[str, _StripView] = field(default_factory=dict)
    over: bool = False

    @property
    def nbytes(self) -> int:
        """Of the lines that have come."""
        rings = [view.ring for view in self.views.values()]
        return sum((r.end - r.start) * r.nbytes // r.capacity for r in rings if r is not None)


@dataclass(eq=False)
class _StripView:
    """What one CCD line has seen in a strip."""

    strip: _Strip
    view: View
    lines: LineIntake

    @property
    def ring(self) -> LineRing | None:
        """Its lines; None before any has come."""
        return None if self.lines.store is None else self.lines.store.rings[self.view.ccd]

    @property
    def known(self) -> bool:
        """Whether there are lines and orientations."""
        return self.ring is not None and bool(np.isfinite(self.strip.orientation.end_s))

    def scan(self, first: float, last: float) -> LineScan | None:
        """Some of its lines with their orientation, as far as there is one."""
        strip, o = self.strip, self.strip.orientation
        if not np.isfinite(o.end_s):
            return None
        low = max(int(np.floor(first)), int(np.ceil(strip.times.line_of(o.start_s))))
        high = min(int(np.ceil(last)), int(np.floor(strip.times.line_of(o.end_s))))
        if high - low < 4:
            return None
        position, R = o.at(strip.times.time_of(np.arange(low, high + 1)))
        return LineScan(self.view, low, position, R, self.ground_share)

    @cached_property
    def ground_share(self) -> float:
        """Way of the middle pixel on the ground as a share of the platform's way, over the whole strip."""
        o = self.strip.orientation
        position, R = o.at([o.start_s, o.end_s])
        rays = R @ self.view.rays_c(np.array([0.5 * (self.view.pixels - 1)]))[0]
        rays /= np.linalg.norm(rays, axis=1)[:, None]
        tilt, above = self.tilt(), above_sphere(self.middle()[0])
        way = position + rays * above / np.cos(min(tilt, LARGEST_TILT))
        return max(float(np.linalg.norm(way[1] - way[0]) / np.linalg.norm(position[1] - position[0])), LEAST_SHARE)

    def whole(self) -> LineScan | None:
        """All of its lines."""
        return None if self.ring is None else self.scan(self.ring.start, self.ring.end)

    def middle(self) -> tuple[Array, Array]:
        """Perspective centre and direction (3,) of the middle pixel in the middle of the strip."""
        o = self.strip.orientation
        position, R = o.at([0.5 * (o.start_s + o.end_s)])
        ray = R[0] @ self.view.rays_c(np.array([0.5 * (self.view.pixels - 1)]))[0]
        return position[0], ray / np.linalg.norm(ray)

    def tilt(self) -> float:
        """Angle between its middle and the way down, rad."""
        position, ray = self.middle()
        down = -position - np.array([0.0, 0.0, RADIUS_M])
        return float(np.arccos(np.clip(ray @ down / np.linalg.norm(down), -1.0, 1.0)))

    def image(self, scan: LineScan, travel: float) -> TurnedImage:
        """Its lines, for patches along any other strip; the platform's way from line to line is given."""
        assert self.ring is not None
        return TurnedImage(Image(scan, self.ring, travel * self.ground_share, self.lines.saturated), scan.way)


@dataclass(eq=False)
class _Master:
    """A view in which places were chosen, with the names of those that have become points."""

    view: _StripView
    places: list[Place]
    names: dict[int, str] = field(default_factory=dict)


class _PairPrediction(Prediction):
    """Where the looks of a view (number 1) at places of another one (number 0) are to be expected."""

    def __init__(self, pair: tuple[_StripView, _StripView], options: MatchingOptions, heights: RoundHeights):
        super().__init__([v.view for v in pair], 0, options)
        self._pair = pair
        strip = pair[0].strip
        self.orientation, self.heights = strip.orientation, heights
        self.times = strip.times
        self.whole = [v.whole() for v in pair]
        self.height_and_travel()  # tells the heights whether the platform is in orbit

    def height_and_travel(self) -> tuple[float, float]:
        height, travel = super().height_and_travel()
        return height, travel * self._pair[0].ground_share

    def scan(self, index: int, first: float, last: float) -> LineScan | None:
        return self._pair[index].scan(first, last)

    def look_lines(self, index: int, line: Array, point_l: Array) -> Array:
        whole = self.whole[index]
        return np.asarray(line, dtype=float) if whole is None else _located(whole, point_l)[0]

    def beside(self, along_too: bool) -> list[Array]:
        """Shifts (2,) across the parallax, and along it too, px, at which a view is looked for: the nearest first, so
        that searches cover three sigma of the orientation."""
        here, there = self.whole
        assert here is not None and there is not None
        half = 0.5 * len(here.position_l)
        middle, _ = here.to_plane(
            np.array([here.first_line + half]), np.array([0.5 * (here.view.pixels - 1)]), np.array([self.nadir_m])
        )
        ground = self.ground(here, middle)
        a, b = (v.middle()[1] for v in self._pair)
        way = np.stack([ground.along, ground.across]) @ (a[:2] / a[2] - b[:2] / b[2])
        along = way / max(float(np.linalg.norm(way)), 1e-9)
        across = np.array([-along[1], along[0]])
        reach = self.options.largest_reach_px
        step = 2 * (1 - OVERLAP) * reach
        n = int(np.ceil(max(self._three_sigma_px() - reach, 0.0) / step))
        far = np.arange(-n, n + 1)
        steps = np.stack(np.meshgrid(far if along_too else np.zeros(1), far, indexing="ij"), axis=-1).reshape(-1, 2)
        nearest = steps[np.argsort(np.hypot(*steps.T), kind="stable")]
        return list(step * nearest @ np.stack([along, across]))

    def turn(self, index: int) -> Array:
        """See `Prediction`."""
        here, there = self.whole
        if index == 0 or here is None or there is None:
            return np.eye(2)
        a, b = here.way, there.way
        cosine, sine = a @ b, a[0] * b[1] - a[1] * b[0]
        return np.array([[cosine, sine], [-sine, cosine]])

    def angle(self, places: list[Place]) -> float:
        """Angle at which the rays of both views meet on the ground, rad: the median of places; 0 where none is seen."""
        here, there = self.whole
        which = self.seen(places)
        if here is None or there is None or not which.any():
            return 0.0
        line, sample = np.array([[p.line, p.sample] for p, sees in zip(places, which, strict=True) if sees]).T
        point, _ = here.to_plane(line, sample, np.full(len(line), self.heights.prior_m))
        other, _ = _located(there, point)
        rays = [point - s.position_l[np.clip(np.nan_to_num(at).astype(int) - s.first_line, 0, len(s.position_l) - 1)]
                for s, at in ((here, line), (there, other))]  # fmt: skip
        a, b = (ray / np.linalg.norm(ray, axis=1)[:, None] for ray in rays)
        return float(np.median(np.arcsin(np.clip(np.linalg.norm(np.cross(a, b), axis=1), 0.0, 1.0))))

    def seen(self, places: list[Place]) -> NDArray[np.bool_]:
        """Which places lie in the lines of the other view, about."""
        here, there = self.whole
        if here is None or there is None or not places:
            return np.zeros(len(places), dtype=bool)
        line, sample = np.array([[place.line, place.sample] for place in places]).T
        height = np.full(len(line), self.heights.prior_m)
        for _ in range(2):  # the ground falls away from the XY plane
            height, _ = self.heights.at(here.to_plane(line, sample, height)[0][:, :2])
        point, _ = here.to_plane(line, sample, height)
        u, v = _located(there, point)
        first, last = there.first_line, there.first_line + len(there.position_l)
        three_sigma, most = self._three_sigma_px(), self.options.largest_reach_px
        reach = max(three_sigma, most)
        inside = (u > first - reach) & (u < last + reach)
        if three_sigma <= most:  # else the view may lie beside where it is expected
            inside &= (v > 0) & (v < there.view.pixels - 1)
        return np.asarray(inside)

    def _three_sigma_px(self) -> float:
        """How far a look may lie from where the orientations put it, px."""
        return self._orientation_reach(self.views[1], self.height_and_travel()[0] * self.views[0].pitch_mm
                                       / self.views[0].focal_length_mm)  # fmt: skip


def _located(scan: LineScan, point_l: Array) -> tuple[Array, Array]:
    """Line and sample (n,) of points (n, 3), whatever line of a strip they are seen in."""
    middle = np.full(len(point_l), scan.first_line + 0.5 * len(scan.position_l))
    line, sample, _ = scan.locate(point_l, middle, rounds=10)
    return line, sample


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
        self._strips: dict[str, _Strip] = {}
        self._masters: list[_Master] = []
        self._events: list[str] = []
        self._held, self._share = (0, 0), 1.0
        self._numbers: Counter[str] = Counter()
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
            begun = self._strips[strip] = _Strip(strip, times)
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
            strip.views[ccd] = _StripView(strip, self._views[ccd], lines)
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
        """No tie points: strips are matched when they are over."""
        return []

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
        out: list[MatchedTie] = []
        for view in (v for v in ended.views.values() if v.known):
            seen_by = [(master, p) for master in self._masters if (p := self._overlap(master, view)) is not None]
            for master, p in seen_by:
                out += self._look(master, view, p)
            if not seen_by or (not self._lone and all(view.tilt() < m.view.tilt() - STEEPER for m, _ in seen_by)):
                out += self._begin_master(view)
        return out

    def _make_room(self, ended: _Strip) -> None:
        """Forget the oldest strips where the budget is used up; tell where it did not hold all lines of a strip."""
        for ccd, view in ended.views.items():
            ring = view.ring
            if ring is not None and ring.start > 0:
                held = f"{self.options.budget_mb / self._at_once:g} MB hold"
                self._events.append(f"{ccd}: {held} the last {ring.end - ring.start} of {ring.end} lines")
        while sum(s.nbytes for s in self._strips.values()) > 1e6 * self.options.budget_mb and len(self._strips) > 2:
            oldest = next(s for s in self._strips.values() if s is not ended)
            del self._strips[oldest.id]
            self._masters = [master for master in self._masters if master.view.strip is not oldest]

    def _overlap(self, master: _Master, view: _StripView) -> _PairPrediction | None:
        """The geometry of a master and a view that sees some of its places; None for one that sees none."""
        p = _PairPrediction((master.view, view), self.options, self._heights)
        return p if p.seen(master.places).any() else None

    def _begin_master(self, view: _StripView) -> list[MatchedTie]:
        """Choose places in all lines of a view, and match them with the earlier ones, those most like it first."""
        others = [v for s in self._strips.values() if s.over for v in s.views.values() if v is not view and v.known]
        if not others and not self._lone:
            return []
        ring, rate = view.ring, view.strip.times.rate
        assert ring is not None
        chooser = PlaceChooser(self.options, 2 * LEAST_SQUARES_HALF + 1, 1)
        chooser.density.load = self._share
        chooser.density.window_holds(*self._held)
        master = _Master(view, chooser.choose(ring, rate, ring.start, view.lines.saturated))
        self.counters["places"] += chooser.tried
        self.counters["cells without texture"] += chooser.empty
        self._masters.append(master)
        mine = view.middle()[1]
        others.sort(key=lambda v: -float(mine @ v.middle()[1]))
        out = self._told(master) if self._lone else []
        for other in others:
            p = self._overlap(master, other)
            out += [] if p is None else self._look(master, other, p)
        if not out:  # another one may have better luck
            self._masters.remove(master)
        return out

    def _told(self, master: _Master) -> list[MatchedTie]:
        """All places of a master as points of one look, for strips that come much later."""
        strip, ccd = master.view.strip.id, master.view.view.ccd
        out = []
        for number, place in enumerate(master.places):
            ray = MatchedRay(ccd, place.line, place.sample, LONE_SIGMA_PX, LONE_SIGMA_PX, strip)
            out.append(MatchedTie(self._named(master, number), (ray,), 1.0, np.full(3, np.nan), 0.0))
        return out

    def _named(self, master: _Master, number: int) -> str:
        """The name of a place of a master, from now on a point."""
        if number not in master.names:
            strip = master.view.strip.id
            self._numbers[strip] += 1
            master.names[number] = f"{self._first_parts[strip]}-M{self._numbers[strip]}"
        return master.names[number]

    def _look(self, master: _Master, view: _StripView, p: _PairPrediction) -> list[MatchedTie]:
        """Look for the places of a master in a view; the ties and later looks that follow."""
        pair = master.view, view
        share = master.view.ground_share
        looks = LookMatcher(p, lambda index, scan, travel: pair[index].image(scan, travel / share), 0)
        numbers = np.flatnonzero(p.seen(master.places))
        if not self._found(looks, p, pair, [Track(master.places[number], 1) for number in numbers.tolist()]):
            self.counters["ground not found"] += len(numbers)
            return []
        numbers = np.flatnonzero(p.seen(master.places))  # the ground may have been found at another height
        tracks = {number: Track(master.places[number], 1) for number in numbers.tolist()}
        out: list[MatchedTie] = []
        waiting: list[tuple[int, Looked, int]] = []
        for part in _batches(np.array([master.places[i].line for i in numbers]), numbers):
            looks.look([tracks[i] for i in part], 0)
            found = [i for i in part if tracks[i].found[0]]
            looked = looks.finish([tracks[i] for i in found]) if found else None
            if looked is not None:
                waiting += [(number, looked, k) for k, number in enumerate(found)]
                out += self._judged(master, view, p, waiting)
        self.counters["too few looks"] += len(waiting)
        self.counters.update(looks.counters)
        return out

    def _found(
        self, looks: LookMatcher, p: _PairPrediction, pair: tuple[_StripView, _StripView], tracks: list[Track]
    ) -> bool:
        """Whether it is known how high the ground is, and where the view lies as far as searches reach; else look."""
        if not self._heights.some:
            return self._find_ground(looks, p, pair, tracks)
        shifts = p.beside(along_too=True)
        if len(shifts) == 1:
            return True
        some = _some(tracks)
        for shift in shifts:
            p.slow.suppose(shift[None], self.options.largest_reach_px / 3)
            points = looks.try_height(some, 0, p.heights.prior_m)
            if points is not None and len(points) >= max(LEAST_FOUND, SHARE * len(some)):
                return True
        p.slow.forget()
        return False

    def _find_ground(
        self, looks: LookMatcher, p: _PairPrediction, pair: tuple[_StripView, _StripView], tracks: list[Track]
    ) -> bool:
        """Match some places as if the ground were at one height after another; whether it was found.

        Attitudes may be so uncertain that a view lies beside where it is looked for by more than a search reaches: that
        is tried too. Along the parallax it looks like a height.
        """
        if len(tracks) < LEAST_FOUND:
            return False
        some = _some(tracks)
        prior, o = p.heights.prior_m, self.options
        heights = self._heights_tried(p, [track.place for track in some]).tolist()
        tried = [(height, beside, o.largest_reach_px) for beside in p.beside(along_too=False) for height in heights]
        # a narrow search finds the ground in short strips too, where it is as high as it is thought to be
        for height, beside, reach in [(prior, np.zeros(2), o.least_reach_px), *tried]:
            p.slow.forget()
            if beside.any():
                p.slow.suppose(beside[None], reach / 3)
            points = looks.try_height(some, 0, height, reach)
            if points is None or len(points) < max(LEAST_FOUND, SHARE * len(some)):
                continue
            p.heights.found(points)
            p.heights_changed()
            if abs(p.heights.prior_m - prior) > 3 * p.heights.prior_sigma_m:
                found = f"the ground was found at about {p.heights.prior_m:.0f} m above the origin"
                self._events.append(f"{found}, not at {prior:.0f} m")
            return True
        p.slow.forget()
        return False

    def _heights_tried(self, p: _PairPrediction, places: list[Place]) -> Array:
        """Heights of the ground, the likeliest first; a search at one of them reaches to the next."""
        sine = np.sin(p.angle(places))
        pixel = p.height_and_travel()[0] * p.views[0].pitch_mm / p.views[0].focal_length_mm
        step = 2 * (1 - OVERLAP) * self.options.largest_reach_px * pixel / max(float(sine), 1e-3)
        prior, low = p.heights.prior_m, min(p.heights.lowest_m, p.heights.prior_m)
        high = min(HIGHEST_GROUND_M, p.platform_m - LEAST_ABOVE * (p.platform_m - low))
        below, higher = (int(np.ceil(max(reach, 0.0) / step)) for reach in (prior - low, high - prior))
        steps = np.arange(-below, higher + 1)
        return prior + step * steps[np.argsort(np.abs(steps), kind="stable")]

    def _judged(
        self, master: _Master, view: _StripView, p: Prediction, waiting: list[tuple[int, Looked, int]]
    ) -> list[MatchedTie]:
        """Looks that agree with their neighbours become ties; while there are too few to tell, they wait."""
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
        for (number, looked, k), ok, left in zip(waiting, fine, together.residual[:, 0], strict=True):
            if not ok:
                continue
            known = number in master.names
            rays = [replace(ray, strip=v.strip.id) for ray, v in zip(looked.rays[k], (master.view, view), strict=True)]
            score, off = float(looked.score[k]), float(np.hypot(*left))
            rays = rays[1:] if known else rays
            out.append(MatchedTie(self._named(master, number), tuple(rays), score, looked.xyz_l[k], off, known))
        places = [looked.xyz_l[k] for (_, looked, k), ok in zip(waiting, fine, strict=True) if ok]
        p.heights.add(np.reshape(places, (-1, 3)))
        self.counters["ties"] += sum(not tie.again for tie in out)
        self.counters["later looks"] += sum(tie.again for tie in out)
        waiting.clear()
        return out


def _some(tracks: list[Track]) -> list[Track]:
    """A few of the places, evenly; those at the ends, about which lines may be missing, are left out."""
    inner = tracks[len(tracks) // 5 : len(tracks) - len(tracks) // 5]
    return [inner[i] for i in np.linspace(0, len(inner) - 1, min(TOGETHER, len(inner))).astype(int)]


def _batches(line: Array, number: NDArray[np.intp]) -> list[list[int]]:
    """Places that are matched together: first some in the middle of a strip, whose wide search has lines all around."""
    if not len(line):
        return []
    nearest = np.argsort(np.abs(line - 0.5 * (line.min() + line.max())), kind="stable")
    first, rest = nearest[:TOGETHER], np.sort(nearest[TOGETHER:])
    parts = [first, *(rest[begin : begin + BATCH] for begin in range(0, len(rest), BATCH))]
    return [number[part].tolist() for part in parts]
