"""Light time and aberration against a direct location of the Rugged library."""

from __future__ import annotations

import re

import numpy as np
import pytest
from places import DATA, needs_data
from scipy.spatial.transform import Rotation

from triline.solver.location.look_directions import TableLook
from triline.solver.location.pushbroom import PushbroomSensor
from triline.solver.orbit.line_times import UniformLineTimes
from triline.solver.orbit.motion import Motion

REPLAY = DATA / "satellites" / "replay-direct-loc-01.txt"


def vectors(text, *names):
    return [np.array([float(x) for x in re.search(rf"{name}((?: +[-+.\de]+)+)", text)[1].split()]) for name in names]


class Straight:
    """An orbit that is a straight line for a moment, an attitude and an Earth that stand still."""

    start_s, end_s = -1.0, 1.0

    def __init__(self, position, velocity, R):
        self.position, self.velocity, self.R = position, velocity, R

    def at(self, time_s):
        t = np.atleast_1d(time_s)[:, None]
        return self.position + t * self.velocity, np.broadcast_to(self.velocity, (len(t), 3))


class Still:
    start_s, end_s = -1.0, 1.0

    def __init__(self, R):
        self.R = R

    def at(self, time_s):
        return np.broadcast_to(self.R, (len(np.atleast_1d(time_s)), 3, 3))

    R_ie = at


def rotation(q):
    return Rotation.from_quat([q[1], q[2], q[3], q[0]]).as_matrix()


@needs_data
@pytest.mark.parametrize("k", range(5))
def test_direct_location_of_rugged(k):
    lines = REPLAY.read_text().splitlines()
    transform = next(line for line in lines if line.startswith("transform:"))
    of_earth, of_craft = transform.split("spacecraft")
    (q_earth,) = vectors(of_earth, "body r")
    p, v, q, omega = vectors(of_craft, " p", " v", " r", " Ω")
    R_is = rotation(q).T
    position = R_is @ p
    velocity = R_is @ v - np.cross(omega, position)
    asked = [line for line in lines if line.startswith("direct location: date")][k]
    got = [line for line in lines if line.startswith("direct location result")][k]
    lever, los = vectors(asked, "position", "los")
    lat, lon, height = (float(x) for x in re.findall(r"[-+]?\d\.\d+e[-+]\d+", got))
    # the Earth turns against the stars by the rotation of the dump
    motion = Motion(Straight(position, velocity, R_is), Still(R_is), "i", "i", Still(rotation(q_earth).T))
    look = TableLook([0.0, 1.0], np.stack([los, los + np.array([0.0, 1e-6, 0.0])]), 2)
    options = {"lever_arm_b": lever}

    def miss(**more):
        sensor = PushbroomSensor(motion, UniformLineTimes(0.0, 1e-3, 2), look, **options, **more)
        X = sensor.ground([0.0], [0.0], height)
        return np.linalg.norm(X - sensor.ellipsoid.cartesian(lat, lon, height))

    assert miss(light_time=True, aberration=True) < 1e-3
    assert miss() > 10.0 and miss(light_time=True) > 10.0
    sensor = PushbroomSensor(motion, UniformLineTimes(0.0, 1e-3, 2), look, **options, light_time=True, aberration=True)
    np.testing.assert_allclose(sensor.inverse([lat], [lon], height), [[0.0, 0.0]], atol=0.1)
    back = sensor.ground_to_pixel(sensor.ground([0.3], [0.7], height))
    np.testing.assert_allclose(back, [[0.3, 0.7]], atol=1e-5)
