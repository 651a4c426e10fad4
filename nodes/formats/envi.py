"""ENVI headers, and binary tables that have one: float64 values, one record a line of the image."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import UserError
from .byte_order_mark import read_latin


def read_header(path: Path) -> dict[str, str]:
    """Keys (lower case) and values of an ENVI header file.

    Raises
    ------
    UserError : not an ENVI header
    """
    text = read_latin(path)
    if not text.lstrip().startswith("ENVI"):
        raise UserError(f"{path}:1: not an ENVI header, wanted 'ENVI' in the first line")
    header: dict[str, str] = {}
    lines = iter(text.splitlines()[1:])
    for line in lines:
        key, sign, value = line.partition("=")
        if not sign:
            continue
        while "{" in value and "}" not in value:
            more = next(lines, None)
            if more is None:
                raise UserError(f"{path}: {key.strip()}: the brace is not closed")
            value += more
        header[key.strip().lower()] = value.strip().strip("{}").strip()
    return header


def header_of(path: Path) -> Path | None:
    """The header beside a binary file, if there is one; some systems write names in capitals."""
    beside = [p for end in (".hdr", ".HDR") for p in (path.with_name(path.name + end), path.with_suffix(end))]
    return next((p for p in beside if p.is_file()), None)


def header_integer(path: Path, header: dict[str, str], key: str, default: int | None = None, low: int = 0) -> int:
    """An integer of a header; ``default`` where the key is absent.

    Raises
    ------
    UserError : absent without a default, not an integer, or less than ``low``
    """
    if key not in header and default is not None:
        return default
    wanted = f"wanted an integer of at least {low}"
    if key not in header:
        raise UserError(f"{path}: {key}: missing, {wanted}")
    try:
        value = int(header[key])
    except ValueError:
        raise UserError(f"{path}: {key}: {header[key]!r}, {wanted}") from None
    if value < low:
        raise UserError(f"{path}: {key}: {value}, {wanted}")
    return value


def read_records(path: Path, bands: tuple[str, ...], notes: list[str]) -> tuple[tuple[str, ...], NDArray[np.float64]]:
    """Names of the bands and the records (n, bands) of a binary table.

    ``bands`` stands for a header that is absent; with a header its ``band names`` count.

    Raises
    ------
    UserError : a header that describes something else than a float64 table, or a file of another size than it says
    """
    header_path = header_of(path)
    size = path.stat().st_size
    kind, offset, lines = np.dtype("<f8"), 0, None
    if header_path is None:
        notes.append(f"{path.name}: no header beside it; taken as {', '.join(bands)}")
    else:
        header = read_header(header_path)

        def integer(key: str, default: int | None = None) -> int:
            try:
                return int(header[key]) if key in header or default is None else default
            except KeyError:
                raise UserError(f"{header_path}: {key}: missing, wanted an integer") from None
            except ValueError:
                raise UserError(f"{header_path}: {key}: {header[key]!r}, wanted an integer") from None

        if integer("data type") != 5:
            raise UserError(f"{header_path}: data type: {header['data type']}, wanted 5 (float64)")
        if header.get("interleave", "bip").lower() != "bip" or integer("samples", 1) != 1:
            raise UserError(f"{header_path}: interleave: wanted bip with 1 sample a line")
        named = tuple(name.strip().lower() for name in header.get("band names", "").split(",") if name.strip())
        count = integer("bands")
        bands = named or bands
        if len(bands) != count:
            raise UserError(f"{header_path}: bands: {count}, wanted {len(bands)} ({', '.join(bands)})")
        kind = np.dtype(">f8" if integer("byte order", 0) else "<f8")
        offset, lines = integer("header offset", 0), integer("lines")
    record = 8 * len(bands)
    if size <= offset or (size - offset) % record:
        raise UserError(f"{path}: {size} bytes, wanted a whole number of records of {record} bytes; truncated?")
    if lines is not None and (size - offset) // record != lines:
        raise UserError(f"{path}: {(size - offset) // record} records, but {header_path} says {lines}; truncated?")
    values = np.fromfile(path, dtype=kind, offset=offset).astype(float)
    return bands, values.reshape(-1, len(bands))
