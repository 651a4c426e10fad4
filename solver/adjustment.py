"""Batch bundle adjustment of line-scanner blocks: Gauss-Newton with the object points eliminated."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from .elimination import Elimination, plan_elimination
from .layout import Layout, build_layout
from .linearisation import (
    Linearisation,
    Whitening,
    linearise,
    misclosures,
    pitch_covariance,
    refresh_weights,
    residual_covariance,
    whiten,
)
from .models.base import ModelOptions
from .network import Network
from .normal_equations import (
    ControlWeights,
    PointNormals,
    Prior,
    back_substitute,
    reduce_normals,
    weigh_control,
    whiten_prior,
)
from .reduced_system import Factor
from .robust import WeightFunction
from .selfcalibration import SelfCalibration

Array = NDArray[np.floating]

#: The image motion is taken anew for the weights after every step that lowers the cost by more than this share of it.
WEIGHTS_CHANGE = 1e-5
#: A step that promised less than this share of the cost and did not lower it met the rounding of the cost.
ROUNDING = 1e-10


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
    """

    network: Network
    model: ModelOptions
    self_calibration: SelfCalibration | None
    layout: Layout
    elimination: Elimination
    prior: Prior
    control: ControlWeights
    earlier: tuple[Solution, ...] = ()


@dataclass(frozen=True)
class State:
    """Values of all unknowns: ``theta`` (n_unknowns,) of the reduced system, ``points_l`` (p, 3)."""

    theta: Array
    points_l: Array


@dataclass(frozen=True)
class Solution:
    """Result of an adjustment. Arrays of rays and points are in the network's order.

    Attributes
    ----------
    problem : network, layout, priors
    state : adjusted values
    whitening : weights used, from the image motion; without `ray_weight`
    ray_weight : (n,) factors on the rays' weights: 0 for excluded ones, between for robust estimation
    linearisation : whitened observation equations at the solution, of all rays, without `ray_weight`
    points : factorised point matrices at the solution
    factor : factorised reduced system
    cost : sum of squared whitened residuals of rays, control and a-priori observations
    n_observations, n_unknowns : of those that carry weight / are determined
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
    cost: float
    n_observations: int
    n_unknowns: int
    iterations: int
    converged: bool
    history: tuple[Iteration, ...]

    @property
    def redundancy(self) -> int:
        return self.n_observations - self.n_unknowns

    @property
    def sigma0(self) -> float:
        """``sqrt(v^T P v / (n - u))`` [K 4.54]; NaN without redundancy."""
        return float(np.sqrt(self.cost / self.redundancy)) if self.redundancy > 0 else float("nan")

    @property
    def network(self) -> Network:
        return self.problem.network

    @property
    def layout(self) -> Layout:
        return self.problem.layout

    @property
    def camera_parameters(self) -> Array:
        """(n_camera,) estimated additional parameters."""
        return self.state.theta[self.layout.n_model :]


def pose_problem(network: Network, model: ModelOptions, self_calibration: SelfCalibration | None = None) -> Problem:
    """Unknowns, priors and elimination plan of a network."""
    layout = build_layout(network, model, self_calibration)
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


def start_state(problem: Problem, points_l: Array | None = None) -> State:
    """No corrections, and points (p, 3), or those where the measured rays meet."""
    points = problem.network.approximate_l if points_l is None else points_l
    return State(np.zeros(problem.layout.n_unknowns), points)


def weigh_rays(problem: Problem, state: State, weights: str = "motion") -> Whitening:
    """Weights of the rays at given values; see `AdjustmentOptions.weights`."""
    rays = problem.network.rays
    if weights == "pitch":
        return whiten(pitch_covariance(rays))
    _, d_orientation, _, _ = misclosures(rays, problem.layout, state.theta, state.points_l)
    return whiten(residual_covariance(rays, d_orientation))


def cost_of(problem: Problem, state: State, lin: Linearisation) -> float:
    """Sum of squared whitened residuals of rays, control and a-priori observations."""
    prior = problem.prior.residual(state.theta)
    control = problem.control.residual(state.points_l)
    return float(np.vdot(lin.residual, lin.residual) + prior @ prior + np.vdot(control, control))


def adjust(
    network: Network,
    model: ModelOptions,
    self_calibration: SelfCalibration | None = None,
    options: AdjustmentOptions = AdjustmentOptions(),
    progress: Callable[[Iteration], None] | None = None,
    then: Sequence[ModelOptions] = (),
) -> Solution:
    """Adjust a block.

    Parameters
    ----------
    network : the block
    model : settings of the trajectory model
    self_calibration : additional parameters to estimate with it
    options : how to iterate
    progress : called with every step
    then : models to run after the first, each on the orientation that the one before refined

    Returns
    -------
    Solution; for singular networks too, with the undetermined directions in ``factor.undetermined``
    """
    solution = solve(pose_problem(network, model, self_calibration), options=options, progress=progress)
    for following in then:
        solution = solve(
            continue_problem(solution, following),
            solution.state.points_l,
            options=options,
            progress=progress,
        )
    return solution


def continue_problem(solution: Solution, model: ModelOptions) -> Problem:
    """The problem of another model on the orientation that a solution refined [K 4.2.3]."""
    old = solution.problem
    correction = old.layout.corrections(solution.state.theta)
    rays = old.network.rays
    refined = old.network.with_orientation(rays.position_l + correction[:3].T, rays.angles + correction[3:].T)
    return replace(pose_problem(refined, model, old.self_calibration), earlier=(*old.earlier, solution))


def solve(
    problem: Problem,
    start: Solution | State | Array | None = None,
    ray_weight: Array | None = None,
    options: AdjustmentOptions = AdjustmentOptions(),
    progress: Callable[[Iteration], None] | None = None,
) -> Solution:
    """Gauss-Newton with Levenberg-Marquardt damping where a step fails.

    Parameters
    ----------
    problem : from `pose_problem`
    start : where to begin: a solution of the same problem (warm, keeps its weights), a state, or points (p, 3) alone
    ray_weight : (n,) factors on the weights; 0 leaves a ray out
    options, progress : as in `adjust`
    """
    rays, layout = problem.network.rays, problem.layout
    given = np.ones(len(rays)) if ray_weight is None else np.asarray(ray_weight, dtype=float)
    if given.shape != (len(rays),) or not (given >= 0).all():
        raise ValueError(f"wanted {len(rays)} weights not below zero, got shape {given.shape}")
    if isinstance(start, Solution):
        state, whitening, lin = start.state, start.whitening, start.linearisation
        fresh = 0
    else:
        state = start if isinstance(start, State) else start_state(problem, start)
        whitening = whiten(pitch_covariance(rays))
        lin = linearise(rays, layout, whitening, state.theta, state.points_l)
        fresh = 8 if options.weights == "motion" else 0
        if fresh:
            whitening, lin = refresh_weights(rays, whitening, lin)
    weight = _robust_weight(given, lin, options.robust)
    active = _weighted(lin, weight)
    cost = cost_of(problem, state, active)
    history: list[Iteration] = []
    damping, taken, converged = 0.0, 0, False
    while True:
        reduced = reduce_normals(
            active, layout, problem.elimination, problem.prior, problem.control, state.theta, state.points_l, damping
        )
        factor = reduced.matrix.factorise()
        d_theta = factor.solve(reduced.rhs)
        y = reduced.points.y
        # a cost far below one observation's is rounding, and its share of nothing
        gain = float(reduced.rhs @ d_theta + np.vdot(y, y)) / max(cost, 1.0)
        converged = gain <= options.tolerance
        if (converged and damping == 0.0) or len(history) >= options.max_iterations:
            break
        d_points = back_substitute(active, layout, problem.elimination, reduced.points, d_theta)
        trial = State(state.theta + d_theta, state.points_l + d_points)
        with np.errstate(all="ignore"):
            new = linearise(rays, layout, whitening, trial.theta, trial.points_l)
            new_active = _weighted(new, weight)
            new_cost = cost_of(problem, trial, new_active)
        accepted = bool(new_cost <= cost * (1.0 + 1e-13))
        history.append(Iteration(len(history) + 1, cost, new_cost, damping, accepted))
        if progress:
            progress(history[-1])
        if not accepted:
            converged = gain < ROUNDING
            damping = 10.0 * damping or 1e-4
            if converged or damping > 1e10:
                break
            continue
        damping = damping / 10.0 if damping > 1e-6 else 0.0
        taken += 1
        state, lin, active = trial, new, new_active
        large = cost - new_cost > WEIGHTS_CHANGE * new_cost
        cost = new_cost
        changed = False
        if fresh and large:
            whitening, lin = refresh_weights(rays, whitening, lin)
            fresh -= 1
            changed = True
        if options.robust is not None and taken <= options.max_iterations // 2:
            weight = _robust_weight(given, lin, options.robust)
            changed = True
        if changed:
            active = _weighted(lin, weight)
            cost = cost_of(problem, state, active)
    if damping:  # cofactors are those of the undamped system
        reduced = reduce_normals(
            active, layout, problem.elimination, problem.prior, problem.control, state.theta, state.points_l
        )
        factor = reduced.matrix.factorise()
    n_observations, n_unknowns = _counts(problem, weight, reduced.points, factor)
    return Solution(
        problem,
        state,
        whitening,
        weight,
        lin,
        reduced.points,
        factor,
        cost,
        n_observations,
        n_unknowns,
        taken,
        converged,
        tuple(history),
    )


def _weighted(lin: Linearisation, weight: Array) -> Linearisation:
    return lin if (weight == 1.0).all() else lin.reweighted(weight)


def _robust_weight(given: Array, lin: Linearisation, robust: WeightFunction | None) -> Array:
    """Given weights times the weight function of the larger whitened residual, scaled by its median."""
    if robust is None:
        return given
    w = np.abs(lin.residual).max(axis=0)
    used = given > 0
    scale = np.median(np.abs(lin.residual[:, used])) / 0.6745 if used.any() else 1.0
    return given * robust(w / max(float(scale), 1e-12))


def _counts(problem: Problem, weight: Array, points: PointNormals, factor: Factor) -> tuple[int, int]:
    """Observations with weight, unknowns that are determined."""
    n = 2 * int((weight > 0).sum()) + problem.prior.n_observations + problem.control.n_observations
    u = problem.layout.n_unknowns - len(factor.undetermined) + int(points.rank.sum())
    return n, u
