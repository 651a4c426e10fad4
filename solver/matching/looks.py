"""The looks at places, view after view: each place of the master is matched in the other views, and gets its height.

A view is matched as soon as its look is in store. What was found tells how high the ground is, and with that the next
view is looked for within a few pixels; a place that fails in one view is not looked for in the others, unless it can do
without.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from .consistency import Disagreement, height_of
from .line_scan import LineScan
from .options import MatchedRay, MatchingOptions, Place
from .prediction import WIDE, Prediction, sample_m
from .search import Found, Ground, Imagery, find

Array = NDArray[np.floating]

#: Standard deviation of a match, px, that heights from it are taken to have at least.
LEAST_MATCH_PX = 0.1


@dataclass(eq=False)
class Track:
    """A place on its way to a tie point.

    Attributes
    ----------
    place : as it was chosen
    height_m : of the ground, guessed, or from the views in which it was found; NaN before that
    tried : (views,) in which views it was looked for
    located : (views, 2) line and sample there, NaN where it was not found
    covariance : (views, 2, 2) of the matches, px^2 of the ground grid
    score : (views,) correlation coefficients
    """

    place: Place
    views: int
    height_m: float = np.nan
    tried: NDArray[np.bool_] = field(init=False)
    located: Array = field(init=False)
    covariance: Array = field(init=False)
    score: Array = field(init=False)

    def __post_init__(self) -> None:
        self.tried = np.zeros(self.views, dtype=bool)
        self.located = np.full((self.views, 2), np.nan)
        self.covariance = np.full((self.views, 2, 2), np.inf)
        self.score = np.ones(self.views)

    @property
    def found(self) -> NDArray[np.bool_]:
        """(views,) where it was found."""
        return np.isfinite(self.located[:, 0])

    def next_view(self, order: Sequence[int]) -> int:
        """The first of the views in an order in which it was not looked for; -1 if there is none."""
        return next((view for view in order if not self.tried[view]), -1)


@dataclass(frozen=True)
class Looked:
    """Places that were matched and wait for a verdict; k of them.

    Attributes
    ----------
    places : as they were chosen
    rays : of each, the master's first
    score : (k,) least correlation coefficient
    xyz_l : (k, 3) with the orientation of now
    disagreement : what is left of their shifts
    chip : (k, n, n) what the master saw about them, on the ground; empty where no patches are kept
    holes : (k, n, n) what of it was not measured; None for no such pixel
    ground : the grids of the chips
    """

    places: list[Place]
    rays: list[tuple[MatchedRay, ...]]
    score: Array
    xyz_l: Array
    disagreement: Disagreement
    chip: NDArray[np.floating] = field(repr=False)
    holes: NDArray[np.bool_] | None = field(repr=False)
    ground: Ground

    def __len__(self) -> int:
        return len(self.places)


@dataclass(frozen=True)
class _Geometry:
    """Where the rays of k places lie, with the orientation of now, on grids at guessed heights.

    Attributes
    ----------
    line, sample : (k,) in the master
    ground, slope : the grids, and the slopes (k, 2) of the master's rays
    travel : way of the platform from line to line, m
    expected : (k, views, 2) shifts to be expected, px
    shift, parallax : (k, views, 2) of the views in which a place was found, px, px a metre of height; else NaN, 0
    sample_m : (1 + views,) size of a pixel across, m, the master's first
    """

    scan: LineScan
    line: Array
    sample: Array
    ground: Ground
    slope: Array
    travel: float
    expected: Array
    shift: Array
    parallax: Array
    sample_m: Array


class LookMatcher:
    """Matches places in the views.

    Parameters
    ----------
    prediction : of the strip
    image : gives the lines of a view: (index of the view, scan, way from line to line) -> `Imagery`
    chip_half : half side of the patches that are kept for later strips, px; 0 for none

    Attributes
    ----------
    seeing : the CCD lines that see; the others are done without, as long as there are two
    sees_from : lines from which on some of them do, that did not before
    """

    def __init__(self, prediction: Prediction, image: Callable[[int, LineScan, float], Imagery], chip_half: int):
        self.prediction = prediction
        self.counters: Counter[str] = Counter()
        self.seeing = frozenset(view.ccd for view in prediction.views)
        self.sees_from: Mapping[str, int] = {}
        self._image, self._chip_half = image, chip_half

    @property
    def least_rays(self) -> int:
        """Rays that a tie point needs now."""
        return min(self.prediction.options.least_rays, max(len(self.seeing), 2))

    def least_rays_of(self, track: Track) -> int:
        """Rays that a place needs to become a tie point: without the views that saw nothing when they came to it."""
        p, gone = self.prediction, 0
        for index in p.others if self.sees_from else ():
            ccd = p.views[index].ccd
            if ccd in self.seeing and ccd in self.sees_from:
                look = track.place.line + p.lines_later(index, np.array([p.nadir_m]))[0]
                gone += bool(look < self.sees_from[ccd])
        return min(self.least_rays, max(len(self.seeing) - gone, 2))

    def guess_heights(self, tracks: Sequence[Track]) -> None:
        """Give places the heights of their neighbours."""
        p = self.prediction
        line, sample = _at(tracks)
        scan = p.scan(p.master, line.min() - 4, line.max() + 4)
        if scan is None:
            return
        xy, _ = scan.to_plane(line, sample, np.full(len(line), p.heights.prior_m))
        for track, height in zip(tracks, p.heights.at(xy[:, :2])[0].tolist(), strict=True):
            track.height_m = height

    def look(self, tracks: Sequence[Track], view: int) -> None:
        """Look for places in a view (of the others); notes in the tracks what was found."""
        p = self.prediction
        for track in tracks:
            track.tried[view] = True
        line, sample = _at(tracks)
        scan = p.scan(p.master, line.min() - WIDE, line.max() + WIDE)
        if scan is None:
            self.counters["no orientation"] += len(tracks)
            return
        guess_l, _ = scan.to_plane(line, sample, np.full(len(line), p.heights.prior_m))
        height, sigma_m = p.heights.at(guess_l[:, :2])
        known = np.array([track.found.any() for track in tracks])
        if known.any():
            height = np.where(known, [track.height_m for track in tracks], height)
            g = self._geometry(tracks, scan, height)
            dz, _ = height_of(g.shift - g.expected, g.parallax, np.isfinite(g.shift[:, :, 0]).astype(float))
            height = np.where(known, height + dz, height)
            base = np.hypot(*g.parallax.transpose(2, 0, 1)).max(axis=1)
            px = max(np.hypot(p.sigma_px(i, g.ground.spacing_m), LEAST_MATCH_PX) for i in p.others)
            sigma_m = np.where(known, np.minimum(px / np.maximum(base, 1e-6), sigma_m), sigma_m)
        g = self._geometry(tracks, scan, height)
        done = self._match_view(view, g, sigma_m)
        if done is None:
            self.counters["no lines"] += len(tracks)
            return
        found, located, parallax = done
        good = np.isfinite(located[:, 0])
        # the height that the match tells; until points are judged it is the best guess for their neighbours
        base = np.maximum(np.sum(parallax**2, axis=1), 1e-12)
        dz = np.where(good & ~known, np.sum(parallax * (found.shift - g.expected[:, view]), axis=1) / base, 0.0)
        for i, track in enumerate(tracks):
            track.height_m = float(height[i] + dz[i])
            if good[i]:
                track.located[view], track.covariance[view] = located[i], found.covariance[i]
                track.score[view] = found.score[i]
        new = good & ~known
        p.heights.add((g.ground.centre_l + np.column_stack([g.slope * dz[:, None], dz]))[new])

    def try_height(
        self, tracks: Sequence[Track], view: int, height_m: float, reach_px: float | None = None
    ) -> tuple[Array, int]:
        """Points (n, 3) of the places that are found in a view with a search about a height, and how many places have
        the lines for it; nothing is noted.

        ``reach_px`` is how far is searched, the largest reach if None. No lines are those without orientation, too.
        """
        p = self.prediction
        line, sample = _at(tracks)
        scan = p.scan(p.master, line.min() - WIDE, line.max() + WIDE)
        if scan is None:
            return np.empty((0, 3)), 0
        guess_l, _ = scan.to_plane(line, sample, np.full(len(tracks), height_m))
        g = self._geometry(tracks, scan, p.heights.level(guess_l[:, :2], height_m))
        done = self._search_view(view, g, p.options.largest_reach_px if reach_px is None else reach_px)
        if done is None:
            return np.empty((0, 3)), 0
        found, _, _, parallax = done
        base = np.maximum(np.sum(parallax**2, axis=1), 1e-12)
        dz = np.sum(parallax * (found.shift - g.expected[:, view]), axis=1) / base
        good = verdict(found, p.options) == ""
        points = (g.ground.centre_l + np.column_stack([g.slope * dz[:, None], dz]))[good]
        return points, int((found.reason != "no lines").sum())

    def finish(self, tracks: Sequence[Track]) -> Looked | None:
        """Places that have been looked for in all views become points; None if none was found often enough."""
        p = self.prediction
        enough = [track for track in tracks if 1 + track.found.sum() >= self.least_rays_of(track)]
        self.counters["too few looks"] += len(tracks) - len(enough)
        if not enough:
            return None
        line, _ = _at(enough)
        scan = p.scan(p.master, line.min() - WIDE, line.max() + WIDE)
        if scan is None:
            self.counters["no orientation"] += len(enough)
            return None
        height = np.array([track.height_m for track in enough])
        g = self._geometry(enough, scan, height)
        weight = np.isfinite(g.shift[:, :, 0]).astype(float)
        dz, _ = height_of(g.shift - g.expected, g.parallax, weight)
        # nothing that a height explains may stay in what is expected of the next points: it would never leave it again
        _, residual = height_of(g.shift, g.parallax, weight)
        xyz = g.ground.centre_l + np.column_stack([g.slope * dz[:, None], dz])
        pixel_m = np.column_stack([np.full(len(g.sample_m), g.travel), g.sample_m])
        # a place is where a noisy pose sees it: line by attitude about y, sample about x, position for both
        noise = p.orientation.noise_left
        wobble = (noise[:2].mean() + p.height_and_travel()[0] ** 2 * noise[[4, 3]]) / pixel_m**2
        rays = [self._rays(track, g.ground.spacing_m / pixel_m, wobble) for track in enough]
        ground = Ground(xyz, g.ground.along, g.ground.across, g.ground.spacing_m)
        chip, holes = np.empty((len(enough), 0, 0)), None
        if self._chip_half:
            patches = self._image(p.master, scan, g.travel).patches(ground, line, self._chip_half, 1)
            chip, holes = patches.values, patches.holes
        across = 2 * g.sample / p.views[p.master].pixels - 1
        return Looked(
            [track.place for track in enough], rays, np.array([track.score.min() for track in enough]), xyz,
            Disagreement(p.when(line, xyz), across, residual), chip, holes, ground,
        )  # fmt: skip

    def _geometry(self, tracks: Sequence[Track], scan: LineScan, height: Array) -> _Geometry:
        p = self.prediction
        line, sample = _at(tracks)
        centre, slope = scan.to_plane(line, sample, height)
        ground = p.ground(scan, centre)
        axes = np.stack([ground.along, ground.across]) / ground.spacing_m
        located = np.stack([track.located for track in tracks])
        shift, parallax = np.full(located.shape, np.nan), np.zeros(located.shape)
        pixel_m = np.full(1 + len(p.others), sample_m(scan, centre, line))
        for j, index in enumerate(p.others):
            seen = np.isfinite(located[:, j, 0])
            u, v = located[seen, j].T
            other = p.scan(index, u.min() - 4, u.max() + 4) if seen.any() else None
            if other is None:
                continue
            there, other_slope = other.to_plane(u, v, height[seen])
            shift[seen, j] = (there - centre[seen])[:, :2] @ axes.T
            parallax[seen, j] = (slope[seen] - other_slope) @ axes.T
            pixel_m[1 + j] = sample_m(other, there, u)
        _, travel = p.height_and_travel()
        across = 2 * sample / p.views[p.master].pixels - 1
        expected = p.slow.expected(p.when(line, centre), across)
        return _Geometry(scan, line, sample, ground, slope, travel, expected, shift, parallax, pixel_m)

    def _match_view(self, view: int, g: _Geometry, sigma_height: Array) -> tuple[Found, Array, Array] | None:
        """Matches in one view: what was found; line and sample there (k, 2), NaN unless good; parallax (k, 2)."""
        p, index = self.prediction, self.prediction.others[view]
        done = self._search_view(view, g, sigma_height)
        if done is None:
            return None
        found, wide, base_line, parallax = done
        good = self._accept(found)
        p.searched(index, float((found.reason == "beyond search").mean()))
        place = g.ground.moved(np.where(good[:, None], found.shift, 0.0)).centre_l
        u, v, inside = wide.locate(place, base_line + found.shift[:, 0] * g.ground.spacing_m / g.travel)
        good &= inside & np.isfinite(u)
        return found, np.where(good[:, None], np.column_stack([u, v]), np.nan), parallax

    def _search_view(
        self, view: int, g: _Geometry, around: Array | float
    ) -> tuple[Found, LineScan, Array, Array] | None:
        """What was found in one view, its lines, the line (k,) of each place without its shift, and parallax (k, 2).

        ``around`` is how far is searched, px, or the sigma (k,) of the heights that tells it.
        """
        p = self.prediction
        index = p.others[view]
        expected, ground = g.expected[:, view], g.ground
        there = p.look_lines(index, g.line, ground.centre_l)
        wide = p.scan(index, there.min() - 2 * WIDE, there.max() + 2 * WIDE)
        if wide is None:
            return None
        moved = ground.moved(expected)
        other_line, _, _ = wide.locate(moved.centre_l, there, rounds=5)
        other_line = np.clip(other_line, wide.first_line, wide.first_line + len(wide.position_l) - 1)
        # slope of the other rays, for what height does
        camera = wide.position_l[(other_line - wide.first_line).astype(int)]
        other_slope = (moved.centre_l[:, :2] - camera[:, :2]) / (moved.centre_l[:, 2:] - camera[:, 2:])
        axes = np.stack([ground.along, ground.across]) / ground.spacing_m
        parallax = (g.slope - other_slope) @ axes.T
        reach = p.reach(index, ground, around, parallax) if isinstance(around, np.ndarray) else float(around)
        master, other = self._image(p.master, g.scan, g.travel), self._image(index, wide, g.travel)
        base_line = other_line - expected[:, 0] * ground.spacing_m / g.travel
        return find(master, g.line, ground, other, expected, base_line, reach), wide, base_line, parallax

    def _accept(self, found: Found) -> NDArray[np.bool_]:
        reason = verdict(found, self.prediction.options)
        names, counts = np.unique(reason[reason != ""], return_counts=True)
        self.counters.update(dict(zip(names.tolist(), counts.tolist(), strict=True)))
        return reason == ""

    def _rays(self, track: Track, px: Array, wobble: Array) -> tuple[MatchedRay, ...]:
        """Half of a match's variance belongs to each of its two images.

        ``px`` is ground grid to pixels, ``wobble`` the variance by noisy poses, px^2; per view, of line and sample.
        """
        p, place = self.prediction, track.place
        known = np.flatnonzero(track.found)
        turn = np.stack([p.turn(p.others[j]) for j in known])
        own_half = 0.5 * np.diagonal(track.covariance[known], axis1=1, axis2=2)
        half = 0.5 * np.einsum("nij,njk,nik->ni", turn, track.covariance[known], turn)
        floor = 0.5 * p.options.image_sigma_px**2
        own = own_half.mean(axis=0) * px[0] ** 2 + floor if place.variance is None else np.array(place.variance)
        own = own + wobble[0]
        ccd = p.views[p.master].ccd
        rays = [MatchedRay(ccd, place.line, place.sample, float(own[0] ** 0.5), float(own[1] ** 0.5))]
        for j, variance in zip(known, half, strict=True):
            v = np.sqrt(variance * px[1 + j] ** 2 + floor + wobble[1 + j])
            line, sample = track.located[j].tolist()
            rays.append(MatchedRay(p.views[p.others[j]].ccd, line, sample, float(v[0]), float(v[1])))
        return tuple(rays)


def _at(tracks: Sequence[Track]) -> tuple[Array, Array]:
    """Lines and samples (k,) of places."""
    line, sample = np.array([[track.place.line, track.place.sample] for track in tracks]).T
    return line, sample


def verdict(found: Found, options: MatchingOptions) -> NDArray[np.str_]:
    """(k,) why a match is not taken, empty for good ones."""
    reason = found.reason.copy()
    sigma = np.sqrt(np.maximum(np.diagonal(found.covariance, axis1=1, axis2=2).max(axis=1), 0.0))
    for name, bad in (
        ("low correlation", found.score < options.least_score),
        ("no way back", ~(found.closing <= options.largest_closing_px)),
        ("imprecise", ~(sigma <= options.largest_sigma_px)),
    ):
        reason[(reason == "") & bad] = name
    return reason
