"""The short flights of ``constants.py``: what window, navigation and matching make of them.

This module imports everything, so it is imported once the constant that is looked at has been changed.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import frame  # noqa: F401  (before NumPy)
import numpy as np
from navigation import errors as inertial_errors
from navigation import flight as inertial_flight
from numpy.typing import NDArray

from triline.nodes.simulator.flight_settings import simulated_flight
from triline.solver.camera.self_calibration import tls
from triline.solver.navigation.inertial_data import MEMS, TACTICAL
from triline.solver.navigation.post_processing import navigate as navigate_inertial
from triline.solver.simulation.error_models import ErrorModel
from triline.solver.simulation.flight import FlightPlan
from triline.solver.simulation.matching_study import match_strip, tie_errors
from triline.solver.simulation.scenario import ObservationPlan, Simulation, simulate
from triline.solver.simulation.window_study import (
    Errors,
    adjust_online,
    measured_errors,
    navigate,
    orientation_errors,
    point_errors,
)
from triline.solver.window.results import WindowOptions

Array = NDArray[np.floating]

ERRORS = ErrorModel(attitude_rate_hz=100.0)
TIES = ObservationPlan(tie_points_per_s=6.0, outlier_share=0.05)
STRIP = FlightPlan(strip_s=20.0, lead_in_s=3.0, lead_out_s=2.0)
BLOCK = FlightPlan(strips=2, strip_s=12.0, sidelap=0.4, turns=False, gap_s=6.0, lead_in_s=3.0, lead_out_s=2.0)
#: Platform time between updates of the window, s.
UPDATE_S = 0.4
#: Matches that are farther from the truth, px, are wrong.
WRONG_PX = 1.0


@dataclass
class Outcome:
    """What came out of the flights of a room.

    Attributes
    ----------
    rmse : (k,) by kind
    nees, counts : by kind
    cpu_s : processor time of what the room does
    """

    rmse: dict[str, Array] = field(default_factory=dict)
    nees: dict[str, float] = field(default_factory=dict)
    counts: dict[str, int] = field(default_factory=dict)
    cpu_s: float = 0.0

    def row(self, usual: Outcome) -> str:
        """RMSE and time over those of another outcome, the other figures as they are."""
        ratios = [float(np.mean(self.rmse[kind] / usual.rmse[kind])) for kind in usual.rmse]
        parts = (
            " ".join(f"{r:6.3f}" for r in ratios),
            " ".join(f"{self.nees[kind]:5.2f}" for kind in usual.nees),
            " ".join(f"{self.counts[kind]:4d}" for kind in usual.counts),
            f"{self.cpu_s / usual.cpu_s:.2f}",
        )
        return " | ".join(parts)


@dataclass
class Flown:
    """Errors of all flights of a room, by kind."""

    squares: dict[str, list[Array]] = field(default_factory=dict)
    normalised: dict[str, list[Array]] = field(default_factory=dict)

    def add(self, kind: str, error: Array, normalised: Array) -> None:
        """Errors (n, k), and their squares over the variances, (n,)."""
        self.squares.setdefault(kind, []).append(error**2)
        self.normalised.setdefault(kind, []).append(normalised)

    def add_errors(self, kind: str, errors: Errors) -> None:
        self.add(kind, errors.error, errors.nees)

    def outcome(self, counts: dict[str, int], cpu_s: float) -> Outcome:
        rmse = {kind: np.sqrt(np.concatenate(rows).mean(axis=0)) for kind, rows in self.squares.items()}
        nees = {kind: float(np.concatenate(rows).mean()) for kind, rows in self.normalised.items()}
        return Outcome(rmse, nees, counts, cpu_s)


def strip() -> Simulation:
    """5 % of the looks are outliers."""
    return simulate(STRIP, 1, ERRORS, observation_plan=TIES)


def block() -> Simulation:
    """The height of one control point is wrong by 6 m."""
    made = simulate(BLOCK, 2, ERRORS, observation_plan=replace(TIES, control=8))
    surveyed = made.surveyed_l.copy()
    surveyed[np.flatnonzero(np.array(made.points.role) == "control")[2], 2] += 6.0
    return replace(made, surveyed_l=surveyed)


def drifting() -> Simulation:
    """Tie points of one CCD line drift by 0.1 px a second."""
    made = simulate(STRIP, 3, ERRORS, observation_plan=replace(TIES, outlier_share=0.0))
    looks = made.images.looks
    mine = np.array([line.id for line in made.flight.camera.lines])[looks.ccd] == "F"
    wrong_px = np.where(mine, 0.1 * np.maximum(looks.time_s - 5.0, 0.0), 0.0)
    moved = replace(looks, sample=looks.sample + wrong_px)
    return replace(made, images=replace(made.images, looks=moved))


def window() -> Outcome:
    """A strip with self-calibration, a block with a wrong control point, a strip with tie points that drift."""
    flown, cpu_s, counts = Flown(), 0.0, {"refused": 0, "events": 0}
    for simulation, calibrated in ((strip(), True), (block(), False), (drifting(), False)):
        poses = navigate(simulation)
        begun = time.process_time()
        camera = tls(simulation.flight.camera) if calibrated else None
        result = adjust_online(simulation, poses, WindowOptions(grid_hz=5.0), camera, update_s=UPDATE_S)
        cpu_s += time.process_time() - begun
        for kind in ("live", "final", "whole"):
            flown.add_errors(kind, orientation_errors(simulation, getattr(result, kind)))
        for kind in ("live", "final", "whole"):
            flown.add_errors(f"{kind} points", point_errors(simulation, getattr(result, f"{kind}_points")))
        counts["refused"] += len(result.refused)
        counts["events"] += len(result.events)
    return flown.outcome(counts, cpu_s)


def navigation() -> Outcome:
    """The kinematic filter on the flights of the window, and inertial flights of two grades, 240 s each."""
    flown, cpu_s, findings = Flown(), 0.0, 0
    for simulation in (strip(), block()):
        begun = time.process_time()
        poses = navigate(simulation)
        cpu_s += time.process_time() - begun
        for kind, smoothed in (("filtered", False), ("smoothed", True)):
            flown.add_errors(kind, measured_errors(simulation, poses, smoothed))
    for seed, grade in ((1, TACTICAL), (2, MEMS)):
        motion, inertial, gnss, settings = inertial_flight(seed, grade, 240.0, 100)
        begun = time.process_time()
        (navigated,) = navigate_inertial(inertial, gnss, settings)
        cpu_s += time.process_time() - begun
        findings += len(navigated.findings)
        at_s = np.arange(120.0, 235.0, 0.5)
        for kind, trajectory in (("inertial filtered", navigated.filtered), ("inertial smoothed", navigated.best)):
            error = inertial_errors(trajectory, motion, at_s)
            flown.add(f"{kind}", error, np.mean((error / trajectory.sigmas(at_s)) ** 2, axis=1))
    return flown.outcome({"findings": findings}, cpu_s)


def matching() -> Outcome:
    """One strip of three CCD lines of 800 px, 15 s long."""
    settings = {"sensor": "ads40-small", "pixels": 800, "images": True, "seconds": 15.0, "lead_in": 2.0, "seed": 3}
    made = simulated_flight({**settings, "height": 800.0})
    assert made.imager is not None
    flight = made.simulation.flight
    lines = flight.strips[0].lines
    images = [made.imager.render(0, ccd, 0, lines) for ccd in range(len(flight.camera.lines))]
    begun = time.process_time()
    matched = match_strip(flight, images)
    cpu_s = time.process_time() - begun
    error, sigma = tie_errors(flight, matched.ties)
    good = (np.abs(error) < WRONG_PX).all(axis=1)
    flown = Flown()
    flown.add("line and sample", error[good], np.mean((error[good] / sigma[good]) ** 2, axis=1))
    return flown.outcome({"tie points": len(matched.ties), "wrong": int(np.sum(~good))}, cpu_s)


FLIGHTS: dict[str, Callable[[], Outcome]] = {"window": window, "navigation": navigation, "matching": matching}
