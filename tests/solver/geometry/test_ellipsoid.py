"""Geodetic coordinates against PROJ, and where rays meet surfaces of constant height."""

from __future__ import annotations

import numpy as np
import pytest
from pyproj import Transformer

from triline.solver.geometry.ellipsoid import WGS84, Ellipsoid


def places(n=400, seed=1):
    rng = np.random.default_rng(seed)
    lat = np.concatenate([[-np.pi / 2, np.pi / 2, 0.0], np.arcsin(rng.uniform(-1, 1, n))])
    lon = np.concatenate([[0.0, 1.0, np.pi], rng.uniform(-np.pi, np.pi, n)])
    return lat, lon, np.concatenate([[0.0, 9000.0, -400.0], rng.uniform(-500.0, 9000.0, n)])


def test_geodetic_coordinates_are_those_of_proj():
    lat, lon, h = places()
    X = WGS84.cartesian(lat, lon, h)
    to_ground = Transformer.from_crs("EPSG:4978", "EPSG:4979", always_xy=True)
    x, y, z = to_ground.transform(np.degrees(lon), np.degrees(lat), h, direction="INVERSE")
    np.testing.assert_allclose(X, np.stack([x, y, z], axis=1), atol=1e-7)


@pytest.mark.parametrize("body", [WGS84, Ellipsoid(3396190.0, 3376200.0), Ellipsoid(1737400.0, 1737400.0)])
def test_there_and_back_on_other_planets(body):
    lat, lon, h = places()
    back = body.geodetic(body.cartesian(lat, lon, h))
    np.testing.assert_allclose(back[:, 0], lat, atol=1e-13)
    np.testing.assert_allclose(back[:, 2], h, atol=1e-7)
    normal, height = body.normal_and_height(body.cartesian(lat, lon, h))
    np.testing.assert_allclose(normal[:, 2], np.sin(lat), atol=1e-13)
    np.testing.assert_allclose(height, h, atol=1e-7)


@pytest.mark.parametrize("height", [-400.0, 0.0, 9000.0])
def test_rays_end_at_their_height(height):
    lat, lon, _ = places()
    ground = WGS84.cartesian(lat, lon, height)
    satellite = WGS84.cartesian(lat + 0.02, lon - 0.05, 7e5)
    d = ground - satellite
    length = np.linalg.norm(d, axis=1)
    s = WGS84.intersect(satellite, d / length[:, None], height)
    seen = np.einsum("ni,ni->n", WGS84.normal_and_height(ground)[0], d) < 0
    assert seen.all()
    np.testing.assert_allclose(s, length, atol=1e-5)


def test_rays_that_pass_by_or_look_away_give_no_number():
    origin = np.array([[7.1e6, 0.0, 0.0]] * 4)
    d = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [-0.2, 0.98, 0.0], [-1.0, 0.0, 0.0]])
    s = WGS84.intersect(origin, d / np.linalg.norm(d, axis=1, keepdims=True), 0.0)
    assert np.isnan(s[:3]).all() and s[3] == pytest.approx(7.1e6 - 6378137.0, abs=1e-6)
    assert np.isnan(WGS84.intersect(origin[:1], d[3:], 8e5)).all(), "a surface above the satellite"


def test_axes_are_lengths():
    with pytest.raises(ValueError, match="semi_minor_m 0"):
        Ellipsoid(1.0, 0.0)
