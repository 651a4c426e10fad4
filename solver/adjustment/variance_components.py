"""Variance components of image, control and slow errors, in the style of Helmert and Foerstner.

For each group of observations the squares of its residuals are compared with its share of the redundancy,
``s_g^2 = v_g^T P_g v_g / r_g`` with ``r_g = n_g - tr(P_g A_g Q A_g^T)``; its sigma is multiplied by ``s_g`` and the
block adjusted again until nothing changes. A-priori sigmas of trajectories are guesses; this says what they should have
been. Constants, the clock and what a calibration leaves open of the camera, are known better than one flight tells:
their sigmas become larger where the solution contradicts them, and never smaller.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.sparse import csr_array

from ..arrays import IntArray
from ..models.base import ERROR_GROUPS, error_groups
from ..quantiles import chi2
from .adjustment import AdjustmentOptions, Problem, Solution, cost_of, solve
from .covariance import Cofactors, cofactors, point_unknown_cofactors
from .linearisation import Whitening
from .normal_equations import Prior, row_variances

#: Constants that are known beforehand better than anything else says: what they are stated to be is only questioned
#: where the solution contradicts it.
CLOCK, CALIBRATION = "clock", "calibration"
CONSTANTS = (CLOCK, CALIBRATION)
GROUPS = ("image", "control", *ERROR_GROUPS, *CONSTANTS)

#: A group with less redundancy keeps its a-priori sigma: the estimate would be chance, unless the squares are beyond
#: what has this probability. The estimate is then that of so many more observations that are as stated.
LEAST_REDUNDANCY, BY_CHANCE, AS_STATED = 5.0, 1e-4, 2.0
#: No estimate with less redundancy than this.
HARDLY_ANY = 0.5

#: Converged when no factor changes by more than this share of itself.
TOLERANCE = 0.01

#: Factors are kept inside these limits; beyond them a group contributes nothing that could be estimated.
SMALLEST, LARGEST = 1e-3, 1e3


@dataclass(frozen=True)
class Component:
    """One group.

    Attributes
    ----------
    group : of `GROUPS`
    n : observations with weight
    redundancy : their share of the redundancy
    factor : what the a-priori sigmas were multiplied by
    uncertainty : relative standard deviation of the factor, ``1 / sqrt(2 r)``
    estimated : False where the group kept its a-priori sigmas
    """

    group: str
    n: int
    redundancy: float
    factor: float
    uncertainty: float
    estimated: bool


@dataclass(frozen=True)
class VarianceComponents:
    """Outcome: the adjustment with the sigmas found, and the groups."""

    solution: Solution
    components: tuple[Component, ...]
    iterations: int
    converged: bool


@dataclass(frozen=True)
class Scales:
    """What a-priori sigmas are multiplied by, per group."""

    factor: dict[str, float] = field(default_factory=lambda: dict.fromkeys(GROUPS, 1.0))

    def times(self, change: dict[str, float]) -> Scales:
        return Scales({g: f * change.get(g, 1.0) for g, f in self.factor.items()})

    def apply(self, problem: Problem) -> Problem:
        """A problem posed with a-priori sigmas, with control and slow errors scaled (the image is scaled in the
        solution)."""
        f = np.ones(problem.prior.n_observations)
        for group, rows in prior_groups(problem).items():
            f[rows] = 1.0 / self.factor[group]
        matrix = csr_array(problem.prior.matrix.multiply(f[:, None]))
        prior = Prior.of(matrix, problem.prior.value * f)
        control = replace(problem.control, weight=problem.control.weight / self.factor["control"] ** 2)
        return replace(problem, prior=prior, control=control)


def prior_groups(problem: Problem) -> dict[str, IntArray]:
    """Rows of the a-priori equations of each group of slow errors and constants, by the words of their labels."""
    given = problem.layout.prior
    labels = [label for label, s in zip(given.labels, given.sigma, strict=True) if np.isfinite(s)]
    column = given.columns[np.isfinite(given.sigma)].max(axis=1)
    of_model = column < problem.layout.n_of_sets
    group = error_groups(labels)
    rows = {name: np.flatnonzero(of_model & (group == g)) for g, name in enumerate(ERROR_GROUPS)}
    rows[CLOCK] = np.flatnonzero(~of_model & (np.array(labels) == "clock"))
    calibration = problem.self_calibration
    questioned = calibration.questioned_names if calibration is not None else ()
    rows[CALIBRATION] = np.flatnonzero((column >= problem.layout.n_model) & np.isin(labels, questioned))
    return rows


def group_sums(solution: Solution, of: Cofactors) -> dict[str, tuple[int, float, float]]:
    """Number, ``v^T P v`` and redundancy of each group in a solution, and of the surface that points lie on, if any."""
    problem, weight = solution.problem, solution.ray_weight
    v = solution.linearisation.residual
    squares = (v * v).sum(axis=0) if of.squares is None else of.squares
    trace = np.einsum("nii->n", of.observed)
    result = {
        "image": (
            2 * int((weight > 0).sum()),
            float(np.sum(weight * squares)),
            float(np.sum(np.where(weight > 0, 2.0 - weight * trace, 0.0))),
        )
    }
    control = problem.control
    given = control.weight > 0
    c = control.residual(solution.state.points_l)
    taken = control.weight * np.einsum("pii->pi", of.points)
    result["control"] = (int(given.sum()), float(np.sum(c * c)), float(np.sum(np.where(given, 1.0 - taken, 0.0))))
    e = problem.prior.residual(solution.state.theta)
    r = 1.0 - row_variances(problem.prior.matrix, solution.factor)
    for group, rows in prior_groups(problem).items():
        result[group] = (len(rows), float(e[rows] @ e[rows]), float(r[rows].sum()))
    if (surface := control.surface) is not None:
        shift = solution.layout.shift_column
        v = surface.residual(solution.state.points_l, float(solution.state.theta[shift]))
        across = point_unknown_cofactors(solution, np.array([shift]))[:, :, 0]
        adjusted = np.einsum("pi,pij,pj->p", surface.normal, of.points, surface.normal) + of.unknowns[shift]
        adjusted += 2.0 * np.einsum("pi,pi->p", surface.normal, across)
        left = np.where(surface.weight > 0, 1.0 - surface.weight * adjusted, 0.0)
        result["surface"] = (surface.n_observations, float(v @ v), float(left.sum()))
    return result


def _can_be_estimated(sums: dict[str, tuple[int, float, float]], group: str) -> bool:
    """Enough redundancy in the group and in the image points; a-priori values that nothing contradicts do not count."""
    n, squares, redundancy = sums[group]
    if not n or sums["image"][2] < LEAST_REDUNDANCY:
        return False
    if group in CONSTANTS:
        return True
    if redundancy < HARDLY_ANY:
        return False
    if redundancy < LEAST_REDUNDANCY:
        return group in ERROR_GROUPS and _contradicted(squares, redundancy)
    return squares > SMALLEST**2 * redundancy


def _contradicted(squares: float, redundancy: float) -> bool:
    """Whether residuals are larger than the stated sigmas let them be by chance."""
    return redundancy > 0 and bool(squares > chi2.isf(BY_CHANCE, redundancy))


def estimate_components(
    solution: Solution,
    groups: tuple[str, ...] = GROUPS,
    options: AdjustmentOptions = AdjustmentOptions(),  # noqa: B008  (frozen)
    most_iterations: int = 15,
    start: Scales = Scales(),
    progress: Callable[[int, dict[str, float]], None] | None = None,
) -> VarianceComponents:
    """Estimate the sigmas of some groups; the others keep theirs.

    Parameters
    ----------
    solution : start
    groups : of `GROUPS`
    options : how to adjust in between
    most_iterations : re-weightings at most
    start : what the solution's sigmas have been multiplied by already
    progress : called after every re-weighting with its number and the factors

    Raises
    ------
    ValueError : a group that does not exist
    """
    unknown = set(groups) - set(GROUPS)
    if unknown:
        raise ValueError(f"no observation group {sorted(unknown)}; there are {', '.join(GROUPS)}")
    scales, converged, number = start, False, 0
    sums = group_sums(solution, cofactors(solution))
    groups = tuple(g for g in groups if _can_be_estimated(sums, g))
    while number < most_iterations:
        change = {}
        for group in groups:
            _, squares, redundancy = sums[group]
            if group in CONSTANTS and scales.factor[group] == 1.0 and not _contradicted(squares, redundancy):
                continue
            more = AS_STATED if redundancy < LEAST_REDUNDANCY else 0.0
            ratio = (max(squares, 0.0) + more / scales.factor[group] ** 2) / (max(redundancy, 1e-6) + more)
            total = scales.factor[group] * np.sqrt(ratio)
            least = 1.0 if group in CONSTANTS else SMALLEST
            change[group] = float(np.clip(total, least, LARGEST)) / scales.factor[group]
        if all(abs(f - 1.0) <= TOLERANCE for f in change.values()):
            converged = True
            break
        number += 1
        scales = scales.times(change)
        solution = scaled(solution, change, options)
        sums = group_sums(solution, cofactors(solution))
        if progress:
            progress(number, scales.factor)
    estimated = {g for g in groups if g not in CONSTANTS or scales.factor[g] != 1.0}
    components = []
    for group in GROUPS:
        n, _, redundancy = sums[group]
        if group in CONSTANTS and not n:
            continue
        uncertainty = 1.0 / np.sqrt(2.0 * redundancy) if redundancy > 0 else np.inf
        components.append(Component(group, n, redundancy, scales.factor[group], float(uncertainty), group in estimated))
    return VarianceComponents(solution, tuple(components), number, converged)


def scaled(
    solution: Solution,
    change: dict[str, float],
    options: AdjustmentOptions = AdjustmentOptions(),  # noqa: B008  (frozen)
) -> Solution:
    """The adjustment with sigmas of groups multiplied by factors, from the values of the one before."""
    problem = Scales().times(change).apply(solution.problem)
    if problem.parts is not None:
        return problem.parts.solve(problem, solution, solution.ray_weight, options, None, change.get("image", 1.0))
    f = 1.0 / change.get("image", 1.0)
    lin = solution.linearisation.reweighted(np.full(len(solution.ray_weight), f * f))
    start = replace(solution, problem=problem, whitening=Whitening(solution.whitening.g * f), linearisation=lin)
    start = replace(start, cost=cost_of(problem, solution.state, lin.reweighted(solution.ray_weight)))
    return solve(problem, start, solution.ray_weight, options)
