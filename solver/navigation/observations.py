"""What can be observed of a navigator's state: each observation gives its innovation, its derivative and its noise.

Derivatives are with respect to the errors of `StateLayout`: position (m), velocity (m/s), attitude (a small rotation
vector ``psi`` in Earth-fixed axes, ``true = exp([psi]) estimated``), then parameters of the sensors. All have ``kind``
(the name in statistics), ``gated`` (whether a too large innovation is weighted down or refused) and ``axes`` (3, 3) in
which innovations are shown, None for the Earth-fixed ones.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..geometry import earth
from ..geometry.rotation import cross, skew
from .error_state import ATTITUDE, POSITION, VELOCITY, Estimate, StateLayout
from .strapdown import OMEGA_IE

Array = NDArray[np.floating]


@dataclass(frozen=True)
class AntennaPosition:
    """Position of the antenna.

    Attributes
    ----------
    position_e : (3,) metres
    covariance_e : (3, 3) m2
    axes : (3, 3) Earth-fixed to north-east-down
    """

    position_e: Array
    covariance_e: Array
    axes: Array | None = None
    kind: str = "position"
    gated: bool = True

    def linearise(self, estimate: Estimate, layout: StateLayout) -> tuple[Array, Array, Array]:
        s = estimate.state
        arm = s.R_eb @ estimate.lever_arm_b
        H = np.zeros((3, layout.n))
        H[:, POSITION] = np.eye(3)
        H[:, ATTITUDE] = -skew(arm)
        if layout.with_lever_arm:
            H[:, layout.lever_arm] = s.R_eb
        innovation = self.position_e - s.r_e - arm
        if layout.with_wander:
            H[:, layout.wander] = np.eye(3, 6)
            innovation = innovation - estimate.wander_e[:3]
        return innovation, H, self.covariance_e


@dataclass(frozen=True)
class AntennaVelocity:
    """Velocity of the antenna relative to the Earth.

    Attributes
    ----------
    velocity_e : (3,) m/s, Earth-fixed axes
    covariance_e : (3, 3) (m/s)2
    rate_ib : (3,) angular rate as measured, body axes, rad/s
    axes : (3, 3) Earth-fixed to north-east-down
    """

    velocity_e: Array
    covariance_e: Array
    rate_ib: Array
    axes: Array | None = None
    kind: str = "velocity"
    gated: bool = True

    def linearise(self, estimate: Estimate, layout: StateLayout) -> tuple[Array, Array, Array]:
        s, arm = estimate.state, estimate.lever_arm_b
        rate = self.rate_ib - estimate.gyro[:3]
        if layout.k == 6:
            rate = rate / (1.0 + estimate.gyro[3:])
        # the Earth's rotation turns with the platform in the derivative below too, but that is 1e-4 of a lever arm
        turning = rate - s.R_eb.T @ OMEGA_IE
        swing = s.R_eb @ cross(turning, arm)
        H = np.zeros((3, layout.n))
        H[:, VELOCITY] = np.eye(3)
        H[:, ATTITUDE] = -skew(swing)
        by_bias = s.R_eb @ skew(arm)
        # three parameters of the gyroscopes are biases, six are biases and scale factors
        H[:, layout.gyro] = by_bias if layout.k == 3 else np.hstack([by_bias, by_bias * rate])
        if layout.with_lever_arm:
            H[:, layout.lever_arm] = s.R_eb @ skew(turning)
        innovation = self.velocity_e - s.v_e - swing
        if layout.with_wander:  # a velocity has the rate of the slow error
            H[:, layout.wander] = np.eye(3, 6, 3)
            innovation = innovation - estimate.wander_e[3:]
        return innovation, H, self.covariance_e


@dataclass(frozen=True)
class ZeroVelocity:
    """The platform stands: velocity relative to the Earth is zero, to ``sigma_m_s``."""

    sigma_m_s: float
    kind: str = "zero velocity"
    gated: bool = True
    axes: Array | None = None

    def linearise(self, estimate: Estimate, layout: StateLayout) -> tuple[Array, Array, Array]:
        H = np.zeros((3, layout.n))
        H[:, VELOCITY] = np.eye(3)
        return -estimate.state.v_e, H, np.eye(3) * self.sigma_m_s**2


@dataclass(frozen=True)
class Heading:
    """Heading of the body from two antennas, an attitude unit, or a compass less its declination.

    It has no meaning where the body's forward axis is vertical.

    Attributes
    ----------
    heading : radians, clockwise from true north
    sigma : radians
    """

    heading: float
    sigma: float
    kind: str = "heading"
    gated: bool = True
    axes: Array | None = None

    def linearise(self, estimate: Estimate, layout: StateLayout) -> tuple[Array, Array, Array]:
        s = estimate.state
        g = earth.geodetic_from_ecef(s.r_e)
        R_ne = earth.R_en(g[0], g[1]).T
        forward = R_ne @ s.R_eb[:, 0]
        horizontal2 = forward[0] ** 2 + forward[1] ** 2
        innovation = (self.heading - np.arctan2(forward[1], forward[0]) + np.pi) % (2 * np.pi) - np.pi
        # d forward = psi_n x forward; d heading = (f_n df_e - f_e df_n) / horizontal2
        d_heading = np.array([-forward[1], forward[0], 0.0]) / horizontal2 @ -skew(forward)
        H = np.zeros((1, layout.n))
        H[0, ATTITUDE] = d_heading @ R_ne
        return np.array([innovation]), H, np.array([[self.sigma**2]])
