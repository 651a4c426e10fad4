"""Refraction: a quadrature of its own, published tables, formulas of aerial photographs, the way there and back."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import quad, solve_ivp
from scipy.interpolate import interp1d

from triline.solver.location.refraction import STANDARD, Atmosphere, Refraction
from triline.solver.simulation.orbital_scene import ORBITAL_SENSORS, overpass

R = 6.371e6
ZENITH_DEG = np.array([10.0, 20.0, 30.0, 45.0, 60.0, 70.0])


@pytest.fixture(scope="module")
def index():
    """Refractive index at a height: hydrostatic equilibrium integrated over the standard's table of temperatures."""
    km = [-1.0, 0.0, 11.019, 20.063, 32.162, 47.350, 51.413, 71.802, 86.0]  # geometric heights as published
    kelvin = [294.651, 288.15, 216.65, 216.65, 228.65, 270.65, 270.65, 214.65, 186.946]

    def temperature(h):
        return np.interp(1e-3 * h, km, kelvin)

    def fall(h, _):
        return [-9.80665 * (R / (R + h)) ** 2 * 0.0289644 / 8.31432 / temperature(h)]

    path = solve_ivp(fall, (0.0, 86_000.0), [np.log(1013.25)], rtol=1e-10, atol=1e-12, max_step=200.0)
    pressure = interp1d(path.t, path.y[0], kind="cubic")
    # Barrell and Sears at 0.55 micrometres: 277.8e-6 at 15 deg C
    return lambda h: 1.0 + 277.8e-6 * np.exp(pressure(h)) / 1013.25 * 288.15 / temperature(h)


def test_independent_quadrature(index):
    for zenith_deg, shift in zip(ZENITH_DEG, Refraction().shift(np.radians(ZENITH_DEG), 0.0), strict=True):
        k = R * np.sin(np.radians(zenith_deg))

        def slope(h, k=k):
            r = R + h
            return k / r * (1.0 / np.sqrt(r * r - k * k) - 1.0 / np.sqrt((index(h) * r) ** 2 - k * k))

        expected = R * sum(quad(slope, a, b, epsrel=1e-6)[0] for a, b in ((0, 5e3), (5e3, 2e4), (2e4, 8.5e4)))
        assert shift == pytest.approx(expected, rel=0.005), zenith_deg


def test_published_tables():
    published = np.array([0.55, 1.22, 2.22, 5.46, 17.8])  # SDP toolkit
    np.testing.assert_allclose(Refraction().shift(np.radians(ZENITH_DEG[:5]), 0.0), published, rtol=0.30)
    own = np.array([0.43, 0.97, 1.80, 4.67, 16.1])  # design/satellites.md
    np.testing.assert_allclose(Refraction().shift(np.radians(ZENITH_DEG[:5]), 0.0), own, rtol=0.01)


@pytest.mark.parametrize(("sensor_km", "ground_km"), [(1.0, 0.0), (3.0, 0.0), (3.0, 1.0), (6.0, 0.5), (8.0, 2.0)])
def test_closed_formula_of_aerial_photographs(sensor_km, ground_km):
    # Saastamoinen 1972: a ray is off by K tan(z) at the camera, up to 9 km
    K = 13e-6 * (sensor_km - ground_km) * (1.0 - 0.02 * (2.0 * sensor_km + ground_km))
    z = np.radians([5.0, 20.0, 32.0])
    expected = K * np.tan(z) / np.cos(z) ** 2 * 1e3 * (sensor_km - ground_km)
    shift = Refraction().shift(z, 1e3 * ground_km, 1e3 * sensor_km)
    np.testing.assert_allclose(shift, expected, rtol=0.03)


def test_a_stated_atmosphere():
    z = np.radians([45.0])
    standard = Refraction().shift(z, 0.0)
    # the same mass of air bends nearly the same way whatever its temperature; more air bends more
    assert Refraction(Atmosphere(temperature_k=310.0)).shift(z, 0.0) == pytest.approx(standard, rel=0.01)
    more = Refraction(Atmosphere(pressure_hpa=1050.0)).shift(z, 0.0)
    assert more == pytest.approx(standard * 1050 / 1013.25, rel=1e-4)
    high = Atmosphere(temperature_k=275.154, pressure_hpa=794.95, height_m=2000.0)  # the standard at 2 km
    assert Refraction(high).shift(z, 0.0) == pytest.approx(standard, rel=1e-4)
    assert float(STANDARD.refractivity(0.0)) == pytest.approx(277.8e-6, rel=1e-3)


@pytest.mark.parametrize("name", ["temperature_k", "pressure_hpa", "vapour_hpa", "height_m", "wavelength_um"])
def test_air_that_is_none(name):
    with pytest.raises(ValueError, match=f"{name} -5000, wanted"):
        Atmosphere(**{name: -5000.0})


def test_no_shift_above_the_air_or_straight_down():
    bent = Refraction()
    assert bent.shift([0.0], 0.0)[0] == 0.0
    assert bent.shift([1.0], 90_000.0)[0] == pytest.approx(0.0, abs=1e-6)
    assert bent.shift([1.0], 1000.0, 1000.0)[0] == pytest.approx(0.0, abs=1e-6)


def test_round_trip_at_sixty_degrees_and_more():
    scene = overpass(ORBITAL_SENSORS["misr"], 36.0, 139.6)
    line, sample = (a.ravel() for a in np.meshgrid(np.linspace(0, 511, 9), np.linspace(0, 1503, 9)))
    for lens, shift_m in (("Cf", 15.0), ("Da", 52.0), ("An", 0.39)):
        straight = scene.sensors[lens]
        bent = straight.with_refraction(Refraction())
        height = np.linspace(0.0, 1000.0, len(line))
        pixel = bent.inverse(*bent.direct(line, sample, height).T)
        assert np.abs(pixel - np.stack([line, sample], axis=1)).max() < 1e-4
        P, Q = bent.ground(line, sample, height), straight.ground(line, sample, height)
        foot = bent.pose(line).position_e
        assert np.linalg.norm(P - Q, axis=1).mean() == pytest.approx(shift_m, rel=0.2)
        assert (np.linalg.norm(P - foot, axis=1) < np.linalg.norm(Q - foot, axis=1)).all()
        assert bent.ellipsoid.geodetic(P)[:, 2] == pytest.approx(height, abs=1e-6)
