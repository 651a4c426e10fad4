"""Piecewise polynomial model: second-order corrections per segment, tied together at the borders [K 4.22-4.33], [P]."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

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
from .gauss_markov import damping_rate, second_order_gauss_markov
from .piecewise_weights import (
    constant_names,
    constants_stated,
    describe_constants,
    left_beside_quadratic,
    pieces,
    slow_errors_stated,
    wander_sigma,
    with_constants,
)
from .slow_errors import SlowErrors
from .wander import GLOBALS

Array = NDArray[np.floating]
Triple = tuple[float, float, float]

#: A ray to a control point counts as so many when segments are placed by the data.
CONTROL_COUNTS = 3

#: How well the pieces meet where the slow errors are known, share of the wander's sigma.
MEETS = 1e-4

_ORDERS = ("value", "first order term", "second order term")


@dataclass(frozen=True)
class PpmOptions(ModelOptions):
    """Settings of the piecewise polynomial model.

    Attributes
    ----------
    segments : per correction set; 0, where the slow errors are known: as short as their correlation time asks for
    placed : "equal" in time, or "data": equal numbers of rays, those to control points counting more
    order : 2, or 1 to fix the second-order terms by their weight
    continuity : highest derivative that is continuous at borders: 0, 1 or 2
    offset_sigma_m, shift_sigma_deg : of the constant terms
    first_sigma_m, first_sigma_deg : of the first-order terms: change over a segment
    second_sigma_m, second_sigma_deg : of the second-order terms
    continuity_sigma_m, continuity_sigma_deg : of C0; per second of C1; per second squared of C2
    slow : the slow errors, where they are known as a process (see `piecewise_weights`): C0 then holds, and how value
        and slope go on from border to border has the weight that the process gives it, instead of all these sigmas
    """

    name: ClassVar[str] = "ppm"
    segments: int = 4
    placed: str = "equal"
    order: int = 2
    continuity: int = 1
    offset_sigma_m: Triple = (0.2, 0.2, 0.2)
    shift_sigma_deg: Triple = (0.01, 0.01, 0.02)
    first_sigma_m: Triple = (0.1, 0.1, 0.1)
    first_sigma_deg: Triple = (0.01, 0.01, 0.02)
    second_sigma_m: Triple = (0.1, 0.1, 0.1)
    second_sigma_deg: Triple = (0.01, 0.01, 0.02)
    continuity_sigma_m: Triple = (0.01, 0.01, 0.01)
    continuity_sigma_deg: Triple = (0.0005, 0.0005, 0.0005)
    slow: SlowErrors | None = None

    def __post_init__(self) -> None:
        if self.segments < 1 and not (self.segments == 0 and self.slow is not None):
            raise ValueError(f"segments: wanted 1 or more, got {self.segments}")
        if self.placed not in ("equal", "data"):
            raise ValueError(f"segments are placed 'equal' or by 'data', not {self.placed!r}")
        if self.order not in (1, 2):
            raise ValueError(f"order: wanted 1 or 2, got {self.order}")
        if self.continuity not in (0, 1, 2):
            raise ValueError(f"continuity: wanted 0, 1 or 2, got {self.continuity}")

    @classmethod
    def from_settings(cls, settings: Mapping[str, object]) -> Self:
        triples: dict[str, Any] = {
            key: three(settings, key, getattr(cls, key))
            for key in cls.__dataclass_fields__
            if key.endswith(("_m", "_deg"))
        }
        own = any(key.startswith(("first_", "second_", "continuity_")) for key in settings)
        slow = None if own else slow_errors_stated(settings)
        options = cls(
            int(str(settings.get("segments", cls.segments if slow is None else 0))),
            str(settings.get("placed", cls.placed)),
            int(str(settings.get("order", cls.order))),
            int(str(settings.get("continuity", cls.continuity))),
            slow=slow,
        )
        return replace(options, **triples)

    def build(self, extent: Extent) -> PiecewisePolynomial:
        return PiecewisePolynomial(extent, self)


class PiecewisePolynomial(CorrectionModel):
    """Segment k: ``a0 + a1 s + a2 s^2`` for each of six corrections, s from 0 to 1 in the segment.

    Column ``18 k + 6 j + c``: coefficient ``a_j`` of component c of segment k; where the slow errors are known as a
    process, after nine columns of offset, shift and drift of the strip.

    Attributes
    ----------
    borders : (segments + 1,) times, seconds
    """

    def __init__(self, extent: Extent, options: PpmOptions):
        self.extent = extent
        self.options = options
        if options.slow is not None and not options.segments:
            options = replace(options, segments=pieces(extent, options.slow))
        self.borders = _borders(extent, options)
        names = [
            f"{component} {order} of segment {k + 1} of {extent.name}"
            for k in range(self.segments)
            for order in _ORDERS
            for component in COMPONENTS
        ]
        self.unknown_names = (*(constant_names(extent) if options.slow else ()), *names)
        self.notes = ("s = 0 at the start, 1 at the end of each segment", *_not_used(options))

    @property
    def segments(self) -> int:
        return len(self.borders) - 1

    def design(self, time_s: ArrayLike) -> Design:
        t = np.asarray(time_s, dtype=float)
        k = self._segment(t)
        s = (t - self.borders[k]) / np.diff(self.borders)[k]
        columns = ((18 * k)[:, None, None] + np.arange(18).reshape(3, 6)).astype(np.int32)
        coefficients = np.stack([np.ones_like(s), s, s * s], axis=1)
        if self.options.slow is not None:
            share = (t - self.extent.start_s) / (self.extent.end_s - self.extent.start_s)
            columns, coefficients = with_constants(columns, coefficients, share)
        return Design(columns, coefficients)

    def _segment(self, t: Array) -> NDArray[np.int64]:
        return np.clip(np.searchsorted(self.borders, t, side="right") - 1, 0, self.segments - 1)

    def left_out_variance(self, time_s: ArrayLike) -> Array:
        t = np.asarray(time_s, dtype=float)
        slow = self.options.slow
        if slow is None:
            return super().left_out_variance(t)
        k = self._segment(t)
        length = np.diff(self.borders)[k]
        after = np.clip(t - self.borders[k], 0.0, length)
        return left_beside_quadratic(slow.wander_time_s, after, length)[:, None] * wander_sigma(slow) ** 2

    def pseudo_observations(self) -> PseudoObservations:
        o = self.options
        if o.slow is not None:
            return join_observations([constants_stated(self.extent, o.slow), *self._process(o.slow)])
        second = np.concatenate([o.second_sigma_m, np.radians(o.second_sigma_deg)])
        if o.order == 1:
            second = second * 1e-6
        of_segment = [*o.offset_sigma_m, *np.radians(o.shift_sigma_deg)]
        of_segment += [*o.first_sigma_m, *np.radians(o.first_sigma_deg), *second]
        parts = [direct_observations(np.tile(of_segment, self.segments), self.unknown_names)]
        if self.segments > 1:
            parts += [self._continuity(derivative) for derivative in range(o.continuity + 1)]
        return join_observations(parts)

    def _process(self, slow: SlowErrors) -> list[PseudoObservations]:
        """The wander from border to border: the start of the first segment; the end of each, given its start; the start
        of the next, which is the same value, and a slope given all before."""
        length = np.diff(self.borders)
        F, Q, _ = second_order_gauss_markov(1.0, slow.wander_time_s, length)
        sigma = wander_sigma(slow)

        def rows(what: str, of: NDArray[np.int64], terms: list[Array], size: Array) -> PseudoObservations:
            """One row a component of segments ``of`` (m,); terms (m,) of a0, a1, a2, then of the next segment."""
            segment, component = np.repeat(of, 6), np.tile(np.arange(6), len(of))
            columns = GLOBALS + 18 * segment[:, None] + 6 * np.arange(len(terms)) + component[:, None]
            coefficients = np.repeat(np.column_stack(terms), 6, axis=0)
            labels = tuple(
                f"{what} of wander of {COMPONENTS[c]}, segment {k + 1} of {self.extent.name}"
                for k, c in zip(segment, component, strict=True)
            )
            columns = np.where(coefficients != 0.0, columns, -1).astype(np.int32)
            return PseudoObservations(
                columns, coefficients, np.zeros(len(columns)), np.repeat(size, 6) * sigma[component], labels
            )

        first, every, inner = np.array([0]), np.arange(self.segments), np.arange(self.segments - 1)
        one, zero = np.ones(self.segments), np.zeros(self.segments)
        slope_sigma = np.array([damping_rate(slow.wander_time_s)])
        value, slope = F[:, 0], F[:, 1]
        gain = Q[:, 0, 1] / Q[:, 0, 0]  # of the slope, when the value at the end is known
        end = [1.0 - value[:, 0], 1.0 - value[:, 1] / length, one]
        goes_on = [-slope[:, 0] - gain * end[0], -slope[:, 1] / length - gain * end[1], -gain]
        parts = [
            rows("start", first, [one[:1]], one[:1]),
            rows("first slope", first, [zero[:1], 1.0 / length[:1]], slope_sigma),
            rows("end", every, end, np.sqrt(Q[:, 0, 0])),
        ]
        if len(inner):
            end_slope = np.sqrt(Q[:, 1, 1] - gain * Q[:, 0, 1])[:-1]
            meet, slopes = [one, one, one, -one], [*goes_on, zero, np.append(1.0 / length[1:], 0.0)]
            parts.append(rows("C0", inner, [c[:-1] for c in meet], MEETS * one[:-1]))
            parts.append(rows("slope", inner, [c[:-1] for c in slopes], end_slope))
        return parts

    def _continuity(self, derivative: int) -> PseudoObservations:
        """Equal derivatives on both sides of every inner border: 6 observations a border [K 4.24, 4.25]."""
        length = np.diff(self.borders)
        left, right = length[:-1] ** -derivative, length[1:] ** -derivative
        at_end = ((1.0, 1.0, 1.0), (0.0, 1.0, 2.0), (0.0, 0.0, 2.0))[derivative]
        at_start = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 2.0))[derivative]
        border, component = (a.ravel() for a in np.indices((self.segments - 1, 6)))
        terms = np.arange(3)
        of_left = 18 * border[:, None] + 6 * terms + component[:, None]
        columns = np.concatenate([of_left, of_left + 18], axis=1)
        coefficients = np.concatenate([np.outer(left[border], at_end), -np.outer(right[border], at_start)], axis=1)
        columns = np.where(coefficients != 0.0, columns, -1)
        o = self.options
        sigma = np.concatenate([o.continuity_sigma_m, np.radians(o.continuity_sigma_deg)])[component]
        labels = tuple(
            f"C{derivative} of {COMPONENTS[c]} at border {b + 1} of {self.extent.name}"
            for b, c in zip(border, component, strict=True)
        )
        return PseudoObservations(columns.astype(np.int32), coefficients, np.zeros(len(border)), sigma, labels)

    def describe(self, theta: ArrayLike, sigma: ArrayLike) -> dict[str, object]:
        theta, sigma = np.asarray(theta, dtype=float), np.asarray(sigma, dtype=float)
        result = describe_constants(theta, sigma) if self.options.slow is not None else {}
        first, shape = (GLOBALS if self.options.slow is not None else 0), (self.segments, 3, 6)
        values = {"": np.reshape(theta[first:], shape), "_sigma": np.reshape(sigma[first:], shape)}
        segments: list[dict[str, object]] = []
        for k in range(self.segments):
            one: dict[str, object] = {"start_s": float(self.borders[k]), "end_s": float(self.borders[k + 1])}
            for j, name in enumerate(("value", "first", "second")):
                for suffix, array in values.items():
                    one[f"{name}_m{suffix}"] = array[k, j, :3].tolist()
                    one[f"{name}_deg{suffix}"] = np.degrees(array[k, j, 3:]).tolist()
            segments.append(one)
        return result | {"segments": segments}


def _not_used(options: PpmOptions) -> list[str]:
    """Notes on settings that have no part in weights which follow from the slow errors."""
    if options.slow is None:
        return []
    given = {"order": (options.order, PpmOptions.order), "continuity": (options.continuity, PpmOptions.continuity)}
    return [
        f"{name} {value} was not used: a wander is stated, from which follow second-order terms and how pieces go on"
        for name, (value, usual) in given.items()
        if value != usual
    ]


def _borders(extent: Extent, options: PpmOptions) -> Array:
    """Borders of segments, equal or by the data; at least a tenth of the equal length apart."""
    equal = np.linspace(extent.start_s, extent.end_s, options.segments + 1)
    if options.placed == "equal" or len(extent.ray_time_s) < options.segments:
        return equal
    times = np.concatenate([extent.ray_time_s] + [extent.control_time_s] * (CONTROL_COUNTS - 1))
    inner = np.quantile(times, np.arange(1, options.segments) / options.segments)
    least = 0.1 * (equal[1] - equal[0])
    place = np.arange(1, options.segments)
    inner = np.maximum.accumulate(inner - least * place) + least * place
    inner = np.clip(inner, extent.start_s + least * place, extent.end_s - least * place[::-1])
    return np.concatenate([equal[:1], inner, equal[-1:]])
