"""Cells of an orthoimage in a map projection, and heights of a map projection in the local frame."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, cached_property

import numpy as np
from numpy.typing import NDArray

from ..geometry.frames import LocalFrame
from .surface import HeightField

Array = NDArray[np.floating]

#: The polynomial from the local frame to cells must be this good, cells; and the nodes it is fitted to, each way.
TOLERANCE_CELLS, NODES = 2e-3, 5
#: A grid of heights has no more nodes than this.
MOST_NODES = 50_000_000
#: Nodes of it that are computed at once. Tuned: fewer take longer, more no less.
AT_ONCE = 20_000


@dataclass(frozen=True)
class CellWindow:
    """Cells of a `GroundGrid` from the first row and column up to, and without, the last."""

    row0: int
    row1: int
    column0: int
    column1: int

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.row1 - self.row0, self.column1 - self.column0

    def meets(self, low: Array, high: Array) -> bool:
        """Whether some of it lies between two corners (column, row)."""
        return bool(
            low[0] < self.column1 and high[0] > self.column0 - 1 and low[1] < self.row1 and high[1] > self.row0 - 1
        )


@dataclass(frozen=True)
class GroundGrid:
    """Square cells, numbered over the whole projection, so that mosaics of one cell size fit.

    Cell (0, 0) has its upper left corner at the projection's origin; columns go east, rows south; whole numbers are
    cell centres.

    Attributes
    ----------
    frame : the local frame with the CRS of the cells
    gsd : size of a cell, units of the CRS

    Raises
    ------
    ValueError : a size that is not positive
    """

    frame: LocalFrame
    gsd: float

    def __post_init__(self) -> None:
        if not (np.isfinite(self.gsd) and self.gsd > 0):
            raise ValueError(f"cells of {self.gsd}, wanted more than 0")

    @cached_property
    def cell_m(self) -> float:
        """Side of a cell on the ground at the origin of the local frame, metres; maps may be in feet, or enlarge."""
        return self.gsd * metres_a_unit(self.frame)

    def cells(self, point_l: Array) -> Array:
        """Column and row (..., 2) of local points (..., 3)."""
        xyz = self.frame.to_crs(point_l)
        return np.stack([xyz[..., 0] / self.gsd - 0.5, -xyz[..., 1] / self.gsd - 0.5], axis=-1)

    def corner(self, column: int, row: int) -> tuple[float, float]:
        """CRS coordinates of a cell's upper left corner."""
        return column * self.gsd, -row * self.gsd

    def window(self, left: float, bottom: float, right: float, top: float) -> CellWindow:
        """The cells that have a part between these CRS coordinates."""
        # what a bound is off by rounding is no reason for one more cell
        rows = int(np.floor(-top / self.gsd + 1e-6)), int(np.ceil(-bottom / self.gsd - 1e-6))
        columns = int(np.floor(left / self.gsd + 1e-6)), int(np.ceil(right / self.gsd - 1e-6))
        return CellWindow(*rows, *columns)

    def centre(self, column: Array, row: Array) -> tuple[Array, Array]:
        """CRS coordinates of places given in cells."""
        return (np.asarray(column) + 0.5) * self.gsd, -(np.asarray(row) + 0.5) * self.gsd

    def cells_of_many(self, point_l: Array) -> Array:
        """The same as `cells` for many points near each other (NaN stays NaN), by a polynomial where that is exact.

        Over some kilometres a projection is a cubic of X and Y, and the height only turns the plumb line; a projection
        costs a microsecond a point, the polynomial a tenth of it.
        """
        if self.frame.crs == "local":
            return self.cells(point_l)
        flat = point_l.reshape(-1, 3)
        polynomial, off = _polynomial(self.cells, np.nanmin(flat, axis=0), np.nanmax(flat, axis=0))
        if not off < TOLERANCE_CELLS:
            return self.cells(point_l)
        return polynomial(flat).reshape(*point_l.shape[:-1], 2)

    def on_relief(self, column: Array, row: Array, relief: HeightField) -> Array:
        """Local points (..., 3) of a relief at places in cells (...); NaN where the relief knows no height.

        The way back of `cells_of_many`, by a polynomial of column, row and Z where that is exact.
        """
        lowest, usual, highest = relief.range_m
        at = np.stack([column.ravel(), row.ravel(), np.full(column.size, usual)], axis=1)
        low, high = at.min(axis=0), at.max(axis=0)
        low[2], high[2] = lowest, highest
        polynomial, off = _polynomial(self._local, low, high)
        to_local = polynomial if off < TOLERANCE_CELLS * self.cell_m else self._local
        xy, z = at[:, :2], at[:, 2]
        for _ in range(2):  # the plumb lines of the local frame and of the map differ a little
            xy = to_local(at)
            z = relief.height(xy[:, 0], xy[:, 1])
            at[:, 2] = np.where(np.isfinite(z), z, usual)
        return np.column_stack([xy, z]).reshape(*column.shape, 3)

    def _local(self, at: Array) -> Array:
        """Local X and Y (n, 2) of columns, rows and Z (n, 3)."""
        x, y = self.centre(at[:, 0], at[:, 1])
        if self.frame.crs == "local":
            return np.stack([x, y], axis=1)
        place = np.stack([x, y, np.zeros(len(at))], axis=1)
        upright = self.frame.from_crs(place[:1] + np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 1.0]]))[:, 2]
        for _ in range(2):
            place[:, 2] += (at[:, 2] - self.frame.from_crs(place)[:, 2]) / (upright[1] - upright[0])
        return self.frame.from_crs(place)[:, :2]


def _polynomial(exactly: Callable[[Array], Array], low: Array, high: Array) -> tuple[Callable[[Array], Array], float]:
    """A polynomial for a function of places (n, 3) between two corners (3,), and how far it is off at most."""
    middle, half = 0.5 * (low + high), np.maximum(0.5 * (high - low), 1.0)
    nodes, design = _nodes()
    wanted = exactly(middle + half * nodes)
    offset = wanted.mean(axis=0)
    coefficients, *_ = np.linalg.lstsq(design, wanted - offset, rcond=None)
    off = float(np.abs(design @ coefficients - (wanted - offset)).max())
    return lambda at: _basis((at - middle) / half) @ coefficients + offset, off


@cache
def _nodes() -> tuple[Array, Array]:
    """Places (n, 3) between -1 and 1 that the polynomial is fitted to, and its terms there."""
    x, y, z = np.meshgrid(*[np.linspace(-1, 1, n) for n in (NODES, NODES, 3)], indexing="ij")
    nodes = np.stack([x.ravel(), y.ravel(), z.ravel()], axis=1)
    return nodes, _basis(nodes)


def _basis(s: Array) -> Array:
    x, y, z = s.T
    xx, yy, xy = x * x, y * y, x * y
    return np.stack([np.ones(len(s)), x, y, z, xx, xy, yy, xx * x, xx * y, xy * y, yy * y, x * z, y * z], axis=1)


def metres_a_unit(frame: LocalFrame) -> float:
    """Metres on the ground that a unit of the CRS of a local frame is, at its origin; the mean of both axes."""
    step_m = 100.0
    x, y, _ = frame.to_crs(step_m * np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])).T
    area = abs((x[1] - x[0]) * (y[2] - y[0]) - (x[2] - x[0]) * (y[1] - y[0]))
    return float(step_m / np.sqrt(area))


def utm_of(frame: LocalFrame) -> str:
    """EPSG name of the UTM zone (WGS 84) at the origin of a local frame."""
    zone = int((frame.lon_deg + 180.0) // 6.0) % 60 + 1
    return f"EPSG:{(32600 if frame.lat_deg >= 0 else 32700) + zone}"


def heights_in_frame(
    frame: LocalFrame, crs: str, z: Array, x0: float, y0: float, dx: float, dy: float, step_m: float = 0.0
) -> HeightField:
    """Heights given in a CRS, bilinear, as a field in the local frame.

    Parameters
    ----------
    frame : the local frame; its own CRS does not matter
    crs : of the heights, which may be in feet or depths in it; above the ellipsoid where it says nothing of heights
    z : (rows, columns) heights at nodes, NaN where not known
    x0, y0 : CRS coordinates of the first node
    dx, dy : from column to column and from row to row, of either sign
    step_m : between the nodes of the field; 0 = as far as the given ones are from each other

    Raises
    ------
    CrsError : PROJ does not know the CRS, or cannot transform from it
    ValueError : fewer than 2 x 2 heights, more nodes than memory holds
    """
    if z.ndim != 2 or min(z.shape) < 2:
        raise ValueError(f"heights of shape {z.shape}, wanted at least 2 x 2 nodes")
    other = replace(frame, crs=crs)
    rows, columns = z.shape
    edge_x, edge_y = np.linspace(0, columns - 1, 33), np.linspace(0, rows - 1, 33)
    border = np.array(
        [(x0 + dx * j, y0 + dy * i) for i in edge_y for j in (0, columns - 1)]
        + [(x0 + dx * j, y0 + dy * i) for j in edge_x for i in (0, rows - 1)]
    )
    middle = float(np.nanmedian(z))
    corners = other.from_crs(np.column_stack([border, np.full(len(border), middle)]))
    if not step_m:
        here = other.from_crs(np.array([x0, y0, middle]) + np.array([[0, 0, 0], [dx, 0, 0], [0, dy, 0]]) + [dx, dy, 0])
        step_m = float(min(np.linalg.norm(here[1] - here[0]), np.linalg.norm(here[2] - here[0])))
    (left, bottom), (right, top) = corners[:, :2].min(axis=0), corners[:, :2].max(axis=0)
    nx, ny = int((right - left) / step_m) + 2, int((top - bottom) / step_m) + 2
    if nx * ny > MOST_NODES:
        raise ValueError(f"{nx} x {ny} heights are too many, wanted at most {MOST_NODES}")
    given = HeightField(0.0, 0.0, 1.0, z)
    first = other.from_crs(np.array([[x0, y0, middle], [x0, y0, middle + 1.0]]))
    unit_m = float(first[1, 2] - first[0, 2])  # of the heights, in the local frame
    start_m = float(np.median(corners[:, 2]))
    field = np.empty((ny, nx))
    x_l = left + step_m * np.arange(nx)
    some = max(AT_ONCE // nx, 1)
    for i in range(0, ny, some):
        y_l = bottom + step_m * np.arange(i, min(i + some, ny))
        point = np.stack([*(v.ravel() for v in np.meshgrid(x_l, y_l)), np.full(nx * len(y_l), start_m)], axis=1)
        for _ in range(3):  # the place in the CRS hardly depends on the height
            place = other.to_crs(point, may_lie_outside=True)  # the field reaches beyond the given heights
            x = other.near(place[:, 0], x0 + 0.5 * dx * (columns - 1))  # across the date line, or from 0 to 360
            h = given.height((x - x0) / dx, (place[:, 1] - y0) / dy)
            known = np.isfinite(h)
            point[:, 2] += np.where(known, unit_m * (h - place[:, 2]), 0.0)
        field[i : i + some] = np.where(known, point[:, 2], np.nan).reshape(len(y_l), nx)
    return HeightField(float(left), float(bottom), step_m, field)
