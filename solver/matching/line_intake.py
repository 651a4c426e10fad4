"""Image lines on their way into the store: judged, counted, and what is wrong with them told in one line."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray

from .line_quality import FULL_SCALES, GOOD, IS_PARTLY_SATURATED, REASONS, SATURATED, full_scale_of, judge_lines
from .line_store import LineStore
from .options import MatchingOptions

#: A CCD line that gives nothing for so long while others do, s, is told of.
SILENT_S = 5.0
#: One that gives nothing fit for use for so long, s, sees nothing: it is not waited for, places are not chosen in it.
BLIND_S = 2.0
#: It sees again once it has given good lines of so many seconds; others that have half of that, at the same time.
RETURN_S = 1.0
#: Events of a strip that are told. A fault that comes again and again is told so often by itself, then summed up, every
#: so many seconds.
MOST_TOLD, BY_ITSELF, SUMMED_S = 100, 3, 10.0
#: Names of lines that cannot be used, in events.
_WORDS = {
    "dark": "black (lens cap, no light or no data)",
    "saturated": "saturated",
    "frozen": "frozen",
    "partly saturated": "partly saturated",
}


class LineIntake:
    """Takes the lines of a strip.

    Parameters
    ----------
    samples : length of each CCD line
    options : see `MatchingOptions`
    make_store : makes the store for pixels of a type, or None as long as it is not known how long a store is needed

    Attributes
    ----------
    counters : lines by what was wrong with them
    saturated : grey value from which on pixels are saturated
    sees_from : lines from which on CCD lines see again that saw nothing earlier in the strip
    """

    def __init__(
        self,
        samples: Mapping[str, int],
        options: MatchingOptions,
        make_store: Callable[[np.dtype], LineStore | None],
    ):
        self.counters: Counter[str] = Counter()
        self.store: LineStore | None = None
        self.saturated = np.inf
        self.sees_from: dict[str, int] = {}
        self._samples, self._options, self._make_store = samples, options, make_store
        self._last_line: dict[str, NDArray[np.unsignedinteger]] = {}
        self._state: dict[str, int] = {}
        self._events: list[str] = []
        self._told = 0
        self._silent_after = np.inf
        self._first = 0
        self._ends: dict[str, int] = {}
        self._good_ends: dict[str, int] = {}
        self._silent: set[str] = set()
        self._returning: dict[str, int] = {}  # CCD lines that see nothing, and their good lines since
        self._rate = 1.0
        self._full_scale = 0
        self._faults: dict[tuple[str, str], tuple[int, int, int]] = {}
        self._told_of: set[str] = set()

    def begin_strip(self, line_rate_hz: float, first_line: int = 0) -> None:
        """What is in store is forgotten; lines come from ``first_line`` on."""
        self.store = None
        self._silent_after = SILENT_S * line_rate_hz
        self._first = first_line
        self._ends = dict.fromkeys(self._samples, first_line)
        self._good_ends = dict.fromkeys(self._samples, first_line)
        self._silent.clear()
        self.sees_from.clear()
        self._rate = line_rate_hz
        self._faults.clear()
        self._told_of.clear()
        self._told = 0
        self._last_line.clear()

    def add(self, ccd: str, first_line: int, pixels: NDArray[np.unsignedinteger]) -> NDArray[np.bool_]:
        """Lines of one CCD; returns which of them (n,) are fit for use.

        Raises
        ------
        ValueError : a CCD line the camera does not have, lines of another length or pixel type
        """
        if ccd not in self._samples:
            raise ValueError(f"unknown CCD line {ccd!r}")
        if pixels.shape[1:] != (self._samples[ccd],):
            width = " x ".join(map(str, pixels.shape[1:])) or "no"
            raise ValueError(f"lines of {ccd} of {width} samples, wanted {self._samples[ccd]}")
        if pixels.dtype not in (np.uint8, np.uint16):
            raise ValueError(f"lines of {ccd} of {pixels.dtype}, wanted uint8 or uint16")
        if not len(pixels) or first_line < 0:
            raise ValueError(f"no lines of {ccd}, or their number {first_line} is below 0")
        full_scale = self._options.full_scale or self._full_scale_now(pixels)
        # ground beside a cloud that has shown 16 bits is not dark for that
        dark_scale = self._options.full_scale or min(full_scale, FULL_SCALES[0])
        self.saturated = SATURATED * full_scale
        verdict = judge_lines(pixels, self._last_line.get(ccd), full_scale, dark_scale)
        self._last_line[ccd] = pixels[-1].copy()
        usable = (verdict == GOOD) | (verdict == IS_PARTLY_SATURATED)
        self._tell(ccd, first_line, verdict)
        self._listen(ccd, first_line + len(pixels))
        self._watch(ccd, first_line + len(pixels), int(usable.sum()))
        if self.store is None:
            self.store = self._make_store(pixels.dtype)
        if self.store is None:
            self.counters["lines before poses"] += len(pixels)
            return usable
        missing, late = self.store.rings[ccd].add(first_line, pixels, usable)
        if missing:
            self.counters["lines missing"] += missing
            words = f"{missing} lines are missing before line {first_line}"
            self._fault(ccd, "missing", words, missing, first_line)
        if late:
            self.counters["lines twice or late"] += late
        return usable

    def _full_scale_now(self, pixels: NDArray[np.unsignedinteger]) -> int:
        """Largest grey value where none is stated, as lines have shown it."""
        before, self._full_scale = self._full_scale, full_scale_of(pixels, self._full_scale)
        if self._full_scale > max(before, FULL_SCALES[0]):
            self.tell(
                f"grey values above {max(before, FULL_SCALES[0])}: full scale is taken to be {self._full_scale}; "
                "full_scale in [matcher] states another one"
            )
        return self._full_scale

    @property
    def seeing(self) -> frozenset[str]:
        """The CCD lines that have given lines fit for use lately; from strip to strip."""
        return frozenset(ccd for ccd in self._samples if ccd not in self._returning)

    def take_events(self) -> list[str]:
        """What is worth telling since the last call."""
        events, self._events = self._events, []
        return events

    def tell(self, text: str) -> None:
        """Another line to be told; a camera that fails all the time is told of so many times, then only counted."""
        self._told += 1
        if self._told <= MOST_TOLD:
            self._events.append(text)
        elif self._told == MOST_TOLD + 1:
            self._events.append("more of the kind is counted, but no longer told in this strip")

    def _watch(self, ccd: str, end: int, good: int) -> None:
        """Note which CCD lines see."""
        if good:
            self._good_ends[ccd] = max(self._good_ends[ccd], end)
        newest = max(self._ends.values())
        for other, at in self._good_ends.items():
            if newest - at > BLIND_S * self._rate:
                self._returning[other] = 0
        if ccd in self._returning:
            self._returning[ccd] += good
            enough = RETURN_S * self._rate
            if self._returning[ccd] >= enough:
                back = [c for c, n in self._returning.items() if n >= 0.5 * enough]
                self.sees_from.update({c: newest - self._returning.pop(c) for c in back})

    def _listen(self, ccd: str, end: int) -> None:
        """Tell of CCD lines that nothing comes from any more, and that something comes again."""
        self._ends[ccd] = max(self._ends.get(ccd, 0), end)
        if ccd in self._silent:
            self._silent.discard(ccd)
            self.tell(f"{ccd}: lines come again")
        for other, at in self._ends.items():
            if other not in self._silent and end - at > self._silent_after:
                self._silent.add(other)
                self.tell(f"{other}: nothing has come" + (f" after line {at - 1}" if at > self._first else ""))

    def _tell(self, ccd: str, first_line: int, verdict: NDArray[np.int8]) -> None:
        """Count bad lines; tell where bad ones begin and where they end."""
        bad = verdict[verdict != GOOD]
        for code, n in zip(*np.unique(bad, return_counts=True), strict=True):
            self.counters[f"lines {REASONS[code]}"] += int(n)
        before, state = self._state.get(ccd, GOOD), int(verdict[-1])
        self._state[ccd] = state
        if state == before == GOOD and len(bad):  # a few bad lines among good ones
            first = first_line + int(np.flatnonzero(verdict != GOOD)[0])
            name = _WORDS[REASONS[int(np.bincount(bad).argmax())]]
            are = "lines are" if len(bad) > 1 else "line is"
            self._fault(ccd, name, f"{len(bad)} {are} {name} from {first} on", len(bad), first)
        elif state != before:
            run = first_line + int(np.flatnonzero(np.append(-1, verdict[:-1]) != state)[-1])
            if state == GOOD:
                if ccd in self._told_of:
                    self.tell(f"{ccd}: lines are good again from line {run} on")
                return
            name = _WORDS[REASONS[state]]
            told = self._fault(ccd, name, f"lines are {name} from line {run} on", len(bad), run)
            (self._told_of.add if told else self._told_of.discard)(ccd)

    def _fault(self, ccd: str, name: str, words: str, lines: int, at: int) -> bool:
        """Tell of a fault; whether it was told by itself and not summed up with others of its kind."""
        told, more, since = self._faults.get((ccd, name), (0, 0, at))
        if told < BY_ITSELF:
            self.tell(f"{ccd}: {words}")
            self._faults[ccd, name] = told + 1, 0, at
            return True
        more += lines
        if at - since >= SUMMED_S * self._rate:
            self.tell(f"{ccd}: {more} more lines are {name}, the last ones about line {at}")
            more, since = 0, at
        self._faults[ccd, name] = told, more, since
        return False
