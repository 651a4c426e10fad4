"""Rational polynomials fitted to a rigorous model or to points, by reweighted and regularised linear least squares.

With ``u = N/D`` the equation ``N - u D = 0`` is linear in the coefficients; divided by the ``D`` of the step before it
is the residual in the image. The coefficients are nearly dependent, so they are held near zero by a small ridge;
without it denominators can pass zero between the points. For points with noise the ridge follows from leaving out
groups of points in turn.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .rpc import POWERS, RationalFunctions, Rpc, terms

Array = NDArray[np.floating]

#: Ridges that are tried for points with noise; the smallest is that of the fit to a rigorous model. Derived: below it
#: rounding decides, and above one the polynomial is a plane.
RIDGES = tuple(10.0**k for k in range(-12, 1))
_MODEL_RIDGE = 1e-12
_ROUNDS = 6
#: How much stronger than the ridge, squared, each coefficient is held at zero: numerators, then denominators without
#: the constant. Derived: in narrow fields of view each order is a hundredth or less of the one before, a denominator
#: of order k acts like a numerator of order k + 1; position, scale and rotation are free but for rounding.
_ORDER = POWERS.sum(axis=1)
_PENALTY = np.concatenate([np.array([1e-4, 1e-4, 1.0, 10.0])[_ORDER], np.array([0.0, 1.0, 10.0, 100.0])[_ORDER[1:]]])
#: Groups of points that are left out in turn.
_GROUPS = 8
#: Nodes of the grid in line, sample and height.
GRID = (21, 21, 7)
#: Share by which the box of a fit is wider than its points, so that points at its edge have room.
_WIDER = 1.0 + 1e-6


class LocationModel(Protocol):
    """Any model with direct location."""

    @property
    def lines(self) -> int: ...

    @property
    def samples(self) -> int: ...

    def direct(self, line: ArrayLike, sample: ArrayLike, height_m: ArrayLike) -> Array:
        """Latitude, longitude (radians) and height, (n, 3)."""
        ...


@dataclass(frozen=True)
class RpcFit:
    """A fit and how good it is.

    Attributes
    ----------
    rpc : the polynomials
    ridge : the regularisation, relative to the mean diagonal of the normal equations
    rms_px, max_px : distance in the image between the points and the fit; for a rigorous model at points between those
        of the fit
    smallest_denominator : over the box, relative to its constant term
    """

    rpc: Rpc
    ridge: float
    rms_px: float
    max_px: float
    smallest_denominator: float


def fit_to_model(model: LocationModel, low_m: float, high_m: float, grid: tuple[int, int, int] = GRID) -> RpcFit:
    """Rational polynomials of a rigorous model between two heights above the ellipsoid.

    Parameters
    ----------
    model : its image must see the ground at all these heights
    low_m, high_m : metres
    grid : nodes in line, sample, height

    Raises
    ------
    ValueError : heights in the wrong order, pixels that miss the ground, denominators that pass zero
    """
    if not high_m > low_m:
        raise ValueError(f"heights {low_m:g} to {high_m:g} m, wanted the lower one first")
    points = _grid_points(model, low_m, high_m, grid, 0.0)
    functions = _fit(points, _MODEL_RIDGE)
    smallest = functions.smallest_denominator()
    ridge = _MODEL_RIDGE
    while not smallest > 0 and ridge < 1.0:
        ridge *= 10.0
        functions = _fit(points, ridge)
        smallest = functions.smallest_denominator()
    if not smallest > 0:
        raise ValueError("a denominator of the fitted polynomials passes zero inside their box")
    lat, lon, h, u, v = _grid_points(model, low_m, high_m, grid, 0.5)
    miss = np.linalg.norm(functions.at(np.degrees(lon), np.degrees(lat), h) - np.stack([v, u], axis=1), axis=1)
    rpc = Rpc(functions, None, model.lines, model.samples)
    return RpcFit(rpc, ridge, float(np.sqrt(np.mean(miss**2))), float(miss.max()), smallest)


def fit_to_points(
    lat: ArrayLike, lon: ArrayLike, height_m: ArrayLike, line: ArrayLike, sample: ArrayLike, ridge: float | None = None
) -> RpcFit:
    """Rational polynomials through points with noise.

    Parameters
    ----------
    lat, lon : (n,) radians
    height_m : (n,) above the ellipsoid
    line, sample : (n,) pixels
    ridge : regularisation; None to choose it by leaving out groups of points in turn

    Raises
    ------
    ValueError : fewer than ten points, or none of the ridges keeps the denominators above zero
    """
    points = tuple(np.asarray(a, dtype=float).ravel() for a in (lat, lon, height_m, line, sample))
    n = len(points[0])
    if n < 10 or any(len(p) != n for p in points):
        raise ValueError(f"{n} points, wanted at least 10, each with latitude, longitude, height, line and sample")
    ridge = _best_ridge(points) if ridge is None else ridge
    functions = _fit(points, ridge)
    while not functions.smallest_denominator() > 0 and ridge < 1e3:
        ridge *= 10.0
        functions = _fit(points, ridge)
    if not functions.smallest_denominator() > 0:
        raise ValueError("a denominator of the fitted polynomials passes zero inside their box")
    miss = _misses(functions, points)
    rms, largest = float(np.sqrt(np.mean(miss**2))), float(miss.max())
    return RpcFit(Rpc(functions), ridge, rms, largest, functions.smallest_denominator())


def _grid_points(
    model: LocationModel, low: float, high: float, grid: tuple[int, int, int], shift: float
) -> tuple[Array, ...]:
    """Latitude, longitude, height, line, sample of a grid; with a shift of half a step the points lie between."""
    axes = [
        np.linspace(a, b, n + 1)[:-1] + shift * (b - a) / n if shift else np.linspace(a, b, n)
        for (a, b), n in zip(((0, model.lines - 1), (0, model.samples - 1), (low, high)), grid, strict=True)
    ]
    u, v, h = (a.ravel() for a in np.meshgrid(*axes, indexing="ij"))
    ground = model.direct(u, v, h)
    missed = np.isnan(ground).any(axis=1)
    if missed.any():
        k = int(np.argmax(missed))
        raise ValueError(f"line {u[k]:.1f}, sample {v[k]:.1f} misses the ground at height {h[k]:g} m")
    return ground[:, 0], ground[:, 1], h, u, v


def _fit(points: tuple[Array, ...], ridge: float) -> RationalFunctions:
    """Polynomials through latitudes, longitudes (radians), heights, lines and samples (n,) each."""
    lat, lon, h, u, v = points
    lon_deg = np.degrees(lon)
    lon_deg = lon_deg[0] + (lon_deg - lon_deg[0] + 180.0) % 360.0 - 180.0  # across the date line
    ins, outs = np.stack([lon_deg, np.degrees(lat), h]), np.stack([v, u])
    in_offset, in_scale = _box(ins)
    out_offset, out_scale = _box(outs)
    in_offset[0] = (in_offset[0] + 180.0) % 360.0 - 180.0
    x = ins - in_offset[:, None]
    x[0] -= 360.0 * np.round(x[0] / 360.0)
    T = terms(x / in_scale[:, None]).T
    coefficients = np.zeros((4, 20))
    for k, y in enumerate((outs - out_offset[:, None]) / out_scale[:, None]):
        coefficients[2 * k], coefficients[2 * k + 1] = _quotient(T, y, ridge)
    return RationalFunctions(coefficients, in_offset, in_scale, out_offset, out_scale)


def _quotient(T: Array, y: Array, ridge: float) -> tuple[Array, Array]:
    """Numerator and denominator (20,), (20,) with constant term 1, of values (n,) at terms (n, 20)."""
    A = np.hstack([T, -y[:, None] * T[:, 1:]])
    weight = np.ones(len(y))
    n = len(y)
    solution = np.zeros(39)
    for _ in range(_ROUNDS):
        B, right = A * weight[:, None], y * weight
        # stacked equations instead of normal equations: half the digits would be lost
        damping = np.sqrt(ridge * n) * np.diag(_PENALTY)
        solution = np.linalg.lstsq(np.vstack([B, damping]), np.concatenate([right, np.zeros(39)]), rcond=None)[0]
        denominator = 1.0 + T[:, 1:] @ solution[20:]
        weight = 1.0 / np.where(np.abs(denominator) > 1e-3, denominator, 1e-3)
    return solution[:20], np.concatenate([[1.0], solution[20:]])


def _box(values: Array) -> tuple[Array, Array]:
    """Middle and half width (k,) of the rows of values (k, n)."""
    low, high = values.min(axis=1), values.max(axis=1)
    half = 0.5 * (high - low) * _WIDER
    return 0.5 * (low + high), np.where(half > 0, half, 1.0)


def _misses(functions: RationalFunctions, points: tuple[Array, ...]) -> Array:
    lat, lon, h, u, v = points
    return np.linalg.norm(functions.at(np.degrees(lon), np.degrees(lat), h) - np.stack([v, u], axis=1), axis=1)


def _best_ridge(points: tuple[Array, ...]) -> float:
    """The ridge with which points that are left out are met best."""
    n = len(points[0])
    group = np.arange(n) % min(_GROUPS, n)
    scores = []
    for ridge in RIDGES:
        squares = 0.0
        for g in range(int(group.max()) + 1):
            out = group == g
            functions = _fit(tuple(p[~out] for p in points), ridge)
            misses = _misses(functions, tuple(p[out] for p in points))
            squares += float(np.sum(np.where(np.isfinite(misses), misses, 1e6) ** 2))
        scores.append(squares)
    return RIDGES[int(np.argmin(scores))]
