"""Where each detector of a line looks in the body of the satellite: polynomials, a table, or a camera with a lens."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.floating]


class LookDirections(Protocol):
    """Look directions of the detectors of a line."""

    samples: int

    def at(self, sample: ArrayLike) -> tuple[Array, Array]:
        """Directions (n, 3) in the body, of any length, of samples (n,), and their derivatives by the sample."""
        ...


class PolynomialLook:
    """Direction ``matrix @ (px(s), py(s), 1)`` with polynomials in ``s = sample + shift``.

    Parameters
    ----------
    x, y : coefficients of the tangents, the constant first
    samples : number of detectors
    matrix : (3, 3) from the axes of the polynomials to the body
    shift : added to the sample, where the polynomials count from elsewhere

    Raises
    ------
    ValueError : no coefficients, no samples
    """

    def __init__(self, x: ArrayLike, y: ArrayLike, samples: int, matrix: ArrayLike, shift: float = 0.0):
        self._x, self._y = (np.atleast_1d(np.asarray(c, dtype=float)) for c in (x, y))
        if not (len(self._x) and len(self._y)) or not (np.isfinite(self._x).all() and np.isfinite(self._y).all()):
            raise ValueError("look directions: wanted coefficients of both polynomials")
        if samples < 1:
            raise ValueError(f"{samples} samples, wanted at least 1")
        self.samples, self._shift = int(samples), float(shift)
        self._matrix = np.asarray(matrix, dtype=float)

    def at(self, sample: ArrayLike) -> tuple[Array, Array]:
        s = np.asarray(sample, dtype=float) + self._shift
        P = np.polynomial.polynomial
        direction = np.stack([P.polyval(s, self._x), P.polyval(s, self._y), np.ones_like(s)], axis=-1)
        slope = np.stack([P.polyval(s, P.polyder(self._x)), P.polyval(s, P.polyder(self._y)), 0 * s], axis=-1)
        return direction @ self._matrix.T, slope @ self._matrix.T


class TableLook:
    """Directions of single detectors, linear between them and continued beyond the first and the last.

    Parameters
    ----------
    sample : (n,) strictly increasing, n >= 2
    direction_b : (n, 3)
    samples : number of detectors of the line

    Raises
    ------
    ValueError : fewer than two, or samples that do not increase
    """

    def __init__(self, sample: ArrayLike, direction_b: ArrayLike, samples: int):
        v, d = np.asarray(sample, dtype=float), np.asarray(direction_b, dtype=float)
        if len(v) < 2 or d.shape != (len(v), 3):
            raise ValueError(f"look directions {d.shape} of {len(v)} detectors, wanted (n, 3) with n at least 2")
        if not (np.diff(v) > 0).all():
            raise ValueError(
                f"look directions: detector {int(np.argmin(np.diff(v) > 0)) + 1} does not follow the one before"
            )
        if not np.isfinite(d).all():
            raise ValueError("look directions: a value that is not a number")
        self.samples = int(samples)
        self._sample, self._direction = v, d
        self._slope = np.diff(d, axis=0) / np.diff(v)[:, None]

    def at(self, sample: ArrayLike) -> tuple[Array, Array]:
        v = np.asarray(sample, dtype=float)
        k = np.clip(np.searchsorted(self._sample, v, side="right") - 1, 0, len(self._sample) - 2)
        slope = self._slope[k]
        return self._direction[k] + slope * (v - self._sample[k])[..., None], slope
