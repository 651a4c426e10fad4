"""Forward pass of the navigation filter over a recording."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .error_state import ErrorStateFilter, Estimate, Innovation, NavigationSettings, Observation, Start
from .inertial_data import GnssData, InertialData, cut
from .observations import AntennaPosition, AntennaVelocity
from .strapdown import State, integrate, without_errors

Array = NDArray[np.floating]

#: Estimated sensor errors are taken off the raw data anew after so long, s; in between to first order. Tuned.
_CHUNK_S = 20.0


@dataclass(frozen=True)
class Estimates:
    """Estimates at n times, as arrays (see `navigation.Estimate`)."""

    time_s: Array
    r_e: Array
    v_e: Array
    R_eb: Array
    gyro: Array
    accel: Array
    lever_arm_b: Array
    wander_e: Array

    def __len__(self) -> int:
        return len(self.time_s)

    def __getitem__(self, part: slice | NDArray) -> Estimates:
        return Estimates(*(getattr(self, name)[part] for name in self.__dataclass_fields__))

    @classmethod
    def stack(cls, estimates: list[Estimate]) -> Estimates:
        return cls(
            np.array([e.time_s for e in estimates]),
            np.array([e.state.r_e for e in estimates]),
            np.array([e.state.v_e for e in estimates]),
            np.array([e.state.R_eb for e in estimates]),
            np.array([e.gyro for e in estimates]),
            np.array([e.accel for e in estimates]),
            np.array([e.lever_arm_b for e in estimates]),
            np.array([e.wander_e for e in estimates]),
        )

    def one(self, i: int) -> Estimate:
        """The estimate of that number."""
        state = State(self.r_e[i], self.v_e[i], self.R_eb[i])
        arm, wander = self.lever_arm_b[i], self.wander_e[i]
        return Estimate(float(self.time_s[i]), state, self.gyro[i], self.accel[i], arm, wander)


@dataclass(frozen=True)
class Carried:
    """Running integrals at the ends of pieces, each block from zero: what carries a state from node to node.

    Attributes
    ----------
    time_s : (q,) ends of the pieces
    block : (q,) index of the block, the one that starts at the node of that index
    duration_s : (q,) since the start of the block
    quaternion, v, p : (q, 4), (q, 3), (q, 3) running integrals
    dt_s, phi, dv : (q,), (q, 3), (q, 3) the pieces themselves
    """

    time_s: Array
    block: NDArray[np.intp]
    duration_s: Array
    quaternion: Array
    v: Array
    p: Array
    dt_s: Array
    phi: Array
    dv: Array


@dataclass(frozen=True)
class FilterPass:
    """What the filter knew at every node, before and after the observations there.

    Attributes
    ----------
    settings : of the filter
    prior, posterior : (N) estimates
    P_prior, P_posterior : (N, n, n)
    F : (N, n, n) transition to each node from the one before; the first is unused
    x : (N, n) errors put in at each node
    carried : inertial integrals in between
    innovations : of all observations
    gaps : start and end of times without inertial data
    unused : observations outside the inertial data, by kind
    """

    settings: NavigationSettings
    prior: Estimates
    posterior: Estimates
    P_prior: Array
    P_posterior: Array
    F: Array
    x: Array
    carried: Carried
    innovations: list[Innovation]
    gaps: list[tuple[float, float]]
    unused: dict[str, int] = field(default_factory=dict)


def node_times(start_s: float, end_s: float, observed_s: ArrayLike, step_s: float) -> Array:
    """Times of nodes (N,): observations (n,), and steps in between no longer than ``step_s``, from start to end."""
    t = np.asarray(observed_s, dtype=float)
    t = t[(t > start_s + 1e-9) & (t < end_s - 1e-9)]
    t = np.unique(np.concatenate([[start_s], t, [end_s]]))
    t = t[np.concatenate([[True], np.diff(t) > 2e-9])]
    t[-1] = end_s
    parts = np.maximum(1, np.ceil(np.diff(t) / step_s - 1e-6).astype(int))
    first = np.repeat(t[:-1], parts)
    within = np.arange(parts.sum()) - np.repeat(np.cumsum(parts) - parts, parts)
    return np.concatenate([first + within * np.repeat(np.diff(t) / parts, parts), [end_s]])


def gnss_observations(gnss: GnssData, rate_ib: Array) -> list[tuple[float, list[Observation]]]:
    """Observations of each fix; ``rate_ib`` (m, 3) is the angular rate at the fixes."""
    position, P, R_en, v = gnss.position_e, gnss.covariance_e(), gnss.R_en, gnss.velocity_e
    out: list[tuple[float, list[Observation]]] = []
    for i in range(len(gnss)):
        axes = R_en[i].T
        at: list[Observation] = [AntennaPosition(position[i], P[i], axes)]
        if v is not None and gnss.sigma_velocity_n is not None and np.isfinite(v[i]).all():
            A = R_en[i] * gnss.sigma_velocity_n[i]
            at.append(AntennaVelocity(v[i], A @ A.T, rate_ib[i], axes))
        out.append((float(gnss.time_s[i]), at))
    return out


def rates_at(inertial: InertialData, time_s: ArrayLike, width_s: float = 0.03) -> Array:
    """Angular rate (m, 3) at times, mean of the samples within ``width_s``."""
    t = np.asarray(time_s, dtype=float)
    total = np.concatenate([np.zeros((1, 3)), np.cumsum(inertial.dtheta, axis=0)])
    length = np.concatenate([[0.0], np.cumsum(inertial.dt_s)])
    n = len(inertial)
    i = np.clip(np.searchsorted(inertial.time_s, t - 0.5 * width_s), 0, n - 1)
    j = np.clip(np.searchsorted(inertial.time_s, t + 0.5 * width_s), i + 1, n)
    return (total[j] - total[i]) / (length[j] - length[i])[:, None]


def run_filter(
    inertial: InertialData,
    gnss: GnssData,
    start: Start,
    settings: NavigationSettings,
    *,
    held_out: NDArray[np.bool_] | None = None,
    aids: list[tuple[float, Observation]] | None = None,
) -> FilterPass:
    """Filter a recording from its start to the last inertial sample.

    Parameters
    ----------
    inertial : as measured
    gnss : fixes; those outside the inertial data are counted, not used
    start : where the navigation starts; its time lies in the inertial data
    held_out : (m,) fixes that are compared but not used
    aids : further observations with their times (zero velocity, heading)

    Raises
    ------
    ValueError : the start lies outside the inertial data
    """
    gaps = inertial.gaps()
    full = inertial.bridged(settings.gap_rate_sigma, settings.gap_force_sigma).corrected()
    t0, t1 = start.estimate.time_s, float(full.time_s[-1])
    if not float(full.time_s[0] - full.dt_s[0]) - 1e-9 <= t0 < t1:
        raise ValueError(f"start at {t0} s outside the inertial data ({full.time_s[0]} to {t1} s)")
    observed = gnss_observations(gnss, rates_at(inertial, gnss.time_s))
    withheld = np.zeros(len(gnss), dtype=bool) if held_out is None else held_out
    events = [(t, o, not withheld[i]) for i, (t, at) in enumerate(observed) for o in at]
    events += [(t, o, True) for t, o in aids or []]
    inside = [e for e in events if t0 - 1e-9 <= e[0] <= t1 + 1e-9]
    unused: dict[str, int] = {}
    for _, o, _ in (e for e in events if not t0 - 1e-9 <= e[0] <= t1 + 1e-9):
        unused[o.kind] = unused.get(o.kind, 0) + 1
    nodes = node_times(t0, t1, [e[0] for e in inside], settings.step_s)
    at_node = nearest_nodes(inside, nodes)

    pieces = cut(full, nodes)[0]
    middle = pieces.time_s - 0.5 * pieces.dt_s
    pieces = pieces[middle > t0]
    block = np.searchsorted(nodes, pieces.time_s - 0.5 * pieces.dt_s) - 1
    first = np.searchsorted(block, np.arange(len(nodes)))
    carried: list[tuple[Array, ...]] = []

    f = ErrorStateFilter(settings, start)
    n, N = f.layout.n, len(nodes)
    P_prior, P_post, F = np.empty((N, n, n)), np.empty((N, n, n)), np.empty((N, n, n))
    x = np.zeros((N, n))
    prior: list[Estimate] = []
    posterior: list[Estimate] = []
    innovations: list[Innovation] = []
    F[0] = np.eye(n)

    def observe(k: int) -> None:
        P_prior[k] = f.P
        prior.append(f.estimate)
        for observation, use in at_node.get(k, ()):
            innovation, dx = f.update(observation, use=use)
            innovations.append(innovation)
            x[k] += dx
        P_post[k] = f.P
        posterior.append(f.estimate)

    observe(0)
    k = 0
    while k < N - 1:
        chunk = slice(k, min(N - 1, max(k + 1, int(np.searchsorted(nodes, nodes[k] + _CHUNK_S)))))
        part = slice(int(first[chunk.start]), int(first[chunk.stop]))
        reference = f.estimate.gyro.copy(), f.estimate.accel.copy()
        blocks, running = integrate_blocks(pieces[part], block[part] - k, chunk.stop - chunk.start, reference)
        carried.append(running)
        for integrals in blocks:
            k += 1
            F[k] = f.predict(integrals, *reference)
            f.estimate.time_s = float(nodes[k])
            observe(k)
    columns = [np.concatenate(c) for c in zip(*carried, strict=True)]
    return FilterPass(
        settings,
        Estimates.stack(prior),
        Estimates.stack(posterior),
        P_prior,
        P_post,
        F,
        x,
        Carried(pieces.time_s, block, columns[0], columns[1], columns[2], columns[3], pieces.dt_s, *columns[4:]),
        innovations,
        gaps,
        unused,
    )


def nearest_nodes(
    observed: Sequence[tuple[float, Observation, bool]], nodes: Array
) -> dict[int, list[tuple[Observation, bool]]]:
    """Observations, and whether they are used, by the node (N,) whose time is nearest to theirs."""
    at_node: dict[int, list[tuple[Observation, bool]]] = {}
    for t, o, use in observed:
        i = int(np.searchsorted(nodes, t))
        if i == len(nodes) or (i > 0 and t - nodes[i - 1] < nodes[i] - t):
            i -= 1
        at_node.setdefault(i, []).append((o, use))
    return at_node


def integrate_blocks(pieces: InertialData, block: NDArray[np.intp], n: int, reference: tuple[Array, Array]):
    """Integrals of n blocks at once, and what runs with the pieces.

    Pieces are laid out (block, position in the block), filled with zeros.

    Parameters
    ----------
    pieces : corrected inertial data
    block : that each piece belongs to, in order
    reference : errors of gyros and accelerometers that are taken off
    """
    phi, dv = without_errors(pieces, *reference)
    count = np.bincount(block, minlength=n)
    column = np.arange(len(block)) - np.repeat(np.cumsum(count) - count, count)
    m = int(count.max())
    laid = [np.zeros((n, m, *a.shape[1:])) for a in (pieces.dt_s, phi, dv, pieces.gyro_psd, pieces.accel_psd)]
    for to, a in zip(laid, (pieces.dt_s, phi, dv, pieces.gyro_psd, pieces.accel_psd), strict=True):
        to[block, column] = a
    out = integrate(laid[0], laid[1], laid[2], len(reference[0]) == 6, laid[3], laid[4])
    running = tuple(a[block, column] for a in (out.duration_s, out.quaternion, out.v, out.p))
    return out.blocks, (*running, phi, dv)
