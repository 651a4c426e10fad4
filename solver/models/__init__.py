"""Trajectory models. Every module here that defines `ModelOptions` is found by its name; see `base`."""

from __future__ import annotations

from importlib import import_module
from pkgutil import iter_modules

from .base import COMPONENTS, CorrectionModel, Design, Extent, ModelOptions, PseudoObservations

__all__ = ["COMPONENTS", "MODELS", "CorrectionModel", "Design", "Extent", "ModelOptions", "PseudoObservations",
           "setting_names"]  # fmt: skip

#: Sigmas of the wander that a project may state; zeros say that there is none.
WANDER_SIGMAS = ("wander_sigma_m", "wander_sigma_deg")
#: Correlation times of the wander that a project may state.
WANDER_TIMES = ("wander_time_s", "attitude_wander_time_s")


#: Options class of each model, by the name the command line uses; found when it is first asked for, since all models
#: take a tenth of a second to import.
MODELS: dict[str, type[ModelOptions]]


def _find() -> dict[str, type[ModelOptions]]:
    for module in iter_modules(__path__):
        import_module(f"{__name__}.{module.name}")
    ours = [options for options in ModelOptions.__subclasses__() if options.__module__.startswith(f"{__name__}.")]
    return {options.name: options for options in sorted(ours, key=lambda o: o.name)}


def setting_names() -> frozenset[str]:
    """Keys of the settings that the models know, of all of them."""
    own = {name for options in __getattr__("MODELS").values() for name in vars(options)["__dataclass_fields__"]}
    own -= {"slow", "left_out_m", "left_out"}  # made of the others
    return frozenset(own | {"drift_sigma_deg", *WANDER_SIGMAS, *WANDER_TIMES})


def __getattr__(name: str) -> dict[str, type[ModelOptions]]:
    if name != "MODELS":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    globals()["MODELS"] = found = _find()
    return found
