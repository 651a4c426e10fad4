"""What earlier strips saw about their tie points, kept so that later strips find the same points."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter

from .consistency import Disagreement, SlowDisagreement
from .search import Ground, Patches

Array = NDArray[np.floating]

#: Half side of a chip, px: the template of the correlation at its coarsest, and what reduces it.
CHIP_HALF = 32
CHIP_BYTES = (2 * CHIP_HALF + 1) ** 2 * 2


@dataclass(frozen=True)
class Chips:
    """Patches on the ground as one strip saw them; they take the place of a view in a search.

    Attributes
    ----------
    values : (k, n, n) grey values
    holes : (k, n, n) what of them was not measured; None for no such pixel
    line_m : nothing here lies on lines
    """

    values: NDArray[np.floating]
    holes: NDArray[np.bool_] | None = None
    line_m: float = 1.0

    def select(self, chosen: NDArray[np.bool_]) -> Chips:
        """Some of them."""
        return Chips(self.values[chosen], None if self.holes is None else self.holes[chosen], self.line_m)

    def patches(self, ground: Ground, line: Array, half: int, factor: int) -> Patches:
        """See `search.Imagery`; the grids must be those of the chips."""
        k, n, _ = self.values.shape
        middle, reach = n // 2, half * factor
        smooth = self.values if factor == 1 else uniform_filter(self.values, factor, mode="nearest", axes=(1, 2))
        if reach > middle:
            raise ValueError(f"a patch of {half} x {factor} px from chips of {middle}")
        # boxes of an even number of pixels lie half a pixel off: that is far below a pixel of theirs
        at = middle + factor * np.arange(-half, half + 1)
        holes = None if self.holes is None or factor > 1 else self.holes[:, at[:, None], at]
        return Patches(smooth[:, at[:, None], at].astype(np.float32), np.ones(k), np.zeros(k), holes)


@dataclass
class StripChips:
    """The chips of one strip.

    Attributes
    ----------
    along, across, spacing_m : of the grids
    names : of the points
    xyz_l : (k, 3)
    values : (k, n, n) grey values
    holes : of each, bits of what was not measured; None where all was
    score : (k,) of the ties
    slow : how another strip lies against this one
    waiting : matches that wait for others to be judged with
    """

    along: Array
    across: Array
    spacing_m: float
    names: list[str] = field(default_factory=list)
    xyz_l: Array = field(default_factory=lambda: np.empty((0, 3)))
    values: NDArray[np.uint16] = field(
        default_factory=lambda: np.empty((0, 2 * CHIP_HALF + 1, 2 * CHIP_HALF + 1), np.uint16)
    )
    holes: list[NDArray[np.uint8] | None] = field(default_factory=list)
    score: Array = field(default_factory=lambda: np.empty(0))
    slow: SlowDisagreement = field(default_factory=lambda: SlowDisagreement(1))
    waiting: list[tuple[Disagreement, list]] = field(default_factory=list)

    def __len__(self) -> int:
        return len(self.names)

    def ground(self, chosen: NDArray[np.int64]) -> Ground:
        """The grids of some of them."""
        return Ground(self.xyz_l[chosen], self.along, self.across, self.spacing_m)

    def chips(self, chosen: NDArray[np.int64]) -> Chips:
        """What was seen of some of them."""
        values = self.values[chosen].astype(np.float32)
        packed = [self.holes[i] for i in chosen.tolist()]
        if not any(bits is not None for bits in packed):
            return Chips(values)
        n = values[0].size
        holes = [np.zeros(n, np.uint8) if bits is None else np.unpackbits(bits, count=n) for bits in packed]
        return Chips(values, np.array(holes, dtype=bool).reshape(values.shape))


class ChipStore:
    """Chips of all strips, within a budget.

    Parameters
    ----------
    budget_bytes : of grey values; when it is used up, every other chip of the strip with most of them goes
    """

    def __init__(self, budget_bytes: int):
        self.budget = budget_bytes
        self.strips: dict[str, StripChips] = {}

    def __len__(self) -> int:
        return sum(len(s) for s in self.strips.values())

    @property
    def nbytes(self) -> int:
        bits = sum(h.nbytes for s in self.strips.values() for h in s.holes if h is not None)
        return len(self) * CHIP_BYTES + bits

    def add(
        self, strip: str, names: list[str], values: NDArray[np.floating], ground: Ground, score: Array,
        holes: NDArray[np.bool_] | None = None,
    ) -> None:  # fmt: skip
        """Chips (k, n, n) of new points of a strip, on grids about them, and which pixels were not measured."""
        if not names or values.shape[1] != 2 * CHIP_HALF + 1:
            return
        s = self.strips.setdefault(strip, StripChips(ground.along, ground.across, ground.spacing_m))
        s.names = [*s.names, *names]
        s.xyz_l = np.concatenate([s.xyz_l, ground.centre_l])
        s.values = np.concatenate([s.values, np.clip(np.rint(values), 0, 65535).astype(np.uint16)])
        s.holes += [None] * len(names) if holes is None else [np.packbits(h) if h.any() else None for h in holes]
        s.score = np.concatenate([s.score, score])
        while self.nbytes > self.budget:
            self._thin()

    def _thin(self) -> None:
        s = max(self.strips.values(), key=len)
        kept = slice(None, None, 2) if len(s) > 2 else slice(0)
        s.names, s.xyz_l, s.values = s.names[kept], s.xyz_l[kept], s.values[kept].copy()
        s.score, s.holes = s.score[kept], s.holes[kept]
