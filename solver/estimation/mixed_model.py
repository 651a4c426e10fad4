"""The mixed model (Gauss-Helmert): conditions between parameters and several observations, all of which have errors.

For each point ``F(beta, l + v) = 0`` with the observations ``l``, for example column, row and height of a control
point, and the condition that the sensor locates them where the point is [D 5.6, 5.7]. Linearised at the parameters and
*corrected* observations of the step before, ``A db + B v + w = 0`` with ``w = F - B v_before``, the corrections with
the least ``v' Q^-1 v`` are

    M = B Q B',  db = -(A' M^-1 A)^-1 A' M^-1 w,  v = -Q B' M^-1 (A db + w)

Where it has converged that is orthogonal distance regression.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..quantiles import norm

Array = NDArray[np.floating]
#: Parameters (d,) and observations (m, p) to conditions (m, c).
Conditions = Callable[[Array, Array], Array]

#: Last step where nothing else is asked for.
_CONVERGED = 1e-9
#: The same for parameters that are held, as a share of their size. Rounding.
_ROUNDING = 1e-12
_MOST_STEPS = 60
#: Steps that shrink no more and are smaller than this share of the sigmas are rounding of the numerical derivatives.
_NEGLIGIBLE = 1e-4
#: Steps of numerical derivatives: in sigmas of observations, and in shares of the size of parameters. Derived: central
#: differences, where rounding and bending are about alike.
_STEP_SIGMAS, _STEP_SHARE = 0.1, 1e-5
#: Two-sided level of the test of one observation, the usual one of data snooping.
SNOOPING_LEVEL = 0.001
#: A correction whose sigma is below this share of that of the observation is not tested: nothing controls it. Rounding.
_UNCONTROLLED = 1e-6
#: Factors of variance components have converged when none changes by more than this share; most rounds.
_FACTOR_TOLERANCE, _MOST_ROUNDS = 1e-3, 50


@dataclass(frozen=True)
class MixedModel:
    """What is to be estimated.

    Attributes
    ----------
    conditions : parameters (d,) and observations (m, p) to conditions (m, c), zero where all are right
    observations : (m, p)
    sigma : (m, p), (p,) or one; zero for what is known without error
    start : (d,) parameters to start from
    scale : (d,) size of a change of each parameter, for numerical derivatives; None for that of ``start``, or 1
    constraint, value : (q, d) and (q,): ``constraint @ beta = value``
    prior, prior_sigma : (d,) values known beforehand and their sigmas, infinite where nothing is known
    last_step : iterations end when parameters and corrections change by less than this share of their sigmas; larger
        where the conditions are computed from numbers with many digits in front, as places on the Earth are
    """

    conditions: Conditions
    observations: ArrayLike
    sigma: ArrayLike
    start: ArrayLike
    scale: ArrayLike | None = None
    constraint: ArrayLike | None = None
    value: ArrayLike | None = None
    prior: ArrayLike | None = None
    prior_sigma: ArrayLike | None = None
    last_step: float = _CONVERGED


@dataclass(frozen=True)
class MixedSolution:
    """Estimates.

    Attributes
    ----------
    parameters : (d,)
    covariance : (d, d) for the stated sigmas; times ``sigma0**2`` where these are known up to a factor only
    corrections : (m, p) that are added to the observations; NaN for points that were rejected
    correction_sigma : (m, p)
    w : (m, p) corrections over their sigmas, of those rejected as they were when rejected; 0 where nothing controls
        the observation
    rejected : (m,) points that the outlier test left out
    sigma0 : 1 where all sigmas are right; NaN without redundancy
    redundancy : conditions, constraints and prior values less parameters
    iterations : of the last solution
    factors : by the name of a group, what `variance_components` multiplied its sigmas by
    """

    parameters: Array
    covariance: Array
    corrections: Array
    correction_sigma: Array
    w: Array
    rejected: NDArray[np.bool_]
    sigma0: float
    redundancy: int
    iterations: int
    factors: dict[str, float] = field(default_factory=dict)

    @property
    def sigma(self) -> Array:
        """(d,) of the parameters; 0 of those that are held, whose variance rounding may make a little less."""
        return np.sqrt(np.maximum(np.diag(self.covariance), 0.0))


def estimate(model: MixedModel, snoop: bool = False) -> MixedSolution:
    """Parameters and corrections of all observations.

    Parameters
    ----------
    snoop : leave out the point with the largest normalised correction, as long as one is too large

    Raises
    ------
    ValueError : shapes that do not fit, too few points, parameters that are not determined, no convergence
    """
    checked = _Checked(model)
    used = np.ones(checked.m, dtype=bool)
    w = np.zeros(checked.l.shape)
    limit = float(norm.ppf(1.0 - SNOOPING_LEVEL / 2.0))
    while True:
        found = checked.solve(used)
        w[used] = found.w[used]
        largest = np.where(used, np.abs(w).max(axis=1), -1.0)
        worst = int(np.argmax(largest))
        if not snoop or largest[worst] <= limit or found.redundancy <= checked.c:
            return replace(found, w=w)
        used[worst] = False


def variance_components(model: MixedModel, groups: tuple[str, ...], snoop: bool = False) -> MixedSolution:
    """The same with sigmas of groups of observations that are multiplied until they agree with the corrections.

    After Helmert and Foerstner: ``s^2 = v' Q^-1 v / r`` over a group with its share ``r`` of the redundancy.

    Parameters
    ----------
    groups : (p,) name of the group of each column of the observations; what is known without error stays so

    Raises
    ------
    ValueError : as of `estimate`; a group without redundancy, no convergence
    """
    m, p = np.shape(model.observations)
    if len(groups) != p:
        raise ValueError(f"{len(groups)} names of groups, wanted one for each of {p} columns of observations")
    names = tuple(dict.fromkeys(groups))
    member = np.array([[g == name for g in groups] for name in names])
    factor = np.ones(len(names))
    sigma = np.broadcast_to(np.asarray(model.sigma, dtype=float), (m, p))
    for _ in range(_MOST_ROUNDS):
        now = sigma * (factor @ member)
        found = estimate(replace(model, sigma=now), snoop)
        with np.errstate(divide="ignore", invalid="ignore"):
            square = np.where(now > 0, (found.corrections / now) ** 2, 0.0)[~found.rejected].sum(axis=0)
            share = np.where(now > 0, (found.correction_sigma / now) ** 2, 0.0)[~found.rejected].sum(axis=0)
        r = member @ share
        known = ~(member @ (now > 0).any(axis=0))
        if not (known | (r > 0.5)).all():
            raise ValueError(
                f"group {names[int(np.argmin(np.where(known, np.inf, r)))]!r} has no redundancy of its own"
            )
        change = np.sqrt(np.where(known, 1.0, member @ square / np.where(known, 1.0, r)))
        factor = factor * change
        if (np.abs(change - 1.0) < _FACTOR_TOLERANCE).all():
            return replace(found, factors=dict(zip(names, factor.tolist(), strict=True)))
    raise ValueError(f"variance components: no convergence in {_MOST_ROUNDS} rounds")


class _Checked:
    """The model with all its arrays in full shape."""

    def __init__(self, model: MixedModel):
        self.F = model.conditions
        self.l = np.asarray(model.observations, dtype=float)
        self.start = np.atleast_1d(np.asarray(model.start, dtype=float))
        if self.l.ndim != 2 or not np.isfinite(self.l).all() or not np.isfinite(self.start).all():
            raise ValueError(f"observations {self.l.shape}, wanted (m, p), all numbers")
        self.m, p = self.l.shape
        self.sigma = np.broadcast_to(np.asarray(model.sigma, dtype=float), (self.m, p))
        if not (np.isfinite(self.sigma) & (self.sigma >= 0)).all():
            raise ValueError("sigmas of the observations, wanted numbers of at least 0")
        d = len(self.start)
        size = np.where(self.start != 0, np.abs(self.start), 1.0)
        self.scale = size if model.scale is None else np.broadcast_to(np.asarray(model.scale, dtype=float), d)
        H = np.zeros((0, d)) if model.constraint is None else np.atleast_2d(np.asarray(model.constraint, dtype=float))
        value = np.zeros(0) if model.value is None else np.atleast_1d(np.asarray(model.value, dtype=float))
        if H.shape != (len(value), d):
            raise ValueError(f"constraints {H.shape} with {len(value)} values, wanted one value a row of {d}")
        self.H, self.value = H, value
        if (model.prior is None) != (model.prior_sigma is None):
            raise ValueError("prior values, wanted with their sigmas")
        spread = np.inf if model.prior_sigma is None else np.asarray(model.prior_sigma, dtype=float)
        if not (np.asarray(spread) > 0).all():
            raise ValueError("sigmas of the prior values, wanted numbers above 0")
        self.prior_weight = np.broadcast_to(1.0 / np.square(spread), d)
        self.prior = self.start if model.prior is None else np.asarray(model.prior, dtype=float)
        self.last_step = model.last_step
        self.c = self._conditions(self.start, self.l).shape[1]

    def _conditions(self, beta: Array, values: Array) -> Array:
        F = np.asarray(self.F(beta, values), dtype=float)
        if F.ndim != 2 or len(F) != len(values):
            raise ValueError(f"conditions {F.shape} of {len(values)} points, wanted one row each")
        if not np.isfinite(F).all():
            k = int(np.argmin(np.isfinite(F).all(axis=1)))
            raise ValueError(f"point {k}: its condition is not a number")
        return F

    def _linearised(self, beta: Array, values: Array, sigma: Array) -> tuple[Array, Array, Array]:
        """Conditions (m, c), derivatives by parameters (m, c, d) and observations (m, c, p)."""
        F = self._conditions(beta, values)
        A = np.empty((*F.shape, len(beta)))
        for k, h in enumerate(_STEP_SHARE * self.scale):
            step = np.zeros(len(beta))
            step[k] = h
            A[:, :, k] = (self._conditions(beta + step, values) - self._conditions(beta - step, values)) / (2.0 * h)
        B = np.zeros((*F.shape, values.shape[1]))
        for k in range(values.shape[1]):
            h = _STEP_SIGMAS * sigma[:, k]
            if h.any():  # what has no error needs no derivative
                step = np.zeros_like(values)
                step[:, k] = h
                difference = self._conditions(beta, values + step) - self._conditions(beta, values - step)
                B[:, :, k] = difference / np.where(h > 0, 2.0 * h, 1.0)[:, None]
        return F, A, B

    def solve(self, used: NDArray[np.bool_]) -> MixedSolution:
        """Gauss-Newton's method over the points that take part."""
        l, sigma, d, q = self.l[used], self.sigma[used], len(self.start), len(self.value)
        redundancy = self.c * len(l) + q + int(np.count_nonzero(self.prior_weight)) - d
        if redundancy < 0:
            raise ValueError(f"{len(l)} points, {self.c} conditions each, wanted at least {d - q} conditions")
        beta, v = self.start, np.zeros_like(l)
        Q, before = sigma**2, np.inf
        for iteration in range(1, _MOST_STEPS + 1):
            F, A, B = self._linearised(beta, l + v, sigma)
            w = F - np.einsum("mcp,mp->mc", B, v)
            M = np.einsum("mcp,mp,mep->mce", B, Q, B)
            try:
                inverse = np.linalg.inv(M)
            except np.linalg.LinAlgError:
                raise ValueError("a condition holds observations without error only") from None
            N = np.einsum("mci,mce,mej->ij", A, inverse, A) + np.diag(self.prior_weight)
            n = -np.einsum("mci,mce,me->i", A, inverse, w) + self.prior_weight * (self.prior - beta)
            C, change = self._normal(N, n, self.value - self.H @ beta)
            k = np.einsum("mce,me->mc", inverse, A @ change + w)
            new_v = -Q * np.einsum("mcp,mc->mp", B, k)
            spread = np.sqrt(np.maximum(np.diag(C), 0.0))
            moved = np.abs(change) <= self.last_step * spread + _ROUNDING * self.scale
            step = float((np.abs(change) / (spread + _ROUNDING * self.scale)).max())
            turned = np.abs(new_v - v) / np.where(sigma > 0, sigma, 1.0)
            beta, v = beta + change, new_v
            if moved.all() and turned.max() < self.last_step * 10.0:
                break
            if max(step, float(turned.max())) < _NEGLIGIBLE and step > 0.5 * before:
                break
            before = step
            if not np.isfinite(beta).all():
                raise ValueError(f"the solution diverged in step {iteration}")
        else:
            raise ValueError(f"no convergence in {_MOST_STEPS} steps")
        M_of_k = inverse @ (M - np.einsum("mci,ij,mej->mce", A, C, A)) @ inverse
        spread = np.sqrt(np.maximum(np.einsum("mcp,mce,mep->mp", B, M_of_k, B), 0.0)) * Q
        square = float(np.einsum("mc,mce,me->", k, M, k)) + float(self.prior_weight @ (beta - self.prior) ** 2)
        shape = self.l.shape
        corrections, correction_sigma, tests = np.full(shape, np.nan), np.full(shape, np.nan), np.zeros(shape)
        corrections[used], correction_sigma[used] = v, spread
        tests[used] = np.where(spread > _UNCONTROLLED * sigma, v / np.where(spread > 0, spread, 1.0), 0.0)
        sigma0 = float(np.sqrt(square / redundancy)) if redundancy else float("nan")
        return MixedSolution(
            beta, C, corrections, correction_sigma, tests, ~used, sigma0, redundancy, iteration
        )  # fmt: skip

    def _normal(self, N: Array, n: Array, misclosure: Array) -> tuple[Array, Array]:
        """Covariance of the parameters and the change of them, with the constraints."""
        d, q = len(n), len(misclosure)
        size = np.sqrt(np.maximum(np.diag(N), np.finfo(float).tiny))
        full = np.zeros((d + q, d + q))
        full[:d, :d] = N / np.outer(size, size)
        scaled = self.H / size
        full[d:, :d], full[:d, d:] = scaled, scaled.T
        s = np.linalg.svd(full, compute_uv=False)
        if not s[-1] > 1e-14 * s[0]:
            weakest = np.abs(np.linalg.eigh(full[:d, :d])[1][:, 0])
            raise ValueError(f"parameter {int(np.argmax(weakest))} (counted from 0) is not determined")
        inverse = np.linalg.inv(full)
        change = (inverse @ np.concatenate([n / size, misclosure]))[:d] / size
        return inverse[:d, :d] / np.outer(size, size), change
