"""Texts whose rows are numbers: their lines that are not blank, and the values, with where one of them is wrong."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import UserError
from .table import MOST_PROBLEMS, one_line


def numbered_lines(path: Path) -> list[tuple[int, str]]:
    """Number and text of the lines that are not blank."""
    text = path.read_text(encoding="utf-8-sig", errors="replace").splitlines()
    return [(i, line) for i, line in enumerate(text, 1) if line.strip()]


def numbers_of(path: Path, lines: list[tuple[int, list[str]]], place: dict[str, int]) -> NDArray[np.float64]:
    """Values (n, columns) of the columns at their places."""
    at = tuple(place.values())
    try:
        values = np.array([[float(fields[i]) for i in at] for _, fields in lines])
        if len(values) > 1 and np.isfinite(values).all():
            return values
    except (ValueError, IndexError):
        pass  # told below, which takes four times as long
    rows, problems = [], []
    for number, fields in lines:
        row = []
        for name, i in place.items():
            text = fields[i].strip() if i < len(fields) else ""
            try:
                row.append(float(text))
            except ValueError:
                row.append(np.nan)
            if not np.isfinite(row[-1]):
                problems.append(f"{path}:{number}: {name}: {f'{text!r} is not a number' if text else 'missing'}")
        rows.append(row)
        if len(problems) >= MOST_PROBLEMS:
            break
    if problems:
        raise UserError(one_line(problems))
    if len(rows) < 2:
        raise UserError(f"{path}: {len(rows)} rows, wanted at least 2")
    return np.array(rows)
