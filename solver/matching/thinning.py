"""Which tie points to keep where there are more than can be worked in: those that tell most of the orientation.

A point of m looks has 2 m - 3 conditions left for the orientation; each look brings its share of them to the place it
stands at, a stretch of time on a part of the swath of a CCD line. What a further condition adds at a place falls with
those that are there already, as 1 / (1 + n): information about the same few unknowns grows with its logarithm.
"""

from __future__ import annotations

import heapq
from collections.abc import Sequence
from dataclasses import dataclass

#: Stretches of time, s, and parts of the swath that are told apart.
STRETCH_S = 1.0
PARTS = 4


@dataclass(frozen=True)
class Candidate:
    """A point that may be kept: per look its time in seconds, its CCD line and its place on it, 0 to 1."""

    looks: Sequence[tuple[float, str, float]]

    @property
    def conditions(self) -> float:
        """What one look of the point brings."""
        m = len(self.looks)
        return max(2 * m - 3, 0) / m if m else 0.0


class Thinning:
    """Chooses points, and remembers where there are enough already."""

    def __init__(self) -> None:
        self._held: dict[tuple[int, str, int], float] = {}

    def choose(self, candidates: Sequence[Candidate], number: int) -> list[int]:
        """Places of so many candidates, in their order; the one that adds most first, then what adds most to it.

        Parameters
        ----------
        candidates : points that came together
        number : of points to keep
        """
        places = [[_place(look) for look in c.looks] for c in candidates]
        waiting = [(-self._gain(c, p), i) for i, (c, p) in enumerate(zip(candidates, places, strict=True))]
        heapq.heapify(waiting)
        chosen: list[int] = []
        while waiting and len(chosen) < number:
            _, i = heapq.heappop(waiting)
            gain = self._gain(candidates[i], places[i])
            if waiting and gain < -waiting[0][0]:  # others have come since it was counted
                heapq.heappush(waiting, (-gain, i))
                continue
            chosen.append(i)
            for place in places[i]:
                self._held[place] = self._held.get(place, 0.0) + candidates[i].conditions
        return sorted(chosen)

    def _gain(self, candidate: Candidate, places: Sequence[tuple[int, str, int]]) -> float:
        return candidate.conditions * sum(1.0 / (1.0 + self._held.get(place, 0.0)) for place in places)

    def forget(self, before_s: float) -> None:
        """Drop what is known of times before."""
        first = int(before_s // STRETCH_S)
        self._held = {place: n for place, n in self._held.items() if place[0] >= first}


def _place(look: tuple[float, str, float]) -> tuple[int, str, int]:
    time_s, ccd, share = look
    return int(time_s // STRETCH_S), ccd, int(PARTS * share)
