"""Image lines that are not fit for matching, and why."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

#: A line is dark if nine tenths of it lie below this share of full scale, saturated if nine tenths lie above;
#: if a third does, it is told of, but what is left of it is used.
DARK, SATURATED = 0.02, 0.995
#: Largest grey values of cameras of 12, 14 and 16 bits, whose pixels all come as 16 bits (definition).
FULL_SCALES = (4095, 16_383, 65_535)
#: A camera has more bits if more than this share of its pixels is above; a few may be faults of the transmission.
ABOVE = 0.01
#: Places in `REASONS` (definition).
GOOD, IS_DARK, IS_SATURATED, IS_FROZEN, IS_PARTLY_SATURATED = 0, 1, 2, 3, 4
REASONS = ("good", "dark", "saturated", "frozen", "partly saturated")
#: So many samples of a line are looked at. Tuned, for speed.
SAMPLES = 512


def full_scale_of(pixels: NDArray[np.unsignedinteger], so_far: int = 0) -> int:
    """Largest grey value of a camera that nobody states: the least of `FULL_SCALES` that its pixels keep within.

    Parameters
    ----------
    pixels : (n, samples) lines that have come now
    so_far : what it was taken for by those before; 0 for the first ones
    """
    if pixels.dtype == np.uint8:
        return 255
    some = pixels[:, :: max(pixels.shape[1] // SAMPLES, 1)]
    full_scale = max(so_far, FULL_SCALES[0])
    while full_scale < FULL_SCALES[-1] and (some > full_scale).mean() > ABOVE:
        full_scale = next(scale for scale in FULL_SCALES if scale > full_scale)
    return full_scale


def judge_lines(
    pixels: NDArray[np.unsignedinteger],
    before: NDArray[np.unsignedinteger] | None,
    full_scale: int,
    dark_scale: int | None = None,
) -> NDArray[np.int8]:
    """Place in `REASONS` of each line (n,).

    A line that repeats the one before it grey value by grey value comes from a frozen CCD: noise never repeats.

    Parameters
    ----------
    pixels : (n, samples)
    before : (samples,) the line before the first one, if there is one
    full_scale : largest grey value
    dark_scale : the same for lines that are dark, where another one counts for them; None = as ``full_scale``
    """
    step = max(pixels.shape[1] // SAMPLES, 1)
    some = pixels[:, ::step]
    previous = some[:1] if before is None else before[None, ::step]
    same = (some == np.concatenate([previous, some[:-1]])).all(axis=1)
    if before is None and len(same):
        same[0] = False
    out = np.full(len(some), GOOD, dtype=np.int8)
    out[same] = IS_FROZEN
    saturated = (some >= SATURATED * full_scale).mean(axis=1)
    out[(saturated > 1 / 3) & ~same] = IS_PARTLY_SATURATED
    out[saturated > 0.9] = IS_SATURATED
    out[(some < DARK * (full_scale if dark_scale is None else dark_scale)).mean(axis=1) > 0.9] = IS_DARK
    return out
