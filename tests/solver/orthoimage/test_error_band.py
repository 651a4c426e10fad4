"""Sigmas of an orthoimage against errors that are drawn; rays that the air bends, on relief."""

from __future__ import annotations

import numpy as np
import pytest

from triline.solver.camera.line_camera import three_line_camera
from triline.solver.geometry.frames import LocalFrame
from triline.solver.geometry.rotation import matrix_from_angles
from triline.solver.location.refraction import STANDARD, Atmosphere, Refraction
from triline.solver.orthoimage.error_band import GroundErrors, sigmas_of_lines
from triline.solver.orthoimage.ground_grid import GroundGrid
from triline.solver.orthoimage.mosaic import Mosaic
from triline.solver.orthoimage.strip import StripRectifier, rays_of
from triline.solver.orthoimage.surface import Ellipsoid, HeightField, Plane, UnderAir

FRAME = LocalFrame(48.93, 8.96, 300.0)
CAMERA = three_line_camera("test", 60.0, 500, 0.05, {"F": 20.0, "N": 0.0, "B": -16.0})


def _slope(east, north, step=10.0, reach=2500.0):
    n = round(2 * reach / step) + 1
    x = -reach + step * np.arange(n)
    X, Y = np.meshgrid(x, x)
    return HeightField(-reach, -reach, step, 40.0 + east * X + north * Y)


def _covariance(rng):
    """Position and attitude with strong correlations, as adjustments leave them."""
    L = rng.standard_normal((6, 6)) * np.array([0.3, 0.3, 0.2, 2e-4, 2e-4, 3e-4])[:, None]
    return L @ L.T


@pytest.mark.parametrize("line", [0, 1, 2])
def test_sigmas_are_those_of_drawn_errors(line):
    """20 000 draws of orientation, measurement and height: their scatter is the sigma, to 3 %."""
    rng = np.random.default_rng(line)
    angles, centre = np.array([0.02, -0.03, 0.7]), np.array([30.0, -20.0, 1500.0])
    rays, Q = rays_of(CAMERA, line), _covariance(rng)
    errors = GroundErrors(0.01, 0.8)
    surface = _slope(0.25, -0.15)
    k = [3, len(rays.sample) // 2, len(rays.sample) - 4]
    R = matrix_from_angles(*angles)
    point, met = surface.meet(centre, rays.ray_c[k] @ R.T)
    assert met.all()
    slope = surface.slope(point[None])
    assert slope == pytest.approx(np.broadcast_to([0.25, -0.15], slope.shape), abs=1e-9)
    sigma = sigmas_of_lines(centre[None], R[None], Q[None], rays.ray_c[k], point[None], slope, errors)[0]

    n = 20_000
    e = rng.multivariate_normal(np.zeros(6), Q, n)
    turned = matrix_from_angles(*(angles + e[:, 3:]).T)
    ray = rays.ray_c[k] + np.pad(0.01 * rng.standard_normal((n, 3, 2)), ((0, 0), (0, 0), (0, 1)))
    d = np.einsum("nij,nkj->nki", turned, ray)
    higher = 0.8 * rng.standard_normal((n, 1))
    # the ground is a plane: meet it in closed form, raised or lowered by its error
    normal = np.array([-0.25, 0.15, 1.0])
    away = (40.0 + higher) - (centre + e[:, :3]) @ normal[:, None]
    drawn = (centre + e[:, :3])[:, None] + d * (away / (d @ normal))[..., None]
    scatter = drawn.std(axis=0)
    assert np.hypot(scatter[:, 0], scatter[:, 1]) == pytest.approx(sigma[:, 0], rel=0.03)
    assert scatter[:, 2] == pytest.approx(sigma[:, 1], rel=0.03)


def test_a_slope_as_steep_as_the_ray_has_no_sigma():
    rays = rays_of(CAMERA, 0)
    R, centre = np.eye(3)[None], np.array([[0.0, 0.0, 1000.0]])
    point, _ = Plane(0.0).meet(centre[:, None], rays.ray_c[None])
    g = rays.ray_c[:, :2] / rays.ray_c[:, 2:]
    steep = (g / np.sum(g * g, axis=1, keepdims=True))[None]
    sigma = sigmas_of_lines(centre, R, np.eye(6)[None], rays.ray_c, point, steep, GroundErrors())
    assert np.isnan(sigma).all()
    with pytest.raises(ValueError, match="wanted at least 0"):
        GroundErrors(height_m=-1.0)


def test_slope_of_the_ellipsoid_is_that_of_its_own_points():
    point = np.array([[4000.0, -7000.0, 0.0], [100.0, 200.0, 0.0]])
    surface, down = Ellipsoid(FRAME, 250.0), np.array([0.0, 0.0, -1.0])
    h = 50.0
    for axis in range(2):
        step = h * np.eye(3)[axis]
        low, high = (surface.meet(point + np.array([0, 0, 5000.0]) + s, down)[0][:, 2] for s in (-step, step))
        assert surface.slope(surface.meet(point + np.array([0, 0, 5000.0]), down)[0])[:, axis] == pytest.approx(
            (high - low) / (2 * h), abs=1e-9
        )


def test_slope_at_the_border_of_heights_is_taken_on_the_side_that_is_known():
    field = _slope(0.2, 0.1)
    edge = np.array([[-2499.0, 0.0, 0.0], [2499.0, 2499.0, 0.0], [2600.0, 0.0, 0.0]])
    assert field.slope(edge)[:2] == pytest.approx(np.broadcast_to([0.2, 0.1], (2, 2)), abs=1e-9)
    assert np.isnan(field.slope(edge)[2]).all()


@pytest.mark.parametrize("height_m", [1500.0, 8000.0])
def test_bent_rays_meet_relief_where_their_points_are(height_m):
    """Points on relief, seen in the directions in which the air shows them, are found again to a millimetre."""
    refraction = Refraction(STANDARD)
    n = round(16_000 / 40) + 1
    x = -8000.0 + 40.0 * np.arange(n)
    X, Y = np.meshgrid(x, x)
    field = HeightField(-8000.0, -8000.0, 40.0, 300.0 * np.sin(X / 900.0) * np.cos(Y / 1100.0) + 0.05 * X)
    rng = np.random.default_rng(4)
    xy = rng.uniform(-0.75, 0.75, (300, 2)) * height_m
    point = np.column_stack([xy, field.height(xy[:, 0], xy[:, 1])])
    centre = np.array([0.0, 0.0, height_m])
    hidden = np.linalg.norm(field.meet(centre, point - centre)[0] - point, axis=1) > 0.01
    point = point[~hidden]
    e = [a @ FRAME.R_el.T + FRAME.origin_e for a in (point, np.broadcast_to(centre, point.shape))]
    seen = (refraction.straight_ground(*e) - FRAME.origin_e) @ FRAME.R_el
    assert np.linalg.norm(seen - point, axis=1).max() > 0.01
    found, met = UnderAir(field, FRAME, refraction).meet(centre, seen - centre)
    assert met.all() and np.linalg.norm(found - point, axis=1).max() < 1e-3
    straight, _ = field.meet(centre, seen - centre)
    assert np.linalg.norm(straight - point, axis=1).max() > 0.01


def test_the_shift_of_an_aerial_camera_is_that_of_the_closed_formula():
    """K of the Manual of Photogrammetry, heights in km: a fit to the air of 1959, good to some per cent."""
    H, h = 6.0, 0.5
    K = 1e-6 * (2410.0 * H / (H * H - 6 * H + 250) - 2410.0 * h / (h * h - 6 * h + 250) * (h / H))
    frame = LocalFrame(45.0, 10.0, 0.0)
    surface = UnderAir(Plane(500.0), frame, Refraction(STANDARD))
    tan = np.array([0.2, 0.5, 0.9])
    d = np.column_stack([tan, np.zeros(3), -np.ones(3)])
    point, _ = surface.meet(np.array([0.0, 0.0, 6000.0]), d)
    shift = 5500.0 * tan - point[:, 0]
    assert shift == pytest.approx(5500.0 * K * tan * (1 + tan**2), rel=0.1)


def test_thinner_air_bends_less_and_slopes_stay():
    field, frame = _slope(0.1, 0.0), FRAME
    d = np.array([[0.6, 0.1, -1.0]])
    centre = np.array([0.0, 0.0, 2000.0])
    straight = field.meet(centre, d)[0]
    off = []
    for pressure in (1013.25, 500.0):
        surface = UnderAir(field, frame, Refraction(Atmosphere(pressure_hpa=pressure)))
        bent = surface.meet(centre, d)[0]
        assert surface.slope(bent) == pytest.approx(field.slope(bent))
        off.append(float(np.linalg.norm(straight - bent)))
    assert off[0] > 1.8 * off[1] > 0
    assert np.isnan(UnderAir(field, frame, Refraction()).meet(centre, -d)[0]).all()


def test_a_mosaic_keeps_the_sigma_of_the_look_that_it_shows():
    """Two lines of flight over the same ground: grey value and sigma come from the same one."""
    grid, surface = GroundGrid(LocalFrame(48.93, 8.96, 300.0, "local"), 2.0), Plane(0.0)
    rays, mosaic = rays_of(CAMERA, 1), Mosaic(np.uint16, 64)
    n = 120
    for k, (y, sigma_m) in enumerate(((0.0, 0.5), (400.0, 2.0))):
        work = StripRectifier(rays, surface, grid, errors=GroundErrors(0.0, 0.3))
        position = np.column_stack([2.0 * np.arange(n), np.full(n, y), np.full(n, 1500.0)])
        R = np.broadcast_to(np.eye(3), (n, 3, 3))
        Q = np.zeros((n, 6, 6))
        Q[:, 0, 0] = Q[:, 1, 1] = sigma_m**2
        pixels = np.full((n, 500), 100 * (k + 1), dtype=np.uint16)
        for patch in [*work.add(0, pixels, None, position, R, Q), *work.finish()]:
            mosaic.add(patch)
    window = mosaic.extent()
    grey, sigma = mosaic.read(*window), mosaic.read_sigma(*window)
    assert {100, 200} == set(np.unique(grey[grey > 0]))
    assert np.array_equal(np.isfinite(sigma[0]), grey > 0)
    for value, sigma_m in ((100, 0.5), (200, 2.0)):
        mine = sigma[:, grey == value]
        across = np.sqrt(np.maximum(mine[0] ** 2 - 2 * sigma_m**2, 0.0)).max()  # by the height, to the ends of the line
        assert mine[0].min() == pytest.approx(np.sqrt(2) * sigma_m, rel=0.01)
        assert 0.02 < across < 0.3 * 300.0 / 500.0
        assert mine[1] == pytest.approx(np.full(mine.shape[1], 0.3), rel=1e-5)
    assert np.isnan(mosaic.read_sigma(-700, -690, 0, 5)).all()
