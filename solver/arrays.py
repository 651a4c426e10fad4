"""Types of arrays, as signatures name them: of numbers, of whole numbers and of truth values."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating]
IntArray = NDArray[np.int64]
Bools = NDArray[np.bool_]
