"""Values as JSON has them: for every file and answer that a program reads."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import numpy as np


def plain(value: Any) -> Any:
    """The same with Python numbers, lists and words as keys; NaN and infinity, not known to JSON, become None."""
    if isinstance(value, Mapping):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(v) for v in value]
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, (bool, np.bool_)):
        return bool(value)
    if isinstance(value, np.integer):
        return int(value)
    if isinstance(value, (float, np.floating)):
        return float(value) if np.isfinite(value) else None
    return value


def json_text(value: Any, indent: int | None = 2) -> str:
    """A value as the text of a JSON document, that any reader of JSON takes."""
    return json.dumps(plain(value), indent=indent, allow_nan=False)
