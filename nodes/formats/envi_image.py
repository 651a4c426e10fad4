"""ENVI images, mapped into memory: some lines at a time, of one band or of a weighted sum of bands, as grey values."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import UserError
from .envi import header_integer, header_of, read_header

Array = NDArray[np.floating]

#: Data types of ENVI that hold real numbers.
_KINDS = {1: "u1", 2: "i2", 3: "i4", 4: "f4", 5: "f8", 12: "u2", 13: "u4", 14: "i8", 15: "u8"}
_INTERLEAVES = ("bil", "bip", "bsq")
_DATA_SUFFIXES = ("", ".img", ".bil", ".bip", ".bsq", ".raw", ".dat", ".bin")
#: Lines that are looked at to judge the range of values of a whole image.
_LOOKED_AT = 32
#: Grey values that an image must have for anything to be matched in it.
_LEAST_LEVELS = 16
_MOST = 65535


@dataclass(frozen=True)
class EnviImage:
    """An image on disk.

    Attributes
    ----------
    path, header_path : of the data and of the header
    lines, samples, bands : its size
    kind : type of a value, with its byte order
    offset : bytes before the first value
    interleave : "bil", "bip" or "bsq"
    names : of the bands; empty where the header has none
    notes : remarks of the reader
    """

    path: Path
    header_path: Path
    lines: int
    samples: int
    bands: int
    kind: np.dtype[Any]
    offset: int
    interleave: str
    names: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()

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

    def read(self, first: int, count: int, band: int) -> NDArray[Any]:
        """Lines ``first`` to ``first + count - 1`` of a band, (count, samples), as they stand in the file."""
        lines, samples, bands = self.lines, self.samples, self.bands
        shape = {"bil": (lines, bands, samples), "bip": (lines, samples, bands), "bsq": (bands, lines, samples)}
        data = np.memmap(self.path, self.kind, "r", self.offset, shape[self.interleave])
        rows = slice(first, first + count)
        if self.interleave == "bil":
            return np.array(data[rows, band])
        return np.array(data[rows, :, band] if self.interleave == "bip" else data[band, rows])


def is_envi_image(path: Path) -> bool:
    """Whether a file has an ENVI header beside it, or is one."""
    header = path if path.suffix.lower() == ".hdr" else header_of(path)
    if header is None or not header.is_file():
        return False
    with open(header, "rb") as file:
        return file.read(16).lstrip().startswith(b"ENVI")


def open_envi(path: Path) -> EnviImage:
    """An image by the name of its data or of its header.

    Raises
    ------
    UserError : no header or no data, a header of something else than an image of real numbers, a file that is too short
    """
    header_path, path = _both(path)
    header = read_header(header_path)
    samples, lines, bands = (header_integer(header_path, header, key, low=1) for key in ("samples", "lines", "bands"))
    code = header_integer(header_path, header, "data type", low=1)
    if code not in _KINDS:
        known = ", ".join(str(k) for k in _KINDS)
        raise UserError(f"{header_path}: data type: {code}, wanted one with real numbers ({known})")
    interleave = header.get("interleave", "bsq" if bands == 1 else "").strip().lower()
    if interleave not in _INTERLEAVES:
        raise UserError(f"{header_path}: interleave: {header.get('interleave', 'missing')}, wanted bil, bip or bsq")
    if header_integer(header_path, header, "file compression", 0):
        raise UserError(f"{header_path}: file compression: {header['file compression']}, wanted 0 (plain values)")
    order = header_integer(header_path, header, "byte order", 0)
    if order > 1:
        raise UserError(f"{header_path}: byte order: {order}, wanted 0 (least byte first) or 1")
    offset = header_integer(header_path, header, "header offset", 0)
    kind = np.dtype(_KINDS[code]).newbyteorder(">" if order else "<")
    wanted, size = offset + lines * samples * bands * kind.itemsize, path.stat().st_size
    if size < wanted:
        what = f"{lines} lines of {samples} samples and {bands} bands ({header_path.name})"
        raise UserError(f"{path}: {size} bytes, wanted {wanted} for {what}; truncated?")
    names = tuple(name.strip() for name in header.get("band names", "").split(",") if name.strip())
    if names and len(names) != bands:
        raise UserError(f"{header_path}: band names: {len(names)} names, wanted {bands}")
    notes = (f"{path.name}: {size - wanted} bytes after the last line, not read",) if size > wanted else ()
    return EnviImage(path, header_path, lines, samples, bands, kind, offset, interleave, names, notes)


def _both(path: Path) -> tuple[Path, Path]:
    """Header and data."""
    if path.suffix.lower() == ".hdr":
        if not path.is_file():
            raise UserError(f"{path}: no such file")
        found = [p for p in (path.with_suffix(s) for s in _DATA_SUFFIXES) if p.is_file()]
        if not found:
            raise UserError(f"{path}: no image beside it, wanted {path.stem} with .img, .bil, .bip, .bsq, .raw or .dat")
        return path, found[0]
    if not path.is_file():
        raise UserError(f"{path}: no such file")
    header = header_of(path)
    if header is None:
        raise UserError(f"{path}: no ENVI header beside it, wanted {path.name}.hdr or {path.stem}.hdr")
    return header, path


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

    image: EnviImage
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
