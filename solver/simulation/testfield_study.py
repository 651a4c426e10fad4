"""Adjusting the simulated testfields over seeds: their accuracy as a table."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..adjustment.job import Job, run
from ..adjustment.network import Control
from ..adjustment.statistics import planimetric
from .testfields import Configuration, Testfield

Array = NDArray[np.floating]


def choose_control(xy: Array, count: int) -> NDArray[np.int64]:
    """Indices of points (n, 2) that are spread well: one at a corner, then always the one furthest from all chosen.

    One point alone is the one nearest the middle.
    """
    if count == 1:
        return np.argmin(np.linalg.norm(xy - xy.mean(axis=0), axis=1), keepdims=True)
    first = int(np.argmin(xy[:, 0] - xy[:, 0].min() + xy[:, 1] - xy[:, 1].min()))
    chosen = [first]
    distance = np.linalg.norm(xy - xy[first], axis=1)
    while len(chosen) < min(count, len(xy)):
        chosen.append(int(np.argmax(distance)))
        distance = np.minimum(distance, np.linalg.norm(xy - xy[chosen[-1]], axis=1))
    return np.array(chosen[:count], dtype=np.int64)


@dataclass(frozen=True)
class Outcome:
    """One configuration on one simulated measurement.

    Attributes
    ----------
    error_m : (n, 3) adjusted minus true, check points
    against_given_m : (n, 3) adjusted minus given: the given coordinates have the noise of control
    sigma_m : (n, 3) theoretical
    sigma0_px : of the image measurement; NaN for direct georeferencing
    parameters : additional parameters that were determinable
    """

    error_m: Array
    against_given_m: Array
    sigma_m: Array
    sigma0_px: float
    parameters: int


def adjust_once(field: Testfield, configuration: Configuration, rng: np.random.Generator) -> Outcome:
    """Simulate, choose control, adjust, compare."""
    simulated = field.simulate(rng)
    network = simulated.network
    known = network.check.point
    spread = np.asarray(field.noise.control_m)
    given = network.check.xyz_l + rng.normal(size=(len(known), 3)) * spread
    chosen = choose_control(network.check.xyz_l[:, :2], configuration.control)
    rest = np.setdiff1d(np.arange(len(known)), chosen)
    network = replace(
        network,
        control=Control(known[chosen], given[chosen], np.tile(spread, (len(chosen), 1))),
        check=Control(known[rest], given[rest], np.tile(spread, (len(rest), 1))),
    )
    job = configuration.job or Job(field.errors)
    result = run(network, job)
    check = known[rest]
    if configuration.job is None:
        points, sigma, sigma0 = result.georeferenced.xyz_l, result.georeferenced.sigma_m, np.nan
    else:
        points, sigma = result.adjusted_points(), result.point_sigma_m
        sigma0 = result.test.sigma0 * field.noise.image_px * result.image_factor
    error = points[check] - simulated.points_l[check]
    return Outcome(error, points[check] - given[rest], sigma[check], float(sigma0), result.solution.layout.n_camera)


@dataclass(frozen=True)
class Row:
    """A line of the table, metres: published beside ours, as means over the seeds.

    Attributes
    ----------
    rmse_xy, rmse_z : against given check coordinates, as published figures are
    sigma_xy, sigma_z : theoretical
    ratio_xy, ratio_z : RMSE against the truth over the theoretical sigma
    sigma0_px, parameters : means
    """

    field: Testfield
    configuration: Configuration
    rmse_xy: float
    rmse_z: float
    sigma_xy: float
    sigma_z: float
    ratio_xy: float
    ratio_z: float
    sigma0_px: float
    parameters: float


def row_of(field: Testfield, configuration: Configuration, outcomes: list[Outcome]) -> Row:
    """Means of one configuration's outcomes."""
    against, error, sigma = (
        np.sqrt(np.nanmean(np.concatenate([getattr(o, name) for o in outcomes]) ** 2, axis=0))
        for name in ("against_given_m", "error_m", "sigma_m")
    )
    sigma_xy, sigma_z = planimetric(sigma), float(sigma[2])
    return Row(
        field,
        configuration,
        planimetric(against),
        float(against[2]),
        sigma_xy,
        sigma_z,
        planimetric(error) / sigma_xy,
        float(error[2]) / sigma_z,
        float(np.mean([o.sigma0_px for o in outcomes])),
        float(np.mean([o.parameters for o in outcomes])),
    )


def study(fields: tuple[Testfield, ...], seeds: int, progress: Callable[[float], None] | None = None) -> list[Row]:
    """All configurations of some testfields over seeds 0 .. seeds - 1.

    Every configuration of a testfield sees the same simulated measurements.
    """
    if seeds < 1:
        raise ValueError(f"seeds: wanted 1 at least, got {seeds}")
    total, done = sum(len(f.configurations) for f in fields) * seeds, 0
    rows = []
    for f in fields:
        for configuration in f.configurations:
            outcomes = []
            for seed in range(seeds):
                outcomes.append(adjust_once(f, configuration, np.random.default_rng(seed)))
                done += 1
                if progress:
                    progress(done / total)
            rows.append(row_of(f, configuration, outcomes))
    return rows
