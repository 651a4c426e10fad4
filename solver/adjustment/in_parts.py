"""Work in parts, so that it can be spread over many updates of some milliseconds each.

A function that works in parts is a generator: each part yields what it cost, in floating point operations, about, and
the caller may do something else before it asks for the next one.
"""

from __future__ import annotations

from collections.abc import Generator
from typing import TypeVar

Cost = float
Parts = Generator[Cost, None, None]

T = TypeVar("T")


def in_one_go(parts: Generator[Cost, None, T]) -> T:
    """Do all parts; returns what the generator returns."""
    while True:
        try:
            next(parts)
        except StopIteration as end:
            return end.value
