"""How a network is taken apart: cells of rays that share their columns, clusters of points that share most of them.

Made once per network and model; each iteration then works with dense blocks only.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from ..arrays import Bools, IntArray
from .layout import Layout
from .nested_dissection import Dissection
from .normal_matrix import NormalMatrix, Structure, find_structure, new_matrix

#: Costs that decide how points are clustered: seconds per multiply-add in a dense product, per element added to the
#: normal matrix, per value scattered, and per cluster. Only their ratios matter.
FLOP, ADD, CLUSTER = 3e-11, 1.5e-9, 5e-5
#: Fewest points that make a cluster, and most rays (so that its arrays stay in the cache).
FEWEST_POINTS, MOST_RAYS = 8, 8192


@dataclass(frozen=True)
class Cell:
    """Rays with the same columns (q,), -1 for none; their equations are ``low:high`` of `Elimination.by_cell`."""

    low: int
    high: int
    columns: IntArray


@dataclass(frozen=True)
class Cluster:
    """Neighbouring points eliminated together.

    Attributes
    ----------
    points, rays : ranges; rays of the points are contiguous
    columns : (U,) sorted columns of the reduced system that these rays touch
    place : (q, rays) int32 flat index of each term in a (points, U + 1) array; column U takes what a ray does not have
    """

    points: slice
    rays: slice
    columns: IntArray
    place: NDArray[np.int32]

    @property
    def n_points(self) -> int:
        return self.points.stop - self.points.start


@dataclass(frozen=True)
class Elimination:
    """The plan: cells, clusters, and the q = T + slots terms that rays have.

    Attributes
    ----------
    point : (n,) point of each ray
    n_points : number of points
    by_cell : (2 n,) order of equations in which cells are contiguous; those of y count after all of x
    cell : (n,) cell of each ray
    structure : order of the unknowns that makes a band; None for a dense system
    """

    point: IntArray
    n_points: int
    by_cell: IntArray
    cell: IntArray
    cells: tuple[Cell, ...]
    clusters: tuple[Cluster, ...]
    n_unknowns: int
    structure: Structure | Dissection | None

    def new_matrix(self) -> NormalMatrix:
        """A zero matrix for the reduced system."""
        return new_matrix(self.n_unknowns, self.structure)


def plan_elimination(
    layout: Layout, prior: csr_array, point: IntArray, first_ray: IntArray, dense: bool = False
) -> Elimination:
    """Group rays and points.

    Parameters
    ----------
    layout : unknowns
    prior : (n_unknowns, n_unknowns) normal matrix of the a-priori knowledge
    point : (n,) point of each ray, ascending
    first_ray : (p + 1,) rays of point i are ``first_ray[i]:first_ray[i + 1]``
    dense : whether the system is dense whatever its size
    """
    cell, by_cell, cells = _cells(layout)
    every = np.stack([c.columns for c in cells])
    touched = np.zeros((len(cells), layout.n_unknowns + 1), dtype=bool)
    touched[np.arange(len(cells))[:, None], every] = True
    touched[:, -1] = False
    clusters = []
    for low, high in _divided(0, len(first_ray) - 1, cell, touched, first_ray)[1]:
        rays = slice(int(first_ray[low]), int(first_ray[high]))
        of_ray = cell[rays]
        used = np.flatnonzero(np.bincount(of_ray, minlength=len(cells)))
        columns = np.flatnonzero(touched[used].any(axis=0))
        if layout.n_surface:
            columns = np.append(columns, layout.shift_column)
        width = len(columns) + 1
        local = np.full(layout.n_unknowns + 1, width - 1, dtype=np.int32)
        local[columns] = np.arange(width - 1)
        table = np.empty(every.shape, dtype=np.int32)
        table[used] = local[every[used]]
        place = np.empty((every.shape[1], len(of_ray)), dtype=np.int32)
        np.add(table[of_ray].T, ((point[rays] - low) * width).astype(np.int32), out=place)
        clusters.append(Cluster(slice(low, high), rays, columns, place))
    cliques = [c.columns for c in clusters if len(c.columns)]
    structure = None if dense else find_structure(layout.n_of_sets, layout.n_unknowns, cliques, prior)
    return Elimination(
        point, len(first_ray) - 1, by_cell, cell, tuple(cells), tuple(clusters), layout.n_unknowns, structure
    )


def _cells(layout: Layout) -> tuple[IntArray, IntArray, list[Cell]]:
    """Cell of each ray, order of the equations by cell, cells."""
    n = layout.columns.shape[1]
    key = np.zeros(n, dtype=np.uint64)
    with np.errstate(over="ignore"):
        for t, column in enumerate(layout.columns):  # hash of the column list: the odd multiplier of each place differs
            key = (key ^ column.astype(np.uint64)) * np.uint64(0x9E3779B97F4A7C15 + 2 * t)
            key ^= key >> np.uint64(29)
        if layout.camera is not None:
            key = (key ^ layout.camera.pattern.astype(np.uint64)) * np.uint64(0xD6E8FEB86659FD93)
            key ^= key >> np.uint64(32)
    rays = np.argsort(key, kind="stable")
    begins = np.flatnonzero(np.diff(key[rays], prepend=key[rays[:1]] + np.uint64(1)))
    bounds = np.append(begins, n)
    size = np.diff(bounds)
    of_rays = np.repeat(np.arange(len(begins)), size)
    cell, by_cell = np.empty(n, dtype=np.int64), np.empty(2 * n, dtype=np.int64)
    cell[rays] = of_rays
    place = np.arange(n) + begins[of_rays]  # two equations each of the rays before the cell
    by_cell[place] = rays
    by_cell[place + size[of_rays]] = rays + n
    examples = rays[begins]
    columns = layout.columns[:, examples].T.astype(np.int64)
    if layout.camera is not None:
        own = layout.camera.columns[layout.camera.pattern[examples]].astype(np.int64)
        columns = np.concatenate([columns, np.where(own >= 0, own + layout.n_model, -1)], axis=1)
    return cell, by_cell, [Cell(*p, own) for p, own in zip(pairwise((2 * bounds).tolist()), columns, strict=True)]


def _divided(
    low: int, high: int, cell: IntArray, touched: Bools, first_ray: IntArray
) -> tuple[float, list[tuple[int, int]]]:
    """Cost of points ``low:high``, and the ranges they are best divided into; ``touched`` (cells, u) are unknowns."""
    rays = first_ray[high] - first_ray[low]
    present = np.zeros(len(touched), dtype=bool)
    present[cell[first_ray[low] : first_ray[high]]] = True
    u = int(np.count_nonzero(touched[present].any(axis=0)))
    own = 3 * (high - low) * u * u * FLOP + u * u * ADD + CLUSTER
    if high - low < 2 * FEWEST_POINTS or (own < 3 * CLUSTER and rays <= MOST_RAYS):
        return own, [(low, high)]
    middle = (low + high) // 2
    left, left_bounds = _divided(low, middle, cell, touched, first_ray)
    right, right_bounds = _divided(middle, high, cell, touched, first_ray)
    if left + right < own or rays > MOST_RAYS:
        return left + right, left_bounds + right_bounds
    return own, [(low, high)]
