"""Strips that are imaged at the same time, as by two cameras with line rates of their own."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ...schemas.image_lines import LineBlock
from ..convert import SECOND_NS, STRIP_SILENT_S


class SideBySide:
    """Tells the lines of the strip that is flown from those of a strip that began while it was."""

    def __init__(self) -> None:
        self._begun: dict[str, int] = {}  # UTC of the first lines that came of each strip, ns, in this order
        self._flown = ""
        self._newest_ns = 0
        self._beside: set[str] = set()

    def lines(self, block: LineBlock, stamp_ns: int, strips: Mapping[str, Any]) -> tuple[bool, str]:
        """Whether a block belongs to a strip beside the one that is flown, or comes late of one before it, and once a
        strip that it is so, for the operator.

        Where lines of two strips come by turns, and neither has ended, the one that began first is flown; the other one
        is when no lines of the first have come for `STRIP_SILENT_S`.

        Parameters
        ----------
        stamp_ns : of the newest message
        strips : ``configuration/strip`` by id
        """
        id, flown = block.strip, self._flown
        goes_on = bool(flown) and not strips[flown].ended and stamp_ns - self._newest_ns < STRIP_SILENT_S * SECOND_NS
        told = ""
        if id != flown and goes_on and id in self._begun:
            if block.time_ns < self._begun[flown]:
                return True, ""
            first, other = sorted((id, flown), key=list(self._begun).index)
            if other not in self._beside:
                self._beside.add(other)
                told = f"{other}: its lines come beside those of {first}"
            if other == id:
                return True, told
        elif id != flown:
            self._begun.pop(id, None)
            self._begun[id] = int(block.time_ns)
        self._flown, self._newest_ns = id, stamp_ns
        return False, told
