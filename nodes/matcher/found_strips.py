"""Strips that nobody announces, found from their image lines."""

from __future__ import annotations

from typing import Any

from ...schemas import messages as m
from ...schemas.image_lines import LineBlock
from ...solver.matching.line_times import OTHER_LINES
from ..convert import SECOND_NS, STRIP_SILENT_S

#: Lines without times of their own that are off the rate of their strip by more are told, lines; then its tie points
#: are worse than their sigma, also where the strip was announced, with a nominal rate.
OFF_LINES = 0.5


def _off(strip: Any, block: LineBlock) -> float:
    """How many lines later than by the rate of a strip a block has come."""
    due_ns = strip.first_line_time_ns + round(block.first_line * SECOND_NS / strip.line_rate_hz)
    return float((block.time_ns - due_ns) * strip.line_rate_hz / SECOND_NS)


class FoundStrips:
    """Makes a strip of the first block that names it: its rate is that of the block, its line 0 by this rate.

    A strip ends when lines of another one come, or none for a while.
    """

    def __init__(self) -> None:
        self._begun: dict[str, Any] = {}
        self._lines: dict[str, int] = {}
        self._newest_ns: dict[str, int] = {}
        self._end_ns: dict[str, int] = {}  # when the last line was imaged, of lines with times of their own
        self._off: set[str] = set()
        self._silent: set[str] = set()  # strips that have ended because no lines came
        self._announced_ns: dict[str, int] = {}  # newest line of strips that were announced

    def __contains__(self, id: str) -> bool:
        return id in self._begun

    def begin(self, block: LineBlock) -> Any:
        """The strip of a block, not known before.

        Raises
        ------
        ValueError : a block that says neither its period nor times of two lines, or that has no strip
        """
        period_ns = float(block.line_period_ns)
        if not period_ns and len(block.pixels) > 1:
            times = block.times_ns()
            period_ns = float(times[-1] - times[0]) / (len(times) - 1)
        if not block.strip or not period_ns > 0:
            raise ValueError("lines without a strip, or without line_period_ns and times; wanted both")
        first_ns = block.time_ns - round(block.first_line * period_ns)
        strip = m.Strip(id=block.strip, first_line_time_ns=max(first_ns, 0), line_rate_hz=SECOND_NS / period_ns)
        self._begun[block.strip] = strip
        return strip

    def note(self, block: LineBlock, stamp_ns: int, announced: Any = None) -> str:
        """Keep how far a strip is; returns a line for the operator where lines come after its end, or are off its rate,
        once a strip.

        Lines with times of their own may be: tie points get these (`LineTimes`).

        Parameters
        ----------
        announced : the strip of the block, if it was announced and not found

        Raises
        ------
        ValueError : the lines of a strip that was found are far off, so their numbers do not go with their times
        """
        strip, own = self._begun.get(block.strip), block.line_times_ns is not None
        if strip is None:
            self._announced_ns[block.strip] = max(self._announced_ns.get(block.strip, 0), stamp_ns)
            return "" if announced is None or own else self._told_off(announced, _off(announced, block), block)
        off = 0.0 if own else _off(strip, block)
        if abs(off) > OTHER_LINES:
            raise ValueError(
                f"line {block.first_line} of strip {strip.id!r} came {off:+.0f} lines off its time; a strip that "
                "begins anew wants another name"
            )
        self._lines[strip.id] = max(self._lines.get(strip.id, 0), int(block.first_line) + len(block.pixels))
        if own:
            self._end_ns[strip.id] = max(self._end_ns.get(strip.id, 0), int(block.times_ns()[-1]))
        self._newest_ns[strip.id] = max(self._newest_ns.get(strip.id, 0), stamp_ns)
        if strip.id in self._silent:
            self._silent.remove(strip.id)
            return (
                f"{strip.id}: lines come again from line {block.first_line} on, after the strip has ended for want of "
                "them: no tie points of them are used, no orientation is refined; they want the name of another strip"
            )
        return self._told_off(strip, off, block)

    def _told_off(self, strip: Any, off: float, block: LineBlock) -> str:
        """A line for the operator where lines are off the rate by which tie points get their times, once a strip."""
        if abs(off) < OFF_LINES or strip.id in self._off:
            return ""
        self._off.add(strip.id)
        where = f"{strip.id}: line {block.first_line} came {off:+.1f} lines off the {strip.line_rate_hz:.4f} lines/s"
        if strip.id in self._begun:
            return f"{where} of its first block: give line_period_ns, or announce the strip with its rate"
        return (
            f"{where} that the strip was announced with: tie points get wrong times, orientation and points wrong "
            "places; announce it with the rate that its lines keep (line_rate_hz)"
        )

    def ended(self, stamp_ns: int, block: LineBlock | None = None) -> list[Any]:
        """Strips that have ended: another one has lines now, or there have been none for a while."""
        silent = [id for id, newest_ns in self._newest_ns.items() if stamp_ns - newest_ns > STRIP_SILENT_S * SECOND_NS]
        self._silent.update(silent)
        others = [] if block is None else [id for id in self._newest_ns if id != block.strip]
        return [self._end(id) for id in dict.fromkeys((*silent, *others))]

    def left_open(self, strip: str, stamp_ns: int) -> list[str]:
        """Strips that were announced, and of which no lines have come for a while before those of another one, once."""
        silent_ns = stamp_ns - round(STRIP_SILENT_S * SECOND_NS)
        found = [id for id, newest_ns in self._announced_ns.items() if id != strip and newest_ns < silent_ns]
        for id in found:
            del self._announced_ns[id]
        return found

    def finish(self) -> list[Any]:
        """Strips that have not ended yet."""
        return [self._end(id) for id in list(self._newest_ns)]

    def _end(self, id: str) -> Any:
        del self._newest_ns[id]
        strip = m.Strip()
        strip.CopyFrom(self._begun[id])
        strip.lines, strip.ended = self._lines[id], True
        lasted_ns = self._end_ns.get(id, 0) - strip.first_line_time_ns
        if lasted_ns > 0 and strip.lines > 1:
            strip.line_rate_hz = (strip.lines - 1) * SECOND_NS / lasted_ns
        return strip
