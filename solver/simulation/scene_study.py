"""Whether errors of adjusted blocks of scenes are as large as their sigmas, over seeds."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..camera.self_calibration import lens, prism
from ..models.base import ModelOptions, same
from ..models.dgr import DgrOptions
from ..models.ppm import PpmOptions
from ..scene_adjustment.solution import adjust, points_enu, prepare
from .orbital_scene import ORBITAL_SENSORS, overpass
from .satellite_block import rigorous_images, scattered_points, simulate_block

Array = NDArray[np.floating]

#: Sensors of the study.
SENSORS = ("alos-prism", "spot5-hrs", "aster-vnir")


#: Trajectory models of the study: errors of GNSS orbits and star trackers, and what wanders within a scene.
MODELS: dict[str, ModelOptions] = {
    "dgr": DgrOptions(same(2.0), same(0.005), same(0.0005)),
    "ppm": PpmOptions(
        2,
        offset_sigma_m=same(2.0),
        shift_sigma_deg=same(0.005),
        first_sigma_m=same(0.5),
        first_sigma_deg=same(0.0005),
        second_sigma_m=same(0.2),
        second_sigma_deg=same(0.0002),
        continuity_sigma_m=same(0.05),
        continuity_sigma_deg=same(0.000005),
    ),
}
#: Model, and whether additional parameters are estimated.
CONFIGURATIONS = tuple((model, calibration) for model in MODELS for calibration in ("none", "selfcal"))
#: Sets of additional parameters, by sensor.
CALIBRATIONS = {"alos-prism": prism, "spot5-hrs": lens, "aster-vnir": lens}


@dataclass(frozen=True)
class ErrorRatio:
    """Root mean square errors over sigmas; 1 is expected.

    Attributes
    ----------
    points : of coordinates of points that are not control, all axes
    unknowns : of corrections and additional parameters
    sigma0 : root mean square of sigma0
    rmse_m, sigma_m : (3,) east, north, up
    blocks : adjusted
    """

    points: float
    unknowns: float
    sigma0: float
    rmse_m: Array
    sigma_m: Array
    blocks: int


def error_over_sigma(
    sensor: str, model: str, calibration: str, seeds: Iterable[int], points: int = 80, control: int = 9
) -> ErrorRatio:
    """Adjust simulated blocks of a sensor and compare errors with sigmas (a priori, sigma0 = 1).

    Errors of one block go together, so that every seed draws corrections, additional parameters and noise anew. The
    ratio is of normalised errors: ``e' Q^-1 e`` of the unknowns over their number, and ``e^2 / sigma^2`` of points.

    Parameters
    ----------
    sensor : one of `SENSORS`
    model, calibration : a pair of `CONFIGURATIONS`
    seeds : of the blocks
    points, control : ground points, and how many of them are control
    """
    scene = overpass(ORBITAL_SENSORS[sensor], 36.0, 139.6)
    parameters = CALIBRATIONS[sensor] if calibration == "selfcal" else None
    images = rigorous_images([scene], MODELS[model], parameters)
    of_points, of_unknowns, of_sigma0, squares, variances = [], [], [], [], []
    for seed in seeds:
        rng = np.random.default_rng(seed)
        P = scattered_points(images, points, rng)
        simulation = simulate_block(images, P, range(control), (), rng)
        solution = adjust(prepare(simulation.block))
        free = np.arange(control, points)
        free = free[solution.determined[free]]
        d = points_enu(solution.problem, solution.state.position_e, P[free], free)
        C = solution.points_covariance[free]
        of_points.append(np.einsum("pi,pij,pj->p", d, np.linalg.inv(C), d) / 3.0)
        e = solution.state.values - simulation.values
        of_unknowns.append(e @ np.linalg.solve(solution.values_covariance, e) / len(e))
        of_sigma0.append(solution.sigma0**2)
        squares.append(d**2)
        variances.append(np.einsum("pii->pi", C))
    rmse, sigma = (np.sqrt(np.concatenate(a).mean(axis=0)) for a in (squares, variances))
    mean = [float(np.sqrt(np.mean(a))) for a in (np.concatenate(of_points), of_unknowns, of_sigma0)]
    return ErrorRatio(mean[0], mean[1], mean[2], rmse, sigma, len(of_sigma0))
