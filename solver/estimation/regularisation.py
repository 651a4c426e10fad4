"""Regularised least squares: parameters that observations hardly determine are held near prior values.

All kinds are the same in the singular values ``s`` of the whitened design ``B = A L^-1 / sigma``, with ``P = L' L`` the
weight of the fictitious observations ``x = x0`` [D 5.18-5.25]:

    x = x0 + L^-1 V diag(f / s) U' b

Tikhonov has the filter factors ``f = s^2 / (s^2 + alpha^2)``, the truncated decomposition 1 for the largest ones and 0
for the rest; fictitious observations are Tikhonov with alpha 1. With ``f`` below 1 the variance falls and a bias comes
in; both are told.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import minimize_scalar

Array = NDArray[np.floating]

#: Values of alpha that are tried before the best is refined. Tuned: minima of both criteria are wider than a step.
_TRIED = 100
#: Smallest alpha over the largest singular value. Rounding.
_SMALLEST = 1e-14
_CONVERGED, _MOST_STEPS = 1e-9, 50


@dataclass(frozen=True)
class Regularised:
    """A regularised solution.

    Attributes
    ----------
    x : (d,)
    alpha : regularisation parameter; NaN where singular values were cut off
    kept : number of singular values that take part
    filters : (m,) factors of the singular values, largest first; m the smaller of n and d
    singular_values : (m,) of the whitened design
    covariance : (d, d) of ``x`` from the noise of the observations
    bias_of : (d, d); times ``x_true - x0`` it is the expected error of ``x``
    expected_bias2 : (d, d) expected product of that error with itself, where the prior weight is right (the true
        parameters scatter about ``x0`` with covariance ``P^-1``)
    condition_before, condition_after : of the normal equations, Frobenius norm; infinite where singular
    effective_parameters : sum of the filter factors: so many parameters the observations determine
    residual_norm, prior_norm : whitened, of the observations and of ``L (x - x0)``
    iterations : 1, or of `iterate`
    """

    x: Array
    alpha: float
    kept: int
    filters: Array
    singular_values: Array
    covariance: Array
    bias_of: Array
    expected_bias2: Array
    condition_before: float
    condition_after: float
    effective_parameters: float
    residual_norm: float
    prior_norm: float
    iterations: int = 1

    @property
    def sigma(self) -> Array:
        """(d,) standard deviations of ``x``, without the bias."""
        return np.sqrt(np.diag(self.covariance))

    def bias(self, x_true_minus_prior: ArrayLike) -> Array:
        """Expected error (d,) of ``x`` where the true parameters are so far from the prior values."""
        return self.bias_of @ np.asarray(x_true_minus_prior, dtype=float)


class Regularisation:
    """Observation equations with prior weights, decomposed once; each method is a solution.

    Parameters
    ----------
    A : (n, d) design
    y : (n,) observations
    sigma : (n,) or one, of the observations
    prior : (d,) values towards which the solution is drawn; zero if None
    weight : (d, d) matrix P of the fictitious observations, or (d,) its diagonal; None for ones. One over the squared
        sigma of a prior value is the weight with which alpha 1 is the best linear estimate

    Raises
    ------
    ValueError : shapes that do not fit, sigmas that are not positive, weights that are not positive definite
    """

    def __init__(
        self, A: ArrayLike, y: ArrayLike, sigma: ArrayLike = 1.0, prior: ArrayLike | None = None,
        weight: ArrayLike | None = None,
    ):  # fmt: skip
        design, values = np.asarray(A, dtype=float), np.asarray(y, dtype=float)
        if design.ndim != 2 or values.shape != design.shape[:1]:
            raise ValueError(f"design {design.shape} and observations {values.shape}, wanted (n, d) and (n,)")
        if not (np.isfinite(design).all() and np.isfinite(values).all()):
            raise ValueError("design or observations: a value that is not a number")
        n, d = design.shape
        spread = np.broadcast_to(np.asarray(sigma, dtype=float), n)
        if not (spread > 0).all():
            raise ValueError("sigmas of the observations, wanted numbers above 0")
        self.prior = np.zeros(d) if prior is None else np.asarray(prior, dtype=float)
        P = np.ones(d) if weight is None else np.asarray(weight, dtype=float)
        P = np.diag(P) if P.ndim == 1 else P
        if self.prior.shape != (d,) or P.shape != (d, d):
            raise ValueError(f"prior values {self.prior.shape}, weights {P.shape}, wanted ({d},) and ({d}, {d})")
        try:
            L = np.linalg.cholesky(P).T
        except np.linalg.LinAlgError:
            raise ValueError("weights of the prior values, wanted a positive definite matrix") from None
        self._L, self._back = L, np.linalg.inv(L)
        b = (values - design @ self.prior) / spread
        U, self._s, Vt = np.linalg.svd(design / spread[:, None] @ self._back, full_matrices=False)
        self._V, self._b = Vt.T, U.T @ b
        # singular values are known to the rounding of the largest one
        self._s = np.where(self._s > np.finfo(float).eps * self._s[0], self._s, 0.0)
        self._outside = max(float(b @ b - self._b @ self._b), 0.0)  # what no parameter reaches
        self._n = n

    @property
    def singular_values(self) -> Array:
        """(m,) of the whitened design with its prior weights, largest first."""
        return self._s

    def tikhonov(self, alpha: float | str) -> Regularised:
        """Minimum of ``|(A x - y) / sigma|^2 + alpha^2 |L (x - x0)|^2``.

        Parameters
        ----------
        alpha : a number, or how to find it: "gcv" (generalised cross-validation) or "l-curve" (largest curvature);
            the L-curve smooths less than is best where the true values are smooth

        Raises
        ------
        ValueError : a negative number, another word
        """
        if isinstance(alpha, str):
            alpha = self._found(alpha)
        if not (np.isfinite(alpha) and alpha >= 0):
            raise ValueError(f"alpha {alpha}, wanted a number of at least 0")
        square = self._s**2 + alpha**2
        return self._with(self._s**2 / np.where(square > 0, square, 1.0), float(alpha), square)

    def fictitious(self) -> Regularised:
        """Fictitious observations ``x = x0`` with the weights given: ``(A' W A + P)^-1``."""
        return self.tikhonov(1.0)

    def truncated(self, keep: int | str) -> Regularised:
        """Only the largest singular values.

        Parameters
        ----------
        keep : how many, or "gcv" or "l-curve"

        Raises
        ------
        ValueError : more than there are, or another word
        """
        most = int(np.count_nonzero(self._s))
        if isinstance(keep, str):
            numbers = np.arange(1, most + 1)
            filters = [np.where(np.arange(len(self._s)) < k, 1.0, 0.0) for k in numbers]
            if keep == "gcv":
                scores = [self._gcv(f) for f in filters]
            elif keep == "l-curve":
                scores = -_curvatures(*np.array([self._norms(f) for f in filters]).T)
            else:
                raise ValueError(f"choice {keep!r}, wanted a number, 'gcv' or 'l-curve'")
            keep = int(numbers[int(np.argmin(scores))])
        if not 1 <= keep <= most:
            raise ValueError(f"{keep} singular values, wanted 1 to {most}")
        filters = np.where(np.arange(len(self._s)) < keep, 1.0, 0.0)
        return self._with(filters, float("nan"), self._s[:keep] ** 2)

    def _with(self, f: Array, alpha: float, square: Array) -> Regularised:
        inverse = np.where(f > 0, f / np.where(self._s > 0, self._s, 1.0), 0.0)
        T = self._back @ self._V
        residual, prior = self._norms(f)
        outside = np.eye(len(self.prior)) - self._V @ (f[:, None] * self._V.T)  # directions no filter lets through
        bias = -self._back @ outside @ self._L
        half = self._back @ outside
        full = self._s**2 if len(self._s) == len(self.prior) else np.append(self._s**2, 0.0)
        if len(self._s) < len(self.prior) and np.isfinite(alpha):
            square = np.append(square, np.full(len(self.prior) - len(self._s), alpha**2))
        return Regularised(
            self.prior + T @ (inverse * self._b), alpha, int(np.count_nonzero(f)), f, self._s,
            (T * inverse**2) @ T.T, bias, half @ half.T, _condition(full), _condition(square),
            float(f.sum()), residual, prior,
        )  # fmt: skip

    def _norms(self, f: Array) -> tuple[float, float]:
        """Of the residuals and of ``L (x - x0)``."""
        residual = np.sqrt(np.sum(((1.0 - f) * self._b) ** 2) + self._outside)
        inverse = np.where(f > 0, f / np.where(self._s > 0, self._s, 1.0), 0.0)
        return float(residual), float(np.linalg.norm(inverse * self._b))

    def _gcv(self, f: Array) -> float:
        left = self._n - f.sum()
        return self._norms(f)[0] ** 2 / left**2 if left > 0.5 else np.inf

    def _found(self, how: str) -> float:
        """The parameter by a criterion: the best of a row of values, refined between its neighbours."""
        top = self._s[0]
        least = max(float(self._s[self._s > 0].min()) * 0.1, _SMALLEST * top)
        logs = np.linspace(np.log(least), np.log(10.0 * top), _TRIED)

        def filters(log: float) -> Array:
            return self._s**2 / (self._s**2 + np.exp(2.0 * log))

        if how == "gcv":
            scores = np.array([self._gcv(filters(t)) for t in logs])
            k = int(np.argmin(scores))
            around = (logs[max(k - 1, 0)], logs[min(k + 1, _TRIED - 1)])
            found = minimize_scalar(lambda t: self._gcv(filters(t)), bounds=around, method="bounded")
            return float(np.exp(found.x))
        if how == "l-curve":
            norms = np.array([self._norms(filters(t)) for t in logs])
            return float(np.exp(logs[int(np.argmax(_curvatures(*norms.T)))]))
        raise ValueError(f"choice {how!r}, wanted a number, 'gcv' or 'l-curve'")


def iterate(
    model: Callable[[Array], tuple[Array, Array]],
    start: ArrayLike,
    y: ArrayLike,
    solve: Callable[[Regularisation], Regularised],
    sigma: ArrayLike = 1.0,
    weight: ArrayLike | None = None,
    last_step: float = _CONVERGED * 1e3,
) -> Regularised:
    """Gauss-Newton's method with regularisation, for a model that is not linear; ``start`` is the prior too.

    Parameters
    ----------
    model : parameters (d,) to computed observations (n,) and their derivatives (n, d)
    start : (d,)
    y : (n,) observations
    solve : of each step, for example ``lambda equations: equations.tikhonov(0.1)``
    sigma, weight : as of `Regularisation`
    last_step : a step in which no parameter changes by more, in its sigmas, is the last

    Raises
    ------
    ValueError : no convergence, a model that gives no number
    """
    prior = np.asarray(start, dtype=float)
    x = prior
    for k in range(_MOST_STEPS):
        computed, J = model(x)
        # linear about x, drawn towards the prior values and not towards x
        step = solve(Regularisation(J, np.asarray(y) - computed + J @ x, sigma, prior, weight))
        change = np.abs(step.x - x) / np.maximum(step.sigma, np.finfo(float).tiny)
        x = step.x
        if change.max() < last_step:
            return replace(step, iterations=k + 1)
    raise ValueError(f"no convergence in {_MOST_STEPS} steps")


def _condition(square: Array) -> float:
    """Condition in the Frobenius norm of a symmetric matrix with these eigenvalues."""
    if not len(square) or not square.min() > 0:
        return float("inf")
    return float(np.linalg.norm(square) * np.linalg.norm(1.0 / square))


def _curvatures(residual: Array, prior: Array) -> Array:
    """Curvature of the curve of both norms, in logarithms, at its points; the ends have none.

    Signed so that the corner of the L is positive, and independent of how the points are spaced (circle through three).
    """
    tiny = np.finfo(float).tiny
    x, y = np.log(np.maximum(residual, tiny)), np.log(np.maximum(prior, tiny))
    if len(x) < 3:
        return np.arange(len(x), dtype=float)
    a, b = np.stack([np.diff(x), np.diff(y)])[:, :-1], np.stack([np.diff(x), np.diff(y)])[:, 1:]
    cross = a[0] * b[1] - a[1] * b[0]
    length = np.hypot(*a) * np.hypot(*b) * np.hypot(*(a + b))
    out = np.full(len(x), -np.inf)
    # with growing alpha the curve runs down and then to the right: it turns left at the corner; with a growing number
    # of singular values it is run through backwards
    turn = np.sign(x[-1] - x[0]) or 1.0
    out[1:-1] = turn * 2.0 * cross / np.where(length > 0, length, np.inf)
    return out
