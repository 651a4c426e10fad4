"""The engines of the navigator, made from a Project message: kinematic (attitude and GNSS) and inertial (raw data)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ...solver.navigation.carried import CameraMount
from ...solver.navigation.error_state import NavigationSettings
from ...solver.navigation.inertial_data import InertialGrade
from ...solver.navigation.inertial_navigator import InertialNavigator
from ...solver.navigation.kinematic import KinematicFilter, KinematicOptions
from ...solver.navigation.online_poses import OnlineOptions
from .. import convert
from ..formats.sensor_folder import usual_bias_time_s
from ..formats.track import MOST_LEVER_ARM_M


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
    for name, limit in convert.LARGEST_SIGMAS.items():
        value = getattr(sample, name)
        usable = 0.0 <= value < limit  # false for NaN
        noise.append(value * (sample.interval_ns * 1e-9) ** 0.5 if usable else 0.0)
        if not usable:
            wrong.append(f"{name} is {value:g}")
    text = f"{' and '.join(wrong)}: the noise of a MEMS unit is assumed instead" if wrong else ""
    return noise[0], noise[1], text


@dataclass(frozen=True)
class InertialUnit:
    """What messages do not say of an inertial unit.

    Attributes
    ----------
    camera_lever_arm_m : perspective centre from the unit, body axes
    gyro_bias_deg_h, accel_bias_mgal : of its data sheet, 1 sigma; 0 = as usual for its noise
    bias_time_s : correlation time of the biases; 0 = as usual for them
    gyro_scale_ppm, accel_scale_ppm : of scale factors, 1 sigma
    """

    camera_lever_arm_m: Sequence[float] = (0.0, 0.0, 0.0)
    gyro_bias_deg_h: float = 0.0
    accel_bias_mgal: float = 0.0
    bias_time_s: float = 0.0
    gyro_scale_ppm: float = 0.0
    accel_scale_ppm: float = 0.0

    def __post_init__(self) -> None:
        arm = [float(v) if isinstance(v, int | float) else np.nan for v in self.camera_lever_arm_m]
        if not (len(arm) == 3 and all(abs(v) <= MOST_LEVER_ARM_M for v in arm)):  # false for NaN
            wanted = f"3 numbers within {MOST_LEVER_ARM_M:g} m: forward, right, down"
            raise ValueError(f"camera_lever_arm_m is {self.camera_lever_arm_m}, wanted {wanted}")
        for name, value in vars(self).items():
            if name != "camera_lever_arm_m" and not 0.0 <= value < np.inf:
                raise ValueError(f"{name} is {value:g}, wanted 0 or more")

    def grade(self, gyro_noise: float, accel_noise: float) -> InertialGrade:
        """Error model for a white noise (rad/sqrt(s), m/s/sqrt(s); 0 = not known)."""
        usual = InertialGrade.of_noise(gyro_noise, accel_noise)
        time_s = self.bias_time_s or (usual_bias_time_s(self.gyro_bias_deg_h) if self.gyro_bias_deg_h else 0.0)
        return replace(
            usual,
            gyro_bias=float(np.radians(self.gyro_bias_deg_h)) / 3600.0 or usual.gyro_bias,
            accel_bias=self.accel_bias_mgal * 1e-5 or usual.accel_bias,
            bias_time_s=time_s or usual.bias_time_s,
            gyro_scale=self.gyro_scale_ppm * 1e-6,
            accel_scale=self.accel_scale_ppm * 1e-6,
        )


def inertial_engine(
    project: Any, first_sample: Any, unit: InertialUnit = InertialUnit(), **options: Any
) -> InertialNavigator:
    """The engine for raw inertial data; its noise is what the first sample says, of a MEMS unit where it says nothing.

    A project knows the antenna from the perspective centre; where that is from the inertial sensor is told beside it.
    Slow errors of GNSS positions, which no inertial data show, do not make a pose invalid.
    """
    slow = convert.slow_errors_of(project)
    east, north, up = slow.wander_m
    camera, antenna = np.asarray(unit.camera_lever_arm_m, dtype=float), convert.lever_arm_of(project)
    forward, right, down = (float(v) for v in camera + antenna)
    gyro_noise, accel_noise, _ = stated_noise(first_sample)
    grade = unit.grade(gyro_noise, accel_noise)
    settings = NavigationSettings(
        grade=grade,
        scale_factors=grade.gyro_scale > 0.0 or grade.accel_scale > 0.0,
        lever_arm_b=(forward, right, down),
        wander_sigma_ned_m=(north, east, up),
        wander_time_s=slow.wander_time_s,
    )
    x, y, z = (float(v) for v in camera)
    mount = CameraMount((x, y, z), convert.R_bc_of(project))
    limit = float(np.hypot(OnlineOptions.valid_position_m, slow.position_sigma.max()))
    options = {"offset_sigma_m": slow.offset_m, "valid_position_m": limit, **options}
    return InertialNavigator(convert.local_frame(project), settings, mount, OnlineOptions(**options))
