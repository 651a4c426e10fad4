"""A word to who gives a command a file in place of a recording, which it or another command reads."""

from __future__ import annotations

import shlex
from pathlib import Path

from ..errors import UserError
from ..recording.remote import RemotePath


def refuse_importable(path: Path) -> None:
    """Raise UserError where something is no recording, but becomes one by ``triline import`` or is for another command.

    Returns silently where nothing is there, or what is there is a recording, or of no known kind.
    """
    if isinstance(path, RemotePath) or not path.exists() or (path.is_file() and _is_mcap(path)):
        return
    from .detect import KINDS, kind_of_path  # imports the readers of all kinds
    from .other_kinds import other_kind

    try:
        kind = kind_of_path(path)
    except UserError:
        if other := other_kind(path):
            raise UserError(f"{path}: {other}; wanted a recording") from None
        return
    target = "camera.json" if kind == "camera" else f"{path.stem}.mcap"
    command = f"triline import {shlex.quote(str(path))} -o {shlex.quote(target)}"
    raise UserError(f"{path}: {KINDS[kind]}, wanted a recording: `{command}` makes one")


def _is_mcap(path: Path) -> bool:
    with open(path, "rb") as file:
        return file.read(8) == b"\x89MCAP0\r\n"
