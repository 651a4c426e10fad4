"""From a predicted place to a measured one: correlation from coarse to fine, then least squares, then back again."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from .correlation import best_place, correlate
from .least_squares import PatchMatch, match_patches, shifts
from .line_scan import LineScan
from .line_store import LineRing
from .patches import MOST_HOLE, Windows, holes_at, interpolate_stack

Array = NDArray[np.floating]
Mask = NDArray[np.bool_]

#: Half sides, px: template of the correlation, template of least squares, margin around it, reach at finer levels.
CORRELATION_HALF, LEAST_SQUARES_HALF, MARGIN, FINE_REACH = 7, 9, 4, 2
#: Furthest a correlation looks in its own pixels; further ones are found at a coarser level.
REACH_PX, COARSEST = 10, 8
#: Where vibration pulls lines apart or together by more than this factor (logarithm), the ground is not well sampled.
LARGEST_UNEVENNESS = float(np.log(1.8))
#: Shares of a template at coarser levels and of what it is searched in that must be known.
LEAST_TEMPLATE, LEAST_SEARCH = 0.7, 0.4
#: Share of a template's weight in least squares that must have been measured in both images.
LEAST_MEASURED = 0.6
#: So often the searched patch is taken anew from where least squares found it; iterations of least squares before, and
#: with the last patch. Tuned.
AGAIN, FIRST_ITERATIONS, ITERATIONS = 2, 4, 8
#: The furthest that all these iterations go, px. Tuned.
FURTHEST = 2.0
#: The template of least squares in a patch with its margin.
INNER = slice(MARGIN, MARGIN + 2 * LEAST_SQUARES_HALF + 1)
#: Along a row of a grid every so many pixels are computed exactly; a patch covers at most so many times its size.
NODE_PX, MOST_STRETCH = 4, 2.0


@dataclass(frozen=True)
class Ground:
    """Horizontal grids on the ground about k places, rows along the flight, columns in the direction of the samples.

    Attributes
    ----------
    centre_l : (k, 3) m
    along, across : (2,) unit vectors of rows and columns
    spacing_m : of rows and columns
    """

    centre_l: Array
    along: Array
    across: Array
    spacing_m: float

    def moved(self, shift: Array) -> Ground:
        """About places that lie (k, 2) rows and columns further."""
        xy = self.spacing_m * (shift[:, :1] * self.along + shift[:, 1:] * self.across)
        return replace(self, centre_l=self.centre_l + np.column_stack([xy, np.zeros(len(xy))]))

    def select(self, chosen: Mask | NDArray[np.intp]) -> Ground:
        """Some of the places."""
        return replace(self, centre_l=self.centre_l[chosen])

    def points(self, rows: Array, columns: Array) -> Array:
        """(k, rows, columns, 3) points of a grid; rows and columns in units of the spacing."""
        out = np.empty((len(self.centre_l), len(rows), len(columns), 3))
        xy = self.spacing_m * (rows[:, None, None] * self.along + columns[None, :, None] * self.across)
        out[..., :2] = self.centre_l[:, None, None, :2] + xy
        out[..., 2] = self.centre_l[:, None, None, 2]
        return out


class Imagery(Protocol):
    """Whatever gives patches on grids on the ground."""

    @property
    def line_m(self) -> float:
        """Way of the platform from one line to the next, m."""
        ...

    def select(self, chosen: Mask) -> Imagery:
        """For some of the places."""
        ...

    def patches(self, ground: Ground, line: Array, half: int, factor: int) -> Patches:
        """Grey values on grids with n = 2 half + 1 and a spacing of ``factor`` pixels.

        Parameters
        ----------
        line : (k,) line of the middle of each, roughly
        """
        ...


@dataclass(frozen=True)
class Patches:
    """What images saw on k grids.

    Attributes
    ----------
    values : (k, n, n) grey values
    known : (k,) share of each that is known; the rest has the mean of it
    uneven : (k,) largest distance of neighbouring lines on the ground against the mean (logarithm)
    holes : (k, n, n) what is known but was not measured: lines put in between others, saturated pixels; None for no
        such pixel. Looked for at full size only.
    """

    values: NDArray[np.floating]
    known: Array
    uneven: Array
    holes: Mask | None = None


@dataclass(frozen=True)
class Image:
    """A view at work: where its lines look, and what they saw.

    Attributes
    ----------
    scan : geometry
    ring : the lines
    line_m : way of the platform from one line to the next, m
    saturated : grey value from which on pixels are saturated
    """

    scan: LineScan
    ring: LineRing
    line_m: float
    saturated: float = np.inf

    def select(self, chosen: Mask) -> Image:
        """An image is the same for all places."""
        return self

    def patches(self, ground: Ground, line: Array, half: int, factor: int, lines_per: Array | None = None) -> Patches:
        """See `Imagery`; every row of a grid through the orientation of the lines it falls on.

        ``lines_per``: lines for a step along rows and columns of grids that do not lie along the flight.
        """
        k, n = len(line), 2 * half + 1
        grid = factor * np.arange(-half, half + 1.0)
        # along a row of the grid, lines and samples change smoothly: a few places are exact, the rest between them
        nodes = np.linspace(grid[0], grid[-1], max((n - 1) // NODE_PX, 1) + 1)
        points = ground.points(grid, nodes)
        along, across = (ground.spacing_m / self.line_m, 0.0) if lines_per is None else lines_per
        guess = line[:, None, None] + along * grid[:, None] + across * nodes
        guess = np.broadcast_to(guess, points.shape[:3])
        u, v, inside = self.scan.locate(points.reshape(-1, 3), guess.ravel(), rounds=4)
        u, v, inside = u.reshape(guess.shape), v.reshape(guess.shape), inside.reshape(guess.shape)
        # how lines follow each other, along the axis of the grid that goes with the flight
        step, axis = (along, 1) if abs(along) >= abs(across) else (across * np.diff(nodes)[0] / factor, 2)
        density = np.diff(u, axis=axis) / (step * factor)
        uneven = np.abs(np.log(np.clip(density, 0.05, 20.0))).reshape(k, -1).max(axis=1)
        between = _between(grid, nodes)
        values, known, holes = self._sample(u, v, between, factor)
        known &= inside @ between > 0.999
        share = known.reshape(k, -1).mean(axis=1)
        mean = np.sum(values, axis=(1, 2), where=known) / np.maximum(share * n * n, 1.0)
        values = np.where(known, values, mean[:, None, None].astype(np.float32))
        return Patches(values, share, uneven, holes)

    def _sample(
        self, u: Array, v: Array, between: Array, factor: int
    ) -> tuple[NDArray[np.floating], Mask, Mask | None]:
        """Grey values (k, n, n) at lines and samples known in some columns (k, n, c), what is known, and holes."""
        widest = int(MOST_STRETCH * factor * u.shape[1]) + 8
        pad = factor + 2 if factor > 1 else 2
        first = [np.floor(np.clip(a.min(axis=(1, 2)), -1e6, 1e9)).astype(np.int64) - pad for a in (u, v)]
        size = [int(np.ceil(np.quantile(np.ptp(a, axis=(1, 2)), 0.95) * 1.05)) + 2 * pad + 6 for a in (u, v)]
        n, m = (min(x, widest) // factor * factor + factor for x in size)
        windows = Windows(first[0], first[1], *self.ring.windows(first[0], first[1], n, m))
        windows, holes = windows.mended(self.saturated)
        windows, line, sample = windows.reduced(factor), u @ between, v @ between
        return *windows.sample(line, sample, cubic=factor == 1), (
            None if holes is None or factor > 1 else windows.touched(holes, line, sample)
        )


def _between(grid: Array, nodes: Array) -> Array:
    """(c, n) weights that interpolate linearly from nodes to all columns of a grid."""
    return np.stack([np.interp(grid, nodes, row) for row in np.eye(len(nodes))])


class TurnedImage:
    """An image on grids that lie in any direction to its lines.

    Attributes
    ----------
    way : (2,) direction in which its lines follow each other on the ground, of length 1
    """

    def __init__(self, image: Image, way: Array):
        self.image, self.way = image, way
        # a shift along the rows moves so many lines: what `find` takes for the way from line to line
        self.line_m = image.line_m

    def select(self, chosen: Mask) -> TurnedImage:
        """An image is the same for all places."""
        return self

    def patches(self, ground: Ground, line: Array, half: int, factor: int) -> Patches:
        """See `Imagery`."""
        middle = self.image.scan.locate(ground.centre_l, line, rounds=4)[0]
        lines_per = np.array([self.way @ ground.along, self.way @ ground.across]) * ground.spacing_m / self.line_m
        return self.image.patches(ground, np.where(np.isfinite(middle), middle, line), half, factor, lines_per)


@dataclass(frozen=True)
class Found:
    """Where k places of the master were found in another view.

    Attributes
    ----------
    shift : (k, 2) rows and columns from the predicted place, px of the ground grid
    covariance : (k, 2, 2) of it, px^2
    score : (k,) correlation coefficient
    closing : (k,) distance by which matching back misses the start, px
    reason : (k,) empty for a match, else why there is none
    """

    shift: Array
    covariance: Array
    score: Array
    closing: Array
    reason: NDArray[np.str_]


def coarsest_factor(reach_px: float) -> int:
    """Reduction at which a search of a reach (px) begins."""
    factor = 1
    while reach_px > REACH_PX * factor and factor < COARSEST:
        factor *= 2
    return factor


def find(
    master: Imagery,
    master_line: Array,
    ground: Ground,
    other: Imagery,
    guess: Array,
    other_line: Array,
    reach_px: float,
) -> Found:
    """Find the places under the master's pixels in another view.

    Parameters
    ----------
    master, other : the two views; the first may be a store of patches
    master_line, other_line : (k,) lines of the grids' middles in the two, roughly
    ground : grids about the places, at their guessed heights
    guess : (k, 2) shift to be expected, rows and columns
    reach_px : how far from it is searched
    """
    k = len(master_line)
    shift, score = np.array(guess, dtype=float), np.zeros(k)
    reason = np.full(k, "", dtype="U24")
    alive = np.ones(k, dtype=bool)
    factor = coarsest_factor(reach_px)
    reach = int(np.ceil(min(reach_px / factor, REACH_PX))) + 1
    line_per_row = ground.spacing_m / other.line_m
    while True:
        t = master.patches(ground, master_line, CORRELATION_HALF, factor)
        at = other_line + shift[:, 0] * line_per_row
        s = other.patches(ground.moved(shift), at, CORRELATION_HALF + reach, factor)
        there = (t.known >= (LEAST_TEMPLATE if factor > 1 else 1.0)) & (s.known >= LEAST_SEARCH)
        reason[alive & ~there] = "no lines"
        alive &= there
        row, column, top = best_place(correlate(t.values, s.values))
        edge = (np.minimum(row, column) == 0) | (np.maximum(row, column) == 2 * reach)
        reason[alive & edge] = "beyond search"
        alive &= ~edge
        step = factor * np.stack([row - reach, column - reach], axis=1)
        shift = np.where(alive[:, None], shift + step, shift)
        score = top
        if factor == 1:
            break
        factor, reach = factor // 2, FINE_REACH
    reason[alive & (score < 0.4)] = "low correlation"
    alive &= score >= 0.4
    return _refine(master, master_line, ground, other, other_line, shift, alive, reason)


def _refine(
    master: Imagery, master_line: Array, ground: Ground, other: Imagery, other_line: Array, shift: Array, alive: Mask,
    reason: NDArray[np.str_],
) -> Found:  # fmt: skip
    k, half = len(shift), LEAST_SQUARES_HALF
    covariance, score, closing = np.full((k, 2, 2), np.inf), np.zeros(k), np.full(k, np.inf)
    wide = half + MARGIN
    if alive.any():
        here, index = ground.select(alive), np.flatnonzero(alive)
        t = master.select(alive).patches(here, master_line[alive], wide, 1)
        start, per_row = shift[index], ground.spacing_m / other.line_m

        def searched(way: Array) -> Patches:
            begin = start + way
            return other.patches(here.moved(begin), other_line[alive] + begin[:, 0] * per_row, wide, 1)

        # interpolating what is interpolated already pulls places towards its pixels, all those alike that are expected
        # wrong by the same part of a pixel: the patch is taken anew from where it was found, which leaves a third of it
        way, s = np.zeros((len(index), 2)), searched(np.zeros((len(index), 2)))
        for _ in range(AGAIN):
            for part, holes in _by_holes(t, s):
                step = shifts(*_middle(t.values[part], s.values[part], FIRST_ITERATIONS, holes))
                way[part] += np.clip(step, -FURTHEST, FURTHEST)
            s = searched(way)
        lost, gone = np.zeros(len(index), dtype=bool), np.zeros(len(index), dtype=bool)
        for part, holes in _by_holes(t, s):
            there = match_patches(*_middle(t.values[part], s.values[part], ITERATIONS, holes))
            back = _back(t.values[part], s.values[part], holes, there)
            way[part] += there.shift
            covariance[index[part]], score[index[part]] = there.covariance, there.score
            closing[index[part]] = np.hypot(*back.shift.T)
            lost[part], gone[part] = ~there.converged, there.measured < LEAST_MEASURED
        lost |= (np.abs(way) > FURTHEST).any(axis=1)
        shift[index] += way
        reason[index[(np.minimum(t.known, s.known) < 1.0) | gone]] = "no lines"
        shaken = np.maximum(t.uneven, s.uneven) > LARGEST_UNEVENNESS
        reason[index[shaken & (reason[index] == "")]] = "shaken"
        reason[index[lost & (reason[index] == "")]] = "not converged"
    return Found(shift, covariance, score, closing, reason)


def _by_holes(t: Patches, s: Patches) -> list[tuple[NDArray[np.intp] | slice, tuple[Mask, Mask] | None]]:
    """The places all of whose pixels were measured, and those with holes in their patches, and the holes."""
    if t.holes is None and s.holes is None:
        return [(slice(None), None)]
    some = np.zeros(len(t.values), dtype=bool)
    for patches in (t, s):
        if patches.holes is not None:
            some |= patches.holes.any(axis=(1, 2))
    parts: list[tuple[NDArray[np.intp] | slice, tuple[Mask, Mask] | None]] = []
    if not some.all():
        parts.append((np.flatnonzero(~some), None))
    if some.any():
        part = np.flatnonzero(some)
        a, b = (
            np.zeros((len(part), *p.values.shape[1:]), dtype=bool) if p.holes is None else p.holes[part] for p in (t, s)
        )
        parts.append((part, (a, b)))
    return parts


def _middle(
    template: NDArray[np.floating], search: NDArray[np.floating], iterations: int, holes: tuple[Mask, Mask] | None
) -> tuple[NDArray[np.floating], NDArray[np.floating], Array, int, tuple[Mask, Mask] | None]:
    """What least squares want to find the middles of templates."""
    beside = None if holes is None else (holes[0][:, INNER, INNER], holes[1])
    return np.ascontiguousarray(template[:, INNER, INNER]), search, np.zeros((len(template), 2)), iterations, beside


def _back(
    template: NDArray[np.floating], search: NDArray[np.floating], holes: tuple[Mask, Mask] | None, there: PatchMatch
) -> PatchMatch:
    """The patches that were found matched in the master: their shift is none."""
    r = np.arange(2 * LEAST_SQUARES_HALF + 1) - LEAST_SQUARES_HALF + 0.5 * (search.shape[1] - 1)
    y, x = np.meshgrid(r, r, indexing="ij")
    at = y + there.shift[:, 0, None, None], x + there.shift[:, 1, None, None]
    found, none = interpolate_stack(search, *at), np.zeros((len(template), 2))
    turned = None if holes is None else (holes_at(holes[1], *at) > MOST_HOLE, holes[0])
    return match_patches(found, template, none, iterations=5, holes=turned)
