"""Inertial measurements, and GNSS velocities, of a simulated flight."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..geometry.rotation import R_ENU_NED
from ..navigation.inertial_data import InertialGrade
from .error_models import Three, antenna_position
from .flight import Flight
from .inertial import TrueMotion, with_errors

Array = NDArray[np.floating]

#: Step over which the antenna's velocity is differenced, seconds.
VELOCITY_STEP_S = 0.01


@dataclass(frozen=True)
class InertialPlan:
    """An inertial unit at the perspective centre, and a receiver that measures velocity.

    Attributes
    ----------
    grade : errors of the unit
    rate_hz : samples a second
    velocity_noise_m_s : white noise of GNSS velocities, local X, Y, Z
    """

    grade: InertialGrade
    rate_hz: float = 200.0
    velocity_noise_m_s: Three = (0.03, 0.03, 0.05)

    def __post_init__(self) -> None:
        if not self.rate_hz > 0:
            raise ValueError(f"inertial plan: rate_hz must be positive, got {self.rate_hz}")


@dataclass(frozen=True)
class InertialMeasurements:
    """Means over the intervals that end at the stamps; n samples, body forward-right-down.

    Attributes
    ----------
    plan : the unit
    time_s : (n,)
    force : (n, 3) specific force, m/s^2
    rate : (n, 3) angular rate, rad/s
    velocity_enu : (g, 3) velocities of the antenna as the receiver reports them, m/s
    """

    plan: InertialPlan
    time_s: Array
    force: Array
    rate: Array
    velocity_enu: Array


def measure_inertial(
    flight: Flight,
    R_bc: Array,
    lever_arm_b: Array,
    gnss_time_s: Array,
    gnss_error_rate: Array,
    plan: InertialPlan,
    rng: np.random.Generator,
) -> InertialMeasurements:
    """What an inertial unit and a receiver's velocity output measure.

    Parameters
    ----------
    gnss_error_rate : (g, 3) rate of the slow position errors at the GNSS times, m/s: velocities have the same errors

    Raises
    ------
    ValueError : a flight with interruptions
    """
    if len(flight.covered_s) != 1:
        raise ValueError("an inertial unit needs a flight without interruptions: fly the turns")
    truth, frame = flight.truth, flight.frame
    poses = truth.at(truth.time_s)
    R_nb = np.swapaxes(frame.R_ln(poses.position_l), -1, -2) @ poses.R_lc @ R_bc.T
    geodetic = frame.to_geodetic(poses.position_l)
    lat, lon = np.radians(geodetic[:, :2].T)
    motion = TrueMotion(truth.time_s, lat, lon, geodetic[:, 2], R_nb)
    data, _ = with_errors(motion.increments(flight.sample_times(plan.rate_hz)), plan.grade, rng)

    half = 0.5 * VELOCITY_STEP_S
    before, after = np.maximum(gnss_time_s - half, truth.start_s), np.minimum(gnss_time_s + half, truth.end_s)
    moved = antenna_position(truth, R_bc, lever_arm_b, after) - antenna_position(truth, R_bc, lever_arm_b, before)
    velocity_l = moved / (after - before)[:, None] + gnss_error_rate
    velocity_l += rng.standard_normal(velocity_l.shape) * plan.velocity_noise_m_s
    R_enu_l = R_ENU_NED.T @ np.swapaxes(frame.R_ln(antenna_position(truth, R_bc, lever_arm_b, gnss_time_s)), -1, -2)
    velocity_enu = np.einsum("nij,nj->ni", R_enu_l, velocity_l)
    dt = data.dt_s[:, None]
    return InertialMeasurements(plan, data.time_s, data.dv / dt, data.dtheta / dt, velocity_enu)
