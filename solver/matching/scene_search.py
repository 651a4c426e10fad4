"""Where the places of a master image lie in another one, as neighbours tell, after a wide search for the first of them.

Errors of two location models move one image against the other by an amount that is nearly the same everywhere, and an
unknown height moves it along one direction, the parallax. So a wide search with few places looks as far along that
direction as heights may be, and across it as far as the models may be wrong; it is believed where many places agree
across the direction, and neighbours along it. The others are looked for near where their neighbours were found.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter
from scipy.spatial import KDTree

from .correlation import best_place, correlate
from .robust_plane import robust_plane
from .scene_patches import ScenePatches, SceneView, mapping, parallaxes, transferred
from .search import COARSEST, REACH_PX, Found, Ground, Patches, find

Array = NDArray[np.floating]
Mask = NDArray[np.bool_]
#: Called with the share of some work that is done.
Told = Callable[[float], None]

#: Half side of the templates of the wide search, and how far it looks at most, in its own reduced pixels; no less far
#: than so many full-size ones. Tuned: small templates are found on steep ground, too, and wrong ones do not agree.
WIDE_HALF, WIDE_REACH, LEAST_WIDE_PX = 12, 64, 128
#: Share of a template, and of what it is compared with, that must be known in the wide search: at the edge of what is
#: known, anything looks alike.
LEAST_TEMPLATE, LEAST_MEASURED = 0.7, 0.8
#: Correlation coefficient of the wide search. Tuned: of what is wrong, consensus leaves out more than this does.
LEAST_WIDE_SCORE = 0.4
#: The same of those from which the others are looked for. Tuned.
LEAST_FINE_SCORE = 0.5
#: Pixels that are read at once, for patches of several places.
MOST_PIXELS = 8_000_000
#: Places that are looked for together.
TOGETHER = 48
#: As many neighbours tell where to look.
NEIGHBOURS = 6
#: Robust standard deviations at which a match does not go with the others: across the parallax, and along it, where
#: relief makes neighbours differ.
ACROSS_SIGMA, ALONG_SIGMA = 4.0, 6.0
#: Models leave no larger standard deviation across the parallax than so many times its floor: what is larger is no
#: crowd that agrees. Tuned: a pixel in the end.
MOST_FLOORS = 20.0
#: The wide search is believed if so many places agree, and this share of those that were found.
FEWEST, LEAST_AGREEING = 5, 0.2


def nobody(share: float) -> None:
    """Who is told where nobody asks."""


def part_of(told: Told, begin: float, end: float) -> Told:
    """Who is told of work that is a part of other work, from one share of that to another."""
    return lambda share: told(begin + (end - begin) * share)


def grids(place: Array, height_m: Array, spacing: float) -> Ground:
    """Grids about places (k, 2) of the master, as `ScenePatches` takes them."""
    return Ground(np.column_stack([place, height_m]), np.array([1.0, 0.0]), np.array([0.0, 1.0]), spacing)


@dataclass(frozen=True)
class Pair:
    """Two images that see the same ground; px are those of the master.

    Attributes
    ----------
    master, other : the views
    spacing : of grids, px: that of the coarser image
    along : (2,) unit vector of the direction in which heights move places in the other image
    parallax : px that a metre of height makes
    """

    master: SceneView
    other: SceneView
    spacing: float
    along: Array
    parallax: float

    @property
    def across(self) -> Array:
        """(2,) unit vector in which heights make no difference."""
        return np.array([-self.along[1], self.along[0]])

    def ways(self, place: Array, height_m: Array) -> Array:
        """(k, 2) what `along` is at places (k, 2): views of different satellites turn against each other in a scene."""
        way = parallaxes(self.master, self.other, place, height_m)
        length = np.linalg.norm(way, axis=1, keepdims=True)
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.where(length > 1e-9, way / length, self.along)

    def find(self, place: Array, height_m: Array, guess: Array, reach_px: float, told: Told = nobody) -> Found:
        """`search.find` with shifts and covariances in px of the master."""
        parts = []
        reach = reach_px / self.spacing
        master, other = ScenePatches(self.master, self.master), ScenePatches(self.master, self.other)
        for k in range(0, len(place), TOGETHER):
            some = slice(k, k + TOGETHER)
            ground, line = grids(place[some], height_m[some], self.spacing), place[some, 0]
            parts.append(find(master, line, ground, other, guess[some] / self.spacing, line, reach))
            told(min(k + TOGETHER, len(place)) / len(place))
        return Found(
            np.concatenate([p.shift for p in parts]) * self.spacing,
            np.concatenate([p.covariance for p in parts]) * self.spacing**2,
            np.concatenate([p.score for p in parts]),
            np.concatenate([p.closing for p in parts]),
            np.concatenate([p.reason for p in parts]),
        )


def pair_of(master: SceneView, other: SceneView, place: Array, height_m: Array) -> Pair:
    """The pair, by how the other image sees the ground under some places (k, 2) of the master."""
    _, slope = mapping(master, other, place, height_m)
    way = parallaxes(master, other, place, height_m)
    known = np.isfinite(slope).all(axis=(1, 2)) & np.isfinite(way).all(axis=1)
    scale = float(np.sqrt(np.median(np.abs(np.linalg.det(slope[known]))))) if known.any() else 1.0
    mean = way[known].mean(axis=0) if known.any() else np.zeros(2)
    parallax = float(np.linalg.norm(mean))
    along = mean / parallax if parallax > 1e-9 else np.array([1.0, 0.0])
    return Pair(master, other, max(1.0 / max(scale, 1e-6), 1.0), along, parallax)


def shifts_between(pair: Pair, place: Array, height_m: Array, pixel: Array) -> Array:
    """Shifts (k, 2), px of the master, that places at heights have in the other image if they are at pixels (k, 2)."""
    shift = np.zeros((len(place), 2))
    for _ in range(3):
        at, slope = mapping(pair.master, pair.other, place + shift, height_m)
        slope = np.where(np.isfinite(slope).all(axis=(1, 2), keepdims=True), slope, np.eye(2))
        shift = shift + np.linalg.solve(slope, (pixel - at)[:, :, None])[:, :, 0]
    return shift


@dataclass(frozen=True)
class WideSearch:
    """Where k places were found in another image.

    Attributes
    ----------
    shift : (k, 2) px of the master, as if parallax were the same at all heights; NaN where nothing was found
    pixel : (k, 2) of the other image
    score : (k,) correlation coefficients
    step_px : of the shifts
    """

    shift: Array
    pixel: Array
    score: Array
    step_px: float


def wide_search(
    pair: Pair, place: Array, height_m: Array, across_px: float, along_px: float, told: Told = nobody
) -> WideSearch:
    """Look for places (k, 2) within so many px across the parallax and along it.

    Along the parallax heights are tried one after the other, each with a search of its own.
    """
    s = pair.spacing
    reach_px = max(across_px, LEAST_WIDE_PX * s)
    factor = 1
    while reach_px > WIDE_REACH * factor * s:
        factor *= 2
    reach = int(np.ceil(reach_px / (factor * s))) + 1
    steps = factor * s * np.arange(-reach, reach + 1.0)
    way = np.stack(np.meshgrid(steps, steps, indexing="ij"), axis=-1)
    allowed = np.abs(way @ pair.across) <= across_px + factor * s
    levels = int(np.ceil(max(along_px - reach_px, 0.0) / (2.0 * reach_px)))
    rise_m = 2.0 * reach_px / pair.parallax if levels else 0.0
    side = (2 * (WIDE_HALF + reach) + 1) * factor * s
    together = int(np.clip(MOST_PIXELS / side**2, 1, TOGETHER))
    shift, pixel = np.full((2, len(place), 2), np.nan)
    best = np.full(len(place), LEAST_WIDE_SCORE)
    master, other = ScenePatches(pair.master, pair.master), ScenePatches(pair.master, pair.other)
    for k in range(0, len(place), together):
        told(k / len(place))
        some = np.arange(k, min(k + together, len(place)))
        ground = grids(place[some], height_m[some], s)
        t = master.patches(ground, place[some, 0], WIDE_HALF, factor)
        there = t.known >= LEAST_TEMPLATE
        some, template = some[there], t.values[there]
        for level in range(-levels, levels + 1) if len(some) else ():
            h = height_m[some] + level * rise_m
            searched = other.patches(grids(place[some], h, s), place[some, 0], WIDE_HALF + reach, factor)
            score = np.where(allowed & _measured(searched), correlate(template, searched.values), np.float32(-1.0))
            row, column, top = best_place(score)
            better = np.flatnonzero(top > best[some])
            if not len(better):
                continue
            k_b, found = some[better], np.stack([steps[row], steps[column]], axis=1)[better]
            pixel[k_b] = transferred(pair.master, pair.other, place[k_b] + found, h[better])
            shift[k_b], best[k_b] = found + level * 2.0 * reach_px * pair.along, top[better]
    shift[~np.isfinite(pixel).all(axis=1)] = np.nan
    return WideSearch(shift, pixel, best, factor * s)


def _measured(searched: Patches) -> Mask:
    """Places (k, n, n) in searched patches at which enough of a template would fall on what is known."""
    inside = slice(WIDE_HALF, -WIDE_HALF)
    if searched.holes is None:
        return np.ones_like(searched.values[:, inside, inside], dtype=bool)
    known = uniform_filter((~searched.holes).astype(np.float32), 2 * WIDE_HALF + 1, axes=(1, 2))
    return known[:, inside, inside] >= LEAST_MEASURED


def crowd(values: Array, weight: Array, tolerance: float) -> Mask:
    """Which values (k,) lie within a tolerance of the one near which most weight lies; NaN do not."""
    with np.errstate(invalid="ignore"):
        near = np.abs(values[:, None] - values) <= tolerance
    return near[int((near @ weight).argmax())] if len(values) else np.zeros(0, dtype=bool)


def plane_fit(place: Array, values: Array, floor: float) -> tuple[Array, float]:
    """What a robust plane through values (k,) at places (k, 2) has there (k,), and the robust standard deviation.

    Of fewer than ten values it is their median.
    """
    if len(values) < 10:
        level = np.median(values)
        return np.full(len(values), level), max(1.4826 * float(np.median(np.abs(values - level))), floor)
    middle, size = place.mean(axis=0), max(float(np.ptp(place, axis=0).max()), 1.0)
    A = np.column_stack([np.ones(len(place)), (place - middle) / size])
    fit, scale = robust_plane(A, values, floor, 10)
    return A @ fit, scale


def neighbours_say(known: Array, values: Array, place: Array, itself: bool = False) -> Array:
    """Median (n, ...) of the values (k, ...) at the nearest of known places (k, 2), at places (n, 2).

    ``itself`` : the places are the known ones, and do not count for themselves.
    """
    number = min(NEIGHBOURS + itself, len(known))
    if number <= itself:
        return np.repeat(values[:1], len(place), axis=0)
    near = np.asarray(KDTree(known).query(place, number)[1]).reshape(len(place), number)
    return np.asarray(np.median(values[near[:, 1:] if itself else near], axis=1))


def agreeing(place: Array, shift: Array, way: Array, floor_px: float) -> Mask:
    """Which shifts (k, 2) go with the others: with a plane across the parallax, and with their neighbours along it.

    Parameters
    ----------
    place : (k, 2)
    way : (2,) or (k, 2) unit vectors in which heights move places
    floor_px : of robust standard deviations
    """
    good = np.asarray(np.isfinite(shift).all(axis=1))
    along = np.sum(shift * way, axis=1)
    across = np.sum(shift * np.stack([-way[..., 1], way[..., 0]], axis=-1), axis=1)
    for _ in range(3):
        k = np.flatnonzero(good)
        if len(k) < FEWEST:
            return np.zeros(len(place), dtype=bool)
        plane, scale = plane_fit(place[k], across[k], floor_px)
        stays = np.abs(across[k] - plane) <= ACROSS_SIGMA * min(scale, MOST_FLOORS * floor_px)
        left = along[k] - neighbours_say(place[k], along[k], place[k], itself=True)
        stays &= np.abs(left) <= ALONG_SIGMA * max(1.4826 * float(np.median(np.abs(left))), 3.0 * floor_px)
        good[k[~stays]] = False
        if stays.all():
            break
    return good


@dataclass(frozen=True)
class Neighbours:
    """Places that were found: they tell where others are to be expected.

    Attributes
    ----------
    place, shift : (k, 2)
    reach_px : within which places are found by what their neighbours say
    """

    place: Array
    shift: Array
    reach_px: float

    def expected(self, place: Array) -> Array:
        """Shifts (n, 2) of other places."""
        return neighbours_say(self.place, self.shift, place)


def first_neighbours(
    pair: Pair, place: Array, height_m: Array, across_px: float, most_m: float, told: Told = nobody
) -> tuple[Neighbours, float] | None:
    """The wide search among heights up to so many metres beside those given, and its consensus.

    Returns
    -------
    neighbours, and how much higher than given the ground is to be taken (as far as models that are wrong tell), or None
    where too few places agree
    """
    wide = wide_search(pair, place, height_m, across_px, across_px + most_m * pair.parallax, part_of(told, 0.0, 0.7))
    found = np.asarray(np.isfinite(wide.shift).all(axis=1))
    good = found & crowd(wide.shift @ pair.across, wide.score - LEAST_WIDE_SCORE, 3.0 * wide.step_px)
    good[good] = agreeing(place[good], wide.shift[good], pair.along, 0.5 * wide.step_px)
    if good.sum() < max(FEWEST, LEAST_AGREEING * found.sum()):
        return None
    along = float(np.median(wide.shift[good] @ pair.along))
    rise_m = min(max(along / max(pair.parallax, 1e-9), -most_m), most_m)
    place, height_m = place[good], height_m[good] + rise_m
    shift = shifts_between(pair, place, height_m, wide.pixel[good])
    fine = pair.find(place, height_m, shift, max(2.0 * wide.step_px, 4.0 * pair.spacing), part_of(told, 0.7, 1.0))
    good = (fine.reason == "") & (fine.score > LEAST_FINE_SCORE)
    way = pair.ways(place[good], height_m[good])
    good[good] = agreeing(place[good], fine.shift[good], way, 0.1 * pair.spacing)
    return (neighbours_of(pair, place[good], fine.shift[good]), rise_m) if good.sum() >= FEWEST else None


def neighbours_of(pair: Pair, place: Array, shift: Array) -> Neighbours:
    """Neighbours out of good shifts, with the reach in which they find each other."""
    left = np.abs(shift - neighbours_say(place, shift, place, itself=True)).max(axis=1)
    most = REACH_PX * COARSEST * pair.spacing
    return Neighbours(place, shift, float(np.clip(1.5 * np.quantile(left, 0.9), 4.0 * pair.spacing, most)))
