"""What was wrong with the newest case of each kind that a counter counts, beside how many there were."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

#: Longest text that is kept of a problem, in characters: names in messages may have any length, a path of a file has
#: less.
LONGEST_PROBLEM = 5000


def shortened(text: str) -> str:
    """A text as it is kept."""
    return text if len(text) <= LONGEST_PROBLEM else f"{text[: LONGEST_PROBLEM - 3]}..."


def in_words(counted: Mapping[str, int], last: Mapping[str, str]) -> str:
    """The last problem of each kind that was counted, which is named where several were; "" where none has a text."""
    kinds = [kind for kind, number in sorted(counted.items()) if number]
    told = [kind for kind in kinds if last.get(kind)]
    if len(kinds) == 1 == len(told):
        return f"the last: {last[told[0]]}"
    return "; ".join(f"the last {kind}: {last[kind]}" for kind in told)


def last_of(status: Any, counter: Any) -> str:
    """The last problem of a counter of a ``status/<node>``; of a publisher that tells one for all counters, that."""
    if any(other.last_problem for other in status.counters):
        return counter.last_problem
    return status.last_problem
