"""Slowly varying errors as a random process: the critically damped second-order Gauss-Markov process.

``x'' = -2 b x' - b^2 x + w`` with white noise ``w`` of spectral density ``4 b^3 sigma^2``. The process is stationary
with variance ``sigma^2`` and autocovariance ``sigma^2 (1 + b tau) exp(-b tau)``; its path has a continuous first
derivative of variance ``(b sigma)^2``, which is independent of the value at the same time.

The **correlation time** is the lag at which the autocorrelation has fallen to 1/e: ``time_s = 2.1462 / b``.
Simulation and estimators use the same function, so that a simulated wander has exactly the prior an estimator assumes.

Source: A. Gelb (ed.), Applied Optimal Estimation, 1974, section 2.2; covariance of the sampled process integrated here.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.floating]

#: ``b * time_s``: the root of ``(1 + x) exp(-x) = 1/e``.
DAMPING_TIMES_TIME = 2.146193220620583


def damping_rate(time_s: float) -> float:
    """The constant ``b`` (1/s) of a process with correlation time ``time_s``.

    Raises
    ------
    ValueError : a correlation time that is not positive
    """
    if not time_s > 0:
        raise ValueError(f"correlation time must be positive, got {time_s} s")
    return DAMPING_TIMES_TIME / time_s


def second_order_gauss_markov(sigma: float, time_s: float, step_s: ArrayLike) -> tuple[Array, Array, Array]:
    """Exact discrete form of the process over a step: ``z(t + step) = F z(t) + noise(Q)`` with ``z = (x, dx/dt)``.

    Parameters
    ----------
    sigma : standard deviation of ``x``, any unit
    time_s : correlation time, the lag at which the autocorrelation is 1/e
    step_s : (...) steps, >= 0

    Returns
    -------
    F : (..., 2, 2) transition
    Q : (..., 2, 2) covariance of the noise gathered over the step
    P0 : (2, 2) stationary covariance; ``P0 = F P0 F^T + Q`` for any step

    Raises
    ------
    ValueError : a correlation time that is not positive, a negative step
    """
    b = damping_rate(time_s)
    h = np.asarray(step_s, dtype=float)
    if (h < 0).any():
        raise ValueError(f"step must not be negative, got {h.min()} s")
    F, Q = np.empty((*h.shape, 2, 2)), np.empty((*h.shape, 2, 2))
    F[..., 0, 0], F[..., 0, 1], F[..., 1, 0], F[..., 1, 1], q00, q01, q11 = over_step(b, h)
    Q[..., 0, 0], Q[..., 0, 1], Q[..., 1, 0], Q[..., 1, 1] = q00, q01, q01, q11
    return F, sigma * sigma * Q, np.diag([sigma * sigma, (b * sigma) ** 2])


def over_step(rate: float, step_s: Array) -> tuple[Array, Array, Array, Array, Array, Array, Array]:
    """Elements F00, F01, F10, F11, Q00, Q01, Q11, each (...), of `second_order_gauss_markov` for a sigma of 1.

    Parameters
    ----------
    rate : damping rate, 1/s
    step_s : (...) steps, >= 0
    """
    from scipy.special import gammainc  # takes as long to import as half of what `triline info` needs

    x = rate * step_s
    decay = np.exp(-x)
    # 1 - exp(-2x) (1 + 2x + 2x^2) is the incomplete gamma function: no cancellation for small steps
    grown = gammainc(3.0, 2.0 * x)
    decay2 = decay * decay
    cross = 2.0 * rate * x * x * decay2
    slope = rate * rate * (grown + 4.0 * x * decay2)
    return decay * (1.0 + x), decay * step_s, -decay * rate * x, decay * (1.0 - x), grown, cross, slope


def autocorrelation(time_s: float, lag_s: ArrayLike) -> Array:
    """Autocorrelation of the value at lags (...), 1 at lag 0."""
    x = damping_rate(time_s) * np.abs(np.asarray(lag_s, dtype=float))
    return (1.0 + x) * np.exp(-x)
