"""Every sensor on its orbit: lenses meet on the ground, round trips, over the pole and the date line."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from triline.solver.simulation.orbital_scene import ORBITAL_SENSORS, overpass

PLACES = {"middle latitude": (25.0, 10.0), "date line": (-20.0, 180.0)}


def grid(sensor, n=5):
    u, v = np.meshgrid(np.linspace(-0.5, sensor.lines - 0.5, n), np.linspace(-0.5, sensor.samples - 0.5, n))
    return u.ravel(), v.ravel()


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("name", ORBITAL_SENSORS)
def test_round_trips_of_every_line_of_every_sensor(name, place):
    for sensor in overpass(ORBITAL_SENSORS[name], *PLACES[place], roll_deg=2.0).sensors.values():
        u, v = grid(sensor)
        for height in (-400.0, 9000.0):
            located = sensor.direct(u, v, height)
            assert np.isfinite(located).all()
            np.testing.assert_allclose(sensor.inverse(*located.T), np.stack([u, v], axis=1), atol=1e-4)


@pytest.mark.parametrize("name", ORBITAL_SENSORS)
def test_over_the_pole(name):
    sensor = replace(ORBITAL_SENSORS[name], inclination_deg=90.0)
    for line in overpass(sensor, 90.0, 0.0).sensors.values():
        u, v = grid(line)
        for height in (-400.0, 9000.0):
            located = line.direct(u, v, height)
            np.testing.assert_allclose(line.inverse(*located.T), np.stack([u, v], axis=1), atol=1e-4)
            assert np.degrees(located[:, 0]).max() > 89.0


@pytest.mark.parametrize("name", ORBITAL_SENSORS)
def test_lenses_see_the_same_ground(name):
    lat, lon = 25.0, 10.0
    for line in overpass(ORBITAL_SENSORS[name], lat, lon).sensors.values():
        middle = np.degrees(line.direct([0.5 * (line.lines - 1)], [0.5 * (line.samples - 1)], 0.0)[0])
        # geodetic latitude is up to 0.2 deg more; the Earth turns by 1.7 deg while MISR's nine lenses look
        assert abs(middle[0] - lat) < 0.4 and abs(middle[1] - lon) < 1.2


def test_pixels_have_their_published_size():
    sizes = {"alos-prism": 2.5, "spot5-hrs": 9.3, "aster-vnir": 15.0, "eros-a1": 1.8, "moms-02": 12.5, "misr": 250.0}
    for name, size in sizes.items():
        views = ORBITAL_SENSORS[name].view_deg
        line = overpass(ORBITAL_SENSORS[name], 5.0, 0.0).sensors[min(views, key=lambda id: abs(views[id]))]
        u, v = np.full(2, 0.5 * line.lines), 0.5 * line.samples + np.array([0.0, 1.0])
        across = np.linalg.norm(np.diff(line.ground(u, v, 0.0), axis=0))
        assert abs(across / size - 1.0) < 0.12, (name, across)


def test_an_asynchronous_sensor_holds_the_ground_back():
    eros = ORBITAL_SENSORS["eros-a1"]
    steps = []
    for rate in (0.0, eros.pitch_rate_deg_s):
        line = overpass(replace(eros, pitch_rate_deg_s=rate), 5.0, 0.0).sensors["P"]
        at = line.ground(0.5 * line.lines + np.array([0.0, 1.0]), np.full(2, 0.5 * line.samples), 0.0)
        steps.append(np.linalg.norm(np.diff(at, axis=0)))
    assert steps[1] < 0.4 * steps[0]


def test_a_latitude_out_of_reach_is_refused():
    with pytest.raises(ValueError, match=r"wanted one that an orbit of 28\.5 deg reaches"):
        overpass(ORBITAL_SENSORS["moms-02"], 50.0, 0.0)
