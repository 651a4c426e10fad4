"""Orbits between the positions of an ephemeris: Hermite of degree 7, Lagrange through 8 nodes, a fitted polynomial."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.floating]

#: Nodes of one piece, and so the degree: with position and velocity at 4, or position alone at 8. [S1: 60 s nodes on a
#: circular orbit, 0.6 um and 3.6 um]
_HERMITE_NODES, _LAGRANGE_NODES = 4, 8


class Orbit(Protocol):
    """Position and velocity at any time inside ``start_s`` to ``end_s``."""

    @property
    def start_s(self) -> float:
        """First time at which it is given."""
        ...

    @property
    def end_s(self) -> float:
        """Last time at which it is given."""
        ...

    def at(self, time_s: ArrayLike) -> tuple[Array, Array]:
        """Position (n, 3) in metres and velocity (n, 3) in m/s at times (n,), in the frame of the ephemeris."""
        ...


class InterpolatedOrbit:
    """Piecewise polynomial through the nodes of an ephemeris.

    Between two nodes it is the polynomial through the nodes about them, with their velocities if they are given
    (Hermite, degree 7 through 4 nodes), else through 8 positions (Lagrange). Where the ephemeris has fewer nodes, all
    of them are used. Newton's form with divided differences, in which a node with a velocity stands twice.

    Parameters
    ----------
    time_s : (n,) strictly increasing, n >= 2
    position : (n, 3) metres
    velocity : (n, 3) m/s, the derivative of the position in the same frame; None for Lagrange
    margin_s : how far the first and the last piece are continued beyond the nodes

    Raises
    ------
    ValueError : too few nodes, shapes that do not match, times that do not increase, values that are not finite
    """

    def __init__(
        self, time_s: ArrayLike, position: ArrayLike, velocity: ArrayLike | None = None, *, margin_s: float = 0.0
    ):
        t, P = np.asarray(time_s, dtype=float), np.asarray(position, dtype=float)
        V = None if velocity is None else np.asarray(velocity, dtype=float)
        check_nodes(t, P, "ephemeris")
        if V is not None:
            check_nodes(t, V, "ephemeris")
        self.time_s, self.margin_s = t, float(margin_s)
        self.start_s, self.end_s = float(t[0] - margin_s), float(t[-1] + margin_s)
        nodes = min(len(t), _LAGRANGE_NODES if V is None else _HERMITE_NODES)
        piece = np.arange(len(t) - 1)
        first = np.clip(piece - nodes // 2 + 1, 0, len(t) - nodes)
        index = first[:, None] + np.arange(nodes)
        # nearest nodes first, so that the high differences multiply small products
        middle = 0.5 * (t[piece] + t[piece + 1])
        index = np.take_along_axis(index, np.argsort(np.abs(t[index] - middle[:, None]), axis=1, kind="stable"), axis=1)
        if V is not None:
            index = np.repeat(index, 2, axis=1)
        self._origin = P[index[:, 0]]
        newton = _divided_differences(t[index], P[index] - self._origin[:, None], None if V is None else V[index])
        self._middle, self._half = middle, 0.5 * np.diff(t)
        self._coefficients = _powers(newton, (t[index] - middle[:, None]) / self._half[:, None], self._half)

    def at(self, time_s: ArrayLike) -> tuple[Array, Array]:
        """Position (n, 3) and velocity (n, 3) at times (n,).

        Raises
        ------
        ValueError : a time outside the ephemeris
        """
        t = np.asarray(time_s, dtype=float)
        check_covered(t, self.start_s, self.end_s, "the ephemeris")
        k = np.clip(np.searchsorted(self.time_s, t, side="right") - 1, 0, len(self.time_s) - 2)
        if len(t) and k.min() == k.max():  # one piece, as in most scenes: products of matrices
            return self._piece(int(k[0]), t)
        position, velocity = np.empty((len(t), 3)), np.empty((len(t), 3))
        for piece in np.unique(k):
            here = np.flatnonzero(k == piece)
            position[here], velocity[here] = self._piece(int(piece), t[here])
        return position, velocity

    def _piece(self, k: int, t: Array) -> tuple[Array, Array]:
        c = self._coefficients[k]
        powers = np.empty((len(c), len(t)))
        powers[0] = 1.0
        if len(c) > 1:
            powers[1] = (t - self._middle[k]) / self._half[k]
        for j in range(2, len(c)):
            np.multiply(powers[j - 1], powers[1], out=powers[j])
        slope = c[1:] * (np.arange(1, len(c)) / self._half[k])[:, None]
        return powers.T @ c + self._origin[k], powers[:-1].T @ slope


class PolynomialOrbit:
    """One polynomial in time for each coordinate, fitted to positions by least squares [D 4.62].

    Parameters
    ----------
    time_s : (n,) strictly increasing
    position : (n, 3) metres
    order : of the polynomial, at least 1; [D] takes 2
    velocity : (n, 3) m/s, adds equations: a velocity counts like a position, at the distance between nodes

    Attributes
    ----------
    residual_m : (n, 3) position minus polynomial

    Raises
    ------
    ValueError : fewer equations than coefficients, shapes that do not match, times that do not increase
    """

    def __init__(self, time_s: ArrayLike, position: ArrayLike, order: int = 2, velocity: ArrayLike | None = None):
        t, P = np.asarray(time_s, dtype=float), np.asarray(position, dtype=float)
        check_nodes(t, P, "ephemeris")
        rows = len(t) * (1 if velocity is None else 2)
        if order < 1 or rows < order + 1:
            raise ValueError(f"a polynomial of order {order} from {rows} equations, wanted order 1 to {rows - 1}")
        self.start_s, self.end_s = float(t[0]), float(t[-1])
        self._middle, self._half = 0.5 * (t[0] + t[-1]), 0.5 * (t[-1] - t[0])
        self._origin = P.mean(axis=0)
        s = (t - self._middle) / self._half
        A, B = np.polynomial.chebyshev.chebvander(s, order), P - self._origin
        equations, right = A, B
        if velocity is not None:
            V = np.asarray(velocity, dtype=float)
            check_nodes(t, V, "ephemeris")
            step = (t[-1] - t[0]) / (len(t) - 1)
            derivative = np.polynomial.chebyshev.chebder(np.eye(order + 1))
            slope = np.polynomial.chebyshev.chebvander(s, order - 1) @ derivative / self._half
            equations, right = np.vstack([A, slope * step]), np.vstack([B, V * step])
        self._coefficients = np.linalg.lstsq(equations, right, rcond=None)[0]
        self.residual_m = B - A @ self._coefficients

    def at(self, time_s: ArrayLike) -> tuple[Array, Array]:
        """Position (n, 3) and velocity (n, 3) at times (n,).

        Raises
        ------
        ValueError : a time outside the ephemeris
        """
        t = np.asarray(time_s, dtype=float)
        check_covered(t, self.start_s, self.end_s, "the ephemeris")
        s = (t - self._middle) / self._half
        value = np.polynomial.chebyshev.chebval(s, self._coefficients).T + self._origin
        rate = np.polynomial.chebyshev.chebval(s, np.polynomial.chebyshev.chebder(self._coefficients)).T / self._half
        return value, rate


def _divided_differences(z: Array, value: Array, slope: Array | None) -> Array:
    """Newton coefficients (m, k, 3) of polynomials through nodes (m, k); equal neighbours stand for a slope."""
    table = value.copy()
    coefficients = np.empty_like(value)
    coefficients[:, 0] = table[:, 0]
    for j in range(1, z.shape[1]):
        step = z[:, j:] - z[:, :-j]
        same = step == 0.0
        rise = (table[:, 1:] - table[:, :-1]) / np.where(same, 1.0, step)[..., None]
        if slope is not None and j == 1:
            rise = np.where(same[..., None], slope[:, :-1], rise)
        table = rise
        coefficients[:, j] = table[:, 0]
    return coefficients


def _powers(newton: Array, z: Array, half: Array) -> Array:
    """Coefficients (m, k, 3) of powers of ``s`` from Newton's form with nodes ``z`` (m, k).

    ``s`` counts from the middle of a piece in halves of it.

    Newton's coefficients are per second; about the middle of a piece powers of ``s`` lose no digits.
    """
    scaled = newton * half[:, None, None] ** np.arange(newton.shape[1])[None, :, None]
    out = np.zeros_like(newton)
    out[:, 0] = scaled[:, -1]
    for j in range(newton.shape[1] - 2, -1, -1):
        raised = np.zeros_like(out)
        raised[:, 1:] = out[:, :-1]
        out = raised - out * z[:, j, None, None]
        out[:, 0] += scaled[:, j]
    return out


def check_nodes(time_s: Array, values: Array, what: str, columns: int = 3) -> None:
    """Refuse nodes that cannot be interpolated.

    Raises
    ------
    ValueError : fewer than two, shapes that do not match, times that do not increase, values that are not finite
    """
    n = len(time_s)
    if n < 2:
        raise ValueError(f"{what}: {n} node{'s' if n != 1 else ''}, wanted at least 2")
    if values.shape != (n, columns):
        raise ValueError(f"{what}: values {values.shape} do not match {n} times, wanted ({n}, {columns})")
    if not (np.isfinite(time_s).all() and np.isfinite(values).all()):
        raise ValueError(f"{what}: a value that is not a number")
    if not (np.diff(time_s) > 0).all():
        raise ValueError(f"{what}: times must increase; node {int(np.argmin(np.diff(time_s) > 0)) + 1} does not")


def check_covered(time_s: Array, start_s: float, end_s: float, what: str) -> None:
    """Refuse times (n,) outside a span.

    Raises
    ------
    ValueError : naming the first time outside
    """
    outside = (time_s < start_s) | (time_s > end_s)
    if outside.any():
        bad = float(np.atleast_1d(time_s)[np.atleast_1d(outside)][0])
        raise ValueError(f"time {bad:.6f} s lies outside {what} [{start_s:.6f}, {end_s:.6f}] s")
