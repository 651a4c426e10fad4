"""Tie points as the lines come in: choose places in the master view, wait for the other looks, match, judge.

The master is the CCD line that looks down most steeply. A place is matched when the last of its looks is in store.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..camera import LineCamera
from ..line_store import LineStore
from .consistency import Disagreement, SlowDisagreement, height_of
from .current_orientation import CurrentOrientation
from .height_guess import HeightGuess
from .interest_points import interest_points
from .line_quality import GOOD, REASONS, judge_lines
from .line_scan import LineScan, View, view_of
from .search import (
    COARSE_REACH,
    COARSEST,
    CORRELATION_HALF,
    LEAST_SQUARES_HALF,
    MARGIN,
    Found,
    Ground,
    Image,
    coarsest_factor,
    find,
)

Array = NDArray[np.floating]

#: Lines around what is needed, for vibration and reduced levels.
PAD = 24
#: Lines of which the orientation is computed around a batch: the widest patch at the coarsest level.
WIDE = 7 * PAD
#: Places are looked for so often.
CHUNK_S, LEAST_CHUNK = 0.25, 8
#: A place waits no longer than this for its other looks once they should be there.
PATIENCE_S = 5.0
#: Looks that are wanted from a line store, s, beyond the time between the first look and the last.
STORE_MARGIN_S = 4.0


@dataclass(frozen=True)
class MatchingOptions:
    """How tie points are made.

    Attributes
    ----------
    points_per_s : places that are tried a second
    largest_sigma_px : places and matches that are measured worse are left out
    least_score : correlation coefficient of a match
    largest_closing_px : by which matching back may miss
    least_reach_px, largest_reach_px : of the search, before anything is known and at all
    relief_sigma_m : of the ground about its mean height, before anything is known
    image_sigma_px : what is added to the sigma of a match for what its residuals do not show
    sigma_factor : on the sigma of a match: residuals of neighbouring pixels are alike
    least_rays : of a tie point
    budget_mb : megabytes for image lines
    full_scale : largest grey value; 0 for 4095, or 255 for 8-bit images

    Raises
    ------
    ValueError : a value that makes no sense
    """

    points_per_s: float = 12.0
    largest_sigma_px: float = 0.1
    least_score: float = 0.75
    largest_closing_px: float = 0.3
    least_reach_px: float = 40.0
    largest_reach_px: float = 80.0
    relief_sigma_m: float = 60.0
    image_sigma_px: float = 0.025
    sigma_factor: float = 1.0
    least_rays: int = 3
    budget_mb: float = 1024.0
    full_scale: int = 0

    def __post_init__(self) -> None:
        for name in ("points_per_s", "largest_sigma_px", "least_reach_px", "budget_mb", "relief_sigma_m"):
            if not 0 < getattr(self, name) < np.inf:
                raise ValueError(f"{name}: wanted more than 0, got {getattr(self, name)}")
        if not self.least_reach_px <= self.largest_reach_px <= 80:
            raise ValueError(f"largest_reach_px: wanted {self.least_reach_px:g} to 80, got {self.largest_reach_px}")
        if not 0 <= self.least_score < 1:
            raise ValueError(f"least_score: wanted 0 to 1, got {self.least_score}")
        if self.least_rays < 2:
            raise ValueError(f"least_rays: wanted at least 2, got {self.least_rays}")


@dataclass(frozen=True)
class MatchedRay:
    """One look at a tie point; px."""

    ccd: str
    line: float
    sample: float
    sigma_line: float
    sigma_sample: float


@dataclass(frozen=True)
class MatchedTie:
    """A tie point; its number in the strip, its looks, correlation, and where it lies with the orientation of now."""

    number: int
    rays: tuple[MatchedRay, ...]
    score: float
    xyz_l: Array


@dataclass(frozen=True)
class _Matched:
    """Places that were matched and wait for a verdict; k places."""

    ties: list[MatchedTie]
    disagreement: Disagreement
    xyz_l: Array

    def __len__(self) -> int:
        return len(self.ties)


class TieMatcher:
    """Turns the image lines of one strip after another into tie points.

    Parameters
    ----------
    camera : line camera with at least two lines across the flight
    options : see `MatchingOptions`

    Attributes
    ----------
    counters : places by what became of them, lines by what was wrong with them
    orientation : of the camera; whoever runs the matcher adds poses and corrections
    """

    def __init__(self, camera: LineCamera, options: MatchingOptions | None = None):
        self.options = options or MatchingOptions()
        if len(camera.lines) < 2:
            raise ValueError("matching wants a camera with at least two CCD lines")
        if len(camera.lenses) != 1:
            raise ValueError(f"matching wants a camera with one lens, {camera.name} has {len(camera.lenses)}")
        self.views = [view_of(camera, i) for i in range(len(camera.lines))]
        self._master = int(np.argmin([abs(view.forward) for view in self.views]))
        self._others = [i for i in range(len(self.views)) if i != self._master]
        self._least_rays = min(self.options.least_rays, len(self.views))
        self.orientation = CurrentOrientation()
        self.counters: Counter[str] = Counter()
        self._events: list[str] = []
        self._heights = HeightGuess(0.0, self.options.relief_sigma_m)
        self._slow = SlowDisagreement(len(self._others))
        self._widest_px = 0.0  # search of late
        self._store: LineStore | None = None
        self._strip = ""
        self._first_s = self._rate = 0.0
        self._pending: list[tuple[int, int]] = []
        self._unjudged: list[_Matched] = []
        self._next_chunk = 0
        self._next_number = 0
        self._last_line: dict[str, NDArray[np.unsignedinteger]] = {}
        self._state: dict[str, int] = {}
        self._ground_state = [0.0, 0.0]

    # -- input ---------------------------------------------------------------------------------------------------------

    def begin_strip(self, strip: str, first_line_time_s: float, line_rate_hz: float) -> None:
        """Lines that follow belong to a strip; what was in store is forgotten.

        Raises
        ------
        ValueError : a line rate that is not positive
        """
        if not (np.isfinite(line_rate_hz) and line_rate_hz > 0 and np.isfinite(first_line_time_s)):
            raise ValueError(f"strip {strip!r} with {line_rate_hz} lines a second")
        self._strip, self._first_s, self._rate = strip, first_line_time_s, line_rate_hz
        self._store = None
        self._pending, self._unjudged, self._last_line = [], [], {}
        self._next_chunk = self._next_number = 0
        self._heights.forget()
        self._slow.forget()
        self.orientation.forget_corrections()

    @property
    def strip(self) -> str:
        """The strip that lines belong to, empty before the first one."""
        return self._strip

    def set_mean_height(self, height_m: float) -> None:
        """What the ground's height is taken for before anything is known, local frame."""
        self._heights.prior_m = height_m

    def add_lines(self, ccd: str, first_line: int, pixels: NDArray[np.unsignedinteger]) -> None:
        """Lines of one CCD.

        Raises
        ------
        ValueError : a CCD line the camera does not have, lines of another length, no strip
        """
        view = next((v for v in self.views if v.ccd == ccd), None)
        if view is None:
            raise ValueError(f"unknown CCD line {ccd!r}")
        if not self._strip:
            raise ValueError(f"lines of {ccd} before their strip")
        if pixels.ndim != 2 or pixels.shape[1] != view.pixels:
            raise ValueError(f"lines of {ccd} of shape {pixels.shape}, wanted {view.pixels} samples")
        if not len(pixels) or first_line < 0:
            raise ValueError(f"no lines of {ccd}, or their number {first_line} is below 0")
        verdict = judge_lines(pixels, self._last_line.get(ccd), self._full_scale(pixels.dtype))
        self._last_line[ccd] = pixels[-1].copy()
        self._tell_lines(ccd, first_line, verdict)
        store = self._store_for(pixels.dtype)
        if store is None:
            self.counters["lines before poses"] += len(pixels)
            return
        missing, late = store.rings[ccd].add(first_line, pixels, verdict == GOOD)
        if missing:
            self.counters["lines missing"] += missing
            self._events.append(f"{ccd}: {missing} lines are missing before line {first_line}")
        if late:
            self.counters["lines twice or late"] += late

    def take_events(self) -> list[str]:
        """What is worth telling since the last call."""
        events, self._events = self._events, []
        return events

    # -- matching ------------------------------------------------------------------------------------------------------

    def match(self) -> list[MatchedTie]:
        """The tie points that have become known."""
        if self._store is None:
            return []
        self._choose_places()
        ready = self._ready()
        out: list[MatchedTie] = []
        # a batch shares one search: what is far apart in time is matched apart
        for begin in range(0, len(ready), 64):
            matched = self._match_places(np.array(ready[begin : begin + 64]))
            if matched is not None and len(matched):
                out += self._judge(matched)
        return out

    def _judge(self, matched: _Matched) -> list[MatchedTie]:
        self._unjudged.append(matched)
        parts = self._unjudged
        d = Disagreement(
            *(np.concatenate([getattr(p.disagreement, n) for p in parts]) for n in ("time_s", "across", "residual"))
        )
        good = self._slow.judge(d)
        if good is None:
            return []
        self._unjudged = []
        ties = [tie for part in parts for tie in part.ties]
        xyz = np.concatenate([part.xyz_l for part in parts])
        # a view without a match is no contradiction, a point with a contradiction is dropped
        fine = (good | ~np.isfinite(d.residual).all(axis=2)).min(axis=1)
        self.counters["contradiction"] += int((~fine).sum())
        self._slow.remember(d.select(fine))
        self._heights.add(xyz[fine])
        accepted = [tie for tie, ok in zip(ties, fine, strict=True) if ok]
        self.counters["ties"] += len(accepted)
        return accepted

    # -- places --------------------------------------------------------------------------------------------------------

    def _choose_places(self) -> None:
        assert self._store is not None
        o, master = self.options, self.views[self._master]
        ring = self._store.rings[master.ccd]
        rows = max(round(CHUNK_S * self._rate), LEAST_CHUNK)
        window = 2 * LEAST_SQUARES_HALF + 1
        half = window // 2 + 2
        if self._next_chunk < ring.start:
            self._next_chunk = ring.start
        while self._next_chunk + rows + half <= ring.end:
            first = self._next_chunk
            self._next_chunk += rows
            stretch = ring.read(first - half, first + rows + half)
            number = first // rows
            cells = max(round(o.points_per_s * rows / self._rate), 1)
            # every other row of cells is shifted by half a cell
            border = np.arange(cells + 1.0) + (0.5 if number % 2 else 0.0)
            columns = np.unique(np.clip(np.concatenate([[0], border / cells * master.pixels]), 0, master.pixels))
            begin = first - stretch.first_line
            found = interest_points(
                stretch.pixels.astype(np.float32), stretch.usable, columns.astype(np.int64), (begin, begin + rows),
                window, o.largest_sigma_px,
            )  # fmt: skip
            self._pending += [
                (int(r) + stretch.first_line, int(c)) for r, c in zip(found.row, found.column, strict=True)
            ]
            self.counters["places"] += len(found.row)
            self.counters["cells without texture"] += found.cells - len(found.row)
            self._tell_ground(found.cells, len(found.row))

    def _ready(self) -> list[tuple[int, int]]:
        """The places whose looks should all be in store; too old ones are given up."""
        assert self._store is not None
        o = self.orientation
        ends = [self._store.rings[view.ccd].end for view in self.views]
        if not self._pending or not np.isfinite(o.end_s):
            return []
        height, travel = self._height_and_travel()
        master = self.views[self._master]
        later = max(master.forward - view.forward for view in self.views) * height / travel
        reach = (MARGIN + LEAST_SQUARES_HALF) + PAD + self._reach_guess()
        known = (o.end_s - self._first_s) * self._rate
        ready, waiting = [], []
        for place in self._pending:
            due = place[0] + max(later, 0.0) + reach
            (ready if due < min(*ends, known) else waiting).append(place)
        # a CCD line that has fallen silent must not hold up everything for ever
        oldest = max(ends) - max(later, 0.0) - reach - PATIENCE_S * self._rate
        kept = [place for place in waiting if place[0] >= oldest]
        self.counters["looks never came"] += len(waiting) - len(kept)
        self._pending = kept
        return ready

    def _reach_guess(self) -> float:
        if self._slow.known:
            return float((CORRELATION_HALF + COARSE_REACH + 2) * coarsest_factor(self._widest_px))
        height, travel = self._height_and_travel()
        reach = max(self._orientation_reach(view, travel) for view in self.views)
        base = max(abs(view.forward) for view in self.views) * 3 * self.options.relief_sigma_m / travel
        factor = coarsest_factor(float(np.clip(np.hypot(reach, base), self.options.least_reach_px, height)))
        return float((CORRELATION_HALF + COARSE_REACH + 2) * factor)

    def _height_and_travel(self) -> tuple[float, float]:
        """Height above ground, and way from one line to the next, now; m."""
        t = self.orientation.end_s
        position, _ = self.orientation.at([t - 1.0 / self._rate * 20, t])
        height = float(position[1, 2]) - float(self._heights.at(position[1:, :2])[0][0])
        return max(height, 1.0), max(float(np.linalg.norm(position[1] - position[0])) / 20, 1e-6)

    # -- a batch -------------------------------------------------------------------------------------------------------

    def _match_places(self, places: NDArray[np.int64]) -> _Matched | None:
        line, sample = places[:, 0].astype(float), places[:, 1].astype(float)
        master_scan = self._scan(self._master, line.min() - WIDE, line.max() + WIDE)
        if master_scan is None:
            self.counters["no orientation"] += len(places)
            return None
        _, travel = self._height_and_travel()
        guess_xy, _ = master_scan.to_plane(line, sample, np.full(len(line), self._heights.prior_m))
        height, sigma_height = self._heights.at(guess_xy[:, :2])
        centre, slope = master_scan.to_plane(line, sample, height)
        ground = self._ground(master_scan, centre)
        time_s = self._first_s + line / self._rate
        across = 2 * sample / self.views[self._master].pixels - 1
        expected = self._slow.expected(time_s, across)

        k, views = len(line), len(self._others)
        shift, parallax = np.full((k, views, 2), np.nan), np.zeros((k, views, 2))
        weight, covariance = np.zeros((k, views)), np.full((k, views, 2, 2), np.inf)
        score, located = np.zeros((k, views)), np.full((k, views, 2), np.nan)
        scale_across = np.ones(views)
        for j, index in enumerate(self._others):
            done = self._match_view(index, master_scan, line, ground, expected[:, j], sigma_height, slope, travel)
            if done is None:
                self.counters["no lines"] += k
                continue
            found, scan, other_line, parallax[:, j] = done
            good = self._accept(found)
            shift[good, j] = found.shift[good]
            covariance[good, j], score[:, j] = found.covariance[good], found.score
            weight[good, j] = 1.0
            place = ground.moved(np.where(good[:, None], found.shift, 0.0)).centre_l
            u, v, inside = scan.locate(place, other_line + found.shift[:, 0] * ground.spacing_m / travel)
            ok = good & inside & np.isfinite(u)
            located[ok, j] = np.column_stack([u, v])[ok]
            shift[~ok, j] = np.nan
            scale_across[j] = self._sample_m(scan, place, u)
        rays = 1 + np.isfinite(shift).all(axis=2).sum(axis=1)
        enough = rays >= self._least_rays
        self.counters["too few looks"] += int((~enough).sum())
        if not enough.any():
            return None
        dz, residual = height_of(shift - expected, parallax, weight)
        residual = residual + expected
        xyz = np.column_stack([centre[:, :2] + slope * dz[:, None], height + dz])
        pixel = ground.spacing_m, travel, self._sample_m(master_scan, centre, line), scale_across
        ties = [
            self._tie(places[i], located[i], covariance[i], score[i], xyz[i], pixel) for i in np.flatnonzero(enough)
        ]
        return _Matched(ties, Disagreement(time_s[enough], across[enough], residual[enough]), xyz[enough])

    def _match_view(
        self, index: int, master_scan: LineScan, line: Array, ground: Ground, expected: Array, sigma_height: Array,
        slope: Array, travel: float,
    ) -> tuple[Found, LineScan, Array, Array] | None:  # fmt: skip
        """Matches in one view: what was found, its lines, the predicted line, and the parallax per metre, px."""
        view, m = self.views[index], self.views[self._master]
        above = float(np.median(master_scan.position_l[:, 2])) - ground.centre_l[:, 2]
        away = (m.forward - view.forward) * above / travel
        wide = self._scan(index, (line + away).min() - 2 * WIDE, (line + away).max() + 2 * WIDE)
        if wide is None:
            return None
        moved = ground.moved(expected)
        other_line, _, _ = wide.locate(moved.centre_l, line + away, rounds=5)
        other_line = np.clip(other_line, wide.first_line, wide.first_line + len(wide.position_l) - 1)
        # slope of the other rays, for what height does
        camera = wide.position_l[(other_line - wide.first_line).astype(int)]
        other_slope = (moved.centre_l[:, :2] - camera[:, :2]) / (moved.centre_l[:, 2:] - camera[:, 2:])
        axes = np.stack([ground.along, ground.across]) / ground.spacing_m
        parallax = (slope - other_slope) @ axes.T
        reach = self._reach(index, ground, sigma_height, parallax)
        master = self._image(self._master, master_scan, travel)
        image = self._image(index, wide, travel)
        base_line = other_line - expected[:, 0] * ground.spacing_m / travel
        found = find(master, line, ground, image, expected, base_line, reach)
        return found, image.scan, base_line, parallax

    def _reach(self, index: int, ground: Ground, sigma_height: Array, parallax: Array) -> float:
        """Three sigma of the prediction in px: orientation of both looks, height, and what the past has shown."""
        o = self.options
        by_height = float((sigma_height * np.abs(parallax).max(axis=1)).max())
        if self._slow.known:
            scale = self._slow.scale_px[self._others.index(index)]
            by_orientation = float(np.max(np.where(np.isfinite(scale), scale, o.least_reach_px / 3)))
            least = 4.0
        else:
            by_orientation = self._orientation_reach(self.views[index], ground.spacing_m) / 3
            least = o.least_reach_px
        return float(np.clip(3 * np.hypot(by_height, by_orientation), least, o.largest_reach_px))

    def _orientation_reach(self, view: View, pixel_m: float) -> float:
        """Three sigma, px, by which the orientation of two looks may be wrong."""
        sigma = np.sqrt(np.diagonal(self.orientation.covariance(self.orientation.end_s)))
        look = np.hypot(sigma[:3].max(), self._height_and_travel()[0] * sigma[3:].max() * (1 + view.forward**2))
        return float(3 * np.sqrt(2.0) * look / pixel_m)

    def _accept(self, found: Found) -> NDArray[np.bool_]:
        o = self.options
        reason = found.reason.copy()
        sigma = np.sqrt(np.maximum(np.diagonal(found.covariance, axis1=1, axis2=2).max(axis=1), 0.0))
        for name, bad in (
            ("low correlation", found.score < o.least_score),
            ("no way back", ~(found.closing <= o.largest_closing_px)),
            ("imprecise", ~(sigma <= o.largest_sigma_px)),
        ):
            reason[(reason == "") & bad] = name
        names, counts = np.unique(reason[reason != ""], return_counts=True)
        self.counters.update(dict(zip(names.tolist(), counts.tolist(), strict=True)))
        return reason == ""

    def _tie(
        self, place: NDArray[np.int64], located: Array, covariance: Array, score: Array, xyz_l: Array,
        pixel: tuple[float, float, float, Array],
    ) -> MatchedTie:  # fmt: skip
        """Half of a match's variance belongs to each of its two images."""
        spacing, travel, master_sample, scale_across = pixel
        known = np.isfinite(located).all(axis=1)
        half = 0.5 * self.options.sigma_factor**2 * np.diagonal(covariance[known], axis1=1, axis2=2)
        floor = 0.5 * self.options.image_sigma_px**2
        own = half.mean(axis=0) * (spacing / np.array([travel, master_sample])) ** 2 + floor
        view = self.views[self._master]
        rays = [MatchedRay(view.ccd, float(place[0]), float(place[1]), float(own[0] ** 0.5), float(own[1] ** 0.5))]
        for (line, sample), variance, j in zip(located[known], half, np.flatnonzero(known), strict=True):
            v = variance * (spacing / np.array([travel, scale_across[j]])) ** 2 + floor
            rays.append(
                MatchedRay(
                    self.views[self._others[j]].ccd, float(line), float(sample), float(v[0] ** 0.5), float(v[1] ** 0.5)
                )
            )
        self._next_number += 1
        return MatchedTie(self._next_number, tuple(rays), float(score[known].min()), xyz_l)

    # -- geometry ------------------------------------------------------------------------------------------------------

    def _scan(self, index: int, first: float, last: float) -> LineScan | None:
        """Lines of a view with their orientation, as far as there is one."""
        o = self.orientation
        low = max(int(np.floor(first)), int(np.ceil((o.start_s - self._first_s) * self._rate)) + 1)
        high = min(int(np.ceil(last)), int(np.floor((o.end_s - self._first_s) * self._rate)) - 1)
        if high - low < 4:
            return None
        position, R = o.at(self._first_s + np.arange(low, high + 1) / self._rate)
        return LineScan(self.views[index], low, position, R)

    def _image(self, index: int, scan: LineScan, travel: float) -> Image:
        assert self._store is not None
        return Image(scan, self._store.rings[self.views[index].ccd], travel)

    def _ground(self, scan: LineScan, centre: Array) -> Ground:
        way = scan.position_l[-1, :2] - scan.position_l[0, :2]
        along = way / np.linalg.norm(way)
        left = np.array([-along[1], along[0]])
        across = left if self.views[self._master].sample[0] < self.views[self._master].sample[-1] else -left
        spacing = self._sample_m(scan, centre, np.full(len(centre), scan.first_line + len(scan.position_l) // 2))
        return Ground(centre, along, across, spacing)

    @staticmethod
    def _sample_m(scan: LineScan, point_l: Array, line: Array) -> float:
        """Size of a pixel across on the ground, m."""
        i = np.clip(np.nan_to_num(line) - scan.first_line, 0, len(scan.position_l) - 1).astype(int)
        depth = np.median(scan.position_l[i, 2] - point_l[:, 2])
        return float(depth * scan.view.pitch_mm / scan.view.focal_length_mm)

    # -- store and words -----------------------------------------------------------------------------------------------

    def _store_for(self, dtype: np.dtype) -> LineStore | None:
        """Rings as long as the looks need; made when the first poses tell how fast the ground goes by."""
        if self._store is None and np.isfinite(self.orientation.end_s):
            height, travel = self._height_and_travel()
            earliest = min(view.forward for view in self.views)
            margin = 2 * (CORRELATION_HALF + COARSE_REACH + 2) * COARSEST + 4 * PAD
            lines = {
                view.ccd: int((view.forward - earliest) * 1.1 * height / travel + STORE_MARGIN_S * self._rate + margin)
                for view in self.views
            }
            self._store = LineStore(
                {v.ccd: v.pixels for v in self.views}, lines, int(self.options.budget_mb * 1e6), dtype
            )
            if self._store.share < 1:
                share = f"{100 * self._store.share:.0f} %"
                self._events.append(f"{self.options.budget_mb:g} MB hold {share} of the lines that matching wants")
        return self._store

    def _full_scale(self, dtype: np.dtype) -> int:
        return self.options.full_scale or (255 if dtype == np.uint8 else 4095)

    def _tell_lines(self, ccd: str, first_line: int, verdict: NDArray[np.int8]) -> None:
        """Count bad lines; tell where bad ones begin and where they end."""
        bad = verdict[verdict != GOOD]
        for code, n in zip(*np.unique(bad, return_counts=True), strict=True):
            self.counters[f"lines {REASONS[code]}"] += int(n)
        state = int(np.bincount(bad).argmax()) if 2 * len(bad) > len(verdict) else GOOD
        if state != self._state.get(ccd, GOOD):
            self._state[ccd] = state
            what = "lines are good again" if state == GOOD else f"lines are {REASONS[state]}"
            self._events.append(f"{ccd}: {what} from about line {first_line}")

    def _tell_ground(self, cells: int, found: int) -> None:
        """Tell where the ground becomes poor in texture, and where it is good again; over some seconds."""
        keep = 1.0 - CHUNK_S / 3.0
        self._ground_state[0] = keep * self._ground_state[0] + (1 - keep) * (found / max(cells, 1) - 1.0)
        poor = self._ground_state[0] < -0.6
        if poor != bool(self._ground_state[1]) and (poor or self._ground_state[0] > -0.4):
            self._ground_state[1] = float(poor)
            self._events.append("the ground is poor in texture" if poor else "the ground has texture again")


__all__ = ["MatchedRay", "MatchedTie", "MatchingOptions", "TieMatcher", "View"]
