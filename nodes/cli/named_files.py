"""Files that a command line names, and those in folders that it names."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from ..errors import UserError


def named_files(paths: Iterable[Path], suffixes: tuple[str, ...], what: str) -> list[Path]:
    """Files as they are named; in place of a folder those in it that have one of the suffixes, sorted.

    Raises
    ------
    UserError : a folder without any; ``what`` says of what
    """
    out: list[Path] = []
    for path in paths:
        if path.is_dir():
            inside = sorted(p for p in path.iterdir() if p.suffix.lower() in suffixes)
            if not inside:
                raise UserError(f"{path}: no {what} in it ({', '.join(suffixes)})")
            out += inside
        else:
            out.append(path)
    return out
