"""Lagrange interpolation model: corrections at orientation fixes, cubic between them [K 4.34-4.41]."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, Self

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
from .piecewise_weights import (
    BEFORE,
    constant_names,
    constants_stated,
    describe_constants,
    given_before,
    left_between_values,
    pieces,
    slow_errors_stated,
    wander_sigma,
    with_constants,
)
from .slow_errors import SlowErrors
from .wander import GLOBALS

Array = NDArray[np.floating]

#: Fewest fixes: the interpolation is over four.
FEWEST_FIXES = 4


@dataclass(frozen=True)
class LimOptions(ModelOptions):
    """Settings of the Lagrange interpolation model.

    Attributes
    ----------
    fixes : per correction set, 4 at least; fewer remain where too few rays lie between two of them; 0, where the slow
        errors are known: as close as their correlation time asks for
    merge : whether fixes are merged at all
    offset_sigma_m, shift_sigma_deg : of the zero observations of every fix
    slow : the slow errors, where they are known as a process (see `piecewise_weights`): instead of zero observations
    """

    name: ClassVar[str] = "lim"
    fixes: int = 8
    merge: bool = True
    offset_sigma_m: tuple[float, float, float] = (0.2, 0.2, 0.2)
    shift_sigma_deg: tuple[float, float, float] = (0.01, 0.01, 0.02)
    slow: SlowErrors | None = None

    def __post_init__(self) -> None:
        if self.fixes < FEWEST_FIXES and not (self.fixes == 0 and self.slow is not None):
            raise ValueError(f"fixes: wanted {FEWEST_FIXES} or more, got {self.fixes}")

    @classmethod
    def from_settings(cls, settings: Mapping[str, object]) -> Self:
        slow = slow_errors_stated(settings)
        return cls(
            int(str(settings.get("fixes", cls.fixes if slow is None else 0))),
            bool(settings.get("merge", cls.merge and slow is None)),
            three(settings, "offset_sigma_m", cls.offset_sigma_m),
            three(settings, "shift_sigma_deg", cls.shift_sigma_deg),
            slow,
        )

    def build(self, extent: Extent) -> LagrangeInterpolation:
        return LagrangeInterpolation(extent, self)


class LagrangeInterpolation(CorrectionModel):
    """Six corrections at each fix; at a time the cubic through the two fixes before and the two after.

    Column ``6 f + c``: component c of fix f; where the slow errors are known as a process, after nine columns of
    offset, shift and drift of the strip.

    Attributes
    ----------
    fixes : (n,) times, seconds
    """

    def __init__(self, extent: Extent, options: LimOptions):
        self.extent = extent
        self.options = options
        number = options.fixes
        if options.slow is not None and not number:
            number = max(pieces(extent, options.slow) + 1, FEWEST_FIXES)
        fixes = np.linspace(extent.start_s, extent.end_s, number)
        if options.merge:
            self.fixes = merge_fixes(fixes, extent.ray_time_s, extent.self_calibration)
        else:
            self.fixes = fixes
        gone = number - len(self.fixes)
        if gone:
            self.notes = (f"{extent.name}: {gone} of {number} fixes merged, too few rays between them",)
        names = [
            f"{component} at fix {f + 1} of {extent.name}" for f in range(len(self.fixes)) for component in COMPONENTS
        ]
        self.unknown_names = (*(constant_names(extent) if options.slow else ()), *names)

    def design(self, time_s: ArrayLike) -> Design:
        t = np.asarray(time_s, dtype=float)
        around, coefficients = self._between(t)
        columns = (6 * around[:, :, None] + np.arange(6)).astype(np.int32)
        if self.options.slow is not None:
            share = (t - self.extent.start_s) / (self.extent.end_s - self.extent.start_s)
            columns, coefficients = with_constants(columns, coefficients, share)
        return Design(columns, coefficients)

    def _between(self, t: Array) -> tuple[NDArray[np.int64], Array]:
        """The four fixes (n, 4) of times, and their factors (n, 4)."""
        first = np.clip(np.searchsorted(self.fixes, t, side="right") - 2, 0, len(self.fixes) - 4)
        around = first[:, None] + np.arange(4)
        at = self.fixes[around]
        coefficients = np.ones((len(t), 4))
        for j in range(4):  # Lagrange basis [K 4.34]
            for m in range(4):
                if m != j:
                    coefficients[:, j] *= (t - at[:, m]) / (at[:, j] - at[:, m])
        return around, coefficients

    def left_out_variance(self, time_s: ArrayLike) -> Array:
        t = np.asarray(time_s, dtype=float)
        if self.options.slow is None:
            return super().left_out_variance(t)
        around, coefficients = self._between(t)
        left = left_between_values(self.options.slow.wander_time_s, t, self.fixes[around], coefficients)
        return left[:, None] * wander_sigma(self.options.slow) ** 2

    def pseudo_observations(self) -> PseudoObservations:
        if self.options.slow is not None:
            return join_observations(
                [constants_stated(self.extent, self.options.slow), self._values(self.options.slow)]
            )
        of_fix = np.concatenate([self.options.offset_sigma_m, np.radians(self.options.shift_sigma_deg)])
        return direct_observations(np.tile(of_fix, len(self.fixes)), self.unknown_names)

    def _values(self, slow: SlowErrors) -> PseudoObservations:
        """Every value observed as what those before it say of it, with the variance of what is new."""
        weights, variance = given_before(slow.wander_time_s, self.fixes)
        fix, component = (a.ravel() for a in np.indices((len(self.fixes), 6)))
        back = np.arange(-BEFORE, 1)
        columns = GLOBALS + 6 * (fix[:, None] + back) + component[:, None]
        columns = np.where(fix[:, None] + back >= 0, columns, -1)
        coefficients = np.column_stack([-weights, np.ones(len(weights))])[fix]
        return PseudoObservations(
            columns.astype(np.int32),
            coefficients,
            np.zeros(len(fix)),
            wander_sigma(slow)[component] * np.sqrt(variance[fix]),
            tuple(
                f"wander of {COMPONENTS[c]} at fix {f + 1} of {self.extent.name}"
                for f, c in zip(fix, component, strict=True)
            ),
        )

    def describe(self, theta: ArrayLike, sigma: ArrayLike) -> dict[str, object]:
        theta, sigma = np.asarray(theta, dtype=float), np.asarray(sigma, dtype=float)
        result = describe_constants(theta, sigma) if self.options.slow is not None else {}
        first = GLOBALS if self.options.slow is not None else 0
        value, spread = np.reshape(theta[first:], (-1, 6)), np.reshape(sigma[first:], (-1, 6))
        fixes = [
            {
                "time_s": float(t),
                "offset_m": v[:3].tolist(),
                "offset_m_sigma": s[:3].tolist(),
                "shift_deg": np.degrees(v[3:]).tolist(),
                "shift_deg_sigma": np.degrees(s[3:]).tolist(),
            }
            for t, v, s in zip(self.fixes, value, spread, strict=True)
        ]
        return result | {"fixes": fixes}


def fewest_rays(fixes: int, self_calibration: bool) -> int:
    """Rays that must lie between two neighbouring fixes of a strip [K 4.2.1.3]."""
    if not self_calibration:
        return 9 if fixes <= 7 else 8
    if fixes <= 4:
        return 15
    return 12 if fixes <= 6 else (10 if fixes == 7 else 9)


def merge_fixes(fixes: Array, ray_time_s: Array, self_calibration: bool) -> Array:
    """Remove fixes until every interval has its rays, or four fixes are left.

    The interval with the fewest rays joins the emptier of its neighbours; the first and last fix stay.
    """
    count = np.histogram(ray_time_s, fixes)[0].tolist()
    times = fixes.tolist()
    while len(times) > FEWEST_FIXES and min(count) < fewest_rays(len(times), self_calibration):
        k = int(np.argmin(count))
        inner = k if k > 0 and (k == len(count) - 1 or count[k - 1] <= count[k + 1]) else k + 1
        count[inner - 1 : inner + 1] = [count[inner - 1] + count[inner]]
        del times[inner]
    return np.array(times)
