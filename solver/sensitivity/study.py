"""All methods over one function: covariance propagation, Monte Carlo, FAST and Sobol indices."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .indices import HARMONICS, Indices, fast, sobol
from .inputs import Function, Normal
from .monte_carlo import MonteCarlo, monte_carlo
from .propagation import Propagated, propagate

Array = NDArray[np.floating]

#: Sigmas of covariance and Monte Carlo agree when they differ by less than this share, or by this many standard errors.
NEARLY_LINEAR, _STANDARD_ERRORS = 0.02, 3.0
#: Curves of FAST. Tuned: with one curve shares of ten parameters are off by 0.02, with four by 0.01.
_CURVES = 4


@dataclass(frozen=True)
class Study:
    """One function looked at by all methods.

    Attributes
    ----------
    inputs : the parameters
    covariance, drawn, fast, sobol : what each method found
    linear : (k,) whether covariance propagation and Monte Carlo agree, in the sigma and in the mean
    """

    inputs: Normal
    covariance: Propagated
    drawn: MonteCarlo
    fast: Indices
    sobol: Indices
    linear: NDArray[np.bool_]


def study(function: Function, inputs: Normal, runs: int, samples: int, seed: int) -> Study:
    """Look at a function by all methods.

    Parameters
    ----------
    function : parameters (n, d) to results (n, k)
    inputs : normal, independent
    runs : of Monte Carlo
    samples : of the Sobol sequence, a power of 2; FAST takes at least as many on each curve
    seed : of all draws

    Raises
    ------
    ValueError : too few runs or samples, no parameter that scatters, a function that gives no number
    """
    if not inputs.sigma.any():
        raise ValueError("no parameter has a sigma above 0")
    found = propagate(function, inputs.mean, inputs.sigma**2)
    streams = np.random.default_rng(seed).spawn(3)
    drawn = monte_carlo(function, inputs.mean, inputs.sigma**2, runs, streams[0])
    # with fewer samples two of the slow parameters had the same frequency, and would interfere
    on_curve = max(samples, 4 * HARMONICS**2 * len(inputs.names)) + 1
    by_fast = fast(function, inputs, on_curve, streams[1], _CURVES)
    by_sobol = sobol(function, inputs, samples, streams[2])
    apart = np.abs(drawn.sigma - found.sigma)
    bias = np.abs(drawn.mean - function(inputs.mean[None])[0])
    limit = np.maximum(NEARLY_LINEAR * found.sigma, _STANDARD_ERRORS * drawn.sigma_error)
    still = found.sigma == 0
    shifted = bias > np.maximum(NEARLY_LINEAR, _STANDARD_ERRORS / np.sqrt(runs)) * drawn.sigma
    return Study(inputs, found, drawn, by_fast, by_sobol, ((apart <= limit) & ~shifted) | (still & (drawn.sigma == 0)))
