"""Data snooping in a block of scenes: as `triline.solver.adjustment.snooping`, whose tests and limits it takes.

Of an object point at most one image point goes in a round, and none that fails by much less than the worst of all. What
was left out and agrees with the rest returns once. A control coordinate goes only where it fails clearly while the
image points fit; where all image points of a point went, three or more, and agree with each other, its given
coordinates go in their place: grossly wrong ones bend the block so much that these fail first. It is the same with a
tie point that lost so many that it has no place any more. Where too many image points would go, model or sigmas are
wrong, and nothing is left out.

Where the image points do not fit, the block without any control says whether control bends it (`bending_control`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..adjustment.point_consensus import ORIENTATION_SHARE
from ..adjustment.reliability import CRITICAL_W
from ..adjustment.snooping import (
    CONTROL_CLEAR,
    CONTROL_FIT,
    MOST_LEFT_OUT,
    MOST_ROUNDS,
    TOGETHER,
    failing_w,
    joint_limit,
    largest_of_group,
)
from .solution import (
    MOST_ITERATIONS,
    NotAdjustableError,
    SceneSolution,
    State,
    adjust,
    intersect,
    joint_covariance,
    linearise,
    points_enu,
)

Array = NDArray[np.floating]


@dataclass(frozen=True)
class SceneSnooping:
    """Outcome.

    Attributes
    ----------
    solution : without what was left out; its iterations are those of all adjustments together
    rays : (k,) image points left out, in order of their test values, the largest first
    w : (k,) their normalised residuals, the larger of line and sample: against the final adjustment without them; when
        they were left out where nothing controls them now
    coordinates : (point, axis) of control coordinates left out
    rounds : of tests
    given_up : share of the image points that would have gone where that is too many; then nothing is left out
    """

    solution: SceneSolution
    rays: NDArray[np.int64]
    w: Array
    coordinates: tuple[tuple[int, int], ...]
    rounds: int
    given_up: float = 0.0


def snoop(
    solution: SceneSolution, critical: float = CRITICAL_W, max_iterations: int = MOST_ITERATIONS
) -> SceneSnooping:
    """Leave out image points and control coordinates that contradict the rest.

    Parameters
    ----------
    solution : start
    critical : of ``|w|``
    max_iterations : of each adjustment in between

    Raises
    ------
    ValueError : a critical value that is not positive
    """
    if not critical > 0:
        raise ValueError(f"critical value {critical}, wanted more than 0")
    beginning, point = solution, solution.problem.block.rays.point
    use, given = np.ones(len(point), dtype=bool), solution.problem.given.copy()
    returned = np.zeros(len(point), dtype=bool)
    returned_given: set[tuple[int, int]] = set()
    exchanged: set[int] = set()
    rounds, w_then, taken = 0, np.zeros(len(point)), solution.iterations
    if given.any() and not (solution.converged and _scale(solution) <= CONTROL_FIT):
        straight = _without_control(solution, critical, max_iterations)
        if straight is not None:
            taken += straight.solution.iterations
            bending = bending_control(straight.solution, given, critical)
            if bending.any():
                use[straight.rays], w_then[straight.rays] = False, straight.w
                few = np.bincount(point, use, len(given)) < 3  # nothing tells whether two rays are wrong or it
                use[np.isin(point, np.flatnonzero(few & bending.any(axis=1)))] = False
                given &= few[:, None] | ~bending
                solution = adjust(solution.problem, straight.solution.state, use, given, max_iterations)
                taken += solution.iterations
    for rounds in range(1, MOST_ROUNDS + 1):
        before = use.copy(), given.copy()
        _leave_out(solution, critical, use, given)
        gone = before[0] & ~use
        w_then[gone] = _larger(solution.test[gone])
        if (use == before[0]).all() and (given == before[1]).all():
            _bring_back(solution, critical, use, given, returned, returned_given)
        if (use == before[0]).all() and (given == before[1]).all():
            solution = _exchange(solution, critical, use, given, exchanged)
        if (use == before[0]).all() and (given == before[1]).all():
            break
        share = float((~use).sum()) / len(use)
        if share > MOST_LEFT_OUT:
            beginning = replace(beginning, iterations=taken)
            return SceneSnooping(beginning, np.empty(0, dtype=np.int64), np.empty(0), (), rounds, share)
        # gross errors bend a block so that it does not converge, and some points are lost: it begins anew without them
        state = solution.state if solution.converged else None
        solution = adjust(solution.problem, state, use, given, max_iterations)
        taken += solution.iterations
    out = np.flatnonzero(~use)
    w = _larger(solution.test)
    w = np.where(w != 0.0, w, w_then)
    out = out[np.argsort(-np.abs(w[out]), kind="stable")]
    p, axis = np.nonzero(solution.problem.given & ~given)
    solution = replace(solution, iterations=taken)
    return SceneSnooping(solution, out, w[out], tuple(zip(p.tolist(), axis.tolist(), strict=True)), rounds)


def _larger(test: Array) -> Array:
    """The larger of two test values (n, 2), with its sign."""
    return np.take_along_axis(test, np.abs(test).argmax(axis=1)[:, None], axis=1)[:, 0]


def _scale(solution: SceneSolution) -> float:
    """How many of their sigmas the residuals of image points have, by their median."""
    w = np.abs(solution.test[solution.ray_weight])
    return float(np.median(w[w > 0])) / 0.6745 if (w > 0).any() else 1.0


def _without_control(solution: SceneSolution, critical: float, max_iterations: int) -> SceneSnooping | None:
    """The block by image points and a-priori knowledge alone; None where these do not determine it, or do not fit."""
    problem = replace(solution.problem, given=np.zeros_like(solution.given))
    try:
        alone = adjust(problem, max_iterations=max_iterations)
    except NotAdjustableError:
        return None
    if not alone.converged or alone.undetermined or _scale(alone) > CONTROL_FIT:
        return None
    found = snoop(alone, critical, max_iterations)
    return None if found.given_up or not found.solution.converged else found


def bending_control(solution: SceneSolution, given: NDArray[np.bool_], critical: float) -> NDArray[np.bool_]:
    """Which known coordinates (p, 3) contradict the block without control, and each other.

    What control says against points that are adjusted without it, ``l`` with the covariance ``S`` of both, are
    condition equations: their normalised residuals are ``(S^-1 l) / sqrt(diag S^-1)``, the squares of all
    ``l' S^-1 l``. The worst goes, and so on until no other fails clearly and together they do not fail. Nothing bends
    the block meanwhile, however far off control lies. Where more than half of the control points would go, model or
    a-priori knowledge contradicts them, and none does.

    Parameters
    ----------
    solution : the block without control
    given : (p, 3) known coordinates that are asked about
    critical : of ``|w|``
    """
    problem, known = solution.problem, solution.problem.block.known
    out = np.zeros_like(given)
    of = np.flatnonzero(given[known.point].any(axis=1) & solution.determined[known.point])
    points = known.point[of]
    miss = points_enu(problem, solution.state.position_e, known.position_e[of], points).ravel()
    S = joint_covariance(solution, points) * max(_scale(solution), 1.0) ** 2
    k = np.arange(len(points))
    S.reshape(len(points), 3, len(points), 3)[k, :, k, :] += problem.covariance_enu[points]
    left = np.flatnonzero(given[points].ravel())
    while len(left):
        weight = np.linalg.inv(S[np.ix_(left, left)])
        v = weight @ miss[left]
        w = np.abs(v) / np.sqrt(np.diag(weight))
        if w.max() <= CONTROL_CLEAR * critical and miss[left] @ v <= joint_limit(critical, len(left)):
            break
        worst = int(w.argmax())
        out[points[left[worst] // 3], left[worst] % 3] = True
        left = np.delete(left, worst)
    if out.any(axis=1).sum() > len(points) / 2:
        out[:] = False
    return out


def _leave_out(solution: SceneSolution, critical: float, use: NDArray[np.bool_], given: NDArray[np.bool_]) -> None:
    """Take out of the masks what fails most."""
    point = solution.problem.block.rays.point
    largest = np.abs(solution.test).max(axis=1, initial=0.0)
    w = np.where(solution.ray_weight, failing_w(largest, solution.joint, critical), 0.0)
    w_given = np.abs(solution.given_test) * given
    if _scale(solution) > CONTROL_FIT:
        w_given = np.zeros_like(w_given)
    worst = max(float(w.max(initial=0.0)), float(w_given.max(initial=0.0)))
    limit = max(critical, TOGETHER * worst)
    failing = np.flatnonzero(w > limit)
    first = failing[largest_of_group(point[failing], solution.joint[failing])]
    of_point = w_given.max(axis=1, initial=0.0)
    clear = max(limit, CONTROL_CLEAR * critical)
    p, axis = np.nonzero((w_given > clear) & (w_given == of_point[:, None]))
    of_ray = np.zeros(len(of_point))
    of_ray[point[first]] = np.sqrt(solution.joint[first])
    takes = of_point[p] >= of_ray[p]
    p, axis = p[takes], axis[takes]
    use[first[~np.isin(point[first], p)]] = False
    given[p, axis] = False


def _bring_back(
    solution: SceneSolution,
    critical: float,
    use: NDArray[np.bool_],
    given: NDArray[np.bool_],
    returned: NDArray[np.bool_],
    returned_given: set[tuple[int, int]],
) -> None:
    """Put back into the masks what agrees with the adjustment without it, each once."""
    point = solution.problem.block.rays.point
    largest = np.abs(solution.test).max(axis=1, initial=0.0)
    agrees = ~use & ~returned & solution.determined[point] & (largest > 0)
    agrees &= failing_w(largest, solution.joint, critical) <= critical
    candidates = np.flatnonzero(agrees)
    first = candidates[largest_of_group(point[candidates], -solution.joint[candidates])]
    use[first], returned[first] = True, True
    if len(first):
        return
    problem = solution.problem
    for p, axis in zip(*np.nonzero(problem.given & ~given), strict=True):
        if (int(p), int(axis)) in returned_given or not solution.determined[p]:
            continue
        miss = problem.R_e_enu[p][:, axis] @ (problem.given_e[p] - solution.state.position_e[p])
        variance = problem.covariance_enu[p, axis, axis] + solution.points_covariance[p, axis, axis]
        if miss**2 <= critical**2 * variance:
            given[p, axis] = True
            returned_given.add((int(p), int(axis)))


def _exchange(
    solution: SceneSolution, critical: float, use: NDArray[np.bool_], given: NDArray[np.bool_], exchanged: set[int]
) -> SceneSolution:
    """Put back into the masks all image points of a point that went, in place of its given coordinates.

    Each point once, and only where its image points, three or more, agree with each other; so do the image points, two
    or more, of a point without given coordinates that has no place any more.

    Returns
    -------
    SceneSolution ; the same, with these points where their rays meet, from where the adjustment goes on
    """
    problem, point = solution.problem, solution.problem.block.rays.point
    n = len(given)
    rays, kept = np.bincount(point, minlength=n), np.bincount(point, use, n)
    deserted = given.any(axis=1) & (rays >= 3) & (kept == 0)
    deserted |= ~given.any(axis=1) & (rays >= 2) & (kept < rays) & ~solution.determined
    deserted[list(exchanged)] = False
    points = np.flatnonzero(deserted)
    if not len(points):
        return solution
    exchanged.update(points.tolist())
    mine = deserted[point]
    met, determined = intersect(problem, solution.state, mine)
    state = State(met, solution.state.values)
    v = linearise(problem, state, mine, np.zeros_like(given)).misclosure
    agrees = np.square(v).sum(axis=1) <= joint_limit(critical) * ORIENTATION_SHARE**2  # not so where it is NaN
    position = solution.state.position_e.copy()
    for p in points:
        own = point == p
        if determined[p] and agrees[own].all():
            use[own], given[p], position[p] = True, False, met[p]
    return replace(solution, state=State(position, solution.state.values))
