"""How likely the data are where sigmas of slow errors, and of looks, are multiplied by factors.

A choice of factors is weighed by its restricted likelihood: that of what the observations say beyond the unknowns.

Source: K.-R. Koch, Maximum likelihood estimate of variance components, Bulletin geodesique 60, 1986.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.linalg import get_lapack_funcs

from ...arrays import Array
from ...models.base import WANDERS
from ..results import DivergedError
from ..state.strip import WindowStrip
from ..state.unknowns import WindowState, block_of

(_trtrs,) = get_lapack_funcs(("trtrs",), dtype=float)  # pyrefly: ignore[not-iterable]

#: Factors that are weighed against each other, and how far from 1 they usually are, as a logarithm. Tuned: with 1.5 one
#: of three attitudes that swing 20 km above the ground is taken for a position of some metres, since images tell them
#: apart by little there (7.7 m in place of 5.8 m); with 1.0 one flight of two with a step of the GNSS is 14 % worse.
BANK, USUAL_LOG = (1.0, 1.5, 2.3, 3.5, 5.5, 9.0, 15.0, 30.0, 60.0, 120.0), 1.2
#: How far those of a strip usually are from what earlier strips have shown, as a logarithm. Tuned.
FROM_STRIP_TO_STRIP_LOG = 0.4
#: Before a wander is stated larger it is weighed against noise of looks that is so many times as large. Tuned; the
#: largest by what it is for: a vibration of 0.03 deg (13 pixels) is 15 times the noise. With 5 as the largest it was a
#: wander of any size, and turned the attitude by tens of degrees.
NOISES = (1.0, 1.2, 1.45, 1.75, 2.1, 2.6, 3.2, 4.0, 5.0, 7.5, 11.0, 17.0, 25.0)
#: The steps from a choice of factors to its neighbours.
STEPS = tuple((*(0,) * i, by, *(0,) * (3 - i)) for i in range(4) for by in (1, -1))
#: The shortest correlation time of the attitude is stated that has so much of the weight; the one in force stays where
#: it has a share of that. Tuned: with a tenth the wander of one flight whose sigma is twice as large (`def`, seed 10)
#: is taken for a faster one at first, and its points are 11 % worse.
ENOUGH_WEIGHT, STAYS = 0.5, 0.2
#: Neighbours are weighed of factors whose cost is so far above the least: their weight is below 1e-4. Derived.
COUNTS = 20.0
#: Wanders are weighed where twice as large a one is more likely by so much, as minus twice the logarithm of a
#: likelihood ratio: chi-square of two degrees of freedom, 0.05 %. It is asked over and over: with 0.5 % a strip as
#: stated of 4 minutes is doubted now and then. Tuned: between 6 and 18 short flights as stated are the same, and points
#: of flights whose wander is twice as large and seen by few looks are within 3 %.
CLEARLY_LIKELIER = 15.0
#: Factors on position and attitude that are tried for that.
TWICE = ((1.0, 2.0), (2.0, 1.0), (2.0, 2.0))
#: By what they are tried to be larger where another explanation is weighed against them. Tuned.
LARGER = (1.0, 3.0, 10.0)


@dataclass(frozen=True)
class LookNoise:
    """What the looks in the window say, and the noise that is stated of them.

    Attributes
    ----------
    variance : of a sample, pixels squared, with the vibration of the attitude
    pixel, sigma_px : angle that a pixel subtends, rad, and the sigma of a sample as stated at first
    rows, square : their observations less object coordinates, and the squares of these where all unknowns are zero
    matrix, rhs : (n, n), (n,) normal equations
    """

    variance: float
    pixel: float
    sigma_px: float
    rows: int
    square: float
    matrix: Array
    rhs: Array


@dataclass(frozen=True)
class Beforehand:
    """What is known of the factors on position and attitude before the data: their logarithms have a normal
    distribution of this mean and sigma."""

    mean: tuple[float, float] = (0.0, 0.0)
    sigma: tuple[float, float] = (USUAL_LOG, USUAL_LOG)

    @classmethod
    def of_earlier_strips(cls, factors: tuple[float, float]) -> Beforehand:
        """Where factors, those above 1, have been learnt: their mean square is what is in force."""
        learnt = [f > 1.0 for f in factors]
        a, b = (np.log(f) - FROM_STRIP_TO_STRIP_LOG**2 if it else 0.0 for f, it in zip(factors, learnt, strict=True))
        c, d = (FROM_STRIP_TO_STRIP_LOG if it else USUAL_LOG for it in learnt)
        return cls((float(a), float(b)), (c, d))

    def cost(self, f: float, g: float) -> float:
        """Minus twice the logarithm of the density of two factors, but for a constant."""
        a, b = self.mean
        c, d = self.sigma
        return float(((np.log(f) - a) / c) ** 2 + ((np.log(g) - b) / d) ** 2)


NOTHING = Beforehand()


class Likelihood:
    """Minus twice the logarithm of the restricted likelihood of a choice of factors, its *cost*.

    It is ``log det N + sum 2 m log f + q - n' N^-1 n``, with m equations of a group and the squares q of the looks at
    unknowns of zero. The factors of a pair act on unknowns of its own each; all others are eliminated once, those of
    the position once for each of its factors: a choice costs a factorisation of the size of the attitude's alone, and
    one that was asked for before nothing.

    Parameters
    ----------
    pair : groups of position and attitude
    beforehand : what is known of the factors without the data in the window
    at_most_s : what the attitude's correlation time is bounded by, see `SigmaFactors`

    Attributes
    ----------
    noise : of looks; None while it stays as it is
    changes : of the state for which it holds
    times_s : what the attitude's correlation time may be bounded by, the one in force first
    """

    def __init__(
        self,
        strip: WindowStrip,
        state: WindowState,
        pair: tuple[int, int],
        beforehand: Beforehand = NOTHING,
        at_most_s: float = np.inf,
    ) -> None:
        self.noise: LookNoise | None = None
        self.strip, self.changes, self.beforehand = strip, state.changes, beforehand
        matrix, rhs = state.normal()
        own, self._apriori, self._rows = [], [], []
        for group in pair:
            numbers, as_stated, in_force, rows = strip.apriori_information(group, state)
            own.append(state.places(numbers))
            self._apriori.append(as_stated)
            self._rows.append(rows)
            matrix[np.ix_(own[-1], own[-1])] -= in_force
        self.times_s: tuple[float, ...] = (at_most_s,)
        self._attitude = [(self._apriori[1], 0.0)]
        if pair == WANDERS and len(strip.attitude_times_s) > 1 and self._rows[1]:
            times_s = strip.attitude_times_s
            now_s = at_most_s if at_most_s in times_s else np.inf
            self.times_s = now_s, *(time_s for time_s in times_s if time_s != now_s)
            told = [strip.attitude_information(time_s, state) for time_s in self.times_s]
            self._attitude = [(matrix, log_det - told[0][1]) for matrix, log_det in told]
        others = np.setdiff1d(np.arange(len(state)), np.concatenate(own))
        self._order = np.concatenate([others, *own])
        assert len(self._order) == len(state)
        self._first = len(others)
        self._matrix, self._rhs = block_of(matrix, self._order), rhs[self._order]
        self._of_noise: dict[float, _Eliminated | None] = {}
        self._of_position: dict[tuple[float, float], _Eliminated | None] = {}
        self._known: dict[tuple[float, float, float, int], float] = {}

    def prefers_larger(self, f: float, g: float) -> bool:
        """Whether larger factors than these, of position or attitude or both, are clearly more likely."""
        larger = min(self.of(i * f, j * g, 1.0) for i, j in TWICE)
        return self.of(f, g, 1.0) - larger > CLEARLY_LIKELIER

    def gain(self, f: float, g: float) -> float:
        """By how much the cost falls where the factors are as much larger than these as is likely best."""
        return self.of(f, g, 1.0) - min(self.of(i * f, j * g, 1.0) for i in LARGER for j in LARGER)

    def of(self, f: float, g: float, h: float, time: int = 0) -> float:
        """Of factors of position, attitude and noise, and a time by its place; infinite where the equations have no
        solution."""
        if (f, g, h, time) not in self._known:
            self._known[f, g, h, time] = self._weighed(f, g, h, time)
        return self._known[f, g, h, time]

    def _weighed(self, f: float, g: float, h: float, time: int) -> float:
        if h not in self._of_noise:
            self._of_noise[h] = self._without_others(h)
        both, A, (B, log_det), (a, b) = self._of_noise[h], self._apriori[0], self._attitude[time], self._rows
        if both is None:
            return np.inf
        if (f, h) not in self._of_position:
            m = len(A)
            matrix = both.matrix.copy()
            matrix[:m, :m] += A / f**2
            self._of_position[f, h] = _eliminated(matrix, both.rhs, m)
        one = self._of_position[f, h]
        last = None if one is None else _eliminated(one.matrix + B / g**2, one.rhs, len(B))
        if one is None or last is None:
            return np.inf
        gained = sum(part.log_det - part.square for part in (both, one, last))
        of_looks = 0.0
        if self.noise is not None and h > 1.0:
            of_looks = 2.0 * self.noise.rows * np.log(h) - (1.0 - h**-2) * self.noise.square
        far = self.beforehand.cost(f, g) + np.log(h) ** 2 / USUAL_LOG**2
        return float(gained - log_det + 2.0 * (a * np.log(f) + b * np.log(g)) + of_looks + far)

    def _without_others(self, h: float) -> _Eliminated | None:
        """The equations of the pair, without what is stated of it."""
        matrix, rhs = self._matrix, self._rhs
        if self.noise is not None and h > 1.0:
            less = 1.0 - h**-2
            matrix = matrix - less * block_of(self.noise.matrix, self._order)
            rhs = rhs - less * self.noise.rhs[self._order]
        return _eliminated(matrix, rhs, self._first)


class Likely(NamedTuple):
    """What is likely.

    Attributes
    ----------
    position, attitude : factors of errors of one kind
    noise : what the noise of looks is to be multiplied by
    at_most_s : what the attitude's correlation time is to be bounded by
    """

    position: float
    attitude: float
    noise: float
    at_most_s: float


def likely(cost: Likelihood, present: tuple[float, float]) -> Likely:
    """Factors of errors of position and attitude of one kind, and what the noise of looks is to be multiplied by, from
    the likelihood of the data under a bank of them.

    Whether a position is off, or an attitude, or the looks are less good shows in the images by little. So each choice
    of factors is weighed by its restricted likelihood, and variances are averaged: where the data cannot tell, all are
    larger, and no sigma is too small. Most of the bank is far from likely: the search goes from the factors in force to
    neighbours as long as they count. An attitude that wanders faster than stated is another one of the models. What a
    factor is depends on the time that it goes with, so one of them is chosen: the shortest that has half of the weight.

    Parameters
    ----------
    cost : of a choice of factors
    present : factors in force

    Raises
    ------
    DivergedError : none of them has a likelihood that is a number
    """
    noises = NOISES if cost.noise is not None else (1.0,)
    most = len(BANK), len(BANK), len(noises), len(cost.times_s)
    costs = np.full(most, np.inf)
    first = tuple(int(np.argmin(np.abs(np.log(np.divide(BANK, f))))) for f in present)
    begin: tuple[int, ...] = (*first, 0, 0)
    seen, waiting, least = {begin}, [begin], np.inf
    while waiting:
        place = waiting.pop()
        i, j, k, time = place
        costs[place] = cost.of(BANK[i], BANK[j], noises[k], time)
        least = min(least, costs[place])
        if costs[place] > least + COUNTS and np.isfinite(least):
            continue
        beside = {tuple(map(sum, zip(place, step, strict=True))) for step in STEPS} - seen
        near = sorted(c for c in beside if min(c) >= 0 and all(i < n for i, n in zip(c, most, strict=True)))
        seen.update(near)
        waiting.extend(near)
    if not np.isfinite(least):
        raise DivergedError("no sigma of the trajectory makes the tie points likely")
    weight = np.exp(-0.5 * (costs - least))
    of_time = weight.sum(axis=(0, 1, 2)) / weight.sum()
    enough = ENOUGH_WEIGHT * np.where(np.arange(len(of_time)) == 0, STAYS, 1.0)
    chosen = min(np.flatnonzero(of_time > enough).tolist(), key=lambda i: cost.times_s[i], default=0)
    weight = weight[..., chosen] / weight[..., chosen].sum()
    squares = (
        weight.sum(axis=others) @ np.square(bank)
        for others, bank in zip(((1, 2), (0, 2), (0, 1)), (BANK, BANK, noises), strict=True)
    )
    f, g, h = (float(np.sqrt(square)) for square in squares)
    return Likely(f, g, h, cost.times_s[chosen])


@dataclass(frozen=True)
class _Eliminated:
    """Normal equations (m, m), (m,) without their first unknowns; what these add to ``log det N``, ``n' N^-1 n``."""

    matrix: Array
    rhs: Array
    log_det: float
    square: float


def _eliminated(matrix: Array, rhs: Array, first: int) -> _Eliminated | None:
    """Without the first unknowns; None where these are not determined."""
    try:
        root = np.linalg.cholesky(matrix[:first, :first])
    except np.linalg.LinAlgError:
        return None
    y = np.column_stack([matrix[:first, first:], rhs[:first]])
    if first:  # solve_triangular asks more of its arguments than such a small system takes
        y, _ = _trtrs(root.T, y, lower=0, trans=1)
    X, y = y[:, :-1], y[:, -1]
    log_det = 2.0 * float(np.log(np.diagonal(root)).sum())
    return _Eliminated(matrix[first:, first:] - X.T @ X, rhs[first:] - X.T @ y, log_det, float(y @ y))
