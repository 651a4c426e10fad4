"""A simulated flight as a block: what a batch adjustment gets of it."""

from __future__ import annotations

import numpy as np

from ..adjustment.network import Control, Measurements, Network, Strip, build_network
from ..trajectory import Trajectory
from .scenario import Simulation
from .window_study import TimedPose, slow_errors_of


def network_of(simulation: Simulation, poses: list[TimedPose]) -> Network:
    """Smoothed poses with their white noise, all rays, control points."""
    smoothed = [p.pose for p in poses if p.pose.smoothed]
    noise = slow_errors_of(simulation.errors).without(np.array([p.covariance for p in smoothed]))
    measured = Trajectory(
        [p.time_s for p in smoothed], [p.position_l for p in smoothed], [p.quaternion for p in smoothed]
    )
    strips = [
        Strip(s.id, measured, s.first_line_time_s, s.line_rate_hz, s.lines, noise=noise)
        for s in simulation.flight.strips
    ]
    images, looks, points = simulation.images, simulation.images.looks, simulation.points
    sigma = np.full(len(looks), simulation.observation_plan.image_sigma_px)
    known = np.flatnonzero(points.role == "control")
    control_sigma = np.tile(simulation.observation_plan.control_sigma_m, (len(known), 1))
    return build_network(
        simulation.flight.camera, strips, [str(id) for id in points.id],
        Measurements(looks.point, looks.strip, looks.ccd, images.line, images.sample, sigma, sigma),
        Control(known, simulation.surveyed_l[known], control_sigma),
    )  # fmt: skip
