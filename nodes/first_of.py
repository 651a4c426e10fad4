"""Lists of names in messages: the first ones, and how many more there are."""

from __future__ import annotations

from collections.abc import Sequence


def first_of(words: Sequence[str], most: int, between: str = ", ") -> str:
    """``a, b and 5 more``: no more than so many of the words."""
    more = len(words) - most
    return between.join(words[:most]) + (f" and {more} more" if more > 0 else "")
