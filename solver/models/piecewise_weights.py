"""Weights of piecewise models from what the slow errors are: constants of a strip, and a wander of known covariance.

Weights from experience state every coefficient on its own, each with the sigma of the whole error. What one segment has
in common with the next is then not stated, and n segments claim n independent answers to one question: the mean of a
strip comes out sqrt(n) times too certain. Stated as the process it is, the error's own correlation says how much the
next piece may differ. The constants (offset, shift, drift) are unknowns of their own before those of the pieces.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from .base import COMPONENTS, Extent, PseudoObservations, direct_observations
from .gauss_markov import autocorrelation, second_order_gauss_markov
from .slow_errors import SlowErrors
from .wander import GLOBALS, NOTHING, SEGMENT_SHARE, WanderOptions

Array = NDArray[np.floating]

#: Values before one that say what is known of it; those before them add less than a thousandth of its variance.
BEFORE = 4


def slow_errors_stated(settings: Mapping[str, object]) -> SlowErrors | None:
    """The slow errors of a ``[trajectory]`` table, if it says that they wander; with one correlation time."""
    stated = WanderOptions.from_settings(settings).slow.alike
    wanders = any(np.any(np.asarray(settings.get(key, 0.0), float)) for key in ("wander_sigma_m", "wander_sigma_deg"))
    return stated if wanders else None


def pieces(extent: Extent, slow: SlowErrors) -> int:
    """Segments of a correction set that are short enough for the wander."""
    return max(1, int(np.ceil((extent.end_s - extent.start_s) / (SEGMENT_SHARE * slow.wander_time_s) - 1e-9)))


def constant_names(extent: Extent) -> tuple[str, ...]:
    """Names of the nine constants of a strip."""
    kinds = ["offset"] * 3 + ["shift"] * 3 + ["drift"] * 3
    return tuple(f"{c} {kind} of {extent.name}" for c, kind in zip(COMPONENTS + COMPONENTS[3:], kinds, strict=True))


def constant_sigma(slow: SlowErrors) -> Array:
    """(9,) of offset, shift, drift."""
    return np.maximum(np.concatenate([slow.offset_m, slow.shift, slow.drift]), NOTHING)


def wander_sigma(slow: SlowErrors) -> Array:
    """(6,) of the wander."""
    return np.maximum(np.concatenate([slow.wander_m, slow.wander]), NOTHING)


def constants_stated(extent: Extent, slow: SlowErrors) -> PseudoObservations:
    """Zero observations of the nine constants."""
    return direct_observations(constant_sigma(slow), constant_names(extent))


def with_constants(columns: NDArray[np.int32], coefficients: Array, share: Array) -> tuple[NDArray[np.int32], Array]:
    """A design (n, k, 6), (n, k) of pieces, its columns counted from 0, with the constants before it.

    Parameters
    ----------
    share : (n,) of the strip gone, what the drift is counted over
    """
    n, k, _ = columns.shape
    wider = np.empty((n, k + 2, 6), dtype=np.int32)
    wider[:, 0] = np.arange(6)
    wider[:, 1] = [-1, -1, -1, 6, 7, 8]
    wider[:, 2:] = columns + GLOBALS
    return wider, np.column_stack([np.ones_like(share), share, coefficients])


def describe_constants(theta: Array, sigma: Array) -> dict[str, object]:
    """The constants as the result file shows them.

    Parameters
    ----------
    theta, sigma : (9 or more,) offset in m, shift and drift in rad, three each, and their standard deviations
    """
    result: dict[str, object] = {"s": "share of the strip"}
    for key, part, unit in (("offset_m", 0, 1.0), ("shift_deg", 3, 180 / np.pi), ("drift_deg", 6, 180 / np.pi)):
        for suffix, values in (("", theta), ("_sigma", sigma)):
            result[key + suffix] = (np.asarray(values, dtype=float)[part : part + 3] * unit).tolist()
    return result


# -- values at fixes ---------------------------------------------------------------------------------------------------


def given_before(time_s: float, fixes: Array) -> tuple[Array, Array]:
    """What the values at the fixes before say of the value at each fix, for a wander of sigma 1.

    Parameters
    ----------
    fixes : (n,) times, ascending

    Returns
    -------
    weights : (n, BEFORE) of the values before, the nearest last; 0 where there are none
    variance : (n,) of what is new
    """
    n = len(fixes)
    weights, variance = np.zeros((n, BEFORE)), np.ones(n)
    for i in range(1, n):
        before = fixes[max(0, i - BEFORE) : i]
        own = autocorrelation(time_s, before[:, None] - before)
        to = autocorrelation(time_s, before - fixes[i])
        w = np.linalg.solve(own, to)
        weights[i, BEFORE - len(w) :] = w
        variance[i] = max(1.0 - float(w @ to), 1e-12)
    return weights, variance


def left_between_values(time_s: float, t: Array, at: Array, coefficients: Array) -> Array:
    """Variance (n,) of what a wander of sigma 1 is at times beyond a linear form of its values at others.

    Parameters
    ----------
    t : (n,)
    at, coefficients : (n, k) times and factors of the values
    """
    to = autocorrelation(time_s, at - t[:, None])
    own = autocorrelation(time_s, at[:, :, None] - at[:, None, :])
    c = coefficients
    variance = 1.0 - 2.0 * np.einsum("nk,nk->n", c, to) + np.einsum("nk,nkm,nm->n", c, own, c)
    return np.maximum(variance, 0.0)


# -- quadratic pieces --------------------------------------------------------------------------------------------------


def left_beside_quadratic(time_s: float, after: Array, length: Array) -> Array:
    """Variance (n,) of a wander of sigma 1 beyond the parabola through value and slope at the start of its segment and
    the value at its end.

    Parameters
    ----------
    after, length : (n,) time since the start of the segment, and its length; between 0 and the length
    """
    F0, Q0, P0 = second_order_gauss_markov(1.0, time_s, after)
    F1, _, _ = second_order_gauss_markov(1.0, time_s, length - after)
    F, Q, _ = second_order_gauss_markov(1.0, time_s, length)
    s = after / length
    parabola = np.stack([1.0 - s * s, (s - s * s) * length], axis=1)
    start = F0[:, 0] - parabola - (s * s)[:, None] * F[:, 0]
    together = np.einsum("nk,nk->n", Q0[:, 0], F1[:, 0])  # of the noise until then and over the segment
    new = Q0[:, 0, 0] - 2.0 * s * s * together + s**4 * Q[:, 0, 0]
    return np.maximum(np.einsum("nk,kl,nl->n", start, P0, start) + new, 0.0)
