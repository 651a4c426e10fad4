"""What was missed on the way is asked for again.

Publishers keep what they have said for a while (`session.KEPT_S`). A node that begins while a flight is under way, that
stood still, whose session was opened anew or that finds numbers missing asks for all of it, and works off what it has
not had, in order, before what has come meanwhile.
"""

from __future__ import annotations

import time
from collections.abc import Iterable
from typing import TypeVar

from ...schemas.envelope import Envelope, RawMessage
from ..ordering import StreamCheck, order_key
from .session import KEPT_S, Bus, is_kept

T = TypeVar("T")

#: A program that has not come round for so long stood still, s.
STOOD_STILL_S = 1.0
#: What is recalled can be on its way all the same, for so long at most, s.
ON_ITS_WAY_S = 10.0
#: Missing numbers are asked for at most so often, s: what nobody keeps any more stays missing.
AGAIN_S = 1.0


class Recall:
    """Notices that something was missed, and asks for it.

    Parameters
    ----------
    bus : the bus
    names : topics that are listened to
    check : of the streams of these topics

    Attributes
    ----------
    recalled : how many messages were asked for again and came
    """

    def __init__(self, bus: Bus, names: Iterable[str], check: StreamCheck[T]) -> None:
        self._bus, self._names, self._check = bus, tuple(names), check
        self._opened = len(bus.opened_anew)
        self._round_s = self._recalled_s = time.monotonic()
        self._asked_s = -AGAIN_S  # because of missing numbers
        self._given: set[tuple[str, Envelope]] = set()  # by the last recall; what was on its way comes once more
        self.recalled = 0

    def come_round(self) -> None:
        """The work of one turn is done."""
        self._round_s = time.monotonic()

    def complete(self, raws: list[RawMessage]) -> list[RawMessage]:
        """What has come, and before it what was missed; call once a turn."""
        now_s, opened = time.monotonic(), len(self._bus.opened_anew)
        if self._given:
            raws = [raw for raw in raws if (raw.topic, raw.envelope) not in self._given]
            if now_s - self._recalled_s > ON_ITS_WAY_S:
                self._given.clear()
        stood_still = now_s - self._round_s > STOOD_STILL_S
        missing = now_s - self._asked_s > AGAIN_S and self._skip(raws)
        if not stood_still and not missing and opened == self._opened:
            return raws
        self._opened = opened
        if missing:
            self._asked_s = now_s
        return self.joined(raws)

    def joined(self, raws: list[RawMessage], seconds: float = KEPT_S) -> list[RawMessage]:
        """What has come and what publishers have said lately, less what was there before, in order."""
        had = {(raw.topic, raw.envelope) for raw in raws}
        missed = [
            raw
            for raw in self._bus.recall(self._names, seconds)
            if (raw.topic, raw.envelope) not in had and self._check.lacks(raw.topic, raw.envelope)
        ]
        self._recalled_s, self._given = time.monotonic(), {(raw.topic, raw.envelope) for raw in missed}
        self.recalled += len(missed)
        return sorted([*missed, *raws], key=lambda raw: order_key(raw.topic, raw.envelope)) if missed else raws

    def _skip(self, raws: list[RawMessage]) -> bool:
        """Whether numbers are missing before or between messages that have come."""
        newest: dict[tuple[str, str, int], int] = {}
        for topic, envelope, *_ in raws:
            stream, number = (topic, envelope.source, envelope.start), envelope.sequence
            last = newest.get(stream)
            if last is None:
                last = self._check.last(topic, envelope)
            if last is not None and number > last + 1 and is_kept(topic):
                return True
            newest[stream] = number if last is None else max(last, number)
        return False
