"""From a predicted place to a measured one: correlation from coarse to fine, then least squares, then back again."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .correlation import best_place, correlate
from .least_squares import PatchMatch, match_patches
from .line_scan import LineScan
from .patches import Picture, interpolate_stack

Array = NDArray[np.floating]
Mask = NDArray[np.bool_]

#: Half sides, px: template of the correlation, template of least squares, margin around it, reach at finer levels.
CORRELATION_HALF, LEAST_SQUARES_HALF, MARGIN, FINE_REACH = 7, 9, 4, 2
#: Furthest a correlation looks in its own pixels; further ones are found at a coarser level.
COARSE_REACH, COARSEST = 10, 8
#: Where vibration pulls lines apart or together by more than this factor (logarithm), the ground is not well sampled.
LARGEST_UNEVENNESS = float(np.log(1.8))


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
        return Ground(self.centre_l + np.column_stack([xy, np.zeros(len(xy))]), self.along, self.across, self.spacing_m)

    def select(self, chosen: Mask) -> Ground:
        """Some of the places."""
        return Ground(self.centre_l[chosen], self.along, self.across, self.spacing_m)

    def points(self, half: int, factor: int) -> Array:
        """(k, n, n, 3) grid points with n = 2 half + 1 and a spacing of ``factor`` pixels."""
        r = self.spacing_m * factor * np.arange(-half, half + 1)
        out = np.empty((len(self.centre_l), len(r), len(r), 3))
        xy = r[:, None, None] * self.along + r[None, :, None] * self.across
        out[..., :2] = self.centre_l[:, None, None, :2] + xy
        out[..., 2] = self.centre_l[:, None, None, 2]
        return out


@dataclass(frozen=True)
class Image:
    """A view at work: where its lines look, and what they saw.

    Attributes
    ----------
    scan : geometry
    levels : factor -> picture
    line_m : way of the platform from one line to the next, m
    """

    scan: LineScan
    levels: dict[int, Picture]
    line_m: float

    def patches(self, ground: Ground, line: Array, half: int, factor: int) -> tuple[NDArray[np.floating], Mask, Array]:
        """Grey values (k, n, n) on the grids, which of the k are known throughout, and how uneven their lines lie.

        The unevenness (k,) is the largest distance of neighbouring lines on the ground against the mean (logarithm).

        Parameters
        ----------
        line : (k,) line of the middle of each, roughly
        """
        points = ground.points(half, factor)
        r = ground.spacing_m * factor / self.line_m * np.arange(-half, half + 1)
        guess = np.broadcast_to((line[:, None] + r)[:, :, None], points.shape[:3])
        u, v, inside = self.scan.locate(points.reshape(-1, 3), guess.ravel(), rounds=4)
        picture = self.levels.get(factor) or self.levels[1].reduced(factor)
        self.levels[factor] = picture
        values, known = picture.sample(u, v, cubic=factor == 1)
        shape = points.shape[:3]
        density = np.diff(u.reshape(shape)[:, :, :: max(half, 1)], axis=1) * (self.line_m / (ground.spacing_m * factor))
        uneven = np.abs(np.log(np.clip(density, 0.05, 20.0))).reshape(len(line), -1).max(axis=1)
        return values.reshape(shape), (inside & known).reshape(len(line), -1).min(axis=1), uneven


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
    while reach_px > COARSE_REACH * factor and factor < COARSEST:
        factor *= 2
    return factor


def find(
    master: Image, master_line: Array, ground: Ground, other: Image, guess: Array, other_line: Array, reach_px: float
) -> Found:
    """Find the places under the master's pixels in another view.

    Parameters
    ----------
    master, other : the two views
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
    reach = int(np.ceil(min(reach_px / factor, COARSE_REACH))) + 1
    line_per_row = ground.spacing_m / other.line_m
    while True:
        t, known_t, _ = master.patches(ground, master_line, CORRELATION_HALF, factor)
        at = other_line + shift[:, 0] * line_per_row
        s, known_s, _ = other.patches(ground.moved(shift), at, CORRELATION_HALF + reach, factor)
        reason[alive & ~(known_t & known_s)] = "no lines"
        alive &= known_t & known_s
        row, column, top = best_place(correlate(t, s))
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
    master: Image, master_line: Array, ground: Ground, other: Image, other_line: Array, shift: Array, alive: Mask,
    reason: NDArray[np.str_],
) -> Found:  # fmt: skip
    k, half = len(shift), LEAST_SQUARES_HALF
    covariance, score, closing = np.full((k, 2, 2), np.inf), np.zeros(k), np.full(k, np.inf)
    wide = half + MARGIN
    if alive.any():
        here, moved = ground.select(alive), ground.select(alive).moved(shift[alive])
        t, known_t, uneven_t = master.patches(here, master_line[alive], wide, 1)
        at = other_line[alive] + shift[alive, 0] * ground.spacing_m / other.line_m
        s, known_s, uneven_s = other.patches(moved, at, wide, 1)
        inner = slice(MARGIN, MARGIN + 2 * half + 1)
        there = match_patches(np.ascontiguousarray(t[:, inner, inner]), s, np.zeros((int(alive.sum()), 2)))
        back = _back(t, s, there)
        index = np.flatnonzero(alive)
        shift[index] += there.shift
        covariance[index], score[index] = there.covariance, there.score
        closing[index] = np.hypot(*back.shift.T)
        reason[index[~(known_t & known_s)]] = "no lines"
        shaken = np.maximum(uneven_t, uneven_s) > LARGEST_UNEVENNESS
        reason[index[shaken & (reason[index] == "")]] = "shaken"
        lost = ~there.converged | (np.abs(there.shift) > 2.0).any(axis=1)
        reason[index[lost & (reason[index] == "")]] = "not converged"
    return Found(shift, covariance, score, closing, reason)


def _back(template: NDArray[np.floating], search: NDArray[np.floating], there: PatchMatch) -> PatchMatch:
    """The patch that was found, matched in the master; its shift should be none."""
    side = 2 * LEAST_SQUARES_HALF + 1
    r = np.arange(side) - LEAST_SQUARES_HALF + 0.5 * (search.shape[1] - 1)
    y, x = np.meshgrid(r, r, indexing="ij")
    found = interpolate_stack(search, y + there.shift[:, 0, None, None], x + there.shift[:, 1, None, None])
    return match_patches(found, template, np.zeros((len(template), 2)), iterations=5)
