"""Earth-fixed pose of a satellite: orbit and attitude, each in whatever frame it is given in."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..geometry.earth import ROTATION_RATE
from ..geometry.rotation import cross
from .attitude import Attitude
from .ephemeris import Orbit

Array = NDArray[np.floating]

#: Frames of an orbit, and of an attitude; "o" is the orbital frame with the inertial velocity, "orbital-e" the one that
#: SPOT-5 takes, with the velocity over the rotating Earth.
ORBIT_FRAMES = ("e", "i")
ATTITUDE_FRAMES = ("e", "i", "o", "orbital-e")


class EarthRotation(Protocol):
    """Rotation between the inertial and the Earth-fixed frame."""

    def R_ie(self, time_s: ArrayLike) -> Array:
        """Rotation matrices (n, 3, 3), Earth-fixed to inertial, at times (n,)."""
        ...


@dataclass(frozen=True)
class FixedPoses:
    """Pose at n times, Earth-fixed.

    Attributes
    ----------
    position_e : (n, 3) metres
    velocity_e : (n, 3) m/s, over the rotating Earth
    R_eb : (n, 3, 3)
    """

    position_e: Array
    velocity_e: Array
    R_eb: Array


class Motion:
    """Orbit and attitude joined.

    Parameters
    ----------
    orbit : positions and velocities
    attitude : rotations from the body to ``attitude_frame``
    orbit_frame : "e" or "i"
    attitude_frame : "e", "i", "o" or "orbital-e" (see `ATTITUDE_FRAMES`)
    earth : needed where one of the frames is inertial and the other is not
    rotation_rate : of the planet about its z axis, rad/s

    Raises
    ------
    ValueError : an unknown frame, or inertial data without the rotation of the Earth; orbit and attitude that have no
        time in common
    """

    def __init__(
        self,
        orbit: Orbit,
        attitude: Attitude,
        orbit_frame: str = "e",
        attitude_frame: str = "e",
        earth: EarthRotation | None = None,
        rotation_rate: float = ROTATION_RATE,
    ):
        if orbit_frame not in ORBIT_FRAMES:
            raise ValueError(f"orbit frame {orbit_frame!r}, wanted one of {', '.join(ORBIT_FRAMES)}")
        if attitude_frame not in ATTITUDE_FRAMES:
            raise ValueError(f"attitude frame {attitude_frame!r}, wanted one of {', '.join(ATTITUDE_FRAMES)}")
        if earth is None and "i" in (orbit_frame, attitude_frame):
            raise ValueError("an orbit or attitude in the inertial frame needs the rotation of the Earth")
        self.start_s = max(orbit.start_s, attitude.start_s)
        self.end_s = min(orbit.end_s, attitude.end_s)
        if not self.start_s < self.end_s:
            raise ValueError(
                f"orbit [{orbit.start_s:.3f}, {orbit.end_s:.3f}] s and attitude [{attitude.start_s:.3f}, "
                f"{attitude.end_s:.3f}] s have no time in common"
            )
        self.orbit, self.attitude, self.earth = orbit, attitude, earth
        self.orbit_frame, self.attitude_frame = orbit_frame, attitude_frame
        self.omega_e = np.array([0.0, 0.0, rotation_rate])

    def at(self, time_s: ArrayLike) -> FixedPoses:
        """Pose at times (n,).

        Raises
        ------
        ValueError : a time outside orbit or attitude
        """
        t = np.atleast_1d(np.asarray(time_s, dtype=float))
        position, velocity = self.orbit.at(t)
        R_ei = None
        if self.earth is not None and "i" in (self.orbit_frame, self.attitude_frame):
            R_ei = np.swapaxes(self.earth.R_ie(t), -1, -2)
        if self.orbit_frame == "i":
            assert R_ei is not None
            position, velocity = (np.einsum("nij,nj->ni", R_ei, x) for x in (position, velocity))
            velocity = velocity - cross(self.omega_e, position)
        R = self.attitude.at(t)
        if self.attitude_frame == "i":
            assert R_ei is not None
            R = R_ei @ R
        elif self.attitude_frame == "o":
            R = R_from_orbital(position, self.inertial_velocity(position, velocity)) @ R
        elif self.attitude_frame == "orbital-e":
            R = R_from_orbital(position, velocity) @ R
        return FixedPoses(position, velocity, R)

    def inertial_velocity(self, position_e: Array, velocity_e: Array) -> Array:
        """Velocity against the stars with components in Earth-fixed axes, ``v_e + omega x r_e`` [D 4.24]."""
        return velocity_e + cross(self.omega_e, position_e)


def turned_on(R: Array, before: Array, share: Array) -> Array:
    """Rotations (n, 3, 3) that go on by shares (n,) of the turn that leads from others (n, 3, 3) to them."""
    from scipy.spatial.transform import Rotation

    turn = Rotation.from_matrix(R @ np.swapaxes(before, 1, 2)).as_rotvec()
    return Rotation.from_rotvec(share[:, None] * turn).as_matrix() @ R


def R_from_orbital(position: ArrayLike, velocity: ArrayLike) -> Array:
    """Rotations (n, 3, 3) from the orbital frame to that of position and velocity (n, 3) [D 4.25-4.28].

    ``Z = -r/|r|``, ``Y = -(r x v)/|r x v|``, ``X = Y x Z``.
    """
    r, v = np.asarray(position, dtype=float), np.asarray(velocity, dtype=float)
    z = -r / np.linalg.norm(r, axis=-1, keepdims=True)
    y = -cross(r, v)
    y = y / np.linalg.norm(y, axis=-1, keepdims=True)
    return np.stack([cross(y, z), y, z], axis=-1)
