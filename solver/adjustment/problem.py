"""An adjustment as a problem with a state and a solution: what stays, what moves, what comes out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, Protocol

import numpy as np
from scipy.sparse import csr_array

from ..arrays import Array, IntArray
from ..camera.self_calibration import SelfCalibration
from ..models.base import ModelOptions
from ..models.platform import NO_PLATFORM_ERRORS, PlatformErrors
from .elimination import Elimination, plan_elimination
from .freed_memory import keep_freed_memory
from .layout import Layout, Unknowns, build_layout
from .linearisation import Linearisation, Whitening, corrected
from .network import Network
from .normal_equations import ControlWeights, PointNormals, Prior, row_variances, weigh_control, whiten_prior
from .reduced_system import Factor
from .robust import WeightFunction


@dataclass(frozen=True)
class AdjustmentOptions:
    """How to iterate.

    Attributes
    ----------
    weights : "motion" carries line and sample sigma through the image motion, "pitch" uses the pixel pitch alone
    max_iterations : of Gauss-Newton, including rejected steps
    tolerance : converged when a step lowers the cost by less than this share of it
    robust : weight function of the normalised residual; None for least squares
    """

    weights: str = "motion"
    max_iterations: int = 30
    tolerance: float = 1e-12
    robust: WeightFunction | None = None

    def __post_init__(self) -> None:
        if self.weights not in ("motion", "pitch"):
            raise ValueError(f"weights are 'motion' or 'pitch', not {self.weights!r}")


#: Iterations as they usually are.
USUAL = AdjustmentOptions()


@dataclass(frozen=True)
class Iteration:
    """One step, for progress lines: cost before it, cost after it, damping, whether it was taken."""

    number: int
    cost_before: float
    cost: float
    damping: float
    accepted: bool


@dataclass(frozen=True)
class Problem:
    """Everything that stays the same while iterating.

    Attributes
    ----------
    network, model, self_calibration : what is adjusted, and how
    layout, elimination, prior, control : made from these
    earlier : solutions of models run before; their corrections are in the orientation of the network's rays
    parts : partitions that do the work on rays and points, which the network then lists only; None for all in memory
    wide : a-priori sigmas of model and platform are far larger than the errors, and no observations, see `Assumed`:
        those of the measured orientation, where that of the rays is what an earlier model refined, or of a filter
    """

    network: Network
    model: ModelOptions
    self_calibration: SelfCalibration | None
    layout: Layout
    elimination: Elimination
    prior: Prior
    control: ControlWeights
    earlier: tuple[Solution, ...] = ()
    parts: Parts | None = None
    wide: bool = False


class Parts(Protocol):
    """A block in partitions (`triline.solver.partitioned`): what is done with its rays and points, and where.

    Solutions have no equations then (`Solution.linearisation`, `whitening`); the functions of this room that need them
    ask here.
    """

    def solve(
        self,
        problem: Problem,
        start: Solution | State | Array | None,
        ray_weight: Array,
        options: AdjustmentOptions,
        progress: Callable[[Iteration], None] | None,
        image_factor: float = 1.0,
    ) -> Solution:
        """`adjustment.solve`, with the sigmas of the rays multiplied by a factor first."""
        ...

    def cofactors(self, solution: Solution) -> Any:
        """`covariance.cofactors`, with the statistics of the rays."""
        ...

    def georeference(self, ray_weight: Array) -> tuple[Array, Array, Array]:
        """Points, and sigmas, of `direct_georeferencing.georeference`."""
        ...

    def consensus(self, solution: Solution, points: IntArray, limit: float) -> dict[int, Any]:
        """`point_consensus.consensus_of_points`."""
        ...

    def noise_information(self, solution: Solution) -> Any:
        """`pose_noise.noise_information`."""
        ...

    def with_noise_left(self, solution: Solution) -> bool:
        """Weigh rays with what `pose_noise.with_noise_left` leaves, from the next solution on; False for all of it."""
        ...


@dataclass(frozen=True)
class State:
    """Values of all unknowns: ``theta`` (n_unknowns,) of the reduced system, ``points_l`` (p, 3)."""

    theta: Array
    points_l: Array


class Assumed(NamedTuple):
    """Values of unknowns that nobody stated: how many of them the data determine by themselves, and the squared
    whitened residuals of all.

    Their wide sigmas say nothing of the data: counted as observations, whose residuals are next to nothing,
    they would make sigma0 too small.
    """

    number: int
    squares: float

    @classmethod
    def of(cls, prior: Prior, columns: IntArray, theta: Array, variance: Array) -> Assumed:
        """Of unknowns (m,) with these columns and variances (m,), for sigma0 = 1; ``theta`` (n_unknowns,) of all."""
        stated = prior.matrix.tocsc()[:, columns].tocoo()
        away = prior.value[stated.row] - stated.data * theta[columns[stated.col]]
        return cls.equations(stated.data**2 * variance[stated.col], away)

    @classmethod
    def equations(cls, variance: Array, residual: Array) -> Assumed:
        """Of whitened equations with adjusted variances and residuals (m,)."""
        share = np.clip(1.0 - variance, 0.0, 1.0)
        return cls(round(float(share.sum())), float(residual @ residual))

    def __add__(self, other: Assumed) -> Assumed:  # pyrefly: ignore[bad-override]  # a sum, not a longer tuple
        return Assumed(self.number + other.number, self.squares + other.squares)


#: Where all values of unknowns are stated.
NOTHING_ASSUMED = Assumed(0, 0.0)


def assumed_of(unknowns: Layout | Unknowns, prior: Prior, theta: Array, factor: Factor, wide: bool = False) -> Assumed:
    """`Assumed` at values ``theta`` of a reduced system; ``wide``: see `Problem`."""
    found = assumed_of_model(unknowns, prior, theta, factor) if wide else NOTHING_ASSUMED
    columns = unknowns.assumed
    if not len(columns):
        return found
    unit = np.zeros((len(theta), len(columns)))
    unit[columns, np.arange(len(columns))] = 1.0
    return found + Assumed.of(prior, columns, theta, np.einsum("um,um->m", unit, factor.solve(unit)))


def assumed_of_model(unknowns: Layout | Unknowns, prior: Prior, theta: Array, factor: Factor) -> Assumed:
    """What is assumed of a trajectory and of the platform, at values ``theta`` (u,) of their unknowns."""
    B = prior.matrix.tocsr()
    rows = np.flatnonzero(np.diff(B.indptr) > 0)
    last = np.maximum.reduceat(B.indices, B.indptr[rows]) if len(rows) else rows
    rows = rows[last < unknowns.n_model]
    own = csr_array(B[rows])
    return Assumed.equations(row_variances(own, factor), prior.value[rows] - own @ theta)


@dataclass(frozen=True, kw_only=True)
class Fitted:
    """What a solution says of its fit.

    Attributes
    ----------
    cost : sum of squared whitened residuals of rays, control and a-priori observations
    n_observations, n_unknowns : of those that carry weight / are determined
    assumed : of the a-priori observations, values that nobody stated; the redundancy is without them
    """

    cost: float
    n_observations: int
    n_unknowns: int
    assumed: Assumed

    @property
    def weighted_squares(self) -> float:
        """``v^T P v`` of what was measured or stated."""
        return max(self.cost - self.assumed.squares, 0.0)

    @property
    def redundancy(self) -> int:
        return self.n_observations - self.assumed.number - self.n_unknowns

    @property
    def sigma0(self) -> float:
        """``sqrt(v^T P v / (n - u))`` [K 4.54]; NaN without redundancy."""
        return float(np.sqrt(self.weighted_squares / self.redundancy)) if self.redundancy > 0 else float("nan")


@dataclass(frozen=True)
class Solution(Fitted):
    """Result of an adjustment, with its fit. Arrays of rays and points are in the network's order.

    Attributes
    ----------
    problem : network, layout, priors
    state : adjusted values
    whitening : weights used, from the image motion; without `ray_weight`
    ray_weight : (n,) factors on the rays' weights: 0 for excluded ones, between for robust estimation
    linearisation : whitened observation equations at the solution, of all rays, without `ray_weight`
    points : factorised point matrices at the solution
    factor : factorised reduced system
    iterations : number of steps taken
    converged : whether the tolerance was reached
    history : all steps
    """

    problem: Problem
    state: State
    whitening: Whitening
    ray_weight: Array
    linearisation: Linearisation
    points: PointNormals
    factor: Factor
    iterations: int
    converged: bool
    history: tuple[Iteration, ...]

    @property
    def network(self) -> Network:
        return self.problem.network

    @property
    def layout(self) -> Layout:
        return self.problem.layout

    @property
    def camera_parameters(self) -> Array:
        """(n_camera,) estimated additional parameters."""
        first = self.layout.n_model
        return self.state.theta[first : first + self.layout.n_camera]


def pose_problem(
    network: Network,
    model: ModelOptions,
    self_calibration: SelfCalibration | None = None,
    platform: PlatformErrors = NO_PLATFORM_ERRORS,
) -> Problem:
    """Unknowns, priors and elimination plan of a network."""
    keep_freed_memory()
    layout = build_layout(network, model, self_calibration, platform)
    network = with_left_out(network, layout)
    prior = whiten_prior(layout.prior, layout.n_unknowns)
    return Problem(
        network,
        model,
        self_calibration,
        layout,
        plan_elimination(layout, prior.normal, network.rays.point, network.first_ray),
        prior,
        weigh_control(network.control, network.n_points),
    )


def with_left_out(network: Network, layout: Layout, sign: float = 1.0) -> Network:
    """The network with what the model cannot follow in (or, sign -1, no more in) the noise of the rays' orientation."""
    rays = network.rays
    left: list[tuple[IntArray, Array]] = []
    for i, item in enumerate(layout.sets):
        mine = np.flatnonzero(layout.set_of_ray == i)
        of_set = item.model.left_out_variance(rays.time_s[mine])
        if of_set.any():
            left.append((mine, of_set))
    if not left:
        return network
    variance = np.zeros((len(rays), 6))
    for mine, of_set in left:
        variance[mine] = of_set
    before = 0.0 if rays.orientation_noise is None else rays.orientation_noise
    noise = before + sign * variance[:, :, None] * np.eye(6)
    return replace(network, rays=replace(rays, orientation_noise=noise))


def start_state(problem: Problem, points_l: Array | None = None) -> State:
    """No corrections, and points (p, 3), or those where the measured rays meet."""
    points = problem.network.approximate_l if points_l is None else points_l
    return State(np.zeros(problem.layout.n_unknowns), points)


def continue_problem(solution: Solution, model: ModelOptions, *, stated: bool = False) -> Problem:
    """The problem of another model on the orientation that a solution refined [K 4.2.3].

    ``stated``: the a-priori sigmas of the model are stated for what is left, see `Problem.wide`.
    """
    old = solution.problem
    correction = old.layout.corrections(solution.state.theta)
    rays = old.network.rays
    refined = with_left_out(old.network, old.layout, -1.0)
    position, angles = corrected(rays, old.layout, correction)
    refined = refined.with_orientation(position.T, angles.T)
    problem = pose_problem(refined, model, old.self_calibration, old.layout.platform)
    return replace(problem, earlier=(*old.earlier, solution), wide=not stated)


def cost_of(problem: Problem, state: State, lin: Linearisation) -> float:
    """Sum of squared whitened residuals of rays, control and a-priori observations."""
    prior = problem.prior.residual(state.theta)
    control = problem.control.residual(state.points_l)
    cost = float(np.vdot(lin.residual, lin.residual) + prior @ prior + np.vdot(control, control))
    if problem.control.surface is not None:
        surface = problem.control.surface.residual(state.points_l, problem.layout.shift_of(state.theta))
        cost += float(surface @ surface)
    return cost
