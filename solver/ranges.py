"""Checks of options: which of them must be above zero, and which must not be below it."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np


def check_ranges(options: Any, above: Iterable[str] = (), not_below: Iterable[str] = (), what: str = "") -> None:
    """Check fields of options; ``what`` they are is said before the name of a wrong one.

    Parameters
    ----------
    above : fields that must be finite and more than 0
    not_below : fields that must be finite and 0 or more

    Raises
    ------
    ValueError : a field that is not
    """
    title = f"{what}: " if what else ""
    for name in above:
        if not 0 < getattr(options, name) < np.inf:
            raise ValueError(f"{title}{name}: wanted more than 0, got {getattr(options, name)}")
    for name in not_below:
        if not 0 <= getattr(options, name) < np.inf:
            raise ValueError(f"{title}{name}: wanted 0 or more, got {getattr(options, name)}")
