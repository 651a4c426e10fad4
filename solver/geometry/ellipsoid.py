"""Ellipsoids of revolution: geodetic coordinates, and where rays meet a surface of constant height, on any planet."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from . import earth

Array = NDArray[np.floating]

#: Newton steps from the ellipsoid with both axes longer by the height to the surface of that height. Derived: the first
#: guess is off by less than 20 m at 9 km, and each step squares the error relative to the radius.
_HEIGHT_STEPS = 2


@dataclass(frozen=True)
class Ellipsoid:
    """An ellipsoid of revolution about the z axis.

    Attributes
    ----------
    semi_major_m, semi_minor_m : half axes, metres

    Raises
    ------
    ValueError : axes that are not positive numbers
    """

    semi_major_m: float
    semi_minor_m: float

    def __post_init__(self) -> None:
        for name in ("semi_major_m", "semi_minor_m"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0):
                raise ValueError(f"{name} {value}, wanted a length above 0")

    @property
    def eccentricity2(self) -> float:
        """First eccentricity, squared; negative where the body is longer than it is wide."""
        return 1.0 - (self.semi_minor_m / self.semi_major_m) ** 2

    def cartesian(self, lat: ArrayLike, lon: ArrayLike, height_m: ArrayLike) -> Array:
        """Body-fixed coordinates (..., 3) in metres; geodetic latitude and longitude in radians."""
        lat, lon, h = np.broadcast_arrays(lat, lon, height_m)
        s, c = np.sin(lat), np.cos(lat)
        e2 = self.eccentricity2
        N = self.semi_major_m / np.sqrt(1.0 - e2 * s * s)
        return np.stack(
            [(N + h) * c * np.cos(lon), (N + h) * c * np.sin(lon), (N * (1.0 - e2) + h) * s],
            axis=-1,
        )

    def geodetic(self, position_e: ArrayLike) -> Array:
        """``(lat, lon, height)`` in radians and metres, (..., 3), of body-fixed positions (..., 3)."""
        X = np.asarray(position_e, dtype=float)
        sine, cosine, height = self._latitude(np.hypot(X[..., 0], X[..., 1]), X[..., 2])
        return np.stack([np.arctan2(sine, cosine), np.arctan2(X[..., 1], X[..., 0]), height], axis=-1)

    def normal_and_height(self, position_e: ArrayLike) -> tuple[Array, Array]:
        """Outward unit normal (..., 3) of the ellipsoid below positions (..., 3), and their height (...) in metres."""
        X = np.asarray(position_e, dtype=float)
        p = np.hypot(X[..., 0], X[..., 1])
        sine, cosine, height = self._latitude(p, X[..., 2])
        east = cosine / np.where(p > 0, p, 1.0)
        return np.stack([X[..., 0] * east, X[..., 1] * east, sine], axis=-1), height

    def _latitude(self, p: Array, z: Array) -> tuple[Array, Array, Array]:
        """Sine and cosine of the geodetic latitude and the height at distance ``p`` from the axis (Bowring, twice)."""
        a, b, e2 = self.semi_major_m, self.semi_minor_m, self.eccentricity2
        ep2 = e2 / (1.0 - e2)
        sine, cosine = z * a * a, p * b * b  # so that the first parametric latitude is atan2(z a, p b)
        for _ in range(2):
            sb, cb = b * sine, a * cosine  # tan(beta) = b/a tan(lat)
            length = np.sqrt(sb * sb + cb * cb)
            length = np.where(length > 0, length, 1.0)
            sb, cb = sb / length, cb / length
            sine, cosine = z + ep2 * b * (sb * sb * sb), p - e2 * a * (cb * cb * cb)
        length = np.sqrt(sine * sine + cosine * cosine)
        sine, cosine = sine / length, cosine / length
        return sine, cosine, p * cosine + z * sine - a * np.sqrt(1.0 - e2 * sine * sine)

    def intersect(self, origin_e: ArrayLike, direction_e: ArrayLike, height_m: ArrayLike = 0.0) -> Array:
        """Distances (n,) in metres along rays to the surface of constant height, on the side of the origin.

        The nearer root of the quadratic [D 4.36] with both axes longer by the height is the first guess; since a
        surface of constant height is no ellipsoid, Newton's method on the geodetic height follows.

        Parameters
        ----------
        origin_e : (n, 3) metres, above the surface
        direction_e : (n, 3) unit vectors
        height_m : (n,) or one, above the ellipsoid

        Returns
        -------
        (n,) ; NaN where the ray passes by, or looks away
        """
        C, d = np.asarray(origin_e, dtype=float), np.asarray(direction_e, dtype=float)
        h = np.broadcast_to(np.asarray(height_m, dtype=float), C.shape[:-1])
        wide, high = 1.0 / (self.semi_major_m + h) ** 2, 1.0 / (self.semi_minor_m + h) ** 2
        A = (d[..., 0] ** 2 + d[..., 1] ** 2) * wide + d[..., 2] ** 2 * high
        B = (C[..., 0] * d[..., 0] + C[..., 1] * d[..., 1]) * wide + C[..., 2] * d[..., 2] * high
        D = (C[..., 0] ** 2 + C[..., 1] ** 2) * wide + C[..., 2] ** 2 * high - 1.0
        root2 = B * B - A * D
        hit = (root2 >= 0) & (B < 0) & (D > 0)
        s = np.where(hit, D / np.where(hit, -B + np.sqrt(np.maximum(root2, 0.0)), 1.0), np.nan)
        for _ in range(_HEIGHT_STEPS):
            normal, height = self.normal_and_height(C + s[..., None] * d)
            s = s + (h - height) / np.einsum("...i,...i->...", normal, d)
        return s


#: The Earth.
WGS84 = Ellipsoid(earth.SEMI_MAJOR_M, earth.SEMI_MAJOR_M * (1.0 - earth.FLATTENING))
