"""Batch bundle adjustment of line-scanner blocks."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from ..arrays import Array
from ..camera.self_calibration import SelfCalibration
from ..models.base import ModelOptions
from .equations import BlockEquations
from .gauss_newton import Descent
from .network import Network
from .problem import (
    USUAL,
    AdjustmentOptions,
    Iteration,
    Problem,
    Solution,
    State,
    continue_problem,
    cost_of,
    pose_problem,
)

__all__ = [
    "AdjustmentOptions",
    "Iteration",
    "Problem",
    "Solution",
    "State",
    "adjust",
    "continue_problem",
    "cost_of",
    "pose_problem",
    "solve",
]


def adjust(
    network: Network,
    model: ModelOptions,
    self_calibration: SelfCalibration | None = None,
    options: AdjustmentOptions = USUAL,
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


def solve(
    problem: Problem,
    start: Solution | State | Array | None = None,
    ray_weight: Array | None = None,
    options: AdjustmentOptions = USUAL,
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
    n = len(problem.network.rays)
    given = np.ones(n) if ray_weight is None else np.asarray(ray_weight, dtype=float)
    if given.shape != (n,) or not (given >= 0).all():
        raise ValueError(f"wanted {n} weights not below zero, got shape {given.shape}")
    if problem.parts is not None:
        return problem.parts.solve(problem, start, given, options, progress)
    equations = BlockEquations(problem, start, given, options.weights)
    descent = Descent(equations, options)
    descend(descent, progress)
    return equations.solution(descent.finished(), tuple(descent.history))


def descend(descent: Descent, progress: Callable[[Iteration], None] | None = None) -> None:
    """Take steps until they arrive, or until there were enough of them."""
    while not descent.arrived and len(descent.history) < descent.options.max_iterations:
        descent.step()
        if progress:
            progress(descent.history[-1])
        if not descent.arrived:
            descent.form_normals()
