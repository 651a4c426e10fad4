"""The engines of the navigator, made from a Project message: kinematic (attitude and GNSS) and inertial (raw data)."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..solver.inertial_data import InertialGrade
from ..solver.inertial_navigator import InertialNavigator, OnlineOptions
from ..solver.kinematic import KinematicFilter, KinematicOptions
from ..solver.navigation import NavigationSettings
from ..solver.navigation_trajectory import CameraMount
from . import convert


def kinematic_engine(project: Any) -> KinematicFilter:
    """The engine for attitude and GNSS input."""
    slow = convert.slow_errors_of(project)
    options = KinematicOptions(
        lever_arm_b=convert.lever_arm_of(project),
        R_bc=convert.R_bc_of(project),
        offset_sigma_m=np.array(slow.offset_m),
        wander_sigma_m=np.array(slow.wander_m),
        wander_time_s=slow.wander_time_s,
        attitude_sigma=slow.attitude_sigma,
    )
    return KinematicFilter(convert.local_frame(project), options)


def inertial_engine(project: Any, first_sample: Any, **options: float) -> InertialNavigator:
    """The engine for raw inertial data; its noise is what the first sample says.

    A project knows the antenna from the perspective centre, so the inertial sensor is taken to sit there.
    """
    slow = convert.slow_errors_of(project)
    east, north, up = slow.wander_m
    forward, right, down = (float(v) for v in convert.lever_arm_of(project))
    root = (first_sample.interval_ns * 1e-9) ** 0.5
    settings = NavigationSettings(
        grade=InertialGrade.of_noise(first_sample.rate_sigma * root, first_sample.force_sigma * root),
        lever_arm_b=(forward, right, down),
        wander_sigma_ned_m=(north, east, up),
        wander_time_s=slow.wander_time_s,
    )
    mount = CameraMount(R_bc=convert.R_bc_of(project))
    answer = OnlineOptions(offset_sigma_m=slow.offset_m, **options)  # pyright: ignore[reportArgumentType]
    return InertialNavigator(convert.local_frame(project), settings, mount, answer)
