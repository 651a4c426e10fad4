"""Simulated flights with inertial and GNSS data for the navigation tests; each is made once."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np

from triline.solver.geometry import earth
from triline.solver.navigation.carried import NavigationTrajectory
from triline.solver.navigation.error_state import NavigationSettings
from triline.solver.navigation.inertial_data import MEMS, TACTICAL, GnssData, InertialData, InertialGrade
from triline.solver.simulation.inertial import TrueMotion, gnss_fixes, survey_flight, with_errors

ARM = (0.5, 0.1, -1.2)
GRADES = {"tactical": TACTICAL, "mems": MEMS}


@dataclass(frozen=True)
class SimulatedFlight:
    motion: TrueMotion
    inertial: InertialData
    gnss: GnssData
    settings: NavigationSettings
    gyro_bias: np.ndarray
    accel_bias: np.ndarray


@cache
def motion(duration_s: float, seed: int, static_s: float = 0.0, turbulence: float = 1.0, line_s: float = 60.0):
    rng = np.random.default_rng(seed)
    return survey_flight(duration_s, rng, static_s=static_s, turbulence=turbulence, line_s=line_s)


@cache
def flight(
    grade: str = "tactical",
    duration_s: float = 600.0,
    seed: int = 1,
    rate_hz: int = 200,
    sigma: tuple[float, float, float] = (0.02, 0.02, 0.04),
    velocity: bool = False,
    static_s: float = 0.0,
    turbulence: float = 1.0,
    line_s: float = 60.0,
) -> SimulatedFlight:
    rng = np.random.default_rng([seed, 77])
    true = motion(duration_s, seed, static_s, turbulence, line_s)
    unit: InertialGrade = GRADES[grade]
    time_s = 0.5 + np.arange(int((duration_s - 1.0) * rate_hz) + 1) / rate_hz
    measured, biases = with_errors(true.increments(time_s), unit, rng)
    fixes = gnss_fixes(
        true, np.arange(1.0, duration_s - 0.6) + 0.0037, sigma, rng, ARM, (0.03, 0.03, 0.05) if velocity else None
    )
    settings = NavigationSettings(unit, lever_arm_b=ARM)
    return SimulatedFlight(true, measured, fixes, settings, biases[0], biases[1])


def errors(trajectory: NavigationTrajectory, true: TrueMotion, time_s: np.ndarray) -> np.ndarray:
    """Errors (n, 9): position and velocity north, east, down (m, m/s), roll, pitch, heading (rad)."""
    states, truth = trajectory.at(time_s), true.at(time_s)
    position = np.einsum("nij,nj->ni", states.R_ne, states.r_e - truth.position_e)
    turn = (states.angles - truth.angles + np.pi) % (2 * np.pi) - np.pi
    return np.hstack([position, states.velocity_n - truth.velocity_n, turn])


def rms(x: np.ndarray) -> np.ndarray:
    return np.sqrt(np.mean(np.square(x), axis=0))


def true_start(true: TrueMotion, time_s: float):
    """Earth-fixed position, velocity and attitude (3,), (3,), (3, 3) at a time."""
    s = true.at(time_s)
    R_en = earth.R_en(s.lat[0], s.lon[0])
    return s.position_e[0], R_en @ s.velocity_n[0], R_en @ s.R_nb[0]
