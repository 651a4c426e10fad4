"""Settings of a trajectory model that differ from strip to strip: recordings of several days or aircraft, and strips
that began before a filter had found its attitude."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Self

from ..models.base import CorrectionModel, Extent, ModelOptions
from ..models.slow_errors import SlowErrors


@dataclass(frozen=True)
class OptionsByStrip(ModelOptions):
    """One model with settings of its own for each strip.

    Attributes
    ----------
    options : by the name of the strip
    """

    options: Mapping[str, ModelOptions]

    @property
    def name(self) -> str:  # pyrefly: ignore[bad-override]  # of one class, not of all
        """How the command line calls the model."""
        return next(iter(self.options.values())).name

    @property
    def slow(self) -> SlowErrors | None:
        """Slow errors of the first strip that states some; None where none does."""
        stated = (getattr(own, "slow", None) for own in self.options.values())
        return next((slow for slow in stated if slow is not None), None)

    @classmethod
    def from_settings(cls, settings: Mapping[str, object]) -> Self:
        raise TypeError("settings of strips come from their recordings")

    def build(self, extent: Extent) -> CorrectionModel:
        return self.options[extent.strip].build(extent)


def options_of_strip(model: ModelOptions, strip: str) -> ModelOptions:
    """Settings of a model for a strip."""
    return model.options[strip] if isinstance(model, OptionsByStrip) else model


def slow_errors_of_strip(model: ModelOptions, strip: str) -> SlowErrors | None:
    """Slow errors that a model states for a strip."""
    return getattr(options_of_strip(model, strip), "slow", None)
