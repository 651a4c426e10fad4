"""Text files that a Windows editor has saved: UTF-8 with a byte order mark before the first character.

Readers whose files are UTF-8 name the codec ``utf-8-sig``, which leaves the mark out; these are for the others.
"""

from __future__ import annotations

import codecs
from pathlib import Path


def read_latin(path: Path) -> str:
    """Text of a file whose bytes are Latin-1, or UTF-8 where it has a mark."""
    data = path.read_bytes()
    marked = data.startswith(codecs.BOM_UTF8)
    return data.decode("utf-8-sig", errors="replace") if marked else data.decode("latin-1")


def without_mark(head: bytes) -> bytes:
    """The first bytes of a file without a mark."""
    return head.removeprefix(codecs.BOM_UTF8)
