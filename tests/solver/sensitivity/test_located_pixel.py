"""Located pixels as functions of their errors: against the closed derivatives, and against moved sensors."""

from __future__ import annotations

from copy import copy

import numpy as np
import pytest

from triline.solver.geometry.earth import R_en
from triline.solver.geometry.rotation import R_ENU_NED
from triline.solver.location.frame_camera import FrameCamera
from triline.solver.location.refraction import Refraction
from triline.solver.location.uncertainty import Sigmas, ground_covariance, ground_derivatives
from triline.solver.rectification.comparison import bilsat_camera
from triline.solver.sensitivity.located_pixel import (
    AIRCRAFT,
    FRAME,
    AircraftPixel,
    FramePixel,
    SatellitePixel,
    camera_inputs,
    satellite_inputs,
)
from triline.solver.sensitivity.propagation import propagate
from triline.solver.sensitivity.study import study
from triline.solver.simulation.orbital_scene import ORBITAL_SENSORS, overpass

SIGMAS = Sigmas((1.0, 2.0, 3.0), (1e-5, 2e-5, 3e-5), 1e-4, (0.3, 0.4), 5.0)


def flown(attitude_rad):
    """Errors of an airborne strip."""
    return camera_inputs(AIRCRAFT, Sigmas((0.1,) * 3, (attitude_rad,) * 3, 0.0, (0.5, 0.5), 1.0), 0.001)


@pytest.fixture(scope="module")
def sensor():
    return overpass(ORBITAL_SENSORS["alos-prism"], 36.0, 139.6).sensors["F"]


def test_a_satellite_against_closed_derivatives(sensor):
    inputs = satellite_inputs(SIGMAS)
    found = propagate(SatellitePixel(sensor, 500.0, 1000.0, 200.0), inputs.mean, inputs.sigma**2)
    closed = ground_derivatives(sensor, 500.0, 1000.0, 200.0)[0]
    scale = np.abs(closed).max(axis=0)
    np.testing.assert_allclose(found.jacobian / scale, closed / scale, atol=2e-3)
    covariance = ground_covariance(sensor, 500.0, 1000.0, 200.0, SIGMAS)[0]
    np.testing.assert_allclose(found.sigma, np.sqrt(np.diag(covariance)), rtol=1e-3)


def test_first_and_last_lines_where_orbit_and_attitude_end_with_the_image(sensor):
    """Errors of time and line lead beyond: these pixels were refused, and the edges missing from maps of a scene."""
    motion = copy(sensor.motion)
    motion.start_s, motion.end_s = np.sort(sensor.line_times.time_of(np.array([0.0, sensor.lines - 1.0])))
    ending = sensor.changed(motion, sensor.look)
    inputs = satellite_inputs(SIGMAS)
    for line in (0.0, sensor.lines - 1.0):
        short, whole = (
            propagate(SatellitePixel(s, line, 1000.0, 200.0), inputs.mean, inputs.sigma**2) for s in (ending, sensor)
        )
        scale = np.abs(whole.jacobian).max(axis=0)
        np.testing.assert_allclose(short.jacobian / scale, whole.jacobian / scale, atol=1e-6)
        errors = np.zeros((2, 10))
        errors[:, 7] = [-5.0, 5.0] if line == 0.0 else [5.0, -5.0]
        one, other = (SatellitePixel(s, line, 1000.0, 200.0)(errors) for s in (ending, sensor))
        np.testing.assert_allclose(one, other, atol=1e-3)
        assert np.isnan(SatellitePixel(ending, line, 1000.0, 200.0)(20.0 * errors[:1])).all()


def test_no_errors_no_change_with_refraction_too(sensor):
    for used in (sensor, sensor.with_refraction(Refraction())):
        assert np.abs(SatellitePixel(used, 500.0, 1000.0, 200.0)(np.zeros((2, 10)))).max() < 1e-6


def test_an_aircraft_against_pen_and_paper():
    # straight down, flying east, 2000 m above ground, 0.0625 m a pixel
    pixel = AircraftPixel((0.0, 0.0, 2500.0), (0.0, 0.0, 0.0), (0.0, 0.0), 64.0, 0.002, 500.0)
    inputs = flown(1e-5)
    J = propagate(pixel, inputs.mean, inputs.sigma**2).jacobian
    expected = np.zeros((3, 10))
    expected[0, 0] = expected[1, 1] = expected[2, 9] = 1.0
    expected[0, 4], expected[1, 3] = -2000.0, 2000.0  # phi tips the camera back, omega to the left
    expected[0, 7] = expected[1, 8] = 0.0625
    np.testing.assert_allclose(J, expected, atol=1e-4)


def test_a_frame_against_its_closed_derivatives_and_a_moved_camera():
    camera = bilsat_camera()
    line, sample, height = 300.0, 1500.0, 800.0
    inputs = camera_inputs(FRAME, SIGMAS, 0.01)
    J = propagate(FramePixel(camera, line, sample, height), inputs.mean, inputs.sigma**2).jacobian
    # derivatives of the pixel of fixed ground become those of the ground of a fixed pixel
    by_pixel, by_camera = J[:2, 7:9], J[:2, :6]
    closed = camera.image_derivatives(line, sample, height)[0]
    scale = np.abs(by_camera).max(axis=0)
    np.testing.assert_allclose(by_camera / scale, -by_pixel @ closed / scale, atol=1e-4)
    # a camera constant of 0.01 mm more, and ground 5 m higher
    other = FrameCamera(
        camera.position_e, camera.R_ec, camera.focal_length_mm + 0.01, camera.pixel_mm, 2048, 2048,
        distortion=camera.distortion,
    )  # fmt: skip
    moved = FramePixel(camera, line, sample, height)(np.array([[0, 0, 0, 0, 0, 0, 0.01, 0, 0, 5.0]]))
    lat, lon, _ = camera.ellipsoid.geodetic(camera.ground(line, sample, height))[0]
    shift = other.ground(line, sample, height + 5.0)[0] - camera.ground(line, sample, height)[0]
    np.testing.assert_allclose(moved[0], (R_ENU_NED @ R_en(lat, lon).T) @ shift, atol=1e-6)
    with pytest.raises(ValueError, match="the ray misses the ground at 800000 m"):
        FramePixel(camera, line, sample, 8e5)


def test_a_pixel_that_misses():
    far = overpass(ORBITAL_SENSORS["misr"], 36.0, 139.6).sensors["Df"]
    with pytest.raises(ValueError, match="the ray misses the ground at 800000 m"):
        SatellitePixel(far, 10.0, 10.0, 8e5)


def test_covariance_and_monte_carlo_agree_where_the_function_is_nearly_linear(sensor):
    inputs = satellite_inputs(SIGMAS)
    found = study(SatellitePixel(sensor, 500.0, 1000.0, 200.0), inputs, 8000, 1024, 1)
    assert found.linear.all() and found.drawn.converged
    np.testing.assert_allclose(found.fast.first[:2], found.covariance.share[:2], atol=0.03)
    np.testing.assert_allclose(found.sobol.first[:2], found.covariance.share[:2], atol=0.02)
    np.testing.assert_allclose(found.sobol.total[:2], found.covariance.share[:2], atol=0.02)


def test_it_is_told_where_they_do_not_agree():
    # a camera that looks 40 degrees to the side with an attitude of 5 degrees
    pixel = AircraftPixel((0.0, 0.0, 2500.0), (np.radians(40.0), 0.0, 0.0), (0.0, 0.0), 64.0, 0.002, 500.0)
    found = study(pixel, flown(np.radians(5.0)), 8000, 512, 1)
    assert not found.linear[1]
    with pytest.raises(ValueError, match="no parameter has a sigma above 0"):
        study(pixel, camera_inputs(AIRCRAFT, Sigmas(), 0.0), 1000, 512, 1)
