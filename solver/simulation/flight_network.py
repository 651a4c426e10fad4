"""A simulated flight as a block: what a batch adjustment gets of it, and its errors against truth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ..adjustment.job import BatchResult
from ..adjustment.network import Control, Measurements, Network, Strip, build_network
from ..adjustment.refined_orientation import corrections_at
from ..geometry.rotation import corrected_angles
from ..geometry.trajectory import Trajectory
from .scenario import Simulation
from .window_study import TimedPose, slow_errors_of

Array = NDArray[np.floating]

#: A strip takes the poses from so long before it until so long after it, s.
BEYOND_S = 0.5


def network_of(simulation: Simulation, poses: list[TimedPose]) -> Network:
    """Smoothed poses with their white noise, all rays, control points."""
    smoothed = [p.pose for p in poses if p.pose.smoothed]
    slow, time_s = slow_errors_of(simulation.errors), np.array([p.time_s for p in smoothed])
    strips = []
    for s in simulation.flight.strips:
        inside = (time_s > s.first_line_time_s - BEYOND_S) & (time_s < s.time_of(s.lines) + BEYOND_S)
        own = [smoothed[i] for i in np.flatnonzero(inside)]
        measured = Trajectory([p.time_s for p in own], [p.position_l for p in own], [p.quaternion for p in own])
        noise = slow.without(np.array([p.covariance for p in own]))
        strips.append(
            Strip(
                s.id,
                measured,
                s.first_line_time_s,
                s.line_rate_hz,
                s.lines,
                noise=noise,
                noise_time_s=own[-1].noise_time_s,
            )
        )
    images, looks, points = simulation.images, simulation.images.looks, simulation.points
    sigma = np.full(len(looks), simulation.observation_plan.image_sigma_px)
    known = np.flatnonzero(points.role == "control")
    control_sigma = np.tile(simulation.observation_plan.control_sigma_m, (len(known), 1))
    network = build_network(
        simulation.flight.camera, strips, [str(id) for id in points.id],
        Measurements(looks.point, looks.strip, looks.ccd, images.line, images.sample, sigma, sigma),
        Control(known, simulation.surveyed_l[known], control_sigma),
    )  # fmt: skip
    return replace(network, heading=True)


def batch_errors(simulation: Simulation, found: BatchResult, strip: str, time_s: Array) -> Array:
    """Errors (n, 6) of the adjusted orientation of a strip at times (n,): X, Y, Z, omega, phi, kappa in m, rad."""
    number = next(i for i, s in enumerate(found.network.strips) if s.id == strip)
    measured, truth = found.network.strips[number].trajectory.at(time_s), simulation.flight.truth.at(time_s)
    correction = corrections_at(found.solution, number, time_s)
    angles = corrected_angles(measured.angles, correction[:, 3:])
    turned = (angles - truth.angles + np.pi) % (2 * np.pi) - np.pi
    return np.hstack([measured.position_l + correction[:, :3] - truth.position_l, turned])
