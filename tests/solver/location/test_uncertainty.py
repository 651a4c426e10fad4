"""Covariance of locations: derivatives by moving the sensor, consistency over draws."""

from __future__ import annotations

import numpy as np
import pytest
from satellite_scenes import Truth, write_dimap1, write_dimap2
from scipy.spatial.transform import Rotation

from triline.nodes.formats.satellite.read import read_scene
from triline.solver.location.pushbroom import PushbroomSensor
from triline.solver.location.uncertainty import Sigmas, ground_covariance, ground_derivatives, pixel_covariance
from triline.solver.orbit.line_times import UniformLineTimes
from triline.solver.orbit.motion import Motion
from triline.solver.sensitivity.located_pixel import SatellitePixel


@pytest.fixture(scope="module")
def sensor(tmp_path_factory):
    truth = Truth(tilt_deg=(15.0, -8.0, 3.0))
    return read_scene(write_dimap2(tmp_path_factory.mktemp("scene") / "scene.xml", truth)).model("rigorous")


class Moved:
    """An orbit or attitude with a constant error."""

    def __init__(self, of, shift=None, turn=None):
        self.of, self.shift, self.turn = of, shift, turn
        self.start_s, self.end_s = of.start_s, of.end_s

    def at(self, time_s):
        if self.turn is not None:
            return self.of.at(time_s) @ Rotation.from_rotvec(self.turn).as_matrix()
        position, velocity = self.of.at(time_s)
        v = velocity + np.cross([0.0, 0.0, 7.292115e-5], position)
        up = position / np.linalg.norm(position, axis=1, keepdims=True)
        across = np.cross(v, up)
        across /= np.linalg.norm(across, axis=1, keepdims=True)
        return position + np.stack([np.cross(up, across), across, up], axis=-1) @ self.shift, velocity


def moved(sensor, position=(0, 0, 0), attitude=(0, 0, 0), time_s=0.0):
    motion = Motion(Moved(sensor.motion.orbit, np.asarray(position)), Moved(sensor.motion.attitude, None, attitude))
    times = sensor.line_times
    return PushbroomSensor(motion, UniformLineTimes(times.first_s + time_s, times.period_s, times.lines), sensor.look)


def enu(P):
    lat, lon = np.arctan2(P[2] * 1.0067394967, np.hypot(P[0], P[1])), np.arctan2(P[1], P[0])
    east = np.array([-np.sin(lon), np.cos(lon), 0.0])
    up = np.array([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)])
    return np.stack([east, np.cross(up, east), up])


def test_derivatives_of_all_ten_sources(sensor):
    u, v, h = 9000.0, 1200.0, 350.0
    J = ground_derivatives(sensor, [u], [v], [h])[0]
    P = sensor.ground([u], [v], h)[0]
    R = enu(P)

    def change(other, step, line=u, sample=v, height=h):
        return R @ (other.ground([line], [sample], height)[0] - P) / step

    for k in range(3):
        unit = np.eye(3)[k]
        np.testing.assert_allclose(J[:, k], change(moved(sensor, position=unit), 1.0), atol=1e-4)
        np.testing.assert_allclose(J[:, 3 + k], change(moved(sensor, attitude=1e-7 * unit), 1e-7), atol=20.0)
    np.testing.assert_allclose(J[:, 6], change(moved(sensor, time_s=1e-4), 1e-4), atol=1.0)
    np.testing.assert_allclose(J[:, 7], change(sensor, 0.1, line=u + 0.1), atol=1e-4)
    np.testing.assert_allclose(J[:, 8], change(sensor, 0.1, sample=v + 0.1), atol=1e-4)
    np.testing.assert_allclose(J[:, 9], change(sensor, 1.0, height=h + 1.0), atol=1e-4)


def test_attitude_errors_are_of_roll_pitch_and_yaw_whatever_the_maker_calls_his_axes(tmp_path):
    """The body of SPOT-5 has x across the flight: an error of roll moves the ground across the track all the same."""
    sensor = read_scene(write_dimap1(tmp_path / "scene.xml", Truth(tilt_deg=(1.0, -1.0, 2.0)))).model("rigorous")
    u, v, h = 0.5 * (sensor.lines - 1), 0.5 * (sensor.samples - 1), 350.0
    pose = sensor.pose([u])
    velocity = sensor.motion.inertial_velocity(pose.position_e, pose.velocity_e)[0]
    C, down = pose.position_e[0], -pose.position_e[0] / np.linalg.norm(pose.position_e[0])
    right = np.cross(down, velocity) / np.linalg.norm(np.cross(down, velocity))
    forward = np.cross(right, down)
    P = sensor.ground([u], [v], h)[0]
    R = enu(P)
    J = ground_derivatives(sensor, [u], [v], [h])[0]
    one = SatellitePixel(sensor, u, v, h)
    for k, axis in enumerate((forward, right, down)):
        turned = Rotation.from_rotvec(1e-6 * axis).apply(P - C)
        d = turned / np.linalg.norm(turned)
        there = C + sensor.ellipsoid.intersect(C[None], d[None], h)[0] * d
        errors = np.zeros((1, 10))
        errors[0, 3 + k] = 1e-6
        size = np.linalg.norm(P - C)
        # the body is within a few degrees of the flight
        np.testing.assert_allclose(J[:, 3 + k] / size, R @ (there - P) / 1e-6 / size, atol=0.05)
        np.testing.assert_allclose(one(errors)[0] / 1e-6 / size, J[:, 3 + k] / size, atol=1e-3)


def test_errors_are_as_large_as_their_sigmas(sensor):
    """Two-sided, narrow enough to fail when a sigma is 20 % wrong."""
    sigmas = Sigmas((2.0, 1.0, 1.5), (2e-6, 3e-6, 5e-5), 1e-4, (0.3, 0.4), 4.0)
    rng = np.random.default_rng(12)
    u, v, h = 12_000.0, 4500.0, 200.0
    P = sensor.ground([u], [v], h)[0]
    R = enu(P)
    C = ground_covariance(sensor, [u], [v], [h], sigmas)[0]
    pixel_C = pixel_covariance(sensor, [u], [v], [h], sigmas)[0]
    n, errors, pixels = 400, [], []
    for _ in range(n):
        other = moved(
            sensor, rng.normal(0, sigmas.position_m), rng.normal(0, sigmas.attitude_rad), rng.normal(0, sigmas.time_s)
        )
        noise, dh = rng.normal(0, sigmas.pixel), rng.normal(0, sigmas.height_m)
        errors.append(R @ (other.ground([u + noise[0]], [v + noise[1]], h + dh)[0] - P))
        pixels.append(other.ground_to_pixel(P[None] + dh * R[2])[0] + noise - [u, v])
    for drawn, covariance in ((np.array(errors), C), (np.array(pixels), pixel_C)):
        nees = np.einsum("ni,ij,nj->n", drawn, np.linalg.inv(covariance), drawn) / drawn.shape[1]
        assert 0.85 < nees.mean() < 1.17
        np.testing.assert_allclose(drawn.std(axis=0), np.sqrt(np.diag(covariance)), rtol=0.12)


def test_covariance_of_the_ground_point_counts_in_the_image(sensor):
    none = pixel_covariance(sensor, [100.0], [100.0], [0.0], Sigmas(), np.zeros((3, 3)))
    np.testing.assert_allclose(none, 0.0, atol=1e-12)
    height = pixel_covariance(sensor, [100.0], [100.0], [0.0], Sigmas(height_m=3.0))
    same = pixel_covariance(sensor, [100.0], [100.0], [0.0], Sigmas(), np.diag([0.0, 0.0, 9.0]))
    np.testing.assert_allclose(same, height, rtol=1e-9)


def test_sigmas_below_zero_are_refused():
    with pytest.raises(ValueError, match="at least 0"):
        Sigmas(time_s=-1.0)
