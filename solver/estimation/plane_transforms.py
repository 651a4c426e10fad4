"""Transforms of the plane through common points, with sigmas [D 1.2].

| kind | parameters | least points |
|---|---|---|
| helmert | 4: shift, rotation, scale | 2 |
| affine | 6 | 3 |
| pseudo-affine | 8: affine with a term x y | 4 |
| projective | 8 | 4 |
| conformal | 6: a complex polynomial of second order | 3 |
| polynomial | (n + 1)(n + 2) of order n | half of that |

Both systems are moved to the middle of the points and scaled alike in x and y before anything is computed, so that
coordinates of a map grid lose no digits.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.floating]

#: Kinds, and what they take at least.
LEAST_POINTS = {"helmert": 2, "affine": 3, "pseudo-affine": 4, "projective": 4, "conformal": 3}
#: Singular values below this share of the largest one count as zero: the points leave a parameter open. Rounding, of
#: coordinates that are a million times as large as the extent of the points.
_RANK = 1e-9
_CONVERGED, _MOST_STEPS = 1e-11, 50
#: Largest order of a polynomial; higher ones swing between the points.
_LARGEST_ORDER = 9


@dataclass(frozen=True)
class PlaneTransform:
    """A transform that was fitted.

    Attributes
    ----------
    kind : with the order, for polynomials ("polynomial 3")
    coefficients : (d,) in the scaled systems
    covariance : (d, d) of them
    residuals : (n, 2) target less transformed points, in the units of the target
    sigma0 : of a coordinate of unit weight; where sigmas were given it is 1 when they are right; NaN without redundancy
    redundancy : coordinates less parameters
    condition : of the design, after scaling
    """

    kind: str
    coefficients: Array
    covariance: Array
    residuals: Array
    sigma0: float
    redundancy: int
    condition: float
    _from: tuple[Array, float]
    _to: tuple[Array, float]

    @property
    def sigma(self) -> Array:
        """(d,) of the coefficients."""
        return np.sqrt(np.diag(self.covariance))

    def at(self, xy: ArrayLike) -> Array:
        """Transformed points (n, 2) of points (n, 2)."""
        values, _ = _evaluate(self.kind, _scaled(xy, self._from), self.coefficients)
        return values * self._to[1] + self._to[0]

    def covariance_at(self, xy: ArrayLike) -> Array:
        """Covariance (n, 2, 2) of transformed points, from that of the coefficients."""
        _, J = _evaluate(self.kind, _scaled(xy, self._from), self.coefficients)
        return self._to[1] ** 2 * J @ self.covariance @ np.swapaxes(J, 1, 2)


def fit_transform(
    kind: str, source: ArrayLike, target: ArrayLike, sigma: ArrayLike | None = None, order: int = 2
) -> PlaneTransform:
    """Fit a transform by least squares.

    Parameters
    ----------
    kind : helmert, affine, pseudo-affine, projective, conformal or polynomial
    source, target : (n, 2)
    sigma : (n,) or one, of the coordinates of the target; None where they are alike and unknown (then the covariance
        comes from the residuals, and is NaN without redundancy)
    order : of a polynomial

    Raises
    ------
    ValueError : a kind that is not known, too few points, points that leave parameters open (collinear ones, for
        example), coordinates that are not numbers
    """
    xy, XY = np.asarray(source, dtype=float), np.asarray(target, dtype=float)
    if kind not in (*LEAST_POINTS, "polynomial"):
        raise ValueError(f"transform {kind!r}, wanted one of {', '.join([*LEAST_POINTS, 'polynomial'])}")
    if kind == "polynomial" and not 1 <= order <= _LARGEST_ORDER:
        raise ValueError(f"polynomial of order {order}, wanted 1 to {_LARGEST_ORDER}")
    if xy.ndim != 2 or xy.shape[1:] != (2,) or XY.shape != xy.shape:
        raise ValueError(f"points {xy.shape} and {XY.shape}, wanted (n, 2) both")
    if not (np.isfinite(xy).all() and np.isfinite(XY).all()):
        raise ValueError("points: a coordinate that is not a number")
    least = (order + 1) * (order + 2) // 2 if kind == "polynomial" else LEAST_POINTS[kind]
    n = len(xy)
    if n < least:
        raise ValueError(f"{kind} transform: {n} points, wanted at least {least}")
    spread = np.broadcast_to(np.asarray(1.0 if sigma is None else sigma, dtype=float), n)
    if not (spread > 0).all():
        raise ValueError("sigmas of the points, wanted numbers above 0")
    name = f"polynomial {order}" if kind == "polynomial" else kind
    into, out = _system(xy), _system(XY)
    x, X = _scaled(xy, into), _scaled(XY, out)
    weight = np.repeat(out[1] / spread, 2)  # of scaled coordinates
    c = _projective_start(x, X) if kind == "projective" else np.zeros(_count(name))
    s, Vt = np.zeros(0), np.zeros((0, 0))
    for _ in range(_MOST_STEPS):
        values, J = _evaluate(name, x, c)
        A = J.reshape(2 * n, -1) * weight[:, None]
        U, s, Vt = np.linalg.svd(A, full_matrices=False)
        rank = int(np.count_nonzero(s > _RANK * s[0]))
        if rank < len(c):
            raise ValueError(f"{kind} transform: the points determine {rank} of {len(c)} parameters (on one line?)")
        step = Vt.T @ (U.T @ ((X - values).ravel() * weight) / s)
        c = c + step
        if kind != "projective" or np.abs(step).max() < _CONVERGED:
            break
    else:
        raise ValueError(f"projective transform: no convergence in {_MOST_STEPS} steps")
    residual = X - _evaluate(name, x, c)[0]
    redundancy = 2 * n - len(c)
    square = float(np.sum((residual.ravel() * weight) ** 2))
    sigma0 = float(np.sqrt(square / redundancy)) if redundancy else float("nan")
    covariance = (Vt.T / s**2) @ Vt * (sigma0**2 if sigma is None else 1.0)
    return PlaneTransform(
        name, c, covariance, residual * out[1], sigma0, redundancy, float(s[0] / s[-1]), into, out
    )  # fmt: skip


def _system(points: Array) -> tuple[Array, float]:
    """Middle of points, and the distance that becomes 1."""
    middle = points.mean(axis=0)
    size = float(np.sqrt(np.mean((points - middle) ** 2)))
    return middle, size if size > 0 else 1.0


def _scaled(points: ArrayLike, system: tuple[Array, float]) -> Array:
    return (np.asarray(points, dtype=float) - system[0]) / system[1]


def _count(name: str) -> int:
    if name.startswith("polynomial"):
        order = int(name.split()[1])
        return (order + 1) * (order + 2)
    return {"helmert": 4, "affine": 6, "pseudo-affine": 8, "projective": 8, "conformal": 6}[name]


def _evaluate(name: str, xy: Array, c: Array) -> tuple[Array, Array]:
    """Transformed points (n, 2) and derivatives (n, 2, d) by the coefficients, in the scaled systems."""
    x, y = xy.T
    one, zero = np.ones_like(x), np.zeros_like(x)
    if name in ("helmert", "conformal"):
        # z^k times a complex coefficient a + i b
        columns = []
        for z in [(x + 1j * y) ** k for k in range(2 if name == "helmert" else 3)]:
            columns += [np.stack([z.real, z.imag], axis=1), np.stack([-z.imag, z.real], axis=1)]
        J = np.stack(columns, axis=-1)
        return J @ c, J
    if name == "projective":
        below = c[6] * x + c[7] * y + 1.0
        X, Y = (c[0] * x + c[1] * y + c[2]) / below, (c[3] * x + c[4] * y + c[5]) / below
        J = np.stack(
            [
                np.stack([x, y, one, zero, zero, zero, -X * x, -X * y], axis=1),
                np.stack([zero, zero, zero, x, y, one, -Y * x, -Y * y], axis=1),
            ],
            axis=1,
        )
        return np.stack([X, Y], axis=1), J / below[:, None, None]
    if name == "affine":
        powers = [(0, 0), (1, 0), (0, 1)]
    elif name == "pseudo-affine":
        powers = [(0, 0), (1, 0), (0, 1), (1, 1)]
    else:
        order = int(name.split()[1])
        powers = [(k - m, m) for k in range(order + 1) for m in range(k + 1)]
    T = np.stack([x**a * y**b for a, b in powers], axis=1)
    J = np.zeros((len(x), 2, 2 * len(powers)))
    J[:, 0, : len(powers)], J[:, 1, len(powers) :] = T, T
    return J @ c, J


def _projective_start(x: Array, X: Array) -> Array:
    """Coefficients by the direct linear transform."""
    one = np.column_stack([x, np.ones(len(x))])
    zero = np.zeros_like(one)
    rows = np.concatenate([np.hstack([one, zero, -X[:, :1] * one]), np.hstack([zero, one, -X[:, 1:] * one])])
    s, Vt = np.linalg.svd(rows)[1:]
    h = Vt[-1]
    # a second vanishing singular value, or points at infinity in their own middle, come from points on one line
    if s[7] <= _RANK * s[0] or abs(h[8]) < _RANK:
        rank = int(np.count_nonzero(s > _RANK * s[0]))
        raise ValueError(f"projective transform: the points determine {min(rank, 7)} of 8 parameters (on one line?)")
    return h[:8] / h[8]
