"""Wander model: constant, drift, and a wander whose value and slope at borders are the unknowns.

The piecewise model with its weights taken from what the errors are, not from experience: between borders the correction
is the conditional mean of a second-order Gauss-Markov process (for a correlation time long against a segment: the cubic
through both values and slopes, so that C0 and C1 hold exactly), and from border to border its transition is observed
with its own noise. What a segment cannot follow is known too: `left_out_variance`.

The errors of a filter do not stay as large as they were: they grow while GNSS is out and are others after a restart.
From a border on the process can therefore be stated anew (`Wander.restate`): what grows is the old error made larger;
what becomes smaller is another error, since observations have taken the place of the old one.

Source: the process in `gauss_markov`; interpolation as in T. D. Barfoot, State Estimation for Robotics, 2017, section
3.4.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..geometry.trajectory import sample_before
from .base import (
    COMPONENTS,
    CorrectionModel,
    Design,
    Extent,
    ModelOptions,
    PseudoObservations,
    direct_observations,
    join_observations,
    three,
)
from .gauss_markov import damping_rate, over_step, second_order_gauss_markov
from .slow_errors import SlowErrors

Array = NDArray[np.floating]
IntArray = NDArray[np.int_]

#: A-priori sigma in place of zero, share of a metre or radian: an error that is said not to exist.
NOTHING = 1e-7
#: A trajectory without slow errors.
NO_SLOW_ERRORS = SlowErrors()
#: Length of a segment as a share of the correlation time: what is left out is then below 1 % of the wander.
SEGMENT_SHARE = 1.0 / 15.0
#: Numbers of shortest segments that a longer one may have.
LENGTHS = (2, 3, 4, 5)
#: Columns of offset, shift and drift before those of the borders.
GLOBALS = 9


@dataclass(frozen=True)
class WanderOptions(ModelOptions):
    """Settings of the wander model.

    Attributes
    ----------
    slow : a-priori sigmas of offset, shift, drift and wander
    segment_s : longest time between borders; 0 = `SEGMENT_SHARE` of the shortest correlation time
    left_out_m, left_out : segments of a component may be longer, whole numbers of these, where interpolation then
        leaves out no more than so much of its wander, m and rad
    """

    name: ClassVar[str] = "wander"
    slow: SlowErrors = NO_SLOW_ERRORS
    segment_s: float = 0.0
    left_out_m: float = 0.0
    left_out: float = 0.0

    @classmethod
    def from_settings(cls, settings: Mapping[str, object]) -> Self:
        degree = float(np.pi / 180)

        def angles(key: str, default: float, *, zeros: bool = False) -> tuple[float, float, float]:
            a, b, c = three(settings, key, (default, default, default), zeros=zeros)
            return (a * degree, b * degree, c * degree)

        slow = SlowErrors(
            three(settings, "offset_sigma_m", (0.2, 0.2, 0.2)),
            angles("shift_sigma_deg", 0.01),
            angles("drift_sigma_deg", 0.01),
            three(settings, "wander_sigma_m", (0.1, 0.1, 0.1), zeros=True),
            angles("wander_sigma_deg", 0.005, zeros=True),
            float(str(settings.get("wander_time_s", 30.0))),
            float(str(settings.get("attitude_wander_time_s", 0.0))),
        )
        return cls(slow, float(str(settings.get("segment_s", 0.0))))

    def build(self, extent: Extent) -> Wander:
        return Wander(extent, self)


class Wander(CorrectionModel):
    """Columns 0..8: offset, shift, drift; ``9 + 12 k + c`` value, ``15 + 12 k + c`` slope of component c at border k.

    Attributes
    ----------
    borders : (segments + 1,) times, seconds; equally far apart, the last one at the end of the extent or beyond
    used : (6) of each component, places of the borders in use, the first and the last one among them; the unknowns of
        others appear nowhere
    """

    def __init__(self, extent: Extent, options: WanderOptions):
        self.extent = extent
        self.options = options
        slow = options.slow
        self.step_s = options.segment_s or SEGMENT_SHARE * float(slow.wander_times_s.min())
        segments = max(1, int(np.ceil((extent.end_s - extent.start_s) / self.step_s - 1e-9)))
        self.borders = extent.start_s + self.step_s * np.arange(segments + 1)
        kinds = ["offset"] * 3 + ["shift"] * 3 + ["drift"] * 3
        names = [f"{c} {kind} of {extent.name}" for c, kind in zip(COMPONENTS + COMPONENTS[3:], kinds, strict=True)]
        names += [
            f"{c} wander {kind} at border {k + 1} of {extent.name}"
            for k in range(segments + 1)
            for kind in ("value", "slope")
            for c in COMPONENTS
        ]
        self.unknown_names = tuple(names)
        self.notes = ("drift is the change over the strip: s = (t - start) / (end - start)",)
        self._sigma = np.tile(np.maximum(np.concatenate([slow.wander_m, slow.wander]), NOTHING), (segments + 1, 1))
        self._time_s = np.tile(slow.wander_times_s, (segments + 1, 1))
        self._another = np.zeros(segments + 1, dtype=bool)
        self._attitude_at_most_s = np.inf
        self.used = self._spaced(0, self._sigma[0], self._time_s[0])
        self._grouped()
        self._observations = self._stated(self._times_s())

    def design(self, time_s: ArrayLike) -> Design:
        return self._design(*self._located(time_s))[0]

    def left_out_variance(self, time_s: ArrayLike) -> Array:
        """Variance (n, 6) of what the wander does between borders beyond the interpolation, m^2 and rad^2."""
        return self._left_out(*self._located(time_s)[1:])

    def design_and_left_out(self, time_s: ArrayLike) -> tuple[Design, Array]:
        located = self._located(time_s)
        design, between = self._design(*located)
        return design, self._left_out(*located[1:], between if self._as_stated else None)

    def _located(self, time_s: ArrayLike) -> tuple[Array, IntArray, IntArray, Array]:
        """Times (n,); for each group of `_alike` the borders in use around them, (n, g) each, and the time (n, g) since
        the first of both."""
        t = np.asarray(time_s, dtype=float)
        place = np.floor((t - self.borders[0]) / self.step_s)
        k = [sample_before(used, place) for used in self._use]
        begin = np.stack([used[i] for used, i in zip(self._use, k, strict=True)], axis=1)
        end = np.stack([used[i + 1] for used, i in zip(self._use, k, strict=True)], axis=1)
        inside = np.minimum(np.maximum(t[:, None] - self.borders[begin], 0.0), self.step_s * (end - begin))
        return t, begin, end, inside

    def _design(self, t: Array, begin: IntArray, end: IntArray, inside: Array) -> tuple[Design, Array]:
        """The design, and the variance (n, g) of what is left out of wanders as stated for sigma 1."""
        n, groups = begin.shape
        variance, part = self._between(inside, self.options.slow.wander_times_s[self._first], end - begin)
        coefficients = np.empty((n, 2 + 4 * groups))
        coefficients[:, 0] = 1.0
        coefficients[:, 1] = (t - self.extent.start_s) / (self.extent.end_s - self.extent.start_s)
        coefficients[:, 2:] = part.reshape(n, -1)
        border = np.zeros((n, 2 + 4 * groups, 1), dtype=np.int32)
        border[:, 2::4, 0] = border[:, 3::4, 0] = begin
        border[:, 4::4, 0] = border[:, 5::4, 0] = end
        return Design(np.where(self._column >= 0, self._column + 12 * border, np.int32(-1)), coefficients), variance

    def _left_out(self, begin: IntArray, end: IntArray, inside: Array, variance: Array | None = None) -> Array:
        if variance is None:
            variance, _ = self._between(inside, self._times_s()[end, self._first], end - begin)
        part = inside / (self.step_s * (end - begin))
        jump = np.minimum(np.maximum(part * (1.0 - part), 0.0), 0.25)  # where a wander becomes another is unknown
        g, components = self._group, np.arange(6)
        before, after = self._sigma[begin[:, g], components], self._sigma[end[:, g], components]
        size = np.where(self._another[end[:, g]], before**2 + after**2, (after - before) ** 2)
        return variance[:, g] * np.maximum(before, after) ** 2 + jump[:, g] * size

    def restate(self, from_s: float, sigma: ArrayLike, time_s: ArrayLike, another: bool = False) -> float:
        """Another wander from a border on, the second one after a time, so that the segment there and its borders stay.

        The arrays that `pseudo_observations` gave change for the segments concerned, and so may the borders in use; who
        has used them already for times up to ``from_s`` sees no difference.

        Parameters
        ----------
        from_s : up to here the model has been in use
        sigma : (6,) standard deviations, metres and radians
        time_s : correlation time, or (6,) of each component
        another : it is another error altogether, however large

        Returns
        -------
        border_s : from here on it holds; infinite if the strip ends before
        """
        place, last = int(np.floor((from_s - self.borders[0]) / self.step_s + 0.1)), len(self.borders) - 1
        sigma = np.maximum(np.asarray(sigma, dtype=float), NOTHING)
        time_s = np.broadcast_to(np.asarray(time_s, dtype=float), 6)
        if place < -1:
            first, self.used = 0, self._spaced(0, sigma, time_s)
        else:
            # of all components the last border that stays as it is; all have it, and the next one
            stays = max(int(used[min(np.searchsorted(used, place, side="right"), len(used) - 1)]) for used in self.used)
            if stays == last:
                return np.inf
            first = min(int(used[1]) for used in self._spaced(stays, sigma, time_s))
            after = self._spaced(first, sigma, time_s) if first < last else [np.array([last])] * 6
            kept = [np.append(used[used < stays], stays) for used in self.used]
            self.used = [np.concatenate(both) for both in zip(kept, after, strict=True)]
        self._sigma[first:] = sigma
        self._time_s[first:] = time_s
        self._another[first] = another
        self._state_anew()
        return float(self.borders[first])

    def bound_attitude_time(self, at_most_s: float) -> None:
        """Take the attitude's correlation time for no longer than so many seconds, inf for as stated; the arrays that
        `pseudo_observations` gave change, and borders in use stay."""
        self._attitude_at_most_s = at_most_s
        self._state_anew()

    def if_attitude_time_bound(self, at_most_s: float) -> PseudoObservations:
        """What `pseudo_observations` would be after `bound_attitude_time`."""
        return self._stated(self._times_s(at_most_s))

    def _state_anew(self) -> None:
        self._grouped()
        changed = self._stated(self._times_s())
        self._observations.columns[...] = changed.columns
        self._observations.coefficients[...] = changed.coefficients
        self._observations.sigma[...] = changed.sigma

    def _times_s(self, attitude_at_most_s: float | None = None) -> Array:
        """(segments + 1, 6) correlation times that hold."""
        at_most_s = self._attitude_at_most_s if attitude_at_most_s is None else attitude_at_most_s
        return np.minimum(self._time_s, np.repeat([np.inf, at_most_s], 3))

    def _spaced(self, first: int, sigma: Array, time_s: Array) -> list[IntArray]:
        """Borders in use of each component from one to the last, as far apart as a wander (6,), (6,) allows."""
        o, last = self.options, len(self.borders) - 1
        allowed = np.repeat([o.left_out_m, o.left_out], 3)
        lengths = np.ones(6, dtype=np.int64)
        for longer in LENGTHS if allowed.any() else ():
            out = np.sqrt(self._between(np.full(6, 0.5 * longer * self.step_s), time_s, np.full(6, longer))[0])
            lengths[out * sigma <= allowed] = longer
        return [np.append(np.arange(first, last, length), last) for length in lengths.tolist()]

    def _alike(self, times_s: Array) -> list[IntArray]:
        """Components by the borders they use and their correlation times (segments + 1, 6)."""
        found: dict[bytes, list[int]] = {}
        stated = self.options.slow.wander_times_s
        for component, (used, time_s) in enumerate(zip(self.used, times_s.T, strict=True)):
            found.setdefault(used.tobytes() + stated[component].tobytes() + time_s.tobytes(), []).append(component)
        return [np.array(components) for components in found.values()]

    def _grouped(self) -> None:
        """Look up what depends on the groups of `_alike` only."""
        times_s = self._times_s()
        alike = self._alike(times_s)
        self._first = np.array([components[0] for components in alike])
        self._use = [self.used[component] for component in self._first]
        self._as_stated = bool((times_s == self.options.slow.wander_times_s).all())
        self._group = np.empty(6, dtype=np.int64)
        # (k, 6) columns of a time's coefficients, of its two borders as if both were the first one
        self._column = np.full((2 + 4 * len(alike), 6), -1, dtype=np.int32)
        self._column[0] = np.arange(6)
        self._column[1, 3:] = [6, 7, 8]
        for g, components in enumerate(alike):
            self._group[components] = g
            for row, slope in enumerate((0, 6, 0, 6)):
                self._column[2 + 4 * g + row, components] = GLOBALS + slope + components

    def _between(self, after: Array, time_s: ArrayLike, length: IntArray) -> tuple[Array, Array]:
        """Variance (...) of what is left out for sigma 1, and coefficients (..., 4), at times after a border."""
        correlated_s = np.broadcast_to(time_s, after.shape)
        different = set(correlated_s.ravel().tolist()) or {1.0}  # any, of no times
        if len(different) == 1:
            return self._interpolated(after, different.pop(), length)
        variance, coefficients = np.empty(after.shape), np.empty((*after.shape, 4))
        for each in different:
            mine = correlated_s == each
            variance[mine], coefficients[mine] = self._interpolated(after[mine], each, length[mine])
        return variance, coefficients

    def _interpolated(self, after: Array, time_s: float, length: IntArray) -> tuple[Array, Array]:
        """The same for one correlation time."""
        rate, whole_s = damping_rate(time_s), self.step_s * length
        F00, F01, F10, F11, W00, W01, W11 = _over_segments(rate, self.step_s, int(length.max(initial=1)))[:, length]
        # from the beginning of the segment to the time, and from there to its end; the value, without the slope
        from_value, from_slope, _, _, q, cross, _ = over_step(rate, after)
        to00, to01, to10, to11, *_ = over_step(rate, whole_s - after)
        back_value = q * to00 + cross * to01
        back_slope = q * to10 + cross * to11
        right_value = back_value * W00 + back_slope * W01
        right_slope = back_value * W01 + back_slope * W11
        left_value = from_value - right_value * F00 - right_slope * F10
        left_slope = from_slope - right_value * F01 - right_slope * F11
        variance = np.maximum(q - right_value * back_value - right_slope * back_slope, 0.0)
        return variance, np.stack([left_value, left_slope, right_value, right_slope], axis=-1)

    def pseudo_observations(self) -> PseudoObservations:
        return self._observations

    def _stated(self, times_s: Array) -> PseudoObservations:
        slow = self.options.slow
        sigma = np.concatenate([slow.offset_m, slow.shift, slow.drift])
        start = GLOBALS + np.arange(12)
        slope_sigma = self._sigma[0] * _damping_rates(times_s[0])
        direct = direct_observations(
            np.concatenate([np.maximum(sigma, NOTHING), self._sigma[0], slope_sigma]),
            self.unknown_names[: GLOBALS + 12],
        )
        assert (direct.columns[GLOBALS:, 0] == start).all()
        return join_observations([direct, self._transitions(times_s)])

    def _transitions(self, times_s: Array) -> PseudoObservations:
        """Two whitened observations ``G (z_k+1 - F D z_k) = 0`` of every component and segment, ``G Q G^T = I``.

        ``D`` makes an error that grows larger. Where sigma falls, the value at the next border is a new one. There are
        as many rows as if all borders were in use; those that end at others carry no weight.
        """
        n = len(self.borders) - 1
        coefficients, sigma = np.zeros((n, 6, 2, 4)), np.full((n, 6), np.inf)
        before = np.repeat(np.arange(n)[:, None], 6, axis=1)
        for c in self._alike(times_s):
            begin, end = self.used[c[0]][:-1], self.used[c[0]][1:]
            before[np.ix_(end - 1, c)] = begin[:, None]
            sigma[np.ix_(end - 1, c)] = self._sigma[np.ix_(end, c)]
            times = times_s[:, c[0]]
            for time_s, length in {*zip(times[end].tolist(), (end - begin).tolist(), strict=True)}:
                chosen = (times[end] == time_s) & (end - begin == length)
                a, b = begin[chosen], end[chosen]
                F, Q, P0 = second_order_gauss_markov(1.0, time_s, self.step_s * length)
                G, new = (np.tril(np.linalg.inv(np.linalg.cholesky(of))) for of in (Q, P0))
                ratio = (self._sigma[b] / self._sigma[a])[:, c]
                rate = np.sqrt(P0[1, 1]) / _damping_rates(times[a])
                D = np.zeros((*ratio.shape, 2, 2))
                D[..., 0, 0], D[..., 1, 1] = ratio, ratio * rate[:, None]
                falls = ((ratio < 1.0 - 1e-9) | self._another[b][:, None])[..., None, None]
                place = np.ix_(b - 1, c)
                coefficients[place] = np.concatenate(
                    [np.where(falls, 0.0, -G @ F @ D), np.broadcast_to(np.where(falls, new, G), D.shape)], axis=-1
                )
        segment, component, row = (a.ravel() for a in np.indices((n, 6, 2)))
        from_column = GLOBALS + 12 * before[segment, component] + component
        to_column = GLOBALS + 12 * (segment + 1) + component
        columns = np.stack([from_column, from_column + 6, to_column, to_column + 6], axis=1)
        labels = tuple(
            f"wander of {COMPONENTS[c]} over segment {k + 1} of {self.extent.name}"
            for k, c in zip(segment, component, strict=True)
        )
        return PseudoObservations(
            columns.astype(np.int32),
            coefficients[segment, component, row],
            np.zeros(len(row)),
            sigma[segment, component],
            labels,
        )

    def describe(self, theta: ArrayLike, sigma: ArrayLike) -> dict[str, object]:
        result: dict[str, object] = {"s": "share of the strip"}
        values = {"": np.asarray(theta, dtype=float), "_sigma": np.asarray(sigma, dtype=float)}
        for key, part, unit in (("offset_m", 0, 1.0), ("shift_deg", 3, 180 / np.pi), ("drift_deg", 6, 180 / np.pi)):
            for suffix, array in values.items():
                result[key + suffix] = (array[part : part + 3] * unit).tolist()
        borders: list[dict[str, object]] = []
        for k, time in enumerate(self.borders):
            one: dict[str, object] = {"time_s": float(time)}
            for suffix, array in values.items():
                value = array[GLOBALS + 12 * k : GLOBALS + 12 * k + 6]
                one["value_m" + suffix] = value[:3].tolist()
                one["value_deg" + suffix] = np.degrees(value[3:]).tolist()
            borders.append(one)
        result["borders"] = borders
        return result


def _damping_rates(time_s: NDArray[np.floating]) -> Array:
    return np.array([damping_rate(t) for t in time_s.tolist()])


@lru_cache(maxsize=64)
def _over_segments(rate: float, step_s: float, most: int) -> Array:
    """Elements F00, F01, F10, F11 of the transition and W00, W01, W11 of the inverse covariance, sigma 1, over segments
    of 0 to ``most`` steps: (7, most + 1), NaN for 0."""
    F00, F01, F10, F11, Q00, Q01, Q11 = over_step(rate, step_s * np.arange(1, most + 1))
    W = np.linalg.inv(np.stack([Q00, Q01, Q01, Q11], axis=1).reshape(-1, 2, 2))
    table = np.stack([F00, F01, F10, F11, W[:, 0, 0], W[:, 0, 1], W[:, 1, 1]])
    return np.hstack([np.full((7, 1), np.nan), table])
