"""ENVI images and raw strips, mapped into memory: some lines of a band at a time."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import UserError
from .byte_order_mark import without_mark
from .envi import header_integer, header_of, read_header
from .grey_image import ImageFile

#: Data types of ENVI that hold real numbers.
_KINDS = {1: "u1", 2: "i2", 3: "i4", 4: "f4", 5: "f8", 12: "u2", 13: "u4", 14: "i8", 15: "u8"}
_INTERLEAVES = ("bil", "bip", "bsq")
_DATA_SUFFIXES = ("", ".img", ".bil", ".bip", ".bsq", ".raw", ".dat", ".bin")
#: What a raw file may hold: name -> type of a value.
TYPES = {"u1": np.dtype("u1"), "u2": np.dtype("<u2"), ">u2": np.dtype(">u2")}


@dataclass(frozen=True, kw_only=True)
class EnviImage(ImageFile):
    """Plain values on disk.

    Attributes
    ----------
    offset : bytes before the first value
    interleave : "bil", "bip" or "bsq"
    """

    offset: int = 0
    interleave: str = "bil"

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
        return without_mark(file.read(16)).lstrip().startswith(b"ENVI")


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
    for key in ("major frame offsets", "minor frame offsets"):
        if header.get(key, "").strip("0., "):
            raise UserError(f"{header_path}: {key}: {header[key]}, wanted 0 (no bytes between lines)")
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
    dark = header.get("autodarkstartline", "")
    if dark.isdecimal() and 0 < int(dark) < lines:
        notes += (f"{path.name}: lines from {dark} on are dark (autodarkstartline), not of the ground",)
    return EnviImage(
        path=path, lines=lines, samples=samples, bands=bands, kind=kind, offset=offset, interleave=interleave,
        names=names, notes=notes,
    )  # fmt: skip


def open_raw(path: Path, kind: str, samples: int) -> EnviImage:
    """Lines without a header, one after the other.

    Parameters
    ----------
    kind : of `TYPES`
    samples : of a line

    Raises
    ------
    UserError : not there, or no whole line in it
    """
    if not path.is_file():
        raise UserError(f"{path}: no such file")
    line = samples * TYPES[kind].itemsize
    lines, more = divmod(path.stat().st_size, line)
    what = f"lines of {samples} samples of type {kind} ({line} bytes)"
    if not lines:
        raise UserError(f"{path}: {more} bytes, wanted {what}")
    notes = (f"{path.name}: {more} bytes after the last of {lines} {what}, not read; wrong samples?",) if more else ()
    return EnviImage(path=path, lines=lines, samples=samples, bands=1, kind=TYPES[kind], notes=notes)


def _both(path: Path) -> tuple[Path, Path]:
    """Header and data."""
    if path.suffix.lower() == ".hdr":
        if not path.is_file():
            raise UserError(f"{path}: no such file")
        suffixes = (*_DATA_SUFFIXES, *(s.upper() for s in _DATA_SUFFIXES))
        found = [p for p in (path.with_suffix(s) for s in suffixes) if p.is_file()]
        if not found:
            raise UserError(f"{path}: no image beside it, wanted {path.stem} with .img, .bil, .bip, .bsq, .raw or .dat")
        return path, found[0]
    if not path.is_file():
        raise UserError(f"{path}: no such file")
    header = header_of(path)
    if header is None:
        other = "a TIFF, or --raw TYPE"
        raise UserError(f"{path}: no ENVI header beside it, wanted {path.name}.hdr or {path.stem}.hdr, {other}")
    return header, path
