"""The experiment of the source on regularisation: nine control pixels, close together or wide apart [D 5.3].

Ground coordinates (east, north; metres) of nine pixels of a frame image depend on 14 parameters of camera and
orientation, or on 12 (without the size of a pixel and the altitude; position as latitude and longitude) [D 5.28]. They
are nearly dependent: the normal equations are singular to rounding. Fictitious observations, the prior knowledge of
each parameter, make them regular. The source gives neither its weights nor its units; those here are of a laboratory
calibration, a star tracker and an orbit, so that orders of magnitude and effects can be compared, not digits.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..estimation.regularisation import Regularisation, Regularised, iterate
from ..geometry.ellipsoid import WGS84
from .comparison import bilsat_camera
from .frame_parameters import changed, names_of, prior_sigmas
from .sampled import metres_a_radian

Array = NDArray[np.floating]

#: Pixels of the source, counted from 1.
PIXELS = {"narrow": (950.0, 1000.0, 1050.0), "wide": (1.0, 1024.0, 2048.0)}
#: Condition numbers that the source gives: without and with fictitious observations.
PUBLISHED = {
    (14, "narrow"): (6.33073e38, 8.51589e14), (14, "wide"): (3.37508e30, 8.51593e14),
    (12, "narrow"): (2.1533e33, 2.8356383e10), (12, "wide"): (1.3246e24, 2.8356389e10),
}  # fmt: skip
#: Sigma of a control coordinate on the ground, m: a hand-held receiver [D 3.3].
GROUND_SIGMA_M = 15.0
HEIGHT_M = 1000.0
#: Derivatives are good to so much of the largest one: differences over a sigma.
DIGITS = 1e-9
#: Last step of the iteration, in sigmas. Derived: derivatives by the distortion have fewer digits where it is small.
_LAST_STEP = 1e-3
#: Condition numbers of normal equations beyond this are rounding.
ROUNDING = 1.0 / DIGITS**2


def design(parameters: int, line: Array, sample: Array) -> Array:
    """Derivatives (2 n, d) of east and north, metres, of pixels (n,) by the parameters (central differences)."""
    camera = bilsat_camera()
    base = camera.direct(line, sample, np.full(len(line), HEIGHT_M))
    east, north = metres_a_radian(base[:, 0], base[:, 2], WGS84)
    columns = []
    for name, sigma in zip(names_of(parameters), prior_sigmas(parameters), strict=True):
        ends = [changed(camera, {name: s * sigma}).direct(line, sample, np.full(len(line), HEIGHT_M)) for s in (1, -1)]
        d = (ends[0] - ends[1]) / (2.0 * sigma)
        columns.append(np.concatenate([d[:, 1] * east, d[:, 0] * north]))
    return np.stack(columns, axis=1)


def nine_pixels(where: str) -> tuple[Array, Array]:
    """Lines and samples (9,) of the narrow or wide set, 0-based.

    Raises
    ------
    KeyError : another name
    """
    axis = np.array(PIXELS[where]) - 1.0
    line, sample = (a.ravel() for a in np.meshgrid(axis, axis, indexing="ij"))
    return line, sample


def condition(square: Array) -> float:
    """Condition number in the Frobenius norm, of a symmetric matrix with these eigenvalues (d,) [D 5.26]."""
    with np.errstate(divide="ignore", over="ignore"):
        return float(np.sqrt(np.sum(square**2)) * np.sqrt(np.sum(1.0 / square**2)))


@dataclass(frozen=True)
class Conditions:
    """Condition of the normal equations, without and with fictitious observations; parameters in units of `PRIOR`.

    Attributes
    ----------
    before, after : condition numbers; ``before`` is at most what rounding leaves
    rank : parameters that the nine pixels determine by themselves, to rounding
    """

    before: float
    after: float
    rank: int


def conditions(parameters: int, where: str) -> Conditions:
    """Condition numbers of one set of parameters and pixels."""
    A = design(parameters, *nine_pixels(where)) / GROUND_SIGMA_M * prior_sigmas(parameters)
    s = np.linalg.svd(A, compute_uv=False)
    kept = s > DIGITS * s[0]
    return Conditions(condition(s**2), condition(s**2 + 1.0), int(kept.sum()))


@dataclass(frozen=True)
class Outcome:
    """One way to regularise, over all draws.

    Attributes
    ----------
    error_m, worst_m : root mean square of the error on the ground over the whole image: median of the draws, and what
        one in twenty exceeds
    bias_m, noise_m : of it, what the prior values and what the noise of the observations leave, as expected
    alpha : the parameter, the median; NaN where singular values were cut off
    effective : parameters that the observations determine, the mean
    condition : of the regularised equations, the median
    """

    error_m: float
    worst_m: float
    bias_m: float
    noise_m: float
    alpha: float
    effective: float
    condition: float


def outcomes(parameters: int, where: str, draws: int, rng: np.random.Generator) -> dict[str, Outcome]:
    """Ground error over the image, of parameters estimated from the nine pixels by several ways.

    True parameters are drawn with their prior sigmas, control with its own; the linear model is used for both.
    """
    A = design(parameters, *nine_pixels(where))
    grid = np.linspace(0.0, 2047.0, 9)
    line, sample = (a.ravel() for a in np.meshgrid(grid, grid, indexing="ij"))
    G = design(parameters, line, sample)
    prior = prior_sigmas(parameters)
    collected: dict[str, list[tuple[float, ...]]] = {}
    for _ in range(draws):
        truth = prior * rng.normal(size=len(prior))
        y = A @ truth + GROUND_SIGMA_M * rng.normal(size=len(A))
        equations = Regularisation(A, y, GROUND_SIGMA_M, weight=1.0 / prior**2)
        for name, found in _ways(equations).items():
            error = G @ (found.x - truth)
            noise = np.einsum("ij,jk,ik->i", G, found.covariance, G)
            half = G @ found.bias_of * prior
            scale = 2.0 / len(G)  # of squares in east and north, to those of points
            collected.setdefault(name, []).append(
                (scale * float(error @ error), scale * float(np.sum(half**2)), scale * float(noise.sum()),
                 found.alpha, found.effective_parameters, found.condition_after)
            )  # fmt: skip
    out = {}
    for name, rows in collected.items():
        values = np.array(rows)
        error, worst = np.sqrt(np.percentile(values[:, 0], [50, 95]))
        bias, noise = np.sqrt(np.median(values[:, 1:3], axis=0))
        alpha = float(np.median(values[:, 3])) if np.isfinite(values[:, 3]).all() else float("nan")
        out[name] = Outcome(
            float(error),
            float(worst),
            float(bias),
            float(noise),
            alpha,
            float(values[:, 4].mean()),
            float(np.median(values[:, 5])),
        )
    return out


def _ways(equations: Regularisation) -> dict[str, Regularised]:
    most = int(np.count_nonzero(equations.singular_values > DIGITS * equations.singular_values[0]))
    return {
        "least squares": equations.truncated(most),
        "fictitious observations": equations.fictitious(),
        "Tikhonov, cross-validation": equations.tikhonov("gcv"),
        "Tikhonov, L-curve": equations.tikhonov("l-curve"),
        "truncated, cross-validation": equations.truncated("gcv"),
    }


def iterations(parameters: int, where: str, rng: np.random.Generator) -> tuple[int | None, int | None]:
    """Steps of Gauss-Newton's method with the camera itself, without and with fictitious observations.

    True parameters are drawn as in `outcomes`; the start is what is known beforehand. None: no convergence, or
    parameters with which the pixels miss the Earth.
    """
    line, sample = nine_pixels(where)
    camera = bilsat_camera()
    base = camera.direct(line, sample, np.full(len(line), HEIGHT_M))
    east, north = metres_a_radian(base[:, 0], base[:, 2], WGS84)
    prior = prior_sigmas(parameters)
    names = names_of(parameters)

    def ground(values: Array) -> Array:
        other = changed(camera, dict(zip(names, values.tolist(), strict=True)))
        located = other.direct(line, sample, np.full(len(line), HEIGHT_M))
        return np.concatenate([(located[:, 1] - base[:, 1]) * east, (located[:, 0] - base[:, 0]) * north])

    def model(values: Array) -> tuple[Array, Array]:
        J = np.stack([(ground(values + h) - ground(values - h)) / (2.0 * h.sum()) for h in np.diag(prior)], axis=1)
        return ground(values), J

    def plain(equations: Regularisation) -> Regularised:
        s = equations.singular_values
        return equations.truncated(int(np.count_nonzero(s > DIGITS * s[0])))

    truth = prior * rng.normal(size=len(prior))
    y = ground(truth) + GROUND_SIGMA_M * rng.normal(size=2 * len(line))
    taken: list[int | None] = []
    for solve in (plain, Regularisation.fictitious):
        try:
            with np.errstate(all="ignore"):
                found = iterate(model, np.zeros(len(prior)), y, solve, GROUND_SIGMA_M, 1.0 / prior**2, _LAST_STEP)
            taken.append(found.iterations)
        except ValueError:
            taken.append(None)
    return taken[0], taken[1]


def curve(parameters: int, where: str, rng: np.random.Generator) -> dict[str, Array]:
    """L-curve and cross-validation of one draw: alpha, residual norm, prior norm, score (k,)."""
    A = design(parameters, *nine_pixels(where))
    prior = prior_sigmas(parameters)
    y = A @ (prior * rng.normal(size=len(prior))) + GROUND_SIGMA_M * rng.normal(size=len(A))
    equations = Regularisation(A, y, GROUND_SIGMA_M, weight=1.0 / prior**2)
    alpha = np.logspace(-4, 4, 81)
    found = [equations.tikhonov(float(a)) for a in alpha]
    residual, norm = (np.array([getattr(f, k) for f in found]) for k in ("residual_norm", "prior_norm"))
    left = len(A) - np.array([f.effective_parameters for f in found])
    return {
        "alpha": alpha, "residual": residual, "prior": norm, "score": residual**2 / left**2,
        "gcv": np.array([equations.tikhonov("gcv").alpha]), "l-curve": np.array([equations.tikhonov("l-curve").alpha]),
    }  # fmt: skip
