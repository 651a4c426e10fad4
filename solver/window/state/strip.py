"""A strip in the window: its time scale and its trajectory model, whose unknowns come and go with time."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...arrays import Array, IntArray
from ...geometry.trajectory import Poses
from ...models import MODELS
from ...models.base import (
    ATTITUDE_WANDER,
    CONSTANT,
    ERROR_GROUPS,
    WANDERS,
    CorrectionModel,
    Design,
    Extent,
    ModelOptions,
    PseudoObservations,
    error_groups,
)
from ...models.dgr import DgrOptions
from ...models.lim import LimOptions
from ...models.ppm import PpmOptions
from ...models.slow_errors import SlowErrors
from ...models.wander import NOTHING, SEGMENT_SHARE, Wander, WanderOptions
from ..results import WindowOptions
from .platform import LivePlatform
from .unknowns import WindowState

#: Times of orientation that are worked on at once: those of a longer stretch depend on more unknowns. Tuned.
TIMES_AT_ONCE = 64
#: Length assumed of a strip that does not say how long it will be, s; what the drift is counted over.
UNKNOWN_LENGTH_S = 600.0
#: Sampling of the times at which an unknown is in use, share of a segment.
_SAMPLING = 0.05
#: Of a wander that is fast because the filter learns, so much may be left out between borders, m and rad: small against
#: the noise of an image coordinate on the ground and in the air. There are half as many unknowns and less, and over
#: seeds errors are no larger (bench/apriori.py).
LEFT_OUT_M, LEFT_OUT = 0.035, 1.5e-5
#: Correlation times that an attitude may have in place of a longer one that is stated, s.
ATTITUDE_TIMES_S = (6.0,)
#: One that is stated is longer than another by so much, at least, where it may be that one. Tuned.
CLEARLY_SHORTER = 1.5


def segment_length(slow: SlowErrors, options: WindowOptions) -> float:
    """Longest segment, s."""
    return options.segment_s or SEGMENT_SHARE * float(slow.wander_times_s.min())


def model_options(slow: SlowErrors, options: WindowOptions, length_s: float) -> ModelOptions:
    """Settings of the model that `options` names, with a-priori sigmas from the slow errors.

    All but "dgr", which has no place for it, state the wander as the process it is.

    Raises
    ------
    ValueError : an unknown model
    """
    step = segment_length(slow, options)
    pieces = max(1, int(np.ceil(length_s / step - 1e-9)))
    if options.model == "wander":
        if not slow.is_learnt or options.segment_s:
            return WanderOptions(slow, step)
        return WanderOptions(slow, step, LEFT_OUT_M, LEFT_OUT)
    if options.model == "dgr":
        offset, shift, drift = (_triple(v) for v in (slow.offset_m, np.degrees(slow.shift), np.degrees(slow.drift)))
        degrees = np.degrees(slow.wander)
        return DgrOptions(offset, shift, drift, slow.wander_m, (degrees[0], degrees[1], degrees[2]))
    if options.model == "lim":
        return LimOptions(max(pieces + 1, 4), False, slow=slow.alike)
    if options.model == "ppm":
        return PpmOptions(segments=pieces, slow=slow.alike)
    raise ValueError(f"unknown trajectory model {options.model!r}; known: {', '.join(MODELS)}")


def _triple(values: ArrayLike) -> tuple[float, float, float]:
    a, b, c = np.maximum(values, NOTHING).tolist()
    return (a, b, c)


@dataclass(frozen=True)
class StatedConstants:
    """What is known beforehand of offset, shift and drift of a strip.

    Attributes
    ----------
    columns, coefficients, value, sigma : (m, t), (m, t), (m,), (m,) equations: numbers of unknowns, -1 for none; sigmas
        as stated at first
    group, factor : (m,) place in `ERROR_GROUPS`, and what the sigmas have been multiplied by
    """

    columns: NDArray[np.int32]
    coefficients: Array
    value: Array
    sigma: Array
    group: IntArray
    factor: Array

    def restated(self, factor: Array) -> tuple[StatedConstants, IntArray, Array, Array] | None:
        """With factors (4,), where they are larger; None where none is.

        Returns
        -------
        constants : what is known then
        numbers, matrix, rhs : (u,), (u, u), (u,) how the normal equations change by it, and of which unknowns
        """
        larger = np.maximum(self.factor, factor[self.group])
        rows = np.flatnonzero(larger > self.factor)
        if not len(rows):
            return None
        change = (self.sigma * larger)[rows] ** -2.0 - (self.sigma * self.factor)[rows] ** -2.0
        row, term = np.nonzero(self.columns[rows] >= 0)
        numbers, place = np.unique(self.columns[rows][row, term], return_inverse=True)
        design = np.zeros((len(rows), len(numbers)))
        design[row, place] = self.coefficients[rows][row, term]
        matrix, rhs = design.T @ (change[:, None] * design), design.T @ (change * self.value[rows])
        return replace(self, factor=larger), numbers.astype(np.int64), matrix, rhs


class WindowStrip:
    """A strip whose model grows with time.

    The model is built for the planned length; unknowns become present in the window's state when a time needs them,
    with those a-priori observations that speak of present unknowns only, and leave it when no later time needs them.

    Attributes
    ----------
    id : name
    first_line_time_s, line_rate_hz : image line u is taken at first_line_time_s + u / line_rate_hz
    lines : number of lines, 0 = not known
    model : its correction functions
    slow : its slow errors, as known beforehand
    followed : (6,) spectral density of the wander that its model follows, see `SlowErrors`
    ended : whether the last line has been taken
    final_to_s : orientation up to here is final, or not refined at all where the flight was joined later
    factor : (4,) what the a-priori sigmas are multiplied by from now on, by `ERROR_GROUPS`
    """

    def __init__(
        self,
        id: str,
        first_line_time_s: float,
        line_rate_hz: float,
        lines: int,
        slow: SlowErrors,
        options: WindowOptions,
        state: WindowState,
        joined_s: float = -np.inf,
        factor: Array | None = None,
        attitude_at_most_s: float = np.inf,
        platform: LivePlatform | None = None,
    ):
        self.id = id
        self._platform = platform
        self.first_line_time_s, self.line_rate_hz = first_line_time_s, line_rate_hz
        self.lines = lines
        self.slow = slow
        self.followed = slow.wander_density if options.follows_wander else np.zeros(6)
        self.ended = False
        self.end_s = first_line_time_s + lines / line_rate_hz if lines else np.inf
        length = lines / line_rate_hz if lines else UNKNOWN_LENGTH_S
        start_s = max(first_line_time_s, min(joined_s, first_line_time_s + length - 1.0))
        self.final_to_s = start_s
        self.model: CorrectionModel = model_options(slow, options, length).build(
            Extent(f"strip {id}", start_s, first_line_time_s + length)
        )
        if isinstance(self.model, Wander) and attitude_at_most_s < np.inf:
            self.model.bound_attitude_time(attitude_at_most_s)
        self.numbers = state.new_numbers(self.model.n_unknowns)
        self._prior = self.model.pseudo_observations()
        self._if_bound: dict[float, PseudoObservations] = {}
        self._row_done = np.zeros(len(self._prior), dtype=bool)
        self.factor = np.ones(4) if factor is None else factor.copy()
        self._group = error_groups(self._prior.labels)
        self._scale = np.ones(len(self._prior))  # of the sigmas of rows that are done
        self._entered = np.zeros(self.model.n_unknowns, dtype=bool)
        self._step_s = segment_length(slow, options)
        self._over = False
        self._look_up_uses()
        always = (self._first_use <= start_s) & (self._last_use >= self.model.extent.end_s)
        state.last(self.numbers[always])

    def restate(self, from_s: float, slow: SlowErrors, another: bool = False) -> float:
        """Another wander from a border on, where the model is one of wander; see `Wander.restate`."""
        assert isinstance(self.model, Wander)
        border_s = self.model.restate(from_s, [*slow.wander_m, *slow.wander], slow.wander_times_s, another)
        self._if_bound.clear()
        if np.isfinite(border_s):
            self._look_up_uses()
        return border_s

    @property
    def attitude_times_s(self) -> tuple[float, ...]:
        """What the correlation time of the attitude's wander may be bounded by; inf, as stated, first."""
        stated_s = float(self.slow.wander_times_s[3]) if isinstance(self.model, Wander) else 0.0
        return np.inf, *(time_s for time_s in ATTITUDE_TIMES_S if time_s < stated_s / CLEARLY_SHORTER)

    def bound_attitude_time(self, at_most_s: float, factor: Array, state: WindowState) -> None:
        """Bound the correlation time of the attitude's wander, of all of the strip, and multiply its sigmas by that of
        factors (4,); inf for as stated. What it was found to be with another time says nothing."""
        if not isinstance(self.model, Wander):
            return
        rows = self._rows_present(state)
        rows = rows[self._group[rows] == ATTITUDE_WANDER]
        columns, coefficients, value, before = self._rows(rows)
        none = np.full(len(rows), np.inf)
        state.reweigh(columns, coefficients, value, before, none)
        self.model.bound_attitude_time(at_most_s)
        self._scale[(self._group == ATTITUDE_WANDER) & self._row_done] = factor[ATTITUDE_WANDER]
        columns, coefficients, value, now = self._rows(rows)
        state.reweigh(columns, coefficients, value, none, now)

    def _look_up_uses(self) -> None:
        self._first_use, self._last_use = self._uses(self._step_s)
        self._need = self._first_use[self._prior.columns].max(axis=1, initial=-np.inf, where=self._prior.columns >= 0)

    def _uses(self, step_s: float) -> tuple[Array, Array]:
        """Times (n_unknowns,) before and after which an unknown takes no part; up to one sample on the safe side."""
        extent = self.model.extent
        t = np.linspace(extent.start_s, extent.end_s, int((extent.end_s - extent.start_s) / (_SAMPLING * step_s)) + 2)
        columns = self.model.design(t).columns.reshape(len(t), -1)
        first = np.full(self.model.n_unknowns + 1, np.inf)
        last = np.full(self.model.n_unknowns + 1, -np.inf)
        np.minimum.at(first, columns, t[:, None])
        np.maximum.at(last, columns, t[:, None])
        sample = t[1] - t[0]
        return first[:-1] - sample, np.minimum(last[:-1] + sample, extent.end_s)

    def time_of(self, line: ArrayLike) -> Array:
        return self.first_line_time_s + np.asarray(line, dtype=float) / self.line_rate_hz

    def contains(self, line: float) -> bool:
        return line >= -0.5 and (not self.lines or line <= self.lines - 0.5)

    def end(self, lines: int, end_s: float | None = None) -> None:
        """The strip is over."""
        self.ended = True
        if lines:
            self.lines = lines
            self.end_s = float(self.time_of(lines)) if end_s is None else end_s

    def design(self, time_s: ArrayLike, poses: Poses | None = None) -> Design:
        """Design with the unknowns' numbers in the window, those of the platform among them.

        Parameters
        ----------
        poses : measured orientation at the times, if the caller has it
        """
        return self._numbered(self.model.design(time_s), time_s, poses)

    def design_and_left_out(self, time_s: ArrayLike, poses: Poses | None = None) -> tuple[Design, Array]:
        """`design` of times (n,) and what the model cannot follow (n, 6), which have work in common."""
        design, variance = self.model.design_and_left_out(time_s)
        return self._numbered(design, time_s, poses), variance

    def _numbered(self, d: Design, time_s: ArrayLike, poses: Poses | None) -> Design:
        d = Design(np.where(d.columns >= 0, self.numbers[d.columns], -1).astype(np.int32), d.coefficients)
        return d if self._platform is None else self._platform.joined(d, np.asarray(time_s, dtype=float), poses)

    @property
    def entered(self) -> IntArray:
        """Numbers of the unknowns that a time has needed so far."""
        return self.numbers[self._entered]

    def apriori(self) -> tuple[NDArray[np.int32], Array, Array, Array]:
        """A-priori equations of these: columns (m, t) by number, -1 for none, coefficients, values, sigmas."""
        rows = np.flatnonzero(self._row_done & np.isfinite(self._prior.sigma))
        return self._rows(rows)

    def constants(self) -> StatedConstants:
        """Those of the a-priori equations that speak of offset, shift and drift."""
        done = self._row_done & np.isfinite(self._prior.sigma)
        rows = np.flatnonzero(done & np.isin(self._group, CONSTANT))
        columns, coefficients, value, sigma = self._rows(rows)
        scale = self._scale[rows]
        return StatedConstants(columns, coefficients, value, sigma / scale, self._group[rows], scale)

    def _rows(
        self, rows: IntArray, prior: PseudoObservations | None = None
    ) -> tuple[NDArray[np.int32], Array, Array, Array]:
        p = prior or self._prior
        columns = np.where(p.columns[rows] >= 0, self.numbers[p.columns[rows]], -1).astype(np.int32)
        return columns, p.coefficients[rows], p.value[rows], p.sigma[rows] * self._scale[rows]

    def apriori_fit(
        self, state: WindowState, since_s: float, held: IntArray | None = None, of: IntArray | None = None
    ) -> tuple[IntArray, Array, Array]:
        """How well the solution agrees with what was known beforehand of the unknowns that are present.

        Parameters
        ----------
        state : solved
        since_s : only what speaks of unknowns that are in use after this time, and of those of the whole strip
        held : unknowns that are held at zero for this
        of : groups that are looked at; None for all

        Returns
        -------
        group, square, redundancy : (m,) place in `ERROR_GROUPS`, squared residual and redundancy number of each
            a-priori equation, with the sigmas that it has now
        """
        rows = self._rows_present(state)
        rows = rows[(self._need[rows] > since_s) | (self._group[rows] < 2)]
        if of is not None:
            rows = rows[np.isin(self._group[rows], of)]
        columns, coefficients, value, sigma = self._rows(rows)
        numbers, place = _touched(columns)
        b = np.where(columns >= 0, coefficients, 0.0) / sigma[:, None]
        if held is None:
            theta, Q = state.values(numbers), state.covariance(numbers)
        else:
            theta, Q = state.if_held(held, numbers)
        residual = np.einsum("mt,mt->m", b, theta[place]) - value / sigma
        known = np.einsum("mt,mtu,mu->m", b, Q[place[:, :, None], place[:, None, :]], b)
        return self._group[rows], residual**2, np.clip(1.0 - known, 0.0, 1.0)

    def apriori_information(self, group: int, state: WindowState) -> tuple[IntArray, Array, Array, int]:
        """Information from the a-priori equations of a group that are present.

        Returns
        -------
        numbers : (u,) of the unknowns that they speak of
        as_stated, in_force : (u, u) about these, as if the sigmas were as stated, and with those that are in force
        rows : number of the equations
        """
        rows = self._rows_present(state)
        rows = rows[self._group[rows] == group]
        columns, coefficients, _, sigma = self._rows(rows)
        numbers, place = _touched(columns)
        b = np.where(columns >= 0, coefficients, 0.0) / sigma[:, None]
        products = b[:, :, None] * b[:, None, :]
        stated = products * self._scale[rows, None, None] ** 2
        as_stated, in_force = (_summed(p, place, len(numbers)) for p in (stated, products))
        return numbers, as_stated, in_force, len(rows)

    def attitude_information(self, at_most_s: float, state: WindowState) -> tuple[Array, float]:
        """What `apriori_information` says as stated of the attitude's wander (u, u) if its correlation time were
        bounded; the logarithm of the determinant of these equations, in those unknowns that they bring into being."""
        assert isinstance(self.model, Wander)
        if at_most_s not in self._if_bound:
            self._if_bound[at_most_s] = self.model.if_attitude_time_bound(at_most_s)
        rows = self._rows_present(state)
        rows = rows[self._group[rows] == ATTITUDE_WANDER]
        columns, coefficients, _, sigma = self._rows(rows, self._if_bound[at_most_s])
        numbers, place = _touched(columns)
        b = np.where(columns >= 0, coefficients, 0.0) * (self._scale[rows] / sigma)[:, None]
        last = b.shape[1] - 1 - np.argmax(b[:, ::-1] != 0.0, axis=1)  # each brings one, of which it speaks last
        log_det = float(2.0 * np.log(np.abs(b[np.arange(len(b)), last])).sum())
        return _summed(b[:, :, None] * b[:, None, :], place, len(numbers)), log_det

    def _rows_present(self, state: WindowState) -> IntArray:
        """A-priori equations whose unknowns are all in the state."""
        rows = np.flatnonzero(self._row_done & np.isfinite(self._prior.sigma))
        columns = self._prior.columns[rows]
        present = (columns < 0) | (state.places(self.numbers[np.maximum(columns, 0)]) >= 0)
        return rows[present.all(axis=1)]

    def equations_present(self, state: WindowState) -> IntArray:
        """Number of a-priori equations of each group (4,) that are present, by `ERROR_GROUPS`."""
        return np.bincount(self._group[self._rows_present(state)], minlength=len(ERROR_GROUPS))

    def restate_sigmas(self, factor: Array, state: WindowState, kept: tuple[bool, bool] = (False, False)) -> set[int]:
        """Multiply the a-priori sigmas by other factors (4,), of what is present and of what is to come; returns the
        groups of which equations that are present have others now.

        Parameters
        ----------
        kept : a wander that is present keeps the largest factor that it has had: where the factor falls, what comes
            wanders less, and what has happened has not become smaller. Offset, shift and drift are the same errors all
            along, so that a smaller factor is what is known better of them
        """
        self.factor = factor.copy()
        rows = self._rows_present(state)
        group = self._group[rows]
        scale = factor[group]
        keeps = np.isin(group, [wander for wander, keep in zip(WANDERS, kept, strict=True) if keep])
        scale = np.where(keeps, np.maximum(scale, self._scale[rows]), scale)
        other = scale != self._scale[rows]
        rows, scale = rows[other], scale[other]
        if len(rows):
            columns, coefficients, value, before = self._rows(rows)
            self._scale[rows] = scale
            state.reweigh(columns, coefficients, value, before, self._prior.sigma[rows] * self._scale[rows])
        return set(self._group[rows].tolist())

    def activate(self, to_s: float, state: WindowState) -> bool:
        """Make unknowns present that times up to this one need; whether there were any."""
        new = np.flatnonzero(~self._entered & (self._first_use <= to_s))
        if not len(new):
            return False
        self._entered[new] = True
        rows = np.flatnonzero(~self._row_done & (self._need <= to_s))
        self._row_done[rows] = True
        self._scale[rows] = self.factor[self._group[rows]]
        state.extend(self.numbers[new], *self._rows(rows))
        return True

    def leaving(self, limit_s: float, state: WindowState) -> tuple[IntArray, float]:
        """Unknowns that no time after the limit needs, and the time up to which the orientation becomes final.

        Unknowns in use to the end of the strip leave when it has ended and is settled (limit infinite). Those that were
        in use, and no longer are since a wander was stated anew, leave with any limit; no orientation is final by that.
        """
        if self._over:
            return self.numbers, self.final_to_s
        present, settled = state.places(self.numbers) >= 0, limit_s == np.inf
        gone = present & (self._last_use <= limit_s)
        if not settled:
            gone &= self._last_use < self.model.extent.end_s - 1e-6
        if not gone.any():
            return np.empty(0, dtype=np.int64), self.final_to_s
        to_s = self.end_s if settled else max(self.final_to_s, float(self._last_use[gone].max()))
        return self.numbers[gone], to_s

    def release(self) -> None:
        """It is over and will not come back: give up what was only needed to fly it, for flights go on for hours."""
        self._over = True
        none = np.empty(0)
        self.model = DgrOptions().build(self.model.extent)  # a small one: that of the strip names all its unknowns
        self._prior = PseudoObservations(np.empty((0, 1), np.int32), none[:, None], none, none, ())
        self._if_bound.clear()
        self._need = self._first_use = self._last_use = self._scale = none
        self._row_done = self._entered = np.empty(0, dtype=bool)
        self.numbers = np.empty(0, dtype=np.int64)

    def is_gone(self, state: WindowState) -> bool:
        """Whether nothing of it is left in the state."""
        return self._over or not (state.places(self.numbers) >= 0).any()

    def is_over(self, state: WindowState) -> bool:
        """Whether it has been in the state and will not be again."""
        return self._over or (self.ended and bool(self._entered.any()) and self.is_gone(state))


def _touched(columns: NDArray[np.int32]) -> tuple[IntArray, NDArray[np.int64]]:
    """Numbers (u,) of the unknowns of equations with columns (m, t), ascending, and their places (m, t) among these;
    any place where there is none."""
    numbers = np.unique(columns)
    numbers = numbers[numbers >= 0].astype(np.int64)
    return numbers, np.minimum(np.searchsorted(numbers, columns), max(len(numbers) - 1, 0))


def _summed(products: Array, place: NDArray[np.int64], u: int) -> Array:
    """Normal equations (u, u) from the products (m, t, t) of coefficients at places (m, t)."""
    at = (place[:, :, None] * u + place[:, None, :]).ravel()
    return np.bincount(at, products.ravel(), u * u).astype(float).reshape(u, u)
