"""Poses of an on-line navigator: how it answers, and its states as poses of the camera with their validity."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..geometry.frames import LocalFrame
from ..geometry.rotation import R_ENU_NED, quaternion_from_angles
from .carried import CameraMount, NavigationStates, camera_poses
from .inertial_data import GnssData
from .pose import NavigationPose

Array = NDArray[np.floating]


@dataclass(frozen=True)
class OnlineOptions:
    """How an on-line navigator answers.

    Attributes
    ----------
    pose_step_s : distance of poses
    filtered_s : least distance of filtered poses; 0 = all
    lag_s : smoothed poses come so much later
    smooth_every_s : how often they come
    rewind_s : how late a fix may be
    step_s : longest distance of nodes
    valid_position_m, valid_attitude_rad : a pose with larger standard deviations is not valid
    patience_s : so long the alignment waits for turns before it takes a given attitude or the course
    longest_alignment_s : of this much past data the alignment makes use
    offset_sigma_m : constant error of GNSS positions, local X, Y, Z, that no data show; it is added to the covariance
    """

    pose_step_s: float = 0.02
    filtered_s: float = 0.0
    lag_s: float = 5.0
    smooth_every_s: float = 1.0
    rewind_s: float = 2.0
    step_s: float = 0.25
    valid_position_m: float = 3.0
    valid_attitude_rad: float = float(np.radians(2.0))
    patience_s: float = 25.0
    longest_alignment_s: float = 130.0
    offset_sigma_m: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        if not self.lag_s >= self.rewind_s:
            raise ValueError(f"lag_s {self.lag_s} is shorter than rewind_s {self.rewind_s}: late fixes would be lost")


@dataclass(frozen=True)
class PoseMaker:
    """States of the inertial sensor as poses of the camera.

    Attributes
    ----------
    frame : local frame of the poses
    mount : of the camera
    options : how uncertain a valid pose may be
    """

    frame: LocalFrame
    mount: CameraMount
    options: OnlineOptions

    def poses(self, states: NavigationStates, P: Array, rate_b: Array, smoothed: bool) -> list[NavigationPose]:
        """Poses from states at m times, the covariance (m, 9, 9) of ``dr, dv, psi``, and the angular rate (m, 3)."""
        o, frame = self.options, self.frame
        poses = camera_poses(states, P, frame, self.mount)
        covariance = poses.covariance + np.diag([*np.square(o.offset_sigma_m), 0.0, 0.0, 0.0])
        velocity = states.v_e @ frame.R_el
        if any(self.mount.lever_arm_b):  # the camera swings about the inertial sensor
            swing = np.cross(rate_b, self.mount.lever_arm_b)
            velocity = velocity + np.einsum("mij,mj->mi", states.R_eb, swing) @ frame.R_el
        q = quaternion_from_angles(poses.angles)
        limit = np.array([*(3 * [o.valid_position_m]), *(3 * [o.valid_attitude_rad])]) ** 2
        large = np.einsum("mii->mi", covariance) > limit
        where, how = large[:, :3].any(axis=1).tolist(), large[:, 3:].any(axis=1).tolist()
        reasons = [
            "position uncertain" if a else "attitude uncertain" if b else "" for a, b in zip(where, how, strict=True)
        ]
        rows = zip(
            states.time_s.tolist(), poses.position_l, poses.angles, q, velocity, covariance, reasons, strict=True
        )
        return [
            NavigationPose(t, x, a, q_i, v, P_i, not reason, reason, smoothed) for t, x, a, q_i, v, P_i, reason in rows
        ]

    def unaligned(self, time_s: float, fix: GnssData, arm_m: float, reason: str) -> NavigationPose:
        """A pose that is not valid: the place of the antenna, nothing known of the attitude.

        Parameters
        ----------
        fix : the newest one
        arm_m : length of the antenna's lever arm
        reason : why there is no better one
        """
        position = self.frame.from_geodetic(np.degrees(fix.lat[0]), np.degrees(fix.lon[0]), fix.height_m[0])
        size = arm_m + float(np.linalg.norm(self.mount.lever_arm_b))
        angles = np.zeros(3)
        covariance = np.diag([*(fix.sigma_ned_m[0] ** 2 + size**2), *(3 * [np.pi**2 / 3.0])])
        covariance[:3, :3] = R_ENU_NED @ covariance[:3, :3] @ R_ENU_NED.T
        q = quaternion_from_angles(angles)
        return NavigationPose(time_s, position, angles, q, np.zeros(3), covariance, False, reason, False)
