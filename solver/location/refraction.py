"""Refraction: how far the air moves the point at which a line of sight reaches the ground.

A straight ray reaches the ground too far from the point below the sensor, because light is bent towards the vertical
on its way down. Snell's law on spherical shells keeps ``n r sin z = k`` along a ray [D 4.38-4.41]; so within a shell of
refractive index ``n`` between the radii ``r0`` and ``r1`` the ray passes the angle ``acos(k / (n r1)) - acos(k / (n
r0))`` at the centre of the Earth. The sum over the shells, less the same for a straight ray, times the radius, is the
shift. It holds for satellites (shells up to the top of the air) and aircraft (shells below the sensor).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..geometry.ellipsoid import WGS84, Ellipsoid

if TYPE_CHECKING:
    from scipy.interpolate import CubicHermiteSpline


Array = NDArray[np.floating]

#: US Standard Atmosphere 1976: geopotential height of the layers, km; temperature at the first, K; gradients, K/km.
#: Definition.
_BASES_KM = np.array([0.0, 11.0, 20.0, 32.0, 47.0, 51.0, 71.0, 84.852])
_GROUND_K = 288.15
_GRADIENTS_K_KM = np.array([-6.5, 0.0, 1.0, 2.8, 0.0, -2.8, -2.0])
_GROUND_HPA = 1013.25
#: Gravity times molar mass over the gas constant, K/km, and the radius of geopotential heights, km. Definition.
_HYDROSTATIC_K_KM, _GEOPOTENTIAL_KM = 34.163195, 6356.766
#: Height in which water vapour falls to 1/e, m; the usual mean. It changes the shift by a thousandth.
_VAPOUR_SCALE_M = 2000.0
#: Where the air ends, m, and where its table begins: below the lowest land.
TOP_M, _LOWEST_M = 85_000.0, -1000.0
#: Step of the table of the air, m. Derived: the cubic between its nodes is off by 1e-9 of the shift.
_STEP_M = 250.0
#: Shells between the ground and the top, thin ones first. Derived: each has the mean index of the air in it, and the
#: sum is off by 1e-4 of the shift at 70 degrees, and by less at steeper angles.
_SHELLS = 32
#: Steps of the fixed point that turns the shift round. Derived: each leaves 1e-4 of the error of the one before,
#: of 50 m at 70 degrees less than a micrometre.
_TURNS = 2


@dataclass(frozen=True)
class Atmosphere:
    """Standard atmosphere scaled to what was measured at one height.

    Temperatures keep the ratio to those of the US Standard Atmosphere 1976; the pressure is in equilibrium with them,
    so that the mass of the air above a height is given by the pressure there. Vapour falls off exponentially.

    Attributes
    ----------
    temperature_k, pressure_hpa, vapour_hpa : at ``height_m``; the defaults are those of the standard atmosphere
    height_m : above the sea; the height above the ellipsoid is good enough
    wavelength_um : of the light

    Raises
    ------
    ValueError : values that no air on Earth has
    """

    temperature_k: float = _GROUND_K
    pressure_hpa: float = _GROUND_HPA
    vapour_hpa: float = 0.0
    height_m: float = 0.0
    wavelength_um: float = 0.55

    def __post_init__(self) -> None:
        limits = {
            "temperature_k": (180.0, 340.0), "pressure_hpa": (200.0, 1100.0), "vapour_hpa": (0.0, 100.0),
            "height_m": (_LOWEST_M, 10_000.0), "wavelength_um": (0.3, 3.0),
        }  # fmt: skip
        for name, (low, high) in limits.items():
            value = getattr(self, name)
            if not low <= value <= high:
                raise ValueError(f"atmosphere: {name} {value:g}, wanted {low:g} to {high:g}")

    def refractivity(self, height_m: ArrayLike) -> Array:
        """Refractive index less one at heights (...) in metres, after the resolution of the IAG of 1999."""
        h = np.asarray(height_m, dtype=float)
        standard, logarithm = _standard(h)
        here, logarithm_here = _standard(np.asarray(self.height_m))
        ratio = self.temperature_k / here
        pressure = self.pressure_hpa * np.exp((logarithm - logarithm_here) / ratio)
        vapour = self.vapour_hpa * np.exp(-(h - self.height_m) / _VAPOUR_SCALE_M)
        wave2 = self.wavelength_um**-2
        dry = (287.6155 + 1.62887 * wave2 + 0.01360 * wave2**2) * 273.15 / _GROUND_HPA
        return 1e-6 * (dry * pressure - 11.27 * vapour) / (standard * ratio)


def _standard(height_m: Array) -> tuple[Array, Array]:
    """Temperature in K and logarithm of the pressure over that at the ground, of the standard atmosphere."""
    km = 1e-3 * height_m
    geopotential = np.minimum(_GEOPOTENTIAL_KM * km / (_GEOPOTENTIAL_KM + km), _BASES_KM[-1])
    base_k = _GROUND_K + np.concatenate([[0.0], np.cumsum(_GRADIENTS_K_KM * np.diff(_BASES_KM))])[:-1]
    fall = np.zeros(len(base_k) + 1)
    for k, gradient in enumerate(_GRADIENTS_K_KM):
        fall[k + 1] = fall[k] + _fall(base_k[k], gradient, _BASES_KM[k + 1] - _BASES_KM[k])
    k = np.clip(np.searchsorted(_BASES_KM, geopotential, side="right") - 1, 0, len(base_k) - 1)
    rise = geopotential - _BASES_KM[k]
    return base_k[k] + _GRADIENTS_K_KM[k] * rise, fall[k] + _fall(base_k[k], _GRADIENTS_K_KM[k], rise)


def _fall(base_k: ArrayLike, gradient: ArrayLike, rise_km: ArrayLike) -> Array:
    """Change of the logarithm of the pressure from the base of a layer to a height above it."""
    base, gradient, rise = np.broadcast_arrays(base_k, gradient, rise_km)
    safe = np.where(gradient == 0, 1.0, gradient)
    sloped = -np.log1p(safe * rise / base) / safe
    return _HYDROSTATIC_K_KM * np.where(gradient == 0, -rise / base, sloped)


#: The standard atmosphere.
STANDARD = Atmosphere()


@dataclass(frozen=True)
class Refraction:
    """What the air does to lines of sight.

    Attributes
    ----------
    atmosphere : the air
    ellipsoid : heights are above it
    """

    atmosphere: Atmosphere = STANDARD
    ellipsoid: Ellipsoid = WGS84

    @cached_property
    def _content(self) -> CubicHermiteSpline:
        """Integral of the refractivity from the lowest height to a height, m."""
        from scipy.interpolate import CubicHermiteSpline

        h = np.arange(_LOWEST_M, TOP_M + 0.5 * _STEP_M, _STEP_M)
        N = self.atmosphere.refractivity(h)
        between = self.atmosphere.refractivity(0.5 * (h[1:] + h[:-1]))
        simpson = _STEP_M / 6.0 * (N[1:] + 4.0 * between + N[:-1])
        return CubicHermiteSpline(h, np.concatenate([[0.0], np.cumsum(simpson)]), N)

    def shift(
        self,
        zenith_rad: ArrayLike,
        height_m: ArrayLike,
        sensor_height_m: ArrayLike = np.inf,
        radius_m: ArrayLike = 6.371e6,
    ) -> Array:
        """How much nearer to the sensor's foot point a bent ray reaches the ground than a straight one.

        Parameters
        ----------
        zenith_rad : (n,) zenith angle of the straight ray where it reaches the ground, below 90 degrees
        height_m : (n,) or one, of the ground; up to 9 km
        sensor_height_m : (n,) or one; infinite for satellites
        radius_m : (n,) or one, of the Earth

        Returns
        -------
        (n,) metres along the ground; zero above the air
        """
        z, h, H, R = (
            np.asarray(a, dtype=float)
            for a in np.broadcast_arrays(*map(np.atleast_1d, (zenith_rad, height_m, sensor_height_m, radius_m)))
        )
        air = self._content
        h = np.clip(h, _LOWEST_M, TOP_M)
        top = np.clip(H, h, TOP_M)
        at_sensor = np.where(H < TOP_M, air(top, nu=1), 0.0)
        bounds = h + (top - h) * (np.arange(_SHELLS + 1) ** 2 / _SHELLS**2).reshape((-1,) + (1,) * h.ndim)
        thick = np.diff(bounds, axis=0)
        some = thick > 0
        mean = np.where(some, np.diff(air(bounds), axis=0) / np.where(some, thick, 1.0), at_sensor)
        r = R + bounds
        impact = (R + h) * np.sin(z)  # of the straight ray
        bent = impact * (1.0 + at_sensor) / (1.0 + mean)
        passed = np.arccos(np.minimum(bent / r[1:], 1.0)) - np.arccos(np.minimum(bent / r[:-1], 1.0))
        straight = np.arccos(np.minimum(impact / r[1:], 1.0)) - np.arccos(np.minimum(impact / r[:-1], 1.0))
        return (R + h) * (straight - passed).sum(axis=0)

    def true_ground(self, straight_e: Array, centre_e: Array) -> Array:
        """Where bent rays reach the ground, whose straight ones reach it at other points of the same height.

        Parameters
        ----------
        straight_e : (n, 3) Earth-fixed, metres; NaN where there is none
        centre_e : (n, 3) perspective centres

        Returns
        -------
        (n, 3) Earth-fixed, metres
        """
        normal, height = self.ellipsoid.normal_and_height(straight_e)
        towards = centre_e - straight_e
        towards /= np.linalg.norm(towards, axis=-1, keepdims=True)
        cosine = np.einsum("...i,...i->...", normal, towards)
        level = towards - cosine[..., None] * normal
        sine = np.linalg.norm(level, axis=-1)
        e2 = self.ellipsoid.eccentricity2
        gaussian = self.ellipsoid.semi_minor_m / (1.0 - e2 * normal[..., 2] ** 2)
        above = self.ellipsoid.normal_and_height(centre_e)[1]
        shift = self.shift(np.arctan2(sine, cosine), height, above, gaussian)
        there = straight_e + level * (shift / np.where(sine > 0, sine, 1.0))[..., None]
        normal, now = self.ellipsoid.normal_and_height(there)
        return there + (height - now)[..., None] * normal

    def straight_ground(self, true_e: Array, centre_e: Array) -> Array:
        """The inverse of `true_ground`: points (n, 3) towards which a straight ray must look to meet points (n, 3)."""
        straight = true_e
        for _ in range(_TURNS):
            straight = straight + (true_e - self.true_ground(straight, centre_e))
        return straight
