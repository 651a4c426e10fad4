"""The matcher's pace: how it keeps up where the machine is too slow for its image lines.

It tries fewer places, evenly fewer, then only signalised targets and points of earlier strips; at last it lets lines go
by. What it decides while it is behind is published as ``matching/pace`` with the platform time from which it holds;
`process` reads these messages and does the same at the same places, so that both give the same ties.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from ...schemas import messages as m

#: Share of the places that are tried, by level; at the last level lines go by unseen.
SHARES = (1.0, 0.7, 0.5, 0.35, 0.2, 0.1, 0.0, 0.0)
#: What the levels do of the work on lines, and of that on places; see `Governor`.
PARTS = (*((1.0, share) for share in SHARES[:-1]), (0.0, 0.0))
#: Of answers later than a share of such a window, s, the adjuster has little.
WINDOW_S = 12.0
#: Behind by less, s, a pace is not because of a heap.
CAUGHT_UP_S = 0.5


@dataclass(frozen=True)
class MatcherPace:
    """How image lines are taken in; ``level`` 0 is the normal pace.

    Raises
    ------
    ValueError : a level there is not
    """

    level: int = 0
    lag_s: float = 0.0

    def __post_init__(self) -> None:
        if not 0 <= self.level < len(SHARES):
            raise ValueError(f"pace of level {self.level}, wanted 0 to {len(SHARES) - 1}")

    @property
    def share(self) -> float:
        """Of the places that are tried."""
        return SHARES[self.level]

    @property
    def blind(self) -> bool:
        """Whether lines go by unseen."""
        return self.level == len(SHARES) - 1

    def words(self) -> str:
        """For the operator."""
        if not self.level:
            return "caught up: normal density again"
        text = f"{self.lag_s:.1f} s behind: " if self.lag_s > CAUGHT_UP_S else "there is room again: "
        if self.blind:
            return text + "lines go by unseen"
        return text + (f"{100 * self.share:g} % of the tie points" if self.share else "only targets and earlier points")

    def message(self, from_ns: int) -> Any:
        """The body of ``matching/pace``."""
        return m.Pace(start_ns=from_ns, level=self.level, interval_factor=1.0, kept_share=self.share, lag_s=self.lag_s)
