"""A disk on which a file cannot grow, for tests of what is left behind on it."""

from __future__ import annotations

import os
import resource
import sys
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def files_of_at_most(size: int) -> Iterator[None]:
    """Writing more than so many bytes to a file fails, as on a full disk.

    No byte code is written meanwhile: of a module that is imported now Python would keep the part that there is room
    for, which other tests then trip over.
    """
    before, wrote = resource.getrlimit(resource.RLIMIT_FSIZE), sys.dont_write_bytecode
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    sys.dont_write_bytecode, os.environ["PYTHONDONTWRITEBYTECODE"] = True, "1"
    try:
        yield
    finally:
        del os.environ["PYTHONDONTWRITEBYTECODE"]
        sys.dont_write_bytecode = wrote
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
