"""Whether a wander that is present keeps the largest factor it has had when less is asked of it.

It may be all in one step of the GNSS, which a mean over the window no longer shows: then it has not become smaller. But
a factor may also have been too large from the start. First looks do not tell whether a position wanders or an attitude,
and both are stated larger, which costs accuracy where only one of them does.
"""

from __future__ import annotations

import numpy as np

from ...arrays import Array, IntArray

#: The other wander was meant where its factor has become so many times as large since. Tuned.
MOVED = 2.0
#: The factor was too large where less than this share of the squares that spoke for it is left while all that it was
#: weighed by is still in the window. Tuned.
STILL_SPEAKS = 0.5


class KeptWanders:
    """The largest factors of the wanders of position and attitude, and what they were weighed by."""

    def __init__(self) -> None:
        self._largest, self._other_then = np.ones(2), np.ones(2)
        self._equations_then, self._first_s = np.zeros(2), np.full(2, np.inf)

    def another_attitude(self) -> None:
        """Of the attitude another wander is stated: what the one before was found to be says nothing."""
        self._largest[1] = self._other_then[1] = 1.0
        self._equations_then[1], self._first_s[1] = 0.0, np.inf

    def keeps(self, factor: Array, equations: IntArray, final_to_s: float) -> tuple[bool, bool]:
        """Whether what is present keeps its largest factors; asked each time sigmas are stated anew, and remembered.

        Not where the other wander has become much larger since: then it was that one all along. Nor where the same data
        ask for much less now that there are more of them. A step of the GNSS does not become smaller by that: its
        square is spread over more equations alone.

        Parameters
        ----------
        factor : (2,) factors on the sigmas of position and attitude that are stated now
        equations : (2,) a-priori equations of the wanders that are present
        final_to_s : time up to which nothing is in the window any more
        """
        other = factor[::-1]
        moved = (factor < self._largest) & (other > MOVED * self._other_then)
        left, spoke = (factor**2 - 1.0) * equations, (self._largest**2 - 1.0) * self._equations_then
        too_large = (final_to_s <= self._first_s) & (left < STILL_SPEAKS * spoke)
        higher = factor >= self._largest
        new = moved | too_large | higher
        self._largest[new], self._other_then[new], self._equations_then[new] = factor[new], other[new], equations[new]
        self._first_s[higher] = final_to_s
        position, attitude = (~(moved | too_large)).tolist()
        return position, attitude
