"""The adjustment of a block of scenes: Gauss-Newton with the points eliminated, covariance of everything.

Whitened equations of a ray are ``l = A_t dt + A_p dp + v`` with the unknowns t of the images and the correction p of
its point in east, north, up. The normal equations of a point are of order 3, so that with ``N_pp = L L'`` and ``W =
N_tp L'^-1`` the reduced matrix is ``S = N_tt - W W'``; cofactors of points are ``N_pp^-1 + N_pp^-1 N_pt S^-1 N_tp
N_pp^-1``.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

from .block import Indices, SceneBlock
from .functional import R_e_enu
from .images import Equations, MeasuredRays

Array = NDArray[np.floating]

#: Gauss-Newton ends when no residual changes by more, in units of its sigma.
_CONVERGED = 1e-7
#: Steps of Gauss-Newton, at most, where nobody says otherwise.
MOST_ITERATIONS = 20
#: A point is determined if the smallest eigenvalue of its scaled normal equations is above this. Derived: rays that
#: meet at an angle of 1e-3 give 1e-6.
_POINT_RANK = 1e-9
#: Eigenvalues of the scaled reduced normal equations below this are directions without information.
_RANK = 1e-12
#: Steps of the intersection of points before the adjustment.
_INTERSECTION_STEPS = 6


class NotAdjustableError(ValueError):
    """A block from which nothing can be computed."""


@dataclass(frozen=True)
class State:
    """Object points (p, 3), Earth-fixed metres, and values (u,) of the images' unknowns."""

    position_e: Array
    values: Array


@dataclass(frozen=True)
class Problem:
    """A block made ready.

    Attributes
    ----------
    block : images, points, control
    rays : measured rays of each image
    R_e_enu : (p, 3, 3) axes of each point
    start : where the adjustment begins; points from intersection with the unknowns as they are beforehand
    given_e, information : (p, 3) known coordinates of points, and (p, 3, 3) their information, east, north, up
    given : (p, 3) coordinates that are observations
    prior, prior_value : whitened a-priori equations of the unknowns
    """

    block: SceneBlock
    rays: tuple[MeasuredRays, ...]
    R_e_enu: Array
    start: State
    given_e: Array
    covariance_enu: Array
    given: NDArray[np.bool_]
    prior: Array = field(repr=False)
    prior_value: Array = field(repr=False)


@dataclass(frozen=True)
class Normals:
    """Normal equations at a state, and what they were made of."""

    misclosure: Array  # (n, 2) whitened
    A_point: Array  # (n, 2, 3)
    A_unknown: tuple[Array, ...]  # per image (m, 2, k)
    seen: NDArray[np.bool_]  # rays that take part
    N_tt: Array
    n_t: Array
    N_pp: Array
    n_p: Array
    N_tp: Array  # (p, u, 3)
    determined: NDArray[np.bool_]  # points
    squares: float


@dataclass(frozen=True)
class SceneSolution:
    """An adjusted block.

    Attributes
    ----------
    problem, state : what was adjusted, and the result
    ray_weight, given : rays (n,) and known coordinates (p, 3) that took part
    determined : (p,) points that rays and control determine
    values_covariance : (u, u) of the unknowns of the images, for sigma0 = 1
    points_covariance : (p, 3, 3) m2, east, north, up, for sigma0 = 1; NaN where not determined
    residual_px : (n, 2) measured minus computed; NaN where a model does not see the point
    redundancy_numbers : (n, 2) of the rays; of those left out 0
    test, joint : (n, 2) normalised residuals and (n,) joint test values; of rays left out against the adjustment
    given_test : (p, 3) normalised residuals of known coordinates; 0 where not given
    undetermined : words for unknowns without information
    weighted_squares, n_observations, n_unknowns : of the adjustment; without assumed values that the data determine
    iterations, converged : of Gauss-Newton
    """

    problem: Problem
    state: State
    ray_weight: NDArray[np.bool_]
    given: NDArray[np.bool_]
    determined: NDArray[np.bool_]
    values_covariance: Array
    points_covariance: Array
    residual_px: Array
    redundancy_numbers: Array
    test: Array
    joint: Array
    given_test: Array
    undetermined: tuple[str, ...]
    weighted_squares: float
    n_observations: int
    n_unknowns: int
    iterations: int
    converged: bool

    @property
    def redundancy(self) -> int:
        return self.n_observations - self.n_unknowns

    @property
    def sigma0(self) -> float:
        """A-posteriori sigma of unit weight; 1 without redundancy."""
        return float(np.sqrt(self.weighted_squares / self.redundancy)) if self.redundancy > 0 else 1.0

    @property
    def measured_redundancy(self) -> float:
        """Share of image points and known coordinates in the redundancy."""
        points, axes = np.nonzero(self.given)
        left = self.points_covariance[points, axes, axes] / self.problem.covariance_enu[points, axes, axes]
        return float(self.redundancy_numbers.sum() + np.clip(1.0 - left, 0.0, 1.0).sum())


def prepare(block: SceneBlock) -> Problem:
    """Measured rays, axes of points and start values.

    Raises
    ------
    NotAdjustableError : no image points, lines that orbit or attitude do not cover, models that too few known points
        would determine
    """
    if not len(block.rays):
        raise NotAdjustableError("no image points")
    n = len(block.point_ids)
    rays = []
    for image, mine in zip(block.images, block.rays_of, strict=True):
        try:
            rays.append(image.measured(block.rays.line[mine], block.rays.sample[mine]))
        except ValueError as error:
            raise NotAdjustableError(f"image {image.name}: {error}") from None
    known = block.known
    given_e, covariance, given = np.full((n, 3), np.nan), np.full((n, 3, 3), np.nan), np.zeros((n, 3), dtype=bool)
    given_e[known.point], covariance[known.point], given[known.point] = (
        known.position_e, known.covariance_enu, known.given,
    )  # fmt: skip
    if not any(image.locates for image in block.images) and not given.all(axis=1).any():
        raise NotAdjustableError("no image that can locate, and no control points")
    position = _first_positions(block, given_e)
    axes = _axes(block, position)
    prior, prior_value = block.layout.prior()
    zero = np.zeros(block.layout.n_unknowns)
    problem = Problem(block, tuple(rays), axes, State(position, zero), given_e, covariance, given, prior, prior_value)
    locating = np.array([image.locates for image in block.images])[block.rays.image]
    position, fixed = intersect(problem, State(position, zero), locating)
    with_place = fixed | np.isfinite(given_e).all(axis=1) & given.all(axis=1)
    values = zero.copy()
    for image, mine, columns in zip(block.images, block.rays_of, block.layout.columns, strict=True):
        points = block.rays.point[mine]
        use = np.flatnonzero(with_place[points])
        trusted = use[given[points[use]].all(axis=1)]
        if len(trusted) >= len(use) / 2 or (not image.locates and len(trusted) > 6):
            use = trusted
        try:
            values[columns] = image.start(
                block.rays.line[mine][use], block.rays.sample[mine][use], position[points[use]]
            )
        except ValueError as error:
            raise NotAdjustableError(str(error)) from None
    state = State(position, values)
    everything = np.ones(len(block.rays), dtype=bool)
    again, now = intersect(problem, state, everything)
    lost = now & ~with_place
    position = np.where(lost[:, None], again, position)
    axes = _axes(block, position)
    return Problem(block, tuple(rays), axes, State(position, values), given_e, covariance, given, prior, prior_value)


def _axes(block: SceneBlock, position: Array) -> Array:
    lat, lon, _ = block.ellipsoid.geodetic(position).T
    return R_e_enu(lat, lon)


def _first_positions(block: SceneBlock, given_e: Array) -> Array:
    """Points where they are known, or where a first ray reaches the middle height of what is known."""
    position = given_e.copy()
    here = np.isfinite(position).all(axis=1)
    height = float(np.median(block.ellipsoid.geodetic(position[here])[:, 2])) if here.any() else 0.0
    for image, mine, columns in zip(block.images, block.rays_of, block.layout.columns, strict=True):
        if not image.locates:
            continue
        points = block.rays.point[mine]
        wanted = np.flatnonzero(~np.isfinite(position[points]).all(axis=1))
        if not len(wanted):
            continue
        pixel = block.rays.line[mine][wanted], block.rays.sample[mine][wanted]
        located = image.located(np.zeros(len(columns))).direct(*pixel, height)
        position[points[wanted]] = block.ellipsoid.cartesian(*located.T)
    missing = ~np.isfinite(position).all(axis=1)
    if missing.any() and not missing.all():
        middle = block.ellipsoid.geodetic(position[~missing].mean(axis=0))
        position[missing] = block.ellipsoid.cartesian(middle[0], middle[1], height)
    if missing.all():
        raise NotAdjustableError("no ray reaches the ground, and no point is known")
    return position


def intersect(problem: Problem, state: State, use: NDArray[np.bool_]) -> tuple[Array, NDArray[np.bool_]]:
    """Points (p, 3) by intersection of rays with the unknowns held, and which are determined.

    Known coordinates do not take part; points that rays do not determine stay where they are.
    """
    position = state.position_e.copy()
    determined = np.zeros(len(position), dtype=bool)
    none = np.zeros_like(problem.given)
    for _ in range(_INTERSECTION_STEPS):
        normals = linearise(problem, State(position, state.values), use, none)
        determined = normals.determined
        if not determined.any():
            break
        step = np.linalg.solve(normals.N_pp[determined], normals.n_p[determined][:, :, None])[:, :, 0]
        moved = position[determined] + np.einsum("pij,pj->pi", problem.R_e_enu[determined], step)
        if not np.isfinite(moved).all():
            break
        position[determined] = moved
        if np.abs(step).max() < 1e-6:
            break
    return position, determined


def where_rays_meet(problem: Problem) -> tuple[Array, NDArray[np.bool_]]:
    """Points (p, 3) where their rays meet before anything is adjusted or known of them, and which are determined.

    Raises
    ------
    NotAdjustableError : no ray of an image that locates by itself reaches the ground
    """
    block = problem.block
    start = _first_positions(block, np.full_like(problem.given_e, np.nan))
    locating = np.array([image.locates for image in block.images])[block.rays.image]
    return intersect(problem, State(start, np.zeros(block.layout.n_unknowns)), locating)


def linearise(problem: Problem, state: State, use: NDArray[np.bool_], given: NDArray[np.bool_]) -> Normals:
    """Normal equations of rays, known coordinates and a-priori knowledge that take part, at a state.

    Parameters
    ----------
    use, given : (n,) which rays, and (p, 3) which known coordinates take part
    """
    block, u = problem.block, problem.block.layout.n_unknowns
    n, p = len(block.rays), len(block.point_ids)
    point, sigma = block.rays.point, block.rays.sigma_px
    misclosure, A_point = np.zeros((n, 2)), np.zeros((n, 2, 3))
    A_unknown: list[Array] = []
    seen = np.zeros(n, dtype=bool)
    N_tt, n_t, N_tp = np.zeros((u, u)), np.zeros(u), np.zeros((p, u, 3))
    for rays, mine, columns in zip(problem.rays, block.rays_of, block.layout.columns, strict=True):
        equations: Equations = rays.equations(state.position_e[point[mine]], state.values[columns])
        good = np.asarray(np.isfinite(equations.misclosure_px).all(axis=1))
        weight = 1.0 / sigma[mine][:, None]
        misclosure[mine] = np.where(good[:, None], equations.misclosure_px, np.nan) * weight
        A_point[mine] = equations.by_point @ problem.R_e_enu[point[mine]] * weight[:, :, None]
        A = equations.by_unknown * weight[:, :, None]
        A_unknown.append(A)
        seen[mine] = good & use[mine]
        on = np.flatnonzero(seen[mine])
        rows = A[on].reshape(-1, len(columns))
        N_tt[np.ix_(columns, columns)] += rows.T @ rows
        n_t[columns] += rows.T @ misclosure[mine[on]].ravel()
        cross = np.einsum("nik,nij->nkj", A[on], A_point[mine[on]])
        np.add.at(N_tp, (point[mine[on]][:, None], columns[None, :]), cross)
    on = np.flatnonzero(seen)
    N_pp, n_p = np.zeros((p, 3, 3)), np.zeros((p, 3))
    np.add.at(N_pp, point[on], np.einsum("nij,nik->njk", A_point[on], A_point[on]))
    np.add.at(n_p, point[on], np.einsum("nij,ni->nj", A_point[on], misclosure[on]))
    squares = float(np.square(misclosure[on]).sum())
    W, miss = _control(problem, state, given)
    N_pp += W
    n_p += np.einsum("pij,pj->pi", W, miss)
    squares += float(np.einsum("pi,pij,pj->", miss, W, miss))
    scale = np.sqrt(np.maximum(np.einsum("pii->pi", N_pp), 1e-300))
    values = np.linalg.eigvalsh(N_pp / (scale[:, :, None] * scale[:, None, :]))
    determined = (values[:, 0] > _POINT_RANK) & np.isfinite(values).all(axis=1)
    away = problem.prior_value - problem.prior @ state.values
    N_tt += problem.prior.T @ problem.prior
    n_t += problem.prior.T @ away
    squares += float(away @ away)
    lost = ~determined[point]
    if (lost & seen).any():  # rays that determine nothing: their equations would be held by the point
        out = seen & lost
        return linearise(problem, state, use & ~out, given & determined[:, None])
    return Normals(misclosure, A_point, tuple(A_unknown), seen, N_tt, n_t, N_pp, n_p, N_tp, determined, squares)


def _control(problem: Problem, state: State, given: NDArray[np.bool_]) -> tuple[Array, Array]:
    """Information (p, 3, 3) of known coordinates that take part, and given minus present ones (p, 3), ENU."""
    p = len(given)
    W, miss = np.zeros((p, 3, 3)), np.zeros((p, 3))
    points = np.flatnonzero(given.any(axis=1))
    if not len(points):
        return W, miss
    d = problem.given_e[points] - state.position_e[points]
    miss[points] = np.einsum("pji,pj->pi", problem.R_e_enu[points], d)
    for i in points:
        axes = np.flatnonzero(given[i])
        W[np.ix_([i], axes, axes)] = np.linalg.inv(problem.covariance_enu[i][np.ix_(axes, axes)])
    return W, miss


@dataclass(frozen=True)
class _Reduced:
    """Solved normal equations: steps and cofactors."""

    step_t: Array
    step_p: Array
    Q_t: Array
    inverse_pp: Array
    undetermined: Array  # (k, u) directions without information


def _reduce(normals: Normals) -> _Reduced:
    p, u = len(normals.N_pp), len(normals.N_tt)
    on = normals.determined
    # scaled as for the test that they are determined, so that those that pass it have a root
    half, scale_p = np.zeros((p, 3, 3)), np.sqrt(np.einsum("pii->pi", normals.N_pp[on]))
    roots = np.linalg.cholesky(normals.N_pp[on] / (scale_p[:, :, None] * scale_p[:, None, :]))
    half[on] = np.swapaxes(np.linalg.inv(roots), -1, -2) / scale_p[:, :, None]
    inverse = half @ np.swapaxes(half, -1, -2)
    W = (normals.N_tp @ half).transpose(1, 0, 2).reshape(u, -1)
    S = normals.N_tt - W @ W.T
    rhs = normals.n_t - np.einsum("puj,pjk,pk->u", normals.N_tp, inverse, normals.n_p, optimize=True)
    scale = np.sqrt(np.maximum(np.diag(normals.N_tt), 1e-300))
    scaled = S / np.outer(scale, scale)
    scaled = 0.5 * (scaled + scaled.T)
    null = np.empty((0, u))
    try:
        if not u:
            raise np.linalg.LinAlgError
        factor = cho_factor(scaled, lower=True)
        if np.square(np.diag(factor[0])).min() < 1e3 * _RANK:
            raise np.linalg.LinAlgError
        Q = cho_solve(factor, np.eye(u))
    except np.linalg.LinAlgError:
        values, vectors = np.linalg.eigh(scaled) if u else (np.empty(0), np.empty((0, 0)))
        good = values > _RANK * max(float(values.max(initial=0.0)), 1e-300)
        Q = (vectors[:, good] / values[good]) @ vectors[:, good].T
        null = vectors[:, ~good].T
    Q = Q / np.outer(scale, scale)
    step_t = Q @ rhs
    left = normals.n_p - np.einsum("puj,u->pj", normals.N_tp, step_t)
    return _Reduced(step_t, np.einsum("pij,pj->pi", inverse, left), Q, inverse, null)


def adjust(
    problem: Problem,
    state: State | None = None,
    use: NDArray[np.bool_] | None = None,
    given: NDArray[np.bool_] | None = None,
    max_iterations: int = MOST_ITERATIONS,
) -> SceneSolution:
    """Adjust a block.

    Parameters
    ----------
    problem : from `prepare`
    state : where to begin; None for the problem's start
    use, given : rays (n,) and known coordinates (p, 3) that take part; None for all
    max_iterations : of Gauss-Newton

    Raises
    ------
    NotAdjustableError : nothing that is determined, or a solution that is not finite
    """
    state = problem.start if state is None else state
    use = np.ones(len(problem.block.rays), dtype=bool) if use is None else use
    given = problem.given if given is None else given
    converged, iterations = False, 0
    normals = linearise(problem, state, use, given)
    while iterations < max_iterations and not converged:
        iterations += 1
        if not normals.determined.any():
            raise NotAdjustableError("no point is determined: every point wants two rays, or one and control")
        reduced = _reduce(normals)
        position = state.position_e + np.einsum("pij,pj->pi", problem.R_e_enu, reduced.step_p)
        change = _changes(problem, normals, reduced)
        state = State(position, state.values + reduced.step_t)
        normals = linearise(problem, state, use, given)
        if not (np.isfinite(state.position_e).all() and np.isfinite(state.values).all()):
            raise NotAdjustableError("the adjustment does not converge: its unknowns are no longer finite")
        converged = change < _CONVERGED
    return _result(problem, state, normals, use, given, iterations, converged)


def _changes(problem: Problem, normals: Normals, reduced: _Reduced) -> float:
    """Largest change of a whitened residual that a step makes."""
    block = problem.block
    largest = 0.0
    for A, mine, columns in zip(normals.A_unknown, block.rays_of, block.layout.columns, strict=True):
        on = normals.seen[mine]
        rays = mine[on]
        change = A[on] @ reduced.step_t[columns]
        change += np.einsum("nij,nj->ni", normals.A_point[rays], reduced.step_p[block.rays.point[rays]])
        largest = max(largest, float(np.abs(change).max(initial=0.0)))
    return largest


def _result(
    problem: Problem, state: State, normals: Normals, use: NDArray[np.bool_], given: NDArray[np.bool_],
    iterations: int, converged: bool,
) -> SceneSolution:  # fmt: skip
    block = problem.block
    reduced = _reduce(normals)
    inverse, Q = reduced.inverse_pp, reduced.Q_t
    F = normals.N_tp @ inverse  # (p, u, 3): how points follow the unknowns, with a minus
    FQ = np.einsum("puj,uv->pjv", F, Q, optimize=True)  # (p, 3, u)
    C_pp = inverse + FQ @ F
    points = np.where(normals.determined[:, None, None], C_pp, np.nan)
    n = len(block.rays)
    sigma = block.rays.sigma_px
    redundancy, test, joint = np.zeros((n, 2)), np.zeros((n, 2)), np.zeros(n)
    for A, mine, columns in zip(normals.A_unknown, block.rays_of, block.layout.columns, strict=True):
        p = block.rays.point[mine]
        B = normals.A_point[mine]
        cross = B @ FQ[p][:, :, columns] @ np.swapaxes(A, -1, -2)
        M = A @ Q[np.ix_(columns, columns)] @ np.swapaxes(A, -1, -2) - cross - np.swapaxes(cross, -1, -2)
        M += B @ C_pp[p] @ np.swapaxes(B, -1, -2)
        inside = normals.seen[mine]
        known = normals.determined[p] & np.isfinite(normals.misclosure[mine]).all(axis=1)
        Qv = np.eye(2) + np.where(inside[:, None, None], -M, M)
        redundancy[mine] = np.where(inside[:, None], np.clip(np.einsum("nii->ni", Qv), 0.0, 1.0), 0.0)
        test[mine], joint[mine] = _tests(normals.misclosure[mine], Qv, known)
    given_now = given & normals.determined[:, None]
    count = 2 * int(normals.seen.sum()) + len(problem.prior) + int(given_now.sum())
    unknowns = block.layout.n_unknowns - len(reduced.undetermined) + 3 * int(normals.determined.sum())
    replaced, squares = _assumed(problem, state, Q)
    return SceneSolution(
        problem,
        state,
        use & normals.seen,
        given_now,
        normals.determined,
        Q,
        points,
        normals.misclosure * sigma[:, None],
        redundancy,
        test,
        joint,
        _given_tests(problem, state, given_now, C_pp),
        _words(reduced.undetermined, block.layout.names),
        normals.squares - squares,
        count - replaced,
        unknowns,
        iterations,
        converged,
    )


def _assumed(problem: Problem, state: State, Q: Array) -> tuple[int, float]:
    """How many values that nobody stated the data determine by themselves, and the squares of the residuals of all.

    Their wide sigmas say nothing of the data: counted as observations, whose residuals are next to nothing,
    they made sigma0 too small.
    """
    mine = problem.block.layout.assumed()
    A = problem.prior[mine]
    away = problem.prior_value[mine] - A @ state.values
    share = np.clip(1.0 - np.einsum("mu,uv,mv->m", A, Q, A), 0.0, 1.0)
    return round(float(share.sum())), float(away @ away)


def _tests(v: Array, Qv: Array, known: NDArray[np.bool_]) -> tuple[Array, Array]:
    """Normalised residuals (n, 2), and joint test values (n,) of line and sample, 0 where nothing controls them."""
    w, joint = np.zeros_like(v), np.zeros(len(v))
    diagonal = np.einsum("nii->ni", Qv)
    free = known[:, None] & (diagonal > 1e-6)
    w[free] = v[free] / np.sqrt(diagonal[free])
    determinant = Qv[:, 0, 0] * Qv[:, 1, 1] - Qv[:, 0, 1] ** 2
    both = free.all(axis=1) & (determinant > 1e-6 * diagonal[:, 0] * diagonal[:, 1])
    joint[both] = np.einsum("ni,nij,nj->n", v[both], np.linalg.inv(Qv[both]), v[both])
    joint[~both] = np.square(w[~both]).max(axis=1, initial=0.0)
    return w, joint


def _given_tests(problem: Problem, state: State, given: NDArray[np.bool_], C_pp: Array) -> Array:
    """Normalised residuals (p, 3) of known coordinates: given minus adjusted."""
    w = np.zeros(given.shape)
    points, axes = np.nonzero(given)
    if len(points):
        _, miss = _control(problem, state, given)
        variance = problem.covariance_enu[points, axes, axes] - C_pp[points, axes, axes]
        total = problem.covariance_enu[points, axes, axes]
        free = variance > 1e-6 * total
        w[points[free], axes[free]] = miss[points[free], axes[free]] / np.sqrt(variance[free])
    return w


def _words(null: Array, names: tuple[str, ...]) -> tuple[str, ...]:
    """Directions without information by their largest unknowns."""
    words = []
    for direction in null:
        largest = [k for k in np.argsort(-np.abs(direction)) if abs(direction[k]) > 0.3][:3]
        words.append(" with ".join(names[k] for k in largest) or "many unknowns together")
    return tuple(words)


def joint_covariance(solution: SceneSolution, points: Indices) -> Array:
    """Covariance (3 k, 3 k) of adjusted points (k,), each in its own east, north, up; m2, for sigma0 = 1."""
    normals = linearise(solution.problem, solution.state, solution.ray_weight, solution.given)
    reduced = _reduce(normals)
    F = (normals.N_tp[points] @ reduced.inverse_pp[points]).transpose(0, 2, 1).reshape(-1, len(normals.N_tt))
    covariance = F @ reduced.Q_t @ F.T
    own = np.arange(len(points))
    covariance.reshape(len(points), 3, len(points), 3)[own, :, own, :] += reduced.inverse_pp[points]
    return covariance


def points_enu(problem: Problem, position_e: Array, reference_e: Array, points: Indices) -> Array:
    """Differences (k, 3) in metres, east, north, up, of positions (p, 3) from references (k, 3) of points (k,)."""
    return np.einsum("pji,pj->pi", problem.R_e_enu[points], position_e[points] - reference_e)
