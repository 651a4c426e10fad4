"""A block in partitions, its adjustment, and what the solution says of its points and rays."""

from __future__ import annotations

import weakref
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from ..adjustment.adjustment import descend
from ..adjustment.equations import Normals, Outcome, residual_scale
from ..adjustment.gauss_newton import Descent
from ..adjustment.layout import Unknowns, correction_sets, unknowns_of
from ..adjustment.nested_dissection import Dissection
from ..adjustment.network import Strip
from ..adjustment.normal_equations import Prior, whiten_prior
from ..adjustment.normal_matrix import NormalMatrix, Structure, find_structure, new_matrix
from ..adjustment.problem import USUAL, AdjustmentOptions, Fitted, Iteration, State, assumed_of
from ..adjustment.reduced_system import DenseFactor, Factor
from ..adjustment.robust import WeightFunction
from ..camera.line_camera import LineCamera
from ..camera.self_calibration import SelfCalibration
from ..models.base import ModelOptions
from ..models.platform import NO_PLATFORM_ERRORS, PlatformErrors
from . import tasks
from .part import Posed, without_times
from .runner import Runner

Array = NDArray[np.floating]
IntArray = NDArray[np.int64]


class Versions:
    """Numbers for versions of the partitions' state, none twice."""

    def __init__(self) -> None:
        self._last = -1

    def new(self) -> int:
        """The next one."""
        self._last += 1
        return self._last


class Kept:
    """A version of the partitions' state that is kept as long as this is."""

    def __init__(self, block: PartitionedBlock, version: int):
        self.version = version
        weakref.finalize(self, block.remove, version).atexit = False


@dataclass(frozen=True)
class PartitionedBlock:
    """A block in partitions, posed for one trajectory model.

    Attributes
    ----------
    runner : works on the partitions, which stand in its store
    keys : of the partitions
    posed : model, camera parameters and correction sets
    unknowns : names, and what is known beforehand
    prior : the same as whitened equations
    plans : of the partitions, in the order of the keys
    structure : of the reduced system; None where it is dense
    n_rays, n_points, n_control : numbers of rays, object points and control coordinates
    """

    runner: Runner
    keys: tuple[int, ...]
    posed: Posed
    unknowns: Unknowns
    prior: Prior
    plans: tuple[tasks.Plan, ...] = field(repr=False)
    structure: Structure | Dissection | None = field(repr=False)
    n_rays: int
    n_points: int
    n_control: int
    versions: Versions = field(default_factory=lambda: Versions(), repr=False)

    def remove(self, version: int) -> None:
        """Remove a version of the partitions' state."""
        for key in self.keys:
            self.runner.store.remove(f"state-{key}-{version}")

    @property
    def n_unknowns(self) -> int:
        """Of the reduced system."""
        return self.posed.n_unknowns

    def new_matrix(self) -> NormalMatrix:
        """A zero matrix for the reduced system."""
        return new_matrix(self.n_unknowns, self.structure)


@dataclass(frozen=True)
class PartitionedSolution(Fitted):
    """Result of an adjustment in partitions; what it says of points and rays stands in the store (`describe`).

    Attributes
    ----------
    block : what was adjusted
    theta : (n_unknowns,) of the reduced system
    factor : factorised reduced system
    iterations, converged, history : as in `adjustment.Solution`
    kept : the state of the partitions
    """

    block: PartitionedBlock
    theta: Array
    factor: Factor
    iterations: int
    converged: bool
    history: tuple[Iteration, ...]
    kept: Kept


def pose_block(
    runner: Runner,
    keys: Sequence[int],
    camera: LineCamera,
    strips: Sequence[Strip],
    model: ModelOptions,
    self_calibration: SelfCalibration | None = None,
    platform: PlatformErrors = NO_PLATFORM_ERRORS,
) -> PartitionedBlock:
    """Pose a block whose partitions (networks, ``network-K``) stand in the runner's store.

    Raises
    ------
    ValueError : no partition
    """
    if not keys:
        raise ValueError("a block without partitions")
    store = runner.store
    found = runner.run(tasks.extents, keys, lambda key: (), tasks.Extents.and_)
    present = np.array(sorted(found.ray_time_s), dtype=np.int64)
    times = [found.ray_time_s[k] for k in present.tolist()]
    of_control = [found.control_time_s[k] for k in present.tolist()]
    sets = correction_sets(camera, strips, present, times, of_control, model, self_calibration is not None)
    sets = without_times(sets)
    unknowns = unknowns_of(sets, self_calibration, platform, None)
    posed = Posed(model, self_calibration, platform, present, sets, len(unknowns.names))
    store.save("strips", tuple(strips))
    store.save("posed", posed)
    plans = tuple(runner.each(tasks.pose, keys, lambda key: ()))
    prior = whiten_prior(unknowns.prior, posed.n_unknowns)
    cliques = {c.tobytes(): c for plan in plans for c in plan.cliques}
    n_of_sets = unknowns.n_model - platform.n_unknowns
    structure = find_structure(n_of_sets, posed.n_unknowns, list(cliques.values()), prior.normal)
    n_control = sum(plan.n_control for plan in plans)
    return PartitionedBlock(
        runner, tuple(keys), posed, unknowns, prior, plans, structure, found.rays, found.points, n_control
    )


class PartitionedEquations:
    """Equations of a block in partitions; see `adjustment.equations.Equations`.

    What is asked of the partitions waits until their equations are formed, which is one pass over them.
    """

    def __init__(
        self,
        block: PartitionedBlock,
        weights: str = "motion",
        start: tuple[int, Array] | None = None,
        changes: Callable[[int], tasks.Changes] | None = None,
        prior: Prior | None = None,
        given: Callable[[int], tuple[Array | None, State | None]] = lambda key: (None, None),
        theta: Array | None = None,
    ):
        self.block = block
        self.prior = prior or block.prior
        self.place = {key: i for i, key in enumerate(block.keys)}
        self.weights_given = start is not None
        self.changes = tasks.Changes()
        self.own_changes = changes
        self.rank = 0
        self._cost: float | None = None
        self.first = block.versions.new()
        if start is not None:
            self.version, self.theta = start
            return
        self.version, self.theta = self.first, np.zeros(block.n_unknowns) if theta is None else theta
        version = self.version
        cost = block.runner.run(tasks.begin, block.keys, lambda key: (version, weights, *given(key)), tasks.add)
        self._settle(cost)

    @property
    def cost(self) -> float:
        if self._cost is None:
            following, changes = self.block.versions.new(), self._changes()
            version = self.version
            cost = self.block.runner.run(
                tasks.change, self.block.keys, lambda key: (version, following, changes(key)), tasks.add
            )
            self._next(following)
            self._settle(cost)
        assert self._cost is not None
        return self._cost

    def _changes(self) -> Callable[[int], tasks.Changes]:
        """What waits for each partition, which is taken from here."""
        common, own = self.changes, self.own_changes
        self.changes, self.own_changes = tasks.Changes(), None

        def of(key: int) -> tasks.Changes:
            if own is None:
                return common
            first = own(key)
            return common._replace(image=first.image, given=first.given, control=first.control)

        return of

    def _settle(self, of_parts: float) -> None:
        e = self.prior.residual(self.theta)
        self._cost = of_parts + float(e @ e)

    def _next(self, version: int) -> None:
        """Go on to another version; the one before goes if it is of this adjustment."""
        if self.version >= self.first:
            self.block.remove(self.version)
        self.version = version

    def form(self, damping: float) -> Normals:
        block, version, prior = self.block, self.version, self.prior
        following, changes = block.versions.new(), self._changes()
        sums = block.runner.run(
            tasks.form,
            block.keys,
            lambda key: (version, following, block.n_unknowns, changes(key), damping),
            tasks.Sums.__add__,
        )
        self._next(following)
        self._settle(sums.cost)
        self.rank = sums.rank
        matrix = block.new_matrix()
        matrix.add_sparse(prior.normal)
        if damping:
            matrix.damp(damping)
        matrix.take_scale(sums.diagonal + prior.normal.diagonal() * (1.0 + damping))
        matrix.add_sparse(_whole(sums.matrix))
        rhs = prior.matrix.T @ prior.residual(self.theta) + sums.rhs
        return Normals(matrix, rhs, sums.squares)

    def attempt(self, d_theta: Array, renewed: bool) -> float:
        block, version, following = self.block, self.version, self.block.versions.new()

        def step(key: int) -> tuple[int, int, Array, bool]:
            return version, following, d_theta[block.plans[self.place[key]].columns], renewed

        cost = block.runner.run(tasks.attempt, block.keys, step, tasks.add)
        self._next(following)
        self.trial = self.theta + d_theta
        e = self.prior.residual(self.trial)
        self.renewed = renewed
        return cost + float(e @ e)

    def take(self) -> bool:
        self.theta = self.trial
        self._do(take=True)
        return self.renewed

    def renew(self) -> None:
        self._do(renew=True)

    def reweigh(self, robust: WeightFunction | None) -> None:
        scale = 1.0
        if robust is not None:
            self.cost  # noqa: B018  (what waits is done before the residuals are looked at)
            version = self.version
            absolute = self.block.runner.run(tasks.residuals, self.block.keys, lambda key: (version,), tasks.join)
            scale = residual_scale(absolute)
        self._do(reweigh=(robust, scale))

    def refresh(self) -> None:
        """Weights are as they are."""

    def _do(self, **what: Any) -> None:
        if what.keys() != {"reweigh"} or self.changes or what["reweigh"] != (None, 1.0):
            self._cost = None
        self.changes = self.changes._replace(**what)

    def solution(
        self, outcome: Outcome, history: tuple[Iteration, ...], n_rays: int, n_control: int, wide: bool = False
    ) -> PartitionedSolution:
        """The solution at the values reached, with the numbers of rays and control coordinates that take part.

        ``wide`` : see `Problem`
        """
        block = self.block
        n = 2 * n_rays + self.prior.n_observations + n_control
        u = block.n_unknowns - len(outcome.factor.undetermined) + self.rank
        assumed = assumed_of(block.unknowns, self.prior, self.theta, outcome.factor, wide)
        return PartitionedSolution(
            block, self.theta, outcome.factor, outcome.steps, outcome.converged, history, Kept(block, self.version),
            cost=self.cost, n_observations=n, n_unknowns=u, assumed=assumed,
        )  # fmt: skip


def solve_block(
    block: PartitionedBlock,
    options: AdjustmentOptions = USUAL,
    progress: Callable[[Iteration], None] | None = None,
) -> PartitionedSolution:
    """Adjust a block in partitions; the steps are those of `adjustment.solve`."""
    equations = PartitionedEquations(block, options.weights)
    descent = Descent(equations, options)
    descend(descent, progress)
    return equations.solution(descent.finished(), tuple(descent.history), block.n_rays, block.n_control)


def cofactors_for(
    block: PartitionedBlock, factor: Factor, version: int
) -> Callable[[int], tuple[int, Array | tuple[Array, ...], Array]]:
    """What `tasks.describe` wants to know of the block for a partition: version, cofactors and variances."""
    variances = factor.variances()

    def wanted(key: int) -> tuple[int, Array | tuple[Array, ...], Array]:
        plan = block.plans[block.keys.index(key)]
        every = len(plan.columns) ** 2 <= sum(len(c) ** 2 for c in plan.cliques)
        blocks: Array | tuple[Array, ...]
        if every and isinstance(factor, DenseFactor):
            blocks = factor.cofactors(plan.columns)
        else:
            blocks = tuple(factor.cofactors(c) for c in plan.cliques)
        return version, blocks, variances[plan.columns]

    return wanted


def describe_block(solution: PartitionedSolution) -> tasks.Totals:
    """Cofactors of all points, residuals and tests of all rays: `tasks.Described` in the store, ``result-K``."""
    block = solution.block
    wanted = cofactors_for(block, solution.factor, solution.kept.version)
    return block.runner.run(tasks.describe, block.keys, wanted, tasks.Totals.__add__)


def _whole(lower: csr_array) -> csr_array:
    """A symmetric matrix from its lower triangle."""
    entries = lower.tocoo()
    row, column = entries.coords
    off = row != column
    rows, columns = np.concatenate([row, column[off]]), np.concatenate([column, row[off]])
    return csr_array((np.concatenate([entries.data, entries.data[off]]), (rows, columns)), shape=lower.shape)
