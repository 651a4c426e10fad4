"""Smooth functions of the place in a tile, from few nodes to all cells."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating]


@lru_cache(maxsize=256)
def places(length: int, count: int) -> Array:
    """``count`` nodes (Chebyshev-Lobatto, ends included) over cells 0 to ``length - 1``."""
    if count == 1:
        return np.array([0.5 * (length - 1)])
    return 0.5 * (length - 1) * (1.0 - np.cos(np.pi * np.arange(count) / (count - 1)))


@lru_cache(maxsize=256)
def spread(length: int, count: int) -> Array:
    """Matrix (length, count) from values at the nodes to values at all cells: the polynomial through the nodes."""
    return lagrange(places(length, count), np.arange(length, dtype=float))


def lagrange(nodes: Array, x: Array) -> Array:
    """Lagrange polynomials (len(x), len(nodes)) of nodes at places, barycentric."""
    n = len(nodes)
    scale = max(float(nodes[-1] - nodes[0]), 1.0) / 4.0
    weight = np.array([1.0 / np.prod((nodes[k] - np.delete(nodes, k)) / scale) for k in range(n)])
    apart = x[:, None] - nodes[None]
    out = (np.abs(apart) < 1e-12).astype(float)
    between = ~out.any(axis=1)
    terms = weight / apart[between]
    out[between] = terms / terms.sum(axis=1, keepdims=True)
    return out


def over_tile(values: Array, rows: int, columns: int) -> NDArray[np.float32]:
    """Values (rows, columns) of a smooth function given at nodes (k, k), single precision."""
    k, m = values.shape
    if k == m == 1:
        return np.full((rows, columns), values[0, 0], dtype=np.float32)
    up, across = _single(rows, k), _single(columns, m)
    return np.asarray(up @ (values.astype(np.float32) @ across.T), dtype=np.float32)


@lru_cache(maxsize=256)
def _single(length: int, count: int) -> NDArray[np.float32]:
    return spread(length, count).astype(np.float32)
