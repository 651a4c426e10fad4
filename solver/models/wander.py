"""Wander model: constant, drift, and a wander whose value and slope at borders are the unknowns.

The piecewise model with its weights taken from what the errors are, not from experience: between borders the correction
is the conditional mean of a second-order Gauss-Markov process (for a correlation time long against a segment: the cubic
through both values and slopes, so that C0 and C1 hold exactly), and from border to border its transition is observed
with its own noise. What a segment cannot follow is known too: `left_out_variance`.

The errors of a filter do not stay as large as they were: they grow while GNSS is out and are others after a restart.
From a border on the process can therefore be stated anew (`Wander.restate`): what grows is the old error made larger;
what becomes smaller is another error, since observations have taken the place of the old one.

Source: the process in `wander`; interpolation as in T. D. Barfoot, State Estimation for Robotics, 2017, section 3.4.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..slow_errors import SlowErrors
from ..wander import damping_rate, second_order_gauss_markov
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

Array = NDArray[np.float64]
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
    segment_s : longest time between borders; 0 = `SEGMENT_SHARE` of the correlation time
    left_out_m, left_out : segments may be longer, whole numbers of these, where interpolation then leaves out no more
        than so much of the wander, m and rad
    """

    name: ClassVar[str] = "wander"
    slow: SlowErrors = NO_SLOW_ERRORS
    segment_s: float = 0.0
    left_out_m: float = 0.0
    left_out: float = 0.0

    @classmethod
    def from_settings(cls, settings: Mapping[str, object]) -> Self:
        degree = float(np.pi / 180)

        def angles(key: str, default: float) -> tuple[float, float, float]:
            a, b, c = three(settings, key, (default, default, default))
            return (a * degree, b * degree, c * degree)

        slow = SlowErrors(
            three(settings, "offset_sigma_m", (0.2, 0.2, 0.2)),
            angles("shift_sigma_deg", 0.01),
            angles("drift_sigma_deg", 0.01),
            three(settings, "wander_sigma_m", (0.1, 0.1, 0.1)),
            angles("wander_sigma_deg", 0.005),
            float(str(settings.get("wander_time_s", 30.0))),
        )
        return cls(slow, float(str(settings.get("segment_s", 0.0))))

    def build(self, extent: Extent) -> Wander:
        return Wander(extent, self)


class Wander(CorrectionModel):
    """Columns 0..8: offset, shift, drift; ``9 + 12 k + c`` value, ``15 + 12 k + c`` slope of component c at border k.

    Attributes
    ----------
    borders : (segments + 1,) times, seconds; equally far apart, the last one at the end of the extent or beyond
    used : places of the borders in use, the first and the last one among them; the unknowns of others appear nowhere
    """

    def __init__(self, extent: Extent, options: WanderOptions):
        self.extent = extent
        self.options = options
        slow = options.slow
        self.step_s = options.segment_s or SEGMENT_SHARE * slow.wander_time_s
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
        self._time_s = np.full(segments + 1, slow.wander_time_s)
        self._another = np.zeros(segments + 1, dtype=bool)
        self.used = self._spaced(0, self._sigma[0], slow.wander_time_s)
        self._observations = self._stated()

    def design(self, time_s: ArrayLike) -> Design:
        t = np.asarray(time_s, dtype=float)
        begin, end, after = self._inside(t)
        part = np.empty((len(t), 4))
        for length in _different(end - begin):
            mine = end - begin == length
            part[mine] = self._between(after[mine], self.options.slow.wander_time_s, int(length))[1]
        share = (t - self.extent.start_s) / (self.extent.end_s - self.extent.start_s)
        columns = np.empty((len(t), 6, 6), dtype=np.int32)
        columns[:, 0] = np.arange(6)
        columns[:, 1] = [-1, -1, -1, 6, 7, 8]
        columns[:, 2:4] = (GLOBALS + 12 * begin)[:, None, None] + np.arange(12).reshape(2, 6)
        columns[:, 4:] = (GLOBALS + 12 * end)[:, None, None] + np.arange(12).reshape(2, 6)
        return Design(columns, np.column_stack([np.ones_like(t), share, part]))

    def left_out_variance(self, time_s: ArrayLike) -> Array:
        """Variance (n, 6) of what the wander does between borders beyond the interpolation, m^2 and rad^2."""
        t = np.asarray(time_s, dtype=float)
        begin, end, inside = self._inside(t)
        variance = np.empty(len(t))
        correlated_s, lengths = self._time_s[end], end - begin
        for each in set(correlated_s.tolist()):
            for length in _different(lengths):
                mine = (correlated_s == each) & (lengths == length)
                if mine.any():
                    variance[mine] = self._between(inside[mine], each, int(length))[0]
        before, after = self._sigma[begin], self._sigma[end]
        part = (t - self.borders[begin]) / (self.step_s * lengths)
        size = np.where(self._another[end][:, None], before**2 + after**2, (after - before) ** 2)
        jump = np.clip(part * (1.0 - part), 0.0, 0.25)[:, None] * size  # it can be anywhere between
        return variance[:, None] * np.maximum(before, after) ** 2 + jump

    def restate(self, from_s: float, sigma: ArrayLike, time_s: float, another: bool = False) -> float:
        """Another wander from a border on, the second one after a time, so that the segment there and its borders stay.

        The arrays that `pseudo_observations` gave change for the segments concerned, and so may the borders in use; who
        has used them already for times up to ``from_s`` sees no difference.

        Parameters
        ----------
        from_s : up to here the model has been in use
        sigma : (6,) standard deviations, metres and radians
        time_s : correlation time
        another : it is another error altogether, however large

        Returns
        -------
        border_s : from here on it holds; infinite if the strip ends before
        """
        place = int(np.floor((from_s - self.borders[0]) / self.step_s + 0.1))
        stays = int(np.searchsorted(self.used, place, side="right"))  # of those in use, the last that stays as it is
        if stays >= len(self.used) - 1:
            return np.inf
        sigma = np.maximum(np.asarray(sigma, dtype=float), NOTHING)
        kept = self.used[: stays + 1] if place >= -1 else self.used[:0]
        after = self._spaced(int(kept[-1]) if len(kept) else 0, sigma, time_s)
        self.used = np.concatenate([kept, after[1:] if len(kept) else after])
        first = int(self.used[len(kept)])
        self._sigma[first:] = sigma
        self._time_s[first:] = time_s
        self._another[first] = another
        changed = self._stated()
        self._observations.columns[...] = changed.columns
        self._observations.coefficients[...] = changed.coefficients
        self._observations.sigma[...] = changed.sigma
        return float(self.borders[first])

    def _spaced(self, first: int, sigma: Array, time_s: float) -> IntArray:
        """Borders in use from one to the last, as far apart as a wander (6,) allows."""
        o, last = self.options, len(self.borders) - 1
        length = 1
        for longer in LENGTHS if o.left_out_m > 0.0 or o.left_out > 0.0 else ():
            out = np.sqrt(self._between(np.array([0.5 * longer * self.step_s]), time_s, longer)[0][0])
            if out * sigma[:3].max() <= o.left_out_m and out * sigma[3:].max() <= o.left_out:
                length = longer
        return np.append(np.arange(first, last, length), last)

    def _inside(self, t: Array) -> tuple[IntArray, IntArray, Array]:
        """Places (n,) of the borders in use around times, and the time (n,) since the first of both."""
        place = np.floor((t - self.borders[0]) / self.step_s)
        k = np.clip(np.searchsorted(self.used, place, side="right") - 1, 0, len(self.used) - 2)
        begin, end = self.used[k], self.used[k + 1]
        return begin, end, np.clip(t - self.borders[begin], 0.0, self.step_s * (end - begin))

    def _between(self, after: Array, time_s: float, length: int) -> tuple[Array, Array]:
        """Variance (n,) of what is left out for sigma 1, and coefficients (n, 4), at times after a border."""
        step_s = self.step_s * length
        F, Q, _ = second_order_gauss_markov(1.0, time_s, step_s)
        F0, Q0, _ = second_order_gauss_markov(1.0, time_s, after)
        F1, _, _ = second_order_gauss_markov(1.0, time_s, step_s - after)
        back = Q0 @ np.swapaxes(F1, 1, 2)
        right = back @ np.linalg.inv(Q)
        left = F0 - right @ F
        variance = Q0[:, 0, 0] - np.einsum("nk,nk->n", right[:, 0], back[:, 0])
        return np.maximum(variance, 0.0), np.concatenate([left[:, 0], right[:, 0]], axis=1)

    def pseudo_observations(self) -> PseudoObservations:
        return self._observations

    def _stated(self) -> PseudoObservations:
        slow = self.options.slow
        sigma = np.concatenate([slow.offset_m, slow.shift, slow.drift])
        start = GLOBALS + np.arange(12)
        slope_sigma = self._sigma[0] * damping_rate(float(self._time_s[0]))
        direct = direct_observations(
            np.concatenate([np.maximum(sigma, NOTHING), self._sigma[0], slope_sigma]),
            self.unknown_names[: GLOBALS + 12],
        )
        assert (direct.columns[GLOBALS:, 0] == start).all()
        return join_observations([direct, self._transitions()])

    def _transitions(self) -> PseudoObservations:
        """Two whitened observations ``G (z_k+1 - F D z_k) = 0`` of every component and segment, ``G Q G^T = I``.

        ``D`` makes an error that grows larger. Where sigma falls, the value at the next border is a new one. There are
        as many rows as if all borders were in use; those that end at others carry no weight.
        """
        n = len(self.borders) - 1
        coefficients, sigma = np.zeros((n, 6, 2, 4)), np.full((n, 6), np.inf)
        before = np.arange(n)
        begin, end = self.used[:-1], self.used[1:]
        before[end - 1] = begin
        sigma[end - 1] = self._sigma[end]
        for time_s, length in {*zip(self._time_s[end].tolist(), (end - begin).tolist(), strict=True)}:
            chosen = (self._time_s[end] == time_s) & (end - begin == length)
            a, b = begin[chosen], end[chosen]
            F, Q, P0 = second_order_gauss_markov(1.0, time_s, self.step_s * length)
            G, new = np.linalg.inv(np.linalg.cholesky(Q)), np.linalg.inv(np.linalg.cholesky(P0))
            ratio = self._sigma[b] / self._sigma[a]  # (m, 6)
            rate = np.sqrt(P0[1, 1]) / np.array([damping_rate(float(t)) for t in self._time_s[a]])
            D = np.zeros((*ratio.shape, 2, 2))
            D[..., 0, 0], D[..., 1, 1] = ratio, ratio * rate[:, None]
            falls = ((ratio < 1.0 - 1e-9) | self._another[b][:, None])[..., None, None]
            coefficients[b - 1, :, :, :2] = np.where(falls, 0.0, -G @ F @ D)
            coefficients[b - 1, :, :, 2:] = np.where(falls, new, G)
        segment, component, row = (a.ravel() for a in np.indices((n, 6, 2)))
        from_column = GLOBALS + 12 * before[segment] + component
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


def _different(values: IntArray) -> list[int]:
    """The different ones among whole numbers, in order."""
    return sorted(set(values.tolist()))
