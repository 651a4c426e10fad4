"""What was missed on the way is asked for again.

Publishers keep what they have said for a while (`session.KEPT_S`). A node that begins while a flight is under way, that
stood still, whose session was opened anew or that finds numbers missing asks for all of it, and works off what it has
not had, in order, before what has come meanwhile.
"""

from __future__ import annotations

import time
from collections.abc import Iterable
from typing import Any

from ...schemas import topics
from ...schemas.envelope import Envelope, RawMessage
from ..ordering import StreamCheck, order_key
from .session import KEPT_S, Bus, is_kept

#: A program that has not come round for so long stood still, s.
STOOD_STILL_S = 1.0
#: What is recalled can be on its way all the same, for so long at most, s.
ON_ITS_WAY_S = 10.0
#: Missing numbers are asked for at most so often, s: what nobody keeps any more stays missing.
AGAIN_S = 1.0
#: A configuration that has not come is asked for so often, s.
CONFIGURATION_AGAIN_S = 5.0


class Recall:
    """Notices that something was missed, and asks for it.

    Parameters
    ----------
    bus : the bus
    names : topics that are listened to
    check : of the streams of these topics

    Attributes
    ----------
    recalled : how many messages of a flight were asked for again and came; what is latched is not counted
    """

    def __init__(self, bus: Bus, names: Iterable[str], check: StreamCheck[Any]) -> None:
        self._bus, self._names, self._check = bus, tuple(names), check
        self._under_way = tuple(name for name in self._names if not topics.find(name).latched)
        self._opened = len(bus.opened_anew)
        self._round_s = self._recalled_s = time.monotonic()
        self._asked_s = -AGAIN_S  # because of missing numbers
        self._configured_s = self._round_s  # when configuration was asked for
        self._given: set[tuple[str, Envelope]] = set()  # by the last recall; what was on its way comes once more
        self.recalled = 0

    def come_round(self) -> None:
        """The work of one turn is done."""
        self._round_s = time.monotonic()

    def once(self, raws: list[RawMessage]) -> list[RawMessage]:
        """What has come, without what was on its way when it was recalled."""
        if not self._given:
            return raws
        raws = [raw for raw in raws if (raw.topic, raw.envelope) not in self._given]
        if time.monotonic() - self._recalled_s > ON_ITS_WAY_S:
            self._given.clear()
        return raws

    def complete(self, raws: list[RawMessage]) -> list[RawMessage]:
        """What has come, and before it what was missed; call once a turn."""
        now_s, opened = time.monotonic(), len(self._bus.opened_anew)
        raws = self.once(raws)
        stood_still = now_s - self._round_s > STOOD_STILL_S
        missing = now_s - self._asked_s > AGAIN_S and self._skip(raws)
        lacking = self._lacking(now_s)
        if not stood_still and not missing and opened == self._opened:
            return self._joined(raws, lacking, KEPT_S) if lacking else raws
        names = self._names if opened != self._opened else (*lacking, *self._under_way)
        self._opened = opened
        if missing:
            self._asked_s = now_s
        return self._joined(raws, names, KEPT_S)

    def joined(self, raws: list[RawMessage], seconds: float = KEPT_S) -> list[RawMessage]:
        """What has come and what publishers have said lately, less what was there before, in order.

        All that is latched is asked for as well: a node that lacks its configuration would wait for ever.
        """
        return self._joined(raws, self._names, seconds)

    def _joined(self, raws: list[RawMessage], names: Iterable[str], seconds: float) -> list[RawMessage]:
        had = {(raw.topic, raw.envelope) for raw in raws}
        missed = [
            raw
            for raw in self._bus.recall(names, seconds)
            if (raw.topic, raw.envelope) not in had and self._check.lacks(raw.topic, raw.envelope)
        ]
        if missed:
            self._recalled_s, self._given = time.monotonic(), {(raw.topic, raw.envelope) for raw in missed}
        self.recalled += sum(not topics.find(raw.topic).latched for raw in missed)
        return sorted([*missed, *raws], key=lambda raw: order_key(raw.topic, raw.envelope)) if missed else raws

    def _lacking(self, now_s: float) -> tuple[str, ...]:
        """Configuration that is to be asked for now, because none has come: without it a node stays mute."""
        if now_s - self._configured_s < CONFIGURATION_AGAIN_S:
            return ()
        self._configured_s = now_s
        names = (name for name in self._names if name.startswith("configuration/"))
        return tuple(name for name in names if name not in self._check.counts)

    def _skip(self, raws: list[RawMessage]) -> bool:
        """Whether numbers are missing before or between messages that have come."""
        newest: dict[tuple[str, str, int], int] = {}
        for topic, envelope, *_ in raws:
            stream, number = (topic, envelope.source, envelope.start), envelope.sequence
            last = newest.get(stream)
            if last is None:
                last = self._check.last(topic, envelope)
            if last is not None and number > last + 1 and is_kept(topic) and not topics.find(topic).latched:
                return True
            newest[stream] = number if last is None else max(last, number)
        return False
