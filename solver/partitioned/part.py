"""One partition: a problem over the few unknowns of the block that its rays touch."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from ..adjustment.elimination import plan_elimination
from ..adjustment.layout import CorrectionSet, Layout, layout_of, sets_of_rays
from ..adjustment.network import Control, Network
from ..adjustment.normal_equations import Prior, weigh_control
from ..adjustment.problem import Problem, with_left_out
from ..camera.self_calibration import SelfCalibration
from ..models.base import ModelOptions, PseudoObservations
from ..models.platform import PlatformErrors

Array = NDArray[np.floating]
IntArray = NDArray[np.int64]

#: Rays of a partition, about. A partition takes some 1.5 kB a ray while it is worked on.
RAYS = 100_000


@dataclass(frozen=True)
class Posed:
    """What all partitions of an adjustment have in common.

    Attributes
    ----------
    model, self_calibration, platform : as for `adjustment.pose_problem`
    present : numbers of the correction sets (`layout.sets_of_rays`), ascending
    sets : correction sets of the block, in that order
    n_unknowns : of the block
    """

    model: ModelOptions
    self_calibration: SelfCalibration | None
    platform: PlatformErrors
    present: IntArray
    sets: tuple[CorrectionSet, ...]
    n_unknowns: int


@dataclass(frozen=True)
class Part:
    """A partition that was posed.

    Attributes
    ----------
    problem : over its own unknowns, without a-priori knowledge; its layout has no sets
    columns : (u,) unknowns of the block that these are, ascending
    """

    problem: Problem
    columns: IntArray


def cut(network: Network, most_rays: int = RAYS) -> Iterator[Network]:
    """Cut a network into partitions: neighbouring points, in the network's order, with all their rays.

    Strips are not cut, and go with every partition; ``refused`` stays with the whole.
    """
    parts = max(1, round(len(network.rays) / most_rays))
    ends = np.searchsorted(network.first_ray, np.linspace(0, len(network.rays), parts + 1)[1:-1])
    bounds = np.unique(np.concatenate([[0], ends, [network.n_points]]))
    for low, high in zip(bounds[:-1].tolist(), bounds[1:].tolist(), strict=True):
        yield some_points(network, low, high)


def some_points(network: Network, low: int, high: int) -> Network:
    """The network of points ``low`` to ``high`` alone, with copies of its arrays."""
    rays = slice(int(network.first_ray[low]), int(network.first_ray[high]))
    own = network.rays.part(np.arange(rays.start, rays.stop))
    return replace(
        network,
        point_ids=network.point_ids[low:high],
        rays=replace(own, point=own.point - low),
        first_ray=network.first_ray[low : high + 1] - rays.start,
        approximate_l=network.approximate_l[low:high].copy(),
        control=_among(network.control, low, high),
        check=_among(network.check, low, high),
        refused=(),
    )


def _among(control: Control, low: int, high: int) -> Control:
    own = np.flatnonzero((control.point >= low) & (control.point < high))
    return Control(control.point[own] - low, control.xyz_l[own], control.sigma_m[own])


def pose_part(network: Network, posed: Posed) -> Part:
    """The problem of one partition."""
    key, _, _ = sets_of_rays(network)
    set_of_ray = np.searchsorted(posed.present, key)
    whole = layout_of(network, posed.sets, set_of_ray, posed.self_calibration, posed.platform)
    network = with_left_out(network, whole)
    layout, columns = _own_unknowns(whole)
    none = csr_array((0, layout.n_unknowns))
    prior = Prior(none, np.empty(0), csr_array((layout.n_unknowns, layout.n_unknowns)))
    problem = Problem(
        replace(network, strips=()),
        posed.model,
        posed.self_calibration,
        layout,
        plan_elimination(layout, prior.normal, network.rays.point, network.first_ray, dense=True),
        prior,
        weigh_control(network.control, network.n_points),
    )
    return Part(problem, columns)


def _own_unknowns(layout: Layout) -> tuple[Layout, IntArray]:
    """A layout over the unknowns that its rays touch, and their columns in the one given."""
    of_sets = np.zeros(layout.n_of_sets + 1, dtype=bool)
    inside = layout.columns < layout.n_of_sets
    of_sets[np.where(inside, layout.columns, -1)] = True
    used = np.flatnonzero(of_sets[:-1])
    columns = np.concatenate([used, np.arange(layout.n_of_sets, layout.n_unknowns)])
    local = np.full(layout.n_unknowns + 1, -1, dtype=np.int32)
    local[columns] = np.arange(len(columns))
    nothing = PseudoObservations(np.empty((0, 1), np.int32), np.empty((0, 1)), np.empty(0), np.empty(0), ())
    own = replace(
        layout,
        sets=(),
        columns=local[layout.columns],
        n_model=len(used) + layout.platform.n_unknowns,
        names=(),
        prior=nothing,
        assumed=np.empty(0, dtype=np.int64),  # what is known beforehand is counted for the whole block
    )
    return own, columns


def without_times(sets: Sequence[CorrectionSet]) -> tuple[CorrectionSet, ...]:
    """Correction sets whose models no longer hold the times of all rays, from which they were built."""
    for item in sets:
        item.model.extent = replace(item.model.extent, ray_time_s=np.empty(0), control_time_s=np.empty(0))
    return tuple(sets)
