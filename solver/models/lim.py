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
    three,
)

Array = NDArray[np.floating]

#: Fewest fixes: the interpolation is over four.
FEWEST_FIXES = 4


@dataclass(frozen=True)
class LimOptions(ModelOptions):
    """Settings of the Lagrange interpolation model.

    Attributes
    ----------
    fixes : per correction set, 4 at least; fewer remain where too few rays lie between two of them
    merge : whether fixes are merged at all
    offset_sigma_m, shift_sigma_deg : of the zero observations of every fix
    """

    name: ClassVar[str] = "lim"
    fixes: int = 8
    merge: bool = True
    offset_sigma_m: tuple[float, float, float] = (0.2, 0.2, 0.2)
    shift_sigma_deg: tuple[float, float, float] = (0.01, 0.01, 0.02)

    def __post_init__(self) -> None:
        if self.fixes < FEWEST_FIXES:
            raise ValueError(f"fixes: wanted {FEWEST_FIXES} or more, got {self.fixes}")

    @classmethod
    def from_settings(cls, settings: Mapping[str, object]) -> Self:
        return cls(
            int(str(settings.get("fixes", cls.fixes))),
            bool(settings.get("merge", cls.merge)),
            three(settings, "offset_sigma_m", cls.offset_sigma_m),
            three(settings, "shift_sigma_deg", cls.shift_sigma_deg),
        )

    def build(self, extent: Extent) -> LagrangeInterpolation:
        return LagrangeInterpolation(extent, self)


class LagrangeInterpolation(CorrectionModel):
    """Six corrections at each fix; at a time the cubic through the two fixes before and the two after.

    Column ``6 f + c``: component c of fix f.

    Attributes
    ----------
    fixes : (n,) times, seconds
    """

    def __init__(self, extent: Extent, options: LimOptions):
        self.extent = extent
        self.options = options
        fixes = np.linspace(extent.start_s, extent.end_s, options.fixes)
        if options.merge:
            self.fixes = merge_fixes(fixes, extent.ray_time_s, extent.self_calibration)
        else:
            self.fixes = fixes
        gone = options.fixes - len(self.fixes)
        if gone:
            self.notes = (f"{extent.name}: {gone} of {options.fixes} fixes merged, too few rays between them",)
        self.unknown_names = tuple(
            f"{component} at fix {f + 1} of {extent.name}" for f in range(len(self.fixes)) for component in COMPONENTS
        )

    def design(self, time_s: ArrayLike) -> Design:
        t = np.asarray(time_s, dtype=float)
        first = np.clip(np.searchsorted(self.fixes, t, side="right") - 2, 0, len(self.fixes) - 4)
        around = first[:, None] + np.arange(4)
        at = self.fixes[around]
        coefficients = np.ones((len(t), 4))
        for j in range(4):  # Lagrange basis [K 4.34]
            for m in range(4):
                if m != j:
                    coefficients[:, j] *= (t - at[:, m]) / (at[:, j] - at[:, m])
        columns = 6 * around[:, :, None] + np.arange(6)
        return Design(columns.astype(np.int32), coefficients)

    def pseudo_observations(self) -> PseudoObservations:
        of_fix = np.concatenate([self.options.offset_sigma_m, np.radians(self.options.shift_sigma_deg)])
        return direct_observations(np.tile(of_fix, len(self.fixes)), self.unknown_names)

    def describe(self, theta: ArrayLike, sigma: ArrayLike) -> dict[str, object]:
        value, spread = np.reshape(theta, (-1, 6)), np.reshape(sigma, (-1, 6))
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
        return {"fixes": fixes}


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
