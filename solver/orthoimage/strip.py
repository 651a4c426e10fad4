"""The lines of a strip become patches of the orthoimage.

Direct and indirect rectification share the work. Rays of every line, through pixels some way apart, go to the ground
(direct): this carries the jitter of each line, and the relief. Their ground points are turned into the other direction,
line and sample as functions of the place, by one-dimensional interpolation along the flight and then across it: the
best scan line of every place, without search. Cells then take their grey value from there (indirect), so that none is
left out and none is asked twice.

Places are counted in the strip's own straight, perhaps oblique axes: ``p`` along the flight, about one a line, ``q``
across, about one a pixel. Both are linear in column and row. Bands of whole ``p`` share the cells among them without
gap or overlap.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ..camera.line_camera import LineCamera
from .error_band import GroundErrors, sigmas_of_lines
from .ground_grid import GroundGrid
from .resampling import TAPS, resample
from .surface import Surface

Array = NDArray[np.floating]
IntArray = NDArray[np.int64]
Mask = NDArray[np.bool_]

#: Pixels from one ray to the next where the ground is smooth, and at least, and rays beyond either end of the CCD line.
NODE_STEP, LEAST_STEP, BEYOND = 16, 2, 2
#: The ground between two rays may be off the straight line by so many cells in height: of a line that looks 27 degrees
#: aside or ahead, half a cell in the plane.
OFF_CELLS = 1.0
#: Rows of the inverse table a line: where a jolt slows the scan down, line as a function of place bends sharply.
ROWS = 3
#: The first and last lines go on straight for so many, so that the orthoimage ends where the lines do.
STRAIGHT_ON = 40
#: Lines (p) that are rectified at once, at most, and cells that are worked on at once.
BAND, CELLS = 256, 32_768
#: More bands than these ahead are looked at for gaps without a line. Tuned: only what a wrong pose shows depends on it.
SEVERAL = 4
#: More than so many lines may not wait for others: a strip that turns round sees no new ground.
MOST_WAITING = 20_000
#: Places further from the middle of the newest lines than so many times the pixels and lines at hand have no place.
#: Tuned: larger takes more memory for what a wrong pose shows.
MOST_AWAY, NEWEST = 6, 64
#: Lines across the flight: nearer to its direction, by the sine between them, they say little of it.
LEAST_SINE = 0.2


@dataclass(frozen=True)
class Patch:
    """Cells of an orthoimage, run by run; n runs of neighbouring cells in a row.

    Attributes
    ----------
    row, column : (n,) where each run begins
    length : (n,) cells in it
    values : (sum of length,) grey values, rounded; 0 = nothing known
    steepness : (sum of length,) 1 for a ray at the end of the CCD line to 255 for its middle, 0 = nothing known
    sigma_m : (sum of length, 2) in the plane and of the height, NaN where not known; None if nobody asked
    """

    row: IntArray
    column: IntArray
    length: IntArray
    values: NDArray[np.unsignedinteger]
    steepness: NDArray[np.uint8]
    sigma_m: NDArray[np.float32] | None = None

    def __len__(self) -> int:
        return int(self.length.sum())


@dataclass(frozen=True)
class Rays:
    """Rays of some pixels of a CCD line, beyond its ends too.

    Attributes
    ----------
    sample : (k,) px, ascending
    ray_c : (k, 3) directions, image frame
    pixels : of the CCD line
    step : from one ray to the next, px, as far as the CCD line goes
    """

    sample: Array
    ray_c: Array
    pixels: int
    step: int


class Shadows(Protocol):
    """What higher ground hides from rays."""

    @property
    def knot_m(self) -> float:
        """How far places may be apart whose `room` tells that of those between, metres."""
        ...

    def room(self, grid: GroundGrid, column: Array, row: Array, slope: Array) -> NDArray[np.float32]:
        """How much higher the ground might be (...), metres, before it hid places; below zero where they are hidden.

        Parameters
        ----------
        grid : of the cells
        column, row : (...) places on the ground, in cells
        slope : (..., 2) way of their rays in X and Y a metre of Z; NaN where no ray is known
        """
        ...


def rays_of(camera: LineCamera, line: int, step: int = NODE_STEP, factor: int = 1) -> Rays:
    """Rays of every ``step``-th pixel of CCD line ``line`` of a camera.

    Parameters
    ----------
    factor : pixels that were put together to one; samples are those of the reduced image

    Raises
    ------
    ValueError : a CCD line too short for it
    """
    pixels = camera.lines[line].pixels // factor
    if pixels < 2:
        raise ValueError(f"CCD line {camera.lines[line].id!r} has {camera.lines[line].pixels} pixels, too few")
    inner = np.unique(np.append(np.arange(0, pixels - 1, step), pixels - 1)).astype(float)
    # two pixels beyond the end are enough for what leans on the end, the next one keeps far places out
    outer = np.array([4.0, 4.0 + step])[:BEYOND]
    sample = np.concatenate([-outer[::-1], inner, pixels - 1 + outer])
    full = factor * sample + 0.5 * (factor - 1)
    xy = camera.image_coordinates(np.full(len(full), line), full)[0]
    return Rays(sample, np.column_stack([xy, np.full(len(xy), -camera.focal_length_mm[line])]), pixels, step)


def step_over(surface: Surface, grid: GroundGrid) -> int:
    """Pixels from one ray to the next, so that the ground between both is about straight: fewer where it has walls.

    Cells are taken to be about as large as the pixels.
    """
    step = NODE_STEP
    while step > LEAST_STEP and surface.bend_m(step * grid.cell_m) > OFF_CELLS * grid.cell_m:
        step //= 2
    return step


class StripRectifier:
    """Rectifies the lines of one strip as they come.

    Parameters
    ----------
    rays : of the CCD line, `rays_of`
    surface : the ground
    grid : cells
    resampling : of `resampling.TAPS`
    band : lines that are rectified at once
    errors : besides those of the orientation; then patches have sigmas
    shadows : what higher ground hides is left out; None = it shows what is seen beside it

    Attributes
    ----------
    missed : rays that did not meet the ground
    hidden : cells that were left out because higher ground hides them

    Raises
    ------
    ValueError : an unknown resampling
    """

    def __init__(
        self, rays: Rays, surface: Surface, grid: GroundGrid, resampling: str = "bilinear", band: int = BAND,
        errors: GroundErrors | None = None, shadows: Shadows | None = None,
    ) -> None:  # fmt: skip
        if resampling not in TAPS:
            raise ValueError(f"resampling {resampling!r}, wanted one of {', '.join(TAPS)}")
        self.rays, self.surface, self.grid, self.resampling, self.band = rays, surface, grid, resampling, band
        self.errors, self.shadows = errors, shadows
        self.missed = self.hidden = 0
        self._axes: _Axes | None = None
        self._first = 0  # number of the first line at hand
        self._pixels = np.empty((0, rays.pixels), dtype=np.uint16)
        self._usable = np.empty(0, dtype=bool)
        self._cells: Array = np.empty((0, len(rays.sample), 2))
        self._place: Array = np.empty((0, len(rays.sample), 2))
        self._sigma = np.empty((0, len(rays.sample), 2), dtype=np.float32)
        self._slope = np.empty((0, len(rays.sample), 2), dtype=np.float32)
        self._done = 0  # places p below are rectified

    def add(
        self, first_line: int, pixels: NDArray[np.unsignedinteger], usable: Mask | None, position_l: Array, R_lc: Array,
        covariance: Array | None = None,
    ) -> list[Patch]:  # fmt: skip
        """Add lines; returns what can be rectified now.

        Parameters
        ----------
        first_line : number of the first one; lines that were left out are missing from the orthoimage
        pixels : (n, samples)
        usable : (n,) which of them are fit for use, None for all
        position_l, R_lc : (n, 3), (n, 3, 3) orientation of each line
        covariance : (n, 6, 6) of X, Y, Z, omega, phi, kappa of each line, m, rad; wanted where patches have sigmas

        Raises
        ------
        ValueError : lines of another length, or that come before those at hand
        """
        n = len(pixels)
        if pixels.shape[1] != self.rays.pixels:
            raise ValueError(f"lines of {pixels.shape[1]} pixels, wanted {self.rays.pixels}")
        usable = np.ones(n, dtype=bool) if usable is None else usable
        out: list[Patch] = []
        if not n:
            return out
        if len(self._usable) and first_line != self._first + len(self._usable):
            if first_line < self._first + len(self._usable):
                raise ValueError(f"line {first_line} comes after line {self._first + len(self._usable) - 1}")
            out = self.finish()  # what is missing has no place: begin anew behind it
        if not len(self._usable):
            self._first = first_line
            self._pixels = self._pixels.astype(pixels.dtype)
        direction = self.rays.ray_c @ np.swapaxes(R_lc, 1, 2)
        point, cells = self._to_ground(position_l, direction)
        self._leave_out_far(cells)
        if self.shadows is not None:
            slope = np.where(np.isfinite(cells), direction[..., :2] / direction[..., 2:], np.nan)
            self._slope = np.concatenate([self._slope, slope.astype(np.float32)])
        if self.errors is not None:
            assert covariance is not None
            slope = self.surface.slope(point)
            sigma = sigmas_of_lines(position_l, R_lc, covariance, self.rays.ray_c, point, slope, self.errors)
            self._sigma = np.concatenate([self._sigma, sigma.astype(np.float32)])
        if not len(self._usable) and self._axes is not None and np.isfinite(cells).any():
            self._done = int(np.floor(np.nanmin(self._axes.place(cells)[..., 0])))
        self._pixels = np.concatenate([self._pixels, pixels])
        self._usable = np.concatenate([self._usable, usable])
        self._cells = np.concatenate([self._cells, cells])
        if self._axes is None:
            return out + (self._begin() if len(self._usable) >= min(self.band, 32) else [])
        self._place = np.concatenate([self._place, self._axes.place(cells)])
        return out + self._rectify(self.band)

    def finish(self) -> list[Patch]:
        """What is left; lines that are added then begin anew, on the same axes."""
        out = self._begin(least=2) if self._axes is None else []
        out += self._rectify(1)
        self._forget(len(self._usable))
        return out

    def _to_ground(self, position_l: Array, direction: Array) -> tuple[Array, Array]:
        """Points (n, k, 3) and cells (n, k, 2) that the rays of lines meet."""
        point, met = self.surface.meet(np.asarray(position_l)[:, None, :], direction)
        self.missed += int((~met).sum())
        if not met.any():
            return point, np.full((*met.shape, 2), np.nan)
        return point, self.grid.cells_of_many(point)

    def _leave_out_far(self, cells: Array) -> None:
        """Make those of the cells (n, k, 2) NaN that a wrong pose puts far from the others: a table up to them would
        take the memory and the time of the others."""
        lines = np.concatenate([self._cells[-NEWEST:], cells])
        newest = lines.reshape(-1, 2)
        at_hand = MOST_AWAY * (self.rays.pixels + len(self._usable) + len(cells))
        if float((np.fmax.reduce(newest) - np.fmin.reduce(newest)).max()) <= at_hand:
            return  # as nearly always: none is that far from any other
        newest = newest[np.isfinite(newest).all(axis=1)]
        if len(newest):
            step = np.hypot(*np.moveaxis(np.diff(lines, axis=1), 2, 0)) / np.diff(self.rays.sample)
            cells_a_pixel = float(np.median(step[np.isfinite(step)])) if np.isfinite(step).any() else 1.0
            away = np.abs(cells - np.median(newest, axis=0)).max(axis=2)
            with np.errstate(invalid="ignore"):
                far = away > max(cells_a_pixel, 1.0) * at_hand
            self.missed += int(far.sum())
            cells[far] = np.nan

    def _begin(self, least: int = 8) -> list[Patch]:
        """Lay the axes through the lines at hand."""
        met: Mask = np.asarray(np.isfinite(self._cells).all(axis=2))
        some = np.flatnonzero(met.any(axis=1))  # lines before the first that sees ground are of no use
        without = int(some[0]) if len(some) else len(met)
        self._forget(max(without, len(met) - MOST_WAITING))
        met = met[len(met) - len(self._usable) :]
        count = met.sum(axis=0)
        rays = np.flatnonzero(2 * count >= max(int(count.max(initial=0)), 1))  # the ground may end under the others
        known = np.flatnonzero(met[:, rays].all(axis=1))
        if len(known) < least or len(rays) < 2:
            return []
        self._axes = _Axes.through(self._cells[np.ix_(known, rays)], known, self.rays.sample[rays])
        self._place = self._axes.place(self._cells)
        self._done = int(np.floor(np.nanmin(self._place[..., 0])))
        return self._rectify(self.band)

    def _rectify(self, least: int) -> list[Patch]:
        """Rectify all places that the lines at hand have passed, if they are enough."""
        out: list[Patch] = []
        if self._axes is None or len(self._usable) < 2 or not np.isfinite(self._place).any():
            return out
        met = np.isfinite(self._place[..., 0])
        # rays that have left the ground that is known are not waited for
        columns = met[np.flatnonzero(met.any(axis=1))[-NEWEST:]].any(axis=0)
        ahead = int(np.floor(np.nanmax(self._place[:, columns, 0], axis=0).min())) - 2
        if least == 1:  # the last lines: places that only some of the pixels have passed, too
            ahead = int(np.ceil(np.nanmax(self._place[..., 0]))) + 1
        if len(self._usable) > MOST_WAITING:
            self._forget(len(self._usable) - MOST_WAITING)
        while ahead - self._done >= least:
            self._done += self._empty_ahead(ahead)
            end = min(self._done + max(self.band, least), ahead)
            if end <= self._done:
                break
            patch = self._band(self._done, end)
            if patch is not None:
                out.append(patch)
            self._done = end
        with np.errstate(invalid="ignore"):
            needed = np.flatnonzero((self._place[..., 0] >= self._done - 3).any(axis=1))
        taps = TAPS[self.resampling][1]
        self._forget(max(int(needed[0] if len(needed) else len(self._usable)) - taps, 0))
        return out

    def _empty_ahead(self, ahead: int) -> int:
        """How many p from the first that is not rectified on no line is near, in whole bands: a wrong pose leaves such
        a gap, in which there is nothing to see."""
        if ahead - self._done <= SEVERAL * self.band:
            return 0
        p = self._place[..., 0]
        p = p[p >= self._done - self.band]
        gap = max(int(p.min() - self._done) // self.band - 1, 0) * self.band if len(p) else 0
        return min(gap, ahead - self._done)

    def _forget(self, lines: int) -> None:
        self._first += lines
        self._pixels, self._usable = self._pixels[lines:], self._usable[lines:]
        self._cells, self._place = self._cells[lines:], self._place[lines:]
        self._sigma, self._slope = self._sigma[lines:], self._slope[lines:]

    def _band(self, begin: int, end: int) -> Patch | None:
        """Cells with p from ``begin`` to below ``end``."""
        assert self._axes is not None
        table = self._inverse(begin, end)
        if table is None:
            return None
        q0, source = table
        q1 = q0 + self.rays.step * (source.shape[1] - 1)
        row, column, length = self._axes.cells_between(begin, end, q0, q1)
        if not len(row):
            return None
        room = None if self.shadows is None else self._room(self.shadows, begin, end, q0, source)
        # places of the cells, relative to the table
        starts = np.concatenate([[0], np.cumsum(length)])
        p_start, q_start = self._axes.place_of(column, row)
        p_start, q_start = (
            (ROWS * (p_start - begin)).astype(np.float32),
            ((q_start - q0) / self.rays.step).astype(np.float32),
        )
        dp = np.float32(ROWS * self._axes.to_place[0, 0])
        dq = np.float32(self._axes.to_place[1, 0] / self.rays.step)
        dtype = self._pixels.dtype
        values = np.zeros(starts[-1], dtype=dtype)
        steepness = np.zeros(starts[-1], dtype=np.uint8)
        sigma = None if self.errors is None else np.full((starts[-1], 2), np.nan, dtype=np.float32)
        largest = np.float32(np.iinfo(dtype).max)
        middle = np.float32(0.5 * (self.rays.pixels - 1))
        usable = None if self._usable.all() else self._usable
        run = 0
        while run < len(row):
            stop = max(int(np.searchsorted(starts, starts[run] + CELLS, side="right")) - 1, run + 1)
            part = slice(starts[run], starts[stop])
            n = length[run:stop]
            along = (np.arange(starts[run], starts[stop]) - np.repeat(starts[run:stop], n)).astype(np.float32)
            p = np.repeat(p_start[run:stop], n) + dp * along
            q = np.repeat(q_start[run:stop], n) + dq * along
            place = _bilinear(source, p, q)
            line, sample = np.real(place), np.imag(place)
            with np.errstate(invalid="ignore"):
                grey, known = resample(self._pixels, usable, line, sample, self.resampling)
                np.rint(grey, out=grey)
                grey = np.clip(grey, 1, largest, out=grey)  # 0 is for nothing known
                steep = 255.0 - np.float32(254.0) / middle * np.abs(sample - middle)
            if room is not None:
                i, j = (
                    at * np.float32((knots - 1) / (nodes - 1))
                    for at, knots, nodes in zip((p, q), room.shape, source.shape, strict=True)
                )
                blocked = known & (_bilinear(room, i, j) < 0)
                self.hidden += int(blocked.sum())
                known &= ~blocked
            values[part] = np.where(known, grey, 0)
            steepness[part] = np.where(known, steep, 0)
            if sigma is not None:
                node = np.interp(sample[known], self.rays.sample, np.arange(len(self.rays.sample)))
                sigma[part][known] = _bilinear(self._sigma, line[known], node.astype(np.float32))
            run = stop
        return Patch(row, column, length, values, steepness, sigma)

    def _room(
        self, shadows: Shadows, begin: int, end: int, q0: int, source: NDArray[np.complexfloating]
    ) -> NDArray[np.float32]:
        """`Shadows.room` at knots from p = begin to end and q = q0 to the end of the table ``source``."""
        assert self._axes is not None
        q1 = q0 + self.rays.step * (source.shape[1] - 1)
        knot = max(shadows.knot_m / self.grid.cell_m, 1.0)  # cells
        per_p, per_q = np.linalg.norm(np.linalg.inv(self._axes.to_place), axis=0).tolist()
        rows, columns = (int(np.ceil(way / knot)) + 1 for way in ((end - begin) * per_p, (q1 - q0) * per_q))
        out = np.empty((rows, columns), dtype=np.float32)
        down, along = np.linspace(0.0, 1.0, rows), np.linspace(0.0, 1.0, columns)
        some = max(CELLS // columns, 1)
        for k in range(0, rows, some):
            i, j = np.meshgrid(down[k : k + some], along, indexing="ij")
            column, row = self._axes.cell_of(begin + (end - begin) * i, q0 + (q1 - q0) * j)
            at = ((n - 1) * share.ravel().astype(np.float32) for n, share in zip(source.shape, (i, j), strict=True))
            place = _bilinear(source, *at)
            known = np.isfinite(place)
            line = np.clip(np.real(place[known]), 0, len(self._slope) - 1)
            node = np.interp(np.imag(place[known]), self.rays.sample, np.arange(len(self.rays.sample)))
            slope = np.full((i.size, 2), np.nan, dtype=np.float32)
            slope[known] = _bilinear(self._slope, line, node.astype(np.float32))
            out[k : k + some] = shadows.room(self.grid, column, row, slope.reshape(*i.shape, 2))
        return out

    def _inverse(self, begin: int, end: int) -> tuple[int, NDArray[np.complexfloating]] | None:
        """Line (of those at hand) and sample, as real and imaginary part, at p = begin .. end and q every so often.

        Returns the first q, and the table.
        """
        p_wanted = begin + np.arange(ROWS * (end - begin) + 1) / ROWS
        lines = np.arange(len(self._usable), dtype=float)
        on = np.concatenate([[-STRAIGHT_ON], lines, [lines[-1] + STRAIGHT_ON]])
        k = len(self.rays.sample)
        line, q = np.full((len(p_wanted), k), np.nan), np.full((len(p_wanted), k), np.nan)
        for j in range(k):
            met = np.isfinite(self._place[:, j, 0])
            if np.count_nonzero(met) < 2:
                continue
            p = np.maximum.accumulate(self._place[met, j, 0])  # where a jolt shows ground twice, the first look counts
            if met.all():
                near = min(10, len(lines) - 1)
                steps = np.maximum([p[near] - p[0], p[-1] - p[-1 - near]], 0.2 * near) * (STRAIGHT_ON / near)
                line[:, j] = np.interp(p_wanted, np.concatenate([[p[0] - steps[0]], p, [p[-1] + steps[1]]]), on)
            else:
                line[:, j] = _between_neighbours(p_wanted, p, lines[met], np.flatnonzero(met))
            q[:, j] = np.interp(p_wanted, p, self._place[met, j, 1])
        if not np.isfinite(q).any():
            return None
        q0 = int(np.floor(np.nanmin(q)))
        count = int(np.ceil((np.nanmax(q) - q0) / self.rays.step)) + 1
        q_wanted = q0 + self.rays.step * np.arange(count, dtype=float)
        table = np.full((len(p_wanted), count), np.nan + 0j, dtype=np.complex64)
        sample = self.rays.sample
        for i in range(len(p_wanted)):
            met = np.isfinite(line[i])
            if np.count_nonzero(met) < 2:
                continue
            across = np.maximum.accumulate(q[i, met])
            table[i].real = _between_neighbours(q_wanted, across, line[i, met], np.flatnonzero(met))
            table[i].imag = np.interp(q_wanted, across, sample[met])
        return q0, table


@dataclass(frozen=True)
class _Axes:
    """``(p, q) = to_place @ (column, row) + shift``."""

    to_place: Array
    shift: Array

    @classmethod
    def through(cls, cells: Array, line: NDArray[np.int_], sample: Array) -> _Axes:
        """Axes along and across lines (n, k, 2): p grows with the lines, q with the samples.

        They are as oblique as the lines: a platform that crabs, or a line that looks forward over a slope.
        """
        middle = cells[:, len(sample) // 2]
        way = middle[-1] - middle[0]
        across = (cells[:, -1] - cells[:, 0]).mean(axis=0)
        travel = float(np.linalg.norm(way)) / max(int(line[-1] - line[0]), 1)
        width = float(np.linalg.norm(across)) / float(sample[-1] - sample[0])
        if travel < 1e-3 * width or width == 0:  # hardly moved: across is known at least
            travel, way = width, np.array([across[1], -across[0]])
        along, side = way / np.linalg.norm(way), across / np.linalg.norm(across)
        if abs(along[0] * side[1] - along[1] * side[0]) < LEAST_SINE:
            along = np.array([side[1], -side[0]])
        to_place = np.linalg.inv(np.stack([along * travel, side * width], axis=1))
        shift = np.array([line[0], sample[len(sample) // 2]]) - to_place @ middle[0]
        return cls(to_place, shift)

    def place(self, cells: Array) -> Array:
        return cells @ self.to_place.T + self.shift

    def place_of(self, column: IntArray, row: IntArray) -> tuple[Array, Array]:
        (pc, pr), (qc, qr) = self.to_place
        return pc * column + pr * row + self.shift[0], qc * column + qr * row + self.shift[1]

    def cell_of(self, p: Array, q: Array) -> tuple[Array, Array]:
        """Column and row (...) of places (...)."""
        (cp, cq), (rp, rq) = np.linalg.inv(self.to_place)
        p, q = p - self.shift[0], q - self.shift[1]
        return cp * p + cq * q, rp * p + rq * q

    def cells_between(self, p0: int, p1: int, q0: int, q1: int) -> tuple[IntArray, IntArray, IntArray]:
        """Row, first column and length of the runs of cells with p0 <= p < p1 and q0 <= q < q1."""
        corners = np.array([(p0, q0), (p0, q1), (p1, q0), (p1, q1)]) - self.shift
        column, row = np.linalg.solve(self.to_place, corners.T)
        rows = np.arange(int(np.floor(row.min())) - 1, int(np.ceil(row.max())) + 2)
        left = np.full(len(rows), int(np.floor(column.min())) - 1)
        right = np.full(len(rows), int(np.ceil(column.max())) + 2)
        for low, high, (by_column, by_row), shift in zip((p0, q0), (p1, q1), self.to_place, self.shift, strict=True):
            at = by_row * rows + shift
            if abs(by_column) < 1e-9:
                right = np.where((at >= low) & (at < high), right, left)
            elif by_column > 0:
                left = np.maximum(left, np.ceil((low - at) / by_column).astype(np.int64))
                right = np.minimum(right, np.ceil((high - at) / by_column).astype(np.int64))
            else:
                left = np.maximum(left, np.floor((high - at) / by_column).astype(np.int64) + 1)
                right = np.minimum(right, np.floor((low - at) / by_column).astype(np.int64) + 1)
        some = right > left
        return rows[some], left[some], (right - left)[some]


def _between_neighbours(wanted: Array, x: Array, y: Array, number: NDArray[np.intp]) -> Array:
    """Values at places by those at places x (n,), which increase; NaN outside them, and between two that are no
    neighbours by their numbers: what lies between saw no ground."""
    out = np.interp(wanted, x, y, left=np.nan, right=np.nan)
    gap = np.diff(number) > 1
    if gap.any():
        k = np.clip(np.searchsorted(x, wanted, side="right") - 1, 0, len(x) - 2)
        out[gap[k] & (wanted > x[k]) & (wanted < x[k + 1])] = np.nan
    return out


def _bilinear(table: NDArray[Any], p: Array, q: Array) -> NDArray[Any]:
    """Between the nodes of a table (rows, columns, ...); p and q (n,) lie inside."""
    rows, columns = table.shape[:2]
    i, j = p.astype(np.intp), q.astype(np.intp)
    np.clip(i, 0, rows - 2, out=i)
    np.clip(j, 0, columns - 2, out=j)
    a, b = p - i.astype(np.float32), q - j.astype(np.float32)
    i *= columns
    i += j
    flat = table.reshape(rows * columns, *table.shape[2:])
    if table.ndim > 2:
        a, b = a[:, None], b[:, None]
    low = flat.take(i, axis=0)
    low += b * (flat.take(i + 1, axis=0) - low)
    i += columns
    high = flat.take(i, axis=0)
    high += b * (flat.take(i + 1, axis=0) - high)
    high -= low
    high *= a
    low += high
    return low
