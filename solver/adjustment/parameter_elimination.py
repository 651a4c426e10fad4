"""Stepwise elimination of additional parameters: solve, examine, remove the worst, solve again [K 4.2.2.4]."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from .adjustment import AdjustmentOptions, Problem, Solution, State, pose_problem, solve
from .covariance import point_cofactors, point_unknown_cofactors
from .determinability import Evidence, Limits, Removal, examine, point_sigmas, ranks, strongest_correlations
from .network import Network
from .network_weakness import PART, describe

Array = NDArray[np.floating]


@dataclass(frozen=True)
class Elimination:
    """Outcome: the adjustment with the determinable parameters, what was removed in which order, what stays in spite of
    a failed criterion (name -> why)."""

    solution: Solution
    removed: tuple[Removal, ...]
    kept: dict[str, str]


def ground_sample_distance(network: Network) -> float:
    """Median pixel size on the ground, metres, over all rays."""
    rays = network.rays
    height = np.abs(rays.position_l[:, 2] - network.approximate_l[rays.point, 2])
    pitch = np.linalg.norm(rays.pitch_mm, axis=1)
    return float(np.median(pitch / rays.focal_length_mm * height))


def gather_evidence(solution: Solution) -> Evidence:
    """What a solution says about its additional parameters."""
    layout = solution.layout
    m, first = layout.n_camera, layout.n_model
    columns = np.arange(first, first + m)
    unit = np.zeros((layout.n_unknowns, m))
    unit[columns, np.arange(m)] = 1.0
    Q = solution.factor.solve(unit)
    q = np.maximum(np.diagonal(Q[columns]), 0.0)
    to_points = point_unknown_cofactors(solution, columns)
    of_points = np.einsum("pii->pi", point_cofactors(solution)).ravel()
    cross = np.concatenate([Q[:first], to_points.reshape(-1, m)])
    strongest, r = strongest_correlations(cross, np.concatenate([solution.factor.variances()[:first], of_points]), q)
    sigma0 = solution.sigma0 if solution.redundancy > 0 else 1.0
    names = layout.names[first : first + m]
    return Evidence(
        names,
        solution.camera_parameters,
        Q[columns],
        _pivots(solution, q),
        _partners(solution, strongest),
        r,
        point_sigmas(to_points, q),
        sigma0,
        max(solution.redundancy, 0),
        ground_sample_distance(solution.network),
        ranks(names, solution.network.camera),
    )


def eliminate(
    solution: Solution,
    limits: Limits = Limits(),  # noqa: B008  (frozen)
    options: AdjustmentOptions = AdjustmentOptions(),  # noqa: B008  (frozen)
    adapt: Callable[[Problem], Problem] = lambda problem: problem,
    progress: Callable[[Removal], None] | None = None,
) -> Elimination:
    """Remove parameters that are not determinable, one at a time, the worst first.

    Parameters
    ----------
    solution : with the full set
    limits, options : critical values; how to iterate
    adapt : what was done to the a-priori weights of the problem, for the problems posed anew
    progress : called with every removal
    """
    removed: list[Removal] = []
    kept: dict[str, str] = {}
    while solution.layout.n_camera:
        verdict = examine(gather_evidence(solution), limits)
        kept = verdict.kept
        if verdict.removal is None:
            break
        removed.append(verdict.removal)
        if progress:
            progress(verdict.removal)
        solution = without(solution, verdict.removal.name, options, adapt)
    return Elimination(solution, tuple(removed), kept)


def without(solution: Solution, name: str, options: AdjustmentOptions, adapt: Callable[[Problem], Problem]) -> Solution:
    """The adjustment without one additional parameter, from the values of the one with it."""
    old = solution.problem
    assert old.self_calibration is not None
    smaller = old.self_calibration.without([name])
    problem = adapt(pose_problem(old.network, old.model, smaller if smaller.n_unknowns else None, old.layout.platform))
    problem = replace(problem, control=old.control, earlier=old.earlier)
    place = old.layout.names.index(name, old.layout.n_model)
    start = State(np.delete(solution.state.theta, place), solution.state.points_l)
    return solve(problem, start, solution.ray_weight, options)


def own_information(solution: Solution) -> Array:
    """(n_unknowns,) diagonal of the normal matrix of the rays before anything is eliminated."""
    layout, lin, weight = solution.layout, solution.linearisation, solution.ray_weight
    n = np.zeros(layout.n_unknowns + 1)
    squares = np.einsum("ckn,ckn->kn", lin.orientation, lin.orientation) * weight
    for t, columns in enumerate(layout.columns):
        values = squares[layout.component[t]] * layout.coefficients[layout.node[t]] ** 2
        n += np.bincount(columns + 1, values, layout.n_unknowns + 1)  # place 0 takes the absent ones
    own = n[1:]
    if layout.camera is not None:
        of_ray = layout.camera.columns[layout.camera.pattern]
        squares = np.einsum("csn,csn->sn", lin.camera, lin.camera) * weight
        for s in range(of_ray.shape[1]):
            of_camera = own[layout.n_model : layout.n_model + layout.n_camera]
            of_camera += np.bincount(of_ray[:, s] + 1, squares[s], layout.n_camera + 1)[1:]
    if layout.n_surface and solution.problem.control.surface is not None:
        own[layout.shift_column] = solution.problem.control.surface.weight.sum()
    return own


def _pivots(solution: Solution, q: Array) -> Array:
    """``1 / (n_ii q_ii)``: what is left of a parameter's own information when all others are free; 0 where singular."""
    parameters = slice(solution.layout.n_model, solution.layout.n_model + len(q))
    own = own_information(solution)[parameters]
    pivot = np.divide(1.0, own * q, out=np.ones_like(q), where=(own > 0) & (q > 0))
    pivot[own == 0] = 0.0
    null = np.abs(solution.factor.undetermined.vectors[parameters])
    pivot[(null > 0.3).any(axis=1)] = 0.0
    return np.minimum(pivot, 1.0)


def _partners(solution: Solution, strongest: NDArray[np.int64]) -> tuple[str, ...]:
    """Names of the unknowns (m,) that the parameters are most correlated with: of the orientation, then coordinates."""
    first, m = solution.layout.n_model, len(strongest)
    names, points = solution.layout.names, solution.network.point_ids
    partner = [
        describe((names[k],), 0) if k < first else f"{'XYZ'[(k - first) % 3]} of point {points[(k - first) // 3]}"
        for k in strongest.tolist()
    ]
    null = solution.factor.undetermined.vectors
    for i in range(m):  # where the system is singular, what the parameter cannot be told from
        own = np.abs(null[first + i])
        if own.max(initial=0.0) > 0.3:
            part = np.abs(null[:, int(np.argmax(own))])
            part[first + i] = 0.0
            members = [k for k in np.argsort(-part, kind="stable")[:3] if part[k] > PART]
            partner[i] = describe(tuple(names[k] for k in members), 0) if members else "nothing"
    return tuple(partner)
