"""The engines of the navigator, made from a Project message: kinematic (attitude and GNSS) and inertial (raw data)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ...solver.navigation.carried import CameraMount
from ...solver.navigation.error_state import NavigationSettings
from ...solver.navigation.inertial_data import InertialGrade
from ...solver.navigation.inertial_navigator import InertialNavigator
from ...solver.navigation.kinematic import KinematicFilter, KinematicOptions
from ...solver.navigation.online_poses import OnlineOptions
from .. import convert

#: A stated noise of a single sample beyond these is no noise of an inertial sensor: rad/s, m/s^2.
LARGEST_RATE_SIGMA, LARGEST_FORCE_SIGMA = 1.0, 50.0


def kinematic_engine(project: Any, filtered_s: float = 0.0) -> KinematicFilter:
    """The engine for attitude and GNSS input."""
    slow = convert.slow_errors_of(project)
    options = KinematicOptions(
        lever_arm_b=convert.lever_arm_of(project),
        R_bc=convert.R_bc_of(project),
        offset_sigma_m=np.array(slow.offset_m),
        wander_sigma_m=np.array(slow.wander_m),
        wander_time_s=slow.wander_time_s,
        attitude_sigma=slow.attitude_sigma,
        filtered_s=filtered_s,
    )
    return KinematicFilter(convert.local_frame(project), options)


def stated_noise(sample: Any) -> tuple[float, float, str]:
    """White noise that an Imu message states, rad/sqrt(s) and m/s/sqrt(s), 0 = not given; and what is wrong with it."""
    noise, wrong = [], []
    for name, limit in (("rate_sigma", LARGEST_RATE_SIGMA), ("force_sigma", LARGEST_FORCE_SIGMA)):
        value = getattr(sample, name)
        usable = 0.0 <= value < limit  # false for NaN
        noise.append(value * (sample.interval_ns * 1e-9) ** 0.5 if usable else 0.0)
        if not usable:
            wrong.append(f"{name} is {value:g}")
    text = f"{' and '.join(wrong)}: the noise of a MEMS unit is assumed instead" if wrong else ""
    return noise[0], noise[1], text


def inertial_engine(
    project: Any, first_sample: Any, camera_lever_arm_m: Sequence[float] = (0.0, 0.0, 0.0), **options: float
) -> InertialNavigator:
    """The engine for raw inertial data; its noise is what the first sample says, of a MEMS unit where it says nothing.

    A project knows the antenna from the perspective centre; where that is from the inertial sensor is told beside it.
    Slow errors of GNSS positions, which no inertial data show, do not make a pose invalid.
    """
    slow = convert.slow_errors_of(project)
    east, north, up = slow.wander_m
    camera, antenna = np.asarray(camera_lever_arm_m, dtype=float), convert.lever_arm_of(project)
    forward, right, down = (float(v) for v in camera + antenna)
    gyro_noise, accel_noise, _ = stated_noise(first_sample)
    settings = NavigationSettings(
        grade=InertialGrade.of_noise(gyro_noise, accel_noise),
        lever_arm_b=(forward, right, down),
        wander_sigma_ned_m=(north, east, up),
        wander_time_s=slow.wander_time_s,
    )
    x, y, z = (float(v) for v in camera)
    mount = CameraMount((x, y, z), convert.R_bc_of(project))
    limit = float(np.hypot(OnlineOptions.valid_position_m, slow.position_sigma.max()))
    answer = OnlineOptions(**{"offset_sigma_m": slow.offset_m, "valid_position_m": limit, **options})  # pyright: ignore
    return InertialNavigator(convert.local_frame(project), settings, mount, answer)
