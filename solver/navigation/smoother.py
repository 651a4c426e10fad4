"""Rauch-Tung-Striebel smoothing of a filter pass; the on-line smoother with a fixed lag uses the same equations.

filterpy's `rts_smoother` wants the states of a linear filter. Here they are errors about an estimate that is
corrected at every update and turns on the rotation group, so the recursion runs on the errors; the gains of all
nodes, which cost most, are computed in one call.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..geometry.rotation import cross, matrix_from_quaternion, quaternion_from_vector
from .error_state import StateLayout
from .filter_pass import Estimates, FilterPass

Array = NDArray[np.floating]


@dataclass(frozen=True)
class Smoothed:
    """Smoothed nodes.

    Attributes
    ----------
    estimates : (N)
    P : (N, n, n)
    """

    estimates: Estimates
    P: Array


def gains(F: Array, P_posterior: Array, P_prior: Array) -> Array:
    """Smoother gains (N - 1, n, n) ``P_k F' inv(P_prior)`` of N nodes; scaled, since metres meet rad/s.

    What is known, and so has no variance, has no gain.
    """
    s = np.sqrt(np.einsum("kii->ki", P_prior[1:]))
    known = s <= 0.0
    s = np.where(known, 1.0, s)
    scaled = P_prior[1:] / (s[:, :, None] * s[:, None, :])
    node, place = np.nonzero(known)
    scaled[node, place, place] = 1.0
    G = np.linalg.solve(scaled, (F[1:] @ P_posterior[:-1]) / s[:, :, None])
    return np.swapaxes(G, -1, -2) / s[:, None, :]


def recurse(G: Array, P_posterior: Array, P_prior: Array, x: Array) -> tuple[Array, Array]:
    """Errors (N, n) that lead from the filtered to the smoothed estimates, and their covariances (N, n, n).

    Parameters
    ----------
    G : (N - 1, n, n) gains
    P_posterior, P_prior : (N, n, n)
    x : (N, n) errors that the observations at each node put in
    """
    N, n = x.shape
    d, P = np.zeros((N, n)), np.empty_like(P_posterior)
    P[-1] = P_posterior[-1]
    for k in range(N - 2, -1, -1):
        e = d[k + 1] + x[k + 1]
        e[6:9] += 0.5 * cross(d[k + 1, 6:9], x[k + 1, 6:9])  # one rotation after another, to second order
        g = G[k]
        d[k] = g @ e
        p = P_posterior[k] + g @ (P[k + 1] - P_prior[k + 1]) @ g.T
        P[k] = 0.5 * (p + p.T)
    return d, P


def corrected(estimates: Estimates, d: Array, layout: StateLayout) -> Estimates:
    """Estimates with errors (N, n) put in."""
    turn = matrix_from_quaternion(quaternion_from_vector(d[:, 6:9]))
    arm, wander = estimates.lever_arm_b, estimates.wander_e
    return Estimates(
        estimates.time_s,
        estimates.r_e + d[:, :3],
        estimates.v_e + d[:, 3:6],
        turn @ estimates.R_eb,
        estimates.gyro + d[:, layout.gyro],
        estimates.accel + d[:, layout.accel],
        arm + d[:, layout.lever_arm] if layout.with_lever_arm else arm,
        wander + d[:, layout.wander] if layout.with_wander else wander,
    )


def smooth(forward: FilterPass) -> Smoothed:
    """Smooth a filter pass over its whole length."""
    G = gains(forward.F, forward.P_posterior, forward.P_prior)
    d, P = recurse(G, forward.P_posterior, forward.P_prior, forward.x)
    return Smoothed(corrected(forward.posterior, d, forward.settings.layout), P)
