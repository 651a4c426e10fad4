"""Images of lines on disk, whatever their format: one band or a weighted sum of bands, as grey values."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import UserError

Array = NDArray[np.floating]

#: Lines that are looked at to judge the range of values of a whole image.
_LOOKED_AT = 32
#: Grey values that an image must have for anything to be matched in it.
_LEAST_LEVELS = 16
_MOST = 65535


@dataclass(frozen=True, kw_only=True)
class ImageFile(ABC):
    """An image on disk.

    Attributes
    ----------
    path : of the data
    lines, samples, bands : its size
    kind : type of a value, with its byte order
    names : of the bands; empty where it has none
    notes : remarks of the reader
    """

    path: Path
    lines: int
    samples: int
    bands: int
    kind: np.dtype[Any]
    names: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()

    @abstractmethod
    def read(self, first: int, count: int, band: int) -> NDArray[Any]:
        """Lines ``first`` to ``first + count - 1`` of a band, (count, samples), as they stand in the file."""

    def band(self, text: str) -> int:
        """Index, from 0, of a band given by its number from 1 or by its name.

        Raises
        ------
        UserError : no such band
        """
        lower = [name.lower() for name in self.names]
        if text.lower() in lower:
            return lower.index(text.lower())
        if text.isdigit() and 1 <= int(text) <= self.bands:
            return int(text) - 1
        named = f" or one of {', '.join(self.names[:8])}" if self.names else ""
        raise UserError(f"{self.path}: band {text!r}: not in it, wanted 1 to {self.bands}{named}")

    def weights(self, text: str | None) -> dict[int, float]:
        """Band index -> weight of ``"2"``, ``"NIR"`` or ``"2:0.5,3:0.5"``; the only band where nothing is said.

        Raises
        ------
        UserError : several bands and none named, a band that is not there, a weight that is not a number
        """
        if text is None:
            if self.bands == 1:
                return {0: 1.0}
            raise UserError(
                f"{self.path}: {self.bands} bands, wanted one of them (--band 2) or a sum (--band 2:0.5,3:0.5)"
            )
        found: dict[int, float] = {}
        for part in text.split(","):
            name, colon, weight = part.strip().rpartition(":")
            try:
                value = float(weight) if colon else 1.0
            except ValueError:
                value = np.nan
            if not np.isfinite(value) or value == 0.0:
                raise UserError(f"{self.path}: band {part.strip()!r}: weight {weight!r}, wanted a number, as in 2:0.5")
            found[self.band(name if colon else weight)] = value
        return found


@dataclass
class GreyImage:
    """Grey values of an image: one band of 8 or 16 bits as it is, everything else as 16 bits.

    Attributes
    ----------
    image : on disk
    weights : band index -> weight
    span : values that become 0 and 65535; None takes the values themselves
    changed : values that did not fit, by what was done to them
    """

    image: ImageFile
    weights: dict[int, float]
    span: tuple[float, float] | None = None
    changed: Counter[str] = field(default_factory=Counter)

    def __post_init__(self) -> None:
        if not self._plain and self.span is None:
            self._refuse_few_levels()

    @property
    def _plain(self) -> bool:
        kind = self.image.kind
        one = list(self.weights.values()) == [1.0]
        return one and self.span is None and kind.kind == "u" and kind.itemsize <= 2

    def read(self, first: int, count: int) -> NDArray[Any]:
        """Lines (count, samples), uint8 or uint16."""
        if self._plain:
            (band,) = self.weights
            values = self.image.read(first, count, band)
            return np.ascontiguousarray(values, values.dtype.newbyteorder("="))
        values = self._sum(first, count)
        if self.span is not None:
            low, high = self.span
            values = (values - low) * (_MOST / (high - low))
        lost = ~np.isfinite(values)
        self.changed["without a number, taken as 0"] += int(lost.sum())
        values = np.rint(np.where(lost, 0.0, values))
        self.changed["below the range, taken as 0"] += int((values < 0).sum())
        self.changed[f"above the range, taken as {_MOST}"] += int((values > _MOST).sum())
        return np.clip(values, 0, _MOST).astype(np.uint16)

    def _sum(self, first: int, count: int) -> Array:
        total = np.zeros((count, self.image.samples))
        for band, weight in self.weights.items():
            total += weight * self.image.read(first, count, band).astype(float)
        return total

    def _refuse_few_levels(self) -> None:
        """Raise UserError where rounded values cannot show anything, by some lines of the image."""
        rows = np.unique(np.linspace(0, self.image.lines - 1, _LOOKED_AT).astype(int))
        values = np.concatenate([self._sum(int(row), 1).ravel() for row in rows])
        values = values[np.isfinite(values)]
        low, high = (float(values.min()), float(values.max())) if len(values) else (0.0, 0.0)
        seen = np.clip([low, high], 0, _MOST)
        if np.diff(seen)[0] < _LEAST_LEVELS:
            what = f"values from {low:.6g} to {high:.6g} give fewer than {_LEAST_LEVELS} grey values from 0 to {_MOST}"
            raise UserError(f"{self.image.path}: {what}; wanted their range: --grey-range LOW HIGH")

    def notes(self) -> list[str]:
        """What was done to values that did not fit, once all lines have been read."""
        return [f"{self.image.path.name}: {n} values {what}" for what, n in sorted(self.changed.items()) if n]
