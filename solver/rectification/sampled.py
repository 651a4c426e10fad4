"""Quantities that change slowly over a tile, from some of its cells to all of them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..geometry.ellipsoid import Ellipsoid

Array = NDArray[np.floating]

#: Cells a side that are asked.
SIDE = 7
#: Step of derivatives by the height, metres.
STEP_M = 10.0


@dataclass(frozen=True)
class SomeCells:
    """Cells of a tile that see the image.

    Attributes
    ----------
    at : (n, 2) row and column in the tile, as shares from -1 to 1
    line, sample, height_m : (n,) what they see
    """

    at: Array
    line: Array
    sample: Array
    height_m: Array


def some_cells(line: Array, sample: Array, height_m: Array | float, inside: NDArray[np.bool_]) -> SomeCells:
    """Evenly chosen cells of a tile (rows, columns) out of those ``inside``; none if there are none."""
    rows, columns = np.nonzero(inside)
    if len(rows) > SIDE * SIDE:
        # some of the rows, and cells from the first to the last of each; every so many cells of all may be one column
        some = np.unique(rows)
        some = some[np.linspace(0, len(some) - 1, min(SIDE, len(some))).round().astype(int)]
        ends = np.searchsorted(rows, some, side="left"), np.searchsorted(rows, some, side="right") - 1
        i = np.linspace(*ends, -(-SIDE * SIDE // len(some))).round().astype(int).ravel()
        edge = [np.argmin(columns), np.argmax(columns), np.argmin(columns + rows), np.argmax(columns + rows)]
        keep = np.unique(np.concatenate([i, edge]))
        rows, columns = rows[keep], columns[keep]
    size = np.maximum(np.array(inside.shape, dtype=float) - 1.0, 1.0)
    at = 2.0 * np.stack([rows, columns], axis=1) / size - 1.0
    h = np.broadcast_to(np.asarray(height_m, dtype=float), inside.shape)[rows, columns]
    return SomeCells(at, line[rows, columns].astype(float), sample[rows, columns].astype(float), h)


def over_cells(cells: SomeCells, values: Array, shape: tuple[int, int]) -> NDArray[np.float32]:
    """Values (rows, columns, k) of a tile by a quadratic (with few cells a plane, or their mean) through values (n, k).

    Only to be used where cells see the image.
    """
    n = len(values)
    order = 2 if n >= 12 else 1 if n >= 6 else 0
    coefficients = np.linalg.lstsq(_terms(cells.at, order), values, rcond=None)[0]
    y, x = (np.linspace(-1.0, 1.0, m) if m > 1 else np.array([-1.0]) for m in shape)
    c = coefficients.astype(np.float32)
    y, x = y.astype(np.float32)[:, None, None], x.astype(np.float32)[None, :, None]
    out = np.broadcast_to(c[0], (*shape, values.shape[1])).copy()
    if order:
        out += c[1] * y + c[2] * x
    if order == 2:
        out += c[3] * (y * y) + c[4] * (x * x) + c[5] * (x * y)
    return out


def _terms(at: Array, order: int) -> Array:
    y, x = at.T
    columns = [np.ones_like(y), y, x, y * y, x * x, x * y]
    return np.stack(columns[: {0: 1, 1: 3, 2: 6}[order]], axis=1)


def metres_a_radian(lat: Array, height_m: Array, ellipsoid: Ellipsoid) -> tuple[Array, Array]:
    """Metres (...) east a radian of longitude, north a radian of latitude; at latitudes (...) in rad, heights in m."""
    e2 = ellipsoid.eccentricity2
    w2 = 1.0 - e2 * np.sin(lat) ** 2
    N = ellipsoid.semi_major_m / np.sqrt(w2)
    return (N + height_m) * np.cos(lat), N * (1.0 - e2) / w2 + height_m


def ground_steps(model: Any, cells: SomeCells, ellipsoid: Ellipsoid) -> tuple[Array, Array, Array, Array]:
    """How ground moves when a pixel or the height changes.

    Returns
    -------
    by_pixel : (n, 2, 2) east and north, metres, by line and sample at one height
    by_height : (n, 2) east and north by the height along the ray
    lat, lon : (n,) where the cells are, radians
    """
    u, v, h = cells.line, cells.sample, cells.height_m
    n = len(u)
    # steps to the inside of the image: orbit and attitude may end with it
    du = np.where(u > 0.5 * (model.lines - 1), -1.0, 1.0)
    dv = np.where(v > 0.5 * (model.samples - 1), -1.0, 1.0)
    u = np.clip(u, 0.0, max(model.lines - 1.0, 0.0))
    located = model.direct(
        np.concatenate([u, u + du, u, u]), np.concatenate([v, v, v + dv, v]),
        np.concatenate([h, h, h, h + STEP_M]),
    ).reshape(4, n, 3)  # fmt: skip
    east, north = metres_a_radian(located[0, :, 0], h, ellipsoid)
    moved = located[1:] - located[0]
    moved[..., 1] = (moved[..., 1] + np.pi) % (2 * np.pi) - np.pi
    en = np.stack([moved[..., 1] * east, moved[..., 0] * north], axis=-1)  # (3, n, 2)
    by_pixel = np.stack([en[0] / du[:, None], en[1] / dv[:, None]], axis=-1)
    return by_pixel, en[2] / STEP_M, located[0, :, 0], located[0, :, 1]
