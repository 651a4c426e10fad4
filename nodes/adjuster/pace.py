"""The adjuster's pace: how it keeps up where updates take longer than the data allows.

First it takes larger batches, then it leaves out tie points that tell least. What it decides while it is behind is
published as ``adjustment/pace`` with the platform time from which it holds; `process` reads these messages and does the
same at the same places, so that both give the same answers.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from ...schemas import messages as m
from ...solver.matching.thinning import Candidate, Thinning
from .. import convert
from ..governor import Announced

#: Factor on the time and the number of rays between updates, and share of the tie points kept, by level.
LEVELS = ((1, 1.0), (2, 1.0), (5, 1.0), (5, 0.5), (5, 0.25), (5, 0.125), (5, 0.05), (5, 0.0))
#: What they do of the work on updates, and of that on tie points, and how many leave no point out; see `Governor`.
PARTS = tuple((1.0 / factor, kept) for factor, kept in LEVELS)
LOSSLESS = 2


@dataclass(frozen=True)
class Pace:
    """How data are taken in; ``level`` 0 is the normal pace, ``eased`` says that the one before was higher."""

    level: int = 0
    lag_s: float = 0.0
    eased: bool = False

    @property
    def factor(self) -> int:
        """On the time and the number of rays between updates."""
        return LEVELS[self.level][0]

    @property
    def kept(self) -> float:
        """Share of the tie points that are worked in."""
        return LEVELS[self.level][1]

    def words(self, update_s: float) -> str:
        """For the operator."""
        if not self.level:
            return "caught up: normal pace again"
        why = "catching up, eased off" if self.eased else f"{self.lag_s:.1f} s behind"
        text = f"{why}: updates every {self.factor * update_s:g} s"
        if self.kept == 0.0:
            return text + ", only control"
        return text + (f", {100 * self.kept:g} % of the tie points" if self.kept < 1.0 else "")


class Pacing:
    """The pace in force, those that are announced, and the tie points that wait while points are left out."""

    def __init__(self) -> None:
        self.pace = Pace()
        self._announced: Announced[Pace] = Announced()
        self.waiting: list[tuple[Any, str]] = []  # with the source
        self.left_out_total = 0
        self._thinning = Thinning()

    def announce(self, body: Any) -> None:
        """Take a message ``adjustment/pace``.

        Raises
        ------
        ValueError : a level there is not
        """
        if not 0 <= body.level < len(LEVELS):
            raise ValueError(f"pace of level {body.level}, wanted 0 to {len(LEVELS) - 1}")
        self._announced.add(body.start_ns, Pace(body.level, body.lag_s))

    def follow(self, stamp_ns: int) -> Pace | None:
        """The pace that begins by now, if one does."""
        begun = self._announced.take(stamp_ns)
        if begun is not None:
            self.pace = begun = replace(begun, eased=begun.level < self.pace.level)
        return begun

    def take_waiting(
        self, rates_hz: dict[str, float], starts_ns: dict[str, int], pixels: dict[str, int]
    ) -> list[tuple[Any, str]]:
        """The tie points among those that wait which are worked in; the others are counted.

        Parameters
        ----------
        rates_hz, starts_ns : line rate and time of the first line, by strip
        pixels : of the CCD lines
        """
        waiting, self.waiting = self.waiting, []
        if self.pace.kept >= 1.0 or not waiting:
            return waiting
        candidates = [
            Candidate(
                [
                    (
                        starts_ns[i.strip] / convert.SECOND_NS + i.line / rates_hz[i.strip],
                        i.ccd,
                        min(max(i.sample / pixels[i.ccd], 0.0), 1.0),
                    )
                    for i in body.images
                    if i.strip in rates_hz and i.ccd in pixels
                ]
            )
            for body, _ in waiting
        ]
        chosen = self._thinning.choose(candidates, round(self.pace.kept * len(waiting)))
        newest = max((time for c in candidates for time, _, _ in c.looks), default=0.0)
        self._thinning.forget(newest - 120.0)
        self.left_out_total += len(waiting) - len(chosen)
        return [waiting[i] for i in chosen]


def pace_message(level: int, lag_s: float, from_ns: int) -> Any:
    """The body of ``adjustment/pace``."""
    factor, kept = LEVELS[level]
    return m.Pace(start_ns=from_ns, level=level, interval_factor=factor, kept_share=kept, lag_s=lag_s)
