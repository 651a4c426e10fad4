"""Attitude between measured ones: rotation spline, polynomials of the quaternion, or linear in a table."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..geometry.rotation import matrix_from_quaternion
from .ephemeris import check_covered, check_nodes

Array = NDArray[np.floating]

#: SciPy's spline is taken over as polynomials of this degree where no interval turns by more, radians: ten times as
#: fast. Derived: a turn of 0.1 rad in an interval is met to 1e-12.
_DEGREE, _SMALL_TURN = 6, 0.1


class Attitude(Protocol):
    """Rotation ``R_fb`` from the body to the frame of reference of the attitude, inside ``start_s`` to ``end_s``."""

    @property
    def start_s(self) -> float:
        """First time at which it is given."""
        ...

    @property
    def end_s(self) -> float:
        """Last time at which it is given."""
        ...

    def at(self, time_s: ArrayLike) -> Array:
        """Rotation matrices (n, 3, 3) at times (n,)."""
        ...


class SplineAttitude:
    """Rotation spline through quaternions: continuous angular rates and accelerations.

    Parameters
    ----------
    time_s : (n,) strictly increasing, n >= 2
    quaternion : (n, 4) ``R_fb`` as xyzw, of any length but zero
    margin_s : how far the first and last angular rate are continued beyond the nodes

    Raises
    ------
    ValueError : too few nodes, shapes that do not match, times that do not increase, a quaternion without a length
    """

    def __init__(self, time_s: ArrayLike, quaternion: ArrayLike, *, margin_s: float = 0.0):
        from scipy.spatial.transform import Rotation, RotationSpline

        t, q = np.asarray(time_s, dtype=float), unit_quaternions(quaternion)
        check_nodes(t, q, "attitude", 4)
        self.start_s, self.end_s = float(t[0] - margin_s), float(t[-1] + margin_s)
        self._first, self._last = float(t[0]), float(t[-1])
        self._time, self._spline = t, RotationSpline(t, Rotation.from_quat(q))
        turn = 2.0 * np.arccos(np.clip(np.abs(np.einsum("ij,ij->i", q[:-1], q[1:])), 0.0, 1.0))
        self._pieces = self._polynomials() if turn.max() < _SMALL_TURN else None

    def at(self, time_s: ArrayLike) -> Array:
        """Rotation matrices (n, 3, 3) at times (n,).

        Raises
        ------
        ValueError : a time outside
        """
        from scipy.spatial.transform import Rotation

        t = np.asarray(time_s, dtype=float)
        check_covered(t, self.start_s, self.end_s, "the attitude")
        inside = np.clip(t, self._first, self._last)
        R = self._inside(inside)
        beyond = t != inside
        if beyond.any():
            rate = self._spline(inside[beyond], order=1)
            R[beyond] = R[beyond] @ Rotation.from_rotvec(rate * (t - inside)[beyond, None]).as_matrix()
        return R

    def _polynomials(self) -> Array:
        """Coefficients (degree + 1, n - 1, 4) of the spline's quaternion in each interval, in ``s`` from -1 to 1."""
        s = np.cos(np.pi * (np.arange(_DEGREE + 1) + 0.5) / (_DEGREE + 1))
        middle, half = 0.5 * (self._time[:-1] + self._time[1:]), 0.5 * np.diff(self._time)
        at = middle[:, None] + half[:, None] * s
        q = self._spline(at.ravel()).as_quat().reshape(*at.shape, 4)
        q = q * np.where(np.einsum("ijk,ik->ij", q, q[:, 0]) < 0, -1.0, 1.0)[..., None]
        inverse = np.linalg.inv(np.polynomial.polynomial.polyvander(s, _DEGREE))
        return np.einsum("dj,njk->dnk", inverse, q)

    def _inside(self, t: Array) -> Array:
        if self._pieces is None:
            return self._spline(t).as_matrix()
        k = np.clip(np.searchsorted(self._time, t, side="right") - 1, 0, len(self._time) - 2)
        low, high = self._time[k], self._time[k + 1]
        s = ((2.0 * t - low - high) / (high - low))[:, None]
        q = self._pieces[_DEGREE][k]
        for d in range(_DEGREE - 1, -1, -1):
            q = q * s + self._pieces[d][k]
        return matrix_from_quaternion(q)


class TableAttitude:
    """Turn at a constant rate between neighbours of a table (the shortest way).

    Parameters and errors as of `SplineAttitude`.
    """

    def __init__(self, time_s: ArrayLike, quaternion: ArrayLike, *, margin_s: float = 0.0):
        from scipy.spatial.transform import Rotation, Slerp

        t, q = np.asarray(time_s, dtype=float), unit_quaternions(quaternion)
        check_nodes(t, q, "attitude", 4)
        self.start_s, self.end_s = float(t[0] - margin_s), float(t[-1] + margin_s)
        self._time, self._rotation = t, Rotation.from_quat(q)
        self._slerp = Slerp(t, self._rotation)

    def at(self, time_s: ArrayLike) -> Array:
        """Rotation matrices (n, 3, 3) at times (n,).

        Raises
        ------
        ValueError : a time outside
        """
        t = np.asarray(time_s, dtype=float)
        check_covered(t, self.start_s, self.end_s, "the attitude")
        return self._slerp(np.clip(t, self._time[0], self._time[-1])).as_matrix()


class AnglesAttitude:
    """Angles that are linear between the nodes of a table, as the makers of SPOT-5 define its attitude.

    Parameters
    ----------
    time_s : (n,) strictly increasing, n >= 2
    angles : (n, 3) radians
    sequence : axes of the three turns in SciPy's notation; capitals turn about axes that turn along
    fixed : (3, 3) rotation that is applied after the angles, from their frame to the frame of reference; None for none
    margin_s : how far the first and last rates are continued beyond the nodes

    Raises
    ------
    ValueError : too few nodes, shapes that do not match, times that do not increase
    """

    def __init__(
        self,
        time_s: ArrayLike,
        angles: ArrayLike,
        sequence: str = "XYZ",
        fixed: ArrayLike | None = None,
        *,
        margin_s: float = 0.0,
    ):
        t, a = np.asarray(time_s, dtype=float), np.asarray(angles, dtype=float)
        check_nodes(t, a, "attitude")
        self.start_s, self.end_s = float(t[0] - margin_s), float(t[-1] + margin_s)
        self._time, self._angles, self._sequence = t, np.unwrap(a, axis=0), sequence
        self._fixed = None if fixed is None else np.asarray(fixed, dtype=float)

    def at(self, time_s: ArrayLike) -> Array:
        """Rotation matrices (n, 3, 3) at times (n,).

        Raises
        ------
        ValueError : a time outside
        """
        from scipy.spatial.transform import Rotation

        t = np.asarray(time_s, dtype=float)
        check_covered(t, self.start_s, self.end_s, "the attitude")
        k = np.clip(np.searchsorted(self._time, t, side="right") - 1, 0, len(self._time) - 2)
        s = ((t - self._time[k]) / (self._time[k + 1] - self._time[k]))[:, None]
        angles = self._angles[k] * (1.0 - s) + self._angles[k + 1] * s
        R = Rotation.from_euler(self._sequence, angles).as_matrix()
        return R if self._fixed is None else self._fixed @ R


class PolynomialAttitude:
    """Each part of the quaternion a polynomial in scaled time; the quaternion is brought to unit length.

    Parameters
    ----------
    coefficients : four sequences, for x, y, z, w, the constant first
    offset_s, scale_s : the polynomials' argument is ``(time_s - offset_s) / scale_s``
    start_s, end_s : where the polynomials hold

    Raises
    ------
    ValueError : no coefficients, or a scale of zero
    """

    def __init__(
        self, coefficients: Sequence[ArrayLike], offset_s: float, scale_s: float, start_s: float, end_s: float
    ):
        parts = [np.atleast_1d(np.asarray(c, dtype=float)) for c in coefficients]
        if len(parts) != 4 or not all(len(p) for p in parts) or not all(np.isfinite(p).all() for p in parts):
            raise ValueError("attitude: wanted polynomial coefficients for the four parts of a quaternion")
        if not (np.isfinite(scale_s) and scale_s != 0):
            raise ValueError(f"attitude: time scale {scale_s} s of the polynomials, wanted a number that is not 0")
        self._coefficients = np.zeros((max(map(len, parts)), 4))
        for k, part in enumerate(parts):
            self._coefficients[: len(part), k] = part
        self._offset, self._scale = float(offset_s), float(scale_s)
        self.start_s, self.end_s = float(start_s), float(end_s)

    def at(self, time_s: ArrayLike) -> Array:
        """Rotation matrices (n, 3, 3) at times (n,).

        Raises
        ------
        ValueError : a time outside
        """
        t = np.asarray(time_s, dtype=float)
        check_covered(t, self.start_s, self.end_s, "the attitude")
        q = np.polynomial.polynomial.polyval((t - self._offset) / self._scale, self._coefficients).T
        return matrix_from_quaternion(q)


def unit_quaternions(quaternion: ArrayLike) -> Array:
    """Quaternions (n, 4) of unit length, with signs that do not jump.

    Raises
    ------
    ValueError : not (n, 4), or one without a length
    """
    q = np.asarray(quaternion, dtype=float)
    if q.ndim != 2 or q.shape[1] != 4:
        raise ValueError(f"attitude: quaternions {q.shape}, wanted (n, 4)")
    length = np.linalg.norm(q, axis=1)
    if not (np.isfinite(length) & (length > 0)).all():
        raise ValueError(f"attitude: quaternion {int(np.argmin(np.isfinite(length) & (length > 0)))} has no length")
    q = q / length[:, None]
    sign = np.where(np.einsum("ij,ij->i", q[:-1], q[1:]) < 0, -1.0, 1.0)
    return q * np.concatenate([[1.0], np.cumprod(sign)])[:, None]
