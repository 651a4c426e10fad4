"""GNSS fixes given in the local frame, one at a time, as data of the navigator."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from ..geometry.frames import LocalFrame
from .inertial_data import GnssData


def local_fix(
    frame: LocalFrame,
    time_s: float,
    antenna_l: ArrayLike,
    covariance: ArrayLike,
    velocity_l: ArrayLike | None = None,
    velocity_covariance: ArrayLike | None = None,
) -> GnssData:
    """One fix from a position (3,) and its covariance (3, 3) in the local frame, on request with a velocity.

    Correlations between north, east and down are left out.

    Raises
    ------
    ValueError : values that are not finite, or a covariance that is not positive definite
    """
    position, P = np.asarray(antenna_l, dtype=float), np.asarray(covariance, dtype=float)
    if not (np.isfinite(time_s) and np.isfinite(position).all() and np.isfinite(P).all()):
        raise ValueError(f"fix at {time_s} s is not finite")
    if np.linalg.eigvalsh(0.5 * (P + P.T)).min() <= 0.0:
        raise ValueError(f"covariance of the fix at {time_s} s is not positive definite")
    lat, lon, h = frame.to_geodetic(position).tolist()
    R_ln = frame.R_ln_at(lat, lon)
    sigma = np.sqrt(np.diag(R_ln.T @ P @ R_ln))[None]
    fix = GnssData(np.array([time_s]), np.radians([lat]), np.radians([lon]), np.array([h]), np.maximum(sigma, 1e-4))
    if velocity_l is None or velocity_covariance is None:
        return fix
    v = (R_ln.T @ np.asarray(velocity_l, dtype=float))[None]
    s = np.sqrt(np.diag(R_ln.T @ np.asarray(velocity_covariance, dtype=float) @ R_ln))[None]
    return replace(fix, velocity_n=v, sigma_velocity_n=s)


def stacked(fixes: list[GnssData]) -> GnssData:
    """Several fixes in one; velocities only where all have one."""
    names = ("time_s", "lat", "lon", "height_m", "sigma_ned_m")
    out = GnssData(*(np.concatenate([getattr(f, name) for f in fixes]) for name in names))
    velocity = [f.velocity_n for f in fixes if f.velocity_n is not None]
    sigma = [f.sigma_velocity_n for f in fixes if f.sigma_velocity_n is not None]
    if len(velocity) == len(fixes) == len(sigma):
        out = replace(out, velocity_n=np.concatenate(velocity), sigma_velocity_n=np.concatenate(sigma))
    return out
