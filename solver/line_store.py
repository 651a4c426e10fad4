"""The newest image lines of every CCD line, in rings that together stay within a budget of bytes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Stretch:
    """Lines out of a ring.

    Attributes
    ----------
    first_line : number of the first one
    pixels : (n, samples) grey values, 0 where nothing usable is known
    usable : (n,) whether a line came and is fit for use
    """

    first_line: int
    pixels: NDArray[np.unsignedinteger]
    usable: NDArray[np.bool_]


class LineRing:
    """The newest ``capacity`` lines of one CCD line.

    Lines that never came are known as missing; lines that come twice or out of order are left out.
    """

    def __init__(self, samples: int, capacity: int, dtype: np.dtype | type = np.uint16):
        if samples < 1 or capacity < 1:
            raise ValueError(f"a ring of {capacity} lines of {samples} samples, wanted at least one of each")
        self._pixels = np.zeros((capacity, samples), dtype=dtype)
        self._usable = np.zeros(capacity, dtype=bool)
        self.start = self.end = 0  # lines from start to end - 1 are in the ring

    @property
    def capacity(self) -> int:
        return len(self._pixels)

    @property
    def nbytes(self) -> int:
        return self._pixels.nbytes + self._usable.nbytes

    def clear(self) -> None:
        """Forget all lines; the next may have any number."""
        self.start = self.end = 0
        self._usable[:] = False

    def add(
        self, first_line: int, pixels: NDArray[np.unsignedinteger], usable: NDArray[np.bool_] | None = None
    ) -> tuple[int, int]:
        """Add lines; returns how many were missing before them, and how many of them came too late.

        Raises
        ------
        ValueError : lines of another length
        """
        if pixels.ndim != 2 or pixels.shape[1] != self._pixels.shape[1]:
            raise ValueError(f"lines of shape {pixels.shape}, wanted {self._pixels.shape[1]} samples")
        usable = np.ones(len(pixels), dtype=bool) if usable is None else usable
        if self.start == self.end:
            self.start = self.end = first_line
        late = min(max(self.end - first_line, 0), len(pixels))
        pixels, usable, first_line = pixels[late:], usable[late:], first_line + late
        if not len(pixels):
            return 0, late
        missing = first_line - self.end
        gone = np.arange(max(self.end, first_line - self.capacity), first_line) % self.capacity
        self._usable[gone] = False
        self._pixels[gone] = 0
        end = first_line + len(pixels)
        kept = min(len(pixels), self.capacity)
        at = np.arange(end - kept, end) % self.capacity
        self._pixels[at] = pixels[-kept:]
        self._usable[at] = usable[-kept:]
        self.end = end
        self.start = max(self.start, end - self.capacity)
        return missing, late

    def read(self, first_line: int, end_line: int) -> Stretch:
        """Lines ``first_line .. end_line - 1`` as far as they are in the ring (a copy)."""
        first, end = max(first_line, self.start), min(end_line, self.end)
        at = np.arange(first, max(end, first)) % self.capacity
        return Stretch(first, self._pixels[at], self._usable[at])


class LineStore:
    """Rings for the CCD lines of a camera.

    Parameters
    ----------
    samples : length of each CCD line
    lines : how many lines of each are wanted
    budget_bytes : all rings together take no more; if that is too little, all are shortened alike
    dtype : of the pixels

    Raises
    ------
    ValueError : a budget that does not hold eight lines of each
    """

    def __init__(
        self,
        samples: Mapping[str, int],
        lines: Mapping[str, int],
        budget_bytes: int,
        dtype: np.dtype | type = np.uint16,
    ):
        size = {ccd: samples[ccd] * np.dtype(dtype).itemsize + 1 for ccd in samples}
        wanted = sum(lines[ccd] * size[ccd] for ccd in samples)
        self.share = min(1.0, budget_bytes / wanted) if wanted else 1.0
        capacity = {ccd: int(lines[ccd] * self.share) for ccd in samples}
        if min(capacity.values(), default=0) < 8:
            raise ValueError(f"a budget of {budget_bytes} bytes for image lines is too small: {wanted} are wanted")
        self.rings = {ccd: LineRing(samples[ccd], capacity[ccd], dtype) for ccd in samples}

    @property
    def nbytes(self) -> int:
        return sum(ring.nbytes for ring in self.rings.values())

    def clear(self) -> None:
        """Forget all lines."""
        for ring in self.rings.values():
            ring.clear()
