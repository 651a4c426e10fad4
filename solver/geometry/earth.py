"""The WGS 84 ellipsoid: radii of curvature, normal gravity, rotation, geodetic and Earth-fixed coordinates."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.floating]

SEMI_MAJOR_M = 6378137.0
FLATTENING = 1.0 / 298.257223563
ECCENTRICITY2 = FLATTENING * (2.0 - FLATTENING)
ROTATION_RATE = 7.292115e-5  # rad/s
GM = 3.986004418e14  # m^3/s^2
GRAVITY_EQUATOR = 9.7803253359  # m/s^2
GRAVITY_POLE = 9.8321849378  # m/s^2
SOMIGLIANA_K = (1.0 - FLATTENING) * GRAVITY_POLE / GRAVITY_EQUATOR - 1.0
#: Gravity at a height leans towards the equator, since the plumb line is curved: m/s^2 for each metre of height times
#: the sine of twice the latitude. Heiskanen and Moritz (1967) section 5-6; the closed formula of normal gravity gives
#: the same within 0.3 % up to 20 km.
GRAVITY_LEAN = 8.14e-9


def curvature_radii(lat: ArrayLike) -> tuple[Array, Array]:
    """Radii of curvature in metres: meridian ``R_N`` (north-south) and prime vertical ``R_E``; latitude in radians."""
    w2 = 1.0 - ECCENTRICITY2 * np.sin(lat) ** 2
    R_E = SEMI_MAJOR_M / np.sqrt(w2)
    return np.asarray(R_E * (1.0 - ECCENTRICITY2) / w2), np.asarray(R_E)


def normal_gravity(lat: ArrayLike, height_m: ArrayLike) -> Array:
    """Somigliana's normal gravity (...), continued upward to second order; m/s^2, positive down.

    Parameters
    ----------
    lat, height_m : (...) latitude in radians, height above the ellipsoid
    """
    s2 = np.sin(lat) ** 2
    g0 = GRAVITY_EQUATOR * (1.0 + SOMIGLIANA_K * s2) / np.sqrt(1.0 - ECCENTRICITY2 * s2)
    m = ROTATION_RATE**2 * SEMI_MAJOR_M**3 * (1.0 - FLATTENING) / GM
    h = np.asarray(height_m) / SEMI_MAJOR_M
    return np.asarray(g0 * (1.0 - 2.0 * (1.0 + FLATTENING + m - 2.0 * FLATTENING * s2) * h + 3.0 * h**2))


def gravity_n(lat: ArrayLike, height_m: ArrayLike) -> Array:
    """Normal gravity (..., 3), m/s^2 to the north, east and down of the ellipsoid; latitude in radians."""
    north = -GRAVITY_LEAN * np.asarray(height_m) * np.sin(2.0 * np.asarray(lat))
    return np.stack(np.broadcast_arrays(north, 0.0, normal_gravity(lat, height_m)), axis=-1)


def ecef_from_geodetic(lat: ArrayLike, lon: ArrayLike, height_m: ArrayLike) -> Array:
    """Earth-fixed coordinates (..., 3) in metres; latitude and longitude in radians, ellipsoidal height."""
    lat, lon, h = np.broadcast_arrays(lat, lon, height_m)
    R_E = curvature_radii(lat)[1]
    p = (R_E + h) * np.cos(lat)
    z = (R_E * (1.0 - ECCENTRICITY2) + h) * np.sin(lat)
    return np.stack([p * np.cos(lon), p * np.sin(lon), z], axis=-1)


def geodetic_from_ecef(position_e: ArrayLike) -> Array:
    """``(lat, lon, height)`` in radians and metres, (..., 3), of Earth-fixed positions (Bowring, refined twice)."""
    X = np.asarray(position_e, dtype=float)
    p = np.hypot(X[..., 0], X[..., 1])
    z = X[..., 2]
    b = SEMI_MAJOR_M * (1.0 - FLATTENING)
    ep2 = ECCENTRICITY2 / (1.0 - ECCENTRICITY2)
    beta = np.arctan2(z * SEMI_MAJOR_M, p * b)
    lat = np.arctan2(z + ep2 * b * np.sin(beta) ** 3, p - ECCENTRICITY2 * SEMI_MAJOR_M * np.cos(beta) ** 3)
    for _ in range(2):
        beta = np.arctan2((1.0 - FLATTENING) * np.sin(lat), np.cos(lat))
        lat = np.arctan2(z + ep2 * b * np.sin(beta) ** 3, p - ECCENTRICITY2 * SEMI_MAJOR_M * np.cos(beta) ** 3)
    R_E = curvature_radii(lat)[1]
    s, c = np.sin(lat), np.cos(lat)
    height = p * c + z * s - R_E * (1.0 - ECCENTRICITY2 * s * s)
    return np.stack([lat, np.arctan2(X[..., 1], X[..., 0]), height], axis=-1)


def R_en(lat: ArrayLike, lon: ArrayLike) -> Array:
    """Rotation north-east-down to Earth-fixed, (..., 3, 3); radians."""
    lat, lon = np.broadcast_arrays(lat, lon)
    sl, cl, so, co = np.sin(lat), np.cos(lat), np.sin(lon), np.cos(lon)
    R = np.empty((*np.shape(lat), 3, 3))
    R[..., 0, 0], R[..., 0, 1], R[..., 0, 2] = -sl * co, -so, -cl * co
    R[..., 1, 0], R[..., 1, 1], R[..., 1, 2] = -sl * so, co, -cl * so
    R[..., 2, 0], R[..., 2, 1], R[..., 2, 2] = cl, 0.0, -sl
    return R
