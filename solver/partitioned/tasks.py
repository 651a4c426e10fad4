"""What is done with one partition: pure but for the objects it reads and writes in the store.

Names in the store: ``network-K`` the partition as it came, ``part-K`` as it was posed, ``state-K-V`` the values it has
reached, in version V, and ``result-K`` what a solution says of its points and rays. A task reads one version and writes
the next, so that it may run twice.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from ..adjustment.covariance import cofactors
from ..adjustment.direct_georeferencing import georeference_posed
from ..adjustment.equations import BlockEquations, Outcome, Reached
from ..adjustment.layout import RayShift, layout_of, sets_of_rays
from ..adjustment.linearisation import Linearisation, Whitening
from ..adjustment.network import Network
from ..adjustment.normal_equations import PointNormals, whiten_prior
from ..adjustment.normal_matrix import DenseMatrix
from ..adjustment.point_consensus import consensus_of_points
from ..adjustment.pose_noise import Pieces, left_of_noise, noise_information, noise_left
from ..adjustment.problem import Solution, State
from ..adjustment.ray_statistics import RayStatistics, ray_statistics
from ..adjustment.reduced_system import Undetermined
from ..adjustment.robust import WeightFunction
from .part import Part, Posed, pose_part
from .runner import Store

Array = NDArray[np.floating]
IntArray = NDArray[np.int64]


class Extents(NamedTuple):
    """What the correction sets of a block have to know of a partition.

    Attributes
    ----------
    ray_time_s, control_time_s : by number of the set, of the rays, and of those to control
    rays, points : how many there are
    """

    ray_time_s: dict[int, Array]
    control_time_s: dict[int, Array]
    rays: int
    points: int

    def and_(self, other: Extents) -> Extents:
        """Both together."""

        def joined(a: dict[int, Array], b: dict[int, Array]) -> dict[int, Array]:
            none = np.empty(0)
            return {k: np.concatenate([a.get(k, none), b.get(k, none)]) for k in a.keys() | b.keys()}

        return Extents(
            joined(self.ray_time_s, other.ray_time_s),
            joined(self.control_time_s, other.control_time_s),
            self.rays + other.rays,
            self.points + other.points,
        )


class Plan(NamedTuple):
    """What the solution of a block has to know of a posed partition: its unknowns, and which of them meet."""

    columns: IntArray
    cliques: tuple[IntArray, ...]
    n_control: int


@dataclass(frozen=True)
class Sums:
    """What partitions say of the unknowns; sums go together with ``+``.

    Attributes
    ----------
    matrix : (n, n) lower triangle of the reduced normal equations
    rhs, diagonal : (n,) right-hand side; diagonal before the points were eliminated, damped
    squares : sum of the squared ``y`` of the points
    cost : sum of squared whitened residuals of rays and control
    rank : determined directions of the points
    """

    matrix: csr_array
    rhs: Array
    diagonal: Array
    squares: float
    cost: float
    rank: int

    def __add__(self, other: Sums) -> Sums:
        return Sums(
            csr_array(self.matrix + other.matrix),
            self.rhs + other.rhs,
            self.diagonal + other.diagonal,
            self.squares + other.squares,
            self.cost + other.cost,
            self.rank + other.rank,
        )


class Changes(NamedTuple):
    """What is done to a partition before its equations are formed, in this order.

    Attributes
    ----------
    take : take the step that was tried last
    image : factor on the sigmas of the rays
    given : (n,) weights of the rays from now on
    control : (p, 3) weights of the control coordinates from now on
    renew : take weights anew
    reweigh : robust weight function and scale of the residuals; no function for the given weights
    """

    take: bool = False
    image: float = 1.0
    given: Array | None = None
    control: Array | None = None
    renew: bool = False
    reweigh: tuple[WeightFunction | None, float] | None = None

    def __bool__(self) -> bool:
        kept = self.given is None and self.control is None and self.reweigh is None and self.image == 1.0
        return not kept or self.take or self.renew


class _Saved(NamedTuple):
    """The state of a partition's equations, without what the posed partition holds."""

    state: State
    g: Array
    linearisation: Linearisation
    camera: Array | None
    shift: RayShift | None
    given: Array
    weight: Array
    control: Array
    keep_weights: bool
    points: PointNormals | None
    trial: tuple[State, Array | None, Linearisation, Array | None, RayShift | None] | None


def extents(store: Store, key: int) -> Extents:
    """Times of the rays of a partition."""
    network: Network = store.load(f"network-{key}")
    number, present, _ = sets_of_rays(network)
    is_control = np.zeros(network.n_points, dtype=bool)
    is_control[network.control.point] = True
    times = {int(k): network.rays.time_s[number == k] for k in present}
    of_control = {int(k): network.rays.time_s[(number == k) & is_control[network.rays.point]] for k in present}
    return Extents(times, of_control, len(network.rays), network.n_points)


def pose(store: Store, key: int) -> Plan:
    """Pose a partition (``part-K``) as the block is (object ``posed``)."""
    return _posed(store, key, store.load(f"network-{key}"))


def _posed(store: Store, key: int, network: Network) -> Plan:
    posed: Posed = store.load("posed")
    if posed.platform.n_unknowns:  # whose effect needs the trajectories
        network = replace(network, strips=store.load("strips"))
    part = pose_part(network, posed)
    store.save(f"part-{key}", part)
    meet = {c.columns.tobytes(): c.columns for c in part.problem.elimination.clusters if len(c.columns)}
    control = part.problem.control.n_observations
    return Plan(part.columns, tuple(part.columns[c] for c in meet.values()), control)


def begin(store: Store, key: int, write: int, weights: str, given: Array | None, start: State | None) -> float:
    """Equations of a posed partition at its start, with weights (n,) of its rays; the cost there."""
    part: Part = store.load(f"part-{key}")
    weight = np.ones(len(part.problem.network.rays)) if given is None else given
    equations = BlockEquations(part.problem, start, weight, weights)
    _save(store, key, write, equations)
    return equations.cost


def residuals(store: Store, key: int, read: int) -> Array:
    """Absolute whitened residuals of the rays with given weight, for the scale of robust weights."""
    return _load(store, key, read)[1].used_residuals().ravel()


def add(a: float, b: float) -> float:
    """The sum."""
    return a + b


def join(a: Array, b: Array) -> Array:
    """Both arrays."""
    return np.concatenate([a, b])


def change(store: Store, key: int, read: int, write: int, changes: Changes) -> float:
    """Change a partition; its cost then."""
    equations = _changed(store, key, read, changes)[1]
    _save(store, key, write, equations)
    return equations.cost


def form(store: Store, key: int, read: int, write: int, n: int, changes: Changes, damping: float) -> Sums:
    """Change a partition, and form what it says of the n unknowns of the block."""
    part, equations = _changed(store, key, read, changes)
    normals = equations.form(damping)
    _save(store, key, write, equations)
    assert isinstance(normals.matrix, DenseMatrix) and normals.matrix.reference is not None
    assert equations.points is not None
    row, column = np.nonzero(np.tril(normals.matrix.lower))
    rhs, diagonal = np.zeros(n), np.zeros(n)
    rhs[part.columns], diagonal[part.columns] = normals.rhs, normals.matrix.reference
    places = (normals.matrix.lower[row, column], (part.columns[row], part.columns[column]))
    rank = int(equations.points.rank.sum())
    return Sums(csr_array(places, shape=(n, n)), rhs, diagonal, normals.squares, equations.cost, rank)


def attempt(store: Store, key: int, read: int, write: int, d_theta: Array, renewed: bool) -> float:
    """Try a step (u,) of the partition's unknowns; the cost it leads to."""
    _, equations = _load(store, key, read)
    cost = equations.attempt(d_theta, renewed)
    _save(store, key, write, equations)
    return cost


@dataclass(frozen=True)
class Described:
    """What a solution says of the points and rays of a partition.

    Attributes
    ----------
    point_ids : (p,)
    points_l, rank : (p, 3) metres, (p,)
    point_cofactors : (p, 3, 3) m^2
    weight, rays : (n,) of the rays, with their statistics
    squares : (n,) squared whitened residuals
    observed : (n, 2, 2) cofactors of the adjusted image coordinates, whitened
    """

    point_ids: tuple[str, ...]
    points_l: Array
    rank: IntArray
    point_cofactors: Array
    weight: Array
    rays: RayStatistics
    squares: Array
    observed: Array


@dataclass(frozen=True)
class Totals:
    """Sums over rays and control of partitions.

    Attributes
    ----------
    image, control : number of observations, ``v^T P v``, redundancy
    largest_w : of rays that take part
    """

    image: Array
    control: Array
    largest_w: float

    def __add__(self, other: Totals) -> Totals:
        largest = max(self.largest_w, other.largest_w)
        return Totals(self.image + other.image, self.control + other.control, largest)


class Blocks:
    """Cofactors of a block among unknowns of a partition that meet: blocks by their columns, or one for all."""

    def __init__(self, blocks: Sequence[tuple[IntArray, Array]] | Array, variances: Array):
        self.undetermined = Undetermined(np.empty((len(variances), 0)), np.empty(0), np.ones(len(variances)))
        self._variances = variances
        self._all = blocks if isinstance(blocks, np.ndarray) else None
        self._blocks = {} if isinstance(blocks, np.ndarray) else {c.tobytes(): Q for c, Q in blocks}

    def solve(self, rhs: Array) -> Array:
        raise TypeError("a partition knows its own cofactors only")

    def cofactors(self, columns: IntArray) -> Array:
        """Block (m, m) of unknowns of the partition that one cluster of points has."""
        if self._all is not None:
            return self._all[np.ix_(columns, columns)]
        return self._blocks[columns.tobytes()] if len(columns) else np.empty((0, 0))

    def variances(self) -> Array:
        return self._variances


def described(
    store: Store, key: int, read: int, cofactors_of: Array | tuple[Array, ...], variances: Array
) -> Described:
    """Statistics of a partition, given the block's cofactors of its unknowns: all (u, u), or those of its
    `Plan.cliques`."""
    part, equations = _load(store, key, read)
    given: Sequence[tuple[IntArray, Array]] | Array
    if isinstance(cofactors_of, np.ndarray):
        given = cofactors_of
    else:
        meet = {c.columns.tobytes(): c.columns for c in part.problem.elimination.clusters if len(c.columns)}
        given = list(zip(meet.values(), cofactors_of, strict=True))
    solution = _solution(equations, Blocks(given, variances))
    Q = cofactors(solution)
    v = solution.linearisation.residual
    return Described(
        part.problem.network.point_ids,
        solution.state.points_l,
        solution.points.rank,
        Q.points,
        equations.weight,
        ray_statistics(solution, Q),
        (v * v).sum(axis=0),
        Q.observed,
    )


def describe(store: Store, key: int, read: int, cofactors_of: Array | tuple[Array, ...], variances: Array) -> Totals:
    """`described`, into the store (``result-K``); sums of it."""
    found = described(store, key, read, cofactors_of, variances)
    store.save(f"result-{key}", found)
    _, equations = _load(store, key, read)
    used = found.weight > 0
    left = np.where(used, 2.0 - found.weight * np.einsum("nii->n", found.observed), 0.0)
    image = [2.0 * used.sum(), (found.weight * found.squares).sum(), left.sum()]
    control = equations.problem.control
    known = control.weight > 0
    c = control.residual(found.points_l)
    taken = control.weight * np.einsum("pii->pi", found.point_cofactors)
    of_control = [float(known.sum()), float(np.sum(c * c)), float(np.where(known, 1.0 - taken, 0.0).sum())]
    largest = float(found.rays.largest_w[used].max(initial=0.0))
    return Totals(np.array(image), np.array(of_control), largest)


class Points(NamedTuple):
    """Where the points of a partition are, how many of their directions are determined, and the rays' weights."""

    points_l: Array
    rank: IntArray
    weight: Array


def points(store: Store, key: int, read: int) -> Points:
    """Points of a partition."""
    equations = _load(store, key, read)[1]
    assert equations.points is not None
    return Points(equations.at.state.points_l, equations.points.rank, equations.weight)


def consensus(
    store: Store, key: int, read: int, places: IntArray, limit: float
) -> dict[int, tuple[IntArray, bool, Array]]:
    """`consensus_of_points` of some points of a partition."""
    _, equations = _load(store, key, read)
    none = Blocks(np.empty((0, 0)), np.empty(0))
    return consensus_of_points(_solution(equations, none), places, limit)


def information(store: Store, key: int, read: int) -> Pieces:
    """What the rays of a partition say of corrections (`pose_noise.noise_information`)."""
    _, equations = _load(store, key, read)
    return noise_information(_solution(equations, Blocks(np.empty((0, 0)), np.empty(0))))


def both(a: Pieces, b: Pieces) -> Pieces:
    """Information added up."""
    return {k: a[k] + b[k] if k in a and k in b else a[k] if k in a else b[k] for k in a.keys() | b.keys()}


def pose_with_noise(store: Store, key: int) -> Plan:
    """Pose a partition again, its rays weighed with what corrections (``pieces``) leave of the noise of poses."""
    network: Network = store.load(f"network-{key}")
    pieces, model, strips = store.load("pieces")
    assert network.rays.orientation_noise is not None
    left = noise_left(network.rays, pieces, strips, model)
    noise = left_of_noise(network.rays.orientation_noise, left)
    return _posed(store, key, replace(network, rays=replace(network.rays, orientation_noise=noise)))


def georeferenced(store: Store, key: int, weight: Array) -> tuple[Array, Array, Array]:
    """Points of a partition without adjustment, and their sigmas (see `direct_georeferencing`)."""
    part: Part = store.load(f"part-{key}")
    network, posed = part.problem.network, store.load("posed")
    number, _, _ = sets_of_rays(network)
    layout = layout_of(network, posed.sets, np.searchsorted(posed.present, number))
    found = georeference_posed(network, layout, whiten_prior(layout.prior, layout.n_unknowns), weight)
    return found.xyz_l, found.image_sigma_m, found.sigma_m


def _solution(equations: BlockEquations, factor: Blocks) -> Solution:
    return equations.solution(Outcome(factor, 0, True), ())


def _changed(store: Store, key: int, read: int, changes: Changes) -> tuple[Part, BlockEquations]:
    part, equations = _load(store, key, read)
    if changes.take:
        equations.take()
    if changes.image != 1.0:
        f = 1.0 / changes.image
        lin = equations.at.linearisation.reweighted(np.full(len(equations.given), f * f))
        equations.at = replace(equations.at, whitening=Whitening(equations.at.whitening.g * f), linearisation=lin)
    if changes.given is not None:
        equations.given = changes.given
    if changes.control is not None:
        control = equations.problem.control
        control = replace(control, weight=changes.control)
        equations.problem = replace(equations.problem, control=control)
    if changes.renew:
        equations.renew()
    if changes.reweigh is not None:
        equations.weigh(*changes.reweigh)
    elif changes:
        equations.refresh()
    return part, equations


def _save(store: Store, key: int, version: int, equations: BlockEquations) -> None:
    at, trial = equations.at, None
    if equations.trial is not None:
        reached = equations.trial[0]
        same = reached.whitening is at.whitening
        fitted = reached.layout.camera.xy_mm if reached.layout.camera and reached.layout is not at.layout else None
        trial = (
            reached.state,
            None if same else reached.whitening.g,
            reached.linearisation,
            fitted,
            reached.layout.shift if fitted is not None else None,
        )
    saved = _Saved(
        at.state,
        at.whitening.g,
        at.linearisation,
        at.layout.camera.xy_mm if at.layout.camera is not None else None,
        at.layout.shift,
        equations.given,
        equations.weight,
        equations.problem.control.weight,
        equations.keep_weights,
        equations.points,
        trial,
    )
    store.save(f"state-{key}-{version}", saved)


def _load(store: Store, key: int, version: int) -> tuple[Part, BlockEquations]:
    part: Part = store.load(f"part-{key}")
    saved: _Saved = store.load(f"state-{key}-{version}")
    equations = BlockEquations.__new__(BlockEquations)
    control = part.problem.control
    if saved.control is not control.weight:
        control = replace(control, weight=saved.control)
    equations.problem = replace(part.problem, control=control)
    equations.given, equations.weight = saved.given, saved.weight
    equations.keep_weights, equations.weights_given = saved.keep_weights, True
    layout = part.problem.layout
    if saved.camera is not None:
        layout = layout.fitted(saved.camera, saved.shift)
    whitening = Whitening(saved.g)
    equations.at = Reached(saved.state, whitening, saved.linearisation, layout)
    equations.points, equations.trial = saved.points, None
    equations.refresh()
    if saved.trial is not None:
        state, g, lin, xy_mm, shift = saved.trial
        weights = whitening if g is None else Whitening(g)
        place = layout if xy_mm is None else layout.fitted(xy_mm, shift)
        equations.retry(Reached(state, weights, lin, place))
    return part, equations
