"""Whether errors are as large as the adjustment says: simulated blocks whose errors are drawn exactly as assumed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from ..adjustment.adjustment import adjust
from ..adjustment.covariance import cofactors
from ..adjustment.statistics import global_test
from ..adjustment.variance_components import group_sums
from ..camera.self_calibration import tls
from ..camera.sensors import preset
from ..models.base import ModelOptions
from ..models.dgr import DgrOptions
from ..models.lim import LimOptions
from ..models.ppm import PpmOptions
from .network import regular_block

Array = NDArray[np.floating]

_SHIFT, _ATTITUDE = (0.11, 0.11, 0.20), (0.004, 0.004, 0.008)

#: Models whose a-priori sigmas are also those of the simulated errors.
MODELS: dict[str, ModelOptions] = {
    "DGR": DgrOptions(_SHIFT, _ATTITUDE, _ATTITUDE),
    "PPM-3": PpmOptions(3, offset_sigma_m=_SHIFT, shift_sigma_deg=_ATTITUDE),
    "LIM-5": LimOptions(5, False, _SHIFT, _ATTITUDE),
}

#: Sigmas of the camera's errors, of the defaults: 0.01 mm, which is 1.5 px, at the edge.
CAMERA_SHARE = 0.1


@dataclass(frozen=True)
class Consistency:
    """Of one model over seeds; 1 is right everywhere but in ``passed``, which should be 0.95.

    Attributes
    ----------
    points : (3,) RMSE of object points over their theoretical sigma, X, Y, Z
    points_sigma : (3,) standard deviation of that ratio, from how it scatters from block to block
    orientation, parameters : mean normalised error squared of the model's unknowns and of the additional parameters,
        per unknown; NaN without such parameters
    sigma0 : mean of sigma0 of the image points, root of their squares over their redundancy
    passed : share of chi-square tests of it that passed
    band : (low, high) in which the mean normalised error squared of the model's unknowns lies with 95 %
    passed_band : (low, high) in which ``passed`` lies with 95 %
    """

    points: Array
    points_sigma: Array
    orientation: float
    parameters: float
    sigma0: float
    passed: float
    band: tuple[float, float]
    passed_band: tuple[float, float]


def consistency(
    model: ModelOptions, self_calibration: bool, seeds: int, progress: Callable[[float], None] | None = None
) -> Consistency:
    """Simulate and adjust over seeds 0 .. seeds - 1: two parallel and one cross ADS40 strip, 5 control points.

    Errors of trajectory and camera are drawn from the a-priori knowledge, jointly where continuity binds them. So the
    a-priori equations have as many squares as unknowns, not as equations, and sigma0 is judged on the image points.
    Every model has draws of its own, so that one unlucky block does not show in several rows.
    """
    if seeds < 1:
        raise ValueError(f"seeds: wanted 1 at least, got {seeds}")
    camera = preset("ads40")
    parameters = replace(tls(camera), sigma=CAMERA_SHARE * tls(camera).sigma) if self_calibration else None
    squares, stated = np.empty((seeds, 3)), np.empty((seeds, 3))
    series = 2 * list(MODELS.values()).index(model) + self_calibration if model in MODELS.values() else 0
    orientation, camera_error, sigma0, passed, unknowns = [], [], [], [], 0
    for seed in range(seeds):
        rng = np.random.default_rng((series, seed))
        drawn_camera = np.empty(0)
        if parameters:
            drawn_camera = parameters.apriori_sigma * rng.standard_normal(parameters.n_unknowns)
        true = dict(zip(parameters.unknown_names, drawn_camera.tolist(), strict=True)) if parameters else None
        simulated = regular_block(
            camera, rng, model, points=60, strips=2, cross=1, control=5, self_calibration=parameters,
            camera_parameters=true,
        )  # fmt: skip
        solution = adjust(simulated.network, model, parameters)
        layout = solution.layout
        Q = cofactors(solution)
        known = solution.points.rank == 3
        squares[seed] = np.mean((solution.state.points_l - simulated.points_l)[known] ** 2, axis=0)
        stated[seed] = np.mean(np.einsum("pii->pi", Q.points)[known], axis=0)
        drawn = [simulated.corrections[simulated.network.strips[s.strip].id] for s in layout.sets]
        error = solution.state.theta[: layout.n_model] - np.concatenate(drawn)
        unknowns = layout.n_model
        orientation.append(_normalised(error, solution.factor.cofactors(np.arange(unknowns))))
        if parameters is not None:
            columns = np.arange(unknowns, layout.n_unknowns)
            error = solution.camera_parameters - drawn_camera
            camera_error.append(_normalised(error, solution.factor.cofactors(columns)))
        _, of_image, redundancy = group_sums(solution, Q)["image"]
        sigma0.append(np.sqrt(of_image / redundancy))
        passed.append(global_test(of_image, round(redundancy)).passed)
        if progress:
            progress((seed + 1) / seeds)
    low, high = np.divide(stats.chi2.ppf([0.025, 0.975], seeds * unknowns), seeds * unknowns)
    ratio = np.sqrt(squares.mean(axis=0) / stated.mean(axis=0))
    # of a ratio of means, by the scatter of its blocks; half of that for the root
    scatter = np.std(squares - ratio**2 * stated, axis=0, ddof=min(1, seeds - 1)) / np.sqrt(seeds)
    least, most = np.divide(stats.binom.ppf([0.025, 0.975], seeds, 0.95), seeds)
    return Consistency(
        ratio,
        scatter / (2.0 * ratio * stated.mean(axis=0)),
        float(np.mean(orientation)),
        float(np.mean(camera_error)) if camera_error else float("nan"),
        float(np.mean(sigma0)),
        float(np.mean(passed)),
        (float(low), float(high)),
        (float(least), float(most)),
    )


def _normalised(error: Array, covariance: Array) -> float:
    """``e^T C^-1 e / k``."""
    s = np.sqrt(np.diag(covariance))
    z = error / s
    return float(z @ np.linalg.solve(covariance / np.outer(s, s), z)) / len(z)
