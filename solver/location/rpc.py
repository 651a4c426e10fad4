"""Rational polynomial coefficients (RPC): evaluate, differentiate, invert.

A coordinate of the image is the quotient of two polynomials of third order in normalised longitude ``L``, latitude
``P`` and height ``H``, with 20 coefficients each in the order of RPC00B (NITF STDI-0002):

    1, L, P, H, LP, LH, PH, L2, P2, H2, PLH, L3, LP2, LH2, L2P, P3, PH2, L2H, P2H, H3
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .in_image import in_image

Array = NDArray[np.floating]

#: Powers of (L, P, H) of the 20 terms.
POWERS = np.array(
    [
        (0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 0), (1, 0, 1), (0, 1, 1), (2, 0, 0), (0, 2, 0), (0, 0, 2),
        (1, 1, 1), (3, 0, 0), (1, 2, 0), (1, 0, 2), (2, 1, 0), (0, 3, 0), (0, 1, 2), (2, 0, 1), (0, 2, 1), (0, 0, 3),
    ]
)  # fmt: skip
#: Denominators are judged on a grid with so many nodes in each of L, P, H from -1 to 1.
_BOX_NODES = 9
#: Newton's method of the direct location ends when it moves by less than this, pixels.
_CONVERGED_PX = 1e-9
_MOST_STEPS = 60
#: The slope is computed anew in every third step; tuned for time.
_STEPS_PER_SLOPE = 3
_PORTION = 4096
#: Polynomials of third order come back to where they were: points further from the middle of the box than so many
#: halves of it, beside the margin asked for, are not seen, whatever pixel comes out. Tuned: boxes are like scenes.
_FARTHEST = 3.0


@dataclass(frozen=True)
class RationalFunctions:
    """Two quotients of polynomials of third order in three normalised coordinates.

    Attributes
    ----------
    coefficients : (4, 20) numerator and denominator of the first result, then of the second
    in_offset, in_scale : (3,) of the coordinates; the first one may be an angle in degrees (see ``periodic``)
    out_offset, out_scale : (2,) of the results
    periodic : whether the first coordinate is a longitude, the same after 360 degrees

    Raises
    ------
    ValueError : shapes that do not fit, values that are not finite, a scale of zero
    """

    coefficients: Array
    in_offset: Array
    in_scale: Array
    out_offset: Array
    out_scale: Array
    periodic: bool = True

    def __post_init__(self) -> None:
        for name, shape in (
            ("coefficients", (4, 20)), ("in_offset", (3,)), ("in_scale", (3,)), ("out_offset", (2,)),
            ("out_scale", (2,)),
        ):  # fmt: skip
            value = np.asarray(getattr(self, name), dtype=float)
            if value.shape != shape or not np.isfinite(value).all():
                raise ValueError(f"rational polynomials: {name} {value.shape}, wanted {shape} finite numbers")
            object.__setattr__(self, name, value)
        if not (self.in_scale != 0).all() or not (self.out_scale != 0).all():
            raise ValueError("rational polynomials: a scale is zero")

    def normalised(self, first: ArrayLike, second: ArrayLike, third: ArrayLike) -> Array:
        """Normalised coordinates (3, n)."""
        columns = np.broadcast_arrays(*(np.atleast_1d(np.asarray(c, dtype=float)) for c in (first, second, third)))
        x = np.stack(columns) - self.in_offset[:, None]
        if self.periodic:
            x[0] -= 360.0 * np.round(x[0] / 360.0)
        return x / self.in_scale[:, None]

    def at(self, first: ArrayLike, second: ArrayLike, third: ArrayLike) -> Array:
        """Results (n, 2); NaN where a denominator is zero."""
        x = self.normalised(first, second, third)
        out = np.empty((x.shape[1], 2))
        for k in range(0, x.shape[1], _PORTION):
            p = self.coefficients @ terms(x[:, k : k + _PORTION])
            with np.errstate(divide="ignore", invalid="ignore"):
                out[k : k + _PORTION] = np.where(p[1::2] != 0, p[0::2] / p[1::2], np.nan).T
        return out * self.out_scale + self.out_offset

    def with_derivatives(
        self, first: ArrayLike, second: ArrayLike, third: ArrayLike, axes: int = 3
    ) -> tuple[Array, Array]:
        """Results (n, 2) and their derivatives (n, 2, axes) by the first coordinates."""
        x = self.normalised(first, second, third)
        p = self.coefficients @ terms(x)
        with np.errstate(divide="ignore", invalid="ignore"):
            q = np.where(p[1::2] != 0, p[0::2] / p[1::2], np.nan)
            slopes = []
            for axis in range(axes):
                d = self.coefficients @ term_slopes(x, axis)
                slopes.append((d[0::2] - q * d[1::2]) / p[1::2] / self.in_scale[axis])
        derivative = np.stack(slopes, axis=-1) * self.out_scale[:, None, None]
        return q.T * self.out_scale + self.out_offset, np.moveaxis(derivative, 0, 1)

    def smallest_denominator(self) -> float:
        """Smallest denominator over the box from -1 to 1, relative to the constant term.

        Zero or less is no model, and so is a denominator that is no number somewhere, for which this is 0.
        """
        axis = np.linspace(-1.0, 1.0, _BOX_NODES)
        x = np.stack([a.ravel() for a in np.meshgrid(axis, axis, axis)])
        smallest = np.inf
        for c in self.coefficients[1::2]:
            with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
                relative = c @ terms(x) / c[0]
            if not np.isfinite(relative).all():
                return 0.0
            smallest = min(smallest, float(relative.min()))
        return smallest


@dataclass(frozen=True)
class Rpc:
    """Rational polynomials of a scene.

    Attributes
    ----------
    to_image : (longitude deg, latitude deg, height m) -> (sample, line), 0-based, integer at the centre of a pixel
    to_ground : (sample, line, height m) -> (longitude deg, latitude deg); None where the file has none. It only starts
        the direct location, which is the inverse of ``to_image``
    lines, samples : size of the image; 0 where it is unknown
    error_bias_m, error_random_m : accuracy as the file states it (root mean square of east, and of north), 0 where none
    """

    to_image: RationalFunctions
    to_ground: RationalFunctions | None = None
    lines: int = 0
    samples: int = 0
    error_bias_m: float = 0.0
    error_random_m: float = 0.0

    def inverse(self, lat: ArrayLike, lon: ArrayLike, height_m: ArrayLike, margin_px: float | None = None) -> Array:
        """Line and sample, (n, 2), of latitudes and longitudes (n,) in radians at heights above the ellipsoid.

        Parameters
        ----------
        margin_px : points further outside the image become NaN, and those far beyond the ground of the polynomials,
            which may come back into it; None for no limit
        """
        out = self.to_image.at(np.degrees(lon), np.degrees(lat), height_m)[:, ::-1].copy()
        if margin_px is None:
            return out
        out[~in_image(out, self.lines, self.samples, margin_px)] = np.nan
        with np.errstate(invalid="ignore"):
            beyond = np.abs(self.to_image.normalised(np.degrees(lon), np.degrees(lat), height_m)[:2]).max(axis=0)
            out[~(beyond <= _FARTHEST * (1.0 + margin_px / np.abs(self.to_image.out_scale).min()))] = np.nan
        return out

    def direct(self, line: ArrayLike, sample: ArrayLike, height_m: ArrayLike) -> Array:
        """Latitude, longitude (radians) and height, (n, 3), of pixels (n,): Newton's method on `inverse`.

        Where it does not converge the result is NaN.
        """
        u, v, h = (np.array(a, dtype=float) for a in np.broadcast_arrays(*map(np.atleast_1d, (line, sample, height_m))))
        out = np.full((len(u), 3), np.nan)
        good = np.isfinite(u) & np.isfinite(v) & np.isfinite(h)
        for k in range(0, len(u), _PORTION):
            part = k + np.flatnonzero(good[k : k + _PORTION])
            out[part] = self._direct(u[part], v[part], h[part])
        return out

    def _direct(self, u: Array, v: Array, h: Array) -> Array:
        f = self.to_image
        pixel = np.stack([v, u], axis=1)
        lon, lat = self._first_guess(pixel, h)
        moved, inverse = np.full(len(u), np.inf), np.empty((len(u), 2, 2))
        active = np.flatnonzero(np.isfinite(lon) & np.isfinite(lat))
        for step in range(_MOST_STEPS):
            if not len(active):
                break
            if step % _STEPS_PER_SLOPE:  # the slope of a step before is good enough close to the answer
                value = f.at(lon[active], lat[active], h[active])
            else:
                value, slope = f.with_derivatives(lon[active], lat[active], h[active], 2)
                inverse[active] = _inverse2(slope)
            miss = pixel[active] - value
            dlon, dlat = np.einsum("nij,nj->in", inverse[active], miss)
            # no further than the size of the box in one step
            far = np.maximum(np.maximum(np.abs(dlon / f.in_scale[0]), np.abs(dlat / f.in_scale[1])), 1.0)
            lon[active] += dlon / far
            lat[active] += dlat / far
            moved[active] = np.abs(miss).max(axis=1)
            active = active[(moved[active] > _CONVERGED_PX) & np.isfinite(lon[active])]
        out = np.stack([np.radians(lat), np.radians((lon + 180.0) % 360.0 - 180.0), h], axis=1)
        out[~(moved < 1e3 * _CONVERGED_PX)] = np.nan
        return out

    def _first_guess(self, pixel: Array, h: Array) -> tuple[Array, Array]:
        """Longitude and latitude (n,), (n,) in degrees near where samples and lines (n, 2) are seen."""
        f = self.to_image
        if self.to_ground is not None:
            lon, lat = self.to_ground.at(pixel[:, 0], pixel[:, 1], h).T
            return lon.copy(), lat.copy()
        middle, slope = f.with_derivatives(*f.in_offset)
        shift = pixel - middle - slope[:, :, 2] * (h - f.in_offset[2])[:, None]
        dlon, dlat = _inverse2(slope[:, :, :2])[0] @ shift.T
        return f.in_offset[0] + dlon, f.in_offset[1] + dlat

    def shifted(self, line: float, sample: float) -> Rpc:
        """The same for an image cut out whose first pixel is at ``line``, ``sample`` of this one; its size unknown."""
        to_image = replace(self.to_image, out_offset=self.to_image.out_offset - [sample, line])
        ground = self.to_ground
        if ground is not None:
            ground = replace(ground, in_offset=ground.in_offset - [sample, line, 0.0])
        return replace(self, to_image=to_image, to_ground=ground, lines=0, samples=0)


def terms(x: Array) -> Array:
    """The 20 terms, (20, n), of normalised coordinates (3, n)."""
    L, P, H = x
    LL, PP, HH, LP = L * L, P * P, H * H, L * P
    return np.stack(
        [
            np.ones_like(L), L, P, H, LP, L * H, P * H, LL, PP, HH, LP * H, LL * L, L * PP, L * HH, LL * P, PP * P,
            P * HH, LL * H, PP * H, HH * H,
        ]
    )  # fmt: skip


def term_slopes(x: Array, axis: int) -> Array:
    """Derivatives (20, n) of the terms by one of the three normalised coordinates (3, n)."""
    L, P, H = x
    zero, one = np.zeros_like(L), np.ones_like(L)
    if axis == 0:
        rows = [
            zero, one, zero, zero, P, H, zero, 2 * L, zero, zero, P * H, 3 * L * L, P * P, H * H, 2 * L * P, zero,
            zero, 2 * L * H, zero, zero,
        ]  # fmt: skip
    elif axis == 1:
        rows = [
            zero, zero, one, zero, L, zero, H, zero, 2 * P, zero, L * H, zero, 2 * L * P, zero, L * L, 3 * P * P,
            H * H, zero, 2 * P * H, zero,
        ]  # fmt: skip
    else:
        rows = [
            zero, zero, zero, one, zero, L, P, zero, zero, 2 * H, L * P, zero, zero, 2 * L * H, zero, zero,
            2 * P * H, L * L, P * P, 3 * H * H,
        ]  # fmt: skip
    return np.stack(rows)


def _inverse2(M: Array) -> Array:
    """Inverses of matrices (n, 2, 2); not finite where there is none."""
    out = np.empty_like(M)
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = 1.0 / (M[:, 0, 0] * M[:, 1, 1] - M[:, 0, 1] * M[:, 1, 0])
        out[:, 0, 0], out[:, 0, 1] = M[:, 1, 1] * scale, -M[:, 0, 1] * scale
        out[:, 1, 0], out[:, 1, 1] = -M[:, 1, 0] * scale, M[:, 0, 0] * scale
    return out
