"""Tie points between lenses whose strips come one after another: a satellite's telescopes see a place minutes apart.

Each strip ``scene/lens`` has its own lines, line times and poses. All of a scene are kept. When a strip is over, its
views are matched with those that came before: places are chosen in a view that looks down more steeply than all before
it, looked for in the earlier ones, and later in each that follows. A point is told when a second view has it; its later
looks follow one by one under its name.
"""

from __future__ import annotations

from collections import Counter, deque
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from ..camera.lens_strips import lens_of
from ..camera.line_camera import LineCamera
from .consistency import Disagreement
from .current_orientation import CurrentOrientation
from .ground_search import LEAST_FOUND, OVERLAP, SHARE, TOGETHER
from .line_intake import LineIntake
from .line_scan import LineScan, View, view_of
from .line_store import LineRing, LineStore
from .looks import Looked, LookMatcher, Track
from .options import MatchedTie, MatchingOptions
from .places import PlaceChooser
from .prediction import Prediction
from .round_earth import RADIUS_M, RoundHeights
from .search import LEAST_SQUARES_HALF, Image
from .waiting import BATCH

Array = NDArray[np.floating]

#: Poses so long before the first line of a strip belong to it, s; strips that follow each other lie further apart.
POSES_BEFORE_S = 1.0
#: Poses kept for a strip whose lines have not come yet.
POSES_KEPT = 512
#: Places are chosen in a view that looks down more steeply than those before it by this, rad. Tuned: two lenses that
#: look forward and backward alike count as equal.
STEEPER = np.radians(2.0)
#: No ground lies higher above the sphere, m, than the highest mountain.
HIGHEST_GROUND_M = 9000.0


@dataclass
class _Strip:
    """A strip of one lens.

    Attributes
    ----------
    id : its name
    first_s, rate : image line u is taken at first_s + u / rate
    orientation : its own
    lines : those that have come
    over : whether its last line has come
    """

    id: str
    first_s: float
    rate: float
    orientation: CurrentOrientation
    lines: LineIntake
    over: bool = False

    def ring(self, ccd: str) -> LineRing | None:
        """The lines of a CCD line; None before any has come."""
        return None if self.lines.store is None else self.lines.store.rings[ccd]

    def scan(self, view: View, first: float, last: float) -> LineScan | None:
        """Some of its lines with their orientation, as far as there is one."""
        o = self.orientation
        if not np.isfinite(o.end_s):
            return None
        low = max(int(np.floor(first)), int(np.ceil((o.start_s - self.first_s) * self.rate)))
        high = min(int(np.ceil(last)), int(np.floor((o.end_s - self.first_s) * self.rate)))
        if high - low < 4:
            return None
        position, R = o.at(self.first_s + np.arange(low, high + 1) / self.rate)
        return LineScan(view, low, position, R)


class _PassPrediction(Prediction):
    """Where looks are to be expected in views that each have lines and poses of their own."""

    def __init__(
        self, views: list[View], master: int, options: MatchingOptions, strips: dict[int, _Strip], heights: RoundHeights
    ):
        super().__init__(views, master, options)
        self._strips, self._whole = strips, dict[int, LineScan]()
        strip = strips[master]
        self.orientation, self.heights = strip.orientation, heights
        self.first_s, self.rate = strip.first_s, strip.rate

    def scan(self, index: int, first: float, last: float) -> LineScan | None:
        return self._strips[index].scan(self.views[index], first, last)

    def look_lines(self, index: int, line: Array, point_l: Array) -> Array:
        whole = self.whole(index)
        if whole is None:
            return np.asarray(line, dtype=float)
        middle = np.full(len(point_l), whole.first_line + 0.5 * len(whole.position_l))
        return whole.locate(point_l, middle, rounds=10)[0]

    def whole(self, index: int) -> LineScan | None:
        """All lines of a view."""
        if index not in self._whole:
            ring = self._strips[index].ring(self.views[index].ccd)
            scan = None if ring is None else self.scan(index, ring.start, ring.end)
            if scan is None:
                return None
            self._whole[index] = scan
        return self._whole[index]

    def corrected(self) -> None:
        """Orientations have changed since they were last asked for."""
        self._whole.clear()
        self.heights_changed()


@dataclass
class _Master:
    """A view in which places were chosen, and what has become of them."""

    prediction: _PassPrediction
    looks: LookMatcher
    tracks: list[Track] = field(default_factory=list)
    names: dict[int, str] = field(default_factory=dict)  # by id of the track


class LensPassMatcher:
    """Turns the image lines of strips ``scene/lens`` into tie points between the lenses of each scene.

    Parameters
    ----------
    camera : line camera with several lenses
    options : see `MatchingOptions`; ``least_rays`` counts as 2, since each look comes minutes after the one before

    Attributes
    ----------
    counters : places by what became of them, lines by what was wrong with them

    Raises
    ------
    ValueError : a camera with one lens, or a CCD line that does not run across the flight
    """

    def __init__(self, camera: LineCamera, options: MatchingOptions | None = None):
        if len(camera.lenses) < 2:
            raise ValueError(f"matching between lenses wants a camera with several, {camera.name} has one")
        self.options = replace(options or MatchingOptions(), least_rays=2)
        self.views = [view_of(camera, i) for i in range(len(camera.lines))]
        self.counters: Counter[str] = Counter()
        self.orientation = CurrentOrientation()  # of the strip whose lines come
        self._camera = camera
        self._lens = [camera.lenses[i].id for i in camera.lens_of_line]
        self._heights = RoundHeights(0.0, self.options.relief_sigma_m)
        self._poses: deque[tuple[float, Array, Array, Array]] = deque(maxlen=POSES_KEPT)
        self._scene = self._strip = ""
        self._strips: dict[str, _Strip] = {}
        self._of: dict[int, _Strip] = {}  # by number of the view
        self._masters: list[_Master] = []
        self._events: list[str] = []
        self._held, self._share = (0, 0), 1.0
        self._number = 0

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
        """The orientation of a strip of the scene; takes corrections."""
        known = self._strips.get(strip)
        return None if known is None else known.orientation

    def begin_strip(self, strip: str, first_line_time_s: float, line_rate_hz: float) -> None:
        """Lines that follow belong to a strip, begun before or new; those of another scene are forgotten.

        Raises
        ------
        ValueError : a line rate that is not positive, or a name that does not end with a lens
        """
        if not (np.isfinite(line_rate_hz) and line_rate_hz > 0 and np.isfinite(first_line_time_s)):
            raise ValueError(f"strip {strip!r} with {line_rate_hz} lines a second")
        lens = lens_of(self._camera, strip)
        if not lens:
            raise ValueError(f"strip {strip!r}: the camera has several lenses, wanted a name that ends with /lens")
        scene = strip.removesuffix(lens)
        if scene != self._scene:
            self._scene, self._number = scene, 0
            self._strips, self._of, self._masters = {}, {}, []
        self._strip = strip
        if strip not in self._strips:
            begun = self._strips[strip] = self._begun(strip, lens, first_line_time_s, line_rate_hz)
            self._of.update({i: begun for i, of in enumerate(self._lens) if of == lens})
        self.orientation = self._strips[strip].orientation

    def _begun(self, strip: str, lens: str, first_s: float, rate: float) -> _Strip:
        samples = {v.ccd: v.pixels for v, of in zip(self.views, self._lens, strict=True) if of == lens}
        lines = LineIntake(samples, self.options, lambda dtype: self._store(samples, dtype))
        lines.begin_strip(rate)
        orientation = CurrentOrientation()
        for pose in self._poses:
            if pose[0] >= first_s - POSES_BEFORE_S:
                orientation.add_pose(*pose)
        return _Strip(strip, first_s, rate, orientation, lines)

    def _store(self, samples: dict[str, int], dtype: np.dtype) -> LineStore:
        """All lines of a strip, as far as its part of the budget goes."""
        budget = int(self.options.budget_mb * 1e6 / len(self._camera.lenses))
        wanted = budget // sum(n * np.dtype(dtype).itemsize + 1 for n in samples.values())
        return LineStore(samples, dict.fromkeys(samples, max(wanted, 8)), budget, dtype)

    def add_lines(self, ccd: str, first_line: int, pixels: NDArray[np.unsignedinteger]) -> NDArray[np.bool_]:
        """Lines of one CCD line; returns which of them (n,) are fit for use.

        Raises
        ------
        ValueError : a CCD line the lens does not have, lines of another length or pixel type, no strip
        """
        if not self._strip:
            raise ValueError(f"lines of {ccd} before their strip")
        strip = self._strips[self._strip]
        usable = strip.lines.add(ccd, first_line, pixels)
        self._events += strip.lines.take_events()
        self.counters.update(strip.lines.counters)
        strip.lines.counters.clear()
        return usable

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
        """A strip is over: its tie points with the strips of other lenses that are."""
        ended = self._strips.get(strip)
        if ended is None or ended.over:
            return []
        ended.over = True
        ended.orientation.close()
        self._tell_budget(ended)
        out: list[MatchedTie] = []
        for i, view in enumerate(self.views):
            if self._of.get(i) is not ended or ended.ring(view.ccd) is None:
                continue
            earlier = self._ready(i)
            if not earlier:
                continue
            for master in self._masters:
                out += self._look(master, i)
            if all(self._tilt(i) < self._tilt(m.prediction.master) - STEEPER for m in self._masters):
                master = self._new_master(i)
                self._masters.append(master)
                for other in earlier:
                    out += self._look(master, other)
        return out

    def _tell_budget(self, strip: _Strip) -> None:
        for ccd, ring in ((v.ccd, strip.ring(v.ccd)) for v in self.views if v.ccd in (strip.lines.seeing)):
            if ring is not None and ring.start > 0:
                held = f"{self.options.budget_mb:g} MB hold the last {ring.end - ring.start} of its {ring.end} lines"
                self._events.append(f"{ccd}: {held}")

    def _ready(self, of: int) -> list[int]:
        """The views that one can be matched with: those whose strips are over, the most alike in direction first."""
        there = [i for i, s in self._of.items() if s.over and s.ring(self.views[i].ccd) is not None]
        there = [i for i in there if np.isfinite(self._of[i].orientation.end_s)]
        if of not in there:
            return []
        mine = self._middle(of)[1]
        return sorted((i for i in there if i != of), key=lambda i: -float(mine @ self._middle(i)[1]))

    def _middle(self, index: int) -> tuple[Array, Array]:
        """Perspective centre and direction (3,) of a view's middle pixel in the middle of its strip."""
        view, o = self.views[index], self._of[index].orientation
        position, R = o.at([0.5 * (o.start_s + o.end_s)])
        ray = R[0] @ view.rays_c(np.array([0.5 * (view.pixels - 1)]))[0]
        return position[0], ray / np.linalg.norm(ray)

    def _tilt(self, index: int) -> float:
        """Angle between a view and the way down, rad."""
        position, ray = self._middle(index)
        down = -position - np.array([0.0, 0.0, RADIUS_M])
        return float(np.arccos(np.clip(ray @ down / np.linalg.norm(down), -1.0, 1.0)))

    def _new_master(self, index: int) -> _Master:
        """Choose places in all lines of a view."""
        p = _PassPrediction(self.views, index, self.options, self._of, self._heights)
        p.height_and_travel()  # whether the platform is in orbit
        chooser = PlaceChooser(self.options, 2 * LEAST_SQUARES_HALF + 1, len(p.others))
        chooser.density.load = self._share
        chooser.density.window_holds(*self._held)
        ring = self._of[index].ring(self.views[index].ccd)
        assert ring is not None
        places = chooser.choose(ring, p.rate, ring.start, self._of[index].lines.saturated)
        self.counters["places"] += chooser.tried
        self.counters["cells without texture"] += chooser.empty
        return _Master(p, LookMatcher(p, self._image, 0), [Track(place, len(p.others)) for place in places])

    def _image(self, index: int, scan: LineScan, travel: float) -> Image:
        ring = self._of[index].ring(self.views[index].ccd)
        assert ring is not None
        return Image(scan, ring, travel, self._of[index].lines.saturated)

    def _look(self, master: _Master, index: int) -> list[MatchedTie]:
        """Look for the places of a master in a view; the ties and later looks that follow."""
        p, looks = master.prediction, master.looks
        p.corrected()
        view = p.others.index(index)
        lines, samples = (np.array([getattr(t.place, a) for t in master.tracks]) for a in ("line", "sample"))
        own = p.whole(p.master)
        if own is None or p.whole(index) is None or not len(lines):
            return []
        tracks = [t for t, seen in zip(master.tracks, self._seen(p, index, lines, samples), strict=True) if seen]
        if not self._heights.some and not self._find_ground(master, tracks, view):
            self.counters["ground not found"] += len(tracks)
            return []
        out: list[MatchedTie] = []
        waiting: list[tuple[Track, Looked, int]] = []
        for part in _batches(tracks):
            looks.look(part, view)
            found = [track for track in part if track.found[view]]
            looked = looks.finish(found) if found else None
            if looked is not None:
                waiting += [(track, looked, k) for k, track in enumerate(found)]
                out += self._judged(master, view, waiting)
        self.counters["too few looks"] += len(waiting)
        for track, _, _ in waiting:
            track.located[view] = np.nan
        self.counters.update(looks.counters)
        looks.counters.clear()
        return out

    def _seen(self, p: _PassPrediction, index: int, line: Array, sample: Array) -> NDArray[np.bool_]:
        """Which places of the master lie in the lines of a view, about."""
        own, other = p.whole(p.master), p.whole(index)
        assert own is not None and other is not None
        height = np.full(len(line), p.heights.prior_m)
        for _ in range(2):  # the ground falls away from the XY plane
            point, _ = own.to_plane(line, sample, height)
            height, _ = p.heights.at(point[:, :2])
        point, _ = own.to_plane(line, sample, height)
        middle = np.full(len(line), other.first_line + 0.5 * len(other.position_l))
        u, v, _ = other.locate(point, middle, rounds=10)
        last, reach = other.first_line + len(other.position_l), p.options.largest_reach_px
        return np.asarray(
            (u > other.first_line - reach) & (u < last + reach) & (v > 0) & (v < p.views[index].pixels - 1)
        )

    def _find_ground(self, master: _Master, tracks: list[Track], view: int) -> bool:
        """Match some places as if the ground were at one height after another; whether it was found."""
        p = master.prediction
        if len(tracks) < LEAST_FOUND:
            return False
        some = [tracks[i] for i in np.linspace(0, len(tracks) - 1, min(TOGETHER, len(tracks))).astype(int)]
        prior = p.heights.prior_m
        tried = [(height, p.options.largest_reach_px) for height in self._heights_tried(p, p.others[view]).tolist()]
        # a narrow search finds the ground in short strips too, where it is as high as it is thought to be
        for height, reach in [(prior, p.options.least_reach_px), *tried]:
            points = master.looks.try_height(some, view, height, reach)
            if points is not None and len(points) >= max(LEAST_FOUND, SHARE * len(some)):
                p.heights.found(points)
                p.heights_changed()
                if abs(p.heights.prior_m - prior) > 3 * p.heights.prior_sigma_m:
                    found = f"the ground was found at about {p.heights.prior_m:.0f} m above the origin"
                    self._events.append(f"{found}, not at {prior:.0f} m")
                return True
        return False

    def _heights_tried(self, p: _PassPrediction, index: int) -> Array:
        """Heights of the ground, the likeliest first; a search at one of them reaches to the next."""
        above = p.height_and_travel()[0]
        sine = np.linalg.norm(np.cross(self._middle(p.master)[1], self._middle(index)[1]))
        pixel = above * p.views[p.master].pitch_mm / p.views[p.master].focal_length_mm
        step = 2 * (1 - OVERLAP) * p.options.largest_reach_px * pixel / max(float(sine), 1e-3)
        low = min(p.heights.lowest_m, p.heights.prior_m)
        below = int(np.ceil(max(p.heights.prior_m - low, 0.0) / step))
        higher = int(np.ceil(max(HIGHEST_GROUND_M - p.heights.prior_m, 0.0) / step))
        steps = np.arange(-below, higher + 1)
        return p.heights.prior_m + step * steps[np.argsort(np.abs(steps), kind="stable")]

    def _judged(self, master: _Master, view: int, waiting: list[tuple[Track, Looked, int]]) -> list[MatchedTie]:
        """Looks that agree with their neighbours become ties; while there are too few to tell, they wait."""
        p = master.prediction
        parts = [looked.disagreement.select([k]) for _, looked, k in waiting]
        together = Disagreement(
            *(np.concatenate([getattr(d, a) for d in parts]) for a in ("time_s", "across", "residual"))
        )
        good = p.slow.judge(together)
        if good is None:
            return []
        out: list[MatchedTie] = []
        ccd = p.views[p.others[view]].ccd
        strip = {self.views[i].ccd: of.id for i, of in self._of.items()}
        fine = good[:, view]
        self.counters["contradiction"] += int((~fine).sum())
        for (track, looked, k), ok, left in zip(waiting, fine, together.residual[:, view], strict=True):
            if not ok:
                track.located[view] = np.nan
                continue
            name = master.names.get(id(track), "")
            rays = [ray for ray in looked.rays[k] if not name or ray.ccd == ccd]
            if not name:
                self._number += 1
                master.names[id(track)] = f"{self._of[p.master].id}-M{self._number}"
            out.append(
                MatchedTie(
                    master.names[id(track)], tuple(replace(ray, strip=strip[ray.ccd]) for ray in rays),
                    float(looked.score[k]), looked.xyz_l[k], float(np.hypot(*left)), bool(name),
                )
            )  # fmt: skip
        places = [looked.xyz_l[k] for (_, looked, k), ok in zip(waiting, fine, strict=True) if ok]
        p.heights.add(np.reshape(places, (-1, 3)))
        self.counters["ties"] += sum(not tie.again for tie in out)
        self.counters["later looks"] += sum(tie.again for tie in out)
        waiting.clear()
        return out


def _batches(tracks: list[Track]) -> list[list[Track]]:
    """Places that are matched together: first some in the middle of a strip, whose wide search has lines all around."""
    line = np.array([track.place.line for track in tracks])
    if not len(line):
        return []
    nearest = np.argsort(np.abs(line - 0.5 * (line.min() + line.max())), kind="stable")
    first = nearest[:TOGETHER]
    rest = np.sort(nearest[TOGETHER:])
    parts = [first, *(rest[begin : begin + BATCH] for begin in range(0, len(rest), BATCH))]
    return [[tracks[i] for i in part] for part in parts]
