"""Equations of an image: derivatives against central differences, misclosures against the full inverse location."""

from __future__ import annotations

import numpy as np
import pytest

from triline.solver.camera.self_calibration import lens, prism
from triline.solver.geometry.ellipsoid import WGS84
from triline.solver.location.refraction import Refraction
from triline.solver.location.rpc_fit import fit_to_model
from triline.solver.models.dgr import DgrOptions
from triline.solver.models.lim import LimOptions
from triline.solver.models.ppm import PpmOptions
from triline.solver.scene_adjustment.functional import ProjectiveImage, RpcImage
from triline.solver.scene_adjustment.rigorous import LensView, RigorousImage, lens_view
from triline.solver.simulation.orbital_scene import ORBITAL_SENSORS, overpass
from triline.solver.simulation.satellite_block import draw, rigorous_images

DGR = DgrOptions((2.0,) * 3, (0.01,) * 3, (0.002,) * 3)
MODELS = {"dgr": DGR, "ppm": PpmOptions(2), "lim": LimOptions(4)}


def pixels(image, n=20, seed=0):
    rng = np.random.default_rng(seed)
    return rng.uniform(200, image.lines - 200, n), rng.uniform(100, image.samples - 100, n)


def drawn(image, seed=1):
    rng = np.random.default_rng(seed)
    return np.concatenate([draw(group.prior, len(group), rng) for group in image.groups])


def check_derivatives(image, u, v, P, values, share):
    """Every derivative to a share of its largest value."""
    rays = image.measured(u, v)
    equations = rays.equations(P, values)
    for axis in range(3):
        d = np.zeros(3)
        d[axis] = 5.0
        low, high = (rays.equations(P + s * d, values).misclosure_px for s in (-1.0, 1.0))
        numeric = -(high - low) / 10.0
        np.testing.assert_allclose(
            equations.by_point[:, :, axis], numeric, atol=share * np.abs(equations.by_point).max()
        )
    names = [name for group in image.groups for name in group.names]
    for k, name in enumerate(names):
        column = equations.by_unknown[:, :, k]
        step = 0.2 / max(np.abs(column).max(), 1e-12)  # a fifth of a pixel
        d = np.zeros(len(values))
        d[k] = step
        low, high = (rays.equations(P, values + s * d).misclosure_px for s in (-1.0, 1.0))
        largest = max(np.abs(column).max(), 1e-9)
        np.testing.assert_allclose(column, -(high - low) / (2.0 * step), atol=3 * share * largest, err_msg=name)


@pytest.mark.parametrize(
    ("sensor", "model", "calibration"),
    [
        ("alos-prism", "dgr", prism),
        ("spot5-hrs", "ppm", lens),
        ("aster-vnir", "lim", None),
        ("eros-a1", "dgr", lens),
        ("moms-02", "ppm", None),
        ("misr", "dgr", lens),
    ],
)
def test_rigorous_images(sensor, model, calibration):
    scene = overpass(ORBITAL_SENSORS[sensor], 20.0, 10.0, roll_deg=3.0)
    for image in rigorous_images([scene], MODELS[model], calibration)[:1]:
        values = drawn(image)
        adjusted = image.located(values)
        u, v = pixels(image.sensor)
        P = adjusted.ground(u, v, np.linspace(-400.0, 9000.0, len(u)))
        # no misclosure where the full inverse location of the adjusted sensor sees the point
        there = adjusted.ground_to_pixel(P)
        np.testing.assert_allclose(there, np.stack([u, v], axis=1), atol=1e-5)
        rays = image.measured(u, v)
        np.testing.assert_allclose(rays.equations(P, values).misclosure_px, 0.0, atol=1e-6)
        # and beside it the difference to it, to the second order of a pixel
        off = image.measured(u + 0.7, v - 0.4).equations(P, values).misclosure_px
        np.testing.assert_allclose(off, np.tile([0.7, -0.4], (len(u), 1)), atol=2e-3)
        check_derivatives(image, u, v, P, values, 2e-4)


def test_refraction_light_time_and_aberration_are_in_the_equations():
    scene = overpass(ORBITAL_SENSORS["alos-prism"], 20.0, 10.0, roll_deg=20.0)
    (image, *_) = rigorous_images([scene], DGR)
    bent = RigorousImage("bent", image.sensor.with_refraction(Refraction()), image.corrections)
    u, v = pixels(image.sensor)
    for one in (image, bent):
        P = one.sensor.ground(u, v, 300.0)
        np.testing.assert_allclose(one.measured(u, v).equations(P, np.zeros(9)).misclosure_px, 0.0, atol=1e-6)
    straight = image.measured(u, v).equations(bent.sensor.ground(u, v, 300.0), np.zeros(9)).misclosure_px
    assert np.abs(straight).max() > 0.1


def test_image_frames():
    """Of a camera that is known, and the one made up for a sensor without: the same axes; a pixel is 0.01 mm."""
    scene = overpass(ORBITAL_SENSORS["alos-prism"], 20.0, 10.0)
    images = rigorous_images([scene], DGR, prism)
    for image in images:
        known = image.calibration.view
        made = lens_view(image.sensor)
        assert isinstance(made, LensView)
        np.testing.assert_allclose(made.R_bc, known.R_bc, atol=1e-9)
        np.testing.assert_allclose(made.R_bc.T @ made.R_bc, np.eye(3), atol=1e-12)
        xy = made.image_coordinates(image.sensor.look.at(np.array([0.0, 1000.0]))[0])
        assert abs(np.linalg.norm(np.diff(xy, axis=0)) / 1000.0 - 0.01) < 1e-5
        assert image.calibration.parameters.names[0].startswith(f"dx_{image.name[-1]}")
    assert sum(len(image.groups[1]) for image in images) == 30


def ground_box(sensor, n=60):
    u, v = pixels(sensor, n)
    return u, v, sensor.ground(u, v, np.random.default_rng(3).uniform(0.0, 2000.0, n))


@pytest.mark.parametrize("affine", [False, True])
def test_rpc_images(affine):
    sensor = overpass(ORBITAL_SENSORS["alos-prism"], 20.0, 179.95).sensors["F"]  # over the date line
    rpc = fit_to_model(sensor, -500.0, 2500.0).rpc
    image = RpcImage("F", rpc, affine)
    values = np.random.default_rng(2).normal(0.0, 3.0, 6 if affine else 2)
    u, v, P = ground_box(sensor)
    lat, lon, h = WGS84.geodetic(P).T
    pixel = image.located(values).inverse(lat, lon, h)
    zero = image.measured(*pixel.T).equations(P, values).misclosure_px
    np.testing.assert_allclose(zero, 0.0, atol=1e-7)
    check_derivatives(image, u, v, P, values, 1e-5)
    back = image.located(values).direct(*pixel.T, h)
    np.testing.assert_allclose(back[:, :2], np.stack([lat, (lon + np.pi) % (2 * np.pi) - np.pi], axis=1), atol=1e-11)


@pytest.mark.parametrize("kind", ["affine", "dlt"])
def test_affine_and_dlt_images(kind):
    """A narrow part of a scene is nearly affine; start values from points, round trips, derivatives."""
    sensor = overpass(ORBITAL_SENSORS["alos-prism"], 20.0, 179.95).sensors["N"]
    u, v, P = ground_box(sensor, 80)
    image = ProjectiveImage("N", kind, (sensor.lines, sensor.samples))
    values = image.start(u, v, P)
    equations = image.measured(u, v).equations(P, values)
    assert np.sqrt(np.mean(equations.misclosure_px**2)) < 5.0
    check_derivatives(image, u, v, P, values, 1e-6)
    lat, lon, h = WGS84.geodetic(P).T
    pixel = image.located(values).inverse(lat, lon, h)
    back = image.located(values).direct(*pixel.T, h)
    np.testing.assert_allclose(image.located(values).inverse(*back.T), pixel, atol=1e-6)


@pytest.mark.parametrize(("kind", "least"), [("affine", 4), ("dlt", 6)])
def test_too_few_or_flat_points_do_not_determine_a_model(kind, least):
    sensor = overpass(ORBITAL_SENSORS["alos-prism"], 20.0, 10.0).sensors["N"]
    u, v, P = ground_box(sensor, 20)
    image = ProjectiveImage("N", kind)
    with pytest.raises(ValueError, match=f"{least - 1} points with known coordinates, the {kind} model wants"):
        image.start(u[: least - 1], v[: least - 1], P[: least - 1])
    flat = sensor.ground(u, v, 100.0)
    with pytest.raises(ValueError, match="lie in a plane or on a line"):
        image.start(u, v, flat)
