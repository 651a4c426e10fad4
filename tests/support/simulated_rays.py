"""Simulated flights for tests: a plan flown, and whether its rays meet."""

import numpy as np

from triline.solver.camera.collinearity import project
from triline.solver.simulation.flight import fly
from triline.solver.simulation.scenario import ObservationPlan
from triline.solver.simulation.streams import stream

EXACT = ObservationPlan(image_sigma_px=0.0)


def flown(plan, seed=1):
    return fly(plan, stream(seed, "motion"), stream(seed, "terrain"))


def reprojection_px(simulation):
    """Distance of noise-free image points from the projection of the true points through the true orientation, px."""
    looks, flight = simulation.images.looks, simulation.flight
    poses = flight.truth.at(looks.time_s)
    points = simulation.points.xyz_l[looks.point]
    projected = project(poses.position_l, poses.angles, points, flight.camera.focal_length_mm[looks.ccd])
    assert projected.in_front.all()
    xy, pitch = flight.camera.image_coordinates(looks.ccd, looks.sample)
    return np.linalg.norm(projected.xy_mm - xy, axis=1) / np.linalg.norm(pitch, axis=1)
