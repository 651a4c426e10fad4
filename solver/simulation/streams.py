"""Independent random streams from one seed."""

from __future__ import annotations

import numpy as np

#: Sources of chance. A source's place in the list is part of what a seed means: new ones are added at the end.
STREAMS = (
    "motion",
    "terrain",
    "attitude noise",
    "attitude slow",
    "gnss noise",
    "gnss slow",
    "points",
    "control",
    "image noise",
    "outliers",
    "imu",
    "texture",
    "illumination",
    "sensor noise",
    "camera",
    "random walk",
    "sine",
)


def stream(seed: int, name: str) -> np.random.Generator:
    """The generator of one source of chance; independent of all others of the same seed.

    Raises
    ------
    ValueError : a negative seed, a name that is not in `STREAMS`
    """
    if seed < 0:
        raise ValueError(f"seed must not be negative, got {seed}")
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(STREAMS.index(name),)))
