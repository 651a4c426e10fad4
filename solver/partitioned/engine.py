"""The batch job over a block in partitions: what `adjustment.problem.Parts` asks for."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..adjustment.adjustment import descend
from ..adjustment.covariance import Cofactors
from ..adjustment.gauss_newton import Descent
from ..adjustment.layout import Layout
from ..adjustment.linearisation import Linearisation, Whitening
from ..adjustment.network import Network, Rays
from ..adjustment.normal_equations import PointNormals, weigh_control
from ..adjustment.pose_noise import Pieces
from ..adjustment.problem import AdjustmentOptions, Iteration, Problem, Solution, State
from ..adjustment.ray_statistics import RayStatistics
from ..camera.self_calibration import SelfCalibration
from ..models.base import ModelOptions
from ..models.platform import PlatformErrors
from . import tasks
from .block import Kept, PartitionedBlock, PartitionedEquations, cofactors_for, pose_block
from .part import RAYS, cut
from .runner import Runner

Array = NDArray[np.floating]
IntArray = NDArray[np.int64]


@dataclass(frozen=True)
class SolutionInParts(Solution):
    """A solution whose equations are in partitions.

    Attributes
    ----------
    kept : the state of these
    """

    kept: Kept | None = None


class Engine:
    """Does the work of a batch job on partitions; see `adjustment.problem.Parts`.

    Parameters
    ----------
    runner : works on the partitions
    most_rays : of a partition, about
    """

    def __init__(self, runner: Runner, most_rays: int = RAYS):
        self.runner, self.most_rays = runner, most_rays
        self._block: PartitionedBlock | None = None
        self._network: Network | None = None
        self._points = self._rays = np.zeros(1, dtype=np.int64)

    def pose(
        self, network: Network, model: ModelOptions, self_calibration: SelfCalibration | None, platform: PlatformErrors
    ) -> Problem:
        """Take a network to the partitions; the problem has a network that only lists its rays and points."""
        points, rays = [0], [0]
        for key, part in enumerate(cut(network, self.most_rays)):
            self.runner.store.save(f"network-{key}", replace(part, strips=()))
            points.append(points[-1] + part.n_points)
            rays.append(rays[-1] + len(part.rays))
        self._points, self._rays = np.array(points), np.array(rays)
        keys = tuple(range(len(points) - 1))
        block = pose_block(self.runner, keys, network.camera, network.strips, model, self_calibration, platform)
        self._noisy = network.rays.orientation_noise is not None
        self._block, self._network = block, listed(network)
        return Problem(
            self._network,
            model,
            self_calibration,
            _layout(block, network.heading),
            None,  # pyrefly: ignore[bad-argument-type]  # every partition has its own
            block.prior,
            weigh_control(network.control, network.n_points),
            parts=self,
        )

    @property
    def block(self) -> PartitionedBlock:
        """What was posed last."""
        assert self._block is not None
        return self._block

    def solve(
        self,
        problem: Problem,
        start: Solution | State | Array | None,
        ray_weight: Array,
        options: AdjustmentOptions,
        progress: Callable[[Iteration], None] | None,
        image_factor: float = 1.0,
    ) -> Solution:
        block = self.block

        def changes(key: int) -> tasks.Changes:
            control = problem.control.weight[self.of_points(key)]
            return tasks.Changes(image=image_factor, given=ray_weight[self.of_rays(key)], control=control)

        if isinstance(start, SolutionInParts):
            assert start.kept is not None
            begin = start.kept.version, start.state.theta
            equations = PartitionedEquations(block, options.weights, begin, changes, problem.prior)
        else:
            at = start if isinstance(start, State) else State(np.zeros(block.n_unknowns), self._start(start))

            def given(key: int) -> tuple[Array, State]:
                own = at.theta[block.plans[key].columns]
                return ray_weight[self.of_rays(key)], State(own, at.points_l[self.of_points(key)])

            equations = PartitionedEquations(
                block, options.weights, None, changes, problem.prior, given, at.theta.copy()
            )
        descent = Descent(equations, options)
        descend(descent, progress)
        outcome = descent.finished()
        version = equations.version
        found = list(self.runner.each(tasks.points, block.keys, lambda key: (version,)))
        weight = np.concatenate([f.weight for f in found])
        history = tuple(descent.history)
        n_rays, n_control = int((weight > 0).sum()), problem.control.n_observations
        solved = equations.solution(outcome, history, n_rays, n_control, problem.wide)
        rank = np.concatenate([f.rank for f in found])
        nothing = np.empty((0, 0))
        return SolutionInParts(
            problem,
            State(solved.theta, np.concatenate([f.points_l for f in found])),
            Whitening(nothing),
            weight,
            Linearisation(np.empty((2, 0)), np.empty((2, 6, 0)), np.empty((2, 0, 0)), np.empty((2, 3, 0))),
            PointNormals(nothing, nothing, rank),
            outcome.factor,
            solved.iterations,
            solved.converged,
            history,
            solved.kept,
            cost=solved.cost,
            n_observations=solved.n_observations,
            n_unknowns=solved.n_unknowns,
            assumed=solved.assumed,
        )

    def _start(self, points_l: Solution | Array | None) -> Array:
        assert self._network is not None and not isinstance(points_l, Solution)
        return self._network.approximate_l if points_l is None else points_l

    def of_points(self, key: int) -> slice:
        """Places of the points of a partition in the network."""
        return slice(int(self._points[key]), int(self._points[key + 1]))

    def of_rays(self, key: int) -> slice:
        """Places of the rays of a partition in the network."""
        return slice(int(self._rays[key]), int(self._rays[key + 1]))

    def cofactors(self, solution: Solution) -> Any:
        assert isinstance(solution, SolutionInParts) and solution.kept is not None
        n, p = int(self._rays[-1]), int(self._points[-1])
        points, observed, squares = np.empty((p, 3, 3)), np.empty((n, 2, 2)), np.empty(n)
        v, sigma, redundancy, w = (np.empty((n, 2)) for _ in range(4))
        joint = np.empty(n)
        wanted = cofactors_for(self.block, solution.factor, solution.kept.version)
        for key, d in zip(self.block.keys, self.runner.each(tasks.described, self.block.keys, wanted), strict=True):
            points[self.of_points(key)] = d.point_cofactors
            own = self.of_rays(key)
            observed[own], squares[own], joint[own] = d.observed, d.squares, d.rays.joint
            v[own], sigma[own] = d.rays.v_px, d.rays.sigma_px
            redundancy[own], w[own] = d.rays.redundancy, d.rays.w
        statistics = RayStatistics(v, sigma, redundancy, w, joint)
        return Cofactors(solution.factor.variances(), points, observed, squares, statistics)

    def georeference(self, ray_weight: Array) -> tuple[Array, Array, Array]:
        keys = self.block.keys
        found = list(self.runner.each(tasks.georeferenced, keys, lambda key: (ray_weight[self.of_rays(key)],)))
        xyz, image, sigma = (np.concatenate(a) for a in zip(*found, strict=True))
        return xyz, image, sigma

    def consensus(self, solution: Solution, points: IntArray, limit: float) -> dict[int, Any]:
        assert isinstance(solution, SolutionInParts) and solution.kept is not None
        version = solution.kept.version
        part = np.searchsorted(self._points, points, side="right") - 1
        own = {key: points[part == key] for key in self.block.keys}
        keys = [key for key, mine in own.items() if len(mine)]
        result: dict[int, Any] = {}

        def wanted(key: int) -> tuple[int, IntArray, float]:
            return version, own[key] - self._points[key], limit

        for key, found in zip(keys, self.runner.each(tasks.consensus, keys, wanted), strict=True):
            for point, (rays, rival, place) in found.items():
                result[int(point + self._points[key])] = rays + self._rays[key], rival, place
        return result

    def noise_information(self, solution: Solution) -> Pieces:
        assert isinstance(solution, SolutionInParts) and solution.kept is not None
        version = solution.kept.version
        return self.runner.run(tasks.information, self.block.keys, lambda key: (version,), tasks.both)

    def with_noise_left(self, solution: Solution) -> bool:
        assert self._network is not None
        slow, strips = getattr(solution.problem.model, "slow", None), self._network.strips
        if slow is None or not self._noisy or not any(s.noise_time_s for s in strips):
            return False
        pieces = self.noise_information(solution)
        light = tuple(replace(s, noise=None) for s in strips)
        self.runner.store.save("pieces", (pieces, solution.problem.model, light))
        for _ in self.runner.each(tasks.pose_with_noise, self.block.keys, lambda key: ()):
            pass
        return True


def listed(network: Network) -> Network:
    """A network whose rays are listed only: point, strip, line and sample with their sigmas, and the time."""
    rays, n = network.rays, len(network.rays)

    def nothing(*shape: int) -> Array:
        return np.broadcast_to(np.float64(np.nan), shape)

    light = Rays(
        rays.point,
        rays.strip,
        rays.ccd,
        rays.source,
        rays.line,
        rays.sample,
        rays.sigma_line_px,
        rays.sigma_sample_px,
        rays.time_s,
        nothing(n),
        nothing(n, 3),
        nothing(n, 3),
        nothing(n, 3),
        nothing(n, 3),
        nothing(n, 2),
        nothing(n, 2),
        nothing(n),
    )
    return replace(network, rays=light)


def _layout(block: PartitionedBlock, heading: bool) -> Layout:
    """The unknowns of a block, without rays."""
    none = np.empty(0, dtype=np.int64)
    unknowns = block.unknowns
    return Layout(
        block.posed.sets,
        none,
        none,
        none,
        np.empty((0, 0), dtype=np.int32),
        np.empty((0, 0)),
        None,
        unknowns.n_model,
        unknowns.n_camera,
        unknowns.names,
        unknowns.prior,
        heading,
        platform=block.posed.platform,
        assumed=unknowns.assumed,
    )
