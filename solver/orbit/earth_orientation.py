"""Earth-fixed and inertial frames: IAU 2006/2000A precession and nutation, Earth rotation angle, pole (ERFA).

``R_ei = W(x, y, s') R3(ERA) Q(X, Y, s)`` (IERS Conventions 2010, chapter 5), with UT1 and the pole from a table. The
observed corrections of the celestial pole (below 1 cm on the ground) are left out, as astropy does.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import erfa
import numpy as np
from numpy.typing import ArrayLike, NDArray

from .time_scales import iso_utc, julian_dates, leap_seconds, tai_from_day

Array = NDArray[np.floating]

#: Distance of the nodes of X, Y, s, days, and degree of the spline through them. Derived: the shortest terms of
#: nutation have periods of some days; so the spline is 3e-9 m off on the ground, with 1 day 5e-8 m.
_NODE_DAYS, _DEGREE = 0.5, 9
#: Nodes beyond the epochs on each side, so that the spline is good at their ends, too.
_EXTRA_NODES = 10
#: Growth of the error of UT1 where the table has ended, seconds a day; tuned to the spread of its changes in a year.
UT1_DRIFT_S_PER_DAY = 1.0e-3
_EQUATOR_SPEED_M_S = 465.1
_TT_MINUS_TAI_DAYS = 32.184 / 86400.0


@dataclass(frozen=True)
class EarthOrientationTable:
    """Rotation and pole of the Earth at midnights of UTC.

    Attributes
    ----------
    mjd : (n,) modified Julian days, strictly increasing
    ut1_utc_s : (n,) seconds
    pole_x, pole_y : (n,) radians
    predicted_from_mjd : from this day on the values are predictions

    Raises
    ------
    ValueError : shapes that do not match, days that do not increase, values that are no numbers
    """

    mjd: Array
    ut1_utc_s: Array
    pole_x: Array
    pole_y: Array
    predicted_from_mjd: float = np.inf

    def __post_init__(self) -> None:
        n = len(self.mjd)
        if n < 2 or any(len(a) != n for a in (self.ut1_utc_s, self.pole_x, self.pole_y)):
            raise ValueError(
                "Earth orientation: wanted two days or more, and as many values of UT1-UTC and of the pole"
            )
        if not all(np.isfinite(a).all() for a in (self.mjd, self.ut1_utc_s, self.pole_x, self.pole_y)):
            raise ValueError("Earth orientation: a day, UT1-UTC or the pole is no number")
        if not (np.diff(self.mjd) > 0).all():
            raise ValueError("Earth orientation: days must increase")

    def error_beyond_m(self, mjd: float) -> float:
        """Error on the ground, metres, that a date after the end of the table may cause; 0 inside."""
        return max(0.0, float(mjd) - float(self.mjd[-1])) * UT1_DRIFT_S_PER_DAY * _EQUATOR_SPEED_M_S


class EarthOrientation:
    """Rotation between ITRF and GCRS about a reference instant.

    After the end of the table its last values stand; `warning` tells what that may cost.

    Parameters
    ----------
    table : rotation and pole
    reference_ns : instant of time zero (`time_scales`)
    """

    def __init__(self, table: EarthOrientationTable, reference_ns: int):
        self.table, self.reference_ns = table, int(reference_ns)
        # to the nanosecond, as instants are; a table has 20 000 days
        leap_ns = np.round(leap_seconds(np.asarray(table.mjd).astype(np.int64)) * 1e9)
        self._ut1_tai = np.asarray(table.ut1_utc_s, dtype=float) - leap_ns * 1e-9

    def R_ie(self, time_s: ArrayLike) -> Array:
        """Rotations (n, 3, 3) from ITRF to GCRS at times (n,) in seconds from the reference.

        Seconds of a float tell an instant to 1e-7 s some decades from the reference, which is 5e-5 m on the equator;
        use `R_ie_at` where that counts.

        Raises
        ------
        ValueError : a time before the table
        """
        return self._rotation(*julian_dates(self.reference_ns, np.atleast_1d(time_s), "TAI"))

    def R_ie_at(self, tai_ns: ArrayLike) -> Array:
        """Rotations (n, 3, 3) from ITRF to GCRS at instants (n,), integer nanoseconds of TAI (`time_scales`).

        Raises
        ------
        ValueError : an instant before the table
        """
        day, ns = np.divmod(np.atleast_1d(np.asarray(tai_ns, dtype=np.int64)), 86_400_000_000_000)
        return self._rotation(2440587.5 + day, ns / 86.4e12)

    def _rotation(self, day: float | Array, tai: Array) -> Array:
        """Rotations (n, 3, 3) at Julian dates ``day + tai`` of TAI."""
        with warnings.catch_warnings():  # a year that ERFA calls dubious has the last known number of leap seconds
            warnings.simplefilter("ignore", erfa.ErfaWarning)
            utc1, utc2 = erfa.taiutc(np.broadcast_to(day, tai.shape), tai)
        mjd = (utc1 - 2400000.5) + utc2
        if len(tai) and mjd.min() < self.table.mjd[0]:
            k, first = int(np.argmin(mjd)), iso_utc(tai_from_day(int(self.table.mjd[0]), 0), 0)
            when = iso_utc(tai_from_day(int(mjd[k] // 1), round(float(mjd[k] % 1) * 86_400e9)), 0)
            raise ValueError(f"{when} lies before the Earth orientation table, which begins {first}")
        ut1_tai, x, y = (
            np.interp(mjd, self.table.mjd, c) for c in (self._ut1_tai, self.table.pole_x, self.table.pole_y)
        )
        tt = tai + _TT_MINUS_TAI_DAYS
        Q = erfa.c2ixys(*_celestial_pole(day, tt))
        angle = erfa.era00(day, tai + ut1_tai / 86400.0)
        W = erfa.pom00(x, y, erfa.sp00(day, tt))
        c, sn = np.cos(angle)[:, None], np.sin(angle)[:, None]
        turned = np.stack([c * Q[:, 0] + sn * Q[:, 1], c * Q[:, 1] - sn * Q[:, 0], Q[:, 2]], axis=1)
        return np.swapaxes(W @ turned, -1, -2)

    def warning(self, first_s: float, last_s: float) -> str:
        """What is to be said of the accuracy between two times; empty if nothing."""
        day, tai = julian_dates(self.reference_ns, np.array([first_s, last_s]), "TAI")
        mjd = day - 2400000.5 + float(tai.max())
        end = iso_utc(tai_from_day(int(self.table.mjd[-1]), 0), 0)[:10]
        if mjd > self.table.mjd[-1]:
            error = self.table.error_beyond_m(mjd)
            when = iso_utc(self.reference_ns + round(last_s * 1e9), 0)
            return f"{when} lies after the Earth orientation table, which ends {end}: up to {error:.1f} m on the ground"
        if mjd > self.table.predicted_from_mjd:
            return f"Earth orientation of {iso_utc(self.reference_ns, 0)} is a prediction"
        return ""


def R_bias() -> Array:
    """Frame bias (3, 3) from GCRS to the mean equator and equinox of J2000 (EME2000), IAU 2006."""
    return np.asarray(erfa.bp06(2451545.0, 0.0)[0])


def _celestial_pole(day: float | Array, tt: Array) -> tuple[Array, Array, Array]:
    """X, Y and s of the celestial intermediate pole at Julian dates ``day + tt`` of TT; many by a spline."""
    from scipy.interpolate import make_interp_spline

    if not len(tt):
        return tt, tt, tt
    first = float(np.min(day))
    x = np.asarray(day) - first + tt
    low, high = float(x.min()), float(x.max())
    n = int(np.ceil((high - low) / _NODE_DAYS)) + 1 + 2 * _EXTRA_NODES
    if n >= len(tt):
        return erfa.xys06a(day, tt)
    nodes = low + (np.arange(n) - _EXTRA_NODES) * _NODE_DAYS
    return tuple(make_interp_spline(nodes, np.stack(erfa.xys06a(first, nodes), axis=1), k=_DEGREE)(x).T)
