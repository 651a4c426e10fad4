"""Pose, velocity and covariance at any time between the nodes of a filter or smoother, carried by the inertial data."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..geometry import earth
from ..geometry.frames import LocalFrame
from ..geometry.rotation import (
    R_BC_NOMINAL,
    angles_from_matrix,
    angles_jacobian,
    cross,
    matrix_from_quaternion,
    navigation_from_matrix,
    quaternion_from_matrix,
    quaternion_from_vector,
    quaternion_multiply,
    skew,
    vector_from_quaternion,
)
from .filter_pass import Carried, Estimates, FilterPass
from .smoother import Smoothed
from .strapdown import OMEGA_IE

Array = NDArray[np.floating]


@dataclass(frozen=True)
class NavigationStates:
    """Position, velocity and attitude of the inertial sensor at m times.

    Attributes
    ----------
    time_s : (m,)
    r_e, v_e : (m, 3) Earth-fixed, metres, m/s
    R_eb : (m, 3, 3)
    """

    time_s: Array
    r_e: Array
    v_e: Array
    R_eb: Array

    @property
    def geodetic(self) -> Array:
        """Latitude, longitude (radians), height, (m, 3)."""
        return earth.geodetic_from_ecef(self.r_e)

    @property
    def R_ne(self) -> Array:
        g = self.geodetic
        return np.swapaxes(earth.R_en(g[:, 0], g[:, 1]), -1, -2)

    @property
    def velocity_n(self) -> Array:
        return _apply(self.R_ne, self.v_e)

    @property
    def angles(self) -> Array:
        """Roll, pitch, heading (m, 3), radians."""
        return navigation_from_matrix(self.R_ne @ self.R_eb)


@dataclass(frozen=True)
class CameraMount:
    """Where the camera sits.

    Attributes
    ----------
    lever_arm_b : (3,) perspective centre from the inertial sensor, body axes, metres
    R_bc : (3, 3) image frame to body: nominal, or with boresight
    """

    lever_arm_b: tuple[float, float, float] = (0.0, 0.0, 0.0)
    R_bc: Array | None = None

    @property
    def rotation(self) -> Array:
        return R_BC_NOMINAL if self.R_bc is None else np.asarray(self.R_bc)


@dataclass(frozen=True)
class CameraPoses:
    """Poses of the camera in a local frame.

    Attributes
    ----------
    time_s : (m,)
    position_l : (m, 3) metres
    angles : (m, 3) omega, phi, kappa, radians
    covariance : (m, 6, 6) of X, Y, Z, omega, phi, kappa; metres and radians
    """

    time_s: Array
    position_l: Array
    angles: Array
    covariance: Array


class NavigationTrajectory:
    """The trajectory of a filter, or of a smoother, at any time.

    Between two nodes the state at the first is carried on by the inertial data; what is missing to the state at the
    end of the block (sensor errors, process noise) is spread over it, in attitude on the rotation group. Covariances
    are linear in time between nodes.

    Parameters
    ----------
    start, end : (N) estimates at the start of each block, and (N) at the end of the block that leads to a node, the
        first unused
    P_start, P_end : (N, n, n)
    carried : inertial integrals
    """

    def __init__(
        self,
        start: Estimates,
        end: Estimates,
        P_start: Array,
        P_end: Array,
        carried: Carried,
    ):
        self.nodes, self._end = start, end
        self.P, self._P_end = P_start, P_end
        self._carried = carried
        self._q = np.concatenate([[[0.0, 0.0, 0.0, 1.0]], carried.quaternion])
        self._vp = np.concatenate([np.zeros((1, 7)), np.column_stack([carried.duration_s, carried.v, carried.p])])
        last = np.searchsorted(
            carried.block, np.arange(len(start) - 1), side="right"
        )  # row behind each block's last piece
        total = matrix_from_quaternion(self._q[last]), self._vp[last, 1:4], self._vp[last, 4:7]
        self._duration = self._vp[last, 0]
        self._gamma0 = gravitation(start.r_e[:-1])
        C = _earth_rotations(self._duration)
        self._gamma1 = _apply(np.swapaxes(C, -1, -2), gravitation(end.r_e[1:]))
        none = np.zeros((0, 3))
        self._miss: tuple[Array, Array, Array] = (none, none, none)
        r, v, R = self._carry(np.arange(len(start) - 1), self._duration, *total)
        turn = vector_from_quaternion(quaternion_from_matrix(end.R_eb[1:] @ np.swapaxes(R, -1, -2)))
        self._miss = (end.r_e[1:] - r, end.v_e[1:] - v, turn)

    @classmethod
    def filtered(cls, forward: FilterPass) -> NavigationTrajectory:
        """Trajectory as the filter knew it at each time."""
        return cls(forward.posterior, forward.prior, forward.P_posterior, forward.P_prior, forward.carried)

    @classmethod
    def smoothed(cls, forward: FilterPass, s: Smoothed) -> NavigationTrajectory:
        """Trajectory after smoothing."""
        return cls(s.estimates, s.estimates, s.P, s.P, forward.carried)

    @property
    def start_s(self) -> float:
        return float(self.nodes.time_s[0])

    @property
    def end_s(self) -> float:
        return float(self.nodes.time_s[-1])

    @property
    def sample_times(self) -> Array:
        """Ends of all inertial samples and nodes."""
        return self._carried.time_s

    def at(self, time_s: ArrayLike) -> NavigationStates:
        """States at times (m,).

        Raises
        ------
        ValueError : a time outside the trajectory
        """
        t = self._inside(time_s)
        c = self._carried
        piece = np.minimum(np.searchsorted(c.time_s, t - 1e-10), len(c.time_s) - 1)
        k = c.block[piece]
        before = np.where((piece > 0) & (c.block[piece - 1] == k), piece, 0)  # rows are shifted by one: 0 is the start
        q0, row = self._q[before], self._vp[before]
        dt = np.clip(t - self.nodes.time_s[k] - row[:, 0], 0.0, c.dt_s[piece])
        share = (dt / c.dt_s[piece])[:, None]
        phi, dv = share * c.phi[piece], share * c.dv[piece]
        R0 = matrix_from_quaternion(q0)
        R = matrix_from_quaternion(quaternion_multiply(q0, quaternion_from_vector(phi)))
        turned = cross(phi, dv)
        v = row[:, 1:4] + _apply(R0, dv + 0.5 * turned)
        p = row[:, 4:7] + dt[:, None] * (row[:, 1:4] + _apply(R0, dv / 2.0 + turned / 6.0))
        r_e, v_e, R_eb = self._carry(k, row[:, 0] + dt, R, v, p)
        return NavigationStates(t, r_e, v_e, R_eb)

    def rates(self, time_s: ArrayLike) -> Array:
        """Angular rate (m, 3) as measured, body axes, rad/s, of the pieces that times lie in."""
        c = self._carried
        rows = np.minimum(np.searchsorted(c.time_s, np.asarray(time_s) - 1e-7), len(c.time_s) - 1)
        return c.phi[rows] / c.dt_s[rows, None]

    def at_rows(self, rows: NDArray[np.intp]) -> NavigationStates:
        """States at the ends of given pieces (rows of the integrals)."""
        c = self._carried
        R = matrix_from_quaternion(c.quaternion[rows])
        r_e, v_e, R_eb = self._carry(c.block[rows], c.duration_s[rows], R, c.v[rows], c.p[rows])
        return NavigationStates(c.time_s[rows], r_e, v_e, R_eb)

    def covariance(self, time_s: ArrayLike) -> Array:
        """Covariance of ``dr, dv, psi`` (m, 9, 9), Earth-fixed, at times (m,)."""
        k, s = self._share(time_s)
        s = s[:, None, None]
        return (1.0 - s) * self.P[k, :9, :9] + s * self._P_end[k + 1, :9, :9]

    def sigmas(self, time_s: ArrayLike) -> Array:
        """Standard deviations (m, 9): position and velocity north, east, down; roll, pitch, heading (radians)."""
        both = []
        for e, P in ((self.nodes, self.P), (self._end, self._P_end)):
            states = NavigationStates(e.time_s, e.r_e, e.v_e, e.R_eb)
            J = navigation_jacobian(states)
            both.append(np.einsum("nij,njk,nik->ni", J, P[:, :9, :9], J))
        k, s = self._share(time_s)
        return np.sqrt(np.maximum((1.0 - s[:, None]) * both[0][k] + s[:, None] * both[1][k + 1], 0.0))

    def camera(self, time_s: ArrayLike, frame: LocalFrame, mount: CameraMount | None = None) -> CameraPoses:
        """Poses of a camera at times (m,), with covariance."""
        states = self.at(time_s)
        return camera_poses(states, self.covariance(states.time_s), frame, mount or CameraMount())

    def _inside(self, time_s: ArrayLike) -> Array:
        t = np.atleast_1d(np.asarray(time_s, dtype=float))
        bad = ~((t >= self.start_s - 1e-9) & (t <= self.end_s + 1e-9))
        if bad.any():
            raise ValueError(f"time {t[bad][0]:.6f} s outside the trajectory [{self.start_s:.6f}, {self.end_s:.6f}] s")
        return t

    def _share(self, time_s: ArrayLike) -> tuple[NDArray[np.intp], Array]:
        t = self._inside(time_s)
        k = np.clip(np.searchsorted(self.nodes.time_s, t - 1e-10) - 1, 0, len(self.nodes) - 2)
        return k, np.clip((t - self.nodes.time_s[k]) / self._duration[k], 0.0, 1.0)

    def _carry(self, k: NDArray[np.intp], t: Array, R: Array, v: Array, p: Array) -> tuple[Array, Array, Array]:
        """States at a time ``t`` into block ``k``, from running integrals, with the miss at its end spread over it."""
        e = self.nodes
        T, tc = self._duration[k][:, None], t[:, None]
        R_ib, r0 = e.R_eb[k], e.r_e[k]
        v0 = e.v_e[k] + cross(OMEGA_IE, r0)
        g0, dg = self._gamma0[k], (self._gamma1[k] - self._gamma0[k]) / T
        C = _earth_rotations(t)
        r_e = _apply(C, r0 + tc * v0 + _apply(R_ib, p) + tc**2 * (g0 / 2.0 + tc * dg / 6.0))
        v_e = _apply(C, v0 + _apply(R_ib, v) + tc * (g0 + tc * dg / 2.0)) - cross(OMEGA_IE, r_e)
        R_eb = C @ R_ib @ R
        if len(self._miss[0]):
            s = tc / T
            mr, mv, turn = (m[k] for m in self._miss)
            r_e = r_e + (3.0 - 2.0 * s) * s**2 * mr + (s - 1.0) * s**2 * T * mv
            v_e = v_e + (6.0 * s * (1.0 - s) / T) * mr + (3.0 * s - 2.0) * s * mv
            R_eb = matrix_from_quaternion(quaternion_from_vector(s * turn)) @ R_eb
        return r_e, v_e, R_eb


def passed_over(
    before: NavigationStates, P_before: Array, states: NavigationStates, P: Array, start_s: float, length_s: float
) -> tuple[NavigationStates, Array]:
    """From one smoothed trajectory to the next, which knows more, without a step: the share of the next grows smoothly.

    Parameters
    ----------
    before, P_before : the trajectory that held up to ``start_s``, at later times, with the covariance (k, 9, 9) of
        ``dr, dv, psi``
    states, P : the next, at times (m,); of the times of the passage those that ``before`` has not are left out
    start_s, length_s : when the passage begins, and how long it takes

    Returns
    -------
    states, P : the passage and what follows. A weighted mean is no more uncertain than the weighted mean of the
        covariances says.
    """
    t = states.time_s
    end = min(start_s + length_s, float(before.time_s[-1])) if len(before.time_s) else start_s
    inside = t < end
    row = np.clip(np.searchsorted(before.time_s, t - 1e-7), 0, max(len(before.time_s) - 1, 0))
    known = np.array([], dtype=bool) if not inside.any() else np.abs(before.time_s[row[inside]] - t[inside]) < 1e-7
    keep = ~inside
    keep[inside] = known
    r, v, R, P = states.r_e[keep], states.v_e[keep], states.R_eb[keep], P[keep]
    n, old = int(known.sum()), row[inside][known]
    s = ((t[inside][known] - start_s) / length_s)[:, None]
    w, slope = s * s * (3.0 - 2.0 * s), 6.0 * s * (1.0 - s) / length_s
    change = r[:n] - before.r_e[old]
    r[:n] = before.r_e[old] + w * change
    v[:n] = before.v_e[old] + w * (v[:n] - before.v_e[old]) + slope * change
    if n:
        turn = vector_from_quaternion(quaternion_from_matrix(R[:n] @ np.swapaxes(before.R_eb[old], -1, -2)))
        R[:n] = matrix_from_quaternion(quaternion_from_vector(w * turn)) @ before.R_eb[old]
        P[:n] += (1.0 - w[:, :, None]) * (P_before[old] - P[:n])
    return NavigationStates(t[keep], r, v, R), P


def gravitation(r_e: Array) -> Array:
    """Gravitation (m, 3), m/s^2, at Earth-fixed positions (m, 3), m."""
    g = earth.geodetic_from_ecef(r_e)
    w2 = earth.ROTATION_RATE**2 * np.array([1.0, 1.0, 0.0])
    return np.einsum("mij,mj->mi", earth.R_en(g[:, 0], g[:, 1]), earth.gravity_n(g[:, 0], g[:, 2])) - w2 * r_e


def navigation_jacobian(states: NavigationStates) -> Array:
    """Derivative (m, 9, 9) of position and velocity (north, east, down) and roll, pitch, heading with respect to
    ``dr, dv, psi``."""
    R_ne = states.R_ne
    rpy = navigation_from_matrix(R_ne @ states.R_eb)
    sp, cp = np.sin(rpy[:, 1]), np.cos(rpy[:, 1])
    sh, ch = np.sin(rpy[:, 2]), np.cos(rpy[:, 2])
    axes = np.zeros((len(rpy), 3, 3))  # columns: where roll, pitch and heading turn about
    axes[:, 0, 0], axes[:, 1, 0], axes[:, 2, 0] = ch * cp, sh * cp, -sp
    axes[:, 0, 1], axes[:, 1, 1] = -sh, ch
    axes[:, 2, 2] = 1.0
    J = np.zeros((len(rpy), 9, 9))
    J[:, :3, :3] = J[:, 3:6, 3:6] = R_ne
    J[:, 6:, 6:] = np.linalg.solve(axes, R_ne)
    return J


def camera_jacobian(states: NavigationStates, frame: LocalFrame, mount: CameraMount) -> Array:
    """Derivative (m, 6, 9) of X, Y, Z, omega, phi, kappa of a camera with respect to ``dr, dv, psi``."""
    R_le = frame.R_el.T
    R_lb = R_le @ states.R_eb
    J = np.zeros((len(states.time_s), 6, 9))
    J[:, :3, :3] = R_le
    J[:, :3, 6:] = -skew(R_lb @ np.asarray(mount.lever_arm_b)) @ R_le
    J[:, 3:, 6:] = angles_jacobian(angles_from_matrix(R_lb @ mount.rotation)) @ R_le
    return J


def camera_poses(states: NavigationStates, P: Array, frame: LocalFrame, mount: CameraMount) -> CameraPoses:
    """Poses of a camera from states of the inertial sensor and the covariance (m, 9, 9) of ``dr, dv, psi``."""
    R_lb = frame.R_el.T @ states.R_eb
    position = (states.r_e - frame.origin_e) @ frame.R_el + R_lb @ np.asarray(mount.lever_arm_b)
    J = camera_jacobian(states, frame, mount)
    return CameraPoses(
        states.time_s, position, angles_from_matrix(R_lb @ mount.rotation), J @ P @ np.swapaxes(J, -1, -2)
    )


def _apply(R: Array, v: Array) -> Array:
    return (R @ v[..., None])[..., 0]


def _earth_rotations(t: Array) -> Array:
    a = earth.ROTATION_RATE * t
    C = np.zeros((len(t), 3, 3))
    C[:, 0, 0] = C[:, 1, 1] = np.cos(a)
    C[:, 0, 1], C[:, 1, 0] = np.sin(a), -np.sin(a)
    C[:, 2, 2] = 1.0
    return C
