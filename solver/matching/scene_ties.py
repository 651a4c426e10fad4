"""Tie points between all images of a block that overlap, by their location models: of satellites, or any with an RPC.

Pairs are gone through one after the other. In each, places of good texture are chosen evenly over what both images see
and looked for in the other one, and in every further image that sees them: one place is one point in all of them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from ..geometry.ellipsoid import WGS84
from .consistency import height_of
from .interest_points import interest_point
from .looks import verdict
from .options import REAL_FLOOR_PX, MatchingOptions
from .places import APART
from .scene_patches import SceneView, mapping, parallaxes, transferred
from .scene_search import (
    FEWEST,
    Neighbours,
    Pair,
    Told,
    agreeing,
    first_neighbours,
    neighbours_of,
    nobody,
    pair_of,
    part_of,
    plane_fit,
    shifts_between,
)
from .search import LEAST_SQUARES_HALF, MARGIN

Array = NDArray[np.floating]
Mask = NDArray[np.bool_]

#: Side of the window of least squares, px; half of it and its margin must lie in the image.
WINDOW = 2 * LEAST_SQUARES_HALF + 1
#: Cells in which one place is chosen: least side, px, and of larger ones so much in the middle is looked at.
LEAST_CELL, MOST_CELL = 14, 256
#: So many more places are tried than points are wanted: some are not found again.
TRIED = 1.3
#: Places of the wide search, and nodes a side of the grid on which an overlap is looked for.
FIRST_PLACES, NODES = 64, 100
#: Places so near to the edge of the other image cannot be matched, px of the grids: half a window with its margin.
MARGIN_PX = LEAST_SQUARES_HALF + MARGIN + 3
#: Rounds in which places are looked for, and for what reasons again.
ROUNDS, AGAIN = 3, ("beyond search", "low correlation", "not converged")
#: Heights at which an overlap is looked for.
LEVELS = 5
#: Pixels of the coarser image of two are larger by this, at least, for it to be the master.
COARSER = 1.1
#: Said of images that do not see the same ground, and of those that do where no height is known.
ELSEWHERE = "do not overlap"
NO_HEIGHT = "no height is known where both may see the ground: the raster has none there (a hole), or ends"
#: Shares of the work of a pair, about: of its first look, in that of choosing places, and in the rest of the same.
FIRST_SHARE, FIRST_CHOSEN_SHARE, CHOSEN_SHARE = 0.3, 0.2, 0.3
#: Shares that are done when each round ends in which places are looked for: few are left after the first.
ROUND_ENDS = (0.0, 0.8, 0.9, 1.0)
#: Floor of robust standard deviations, px.
FLOOR_PX = 0.05
#: No places.
NOWHERE = np.empty((0, 2))


@dataclass(frozen=True)
class SceneMatching:
    """How tie points of scenes are made.

    Attributes
    ----------
    points : wanted in each pair
    low_m, high_m : between which heights above the ellipsoid the ground may lie; of given heights, how wrong they are
    height_m : heights (k,) of pixels (k, 2) of a view, NaN where not known; None where heights are not given
    search_m : how far apart on the ground the location models may put the same place
    matching : what a match must be
    """

    points: int
    low_m: float
    high_m: float
    height_m: Callable[[SceneView, Array], Array] | None
    search_m: float
    matching: MatchingOptions = field(
        default_factory=lambda: MatchingOptions(image_sigma_px=REAL_FLOOR_PX, largest_sigma_px=0.25)
    )

    @property
    def middle_m(self) -> float:
        return 0.5 * (self.low_m + self.high_m)

    def heights(self, view: SceneView, place: Array) -> Array:
        """Heights (k,) at which the ground under places (k, 2) is looked for."""
        if self.height_m is None:
            return np.full(len(place), self.middle_m)
        found = self.height_m(view, place)
        return np.where(np.isfinite(found), found + self.middle_m, np.nan)


@dataclass
class PairReport:
    """What became of a pair.

    Attributes
    ----------
    images, names : master and other image
    overlap : share of the master's image that the other one sees
    gsd_m : of the master
    tried, found, kept : places tried for this pair; matched in the other image; points that both images have in the
        end, those that agree and of other pairs
    misfit_px : by which rays of both images miss each other by the models as they are, root mean square, px of the
        master
    left_px : what is left of it about a plane
    why : no points came of it, in words; "" otherwise
    """

    images: tuple[int, int]
    names: tuple[str, str]
    overlap: float = 0.0
    gsd_m: float = 0.0
    tried: int = 0
    found: int = 0
    kept: int = 0
    misfit_px: float = np.nan
    left_px: float = np.nan
    why: str = ""


@dataclass(frozen=True)
class ScenePoint:
    """A tie point: image -> line, sample, and their sigma, px."""

    rays: dict[int, tuple[float, float, float]]


@dataclass
class _Known:
    """What is known of an ordered pair.

    Attributes
    ----------
    pair : of images
    rise_m : so much higher than `SceneMatching.heights` the ground is taken in it
    neighbours : where places of the master are found in the other image
    overlap : (NODES^2,) which nodes of the master's grid the other image sees
    """

    pair: Pair
    rise_m: float
    neighbours: Neighbours
    overlap: Mask


@dataclass(frozen=True)
class _Looks:
    """Where k places of a master were found in another image.

    Attributes
    ----------
    found : (k,) whether there is a good match
    good : (k,) whether it also agrees with the others
    pixel : (k, 2) of the other image
    sigma_px, own_px : (k,) of line and sample there, and in the master
    """

    found: Mask
    good: Mask
    pixel: Array
    sigma_px: Array
    own_px: Array


class SceneMatcher:
    """Finds the tie points of a block of images.

    Parameters
    ----------
    views : the images
    how : see `SceneMatching`
    told : called with the share of the work that is done
    """

    def __init__(self, views: Sequence[SceneView], how: SceneMatching, told: Told | None = None):
        self.views, self.how = views, how
        self._told = told or nobody
        self._known: dict[tuple[int, int], _Known | str] = {}

    def match(self) -> tuple[list[ScenePoint], list[PairReport]]:
        """All tie points, and a report of each pair that may overlap."""
        points: list[ScenePoint] = []
        reports = []
        pairs = list(combinations(range(len(self.views)), 2))
        for number, (i, j) in enumerate(pairs):
            a, b = self._master_first(i, j)
            report = PairReport((a, b), (self.views[a].name, self.views[b].name))
            reports.append(report)
            told = part_of(self._told, number / len(pairs), (number + 1) / len(pairs))
            known = self._pair(a, b, part_of(told, 0.0, FIRST_SHARE))
            if isinstance(known, str):
                report.why = known
            else:
                report.gsd_m, report.overlap = self._gsd(a), float(known.overlap.mean())
                points += self._points_of(a, b, known, points, report, part_of(told, FIRST_SHARE, 1.0))
            told(1.0)
        for report in reports:
            self._tell_misfit(report, points)
        return points, reports

    def _gsd(self, i: int) -> float:
        """Size of a pixel on the ground, m: the square root of the area."""
        view = self.views[i]
        middle = 0.5 * (np.array(view.pixels.first) + view.pixels.end)
        pixel = middle + np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
        h = np.where(np.isfinite(h := self.how.heights(view, pixel)), h, 0.0)
        lat, lon, _ = view.location.direct(pixel[:, 0], pixel[:, 1], h).T
        ground = getattr(view.location, "ellipsoid", WGS84).cartesian(lat, lon, h)
        return float(np.sqrt(np.linalg.norm(np.cross(ground[1] - ground[0], ground[2] - ground[0]))))

    def _master_first(self, i: int, j: int) -> tuple[int, int]:
        return (j, i) if self._gsd(j) > COARSER * self._gsd(i) else (i, j)

    def _pair(self, a: int, b: int, told: Told) -> _Known | str:
        """What is known of a pair, found when it is asked for first; in words where there is nothing."""
        if (a, b) not in self._known:
            self._known[a, b] = self._first_look(a, b, told)
        return self._known[a, b]

    def _first_look(self, a: int, b: int, told: Told) -> _Known | str:
        """The pair by a wide search with few places, or why there is nothing."""
        master, other, how = self.views[a], self.views[b], self.how
        grid = master.grid(NODES)
        h = how.heights(master, grid)
        there = np.isfinite(h)
        # where no height is known, that of elsewhere tells whether there is ground that both see
        h = np.where(there, h, np.median(h[there]) if there.any() else how.middle_m)
        half, seen = 0.5 * (how.high_m - how.low_m), np.zeros(len(grid), dtype=bool)
        for level in np.linspace(-half, half, LEVELS):
            seen |= other.inside(transferred(master, other, grid, h + level), how.search_m / self._gsd(b))
        if not seen.any():
            return ELSEWHERE
        seen &= there
        if not seen.any():
            return NO_HEIGHT
        some = np.flatnonzero(seen)[:: max(int(seen.sum()) // FIRST_PLACES, 1)]
        pair = pair_of(master, other, grid[some], h[some])
        place = self._best_places(
            master, self._cells(master, seen, FIRST_PLACES), pair.spacing, told=part_of(told, 0.0, FIRST_CHOSEN_SHARE)
        )
        if not len(place):
            return "no texture where both may see the ground"
        h = how.heights(master, place)
        place, h = place[np.isfinite(h)], h[np.isfinite(h)]
        if not len(place):
            return NO_HEIGHT
        wide = part_of(told, FIRST_CHOSEN_SHARE, 1.0)
        found = first_neighbours(pair, place, h, how.search_m / self._gsd(a), half, wide)
        if found is None:
            return (
                "nothing found: the search may be too narrow (--search-m, --height), or they do not see the same; are "
                f"the images of {master.name} and {other.name} the right ones?"
            )
        neighbours, rise_m = found
        at = transferred(master, other, grid + neighbours.expected(grid), how.heights(master, grid) + rise_m)
        return _Known(pair, rise_m, neighbours, other.inside(at))

    @staticmethod
    def _cells(view: SceneView, seen: Mask, number: float) -> NDArray[np.int64]:
        """First line and sample, end line and sample (n, 4) of about so many square cells, where nodes are seen."""
        first, end = np.array(view.pixels.first), np.array(view.pixels.end)
        size = end - first
        side = max(float(np.sqrt(seen.mean() * size.prod() / number)), LEAST_CELL)
        count = np.ceil(size / side).astype(int)
        corner = np.stack([k.ravel() for k in np.meshgrid(*map(np.arange, count), indexing="ij")], axis=1) * side
        middle = np.minimum(corner + 0.5 * side, size - 1)
        node = np.rint(middle / np.maximum(size - 1, 1) * (NODES - 1)).astype(int)
        corner = corner[seen[node[:, 0] * NODES + node[:, 1]]] + first
        return np.hstack([np.rint(corner), np.minimum(np.rint(corner + side), end)]).astype(np.int64)

    def _best_places(
        self, view: SceneView, cells: NDArray[np.int64], spacing: float, there: Array = NOWHERE, taken: Array = NOWHERE,
        *, told: Told,
    ) -> Array:  # fmt: skip
        """The place (n, 2) of best texture in each cell without one that is taken, some distance from all there are."""
        half, apart = WINDOW // 2 + 2, round(APART * WINDOW)
        margin = round(MARGIN_PX * spacing)
        first, end = np.array(view.pixels.first) + margin, np.array(view.pixels.end) - margin
        places = np.rint(there)
        for number, cell in enumerate(cells):
            told(number / len(cells))
            low, high = np.maximum(cell[:2], first), np.minimum(cell[2:], end)
            if (high <= low).any() or ((taken >= low) & (taken < high)).all(axis=1).any():
                continue
            size = np.minimum(high - low, MOST_CELL)
            begin = (low + high - size) // 2 - half
            image = view.pixels.window(*begin.tolist(), *(size + 2 * half).tolist())
            free = np.ones(image.shape, dtype=bool)  # what lies on the border of two cells would be the best of both
            near = (np.abs(places - (begin + 0.5 * np.array(image.shape))) < 0.5 * np.array(image.shape) + apart).all(
                axis=1
            )
            for u, v in (places[near] - begin).astype(int).tolist():
                free[max(u - apart + 1, 0) : max(u + apart, 0), max(v - apart + 1, 0) : max(v + apart, 0)] = False
            best = interest_point(
                image, np.ones(len(image), dtype=bool), WINDOW, self.how.matching.largest_sigma_px, free,
                saturated=view.pixels.saturated,
            )  # fmt: skip
            if best is not None:
                places = np.vstack([places, begin + best[:2]])
        return places[len(there) :]

    def _points_of(
        self, a: int, b: int, known: _Known, points: list[ScenePoint], report: PairReport, told: Told
    ) -> list[ScenePoint]:
        """New points that the master and the other image of a pair have, and others, too."""
        master = self.views[a]
        cells = self._cells(master, known.overlap, TRIED * self.how.points)
        there = np.array([p.rays[a][:2] for p in points if a in p.rays]).reshape(-1, 2)
        taken = there[np.array([b in p.rays for p in points if a in p.rays], dtype=bool)]
        chosen = part_of(told, 0.0, CHOSEN_SHARE)
        place = self._best_places(master, cells, known.pair.spacing, there, taken, told=chosen)
        report.tried = len(place)
        if not len(place):
            return []
        rays: list[dict[int, tuple[float, float, float]]] = [{} for _ in place]
        own = np.full(len(place), np.nan)
        others = [b, *(k for k in range(len(self.views)) if k not in (a, b))]
        for number, c in enumerate(others):
            ends = CHOSEN_SHARE + (1.0 - CHOSEN_SHARE) * np.array([number, number + 0.5, number + 1.0]) / len(others)
            other = self._pair(a, c, part_of(told, *ends[:2].tolist()))
            if isinstance(other, str):
                continue
            looks = self._looks_at(other, place, part_of(told, *ends[::2].tolist() if c == b else ends[1:].tolist()))
            if c == b:
                report.found = int(looks.found.sum())
            own = np.fmax(own, np.where(looks.good, looks.own_px, np.nan))
            for k in np.flatnonzero(looks.good):
                rays[k][c] = (float(looks.pixel[k, 0]), float(looks.pixel[k, 1]), float(looks.sigma_px[k]))
        return [
            ScenePoint({a: (float(place[k, 0]), float(place[k, 1]), float(own[k]))} | r)
            for k, r in enumerate(rays)
            if r
        ]

    def _looks_at(self, known: _Known, place: Array, told: Told) -> _Looks:
        """Look for places (k, 2) of the master in the other image of a pair."""
        how, pair = self.how, known.pair
        h = how.heights(pair.master, place) + known.rise_m
        good, shift = np.zeros(len(place), dtype=bool), np.full((len(place), 2), np.nan)
        covariance, way = np.full((len(place), 2, 2), np.nan), pair.ways(place, h)
        waiting = np.flatnonzero(np.isfinite(h))
        for number in range(ROUNDS):
            guess = known.neighbours.expected(place[waiting])
            at, slope = mapping(pair.master, pair.other, place[waiting] + guess, h[waiting])
            edge = MARGIN_PX * np.sqrt(np.abs(np.linalg.det(np.nan_to_num(slope)))) * pair.spacing
            seen = pair.other.inside(at, -edge[:, None])
            k = waiting[seen]
            if not len(k):
                break
            part = part_of(told, *ROUND_ENDS[number : number + 2])
            found = pair.find(place[k], h[k], guess[seen], known.neighbours.reach_px, part)
            fine = verdict(found, how.matching) == ""
            shift[k], covariance[k] = np.where(fine[:, None], found.shift, np.nan), found.covariance
            before = int(good.sum())
            good = agreeing(place, shift, way, FLOOR_PX * pair.spacing)
            if good.sum() > len(known.neighbours.place):
                known.neighbours = neighbours_of(pair, place[good], shift[good])
            # what lies beside the search, or is like nothing there, is looked for where closer neighbours say
            waiting = k[~good[k] & np.isin(found.reason, AGAIN)]
            if not len(waiting) or good.sum() <= before:
                break
        k = np.flatnonzero(good)
        pixel, sigma, own = np.full((len(place), 2), np.nan), np.full(len(place), np.nan), np.full(len(place), np.nan)
        pixel[k], slope = mapping(pair.master, pair.other, place[k] + shift[k], h[k])
        # half of a match's variance belongs to each of its two images; what is added is of the coarser one's pixels
        C = covariance[k] + (how.matching.image_sigma_px * pair.spacing) ** 2 * np.eye(2)
        turned = slope @ C @ np.swapaxes(slope, 1, 2)
        own[k], sigma[k] = (np.sqrt(0.25 * np.trace(c, axis1=1, axis2=2)) for c in (C, turned))
        return _Looks(np.asarray(np.isfinite(shift).all(axis=1)), good, pixel, sigma, own)

    def _tell_misfit(self, report: PairReport, points: list[ScenePoint]) -> None:
        """By which the rays of a pair miss each other: what is left of shifts once each point has its height."""
        a, b = report.images
        both = [p for p in points if a in p.rays and b in p.rays]
        report.kept = len(both)
        if not both:
            counts = f"{report.tried} places tried, {report.found} matched"
            report.why = report.why or f"{counts}, fewer than {FEWEST} of them agree"
            return
        known = self._known[a, b]
        if isinstance(known, str):  # a third image found them in both
            return
        pair = known.pair
        place, pixel = (np.array([p.rays[k][:2] for p in both]) for k in (a, b))
        h = self.how.heights(pair.master, place) + known.rise_m
        shift, way = shifts_between(pair, place, h, pixel), parallaxes(pair.master, pair.other, place, h)
        _, left = height_of(shift[:, None], way[:, None], np.ones((len(place), 1)))
        plane, _ = plane_fit(place, left[:, 0] @ pair.across, 1e-3)
        report.misfit_px = float(np.sqrt(np.mean(np.sum(left[:, 0] ** 2, axis=1))))
        report.left_px = float(np.sqrt(np.mean((left[:, 0] @ pair.across - plane) ** 2)))
