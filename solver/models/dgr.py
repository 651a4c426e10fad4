"""Direct georeferencing model: constant shift of six, drift of three attitude corrections [K 4.8-4.10, 4.12]."""

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


@dataclass(frozen=True)
class DgrOptions(ModelOptions):
    """A-priori sigmas of the nine unknowns; the drift is the change over the whole strip.

    ``wander_sigma_m``, ``wander_sigma_deg`` are of what the nine cannot follow, if that is known: it is then in the
    weights of the rays and in the covariance of the orientation, though as if it were another at every time.
    """

    name: ClassVar[str] = "dgr"
    offset_sigma_m: tuple[float, float, float] = (0.2, 0.2, 0.2)
    shift_sigma_deg: tuple[float, float, float] = (0.01, 0.01, 0.02)
    drift_sigma_deg: tuple[float, float, float] = (0.01, 0.01, 0.02)
    wander_sigma_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    wander_sigma_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @classmethod
    def from_settings(cls, settings: Mapping[str, object]) -> Self:
        return cls(
            three(settings, "offset_sigma_m", cls.offset_sigma_m),
            three(settings, "shift_sigma_deg", cls.shift_sigma_deg),
            three(settings, "drift_sigma_deg", cls.drift_sigma_deg),
        )

    def build(self, extent: Extent) -> DirectGeoreferencing:
        return DirectGeoreferencing(extent, self)


class DirectGeoreferencing(CorrectionModel):
    """``dX = X_off``, ``d_omega = omega_0 + omega_1 s`` and so on; ``s`` is the share of the trajectory gone."""

    notes = ("drift is the change over the trajectory of the strip: s = (t - start) / (end - start)",)

    def __init__(self, extent: Extent, options: DgrOptions):
        self.extent = extent
        self.options = options
        kinds = ["offset"] * 3 + ["shift"] * 3 + ["drift"] * 3
        self.unknown_names = tuple(
            f"{component} {kind} of {extent.name}"
            for component, kind in zip(COMPONENTS + COMPONENTS[3:], kinds, strict=True)
        )
        self._columns = np.array([[0, 1, 2, 3, 4, 5], [-1, -1, -1, 6, 7, 8]], dtype=np.int32)

    def design(self, time_s: ArrayLike) -> Design:
        t = np.asarray(time_s, dtype=float)
        share = (t - self.extent.start_s) / (self.extent.end_s - self.extent.start_s)
        columns = np.broadcast_to(self._columns, (len(t), 2, 6))
        coefficients = np.ones((len(t), 2))
        coefficients[:, 1] = share
        return Design(columns, coefficients)

    def left_out_variance(self, time_s: ArrayLike) -> NDArray[np.floating]:
        sigma = np.concatenate([self.options.wander_sigma_m, np.radians(self.options.wander_sigma_deg)])
        return np.tile(sigma**2, (np.size(time_s), 1))

    def pseudo_observations(self) -> PseudoObservations:
        o = self.options
        sigma = np.concatenate([o.offset_sigma_m, np.radians(o.shift_sigma_deg), np.radians(o.drift_sigma_deg)])
        return direct_observations(sigma, self.unknown_names)

    def describe(self, theta: ArrayLike, sigma: ArrayLike) -> dict[str, object]:
        result: dict[str, object] = {}
        for key, part, to_unit in (("offset_m", 0, 1.0), ("shift_deg", 3, 180 / np.pi), ("drift_deg", 6, 180 / np.pi)):
            for suffix, values in (("", theta), ("_sigma", sigma)):
                result[key + suffix] = (np.asarray(values, dtype=float)[part : part + 3] * to_unit).tolist()
        result["s"] = "share of the trajectory of the strip"
        return result
