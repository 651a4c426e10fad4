"""Refraction taken off airborne images: against the closed formula of aerial photogrammetry."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from adjustment_networks import simulate

from triline.solver.adjustment.straightened import straightened
from triline.solver.geometry.frames import LocalFrame
from triline.solver.location.refraction import Atmosphere, Refraction
from triline.solver.models.dgr import DgrOptions

FRAME = LocalFrame(47.0, 8.0, 0.0)


def displacement(r_mm, focal_length_mm, flown_m, ground_m):
    """Outward displacement in a level image, mm: ``K (r + r^3 / f^2)`` with K of the ARDC model atmosphere (Manual of
    Photogrammetry; heights in km)."""
    H, h = 1e-3 * flown_m, 1e-3 * ground_m
    above, below = (2410.0 * x / (x**2 - 6.0 * x + 250.0) for x in (H, h))
    return 1e-6 * (above - below * h / H) * (r_mm + r_mm**3 / focal_length_mm**2)


def of_densities(r_mm, focal_length_mm, flown_m, ground_m):
    """The same for a low flight: the index goes with the density, 1 + 2.77e-4 at the sea; K is its mean below the
    aircraft less its value there. Densities of the US Standard Atmosphere 1976 (kg/m^3) at 0, 1 and 2 km."""
    low, middle, high = 1.2250, 1.1117, 1.0066
    thickness = (flown_m - ground_m) / 2000.0  # the index falls nearly as a straight line
    k = 2.77e-4 / low * ((low + 4.0 * middle + high) / 6.0 - high) * thickness
    return k * (r_mm + r_mm**3 / focal_length_mm**2)


@pytest.mark.parametrize(
    ("flown_m", "formula"), [(2000.0, of_densities), (5000.0, displacement), (8000.0, displacement)]
)
def test_against_closed_formulas(flown_m, formula):
    network = simulate(2, DgrOptions(), height_m=flown_m, length_m=2.0 * flown_m).network
    rays = network.rays
    change = straightened(network, FRAME, Refraction()).rays.xy_mm - rays.xy_mm
    r = np.linalg.norm(rays.xy_mm, axis=1)
    inward = -np.einsum("ni,ni->n", change, rays.xy_mm) / r
    expected = formula(r, rays.focal_length_mm, rays.position_l[:, 2], network.approximate_l[rays.point, 2])
    outside = r > 15.0  # the images are level to some tenths of a degree only
    np.testing.assert_allclose(inward[outside], expected[outside], rtol=0.1)  # that of 1959 is a fit to some per cent
    beside = np.linalg.norm(change + inward[:, None] * rays.xy_mm / r[:, None], axis=1)
    assert (beside[outside] < 0.1 * expected[outside]).all()


def test_half_the_air_bends_half_and_points_without_a_place_stay():
    network = simulate(2, DgrOptions()).network
    by = [
        np.abs(straightened(network, FRAME, Refraction(air)).rays.xy_mm - network.rays.xy_mm).max()
        for air in (Atmosphere(), Atmosphere(pressure_hpa=500.0))
    ]
    assert 0.3 * by[0] < by[1] < 0.7 * by[0]
    blind = replace(network, approximate_l=np.full_like(network.approximate_l, np.nan))
    np.testing.assert_array_equal(straightened(blind, FRAME, Refraction()).rays.xy_mm, network.rays.xy_mm)
