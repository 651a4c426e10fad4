"""Orbital sensors as cameras with poses in a local frame: pixels of the rigorous model, far from the origin too."""

from __future__ import annotations

import numpy as np
import pytest

from triline.solver.camera.collinearity import project
from triline.solver.geometry.frames import LocalFrame
from triline.solver.location.local_poses import local_poses
from triline.solver.location.refraction import Refraction
from triline.solver.scene_adjustment.rigorous import lens_view
from triline.solver.simulation.orbital_scene import ORBITAL_SENSORS, overpass

CASES = [("alos-prism", "F", 36.0), ("spot5-hrs", "B", 36.0), ("aster-vnir", "3B", 70.0), ("eros-a1", "P", -50.0),
         ("moms-02", "F", 10.0), ("misr", "Df", 36.0), ("misr", "An", 36.0)]  # fmt: skip


def made(name, ccd, lat_deg, refraction=None):
    scene = overpass(ORBITAL_SENSORS[name], lat_deg, 139.6, roll_deg=2.0)
    sensor = scene.sensors[ccd].with_refraction(refraction)
    ends = sensor.line_times.time_of(np.array([-0.5, sensor.lines - 0.5]))
    time = np.linspace(ends[0] - 0.3, ends[1] + 0.3, int((ends[1] - ends[0]) / 0.1) + 7)
    frame = LocalFrame(lat_deg, 139.6, 500.0, "EPSG:4979")
    view = lens_view(sensor)
    poses = local_poses(sensor, frame, view.image_coordinates, view.R_bc, view.focal_length_mm, time, 500.0)
    return sensor, frame, poses


@pytest.mark.parametrize(("name", "ccd", "lat_deg"), CASES)
@pytest.mark.parametrize("refraction", [None, Refraction()], ids=["straight", "bent"])
def test_pixels_are_those_of_the_rigorous_model(name, ccd, lat_deg, refraction):
    """Random pixels at random heights, through collinearity: light time and aberration are in poses and table.

    Refraction hangs on the height, so that what is fitted at 500 m is a little off on mountains.
    """
    sensor, frame, poses = made(name, ccd, lat_deg, refraction)
    rng = np.random.default_rng(5)
    line, sample = rng.uniform(0, sensor.lines - 1, 500), rng.uniform(0, sensor.samples - 1, 500)
    ground = (sensor.ground(line, sample, rng.uniform(-400, 3000, 500)) - frame.origin_e) @ frame.R_el
    at = poses.trajectory.at(sensor.line_times.time_of(line))
    xy = project(at.position_l, at.angles, ground, np.full(500, poses.focal_length_mm)).xy_mm
    table = np.stack([np.interp(sample, np.arange(sensor.samples), poses.xy_mm[:, k]) for k in range(2)], axis=1)
    pixel = np.median(np.linalg.norm(np.diff(poses.xy_mm, axis=0), axis=1))
    off = np.linalg.norm(xy - table, axis=1).max() / pixel
    assert off < (0.005 if refraction is None else 0.2)
    assert poses.misfit_px < (0.005 if refraction is None else 0.1)


def test_the_misfit_tells_poses_too_far_apart():
    """A turning satellite with a pose every 3 s."""
    scene = overpass(ORBITAL_SENSORS["misr"], 36.0, 139.6)
    sensor = scene.sensors["Df"]
    ends = sensor.line_times.time_of(np.array([-0.5, sensor.lines - 0.5]))
    frame, view = LocalFrame(36.0, 139.6, 0.0), lens_view(sensor)
    near, far = (
        local_poses(sensor, frame, view.image_coordinates, view.R_bc, view.focal_length_mm,
                    np.linspace(ends[0], ends[1], n), 0.0).misfit_px
        for n in (200, 3)
    )  # fmt: skip
    assert far > 10 * near


def test_rays_that_miss_the_ground():
    sensor, frame, _ = made("misr", "Df", 36.0)
    view = lens_view(sensor)
    with pytest.raises(ValueError, match="rays that miss the ground at"):
        local_poses(sensor, frame, view.image_coordinates, view.R_bc, view.focal_length_mm, [0.0, 0.1], 8e5)
