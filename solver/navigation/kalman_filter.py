"""The Kalman filter of filterpy, without half a second of imports.

With any of its parts filterpy imports `scipy.stats` and `scipy.ndimage`, a third of all the time that `triline process`
needs before it works. It takes four names from them, for likelihoods and discrete filters that nobody asks for here.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Iterable
from functools import cache
from types import ModuleType
from typing import Any

#: What filterpy takes from modules that take long to import.
_TAKEN = {"scipy.stats": ("norm", "multivariate_normal"), "scipy.ndimage": ("convolve", "shift")}


class _WhenUsed:
    """A name of a module that is imported when it is used."""

    def __init__(self, module: str, name: str) -> None:
        self._module, self._name = module, name

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        return self._real()(*args, **kwargs)

    def __getattr__(self, attribute: str) -> Any:
        if isinstance(sys.modules.get(self._module), _StandIn):  # filterpy looks whether SciPy is older than we allow
            return lambda *args, **kwargs: 0.0
        return getattr(self._real(), attribute)

    def _real(self) -> Any:
        return getattr(importlib.import_module(self._module), self._name)


class _StandIn(ModuleType):
    """Stands for a module while filterpy is imported."""

    def __init__(self, module: str, names: Iterable[str]) -> None:
        super().__init__(module)
        vars(self).update((name, _WhenUsed(module, name)) for name in names)


@cache
def kalman_filter() -> type[Any]:
    """The class `filterpy.kalman.KalmanFilter`. No other thread may import these modules of SciPy meanwhile."""
    stand_ins = {module: _StandIn(module, names) for module, names in _TAKEN.items() if module not in sys.modules}
    sys.modules.update(stand_ins)
    try:
        from filterpy.kalman import KalmanFilter
    finally:
        for module in stand_ins:
            del sys.modules[module]
    return KalmanFilter
